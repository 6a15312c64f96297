"""A tool between two finger pads: where they touch it, what they can hold by friction, and the joint that stands for them.

Pads are of rubber and touch over a patch, which holds not only forces but torques as well (soft fingers: Howe and Cutkosky,
"Practical force-motion models for sliding manipulation", 1996).  Rigid hulls touch at some points only, and the solver squeezes a tool
of a few grams out between two fingers that press on it with 60 N.  So the pads close on the tool by the engine's contacts, and
what they have closed on is held by a joint between hand and tool, as stiff as the pads, that gives way plastically where the load is
above what friction holds.  For N newtons of each finger, a coefficient mu, and patches of mean radius r and half extents h:

    force along the pads          2 mu N
    torque about the closing axis 2 mu N r
    torque about the other axes   2 N h      (the pressure moves within the patches)

and the tool slips where the root of the sum of the squared shares of these exceeds one (an ellipsoidal limit surface).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from magic_core import transforms
from magic_verifier.simulation import Touch, engine, to_pose

Array = NDArray[np.float64]
#: Rubber gives way by this (m) under the grip, so that a ball or an edge is touched over a patch of at least this half extent (m): a ball
#: of 10 mm radius pressed with 60 N into rubber of 4 MPa (Hertz: (3 F R / 4 E)^(1/3) = 4.8 mm, the mean distance of a disc's points
#: from its middle 2/3 of that).
SOFTNESS, LEAST = 0.001, 0.003
#: Shear stiffness (N/m) of two pads of 18 mm square and 1.5 mm thick, of rubber with a shear modulus of 1 MPa: 2 G A / t.  Across the
#: pads they are stiffer still.  Their damping time (s).
STIFFNESS, RELAXATION = 4e5, 0.005
#: Along the pads the fingers give way as well (N/m; s), 2 mm at what pads hold.  Pads that alone did would be read wrongly: the engine
#: gives a whole step's weight to a tool at the step's beginning, which leaves the grip of a long light one displaced at its end by more
#: than its load makes.  It was 0.73 of what pads hold of a spoon of 50 g that asks for 0.29 of it, and is 0.36.
SHEAR, SHEAR_RELAXATION = 5e4, 0.01


@dataclass(frozen=True)
class Patch:
    """Where two pads touch: tcp_from_patch (4, 4), x the closing axis, y across the fingers, z along them; radius: mean distance of what
    is touched from its middle, m; half (2,): half extents along y and z, m.  The smaller of the two pads'."""

    tcp_from_patch: Array
    radius: float
    half: tuple[float, float]

    def holds(self, force: float, friction: float) -> Array:
        """(6,): the largest force along x, y, z (N) and torque about them (Nm); along x the fingers' mechanism holds."""
        shear = 2 * friction * force
        # A torque about y moves the pressure along z, and the other way round.
        return np.array([np.inf, shear, shear, shear * self.radius, 2 * force * self.half[1], 2 * force * self.half[0]])


def patch_of(touches: list[Touch], world_from_tcp: Array, closing: int, friction: float) -> Patch | None:
    """The patch of pads that touch at these points (normals towards the tool); ``None`` where not both of them do, or where one
    pushes aside what it touches: a normal, or the line between the two middles, further from the closing axis (0 or 1: the tip
    frame's) than friction holds."""
    tcp_from_world = transforms.inverse(world_from_tcp)
    points = np.array([tcp_from_world[:3, :3] @ touch.position + tcp_from_world[:3, 3] for touch in touches]).reshape(-1, 3)
    normals = np.array([tcp_from_world[:3, :3] @ touch.normal for touch in touches]).reshape(-1, 3)
    within = np.cos(np.arctan(max(friction, 0.05)))
    found = []
    for side in (1.0, -1.0):
        # The finger on the positive side pushes the tool towards the negative one.
        towards = -side * np.eye(3)[closing]
        mine = normals @ towards >= within
        if not mine.any():
            mine = _wedged(normals, towards, within)
        if not mine.any():
            return None
        found.append(points[mine])
    flat = [1 - closing, 2]
    middles = [(p.min(axis=0) + p.max(axis=0)) / 2 for p in found]
    halves = [np.maximum(np.ptp(p[:, flat], axis=0) / 2, LEAST) for p in found]
    apart = np.abs(middles[0] - middles[1])
    # Soft pads hold between all points that both touch.
    beside = np.maximum(apart[flat] - halves[0] - halves[1], 0.0)
    if np.hypot(*beside) > max(friction, 0.05) * apart[closing] + SOFTNESS:
        return None
    half = np.minimum(*halves)
    axes = np.zeros((3, 3))
    axes[closing, 0] = axes[1 - closing, 1] = 1.0
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, (middles[0] + middles[1]) / 2
    # Mean distance from the middle over a rectangle, within 2 % (exact for a square, and for a line).
    radius = float(max(0.5 * half.max() + 0.265 * half.min(), LEAST * 2 / 3))
    return Patch(frame, radius, (float(half[0]), float(half[1])))


def _wedged(normals: Array, towards: Array, within: float) -> NDArray[np.bool_]:
    """Which of the touches of one pad, with these normals (N, 3), press together ``towards`` the other one (3,), no further from it than
    ``within`` (a cosine): the two edges of a pad in a hollow each push aside what they touch, and both hold it.  None where they do not."""
    facing = normals @ towards > 0
    if not facing.any():
        return facing
    shares, off = nnls(normals[facing].T, towards)
    if off**2 > 1 - within**2:
        return np.zeros(len(normals), dtype=bool)
    facing[facing] = shares > 0
    return facing


class Grip:
    """The joint between a link of the hand and the tool that it holds, from the moment at which it is made until :meth:`open`."""

    def __init__(self, hand: Any, hand_from_patch: Array, tool: Any, patch: Patch, force: float, friction: float, timestep: float) -> None:
        """hand, tool: the engine's bodies, the tool's pose that in which it is held; force: N of each finger; timestep of the world, s."""
        self._hand, self._tool = hand, tool
        holds = patch.holds(force, friction)
        levers = np.maximum([patch.radius, max(patch.half), max(patch.half)], LEAST)
        stiffness = np.concatenate([[STIFFNESS, SHEAR, SHEAR], STIFFNESS * levers**2])
        self._shares = (stiffness / holds).tolist()
        self._anchor = to_pose(hand_from_patch)
        self._tool_from_patch = tool.entity_pose.inv() * hand.entity_pose * self._anchor
        self._joint = joint = engine().physx.PhysxDriveComponent(tool)
        joint.parent = hand
        joint.pose_in_parent = self._anchor
        joint.pose_in_child = self._tool_from_patch
        # Across the pads the fingers' mechanism holds, whatever the load.
        limits = [1e6, *holds[1:4].tolist(), float(holds[4:].max())]
        drives = self._drives()
        damping = stiffness * [RELAXATION, SHEAR_RELAXATION, SHEAR_RELAXATION, RELAXATION, RELAXATION, RELAXATION]
        for drive, k, c, limit in zip(drives, stiffness[:5].tolist(), damping[:5].tolist(), limits, strict=True):
            drive(k, c, limit * timestep, "force")  # the engine limits the impulse of a step
        tool.entity.add_component(joint)

    def _drives(self) -> tuple[Any, ...]:
        joint = self._joint
        return (
            joint.set_drive_property_x,
            joint.set_drive_property_y,
            joint.set_drive_property_z,
            joint.set_drive_property_twist,
            joint.set_drive_property_swing,
        )

    def load(self) -> float:
        """The share of what the pads hold that the load is now; where it is above 1 they creep along until it is 1."""
        moved = self._anchor.inv() * self._hand.entity_pose.inv() * self._tool.entity_pose * self._tool_from_patch
        shift, (w, *vector) = moved.p.tolist(), moved.q.tolist()
        # Small turns: a rotation vector is twice the quaternion's vector part.
        turn = [2 * v if w >= 0 else -2 * v for v in vector]
        share = math.hypot(*(s * d for s, d in zip(self._shares, (*shift, *turn), strict=True)))
        if share > 1:
            keep = 1 - 1 / share
            step = transforms.from_rotvec([keep * v for v in turn], [0.0, keep * shift[1], keep * shift[2]])
            self._anchor = self._anchor * to_pose(step)
            self._joint.pose_in_parent = self._anchor
        return share

    def slip(self, moved: Array) -> None:
        """Hold the tool elsewhere, moved (4, 4) in the patch's frame, as if it had slipped so far."""
        self._anchor = self._anchor * to_pose(moved)
        self._joint.pose_in_parent = self._anchor

    def open(self) -> None:
        """The pads let go."""
        for drive in self._drives():
            drive(0.0, 0.0, 0.0, "force")
