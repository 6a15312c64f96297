"""A topic that is heard in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile

#: A wait ends after so long, s: whether the node is still there is asked again.
AWHILE = 0.2

_hearing: list[threading.Thread] = []


class _Apart(CallbackGroup):
    """What no executor takes."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        pass


def listen_apart(node: Node, kind: type, topic: str, callback: Callable[[Any], None], qos: QoSProfile) -> None:
    """Subscribe, and have ``callback`` called in a thread of its own, with one message after the other, until the node is destroyed.

    rclpy's executors list and wait for all that a node has anew for each message, which with joint states at 100 Hz and some twenty
    entities takes a fifth of a core.  What comes out of the callback is logged.
    """
    subscription = node.create_subscription(kind, topic, callback, qos, callback_group=_Apart())

    def take() -> None:
        """Wait once, and hand over what there is."""
        with ExitStack() as held:
            held.enter_context(subscription.handle)
            held.enter_context(node.context.handle)
            waits = _rclpy.WaitSet(1, 0, 0, 0, 0, 0, node.context.handle)
            waits.clear_entities()
            waits.add_subscription(subscription.handle)
            waits.wait(int(AWHILE * 1e9))
            while (found := subscription.handle.take_message(kind, False)) is not None:
                try:
                    callback(found[0])
                except Exception as error:
                    node.get_logger().error(f"{topic}: {type(error).__name__}: {error}", throttle_duration_sec=5.0)

    def hear() -> None:
        while node.context.ok():
            try:
                take()
            except (InvalidHandle, _rclpy.RCLError):  # the node, or ROS, has ended
                return

    thread = threading.Thread(target=hear, name=f"hears {topic}", daemon=True)
    _hearing.append(thread)
    thread.start()


def join_all() -> None:
    """Wait for the threads of nodes that have been destroyed: what they wait in must not be unloaded under them."""
    while _hearing:
        _hearing.pop().join(5 * AWHILE)
