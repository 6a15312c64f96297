"""Writing a bag: :class:`magic_bags.recording.Recording`, by the name that scripts of users import."""

from magic_bags.recording import Recording

__all__ = ["Recording"]
