"""Run a plan in physics and judge it by the strategy's goal test.

:func:`verify` is the one entry point: it never raises for anything that the scene,
the plan or the simulation may bring up, but answers a :class:`Verdict` with a code
and a sentence, within its deadline.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.robot import Description
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_verifier import goals
from magic_verifier.floating import TABLE, TARGET, TOOL, FloatingRun, Perturbation, Setup, make_setup, perturbed
from magic_verifier.goals import Judgement
from magic_verifier.simulation import DYNAMIC, Settings

#: Deadline and cancel request are looked at, and the state checked, every so many steps.
CHECK_EVERY = 12
#: Solver settings of the variants: a grip needs more iterations than a floating tool.
DEFAULTS = {"fg": Settings(), "arm": Settings(position_iterations=25, velocity_iterations=2, contact_offset=0.002)}
#: Poses are recorded at this rate (Hz).
RECORD_RATE = 30.0


@dataclass(frozen=True)
class Limits:
    """What a motion may do apart from its goal.

    overlap: depth in metres to which the tool may be in static things before the contact phase,
    in a fixed target when it is let go (reconstructions are that uncertain, and a touch is an
    overlap of about nothing), and in the table at any time; press: the same for other static
    things after the contact phase has begun, where the tool may well slide along them; nudge
    (m): how far the target may be pushed before the contact phase; early_force (N): how hard a
    held tool may touch fixed things before it; slip (m) and slip_angle (rad): how far the tool
    may move in the gripper between lift and release; tracking (rad), tracking_slide (m): how far a
    turning and a sliding joint may lag behind; required_rate: share of perturbed runs that must pass.
    """

    overlap: float = 0.0015
    press: float = 0.01
    nudge: float = 0.002
    early_force: float = 5.0
    slip: float = 0.02
    slip_angle: float = 0.35
    tracking: float = 0.1
    tracking_slide: float = 0.01
    required_rate: float = 0.5


@dataclass(frozen=True)
class Recording:
    """What happened: times (T,) s, phase of each, poses[name] (T, 4, 4) world_from_object of ``tool`` and
    ``target``, joints (T, J) of the arm in rad and m (J = 0 without an arm)."""

    times: NDArray[np.float64]
    phases: tuple[str, ...]
    poses: dict[str, NDArray[np.float64]]
    joints: NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """The answer: code OK exactly where success; success_rate over the runs; metrics of the judged run (the first one that
    failed, else the first); simulated seconds over all runs, seconds of wall time, recording of the judged run."""

    success: bool
    code: Code
    message: str
    success_rate: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    simulated: float = 0.0
    seconds: float = 0.0
    recording: Recording | None = None
    runs: tuple[Judgement, ...] = ()


class _Recorder:
    def __init__(self, run: Any) -> None:
        self._run = run
        self._every = max(1, round(run.setup.settings.frequency / RECORD_RATE))
        self._times: list[float] = []
        self._phases: list[str] = []
        self._poses: dict[str, list[NDArray[np.float64]]] = {TOOL: [], TARGET: []}
        self._joints: list[NDArray[np.float64]] = []
        self.note()

    def note(self) -> None:
        run = self._run
        self._times.append(run.time)
        self._phases.append(run.phase)
        for name, poses in self._poses.items():
            poses.append(run.world.pose(name))
        self._joints.append(run.joints())

    def observe(self) -> None:
        if self._run.world.steps % self._every == 0:
            self.note()

    def recording(self) -> Recording:
        if self._times[-1] != self._run.time:
            self.note()
        return Recording(
            np.array(self._times), tuple(self._phases), {k: np.stack(v) for k, v in self._poses.items()}, np.stack(self._joints)
        )


class _Stop:
    """Deadline (of ``time.monotonic``) and cancel request."""

    def __init__(self, deadline: float | None, cancel: Callable[[], bool] | None) -> None:
        self._deadline = deadline
        self._cancel = cancel

    def check(self, simulated: float) -> None:
        if self._cancel is not None and self._cancel():
            raise MagicError(Code.CANCELED, f"canceled after {simulated:.2f} simulated seconds")
        if self._deadline is not None and clock.monotonic() > self._deadline:
            raise MagicError(Code.SIMULATION_TIMEOUT, f"out of time after {simulated:.2f} simulated seconds")


def _refuse_intrusions(strategy: Strategy, run: FloatingRun, limits: Limits, stop: _Stop) -> dict[str, float]:
    """Raise where the planned tool goes through static things; returns what was measured."""
    found = run.intrusions(check=stop.check)
    for item in sorted(found, key=lambda i: i.time):
        if item.before_contact and item.depth > limits.overlap:
            raise MagicError(
                Code.PRE_CONTACT_COLLISION,
                f"the tool is in the {item.body} before the contact phase, at {item.time:.2f} s",
                f"{item.depth * 1000:.1f} mm deep",
                f"up to {limits.overlap * 1000:.1f} mm",
            )
        if item.body == TARGET and item.depth > limits.overlap and strategy.releases:
            raise MagicError(
                Code.PRE_CONTACT_COLLISION,
                f"the tool overlaps the fixed target at {item.time:.2f} s",
                f"{item.depth * 1000:.1f} mm deep",
                f"up to {limits.overlap * 1000:.1f} mm",
            )
        allowed = limits.overlap if item.body == TABLE else limits.press
        if not item.before_contact and item.depth > allowed:
            raise MagicError(
                Code.LIMIT_EXCEEDED,
                f"the tool is pressed into the {item.body} at {item.time:.2f} s",
                f"{item.depth * 1000:.1f} mm deep",
                f"up to {allowed * 1000:.1f} mm",
            )
    return {
        "overlap_before_contact": max((i.depth for i in found if i.before_contact), default=0.0),
        "overlap": max((i.depth for i in found), default=0.0),
    }


def _refuse_early_touch(run: Any, watched: list[str], limits: Limits) -> None:
    """Raise where, before the contact phase, the tool has pushed a free target away or presses on something fixed.

    A touch that moves nothing is allowed: the target is then still where the contact was planned.
    """
    for name in watched:
        if not run.world.touching(TOOL, name, 0.0):
            continue
        if name == TARGET and run.setup.target_kind == DYNAMIC:
            moved = float(np.linalg.norm((run.world.position(TARGET) - run.setup.target.world_from_object[:3, 3])[:2]))
            if moved < limits.nudge:
                continue
            value, allowed = f"moved {moved * 1000:.1f} mm", f"less than {limits.nudge * 1000:.1f} mm"
        else:
            impulse = sum((touch.impulse for touch in run.world.touches(TOOL, name)), np.zeros(3))
            force = float(np.linalg.norm(impulse)) / run.world.timestep
            if force < limits.early_force:
                continue
            value, allowed = f"{force:.1f} N", f"less than {limits.early_force:g} N"
        raise MagicError(
            Code.PRE_CONTACT_COLLISION,
            f"the tool hit the {name} at {run.time:.2f} s, before the contact phase at {run.contact_time:.2f} s",
            value,
            allowed,
        )


def _run_once(
    strategy: Strategy,
    setup: Setup,
    plan: MotionPlan,
    limits: Limits,
    rng: np.random.Generator,
    stop: _Stop,
    progress: Callable[[str, float], None] | None,
    arm_options: Any,
    robot: Description | None,
) -> tuple[Judgement, Recording | None, float]:
    """One run: judgement, recording, simulated seconds.  Raises for cancel and deadline only."""
    recorder = None
    run: Any = None
    metrics: dict[str, float] = {}
    try:
        stop.check(0.0)
        if plan.variant == "arm":
            from magic_verifier.arm_simulation import ArmRun

            run = ArmRun(setup, plan, arm_options, limits, robot)
        else:
            run = FloatingRun(setup, plan)
        goal = goals.goal_test(strategy, run, rng)
        recorder = _Recorder(run)
        if plan.variant == "fg":
            metrics = _refuse_intrusions(strategy, run, limits, stop)
        end = run.duration + goal.settle
        if run.release_time is not None:
            end = max(end, run.release_time + goal.settle)
        # A kinematic tool touches nothing static, see _refuse_intrusions.
        watched = [TARGET] if setup.target_kind == DYNAMIC or plan.variant == "arm" else []
        watched += [o.id for o in setup.obstacles] if plan.variant == "arm" else []
        names = (TOOL, TARGET) if setup.target_kind == DYNAMIC else (TOOL,)
        # The run's clock stands still while a gripper closes: the number of steps is bounded apart from it.
        for step in range(int(np.ceil((end + 10.0) * setup.settings.frequency))):
            if run.time >= end - 1e-9:
                break
            goal.disturb(run)
            run.advance()
            goal.observe(run)
            recorder.observe()
            if step % CHECK_EVERY == 0:
                stop.check(run.time)
                run.world.check(names)
                if progress is not None and step % (CHECK_EVERY * 10) == 0:
                    progress(run.phase, run.time)
            if step % 6 == 0 and run.time < run.contact_time:
                _refuse_early_touch(run, watched, limits)
        run.world.check(names)
        judgement = goal.judge(run)
        return (
            replace(judgement, metrics={**metrics, **getattr(run, "metrics", dict)(), **judgement.metrics}),
            recorder.recording(),
            run.time,
        )
    except MagicError as error:
        if error.code in (Code.CANCELED, Code.SIMULATION_TIMEOUT):
            raise
        recording = None
        if recorder is not None and error.code != Code.SIMULATION_EXPLODED:
            recording = recorder.recording()
        if run is not None:
            metrics = {**metrics, **getattr(run, "metrics", dict)()}
        return Judgement(error.code, error.message, metrics), recording, run.time if run is not None else 0.0


def verify(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...] | list[SceneObject],
    table: NDArray[np.float64],
    candidate: ContactCandidate | None,
    plan: MotionPlan,
    seed: int = 0,
    repetitions: int = 1,
    deadline: float | None = None,
    cancel: Callable[[], bool] | None = None,
    progress: Callable[[str, float], None] | None = None,
    settings: Settings | None = None,
    perturbation: Perturbation | None = None,
    limits: Limits | None = None,
    arm_options: Any = None,
    robot: Description | None = None,
) -> Verdict:
    """Simulate a plan and judge it.

    table (4,) plane with its unit normal up; ``candidate`` goes into no decision and may be ``None``.  With
    repetitions > 1 the first run is as given and each further one is perturbed (:class:`Perturbation`); success
    then means that at least ``limits.required_rate`` of the runs passed.  ``deadline`` is a moment of
    ``time.monotonic()``; ``cancel`` is asked every few steps; ``progress`` hears phase and simulated time.
    ``robot``: the arm of an arm plan, ``None`` for the Panda; ``arm_options``: its controller (:class:`ArmOptions`).
    The same seed gives the same verdict.
    """
    started = clock.monotonic()
    settings = settings or DEFAULTS[plan.variant]
    limits = limits or Limits()
    perturbation = perturbation or Perturbation()
    stop = _Stop(deadline, cancel)
    judgements: list[Judgement] = []
    recordings: list[Recording | None] = []
    simulated = 0.0

    def elapsed() -> float:
        return clock.monotonic() - started

    try:
        if not strategy.simulatable:
            raise MagicError(Code.NOT_VERIFIABLE, f"strategy {strategy.name}", "says that simulation cannot judge it", "simulatable: true")
        goals.require(strategy)
        stop.check(0.0)
        nominal = make_setup(tool, target, tuple(obstacles), table, strategy.physics, settings)
        for index in range(max(1, int(repetitions))):
            rng = np.random.default_rng([int(seed), index])
            setup = nominal if index == 0 else perturbed(nominal, perturbation, rng)
            judgement, recording, length = _run_once(strategy, setup, plan, limits, rng, stop, progress, arm_options, robot)
            judgements.append(judgement)
            recordings.append(recording)
            simulated += length
    except MagicError as error:
        return Verdict(False, error.code, error.message, 0.0, {}, simulated, elapsed(), None, tuple(judgements))
    passed = [j.code == Code.OK for j in judgements]
    rate = float(np.mean(passed))
    success = rate >= limits.required_rate and rate > 0
    shown = passed.index(True) if success else passed.index(False)
    judged = judgements[shown]
    message = judged.message
    if len(passed) > 1:
        message += f"; {sum(passed)} of {len(passed)} runs passed"
    return Verdict(
        success,
        judged.code if not success else Code.OK,
        message,
        rate,
        judged.metrics,
        simulated,
        elapsed(),
        recordings[shown],
        tuple(judgements),
    )
