"""Whether a motion is one that may be carried out as it stands: every number of it, before any physics.

What is published is the trajectory, not what was simulated of it: names, times,
positions, velocities and accelerations all reach the controller.  Each of them is
therefore held against the arm's limits and against the others, and so is what the
controller makes of them between the points (:mod:`magic_core.interpolation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import interpolation, transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import TOOL_SPEED, TOOL_TURN, ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.robot import Description

Array = NDArray[np.float64]

#: Nothing that a tool does on a table lasts longer (s); a longer one is a mistake in the units of time.
LONGEST = 600.0
#: Farthest between two samples, m and rad.  What is between them is not told: a consumer may interpolate it in its own way, which
#: over a longer step would be another motion than the one simulated.  Motions are planned in steps of a tenth of this.
TOOL_STEP = 0.05
TOOL_STEP_TURN = 0.35
#: A tool that is let go is simulated from rest; this (m/s) is what its own motion may differ from that: it falls that fast after 2 ms.
RELEASE_SPEED = 0.02
#: Numbers pass through messages and other programs' rounding: relative and absolute tolerance of limits, the latter in rad or m.
SLACK = 1e-3
#: At rest is slower than this, rad/s or m/s: a thousandth of what the joints can do.
REST = 2e-3
#: Acceleration at rest is less than this share of a joint's limit: a controller that begins or ends a move with more jumps.
REST_PULL = 0.01
#: How far (m, rad) the tool's own motion may be from where joints and grasp take it.  Positions between samples are interpolated.
HELD_SHIFT = 0.002
HELD_TURN = 0.02
#: How far (m/s, rad/s) a given velocity of the tool may be from that of its positions, and in parts of the speed.
TWIST = 0.02


def check(plan: MotionPlan, robot: Description | None = None) -> None:
    """Raise for a plan that cannot be carried out as it stands, naming the waypoint, the value and what is allowed.

    ``BAD_MOTION``: names, sizes, values that are none, times, positions that contradict velocities, a tool that is not where the
    arm takes it, jumps; ``JOINT_LIMIT``, ``DYNAMIC_LIMIT``: beyond the arm's limits.  ``robot`` may be left out without an arm.
    """
    motion = plan.tool_motion
    _check_clock("tool motion", motion.times)
    _check_phases(motion.phases, float(motion.times[-1]))
    _check_poses(motion)
    if plan.arm_motion is not None and robot is not None:
        check_arm(plan.arm_motion, robot)
        _check_phases(plan.arm_motion.phases, float(plan.arm_motion.times[-1]))
        _check_held(motion, plan.arm_motion, robot)
    elif plan.arm_motion is None:
        _check_release(motion)


def _check_clock(what: str, times: Array) -> None:
    if times.ndim != 1 or len(times) < 1:
        raise MagicError(Code.BAD_MOTION, f"times of the {what}", f"shape {times.shape}", "one or more numbers")
    bad = np.flatnonzero(~np.isfinite(times))
    if len(bad):
        raise MagicError(Code.BAD_MOTION, f"time of the {what} at waypoint {bad[0]}", float(times[bad[0]]), "finite seconds")
    if abs(times[0]) > 1e-6:
        raise MagicError(Code.BAD_MOTION, f"time of the {what} at waypoint 0", f"{times[0]:.6g} s", "0 s")
    steps = np.diff(times)
    if len(steps) and steps.min() <= 0:
        at = int(np.argmin(steps)) + 1
        raise MagicError(
            Code.BAD_MOTION, f"time of the {what} at waypoint {at}", f"{times[at]:.6g} s after {times[at - 1]:.6g} s", "strictly increasing"
        )
    if times[-1] > LONGEST:
        raise MagicError(Code.BAD_MOTION, f"length of the {what}", f"{times[-1]:.0f} s", f"up to {LONGEST:g} s")


def _check_phases(phases: tuple[Phase, ...], end: float) -> None:
    before = 0.0
    for phase in phases:
        if not (np.isfinite(phase.start) and np.isfinite(phase.end) and before - SLACK <= phase.start <= phase.end <= end + SLACK):
            raise MagicError(
                Code.BAD_MOTION,
                f"phase {phase.name!r}",
                f"{phase.start:g} to {phase.end:g} s",
                f"phases in order between {before:.6g} and {end:.6g} s",
            )
        before = phase.end


def _check_poses(motion: ToolMotion) -> None:
    """The tool's poses are rigid, and no farther from each other than they may be, in way, turn and speed."""
    poses, times = motion.world_from_tool, motion.times
    turns = poses[:, :3, :3]
    off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(np.linalg.det(turns) - 1))
    if off.max() > SLACK:
        raise MagicError(
            Code.BAD_MOTION, f"pose of the tool at waypoint {int(off.argmax())}", f"a rotation off by {off.max():.3g}", "a rotation"
        )
    if len(times) < 2:
        return
    dt = np.diff(times)
    way = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = _turns(poses)
    for values, most, what, unit in (
        (way, TOOL_STEP, "step of the tool", "m"),
        (turn, TOOL_STEP_TURN, "turn of the tool in one step", "rad"),
        (way / dt, TOOL_SPEED, "speed of the tool", "m/s"),
        (turn / dt, TOOL_TURN, "turning speed of the tool", "rad/s"),
    ):
        # Times are sent in whole nanoseconds and poses in doubles; the absolute part is for steps of next to no length.
        over = np.flatnonzero(values > most * (1 + SLACK) + 1e-6)
        if len(over):
            at = int(over[0]) + 1
            raise MagicError(
                Code.BAD_MOTION, f"{what} to waypoint {at} ({times[at]:.2f} s)", f"{values[at - 1]:.3g} {unit}", f"up to {most:g} {unit}"
            )


def _turns(poses: Array) -> Array:
    """(T - 1,): angles in rad between one pose and the next."""
    turns = poses[:, :3, :3]
    traces = np.einsum("tij,tij->t", turns[:-1], turns[1:])
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


def _check_release(motion: ToolMotion) -> None:
    """A floating tool is at rest where it is let go."""
    start = next((p.start for p in motion.phases if p.name == "release"), None)
    if start is None or len(motion.times) < 2:
        return
    after = min(int(np.searchsorted(motion.times, start + 1e-9, side="right")), len(motion.times) - 1)
    dt = motion.times[after] - motion.times[after - 1]
    speed = float(np.linalg.norm(motion.world_from_tool[after, :3, 3] - motion.world_from_tool[after - 1, :3, 3]) / dt)
    if speed > RELEASE_SPEED:
        raise MagicError(
            Code.BAD_MOTION,
            f"speed of the tool where it is let go, at {start:.2f} s (waypoint {after})",
            f"{speed:.3g} m/s",
            f"up to {RELEASE_SPEED:g} m/s",
        )


def check_arm(motion: ArmMotion, robot: Description) -> None:
    """The arm's part of :func:`check`: names, shapes, values, limits, rest, grasp."""
    names = tuple(motion.joint_names)
    if names != robot.names:
        raise MagicError(Code.BAD_MOTION, "joints of the arm motion", list(names), f"{list(robot.names)}, in this order")
    times = np.asarray(motion.times, dtype=float)
    if len(times) < 2:
        raise MagicError(Code.BAD_MOTION, "waypoints of the arm motion", len(times), "two or more")
    _check_clock("arm motion", times)
    columns: dict[str, Array] = {}
    for what in ("positions", "velocities", "accelerations"):
        values = np.asarray(getattr(motion, what), dtype=float)
        if values.shape != (len(times), len(names)):
            raise MagicError(Code.BAD_MOTION, f"{what} of the arm motion", f"shape {values.shape}", f"{(len(times), len(names))}")
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            i, j = bad[0]
            raise MagicError(
                Code.BAD_MOTION, f"{what} of {names[j]} at waypoint {i} ({times[i]:.2f} s)", float(values[i, j]), "finite numbers"
            )
        columns[what] = values
    course = _Course(robot, times, *columns.values())
    _check_range(course)
    _check_samples(course)
    _check_braking(course)
    _check_course(course)
    _check_between(course)
    _check_rest(motion, course)
    _check_grasp(motion, robot)


@dataclass(frozen=True)
class _Course:
    """The joints of an arm over T waypoints: times (T,), s; q, speed and pull (T, N): positions, velocities and accelerations, rad or m."""

    robot: Description
    times: Array
    q: Array
    speed: Array
    pull: Array

    def beyond(self, code: Code, what: str, i: int, j: int, value: float, allowed: str, per: str) -> MagicError:
        """What is wrong with joint j at waypoint i; per: what the unit of ``value`` is beside rad or m."""
        unit = ("m" if self.robot.arm[j].sliding else "rad") + per
        where = f"{what} of {self.robot.names[j]} at waypoint {i} ({self.times[i]:.2f} s)"
        return MagicError(code, where, f"{value:.4f} {unit}", f"{allowed} {unit}")


def _check_range(course: _Course) -> None:
    """Each joint stays in its range."""
    q, arm = course.q, course.robot.arm
    lower, upper = (np.array([getattr(joint, side) for joint in arm]) for side in ("lower", "upper"))
    over = np.argwhere((q < lower - SLACK) | (q > upper + SLACK))
    if len(over):
        i, j = over[0]
        raise course.beyond(Code.JOINT_LIMIT, "position", i, j, q[i, j], f"{lower[j]:.4f} to {upper[j]:.4f}", "")


def _check_samples(course: _Course) -> None:
    """What is told of the waypoints, and the means from one to the next, are within the limits."""
    fastest, hardest = course.robot.velocity, course.robot.acceleration
    dt = np.diff(course.times)[:, None]
    for values, most, what, per in (
        (course.speed, fastest, "velocity", "/s"),
        (np.diff(course.q, axis=0) / dt, fastest, "velocity between waypoints", "/s"),
        (course.pull, hardest, "acceleration", "/s^2"),
        (np.diff(course.speed, axis=0) / dt, hardest, "acceleration between waypoints", "/s^2"),
    ):
        over = np.argwhere(np.abs(values) > most * (1 + SLACK) + SLACK)
        if len(over):
            i, j = over[0]
            waypoint = i + len(course.times) - len(values)
            raise course.beyond(Code.DYNAMIC_LIMIT, what, waypoint, j, values[i, j], f"up to {most[j]:g} either way", per)


def _check_braking(course: _Course) -> None:
    """Near the end of its range a joint is slow enough to stop before it, where the arm asks that."""
    if course.robot.braking is None:
        return
    slowest, quickest = course.robot.braking.velocities(course.q)
    over = np.argwhere((course.speed < slowest - SLACK) | (course.speed > quickest + SLACK))
    if len(over):
        i, j = over[0]
        allowed = f"{slowest[i, j]:.3f} to {quickest[i, j]:.3f} this near to the end of its range"
        raise course.beyond(Code.DYNAMIC_LIMIT, "velocity", i, j, course.speed[i, j], allowed, "/s")


def _check_course(course: _Course) -> None:
    """Velocities are those of the positions."""
    dt, moved, speed = np.diff(course.times)[:, None], np.diff(course.q, axis=0), course.speed
    # Within its acceleration a joint can between two samples leave the straight course of its velocities by a quarter of a t^2.
    gap = np.abs(moved - dt * (speed[1:] + speed[:-1]) / 2)
    allowed = course.robot.acceleration * dt**2 / 4 + 1e-4
    over = np.argwhere(gap > allowed)
    if len(over):
        i, j = over[0]
        what = "velocities and positions contradict each other: mean velocity"
        by_positions = f"{moved[i, j] / dt[i, 0]:.4f} +- {allowed[i, j] / dt[i, 0]:.4f} by the positions"
        raise course.beyond(Code.BAD_MOTION, what, i + 1, j, (speed[i, j] + speed[i + 1, j]) / 2, by_positions, "/s")


def _check_between(course: _Course) -> None:
    """What a controller makes of the waypoints is within the limits between them as well."""
    robot = course.robot
    fast, strong, sharp = interpolation.extremes(course.times, course.q, course.speed, course.pull)
    for values, most, what, per in (
        (fast, robot.velocity, "velocity", "/s"),
        (strong, robot.acceleration, "acceleration", "/s^2"),
        (sharp, robot.jerk, "jerk", "/s^3"),
    ):
        over = np.argwhere(values > most * (1 + SLACK) + SLACK)
        if len(over):
            i, j = over[0]
            what = f"{what} that a controller makes of it up to the next"
            raise course.beyond(Code.DYNAMIC_LIMIT, what, i, j, values[i, j], f"up to {most[j]:g} either way", per)


def _check_rest(motion: ArmMotion, course: _Course) -> None:
    """The arm rests at the start, the end, the grasp and the release."""
    times, limit = course.times, course.robot.acceleration
    moments = {"start": 0.0, "end": float(times[-1]), "grasp": float(motion.grasp_time)}
    if motion.release_time is not None:
        moments["release"] = float(motion.release_time)
    for name, when in moments.items():
        if not (np.isfinite(when) and 0 <= when <= times[-1] + SLACK):
            raise MagicError(Code.BAD_MOTION, f"time of the {name}", f"{when:g} s", f"0 to {times[-1]:.6g} s")
        i = int(np.abs(times - when).argmin())
        fastest, pulled = (
            np.array([np.interp(when, times, np.abs(column)) for column in values.T]) for values in (course.speed, course.pull)
        )
        j = int(fastest.argmax())
        if fastest[j] > REST:
            raise course.beyond(Code.BAD_MOTION, f"velocity at the {name}", i, j, float(fastest[j]), f"rest, up to {REST:g}", "/s")
        j = int((pulled / limit).argmax())
        if pulled[j] > REST_PULL * limit[j]:
            most = f"rest, up to {REST_PULL * limit[j]:g}"
            raise course.beyond(Code.BAD_MOTION, f"acceleration at the {name}", i, j, float(pulled[j]), most, "/s^2")
    if motion.release_time is not None and not motion.grasp_time < motion.release_time:
        raise MagicError(
            Code.BAD_MOTION, "time of the release", f"{motion.release_time:g} s", f"after the grasp at {motion.grasp_time:g} s"
        )


def _check_grasp(motion: ArmMotion, robot: Description) -> None:
    grasp = np.asarray(motion.tool_from_tcp, dtype=float)
    if grasp.shape != (4, 4) or not np.all(np.isfinite(grasp)) or np.abs(grasp[:3, :3] @ grasp[:3, :3].T - np.eye(3)).max() > SLACK:
        raise MagicError(Code.BAD_MOTION, "grasp (tool_from_tcp)", grasp.tolist(), "a finite rigid transform")
    if not 0 <= motion.grasp_width <= robot.config.opening + SLACK:
        raise MagicError(Code.BAD_MOTION, "width of the grasp", f"{motion.grasp_width:g} m", f"0 to {robot.config.opening:g} m")


def _check_held(tool: ToolMotion, arm: ArmMotion, robot: Description) -> None:
    """While it is held the tool is where the joints and the grasp take it."""
    end = np.inf if arm.release_time is None else arm.release_time
    if abs(tool.times[-1] - arm.times[-1]) > 0.05 and arm.release_time is None:
        raise MagicError(
            Code.BAD_MOTION, "length of the tool motion", f"{tool.times[-1]:.3f} s", f"that of the arm motion, {arm.times[-1]:.3f} s"
        )
    held = np.flatnonzero((tool.times >= arm.grasp_time - 1e-9) & (tool.times <= end + 1e-9))
    if not len(held):
        raise MagicError(Code.BAD_MOTION, "tool motion", "no sample while the tool is held", f"samples from {arm.grasp_time:.2f} s on")
    at = tool.times[held]
    q = np.column_stack([np.interp(at, arm.times, column) for column in np.asarray(arm.positions, dtype=float).T])
    taken = robot.forward(q) @ transforms.inverse(np.asarray(arm.tool_from_tcp, dtype=float))
    given = tool.world_from_tool[held]
    shift = np.linalg.norm(taken[:, :3, 3] - given[:, :3, 3], axis=1)
    turn = np.arccos(np.clip((np.einsum("tij,tij->t", taken[:, :3, :3], given[:, :3, :3]) - 1) / 2, -1, 1))
    worst = int(np.maximum(shift / HELD_SHIFT, turn / HELD_TURN).argmax())
    if shift[worst] > HELD_SHIFT or turn[worst] > HELD_TURN:
        raise MagicError(
            Code.BAD_MOTION,
            f"tool at waypoint {held[worst]} ({at[worst]:.2f} s), away from where joints and grasp take it by",
            f"{shift[worst] * 1000:.1f} mm and {turn[worst]:.3f} rad",
            f"up to {HELD_SHIFT * 1000:g} mm and {HELD_TURN:g} rad",
        )


def check_trajectory(message: Any, tool_id: str, motion: ToolMotion) -> None:
    """What a ``MultiDOFJointTrajectory`` says beyond the poses of ``motion``: the tool's name, and velocities and accelerations."""
    names = list(message.joint_names)
    if names != [tool_id]:
        raise MagicError(Code.BAD_MOTION, "joint names of the tool's trajectory", names, f"[{tool_id!r}], the tool of the goal")
    given: dict[str, Array] = {}
    for what in ("velocities", "accelerations"):
        counts = {len(getattr(p, what)) for p in message.points}
        if counts not in ({0}, {1}):
            raise MagicError(Code.BAD_MOTION, f"{what} of the tool's trajectory", f"{sorted(counts)} in a point", "one in each, or none")
        if counts == {1}:
            given[what] = np.stack([_twist(getattr(p, what)[0]) for p in message.points])
            bad = np.argwhere(~np.isfinite(given[what]))
            if len(bad):
                raise MagicError(
                    Code.BAD_MOTION, f"{what} of the tool at waypoint {bad[0][0]}", float(given[what][tuple(bad[0])]), "finite numbers"
                )
    if "velocities" not in given or len(motion.times) < 2:
        return
    dt = np.diff(motion.times)[:, None]
    poses = motion.world_from_tool
    moved = np.diff(poses[:, :3, 3], axis=0) / dt
    turned = Rotation.from_matrix(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1)).as_rotvec() / dt
    mean = (given["velocities"][1:] + given["velocities"][:-1]) / 2
    for by_poses, told, most, unit in ((moved, mean[:, :3], TOOL_SPEED, "m/s"), (turned, mean[:, 3:], TOOL_TURN, "rad/s")):
        gap, speed = np.linalg.norm(told - by_poses, axis=1), np.linalg.norm(by_poses, axis=1)
        over = np.flatnonzero(gap > TWIST * (1 + speed / most))
        if len(over):
            raise MagicError(
                Code.BAD_MOTION,
                f"velocity of the tool at waypoint {over[0] + 1}, away from that of its poses by",
                f"{gap[over[0]]:.3g} {unit}",
                f"up to {TWIST:g} {unit}",
            )


def _twist(message: Any) -> Array:
    return np.array([getattr(part, axis) for part in (message.linear, message.angular) for axis in "xyz"])
