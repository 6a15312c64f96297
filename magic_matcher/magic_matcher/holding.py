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
from numpy.typing import NDArray

from magic_matcher.contour import Contour, level_lines, resample

#: Rises and falls below this share of the radius (and of a pixel or two) are the raster's.
TOLERANCE = 0.04
#: At rest the way into the open points up at least so much (cosine).
LIES = 0.3
#: Directions in which pockets are looked for.
DIRECTIONS = 72
#: By so much (rad) a pull may be off to either side and still has to find the disc held, in steps in which a better pull is looked for, and
#: the farthest that one is from the contact's own normal.
ASTRAY, TURN_STEP, TURN_MOST = np.deg2rad(15.0), np.deg2rad(5.0), np.deg2rad(45.0)
#: A disc that has moved aside by so many radii has left its place: what a side of a shallow hollow rises by farther off holds it at another
#: one. A disc's centres are looked at so many times as closely for that.
STAYS, FINER = 0.75, 4


#: Closed curves (K, 2) of a disc's centres, and their unit normals (K, 2) into the open.
Curves = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


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


@dataclass(frozen=True)
class Room:
    """How much room is around a tool: distance (H, W) float32 px to it, 0 on it; corner (2,): the picture's pixel (0, 0) in it."""

    distance: NDArray[np.float32]
    corner: NDArray[np.float64]

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """The room (B,) at points (B, 2); beyond the border as on it."""
        u, v = (np.ascontiguousarray(a[None], dtype=np.float32) for a in (points + self.corner).T)
        return cv2.remap(self.distance, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]


def room(contour: Contour, radius: float) -> Room:
    """The room around a tool, as far as a disc of ``radius`` px can be from touching it."""
    margin = int(np.ceil(radius)) + 4
    low = np.floor(contour.points.min(axis=0)).astype(int) - 1
    high = np.ceil(contour.points.max(axis=0)).astype(int) + 2
    first, last = np.maximum(low, 0), np.minimum(high, np.array(contour.soft.shape)[::-1])
    free = np.ones(tuple((high - low)[::-1] + 2 * margin), np.uint8)
    left, top = first - low + margin
    cut = contour.soft[first[1] : last[1], first[0] : last[0]]
    free[top : top + cut.shape[0], left : left + cut.shape[1]] = cut <= 0.5
    return Room(cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), (margin - low).astype(float))


def centres(around: Room, radius: float) -> Curves:
    """Closed curves (K, 2) of the centres of touching discs, px, and their unit normals (K, 2) into the open."""
    # Distances are to the nearest pixel of the tool, half a pixel beyond its edge.
    lines = level_lines(around.distance, max(0.97 * radius + 0.5, 0.75))
    spacing = max(1.5, radius / 7)
    limit = np.array(around.distance.shape)[::-1] - 1
    result = []
    for line in lines:
        sampled = resample(line, spacing) if len(line) > 3 else None
        if sampled is None:
            continue
        curve = sampled[0]
        tangent = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
        normal = np.column_stack([tangent[:, 1], -tangent[:, 0]]) / np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-9)[:, None]
        inner, outer = (np.clip(np.rint(curve + sign * 2.0 * normal).astype(int), 0, limit) for sign in (-1, 1))
        if np.sum(around.distance[outer[:, 1], outer[:, 0]] - around.distance[inner[:, 1], inner[:, 0]]) < 0:
            normal = -normal
        result.append((curve - around.corner, normal))
    return result


def _walks(heights: NDArray[np.float32], start: NDArray[np.int64], sign: int) -> NDArray[np.float32]:
    """Heights (B, K) met on walks once around a curve from ``start`` (B,), forwards or backwards; ``heights`` (B, K), or (1, K) for all
    alike."""
    count = heights.shape[1]
    if sign < 0:
        # Backwards from k is forwards from K - 1 - k on the reversed curve.
        heights, start = heights[:, ::-1], count - 1 - start
    doubled = np.concatenate([heights, heights[:, :-1]], axis=1)
    row, column = doubled.strides
    # Every walk is a stretch of its own row: seen, not copied.
    stretches = np.lib.stride_tricks.as_strided(doubled, (len(doubled), count, count), (row, column, column), writeable=False)
    return stretches[np.arange(len(start)) if len(heights) > 1 else 0, start]


def _descend(height: NDArray[np.float32], tolerance: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Step (B,) and height (B,) of the lowest point of walks (B, K) before they climb by more than ``tolerance`` above it."""
    lowest = np.minimum.accumulate(height, axis=1)
    climbed = height - lowest > tolerance
    last = np.argmax(climbed, axis=1)
    last = np.where(last > 0, last, height.shape[1]) - 1
    value = lowest[np.arange(len(height)), last]
    return np.argmax(height <= value[:, None], axis=1), value


def _climb(height: NDArray[np.float32], base: NDArray[np.float32], tolerance: float) -> NDArray[np.float32]:
    """Highest rise (B,) above ``base`` on walks (B, K) before they fall below it."""
    fallen = height < (base - tolerance)[:, None]
    last = np.argmax(fallen, axis=1)
    last = np.where(last > 0, last, height.shape[1])
    highest = np.where(np.arange(height.shape[1]) < last[:, None], height, -np.inf).max(axis=1)
    return np.maximum(highest - base, 0.0)


def _settle(
    curve: NDArray[np.float64],
    free: NDArray[np.float64],
    up: NDArray[np.float64],
    at: NDArray[np.int64],
    value: NDArray[np.float32],
    tolerance: float,
    by_place: bool,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Index (B,) where discs come to rest that start ``at`` (B,) on a curve (K, 2) with heights ``value`` (B, K).

    Also the depths (B, 2) of the hollows, px, and whether (B,) the discs lie in them: a
    lowest place that hangs over is none, the disc left the tool before it.  There ``free`` (K, 2),
    the ways into the open, do not point up, along unit directions ``up`` (B, 2).  by_place:
    heights (1, K) and ``up`` (K, 2) belong to the places and are the same for all discs.
    """
    count = len(curve)
    (ahead, low_ahead), (back, low_back) = (_descend(_walks(value, at, sign), tolerance) for sign in (1, -1))
    rest = np.where(low_ahead <= low_back, at + ahead, at - back) % count
    lies = np.sum(free[rest] * (up[rest] if by_place else up), axis=1) > LIES
    depth = np.zeros((len(at), 2))
    rows = np.nonzero(lies)[0]
    if len(rows):
        there = value if by_place else value[rows]
        base = there[0 if by_place else np.arange(len(there)), rest[rows]]
        depth[rows] = np.column_stack([_climb(_walks(there, rest[rows], sign), base, tolerance) for sign in (1, -1)])
    return rest, depth, lies


def hold(contour: Contour, points: NDArray[np.float64], normals: NDArray[np.float64], radius: float, around: Room | None = None) -> Held:
    """Press a disc of ``radius`` px against contacts (B, 2) with outward normals (B, 2); ``around`` is :func:`room` where it is known."""
    number = len(points)
    gap, drift, start = np.full(number, np.inf), np.zeros(number), np.full(number, -1.0)
    press, swing = np.zeros((number, 2)), np.zeros((number, 2))
    curves = centres(room(contour, radius) if around is None else around, radius)
    if not curves:
        return Held(gap, drift, press, swing, start)
    lengths = [len(curve) for curve, _ in curves]
    everything = np.concatenate([curve for curve, _ in curves])
    which = np.repeat(np.arange(len(curves)), lengths)
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    # Along and across the normals, from the centroid, so that single precision is enough.
    places, here = (everything - contour.centroid).astype(np.float32), points - contour.centroid
    beside = np.column_stack([normals[:, 1], -normals[:, 0]])
    beyond = normals.astype(np.float32) @ places.T
    beyond -= (np.sum(here * normals, axis=1) + radius).astype(np.float32)[:, None]
    across = beside.astype(np.float32) @ places.T
    across -= np.sum(here * beside, axis=1).astype(np.float32)[:, None]
    # The disc comes from outside: standing off along the normal is what a narrow corner makes it do.
    cost = np.minimum(beyond, 0.5 * beyond)
    cost *= cost
    cost += across * across
    chosen = np.argmin(cost, axis=1)
    rows = np.arange(number)
    gap = np.hypot(across[rows, chosen], beyond[rows, chosen]).astype(np.float64) / radius
    tolerance = max(TOLERANCE * radius, 0.6)
    for k, (curve, free) in enumerate(curves):
        part = np.nonzero(which[chosen] == k)[0]
        if not len(part):
            continue
        at = chosen[part] - first[k]
        height = beyond[part, first[k] : first[k] + lengths[k]]
        rest, depth, lies = _settle(curve, free, normals[part], at, height, tolerance, False)
        press[part] = np.sort(depth, axis=1) / radius
        moved = curve[rest] - curve[at]
        drift[part] = np.where(lies, np.hypot(moved[:, 0], moved[:, 1]) / radius, np.inf)
        inward = contour.centroid - curve
        distance = np.maximum(np.hypot(inward[:, 0], inward[:, 1]), 1e-9)
        # This height is the same for all contacts: each start is followed once.
        starts, which_start = np.unique(at, return_inverse=True)
        rest, depth, lies = _settle(curve, free, inward / distance[:, None], starts, -distance[None].astype(np.float32), tolerance, True)
        rest, depth, lies = rest[which_start], depth[which_start], lies[which_start]
        swing[part] = np.sort(depth, axis=1) / radius
        start[part] = np.where(lies, swing[part, 0] - (distance[rest] - distance[at]) / radius, -1.0)
    return Held(gap, drift, press, swing, start)


@dataclass(frozen=True)
class Pocket:
    """Where a tool holds a disc: the disc's centre (2,), the unit way (2,) out, and the depth, radii, to the shallower side."""

    centre: NDArray[np.float64]
    out: NDArray[np.float64]
    depth: float


def pockets(contour: Contour, radius: float, curves: Curves, enough: float, hangs: bool = False) -> list[Pocket]:
    """Where a disc of ``radius`` px is held ``enough`` radii deep, the deepest first, no two within a radius of each other.

    Pressed into the tool along some direction, and :data:`ASTRAY` to either side of it, as :func:`steadied` asks; with ``hangs`` by a tool
    that hangs from it, its centroid as far below as it gets.  curves: those of the disc's :func:`centres`.
    """
    found: list[Pocket] = []
    tolerance = max(TOLERANCE * radius, 0.6)
    for curve, free in curves:
        found += _hung(contour, radius, curve, free, tolerance) if hangs else _pressed(radius, curve, free, tolerance, enough)
    apart: list[Pocket] = []
    for pocket in sorted(found, key=lambda p: -p.depth):
        if pocket.depth >= enough and all(np.hypot(*(pocket.centre - other.centre)) > radius for other in apart):
            apart.append(pocket)
    return apart


def _hung(contour: Contour, radius: float, curve: NDArray[np.float64], free: NDArray[np.float64], tolerance: float) -> list[Pocket]:
    inward = contour.centroid - curve
    distance = np.maximum(np.hypot(inward[:, 0], inward[:, 1]), 1e-9)
    up = inward / distance[:, None]
    rest, depth, lies = _settle(curve, free, up, np.arange(len(curve)), -distance[None].astype(np.float32), tolerance, True)
    places, first = np.unique(rest[lies], return_index=True)
    held = depth[lies].min(axis=1)[first] / radius
    return [Pocket(curve[place], up[place], float(deep)) for place, deep in zip(places, held, strict=True)]


def _pressed(radius: float, curve: NDArray[np.float64], free: NDArray[np.float64], tolerance: float, enough: float) -> list[Pocket]:
    turns = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    directions = np.column_stack([np.cos(turns), np.sin(turns)])
    heights = (directions @ (curve - curve.mean(axis=0)).T).astype(np.float32)
    lowest = (heights <= np.roll(heights, 1, axis=1)) & (heights <= np.roll(heights, -1, axis=1)) & (directions @ free.T > LIES)
    which, at = np.nonzero(lowest)
    if not len(which):
        return []
    rest, depth, _ = _settle(curve, free, directions[which], at, heights[which], tolerance, False)
    deep = depth.min(axis=1) / radius
    side = round(ASTRAY * DIRECTIONS / (2 * np.pi))
    found = []
    for k in np.flatnonzero(deep >= enough):
        here = np.hypot(*(curve[rest] - curve[rest[k]]).T) <= radius
        astray = [deep[here & (which == (which[k] + turn) % DIRECTIONS)].max(initial=0.0) for turn in (-side, side)]
        if min(astray) >= enough:
            found.append(Pocket(curve[rest[k]], directions[which[k]], float(min(deep[k], *astray))))
    return found


def _around(good: NDArray[np.bool_], at: int, most: int) -> int:
    """How many to either side of one are good as well, at most so many; -1 where it is not good itself."""
    return next((k - 1 for k in range(most + 1) if not good[at - k : at + k + 1].all()), most)


def _finer(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A closed row of points (K, 2) with others between them, :data:`FINER` K in all."""
    count = len(points)
    at = np.arange(FINER * count) / FINER
    return np.column_stack([np.interp(at, np.arange(count + 1), np.append(axis, axis[0])) for axis in points.T])


def _along(
    radius: float, curve: NDArray[np.float64], free: NDArray[np.float64], at: int, out: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """A disc pressed against directions ``out`` (T, 2) from one of its centres: how deep (T,) it is held, radii, how high (T,) the lower
    side of where it comes to rest is within :data:`STAYS`, and the index (T,) of that centre."""
    tolerance = max(TOLERANCE * radius, 0.6)
    height = (out @ (curve - curve[at]).T).astype(np.float32)
    rest, depth, _ = _settle(curve, free, out, np.full(len(out), at), height, tolerance, False)
    # What rolls farther than its own radius is at another place.
    held = np.where(np.hypot(*(curve[rest] - curve[at]).T) <= radius, depth.min(axis=1) / radius, 0.0)
    beside = np.column_stack([-out[:, 1], out[:, 0]])
    aside = beside @ curve.T - np.sum(beside * curve[rest], axis=1)[:, None]
    near = np.where(np.abs(aside) <= STAYS * radius, height, -np.inf)
    sides = [_climb(_walks(near, rest, sign), height[np.arange(len(out)), rest], tolerance) for sign in (1, -1)]
    return held, np.minimum(held, np.min(sides, axis=0) / radius), rest


def steadied(
    contour: Contour,
    point: NDArray[np.float64],
    normal: NDArray[np.float64],
    radius: float,
    curves: Curves,
    enough: float,
    straight: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The contact (2,) and normal (2,) by which a disc of ``radius`` px is held, pulled a little astray as well, that was met at a
    contact; ``None`` where its own normal serves, or no other is better.  curves: those of its :func:`centres`.

    A large disc in a small corner touches both of its arms, the shorter one at its end: pulled along the bisector of the corner it rolls
    over that end.  Of normals turned about the disc's centre the one that is turned least counts for which the hollow is ``enough``
    radii deep, pulled along it and :data:`ASTRAY` to either side.  Where none is so deep and the tool is led ``straight`` on, it is the one
    along which the lower side is highest (:data:`STAYS`), of those along which the hollow is ``enough`` deep if it is so along the
    contact's own.  Of a scoop, that is led along and then up, it is the deepest, and where none bears such pulls the one that bears the
    most to either side.  The contact is then where the line through the disc's centre meets the outline.
    """
    if not curves:
        return None
    across = np.array([-normal[1], normal[0]])
    relative = np.concatenate([curve for curve, _ in curves]) - point - radius * normal
    # As in hold(): the disc comes from outside.
    beyond = relative @ normal
    nearest = int(np.argmin(np.minimum(beyond, 0.5 * beyond) ** 2 + (relative @ across) ** 2))
    ends = np.cumsum([len(curve) for curve, _ in curves])
    which = int(np.searchsorted(ends, nearest, side="right"))
    curve, free = curves[which]
    at = nearest - (int(ends[which - 1]) if which else 0)
    tolerance = max(TOLERANCE * radius, 0.6)

    side = round(ASTRAY / TURN_STEP)
    count = round(TURN_MOST / TURN_STEP) + side
    turns = np.arange(-count, count + 1) * TURN_STEP
    directions = np.cos(turns)[:, None] * normal + np.sin(turns)[:, None] * across
    own = min(enough, float(_along(radius, curve, free, at, directions[[count - side, count, count + side]])[0].min()))
    if own >= enough:
        return None
    held, _, rest = _along(radius, curve, free, at, directions)
    held = np.minimum(held, enough)
    steady = np.min([held[side + k : len(held) - side + k] for k in (-side, 0, side)], axis=0)
    nearby = np.abs(turns[side:-side])
    best = side + int(np.lexsort((nearby, -steady))[0])
    if straight and steady[best - side] < enough:
        curve, free, at = _finer(curve), _finer(free), FINER * at
        held, lower, rest = _along(radius, curve, free, at, directions)
        lower[held < min(held[count], enough)] = 0.0  # what is deep enough stays so
        best = side + int(np.lexsort((nearby, -lower[side:-side]))[0])
        if lower[best] <= lower[count] + tolerance / radius:
            return None
    elif not straight and steady[best - side] <= own + TOLERANCE:
        # Too shallow for such pulls: the middle of those that it bears.
        bears = np.array([_around(held > TOLERANCE, side + k, side) for k in range(len(steady))])
        best = side + int(np.lexsort((nearby, -bears))[0])
        # Of a disc for which the tolerance is less than a pixel the outline tells no single step, as in a wide bowl.
        unsure = bears[count - side] >= 0 and TOLERANCE * radius < 1.0
        if bears[best - side] <= bears[count - side] + unsure:
            return None
    direction, centre = directions[best], curve[rest[best]]
    way = np.arange(0.0, 3 * radius, 0.25)
    ahead = centre - way[:, None] * direction
    solid = np.flatnonzero(contour.sample(*ahead.T.astype(np.float32)[:, None])[0] > 0.5)
    return (ahead[solid[0]], direction) if len(solid) else None
