"""Parting touching things at concave seams, after LCCP (Stein et al. 2014), on voxels instead of supervoxels."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception import clusters, seams
from magic_perception.attached import COLOR, shade

#: Points are smoothed over squares of so many pixels, for their normals.
SMOOTHED = 7
#: What stands on another has so many voxels.
LEAST_ON_TOP = 50
#: Two voxels between which the surface bends inward by this angle (degrees) or more are on the two sides of a seam.
CONCAVE = 12.0
#: A part of fewer voxels goes to the nearest other.
LEAST_PIECE = 12


def normals(points: NDArray[np.float32], eye: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) of an organised cloud (H, W, 3), towards the eye, from differences of smoothed points; NaN at gaps and jumps.

    Computed at every second pixel; four pixels share one.
    """
    height, width = points.shape[:2]
    valid = np.isfinite(points[..., 0])
    weight = cv2.blur(valid.astype(np.float32), (SMOOTHED, SMOOTHED))[::2, ::2]
    smooth = cv2.blur(np.where(valid[..., None], points, np.float32(0)), (SMOOTHED, SMOOTHED))[::2, ::2]
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, z = (np.where(weight < 0.6, np.float32(np.nan), smooth[..., axis] / weight) for axis in range(3))
        du, dv = ([np.full_like(x, np.nan) for _ in range(3)] for _ in range(2))
        for axis, field in enumerate((x, y, z)):
            du[axis][:, 2:-2] = field[:, 4:] - field[:, :-4]
            dv[axis][2:-2] = field[4:] - field[:-4]
        normal = [du[1] * dv[2] - du[2] * dv[1], du[2] * dv[0] - du[0] * dv[2], du[0] * dv[1] - du[1] * dv[0]]
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        ex, ey, ez = eye.astype(np.float32)
        away = normal[0] * (x - ex) + normal[1] * (y - ey) + normal[2] * (z - ez) > 0
        # Across a jump in depth there is no surface.
        jump = (du[0] ** 2 + du[1] ** 2 + du[2] ** 2 > 0.05**2) | (dv[0] ** 2 + dv[1] ** 2 + dv[2] ** 2 > 0.05**2)
        scale = np.where(jump, np.float32(np.nan), np.where(away, -1, 1) / length)
        result = np.stack([n * scale for n in normal], axis=-1).astype(np.float32)
    return np.repeat(np.repeat(result, 2, axis=0)[:height], 2, axis=1)[:, :width]


#: The edge of a voxel, and how far the middles of two neighbours are from each other at most, m.
VOXEL, REACH = 0.008, 0.0144


def voxels_of(
    points: NDArray[np.floating],
    normal: NDArray[np.floating],
    heights: NDArray[np.floating],
    rgb: NDArray[np.floating],
    across: NDArray[np.floating] | None = None,
) -> tuple[seams.Voxels, NDArray[np.int64]] | None:
    """The voxels of a cluster and the voxel of each point (N,); ``None`` where no two are neighbours.  points, normal, rgb (N, 3), heights
    (N,), all finite;
    across (L, 2, 3): places on the two sides of gaps in depth: voxels there are neighbours."""
    from scipy.spatial import cKDTree

    centre, index = clusters.thin(points, VOXEL)
    count = np.bincount(index)

    def mean_of(values: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.stack([np.bincount(index, values[:, axis]) for axis in range(3)], axis=1) / count[:, None]

    mean = mean_of(normal)
    length = np.linalg.norm(mean, axis=1)
    mean /= np.maximum(length, 1e-9)[:, None]
    pairs = cKDTree(centre).query_pairs(REACH, output_type="ndarray")
    if len(pairs) == 0:
        return None
    a, b = pairs.T
    d = centre[a] - centre[b]
    d /= np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
    opening = np.sum((mean[a] - mean[b]) * d, axis=1)
    bend = _angle(mean, a, b)
    # A voxel whose normals disagree lies on an edge itself: it tells nothing of convexity.
    clear = (length[a] > 0.8) & (length[b] > 0.8)
    if across is not None:
        p, q, turn, told = _over_gaps(centre, mean, across)
        a, b, opening = (np.concatenate(both) for both in ((a, p), (b, q), (opening, turn)))
        bend = np.concatenate([bend, _angle(mean, p, q)])
        clear = np.concatenate([clear, told & (length[p] > 0.8) & (length[q] > 0.8)])
    return seams.Voxels(centre, mean, np.bincount(index, heights) / count, mean_of(rgb), a, b, opening, bend, clear), index


def _angle(normal: NDArray[np.float64], a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.float64]:
    """Degrees (P,) between the normals (V, 3) of pairs of voxels."""
    return np.degrees(np.arccos(np.clip(np.sum(normal[a] * normal[b], axis=1), -1, 1)))


#: How far the next voxel is from the edge of a gap at most, as normals end some pixels before it, m; by so much, m and as a share of the
#: distance, what lies on one surface may lie before its tangent plane across the gap.
EDGE, BEFORE, RISE = 0.016, 0.003, 0.1


def _over_gaps(
    centre: NDArray[np.float64], normal: NDArray[np.float64], across: NDArray[np.floating]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Pairs of voxels (a, b) on the two sides of gaps; for each 1 where neither lies before the other's tangent plane, so that the surface
    may go on from one to the other without bending inward, else -1; and whether that tells anything: where one lies before and the other
    behind there is a step.

    centre, normal (V, 3); across (L, 2, 3): places on the two sides.
    """
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(centre).query(across)
    a, b = np.unique(np.sort(nearest[np.all(distance < EDGE, axis=1)], axis=1), axis=0).T
    way = centre[b] - centre[a]
    length = np.linalg.norm(way, axis=1)
    a, b, way, length = (values[length > REACH] for values in (a, b, way, length))
    slack = BEFORE + RISE * length
    one, two = np.sum(normal[a] * way, axis=1), -np.sum(normal[b] * way, axis=1)
    step = (np.maximum(one, two) > slack) & (np.minimum(one, two) < -slack)
    return a, b, np.where(np.maximum(one, two) < slack, 1.0, -1.0), ~step


def pieces(voxels: seams.Voxels) -> NDArray[np.int64]:
    """Parts (V,) from 0 of the voxels, cut at every concave seam.

    Two voxels are joined where the surface between them is convex or bent inward by less than :data:`CONCAVE` degrees, over a gap by as
    much on each :data:`REACH` of it, and where at least half of the voxels next to both agree.  A part of fewer than :data:`LEAST_PIECE`
    voxels goes to the nearest other.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    n, a, b = len(voxels.centre), voxels.a, voxels.b
    apart = np.linalg.norm(voxels.centre[a] - voxels.centre[b], axis=1)
    convex = ((voxels.opening > 0) | (voxels.bend < CONCAVE * np.maximum(apart / REACH, 1))) & voxels.clear
    joined = coo_matrix((np.ones(convex.sum()), (a[convex], b[convex])), shape=(n, n)).tocsr()
    joined = joined + joined.T
    near = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    near = near + near.T
    common = np.asarray((near[a].multiply(near[b])).sum(axis=1)).ravel()
    agree = np.asarray((joined[a].multiply(joined[b])).sum(axis=1)).ravel()
    keep = convex & (agree >= 0.5 * common)
    part = connected_components(coo_matrix((np.ones(keep.sum()), (a[keep], b[keep])), shape=(n, n)), directed=False)[1]
    large = np.bincount(part)[part] >= LEAST_PIECE
    if not large.any():
        return np.zeros(n, np.int64)
    nearest = np.nonzero(large)[0][cKDTree(voxels.centre[large]).query(voxels.centre[~large])[1]]
    part[~large] = part[nearest]
    return np.unique(part, return_inverse=True)[1]


#: Voxels of a level face look up to this cosine.
UPWARD = 0.95
#: So many of them lie within so much, m, of its height.
FACE, LEVEL = 30, 0.006
#: Other faces are so far from it, m.
APART = 0.012
#: What stands on it begins so much above it, m, where voxels look up to this cosine, and at its height where they do not.
ABOVE, SIDE = 0.004, 0.8
#: Where it begins such a share of the surface bends inward.
BENT = 0.25
#: A thing that stands beside the face goes on below it: of its lowest part above the face, so high, m, more than such a share...
BAND, GOES_ON = 0.016, 0.3
#: ...has something below the face that lies at most so far aside, m, and differs by no more in colour (R, G, B of 0..1).
ASIDE, PAINT = 0.010, 0.08


def on_tops(voxels: seams.Voxels) -> NDArray[np.int64]:
    """Parts (V,) from 0 of the voxels, cut where something stands on a level face: it hangs together with what bears it where their sides
    lie in one plane, or where its own side is seen before the other's back edge, and no seam bends inward all around."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    part = np.zeros(len(voxels.centre), np.int64)
    for level in _tops(voxels.height[voxels.normal[:, 2] > UPWARD]):
        above = (part == 0) & (voxels.height > level + np.where(voxels.normal[:, 2] > SIDE, ABOVE, 0.0))
        inner = above[voxels.a] & above[voxels.b]
        link = coo_matrix((np.ones(np.count_nonzero(inner)), (voxels.a[inner], voxels.b[inner])), shape=(len(part), len(part)))
        group = connected_components(link, directed=False)[1]
        for number in np.unique(group[above]):
            upper = above & (group == number)
            told = (upper[voxels.a] != upper[voxels.b]) & voxels.clear
            inward = (voxels.opening[told] < 0) & (voxels.bend[told] > 25)
            bent = np.count_nonzero(inward) > BENT * len(inward)
            if np.count_nonzero(upper) >= LEAST_ON_TOP and bent and _going_on(voxels, (part == 0) & ~upper, upper, level) <= GOES_ON:
                part[upper] = part.max() + 1
    return part


def _going_on(voxels: seams.Voxels, lower: NDArray[np.bool_], upper: NDArray[np.bool_], level: float) -> float:
    """The share of the foot of an upper part (V,) that goes on in its own colour in the lower one (V,) below the level of its face."""
    from scipy.spatial import cKDTree

    foot = upper & (voxels.height < level + BAND)
    under = lower & (voxels.height < level - LEVEL) & (voxels.height > level - LEVEL - BAND)
    if not foot.any() or not under.any():
        return 0.0
    where = np.column_stack([voxels.centre[:, :2] / ASIDE, voxels.rgb / PAINT])
    return float(np.mean(cKDTree(where[under]).query(where[foot], p=np.inf)[0] <= 1))


def _tops(heights: NDArray[np.float64]) -> list[float]:
    """Heights of the level faces among upward voxels (N,), the highest first."""
    found: list[float] = []
    if len(heights) < FACE:
        return found
    count, edges = np.histogram(heights, np.arange(heights.min() - LEVEL, heights.max() + 2 * LEVEL, LEVEL / 2))
    near = np.convolve(count, np.ones(4), "valid")
    for k in np.argsort(-near, kind="stable"):
        if near[k] < FACE:
            break
        level = float(np.median(heights[(heights >= edges[k]) & (heights <= edges[k + 4])]))
        if all(abs(level - other) > APART for other in found):
            found.append(level)
    return sorted(found, reverse=True)


def parts(
    points: NDArray[np.floating],
    normal: NDArray[np.floating],
    heights: NDArray[np.floating],
    rgb: NDArray[np.floating],
    judge: seams.Judge,
    cut: Callable[[seams.Voxels], NDArray[np.int64]] = pieces,
    across: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Labels (N,) from 0 of the things in one cluster: points (N, 3), normals (N, 3), NaN allowed, heights (N,) above the table, colours
    (N, 3), 0..255; ``cut`` makes the parts of its voxels of which the judge tells whether they are things; across (L, 2): points on the two
    sides of gaps in depth."""
    from scipy.spatial import cKDTree

    labels = np.zeros(len(points), np.int64)
    sound = np.isfinite(normal[:, 0]) & np.isfinite(heights)
    if sound.sum() < 200:
        return labels
    made = voxels_of(points[sound], normal[sound], heights[sound], rgb[sound] / 255, None if across is None else points[across])
    if made is None:
        return labels
    voxels, index = made
    part = seams.joined(voxels, cut(voxels), judge)
    labels[sound] = part[index]
    if part.max() > 0 and (~sound).any():
        labels[~sound] = part[cKDTree(voxels.centre).query(points[~sound])[1]]
    return labels


def insides(
    points: NDArray[np.floating], normal: NDArray[np.floating], labels: NDArray[np.int64], heights: NDArray[np.floating]
) -> NDArray[np.int64]:
    """Labels (N,) with the inside of round open things (mugs, bowls, pots) joined to their outside.

    The two surfaces meet at a rim that depth cannot see across.  A part is the inside of another where the other is
    round in plan, the part lies in that circle and below its top, and its upright surfaces look inward.
    """
    from magic_perception.primitives import fit_circle

    labels = labels.copy()
    numbers = [int(i) for i in np.unique(labels) if i >= 0]
    members = {i: np.nonzero(labels == i)[0] for i in numbers}
    members = {i: m[:: max(1, len(m) // 1500)] for i, m in members.items() if len(m) > 60}
    circles = {}
    for i, m in members.items():
        side = m[np.isfinite(normal[m, 0]) & (np.abs(normal[m, 2]) < 0.8)]
        if len(side) < 60:
            continue
        centre, radius = fit_circle(points[side, :2].astype(float))
        away = points[side, :2] - centre
        distance = np.linalg.norm(away, axis=1)
        outward = np.mean(np.sum(normal[side, :2] * away, axis=1) > 0)
        # Bowls widen upwards: the circle is that of their middle, and the rim may reach half as far again.
        if 0.02 < radius < 0.2 and outward > 0.7 and np.percentile(np.abs(distance - radius), 80) < 0.3 * radius:
            circles[i] = (centre, max(radius, float(np.percentile(distance, 90))), float(np.percentile(heights[m], 97)), len(m))
    for i, m in members.items():
        finite = m[np.isfinite(normal[m, 0])]
        best = None
        for j, (centre, radius, top, _) in circles.items():
            if i == j:
                continue
            toward = centre - points[m, :2]
            within = np.mean(np.linalg.norm(toward, axis=1) < 1.1 * radius + 0.005)
            low = np.percentile(heights[m], 90) < top + 0.012
            upright = finite[np.abs(normal[finite, 2]) < 0.8]
            inward = (
                np.mean(np.sum(normal[upright, :2] * (centre - points[upright, :2]), axis=1) > 0)
                if len(upright) > 0.2 * len(finite)
                else float(np.median(heights[m]) < 0.6 * top)
            )
            if within > 0.85 and low and inward > 0.75 and (best is None or within > best[0]):
                best = (within, j)
        if best is not None:
            labels[labels == i] = best[1]
    return _outsides(points, normal, labels, heights)


#: Of an inside such a share lies near one circle, to a wall's thickness at its best, m: the rest may be a pen that stands in it.
MOST, WALL = 0.6, 0.004
#: Such a share of it faces the circle's middle.
INWARD = 0.8
#: Of an outside such a share faces away from there, and such a share lies within the rim: the rest may be a handle.
OUTWARD, WITHIN = 0.75, 0.7
#: Its highest points lie at such a share of the rim's radius: depth rounds the near rim off, and the far one outwards.
BESIDE_RIM = 0.75
#: The tops of both are so near each other, m.
AS_HIGH = 0.02


def _walls(normal: NDArray[np.floating], labels: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The upright points of each label that has enough of them, thinned, by their numbers."""
    upright = np.isfinite(normal[:, 0]) & (np.abs(normal[:, 2]) < 0.8)
    members = [np.nonzero((labels == i) & upright)[0] for i in np.unique(labels[labels >= 0])]
    return [m[:: max(1, len(m) // 1500)] for m in members if len(m) > 200]


def _outsides(
    points: NDArray[np.floating], normal: NDArray[np.floating], labels: NDArray[np.int64], heights: NDArray[np.floating]
) -> NDArray[np.int64]:
    """Labels (N,) with the outside of open round things joined to an inside that shows more of their form: of a bowl seen from above little
    but the near wall's lower half is seen from without.

    The inside's upright surfaces look to its own axis; the outside's look away from that, lie within its rim, as high, and end beside it.
    """
    from magic_perception.primitives import fit_circle, likeliest_circle

    members = _walls(normal, labels)
    tops = [float(np.percentile(heights[mine], 97)) for mine in members]
    for mine, top in zip(members, tops, strict=True):
        alike = [m for m, high in zip(members, tops, strict=True) if abs(high - top) < AS_HIGH and labels[m[0]] != labels[mine[0]]]
        if not alike:
            continue
        place = np.column_stack([points[mine, :2], heights[mine]]).astype(float)
        # Of all points alike, and of most of them.
        for circle in (fit_circle(place[:, :2]), likeliest_circle(place, top, WALL, np.random.default_rng(0))):
            if circle is None:
                continue
            centre, radius = circle
            away = points[mine, :2] - centre
            distance = np.linalg.norm(away, axis=1)
            near = np.abs(distance - radius) < 0.3 * radius
            if not 0.02 < radius < 0.2 or near.mean() < MOST or np.mean(np.sum(normal[mine, :2] * away, axis=1) < 0) < INWARD:
                continue
            rim = float(np.percentile(distance[near], 97))
            for other in alike:
                if labels[other[0]] == labels[mine[0]]:
                    continue
                away = points[other, :2] - centre
                far = np.linalg.norm(away, axis=1)
                high = heights[other] >= np.percentile(heights[other], 80)
                if (
                    np.mean(np.sum(normal[other, :2] * away, axis=1) > 0) > OUTWARD
                    and np.mean(far < 1.15 * rim + 0.005) > WITHIN
                    and np.median(far[high]) > BESIDE_RIM * rim
                ):
                    labels[labels == labels[other[0]]] = labels[mine[0]]
    return labels


#: Of a part that has a handle such a share of its upright surfaces at least lies within the other's rim, beside it, and of these such a
#: share faces the other way.
HANDLED, FACING = 0.1, 0.6
#: Parts of one thing are so near each other, m.
TOUCHING = 0.012
#: Of an inside alone, or an outside alone, no more than this share faces otherwise.
ALONE = 0.1


def with_handles(
    points: NDArray[np.floating],
    normal: NDArray[np.floating],
    labels: NDArray[np.int64],
    heights: NDArray[np.floating],
    rgb: NDArray[np.floating],
) -> NDArray[np.int64]:
    """Labels (N,) with the parts of a bowl joined of which one hangs together with a long handle, as those of ladles and pans do.

    A round inside that shows no outside, or a round outside that shows no inside, goes on in a part of the same colour (``rgb``, (N, 3))
    that touches it: in what of that lies beside its rim and faces the other way, or is more of the inside.  :func:`insides` asks it of
    parts that are one side of a bowl alone.
    """
    from scipy.spatial import cKDTree

    from magic_perception.primitives import fit_circle

    labels, members = labels.copy(), _walls(normal, labels)
    shades = [shade(rgb[m]) for m in members]
    for mine, color in zip(members, shades, strict=True):
        alike = [
            m
            for m, other in zip(members, shades, strict=True)
            if np.linalg.norm(color - other) <= COLOR and labels[m[0]] != labels[mine[0]]
        ]
        if not alike:
            continue
        centre, radius = fit_circle(points[mine, :2].astype(float))
        away = points[mine, :2] - centre
        distance = np.linalg.norm(away, axis=1)
        outward = float(np.mean(np.sum(normal[mine, :2] * away, axis=1) > 0))
        if not 0.02 < radius < 0.2 or np.mean(np.abs(distance - radius) < 0.3 * radius) < MOST or ALONE < outward < 1 - ALONE:
            continue
        rim, top = float(np.percentile(distance, 97)), float(np.percentile(heights[mine], 97))
        tree = cKDTree(points[labels == labels[mine[0]]])
        for other in alike:
            if labels[other[0]] == labels[mine[0]]:
                continue
            away = points[other, :2] - centre
            far = np.linalg.norm(away, axis=1)
            within = far < 1.1 * rim
            # What lies in a bowl lies in its middle as well.
            if (
                within.mean() < HANDLED
                or np.median(far[within]) < BESIDE_RIM * rim
                or np.percentile(heights[other][within], 97) > top + 0.012
            ):
                continue
            faces = float(np.mean(np.sum(normal[other[within], :2] * away[within], axis=1) > 0))
            # More of an inside is told by facing the middle: nothing that stands in it by itself does.
            fits = 1 - faces > FACING if outward > 0.5 else faces > FACING or 1 - faces > INWARD
            if fits and tree.query(points[labels == labels[other[0]]])[0].min() < TOUCHING:
                labels[labels == labels[other[0]]] = labels[mine[0]]
    return labels
