"""Hammering and sweeping: the demonstration does its task, and what drives a peg is the tool's momentum."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("magic_planner.object_motion")

from magic_bringup import striking
from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.shapes import make
from magic_planner.object_motion import plan_tool_motion
from magic_verifier import evaluate as ev
from magic_verifier.cases import Options, all_cases, tool_names
from magic_verifier.subjects import scene_for
from magic_verifier.verification import Proposal, verify_proposal

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")


def shown(name, repetitions=1, tool=None, contact=None, **physics):
    """The verdict on a strategy with its own tool, or another with that contact, in the demonstrated scene."""
    strategy = striking.STRATEGIES[name]()
    strategy = replace(strategy, physics=replace(strategy.physics, **physics))
    target, obstacles, _ = scene_for(strategy, "demonstration")
    tool = tool or make("mallet", 0, **striking.REFERENCE)
    item = tool.as_object("tool", transforms.make(translation=[0.4, -0.3, 0.02]))
    candidate = ContactCandidate("tool", contact or strategy.tool_contact, strategy.target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4))
    motion = plan_tool_motion(strategy, item, target, candidate, "keep", ev.TABLE, obstacles)
    return verify_proposal(Proposal(strategy, item, target, obstacles, ev.TABLE, MotionPlan("fg", motion)), repetitions=repetitions)


@pytest.mark.parametrize("name", ["hammering", "sweeping"])
def test_the_demonstration_does_its_task_whatever_is_drawn(name):
    verdict = shown(name, repetitions=0)
    assert verdict.success, verdict.message
    assert verdict.code == Code.OK


def test_a_heavier_mallet_drives_deeper_and_one_of_foam_does_not():
    heavy, foam = shown("hammering", tool_density=4500.0), shown("hammering", tool_density=100.0)
    assert heavy.metrics["depth"] > 1.5 * shown("hammering").metrics["depth"]
    assert foam.code == Code.GOAL_NOT_REACHED
    assert foam.metrics["depth"] < 0.002


def test_the_blow_does_not_outlast_the_momentum():
    """A tool on rails would drive the peg by the follow-through, 0.1 m, whatever it weighs."""
    strategy = striking.hammering()
    depth = shown("hammering").metrics["depth"]
    tool = make("mallet", 0, **striking.REFERENCE)
    mass = strategy.physics.tool_density * tool.mesh.to_trimesh().volume
    speed = striking.RADIUS * striking.TURNING
    # No more than all of the tool's energy against the resistance.
    assert 0 < depth < 0.5 * mass * speed**2 / 8.0


def test_a_tool_on_rails_is_no_blow(monkeypatch):
    strategy = striking.hammering()
    held = replace(strategy, waypoints=tuple(replace(w, phase=w.phase.replace("strike", "goal")) for w in strategy.waypoints))
    monkeypatch.setitem(striking.STRATEGIES, "hammering", lambda: held)
    verdict = shown("hammering")
    assert verdict.code == Code.BAD_STRATEGY
    assert "strike" in verdict.message


def test_a_tool_too_short_for_the_row_leaves_some_behind():
    plank = make("mallet", 0, **{**striking.REFERENCE, "handle": 0.24})
    face = plank.contact("face", plank.view("top"))  # 32 mm wide: the row is 140
    verdict = shown("sweeping", tool=plank, contact=face)
    assert verdict.code == Code.GOAL_NOT_REACHED
    assert verdict.metrics["swept"] < 3


def test_the_sets_hold_every_kind_and_only_the_floating_gripper_does_them():
    hammers = {
        name.split(":")[0] + name.partition(",")[2] for name in tool_names(Options("hammering", set="hammers", strategies=STRATEGIES))
    }
    assert hammers == {"malletform=T", "malletform=L", "malletform=X", "hammer"}
    assert not hammers & {name.split(":")[0] for name in tool_names(Options("hammering", set="non_hammers", strategies=STRATEGIES))}
    for wrong in (Options("hammering", "arm"), Options("sweeping", source="images"), Options("hooking", set="hammers")):
        wrong = replace(wrong, strategies=STRATEGIES)
        with pytest.raises(MagicError) as error:
            all_cases(wrong)
        assert error.value.code == Code.BAD_REQUEST
