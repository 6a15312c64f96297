"""Several frames of a camera at rest as one frame with less noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError


def average(frames: list[RgbdFrame], spread: float = 0.015) -> RgbdFrame:
    """The mean of the frames of one camera that stands still; stamp and pose are those of the last.

    A pixel needs depth in half of the frames.  Where the values spread by more than ``spread`` metres (edges flicker
    between two surfaces) the median is taken instead of the mean, so that no surface is made up between two.
    What is blind in one of them is blind in the mean: colours of the robot and of what is behind it are mixed there.
    Raises ``BAD_IMAGE`` for frames of different sizes, ``NO_FRAMES`` for none.
    """
    if not frames:
        raise MagicError(Code.NO_FRAMES, "frames to average", 0, "at least one")
    last = frames[-1]
    if len(frames) == 1:
        return last
    if any(f.depth.shape != last.depth.shape for f in frames):
        raise MagicError(Code.BAD_IMAGE, "sizes of the frames to average", [f.depth.shape for f in frames], "one size")
    depth = np.stack([f.depth for f in frames]).astype(np.float32)
    valid = np.isfinite(depth)
    count = valid.sum(axis=0)
    filled = np.where(valid, depth, 0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    wide = np.where(valid, depth, -np.inf).max(axis=0) - np.where(valid, depth, np.inf).min(axis=0) > spread
    if wide.any():
        ordered = np.sort(np.where(valid[:, wide], depth[:, wide], np.inf), axis=0)
        mean[wide] = np.take_along_axis(ordered, ((count[wide] - 1) // 2)[None], axis=0)[0]
    mean[2 * count < len(frames)] = np.nan
    veils = [f.blind for f in frames if f.blind is not None]
    blind = np.logical_or.reduce(veils) if veils else None
    if blind is not None:
        mean[blind] = np.nan
    total = np.zeros(last.color.shape, np.float32)
    for frame in frames:
        cv2.accumulate(frame.color, total)
    color = np.clip(total / len(frames) + 0.5, 0, 255).astype(np.uint8)
    return replace(last, depth=mean.astype(np.float32), color=color, blind=blind)
