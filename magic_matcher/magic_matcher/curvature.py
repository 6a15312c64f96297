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


def pyramid(size: float, count: int = SCALES) -> NDArray[np.float64]:
    """Observation scales (count,) in pixels, geometric, for an object of that size in pixels."""
    low = max(SMALLEST_SCALE * size, SCALE_FLOOR)
    return np.geomspace(low, max(LARGEST_SCALE * size, 1.5 * low), count)


def fit(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    use: NDArray[np.bool_],
    centres: NDArray[np.float64],
    scales: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parabola coefficients and normals of B neighbourhoods.

    points, normals (B, K, 2) of the contour, use (B, K), centres (B, 2), scales (B,)
    -> a (B,), positive where convex, NaN with fewer than five points; normal (B, 2)
    outward.  The tangent is the principal component of the points within s / 2; where
    an acute tip would turn it by 90 degrees, the component that is square to the mean
    of the contour's own normals.
    """
    u, v = points[..., 0] - centres[:, :1], points[..., 1] - centres[:, 1:]
    near = use & (u * u + v * v <= (scales[:, None] / 2) ** 2)
    near = np.where(near.sum(axis=1, keepdims=True) >= 5, near, use)
    weight = near / np.maximum(near.sum(axis=1, keepdims=True), 1)
    # First and second moments; the centre is near the points, so that nothing is lost by subtracting them.
    mean_u, mean_v = np.sum(weight * u, axis=1), np.sum(weight * v, axis=1)
    uu = np.sum(weight * u * u, axis=1) - mean_u**2
    vv = np.sum(weight * v * v, axis=1) - mean_v**2
    uv = np.sum(weight * u * v, axis=1) - mean_u * mean_v
    angle = 0.5 * np.arctan2(2 * uv, uu - vv)
    tangent = np.column_stack([np.cos(angle), np.sin(angle)])
    outward = np.column_stack([np.sum(weight * normals[..., 0], axis=1), np.sum(weight * normals[..., 1], axis=1)])
    length = np.linalg.norm(outward, axis=1)
    along = np.abs(np.sum(outward * tangent, axis=1))
    turned = (along > 0.75 * length) & (length > 0.2)
    tangent = np.where(turned[:, None], np.column_stack([-tangent[:, 1], tangent[:, 0]]), tangent)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    own = normals[np.arange(len(points)), points.shape[1] // 2]
    side = np.where(length > 0.2, np.sum(normal * outward, axis=1), np.sum(normal * own, axis=1))
    normal = np.where(side[:, None] < 0, -normal, normal)
    x = u * tangent[:, :1] + v * tangent[:, 1:]
    y = u * normal[:, :1] + v * normal[:, 1:]
    x2 = np.where(use, x * x, 0.0)
    fourth = np.sum(x2 * x2, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = -np.sum(x2 * y, axis=1) / fourth
    return np.where((use.sum(axis=1) >= 5) & (fourth > 0), a, np.nan), normal


def connected(distance: NDArray[np.float64], once: NDArray[np.bool_], scales: NDArray[np.float64], gap: int = GAP) -> NDArray[np.bool_]:
    """Which points (B, K) the walk from the middle column reaches inside the disc; see ``GAP``."""
    half = distance.shape[1] // 2
    inside = once & (distance <= scales[:, None])

    def walk(part: NDArray[np.bool_]) -> NDArray[np.bool_]:
        position = np.arange(part.shape[1])
        last = np.maximum.accumulate(np.where(part, position, 0), axis=1)
        return part & ~np.logical_or.accumulate(position - last > gap, axis=1)

    forward = walk(inside[:, half:])
    backward = walk(inside[:, half::-1])[:, ::-1]
    return np.concatenate([backward[:, :-1], forward], axis=1)


def clearance(
    contour: Contour, points: NDArray[np.float64], directions: NDArray[np.float64], reach: ArrayLike, steps: int = 64
) -> NDArray[np.float64]:
    """Distance (B,) from points (B, 2) on the edge along unit directions (B, 2) to the next edge; ``reach`` where there is none.

    The first 1.5 px, in which the ray leaves the edge it starts from, are passed over.
    """
    reach = np.broadcast_to(np.asarray(reach, dtype=float), (len(points),))
    at = 1.5 + np.linspace(0.0, 1.0, steps) * np.maximum(reach - 1.5, 0.5)[:, None]
    material = contour.sample(points[:, None, :] + at[..., None] * directions[:, None, :]) > 0.5
    changed = material != material[:, :1]
    first = np.argmax(changed, axis=1)
    return np.where(changed.any(axis=1), at[np.arange(len(points)), first], reach)


def visible(contour: Contour, sources: NDArray[np.float64], points: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (B, K, 2) are hit first by rays from their source (B, 2), out to ``reach`` (B,) pixels."""
    angles = (np.arange(_RAYS) + 0.5) * (2 * np.pi / _RAYS)
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    radii = np.linspace(0.0, 1.0, _RAY_STEPS) * reach[:, None]
    grid = sources[:, None, None, :] + radii[:, None, :, None] * rays[None, :, None, :]
    material = contour.sample(grid) > 0.5
    changed = material != material[:, :, :1]
    first = np.where(changed.any(axis=2), np.argmax(changed, axis=2), _RAY_STEPS)
    hit = first * (reach / (_RAY_STEPS - 1))[:, None]
    # A ray that grazes an edge may meet it anywhere between its neighbours' hits.
    hit = np.maximum(hit, np.maximum(np.roll(hit, 1, axis=1), np.roll(hit, -1, axis=1)))
    offset = points - sources[:, None, :]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    column = ((np.arctan2(offset[..., 1], offset[..., 0]) % (2 * np.pi)) * (_RAYS / (2 * np.pi))).astype(int) % _RAYS
    slack = 2.0 + (reach / (_RAY_STEPS - 1))[:, None]
    return distance <= np.take_along_axis(hit, column, axis=1) + slack


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
    order = np.argsort(scales)
    if len(order) > 4 and scales[order[-1]] > 3 * scales[order[0]]:
        # Small and large scales apart: neither needs the other's reach or the other's density.
        a, normal, extent = np.empty(len(scales)), np.empty((len(scales), 2)), np.empty(len(scales))
        for part in np.array_split(order, 2):
            a[part], normal[part], extent[part] = measure(contour, indices[part], scales[part], concave, suppress)
        return a, normal, extent
    # Any arc that stays within s and can be taken for one edge is shorter than a full circle of radius s.
    stride = max(1, int(scales.min() / DENSITY))
    half = int(np.ceil(min(np.pi * float(scales.max()), float(contour.lengths.max())) / stride)) + 1
    gap = max(1, GAP // stride)
    window, once = contour.window(indices, half, stride)
    points, normals = contour.points[window], contour.normals[window]
    centres = contour.points[indices]
    distance = np.hypot(*(points - centres[:, None, :]).transpose(2, 0, 1))
    use = connected(distance, once, scales, gap)
    a, normal = fit(points, normals, use, centres, scales)
    extent = _extent(distance, use)
    if not suppress:
        return a, normal, extent
    curvature = arc_curvature(np.nan_to_num(a), extent)
    agrees = np.ones(len(a), bool) if concave is None else (curvature < 0) == concave
    outside = curvature < 0 if concave is None else np.full(len(a), concave)
    direction = np.where(outside[:, None], normal, -normal)
    delta = np.where(agrees, 0.5 / np.maximum(np.abs(curvature), 1e-9), NEAR)
    delta = np.minimum(delta, 0.5 * scales)
    free = clearance(contour, centres, direction, 2 * delta + 3.0)
    delta = np.maximum(np.minimum(delta, 0.5 * free), 1.0)
    sources = centres + delta[:, None] * direction
    seen = visible(contour, sources, points, scales + delta)
    seen[:, half] = True
    second = use & seen
    # Suppression may open gaps: what lies behind one is another edge.
    second = connected(np.where(second, distance, np.inf), once, scales, gap)
    enough = second.sum(axis=1) >= np.maximum(5, 0.25 * use.sum(axis=1))
    second = np.where(enough[:, None], second, use)
    return *fit(points, normals, second, centres, scales), _extent(distance, second)


def _extent(distance: NDArray[np.float64], use: NDArray[np.bool_]) -> NDArray[np.float64]:
    """How far (B,) the used points reach; unequal sides are joined as they weigh in the fit, with the fifth power."""
    half = distance.shape[1] // 2
    reached = np.where(use, distance, 0.0)
    sides = np.stack([reached[:, : half + 1].max(axis=1), reached[:, half:].max(axis=1)])
    return np.maximum(np.mean(sides**5, axis=0) ** 0.2, 1e-6)


def curvature_map(contour: Contour, indices: NDArray[np.int64], scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Signed curvature (B,) 1/px and normals (B, 2) at many contour points and one scale, without suppression."""
    half = int(np.ceil(min(np.pi * scale, float(contour.lengths.max())))) + 1
    window, once = contour.window(indices, half)
    # 32 points a side tell as much as all of them.
    columns = half + np.unique(np.rint(np.linspace(-half, half, 65)).astype(int))
    window, once = window[:, columns], once[:, columns]
    points, centres = contour.points[window], contour.points[indices]
    distance = np.hypot(points[..., 0] - centres[:, :1], points[..., 1] - centres[:, 1:])
    use = connected(distance, once, np.full(len(indices), float(scale)), 0)
    a, normal = fit(points, contour.normals[window], use, centres, np.full(len(indices), float(scale)))
    return arc_curvature(np.nan_to_num(a), _extent(distance, use)), normal


def _search(contour: Contour, indices: NDArray[np.int64], normals: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.int64]:
    """Convexity matching's step: the nearest edge along the normal line, either way; the old point where there is none."""
    points = contour.points[indices]
    result = indices.copy()
    best = np.full(len(indices), np.inf)
    for sign in (1.0, -1.0):
        distance = clearance(contour, points, sign * normals, reach)
        there = (distance < reach - 1e-6) & (distance < best)
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


def explained(contour: Contour, index: int, normal: NDArray[np.float64], scales: NDArray[np.float64]) -> tuple[float, float] | None:
    """Signed curvature (1/px, positive: convex) at the largest of ``scales`` at which a circle or a conic explains the edge,
    and that scale; ``None`` where there is none.  ``normal`` (2,) is the contact's, outward."""
    scales = np.sort(scales[scales >= EXPLAINED_FLOOR])
    if not len(scales):
        return None
    half = int(np.ceil(min(np.pi * float(scales[-1]), float(contour.lengths.max())))) + 1
    window, once = contour.window(np.array([index]), half)
    local = contour.points[window[0]] - contour.points[index]
    distance = np.hypot(*local.T)
    use = connected(np.broadcast_to(distance, (len(scales), len(distance))), np.broadcast_to(once, (len(scales), len(distance))), scales)
    tangent = np.array([-normal[1], normal[0]])
    curve: tuple[float, float] | None = None
    for scale, part in zip(scales[::-1], use[::-1], strict=True):
        if curve is not None and scale < curve[1] / FAR:
            break
        sides = part[:half].sum(), part[half + 1 :].sum()
        if min(sides) < 0.5 * scale:  # the edge ends within the scale
            continue
        x, y = local[part] @ tangent / scale, -(local[part] @ normal) / scale
        one = np.ones(len(x))
        for columns in ((x * x + y * y, x, one), (x * x, y * y, x * y, x, one)):
            if len(columns) > 3 and curve is not None:
                break
            basis = np.column_stack(columns)
            fitted = np.linalg.solve(basis.T @ basis + 1e-7 * len(x) * np.eye(len(columns)), basis.T @ y)
            if scale * float(np.sqrt(np.mean((y - basis @ fitted) ** 2))) > RESIDUE:
                continue
            if len(columns) == 3:
                return _bend(fitted[0], fitted[0], 0.0, *fitted[1:]) / scale, float(scale)
            bend = _bend(*fitted)
            if abs(bend) <= ALPHA:  # else it is a corner's arms that look like a hyperbola
                curve = bend / scale, float(scale)
        if curve is not None and curve[1] == scales[-1]:  # all there is to see
            break
    return curve


def estimate(
    contour: Contour,
    index: int,
    concave: bool | None = None,
    scales: NDArray[np.float64] | None = None,
    two_step: bool = True,
) -> Estimate:
    """Curvature at the contour point ``index`` and its motion functional scale.

    With ``concave`` given (the reference's sign) a point of the other sign is moved by
    the convexity search, scale by scale, and only scales with that sign are accepted,
    if there is one.  Raises ``NO_CURVATURE`` where no scale has enough points.
    """
    scales = pyramid(contour.size) if scales is None else np.asarray(scales, dtype=float)
    indices = np.full(len(scales), int(index))
    a, normal, extent = measure(contour, indices, scales, concave, suppress=two_step)
    if concave is not None and two_step:
        wrong = np.isfinite(a) & ((a < 0) != concave)
        if wrong.any() and not (np.isfinite(a) & ~wrong).any():
            moved = indices.copy()
            moved[wrong] = _search(contour, indices[wrong], normal[wrong], np.maximum(scales[wrong], 2 * NEAR))
            retry = np.nonzero(moved != indices)[0]
            if len(retry):
                a2, normal2, extent2 = measure(contour, moved[retry], scales[retry], concave)
                better = np.isfinite(a2) & ((a2 < 0) == concave)
                accepted = retry[better]
                indices[accepted], a[accepted] = moved[accepted], a2[better]
                normal[accepted], extent[accepted] = normal2[better], extent2[better]
    with np.errstate(invalid="ignore"):
        value = extent * 2 * np.abs(a)
    usable = np.isfinite(value)
    if concave is not None and (usable & ((a < 0) == concave)).any():
        usable &= (a < 0) == concave
    if not usable.any():
        raise MagicError(
            Code.NO_CURVATURE, "contour points around the contact", int(contour.lengths[contour.loop[index]]), "at least 5 on its edge"
        )
    curvature = arc_curvature(np.nan_to_num(a), extent)
    best, share = _functional_scale(value, usable, (a < 0), indices)
    scale, signed = float(scales[best]), float(curvature[best])
    direction = normal[best]
    if share > 0:  # between the scale before and this one
        scale = float(scales[best - 1] ** share * scales[best] ** (1 - share))
        signed = float(curvature[best - 1] * share + curvature[best] * (1 - share))
        direction = normal[best - 1] * share + normal[best] * (1 - share)
        direction = direction / max(float(np.hypot(*direction)), 1e-9)
    exact = explained(contour, int(indices[best]), direction, scales[scales <= scale * (1 + 1e-9)]) if two_step else None
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
