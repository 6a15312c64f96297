"""The executor with threads: what it costs, what it survives, and how it ends."""

import os
import threading
import time

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from magic_core.executor import ThreadedExecutor

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


@pytest.mark.parametrize("bench", [1], indirect=True)
def test_waiting_for_a_free_thread_costs_nothing(bench):
    begun = threading.Event()

    def work():
        begun.set()
        bench.release.wait(DEADLINE)

    timer(bench, work)  # holds the only thread
    timer(bench, lambda: None)  # would like to have it
    bench.start()
    assert begun.wait(DEADLINE)
    before = time.process_time()
    bench.release.wait(1.0)  # nobody sets it: a second passes
    assert time.process_time() - before < 0.3  # rclpy's own executor takes all of the second


def test_callbacks_run_side_by_side(bench):
    meeting = threading.Barrier(2)
    met = threading.Event()

    def meet():
        if not met.is_set():
            meeting.wait(DEADLINE)
            met.set()

    timer(bench, meet)
    timer(bench, meet)
    bench.start()
    assert met.wait(DEADLINE)


def test_an_exception_out_of_a_callback_ends_nothing_else(bench, capfd):
    went_on = threading.Event()
    calls = []

    def faulty():
        calls.append(None)
        if len(calls) > 2:
            went_on.set()
        raise ValueError("a defect")

    timer(bench, faulty)
    bench.start()
    assert went_on.wait(DEADLINE)
    assert "ValueError: a defect" in capfd.readouterr().err


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
