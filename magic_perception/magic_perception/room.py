"""Room for what nobody saw: how far a thing may go on behind others.

That something nearer borders on a thing in a picture does not say that a part of it is hidden: a camera from another side may look there,
or what stands before it hides little.  So the space about its solid is asked cell by cell: which cells does every camera leave open,
because other things are before them?
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_perception.hidden import ROBOT
from magic_perception.looks import Looked

#: Edge of a cell, m, where there are no more cells than the second; so far about the solid they are looked at.
CELL, CELLS, MARGIN = 0.004, 300_000, 0.045
#: What is within so many pixels of a thing borders on it.
BESIDE = 3
#: What is narrower than so many cells is the noise of edges, or no room for a part.
WIDE = 2
#: Depth farther behind a cell than this, m, shows that it is empty; so near to another thing's solid it is that one's.
EMPTY, OWN = 0.008, 0.003


@dataclass(frozen=True)
class Room:
    """How far from its solid a thing may go on out of sight, m.

    behind: where every camera that has the place in its picture has another thing before it.  around: where one of them may also have the
    thing itself before it, as the far side of everything is hidden.  by: the labels (negative: fixtures) that are before the places of
    ``behind`` farther off than ``far``.
    """

    behind: float
    around: float
    by: tuple[int, ...]


def bordered(labels: list[NDArray[np.int32]], label: int) -> bool:
    """Whether in some picture another thing, or a fixture, borders on a thing."""
    for image in labels:
        x, y, w, h = cv2.boundingRect((image == label).view(np.uint8))
        window = image[max(y - BESIDE, 0) : y + h + BESIDE, max(x - BESIDE, 0) : x + w + BESIDE]
        near = (
            cv2.dilate((window == label).view(np.uint8), np.ones((2 * BESIDE + 1,) * 2, np.uint8)) > 0
            if w
            else np.zeros(window.shape, bool)
        )
        if np.any(near & (window != 0) & (window != label) & (window != ROBOT)):
            return True
    return False


def room(
    mesh: Mesh,
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    label: int,
    others: list[Mesh],
    world_from_table: NDArray[np.float64],
    far: float,
) -> Room:
    """The room about the solid of a thing; mesh and others, the solids of other things and of fixtures: in the table frame.

    Only cells count that hang together with the solid, where no other solid is, up to the height of its own.  What a camera takes for the
    table, or looks past, is empty.
    """
    low, high = mesh.bounds
    sides = np.array([*(high - low)[:2] + 2 * MARGIN, high[2]])
    cell = CELL * max(1.0, float(np.prod(sides / CELL) / CELLS) ** (1 / 3))
    x, y = (np.arange(low[i] - MARGIN, high[i] + MARGIN, cell) for i in range(2))
    cells = np.stack(np.meshgrid(x, y, np.arange(cell / 2, high[2] + cell, cell), indexing="ij"), axis=-1)
    shape, points = cells.shape[:3], cells.reshape(-1, 3)
    # Most cells are empty to the first camera: the others are asked for what is left.
    possible, left = np.arange(len(points)), points
    seen_as: list[NDArray[np.int32]] = []
    for look, image in zip(looks, labels, strict=True):
        camera_from_table = transforms.inverse(look.frame.world_from_camera) @ world_from_table
        there, empty = _looked_at(look, image, transforms.apply(camera_from_table, left))
        possible, left, *seen_as = (of_all[~empty] for of_all in (possible, left, *seen_as, there))
    seen = np.stack(seen_as)
    hidden = np.any((seen != 0) & (seen != label) & (seen != ROBOT), axis=0)
    for other in others:
        near, (bottom, top) = np.flatnonzero(hidden), other.bounds
        near = near[np.all((left[near] > bottom - OWN) & (left[near] < top + OWN), axis=1)]
        if len(near):
            hidden[near[_distances(other, left[near]) < OWN]] = False

    def reach(open_: NDArray[np.bool_]) -> tuple[float, NDArray[np.float32]]:
        field = np.zeros(len(points), bool)
        field[possible[open_]] = True
        farthest, away = _reach(field.reshape(shape), points, mesh, cell)
        return farthest, away[possible]

    around, away = reach(hidden)
    behind = 0.0
    if around > 0:
        behind, away = reach(hidden & ~np.any(seen == label, axis=0))
    by: set[int] = set()
    for there in seen if behind > far else ():
        before = there[away > far]
        before = before[(before != 0) & (before != label) & (before != ROBOT)]
        if len(before):
            names, counts = np.unique(before, return_counts=True)
            by.add(int(names[np.argmax(counts)]))
    return Room(behind, around, tuple(sorted(by)))


def _looked_at(look: Looked, labels: NDArray[np.int32], local: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """At points (N, 3) in the camera's frame: the label of their pixels (0 outside of the picture), and whether the camera sees them to be
    empty."""
    k = look.frame.intrinsics
    z = np.maximum(local[:, 2], 1e-3)
    u, v = np.rint(k.fx * local[:, 0] / z + k.cx), np.rint(k.fy * local[:, 1] / z + k.cy)
    inside = (local[:, 2] > 0.05) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    u, v = (np.where(inside, i, 0).astype(int) for i in (u, v))
    there = np.where(inside, labels[v, u], 0)
    with np.errstate(invalid="ignore"):
        past = look.frame.depth[v, u] > local[:, 2] + EMPTY
    return there, inside & ((there == 0) | past)


def _reach(open_: NDArray[np.bool_], points: NDArray[np.float64], mesh: Mesh, cell: float) -> tuple[float, NDArray[np.float32]]:
    """How far from the solid the open cells reach that hang together with it, m, and how far each of the points (N, 3) of all cells does, 0
    where it is none of them."""
    from scipy import ndimage

    away = np.zeros(len(points), np.float32)
    where = np.nonzero(open_)
    if len(where[0]) < WIDE**2:
        return 0.0, away
    # Few cells are open, and those below the lowest are as these.
    cut = (*(slice(int(along.min()), int(along.max()) + 1) for along in where[:2]), slice(0, int(where[2].max()) + 1))
    wide = ndimage.binary_opening(np.pad(open_[cut], ((0, 0), (0, 0), (WIDE, 0)), mode="edge"), np.ones((WIDE,) * 3))[..., WIDE:]
    pieces, count = ndimage.label(wide, np.ones((3, 3, 3)))
    if count == 0:
        return 0.0, away
    cells = np.arange(len(points)).reshape(open_.shape)[cut]
    index, piece = cells[wide], pieces[wide]
    distance = _distances(mesh, points[index])
    nearest = ndimage.minimum(distance, piece, np.arange(1, count + 1))
    reached = np.concatenate([[False], nearest < 2.5 * cell])[piece]
    away[index[reached]] = np.maximum(distance[reached], 0)
    return float(away.max()), away


def _distances(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.float32]:
    """How far points (N, 3) are from a solid, m, negative inside."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return np.asarray(scene.compute_signed_distance(o3d.core.Tensor(points.astype(np.float32))).numpy())
