"""The planner node over ROS: an action that answers every goal with a code."""

from __future__ import annotations

import os
import re
import threading

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import planner_scenes as scenes
import pytest
from planner_graph import DEADLINE, goal, planner

from magic_core.errors import Code
from magic_core.testing.served import ask, wait

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("magic_interfaces.action")


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    with planner(tmp_path_factory.mktemp("strategies")) as client:
        yield client


def test_an_arm_motion_comes_with_feedback(graph):
    stages = []
    result = ask(graph, goal(), lambda m: stages.append(m.feedback.stage))
    assert result.code == Code.OK, result.message
    assert result.plan.arm_trajectory.joint_names[0] == "panda_joint1"
    assert result.plan.tool_trajectory.joint_names == ["tool"]
    assert len(result.plan.arm_trajectory.points) == len(result.plan.tool_trajectory.points)
    assert [p.name for p in result.plan.phases][:2] == ["grasp", "transfer"]
    assert result.seconds > 0
    assert {"motion", "grasp", "task"} <= set(stages)


def test_a_floating_motion_is_the_same_as_from_the_core(graph):
    import numpy as np

    from magic_core import conversions as convert
    from magic_planner.object_motion import plan_tool_motion

    result = ask(graph, goal(variant="fg"))
    assert result.code == Code.OK, result.message
    plan = convert.plan_from_msg(result.plan)
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    core = plan_tool_motion(scenes.pulling(), tool, target, scenes.candidate(tool, tool_contact, target_contact))
    np.testing.assert_allclose(plan.tool_motion.world_from_tool, core.world_from_tool, atol=1e-5)  # the strategy went through its files


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"strategy": "dancing"}, Code.UNKNOWN_STRATEGY),
        ({"variant": "leg"}, Code.UNKNOWN_VARIANT),
        ({"reflection": "swap"}, Code.BAD_REQUEST),
        ({"timeout": -1.0}, Code.BAD_REQUEST),
        ({"timeout": float("nan")}, Code.BAD_REQUEST),
        ({"timeout": 0.001}, Code.PLANNING_TIMEOUT),
        ({"variant": "fg", "attempt": 1}, Code.BAD_REQUEST),
    ],
)
def test_a_bad_goal_is_answered_with_its_code(graph, changes, code):
    result = ask(graph, goal(**changes))
    assert result.code == code, result.message
    assert result.message


def test_a_tool_is_as_heavy_as_the_goal_says(graph):
    """What the pads hold of the hook as steel is another share than of it as wood."""
    used = []
    for mass in (0.0, 0.1, 2.0):
        result = ask(graph, goal(tool_mass=mass))
        assert result.code == Code.OK, result.message
        share, grams = re.search(r"grip: (\d+) % of what pads pressed with 60 N hold of (\d+) g", result.message).groups()
        assert mass == 0 or float(grams) == 1000 * mass
        used.append(int(share))
    assert used[0] <= used[1] < 20 < used[2]
    wrong = ask(graph, goal(tool_mass=100.0))  # grams
    assert wrong.code == Code.BAD_REQUEST and "kg/m^3" in wrong.message
    assert ask(graph, goal(target_mass=-1.0)).code == Code.BAD_REQUEST


def test_empty_messages_are_answered_too(graph):
    from magic_interfaces.action import PlanMotion

    result = ask(graph, PlanMotion.Goal(strategy="pulling", variant="fg"))
    assert result.code not in (Code.OK, Code.INTERNAL), result.message
    twice = goal()
    twice.obstacles = [twice.target]
    assert ask(graph, twice).code == Code.BAD_REQUEST


def test_a_start_in_another_order_is_understood_and_an_incomplete_one_refused(graph):
    from magic_core.robot import PANDA_HOME

    message = goal()
    message.start.name = ["panda_finger_joint1", *(f"panda_joint{i}" for i in range(7, 0, -1))]
    message.start.position = [0.04, *PANDA_HOME[::-1]]
    assert ask(graph, message).code == Code.OK
    message.start.name = ["panda_joint1"]
    message.start.position = [0.0]
    result = ask(graph, message)
    assert result.code == Code.BAD_REQUEST and "panda_joint2" in result.message


def test_a_second_goal_is_refused_and_the_first_can_be_cancelled(graph):
    message = goal(timeout=10.0)
    started = threading.Event()
    first = wait(graph.send_goal_async(message, feedback_callback=lambda m: started.set()))
    assert started.wait(DEADLINE)
    second = wait(graph.send_goal_async(goal()))
    pending = second.get_result_async()
    wait(first.cancel_goal_async())
    answer = wait(first.get_result_async()).result
    assert answer.code in (Code.CANCELED, Code.OK)  # OK where the plan was there before the request
    assert wait(pending).result.code in (Code.BUSY, Code.OK)
    assert ask(graph, goal()).code == Code.OK  # nothing is left running
