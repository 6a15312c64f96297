"""One camera's picture over the table: how high above it each pixel lies, and the table itself."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import MagicError
from magic_perception.parameters import Parameters
from magic_perception.pixels import where
from magic_perception.table import ALIKE, Plane, fit_plane, supports


@dataclass(frozen=True)
class Looked:
    """One frame over the table.

    heights (H, W) float32 metres above the table, the camera's own small error of calibration taken out, lightly
    smoothed; raw heights are unsmoothed; NaN without depth.  inside (H, W): in the region of interest, whose
    z counts from the table.
    sigma (H, W): standard deviation of ``heights``, measured on the table.  normal (3,): of the table, in the world.
    """

    frame: RgbdFrame
    raw: NDArray[np.float32]
    heights: NDArray[np.float32]
    inside: NDArray[np.bool_]
    sigma: NDArray[np.float32]
    normal: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def open(self) -> NDArray[np.bool_]:
        """(H, W): where the scene in the region of interest is seen: inside and not blind."""
        return self.inside if self.frame.blind is None else self.inside & ~self.frame.blind

    def points(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        """World points (..., 3) in metres at pixels, row and column (...) each; NaN without depth."""
        return self._placed(self.frame.depth[rows, columns], rows, columns)

    def cloud(self, cut: tuple[slice, slice]) -> NDArray[np.float32]:
        """The same (h, w, 3) of a window of the picture, its rows and columns."""
        rows, columns = (np.arange(*part.indices(size)) for part, size in zip(cut, self.frame.depth.shape, strict=True))
        return self._placed(self.frame.depth[cut], rows[:, None], columns[None])

    def _placed(self, depth: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.float32]:
        k, pose = self.frame.intrinsics, self.frame.world_from_camera
        z = depth.astype(np.float32)
        local = np.empty((*z.shape, 3), np.float32)
        np.multiply((columns.astype(np.float32) - np.float32(k.cx)) / np.float32(k.fx), z, out=local[..., 0])
        np.multiply((rows.astype(np.float32) - np.float32(k.cy)) / np.float32(k.fy), z, out=local[..., 1])
        local[..., 2] = z
        return local @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)


#: Metres and degrees within which a camera's own plane is looked for around the common one.
APART, TILTED = 0.06, 5.0


def find_table(frames: list[RgbdFrame], parameters: Parameters, notes: list[str] | None = None) -> tuple[Plane, list[Plane]]:
    """The table in world coordinates, and as each camera sees it (which takes small errors of calibration out).

    The table is looked for at any height within the region's x and y; ``notes`` gets a sentence where its height is not
    expected, or another level has the same claim.  A camera that sees no plane near the common one uses that.
    """
    clouds = []
    low, high = np.asarray(parameters.region_low, float), np.asarray(parameters.region_high, float)
    bounded = [axis for axis in range(2) if np.isfinite(low[axis]) or np.isfinite(high[axis])]
    for frame in frames:
        k = frame.intrinsics
        z = frame.depth[::4, ::4]
        v, u = where(np.isfinite(z))
        z = z[v, u].astype(float)
        points = transforms.apply(frame.world_from_camera, np.column_stack([(4 * u - k.cx) / k.fx * z, (4 * v - k.cy) / k.fy * z, z]))
        keep = np.ones(len(points), bool)
        for axis in bounded:
            keep &= (points[:, axis] > low[axis]) & (points[:, axis] < high[axis])
        clouds.append(points[keep])
    up = (0.0, 0.0, 1.0)
    everything = np.concatenate(clouds)
    both = fit_plane(everything, up, parameters.table_tilt, parameters.table_band, seed=parameters.seed)
    found = supports(everything, both, parameters.table_band)
    if found[0].plane is not both and found[0].plane.coefficients[3] != both.coefficients[3]:
        near = everything[np.abs(found[0].plane.heights(everything)) < 2 * parameters.table_band]
        both = fit_plane(near, found[0].plane.normal, 5.0, parameters.table_band, seed=parameters.seed)
    centre = np.median(everything[np.abs(both.heights(everything)) < 0.02], axis=0)
    if notes is not None:
        for other in found[1:]:
            if other.things >= 0.5:
                above = 1000 * float(-other.plane.heights(centre))
                notes.append(
                    f"{other.things:.0f} things stand on a level {abs(above):.0f} mm {'above' if above > 0 else 'below'} the one taken for the table, "
                    f"on which {found[0].things:.0f} do" + (": ambiguous" if other.things >= found[0].things - ALIKE else "")
                )
        if not low[2] <= centre[2] <= max(-low[2], 0.0):
            notes.append(
                f"table found {1000 * centre[2]:.0f} mm from the base's height (region_low z: {1000 * low[2]:.0f} mm): heights are taken from the table found"
            )
    own = []
    share = float(np.mean(np.abs(both.heights(everything)) < parameters.table_band))
    for cloud in clouds:
        plane = both
        heights = np.abs(both.heights(cloud))
        # Far from the common plane only where little lies near it: a tray's plane is not to be lost to the table's below it.
        close = np.count_nonzero(heights < parameters.table_band) > 0.3 * share * len(cloud)
        near = cloud[heights < (parameters.table_band if close else APART)]
        if len(near) > 300:
            try:
                plane = fit_plane(near, both.normal, TILTED, parameters.table_band, iterations=80, seed=parameters.seed)
            except MagicError:
                pass
        own.append(plane)
    return both, own


def look(frame: RgbdFrame, plane: Plane, world_from_table: NDArray[np.float64], parameters: Parameters) -> Looked:
    """Heights above the table of one frame; the frame is moved by the small motion that carries ``plane`` onto z = 0 of the table frame."""
    correction = transforms.inverse(frame_on(plane, world_from_table))
    # Correct the pose, not the heights alone, so that both cameras agree in the table's plane too.
    pose = world_from_table @ correction @ frame.world_from_camera
    frame = replace(frame, world_from_camera=pose)
    k = frame.intrinsics
    table_from_camera = transforms.inverse(world_from_table) @ pose
    z = np.ascontiguousarray(frame.depth, dtype=np.float32)
    across = ((np.arange(k.width) - k.cx) / k.fx).astype(np.float32)[None, :]
    down = ((np.arange(k.height) - k.cy) / k.fy).astype(np.float32)[:, None]

    def along(row: NDArray[np.float64]) -> NDArray[np.float32]:
        """(H, W): the dot product of ``row`` (3,) and each pixel's ray (x, y, 1)."""
        x, y, one = row.astype(np.float32)
        return across * x + (down * y + one)

    row = table_from_camera[2]
    fall = along(row[:3])
    raw = cv2.multiply(z, fall)
    raw += np.float32(row[3])
    valid = np.isfinite(raw)
    # Without depth a pixel counts as inside where its ray meets the table there.
    reach = np.float32(-row[3]) / np.minimum(fall, np.float32(-1e-3))
    inside = reach < 5.0
    distance = None
    for axis in range(2):
        low, high = np.float32(parameters.region_low[axis]), np.float32(parameters.region_high[axis])
        if np.isfinite(low) or np.isfinite(high):
            distance = np.where(valid, z, reach) if distance is None else distance
            where = along(pose[axis, :3])
            where *= distance
            where += np.float32(pose[axis, 3])
            inside &= where > low
            inside &= where < high
    np.copyto(raw, np.float32(np.nan), where=~valid)
    with np.errstate(invalid="ignore"):
        inside &= ~((raw < np.float32(parameters.region_low[2])) | (raw > np.float32(parameters.region_high[2])))
    zero = np.where(valid, raw, np.float32(0))
    # Bias of depth over the table, which varies slowly over the picture: a quarter of its resolution will do.
    near = (valid & (np.abs(zero) < 0.008)).astype(np.float32)
    small = (max(1, k.width // 4), max(1, k.height // 4))
    count, total = (
        cv2.blur(cv2.resize(x, small, interpolation=cv2.INTER_AREA), (21, 21), borderType=cv2.BORDER_CONSTANT) for x in (near, near * zero)
    )
    bias = np.where(count > 0.15, total / np.maximum(count, 1e-6), 0).astype(np.float32)
    raw -= cv2.resize(bias, (k.width, k.height))
    zero = np.where(valid, raw, np.float32(0))
    # Smooth over nearby pixels of like height only: an edge of 10 mm must not smear.
    share = cv2.blur(valid.astype(np.float32), (3, 3), borderType=cv2.BORDER_CONSTANT)
    smooth = cv2.blur(zero, (3, 3), borderType=cv2.BORDER_CONSTANT)
    smooth /= np.maximum(share, np.float32(1e-6))
    heights = np.where(valid & (cv2.absdiff(smooth, zero) < 0.01), smooth, raw)
    flat = np.flatnonzero(valid & (np.abs(zero) < 0.01) & inside)
    sigma = np.where(valid, z, np.float32(0))
    sigma *= sigma
    if len(flat) > 500:
        sample = flat[::5]
        sigma *= np.float32(1.4826 * np.median(np.abs(np.take(heights, sample)) / np.take(sigma, sample)))
    else:
        sigma *= np.float32(1.4826 * 0.002)
    np.copyto(sigma, np.float32(0.002), where=~valid)
    return Looked(frame, raw, heights, inside, np.maximum(sigma, np.float32(3e-4)), world_from_table[:3, 2].copy())


def frame_on(plane: Plane, world_from_table: NDArray[np.float64]) -> NDArray[np.float64]:
    """world-from-plane pose nearest to ``world_from_table``, expressed so that look() can undo a camera's error."""
    z0 = world_from_table[:3, 2]
    z1 = plane.normal
    axis = np.cross(z0, z1)
    angle = float(np.arctan2(np.linalg.norm(axis), z0 @ z1))
    turn = transforms.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle)
    origin = world_from_table[:3, 3]
    origin = origin - plane.heights(origin) * z1
    return transforms.make(turn[:3, :3] @ world_from_table[:3, :3], origin)
