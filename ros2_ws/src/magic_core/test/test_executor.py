"""The executor with threads: what it costs, what it survives, and how it ends."""

import contextlib
import os
import threading
import time

import pytest
import rclpy
from rclpy.action import ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node

from magic_core import executor
from magic_core.executor import ThreadedExecutor
from magic_interfaces.action import VerifyMotion

DEADLINE = 10.0


class Bench:
    """A node spun by an executor in a thread."""

    def __init__(self, threads):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=1 + os.getpid() % 100)
        self.node = Node("spun", context=self.context)
        self.group = ReentrantCallbackGroup()
        self.executor = ThreadedExecutor(threads, context=self.context)
        self.executor.add_node(self.node)
        self.release = threading.Event()
        self._thread = threading.Thread(target=self.executor.spin, daemon=True)

    def start(self):
        self._thread.start()

    def close(self):
        self.release.set()
        self.executor.shutdown(DEADLINE)
        if self._thread.ident is not None:  # a test may spin by itself
            self._thread.join(DEADLINE)
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def bench(request):
    found = Bench(getattr(request, "param", 2))
    yield found
    found.close()


def timer(bench, callback, period=0.001):
    return bench.node.create_timer(period, callback, callback_group=bench.group)


@pytest.mark.parametrize("bench", [3], indirect=True)
def test_a_callback_is_handed_over_once(bench, monkeypatch):
    """rclpy's own executor hands it over again and again until a thread has begun it: tens of times beside a computation."""
    handed, done = [], []
    enough = threading.Event()
    submit = bench.executor._pool.submit
    monkeypatch.setattr(bench.executor._pool, "submit", lambda *a: handed.append(a) or submit(*a))

    def compute():
        while not bench.release.is_set():  # holds Python's lock as long as it may
            sum(range(1000))

    def tick():
        done.append(None)
        if len(done) == 100:
            enough.set()

    bench.node.create_timer(0.001, compute, callback_group=MutuallyExclusiveCallbackGroup())
    for _ in range(2):
        bench.node.create_timer(0.005, tick, callback_group=MutuallyExclusiveCallbackGroup())
    bench.start()
    assert enough.wait(DEADLINE)
    assert len(handed) < 1.2 * len(done) + 10


def test_callbacks_run_side_by_side(bench):
    meeting = threading.Barrier(2)
    met = threading.Event()

    def meet():
        if not met.is_set():
            with contextlib.suppress(threading.BrokenBarrierError):
                meeting.wait(DEADLINE)
                met.set()

    timer(bench, meet)
    timer(bench, meet)
    bench.start()
    assert met.wait(DEADLINE)
    meeting.abort()  # for a third call that came in between


def test_an_exception_out_of_a_callback_ends_nothing_else(bench, capfd):
    went_on = threading.Event()
    calls = []

    def faulty():
        calls.append(None)
        if len(calls) > 20:
            went_on.set()
        raise ValueError("a defect")

    timer(bench, faulty)
    bench.start()
    assert went_on.wait(DEADLINE)
    bench.close()  # now all is said
    assert "ValueError: a defect" in capfd.readouterr().err


def test_an_action_server_destroyed_while_it_is_waited_for_ends_nothing(bench, monkeypatch):
    server = ActionServer(bench.node, VerifyMotion, "verify_motion", lambda goal: VerifyMotion.Result(), callback_group=bench.group)
    failed, went_on = threading.Event(), threading.Event()
    add = server.add_to_wait_set

    def destroyed(wait_set):
        failed.set()
        add(wait_set)

    def tick():
        if failed.is_set():
            went_on.set()

    timer(bench, tick)
    bench.start()
    monkeypatch.setattr(server, "add_to_wait_set", destroyed)
    # As between the two steps of rclpy's ActionServer.destroy: the handle is gone, and the node still lists the server.
    server._handle.destroy_when_not_in_use()
    assert failed.wait(DEADLINE)
    bench.node.remove_waitable(server)
    assert went_on.wait(DEADLINE)


def test_a_wait_that_never_succeeds_is_an_error(bench, monkeypatch):
    def fail(**kwargs):
        raise _rclpy.RCLError("never")

    monkeypatch.setattr(bench.executor, "wait_for_ready_callbacks", fail)
    monkeypatch.setattr(executor, "FAILING", 0.05)
    deadline = time.monotonic() + DEADLINE
    with pytest.raises(_rclpy.RCLError, match="never"):
        while time.monotonic() < deadline:
            bench.executor.spin_once(0.0)


def test_shutdown_waits_for_the_callbacks_at_work(bench):
    begun, ended = threading.Event(), threading.Event()

    def work():
        begun.set()
        bench.release.wait(DEADLINE)
        ended.set()

    timer(bench, work)
    bench.start()
    assert begun.wait(DEADLINE)
    assert not bench.executor.shutdown(0.1)
    bench.release.set()
    assert bench.executor.shutdown(DEADLINE)
    assert ended.is_set()


@pytest.mark.parametrize("bench", [1], indirect=True)
def test_shutdown_ends_the_spinning_where_all_threads_are_taken(bench):
    begun = threading.Event()

    def work():
        begun.set()
        bench.release.wait(DEADLINE)

    for _ in range(2):
        timer(bench, work)
    bench.start()
    assert begun.wait(DEADLINE)
    for _ in range(200):  # until the other one waits for the thread
        if bench.executor._pool._work_queue.qsize():
            break
        bench.release.wait(0.01)
    assert not bench.executor.shutdown(0.1)
    bench._thread.join(2.0)
    assert not bench._thread.is_alive()
