"""URDF and SRDF as the rest of a robot's software tells them: on a latched topic, in place of a file."""

from __future__ import annotations

import atexit
import shutil
import tempfile
import time
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from magic_core import qos
from magic_core.errors import Code, MagicError

#: What a parameter begins with that names a topic and not a file.
TOPIC = "topic:"
#: How long a description is waited for, s.
PATIENCE = 10.0


def file_of(node: Node, name: str, given: str, patience: float = PATIENCE) -> str:
    """The file that a parameter ``name`` names; of ``topic:/robot_description`` one that holds what comes there.

    Waits for it, at most ``patience`` seconds, by a node of its own beside ``node``, which need not be spinning.  Raises BAD_REQUEST.
    """
    if not given.startswith(TOPIC):
        return given
    topic, found = given.removeprefix(TOPIC), []
    if not topic:
        raise MagicError(Code.BAD_REQUEST, name, given, "topic: and the name of a topic, as in topic:/robot_description")
    listener = rclpy.create_node(f"{node.get_name()}_description", context=node.context, namespace=node.get_namespace())
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(listener)
    try:
        listener.create_subscription(String, topic, lambda message: found.append(message.data), qos.LATCHED)
        deadline = time.monotonic() + patience
        while not found and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
    finally:
        executor.shutdown()
        listener.destroy_node()
    if not found:
        raise MagicError(
            Code.BAD_REQUEST, f"{name}: nothing came on {topic}", f"{patience:g} s", "a description on a latched topic, std_msgs/String"
        )
    folder = Path(tempfile.mkdtemp(prefix="magic_description_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = folder / f"{name.rpartition('.')[2]}.xml"
    path.write_text(found[-1])
    return str(path)
