"""Convex pieces against convex pieces: which two bodies touch (FCL, as MPlib ships it)."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from magic_core import masses, transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, box_corners
from magic_core.recent import Recent
from magic_core.scene import SceneObject

#: Vertices (V, 3) and outward faces (F, 3) of a convex hull.
Hull = tuple[NDArray[np.float64], NDArray[np.int32]]
#: Hulls of arrays that still live: the same pieces are asked for by every stage of every attempt.  The arrays are a request's, and are
#: not kept alive: every request brings others.
_HULLS: dict[int, tuple[weakref.ref[NDArray[np.float64]], Hull]] = {}
#: The same by content, for the next request brings the same pieces in other arrays: those of some objects of a hundred pieces.
_EQUAL_HULLS: Recent[bytes, Hull] = Recent(8 * 2**20)


def hull(vertices: NDArray[np.float64]) -> Hull:
    """Vertices (V, 3) and outward faces (F, 3) of the convex hull of points (N, 3); not to be written to.

    A set without volume (a sheet, a line) is thickened by 0.1 mm each way first, so that it still has a hull.
    """
    key = id(vertices)
    known = _HULLS.get(key)
    if known is not None and known[0]() is vertices:
        return known[1]
    result = _equal_hull(vertices)
    _HULLS[key] = weakref.ref(vertices, lambda _: _HULLS.pop(key, None)), result
    return result


def _equal_hull(vertices: NDArray[np.float64]) -> Hull:
    points = np.asarray(vertices, dtype=float)
    if points.size > 3 * MOST_VERTICES:
        return _hull(points)
    content = points.tobytes()
    known = _EQUAL_HULLS.get(content)
    if known is not None:
        return known
    made = _hull(points)
    return _EQUAL_HULLS.put(content, made, len(content) + made[0].nbytes + made[1].nbytes)


#: A piece with more vertices than this is represented by its outermost ones in this many directions.
MOST_VERTICES = 2000
DIRECTIONS = 600
#: Coordinates beyond this (metres) are no object of this world; their products are not numbers any more.
LARGEST = 1e4


def outermost(points: NDArray[np.float64], count: int = DIRECTIONS) -> NDArray[np.float64]:
    """Of points (N, 3) those (M, 3), M <= count, that reach furthest in ``count`` directions spread evenly over the sphere.

    The directions are stretched with the points, so that long and flat shapes are sampled as well as round ones: what is
    cut off is, with DIRECTIONS of them, below 1 % of the extent in each direction (0.3 % for a ball).
    """
    n = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * n / count), np.pi * (1 + np.sqrt(5)) * n
    directions = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])
    centred = points - points.mean(axis=0)
    axes = np.linalg.svd(centred.T @ centred)[0]
    centred = centred @ axes
    white = np.ascontiguousarray((centred / np.maximum(np.abs(centred).max(axis=0), 1e-9)).T, dtype=np.float32)
    towards = np.ascontiguousarray(directions.T, dtype=np.float32)
    best, index = np.full(count, -np.inf, np.float32), np.zeros(count, dtype=int)
    for first in range(0, len(points), 10_000):
        reach = towards @ white[:, first : first + 10_000]
        furthest = reach.argmax(axis=1)
        value = reach[np.arange(count), furthest]
        index = np.where(value > best, first + furthest, index)
        best = np.maximum(best, value)
    return points[np.unique(index)]


def _hull(vertices: NDArray[np.float64]) -> Hull:
    points = np.asarray(vertices, dtype=float).reshape(-1, 3)
    if len(points) == 0:
        raise MagicError(Code.BAD_MESH, "convex piece", "no vertices", "at least one vertex")
    if not np.abs(points).max() < LARGEST:
        raise MagicError(Code.BAD_MESH, "convex piece", f"{np.abs(points).max():.3g} m", f"coordinates below {LARGEST:g} m")
    if len(points) > MOST_VERTICES:
        points = outermost(points)
    try:
        shell = ConvexHull(points)
    except (QhullError, ValueError):
        pad = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 1e-4
        points = (points[:, None] + pad).reshape(-1, 3)
        try:
            shell = ConvexHull(points, qhull_options="QJ")
        except (QhullError, ValueError) as error:
            raise MagicError(Code.BAD_MESH, "convex piece", str(error).splitlines()[0], "points with a convex hull") from error
    used = np.unique(shell.simplices)
    index = np.zeros(len(points), dtype=np.int32)
    index[used] = np.arange(len(used), dtype=np.int32)
    faces = index[shell.simplices]
    corners = points[shell.simplices]
    # Qhull orders a simplex's corners anyhow; its equations hold the outward normals.
    inward = np.einsum("ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), shell.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points[used], faces.astype(np.int32)


def solid_pieces(item: SceneObject) -> tuple[Mesh, ...]:
    """The convex pieces of an object; where it has none, the convex hull of its mesh (object frame)."""
    pieces = tuple(p for p in item.pieces if len(p.vertices))
    if pieces:
        return pieces
    if len(item.mesh.vertices) == 0:
        raise MagicError(Code.BAD_MESH, f"mesh of {item.id}", "no vertices and no convex pieces", "an object with a shape")
    return (Mesh(*hull(item.mesh.vertices)),)


def outer_points(item: SceneObject) -> NDArray[np.float64]:
    """Corners (N, 3) of the convex hull of the whole object, object frame: all that its extent in a direction depends on."""
    return hull(np.concatenate([p.vertices for p in solid_pieces(item)]))[0]


#: What of the margin grown pieces have at least: an octahedron's faces are that much nearer than its corners.
LEAST_GROWTH = 3**-0.5


def grown(pieces: Iterable[Mesh], margin: float) -> tuple[Mesh, ...]:
    """Convex pieces grown by about ``margin`` metres: by that along the axes, by LEAST_GROWTH of it where they are least grown."""
    return tuple(Mesh(*_grown(piece, margin)) for piece in pieces)


def _grown(piece: Mesh, margin: float) -> Hull:
    steps = margin * np.concatenate([np.eye(3), -np.eye(3)])
    return _equal_hull((hull(piece.vertices)[0][:, None] + steps).reshape(-1, 3))


def mass_centre(pieces: Sequence[Mesh]) -> tuple[float, NDArray[np.float64]]:
    """Volume in m^3 of convex pieces taken together, and the centre (3,) of their mass."""
    return masses.mass_centre([hull(piece.vertices) for piece in pieces])


def fcl_pose(transform: NDArray[np.float64]) -> Any:
    """A 4x4 transform as MPlib's Pose."""
    import mplib

    return mplib.Pose(np.ascontiguousarray(transform, dtype=float))


def shell(pieces: Iterable[Mesh]) -> list[Any]:
    """The surfaces of convex pieces as one FCL triangle tree, in a list of one; not to be written to.

    Not FCL's convex geometries: those of more than 32 vertices are searched along their edges, which goes astray on flat
    faces and reports bodies 3 cm apart as touching; and a tree is asked in about 10 us whatever the number of pieces, a
    convex geometry in 10 us or more each.  Two surfaces do not meet where one body is wholly inside the other: :class:`Body`
    looks for that.  In the arm's collision world it is left out, for whatever would hold an object of the table is in the
    table as well, and whatever holds a finger meets the hand.
    """
    return [solid(pieces).tree]


def roomy_shell(pieces: Iterable[Mesh], margin: float) -> list[Any]:
    """A surface about each convex piece as one FCL triangle tree, in a list of one, that keeps ``margin`` metres from its faces.

    At least LEAST_GROWTH of the margin where a piece is sharp.  Pieces no larger than the margin become boxes.
    """
    pieces = tuple(pieces)
    hulls = [hull(piece.vertices) for piece in pieces]
    key = (*_names(hulls), margin)
    known = _SHELLS.get(key)
    if known is None:
        extents = np.array([np.ptp(vertices, axis=0).max() for vertices, _ in hulls])
        small = [vertices for (vertices, _), extent in zip(hulls, extents, strict=True) if extent <= margin]
        large = [piece for piece, extent in zip(pieces, extents, strict=True) if extent > margin]
        surfaces = [_box(vertices.min(axis=0) - margin, vertices.max(axis=0) + margin) for vertices in small]
        vertices, faces, _ = joined(surfaces + (_roomy(large, margin) if large else []))
        known = _SHELLS.put(key, (hulls, _tree(vertices, faces)), len(faces) * TREE_BYTES)
    return [known[1]]


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> Hull:
    """The surface of a box between two corners (3,)."""
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]], dtype=np.int32)
    return box_corners(low, high), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _roomy(pieces: Sequence[Mesh], margin: float) -> list[Hull]:
    """Surfaces about pieces: each corner goes out along the mean of the normals about it; pieces with corners too sharp for that
    are grown as :func:`grown` does it, which takes new convex hulls."""
    vertices, faces, first = joined([hull(piece.vertices) for piece in pieces])
    corners = vertices[faces]
    sides = _units(np.roll(corners, -1, axis=1) - corners)
    normals = _units(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    # Weighted by the angle at the corner a face counts the same however it is cut into triangles.
    angles = np.arccos(np.clip(-np.einsum("fij,fij->fi", sides, np.roll(sides, 1, axis=1)), -1.0, 1.0))
    out = np.zeros_like(vertices)
    np.add.at(out, faces, angles[:, :, None] * normals[:, None])
    out = _units(out)
    # A corner that goes out by d takes the faces about it along by d times the cosine.
    cosine = np.ones(len(vertices))
    np.minimum.at(cosine, faces, np.einsum("fij,fj->fi", out[faces], normals))
    farthest = 2.0
    blunt = np.minimum.reduceat(cosine, first) > LEAST_GROWTH / farthest
    piece_of_face = np.searchsorted(first, faces[:, 0], side="right") - 1
    surfaces = [(vertices + margin * out / np.maximum(cosine, 1 / farthest)[:, None], faces[blunt[piece_of_face]])]
    return surfaces + [_grown(piece, margin) for piece, b in zip(pieces, blunt, strict=True) if not b]


def joined(
    surfaces: Sequence[Hull],
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int64]]:
    """Triangle surfaces as one: vertices (V, 3), faces (F, 3), and where the vertices of each begin (P,)."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in surfaces[:-1]])
    faces = np.concatenate([faces + n for (_, faces), n in zip(surfaces, first, strict=True)])
    return np.concatenate([vertices for vertices, _ in surfaces]), faces.astype(np.int32), first


def _units(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (..., 3) scaled to length one; those of no length stay zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-15))


def _tree(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> Any:
    """Triangles as an FCL tree."""
    from mplib.collision_detection import fcl

    tree = fcl.BVHModel()
    tree.begin_model()
    tree.add_sub_model(vertices, faces)
    tree.end_model()
    return tree


@dataclass(frozen=True)
class Solid:
    """What collision tests need to know of P convex pieces, in their frame.

    tree: their surfaces; normals (P, F, 3), offsets (P, F): their planes, the shorter lists filled up, and how many (P,) there are
    of each; centres (P, 3), radii (P,): balls about them; halves (P, 3): half the sides of their boxes, about the same centres;
    first (P, 3): a point of each.
    """

    tree: Any
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    counts: NDArray[np.int64]
    centres: NDArray[np.float64]
    radii: NDArray[np.float64]
    halves: NDArray[np.float64]
    first: NDArray[np.float64]


#: What FCL's tree holds for each face, bytes.
TREE_BYTES = 560
#: Solids of pieces seen lately and shells about them, by their hulls, which are kept with them: an id is theirs for as long as they live.
_SOLIDS: Recent[tuple[int, ...], tuple[list[Hull], Solid]] = Recent(32 * 2**20)
_SHELLS: Recent[tuple[float, ...], tuple[list[Hull], Any]] = Recent(16 * 2**20)


def _names(hulls: Iterable[Hull]) -> tuple[int, ...]:
    return tuple(id(vertices) for vertices, _ in hulls)


def solid(pieces: Iterable[Mesh]) -> Solid:
    """What is needed of convex pieces; made once for pieces of the same shape.  Not to be written to."""
    hulls = [hull(piece.vertices) for piece in pieces]
    key = _names(hulls)
    known = _SOLIDS.get(key)
    if known is not None:
        return known[1]
    normals, offsets, counts = _planes(hulls)
    vertices, faces, _ = joined(hulls)
    centres = np.array([(vertices.min(axis=0) + vertices.max(axis=0)) / 2 for vertices, _ in hulls])
    made = Solid(
        tree=_tree(vertices, faces),
        normals=normals,
        offsets=offsets,
        counts=counts,
        centres=centres,
        radii=np.array([np.linalg.norm(v - c, axis=1).max() for (v, _), c in zip(hulls, centres, strict=True)]),
        halves=np.array([(vertices.max(axis=0) - vertices.min(axis=0)) / 2 for vertices, _ in hulls]),
        first=np.array([vertices[0] for vertices, _ in hulls]),
    )
    return _SOLIDS.put(key, (hulls, made), len(faces) * TREE_BYTES + normals.nbytes + offsets.nbytes)[1]


class Body:
    """A named rigid body of convex pieces that can be moved and asked what it touches."""

    def __init__(self, name: str, pieces: Iterable[Mesh]) -> None:
        """pieces: convex meshes in the body's frame."""
        import mplib
        from mplib.collision_detection import fcl

        self.name = name
        known = solid(pieces)
        self.object = fcl.CollisionObject(known.tree, mplib.Pose())
        self._planes = known.normals, known.offsets
        self.local, self.radii, self.first = known.centres, known.radii, known.first
        self.pose = np.eye(4)
        self.centres = self.local

    @classmethod
    def from_object(cls, item: SceneObject) -> Body:
        """A body of an object's pieces, already placed where the object is."""
        body = cls(item.id, solid_pieces(item))
        body.move(item.world_from_object)
        return body

    def move(self, world_from_body: NDArray[np.float64]) -> None:
        """Place the body."""
        self.pose = np.asarray(world_from_body, dtype=float)
        self.centres = transforms.apply(self.pose, self.local)
        self.object.set_pose(fcl_pose(self.pose))

    def touches(self, other: Body, inside: bool = True) -> bool:
        """Whether this body and the other have a point in common; without ``inside`` their surfaces only, which is quicker."""
        from mplib.collision_detection import fcl

        if not inside:
            return bool(fcl.collide(self.object, other.object).is_collision())
        reach = self.radii[:, None] + other.radii[None, :]
        near = np.argwhere(np.linalg.norm(self.centres[:, None] - other.centres[None, :], axis=2) < reach)
        if not len(near):
            return False
        if fcl.collide(self.object, other.object).is_collision():
            return True
        # The surfaces are apart: a piece is wholly inside another one, with any of its points, or outside.
        return self._holds(other, near) or other._holds(self, near[:, ::-1])

    def _holds(self, other: Body, pairs: NDArray[np.int64]) -> bool:
        """Whether the first point of other's piece j lies in this body's piece i, for any of the pairs (N, 2) of i and j."""
        points = transforms.apply(transforms.inverse(self.pose), transforms.apply(other.pose, other.first))
        near = np.linalg.norm(points[pairs[:, 1]] - self.local[pairs[:, 0]], axis=1) < self.radii[pairs[:, 0]]
        if not near.any():
            return False
        i, j = pairs[near].T
        normals, offsets = self._planes
        heights = np.matmul(normals[i], points[j][:, :, None])[:, :, 0] - offsets[i]
        return bool((heights.max(axis=1) <= 0).any())


def padded(rows: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Arrays of different lengths as one (N, longest, ...), the shorter ones filled up with copies of their first row."""
    longest = max(len(row) for row in rows)
    return np.stack([np.concatenate([row, np.repeat(row[:1], longest - len(row), axis=0)]) for row in rows])


def _planes(
    hulls: Sequence[Hull],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Outward unit normals (P, F, 3) of the hulls' faces, their offsets (P, F), and how many (P,) there are of each: inside is where
    normals @ x <= offsets.  Triangles of one flat face count once; the shorter lists are filled up with copies of their first."""
    vertices, faces, first = joined(hulls)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > min(1e-14, 1e-6 * lengths.max())
    normals = normals[good] / lengths[good][:, None]
    offsets = np.einsum("ij,ij->i", normals, a[good])
    piece = np.searchsorted(first, faces[good, 0], side="right") - 1
    # To 0.01 mrad and 0.1 um.
    once = np.unique(np.column_stack([piece, np.round(normals * 1e5), np.round(offsets * 1e7)]), axis=0, return_index=True)[1]
    once.sort()
    counts = np.bincount(piece[once], minlength=len(hulls))
    starts = np.cumsum(counts) - counts
    n = np.arange(max(int(counts.max()), 1))
    rows = once[np.where(n < counts[:, None], starts[:, None] + n, starts[:, None]).clip(0, len(once) - 1)]
    return normals[rows], offsets[rows], counts
