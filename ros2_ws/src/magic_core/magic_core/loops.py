"""The opening of a loop (a handle's, a ring's): where it is, and how much of it is in a camera's sight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.rendering import Raycaster


@dataclass(frozen=True)
class Opening:
    """The flat opening that a rim bounds.  points (N, 3): all over it, m; through (3,): unit vector through it."""

    points: NDArray[np.float64]
    through: NDArray[np.float64]

    @classmethod
    def within(cls, rim: NDArray[np.float64], apart: float = 0.001) -> Opening:
        """The opening within a rim (M, 3) in order, m, by points so far ``apart`` in its plane."""
        import shapely

        middle = rim.mean(axis=0)
        plane = np.linalg.svd(rim - middle)[2]  # two directions in the opening, and the one through it
        flat = (rim - middle) @ plane[:2].T
        low, high = flat.min(axis=0), flat.max(axis=0)
        grid = np.stack(np.meshgrid(*(np.arange(a, b, apart) for a, b in zip(low, high, strict=True))), axis=-1).reshape(-1, 2)
        inside = grid[shapely.contains_xy(shapely.Polygon(flat), grid)]
        return cls(middle + inside @ plane[:2], plane[2])

    def moved(self, pose: NDArray[np.float64]) -> Opening:
        """The opening in another frame: pose (4, 4)."""
        return Opening(transforms.apply(pose, self.points), pose[:3, :3] @ self.through)

    def in_sight(self, eye: NDArray[np.float64], everything: Raycaster) -> float:
        """How much of it is in sight from ``eye`` (3,), as a share of what there is from straight ahead: 0 to 1.

        everything: what may hide it, the loop itself too.
        """
        away = np.linalg.norm(self.points - eye, axis=1)
        ways = (self.points - eye) / away[:, None]
        free = everything.cast(np.broadcast_to(eye, ways.shape)[None], ways[None]).distance[0] > away
        return float(np.mean(free * np.abs(ways @ self.through)))
