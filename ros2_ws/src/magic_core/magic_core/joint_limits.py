"""What the makers of arms publish for their joints.

Franka: "Control Interface Specification and Robot Limits" (https://frankarobotics.github.io/docs/robot_specifications.html), joint
space limits of the Franka Emika Robot (Panda) and of the Franka Research 3: a command beyond any of them aborts the motion.
Universal Robots: user manual of the UR5e for positions and velocities, "Max. joint torques" for the rest.  It publishes no
accelerations and no jerks; 180 degrees/s^2 is what its own ROS 2 description (ur_description, config/ur5e/joint_limits.yaml) puts in
their place, and the jerk here stands in the same ratio to it as Franka's: both are this project's choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JointLimits:
    """Limits of the joints from the base to the hand, each (J,): lower, upper rad; velocity rad/s; acceleration rad/s^2; jerk rad/s^3."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]
    braking: Braking | None = None


@dataclass(frozen=True)
class Braking:
    """How fast a joint may still go towards the end of its range, all (J,): ends (lower and upper),
    rad; deceleration, rad/s^2; offset, rad/s:

    at most sqrt(2 deceleration (end - q)) - offset, and not below 0.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    deceleration: tuple[float, ...]
    offset: tuple[float, ...]

    def velocities(self, q: Array) -> tuple[Array, Array]:
        """Lowest and highest velocities (N, J), rad/s, at positions q (N, J)."""
        twice, offset = 2 * np.array(self.deceleration), np.array(self.offset)
        ways = (np.asarray(q) - self.lower, self.upper - np.asarray(q))
        low, high = (np.maximum(0.0, np.sqrt(np.maximum(0.0, twice * way)) - offset) for way in ways)
        return -low, high


_HALF, _TURN = (math.pi,), (2 * math.pi,)

#: By the name of the preset (:mod:`magic_core.presets`).
PUBLISHED = {
    "panda": JointLimits(
        lower=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
        upper=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
        velocity=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
        acceleration=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
        jerk=(7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0),
    ),
    "fr3": JointLimits(
        lower=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
        upper=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
        velocity=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
        acceleration=(10.0,) * 7,
        jerk=(5000.0,) * 7,
        braking=Braking(
            lower=(-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196),
            upper=(2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196),
            deceleration=(6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0),
            offset=(0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35),
        ),
    ),
    "ur5e": JointLimits(
        lower=tuple(-limit for limit in (*_TURN * 2, *_HALF, *_TURN * 3)),
        upper=(*_TURN * 2, *_HALF, *_TURN * 3),
        velocity=_HALF * 6,
        acceleration=_HALF * 6,
        jerk=(500 * math.pi,) * 6,
    ),
}
