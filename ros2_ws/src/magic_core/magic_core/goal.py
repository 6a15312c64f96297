"""What a strategy is for, as data: a tree of predicates with numbers and times.

In ``strategy.yaml``::

    goal:
      values: {distance: 0.2, kicks: 0.0}       # numbers that the tree names, so that they can be set from outside
      trial: {kicked: {radii: kicks}}           # what the test does to the scene meanwhile; may be left out
      test:                                     # the tree
        all:
        - {moved: {what: target, along: pull, by: distance}, after: {phase: goal}}
        - {at_rest: {what: target, below: 0.05}, after: {settle: 1.0}, code: UNSTABLE, say: the target rolls on}

A node is ``all``, ``any`` (lists of nodes), ``not`` (a node) or one of :data:`PREDICATES`, with any of these beside it:

after       when it is asked: ``{phase: NAME}`` at the end of that phase; ``{settle: SECONDS}`` so long after the motion and the release;
            ``{rest: {...}}`` when a body has come to rest; ``{push: {...}}`` after it was pushed in several directions (the numbers
            of both: :data:`TRIES`).  What is below a node is asked when the node is; by default at the end, when all settling times
            are over.
ever        ``{phase: NAME, last: SHARE}`` or ``{seconds: SECONDS}``: it holds at some time in the last share of the phase, or the
            last seconds before it is asked; ``always`` the same way, all the time.
code, say   the code and the sentence where it does not hold (:class:`magic_core.errors.Code` by name).
metric      a name for what it measures, of a group: 1 where it holds.
as_given    true: asked in the scene as given only, not where things were drawn at random.
throughout  true: in a node after a push, looked at between the pushes as well.

``all`` is asked in its order and ends with the first that does not hold; phases and settling times come before the tries, which change
the scene.  Numbers are in SI units, angles in degrees; where
a number is wanted a name of ``values`` may stand.  Bodies are ``tool``, ``target``, ``row`` (the target and what the trial has put beside
it), ``table``, ``arm``, ``fingers`` and the ids of fixtures.  Directions are ``pull`` (level, against the target's normal, on which the
tool acts), ``left`` of it, ``press`` (against the normal as it is), ``up``, ``down``, or three numbers in the world.

``test`` may also be the name of one of the trees that ship (:func:`names`), whose numbers ``values`` then sets.  This module
reads, writes and words goals; :mod:`magic_verifier.goals` decides them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError

#: The trees that ship.
FOLDER = Path(__file__).with_name("goals")
GROUPS = ("all", "any", "not")
DIRECTIONS = ("pull", "left", "press", "up", "down")
MOVING = ("tool", "target", "row")
#: Beside the kind of a node.
BESIDE = ("after", "ever", "always", "code", "say", "metric", "as_given", "throughout")


@dataclass(frozen=True)
class Arg:
    """One argument: ``kind`` is number, body (one that moves), other (any body), direction, point (three numbers), phase or word;
    ``what`` says what it is, with its unit; ``default`` ``None``: it has to be given; numbers are from ``least`` to ``most``."""

    kind: str
    what: str
    default: Any = None
    least: float = 0.0
    most: float = 100.0
    words: tuple[str, ...] = ()

    @property
    def allowed(self) -> str:
        """What may be given, in words."""
        if self.kind == "number":
            return f"{self.what}, from {self.least:g} to {self.most:g}"
        if self.kind == "body":
            return ", ".join(MOVING)
        if self.kind == "direction":
            return f"{', '.join(DIRECTIONS)}, or three numbers"
        return {"other": "the id of a body", "point": "three numbers (m)", "phase": "the name of a phase"}.get(
            self.kind, ", ".join(self.words)
        )


def _number(what: str, default: Any = None, least: float = 0.0, most: float = 100.0) -> Arg:
    return Arg("number", what, default, least, most)


_WHAT = Arg("body", "the body")
_WHOM = Arg("other", "the other body")
_ALONG = Arg("direction", "the direction")


@dataclass(frozen=True)
class Predicate:
    """A kind of leaf: its arguments, what it needs to be told (:data:`NEEDS`), its words, and the code where it does not hold.

    ``words`` is filled with the arguments.
    """

    args: dict[str, Arg]
    needs: tuple[str, ...]
    words: str
    code: Code = Code.GOAL_NOT_REACHED


#: What predicates need: poses of the bodies now and at the start; how fast they are; what touches what; where masses are; where the
#: hand is; what has happened meanwhile; and to try things out, as only a simulation can.
NEEDS = ("poses", "speeds", "contacts", "masses", "hand", "history", "trying")

PREDICATES: dict[str, Predicate] = {
    "moved": Predicate(
        {"what": _WHAT, "along": _ALONG, "by": _number("a length in m", least=-100.0)},
        ("poses",),
        "the {what} has moved {by:mm} along {along} or more",
    ),
    "stayed": Predicate(
        {"what": _WHAT, "within": _number("a length in m")},
        ("poses",),
        "the {what} is within {within:mm} of where it was",
        Code.DRIFT,
    ),
    "drift": Predicate(
        {
            "what": _WHAT,
            "along": _ALONG,
            "below": _number("a length in m, or in radii of the target"),
            "of": Arg("word", "the unit", "m", words=("m", "radius")),
        },
        ("poses",),
        "it has drifted to the side of {along} by less than {below:drift}",
        Code.DRIFT,
    ),
    "above": Predicate(
        {"what": _WHAT, "height": _number("a height above the table in m", least=-10.0)},
        ("poses",),
        "the {what} is more than {height:mm} above the table",
    ),
    "upright": Predicate(
        {"what": _WHAT, "within": _number("an angle in degrees", 15.0, 0.0, 180.0)},
        ("poses",),
        "what was up of the {what} is up, within {within:deg}",
        Code.UNSTABLE,
    ),
    "points": Predicate(
        {"what": _WHAT, "along": _ALONG, "within": _number("an angle in degrees", 45.0, 0.0, 180.0)},
        ("poses",),
        "what was up of the {what} points along {along}, within {within:deg}",
    ),
    "turned": Predicate(
        {
            "what": _WHAT,
            "by": _number("an angle in degrees", least=0.0, most=180.0),
            "about": Arg("word", "the axis", "any", words=("any", "up", "level")),
        },
        ("poses",),
        "the {what} has turned by {by:deg} or more about {about:axis}",
    ),
    "inside": Predicate(
        {
            "what": _WHAT,
            "low": Arg("point", "the region's low corner"),
            "high": Arg("point", "the region's high corner"),
            "of": Arg("word", "the region's frame", "start", words=("start", "world")),
        },
        ("poses",),
        "the {what} is inside the region from {low} to {high} of {of:frame}",
    ),
    "at_rest": Predicate(
        {"what": _WHAT, "below": _number("a speed in m/s"), "turning": _number("a speed in rad/s", math.inf, 0.0, math.inf)},
        ("speeds",),
        "the {what} is slower than {below:speed}{turning:turning}",
        Code.UNSTABLE,
    ),
    "touching": Predicate({"what": _WHAT, "whom": _WHOM}, ("contacts",), "the {what} touches the {whom}", Code.LOST_CONTACT),
    "touching_only": Predicate(
        {"what": _WHAT, "whom": _WHOM}, ("contacts",), "the {what} touches nothing but the {whom}", Code.GOAL_NOT_REACHED
    ),
    "held_by": Predicate({"what": _WHAT, "whom": _WHOM}, ("contacts",), "the {what} is held by the {whom} alone", Code.LOST_CONTACT),
    "overlap": Predicate(
        {"what": _WHAT, "whom": _WHOM, "below": _number("a length in m")},
        ("contacts",),
        "the {what} is in the {whom} by no more than {below:mm}",
        Code.UNSTABLE,
    ),
    "below_support": Predicate(
        {"what": _WHAT, "whom": _WHOM},
        ("contacts", "masses"),
        "the centre of mass of the {what} is below where the {whom} holds it",
        Code.UNSTABLE,
    ),
    "pressed": Predicate(
        {"what": _WHAT, "whom": _WHOM, "along": _ALONG, "impulse": _number("an impulse in N s", least=0.0)},
        ("history",),
        "the {whom} has pressed on the {what} along {along} with {impulse:impulse} or more",
    ),
    "released": Predicate({}, ("hand",), "the tool was let go"),
    "hand_away": Predicate({"by": _number("a length in m")}, ("hand",), "the hand is {by:mm} from where it let go or more"),
    "struck": Predicate(
        {"phase": Arg("phase", "the phase", "strike")}, ("history",), "from the phase {phase} on the tool flies by its own momentum"
    ),
    "encloses": Predicate(
        {"along": _ALONG, "turned": _number("an angle in degrees", 30.0, 0.0, 89.0)},
        ("trying",),
        "pulled on along {along}, turned by {turned:deg} to either side, the tool keeps the target on one side and on the other "
        "does not let it fall back as along a flat face",
        Code.DRIFT,
    ),
}

#: What a node may be asked after, beside a phase and a settling time.
TRIES: dict[str, dict[str, Arg]] = {
    # It is calmed down, what swings comes to rest, with a friction of its own and the target's of no more than that.
    "rest": {
        "what": _WHAT,
        "below": _number("a speed in m/s"),
        "turning": _number("a speed in rad/s", math.inf, 0.0, math.inf),
        "friction": _number("a coefficient of friction", math.inf, 0.0, math.inf),
        "within": _number("seconds", 2.5, 0.0, 30.0),
    },
    # Pushed at that speed in each of several directions; where ``below`` is given it then gets the time to come to rest.
    "push": {
        "what": _WHAT,
        "speed": _number("a speed in m/s"),
        "below": _number("a speed in m/s", 0.0),
        "turning": _number("a speed in rad/s", math.inf, 0.0, math.inf),
    },
}

#: What the test does to the scene while the motion runs.
TRIALS: dict[str, dict[str, Arg]] = {
    # Kicks of the target's velocity to the side, at each 1/240 s between contact and end of the goal phase: standard deviation.
    "kicked": {"radii": _number("target radii per second", least=0.0, most=1e9)},
    # The target resists, as by dry friction (Coulomb), along a direction; by no more in a step than stops it.
    "resists": {"force": _number("newtons", least=0.0, most=1e4), "along": Arg("direction", "the direction", "pull")},
    # So many like the target stand beside it.
    "row": {"others": _number("a number", least=0.0, most=20.0), "spacing": _number("a length in m", 0.05, 0.001, 1.0)},
}

_AFTER = {"phase": Arg("phase", "the phase"), "settle": _number("seconds", least=0.0, most=60.0)}
_WINDOW = {
    "phase": Arg("phase", "the phase", ""),
    "last": _number("a share", 1.0, 0.0, 1.0),
    "seconds": _number("seconds", 0.0, 0.0, 60.0),
}


@dataclass(frozen=True)
class Moment:
    """When a node is asked: ``kind`` is phase, settle, rest or push."""

    kind: str
    args: dict[str, Any]


@dataclass(frozen=True)
class Node:
    """A node of the tree; see the module.  ``args`` of a predicate, ``of`` of a group."""

    kind: str
    args: dict[str, Any] = field(default_factory=dict)
    of: tuple[Node, ...] = ()
    after: Moment | None = None
    ever: dict[str, Any] | None = None
    always: dict[str, Any] | None = None
    code: str = ""
    say: str = ""
    metric: str = ""
    as_given: bool = False
    throughout: bool = False

    def nodes(self) -> Iterator[Node]:
        """The node and all below it."""
        yield self
        for node in self.of:
            yield from node.nodes()

    def has(self, kind: str) -> bool:
        """Whether it, or one below it, is of a kind."""
        return any(node.kind == kind for node in self.nodes())


@dataclass(frozen=True)
class Goal:
    """What decides success: a tree, or the name of one that ships; the numbers that it names (of a shipped tree those that are
    other than its own); what the test does meanwhile."""

    test: Node | str
    values: dict[str, float] = field(default_factory=dict)
    trial: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The tree's name, empty for one of the strategy's own."""
        return self.test if isinstance(self.test, str) else ""

    @property
    def title(self) -> str:
        """The tree's name, or what it asks for, short."""
        if isinstance(self.test, str):
            return self.test
        return ", ".join(dict.fromkeys(node.kind for node in self.test.nodes() if node.kind in PREDICATES))

    @property
    def written(self) -> Node:
        """The tree as it is written, with the names of its numbers; raises ``UNKNOWN_GOAL``."""
        written = named(self.test).test if isinstance(self.test, str) else self.test
        assert isinstance(written, Node)
        return written

    @property
    def numbers(self) -> dict[str, float]:
        """All numbers that the tree names; of a shipped tree those that are set, and its own for the others.  Raises ``UNKNOWN_GOAL``."""
        return {**named(self.test).values, **self.values} if isinstance(self.test, str) else dict(self.values)

    def with_values(self, values: dict[str, float]) -> Goal:
        """The goal with other numbers; names that it does not know are refused by :meth:`resolved`."""
        return replace(self, values={**self.values, **values})

    @property
    def tree(self) -> Node:
        """The tree with its numbers; raises as :meth:`resolved`."""
        tree = self.filled.test
        assert isinstance(tree, Node)
        return tree

    @cached_property
    def filled(self) -> Goal:
        """:meth:`resolved`, once for all who ask."""
        return self.resolved()

    def resolved(self, path: str = "goal") -> Goal:
        """The goal with its tree, and the numbers in it in place of their names; ``path`` is where it stands, for messages.

        Raises ``UNKNOWN_GOAL`` for a name of no tree, ``BAD_STRATEGY`` for numbers that it does not name or that are out of bounds.
        """
        if isinstance(self.test, str):
            full = replace(named(self.test), values=self.numbers)
        else:
            full = self
        used = {value for node in full.test.nodes() for value in _names(node)}  # type: ignore[union-attr]
        used |= {value for name, args in full.trial.items() for value in _named(TRIALS[name], args)}
        unknown = sorted(set(full.values) - used)
        if unknown:
            raise _bad(f"{path}.values of {self.name or 'the tree'}", ", ".join(unknown), sorted(used) or "none: the tree names no numbers")
        test = _filled(full.test, f"{path}.test", full.values)  # type: ignore[arg-type]
        trial = {name: _filled_args(TRIALS[name], args, f"{path}.trial.{name}", full.values) for name, args in full.trial.items()}
        return Goal(test, {}, trial)


def names() -> list[str]:
    """Of the trees that ship."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


@lru_cache(maxsize=32)
def named(name: str) -> Goal:
    """A tree that ships, with its numbers; raises ``UNKNOWN_GOAL``."""
    if name not in names():
        raise MagicError(Code.UNKNOWN_GOAL, "goal test", name, names())
    return from_data(yaml.safe_load((FOLDER / f"{name}.yaml").read_text()))


def shipped(name: str, **values: float) -> Goal:
    """A tree that ships as a strategy's own, in full, with some of its numbers."""
    goal = named(name)
    changed = replace(goal, values={**goal.values, **{key: float(value) for key, value in values.items()}})
    changed.resolved()
    return changed


# ------------------------------------------------------------------------------------------------ reading


def from_data(data: Any, path: str = "goal") -> Goal:
    """The goal of a ``strategy.yaml``; raises ``BAD_STRATEGY`` with the path, the value and what is allowed."""
    _keys(data, ("test", "values", "trial"), path)
    if "test" not in data:
        raise _bad(path, "no test", "test: a tree, or the name of one that ships")
    values = data.get("values") or {}
    if not isinstance(values, dict):
        raise _bad(f"{path}.values", values, "names with numbers")
    numbers = {str(name): _plain(value, f"{path}.values.{name}") for name, value in values.items()}
    if isinstance(data["test"], str):
        if data.get("trial"):
            raise _bad(f"{path}.trial", data["trial"], "nothing: a named tree brings its own")
        return Goal(data["test"], numbers)
    trial = data.get("trial") or {}
    _keys(trial, tuple(TRIALS), f"{path}.trial")
    trials = {name: _args(TRIALS[name], args, f"{path}.trial.{name}", numbers) for name, args in trial.items()}
    goal = Goal(_node(data["test"], f"{path}.test", numbers, tries=True), numbers, trials)
    _in_order(goal.written, f"{path}.test")
    goal.resolved(path)
    return goal


def to_data(goal: Goal) -> dict[str, Any]:
    """The goal for a ``strategy.yaml``, plain data."""
    data: dict[str, Any] = {"values": dict(goal.values)} if goal.values or isinstance(goal.test, str) else {}
    if goal.trial:
        data["trial"] = {name: _args_data(args) for name, args in goal.trial.items()}
    return {**data, "test": goal.test if isinstance(goal.test, str) else _node_data(goal.test)}


def _bad(path: str, value: Any, allowed: Any) -> MagicError:
    return MagicError(Code.BAD_STRATEGY, path, value, allowed)


def _keys(data: Any, allowed: tuple[str, ...], path: str) -> None:
    if not isinstance(data, dict):
        raise _bad(path, data, f"a mapping with {', '.join(allowed)}")
    for key in data:
        if key not in allowed:
            raise _bad(f"{path}: key", str(key), allowed)


def _plain(value: Any, path: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _bad(path, value, "a finite number")
    return float(value)


def _node(data: Any, path: str, values: dict[str, float], tries: bool, plain: bool = True, timed: str = "") -> Node:
    """``tries``: whether what is below may try things out, which changes the scene for all that comes after; ``plain``: whether there is
    no 'any' or 'not' above; ``timed``: what the node is in is asked after, ``""`` where that is not said."""
    kinds = (*GROUPS, *PREDICATES)
    if not isinstance(data, dict):
        raise _bad(path, data, f"one of {', '.join(kinds)}, with what belongs to it")
    found = [key for key in data if key in kinds]
    if len(found) != 1:
        strange = [str(key) for key in data if key not in (*kinds, *BESIDE)]
        raise _bad(path, ", ".join(found) or ", ".join(strange) or "nothing", f"one of {', '.join(kinds)}")
    kind = found[0]
    _keys(data, (kind, *BESIDE), path)
    inner = f"{path}.{kind}"
    after = _moment(data["after"], f"{path}.after", values) if data.get("after") is not None else None
    if after is not None and after.kind in TRIES and not tries:
        raise _bad(
            f"{path}.after",
            after.kind,
            "phase or settle here: a try changes the scene, and stands in the outermost 'all' or one of its own",
        )
    if after is not None and after.kind not in TRIES and timed:
        raise _bad(f"{path}.after", after.kind, f"nothing here: it is asked when what it is in is, after {timed}")
    windows = {key: _window(data[key], f"{path}.{key}", values) for key in ("ever", "always") if data.get(key) is not None}
    if windows and (kind in GROUPS or len(windows) > 1):
        raise _bad(path, " and ".join(windows), "one of ever and always, beside a predicate")
    if windows and (timed in TRIES or (after is not None and after.kind in TRIES)):
        raise _bad(path, f"{next(iter(windows))} after a try", "what is looked at over a time of the motion")
    if windows and set(PREDICATES[kind].needs) & {"trying", "history", "hand"}:
        raise _bad(path, f"{next(iter(windows))} beside {kind}", "a predicate that is looked at again and again")
    code = data.get("code", "")
    if code and (not isinstance(code, str) or code not in Code.__members__ or not 400 <= Code[code] < 500):
        raise _bad(f"{path}.code", code, [c.name for c in Code if 400 <= c < 500])
    beside: dict[str, Any] = {"code": code, "after": after, **windows}
    for key, wanted in (("say", str), ("metric", str), ("as_given", bool), ("throughout", bool)):
        value = data.get(key, wanted())
        if not isinstance(value, wanted):
            raise _bad(f"{path}.{key}", value, "a text" if wanted is str else "true or false")
        beside[key] = value
    if beside["as_given"] and not plain:
        raise _bad(f"{path}.as_given", True, "only in 'all': what is not asked must not decide an 'any' or a 'not'")
    if beside["throughout"] and timed != "push":
        raise _bad(f"{path}.throughout", True, "only in a group after a push")
    if ":" in beside["say"]:
        raise _bad(f"{path}.say", beside["say"], "a sentence without a colon: what was measured follows it")
    if kind not in GROUPS:
        return Node(kind, _args(PREDICATES[kind].args, data[kind], inner, values), **beside)
    # Below a phase's end, a settling time, a 'not' or an 'any' nothing is tried: it would be asked while the motion still runs, where
    # nothing can go on from, or of a changed scene.
    tries = tries and kind == "all" and (after is None or after.kind in TRIES)
    plain, timed = plain and kind == "all", timed if after is None else after.kind
    if kind == "not":
        return Node(kind, of=(_node(data[kind], inner, values, False, False, timed),), **beside)
    if not isinstance(data[kind], list) or not data[kind]:
        raise _bad(inner, data[kind], "a list of nodes")
    return Node(kind, of=tuple(_node(item, f"{inner}[{k}]", values, tries, plain, timed) for k, item in enumerate(data[kind])), **beside)


def _in_order(node: Node, path: str, tried: str = "") -> str:
    """Refuse a phase or a settling time after a try in the order of the tree, where it would be asked of the changed scene; ``tried``: the
    try before the node.  Returns the last one up to its end."""
    if node.after is not None and node.after.kind in TRIES:
        tried = node.after.kind
    elif node.after is not None and tried:
        raise _bad(
            f"{path}.after", node.after.kind, f"rest or push here: after the {tried} before it the scene is another one; put it first"
        )
    for k, child in enumerate(node.of):
        tried = _in_order(child, f"{path}.{node.kind}" if node.kind == "not" else f"{path}.{node.kind}[{k}]", tried)
    return tried


def _moment(data: Any, path: str, values: dict[str, float]) -> Moment:
    _keys(data, ("phase", "settle", *TRIES), path)
    if len(data) != 1:
        raise _bad(path, ", ".join(data), f"one of phase, settle, {', '.join(TRIES)}")
    kind, value = next(iter(data.items()))
    if kind in TRIES:
        return Moment(kind, _args(TRIES[kind], value, f"{path}.{kind}", values))
    return Moment(kind, {kind: _value(_AFTER[kind], value, f"{path}.{kind}", values)})


def _window(data: Any, path: str, values: dict[str, float]) -> dict[str, Any]:
    args = _args(_WINDOW, data, path, values)
    if bool(args["phase"]) == bool(args["seconds"]):
        raise _bad(path, data, "a phase, with the last share of it, or seconds above 0")
    return args


def _args(known: dict[str, Arg], data: Any, path: str, values: dict[str, float]) -> dict[str, Any]:
    data = {} if data is None and all(arg.default is not None for arg in known.values()) else data
    _keys(data, tuple(known), path)
    result = {}
    for name, arg in known.items():
        if name in data:
            result[name] = _value(arg, data[name], f"{path}.{name}", values)
        elif arg.default is None:
            raise _bad(path, f"without {name}", f"{name}: {arg.allowed}")
        else:
            result[name] = arg.default
    return result


def _value(arg: Arg, value: Any, path: str, values: dict[str, float]) -> Any:
    if arg.kind == "number":
        if isinstance(value, str):
            if value not in values:
                raise _bad(path, value, [arg.allowed, *values])
            return value
        return _in_bounds(arg, value, path)
    if arg.kind == "point" or (arg.kind == "direction" and isinstance(value, (list, tuple))):
        if not isinstance(value, (list, tuple)) or len(value) != 3:
            raise _bad(path, value, arg.allowed)
        point = tuple(_plain(v, path) for v in value)
        if arg.kind == "direction" and math.hypot(*point) < 1e-6:
            raise _bad(path, value, "a direction that is not zero")
        return point
    allowed = {"body": MOVING, "direction": DIRECTIONS, "word": arg.words}.get(arg.kind)
    if not isinstance(value, str) or not value or (allowed is not None and value not in allowed):
        raise _bad(path, value, arg.allowed)
    return value


def _in_bounds(arg: Arg, value: Any, path: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not arg.least <= value <= arg.most:
        raise _bad(path, value, arg.allowed)
    return float(value)


def _named(known: dict[str, Arg], args: dict[str, Any]) -> list[str]:
    return [args[name] for name, arg in known.items() if arg.kind == "number" and isinstance(args.get(name), str)]


def _names(node: Node) -> list[str]:
    found = _named(PREDICATES[node.kind].args, node.args) if node.kind in PREDICATES else []
    if node.after is not None:
        found += _named(TRIES.get(node.after.kind, _AFTER), node.after.args)
    for window in (node.ever, node.always):
        found += _named(_WINDOW, window) if window else []
    return found


def _filled_args(known: dict[str, Arg], args: dict[str, Any], path: str, values: dict[str, float]) -> dict[str, Any]:
    return {
        name: _in_bounds(known[name], values[value], f"{path}.{name} (values.{value})")
        if known[name].kind == "number" and isinstance(value, str)
        else value
        for name, value in args.items()
    }


def _filled(node: Node, path: str, values: dict[str, float]) -> Node:
    """The node with the numbers that its names stand for."""
    inner = f"{path}.{node.kind}"
    after = node.after
    if after is not None:
        known = TRIES.get(after.kind, _AFTER)
        after = Moment(after.kind, _filled_args(known, after.args, f"{path}.after", values))
    ever, always = (
        None if window is None else _filled_args(_WINDOW, window, f"{path}.{key}", values)
        for key, window in (("ever", node.ever), ("always", node.always))
    )
    args = _filled_args(PREDICATES[node.kind].args, node.args, inner, values) if node.kind in PREDICATES else {}
    of = tuple(_filled(child, inner if node.kind == "not" else f"{inner}[{k}]", values) for k, child in enumerate(node.of))
    return replace(node, args=args, of=of, after=after, ever=ever, always=always)


# ------------------------------------------------------------------------------------------------ writing


def _args_data(args: dict[str, Any], known: dict[str, Arg] | None = None) -> dict[str, Any]:
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in args.items()
        if known is None or known[name].default is None or value != known[name].default
    }


def _node_data(node: Node) -> dict[str, Any]:
    if node.kind in PREDICATES:
        data: dict[str, Any] = {node.kind: _args_data(node.args, PREDICATES[node.kind].args)}
    elif node.kind == "not":
        data = {"not": _node_data(node.of[0])}
    else:
        data = {node.kind: [_node_data(child) for child in node.of]}
    # What is said of a group comes before its list, which may be long.
    beside: dict[str, Any] = {}
    if node.after is not None:
        args = _args_data(node.after.args, TRIES.get(node.after.kind))
        beside["after"] = args if node.after.kind in _AFTER else {node.after.kind: args}
    for key, window in (("ever", node.ever), ("always", node.always)):
        if window is not None:
            beside[key] = _args_data(window, _WINDOW)
    beside |= {key: value for key in BESIDE[3:] if (value := getattr(node, key))}
    return {**data, **beside} if node.kind in PREDICATES else {**beside, **data}


# ------------------------------------------------------------------------------------------------ words

#: Lengths below this (m) are said in tenths of a millimetre.
_FINE = 0.01


def _length(value: float) -> str:
    return f"{1000 * value:.0f} mm" if abs(value) >= _FINE else f"{1000 * value:.3g} mm"


def _direction(value: Any) -> str:
    if isinstance(value, str):
        return {"pull": "the pull", "left": "the left", "press": "the target's normal, inwards"}.get(value, value)
    return f"({', '.join(f'{v:g}' for v in value)})"


class _Said:
    """One argument as the templates of :data:`PREDICATES` ask for it, beside the others (``args``)."""

    def __init__(self, value: Any, args: dict[str, Any]) -> None:
        self._value = value
        self._args = args

    def __format__(self, how: str) -> str:
        value = self._value
        if how in _UNITS and isinstance(value, str):
            return f" and {value}" if how == "turning" else value  # a name that no number stands for yet
        if how == "drift":
            return f"{value:g} of its radius" if self._args["of"] == "radius" else _length(value)
        if how in _UNITS:
            return _UNITS[how](value)
        if how in _PHRASES:
            return _PHRASES[how][value]
        return _direction(value)


_UNITS: dict[str, Callable[[Any], str]] = {
    "mm": _length,
    "deg": lambda value: f"{value:g} degrees",
    "speed": lambda value: f"{value:g} m/s",
    "turning": lambda value: "" if math.isinf(value) else f" and {value:g} rad/s",
    "drift": _length,
    "impulse": lambda value: f"{value:g} N s",
}
_PHRASES = {
    "axis": {"any": "any axis", "up": "the upright", "level": "a level axis"},
    "frame": {"start": "where it stood", "world": "the world"},
}


def leaf_words(node: Node) -> str:
    """A predicate as a sentence."""
    return PREDICATES[node.kind].words.format(**{name: _Said(value, node.args) for name, value in node.args.items()})


def node_words(node: Node) -> str:
    """A node in one line."""
    if node.kind in PREDICATES:
        said = leaf_words(node)
    elif node.kind == "not":
        said = f"not: {node_words(node.of[0])}"
    else:
        said = f" {'and' if node.kind == 'all' else 'or'} ".join(node_words(child) for child in node.of)
    return said if node.after is None else f"{moment_words(node.after)}, {said}"


def moment_words(moment: Moment) -> str:
    """When a node is asked."""
    args = moment.args
    if moment.kind == "phase":
        return f"at the end of the phase {args['phase']}"
    if moment.kind == "settle":
        return f"{args['settle']:g} s after the motion" if not isinstance(args["settle"], str) else f"{args['settle']} after the motion"
    if moment.kind == "rest":
        friction = (
            ""
            if isinstance(args["friction"], float) and math.isinf(args["friction"])
            else f", with a friction of at most {args['friction']}"
        )
        return f"when the {args['what']} has come to rest{friction}"
    speed = args["speed"] if isinstance(args["speed"], str) else f"{args['speed']:g} m/s"
    return f"after the {args['what']} was pushed from all sides at {speed}"


def words(goal: Goal) -> list[str]:
    """The goal in plain sentences, one a line, what belongs to a group indented under it.  Raises as :meth:`Goal.resolved`."""
    full = goal.resolved()
    lines = []
    for name, args in full.trial.items():
        if name == "kicked" and args["radii"] > 0:
            lines.append(f"meanwhile the target is kicked sideways, by {args['radii']:g} of its radius")
        elif name == "resists":
            lines.append(f"meanwhile the target resists along {_direction(args['along'])} with {args['force']:g} N")
        elif name == "row":
            lines.append(f"beside the target stand {args['others']:g} like it, {_length(args['spacing'])} apart")
    return [*lines, *_lines(full.tree, "")]


def _lines(node: Node, indent: str) -> list[str]:
    when = [] if node.after is None else [moment_words(node.after)]
    window = node.ever or node.always
    if window is not None:
        often = "some time" if node.ever is not None else "all the time"
        span = f"the last {window['seconds']:g} s" if window["seconds"] else f"the phase {window['phase']}"
        share = f"the last {100 * window['last']:g} % of " if not window["seconds"] and window["last"] < 1 else ""
        when.append(f"{often} in {share}{span}")
    if node.as_given:
        when.append("in the scene as given")
    said = ", ".join(when)
    if node.kind in PREDICATES:
        return [f"{indent}{said + ', ' if said else ''}{leaf_words(node)}"]
    if node.kind == "all" and not said and not indent:
        return [line for child in node.of for line in _lines(child, indent)]
    head = {"all": "all of", "any": "one of", "not": "not"}[node.kind]
    return [f"{indent}{said + ', ' if said else ''}{head}:", *(line for child in node.of for line in _lines(child, indent + "  "))]


def direction_of(along: Any, target_normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vector (3,) of a direction's name (:data:`DIRECTIONS`) or numbers, in the world.

    target_normal (3,) is the strategy's, in the world.  Raises ``BAD_STRATEGY`` for a level direction of an upright normal.
    """
    if not isinstance(along, str):
        return transforms.unit(np.asarray(along, dtype=float))
    if along in ("up", "down"):
        return np.array([0.0, 0.0, 1.0 if along == "up" else -1.0])
    inwards = -np.asarray(target_normal, dtype=float)
    if along == "press":
        return transforms.unit(inwards)
    level = inwards * [1.0, 1.0, 0.0]
    if np.linalg.norm(level) < 1e-6:
        what = f"target_normal of a strategy with the direction '{along}'"
        raise MagicError(Code.BAD_STRATEGY, what, target_normal, "a direction along the table")
    level = transforms.unit(level)
    return level if along == "pull" else np.cross([0.0, 0.0, 1.0], level)
