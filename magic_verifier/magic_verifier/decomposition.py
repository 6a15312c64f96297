"""Convex pieces of a mesh, by their former place: scripts outside this repository import them from here."""

from magic_core.decomposition import convex_pieces

__all__ = ["convex_pieces"]
