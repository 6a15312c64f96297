"""Hoops, bent wires and other open forms that stand or rise from the table: carved out of space.

What a mask does not cover, and what lies before a measured depth, is free.  What is left, no farther behind the seen surface than
the thing is wide there, is the thing: its visual hull (Laurentini 1994), cut by the free space of the depth cameras.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_perception.sight import Sight, surfaces
from magic_perception.solids import Reconstruction, joined

#: Cells that touch along an edge alone are joined so many times: each time may make others.
EDGE_ROUNDS = 10
#: A part that holds less than this share of the largest one's cells is a speck.
LEAST_PART = 0.03
#: Convex pieces are hulls of the cells in blocks so wide (m), larger ones where there would be more than the next.
BLOCK = 0.012
MOST_BLOCKS = 100
#: Cells of the grid, at most, none smaller than 2 mm.
CELLS = 60000
#: Faces of the mesh, at most.
FACES = 20000


def build_carved(sights: list[Sight], noise: float) -> Reconstruction:
    """The carved solid; noise: of the depth, m."""
    points, _ = surfaces(sights)
    low = np.append(np.percentile(points[:, :2], 0.5, axis=0) - 0.008, 0.0)
    high = np.percentile(points, 99.5, axis=0) + [0.008, 0.008, 0.003]
    cell = float(max(0.002, (np.prod(high - low) / CELLS) ** (1 / 3)))
    axes = [np.arange(a + cell / 2, b + cell / 2, cell) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = np.ones(grid.shape[:3], np.float32)
    near = np.zeros(grid.shape[:3], bool)
    for sight in sights:
        inside, blind, z, measured = sight.sample(grid)
        with np.errstate(invalid="ignore"):
            passed = (measured > z + max(0.007, 3 * noise)) & ~blind
        field = np.minimum(field, np.where(passed, np.float32(0), inside))
        with np.errstate(invalid="ignore"):
            near |= z < sight.look_up(grid, _back(sight))
    field *= near
    field = _largest(_blurred(field, 0.7))
    if np.count_nonzero(field > 0.5) < 20:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "carved cells of one object", int(np.count_nonzero(field > 0.5)), "at least 20")
    field = _joined_edges(field, 0.5)
    mesh = surface_net(field, axes, 0.5)
    if not closed(mesh):
        mesh = level_surface(field, axes, 0.5)
    mesh = _thinned(mesh, FACES)
    return Reconstruction(mesh, tuple(_pieces(field, axes)), "carved")


def _back(sight: Sight) -> NDArray[np.float32]:
    """A picture (H, W) of the depth in metres to which the thing may reach: as far behind the seen surface as it is wide around
    there; infinite where nothing near was measured; NaN off the mask."""
    mask, heights, _, r0, c0 = sight._filled
    back = np.where(sight.mask, np.float32(np.inf), np.float32(np.nan))
    if not mask.size:
        return back
    k = sight.intrinsics
    rows, columns = mask.shape
    u, v = np.arange(columns) + c0, np.arange(rows) + r0
    down = sight.table_from_camera[2]
    fall = ((u - k.cx) / k.fx * down[0])[None] + ((v - k.cy) / k.fy * down[1])[:, None] + down[2]
    depth = (heights - down[3]) / np.minimum(fall, -1e-3)
    distance = cv2.distanceTransform(np.pad(mask, 1).view(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    # The middle line's distance to the edge holds for the whole breadth around it.
    middle = distance
    for _ in range(4):
        middle = np.maximum(middle, np.where(mask, cv2.dilate(middle, np.ones((5, 5), np.uint8)) - 2.5, 0))
    reach = np.maximum(2 * middle * depth / k.fx, 0.004)
    back[r0 : r0 + rows, c0 : c0 + columns][mask] = (depth + reach)[mask]
    return back


def _blurred(field: NDArray[np.float32], cells: float) -> NDArray[np.float32]:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(np.pad(field, 2), cells)[1:-1, 1:-1, 1:-1]


def _largest(field: NDArray[np.float32]) -> NDArray[np.float32]:
    """The field with its parts that hold less than :data:`LEAST_PART` of the largest part's cells taken out."""
    from scipy.ndimage import label

    parts, _ = label(field > 0.5)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    keep = sizes >= LEAST_PART * sizes.max(initial=1)
    keep[0] = True
    return np.where(keep[parts], field, np.float32(0))


def _joined_edges(field: NDArray[np.float32], level: float) -> NDArray[np.float32]:
    """The field with cells filled in where two others touch along an edge alone: there no surface would be closed."""
    field = field.copy()
    for _ in range(EDGE_ROUNDS):
        changed = False
        for axis in range(3):
            plane = np.moveaxis(field, axis, 0)  # a view: writing to it writes to the field
            above = plane > level
            a, b, c, d = above[:, :-1, :-1], above[:, 1:, :-1], above[:, :-1, 1:], above[:, 1:, 1:]
            for alone, shift in ((a & d & ~b & ~c, (1, 0)), (b & c & ~a & ~d, (0, 0))):
                i, j, k = np.nonzero(alone)
                if len(i):
                    plane[i, j + shift[0], k + shift[1]] = level + 0.05
                    changed = True
        if not changed:
            break
    return field


def surface_net(field: NDArray[np.float32], axes: list[NDArray[np.float64]], level: float) -> Mesh:
    """The surface around where a field is above a level, a vertex for each cell that it crosses (Gibson 1998); closed but where cells touch
    along an edge or a corner only.

    field (X, Y, Z) with a border of cells below the level around the values at ``axes``.
    """
    shape = np.array(field.shape)
    steps = np.array([float(a[1] - a[0]) for a in axes])
    start = np.array([float(a[0]) for a in axes]) - steps
    above = field > level
    total, count = np.zeros((field.size, 3)), np.zeros(field.size)
    weights = np.array([shape[1] * shape[2], shape[2], 1])
    quads = []
    for axis in range(3):
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]] @ weights
        low, high = (tuple(slice(a, b) if i == axis else slice(None) for i in range(3)) for a, b in ((0, -1), (1, None)))
        spots = np.argwhere(above[low] != above[high])
        first = spots @ weights
        ahead = first + weights[axis]
        values = field.ravel()
        place = spots.astype(float)
        place[:, axis] += (level - values[first]) / (values[ahead] - values[first])
        cells = np.stack([first - u - v, first - v, first, first - u], axis=1)
        for corner in cells.T:
            count += np.bincount(corner, minlength=field.size)
            for i in range(3):
                total[:, i] += np.bincount(corner, place[:, i], minlength=field.size)
        out = above.ravel()[first]
        quads.append(np.where(out[:, None], cells, cells[:, ::-1]))
    used = np.flatnonzero(count)
    number = np.zeros(field.size, np.int64)
    number[used] = np.arange(len(used))
    corners = number[np.concatenate(quads)]
    vertices = start + total[used] / count[used, None] * steps
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.0)
    return Mesh(vertices, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]))


def closed(mesh: Mesh) -> bool:
    """Whether every edge belongs to two triangles."""
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1).astype(np.int64)
    return bool(np.all(np.unique(edges[:, 0] * (len(mesh.vertices) + 1) + edges[:, 1], return_counts=True)[1] == 2))


#: The six tetrahedra of a cube, all around its diagonal from corner 0 to corner 7; corner bits are x, y, z.
_TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


def level_surface(field: NDArray[np.float32], axes: list[NDArray[np.float64]], level: float) -> Mesh:
    """The closed surface around where a field is above a level, by marching tetrahedra (Doi and Koide 1991).

    field (X, Y, Z) with a border of cells below the level around the values at ``axes``.
    """
    shape = field.shape
    steps = [float(a[1] - a[0]) for a in axes]
    start = np.array([a[0] - s for a, s in zip(axes, steps, strict=True)])
    above = field > level
    corner = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    count = sum(above[c[0] : shape[0] - 1 + c[0], c[1] : shape[1] - 1 + c[1], c[2] : shape[2] - 1 + c[2]].astype(np.int8) for c in corner)
    cubes = np.argwhere((count > 0) & (count < 8))
    index = np.ravel_multi_index((cubes[:, None] + corner).reshape(-1, 3).T, shape).reshape(-1, 8)
    tetra = index[:, _TETRAHEDRA].reshape(-1, 4)
    inside = above.ravel()[tetra]
    total = inside.sum(axis=1)
    pairs = []
    # One corner apart from three: a triangle; two from two: a quadrilateral.
    for lone, which in ((1, True), (3, False)):
        rows = tetra[total == lone]
        order = np.argsort(inside[total == lone] != which, axis=1, kind="stable")
        rows = np.take_along_axis(rows, order, axis=1)
        pairs.append(np.stack([rows[:, [0, 0, 0]], rows[:, 1:]], axis=2))
    rows = tetra[total == 2]
    order = np.argsort(~inside[total == 2], axis=1, kind="stable")
    a, b, c, d = np.take_along_axis(rows, order, axis=1).T
    pairs.append(np.stack([np.stack([a, a, b], axis=1), np.stack([c, d, c], axis=1)], axis=2))
    pairs.append(np.stack([np.stack([a, b, b], axis=1), np.stack([d, d, c], axis=1)], axis=2))
    edges = np.sort(np.concatenate(pairs).reshape(-1, 2), axis=1)
    unique, faces = np.unique(edges[:, 0] * field.size + edges[:, 1], return_inverse=True)
    first, second = unique // field.size, unique % field.size
    values = field.ravel()
    share = np.clip((level - values[first]) / (values[second] - values[first]), 0.02, 0.98)[:, None]
    p, q = (np.stack(np.unravel_index(i, shape), axis=1) for i in (first, second))
    vertices = start + (p + share * (q - p)) * steps
    faces = faces.reshape(-1, 3)
    # Outward: away from the corners above the level.
    lone = np.concatenate(pairs)
    high = np.where(above.ravel()[lone[:, 0, 0]], lone[:, 0, 0], lone[:, 0, 1])
    toward = start + np.stack(np.unravel_index(high, shape), axis=1) * steps
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flip = np.sum(normal * (toward - corners[:, 0]), axis=1) > 0
    faces[flip] = faces[flip][:, ::-1]
    vertices[:, 2] = np.maximum(vertices[:, 2], 0.0)
    return Mesh(vertices, faces)


def _thinned(mesh: Mesh, faces: int) -> Mesh:
    """The mesh with at most that many faces, if it stays closed (quadric decimation, Garland and Heckbert 1997)."""
    if len(mesh.faces) <= faces:
        return mesh
    import open3d as o3d

    solid = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces))
    solid = solid.simplify_quadric_decimation(faces)
    thinned = Mesh(np.asarray(solid.vertices), np.asarray(solid.triangles))
    return thinned if closed(thinned) else mesh


def _pieces(field: NDArray[np.float32], axes: list[NDArray[np.float64]]) -> list[Mesh]:
    """Convex pieces: hulls of the cells in blocks of :data:`BLOCK` metres, larger where there were more than :data:`MOST_BLOCKS`, joined
    where that fills little."""
    steps = np.array([float(a[1] - a[0]) for a in axes])
    start = np.array([a[0] for a in axes]) - steps
    spots = np.argwhere(field > 0.5)
    size = max(2, round(BLOCK / steps[0]))
    while True:
        _, group = np.unique((spots // size) @ np.array([1, 10_000, 100_000_000]), return_inverse=True)
        if group.max() < MOST_BLOCKS:
            break
        size += 1
    order = np.argsort(group, kind="stable")
    corner = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)]) - 0.5
    clouds = []
    for members in np.split(order, np.cumsum(np.bincount(group))[:-1]):
        cells = spots[members]
        # Only the outermost cells of each row count for a hull.
        row = cells[:, 1] * 10_000 + cells[:, 2]
        by = np.lexsort((cells[:, 0], row))
        ends = np.flatnonzero(np.diff(row[by], prepend=-1, append=-1))
        cells = cells[by][np.unique(np.concatenate([ends[:-1], ends[1:] - 1]))]
        cloud = (start + cells * steps)[:, None] + corner * steps
        cloud = cloud.reshape(-1, 3)
        cloud[:, 2] = np.maximum(cloud[:, 2], 0.0)
        clouds.append(cloud)
    return joined(clouds)
