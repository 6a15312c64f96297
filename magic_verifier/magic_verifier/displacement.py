"""How far a thing was moved from where it stood: by its middle, or by its outline where it was turned on the spot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from magic_core import transforms


class Place:
    """Where a thing stands on a table.

    Its outline is the convex hull of its corners, seen along the table's normal.  What is turned about an axis that it is round about, as a
    can is, stays in its outline, and nothing of it is taken to have moved; a bar that is turned about its middle leaves its outline by up
    to half its length.
    """

    def __init__(
        self, corners: NDArray[np.float64], pose: NDArray[np.float64], middle: NDArray[np.float64], normal: NDArray[np.float64]
    ) -> None:
        """``corners`` (N, 3) in the thing's frame; its ``pose`` (4, 4) and ``middle`` (3,) in the world; ``normal`` (3,) of the table."""
        across = np.linalg.svd(np.asarray(normal, dtype=float)[None])[2][1:]
        self._corners, self._across, self._middle = corners, across, across @ middle
        self._outline = ConvexHull(transforms.apply(pose, corners) @ across.T).equations

    def left_by(self, pose: NDArray[np.float64], middle: NDArray[np.float64]) -> float:
        """Metres along the table by which it has left its place, now that ``pose`` and ``middle`` are these: the way of its middle, or how
        far it reaches out of its old outline, whichever is more."""
        seen = transforms.apply(pose, self._corners) @ self._across.T
        beyond = seen @ self._outline[:, :2].T + self._outline[:, 2]
        # Not a number where one of them is none.
        return float(np.maximum(np.linalg.norm(self._across @ middle - self._middle), beyond.max()))
