"""Closed solids and their convex pieces: hulls joined where that fills little, prisms, lofts through rings."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from magic_core.mesh import Mesh, concatenate
from magic_perception import polygons
from magic_perception.sight import Agreement

#: Convex parts of what is pulled up keep to its outline by this, m.
PRISM = 0.0004
#: A run of rings is one piece as long as its hull keeps within this (m) of them.
RUN = 0.004


@dataclass(frozen=True)
class Reconstruction:
    """mesh and convex pieces in the table frame; ``shape`` names how they came about; ``fit``: how the mesh agrees
    with what was seen, where that was asked already."""

    mesh: Mesh
    pieces: tuple[Mesh, ...]
    shape: str
    fit: Agreement | None = None


def hull_of(points: NDArray[np.float64]) -> Mesh | None:
    """The convex hull of points (N, 3), faces outward; ``None`` where they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = points[used]
    p = vertices[faces]
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices, faces)


def hangs_together(mesh: Mesh, gap: float) -> bool:
    """Whether no part of a mesh is farther than ``gap`` metres from all others, from vertex to vertex."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    tree = cKDTree(mesh.vertices)
    near = tree.query_pairs(1e-6, output_type="ndarray")  # corners that faces do not share
    a, b = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], near]).T
    n = len(mesh.vertices)
    count, part = connected_components(coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n, n)), directed=False)
    if count == 1:
        return True
    pairs = tree.query_pairs(gap, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), np.int8), (part[pairs[:, 0]], part[pairs[:, 1]])), shape=(count, count))
    return connected_components(links, directed=False)[0] == 1


#: How far what a quick hull (manifold3d) fills may be from what Qhull says, over half of its surface, m: the rounding of both, with room.
_QUICK = 1e-6


def joined(clouds: list[NDArray[np.float64]], tolerance: float = 0.001, most: int = 40, limit: float = 0.0025) -> list[Mesh]:
    """Hulls of clouds (N, 3), neighbours joined, the pair that fills least first.

    Two are joined where the volume that their common hull fills, over half of its surface, is at most ``tolerance``
    metres; with more than ``most`` left the tolerance grows up to ``limit``.
    """
    joining = _Joining(clouds, limit)
    joining.join(tolerance, most)
    return [mesh for part in joining.parts.values() if (mesh := hull_of(part.corners)) is not None]


@dataclass(frozen=True)
class _Hull:
    """A convex hull: its corners (N, 3), volume (m^3) and surface (m^2)."""

    corners: NDArray[np.float64]
    volume: float
    area: float

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> _Hull | None:
        """Of points (N, 3); ``None`` where they are flat."""
        from scipy.spatial import ConvexHull, QhullError

        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            return None
        return cls(points[hull.vertices], hull.volume, hull.area)

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Its lowest and highest coordinates (3,)."""
        return self.corners.min(axis=0), self.corners.max(axis=0)


class _Joining:
    """Hulls that are being joined two by two, by number; a joined one gets the next number.

    limit: pairs whose common hull fills more than this, m, are never joined.
    """

    def __init__(self, clouds: list[NDArray[np.float64]], limit: float) -> None:
        self.parts: dict[int, _Hull] = {}
        self._limit = limit
        # The volume of the clouds' own hulls in each part, and its box.
        self._own: dict[int, float] = {}
        self._boxes = np.empty((2 * len(clouds), 2, 3))
        # What fills how much at least, its exact value not known before it is the least of all: most pairs never are.
        self._queue: list[tuple[float, int, int]] = []
        self._common: dict[tuple[int, int], _Hull] = {}
        for hull in (_Hull.of(cloud) for cloud in clouds):
            if hull is not None:
                self._add(len(self.parts), hull, hull.volume)
        for i in list(self.parts):
            self._offer(i, [j for j in self.parts if j > i])

    def join(self, tolerance: float, most: int) -> None:
        """Join while a pair fills at most ``tolerance`` m, or more than ``most`` are left."""
        following = len(self.parts)
        while self._queue:
            excess, i, j = heapq.heappop(self._queue)
            if i not in self.parts or j not in self.parts:
                self._common.pop((i, j), None)
                continue
            if excess > tolerance and len(self.parts) <= most:
                break
            if (i, j) not in self._common:
                self._measure(i, j)
                continue
            self._add(following, self._common.pop((i, j)), self._own[i] + self._own[j])
            for gone in (i, j):
                del self.parts[gone], self._own[gone]
            self._offer(following, [other for other in self.parts if other != following])
            following += 1

    def _add(self, number: int, hull: _Hull, own: float) -> None:
        self.parts[number], self._own[number], self._boxes[number] = hull, own, hull.box

    def _excess(self, i: int, j: int, volume: float, area: float) -> float:
        """How much a common hull of two parts fills over half of its surface, m."""
        return (volume - self._own[i] - self._own[j]) / (area / 2)

    def _offer(self, i: int, others: list[int]) -> None:
        """Queue a part with each of the others that is near, by what their common hull fills at least."""
        from manifold3d import Manifold

        if not others:
            return
        box = self._boxes[others]
        near = np.all((box[:, 0] < self._boxes[i][1] + 5e-4) & (box[:, 1] > self._boxes[i][0] - 5e-4), axis=1)
        for j in np.array(others)[near].tolist():
            both = Manifold.hull_points(np.concatenate([self.parts[i].corners, self.parts[j].corners]))
            area = both.surface_area()
            least = self._excess(i, j, both.volume(), area) - _QUICK if area > 0 else -np.inf
            if least < self._limit:
                heapq.heappush(self._queue, (least, i, j))

    def _measure(self, i: int, j: int) -> None:
        """Queue a pair once more, by what its common hull truly fills."""
        hull = _Hull.of(np.concatenate([self.parts[i].corners, self.parts[j].corners]))
        if hull is not None and (excess := self._excess(i, j, hull.volume, hull.area)) < self._limit:
            self._common[i, j] = hull
            heapq.heappush(self._queue, (excess, i, j))


def extruded(parts: list[Polygon], height: float, shape: str) -> Reconstruction:
    """Polygons pulled up from the table, with the prisms of their convex parts."""
    pieces = [polygons.prism(ring, 0.0, height) for part in parts for ring in polygons.convex_parts(part.simplify(0.0005), PRISM)]
    return Reconstruction(concatenate([polygons.extrude(part, 0.0, height) for part in parts]), tuple(pieces), shape)


def lofted(rings: NDArray[np.float64]) -> Mesh:
    """The closed solid through rings (L, K, 3), counter-clockwise, from the bottom up."""
    levels, k = rings.shape[:2]
    i = np.arange(k)
    j = (i + 1) % k
    faces = []
    for row in range(levels - 1):
        a, b = row * k, (row + 1) * k
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(axis=0, keepdims=True), rings[-1].mean(axis=0, keepdims=True)])
    last = (levels - 1) * k
    faces.append(np.column_stack([np.full(k, levels * k), j, i]))
    faces.append(np.column_stack([np.full(k, levels * k + 1), last + i, last + j]))
    return Mesh(vertices, np.concatenate(faces))


def loft_pieces(rings: NDArray[np.float64]) -> list[Mesh]:
    """Convex hulls of runs of rings (L, K, 3): a run grows upwards as long as its hull keeps within :data:`RUN` metres of the rings in
    it."""
    pieces = []
    start = 0
    flat = rings[..., :2]
    area = np.array([polygons.area_of(ring) for ring in flat])
    perimeter = np.array([np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum() for ring in flat])
    while start < len(rings) - 1:
        stop = start + 1
        while stop + 1 < len(rings):
            fits = True
            a, b = flat[start], flat[stop + 1]
            for row in range(start + 1, stop + 1):
                # The hull's section between the run's ends holds at least their blend.
                share = (row - start) / (stop + 1 - start)
                blend = polygons.area_of(polygons.convex_hull(np.concatenate([(1 - share) * a + share * b, flat[row]])))
                if blend - area[row] > RUN * perimeter[row] / 2:
                    fits = False
                    break
            if not fits:
                break
            stop += 1
        hull = hull_of(rings[start : stop + 1].reshape(-1, 3))
        if hull is not None:
            pieces.append(hull)
        start = stop
    return pieces
