"""What every node of the graph does alike: start, stop, validate parameters, report."""

from __future__ import annotations

import difflib
import gc
import os
import signal
import sys
import threading
import time
import traceback
from array import array
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from magic_core import presence, presets
from magic_core.arguments import split
from magic_core.diagnostics import Diagnostics, status
from magic_core.errors import Code, MagicError
from magic_core.executor import ThreadedExecutor
from magic_core.listening import join_all
from magic_core.robot_description import file_of
from magic_core.threads import one_thread

#: What a node is given to wind down while messages still flow, and then its callbacks to end, s.
WINDING_DOWN, ENDING = 5.0, 2.0
#: What the last answers of a node that has wound down are given to go out, s.
LAST_WORDS = 0.1

#: How long an action server keeps a result for a client that has not asked for it yet, s.  Clients ask when their goal is accepted;
#: rclpy's own 900 s keep hundreds of plans of some MB each.
RESULT_TIMEOUT = 10

#: The arm's parameters: one file gives them to every node, to those as well that need some of them or none.
ROBOT_PARAMETERS = frozenset(
    "robot." + name
    for name in (
        *("urdf", "srdf", "package_root", "move_group", "closing_axis", "opening", "home", "base_frame"),
        *("acceleration", "jerk", "velocity_scale", "acceleration_scale", "jerk_scale", "preset"),
    )
)

#: Between looks at whether anybody still waits for a goal's result, s.
ABANDONED_PERIOD = 0.25

#: Set when a signal has told this process to end.
_TOLD_TO_END = threading.Event()


def run(node_type: Callable[[], Node], threads: int = 4, args: list[str] | None = None) -> None:
    """Spin one node until SIGINT, SIGTERM or shutdown, and end the process.

    A node that has begun something elsewhere may have a method ``wind_down() -> bool``: it is called again and again, while
    the node still spins, until it says that all is over.  A node that cannot start (a bad parameter, for one) logs why; the
    status is 1 then, else 0.
    """
    name = getattr(node_type, "__name__", "node")
    try:
        _begin_ros(sys.argv[1:] if args is None else args)
    except MagicError as error:
        print(f"{name} cannot start: {error}", file=sys.stderr)
        sys.exit(1)
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
        refuse_unknown_parameters(node)
        executor.add_node(node)
        one_thread()
        # What was imported and built is there to stay: the collector would walk through all of it,
        # 0.15 s each time, in the middle of goals.
        gc.collect()
        gc.freeze()
        spinning = True
        # The wait is in C, and Python only runs a signal's handler between its own instructions: without
        # a limit a node without timers would never notice.
        while rclpy.ok() and not _TOLD_TO_END.is_set():
            executor.spin_once(timeout_sec=0.2)
        _wind_down(node, executor)
    except KeyboardInterrupt:
        pass
    except (MagicError, ParameterException, NameValidationException) as error:
        print(f"{name} cannot start: {error}", file=sys.stderr)
        status = 1
    except Exception:
        # A library that the interrupt meets while it is being loaded makes an error of its own of it (Open3D: an ImportError).
        if spinning or not _TOLD_TO_END.is_set():
            raise
    finally:
        # A second signal during the shutdown must not leave a traceback behind.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ended = executor.shutdown(timeout_sec=ENDING)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        join_all()
    if not ended:  # Python would wait for such a thread without a limit
        print("a callback has not ended in time and is left", file=sys.stderr, flush=True)
        os._exit(status)
    if _TOLD_TO_END.is_set() and not spinning:
        # What was being loaded is there by half, and the destructors of such a library may set a status of their own (Open3D: 1).
        gc.collect()  # of the node that was not finished, what ROS has of it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def _begin_ros(arguments: Sequence[str]) -> None:
    """Initialise rclpy; raises BAD_REQUEST for arguments that ROS would ignore, as those of who forgot ``--ros-args``, and for arguments
    and an environment that it cannot read."""
    own, _ = split(arguments)
    if any(":=" not in word for word in own):  # ROS 1's remappings ROS still heeds
        allowed = "--ros-args -p PARAMETER:=VALUE, --ros-args --params-file FILE, --ros-args -r NAME:=NAME, --version"
        raise MagicError(Code.BAD_REQUEST, "arguments", " ".join(own), allowed)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # of rcl, whose message has lines of where in its sources
        raise MagicError(Code.BAD_REQUEST, str(error).splitlines()[0]) from error


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
    read_only: bool = True,
) -> Any:
    """Declare a parameter with its description and range, and return its value.

    A parameter that is read at the start alone is ``read_only``: to set it later is refused instead of having no effect.
    A value that is not one of ``choices`` raises ``BAD_REQUEST``.
    """
    _fit(node, name, default, choices)
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


def _fit(node: Node, name: str, default: Any, choices: tuple[str, ...] | None) -> None:
    """Bring a given value to the type that is meant, where YAML has another one for how it is written.

    Whole numbers for floats; ``y``, ``n``, ``on`` and the like, which are truths in the YAML of parameter files, for the choice that
    is so written: the tools that dump parameters do not quote them.
    """
    given = node._parameter_overrides.get(name)
    if given is None:
        return
    value: Any = given.value
    if value is None and default:  # what rclpy makes of an empty list
        raise MagicError(Code.BAD_REQUEST, f"parameter {name}", "an empty list", f"values, as {list(default)}")
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    elif isinstance(default, (list, tuple)) and default and isinstance(default[0], float) and isinstance(value, (list, tuple, array)):
        value = [float(v) for v in value] if all(type(v) is int for v in value) else value
    elif isinstance(default, str) and isinstance(value, bool):
        words = {True: ("y", "yes", "on", "true"), False: ("n", "no", "off", "false")}[value]
        meant = [c for c in choices or () if c.lower() in words]
        value = meant[0] if len(meant) == 1 else value
    if value is not given.value:
        node._parameter_overrides[name] = Parameter(name, value=value)


def refuse_unknown_parameters(node: Node) -> None:
    """Raise BAD_REQUEST where a node was given a parameter that it has not declared, naming those that are written alike.

    rclpy ignores such a parameter: ``excute:=true`` would seem to be heeded.  The arm's parameters are given to all nodes.
    """
    unknown = sorted(name for name in node._parameter_overrides if not node.has_parameter(name) and name not in ROBOT_PARAMETERS)
    if not unknown:
        return
    declared = sorted(set(node.list_parameters([], 0).names) | ROBOT_PARAMETERS)
    near = list(dict.fromkeys(match for name in unknown for match in difflib.get_close_matches(name, declared, 3, 0.5)))
    raise MagicError(
        Code.BAD_REQUEST,
        f"{node.get_name()} has no such parameter",
        ", ".join(unknown),
        (f"written alike: {', '.join(near)}; " if near else "") + f"all: `ros2 param list` of {node.get_fully_qualified_name()}",
    )


def robot_parameters(node: Node) -> dict[str, Any]:
    """Declare the parameters ``robot.*`` that every node with an arm has; the arguments of :class:`magic_core.robot.RobotConfig`."""
    preset = parameter(
        node, "robot.preset", "", "Arm whose values are the defaults here and whose published limits hold.", choices=("", *presets.PRESETS)
    )
    default = presets.config_of(preset)

    def described(name: str, text: str) -> str:
        return file_of(node, f"robot.{name}", parameter(node, f"robot.{name}", getattr(default, name), text))

    return {
        "preset": preset,
        "urdf": described("urdf", "URDF of arm and gripper, a file or topic:/robot_description; empty: the Panda of example-robot-data."),
        "srdf": described("srdf", "SRDF with the pairs of links that may touch, a file or topic:/robot_description_semantic."),
        "package_root": parameter(
            node, "robot.package_root", default.package_root, "Folder that package:// stands for; empty: found from the URDF's place."
        ),
        "base_frame": parameter(
            node, "robot.base_frame", default.base_frame, "Name of the frame of the URDF's root link; empty: that link's name."
        ),
        "move_group": parameter(node, "robot.move_group", default.move_group, "Link between the fingertips, z out of the hand."),
        "closing_axis": parameter(
            node, "robot.closing_axis", default.closing_axis, "Axis of that link along which the fingers close.", choices=("x", "y")
        ),
        "opening": parameter(node, "robot.opening", default.opening, "Metres between the open fingers.", low=0.005, high=1.0),
        "home": tuple(parameter(node, "robot.home", list(default.home), "Home configuration, rad (m where a joint slides).")),
        "acceleration": tuple(
            parameter(node, "robot.acceleration", list(default.acceleration), "Acceleration limits, rad/s^2, one a joint or one for all.")
        ),
        "jerk": tuple(parameter(node, "robot.jerk", list(default.jerk), "Jerk limits, rad/s^3, one a joint or one for all.")),
    }


class Goal:
    """What a handler needs of rclpy's handle of its goal.

    ``is_cancel_requested`` is also true where the process is told to end, and where all have gone who could take the answer: a
    client that was killed would otherwise keep this server busy for those that come after it.
    """

    def __init__(self, handle: Any, clients: presence.Watch) -> None:
        self._handle = handle
        self._clients = clients
        self._looked = 0.0
        self._abandoned = False
        self.request = handle.request

    @property
    def is_cancel_requested(self) -> bool:
        """Whether the work is to stop."""
        now = time.monotonic()
        if not self._abandoned and now - self._looked > ABANDONED_PERIOD:  # asked between any two steps of the work
            self._looked = now
            self._abandoned = self._clients.gone()
        return self._abandoned or _TOLD_TO_END.is_set() or bool(self._handle.is_cancel_requested)

    def publish_feedback(self, feedback: Any) -> None:
        """As rclpy's."""
        self._handle.publish_feedback(feedback)


class OneGoalServer:
    """An action server that works on one goal at a time; a goal during another one is answered BUSY at once, nothing is queued.

    How it goes is told on ``/diagnostics`` at 1 Hz.

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
        self._name = node.resolve_service_name(name)
        self._answered = self._refused = 0
        self._last = ""
        group = ReentrantCallbackGroup()
        self._server = ActionServer(
            node,
            action,
            name,
            self._execute,
            goal_callback=lambda _goal: GoalResponse.ACCEPT,
            cancel_callback=lambda _handle: CancelResponse.ACCEPT,
            callback_group=group,
            result_timeout=RESULT_TIMEOUT,
        )
        self._diagnostics = Diagnostics(node, self._report, group)

    def destroy(self) -> None:
        """Take the server down, before its node."""
        self._server.destroy()

    def _report(self) -> list[DiagnosticStatus]:
        servers = self._node.count_services(f"{self._name}/_action/send_goal")
        message = f"at work on a goal of {self._name}" if self._busy.locked() else f"waiting for goals of {self._name}"
        level = DiagnosticStatus.OK
        if servers > 1:
            message, level = f"{servers} servers of {self._name}: each carries every goal out (allowed: 1)", DiagnosticStatus.ERROR
        values = {"goals answered": self._answered, "refused as BUSY": self._refused, "last answer": self._last or "none yet"}
        return [status(self._node, "goals", level, message, values)]

    def _execute(self, handle: Any) -> Any:
        try:
            return self._answered_goal(handle)
        finally:
            # rclpy keeps the handle for RESULT_TIMEOUT beyond the end, and with it the request: a scene of some MB as messages, so
            # that what a server held depended on how many goals came in that time.
            handle._goal_request = None

    def _answered_goal(self, handle: Any) -> Any:
        started = time.monotonic()
        result = self._action.Result()
        if not self._busy.acquire(blocking=False):
            self._refused += 1
            result.code, result.message = int(Code.BUSY), self._message
            handle.abort()
            return result
        try:
            clients = presence.Watch(lambda: presence.askers(self._node, f"{self._name}/_action/get_result"))
            self._work(Goal(handle, clients), result)
        except Exception as error:  # no handler lets an exception out
            result.code, result.message = describe(self._node, error)
        finally:
            self._busy.release()
        result.seconds = time.monotonic() - started
        self._answered += 1
        self._last = f"{result.code}: {result.message} ({result.seconds:.2f} s)"
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
