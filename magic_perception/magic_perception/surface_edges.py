"""Seams of labels in a picture, moved to where the surfaces on either side end."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception.looks import Looked
from magic_perception.pixels import window

#: Pixels beside the seam of two labels that are judged anew, and half the window around them in which surfaces are fitted.
BAND, FITTED = 6, 14
#: Standard deviations of depth from which a pixel is not of its own surface, and within which it is of another.
OFF, ON = 2.5, 1.5
#: Least share of the window that tells of a surface.
SUPPORT = 0.06
#: A pixel at a seam goes to the label that most of the square of so many pixels about it have.
NEIGHBOURS = 7


def on_surfaces(labels: NDArray[np.int32], look: Looked) -> NDArray[np.int32]:
    """Labels (H, W) whose seams follow the surfaces on either side: parts come in voxels, several pixels wide.

    Near a seam a pixel that lies off the plane through its own label's pixels farther in, and on that of the other's, is the other's.  Of a
    plane the inverse depth is linear in the picture, so that moments over a window fit all planes at once.
    """
    meets, things = np.zeros(labels.shape, bool), window(labels > 0)
    for axis in range(2):
        image, there = (np.moveaxis(picture[things], axis, 0) for picture in (labels, meets))
        one, two = image[:-1], image[1:]
        seam = (one != two) & (one > 0) & (two > 0)
        there[:-1] |= seam
        there[1:] |= seam
    if not meets.any():
        return labels
    size = 2 * BAND + 1
    near = cv2.dilate(meets.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
    depth = look.frame.depth
    band = near & (labels > 0) & np.isfinite(depth)
    sigma = np.maximum(look.sigma, np.float32(0.0015))
    best, winner = np.full(labels.shape, np.inf, np.float32), labels.copy()
    own = np.full(labels.shape, np.inf, np.float32)
    for label in (int(i) for i in np.unique(labels[meets])):
        x, y, w, h = cv2.boundingRect((meets & (labels == label)).view(np.uint8))
        margin = BAND + FITTED + 1
        cut = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        core = (labels[cut] == label) & ~near[cut] & np.isfinite(depth[cut])
        reach = cv2.dilate((labels[cut] == label).view(np.uint8), np.ones((size, size), np.uint8)) > 0
        rows, columns = np.nonzero(band[cut] & reach)
        off = _off_plane(depth[cut], core, rows, columns) / sigma[cut][rows, columns]
        mine = labels[cut][rows, columns] == label
        own[cut][rows[mine], columns[mine]] = off[mine]
        better = ~mine & (off < best[cut][rows, columns])
        best[cut][rows[better], columns[better]] = off[better]
        winner[cut][rows[better], columns[better]] = label
    changed = band & (own > OFF) & np.isfinite(own) & (best < ON)
    result = np.where(changed, winner, labels)
    # A thin bar before another thing is none of that: its pixels lie off the other's surface.
    return np.where(best < 2 * OFF, _smooth_seams(result, near), result)


def _off_plane(
    depth: NDArray[np.float32], core: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """How far pixels (N,) lie from the plane through those of ``core`` (H, W) around each, m; infinite where too few tell."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width].astype(float)
    v, u = v - height / 2, u - width / 2
    weight = core.astype(float)
    inverse = np.where(core, 1 / np.where(core, depth, 1), 0.0)
    size = (2 * FITTED + 1,) * 2

    def at(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)[rows, columns]

    n, su, sv = at(weight), at(weight * u), at(weight * v)
    suu, suv, svv = at(weight * u * u), at(weight * u * v), at(weight * v * v)
    sq, suq, svq = at(inverse), at(inverse * u), at(inverse * v)
    enough = n > SUPPORT * size[0] * size[1]
    safe = np.maximum(n, 1)
    mu, mv, mq = su / safe, sv / safe, sq / safe
    # A ridge of one pixel's spread: along a thin strip the plane across it is not told.
    cuu, cuv, cvv = suu / safe - mu**2 + 1, suv / safe - mu * mv, svv / safe - mv**2 + 1
    cuq, cvq = suq / safe - mu * mq, svq / safe - mv * mq
    det = cuu * cvv - cuv**2
    a, b = (cvv * cuq - cuv * cvq) / det, (cuu * cvq - cuv * cuq) / det
    told = mq + a * (u[rows, columns] - mu) + b * (v[rows, columns] - mv)
    return np.where(enough, np.abs(depth[rows, columns] - 1 / np.maximum(told, 1e-3)), np.inf)


def _smooth_seams(labels: NDArray[np.int32], near: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Labels (H, W) with each labelled pixel of ``near`` given to the label that most of its neighbours have."""
    best, winner = np.zeros(labels.shape, np.float32), labels.copy()
    x, y, w, h = cv2.boundingRect(near.view(np.uint8))
    cut = (slice(max(y - NEIGHBOURS, 0), y + h + NEIGHBOURS), slice(max(x - NEIGHBOURS, 0), x + w + NEIGHBOURS))
    part = labels[cut]
    for label in (int(i) for i in np.unique(part[near[cut] & (part > 0)])):
        share = cv2.blur((part == label).astype(np.float32), (NEIGHBOURS, NEIGHBOURS), borderType=cv2.BORDER_CONSTANT)
        more = share > best[cut]
        best[cut][more] = share[more]
        winner[cut][more] = label
    return np.where(near & (labels > 0), winner, labels)
