"""Seeded parameters of a generator: drawn in a fixed order, any of them given instead."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from magic_core.errors import Code, MagicError
from magic_core.shapes.solids import Color

if TYPE_CHECKING:
    from magic_core.shapes.shape import Shape

_PAINTS: tuple[Color, ...] = (
    (196, 60, 52),
    (52, 98, 180),
    (60, 140, 80),
    (222, 168, 50),
    (120, 70, 150),
    (60, 60, 66),
    (225, 225, 220),
    (230, 120, 60),
    (60, 160, 170),
    (200, 110, 140),
)
_METALS: tuple[Color, ...] = ((168, 172, 178), (140, 144, 150), (188, 186, 180), (110, 112, 118))
_WOODS: tuple[Color, ...] = ((176, 130, 84), (150, 104, 62), (205, 166, 118))


class Draw:
    """Draws the parameters of one object of a family.

    Giving one parameter leaves the others as the seed draws them, because each draw
    takes its number whether it is used or not.  A name that the generator does not
    know raises ``BAD_REQUEST`` in :meth:`done`.
    """

    def __init__(self, family: str, seed: int, given: dict[str, float | str]) -> None:
        if not isinstance(seed, (int, np.integer)) or seed < 0:
            raise MagicError(Code.BAD_REQUEST, f"seed of a {family}", seed, "an integer from 0 up")
        self._family, self._given = family, dict(given)
        # The family is part of the seed, so that families do not share their draws.
        self._random = np.random.default_rng([int(seed), *family.encode()])
        self.parameters: dict[str, float | str] = {}

    def real(self, name: str, low: float, high: float) -> float:
        """A number drawn evenly from low to high."""
        value = float(self._random.uniform(low, high))
        given = self._given.get(name, value)
        if isinstance(given, str) or not np.isfinite(given) or given < 0:
            raise MagicError(
                Code.BAD_REQUEST, f"{name} of a {self._family}", given, f"a number from 0 up (usually {low:.4g} to {high:.4g})"
            )
        self.parameters[name] = float(given)
        return float(given)

    def choice(self, name: str, choices: tuple[str, ...]) -> str:
        """One of several words."""
        value = choices[int(self._random.integers(len(choices)))]
        given = self._given.get(name, value)
        if isinstance(given, float):
            given = f"{given:g}"  # a count
        if given not in choices:
            raise MagicError(Code.BAD_REQUEST, f"{name} of a {self._family}", given, choices)
        self.parameters[name] = str(given)
        return str(given)

    def _paint(self, paints: tuple[Color, ...]) -> Color:
        base = np.array(paints[int(self._random.integers(len(paints)))]) + self._random.normal(0, 8, 3)
        r, g, b = np.clip(base, 20, 240).astype(int).tolist()
        return r, g, b

    def color(self) -> Color:
        """A paint or plastic colour."""
        return self._paint(_PAINTS)

    def metal(self) -> Color:
        """A metal's grey."""
        return self._paint(_METALS)

    def wood(self) -> Color:
        """A wood's brown."""
        return self._paint(_WOODS)

    def done(self) -> None:
        """Raise ``BAD_REQUEST`` for given names that were never drawn."""
        unknown = sorted(set(self._given) - set(self.parameters))
        if unknown:
            raise MagicError(Code.BAD_REQUEST, f"parameter of a {self._family}", unknown[0], tuple(self.parameters))


def recipe(make: Callable[..., Shape]) -> Callable[..., Shape]:
    """A generator whose geometric impossibilities come out as ``BAD_REQUEST`` with the parameters."""

    def checked(seed: int = 0, **given: float | str) -> Shape:
        try:
            return make(seed, **given)
        except (ValueError, ArithmeticError) as error:
            raise MagicError(
                Code.BAD_REQUEST, f"{make.__name__} {seed} with {given}", str(error), "sizes that give a closed solid"
            ) from error

    checked.__name__, checked.__doc__ = make.__name__, make.__doc__
    return checked
