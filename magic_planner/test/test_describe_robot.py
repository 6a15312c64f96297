"""An arm's files from its URDF: pairs that never touch, xacro, and linkage grippers reduced to their opening."""

import math
import shutil
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import yaml

from magic_core import robot as robots
from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description, RobotConfig
from magic_core.testing import six_axis
from magic_planner import describe_robot, linkage
from magic_planner.robot import Robot

#: The linkage: bars of length L on knuckles at +-D from the middle, upright at an angle of 0; the fingertip keeps upright.
L, D, PAD = 0.08, 0.02, 0.01


def with_linkage(folder, tips=True, parallel=True, drivers=1):
    """The six-axis arm with a parallel gripper on a linkage instead of its sliding fingers: open at 0, bars leaning out by 0.5 rad."""
    config = six_axis.describe(folder)
    root = ET.parse(config.urdf).getroot()
    for element in [e for e in root if (e.get("name") or "").endswith("_finger") or (e.get("name") or "").startswith("zz_")]:
        root.remove(element)
    for side, sign in (("left", 1), ("right", -1)):
        mimic = "" if side == "left" or drivers > 1 else '<mimic joint="drive"/>'
        name = "drive" if side == "left" else "right_bar_joint"
        follow = (
            f'<mimic joint="drive" multiplier="-1" offset="{0 if parallel else 0.3}"/>'
            if parallel
            else '<mimic joint="drive" multiplier="-0.4"/>'
        )
        for text in (
            f'<link name="{side}_bar"><collision><origin xyz="0 0 {L / 2}"/><geometry><box size="0.01 0.01 {L}"/></geometry></collision></link>',
            f'<link name="{side}_tip">'
            + (f'<collision><origin xyz="0 0 0.02"/><geometry><box size="{2 * PAD} 0.02 0.05"/></geometry></collision>' if tips else "")
            + "</link>",
            f'<joint name="{name}" type="revolute"><parent link="flange"/><child link="{side}_bar"/><origin xyz="{sign * D} 0 0.07" rpy="0 {sign * 0.5} 0"/>'
            f'<axis xyz="0 {-sign} 0"/><limit lower="0" upper="0.9" velocity="1" effort="10"/>{mimic}</joint>',
            f'<joint name="{side}_tip_joint" type="revolute"><parent link="{side}_bar"/><child link="{side}_tip"/><origin xyz="0 0 {L}" rpy="0 {-sign * 0.5} 0"/>'
            f'<axis xyz="0 {-sign} 0"/><limit lower="-1" upper="1" velocity="1" effort="10"/>{follow}</joint>',
        ):
            root.append(ET.fromstring(text))
    path = folder / "linkage.urdf"
    path.write_text(ET.tostring(root, encoding="unicode"))
    return path


def gap(angle):
    """Between the inner faces of the fingertips at an angle of the driving joint, m."""
    return 2 * (D + L * math.sin(0.5 - angle) - PAD)


def ungripped(path):
    return linkage.Ungripped(RobotConfig(urdf=str(path), srdf=str(path.with_name("six_axis.srdf")), move_group="tip", home=six_axis.HOME))


def test_a_linkage_opens_as_its_geometry_says(tmp_path):
    jaws = linkage.measure(ungripped(with_linkage(tmp_path)))
    assert (jaws.driver, jaws.axis) == ("drive", "x")
    assert jaws.widths == pytest.approx([gap(a) for a in jaws.positions], abs=1e-9)
    assert jaws.opening == pytest.approx(gap(0.0))
    closed = 0.5 + math.asin((D - PAD) / L)
    assert jaws.least == pytest.approx(0.0, abs=1e-9)
    assert jaws.positions[jaws.closed] == pytest.approx(closed, abs=1e-9)
    assert jaws.reaches_on == pytest.approx(L * (math.cos(0.5 - closed) - math.cos(0.5)))


def test_the_reduced_fingers_are_as_far_apart_and_as_deep_as_the_linkage(tmp_path):
    found = describe_robot.describe(with_linkage(tmp_path), tmp_path / "out", tip="tip", home=six_axis.HOME, samples=200)
    description, jaws = Description(found.config), found.jaws
    assert {j.name for j in description.fingers} == set(linkage.NAMES)
    planned = Robot(found.config)
    for width in (found.config.opening, 0.03, jaws.least):
        fingers = dict(zip((j.name for j in description.fingers), description.finger_positions(width)))
        poses = description.poses({**dict(zip(description.names, six_axis.HOME)), **fingers})
        tip = transforms.inverse(poses["tip"])
        corners = [transforms.apply(tip @ poses[f"{s}_tip"], [[x, 0, 0.045] for x in (-PAD, PAD)]) for s in ("left", "right")]
        assert corners[0][:, 0].min() - corners[1][:, 0].max() == pytest.approx(width, abs=1e-5)
        assert corners[0][:, 2] == pytest.approx(jaws.depths[jaws.closed], abs=1e-6)
    assert planned.finger_links and planned.collision(np.array(six_axis.HOME)) is None


@pytest.mark.parametrize(
    "change, words",
    [
        ({"drivers": 2}, "driving joints of the gripper"),
        ({"tips": False}, "turn of the fingertip"),
        ({"parallel": False}, "a parallel gripper"),
    ],
)
def test_what_is_no_parallel_linkage_is_refused(tmp_path, change, words):
    with pytest.raises(MagicError) as caught:
        linkage.measure(ungripped(with_linkage(tmp_path, **change)))
    assert caught.value.code is Code.BAD_REQUEST and words in caught.value.message


def test_a_real_linkage_of_somebody_elses_is_reduced():
    """PAL's gripper of the TIAGo Pro: six joints, of which one drives."""
    path = robots.panda_folder().parent / "tiago_pro_description/robots/tiago_pro.urdf"
    if not path.is_file():
        pytest.skip("example-robot-data without the TIAGo Pro")
    robot = linkage.Ungripped(
        RobotConfig(
            urdf=str(path), srdf=str(robots.panda_folder() / "srdf/panda.srdf"), move_group="gripper_left_base_link", home=(0.0,) * 8
        )
    )
    jaws = linkage.measure(robot)
    assert len(robot.gripper_joints()) == 6 and jaws.driver == "gripper_left_finger_joint"
    assert 0.07 < jaws.opening < 0.09 and jaws.least < 0.01 and 0.0 < jaws.reaches_on < 0.03
    tree = linkage.reduced(robot, jaws)
    kinds = {j.get("name"): j.get("type") for j in tree.findall("joint")}
    assert [kinds[name] for name in linkage.NAMES] == ["prismatic", "prismatic"]
    assert kinds["gripper_left_outer_finger_right_joint"] == "fixed"


def test_pairs_that_cannot_meet_are_found_and_those_that_can_are_kept(tmp_path):
    """Of the six-axis arm: by its dimensions the forearm can fold back on to the shoulder, and nothing reaches its own neighbour's
    neighbour's foot."""
    found = describe_robot.describe(six_axis_file(tmp_path), tmp_path / "out", tip="tip", home=six_axis.HOME, samples=1500)
    pairs = found.pairs
    assert ("foot", "turn") in pairs.adjacent and ("left_finger", "right_finger") in pairs.adjacent
    assert not pairs.home
    # The elbow turns by 2.6 rad either way: the hand of an arm folded up meets shoulder and foot.
    assert ("flange", "shoulder") in pairs.checked or ("left_finger", "shoulder") in pairs.checked
    # The shoulder's own upper end, 0.4 m from its joint, never meets the foot: its lower end begins 0.04 m above it and it tilts by 1.9 rad
    # at most.
    assert ("elbow", "turn") in pairs.never
    everything = sum(map(len, (pairs.adjacent, pairs.always, pairs.home, pairs.never, pairs.checked)))
    assert everything == math.comb(len(six_axis.BOXES) + 2, 2)
    # What is written is what planner and verifier read.
    config = RobotConfig(
        **{
            k: tuple(v) if isinstance(v, list) else v
            for k, v in yaml.safe_load((tmp_path / "out" / "robot.param.yaml").read_text())["/**"]["ros__parameters"]["robot"].items()
        }
    )
    description = Description(config)
    assert (
        yaml.safe_load((tmp_path / "out" / "robot.param.yaml").read_text())["/**/perception"]["ros__parameters"]["frame"]
        == description.base_frame
    )
    unchecked = {frozenset(p) for group in (pairs.adjacent, pairs.always, pairs.home, pairs.never) for p in group}
    assert description.disabled == unchecked and config.opening == pytest.approx(0.1) and config.closing_axis == "x"


def six_axis_file(folder):
    six_axis.describe(folder)
    return folder / "six_axis.urdf"


def test_pairs_of_the_panda_agree_with_its_makers():
    """What touches in a sample Franka's own SRDF has checked, and what that does not have checked is not checked here either."""
    theirs = Description()
    pairs = describe_robot.link_pairs(theirs.config, samples=400)
    assert not pairs.home and len(pairs.checked) > 10
    assert not {frozenset(p) for p in pairs.checked} & theirs.disabled
    ours = {frozenset(p) for p in (*pairs.adjacent, *pairs.always, *pairs.never)}
    shaped = {link for pair in (*ours, *map(frozenset, pairs.checked)) for link in pair}
    assert {pair for pair in theirs.disabled if pair <= shaped} <= ours


def test_xacro_is_processed_where_there_is_one(tmp_path, monkeypatch):
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="side" default="left"/><link name="$(arg side)_base"/></robot>'
    )
    if shutil.which("xacro") or _importable("xacro"):
        assert describe_robot.document(path, ["side:=right"]).find("link").get("name") == "right_base"
    monkeypatch.setitem(__import__("sys").modules, "xacro", None)
    with pytest.raises(MagicError, match=r"ros-jazzy-xacro.*requirements-robot.txt"):
        describe_robot.document(path)
    plain = tmp_path / "plain.urdf"
    plain.write_text('<robot name="r"><!-- <xacro:include/> --><link name="a"/></robot>')
    assert describe_robot.document(plain).find("link").get("name") == "a"
    with pytest.raises(MagicError, match="only a xacro"):
        describe_robot.document(plain, ["a:=b"])


def _importable(name):
    import importlib.util

    return importlib.util.find_spec(name) is not None


def test_the_command_says_what_it_found_and_what_is_wrong(tmp_path, capsys):
    path = six_axis_file(tmp_path)
    assert (
        describe_robot.main(
            [str(path), "--tip-at", "flange", "0", "0", "0.12", "0", "0", "0", "--samples", "100", "--out", str(tmp_path / "out")]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "6 joints" in out and "100.0 mm open, closes along x of magic_tip" in out and "robot_params:=" in out
    assert describe_robot.main([str(path), "--tip", "nothing", "--out", str(tmp_path / "out")]) == 1
    assert "nothing" in capsys.readouterr().err
    assert describe_robot.main([str(tmp_path / "none.urdf"), "--tip", "tip"]) == 1
    for wrong in ("--samples=0", "--samples=-5"):  # which would leave no pair to be checked
        assert describe_robot.main([str(path), "--tip", "tip", wrong, "--out", str(tmp_path / "never")]) == 1
        assert "--samples" in capsys.readouterr().err and not (tmp_path / "never").exists()
