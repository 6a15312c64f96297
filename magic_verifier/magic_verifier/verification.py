"""Run a plan in physics and judge it by the strategy's goal.

:func:`verify_proposal` is the one entry point: it never raises for anything that the scene,
the plan or the simulation may bring up, but answers a :class:`Verdict` with a code
and a sentence, within its deadline.

A verdict is a set of rollouts (:mod:`magic_verifier.rollout`).  The first is the scene as given, the whole motion; each
further one is a draw of what is not known (:mod:`magic_verifier.uncertainty`), from where
the tool comes near anything; an arm takes hold of a seen tool before.  The rollouts end as soon as the interval of the success
rate lies on one side of the rate that is required (:mod:`magic_verifier.rates`).
"""

from __future__ import annotations

import math
import pickle
import time as clock
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, wait
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.robot import Description
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Strategy
from magic_verifier import goals, motion_check, uncertainty
from magic_verifier.floating import CONTACT_PHASES, Setup, make_setup, nears, phase_start, speed
from magic_verifier.goals import Judgement
from magic_verifier.rates import Z95, decided, deviations, level, passes, wilson
from magic_verifier.rollout import Limits, Outcome, Recording, Stop, Task, from_held, rollout
from magic_verifier.simulation import DYNAMIC, LEAST_FREQUENCY, Settings
from magic_verifier.uncertainty import Uncertainty

#: Solver settings of the variants: a grip needs more iterations than a floating tool.
DEFAULTS = {"fg": Settings(), "arm": Settings(position_iterations=8, velocity_iterations=1, contact_offset=0.002)}
#: Rollouts at most, where the caller names no number: up to two of so many may fail (see ``Limits.required_rate``).
ROLLOUTS = 24
#: A drawn rollout begins so many seconds before the box of one of the tool's pieces comes within so many metres of one of anything but
#: the table, with a floating gripper of the target: more than what is drawn may displace them.
LEAD, NEAR = 0.1, 0.03
#: A drawn rollout takes steps so many times as long as the scene as given: the longest for which the tool is slow enough (:func:`_longer`).
LONGER = {"fg": (4.0, 2.0), "arm": (2.0,)}
#: Where the arm moves a free ball contacts are solved ahead of a touch as far as the tool at its fastest, or the ball in a fall, comes in a
#: step, and no less than twice this (m), what goals take for a touch: every piece of a bowl that its ball is near to costs, touched or not.
#: Faces that meet faces find fewer of their points so, and a cylinder that hardly stays in its hook may do otherwise (1 of 26 draws).
LEAST_OFFSET = goals.TOUCH / 2
#: A parameter is named as the cause of failures if as clean a separation by any of the parameters had a chance of less than this.
BY_CHANCE = 0.05


@dataclass(frozen=True)
class Proposal:
    """A plan in its scene, and under which physics and limits it is judged: all that its rollouts are a function of.

    table (4,): plane with its unit normal up.  seed: of the draws.  settings: of the solver (``None``: :data:`DEFAULTS`).  spreads: what is
    drawn (``None``: the file that ships).  robot: the arm of an arm plan (``None``: the Panda); arm_options: its controller
    (:class:`magic_verifier.articulation.ArmOptions`).
    """

    strategy: Strategy
    tool: SceneObject
    target: SceneObject
    obstacles: Sequence[SceneObject]
    table: NDArray[np.float64]
    plan: MotionPlan
    seed: int = 0
    settings: Settings | None = None
    spreads: Uncertainty | None = None
    limits: Limits = field(default_factory=Limits)
    arm_options: Any = None
    robot: Description | None = None


@dataclass(frozen=True)
class Verdict:
    """The answer: code OK exactly where success.

    success_rate over the rollouts with its interval (rate_low, rate_high), 95 % or what :func:`magic_verifier.rates.level` says; failures:
    reasons of the failing ones with their counts; runs: what each rollout came to, the scene as given first; metrics and recording of the
    judged run (the first one that failed, else the first); simulated seconds over all runs, seconds of wall time.
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


def verify_proposal(
    proposal: Proposal,
    repetitions: int = 0,
    tried: int = 0,
    deadline: float | None = None,
    cancel: Callable[[], bool] | None = None,
    progress: Callable[[str, float], None] | None = None,
    pool: Executor | None = None,
    workers: int = 1,
) -> Verdict:
    """Simulate a plan and judge it.

    repetitions: rollouts at most (0: :data:`ROLLOUTS`).  The first is the scene as given; if it fails, so does the verdict.  Success
    means that the lower end of the 95 % interval of the success rate is no lower than ``limits.required_rate``; the rollouts end when
    that is decided.  ``repetitions=1`` simulates the scene as given alone and judges by it, whatever the required rate: the interval
    then says how little that is.  ``tried``: motions that were simulated for the same task before this one; the more, the wider is the
    interval (:func:`magic_verifier.rates.level`).

    ``deadline``: a moment of ``time.monotonic()``; ``cancel`` is asked every few steps; ``progress`` hears phase and simulated time.
    ``pool``: processes that compute so many (``workers``) rollouts beside this one.  The same proposal gives the same verdict, with or
    without them.
    """
    started = clock.monotonic()
    most = int(repetitions) if repetitions > 0 else ROLLOUTS
    required, z = proposal.limits.required_rate, deviations(tried)
    stop = Stop(deadline, cancel)
    outcomes: list[Outcome] = []
    try:
        stop.check(0.0)
        task = make_task(proposal)
        outcomes = rollouts(task, most, required, pool, workers, stop, progress, z)
        passed = sum(outcome.judgement.code == Code.OK for outcome in outcomes)
        shown = _shown(outcomes, passed, most, required, z)
        if shown > 0:  # recording costs, and of the drawn rollouts one is looked at: the same again, recorded
            outcomes[shown] = rollout(from_held(task, outcomes[0].held), shown, stop)
    except MagicError as error:
        runs = tuple(outcome.judgement for outcome in outcomes)
        return Verdict(False, error.code, error.message, 0.0, {}, _simulated(outcomes), clock.monotonic() - started, None, runs)
    return _verdict(task, outcomes, most, tried, _simulated(outcomes), clock.monotonic() - started)


def verify(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    obstacles: Sequence[SceneObject],
    table: NDArray[np.float64],
    candidate: ContactCandidate | None,
    plan: MotionPlan,
    seed: int = 0,
    **options: Any,
) -> Verdict:
    """:func:`verify_proposal` for a caller that has the parts of a :class:`Proposal`, as a script has them; options: those of both.

    ``candidate``, the contact that the plan was made for, goes into no verdict.
    """
    proposed = {name: options.pop(name) for name in ("settings", "spreads", "limits", "arm_options", "robot") if name in options}
    return verify_proposal(Proposal(strategy, tool, target, obstacles, table, plan, seed, **proposed), **options)


def _simulated(outcomes: list[Outcome]) -> float:
    return float(sum(outcome.simulated for outcome in outcomes))


def make_task(proposal: Proposal) -> Task:
    """What the rollouts of a verdict are a function of.  Raises NOT_VERIFIABLE for a strategy that simulation cannot judge, and what the
    checks of goal, motion and scene raise."""
    strategy, plan, robot = proposal.strategy, proposal.plan, proposal.robot
    if not strategy.simulatable:
        raise MagicError(Code.NOT_VERIFIABLE, f"strategy {strategy.name}", "says that simulation cannot judge it", "simulatable: true")
    goals.require(strategy)
    if plan.variant == "arm" and robot is None:
        from magic_verifier.articulation import panda

        robot = panda()
    motion_check.check(plan, robot)
    settings = proposal.settings or DEFAULTS[plan.variant]
    setup = make_setup(proposal.tool, proposal.target, tuple(proposal.obstacles), proposal.table, strategy.physics, settings)
    spreads = proposal.spreads or uncertainty.read()
    eyes = spreads.eyes(proposal.tool), spreads.eyes(proposal.target)
    start = _start(strategy, setup, plan)
    options = proposal.arm_options
    hard = options is not None and options.past is not None  # what contacts alone hold hangs on how long a step is
    longer = 1.0 if hard else _longer(setup, plan, start)
    rolls = setup.target_kind == DYNAMIC and all(setup.target.balls)
    return Task(
        strategy,
        setup,
        plan,
        proposal.limits,
        int(proposal.seed),
        spreads,
        eyes,
        options,
        robot,
        start,
        longer=longer,
        offset=_offset(setup, plan, start, longer) if rolls and not hard else settings.contact_offset,
        shares=uncertainty.shares(proposal.tool, eyes[0][1], setup.tool.hulls),
    )


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


def _offset(setup: Setup, plan: MotionPlan, start: float, longer: float) -> float:
    """The contact offset (m) of drawn rollouts: half of how far the tool, or a ball that begins to fall, comes in one of their steps,
    between :data:`LEAST_OFFSET` and that of the scene as given."""
    settings = setup.settings
    step = longer / settings.frequency
    come = max(speed(plan.tool_motion, setup.tool, start) * step, settings.gravity * step**2)
    return min(settings.contact_offset, max(LEAST_OFFSET, come / 2))


def rollouts(
    task: Task,
    most: int,
    required: float | None,
    pool: Executor | None = None,
    workers: int = 0,
    stop: Stop | None = None,
    progress: Callable[[str, float], None] | None = None,
    z: float = Z95,
) -> list[Outcome]:
    """The outcomes of the rollouts in the order of their numbers, until it is decided whether the required rate is reached (``None``: all
    of them); of one that fails in the scene as given that one alone.  z: of the interval, in standard deviations.

    With a pool others compute some of them meanwhile, to the same outcomes, none beyond those that are needed at least if the scene as
    given passes: which ones are computed where depends on who is ready first, what comes of them does not.  They begin beside the scene
    as given, as soon as is known what it has to tell of them: of the arm, how it has the tool in its hand.
    """
    stop = stop or Stop()
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
        """Give out what can be: one more than there are processes, so that none waits for this one to look round, but not the last one that
        is
        left: this process would wait for it, while another is still at what it was given before."""
        while self._pool is not None and self._packed is not None and len(self._waiting) < self._most(end):
            try:
                self._waiting[self.following] = self._pool.submit(_elsewhere, self._packed, self.following)
            except RuntimeError:  # a process was killed, or the pool is closed: this one does it all
                self._pool = None
                return
            self.following += 1

    def _most(self, end: int) -> int:
        """How many may be given out, with what is."""
        left = end - self.following
        return self._workers + (left > 1) if left > 0 else 0

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


def _shown(outcomes: list[Outcome], passed: int, most: int, required: float, z: float) -> int:
    """Which rollout a verdict shows: the first one that failed where it is a no, else the scene as given."""
    if most == 1 or passed == len(outcomes) or passes(passed, len(outcomes), required, z):
        return 0
    return next(i for i, outcome in enumerate(outcomes) if outcome.judgement.code != Code.OK)


def _verdict(task: Task, outcomes: list[Outcome], most: int, tried: int, simulated: float, seconds: float) -> Verdict:
    judgements = [outcome.judgement for outcome in outcomes]
    passed = [j.code == Code.OK for j in judgements]
    count, good, required = len(passed), sum(passed), task.limits.required_rate
    z = deviations(tried)
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
