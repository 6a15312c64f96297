"""What of a convex outline a tool meets that is led against it: a flat side, a round one, or a corner.

Curvature at one point is not enough to tell.  Where a cube is turned by a few degrees the point that reaches farthest is a corner,
though it is the side beside it that the tool comes to lie on; and a millimetre of noise on a reconstructed outline is, at one point, any
curvature.  So models are fitted to as much of the outline as they explain, first to within the raster, then to within its own roughness,
which is how far what faces the direction stays behind its convex hull:

* a *flat side*: the longest stretch of a straight line that faces the direction within :data:`FACING`, half of the outline's width
  along it and more; straight, where its bow is small against it;
* a *round side*: a circle through all that faces the direction within :data:`AROUND`;
* a *corner*: straight stretches on both sides of the point that reaches farthest, which meet near it; its radius is that of the
  circle which rounds it, its scale the length of the shorter stretch.

What none of them explains (the tip of an ellipse) is left to :mod:`magic_matcher.curvature`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_matcher.contour import Contour

#: A side faces a direction within this angle, rad; a circle stands for all that does so, seen from the outline's middle, within the other.
FACING, AROUND = np.deg2rad(30.0), np.deg2rad(60.0)
#: A model explains what it leaves no more of (root mean square): so many pixels, or this share of the size; on a rough outline so many
#: times the roughness, the least that explains it, up to the last share.
RASTER, EVEN, ROUGH, ROUGHEST = 0.45, 0.005, (1.0, 1.5, 2.25, 3.5), 0.04
#: A flat side is as long as this share of the outline's width along it, and surely one from the next on; its bow is no more than this share
#: of its length.
LONG, WHOLE, BOW = 0.6, 0.8, 0.06
#: Stretches this much alike in length and direction (cosine) are the same.
ALIKE = 0.97
#: What of a stretch may lie around the corners at its ends: the line is that of the rest.
ENDS = 0.1
#: The circle of a round side is no larger than this share of the size, and seen from its middle the side reaches so far to both sides, rad.
LARGEST, REACHES = 1.5, np.deg2rad(40.0)
#: The arms of a corner are as long as this share of the size; where they meet is no farther from the outline than the other.
ARM, APEX = 0.3, 0.12
#: The outline is compared with a corner over this share of its shorter arm.
WITHIN = 0.7
#: What leaves less than this share of what a circle leaves is a corner.
CLEARLY = 0.7
#: A place belongs to a straight side no farther from it than this share of the size, whose normal is within this angle (rad) of its own and
#: which is as long as the last share.
BESIDE, SKEW, SHORTEST = 0.05, np.deg2rad(45.0), 0.1
#: A side is no longer than so many times what it is where half as much is allowed to be left.
CORNERED = 1.25
#: Places at which stretches begin, and the lengths that are tried.
_BEGIN, _LENGTHS = 180, 60


@dataclass(frozen=True)
class Side:
    """point (2,) px; radius px: inf of a flat side, of a corner how much it is rounded; scale px over which it is that."""

    point: NDArray[np.float64]
    radius: float
    scale: float


def side(contour: Contour, direction: NDArray[np.float64]) -> Side | None:
    """The side of the outermost loop that a tool meets which is led against a picture direction (2,); ``None`` where it is none of
    these."""
    outline = _Outline(contour)
    even = max(RASTER, EVEN * outline.size)
    roughness, most = outline.roughness(direction), ROUGHEST * outline.size
    for allowed in (even, *(min(times * roughness, most) for times in ROUGH if times * roughness > even)):
        stretches = outline.stretches(allowed)
        flat = _flat(outline, stretches, direction, allowed)
        if flat is not None and flat[1] >= WHOLE:
            return flat[0]
        round_side, corner = _round(outline, direction), _corner(outline, stretches, direction)
        # On a rough outline two short straight stretches are anywhere.
        whole = allowed >= min(ROUGH[0] * roughness, most)
        if whole and corner is not None and corner[1] <= min(allowed, CLEARLY * round_side[1] if round_side else np.inf):
            return corner[0]
        if round_side is not None and round_side[1] <= allowed:
            return round_side[0]
        if whole and flat is not None:
            return flat[0]
    return None


def straight_at(contour: Contour, point: NDArray[np.float64], normal: NDArray[np.float64]) -> tuple[Side, NDArray[np.float64]] | None:
    """The straight side of the outermost loop at a place (2,) that faces a direction (2,), and its normal; ``None`` where there is none.

    The normal of a place is that of what is around it: near a corner it is between those of both sides.
    """
    outline = _Outline(contour)
    stretches = outline.stretches(max(RASTER, EVEN * outline.size))
    along = np.column_stack([-stretches.normal[:, 1], stretches.normal[:, 0]])
    off = point - stretches.middle
    run = np.clip(np.einsum("ni,ni->n", off, along), -stretches.length / 2, stretches.length / 2)
    nearest = stretches.middle + run[:, None] * along
    fits = (np.linalg.norm(point - nearest, axis=1) < BESIDE * outline.size) & (stretches.normal @ normal > np.cos(SKEW))
    fits &= stretches.length > SHORTEST * outline.size
    if not fits.any():
        return None
    best = int(np.argmax(np.where(fits, stretches.normal @ normal, -1.0)))
    return Side(nearest[best], np.inf, float(stretches.length[best])), stretches.normal[best]


@dataclass(frozen=True)
class Ends:
    """A place (2,) px on a straight side: how much of the side, px, is behind and ahead of it along the unit way (2,), its normal turned by
    +90 degrees."""

    place: NDArray[np.float64]
    along: NDArray[np.float64]
    behind: float
    ahead: float

    def like(self, shown: Ends, mirrored: bool, scale: float) -> NDArray[np.float64]:
        """The nearest place (2,) that has as much of the side to both hands as another place has, whose lengths are taken ``scale`` times;
        where the side is shorter, the place that divides it in the same proportion.  mirrored: hands are changed."""
        behind, ahead = (scale * length for length in ((shown.ahead, shown.behind) if mirrored else (shown.behind, shown.ahead)))
        length = self.behind + self.ahead
        low, high = (behind, length - ahead) if behind + ahead <= length else (behind * length / (behind + ahead),) * 2
        return self.place + (float(np.clip(self.behind, low, high)) - self.behind) * self.along


def ends(contour: Contour, point: NDArray[np.float64], normal: NDArray[np.float64]) -> Ends | None:
    """Where on the straight side of the outermost loop that it belongs to a place (2,) with an outward normal (2,) is; ``None`` where it is
    on none."""
    outline = _Outline(contour)
    even = max(RASTER, EVEN * outline.size)
    found: list[Ends] = []
    for allowed in (even, 2 * even):
        stretches = outline.stretches(allowed)
        along = np.column_stack([-stretches.normal[:, 1], stretches.normal[:, 0]])
        off = point - stretches.middle
        run = np.einsum("ni,ni->n", off, along)
        fits = (np.abs(run) < stretches.length / 2) & (np.abs(np.einsum("ni,ni->n", off, stretches.normal)) < 3 * even)
        fits &= (stretches.normal @ normal > ALIKE) & (stretches.length > SHORTEST * outline.size)
        if not fits.any():
            return None
        best = int(np.argmax(np.where(fits, stretches.length, 0.0)))
        half, at = float(stretches.length[best]) / 2, float(run[best])
        found.append(Ends(stretches.middle[best] + at * along[best], along[best], half + at, half - at))
    side, coarser = found
    # A side ends at its corners; of a round outline the more is straight the less is asked.
    return side if coarser.behind + coarser.ahead < CORNERED * (side.behind + side.ahead) else None


@dataclass(frozen=True)
class _Stretch:
    """B straight stretches: middle (B, 2), outward normal (B, 2), length (B,) px; first (B,) and count (B,) of the points of their
    lines."""

    middle: NDArray[np.float64]
    normal: NDArray[np.float64]
    length: NDArray[np.float64]
    first: NDArray[np.int64]
    count: NDArray[np.int64]

    def chosen(self, which: NDArray[np.bool_]) -> _Stretch:
        return _Stretch(self.middle[which], self.normal[which], self.length[which], self.first[which], self.count[which])


class _Outline:
    """The points (K, 2) of a contour's longest loop, closed, and its normals there."""

    def __init__(self, contour: Contour) -> None:
        which = contour.loop == 0
        self.points, self.normals, self.size = contour.points[which], contour.normals[which], contour.size
        self.middle = (self.points.min(axis=0) + self.points.max(axis=0)) / 2

    def facing(self, direction: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points (K,) lie towards a direction (2,), seen from the middle."""
        out = self.points - self.middle
        return out @ direction > np.cos(AROUND) * np.linalg.norm(out, axis=1)

    def roughness(self, direction: NDArray[np.float64]) -> float:
        """How far what lies towards a direction (2,) and faces it stays behind the convex hull: three quarters of it, so that a notch is
        none."""
        hull = cv2.convexHull(self.points.astype(np.float32))
        which = self.facing(direction) & (self.normals @ direction > np.cos(AROUND))
        behind = [cv2.pointPolygonTest(hull, (float(u), float(v)), True) for u, v in self.points[which]]
        return float(np.percentile(behind, 75)) if behind else 0.0

    def reach(self, direction: NDArray[np.float64]) -> float:
        """How far the outline reaches along a direction (2,)."""
        return float((self.points @ direction).max())

    def stretches(self, allowed: float) -> _Stretch:
        """The longest stretch from each of many places on of which a straight line leaves no more than ``allowed``."""
        count = len(self.points)
        doubled = np.concatenate([self.points, self.points]) - self.middle
        products = np.column_stack([doubled, doubled[:, 0] ** 2, doubled[:, 1] ** 2, doubled[:, 0] * doubled[:, 1]])
        sums = np.concatenate([np.zeros((1, 5)), np.cumsum(products, axis=0)])
        begin = np.unique(np.linspace(0, count - 1, _BEGIN).astype(int))
        number = np.unique(np.linspace(max(4, 0.05 * count), 0.5 * count, _LENGTHS).astype(int))
        xx, yy, xy, _ = self._moments(sums, *np.broadcast_arrays(begin[:, None], number))
        spread = np.hypot((xx - yy) / 2, xy)
        straight = (xx + yy) / 2 - spread <= allowed**2
        # The longest up to which all are straight: beyond a corner a stretch may seem so again.
        last = np.logical_and.accumulate(straight, axis=1).sum(axis=1) - 1
        rows = np.nonzero(last >= 0)[0]
        whole = number[last[rows]]
        first, count = begin[rows] + np.rint(ENDS * whole).astype(int), np.rint((1 - 2 * ENDS) * whole).astype(int)
        xx, yy, xy, mean = self._moments(sums, first, count)
        spread = np.hypot((xx - yy) / 2, xy)
        angle = 0.5 * np.arctan2(2 * xy, xx - yy)
        normal = np.column_stack([-np.sin(angle), np.cos(angle)])
        outward = np.einsum("ni,ni->n", normal, self._mean_normals(first, count))
        normal *= np.where(outward < 0, -1.0, 1.0)[:, None]
        length = np.sqrt(12 * np.maximum((xx + yy) / 2 + spread, 0.0)) / (1 - 2 * ENDS)
        return _Stretch(mean + self.middle, normal, length, first, count)

    @staticmethod
    def _moments(sums: NDArray[np.float64], first: NDArray[np.int64], count: NDArray[np.int64]) -> tuple[NDArray[np.float64], ...]:
        """xx, yy, xy about the means, and these (..., 2), of the points of stretches, from cumulated sums."""
        part = (sums[first + count] - sums[first]) / count[..., None]
        mean = part[..., :2]
        return part[..., 2] - mean[..., 0] ** 2, part[..., 3] - mean[..., 1] ** 2, part[..., 4] - mean[..., 0] * mean[..., 1], mean

    def _mean_normals(self, first: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.float64]:
        sums = np.concatenate([np.zeros((1, 2)), np.cumsum(np.concatenate([self.normals, self.normals]), axis=0)])
        return sums[first + count] - sums[first]


def _flat(outline: _Outline, stretches: _Stretch, direction: NDArray[np.float64], allowed: float) -> tuple[Side, float] | None:
    """A flat side, and its length as a share of the outline's width."""
    facing = stretches.chosen(stretches.normal @ direction > np.cos(FACING))
    if not len(facing.length):
        return None
    best = int(np.argmax(facing.length))
    normal, length = facing.normal[best], float(facing.length[best])
    # Stretches that begin a little to either side are as long: their middle is the side's.
    middle = facing.middle[(facing.length > ALIKE * length) & (facing.normal @ normal > ALIKE)].mean(axis=0)
    along = np.array([-normal[1], normal[0]])
    width = outline.reach(along) + outline.reach(-along)
    # What lies deeper than the outline reaches is the floor of a notch.
    if length < LONG * width or outline.reach(normal) - middle @ normal > 3 * allowed:
        return None
    index = (facing.first[best] + np.arange(facing.count[best])) % len(outline.points)
    x, y = (outline.points[index] - middle) @ along, (outline.points[index] - middle) @ normal
    bow = abs(float(np.polyfit(x, y, 2)[0])) * (length / 2) ** 2
    if bow > max(BOW * length, allowed):
        return None
    return Side(middle, np.inf, length), length / width


def _round(outline: _Outline, direction: NDArray[np.float64]) -> tuple[Side, float] | None:
    """A round side, and what its circle leaves."""
    points = outline.points[outline.facing(direction)]
    if len(points) < 8:
        return None
    # Algebraic first (Kasa), then the distances themselves.
    local = points - outline.middle
    fitted = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), (local**2).sum(axis=1), rcond=None)[0]
    centre, radius = fitted[:2], float(np.sqrt(max(fitted[2] + fitted[:2] @ fitted[:2], 1.0)))
    for _ in range(6):
        away = local - centre
        far = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        change = np.linalg.lstsq(np.column_stack([away / far[:, None], np.ones(len(far))]), far - radius, rcond=None)[0]
        centre, radius = centre + change[:2], float(radius + change[2])
        if not 0 < radius < LARGEST * outline.size:
            return None
    away = local - centre
    left = np.linalg.norm(away, axis=1) - radius
    angle = np.arctan2(direction[0] * away[:, 1] - direction[1] * away[:, 0], away @ direction)
    if not (angle.min() < -REACHES and angle.max() > REACHES):
        return None
    return Side(outline.middle + centre + radius * direction, radius, 1.5 * radius), float(np.sqrt(np.mean(left**2)))


def _corner(outline: _Outline, stretches: _Stretch, direction: NDArray[np.float64]) -> tuple[Side, float] | None:
    """A corner, and what its arms and the circle between them leave."""
    beside = np.array([-direction[1], direction[0]])
    arms = []
    for sign in (1.0, -1.0):
        on_side = (stretches.normal @ beside * sign > 0.05) & (stretches.normal @ direction > 0.05)
        found = stretches.chosen(on_side & (stretches.length >= ARM * outline.size))
        if not len(found.length):
            return None
        # Of the straight stretches on this side the one whose line, not its length, reaches farthest: the one next to the corner.
        ends = found.middle @ direction + found.length / 2 * np.abs(found.normal @ beside)
        near = ends > ends.max() - APEX * outline.size
        best = int(np.argmax(np.where(near, found.length, 0.0)))
        arms.append((found.middle[best], found.normal[best], float(found.length[best])))
    (p, n, a), (q, m, b) = arms
    turn = float(np.arccos(np.clip(n @ m, -1, 1)))
    if not np.deg2rad(15) < turn < np.deg2rad(150):
        return None
    apex = np.linalg.solve(np.stack([n, m]), np.array([n @ p, m @ q]))
    bisector = transforms.unit(n + m)
    gap = float(apex @ bisector) - outline.reach(bisector)
    if np.linalg.norm(outline.points - apex, axis=1).min() > APEX * outline.size:
        return None
    radius = float(np.clip(gap / (1 / np.cos(turn / 2) - 1), 0.5, outline.size))
    centre = apex - bisector * radius / np.cos(turn / 2)
    near = outline.points[np.linalg.norm(outline.points - apex, axis=1) < WITHIN * min(a, b)]
    away = near - centre
    on_arc = away @ bisector > np.cos(turn / 2) * np.linalg.norm(away, axis=1)
    left = np.where(on_arc, np.linalg.norm(away, axis=1) - radius, np.maximum((near - p) @ n, (near - q) @ m))
    return Side(centre + radius * direction, radius, min(a, b)), float(np.sqrt(np.mean(left**2)))
