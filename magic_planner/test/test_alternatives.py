"""The comparison with other libraries: what it draws, and what it says of answers that are known."""

import numpy as np
import pytest

from magic_planner import alternatives
from magic_planner.robot import Robot


@pytest.fixture(scope="module")
def robot():
    return Robot()


def test_an_answer_is_measured_by_the_chains_own_kinematics(robot):
    q = np.stack([robot.home, robot.home + 0.1])
    targets = robot.chain.forward(q)
    exact = alternatives.asked(robot, "exact", targets, lambda t: (np.array([0, 1, 1]), q[[0, 1, 1]]))
    assert (exact.solved, exact.solutions) == (2, 1.5) and exact.position < 1e-9 and exact.angle < 1e-4
    # The last joint turns the hand about its own axis: the tip stays, and the angle is the joint's.
    turned = q + 0.01 * np.eye(robot.count)[-1]
    off = alternatives.asked(robot, "off", targets, lambda t: (np.arange(2), turned))
    assert off.angle == pytest.approx(10.0, rel=1e-6) and off.position < 1e-6
    nothing = alternatives.asked(robot, "none", targets, lambda t: (np.zeros(0, int), np.zeros((0, robot.count))))
    assert (nothing.solved, nothing.solutions, nothing.position) == (0, 0.0, 0.0)


def test_poses_and_pairs_are_drawn_anew_by_their_seed(robot):
    poses = alternatives.drawn(robot, 3, 5)
    np.testing.assert_array_equal(poses, alternatives.drawn(robot, 3, 5))
    assert (poses[:, 2, 3] > 0.02).all()
    boxes = alternatives.among_boxes(robot, 2, 1)
    np.testing.assert_array_equal(boxes.pairs, alternatives.among_boxes(robot, 2, 1).pairs)
    assert len(boxes.sizes) == len(boxes.poses) == alternatives.BOXES
    assert not robot.collides(robot.home)
    for start, goal in boxes.pairs:
        assert not robot.collides(start) and not robot.collides(goal)
        assert not alternatives._free(robot, np.stack([start, goal]), alternatives.FINE)
