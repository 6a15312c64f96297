"""The measured points of a scene as obstacles: what was seen but is in nobody's reconstruction must be avoided as well.

The convex pieces of an object are what perception made of its points.  Where they
cover the points these add nothing but noise; what remains outside of all pieces (a
stroke that was taken for noise, a second thing taken into the cluster, a corner that
the completion cut off) goes into the collision world as an octree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_planner.collision import hull, solid_pieces

Array = NDArray[np.float64]
#: No object's cloud is thinned from more points than this; of larger ones every n-th is taken.
MOST_POINTS = 200_000


@dataclass(frozen=True)
class CloudSettings:
    """use: whether measured points are obstacles.  resolution: edge of a voxel in metres; margin: points nearer than this
    to a reconstructed shape, the tool or the table are left to that shape (noise of the depth, and of the reconstruction)."""

    use: bool = True
    resolution: float = 0.01
    margin: float = 0.01

    def __post_init__(self) -> None:
        if not 0.002 <= self.resolution <= 0.1:
            raise MagicError(Code.BAD_REQUEST, "cloud resolution", self.resolution, "0.002 to 0.1 m")
        if not 0.0 <= self.margin <= 0.2:
            raise MagicError(Code.BAD_REQUEST, "cloud margin", self.margin, "0 to 0.2 m")


def cloud_name(item: SceneObject) -> str:
    """What the measured points of an object are called in messages and in the collision world."""
    return f"points of {item.id}"


def thinned(points: Array, resolution: float) -> Array:
    """One point (M, 3) for each voxel that points (N, 3) lie in: the voxel's centre, in the order of the grid."""
    if not len(points):
        return points.reshape(0, 3)
    return (np.unique(np.floor(points / resolution).astype(np.int64), axis=0) + 0.5) * resolution


def outside(points: Array, pieces: Sequence[Mesh], world_from_object: Array, margin: float) -> NDArray[np.bool_]:
    """(N,) whether each point (N, 3) in the world is further than ``margin`` metres from all convex pieces (object frame).

    The distance is the one to the nearest face's plane: at edges and corners a little more than the margin counts as near.
    """
    local = transforms.apply(transforms.inverse(world_from_object), points)
    free = np.ones(len(local), dtype=bool)
    for piece in pieces:
        vertices, faces = hull(piece.vertices)
        low, high = vertices.min(axis=0) - margin, vertices.max(axis=0) + margin
        near = np.flatnonzero(free & ((local > low) & (local < high)).all(axis=1))
        if not len(near):
            continue
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        lengths = np.linalg.norm(normals, axis=1)
        good = lengths > 1e-14
        normals = normals[good] / lengths[good][:, None]
        beyond = local[near] @ normals.T - np.einsum("ij,ij->i", normals, a[good])
        free[near[beyond.max(axis=1) <= margin]] = False
    return free


def unexplained(seen: Sequence[SceneObject], tool: SceneObject, plane: Array, settings: CloudSettings) -> dict[str, Array]:
    """Voxel centres (M, 3), world metres, of the measured points of each seen object that no shape accounts for.

    Left out are points within the margin of the pieces of any of the objects (known fixtures among them), of the tool where it
    lies, and of the table or below it.  The tool's own points are never obstacles.  Objects without such points are left out.
    """
    if not settings.use:
        return {}
    found = {}
    for item in seen:
        points = np.asarray(item.points, dtype=float).reshape(-1, 3)
        points = points[:: max(1, -(-len(points) // MOST_POINTS))]
        points = points[np.isfinite(points).all(axis=1)]
        points = thinned(points[points @ plane[:3] + plane[3] > settings.margin], settings.resolution)
        for other in (item, tool, *(o for o in seen if o is not item)):
            if not len(points):
                break
            # A voxel's centre stands for points half a voxel to each side of it.
            points = points[outside(points, solid_pieces(other), other.world_from_object, settings.margin + settings.resolution / 2)]
        if len(points):
            found[item.id] = points
    return found
