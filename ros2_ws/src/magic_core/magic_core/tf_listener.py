"""Fills a :class:`magic_core.tf.TransformBuffer` from ``/tf`` and ``/tf_static``."""

from __future__ import annotations

import threading
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from magic_core import conversions as cv
from magic_core.errors import MagicError
from magic_core.node import describe
from magic_core.qos import RELIABLE, STATIC_TF
from magic_core.tf import TransformBuffer


class TransformListener:
    """Subscribes to ``/tf`` and ``/tf_static``; the buffer is read and written under ``lock``.

    ``/tf_static`` is subscribed to twice.  Its publishers should be transient local, so that who comes late still hears them; but
    a bag that was recorded without its QoS is played volatile, and DDS joins no volatile publisher to a transient-local subscription.
    """

    def __init__(self, node: Node, group: CallbackGroup, lock: Any = None) -> None:
        self.buffer = TransformBuffer()
        self.lock = lock if lock is not None else threading.Lock()
        self._node = node
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().error("tf2_msgs is not installed: there are no transforms")
            return
        for topic, static, qos in (("/tf", False, RELIABLE), ("/tf_static", True, STATIC_TF), ("/tf_static", True, RELIABLE)):
            node.create_subscription(TFMessage, topic, lambda msg, static=static: self._take(msg, static), qos, callback_group=group)

    def _take(self, msg: Any, static: bool) -> None:
        """Transforms; one that is none is named in the log, left out, and told with what is missing because of it."""
        with self.lock:
            for transform in msg.transforms:
                try:
                    cv.remember_transform(self.buffer, transform, static)
                except Exception as error:
                    self._node.get_logger().warning(f"left out: {describe(self._node, error)[1]}", throttle_duration_sec=5.0)

    def explain(self, error: MagicError) -> MagicError:
        """The error of a lookup, with what of the graph may be its reason."""
        reasons = []
        for topic in ("/tf", "/tf_static"):
            profiles = [p.qos_profile for p in self._node.get_publishers_info_by_topic(topic)]
            if any(p.reliability == ReliabilityPolicy.BEST_EFFORT for p in profiles):
                reasons.append(f"a publisher of {topic} is best effort and not heard (wanted: reliable)")
            if topic == "/tf_static" and any(p.durability == DurabilityPolicy.VOLATILE for p in profiles):
                reasons.append(
                    f"a publisher of {topic} is volatile: what it sent before this node was there is lost (wanted: transient local)"
                )
        return MagicError(error.code, "; ".join([error.message, *reasons])) if reasons else error
