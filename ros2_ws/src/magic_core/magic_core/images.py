"""Image files, read in one way by every command.

Pixels are OpenCV's, of any depth and with alpha; a picture is turned as its EXIF orientation says, so that its pixels are those that
every viewer shows.  OpenCV alone would turn some formats and not others, depending on its flags.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import depth as depths
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError

#: EXIF orientation -> quarter turns against the clock, and whether it is mirrored (left to right) first.
_TURNS = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False), 7: (3, True), 8: (1, False)}
#: What a user can do about a unit.
REMEDY = "pass --depth-unit " + ", ".join(depths.UNITS) + " or another multiple"


def _orientation(path: Path) -> int:
    """The EXIF orientation of what OpenCV leaves as it is stored; it turns TIFF files itself."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            value = 1 if image.format == "TIFF" else image.getexif().get(0x0112, 1)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return 1  # a format that Pillow does not know has no EXIF either
    return value if value in _TURNS else 1


def turned(array: NDArray, orientation: int) -> NDArray:
    """An image (H, W, ...) as it is stored, as it is shown."""
    quarters, mirrored = _TURNS[orientation]
    return np.ascontiguousarray(np.rot90(array[:, ::-1] if mirrored else array, quarters))


@dataclass(frozen=True)
class Stored:
    """A file's pixels (H, W) or (H, W, C), BGR or BGRA, of its own type, as they are stored, and its EXIF orientation (1: upright)."""

    pixels: NDArray
    orientation: int

    @property
    def shown(self) -> NDArray:
        """The pixels as every viewer shows them."""
        return turned(self.pixels, self.orientation)


def load(path: str | Path, name: str, code: Code = Code.BAD_IMAGE) -> Stored:
    """An image file; ``name`` says in errors what it is.  Raises ``code`` for what is none."""
    path = Path(path).expanduser()
    if not path.is_file():
        raise MagicError(code, name, str(path), "a file that exists")
    if path.suffix.lower() == ".exr":
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    raw = np.fromfile(path, np.uint8)
    try:
        # Decoded from memory: reading files OpenCV writes warnings of its own.
        data = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if len(raw) else None
    except cv2.error:
        data = None
    if data is None or data.size == 0:
        raise MagicError(code, name, str(path), "a readable PNG, JPEG, TIFF, WebP or EXR file")
    if data.ndim == 3 and data.shape[2] == 1:
        data = data[..., 0]
    return Stored(data, _orientation(path))


def eight_bits(data: NDArray) -> NDArray[np.uint8]:
    """Pixels of any type as 8 bits: 16 bits by their range (12 bits where nothing exceeds them),
    floats by their largest where it exceeds 1."""
    if data.dtype == np.bool_:
        return data.astype(np.uint8) * 255
    if data.dtype.kind == "f":
        data = np.nan_to_num(data, nan=0.0, posinf=0.0, neginf=0.0)
        return np.clip(data * (255 / max(float(data.max()), 1.0)), 0, 255).astype(np.uint8)
    if data.dtype != np.uint8:
        full = 4095 if data.dtype == np.uint16 and data.max() <= 4095 else np.iinfo(data.dtype).max
        return np.clip(data.astype(np.float64) * (255 / full), 0, 255).astype(np.uint8)
    return data


def read(path: str | Path, name: str = "picture", code: Code = Code.BAD_IMAGE) -> NDArray[np.uint8]:
    """A picture as it is shown: (H, W), (H, W, 3) BGR or (H, W, 4) BGRA uint8."""
    data = eight_bits(load(path, name, code).shown)
    if data.ndim == 3 and data.shape[2] == 2:  # grey and alpha
        data = np.dstack([data[..., :1].repeat(3, axis=2), data[..., 1]])
    return data


def read_color(path: str | Path, name: str = "colour image", code: Code = Code.BAD_IMAGE) -> NDArray[np.uint8]:
    """A colour or grey picture as it is shown, (H, W, 3) uint8 RGB; alpha is dropped."""
    return _rgb(read(path, name, code))


def _rgb(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if data.ndim == 2:
        return np.repeat(data[..., None], 3, axis=2)
    return np.ascontiguousarray(data[..., 2::-1])


def _numbers(path: Path) -> Stored:
    """A depth file's numbers (H, W)."""
    if path.suffix.lower() == ".npy":
        try:
            stored = Stored(np.load(path, allow_pickle=False), 1)
        except (OSError, ValueError, EOFError) as error:
            raise MagicError(Code.BAD_IMAGE, "depth image", f"{path}: {error}", "a readable array") from error
    else:
        stored = load(path, "depth image")
    raw = stored.pixels
    if raw.ndim == 3 and raw.shape[2] == 1:
        stored, raw = Stored(raw[..., 0], stored.orientation), raw[..., 0]
    if raw.ndim != 2 or raw.dtype.kind not in "uif" or raw.dtype.itemsize == 1 or raw.size == 0:
        raise MagicError(Code.BAD_ENCODING, "depth image", f"{path}: {raw.shape} {raw.dtype}", "one channel, 16-bit or floating point")
    return stored


def _metres(raw: NDArray, path: Path, unit: str | None) -> NDArray[np.float32]:
    used = unit or depths.default_unit(raw.dtype)
    result = depths.in_metres(raw, used)
    depths.check_distance(result, f"depth image {path}", used, bool(unit), REMEDY)
    return depths.without_far(result)


def read_depth(path: str | Path, unit: str | None = None) -> NDArray[np.float32]:
    """A depth image (16-bit PNG, TIFF, EXR, ``.npy``) as (H, W) float32 metres, NaN where there is none.

    unit: see :func:`magic_core.depth.metres`; by default mm for whole numbers, m for floating-point ones.  Raises ``BAD_IMAGE``,
    ``BAD_ENCODING`` (8 bits, several channels), ``NO_DEPTH`` (no valid pixel), ``DEPTH_UNIT`` (:func:`magic_core.depth.check_distance`).
    """
    return _metres(_numbers(Path(path).expanduser()).shown, Path(path), unit)


@dataclass(frozen=True)
class Rgbd:
    """A colour picture as it is shown with the depth registered to it.

    color (H, W, 3) uint8 RGB; depth (H, W) float32 metres; unit of the file, and whether it was told; stored_from_shown (4, 4): from
    the optical frame of the picture as it is shown to that of the picture as it is stored, where depth and intrinsics came with the
    latter; notes: what was done to them.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    intrinsics: Intrinsics
    unit: str
    told: bool
    stored_from_shown: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()


def read_rgbd(color: str | Path, depth: str | Path, intrinsics: str, unit: str | None = None) -> Rgbd:
    """A colour image, the depth image registered to it and their intrinsics (see :func:`read_intrinsics`).

    Of a picture that is stored sideways (EXIF) depth and intrinsics may belong to the picture as it is shown or as it is stored; the
    depth's size says to which, and in the second case both are turned with it.  Where it cannot say (square, turned by half, mirrored)
    the picture is refused.  Raises what :func:`read_color`, :func:`read_depth` and :func:`read_intrinsics` do.
    """
    color, depth = Path(color).expanduser(), Path(depth).expanduser()
    picture, numbers = load(color, "colour image"), _numbers(depth)
    shown = _rgb(_flat(eight_bits(picture.shown)))
    raw = numbers.shown
    size, stored_size = shown.shape[:2], picture.pixels.shape[:2]
    if raw.shape not in (size, stored_size):
        raise MagicError(Code.BAD_IMAGE, f"size of depth image {depth}", raw.shape, f"{size}, that of the colour image")
    orientation = picture.orientation
    as_stored = orientation in (6, 8) and size != stored_size and raw.shape == stored_size
    if orientation != 1 and not as_stored and (orientation not in (6, 8) or size == stored_size):
        raise MagicError(
            Code.BAD_IMAGE,
            f"EXIF orientation of {color}",
            orientation,
            "1 (upright), or 6 and 8 where the depth's size tells whether it belongs to the picture as it is stored or as it is shown: "
            "store the picture as depth and intrinsics have it",
        )
    height, width = raw.shape
    k = read_intrinsics(intrinsics, width, height, color.name)
    used = unit or depths.default_unit(raw.dtype)
    metres = _metres(raw, depth, unit)
    if not as_stored:
        return Rgbd(shown, metres, k, used, bool(unit))
    turn = np.eye(4)
    if orientation == 6:  # clockwise: (u, v) -> (height - 1 - v, u)
        k = Intrinsics(height, width, k.fy, k.fx, height - 1 - k.cy, k.cx)
        turn[:2, :2] = [[0, 1], [-1, 0]]
    else:  # (u, v) -> (v, width - 1 - u)
        k = Intrinsics(height, width, k.fy, k.fx, k.cy, width - 1 - k.cx)
        turn[:2, :2] = [[0, -1], [1, 0]]
    note = f"{color.name} is stored sideways (EXIF orientation {orientation}): depth and intrinsics, as stored, are turned with it"
    return Rgbd(shown, turned(metres, orientation), k, used, bool(unit), turn, (note,))


def _flat(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey where there are grey and alpha."""
    return data[..., 0] if data.ndim == 3 and data.shape[2] == 2 else data


def read_intrinsics(source: str, width: int, height: int, hint: str = "") -> Intrinsics:
    """Intrinsics from ``fx,fy,cx,cy`` or a JSON file, for an image of that size; raises ``BAD_INTRINSICS``.

    The file holds ``fx, fy, cx, cy``, or a 3 x 3 ``K`` / ``intrinsic_matrix`` (nested rows, or nine
    numbers, row- or column-major), or such entries by name: ``FILE:NAME`` picks one, else the one
    that ``hint`` (a file name) begins with, else the only one.
    """
    allowed = "fx,fy,cx,cy or a JSON file with fx, fy, cx, cy or a 3 x 3 matrix"
    path, _, name = source.partition(":") if not Path(source).is_file() else (source, "", "")
    if Path(path).is_file():
        try:
            data: Any = json.loads(Path(path).read_text())
        except (OSError, ValueError) as error:
            raise MagicError(Code.BAD_INTRINSICS, "intrinsics file", f"{path}: {error}", allowed) from error
        if isinstance(data, dict) and data and all(isinstance(v, dict) for v in data.values()):
            fitting = [name] if name else [k for k in data if hint.startswith(k)] or (list(data) if len(data) == 1 else [])
            if not fitting or fitting[0] not in data:
                raise MagicError(Code.BAD_INTRINSICS, f"entry of {path}", name or hint, [f"{path}:{k}" for k in data])
            data = data[max(fitting, key=len)]
        values, size = _from_json(data, path, allowed)
        if size and size != (width, height):
            raise MagicError(
                Code.BAD_INTRINSICS, f"image size in {path}", f"{size[0]} x {size[1]}", f"{width} x {height}, the size of the depth image"
            )
    else:
        try:
            values = [float(v) for v in source.split(",")]
        except ValueError:
            raise MagicError(Code.BAD_INTRINSICS, "intrinsics", source, allowed) from None
    if len(values) != 4:
        raise MagicError(Code.BAD_INTRINSICS, "intrinsics", source, allowed)
    result = Intrinsics(width, height, *values)
    check_centre(result)
    return result


def check_centre(k: Intrinsics) -> None:
    """Raises ``BAD_INTRINSICS`` for a centre outside of the image, or one that fits the image only when it lies on its side."""
    if not (0 < k.cx < k.width and 0 < k.cy < k.height):
        raise MagicError(Code.BAD_INTRINSICS, "cx, cy", (k.cx, k.cy), f"a centre inside of {k.width} x {k.height} pixels")
    off = abs(k.cx - k.width / 2) + abs(k.cy - k.height / 2)
    turned_off = abs(k.cx - k.height / 2) + abs(k.cy - k.width / 2)
    if off > 0.1 * (k.width + k.height) / 2 and turned_off < 0.2 * off:
        raise MagicError(
            Code.BAD_INTRINSICS,
            "cx, cy",
            (k.cx, k.cy),
            f"near the middle of {k.width} x {k.height} pixels; these are of the picture turned by a quarter",
        )


def _from_json(data: Any, path: str, allowed: str) -> tuple[list[float], tuple[int, int] | None]:
    try:
        size = (int(data["width"]), int(data["height"])) if "width" in data and "height" in data else None
        if "fx" in data:
            return [float(data[k]) for k in ("fx", "fy", "cx", "cy")], size
        matrix = np.array(next(data[k] for k in ("K", "k", "intrinsic_matrix", "camera_matrix") if k in data), dtype=float).reshape(3, 3)
        if matrix[2, 0] != 0 or matrix[2, 1] != 0:  # Open3D writes the columns one after the other
            matrix = matrix.T
        return [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])], size
    except (KeyError, StopIteration, TypeError, ValueError, IndexError) as error:
        raise MagicError(Code.BAD_INTRINSICS, "intrinsics file", f"{path}: {type(error).__name__} {error}", allowed) from error
