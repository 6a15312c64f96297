"""The plane that things stand on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError


@dataclass(frozen=True)
class Plane:
    """a x + b y + c z + d = 0 with unit normal; ``inliers`` is the share of the given points that agree."""

    coefficients: NDArray[np.float64]
    inliers: float = 1.0

    @property
    def normal(self) -> NDArray[np.float64]:
        """(3,): the unit normal, up."""
        return self.coefficients[:3]

    def heights(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distances (...) in metres of points (..., 3), positive above."""
        return np.asarray(points) @ self.coefficients[:3] + self.coefficients[3]

    def tilt(self, up: ArrayLike = (0.0, 0.0, 1.0)) -> float:
        """Angle in degrees between the normal and a unit vector."""
        return float(np.degrees(np.arccos(np.clip(self.normal @ np.asarray(up, float), -1, 1))))


def fit_plane(
    points: NDArray[np.float64],
    up: ArrayLike | None = None,
    max_tilt: float = 15.0,
    band: float = 0.008,
    iterations: int = 300,
    sample: int = 6000,
    seed: int = 0,
) -> Plane:
    """The plane that most points agree with, by RANSAC and least squares on its inliers.

    points (N, 3) metres.  With ``up`` only planes whose normal lies within ``max_tilt`` degrees of it count;
    without, the normal is turned towards the origin (the camera).  Of planes with nearly the same support
    (90 %) the upper one wins, so that a table wins over the floor below it only where both are seen equally.
    Raises ``NO_TABLE`` for fewer than 100 points or no plane that 10 % of them agree with.
    """
    points = np.asarray(points, dtype=float)
    if not np.isfinite(points.sum()):
        points = points[np.all(np.isfinite(points), axis=1)]
    if len(points) < 100:
        raise MagicError(Code.NO_TABLE, "points for the table plane", len(points), "at least 100 with depth in the region of interest")
    rng = np.random.default_rng(seed)
    points = points[rng.permutation(len(points))[:sample]]
    few = points[:1000]  # enough to rank hypotheses; the best is fitted to all
    corners = few[rng.integers(0, len(few), (iterations, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    # Three points closer together than the noise say nothing of the normal.
    sound = lengths > 1e-4
    normals, corners = normals[sound] / lengths[sound, None], corners[sound]
    offsets = -np.sum(normals * corners[:, 0], axis=1)
    if up is not None:
        facing = normals @ np.asarray(up, float)
        upright = np.abs(facing) > np.cos(np.radians(max_tilt))
        normals, offsets = (normals * np.sign(facing)[:, None])[upright], (offsets * np.sign(facing))[upright]
    else:
        sign = np.where(offsets < 0, -1.0, 1.0)
        normals, offsets = normals * sign[:, None], offsets * sign
    if len(normals) == 0:
        raise MagicError(Code.NO_TABLE, "table plane", "no upright plane", f"a plane within {max_tilt} degrees of level")
    distance = normals.astype(np.float32) @ few.T.astype(np.float32) + offsets[:, None].astype(np.float32)
    support = np.count_nonzero(np.abs(distance, out=distance) < band, axis=1)
    best = int(np.argmax(support))
    coefficients = np.append(normals[best], offsets[best])
    for width in (band, band * 0.6, band * 0.6):
        near = np.abs(points @ coefficients[:3] + coefficients[3]) < width
        if near.sum() < 50:
            break
        centre = points[near].mean(axis=0)
        local = points[near] - centre
        normal = np.linalg.eigh(local.T @ local)[1][:, 0]
        normal = normal if normal @ coefficients[:3] > 0 else -normal
        coefficients = np.append(normal, -normal @ centre)
    inliers = float(np.mean(np.abs(points @ coefficients[:3] + coefficients[3]) < band))
    plane = Plane(coefficients, inliers)
    if inliers < 0.1:
        raise MagicError(Code.NO_TABLE, "share of points on the best plane", round(inliers, 3), "at least 0.1")
    if up is not None and plane.tilt(up) > max_tilt:
        raise MagicError(Code.NO_TABLE, "tilt of the best plane in degrees", round(plane.tilt(up), 1), f"at most {max_tilt}")
    return plane


def world_from_plane(plane: Plane) -> NDArray[np.float64]:
    """The frame on the plane below the origin, z along its normal, x the origin frame's x (or y) made level."""
    z = plane.normal
    x = np.array([1.0, 0, 0]) if abs(z[0]) < 0.9 else np.array([0, 1.0, 0])
    x = transforms.unit(x - (x @ z) * z)
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), -plane.coefficients[3] * z)


def camera_over_table(points: NDArray[np.float64], band: float = 0.008, seed: int = 0) -> NDArray[np.float64]:
    """world_from_camera (4, 4) of a camera whose pose is not known, from the table that it sees.

    points (..., 3) in the optical frame.  The world's origin lies on the table below the camera,
    z up, x level in the direction that the camera looks.
    """
    plane = fit_plane(np.asarray(points).reshape(-1, 3), band=band, seed=seed)
    z = plane.normal
    forward = np.array([0.0, 0.0, 1.0])
    x = forward - (forward @ z) * z
    if np.linalg.norm(x) < 0.1:  # looking straight down: the picture's top is forward
        x = np.array([0.0, -1.0, 0.0]) - (np.array([0.0, -1.0, 0.0]) @ z) * z
    x = transforms.unit(x)
    camera_from_world = transforms.make(np.column_stack([x, np.cross(z, x), z]), -plane.coefficients[3] * z)
    return transforms.inverse(camera_from_world)
