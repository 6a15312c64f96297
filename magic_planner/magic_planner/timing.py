"""When: velocities and accelerations for joint paths (TOPP-RA), and the tool's own clock kept where the joints allow."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
#: TOPP-RA holds its limits at grid points; this share is kept for what lies between.
SHARE = 0.95


class Infeasible(Exception):
    """No timing within the limits was found."""


def _toppra(knots: Array, rows: Array, velocity: Array, acceleration: Array, step: float) -> tuple[Array, Array, Array, Array]:
    """Time-optimal rest-to-rest timing of the spline through rows (n, D) at knots (n,): times, positions, velocities, accelerations."""
    import toppra
    import toppra.algorithm as algorithm
    import toppra.constraint as constraint

    # Not toppra.setup_logging: each call of that adds one more handler to the library's logger.
    logging.getLogger("toppra").setLevel(logging.ERROR)
    try:
        path = toppra.SplineInterpolator(knots, rows)
        # 0.1 % more than twice the number of knots: the limits are held between them as well.
        grid = np.linspace(knots[0], knots[-1], int(np.clip(3 * len(knots), 40, 250)))
        instance = algorithm.TOPPRA(
            [constraint.JointVelocityConstraint(velocity * SHARE), constraint.JointAccelerationConstraint(acceleration * SHARE)],
            path,
            gridpoints=grid,
            parametrizer="ParametrizeConstAccel",
        )
        trajectory = instance.compute_trajectory()
    except (RuntimeError, ValueError, ArithmeticError) as error:
        raise Infeasible(f"{type(error).__name__}: {error}") from error
    if trajectory is None or not np.isfinite(trajectory.duration):
        raise Infeasible("TOPP-RA found no solution")
    count = max(2, int(np.ceil(trajectory.duration / step)) + 1)
    times = np.linspace(0.0, trajectory.duration, count)
    q, qd, qdd = trajectory(times), trajectory(times, 1), trajectory(times, 2)
    if not (np.all(np.isfinite(q)) and np.all(np.isfinite(qd)) and np.all(np.isfinite(qdd))):
        raise Infeasible("TOPP-RA's solution is not finite")
    qd[0] = qd[-1] = 0.0
    return times, q, qd, qdd


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


def parameterise(
    path: Array, velocity: Array, acceleration: Array, step: float, corners: bool = False
) -> tuple[Array, Array, Array, Array]:
    """Time a joint path (n, J) of straight pieces, at rest at both ends: times (m,), positions, velocities, accelerations (m, J)."""
    at, points = knots(path, corners)
    if len(points) < 2:
        return np.zeros(1), points, np.zeros_like(points), np.zeros_like(points)
    return _toppra(at, points, velocity, acceleration, step)


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

    def follow(
        self, clock: Array, q: Array, rests: Sequence[int], velocity: Array, acceleration: Array, step: float
    ) -> Callable[[float], float]:
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
                # The tool's clock is one more joint, of speed 1 at most: that is how its own speeds are kept.
                if len(rows) < 4:
                    fine = np.linspace(times[0], times[-1], 6)
                    rows, times = np.stack([np.interp(fine, times, rows[:, j]) for j in range(rows.shape[1])], axis=1), fine
                both = np.column_stack([rows, times])
                limits = np.append(velocity, 1.0 / SHARE), np.append(acceleration, 20.0)
                at, positions, speeds, pulls = _toppra(times, both, *limits, step)
                known += positions[1:, -1].tolist()
                real += (self.now - began + at[1:]).tolist()
                self.append((at, positions[:, :-1], speeds[:, :-1], pulls[:, :-1]))
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
