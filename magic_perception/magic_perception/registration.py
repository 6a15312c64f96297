"""Depth that was measured in another frame than the colour: brought into the colour image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError


def register_depth(
    depth: NDArray[np.float32], depth_camera: Intrinsics, color_camera: Intrinsics, color_from_depth: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Depth (H, W) metres of the depth camera as the colour camera sees it, (Hc, Wc) float32 metres, NaN where nothing falls.

    color_from_depth (4, 4): the depth optical frame in the colour optical frame.  Every depth pixel is carried over as
    the rectangle between its two opposite corners, as librealsense does, so that a finer colour image has no gaps;
    where two fall on one pixel the nearer wins.
    """
    if depth.shape != (depth_camera.height, depth_camera.width):
        raise MagicError(
            Code.BAD_IMAGE, "depth image", depth.shape, f"{(depth_camera.height, depth_camera.width)}, the size in its camera_info"
        )
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[v, u].astype(float)
    corners = []
    for shift in (-0.5, 0.5):
        rays = np.column_stack(
            [(u + shift - depth_camera.cx) / depth_camera.fx, (v + shift - depth_camera.cy) / depth_camera.fy, np.ones(len(z))]
        )
        moved = (rays * z[:, None]) @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
        corners.append((color_camera.project(moved), moved[:, 2]))
    (first, z0), (second, z1) = corners
    low = np.minimum(first, second)
    high = np.maximum(first, second)
    z = (z0 + z1) / 2
    good = np.all(np.isfinite(low) & np.isfinite(high), axis=1) & (z > 0)
    good &= np.all(high > -1, axis=1) & (low[:, 0] < color_camera.width) & (low[:, 1] < color_camera.height)
    # Pixel centres are integers: the rectangle covers those between its corners, at least the nearest one.
    start = np.ceil(low[good] - 1e-6).astype(int)
    stop = np.maximum(np.ceil(high[good] - 1e-6).astype(int), start + 1)
    stop = np.minimum(stop, start + 6)
    z = z[good]
    nearest = np.full(color_camera.height * color_camera.width, np.inf, np.float32)
    for dy in range(int((stop - start)[:, 1].max(initial=1))):
        for dx in range(int((stop - start)[:, 0].max(initial=1))):
            x, y = start[:, 0] + dx, start[:, 1] + dy
            fits = (x < stop[:, 0]) & (y < stop[:, 1]) & (x >= 0) & (y >= 0) & (x < color_camera.width) & (y < color_camera.height)
            np.minimum.at(nearest, y[fits] * color_camera.width + x[fits], z[fits].astype(np.float32))
    nearest[~np.isfinite(nearest)] = np.nan
    return nearest.reshape(color_camera.height, color_camera.width)
