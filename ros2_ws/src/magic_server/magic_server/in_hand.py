"""Where the tool is in the hand, by the points that cameras see of it.  No ROS here.

The tool's shape is known from before it was grasped, and its pose is expected to be where the arm and the grasp put it.  What
is seen of it now, without what the hand hides, is laid against that shape: the pose is the most likely one given both, the
points (point to plane, by Gauss and Newton) and the grasp (normal, a :class:`Spread`).  So a direction in which nothing
is seen, the axis of a round rod for one, stays as the grasp has it.

What the grasp says, it says of the place between the pads: they leave the tool no way across them, and what turns there moves the
tool's far end by much more than what is seen of that end is wrong by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.mesh import Mesh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spread:
    """How far a tool may be from where it is expected, standard deviations: closing, m along the axis along which the fingers close;
    along, m across it; turn, rad.  All of them at the place between the fingertips."""

    closing: float
    along: float
    turn: float


#: Of a tool that was grasped, since it was looked at in the hand, and since it was let go.  Pads turn a tool until it lies flat between
#: them, and what slips goes along them.
GRASPED, LOOKED, LET_GO = Spread(0.003, 0.012, 0.15), Spread(0.002, 0.005, 0.07), Spread(0.02, 0.02, 0.3)
#: Standard deviation, m, of a point on the surface as it was reconstructed; its errors hold together over a patch, so that however many
#: points are seen they count as so many at most.
NOISE, WORTH = 0.003, 60
#: Points on the tool's surface that stand for it, and points seen that are used.
SURFACE, USED = 12000, 400
#: The surface is where points were seen at the first look: the median of so many...
NEIGHBOURS = 9
#: ...where those are within so much, m, along it and across it...
BESIDE, ABOVE = 0.006, 0.005
#: ...and lie around: their mean is within this, m, along it.
AROUND = 0.0015
#: Nearer to the fingertips than this, m, depth is smeared between fingers and tool.
BY_FINGERS = 0.045
#: Points farther than this from the tool are none of it, m: when the search begins, and when it ends.
REACH, CLOSE = 0.04, 0.010
#: Fewer points than these say nothing; and fewer than this share of those about it, that what is there is something else.
FEWEST, SHARE = 40, 0.5
ROUNDS = 25
#: The search begins as expected, turned by so much, rad, about each axis of the hand, and shifted by so much, m, along the tool.
TURN, SHIFT = 0.35, 0.02
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


@dataclass(frozen=True)
class Shape:
    """A tool as it was seen before it was grasped, in its own frame: mesh, points (N, 3) on its surface with normals (N, 3)."""

    mesh: Mesh
    points: Array
    normals: Array
    tree: cKDTree

    @classmethod
    def of(cls, mesh: Mesh, seen: Array) -> Shape:
        """Of a reconstruction and the points (M, 3) that were seen of it, both in its frame: where those are, they are the surface."""
        body = mesh.to_trimesh()
        points, face = trimesh.sample.sample_surface(body, SURFACE, seed=0)
        points, normals = np.asarray(points), np.asarray(body.face_normals[face])
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen) >= NEIGHBOURS:
            tree = cKDTree(seen)
            # Of noisy points those that are nearest to where the surface is not are on that side of it: looked for again from nearer by.
            for _ in range(2):
                distance, index = tree.query(points, k=NEIGHBOURS, distance_upper_bound=BESIDE + ABOVE)
                near = np.isfinite(distance)
                way = seen[np.where(near, index, 0)] - points[:, None]
                gap = np.einsum("nkj,nj->nk", way, normals)
                near &= (np.abs(gap) < ABOVE) & (distance**2 - gap**2 < BESIDE**2)
                # Past an edge another face was seen: its points are all on one side.
                aside = np.where(near[..., None], way - gap[..., None] * normals[:, None], 0.0).sum(axis=1)
                around = np.linalg.norm(aside, axis=1) < AROUND * near.sum(axis=1)
                moved = around & (near.sum(axis=1) > NEIGHBOURS / 2)
                points[moved] += np.nanmedian(np.where(near, gap, np.nan)[moved], axis=1)[:, None] * normals[moved]
        return cls(mesh, points, normals, cKDTree(points))

    def distances(self, world_from_tool: Array, points: Array) -> Array:
        """(N,): how far world points (N, 3) are from it at a pose, m."""
        return np.asarray(self.tree.query(transforms.apply(transforms.inverse(world_from_tool), points))[0])


def clear_of(hand: Array, points: Array) -> Array:
    """Of world points (N, 3) those that tell of a tool in a hand at a pose world_from_tcp (4, 4)."""
    return np.asarray(points[np.linalg.norm(points - hand[:3, 3], axis=1) > BY_FINGERS])


def locate(shape: Shape, expected: Array, points: Array, hand: Array, closing: int, spread: Spread = GRASPED) -> Seen | None:
    """The pose of a tool, where there is one that :func:`located` finds; ``None`` where too little of it is seen, or what is seen would
    be as likely with the tool elsewhere."""
    found = located(shape, expected, points, hand, closing, spread)
    return found[0] if len(found) == 1 else None


def located(shape: Shape, expected: Array, points: Array, hand: Array, closing: int, spread: Spread = GRASPED) -> list[Seen]:
    """The poses of a tool that is expected at ``expected`` (world_from_tool), by world points (N, 3) of which some are on it: the most
    likely one first, and those as likely that are :data:`APART` from the ones before.

    hand (4, 4): world_from_tcp, where the pads hold it, or did; closing: the axis of that frame, 0 or 1, along which they close.
    Empty where too little of it is seen.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    mesh = shape.mesh
    middle = transforms.apply(expected, mesh.bounds.mean(axis=0))
    # Poses that the grasp makes likely have the tool's points in this ball; what is far from it need not be looked at.
    ball = float(np.linalg.norm(mesh.extents)) / 2 + REACH + 3 * max(spread.closing, spread.along)
    points = points[np.linalg.norm(points - middle, axis=1) < ball]
    points = points[:: max(1, len(points) // USED)]
    if len(points) < FEWEST:
        return []
    prior = _Prior.of(hand, closing, spread)
    along = expected[:3, int(np.argmax(mesh.extents))]
    turns = [sign * TURN * axis for axis in hand[:3, :3].T for sign in (1, -1)]
    starts = [transforms.from_rotvec(turn) for turn in ([0.0, 0.0, 0.0], *turns)]
    starts += [transforms.make(translation=shift * along) for shift in (SHIFT, -SHIFT)]
    tried = [_fitted(shape, expected, _about(middle, start), points, prior) for start in starts]
    tried.sort(key=lambda fit: fit[1])
    found: list[Seen] = []
    for moved, against in tried:
        pose = moved @ expected
        if not against < tried[0][1] + LIKELY or any(Deviation.of(mesh, other.world_from_tool, pose).within(*APART) for other in found):
            continue
        distances = shape.distances(pose, points)
        on = distances < CLOSE
        if not found and on.sum() < max(FEWEST, SHARE * len(points)):
            return []
        found.append(Seen(pose, int(on.sum()), float(np.sqrt((distances[on] ** 2).mean()))))
    return found


@dataclass(frozen=True)
class _Prior:
    """What the grasp says of a motion (6,) of the tool, shift at ``pivot`` (3,) and turn: information (6, 6)."""

    pivot: Array
    information: Array

    @classmethod
    def of(cls, hand: Array, closing: int, spread: Spread) -> _Prior:
        shifts = np.full(3, spread.along)
        shifts[closing] = spread.closing
        information = np.zeros((6, 6))
        information[:3, :3] = hand[:3, :3] @ np.diag(shifts**-2.0) @ hand[:3, :3].T
        information[3:, 3:] = np.eye(3) / spread.turn**2
        return cls(hand[:3, 3].copy(), information)

    def vector(self, moved: Array) -> Array:
        """(6,): the shift of the pivot, m, and the rotation vector, rad."""
        shift = transforms.apply(moved, self.pivot) - self.pivot
        return np.concatenate([shift, Rotation.from_matrix(moved[:3, :3]).as_rotvec()])


def _about(middle: Array, turned: Array) -> Array:
    return transforms.make(translation=middle) @ turned @ transforms.make(translation=-middle)


def _fitted(shape: Shape, expected: Array, moved: Array, points: Array, prior: _Prior) -> tuple[Array, float]:
    """What has moved the tool from where it is expected (4, 4, in the world), sought from ``moved``, and what speaks against it."""
    for step in range(ROUNDS):
        pose = moved @ expected
        distances, index = shape.tree.query(transforms.apply(transforms.inverse(pose), points))
        reach = max(CLOSE, REACH * (1 - 2 * step / ROUNDS))
        near = distances < reach
        if near.sum() < 6:
            return moved, np.inf
        foot = transforms.apply(pose, shape.points[index[near]])
        normal = shape.normals[index[near]] @ pose[:3, :3].T
        gap = ((points[near] - foot) * normal).sum(axis=1)
        jacobian = np.concatenate([normal, np.cross(foot - prior.pivot, normal)], axis=1)
        # Beyond two deviations a point counts less the farther it is (Huber).
        weight = np.minimum(1.0, 2 * NOISE / np.maximum(np.abs(gap), 1e-9)) / NOISE**2
        weight *= min(1.0, WORTH / near.sum())
        matrix = (jacobian * weight[:, None]).T @ jacobian + prior.information
        change = np.linalg.solve(matrix, (jacobian * weight[:, None]).T @ gap - prior.information @ prior.vector(moved))
        moved = _about(prior.pivot, transforms.from_rotvec(change[3:], change[:3])) @ moved
        if np.abs(change).max() < 1e-5 and reach == CLOSE:
            break
    seen = np.minimum(shape.distances(moved @ expected, points), 2 * CLOSE) ** 2 / NOISE**2
    off = prior.vector(moved)
    return moved, float(seen.mean() * min(len(points), WORTH) + off @ prior.information @ off)
