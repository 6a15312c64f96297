"""How a node's process ends, and one goal at a time; each node in a process of its own, as signals are meant for processes."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

DEADLINE = 30.0

HEAD = """
import sys, threading, time
from rclpy.node import Node
from magic_core.node import run

class Spun(Node):
    def __init__(self):
        super().__init__("spun")
"""


class Process:
    """A node as a program; ``said(text)`` waits until it has printed that."""

    def __init__(self, body, *arguments):
        env = {**os.environ, "PYTHONUNBUFFERED": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "OPENBLAS_NUM_THREADS": "2"}
        self.popen = subprocess.Popen(
            [sys.executable, "-c", HEAD + body, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env
        )
        self.lines = []
        self._heard = threading.Condition()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self):
        for line in self.popen.stdout:
            with self._heard:
                self.lines.append(line)
                self._heard.notify_all()

    def said(self, text):
        with self._heard:
            assert self._heard.wait_for(lambda: any(text in line for line in self.lines), DEADLINE), self.lines

    def wait(self):
        status = self.popen.wait(DEADLINE)
        self._thread.join(DEADLINE)
        return status


@pytest.fixture
def start():
    started = []

    def begin(init, methods="", after="run(Spun)", arguments=()):
        parts = [textwrap.indent(textwrap.dedent(init), 8 * " "), textwrap.indent(textwrap.dedent(methods), 4 * " "), after]
        started.append(Process("\n".join(parts), *arguments))
        return started[-1]

    yield begin
    for process in started:
        process.popen.kill()
        process.popen.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_what_a_node_has_begun_is_wound_down_while_it_still_spins(start, number):
    process = start(
        """
            self.ticks = 0
            self.create_timer(0.05, self.tick)
            self.before = None
        """,
        """
        def tick(self):
            self.ticks += 1
            if self.ticks == 1:
                print("up")

        def wind_down(self):
            if self.before is None:
                self.before = self.ticks
                print("winding down")
            return self.ticks >= self.before + 3

        def destroy_node(self):
            print("ticked on" if self.ticks >= self.before + 3 else "stood still")
            super().destroy_node()
        """,
    )
    process.said("up")
    process.popen.send_signal(number)
    process.said("winding down")
    process.popen.send_signal(number)  # an impatient user changes nothing
    assert process.wait() == 0, process.lines
    assert "ticked on\n" in process.lines
    assert not any("Traceback" in line for line in process.lines), process.lines


def test_linear_algebra_takes_one_thread(start):
    pytest.importorskip("threadpoolctl")
    process = start(
        """
            self.create_timer(0.05, self.tell)
        """,
        """
        def tell(self):
            from threadpoolctl import threadpool_info
            print("threads:", {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"})
        """,
    )
    process.said("threads: {1}")


def test_a_node_that_cannot_wind_down_ends_all_the_same(start):
    process = start(
        """
            self.create_timer(0.05, lambda: print("up"))
        """,
        """
        def wind_down(self):
            return False
        """,
        "import magic_core.node; magic_core.node.WINDING_DOWN = 0.3; run(Spun)",
    )
    process.said("up")
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0, process.lines


def test_a_callback_that_never_ends_does_not_hold_up_the_end(start):
    process = start(
        """
            self.create_timer(0.01, self.hang)
        """,
        """
        def hang(self):
            print("hanging")
            time.sleep(1000.0)
        """,
    )
    process.said("hanging")
    begin = time.monotonic()
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0, process.lines
    assert time.monotonic() - begin < 10.0
    assert any("has not ended in time" in line for line in process.lines), process.lines


def test_a_signal_during_the_start_ends_it(start):
    process = start(
        """
            print("loading")
            time.sleep(1000.0)
        """
    )
    process.said("loading")
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0, process.lines


def test_a_signal_that_a_library_makes_another_error_of_during_the_start_ends_it_too(start):
    """As Open3D does while it is being imported."""
    process = start(
        """
            print("loading")
            try:
                time.sleep(1000.0)
            except KeyboardInterrupt as error:
                raise ImportError("initialization failed") from error
        """
    )
    process.said("loading")
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0, process.lines
    assert not any("Traceback" in line for line in process.lines), process.lines


def test_what_a_library_that_is_loaded_by_half_does_at_the_end_does_not_set_the_status(start):
    """As the destructors of Open3D do."""
    process = start(
        """
            import atexit, os
            atexit.register(os._exit, 1)
            print("loading")
            time.sleep(1000.0)
        """
    )
    process.said("loading")
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0, process.lines


def test_an_error_during_the_start_that_no_signal_made_is_not_hidden(start):
    process = start('raise ImportError("initialization failed")')
    assert process.wait() == 1
    assert any("ImportError: initialization failed" in line for line in process.lines), process.lines


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("-p", "rate:=2.0"), "'-p rate:=2.0' (allowed: --ros-args -p"),
        (("--help",), "'--help' (allowed: --ros-args -p"),
        (("--ros-args", "--params-file", "/nowhere.yaml"), "/nowhere.yaml"),
        (("--ros-args", "-p", "rate"), "-p rate"),
    ],
    ids=["--ros-args was forgotten", "help", "a parameters file that is not there", "a parameter without a value"],
)
def test_arguments_that_ros_ignores_or_cannot_read_are_refused_in_a_line(start, arguments, said):
    process = start("", arguments=arguments)
    assert process.wait() == 1, process.lines
    line = process.lines[-1]  # before it there may be rcl's own
    assert len(process.lines) <= 2 and "Spun cannot start: [506 BAD_REQUEST]" in line and said in line, process.lines


def test_a_domain_that_is_no_number_is_named(start, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "lab")
    process = start("")
    assert process.wait() == 1
    assert "Spun cannot start: [506 BAD_REQUEST]" in process.lines[-1] and "ROS_DOMAIN_ID" in process.lines[-1], process.lines


def test_a_name_that_is_none_of_ros_is_refused_without_a_traceback(start):
    process = start('self.create_subscription(__import__("std_msgs.msg").msg.Empty, "camera/a b", print, 1)')
    assert process.wait() == 1
    assert "Spun cannot start: Invalid topic name" in process.lines[0], process.lines


def test_a_goal_at_work_hears_that_its_process_is_to_end(start):
    process = start(
        """
            from rclpy.action import ActionClient
            from magic_core.errors import Code, MagicError
            from magic_core.node import OneGoalServer
            from magic_interfaces.action import VerifyMotion

            def work(goal, result):
                print("at work")
                while not goal.is_cancel_requested:
                    time.sleep(0.005)
                print("told to stop")
                raise MagicError(Code.CANCELED, "canceled")

            self.server = OneGoalServer(self, VerifyMotion, "verify", work, "busy")
            self.client = ActionClient(self, VerifyMotion, "verify")
            self.goal = VerifyMotion.Goal()
            self.create_timer(0.05, self.ask)
        """,
        """
        def ask(self):
            if self.goal is not None and self.client.server_is_ready():
                self.client.send_goal_async(self.goal)
                self.goal = None
        """,
    )
    process.said("at work")
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0, process.lines
    assert "told to stop\n" in process.lines
    assert not any("has not ended in time" in line or "Traceback" in line for line in process.lines), process.lines
