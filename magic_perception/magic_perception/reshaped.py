"""A tool's mesh, mended by the pictures in which it is used: what its first look showed wrong, or not at all, is moved along its normals.

A tool that is nearer to a camera and one that is thicker look alike, so that pose and surface are sought together: the measured points
of a moment are off by ``r = J x + B d``, with the change ``x`` (6,) of the tool's pose and how far the surface is off, ``d``, at points all
over it.  ``x`` is taken out of each moment's normal equations (by their Schur complement) after what else is known of the pose: that the
tool lay where it lay first, and where its outline was seen since.  What is left of all moments says what ``d`` is, beside what it is
expected to be: a Gaussian process over the surface, as far off as reconstructed surfaces are.

A measured point belongs to what its ray meets, not to what is nearest to it: behind a wall of 3 mm the nearest is its other side, so that
only points with errors towards the camera count, and the depth of a rim that has run over the hollow behind it is nearest to that rim.
Both made walls thicker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from magic_core import transforms
from magic_core.mesh import Mesh

Array = NDArray[np.float64]
#: How far a reconstructed surface is off (standard deviation, m); errors hold together over so far (m), on one side of a wall.
OFF, TOGETHER = 0.003, 0.015
#: Each time it is moved by at most so many deviations, and inwards by no more than this share of the thickness there.
MOST, THINNER = 2.0, 0.4
#: Standard deviation (m) of a measured point; the points of a picture count as so many at most; farther off (m), along their rays, they are
#: not the tool's.
NOISE, WORTH, CLOSE = 0.004, 60.0, 0.010
#: A surface is measured by what looks at it from no farther aside than this cosine.
FACING = 0.3
#: The mesh is divided into edges of at most this (m) before it is moved.
EDGE = 0.006
#: So many points tell of a place between them.
NEIGHBOURS = 3


class Aside(NamedTuple):
    """How far (K,) m the surface seems off along (K, 3) at places (K, 3), all in the world, with weights (K,) 1/m^2."""

    off: Array
    along: Array
    places: Array
    weights: Array


class Picture(NamedTuple):
    """What one shows of the tool: measured points (M, 3) of the world and where the camera is (3,); and the outline."""

    points: Array
    eye: Array
    outline: Aside


class Met(NamedTuple):
    """Where rays through measured points meet a surface, in its frame: how far (K,) m the points are before it along its normals (K, 3), at
    feet (K, 3); which of the points, (M,), these are."""

    off: Array
    normals: Array
    feet: Array
    which: NDArray[np.bool_]


class Reshaping:
    """What pictures say of a surface: mesh, in its own frame; points (N, 3) on it with their normals (N, 3); first: what has mended it
    before."""

    def __init__(self, mesh: Mesh, points: Array, normals: Array, first: Reshaping | None = None) -> None:
        self._mesh, self._first = mesh, first
        self._scene = raycaster(mesh)
        inward = np.concatenate([points - 1e-4 * normals, -normals], axis=1).astype(np.float32)
        thick = self._scene.cast_rays(o3d.core.Tensor(inward))["t_hit"].numpy().astype(float)
        self._least = -np.minimum(MOST * OFF, THINNER * np.where(np.isfinite(thick), thick, 0.0))
        self._places = _placed(points, normals)
        self._tree = cKDTree(self._places)
        apart = ((self._places[:, None] - self._places[None]) ** 2).sum(axis=-1)
        expected = OFF**2 * (np.exp(-apart / 2) + 1e-4 * np.eye(len(points)))
        self._matrix, self._vector = np.linalg.inv(expected), np.zeros(len(points))

    def see(self, pictures: Sequence[Picture], pose: Array, middle: Array, known: Array) -> None:
        """Take what the pictures of a moment show.

        pose (4, 4): where the tool is about; known (6, 6): how well, as information of a change of it, by a shift of the tool's middle
        (3,), in its own frame, and by a turn about it.
        """
        known, pull = known.copy(), np.zeros(6)
        count = len(self._vector)
        both, alone, off = np.zeros((6, count)), np.zeros((count, count)), np.zeros(count)
        tool_from_world = transforms.inverse(pose)
        for picture in pictures:
            for signed, gradient, place, weight in (self._measured(picture, pose), picture.outline):
                jacobian = np.concatenate([gradient, np.cross(place - transforms.apply(pose, middle), gradient)], axis=1)
                shares = self._shares(transforms.apply(tool_from_world, place), gradient @ pose[:3, :3])
                weighted = shares.multiply(weight[:, None]).tocsr()
                known += (jacobian * weight[:, None]).T @ jacobian
                pull += jacobian.T @ (weight * signed)
                both += (weighted.T @ jacobian).T
                alone += (shares.T @ weighted).toarray()
                off += weighted.T @ signed
        moved = np.linalg.solve(known, np.column_stack([both, pull]))
        self._matrix += alone - both.T @ moved[:, :-1]
        self._vector += off - both.T @ moved[:, -1]

    def mended(self, pieces: Sequence[Mesh] = ()) -> tuple[Mesh, tuple[Mesh, ...]]:
        """The mesh with its surface where the pictures say, and convex pieces of its solid (as it was before any mending), their corners
        moved as the surface nearest to them is."""
        if self._first is not None:
            pieces = self._first.mended(pieces)[1]
        whole = trimesh.Trimesh(self._mesh.vertices, self._mesh.faces, process=True)  # what is one corner is moved as one
        fine = trimesh.Trimesh(*divided(whole.vertices, whole.faces, EDGE), process=False)
        off = np.clip(np.linalg.solve(self._matrix, self._vector), self._least, MOST * OFF)
        shift = (self._shares(fine.vertices, fine.vertex_normals) @ off)[:, None] * fine.vertex_normals
        colors = None if self._mesh.colors is None else self._mesh.colors[cKDTree(self._mesh.vertices).query(fine.vertices)[1]]
        scene = raycaster(Mesh(fine.vertices, fine.faces))

        def moved(piece: Mesh) -> Mesh:
            closest = scene.compute_closest_points(o3d.core.Tensor(piece.vertices.astype(np.float32)))
            second, third = closest["primitive_uvs"].numpy().astype(float).T
            corners = shift[fine.faces[closest["primitive_ids"].numpy()]]
            return replace(
                piece, vertices=piece.vertices + np.einsum("nk,nki->ni", np.column_stack([1 - second - third, second, third]), corners)
            ).convex_hull()

        return Mesh(fine.vertices + shift, fine.faces, colors), tuple(moved(piece) for piece in pieces)

    def _measured(self, picture: Picture, pose: Array) -> Aside:
        """Of a picture's points those that are the tool's: depth that is smeared past the tool's outline is not of it."""
        tool_from_world = transforms.inverse(pose)
        off, normals, feet, _ = met(
            self._scene, transforms.apply(tool_from_world, picture.points), transforms.apply(tool_from_world, picture.eye)
        )
        weight = (1 / (1 + (off / (CLOSE / 2)) ** 2)) ** 2 / NOISE**2 * min(1.0, WORTH / max(len(off), 1))
        return Aside(off, normals @ pose[:3, :3].T, transforms.apply(pose, feet), weight)

    def _shares(self, places: Array, normals: Array) -> csr_matrix:
        """(M, N): how much the points tell of places (M, 3) with their normals (M, 3)."""
        away, near = self._tree.query(_placed(places, normals), NEIGHBOURS)
        weight = 1 / np.maximum(away, 1e-3)
        weight /= weight.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(places)), NEIGHBOURS)
        return csr_matrix((weight.ravel(), (rows, near.ravel())), (len(places), len(self._vector)))


def raycaster(mesh: Mesh) -> o3d.t.geometry.RaycastingScene:
    """A mesh, ready for rays and for what is nearest on it."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene


def met(scene: o3d.t.geometry.RaycastingScene, points: Array, eye: Array) -> Met:
    """Where rays from an eye (3,) through measured points (M, 3) meet a surface that faces it and is no farther than CLOSE from them, all
    in its frame.

    What is in sight is what was measured; where that is farther off, as along the edge of what is before it, the sensor's depth is of
    something else.
    """
    away = points - eye
    rays = np.concatenate([np.broadcast_to(eye, points.shape), away], axis=1).astype(np.float32)
    cast = scene.cast_rays(o3d.core.Tensor(rays))
    far, normals = cast["t_hit"].numpy().astype(float), cast["primitive_normals"].numpy().astype(float)
    length, along = np.linalg.norm(away, axis=1), (normals * away).sum(axis=1)
    which = (np.abs(far - 1) * length < CLOSE) & (-along > FACING * length)
    far, away, along, normals = far[which], away[which], along[which], normals[which]
    return Met((1 - far) * along, normals, eye + far[:, None] * away, which)


def divided(vertices: Array, faces: NDArray[np.int64], longest: float) -> tuple[Array, NDArray[np.int64]]:
    """The same surface, vertices (V, 3) and faces (F, 3), with no edge longer than ``longest``, and closed if it was: an edge is halved for
    both of its faces, when it is the longest of either."""
    vertices, faces = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    while True:
        edges, which = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        which, rank = which.reshape(-1, 3), np.argsort(np.argsort(length, kind="stable"))
        side = rank[which].argmax(axis=1)
        most = which[np.arange(len(faces)), side]
        halved = (length > longest) & (np.bincount(most, minlength=len(edges)) == np.bincount(which.ravel(), minlength=len(edges)))
        if not halved.any():
            return vertices, faces
        middle = len(vertices) - 1 + np.cumsum(halved)
        vertices = np.concatenate([vertices, vertices[edges[halved]].mean(axis=1)])
        cut = np.flatnonzero(halved[most])
        a, b, c = (faces[cut, (side[cut] + k) % 3] for k in range(3))
        m = middle[most[cut]]
        faces = np.concatenate([np.delete(faces, cut, axis=0), np.column_stack([a, m, c]), np.column_stack([m, b, c])])


def _placed(points: Array, normals: Array) -> Array:
    """(N, 6): points whose errors hold together are near each other."""
    return np.concatenate([points / TOGETHER, normals], axis=1)
