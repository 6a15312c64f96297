"""What every node of the graph does alike: start, stop, validate parameters, report."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from magic_core.errors import Code, MagicError
from magic_core.executor import ThreadedExecutor
from magic_core.robot import RobotConfig

#: What a node is given to wind down while messages still flow, and then its callbacks to end, s.
WINDING_DOWN, ENDING = 5.0, 2.0
#: What the last answers of a node that has wound down are given to go out, s.
LAST_WORDS = 0.1

#: Set when a signal has told this process to end.
_TOLD_TO_END = threading.Event()


def run(node_type: Callable[[], Node], threads: int = 4, args: list[str] | None = None) -> None:
    """Spin one node until SIGINT, SIGTERM or shutdown, and end the process.

    A node that has begun something elsewhere may have a method ``wind_down() -> bool``: it is called again and again, while
    the node still spins, until it says that all is over.  A node that cannot start (a bad parameter, for one) logs why; the
    status is 1 then, else 0.
    """
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    spinning = False

    def stop(_signum: int, _frame: Any) -> None:
        _TOLD_TO_END.set()
        if not spinning:  # else whatever the executor has in its hands is brought to its end
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    node = None
    executor = ThreadedExecutor(threads)
    status = 0
    try:
        node = node_type()
        executor.add_node(node)
        spinning = True
        # The wait is in C, and Python only runs a signal's handler between its own instructions: without
        # a limit a node without timers would never notice.
        while rclpy.ok() and not _TOLD_TO_END.is_set():
            executor.spin_once(timeout_sec=0.2)
        _wind_down(node, executor)
    except KeyboardInterrupt:
        pass
    except (MagicError, ParameterException) as error:
        print(f"{getattr(node_type, '__name__', 'node')} cannot start: {error}", file=sys.stderr)
        status = 1
    finally:
        # A second signal during the shutdown must not leave a traceback behind.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ended = executor.shutdown(timeout_sec=ENDING)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    if not ended:  # Python would wait for such a thread without a limit
        print("a callback has not ended in time and is left", file=sys.stderr, flush=True)
        os._exit(status)
    sys.exit(status)


def _wind_down(node: Node, executor: ThreadedExecutor) -> None:
    """Let a node end what it has begun elsewhere, while requests and answers still get through."""
    wind_down = getattr(node, "wind_down", None)
    if wind_down is None:
        return
    deadline = time.monotonic() + WINDING_DOWN
    while rclpy.ok() and not wind_down() and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.02)
    deadline = time.monotonic() + LAST_WORDS
    while rclpy.ok() and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.02)


def parameter(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    read_only: bool = False,
) -> Any:
    """Declare a parameter with its description and range, and return its value.

    A value of a read-only or start-up parameter that is not one of ``choices`` raises ``BAD_REQUEST``.
    """
    descriptor = ParameterDescriptor(description=description, read_only=read_only)
    if choices is not None:
        descriptor.additional_constraints = "one of: " + ", ".join(choices)
    if low is not None and high is not None:
        if isinstance(default, int) and not isinstance(default, bool):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    value = node.declare_parameter(name, default, descriptor).value
    if choices is not None and value not in choices:
        raise MagicError(Code.BAD_REQUEST, f"parameter {name}", value, choices)
    return value


def robot_parameters(node: Node) -> dict[str, Any]:
    """Declare the parameters ``robot.*`` that every node with an arm has; the arguments of :class:`magic_core.robot.RobotConfig`."""
    default = RobotConfig()
    return {
        "urdf": parameter(node, "robot.urdf", default.urdf, "URDF of arm and gripper; empty: the Panda of example-robot-data."),
        "srdf": parameter(node, "robot.srdf", default.srdf, "SRDF with the pairs of links that may touch."),
        "package_root": parameter(
            node, "robot.package_root", default.package_root, "Folder that package:// stands for; empty: found from the URDF's place."
        ),
        "move_group": parameter(node, "robot.move_group", default.move_group, "Link between the fingertips, z out of the hand."),
        "closing_axis": parameter(
            node, "robot.closing_axis", default.closing_axis, "Axis of that link along which the fingers close.", choices=("x", "y")
        ),
        "opening": parameter(node, "robot.opening", default.opening, "Metres between the open fingers.", low=0.005, high=1.0),
        "home": tuple(parameter(node, "robot.home", list(default.home), "Home configuration, rad (m where a joint slides).")),
    }


class Goal:
    """What a handler needs of rclpy's handle of its goal.  ``is_cancel_requested`` is also true where the process is told to end."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle
        self.request = handle.request

    @property
    def is_cancel_requested(self) -> bool:
        """Whether the work is to stop."""
        return _TOLD_TO_END.is_set() or bool(self._handle.is_cancel_requested)

    def publish_feedback(self, feedback: Any) -> None:
        """As rclpy's."""
        self._handle.publish_feedback(feedback)


class OneGoalServer:
    """An action server that works on one goal at a time; a goal during another one is answered BUSY at once, nothing is queued.

    The action's result has the fields ``code``, ``message`` and ``seconds``.  ``work(goal, result)`` fills the result in; an
    exception out of it becomes its code and message.  Cancel requests are accepted; ``work`` looks for them and raises CANCELED.
    ``aborts(code)``: whether a goal that ended with this code aborts rather than succeeds.
    """

    def __init__(
        self,
        node: Node,
        action: Any,
        name: str,
        work: Callable[[Goal, Any], None],
        busy: str,
        aborts: Callable[[int], bool] = lambda code: code != Code.OK,
    ) -> None:
        self._node, self._action, self._work, self._message, self._aborts = node, action, work, busy, aborts
        self._busy = threading.Lock()
        self._server = ActionServer(
            node,
            action,
            name,
            self._execute,
            goal_callback=lambda _goal: GoalResponse.ACCEPT,
            cancel_callback=lambda _handle: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )

    def destroy(self) -> None:
        """Take the server down, before its node."""
        self._server.destroy()

    def _execute(self, handle: Any) -> Any:
        started = time.monotonic()
        result = self._action.Result()
        if not self._busy.acquire(blocking=False):
            result.code, result.message = int(Code.BUSY), self._message
            handle.abort()
            return result
        try:
            self._work(Goal(handle), result)
        except Exception as error:  # no handler lets an exception out
            result.code, result.message = describe(self._node, error)
        finally:
            self._busy.release()
        result.seconds = time.monotonic() - started
        if result.code == Code.CANCELED and handle.is_cancel_requested:
            handle.canceled()
        elif self._aborts(result.code):
            handle.abort()
        else:
            handle.succeed()
        return result


def describe(node: Node, error: BaseException) -> tuple[int, str]:
    """Code and message of any exception, for the answer of a handler.

    What is not a :class:`MagicError` is a defect of ours: it is logged with its traceback and answered as INTERNAL.
    """
    if isinstance(error, MagicError):
        return int(error.code), error.message
    node.get_logger().error("".join(traceback.format_exception(error)))
    return int(Code.INTERNAL), f"{type(error).__name__}: {error}"
