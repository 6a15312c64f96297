"""The course that a controller makes of points, against polynomials whose derivatives are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from magic_core.interpolation import extremes


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.floats(0.05, 2.0), st.integers(2, 6))
@settings(max_examples=60, deadline=None)
def test_a_polynomial_of_the_fifth_degree_is_found_again(coefficients, length, count):
    course = Polynomial(coefficients)
    times = np.linspace(0.0, length, count)
    columns = [course.deriv(n)(times)[:, None] if n else course(times)[:, None] for n in range(3)]
    found = extremes(times, *columns)
    for values, order in zip(found, (1, 2, 3)):
        assert values.shape == (count - 1, 1)
        for i in range(count - 1):
            true = np.abs(course.deriv(order)(np.linspace(times[i], times[i + 1], 400))).max()
            # The largest of 400 places falls short of the largest there is by some 1e-5 of it.
            assert values[i, 0] <= true * (1 + 1e-4) + 1e-5 * (1 + 1 / length**3)
            assert values[i, 0] >= true * 0.9 - 1e-5


def test_a_jump_of_the_acceleration_between_two_points_is_a_jerk():
    """From rest to 1 rad/s^2 within one step of 10 ms: the jerk of a smooth course is 100 rad/s^3 at least."""
    times = np.array([0.0, 0.01])
    _, strong, sharp = extremes(times, np.zeros((2, 1)), np.zeros((2, 1)), np.array([[0.0], [1.0]]))
    assert sharp[0, 0] >= 100.0
    assert strong[0, 0] == pytest.approx(1.0)
