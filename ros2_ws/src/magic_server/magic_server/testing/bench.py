"""The strategy server among stand-ins of the other nodes, for tests."""

import threading
import time
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from magic_core import qos
from magic_core.actions import ActionClient
from magic_core.domain import free_domain
from magic_core.executor import ThreadedExecutor
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import VerifiedMotion
from magic_server.strategy_server import StrategyServer
from magic_server.testing import fakes

#: s; what has not come by then does not come.
DEADLINE = 60.0


class Bench:
    """The server, the stand-ins and a client, spun by one executor in a thread."""

    def __init__(self, folder, services=("match", "plan", "verify"), **parameters):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=free_domain())  # two benches may be open at once
        values = {
            "strategies": str(folder),
            "server_timeout": 2.0,
            "objects_timeout": 1.0,
            "grace": 0.5,
            "objects_age": 600.0,
            **parameters,
        }
        arguments = ["--ros-args"] + [x for k, v in values.items() for x in ("-p", f"{k}:={str(v).lower() if isinstance(v, bool) else v}")]
        original = Node.__init__
        context = self.context

        # The server takes no arguments, as a node started by its executable; give it this test's context and parameters.
        def init(node, *args, **kwargs):
            original(node, *args, **{**kwargs, "context": context, "cli_args": arguments})

        Node.__init__ = init  # type: ignore[method-assign,assignment]
        try:
            self.server = StrategyServer()
        finally:
            Node.__init__ = original  # type: ignore[method-assign]
        self.fakes = fakes.FakeServers(services=(*services, "objects"), context=context)
        self.node = Node("client", context=context)
        self.client = ActionClient(self.node, RunStrategy, "run_strategy")
        self.feedback = []
        self.heard = threading.Condition()
        self.messages: dict[str, list[Any]] = {"arm": [], "tool": [], "markers": [], "state": [], "frames": []}
        self.valid = dict.fromkeys(("arm", "tool"))  # the trajectories that have not been taken back
        topics: tuple[tuple[str, Any, str], ...] = (
            ("arm", JointTrajectory, "verified_trajectory"),
            ("tool", MultiDOFJointTrajectory, "verified_tool_trajectory"),
            ("markers", MarkerArray, "strategy/markers"),
            ("state", VerifiedMotion, "verified_motion"),
            ("frames", TFMessage, "/tf_static"),
        )
        for key, kind, topic in topics:
            self.node.create_subscription(kind, topic, partial(self._hear, key), qos.LATCHED)
        self.diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.executor = ThreadedExecutor(8, context=context)
        for node in (self.server, self.fakes, self.node):
            self.executor.add_node(node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()
        assert self.client.wait_for_server(DEADLINE)

    def _hear(self, key, message):
        with self.heard:
            if key in self.valid:
                self.valid[key] = message if message.points else None
            if key not in self.valid or message.points:
                self.messages[key].append(message)
            self.heard.notify_all()

    def wait(self, condition, timeout=DEADLINE):
        with self.heard:
            assert self.heard.wait_for(condition, timeout)

    def until(self, condition, timeout=DEADLINE):
        """Wait for what gives no event here."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def send(self, **goal):
        goal = {"strategy": "fake", "variant": "fg", "target_id": "object_2", **goal}
        future = self.client.send_goal_async(RunStrategy.Goal(**goal), feedback_callback=lambda m: self.feedback.append(m.feedback))
        handle = self.result(future)
        assert handle.accepted
        return handle

    @staticmethod
    def result(future, timeout=DEADLINE):
        done = threading.Event()
        future.add_done_callback(lambda f: done.set())
        assert done.wait(timeout), "no answer before the deadline"
        return future.result()

    def run(self, **goal):
        response = self.result(self.send(**goal).get_result_async())
        return response.result, response.status

    def close(self):
        self.executor.shutdown(timeout_sec=2.0)
        for node in (self.server, self.fakes, self.node):
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.thread.join(5.0)
