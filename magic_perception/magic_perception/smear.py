"""Depth smeared past an edge or across a hole, taken out of a mask by colour; what depth lost, put back.

The window of stereo matching carries a near surface's depth some pixels past its edge and over narrow gaps (a handle's hole); at thin bars
it may carry the background's depth over the thing.  The colour image shows the edge.  Each connected region of a mask is judged with two
histograms of colour, that of the table around it and that of its own inside: a pixel near the edge goes to whichever makes its
neighbourhood likelier, and a region of the table's colour that the mask encloses is a hole.  What has the table's colour itself, or nearly,
is left as it was: where the thing's own colours run into the table's, as a wooden spoon's do with the light, there is no edge to cut along.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception.clusters import connected
from magic_perception.pixels import where

#: Pixels, at a focal length of 615, by which depth reaches past an edge or falls short of it, and to which a hole may lie inside a mask's
#: edge.
REACH, DEEP = 9, 26
#: Where smear is found to reach no farther than this, pixels, depth is not carried past edges.
SHARP = 3
#: Log of the ratio of likelihoods from which a pixel near the edge is the table's, and one without support in depth is the thing's; and
#: that of a region's mean from which it is a hole.
TABLE, THING, HOLE = 1.0, 1.5, 2.5
#: And that by which a thing's own pixel is clearly not the table's, and the share of those beside a patch that are so where there is an
#: edge of colour.
APART, MOST = 2.5, 0.4
#: What is the table's differs from its colour around by less than so many squared standard deviations, shadows aside.
LIKE = 25.0
#: A hole is hollow in depth, by so many metres, or it has the table's colour to so many squared standard deviations.
HOLLOW, SAME = 0.004, 4.0
#: A filled hole is hollow by so many metres where so much of its border is of the thing's own colours.
SHALLOW, CLOSED = 0.002, 0.95
#: Depth falls back beyond an outline by so many metres more than a surface at 45 degrees would, looked for so many pixels beside it.
STEP, BESIDE = 0.005, 3
#: Least pixels of a hole, and of either kind for its histogram to tell anything.
LEAST, SAMPLE = 12, 150
#: Past such a share of the outlines nearest to a patch's inner pixels depth goes on where it is a face that stands on the table.
STANDS = 0.6
#: A patch with a larger share of the open around it than this may be the thing's end, where its pixels are off a plane by no more than so
#: many metres in the middle.
OPEN, EVEN = 0.5, 0.008
#: Widths of the histograms' bins in lightness and in the two colour axes, of 256.
BINS = (12, 5, 5)


def _index(lab: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Each pixel's bin of a histogram of colour (H, W)."""
    i, j, k = (cv2.extractChannel(lab, c).astype(np.int32) // BINS[c] for c in range(3))
    return (i * _SHAPE[1] + j) * _SHAPE[2] + k


_SHAPE = tuple(256 // b + 1 for b in BINS)
#: A density so small that it says nothing.
FLAT = np.float32(1e-5)


def _density(index: NDArray[np.int32]) -> NDArray[np.float32]:
    """A smoothed histogram of colour over all bins, which sums to 1."""
    from scipy.ndimage import gaussian_filter

    counts = np.bincount(index, minlength=int(np.prod(_SHAPE))).reshape(_SHAPE).astype(np.float32)
    used = np.unravel_index(np.flatnonzero(counts > 0), _SHAPE)
    cut = tuple(slice(max(int(along.min()) - 3, 0), int(along.max()) + 4) for along in used)
    counts[cut] = gaussian_filter(counts[cut], 0.9, mode="constant")
    return (counts / counts.sum()).ravel()


def likelier(lab: NDArray[np.uint8], one: NDArray[np.bool_], other: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Log of how much likelier each pixel's colour (H, W, 3) is in a region ``one`` (H, W) than in another."""
    index = _index(lab)
    return cv2.blur(np.take(np.log((_density(index[one]) + FLAT) / (_density(index[other]) + FLAT)), index), (3, 3))


#: How dark a shadow beside a thing makes the table, and how much of the table is taken to lie in one.
SHADES, SHADED = (0.9, 0.8, 0.7, 0.6), 0.15


def _shaded(lab: NDArray[np.uint8], index: NDArray[np.int32], table: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The density of the table's colours, its own and those that it has in a shadow of that darkness: in proportion nearer to black.

    lab (H, W, 3), index (H, W): the picture, and the bins of its pixels; table (H, W): where it shows the table.
    """
    rows, columns = where(table)
    step = max(1, len(rows) // 2000)
    own = _density(index[rows, columns])
    few = lab[rows[::step], columns[::step]].astype(np.float32) - np.float32([0, 128, 128])
    dark = np.concatenate([few * shade for shade in SHADES]) + np.float32([0, 128, 128])
    return (1 - SHADED) * own + SHADED * _density(_index(np.round(dark).astype(np.uint8)[:, None])[:, 0])


def softened(color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (H, W, 3) RGB in OpenCV's Lab of 8 bits, without the noise of single pixels."""
    return cv2.cvtColor(cv2.GaussianBlur(color, (3, 3), 0), cv2.COLOR_RGB2LAB)


def cleared(
    mask: NDArray[np.bool_],
    lab: NDArray[np.uint8],
    depth: NDArray[np.float32],
    table: NDArray[np.bool_],
    unlike: NDArray[np.float32],
    possible: NDArray[np.bool_],
    jump: NDArray[np.bool_],
    focal: float,
) -> tuple[NDArray[np.bool_], bool]:
    """The mask (H, W) with smear taken out and lost rims put back; and whether things with an edge of colour show that depth is not carried
    past edges.

    lab (H, W, 3): the picture (:func:`softened`); depth (H, W) metres; table (H, W): pixels that are surely the table; unlike (H, W):
    squared distance of the colour from that of the table around, in the light or in a shadow, in standard deviations; possible (H, W):
    where the mask may grow; jump (H, W): :func:`falls_back`; focal: focal length, pixels.
    """
    scale = focal / 615
    most, deep = max(3, round(REACH * scale)), round(DEEP * scale)
    result = mask.copy()
    wide = cv2.dilate(mask.view(np.uint8), np.ones((5, 5), np.uint8))
    _, regions, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    judged = []
    for number, (x, y, w, h, _) in enumerate(stats[1:], 1):
        margin = 3 * most
        cut = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        mine = mask[cut] & (regions[cut] == number)
        others = mask[cut] & ~mine
        # What lies farther around than smear reaches, be it the table or the room behind it, is not the thing's either.
        beyond = cv2.dilate(mine.view(np.uint8), np.ones((2 * most + 7,) * 2, np.uint8)) == 0
        near = _Near(mine, lab[cut], depth[cut], unlike[cut], table[cut] | (beyond & ~others), possible[cut] & ~others, jump[cut])
        told = _told(near, most, deep)
        if told is not None:
            judged.append((cut, near, told))
    reach = _width([told for _, _, told in judged], most)
    for cut, near, told in judged:
        result[cut][near.mine] = False
        result[cut] |= _judged(near, told, reach, most, deep)
    return result, reach <= SHARP < most


@dataclass(frozen=True)
class _Near:
    """One region of a mask in its window, and what :func:`cleared` is told there; ``around``: what is surely not the thing."""

    mine: NDArray[np.bool_]
    lab: NDArray[np.uint8]
    depth: NDArray[np.float32]
    unlike: NDArray[np.float32]
    around: NDArray[np.bool_]
    possible: NDArray[np.bool_]
    jump: NDArray[np.bool_]


@dataclass(frozen=True)
class _Told:
    """Of one region in its window: log of how much likelier each pixel's colour is around the thing than on it; its distance from the
    outside, pixels; for pixels of the outline past which depth falls back how far the first pixel surely of the thing's colour lies behind
    them, where there is an edge of colour; whether past each pixel's nearest outline depth goes on; the region's own pixels that are
    clearly not the table's; and where there is an edge of colour beside."""

    field: NDArray[np.float32]
    within: NDArray[np.float32]
    widths: NDArray[np.float32]
    goes_on: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    apart: NDArray[np.bool_]


def _told(near: _Near, most: int, deep: int) -> _Told | None:
    """What colour and depth tell of a region; ``None`` where they tell too little."""
    mine = near.mine
    if np.count_nonzero(mine) < SAMPLE or np.count_nonzero(near.around) < SAMPLE:
        return None
    index = _index(near.lab)
    ground = _shaded(near.lab, index, near.around)
    padded = np.pad(mine, 1)
    within = cv2.distanceTransform(padded.view(np.uint8), cv2.DIST_L2, 3)
    nearest = cv2.distanceTransformWithLabels(padded.view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    firm = np.zeros(int(nearest.max()) + 1, bool)
    firm[nearest[padded & (within < 1.5) & ~np.pad(near.jump, 1)]] = True
    within, goes_on = within[1:-1, 1:-1], np.take(firm, nearest[1:-1, 1:-1])

    def field(own: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Log of how much likelier each pixel's colour is around the thing than on it, of which ``own`` is a sample."""
        return cv2.blur(np.take(np.log((ground + FLAT) / (_density(index[own]) + FLAT)), index), (3, 3))

    inner = mine & (within > min(most, 0.6 * float(within.max())))
    other = inner & (near.unlike >= LIKE)
    first = field(other if np.count_nonzero(other) > max(SAMPLE, 0.3 * np.count_nonzero(inner)) else inner)
    # What looks like the table near the edge says nothing of the thing's own colours.
    sure = mine & ~((first > TABLE) & (within < deep))
    if np.count_nonzero(sure) < 0.3 * np.count_nonzero(mine):
        return None
    told = field(sure)
    # Of a region of many things each has a small part of the histogram, so that colour that is not the table's even in a shadow is clear as
    # well.
    clear = mine & ((told < -APART) | (near.unlike >= LIKE))
    count, share = (
        cv2.blur(x.astype(np.float32), (2 * most + 5,) * 2, borderType=cv2.BORDER_CONSTANT)
        for x in (mine & ~((told > TABLE) & (near.unlike < LIKE)), clear)
    )
    apart = share > MOST * count
    edge = near.jump & mine & apart & (within < 1.5) & (cv2.dilate((~mine & (told > TABLE)).view(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    own = cv2.distanceTransform((~(mine & (told < -THING))).view(np.uint8), cv2.DIST_L2, 3)
    return _Told(told, within, own[edge], goes_on, clear, apart)


def falls_back(mask: NDArray[np.bool_], depth: NDArray[np.float32], focal: float) -> NDArray[np.bool_]:
    """Pixels (H, W) of a mask beyond whose nearest outline depth falls back, or is mostly missing: only there does stereo carry it past an
    edge.

    Where a thing meets the table towards the camera depth goes on.
    """
    size = (2 * BESIDE + 1,) * 2
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    cut = (slice(max(y - BESIDE, 0), y + h + BESIDE), slice(max(x - BESIDE, 0), x + w + BESIDE))
    own, z = mask[cut], depth[cut]
    seen = ~own & np.isfinite(z)
    far = cv2.dilate(np.where(seen, z, np.float32(0)).astype(np.float32), np.ones(size, np.uint8))
    far[cv2.blur(seen.astype(np.float32), size) < 0.5 * cv2.blur((~own).astype(np.float32), size)] = np.inf
    # Beyond the picture's border nothing is known.
    within, nearest = cv2.distanceTransformWithLabels(np.pad(own, 1).view(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    outside = ~np.pad(own, 1)
    table = np.empty(int(nearest.max()) + 1, np.float32)
    table[nearest[outside]] = np.pad(far, 1, constant_values=np.inf)[outside]
    result = np.zeros_like(mask)
    with np.errstate(invalid="ignore"):
        result[cut] = own & ~(np.take(table, nearest[1:-1, 1:-1]) - z < STEP + within[1:-1, 1:-1] * z / focal)
    return result


def _width(told: list[_Told], most: int) -> int:
    """How far smear reaches in a picture, pixels, at most ``most``: where the thing's colour begins behind most of the outlines past which
    depth falls back."""
    widths = np.concatenate([t.widths for t in told]) if told else np.zeros(0)
    widths = widths[widths <= 2 * most]
    if len(widths) < LEAST:
        return most
    return int(np.clip(np.ceil(np.percentile(widths, 75)) + 2, SHARP, most))


def _judged(near: _Near, told: _Told, reach: int, most: int, deep: int) -> NDArray[np.bool_]:
    """The region as colour has it."""
    mine = near.mine
    kept = mine & ~_smeared(near, told, reach, most, deep)
    # Grow step by step, so that nothing is reached across the table.
    like = near.possible & ~mine & (told.field < -THING)
    grown = kept
    for _ in range(most):
        grown = grown | (cv2.dilate(grown.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool) & like)
    return grown | _enclosed(like & ~grown & np.isfinite(near.depth), grown)


def _smeared(near: _Near, told: _Told, reach: int, most: int, deep: int) -> NDArray[np.bool_]:
    """Of a region's pixels those that colour gives to the table: a rim of it no wider than smear is, and holes, which depth shows hollow or
    nothing can tell from the table."""
    within = told.within
    empty = near.mine & (told.field > TABLE) & (near.unlike < LIKE)
    outside = cv2.dilate((~near.mine).view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    removed = np.zeros_like(empty)
    _, parts, stats, _ = cv2.connectedComponentsWithStats(empty.view(np.uint8), connectivity=4)
    for i, (x, y, w, h, area) in enumerate(stats[1:], 1):
        if area < LEAST:
            continue
        cut = (slice(max(y - 4, 0), y + h + 4), slice(max(x - 4, 0), x + w + 4))
        part = parts[cut] == i
        ring = (cv2.dilate(part.view(np.uint8), np.ones((7, 7), np.uint8)) > 0) & near.mine[cut] & ~empty[cut]
        if (
            np.count_nonzero(ring) >= LEAST
            and float(told.clear[cut][ring].mean()) > MOST
            and float(within[cut][part].max()) < deep
            and float(told.field[cut][part].mean()) >= HOLE
            and (_hollow(near, part, ring, cut) or float(np.median(near.unlike[cut][part])) < SAME)
            and not _sticks_out(near, parts == i, empty, 2 * most)
            and (not _stands(told, part, cut, reach) or _sunk(near, part, ring, cut, empty))
        ):
            removed[cut] |= part
    # A surface of the table's colour that goes on farther than smear reaches is the thing's own.
    own = _around(empty & ~removed & (within > reach + 1), reach + 1)
    return removed | connected(empty & (within <= reach) & near.jump & told.apart & ~own, outside)


def _hollow(near: _Near, part: NDArray[np.bool_], ring: NDArray[np.bool_], cut: tuple[slice, slice]) -> bool:
    """Whether depth shows a patch of the table's colour in a region hollow, within the ring of the region's own about it, or is missing
    there."""
    inside, rim = part & np.isfinite(near.depth[cut]), ring & np.isfinite(near.depth[cut])
    if np.count_nonzero(inside) < 0.7 * np.count_nonzero(part):
        return True
    if np.count_nonzero(rim) <= 8:
        return False
    # Behind its rim, and more so than a slope explains.
    back = float(np.median(near.depth[cut][inside]) - np.median(near.depth[cut][rim]))
    return back > HOLLOW and float(np.median(_from_plane(near.depth[cut], rim, inside))) > HOLLOW


def _sunk(near: _Near, part: NDArray[np.bool_], ring: NDArray[np.bool_], cut: tuple[slice, slice], empty: NDArray[np.bool_]) -> bool:
    """Whether a patch of the table's colour has the region's own colours all around, as no face has that meets the table, and depth lies
    behind theirs, if only by as much as is left of a hole that it fills."""
    border = (cv2.dilate(part.view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~part
    inside, rim = part & np.isfinite(near.depth[cut]), ring & np.isfinite(near.depth[cut])
    if float((near.mine[cut] & ~empty[cut])[border].mean()) < CLOSED or np.count_nonzero(rim) <= 8 or not inside.any():
        return False
    return float(np.median(_from_plane(near.depth[cut], rim, inside))) > SHALLOW


def _stands(told: _Told, part: NDArray[np.bool_], cut: tuple[slice, slice], reach: int) -> bool:
    """Whether a patch of the table's colour reaches farther in than smear does from outlines past most of which depth goes on: a face that
    meets the table towards the camera.  Past a bar, and beside the hole that it encloses, depth falls back."""
    deep = part & (told.within[cut] > reach + 1)
    return np.count_nonzero(deep) >= LEAST and float(told.goes_on[cut][deep].mean()) > STANDS


def _sticks_out(near: _Near, part: NDArray[np.bool_], empty: NDArray[np.bool_], away: int) -> bool:
    """Whether a patch of the table's colour (H, W) has more of the open than of the region around it, is even, lies before what is there,
    and reaches more than ``away`` pixels from all that is of the thing's own colours, farther than depth is carried: the end of a wooden
    handle on a wooden table."""
    x, y, w, h = cv2.boundingRect(part.view(np.uint8))
    cut = (slice(max(y - away - 1, 0), y + h + away + 1), slice(max(x - away - 1, 0), x + w + away + 1))
    here, mine, depth = part[cut], near.mine[cut], near.depth[cut]
    ring = (cv2.dilate(here.view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~here
    seen = here & np.isfinite(depth)
    far = seen & ~_around(mine & ~empty[cut], away)
    beside = _around(here, BESIDE) & ~mine & np.isfinite(depth)
    if np.count_nonzero(far) < LEAST or np.count_nonzero(beside) < LEAST or float((ring & ~mine).sum()) <= OPEN * float(ring.sum()):
        return False
    # Towards the camera the table begins where the thing ends.  Depth that is carried from one thing to another is a ramp.
    before = float(np.percentile(depth[beside], 75) - np.median(depth[far])) > STEP
    return before and float(np.median(np.abs(_from_plane(depth, seen, seen)))) < EVEN


def _from_plane(depth: NDArray[np.float32], of: NDArray[np.bool_], at: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How far pixels ``at`` lie behind the plane through those ``of``, m: of a plane the inverse depth is linear in the picture."""

    def rows(where: NDArray[np.bool_]) -> NDArray[np.float64]:
        v, u = np.nonzero(where)
        return np.column_stack([u, v, np.ones(len(u))])

    plane = np.linalg.lstsq(rows(of), 1 / depth[of].astype(float), rcond=None)[0]
    return np.asarray(depth[at] - 1 / np.maximum(rows(at) @ plane, 1e-3))


def _around(mask: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """What lies within ``reach`` pixels of a mask."""
    return mask if not mask.any() else cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 3) <= reach


def _enclosed(like: NDArray[np.bool_], mask: NDArray[np.bool_], share: float = 0.6) -> NDArray[np.bool_]:
    """The regions of ``like`` whose border lies on the mask by at least that share: the floor of a bowl, which is as low as the table."""
    result = np.zeros_like(mask)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(like.view(np.uint8), connectivity=4)
    beside = np.pad(mask, 1)
    for i in range(1, count):
        x, y, w, h, area = stats[i]
        if area < LEAST:
            continue
        part = np.pad(parts[y : y + h, x : x + w] == i, 1)
        rim = (cv2.dilate(part.view(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~part
        if float(beside[y : y + h + 2, x : x + w + 2][rim].mean()) >= share:
            result[y : y + h, x : x + w] |= part[1:-1, 1:-1]
    return result


#: Of a pixel whose depth is not the thing's: its own largest height over the table, and that which the mask has nearby at least, m; pixels.
LOW, HIGH, NEARBY = 0.008, 0.030, 6
#: A bar up to so many pixels wide has the depth of what is behind it mixed into its own; there a fall of so many metres nearby is none of
#: the bar's.
BAR, FALL = 11, 0.015


def behind(mask: NDArray[np.bool_], heights: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels (H, W) of a mask at which depth shows the table behind the thing: at a thin bar the background's depth may win.

    heights (H, W) metres above the table.  They are as low as the table where the thing is high all around, or fall off in a thin bar.
    """
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    result = np.zeros_like(mask)
    if w == 0:
        return result
    cut = (slice(y, y + h), slice(x, x + w))
    zero = np.where(mask[cut] & np.isfinite(heights[cut]), heights[cut], np.float32(0))
    around = cv2.dilate(zero, np.ones((2 * NEARBY + 1,) * 2, np.uint8))
    within = cv2.distanceTransform(np.pad(mask[cut], 1).view(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    bar = mask[cut] & ~_around(within > BAR / 2, BAR / 2)
    with np.errstate(invalid="ignore"):
        low = (heights[cut] < LOW) & (around > HIGH)
        result[cut] = mask[cut] & (low | (bar & (heights[cut] < around - FALL)))
    return result


#: A thing lies so far behind another, m, that a depth between theirs is told to be nearer to the one or the other.
APART_IN_DEPTH = 0.03


def before(mask: NDArray[np.bool_], others: NDArray[np.bool_], depth: NDArray[np.float32], focal: float) -> NDArray[np.bool_]:
    """Pixels of a mask (H, W) that have the depth of something before the thing, carried past that one's edge.

    others (H, W): other things; depth (H, W) metres; focal: focal length, pixels.
    """
    reach = max(3, round(REACH * focal / 615))
    result = np.zeros_like(mask)
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    cut = (slice(max(y - reach, 0), y + h + reach), slice(max(x - reach, 0), x + w + reach))
    mine, measured = mask[cut], depth[cut]
    if not others[cut].any():
        return result
    around = np.ones((2 * reach + 1,) * 2, np.uint8)
    nearest = cv2.erode(np.where(others[cut] & np.isfinite(measured), measured, np.float32(np.inf)), around)
    inner = mine & np.isinf(nearest) & np.isfinite(measured)
    if not inner.any() or not (mine & np.isfinite(nearest)).any():
        return result
    _, index = cv2.distanceTransformWithLabels((~inner).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value = np.zeros(int(np.count_nonzero(inner)) + 1, np.float32)
    value[index[inner]] = measured[inner]
    own = np.take(value, index)
    with np.errstate(invalid="ignore"):
        result[cut] = mine & (own - nearest > APART_IN_DEPTH) & (measured < 0.75 * own + 0.25 * nearest)
    return result
