"""A tool's pixels told from all others by their colour: from those of what is behind it, and from those of what may touch it.

The tool's colours are those of the pixels in which it lies first.  What is about it then and while it moves is ground, which is behind it
wherever it is seen.  The hand, and the things that stood about at first (the target, fixtures), may come between the tool and the camera,
touch it or lie in it: depth does not part them from it, colour may.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from magic_core.camera import RgbdFrame

Array = NDArray[np.float64]
#: Colours are told apart by L*, a* and b* in bins of so many units (of 256), blurred by as many bins as the light on a surface changes
#: them; a colour that the tool has not shown is its own with this share of an even chance.
BIN, BLUR, STRANGE = (16, 4, 4), (2.0, 1.5, 1.5), 0.02
SHAPE = tuple(256 // size for size in BIN)
EVEN = 1 / math.prod(SHAPE)
#: What is not the tool is ground, what moves, one of the other things, and anything else, with these chances.
CHANCES = (0.3, 0.3, 0.3, 0.1)
#: A pixel says what those of a square of so many to a side say on average.
ALONE = 3
#: Evidence of a pixel at most (natural logarithm of the ratio of likelihoods).
EVIDENCE = 3.0
#: The share of what is learned anew from each picture: of ground, and of what moves.
LEARNING = (0.1, 0.3)


class Said(NamedTuple):
    """What the colours of a picture say.  tool (H, W): the logarithm of how much likelier the colours about a pixel are the tool's than
    those of anything else; touches (H, W): it is not, and rather that of a hand or of another thing, which may touch the tool, than that of
    ground."""

    tool: NDArray[np.float32]
    touches: NDArray[np.bool_]


class ToolColors:
    """Colours of a tool, of the ground, of what moves and of other things, as shares of 1 in bins; until they are learned all are alike."""

    def __init__(self) -> None:
        self._own = self._ground = self._moving = self._others = np.full(SHAPE, EVEN)

    def learn(self, own: NDArray[np.uint8], ground: NDArray[np.uint8], others: Sequence[NDArray[np.uint8]]) -> None:
        """Take colours (N, 3) that are seen before anything moves; others: of each other thing."""
        self._own, self._ground = _histogram(own), _histogram(ground)
        if others:
            self._others = np.mean([_histogram(colors) for colors in others], axis=0)

    def see_ground(self, colors: NDArray[np.uint8]) -> None:
        """Take the colours (N, 3) of other ground."""
        self._ground = (1 - LEARNING[0]) * self._ground + LEARNING[0] * _histogram(colors)

    def see_moving(self, colors: NDArray[np.uint8]) -> None:
        """Take the colours (N, 3) of what has come into the pictures."""
        self._moving = (1 - LEARNING[1]) * self._moving + LEARNING[1] * _histogram(colors)

    def said(self, frame: RgbdFrame) -> Said:
        """What a frame's colours say."""
        ground, moving, others, rest = CHANCES
        own = self._own + STRANGE * EVEN
        other = ground * self._ground + moving * self._moving + others * self._others + rest * EVEN
        tool = np.clip(np.log(own / other), -EVIDENCE, EVIDENCE).astype(np.float32)
        touches = ((tool < 0) & ((self._moving + self._others) / 2 > self._ground)).astype(np.float32)
        bins = tuple(np.moveaxis(lab(frame) // BIN, -1, 0))
        # A pixel alone is of another thing's colour by chance, its neighbours are not.
        tool, touches = (cv2.blur(each[bins], (ALONE, ALONE)) for each in (tool, touches))
        return Said(tool, (tool < 0) & (touches > 0.5))


def lab(frame: RgbdFrame) -> NDArray[np.uint8]:
    """The colours (H, W, 3) of a frame: L*, a* and b*."""
    return cv2.cvtColor(frame.color, cv2.COLOR_RGB2LAB)


def _histogram(colors: NDArray[np.uint8]) -> Array:
    """How often colours (N, 3) come, as shares of 1, in bins and blurred."""
    counts = np.zeros(SHAPE)
    np.add.at(counts, tuple((colors // BIN).T), 1.0)
    return gaussian_filter(counts / max(len(colors), 1), BLUR)
