"""Triangle meshes: one small frozen type, with trimesh behind it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) float64 metres, faces (F, 3) int32 counter-clockwise from outside,
    colors (V, 3) uint8 RGB or ``None``."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.ascontiguousarray(self.faces, dtype=np.int32).reshape(-1, 3)
        if len(vertices) and not np.all(np.isfinite(vertices)):
            raise MagicError(Code.BAD_MESH, "vertices", "NaN or infinite", "finite coordinates in metres")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise MagicError(Code.BAD_MESH, "face index", int(faces.max()), f"0 to {len(vertices) - 1}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        if self.colors is not None:
            object.__setattr__(self, "colors", np.ascontiguousarray(self.colors, dtype=np.uint8).reshape(-1, 3))

    @cached_property
    def principal_axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """See :func:`magic_core.views.own_axes`; asked for again and again, and computed once."""
        corners = self.vertices[self.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) + 1e-15
        centroid = np.average(corners.mean(axis=1), axis=0, weights=area)
        middles = (corners + np.roll(corners, 1, axis=1)) / 2 - centroid
        axes = np.linalg.eigh(np.einsum("n,nki,nkj->ij", area, middles, middles))[1].T[::-1].copy()
        along_axes = middles @ axes.T
        second, third = (np.einsum("n,nki->i", area, along_axes**n) / (3 * area.sum()) for n in (2, 3))
        skew = third / np.maximum(second, 1e-30) ** 1.5
        axes[skew < 0] *= -1
        if np.linalg.det(axes) < 0:
            axes[int(np.argmin(np.abs(skew)))] *= -1
        axes.flags.writeable = centroid.flags.writeable = False
        return axes, centroid

    @property
    def bounds(self) -> NDArray[np.float64]:
        """(2, 3): lower and upper corner of the axis-aligned box."""
        if len(self.vertices) == 0:
            raise MagicError(Code.BAD_MESH, "mesh", "no vertices", "at least one triangle")
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def extents(self) -> NDArray[np.float64]:
        """(3,): edge lengths of the axis-aligned box in metres."""
        low, high = self.bounds
        return high - low

    def transformed(self, transform: NDArray[np.float64]) -> Mesh:
        """The mesh with its vertices mapped by a 4x4 rigid transform."""
        return Mesh(transforms.apply(transform, self.vertices), self.faces, self.colors)

    def scaled(self, factor: float) -> Mesh:
        """The mesh scaled about its origin."""
        return Mesh(self.vertices * float(factor), self.faces, self.colors)

    def painted(self, color: tuple[int, int, int]) -> Mesh:
        """The mesh with one colour for all vertices."""
        return Mesh(self.vertices, self.faces, np.tile(np.array(color, dtype=np.uint8), (len(self.vertices), 1)))

    def convex_hull(self) -> Mesh:
        """The convex hull as a mesh."""
        hull = self.to_trimesh().convex_hull
        return Mesh(hull.vertices, hull.faces)

    def to_trimesh(self) -> trimesh.Trimesh:
        """The same mesh as trimesh's type, vertices unmerged."""
        return trimesh.Trimesh(self.vertices, self.faces, vertex_colors=self.colors, process=False)

    def save(self, path: str | Path) -> None:
        """Write the mesh; the ending names the format (ply, obj, stl)."""
        self.to_trimesh().export(str(path))


#: A mesh that is thinner than this share of its length has no inside, and no two sides to be grasped by or to be seen from.
FLAT = 1e-5


def check_solid(mesh: Mesh, what: str) -> None:
    """Raises BAD_MESH, naming ``what``, for a mesh that bounds no body: fewer than four triangles, or all of it in one plane."""
    if len(mesh.faces) < 4:
        raise MagicError(Code.BAD_MESH, f"triangles of {what}", len(mesh.faces), "at least 4, around a body")
    used = mesh.vertices[np.unique(mesh.faces)]
    centred = used - used.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    longest, thinnest = np.ptp(along[:, 0]), np.ptp(along[:, 2])
    if not thinnest > FLAT * longest:
        raise MagicError(Code.BAD_MESH, f"thickness of {what} in m", float(f"{thinnest:.3g}"), f"above {FLAT * longest:.2g}; it is flat")


def box_corners(low: NDArray, high: NDArray) -> NDArray:
    """(8, 3): the corners of the box along the axes from its lowest (3,) to its highest (3,); z changes first, then y."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def concatenate(meshes: list[Mesh] | tuple[Mesh, ...]) -> Mesh:
    """One mesh that holds all the given ones; colours are kept where all have them."""
    if not meshes:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3)))
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    colors = [m.colors for m in meshes]
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + offset for m, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate(colors) if all(c is not None for c in colors) else None,
    )


def from_trimesh(mesh: trimesh.Trimesh) -> Mesh:
    """Take over vertices, faces and, where there are any, vertex colours of a trimesh mesh."""
    colors = None
    if mesh.visual.defined and mesh.visual.kind == "vertex":
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
    return Mesh(mesh.vertices, mesh.faces, colors)


def load(path: str | Path) -> Mesh:
    """Read a mesh file in metres (anything trimesh reads); its parts are joined into one mesh."""
    path = Path(path)
    if not path.is_file():
        raise MagicError(Code.BAD_MESH, "mesh file", str(path), "an existing ply, obj or stl file")
    try:
        mesh = trimesh.load(str(path), force="mesh", process=False)
    except Exception as error:  # trimesh's readers raise whatever their format brings up
        raise MagicError(Code.BAD_MESH, f"mesh file {path}", str(error), "a readable ply, obj or stl file") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise MagicError(Code.BAD_MESH, "mesh file", str(path), "a file with at least one triangle")
    return from_trimesh(mesh)
