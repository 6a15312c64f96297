"""The robot is cut out of pictures, all of it and little else; where its links are is what the maker's table says."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.joint_history import JointHistory
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_core.robot import Description
from magic_core.robot_pictures import RobotPictures, link_mesh
from magic_core.self_filter import STEP, SelfFilter
from magic_core.sensor import D435, capture, looking_at, scene_raycaster
from magic_core.shapes import make
from magic_core.testing import six_axis

#: Franka's table of modified Denavit-Hartenberg parameters: a, d (m), alpha (rad) of each joint, then of the flange.
FRANKA = (
    (0, 0.333, 0), (0, 0, -np.pi / 2), (0, 0.316, np.pi / 2), (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2), (0, 0, np.pi / 2), (0.088, 0, np.pi / 2), (0, 0.107, 0),
)  # fmt: skip
OVER_THE_TABLE = (0.0, 0.35, 0.0, -2.1, 0.0, 2.45, np.pi / 4, 0.04, 0.04)
LEFT = looking_at([0.94, 0.42, 0.66], [0.52, 0.0, 0.04])


@pytest.fixture(scope="module")
def panda():
    robot = Description()
    return robot, RobotPictures(robot), SelfFilter(robot)


def drawn_by_collision_shapes(robot, joints, pose):
    """Depth (H, W) of the robot's collision shapes, drawn at full resolution by another caster."""
    poses = robot.poses(robot.arm_positions(joints))
    meshes = [mesh.transformed(poses[link]) for link in robot.links if (mesh := link_mesh(robot, link, ("collision",))) is not None]
    return Raycaster(meshes).perspective(D435, pose)[1]


def seen_with(meshes, pose, seed=0):
    """A frame of the sensor model, and where (H, W) its rays meet any of the meshes."""
    caster = scene_raycaster(meshes)
    return capture([], D435, pose, seed, raycaster=caster), caster.perspective(D435, pose)[0].ids > 0


@settings(deadline=None)
@given(joints=st.lists(st.floats(-2.5, 2.5), min_size=7, max_size=7))
def test_the_flange_is_where_frankas_table_says(panda, joints):
    expected = np.eye(4)
    for (a, d, alpha), theta in zip(FRANKA, [*joints, 0.0], strict=True):
        expected = expected @ transforms.from_rpy(alpha, 0, 0) @ transforms.make(translation=[a, 0, 0])
        expected = expected @ transforms.from_rpy(0, 0, theta) @ transforms.make(translation=[0, 0, d])
    names = [f"panda_joint{i}" for i in range(1, 8)]
    np.testing.assert_allclose(panda[0].poses(dict(zip(names, joints, strict=True)))["panda_link8"], expected, atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(st.lists(st.floats(0.02, 0.98), min_size=7, max_size=7), st.floats(0, 0.04), st.integers(0, 1000))
def test_all_of_the_robot_is_cut_and_nothing_away_from_it(panda, shares, finger, seed):
    """With the sensor's noise and the true looks, at any joint positions: no pixel of the robot stays, and what stays is the table."""
    robot, pictures, self_filter = panda
    arm = [joint.lower + share * (joint.upper - joint.lower) for joint, share in zip(robot.arm, shares, strict=True)]
    joints = np.array([*arm, finger, finger])
    frame, truly = seen_with(pictures.at(joints), LEFT, seed)
    cut = self_filter.cut(frame, [robot.arm_positions(joints)])
    points = transforms.apply(LEFT, D435.unproject(frame.depth))
    assert not np.any(truly & ~cut.robot)
    left = ~cut.robot & np.isfinite(frame.depth)
    assert np.all(np.abs(points[left][:, 2]) < 6 * 0.0042 * frame.depth[left] ** 2)
    depth = drawn_by_collision_shapes(robot, joints, LEFT)
    if np.isfinite(depth).any():
        margins, near = self_filter.margins, np.nanmin(depth)
        # The shapes are drawn at every STEP-th pixel; grown by a margin they are nearer by it.
        reach = 3 * STEP + margins.edge + int(np.ceil(D435.fx * margins.space / (near - margins.space)))
        allowed = cv2.dilate(np.isfinite(depth).astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)).astype(bool)
        assert not np.any(cut.robot & ~allowed)
    else:
        assert not cut.robot.any()


def test_what_is_before_the_robot_stays(panda):
    robot, pictures, self_filter = panda
    joints = np.array(OVER_THE_TABLE)
    hand = robot.poses(robot.arm_positions(joints))["panda_hand"][:3, 3]
    way = LEFT[:3, 3] - hand
    ball = make("sphere", 0, radius=0.03).mesh.transformed(transforms.make(translation=hand + 0.15 * way / np.linalg.norm(way)))
    frame, _ = seen_with([*pictures.at(joints), ball], LEFT)
    _, of_ball = seen_with([ball], LEFT)
    cut = self_filter.cut(frame, [robot.arm_positions(joints)])
    inner = cv2.erode(of_ball.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & np.isfinite(frame.depth)
    assert inner.sum() > 500 and not cut.robot[inner].any()


def test_a_robot_that_is_not_where_it_is_said_to_be_is_a_contradiction(panda):
    robot, pictures, self_filter = panda
    there = np.array(OVER_THE_TABLE)
    frame, _ = seen_with(pictures.at(there), LEFT)
    empty, _ = seen_with([], LEFT)
    assert not self_filter.cut(frame, [robot.arm_positions(there)]).contradicted
    assert self_filter.cut(empty, [robot.arm_positions(there)]).contradicted
    looks_away, _ = seen_with([], looking_at([0.94, 0.42, 0.66], [1.3, 0.9, 0.0]))
    away = self_filter.cut(looks_away, [robot.arm_positions(there)])
    assert not away.contradicted and np.isnan(away.through) and not away.robot.any()


def test_where_the_base_stands_is_told(panda):
    """Robot and camera moved together make the same picture."""
    robot, pictures, self_filter = panda
    joints = np.array(OVER_THE_TABLE)
    move = transforms.from_rpy(0, 0, 0.7, [0.3, -0.2, 0.1])
    table = Mesh(np.array([[-1.0, -1, 0], [2, -1, 0], [2, 1, 0], [-1, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    frames = [capture(pictures.at(joints, base), D435, base @ LEFT, 0, table=table.transformed(base)) for base in (np.eye(4), move)]
    cuts = [self_filter.cut(frame, [robot.arm_positions(joints)], base) for frame, base in zip(frames, (None, move), strict=True)]
    assert np.mean(cuts[0].robot != cuts[1].robot) < 1e-3
    assert self_filter.cut(frames[1], [robot.arm_positions(joints)]).robot.mean() != pytest.approx(cuts[1].robot.mean(), rel=0.05)


def test_a_camera_at_the_wrist_sees_the_fingers(panda):
    robot, pictures, self_filter = panda
    joints = np.array(OVER_THE_TABLE)
    hand = robot.poses(robot.arm_positions(joints))["panda_hand"]
    camera = hand @ transforms.from_rpy(0, -0.5, 0, [0.07, 0, 0.02]) @ transforms.from_rpy(0, 0, np.pi / 2)
    frame, truly = seen_with(pictures.at(joints), camera)
    assert 1000 < truly.sum() < 0.5 * truly.size
    cut = self_filter.cut(frame, [robot.arm_positions(joints)])
    assert not np.any(truly & ~cut.robot)
    assert cut.robot.mean() < 0.6


def test_a_moving_arm_is_cut_wherever_it_may_have_been(panda):
    robot, pictures, self_filter = panda
    before, after = np.array(OVER_THE_TABLE), np.array(OVER_THE_TABLE)
    after[0] += 0.06
    both = [robot.arm_positions(before), robot.arm_positions(after)]
    for joints in (before, after, (before + after) / 2):
        frame, truly = seen_with(pictures.at(joints), LEFT)
        assert not np.any(truly & ~self_filter.cut(frame, both).robot)


def test_another_arm(tmp_path):
    robot = Description(six_axis.describe(tmp_path))
    joints = np.array([*six_axis.HOME, 0.05, 0.05])
    frame, truly = seen_with(RobotPictures(robot).at(joints), LEFT)
    cut = SelfFilter(robot).cut(frame, [robot.arm_positions(joints)])
    assert truly.sum() > 5000 and not np.any(truly & ~cut.robot)


# ---------------------------------------------------------------- joints at the picture's moment


def test_joints_are_interpolated_to_the_picture():
    history = JointHistory()
    history.take(["a", "b"], [0.0, 1.0], 10.0)
    history.take(["a"], [0.4], 10.2)
    assert history.at(["a"], 10.05, 0.2) == pytest.approx({"a": 0.1})
    assert history.at(["a", "b"], 10.1, 0.2) == pytest.approx({"a": 0.2, "b": 1.0})  # b was told of once, a tenth of a second ago
    assert history.at(["a"], 10.3, 0.2) == {"a": 0.4} and history.at(["a"], 9.9, 0.2) == {"a": 0.0}
    assert history.newest(["a", "b"]) == 10.0 and history.newest(["c"]) == -np.inf


def test_late_and_early_messages_find_their_place():
    history = JointHistory()
    for stamp in (10.2, 10.0, 10.1):
        history.take(["a"], [stamp - 10], stamp)
    assert history.at(["a"], 10.05, 0.2) == pytest.approx({"a": 0.05})


def test_across_a_gap_the_nearer_state_counts():
    history = JointHistory()
    history.take(["a"], [0.0], 10.0)
    history.take(["a"], [1.0], 11.0)
    assert history.at(["a"], 10.1, 0.2) == {"a": 0.0} and history.at(["a"], 10.9, 0.2) == {"a": 1.0}


def test_a_joint_that_passes_half_a_turn_does_not_pass_zero():
    history = JointHistory()
    history.take(["a"], [3.1], 10.0)
    history.take(["a"], [-3.1], 10.1)
    assert abs(history.at(["a"], 10.06, 0.2)["a"]) == pytest.approx(3.1)


@pytest.mark.parametrize(
    ("names", "stamp", "code", "told"),
    [(["a"], 12.0, Code.STALE_DATA, "2.0"), (["a"], 8.0, Code.STALE_DATA, "2.0"), (["a", "z"], 10.0, Code.STALE_DATA, "z")],
)
def test_what_is_not_known_at_a_stamp_is_told(names, stamp, code, told):
    history = JointHistory()
    history.take(["a"], [0.0], 10.0)
    with pytest.raises(MagicError) as error:
        history.at(names, stamp, 0.2)
    assert error.value.code == code and told in error.value.message


def test_nothing_received_is_told():
    with pytest.raises(MagicError) as error:
        JointHistory().at(["a"], 10.0, 0.2)
    assert error.value.code == Code.NO_FRAMES


@pytest.mark.parametrize(("positions", "stamp"), [([0.0, 1.0], 10.0), ([np.nan], 10.0), ([0.0], 0.0)])
def test_messages_that_say_nothing_are_refused(positions, stamp):
    history = JointHistory()
    with pytest.raises(MagicError):
        history.take(["a"], positions, stamp)
    assert not history.known()


def test_a_joint_that_is_after_a_gap_where_it_was_before_has_been_there():
    history = JointHistory()
    for stamp, resting, moving in ((10.0, 0.5, 0.0), (10.8, 0.5004, 0.4)):
        history.take(["a", "b"], [resting, moving], stamp)
    assert history.at(["a"], 10.4, 0.2)["a"] == pytest.approx(0.5, abs=1e-3)
    with pytest.raises(MagicError, match="STALE_DATA"):
        history.at(["b"], 10.4, 0.2)
    history.take(["a"], [0.5], 13.0)
    with pytest.raises(MagicError, match="STALE_DATA"):
        history.at(["a"], 11.9, 0.2)


def test_a_bag_that_begins_again_begins_anew():
    history = JointHistory(memory=5.0)
    history.take(["a"], [1.0], 100.0)
    history.take(["a"], [2.0], 10.0)
    assert history.at(["a"], 10.0, 0.2) == {"a": 2.0} and history.newest(["a"]) == 10.0


def test_a_fast_driver_does_not_fill_the_memory():
    history = JointHistory(memory=1.0)
    for i in range(5000):
        history.take(["a"], [i * 1e-3], 10 + i * 1e-3)
    assert len(history._tracks["a"]) <= 260
    assert history.at(["a"], 14.9, 0.2)["a"] == pytest.approx(4.9, abs=0.005)
