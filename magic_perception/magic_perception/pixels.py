"""Which pixels of a picture something holds of, where they are, and which of them together are broad."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def where(mask: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (N,) of the pixels of a picture (H, W) that are not 0, row by row: what ``np.nonzero`` finds, in an eighth of its
    time, as that is quick along one axis alone."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return rows, columns


def opened(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """What of a mask (H, W) is no narrower than so many pixels, in rows and in columns."""
    return cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)).view(bool)


def window(mask: NDArray, margin: int = 0) -> tuple[slice, slice]:
    """The rows and columns that hold all pixels of a picture (H, W) of one byte each that are not 0, and so many around.

    None where there are no such pixels.  What is done there costs by the size of a thing, and not by that of the picture.
    """
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    if w == 0:
        return slice(0, 0), slice(0, 0)
    return slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin)
