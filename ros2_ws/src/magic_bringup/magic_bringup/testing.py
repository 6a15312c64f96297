"""The whole graph in tests: five real processes in a ROS domain of their own, fed from recorded bags or from changed frames."""

from __future__ import annotations

import copy
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from magic_bags import bag_messages
from magic_bringup.demo import Options, Watcher, look_into
from magic_bringup.graph import Graph
from magic_core import qos
from magic_core.domain import isolated

#: Longest wait for anything in these tests, s; a machine with two busy cores starts the graph in less than half of it.
DEADLINE = 90.0
#: Parameters of a strategy server with which a motion is simulated once, in the scene as given: for tests of what comes before and after.
ONCE = {"repetitions": 1, "required_rate": 0.0}


def until(condition: Callable[[], Any], timeout: float = DEADLINE, what: str = "") -> Any:
    """The condition's first true value; fails at the deadline."""
    deadline = time.monotonic() + timeout
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline, f"not within {timeout} s: {what}"
        time.sleep(0.02)


class Bench:
    """A graph with a client: the demo's own watcher, and what a test asks for besides."""

    def __init__(self, graph: Graph, watcher: Watcher) -> None:
        self.graph = graph
        self.watcher = watcher
        self.lines: list[str] = []
        self._codes: dict[str, tuple[int, str]] = {}
        watcher.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for item in status.values:
                if item.key == "code":
                    self._codes[status.name] = int(item.value), status.message

    def diagnosed(self, code: int, says: tuple[str, ...] = ()) -> None:
        """Wait until one of perception's diagnostics has this code and says all this."""

        def named() -> bool:
            return any(c == code and all(s in message for s in says) for c, message in list(self._codes.values()))

        try:
            until(named)
        except AssertionError as error:
            raise AssertionError(f"no diagnostic with code {int(code)} and {says}, but {self._codes}") from error

    def ready(self, wanted: tuple[str, ...] = ()) -> None:
        """Wait for the nodes (all of them, or the named ones)."""

        def up() -> bool:
            self.graph.check()
            missing = self.watcher.ready()
            return not [n for n in missing if not wanted or n in wanted]

        until(up, what="the graph is up")

    def play(self, bag: Path) -> None:
        """Replay a bag until objects have been seen."""
        player = self.graph.start("bag_player", "magic_bringup", "bag_player", str(bag), "--loop", "--delay", "0.7")

        def seen() -> bool:
            self.graph.check()
            assert player.status is None, player.tail()
            return self.watcher.objects_at is not None

        until(seen, what="objects are published")
        self.graph.stop(["bag_player"])

    def run(self, timeout: float = 2 * DEADLINE, **goal: Any) -> Any:
        """The result of one run of a strategy."""
        options = Options(**{"strategy": "hooking", "variant": "fg", "bag": Path(), "out": Path(), "timeout": 150.0, **goal})
        pending = self.watcher.send(options)

        def answered() -> bool:
            return pending.result is not None

        until(answered, timeout, "the strategy server answers")
        return pending.result


@contextmanager
def started(
    logs: Path, bag: Path | None = None, parameters: dict[str, dict[str, object]] | None = None, leave_out: tuple[str, ...] = ()
) -> Iterator[Bench]:
    """A graph in a domain of its own; everything is stopped in the end.

    Its strategy server is told that it sees a recording, unless it is to move an arm.
    """
    server = (parameters or {}).get("strategy_server", {})
    parameters = {**(parameters or {}), "strategy_server": {"recorded": not server.get("execute", False), **server}}
    env = isolated()
    before = {k: os.environ.get(k) for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
    os.environ.update({k: env[k] for k in before})
    lines: list[str] = []
    try:
        with Graph(logs, env) as graph:
            graph.start_nodes(parameters, leave_out)
            watcher = Watcher(look_into(bag)[0] if bag is not None else (), lines.append)
            try:
                bench = Bench(graph, watcher)
                bench.lines = lines
                yield bench
            finally:
                watcher.close()
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def first_messages(bag: Path) -> dict[str, Any]:
    """The first message of every topic of a bag, decoded."""
    found: dict[str, Any] = {}
    for topic, _, message in bag_messages.messages(bag, lambda topic, _: topic not in found):
        found[topic] = message
    return found


class Feed(Node):
    """Publishes one set of messages again and again at 5 Hz with growing stamps, changed as a test wants.

    ``change(topic, message)`` gets a copy and returns what is to be sent; ``None``: nothing.
    """

    def __init__(self, messages: dict[str, Any], change: Callable[[str, Any], Any]) -> None:
        super().__init__("feed")
        self._out = []
        for topic, message in messages.items():
            changed = change(topic, copy.deepcopy(message))
            if changed is not None:
                latched = topic in ("/tf_static", "/known_objects")
                profile = qos.STATIC_TF if latched else qos.RELIABLE
                self._out.append((topic, changed, self.create_publisher(type(changed), topic, profile), latched))
        for _, message, publisher, latched in self._out:
            if latched:
                publisher.publish(message)
        self.create_timer(0.2, self._tick)

    def _tick(self) -> None:
        now = self.get_clock().now().to_msg()
        for _, message, publisher, latched in self._out:
            if not latched:
                if hasattr(message, "header"):
                    message.header.stamp = now
                publisher.publish(message)


@contextmanager
def feeding(messages: dict[str, Any], change: Callable[[str, Any], Any] = lambda topic, message: message) -> Iterator[Feed]:
    """A feed, spun in a thread on the running context."""
    feed = Feed(messages, change)
    executor = SingleThreadedExecutor()
    executor.add_node(feed)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    try:
        yield feed
    finally:
        executor.shutdown(timeout_sec=2.0)
        feed.destroy_node()
        thread.join(2.0)


def camera_messages(meshes: list[Any], names: tuple[str, ...] = ("left", "right"), seed: int = 0) -> dict[str, Any]:
    """What D435 cameras that look at meshes (world coordinates) on the table publish: topic -> message."""
    from geometry_msgs.msg import TransformStamped
    from tf2_msgs.msg import TFMessage

    from magic_core import conversions, sensor

    messages: dict[str, Any] = {}
    static = TFMessage()
    caster = sensor.scene_raycaster(meshes)
    for index, name in enumerate(names):
        pose = sensor.looking_at([0.1, 0.45 if index == 0 else -0.45, 0.65], [0.5, 0.0, 0.0])
        frame = sensor.capture(meshes, sensor.D435, pose, (seed, index), camera=name, raycaster=caster)
        messages.update({f"/camera/{name}/{topic}": message for topic, message in conversions.frame_to_msgs(frame).items()})
        static.transforms.append(
            TransformStamped(
                header=conversions.header("panda_link0"),
                child_frame_id=f"{name}_color_optical_frame",
                transform=conversions.transform_to_msg(pose),
            )
        )
    return {"/tf_static": static, **messages}
