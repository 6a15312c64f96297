"""Parts of one thing that another hides in its middle, in one camera's picture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_perception import convexity
from magic_perception.labels import sizeable
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pixels import where, window

#: Two parts on both sides of what hides the middle of one thing: how much nearer that is, and how far the tops may differ in height, m;
#: least common share of their histograms of colour; and so many pixels are between what is compared across an edge, of which there are so
#: many at least.
NEARER, LEVEL, COMMON, ACROSS, EDGES = 0.012, 0.015, 0.5, (8, 20), 8


def behind_one(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels with the parts of one thing that another hides in its middle joined: of one colour or with an upright face in one plane,
    equally high, and nothing but that other between."""
    from scipy.spatial import cKDTree

    top = max((int(image.max()) for image in labels), default=0)
    owner = np.arange(top + 2)
    for look, image in zip(looks, labels, strict=True):
        hides = _hides(image, look.frame.depth)
        for front in {f for _, f in hides}:
            parts = sorted({back for back, f in hides if f == front})
            for i, a in enumerate(parts):
                for b in parts[i + 1 :]:
                    if owner[a] == owner[b]:
                        continue
                    one, two = (_part(look, image == label) for label in (a, b))
                    if min(len(one[0]), len(two[0])) < 40 or abs(one[1] - two[1]) > LEVEL:
                        continue
                    if np.minimum(one[2], two[2]).sum() < COMMON and not one_face(look, image, a, b):
                        continue
                    distance, nearest = cKDTree(two[0]).query(one[0])
                    order = np.argsort(distance)[:20]
                    ways = np.linspace(one[0][order], two[0][nearest[order]], 12)[1:-1]
                    k = look.frame.intrinsics
                    local = transforms.apply(transforms.inverse(look.frame.world_from_camera), ways.reshape(-1, 3).astype(float))
                    u = np.clip(np.rint(k.fx * local[:, 0] / local[:, 2] + k.cx), 0, k.width - 1).astype(int)
                    v = np.clip(np.rint(k.fy * local[:, 1] / local[:, 2] + k.cy), 0, k.height - 1).astype(int)
                    met = image[v, u]
                    if float(np.isin(met, (front, a, b)).mean()) > 0.8 and bool((met == front).any()):
                        owner[owner == max(owner[a], owner[b])] = min(owner[a], owner[b])
    if np.array_equal(owner, np.arange(top + 2)):
        return labels
    owner[-1] = -1
    return sizeable([owner[image] for image in labels], looks, parameters)


#: Two upright faces are in one plane where their directions differ by less, degrees, and 80 % of both lie so near to it, m; so many pixels
#: each, and such a share of a part's, make a face.
PARALLEL, FLAT, FACE, FACE_SHARE = 8.0, 0.004, 60, 0.15


def one_face(look: Looked, image: NDArray[np.int32], a: int, b: int) -> bool:
    """Whether upright faces of two labels lie in one plane, as those of a box do that something hides in its middle."""
    x, y, w, h = cv2.boundingRect(((image == a) | (image == b)).view(np.uint8))
    height, width = image.shape
    cut = (slice(max(y - 8, 0), min(y + h + 8, height)), slice(max(x - 8, 0), min(x + w + 8, width)))
    points = look.cloud(cut)
    normal = convexity.normals(points, look.frame.world_from_camera[:3, 3])
    up = look.normal.astype(np.float32)
    faces = []
    for label in (a, b):
        mine = (image[cut] == label) & np.isfinite(normal[..., 0]) & np.isfinite(points[..., 0])
        upright = mine & (np.abs(normal @ up) < 0.35)
        way = normal[upright][:: max(1, np.count_nonzero(upright) // 300)]
        if len(way) == 0:
            return False
        # The direction that most of them share.
        agree = way @ way.T > np.cos(np.radians(15))
        main = way[agree[np.argmax(agree.sum(axis=1))]].mean(axis=0)
        face = upright & (normal @ (main / np.linalg.norm(main)) > np.cos(np.radians(15)))
        if np.count_nonzero(face) < max(FACE, FACE_SHARE * np.count_nonzero(mine)):
            return False
        faces.append((main / np.linalg.norm(main), points[face][:: max(1, np.count_nonzero(face) // 500)]))
    (one, p), (two, q) = faces
    if one @ two < np.cos(np.radians(PARALLEL)):
        return False
    # As many of either, so that the larger does not decide alone.
    count = min(len(p), len(q))
    both = np.concatenate([p[np.linspace(0, len(p) - 1, count).astype(int)], q[np.linspace(0, len(q) - 1, count).astype(int)]])
    middle = both.mean(axis=0)
    plane = np.linalg.svd(both - middle, full_matrices=False)[2][2]
    return all(float(np.percentile(np.abs((face - middle) @ plane), 80)) < FLAT for face in (p, q))


def _hides(image: NDArray[np.int32], depth: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Pairs of labels (behind, before) that meet in a picture along an edge where the second is nearer; what is behind may have lost its
    depth there."""
    found: dict[tuple[int, int], int] = {}
    cut = window(image > 0)
    image, depth = image[cut], depth[cut]
    for axis, across in ((axis, across) for axis in range(2) for across in ACROSS):
        first, second = (np.moveaxis(image, axis, 0)[part] for part in (slice(None, -across), slice(across, None)))
        rows, columns = where((first != second) & (first > 0) & (second > 0))
        if len(rows) == 0:
            continue
        z = np.moveaxis(depth, axis, 0)
        step = z[rows + across, columns] - z[rows, columns]
        for sign, pair in ((1, (second, first)), (-1, (first, second))):
            far = sign * step > NEARER
            keys, counts = np.unique(np.stack([p[rows[far], columns[far]] for p in pair]), axis=1, return_counts=True)
            for (back, front), count in zip(keys.T, counts, strict=True):
                found[int(back), int(front)] = max(found.get((int(back), int(front)), 0), int(count) // across)
    return [pair for pair, count in found.items() if count >= EDGES]


def _part(look: Looked, mask: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float, NDArray[np.float64]]:
    """Points (N, 3) of a mask, the height of its top and its histogram of the two colour axes, which sums to 1."""
    rows, columns = where(mask & np.isfinite(look.heights))
    if len(rows) == 0:
        return np.zeros((0, 3), np.float32), 0.0, np.zeros(256)
    step = max(1, len(rows) // 1500)
    rows, columns = rows[::step], columns[::step]
    lab = cv2.cvtColor(np.ascontiguousarray(look.frame.color[rows, columns][None]), cv2.COLOR_RGB2LAB)[0].astype(int)
    histogram = np.bincount((np.clip(lab[:, 1] - 64, 0, 127) // 8) * 16 + np.clip(lab[:, 2] - 64, 0, 127) // 8, minlength=256) / len(lab)
    return look.points(rows, columns), float(np.percentile(look.heights[rows, columns], 95)), histogram
