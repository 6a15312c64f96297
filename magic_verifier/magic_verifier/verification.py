"""Run a plan in physics and judge it by the strategy's goal.

:func:`verify` is the one entry point: it never raises for anything that the scene,
the plan or the simulation may bring up, but answers a :class:`Verdict` with a code
and a sentence, within its deadline.

A verdict is a set of rollouts.  The first is the scene as given, the whole motion; each
further one is a draw of what is not known (:mod:`magic_verifier.uncertainty`), from where
the tool comes near anything; an arm takes hold of a seen tool before.  The rollouts end as soon as the interval of the success
rate lies on one side of the rate that is required.
"""

from __future__ import annotations

import math
import pickle
import time as clock
from collections import Counter
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, field, replace
from functools import lru_cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.robot import Description
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Strategy
from magic_verifier import goals, motion_check, uncertainty
from magic_verifier.floating import CONTACT_PHASES, TABLE, TARGET, TOOL, Body, FloatingRun, Setup, make_setup, nears, phase_start, speed
from magic_verifier.goals import Judgement
from magic_verifier.simulation import DYNAMIC, LEAST_FREQUENCY, STATIC, Settings
from magic_verifier.uncertainty import Draw, Eyes, Uncertainty

#: Deadline and cancel request are looked at, and the state checked, every so many steps.
CHECK_EVERY = 12
#: Whether the tool touches anything too early is looked at every so many seconds.
TOUCH_EVERY = 0.025
#: Solver settings of the variants: a grip needs more iterations than a floating tool.
DEFAULTS = {"fg": Settings(), "arm": Settings(position_iterations=8, velocity_iterations=1, contact_offset=0.002)}
#: Poses are recorded at this rate (Hz).
RECORD_RATE = 30.0
#: Rollouts at most, where the caller names no number: up to two of so many may fail (see ``Limits.required_rate``).
ROLLOUTS = 24
#: A drawn rollout begins so many seconds before the box of one of the tool's pieces comes within so many metres of one of anything but
#: the table, with a floating gripper of the target: more than what is drawn may displace them.
LEAD, NEAR = 0.1, 0.03
#: A drawn rollout takes steps so many times as long as the scene as given: the longest for which the tool is slow enough (:func:`_longer`).
LONGER = {"fg": (4.0, 2.0), "arm": (2.0,)}
#: A drawn rollout of a tool that cameras saw begins with its grasp, from so many seconds before the fingers close until so many after.
BEFORE_GRASP, AFTER_GRASP = 0.6, 1.0
#: How an arm's hand yields (N/m): a usual stiffness of Cartesian impedance control.
STIFFNESS = 2000.0
#: Two-sided 95 % of the normal distribution.
Z95 = NormalDist().inv_cdf(0.975)
#: A parameter is named as the cause of failures if as clean a separation by any of the parameters had a chance of less than this.
BY_CHANCE = 0.05


@dataclass(frozen=True)
class Limits:
    """What a motion may do apart from its goal.

    overlap: depth in metres to which the tool may be in static things before the contact phase,
    in a fixed target when it is let go (reconstructions are that uncertain, and a touch is an
    overlap of about nothing), and in the table at any time; press: the same for other static
    things after the contact phase has begun, where the tool may well slide along them; nudge
    (m): how far the target may be pushed before the contact phase; stray (m): how far it may move along the table by itself,
    before anything touches it; early_force (N): how hard a
    held tool may touch fixed things before it; slip (m) and slip_angle (rad): how far the tool
    may move in the gripper between lift and release; tracking (rad), tracking_slide (m): how far a
    turning and a sliding joint may lag behind.

    give (m): what stands for overlap and nudge, and for early_force with a hand's stiffness (:data:`STIFFNESS`), in drawn
    rollouts, where tool and target are off by what was drawn: a hand gives way to what it brushes, and a target that is
    pushed so far was drawn as far away as well.  10 mm are 20 N, where Franka's examples set the threshold of a
    contact; whether the task is done in spite of it is for the goal to say.

    required_rate: the lower end of the 95 % interval of the success rate must be no lower.  0.7: more than two thirds of
    what may be the case must succeed, and nine rollouts that all pass suffice to say so.  Of motions that really succeed
    in half of the cases 0.2 % are passed (with up to 24 rollouts, the interval looked at after each), in 70 % of the
    cases 6 %, in 90 % 67 %, in 95 % 90 %, in 98 % 97 %.
    """

    overlap: float = 0.0015
    press: float = 0.01
    nudge: float = 0.002
    stray: float = 0.005
    early_force: float = 5.0
    slip: float = 0.02
    slip_angle: float = 0.35
    tracking: float = 0.1
    tracking_slide: float = 0.01
    give: float = 0.01
    required_rate: float = 0.7

    def yielding(self) -> Limits:
        """The limits where things are not where they were taken to be: as ``give`` allows."""
        force = max(self.early_force, STIFFNESS * self.give)
        return replace(self, overlap=max(self.overlap, self.give), nudge=max(self.nudge, self.give), early_force=force)


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
    """The answer: code OK exactly where success.

    success_rate over the rollouts with its interval (rate_low, rate_high), 95 % or what :func:`level` says; failures: reasons of the failing ones with their
    counts; runs: what each rollout came to, the scene as given first; metrics and recording of the judged run (the first one that
    failed, else the first); simulated seconds over all runs, seconds of wall time.
    """

    success: bool
    code: Code
    message: str
    success_rate: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    simulated: float = 0.0
    seconds: float = 0.0
    recording: Recording | None = None
    runs: tuple[Judgement, ...] = ()
    rate_low: float = 0.0
    rate_high: float = 1.0
    failures: tuple[str, ...] = ()


def wilson(successes: int, count: int, z: float = Z95) -> tuple[float, float]:
    """The Wilson score interval of a success rate, 95 % unless told otherwise; (0, 1) of no trials."""
    if count == 0:
        return 0.0, 1.0
    share = successes / count
    centre = share + z * z / (2 * count)
    half = z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    scale = 1 + z * z / count
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def level(tried: int) -> float:
    """The level of a motion's interval, where so many motions for the same task were tried before it: each try shares the 5 % that an
    interval may be wrong by (Bonferroni), as one of many that fail now and then is found to pass by chance."""
    return 1 - 0.05 / (1 + tried)


def _z(tried: int) -> float:
    return NormalDist().inv_cdf((1 + level(tried)) / 2)


def decided(successes: int, count: int, most: int, required: float, z: float = Z95) -> bool:
    """Whether no further rollout is needed: the interval lies on one side of the required rate, or can no more come above it."""
    low, high = wilson(successes, count, z)
    return low >= required or high < required or wilson(successes + most - count, most, z)[0] < required


def passes(successes: int, count: int, required: float, z: float = Z95) -> bool:
    """Whether a success rate is shown to be no lower than required."""
    return successes > 0 and wilson(successes, count, z)[0] >= required


def fewest(required: float, tried: int = 0) -> int:
    """With how many rollouts, none of which fails, a success rate is shown to be no lower than required, after so many motions that were
    simulated for the same task before: given to :func:`verify` as the most there may be, one that fails is a no."""
    count = 1
    while not passes(count, count, required, _z(tried)):
        count += 1
    return count


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


def _refuse_intrusions(
    strategy: Strategy, run: FloatingRun, limits: Limits, stop: Any, measured: bool, planned: float = np.inf
) -> dict[str, float]:
    """Raise where the planned tool goes through static things; returns what was measured.

    Where that is not to be ``measured``, for it is shown to nobody, what is allowed in any case need not be found; ``planned``: what was of the
    tool as it is thought to be, m.
    """
    found = run.intrusions(check=stop.check, harmless=0.0 if measured else min(limits.overlap, limits.press), planned=planned)
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


class _Untouched:
    """Refuses a target that moves by itself, topples or rolls off, before anything touches it that the motion moves: what comes of it would
    be put down to the tool."""

    #: A target that is slower than this (m/s) is not being pushed: its contacts are not looked at.
    STILL = 0.001

    def __init__(self, run: Any, limits: Limits) -> None:
        self._run, self._limits = run, limits
        self._fixed = {TABLE, *(o.id for o in run.setup.obstacles)}
        self._over = run.setup.target_kind != DYNAMIC
        self._stood = self._middle(run.setup.target.world_from_object)

    def _middle(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        return transforms.apply(pose, self._run.setup.target.centre)

    def check(self, kicked: bool) -> None:
        """After each step; ``kicked``: the test itself moves the target from now on."""
        world, limits = self._run.world, self._limits
        self._over = self._over or kicked
        if self._over or math.hypot(*world.velocity(TARGET).tolist()) < self.STILL:
            return
        self._over = not self._fixed.issuperset(world.touched_by(TARGET, goals.TOUCH))
        way = self._middle(world.pose(TARGET)) - self._stood
        normal = self._run.setup.table[:3]
        moved = float(np.linalg.norm(way - (way @ normal) * normal))
        if not self._over and moved > limits.stray:
            raise MagicError(
                Code.UNSTABLE,
                f"the target moves by itself at {self._run.time:.2f} s, before anything touches it",
                f"moved {moved * 1000:.1f} mm",
                f"up to {limits.stray * 1000:.1f} mm",
            )


@dataclass(frozen=True)
class Task:
    """Everything that a rollout is a function of, beside its number: it may be sent to another process.

    ``eyes``: how well tool and target are known, and by how much these widths are to be multiplied; ``start``: the moment of the
    motion at which drawn rollouts begin; ``held``: the tool in the arm's hand at that moment; ``overlap``: how deep the tool that is led goes into
    things as it was planned, m, where that is known; ``longer``: how many times as long their
    steps are; ``shares``: how much of what is drawn of the tool's surface its corners are shifted by (:func:`magic_verifier.uncertainty.shares`).
    """

    strategy: Strategy
    setup: Setup
    plan: MotionPlan
    limits: Limits
    seed: int
    uncertainty: Uncertainty
    eyes: tuple[tuple[Eyes, float], tuple[Eyes, float]]
    arm_options: Any = None
    robot: Description | None = None
    start: float = 0.0
    held: Any = None
    overlap: float = np.inf
    longer: float = 1.0
    shares: tuple[NDArray[np.float64], ...] | None = None

    def drawn(self, index: int) -> Draw | None:
        """The draw of a rollout; ``None`` for the first one."""
        return None if index == 0 else uncertainty.draw(self.uncertainty, *self.eyes, self.seed, index)

    def under(self, drawn: Draw) -> Setup:
        """The scene of a drawn rollout."""
        setup = uncertainty.applied(drawn, self.setup, self.shares)
        settings = replace(setup.settings, frequency=setup.settings.frequency / self.longer)
        if self.plan.variant == "arm":
            # The engine solves a step in as many parts as there are iterations.  Pads hardly give: at longer parts the load on a grip
            # comes out half as large again, and tools slip that do not.
            settings = replace(settings, position_iterations=round(self.longer * settings.position_iterations))
        return replace(setup, settings=settings)


@dataclass(frozen=True)
class Outcome:
    """What a rollout came to: judgement, recording (``None`` where there is none to show), simulated seconds; ``held``: the tool in
    the arm's hand when it came to the task's start."""

    judgement: Judgement
    recording: Recording | None
    simulated: float
    held: Any = None


class _Never:
    """No deadline, no cancel request: another process is told to stop in another way."""

    def check(self, _simulated: float) -> None:
        return


def rollout(
    task: Task,
    index: int,
    stop: Any = None,
    progress: Callable[[str, float], None] | None = None,
    record: bool = True,
    begin: Callable[[Task], None] | None = None,
) -> Outcome:
    """One rollout, a function of ``task`` and ``index`` alone.  ``begin`` hears of the first one, as soon as it is known, the task of the
    others: how the arm has the tool in its hand at the task's start, or how deep the tool goes into things.  Raises for cancel and deadline only."""
    stop = stop or _Never()
    strategy, plan, limits = task.strategy, task.plan, task.limits
    drawn = task.drawn(index)
    recorder = held = taken_anew = None
    run: Any = None
    metrics: dict[str, float] = {}
    grasped = 0.0

    def simulated() -> float:
        return grasped + (float(run.world.time) if run is not None else 0.0)

    try:
        stop.check(0.0)
        setup = task.setup if drawn is None else task.under(drawn)
        limits = limits if drawn is None else limits.yielding()
        if plan.variant == "arm":
            if drawn is not None and _grasp_is_drawn(task):
                grasped, taken_anew = _take_hold(task, drawn, limits, stop)
            run = _arm_run(task, setup, drawn, taken_anew)
        elif drawn is None:
            run = FloatingRun(setup, plan)
        else:
            run = FloatingRun(setup, plan, _moving_from(task, setup), drawn.tool_from_held, task.setup.tool)
        setup = run.setup
        goal = goals.goal_test(strategy, run, np.random.default_rng([task.seed, index, 1]), None if drawn is None else drawn.nudge)
        recorder = _Recorder(run) if record else None
        if plan.variant == "fg":
            metrics = _refuse_intrusions(strategy, run, limits, stop, record or drawn is None, task.overlap)
            if drawn is None and begin is not None:
                begin(replace(task, overlap=metrics["overlap"]))
        end = goal.until()
        # A kinematic tool touches nothing static, see _refuse_intrusions.
        watched = [TARGET] if setup.target_kind == DYNAMIC or plan.variant == "arm" else []
        watched += [o.id for o in setup.obstacles] if plan.variant == "arm" else []
        names = (TOOL, TARGET) if setup.target_kind == DYNAMIC else (TOOL,)
        touch_every = max(1, round(TOUCH_EVERY * setup.settings.frequency))
        # A thing that was seen to stand may roll off where its centre of mass or its shape was drawn otherwise.
        untouched = _Untouched(run, limits) if drawn is None else None

        def advance(step: int) -> None:
            run.advance()
            if recorder is not None:
                recorder.observe()
            if step % CHECK_EVERY == 0:
                stop.check(simulated())
                run.world.check(names)
                if progress is not None and step % (CHECK_EVERY * 10) == 0:
                    progress(run.phase, run.time)

        # The run's clock stands still while a gripper closes: the number of steps is bounded apart from it.
        for step in range(int(np.ceil((end + 10.0) * setup.settings.frequency))):
            if run.time >= end - 1e-9:
                break
            goal.disturb()
            advance(step)
            if untouched is not None:
                untouched.check(goal.kicks)
            goal.observe()
            if held is None and drawn is None and plan.variant == "arm" and run.time >= task.start:
                held = run.held()
                if held is not None and begin is not None:
                    begin(from_held(task, held))
            if step % touch_every == 0 and run.time < run.contact_time:
                _refuse_early_touch(run, watched, limits)
        run.world.check(names)

        def go_on(seconds: float) -> None:
            for step in range(round(seconds * setup.settings.frequency)):
                advance(step)
            run.world.check(names)

        judgement = goal.judge(go_on)
        judgement = replace(judgement, metrics={**metrics, **getattr(run, "metrics", dict)(), **judgement.metrics})
    except MagicError as error:
        if error.code in (Code.CANCELED, Code.SIMULATION_TIMEOUT):
            raise
        if run is not None:
            metrics = {**metrics, **getattr(run, "metrics", dict)()}
        judgement = Judgement(error.code, error.message, metrics)
        if error.code == Code.SIMULATION_EXPLODED:
            recorder = None
    return Outcome(judgement, recorder.recording() if recorder is not None else None, simulated(), held)


def _moving_from(task: Task, setup: Setup) -> float:
    """Where a drawn floating rollout begins to step: a tool that only its release makes free meets nothing that moves before it."""
    release = phase_start(task.plan.tool_motion.phases, ("release",))
    if setup.target_kind == STATIC and release is not None:
        return release
    return task.start


def _grasp_is_drawn(task: Task) -> bool:
    """Whether drawn rollouts take hold of the tool anew: of one whose shape cameras gave, which is not in the hand when the plan begins."""
    motion = task.plan.arm_motion
    return motion is not None and motion.grasp_time > 0 and task.eyes[0][0] == task.uncertainty.camera


def _take_hold(task: Task, drawn: Draw, limits: Limits, stop: Any) -> tuple[float, Any]:
    """The grasp of a drawn rollout, the tool on the table as far off as it is drawn to be in the hand and shaped as drawn
    (:func:`standing`): simulated seconds, and how the pads have it.

    What is seen of a lying thing is its top: how steep its sides are, between which the fingers close, is the reconstruction's guess.
    Steps are short, as closing fingers bear no longer ones.  Raises as the run does.
    """
    from magic_verifier.arm_simulation import ArmRun

    motion = task.plan.arm_motion
    assert motion is not None
    setup = replace(task, longer=1.0).under(drawn)
    setup = replace(setup, tool=standing(setup.tool, task.setup.tool, drawn.tool_from_held, setup.table))
    begin, end = max(motion.grasp_time - BEFORE_GRASP, 0.0), min(motion.grasp_time + AFTER_GRASP, task.start)
    run = ArmRun(setup, task.plan, _drawn_options(task, drawn), limits, task.robot, None, drawn.lag, begin)
    while run.time < end:
        run.advance()
        if run.world.steps % CHECK_EVERY == 0:
            stop.check(float(run.world.time))
    return float(run.world.time), run.held()


def along_table(moved: NDArray[np.float64], up: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A small displacement (4, 4) in two: along the plane whose normal is ``up`` and about it, and the rest, a height and a tilt."""
    shift, turn = moved[:3, 3], Rotation.from_matrix(moved[:3, :3]).as_rotvec()
    height, angle = (shift @ up) * up, (turn @ up) * up
    return transforms.from_rotvec(angle, shift - height), transforms.from_rotvec(turn - angle, height)


def standing(drawn: Body, seen: Body, tool_from_held: NDArray[np.float64], table: NDArray[np.float64]) -> Body:
    """A tool of a drawn shape on the table (4,), displaced from where it was ``seen`` along the table and about the vertical alone, by what is drawn.

    It was seen to stand: no height, tilt or underside is drawn with which it would not.  What is drawn of heights fades out towards
    the table, over the lower half of the tool; without that mugs toppled that stood as they were seen to stand.
    """
    up, pose = table[:3], seen.world_from_object
    turn = pose[:3, :3]
    moved, _ = along_table(tool_from_held, turn.T @ up)
    heights = [transforms.apply(pose, hull) @ up + table[3] for hull in seen.hulls]
    highest = max(float(h.max()) for h in heights)
    hulls = list(drawn.hulls)
    for index, (before, ball) in enumerate(zip(heights, drawn.balls, strict=True)):
        if ball is None:
            kept = np.clip(1 - before / max(0.5 * highest, 1e-6), 0.0, 1.0)
            after = transforms.apply(pose, hulls[index]) @ up + table[3]
            hulls[index] = hulls[index] + (kept * (before - after))[:, None] * (up @ turn)
    return replace(drawn, hulls=tuple(hulls), world_from_object=pose @ moved)


def _drawn_options(task: Task, drawn: Draw) -> Any:
    from magic_verifier.articulation import ArmOptions

    options = task.arm_options or ArmOptions()
    return replace(
        options, grip_force=options.grip_force * drawn.grip_force, stiffness=tuple(k * drawn.stiffness for k in options.stiffness)
    )


def _arm_run(task: Task, setup: Setup, drawn: Draw | None, taken_anew: Any = None) -> Any:
    """The arm's run under a draw; ``taken_anew``: how the drawn grasp has the tool, ``None`` where none is drawn."""
    from magic_verifier.arm_simulation import ArmRun
    from magic_verifier.articulation import ArmOptions

    if drawn is None:
        return ArmRun(setup, task.plan, task.arm_options or ArmOptions(), task.limits, task.robot)
    options = _drawn_options(task, drawn)
    if options.past is not None:  # what contacts alone have taken hold of has no state that could be begun from
        return ArmRun(setup, task.plan, options, task.limits, task.robot, None, drawn.lag)
    if taken_anew is None:
        held = replace(task.held, tool_from_tcp=transforms.inverse(drawn.tool_from_held) @ task.held.tool_from_tcp)
    else:
        # Fingers that close turn a tool until its sides lie along the pads, whatever way they were seen to go.  A tool on the table was
        # off along it alone: the rest of what is drawn comes now.  On the way it creeps as it did in the scene as given.
        _, off_it = along_table(drawn.tool_from_held, task.setup.tool.world_from_object[:3, :3].T @ setup.table[:3])
        crept = transforms.inverse(task.held.taken) @ task.held.tool_from_tcp
        held = replace(taken_anew, time=task.held.time, tool_from_tcp=transforms.inverse(off_it) @ taken_anew.taken @ crept)
    return ArmRun(setup, task.plan, options, task.limits, task.robot, held, drawn.lag)


def _start(strategy: Strategy, setup: Setup, plan: MotionPlan) -> float:
    """Where drawn rollouts begin: shortly before the tool comes near anything that it may meet, not before its approach; at the end of a
    motion that comes near nothing."""
    phases = plan.tool_motion.phases
    contact = phase_start(phases, CONTACT_PHASES)
    if contact is None:
        return 0.0
    approach = phase_start(phases, ("approach",))
    first = (0.0 if plan.arm_motion is None else contact) if approach is None else approach
    times, poses = plan.tool_motion.times, plan.tool_motion.world_from_tool
    fine = np.append(np.arange(first, contact, 0.02), contact)
    # Nothing that is fixed meets a tool that is led along its path; an arm may press on it.
    others = (setup.target, *(setup.obstacles if plan.arm_motion is not None else ()))
    near = nears(setup, transforms.interpolate(times, poses, fine), fine, NEAR + goals.around(strategy), others)
    return float(np.clip((contact if near is None else near) - LEAD, first, contact))


def _longer(setup: Setup, plan: MotionPlan, start: float) -> float:
    """How many times as long the steps of drawn rollouts are: by so much that the tool never goes further in one of them than contacts
    are solved ahead of a touch, a blow for one does."""
    frequency, reach = setup.settings.frequency, 2 * setup.settings.contact_offset
    fastest = speed(plan.tool_motion, setup.tool, start)
    for longer in LONGER[plan.variant]:
        if frequency / longer >= LEAST_FREQUENCY and fastest <= reach * frequency / longer:
            return longer
    return 1.0


@dataclass(frozen=True)
class _Packed:
    """A task as it is sent to other processes, once packed and, there, once unpacked."""

    content: bytes

    @classmethod
    def of(cls, task: Task) -> _Packed:
        """The arm goes by what it was read from, so that a process reads it once for all tasks; pictures stay here: nine tenths of it, that
        no rollout looks at."""
        views = {name: _unpictured(getattr(task.strategy, name)) for name in ("tool_view", "target_view")}
        task, config = (
            replace(task, strategy=replace(task.strategy, **views), robot=None),
            None if task.robot is None else task.robot.config,
        )
        return cls(pickle.dumps((task, config), pickle.HIGHEST_PROTOCOL))


def _unpictured(view: CanonicalView) -> CanonicalView:
    return replace(view, image=view.image[:1, :1].copy(), mask=view.mask[:1, :1].copy(), depth=None)


@lru_cache(maxsize=2)
def _unpacked(packed: _Packed) -> Task:
    from magic_verifier.articulation import described

    task, config = pickle.loads(packed.content)
    return replace(task, robot=None if config is None else described(config))


def _elsewhere(packed: _Packed, index: int) -> Outcome:
    return rollout(_unpacked(packed), index, record=False)


def from_held(task: Task, held: Any) -> Task:
    """The task of the drawn rollouts: where the arm has the tool in its hand (``held``), as it had it in the first one."""
    return task if held is None else replace(task, held=held, start=held.time)


def _least_more(passed: int, count: int, most: int, required: float, z: float) -> int:
    """How many further rollouts it takes at least until it is decided."""
    for more in range(1, most - count + 1):
        if decided(passed + more, count + more, most, required, z) or decided(passed, count + more, most, required, z):
            return more
    return most - count


class _Elsewhere:
    """Rollouts that a pool's processes compute; none where there is no pool, or where one of its processes was killed."""

    def __init__(self, pool: Executor | None, workers: int) -> None:
        self._pool, self._workers = pool, workers
        self._packed: _Packed | None = None
        self._waiting: dict[int, Future[Outcome]] = {}
        #: The lowest number that nobody computes yet.
        self.following = 1

    def begin(self, task: Task, end: int) -> None:
        """Have rollouts of a task computed, those below ``end`` at most."""
        if self._pool is not None and self.following < end:
            self._packed = _Packed.of(task)
            self.fill(end)

    def fill(self, end: int) -> None:
        """Give out what can be: one more than there are processes, so that none waits for this one to look round."""
        while self._pool is not None and self._packed is not None and self.following < end and len(self._waiting) <= self._workers:
            try:
                self._waiting[self.following] = self._pool.submit(_elsewhere, self._packed, self.following)
            except RuntimeError:  # a process was killed, or the pool is closed: this one does it all
                self._pool = None
                return
            self.following += 1

    def done(self) -> dict[int, Outcome | None]:
        """What has been computed since this was last asked; ``None`` for what was lost with its process."""
        found: dict[int, Outcome | None] = {}
        for index in [i for i, future in self._waiting.items() if future.done()]:
            future = self._waiting.pop(index)
            if isinstance(future.exception(), BrokenExecutor):
                self._pool = None
                found[index] = None
            else:
                found[index] = future.result()
        return found

    def wait(self, index: int) -> None:
        """Wait for one of them, a moment at most."""
        wait([self._waiting[index]], timeout=0.01)

    def end(self) -> None:
        """What has not been begun is not."""
        for future in self._waiting.values():
            future.cancel()


def rollouts(
    task: Task,
    most: int,
    required: float | None,
    pool: Executor | None = None,
    workers: int = 0,
    stop: Any = None,
    progress: Callable[[str, float], None] | None = None,
    z: float = Z95,
) -> list[Outcome]:
    """The outcomes of the rollouts in the order of their numbers, until it is decided whether the required rate is reached (``None``: all
    of them); of one that fails in the scene as given that one alone.  z: of the interval, in standard deviations.

    With a pool others compute some of them meanwhile, to the same outcomes, none beyond those that are needed at least if the scene as
    given passes: which ones are computed where depends on who is ready first, what comes of them does not.  They begin beside the scene
    as given, as soon as is known what it has to tell of them: of the arm, how it has the tool in its hand.
    """
    stop = stop or _Never()
    elsewhere = _Elsewhere(pool, workers)
    found: dict[int, Outcome | None] = {}

    def needed(passed: int, count: int) -> int:
        return most if required is None else count + _least_more(passed, count, most, required, z)

    others = task

    def begin(known: Task) -> None:
        nonlocal others
        others = known
        elsewhere.begin(others, needed(1, 1))

    try:
        first = rollout(task, 0, stop, progress, begin=begin)
        outcomes, passed = [first], int(first.judgement.code == Code.OK)
        if not passed:
            return outcomes
        task = others
        while len(outcomes) < most:
            if required is not None and len(outcomes) > 1 and decided(passed, len(outcomes), most, required, z):
                break
            end = needed(passed, len(outcomes))
            found.update(elsewhere.done())
            elsewhere.fill(end)
            index = len(outcomes)
            if found.get(index) is not None:
                outcomes.append(found.pop(index))  # type: ignore[arg-type]
                passed += outcomes[-1].judgement.code == Code.OK
            elif index in found:
                found[index] = rollout(task, index, stop, progress, record=False)
            elif elsewhere.following < end:
                elsewhere.following += 1
                found[elsewhere.following - 1] = rollout(task, elsewhere.following - 1, stop, progress, record=False)
            else:
                stop.check(0.0)
                elsewhere.wait(index)
    finally:
        elsewhere.end()
    return outcomes


def make_task(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...],
    table: NDArray[np.float64],
    plan: MotionPlan,
    seed: int = 0,
    settings: Settings | None = None,
    spreads: Uncertainty | None = None,
    limits: Limits | None = None,
    arm_options: Any = None,
    robot: Description | None = None,
) -> Task:
    """What the rollouts of a verdict are a function of; arguments and errors as :func:`verify` has them."""
    if not strategy.simulatable:
        raise MagicError(Code.NOT_VERIFIABLE, f"strategy {strategy.name}", "says that simulation cannot judge it", "simulatable: true")
    goals.require(strategy)
    if plan.variant == "arm" and robot is None:
        from magic_verifier.articulation import panda

        robot = panda()
    motion_check.check(plan, robot)
    setup = make_setup(tool, target, obstacles, table, strategy.physics, settings or DEFAULTS[plan.variant])
    spreads = spreads or uncertainty.read()
    eyes = spreads.eyes(tool), spreads.eyes(target)
    start = _start(strategy, setup, plan)
    hard = arm_options is not None and arm_options.past is not None  # what contacts alone hold hangs on how long a step is
    longer = 1.0 if hard else _longer(setup, plan, start)
    shares = uncertainty.shares(tool, eyes[0][1], setup.tool.hulls)
    return Task(
        strategy, setup, plan, limits or Limits(), int(seed), spreads, eyes, arm_options, robot, start, longer=longer, shares=shares
    )


def verify(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...] | list[SceneObject],
    table: NDArray[np.float64],
    candidate: ContactCandidate | None,
    plan: MotionPlan,
    seed: int = 0,
    repetitions: int = 0,
    deadline: float | None = None,
    cancel: Callable[[], bool] | None = None,
    progress: Callable[[str, float], None] | None = None,
    settings: Settings | None = None,
    spreads: Uncertainty | None = None,
    limits: Limits | None = None,
    arm_options: Any = None,
    robot: Description | None = None,
    pool: Executor | None = None,
    workers: int = 1,
    tried: int = 0,
) -> Verdict:
    """Simulate a plan and judge it.

    table (4,) plane with its unit normal up; ``candidate`` goes into no decision and may be ``None``.

    repetitions: rollouts at most (0: :data:`ROLLOUTS`).  The first is the scene as given; if it fails, so does the verdict.  Success
    means that the lower end of the 95 % interval of the success rate is no lower than ``limits.required_rate``; the rollouts end when
    that is decided.  ``repetitions=1`` simulates the scene as given alone and judges by it, whatever the required rate: the interval
    then says how little that is.  ``tried``: motions that were simulated for the same task before this one; the more, the wider is the
    interval (:func:`level`).

    ``spreads``: what is drawn (default: the file that ships); ``deadline``: a moment of ``time.monotonic()``; ``cancel`` is asked every
    few steps; ``progress`` hears phase and simulated time.  ``robot``: the arm of an arm plan, ``None`` for the Panda; ``arm_options``:
    its controller (:class:`ArmOptions`).  ``pool``: processes that compute so many (``workers``) rollouts beside this one.  The same
    seed gives the same verdict, with or without them.
    """
    started = clock.monotonic()
    limits = limits or Limits()
    most = int(repetitions) if repetitions > 0 else ROLLOUTS
    stop = _Stop(deadline, cancel)
    outcomes: list[Outcome] = []

    def elapsed() -> float:
        return clock.monotonic() - started

    def simulated() -> float:
        return float(sum(outcome.simulated for outcome in outcomes))

    try:
        stop.check(0.0)
        task = make_task(strategy, tool, target, tuple(obstacles), table, plan, seed, settings, spreads, limits, arm_options, robot)
        outcomes = rollouts(task, most, limits.required_rate, pool, workers, stop, progress, _z(tried))
        passed = sum(outcome.judgement.code == Code.OK for outcome in outcomes)
        shown = _shown(outcomes, passed, most, limits.required_rate, _z(tried))
        if shown > 0:  # recording costs, and of the drawn rollouts one is looked at: the same again, recorded
            outcomes[shown] = rollout(from_held(task, outcomes[0].held), shown, stop)
    except MagicError as error:
        runs = tuple(outcome.judgement for outcome in outcomes)
        return Verdict(False, error.code, error.message, 0.0, {}, simulated(), elapsed(), None, runs)
    return _verdict(task, outcomes, most, tried, simulated(), elapsed())


def _shown(outcomes: list[Outcome], passed: int, most: int, required: float, z: float) -> int:
    """Which rollout a verdict shows: the first one that failed where it is a no, else the scene as given."""
    if most == 1 or passed == len(outcomes) or passes(passed, len(outcomes), required, z):
        return 0
    return next(i for i, outcome in enumerate(outcomes) if outcome.judgement.code != Code.OK)


def _verdict(task: Task, outcomes: list[Outcome], most: int, tried: int, simulated: float, seconds: float) -> Verdict:
    judgements = [outcome.judgement for outcome in outcomes]
    passed = [j.code == Code.OK for j in judgements]
    count, good, required = len(passed), sum(passed), task.limits.required_rate
    z = _z(tried)
    low, high = wilson(good, count, z)
    success = passed[0] and (most == 1 or passes(good, count, required, z))
    shown = _shown(outcomes, good, most, required, z)
    failures = reasons(task, judgements)
    code, message = judgements[shown].code, judgements[shown].message
    before = f", for {tried} tried before," if tried else ""
    rate = f"{good} of {count} rollouts passed ({100 * level(tried):.3g} % interval{before} {100 * low:.0f} to {100 * high:.0f} %)"
    if success:
        code = Code.OK
        message += f"; {rate}" if most > 1 else "; the scene as given alone, nothing varied"
    elif passed[0]:
        wanted = f"needed: lower end no lower than {100 * required:g} %"
        if good == count:
            code, message = Code.NOT_SURE_ENOUGH, f"too few rollouts to be sure: {rate}, {wanted}"
        else:
            code = _commonest(judgements)
            message = f"passes in the scene as given, but not surely enough: {rate}, {wanted}; {'; '.join(failures)}"
    if success and failures:
        message += f"; {'; '.join(failures)}"
    metrics = dict(judgements[shown].metrics)
    if count > 1:  # what the drawn rollouts found of it, in shares
        for name in ("holds", "holds_in_stronger_noise"):
            found = [j.metrics[name] for j in judgements if name in j.metrics]
            if found:
                metrics[f"{name}_rate"] = float(np.mean(found))
    return Verdict(
        success, code, message, good / count, metrics, simulated, seconds, outcomes[shown].recording, tuple(judgements), low, high, failures
    )


def _commonest(judgements: list[Judgement]) -> Code:
    return Counter(j.code for j in judgements if j.code != Code.OK).most_common(1)[0][0]


def reasons(task: Task, judgements: list[Judgement]) -> tuple[str, ...]:
    """Why rollouts failed, commonest first: "3 of 20: the target slid off sideways, at friction below 0.14".

    A parameter is named where it separates: all rollouts that failed so are on one side of all that passed, and by chance
    that would hardly happen to any of the parameters.
    """
    count = len(judgements)
    causes = Counter(j.cause for j in judgements if j.code != Code.OK)
    found = []
    for cause, times in causes.most_common():
        separation = ""
        bad = [i for i, j in enumerate(judgements) if j.code != Code.OK and j.cause == cause and i > 0]
        good = [i for i, j in enumerate(judgements) if j.code == Code.OK and i > 0]
        if bad and good:
            values = {i: task.drawn(i).values(task.setup) for i in (*bad, *good)}  # type: ignore[union-attr]
            names = list(values[bad[0]])
            if 2 * len(names) / math.comb(len(bad) + len(good), len(bad)) < BY_CHANCE:
                for name in names:
                    separation = _separated([values[i][name] for i in bad], [values[i][name] for i in good], name)
                    if separation:
                        break
        found.append(f"{times} of {count}: {cause}{separation}")
    return tuple(found)


def _separated(bad: list[float], good: list[float], name: str) -> str:
    what, _, unit = name.partition(" in ")
    if max(bad) < min(good):
        return f", at {what} below {(max(bad) + min(good)) / 2:.3g} {unit}".rstrip()
    if min(bad) > max(good):
        return f", at {what} above {(min(bad) + max(good)) / 2:.3g} {unit}".rstrip()
    return ""
