"""Depth images in metres: their units, what in them is no depth, and whether they can be a table-top before an arm.

A wrong unit makes a scene that looks right and is ten times too small: it is refused wherever depth comes in, from files and from
topics alike, with the unit that it looks like.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError

#: Units that cameras and files are known to use, by their names; any other multiple is written the same way.
UNITS = ("mm", "cm", "m", "0.1mm", "0.25mm")
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "um": 1e-6}
#: What lies beyond is no depth, m: stereo, structured light and time of flight for table-tops end before.
FAR = 20.0
#: The least median distance, and the least distance of all but the nearest twentieth, m, of a picture whose unit was not told.  Depth
#: cameras see nothing nearer than 0.17 m (a D435; a D405 some 0.1 m), and an arm reaches nothing beyond 1.5 m.
LEAST, MOST = 0.15, 1.5
#: The same where the unit was told: close-ups of a camera on the hand, cameras under a ceiling.
LEAST_TOLD, MOST_TOLD = 0.08, 4.0
#: Median distances, m, that table-tops are seen from: what a wrong unit is guessed by.
USUAL = (0.25, 1.5)
#: How many times farther or nearer than the plane below it a picture may be, whose camera's pose is known.
OFF = 3.0
#: Things so large (m), all of them, seen from so far away (m), are more likely smaller ones in a smaller unit.
LARGE, AWAY = 0.3, 1.1


def metres(unit: str) -> float:
    """What 1 is in metres: ``mm``, ``cm``, ``m``, ``um``, or a multiple (``0.1mm``, ``0.25mm``).  Raises ``DEPTH_UNIT``."""
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)?\s*(um|mm|cm|m)\s*", unit)
    value = float(match[1] or 1) * _METRES[match[2]] if match else 0.0
    if not value > 0:
        raise MagicError(Code.DEPTH_UNIT, "unit of depth", unit, (*UNITS, "or another multiple, as 0.2mm"))
    return value


def default_unit(dtype: np.dtype) -> str:
    """Whole numbers are millimetres and floating-point ones metres (REP-118), unless something else is told."""
    return "m" if dtype.kind == "f" else "mm"


def in_metres(raw: NDArray, unit: str = "") -> NDArray[np.float32]:
    """Numbers (H, W) of a sensor as float32 metres, NaN where there is no depth: 0, negative, NaN, infinite, or an integer type's largest
    number (65535), which drivers write into holes.  unit: of the numbers; empty: :func:`default_unit`."""
    factor = metres(unit or default_unit(raw.dtype))
    depth = raw.astype(np.float32) * np.float32(factor)
    none = ~np.isfinite(depth) | (depth <= 0)
    if raw.dtype.kind in "ui":
        none |= raw == np.iinfo(raw.dtype).max
    depth[none] = np.nan
    return depth


def without_far(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The depth, with NaN where it lies beyond :data:`FAR`."""
    return np.where(depth <= FAR, depth, np.float32(np.nan))


def looks_like(median: float, unit: str) -> str:
    """Which units would make a usual distance of what ``unit`` made this median (m) of, the likeliest first; empty: none would."""
    found = []
    for other in UNITS:
        value = median * metres(other) / metres(unit)
        if other != unit and USUAL[0] <= value <= USUAL[1]:
            found.append((abs(np.log(value / 0.7)), f"{other} ({value:.2f} m)"))
    return " or ".join(text for _, text in sorted(found))


def check_distance(depth: NDArray[np.float32], what: str, unit: str, told: bool, remedy: str) -> None:
    """Raises ``NO_DEPTH`` where nothing is seen, ``DEPTH_UNIT`` where all of it is too near or too far for a table-top before an arm.

    depth (H, W) metres, read as ``unit``; told: somebody said so, it is no default.  what, remedy: for the message.
    """
    seen = depth[np.isfinite(depth)]
    if len(seen) == 0:
        raise MagicError(Code.NO_DEPTH, f"{what}: pixels with depth", 0, "at least one: above 0, finite and no integer's largest")
    near, middle = (float(x) for x in np.percentile(seen, (5, 50)))
    least, most = (LEAST_TOLD, MOST_TOLD) if told else (LEAST, MOST)
    if middle < least or near > most:
        like = looks_like(middle, unit)
        allowed = f"a median from {least} m on and something nearer than {most} m; " + (f"it looks like {like}: " if like else "")
        raise MagicError(
            Code.DEPTH_UNIT,
            f"{what}, read as {unit}",
            f"median {middle:.4g} m, the nearest twentieth up to {near:.4g} m",
            allowed + remedy,
        )


def check_sizes(distance: float, sizes: list[float], unit: str, told: bool, remedy: str) -> None:
    """Raises ``DEPTH_UNIT`` where all things (their longest sides, m) are large and far away (m), and the unit was not told."""
    if not told and sizes and distance > AWAY and min(sizes) > LARGE:
        like = looks_like(distance, unit)
        raise MagicError(
            Code.DEPTH_UNIT,
            f"depth, read as {unit}",
            f"the smallest thing is {min(sizes):.2f} m across, seen from {distance:.2f} m",
            f"a thing of up to {LARGE} m; " + (f"it looks like {like}: " if like else "") + f"{remedy}, also where {unit} is right",
        )


def times_as_far(frame: RgbdFrame, low: tuple[float, ...] = (-np.inf, -np.inf), high: tuple[float, ...] = (np.inf, np.inf)) -> float | None:
    """How many times farther than the plane z = 0 the picture is: the median over the pixels whose rays meet it within 3 m of the camera
    and within the region's x and y (low, high); ``None`` where fewer than 100 do."""
    depth = frame.depth[::4, ::4]
    v, u = np.mgrid[0 : frame.depth.shape[0] : 4, 0 : frame.depth.shape[1] : 4]
    k, pose = frame.intrinsics, frame.world_from_camera
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.where(rays[..., 2] < -1e-3, -pose[2, 3] / rays[..., 2], np.nan)
        hit = pose[:3, 3] + rays * expected[..., None]
        good = (expected > 0) & (expected < 3.0) & np.isfinite(depth)
        for axis in (0, 1):
            good &= (hit[..., axis] > low[axis]) & (hit[..., axis] < high[axis])
    if np.count_nonzero(good) < 100:
        return None
    return float(np.median(depth[good] / expected[good]))


def check_pose(
    frame: RgbdFrame,
    unit: str,
    remedy: str,
    low: tuple[float, ...] = (-np.inf, -np.inf),
    high: tuple[float, ...] = (np.inf, np.inf),
) -> None:
    """Raises ``DEPTH_UNIT`` where the picture lies several times farther or nearer than the table that its camera's pose puts below it."""
    times = times_as_far(frame, low, high)
    if times is None or 1 / OFF < times < OFF:
        return
    likely = [u for u in UNITS if 1 / 1.3 < metres(u) * times / metres(unit) < 1.3]
    raise MagicError(
        Code.DEPTH_UNIT,
        f"depth of {frame.camera}, read as {unit}",
        f"{times:.3g} times as far as the plane z = 0 under the camera's pose",
        f"{1 / OFF:.2g} to {OFF:.2g} times; " + (f"it looks like {likely[0]}: {remedy}" if likely else f"{remedy}, or mend the pose"),
    )
