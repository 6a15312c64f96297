"""Decides a strategy's goal (:mod:`magic_core.goal`) over a simulated run.

A :class:`Watch` accompanies a run step by step and ends with a :class:`Judgement`: the code and the sentence of the first
predicate that does not hold, with what was measured and what was wanted.  The trees that ship (``magic_core/goals/*.yaml``)
have two parts: the tests of the tasks as the paper's authors released them, whose group has the metric ``released_test``, and what finds
out that something passed by chance: held by something else, balanced, glued by friction, pushed and not hooked.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.goal import PREDICATES, TRIES, Moment, Node, leaf_words, node_words
from magic_core.strategy import Strategy
from magic_verifier.floating import TARGET, TOOL, phase_end, phase_start
from magic_verifier.predicates import BESIDE, TOUCH, Asked, Simulated, Told, note_presses, told
from magic_verifier.simulation import DYNAMIC

__all__ = ["TOUCH", "Judgement", "Watch", "around", "goal_test", "require"]

#: What is watched over time is looked at every so many seconds.
OBSERVE_EVERY = 0.025
#: What swings comes to rest within seconds under this damping (1/s), as it does by itself within a minute; damping holds nothing up.
CALM = 3.0
#: How long a thing gets to come to rest after a push (s), and how long after it (s) it may still slide, swing or begin to fall: from a
#: balance it falls by a centimetre within 0.05 s, and a swing of 0.2 m length passes its middle after 0.22 s.
REST_WITHIN = 2.5
AFTER_PUSH = 0.45
#: State is looked at every so many seconds while things come to rest.
LOOK_EVERY = 0.1
#: A drawn rollout lets things settle no longer than this (s): a fall takes a quarter of a second.
SOON = 0.75


@dataclass(frozen=True)
class Judgement:
    """What came of a goal: OK or why not, a sentence with numbers, and what was measured (SI units).

    The metric ``released_test`` is 1 where the released code's test passed, whatever came of the rest.
    """

    code: Code
    message: str
    metrics: dict[str, float] = field(default_factory=dict)

    @property
    def cause(self) -> str:
        """The sentence up to its numbers: what equal failures have in common."""
        return re.split(r":| at [0-9]", self.message, maxsplit=1)[0]


#: Steps a run on for some seconds, keeping deadline and cancel request, looking for explosions.
GoOn = Callable[[float], None]


@dataclass(frozen=True)
class _Answer:
    """A node's: ``say`` and ``wanted`` where it does not hold, ``measured`` by kind and body; a ``message`` where it is composed;
    ``untold``: what of it cannot be told."""

    truth: bool | None
    code: Code = Code.OK
    say: str = ""
    wanted: str = ""
    measured: dict[tuple[str, str], str] = field(default_factory=dict)
    message: str = ""
    untold: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """What was measured."""
        return ", ".join(text for text in self.measured.values() if text)

    def failure(self) -> str:
        """The sentence where it does not hold: what is wrong, what was measured, what was wanted."""
        if self.message:
            return self.message
        return f"{self.say}{': ' + self.state if self.state else ''}{f' ({self.wanted})' if self.wanted else ''}"


def _moments(node: Node, moment: Moment | None = None) -> list[tuple[Node, Moment | None]]:
    """All nodes with what they are asked after: their own, or that of what they are in."""
    moment = node.after if node.after is not None else moment
    return [(node, moment), *(pair for child in node.of for pair in _moments(child, moment))]


class Watch:
    """Watches a floating or an arm run for a strategy's goal.

    ``disturb`` before and ``observe`` after each step, ``judge`` at the end, which is :meth:`until`.  ``nudge``: direction (rad) of the
    first push of a drawn rollout, ``None`` for the scene as given.  Raises ``UNKNOWN_GOAL`` and ``BAD_STRATEGY``.
    """

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        goal = strategy.goal.filled
        self.run = run
        self.rng = rng
        self.nudge = nudge
        self.tree: Node = goal.test  # type: ignore[assignment]
        self._trial = goal.trial
        self.drawn = nudge is not None
        self.metrics: dict[str, float] = {}
        self.asked = Asked(strategy, None, rng)
        self.asked.state = Simulated(run, self._put_beside() if "row" in self._trial else ())
        self._check_names()
        self._go_on: GoOn = lambda _seconds: None
        self._answers: dict[int, _Answer] = {}
        self._late: list[tuple[float, Node]] = []
        self._windows: list[tuple[Node, float, float, float]] = []  # leaf, whole window from and to, what counts of it from
        self._looks: dict[int, list[tuple[float, bool | None]]] = {}
        self._every = max(1, round(OBSERVE_EVERY * run.setup.settings.frequency))
        self._pressed = [node for node in self.tree.nodes() if node.kind == "pressed"]
        self._plan()
        self._kick, self._slowing = self._disturbances()

    # ------------------------------------------------------------ the scene of the test

    def _put_beside(self) -> tuple[str, ...]:
        """Bodies like the target to its left, to its right, further to the left, ..."""
        row, run = self._trial["row"], self.run
        side, body, physics = self.asked.direction("left"), run.setup.target, run.setup.physics
        names = []
        for number in range(round(row["others"])):
            aside = (number // 2 + 1) * row["spacing"] * (1 if number % 2 == 0 else -1)
            names.append(f"{BESIDE}{number + 1}")
            pose = transforms.make(translation=aside * side) @ body.world_from_object
            run.world.add(names[-1], list(body.hulls), pose, DYNAMIC, physics.target_density, physics.friction, balls=body.balls)
        return tuple(names)

    def _check_names(self) -> None:
        """Refuse a tree that names a body, a phase or a direction which the run does not have."""
        phases = {"goal", *(phase.name for phase in self.run.phases)}
        there = {TOOL, "table", "arm", "fingers", *self.asked.state.row(), *(o.id for o in self.run.setup.obstacles)}
        for node in self.tree.nodes():
            whom = node.args.get("whom")
            if whom is not None and whom not in there:
                raise MagicError(Code.BAD_STRATEGY, f"goal: {node.kind}: whom", whom, sorted(there))
            for named in (node.args, node.ever or {}, node.always or {}, node.after.args if node.after else {}):
                if named.get("phase") and named["phase"] not in phases and node.kind != "struck":
                    raise MagicError(Code.BAD_STRATEGY, f"goal: {node.kind}: phase", named["phase"], sorted(phases))
            if "along" in node.args:
                self.asked.direction(node.args["along"])
            if node.kind == "struck":
                told(self.asked, node)

    def _disturbances(self) -> tuple[float, float]:
        """Kicks (m/s a step, standard deviation) and what resistance takes of the target's speed in a step (m/s)."""
        frequency = self.run.setup.settings.frequency
        kick = slowing = 0.0
        acts = [name for name, args in self._trial.items() if name == "resists" or (name == "kicked" and args["radii"] > 0)]
        if acts and self.run.setup.target_kind != DYNAMIC:
            raise MagicError(Code.BAD_STRATEGY, "goal: trial of a target that is fixed", ", ".join(acts), "none: nothing moves it")
        if (kicked := self._trial.get("kicked")) and kicked["radii"] > 0:
            kick = kicked["radii"] * self.asked.radius(self.asked.direction("pull")) * float(np.sqrt(240.0 / frequency))
        if resists := self._trial.get("resists"):
            slowing = resists["force"] / float(self.run.world.component(TARGET).mass) / frequency
        return kick, slowing

    def _plan(self) -> None:
        """When the nodes are to be asked, and what is looked at meanwhile."""
        self._from, self._to = self._span("goal")
        leaves = [(n, m) for n, m in _moments(self.tree) if n.kind in PREDICATES]
        # What names no time is asked at the motion's end at least.
        self._end = max(self._motion_end() if m is None or m.kind in TRIES else self._time(m) for _, m in leaves)
        end = self.until()
        for node, moment in _moments(self.tree):
            time = end if moment is None or moment.kind in TRIES else self._time(moment)
            if node.after is not None and node.after.kind not in TRIES and time < end - 1e-9:
                self._late.append((time, node))
            window = node.ever or node.always
            if window is not None:
                self._looks[id(node)] = []
                first, last = self._span(window["phase"]) if window["phase"] else (time - window["seconds"], time)
                counts = last - window["last"] * (last - first) if window["phase"] else first
                self._windows.append((node, first, last, counts))

    def _motion_end(self) -> float:
        return self.run.duration if self.run.release_time is None else max(self.run.duration, self.run.release_time)

    def _span(self, phase: str) -> tuple[float, float]:
        """When a phase begins and ends on the motion's clock; of the goal also where only a contact, or nothing, is named."""
        phases = self.run.phases
        start = phase_start(phases, (phase,)) or phase_start(phases, ("contact", phase)) or 0.0
        end = phase_end(phases, phase)
        return start, self.run.duration if end is None else end

    def _time(self, moment: Moment) -> float:
        if moment.kind == "phase":
            return self._span(moment.args["phase"])[1]
        settle = moment.args["settle"]
        return self._motion_end() + (settle if self.nudge is None else min(settle, SOON))

    def leaves_alone(self, name: str) -> bool:
        """Whether nothing pushes a body, lets it come to rest or asks what it touches, so that it may be held where it is."""
        moments = [node.after for node in self.tree.nodes() if node.after is not None]
        asked = [node.args for node in self.tree.nodes() if "whom" in node.args]
        return all(args.get("what") != name for args in (*asked, *(moment.args for moment in moments)))

    def until(self) -> float:
        """The moment of the motion at which the run may end: in the scene as given all of the motion, else when all was asked."""
        return max(self._end, self._motion_end()) if self.nudge is None else self._end

    # ------------------------------------------------------------ step by step

    def disturb(self) -> None:
        """Before each step."""
        world = self.run.world
        if self.kicks and self.run.time < self._to:
            world.set_velocity(TARGET, world.velocity(TARGET) + self.rng.normal(0, self._kick) * self.asked.direction("left"))
        if self._slowing > 0:
            along = self.asked.direction(self._trial["resists"]["along"])
            velocity = world.velocity(TARGET)
            speed = float(velocity @ along)
            if speed != 0.0:
                world.set_velocity(TARGET, velocity - np.sign(speed) * min(abs(speed), self._slowing) * along)

    @property
    def kicks(self) -> bool:
        """Whether the test itself has begun to move the target."""
        return self._kick > 0 and self.run.time >= (phase_start(self.run.phases, ("contact", "goal")) or 0.0)

    def observe(self) -> None:
        """After each step."""
        time = self.run.time
        if self._pressed:
            note_presses(self.asked, self._pressed)
        if self._windows and self.run.world.steps % self._every == 0:
            for node, first, last, _ in self._windows:
                if first <= time <= last:
                    self._looks[id(node)].append((time, told(self.asked, node).truth))
        if self._late:
            for late in [late for late in self._late if time >= late[0]]:
                if late in self._late:
                    self._late.remove(late)
                    found = self._answers[id(late[1])] = self.ask(late[1])
                    if found.truth is False and self.tree.kind == "all" and any(late[1] is child for child in self.tree.of):
                        self._late.clear()  # the goal is missed: what comes after it is not asked

    def _windowed(self, node: Node, now: Told) -> Told:
        _, first, _, counts = next(w for w in self._windows if w[0] is node)
        looks = self._looks[id(node)]
        yes = [truth for time, truth in looks if time > counts or (counts == first and time == first)]
        # Nothing was looked at, or what was tells neither: a 'not' above must not make a yes of that.
        if not yes or (None in yes and (True not in yes if node.ever is not None else False not in yes)):
            return Told(None, wanted=leaf_words(node))
        truth = True in yes if node.ever is not None else False not in yes
        if node.kind != "touching":
            return Told(truth, now.measured, now.wanted, now.metrics)
        metrics = {"touching": float(truth)} if not (node.ever or node.always)["phase"] else {}  # type: ignore[index]
        if not metrics:
            metrics = {"contact_share": float(np.mean([bool(t) for _, t in looks])) if looks else 0.0}
        said = f"{node.args['what']} {'touching' if truth else 'not touching'} the {node.args['whom']}"
        return Told(truth, said, now.wanted, metrics)

    # ------------------------------------------------------------ the tree

    def ask(self, node: Node, when: str = "") -> _Answer:
        """The answer of a node, its ``when`` included in what it says."""
        if node.as_given and self.drawn:
            return _Answer(True)
        known = self._answers.get(id(node))
        if known is not None:
            return known
        if node.after is not None:
            when = self._before(node.after, node) or when
        if node.kind in PREDICATES:
            return self._leaf(node, when)
        if node.kind == "not":
            return self._not(node, when)
        return self._all(node, when) if node.kind == "all" else self._any(node, when)

    def _told(self, node: Node) -> Told:
        found = told(self.asked, node)
        if found.truth is not None and (node.ever is not None or node.always is not None):
            found = self._windowed(node, found)
        metrics = list(found.metrics.items())
        if node.metric and metrics:
            metrics[0] = node.metric, metrics[0][1]
        self.metrics.update(metrics)
        return found

    def _leaf(self, node: Node, when: str) -> _Answer:
        found = self._told(node)
        code = Code[node.code] if node.code else PREDICATES[node.kind].code
        say = (node.say or f"it does not hold that {leaf_words(node)}") + when
        if found.truth is None:
            return _Answer(None, code, untold=(found.wanted,))
        measured = {(node.kind, node.args.get("what", "")): found.measured} if found.measured else {}
        return _Answer(found.truth, code, say, found.wanted, measured)

    def _state(self, node: Node) -> dict[tuple[str, str], str]:
        """What the plain leaves of a group measure, all of them: a failure is said with what was around it."""
        result = {}
        for child in node.of:
            if child.as_given and self.drawn:
                continue
            if child.after is not None or (child.kind in PREDICATES and "trying" in PREDICATES[child.kind].needs):
                continue
            if child.kind in PREDICATES:
                found = self._told(child)
                if found.measured and child.kind != "touching_only":  # said where it is the fault
                    result[child.kind, child.args.get("what", "")] = found.measured
            elif child.kind == "any":
                result |= self._state(child)
        return result

    def _all(self, node: Node, when: str) -> _Answer:
        measured = self._state(node)
        truth: bool | None = True
        untold: tuple[str, ...] = ()
        if node.metric:
            self.metrics[node.metric] = 0.0
        for child in node.of:
            found = self.ask(child, when)
            if found.truth is False:
                if not found.message:
                    found = replace(found, say=node.say + when if node.say else found.say, measured={**measured, **found.measured})
                return replace(found, code=Code[node.code] if node.code else found.code, message=found.failure())
            truth = truth if found.truth else None
            untold += found.untold
            measured |= found.measured
        if node.metric and truth:
            self.metrics[node.metric] = 1.0
        return _Answer(truth, measured=measured, untold=untold)

    def _any(self, node: Node, when: str) -> _Answer:
        found = []
        for child in node.of:
            found.append(self.ask(child, when))
            if found[-1].truth:
                break
        measured = {key: text for answer in found for key, text in answer.measured.items()}
        truth = True if found[-1].truth else (None if any(a.truth is None for a in found) else False)
        if node.metric:
            self.metrics[node.metric] = float(bool(truth))
        code = Code[node.code] if node.code else found[0].code
        say = node.say + when if node.say else found[0].say or found[0].message
        wanted = " or ".join(dict.fromkeys(a.wanted for a in found if a.wanted)).replace(" or needed: ", " or ")
        untold = tuple(text for answer in found for text in answer.untold) if truth is None else ()
        return _Answer(truth, code, say, wanted, measured, untold=untold)

    def _not(self, node: Node, when: str) -> _Answer:
        (child,) = node.of
        found = self.ask(child, when)
        truth = None if found.truth is None else not found.truth
        if node.metric:
            self.metrics[node.metric] = float(bool(truth))
        code = Code[node.code] if node.code else Code.GOAL_NOT_REACHED
        say = (node.say or f"it holds that {node_words(child)}") + when
        return _Answer(truth, code, say, "needed: that it does not", found.measured, untold=found.untold)

    # ------------------------------------------------------------ the end

    def judge(self, go_on: GoOn) -> Judgement:
        """After the last step; ``go_on`` steps the run further."""

        def noting(seconds: float) -> None:
            go_on(seconds - OBSERVE_EVERY)
            self.asked.state.note()
            go_on(OBSERVE_EVERY)

        self._go_on = noting
        found = self.ask(self.tree)
        metrics = {name: value for name, value in self.metrics.items() if np.isfinite(value)}
        if found.truth:
            return Judgement(Code.OK, f"the goal is reached: {found.state}", metrics)
        if found.truth is None:
            told_of = "contacts of a tool that is led, or of a fixed target, with what is fixed, or a time at which nothing was looked at"
            return Judgement(Code.NOT_VERIFIABLE, f"the goal cannot be told in simulation, {told_of}: {'; '.join(found.untold)}", metrics)
        return Judgement(found.code, found.failure(), metrics)

    def _before(self, moment: Moment, node: Node) -> str:
        """Make the moment of a node: what to say of it."""
        if moment.kind == "rest":
            return self._rest(node, moment.args)
        if moment.kind == "push":
            return self._push(node, moment.args)
        return ""

    def _rest(self, node: Node, args: dict[str, Any]) -> str:
        friction = float(args["friction"])
        own = self.run.setup.physics.friction
        if np.isfinite(friction):
            for name in (TOOL, TARGET):
                self.run.world.set_friction(name, min(own, friction))
        for name in self.asked.bodies(args["what"]):
            self.run.world.calm(name, CALM)
        # What has fallen is not waited for.
        floors = [child for child in node.of if child.kind == "above"]
        for _ in range(round(args["within"] / LOOK_EVERY)):
            self._go_on(LOOK_EVERY)
            if self._rests(args) or not all(told(self.asked, child).truth for child in floors):
                break
        return f", with a friction of {friction:g}" if friction < own else ""

    def _push(self, node: Node, args: dict[str, Any]) -> str:
        watched = [child for child in node.of if child.throughout]
        directions = self.directions()
        world = self.run.world
        said = f", pushed in {len(directions)} directions at {args['speed']:g} m/s"
        for index, direction in enumerate(directions):
            for name in self.asked.bodies(args["what"]):
                world.set_velocity(name, world.velocity(name) + args["speed"] * direction)
            for _ in range(2):  # what it only knocks against on its way counts as well
                self._go_on(AFTER_PUSH / 2)
                for child in watched:
                    found = self.ask(child, f" after push {index + 1}")
                    if found.truth is False:
                        self._answers[id(child)] = found
                        return said
        if args["below"] == 0:
            self._go_on(AFTER_PUSH)
            return said
        for _ in range(round(REST_WITHIN / LOOK_EVERY)):
            if self._rests(args):
                break
            self._go_on(LOOK_EVERY)
        return said

    def _rests(self, args: dict[str, Any]) -> bool:
        speeds = [self.asked.state.speeds(name) for name in self.asked.bodies(args["what"])]
        return all(speed < args["below"] and turning < args["turning"] for speed, turning in speeds)

    def directions(self) -> list[NDArray[np.float64]]:
        """Horizontal unit vectors (3,) of the pushes: four of them in the scene as given, else three that begin anywhere."""
        count, first = (4, 0.0) if self.nudge is None else (3, self.nudge)
        return [np.array([np.cos(a), np.sin(a), 0.0]) for a in first + 2 * np.pi * np.arange(count) / count]


def goal_test(strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> Watch:
    """The goal of a strategy, ready to watch a run; raises ``UNKNOWN_GOAL`` and ``BAD_STRATEGY``.  ``nudge``: see :class:`Watch`."""
    return Watch(strategy, run, rng, nudge)


def require(strategy: Strategy) -> None:
    """Raise ``UNKNOWN_GOAL`` or ``BAD_STRATEGY`` unless the strategy's goal can be decided."""
    strategy.goal.resolved()


def around(strategy: Strategy) -> float:
    """How far (m) from the target bodies of the test's own may stand."""
    row = strategy.goal.resolved().trial.get("row")
    return 0.0 if row is None else float(np.ceil(row["others"] / 2) * row["spacing"])
