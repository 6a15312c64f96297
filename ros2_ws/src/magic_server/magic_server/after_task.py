"""What is seen after a motion: each thing by the id that it had before, and the tool wherever it may be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import conversions
from magic_core.scene import UNSEEN
from magic_interfaces.msg import SceneObject, SceneObjectArray
from magic_server import in_hand, scene_change
from magic_server.held import Carried, Held
from magic_server.seen_goal import Sight, Thing
from magic_server.stages import hull_of

#: What is seen is of the tool where more than this share of it is on the tool's surface.
MOSTLY = 0.9


@dataclass(frozen=True)
class Placed:
    """A tool by its id, its shape, and where it is: world_from_tool (4, 4)."""

    id: str
    shape: in_hand.Shape
    world_from_tool: NDArray[np.float64]

    def explains(self, item: SceneObject) -> bool:
        """Whether an object that is seen is this tool, or a part of it, whatever its id."""
        points = conversions.cloud_from_msg(item.cloud)[0]
        return len(points) > 0 and float(np.mean(self.shape.distances(self.world_from_tool, points) < in_hand.CLOSE)) > MOSTLY


@dataclass(frozen=True)
class After:
    """What is known of a scene from before a motion, and of the tool since.

    before: the scene as it was planned in, and stood: its hulls, by ids.  carried, held: the tool that was taken up, and that is in the hand; None: none.
    closing: the axis of the hand along which the fingers close.  tolerance: m that a thing which stands is seen to move at most; accuracy: m to which it is
    known.
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

        The tool is where the hand has it, or where its shape is seen once that has let it go; ids may have been handed on: tool and target were near each
        other.
        """
        # What is remembered from before the motion does not tell what came of it.
        items, stamp = [item for item in scene.objects if UNSEEN not in item.cut_off], conversions.time_from_msg(scene.header.stamp)
        if self.held is not None:
            there = hand(stamp)
            places = [Placed(self.held.tool.id, self.held.shape, self.held.pose(there))]
            items = [item for item in items if not self.held.sees(item, there, self.stood)]
        else:
            places = self._let_go(scene)
        items = [item for item in items if not any(place.explains(item) for place in places)]
        things = {item.id: thing(item) for item in items}
        if not places and self.carried is not None:
            self._name_tool(things, self.carried)
        if self.target not in things and self.target in self.stood:
            before = next(thing(item) for item in self.before.objects if item.id == self.target)
            alike = [i for i in things.keys() - self.stood.keys() if before.like(things[i], 2 * self.accuracy)]
            if len(alike) == 1:
                things[self.target] = things.pop(alike[0])
        shapes = [{place.id: Thing.of(place.shape.mesh, place.world_from_tool, whole=True)} for place in places]
        return [Sight({**things, **shape}, stamp) for shape in shapes or [{}]]

    def _name_tool(self, things: dict[str, Thing], carried: Carried) -> None:
        """Give its id to what is seen of a tool that the hand has let go and whose shape is not told by that: some part of it, whatever is seen under its id, or
        else the most of what is where it was let go."""
        held = carried.held
        if held.tool.id not in things and carried.let_go_at is not None:
            place, strange = held.hull(carried.let_go_at), things.keys() - self.stood.keys()
            near = [i for i in strange if scene_change.contained(scene_change.hull(things[i].points), place, scene_change.ABOUT)]
            if near:
                things[held.tool.id] = things.pop(max(near, key=lambda i: float(np.prod(things[i].extents))))
        if held.tool.id in things:
            things[held.tool.id] = things[held.tool.id].part(float(np.linalg.norm(held.mesh.extents)))

    def _let_go(self, scene: SceneObjectArray) -> list[Placed]:
        """Where the hand has let the tool go, its shape as it was seen before, laid on what is seen there, in each of the ways in which that is as likely; empty:
        it was never taken up, or too little of it is seen.

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


def points_of(scene: SceneObjectArray, stood: Mapping[str, NDArray[np.float64]], tool: str, tolerance: float) -> NDArray[np.float64]:
    """(N, 3): what cameras see and what is not one of the things that stand where they stood, with hulls by ids from before; the tool is none of them."""
    points = [np.zeros((0, 3))]
    for item in scene.objects:
        if item.source != SceneObject.CAMERA or UNSEEN in item.cut_off:
            continue
        before = stood.get(item.id) if item.id != tool else None
        if before is None or scene_change.gap(before, hull_of(item), True) > tolerance:
            points.append(conversions.cloud_from_msg(item.cloud)[0])
    return np.concatenate(points)
