"""Procedural objects: seeded families of tools, targets and fixtures with their functional regions.

``make("mug", 7)`` is the seventh mug; ``make("caliper", 3, opening=0.1)`` the third
caliper with one parameter given.  ``FAMILIES`` names the generators; each returns a
:class:`Shape`.
"""

from __future__ import annotations

from collections.abc import Callable

from magic_core.errors import Code, MagicError
from magic_core.shapes.flat import FLAT
from magic_core.shapes.round import HANDLES, PROFILES, ROUND
from magic_core.shapes.shape import Region, Shape, section_view
from magic_core.shapes.struck import STRUCK

FAMILIES: dict[str, Callable[..., Shape]] = {**FLAT, **ROUND, **STRUCK}

__all__ = ["FAMILIES", "HANDLES", "PROFILES", "Region", "Shape", "make", "mug_of_set", "mug_set", "section_view"]


def make(family: str, seed: int = 0, **parameters: float | str) -> Shape:
    """The object of a family and a seed; parameters (metres, radians, words) given here replace the drawn ones.

    Raises ``BAD_REQUEST`` for a family or parameter that is not there, or sizes that give no solid.
    """
    if family not in FAMILIES:
        raise MagicError(Code.BAD_REQUEST, "family of shapes", family, tuple(FAMILIES))
    return FAMILIES[family](seed, **parameters)


def mug_set(count: int = 134, seed: int = 0) -> list[Shape]:
    """``count`` different mugs that go through all pairs of body profile and handle form."""
    return [mug_of_set(k, seed) for k in range(count)]


def mug_of_set(index: int, seed: int = 0) -> Shape:
    """The mug of that index in :func:`mug_set`, without making the others."""
    profile, handle = PROFILES[index % len(PROFILES)], HANDLES[index // len(PROFILES) % len(HANDLES)]
    return make("mug", seed + index, profile=profile, handle=handle)
