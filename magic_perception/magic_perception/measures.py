"""The measures by which segmentations of unseen objects are compared (Xie et al., UOIS-Net-3D, section VI).

Found and true objects are matched one to one so that the sum of their F-measures is largest (Hungarian).  Overlap counts the pixels that
matched masks share, boundary the pixels of either outline that lie near the other's; precision is out of all that was found,
recall out of all that is there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

#: How far apart outlines may be, as a share of the picture's diagonal; rounded up to whole pixels.
NEAR = 0.003


@dataclass(frozen=True)
class Measures:
    """Of one picture, or the mean of several; each 0..1.

    iou: mean over the true objects of the best intersection over union with any found one.  overlap_*, boundary_*: see the module.
    detected: share of the true objects whose match has an F-measure above 0.75 (``F@.75``).
    """

    iou: float
    overlap_precision: float
    overlap_recall: float
    overlap_f: float
    boundary_precision: float
    boundary_recall: float
    boundary_f: float
    detected: float


def mean(rows: list[Measures]) -> Measures:
    """The mean over pictures, as the field reports it; ``iou`` too is a mean of the pictures' means."""
    return Measures(*(float(np.mean([getattr(row, name.name) for row in rows])) for name in fields(Measures)))


def best_ious(labels: NDArray[np.integer], truth: NDArray[np.integer]) -> NDArray[np.float64]:
    """(T,): for each true object, in the order of its number, the best intersection over union with a found one."""
    table, found, true = _shared(labels, truth)
    union = found[None] + true[:, None] - table
    return (table / union).max(axis=1, initial=0.0)


def measure(labels: NDArray[np.integer], truth: NDArray[np.integer]) -> Measures:
    """labels, truth (H, W): number of the object at each pixel, found and true; 0 and below is none."""
    from scipy.optimize import linear_sum_assignment

    table, found, true = _shared(labels, truth)
    if len(true) == 0 or len(found) == 0:
        both = float(len(true) == len(found))
        precision, recall = float(len(found) == 0), float(len(true) == 0)
        return Measures(recall, precision, recall, both, precision, recall, both, recall)
    iou = float(best_ious(labels, truth).mean())
    score = 2 * table / (found[None] + true[:, None])
    rows, columns = linear_sum_assignment(-score)
    shared = float(table[rows, columns].sum())
    numbers, true_numbers = np.unique(labels[labels > 0]), np.unique(truth[truth > 0])
    outlines = [boundary(labels == i) for i in numbers]
    true_outlines = [boundary(truth == i) for i in true_numbers]
    hits = np.zeros(2)
    for i, j in zip(rows, columns, strict=True):
        hits += _near(outlines[j], true_outlines[i])
    return Measures(
        iou,
        *_prf(shared / found.sum(), shared / true.sum()),
        *_prf(hits[0] / max(sum(int(o.sum()) for o in outlines), 1), hits[1] / max(sum(int(o.sum()) for o in true_outlines), 1)),
        float(np.count_nonzero(score[rows, columns] > 0.75) / len(true)),
    )


def _prf(precision: float, recall: float) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean."""
    return float(precision), float(recall), float(2 * precision * recall / max(precision + recall, 1e-12))


def _shared(
    labels: NDArray[np.integer], truth: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels that true object i and found object j share (T, F), pixels of each found one (F,) and of each true one (T,)."""
    numbers, mine = np.unique(np.maximum(labels, 0), return_inverse=True)
    true_numbers, theirs = np.unique(np.maximum(truth, 0), return_inverse=True)
    size = (len(true_numbers), len(numbers))
    table = np.bincount(theirs.ravel() * size[1] + mine.ravel(), minlength=size[0] * size[1]).reshape(size).astype(float)
    some, true_some = numbers > 0, true_numbers > 0
    return table[true_some][:, some], table.sum(axis=0)[some], table.sum(axis=1)[true_some]


def boundary(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W): pixels that differ from their right, lower or lower right neighbour."""
    result = np.zeros_like(mask)
    result[:, :-1] |= mask[:, :-1] ^ mask[:, 1:]
    result[:-1] |= mask[:-1] ^ mask[1:]
    result[:-1, :-1] |= mask[:-1, :-1] ^ mask[1:, 1:]
    return result


def _near(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(2,): pixels of outline a near b, and of b near a."""
    x, y, w, h = cv2.boundingRect((a | b).view(np.uint8))
    if w == 0:
        return np.zeros(2)
    reach = int(np.ceil(NEAR * np.hypot(*a.shape)))
    step = np.arange(-reach, reach + 1)
    disc = (step[:, None] ** 2 + step**2 <= reach**2).astype(np.uint8)
    a, b = (np.ascontiguousarray(m[y : y + h, x : x + w]) for m in (a, b))
    wide_a, wide_b = (cv2.dilate(m.view(np.uint8), disc) > 0 for m in (a, b))
    return np.array([np.count_nonzero(a & wide_b), np.count_nonzero(b & wide_a)], float)
