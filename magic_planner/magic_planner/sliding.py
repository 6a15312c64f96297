"""A contact that slides along the tool to where the tool has room.

Two contact points meet only if there is room for the rest of the tool.  A bowl that reaches 90 mm beyond its contact
cannot meet with it a ball whose own contact is 35 mm above the table.  At each pose the contact therefore moves along the
tool's outline, in the plane of the contact, by the least way that keeps the tool clear of table and obstacles, and the tool
keeps its attitude: the target is met further out on the same surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_planner.collision import Body, grown, hull, outer_points, solid_pieces
from magic_planner.giving_way import GAP, averaged, hits, way_along

Array = NDArray[np.float64]
#: Step along the outline and the furthest that a contact slides, metres.
STEP = 0.0005
FURTHEST = 0.3
#: The outline is followed as long as it is seen from the contact's normal at 60 degrees or less.
STEEPEST = 1.75
#: How far the outline of the mesh may be from the contact, metres.
SLACK = 0.01
#: How far, metres, a slide that clears the table is looked for one that clears the obstacles.
REACH = 0.02
#: What the table may lack of its clearance, metres, after a slide: no more than rounding.
LITTLE = 1e-9
#: Least way of the contact, metres, over which a slide begins and ends.
SMOOTHING = 0.015


def slid_contacts(
    tool: SceneObject,
    tool_from_contact: Array,
    world_from_contact: Array,
    obstacles: Sequence[SceneObject],
    plane: Array,
    clearance: float,
    gap: float = GAP,
) -> Array:
    """tool_from_contact (T, 4, 4): the frame for each pose of a path, its origin moved along the outline, its axes kept.

    world_from_contact (T, 4, 4): where the motion leads the contact frame.  plane (4,): the table, unit normal up, which the tool
    is to keep ``clearance`` metres above; gap: metres to keep to the obstacles.  Where the frame at its own place leaves room it stays
    there; where no slide does, it keeps the one of the pose before.
    """
    frames = np.repeat(tool_from_contact[None], len(world_from_contact), axis=0)
    poses = world_from_contact @ transforms.inverse(tool_from_contact)
    pieces = solid_pieces(tool)
    body, walls = Body(tool.id, grown(pieces, gap) if gap > GAP else pieces), [Body.from_object(item) for item in obstacles]
    heights = lowest(plane, poses, outer_points(tool)) - clearance
    clear = (heights >= 0) & ~hits(poses, body, walls)
    search = _Search(poses, world_from_contact[:, :3, :2], heights, plane[:3], body, walls, clear)
    if clear.all():
        return frames
    way = way_along(world_from_contact)
    sides = outline(tool, tool_from_contact)
    first = [search.outwards(int(clear.argmin()), side) for side in sides]
    # To the side on which there is room after the shorter way; the path keeps to it.
    _, points = min(((n, side) for n, side in zip(first, sides, strict=True) if n is not None), key=lambda c: c[0], default=(0, None))
    if points is not None:
        steps = _smoothed(search.least(points), way)
        places = np.column_stack([np.interp(steps, np.arange(len(points)), points[:, axis]) for axis in (0, 1)])
        frames[:, :3, 3] += places @ tool_from_contact[:3, :2].T
    return frames


def lowest(plane: Array, world_from_tool: Array, points: Array) -> Array:
    """(T,) height in metres above a plane (4,) of the lowest of points (N, 3) of the tool frame at each of the poses (T, 4, 4)."""
    in_tool = plane[:3] @ world_from_tool[:, :3, :3]
    return np.asarray((in_tool @ points.T).min(axis=1) + world_from_tool[:, :3, 3] @ plane[:3] + plane[3])


@dataclass(frozen=True)
class _Search:
    """The least slide for each pose of a path.

    poses (T, 4, 4) of the tool with the contact at its own place, axes (T, 3, 2): the contact's normal and tangent, heights (T,): of
    the tool's lowest point above where it may be, up (3,): the table's normal; clear (T,): whether there is room as it is.
    """

    poses: Array
    axes: Array
    heights: Array
    up: Array
    body: Body
    walls: list[Body]
    clear: NDArray[np.bool_]

    def least(self, points: Array) -> NDArray[np.int64]:
        """(T,) the smallest of the steps along an outline (N, 2) that fit; where none does, as many as before."""
        found, now = np.zeros(len(self.poses), dtype=int), 0
        for index in range(len(self.poses)):
            if self._fits(index, points, now):
                while now and self._fits(index, points, now - 1):
                    now -= 1
            else:
                further = self.outwards(index, points, now)
                now = now if further is None else further
            found[index] = now
        return found

    def outwards(self, index: int, points: Array, start: int = 0) -> int | None:
        """The first step beyond ``start`` that fits, within REACH of where the table allows it; None where none does."""
        above = self.heights[index] - points @ (self.up @ self.axes[index]) >= -LITTLE
        steps = (start + 1 + np.flatnonzero(above[start + 1 :]))[: int(REACH / STEP)]
        return next((int(n) for n in steps if self._fits(index, points, n)), None)

    def _fits(self, index: int, points: Array, step: int) -> bool:
        if step == 0:
            return bool(self.clear[index])
        place = self.axes[index] @ points[step]
        if self.heights[index] - self.up @ place < -LITTLE:
            return False
        pose = self.poses[index].copy()
        pose[:3, 3] -= place
        self.body.move(pose)
        return not any(self.body.touches(wall, inside=False) for wall in self.walls)


def _smoothed(steps: NDArray[np.int64], way: Array) -> Array:
    """Steps (T,), nowhere fewer than the given ones, that change over SMOOTHING metres of the way (T,) at least."""
    width = max(SMOOTHING, 0.5 * STEP * float(steps.max()))
    around = zip(np.searchsorted(way, way - width), np.searchsorted(way, way + width, side="right"), strict=True)
    most = np.array([steps[first:end].max() for first, end in around])
    # A bell no wider than what the maximum was taken over: the average is nowhere below the steps.
    return averaged(most[:, None], way, lambda apart: np.where(np.abs(apart) <= width, 1.0 + np.cos(np.pi * apart / width), 0.0))[:, 0]


def outline(item: SceneObject, tool_from_contact: Array) -> tuple[Array, Array]:
    """Points (N, 2) of the surface to either side of the contact, along its normal and along its tangent, metres, in steps of STEP.

    Both begin with the contact's own place, (0, 0).
    """
    meshes = [item.mesh] if len(item.mesh.faces) else [Mesh(*hull(piece.vertices)) for piece in solid_pieces(item)]
    contact_from_tool = transforms.inverse(tool_from_contact)
    corners = np.concatenate([transforms.apply(contact_from_tool, mesh.vertices)[mesh.faces] for mesh in meshes])
    cut = _cut(corners)
    ways = np.arange(0.0, FURTHEST + STEP / 2, STEP)
    return _followed(cut, ways), _followed(cut, -ways)


def _cut(corners: Array) -> Array:
    """Segments (S, 2, 2), in x and y, in which triangles (N, 3, 3) meet the plane z = 0."""
    above = corners[..., 2] >= 0
    corners = corners[above.any(axis=1) & ~above.all(axis=1)]
    above = corners[..., 2] >= 0
    # The corner that is alone on its side comes first: its two edges meet the plane.
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    first = corners[np.arange(len(corners)), alone]
    ends = [corners[np.arange(len(corners)), (alone + n) % 3] for n in (1, 2)]
    return np.stack(
        [first[:, :2] + (end[:, :2] - first[:, :2]) * (first[:, 2] / (first[:, 2] - end[:, 2]))[:, None] for end in ends], axis=1
    )


def _followed(cut: Array, ways: Array) -> Array:
    """The outline through (0, 0) at y = ways (N,), as far as it goes."""
    heights: list[float] = []
    for y in ways:
        a, b = cut[(cut[:, :, 1].min(axis=1) <= y) & (cut[:, :, 1].max(axis=1) > y)].swapaxes(0, 1)
        crossings = a[:, 0] + (b[:, 0] - a[:, 0]) * ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))
        before, reach = (heights[-1], STEEPEST * STEP) if heights else (0.0, SLACK)
        near = crossings[np.abs(crossings - before) <= reach]
        if not len(near):
            break
        heights.append(float(near[np.abs(near - before).argmin()]))
    if not heights:
        return np.zeros((1, 2))
    return np.column_stack([np.array(heights) - heights[0], ways[: len(heights)]])
