"""The local stage: curvature of the contour around a contact point (paper, III-C).

At an observation scale s around the point c the contour points within s are put into
axes along their tangent (principal component) and their normal, and a parabola
y = a x^2 is fitted.  The paper takes kappa = 2 |a| and r = 1 / kappa.  Three things are
made exact here.

*Wide arcs.*  Over an arc of a circle of radius R that is not short against R the parabola
is steeper than its osculating one: with t = s / R the arc spans +-Theta, Theta = 2 asin(t / 2),
and the fit gives a s = g(t) with

    g(t) = t * int_0^Theta (1 - cos w) sin^2 w dw / int_0^Theta sin^4 w dw,

from g = t / 2 for short arcs to 4 t / 3 once the whole circle is seen (t >= 2), where 2 a
overestimates the curvature 2.7 times.  g is increasing, so R = s / g^-1(a s) undoes it; on
a circle the estimate is the same at every scale.  The choice of the scale keeps the paper's
uncorrected r, to which alpha = 3.5 belongs: on a circle s / r = 3.5 is met at s = 1.73 R.

*Tips and fillets.*  An arc of a circle is not all that an edge can be.  The radius is read off
at the largest scale, up to the functional one, at which a conic through the contact,

    y = A x^2 + B y^2 + C x y + D x + E,    D and E small: what is left of normal and place,

explains the edge to the raster's precision (:func:`explained`): a circle where that is
enough, else the conic, which is exact for the tips and flanks of ellipses at any scale.
Within a fillet that is a scale that does not see its arms yet.  Where no scale of at
least ``EXPLAINED_FLOOR`` px is explained (sharp corners, rough masks) the arc's radius at the
functional scale stands.

*Other edges.*  The points used are those that the walk along the contour from c reaches
without leaving the disc of radius s for more than a few pixels, and, the second time,
those hit first by rays from S (irrelevant point suppression).  S stays between c and
the next edge along the normal, so that it never lies behind it.

*Scales.*  The pyramid is relative to the object's size, with a floor in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import Code, MagicError
from magic_matcher.contour import Contour

#: The paper's alpha: the motion functional scale is the one with s / r nearest to it.
ALPHA = 3.5

#: Smallest and largest observation scale as shares of the object's size (its diagonal), and
#: the floor in pixels: below it the raster speaks louder than the shape.
SMALLEST_SCALE, LARGEST_SCALE, SCALE_FLOOR = 0.015, 0.65, 5.0
SCALES = 18

#: The walk along the contour may leave the disc for this many pixels (released code: 5).
GAP = 5

#: Contour points used on a length of one scale; more do not change the fit.
DENSITY = 32

#: Where the sign disagrees with the reference S lies this far along the normal, px (released code).
NEAR = 5.0

#: A radius beyond this many object sizes is a straight edge.
STRAIGHT = 50.0

#: A bow lower than this over a whole scale, px, is none.
STRAIGHT_SAGITTA = 2e-3

#: s / r this near to alpha has met it; see _functional_scale.
TIE = 0.75

#: An edge is explained by a model that leaves no more than this, root mean square, px; the raster alone leaves 0.1 to 0.25.
RESIDUE = 0.28
#: A conic is believed where it explains a scale so many times larger than a circle does, or all scales: a fillet with a
#: little of its arms is a conic, too.
FAR = 2.0
#: Below this scale (px) any curve explains the few points there are.
EXPLAINED_FLOOR = 10.0

_RAYS, _RAY_STEPS = 96, 56
#: Scales, from the largest, at which an arc between straight arms is looked for.
_FILLETS = 5
#: Neighbourhoods whose rays are sampled at a time.
_BLOCK = 16


@dataclass(frozen=True)
class Estimate:
    """Curvature at one contour point; lengths in pixels.

    index and point (2,) on the contour; normal (2,) unit, outward; radius (inf:
    straight); concave: the centre of curvature lies outside the material; scale is the
    motion functional scale s_j; fitness = |s / r - alpha| with the uncorrected r.
    scales, curvatures (J,) hold the pyramid: signed corrected curvature 1/px, positive
    where convex, NaN where there was nothing to fit.
    """

    index: int
    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    radius: float
    concave: bool
    scale: float
    fitness: float
    scales: NDArray[np.float64]
    curvatures: NDArray[np.float64]

    @property
    def signed_curvature(self) -> float:
        """1/px, positive where convex."""
        return (-1.0 if self.concave else 1.0) / self.radius


@lru_cache(maxsize=1)
def _arc_table() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """t = s / R in (0, 2] and g(t) = a s of the parabola fitted to that arc; see the module's head."""
    t = np.linspace(1e-3, 2.0, 4001)
    w = 2.0 * np.arcsin(t / 2.0)
    sin2 = w / 2 - np.sin(2 * w) / 4
    sin2cos = np.sin(w) ** 3 / 3
    sin4 = 3 * w / 8 - np.sin(2 * w) / 4 + np.sin(4 * w) / 32
    with np.errstate(divide="ignore", invalid="ignore"):
        g = t * (sin2 - sin2cos) / sin4
    # sin4 loses its digits for short arcs, where g = t / 2 (1 + t^2 / 7 + ...) is exact enough
    return t, np.where(t < 0.05, t / 2, g)


def arc_curvature(a: ArrayLike, scale: ArrayLike) -> NDArray[np.float64]:
    """Signed curvature of the circle whose arc within ``scale`` gives the parabola coefficient ``a``."""
    a, scale = np.broadcast_arrays(np.asarray(a, dtype=float), np.asarray(scale, dtype=float))
    t, g = _arc_table()
    value = np.abs(a) * scale
    arc = np.interp(value, np.concatenate([[0.0], g]), np.concatenate([[0.0], t])) / scale
    return np.sign(a) * np.where(value > g[-1], np.abs(a) * 0.75, arc)


def pyramid(size: float) -> NDArray[np.float64]:
    """Observation scales (SCALES,) in pixels, geometric, for an object of that size in pixels."""
    low = max(SMALLEST_SCALE * size, SCALE_FLOOR)
    return np.geomspace(low, max(LARGEST_SCALE * size, 1.5 * low), SCALES)


@dataclass(frozen=True)
class Neighbourhood:
    """Contour points around B centres on a walk of K steps, single precision.

    u, v, distance (B, K): offsets from the centre and how far they are, px; nu, nv (B, K): the contour's normals;
    once (B, K): which of them are there, each once; middle: the column of the centres.
    """

    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]
    nu: NDArray[np.float32]
    nv: NDArray[np.float32]
    once: NDArray[np.bool_]
    middle: int


def neighbourhood(contour: Contour, indices: NDArray[np.int64], offsets: NDArray[np.int64]) -> Neighbourhood:
    """The contour points at steps ``offsets`` (K,), ascending and with 0 among them, from ``indices`` (B,)."""
    window, once = contour.window(indices, offsets)
    u, v, nu, nv = contour.flat
    du, dv = u[window], v[window]
    du -= u[indices][:, None]
    dv -= v[indices][:, None]
    return Neighbourhood(du, dv, np.sqrt(du * du + dv * dv), nu[window], nv[window], once, int(np.searchsorted(offsets, 0)))


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.einsum("bk,bk->b", a, b).astype(np.float64)


def fit(around: Neighbourhood, use: NDArray[np.bool_], scales: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parabola coefficients and normals of B neighbourhoods, of which the points ``use`` (B, K) within ``scales`` (B,) are fitted.

    -> a (B,), positive where convex, NaN with fewer than five points; normal (B, 2)
    outward.  The tangent is the principal component of the points within s / 2; where
    an acute tip would turn it by 90 degrees, the component that is square to the mean
    of the contour's own normals.
    """
    u, v = around.u, around.v
    near = use & (around.distance <= (0.5 * scales).astype(np.float32)[:, None])
    count = np.count_nonzero(near, axis=1)
    few = count < 5
    if few.any():
        near[few] = use[few]
        count[few] = np.count_nonzero(use[few], axis=1)
    weight = near.astype(np.float32)
    count = np.maximum(count, 1)
    # First and second moments; the centre is near the points, so that nothing is lost by subtracting them.
    wu, wv = weight * u, weight * v
    mean_u, mean_v = _dot(wu, weight) / count, _dot(wv, weight) / count
    uu = _dot(wu, u) / count - mean_u**2
    vv = _dot(wv, v) / count - mean_v**2
    uv = _dot(wu, v) / count - mean_u * mean_v
    angle = 0.5 * np.arctan2(2 * uv, uu - vv)
    tangent = np.column_stack([np.cos(angle), np.sin(angle)])
    outward = np.column_stack([_dot(weight, around.nu), _dot(weight, around.nv)]) / count[:, None]
    length = np.linalg.norm(outward, axis=1)
    along = np.abs(np.sum(outward * tangent, axis=1))
    turned = (along > 0.75 * length) & (length > 0.2)
    tangent = np.where(turned[:, None], np.column_stack([-tangent[:, 1], tangent[:, 0]]), tangent)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    own = np.column_stack([around.nu[:, around.middle], around.nv[:, around.middle]])
    side = np.sum(normal * np.where((length > 0.2)[:, None], outward, own), axis=1)
    normal = np.where(side[:, None] < 0, -normal, normal)
    t, n = tangent.astype(np.float32), normal.astype(np.float32)
    x = u * t[:, :1] + v * t[:, 1:]
    y = u * n[:, :1] + v * n[:, 1:]
    np.multiply(x, x, out=x)
    np.multiply(x, use, out=x)
    fourth = _dot(x, x)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = -_dot(x, y) / fourth
    # A straight edge has no sign: what single precision leaves of it is not to be taken for one.
    a = np.where(np.abs(a) * scales**2 < STRAIGHT_SAGITTA, 0.0, a)
    return np.where((np.count_nonzero(use, axis=1) >= 5) & (fourth > 0), a, np.nan), normal


def connected(
    distance: NDArray[np.floating[Any]], once: NDArray[np.bool_], scales: NDArray[np.float64], middle: int, gap: int = GAP
) -> NDArray[np.bool_]:
    """Which points (B, K) the walk from the column ``middle`` reaches inside the disc; see ``GAP``."""
    inside = distance <= scales[:, None].astype(distance.dtype)
    inside &= once

    def walk(part: NDArray[np.bool_]) -> None:
        # Here ``part`` is a view: what lies behind the first wide gap is taken out of it.
        position = np.arange(part.shape[1], dtype=np.int32)
        if gap == 0:
            broken = ~part
            broken[:, 0] = False
        else:
            last = np.maximum.accumulate(part * position, axis=1)
            broken = position - last > gap
        first = np.argmax(broken, axis=1)
        there = np.nonzero(first)[0]
        part[there] &= position < first[there, None]

    walk(inside[:, middle:])
    walk(inside[:, middle::-1])
    return inside


def clearance(
    contour: Contour, points: NDArray[np.float64], directions: NDArray[np.float64], reach: ArrayLike, steps: int = 64
) -> NDArray[np.float64]:
    """Distance (B,) from points (B, 2) on the edge along unit directions (B, 2) to the next edge; ``reach`` where there is none.

    The first 1.5 px, in which the ray leaves the edge it starts from, are passed over.
    """
    reach = np.broadcast_to(np.asarray(reach, dtype=float), (len(points),))
    at = (1.5 + np.linspace(0.0, 1.0, steps) * np.maximum(reach - 1.5, 0.5)[:, None]).astype(np.float32)
    start, step = points.astype(np.float32), directions.astype(np.float32)
    material = contour.sample(start[:, :1] + at * step[:, :1], start[:, 1:] + at * step[:, 1:]) > 0.5
    first = np.argmax(material != material[:, :1], axis=1)
    return np.where(first > 0, at[np.arange(len(points)), first], reach)


@lru_cache(maxsize=1)
def _rays() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    angles = (np.arange(_RAYS) + 0.5) * (2 * np.pi / _RAYS)
    return np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)


def visible(
    contour: Contour,
    sources: NDArray[np.float64],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    reach: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which points (B, K), given by their offsets u, v from their source (B, 2), its rays hit first, out to ``reach`` (B,) pixels."""
    cosine, sine = _rays()
    radii = (np.linspace(0.0, 1.0, _RAY_STEPS) * reach[:, None]).astype(np.float32)[:, None, :]
    start = sources.astype(np.float32)
    first = np.empty((len(sources), _RAYS), np.int64)
    for part in range(0, len(sources), _BLOCK):  # so that what is sampled stays in the processor's cache
        rows = slice(part, part + _BLOCK)
        grid_u = radii[rows] * cosine[:, None]
        grid_v = radii[rows] * sine[:, None]
        grid_u += start[rows, 0, None, None]
        grid_v += start[rows, 1, None, None]
        material = contour.sample(grid_u.reshape(-1, _RAY_STEPS), grid_v.reshape(-1, _RAY_STEPS)) > 0.5
        first[rows] = np.argmax(material != material[:, :1], axis=1).reshape(-1, _RAYS)
    first[first == 0] = _RAY_STEPS
    hit = first * (reach / (_RAY_STEPS - 1))[:, None]
    # A ray that grazes an edge may meet it anywhere between its neighbours' hits.
    hit = np.maximum(hit, np.maximum(np.roll(hit, 1, axis=1), np.roll(hit, -1, axis=1)))
    hit = (hit + (2.0 + reach / (_RAY_STEPS - 1))[:, None]).astype(np.float32)
    column = (np.arctan2(v, u) * np.float32(_RAYS / (2 * np.pi))).astype(np.int32)
    # Truncated towards zero: one less for what is negative is its floor but on a ray's very border.
    column -= v < 0
    column %= _RAYS
    return np.sqrt(u * u + v * v) <= np.take_along_axis(hit, column, axis=1)


def measure(
    contour: Contour,
    indices: NDArray[np.int64],
    scales: NDArray[np.float64],
    concave: bool | None = None,
    suppress: bool = True,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Parabola coefficients a (B,) (positive: convex), normals (B, 2) and extents (B,) at contour points (B,) and scales (B,).

    The extent is how far the points that were used reach from the contact: at most the
    scale, less where the edge ends or the rays see less of it.

    Curvature is computed twice, the second time from the points that rays from S hit
    first.  ``concave`` is the sign that is looked for: where the first estimate disagrees
    S lies ``NEAR`` px along the normal on the side that sign asks for.  suppress=False
    stops after the first estimate (ablation).
    """
    levels = np.unique(scales)
    if len(levels) > 4 and levels[-1] > 3 * levels[0]:
        # Small and large scales apart: neither needs the other's reach or the other's density.
        a, normal, extent = np.empty(len(scales)), np.empty((len(scales), 2)), np.empty(len(scales))
        large = scales >= levels[(len(levels) + 1) // 2]
        for part in (~large, large):
            a[part], normal[part], extent[part] = measure(contour, indices[part], scales[part], concave, suppress)
        return a, normal, extent
    # Any arc that stays within s and can be taken for one edge is shorter than a full circle of radius s.
    stride = max(1, int(levels[0] / DENSITY))
    half = int(np.ceil(min(np.pi * float(levels[-1]), float(contour.lengths.max())) / stride)) + 1
    gap = max(1, GAP // stride)
    around = neighbourhood(contour, indices, np.arange(-half, half + 1) * stride)
    use = connected(around.distance, around.once, scales, half, gap)
    a, normal = fit(around, use, scales)
    extent = _extent(around.distance, use, half)
    if not suppress:
        return a, normal, extent
    curvature = arc_curvature(np.nan_to_num(a), extent)
    agrees = np.ones(len(a), bool) if concave is None else (curvature < 0) == concave
    outside = curvature < 0 if concave is None else np.full(len(a), concave)
    direction = np.where(outside[:, None], normal, -normal)
    delta = np.where(agrees, 0.5 / np.maximum(np.abs(curvature), 1e-9), NEAR)
    delta = np.minimum(delta, 0.5 * scales)
    centres = contour.points[indices]
    free = clearance(contour, centres, direction, 2 * delta + 3.0)
    delta = np.maximum(np.minimum(delta, 0.5 * free), 1.0)
    shift = delta[:, None] * direction
    near = shift.astype(np.float32)
    seen = visible(contour, centres + shift, around.u - near[:, :1], around.v - near[:, 1:], scales + delta)
    seen[:, half] = True
    # Suppression may open gaps: what lies behind one is another edge.
    second = connected(around.distance, use & seen, scales, half, gap)
    enough = np.count_nonzero(second, axis=1) >= np.maximum(5, 0.25 * np.count_nonzero(use, axis=1))
    second[~enough] = use[~enough]
    return *fit(around, second, scales), _extent(around.distance, second, half)


def _extent(distance: NDArray[np.float32], use: NDArray[np.bool_], middle: int) -> NDArray[np.float64]:
    """How far (B,) the used points reach; unequal sides are joined as they weigh in the fit, with the fifth power."""
    reached = distance * use
    sides = np.stack([reached[:, : middle + 1].max(axis=1), reached[:, middle:].max(axis=1)]).astype(np.float64)
    return np.maximum(np.mean(sides**5, axis=0) ** 0.2, 1e-6)


def curvature_map(contour: Contour, indices: NDArray[np.int64], scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Signed curvature (B,) 1/px and normals (B, 2) at many contour points and one scale, without suppression."""
    half = int(np.ceil(min(np.pi * scale, float(contour.lengths.max())))) + 1
    # 32 points a side tell as much as all of them.
    offsets = np.unique(np.rint(np.linspace(-half, half, 65)).astype(int))
    around = neighbourhood(contour, indices, offsets)
    scales = np.full(len(indices), float(scale))
    use = connected(around.distance, around.once, scales, around.middle, 0)
    a, normal = fit(around, use, scales)
    return arc_curvature(np.nan_to_num(a), _extent(around.distance, use, around.middle)), normal


def _search(contour: Contour, indices: NDArray[np.int64], normals: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.int64]:
    """Convexity matching's step: the nearest edge along the normal line, either way; the old point where there is none."""
    points = contour.points[indices]
    result = indices.copy()
    best = np.full(len(indices), np.inf)
    for sign in (1.0, -1.0):
        distance = clearance(contour, points, sign * normals, reach)
        there = (distance < reach - 1e-4) & (distance < best)
        for i in np.nonzero(there)[0]:
            result[i] = contour.nearest(points[i] + sign * distance[i] * normals[i])
        best = np.where(there, distance, best)
    return result


def _functional_scale(
    value: NDArray[np.float64], usable: NDArray[np.bool_], concave: NDArray[np.bool_], indices: NDArray[np.int64]
) -> tuple[int, float]:
    """Index of the motion functional scale for s / r (J,), and how much of the scale before it belongs to it (0..1).

    A sharp corner meets alpha at every scale alike, a rounded one comes near to it from
    some scale on for good: the argmin alone would fall on any of these by noise.  The
    smallest scale that comes within ``TIE`` of alpha is taken, to a fraction of a step, so
    that it does not jump when the object is turned or scaled; where none does, the argmin.
    """
    cost = np.where(usable, np.abs(value - ALPHA), np.inf)
    near = usable & (value >= ALPHA - TIE)
    if not near.any() or cost.min() > 1.0:
        return int(np.argmin(cost)), 0.0
    best = int(np.argmax(near))
    if best == 0 or not usable[best - 1] or concave[best - 1] != concave[best] or indices[best - 1] != indices[best]:
        return best, 0.0
    return best, float(np.clip((value[best] - (ALPHA - TIE)) / max(value[best] - value[best - 1], 1e-9), 0.0, 1.0))


def _bend(a: float, b: float, c: float, d: float, e: float) -> float:
    """Curvature of y = a x^2 + b y^2 + c x y + d x + e where it crosses the y axis near the origin."""
    fx, fy = d + c * e, 2 * b * e - 1
    return float((2 * a * fy * fy - 2 * c * fx * fy + 2 * b * fx * fx) / (fx * fx + fy * fy) ** 1.5)


def _models(
    x: NDArray[np.float64], y: NDArray[np.float64], use: NDArray[np.bool_], scales: NDArray[np.float64], circle: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Curvatures (J,), 1/px, and root mean squares of what is left (J,), px, of a circle or a conic through points x, y (K,),
    y along the inward normal, fitted to those of ``use`` (J, K) within ``scales`` (J,)."""
    one = np.ones_like(x)
    basis = np.stack((x * x + y * y, x, one) if circle else (x * x, y * y, x * y, x, one), axis=1)
    number = basis.shape[1]
    products = np.column_stack([(basis[:, :, None] * basis[:, None, :]).reshape(len(x), -1), basis * y[:, None], y * y])
    sums = use.astype(np.float64) @ products
    count = np.maximum(use.sum(axis=1), 1)
    # In units of the scale, so that all unknowns weigh alike.
    units = scales[:, None] ** np.array([2, 1, 0] if circle else [2, 2, 2, 1, 0])
    left = sums[:, : number**2].reshape(-1, number, number) / (units[:, :, None] * units[:, None, :])
    right = sums[:, number**2 : -1] / (units * scales[:, None])
    fitted = np.linalg.solve(left + 1e-7 * count[:, None, None] * np.eye(number), right[..., None])[..., 0]
    square = sums[:, -1] / scales**2 - 2 * np.sum(fitted * right, axis=1) + np.einsum("ji,jik,jk->j", fitted, left, fitted)
    residue = scales * np.sqrt(np.maximum(square, 0.0) / count)
    bends = [_bend(f[0], f[0], 0.0, f[1], f[2]) if circle else _bend(*f) for f in fitted.tolist()]
    return np.array(bends) / scales, residue


def _fillet(
    x: NDArray[np.float64], y: NDArray[np.float64], start: tuple[float, float, float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Two straight arms joined by an arc, fitted to points x, y (K,) of an edge that opens towards +y.

    start: slope angles of the left and the right arm, both rising away from the corner, and their offsets.
    -> (angle, angle, offset, offset, radius), what is left (K,), on which part each point lies (2, K): left arm, right arm.
    """

    def misses(p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Distances (P, K) from P models towards the open side, and the parts."""
        a, b, c, d, r = (p[:, k, None] for k in range(5))
        sa, ca, sb, cb = np.sin(a), np.cos(a), np.sin(b), np.cos(b)
        turn = sa * cb + ca * sb
        # The arc's centre is r away from both arms.
        u = (cb * (c + r) - ca * (d + r)) / turn
        v = (sb * (c + r) + sa * (d + r)) / turn
        dx, dy = x - u, y - v
        left, right = dy * sa - dx * ca, dx * cb + dy * sb
        arms = np.stack([(left > 0) & (left >= right), (right > 0) & (right > left)])
        on_left, on_right = x * sa + y * ca - c, y * cb - x * sb - d
        return np.where(arms[0], on_left, np.where(arms[1], on_right, r - np.sqrt(dx * dx + dy * dy))), arms

    a, b, c, d = start
    # Where the arms would meet, and how far the edge stays from it: k times the radius.
    turn = np.sin(a + b)
    apex = np.array([(np.cos(b) * c - np.cos(a) * d) / turn, (np.sin(b) * c + np.sin(a) * d) / turn])
    k = 1.0 / max(np.cos((a + b) / 2), 1e-3) - 1.0
    p = np.array([a, b, c, d, max(float(np.hypot(x - apex[0], y - apex[1]).min()) / k, 1.0)])
    steps = np.diag([1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
    damping, (left, arms) = 1e-3, misses(p[None])
    left, arms = left[0], arms[:, 0]
    for _ in range(8):
        jacobian = (misses(p + steps)[0] - left) / np.diag(steps)[:, None]
        gradient, normal = jacobian @ left, jacobian @ jacobian.T
        change = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -gradient)
        moved = p + change
        if not (0 < moved[0] < 1.5 and 0 < moved[1] < 1.5 and moved[4] > 0.5):
            break
        new, parts = misses(moved[None])
        if new[0] @ new[0] > left @ left:
            damping *= 10
            continue
        gained = left @ left - new[0] @ new[0]
        p, left, arms, damping = moved, new[0], parts[:, 0], damping * 0.3
        if gained < 1e-4 * (left @ left):
            break
    return p, left, arms


def fillet(x: NDArray[np.float64], y: NDArray[np.float64], blur: float) -> tuple[float, float] | None:
    """Radius (px) of the arc in which the contact (0, 0) lies between two straight arms, and the root mean square of what is left.

    x, y (K,) in walking order, x along the tangent, y towards the side to which the edge opens;
    blur: that of the contour.  ``None`` where there are no two arms or no arc between them.
    """
    if x[0] > x[-1]:
        x, y = x[::-1], y[::-1]
    third = len(x) // 3
    if third < 4:
        return None
    arms = []
    for part, sign in ((slice(0, third), -1.0), (slice(len(x) - third, len(x)), 1.0)):
        u, v = x[part], y[part]
        mean_u, mean_v = u.mean(), v.mean()
        du, dv = u - mean_u, v - mean_v
        angle = 0.5 * np.arctan2(2 * float(du @ dv), float(du @ du - dv @ dv))
        angle *= sign
        if not 0.05 < angle < 1.45:
            return None
        offset = np.sin(angle) * -sign * mean_u + np.cos(angle) * mean_v
        # Bent arms are none; what the arc itself takes of them is a little.
        if np.sqrt(np.mean((np.sin(angle) * -sign * u + np.cos(angle) * v - offset) ** 2)) > 2 * RESIDUE:
            return None
        arms.append((angle, offset))
    (a, c), (b, d) = arms
    if a + b < 0.5:
        return None
    (a, b, _, _, radius), left, parts = _fillet(x, y, (a, b, c, d))
    turn = a + b
    arc = ~parts.any(axis=0)
    if not arc[np.argmin(x * x + y * y)] or arc.sum() < 4 or min(parts.sum(axis=1)) < max(4.0, 0.3 * radius) or turn < 0.5:
        return None
    # The blur of the mask fills the corner by blur^2 / (2 r), and the arc's middle is k r from where the arms meet.
    k = 1.0 / np.cos(turn / 2) - 1.0
    radius = 0.5 * (radius + np.sqrt(max(radius**2 - 2 * blur**2 / k, 0.0)))
    return float(radius), float(np.sqrt(np.mean(left**2)))


def explained(
    contour: Contour, index: int, normal: NDArray[np.float64], scales: NDArray[np.float64], concave: bool = False
) -> tuple[float, float] | None:
    """Signed curvature (1/px, positive: convex) at the largest of ``scales`` at which a circle, a conic or an arc between
    straight arms explains the edge, and that scale; ``None`` where there is none.  ``normal`` (2,) is the contact's, outward, concave its
    sign.
    """
    scales = np.sort(scales[scales >= EXPLAINED_FLOOR])[::-1]
    if not len(scales):
        return None
    half = int(np.ceil(min(np.pi * float(scales[0]), float(contour.lengths.max())))) + 1
    window, once = contour.window(np.array([index]), np.arange(-half, half + 1))
    local = contour.points[window[0]] - contour.points[index]
    distance = np.hypot(local[:, 0], local[:, 1])
    use = connected(np.broadcast_to(distance, (len(scales), len(distance))), once, scales, half)
    # Where a side is shorter the edge ends within the scale.
    whole = np.minimum(np.count_nonzero(use[:, :half], axis=1), np.count_nonzero(use[:, half + 1 :], axis=1)) >= 0.5 * scales
    if not whole.any():
        return None
    largest = float(scales[0])
    scales, use = scales[whole], use[whole]
    tangent = np.array([-normal[1], normal[0]])
    x, y = local @ tangent, -(local @ normal)
    circles, left = _models(x, y, use, scales, True)
    circle = int(np.argmax(left <= RESIDUE)) if (left <= RESIDUE).any() else len(scales)
    if circle == 0:
        return float(_unblurred(circles[0], contour.blur)), float(scales[0])
    conics, left = _models(x, y, use[:circle], scales[:circle], False)
    # More bent than this it is a corner's arms that look like a hyperbola.
    fits = (left <= RESIDUE) & (np.abs(conics) * scales[:circle] <= ALPHA)
    conic = int(np.argmax(fits)) if fits.any() else circle
    for k in range(min(conic + 1, circle, _FILLETS)):  # larger than, or as large as, what a conic explains
        found = fillet(x[use[k]], -y[use[k]] if concave else y[use[k]], contour.blur)
        # An ellipse's tip looks a little like a fillet, and noise may let it pass: a fillet is clearly no conic.
        if found is not None and found[1] <= min(RESIDUE, 0.65 * float(left[k])):
            return (-1.0 if concave else 1.0) / found[0], float(scales[k])
    if conic < circle and (circle == len(scales) or scales[circle] < scales[conic] / FAR or scales[conic] == largest):
        return float(conics[conic]), float(scales[conic])
    return (float(_unblurred(circles[circle], contour.blur)), float(scales[circle])) if circle < len(scales) else None


def _unblurred(curvature: float, blur: float) -> float:
    """The curvature of an arc before the blur of the mask took blur^2 / (2 r) of its radius."""
    return curvature / (1.0 + 0.5 * (blur * curvature) ** 2)


def estimate(
    contour: Contour,
    index: int,
    concave: bool | None = None,
    scales: NDArray[np.float64] | None = None,
) -> Estimate:
    """Curvature at the contour point ``index`` and its motion functional scale.

    With ``concave`` given (the reference's sign) a point of the other sign is moved by
    the convexity search, scale by scale, and only scales with that sign are accepted,
    if there is one.  Raises ``NO_CURVATURE`` where no scale has enough points.
    """
    found = estimate_many(contour, np.array([int(index)]), concave, scales)[0]
    if found is None:
        raise MagicError(
            Code.NO_CURVATURE, "contour points around the contact", int(contour.lengths[contour.loop[index]]), "at least 5 on its edge"
        )
    return found


def estimate_many(
    contour: Contour,
    starts: NDArray[np.int64],
    concave: bool | None = None,
    scales: NDArray[np.float64] | None = None,
    two_step: bool = True,
) -> list[Estimate | None]:
    """As :func:`estimate` at several contour points (P,) together; ``None`` where no scale has enough points."""
    scales = pyramid(contour.size) if scales is None else np.asarray(scales, dtype=float)
    if not len(starts):
        return []
    indices, level = np.repeat(np.asarray(starts, dtype=np.int64), len(scales)), np.tile(scales, len(starts))
    a, normal, extent = measure(contour, indices, level, concave, suppress=two_step)
    if concave is not None and two_step:
        wrong = np.isfinite(a) & ((a < 0) != concave)
        right = (np.isfinite(a) & ~wrong).reshape(len(starts), -1).any(axis=1)
        wrong &= ~np.repeat(right, len(scales))
        if wrong.any():
            moved = indices.copy()
            moved[wrong] = _search(contour, indices[wrong], normal[wrong], np.maximum(level[wrong], 2 * NEAR))
            retry = np.nonzero(moved != indices)[0]
            if len(retry):
                a2, normal2, extent2 = measure(contour, moved[retry], level[retry], concave)
                better = np.isfinite(a2) & ((a2 < 0) == concave)
                accepted = retry[better]
                indices[accepted], a[accepted] = moved[accepted], a2[better]
                normal[accepted], extent[accepted] = normal2[better], extent2[better]
    curvature = arc_curvature(np.nan_to_num(a), extent)
    shape = (len(starts), len(scales))
    parts = (indices.reshape(shape), a.reshape(shape), normal.reshape(*shape, 2), extent.reshape(shape), curvature.reshape(shape))
    return [_accept(contour, scales, concave, two_step, *row) for row in zip(*parts, strict=True)]


def _accept(
    contour: Contour,
    scales: NDArray[np.float64],
    concave: bool | None,
    two_step: bool,
    indices: NDArray[np.int64],
    a: NDArray[np.float64],
    normal: NDArray[np.float64],
    extent: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> Estimate | None:
    """The best across the scales (J,) of one contour point, ``None`` where none has enough points."""
    with np.errstate(invalid="ignore"):
        value = extent * 2 * np.abs(a)
    usable = np.isfinite(value)
    if concave is not None and (usable & ((a < 0) == concave)).any():
        usable &= (a < 0) == concave
    if not usable.any():
        return None
    best, share = _functional_scale(value, usable, (a < 0), indices)
    scale, signed = float(scales[best]), float(curvature[best])
    direction = normal[best]
    if share > 0:  # between the scale before and this one
        scale = float(scales[best - 1] ** share * scales[best] ** (1 - share))
        signed = float(curvature[best - 1] * share + curvature[best] * (1 - share))
        direction = normal[best - 1] * share + normal[best] * (1 - share)
        direction = direction / max(float(np.hypot(*direction)), 1e-9)
    exact = explained(contour, int(indices[best]), direction, scales[scales <= scale * (1 + 1e-9)], signed < 0) if two_step else None
    if exact is not None and (exact[0] < 0) == (signed < 0):
        signed = exact[0]
    radius = 1.0 / max(abs(signed), 1e-12)
    if radius > STRAIGHT * contour.size:
        radius = np.inf
    return Estimate(
        index=int(indices[best]),
        point=contour.points[indices[best]].copy(),
        normal=direction.copy(),
        radius=float(radius),
        concave=bool(signed < 0),
        scale=scale,
        fitness=float(abs(value[best] - ALPHA)),
        scales=scales,
        curvatures=np.where(np.isfinite(a), curvature, np.nan),
    )
