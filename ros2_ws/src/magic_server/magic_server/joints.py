"""Where the joints are, as their driver last said.  No ROS here."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import robot
from magic_core.errors import Code, MagicError
from magic_core.joint_history import JointHistory

#: A joint that is faster than this moves, rad/s.
STANDSTILL = 0.05
#: How far beyond its limit a joint may be heard to stand, rad or m: as much as the planner takes.
RANGE = 1e-3
#: Efforts are kept for so many seconds.
KEPT = 1.0


@dataclass(frozen=True)
class Joint:
    """The last that was said of one joint: position rad (or m), velocity rad/s (NaN: not told), ``stamp`` by the clock of the
    driver and ``came`` by the monotonic clock of this process, both in seconds."""

    position: float
    velocity: float
    stamp: float
    came: float


class JointStates:
    """The newest state of every joint, put together from messages that may each tell of some joints only; ``history`` has those before,
    and the efforts of the last second are kept.

    Arm and gripper often come from two drivers on the same topic.
    """

    def __init__(self) -> None:
        self.history = JointHistory()
        self._joints: dict[str, Joint] = {}
        self._efforts: deque[tuple[float, dict[str, float]]] = deque()
        self._lock = threading.Lock()

    def take(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        velocities: Sequence[float],
        stamp: float,
        came: float,
        efforts: Sequence[float] = (),
    ) -> None:
        """Take one message in; one whose positions do not go with its names says nothing."""
        if len(positions) != len(names):
            return
        told = velocities if len(velocities) == len(names) else [math.nan] * len(names)
        with self._lock:
            self._joints.update((n, Joint(float(p), float(v), stamp, came)) for n, p, v in zip(names, positions, told))
            if len(efforts) == len(names):
                self._efforts.append((stamp, dict(zip(names, map(float, efforts)))))
            while self._efforts and self._efforts[0][0] < stamp - KEPT:
                self._efforts.popleft()
        with suppress(MagicError):  # what has no stamp was at no moment
            self.history.take(names, positions, stamp)

    def all(self) -> dict[str, Joint]:
        """Every joint that was heard of, by name."""
        with self._lock:
            return dict(self._joints)

    def efforts(self, names: Sequence[str], since: float) -> NDArray[np.float64]:
        """(J,): the mean effort of each joint in the states from a stamp on, Nm (N); not a number where none tells it."""
        with self._lock:
            told = [efforts for stamp, efforts in self._efforts if stamp >= since]
        found = [[efforts[name] for efforts in told if name in efforts] for name in names]
        return np.array([np.mean(values) if values else math.nan for values in found])


def check_range(arm: Iterable[robot.Joint], joints: Mapping[str, Joint]) -> None:
    """Refuse an arm that stands outside its own limits, where nothing that is planned could begin; raises JOINT_LIMIT."""
    for joint in arm:
        if joint.name in joints and not joint.lower - RANGE <= joints[joint.name].position <= joint.upper + RANGE:
            raise MagicError(
                Code.JOINT_LIMIT,
                f"the arm stands with {joint.name} at",
                round(joints[joint.name].position, 4),
                f"{joint.lower:g} to {joint.upper:g}",
            )


def check_start(
    names: Sequence[str],
    first: Sequence[float],
    joints: Mapping[str, Joint],
    clock: float,
    now: float,
    tolerance: float,
    max_age: float,
    by_stamp: bool = True,
) -> None:
    """Refuse a trajectory whose start is not where the arm stands.

    names, first: joints of the trajectory and their positions at its first point, rad.  joints: what is known of them.
    clock, now: the time, s, by the clock of the stamps and by the monotonic clock.  Raises NO_FRAMES (no joint state),
    STALE_DATA (older than ``max_age`` s by arrival or, with ``by_stamp``, by stamp, or from the future) and BAD_MOTION (a joint
    is missing, not finite, farther than ``tolerance`` rad off, or moving).
    """
    if not names or len(names) != len(first):
        raise MagicError(
            Code.BAD_MOTION, "trajectory", f"{len(names)} joints, {len(first)} positions at its start", "one position for each joint"
        )
    if not joints:
        raise MagicError(Code.NO_FRAMES, "joint_states", "none received", f"one not older than {max_age:g} s")
    missing = [name for name in names if name not in joints]
    if missing:
        raise MagicError(Code.BAD_MOTION, "joint_states", f"nothing about {', '.join(missing)}", f"positions of {', '.join(names)}")
    ages = [now - joints[n].came for n in names] + ([clock - joints[n].stamp for n in names] if by_stamp else [])
    age = max(ages, key=lambda a: math.inf if math.isnan(a) else abs(a))
    if not abs(age) <= max_age:
        raise MagicError(
            Code.STALE_DATA, "age of joint_states in s", round(age, 3), f"at most {max_age:g}, by its stamp and by its arrival"
        )
    gaps = {name: abs(joints[name].position - position) for name, position in zip(names, first)}
    # What is not a number is never within the tolerance.
    wrong = {name: gap for name, gap in gaps.items() if not gap <= tolerance}
    if wrong:
        name = max(wrong, key=lambda n: wrong[n] if math.isfinite(wrong[n]) else math.inf)
        raise MagicError(
            Code.BAD_MOTION,
            "distance of the arm from the trajectory's start in rad",
            f"{wrong[name]:.4f} at {name}",
            f"at most {tolerance:g} at every joint",
        )
    moving = {name: abs(joints[name].velocity) for name in names if abs(joints[name].velocity) > STANDSTILL}
    if moving:
        name = max(moving, key=moving.__getitem__)
        raise MagicError(
            Code.BAD_MOTION, "speed of the arm in rad/s where a move begins", f"{moving[name]:.3f} at {name}", f"at most {STANDSTILL:g}"
        )
