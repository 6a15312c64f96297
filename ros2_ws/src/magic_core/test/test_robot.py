"""What is read off a URDF and an SRDF, and what is said of those that do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magic_core.errors import Code, MagicError
from magic_core.joint_limits import PUBLISHED
from magic_core.presets import PRESETS
from magic_core.robot import Description, RobotConfig, panda_folder
from magic_core.testing import six_axis


@pytest.fixture
def config(tmp_path):
    return six_axis.describe(tmp_path)


def edited(config, *changes):
    """The same robot with its URDF changed: pairs of what there was and what is to be there."""
    path = Path(config.urdf)
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return config


def test_the_panda_is_the_default():
    robot = Description()
    assert robot.names == tuple(f"panda_joint{n}" for n in range(1, 8))
    assert {joint.name for joint in robot.fingers} == {"panda_finger_joint1", "panda_finger_joint2"}
    assert robot.foot == {"panda_link0"} and robot.base == "panda_link0"
    assert robot.finger_links == {"panda_leftfinger", "panda_rightfinger"}
    np.testing.assert_allclose([robot.closed, robot.opened], [[0, 0], [0.04, 0.04]])
    assert [joint.effort for joint in robot.arm] == [87, 87, 87, 87, 12, 12, 12]


def test_published_limits_hold_besides_those_of_the_urdf():
    panda, files = Description(), {"urdf": str(panda_folder() / "urdf/panda.urdf"), "srdf": str(panda_folder() / "srdf/panda.srdf")}
    for name in ("lower", "upper", "velocity"):  # the file has Franka's own numbers
        assert [getattr(joint, name) for joint in panda.arm] == list(getattr(PUBLISHED["panda"], name))
    fr3 = Description(replace(PRESETS["fr3"].config, move_group="panda_hand_tcp", **files))
    for index, joint in enumerate(fr3.arm):
        assert joint.lower == max(PUBLISHED["panda"].lower[index], PUBLISHED["fr3"].lower[index])
        assert joint.upper == min(PUBLISHED["panda"].upper[index], PUBLISHED["fr3"].upper[index])
        assert joint.velocity == PUBLISHED["panda"].velocity[index]  # the slower of the two
        element = fr3.tree().find(f"joint[@name='{joint.name}']/limit")
        assert (float(element.get("lower")), float(element.get("velocity"))) == (joint.lower, joint.velocity)
    assert panda.braking is None and fr3.braking is not None
    assert list(fr3.jerk) == [5000.0] * 7
    # A URDF of one's own without a preset has nobody's limits but its own.
    assert Description(RobotConfig(**files)).published is None
    with pytest.raises(MagicError, match="as the robot.preset ur5e has"):
        Description(replace(PRESETS["ur5e"].config, move_group="panda_hand_tcp", **files))
    with pytest.raises(MagicError, match=r"robot\.preset: 'fr4'"):
        RobotConfig(preset="fr4")


def test_the_end_of_a_joint_is_come_to_slowly():
    """Franka's formula for the FR3, with numbers worked out by hand: joint 1, 0.1 rad before 2.7501 rad, and beyond it."""
    low, high = PUBLISHED["fr3"].braking.velocities(np.array([[2.6501, 0, 0, -1.5, 0, 2.0, 0], [2.8, 0, 0, -1.5, 0, 2.0, 0]]))
    assert high[:, 0] == pytest.approx([np.sqrt(1.2) - 0.3, 0.0])
    assert low[0, 0] == pytest.approx(-(np.sqrt(12 * 5.4002) - 0.3))


def test_the_base_frame_is_the_root_link_or_another_name_for_it(config):
    assert Description().base_frame == "panda_link0"
    assert Description(replace(config, base_frame="/left/foot")).base_frame == "left/foot"
    assert Description(replace(config, base_frame="foot")).base_frame == Description(config).base_frame == "foot"
    with pytest.raises(MagicError) as caught:
        Description(replace(config, base_frame="tip"))
    assert caught.value.code == Code.BAD_REQUEST
    assert "'tip' (allowed: the URDF's root link foot" in caught.value.message


def test_places_of_links_are_those_of_a_plane_arm(config):
    """Shoulder, elbow and wrist turn about y: the tip is where lengths and angles say."""
    robot = Description(config)
    shoulder, elbow, wrist = 0.4, 0.7, -0.3
    tip = robot.poses({"joint_shoulder": shoulder, "joint_elbow": elbow, "joint_wrist": wrist})["tip"]
    angles = np.cumsum([shoulder, elbow, wrist])
    lengths = np.array([0.40, 0.18 + 0.20, 0.08 + 0.12])
    np.testing.assert_allclose(tip[:3, 3], [lengths @ np.sin(angles), 0, 0.32 + lengths @ np.cos(angles)], atol=1e-12)
    np.testing.assert_allclose(tip[:3, 2], [np.sin(angles[-1]), 0, np.cos(angles[-1])], atol=1e-12)


@pytest.mark.parametrize("width", [0.0, 0.03, 0.1])
def test_fingers_are_as_far_apart_as_asked(config, width):
    robot = Description(config)
    by_name = robot.arm_positions(np.concatenate([np.zeros(6), robot.finger_positions(width)]))
    poses = robot.poses(by_name)
    assert poses["left_finger"][0, 3] - poses["right_finger"][0, 3] == pytest.approx(width)


def test_a_finger_may_open_towards_its_lower_limit(config):
    right = '<axis xyz="-1 0 0"/><limit lower="0" upper="0.05"'
    robot = Description(edited(config, (right, '<axis xyz="1 0 0"/><limit lower="-0.05" upper="0"')))
    opened = {joint.name: place for joint, place in zip(robot.fingers, robot.opened, strict=True)}
    assert opened == {"zz_left": 0.05, "zz_right": -0.05}


def test_fingers_that_do_not_meet_keep_their_distance(config):
    robot = Description(replace(config, opening=0.12))
    np.testing.assert_allclose(robot.finger_positions(0.02), robot.closed, atol=1e-12)
    np.testing.assert_allclose(robot.finger_positions(0.07), 0.025)


def test_joints_beside_arm_and_fingers_stand_still(config):
    head = (
        '<link name="head"/><joint name="nod" type="revolute"><parent link="foot"/><child link="head"/>'
        '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    robot = Description(edited(config, ("</robot>", head)))
    assert robot.foot == {"foot", "head"} and "nod" not in robot.moving
    kinds = {joint.get("name"): joint.get("type") for joint in robot.tree().findall("joint")}
    assert kinds["nod"] == "fixed" and kinds["joint_turn"] == "revolute"


def test_more_than_a_turn_is_a_turn_about_home(config):
    wide = 'xyz="0 0 1"/><limit lower="-3.0" upper="3.0"'
    home = (1.0, *config.home[1:])
    robot = Description(replace(edited(config, (wide, 'xyz="0 0 1"/><limit lower="-6.28" upper="6.28"')), home=home))
    turn = robot.arm[0]
    assert (turn.lower, turn.upper) == pytest.approx((1 - np.pi, 1 + np.pi))
    limit = robot.tree().find("joint[@name='joint_turn']/limit")
    assert float(limit.get("lower")) == turn.lower and float(limit.get("effort")) == 150
    assert robot.arm[1].upper == 1.9


def test_every_body_moves_as_one():
    robot = Description()
    bodies = robot.bodies
    assert sorted(link for body in bodies for link in body) == sorted(robot.links)
    assert {"panda_link7", "panda_link8", "panda_hand", "panda_hand_tcp"} in bodies


def test_meshes_are_found_from_where_the_urdf_lies():
    robot = Description()
    names = [mesh.get("filename") for mesh in robot.tree().iterfind("link/collision/geometry/mesh")]
    assert len(names) == 9 and all(Path(name).is_file() for name in names)
    shapes = robot.shapes("panda_link0", "visual")
    assert shapes[0].kind == "mesh" and shapes[0].file.suffix == ".dae"
    assert [shape.kind for shape in robot.shapes("panda_leftfinger")] == ["box"] * 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((("</robot>", ""),), "URDF"),
        ((('type="prismatic"', 'type="revolute"'),), "two prismatic joints"),
        ((('xyz="-1 0 0"', 'xyz="0 1 0"'),), "closing axis"),
        ((('effort="150"', 'effort="0"'),), "effort limit of joint_turn"),
        ((('<child link="elbow"/>', '<child link="nowhere"/>'),), "nowhere"),
        ((('<parent link="shoulder"/>', '<parent link="flange"/>'),), "one tree"),
        ((("</robot>", '<link name="loose"/></robot>'),), "one tree"),
        ((('xyz="0 0 0.2"', 'xyz="0 zero 0.2"'),), "joints of"),
    ],
)
def test_what_is_wrong_with_a_urdf_is_said(config, changes, words):
    with pytest.raises(MagicError) as error:
        Description(edited(config, *changes))
    assert error.value.code == Code.BAD_REQUEST
    assert words in error.value.message


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"move_group": "elsewhere"}, "tip link"),
        ({"move_group": "foot"}, "tip link"),
        ({"home": (0.0,) * 7}, "home"),
        ({"home": tuple(np.degrees(six_axis.HOME))}, "home position of joint_"),
        ({"home": (*six_axis.HOME[:-1], np.nan)}, "home position of joint_"),
        ({"urdf": "nowhere.urdf"}, "URDF"),
        ({"srdf": "nowhere.srdf"}, "SRDF"),
        ({"closing_axis": "y"}, "closing axis"),
    ],
)
def test_what_is_wrong_with_a_configuration_is_said(config, change, words):
    with pytest.raises(MagicError) as error:
        Description(replace(config, **change))
    assert error.value.code == Code.BAD_REQUEST
    assert words in error.value.message


def test_a_missing_mesh_is_named():
    folder = panda_folder()
    config = RobotConfig(str(folder / "urdf/panda.urdf"), str(folder / "srdf/panda.srdf"), package_root="/nowhere")
    with pytest.raises(MagicError, match=r"link0\.stl.*package_root") as error:
        Description(config).tree()
    assert error.value.code == Code.BAD_REQUEST
