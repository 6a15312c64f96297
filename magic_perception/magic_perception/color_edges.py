"""Where an edge lies between two colours, to a fraction of a pixel.

A pixel at an edge has a colour between those of its two sides, and a tool of wood on wood has such a colour elsewhere itself: by what
colours it has, its edge is taken to lie a pixel too far out.  Across an edge the colours go from one side's to the other's; how much of
the line is of the first says where between its ends the edge is, however much the lens blurs it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: So far (pixels) from an edge colours are unmixed, if the thing goes on so far; colours of a line are read at so many places, those of its
#: ends at ENDS.
UNMIXED, READ, ENDS = 2.0, 17, 3
#: Colours of two sides that differ by less (of 255) do not tell where the edge is.
CONTRAST = 8.0


def parted(
    color: NDArray[np.uint8], hidden: NDArray[np.bool_], starts: Array, outwards: Array, about: Array, room: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Where along lines the edges are, (K,) pixels from their starts, and whether that was found (K,).

    color (H, W, 3); hidden (H, W): what tells nothing; starts (K, 2): u, v; outwards (K, 2): unit vectors; about (K,): where the edge is
    thought to be, within a pixel or so; room (K, 2): how far from the edge inwards and outwards colours are those of one thing, at most.
    """
    inner, outer = np.minimum(room, UNMIXED).T
    share = np.linspace(0, 1, READ)
    at, found = about.copy(), np.zeros(len(about), bool)
    picture, nothing = color.astype(np.float32), hidden.astype(np.float32)
    for _ in range(2):  # once more from where it was found: then both ends are unmixed
        along = (at - inner)[:, None] + share * (inner + outer)[:, None]
        u, v = ((starts[:, k, None] + along * outwards[:, k, None]).astype(np.float32) for k in range(2))
        line = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside, outside = line[:, :ENDS].mean(axis=1), line[:, -ENDS:].mean(axis=1)
        apart = inside - outside
        contrast = np.linalg.norm(apart, axis=1)
        found = (contrast > CONTRAST) & (cv2.remap(nothing, u, v, cv2.INTER_NEAREST, borderValue=1) == 0).all(axis=1)
        alike = ((line - outside[:, None]) * apart[:, None]).sum(axis=-1) / np.maximum(contrast, 1.0)[:, None] ** 2
        edge = at - inner + np.clip(alike, 0, 1).mean(axis=1) * (inner + outer)
        at = np.where(found, np.clip(edge, at - 1, at + 1), at)
    return at, found
