"""A serial arm read from its URDF: forward kinematics, Jacobian, gravity torques and inverse kinematics of many configurations at once.

Everything is vectorised over N configurations, because the planner asks about
hundreds of them: every grasp it considers, from many starting points, over the
whole motion.  With q the joint positions, x the tip's pose and J its Jacobian,
one step of the inverse kinematics is the damped least-squares step

    dq = J^T (J J^T + lambda^2 I)^-1 e  +  (I - J^T (J J^T + lambda^2 I)^-1 J) dq_0

with e the pose error (3 metres, 3 radians) and dq_0 a pull to the middle of the
joint ranges, which acts in the redundancy only.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError

Array = NDArray[np.float64]
GRAVITY = np.array([0.0, 0.0, -9.81])
#: Of a step towards a pose: damped least squares, and no joint goes farther (rad).
DAMPING = 1e-2
LARGEST_STEP = 0.4
#: A branch that comes nearer to a joint's limit than this (rad) ends there.
MARGIN = 0.01
#: Each pose of a path is followed in so many steps, the first of which goes this share of the way to the middle of the ranges.
ITERATIONS = 6
PULL = 0.02


@dataclass(frozen=True)
class Chain:
    """Joints from the base link to the tip link, as the URDF gives them.

    names, lower, upper (rad or m), velocity, effort: (J,) of the moving joints.
    Each joint's transform is a + f(q) b + g(q) c with constant (4, 4) matrices, f = sin q and
    g = 1 - cos q (revolute), f = q and g = 0 (prismatic).  masses (M,) kg, and for each
    the joint that carries it and its centre (M, 3) in that joint's moving frame.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    velocity: Array
    effort: Array
    prismatic: NDArray[np.bool_]
    axes: Array
    a: Array
    b: Array
    c: Array
    last_from_tip: Array
    base_link: str
    tip_link: str
    masses: Array
    mass_joint: NDArray[np.int64]
    mass_centre: Array

    @property
    def count(self) -> int:
        """Number of moving joints J."""
        return len(self.names)

    @property
    def middle(self) -> Array:
        """(J,): the middle of each joint's range."""
        return (self.lower + self.upper) / 2

    @property
    def reach(self) -> float:
        """Metres that no tip position can exceed from the base frame's origin."""
        lengths = np.linalg.norm(self.a[:, :3, 3], axis=1).sum() + np.linalg.norm(self.last_from_tip[:3, 3])
        return float(lengths + np.where(self.prismatic, np.maximum(np.abs(self.lower), np.abs(self.upper)), 0).sum())

    def frames(self, q: Array) -> tuple[Array, Array]:
        """Moving frames of the joints (N, J, 4, 4) and the tip (N, 4, 4) in the base frame, for q (N, J)."""
        f = np.where(self.prismatic, q, np.sin(q))[:, :, None, None]
        g = np.where(self.prismatic, 0.0, 1 - np.cos(q))[:, :, None, None]
        step = self.a + f * self.b + g * self.c
        frames = np.empty_like(step)
        frames[:, 0] = step[:, 0]
        for j in range(1, self.count):
            np.matmul(frames[:, j - 1], step[:, j], out=frames[:, j])
        return frames, frames[:, -1] @ self.last_from_tip

    def forward(self, q: Array) -> Array:
        """Pose of the tip in the base frame: (4, 4) for q (J,), (N, 4, 4) for q (N, J)."""
        q = np.asarray(q, dtype=float)
        tip = self.frames(np.atleast_2d(q))[1]
        return tip[0] if q.ndim == 1 else tip

    def jacobian(self, frames: Array, tip: Array) -> Array:
        """(N, 6, J): velocity of the tip's origin, then angular velocity, in base axes, for each joint."""
        axes = np.einsum("njik,jk->nji", frames[:, :, :3, :3], self.axes)
        arm = tip[:, None, :3, 3] - frames[:, :, :3, 3]
        turning = ~self.prismatic[None, :, None]
        linear = np.where(turning, np.cross(axes, arm), axes)
        return np.concatenate([linear, np.where(turning, axes, 0.0)], axis=2).transpose(0, 2, 1)

    def gravity_torques(self, q: Array, payload: float = 0.0, payload_centre: Array | None = None) -> Array:
        """Torques (N, J) in N m (N for prismatic joints) that hold the arm still at q (N, J).

        payload: kg in the hand, its centre (3,) in the tip frame.
        """
        frames, tip = self.frames(np.atleast_2d(q))
        axes = np.einsum("njik,jk->nji", frames[:, :, :3, :3], self.axes)
        points = [
            np.einsum("nij,j->ni", frames[:, j, :3, :3], centre) + frames[:, j, :3, 3]
            for j, centre in zip(self.mass_joint, self.mass_centre, strict=True)
        ]
        loads = [(j, point, mass * GRAVITY) for j, point, mass in zip(self.mass_joint, points, self.masses, strict=True)]
        if payload:
            centre = np.zeros(3) if payload_centre is None else np.asarray(payload_centre)
            loads.append((self.count - 1, np.einsum("nij,j->ni", tip[:, :3, :3], centre) + tip[:, :3, 3], payload * GRAVITY))
        torques = np.zeros((len(tip), self.count))
        for last, point, weight in loads:
            for j in range(last + 1):
                lever = weight if self.prismatic[j] else np.cross(point - frames[:, j, :3, 3], weight)
                torques[:, j] -= np.einsum("ni,ni->n", axes[:, j], np.broadcast_to(lever, axes[:, j].shape))
        return torques

    def solve(
        self, targets: Array, q: Array, iterations: int = 60, position: float = 1e-4, angle: float = 5e-4, pull: float = 0.0
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Inverse kinematics of N problems: base_from_tip targets (N, 4, 4) from starts q (N, J).

        Returns q (N, J) within the joint limits and whether each converged to ``position`` metres and
        ``angle`` radians.  ``pull`` is the share of the way to the middle of the ranges taken in the redundancy at each step.
        """
        q = np.clip(q, self.lower, self.upper)
        solved = np.zeros(len(q), dtype=bool)
        active = np.arange(len(q))
        for _ in range(iterations):
            frames, tip = self.frames(q[active])
            error = pose_error(targets[active], tip)
            good = (np.linalg.norm(error[:, :3], axis=1) < position) & (np.linalg.norm(error[:, 3:], axis=1) < angle)
            solved[active[good]] = True
            if good.any():
                keep = ~good
                active, frames, tip, error = active[keep], frames[keep], tip[keep], error[keep]
            if not len(active):
                break
            q[active] = np.clip(q[active] + self._step(q[active], self.jacobian(frames, tip), error, pull), self.lower, self.upper)
        return q, solved

    def _step(self, q: Array, jacobian: Array, error: Array, pull: float) -> Array:
        # Long errors are shortened: far from the goal the linear model holds for a short way only.
        size = np.linalg.norm(error, axis=1, keepdims=True)
        error = error * np.minimum(1.0, 0.5 / np.maximum(size, 1e-12))
        # The damping fades with the error, so that the last steps are Newton's.
        squared = (DAMPING * np.minimum(1.0, 4 * size[:, 0])) ** 2 + 1e-8
        transposed = jacobian.transpose(0, 2, 1)
        gram = jacobian @ transposed + squared[:, None, None] * np.eye(6)
        if pull:
            rest = pull * (self.middle - q)
            both = np.linalg.solve(gram, np.stack([error, np.einsum("nij,nj->ni", jacobian, rest)], axis=2))
            step = np.einsum("nij,ni->nj", jacobian, both[:, :, 0] - both[:, :, 1]) + rest
        else:
            step = np.einsum("nij,ni->nj", jacobian, np.linalg.solve(gram, error[:, :, None])[:, :, 0])
        longest = np.abs(step).max(axis=1, keepdims=True)
        return step * np.minimum(1.0, LARGEST_STEP / np.maximum(longest, 1e-12))

    def track(self, targets: Array, q: Array, jump: float = 0.35) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """Follow K poses with N branches at once, each step from the one before.

        targets (K, N, 4, 4) base_from_tip; q (N, J) solves the first pose.  Returns the paths (K, N, J),
        the index of the first pose that a branch could not follow (N,) (K: all followed), and what
        stopped it (N,): the joint at its limit, -1 the pose out of reach, -2 a jump of more than ``jump`` rad.
        """
        steps, branches = targets.shape[:2]
        paths = np.zeros((steps, branches, self.count))
        paths[0] = q
        stopped = np.full(branches, steps)
        reason = np.full(branches, -1)
        alive = np.arange(branches)
        for k in range(1, steps):
            if not len(alive):
                break
            before = paths[k - 1, alive]
            now = before + (before - paths[k - 2, alive]) * 0.8 if k > 1 else before.copy()
            now = np.clip(now, self.lower, self.upper)
            goal = targets[k, alive]
            for n in range(ITERATIONS):
                frames, tip = self.frames(now)
                error = pose_error(goal, tip)
                good = (np.linalg.norm(error[:, :3], axis=1) < 1e-4) & (np.linalg.norm(error[:, 3:], axis=1) < 5e-4)
                if n and good.all():
                    break
                move = self._step(now, self.jacobian(frames, tip), error, PULL if n == 0 else 0.0)
                now = np.clip(now + move, self.lower, self.upper)
            else:
                error = pose_error(goal, self.frames(now)[1])
            missed = (np.linalg.norm(error[:, :3], axis=1) > 2e-4) | (np.linalg.norm(error[:, 3:], axis=1) > 1e-3)
            jumped = np.abs(now - before).max(axis=1) > jump
            slack = np.minimum(now - self.lower, self.upper - now)
            tight = slack.min(axis=1) < MARGIN
            paths[k, alive] = now
            bad = missed | jumped | tight
            stopped[alive[bad]] = k
            reason[alive[bad]] = np.where(tight[bad], slack[bad].argmin(axis=1), np.where(jumped[bad], -2, -1))
            alive = alive[~bad]
        return paths, stopped, reason


def pose_error(targets: Array, tips: Array) -> Array:
    """(N, 6): translation, then rotation vector in base axes, that carries each tip onto its target."""
    relative = targets[:, :3, :3] @ tips[:, :3, :3].transpose(0, 2, 1)
    axis = 0.5 * np.stack(
        [relative[:, 2, 1] - relative[:, 1, 2], relative[:, 0, 2] - relative[:, 2, 0], relative[:, 1, 0] - relative[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, (np.trace(relative, axis1=1, axis2=2) - 1) / 2)
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)
    turn = axis * scale[:, None]
    half = (sine < 1e-6) & (angle > 1.0)
    if half.any():  # exactly half a turn: the sine says nothing about the axis
        turn[half] = Rotation.from_matrix(relative[half]).as_rotvec()
    return np.concatenate([targets[:, :3, 3] - tips[:, :3, 3], turn], axis=1)


def _numbers(text: str | None, default: str) -> Array:
    return np.array([float(v) for v in (text or default).split()])


def _origin(element: ElementTree.Element | None) -> Array:
    if element is None:
        return np.eye(4)
    return transforms.from_rpy(*_numbers(element.get("rpy"), "0 0 0"), _numbers(element.get("xyz"), "0 0 0"))


def _bound(limit: ElementTree.Element | None, key: str, default: float) -> float:
    return float(limit.get(key, default)) if limit is not None else default


def load_chain(urdf: str | Path, tip: str, base: str | None = None) -> Chain:
    """The chain of a URDF from its root (or ``base``) to the link ``tip``; BAD_REQUEST where the file or link is not there."""
    path = Path(urdf)
    try:
        root = ElementTree.fromstring(path.read_text())
        return _chain(root, tip, base)
    except (OSError, ElementTree.ParseError, ValueError, TypeError) as error:
        raise MagicError(Code.BAD_REQUEST, f"URDF {path}", f"{type(error).__name__}: {error}", "a readable URDF of a serial arm") from error


def _chain(root: ElementTree.Element, tip: str, base: str | None) -> Chain:
    links = {link.get("name"): link for link in root.findall("link")}
    by_child = {_end(joint, "child"): joint for joint in root.findall("joint")}
    if tip not in links:
        raise MagicError(Code.BAD_REQUEST, "tip link", tip, list(links))
    joints, base_link = _joints_to(tip, base, by_child)
    moving, last_from_tip, carried = _along(joints)
    if not moving:
        raise MagicError(Code.BAD_REQUEST, "tip link", tip, "a link that at least one joint moves")
    masses, mass_joint, mass_centre = _masses(links, _with_branches(carried, by_child))
    return Chain(
        names=tuple(joint.name for joint in moving),
        a=np.stack([joint.a for joint in moving]),
        b=np.stack([joint.b for joint in moving]),
        c=np.stack([joint.c for joint in moving]),
        axes=np.stack([joint.axis for joint in moving]),
        prismatic=np.array([joint.prismatic for joint in moving], dtype=bool),
        lower=np.array([joint.lower for joint in moving], dtype=float),
        upper=np.array([joint.upper for joint in moving], dtype=float),
        velocity=np.array([joint.velocity for joint in moving], dtype=float),
        effort=np.array([joint.effort for joint in moving], dtype=float),
        last_from_tip=last_from_tip,
        base_link=base_link,
        tip_link=tip,
        masses=masses,
        mass_joint=mass_joint,
        mass_centre=mass_centre,
    )


class _Joint(NamedTuple):
    """One moving joint of a :class:`Chain`, which says what its fields are."""

    name: str
    a: Array
    b: Array
    c: Array
    axis: Array
    prismatic: bool
    lower: float
    upper: float
    velocity: float
    effort: float


#: By link: the index of the moving joint that carries it (-1: none does), and its pose (4, 4) in that joint's moving frame.
_Carried = dict[str, tuple[int, Array]]


def _end(joint: ElementTree.Element, which: str) -> str:
    """The link at the ``parent`` or ``child`` end of a joint."""
    return joint.find(which).get("link")  # type: ignore[union-attr,return-value]


def _joints_to(tip: str, base: str | None, by_child: dict[str, ElementTree.Element]) -> tuple[list[ElementTree.Element], str]:
    """The joints that lead to a link from ``base``, or from the root, and the link at which they begin."""
    joints: list[ElementTree.Element] = []
    link = tip
    while link in by_child and link != base:
        joints.insert(0, by_child[link])
        link = _end(by_child[link], "parent")
    return joints, link


def _along(joints: list[ElementTree.Element]) -> tuple[list[_Joint], Array, _Carried]:
    """The moving ones of joints in a row, the pose (4, 4) of the last link in the last of these, and what carries each link."""
    moving: list[_Joint] = []
    carried: _Carried = {}
    fixed = np.eye(4)  # in the frame of the last moving joint
    for joint in joints:
        fixed = fixed @ _origin(joint.find("origin"))
        if joint.get("type") in ("revolute", "continuous", "prismatic"):
            moving.append(_moving(joint, fixed))
            fixed = np.eye(4)
        carried[_end(joint, "child")] = (len(moving) - 1, fixed.copy())
    return moving, fixed, carried


def _moving(joint: ElementTree.Element, a: Array) -> _Joint:
    """A moving joint whose frame at zero is ``a`` (4, 4) in that of the moving joint before it."""
    kind, axis, limit = joint.get("type"), joint.find("axis"), joint.find("limit")
    direction = transforms.unit(_numbers(axis.get("xyz") if axis is not None else None, "1 0 0"))
    b, c = np.zeros((4, 4)), np.zeros((4, 4))
    if kind == "prismatic":
        b[:3, 3] = direction
        b = a @ b
    else:
        cross = np.zeros((4, 4))
        cross[:3, :3] = np.cross(np.eye(3), direction)
        b, c = a @ cross, a @ cross @ cross
    low, high = -2 * np.pi, 2 * np.pi
    if kind != "continuous":
        low, high = _bound(limit, "lower", low), _bound(limit, "upper", high)
    most = _bound(limit, "velocity", 1.0), _bound(limit, "effort", np.inf)
    return _Joint(joint.get("name"), a, b, c, direction, kind == "prismatic", low, high, *most)  # type: ignore[arg-type]


def _with_branches(carried: _Carried, by_child: dict[str, ElementTree.Element]) -> _Carried:
    """What the chain carries with all that hangs on it without being part of it (the fingers), whose joints count as at zero."""
    carried = dict(carried)
    grown = True
    while grown:
        grown = False
        for child, joint in by_child.items():
            parent = _end(joint, "parent")
            if child not in carried and parent in carried:
                index, frame = carried[parent]
                carried[child] = (index, frame @ _origin(joint.find("origin")))
                grown = True
    return carried


def _masses(links: dict[str | None, ElementTree.Element], carried: _Carried) -> tuple[Array, NDArray[np.int64], Array]:
    """masses (M,), mass_joint (M,) and mass_centre (M, 3) of the links that moving joints carry, as :class:`Chain` has them."""
    masses, joints, centres = [], [], []
    for name, (index, frame) in carried.items():
        inertial = links[name].find("inertial") if name in links else None
        mass = inertial.find("mass") if inertial is not None else None
        if index >= 0 and mass is not None and float(mass.get("value", "0")) > 0:
            masses.append(float(mass.get("value", "0")))
            joints.append(index)
            centres.append((frame @ _origin(inertial.find("origin")))[:3, 3])  # type: ignore[union-attr]
    return np.array(masses, dtype=float), np.array(joints, dtype=int), np.array(centres, dtype=float).reshape(-1, 3)
