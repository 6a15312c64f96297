"""The laboratory's cameras: the sensor model of :mod:`magic_core.sensor` on things and an arm that move.  No ROS here.

:func:`magic_core.sensor.capture` casts every ray at one set of meshes, which a moving arm would have built anew for each picture.
Here each body has rays cast at it in its own frame, in the window on which it can fall, and what was cast is kept until the body moves:
of a scene at rest only the sensor's noise is new.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from magic_core import sensor, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.mesh import Mesh, box_corners
from magic_core.rendering import Raycaster, shade

Array = NDArray[np.float64]

#: A body that has moved by less than this (m, and rad) since it was cast is where it was.
SAME = 1e-4
#: So many draws of the sensor's noise are kept for each camera; a frame has one of them, moved over the picture by chance.
DRAWS = 4
#: What is nearer than this to the lens, m, may fall on any pixel.
NEAR = 0.05


@dataclass(frozen=True)
class _Layer:
    """A body in a camera's picture: its pose then, the window, and in it depth (metres, inf: not hit), cosine and lit colour."""

    pose: Array
    window: tuple[slice, slice]
    depth: NDArray[np.float32]
    cosine: NDArray[np.float32]
    image: NDArray[np.float32]


class Bodies:
    """Coloured meshes by name, each in its own frame, ready to be looked at; several cameras may share them.  beside: others that are
    there as well."""

    def __init__(self, meshes: Mapping[str, Mesh], beside: Bodies | None = None) -> None:
        self.casters = {name: Raycaster([mesh]) for name, mesh in meshes.items()}
        self.corners = {name: box_corners(*mesh.bounds) for name, mesh in meshes.items()}
        if beside is not None:
            self.casters |= beside.casters
            self.corners |= beside.corners


class Camera:
    """One D435 at a pose: world_from_camera (4, 4) of its colour optical frame."""

    def __init__(self, name: str, world_from_camera: Array, bodies: Bodies, intrinsics: Intrinsics = sensor.D435) -> None:
        self.name, self.intrinsics, self.world_from_camera = name, intrinsics, np.asarray(world_from_camera, dtype=float)
        self._bodies = bodies
        along = intrinsics.unproject(np.ones((intrinsics.height, intrinsics.width)))
        self._length = np.linalg.norm(along, axis=-1).astype(np.float32)
        self._rays = along / self._length[..., None]  # camera frame
        self._layers: dict[str, _Layer] = {}
        self._table = self._cast_table()
        self._noise = _draws(name, (intrinsics.height, intrinsics.width))
        self._all: tuple[NDArray[np.float32], sensor.Sight] | None = None

    def _cast_table(self) -> _Layer:
        caster = Raycaster([sensor.table_mesh()])
        rays = self._rays @ self.world_from_camera[:3, :3].T
        cast = caster.cast(self.world_from_camera[:3, 3], rays)
        hit = np.isfinite(cast.distance)
        points = rays * np.where(hit, cast.distance, 0.0)[..., None] + self.world_from_camera[:3, 3]
        image = shade(cast, sensor.LIGHT, sensor.AMBIENT, sensor.BACKGROUND).astype(np.float32)
        image *= np.where(hit, sensor.wood(points), 1.0).astype(np.float32)[..., None]
        cosine = np.abs(np.einsum("hwi,hwi->hw", rays, cast.normals)).astype(np.float32)
        everything = (slice(0, self.intrinsics.height), slice(0, self.intrinsics.width))
        return _Layer(np.eye(4), everything, (cast.distance / self._length).astype(np.float32), cosine, image)

    def picture(self, poses: Mapping[str, Array], seed: int | list[int], stamp: float = 0.0) -> RgbdFrame:
        """What the sensor gives for these bodies, world_from_body (4, 4) each; a body that is not named is not there."""
        changed = [name for name, pose in poses.items() if not self._same(name, pose)]
        gone = [name for name in self._layers if name not in poses]
        for name in gone:
            del self._layers[name]
        for name in changed:
            self._layers[name] = self._cast(name, np.array(poses[name], dtype=float))
        if self._all is None or changed or gone:
            depth, cosine, image = self._compose()
            self._all = sensor.sharp(image), sensor.Sight.of(depth, cosine, self.intrinsics, sensor.DepthModel())
        image, sight = self._all
        chance = np.random.default_rng(seed)
        noise = self._noise[chance.integers(DRAWS)].rolled(*chance.integers(0, image.shape[:2]))
        color, measured = sensor.colored(image, noise), sight.measured(noise)
        return RgbdFrame(color, measured, self.intrinsics, self.world_from_camera, self.name, stamp)

    def _same(self, name: str, pose: Array) -> bool:
        layer = self._layers.get(name)
        return layer is not None and bool(np.abs(layer.pose - pose).max() < SAME)

    def _cast(self, name: str, pose: Array) -> _Layer:
        window = self._window(transforms.apply(transforms.inverse(self.world_from_camera) @ pose, self._bodies.corners[name]))
        body_from_camera = transforms.inverse(pose) @ self.world_from_camera
        rays = self._rays[window] @ body_from_camera[:3, :3].T
        if rays.size == 0:
            nothing = np.zeros(rays.shape[:2], np.float32)
            return _Layer(pose, window, nothing, nothing, np.zeros((*nothing.shape, 3), np.float32))
        cast = self._bodies.casters[name].cast(body_from_camera[:3, 3], rays)
        # The light, too, as the body sees it.
        light = pose[:3, :3].T @ np.asarray(sensor.LIGHT)
        image = shade(cast, light, sensor.AMBIENT, sensor.BACKGROUND).astype(np.float32)
        cosine = np.abs(np.einsum("hwi,hwi->hw", rays, cast.normals)).astype(np.float32)
        return _Layer(pose, window, (cast.distance / self._length[window]).astype(np.float32), cosine, image)

    def _window(self, corners: Array) -> tuple[slice, slice]:
        """The pixels on which something with these corners (8, 3), camera frame, can fall."""
        width, height = self.intrinsics.width, self.intrinsics.height
        if corners[:, 2].max() <= NEAR:
            return slice(0, 0), slice(0, 0)
        if corners[:, 2].min() <= NEAR:
            return slice(0, height), slice(0, width)
        low, high = (edge(self.intrinsics.project(corners), axis=0) for edge in (np.min, np.max))
        u0, v0 = (int(np.clip(np.floor(x), 0, most)) for x, most in zip(low, (width, height), strict=True))
        u1, v1 = (int(np.clip(np.ceil(x) + 1, 0, most)) for x, most in zip(high, (width, height), strict=True))
        return slice(v0, max(v0, v1)), slice(u0, max(u0, u1))

    def _compose(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Depth (NaN: nothing), cosine and image of the nearest of all layers."""
        table = self._table
        depth, cosine, image = table.depth.copy(), table.cosine.copy(), table.image.copy()
        for layer in self._layers.values():
            before = layer.depth < depth[layer.window]
            depth[layer.window][before] = layer.depth[before]
            cosine[layer.window][before] = layer.cosine[before]
            image[layer.window][before] = layer.image[before]
        return np.where(np.isfinite(depth), depth, np.float32(np.nan)), cosine, image


@lru_cache(maxsize=8)
def _draws(name: str, shape: tuple[int, int]) -> list[sensor.Noise]:
    """A camera's draws of noise, the same after each reset."""
    return [sensor.Noise.draw(shape, [zlib.crc32(name.encode()), k]).light() for k in range(DRAWS)]
