"""When: velocities, accelerations and jerks for joint paths, and the tool's own clock kept where the joints allow.

TOPP-RA gives the fastest law s(t) of the path parameter within the velocity and acceleration limits.  Its acceleration jumps, so the
law is averaged over a window of T seconds,

    s_T(t) = 1/T  integral of s over [t - T, t],

which keeps the path to the bit, ends T later, begins and ends at rest with no acceleration, and has the jerk (s''(t) - s''(t - T)) / T.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

Array = NDArray[np.float64]
#: TOPP-RA holds its limits at grid points; this share is kept for what lies between.
SHARE = 0.95
#: How often the window is widened before the whole motion is slowed down instead.
WIDENINGS = 4
#: A motion that had to be slowed down by more is at a place where the arm may not move at all.
SLOWEST = 10.0
#: Each step of the result is looked at in so many parts.
PARTS = 4


class Infeasible(Exception):
    """No timing within the limits was found."""


@dataclass(frozen=True)
class Limits:
    """velocity, acceleration, jerk: (J,) rad/s, rad/s^2, rad/s^3 (m where a joint slides), the same in both directions.

    at: lowest and highest velocities (N, J) at positions (N, J), for an arm that may go less fast near the ends of its joints.
    """

    velocity: Array
    acceleration: Array
    jerk: Array
    at: Callable[[Array], tuple[Array, Array]] | None = None

    def slower(self, share: float) -> Limits:
        """The same with this share of the velocities."""
        at = self.at
        if at is None:
            return replace(self, velocity=self.velocity * share)
        return replace(self, velocity=self.velocity * share, at=lambda q: (at(q)[0] * share, at(q)[1] * share))

    def excess(self, q: Array, qd: Array, qdd: Array, qddd: Array) -> tuple[float, float, float]:
        """By which factor velocities, accelerations and jerks (N, J) at positions q go beyond the limits; below 1: not."""
        fastest = np.abs(qd) / self.velocity
        if self.at is not None:
            low, high = self.at(q)
            fastest = np.maximum(fastest, np.where(qd > 0, qd / np.maximum(high, 1e-9), qd / np.minimum(low, -1e-9)))
        return float(fastest.max()), float((np.abs(qdd) / self.acceleration).max()), float((np.abs(qddd) / self.jerk).max())


class _Law:
    """s(t), at rest at both ends: speeds (n,) at path parameters (n,), between which the acceleration is constant; see :meth:`averaged`."""

    def __init__(self, at: Array, speeds: Array) -> None:
        steps = 2 * np.diff(at) / (speeds[1:] + speeds[:-1])
        if not np.all(np.isfinite(steps)):
            raise Infeasible("TOPP-RA's solution stands still on the way")
        self._start, self._end = float(at[0]), float(at[-1])
        times = np.concatenate([[0.0], np.cumsum(steps)])
        self.duration = float(times[-1])
        #: The strongest acceleration of the path parameter, by the place where it is.
        self.at, self.pull = at[:-1], np.abs(np.diff(speeds)) / steps
        # Before and after it stands: two pieces of no speed, as long as any window.
        margin = self.duration + 1.0
        knots = np.concatenate([[-margin], times, [self.duration + margin]])
        speeds = np.concatenate([[0.0], speeds, [0.0]])
        slopes = np.diff(speeds) / np.diff(knots)
        self._speed = PPoly(np.stack([slopes, speeds[:-1]]), knots)
        self._way = self._speed.antiderivative()
        self._area = self._way.antiderivative()

    def averaged(self, window: float, times: Array) -> tuple[Array, Array, Array, Array]:
        """s_T with T = window, in [0, duration + T], and its three derivatives at times (N,)."""
        ends = [piece(times) - piece(times - window) for piece in (self._area, self._way, self._speed, self._speed.derivative())]
        way, *derivatives = (end / window for end in ends)
        return np.clip(self._start + way, self._start, self._end), *derivatives


def _grid(knots: Array) -> Array:
    """Path parameters (m,) at which TOPP-RA holds the limits: each knot, where a spline bends most sharply, and places between."""
    parts = max(1, int(np.ceil(40 / (len(knots) - 1))), min(3, 250 // len(knots)))
    return np.interp(np.arange(parts * (len(knots) - 1) + 1) / parts, np.arange(len(knots)), knots)


def _timed(knots: Array, rows: Array, limits: Limits, step: float, clocked: bool = False) -> tuple[Array, Array, Array, Array, Array]:
    """Rest-to-rest timing of the spline through rows (n, J) at knots (n,): times, positions, velocities, accelerations, path parameters.

    clocked: the knots are the tool's clock, which never goes faster than time.
    """
    import toppra
    import toppra.algorithm as algorithm
    import toppra.constraint as constraint

    # Not toppra.setup_logging: each call of that adds one more handler to the library's logger.
    logging.getLogger("toppra").setLevel(logging.ERROR)
    columns = np.column_stack([rows, knots]) if clocked else rows
    velocity, acceleration = limits.velocity * SHARE, limits.acceleration * SHARE
    if clocked:
        velocity, acceleration = np.append(velocity, 1.0), np.append(acceleration, 20.0)
    spline = CubicSpline(knots, rows)
    grid = _grid(knots)
    constraints = [constraint.JointVelocityConstraint(velocity), constraint.JointAccelerationConstraint(acceleration)]
    if limits.at is not None:
        low, high = limits.at(spline(grid))
        bounds = np.stack([low, high], axis=2) * SHARE
        if clocked:
            bounds = np.concatenate([bounds, np.tile([[[-1.0, 1.0]]], (len(grid), 1, 1))], axis=1)
        # It is asked at the grid's points, and once before at 0.
        constraints.append(constraint.JointVelocityConstraintVarying(lambda s: bounds[int(np.abs(grid - s).argmin())]))
    try:
        instance = algorithm.TOPPRA(constraints, toppra.SplineInterpolator(knots, columns), gridpoints=grid)
        _, speeds, _ = instance.compute_parameterization(0.0, 0.0)
    except (RuntimeError, ValueError, ArithmeticError) as error:
        raise Infeasible(f"{type(error).__name__}: {error}") from error
    if speeds is None or not np.all(np.isfinite(speeds)):
        raise Infeasible("TOPP-RA found no solution")
    law = _Law(grid, np.asarray(speeds, dtype=float))
    slopes = [spline.derivative(n) for n in (1, 2, 3)]
    # The shortest window for an acceleration that begins or ends; where one turns into its opposite it is widened to twice that.
    window = max(float((law.pull[:, None] * np.abs(slopes[0](law.at)) / limits.jerk).max()), step / PARTS)
    for _ in range(WIDENINGS):
        count = max(2, int(np.ceil((law.duration + window) / step)) + 1)
        times = np.linspace(0.0, law.duration + window, PARTS * (count - 1) + 1)
        s, speed, pull, jerk = law.averaged(window, times)
        d1, d2, d3 = (slope(s) for slope in slopes)
        speed, pull, jerk = speed[:, None], pull[:, None], jerk[:, None]
        q, qd, qdd = spline(s), d1 * speed, d1 * pull + d2 * speed**2
        fast, strong, sharp = limits.excess(q, qd, qdd, d1 * jerk + 3 * d2 * speed * pull + d3 * speed**3)
        by_law = limits.excess(q, qd, qdd, d1 * jerk)[2]
        if by_law <= 1.0:
            break
        window *= 1.05 * by_law
    # An average of what keeps the limits at each place may exceed them a little at another: slower as a whole.
    slower = max(1.0, fast, np.sqrt(strong), np.cbrt(sharp))
    if not slower <= SLOWEST:
        raise Infeasible(f"TOPP-RA's solution had to be {slower:.3g} times slower (up to {SLOWEST:g})")
    qd[0] = qd[-1] = qdd[0] = qdd[-1] = 0.0
    return times[::PARTS] * slower, q[::PARTS], qd[::PARTS] / slower, qdd[::PARTS] / slower**2, s[::PARTS]


def knots(path: Array, corners: bool = False) -> tuple[Array, Array]:
    """Knots (m,) and points (m, J) of the spline that is laid through a joint path (n, J); no more than one where nothing moves.

    Straight pieces are cut finer before, so that the spline stays near them; ``corners``: as fine as a path with sharp
    corners wants it, about which a spline swings out.
    """
    keep = np.concatenate([[True], np.abs(np.diff(path, axis=0)).max(axis=1) > 1e-7])
    path = path[keep]
    rows = [path[:1]]
    for a, b in itertools.pairwise(path):
        parts = max(4 if corners or len(path) <= 6 else 1, int(np.ceil(np.abs(b - a).max() / (0.08 if corners else 0.15))))
        rows.append(a + (b - a) * np.linspace(0, 1, parts + 1)[1:, None])
    points = np.concatenate(rows)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]), points


def swept(path: Array, step: float) -> Array:
    """Joint positions (m, J), at most ``step`` rad apart, that a free motion along a path (n, J) with corners will pass."""
    at, points = knots(path, corners=True)
    if len(points) < 2:
        return points
    spline = CubicSpline(at, points)
    return np.asarray(spline(np.linspace(at[0], at[-1], int(np.ceil(at[-1] / step)) + 1)))


def parameterise(path: Array, limits: Limits, step: float, corners: bool = False) -> tuple[Array, Array, Array, Array]:
    """Time a joint path (n, J) of straight pieces, at rest at both ends: times (m,), positions, velocities, accelerations (m, J).

    Steps are ``step`` s or, where the motion has to be slowed down at the end, a little more.
    """
    at, points = knots(path, corners)
    if len(points) < 2:
        return np.zeros(1), points, np.zeros_like(points), np.zeros_like(points)
    return _timed(at, points, limits, step)[:4]


class Track:
    """A joint trajectory that grows piece by piece, each at rest where it meets the next."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.now = 0.0
        self._times: list[Array] = []
        self._rows: list[tuple[Array, Array, Array]] = []

    def append(self, piece: tuple[Array, Array, Array, Array]) -> None:
        """Add a piece whose times start at 0; its first sample replaces the last one there is."""
        times, q, qd, qdd = piece
        first = 1 if self._times else 0
        if len(times) > first:
            self._times.append(self.now + times[first:])
            self._rows.append((q[first:], qd[first:], qdd[first:]))
        self.now += float(times[-1])

    def hold(self, seconds: float, step: float) -> None:
        """Stand still."""
        count = max(2, int(np.ceil(seconds / step)) + 1)
        q = np.repeat(self._rows[-1][0][-1:], count, axis=0)
        self.append((np.linspace(0, seconds, count), q, np.zeros_like(q), np.zeros_like(q)))

    def follow(self, clock: Array, q: Array, rests: Sequence[int], limits: Limits, step: float) -> Callable[[float], float]:
        """Add a path q (T, J) that the tool passes at times ``clock`` (T,), never faster than that.

        rests: indices, first and last among them, at which the tool stands still.  Returns the function from the
        tool's clock to seconds since this call.
        """
        began = self.now
        known, real = [float(clock[0])], [0.0]
        for a, b in itertools.pairwise(rests):
            rows, times = q[a : b + 1], clock[a : b + 1]
            if np.abs(rows - rows[0]).max() < 1e-7:
                self.hold(float(times[-1] - times[0]), step)
            else:
                if len(rows) < 4:
                    fine = np.linspace(times[0], times[-1], 6)
                    rows, times = np.stack([np.interp(fine, times, rows[:, j]) for j in range(rows.shape[1])], axis=1), fine
                # The tool's clock is the path parameter and goes no faster than time: that is how its own speeds are kept.
                at, positions, speeds, pulls, passed = _timed(times, rows, limits, step, clocked=True)
                known += passed[1:].tolist()
                real += (self.now - began + at[1:]).tolist()
                self.append((at, positions, speeds, pulls))
            known.append(float(clock[b]))
            real.append(self.now - began)
        order = np.maximum.accumulate(np.array(known))
        return lambda when: float(np.interp(when, order, np.array(real)))

    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Times (N,), positions, velocities, accelerations (N, J)."""
        times = np.concatenate(self._times)
        q, qd, qdd = (np.concatenate([rows[i] for rows in self._rows]) for i in range(3))
        keep = np.concatenate([[True], np.diff(times) > 1e-6])
        return times[keep], q[keep], qd[keep], qdd[keep]
