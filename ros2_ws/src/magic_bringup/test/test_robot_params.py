"""The one file that says which robot there is."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.parameter import Parameter

from magic_core.node import robot_parameters
from magic_core.presets import PRESETS
from magic_core.robot import RobotConfig
from magic_server import settings

SHARE = Path(__file__).resolve().parents[1]


def test_the_gripper_is_told_the_force_that_was_planned_and_verified_with():
    """A motion that was verified with a firmer grip than the hand is told would slip."""
    from magic_server.arm import ArmSettings

    root = SHARE.parents[2]
    planner = yaml.safe_load((root / "magic_planner/config/planner.param.yaml").read_text())["/**"]["ros__parameters"]
    verifier = yaml.safe_load((root / "magic_verifier/config/verifier.param.yaml").read_text())["/**"]["ros__parameters"]
    assert planner["grasp"]["grip_force"] == verifier["arm"]["grip_force"] == ArmSettings.effort


def test_it_holds_the_defaults():
    """What is set and what is only shown, which a preset would otherwise not get past."""
    text = (SHARE / "config/robot.param.yaml").read_text()
    default = vars(RobotConfig())
    shown = yaml.safe_load(re.sub(r"^      # (\w+:)", r"      \1", text, flags=re.MULTILINE))["/**"]["ros__parameters"]["robot"]
    assert set(shown) == set(default)
    for name, value in shown.items():
        assert value == (pytest.approx(default[name]) if isinstance(value, list) else default[name]), name
    assert set(yaml.safe_load(text)["/**"]["ros__parameters"]["robot"]) == {"preset", "urdf", "srdf", "package_root", "base_frame"}


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_what_every_node_reads(name, ros):
    """Through the parameters, with one of them given besides; and the server's actions are the driver's."""
    given = [Parameter("robot.preset", value=name), Parameter("robot.opening", value=0.07)]
    node = rclpy.create_node("some_node", context=ros, parameter_overrides=given)
    try:
        config = RobotConfig(**robot_parameters(node))
        for key in ("move_group", "home", "acceleration", "jerk", "closing_axis"):
            assert getattr(config, key) == pytest.approx(getattr(PRESETS[name].config, key)), key
        assert (config.preset, config.opening) == (name, 0.07)
        assert settings.read(node, name).trajectory_action == PRESETS[name].trajectory_action
    finally:
        node.destroy_node()


@pytest.fixture
def ros():
    context = Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def test_every_node_that_knows_the_robot_gets_it_after_its_own_file():
    root = ElementTree.parse(SHARE / "launch/magic.launch.xml").getroot()
    files = {node.get("exec"): [p.get("from") for p in node.iter("param") if p.get("from")] for node in root.iter("node")}
    for name in ("perception", "planner", "verifier", "strategy_server"):
        # After these come what launch arguments say, where they are given.
        assert files[name][1] == "$(var robot_params)"
        assert all(file.endswith("_file)") for file in files[name][2:])
