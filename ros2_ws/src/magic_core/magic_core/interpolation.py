"""What a controller commands between the points of a trajectory.

ros2_control's joint trajectory controller joins points that have positions, velocities and accelerations by polynomials of the fifth
degree (its "splines"), and commands these at its own rate.  It is that course, not the points, that an arm's limits hold for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Places in each step at which velocity and acceleration are looked at, its ends included.
PLACES = 9


def extremes(times: Array, positions: Array, velocities: Array, accelerations: Array) -> tuple[Array, Array, Array]:
    """The largest velocity, acceleration and jerk, without sign, of each joint in each step: three of (N - 1, J).

    times (N,) s, rising; the others (N, J).  The jerk is exact; velocity and acceleration are those at ``PLACES`` places.
    """
    h = np.diff(times)[:, None]
    p, v, a = positions[:-1], velocities[:-1], accelerations[:-1]
    # What constant acceleration leaves over at the end of the step, as coefficients of (t / h)^3, ^4 and ^5.
    d = positions[1:] - p - h * v - h**2 * a / 2
    e = (velocities[1:] - v - h * a) * h
    f = (accelerations[1:] - a) * h**2
    c3, c4, c5 = 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2
    fastest, strongest = np.abs(velocities[1:]), np.abs(accelerations[1:])
    for x in np.linspace(0.0, 1.0, PLACES)[:-1]:
        fastest = np.maximum(fastest, np.abs(v + h * x * a + (3 * c3 * x**2 + 4 * c4 * x**3 + 5 * c5 * x**4) / h))
        strongest = np.maximum(strongest, np.abs(a + (6 * c3 * x + 12 * c4 * x**2 + 20 * c5 * x**3) / h**2))
    jerks = [6 * c3 + 24 * c4 * x + 60 * c5 * x**2 for x in (0.0, 1.0)]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = -c4 / (5 * c5)  # where the jerk itself turns
    inside = (turn > 0) & (turn < 1)
    turn = np.where(inside, turn, 0.0)
    jerks.append(6 * c3 + 24 * c4 * turn + 60 * c5 * turn**2)
    return fastest, strongest, np.max(np.abs(jerks), axis=0) / h**3
