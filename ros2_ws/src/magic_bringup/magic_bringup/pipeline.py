"""In which order the candidates of a run are tried: :class:`magic_server.pipeline.Agenda`, by the name that scripts of users import."""

from magic_server.pipeline import Agenda

__all__ = ["Agenda"]
