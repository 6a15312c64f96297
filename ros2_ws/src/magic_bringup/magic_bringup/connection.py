"""A node that asks the others of a live graph, for the commands of a terminal."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from magic_core import qos
from magic_core.errors import Code, MagicError
from magic_core.executor import ThreadedExecutor
from magic_interfaces.msg import SceneObjectArray
from magic_server.remote import RemoteAction, RemoteService, Token


class Client:
    """A node that asks the others; spins in a thread of its own."""

    def __init__(self, arguments: Sequence[str] | None) -> None:
        self.context = rclpy.Context()
        rclpy.init(
            args=None if arguments is None else list(arguments), context=self.context, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = Node("magic", context=self.context)
        self.token = Token()
        self.group = ReentrantCallbackGroup()
        self._executor = ThreadedExecutor(2, context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def action(self, kind: Any, name: str, server: str) -> RemoteAction:
        return RemoteAction(self.node, kind, name, server, self.group)

    def service(self, kind: Any, name: str, server: str) -> RemoteService:
        return RemoteService(self.node, kind, name, server, self.group)

    def objects(self, timeout: float) -> Any:
        """The newest ``objects`` message; raises NO_FRAMES where none comes within ``timeout`` seconds."""
        came: list[Any] = []
        self.node.create_subscription(SceneObjectArray, "objects", lambda m: (came.append(m), self.token.poke()), qos.LATCHED)
        topic = self.node.resolve_topic_name("objects")
        if not self.token.wait(lambda: bool(came), time.monotonic() + timeout):
            count = self.node.count_publishers("objects")
            raise MagicError(Code.NO_FRAMES, f"nothing came on {topic} within {timeout:g} s; it has {count} publishers")
        return came[-1]

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self._thread.join(2.0)


@contextlib.contextmanager
def connected(arguments: Sequence[str] | None) -> Iterator[Client]:
    """A client that is closed whatever happens."""
    client = Client(arguments)
    try:
        yield client
    finally:
        client.close()
