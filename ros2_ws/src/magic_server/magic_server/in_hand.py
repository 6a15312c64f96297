"""Where the tool is in the hand, by the points that cameras see of it.  No ROS here.

The tool's shape is known from before it was grasped, and its pose is expected to be where the arm and the grasp put it.  What
is seen of it now, without what the hand hides, is laid against that shape: the pose is the most likely one given both, the
points (point to plane, by Gauss and Newton) and the grasp (normal, as wide as :data:`PRIOR`).  So a direction in which nothing
is seen, the axis of a round rod for one, stays as the grasp has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.mesh import Mesh

Array = NDArray[np.float64]

#: How far a tool may be off in the hand before it is looked at, and since it was looked at: standard deviations, m and rad.
PRIOR, AGAIN = (0.015, 0.2), (0.005, 0.07)
#: Standard deviation, m, of a point on the surface as it was reconstructed; its errors hold together over a patch, so that however many
#: points are seen they count as so many at most.
NOISE, WORTH = 0.003, 60
#: Points on the tool's surface that stand for it, and points seen that are used.
SURFACE, USED = 3000, 400
#: Points farther than this from the tool are none of it, m: when the search begins, and when it ends.
REACH, CLOSE = 0.04, 0.010
#: Fewer points than these say nothing; and fewer than this share of those about it, that what is there is something else.
FEWEST, SHARE = 40, 0.5
ROUNDS = 25
#: The search begins as expected and turned by so much, rad, about the axis along which the fingers close, and shifted by so much, m,
#: along the tool: the ways a tool slips.
TURNS, SHIFTS = (0.0, 0.35, -0.35), (0.0, 0.02, -0.02)
#: Another pose that far from the best one (m, rad) and hardly less likely (difference of the logarithms, twice) says that nobody knows.
APART, LIKELY = (0.008, 0.15), 6.0


@dataclass(frozen=True)
class Seen:
    """world_from_tool (4, 4); how many points say so, and their distance from the surface, m (root mean square)."""

    world_from_tool: Array
    points: int
    distance: float


@dataclass(frozen=True)
class Deviation:
    """How far a tool in the hand is from where it is expected: m at its middle, and rad."""

    shift: float
    turn: float

    @classmethod
    def of(cls, mesh: Mesh, expected: Array, found: Array) -> Deviation:
        """Of two poses (4, 4) of a tool in the world."""
        middle = mesh.bounds.mean(axis=0)
        shift = float(np.linalg.norm(transforms.apply(found, middle) - transforms.apply(expected, middle)))
        return cls(shift, transforms.rotation_angle(expected, found))

    def within(self, shift: float, turn: float) -> bool:
        """Whether it is no larger than both."""
        return self.shift <= shift and self.turn <= turn

    def __str__(self) -> str:
        return f"{1000 * self.shift:.1f} mm and {np.degrees(self.turn):.1f} degrees"


@lru_cache(maxsize=4)
def _surface(vertices: bytes, faces: bytes) -> tuple[Array, Array, cKDTree]:
    mesh = trimesh.Trimesh(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, dtype=np.int64).reshape(-1, 3), process=False)
    points, face = trimesh.sample.sample_surface(mesh, SURFACE, seed=0)
    return np.asarray(points), np.asarray(mesh.face_normals[face]), cKDTree(points)


def locate(mesh: Mesh, expected: Array, points: Array, closing: Array, prior: tuple[float, float] = PRIOR) -> Seen | None:
    """The pose of a tool that is expected at ``expected`` (world_from_tool), by world points (N, 3) of which some are on it.

    closing (3,): unit direction in the world along which the fingers close.  prior: how well it is known to be there, standard deviations, m and rad.
    ``None`` where too little of it is seen, or what is seen would be as likely with the tool elsewhere.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    surface = _surface(np.asarray(mesh.vertices, dtype=float).tobytes(), np.asarray(mesh.faces, dtype=np.int64).tobytes())
    middle = transforms.apply(expected, mesh.bounds.mean(axis=0))
    # Any pose within three deviations of the prior has its points in this ball; what is far from it need not be looked at.
    ball = float(np.linalg.norm(mesh.extents)) / 2 + REACH + 3 * PRIOR[0]
    points = points[np.linalg.norm(points - middle, axis=1) < ball]
    points = points[:: max(1, len(points) // USED)]
    if len(points) < FEWEST:
        return None
    along = expected[:3, int(np.argmax(mesh.extents))]
    starts = [_about(middle, transforms.from_rotvec(turn * closing, shift * along)) for turn in TURNS for shift in SHIFTS]
    tried = [_fitted(surface, expected, start, points, middle, prior) for start in starts]
    moved, against = min(tried, key=lambda fit: fit[1])
    pose = moved @ expected
    for other, more in tried:
        if more < against + LIKELY and not Deviation.of(mesh, pose, other @ expected).within(*APART):
            return None
    distances = surface[2].query(transforms.apply(transforms.inverse(pose), points))[0]
    on = distances < CLOSE
    if on.sum() < max(FEWEST, SHARE * len(points)):
        return None
    return Seen(pose, int(on.sum()), float(np.sqrt((distances[on] ** 2).mean())))


def _about(middle: Array, turned: Array) -> Array:
    return transforms.make(translation=middle) @ turned @ transforms.make(translation=-middle)


def _fitted(
    surface: tuple[Array, Array, cKDTree], expected: Array, moved: Array, points: Array, middle: Array, prior: tuple[float, float]
) -> tuple[Array, float]:
    """What has moved the tool from where it is expected (4, 4, in the world), sought from ``moved``, and what speaks against it."""
    on, normals, tree = surface
    information = np.repeat([1 / prior[0] ** 2, 1 / prior[1] ** 2], 3)
    for step in range(ROUNDS):
        pose = moved @ expected
        distances, index = tree.query(transforms.apply(transforms.inverse(pose), points))
        reach = max(CLOSE, REACH * (1 - 2 * step / ROUNDS))
        near = distances < reach
        if near.sum() < 6:
            return moved, np.inf
        foot = transforms.apply(pose, on[index[near]])
        normal = normals[index[near]] @ pose[:3, :3].T
        gap = ((points[near] - foot) * normal).sum(axis=1)
        jacobian = np.concatenate([normal, np.cross(foot - middle, normal)], axis=1)
        # Beyond two deviations a point counts less the farther it is (Huber).
        weight = np.minimum(1.0, 2 * NOISE / np.maximum(np.abs(gap), 1e-9)) / NOISE**2
        weight *= min(1.0, WORTH / near.sum())
        off = _vector(moved, middle)
        matrix = (jacobian * weight[:, None]).T @ jacobian + np.diag(information)
        change = np.linalg.solve(matrix, (jacobian * weight[:, None]).T @ gap - information * off)
        moved = _about(middle, transforms.from_rotvec(change[3:], change[:3])) @ moved
        if np.abs(change).max() < 1e-5 and reach == CLOSE:
            break
    distances = tree.query(transforms.apply(transforms.inverse(moved @ expected), points))[0]
    seen = np.minimum(distances, 2 * CLOSE) ** 2 / NOISE**2
    return moved, float(seen.mean() * min(len(points), WORTH) + information @ _vector(moved, middle) ** 2)


def _vector(moved: Array, middle: Array) -> Array:
    """(6,): the shift of the middle, m, and the rotation vector, rad."""
    return np.concatenate([transforms.apply(moved, middle) - middle, Rotation.from_matrix(moved[:3, :3]).as_rotvec()])
