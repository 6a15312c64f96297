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
