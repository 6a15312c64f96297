"""What every node of the graph does alike: start, stop, validate parameters, report."""

from __future__ import annotations

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
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from magic_core.errors import Code, MagicError

#: How long a thread keeps Python's lock while others wait for it, s.
SWITCH_INTERVAL = 2e-4


def run(node_type: Callable[[], Node], threads: int = 4, args: list[str] | None = None) -> None:
    """Spin one node until SIGINT, SIGTERM or shutdown; ends the process's main cleanly on each.

    A node that cannot start (a bad parameter, for one) logs why and exits with status 1.
    """
    # rclpy's executor asks without pause for a callback that it has handed to a thread until that thread has begun. A computation
    # that lets go of Python's lock in every call into a library then waits a whole switch interval, 5 ms, to get it back:
    # a scene took up to 21 s instead of 0.5.
    sys.setswitchinterval(SWITCH_INTERVAL)
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)

    def stop(signum: int, _frame: Any) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    node = None
    executor = MultiThreadedExecutor(threads)
    status = 0
    try:
        node = node_type()
        executor.add_node(node)
        # spin() waits in C without a limit, and Python only runs a signal's handler between its own
        # instructions: a node without timers would never notice.
        while rclpy.ok():
            executor.spin_once(timeout_sec=0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (MagicError, ParameterException) as error:
        print(f"{getattr(node_type, '__name__', 'node')} cannot start: {error}", file=sys.stderr)
        status = 1
    finally:
        # A second signal during the shutdown must not leave a traceback behind.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)


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


class OneGoalServer:
    """An action server that works on one goal at a time; a goal during another one is answered BUSY at once, nothing is queued.

    The action's result has the fields ``code``, ``message`` and ``seconds``.  ``work(handle, result)`` fills the result in; an
    exception out of it becomes its code and message.  Cancel requests are accepted; ``work`` looks for them and raises CANCELED.
    ``aborts(code)``: whether a goal that ended with this code aborts rather than succeeds.
    """

    def __init__(
        self,
        node: Node,
        action: Any,
        name: str,
        work: Callable[[Any, Any], None],
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
            self._work(handle, result)
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
