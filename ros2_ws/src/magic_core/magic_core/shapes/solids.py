"""Solids by construction: each gives a closed surface and the convex pieces that fill it.

Lengths in metres.  A :class:`Part` is one closed solid; :func:`join` unites several
into one watertight mesh (manifold3d), keeping a colour for each.  The pieces come
from the construction itself (stations of a sweep, sectors of a turned body, convex
parts of a polygon), so that physics needs no general convex decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
import shapely.geometry.polygon
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from magic_core import transforms
from magic_core.mesh import Mesh

Array = NDArray[np.float64]
Color = tuple[int, int, int]

#: A convex part of a polygon smaller than this (m^2) is left out: nothing can touch it and hulls of slivers fail.
SMALLEST_PART = 2e-8


@dataclass(frozen=True)
class Part:
    """One closed solid: surface vertices (V, 3), faces (F, 3) outward, convex pieces, colour."""

    vertices: Array
    faces: NDArray[np.int32]
    pieces: tuple[Mesh, ...]
    color: Color

    def moved(self, transform: Array) -> Part:
        """The part mapped by a rigid transform (4, 4)."""
        return Part(
            transforms.apply(transform, self.vertices), self.faces, tuple(p.transformed(transform) for p in self.pieces), self.color
        )


def hull(points: ArrayLike) -> Mesh:
    """Convex hull of points (N, 3), faces outward."""
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    found = ConvexHull(points, qhull_options="Qt Pp")
    faces = found.simplices
    a, b, c = (points[faces[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces = np.where(inward[:, None], faces[:, ::-1], faces)
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(points[used], index.reshape(-1, 3))


def volume(vertices: Array, faces: NDArray) -> float:
    """Signed volume (m^3) of a closed surface, positive where faces point outward."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def _outward(vertices: Array, faces: NDArray) -> NDArray[np.int32]:
    return np.ascontiguousarray(faces if volume(vertices, faces) > 0 else faces[:, ::-1], dtype=np.int32)


# ---------------------------------------------------------------- plates


def stroke(points: ArrayLike, width: float, flat_ends: bool = False) -> shapely.Polygon:
    """A polyline (N, 2) drawn with a pen of that width, joints round, ends round or flat."""
    line = shapely.LineString(np.asarray(points, dtype=float))
    return line.buffer(width / 2, quad_segs=8, cap_style="flat" if flat_ends else "round", join_style="round")


def arc(centre: ArrayLike, radius: float | tuple[float, float], start: float, end: float, count: int = 24) -> Array:
    """Points (count, 2) on a circle or an axis-aligned ellipse; angles in radians, counter-clockwise where end > start."""
    angle = np.linspace(start, end, count)
    rx, ry = (radius, radius) if np.isscalar(radius) else radius
    return np.asarray(centre, dtype=float) + np.column_stack([rx * np.cos(angle), ry * np.sin(angle)])


def fillet(polygon: shapely.Polygon, radius: float) -> shapely.Polygon:
    """The polygon with its concave corners rounded to a radius (a morphological closing)."""
    return polygon.buffer(radius, quad_segs=10, join_style="mitre").buffer(-radius, quad_segs=10, join_style="round")


def _triangles(polygon: shapely.Polygon) -> tuple[Array, NDArray[np.int64]]:
    """Constrained Delaunay triangulation on the polygon's own vertices: points (N, 2), triangles (M, 3) counter-clockwise."""
    rings = [np.asarray(r.coords)[:-1] for r in (polygon.exterior, *polygon.interiors)]
    points = np.concatenate(rings)
    index = {tuple(p): i for i, p in enumerate(points)}
    triangles = []
    for triangle in shapely.constrained_delaunay_triangles(polygon).geoms:
        corner = [index[tuple(p)] for p in np.asarray(triangle.exterior.coords)[:3]]
        a, b, c = points[corner]
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        triangles.append(corner if turn > 0 else corner[::-1])
    return points, np.array(triangles)


def convex_parts(polygon: shapely.Polygon, tolerance: float = 0.01) -> list[Array]:
    """Partition of a polygon (holes allowed) into convex parts, each (K, 2) counter-clockwise.

    Constrained Delaunay triangles joined across diagonals as long as the union stays
    convex (Hertel and Mehlhorn 1983).  A corner may turn inward by ``tolerance``
    radians: the parts are used as hulls, and the hull then adds next to nothing.
    """
    points, triangles = _triangles(polygon)
    parts: dict[int, list[int]] = {i: list(t) for i, t in enumerate(triangles.tolist())}
    owner: dict[tuple[int, int], int] = {}
    for i, t in parts.items():
        for k in range(3):
            owner[t[k], t[(k + 1) % 3]] = i

    def convex(ring: list[int]) -> bool:
        p = points[ring]
        d = np.roll(p, -1, axis=0) - p
        length = np.linalg.norm(d, axis=1)
        if length.min() <= 0:
            return False
        d = d / length[:, None]
        n = np.roll(d, -1, axis=0)
        turn = np.arctan2(d[:, 0] * n[:, 1] - d[:, 1] * n[:, 0], np.einsum("ij,ij->i", d, n))
        return bool(turn.min() > -tolerance) and turn[turn < 0].sum() > -2 * tolerance and turn.sum() < 2 * np.pi + 0.1

    # Long diagonals first: dropping them leaves compact parts.
    diagonals = [(a, b) for (a, b) in owner if a < b and (b, a) in owner]
    diagonals.sort(key=lambda e: (-float(np.linalg.norm(points[e[0]] - points[e[1]])), e))
    for a, b in diagonals:
        i, j = owner[a, b], owner[b, a]
        if i == j:
            continue
        left, right = parts[i], parts[j]
        s, t = left.index(b), right.index(a)
        ring = left[s:] + left[:s] + (right[t:] + right[:t])[1:-1]
        if len(set(ring)) != len(ring) or not convex(ring):
            continue
        parts[i] = ring
        for k, p in enumerate(ring):
            owner[p, ring[(k + 1) % len(ring)]] = i
        del parts[j]
    return [points[ring] for ring in parts.values()]


def plate(polygon: shapely.Polygon, low: float, high: float, color: Color, grid: float = 1e-5) -> Part:
    """A polygon (holes allowed) in the xy plane, extruded from z = low to z = high."""
    polygon = shapely.simplify(shapely.set_precision(polygon, grid), 4e-5)
    if polygon.geom_type != "Polygon":
        raise ValueError(f"a plate needs one connected polygon, not a {polygon.geom_type}")
    polygon = shapely.geometry.polygon.orient(polygon)  # outline counter-clockwise, holes clockwise: walls face outward
    points, triangles = _triangles(polygon)
    n = len(points)
    faces = [triangles[:, ::-1], triangles + n]
    start = 0
    for ring in (polygon.exterior, *polygon.interiors):
        i = start + np.arange(len(ring.coords) - 1)
        j = np.roll(i, -1)
        faces += [np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])]
        start += len(i)
    vertices = np.concatenate([np.column_stack([points, np.full(n, low)]), np.column_stack([points, np.full(n, high)])])
    pieces = []
    for part in convex_parts(polygon):
        x, y = part.T
        if abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 < SMALLEST_PART:
            continue
        pieces.append(hull(np.concatenate([np.column_stack([part, np.full(len(part), z)]) for z in (low, high)])))
    return Part(vertices, np.concatenate(faces).astype(np.int32), tuple(pieces), color)


# ---------------------------------------------------------------- sweeps and turned bodies


def loft(rings: Array, color: Color) -> Part:
    """A solid through convex rings (K, M, 3); each pair of neighbours spans one convex piece."""
    rings = np.asarray(rings, dtype=float)
    k, m = rings.shape[:2]
    vertices = rings.reshape(-1, 3)
    i = np.arange(m)
    j = (i + 1) % m
    faces = []
    for s in range(k - 1):
        a, b = s * m, (s + 1) * m
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    fan = np.column_stack([np.zeros(m - 2, int), np.arange(1, m - 1), np.arange(2, m)])
    faces += [fan[:, ::-1], fan + (k - 1) * m]
    return Part(vertices, _outward(vertices, np.concatenate(faces)), tuple(hull(rings[s : s + 2]) for s in range(k - 1)), color)


def tube(path: ArrayLike, across: float | Array, along: float | Array, side: ArrayLike, color: Color, corners: int = 12) -> Part:
    """A rod of elliptic section along a path (K, 3) that lies in a plane with normal ``side`` (3,).

    across: full width in the path's plane; along: full width along ``side``; numbers or one for each station.
    """
    path = np.asarray(path, dtype=float)
    side = transforms.unit(side)
    tangent = np.gradient(path, axis=0)
    steps = np.diff(path, axis=0)
    steps = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    # Mitre plane at the inner stations: the bisector of the two steps.
    tangent[1:-1] = steps[:-1] + steps[1:]
    tangent[0], tangent[-1] = steps[0], steps[-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(side, tangent)
    stretch = np.ones(len(path))
    stretch[1:-1] = 1 / np.maximum(np.einsum("ij,ij->i", tangent[1:-1], steps[1:]), 0.5)
    across = np.broadcast_to(across, len(path)) * stretch
    along = np.broadcast_to(along, len(path))
    angle = (np.arange(corners) + 0.5) * 2 * np.pi / corners
    # The polygon circumscribes so that its flats, not its corners, lie at the stated width.
    grow = 1 / np.cos(np.pi / corners)
    rings = (
        path[:, None]
        + (across / 2 * grow)[:, None, None] * np.cos(angle)[None, :, None] * normal[:, None]
        + (along / 2 * grow)[:, None, None] * np.sin(angle)[None, :, None] * side
    )
    return loft(rings, color)


def turned(z: ArrayLike, radius: ArrayLike, color: Color, sectors: int = 48, piece_sectors: int = 24) -> Part:
    """A full body of revolution about z through (z, radius) stations; a piece for each pair (one, where the whole is convex)."""
    z, radius = np.asarray(z, dtype=float), np.asarray(radius, dtype=float)

    def rings(count: int) -> Array:
        angle = np.arange(count) * 2 * np.pi / count
        return np.stack(
            [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(count, h)]) for h, r in zip(z, radius, strict=True)]
        )

    solid = loft(rings(sectors), color)
    pieces = loft(rings(piece_sectors), color).pieces
    slopes = np.diff(radius) / np.diff(z)
    if np.all(np.diff(slopes) <= 1e-9):
        pieces = (hull(rings(piece_sectors)),)
    return Part(solid.vertices, solid.faces, pieces, color)


def cup(z: Array, outer: Array, inner: Array, floor: float, color: Color, sectors: int = 64, piece_sectors: int = 32) -> Part:
    """An open vessel turned about z: stations z (K,) with outer and inner radii (K,), z[0] the underside.

    The inside begins at z = ``floor``, which must be one of the stations.
    """
    first = int(np.flatnonzero(np.isclose(z, floor))[0])

    def ring(radius: float, height: float, count: int) -> Array:
        angle = np.arange(count) * 2 * np.pi / count
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)])

    profile = [(outer[k], z[k]) for k in range(len(z))] + [(inner[k], z[k]) for k in range(len(z) - 1, first - 1, -1)]
    vertices = np.concatenate([ring(r, h, sectors) for r, h in profile] + [[[0, 0, z[0]], [0, 0, floor]]])
    i, n = np.arange(sectors), len(profile)
    j = (i + 1) % sectors
    faces = []
    for s in range(n - 1):
        a, b = s * sectors, (s + 1) * sectors
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    bottom, top, last = n * sectors, n * sectors + 1, (n - 1) * sectors
    faces += [np.column_stack([np.full(sectors, bottom), j, i]), np.column_stack([np.full(sectors, top), last + i, last + j])]
    pieces = [hull(np.concatenate([ring(outer[k], z[k], piece_sectors) for k in range(first + 1)]))]
    angle = np.arange(piece_sectors + 1) * 2 * np.pi / piece_sectors
    for k in range(first, len(z) - 1):
        for s in range(piece_sectors):
            corner = [
                (r * np.cos(a), r * np.sin(a), h)
                for a in angle[s : s + 2]
                for r, h in ((outer[k], z[k]), (inner[k], z[k]), (outer[k + 1], z[k + 1]), (inner[k + 1], z[k + 1]))
            ]
            pieces.append(hull(corner))
    return Part(vertices, _outward(vertices, np.concatenate(faces)), tuple(pieces), color)


def bowl(
    half: tuple[float, float],
    depth: float,
    wall: float,
    power: float,
    color: Color,
    sectors: int = 48,
    piece_sectors: int = 16,
    levels: int = 6,
) -> Part:
    """An open shell, rim at z = 0 about the origin, bottom of the inside at z = -depth.

    Its inside is (|x/a| ^ 2 + |y/b| ^ 2) ^ (power / 2) + |z / depth| ^ power = 1: an ellipsoid
    for power 2, a cup with a flat floor for more.  The outside is the same shape, wider and deeper by ``wall``.
    """

    def surface(u: Array, count: int, grow: float) -> Array:
        rho, h = np.sin(u) ** (2 / power), np.cos(u) ** (2 / power)
        h[-1], rho[0] = 0.0, 0.0
        angle = np.arange(count) * 2 * np.pi / count
        x = (half[0] + grow) * rho[:, None] * np.cos(angle)
        y = (half[1] + grow) * rho[:, None] * np.sin(angle)
        return np.stack([x, y, np.broadcast_to(-(depth + grow) * h[:, None], x.shape)], axis=-1)

    fine = np.linspace(0, np.pi / 2, 3 * levels + 1)
    inside, outside = surface(fine, sectors, 0.0), surface(fine, sectors, wall)
    rows = len(fine) - 1
    vertices = np.concatenate([outside[1:].reshape(-1, 3), inside[1:].reshape(-1, 3), [outside[0, 0], inside[0, 0]]])
    i = np.arange(sectors)
    j = (i + 1) % sectors
    faces = []

    def band(a: int, b: int) -> None:
        faces.extend([np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])])

    for s in range(rows - 1):
        band(s * sectors, (s + 1) * sectors)
    band((rows - 1) * sectors, (2 * rows - 1) * sectors)
    for s in range(rows - 1, 0, -1):
        band((rows + s) * sectors, (rows + s - 1) * sectors)
    low, high = 2 * rows * sectors, 2 * rows * sectors + 1
    faces += [
        np.column_stack([np.full(sectors, low), j, i]),
        np.column_stack([np.full(sectors, high), rows * sectors + i, rows * sectors + j]),
    ]
    coarse = np.linspace(0, np.pi / 2, levels + 1)
    a, b = surface(coarse, piece_sectors, 0.0), surface(coarse, piece_sectors, wall)
    pieces = []
    for s in range(levels):
        for k in range(piece_sectors):
            n = (k + 1) % piece_sectors
            pieces.append(hull(np.concatenate([g[[s, s, s + 1, s + 1], [k, n, k, n]] for g in (a, b)])))
    return Part(vertices, _outward(vertices, np.concatenate(faces)), tuple(pieces), color)


def ball(radius: float, color: Color, sectors: int = 48) -> Part:
    """A sphere about the origin; one piece of fewer corners stands for it in physics."""

    def rings(count: int) -> Array:
        u = np.linspace(0, np.pi, count // 2 + 1)[1:-1]
        angle = np.arange(count) * 2 * np.pi / count
        body = np.stack(
            [np.sin(u)[:, None] * np.cos(angle), np.sin(u)[:, None] * np.sin(angle), np.broadcast_to(np.cos(u)[:, None], (len(u), count))],
            -1,
        )
        return np.concatenate([body.reshape(-1, 3), [[0, 0, 1.0], [0, 0, -1.0]]]) * radius

    outer = hull(rings(sectors))
    piece = hull(rings(20))
    # As much above the sphere at its corners as below it in its faces: the piece has the ball's volume.
    grow = (volume(outer.vertices, outer.faces) / volume(piece.vertices, piece.faces)) ** (1 / 3)
    return Part(outer.vertices, outer.faces, (piece.scaled(grow),), color)


def join(parts: list[Part]) -> Mesh:
    """One watertight mesh of all parts (exact union), each vertex in the colour of the part it came from."""
    import manifold3d

    if len(parts) == 1:
        return Mesh(parts[0].vertices, parts[0].faces).painted(parts[0].color)
    solids = [
        manifold3d.Manifold(
            manifold3d.Mesh(np.ascontiguousarray(p.vertices, np.float32), np.ascontiguousarray(p.faces, np.uint32))
        ).as_original()
        for p in parts
    ]
    for part, solid in zip(parts, solids, strict=True):
        if solid.is_empty():
            raise ValueError(f"a part of {len(part.faces)} faces is not a closed solid: {solid.status()}")
    colors = {solid.original_id(): part.color for part, solid in zip(parts, solids, strict=True)}
    merged = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh()
    vertices = np.asarray(merged.vert_properties)[:, :3].astype(float)
    faces = np.asarray(merged.tri_verts).astype(np.int32)
    paint = np.zeros((len(vertices), 3), np.uint8)
    for k, original in enumerate(merged.run_original_id):
        run = faces[merged.run_index[k] // 3 : merged.run_index[k + 1] // 3]
        paint[run.ravel()] = colors[original]
    return Mesh(vertices, faces, paint)
