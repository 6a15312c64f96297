"""A planner node, a client of its action and goals for it, for the tests over ROS."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import planner_scenes as scenes

from magic_core import strategy as strategies

DEADLINE = 20.0


@contextmanager
def planner(folder, **parameters) -> Iterator:
    """An action client of a planner node, both in a domain of their own, that has the strategy ``pulling``; folder: where that may
    be written."""
    import rclpy
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.parameter import Parameter

    from magic_core.actions import ActionClient
    from magic_core.domain import free_domain
    from magic_interfaces.action import PlanMotion
    from magic_planner.node import PlannerNode

    strategies.save(scenes.pulling(), folder / "pulling")
    rclpy.init(domain_id=free_domain())
    given = {"strategies": str(folder), **parameters}
    node = PlannerNode(parameter_overrides=[Parameter(name, value=value) for name, value in given.items()])
    user = rclpy.create_node("user")
    client = ActionClient(user, PlanMotion, "plan_motion")
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    executor.add_node(user)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    assert client.wait_for_server(DEADLINE)
    yield client
    executor.shutdown(timeout_sec=2.0)
    client.destroy()
    node.destroy_node()
    user.destroy_node()
    rclpy.try_shutdown()
    thread.join(5.0)


def goal(tool=None, target=None, **changes):
    """A goal that can be planned, with some of it exchanged."""
    from magic_core import conversions as convert
    from magic_interfaces.action import PlanMotion

    lying, tool_contact = scenes.hook()
    standing, target_contact = scenes.standing_cylinder()
    head = convert.header("panda_link0")
    message = PlanMotion.Goal(strategy="pulling", variant="arm", reflection="keep", timeout=10.0)
    message.tool = convert.object_to_msg(tool or lying, head)
    message.target = convert.object_to_msg(target or standing, head)
    message.candidate = convert.candidate_to_msg(scenes.candidate(lying, tool_contact, target_contact))
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def wait(future):
    """The result of a future; fails after DEADLINE."""
    end = time.monotonic() + DEADLINE
    while not future.done():
        assert time.monotonic() < end, "no answer"
        time.sleep(0.002)
    return future.result()


def ask(client, message, feedback=None):
    """The result of a goal."""
    handle = wait(client.send_goal_async(message, feedback_callback=feedback))
    assert handle.accepted
    return wait(handle.get_result_async()).result
