"""A path by what pictures say of it: how it is changed and foreseen, what is doubted, and what a motion's own haste is."""

import numpy as np
import pytest

from magic_core import transforms
from magic_perception.paths import CLEAR, COMPARED, SURFACE, UNCONTRADICTED, Seen, State, changed, doubted, likeliest, moved, predicted

RATE = 10.0
SURE = np.diag([1 / 0.002**2] * 3 + [1 / 0.02**2] * 3)


def test_a_change_of_pose_is_undone_by_its_inverse():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = transforms.from_rotvec(rng.normal(size=3), rng.normal(size=3))
        middle, change = rng.normal(size=3), rng.normal(size=6) * 0.5
        after = moved(pose, middle, change)
        np.testing.assert_allclose(changed(after, pose, middle), change, atol=1e-12)
        np.testing.assert_allclose(transforms.apply(after, middle) - transforms.apply(pose, middle), change[:3], atol=1e-12)


def test_a_prediction_goes_on_as_before_and_knows_less_the_longer_it_is():
    velocity = np.array([0.3, 0.0, 0.1, 0.0, 0.0, 1.0])
    state = State(np.eye(4), velocity, np.eye(12) * 1e-6)
    middle = np.array([0.1, 0.0, 0.0])
    later, _ = predicted(state, middle, 0.2)
    np.testing.assert_allclose(transforms.apply(later.pose, middle), middle + 0.2 * velocity[:3])
    assert transforms.rotation_angle(later.pose, state.pose) == pytest.approx(0.2)
    halves, _ = predicted(predicted(state, middle, 0.1)[0], middle, 0.1)
    np.testing.assert_allclose(halves.covariance, later.covariance, atol=1e-12)  # the steps do not matter
    assert np.all(np.diag(later.covariance)[:6] > np.diag(state.covariance)[:6])


def seen_at(pose=None, apart=np.nan, through=0.0):
    """What the pictures of a moment say that see a thing at a pose, as sharply as SURE."""
    return Seen(np.eye(4) if pose is None else pose, SURE, np.zeros(6), through, apart)


def test_what_cameras_tell_apart_or_look_through_is_doubted_and_only_about_then():
    times = np.arange(60) / RATE
    told = [seen_at(apart=(0.5 if k < 30 else 4.0) if k % 5 == 0 else np.nan) for k in range(60)]
    around = round(COMPARED * RATE)
    doubts = doubted(times, told)
    np.testing.assert_allclose(doubts[: 30 - around], 1.0)  # agreeing better than said is no proof of more
    np.testing.assert_allclose(doubts[30 + around :], 4.0)
    told[5], told[7] = None, seen_at(through=3 * CLEAR)
    assert doubted(times, told)[7] == pytest.approx(9.0) and doubted(times, told)[4] == 1.0
    np.testing.assert_allclose(doubted(times, [seen_at()] * 60), UNCONTRADICTED)  # one camera: nothing tells what it is wrong in


def test_what_is_doubted_is_known_less():
    times = np.arange(60) / RATE
    start = State(np.eye(4), np.zeros(6), np.diag(np.repeat([0.002, 0.02, 0.05, 0.5], 3) ** 2))
    sure, doubtful = (likeliest(start, times, [seen_at(apart=apart)] * 60, np.zeros(3))[30] for apart in (1.0, 9.0))
    deviations = [np.sqrt(state.covariance[3, 3] - SURFACE[1] ** 2) for state in (sure, doubtful)]
    assert 1.5 < deviations[1] / deviations[0] < 3.0


@pytest.mark.parametrize("pace", [0.3, 6.0], ids=["quiet", "quick"])
def test_a_quiet_motion_is_smoothed_and_a_quick_one_is_kept(pace):
    rng = np.random.default_rng(1)
    times = np.arange(60) / RATE
    true = np.stack([transforms.from_rpy(0.3 * np.sin(pace * t), 0, 0, [0.2 * np.sin(0.5 * pace * t), 0, 0]) for t in times])
    noise = rng.multivariate_normal(np.zeros(6), np.linalg.inv(SURE), len(times))
    told = [seen_at(moved(pose, np.zeros(3), off), apart=1.0) for pose, off in zip(true, noise, strict=True)]
    start = State(true[0], np.array([0.1 * pace, 0, 0, 0.3 * pace, 0, 0]), np.diag(np.repeat([0.002, 0.02, 0.05, 0.5], 3) ** 2))
    states = likeliest(start, times, told, np.zeros(3))
    off = np.array([changed(state.pose, pose, np.zeros(3)) for state, pose in zip(states, true, strict=True)])
    rms, given = np.sqrt((off**2).mean(axis=0)), np.sqrt((noise**2).mean(axis=0))
    assert np.all(rms < (0.6 if pace < 1 else 1.0) * given)
