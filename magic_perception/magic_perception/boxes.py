"""Upright boxes with sharp or rounded edges and cylinders, where two faces at least are seen: cartons, bricks, tins of meat or fish, cans.

All three are fitted to the same measurements in the same way, so that their errors can be compared: what is as wide as long is a box only
where a box explains it better than a cylinder does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.mesh import Mesh
from magic_perception.sight import Sight
from magic_perception.solids import Reconstruction, hull_of

#: Least size, m, and least share of the points on each of two faces.
LEAST, FACE = 0.02, 0.08
#: The 90th percentile of the points' distances to the surface, m, and the median distance of the masks' edges to its outline, pixels, may
#: be so large.
RESIDUAL, EDGE = 0.004, 2.0
#: A share of the points larger than this that lies farther than AWAY, m, from the surface is a part of its own (a handle), and no noise.
PART, AWAY = 0.02, 0.010
#: Errors beyond this are outliers, m.
ROBUST = 0.003
#: Over so much of 0.1 m (0.3 mm) and of a radian differences are taken.
STEP = 3e-3
#: A footprint longer than wide by this factor is no circle.  What has more to fit by explains better only with an error smaller by this
#: factor, as rounded edges beside sharp ones and a box beside a cylinder: of 43 procedural boxes rounded edges had 0.99 to 1.02 of the
#: error of sharp ones, of 20 tins 0.16 to 0.79.
OBLONG, ROUNDER = 1.5, 0.85
#: Of half its box's width a cylinder's side lies so deep in that at most, 1 - cos 45 degrees.
HOLLOW = 0.3
#: So many corners has a quarter of a rounded edge; which way they are from its middle, quarter by quarter, and the signs of the quarters.
QUARTER = 6
ROUNDED = np.array([(np.cos(a), np.sin(a)) for q in range(4) for a in np.linspace(0, np.pi / 2, QUARTER + 1) + q * np.pi / 2])
QUARTERS = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])


@dataclass(frozen=True)
class Box:
    """An upright box on the table z = 0: middle (2,), sizes (3,) along its own x and y and up, m; ``yaw`` of its x, radians; ``corner``:
    radius of its upright edges, m, at most half of its shorter side."""

    middle: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: float
    corner: float = 0.0

    @property
    def round(self) -> bool:
        """Whether it is a cylinder."""
        return self.corner >= 0.4999 * float(self.size[:2].max())

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (N, 3) in the box's axes, from the middle of its bottom."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        away = points[:, :2] - self.middle
        return np.column_stack([away @ [c, s], away @ [-s, c], points[:, 2]])

    def beyond(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3): how far points (N, 3) lie out of the faces along x, y and up; negative within."""
        local = self.local(points)
        return np.column_stack([np.abs(local[:, :2]) - self.size[:2] / 2, local[:, 2] - self.size[2]])

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,): signed distance of points (N, 3) to the sides and the top, positive outside."""
        x, y, above = self.beyond(points).T
        x, y = x + self.corner, y + self.corner
        beside = np.hypot(np.maximum(x, 0), np.maximum(y, 0)) + np.minimum(np.maximum(x, y), 0) - self.corner
        return np.hypot(np.maximum(beside, 0), np.maximum(above, 0)) + np.minimum(np.maximum(beside, above), 0)

    def corners(self) -> NDArray[np.float64]:
        """(K, 3): of the bottom, then of the top; 8 of a box with sharp edges."""
        turns, quarters = (ROUNDED, np.repeat(QUARTERS, QUARTER + 1, axis=0)) if self.corner > 0 else (QUARTERS, QUARTERS)
        local = quarters * (self.size[:2] / 2 - self.corner) + self.corner * turns
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        ring = self.middle + local @ np.array([[c, s], [-s, c]])
        return np.column_stack([np.concatenate([ring, ring]), np.repeat([0.0, self.size[2]], len(ring))])


def recognise_box(sights: list[Sight], height: float, noise: float) -> Reconstruction | None:
    """The box or upright cylinder on whose faces lies what was measured and whose outline the masks have; ``None`` where they tell of
    something else, or of one face only.

    A box with sharp edges where that will do, else one whose upright edges are rounded; a cylinder instead of either where that has smaller
    errors.
    height: of the points above the table; noise: standard deviation of the heights; metres.
    """
    if not LEAST < height < 0.4:
        return None
    # What depth has lost is not told by what lies beside it.
    told = np.concatenate([sight.measured for sight in sights])
    sample = told[:: max(1, len(told) // 800)]
    if len(sample) < 80:
        return None
    start = _start(sample, height)
    if start is None:
        return None
    # Far from any box, or hollow: what follows would take its time in vain.  A cylinder's side is nowhere deeper in its box.
    off, deep = start.distance(sample), max(AWAY, HOLLOW * float(start.size[:2].min()) / 2)
    if float(np.percentile(np.abs(off), 80)) > 3 * RESIDUAL or float(np.mean(off < -deep)) > 2 * PART:
        return None
    edges = [_edges(sight) for sight in sights]
    limit = max(RESIDUAL, 2.5 * noise)
    found = _fitted(start, sample[::2], sights, edges)
    if found is None:
        return None
    (sharp, sharp_error), few = found, sample[::2]
    rounded, rounded_error = _fitted(replace(sharp, corner=0.25 * float(sharp.size[:2].min())), few, sights, edges) or (sharp, np.inf)
    ways = [(sharp, sharp_error, "box"), (rounded, rounded_error, "rounded box")]
    if rounded_error < ROUNDER * sharp_error:
        ways.reverse()
    short, long = np.sort(ways[0][0].size[:2])
    if long < OBLONG * short:
        across = float(short + long) / 2
        way = _fitted(replace(sharp, size=np.array([across, across, sharp.size[2]]), corner=across / 2), few, sights, edges)
        if way is not None and min(sharp_error, rounded_error) > ROUNDER * way[1]:
            ways = [(*way, "cylinder")]
    for box, _, shape in ways:
        if _sound(box, sample, sights, edges, limit):
            solid = hull_of(box.corners())
            return None if solid is None else Reconstruction(Mesh(solid.vertices, solid.faces), (solid,), shape)
    return None


def _sound(box: Box, points: NDArray[np.float64], sights: list[Sight], edges: list[NDArray[np.float64]], limit: float) -> bool:
    """Whether points (N, 3) lie on the faces of a box, on two at least, and the masks' outlines (M, 2), pixels, are its own; limit: of the
    distance, m."""
    if box.size.min() < LEAST or box.size.max() > 0.5:
        return False
    distance = np.abs(box.distance(points))
    if float(np.percentile(distance, 90)) > limit or float(np.mean(distance > AWAY)) > PART or _faces(box, points, limit) < 2:
        return False
    return all(
        len(pixels) <= 20 or float(np.median(np.abs(_outlines(box.corners()[None], s, pixels)[0]))) <= EDGE
        for s, pixels in zip(sights, edges, strict=True)
    )


def _start(points: NDArray[np.float64], height: float) -> Box | None:
    """A box by the direction in which the sides' points lie nearest to two lines at right angles (after Zhang et al. 2017)."""
    side = points[(points[:, 2] < 0.9 * height - 0.003) & (points[:, 2] > 0.1 * height), :2]
    flat = side if len(side) > 60 else points[:, :2]
    flat = flat[:: max(1, len(flat) // 300)]
    if not len(flat):
        return None
    yaws = np.radians(np.arange(0, 90, 1.5))
    c, s = np.cos(yaws), np.sin(yaws)
    along = np.stack([np.column_stack([c, s]), np.column_stack([-s, c])]) @ flat.T  # (2, yaws, points)
    low, high = np.percentile(along, [2, 98], axis=2, keepdims=True)
    gaps = np.minimum(np.abs(along - low), np.abs(high - along))
    yaw = float(yaws[int(np.argmin(np.minimum(gaps.min(axis=0), 0.01).mean(axis=1)))])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    low, high = np.percentile(points[:, :2] @ turn.T, [1, 99], axis=0)
    return Box(turn.T @ ((low + high) / 2), np.array([*(high - low), height]), yaw)


def _edges(sight: Sight, most: int = 150) -> NDArray[np.float64]:
    """Pixels (N, 2), column and row, of the mask's outline that nothing else hides and the picture does not cut."""
    mask = sight.mask.view(np.uint8)
    line = (mask > 0) & (cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    line &= cv2.dilate(sight.hidden.view(np.uint8), np.ones((7, 7), np.uint8)) == 0
    line[:3] = line[-3:] = False
    line[:, :3] = line[:, -3:] = False
    rows, columns = np.nonzero(line)
    step = max(1, len(rows) // most)
    return np.column_stack([columns[::step], rows[::step]]).astype(float)


def _outlines(corners: NDArray[np.float64], sight: Sight, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signed distances (B, N) of pixels (N, 2) to the outlines in a picture of boxes with these corners (B, K, 3), positive outside."""
    seen = sight.pixels(corners)
    hulls = [cv2.convexHull(points, returnPoints=False)[:, 0] for points in seen]
    # Counter-clockwise, all of as many corners: the last one again, and edges of no length.
    count = max(len(hull) for hull in hulls)
    order = np.stack([np.pad(hull, (0, count - len(hull)), mode="edge") for hull in hulls])
    ring = np.take_along_axis(seen, order[..., None], axis=1)
    edge = np.roll(ring, -1, axis=1) - ring
    length = np.linalg.norm(edge, axis=2)
    normal = np.stack([edge[..., 1], -edge[..., 0]], axis=-1) / np.maximum(length, 1e-6)[..., None]
    away = pixels @ normal.transpose(0, 2, 1) - np.sum(ring * normal, axis=2)[:, None]
    return np.where(length[:, None] > 1e-6, away, -np.inf).max(axis=2)


def _fitted(start: Box, points: NDArray[np.float64], sights: list[Sight], edges: list[NDArray[np.float64]]) -> tuple[Box, float] | None:
    """The box that points and outlines agree with best, and its error (least squares, robust to outliers).

    Its edges are sharp, rounded, or so round that it is a cylinder, where those of ``start`` are.
    """
    from scipy.optimize import least_squares

    scale = [float(np.nanmedian(sight.depth[sight.mask])) / sight.intrinsics.fx for sight in sights]
    if not np.all(np.isfinite(scale)):
        return None
    circle = start.round

    def made(x: NDArray[np.float64]) -> Box:
        if circle:
            across = max(float(x[2]), 1e-3)
            return Box(x[:2], np.array([across, across, max(float(x[3]), 1e-3)]), 0.0, across / 2)
        size = np.maximum(x[2:5], 1e-3)
        return Box(x[:2], size, float(x[5]), float(np.clip(x[6], 1e-3, size[:2].min() / 2)) if len(x) > 6 else 0.0)

    def errors(tried: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of boxes by their numbers (B, P): (B, errors)."""
        boxes = [made(x) for x in first + (tried - 1) * scales]
        parts = [np.stack([box.distance(points) for box in boxes]) / np.sqrt(len(points))]
        corners = np.stack([box.corners() for box in boxes])
        for sight, pixels, size in zip(sights, edges, scale, strict=True):
            if len(pixels):
                # The middles of a mask's outermost pixels lie half a pixel within.
                parts.append(size * (_outlines(corners, sight, pixels) + 0.5) / np.sqrt(len(pixels)))
        return 30 * np.concatenate(parts, axis=1)

    def slopes(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(errors, P), by differences, all of them at once."""
        beside = x + np.diag(STEP * x)
        here, there = np.split(errors(np.vstack([x, beside])), [1])
        return ((there - here) / (np.diag(beside) - x)[:, None]).T

    if circle:
        first, scales = np.array([*start.middle, start.size[0], start.size[2]]), np.full(4, 0.1)
    else:
        first = np.array([*start.middle, *start.size, start.yaw, *([start.corner] if start.corner > 0 else [])])
        scales = np.array([0.1] * 5 + [1.0, 0.1])[: len(first)]
    # Errors have kinks, where a point or a pixel changes from one face to another: differences are taken over more than these are apart.
    found = least_squares(
        lambda x: errors(x[None])[0],
        np.ones(len(first)),
        jac=slopes,
        loss="soft_l1",
        f_scale=30 * ROBUST / np.sqrt(len(points)),
        ftol=1e-4,
        max_nfev=30,
    )
    return made(first + (found.x - 1) * scales), float(found.cost)


def _faces(box: Box, points: NDArray[np.float64], limit: float) -> int:
    """How many faces hold their share of the points, those near an edge left out; a cylinder's side is one."""
    out, local = box.beyond(points), box.local(points)
    if box.round:
        across = np.linalg.norm(local[:, :2], axis=1) - box.corner
        faces = [(np.abs(across) < limit) & (out[:, 2] < -limit), (np.abs(out[:, 2]) < limit) & (across < -limit)]
    else:
        faces = [(np.abs(out[:, 2]) < limit) & (out[:, :2].max(axis=1) < -limit)]
        for axis in range(2):
            # Where an edge is rounded the face is flat up to where that begins.
            on = (np.abs(out[:, axis]) < limit) & (out[:, 1 - axis] < -max(limit, box.corner)) & (out[:, 2] < -limit)
            faces += [on & (local[:, axis] > 0), on & (local[:, axis] < 0)]
    return sum(bool(np.mean(on) >= FACE) for on in faces)
