"""Convex pieces of any mesh, for objects that come without them.

The mesh is filled with cubes and the cubes are merged into boxes; each box is then
replaced by the convex hull of what of the mesh lies in it.  Holes that are wider than
a cube stay open.  Slower decompositions fit better; this one needs no closed, no
oriented and no clean mesh, and ends in bounded time.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh

#: Faces above which the surface is sampled rather than used whole.
SAMPLES = 400_000
#: What fills its convex hull to this share counts as convex.
CONVEX = 0.95
#: Cubes that the thinnest side is cut into, if no more than FINEST along the longest edge are needed for it.
THINNEST, FINEST = 6, 112
MAX_EXTENT = 5.0
MIN_EXTENT = 0.002


def extremes(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Of points (N, 3) those furthest out in ``count`` evenly spread directions."""
    # A Fibonacci sphere: directions spread evenly without chance; two of them may share their furthest point.
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    directions = np.column_stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z])
    chunk = max(1, 1_000_000 // len(points))
    along = np.ascontiguousarray(points.T)
    chosen = [np.argmax(directions[i : i + chunk] @ along, axis=1) for i in range(0, count, chunk)]
    return points[np.unique(np.concatenate(chosen))]


def convex_pieces(mesh: Mesh, resolution: int = 56, most: int = 400) -> tuple[Mesh, ...]:
    """Convex pieces in the mesh's frame; ``resolution`` cubes along the longest edge (for thin things up
    to :data:`FINEST`), at most ``most`` pieces.

    Raises ``BAD_MESH`` for a mesh without faces, or of a size that cannot be simulated.
    """
    if len(mesh.faces) == 0:
        raise MagicError(Code.BAD_MESH, "mesh", "no faces", "at least one triangle")
    low, high = mesh.bounds
    extent = float((high - low).max())
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise MagicError(Code.BAD_MESH, "largest extent of the mesh", f"{extent:.3g} m", f"{MIN_EXTENT} to {MAX_EXTENT} m")
    pitch = max(min(extent / resolution, float((high - low).min()) / THINNEST), extent / max(resolution, FINEST))
    surface = _surface(mesh, pitch)
    origin = low - 1.5 * pitch
    index = np.floor((surface - origin) / pitch).astype(int)
    grid = np.zeros(np.ceil((high - origin) / pitch).astype(int) + 3, dtype=bool)
    grid[tuple(index.T)] = True
    # What cannot be reached from outside is inside.
    filled = ndimage.binary_fill_holes(grid)
    hull = _hull(extremes(surface, 1000))
    if hull is not None and _volume(mesh, grid, filled, pitch) >= CONVEX * ConvexHull(hull.vertices).volume:
        return (hull,)
    boxes = _boxes(filled)
    boxes = sorted(boxes, key=lambda b: -int(np.prod(b[1] - b[0])))[:most]
    tree = cKDTree(surface)
    pieces = []
    for lower, upper in boxes:
        corner, end = origin + lower * pitch, origin + upper * pitch
        pieces.append(
            _piece(corner, end, filled[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))], grid, lower, surface, tree, pitch)
        )
    return tuple(p for p in pieces if p is not None)


def _volume(mesh: Mesh, grid: NDArray[np.bool_], filled: NDArray[np.bool_], pitch: float) -> float:
    """Volume in m^3: exact for a closed mesh, else of the cubes inside and half of those on the surface.

    All cubes together reach beyond the surface by as much as a thin thing is thick.
    """
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    if solid.is_watertight and solid.is_winding_consistent:
        return abs(float(solid.volume))
    return float((filled & ~grid).sum() + 0.5 * grid.sum()) * pitch**3


def _surface(mesh: Mesh, pitch: float) -> NDArray[np.float64]:
    """Points (N, 3) on the surface, dense enough that no cube is missed; the vertices are among them."""
    triangles = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    area = max(float(triangles.area), 1e-12)
    count = int(np.clip(24 * area / pitch**2, 2000, SAMPLES))
    points, _ = trimesh.sample.sample_surface(triangles, count, seed=0)
    vertices = mesh.vertices if len(mesh.vertices) <= SAMPLES else mesh.vertices[:: len(mesh.vertices) // SAMPLES + 1]
    return np.concatenate([vertices, points])


def _boxes(grid: NDArray[np.bool_]) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Disjoint boxes [lower, upper) that together are the true cells, grown greedily."""
    left = grid.copy()
    boxes = []
    for start in np.argwhere(grid):
        if not left[tuple(start)]:
            continue
        lower, upper = start.copy(), start + 1
        for axis in (2, 1, 0):
            while upper[axis] < grid.shape[axis]:
                face = [slice(a, b) for a, b in zip(lower, upper, strict=True)]
                face[axis] = slice(upper[axis], upper[axis] + 1)
                if not left[tuple(face)].all():
                    break
                upper[axis] += 1
        left[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))] = False
        boxes.append((lower, upper))
    return boxes


def _piece(
    corner: NDArray[np.float64],
    end: NDArray[np.float64],
    cells: NDArray[np.bool_],
    shell: NDArray[np.bool_],
    lower: NDArray[np.int64],
    surface: NDArray[np.float64],
    tree: cKDTree,
    pitch: float,
) -> Mesh | None:
    """The hull of the surface points in a box and of its inner cells' corners."""
    near = tree.query_ball_point((corner + end) / 2, float(np.linalg.norm(end - corner)) / 2 + 1e-9)
    points = surface[near]
    points = points[np.all((points >= corner - 1e-9) & (points <= end + 1e-9), axis=1)]
    inner = np.argwhere(cells & ~shell[tuple(slice(a, a + n) for a, n in zip(lower, cells.shape, strict=True))])
    if len(inner):
        low, high = inner.min(axis=0), inner.max(axis=0) + 1
        block = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        points = np.concatenate([points, corner + block * pitch])
    if len(points) < 4:
        return None
    # A sheet without thickness is given a fifth of a cube.
    return _hull(points) or _hull(np.concatenate([points + 0.1 * pitch, points - 0.1 * pitch]))


def _hull(points: NDArray[np.float64]) -> Mesh | None:
    """The convex hull of points (N, 3), ``None`` where they span no volume."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    renumber = np.full(len(points), -1)
    renumber[hull.vertices] = np.arange(len(hull.vertices))
    return Mesh(points[hull.vertices], renumber[hull.simplices])
