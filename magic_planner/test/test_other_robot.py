"""Another arm with another gripper, by configuration alone, plans through the same code."""

from __future__ import annotations

import os

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import dataclasses

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import interpolation, transforms
from magic_core.errors import Code, MagicError
from magic_core.joint_limits import PUBLISHED
from magic_core.presets import PRESETS
from magic_core.robot import Description
from magic_core.testing import six_axis
from magic_planner.arm import ArmPlanner
from magic_planner.object_motion import plan_tool_motion
from magic_planner.request import Problem
from magic_planner.robot import Robot


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return six_axis.describe(tmp_path_factory.mktemp("six_axis"))


@pytest.fixture(scope="module")
def planner(config):
    planner = ArmPlanner(Robot(config))
    planner.warm_up()
    return planner


def test_its_description_is_understood(planner):
    robot = planner.robot
    assert robot.count == 6 and robot.chain.names == tuple(f"joint_{name}" for name, *_ in six_axis.JOINTS)
    assert set(robot.finger_links) == {"left_finger", "right_finger"}
    assert robot.tip_reach == pytest.approx(0.01, abs=1e-6)  # fingers of 60 mm from 70 mm on, the tip at 120 mm
    assert robot.pad_half_width == pytest.approx(0.011, abs=1e-6)
    robot.open_to(0.1)
    gap = min(np.abs(robot.hand[name].vertices[:, 0]).min() for name in robot.finger_links)
    assert gap == pytest.approx(0.05, abs=1e-6)
    assert robot.collision(robot.home) is None


def test_it_pulls_with_the_hook(planner):
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder(at=(0.72, 0.0))
    strategy, candidate = scenes.pulling(), scenes.candidate(tool, tool_contact, target_contact)
    motion = plan_tool_motion(strategy, tool, target, candidate)
    plan = planner.solve(Problem(strategy, tool, target, candidate, "keep", motion))
    arm, chain = plan.arm_motion, planner.robot.chain
    assert arm.joint_names == chain.names and arm.positions.shape[1] == 6
    assert np.all(arm.positions >= chain.lower) and np.all(arm.positions <= chain.upper)
    assert np.all(np.abs(arm.velocities) <= planner.robot.limits.velocity * 1.001)
    held = arm.times >= arm.grasp_time
    tips = chain.forward(arm.positions[held])
    expected = plan.tool_motion.world_from_tool[held] @ arm.tool_from_tcp
    assert np.linalg.norm(tips[:, :3, 3] - expected[:, :3, 3], axis=1).max() < 1e-3
    np.testing.assert_allclose(plan.tool_motion.world_from_tool[-1], motion.world_from_tool[-1], atol=1e-3)
    # The fingers close along x of the tip, across the tool's handle.
    across = arm.tool_from_tcp[:3, 0]
    assert abs(across[1]) > 0.9 or abs(across[2]) > 0.9
    assert 0.01 < arm.grasp_width < 0.1
    again = planner.solve(Problem(strategy, tool, target, candidate, "keep", motion))
    np.testing.assert_array_equal(arm.positions, again.arm_motion.positions)


def test_a_wider_gripper_takes_what_a_narrow_one_cannot(planner, config):
    tool, _ = scenes.hook()
    block = scenes.item("tool", [scenes.box([0.3, 0.085, 0.085])], transforms.make(translation=[0.45, 0.25, 0.0425]), scenes.DOWN)
    target, target_contact = scenes.standing_cylinder(at=(0.72, 0.0))
    candidate = scenes.candidate(tool, scenes.contact(scenes.DOWN, [-0.15, 0, 0], [-1, 0, 0]), target_contact)
    strategy = scenes.pulling()
    motion = plan_tool_motion(strategy, block, target, candidate)
    narrow = ArmPlanner(Robot(dataclasses.replace(config, opening=0.08)))
    with pytest.raises(MagicError) as refused:
        narrow.solve(Problem(strategy, block, target, candidate, "keep", motion))
    assert refused.value.code == Code.NO_GRASP and "0.074" in refused.value.message
    try:
        plan = planner.solve(Problem(strategy, block, target, candidate, "keep", motion))
        assert plan.arm_motion.grasp_width == pytest.approx(0.085, abs=1e-3)
    except MagicError as error:
        assert "apart" not in error.message, "it is not the width that stops the wide one"


def test_the_node_takes_it_by_its_parameters(config, tmp_path):
    pytest.importorskip("rclpy")
    from planner_graph import goal
    from planner_graph import planner as node

    from magic_core.testing.served import ask

    given = {
        f"robot.{name}": value if not isinstance(value, tuple) else list(value)
        for name, value in vars(config).items()
        if name in ("urdf", "srdf", "move_group", "closing_axis", "opening", "home", "acceleration")
    }
    given["robot.base_frame"] = "panda_link0"  # what the goal's objects call the root of any arm
    with node(tmp_path, **given) as client:
        result = ask(client, goal(target=scenes.standing_cylinder(at=(0.72, 0.0))[0]))
        assert result.code == Code.OK, result.message
        assert list(result.plan.arm_trajectory.joint_names) == [f"joint_{name}" for name, *_ in six_axis.JOINTS]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"move_group": "elsewhere"}, "tip link"),
        ({"home": (0.0, 0.0)}, "home"),
        ({"acceleration": (1.0, 2.0)}, "acceleration"),
        ({"urdf": "nowhere.urdf"}, "URDF"),
        ({"srdf": "nowhere.srdf"}, "SRDF"),
        ({"closing_axis": "z"}, "closing axis"),
        ({"opening": 2.0}, "opening"),
        ({"velocity_scale": 0.0}, "velocity_scale"),
    ],
)
def test_what_is_wrong_with_a_configuration_is_said(config, change, words):
    with pytest.raises(MagicError) as error:
        Robot(dataclasses.replace(config, **change))
    assert error.value.code == Code.BAD_REQUEST
    assert words in error.value.message


def test_the_preset_of_an_fr3_plans_within_its_limits():
    """With the Panda's description, whose links are the same: what the preset publishes is narrower in places, and is kept."""
    panda = Description()
    files = {"urdf": str(panda.urdf), "srdf": str(panda.srdf), "move_group": panda.config.move_group}
    planner = ArmPlanner(Robot(dataclasses.replace(PRESETS["fr3"].config, **files)))
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder(at=(0.62, 0.0))
    strategy, candidate = scenes.pulling(), scenes.candidate(tool, tool_contact, target_contact)
    plan = planner.solve(Problem(strategy, tool, target, candidate, "keep", plan_tool_motion(strategy, tool, target, candidate)))
    arm, limits = plan.arm_motion, PUBLISHED["fr3"]
    assert np.all(arm.positions >= limits.lower) and np.all(arm.positions <= limits.upper)
    low, high = limits.braking.velocities(arm.positions)
    assert np.all((low - 1e-6 <= arm.velocities) & (arm.velocities <= high + 1e-6))
    fast, strong, sharp = interpolation.extremes(arm.times, arm.positions, arm.velocities, arm.accelerations)
    assert np.all(fast <= 0.31 * np.array(limits.velocity))
    assert np.all(strong <= 0.21 * np.array(limits.acceleration))
    assert np.all(sharp <= 0.06 * np.array(limits.jerk))
