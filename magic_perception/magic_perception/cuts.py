"""Things of different colours that stand beside each other in one cluster, parted by the upright plane between them.

Two convex things on a table are on the two sides of some upright plane.  Where stereo fills the gap between them, or they touch with faces
that go on in one plane, no seam bends inward, and low things have none that tells; but colour changes all along that plane, and either side
alone is nearer to a convex body than both are together: a camera sees past them where one convex body would be.  What no camera sees is no
evidence, as a body may go on behind itself, behind other things and where its depth is lost.  The colour of one printed thing changes as
well, and so do those of a head and its handle: the chance of two things is a logistic function of what is measured at the plane
(:data:`CRITERIA`), and what may be one convex body stays one thing, whatever its colours.  ``cuts.json`` holds the weights, made by
``python -m magic_perception.learn_cuts`` from procedural scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.workers import Workers
from magic_perception import clusters, logistic
from magic_perception.clustered import Clusters
from magic_perception.looks import Looked
from magic_perception.percentiles import extents, percentile
from magic_perception.shared_out import shared_out

#: What is measured at an upright plane between two sides of a cluster, and what it means.
CRITERIA = {
    "contrast": "log of one and the change of colour across the plane, in squared standard deviations",
    "own": "share of points that are nearer in colour to their own side's mean than to the other's, less a half",
    "hull": "log of the share of the plan's convex hull that is in neither side's and that a camera sees to be empty, up to 0.05, over 0.02",
    "block": "the same of the upright block on that hull and those on the sides', each as high as what is in it",
    "breadth": "log of the lesser breadth of the sides in plan, up to 40 mm, over that",
    "slim": "lesser ratio of breadth and length of the sides in plan",
    "hollow": "share of its own hull in plan that a camera sees to be empty below its top, of the side of which that is less",
}

#: Directions that are looked in, and the steps of the plane along them, m; what is compared across a plane lies so near to it, m.
DIRECTIONS, STEP, BESIDE = 24, 0.004, 0.016
#: Spread of colour (lightness, two colour axes; OpenCV's Lab of 8 bits), which light and noise make, and of height, m, that a surface has.
SPREAD, ROUGH = np.array([12.0, 5.0, 5.0]), 0.004
#: Least change of colour across a plane that is looked at, in squared standard deviations; least share of the points on a side, and number
#: of those near the plane; what a change of height counts beside one of colour.
LITTLE, SMALL, FEW, STEPPED = 0.3, 0.03, 20, 0.5
#: So many planes of a cluster are judged, by so many of its points; two differ by so many degrees, or by so much beside each other, m.
PLANES, POINTS, TURNED, MOVED = 4, 3000, 20.0, 0.010
#: A side has at least so many points, and is so broad in plan, m.
LEAST, NARROW = 120, 0.012
#: Cells of the plan, and how near to the plane what is seen may be the other side's, m.
CELL, UNSURE = 0.004, 0.004
#: What lies so near to the plane, m, is the side's whose colour is nearer by this factor.
NEAR, CLEAR = 0.008, 0.6

#: Whether a camera sees that nothing is there is asked at these shares of the height of the cluster; depth so much farther than a place, m,
#: shows it.  What is empty up to such a share of a side's height is hollow.
LEVELS, EMPTY, HOLLOW = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9), 0.008, 0.8
#: The share of the hull that has to be seen empty for what lies in it to be thought two things; the least and most that are told apart.
SEEN, LEAST_SEEN, MOST_SEEN = 0.02, 0.004, 0.05

#: Told the criteria (C,) of a plane: the logarithm of the odds that its sides are two things.
Judge = Callable[[NDArray[np.float64]], float]


@dataclass(frozen=True)
class Points:
    """Points: place (N, 2) in plan and height (N,) above the table, m; lab (N, 3): colour, OpenCV's Lab of 8 bits."""

    place: NDArray[np.float64]
    height: NDArray[np.float64]
    lab: NDArray[np.float64]

    def of(self, index: NDArray[np.int64]) -> Points:
        """Some of them."""
        return Points(self.place[index], self.height[index], self.lab[index])


@dataclass(frozen=True)
class Seen:
    """A cluster: some :data:`POINTS` of its points, and what cameras see in its convex hull in plan: empty (L, G), whether one sees that
    nothing is at heights level (L,) above the table, m, in cells whose middles are at place (G, 2)."""

    points: Points
    place: NDArray[np.float64]
    level: NDArray[np.float64]
    empty: NDArray[np.bool_]

    @classmethod
    def of(cls, points: Points, empty: Callable[[NDArray[np.float64]], NDArray[np.bool_]]) -> Seen:
        """By all points of the cluster; ``empty`` is told places (N, 3), in plan and the height above the table, m."""
        points = points.of(np.arange(0, len(points.place), max(1, len(points.place) // POINTS)))
        outline = _hull(points.place)
        low, high = outline[:, 0].min(axis=0), outline[:, 0].max(axis=0)
        place = np.stack(np.meshgrid(*(np.arange(low[i] + CELL / 2, high[i], CELL) for i in range(2))), axis=-1).reshape(-1, 2)
        place = place[_inside(place, outline)].astype(float)
        level = float(np.percentile(points.height, 97)) * np.array(LEVELS)
        asked = np.column_stack([np.tile(place, (len(level), 1)), np.repeat(level, len(place))])
        return cls(points, place, level, empty(asked).reshape(len(level), -1))

    def below(self, height: float) -> NDArray[np.bool_]:
        """The cells (G,) that are seen to be empty at some level up to a height, m, or at the lowest."""
        return np.any(self.empty[: max(1, np.count_nonzero(self.level <= height))], axis=0)


class Plane(NamedTuple):
    """An upright plane: the angle of its normal in plan, its offset along that, m, and the change of colour across it, in squared standard
    deviations."""

    angle: float
    offset: float
    change: float

    def distance(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of places (N, 2) in plan, m, negative on the first side."""
        return place @ [np.cos(self.angle), np.sin(self.angle)] - self.offset


def planes(points: Points) -> list[Plane]:
    """The planes across which colour changes most, and height, the best first."""
    centre = points.place.mean(axis=0)
    place, cell = clusters.thin(np.column_stack([points.place - centre, np.zeros(len(points.place))]), CELL)
    values = np.column_stack([points.lab / SPREAD, points.height / ROUGH])
    # Of each cell of the plan the number of its points, their sums and sums of squares; then of each step along each direction.
    columns = np.vstack([np.bincount(cell), *(np.bincount(cell, column) for column in (*values.T, *(values**2).T))])
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    distance = np.column_stack([np.cos(angles), np.sin(angles)]) @ place[:, :2].T
    low = float(distance.min())
    index = ((distance - low) / STEP).astype(int)
    steps = int(index.max()) + 1
    index += np.arange(DIRECTIONS)[:, None] * steps
    sums = np.stack([np.bincount(index.ravel(), np.tile(column, DIRECTIONS), DIRECTIONS * steps) for column in columns])
    total = np.zeros((len(columns), DIRECTIONS, steps + 1))
    np.cumsum(sums.reshape(len(columns), DIRECTIONS, steps), axis=2, out=total[:, :, 1:])
    edges, width = np.arange(1, steps), round(BESIDE / STEP)
    before = total[:, :, edges] - total[:, :, np.maximum(edges - width, 0)]
    after = total[:, :, np.minimum(edges + width, steps)] - total[:, :, edges]
    share = total[0, :, edges].T / len(points.place)
    enough = (before[0] > FEW) & (after[0] > FEW) & (share > SMALL) & (share < 1 - SMALL)
    one, two = (window[1:] / np.maximum(window[0], 1) for window in (before, after))
    spread = np.maximum(one[4:] - one[:4] ** 2, 0) + np.maximum(two[4:] - two[:4] ** 2, 0)
    change = np.where(enough, (one[:4] - two[:4]) ** 2 / (spread + 2), 0)
    color = change[:3].sum(axis=0)
    score = color + STEPPED * change[3]
    wide = np.pad(score, ((0, 0), (1, 1)))
    peaks = np.argwhere((color > LITTLE) & (score >= wide[:, :-2]) & (score >= wide[:, 2:]))
    kept: list[tuple[NDArray[np.float64], float]] = []
    result = []
    for i, k in peaks[np.argsort(-score[tuple(peaks.T)], kind="stable")]:
        way, offset = np.array([np.cos(angles[i]), np.sin(angles[i])]), low + float(edges[k]) * STEP
        turns = [float(way @ other) for other, _ in kept]
        if any(
            abs(turn) > np.cos(np.radians(TURNED)) and abs(offset * np.sign(turn) - beside) < MOVED
            for turn, (_, beside) in zip(turns, kept, strict=True)
        ):
            continue
        kept.append((way, offset))
        result.append(Plane(float(angles[i]), offset + float(centre @ way), float(color[i, k])))
        if len(kept) == PLANES:
            break
    return result


def measured(seen: Seen, plane: Plane) -> NDArray[np.float64] | None:
    """The :data:`CRITERIA` (C,) of a plane; ``None`` where a side is too small."""
    points = seen.points
    distance = plane.distance(points.place)
    first = distance < 0
    sides = (first, ~first)
    counts = [np.count_nonzero(side) for side in sides]
    # What lies nearer to the plane than it is known may be the other side's, and makes a narrow side as broad as that.
    clear = [points.place[side & (np.abs(distance) > UNSURE)] for side in sides]
    if min(counts) < LEAST // 3 or min(len(place) for place in clear) < 3:
        return None
    boxes = [_extents(place) for place in clear]
    if min(box[0] for box in boxes) < NARROW:
        return None
    inside = [_inside(seen.place, _hull(place)) for place in clear]
    tops = [max(percentile(points.height[side], 95), 1e-3) for side in sides]
    off = np.abs(plane.distance(seen.place)) > UNSURE
    beside = off & ~inside[0] & ~inside[1]
    solid = np.any([within & (seen.level[:, None] <= top) for within, top in zip(inside, tops, strict=True)], axis=0)
    scaled = points.lab / SPREAD
    away = [np.linalg.norm(scaled - scaled[side].mean(axis=0), axis=1) for side in sides]
    return np.array([
        np.log1p(plane.change),
        min(float(np.mean(away[i][side] < away[1 - i][side])) for i, side in enumerate(sides)) - 0.5,
        _share(beside & seen.below(min(tops))),
        _share(seen.empty & ~solid & off),
        min(np.log(min(box[0] for box in boxes) / 0.040), 0.0),
        min(float(box[0] / max(box[1], box[0])) for box in boxes),
        min(float(np.mean(seen.below(HOLLOW * top)[within])) if within.any() else 0.0 for within, top in zip(inside, tops, strict=True)),
    ])  # fmt: skip


def _share(empty: NDArray[np.bool_]) -> float:
    """The logarithm of the share of what is seen to be empty, over what tells something."""
    return float(np.log(np.clip(np.mean(empty) if empty.size else 0.0, LEAST_SEEN, MOST_SEEN) / SEEN))


def convex(row: NDArray[np.float64]) -> bool:
    """Whether by the criteria (C,) of a plane both sides may be one convex body, as far as cameras see."""
    names = list(CRITERIA)
    return row[names.index("hull")] <= 0 and row[names.index("block")] <= 0


def _extents(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Breadth and length (2,) of most of the places (N, 2), m: a handle stays slim with a bit of its head beside it."""
    return extents(place) / 0.9


def _hull(place: NDArray[np.float64]) -> NDArray[np.float32]:
    return cv2.convexHull(np.ascontiguousarray(place, np.float32)[:, None])


def _inside(place: NDArray[np.float64], outline: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which of the places (N, 2) are inside a convex outline."""
    ring = outline[:, 0].astype(float)
    edge = np.roll(ring, -1, axis=0) - ring
    side = edge[:, :1] * (place[:, 1] - ring[:, 1:]) - edge[:, 1:] * (place[:, 0] - ring[:, :1])
    return np.all(side >= 0, axis=0) | np.all(side <= 0, axis=0)


@cache
def learned() -> Judge:
    """The judge by the weights that ship with the package."""
    return logistic.load(Path(__file__).with_name("cuts.json"), CRITERIA).odds


def rated(seen: Seen) -> list[tuple[Plane, NDArray[np.float64]]]:
    """The planes whose sides are no one convex body, with their criteria (C,)."""
    rows = [(plane, measured(seen, plane)) for plane in planes(seen.points)]
    return [(plane, row) for plane, row in rows if row is not None and not convex(row)]


def best(found: list[tuple[Plane, NDArray[np.float64]]], judge: Judge) -> Plane | None:
    """Of planes with their criteria (C,) that which is likeliest to part two things; ``None`` where none is likelier to than not."""
    odds = [judge(row) for _, row in found]
    return found[int(np.argmax(odds))][0] if odds and max(odds) > 0 else None


def points_of(looks: list[Looked], found: Clusters) -> Points:
    """All points of the clusters (N,)."""
    height = np.concatenate([look.heights[where] for look, where in zip(looks, found.spots, strict=True)])
    color = np.concatenate([look.frame.color[where] for look, where in zip(looks, found.spots, strict=True)])
    lab = cv2.cvtColor(color[:, None], cv2.COLOR_RGB2LAB)[:, 0] if len(color) else color
    return Points(found.cloud[:, :2].astype(float), height.astype(float), lab.astype(float))


def bare(looks: list[Looked], found: Clusters) -> list[NDArray[np.bool_]]:
    """For each look (H, W) where it shows no thing, nothing known, and is not blind."""
    return [look.open & ~mask & ~fixed for look, mask, fixed in zip(looks, found.masks, found.fixed, strict=True)]


def empty(looks: list[Looked], bared: list[NDArray[np.bool_]], asked: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which places (N, 3) in the world a camera sees to be empty: it is :func:`bare` there, or what it sees lies behind them."""
    result = np.zeros(len(asked), bool)
    for look, none in zip(looks, bared, strict=True):
        k = look.frame.intrinsics
        local = transforms.apply(transforms.inverse(look.frame.world_from_camera), asked)
        z = np.maximum(local[:, 2], 1e-3)
        u, v = np.rint(k.fx * local[:, 0] / z + k.cx), np.rint(k.fy * local[:, 1] / z + k.cy)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
        u, v = (np.where(inside, i, 0).astype(int) for i in (u, v))
        with np.errstate(invalid="ignore"):
            result |= inside & (none[v, u] | (look.frame.depth[v, u] > z + EMPTY))
    return result


def seen_of(looks: list[Looked], bared: list[NDArray[np.bool_]], cloud: NDArray[np.float32], points: Points) -> Seen:
    """What is seen of a cluster; cloud (N, 3), points (N,): its own points in the world, and over the table."""
    ground = np.array([0, 0, np.mean(cloud[:, 2] - points.height)])
    return Seen.of(points, lambda asked: empty(looks, bared, asked + ground))


def parted(
    looks: list[Looked], found: Clusters, instance: NDArray[np.int64], judge: Judge, workers: Workers | None = None
) -> NDArray[np.int64]:
    """The instances (N,) of the cloud's points with those parted that an upright plane parts into two things.

    workers: processes that look for planes as well.
    """
    instance = instance.copy()
    points, bared = points_of(looks, found), bare(looks, found)

    def seen(labels: Iterable[int]) -> list[tuple[int, Seen]]:
        members = [(label, np.nonzero(instance == label)[0]) for label in labels]
        return [(label, seen_of(looks, bared, found.cloud[mine], points.of(mine))) for label, mine in members if len(mine) >= 2 * LEAST]

    whole = seen(range(int(instance.max(initial=-1)) + 1))
    things = [thing for _, thing in whole]
    ratings = shared_out(_rated, None, things, [len(thing.points.place) for thing in things], workers)
    todo = [(label, rating) for (label, _), rating in zip(whole, ratings, strict=True)]
    while todo:
        label, rating = todo.pop()
        plane = best(rating, judge)
        if plane is None:
            continue
        mine = np.nonzero(instance == label)[0]
        first = _first(points.of(mine), plane)
        if min(np.count_nonzero(first), np.count_nonzero(~first)) < LEAST:
            continue
        new = int(instance.max()) + 1
        instance[mine[first]] = new
        todo += [(part, rated(thing)) for part, thing in seen((label, new))]
    return instance


def _rated(_: None, thing: Seen) -> list[tuple[Plane, NDArray[np.float64]]]:
    return rated(thing)


def _first(points: Points, plane: Plane) -> NDArray[np.bool_]:
    """Which points (N,) are on the first side of a plane; of those near it by the colour of what lies beside it, where that tells."""
    distance = plane.distance(points.place)
    first = distance < 0
    beside = (np.abs(distance) > NEAR) & (np.abs(distance) < BESIDE)
    if not (np.any(beside & first) and np.any(beside & ~first)):
        return first
    scaled = points.lab / SPREAD
    one, two = (np.linalg.norm(scaled - np.median(scaled[beside & side], axis=0), axis=1) for side in (first, ~first))
    near = np.abs(distance) <= NEAR
    first[near & (one < CLEAR * two)] = True
    first[near & (two < CLEAR * one)] = False
    return first
