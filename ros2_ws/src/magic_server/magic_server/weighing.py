"""What the tool in the hand weighs, by the torques that the arm's joints bear.  No ROS here.

An arm at rest bears what its own links weigh, by its URDF, and what it holds.  It is read with the empty hand before the
fingers close, and with the tool after the lift: what its own weights are taken to be wrongly is nearly the same in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.robot import Description, Joint

Array = NDArray[np.float64]
#: Of the base frame, whose z is up, m/s^2.
GRAVITY = np.array([0.0, 0.0, -9.81])
#: Of what the weights of the links change from one pose to another so large a share is not known.
MODEL = 0.05
#: The hand bears something, or the torques are not those of this arm, where it seems to hold more than this before it has closed, kg.
EMPTY = 0.5
#: Torques that differ from those of any load by more than so many standard errors, in the mean of the joints, are no load's.
FITS = 3.0
#: Rollouts draw densities within this factor, nine of ten times (``tool_density`` of the verifier's ``uncertainty.yaml``).
DRAWN = 1.4


@dataclass(frozen=True)
class Reading:
    """An arm at rest: positions of all joints by name, rad (m), and what each of the arm's bears, (J,) Nm (N)."""

    positions: Mapping[str, float]
    torques: Array


@dataclass(frozen=True)
class Weight:
    """Mass and its standard error, kg."""

    mass: float
    error: float

    @property
    def least(self) -> float:
        """What it weighs at least, by two standard errors."""
        return self.mass - 2 * self.error

    def differs(self, taken: float) -> bool:
        """Whether there is something that certainly is beyond what rollouts draw about a mass that was taken, kg."""
        return self.least > DRAWN * taken or (self.least > 0 and self.mass + 2 * self.error < taken / DRAWN)

    def __str__(self) -> str:
        return f"{1000 * self.mass:.0f} g (within {2000 * self.error:.0f} g)"


def own_torques(robot: Description, positions: Mapping[str, float]) -> Array:
    """(J,): what the arm's joints bear of the links beyond them at rest, Nm (N); positions by name."""
    poses = robot.poses(positions)
    result = np.zeros(len(robot.arm))
    for j, joint in enumerate(robot.arm):
        for link in robot.beyond(joint.child):
            mass, centre = robot.masses.get(link, (0.0, np.zeros(3)))
            if mass > 0:
                result[j] += mass * _unit(poses, joint, poses[link][:3, :3] @ centre + poses[link][:3, 3])
    return result


def load_torques(robot: Description, positions: Mapping[str, float], centre: Array) -> Array:
    """(J,): what the arm's joints bear of 1 kg at ``centre`` (3,), m in the frame of the link between the fingertips, Nm (N)."""
    poses = robot.poses(positions)
    tip = poses[robot.config.move_group]
    point = tip[:3, :3] @ centre + tip[:3, 3]
    return np.array([_unit(poses, joint, point) for joint in robot.arm])


def _unit(poses: Mapping[str, Array], joint: Joint, point: Array) -> float:
    """What a joint bears of 1 kg at a point (3,) of the base frame, Nm (N)."""
    frame = poses[joint.child]
    bears = GRAVITY if joint.sliding else np.cross(point - frame[:3, 3], GRAVITY)
    return -float(frame[:3, :3] @ joint.axis @ bears)


def weighed(robot: Description, error: float, empty: Reading, loaded: Reading, centre: Array) -> Weight:
    """What an arm has taken up whose middle is at ``centre`` (3,), m in the frame of the link between the fingertips.

    ``error``: to which each joint repeats its torque, Nm (N).  Raises BAD_REQUEST where the torques tell no weight: not told, not those of
    this arm, or of a hand that bore something before.
    """
    for reading in (empty, loaded):
        if not np.all(np.isfinite(reading.torques)):
            raise MagicError(Code.BAD_REQUEST, "effort of joint_states", "not told", "the torque of each of the arm's joints")
    before = empty.torques - own_torques(robot, empty.positions)
    unit = load_torques(robot, empty.positions, np.zeros(3))
    bore = float(unit @ before / (unit @ unit))
    if not abs(bore) <= EMPTY:
        raise MagicError(
            Code.BAD_REQUEST, "kg that the arm seems to hold before the fingers close", round(bore, 2), f"at most {EMPTY:g}; see its URDF"
        )
    own = own_torques(robot, loaded.positions)
    more = loaded.torques - own - before
    unit = load_torques(robot, loaded.positions, centre)
    errors = np.hypot(math.sqrt(2) * error, MODEL * (own - own_torques(robot, empty.positions)))
    unit, more = unit / errors, more / errors
    mass = float(unit @ more / (unit @ unit))
    off = float(np.sqrt(np.mean((more - mass * unit) ** 2)))
    if not off <= FITS:
        raise MagicError(
            Code.BAD_REQUEST, "torques of the arm, from those of a load, in standard errors", round(off, 1), f"at most {FITS:g}"
        )
    return Weight(mass, float(1 / np.sqrt(unit @ unit)))
