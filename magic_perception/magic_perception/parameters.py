"""The numbers that perception works with, in one place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magic_core.errors import Code, MagicError

METHODS = ("completed", "paper")

#: The workspace before a robot that the node takes where nothing else is said, m. It begins at the robot's base, which is cut out of the
#: pictures: a motion that pulls something towards the robot may end right beside it, and what came of it is to be seen.
WORKSPACE = {"region_low": (0.0, -0.6, -0.05), "region_high": (0.95, 0.6, 0.5)}


@dataclass(frozen=True)
class Parameters:
    """What :func:`magic_perception.pipeline.perceive` may be told; lengths in m.

    Attributes
    ----------
    region_low, region_high : (3,), the workspace box; x and y in the world frame, z above the table that was found.  What is outside is not
        looked at.  A table farther than -region_low[2] from the world's z = 0 is used and said.
    table_tilt : degrees, the largest angle between the table's normal and the world's up.
    table_band : points this near to a plane hypothesis agree with it.
    snap_height, snap_tilt : a table found this near (m, degrees) to the plane z = 0 is taken to be that plane, and the cameras' small
    errors
        of calibration are taken out; 0 turns it off.
    min_height : least height above the table that depth alone may call an object.
    min_pixels, min_extent : smaller things are noise.
    max_extent : what is longer and cut by the picture or the region is no thing on the table.
    cluster_eps, cluster_points : DBSCAN's radius and neighbours on the thinned cloud.
    known_margin : points this near to a known object belong to it.
    resolution : cell of the occupancy grids that outlines come from.
    wall : assumed wall thickness of things that are seen to be hollow from above.
    use_color : refine masks by the colour difference to the table.
    arm_offset : cameras that see the arm farther than this from where its joints put it are refused, and by less what they see is moved;
        0: neither.
    split : part touching objects where what is measured at a concave seam, or at an upright plane between colours, says that they are two
        (:mod:`magic_perception.seams`, :mod:`magic_perception.cuts`).
    method : ``completed``, or ``paper`` for the plain projection and alpha shape of the paper.
    max_objects : the largest ones are kept.
    """

    region_low: tuple[float, float, float] = (-np.inf, -np.inf, -0.05)
    region_high: tuple[float, float, float] = (np.inf, np.inf, 0.6)
    table_tilt: float = 15.0
    table_band: float = 0.008
    snap_height: float = 0.008
    snap_tilt: float = 1.5
    min_height: float = 0.004
    min_pixels: int = 120
    min_extent: float = 0.008
    max_extent: float = 0.6
    cluster_eps: float = 0.012
    cluster_points: int = 4
    known_margin: float = 0.012
    resolution: float = 0.0015
    wall: float = 0.003
    use_color: bool = True
    arm_offset: float = 0.015
    split: bool = True
    method: str = "completed"
    max_objects: int = 24
    seed: int = 0

    def __post_init__(self) -> None:
        low, high = np.asarray(self.region_low, float), np.asarray(self.region_high, float)
        if low.shape != (3,) or high.shape != (3,) or not np.all(low < high):
            raise MagicError(
                Code.BAD_REQUEST,
                "region of interest",
                f"{self.region_low} to {self.region_high}",
                "a lower corner below the upper one on x, y and z",
            )
        if self.method not in METHODS:
            raise MagicError(Code.BAD_REQUEST, "method of reconstruction", self.method, METHODS)
        for name in ("table_tilt", "table_band", "min_height", "cluster_eps", "resolution", "wall"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise MagicError(Code.BAD_REQUEST, name, value, "a number above 0")
