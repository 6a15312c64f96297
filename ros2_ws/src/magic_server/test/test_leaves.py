"""The leaves of a behaviour tree, against stand-ins of the servers."""

import threading
import time

import numpy as np
import pytest

py_trees = pytest.importorskip("py_trees")

import rclpy
from rclpy.executors import MultiThreadedExecutor

from magic_core import conversions
from magic_core.errors import Code
from magic_interfaces.action import VerifyMotion
from magic_server import leaves
from magic_server.testing import fakes

Status = py_trees.common.Status


@pytest.fixture
def graph():
    """A node for the leaves and stand-ins of matcher, planner and verifier, which spin in a thread."""
    rclpy.init()
    node, servers = rclpy.create_node("tree"), fakes.FakeServers()
    executor = MultiThreadedExecutor(4)
    for each in (node, servers):
        executor.add_node(each)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    py_trees.blackboard.Blackboard.clear()
    yield node, servers
    executor.shutdown(timeout_sec=2.0)
    thread.join(timeout=5.0)
    for each in (node, servers):
        each.destroy_node()
    rclpy.try_shutdown()


def tick(leaf, until=lambda status: status is not Status.RUNNING, seconds=20.0):
    deadline = time.monotonic() + seconds
    while True:
        leaf.tick_once()
        if until(leaf.status):
            return leaf.status
        assert time.monotonic() < deadline, leaf.feedback_message
        time.sleep(0.01)


def board(key):
    return py_trees.blackboard.Blackboard.get(f"/magic/{key}")


def set_up(leaf, node):
    for each in leaf.iterate():
        each.setup(node=node)
    return leaf


def test_the_stages_in_a_row_hand_on_what_they_found(graph):
    node, servers = graph
    row = set_up(leaves.stages_in_a_row("fake", "fg", target_id="object_2"), node)
    servers.publish(fakes.scene())
    assert tick(row) is Status.SUCCESS
    assert [name for name, _ in servers.goals] == ["match", "plan_motion", "verify_motion"]
    assert board("candidates")[0].tool_id == "object_1" and board("plan").variant == "fg"
    for leaf in ("objects", "match", "plan", "verify"):
        assert board(f"{leaf}/code") == Code.OK
    assert board("verify/result").rollouts == 1
    planned, verified = servers.goals[1][1], servers.goals[2][1]
    assert (planned.tool.id, planned.target.id, planned.obstacles) == ("object_1", "object_2", [])
    np.testing.assert_array_equal(*(conversions.plan_from_msg(p).tool_motion.world_from_tool for p in (verified.plan, board("plan"))))


def test_a_stage_that_fails_ends_the_row_with_its_code(graph):
    node, servers = graph
    servers.on_verify = lambda goal, canceled: VerifyMotion.Result(code=int(Code.DRIFT), message="drifted")
    row = set_up(leaves.stages_in_a_row("fake", "fg", target_id="object_2"), node)
    servers.publish(fakes.scene())
    assert tick(row) is Status.FAILURE
    assert (board("verify/code"), board("verify/message")) == (Code.DRIFT, "drifted")
    # An answer that is no error and no success either is none to go on with.
    servers.on_verify = lambda goal, canceled: VerifyMotion.Result(code=0, success=False)
    assert tick(row) is Status.FAILURE
    assert board("verify/code") == Code.GOAL_NOT_REACHED


def test_a_leaf_that_is_interrupted_cancels_what_it_asked_for(graph):
    node, servers = graph
    servers.on_verify = servers.until_canceled(VerifyMotion.Result())
    row = set_up(leaves.stages_in_a_row("fake", "fg", target_id="object_2"), node)
    servers.publish(fakes.scene())
    tick(row, lambda status: any(name == "verify_motion" for name, _ in servers.goals))
    row.stop(Status.INVALID)
    deadline = time.monotonic() + 10.0
    while servers.canceled_goals != ["verify_motion"]:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_what_is_not_there_is_said(graph):
    node, _servers = graph
    nobody = set_up(leaves.RunStrategyLeaf(timeout=0.2, strategy="fake", variant="fg"), node)
    assert tick(nobody) is Status.FAILURE
    assert board("run_strategy/code") == Code.SERVER_UNAVAILABLE
    objects = set_up(leaves.ObjectsLeaf(timeout=0.2), node)
    assert tick(objects) is Status.FAILURE and board("objects/code") == Code.NO_OBJECTS
    alone = set_up(leaves.PlanLeaf("fake", "fg"), node)
    assert tick(alone) is Status.FAILURE
    assert board("plan/code") == Code.BAD_REQUEST and "scene" in board("plan/message")
    with pytest.raises(KeyError, match="node"):
        leaves.ObjectsLeaf().setup()
