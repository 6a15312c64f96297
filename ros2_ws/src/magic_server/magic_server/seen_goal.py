"""Whether a strategy's goal is met by what cameras see after the motion.  No ROS here.

The goal is the tree that simulation decides as well (:mod:`magic_core.goal`); here it is asked of where things are before the
motion and in two looks after it.  An answer is yes, no, or that it cannot be told: where a thing is not seen, where it is
nearer to a bound than its place is known, of how it is turned (the frame of a reconstructed thing is another one with each look), and of
what was to be looked at earlier than the looks are: the end of a phase is asked of them where the tool does nothing after it.
What touches what is told by how near their surfaces are, and where the hand is by the arm's joints.  Surfaces that are seen apart
may touch all the same where not all of them is seen: a thing of which a part is seen goes on somewhere, and what is seen of one stops
short of a fixture, to which perception counts what is as near to it as it may be wrong.

What only a simulation can try (pushes, pulls to the side), and masses and impulses, no look tells; they were asked when the motion was
verified.  In a plain 'all' they are left out, and the answer says so; below an 'any' or a 'not' they cannot be told.  That one body is in
another, which a simulation may show, no true ones are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magic_core import transforms
from magic_core.goal import PREDICATES, Node, direction_of, leaf_words, moment_words, node_words
from magic_core.mesh import Mesh
from magic_core.strategy import Strategy
from magic_server import scene_change

Array = NDArray[np.float64]

#: What no camera tells.
UNASKED = frozenset({"masses", "history", "trying"})
#: Points that stand for a surface lie about so far apart, m, much nearer than its place is known: what touches is
#: as near as points are. At most so many.
SPACING, MOST = 0.002, 20000
#: Points that stand for a link of the arm.
SURFACE = 1000
#: The gripper, by the names that goals have for it.
HAND = ("hand", "arm", "fingers")
#: After these phases' beginning the tool acts no more.
ENDING = ("retreat",)
#: Looks are put no farther apart than this to tell slow motions, s.
APART = 5.0
#: What a goal lets come to rest is looked at for so long, s: a simulation calms it, by itself a thing that hangs swings on.
CALMING = 20.0
#: What is seen of a thing that touches a fixture ends so far from it at most, m: points as near as perception's ``known_margin`` to a
#: fixture are the fixture's, and lie apart.
SHORT = 0.02


@dataclass(frozen=True)
class Thing:
    """An object as it was seen: points (N, 3) on its surface and the middle (3,) of its box, in the world.

    given: it is a fixture.  whole: all of its surface is there, of one that cameras see what they see.  span: where that is some part of
    it, all of it lies within so many m of each of the points.
    """

    points: Array
    middle: Array
    given: bool = False
    whole: bool = False
    span: float | None = None

    @classmethod
    def of(cls, mesh: Mesh, world_from_object: Array, given: bool = False, whole: bool = False) -> Thing:
        """Of a mesh at a pose (4, 4)."""
        corners = transforms.apply(world_from_object, mesh.vertices)
        surface = mesh.vertices
        if len(mesh.faces):
            body = mesh.to_trimesh()
            count = min(MOST, int(np.ceil(body.area / SPACING**2)))
            surface = np.concatenate([surface, trimesh.sample.sample_surface(body, count, seed=0)[0]])
        return cls(transforms.apply(world_from_object, surface), (corners.min(axis=0) + corners.max(axis=0)) / 2, given, whole or given)

    def part(self, span: float) -> Thing:
        """The same as some part of a thing that is ``span`` m from one end to the other."""
        return replace(self, whole=False, span=span)

    @property
    def unseen(self) -> Array:
        """(3,): how far its middle may be from that of all of it, along the world's axes, m."""
        return np.zeros(3) if self.span is None else np.maximum(0.0, self.span - self.extents) / 2

    @property
    def extents(self) -> Array:
        """(3,): of its box along the world's axes, m."""
        return np.asarray(np.ptp(self.points, axis=0))

    def like(self, other: Thing, exact: float) -> bool:
        """Whether another thing is of this form, and turned as this one is, to ``exact`` m, wherever it is."""
        here, there = (scene_change.hull(thing.points - thing.middle) for thing in (self, other))
        return scene_change.distance(here, there) <= exact


@dataclass(frozen=True)
class Sight:
    """One look: things by id, and when, s."""

    things: Mapping[str, Thing]
    stamp: float

    def apart(self, other: Sight, name: str) -> float:
        """How far a thing is from where another look has it, m; inf where one has not."""
        if name not in self.things or name not in other.things:
            return math.inf
        return float(np.linalg.norm(self.things[name].middle - other.things[name].middle))


@dataclass(frozen=True)
class SeenGoal:
    """met: whether the goal is met, ``None`` where it cannot be told; message: by what; moving: what the goal lets come to rest is seen
    to move, and nothing else speaks against it: how it moves is why it cannot be told, or may be; unsure: where the tool is cannot be
    told by what is seen of it, which another look may."""

    met: bool | None
    message: str
    moving: bool = False
    unsure: bool = False

    @classmethod
    def of_all(cls, found: Sequence[SeenGoal]) -> SeenGoal:
        """What holds wherever the tool may be, of answers for each of the poses in which it may be."""
        first = found[0]
        if len({one.met for one in found}) == 1:
            return first
        told = "; or: ".join(dict.fromkeys(one.message for one in found if one.met is not True))
        return cls(
            None,
            f"what is seen of the tool goes with {len(found)} poses of it, in some of which {told}",
            any(one.moving for one in found),
            True,
        )


@dataclass(frozen=True)
class _Told:
    truth: bool | None
    text: str


@dataclass(frozen=True)
class Hand:
    """The hand when the motion was over: whether it has let the tool go, how far (m) it is from where it did, and points (N, 3) on the
    surface of arm and hand in the world; ``None`` where that is not known."""

    released: bool
    away: float | None = None
    points: Array | None = None


def patience(strategy: Strategy, accuracy: float) -> tuple[float, float]:
    """How long after the motion a goal is to be looked at first, and how far apart the two looks have to be at least, s.

    The first is the longest time that the goal lets things settle; the second what tells a thing at rest from one that moves by the
    goal's bound, where its place is known to ``accuracy`` (m), at most :data:`APART`: what is slower than that shows cannot be told.
    """
    nodes = list(strategy.goal.tree.nodes())
    settle = max((n.after.args["settle"] for n in nodes if n.after is not None and n.after.kind == "settle"), default=0.0)
    apart = max((2 * accuracy / n.args["below"] for n in nodes if n.kind == "at_rest" and n.args["below"] > 0), default=0.0)
    return float(settle), min(float(apart), APART)


def judge(
    strategy: Strategy,
    names: Mapping[str, str],
    phases: Sequence[str],
    looks: tuple[Sight, Sight, Sight],
    table: Array,
    hand: Hand,
    accuracy: float,
) -> SeenGoal:
    """Ask a strategy's goal of what was seen.

    names: the ids of ``tool`` and ``target``.  phases: names of the motion's, in their order.  looks: one before the motion and two after
    it.  table (4,): plane, unit normal up.  accuracy: m to which the middle of a thing is known that is seen twice.
    """
    asked = _Asked(strategy, names, phases, *looks, table, hand, accuracy)
    found = asked.node(strategy.goal.tree, True)
    if found is None:
        return SeenGoal(None, "none of it shows")
    tools = [sight.things[names["tool"]] for sight in looks[1:] if names["tool"] in sight.things]
    unsure = found.truth is None and any(tool.span is not None for tool in tools)
    unasked = dict.fromkeys(asked.unasked) if found.truth else ()
    moving = False
    if not found.truth:
        calm = replace(asked, calm=True, unasked=[])
        rest = calm.node(strategy.goal.tree, True)
        moving = calm.restless and (rest is None or rest.truth is not False)
    return SeenGoal(
        found.truth, "; ".join(filter(None, (found.text, f"not looked at: {', '.join(unasked)}" if unasked else ""))), moving, unsure
    )


@dataclass
class _Asked:
    strategy: Strategy
    names: Mapping[str, str]
    phases: Sequence[str]
    before: Sight
    first: Sight
    now: Sight
    table: Array
    hand: Hand
    accuracy: float
    #: What the goal lets come to rest is taken to be at rest; and whether it was seen to move.
    calm: bool = False
    restless: bool = False
    #: What was left out, in words.
    unasked: list[str] = field(default_factory=list)

    # ------------------------------------------------------------ the tree

    def node(self, node: Node, plain: bool, rests: bool = False) -> _Told | None:
        """The answer of a node; ``None`` where it is left out.  plain: there is no 'any' or 'not' above, so that it may be.  rests: it is
        asked when something has come to rest."""
        moment = node.after
        rests = rests or (moment is not None and moment.kind == "rest")
        if (moment is not None and moment.kind == "push") or (node.kind in PREDICATES and UNASKED & set(PREDICATES[node.kind].needs)):
            if not plain:
                return _Told(None, f"that {node_words(node)}: no look tells")
            # What is asked after a push is in its group.
            self.unasked.append(f"how it is {moment_words(moment)}" if moment is not None and node.of else f"that {node_words(node)}")
            return None
        if moment is not None and moment.kind == "phase" and not self.at_the_end(moment.args["phase"]):
            return _Told(None, f"that {node_words(node)}: it was not looked at then")
        if node.kind in PREDICATES:
            return self.calmed(node) if self.calm and rests and node.kind == "at_rest" else self.leaf(node, plain)
        plain = plain and node.kind == "all"
        found = [answer for child in node.of if (answer := self.node(child, plain, rests)) is not None]
        if not found:
            return None
        if node.kind == "not":
            return _Told(None if found[0].truth is None else not found[0].truth, f"not: {found[0].text}")
        decisive = node.kind == "any"  # one such answer decides
        decided = [answer for answer in found if answer.truth is decisive]
        if decided:
            return _Told(decisive, "; ".join(answer.text for answer in (decided[:1] if decisive else decided)))
        untold = [answer for answer in found if answer.truth is None]
        if untold:
            return _Told(None, "; ".join(dict.fromkeys(answer.text for answer in untold)))
        return _Told(not decisive, "; ".join(dict.fromkeys(answer.text for answer in found if answer.text)))

    def calmed(self, node: Node) -> _Told:
        """What comes to rest is at rest."""
        with suppress(LookupError):  # what is not seen is not seen to move
            what = "target" if node.args["what"] == "row" else node.args["what"]
            way = self.thing(what, self.now).middle - self.thing(what, self.first).middle
            self.restless = self.restless or float(np.linalg.norm(way)) > self.accuracy
        return _Told(True, "")

    def at_the_end(self, phase: str) -> bool:
        """Whether what holds at a phase's end is what is looked at: it is the last one in which the tool acts.  The goal that no phase is
        named after ends with the motion, as in simulation."""
        acting = [name for name in self.phases if name not in ENDING]
        return (phase == "goal" and phase not in self.phases) or (bool(acting) and acting[-1] == phase)

    def leaf(self, node: Node, plain: bool) -> _Told:
        """The answer of a predicate."""
        decide = getattr(self, f"_{node.kind}", None)
        if decide is None:
            return _Told(None, f"that {leaf_words(node)}: no camera tells")
        window = node.ever or node.always
        if window is not None and window["phase"] and not self.at_the_end(window["phase"]):
            return _Told(None, f"that {leaf_words(node)}: it was not looked at then")
        row = node.args.get("what") == "row"
        try:
            found = decide(**{**node.args, "what": "target"} if row else node.args)
        except LookupError as error:
            return _Told(None, f"that {leaf_words(node)}: {error.args[0]} is not seen")
        # What is seen afterwards may have been otherwise meanwhile.
        if (node.ever is not None and found.truth is False) or (node.always is not None and found.truth):
            return _Told(None, f"that {leaf_words(node)}: it is not watched all the time")
        # It holds of all in the row or of none: that it does not of the target is enough.
        if row and self.beside and found.truth:
            return _Told(None, f"that {leaf_words(node)}: of what stands beside the target nothing is looked at")
        if found.truth and math.isfinite(node.args.get("turning", math.inf)):
            turns = f"how fast the {node.args['what']} turns"
            if not plain:
                return _Told(None, f"{turns}: no camera tells")
            self.unasked.append(turns)
        return found

    @cached_property
    def beside(self) -> bool:
        """Whether the test puts others beside the target."""
        return "row" in self.strategy.goal.resolved().trial

    # ------------------------------------------------------------ what is seen

    def thing(self, name: str, sight: Sight) -> Thing:
        """Raises LookupError with the id."""
        name = self.names.get(name, name)
        if name not in sight.things:
            raise LookupError(name)
        return sight.things[name]

    def way(self, name: str) -> tuple[Array, float]:
        """How far a thing's middle has moved (3,), and how exactly that is known, m: of what is seen in part now, less so."""
        before, now = self.thing(name, self.before), self.thing(name, self.now)
        return now.middle - before.middle, self.accuracy + float(max(np.abs(now.extents - before.extents).max() / 2, now.unseen.max()))

    def height(self, thing: Thing) -> float:
        """Of its middle above the table, m."""
        a, b, c, d = (float(v) for v in self.table)
        x, y, z = (float(v) for v in thing.middle)
        return z + (a * x + b * y + d) / c

    def direction(self, along: Any) -> Array:
        """The unit vector (3,) of a direction's name or numbers."""
        return direction_of(along, self.strategy.target_normal)

    def at_least(self, value: float, bound: float, exact: float, text: str) -> _Told:
        """Whether a value is at least a bound, where it is known so exactly."""
        truth = None if abs(value - bound) < exact else value > bound
        doubt = f", known to {1000 * exact:.0f} mm" if truth is None else ""
        return _Told(truth, f"{text}{doubt}")

    # ------------------------------------------------------------ predicates

    def _moved(self, what: str, along: Any, by: float) -> _Told:
        way, exact = self.way(what)
        moved = float(way @ self.direction(along))
        return self.at_least(moved, by, exact, f"the {what} moved {1000 * moved:.0f} mm of {1000 * by:g}")

    def _stayed(self, what: str, within: float) -> _Told:
        way, exact = self.way(what)
        moved = float(np.linalg.norm(way))
        return self.at_least(-moved, -within, exact, f"the {what} moved {1000 * moved:.0f} mm, allowed {1000 * within:g}")

    def _drift(self, what: str, along: Any, below: float, of: str) -> _Told:
        (way, exact), direction = self.way(what), self.direction(along)
        side = np.cross([0, 0, 1.0], direction)
        level = np.linalg.norm(side) > 0.5
        aside = abs(float(way @ transforms.unit(side))) if level else float(np.linalg.norm(way - (way @ direction) * direction))
        if of == "radius":
            across = self.thing("target", self.before).points @ (transforms.unit(side) if level else np.array([1.0, 0.0, 0.0]))
            below *= float(across.max() - across.min()) / 2
        return self.at_least(-aside, -below, exact, f"the {what} drifted {1000 * aside:.0f} mm sideways, allowed {1000 * below:.0f}")

    def _above(self, what: str, height: float) -> _Told:
        now = self.thing(what, self.now)
        found = self.height(now)
        text = f"the {what} is {1000 * found:.0f} mm above the table, needed {1000 * height:g}"
        return self.at_least(found, height, self.accuracy + float(now.unseen[2]), text)

    def _inside(self, what: str, low: Any, high: Any, of: str) -> _Told:
        now = self.thing(what, self.now)
        place = now.middle - (self.thing("target", self.before).middle if of == "start" else 0.0)
        room = float(np.minimum(place - np.asarray(low), np.asarray(high) - place).min())
        where = f"{1000 * abs(room):.0f} mm {'inside' if room > 0 else 'outside'} of the region"
        return self.at_least(room, 0.0, self.accuracy + float(now.unseen.max()), f"the {what} is {where}")

    def _at_rest(self, what: str, below: float, turning: float) -> _Told:
        first, now = self.thing(what, self.first), self.thing(what, self.now)
        way = float(np.linalg.norm(now.middle - first.middle))
        seconds = max(self.now.stamp - self.first.stamp, 1e-3)
        parts = 0.0 if now.whole and first.whole else float(np.abs(now.extents - first.extents).max()) / 2
        exact = self.accuracy + float(max(parts, now.unseen.max(), first.unseen.max()))
        return self.at_least(-way, -below * seconds, exact, f"the {what} moved {1000 * way:.0f} mm in {seconds:.1f} s")

    def _overlap(self, what: str, whom: str, below: float) -> _Told:
        return _Told(True, "")  # bodies are in each other in a simulation alone

    def _released(self) -> _Told:
        return _Told(self.hand.released, "the tool was let go" if self.hand.released else "the tool is in the hand")

    def _hand_away(self, by: float) -> _Told:
        if not self.hand.released:
            return _Told(False, "the tool is in the hand")
        if self.hand.away is None:
            return _Told(None, "how far the hand has gone away is not known")
        text = f"the hand is {1000 * self.hand.away:.0f} mm from where it let go, needed {1000 * by:g}"
        return _Told(self.hand.away >= by, text)

    def gap(self, what: str, whom: str) -> tuple[float, float]:
        """How near the surfaces of two bodies are seen to come, and how near they may be at least, m."""
        thing = self.thing(what, self.now)
        if whom == "table":
            heights = thing.points @ self.table[:3] + self.table[3]
            seen = max(0.0, float(heights.min()))
            return seen, seen if thing.span is None else max(0.0, float(heights.max()) - thing.span)
        if whom in HAND:
            assert self.hand.points is not None
            other = Thing(self.hand.points, self.hand.points.mean(axis=0), whole=True)
        else:
            other = self.thing(whom, self.now)
        seen = float(cKDTree(other.points).query(thing.points)[0].min())
        short = SHORT if (thing.given and not other.whole) or (other.given and not thing.whole) else 0.0
        return seen, max(0.0, min([seen - short, *(_nearest(a, b) for a, b in ((thing, other), (other, thing)) if a.span is not None)]))

    def _touching(self, what: str, whom: str) -> _Told:
        if whom in HAND and what == "tool" and not self.hand.released:
            return _Told(True, "the tool is in the hand")
        if whom in HAND and self.hand.points is None:
            return _Told(None, f"whether the hand touches the {what} is not seen")
        gap, least = self.gap(what, whom)
        # Surfaces are known to the accuracy of both, and between their points is room.
        truth = True if gap <= self.accuracy else (False if least > 3 * self.accuracy else None)
        seen = f"what is seen of the {what}" if truth is None and least < gap else f"the {what}"
        return _Told(truth, f"{seen} is {1000 * gap:.0f} mm from the {whom}")

    def _touching_only(self, what: str, whom: str) -> _Told:
        own = {self.names.get(what, what), self.names.get(whom, whom)}
        others = [name for name in ("table", *self.now.things) if name != whom and name not in own]
        others += [HAND[0]] if self.hand.points is not None and whom not in HAND else []
        found = [self._touching(what, other) for other in others]
        if what == "tool" and not self.hand.released and whom not in HAND:
            return _Told(False, "the tool is in the hand")
        near = [answer for answer in found if answer.truth is not False]
        if near:  # what looks like a touch may be none: nobody knows
            return _Told(None, "; ".join(answer.text for answer in near))
        return _Told(True, f"the {what} is away from all but the {whom}")

    def _held_by(self, what: str, whom: str) -> _Told:
        touching, only = self._touching(what, whom), self._touching_only(what, whom)
        if False in (touching.truth, only.truth):
            return _Told(False, touching.text if touching.truth is False else only.text)
        return _Told(None if None in (touching.truth, only.truth) else True, f"{touching.text}; {only.text}")


def _nearest(part: Thing, other: Thing) -> float:
    """How near another thing's surface comes at least to one of which a part is seen, m: all of that is
    within its span of each of its points."""
    assert part.span is not None
    ends = part.points[np.unique((part.points @ scene_change.DIRECTIONS.T).argmax(axis=0))]
    farthest = np.max([np.linalg.norm(other.points - end, axis=1) for end in ends], axis=0)
    return max(0.0, float(farthest.min()) - part.span)
