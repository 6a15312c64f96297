"""Things that stand on a round body (mugs, cans, bands): a body of revolution, open where it was seen to be, and a handle."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from magic_core.mesh import Mesh, concatenate
from magic_perception import primitives
from magic_perception.body import Body
from magic_perception.handles import HOLE, handle_of, standing_off
from magic_perception.parameters import Parameters
from magic_perception.percentiles import percentile
from magic_perception.sight import Sight, carve
from magic_perception.solids import Reconstruction, hull_of


def round_body(points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, wall: float, seed: int) -> Body | None:
    """The body of revolution on which most of the side points lie, or ``None``.

    x^2 + y^2 = 2 a x + 2 b y + q(z): linear in the axis (a, b) and in q, straight between levels, so that
    conical, bulged and waisted bodies fit at once.
    """
    index = np.nonzero((points[:, 2] > 0.08 * height) & (points[:, 2] < 0.94 * height))[0]
    if len(index) < 60:
        return None
    rng = np.random.default_rng(seed)
    index = index[rng.permutation(len(index))[:5000]]
    sample, eye = points[index], eyes[index]
    band = max(0.003, 2 * noise)
    circle = primitives.likeliest_circle(sample, height, band, rng)
    if circle is None:
        return None
    # The inside of an open wall is seen beyond the axis: there the outward normal points away from the camera.
    out, ray = sample[:, :2] - circle[0], eye[:, :2] - sample[:, :2]
    cosine = np.sum(ray * out, axis=1) / np.maximum(np.linalg.norm(ray, axis=1) * np.linalg.norm(out, axis=1), 1e-9)
    # The inside of the far wall tells how far away the axis is, which a noisy front alone leaves open.
    # At grazing incidence stereo rounds the silhouette off backwards, which would make the body wider.
    inner, front = sample[cosine < -0.35], sample[cosine > 0.35]
    fit = _fit(front, inner, circle, height, wall, band)
    if fit is None:
        return None
    side, near, opposite = fit
    radius = side.radius(front[:, 2])
    seen = front[:, :2] - side.axis
    widest = max(float(np.ptp(seen @ np.array([np.cos(t), np.sin(t)]))) for t in np.linspace(0, np.pi, 12, endpoint=False))
    if 2 * float(np.median(radius)) > 1.12 * widest:
        return None  # a broad face bent a little, not a round body
    # What reaches beyond the body must be little, as seen from its axis: a handle before the body has many points in few directions, a box's corner
    # reaches 0.4 r beyond its inscribed circle.
    told, lies = (
        sum(np.bincount(_sector(p[k], side.axis), minlength=SECTORS) for p, k in zip((front, inner), which, strict=True))
        for which in ((slice(None), slice(None)), (near, opposite))
    )
    agree = lies >= 0.5 * np.maximum(told, 1)
    if agree.sum() < max(0.28 * SECTORS, 0.5 * np.count_nonzero(told)) or float(np.mean(cosine < 0)) > 0.7:
        return None
    top = float(np.percentile(front[near, 2], 99))
    around = points[np.abs(np.linalg.norm(points[:, :2] - side.axis, axis=1) - float(np.median(radius))) < 0.012]
    top = max(top, float(np.percentile(around[:, 2], 97)) if len(around) > 8 else top)
    # A rim is level: what rises far above it in a few directions is a pen that leans on it.
    sector = _sector(around, side.axis)
    highest = [percentile(around[sector == k, 2], 97) for k in range(SECTORS) if np.count_nonzero(sector == k) > 8]
    level = float(np.percentile(highest, 75)) if highest else top
    top = level if top > level + STICKS > 0.8 * top else top
    return Body(side.axis, _profile(side, front, top, band))


#: What rises so far above a rim, m, is no part of it.
STICKS = 0.012
#: A handle goes up to so many times the height of its body at most; a stem rises farther.
STEM = 1.5
#: Directions from an axis in which it is asked whether points lie on a body about it.
SECTORS = 36


def _sector(points: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.int64]:
    """In which of the :data:`SECTORS` about an axis (2,) points (N, 3) lie."""
    away = points[:, :2] - axis
    return np.floor((np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi)) * SECTORS).astype(int) % SECTORS


@dataclass(frozen=True)
class _Side:
    """What :func:`round_body` fits: axis (2,); q (K,), r^2 with respect to ``origin`` (2,) at levels from the table to the height."""

    origin: NDArray[np.float64]
    shift: NDArray[np.float64]
    q: NDArray[np.float64]
    height: float

    @property
    def axis(self) -> NDArray[np.float64]:
        return self.origin + self.shift

    def radius(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """At heights z above the table, metres."""
        return np.sqrt(np.maximum(_hats(z / self.height, len(self.q)) @ self.q + self.shift @ self.shift, 1e-6))


#: Between its levels a side is straight; they are about so far apart, m.
LEVEL = 0.012
#: How stiff a side is, against bends between levels.
STIFF = 0.1


def _hats(z: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """(N, count): the weights of levels at heights z (N,) from 0 to 1."""
    return np.maximum(0.0, 1.0 - np.abs(np.clip(z, 0.0, 1.0)[..., None] * (count - 1) - np.arange(count)))


def _fit(
    front: NDArray[np.float64],
    inner: NDArray[np.float64],
    circle: tuple[NDArray[np.float64], float],
    height: float,
    wall: float,
    band: float,
) -> tuple[_Side, NDArray[np.bool_], NDArray[np.bool_]] | None:
    """The side through the front's points (N, 3), and which of them lie on it; ``inner`` (M, 3): points on the inside of the far wall, and which of them do."""
    origin, first = circle
    start = max(0.008, 0.15 * first)
    near = np.abs(np.linalg.norm(front[:, :2] - origin, axis=1) - first) < start
    # From the start on: a front alone, with a handle before it, tells little of where the axis is.
    on = np.abs(first - wall - np.linalg.norm(inner[:, :2] - origin, axis=1)) < start
    count = max(3, min(12, round(height / LEVEL) + 1))
    bends = np.diff(np.eye(count), 2, axis=0)
    side = _Side(origin, np.zeros(2), np.full(count, first**2), height)
    for width in (3 * band, 3 * band, 2 * band, 1.5 * band, 1.5 * band):
        if np.count_nonzero(near) < 25:
            return None
        away = inner[on, :2] - side.axis
        opposite = inner[on, :2] + away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6) * wall
        local = np.concatenate([front[near, :2], opposite]) - origin
        z = np.concatenate([front[near, 2], inner[on, 2]]) / height
        stiff = np.sqrt(STIFF * len(z)) * np.column_stack([np.zeros((count - 2, 2)), bends])
        matrix = np.vstack([np.column_stack([2 * local, _hats(z, count)]), stiff])
        model = np.linalg.lstsq(matrix, np.append(np.sum(local**2, axis=1), np.zeros(count - 2)), rcond=None)[0]
        side = _Side(origin, model[:2], model[2:], height)
        near = np.abs(np.linalg.norm(front[:, :2] - side.axis, axis=1) - side.radius(front[:, 2])) < width
        on = np.abs(side.radius(inner[:, 2]) - wall - np.linalg.norm(inner[:, :2] - side.axis, axis=1)) < width
    return side, near, on


def _profile(side: _Side, front: NDArray[np.float64], top: float, band: float) -> NDArray[np.float64]:
    """Radius and z (K, 2) from the table to the top: half the fitted side's, half what the points of each level say."""
    levels = np.linspace(0, top, max(4, int(top / 0.008)) + 1)
    radii = side.radius(levels)
    front = front[np.argsort(front[:, 2])]
    rho = np.linalg.norm(front[:, :2] - side.axis, axis=1)
    around = np.searchsorted(front[:, 2], [levels - 0.0061, levels + 0.0061])
    for i, level in enumerate(levels):
        near = slice(*around[:, i])
        here = rho[near][(np.abs(front[near, 2] - level) < 0.006) & (np.abs(rho[near] - radii[i]) < 2.5 * band)]
        if len(here) > 6:
            radii[i] = 0.5 * radii[i] + 0.5 * np.median(here)
    return np.column_stack([radii, levels])


def seen_into(sights: list[Sight], body: Body, noise: float) -> bool:
    """Whether most of the rays that meet the top disc of the body from above go on below it: then it is open."""
    radius, top = body.profile[-1]
    steps = np.linspace(-0.6, 0.6, 13)
    x, y = (part.ravel() for part in np.meshgrid(steps, steps))
    disc = np.column_stack([x, y])[np.hypot(x, y) <= 0.6] * radius + body.axis
    lid = np.column_stack([disc, np.full(len(disc), top)])
    through = told = 0
    margin = max(0.010, 3 * noise)
    for sight in sights:
        # Of the mouth of a body on its side a camera at the other end sees nothing.
        if sight.eye[2] < top:
            continue
        inside, blind, z, measured = sight.sample(lid)
        with np.errstate(invalid="ignore"):
            known = (inside > 0.5) & ~blind & (measured > z - margin)
        told += int(known.sum())
        through += int((measured[known] > z[known] + margin).sum())
    return told > 8 and through > 0.5 * told


def _through_the_top(body: Body, sight: Sight, spots: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether a camera looks at spots (..., 3) inside a body's foot through its top, and not past the rim itself."""
    radius, top = body.profile[-1]
    share = (top - spots[..., 2]) / np.maximum(sight.eye[2] - spots[..., 2], 1e-6)
    met = spots[..., :2] + share[..., None] * (sight.eye[:2] - spots[..., :2])
    return np.linalg.norm(met - body.axis, axis=-1) < radius - RIM


#: Spacing of the offsets at which a mask's edge is looked for, m.
EDGE_STEP = 5e-4


def fit_to_silhouettes(body: Body, sights: list[Sight], reach: float = 0.008) -> Body:
    """The body moved and scaled to the masks' edges, which the colour image puts to a pixel, where depth rounds them off.

    At each level the two tangent rays of every camera tell the radius on the camera's left and right; where both are
    seen, half of their difference moves the axis sideways.  A side without an edge near (a handle) says nothing.  The
    far rim's upper edge tells the height.
    """
    steps = np.arange(-reach, reach + EDGE_STEP / 2, EDGE_STEP)
    for _ in range(2):
        body = _fit_sides(body, sights, steps)
    tops = [edge for sight in sights for edge in _rim_edges(body, sight, steps)]
    if len(tops) >= 5:
        profile = body.profile.copy()
        profile[:, 1] *= 1 + float(np.median(tops)) / profile[-1, 1]
        body = replace(body, profile=profile)
    return body


def crossing(values: NDArray[np.float32], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The offset (N,) at which rows of mask values (N, S) fall below a half once and for all; NaN where they do not."""
    below = values < 0.5
    index = below.argmax(axis=1)
    rows = np.arange(len(values))
    sound = below.any(axis=1) & (index > 0) & ~(~below & (np.arange(values.shape[1]) > index[:, None])).any(axis=1)
    before, after = values[rows, np.maximum(index - 1, 0)], values[rows, index]
    share = np.clip((before - 0.5) / np.maximum(before - after, 1e-6), 0, 1)
    return np.where(sound, steps[np.maximum(index - 1, 0)] + share * EDGE_STEP, np.nan)


def _fit_sides(body: Body, sights: list[Sight], steps: NDArray[np.float64]) -> Body:
    """One turn of moving the axis and of widening the profile to what the cameras see on the left and on the right."""
    axis, levels = body.axis, body.profile[:, 1]
    sides, moves = [], []
    for sight in sights:
        left, right, across = _side_edges(body, sight, steps)
        sides += [left, right]
        both = np.isfinite(left) & np.isfinite(right)
        if both.sum() >= 2:
            moves.append((across, float(np.median((right - left)[both]) / 2)))
    if moves:
        matrix = np.array([across for across, _ in moves] + [[0.05, 0], [0, 0.05]])
        axis = axis + np.linalg.lstsq(matrix, np.array([move for _, move in moves] + [0, 0]), rcond=None)[0]
    profile = body.profile
    edges = np.stack(sides)
    told = np.isfinite(edges)
    if told.sum() >= 4:
        # A line, so that the mask's ragged edge does not ruffle the profile.
        where = np.broadcast_to(levels / levels[-1], edges.shape)[told]
        slope, offset = np.polyfit(where, edges[told], 1) if np.ptp(where) > 0.4 else (0.0, float(np.median(edges[told])))
        profile = np.column_stack([np.maximum(body.radius(levels) + offset + slope * levels / levels[-1], 0.004), levels])
    return replace(body, axis=axis, profile=profile)


def _side_edges(
    body: Body, sight: Sight, steps: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """How much wider the mask is than the body, metres for each level (K,), on a camera's left and right; and the way to its right (2,)."""
    levels = body.profile[:, 1]
    inner = (levels > 0.1 * levels[-1]) & (levels < 0.97 * levels[-1])
    away = body.axis - sight.eye[:2]
    distance = max(float(np.linalg.norm(away)), 1e-6)
    away = away / distance
    across = np.array([away[1], -away[0]])
    radii = body.radius(levels)
    # Of what opens upwards a wider level above is seen before the side of a lower one.
    nearer = (levels - levels[:, None]) * distance / max(float(sight.eye[2] - levels[-1]), 1e-6)
    before = np.where(nearer >= 0, np.sqrt(np.maximum(radii**2 - nearer**2, 0)), 0).max(axis=1) - radii
    found = []
    for sign in (-1, 1):
        rho = radii[:, None] + steps
        sine = np.clip(rho / distance, 0, 0.9)
        tangent = body.axis + rho[..., None] * (-sine[..., None] * away + sign * np.sqrt(1 - sine**2)[..., None] * across)
        inside, blind, _, _ = sight.sample(np.concatenate([tangent, np.broadcast_to(levels[:, None, None], (*rho.shape, 1))], axis=2))
        edge = crossing(inside, steps) - before
        edge[blind.any(axis=1) | ~inner] = np.nan
        found.append(edge)
    middle = np.nanmedian(np.concatenate(found)) if np.isfinite(np.concatenate(found)).any() else 0.0
    # Where a handle begins its edge is taken for the body's.
    left, right = (np.where(np.abs(edge - middle) < 0.003, edge, np.nan) for edge in found)
    return left, right, across


def _rim_edges(body: Body, sight: Sight, steps: NDArray[np.float64]) -> list[float]:
    """How much higher the mask reaches than the far rim, metres, at nine places around it; fewer where it cannot be told."""
    axis, profile = body.axis, body.profile
    away = axis - sight.eye[:2]
    bearing = np.arctan2(away[1], away[0]) + np.linspace(-0.5, 0.5, 9)
    rim = axis + profile[-1, 0] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    heights = profile[-1, 1] + steps
    spots = np.concatenate(
        [np.repeat(rim[:, None], len(steps), axis=1), np.broadcast_to(heights[None, :, None], (len(rim), len(steps), 1))], axis=2
    )
    inside, blind, _, _ = sight.sample(spots)
    edge = crossing(inside, steps)
    edge[blind.any(axis=1)] = np.nan
    return edge[np.isfinite(edge)].tolist()


def build_round(
    sights: list[Sight], points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, parameters: Parameters
) -> Reconstruction | None:
    """A round body with or without a handle; ``None`` where the points tell of something else.

    points (N, 3) with the camera (N, 3) that saw each; height and noise as for :func:`magic_perception.primitives.recognise`.
    """
    body = round_body(points, eyes, height, noise, parameters.wall, parameters.seed)
    if body is None:
        return None
    lid = not seen_into(sights, body, noise)
    # Out of an open one something may stick.
    if lid and height > body.profile[-1, 1] + STICKS:
        return None
    body = _to_the_masks(body, lid, sights, noise)
    beyond = np.linalg.norm(points[:, :2] - body.axis, axis=1) - body.radius(points[:, 2])
    over = points[(points[:, 2] > body.profile[-1, 1] + STICKS) & (beyond < 0)]
    if len(over) > 0.08 * len(points):
        return None  # more than a body of revolution with a flat end, a bottle's neck say
    out = points[beyond > max(0.005, 2.5 * noise)]
    handle = None
    if len(out) > 20:
        out = standing_off(out, body)
        reach = np.linalg.norm(out[:, :2] - body.axis, axis=1)
        if len(out) > 0.01 * len(points) and np.percentile(reach - body.radius(out[:, 2]), 95) > 0.010:
            if np.percentile(out[:, 2], 95) > STEM * body.profile[-1, 1]:
                return None  # a ladle
            handle = handle_of(sights, out, body)
            if handle is None and len(out) > 0.15 * len(points):
                return None
        elif len(out) > 0.2 * len(points):
            return None
    mesh, pieces = turned_body(body, max(parameters.wall, 0.0035))
    # A mouth tells of a cup, and a bar on it of a handle. Beside what is closed, or closed as far as is seen, it takes the hole between: what stands
    # close to a tin is no handle.
    if handle is None or (not body.open and handle.hole < HOLE):
        return Reconstruction(mesh, tuple(pieces), "round")
    return Reconstruction(_united(mesh, handle.bars), tuple(pieces + handle.pieces), "round with handle")


def _to_the_masks(body: Body, lid: bool, sights: list[Sight], noise: float) -> Body:
    """The body fitted to the masks' edges, open or closed as it was seen to be, or a band; lid: depth shows that it is closed."""
    fitted = fit_to_silhouettes(body, sights)
    if lid or not seen_into(sights, fitted, noise):
        # A lid that depth shows is where it is: the masks' edges tell the sides alone.
        level = fitted.profile[:, 1] * (body.profile[-1, 1] / fitted.profile[-1, 1])
        return replace(fitted, profile=np.column_stack([fitted.profile[:, 0], level]))
    fitted = replace(fitted, open=True)
    return replace(fitted, through=True) if seen_through(fitted, sights) else fitted


#: A body is a band where the table shows to a camera at so much of its foot, or at so much of what it sees of that through the top, if that is so large, m^2.
#: Of twelve cups, bowls and mugs none showed any; of five bands that were deeper than wide the slivers seen of the table, 0.1 cm2 and more, were open by 13 to 85 %.
SHOWS, OPENS, SLIVER = 0.12, 0.3, 5e-5
#: Wall and smear at the rim of an open body are so wide, m.
RIM = 0.006


def seen_through(body: Body, sights: list[Sight]) -> bool:
    """Whether some part of the table inside an open body shows to some camera through its top, as of a band."""
    turns, shares = np.arange(32) * 2 * np.pi / 32, np.linspace(0.1, 0.9, 9)
    ring = np.column_stack([np.cos(turns), np.sin(turns)])
    spots = np.stack([np.column_stack([body.axis + f * body.profile[0, 0] * ring, np.full(len(ring), 0.001)]) for f in shares])
    # Each stands for an area of the foot, m^2: the farther out, the larger.
    area = shares[:, None] * (0.1 * 2 * np.pi / len(turns) * body.profile[0, 0] ** 2)
    for sight in sights:
        through = _through_the_top(body, sight, spots)
        table = through & (carve([sight], [spots]) < 0.3)
        seen = float((area * through).sum())
        if table.mean() > SHOWS or (seen > SLIVER and float((area * table).sum()) > OPENS * seen):
            return True
    return False


def _united(mesh: Mesh, bars: list[Mesh]) -> Mesh:
    """One closed mesh of a body and its handle's bars."""
    import trimesh

    try:
        joined = trimesh.boolean.union([mesh.to_trimesh(), *[bar.to_trimesh() for bar in bars]], engine="manifold")
        return Mesh(joined.vertices, joined.faces)
    except Exception:  # the boolean library refuses a degenerate solid: overlapping closed parts still bound the same solid
        return concatenate([mesh, *bars])


def turned_body(body: Body, wall: float, sectors: int = 16) -> tuple[Mesh, list[Mesh]]:
    """Mesh and convex pieces of a round body: a stack of frusta, or a floor and wall sectors where it is open."""
    profile = body.profile
    simple = np.asarray(shapely.LineString(profile).simplify(0.0008).coords)
    if not body.open or profile[:, 0].min() < 2.5 * wall:
        mesh = primitives.revolve(profile, body.axis)
        pieces = [primitives.revolve(simple[i : i + 2], body.axis, 24) for i in range(len(simple) - 1)]
        chord = np.interp(profile[:, 1], profile[[0, -1], 1], profile[[0, -1], 0])
        if np.all(profile[:, 0] > chord - 0.001) and np.all(np.diff(profile[:, 0], 2) < 0.0015):
            hull = hull_of(primitives.revolve(simple, body.axis, 32).vertices)
            pieces = [hull] if hull is not None else pieces
        return mesh, pieces
    floor = 0.0 if body.through else min(0.006, 0.2 * profile[-1, 1]) if body.floor is None else body.floor
    inner = np.column_stack([profile[:, 0] - wall, profile[:, 1]])
    pieces: list[Mesh] = []
    if body.through:
        mesh = primitives.turn_ring(np.vstack([profile, inner[::-1]]), body.axis)
    else:
        inner = np.vstack([[np.interp(floor, inner[:, 1], inner[:, 0]), floor], inner[inner[:, 1] > floor + 0.001]])
        mesh = primitives.revolve(np.vstack([profile, inner[::-1]]), body.axis)
        ends = np.array([[np.interp(z, simple[:, 1], simple[:, 0]), z] for z in (0.0, floor)])
        pieces.append(primitives.revolve(ends, body.axis, 24))
    levels = simple[:, 1].copy()
    levels[0] = floor
    levels = levels[(levels >= floor)]
    angles = np.linspace(0, 2 * np.pi, sectors + 1)
    for z0, z1 in itertools.pairwise(levels):
        outer0, outer1 = np.interp([z0, z1], simple[:, 1], simple[:, 0])
        for a, b in itertools.pairwise(angles):
            corners = [
                [body.axis[0] + r * np.cos(t), body.axis[1] + r * np.sin(t), z]
                for t in (a, b)
                for r, z in ((outer0, z0), (outer0 - wall, z0), (outer1, z1), (outer1 - wall, z1))
            ]
            hull = hull_of(np.array(corners))
            if hull is not None:
                pieces.append(hull)
    return mesh, pieces
