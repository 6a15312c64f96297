"""What a tool weighs by the arm's torques: against the energy of the links, and drawn errors of sensors and URDF."""

import copy

import numpy as np
import pytest

from magic_core import transforms
from magic_core.errors import MagicError
from magic_core.robot import Description
from magic_server.weighing import Reading, Weight, load_torques, own_torques, weighed

ROBOT = Description()
RNG = np.random.default_rng(3)
POSES = [ROBOT.config.home + RNG.uniform(-0.4, 0.4, 7) for _ in range(5)]


def at(q):
    return ROBOT.arm_positions(np.append(q, [0.04, 0.04]))


def energy(q, load=0.0, centre=np.zeros(3)):
    """Potential energy of links and load, J."""
    poses = ROBOT.poses(at(q))
    links = sum(mass * transforms.apply(poses[link], middle[None])[0, 2] for link, (mass, middle) in ROBOT.masses.items())
    return 9.81 * (links + load * transforms.apply(poses["panda_hand_tcp"], centre[None])[0, 2])


def slope(of, q):
    step = 1e-5 * np.eye(7)
    return np.array([(of(q + d) - of(q - d)) / 2e-5 for d in step])


@pytest.mark.parametrize("q", POSES)
def test_joints_bear_what_raising_links_and_load_takes(q):
    centre = np.array([0.03, -0.02, 0.08])
    np.testing.assert_allclose(own_torques(ROBOT, at(q)), slope(energy, q), atol=1e-5)
    np.testing.assert_allclose(load_torques(ROBOT, at(q), centre), slope(lambda q: energy(q, 1.0, centre) - energy(q), q), atol=1e-5)


def jacobian(q):
    return np.stack([slope(lambda q, axis=axis: ROBOT.forward(q)[0, axis, 3], q) for axis in range(3)])


LOW = np.array(ROBOT.config.home) + [0.1, 0.3, -0.1, -0.1, 0.2, 0.1, -0.2]
LIFTED = LOW + np.linalg.pinv(jacobian(LOW)) @ [0.0, 0.0, 0.1]


def readings(mass, centre, error=0.0, links=0.0, rng=None):
    """An arm at a grasp and 0.1 m above it, whose torques repeat to ``error`` Nm and whose links weigh otherwise by the share ``links``."""
    rng = rng or np.random.default_rng(0)
    true = copy.copy(ROBOT)
    true.masses = {link: (m * (1 + links * rng.standard_normal()), c) for link, (m, c) in ROBOT.masses.items()}

    def reading(q, held):
        return Reading(at(q), own_torques(true, at(q)) + held * load_torques(true, at(q), centre) + error * rng.standard_normal(7))

    return reading(LOW, 0.0), reading(LIFTED, mass)


CENTRE = np.array([0.05, 0.0, 0.02])


@pytest.mark.parametrize("mass", [0.0, 0.06, 1.2])
def test_a_load_is_weighed(mass):
    found = weighed(ROBOT, 0.2, *readings(mass, CENTRE), CENTRE)
    assert found.mass == pytest.approx(mass, abs=1e-9) and 0.03 < found.error < 0.08


def test_the_error_that_is_told_is_the_error_there_is():
    """Of drawn arms, whose links weigh up to some tenths more or less, nearly all weigh within two standard errors."""
    rng, within, drawn = np.random.default_rng(5), 0, 200
    for _ in range(drawn):
        mass = rng.uniform(0.03, 1.5)
        found = weighed(ROBOT, 0.2, *readings(mass, CENTRE, 0.2, 0.05, rng), CENTRE)
        within += abs(found.mass - mass) < 2 * found.error
    assert within >= 0.95 * drawn


def test_what_is_certainly_heavier_or_lighter_than_any_rollout_drew_differs():
    assert Weight(0.5, 0.05).differs(0.25) and Weight(0.5, 0.05).differs(0.9)
    assert not Weight(0.5, 0.05).differs(0.4) and not Weight(0.5, 0.1).differs(0.25) and not Weight(0.06, 0.05).differs(0.06)
    assert not Weight(-0.16, 0.09).differs(0.05)  # what is lighter than can be weighed
    assert str(Weight(0.512, 0.04)) == "512 g (within 80 g)"


def refusal(*arguments):
    with pytest.raises(MagicError) as caught:
        weighed(ROBOT, 0.2, *arguments)
    return caught.value.message


def test_torques_that_tell_no_weight_are_refused():
    empty, loaded = readings(0.5, CENTRE)
    untold = Reading(empty.positions, np.full(7, np.nan))
    assert "not told" in refusal(untold, loaded, CENTRE) and "not told" in refusal(empty, untold, CENTRE)
    # A driver that takes the weight of the links off tells nothing of an arm as its URDF has it.
    assert "before the fingers close" in refusal(Reading(empty.positions, np.zeros(7)), Reading(loaded.positions, np.zeros(7)), CENTRE)
    # Fingers that stand on the table are no empty hand.
    pressed = Reading(empty.positions, empty.torques - 0.6 * load_torques(ROBOT, empty.positions, np.zeros(3)))
    assert "before the fingers close" in refusal(pressed, loaded, CENTRE)
    # Who leans on the arm is no load in the hand.
    pushed = Reading(loaded.positions, loaded.torques + np.array([8.0, 0, 0, 0, 5.0, 0, 0]))
    assert "from those of a load" in refusal(empty, pushed, CENTRE)
