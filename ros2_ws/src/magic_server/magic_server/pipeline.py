"""The order of work of one run: match, then plan and verify until physics agrees (paper, III-D).

No ROS here.  The three stages come in as an object with the methods of
:class:`Stages`; candidates, plans and pictures pass through untouched, so that the
server can hand on messages as they came.  Candidates are taken best first.  For
each, the reflections of the strategy are tried where the match was mirrored, and
with an arm several attempts (grasps).  The first motion that physics passes without
fail ends the run; where some of its rollouts failed, a surer one is looked for among the
next (:class:`Choice`).  Every trial leaves a :class:`Report` with its reason.  While a motion
is verified, the plan that comes next if it fails is begun; what is tried, in which
order, and what is said of it are the same as one after the other.
"""

from __future__ import annotations

import copy
import heapq
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from magic_core.errors import Code, MagicError
from magic_core.motion import VARIANTS
from magic_server.permission import Verdict

STAGES = ("perceive", "match", "plan", "verify")

#: Failures that no other candidate can mend: they end the run.
FATAL = frozenset(
    {
        Code.UNKNOWN_STRATEGY,
        Code.BAD_STRATEGY,
        Code.UNKNOWN_OBJECT,
        Code.UNKNOWN_VARIANT,
        Code.UNKNOWN_GOAL,
        Code.UNKNOWN_FEATURES,
        Code.FEATURE_WEIGHTS,
        Code.SERVER_UNAVAILABLE,
        Code.SERVER_TIMEOUT,
        Code.CANCELED,
        Code.BUSY,
        Code.NOT_VERIFIABLE,
        Code.BAD_REQUEST,
        Code.NOT_ALONE,
        # The arm stands where it stands, whatever is tried next.
        Code.START_IN_COLLISION,
    }
)

#: Failures of planning after which the next attempt would fail in the same way.
EXHAUSTED = frozenset({Code.NO_GRASP, Code.NO_IK, Code.PATH_IN_COLLISION, Code.BAD_MESH, Code.BAD_MOTION, Code.INTERNAL})


class HopelessError(MagicError):
    """A failure that no other candidate can mend, whatever its code: it ends the run."""


#: Failures of the grasp alone: the same contact gets its next grasp at once.
GRASP_ONLY = frozenset({Code.GRASP_SLIPPED})


@dataclass(frozen=True)
class Request:
    """One run.  tool_id and target_id are ids, names in words (:mod:`magic_core.naming`, :mod:`magic_core.open_words`) or empty: the
    matcher chooses. timeout in seconds for everything.  tool_mass, target_mass: kg, 0 where nobody knows."""

    strategy: str
    variant: str
    tool_id: str = ""
    target_id: str = ""
    top_k: int = 3
    seed: int = 0
    timeout: float = 120.0
    allow_unverified: bool = False
    tool_mass: float = 0.0
    target_mass: float = 0.0


@dataclass(frozen=True)
class Settings:
    """attempts: how many grasps are tried for one contact (arm); reserve: the share of a budget in seconds below
    which no further trial is begun."""

    attempts: int = 3
    reserve: float = 0.2


@dataclass(frozen=True)
class Matches:
    """What the matcher answered, best candidate first; a candidate has ``flipped``, ``score`` and ``tool_id``.

    doubts: why the objects themselves may be at fault where nothing succeeds, a sentence each.
    """

    candidates: Sequence[Any]
    target_id: str
    features: str = ""
    heatmap: Any = None
    message: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Trial:
    """One thing to try: a candidate (index from 0), what is done with the tool's face, and which grasp (0 first)."""

    index: int
    candidate: Any
    reflection: str
    attempt: int = 0


@dataclass(frozen=True)
class Planned:
    """What the planner answered; ``plan`` counts only where the code is OK.  state_known: whether it begins where the arm was heard to be;
    else at home."""

    code: Code
    message: str = ""
    plan: Any = None
    state_known: bool = True


@dataclass(frozen=True)
class Report:
    """What became of one trial: the last stage that it reached, with code and reason there, and what the verifier said if it was asked."""

    trial: Trial
    stage: str
    code: Code
    message: str
    plan: Any = None
    verdict: Verdict | None = None


@dataclass(frozen=True)
class _Passed:
    """A motion that may be taken."""

    report: Report
    planned: Planned

    @property
    def rate(self) -> float:
        """The share of its rollouts that passed; 1 where there were none."""
        verdict = self.report.verdict
        return verdict.success_rate if verdict is not None and verdict.rollouts else 1.0


@dataclass(frozen=True)
class Progress:
    """Where the run is; ``candidates`` counts those known so far, ``reports`` the trials that are over."""

    stage: str
    candidate: int
    candidates: int
    message: str
    reports: tuple[Report, ...]


@dataclass(frozen=True)
class Outcome:
    """How a run ended.  ``verified`` says that physics agreed, by ``verdict``; only then may the plan be published.

    ``plan`` is also filled in for the best match of a strategy that simulation cannot judge; its code is OK only if the caller allowed
    that. ``state_known`` is the plan's.  ``seconds`` holds the wall time for which the run waited for each stage, and ``total``.
    """

    code: Code
    message: str
    verified: bool = False
    verdict: Verdict | None = None
    plan: Any = None
    state_known: bool = True
    tool_id: str = ""
    target_id: str = ""
    reports: tuple[Report, ...] = ()
    simulations: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    features: str = ""
    heatmap: Any = None


def joined(outcomes: Sequence[Outcome], last: Outcome) -> Outcome:
    """How a goal ended for which several runs were made: the ``last`` that was carried out, with what all of them tried and took."""
    names = {name for outcome in outcomes for name in outcome.seconds}
    return replace(
        last,
        reports=tuple(report for outcome in outcomes for report in outcome.reports),
        simulations=sum(outcome.simulations for outcome in outcomes),
        seconds={name: sum(outcome.seconds.get(name, 0.0) for outcome in outcomes) for name in names},
        heatmap=outcomes[0].heatmap,
    )


def with_metrics(message: str, metrics: Sequence[tuple[str, float]]) -> str:
    """A verdict's sentence with what was measured behind it, in brackets: ``sentence [name value, name value]``."""
    return message + (f" [{', '.join(f'{name} {value:.4g}' for name, value in metrics)}]" if metrics else "")


def split_metrics(message: str) -> tuple[str, dict[str, float]]:
    """The sentence and the measurements that :func:`with_metrics` joined; a message without them is all sentence."""
    match = re.fullmatch(r"(.*) \[(\w+ [^\s,\]]+(?:, \w+ [^\s,\]]+)*)\]", message, re.DOTALL)
    if match is None:
        return message, {}
    try:
        pairs = [item.split(" ") for item in match[2].split(", ")]
        return match[1], {name: float(value) for name, value in pairs}
    except ValueError:
        return message, {}


class Stages(Protocol):
    """The work itself.  Each method ends within ``timeout`` seconds, by a result or by a :class:`MagicError`."""

    def perceive(self, request: Request, timeout: float) -> tuple[Request, str]:
        """Make sure that there are objects to work on.  The request with its ids among them, and how names in words were read."""

    def match(self, request: Request, timeout: float) -> Matches:
        """Find the contacts."""

    def plan(self, request: Request, matches: Matches, trial: Trial, timeout: float) -> Planned:
        """Turn one contact into a motion."""

    def expect(self, request: Request, matches: Matches, trial: Trial, timeout: float) -> None:
        """Begin, beside the simulation that follows, the plan that will probably be asked for next; returns at once, and raises nothing."""

    def forget(self) -> None:
        """What was expected is not asked for any more; returns at once."""

    def verify(self, request: Request, matches: Matches, trial: Trial, plan: Any, timeout: float) -> Verdict:
        """Run a motion in physics."""


class Agenda:
    """Which trial comes next: the one that promises most.

    A trial promises its candidate's share of the best candidate's score, halved with each
    further attempt: among candidates of like score every one gets its first grasp before one
    gets its second, but a far better contact gets another grasp before far worse ones are tried.
    A grasp that slipped is followed by the next grasp of the same contact.  Trials of the same
    promise are taken in the order of the candidates, and of the reflections.  ``spent(candidate)``
    says how many grasps of a candidate have failed before: these are left out.
    """

    def __init__(
        self, candidates: Sequence[Any], reflections: Sequence[str], attempts: int, spent: Callable[[Any], int] = lambda candidate: 0
    ) -> None:
        self._attempts = max(1, attempts)
        self._order: dict[tuple[int, str], int] = {}
        self._heap: list[tuple[float, int, int, Trial]] = []
        best = max((float(c.score) for c in candidates), default=0.0)
        for index, candidate in enumerate(candidates):
            share = min(1.0, max(0.0, float(candidate.score) / best)) if best > 0 else 1.0
            made = spent(candidate)
            if made >= self._attempts:
                continue
            for reflection in reflections_of(candidate, reflections):
                self._order[index, reflection] = len(self._order)
                self._push(share, Trial(index, candidate, reflection, made))

    def _push(self, promise: float, trial: Trial) -> None:
        # Order and attempt are unique together, so that trials themselves are never compared.
        heapq.heappush(self._heap, (-promise, self._order[trial.index, trial.reflection], trial.attempt, trial))

    def next(self) -> tuple[float, Trial] | None:
        """The next trial with what it promises; ``None`` when all are done."""
        if not self._heap:
            return None
        promise, _, _, trial = heapq.heappop(self._heap)
        return -promise, trial

    def failed(self, promise: float, trial: Trial, code: Code) -> None:
        """Put the next attempt of a failed trial on the list where one may help."""
        if code in EXHAUSTED or trial.attempt + 1 >= self._attempts:
            return
        again = Trial(trial.index, trial.candidate, trial.reflection, trial.attempt + 1)
        self._push(promise if code in GRASP_ONLY else promise / 2, again)

    def foreseen(self, promise: float, trial: Trial) -> Trial | None:
        """What will be next if a trial fails, as most that fail do: by the contact, not by the grasp alone."""
        then = copy.copy(self)
        then._heap = list(self._heap)
        then.failed(promise, trial, Code.GOAL_NOT_REACHED)
        entry = then.next()
        return entry[1] if entry is not None else None


class Choice:
    """Which of the motions that physics passed is taken: the surest.

    One of which no rollout failed is taken at once.  Of verified motions that were carried out on the truth 8 of 677 failed where no
    rollout had, and 6 of 92 where some had: of the next :data:`MORE` trials one may be surer.
    """

    #: So many further trials are made for a motion that is surer than one that passed.
    MORE = 4

    def __init__(self) -> None:
        self.best: Any = None
        self._rate, self._more = -1.0, self.MORE

    @property
    def over(self) -> bool:
        """Whether nothing further is tried."""
        return self.best is not None and (self._rate >= 1.0 or self._more == 0)

    def tried(self, motion: Any, rate: float) -> None:
        """A trial is over: it came to a ``motion`` that passed with this share of its rollouts, or to none (``None``)."""
        if self.best is not None:
            self._more -= 1
        if motion is not None and rate > self._rate:
            self.best, self._rate = motion, rate


def reflections_of(candidate: Any, reflections: Sequence[str]) -> tuple[str, ...]:
    """What is done with the tool's face: nothing for an upright match, the strategy's reflections for a mirrored one."""
    return tuple(reflections) if candidate.flipped else ("keep",)


def check(request: Request) -> None:
    """Refuse what cannot be run before any work: an unknown variant, a bad timeout, one object for both."""
    if request.variant not in VARIANTS:
        raise MagicError(Code.UNKNOWN_VARIANT, "variant", request.variant, VARIANTS)
    if not 0 < request.timeout < float("inf"):
        raise MagicError(Code.BAD_REQUEST, "timeout", request.timeout, "seconds above 0")
    for name in ("tool_mass", "target_mass"):
        mass = getattr(request, name)
        if not 0 <= mass < float("inf"):
            raise MagicError(Code.BAD_REQUEST, name, mass, "kg above 0, or 0 where it is not known")
    if request.tool_mass and not request.tool_id:
        raise MagicError(Code.BAD_REQUEST, "tool_mass without tool_id", request.tool_mass, "a tool_id: which tool weighs so much")
    check_different(request)


def check_different(request: Request) -> None:
    """Refuse one object for both."""
    if request.tool_id and request.tool_id == request.target_id:
        raise MagicError(Code.BAD_REQUEST, "tool_id and target_id", request.tool_id, "two different objects")


class Run:
    """One run from request to outcome; :meth:`execute` never raises."""

    def __init__(
        self,
        request: Request,
        reflections: Sequence[str],
        simulatable: bool,
        stages: Stages,
        settings: Settings = Settings(),
        notify: Callable[[Progress], None] = lambda progress: None,
        canceled: Callable[[], bool] = lambda: False,
        describe: Callable[[BaseException], tuple[int, str]] | None = None,
        clock: Callable[[], float] = time.monotonic,
        spent: Callable[[Any], int] = lambda candidate: 0,
    ) -> None:
        self._request = request
        self._reflections = reflections
        self._simulatable = simulatable
        self._stages = stages
        self._settings = settings
        self._notify = notify
        self._canceled = canceled
        self._describe = describe or (lambda error: (int(Code.INTERNAL), f"{type(error).__name__}: {error}"))
        self._clock = clock
        self._spent = spent
        self._start = clock()
        self._seconds = dict.fromkeys(STAGES, 0.0)
        self._reports: list[Report] = []
        self._simulations = 0
        self._matches: Matches | None = None

    def execute(self) -> Outcome:
        """Do the work."""
        try:
            check(self._request)
            return self._work()
        except MagicError as error:
            return self._outcome(error.code, error.message)
        except Exception as error:  # nothing may leave the server's handler
            code, message = self._describe(error)
            return self._outcome(Code(code), message)
        finally:
            self._stages.forget()

    def _work(self) -> Outcome:
        self._tell("perceive", 0, "waiting for objects")
        request, reading = self._timed("perceive", lambda left: self._stages.perceive(self._request, left))
        self._request = request
        if reading:
            self._tell("perceive", 0, reading)
        self._tell("match", 0, "matching contacts")
        matches = self._matches = self._timed("match", lambda left: self._stages.match(request, left))
        self._tell("match", 0, matches.message or f"{len(matches.candidates)} candidates")
        if not matches.candidates:
            raise MagicError(Code.NO_MATCH, "the matcher found no contact" + (f": {matches.message}" if matches.message else ""))
        agenda = Agenda(matches.candidates, self._reflections, self._settings.attempts if request.variant == "arm" else 1, self._spent)
        choice = Choice()
        while not choice.over and (entry := agenda.next()) is not None:
            promise, trial = entry
            try:
                if self._left() < self._settings.reserve:
                    raise self._late()
                passed, code = self._try(matches, trial, agenda.foreseen(promise, trial))
            except MagicError as error:
                if error.code != Code.SERVER_TIMEOUT or choice.best is None:
                    raise
                break
            choice.tried(passed, passed.rate if passed is not None else 0.0)
            agenda.failed(promise, trial, code)
        if choice.best is not None:
            return self._taken(choice.best)
        summary = self._summary() or f"each of {len(matches.candidates)} candidates has been tried before"
        return self._outcome(Code.NO_CANDIDATE_SUCCEEDED, "; ".join([summary, *matches.doubts]))

    def _try(self, matches: Matches, trial: Trial, following: Trial | None) -> tuple[_Passed | None, Code]:
        request = self._request
        what = f"candidate {trial.index + 1} of {len(matches.candidates)}, {trial.reflection}" + (
            f", grasp {trial.attempt + 1}" if trial.attempt else ""
        )
        self._tell("plan", trial.index, what)
        planned = self._attempt("plan", trial, lambda left: self._stages.plan(request, matches, trial, left), Planned)
        if planned.code != Code.OK:
            self._drop(Report(trial, "plan", planned.code, planned.message))
            return None, planned.code
        if not self._simulatable:
            code = Code.OK if request.allow_unverified else Code.NOT_VERIFIABLE
            message = f"not verified: simulation cannot judge the strategy {request.strategy!r}; this is the best match's motion"
            if not request.allow_unverified:
                message += " (allow_unverified = true accepts it)"
            return _Passed(Report(trial, "plan", code, message, planned.plan), planned), code
        self._tell("verify", trial.index, what)
        if following is not None and self._left() >= self._settings.reserve:
            self._stages.expect(request, matches, following, self._left())
        self._simulations += 1
        verdict = self._attempt("verify", trial, lambda left: self._stages.verify(request, matches, trial, planned.plan, left), Verdict)
        self._simulations += max(0, verdict.rollouts - 1)
        report = Report(trial, "verify", verdict.code, verdict.message, planned.plan, verdict)
        if verdict.code != Code.OK:
            self._drop(report)
            return None, verdict.code
        passed = _Passed(report, planned)
        self._reports.append(report)
        self._tell("verify", trial.index, f"verified: {verdict.message}" + ("; a surer motion is looked for" if passed.rate < 1.0 else ""))
        return passed, Code.OK

    def _taken(self, passed: _Passed) -> Outcome:
        """The run ends with this motion, whose report is the last."""
        report = passed.report
        self._reports = [*(r for r in self._reports if r is not report), report]
        return self._outcome(report.code, report.message, verdict=report.verdict, planned=passed.planned, trial=report.trial)

    def _attempt(self, stage: str, trial: Trial, work: Callable[[float], Any], failure: Callable[[Code, str], Any]) -> Any:
        """Run a stage for one trial; an error that is the trial's own becomes its failure, others end the run."""
        hopeless = False
        try:
            result = self._timed(stage, work)
        except MagicError as error:
            result = failure(error.code, error.message)
            hopeless = isinstance(error, HopelessError)
        except Exception as error:
            code, message = self._describe(error)
            result = failure(Code(code), message)
        if hopeless or result.code in FATAL:
            self._reports.append(Report(trial, stage, result.code, result.message))
            raise MagicError(result.code, result.message)
        return result

    def _drop(self, report: Report) -> None:
        self._reports.append(report)
        trial = report.trial
        self._tell(report.stage, trial.index, f"candidate {trial.index + 1} dropped: {report.code.name}: {report.message}")

    def _timed(self, stage: str, work: Callable[[float], Any]) -> Any:
        if self._canceled():
            raise MagicError(Code.CANCELED, f"canceled before {stage}")
        left = self._left()
        if left <= 0:
            raise self._late()
        begin = self._clock()
        try:
            return work(left)
        finally:
            self._seconds[stage] += self._clock() - begin

    def _left(self) -> float:
        return self._start + self._request.timeout - self._clock()

    def _late(self) -> MagicError:
        return MagicError(Code.SERVER_TIMEOUT, f"the {self._request.timeout:g} s for the whole run are over. {self._summary()}".strip())

    def _summary(self) -> str:
        if not self._reports:
            return ""
        reasons = "; ".join(
            f"{r.trial.index + 1}{'' if r.trial.reflection == 'keep' else ' turned'}: {r.code.name} at {r.stage}" for r in self._reports
        )
        furthest = max(self._reports, key=lambda r: STAGES.index(r.stage))  # the first of those that came furthest
        said = f"; the first at {furthest.stage}: {split_metrics(furthest.message)[0]}"
        return f"{len(self._reports)} trials of {len(self._matches.candidates) if self._matches else 0} candidates failed ({reasons}{said})"

    def _tell(self, stage: str, index: int, message: str) -> None:
        count = len(self._matches.candidates) if self._matches else 0
        self._notify(Progress(stage, index, count, message, tuple(self._reports)))

    def _outcome(
        self, code: Code, message: str, verdict: Verdict | None = None, planned: Planned | None = None, trial: Trial | None = None
    ) -> Outcome:
        matches = self._matches
        first = matches.candidates[0] if matches and matches.candidates else None
        chosen = trial.candidate if trial else first
        return Outcome(
            code=code,
            message=message,
            verified=verdict is not None,
            verdict=verdict,
            plan=planned.plan if planned is not None else None,
            state_known=planned is None or planned.state_known,
            tool_id=chosen.tool_id if chosen is not None else self._request.tool_id,
            target_id=matches.target_id if matches else self._request.target_id,
            reports=tuple(self._reports),
            simulations=self._simulations,
            seconds={**self._seconds, "total": self._clock() - self._start},
            features=matches.features if matches else "",
            heatmap=matches.heatmap if matches else None,
        )
