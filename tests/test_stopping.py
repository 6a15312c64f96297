"""A strategy server that is told to end while the arm moves stops the arm first."""

# In a file of its own: a graph that a module's fixture still holds would share its ROS context.

import signal
import threading
import time
from pathlib import Path

import pytest

from magic_bringup.demo import Options
from magic_bringup.graph import NODES
from magic_bringup.testing import DEADLINE, started, until
from magic_core.errors import Code
from magic_core.executor import ThreadedExecutor
from magic_server.testing import fakes

SERVER = {
    "execute": True,
    "autostart": True,
    "state_age": 10.0,
    "objects_age": 60.0,
    "trajectory_action": "arm/follow_joint_trajectory",
    "gripper_action": "gripper/gripper_action",
    **fakes.OPEN_LOOP,
}
#: No move of the stand-in ends by itself before this, s.
LONG = 30.0


@pytest.fixture
def graph(tmp_path):
    """The strategy server as a process, and stand-ins of all others: (bench, arm, ``stopped``: set when the arm's goal is canceled)."""
    with started(tmp_path, parameters={"strategy_server": SERVER}, leave_out=tuple(n for n in NODES if n != "strategy_server")) as bench:
        bench.ready(("strategy_server",))
        servers, arm = fakes.FakeServers(), fakes.FakeArm()
        stopped, over = threading.Event(), threading.Event()

        def move(trajectory, canceled):
            deadline = time.monotonic() + LONG
            while not canceled() and not over.is_set() and time.monotonic() < deadline:
                time.sleep(0.002)
            if canceled():
                stopped.set()
            return 0, ""

        arm.on_move = move
        executor = ThreadedExecutor(6)
        executor.add_node(servers)
        executor.add_node(arm)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        servers.publish(fakes.scene())
        try:
            yield bench, arm, stopped
        finally:
            over.set()
            arm.admits.set()
            executor.shutdown(timeout_sec=2.0)
            thread.join(5.0)
            arm.destroy_node()
            servers.destroy_node()


def send(bench):
    return bench.watcher.send(Options("hooking", "arm", Path(), Path(), tool="object_1", target="object_2"))


def told_to_end(bench, number):
    process = bench.graph.processes["strategy_server"]
    process.stopped = True
    process.signal(number)
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_a_server_that_ends_stops_the_arm(graph, number):
    bench, arm, stopped = graph
    pending = send(bench)
    assert arm.moving.wait(DEADLINE), bench.graph.processes["strategy_server"].tail()
    until(lambda: any("the arm moves" in line for line in bench.lines), what="the server says that the arm moves")
    process = told_to_end(bench, number)
    assert stopped.wait(3.0), "the arm goes on"
    assert process.wait(DEADLINE) == 0, process.tail(50)
    assert "Traceback" not in process.tail(100), process.tail(100)
    # Its client has an answer, which says what was not done.
    until(lambda: pending.result is not None, what="the client is answered")
    assert (pending.result.code, pending.result.verified, pending.result.executed) == (Code.CANCELED, False, False)
    assert "did not say" not in pending.result.message


def test_a_goal_that_is_accepted_after_the_signal_is_canceled(graph):
    bench, arm, stopped = graph
    arm.admits.clear()
    send(bench)
    assert arm.asked.wait(DEADLINE), bench.graph.processes["strategy_server"].tail()
    process = told_to_end(bench, signal.SIGINT)
    # The server takes no more goals from here on, so that the arm's answer comes while it winds down.
    until(lambda: "winding down" in process.tail(), 3.0, "the server has heard the signal")
    arm.admits.set()
    assert stopped.wait(3.0), "the arm goes on"
    assert process.wait(DEADLINE) == 0, process.tail(50)
