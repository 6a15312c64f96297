"""How far the poses of cameras disagree, measured on what they see together.

Each camera's table is a plane: two of them tell the difference in height and two angles, to fractions of a millimetre.  What is
left is a motion in that plane, two shifts and a turn.  It comes from the things on the table: a point that one camera sees on a
thing, moved to where the other camera would have it, must fall on the other's mask unless something hides it there, and on its
surface where both see the same side.  The motion is the one with which the cameras contradict each other least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_perception import convexity
from magic_perception.segmentation import Looked

#: Metres and radians up to which cameras are brought together: half of it is how far either may be from the truth.
MOST_OFFSET, MOST_ANGLE = 0.010, float(np.radians(1.5))
#: Metres and radians below which a disagreement is not worth a word; standard errors that chance may reach.
LEAST_OFFSET, LEAST_ANGLE, CHANCE = 0.004, float(np.radians(0.75)), 2.2
#: A thing has moved where its two views contradict each other by less than this share once one of them is moved.
FITS = 0.92
#: Points of each camera that are looked for in the other: of all things, and where one thing is looked at.
POINTS, SINGLE = 600, 300
#: Errors of neighbouring points go together, so that a point counts for less than one; and what a standard error is at least, m and rad.
SPREAD, FLOOR = 3.0, (0.001, float(np.radians(0.1)))
#: Of the points every so many-th looks for where to begin; the longest step (3,) of the search, m and rad.
FEW, LARGEST = 3, np.array([0.012, 0.012, 0.05])
#: Metres: a contradiction beyond this is none of a pose but of what was seen.
MOST = 0.03
#: Pixels beside a mask's edge that say nothing, and width in pixels over which heights are smoothed.
GRACE, SMOOTH = 2.0, 7
#: Metres and radians per standard deviation of what cameras may well be off by; keeps directions that nothing tells of at 0.
PRIOR = np.array([0.03, 0.03, 0.03])


@dataclass(frozen=True)
class Disagreement:
    """How camera ``second`` sees the world displaced from where ``first`` does.

    offset: by how much, m, in the middle of the things that both see, and angle, rad; errors: their standard errors.
    motion (3,): what of it is left once each camera's table is the common plane: shifts in m along x and y of the table frame, and a turn in
    rad about ``centre`` (3,), that carry what ``second`` sees to where ``first`` does.
    """

    first: str
    second: str
    offset: float
    angle: float
    errors: tuple[float, float]
    motion: NDArray[np.float64]
    centre: NDArray[np.float64]

    def __str__(self) -> str:
        return (
            f"{self.second} sees the scene {1000 * self.offset:.1f} mm and {np.degrees(self.angle):.1f} degrees from where {self.first} does "
            f"(standard errors {1000 * self.errors[0]:.1f} mm, {np.degrees(self.errors[1]):.1f} degrees)"
        )

    @property
    def certain(self) -> bool:
        """Whether the cameras disagree by more than chance and by what is worth a word."""
        return (self.offset > LEAST_OFFSET and self.offset > CHANCE * self.errors[0]) or (
            self.angle > LEAST_ANGLE and self.angle > CHANCE * self.errors[1]
        )

    @property
    def beyond(self) -> bool:
        """Whether they certainly disagree by more than may be corrected."""
        return self.certain and (
            (self.offset > MOST_OFFSET and self.offset > CHANCE * self.errors[0])
            or (self.angle > MOST_ANGLE and self.angle > CHANCE * self.errors[1])
        )


@dataclass(frozen=True)
class _Witness:
    """What one camera tells: points (N, 3) on things and their normals (N, 3); pictures of the distance to its masks (H, W), m at unit depth,
    and of the normals around them (h, w, 3), which begin at row and column ``corner``."""

    camera_from_world: NDArray[np.float64]
    look: Looked
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    outside: NDArray[np.float32]
    field: NDArray[np.float32]
    corner: tuple[int, int]


def _witness(look: Looked, labels: NDArray[np.int32], count: int, rng: np.random.Generator) -> _Witness | None:
    """What one camera tells by at most so many points, drawn at random, of the things that are labelled (H, W); ``None`` where it sees next to nothing of any."""
    mask = labels > 0
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    if w == 0:
        return None
    pad = 12
    r0, r1 = max(y - pad, 0), min(y + h + pad, mask.shape[0])
    c0, c1 = max(x - pad, 0), min(x + w + pad, mask.shape[1])
    window = look.points(*np.meshgrid(np.arange(r0, r1), np.arange(c0, c1), indexing="ij"))
    field = convexity.normals(window, look.frame.world_from_camera[:3, 3])
    # Depth at the very edge of a mask may be that of what lies behind.
    rows, columns = np.nonzero(mask & np.isfinite(look.heights) & (look.heights > 0))
    if len(rows) < 60:
        return None
    keep = rng.permutation(len(rows))[:count]
    rows, columns = rows[keep], columns[keep]
    points = _steady(look, mask, (slice(r0, r1), slice(c0, c1)), rows, columns)
    # Where a camera cannot tell (a known object before it) nothing is outside of its masks.
    blank = (labels != 0).view(np.uint8)
    # A pixel of grace for the edge, and one for what noise is left in the points: with noise alone those that a camera sees at
    # another's edge would push away from it.
    outside = np.maximum(cv2.distanceTransform(1 - blank, cv2.DIST_L2, 5) - GRACE, 0) / np.float32(look.frame.intrinsics.fx)
    return _Witness(
        transforms.inverse(look.frame.world_from_camera),
        look,
        points,
        field[rows - r0, columns - c0].astype(float),
        outside,
        field,
        (r0, c0),
    )


def _steady(
    look: Looked, mask: NDArray[np.bool_], window: tuple[slice, slice], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """World points (N, 3) of pixels of a mask where their rays reach heights that are smoothed over the mask."""
    inside = mask[window] & np.isfinite(look.heights[window])
    share = cv2.blur(inside.astype(np.float32), (SMOOTH, SMOOTH))
    height = cv2.blur(np.where(inside, look.heights[window], np.float32(0)), (SMOOTH, SMOOTH)) / np.maximum(share, np.float32(1e-6))
    # Over an edge of depth there is nothing to smooth.
    raw = look.heights[window]
    with np.errstate(invalid="ignore"):
        height = np.where(np.abs(height - raw) < 0.006, height, raw)[rows - window[0].start, columns - window[1].start]
    measured = look.points(rows, columns).astype(float)
    eye = look.frame.world_from_camera[:3, 3]
    # Along the ray by as much as brings the measured height to the smoothed one.
    change = (height - raw[rows - window[0].start, columns - window[1].start]) / np.minimum((measured - eye) @ look.normal, -1e-3)
    return measured + change[:, None] * (measured - eye)


def _contradictions(
    other: _Witness, moved: NDArray[np.float64], turned: NDArray[np.float64], gate: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """How points ``moved`` (N, 3) with normals ``turned`` (N, 3) that one camera saw contradict another camera: metres (N,) beside its masks (0 where nothing is told), and
    off its surface (NaN where the two do not see the same side within ``gate``), with the normals (N, 3) there."""
    k, pose = other.look.frame.intrinsics, other.camera_from_world
    local = moved @ pose[:3, :3].T + pose[:3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    column = np.round(k.fx * local[:, 0] / z + k.cx).astype(int)
    row = np.round(k.fy * local[:, 1] / z + k.cy).astype(int)
    inside = (local[:, 2] > 0.05) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    depth = other.look.frame.depth[row, column]
    outside = other.outside[row, column]
    # Something nearer hides the point: nothing is told.
    with np.errstate(invalid="ignore"):
        hidden = depth < local[:, 2] - gate
    beside = np.where(inside & ~hidden, np.minimum(outside * z, MOST), 0.0)
    r, c = row - other.corner[0], column - other.corner[1]
    on = inside & (outside == 0) & np.isfinite(depth) & (r >= 0) & (c >= 0) & (r < other.field.shape[0]) & (c < other.field.shape[1])
    normal = other.field[np.where(on, r, 0), np.where(on, c, 0)].astype(float)
    there = other.look.points(row, column).astype(float)
    gap = np.sum((moved - there) * normal, axis=1)
    with np.errstate(invalid="ignore"):
        alike = on & (np.sum(normal * turned, axis=1) > 0.8) & (np.abs(gap) < gate) & (np.linalg.norm(moved - there, axis=1) < 2 * gate)
    return beside, np.where(alike, gap, np.nan), normal


#: Metres for one standard deviation of a point beside a mask and off a surface.  Masks tell how large an offset there is; a round thing
#: leaves them room of a centimetre, so that surfaces decide.
EDGE, SURFACE = 0.006, 0.003


def _cost(beside: NDArray[np.float64], gap: NDArray[np.float64]) -> NDArray[np.float64]:
    """(...,): what contradictions (..., N) cost; a point whose surface the other camera does not see costs as much as one far off it."""
    off = np.minimum((gap / SURFACE) ** 2, 9.0)
    return np.sum(np.nan_to_num(off, nan=9.0) + np.minimum((beside / EDGE) ** 2, 9.0), axis=-1)


def _motion(x: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """The motion (4, 4) by x = (along x, along y, about z) in the table frame, turning about ``centre``."""
    turn = transforms.from_rpy(0, 0, float(x[2]))
    turn[:3, 3] = centre - turn[:3, :3] @ centre + [x[0], x[1], 0.0]
    return turn


def _told(
    first: _Witness, second: _Witness, motion: NDArray[np.float64], gate: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """With the points of ``second`` moved (world): the cost, and of the points that both see their places (N, 3) as ``first`` has
    them, the normals (N, 3) along which they are off, and by how much the motion must still carry ``second`` (N,)."""
    back = transforms.inverse(motion)
    moved = transforms.apply(motion, second.points)
    beside, gap, normal = _contradictions(first, moved, second.normals @ motion[:3, :3].T, gate)
    cost = float(_cost(beside, gap))
    seen = np.isfinite(gap)
    places, normals, offsets = [moved[seen]], [normal[seen]], [gap[seen]]
    moved = transforms.apply(back, first.points)
    beside, gap, normal = _contradictions(second, moved, first.normals @ back[:3, :3].T, gate)
    cost += float(_cost(beside, gap))
    seen = np.isfinite(gap)
    # A point of the first above the surface of the second: the second must move along its normal by as much.
    places.append(first.points[seen])
    normals.append(normal[seen] @ motion[:3, :3].T)
    offsets.append(-gap[seen])
    return cost, np.concatenate(places), np.concatenate(normals), np.concatenate(offsets)


def _solve(
    first: _Witness, second: _Witness, world_from_table: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int] | None:
    """The motion (3,) of ``second`` that contradicts least, its covariance (3, 3), the middle (3,) that it turns about, in the table
    frame, and how many points told; ``None`` where too few did."""
    axes = world_from_table[:3, :3]
    centre = transforms.apply(transforms.inverse(world_from_table), np.concatenate([first.points, second.points])).mean(axis=0)
    # Where to begin: the shifts of a lattice that contradict least, and none.
    steps = np.arange(-0.048, 0.0481, 0.008)
    shifts = np.stack([a.ravel() for a in np.meshgrid(steps, steps)], axis=1)
    world = np.column_stack([shifts, np.zeros(len(shifts))]) @ axes.T
    total = 0.25 * np.sum((shifts / PRIOR[:2]) ** 2, axis=1)
    for one, other, sign in ((second, first, 1), (first, second, -1)):
        points, normals = one.points[::FEW], one.normals[::FEW]
        moved = (points[None] + sign * world[:, None]).reshape(-1, 3)
        beside, gap, _ = _contradictions(other, moved, np.tile(normals, (len(world), 1)), 0.02)
        total = total + _cost(beside.reshape(len(world), -1), gap.reshape(len(world), -1))
    starts = [np.zeros(3), np.append(shifts[int(np.argmin(total))], 0.0)]
    found = [solved for x in starts if (solved := _refined(first, second, world_from_table, x, centre)) is not None]
    if not found:
        return None
    _, x, covariance, count = min(found, key=lambda f: f[0])
    return x, covariance, centre, count


def _refined(
    first: _Witness, second: _Witness, world_from_table: NDArray[np.float64], x: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], int] | None:
    """From a motion ``x`` (3,) on, by surfaces: what is left contradictory, the motion, its covariance and how many points told; ``None`` where too few did."""
    table_from_world = transforms.inverse(world_from_table)
    axes = world_from_table[:3, :3]
    middle = transforms.apply(world_from_table, centre)
    for gate in (0.02, 0.015, 0.010, 0.010):
        motion = world_from_table @ _motion(x, centre) @ table_from_world
        _, places, normals, offsets = _told(first, second, motion, gate)
        if len(offsets) < 40:
            return None
        # A turn about the table's normal through the middle (which moves with the shift).
        arm = np.cross(axes[:, 2], places - middle - axes[:, :2] @ x[:2])
        jacobian = np.column_stack([normals @ axes[:, 0], normals @ axes[:, 1], np.sum(normals * arm, axis=1)]) / SURFACE
        r = offsets / SURFACE
        weight = 1 / np.maximum(1.0, np.abs(r))[:, None]
        information = jacobian.T @ (weight * jacobian) / SPREAD**2 + np.diag(1 / PRIOR**2)
        slope = jacobian.T @ (weight[:, 0] * r) / SPREAD**2 + x / PRIOR**2
        x = x - np.clip(np.linalg.solve(information, slope), -LARGEST, LARGEST)
    motion = world_from_table @ _motion(x, centre) @ table_from_world
    cost, _, _, offsets = _told(first, second, motion, 0.010)
    return cost, x, np.linalg.inv(information), len(offsets)


def shifted(
    first: Looked, second: Looked, labels: tuple[NDArray[np.int32], NDArray[np.int32]], label: int, world_from_table: NDArray[np.float64]
) -> float:
    """By how much, m, one thing stands elsewhere in the table's plane in ``second`` than in ``first``; 0 where chance may be it.

    labels (H, W): of both looks.  It starts from no shift at all, so that more than some 2 cm is not found.
    """
    rng = np.random.default_rng(label)
    # Beside another thing nothing tells where this one ends.
    one, two = (
        _witness(look, np.where(image == label, 1, np.where(image != 0, -1, 0)), SINGLE, rng)
        for look, image in zip((first, second), labels, strict=True)
    )
    if one is None or two is None:
        return 0.0
    centre = transforms.apply(transforms.inverse(world_from_table), np.concatenate([one.points, two.points])).mean(axis=0)
    found = _refined(one, two, world_from_table, np.zeros(3), centre)
    if found is None:
        return 0.0
    cost, x, covariance, _ = found
    offset, error = float(np.hypot(x[0], x[1])), float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])) + FLOOR[0]
    # Surfaces alone say little of what is flat: the masks have to fit better as well.
    better = cost < FITS * _told(one, two, np.eye(4), 0.010)[0]
    return offset if better and offset > CHANCE * error else 0.0


def measure(
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    given: list[NDArray[np.float64]],
    world_from_table: NDArray[np.float64],
    seed: int = 0,
) -> list[Disagreement]:
    """The disagreement of each pair of cameras that see the same sides of things.

    looks and labels (H, W) as a segmenter has them; given (4, 4) each: the cameras' poses as they were given, before
    :func:`magic_perception.segmentation.look` put each camera's own plane onto the table.
    """
    rng = np.random.default_rng(seed)
    witnesses = [_witness(look, image, POINTS, rng) for look, image in zip(looks, labels, strict=True)]
    level = [look.frame.world_from_camera @ transforms.inverse(pose) for look, pose in zip(looks, given, strict=True)]
    found = []
    for i, first in enumerate(witnesses):
        for j, second in enumerate(witnesses[i + 1 :], i + 1):
            solved = _solve(first, second, world_from_table) if first is not None and second is not None else None
            if solved is None:
                continue
            x, covariance, centre, _ = solved
            motion = world_from_table @ _motion(x, centre) @ transforms.inverse(world_from_table)
            whole = transforms.inverse(level[i]) @ motion @ level[j]
            middle = transforms.apply(transforms.inverse(level[j]), transforms.apply(world_from_table, centre))
            errors = (
                float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])) + FLOOR[0],
                float(np.sqrt(covariance[2, 2])) + FLOOR[1],
            )
            found.append(
                Disagreement(
                    looks[i].frame.camera,
                    looks[j].frame.camera,
                    float(np.linalg.norm(transforms.apply(whole, middle) - middle)),
                    transforms.rotation_angle(whole, np.eye(4)),
                    errors,
                    x,
                    centre,
                )
            )
    return found


def brought_together(looks: list[Looked], by: Disagreement, world_from_table: NDArray[np.float64]) -> list[Looked]:
    """The looks of the two cameras of a pair, each moved by half of what is left between them; others as they are."""
    moved = []
    for look in looks:
        share = {by.first: -0.5, by.second: 0.5}.get(look.frame.camera)
        if share is not None:
            motion = world_from_table @ _motion(share * by.motion, by.centre) @ transforms.inverse(world_from_table)
            look = replace(look, frame=replace(look.frame, world_from_camera=motion @ look.frame.world_from_camera))
        moved.append(look)
    return moved
