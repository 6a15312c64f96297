"""What a node says about itself on ``/diagnostics``."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

from magic_core import qos

#: Between two reports, s.
PERIOD = 1.0
#: A simulated clock that has not moved for this long is named, s.
STILL = 5.0


def wall_timer(node: Node, period: float, callback: Callable[[], None], group: CallbackGroup | None = None) -> Timer:
    """A timer that also fires where ``use_sim_time`` is set and nothing comes on ``/clock``; period in s."""
    return node.create_timer(period, callback, callback_group=group, clock=Clock(clock_type=ClockType.STEADY_TIME))


def label(node: Node) -> str:
    """What the names of a node's diagnostics begin with: its full name without the first slash."""
    return node.get_fully_qualified_name().lstrip("/")


def status(node: Node, what: str, level: bytes, message: str, values: Mapping[str, object] | None = None) -> DiagnosticStatus:
    """One diagnostic of a node; ``hardware_id`` is the node's full name."""
    return DiagnosticStatus(
        name=f"{label(node)}: {what}",
        level=level,
        message=message,
        hardware_id=node.get_fully_qualified_name(),
        values=[KeyValue(key=key, value=str(value)) for key, value in (values or {}).items()],
    )


def clock_complaint(node: Node) -> str:
    """What is wrong with a node's simulated clock; empty where nothing is, or where it has none."""
    if node.get_parameter("use_sim_time").value and node.get_clock().now().nanoseconds == 0:
        return "use_sim_time is set, but nothing comes on /clock (play a bag with --clock, or unset use_sim_time)"
    return ""


class Diagnostics:
    """Publishes a node's diagnostics once a second by the wall clock: what ``report`` returns, and the state of a simulated clock.

    Topic ``/diagnostics`` (diagnostic_msgs/DiagnosticArray).
    """

    def __init__(self, node: Node, report: Callable[[], Sequence[DiagnosticStatus]], group: CallbackGroup | None = None) -> None:
        self._node, self._report = node, report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", qos.RELIABLE)
        self._seen, self._moved = 0, time.monotonic()
        self._timer = wall_timer(node, PERIOD, self.publish, group)

    def publish(self) -> None:
        """Say now what is so."""
        try:
            array = DiagnosticArray(status=[*self._report(), *self._clock()])
            array.header.stamp = self._node.get_clock().now().to_msg()
            self._publisher.publish(array)
        except Exception as error:  # what cannot be told must not end the node
            self._node.get_logger().error("".join(traceback.format_exception(error)), throttle_duration_sec=5.0)

    def _clock(self) -> list[DiagnosticStatus]:
        if not self._node.get_parameter("use_sim_time").value:
            return []
        now = self._node.get_clock().now().nanoseconds
        if now != self._seen:
            self._seen, self._moved = now, time.monotonic()
        still = time.monotonic() - self._moved
        message, level = clock_complaint(self._node), DiagnosticStatus.ERROR
        if not message and still > STILL:
            message, level = f"/clock has stood still for {still:.0f} s", DiagnosticStatus.WARN
        return [status(self._node, "clock", level if message else DiagnosticStatus.OK, message or "follows /clock")]
