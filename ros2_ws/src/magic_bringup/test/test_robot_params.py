"""The one file that says which robot there is."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml

from magic_core.robot import RobotConfig

SHARE = Path(__file__).resolve().parents[1]


def test_it_holds_the_defaults():
    content = yaml.safe_load((SHARE / "config/robot.param.yaml").read_text())
    given = content["/**"]["ros__parameters"]["robot"]
    default = vars(RobotConfig())
    assert set(given) == set(default)
    for name, value in given.items():
        assert value == (pytest.approx(default[name]) if isinstance(value, list) else default[name]), name


def test_every_node_that_knows_the_robot_gets_it_after_its_own_file():
    root = ElementTree.parse(SHARE / "launch/magic.launch.xml").getroot()
    files = {node.get("exec"): [p.get("from") for p in node.iter("param") if p.get("from")] for node in root.iter("node")}
    for name in ("perception", "planner", "verifier", "strategy_server"):
        # After these come what launch arguments say, where they are given.
        assert files[name][1] == "$(var robot_params)"
        assert all(file.endswith("_file)") for file in files[name][2:])
