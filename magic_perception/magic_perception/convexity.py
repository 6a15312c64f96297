"""Parting touching things at concave seams, after LCCP (Stein et al. 2014), on voxels instead of supervoxels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception import clusters


def normals(points: NDArray[np.float32], eye: NDArray[np.float64], size: int = 7) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) of an organised cloud (H, W, 3), towards the eye, from differences of smoothed points; NaN at gaps and jumps.

    Computed at every second pixel; four pixels share one.
    """
    height, width = points.shape[:2]
    valid = np.isfinite(points[..., 0])
    weight = cv2.blur(valid.astype(np.float32), (size, size))[::2, ::2]
    smooth = cv2.blur(np.where(valid[..., None], points, np.float32(0)), (size, size))[::2, ::2]
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


@dataclass(frozen=True)
class Evidence:
    """What must speak for two things where a concave seam parts one cluster; lengths in metres, angles in degrees.

    A single thing has concave seams too: a handle meets a mug's side, a ladle's stem its bowl, a post its base.  Two parts
    are two things only where the seam is long and sharp, both are bulky, and each could lie there alone: one carries
    the other, or both reach the table.

    seam: least pairs of voxels across the seam.  concave, bend: least share of them that bends inward by more than
    ``sharp``, and least median bend, where one lies on the other; beside, beside_bend: the same where they stand side by side.
    breadth, depth: least middle and smallest extent of each.  rest: slack between the top of one and the bottom of the
    other.  floor: a part that begins below this height stands on the table.  neck: an upper part on the lower one's axis,
    both round, and narrower than this share of it is its neck.
    foot: least width of the lowest 25 mm of what stands on another part; a post grows out of its base.
    doubts: so many criteria must speak against two things before they are joined.  colors: so many fewer do where the two have
    each a colour of its own: their mean chromaticities differ by ``UNLIKE``, and four fifths of either's voxels are nearer to the own mean.
    """

    doubts: int = 2
    colors: int = 2

    seam: int = 24
    sharp: float = 25.0
    concave: float = 0.4
    bend: float = 20.0
    beside: float = 0.6
    beside_bend: float = 40.0
    breadth: float = 0.040
    depth: float = 0.018
    rest: float = 0.015
    floor: float = 0.015
    neck: float = 0.6
    foot: float = 0.035


def parts(
    points: NDArray[np.floating],
    normal: NDArray[np.floating],
    heights: NDArray[np.floating],
    color: NDArray[np.floating],
    voxel: float = 0.008,
    angle: float = 12.0,
    least: float = 0.12,
    evidence: Evidence = Evidence(),
) -> NDArray[np.int64]:
    """Labels (N,) from 0 of the things in one cluster: points (N, 3), normals (N, 3), NaN allowed, heights (N,) above the table, chromaticity (N, 3).

    Two voxels are joined where the surface between them is convex or bent inward by less than ``angle`` degrees, and
    where at least half of the voxels next to both agree.  Parts with less than ``least`` of all points go to the
    neighbour they touch most, a handle is no thing of its own, unless their colour is another part's alone: a jaw that something else hides in part.  What is left apart is joined again unless there is :class:`Evidence`.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    sound = np.isfinite(normal[:, 0]) & np.isfinite(heights)
    if sound.sum() < 200:
        return np.zeros(len(points), np.int64)
    centre, index = clusters.thin(points[sound], voxel)
    count = np.bincount(index)
    mean = np.stack([np.bincount(index, normal[sound][:, axis]) for axis in range(3)], axis=1)
    length = np.linalg.norm(mean, axis=1) / count
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    n = len(centre)
    tree = cKDTree(centre)
    pairs = tree.query_pairs(1.8 * voxel, output_type="ndarray")
    if len(pairs) == 0:
        return np.zeros(len(points), np.int64)
    a, b = pairs.T
    d = centre[a] - centre[b]
    d /= np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9)
    opening = np.sum((mean[a] - mean[b]) * d, axis=1)
    bend = np.degrees(np.arccos(np.clip(np.sum(mean[a] * mean[b], axis=1), -1, 1)))
    # A voxel whose normals disagree lies on an edge itself: it tells nothing of convexity.
    clear = (length[a] > 0.8) & (length[b] > 0.8)
    convex = ((opening > 0) | (bend < angle)) & clear
    joined = coo_matrix((np.ones(convex.sum()), (a[convex], b[convex])), shape=(n, n)).tocsr()
    joined = joined + joined.T
    near = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    near = near + near.T
    common = np.asarray((near[a].multiply(near[b])).sum(axis=1)).ravel()
    agree = np.asarray((joined[a].multiply(joined[b])).sum(axis=1)).ravel()
    keep = convex & (agree >= 0.5 * common)
    graph = coo_matrix((np.ones(keep.sum()), (a[keep], b[keep])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    shade = np.stack([np.bincount(index, color[sound][:, axis]) for axis in range(3)], axis=1) / count[:, None]
    part = _join_small(part, a, b, count.astype(float), least, shade)
    if part.max() > 0:
        height = np.bincount(index, heights[sound]) / count
        part = _join_unproven(part, centre, mean, height, shade, a, b, (opening < 0) & (bend > evidence.sharp), bend, clear, evidence)
    labels = np.zeros(len(points), np.int64)
    labels[sound] = part[index]
    if part.max() > 0 and (~sound).any():
        labels[~sound] = part[tree.query(points[~sound])[1]]
    return labels


#: Largest difference in chromaticity (R, G, B over their sum) of two parts of one thing's colour, and least of two that differ.
ALIKE, UNLIKE = 0.03, 0.10


def _join_small(
    part: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    weight: NDArray[np.float64],
    least: float,
    shade: NDArray[np.float64],
) -> NDArray[np.int64]:
    """Parts of too few points, smallest first, into the neighbour with the longest common border; without one into the largest part.

    A part whose neighbour has another colour goes to the largest part of its own colour, if there is one.  shade (V, 3): chromaticity of the voxels.
    """
    part = np.unique(part, return_inverse=True)[1]
    total = int(part.max()) + 1
    sizes = np.bincount(part, weight)
    border = np.zeros((total, total))
    np.add.at(border, (part[a], part[b]), 1.0)
    border = border + border.T
    np.fill_diagonal(border, 0)
    owner = np.arange(total)
    tint = np.stack([np.bincount(part, weight * shade[:, axis]) for axis in range(3)], axis=1) / sizes[:, None]
    large = sizes >= least * weight.sum()
    while True:
        small = np.nonzero((sizes > 0) & (sizes < least * weight.sum()))[0]
        if len(small) == 0:
            break
        i = int(small[np.argmin(sizes[small])])
        target = int(np.argmax(border[i])) if border[i].max() > 0 else int(np.argmax(np.where(np.arange(total) == i, -1, sizes)))
        apart = np.linalg.norm(tint - tint[i], axis=1)
        own = large & (apart < ALIKE)
        if large[target] and apart[target] > UNLIKE and own.any():
            target = int(np.argmax(np.where(own, sizes, -1)))
        owner[owner == i] = target
        sizes[target] += sizes[i]
        sizes[i] = 0
        border[target] += border[i]
        border[:, target] += border[:, i]
        border[i], border[:, i] = 0, 0
        border[target, target] = 0
    return np.unique(owner[part], return_inverse=True)[1]


def _join_unproven(
    part: NDArray[np.int64], centre: NDArray[np.float64], normal: NDArray[np.float64], height: NDArray[np.float64], shade: NDArray[np.float64],
    a: NDArray[np.int64], b: NDArray[np.int64], concave: NDArray[np.bool_], bend: NDArray[np.float64], clear: NDArray[np.bool_], evidence: Evidence,
) -> NDArray[np.int64]:  # fmt: skip
    """Parts of voxels joined again until there is evidence between all that touch: first a bar with what it ends at (a mallet's handle
    with its head, whatever the handle leans against), then the least proven pair."""
    while part.max() > 0:
        worst: tuple[tuple[bool, float], int, int] | None = None
        touching = np.zeros(int(part.max()) + 1, bool)
        for i in range(int(part.max()) + 1):
            for j in range(i):
                across = ((part[a] == i) & (part[b] == j)) | ((part[a] == j) & (part[b] == i))
                if not across.any():
                    continue
                touching[[i, j]] = True
                told = across & clear
                share = float(concave[told].mean()) if told.any() else 0.0
                angle = float(np.median(bend[told])) if told.any() else 0.0
                if int(told.sum()) < evidence.seam:
                    share = 0.0
                doubts = _doubts(centre, normal, height, part == i, part == j, share, angle, evidence)
                if doubts < evidence.doubts + evidence.colors * _two_colors(shade[part == i], shade[part == j]):
                    continue
                seam = np.concatenate([a[across], b[across]])
                rank = (not (_ends_at(centre, part == i, seam, evidence) or _ends_at(centre, part == j, seam, evidence)), share)
                if worst is None or rank < worst[0]:
                    worst = (rank, i, j)
        if worst is None:
            # A gap in what was seen is no seam: a part that touches nothing belongs to the nearest.
            lone = np.nonzero(~touching)[0]
            if len(lone) == 0:
                break
            i = int(lone[0])
            from scipy.spatial import cKDTree

            others = np.nonzero(part != i)[0]
            distance, nearest = cKDTree(centre[others]).query(centre[part == i])
            worst = ((True, 0.0), i, int(part[others[nearest[np.argmin(distance)]]]))
        part = np.where(part == worst[1], worst[2], part)
        part = np.unique(part, return_inverse=True)[1]
    return part


def _two_colors(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
    """Whether the voxels of two parts (N, 3) have each a chromaticity of their own."""
    means = first.mean(axis=0), second.mean(axis=0)
    if float(np.linalg.norm(means[0] - means[1])) < UNLIKE:
        return False
    near = [
        np.linalg.norm(shade - means[i], axis=1) < np.linalg.norm(shade - means[1 - i], axis=1) for i, shade in enumerate((first, second))
    ]
    return all(float(n.mean()) > 0.8 for n in near)


def _ends_at(centre: NDArray[np.float64], members: NDArray[np.bool_], seam: NDArray[np.int64], evidence: Evidence) -> bool:
    """Whether a part is a bar and its voxels on the seam lie at one of its ends."""
    local = centre[members] - centre[members].mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=False)[2]
    low, high = np.percentile(local @ axes.T, [2, 98], axis=0)
    length, breadth = float(high[0] - low[0]), float(high[1] - low[1])
    if breadth > evidence.breadth or length < 3 * breadth:
        return False
    along = (centre[seam[members[seam]]] - centre[members].mean(axis=0)) @ axes[0]
    return (
        len(along) > 0
        and float(np.percentile(np.minimum(along - low[0], high[0] - along), 90)) < 0.2 * length
        and float(np.ptp(along)) < 0.5 * length
    )


def _doubts(
    centre: NDArray[np.float64], normal: NDArray[np.float64], height: NDArray[np.float64],
    first: NDArray[np.bool_], second: NDArray[np.bool_], share: float, angle: float, evidence: Evidence,
) -> int:  # fmt: skip
    """How many of the criteria of :class:`Evidence` speak against two parts being two things: the seam, the bulk of either, and how they lie."""
    from magic_perception.primitives import fit_circle

    doubts = int(share < evidence.concave or angle < evidence.bend)
    for members in (first, second):
        local = centre[members] - centre[members].mean(axis=0)
        along = local @ np.linalg.svd(local, full_matrices=False)[2].T
        extent = np.sort(np.percentile(along, 97, axis=0) - np.percentile(along, 3, axis=0))
        doubts += int(extent[1] < evidence.breadth or extent[0] < evidence.depth)
    lower, upper = (first, second) if np.median(height[first]) < np.median(height[second]) else (second, first)
    bottom, top = float(np.percentile(height[upper], 2)), float(np.percentile(height[lower], 97))
    if bottom < top - evidence.rest:
        both = bottom < evidence.floor and float(np.percentile(height[lower], 2)) < evidence.floor
        return doubts + int(not both) + int(share < evidence.beside or angle < evidence.beside_bend)
    foot = centre[upper & (height < bottom + 0.025), :2]
    doubts += int(len(foot) < 4 or float(np.ptp(foot @ np.linalg.svd(foot - foot.mean(axis=0), full_matrices=False)[2][0])) < evidence.foot)
    circles = []
    for members in (lower, upper):
        side = members & (np.abs(normal[:, 2]) < 0.7)
        if side.sum() < 12:
            return doubts
        middle, radius = fit_circle(centre[side, :2])
        circles.append((middle, radius, float(np.percentile(np.abs(np.linalg.norm(centre[side, :2] - middle, axis=1) - radius), 80))))
    (c0, r0, e0), (c1, r1, e1) = circles
    neck = e0 < 0.15 * r0 and e1 < 0.2 * r1 and r1 < evidence.neck * r0 and np.linalg.norm(c0 - c1) < 0.2 * r0
    # A neck is no doubt but a sign of one thing.
    return doubts + (evidence.doubts if neck else 0)


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
    return labels
