"""The arm and its gripper: where their description is, how they move, what they touch.

Everything that is particular to one arm is in :class:`magic_core.robot.RobotConfig`.  MPlib loads
URDF and SRDF, checks collisions and plans free motion; :mod:`magic_planner.kinematics`
answers the many small questions.
"""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.robot import Description, RobotConfig
from magic_planner.budget import Budget
from magic_planner.collision import Body, fcl_pose, hull
from magic_planner.kinematics import Chain, load_chain
from magic_planner.timing import Limits

#: Joint positions that are tried as starts of the inverse kinematics.
SEEDS = 6000
#: How far the table's slab lies below its plane, m: what lies on it does not touch it.
TABLE_GAP = 0.001
#: A path is checked for collisions at steps of so many rad.
CHECKED = 0.04
#: A solution keeps so far from the limits of the joints, rad.
FROM_LIMIT = 0.02


@dataclass(frozen=True)
class Collision:
    """Two things that meet: names of links or objects."""

    first: str
    second: str

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


@dataclass
class Attached:
    """The object in the hand as the collision world knows it."""

    name: str = ""
    touching: tuple[str, ...] = field(default_factory=tuple)


class Robot:
    """The arm in its collision world.  Not thread-safe: one request at a time."""

    def __init__(self, config: RobotConfig | None = None) -> None:
        """Load the arm; raises BAD_REQUEST for a file, link or joint that is not there."""
        import mplib

        self.description = Description(config)
        self.config, urdf = self.description.config, self.description.urdf
        limits = np.array([(joint.lower, joint.upper) for joint in self.description.arm])
        chain = load_chain(urdf, self.config.move_group)
        velocity = np.minimum(chain.velocity, self.description.velocity)
        self.chain: Chain = replace(chain, lower=limits[:, 0], upper=limits[:, 1], velocity=velocity)
        # MPlib writes a copy of a URDF that names package:// beside it; ours goes to a folder that can be written.
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / urdf.name
            # ... where it reads mesh names, absolute ones too, relative to the URDF.
            copy.write_text(ET.tostring(self.description.tree(Path(scratch)), encoding="unicode"))
            try:
                self.planner = mplib.Planner(
                    urdf=str(copy), srdf=str(self.description.srdf), move_group=self.config.move_group, new_package_keyword=""
                )
            except (RuntimeError, ValueError, AssertionError) as error:
                raise MagicError(
                    Code.BAD_REQUEST, f"robot {urdf}", str(error).splitlines()[0], "a URDF and SRDF that MPlib reads"
                ) from error
        self.world = self.planner.planning_world
        self.count = self.chain.count
        self.home = np.array(self.config.home, dtype=float)
        #: What motions are timed by: the shares of the arm's limits that are used.
        self.limits = Limits(
            velocity * self.config.velocity_scale,
            self.description.acceleration * self.config.acceleration_scale,
            self.description.jerk * self.config.jerk_scale,
            self.description.braking.velocities if self.description.braking is not None else None,
        )
        names = self.planner.user_joint_names
        if list(names[: self.count]) != list(self.chain.names):
            raise MagicError(Code.BAD_REQUEST, "joints of the URDF", list(names), f"the arm's joints first: {list(self.chain.names)}")
        self.fingers = names[self.count :]
        self.link = self.planner.link_name_2_idx[self.config.move_group]
        self.hand: dict[str, Mesh] = {}
        self._read_hand()
        self._attached = Attached()
        self._library: tuple[cKDTree, NDArray[np.float64]] | None = None

    # ------------------------------------------------------------ the gripper

    @property
    def closing(self) -> NDArray[np.float64]:
        """(3,): the axis along which the fingers close, in the frame of the move group."""
        return np.eye(3)["xy".index(self.config.closing_axis)]

    def _finger_positions(self, width: float) -> NDArray[np.float64]:
        robot = self.description
        by_name = {joint.name: position for joint, position in zip(robot.fingers, robot.finger_positions(width), strict=True)}
        return np.array([by_name[name] for name in self.fingers])

    def open_to(self, width: float) -> None:
        """Set the distance between the fingers in the collision world."""
        self.planner.robot.set_qpos(np.concatenate([self.home, self._finger_positions(width)]), True)

    def _read_hand(self) -> None:
        """Convex hulls, in the frame of the move group and with open fingers, of the links that ride on the last joint."""
        self.open_to(self.config.opening)
        tip_from_base = transforms.inverse(self.chain.forward(self.home))
        shapes = {o.name: o.shapes for o in self.planner.robot.get_fcl_model().get_collision_objects()}
        before = {name: [s.pose.to_transformation_matrix() for s in found] for name, found in shapes.items()}
        moved = self.home + np.where(np.arange(self.count) == self.count - 1, -0.3, 0.0)
        self.planner.robot.set_qpos(np.concatenate([moved, self._finger_positions(self.config.opening)]), True)
        after_from_base = transforms.inverse(self.chain.forward(moved))
        for name, found in shapes.items():
            local = [tip_from_base @ pose for pose in before[name]]
            again = [after_from_base @ s.pose.to_transformation_matrix() for s in found]
            if local and all(np.allclose(a, b, atol=1e-6) for a, b in zip(local, again, strict=True)):
                points = [transforms.apply(pose, _shape_points(s.get_collision_geometry())) for pose, s in zip(local, found, strict=True)]
                self.hand[name] = Mesh(*hull(np.concatenate(points)))
        self.open_to(self.config.opening)
        if not self.hand:
            raise MagicError(
                Code.BAD_REQUEST, "gripper of the URDF", "no collision shape moves with the last joint", "a hand with collision geometry"
            )
        #: How far the fingertips reach beyond the tip frame's origin, metres.
        self.tip_reach = float(max(m.vertices[:, 2].max() for m in self.hand.values()))
        across = "xy".index(self.config.closing_axis)
        depth = {name: m.vertices[:, 2].max() for name, m in self.hand.items()}
        deepest = max(depth.values())
        #: Links that touch what is held: those that reach as deep as the fingertips.
        self.finger_links = tuple(
            n for n, d in depth.items() if d > deepest - 0.005 and abs(self.hand[n].vertices[:, across].mean()) > 1e-3
        )

    @property
    def pad_half_width(self) -> float:
        """Half the breadth of a finger across the closing and the approach direction, metres."""
        across = 1 - "xy".index(self.config.closing_axis)
        links = self.finger_links or tuple(self.hand)
        return min(float(np.abs(self.hand[name].vertices[:, across]).max()) for name in links)

    def hand_body(self) -> Body:
        """The open hand as one body in the frame of the move group."""
        return Body("hand", self.hand.values())

    # ------------------------------------------------------------ the world

    def clear(self) -> None:
        """Take everything out of the collision world but the arm."""
        if self._attached.name:
            self.world.detach_object(self._attached.name, also_remove=True)
            self._attached = Attached()
        for name in list(self.world.get_object_names()):
            self.world.remove_object(name)
        self.planner.acm.clear()

    def add(self, name: str, shapes: Iterable[Any], world_from_object: NDArray[np.float64]) -> None:
        """Put an object of FCL shapes (:func:`magic_planner.collision.shell`) into the world, or put it elsewhere."""
        from mplib.collision_detection import fcl

        if self.world.has_object(name):
            self.world.remove_object(name)
        solids = [fcl.CollisionObject(shape) for shape in shapes]
        self.world.add_object(fcl.FCLObject(name, fcl_pose(world_from_object), solids, [fcl_pose(np.eye(4))] * len(solids)))

    def add_table(self, plane: NDArray[np.float64], name: str = "table", gap: float = TABLE_GAP) -> None:
        """Put the table in as a slab 0.2 m thick whose top lies ``gap`` below the plane (4,); what of the arm never moves may touch it."""
        from mplib.collision_detection import fcl

        normal = plane[:3]
        pose = transforms.frame(-normal * (plane[3] + gap + 0.1), np.cross([0.0, 1.0, 0.0], normal), normal)
        if self.world.has_object(name):
            self.world.remove_object(name)
        self.world.add_object(fcl.FCLObject(name, fcl_pose(pose), [fcl.CollisionObject(fcl.Box(4.0, 4.0, 0.2))], [fcl_pose(np.eye(4))]))
        self.allow(name, *self.description.foot)

    def add_cloud(self, name: str, points: NDArray[np.float64], resolution: float) -> None:
        """Put a point cloud (N, 3), world metres, into the world as an octree with voxels of edge ``resolution``."""
        if self.world.has_object(name):
            self.world.remove_object(name)
        if len(points):
            self.world.add_point_cloud(name, np.ascontiguousarray(points, dtype=float), resolution)

    def allow(self, first: str, *others: str, allowed: bool = True) -> None:
        """Let two things touch, or forbid it again."""
        for other in others:
            if allowed:
                self.planner.acm.set_entry(first, other, True)
            elif self.planner.acm.has_entry(first, other):
                self.planner.acm.remove_entry(first, other)

    def attach(self, name: str, shapes: Iterable[Any], tip_from_object: NDArray[np.float64], touching: Sequence[str]) -> None:
        """Take an object of FCL shapes into the hand; ``touching`` are the links that may touch it."""
        self.detach()
        self.add(name, shapes, np.eye(4))
        self.world.attach_object(name, self.planner.robot.get_name(), self.link, fcl_pose(tip_from_object), list(touching))
        self._attached = Attached(name, tuple(touching))

    def detach(self) -> None:
        """Let go of what is in the hand and take it out of the world."""
        if self._attached.name:
            self.world.detach_object(self._attached.name, also_remove=True)
            if self.world.has_object(self._attached.name):
                self.world.remove_object(self._attached.name)
            self._attached = Attached()

    def collides(self, q: NDArray[np.float64]) -> bool:
        """Whether the arm at q (J,), with what it holds, touches itself or anything."""
        self.world.set_qpos_all(q)
        return bool(self.world.is_state_colliding())

    def collision(self, q: NDArray[np.float64]) -> Collision | None:
        """The first pair that touches at q (J,)."""
        self.world.set_qpos_all(q)
        if not self.world.is_state_colliding():
            return None
        found = self.world.check_collision()
        if not found:
            return Collision("the arm", "something")
        return Collision(found[0].link_name1 or found[0].object_name1, found[0].link_name2 or found[0].object_name2)

    def free(self, rows: NDArray[np.float64], budget: Budget, stage: str) -> bool:
        """Whether the arm touches nothing at any of the rows (N, J)."""
        for n, index in enumerate(coarse_to_fine(range(len(rows)))):
            if n % 16 == 0:
                budget.check(stage)
            if self.collides(rows[index]):
                return False
        return True

    def first_collision(self, path: NDArray[np.float64], budget: Budget | None = None, stage: str = "") -> tuple[int, Collision] | None:
        """Index of the first row of a path (N, J) before which the arm touches something, and the pair.

        Rows are joined by straight lines, checked every :data:`CHECKED` rad.
        """
        for i, q in enumerate(path):
            if budget is not None and i % 16 == 0:
                budget.check(stage)
            between = [q]
            if i:
                parts = max(1, int(np.ceil(np.abs(q - path[i - 1]).max() / CHECKED)))
                between = [path[i - 1] + (q - path[i - 1]) * n / parts for n in range(1, parts + 1)]
            for point in between:
                if self.collides(point):
                    return i, self.collision(point) or Collision("the arm", "something")
        return None

    # ------------------------------------------------------------ inverse kinematics

    def _seed_library(self) -> tuple[cKDTree, NDArray[np.float64]]:
        """Joint positions free of self-collision that lie all over the workspace, to start the inverse kinematics from."""
        if self._library is None:
            rng = np.random.default_rng(20)
            lower, upper = self.chain.lower, self.chain.upper
            margin = 0.05 * (upper - lower)
            q = rng.uniform(lower + margin, upper - margin, (SEEDS, self.count))
            tips = self.chain.forward(q)
            useful = (tips[:, 2, 3] > -0.1) & (tips[:, 2, 2] < 0.7)
            q, tips = q[useful], tips[useful]
            free = []
            for row in q:
                self.world.set_qpos_all(row)
                free.append(not self.world.check_self_collision())
            q, tips = q[free], tips[free]
            self._library = (cKDTree(self._features(tips)), q)
        return self._library

    @staticmethod
    def _features(tips: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([tips[:, :3, 3] * 4.0, tips[:, :3, 2], tips[:, :3, 0] * 0.7], axis=1)

    def warm_up(self) -> None:
        """Build what the first request would otherwise wait for."""
        self.clear()
        self._seed_library()
        self.inverse(np.repeat(self.chain.forward(self.home)[None], 4, axis=0))

    def inverse(
        self, targets: NDArray[np.float64], starts: NDArray[np.float64] | None = None, seeds: int = 12
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """All solutions found for poses (N, 4, 4): index of the pose (S,) and joint positions (S, J), near duplicates left out.

        starts (M, J): further configurations to start from, for every pose.
        """
        tree, library = self._seed_library()
        seeds = min(seeds, len(library))
        near = library[np.atleast_2d(tree.query(self._features(targets), k=seeds)[1].reshape(len(targets), seeds))]
        if starts is not None and len(starts):
            near = np.concatenate(
                [near, np.broadcast_to(np.atleast_2d(starts)[None], (len(targets), *np.atleast_2d(starts).shape))], axis=1
            )
        each = near.shape[1]
        q, solved = self.chain.solve(np.repeat(targets, each, axis=0), near.reshape(-1, self.count), iterations=25)
        inside = np.minimum(q - self.chain.lower, self.chain.upper - q).min(axis=1) > FROM_LIMIT
        index = np.repeat(np.arange(len(targets)), each)
        keep_index: list[int] = []
        keep_q: list[NDArray[np.float64]] = []
        for i in range(len(targets)):
            mine: list[NDArray[np.float64]] = []
            for row in q[(index == i) & solved & inside]:
                if all(np.abs(row - other).max() > 0.15 for other in mine):
                    mine.append(row)
            keep_index += [i] * len(mine)
            keep_q += mine
        return np.array(keep_index, dtype=int), np.array(keep_q).reshape(-1, self.count)


def coarse_to_fine(indices: Iterable[int]) -> list[int]:
    """The same indices, spread over their whole range from the first on: what fails somewhere is found soon."""
    found = list(indices)
    bits = max(1, len(found).bit_length())
    return [found[n] for n in sorted(range(len(found)), key=lambda n: int(f"{n:0{bits}b}"[::-1], 2))]


def _shape_points(geometry: Any) -> NDArray[np.float64]:
    """Points (N, 3) whose convex hull holds an FCL shape."""
    kind = type(geometry).__name__
    if hasattr(geometry, "get_vertices"):
        return np.asarray(geometry.get_vertices(), dtype=float).reshape(-1, 3)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    if kind == "Box":
        return corners * np.asarray(geometry.side, dtype=float).reshape(3) / 2
    if kind == "Sphere":
        return corners * float(geometry.radius)
    if kind in ("Capsule", "Cylinder", "Cone"):
        radius, length = float(geometry.radius), float(geometry.lz)
        return corners * [radius, radius, length / 2 + (radius if kind == "Capsule" else 0.0)]
    raise MagicError(Code.BAD_REQUEST, "collision shape of the hand", kind, ("mesh", "Box", "Sphere", "Capsule", "Cylinder"))
