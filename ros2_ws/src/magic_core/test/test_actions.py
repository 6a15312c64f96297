"""The action client against an executor that is faster than the sender."""

import os
import threading
import time

import pytest
import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node

from magic_core.actions import ActionClient
from magic_interfaces.action import VerifyMotion

DEADLINE = 10.0


class Slow:
    """rclpy's handle of a client whose calls return long after their requests went out."""

    def __init__(self, handle):
        self._handle = handle

    def __getattr__(self, name):
        found = getattr(self._handle, name)
        if not name.startswith("send_"):
            return found

        def send(*args):
            number = found(*args)
            time.sleep(0.3)  # by now the answer is here
            return number

        return send


@pytest.fixture
def client():
    domain = 1 + os.getpid() % 100
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    serving, asking = Node("serving", context=context), Node("asking", context=context)
    go_on = threading.Event()

    def execute(handle):
        assert go_on.wait(DEADLINE)
        if handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.succeed()
        return VerifyMotion.Result(message="done")

    name = f"verify_{os.getpid()}"  # of no other test that might share the domain
    ActionServer(serving, VerifyMotion, name, execute, cancel_callback=lambda goal: CancelResponse.ACCEPT)
    result = ActionClient(asking, VerifyMotion, name)
    result.go_on = go_on
    executor = MultiThreadedExecutor(4, context=context)
    executor.add_node(serving)
    executor.add_node(asking)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    assert result.wait_for_server(DEADLINE)
    yield result
    go_on.set()
    executor.shutdown(timeout_sec=2.0)
    asking.destroy_node()
    serving.destroy_node()
    rclpy.try_shutdown(context=context)
    thread.join(5.0)


def wait(future):
    done = threading.Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(DEADLINE), "the answer was lost"
    return future.result()


def test_no_answer_is_lost_that_comes_before_its_request_is_noted(client):
    client._client_handle = Slow(client._client_handle)
    handle = wait(client.send_goal_async(VerifyMotion.Goal()))
    assert handle.accepted
    client.go_on.set()
    assert wait(handle.get_result_async()).result.message == "done"


def test_no_answer_to_a_cancel_is_lost(client):
    handle = wait(client.send_goal_async(VerifyMotion.Goal()))
    client._client_handle = Slow(client._client_handle)
    assert len(wait(handle.cancel_goal_async()).goals_canceling) == 1


def test_many_goals_from_many_threads(client):
    client.go_on.set()
    answers = []

    def ask():
        for _ in range(10):
            handle = wait(client.send_goal_async(VerifyMotion.Goal()))
            answers.append(wait(handle.get_result_async()).result.message)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert answers == ["done"] * 40
