"""Things of different colours so near each other that their points hang together, told by the table that a camera sees between them.

A gap of some millimetres is narrower than the radius in which points are one cluster, and low things have no seam that tells.  Where one
picture shows the table between two parts of a cluster, and they differ in colour, they are two things, also where the other camera looks
along the gap's side and sees none.  What is of one colour stays one: a thin thing's mask may be torn.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception.clustered import Clusters
from magic_perception.looks import Looked

#: Least difference of two things' middle colours, in the two colour axes or in lightness (OpenCV's Lab of 8 bits): sides in the shade
#: differ in lightness.
HUE, LIGHTNESS = 12.0, 60.0
#: What is darker than this, of 255, has noise for a colour.
DARK = 40.0
#: So many of the shortest ways between two parts are looked at in a picture, and such a share of the pixels on them is of neither thing.
WAYS, CLEAR = 12, 0.9
#: What has the table's colour within a mask may be a gap where it is so many pixels wide, and not so near (of 255, R, G, B) to a mixture of
#: the colours on its sides: where two meet a pixel has both.
WIDE, MIXED = 2, 24.0
#: By what points of one picture are matched with those of another: m, and steps of colour, that count alike.
NEAR, ALIKE = 0.006, 12.0


def parted(looks: list[Looked], found: Clusters, instance: NDArray[np.int64], least: int) -> NDArray[np.int64]:
    """The instances (N,) of the cloud's points with those parted between whose parts, of at least ``least`` pixels each, the table
    shows."""
    instance = instance.copy()
    regions = [_regions(mask, table) for mask, table in zip(found.masks, found.table, strict=True)]
    region = np.concatenate([r[where] for r, where in zip(regions, found.spots, strict=True)])
    look_of = np.repeat(np.arange(len(looks)), [len(where[0]) for where in found.spots])
    for label in range(int(instance.max(initial=-1)) + 1):
        mine = np.nonzero(instance == label)[0]
        if len(mine) < 2 * least:
            continue
        best, number = None, 1
        for i in range(len(looks)):
            own = mine[look_of[mine] == i]
            values, counts = np.unique(region[own], return_counts=True)
            large = values[counts >= least]
            if len(large) > number:
                groups = _groups(looks[i], found.masks[i], found.fixed[i], regions[i], large)
                if groups.max() + 1 > number:
                    best, number = (own, large, groups), int(groups.max()) + 1
        if best is None:
            continue
        own, large, groups = best
        told = np.isin(region[own], large)
        group = _spread(looks, found, mine, own[told], groups[np.searchsorted(large, region[own[told]])])
        top = int(instance.max())
        for k in range(1, number):
            instance[mine[group == k]] = top + k
    return instance


def _regions(mask: NDArray[np.bool_], table: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The connected regions (H, W) of a mask, from 1, without what has the table's colour: over a gap stereo carries the depth of its
    sides."""
    gap = cv2.morphologyEx((mask & table).view(np.uint8), cv2.MORPH_OPEN, np.ones((WIDE, WIDE), np.uint8))
    return cv2.connectedComponents((mask & (gap == 0)).view(np.uint8), connectivity=4)[1]


def _groups(
    look: Looked, mask: NDArray[np.bool_], fixed: NDArray[np.bool_], regions: NDArray[np.int32], large: NDArray[np.int32]
) -> NDArray[np.int64]:
    """For each region its group (from 0): regions of one colour, or with something else than the table between, are one group."""
    lab = cv2.cvtColor(look.frame.color, cv2.COLOR_RGB2LAB)
    colors = [np.median(lab[regions == number], axis=0).astype(float) for number in large]
    group = np.arange(len(large))
    for i in range(len(large)):
        for j in range(i + 1, len(large)):
            differ = _differ(colors[i], colors[j])
            if not (differ and _table_between(look, mask, fixed, regions, (int(large[i]), int(large[j])))):
                group[group == group[j]] = group[i]
    return np.unique(group, return_inverse=True)[1]


def _differ(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Whether two colours (3,), of Lab in 8 bits, are those of two things; in the shade a colour is as much paler as it is darker."""
    middle = max((one[0] + other[0]) / 2, 1.0)
    hue = (one[1:] - 128) * middle / max(one[0], DARK) - (other[1:] - 128) * middle / max(other[0], DARK)
    return bool(np.hypot(*hue) > HUE or abs(one[0] - other[0]) > LIGHTNESS)


def _table_between(
    look: Looked, mask: NDArray[np.bool_], fixed: NDArray[np.bool_], regions: NDArray[np.int32], pair: tuple[int, int]
) -> bool:
    """Whether the shortest ways between two regions of a picture cross what is no thing, nothing known (``fixed``, behind which a thing may
    go on), not blind, and within the mask no mixture of their colours."""
    one, other = (regions == number for number in pair)
    x, y, w, h = cv2.boundingRect((one | other).view(np.uint8))
    cut = (slice(y, y + h), slice(x, x + w))
    color = look.frame.color[cut].astype(np.float32)
    one, other = one[cut], other[cut]
    first, second = (np.median(color[region], axis=0) for region in (one, other))
    distance, index = cv2.distanceTransformWithLabels((~one).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(index.max()) + 1, np.int64)
    source[index[one]] = np.flatnonzero(one)
    there = np.flatnonzero(other)
    there = there[np.argsort(distance.ravel()[there], kind="stable")[:WAYS]]
    (v0, u0), (v1, u1) = np.divmod(source[index.ravel()[there]], w), np.divmod(there, w)
    t = np.linspace(0, 1, 16)[:, None]
    v, u = (np.rint((1 - t) * a + t * b).astype(int) for a, b in ((v0, v1), (u0, u1)))
    inner = ~(one[v, u] | other[v, u])
    met = color[v, u]
    way = second - first
    share = np.clip((met - first) @ way / max(float(way @ way), 1.0), 0, 1)
    mixed = mask[cut][v, u] & (np.linalg.norm(met - first - share[..., None] * way, axis=-1) < MIXED)
    free = inner & ~mixed & (regions[cut][v, u] == 0) & (look.open & ~fixed)[cut][v, u]
    return bool(inner.any()) and float(free.sum()) >= CLEAR * float(inner.sum())


def _spread(
    looks: list[Looked], found: Clusters, mine: NDArray[np.int64], told: NDArray[np.int64], group: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The group of each of the points ``mine``, from those of the points ``told``: of the nearest in place and colour."""
    from scipy.spatial import cKDTree

    lab = np.concatenate(
        [
            cv2.cvtColor(np.ascontiguousarray(look.frame.color[where][None]), cv2.COLOR_RGB2LAB)[0]
            if len(where[0])
            else np.zeros((0, 3), np.uint8)
            for look, where in zip(looks, found.spots, strict=True)
        ]
    )
    # Lightness changes with the direction of a face.
    features = np.column_stack([found.cloud / NEAR, lab[:, 1:].astype(np.float32) / ALIKE, lab[:, 0].astype(np.float32) / (4 * ALIKE)])
    step = max(1, len(told) // 4000)
    result = group[::step][cKDTree(features[told[::step]]).query(features[mine])[1]]
    result[np.searchsorted(mine, told)] = group
    return result
