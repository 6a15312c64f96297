"""Convex pieces against convex pieces: which two bodies touch, and where (FCL, as MPlib ships it)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject

#: Hulls of arrays seen lately: the same pieces are asked for by every stage of every attempt.
_HULLS: OrderedDict[int, tuple[Any, tuple[NDArray[np.float64], NDArray[np.int32]]]] = OrderedDict()
_KEPT_HULLS = 4000


def hull(vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3) and outward faces (F, 3) of the convex hull of points (N, 3); not to be written to.

    A set without volume (a sheet, a line) is thickened by 0.1 mm each way first, so that it still has a hull.
    """
    known = _HULLS.get(id(vertices))
    if known is not None and known[0] is vertices:
        return known[1]
    result = _hull(vertices)
    _HULLS[id(vertices)] = (vertices, result)
    while len(_HULLS) > _KEPT_HULLS:
        _HULLS.popitem(last=False)
    return result


def _hull(vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    points = np.asarray(vertices, dtype=float).reshape(-1, 3)
    if len(points) == 0:
        raise MagicError(Code.BAD_MESH, "convex piece", "no vertices", "at least one vertex")
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


def mass_centre(pieces: Sequence[Mesh]) -> tuple[float, NDArray[np.float64]]:
    """Volume in m^3 of convex pieces taken together, and the centre (3,) of their mass."""
    volumes, centres = np.zeros(len(pieces)), np.zeros((len(pieces), 3))
    for n, piece in enumerate(pieces):
        vertices, faces = hull(piece.vertices)
        corners = vertices[faces] - vertices[0]
        tetrahedra = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        volumes[n] = max(float(tetrahedra.sum()), 1e-12)
        centres[n] = vertices[0] + (tetrahedra[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / volumes[n]
    return float(volumes.sum()), np.average(centres, axis=0, weights=volumes)


def fcl_pose(transform: NDArray[np.float64]) -> Any:
    """A 4x4 transform as MPlib's Pose."""
    import mplib

    return mplib.Pose(np.ascontiguousarray(transform, dtype=float))


def convex_shapes(pieces: Iterable[Mesh]) -> list[Any]:
    """Convex pieces as FCL's convex geometries."""
    from mplib.collision_detection import fcl

    return [fcl.Convex(*hull(piece.vertices)) for piece in pieces]


def shell(pieces: Iterable[Mesh]) -> list[Any]:
    """The surfaces of convex pieces as one FCL triangle tree, in a list of one.

    For the arm's collision world: there a triangle tree is asked in about 10 us whatever the number of pieces, a convex
    geometry in 10 us or more each.  Two surfaces do not meet where one body is wholly inside the other; in this world
    whatever would hold an object of the table is in the table as well, and whatever holds a finger meets the hand.
    """
    from mplib.collision_detection import fcl

    tree = fcl.BVHModel()
    tree.begin_model()
    for piece in pieces:
        tree.add_sub_model(*hull(piece.vertices))
    tree.end_model()
    return [tree]


class Body:
    """A named rigid body of convex shapes that can be moved and asked what it touches."""

    def __init__(self, name: str, shapes: Sequence[Any], local: Sequence[NDArray[np.float64]], radii: Sequence[float]) -> None:
        """shapes: FCL geometries; local: body_from_shape (4, 4) of each; radii: of the ball about each shape's origin, m."""
        import mplib
        from mplib.collision_detection import fcl

        self.name = name
        self.shapes = list(shapes)
        self.objects = [fcl.CollisionObject(shape, mplib.Pose()) for shape in shapes]
        self.local = np.asarray(local, dtype=float).reshape(-1, 4, 4)
        self.radii = np.asarray(radii, dtype=float)
        self.centres = self.local[:, :3, 3].copy()

    @classmethod
    def from_pieces(cls, name: str, pieces: Iterable[Mesh]) -> Body:
        """A body of convex meshes given in the body's frame."""
        from mplib.collision_detection import fcl

        shapes, local, radii = [], [], []
        for piece in pieces:
            vertices, faces = hull(piece.vertices)
            centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
            shapes.append(fcl.Convex(vertices - centre, faces))
            local.append(transforms.make(translation=centre))
            radii.append(float(np.linalg.norm(vertices - centre, axis=1).max()))
        return cls(name, shapes, local, radii)

    @classmethod
    def from_object(cls, item: SceneObject) -> Body:
        """A body of an object's pieces, already placed where the object is."""
        body = cls.from_pieces(item.id, solid_pieces(item))
        body.move(item.world_from_object)
        return body

    def move(self, world_from_body: NDArray[np.float64]) -> None:
        """Place the body."""
        world_from_shape = np.asarray(world_from_body) @ self.local
        self.centres = world_from_shape[:, :3, 3]
        for shape, pose in zip(self.objects, world_from_shape, strict=True):
            shape.set_pose(fcl_pose(pose))

    def touches(self, other: Body) -> bool:
        """Whether any shape of this body meets any of the other's."""
        from mplib.pymp.collision_detection import fcl

        reach = self.radii[:, None] + other.radii[None, :]
        near = np.linalg.norm(self.centres[:, None] - other.centres[None, :], axis=2) < reach
        for i, j in np.argwhere(near):
            if fcl.collide(self.objects[i], other.objects[j]).is_collision():
                return True
        return False
