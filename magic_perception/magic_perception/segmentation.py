"""Which pixels belong to which thing on the table.

A segmenter maps frames and the table to instance labels.  ``depth`` needs no weights: what stands above the
table, helped by the table's own colour where depth is too coarse (a 4 mm hook) or missing (a handle's edge).
``sam`` and ``sam2`` (module :mod:`magic_perception.sam`) refine its masks.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import MagicError
from magic_core.mesh import Mesh
from magic_perception import attached, between, clusters, convexity, cuts, smear
from magic_perception.parameters import Parameters
from magic_perception.seams import Judge, learned
from magic_perception.table import Plane, fit_plane, supports

T, R = TypeVar("T"), TypeVar("R")


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
        k, pose = self.frame.intrinsics, self.frame.world_from_camera
        z = self.frame.depth[rows, columns].astype(np.float32)
        local = np.empty((*z.shape, 3), np.float32)
        np.multiply((columns.astype(np.float32) - np.float32(k.cx)) / np.float32(k.fx), z, out=local[..., 0])
        np.multiply((rows.astype(np.float32) - np.float32(k.cy)) / np.float32(k.fy), z, out=local[..., 1])
        local[..., 2] = z
        return local @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)


class Segmenter(Protocol):
    """Anything that labels instances."""

    name: str

    def segment(self, looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> list[NDArray[np.int32]]:
        """Labels (H, W) int32 for each look: 0 none, i >= 1 the same thing in all cameras, -1 a known object."""


def each(function: Callable[[T], R], items: list[T], workers: int) -> list[R]:
    """``function`` of each item, in their order, by several threads: OpenCV, NumPy and Open3D work outside of Python's lock."""
    if workers < 2 or len(items) < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(min(workers, len(items))) as pool:
        return list(pool.map(function, items))


def masked_mean(values: NDArray[np.float32], weights: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean of values over a size x size window, counting only where weights are, and the share of the window that counts."""
    share = cv2.blur(weights, (size, size), borderType=cv2.BORDER_CONSTANT)
    total = cv2.blur(values * (weights[..., None] if values.ndim == 3 else weights), (size, size), borderType=cv2.BORDER_CONSTANT)
    safe = np.maximum(share, 1e-6)
    return total / (safe[..., None] if values.ndim == 3 else safe), share


def masked_mean_at(
    values: NDArray[np.float32], weights: NDArray[np.float32], size: int, where: tuple[NDArray, NDArray]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """:func:`masked_mean` of values (H, W, C) at some pixels only: (N, C) and (N,)."""
    share = cv2.blur(weights, (size, size), borderType=cv2.BORDER_CONSTANT)[where]
    total = cv2.blur(values * weights[..., None], (size, size), borderType=cv2.BORDER_CONSTANT)[where]
    return total / np.maximum(share, np.float32(1e-6))[:, None], share


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
        v, u = np.nonzero(np.isfinite(z))
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
            if other.things:
                above = 1000 * float(-other.plane.heights(centre))
                notes.append(
                    f"{other.things} things stand on a level {abs(above):.0f} mm {'above' if above > 0 else 'below'} the one taken for the table, "
                    f"on which {found[0].things} do" + (": ambiguous" if other.things >= found[0].things else "")
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
    correction = transforms.inverse(_frame_on(plane, world_from_table))
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
    raw[~valid] = np.nan
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
    sigma[~valid] = 0.002
    return Looked(frame, raw, heights, inside, np.maximum(sigma, np.float32(3e-4)), world_from_table[:3, 2].copy())


def _frame_on(plane: Plane, world_from_table: NDArray[np.float64]) -> NDArray[np.float64]:
    """world-from-plane pose nearest to ``world_from_table``, expressed so that look() can undo a camera's error."""
    z0 = world_from_table[:3, 2]
    z1 = plane.normal
    axis = np.cross(z0, z1)
    angle = float(np.arctan2(np.linalg.norm(axis), z0 @ z1))
    turn = transforms.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle)
    origin = world_from_table[:3, 3]
    origin = origin - plane.heights(origin) * z1
    return transforms.make(turn[:3, :3] @ world_from_table[:3, :3], origin)


def open_by_two(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Morphological opening by 2 x 2 pixels; with OpenCV's own even kernels the mask would move by a pixel."""
    kernel = np.ones((2, 2), np.uint8)
    return cv2.dilate(cv2.erode(mask.astype(np.uint8), kernel, anchor=(0, 0)), kernel, anchor=(1, 1)) > 0


def _total(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sum over three channels, which numpy's own sum does slowly along a short axis."""
    return values[..., 0] + values[..., 1] + values[..., 2]


#: How dark a shadow is at the darkest, in the lightness of what lies in it.
DARKEST = 0.45


def color_distance(looked: Looked, table: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """How far each pixel's colour is from the table's around it, in squared standard deviations, the same where darkness
    may be a shadow's (both (H, W)), and the threshold of notice.

    The table's colour and its spread are local means over the pixels of ``table`` (a wooden grain has a large
    spread, so nothing stands out from it lightly); the threshold is what 99.7 % of the table stays below, at least 25.
    """
    lab = cv2.cvtColor(cv2.GaussianBlur(looked.frame.color, (3, 3), 0), cv2.COLOR_RGB2LAB)
    small = cv2.resize(lab, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32)
    weights = (cv2.resize(table.astype(np.float32), small.shape[1::-1], interpolation=cv2.INTER_AREA) > 0.99).astype(np.float32)
    mean, share = masked_mean(small, weights, 31)
    variance, _ = masked_mean((small - mean) ** 2, weights, 31)
    far = share < 0.05
    if weights.sum() > 50:
        whole = small[weights > 0]
        mean[far], variance[far] = whole.mean(axis=0), whole.var(axis=0)
    size = lab.shape[1::-1]
    # Floor: 3 grey levels of noise in lightness, 2 in colour.
    weight = 1 / (variance + np.array([9.0, 4.0, 4.0], np.float32))
    distance, shaded = np.zeros(lab.shape[:2], np.float32), np.zeros(lab.shape[:2], np.float32)
    for channel in range(3):
        here, scale = cv2.resize(mean[..., channel], size), cv2.resize(weight[..., channel], size)
        offset = cv2.subtract(cv2.extractChannel(lab, channel), here, dtype=cv2.CV_32F)
        if channel == 0:
            shade = np.minimum(1 + offset / np.maximum(here, 1), 1)
            light = np.where(shade > DARKEST, np.maximum(offset, 0), offset)
            cv2.accumulateProduct(light * light, scale, shaded)
        else:
            # In a shadow both colour axes shrink with the lightness.
            less = offset + (1 - shade) * (here - 128)
            cv2.accumulateProduct(less * less, scale, shaded)
        offset *= offset
        cv2.accumulateProduct(offset, scale, distance)
    sample = np.flatnonzero(table)
    threshold = max(25.0, float(np.percentile(np.take(distance, sample[::7]), 99.7))) if len(sample) > 500 else np.inf
    return distance, shaded, threshold


def foreground(looked: Looked, parameters: Parameters) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(H, W): pixels of things on the table: higher than the noise, or of another colour than the table and not lying in it; and (H, W)
    those of the table's colour, in the light or in a shadow."""
    h, inside = looked.heights, looked.open
    valid = np.isfinite(h)
    zero = np.where(valid, h, np.float32(0))
    limit = np.maximum(np.float32(parameters.min_height), np.float32(4.0) * looked.sigma)
    raised = (zero > limit) & inside
    raised = cv2.morphologyEx(raised.view(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).view(bool)
    if not parameters.use_color:
        return raised, np.zeros_like(raised)
    around = cv2.dilate(raised.view(np.uint8), np.ones((9, 9), np.uint8)).view(bool)
    table = _outside(valid & (np.abs(zero) < limit) & inside & ~around, raised)
    if np.count_nonzero(table) < 500:
        return raised, np.zeros_like(raised)
    distance, shaded, threshold = color_distance(looked, table)
    if not np.isfinite(threshold):
        return raised, np.zeros_like(raised)
    other = (distance > threshold) & inside
    # Of another colour and a little above the table on the average of a window: a thin thing.  A shadow or a print lies at 0.
    near = other & valid & (zero < 0.03)
    total = cv2.blur(np.where(near, looked.raw, np.float32(0)), (9, 9), borderType=cv2.BORDER_CONSTANT)
    share = cv2.blur(near.astype(np.float32), (9, 9), borderType=cv2.BORDER_CONSTANT)
    thin = other & (share * np.float32(81) > 8) & (total > share * np.maximum(np.float32(0.0015), looked.sigma * np.float32(1.2)))
    core = raised | thin
    # Grow into pixels without depth that have another colour and touch what is there.
    unseen = other & ~valid
    result = clusters.connected(core | unseen, core)
    result = _fill_bowls(result, looked, other, parameters)
    color, depth, focal = looked.frame.color, looked.frame.depth, looked.frame.intrinsics.fx
    # Where depth goes on beyond a thing's edge it was not carried there.
    firm = result & ~(jump := smear.falls_back(result, depth, focal))
    result = smear.cleared(result, color, depth, table, shaded, inside & (distance > 9), jump, focal)
    result = _two_colors(result, looked, table, firm)
    return open_by_two(result), shaded < smear.LIKE


def _outside(table: NDArray[np.bool_], raised: NDArray[np.bool_], share: float = 0.2) -> NDArray[np.bool_]:
    """The table without what lies in the convex hull of something raised: the floor of a bowl is as low as the table, but has the bowl's colour.

    What spans more than ``share`` of the picture (a tray's rim, a wall) encloses the table itself.
    """
    covered = np.zeros(table.shape, np.uint8)
    outlines, _ = cv2.findContours(raised.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    for outline in outlines:
        hull = cv2.convexHull(outline)
        if cv2.contourArea(hull) < share * table.size:
            cv2.fillConvexPoly(covered, hull, 1)
    return table & (covered == 0)


def _fill_bowls(mask: NDArray[np.bool_], looked: Looked, other: NDArray[np.bool_], parameters: Parameters) -> NDArray[np.bool_]:
    """Fill holes of a mask that are not the table: of another colour, or a little higher (the floor of a spoon's bowl is a few mm up)."""
    outside = np.pad((~mask).astype(np.uint8), 1, constant_values=1)
    cv2.floodFill(outside, None, (0, 0), 2)
    holes = (outside[1:-1, 1:-1] == 1).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(holes, connectivity=4)
    result = mask.copy()
    for i in range(1, count):
        x, y, w, h, area = stats[i]
        window = (slice(y, y + h), slice(x, x + w))
        part = labels[window] == i
        heights = looked.raw[window][part]
        heights = heights[np.isfinite(heights)]
        # The fewer that are raised one by one are smear of the hole's rim: they tell nothing of its floor.
        high = heights > max(parameters.min_height, 4.0 * float(np.median(looked.sigma[window][part])))
        heights = heights[~high] if 2 * np.count_nonzero(high) <= len(heights) else heights
        if area < 12 or other[window][part].mean() > 0.7:
            result[window] |= part
        elif len(heights) > 15:
            # Standard error of the middle of a hole, for noise that is correlated over some 5 pixels.
            error = float(np.median(looked.sigma[window][part])) * 3.0 / np.sqrt(len(heights) / 5)
            if np.median(heights) > max(0.0012, 3 * error):
                result[window] |= part
    return result


def _two_colors(
    mask: NDArray[np.bool_], looked: Looked, table: NDArray[np.bool_], firm: NDArray[np.bool_], reach: int = 3
) -> NDArray[np.bool_]:
    """Move a mask's edge to where the colour is half way between the thing's and the table's next to it.

    Depth fattens edges by some pixels and a threshold on colour by one; pixels within ``reach`` of the edge are judged
    anew by the share of the thing's colour in theirs, wherever the two colours differ enough to tell; those of ``firm`` (H, W) stay.
    """
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    small = mask.astype(np.uint8)
    wide = cv2.dilate(small, kernel)
    band = (wide > 0) & ~(cv2.erode(small, kernel) > 0) & looked.open
    if not band.any():
        return mask
    inner = (cv2.erode(small, np.ones((3, 3), np.uint8)) > 0).astype(np.float32)
    # A thread of two pixels has no inside: its own pixels stand for it.
    thin = mask & (cv2.dilate(inner, np.ones((7, 7), np.uint8)) == 0)
    inner[thin] = 1.0
    free = (table & ~(cv2.dilate(small, np.ones((5, 5), np.uint8)) > 0)).astype(np.float32)
    result = mask.copy()
    # Each thing in its own window; the means look at most 15 pixels around, so that the windows change nothing.
    _, _, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8)
    for x, y, w, h, _ in stats[1:]:
        margin = 16
        r0, r1, c0, c1 = max(y - margin, 0), min(y + h + margin, mask.shape[0]), max(x - margin, 0), min(x + w + margin, mask.shape[1])
        cut = (slice(r0, r1), slice(c0, c1))
        lab = cv2.cvtColor(np.ascontiguousarray(looked.frame.color[cut]), cv2.COLOR_RGB2LAB).astype(np.float32)
        where = np.zeros(lab.shape[:2], bool)
        middle = (slice(y - r0, y - r0 + h), slice(x - c0, x - c0 + w))
        where[middle] = band[cut][middle]
        where = np.nonzero(where)
        own, share = masked_mean_at(lab, inner[cut], 13, where)
        ground, ground_share = masked_mean_at(lab, free[cut], 31, where)
        difference = own - ground
        length = _total(difference**2)
        offset = lab[where] - ground
        part = _total(offset * difference) / np.maximum(length, 1.0)
        # A pixel on the edge has a mixture of the two colours; a third colour (a side in the shade) tells nothing.
        rest = _total((offset - part[..., None] * difference) ** 2)
        before = mask[cut][where]
        told = ~(firm[cut][where] & before) & ((rest < 9.0**2) | ~before) & (length > 15.0**2) & (share > 0.02) & (ground_share > 0.05)
        # Grow only into what depth does not contradict, and by what touches the mask.
        with np.errstate(invalid="ignore"):
            possible = ~(looked.heights[cut][where] <= -0.006)
        result[cut][where] = np.where(told, (part > 0.5) & (before | possible), result[cut][where])
    return clusters.connected(result, mask, 8)


def near_known(looked: Looked, mask: NDArray[np.bool_], known: tuple[Mesh, ...], margin: float) -> NDArray[np.bool_]:
    """(H, W): pixels of ``mask`` that belong to known meshes (world): within ``margin`` of them, or seen inside or behind them."""
    result = np.zeros_like(mask)
    if not known:
        return result
    import open3d as o3d

    where = np.nonzero(mask & np.isfinite(looked.heights))
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in known:
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    if len(where[0]):
        points = np.ascontiguousarray(looked.points(*where))
        near = scene.compute_distance(o3d.core.Tensor(points), nthreads=2).numpy() < margin
        eye = looked.frame.world_from_camera[:3, 3].astype(np.float32)
        rays = np.concatenate([np.broadcast_to(eye, points.shape), points - eye], axis=1)
        # t = 1 is the measured point: a hit before it means that the point lies inside of or behind a known thing.
        behind = scene.cast_rays(o3d.core.Tensor(np.ascontiguousarray(rays)), nthreads=2)["t_hit"].numpy() < 1.0
        result[where] = near | behind
    # Pixels without depth on the known thing's silhouette.
    rest = mask & ~np.isfinite(looked.heights)
    if rest.any():
        for mesh in known:
            hull = np.concatenate([mesh.vertices])
            pixels = looked.frame.intrinsics.project(transforms.apply(transforms.inverse(looked.frame.world_from_camera), hull))
            if np.all(np.isfinite(pixels)):
                drawn = np.zeros(mask.shape, np.uint8)
                for face in mesh.faces:
                    cv2.fillConvexPoly(drawn, np.clip(pixels[face], -4000, 4000).round().astype(np.int32), 1)
                drawn = cv2.dilate(drawn, np.ones((7, 7), np.uint8)).astype(bool)
                result |= rest & drawn
    return result


@dataclass(frozen=True)
class Clusters:
    """What is above the table, by what hangs together in space.

    masks (H, W) for each look, without what is known; fixed (H, W): what is; table (H, W): what has the table's colour.  spots: rows and columns of the mask's pixels with depth in
    each look; cloud (N, 3): their world points, look by look; instance (N,): their cluster, -1 for noise.
    """

    masks: list[NDArray[np.bool_]]
    fixed: list[NDArray[np.bool_]]
    table: list[NDArray[np.bool_]]
    spots: list[tuple[NDArray, NDArray]]
    cloud: NDArray[np.float32]
    instance: NDArray[np.int64]


def clustered(looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> Clusters:
    """The clusters in all looks together; known: meshes (world) that are left out."""
    masks, tables = zip(*each(lambda looked: foreground(looked, parameters), looks, parameters.workers), strict=True)
    fixed = [near_known(looked, mask, known, parameters.known_margin) for looked, mask in zip(looks, masks, strict=True)]
    masks = [mask & ~known_pixels for mask, known_pixels in zip(masks, fixed, strict=True)]
    spots = [
        np.nonzero(mask & np.isfinite(looked.heights) & ~smear.behind(mask, looked.heights))
        for mask, looked in zip(masks, looks, strict=True)
    ]
    cloud = np.concatenate([looked.points(*where) for looked, where in zip(looks, spots, strict=True)])
    between = [_bridges(looked, mask) for looked, mask in zip(looks, masks, strict=True)]
    instance = clusters.cluster(np.concatenate([cloud, *between]), parameters.cluster_eps, parameters.cluster_points, voxel=0.004)
    # A cluster of nothing but bridges is none.
    instance = instance[: len(cloud)]
    instance[instance >= 0] = np.unique(instance[instance >= 0], return_inverse=True)[1]
    return Clusters(masks, fixed, list(tables), spots, cloud, instance)


#: A gap in depth is bridged where the surfaces on its sides are no farther apart in depth than so many times its width, beside the noise, m.
STEEP, NOISE = 1.0, 0.004


def _bridges(looked: Looked, mask: NDArray[np.bool_], samples: int = 8) -> NDArray[np.float32]:
    """Points (N, 3), world, across the gaps in a mask's depth: what colour shows to be one thing is not two for want of depth.

    Each pixel without depth goes to the nearest that has it; where two of these regions meet, straight lines join the pixels they go to.
    """
    x, y, w, h = cv2.boundingRect((mask & ~np.isfinite(looked.frame.depth)).view(np.uint8))
    # As wide a margin as a pixel without depth may be from one with it.
    cut = (slice(max(y - 16, 0), y + h + 16), slice(max(x - 16, 0), x + w + 16))
    own, z = mask[cut], looked.frame.depth[cut]
    seen = own & np.isfinite(z)
    if w == 0 or not seen.any():
        return np.zeros((0, 3), np.float32)
    _, index = cv2.distanceTransformWithLabels((~seen).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(index.max()) + 1, np.int64)
    source[index[seen]] = np.flatnonzero(seen)
    goes, flat = source[index], cv2.connectedComponents(own.view(np.uint8), connectivity=8)[1].ravel()
    meetings = []
    for axis in range(2):
        one, two, here, there, first, second = (
            np.moveaxis(image, axis, 0)[part] for image in (goes, own, seen) for part in (slice(None, -1), slice(1, None))
        )
        meet = here & there & (one != two) & ~(first & second)
        meetings.append(np.minimum(one[meet], two[meet]) * own.size + np.maximum(one[meet], two[meet]))
    a, b = np.divmod(np.unique(np.concatenate(meetings)), own.size)
    (v0, u0), (v1, u1) = (np.divmod(i, own.shape[1]) for i in (a, b))
    z0, z1, apart = z.ravel()[a].astype(float), z.ravel()[b].astype(float), np.hypot(u1 - u0, v1 - v0)
    k = looked.frame.intrinsics
    even = (apart > 2) & (flat[a] == flat[b]) & (np.abs(z1 - z0) < STEEP * apart * np.minimum(z0, z1) / k.fx + NOISE)
    t = np.linspace(0, 1, samples)[1:-1, None]
    u, v = (((1 - t) * p[even] + t * q[even]).ravel() for p, q in ((u0, u1), (v0, v1)))
    middle = (1 / ((1 - t) / z0[even] + t / z1[even])).ravel()
    local = np.column_stack([(u + cut[1].start - k.cx) / k.fx * middle, (v + cut[0].start - k.cy) / k.fy * middle, middle])
    return transforms.apply(looked.frame.world_from_camera, local).astype(np.float32)


#: A cluster is looked at for seams from so many points on, and where it is so high above the table, m: tools lie flat, and their parts belong together.
POINTS, TALL = 1500, 0.05
#: From this height on, m, a cluster may be the inside or the outside of another.
RAISED = 0.02


@dataclass(frozen=True)
class Surfaces:
    """The points of all clusters (N,): unit normals (N, 3), NaN outside of the raised clusters and where there is none; heights (N,) above the table, m;
    colours (N, 3), 0..255.  tall: the indices of the points of each cluster that may be more than one thing."""

    normal: NDArray[np.float32]
    heights: NDArray[np.float32]
    rgb: NDArray[np.float32]
    tall: list[NDArray[np.int64]]


def surfaces(looks: list[Looked], found: Clusters) -> Surfaces:
    """Of the clusters what their seams are found by."""
    heights = np.concatenate([looked.heights[where] for looked, where in zip(looks, found.spots, strict=True)])
    rgb = np.concatenate([looked.frame.color[where] for looked, where in zip(looks, found.spots, strict=True)]).astype(np.float32)
    members = [np.nonzero(found.instance == label)[0] for label in range(int(found.instance.max(initial=-1)) + 1)]
    tops = [float(np.percentile(heights[mine], 97)) if len(mine) >= POINTS else 0.0 for mine in members]
    tall = [mine for mine, top in zip(members, tops, strict=True) if top >= TALL]
    normal = np.full((len(found.cloud), 3), np.nan, np.float32)
    flags = np.zeros(len(found.cloud), bool)
    for mine, top in zip(members, tops, strict=True):
        flags[mine] = top >= RAISED
    start = 0
    for looked, (rows, columns) in zip(looks, found.spots, strict=True):
        here = flags[start : start + len(rows)]
        if here.any():
            v, u = rows[here], columns[here]
            r0, r1 = max(int(v.min()) - 8, 0), min(int(v.max()) + 9, looked.heights.shape[0])
            c0, c1 = max(int(u.min()) - 8, 0), min(int(u.max()) + 9, looked.heights.shape[1])
            window = looked.points(*np.meshgrid(np.arange(r0, r1), np.arange(c0, c1), indexing="ij"))
            field = convexity.normals(window, looked.frame.world_from_camera[:3, 3])
            near = np.nonzero((rows >= r0) & (rows < r1) & (columns >= c0) & (columns < c1))[0]
            normal[start + near] = field[rows[near] - r0, columns[near] - c0]
        start += len(rows)
    return Surfaces(normal, heights, rgb, tall)


class DepthSegmenter:
    """Table plane, table colour, clusters: no weights but those of a few criteria of seams and of upright planes.

    judge, cut: what tells whether a seam parts two things, and whether an upright plane does, instead of the weights that ship with the package.
    """

    name = "depth"

    def __init__(self, judge: Judge | None = None, cut: cuts.Judge | None = None) -> None:
        self._judge = judge or learned()
        self._cut = cut or cuts.learned()

    def segment(self, looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> list[NDArray[np.int32]]:
        """See :class:`Segmenter`."""
        found = clustered(looks, known, parameters)
        instance = (
            cuts.parted(looks, found, uncut(looks, found, self._judge, parameters), self._cut) if parameters.split else found.instance
        )
        labels = []
        start = 0
        for mask, where in zip(found.masks, found.spots, strict=True):
            image = np.zeros(mask.shape, np.int32)
            image[where] = instance[start : start + len(where[0])] + 1
            start += len(where[0])
            labels.append(_fill(image, mask))
        # What is too small for a thing and hangs together with one in the mask belongs to it: depth is not to be trusted there.
        labels = [_fill(image, mask) for image, mask in zip(_sizeable(labels, looks, parameters), found.masks, strict=True)]
        labels = _with_depth(labels, looks, parameters)
        for image, mask, fixed, looked in zip(labels, found.masks, found.fixed, looks, strict=True):
            image[fixed | _beside(fixed, mask & (image == 0) & ~np.isfinite(looked.frame.depth))] = -1
        labels = _behind_one(_attached(labels, looks, parameters), looks, parameters)
        return [_on_surfaces(image, looked) for image, looked in zip(labels, looks, strict=True)]


def uncut(looks: list[Looked], found: Clusters, judge: Judge, parameters: Parameters) -> NDArray[np.int64]:
    """The instances (N,) parted at the seams between things and where the table shows between them, before :mod:`magic_perception.cuts`."""
    return between.parted(looks, found, _parted(looks, found, judge), parameters.min_pixels)


def _parted(looks: list[Looked], found: Clusters, judge: Judge) -> NDArray[np.int64]:
    """The instances (N,) with tall clusters parted at the seams between things."""
    seen = surfaces(looks, found)
    instance = found.instance.copy()
    following = int(instance.max(initial=-1)) + 1
    for mine in seen.tall:
        part = convexity.parts(found.cloud[mine], seen.normal[mine], seen.heights[mine], seen.rgb[mine], judge)
        for number in range(1, int(part.max()) + 1):
            instance[mine[part == number]] = following
            following += 1
    return convexity.insides(found.cloud, seen.normal, instance, seen.heights)


#: Least share of a thing's pixels that has depth of its own in one camera at least.
MEASURED = 0.2


def _with_depth(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels without what colour alone tells of: beyond the table's edge, where depth ends, the floor is of another colour."""
    top = max((int(image.max()) for image in labels), default=0)
    share = np.zeros(top + 1)
    for look, image in zip(looks, labels, strict=True):
        own = image > 0
        # Depth of the table behind a thing is none of its own: a shadow of stereo at the table's edge has a few pixels that are.
        depth = own & np.isfinite(look.frame.depth) & ~smear.behind(own, look.heights)
        count, seen = (np.bincount(image[where], minlength=top + 1) for where in (own, depth))
        share = np.maximum(share, seen / np.maximum(count, 1))
    if np.all(share[1:] >= MEASURED):
        return labels
    table = np.where(share >= MEASURED, np.arange(top + 1), 0).astype(np.int32)
    return _sizeable([table[image] for image in labels], looks, parameters)


def _fill(labels: NDArray[np.int32], mask: NDArray[np.bool_], reach: float = 24.0) -> NDArray[np.int32]:
    """Give pixels of the mask that have no label the one of the nearest labelled pixel within ``reach`` pixels, if both are of one connected region."""
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    if w == 0 or h == 0:
        return labels
    margin = int(np.ceil(reach))
    cut = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
    part = labels[cut]
    seen = part > 0
    missing = np.nonzero(mask[cut] & (part == 0))
    if len(missing[0]) == 0 or not seen.any():
        return labels
    distance, index = cv2.distanceTransformWithLabels((~seen).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(int(np.count_nonzero(seen)) + 1, np.int32)
    table[index[seen]] = part[seen]
    count, regions = cv2.connectedComponents(mask[cut].view(np.uint8), connectivity=8)
    labelled = np.zeros(count, bool)
    labelled[regions[seen]] = True
    result = labels.copy()
    result[cut][missing] = np.where((distance[missing] <= reach) & labelled[regions[missing]], table[index[missing]], 0)
    return result


def _beside(fixed: NDArray[np.bool_], blank: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What of ``blank`` (H, W), which colour alone tells from the table, hangs together with a fixture: beside it stereo has a shadow, and what is seen there
    is of something behind, nobody knows of what.  It is no more the end of that than the fixture is."""
    if not (fixed.any() and blank.any()):
        return np.zeros_like(blank)
    regions = cv2.connectedComponents(blank.view(np.uint8), connectivity=8)[1]
    touched = np.unique(regions[cv2.dilate(fixed.view(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    return blank & np.isin(regions, touched)


def _attached(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels with the parts of one thing joined that depth or a seam has parted (:mod:`magic_perception.attached`)."""
    owner = attached.owners(labels, looks)
    if np.array_equal(owner, np.arange(len(owner))):
        return labels
    owner = np.append(owner, -1)
    return _sizeable([owner[image] for image in labels], looks, parameters)


#: Two parts on both sides of what hides the middle of one thing: how much nearer that is, and how far the tops may differ in height, m; least
#: common share of their histograms of colour; and so many pixels are between what is compared across an edge, of which there are so many at least.
NEARER, LEVEL, COMMON, ACROSS, EDGES = 0.012, 0.015, 0.5, (8, 20), 8


def _behind_one(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels with the parts of one thing that another hides in its middle joined: of one colour or with an upright face in one plane, equally high,
    and nothing but that other between."""
    from scipy.spatial import cKDTree

    top = max((int(image.max()) for image in labels), default=0)
    owner = np.arange(top + 2)
    for look, image in zip(looks, labels, strict=True):
        hides = _hides(image, look.frame.depth)
        for front in {f for _, f in hides}:
            parts = sorted({back for back, f in hides if f == front})
            for i, a in enumerate(parts):
                for b in parts[i + 1 :]:
                    if owner[a] == owner[b]:
                        continue
                    one, two = (_part(look, image == label) for label in (a, b))
                    if min(len(one[0]), len(two[0])) < 40 or abs(one[1] - two[1]) > LEVEL:
                        continue
                    if np.minimum(one[2], two[2]).sum() < COMMON and not _one_face(look, image, a, b):
                        continue
                    distance, nearest = cKDTree(two[0]).query(one[0])
                    order = np.argsort(distance)[:20]
                    ways = np.linspace(one[0][order], two[0][nearest[order]], 12)[1:-1]
                    k = look.frame.intrinsics
                    local = transforms.apply(transforms.inverse(look.frame.world_from_camera), ways.reshape(-1, 3).astype(float))
                    u = np.clip(np.rint(k.fx * local[:, 0] / local[:, 2] + k.cx), 0, k.width - 1).astype(int)
                    v = np.clip(np.rint(k.fy * local[:, 1] / local[:, 2] + k.cy), 0, k.height - 1).astype(int)
                    met = image[v, u]
                    if float(np.isin(met, (front, a, b)).mean()) > 0.8 and bool((met == front).any()):
                        owner[owner == max(owner[a], owner[b])] = min(owner[a], owner[b])
    if np.array_equal(owner, np.arange(top + 2)):
        return labels
    owner[-1] = -1
    return _sizeable([owner[image] for image in labels], looks, parameters)


#: Two upright faces are in one plane where their directions differ by less, degrees, and 80 % of both lie so near to it, m; so many pixels each,
#: and such a share of a part's, make a face.
PARALLEL, FLAT, FACE, FACE_SHARE = 8.0, 0.004, 60, 0.15


def _one_face(look: Looked, image: NDArray[np.int32], a: int, b: int) -> bool:
    """Whether upright faces of two labels lie in one plane, as those of a box do that something hides in its middle."""
    x, y, w, h = cv2.boundingRect(((image == a) | (image == b)).view(np.uint8))
    height, width = image.shape
    cut = (slice(max(y - 8, 0), min(y + h + 8, height)), slice(max(x - 8, 0), min(x + w + 8, width)))
    points = look.points(*np.mgrid[cut])
    normal = convexity.normals(points, look.frame.world_from_camera[:3, 3])
    up = look.normal.astype(np.float32)
    faces = []
    for label in (a, b):
        mine = (image[cut] == label) & np.isfinite(normal[..., 0]) & np.isfinite(points[..., 0])
        upright = mine & (np.abs(normal @ up) < 0.35)
        way = normal[upright][:: max(1, np.count_nonzero(upright) // 300)]
        if len(way) == 0:
            return False
        # The direction that most of them share.
        agree = way @ way.T > np.cos(np.radians(15))
        main = way[agree[np.argmax(agree.sum(axis=1))]].mean(axis=0)
        face = upright & (normal @ (main / np.linalg.norm(main)) > np.cos(np.radians(15)))
        if np.count_nonzero(face) < max(FACE, FACE_SHARE * np.count_nonzero(mine)):
            return False
        faces.append((main / np.linalg.norm(main), points[face][:: max(1, np.count_nonzero(face) // 500)]))
    (one, p), (two, q) = faces
    if one @ two < np.cos(np.radians(PARALLEL)):
        return False
    # As many of either, so that the larger does not decide alone.
    count = min(len(p), len(q))
    both = np.concatenate([p[np.linspace(0, len(p) - 1, count).astype(int)], q[np.linspace(0, len(q) - 1, count).astype(int)]])
    middle = both.mean(axis=0)
    plane = np.linalg.svd(both - middle, full_matrices=False)[2][2]
    return all(float(np.percentile(np.abs((face - middle) @ plane), 80)) < FLAT for face in (p, q))


def _hides(image: NDArray[np.int32], depth: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Pairs of labels (behind, before) that meet in a picture along an edge where the second is nearer; what is behind may have lost its depth there."""
    found: dict[tuple[int, int], int] = {}
    for axis, across in ((axis, across) for axis in range(2) for across in ACROSS):
        first, second = (np.moveaxis(image, axis, 0)[part] for part in (slice(None, -across), slice(across, None)))
        rows, columns = np.nonzero((first != second) & (first > 0) & (second > 0))
        if len(rows) == 0:
            continue
        z = np.moveaxis(depth, axis, 0)
        step = z[rows + across, columns] - z[rows, columns]
        for sign, pair in ((1, (second, first)), (-1, (first, second))):
            far = sign * step > NEARER
            keys, counts = np.unique(np.stack([p[rows[far], columns[far]] for p in pair]), axis=1, return_counts=True)
            for (back, front), count in zip(keys.T, counts, strict=True):
                found[int(back), int(front)] = max(found.get((int(back), int(front)), 0), int(count) // across)
    return [pair for pair, count in found.items() if count >= EDGES]


def _part(look: Looked, mask: NDArray[np.bool_]) -> tuple[NDArray[np.float32], float, NDArray[np.float64]]:
    """Points (N, 3) of a mask, the height of its top and its histogram of the two colour axes, which sums to 1."""
    rows, columns = np.nonzero(mask & np.isfinite(look.heights))
    if len(rows) == 0:
        return np.zeros((0, 3), np.float32), 0.0, np.zeros(256)
    step = max(1, len(rows) // 1500)
    rows, columns = rows[::step], columns[::step]
    lab = cv2.cvtColor(np.ascontiguousarray(look.frame.color[rows, columns][None]), cv2.COLOR_RGB2LAB)[0].astype(int)
    histogram = np.bincount((np.clip(lab[:, 1] - 64, 0, 127) // 8) * 16 + np.clip(lab[:, 2] - 64, 0, 127) // 8, minlength=256) / len(lab)
    return look.points(rows, columns), float(np.percentile(look.heights[rows, columns], 95)), histogram


#: Pixels beside the seam of two labels that are judged anew, and half the window around them in which surfaces are fitted; standard deviations of depth
#: from which a pixel is not of its own surface, and within which it is of another; least share of the window that tells of a surface.
BAND, FITTED, OFF, ON, SUPPORT = 6, 14, 2.5, 1.5, 0.06


def _on_surfaces(labels: NDArray[np.int32], look: Looked) -> NDArray[np.int32]:
    """Labels (H, W) whose seams follow the surfaces on either side: parts come in voxels, several pixels wide.

    Near a seam a pixel that lies off the plane through its own label's pixels farther in, and on that of the other's, is the other's.  Of a plane the inverse
    depth is linear in the picture, so that moments over a window fit all planes at once.
    """
    meets = np.zeros(labels.shape, bool)
    for axis in range(2):
        one, two = (np.moveaxis(labels, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        seam = (one != two) & (one > 0) & (two > 0)
        np.moveaxis(meets, axis, 0)[:-1] |= seam
        np.moveaxis(meets, axis, 0)[1:] |= seam
    if not meets.any():
        return labels
    size = 2 * BAND + 1
    near = cv2.dilate(meets.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
    depth = look.frame.depth
    band = near & (labels > 0) & np.isfinite(depth)
    sigma = np.maximum(look.sigma, np.float32(0.0015))
    best, winner = np.full(labels.shape, np.inf, np.float32), labels.copy()
    own = np.full(labels.shape, np.inf, np.float32)
    for label in (int(i) for i in np.unique(labels[meets])):
        x, y, w, h = cv2.boundingRect((meets & (labels == label)).view(np.uint8))
        margin = BAND + FITTED + 1
        cut = (slice(max(y - margin, 0), y + h + margin), slice(max(x - margin, 0), x + w + margin))
        core = (labels[cut] == label) & ~near[cut] & np.isfinite(depth[cut])
        reach = cv2.dilate((labels[cut] == label).view(np.uint8), np.ones((size, size), np.uint8)) > 0
        rows, columns = np.nonzero(band[cut] & reach)
        off = _off_plane(depth[cut], core, rows, columns) / sigma[cut][rows, columns]
        mine = labels[cut][rows, columns] == label
        own[cut][rows[mine], columns[mine]] = off[mine]
        better = ~mine & (off < best[cut][rows, columns])
        best[cut][rows[better], columns[better]] = off[better]
        winner[cut][rows[better], columns[better]] = label
    changed = band & (own > OFF) & np.isfinite(own) & (best < ON)
    result = np.where(changed, winner, labels)
    # A thin bar before another thing is none of that: its pixels lie off the other's surface.
    return np.where(best < 2 * OFF, _smooth_seams(result, near), result)


def _off_plane(
    depth: NDArray[np.float32], core: NDArray[np.bool_], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """How far pixels (N,) lie from the plane through those of ``core`` (H, W) around each, m; infinite where too few tell."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width].astype(float)
    v, u = v - height / 2, u - width / 2
    weight = core.astype(float)
    inverse = np.where(core, 1 / np.where(core, depth, 1), 0.0)
    size = (2 * FITTED + 1,) * 2

    def at(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)[rows, columns]

    n, su, sv = at(weight), at(weight * u), at(weight * v)
    suu, suv, svv = at(weight * u * u), at(weight * u * v), at(weight * v * v)
    sq, suq, svq = at(inverse), at(inverse * u), at(inverse * v)
    enough = n > SUPPORT * size[0] * size[1]
    safe = np.maximum(n, 1)
    mu, mv, mq = su / safe, sv / safe, sq / safe
    # A ridge of one pixel's spread: along a thin strip the plane across it is not told.
    cuu, cuv, cvv = suu / safe - mu**2 + 1, suv / safe - mu * mv, svv / safe - mv**2 + 1
    cuq, cvq = suq / safe - mu * mq, svq / safe - mv * mq
    det = cuu * cvv - cuv**2
    a, b = (cvv * cuq - cuv * cvq) / det, (cuu * cvq - cuv * cuq) / det
    told = mq + a * (u[rows, columns] - mu) + b * (v[rows, columns] - mv)
    return np.where(enough, np.abs(depth[rows, columns] - 1 / np.maximum(told, 1e-3)), np.inf)


def _smooth_seams(labels: NDArray[np.int32], near: NDArray[np.bool_], size: int = 7) -> NDArray[np.int32]:
    """Labels (H, W) with each labelled pixel of ``near`` given to the label that most of its neighbours have."""
    best, winner = np.zeros(labels.shape, np.float32), labels.copy()
    x, y, w, h = cv2.boundingRect(near.view(np.uint8))
    cut = (slice(max(y - size, 0), y + h + size), slice(max(x - size, 0), x + w + size))
    part = labels[cut]
    for label in (int(i) for i in np.unique(part[near[cut] & (part > 0)])):
        share = cv2.blur((part == label).astype(np.float32), (size, size), borderType=cv2.BORDER_CONSTANT)
        more = share > best[cut]
        best[cut][more] = share[more]
        winner[cut][more] = label
    return np.where(near & (labels > 0), winner, labels)


def _sizeable(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Drop what is too small, and number the rest from 1, by their pixels, most first."""
    spots = [np.nonzero(image > 0) for image in labels]
    values = [image[where] for image, where in zip(labels, spots, strict=True)]
    top = max((int(v.max(initial=0)) for v in values), default=0)
    pixels = np.stack([np.bincount(v, minlength=top + 1) for v in values])
    order = [np.argsort(v, kind="stable") for v in values]
    starts = [np.concatenate([[0], np.cumsum(row)]) for row in pixels]
    keep = []
    for label in range(1, top + 1):
        if pixels[:, label].max() < parameters.min_pixels:
            continue
        clouds = []
        for looked, where, turn, start in zip(looks, spots, order, starts, strict=True):
            mine = turn[start[label] : start[label + 1]]
            mine = mine[:: max(1, len(mine) // 2000)]
            clouds.append(looked.points(where[0][mine], where[1][mine]))
        points = np.concatenate(clouds)
        points = points[np.isfinite(points[:, 0])]
        if len(points) < 20:
            continue
        low, high = np.percentile(points, [3, 97], axis=0)
        if np.max(high - low) < parameters.min_extent:
            continue
        keep.append((pixels[:, label].sum(), label))
    keep.sort(reverse=True)
    table = np.zeros(top + 2, np.int32)
    table[-1] = -1
    for new, (_, old) in enumerate(keep[: parameters.max_objects]):
        table[old] = new + 1
    return [table[image] for image in labels]
