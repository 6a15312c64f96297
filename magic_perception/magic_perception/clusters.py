"""Groups of points (DBSCAN, Ester et al. 1996; paper, IV-B)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def thin(points: NDArray[np.floating], voxel: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """One mean point (M, 3) for each occupied voxel of edge ``voxel`` metres, and for each point (N,) the index of its voxel."""
    keys = np.floor(np.asarray(points, float) / voxel).astype(np.int64)
    keys -= keys.min(axis=0)
    size = keys.max(axis=0) + 1
    flat = (keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2]
    _, index, counts = np.unique(flat, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(index, points[:, axis]) for axis in range(3)], axis=1) / counts[:, None]
    return mean, index


def cluster(points: NDArray[np.floating], eps: float, min_points: int, voxel: float | None = None) -> NDArray[np.int64]:
    """DBSCAN labels (N,) of points (N, 3): -1 noise, clusters from 0.  With ``voxel`` the cloud is thinned first."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    import open3d as o3d

    mean, index = thin(points, voxel) if voxel else (np.asarray(points, float), np.arange(len(points)))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(mean))
    return np.asarray(cloud.cluster_dbscan(eps, min_points), dtype=np.int64)[index]


def largest(points: NDArray[np.floating], eps: float, min_points: int, voxel: float | None = None) -> NDArray[np.bool_]:
    """(N,): the points of the cluster that has most of them (paper, IV-B); all where there is no cluster."""
    labels = cluster(points, eps, min_points, voxel)
    if len(labels) == 0 or labels.max() < 0:
        return np.ones(len(points), bool)
    return labels == int(np.argmax(np.bincount(labels[labels >= 0])))
