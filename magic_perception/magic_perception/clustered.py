"""What is above the table, by what hangs together in space, and the surfaces that seams are found by."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_core.workers import Workers
from magic_perception import clusters, convexity, smear
from magic_perception.foreground import foreground, near_known
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pixels import where
from magic_perception.shared_out import shared_out

#: Pixels of a line across a gap whose colours are compared, its ends among them.
SAMPLES = 8


@dataclass(frozen=True)
class Bridges:
    """Straight ways across gaps in depth that colour shows to hang together.

    ends (L, 2): the points on the two sides, by their numbers; place (L, S, 3): world points on the way between them.
    """

    ends: NDArray[np.int64]
    place: NDArray[np.float32]

    def among(self, mine: NDArray[np.int64]) -> NDArray[np.int64]:
        """The ends (K, 2) of those whose ends are both among some points (M,), ascending, by their places in that list."""
        found = np.minimum(np.searchsorted(mine, self.ends), len(mine) - 1)
        return found[np.all(mine[found] == self.ends, axis=1)]


@dataclass(frozen=True)
class Clusters:
    """What is above the table, by what hangs together in space.

    masks (H, W) for each look, without what is known; fixed (H, W): what is; table (H, W): what has the table's colour.  spots: rows and
    columns of the mask's pixels with depth in each look; cloud (N, 3): their world points, look by look; instance (N,): their cluster, -1
    for noise; bridges: between points of the cloud.
    """

    masks: list[NDArray[np.bool_]]
    fixed: list[NDArray[np.bool_]]
    table: list[NDArray[np.bool_]]
    spots: list[tuple[NDArray, NDArray]]
    cloud: NDArray[np.float32]
    instance: NDArray[np.int64]
    bridges: Bridges


def clustered(looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters, workers: Workers | None = None) -> Clusters:
    """The clusters in all looks together; known: meshes (world) that are left out."""
    pixels = [looked.heights.size for looked in looks]
    told = shared_out(_in_look, (looks, known, parameters), range(len(looks)), pixels, workers)
    masks, fixed, tables, spots, clouds, made = map(list, zip(*told, strict=True))
    cloud = np.concatenate(clouds)
    between = [bridges.place.reshape(-1, 3) for bridges in made]
    instance = clusters.cluster(np.concatenate([cloud, *between]), parameters.cluster_eps, parameters.cluster_points, voxel=0.004)
    bridges = _of_cloud(made, spots, masks)
    # A cluster of nothing but bridges is none.
    instance = _bridged(instance[: len(cloud)], bridges)
    return Clusters(masks, fixed, tables, spots, cloud, instance, bridges)


def _in_look(
    given: tuple[list[Looked], tuple[Mesh, ...], Parameters], number: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_], tuple[NDArray, NDArray], NDArray[np.float32], Bridges]:
    """What one look tells: mask, fixed, table and spots as :class:`Clusters` has them, the points (N, 3) at the spots, and bridges between
    pixels."""
    looks, known, parameters = given
    looked = looks[number]
    mask, table = foreground(looked, parameters)
    fixed = near_known(looked, mask, known, parameters.known_margin)
    mask &= ~fixed
    spots = where(mask & np.isfinite(looked.heights) & ~smear.behind(mask, looked.heights))
    return mask, fixed, table, spots, looked.points(*spots), _bridges(looked, mask)


#: A gap in depth is bridged where the surfaces on its sides are no farther apart in depth than so many times its width, beside the noise,
#: m.
STEEP, NOISE = 1.0, 0.004


def _bridges(looked: Looked, mask: NDArray[np.bool_]) -> Bridges:
    """Across the gaps in a mask's depth, between pixels of the flattened picture: what colour shows to be one thing is not two for want of
    depth.

    Each pixel without depth goes to the nearest that has it; where two of these regions meet, straight lines join the pixels they go to.
    """
    x, y, w, h = cv2.boundingRect((mask & ~np.isfinite(looked.frame.depth)).view(np.uint8))
    # As wide a margin as a pixel without depth may be from one with it.
    cut = (slice(max(y - 16, 0), y + h + 16), slice(max(x - 16, 0), x + w + 16))
    own, z = mask[cut], looked.frame.depth[cut]
    seen = own & np.isfinite(z)
    if w == 0 or not seen.any():
        return Bridges(np.zeros((0, 2), np.int64), np.zeros((0, SAMPLES - 2, 3), np.float32))
    _, index = cv2.distanceTransformWithLabels((~seen).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(index.max()) + 1, np.int64)
    source[index[seen]] = np.flatnonzero(seen)
    goes, flat = np.take(source, index), cv2.connectedComponents(own.view(np.uint8), connectivity=8)[1].ravel()
    meetings = []
    for axis in range(2):
        one, two, here, there, first, second = (
            np.moveaxis(image, axis, 0)[part] for image in (goes, own, seen) for part in (slice(None, -1), slice(1, None))
        )
        meet = here & there & (one != two) & ~(first & second)
        meetings.append(np.minimum(one[meet], two[meet]) * own.size + np.maximum(one[meet], two[meet]))
    a, b = np.divmod(np.unique(np.concatenate(meetings)), own.size)
    (v0, u0), (v1, u1) = (np.divmod(i, own.shape[1]) for i in (a, b))
    z0, z1, apart = z.ravel()[a].astype(float), z.ravel()[b].astype(float), np.hypot(u1 - u0, v1 - v0)
    k = looked.frame.intrinsics
    even = (apart > 2) & (flat[a] == flat[b]) & (np.abs(z1 - z0) < STEEP * apart * np.minimum(z0, z1) / k.fx + NOISE)
    a, b, z0, z1 = a[even], b[even], z0[even, None], z1[even, None]
    t = np.linspace(0, 1, SAMPLES)[1:-1]
    u, v = (
        (1 - t) * p[even, None] + t * q[even, None]
        for p, q in ((u0 + cut[1].start, u1 + cut[1].start), (v0 + cut[0].start, v1 + cut[0].start))
    )
    middle = 1 / ((1 - t) / z0 + t / z1)
    local = np.stack([(u - k.cx) / k.fx * middle, (v - k.cy) / k.fy * middle, middle], axis=-1)
    place = transforms.apply(looked.frame.world_from_camera, local.reshape(-1, 3)).astype(np.float32).reshape(local.shape)
    ends = np.column_stack([(v + cut[0].start) * mask.shape[1] + u + cut[1].start for v, u in (np.divmod(i, own.shape[1]) for i in (a, b))])
    return Bridges(ends, place)


def _of_cloud(made: list[Bridges], spots: list[tuple[NDArray, NDArray]], masks: list[NDArray[np.bool_]]) -> Bridges:
    """The bridges of all looks between points of the cloud, which leaves depth out that is not the thing's own."""
    found, start = [], 0
    for bridges, (rows, columns), mask in zip(made, spots, masks, strict=True):
        number = np.full(mask.size, -1)
        number[rows * mask.shape[1] + columns] = np.arange(start, start + len(rows))
        ends = number[bridges.ends]
        kept = np.all(ends >= 0, axis=1)
        found.append((ends[kept], bridges.place[kept]))
        start += len(rows)
    return Bridges(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _bridged(instance: NDArray[np.int64], bridges: Bridges) -> NDArray[np.int64]:
    """The clusters (N,), numbered anew, of which those are one that a bridge joins: over a thin bar bridges are too few to be a cluster's
    core."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    real = instance >= 0
    if not real.any():
        return instance
    pairs = instance[bridges.ends]
    a, b = pairs[np.all(pairs >= 0, axis=1)].T
    total = int(instance.max()) + 1
    owner = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(total, total)), directed=False)[1]
    instance[real] = np.unique(owner[instance[real]], return_inverse=True)[1]
    return instance


#: A cluster is looked at for seams from so many points on, and where it is so high above the table, m: tools lie flat, and their parts
#: belong together.
POINTS, TALL = 1500, 0.05

#: From this height on, m, a cluster may be the inside or the outside of another.
RAISED = 0.02


@dataclass(frozen=True)
class Surfaces:
    """The points of all clusters (N,): unit normals (N, 3), NaN outside of the raised clusters and where there is none; heights (N,) above
    the table, m; colours (N, 3), 0..255.  tall: the indices of the points of each cluster that may be more than one thing."""

    normal: NDArray[np.float32]
    heights: NDArray[np.float32]
    rgb: NDArray[np.float32]
    tall: list[NDArray[np.int64]]


def surfaces(looks: list[Looked], found: Clusters) -> Surfaces:
    """Of the clusters what their seams are found by."""
    heights = np.concatenate([looked.heights[where] for looked, where in zip(looks, found.spots, strict=True)])
    rgb = np.concatenate([looked.frame.color[where] for looked, where in zip(looks, found.spots, strict=True)]).astype(np.float32)
    members = [np.nonzero(found.instance == label)[0] for label in range(int(found.instance.max(initial=-1)) + 1)]
    tops = [float(np.percentile(heights[mine], 97)) if len(mine) >= POINTS else 0.0 for mine in members]
    tall = [mine for mine, top in zip(members, tops, strict=True) if top >= TALL]
    normal = np.full((len(found.cloud), 3), np.nan, np.float32)
    flags = np.zeros(len(found.cloud), bool)
    for mine, top in zip(members, tops, strict=True):
        flags[mine] = top >= RAISED
    start = 0
    for looked, (rows, columns) in zip(looks, found.spots, strict=True):
        here = flags[start : start + len(rows)]
        if here.any():
            v, u = rows[here], columns[here]
            r0, r1 = max(int(v.min()) - 8, 0), min(int(v.max()) + 9, looked.heights.shape[0])
            c0, c1 = max(int(u.min()) - 8, 0), min(int(u.max()) + 9, looked.heights.shape[1])
            field = convexity.normals(looked.cloud((slice(r0, r1), slice(c0, c1))), looked.frame.world_from_camera[:3, 3])
            near = np.nonzero((rows >= r0) & (rows < r1) & (columns >= c0) & (columns < c1))[0]
            normal[start + near] = field[rows[near] - r0, columns[near] - c0]
        start += len(rows)
    return Surfaces(normal, heights, rgb, tall)
