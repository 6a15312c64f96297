"""The arm's and the gripper's controllers, as ros2_control has them.  No ROS here.

:class:`TrajectoryController` does what the joint trajectory controller of ros2_controllers (Jazzy) does with its action: which goals
it refuses, how it interpolates, when it aborts and with which code, and that it holds where it is after a cancel or an abort.
:class:`GripperController` is the gripper action controller with the Panda's way of grasping: a goal to close presses until the
fingers stand, and where they stand decides.

Both are asked once a step: :meth:`update` with the state, at which a goal may end.  A goal's outcome may be waited for in another thread.
"""

from __future__ import annotations

import bisect
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Fingers that open are there when they are within this of where they were told to, m.
THERE = 0.001
#: Velocities at a trajectory's end that are no larger, rad/s, are none.
NOTHING = float(np.finfo(np.float32).eps)


class Error(IntEnum):
    """The codes of control_msgs/action/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class RefusedError(ValueError):
    """A goal that the controller does not accept."""

    def __init__(self, code: Error, reason: str) -> None:
        super().__init__(reason)
        self.code, self.reason = code, reason


@dataclass(frozen=True)
class Point:
    """One point of a trajectory: seconds from its start, positions (J,), and velocities and accelerations (J,) or none (empty)."""

    time: float
    positions: Sequence[float]
    velocities: Sequence[float] = ()
    accelerations: Sequence[float] = ()


@dataclass(frozen=True)
class Tolerance:
    """How far a joint may be off: rad on the way, rad and rad/s at the end.  0: any amount."""

    path: float = 0.2
    goal: float = 0.02
    stopped: float = 0.05


@dataclass
class Goal:
    """A goal at work, and what became of it: ``done`` is set once ``code`` and ``reason`` stand;
    ``canceled``: by its client or a newer goal."""

    trajectory: Trajectory
    start: float
    tolerances: tuple[Tolerance, ...]
    goal_time: float
    done: threading.Event = field(default_factory=threading.Event)
    code: Error = Error.SUCCESSFUL
    reason: str = ""
    canceled: bool = False

    def end(self, code: Error, reason: str, canceled: bool = False) -> None:
        """Say what became of it, once."""
        if not self.done.is_set():
            self.code, self.reason, self.canceled = code, reason, canceled
            self.done.set()


class Trajectory:
    """Positions and velocities over time, interpolated as the joint trajectory controller does.

    Between two points a polynomial of the first degree where only positions are given, of the third with velocities, of the fifth with
    accelerations.  Before the first point comes the state (``q``, ``qd``) at the moment ``received``, in seconds from its start, where
    that is before the first point's time; a trajectory that should have begun before that is entered where it would be by then.
    """

    def __init__(self, points: Sequence[Point], q: Array, qd: Array, received: float = 0.0) -> None:
        first = points[0]
        if first.time > received:
            zero = [0.0] * len(q)
            points = [
                Point(received, q.tolist(), qd.tolist() if len(first.velocities) else (), zero if len(first.accelerations) else ()),
                *points,
            ]
        self.times = [point.time for point in points]
        self._coefficients = [_polynomial(a, b) for a, b in pairwise(points)]
        self._last = np.asarray(points[-1].positions, dtype=float)

    @property
    def duration(self) -> float:
        """Seconds to its end."""
        return self.times[-1]

    def sample(self, time: float) -> tuple[Array, Array]:
        """Positions and velocities (J,) at a time, which stand still after the end."""
        if time >= self.times[-1]:
            return self._last, np.zeros_like(self._last)
        index = max(0, bisect.bisect_right(self.times, time) - 1)
        s = max(0.0, time - self.times[index])
        c = self._coefficients[index]
        powers = s ** np.arange(len(c))
        slopes = np.arange(1, len(c)) * powers[:-1]
        return powers @ c, slopes @ c[1:]


def _polynomial(a: Point, b: Point) -> Array:
    """Coefficients (D + 1, J) of the segment between two points, lowest power first, in seconds from its beginning."""
    h = b.time - a.time
    p0, p1 = np.asarray(a.positions, dtype=float), np.asarray(b.positions, dtype=float)
    if not (len(a.velocities) and len(b.velocities)):
        return np.stack([p0, (p1 - p0) / h])
    v0, v1 = np.asarray(a.velocities, dtype=float), np.asarray(b.velocities, dtype=float)
    if not (len(a.accelerations) and len(b.accelerations)):
        return np.stack([p0, v0, (3 * (p1 - p0) - (2 * v0 + v1) * h) / h**2, (2 * (p0 - p1) + (v0 + v1) * h) / h**3])
    a0, a1 = np.asarray(a.accelerations, dtype=float), np.asarray(b.accelerations, dtype=float)
    return np.stack(
        [
            p0,
            v0,
            a0 / 2,
            (20 * (p1 - p0) - (8 * v1 + 12 * v0) * h - (3 * a0 - a1) * h**2) / (2 * h**3),
            (30 * (p0 - p1) + (14 * v1 + 16 * v0) * h + (3 * a0 - 2 * a1) * h**2) / (2 * h**4),
            (12 * (p1 - p0) - 6 * (v1 + v0) * h - (a0 - a1) * h**2) / (2 * h**5),
        ]
    )


class TrajectoryController:
    """One trajectory at a time; where there is none the arm is held.

    names: of the joints, in the order of the state.  tolerance: of each joint where a goal names none; goal_time: s beyond the
    trajectory's end within which its tolerances must be met; 0: whenever.
    """

    def __init__(self, names: Sequence[str], q: Array, tolerance: Tolerance | None = None, goal_time: float = 2.0) -> None:
        self.names = tuple(names)
        self.tolerance, self.goal_time = tolerance or Tolerance(), goal_time
        self.goal: Goal | None = None
        self._hold = np.asarray(q, dtype=float).copy()
        self._qd = np.zeros(len(self._hold))
        self._q = self._hold
        #: What :meth:`update` last commanded: positions (J,) and velocities (J,).
        self.desired: tuple[Array, Array] = (self._hold, np.zeros(len(self._hold)))

    # ------------------------------------------------------------ goals

    def check(self, names: Sequence[str], points: Sequence[Point], stamp: float, now: float) -> list[int]:
        """The columns of the trajectory in this controller's order; raises :class:`RefusedError` where it would refuse the goal.

        stamp: when it is to begin, s by the controller's clock; 0: at once.
        """
        if not points:
            raise RefusedError(Error.INVALID_GOAL, "empty trajectory")
        if not names or set(names) != set(self.names) or len(names) != len(self.names):
            wrong = sorted(set(names) ^ set(self.names))
            raise RefusedError(
                Error.INVALID_JOINTS, f"joints {', '.join(wrong) or 'named twice'} (allowed: exactly {', '.join(self.names)})"
            )
        for index, point in enumerate(points):
            if len(point.positions) != len(names):
                raise RefusedError(Error.INVALID_GOAL, f"{len(point.positions)} positions in point {index} (allowed: {len(names)})")
            for what in (point.velocities, point.accelerations):
                if len(what) not in (0, len(names)):
                    raise RefusedError(
                        Error.INVALID_GOAL, f"{len(what)} velocities or accelerations in point {index} (allowed: {len(names)})"
                    )
            numbers = (point.time, *point.positions, *point.velocities, *point.accelerations)
            if not all(map(math.isfinite, numbers)) or point.time < 0:
                raise RefusedError(Error.INVALID_GOAL, f"a number in point {index} is not finite, or its time below 0")
            if index and not point.time > points[index - 1].time:
                raise RefusedError(Error.INVALID_GOAL, f"time of point {index} is not after that of the one before")
        if any(abs(velocity) > NOTHING for velocity in points[-1].velocities):
            raise RefusedError(Error.INVALID_GOAL, "velocities of the last point are not 0")
        if stamp > 0 and stamp + points[-1].time < now:
            raise RefusedError(Error.OLD_HEADER_TIMESTAMP, f"the trajectory ended {now - stamp - points[-1].time:.3f} s ago")
        return [list(names).index(name) for name in self.names]

    def begin(
        self,
        names: Sequence[str],
        points: Sequence[Point],
        now: float,
        stamp: float = 0.0,
        path: Mapping[str, float] | None = None,
        goal: Mapping[str, float] | None = None,
        goal_time: float = 0.0,
    ) -> Goal:
        """Follow a trajectory from now on; a goal at work is canceled.  path, goal: tolerances by joint, rad; 0: the controller's own,
        below 0: any.  Raises :class:`RefusedError`."""
        order = self.check(names, points, stamp, now)

        def sorted_as_mine(values: Sequence[float]) -> Sequence[float]:
            return [values[k] for k in order] if len(values) else ()

        mine = [Point(p.time, sorted_as_mine(p.positions), sorted_as_mine(p.velocities), sorted_as_mine(p.accelerations)) for p in points]

        def chosen(given: Mapping[str, float] | None, name: str, own: float) -> float:
            value = (given or {}).get(name, 0.0)
            return own if value == 0 else max(value, 0.0)

        tolerances = tuple(
            Tolerance(chosen(path, name, self.tolerance.path), chosen(goal, name, self.tolerance.goal), self.tolerance.stopped)
            for name in self.names
        )
        if self.goal is not None:
            self.goal.end(Error.INVALID_GOAL, "Current goal cancelled due to new incoming action.", canceled=True)
        start = stamp if stamp > 0 else now
        trajectory = Trajectory(mine, *self.desired, now - start)
        self.goal = Goal(trajectory, start, tolerances, goal_time if goal_time > 0 else self.goal_time)
        return self.goal

    def cancel(self, goal: Goal) -> None:
        """Hold where the arm is; what is no more at work stays as it is."""
        if goal is self.goal:
            self._stand()
        goal.end(Error.SUCCESSFUL, "Goal cancelled", canceled=True)

    def abort(self, code: Error, reason: str) -> None:
        """End the goal at work with an error, and hold where the arm is."""
        goal = self.goal
        if goal is not None:
            self._stand()
            goal.end(code, reason)

    def _stand(self) -> None:
        self.goal, self._hold = None, self._q.copy()

    # ------------------------------------------------------------ control

    def update(self, now: float, q: Array, qd: Array) -> tuple[Array, Array]:
        """Positions and velocities (J,) to command, for the state (J,) of the arm at this moment."""
        self._q, self._qd = q, qd
        if self.goal is not None:
            self._follow(self.goal, now)
        goal = self.goal
        self.desired = (self._hold, np.zeros(len(self._hold))) if goal is None else goal.trajectory.sample(now - goal.start)
        return self.desired

    def _follow(self, goal: Goal, now: float) -> None:
        """End the goal where its way or its end is over."""
        time = now - goal.start
        error = np.abs(self.desired[0] - self._q)
        if time <= goal.trajectory.duration:
            for name, off, tolerance in zip(self.names, error.tolist(), goal.tolerances, strict=True):
                if 0 < tolerance.path < off:
                    self.abort(
                        Error.PATH_TOLERANCE_VIOLATED,
                        f"Aborted due to path tolerance violation: {name} is off by {off:.3f} rad (allowed: {tolerance.path:g})",
                    )
                    return
            return
        error = np.abs(goal.trajectory.sample(time)[0] - self._q)
        late = time - goal.trajectory.duration
        worst = [
            f"{name} is off by {off:.4f} rad, at {speed:.3f} rad/s"
            for name, off, speed, t in zip(self.names, error.tolist(), np.abs(self._qd).tolist(), goal.tolerances, strict=True)
            if 0 < t.goal < off or 0 < t.stopped < speed
        ]
        if not worst:
            self._hold = goal.trajectory.sample(time)[0]
            self.goal = None
            goal.end(Error.SUCCESSFUL, "Goal successfully reached!")
        elif 0 < goal.goal_time < late:
            self.abort(
                Error.GOAL_TOLERANCE_VIOLATED, f"Aborted due to goal_time_tolerance exceeding by {late - goal.goal_time:.3f} s: {worst[0]}"
            )


@dataclass
class GripperGoal:
    """A goal of the gripper and its end: position of a finger's joint, m, effort, N; ``aborted``: the action's status."""

    position: float
    effort: float
    begun: float
    closes: bool
    moved: float = 0.0
    done: threading.Event = field(default_factory=threading.Event)
    stalled: bool = False
    reached: bool = False
    aborted: bool = False
    canceled: bool = False
    found: float = 0.0


class GripperController:
    """One goal at a time, on the position of a finger's joint (m).

    A goal to open has ended when the fingers are there.  A goal to close has when they stand still: they press with the goal's effort on
    what is between them, wherever that is.  ``reached`` says that it was within ``tolerance`` of where they were told to close to; else
    they have stalled: succeeded where ``allow_stalling`` is set, else aborted, as the gripper action controller has it. stall_velocity
    m/s, stall_timeout s: slower than that for so long is standing.
    """

    def __init__(
        self, tolerance: float = 0.005, stall_velocity: float = 0.001, stall_timeout: float = 0.3, allow_stalling: bool = False
    ) -> None:
        self.tolerance, self.stall_velocity, self.stall_timeout = tolerance, stall_velocity, stall_timeout
        self.allow_stalling = allow_stalling
        self.goal: GripperGoal | None = None

    def begin(self, position: float, effort: float, now: float, found: float) -> GripperGoal:
        """Move the fingers from ``found`` to a position; a goal at work is canceled."""
        if self.goal is not None:
            self.cancel(self.goal)
        self.goal = GripperGoal(position, effort, now, position < found - 1e-4, moved=now)
        return self.goal

    def cancel(self, goal: GripperGoal) -> None:
        """Leave the fingers as they are."""
        if goal is self.goal:
            self.goal = None
        if not goal.done.is_set():
            goal.canceled = True
            goal.done.set()

    def update(self, now: float, position: float, velocity: float) -> None:
        """End the goal at work where the fingers, at this position (m) and velocity (m/s), have done what they were told or stand."""
        goal = self.goal
        if goal is None:
            return
        goal.found = position
        near = abs(position - goal.position) <= self.tolerance
        if abs(velocity) > self.stall_velocity:
            goal.moved = now
        standing = now - goal.moved >= self.stall_timeout
        if standing or (not goal.closes and abs(position - goal.position) <= THERE):
            goal.reached, goal.stalled = near, not near
            goal.aborted = goal.stalled and not self.allow_stalling
            self.goal = None
            goal.done.set()
