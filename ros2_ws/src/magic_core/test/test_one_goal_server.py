"""What a server of goals keeps, and for whom it works: results for a short time, and nobody who has gone."""

import itertools
import os
import subprocess
import sys
import threading
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from magic_core import node as nodes
from magic_core import qos
from magic_core.actions import ActionClient
from magic_core.errors import Code, MagicError
from magic_core.executor import ThreadedExecutor
from magic_core.node import OneGoalServer
from magic_interfaces.action import VerifyMotion

DEADLINE = 30.0
COUNT = itertools.count()
CLIENT = """
import sys, time
import rclpy
from rclpy.action import ActionClient
from rclpy.node import Node
from magic_interfaces.action import VerifyMotion
rclpy.init()
node = Node("killed_client")
client = ActionClient(node, VerifyMotion, sys.argv[1])
client.wait_for_server()
handle = client.send_goal_async(VerifyMotion.Goal())
rclpy.spin_until_future_complete(node, handle)
handle.result().get_result_async()
rclpy.spin(node)
"""


class Bench:
    def __init__(self, domain):
        self.domain = domain
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        # A context that is shut down may still be seen for a while: no two benches share a name.
        space = f"robot_{next(COUNT)}"
        self.node = Node("served", context=self.context, namespace=space)
        self.label, self.name = f"{space}/served", f"/{space}/verify"
        self.at_work, self.go_on, self.over = threading.Event(), threading.Event(), threading.Event()
        self.server = OneGoalServer(self.node, VerifyMotion, "verify", self.work, "busy")
        self.client = None
        self.heard = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.heard.append, qos.RELIABLE)
        self.executor = ThreadedExecutor(6, context=self.context)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def work(self, goal, result):
        self.at_work.set()
        try:
            while not self.go_on.is_set():
                if goal.is_cancel_requested:
                    raise MagicError(Code.CANCELED, "canceled")
                time.sleep(0.005)
            result.message = "done"
        finally:
            self.over.set()

    def result(self, future):
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(DEADLINE)
        return future.result()

    def send(self):
        if self.client is None:
            self.client = ActionClient(self.node, VerifyMotion, "verify")
            assert self.client.wait_for_server(DEADLINE)
        return self.result(self.client.send_goal_async(VerifyMotion.Goal())).get_result_async()

    def until(self, condition):
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def close(self):
        self.go_on.set()
        self.executor.shutdown(timeout_sec=2.0)
        self.server.destroy()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.thread.join(5.0)


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(nodes, "RESULT_TIMEOUT", 1)
    made = Bench(1 + (os.getpid() * 7 + 11) % 100)
    yield made
    made.close()


def test_results_are_forgotten_also_those_of_goals_refused(bench):
    first = bench.send()
    assert bench.at_work.wait(DEADLINE)
    refused = [bench.result(bench.send()).result.code for _ in range(5)]
    assert refused == [Code.BUSY] * 5
    bench.go_on.set()
    assert bench.result(first).result.message == "done"
    assert len(bench.server._server._goal_handles) >= 1
    bench.until(lambda: not bench.server._server._goal_handles and not bench.server._server._result_futures)


def test_requests_are_not_kept_as_long_as_results(bench):
    first = bench.send()
    assert bench.at_work.wait(DEADLINE)
    assert bench.result(bench.send()).result.code == Code.BUSY
    bench.go_on.set()
    assert bench.result(first).result.message == "done"
    kept = list(bench.server._server._goal_handles.values())
    assert kept and [handle.request for handle in kept] == [None] * len(kept)


def test_a_goal_whose_client_was_killed_is_given_up(bench):
    environment = {**os.environ, "ROS_DOMAIN_ID": str(bench.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with subprocess.Popen([sys.executable, "-c", CLIENT, bench.name], env=environment) as process:
        try:
            assert bench.at_work.wait(DEADLINE)
            assert not bench.over.wait(0.5), "given up while its client waits"
        finally:
            process.kill()
    assert bench.over.wait(DEADLINE), "the server is busy for nobody"


def test_diagnostics_say_how_goals_went_and_whose_they_are(bench):
    bench.go_on.set()
    assert bench.result(bench.send()).result.message == "done"

    def told():
        statuses = [s for m in list(bench.heard) for s in m.status]
        return [s for s in statuses if {v.key: v.value for v in s.values}.get("goals answered") == "1"]

    bench.until(told)
    status = told()[0]
    assert (status.name, status.hardware_id, status.level) == (f"{bench.label}: goals", f"/{bench.label}", DiagnosticStatus.OK)
    assert bench.name in status.message
    assert {v.key: v.value for v in status.values}["last answer"].startswith("0: done")
