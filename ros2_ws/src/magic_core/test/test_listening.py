"""A topic that is heard in a thread of its own: without an executor, in order, whatever its callback does, and until the node ends."""

import os
import threading
import time

import pytest
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from magic_core import listening, qos

DEADLINE = 10.0


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=1 + os.getpid() % 100)
    found = Node("hears", context=context)
    yield found
    found.destroy_node()
    rclpy.try_shutdown(context=context)
    begin = time.monotonic()
    listening.join_all()
    assert time.monotonic() - begin < 5 * listening.AWHILE
    assert not any(thread.name.startswith("hears") for thread in threading.enumerate())


def until(done):
    end = time.monotonic() + DEADLINE
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_messages_come_in_order_and_an_error_is_not_the_end(node):
    heard = []

    def take(message):
        heard.append(message.position[0])
        if message.position[0] == 3:
            raise ValueError("three")

    listening.listen_apart(node, JointState, "joint_states", take, qos.STATES)
    out = node.create_publisher(JointState, "joint_states", qos.RELIABLE)
    until(lambda: out.get_subscription_count() == 1)
    for k in range(20):
        out.publish(JointState(position=[float(k)]))
    until(lambda: len(heard) == 20)
    assert heard == sorted(heard)
