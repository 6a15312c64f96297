"""What becomes of a disc that is pressed against a tool: does it stay where the contact is?

Planar quasi-statics.  The centre of a disc of radius r that touches the tool lies on the
tool's outline grown by r (the level r of the distance from it).  Pressed, the centre runs
downhill on that curve into a hollow; how high it would have to climb on either side to
leave the hollow again says how well it is held.  Two heights matter:

* ``press``: the height along the contact's own normal, for a tool that is moved along it;
* ``swing``: nearness to the tool's centroid, for a tool that hangs from the disc and turns
  until its centroid is as far from the disc as it gets.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from contourpy import contour_generator
from numpy.typing import NDArray

from magic_matcher.contour import Contour, resample

#: Rises and falls below this share of the radius (and of a pixel or two) are the raster's.
TOLERANCE = 0.04
#: At rest the way into the open points up at least so much (cosine).
LIES = 0.3


@dataclass(frozen=True)
class Held:
    """B contacts with a disc, all in units of its radius.

    gap (B,): how far off the disc must stay from touching the contact squarely (0.41 in a
    sharp right-angled corner, 1 in one of 60 degrees); inf where it finds no room at all;
    drift (B,): how far it then slides (inf: off the tool); press, swing (B, 2): depth of the hollow to its
    shallower and its deeper side; start (B,): as swing's shallower, measured from where
    the disc starts instead of from where it settles (negative: it can fall out at once).
    """

    gap: NDArray[np.float64]
    drift: NDArray[np.float64]
    press: NDArray[np.float64]
    swing: NDArray[np.float64]
    start: NDArray[np.float64]


def centres(contour: Contour, radius: float) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Closed curves (K, 2) of the centres of touching discs, px, and their unit normals (K, 2) into the open."""
    margin = int(np.ceil(2 * radius)) + 4
    free = (np.pad(contour.soft, margin) <= 0.5).astype(np.uint8)
    room = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances are to the nearest pixel of the tool, half a pixel beyond its edge.
    lines = contour_generator(z=room).lines(max(0.97 * radius + 0.5, 0.75))
    spacing = max(1.5, radius / 7)
    result = []
    for line in lines:
        sampled = resample(line, spacing) if len(line) > 3 else None
        if sampled is None:
            continue
        curve = sampled[0]
        tangent = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
        normal = np.column_stack([tangent[:, 1], -tangent[:, 0]]) / np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
        inner, outer = (np.clip(np.rint(curve + sign * 2.0 * normal).astype(int), 0, np.array(room.shape)[::-1] - 1) for sign in (-1, 1))
        if np.sum(room[outer[:, 1], outer[:, 0]] - room[inner[:, 1], inner[:, 0]]) < 0:
            normal = -normal
        result.append((curve - margin, normal))
    return result


def _descend(height: NDArray[np.float64], tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Step (B,) and height (B,) of the lowest point of walks (B, K) before they climb by more than ``tolerance`` above it."""
    lowest = np.minimum.accumulate(height, axis=1)
    climbed = np.logical_or.accumulate(height > lowest + tolerance, axis=1)
    reachable = np.where(climbed, np.inf, height)
    step = np.argmin(reachable, axis=1)
    return step, reachable[np.arange(len(height)), step]


def _climb(height: NDArray[np.float64], base: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
    """Highest rise (B,) above ``base`` on walks (B, K) before they fall below it."""
    rise = height - base[:, None]
    fallen = np.logical_or.accumulate(rise < -tolerance, axis=1)
    return np.maximum(np.where(fallen, 0.0, rise).max(axis=1), 0.0)


def _settle(
    curve: NDArray[np.float64], at: NDArray[np.int64], value: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Index (B,) where discs come to rest that start ``at`` (B,) on a curve with heights ``value`` (B, K), and the depths (B, 2)."""
    count = len(curve)
    rows = np.arange(len(at))
    steps = np.arange(count)

    def walk(start: NDArray[np.int64], sign: int) -> NDArray[np.float64]:
        return np.take_along_axis(value, (start[:, None] + sign * steps) % count, axis=1)

    (ahead, low_ahead), (back, low_back) = (_descend(walk(at, sign), tolerance) for sign in (1, -1))
    rest = np.where(low_ahead <= low_back, at + ahead, at - back) % count
    base = value[rows, rest]
    return rest, np.column_stack([_climb(walk(rest, sign), base, tolerance) for sign in (1, -1)])


def hold(contour: Contour, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float) -> Held:
    """Press a disc of ``radius`` px against contacts (B, 2) with outward normals (B, 2)."""
    number = len(points)
    gap, drift, start = np.full(number, np.inf), np.zeros(number), np.full(number, -1.0)
    press, swing = np.zeros((number, 2)), np.zeros((number, 2))
    curves = centres(contour, radius)
    if not curves:
        return Held(gap, drift, press, swing, start)
    lengths = [len(curve) for curve, _ in curves]
    everything = np.concatenate([curve for curve, _ in curves])
    which = np.repeat(np.arange(len(curves)), lengths)
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    u, v = everything[:, 0] - points[:, :1], everything[:, 1] - points[:, 1:]
    along = u * normals[:, :1] + v * normals[:, 1:]
    across = np.abs(u * normals[:, 1:] - v * normals[:, :1])
    beyond = along - radius
    # The disc comes from outside: standing off along the normal is what a narrow corner makes it do.
    cost = np.hypot(across, np.where(beyond > 0, 0.5 * beyond, beyond))
    chosen = np.argmin(cost, axis=1)
    rows = np.arange(number)
    gap = np.hypot(across[rows, chosen], beyond[rows, chosen]) / radius
    tolerance = max(TOLERANCE * radius, 0.6)
    for k, (curve, free) in enumerate(curves):
        part = np.nonzero(which[chosen] == k)[0]
        if not len(part):
            continue
        at = chosen[part] - first[k]
        height = curve @ normals[part].T
        rest, depth = _settle(curve, at, height.T, tolerance)
        # A lowest place that hangs over is none: the disc left the tool before it.
        lies = np.sum(free[rest] * normals[part], axis=1) > LIES
        press[part] = np.where(lies[:, None], np.sort(depth, axis=1) / radius, 0.0)
        moved = curve[rest] - curve[at]
        drift[part] = np.where(lies, np.hypot(*moved.T) / radius, np.inf)
        inward = contour.centroid - curve
        distance = np.maximum(np.hypot(*inward.T), 1e-9)
        # This height is the same for all contacts: each start is followed once.
        starts, which_start = np.unique(at, return_inverse=True)
        rest, depth = _settle(curve, starts, np.broadcast_to(-distance, (len(starts), len(curve))), tolerance)
        rest, depth = rest[which_start], depth[which_start]
        lies = np.sum(free[rest] * inward[rest], axis=1) > LIES * distance[rest]
        swing[part] = np.where(lies[:, None], np.sort(depth, axis=1) / radius, 0.0)
        start[part] = np.where(lies, swing[part, 0] - (distance[rest] - distance[at]) / radius, -1.0)
    return Held(gap, drift, press, swing, start)
