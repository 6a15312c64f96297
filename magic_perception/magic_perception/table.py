"""The plane that things stand on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_perception.percentiles import bounds, extents

#: Cells of the map of heights in which things are counted that stand on a level, m.
CELL = 0.01


@dataclass(frozen=True)
class Plane:
    """a x + b y + c z + d = 0 with unit normal; ``inliers`` is the share of the given points that agree."""

    coefficients: NDArray[np.float64]
    inliers: float = 1.0

    @property
    def normal(self) -> NDArray[np.float64]:
        """(3,): the unit normal, up."""
        return self.coefficients[:3]

    def heights(self, points: ArrayLike) -> NDArray[np.float64]:
        """Signed distances (...) in metres of points (..., 3), positive above."""
        return np.asarray(points) @ self.coefficients[:3] + self.coefficients[3]

    def tilt(self, up: ArrayLike = (0.0, 0.0, 1.0)) -> float:
        """Angle in degrees between the normal and a unit vector."""
        return float(np.degrees(np.arccos(np.clip(self.normal @ np.asarray(up, float), -1, 1))))


def fit_plane(
    points: NDArray[np.float64],
    up: ArrayLike | None = None,
    max_tilt: float = 15.0,
    band: float = 0.008,
    iterations: int = 300,
    sample: int = 6000,
    seed: int = 0,
) -> Plane:
    """The plane that most points agree with, by RANSAC and least squares on its inliers.

    points (N, 3) metres.  With ``up`` only planes whose normal lies within ``max_tilt`` degrees of it count;
    without, the normal is turned towards the origin (the camera).  Of planes with nearly the same support
    (90 %) the upper one wins, so that a table wins over the floor below it only where both are seen equally.
    Raises ``NO_TABLE`` for fewer than 100 points or no plane that 10 % of them agree with.
    """
    points = np.asarray(points, dtype=float)
    if not np.isfinite(points.sum()):
        points = points[np.all(np.isfinite(points), axis=1)]
    if len(points) < 100:
        raise MagicError(Code.NO_TABLE, "points for the table plane", len(points), "at least 100 with depth in the region of interest")
    rng = np.random.default_rng(seed)
    points = points[rng.permutation(len(points))[:sample]]
    few = points[:1000]  # enough to rank hypotheses; the best is fitted to all
    corners = few[rng.integers(0, len(few), (iterations, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    # Three points closer together than the noise say nothing of the normal.
    sound = lengths > 1e-4
    normals, corners = normals[sound] / lengths[sound, None], corners[sound]
    offsets = -np.sum(normals * corners[:, 0], axis=1)
    if up is not None:
        facing = normals @ np.asarray(up, float)
        upright = np.abs(facing) > np.cos(np.radians(max_tilt))
        normals, offsets = (normals * np.sign(facing)[:, None])[upright], (offsets * np.sign(facing))[upright]
    else:
        sign = np.where(offsets < 0, -1.0, 1.0)
        normals, offsets = normals * sign[:, None], offsets * sign
    if len(normals) == 0:
        raise MagicError(Code.NO_TABLE, "table plane", "no upright plane", f"a plane within {max_tilt} degrees of level")
    distance = normals.astype(np.float32) @ few.T.astype(np.float32) + offsets[:, None].astype(np.float32)
    support = np.count_nonzero(np.abs(distance, out=distance) < band, axis=1)
    best = int(np.argmax(support))
    coefficients = np.append(normals[best], offsets[best])
    for width in (band, band * 0.6, band * 0.6):
        near = np.abs(points @ coefficients[:3] + coefficients[3]) < width
        if near.sum() < 50:
            break
        centre = points[near].mean(axis=0)
        local = points[near] - centre
        normal = np.linalg.eigh(local.T @ local)[1][:, 0]
        normal = normal if normal @ coefficients[:3] > 0 else -normal
        coefficients = np.append(normal, -normal @ centre)
    inliers = float(np.mean(np.abs(points @ coefficients[:3] + coefficients[3]) < band))
    plane = Plane(coefficients, inliers)
    if inliers < 0.1:
        raise MagicError(Code.NO_TABLE, "share of points on the best plane", round(inliers, 3), "at least 0.1")
    if up is not None and plane.tilt(up) > max_tilt:
        raise MagicError(Code.NO_TABLE, "tilt of the best plane in degrees", round(plane.tilt(up), 1), f"at most {max_tilt}")
    return plane


#: Of a support that lies on another (a tray, a board, a mat): its largest height, its least edge and its least area, m and m^2.
RAISED, EDGE, AREA = 0.045, 0.16, 0.04
#: Least edge and area of a table that stands high above another level, m and m^2.
WIDE = (0.28, 0.12)
#: Two levels have the same claim where the things on them differ by no more than this.
ALIKE = 0.3


@dataclass(frozen=True)
class Support:
    """A plane that may be the table: how many things stand on it (:func:`standing`), and the share of the points that lie on it."""

    plane: Plane
    things: float
    share: float


def standing(heights: NDArray[np.floating], xy: NDArray[np.floating], level: float, band: float = 0.008) -> tuple[float, float]:
    """How many things stand on a level, and its area in m^2.

    heights (N,) and xy (N, 2) metres in a frame with z up.  A thing is a connected region of at most half a metre that rises from the
    level by more than 12 mm, and around which at least six tenths of what is seen is the level.  It counts by the share of its outline at
    which the level is seen: specks of noise on a floor far below have gaps around them.
    """
    low = bounds(xy)[0] - 4 * CELL
    index = np.floor((xy - low) / CELL).astype(int)
    size = bounds(index)[1] + 5
    if size.max() > 1000:
        return 0.0, 0.0
    flat = index[:, 0] * size[1] + index[:, 1]
    top = np.full(int(size.prod()), -np.inf)
    np.maximum.at(top, flat, heights)
    count = np.bincount(flat[np.abs(heights - level) < band], minlength=len(top)).reshape(size)
    top = top.reshape(size)
    on = (count > 0) & (top < level + 0.012)
    above = (top >= level + 0.012).astype(np.uint8)
    above = cv2.morphologyEx(above, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    n, labels, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
    things = 0.0
    for i in range(1, n):
        x, y, w, h, area = stats[i]
        if area < 4 or max(w, h) * CELL > 0.5:
            continue
        cut = (slice(max(y - 3, 0), y + h + 3), slice(max(x - 3, 0), x + w + 3))
        mine = (labels[cut] == i).astype(np.uint8)
        ring = (cv2.dilate(mine, np.ones((5, 5), np.uint8)) > 0) & (mine == 0)
        known = ring & np.isfinite(top[cut])
        around = np.count_nonzero(on[cut] & known)
        if known.sum() >= 0.25 * ring.sum() and around >= 0.6 * known.sum():
            things += around / np.count_nonzero(ring)
    return things, float(on.sum()) * CELL * CELL


def supports(points: NDArray[np.float64], plane: Plane, band: float = 0.008) -> list[Support]:
    """The level ``plane`` and those parallel to it that hold many points (N, 3), the likeliest table first.

    The table is the level that most things stand on; of levels with the same claim (:data:`ALIKE`) the one that more points lie on.  A
    level a little above another counts where it is as wide as a tray, a board or a mat; one high above another where it is as wide as a
    table: the top of a box is none, though things may stand on it.
    """
    frame = world_from_plane(plane)
    local = transforms.apply(transforms.inverse(frame), points)
    heights, xy = local[:, 2], local[:, :2]
    step = 0.004
    low = float(heights.min()) - step
    histogram = np.bincount(((heights - low) / step).astype(int))
    smooth = np.convolve(histogram, [1, 1, 1], mode="same")
    levels = [0.0]
    order = np.argsort(smooth)[::-1]
    for i in order[: np.count_nonzero(smooth >= max(0.03 * len(points), 80))]:
        level = low + (i + 0.5) * step
        if all(abs(level - other) > 2.0 * band for other in levels):
            levels.append(level)
    found = []
    for level in levels:
        near = np.abs(heights - level) < band
        if level != 0.0:
            level = float(np.median(heights[near]))
        things, area = standing(heights, xy, level, band)
        share = float(near.mean())
        if level != 0.0:
            narrow = extents(xy[near]).min()
            below = [other for other in levels if other < level - 2 * band]
            tray = any(level - other <= RAISED for other in below) and narrow >= EDGE and area >= AREA
            wide = narrow >= WIDE[0] and area >= WIDE[1]
            if below and not (tray or wide):
                continue
        coefficients = plane.coefficients.copy()
        coefficients[3] -= level
        found.append(Support(Plane(coefficients, share), things, share))
    return _ranked(found)


def _ranked(found: list[Support]) -> list[Support]:
    """The likeliest table first, then by how many things stand on them."""
    most = max(support.things for support in found)
    best = max((support for support in found if support.things >= most - ALIKE), key=lambda support: support.share)
    return [best, *sorted((s for s in found if s is not best), key=lambda s: (s.things, s.share), reverse=True)]


def world_from_plane(plane: Plane) -> NDArray[np.float64]:
    """The frame on the plane below the origin, z along its normal, x the origin frame's x (or y) made level."""
    z = plane.normal
    x = np.array([1.0, 0, 0]) if abs(z[0]) < 0.9 else np.array([0, 1.0, 0])
    x = transforms.unit(x - (x @ z) * z)
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), -plane.coefficients[3] * z)


#: Cosine between a plane's normal and the picture's down beyond which the plane is upright: a wall, seen by a camera that looks down by 15
#: degrees.
UPRIGHT = 0.26
#: Points that tell the planes of a picture apart.
ENOUGH = 20000


def table_in_view(points: NDArray[np.float64], band: float = 0.008, seed: int = 0, notes: list[str] | None = None) -> Plane:
    """The table among the planes that a camera sees whose pose is not known; points (..., 3) in the optical frame, NaN allowed.

    Nothing but the picture's own up, which a camera on its tripod or in a hand keeps roughly, tells a wall from a table: a plane whose
    normal points down in the picture is upright, and of two at right angles the one that faces up less.  Of the others the one that
    most things stand on is the table.
    ``notes`` gets a sentence where another plane has the same claim.  Raises ``NO_TABLE``; ``TABLE_AMBIGUOUS`` where all planes are
    upright.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim == 3:
        # Of denser points the noise of a far floor makes more specks that stand on it.
        step = max(1, round(np.sqrt(points[..., 0].size / ENOUGH)))
        points = points[::step, ::step]
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    first = fit_plane(points, band=band, seed=seed)
    rest, planes = points, [first]
    while len(planes) < 4:
        rest = rest[np.abs(planes[-1].heights(rest)) > 2 * band]
        if len(rest) < max(0.12 * len(points), 400):
            break
        try:
            planes.append(fit_plane(rest, band=band, seed=seed))
        except MagicError:
            break
    level = [
        plane
        for plane in planes
        if plane.normal[1] <= UPRIGHT
        and not any(abs(plane.normal @ other.normal) < 0.35 and other.normal[1] < plane.normal[1] - 0.3 for other in planes)
    ]
    if not level:
        down = float(np.degrees(np.arcsin(np.clip(first.normal[1], -1, 1))))
        raise MagicError(
            Code.TABLE_AMBIGUOUS,
            "largest plane",
            f"upright in the picture (its normal points down in it by {down:.0f} degrees), {first.inliers:.0%} of the depth",
            f"a table in view: a plane that faces up in the picture and holds at least 12 % of the depth, of {len(planes)} planes found",
        )
    found: list[Support] = []
    for plane in level:
        # Levels of planes that are nearly parallel are one family's: each level is judged once, by the plane that most points agree with.
        if not _listed(plane, found, band):
            found += [support for support in supports(points, plane, band) if not _listed(support.plane, found, band)]
    found = _ranked(found)
    best = found[0]
    plane = best.plane
    near = points[np.abs(plane.heights(points)) < 2 * band]
    if plane is not first and len(near) > 300:
        # The largest plane that the points near it tell of may be another, inclined to it (a box's side that meets it): then it stays as it
        # was found.
        try:
            plane = fit_plane(near, plane.normal, 5.0, band, seed=seed)
        except MagicError:
            pass
    if notes is not None:
        if all(plane is not first for plane in level):
            notes.append(f"the largest plane ({first.inliers:.0%} of the depth) is upright in the picture: not the table")
        for other in found[1:]:
            if best.things > 0 and other.things >= best.things - ALIKE and other.share > 0.1:
                notes.append(
                    f"table ambiguous: as many things ({other.things:.0f}) stand on a plane {_between(plane, other.plane)}; "
                    f"taken was the one with {best.share:.0%} of the depth, not {other.share:.0%}"
                )
    return plane


def _listed(plane: Plane, found: list[Support], band: float) -> bool:
    """Whether a plane is one of those found, or hardly inclined to one and at its height."""
    return any(
        plane.normal @ other.plane.normal > 0.98 and abs(plane.coefficients[3] - other.plane.coefficients[3]) < 2 * band for other in found
    )


def _between(one: Plane, other: Plane) -> str:
    angle = one.tilt(other.normal)
    if angle > 5:
        return f"{angle:.0f} degrees inclined to it"
    return f"{1000 * abs(one.coefficients[3] - other.coefficients[3]):.0f} mm from it"


def camera_over_table(
    points: NDArray[np.float64], band: float = 0.008, seed: int = 0, notes: list[str] | None = None
) -> NDArray[np.float64]:
    """world_from_camera (4, 4) of a camera whose pose is not known, from the table that it sees (:func:`table_in_view`).

    points (..., 3) in the optical frame.  The world's origin lies on the table below the camera,
    z up, x level in the direction that the camera looks.
    """
    plane = table_in_view(points, band, seed, notes)
    z = plane.normal
    forward = np.array([0.0, 0.0, 1.0])
    x = forward - (forward @ z) * z
    if np.linalg.norm(x) < 0.1:  # looking straight down: the picture's top is forward
        x = np.array([0.0, -1.0, 0.0]) - (np.array([0.0, -1.0, 0.0]) @ z) * z
    x = transforms.unit(x)
    camera_from_world = transforms.make(np.column_stack([x, np.cross(z, x), z]), -plane.coefficients[3] * z)
    return transforms.inverse(camera_from_world)
