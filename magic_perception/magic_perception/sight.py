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
from magic_perception.pixels import where, window
from magic_perception.smear import LOW, REACH

#: A mesh is compared with a picture at every so many pixels.
EVERY = 3
#: Differences of depth up to this (m) are noise.
DEPTH_NOISE = 0.010


@dataclass(frozen=True)
class Sight:
    """One camera's view of one thing.

    mask (H, W) bool: the thing; hidden (H, W) bool: something else in front may hide it, so that a miss there says nothing.
    color (H, W, 3) uint8 RGB; depth (H, W) float32 metres, NaN none; heights (H, W) float32 above the table; sigma: noise of the heights at
    the thing.
    """

    intrinsics: Intrinsics
    table_from_camera: NDArray[np.float64]
    mask: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    heights: NDArray[np.float32]
    sigma: float

    @cached_property
    def _soft(self) -> NDArray[np.float32]:
        return self.mask.astype(np.float32)

    @cached_property
    def _blind(self) -> NDArray[np.uint8]:
        return self.hidden.view(np.uint8)

    @cached_property
    def _filled(self) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32], int, int]:
        """Around the mask: where the surface is known, its heights, filled and smoothed, the distance in pixels to where they
        were measured, and the first row and column."""
        x, y, w, h = cv2.boundingRect(self.mask.view(np.uint8))
        pad = 3
        r0, r1, c0, c1 = max(y - pad, 0), y + h + pad, max(x - pad, 0), x + w + pad
        mask, heights = self.mask[r0:r1, c0:c1], self.heights[r0:r1, c0:c1]
        known = mask & np.isfinite(heights)
        if not w or np.count_nonzero(known) < 5:
            return np.zeros((0, 0), bool), np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32), 0, 0
        distance, index = cv2.distanceTransformWithLabels((~known).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        value = np.zeros(int(np.count_nonzero(known)) + 1, np.float32)
        value[index[known]] = heights[known]
        return mask & (distance < 12), cv2.medianBlur(np.take(value, index), 5), distance, r0, c0

    @cached_property
    def _camera_from_table(self) -> NDArray[np.float64]:
        return transforms.inverse(self.table_from_camera)

    @property
    def eye(self) -> NDArray[np.float64]:
        """(3,): where the camera is."""
        return self.table_from_camera[:3, 3]

    def sample(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """At points (..., 3): the mask (0..1, interpolated; 1 where blind), where the picture tells nothing (hidden or
        outside of it), the points' depth and the measured depth."""
        u, v, z, count = self._pixels(points)
        shape = points.shape[:-1]

        def at(field: NDArray, how: int, beyond: float) -> NDArray:
            return cv2.remap(field, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond).ravel()[:count].reshape(shape)

        blind = at(self._blind, cv2.INTER_NEAREST, 1.0) > 0
        inside = at(self._soft, cv2.INTER_LINEAR, 1.0)
        inside[blind] = 1
        return inside, blind, z.reshape(shape), at(self.depth, cv2.INTER_NEAREST, float("nan"))

    def look_up(self, points: NDArray[np.float64], picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """A picture (H, W) at the nearest pixels of points (..., 3); NaN outside of it."""
        u, v, _, count = self._pixels(points)
        found = cv2.remap(picture, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
        return found.ravel()[:count].reshape(points.shape[:-1])

    @cached_property
    def reached(self) -> NDArray[np.float32]:
        """A picture (H, W) of the height down to which each pixel's ray surely goes on, m: to the table beside the mask, in it to the
        greatest height measured around; nowhere, infinite, where something else may hide the thing or depth is missing.

        What is raised beside the mask farther than smear reaches is taken for a part of the thing that colour has lost.
        """
        result = np.where(self.hidden, np.float32(np.inf), np.float32(-np.inf))
        x, y, w, h = cv2.boundingRect(self.mask.view(np.uint8))
        reach = round(REACH * self.intrinsics.fx / 615)
        pad = 6 * reach
        cut = (slice(max(y - pad, 0), y + h + pad), slice(max(x - pad, 0), x + w + pad))
        mask, heights = self.mask[cut], self.heights[cut]
        with np.errstate(invalid="ignore"):
            raised = ~mask & (heights > LOW)
        far = raised & (cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 3) > reach)
        thing = mask | (raised & (cv2.dilate(far.view(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0))
        known = np.where(thing & np.isfinite(heights), heights, np.float32(np.inf))
        result[cut][thing] = cv2.dilate(known, np.ones((3, 3), np.uint8))[thing]
        return result

    @cached_property
    def measured(self) -> NDArray[np.float64]:
        """Points (N, 3) of the thing where depth was measured, a pixel within the mask's edge, above the table."""
        cut = window(self.mask, 1)
        inner = cv2.erode(self.mask[cut].view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
        rows, columns = where(inner & np.isfinite(self.depth[cut]))
        rows, columns = rows + cut[0].start, columns + cut[1].start
        z, k = self.depth[rows, columns].astype(float), self.intrinsics
        local = np.column_stack([(columns - k.cx) / k.fx * z, (rows - k.cy) / k.fy * z, z])
        points = transforms.apply(self.table_from_camera, local)
        return points[points[:, 2] > 0]

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Column and row (..., 2) at which points (..., 3) are seen, also outside of the picture; -1e4 behind the camera."""
        u, v, _, count = self._pixels(points)
        return np.stack([u.ravel()[:count], v.ravel()[:count]], axis=-1).reshape(*points.shape[:-1], 2)

    def _pixels(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], int]:
        """u and v of points (..., 3) in the shape that OpenCV's remap takes (less than 32768 rows and columns), depths (N,) and N."""
        pose, k = self._camera_from_table, self.intrinsics
        camera = points.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
        before = camera[:, 2] > 1e-9
        z = np.where(before, camera[:, 2], 1.0)
        u, v = ((f * camera[:, i] / z + c).astype(np.float32) for i, f, c in ((0, k.fx, k.cx), (1, k.fy, k.cy)))
        u[~before] = v[~before] = -1e4
        count = len(u)
        rows = -(-count // 8192)
        u, v = (np.resize(x, (rows, 8192)) if rows > 1 else x.reshape(1, -1) for x in (u, v))
        return u, v, camera[:, 2].astype(np.float32), count


def surface(sight: Sight, upsample: int = 1) -> NDArray[np.float64]:
    """The thing's visible surface as points (N, 3), also where depth is missing in the mask, ``upsample`` times as dense as the pixels.

    Heights are filled from the nearest pixel and smoothed in the mask; each point is where its pixel's ray reaches its height.
    """
    mask, filled, _, r0, c0 = sight._filled
    if upsample > 1 and mask.size:
        size = (mask.shape[1] * upsample, mask.shape[0] * upsample)
        mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
        filled = cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)
    v, u = where(mask)
    h = filled[v, u]
    u = (u + 0.5) / upsample - 0.5 + c0
    v = (v + 0.5) / upsample - 0.5 + r0
    k = sight.intrinsics
    rays = np.column_stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(len(u))]) @ sight.table_from_camera[:3, :3].T
    down = np.minimum(rays[:, 2], -1e-3)
    rays *= ((h - sight.eye[2]) / down)[:, None]
    # A grazing ray turns a small error of height into a large one in the plane.
    near = np.einsum("ij,ij->i", rays, rays) < 4.0**2
    return (rays if near.all() else rays[near]) + sight.eye


def surfaces(sights: list[Sight], upsample: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The surface points (N, 3) of all cameras, none below the table, and for each the camera (N, 3) that saw it."""
    clouds = [surface(sight, upsample) for sight in sights]
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    eyes = np.repeat([sight.eye for sight in sights], [len(c) for c in clouds], axis=0)
    keep = points[:, 2] > -0.01
    points, eyes = points[keep], eyes[keep]
    np.maximum(points[:, 2], 0, out=points[:, 2])
    return points, eyes


def carve(
    sights: list[Sight], columns: list[NDArray[np.float64]], see_through: float | None = None, weights: list[float] | None = None
) -> NDArray[np.float32]:
    """Occupancy (rows, columns) 0..1 of cells, given the points (rows, columns, 3) of each cell's column: mean over cameras of the least
    mask.

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
                    # Before what is not in the mask a nearer depth is smeared.
                    behind = (measured < z - see_through) & (inside > 0.5)
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


@dataclass(frozen=True)
class Agreement:
    """How a proposed solid agrees with what the cameras saw.

    overlap: mean over the cameras of the overlap (intersection over union) of silhouette and mask.  through: the largest share, over
    the cameras, of the rays that meet the solid, away from its outline, but were seen to go on: past the mask, or into the solid
    by more than the noise and more than a quarter of its thickness there.  Free space forbids the solid there.
    """

    overlap: float
    through: float

    @property
    def score(self) -> float:
        """Both in one number, 0..1."""
        return self.overlap * (1 - self.through)


def agreement(mesh: Mesh, sights: list[Sight]) -> Agreement:
    """Compare a mesh with the masks and depths of all cameras, at every :data:`EVERY`-th pixel; :data:`DEPTH_NOISE` metres of depth are
    noise."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    overlaps, passed = [], [0.0]
    for sight in sights:
        x, y, w, h = cv2.boundingRect(sight.mask.view(np.uint8))
        pad = 24
        v = np.arange(max(y - pad, 0), min(y + h + pad, sight.mask.shape[0]), EVERY)
        u = np.arange(max(x - pad, 0), min(x + w + pad, sight.mask.shape[1]), EVERY)
        k = sight.intrinsics
        rays = np.empty((len(v), len(u), 6), np.float32)
        rays[..., :3] = sight.eye
        # Rays of depth 1, so that their length to the hit is the depth.
        rays[..., 3:] = (
            np.stack(np.broadcast_arrays(((u - k.cx) / k.fx)[None], ((v - k.cy) / k.fy)[:, None], 1.0), axis=-1)
            @ sight.table_from_camera[:3, :3].T
        )
        depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        drawn = np.isfinite(depth)
        where = np.ix_(v, u)
        mask, told, seen = sight.mask[where], ~sight.hidden[where], sight.depth[where]
        with np.errstate(invalid="ignore"):
            told &= mask | ~(seen < depth - 0.02)  # something in front of it
        overlaps.append(np.count_nonzero(drawn & mask & told) / max(np.count_nonzero((drawn | mask) & told), 1))
        inner = cv2.erode(drawn.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool) & told
        with np.errstate(invalid="ignore"):
            into = inner & mask & (seen > depth + max(DEPTH_NOISE, 3 * sight.sigma))
        if into.any():
            far, back = np.float32(5.0), rays[into]
            back[:, :3] += far * back[:, 3:]
            back[:, 3:] *= -1
            thickness = far - scene.cast_rays(o3d.core.Tensor(back))["t_hit"].numpy() - depth[into]
            into[into] = seen[into] > depth[into] + 0.25 * thickness
        passed.append(np.count_nonzero(into | (inner & ~mask)) / max(np.count_nonzero(inner), 1))
    return Agreement(float(np.mean(overlaps)), float(max(passed)))
