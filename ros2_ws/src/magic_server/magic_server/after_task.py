"""What is seen after a motion: each thing by the id that it had before, and the tool wherever it may be.

A target that has been taken along is another thing to the cameras, or a part of the tool that carries it: it is what has its colour, is
none of the tool, and where its shape, as it was seen before, can be laid on that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import conversions, transforms
from magic_core.scene import UNSEEN
from magic_interfaces.msg import SceneObject, SceneObjectArray
from magic_server import in_hand, scene_change
from magic_server.held import Carried, Held
from magic_server.seen_goal import Sight, Thing
from magic_server.stages import hull_of

#: What is seen is of the tool where more than this share of it is on the tool's surface; and no target under its id where so much is.
MOSTLY, MIXED = 0.9, 0.5
#: A target's colour is that which it had where each chromaticity (of 1) differs by less, lit otherwise as it may be.
SHADE = 0.05
#: Where a target is that was taken along nothing tells but what is seen of it: how far it may be from there (m, rad).
ANYWHERE = in_hand.Spread(0.03, 0.03, 3.0)
#: Its shape lies on what is seen of it where that is so near to it, m, root mean square, and most of what is seen is of it.
LAID, MOST = 0.004, 0.5


@dataclass(frozen=True)
class Placed:
    """A tool, or the target, by its id, its shape, and where it is: world_from_tool (4, 4)."""

    id: str
    shape: in_hand.Shape
    world_from_tool: NDArray[np.float64]

    def on(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(N,): which of points (N, 3) are on its surface."""
        return self.shape.distances(self.world_from_tool, points) < in_hand.CLOSE

    def thing(self) -> Thing:
        """All of it, as the goal is asked of it."""
        return Thing.of(self.shape.mesh, self.world_from_tool, whole=True)


def share(item: SceneObject, places: Sequence[Placed]) -> float:
    """How much of what is seen of an object is on any of these surfaces, as a share."""
    points = conversions.cloud_from_msg(item.cloud)[0]
    return float(np.mean(np.any([place.on(points) for place in places], axis=0))) if len(points) and places else 0.0


@dataclass(frozen=True)
class After:
    """What is known of a scene from before a motion, and of the tool since.

    before: the scene as it was planned in, and stood: its hulls, by ids.  carried, held: the tool that was taken up, and that is in the
    hand; None: none. closing: the axis of the hand along which the fingers close.  tolerance: m that a thing which stands is seen to move
    at most; accuracy: m to which it is known.
    """

    before: SceneObjectArray
    stood: Mapping[str, NDArray[np.float64]]
    tool: str
    target: str
    carried: Carried | None
    held: Held | None
    closing: int
    tolerance: float
    accuracy: float

    def sights(self, scene: SceneObjectArray, hand: Callable[[float], NDArray[np.float64]]) -> list[Sight]:
        """Things where a scene shows them, for each place where the tool may be; hand: world_from_tcp (4, 4) by stamps.

        The tool is where the hand has it, or where its shape is seen once that has let it go; ids may have been handed
        on: tool and target were near each other.
        """
        # What is remembered from before the motion does not tell what came of it.
        items, stamp = [item for item in scene.objects if UNSEEN not in item.cut_off], conversions.time_from_msg(scene.header.stamp)
        if self.held is not None:
            there = hand(stamp)
            places = [Placed(self.held.tool.id, self.held.shape, self.held.pose(there))]
            items = [item for item in items if not self.held.sees(item, there, self.stood)]
        else:
            places = self._let_go(scene)
        items = [item for item in items if all(share(item, [place]) <= MOSTLY for place in places)]
        things = {item.id: thing(item) for item in items}
        if not places and self.carried is not None:
            self._name_tool(things, self.carried)
        if self.target in self.stood:
            things = self._named_target(things, items, scene, places)
        return [Sight({**things, **shape}, stamp) for shape in [{place.id: place.thing()} for place in places] or [{}]]

    def _named_target(
        self, things: dict[str, Thing], items: Sequence[SceneObject], scene: SceneObjectArray, places: Sequence[Placed]
    ) -> dict[str, Thing]:
        """Things with the target by its id: what has its form, or else where its shape lies on what is seen; not what is mostly the
        tool.  ``places``: where the tool may be."""
        before = next(item for item in self.before.objects if item.id == self.target)
        form = thing(before)
        if self.target in things and form.like(things[self.target], 2 * self.accuracy):
            return things
        alike = [i for i in things.keys() - self.stood.keys() if form.like(things[i], 2 * self.accuracy)]
        if len(alike) == 1:
            return {self.target if i == alike[0] else i: there for i, there in things.items()}
        laid = self._laid(before, scene, places)
        if laid is not None:
            rest = {item.id for item in items if share(item, [*places, laid]) > MOSTLY}
            return {**{i: there for i, there in things.items() if i not in rest}, self.target: laid.thing()}
        part = all(self._may_be_part(item, before, places) for item in items if item.id == self.target)
        return {i: there for i, there in things.items() if i != self.target or part}

    def _may_be_part(self, item: SceneObject, target: SceneObject, places: Sequence[Placed]) -> bool:
        """Whether what is seen by the target's id may be a part of it: of its colour, no larger, and not mostly the tool, to
        which the id may have been handed on."""
        (points, shown), (own, colors) = (conversions.cloud_from_msg(one.cloud) for one in (item, target))
        if item.source != SceneObject.CAMERA or not len(points) or not len(own):
            return True
        alike = np.mean(_alike(shown, colors)) > MOST
        whole = transforms.apply(conversions.pose_from_msg(target.pose), conversions.mesh_from_msg(target.mesh).vertices)
        return bool(alike) and _across(points) <= _across(whole) + 2 * self.accuracy and share(item, places) <= MIXED

    def _laid(self, target: SceneObject, scene: SceneObjectArray, places: Sequence[Placed]) -> Placed | None:
        """Where the target has been taken, its shape and colours as they were seen before laid on what is seen and is none of the tool;
        ``None``: too little of it is seen, or that goes with the target in several places."""
        pose, up = conversions.pose_from_msg(target.pose), conversions.plane_from_msg(scene.table)[:3]
        own, colors = conversions.cloud_from_msg(target.cloud)
        clouds = [conversions.cloud_from_msg(item.cloud) for item in strangers(scene, self.stood, self.target, self.tolerance)]
        if not len(own) or not clouds:
            return None
        points, shown = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
        kept = _alike(shown, colors)
        for place in places:
            kept &= ~place.on(points)
        points = points[kept]
        if len(points) < in_hand.FEWEST:
            return None
        shape = in_hand.Shape.of(conversions.mesh_from_msg(target.mesh), transforms.apply(transforms.inverse(pose), own))
        # Cameras look down: most of the target is below what is seen of it.
        middle = transforms.apply(pose, shape.mesh.bounds.mean(axis=0))
        height = float(np.ptp(transforms.apply(pose, shape.mesh.vertices) @ up))
        there = np.median(points, axis=0) - 0.25 * height * up
        expected = transforms.make(translation=there - middle) @ pose
        found = in_hand.located(shape, expected, points, transforms.make(translation=there), self.closing, ANYWHERE)
        hulls = [scene_change.hull(transforms.apply(one.world_from_tool, shape.mesh.vertices)) for one in found]
        # A ball may lie in any turn: it is in one place all the same.
        if not found or any(scene_change.distance(hulls[0], other) > 2 * self.accuracy for other in hulls[1:]) or found[0].distance > LAID:
            return None
        placed = Placed(target.id, shape, found[0].world_from_tool)
        on = placed.on(points)
        nearest = shape.tree.query(transforms.apply(transforms.inverse(placed.world_from_tool), points[on]))[1]
        facing = shape.normals[nearest] @ placed.world_from_tool[:3, :3].T @ up
        return placed if on.mean() > MOST and facing.mean() > 0 else None

    def _name_tool(self, things: dict[str, Thing], carried: Carried) -> None:
        """Give its id to what is seen of a tool that the hand has let go and whose shape is not told by that: some part of it, whatever
        is seen under its id, or else the most of what is where it was let go."""
        held = carried.held
        if held.tool.id not in things and carried.let_go_at is not None:
            place, strange = held.hull(carried.let_go_at), things.keys() - self.stood.keys()
            near = [i for i in strange if scene_change.contained(scene_change.hull(things[i].points), place, scene_change.ABOUT)]
            if near:
                things[held.tool.id] = things.pop(max(near, key=lambda i: float(np.prod(things[i].extents))))
        if held.tool.id in things:
            things[held.tool.id] = things[held.tool.id].part(float(np.linalg.norm(held.mesh.extents)))

    def _let_go(self, scene: SceneObjectArray) -> list[Placed]:
        """Where the hand has let the tool go, its shape as it was seen before, laid on what is seen there, in each of the ways in which
        that is as likely; empty: it was never taken up, or too little of it is seen.

        What is seen of a tool that hangs stops where it is near what holds it, what is seen there counts as that, and it has no more of its
        hollows than shows now.
        """
        if self.carried is None or self.carried.let_go_at is None:
            return []
        held, there = self.carried.held, self.carried.let_go_at
        points = points_of(scene, self.stood, self.tool, self.tolerance)
        found = in_hand.located(held.shape, held.pose(there), points, there, self.closing, in_hand.LET_GO)
        return [Placed(held.tool.id, held.shape, one.world_from_tool) for one in found]


def thing(item: SceneObject) -> Thing:
    """An object as the goal is asked of it."""
    return Thing.of(conversions.mesh_from_msg(item.mesh), conversions.pose_from_msg(item.pose), item.source == SceneObject.KNOWN)


def _alike(shown: NDArray[np.uint8], colors: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(N,): which of colours (N, 3) are the middle one of others (M, 3), lit otherwise as they may be."""
    here, there = (each / np.maximum(each.sum(axis=1, keepdims=True, dtype=float), 1.0) for each in (shown, colors))
    return np.abs(here - np.median(there, axis=0)).max(axis=1) < SHADE


def _across(points: NDArray[np.float64]) -> float:
    """How far points (N, 3) are apart at most, m."""
    return float((scene_change.hull(points) + scene_change.hull(-points)).max())


def strangers(scene: SceneObjectArray, stood: Mapping[str, NDArray[np.float64]], moved: str, tolerance: float) -> list[SceneObject]:
    """What cameras see and what is not one of the things that stand where they stood, with hulls by ids from
    before; the thing ``moved`` is none of them."""
    found = []
    for item in scene.objects:
        if item.source != SceneObject.CAMERA or UNSEEN in item.cut_off:
            continue
        before = stood.get(item.id) if item.id != moved else None
        if before is None or scene_change.gap(before, hull_of(item), True) > tolerance:
            found.append(item)
    return found


def points_of(scene: SceneObjectArray, stood: Mapping[str, NDArray[np.float64]], tool: str, tolerance: float) -> NDArray[np.float64]:
    """(N, 3): the points of :func:`strangers`, the tool among them."""
    return np.concatenate(
        [np.zeros((0, 3)), *(conversions.cloud_from_msg(item.cloud)[0] for item in strangers(scene, stood, tool, tolerance))]
    )
