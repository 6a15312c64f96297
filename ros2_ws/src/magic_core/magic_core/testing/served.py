"""A node that serves an action, a client of it, and answers that are waited for, for the tests over ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from magic_core.domain import free_domain

#: Seconds in which a node offers its action.
STARTING = 20.0


@contextmanager
def served(node_type: Callable[..., Any], action: Any, name: str, parameters: Mapping[str, Any]) -> Iterator[Any]:
    """A client of the action ``name`` of a node that was started with these parameters, both in a ROS domain of their own."""
    import rclpy
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.parameter import Parameter

    from magic_core.actions import ActionClient

    rclpy.init(domain_id=free_domain())
    node = node_type(parameter_overrides=[Parameter(key, value=value) for key, value in parameters.items()])
    peer = rclpy.create_node("peer")
    client = ActionClient(peer, action, name)
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    executor.add_node(peer)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        assert client.wait_for_server(timeout_sec=STARTING)
        yield client
    finally:
        executor.shutdown(timeout_sec=5)
        thread.join(timeout=5)
        client.destroy()
        node.destroy_node()
        peer.destroy_node()
        rclpy.try_shutdown()


def wait(future: Any, seconds: float = 30.0) -> Any:
    """The result of a future; fails after so many seconds."""
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(seconds), f"no answer within {seconds} s"
    return future.result()


def ask(client: Any, goal: Any, feedback: Callable[[Any], None] | None = None) -> Any:
    """The result of a goal that has to be accepted."""
    handle = wait(client.send_goal_async(goal, feedback_callback=feedback))
    assert handle.accepted
    return wait(handle.get_result_async()).result
