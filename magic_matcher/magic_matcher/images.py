"""Matching from picture files alone: masks from a plain background, views in pixels.

Large pictures are matched at the size that the method needs (:class:`Picture`): cut to the
object, averaged over blocks of whole pixels, and what is found is carried back and put on the
full mask's edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import images as files
from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView
from magic_matcher import contour as contours

#: Share of the border that must agree with the background's colour for it to count as plain.
PLAIN_SHARE = 0.8
#: Smallest side of a picture, px.
SMALLEST = 8
#: Longest side, px, at which an object is matched, and of a picture that is not cut to its object.
WORKING, WHOLE = 768, 1024
#: Rows of a picture that are compared with the background at a time.
_STRIPE = 128
#: Canny's thresholds (the paper authors' code).
CANNY = (100, 200)


def decode(path: str | Path, name: str) -> NDArray[np.uint8]:
    """A picture file as it is shown (:mod:`magic_core.images`), (H, W), (H, W, 3) BGR or (H, W, 4) BGRA uint8; ``name`` says in errors what
    it is."""
    data = files.read(path, name, Code.BAD_REQUEST_IMAGE)
    if min(data.shape[:2]) < SMALLEST:
        raise MagicError(
            Code.BAD_REQUEST_IMAGE, f"size of {name} {path}", f"{data.shape[1]}x{data.shape[0]}", f"{SMALLEST} px or more a side"
        )
    return data


def read(path: str | Path) -> NDArray[np.uint8]:
    """A picture file as RGBA (H, W, 4) uint8; alpha is 255 where the file has none."""
    data = decode(path, "picture")
    if data.ndim == 2:
        data = cv2.cvtColor(data, cv2.COLOR_GRAY2BGRA)
    elif data.shape[2] == 3:
        data = cv2.cvtColor(data, cv2.COLOR_BGR2BGRA)
    return cv2.cvtColor(data, cv2.COLOR_BGRA2RGBA)


def read_mask(path: str | Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask file of the picture's size (H, W): on where brighter than half of its brightest (255, or 1), and opaque."""
    data = decode(path, "mask")
    if data.ndim == 3:
        grey = cv2.cvtColor(np.ascontiguousarray(data[..., :3]), cv2.COLOR_BGR2GRAY)
        data = np.where(data[..., 3] > 127, grey, 0) if data.shape[2] == 4 else grey
    if data.shape != size:
        raise MagicError(
            Code.BAD_REQUEST_IMAGE, f"size of mask {path}", f"{data.shape[1]}x{data.shape[0]}", f"that of its picture, {size[1]}x{size[0]}"
        )
    if not data.any():
        raise MagicError(Code.EMPTY_MASK, f"mask {path}", "black all over", "a mask that is 255 on the object")
    return data > data.max() / 2


def mask_from_background(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The object (H, W) bool in a picture (H, W, 3 or 4) with a plain background, or with a background that is transparent.

    The background's colour is the border's median; what differs from it by more than
    the border itself does is the object, specks left out; a hole that shows the background
    stays a hole.  Where nothing differs enough in colour the object is what Canny's edges
    enclose.  Raises ``EMPTY_MASK`` where the border is not plain or there is no object.
    """
    if image.shape[2] == 4 and (image[..., 3] < 128).any():
        mask = image[..., 3] >= 128
        if not mask.any():
            raise MagicError(Code.EMPTY_MASK, "picture", "transparent all over", "an object on a transparent background")
        return mask
    lab = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2LAB)
    width = max(2, min(image.shape[:2]) // 50)
    sides = (lab[:width], lab[-width:], lab[width:-width, :width], lab[width:-width, -width:])
    border = np.concatenate([side.reshape(-1, 3) for side in sides]).astype(np.float32)
    colour = np.median(border, axis=0)
    spread = float(np.percentile(np.linalg.norm(border - colour, axis=-1), 100 * PLAIN_SHARE))
    if spread > 18:
        raise MagicError(
            Code.EMPTY_MASK,
            "the picture's background is not plain: four fifths of its border differ from their median by up to",
            f"{spread:.0f} (CIELAB)",
            "18, or give a mask",
        )
    threshold = max(12.0, 3 * spread)
    # The squares of the differences by table, a stripe at a time: large pictures stay in the processor's cache.
    squares = ((np.arange(256, dtype=np.float32)[None, :, None] - colour.astype(np.float32)) ** 2).astype(np.float32)
    mask = np.empty(image.shape[:2], np.uint8)
    for row in range(0, len(mask), _STRIPE):
        differs = cv2.LUT(lab[row : row + _STRIPE], squares)
        mask[row : row + _STRIPE] = cv2.transform(differs, np.ones((1, 3), np.float32)) > threshold**2
    # Lines one pixel wide are noise.  The anchors are opposite corners: OpenCV's own opening would move the object by a pixel.
    square = np.ones((2, 2), np.uint8)
    mask = cv2.dilate(cv2.erode(mask, square, anchor=(0, 0)), square, anchor=(1, 1))
    found = _large(mask)
    if found is None:
        found = _large(_enclosed(image))
    if found is None:
        raise MagicError(
            Code.EMPTY_MASK,
            "objects that stand out from the picture's plain background, by colour or by an outline",
            0,
            "one, or give a mask",
        )
    if found.mean() > 0.95:
        raise MagicError(
            Code.EMPTY_MASK,
            "share of the picture that stands out from its border",
            round(float(found.mean()), 3),
            "at most 0.95, or give a mask",
        )
    return found


def _large(mask: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """The parts of a mask that are no specks, ``None`` where it has none."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    largest = int(stats[1:, cv2.CC_STAT_AREA].max()) if count > 1 else 0
    if largest < 64:
        return None
    kept = stats[:, cv2.CC_STAT_AREA] >= 0.02 * largest
    kept[0] = False
    return kept[labels]


def _enclosed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What Canny's edges enclose (H, W) 0 or 1: all that cannot be reached from the border without crossing an edge."""
    grey = cv2.GaussianBlur(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY), (0, 0), 0.8)
    edges = cv2.Canny(grey, *CANNY)
    if not edges.any():
        # A faint outline, but much stronger than what the rest of the picture has.
        steepness = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
        high = max(4 * float(np.percentile(steepness, 90)), 16.0)
        edges = cv2.Canny(grey, high / 2, high)
    walls = np.pad(cv2.morphologyEx(edges, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)), 1)
    outside = walls.copy()
    cv2.floodFill(outside, None, (0, 0), 128)
    # The edge's own pixels are half outside: taken off again with what the closing added.
    return cv2.morphologyEx((outside != 128).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))[1:-1, 1:-1]


def view(picture: str | Path, mask: str | Path | None = None, kind: str = "top") -> CanonicalView:
    """A picture file as a view in which one metre is one pixel and the object frame is the view's."""
    image, on = _image_and_mask(picture, mask)
    return CanonicalView(image, on, 1.0, np.eye(4), kind)


def _image_and_mask(picture: str | Path, mask: str | Path | None) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A picture (H, W, 3) uint8 RGB, black off its object, and the object's mask."""
    data = read(picture)
    if mask is not None:
        on = read_mask(mask, data.shape[:2])
    else:
        try:
            on = mask_from_background(data)
        except MagicError as error:
            raise MagicError(error.code, f"{picture}: {error.message}") from error
    image = np.ascontiguousarray(data[..., :3])
    return cv2.bitwise_and(image, image, mask=on.view(np.uint8)), on


@dataclass(frozen=True)
class Picture:
    """A picture file and the view in which it is matched.

    mask (H, W): of the file; view: at working size, one metre a pixel of the view; block: file pixels a side of a pixel of
    the view; corner (2,): the file's pixel (u, v) at which the view's first begins.
    """

    mask: NDArray[np.bool_]
    view: CanonicalView
    block: int
    corner: NDArray[np.int64]

    def to_view(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """File pixels (..., 2) in the view; (0, 0) is the centre of the first pixel in both."""
        return (points - self.corner + 0.5) / self.block - 0.5

    def to_file(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """The view's pixels (..., 2) in the file."""
        return (points + 0.5) * self.block - 0.5 + self.corner

    def on_edge(self, point: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """The point (2,) of the file moved along its normal onto the full mask's edge; as it is where there is none within two blocks."""
        if self.block == 1:
            return point
        at = np.arange(-2.0 * self.block, 2.0 * self.block + 0.25, 0.25)
        reach = 2 * self.block + 8
        low = np.maximum(np.floor(point).astype(int) - reach, 0)
        cut = self.mask[low[1] : low[1] + 2 * reach + 2, low[0] : low[0] + 2 * reach + 2].astype(np.float32)
        line = (point - low + at[:, None] * normal).astype(np.float32)
        soft = cv2.GaussianBlur(cut, (0, 0), contours.BLUR, borderType=cv2.BORDER_CONSTANT)
        value = cv2.remap(soft, line[None, :, 0], line[None, :, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
        leaves = np.nonzero((value[:-1] >= 0.5) & (value[1:] < 0.5))[0]
        if not len(leaves):
            return point
        k = leaves[np.argmin(np.abs(at[leaves]))]
        return point + (at[k] + 0.25 * float((value[k] - 0.5) / (value[k] - value[k + 1]))) * normal

    @cached_property
    def size(self) -> tuple[int, int]:
        """Width and height of the file, px."""
        return self.mask.shape[1], self.mask.shape[0]

    def enlarged(self, picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """A picture of the view (h, w) at the file's size (H, W), 0 beyond the view and off the mask."""
        if self.block == 1 and picture.shape == self.mask.shape:
            return picture
        height, width = picture.shape
        large = cv2.resize(picture, (width * self.block, height * self.block), interpolation=cv2.INTER_LINEAR)
        result = np.zeros(self.mask.shape, np.float32)
        left, top = (int(c) for c in self.corner)
        part = result[top : top + large.shape[0], left : left + large.shape[1]]
        part[:] = large[: part.shape[0], : part.shape[1]]
        result[~self.mask] = 0.0
        return result


def load(picture: str | Path, mask: str | Path | None = None, kind: str = "top") -> Picture:
    """A picture file for matching; as :func:`view`, but an object that is large in pixels is cut out and averaged over blocks."""
    image, on = _image_and_mask(picture, mask)
    rows, columns = (np.nonzero(on.any(axis=axis))[0] for axis in (1, 0))
    height, width = int(rows[-1] - rows[0]) + 1, int(columns[-1] - columns[0]) + 1
    block = -(-max(height, width) // WORKING)
    if block == 1 and max(on.shape) <= WHOLE:
        return Picture(on, CanonicalView(image, on, 1.0, np.eye(4), kind), 1, np.zeros(2, dtype=np.int64))
    margin = 16 * block
    left, top = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
    right, bottom = min(on.shape[1], int(columns[-1]) + 1 + margin), min(on.shape[0], int(rows[-1]) + 1 + margin)
    fill = ((0, -(bottom - top) % block), (0, -(right - left) % block))
    small = np.pad(image[top:bottom, left:right], (*fill, (0, 0)))
    share = np.pad(on[top:bottom, left:right].astype(np.float32), fill)
    if block > 1:
        size = (share.shape[1] // block, share.shape[0] // block)
        small, share = cv2.resize(small, size, interpolation=cv2.INTER_AREA), cv2.resize(share, size, interpolation=cv2.INTER_AREA)
    kept = share >= 0.5
    if not kept.any():
        raise MagicError(
            Code.EMPTY_MASK, f"{picture}: width of the object", f"less than {block} px", "an object that fills more of its extent"
        )
    small[~kept] = 0
    return Picture(on, CanonicalView(small, kept, 1.0, np.eye(4), kind), block, np.array([left, top]))
