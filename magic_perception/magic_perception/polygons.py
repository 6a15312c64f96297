"""Outlines in the plane and what is built on them: occupancy grids, alpha shapes, convex parts, extrusions."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Polygon

from magic_core.mesh import Mesh

#: Holes of less than this (m^2) are noise, and closed.
NOISE_HOLE = 1.2e-5


def parts_of(shape: shapely.Geometry) -> list[Polygon]:
    """The polygons of a polygon, a multi-polygon or a collection, largest first; nothing for what has no area."""
    if shape.is_empty:
        return []
    if isinstance(shape, Polygon):
        return [shape] if shape.area > 0 else []
    found = [part for item in getattr(shape, "geoms", []) for part in parts_of(item)]
    return sorted(found, key=lambda p: -p.area)


def outline(field: NDArray, origin: NDArray[np.float64], cell: float, level: float = 0.5, simplify: float | None = None) -> list[Polygon]:
    """Polygons with holes where a field over a grid is above a level, to a fraction of a cell.

    field (rows, columns): value at the cell's centre, row i at y = origin[1] + i cell, column j at x = origin[0] + j cell.
    Holes smaller than :data:`NOISE_HOLE` square metres are noise and closed.  ``simplify`` metres (default 0.3 cells).
    """
    from contourpy import FillType, contour_generator

    padded = np.pad(np.asarray(field, dtype=float), 1)
    filled = contour_generator(z=padded, fill_type=FillType.OuterOffset).filled(level, np.inf)
    result = []
    for points, offsets in zip(*filled, strict=True):
        rings = [(points[a:b] - 1) * cell + origin for a, b in itertools.pairwise(offsets)]
        if len(rings[0]) < 4:
            continue
        holes = [ring for ring in rings[1:] if len(ring) >= 4 and Polygon(ring).area > NOISE_HOLE]
        shape = Polygon(rings[0], holes).simplify(0.3 * cell if simplify is None else simplify)
        result += parts_of(shape if shape.is_valid else shape.buffer(0))
    return sorted(result, key=lambda p: -p.area)


def smooth_field(occupied: NDArray[np.bool_], cells: float = 1.0) -> NDArray[np.float32]:
    """An occupancy grid blurred by a Gaussian of that many cells, so that its 0.5 level is a smooth outline."""
    return (
        cv2.GaussianBlur(occupied.astype(np.float32), (0, 0), cells, borderType=cv2.BORDER_CONSTANT)
        if cells > 0
        else occupied.astype(np.float32)
    )


def alpha_shape(points: NDArray[np.float64], alpha: float) -> list[Polygon]:
    """The union of the Delaunay triangles whose circumradius is below ``alpha`` metres (Edelsbrunner 1983), largest polygon first."""
    from scipy.spatial import Delaunay, QhullError

    points = np.unique(np.asarray(points, float).round(6), axis=0)
    if len(points) < 4:
        return []
    try:
        corners = points[Delaunay(points).simplices]
    except QhullError:
        return []
    a = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    b = np.linalg.norm(corners[:, 1] - corners[:, 2], axis=1)
    c = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=1)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    small = (area > 1e-12) & (a * b * c < 4 * alpha * np.maximum(area, 1e-15))
    if not small.any():
        return []
    return parts_of(shapely.union_all(shapely.polygons(corners[small])))


def triangulate(polygon: Polygon) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 2) and counter-clockwise triangles (T, 3) of a polygon with holes, by ear cutting."""
    import mapbox_earcut

    rings = [np.asarray(r.coords)[:-1] for r in (polygon.exterior, *polygon.interiors)]
    vertices = np.concatenate(rings)
    faces = (
        mapbox_earcut.triangulate_float64(vertices, np.cumsum([len(r) for r in rings]).astype(np.uint32)).reshape(-1, 3).astype(np.int64)
    )
    if len(faces) == 0:
        return vertices, faces
    p = vertices[faces]
    turn = (p[:, 1, 0] - p[:, 0, 0]) * (p[:, 2, 1] - p[:, 0, 1]) - (p[:, 1, 1] - p[:, 0, 1]) * (p[:, 2, 0] - p[:, 0, 0])
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    return vertices, faces


def convex_hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners (K, 2), counter-clockwise, of the hull of points (N, 2), by the monotone chain; fewer than 3 if they lie on a line."""
    if len(points) > 30:
        # OpenCV's hull works on 32-bit floats: it picks the candidates, of which the chain then takes the true corners.
        local = (points - points.mean(axis=0)).astype(np.float32)
        points = points[cv2.convexHull(local, returnPoints=False)[:, 0]]
    ordered = sorted(set(map(tuple, points.tolist())))
    if len(ordered) < 3:
        return np.array(ordered)

    def chain(items: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for p in items:
            while (
                len(kept) > 1
                and (kept[-1][0] - kept[-2][0]) * (p[1] - kept[-2][1]) - (kept[-1][1] - kept[-2][1]) * (p[0] - kept[-2][0]) <= 1e-15
            ):
                kept.pop()
            kept.append(p)
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def area_of(ring: NDArray[np.float64]) -> float:
    """Signed area of a ring (K, 2), positive where counter-clockwise."""
    x, y = ring[:, 0], ring[:, 1]
    return float(np.dot(x[:-1], y[1:]) - np.dot(y[:-1], x[1:]) + x[-1] * y[0] - y[-1] * x[0]) / 2


def convex_parts(polygon: Polygon, tolerance: float = 0.0) -> list[NDArray[np.float64]]:
    """Cut a polygon with holes into convex rings (K, 2), counter-clockwise: triangles, merged greedily (Hertel and Mehlhorn 1983).

    Two parts are merged over their shared edge, longest edge first, where the area that the merged hull adds
    is at most ``tolerance`` metres times half of the hull's perimeter (a mean depth of the filled notch); with 0 the parts tile the
    polygon.
    """
    vertices, faces = triangulate(polygon)
    if len(faces) == 0:
        return []
    rings: dict[int, NDArray] = {i: vertices[f] for i, f in enumerate(faces)}
    areas = {i: area_of(r) for i, r in rings.items()}
    filled = dict(areas)
    owner = list(range(len(faces)))
    edges: dict[tuple[int, int], list[int]] = {}
    for i, face in enumerate(faces.tolist()):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            edges.setdefault((min(face[a], face[b]), max(face[a], face[b])), []).append(i)
    shared = [(float(np.linalg.norm(vertices[a] - vertices[b])), pair) for (a, b), pair in edges.items() if len(pair) == 2]
    shared.sort(key=lambda item: -item[0])

    def root(i: int) -> int:
        while owner[i] != i:
            owner[i] = owner[owner[i]]
            i = owner[i]
        return i

    merged = True
    apart: set[tuple[int, int]] = set()  # that are not merged as they are
    while merged:
        merged = False
        rest = []
        for length, (a, b) in shared:
            i, j = root(a), root(b)
            if i == j:
                continue
            if (i, j) in apart:
                rest.append((length, (a, b)))
                continue
            hull = convex_hull(np.concatenate([rings[i], rings[j]]))
            if len(hull) < 3:
                continue
            area = area_of(hull)
            excess = area - filled[i] - filled[j]
            perimeter = float(np.sqrt(np.sum(np.diff(hull, axis=0, append=hull[:1]) ** 2, axis=1)).sum())
            if excess <= 1e-10 + tolerance * perimeter / 2:
                owner[j] = i
                rings[i], areas[i], filled[i] = hull, area, filled[i] + filled[j]
                del rings[j]
                apart = {pair for pair in apart if i not in pair}
                merged = True
            else:
                apart.add((i, j))
                rest.append((length, (a, b)))
        shared = rest
    return [ring for ring in rings.values() if area_of(ring) > 1e-9]


def prism(ring: NDArray[np.float64], bottom: float, top: float) -> Mesh:
    """A convex ring (K, 2), counter-clockwise, pulled up from z = bottom to z = top."""
    k = len(ring)
    vertices = np.concatenate([np.column_stack([ring, np.full(k, bottom)]), np.column_stack([ring, np.full(k, top)])])
    i = np.arange(k)
    j = (i + 1) % k
    fan = np.column_stack([np.zeros(k - 2, int), i[1:-1], i[2:]])
    faces = np.concatenate([fan[:, ::-1], fan + k, np.column_stack([i, j, j + k]), np.column_stack([i, j + k, i + k])])
    return Mesh(vertices, faces)


def extrude(polygon: Polygon, bottom: float, top: float) -> Mesh:
    """A polygon with holes pulled up from z = bottom to z = top: watertight, holes open."""
    vertices, faces = triangulate(polygon)
    n = len(vertices)
    solid = np.concatenate([np.column_stack([vertices, np.full(n, bottom)]), np.column_stack([vertices, np.full(n, top)])])
    return Mesh(solid, np.concatenate([faces[:, ::-1], faces + n, *_walls(faces, n)]))


def _walls(faces: NDArray[np.int64], n: int) -> list[NDArray[np.int64]]:
    """Side triangles over the border edges of a planar triangulation whose lifted copy starts at index n."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] * n + edges[:, 1]
    backward = edges[:, 1] * n + edges[:, 0]
    border = edges[~np.isin(forward, backward)]
    i, j = border[:, 0], border[:, 1]
    return [np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])]


def ring_points(polygon: Polygon, step: float) -> NDArray[np.float64]:
    """Points (N, 2) along all rings of a polygon, its corners and between them at most ``step`` apart."""
    result = []
    for ring in (polygon.exterior, *polygon.interiors):
        result.append(np.asarray(shapely.segmentize(ring, step).coords)[:-1])
    return np.concatenate(result)


def multi(polygons: list[Polygon]) -> MultiPolygon:
    """Polygons as one shape."""
    return MultiPolygon(polygons)
