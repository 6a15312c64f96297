"""Parts of one thing that depth or a seam has parted, told by how they lie on it in the pictures: a handle, the rim of a mouth.

Where a mug lies on its side its handle meets it at two ends that depth loses, or lies on the table beside it; its mouth, seen aslant, is a
strip a few pixels wide whose depth is torn from the outside's; a bent wire has the table's depth between a plate and a hook that keep their
own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_perception import smear
from magic_perception.hidden import CLEAR, FOOT, hangs, seen_through
from magic_perception.looks import Looked

#: The widest gap and the least height over the table of what hangs in the air, m.
GAP, LIFTED = 0.020, 0.012
#: The largest difference in chromaticity (R, G, B over their sum) of what has one colour.
COLOR = 0.06
#: Pixels in which two parts are neighbours.
BESIDE = 7
#: The largest share of the other's pixels that a part has which hangs beside it or is a strip along it, and which closes a loop with it.
PART, LOOP = 0.2, 0.5
#: A hole of so many pixels, of whose rim either has such a share, closes a loop; a strip is so wide at most, as a mean, at a focal length
#: of 615.
HOLE, RIM, STRIP = 10, 0.2, 4.0
#: Of the pixels at which two parts meet in a bar such a share has no depth of its own; so long, m, a bar may be that has none, where
#: several pictures show it.
LOST, LOST_BAR = 0.5, 0.040
#: A place is seen to be empty where a picture shows neither there and depth goes on behind it by so many metres; between two things most
#: places are.
EMPTY, FREE = 0.004, 0.3


def owners(labels: list[NDArray[np.int32]], looks: list[Looked]) -> NDArray[np.int64]:
    """For each label (top + 1,) the one it belongs to, itself mostly: a smaller one of the same colour that touches a larger one in every
    picture which shows it.

    It belongs to the other where it hangs in the air, carried by nothing; where they meet in a thin bar that has lost its depth; or where
    both enclose a hole, as a handle does with its mug, or it is a strip along the other's edge, and no camera sees between them; or where
    one would hang over the other, and something that no camera sees may carry it, as the stem does a goblet's cup.
    """
    top = max((int(image.max()) for image in labels), default=0)
    owner = np.arange(top + 1)
    if top < 2:
        return owner
    sizes = sum(np.bincount(image[image > 0], minlength=top + 1) for image in labels)
    parts: dict[int, _Part] = {}

    def part(label: int) -> _Part:
        if label not in parts:
            parts[label] = _Part.of(label, labels, looks)
        return parts[label]

    for label in range(top, 0, -1):
        for other in sorted(_beside(labels, label), key=lambda i: -sizes[i]):
            if (sizes[other], -other) < (sizes[label], -label):
                continue
            one, two = part(label), part(other)
            if min(len(one.points), len(two.points)) < 20 or float(np.linalg.norm(one.shade - two.shade)) > COLOR:
                continue
            if _over(labels, looks, (label, one), (other, two)):
                owner[label] = other
                break
            ways, gap = _ways(one, two)
            if gap > LOST_BAR:
                continue
            half, small = sizes[label] < LOOP * sizes[other], sizes[label] < PART * sizes.max() and sizes[label] < PART * sizes[other]
            if _bar(labels, looks, label, other) or (
                gap <= GAP
                and (
                    (small and _hangs(one, two))
                    or (
                        ((half and _loop(labels, label, other)) or (small and _strip(labels, looks, label, other)))
                        and not _seen_between(ways, labels, looks, (label, other))
                    )
                )
            ):
                owner[label] = other
                break
    for label in range(top + 1):
        while owner[owner[label]] != owner[label]:
            owner[label] = owner[owner[label]]
    return owner


def doubtful(labels: list[NDArray[np.int32]], looks: list[Looked]) -> list[tuple[int, int]]:
    """The pairs of labels that may be parts of one thing, though nothing says that they are: of one colour, beside each other in every
    picture that shows the one or the other, and no camera sees between."""
    beside = {label: _beside(labels, label) for label in range(1, max((int(image.max()) for image in labels), default=0) + 1)}
    near = {(min(label, other), max(label, other)) for label, others in beside.items() for other in others}
    parts = {label: _Part.of(label, labels, looks) for label in {label for pair in near for label in pair}}
    found = []
    for pair in sorted(near):
        one, two = (parts[label] for label in pair)
        if min(len(one.points), len(two.points)) < 20 or float(np.linalg.norm(one.shade - two.shade)) > COLOR:
            continue
        ways, gap = _ways(one, two)
        if gap <= LOST_BAR and not _seen_between(ways, labels, looks, pair):
            found.append(pair)
    return found


@dataclass(frozen=True)
class _Part:
    """A label's points (N, 3), their heights (N,), and its middle chromaticity (3,), which shading leaves as it is."""

    points: NDArray[np.float32]
    heights: NDArray[np.float32]
    shade: NDArray[np.float32]

    @classmethod
    def of(cls, label: int, labels: list[NDArray[np.int32]], looks: list[Looked]) -> _Part:
        """The part in all pictures."""
        points, heights, colors = [], [], []
        for look, image in zip(looks, labels, strict=True):
            where = np.nonzero((image == label) & np.isfinite(look.heights))
            step = max(1, len(where[0]) // 4000)
            where = (where[0][::step], where[1][::step])
            points.append(look.points(*where))
            heights.append(look.heights[where])
            colors.append(look.frame.color[where])
        return cls(np.concatenate(points), np.concatenate(heights), shade(np.concatenate(colors)))


def shade(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The middle chromaticity (3,) of colours (N, 3), infinite of none."""
    rgb = colors.astype(np.float32)
    return np.median(rgb / np.maximum(rgb.sum(axis=1, keepdims=True), 1), axis=0) if len(rgb) else np.full(3, np.inf, np.float32)


def _around(image: NDArray[np.int32], label: int, margin: int) -> tuple[slice, slice] | None:
    """The window of a label in a picture, so many pixels wider; ``None`` where it does not show."""
    x, y, w, h = cv2.boundingRect((image == label).view(np.uint8))
    return None if w == 0 else (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))


def _beside(labels: list[NDArray[np.int32]], label: int) -> set[int]:
    """The labels beside one in every picture that shows it."""
    beside: set[int] | None = None
    for image in labels:
        cut = _around(image, label, BESIDE)
        if cut is None:
            continue
        near = cv2.dilate((image[cut] == label).view(np.uint8), np.ones((BESIDE, BESIDE), np.uint8)) > 0
        here = {int(i) for i in np.unique(image[cut][near]) if i > 0 and i != label}
        beside = here if beside is None else beside & here
    return beside or set()


def _hangs(part: _Part, other: _Part) -> bool:
    """Whether a part begins above the table and the other does not carry it."""
    from scipy.spatial import cKDTree

    bottom = float(np.percentile(part.heights, 10))
    if bottom < LIFTED:
        return False
    foot = part.points[part.heights <= np.percentile(part.heights, 25)]
    # Carried: the other ends at its foot.
    below = cKDTree(other.points[:, :2]).query_ball_point(np.median(foot[:, :2], axis=0), 0.02)
    return not (len(below) > 4 and bottom - 0.015 < float(np.percentile(other.heights[below], 95)) < bottom + 0.010)


def _over(labels: list[NDArray[np.int32]], looks: list[Looked], *both: tuple[int, _Part]) -> bool:
    """Whether one of two labels would hang over the other, which stands on the table under its middle, and no camera sees that the column
    between is empty."""
    from scipy.spatial import ConvexHull, QhullError

    (_, lower), (label, upper) = sorted(both, key=lambda pair: float(np.percentile(pair[1].heights, 5)))
    bottom = float(np.percentile(upper.heights, 5))
    if np.percentile(lower.heights, 10) >= LIFTED or bottom < CLEAR or not hangs(looks, labels, label):
        return False
    feet = upper.points - upper.heights[:, None] * looks[0].normal
    low, high = np.percentile(feet, [2, 98], axis=0)
    middle = (low + high) / 2
    plan = lower.points[:, :2].astype(float)
    try:
        corners = plan[ConvexHull(plan).vertices]
    except QhullError:
        return False
    outline = np.append(corners, corners[:1], axis=0).astype(np.float32)[:, None]
    if cv2.pointPolygonTest(outline, (float(middle[0]), float(middle[1])), True) < -GAP:
        return False
    beside = np.stack(np.meshgrid(*[np.linspace(-FOOT, FOOT, 5)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    return not seen_through(looks, labels, middle + beside, np.full(len(beside), bottom)).all()


def _loop(labels: list[NDArray[np.int32]], label: int, other: int) -> bool:
    """Whether two labels enclose in a picture what is neither's, which neither encloses alone."""
    for image in labels:
        cut = _around(np.where(image == other, label, image), label, 2)
        if cut is None:
            continue
        own, both = image[cut] == label, (image[cut] == label) | (image[cut] == other)
        _, holes, stats, _ = cv2.connectedComponentsWithStats(np.pad(~both, 1, constant_values=True).view(np.uint8), connectivity=4)
        for i, area in enumerate(stats[1:, cv2.CC_STAT_AREA], 1):
            if area < HOLE or i == holes[0, 0]:
                continue
            rim = cv2.dilate((holes == i).view(np.uint8), np.ones((3, 3), np.uint8))[1:-1, 1:-1].view(bool) & both
            if RIM < float(own[rim].mean()) < 1 - RIM:
                return True
    return False


def _strip(labels: list[NDArray[np.int32]], looks: list[Looked], label: int, other: int) -> bool:
    """Whether a label is a strip along the other's edge wherever it shows."""
    for image, look in zip(labels, looks, strict=True):
        cut = _around(image, label, 2)
        if cut is None:
            continue
        own = image[cut] == label
        along = np.count_nonzero((cv2.dilate(own.view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (image[cut] == other))
        if np.count_nonzero(own) > STRIP * look.frame.intrinsics.fx / 615 * along:
            return False
    return True


def _bar(labels: list[NDArray[np.int32]], looks: list[Looked], label: int, other: int) -> bool:
    """Whether two labels meet in a picture in a thin bar that has lost its depth there, and what of them has its own is near each other,
    less near where all of several pictures show them meet so: there each pixel has the label of the nearest that has depth, and nothing in
    space parts them."""
    from scipy.spatial import cKDTree

    met, shown = 0, 0
    told: tuple[list[NDArray[np.float32]], ...] = ([], [])
    for image, look in zip(labels, looks, strict=True):
        cut = _around(np.where(image == other, label, image), label, 2)
        if cut is None:
            continue
        parts = tuple(image[cut] == i for i in (label, other))
        both = parts[0] | parts[1]
        heights = look.heights[cut]
        lost = both & (~np.isfinite(heights) | smear.behind(both, heights))
        for points, part in zip(told, parts, strict=True):
            rows, columns = np.nonzero(part & ~lost)
            step = max(1, len(rows) // 4000)
            points.append(look.points(rows[::step] + cut[0].start, columns[::step] + cut[1].start))
        shown += parts[0].any() and parts[1].any()
        seam = (cv2.dilate(parts[0].view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & parts[1]
        if not seam.any() or float(lost[seam].mean()) < LOST:
            continue
        width = smear.BAR * look.frame.intrinsics.fx / 615
        within = cv2.distanceTransform(np.pad(both, 1).view(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        near = cv2.distanceTransform((~seam).view(np.uint8), cv2.DIST_L2, 3) <= width
        # One of them is thin all about the seam: two bodies that meet with their corners are no bar.
        met += min(float(within[near & part].max()) for part in parts) <= width / 2
    if not met:
        return False
    one, two = (np.concatenate(points) for points in told)
    return len(one) > 0 and len(two) > 0 and float(cKDTree(two).query(one)[0].min()) <= (LOST_BAR if met == shown > 1 else GAP)


def _ways(part: _Part, other: _Part) -> tuple[NDArray[np.float32], float]:
    """Places (20, 10, 3) on the shortest ways between two parts, and the shortest, m."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(other.points).query(part.points)
    order = np.argsort(distance)[:20]
    steps = np.linspace(0, 1, 12)[1:-1, None]
    return (1 - steps) * part.points[order][:, None] + steps * other.points[nearest[order]][:, None], float(distance[order[0]])


def _seen_between(ways: NDArray[np.float32], labels: list[NDArray[np.int32]], looks: list[Looked], both: tuple[int, int]) -> bool:
    """Whether a camera sees between two parts: most of the ways have places where a picture shows neither, and depth lies behind them."""
    empty = np.zeros(len(ways), bool)
    for image, look in zip(labels, looks, strict=True):
        k = look.frame.intrinsics
        local = transforms.apply(transforms.inverse(look.frame.world_from_camera), ways.reshape(-1, 3).astype(float))
        u, v = (np.rint(f * local[:, i] / local[:, 2] + c).astype(int) for f, i, c in ((k.fx, 0, k.cx), (k.fy, 1, k.cy)))
        inside = (u >= 0) & (v >= 0) & (u < k.width) & (v < k.height)
        u, v = np.where(inside, u, 0), np.where(inside, v, 0)
        with np.errstate(invalid="ignore"):
            behind = ~(look.frame.depth[v, u] < local[:, 2] + EMPTY)
        empty |= (inside & ~np.isin(image[v, u], both) & behind).reshape(ways.shape[:2]).any(axis=1)
    return float(empty.mean()) > FREE
