"""Timing: the path is kept, the limits too, and nothing begins or ends with a jerk."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from magic_core import interpolation
from magic_core.joint_limits import PUBLISHED
from magic_planner import timing
from magic_planner.timing import Infeasible, Limits, Track, knots, parameterise

STEP = 0.02
ONE = Limits(np.array([0.5]), np.array([2.0]), np.array([40.0]))
PANDA = Limits(
    *(np.array(getattr(PUBLISHED["panda"], name)) * share for name, share in (("velocity", 0.3), ("acceleration", 0.2), ("jerk", 0.03)))
)


def test_a_straight_move_of_one_joint_takes_what_the_textbook_says():
    """Trapezoidal velocity of 0.95 of the limits, averaged over the time in which the jerk limit builds up the acceleration."""
    times, q, qd, _ = parameterise(np.array([[0.0], [1.0]]), ONE, STEP)
    v, a = 0.95 * 0.5, 0.95 * 2.0
    assert times[-1] == pytest.approx(1.0 / v + v / a + a / 40.0, rel=0.01)
    assert qd.max() == pytest.approx(v, rel=1e-3)
    assert (q[0, 0], q[-1, 0]) == pytest.approx((0.0, 1.0))
    assert abs(q[len(q) // 2, 0] - 0.5) < v * STEP


paths = st.lists(st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7), min_size=2, max_size=5).map(np.array)


@given(paths, st.booleans())
@settings(max_examples=25, deadline=None)
def test_any_path_is_kept_within_velocity_acceleration_and_jerk(path, corners):
    times, q, qd, qdd = parameterise(path, PANDA, STEP, corners)
    np.testing.assert_allclose([q[0], q[-1]], [path[0], path[-1]], atol=1e-9)
    if len(times) < 2:
        return
    for ends in (qd, qdd):
        assert not ends[[0, -1]].any()
    # The path itself: every point lies on the spline through its knots.
    at, points = knots(path, corners)
    dense = CubicSpline(at, points)(np.linspace(at[0], at[-1], 4000))
    spacing = np.linalg.norm(np.diff(dense, axis=0), axis=1).max()
    assert max(np.linalg.norm(dense - row, axis=1).min() for row in q) <= spacing
    fast, strong, sharp = interpolation.extremes(times, q, qd, qdd)
    assert np.all(fast <= PANDA.velocity * 1.01)
    assert np.all(strong <= PANDA.acceleration * 1.1)
    assert np.all(sharp <= PANDA.jerk * 2.5)  # 7.5 % of the published one: steps of 20 ms round its corners
    # Positions, velocities and accelerations are those of one motion.
    middle = (
        np.diff(q, axis=0) - np.diff(times)[:, None] * (qd[1:] + qd[:-1]) / 2 + np.diff(times)[:, None] ** 2 * np.diff(qdd, axis=0) / 12
    )
    assert np.abs(middle).max() < 2e-4


def test_near_the_end_of_its_range_a_joint_goes_as_slowly_as_its_maker_says():
    braking = PUBLISHED["fr3"].braking
    start = np.array([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8])
    goal = start.copy()
    goal[1] = 1.7637  # 20 mrad before its limit
    wide = [np.array(getattr(PUBLISHED["fr3"], name)) for name in ("velocity", "acceleration", "jerk")]
    for at, kept in ((None, False), (braking.velocities, True)):
        _, q, qd, _ = parameterise(np.stack([start, goal]), Limits(*wide, at), STEP)
        low, high = braking.velocities(q)
        assert np.all((low - 1e-6 <= qd) & (qd <= high + 1e-6)) == kept
    beyond = goal.copy()
    beyond[1] = 1.79
    with pytest.raises(Infeasible):
        parameterise(np.stack([start, beyond]), Limits(*wide, braking.velocities), STEP)


def test_the_tools_own_clock_is_never_outrun():
    clock = np.linspace(0.0, 2.0, 60)
    rows = np.outer(0.05 * (1 - np.cos(np.pi * clock / 2)), np.ones(7))  # much slower than the arm can
    track = Track(7)
    track.append((np.zeros(1), rows[:1], rows[:1] * 0, rows[:1] * 0))
    passed = track.follow(clock, rows, [0, len(clock) - 1], PANDA, STEP)
    real = np.array([passed(t) for t in clock])
    assert np.all(np.diff(real) >= np.diff(clock) * 0.999)
    assert real[-1] == pytest.approx(2.0, abs=0.4)  # it has to be got up to speed, and stopped


def test_a_path_that_goes_nowhere_takes_no_time():
    times, q, _, _ = timing.parameterise(np.zeros((3, 7)), PANDA, STEP)
    assert list(times) == [0.0] and q.shape == (1, 7)
