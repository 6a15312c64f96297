"""Several frames of a camera at rest as one frame with less noise."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_perception.pixels import opened

#: A place has changed since an older frame where a channel of its colour, smoothed, is off by more than this (of 255)...
CHANGED = 10.0
#: ...and than so many times what the frames are off by elsewhere...
NOISES = 5.0
#: ...in a blob of so many pixels in both directions.
BLOB = 3
#: So have as many pixels around it.
AROUND = 7
#: So has depth that is off by more than the spread in a blob of so many pixels: flicker at edges is narrower.
FAR_BLOB = 9
#: The same of two means, which have less noise: levels of colour.
FAINT = 6.0
#: Of depth, m at one metre (as its noise, growing with the square), in a blob of so many pixels.
SHIFT, DEEP_BLOB = 0.006, 7
#: How far the camera may be from where it was (entries of its pose).
PLACE = 1e-4
#: Where depth spreads by more than this (m) between frames the median is taken: edges flicker between two surfaces.
SPREAD = 0.015


def average(frames: list[RgbdFrame]) -> RgbdFrame:
    """The mean of the frames of one camera that stands still, as of the last of them, whose stamp and pose it has.

    A pixel needs depth in half of the frames that count there.  Where the values spread by more than :data:`SPREAD` metres (edges flicker
    between two surfaces) the median is taken instead of the mean, so that no surface is made up between two.
    What moves, and what the robot hid before, is taken from the frames alone that show it as the last one does: the mean of a thing's
    places is a thing that is nowhere.  Blind is what is blind in the last frame. So is what is held. Raises ``BAD_IMAGE`` for frames of
    different sizes, ``NO_FRAMES`` for none.
    """
    if not frames:
        raise MagicError(Code.NO_FRAMES, "frames to average", 0, "at least one")
    last = frames[-1]
    if len(frames) == 1:
        return last
    if any(f.depth.shape != last.depth.shape for f in frames):
        raise MagicError(Code.BAD_IMAGE, "sizes of the frames to average", [f.depth.shape for f in frames], "one size")
    older = [_still(frame, last, SPREAD) for frame in frames[:-1]]
    used = np.stack([*older, np.ones_like(older[0])])
    depth = np.stack([f.depth for f in frames]).astype(np.float32)
    valid = np.isfinite(depth) & used
    # Frame by frame: numpy reduces a short axis slowly.
    count, uses = _summed(valid.view(np.uint8)), _summed(used.view(np.uint8))
    mean = _summed(np.where(valid, depth, np.float32(0))) / np.maximum(count, 1)
    nearest, farthest = np.where(valid, depth, np.float32(np.inf)), np.where(valid, depth, np.float32(-np.inf))
    wide = reduce(np.maximum, farthest) - reduce(np.minimum, nearest) > SPREAD
    if wide.any():
        ordered = np.sort(np.where(valid[:, wide], depth[:, wide], np.inf), axis=0)
        mean[wide] = np.take_along_axis(ordered, ((count[wide].astype(np.intp) - 1) // 2)[None], axis=0)[0]
    mean[2 * count < uses] = np.nan
    if last.blind is not None:
        mean[last.blind] = np.nan
    total = np.zeros(last.color.shape, np.float32)
    for frame, counts in zip(frames, used, strict=True):
        cv2.accumulate(frame.color, total, mask=counts.view(np.uint8))
    color = np.clip(total / uses[..., None] + np.float32(0.5), 0, 255).astype(np.uint8)
    return replace(last, depth=mean, color=color)


def _summed(stack: NDArray) -> NDArray[np.float32]:
    """The sum (H, W) over a stack (N, H, W)."""
    return reduce(np.add, stack, np.float32(0))


def unchanged(frame: RgbdFrame, before: RgbdFrame) -> bool:
    """Whether a mean of frames shows what an earlier one of the same camera, from the same place, did: no blob of it differs by more than
    noise."""
    if not _comparable(frame, before):
        return False
    (blind, veiled), (held, was_held) = _blind(frame, before), _held(frame, before)
    other = (np.isfinite(frame.depth) != np.isfinite(before.depth)) | _deeper(frame, before)
    return not (
        opened(_recolored(frame, before, FAINT), BLOB).any()
        or opened(other & ~blind & ~veiled, DEEP_BLOB).any()
        or opened(blind != veiled, DEEP_BLOB).any()
        or opened(held != was_held, DEEP_BLOB).any()
    )


def unchanged_beside_robot(frame: RgbdFrame, before: RgbdFrame) -> bool:
    """The same but for where one of both shows the robot, or what that holds, and for depth that there is in one of both only: beside an
    arm is its shadow, which the second imager does not see."""
    if not _comparable(frame, before):
        return False
    robot = np.logical_or.reduce([*_blind(frame, before), *_held(frame, before)])
    beside = cv2.dilate(robot.view(np.uint8), np.ones((2 * AROUND + 1,) * 2, np.uint8)) == 0
    return not (opened(_recolored(frame, before, FAINT) & beside, BLOB).any() or opened(_deeper(frame, before) & beside, DEEP_BLOB).any())


def _comparable(frame: RgbdFrame, before: RgbdFrame) -> bool:
    """Whether two frames are of one camera at one place."""
    if frame.camera != before.camera or frame.depth.shape != before.depth.shape or frame.intrinsics != before.intrinsics:
        return False
    return bool(np.allclose(frame.world_from_camera, before.world_from_camera, atol=PLACE))


def _blind(*frames: RgbdFrame) -> list[NDArray[np.bool_]]:
    return [np.zeros(f.depth.shape, bool) if f.blind is None else f.blind for f in frames]


def _held(*frames: RgbdFrame) -> list[NDArray[np.bool_]]:
    return [np.zeros(f.depth.shape, bool) if f.held is None else f.held > 0 for f in frames]


def _deeper(frame: RgbdFrame, before: RgbdFrame) -> NDArray[np.bool_]:
    """(H, W): where both have depth, and another one."""
    with np.errstate(invalid="ignore"):
        return np.abs(frame.depth - before.depth) > SHIFT * np.maximum(frame.depth, 0.5) ** 2


def _recolored(frame: RgbdFrame, other: RgbdFrame, least: float) -> NDArray[np.bool_]:
    """(H, W): where two frames differ in colour, by more than ``least`` (of 255) and than elsewhere."""
    red, green, blue = cv2.split(cv2.absdiff(frame.color, other.color))
    difference = cv2.GaussianBlur(cv2.max(cv2.max(red, green), blue), (0, 0), 1.0)
    return difference > max(least, NOISES * float(np.median(difference)))


def _still(frame: RgbdFrame, last: RgbdFrame, spread: float) -> NDArray[np.bool_]:
    """(H, W): where a frame shows what the last one does."""
    changed = opened(_recolored(frame, last, CHANGED), BLOB)
    with np.errstate(invalid="ignore"):
        changed |= opened(np.abs(frame.depth - last.depth) > spread, FAR_BLOB)
    if changed.any():
        changed = cv2.dilate(changed.view(np.uint8), np.ones((2 * AROUND + 1,) * 2, np.uint8)).view(bool)
    for blind in (frame.blind, last.blind):
        if blind is not None:
            changed = changed | blind
    return ~changed
