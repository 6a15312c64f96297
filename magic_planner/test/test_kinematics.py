"""The arm's own kinematics against MPlib's, finite differences and statics."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import PANDA_HOME, RobotConfig, panda_folder
from magic_planner.kinematics import load_chain, pose_error


@pytest.fixture(scope="module")
def chain():
    return load_chain(panda_folder() / "urdf" / "panda.urdf", "panda_hand_tcp")


@pytest.fixture(scope="module")
def configurations(chain):
    return np.random.default_rng(0).uniform(chain.lower, chain.upper, (40, chain.count))


def test_forward_kinematics_agrees_with_mplib(arm, configurations):
    robot = arm.robot
    model = robot.planner.pinocchio_model
    for q in configurations:
        model.compute_forward_kinematics(np.concatenate([q, [0.0, 0.0]]))
        np.testing.assert_allclose(robot.chain.forward(q), model.get_link_pose(robot.link).to_transformation_matrix(), atol=1e-9)


def test_the_jacobian_is_the_derivative(chain, configurations):
    frames, tip = chain.frames(configurations)
    jacobian = chain.jacobian(frames, tip)
    for j in range(chain.count):
        step = np.zeros(chain.count)
        step[j] = 1e-6
        slope = pose_error(chain.forward(configurations + step), chain.forward(configurations - step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, j], slope, atol=1e-6)


def test_pose_error_is_zero_only_at_the_target_and_survives_half_turns():
    pose = transforms.from_rpy(0.3, -0.2, 1.0, [0.1, 0.2, 0.3])
    assert np.allclose(pose_error(pose[None], pose[None]), 0)
    half = pose @ transforms.from_rpy(np.pi, 0, 0)
    assert np.linalg.norm(pose_error(half[None], pose[None])[0, 3:]) == pytest.approx(np.pi)


def test_inverse_kinematics_reaches_what_forward_kinematics_gave(chain, configurations):
    targets = chain.forward(configurations)
    near = np.clip(configurations + 0.1, chain.lower, chain.upper)
    q, solved = chain.solve(targets, near)
    assert solved.mean() > 0.9
    reached = chain.forward(q[solved])
    assert np.linalg.norm(reached[:, :3, 3] - targets[solved, :3, 3], axis=1).max() < 1e-4
    assert np.all(q >= chain.lower) and np.all(q <= chain.upper)


def test_tracking_stays_on_the_path_and_says_where_it_ends(chain):
    start = transforms.make(np.diag([1.0, -1.0, -1.0]), [0.5, 0.0, 0.2])
    q, solved = chain.solve(start[None], np.array([PANDA_HOME]))
    assert solved[0]
    path = np.repeat(start[None], 60, axis=0)
    path[:, 0, 3] += np.linspace(0, 0.6, 60)  # ends beyond the arm's reach
    found, stopped, _ = chain.track(path[:, None], q)
    assert 15 < stopped[0] < 60
    reached = chain.forward(found[: stopped[0], 0])
    np.testing.assert_allclose(reached, path[: stopped[0]], atol=2e-4)
    assert np.abs(np.diff(found[: stopped[0], 0], axis=0)).max() < 0.35


def test_gravity_torques_are_the_potentials_gradient(chain, configurations):
    def potential(q):
        frames, tip = chain.frames(q)
        energy = np.zeros(len(q))
        for j, mass, centre in zip(chain.mass_joint, chain.masses, chain.mass_centre, strict=True):
            energy += mass * 9.81 * (np.einsum("nij,j->ni", frames[:, j, :3, :3], centre) + frames[:, j, :3, 3])[:, 2]
        return energy + 2.0 * 9.81 * (tip @ np.array([0.0, 0.1, 0.05, 1.0]))[:, 2]

    torques = chain.gravity_torques(configurations, 2.0, np.array([0.0, 0.1, 0.05]))
    for j in range(chain.count):
        step = np.zeros(chain.count)
        step[j] = 1e-6
        slope = (potential(configurations + step) - potential(configurations - step)) / 2e-6
        np.testing.assert_allclose(torques[:, j], slope, atol=1e-5)


@pytest.mark.parametrize(("urdf", "tip"), [("/nowhere.urdf", "tip"), ("panda", "tail")])
def test_a_missing_file_or_link_is_named(urdf, tip):
    path = panda_folder() / "urdf" / "panda.urdf" if urdf == "panda" else urdf
    with pytest.raises(MagicError, match="tail|nowhere") as raised:
        load_chain(path, tip)
    assert raised.value.code == Code.BAD_REQUEST


@pytest.mark.parametrize("change", [{"opening": 0.0}, {"closing_axis": "z"}, {"velocity_scale": 0.0}, {"acceleration_scale": 2.0}])
def test_a_bad_configuration_is_refused(change):
    with pytest.raises(MagicError) as raised:
        RobotConfig(**change)
    assert raised.value.code == Code.BAD_REQUEST
