"""Convex pieces of any mesh, for objects that come without them.

The mesh is filled with cubes and the cubes are merged into boxes; each box is then
replaced by the convex hull of what of the mesh lies in it.  Pieces that stand above the
surface of a hollow are cut in two until they follow it.  Holes that are wider than a
cube stay open.  Slower decompositions fit better; this one needs no closed, no
oriented and no clean mesh, and ends in bounded time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, box_corners

#: Faces above which the surface is sampled rather than used whole.
SAMPLES = 400_000
#: What fills its convex hull to this share counts as convex.
CONVEX = 0.95
#: Cubes that the thinnest side is cut into, if no more than FINEST along the longest edge are needed for it.
THINNEST, FINEST = 6, 112
#: A piece that stands this far above the surface, m, where something may lie, is cut further: contacts are solved from 2 mm on.  It is
#: cut to SMALLEST, m, at least, and so that there are no more than ALL pieces in the end: each costs time in physics.
ABOVE, SMALLEST, ALL = 0.0015, 0.002, 600
#: Something may lie where a ball of this radius, m, touches the surface, or comes as near as SLACK: thinner than rods and targets are.
#: In narrower furrows (a scan's roughness, a corner) nothing does.
BALL, SLACK = 0.005, 0.001
#: Heights are asked for at points so far apart, m.
SPACING = 0.002
#: Of so many directions one at least leads out from a point that is outside.
DIRECTIONS = 32
MAX_EXTENT = 5.0
MIN_EXTENT = 0.002
#: Cubes along a mesh's longest edge, but for thin things.
RESOLUTION = 56
#: Boxes at most, before pieces that fill hollows are cut further.
BOXES = 400


def extremes(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Of points (N, 3) those furthest out in ``count`` evenly spread directions."""
    directions = _directions(count)  # two of them may share their furthest point
    chunk = max(1, 1_000_000 // len(points))
    along = np.ascontiguousarray(points.T)
    chosen = [np.argmax(directions[i : i + chunk] @ along, axis=1) for i in range(0, count, chunk)]
    return points[np.unique(np.concatenate(chosen))]


def _directions(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) spread evenly, without chance: a Fibonacci sphere."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + 5**0.5) * k
    return np.column_stack([np.cos(angle) * np.sqrt(1 - z * z), np.sin(angle) * np.sqrt(1 - z * z), z])


def convex_pieces(mesh: Mesh) -> tuple[Mesh, ...]:
    """Convex pieces in the mesh's frame; :data:`RESOLUTION` cubes along the longest edge (for thin things up
    to :data:`FINEST`), of at most :data:`BOXES` boxes; pieces that fill hollows are cut further, up to :data:`ALL`.

    Raises ``BAD_MESH`` for a mesh without faces, or of a size that cannot be simulated.
    """
    if len(mesh.faces) == 0:
        raise MagicError(Code.BAD_MESH, "mesh", "no faces", "at least one triangle")
    low, high = mesh.bounds
    extent = float((high - low).max())
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise MagicError(Code.BAD_MESH, "largest extent of the mesh", f"{extent:.3g} m", f"{MIN_EXTENT} to {MAX_EXTENT} m")
    pitch = max(min(extent / RESOLUTION, float((high - low).min()) / THINNEST), extent / max(RESOLUTION, FINEST))
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
    boxes = sorted(boxes, key=lambda b: -int(np.prod(b[1] - b[0])))[:BOXES]
    tree = cKDTree(surface)
    pieces = []
    for lower, upper in boxes:
        corner, end = origin + lower * pitch, origin + upper * pitch
        cells = filled[tuple(slice(a, b) for a, b in zip(lower, upper, strict=True))]
        made = _piece(corner, end, cells, grid, lower, surface, tree, pitch)
        if made is not None:
            pieces.append(_Cut(made, corner, end))
    return tuple(cut.hull for cut in _followed(mesh, pieces))


@dataclass(frozen=True)
class _Cut:
    """A convex piece, the box from ``low`` to ``high`` (3,) in which it lies, and, once it was cut, the
    triangles (T, 3, 3) of the mesh in it."""

    hull: Mesh
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    inside: NDArray[np.float64] | None = None


def _followed(mesh: Mesh, pieces: list[_Cut]) -> list[_Cut]:
    """Pieces that stand above the mesh by more than :data:`ABOVE` cut in two, and again, those that stand highest first, up to :data:`ALL`.

    The two are what of the solid lies on each side of a plane across the box, of the three through its
    middle that by which the least volume is left.
    """
    space = _Space(mesh)
    done: list[_Cut] = []
    fresh = pieces
    while fresh:
        heights = space.above(fresh)
        order = np.argsort(-heights, kind="stable")
        high = [fresh[i] for i in order if heights[i] > ABOVE]
        done += [fresh[i] for i in order if heights[i] <= ABOVE]
        fresh = []
        for number, piece in enumerate(high):
            room = ALL - len(done) - len(fresh) - (len(high) - number)
            halves = space.halves(piece) if room > 0 else None
            if halves is None:
                done.append(piece)
            else:
                fresh += halves
    return done


class _Space:
    """What is outside of a mesh, and how far from it."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d  # slow to import; not all meshes are cut

        self._tensor = lambda a: o3d.core.Tensor(np.ascontiguousarray(a, dtype=np.float32))
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        self._triangles = mesh.vertices[mesh.faces]
        self._bounds = self._triangles.min(axis=1), self._triangles.max(axis=1)
        self._around = _directions(DIRECTIONS)

    def outside(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of points (N, 3) see out: this asks for no closed and no oriented mesh."""
        out = np.zeros(len(points), dtype=bool)
        for start in range(0, len(points), 20_000):
            some = points[start : start + 20_000]
            rays = np.concatenate([np.repeat(some, DIRECTIONS, axis=0), np.tile(self._around, (len(some), 1))], axis=1)
            free = np.isinf(self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy())
            out[start : start + 20_000] = free.reshape(-1, DIRECTIONS).any(axis=1)
        return out

    def above(self, pieces: list[_Cut]) -> NDArray[np.float64]:
        """How far each piece stands above the mesh where something may lie, m: the largest distance of points
        spread over its faces that are outside."""
        points = [_spread(cut) for cut in pieces]
        owner = np.repeat(np.arange(len(pieces)), [len(p) for p in points])
        everything = np.concatenate(points)
        nearest = self._scene.compute_closest_points(self._tensor(everything))["points"].numpy().astype(float)
        distance = np.linalg.norm(everything - nearest, axis=1)
        far = np.flatnonzero(distance > ABOVE)
        away = (everything[far] - nearest[far]) / distance[far, None]
        clear = self._scene.compute_distance(self._tensor(nearest[far] + BALL * away)).numpy()
        far = far[clear >= BALL - SLACK]
        far = far[self.outside(everything[far])]
        heights = np.zeros(len(pieces))
        np.maximum.at(heights, owner[far], distance[far])
        return heights

    def halves(self, piece: _Cut) -> list[_Cut] | None:
        """The two halves of a piece, ``None`` where it is too small."""
        inside = piece.inside
        if inside is None:
            # Of the mesh itself, rather than of points spread over it, so that the halves meet.
            near = np.all((self._bounds[0] <= piece.high) & (self._bounds[1] >= piece.low), axis=1)
            inside = self._triangles[near]
            for axis in range(3):
                inside = _split(_split(inside, axis, piece.low[axis])[1], axis, piece.high[axis])[0]
        best = None
        grid = np.stack([piece.low, (piece.low + piece.high) / 2, piece.high])
        corners = np.stack(np.meshgrid(*grid.T, indexing="ij"), axis=-1)
        solid = ~self.outside(corners.reshape(-1, 3)).reshape(3, 3, 3)
        for axis in np.flatnonzero(piece.high - piece.low >= 2 * SMALLEST):
            made = []
            for half, part in enumerate(_split(inside, axis, grid[1, axis])):
                lower, upper = piece.low.copy(), piece.high.copy()
                lower[axis], upper[axis] = grid[half, axis], grid[half + 1, axis]
                at = tuple(slice(half, half + 2) if k == axis else slice(None, None, 2) for k in range(3))
                # The hull of what of a solid lies in a box: of its surface there, and of the box's corners that are in the solid.
                points = np.concatenate([part.reshape(-1, 3), corners[at][solid[at]]])
                # A sheet without thickness keeps some.
                hull = _hull(points) or _hull(np.concatenate([points + 0.1 * SMALLEST, points - 0.1 * SMALLEST]))
                if hull is not None:
                    made.append((_Cut(hull, lower, upper, part), ConvexHull(hull.vertices).volume))
            volume = sum(v for _, v in made)
            if made and (best is None or volume < best[0]):
                best = volume, [cut for cut, _ in made]
        return None if best is None else best[1]


def _spread(piece: _Cut) -> NDArray[np.float64]:
    """Points (N, 3) over the faces of a piece's hull, corners and edges too, about :data:`SPACING` apart."""
    triangles = piece.hull.vertices[piece.hull.faces]
    # What lies in a side of the box is a cut through the solid, and stands above it at its edges if at all.
    flat = np.zeros(len(triangles), dtype=bool)
    for side in (piece.low, piece.high):
        flat |= np.any(np.all(np.abs(triangles - side) < 1e-7, axis=1), axis=1)
    longest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(longest / SPACING), 1, 32).astype(int)
    result = [np.zeros((0, 3))]
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        inner = i + j <= n
        weights = np.column_stack([i[inner], j[inner], n - i[inner] - j[inner]]) / n
        edge = (weights == 0).any(axis=1)
        result.append((weights @ triangles[(steps == n) & ~flat]).reshape(-1, 3))
        result.append((weights[edge] @ triangles[(steps == n) & flat]).reshape(-1, 3))
    return np.concatenate(result)


def _split(triangles: NDArray[np.float64], axis: int, at: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What of triangles (T, 3, 3) lies below and what above a coordinate, as triangles."""
    above = triangles[:, :, axis] > at
    count = above.sum(axis=1)
    parts = [[triangles[count == 0]], [triangles[count == 3]]]
    for lone in (1, 2):
        cut = triangles[count == lone]
        # The corner that is alone on its side goes first.
        first = np.argmax(above[count == lone] == (lone == 1), axis=1)
        a, b, c = (cut[np.arange(len(cut)), (first + k) % 3] for k in range(3))
        with np.errstate(divide="ignore", invalid="ignore"):
            p, q = (a + (other - a) * ((at - a[:, axis]) / (other[:, axis] - a[:, axis]))[:, None] for other in (b, c))
        parts[lone % 2].append(np.stack([a, p, q], axis=1))
        parts[1 - lone % 2] += [np.stack([p, b, c], axis=1), np.stack([p, c, q], axis=1)]
    return np.concatenate(parts[0]), np.concatenate(parts[1])


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
        block = box_corners(inner.min(axis=0), inner.max(axis=0) + 1)
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
