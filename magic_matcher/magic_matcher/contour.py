"""Sub-pixel contours of a mask: where the object ends, in order, with outward normals.

Pixel coordinates are (u right, v down) with (0, 0) the centre of the first pixel.  The
picture is drawn with v down, so "left of the walk" is meant as seen in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from contourpy import contour_generator
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import Code, MagicError

#: Standard deviation in pixels of the blur that turns the mask's staircase into a slope.  A disc of
#: radius R loses sigma^2 / (2 R) of its radius by it: 0.05 px at R = 10.
BLUR = 1.0

#: Loops with a smaller perimeter (px) are specks of the segmentation, not edges.
SMALLEST_LOOP = 12.0

_MARGIN = 6


@dataclass(frozen=True)
class Contour:
    """All loops of one mask's boundary, sampled evenly at about one point a pixel.

    points (N, 2) pixels; normals (N, 2) unit, out of the material; loop (N,) index of
    the loop a point is on; starts (L,) and lengths (L,) give each loop's slice of the
    arrays, in walking order, closed; spacing (L,) pixels between neighbours.  soft
    (H, W) float32 is the blurred mask whose 0.5 level the contour is.  size is the
    diagonal of the points' bounding box, the length that scales are relative to.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    loop: NDArray[np.int64]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    spacing: NDArray[np.float64]
    soft: NDArray[np.float32]
    size: float
    centroid: NDArray[np.float64]

    def nearest(self, pixel: ArrayLike) -> int:
        """Index of the contour point nearest to a pixel (2,)."""
        return int(np.argmin(np.sum((self.points - np.asarray(pixel, dtype=float)) ** 2, axis=1)))

    def window(self, indices: NDArray[np.int64], half: int, stride: int = 1) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Neighbours along the loop, every ``stride``-th: indices (B, 2 half + 1) and which of them are there once.

        Column ``half`` is the point itself; a short loop is covered once, not again and again.
        """
        offsets = np.arange(-half, half + 1) * stride
        loop = self.loop[indices]
        start, length = self.starts[loop][:, None], self.lengths[loop][:, None]
        position = (indices[:, None] - start + offsets) % length
        once = (offsets >= -((length - 1) // 2)) & (offsets <= length // 2)
        return start + position, once

    def sample(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """The blurred mask at points (..., 2), bilinear, 0 outside the picture."""
        flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float32)
        # remap limits the sides of its maps to 32767
        rows = -(-len(flat) // 4096)
        padded = np.zeros((rows * 4096, 2), np.float32)
        padded[: len(flat)] = flat
        grid = padded.reshape(rows, 4096, 2)
        values = cv2.remap(self.soft, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return values.ravel()[: len(flat)].reshape(points.shape[:-1])


def resample(line: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.float64], float] | None:
    """A closed polyline at even steps of about ``spacing`` pixels."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    keep = np.concatenate([[True], steps > 1e-9])
    line = line[keep]
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    total = float(arc[-1])
    if total < SMALLEST_LOOP:
        return None
    count = max(int(round(total / spacing)), 8)
    at = np.arange(count) * (total / count)
    return np.column_stack([np.interp(at, arc, line[:, 0]), np.interp(at, arc, line[:, 1])]), total / count


def extract(mask: NDArray[np.bool_], spacing: float = 1.0, blur: float = BLUR) -> Contour:
    """The sub-pixel contour of a mask (H, W) bool: the 0.5 level of the blurred mask.

    Raises ``EMPTY_MASK`` where the mask holds no edge that could be followed.
    """
    mask = np.asarray(mask)
    if mask.ndim != 2:
        raise MagicError(Code.BAD_REQUEST_IMAGE, "mask", mask.shape, "(H, W)")
    mask = mask.astype(bool)
    if not mask.any():
        raise MagicError(Code.EMPTY_MASK, "pixels of the mask that are on the object", 0, "at least 16")
    padded = np.pad(mask.astype(np.float32), _MARGIN)
    soft = cv2.GaussianBlur(padded, (0, 0), blur) if blur > 0 else padded
    lines = contour_generator(z=soft).lines(0.5)
    points: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    spacings: list[float] = []
    for line in lines:
        resampled = resample(line - _MARGIN, spacing)
        if resampled is None:
            continue
        loop, step = resampled
        # The tangent over a few pixels: single steps still show the raster.
        reach = min(3, (len(loop) - 1) // 2)
        tangent = np.roll(loop, -reach, axis=0) - np.roll(loop, reach, axis=0)
        tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
        normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        probe = np.rint(loop + _MARGIN).astype(int)
        ahead = np.rint(loop + 1.5 * normal + _MARGIN).astype(int)
        limit = np.array(soft.shape)[::-1] - 1
        inside, outside = np.clip(probe, 0, limit), np.clip(ahead, 0, limit)
        if np.sum(soft[outside[:, 1], outside[:, 0]] - soft[inside[:, 1], inside[:, 0]]) > 0:
            loop, normal = loop[::-1], -normal[::-1]
        points.append(loop)
        normals.append(normal)
        spacings.append(step)
    if not points:
        raise MagicError(Code.EMPTY_MASK, "pixels of the mask that are on the object", int(mask.sum()), "a region at least 4 px wide")
    order = sorted(range(len(points)), key=lambda i: -len(points[i]))
    points, normals = [points[i] for i in order], [normals[i] for i in order]
    lengths = np.array([len(p) for p in points])
    everything = np.concatenate(points)
    v, u = np.nonzero(mask)
    return Contour(
        points=everything,
        normals=np.concatenate(normals),
        loop=np.repeat(np.arange(len(points)), lengths),
        starts=np.concatenate([[0], np.cumsum(lengths)[:-1]]),
        lengths=lengths,
        spacing=np.array([spacings[i] for i in order]),
        soft=np.ascontiguousarray(soft[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]),
        size=float(np.hypot(*(everything.max(axis=0) - everything.min(axis=0)))),
        centroid=np.array([u.mean(), v.mean()]),
    )
