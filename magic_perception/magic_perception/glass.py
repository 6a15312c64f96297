"""What stands on the table and gives no depth (a glass, polished metal): found by colour, reconstructed by nobody, said."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_perception.foreground import color_distance
from magic_perception.looks import Looked
from magic_perception.smear import softened

#: Least size of a region without depth, m; least share of its surroundings that is seen to be the table; least share of its pixels
#: of another colour than the table there, and how that differs, in squared standard deviations.
SIZE, AROUND, OTHER, UNLIKE = 0.025, 0.6, 0.2, 25.0
#: A depth shadow is narrower than this, m.
SHADOW = 0.012


@dataclass(frozen=True)
class Unmeasured:
    """Something without depth: where its middle would lie on the table (3,), world, m, and its larger extent there, m."""

    place: NDArray[np.float64]
    extent: float

    def __str__(self) -> str:
        x, y, _ = self.place
        return f"something that gives no depth, {1000 * self.extent:.0f} mm wide, stands at ({x:.2f}, {y:.2f}) m: it is no object, and motions do not avoid it"


def unmeasured(look: Looked, labels: NDArray[np.int32], world_from_table: NDArray[np.float64]) -> list[Unmeasured]:
    """The regions without depth and without a label (H, W) that the table surrounds and whose colour is not the table's."""
    valid = np.isfinite(look.heights)
    blank = (~valid & look.open & (labels == 0)).view(np.uint8)
    k, pose = look.frame.intrinsics, look.frame.world_from_camera
    scale = float(np.nanmedian(look.frame.depth[::8, ::8])) / k.fx
    # Shadows beside things and lone pixels are thin.
    width = 2 * max(1, round(SHADOW / scale / 2)) + 1
    thick = cv2.morphologyEx(blank, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
    if not thick.any():
        return []
    count, regions, stats, _ = cv2.connectedComponentsWithStats(thick, connectivity=8)
    with np.errstate(invalid="ignore"):
        table = valid & look.inside & (np.abs(look.heights) < np.maximum(0.006, 4 * look.sigma)) & (labels == 0)
    distance = None
    found = []
    for i in range(1, count):
        x, y, w, h, area = stats[i]
        if max(w, h) * scale < SIZE or area < 60:
            continue
        cut = (slice(max(y - 5, 0), y + h + 5), slice(max(x - 5, 0), x + w + 5))
        mine = regions[cut] == i
        ring = (cv2.dilate(mine.view(np.uint8), np.ones((9, 9), np.uint8)) > 0) & ~mine
        # What ends at the picture's border is not surrounded.
        border = x < 3 or y < 3 or x + w > k.width - 3 or y + h > k.height - 3
        if border or float(table[cut][ring].mean()) < AROUND:
            continue
        if distance is None:
            free = cv2.erode(table.view(np.uint8), np.ones((5, 5), np.uint8)) > 0
            if np.count_nonzero(free) < 500:
                return []
            distance = color_distance(softened(look.frame.color), free)[1]
        if float((distance[cut][mine] > UNLIKE).mean()) < OTHER:
            continue
        # Its foot is its lowest pixel in the picture; its middle lies about half its width behind.
        ray = pose[:3, :3] @ np.array([(x + w / 2 - k.cx) / k.fx, (y + h - min(w, h) / 2 - k.cy) / k.fy, 1.0])
        reach = look.normal @ (world_from_table[:3, 3] - pose[:3, 3]) / (look.normal @ ray)
        found.append(Unmeasured(pose[:3, 3] + reach * ray, max(w, h) * float(reach) / k.fx))
    return found


def once(found: list[Unmeasured]) -> list[Unmeasured]:
    """What several cameras see, once."""
    result: list[Unmeasured] = []
    for item in found:
        if all(np.linalg.norm(item.place - other.place) > max(item.extent, other.extent) for other in result):
            result.append(item)
    return result
