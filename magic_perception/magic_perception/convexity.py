"""Parting touching things at concave seams, after LCCP (Stein et al. 2014), on voxels instead of supervoxels."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception import clusters


def normals(points: NDArray[np.float32], eye: NDArray[np.float64], size: int = 7) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) of an organised cloud (H, W, 3), towards the eye, from differences of smoothed points; NaN at gaps and jumps."""
    valid = np.isfinite(points[..., 0])
    weight = cv2.blur(valid.astype(np.float32), (size, size))
    smooth = cv2.blur(np.where(valid[..., None], points, 0).astype(np.float32), (size, size)) / np.maximum(weight, 1e-6)[..., None]
    smooth[weight < 0.6] = np.nan
    step = max(2, size // 2)
    du = np.full_like(smooth, np.nan)
    dv = np.full_like(smooth, np.nan)
    du[:, step:-step] = smooth[:, 2 * step :] - smooth[:, : -2 * step]
    dv[step:-step] = smooth[2 * step :] - smooth[: -2 * step]
    normal = np.cross(du, dv)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        away = np.sum(normal * (points - eye.astype(np.float32)), axis=-1) > 0
        # Across a jump in depth there is no surface.
        jump = np.maximum(np.linalg.norm(du, axis=-1), np.linalg.norm(dv, axis=-1)) > 0.05
    normal[away] *= -1
    normal[jump] = np.nan
    return normal


def parts(points: NDArray[np.floating], normal: NDArray[np.floating], voxel: float = 0.008, angle: float = 12.0, least: float = 0.12) -> NDArray[np.int64]:
    """Labels (N,) from 0 of the convexly connected parts of one cluster: points (N, 3) with normals (N, 3), NaN allowed.

    Two voxels are joined where the surface between them is convex or bent inward by less than ``angle`` degrees, and
    where at least half of the voxels next to both agree.  Parts with less than ``least`` of all points go to the
    neighbour they touch most: a handle is no thing of its own.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    sound = np.isfinite(normal[:, 0])
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
    convex = (opening > 0) | (bend < angle)
    # A voxel whose normals disagree lies on an edge itself: it tells nothing of convexity.
    convex &= (length[a] > 0.8) & (length[b] > 0.8)
    joined = coo_matrix((np.ones(convex.sum()), (a[convex], b[convex])), shape=(n, n)).tocsr()
    joined = joined + joined.T
    near = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    near = near + near.T
    common = np.asarray((near[a].multiply(near[b])).sum(axis=1)).ravel()
    agree = np.asarray((joined[a].multiply(joined[b])).sum(axis=1)).ravel()
    keep = convex & (agree >= 0.5 * common)
    graph = coo_matrix((np.ones(keep.sum()), (a[keep], b[keep])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    weight = count.astype(float)
    # Smallest first, into the neighbour with the longest common border.
    while True:
        sizes = np.bincount(part, weight)
        small = [i for i in np.argsort(sizes) if 0 < sizes[i] < least * weight.sum()]
        if not small:
            break
        for i in small:
            across = part[b[part[a] == i]].tolist() + part[a[part[b] == i]].tolist()
            across = [x for x in across if x != i]
            target = max(set(across), key=across.count) if across else int(np.argmax(np.where(np.arange(len(sizes)) == i, -1, sizes)))
            part[part == i] = target
            break
    part = np.unique(part, return_inverse=True)[1]
    labels = np.zeros(len(points), np.int64)
    labels[sound] = part[index]
    if (~sound).any():
        labels[~sound] = part[tree.query(points[~sound])[1]]
    return labels


def insides(points: NDArray[np.floating], normal: NDArray[np.floating], labels: NDArray[np.int64], heights: NDArray[np.floating]) -> NDArray[np.int64]:
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
            inward = np.mean(np.sum(normal[upright, :2] * (centre - points[upright, :2]), axis=1) > 0) if len(upright) > 0.2 * len(finite) else float(np.median(heights[m]) < 0.6 * top)
            if within > 0.85 and low and inward > 0.75 and (best is None or within > best[0]):
                best = (within, j)
        if best is not None:
            labels[labels == i] = best[1]
    return labels
