"""What one camera saw of one thing: samples, surface points, carving, silhouettes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster


@dataclass(frozen=True)
class Sight:
    """One camera's view of one thing.

    mask (H, W) bool: the thing; hidden (H, W) bool: something else in front may hide it, so that a miss there says nothing.
    depth (H, W) float32 metres, NaN none; heights (H, W) float32 above the table; sigma: noise of the heights at the thing.
    """

    intrinsics: Intrinsics
    table_from_camera: NDArray[np.float64]
    mask: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    depth: NDArray[np.float32]
    heights: NDArray[np.float32]
    sigma: float

    @cached_property
    def _soft(self) -> NDArray[np.float32]:
        return self.mask.astype(np.float32)

    @cached_property
    def _blind(self) -> NDArray[np.uint8]:
        return self.hidden.astype(np.uint8)

    @property
    def eye(self) -> NDArray[np.float64]:
        """(3,): where the camera is."""
        return self.table_from_camera[:3, 3]

    def sample(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """At points (..., 3): the mask (0..1, interpolated; 1 where blind), where the picture tells nothing (hidden or
        outside of it), the points' depth and the measured depth."""
        camera = transforms.apply(transforms.inverse(self.table_from_camera), points)
        pixels = np.nan_to_num(self.intrinsics.project(camera), nan=-1e4)
        u, v = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
        shape = u.shape
        # OpenCV's remap takes pictures of less than 32768 rows and columns.
        rows = -(-u.size // 8192)
        u, v = (np.resize(x, (rows, 8192)) if rows > 1 else x.reshape(1, -1) for x in (u, v))
        count = int(np.prod(shape))

        def at(field: NDArray, how: int, beyond: float) -> NDArray:
            return cv2.remap(field, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond).ravel()[:count].reshape(shape)

        blind = at(self._blind, cv2.INTER_NEAREST, 1.0) > 0
        inside = np.where(blind, np.float32(1), at(self._soft, cv2.INTER_LINEAR, 1.0))
        return inside, blind, camera[..., 2].astype(np.float32), at(self.depth, cv2.INTER_NEAREST, float("nan"))


def surface(sight: Sight, upsample: int = 2) -> NDArray[np.float64]:
    """The thing's visible surface as points (N, 3), also where depth is missing in the mask, twice as dense as the pixels.

    Heights are filled from the nearest pixel and smoothed in the mask; each point is where its pixel's ray reaches its height.
    """
    rows, columns = np.nonzero(sight.mask)
    if len(rows) == 0:
        return np.zeros((0, 3))
    pad = 3
    r0, r1 = max(rows.min() - pad, 0), min(rows.max() + pad + 1, sight.mask.shape[0])
    c0, c1 = max(columns.min() - pad, 0), min(columns.max() + pad + 1, sight.mask.shape[1])
    mask = sight.mask[r0:r1, c0:c1]
    heights = sight.heights[r0:r1, c0:c1]
    known = mask & np.isfinite(heights)
    if known.sum() < 5:
        return np.zeros((0, 3))
    distance, index = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value = np.zeros(int(index.max()) + 1, np.float32)
    value[index[known]] = heights[known]
    filled = cv2.medianBlur(value[index], 5)
    mask = mask & (distance < 12)
    if upsample > 1:
        size = (mask.shape[1] * upsample, mask.shape[0] * upsample)
        mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
        filled = cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)
    v, u = np.nonzero(mask)
    h = filled[v, u]
    u = (u + 0.5) / upsample - 0.5 + c0
    v = (v + 0.5) / upsample - 0.5 + r0
    k = sight.intrinsics
    rays = np.column_stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(len(u))]) @ sight.table_from_camera[:3, :3].T
    down = np.minimum(rays[:, 2], -1e-3)
    points = sight.eye + rays * ((h - sight.eye[2]) / down)[:, None]
    # A grazing ray turns a small error of height into a large one in the plane.
    return points[np.linalg.norm(points - sight.eye, axis=1) < 4.0]


def carve(
    sights: list[Sight], columns: list[NDArray[np.float64]], see_through: float | None = None, weights: list[float] | None = None
) -> NDArray[np.float32]:
    """Occupancy (rows, columns) 0..1 of cells, given the points (rows, columns, 3) of each cell's column: mean over cameras of the least mask.

    With ``see_through`` metres a camera that measured depth farther than that behind a cell saw it empty, and one
    that measured depth nearer than that before it says nothing.
    """
    total = np.zeros(columns[0].shape[:2], np.float32)
    weight = np.zeros_like(total)
    for sight, trust in zip(sights, weights or [1.0] * len(sights), strict=True):
        least = np.ones_like(total)
        blind = np.zeros(total.shape, bool)
        for points in columns:
            inside, unseen, z, measured = sight.sample(points)
            blind |= unseen
            if see_through is not None:
                with np.errstate(invalid="ignore"):
                    inside = np.where(measured > z + see_through, 0, inside)
                    behind = measured < z - see_through
                blind |= behind
                inside = np.where(behind, 1, inside)
            least = np.minimum(least, inside)
        share = np.where(blind & (least > 0.5), 0.05 * trust, trust).astype(np.float32)
        total += share * least
        weight += share
    return total / np.maximum(weight, 1e-6)


def silhouette(sight: Sight, middle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The thing's mask carried on to the upright plane through ``middle`` (2,) that faces the camera.

    Returns the horizontal unit vectors (2,) away from the camera and to its right, and points (N, 2) on the silhouette's
    left and right edges, row by row: distance to the right of ``middle``, height.
    """
    away = middle - sight.eye[:2]
    away = away / max(np.linalg.norm(away), 1e-9)
    right = np.array([away[1], -away[0]])
    rows = np.nonzero(sight.mask.any(axis=1))[0]
    first = sight.mask[rows].argmax(axis=1)
    last = sight.mask.shape[1] - 1 - sight.mask[rows, ::-1].argmax(axis=1)
    k = sight.intrinsics
    edges = []
    for u in (first - 0.5, last + 0.5):
        rays = np.column_stack([(u - k.cx) / k.fx, (rows - k.cy) / k.fy, np.ones(len(rows))]) @ sight.table_from_camera[:3, :3].T
        scale = ((middle - sight.eye[:2]) @ away) / np.maximum(rays[:, :2] @ away, 1e-6)
        points = sight.eye + rays * scale[:, None]
        edges.append(np.column_stack([(points[:, :2] - middle) @ right, points[:, 2]]))
    return away, right, np.concatenate(edges)


def agreement(mesh: Mesh, sights: list[Sight], step: int = 3) -> float:
    """Mean over the cameras of the overlap (intersection over union) of a mesh's silhouette with the mask, every ``step``-th pixel."""
    caster = Raycaster([mesh])
    result = []
    for sight in sights:
        rows, columns = (np.nonzero(sight.mask.any(axis=axis))[0] for axis in (1, 0))
        pad = 24
        v = np.arange(max(rows[0] - pad, 0), min(rows[-1] + pad, sight.mask.shape[0]), step)
        u = np.arange(max(columns[0] - pad, 0), min(columns[-1] + pad, sight.mask.shape[1]), step)
        k = sight.intrinsics
        rays = (
            np.stack(np.broadcast_arrays(((u - k.cx) / k.fx)[None], ((v - k.cy) / k.fy)[:, None], 1.0), axis=-1)
            @ sight.table_from_camera[:3, :3].T
        )
        drawn = caster.hits(sight.eye, rays)
        mask, told = sight.mask[np.ix_(v, u)], ~sight.hidden[np.ix_(v, u)]
        result.append(np.count_nonzero(drawn & mask & told) / max(np.count_nonzero((drawn | mask) & told), 1))
    return float(np.mean(result))
