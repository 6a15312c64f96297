"""A scene that hands can be put to by fixed joint positions."""

from functools import lru_cache

import numpy as np

from magic_core import transforms
from magic_core.robot import PANDA_HOME, Description
from magic_core.shapes import make
from magic_lab.scenarios import SCENARIOS, TARGET, Scene, draw
from magic_lab.world import Thing

HOME = np.array(PANDA_HOME)
#: The Panda with its hand straight down, 0.1 m above the table before it, and as far down as its fingertips are round a block there.
ABOVE = [0.0, 0.3474, 0.0, -2.2196, 0.0, 2.567, 0.7854]


@lru_cache
def robot():
    return Description()


@lru_cache
def empty():
    """A scene with a block under the hand as its tool, and a cylinder far away."""
    drawn = draw(SCENARIOS["hooking"], SCENARIOS["hooking"].cases[0], 0)
    tcp = robot().forward(np.array([ABOVE]))[0]
    x, y = tcp[:2, 3]
    turn = transforms.from_rpy(0, 0, np.arctan2(tcp[1, 1], tcp[0, 1]) - np.pi / 2)
    block = make("cylinder", 1, radius=0.015, half_height=0.05).as_object("tool_1", transforms.make(turn[:3, :3], [x, y, 0.05]))
    away = drawn.thing(TARGET)
    return Scene(drawn.scenario, drawn.case, 0, drawn.strategy, (Thing(block), away), (), ("tool_1",), TARGET, 0.4, 1.2)


def lowered(height):
    """Joints that bring the hand of ABOVE down to where its tip is so high, by a few Newton steps on its forward kinematics."""
    q = np.array(ABOVE)
    for _ in range(20):
        here = robot().forward(q[None])[0]
        jacobian = np.zeros((6, 7))
        for k in range(7):
            off = q.copy()
            off[k] += 1e-6
            step = robot().forward(off[None])[0] @ transforms.inverse(here)
            jacobian[:3, k] = (transforms.apply(step, here[:3, 3]) - here[:3, 3]) / 1e-6
            jacobian[3:, k] = np.array([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]]) / 2e-6
        q = q + np.linalg.pinv(jacobian) @ np.array([0, 0, height - here[2, 3], 0, 0, 0])
    return q
