"""Transforms against the group's axioms and known rotations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms as tf

number = st.floats(-10, 10, allow_nan=False)
vector = st.tuples(number, number, number)
poses = st.builds(lambda r, t: tf.from_rotvec(r, t), vector, vector)


@given(poses, poses, poses)
@settings(max_examples=60, deadline=None)
def test_group_axioms(a, b, c):
    np.testing.assert_allclose(a @ tf.inverse(a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(tf.inverse(a @ b), tf.inverse(b) @ tf.inverse(a), atol=1e-9)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(a[:3, :3]), 1.0, atol=1e-9)


@given(poses)
@settings(max_examples=60, deadline=None)
def test_quaternions_come_back(pose):
    q = tf.quaternion_xyzw(pose)
    assert q[3] >= 0
    np.testing.assert_allclose(np.linalg.norm(q), 1.0, atol=1e-12)
    np.testing.assert_allclose(tf.from_quaternion(pose[:3, 3], q), pose, atol=1e-9)
    np.testing.assert_allclose(tf.from_quaternion_wxyz(pose[:3, 3], tf.quaternion_wxyz(pose)), pose, atol=1e-9)
    np.testing.assert_allclose(np.roll(q, 1), tf.quaternion_wxyz(pose))


def test_quaternion_order():
    quarter = tf.from_rpy(0, 0, np.pi / 2)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(tf.quaternion_xyzw(quarter), [0, 0, half, half], atol=1e-12)
    np.testing.assert_allclose(tf.quaternion_wxyz(quarter), [half, 0, 0, half], atol=1e-12)
    np.testing.assert_allclose(tf.apply(quarter, [1, 0, 0]), [0, 1, 0], atol=1e-12)


def test_fixed_axis_roll_pitch_yaw():
    # REP-103: yaw about z, then pitch about y, then roll about x, all fixed axes applied roll first.
    np.testing.assert_allclose(tf.apply(tf.from_rpy(np.pi / 2, 0, np.pi / 2), [0, 1, 0]), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(tf.apply(tf.from_rpy(0, np.pi / 2, np.pi / 2), [1, 0, 0]), [0, 0, -1], atol=1e-12)


def test_inverse_and_apply_of_stacks():
    rng = np.random.default_rng(0)
    stack = np.stack([tf.from_rotvec(rng.normal(size=3), rng.normal(size=3)) for _ in range(5)])
    np.testing.assert_allclose(tf.inverse(stack) @ stack, np.tile(np.eye(4), (5, 1, 1)), atol=1e-12)
    points = rng.normal(size=(2, 3, 3))
    assert tf.apply(stack[0], points).shape == (2, 3, 3)
    np.testing.assert_allclose(tf.apply(tf.inverse(stack[0]), tf.apply(stack[0], points)), points, atol=1e-12)


@given(vector, vector, vector)
@settings(max_examples=60, deadline=None)
def test_frames_are_right_handed_and_keep_x(origin, x, z):
    if np.linalg.norm(np.cross(x, z)) < 1e-3 or np.linalg.norm(x) < 1e-2:
        return
    frame = tf.frame(origin, x, z)
    np.testing.assert_allclose(frame[:3, 0], tf.unit(x), atol=1e-9)
    np.testing.assert_allclose(np.cross(frame[:3, 0], frame[:3, 1]), frame[:3, 2], atol=1e-9)
    np.testing.assert_allclose(frame[:3, 1], np.cross(frame[:3, 2], frame[:3, 0]), atol=1e-9)
    assert frame[:3, 2] @ np.asarray(z) > 0


@pytest.mark.parametrize("bad", [[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
def test_no_direction(bad):
    with pytest.raises(ValueError, match="finite length"):
        tf.unit(bad)


def test_rotation_angle():
    assert tf.rotation_angle(np.eye(4), tf.from_rpy(0, 0.3, 0)) == pytest.approx(0.3)
    assert tf.rotation_angle(tf.from_rpy(0.2, 0, 0), tf.from_rpy(0.2, 0, 0)) == pytest.approx(0, abs=1e-7)


def test_interpolation_is_linear_and_spherical_and_holds_at_the_ends():
    times = [0.0, 2.0]
    poses = np.stack([np.eye(4), tf.from_rpy(0, 0, np.pi / 2, [2, 0, 0])])
    at = tf.interpolate(times, poses, [-1.0, 0.0, 1.0, 2.0, 9.0])
    np.testing.assert_allclose(at[0], poses[0], atol=1e-12)
    np.testing.assert_allclose(at[2], tf.from_rpy(0, 0, np.pi / 4, [1, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(at[4], poses[1], atol=1e-12)
    np.testing.assert_allclose(tf.interpolate([0.0], poses[:1], [0.0, 5.0]), np.tile(np.eye(4), (2, 1, 1)))
