"""Which pixels are of things on the table, by depth and the table's colour together: no table, shadow or smear, nothing that is known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_perception import clusters, smear
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pixels import where, window

#: What spans more than this share of the picture (a tray's rim, a wall) encloses the table itself.
ENCLOSING = 0.2
#: Pixels so near to a mask's edge are judged anew by the two colours at it.
FATTENED = 3


def masked_mean(values: NDArray[np.float32], weights: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean of values over a size x size window, counting only where weights are, and the share of the window that counts."""
    share = cv2.blur(weights, (size, size), borderType=cv2.BORDER_CONSTANT)
    total = cv2.blur(values * (weights[..., None] if values.ndim == 3 else weights), (size, size), borderType=cv2.BORDER_CONSTANT)
    safe = np.maximum(share, 1e-6)
    return total / (safe[..., None] if values.ndim == 3 else safe), share


def masked_mean_at(
    values: NDArray[np.float32], weights: NDArray[np.float32], size: int, where: tuple[NDArray, NDArray]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """:func:`masked_mean` of values (H, W, C) at some pixels only: (N, C) and (N,)."""
    share = cv2.blur(weights, (size, size), borderType=cv2.BORDER_CONSTANT)[where]
    total = cv2.blur(values * weights[..., None], (size, size), borderType=cv2.BORDER_CONSTANT)[where]
    return total / np.maximum(share, np.float32(1e-6))[:, None], share


def open_by_two(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Morphological opening by 2 x 2 pixels; with OpenCV's own even kernels the mask would move by a pixel."""
    kernel = np.ones((2, 2), np.uint8)
    return cv2.dilate(cv2.erode(mask.astype(np.uint8), kernel, anchor=(0, 0)), kernel, anchor=(1, 1)) > 0


def _total(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sum over three channels, which numpy's own sum does slowly along a short axis."""
    return values[..., 0] + values[..., 1] + values[..., 2]


#: How dark a shadow is at the darkest, in the lightness of what lies in it.
DARKEST = 0.45


def color_distance(lab: NDArray[np.uint8], table: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How far each pixel's colour (``lab``, (H, W, 3): :func:`magic_perception.smear.softened`) is from the table's around it, in squared
    standard deviations, and the same where darkness may be a shadow's (both (H, W)).

    The table's colour and its spread are local means over the pixels of ``table``: a wooden grain has a large
    spread, so nothing stands out from it lightly.
    """
    small = cv2.resize(lab, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32)
    weights = (cv2.resize(table.astype(np.float32), small.shape[1::-1], interpolation=cv2.INTER_AREA) > 0.99).astype(np.float32)
    mean, share = masked_mean(small, weights, 31)
    variance, _ = masked_mean((small - mean) ** 2, weights, 31)
    far = share < 0.05
    if weights.sum() > 50:
        whole = small[weights > 0]
        mean[far], variance[far] = whole.mean(axis=0), whole.var(axis=0)
    size = lab.shape[1::-1]
    # Floor: 3 grey levels of noise in lightness, 2 in colour.
    weight = 1 / (variance + np.array([9.0, 4.0, 4.0], np.float32))
    distance, shaded = np.zeros(lab.shape[:2], np.float32), np.zeros(lab.shape[:2], np.float32)
    for channel in range(3):
        here, scale = cv2.resize(mean[..., channel], size), cv2.resize(weight[..., channel], size)
        offset = cv2.subtract(cv2.extractChannel(lab, channel), here, dtype=cv2.CV_32F)
        if channel == 0:
            shade = np.minimum(1 + offset / np.maximum(here, 1), 1)
            light = np.where(shade > DARKEST, np.maximum(offset, 0), offset)
            cv2.accumulateProduct(light * light, scale, shaded)
        else:
            # In a shadow both colour axes shrink with the lightness.
            less = offset + (1 - shade) * (here - 128)
            cv2.accumulateProduct(less * less, scale, shaded)
        offset *= offset
        cv2.accumulateProduct(offset, scale, distance)
    return distance, shaded


#: From so many squared standard deviations on a colour is another than the table's, and where no shadow would explain it one that may be.
OTHER, FAINT = 25.0, 9.0
#: The strip in which a thing is mirrored at its foot and has its depth carried to is so many pixels wide at most, at a focal length of 615.
MIRRORED = 12


def notice(distance: NDArray[np.float32], sample: NDArray[np.int64]) -> float:
    """What the distance (H, W) of 99.7 % of a ``sample`` of the table (N,) stays below."""
    return float(np.percentile(np.take(distance, sample), 99.7))


def lifted(other: NDArray[np.bool_], looked: Looked, zero: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W): pixels of another colour (``other``) around which those of another colour are a little above the table on the average of a
    window: a thin thing.  A shadow or a print lies at 0.  ``zero``: heights, m, 0 without depth."""
    near = other & np.isfinite(looked.heights) & (zero < 0.03)
    total = cv2.blur(np.where(near, looked.raw, np.float32(0)), (9, 9), borderType=cv2.BORDER_CONSTANT)
    share = cv2.blur(near.astype(np.float32), (9, 9), borderType=cv2.BORDER_CONSTANT)
    return other & (share * np.float32(81) > 8) & (total > share * np.maximum(np.float32(0.0015), looked.sigma * np.float32(1.2)))


#: What is of a faintly other colour is so many metres above the table as a whole, so many times the noise of one pixel, and so many times
#: that of the mean; noise is alike in so many pixels.
PLATE, ABOVE, SURE, GRAIN = 0.002, 1.2, 5.0, 25.0


def _plates(faint: NDArray[np.bool_], core: NDArray[np.bool_], looked: Looked) -> NDArray[np.bool_]:
    """(H, W): what is of a colour not far from the table's (``faint``) but above it as a whole: a flat thing whose own pixels are as low as
    the noise.

    It is broader than the strip in which a thing of the ``core`` (H, W) is mirrored at its foot, to which depth is carried.
    """
    size = 2 * round(0.5 * MIRRORED * looked.frame.intrinsics.fx / 615) + 1
    broad = cv2.morphologyEx((faint | core).view(np.uint8), cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    beside, result = broad.view(bool) & ~core, np.zeros_like(core)
    if np.count_nonzero(beside) < size**2:
        return result
    _, regions, stats, _ = cv2.connectedComponentsWithStats(beside.view(np.uint8), connectivity=4)
    for label, (x, y, w, h, area) in enumerate(stats[1:], 1):
        if area < size**2:
            continue
        cut = (slice(y, y + h), slice(x, x + w))
        mine = regions[cut] == label
        # Broad without the core, whose fringe it may be.
        if cv2.distanceTransform(np.pad(mine, 1).view(np.uint8), cv2.DIST_L2, 3).max() < size // 2:
            continue
        heights, noise = looked.raw[cut][mine], float(np.median(looked.sigma[cut][mine]))
        heights = heights[np.isfinite(heights)]
        error = noise * np.sqrt(GRAIN / max(len(heights), 1))
        if 2 * len(heights) > area and float(heights.mean()) > max(PLATE, ABOVE * noise, SURE * error):
            result[cut] |= mine
    return result


#: What is so high, m, shades and mirrors itself beside its foot.
TALL = 0.012


def _beyond(raised: NDArray[np.bool_], looked: Looked) -> NDArray[np.bool_]:
    """(H, W): what is beyond the strip in which something tall of what is ``raised`` is mirrored, shades the table and has its depth
    carried to."""
    with np.errstate(invalid="ignore"):
        low = ~(raised & (looked.heights > TALL))
    return cv2.distanceTransform(low.view(np.uint8), cv2.DIST_L2, 3) > MIRRORED * looked.frame.intrinsics.fx / 615 + 1


#: The rest of a thing of which parts are seen to be higher than the noise is as a whole so many metres above the table beside it.
LOW_REST = 0.0015
#: The table beside it is what is so many pixels from it, at a focal length of 615.
RING = (6, 18)
#: It tells its height where it has so many pixels.
RING_PIXELS = 100


def _rest(
    vivid: NDArray[np.bool_],
    core: NDArray[np.bool_],
    raised: NDArray[np.bool_],
    beyond: NDArray[np.bool_],
    table: NDArray[np.bool_],
    looked: Looked,
) -> NDArray[np.bool_]:
    """(H, W): what goes on from the ``core`` in a colour that no shadow makes of the table's (``vivid``), lower than the noise of a
    pixel, and is above the table as a whole.

    Of a thin thing noise lifts a part here and there, and what those alone tell is none of its shape.  A print on the table has no
    height, and a strip no wider than that in which a thing is mirrored and shades the table at its foot tells nothing.
    """
    result = np.zeros_like(core)
    high = cv2.dilate(raised.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
    more = vivid & ~core & ~high & beyond
    if not more.any():
        return result
    _, regions, stats, _ = cv2.connectedComponentsWithStats(((vivid | core) & ~high).view(np.uint8), connectivity=8)
    touched = cv2.dilate(core.view(np.uint8), np.ones((5, 5), np.uint8)).view(bool)
    scale = looked.frame.intrinsics.fx / 615
    margin = round(RING[1] * scale) + 1
    for label in np.intersect1d(regions[more], regions[touched & (regions > 0)]):
        x, y, w, h, _ = stats[label]
        cut = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        mine = regions[cut] == label
        far = mine & beyond[cut]
        apart = cv2.distanceTransform((~mine).view(np.uint8), cv2.DIST_L2, 3)
        beside = table[cut] & ~touched[cut] & (apart > RING[0] * scale) & (apart < RING[1] * scale)
        heights, ground = (looked.raw[cut][where & np.isfinite(looked.raw[cut])] for where in (far, beside))
        if 2 * len(heights) <= np.count_nonzero(far) or len(ground) < RING_PIXELS:
            continue
        error = float(np.median(looked.sigma[cut][mine])) * np.sqrt(GRAIN / len(heights) + GRAIN / len(ground))
        if float(heights.mean() - ground.mean()) > max(LOW_REST, SURE * error):
            result[cut] |= mine
    return result


#: A colour is a thing's where it is so many times as frequent on what is seen to be of things as on the table (logarithm).
FREQUENT = 2.5
#: What is seen to be of things tells its colours where it has so many pixels.
SEEDS = 60


def _own_colors(lab: NDArray[np.uint8], low: NDArray[np.bool_], table: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W): what has the colours of parts of thin things that are seen to be above the table (``low``), which hardly anything else of
    the table has; lab (H, W, 3).

    The rest of such a thing is lower than the noise, and taken for the table it would hide the thing from all that compares with the
    table's colours.
    """
    return table & (smear.likelier(lab, low, table) > FREQUENT)


def foreground(looked: Looked, parameters: Parameters) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(H, W): pixels of things on the table: higher than the noise, or of another colour than the table and not lying in it; and (H, W)
    those of the table's colour, in the light or in a shadow."""
    h, inside = looked.heights, looked.open
    valid = np.isfinite(h)
    zero = np.where(valid, h, np.float32(0))
    limit = np.maximum(np.float32(parameters.min_height), np.float32(4.0) * looked.sigma)
    high = (zero > limit) & inside
    raised = cv2.morphologyEx(high.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).view(bool)
    if not parameters.use_color:
        return raised, np.zeros_like(raised)
    around = cv2.dilate(raised.view(np.uint8), np.ones((9, 9), np.uint8)).view(bool)
    table = _outside(valid & (np.abs(zero) < limit) & inside & ~around, raised)
    if np.count_nonzero(table) < 500:
        return raised, np.zeros_like(raised)

    lab = smear.softened(looked.frame.color)
    beyond = _beyond(raised, looked)

    def seen(table: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """What is surely of things, what has another colour than the table, and how far from the table's all colours are, in the light
        and in a shadow."""
        distance, shaded = color_distance(lab, table)
        sample = np.flatnonzero(table)[::7]
        other = (distance > max(OTHER, notice(distance, sample))) & inside
        unshaded = notice(shaded, sample)
        core = raised | lifted(other, looked, zero)
        core |= _plates((shaded > max(FAINT, unshaded)) & (distance > FAINT) & inside, core, looked)
        core |= _rest(other & (shaded > max(OTHER, unshaded)), core, raised, beyond, table, looked)
        return core, other, distance, shaded

    core, other, distance, shaded = seen(table)
    low = core & beyond
    if np.count_nonzero(low) >= SEEDS and np.count_nonzero(low := _outside(low, raised)) >= SEEDS:
        own = table & _rest(_own_colors(lab, low, table), low, raised, beyond, table, looked)
        # Where most of a thing is seen nothing of the table has to be told anew.
        if np.count_nonzero(own) > np.count_nonzero(low):
            table &= ~own
            core, other, distance, shaded = seen(table)
    depth, focal = looked.frame.depth, looked.frame.intrinsics.fx

    def of(core: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_], bool]:
        """The mask by what is surely of things, what of it stays whatever its colour, and whether depth is not carried past edges."""
        # Grow into pixels without depth that have another colour and touch what is there.
        result = clusters.connected(core | (other & ~valid), core)
        result = _fill_bowls(result, looked, other, parameters)
        # Where depth goes on beyond a thing's edge it was not carried there.
        firm = result & ~(jump := smear.falls_back(result, depth, focal))
        result, sharp = smear.cleared(result, lab, depth, table, shaded, inside & (distance > 9), jump, focal)
        return result, firm, sharp

    result, firm, sharp = of(core)
    # What is high at the rim of a thing of the table's colour is its own where depth is not carried there.
    if sharp and np.any((closed := _closed(high, inside & ~valid, other)) & ~core):
        result, firm, _ = of(core | closed)
    result = _two_colors(result, looked, table, firm)
    return open_by_two(result), shaded < smear.LIKE


#: A gap in depth of so many pixels is closed, in what is somewhere broader than the second.
GAP, SLIVER = 5, 7


def _closed(high: NDArray[np.bool_], missing: NDArray[np.bool_], other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What is high (H, W), and the gaps in its depth (``missing``), of things that have mostly the table's colour (are not of another one,
    ``other``).

    At edges every other pixel loses its depth, and there colour does not tell that it is the thing's.  Beside a sliver, as stereo leaves at
    the far edge of a board, nothing is closed.
    """
    closing = cv2.morphologyEx(high.view(np.uint8), cv2.MORPH_CLOSE, np.ones((GAP, GAP), np.uint8)).view(bool)
    closed = cv2.morphologyEx((high | (missing & closing)).view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    broad = cv2.erode(closed, np.ones((SLIVER, SLIVER), np.uint8)) > 0
    count, regions = cv2.connectedComponents(closed, connectivity=8)
    size, told, inner = (np.bincount(regions[where], minlength=count) for where in (closed > 0, other, broad))
    plain = (inner > 0) & (told < 0.5 * size)
    plain[0] = False
    return np.take(plain, regions) & ~other


def _outside(table: NDArray[np.bool_], raised: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The table, or what else (H, W), without what lies in the convex hull of something raised: the floor of a bowl is as low as the table,
    but has the bowl's colour.

    What spans more than :data:`ENCLOSING` of the picture (a tray's rim, a wall) encloses the table itself.
    """
    covered = np.zeros(table.shape, np.uint8)
    outlines, _ = cv2.findContours(raised.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    for outline in outlines:
        hull = cv2.convexHull(outline)
        if cv2.contourArea(hull) < ENCLOSING * table.size:
            cv2.fillConvexPoly(covered, hull, 1)
    return table & (covered == 0)


def _fill_bowls(mask: NDArray[np.bool_], looked: Looked, other: NDArray[np.bool_], parameters: Parameters) -> NDArray[np.bool_]:
    """Fill holes of a mask that are not the table: of another colour, or a little higher (the floor of a spoon's bowl is a few mm up)."""
    result, cut = mask.copy(), window(mask)
    outside = np.pad((~mask[cut]).view(np.uint8), 1, constant_values=1)
    cv2.floodFill(outside, None, (0, 0), 2)
    holes = (outside[1:-1, 1:-1] == 1).view(np.uint8)
    if not holes.any():
        return result
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < 12
    small[0] = False
    result[cut] |= np.take(small, labels)
    for i in np.flatnonzero(~small)[1:]:
        x, y, w, h, _ = stats[i]
        part = labels[y : y + h, x : x + w] == i
        around = (slice(cut[0].start + y, cut[0].start + y + h), slice(cut[1].start + x, cut[1].start + x + w))
        if other[around][part].mean() > 0.7:
            result[around] |= part
            continue
        heights = looked.raw[around][part]
        heights = heights[np.isfinite(heights)]
        # The fewer that are raised one by one are smear of the hole's rim: they tell nothing of its floor.
        high = heights > max(parameters.min_height, 4.0 * float(np.median(looked.sigma[around][part])))
        heights = heights[~high] if 2 * np.count_nonzero(high) <= len(heights) else heights
        if len(heights) > 15:
            # Standard error of the middle of a hole, for noise that is correlated over some 5 pixels.
            error = float(np.median(looked.sigma[around][part])) * 3.0 / np.sqrt(len(heights) / 5)
            if np.median(heights) > max(0.0012, 3 * error):
                result[around] |= part
    return result


def _two_colors(mask: NDArray[np.bool_], looked: Looked, table: NDArray[np.bool_], firm: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Move a mask's edge to where the colour is half way between the thing's and the table's next to it.

    Depth fattens edges by some pixels and a threshold on colour by one; pixels within :data:`FATTENED` of the edge are judged
    anew by the share of the thing's colour in theirs, wherever the two colours differ enough to tell; those of ``firm`` (H, W) stay.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * FATTENED + 1, 2 * FATTENED + 1))
    # The means look at most 15 pixels around, so that what lies farther off changes nothing.
    margin = 16
    result, things = mask.copy(), window(mask, FATTENED + margin)
    own, table, firm, open_, heights, color = (
        picture[things] for picture in (mask, table, firm, looked.open, looked.heights, looked.frame.color)
    )
    if own.size == 0:
        return mask
    small = own.view(np.uint8)
    wide = cv2.dilate(small, kernel)
    band = (wide > 0) & ~(cv2.erode(small, kernel) > 0) & open_
    if not band.any():
        return mask
    inner = (cv2.erode(small, np.ones((3, 3), np.uint8)) > 0).astype(np.float32)
    # A thread of two pixels has no inside: its own pixels stand for it.
    thin = own & (cv2.dilate(inner, np.ones((7, 7), np.uint8)) == 0)
    inner[thin] = 1.0
    free = (table & ~(cv2.dilate(small, np.ones((5, 5), np.uint8)) > 0)).astype(np.float32)
    moved = result[things]
    # Each thing in its own window.
    _, _, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    for x, y, w, h, _ in stats[1:]:
        r0, c0 = max(y - margin, 0), max(x - margin, 0)
        cut = (slice(r0, y + h + margin), slice(c0, x + w + margin))
        lab = cv2.cvtColor(np.ascontiguousarray(color[cut]), cv2.COLOR_RGB2LAB).astype(np.float32)
        near = np.zeros(lab.shape[:2], bool)
        middle = (slice(y - r0, y - r0 + h), slice(x - c0, x - c0 + w))
        near[middle] = band[cut][middle]
        spots = where(near)
        thing, share = masked_mean_at(lab, inner[cut], 13, spots)
        ground, ground_share = masked_mean_at(lab, free[cut], 31, spots)
        difference = thing - ground
        length = _total(difference**2)
        offset = lab[spots] - ground
        part = _total(offset * difference) / np.maximum(length, 1.0)
        # A pixel on the edge has a mixture of the two colours; a third colour (a side in the shade) tells nothing.
        rest = _total((offset - part[..., None] * difference) ** 2)
        before = own[cut][spots]
        told = ~(firm[cut][spots] & before) & ((rest < 9.0**2) | ~before) & (length > 15.0**2) & (share > 0.02) & (ground_share > 0.05)
        # Grow only into what depth does not contradict, and by what touches the mask.
        with np.errstate(invalid="ignore"):
            possible = ~(heights[cut][spots] <= -0.006)
        moved[cut][spots] = np.where(told, (part > 0.5) & (before | possible), moved[cut][spots])
    return clusters.connected(result, mask, 8)


def near_known(looked: Looked, mask: NDArray[np.bool_], known: tuple[Mesh, ...], margin: float) -> NDArray[np.bool_]:
    """(H, W): pixels of ``mask`` that belong to known meshes (world): within ``margin`` of them, or seen inside or behind them."""
    result = np.zeros_like(mask)
    if not known:
        return result
    import open3d as o3d

    where = np.nonzero(mask & np.isfinite(looked.heights))
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in known:
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    if len(where[0]):
        points = np.ascontiguousarray(looked.points(*where))
        near = scene.compute_distance(o3d.core.Tensor(points), nthreads=2).numpy() < margin
        eye = looked.frame.world_from_camera[:3, 3].astype(np.float32)
        rays = np.concatenate([np.broadcast_to(eye, points.shape), points - eye], axis=1)
        # t = 1 is the measured point: a hit before it means that the point lies inside of or behind a known thing.
        behind = scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)), nthreads=2)["t_hit"].numpy() < 1.0
        result[where] = near | behind
    # Pixels without depth on the known thing's silhouette.
    rest = mask & ~np.isfinite(looked.heights)
    if rest.any():
        for mesh in known:
            hull = np.concatenate([mesh.vertices])
            pixels = looked.frame.intrinsics.project(transforms.apply(transforms.inverse(looked.frame.world_from_camera), hull))
            if np.all(np.isfinite(pixels)):
                drawn = np.zeros(mask.shape, np.uint8)
                for face in mesh.faces:
                    cv2.fillConvexPoly(drawn, np.clip(pixels[face], -4000, 4000).round().astype(np.int32), 1)
                drawn = cv2.dilate(drawn, np.ones((7, 7), np.uint8)).astype(bool)
                result |= rest & drawn
    return result
