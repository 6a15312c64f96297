"""Sub-pixel contours of a mask: where the object ends, in order, with outward normals.

Pixel coordinates are (u right, v down) with (0, 0) the centre of the first pixel.  The
picture is drawn with v down, so "left of the walk" is meant as seen in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
    diagonal of the points' bounding box, the length that scales are relative to; blur, px, is
    that of the mask before its level was taken.
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
    blur: float = BLUR

    @cached_property
    def flat(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """u, v and the normals' u, v (N,) each, single precision, points from the centroid: what many neighbourhoods are cut from."""
        u, v = (np.ascontiguousarray(a, dtype=np.float32) for a in (self.points - self.centroid).T)
        nu, nv = (np.ascontiguousarray(a, dtype=np.float32) for a in self.normals.T)
        return u, v, nu, nv

    def nearest(self, pixel: ArrayLike) -> int:
        """Index of the contour point nearest to a pixel (2,)."""
        offset = self.points - np.asarray(pixel, dtype=float)
        return int(np.argmin(np.einsum("ni,ni->n", offset, offset)))

    def window(self, indices: NDArray[np.int64], offsets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Neighbours along the loop at ``offsets`` (K,), ascending steps of the walk: indices (B, K) and which of them are there once.

        A short loop is covered once, not again and again.
        """
        loop = self.loop[indices]
        start, length = self.starts[loop][:, None], self.lengths[loop][:, None]
        once = (offsets >= -((length - 1) // 2)) & (offsets <= length // 2)
        position = (indices[:, None] - start) + offsets
        # What is there once is at most one turn away; the rest may be anywhere on the loop.
        position += length * (position < 0)
        position -= length * (position >= length)
        np.clip(position, 0, length - 1, out=position)
        position += start
        return position, once

    def sample(self, u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
        """The blurred mask at points (R, C), sides below 32768, bilinear, 0 outside the picture."""
        return cv2.remap(self.soft, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def level_lines(picture: NDArray[np.float32], level: float) -> list[NDArray[np.float64]]:
    """Lines (K, 2) of one level of a picture (H, W), closed where they do not end at its border."""
    height, width = picture.shape
    u = np.broadcast_to(np.arange(width, dtype=float), (height, width))
    v = np.broadcast_to(np.arange(height, dtype=float)[:, None], (height, width))
    # For one level of one picture the oldest algorithm is the quickest by far; the others prepare for many.
    return contour_generator(u, v, picture.astype(np.float64), name="mpl2005").lines(level)[0]


def resample(line: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.float64], float] | None:
    """A closed polyline at even steps of about ``spacing`` pixels."""
    steps = np.hypot(np.diff(line[:, 0]), np.diff(line[:, 1]))
    moved = steps > 1e-9
    line, steps = line[np.concatenate([[True], moved])], steps[moved]
    arc = np.concatenate([[0.0], np.cumsum(steps)])
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
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    top, left = int(rows[0]), int(columns[0])
    cut = mask[top : rows[-1] + 1, left : columns[-1] + 1]
    moments = cv2.moments(cut.view(np.uint8), binaryImage=True)
    whole = np.zeros((mask.shape[0] + 2 * _MARGIN, mask.shape[1] + 2 * _MARGIN), np.float32)
    soft = whole[top : top + cut.shape[0] + 2 * _MARGIN, left : left + cut.shape[1] + 2 * _MARGIN]
    soft[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = cut
    if blur > 0:
        soft[:] = cv2.GaussianBlur(soft, (0, 0), blur)
    lines = level_lines(soft, 0.5)
    corner = np.array([left, top], dtype=float)
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
        points.append(loop + corner)
        normals.append(normal)
        spacings.append(step)
    if not points:
        raise MagicError(Code.EMPTY_MASK, "pixels of the mask that are on the object", int(mask.sum()), "a region at least 4 px wide")
    order = sorted(range(len(points)), key=lambda i: -len(points[i]))
    points, normals = [points[i] for i in order], [normals[i] for i in order]
    lengths = np.array([len(p) for p in points])
    everything = np.concatenate(points)
    return Contour(
        points=everything,
        normals=np.concatenate(normals),
        loop=np.repeat(np.arange(len(points)), lengths),
        starts=np.concatenate([[0], np.cumsum(lengths)[:-1]]),
        lengths=lengths,
        spacing=np.array([spacings[i] for i in order]),
        soft=np.ascontiguousarray(whole[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]),
        size=float(np.hypot(*(everything.max(axis=0) - everything.min(axis=0)))),
        centroid=corner + np.array([moments["m10"], moments["m01"]]) / moments["m00"],
        blur=float(blur),
    )
