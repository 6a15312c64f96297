"""Which way a target is led among other things: as the strategy has it, or turned about the vertical where something stands in the way of
that.

Seen from above: what tool and target cover of the table on their way, as unions of convex polygons, against what the other things cover.
Of strategies whose target may be led another way (:attr:`magic_core.strategy.Strategy.turned_by`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import Contact, ContactCandidate, turned_over
from magic_core.errors import Code, MagicError
from magic_core.placement import waypoint_poses
from magic_core.scene import Scene, SceneObject
from magic_core.strategy import Strategy
from magic_matcher.matching import Matcher, MatchResult
from magic_matcher.selection import ALIKE, alike, select

Array = NDArray[np.float64]
#: Matches tools with a target.
Match = Callable[[Sequence[SceneObject], SceneObject], MatchResult]
#: Step (rad) between the directions that are looked at.
STEP = np.deg2rad(10.0)
#: So much room (m) beside what is led is enough: what a tool shifts in the hand, and what reconstructions are off by.
ROOM = 0.012
#: What stands so deep (m) in the target's way is pushed aside whatever the tool: a verdict allows half of it.
PUSHED = 0.01
#: A waypoint at which the tool is so much higher (m) than where it meets the target is above things.
RAISED = 0.02


@dataclass(frozen=True)
class Way:
    """One way of a candidate: the turn (rad), the room (m) that tool and target have at least, negative where they go through something,
    and ids of what the target itself pushes aside."""

    turn: float
    room: float
    pushed: tuple[str, ...]


def footprint(item: SceneObject, pose: Array | None = None) -> list[Array]:
    """Corners (N, 2) of each piece as seen from above, where it stands or at another pose (4, 4)."""
    pose = item.world_from_object if pose is None else pose
    pieces = [piece.vertices for piece in item.pieces if len(piece.vertices)] or [item.mesh.vertices]
    return [transforms.apply(pose, points)[:, :2] for points in pieces]


def area(pieces: Sequence[Array], shifts: Array) -> Any:
    """What pieces cover while they are led on straight lines through shifts (K, 2)."""
    import shapely

    spans = [shifts] if len(shifts) == 1 else [shifts[k : k + 2] for k in range(len(shifts) - 1)]
    swept = [(points[None] + span[:, None]).reshape(-1, 2) for points in pieces for span in spans]
    return shapely.union_all([shapely.MultiPoint(points).convex_hull for points in swept])


def turns(strategy: Strategy) -> list[float]:
    """The directions to look at, rad, the smallest turn first."""
    count = int(strategy.turned_by / STEP + 1e-6)
    return [0.0, *(sign * k * STEP for k in range(1, count + 1) for sign in (1.0, -1.0))]


def led(strategy: Strategy, candidate: ContactCandidate, tool: SceneObject | None, target: SceneObject) -> Iterator[Any]:
    """What the target covers on its way, and the tool, where its shape is known."""
    assert candidate.target is not None
    world_from_contact = target.world_from_object @ candidate.target.object_from_contact
    offsets = np.array([w.offset for w in strategy.waypoints])
    met = next((k for k, w in enumerate(strategy.waypoints) if w.phase == "contact"), len(offsets) - 1)
    moved = [k for k, w in enumerate(strategy.waypoints) if k >= met and w.phase in ("contact", "goal")]
    yield area(footprint(target), ((offsets[moved] - offsets[met]) @ world_from_contact[:3, :3].T)[:, :2])
    if tool is not None:
        low = [k for k, offset in enumerate(offsets) if abs(offset[2] - offsets[met, 2]) < RAISED]
        frame = candidate.tool.object_from_contact
        frame = turned_over(frame) if candidate.flipped and strategy.reflections[0] == "turn" else frame
        pose = world_from_contact @ waypoint_poses(strategy.waypoints, {})[met] @ transforms.inverse(frame)
        yield area(footprint(tool, pose), ((offsets[low] - offsets[met]) @ world_from_contact[:3, :3].T)[:, :2])


def room(swept: Any, other: Any) -> float:
    """Metres between two areas, or, negative, how far they are in each other: the side of a square as large as what both cover."""
    return float(swept.distance(other)) or -float(np.sqrt(swept.intersection(other).area))


class Ways:
    """The ways of one target among other things; contact_at: where a tool is to meet the target for a turn (rad)."""

    def __init__(
        self, strategy: Strategy, target: SceneObject, others: Sequence[SceneObject], contact_at: Callable[[float], Contact]
    ) -> None:
        self._strategy, self._target, self._contact_at = strategy, target, contact_at
        self._others = {item.id: area(footprint(item), np.zeros((1, 2))) for item in others if item.id != target.id and not item.hanging}
        self._contacts: dict[float, Contact] = {}

    def at(self, candidate: ContactCandidate, turn: float) -> ContactCandidate:
        """The candidate turned."""
        if turn == 0.0:
            return candidate
        if turn not in self._contacts:
            self._contacts[turn] = self._contact_at(turn)
        return replace(candidate, target=self._contacts[turn], turn=turn)

    def best(self, candidate: ContactCandidate, tool: SceneObject | None) -> Way:
        """The way that is turned the least of those with room enough; of none the one that pushes nothing aside, with the most room."""
        found: list[Way] = []
        others = {name: other for name, other in self._others.items() if tool is None or name != tool.id}
        if not others:
            return Way(0.0, np.inf, ())
        for turn in turns(self._strategy):
            target, *rest = led(self._strategy, self.at(candidate, turn), tool, self._target)
            free = min(room(swept, other) for swept in (target, *rest) for other in others.values())
            pushed = tuple(name for name, other in others.items() if target.buffer(-PUSHED).intersects(other))
            found.append(Way(turn, free, pushed))
            if free >= ROOM:
                break
        return max(found, key=lambda way: (not way.pushed, min(way.room, ROOM)))


@dataclass(frozen=True)
class Led:
    """The candidates of a match, each led the way that suits it best, and of each that way."""

    candidates: tuple[ContactCandidate, ...]
    ways: tuple[Way, ...]

    @property
    def worth(self) -> float:
        """What the best of them promises: the score of one with room enough, half of it for one that has less, nothing for one whose target
        pushes something aside."""
        rated = zip(self.candidates, self.ways, strict=True)
        return max((0.0 if way.pushed else c.score if way.room >= ROOM else c.score / 2 for c, way in rated), default=0.0)

    @property
    def clear(self) -> tuple[ContactCandidate, ...]:
        """Those whose target pushes nothing aside."""
        return tuple(c for c, way in zip(self.candidates, self.ways, strict=True) if not way.pushed)


def lead(
    strategy: Strategy,
    candidates: Sequence[ContactCandidate],
    target: SceneObject,
    objects: Sequence[SceneObject],
    contact_at: Callable[[float], Contact],
) -> Led:
    """Each candidate as it is best led among all ``objects`` of a scene; contact_at: as for :class:`Ways`."""
    ways, tools = Ways(strategy, target, objects, contact_at), {item.id: item for item in objects}
    best = tuple(ways.best(candidate, tools.get(candidate.tool_id)) for candidate in candidates)
    return Led(tuple(ways.at(c, way.turn) for c, way in zip(candidates, best, strict=True)), best)


def blocked(strategy: Strategy, target: SceneObject, led: Led, objects: Sequence[SceneObject]) -> MagicError:
    """What is to be said where each candidate's target pushes something aside: what stands in the way, by how it is led best."""
    names = dict.fromkeys(name for way in led.ways for name in way.pushed)
    places = {item.id: item.world_from_box[:2, 3] for item in objects}
    told = ", ".join(f"{name} at ({places[name][0]:.2f}, {places[name][1]:.2f}) m" for name in names)
    most = f"turned by up to {np.degrees(strategy.turned_by):.0f} degrees to either side"
    return MagicError(Code.WAY_BLOCKED, f"what stands where {target.id} is to be led", told, f"nothing there, or nothing on a way {most}")


def kept(strategy: Strategy, result: MatchResult, target: SceneObject, led: Led, objects: Sequence[SceneObject]) -> MatchResult:
    """A match with those of its candidates whose target pushes nothing aside; raises ``WAY_BLOCKED`` where there are none."""
    if not led.clear:
        raise blocked(strategy, target, led, objects)
    return replace(result, candidates=led.clear)


def match_led(matcher: Matcher, match: Match, strategy: Strategy, scene: Scene, tool_ids: Sequence[str], target_id: str) -> MatchResult:
    """The match of what a request names in a scene, or means by naming nothing, each candidate led among the other things.

    Of several things that may as well be the target it is the first whose best candidate has its way, else that whose best promises
    most (:attr:`Led.worth`).  Candidates
    whose target would push something aside are left out; ``WAY_BLOCKED`` where there are no others.  Raises what selection and match do.
    """
    tools, target = select(scene, strategy, tool_ids, target_id, matcher.target_view)
    if not strategy.turned_by:
        return match(tools, target)
    targets = [target] if target_id else alike(strategy, [o for o in scene.objects if o.id not in tool_ids], matcher.target_view)
    found: list[tuple[float, MatchResult | MagicError]] = []
    for item in targets:
        worth = -1.0
        try:
            result = match(select(scene, strategy, tool_ids, item.id, matcher.target_view)[0], item)
            led = lead(strategy, result.candidates, item, scene.objects, contacts_of(matcher, strategy, item))
            worth = led.worth
            found.append((worth, kept(strategy, result, item, led, scene.objects)))
        except MagicError as error:
            found.append((worth, error))
            continue
        if worth >= ALIKE * max(candidate.score for candidate in result.candidates):
            break
    best = max(found, key=lambda entry: entry[0])[1]
    if isinstance(best, MagicError):
        raise best
    return best


def contacts_of(matcher: Matcher, strategy: Strategy, target: SceneObject) -> Callable[[float], Contact]:
    """Where a tool is to meet a target for a turn (rad)."""
    return lambda turn: matcher.target_of(target, strategy.turned(turn)).contact
