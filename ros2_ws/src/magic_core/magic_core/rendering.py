"""Pictures of meshes by ray casting (Open3D, CPU): no renderer, no GPU, no display."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView

#: Edge length in pixels of a canonical view, and the share of it that the object fills.
VIEW_SIZE = 384
VIEW_FILL = 0.8

GREY = np.array([180, 180, 185], dtype=np.uint8)


@dataclass(frozen=True)
class Cast:
    """Where a grid of rays hit.

    distance (H, W) float32 along unit rays (inf: none); ids (H, W) int32 index of
    the mesh hit, -1 none; normals (H, W, 3) world, towards the eye; color (H, W, 3) uint8.
    """

    distance: NDArray[np.float32]
    ids: NDArray[np.int32]
    normals: NDArray[np.float32]
    color: NDArray[np.uint8]


class Raycaster:
    """A fixed set of meshes, ready to be looked at from anywhere.

    meshes are given in world coordinates; a mesh without colours is grey.
    """

    def __init__(self, meshes: list[Mesh] | tuple[Mesh, ...]) -> None:
        import open3d as o3d  # slow to import; only who renders pays for it

        self._o3d = o3d
        self._meshes = list(meshes)
        self._scene = o3d.t.geometry.RaycastingScene()
        for mesh in self._meshes:
            self._scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def cast(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> Cast:
        """Cast rays: origins and unit directions, each (H, W, 3) in world coordinates."""
        rays = _rays(origins, directions)
        hits = self._scene.cast_rays(self._o3d.core.Tensor(rays))
        distance = hits["t_hit"].numpy()
        ids = hits["geometry_ids"].numpy().astype(np.int64)
        hit = np.isfinite(distance)
        ids = np.where(hit, ids, -1).astype(np.int32)
        normals = hits["primitive_normals"].numpy()
        facing = np.einsum("...i,...i->...", normals, rays[..., 3:]) > 0
        normals[facing] *= -1
        color = np.zeros((*distance.shape, 3), dtype=np.uint8)
        primitives = hits["primitive_ids"].numpy()
        uv = hits["primitive_uvs"].numpy()
        for index, mesh in enumerate(self._meshes):
            where = ids == index
            if not where.any():
                continue
            if mesh.colors is None:
                color[where] = GREY
                continue
            corners = mesh.colors[mesh.faces[primitives[where]]].astype(np.float32)
            b, c = uv[where][:, 0:1], uv[where][:, 1:2]
            color[where] = (corners[:, 0] * (1 - b - c) + corners[:, 1] * b + corners[:, 2] * c).round().astype(np.uint8)
        return Cast(distance, ids, normals, color)

    def hits(self, origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which rays, origins and directions each (..., 3) in world coordinates, meet any mesh: (...); quicker than :meth:`cast`."""
        return self._scene.test_occlusions(self._o3d.core.Tensor(_rays(origins, directions))).numpy().astype(bool)

    def crossings(self, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances (N,) at which one ray, (3,) and (3,), passes through the meshes' surfaces, ascending; where triangles meet, once."""
        found = self._scene.list_intersections(self._o3d.core.Tensor(_rays(origin[None], direction[None])))["t_hit"].numpy()
        found = np.sort(found.astype(np.float64))
        return found[np.concatenate([[True], np.diff(found) > 1e-6])] if len(found) else found

    def nearest(self, points: ArrayLike) -> NDArray[np.float64]:
        """The points (..., 3) of the meshes' surfaces that are nearest to points (..., 3)."""
        points = np.asarray(points, dtype=np.float32)
        query = self._o3d.core.Tensor(points.reshape(-1, 3))
        return self._scene.compute_closest_points(query)["points"].numpy().astype(np.float64).reshape(points.shape)

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """How far points (N, 3) are from the meshes' surfaces, (N,), metres."""
        return np.asarray(self._scene.compute_distance(self._o3d.core.Tensor(points.astype(np.float32))).numpy())

    def occluded(self, origins: NDArray[np.float64], direction: ArrayLike) -> NDArray[np.bool_]:
        """Whether anything lies on the way from points (N, 3) in one unit direction (3,): shadows."""
        rays = np.empty((len(origins), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origins, np.asarray(direction, dtype=float)
        return self._scene.test_occlusions(self._o3d.core.Tensor(rays)).numpy().astype(bool)

    def perspective(self, intrinsics: Intrinsics, world_from_camera: NDArray[np.float64]) -> tuple[Cast, NDArray[np.float32]]:
        """Look through a pinhole camera; also returns the depth image (H, W), metres along z, NaN where nothing is."""
        rays = intrinsics.unproject(np.ones((intrinsics.height, intrinsics.width)))
        length = np.linalg.norm(rays, axis=-1)
        directions = (rays / length[..., None]) @ world_from_camera[:3, :3].T
        cast = self.cast(world_from_camera[:3, 3], directions)
        depth = np.where(np.isfinite(cast.distance), cast.distance / length, np.nan).astype(np.float32)
        return cast, depth

    def orthographic(
        self, world_from_view: NDArray[np.float64], size: tuple[int, int], metres_per_pixel: float, reach: float
    ) -> tuple[Cast, NDArray[np.float32]]:
        """Look along z of a view frame with parallel rays from ``reach`` metres before its plane.

        size is (H, W); also returns depth (H, W) from the view plane, negative before it, NaN off the meshes.
        """
        height, width = size
        u = (np.arange(width) - (width - 1) / 2) * metres_per_pixel
        v = (np.arange(height) - (height - 1) / 2) * metres_per_pixel
        x, y, z = world_from_view[:3, :3].T
        start = world_from_view[:3, 3] - reach * z
        cast = self.cast((u[:, None] * x)[None] + (v[:, None] * y + start)[:, None], z)
        depth = np.where(np.isfinite(cast.distance), cast.distance - reach, np.nan).astype(np.float32)
        return cast, depth


def _rays(origins: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float32]:
    """(..., 6): origins and directions side by side, as Open3D takes them."""
    rays = np.empty((*np.broadcast_shapes(np.shape(origins), np.shape(directions))[:-1], 6), dtype=np.float32)
    rays[..., :3], rays[..., 3:] = origins, directions
    return rays


def shade(
    cast: Cast, light: ArrayLike = (0.3, 0.2, 1.0), ambient: float = 0.45, background: tuple[int, int, int] = (0, 0, 0)
) -> NDArray[np.uint8]:
    """Colours under one distant light (a direction towards it, world frame): (H, W, 3) uint8."""
    lambert = np.clip(cast.normals @ transforms.unit(light), 0, 1)
    image = cast.color * (ambient + (1 - ambient) * lambert)[..., None]
    image[cast.ids < 0] = background
    return np.clip(image, 0, 255).astype(np.uint8)


def frame_of_view(
    mesh: Mesh, direction: ArrayLike, up: ArrayLike, size: int, fill: float
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Where a square picture of a mesh looks from: object_from_view (4, 4), metres per pixel, and the mesh's extents (3,) in the view, m.

    The view's z is ``direction``, its y as much down (against ``up``) as that allows; its origin is the middle of the mesh's box there.
    The silhouette's larger side fills ``fill`` of the ``size`` pixels.
    """
    z = transforms.unit(direction)
    up = np.asarray(up, dtype=float)
    y = transforms.unit(-(up - (up @ z) * z))
    rotation = np.column_stack([np.cross(y, z), y, z])
    local = mesh.vertices @ rotation
    low, high = local.min(axis=0), local.max(axis=0)
    extents = high - low
    return transforms.make(rotation, rotation @ ((low + high) / 2)), max(float(extents[:2].max()), 1e-6) / (fill * size), extents


def canonical_view(
    mesh: Mesh,
    direction: ArrayLike,
    up: ArrayLike,
    kind: str,
    size: int = VIEW_SIZE,
    fill: float = VIEW_FILL,
    confidence: float = 1.0,
) -> CanonicalView:
    """Draw a mesh (object frame) as seen along ``direction`` with ``up`` at the top of the picture.

    The picture is square; the silhouette's larger side fills ``fill`` of it.
    """
    object_from_view, metres_per_pixel, extents = frame_of_view(mesh, direction, up, size, fill)
    x, y, z = object_from_view[:3, :3].T
    reach = float(extents[2]) / 2 + 0.01
    # The object is centred: rays are needed only in the rectangle that it fills, two pixels of margin around it.
    pad = np.maximum((size - 2 * np.ceil(extents[:2] / metres_per_pixel / 2).astype(int) - 4) // 2, 0)
    cast, depth = Raycaster([mesh]).orthographic(object_from_view, (size - 2 * pad[1], size - 2 * pad[0]), metres_per_pixel, reach)
    image = shade(cast, light=-z + 0.4 * x - 0.3 * y)
    border = ((pad[1], pad[1]), (pad[0], pad[0]))
    return CanonicalView(
        np.pad(image, (*border, (0, 0))), np.pad(cast.ids >= 0, border), metres_per_pixel, object_from_view, kind, np.pad(depth, border, constant_values=np.nan), confidence
    )  # fmt: skip
