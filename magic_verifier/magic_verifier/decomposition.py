"""Convex pieces of a mesh: :mod:`magic_core.decomposition`, by the name that scripts of users import."""

from magic_core.decomposition import convex_pieces

__all__ = ["convex_pieces"]
