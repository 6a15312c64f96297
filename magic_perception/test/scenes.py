"""Ray-cast table-tops for the tests: two cameras over procedural objects, with D435-like depth."""

from __future__ import annotations

import cv2
import numpy as np

from magic_core import shapes, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster, shade

INTRINSICS = Intrinsics(640, 480, 615.0, 615.0, 319.5, 239.5)


def pose(eye, at):
    """world_from_camera of a camera at ``eye`` that looks at ``at``, upright."""
    z = transforms.unit(np.subtract(at, eye))
    x = transforms.unit(np.cross(z, [0, 0, 1]))
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), eye)


POSES = {"left": pose([0.25, 0.45, 0.62], [0.55, 0.0, 0.02]), "right": pose([0.25, -0.45, 0.62], [0.55, 0.0, 0.02])}


def table(color=(150, 120, 90)) -> Mesh:
    """A table at z = 0."""
    return Mesh([[-0.4, -1, 0], [1.6, -1, 0], [1.6, 1, 0], [-0.4, 1, 0]], [[0, 1, 2], [0, 2, 3]]).painted(color)


def placed(mesh: Mesh, x: float, y: float, yaw: float = 0.0) -> Mesh:
    """The mesh on the table."""
    return mesh.transformed(transforms.from_rpy(0, 0, yaw, [x, y, -mesh.bounds[0, 2]]))


def shape(family: str, seed: int, x: float, y: float, yaw: float = 0.0) -> Mesh:
    """A procedural object on the table."""
    return placed(shapes.make(family, seed).mesh, x, y, yaw)


def capture(meshes, name="left", seed=0, noise=1.0, world_from_camera=None, stamp=1.0, intrinsics=INTRINSICS):
    """A frame of the meshes on the table, and the index of the mesh at each pixel (-1 table)."""
    rng = np.random.default_rng(seed)
    where = POSES[name] if world_from_camera is None else world_from_camera
    cast, depth = Raycaster([table(), *meshes]).perspective(intrinsics, where)
    size = depth.shape
    image = shade(cast).astype(float) + noise * (rng.normal(0, 3, (*size, 1)) + rng.normal(0, 1.5, (*size, 3)))
    baseline = 0.05 * intrinsics.fx
    grain = cv2.GaussianBlur(rng.normal(0, 1, size), (0, 0), 1.0)
    disparity = baseline / depth + noise * 0.08 * grain / grain.std()
    if noise > 0:
        disparity = np.round(disparity * 32) / 32
    measured = baseline / disparity
    if noise > 0:
        filled = np.nan_to_num(depth, nan=9.0)
        edge = cv2.dilate(filled, np.ones((3, 3))) - cv2.erode(filled, np.ones((3, 3))) > 0.02
        measured[edge & (rng.random(size) < 0.6)] = np.nan
    measured = np.round(measured * 1000) / 1000
    return RgbdFrame(np.clip(image, 0, 255).astype(np.uint8), measured.astype(np.float32), intrinsics, where, name, stamp), cast.ids - 1
