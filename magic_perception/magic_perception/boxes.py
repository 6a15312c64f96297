"""Upright boxes, where two faces at least are seen: cartons, bricks, blocks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.mesh import Mesh
from magic_perception.sight import Sight
from magic_perception.solids import Reconstruction, hull_of

#: Least size, m, and least share of the points on each of two faces.
LEAST, FACE = 0.02, 0.08
#: The 90th percentile of the points' distances to the surface, m, and the median distance of the masks' edges to its outline, pixels, may be so large.
RESIDUAL, EDGE = 0.004, 2.0
#: A share of the points larger than this that lies farther than AWAY, m, from the surface is a part of its own (a handle), and no noise.
PART, AWAY = 0.02, 0.010
#: Errors beyond this are outliers, m.
ROBUST = 0.003


@dataclass(frozen=True)
class Box:
    """An upright box on the table z = 0: middle (2,), sizes (3,) along its own x and y and up, m; ``yaw`` of its x, radians."""

    middle: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: float

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the box's axes, from the middle of its bottom."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        away = points[:, :2] - self.middle
        return np.column_stack([away @ [c, s], away @ [-s, c], points[:, 2]])

    def beyond(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3): how far points (N, 3) lie out of the faces along x, y and up; negative within."""
        local = self.local(points)
        return np.column_stack([np.abs(local[:, :2]) - self.size[:2] / 2, local[:, 2] - self.size[2]])

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,): signed distance of points (N, 3) to the sides and the top, positive outside."""
        out = self.beyond(points)
        return np.linalg.norm(np.maximum(out, 0), axis=1) + np.minimum(out.max(axis=1), 0)

    def corners(self) -> NDArray[np.float64]:
        """(8, 3)."""
        x, y, z = (a.ravel() for a in np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [0.0, 1.0], indexing="ij"))
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = x * self.size[0], y * self.size[1]
        return np.column_stack([self.middle[0] + c * x - s * y, self.middle[1] + s * x + c * y, z * self.size[2]])


def recognise_box(points: NDArray[np.float64], sights: list[Sight], height: float, noise: float) -> Reconstruction | None:
    """The box on whose faces the points (N, 3) lie and whose outline the masks have; ``None`` where they tell of something else, or of one face only.

    height: of the points above the table; noise: standard deviation of the heights; metres.
    """
    sample = points[:: max(1, len(points) // 800)]
    if not LEAST < height < 0.4 or len(sample) < 80:
        return None
    start = _start(sample, height)
    edges = [_edges(sight) for sight in sights]
    # Far from any box: what follows would take its time in vain.
    rough = start is None or float(np.percentile(np.abs(start.distance(sample)), 80)) > 3 * RESIDUAL
    box = None if rough else _fitted(start, sample[::2], sights, edges)
    if box is None or box.size.min() < LEAST or box.size.max() > 0.5:
        return None
    limit = max(RESIDUAL, 2.5 * noise)
    distance = np.abs(box.distance(sample))
    if float(np.percentile(distance, 90)) > limit or float(np.mean(distance > AWAY)) > PART or _faces(box, sample, limit) < 2:
        return None
    for sight, pixels in zip(sights, edges, strict=True):
        if len(pixels) > 20 and float(np.median(np.abs(_outline(box, sight, pixels)))) > EDGE:
            return None
    solid = hull_of(box.corners())
    return None if solid is None else Reconstruction(Mesh(solid.vertices, solid.faces), (solid,), "box")


def _start(points: NDArray[np.float64], height: float) -> Box | None:
    """A box by the direction in which the sides' points lie nearest to two lines at right angles (after Zhang et al. 2017)."""
    side = points[(points[:, 2] < 0.9 * height - 0.003) & (points[:, 2] > 0.1 * height), :2]
    flat = side if len(side) > 60 else points[:, :2]
    flat = flat[:: max(1, len(flat) // 300)]
    if not len(flat):
        return None
    yaws = np.radians(np.arange(0, 90, 1.5))
    c, s = np.cos(yaws), np.sin(yaws)
    along = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])]) @ flat.T  # (2, yaws, points)
    low, high = np.percentile(along, [2, 98], axis=2, keepdims=True)
    gaps = np.minimum(np.abs(along - low), np.abs(high - along))
    yaw = float(yaws[int(np.argmin(np.minimum(gaps.min(axis=0), 0.01).mean(axis=1)))])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    low, high = np.percentile(points[:, :2] @ turn.T, [1, 99], axis=0)
    return Box(turn.T @ ((low + high) / 2), np.array([*(high - low), height]), yaw)


def _edges(sight: Sight, most: int = 150) -> NDArray[np.float64]:
    """Pixels (N, 2), column and row, of the mask's outline that nothing else hides and the picture does not cut."""
    mask = sight.mask.view(np.uint8)
    line = (mask > 0) & (cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    line &= cv2.dilate(sight.hidden.view(np.uint8), np.ones((7, 7), np.uint8)) == 0
    line[:3] = line[-3:] = False
    line[:, :3] = line[:, -3:] = False
    rows, columns = np.nonzero(line)
    step = max(1, len(rows) // most)
    return np.column_stack([columns[::step], rows[::step]]).astype(float)


def _outline(box: Box, sight: Sight, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distances (N,) of pixels (N, 2) to the outline of the box in a picture, positive outside."""
    hull = cv2.convexHull(sight.pixels(box.corners()).astype(np.float32))[:, 0].astype(float)
    edge = np.roll(hull, -1, axis=0) - hull
    length = np.linalg.norm(edge, axis=1)
    hull, edge, length = hull[length > 1e-6], edge[length > 1e-6], length[length > 1e-6]
    normal = np.column_stack([edge[:, 1], -edge[:, 0]]) / length[:, None]
    if np.mean(np.sum((hull.mean(axis=0) - hull) * normal, axis=1)) > 0:
        normal = -normal
    return (pixels @ normal.T - np.sum(hull * normal, axis=1)).max(axis=1)


def _fitted(start: Box, points: NDArray[np.float64], sights: list[Sight], edges: list[NDArray[np.float64]]) -> Box | None:
    """The box that points and outlines agree with best (least squares, robust to outliers)."""
    from scipy.optimize import least_squares

    scale = [float(np.nanmedian(sight.depth[sight.mask])) / sight.intrinsics.fx for sight in sights]
    if not np.all(np.isfinite(scale)):
        return None

    def made(x: NDArray[np.float64]) -> Box:
        return Box(x[:2], np.maximum(x[2:5], 1e-3), float(x[5]))

    def errors(x: NDArray[np.float64]) -> NDArray[np.float64]:
        box = made(x)
        parts = [box.distance(points) / np.sqrt(len(points))]
        for sight, pixels, size in zip(sights, edges, scale, strict=True):
            if len(pixels):
                parts.append(size * _outline(box, sight, pixels) / np.sqrt(len(pixels)))
        return 30 * np.concatenate(parts)

    first = np.array([*start.middle, *start.size, start.yaw])
    found = least_squares(
        errors, first, loss="soft_l1", f_scale=30 * ROBUST / np.sqrt(len(points)), x_scale=[0.1] * 5 + [1.0], ftol=1e-4, max_nfev=12
    )
    return made(found.x)


def _faces(box: Box, points: NDArray[np.float64], limit: float) -> int:
    """How many faces hold their share of the points, those near an edge left out."""
    out = box.beyond(points)
    local = box.local(points)
    count = 0
    for axis in range(3):
        others = np.delete(out, axis, axis=1).max(axis=1)
        on = (np.abs(out[:, axis]) < limit) & (others < -limit)
        for side in (on & (local[:, axis] > 0), on & (local[:, axis] < 0)):
            count += int(np.mean(side) >= FACE)
    return count
