"""Matching from picture files alone: masks from a plain background, views in pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView

#: Share of the border that must agree with the background's colour for it to count as plain.
PLAIN_SHARE = 0.8


def read(path: str | Path) -> NDArray[np.uint8]:
    """A picture file as RGBA (H, W, 4) uint8; alpha is 255 where the file has none."""
    data = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if data is None:
        raise MagicError(Code.BAD_REQUEST_IMAGE, "picture", str(path), "a readable PNG or JPEG file")
    if data.dtype != np.uint8:
        data = (data / max(np.iinfo(data.dtype).max / 255, 1)).astype(np.uint8)
    if data.ndim == 2:
        data = cv2.cvtColor(data, cv2.COLOR_GRAY2BGRA)
    elif data.shape[2] == 3:
        data = cv2.cvtColor(data, cv2.COLOR_BGR2BGRA)
    return cv2.cvtColor(data, cv2.COLOR_BGRA2RGBA)


def read_mask(path: str | Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask file (on where brighter than half) of the picture's size (H, W)."""
    data = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if data is None:
        raise MagicError(Code.BAD_REQUEST_IMAGE, "mask", str(path), "a readable PNG file")
    if data.shape != size:
        raise MagicError(Code.BAD_REQUEST_IMAGE, f"size of mask {path}", f"{data.shape[1]}x{data.shape[0]}", f"that of its picture, {size[1]}x{size[0]}")
    if not (data > 127).any():
        raise MagicError(Code.EMPTY_MASK, f"mask {path}", "no pixel above 127", "a mask that is 255 on the object")
    return data > 127


def mask_from_background(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The object (H, W) bool in a picture (H, W, 3 or 4) with a plain background, or with a background that is transparent.

    The background's colour is the border's median; what differs from it by more than
    the border itself does is the object, holes included, specks left out.  Raises
    ``EMPTY_MASK`` where the border is not plain or nothing differs from it.
    """
    if image.shape[2] == 4 and (image[..., 3] < 128).any():
        mask = image[..., 3] >= 128
        if not mask.any():
            raise MagicError(Code.EMPTY_MASK, "picture", "transparent all over", "an object on a transparent background")
        return mask
    lab = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2LAB).astype(np.float32)
    width = max(2, min(image.shape[:2]) // 50)
    inner = np.zeros(image.shape[:2], bool)
    inner[width:-width, width:-width] = True
    border = lab[~inner]
    colour = np.median(border, axis=0)
    distance = np.linalg.norm(lab - colour, axis=-1)
    spread = float(np.percentile(distance[~inner], 100 * PLAIN_SHARE))
    if spread > 18:
        raise MagicError(
            Code.EMPTY_MASK, "the picture's background is not plain: four fifths of its border differ from their median by up to", f"{spread:.0f} (CIELAB)", "18, or give a mask"
        )
    threshold = max(12.0, 3 * spread)
    mask = (distance > threshold).astype(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        raise MagicError(Code.EMPTY_MASK, "objects that stand out from the picture's plain background", 0, "one, or give a mask")
    largest = int(stats[1:, cv2.CC_STAT_AREA].max())
    if largest < 64 or largest > 0.95 * mask.size:
        raise MagicError(Code.EMPTY_MASK, "pixels that stand out from the picture's plain background", largest, f"64 to {int(0.95 * mask.size)}, or give a mask")
    keep = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= 0.02 * largest]
    return np.isin(labels, keep)


def view(picture: str | Path, mask: str | Path | None = None, kind: str = "top") -> CanonicalView:
    """A picture file as a view in which one metre is one pixel and the object frame is the view's."""
    data = read(picture)
    if mask is not None:
        on = read_mask(mask, data.shape[:2])
    else:
        try:
            on = mask_from_background(data)
        except MagicError as error:
            raise MagicError(error.code, f"{picture}: {error.message}") from error
    image = data[..., :3].copy()
    image[~on] = 0
    return CanonicalView(image, on, 1.0, np.eye(4), kind)
