"""Pictures of labels: filled, numbered by size, without what is too small or has no depth of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception import smear
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pixels import where, window

#: Least share of a thing's pixels that has depth of its own in one camera at least.
MEASURED = 0.2
#: Unlabelled pixels take the label of one so near, in pixels.
REACH = 24.0


def with_depth(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels without what colour alone tells of: beyond the table's edge, where depth ends, the floor is of another colour."""
    top = max((int(image.max()) for image in labels), default=0)
    share = np.zeros(top + 1)
    for look, image in zip(looks, labels, strict=True):
        own = image > 0
        # Depth of the table behind a thing is none of its own: a shadow of stereo at the table's edge has a few pixels that are.
        depth = own & np.isfinite(look.frame.depth) & ~smear.behind(own, look.heights)
        count, seen = (np.bincount(image[where], minlength=top + 1) for where in (own, depth))
        share = np.maximum(share, seen / np.maximum(count, 1))
    if np.all(share[1:] >= MEASURED):
        return labels
    table = np.where(share >= MEASURED, np.arange(top + 1), 0).astype(np.int32)
    return sizeable([table[image] for image in labels], looks, parameters)


def fill(labels: NDArray[np.int32], mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Give pixels of the mask that have no label the one of the nearest labelled pixel within :data:`REACH` pixels, if both are of one
    connected region."""
    margin = int(np.ceil(REACH))
    cut = window(mask, margin)
    part = labels[cut]
    seen = part > 0
    if not seen.any():
        return labels
    count, regions = cv2.connectedComponents(mask[cut].view(np.uint8), connectivity=8)
    labelled = np.zeros(count, bool)
    labelled[regions[seen]] = True
    labelled[0] = False
    missing = (part == 0) & np.take(labelled, regions)
    near = window(missing, margin)
    part, seen, missing = part[near], seen[near], missing[near]
    if not seen.any():
        return labels
    distance, index = cv2.distanceTransformWithLabels((~seen).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(int(np.count_nonzero(seen)) + 1, np.int32)
    table[index[seen]] = part[seen]
    result = labels.copy()
    result[cut][near] = np.where(missing & (distance <= REACH), np.take(table, index), part)
    return result


def beside(fixed: NDArray[np.bool_], blank: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What of ``blank`` (H, W), which colour alone tells from the table, hangs together with a fixture: beside it stereo has a shadow, and
    what is seen there is of something behind, nobody knows of what.  It is no more the end of that than the fixture is."""
    if not (fixed.any() and blank.any()):
        return np.zeros_like(blank)
    regions = cv2.connectedComponents(blank.view(np.uint8), connectivity=8)[1]
    touched = np.unique(regions[cv2.dilate(fixed.view(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    return blank & np.isin(regions, touched)


def sizeable(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Drop what is too small, and number the rest from 1, by their pixels, most first."""
    spots = [where(image > 0) for image in labels]
    values = [image[spot] for image, spot in zip(labels, spots, strict=True)]
    top = max((int(v.max(initial=0)) for v in values), default=0)
    pixels = np.stack([np.bincount(v, minlength=top + 1) for v in values])
    order = [np.argsort(v, kind="stable") for v in values]
    starts = [np.concatenate([[0], np.cumsum(row)]) for row in pixels]
    keep = []
    for label in range(1, top + 1):
        if pixels[:, label].max() < parameters.min_pixels:
            continue
        clouds = []
        for looked, spot, turn, start in zip(looks, spots, order, starts, strict=True):
            mine = turn[start[label] : start[label + 1]]
            mine = mine[:: max(1, len(mine) // 2000)]
            clouds.append(looked.points(spot[0][mine], spot[1][mine]))
        points = np.concatenate(clouds)
        points = points[np.isfinite(points[:, 0])]
        if len(points) < 20:
            continue
        low, high = np.percentile(points, [3, 97], axis=0)
        if np.max(high - low) < parameters.min_extent:
            continue
        keep.append((pixels[:, label].sum(), label))
    keep.sort(reverse=True)
    table = np.zeros(top + 2, np.int32)
    table[-1] = -1
    for new, (_, old) in enumerate(keep):
        table[old] = new + 1
    return [np.take(table, image) for image in labels]
