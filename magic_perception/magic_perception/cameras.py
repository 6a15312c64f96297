"""How far the poses of cameras disagree, measured on what they see together.

Each camera's table is a plane: two of them tell the difference in height and two angles, to fractions of a millimetre.  What is
left is a motion in that plane, two shifts and a turn.  It comes from the things on the table: a point that one camera sees on a
thing, moved to where the other camera would have it, must fall on the other's mask unless something hides it there, on its
surface where both see the same side, and never before that surface, where the other camera looks through it.  The motion is the one with
which the cameras contradict each other least.

Whether it is believed the things say patch by patch.  What one patch of a surface tells, its points tell all together: a mask that is too wide, a depth that is carried
past an edge, is one error and not a hundred.  So the contradictions are summed by patch, and a motion is believed where they fall in so many patches, and so
evenly, that it is not for the sake of a few.  A round thing alone, or sides of which each camera sees its own, has few patches that tell; then the poses stand as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_perception import convexity
from magic_perception.looks import Looked
from magic_perception.pixels import where

#: Metres and radians up to which cameras are brought together: half of it is how far either may be from the truth.
MOST_OFFSET, MOST_ANGLE = 0.010, float(np.radians(1.5))
#: Metres and radians below which a disagreement is not worth a word; standard errors that chance may reach.
LEAST_OFFSET, LEAST_ANGLE, CHANCE = 0.004, float(np.radians(0.75)), 2.2
#: A motion is believed where contradictions fall by so many times the root of the sum of squares of what they fall by in each patch of a surface; one of more than
#: may be corrected, which chance hardly makes, from so many on.  The size of a patch, m.
FALL, BEYOND, PATCH = 2.8, 2.3, 0.02
#: Points of each camera that are looked for in the other: of all things, and where one thing is looked at; so many have to be seen by both.
POINTS, SINGLE, SEEN = 600, 300, 40
#: Of the points every so many-th looks for where to begin, and for the motion.
FEW, SOME = 4, 2
#: Metres and radians by which a motion is changed in search of a better one, from step to step.
STEPS = ((0.004, float(np.radians(2))), (0.002, float(np.radians(1))), (0.001, float(np.radians(0.5))))
#: Standard errors are taken from so many draws of the patches, with shifts on a lattice of so many steps of so many metres to each side, and
#: turns of so many radians; they are at least these, m and rad.
DRAWS, REACH, STEP, TURN, FLOOR = 100, 3, 0.003, float(np.radians(0.5)), (0.001, float(np.radians(0.1)))
#: Metres: a contradiction beyond this is none of a pose but of what was seen.
MOST = 0.03
#: Metres for one standard deviation of a point beside a mask and off a surface.  Masks tell how large an offset there is; a round thing
#: leaves them room of a centimetre, so that surfaces decide.
EDGE, SURFACE = 0.006, 0.003
#: What a point costs at most, in squares of these, which it does where the other camera looks through it; and, to begin with, where that neither sees it nor speaks against it.
DEAREST, UNSEEN = 9.0, 1.0
#: Metres off a surface up to which a point is taken for one of it: of a motion, and where to begin.
GATE, WIDE = 0.010, 0.020
#: Where each camera looks through more than this share of what the other sees, their poses are wrong: of 24 made scenes (seeds 40000 to 40023) it was at most 0.001, and
#: 0.44 and more with the poses exchanged.
THROUGH = 0.25
#: Pixels beside a mask's edge that say nothing, and width in pixels over which heights are smoothed.
GRACE, SMOOTH = 2.0, 7
#: Metres and radians for one standard deviation of what cameras may well be off by; keeps directions that nothing tells of at 0.
PRIOR = np.array([0.03, 0.03, 0.03])


@dataclass(frozen=True)
class Disagreement:
    """How camera ``second`` sees the world displaced from where ``first`` does.

    Attributes
    ----------
    offset, angle : by how much, m, in the middle of the things that both see, and rad: the likeliest ones.
    errors : their standard errors.
    sure : how much of both, m and rad, is more than chance: what the tables tell, and of the things what is believed of them.
    motion, centre : (3,), what is left once each camera's table is the common plane: shifts in m along x and y of the table frame, and a
        turn in rad about ``centre`` (3,), that carry what ``second`` sees to where ``first`` does.
    """

    first: str
    second: str
    offset: float
    angle: float
    errors: tuple[float, float]
    sure: tuple[float, float]
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
        return self.sure[0] > LEAST_OFFSET or self.sure[1] > LEAST_ANGLE

    @property
    def beyond(self) -> bool:
        """Whether they certainly disagree by more than may be corrected."""
        return self.sure[0] > MOST_OFFSET or self.sure[1] > MOST_ANGLE


@dataclass(frozen=True)
class _Witness:
    """What one camera tells: points (N, 3) on things and their normals (N, 3); pictures of the distance to its masks (H, W), m at unit depth,
    and of the places and the normals around them (h, w, 3), in the world, which begin at row and column ``corner``."""

    camera_from_world: NDArray[np.float64]
    look: Looked
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    outside: NDArray[np.float32]
    places: NDArray[np.float32]
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
    places = look.cloud((slice(r0, r1), slice(c0, c1)))
    field = convexity.normals(places, look.frame.world_from_camera[:3, 3])
    # Depth at the very edge of a mask may be that of what lies behind.
    rows, columns = where(mask & np.isfinite(look.heights) & (look.heights > 0))
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
        places,
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


def _compared(
    other: _Witness, moved: NDArray[np.float64], turned: NDArray[np.float64], gate: float, unseen: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """What points ``moved`` (N, 3) with normals ``turned`` (N, 3) that one camera saw cost (N,) by what another camera sees there, and which of them (N,) it sees too, within ``gate``;
    unseen: what it costs that it neither sees a point nor speaks against it."""
    k, pose = other.look.frame.intrinsics, other.camera_from_world
    x, y, deep = pose[:3, :3] @ moved.T + pose[:3, 3:]
    z = np.maximum(deep, 1e-6)
    column, row = np.rint(k.fx * x / z + k.cx), np.rint(k.fy * y / z + k.cy)
    inside = (deep > 0.05) & (column >= 0) & (column < k.width) & (row >= 0) & (row < k.height)
    column, row = (np.where(inside, pixel, 0).astype(int) for pixel in (column, row))
    flat = row * k.width + column
    depth, outside = other.look.frame.depth.ravel()[flat], other.outside.ravel()[flat]
    # Something nearer hides the point: nothing is told.
    with np.errstate(invalid="ignore"):
        hidden = depth < deep - gate
    beside = np.where(inside & ~hidden, np.minimum(outside * z, MOST), 0.0)
    r, c = row - other.corner[0], column - other.corner[1]
    on = np.flatnonzero(
        inside & (outside == 0) & np.isfinite(depth) & (r >= 0) & (c >= 0) & (r < other.field.shape[0]) & (c < other.field.shape[1])
    )
    normal = other.field[r[on], c[on]].astype(float)
    away = moved[on] - other.places[r[on], c[on]]
    gap = np.einsum("ij,ij->i", away, normal)
    alike, off = np.zeros(len(moved), bool), np.full(len(moved), unseen)
    with np.errstate(invalid="ignore"):
        near = (np.abs(gap) < gate) & (np.einsum("ij,ij->i", away, away) < (2 * gate) ** 2)
        alike[on] = near & (np.einsum("ij,ij->i", normal, turned[on]) > 0.8)
        off[on] = np.where(alike[on], np.minimum((gap / SURFACE) ** 2, DEAREST), np.where(depth[on] > deep[on] + gate, DEAREST, unseen))
    return off + np.minimum((beside / EDGE) ** 2, DEAREST), alike


def _motion(x: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """The motion (4, 4) by x = (along x, along y, about z) in the table frame, turning about ``centre``."""
    turn = transforms.from_rpy(0, 0, float(x[2]))
    turn[:3, 3] = centre - turn[:3, :3] @ centre + [x[0], x[1], 0.0]
    return turn


@dataclass(frozen=True)
class _Believed:
    """The likeliest motion (3,) with the standard errors of its shift, m, and turn, rad, and what of it is believed (3,)."""

    x: NDArray[np.float64]
    errors: tuple[float, float]
    sure: NDArray[np.float64]


@dataclass(frozen=True)
class _Pair:
    """Two cameras, and the middle (3,), in the table frame, of what they see, about which the second is turned; motions are (3,): x, y, turn.

    away (N, 3): the points of the second camera, then those of the first, in the table frame from the middle.
    unseen: what a point costs that only one of them sees: as much as others do that both see, so that it is neither good nor bad to be seen by both.
    """

    first: _Witness
    second: _Witness
    world_from_table: NDArray[np.float64]
    centre: NDArray[np.float64]
    away: NDArray[np.float64]
    unseen: float = UNSEEN

    @classmethod
    def of(cls, first: _Witness, second: _Witness, world_from_table: NDArray[np.float64]) -> _Pair:
        """About the middle of all points."""
        points = transforms.apply(transforms.inverse(world_from_table), np.concatenate([second.points, first.points]))
        centre = points.mean(axis=0)
        return cls(first, second, world_from_table, centre, points - centre)

    def points(self, every: int = 1) -> NDArray[np.float64]:
        """(N, 3): some of ``away``, every so many-th of each camera."""
        split = len(self.second.points)
        return np.concatenate([self.away[:split:every], self.away[split::every]])

    def compared(self, motions: NDArray[np.float64], every: int = 1, gate: float = GATE) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """What each point costs (M, N), and whether both cameras see it (M, N), with the second camera moved by ``motions`` (M, 3)."""
        motions = np.atleast_2d(motions)
        cos, sin, zero = np.cos(motions[:, 2]), np.sin(motions[:, 2]), np.zeros(len(motions))
        turns = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], axis=1).reshape(-1, 3, 3)
        shifts = np.column_stack([motions[:, :2], zero])[:, None]
        axes, split = self.world_from_table[:3, :3], len(self.second.points[::every])
        points = self.points(every)
        told = []
        for one, other, local, turn in (
            (self.second, self.first, points[:split] @ turns.transpose(0, 2, 1) + shifts, turns.transpose(0, 2, 1)),
            (self.first, self.second, (points[split:] - shifts) @ turns, turns),
        ):
            moved = transforms.apply(self.world_from_table, (local + self.centre).reshape(-1, 3))
            turned = (one.normals[::every] @ axes @ turn).reshape(-1, 3) @ axes.T
            told.append([values.reshape(len(motions), -1) for values in _compared(other, moved, turned, gate, self.unseen)])
        return np.concatenate([told[0][0], told[1][0]], axis=1), np.concatenate([told[0][1], told[1][1]], axis=1)

    def cost(self, motions: NDArray[np.float64], every: int = 1, gate: float = GATE) -> NDArray[np.float64]:
        """(M,): what motions (M, 3) cost."""
        return self.compared(motions, every, gate)[0].sum(axis=1) + _prior(motions)

    def least(self, x: NDArray[np.float64], axes: int) -> NDArray[np.float64]:
        """The motion (3,) from ``x`` (3,) on that costs least, by smaller and smaller steps along the first so many axes: 2, shifts alone, or 3."""
        ways = np.concatenate([np.zeros((1, 3)), np.eye(3)[:axes], -np.eye(3)[:axes]])
        for metres, radians in STEPS:
            best = 1
            while best:
                tried = x + ways * [metres, metres, radians]
                best = int(np.argmin(self.cost(tried, SOME)))
                x = tried[best]
        return x

    def begin(self) -> NDArray[np.float64]:
        """The shift (3,) of a lattice 96 mm wide that costs least."""
        steps = np.arange(-0.048, 0.0481, 0.008)
        lattice = np.array([(a, b, 0.0) for a in steps for b in steps])
        return lattice[int(np.argmin(self.cost(lattice, FEW, WIDE)))]

    def patches(self, x: NDArray[np.float64], every: int = 1) -> NDArray[np.float64]:
        """(N, P): to which patch of a surface each point belongs, 0 or 1, with the second camera moved by ``x`` (3,)."""
        points, split = self.points(every), len(self.second.points[::every])
        points[:split] = points[:split] @ transforms.from_rpy(0, 0, float(x[2]))[:3, :3].T + [x[0], x[1], 0.0]
        _, index = np.unique(np.floor(points / PATCH).astype(int), axis=0, return_inverse=True)
        return np.eye(index.max() + 1)[index.ravel()]

    def fall(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
        """By how much contradictions fall from one motion (3,) to another, over the root of the sum of squares of what they fall by in each patch."""
        costs, _ = self.compared(np.stack([before, after]))
        falls = (costs[0] - costs[1]) @ self.patches(after)
        return float(falls.sum() / max(np.sqrt(np.sum(falls**2)), 1e-9))

    def errors(self, x: NDArray[np.float64]) -> tuple[float, float]:
        """The standard errors of a motion's shift, m, in the direction that is known worst, and turn, rad: how it differs where other patches had been seen."""
        steps = STEP * np.arange(-REACH, REACH + 1)
        shifts = np.array([(0.0, 0.0, x[2]), *((x[0] + a, x[1] + b, x[2]) for a in steps for b in steps)])
        turns = x + np.outer(TURN * np.arange(-REACH, REACH + 1), [0, 0, 1])
        patches = self.patches(x, SOME)
        count = patches.shape[1]
        draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS).T
        found = [
            tried[np.argmin(self.compared(tried, SOME)[0] @ patches @ draws + _prior(tried)[:, None], axis=0)] - x
            for tried in (shifts, turns)
        ]
        spread = np.linalg.eigvalsh(found[0][:, :2].T @ found[0][:, :2] / DRAWS)[-1]
        return float(np.sqrt(spread)) + FLOOR[0], float(np.sqrt(np.mean(found[1][:, 2] ** 2))) + FLOOR[1]

    def solved(self, far: bool = True) -> _Believed | None:
        """The motion that contradicts least, and what is believed of it; ``None`` where too few points are seen by both.  far: it may be far from none."""
        nothing = np.zeros(3)
        shift = self.descended([nothing, self.begin()] if far else [nothing])
        costs, seen = self.compared(shift)
        if np.count_nonzero(seen) < SEEN:
            return None
        pair = replace(self, unseen=float(np.mean(np.minimum(costs[seen], DEAREST))))
        shift = pair.descended([nothing, shift])
        motion = pair.least(shift, 3) if far else shift
        x = motion if pair.fall(shift, motion) > FALL else shift
        errors = pair.errors(x)
        offset, angle = float(np.hypot(x[0], x[1])), abs(float(x[2]))
        by_chance = offset < CHANCE * errors[0] and angle < CHANCE * errors[1]
        if by_chance or pair.fall(nothing, x) < (BEYOND if offset > MOST_OFFSET else FALL):
            return _Believed(x, errors, nothing)
        return _Believed(x, errors, x)

    def apart(self, x: NDArray[np.float64], first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float]:
        """How far, m, in the middle, and rad, the cameras were apart as their poses were given, where a motion (3,) is left once each was moved by (4, 4) onto the table."""
        motion = self.world_from_table @ _motion(x, self.centre) @ transforms.inverse(self.world_from_table)
        whole = transforms.inverse(first) @ motion @ second
        middle = transforms.apply(transforms.inverse(second), transforms.apply(self.world_from_table, self.centre))
        return float(np.linalg.norm(transforms.apply(whole, middle) - middle)), transforms.rotation_angle(whole, np.eye(4))

    def descended(self, starts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Of the shifts (3,) that these lead to that which costs least; those that are the same lead to one."""
        apart = [x for i, x in enumerate(starts) if not any(np.allclose(x, other, rtol=0, atol=1e-9) for other in starts[:i])]
        found = [self.least(x, 2) for x in apart]
        return found[int(np.argmin(self.cost(np.stack(found))))] if len(found) > 1 else found[0]


def _prior(motions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M,): what motions (M, 3) cost by themselves."""
    return DEAREST * np.sum((motions / PRIOR) ** 2, axis=-1)


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
    found = _Pair.of(one, two, world_from_table).solved(far=False)
    return float(np.hypot(found.sure[0], found.sure[1])) if found is not None else 0.0


def measure(
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    given: list[NDArray[np.float64]],
    world_from_table: NDArray[np.float64],
    seed: int = 0,
) -> list[Disagreement]:
    """The disagreement of each pair of cameras that see the same sides of things.

    looks and labels (H, W) as a segmenter has them; given (4, 4) each: the cameras' poses as they were given, before
    :func:`magic_perception.looks.look` put each camera's own plane onto the table.
    """
    rng = np.random.default_rng(seed)
    witnesses = [_witness(look, image, POINTS, rng) for look, image in zip(looks, labels, strict=True)]
    level = [look.frame.world_from_camera @ transforms.inverse(pose) for look, pose in zip(looks, given, strict=True)]
    found = []
    for i, first in enumerate(witnesses):
        for j, second in enumerate(witnesses[i + 1 :], i + 1):
            if first is None or second is None:
                continue
            pair = _Pair.of(first, second, world_from_table)
            solved = pair.solved()
            if solved is not None:
                names = looks[i].frame.camera, looks[j].frame.camera
                measured, sure = (pair.apart(x, level[i], level[j]) for x in (solved.x, solved.sure))
                found.append(Disagreement(*names, *measured, solved.errors, sure, solved.sure, pair.centre))
    return found


def looked_through(one: Looked, labels: NDArray[np.int32], other: Looked) -> float:
    """The share of what one camera sees of the things that are labelled (H, W) that another one looks through: all around the place, as far as cameras may
    be off, it sees lower than that.  Of what is in the other's picture; NaN where that is too little to tell.

    Cameras that stand where they are said to look through next to nothing: what one does not see is hidden, and hides what is behind it.
    """
    rows, columns = where((labels > 0) & np.isfinite(one.heights) & (one.heights > GATE))
    frame = other.frame
    points = transforms.apply(transforms.inverse(frame.world_from_camera), one.points(rows, columns).astype(float))
    height, width = frame.depth.shape
    pixels = frame.intrinsics.project(points).round()
    seen = ((pixels >= 0) & (pixels < (width, height))).all(axis=-1)  # NaN, behind the camera, is not
    if np.count_nonzero(seen) < SEEN:
        return np.nan
    u, v = pixels[seen].astype(int).T
    reach = int(np.ceil(frame.intrinsics.fx * MOST_OFFSET / np.median(points[seen, 2])))
    around = cv2.dilate(np.nan_to_num(other.heights, nan=np.inf), np.ones((2 * reach + 1,) * 2, np.uint8))
    return float(np.mean(around[v, u] < one.heights[rows, columns][seen] - GATE / 2))


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
