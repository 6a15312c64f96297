"""Earlier views that still hold: what a camera saw from another place, or before something came between.

A camera that moves leaves frames behind (keyframes) that show sides of things which it no longer sees; one that stands still is
remembered where the robot now stands before it.  They are looked at together with the newest frames, as if more cameras stood there, as
long as nothing newer contradicts them: a thing that a newer frame looks through, sees where there was nothing, or sees displaced is blotted
out of the older ones (:func:`contradicted`), so that what moved is not smeared over where it was.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_perception import cameras
from magic_perception.looks import Looked
from magic_perception.pixels import opened

#: Two frames show the same from places nearer than this, m, with axes nearer than this, rad; and a camera has stood still within these.
NEAR, TURNED = 0.08, float(np.radians(12))
STILL, STEADY = 0.001, 0.002
#: What the robot hides of things is worth another look from so many pixels on.
LEAST = 120
#: Pixels beside a mask and inside of one that tell nothing; a contradiction is as large as this, pixels, in both directions.
GRACE, INNER, BLOB = 3, 3, 5
#: Metres that depth is off at most, besides four standard deviations; and, behind a thing, that show it gone.
SLACK, BEHIND = 0.008, 0.025
#: A thing that stands so far, m, from where it was has moved.
MOVED = 0.005
#: Pixels around what has changed that are blotted out with it: depth is smeared past edges.
AROUND = 9


@dataclass(frozen=True)
class Keyframe:
    """A frame that is kept; things (H, W) bool: where it shows any."""

    frame: RgbdFrame
    things: NDArray[np.bool_]


class Keyframes:
    """The views of the last scenes that add to the newest frames.

    limit: so many are kept, one for each place of a camera, the newest ones; 0: none.  memory: for so many seconds by the stamps.
    """

    def __init__(self, limit: int = 4, memory: float = 60.0) -> None:
        self.limit, self.memory = limit, memory
        self._kept: list[Keyframe] = []

    def useful(self, frames: list[RgbdFrame]) -> list[RgbdFrame]:
        """Those kept that show what the newest ``frames`` do not: seen from elsewhere, or where the robot hides things now."""
        newest = max((f.stamp for f in frames), default=-np.inf)
        if any(k.frame.stamp > newest + 1.0 for k in self._kept):
            self._kept = []  # a bag began again
        self._kept = [k for k in self._kept if newest - k.frame.stamp <= self.memory]
        return [k.frame for k in self._kept if self._adds(k, frames)]

    @staticmethod
    def _adds(kept: Keyframe, frames: list[RgbdFrame]) -> bool:
        for frame in frames:
            if alike(kept.frame, frame, NEAR, TURNED):
                if frame.blind is None or frame.blind.shape != kept.things.shape:
                    return False
                return np.count_nonzero(kept.things & frame.blind) >= LEAST
        return True

    def update(
        self,
        frames: list[RgbdFrame],
        labels: list[NDArray[np.int32]],
        earlier: list[tuple[RgbdFrame, RgbdFrame]],
        still: Collection[str],
        carried: Collection[int] = (),
    ) -> None:
        """Keep the frames of a scene; labels (H, W): where things are in them; earlier: what :meth:`useful` gave and what has become of
        it since; still: the cameras that did not move while these frames were taken; carried: labels of what will not stay where it is,
        which is blotted out: a thing in the robot's hand is hidden by it as soon as it has left."""
        after = {id(old): new for old, new in earlier}
        kept = []
        for item in self._kept:
            new = after.get(id(item.frame), item.frame)
            things = item.things if new.blind is None else item.things & ~new.blind
            if np.count_nonzero(things) >= LEAST:
                kept.append(Keyframe(new, things))
        for frame, image in zip(frames, labels, strict=True):
            if frame.camera not in still or self.limit < 1:
                continue
            things = image > 0
            passing = np.isin(image, list(carried)) & things
            if passing.any():
                passing = _widened(passing)
                frame, things = frame.blinded(passing), things & ~passing
            new = Keyframe(frame, things)
            for old in [k for k in kept if alike(k.frame, frame, NEAR, TURNED)]:
                kept = [k for k in kept if k is not old]
                if alike(old.frame, frame, STILL, STEADY):
                    new = _over(old, new)
                elif frame.blind is not None and np.count_nonzero(old.things & frame.blind) >= LEAST:
                    kept.append(old)
            if np.count_nonzero(new.things) >= LEAST:
                kept.append(new)
        self._kept = sorted(kept, key=lambda k: k.frame.stamp)[-self.limit :] if self.limit else []


def alike(one: RgbdFrame, other: RgbdFrame, near: float, turned: float) -> bool:
    """Whether two frames are of one camera, or of two, in places nearer than ``near`` m with axes nearer than ``turned`` rad."""
    apart = np.linalg.norm(one.world_from_camera[:3, 3] - other.world_from_camera[:3, 3])
    return bool(apart < near and transforms.rotation_angle(one.world_from_camera, other.world_from_camera) < turned)


def _over(old: Keyframe, new: Keyframe) -> Keyframe:
    """The newer of two frames from one place, with what the older one shows where the newer is blind."""
    if new.frame.blind is None or old.frame.depth.shape != new.frame.depth.shape:
        return new
    blind = np.zeros_like(new.frame.blind) if old.frame.blind is None else new.frame.blind & old.frame.blind
    fill = new.frame.blind & ~blind
    if not fill.any():
        return new
    depth = np.where(fill, old.frame.depth, new.frame.depth)
    color = np.where(fill[..., None], old.frame.color, new.frame.color)
    return Keyframe(replace(new.frame, depth=depth, color=color, blind=blind), new.things | (old.things & fill))


def contradicted(
    looks: list[Looked], labels: list[NDArray[np.int32]], current: int, world_from_table: NDArray[np.float64]
) -> list[NDArray[np.bool_]]:
    """For each look but the first ``current`` ones, (H, W): what of it newer looks show to have moved, gone or come since.

    looks and labels (H, W): the newest first, then earlier ones in the order of their stamps.
    """
    result = []
    for i in range(current, len(looks)):
        newer = [*range(current), *range(i + 1, len(looks))]
        changed: set[int] = set()
        for k in newer:
            for one, other in ((i, k), (k, i)):
                refuted = opened(_refuted(looks[one], labels[one], looks[other], labels[other]), BLOB)
                changed |= set(np.unique(labels[one][refuted]).tolist())
        # What is seen from both sides may stand a little beside where it stood; whoever sees most of it tells.
        for label in sorted(set(np.unique(labels[i][labels[i] > 0]).tolist()) - changed):
            best = max(newer, key=lambda k: np.count_nonzero(labels[k] == label))
            pair = labels[i], labels[best]
            if np.any(pair[1] == label) and cameras.shifted(looks[i], looks[best], pair, label, world_from_table) > MOVED:
                changed.add(label)
        stale = np.isin(labels[i], sorted(changed))
        # What the older look shows where the thing is now is what was behind it.
        for k in newer if changed else ():
            stale |= _drawn(looks[k], np.isin(labels[k], sorted(changed)), looks[i])
        if changed:
            stale = _widened(stale)
        result.append(stale)
    return result


def _widened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return cv2.dilate(mask.view(np.uint8), np.ones((2 * AROUND + 1,) * 2, np.uint8)).view(bool)


def _projected(
    look: Looked, rows: NDArray[np.int64], columns: NDArray[np.int64], other: Looked
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Row, column and depth (N,) in another look of pixels of one, and whether they are inside of its picture."""
    k = other.frame.intrinsics
    points = look.points(rows, columns).astype(float)
    local = transforms.apply(transforms.inverse(other.frame.world_from_camera), points)
    z = np.maximum(local[:, 2], 1e-3)
    u, v = np.rint(k.fx * local[:, 0] / z + k.cx), np.rint(k.fy * local[:, 1] / z + k.cy)
    inside = (local[:, 2] > 0.05) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    u, v = (np.where(inside, x, 0).astype(int) for x in (u, v))
    return v, u, local[:, 2], inside


def _refuted(look: Looked, labels: NDArray[np.int32], other: Looked, there: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(H, W): pixels of things in one look whose places another look sees to be empty, or to be of something else that does not hide
    them."""
    result = np.zeros(labels.shape, bool)
    small = labels.astype(np.int16)
    kernel = np.ones((2 * INNER + 1,) * 2, np.uint8)
    inner = (small > 0) & (cv2.erode(small, kernel) == cv2.dilate(small, kernel))
    rows, columns = np.nonzero(inner & np.isfinite(look.heights) & np.isfinite(look.frame.depth))
    if len(rows) == 0:
        return result
    v, u, z, inside = _projected(look, rows, columns, other)
    beside = cv2.distanceTransform((there == 0).view(np.uint8), cv2.DIST_L2, 5) > GRACE
    depth, sigma = other.frame.depth[v, u], 4 * other.sigma[v, u]
    told = inside & np.isfinite(depth) & other.open[v, u] & (there[v, u] >= 0)
    slack = np.maximum(SLACK, sigma)
    with np.errstate(invalid="ignore"):
        empty = told & ((beside[v, u] & (depth > z - slack)) | (depth > z + np.maximum(BEHIND, 2 * sigma)))
    result[rows[empty], columns[empty]] = True
    return result


def _drawn(look: Looked, mask: NDArray[np.bool_], other: Looked) -> NDArray[np.bool_]:
    """(H, W): the pixels of another look on which those of a mask fall, without gaps."""
    drawn = np.zeros(other.frame.depth.shape, np.uint8)
    rows, columns = np.nonzero(mask & np.isfinite(look.frame.depth))
    if len(rows):
        v, u, _, inside = _projected(look, rows, columns, other)
        drawn[v[inside], u[inside]] = 1
    return cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)).view(bool)
