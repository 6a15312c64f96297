"""One rollout: a plan run once in physics, in the scene as given or as it was drawn to be, and judged by the strategy's goal.

A drawn one (:mod:`magic_verifier.uncertainty`) begins where the tool comes near anything; an arm takes hold of a seen tool before.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.robot import Description
from magic_core.strategy import Strategy
from magic_verifier import goals, uncertainty
from magic_verifier.displacement import Place
from magic_verifier.floating import TABLE, TARGET, TOOL, Body, FloatingRun, Setup, phase_start
from magic_verifier.goals import Judgement, Watch
from magic_verifier.predicates import ARM, FINGERS
from magic_verifier.simulation import DYNAMIC, STATIC
from magic_verifier.uncertainty import Draw, Eyes, Uncertainty

#: Deadline and cancel request are looked at, and the state checked, every so many steps.
CHECK_EVERY = 12
#: Whether the tool touches anything too early is looked at every so many seconds.
TOUCH_EVERY = 0.025
#: Poses are recorded at this rate (Hz).
RECORD_RATE = 30.0
#: A drawn rollout of a tool that cameras saw begins with its grasp, from so many seconds before the fingers close until so many after.
BEFORE_GRASP, AFTER_GRASP = 0.6, 1.0
#: How an arm's hand yields (N/m): a usual stiffness of Cartesian impedance control.
STIFFNESS = 2000.0


@dataclass(frozen=True)
class Limits:
    """What a motion may do apart from its goal.

    overlap: depth in metres to which the tool may be in static things before the contact phase,
    in a fixed target when it is let go (reconstructions are that uncertain, and a touch is an
    overlap of about nothing), and in the table at any time; press: the same for other static
    things after the contact phase has begun, where the tool may well slide along them; shove (m): how far a loose thing that has no
    part in the motion may be moved at any time, or a tool that is led may go into it; nudge
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
    shove: float = 0.005
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
class Task:
    """Everything that a rollout is a function of, beside its number: it may be sent to another process.

    ``eyes``: how well tool and target are known, and by how much these widths are to be multiplied; ``start``: the moment of the
    motion at which drawn rollouts begin; ``held``: the tool in the arm's hand at that moment; ``overlap``: how deep the tool that is led
    goes into things as it was planned, m, where that is known; ``longer``: how many times as long their steps are; ``offset``: the contact
    offset of their worlds, and of tool and target in the arm's scene as given as soon as it holds the tool, m (``None``: that of the scene
    as given); ``shares``: how much of what is drawn of the tool's surface its corners are shifted by
    (:func:`magic_verifier.uncertainty.shares`).
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
    offset: float | None = None
    shares: tuple[NDArray[np.float64], ...] | None = None

    def drawn(self, index: int) -> Draw | None:
        """The draw of a rollout; ``None`` for the first one."""
        return None if index == 0 else uncertainty.draw(self.uncertainty, *self.eyes, self.seed, index)

    def under(self, drawn: Draw) -> Setup:
        """The scene of a drawn rollout."""
        setup = uncertainty.applied(drawn, self.setup, self.shares)
        offset = setup.settings.contact_offset if self.offset is None else self.offset
        settings = replace(setup.settings, frequency=setup.settings.frequency / self.longer, contact_offset=offset)
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


class Stop:
    """When a simulation is to end before its time: at a deadline (of ``time.monotonic``) or a request to cancel; never where there is
    neither."""

    def __init__(self, deadline: float | None = None, cancel: Callable[[], bool] | None = None) -> None:
        self._deadline = deadline
        self._cancel = cancel

    def check(self, simulated: float) -> None:
        """Raises CANCELED or SIMULATION_TIMEOUT, with how many seconds were simulated."""
        if self._cancel is not None and self._cancel():
            raise MagicError(Code.CANCELED, f"canceled after {simulated:.2f} simulated seconds")
        if self._deadline is not None and clock.monotonic() > self._deadline:
            raise MagicError(Code.SIMULATION_TIMEOUT, f"out of time after {simulated:.2f} simulated seconds")


def rollout(
    task: Task,
    index: int,
    stop: Stop | None = None,
    progress: Callable[[str, float], None] | None = None,
    record: bool = True,
    begin: Callable[[Task], None] | None = None,
) -> Outcome:
    """One rollout, a function of ``task`` and ``index`` alone.  ``begin`` hears of the first one, as soon as it is known, the task of the
    others: how the arm has the tool in its hand at the task's start, or how deep the tool goes into things.  Raises for cancel and deadline
    only."""
    this = _Rollout(task, index, stop or Stop(), progress, record, begin)
    try:
        judgement = this.judged()
    except MagicError as error:
        if error.code in (Code.CANCELED, Code.SIMULATION_TIMEOUT):
            raise
        judgement = Judgement(error.code, error.message, this.metrics())
        if error.code == Code.SIMULATION_EXPLODED:
            this.recorder = None
    recording = None if this.recorder is None else this.recorder.recording()
    return Outcome(judgement, recording, this.simulated(), this.held)


class _Rollout:
    """A rollout on its way; arguments as :func:`rollout` has them."""

    def __init__(
        self,
        task: Task,
        index: int,
        stop: Stop,
        progress: Callable[[str, float], None] | None,
        record: bool,
        begin: Callable[[Task], None] | None,
    ) -> None:
        self._task, self._index, self._stop, self._progress, self._record, self._begin = task, index, stop, progress, record, begin
        self._drawn = task.drawn(index)
        self._limits = task.limits if self._drawn is None else task.limits.yielding()
        self._run: Any = None
        self._grasped = 0.0  # simulated seconds of the grasp before the run
        self._overlaps: dict[str, float] = {}
        self.recorder: _Recorder | None = None
        self.held: Any = None

    def simulated(self) -> float:
        """Simulated seconds until now."""
        return self._grasped + (float(self._run.world.time) if self._run is not None else 0.0)

    def metrics(self) -> dict[str, float]:
        """What was measured until now apart from the goal."""
        return self._overlaps if self._run is None else {**self._overlaps, **getattr(self._run, "metrics", dict)()}

    def judged(self) -> Judgement:
        """Run the plan and judge it; raises what ends it before, and for cancel and deadline."""
        task, drawn = self._task, self._drawn
        self._stop.check(0.0)
        run = self._run = self._new_run()
        nudge = None if drawn is None else drawn.nudge
        goal = goals.goal_test(task.strategy, run, np.random.default_rng([task.seed, self._index, 1]), nudge)
        self.recorder = _Recorder(run) if self._record else None
        if task.plan.variant == "arm":
            run.stands_still = goal.leaves_alone(TOOL)
        else:
            measured = self._record or drawn is None
            self._overlaps = _refuse_intrusions(task.strategy, run, self._limits, self._stop, measured, task.overlap)
            if drawn is None and self._begin is not None:
                self._begin(replace(task, overlap=self._overlaps["overlap"]))
        self._run_to(goal)
        judgement = goal.judge(self._run_on)
        return replace(judgement, metrics={**self.metrics(), **judgement.metrics})

    def _new_run(self) -> Any:
        task, drawn = self._task, self._drawn
        setup = task.setup if drawn is None else task.under(drawn)
        if task.plan.variant == "arm":
            taken_anew = None
            if drawn is not None and _grasp_is_drawn(task):
                self._grasped, taken_anew = _take_hold(task, drawn, self._limits, self._stop)
            return _arm_run(task, setup, drawn, taken_anew)
        if drawn is None:
            return FloatingRun(setup, task.plan)
        return FloatingRun(setup, task.plan, _moving_from(task, setup), drawn.tool_from_held, task.setup.tool)

    def _run_to(self, goal: Watch) -> None:
        """Run until the moment at which the goal is to be judged; raises where the tool does before what it may not."""
        run, task, setup = self._run, self._task, self._run.setup
        end = goal.until()
        arm = task.plan.variant == "arm"
        # A kinematic tool touches nothing static, see _refuse_intrusions.
        watched = [TARGET] if setup.target_kind == DYNAMIC or arm else []
        watched += [o.id for o in setup.obstacles] if arm else []
        touch_every = max(1, round(TOUCH_EVERY * setup.settings.frequency))
        # A thing that was seen to stand may roll off where its centre of mass or its shape was drawn otherwise.
        untouched = _Untouched(run, self._limits) if self._drawn is None else None
        others = _Others(run, self._limits)
        # The run's clock stands still while a gripper closes: the number of steps is bounded apart from it.
        for step in range(int(np.ceil((end + 10.0) * setup.settings.frequency))):
            if run.time >= end - 1e-9:
                break
            goal.disturb()
            self._advance(step)
            if untouched is not None:
                untouched.check(goal.kicks)
            goal.observe()
            if arm and self._drawn is None and self.held is None and run.time >= task.start:
                self._note_held()
            if step % touch_every == 0 and run.time < run.contact_time:
                _refuse_early_touch(run, watched, self._limits)
            if step % touch_every == 0:
                others.check()
        run.world.check(self._moving())

    def _run_on(self, seconds: float) -> None:
        """Run further, as a goal's test asks."""
        for step in range(round(seconds * self._run.setup.settings.frequency)):
            self._advance(step)
        self._run.world.check(self._moving())

    def _advance(self, step: int) -> None:
        run = self._run
        run.advance()
        if self.recorder is not None:
            self.recorder.observe()
        if step % CHECK_EVERY == 0:
            self._stop.check(self.simulated())
            run.world.check(self._moving())
            if self._progress is not None and step % (CHECK_EVERY * 10) == 0:
                self._progress(run.phase, run.time)

    def _moving(self) -> tuple[str, ...]:
        """What has to be somewhere."""
        return (TOOL, TARGET) if self._run.setup.target_kind == DYNAMIC else (TOOL,)

    def _note_held(self) -> None:
        """Keep how the arm has the tool in its hand, once it has, for the drawn rollouts."""
        self.held = self._run.held()
        if self.held is not None and self._begin is not None:
            self._begin(from_held(self._task, self.held))


def from_held(task: Task, held: Any) -> Task:
    """The task of the drawn rollouts: where the arm has the tool in its hand (``held``), as it had it in the first one."""
    return task if held is None else replace(task, held=held, start=held.time)


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


def _refuse_intrusions(
    strategy: Strategy, run: FloatingRun, limits: Limits, stop: Stop, measured: bool, planned: float = np.inf
) -> dict[str, float]:
    """Raise where the planned tool goes through static things; returns what was measured.

    Where that is not to be ``measured``, for it is shown to nobody, what is allowed in any case need not be found; ``planned``: what was of
    the tool as it is thought to be, m.
    """
    loose = {o.id for o in run.setup.obstacles if o.loose}
    harmless = min(limits.overlap, limits.press, limits.shove if loose else np.inf)
    found = run.intrusions(check=stop.check, harmless=0.0 if measured else harmless, planned=planned)
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
        if item.body in loose and item.depth > limits.shove:
            raise MagicError(
                Code.OBSTACLE_PUSHED,
                f"the tool goes through {item.body} at {item.time:.2f} s",
                f"{item.depth * 1000:.1f} mm deep",
                f"up to {limits.shove * 1000:g} mm",
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
    """Raise where, before the contact phase, tool or hand have pushed a free target away or the tool presses on something fixed.

    A touch that moves nothing is allowed: the target is then still where the contact was planned.
    """
    for name in watched:
        free = name == TARGET and run.setup.target_kind == DYNAMIC
        by = next((part for part in ((TOOL, FINGERS, ARM) if free else (TOOL,)) if run.world.touching(part, name, 0.0)), None)
        if by is None:
            continue
        if free:
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
            f"the {'hand' if by == FINGERS else by} hit the {name} at {run.time:.2f} s, before the contact phase at {run.contact_time:.2f} s",
            value,
            allowed,
        )


class _Others:
    """Refuses a motion that moves loose things which have no part in it.  Each stands where it was seen until something that moves touches
    it."""

    def __init__(self, run: Any, limits: Limits) -> None:
        self._run, self._limits = run, limits
        self._resting = [o.id for o in run.setup.obstacles if o.loose]
        self._corners = {o.id: o.outermost for o in run.setup.obstacles if o.loose}
        self._stood: dict[str, tuple[Place, str]] = {}  # where what is free stood, and what has touched it

    def check(self) -> None:
        """Every few steps."""
        world = self._run.world
        for name in self._resting:
            touched = world.touched_by(name)
            if touched:
                world.let_go(name)
                place = Place(self._corners[name], world.pose(name), world.centre_of_mass(name), self._run.setup.table[:3])
                self._stood[name] = place, " and ".join(touched)
        self._resting = [name for name in self._resting if name not in self._stood]
        for name, (place, pusher) in self._stood.items():
            moved = place.left_by(world.pose(name), world.centre_of_mass(name))
            if not moved <= self._limits.shove:
                raise MagicError(
                    Code.OBSTACLE_PUSHED,
                    f"{name} is pushed by the {pusher} at {self._run.time:.2f} s ({self._run.phase})",
                    f"moved {moved * 1000:.1f} mm",
                    f"up to {self._limits.shove * 1000:g} mm",
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


def _moving_from(task: Task, setup: Setup) -> float:
    """Where a drawn floating rollout begins to step: a tool that only its release makes free meets nothing that moves before it."""
    release = phase_start(task.plan.tool_motion.phases, ("release",))
    if setup.target_kind == STATIC and release is not None:
        return release
    return task.start


def _grasp_is_drawn(task: Task) -> bool:
    """Whether drawn rollouts take hold of the tool anew: of one whose shape cameras gave, which is not in the hand when the plan begins."""
    motion = task.plan.arm_motion
    return motion is not None and motion.grasp_time > 0 and _seen(task)


def _seen(task: Task) -> bool:
    """Whether cameras gave the tool's shape and pose."""
    return task.eyes[0][0] == task.uncertainty.camera


def _take_hold(task: Task, drawn: Draw, limits: Limits, stop: Stop) -> tuple[float, Any]:
    """The grasp of a drawn rollout, the tool on the table as far off as it is drawn to be in the hand and shaped as drawn
    (:func:`standing`): simulated seconds, and how the pads have it.

    What is seen of a lying thing is its top: how steep its sides are, between which the fingers close, is the reconstruction's guess.
    Steps are short, as closing fingers bear no longer ones.  Raises as the run does.
    """
    from magic_verifier.arm_simulation import ArmRun

    motion = task.plan.arm_motion
    assert motion is not None
    setup = replace(task, longer=1.0, offset=None).under(drawn)
    setup = replace(setup, tool=standing(setup.tool, task.setup.tool, drawn.tool_from_held, setup.table))
    begin, end = max(motion.grasp_time - BEFORE_GRASP, 0.0), min(motion.grasp_time + AFTER_GRASP, task.start)
    run = ArmRun(setup, task.plan, _drawn_options(task, drawn), limits, task.robot, None, drawn.lag, begin, rests=True)
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
    """A tool of a drawn shape on the table (4,), displaced from where it was ``seen`` along the table and about the vertical alone, by what
    is drawn.

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
        return ArmRun(setup, task.plan, task.arm_options or ArmOptions(), task.limits, task.robot, rests=_seen(task), offset=task.offset)
    options, limits = _drawn_options(task, drawn), task.limits.yielding()
    if options.past is not None:  # what contacts alone have taken hold of has no state that could be begun from
        return ArmRun(setup, task.plan, options, limits, task.robot, None, drawn.lag)
    if taken_anew is None:
        held = replace(task.held, tool_from_tcp=transforms.inverse(drawn.tool_from_held) @ task.held.tool_from_tcp)
    else:
        # Fingers that close turn a tool until its sides lie along the pads, whatever way they were seen to go.  A tool on the table was
        # off along it alone: the rest of what is drawn comes now.  On the way it creeps as it did in the scene as given.
        _, off_it = along_table(drawn.tool_from_held, task.setup.tool.world_from_object[:3, :3].T @ setup.table[:3])
        crept = transforms.inverse(task.held.taken) @ task.held.tool_from_tcp
        held = replace(taken_anew, time=task.held.time, tool_from_tcp=transforms.inverse(off_it) @ taken_anew.taken @ crept)
    return ArmRun(setup, task.plan, options, limits, task.robot, held, drawn.lag)
