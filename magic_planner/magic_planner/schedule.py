"""The whole motion on one clock: the paths timed and joined, the phases named, the limits checked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_core import interpolation, transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_planner import timing
from magic_planner.collision import mass_centre, solid_pieces
from magic_planner.request import ArmSettings, Branch, Request, StageError
from magic_planner.robot import Robot

Array = NDArray[np.float64]
#: Samples of a motion at which what its joints hold is looked at.
LOADED = 60


def slowed(plan: MotionPlan, factor: float) -> MotionPlan:
    """The arm's plan with the tool carried and used ``factor`` times as slowly; coming to it,
    closing and leaving it take as long as before.

    The path is the same, speeds and accelerations are less by ``factor`` and its square.
    """
    arm = plan.arm_motion
    assert arm is not None
    since = next((p.end for p in arm.phases if p.name == "grasp"), arm.grasp_time)
    until = float(arm.times[-1]) if arm.release_time is None else arm.release_time

    def at(times: Array) -> Array:
        return times + (factor - 1) * np.clip(times - since, 0.0, until - since)

    def moment(time: float) -> float:
        return float(at(np.array(time)))

    slow = np.where((arm.times > since) & (arm.times <= until), factor, 1.0)[:, None]
    phases = tuple(Phase(p.name, moment(p.start), moment(p.end)) for p in arm.phases)
    tool = plan.tool_motion
    return replace(
        plan,
        tool_motion=ToolMotion(
            at(tool.times),
            tool.world_from_tool,
            tuple(Phase(p.name, moment(p.start), moment(p.end)) for p in tool.phases),
            tuple((name, moment(time)) for name, time in tool.marks),
        ),
        arm_motion=replace(
            arm,
            times=at(arm.times),
            velocities=arm.velocities / slow,
            accelerations=arm.accelerations / slow**2,
            grasp_time=moment(arm.grasp_time),
            release_time=None if arm.release_time is None else moment(arm.release_time),
            phases=phases,
        ),
    )


class Schedule:
    """Makes a plan of joint paths."""

    def __init__(self, robot: Robot, settings: ArmSettings) -> None:
        self.robot, self.settings = robot, settings

    def timed(
        self,
        request: Request,
        branch: Branch,
        come: Array,
        pick: tuple[Array, Array, Array],
        carry: Array,
        task: Array,
        retreat: Array | None,
    ) -> MotionPlan:
        """The plan that consists of joint paths (n, J): come, (approach, grasp, lift) of ``pick``, carry, task and retreat.

        Raises StageError where no timing keeps the limits of joints and torques.
        """
        robot, settings = self.robot, self.settings
        limits, step = robot.limits, settings.time_step
        near = limits.slower(0.6)
        track = timing.Track(robot.count)
        names: list[tuple[str, float]] = []
        with _feasible("time parameterisation"):
            track.append(timing.parameterise(come, limits, step, corners=True))
            track.append(timing.parameterise(pick[0], near, step))
            grasp_time = track.now
            track.hold(settings.dwell, step)
            names.append(("grasp", track.now))
            track.append(timing.parameterise(pick[2], near, step))
            track.append(timing.parameterise(carry, limits, step, corners=True))
            names.append(("transfer", track.now))
            began = track.now
            clock = track.follow(request.times, task, self._rests(request), limits, step)
        for phase in request.motion.phases:
            if phase.start < request.times[-1] - 1e-9:
                names.append((phase.name, began + float(clock(min(phase.end, float(request.times[-1]))))))
        release_time = None
        if retreat is not None:
            release_time = track.now
            track.hold(settings.dwell, step)
            names.append(("release", track.now))
            with _feasible("time parameterisation of the retreat"):
                track.append(timing.parameterise(retreat, near, step))
            names.append(("retreat", track.now))
        times, q, qd, qdd = track.arrays()
        held = (times >= grasp_time) & (times <= (np.inf if release_time is None else release_time))
        self._check_range(times, q)
        self._check_rates(times, q, qd, qdd)
        self._check_torques(request, branch, times, q, held)
        poses = np.empty((len(times), 4, 4))
        poses[held] = robot.chain.forward(q[held]) @ transforms.inverse(branch.grasp.tool_from_tcp)
        poses[times < grasp_time] = request.tool.world_from_object
        if release_time is not None:
            poses[times > release_time] = poses[held][-1]
        phases = _phases(names)
        return MotionPlan(
            "arm",
            ToolMotion(times, poses, phases),
            ArmMotion(
                times, robot.chain.names, q, qd, qdd, branch.grasp.tool_from_tcp, branch.grasp.width, grasp_time, release_time, phases
            ),
        )

    def _rests(self, request: Request) -> list[int]:
        """Indices of task samples at which the tool stands still, so that its motion may be timed piece by piece."""
        last = len(request.times) - 1
        if request.strategy.mode != "plan":
            return [0, last]
        found = {0, last}
        for _, when in request.marks:
            found.add(min(last, int(np.abs(request.times - when).argmin())))
        return sorted(found)

    def _check_range(self, times: Array, q: Array) -> None:
        """Raises StageError where joints q (T, J) leave their ranges."""
        chain = self.robot.chain
        over = np.argwhere((q < chain.lower - 1e-6) | (q > chain.upper + 1e-6))
        if len(over):
            i, j = over[0]
            allowed = f"{chain.lower[j]} to {chain.upper[j]} rad"
            raise StageError("timing", MagicError(Code.JOINT_LIMIT, self._joint(j, times[i]), round(float(q[i, j]), 4), allowed))

    def _check_rates(self, times: Array, q: Array, qd: Array, qdd: Array) -> None:
        """Raises StageError where, between the samples too, velocity, acceleration or jerk is more than is published of the robot."""
        published = self.robot.description
        most = self.robot.chain.velocity, published.acceleration, published.jerk
        found = interpolation.extremes(times, q, qd, qdd)
        for values, limits, unit in zip(found, most, ("rad/s", "rad/s^2", "rad/s^3"), strict=True):
            over = np.argwhere(values > limits)
            if len(over):
                i, j = over[0]
                value, allowed = f"{values[i, j]:.3f} {unit}", f"up to {limits[j]:.3f} {unit}"
                raise StageError("timing", MagicError(Code.DYNAMIC_LIMIT, self._joint(j, times[i]), value, allowed))

    def _check_torques(self, request: Request, branch: Branch, times: Array, q: Array, held: NDArray[np.bool_]) -> None:
        """Raises StageError where joints q (T, J) do not hold the arm, and where it is ``held`` (T,) the tool."""
        chain = self.robot.chain
        some = np.unique(np.linspace(0, len(times) - 1, min(len(times), LOADED)).astype(int))
        volume, centre = mass_centre(solid_pieces(request.tool))
        mass = volume * request.strategy.physics.tool_density
        tcp_centre = transforms.apply(transforms.inverse(branch.grasp.tool_from_tcp), centre)
        for rows, load in ((some[held[some]], mass), (some[~held[some]], 0.0)):
            if not len(rows):
                continue
            torques = np.abs(chain.gravity_torques(q[rows], load, tcp_centre))
            over = np.argwhere(torques > chain.effort)
            if len(over):
                i, j = over[0]
                what = f"{self._joint(j, times[rows[i]])} with {load:.2f} kg in hand"
                value, allowed = f"{torques[i, j]:.1f} N m", f"up to {chain.effort[j]} N m"
                raise StageError("timing", MagicError(Code.DYNAMIC_LIMIT, what, value, allowed))

    def _joint(self, index: int, time: float) -> str:
        return f"{self.robot.chain.names[index]} at {time:.2f} s"


@contextmanager
def _feasible(what: str) -> Iterator[None]:
    """A path that no timing serves is a failure of the stage ``timing``."""
    try:
        yield
    except timing.Infeasible as error:
        allowed = "a path that the limits of velocity, acceleration and jerk allow"
        raise StageError("timing", MagicError(Code.TIME_PARAMETERISATION, what, str(error), allowed)) from error


def _phases(ends: Sequence[tuple[str, float]]) -> tuple[Phase, ...]:
    phases, start = [], 0.0
    for name, end in ends:
        if end > start + 1e-9:
            phases.append(Phase(name, start, end))
            start = end
    return tuple(phases)
