"""The strategy server's parameters; ``config/strategy_server.param.yaml`` lists them with their defaults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rclpy.node import Node

from magic_core.errors import Code, MagicError
from magic_core.node import parameter
from magic_core.presets import PRESETS
from magic_server import gripper
from magic_server.arm import ArmSettings


@dataclass(frozen=True)
class Settings:
    """What a run may take, and whether the arm is moved.

    Attributes
    ----------
    strategies : folder of the strategies; empty: the installed ones.
    top_k : candidates where the goal names no number.
    attempts : grasps for one contact.
    repetitions : rollouts of one motion at most; 0: the verifier's own number.
    timeout : s for a whole run where the goal says nothing.
    presence : s to wait for a server that is not there.
    objects, match, plan, verify : s for each.
    grace : s that an answer may come late.
    execute, autostart : verified plans are carried out, and the lifecycle begins in its state active, in which alone the arm moves.
    execute_unverified : with ``execute``, also what simulation cannot judge, where the goal allows it.
    trajectory_action, gripper_action : names of the controllers' actions.
    objects_age, object_tolerance : s that objects may be old, and m that they may have moved, where a trajectory is published or the arm
        begins to move.
    required_rate : least lower end of the success rate's interval.
    recorded : what comes in is a recording.
    words_weights : of the network that reads open words; empty: none.
    """

    strategies: str
    top_k: int
    attempts: int
    repetitions: int
    timeout: float
    presence: float
    objects: float
    match: float
    plan: float
    verify: float
    grace: float
    execute: bool
    autostart: bool
    execute_unverified: bool
    trajectory_action: str
    gripper_action: str
    objects_age: float
    object_tolerance: float
    required_rate: float
    recorded: bool
    words_weights: str


@dataclass(frozen=True)
class LoopSettings:
    """What is looked at while a plan is carried out, and what follows.

    Attributes
    ----------
    look, watch, judge : look at the tool after the lift; at the scene while the arm moves; and after the task whether the goal is met.
    executions, replans : how often the arm begins, and how often a motion is planned anew, at most, of one goal.
    seconds : after that many nothing is begun again.
    look_time : s that a picture of what has just happened is waited for.
    rest_time : s that the arm is given to come to rest when it is stopped.
    tool_shift, tool_turn : m and rad; a tool that is off by no more in the hand is carried on as planned.
    slip_shift, slip_turn : m and rad; one that is off by more is given up.
    watch_tolerance : m that a thing may move while the arm moves.
    intrusion : m that what comes in while the arm moves has to be away from where arm and tool are still to go; 0: it is not looked for.
    accuracy : m to which the middle of a thing is known that is seen twice.
    torque_error : Nm (N) to which a joint repeats its torque: with it the tool is weighed where it is looked at; 0: it is not.
    """

    look: bool = True
    watch: bool = True
    judge: bool = True
    executions: int = 3
    replans: int = 5
    seconds: float = 300.0
    look_time: float = 10.0
    rest_time: float = 5.0
    tool_shift: float = 0.005
    tool_turn: float = 0.06
    slip_shift: float = 0.03
    slip_turn: float = 0.5
    watch_tolerance: float = 0.03
    intrusion: float = 0.0
    accuracy: float = 0.005
    torque_error: float = 0.0


def read(node: Node, preset: str = "") -> Settings:
    """Declare the parameters of a run and read them; ``preset``: the arm's, which names its driver's actions (empty: the Panda's)."""
    driver = PRESETS[preset or "panda"]

    def declared(name: str, default: Any, text: str, low: float | None = None, high: float | None = None) -> Any:
        return parameter(node, name, default, text, low=low, high=high)

    def count(name: str, default: int, text: str) -> int:
        return declared(name, default, text, 1, 50)

    def seconds(name: str, default: float, text: str) -> float:
        return declared(name, default, text, 0.05, 3600.0)

    return Settings(
        strategies=declared("strategies", "", "folder of the strategies; empty: the installed ones"),
        top_k=count("top_k", 3, "candidates to try where the goal does not say"),
        attempts=count("attempts", 3, "grasps to try for one contact (variant arm)"),
        repetitions=declared("repetitions", 0, "rollouts of one motion at most; 0: the verifier's own number", 0, 1000),
        timeout=seconds("timeout", 300.0, "s for a whole run where the goal does not say"),
        presence=seconds("server_timeout", 5.0, "s to wait for a server that is not there"),
        objects=seconds("objects_timeout", 10.0, "s to wait for objects"),
        match=seconds("match_timeout", 60.0, "s for one match"),
        plan=seconds("plan_timeout", 30.0, "s for one plan"),
        verify=seconds("verify_timeout", 120.0, "s for one verification"),
        grace=seconds("grace", 5.0, "s that an answer may come late before its server counts as dead"),
        execute=declared("execute", False, "carry verified plans out with arm and gripper"),
        autostart=declared("autostart", False, "begin in the lifecycle's state active, in which the arm may move, without being asked"),
        execute_unverified=declared(
            "execute_unverified", False, "with execute: also what simulation cannot judge, where the goal has allow_unverified"
        ),
        trajectory_action=declared(
            "trajectory_action", driver.trajectory_action, "action of the arm's controller (control_msgs/FollowJointTrajectory)"
        ),
        gripper_action=declared("gripper_action", driver.gripper_action, "action of the gripper (control_msgs/GripperCommand)"),
        objects_age=seconds("objects_age", 5.0, "s that the objects may be old where a trajectory is published or the arm begins to move"),
        object_tolerance=declared(
            "object_tolerance",
            0.02,
            "m that a point of an object may have moved since it was planned for, all of it half as much",
            0.0,
            0.5,
        ),
        required_rate=declared(
            "required_rate", 0.7, "least lower end of the success rate's 95 % interval; the verifier requires its own besides", 0.0, 0.99
        ),
        recorded=declared("recorded", False, "what comes in is a recording: it gets no older, and no arm is moved by it"),
        words_weights=declared(
            "words_weights",
            "",
            "weights of CLIP or SigLIP, a hub name or a folder, for names in other words than the known ones; empty: such names are refused",
        ),
    )


def read_arm(node: Node, presence: float, finger: str) -> ArmSettings:
    """Declare the parameters of the execution and read them; ``finger``: the joint of a finger."""

    def number(name: str, text: str, low: float, high: float) -> float:
        return parameter(node, name, getattr(ArmSettings, name), text, low=low, high=high)

    return ArmSettings(
        speed=number("speed", "of the execution, as a share of the planned speed", 0.01, 1.0),
        start_tolerance=number("start_tolerance", "rad that a joint may be off where a move begins", 0.0, 0.5),
        path_tolerance=number(
            "path_tolerance", "rad that a joint may be off its trajectory while it moves; 0: the controller's own", 0.0, 1.0
        ),
        goal_tolerance=number("goal_tolerance", "rad that a joint may be off where a move ends; 0: the controller's own", 0.0, 0.5),
        goal_time=number("goal_time", "s that a joint may take to get there after its time; 0: the controller's own", 0.0, 30.0),
        state_age=number("state_age", "s that joint_states may be old where a move begins", 0.01, 10.0),
        opening=number("opening", "m between the open fingers", 0.0, 0.5),
        finger_scale=number("finger_scale", "position of the gripper's joint for a metre between the fingers", 0.01, 100.0),
        squeeze=number("squeeze", "m that the fingers are told to close beyond the tool's thickness", 0.0, 0.1),
        effort=number("effort", "of the gripper, N; 0: the driver's own", 0.0, 1000.0),
        grasp_tolerance=number("grasp_tolerance", "m that the opening of the closed fingers may be off the planned one", 0.0, 0.1),
        presence=presence,
        gripper_command=parameter(
            node, "gripper_command", "GripperCommand", "the gripper's action, of control_msgs", choices=tuple(gripper.ACTIONS)
        ),
        gripper_joint=parameter(node, "gripper_joint", "", "joint that ParallelGripperCommand names; empty: the first finger's") or finger,
    )


def read_loop(node: Node, preset: str = "") -> LoopSettings:
    """Declare the parameters of the closed loop and read them, of the arm of a preset (empty: of none); raises BAD_REQUEST where a tool is
    given up sooner than corrected."""

    def of(name: str, parameter_name: str, text: str, low: float | None = None, high: float | None = None) -> Any:
        return parameter(node, f"loop.{parameter_name}", getattr(LoopSettings, name), text, low=low, high=high)

    found = LoopSettings(
        look=of("look", "look", "look at the tool in the hand after the lift, and correct its pose"),
        watch=of("watch", "watch", "watch target and obstacles while the arm moves, and stop it where they move"),
        judge=of("judge", "judge", "look after the task whether the goal is met"),
        executions=of("executions", "executions", "how often the arm begins for one goal, at most: with the next candidate", 1, 20),
        replans=of("replans", "replans", "how often a motion is planned anew for one goal, at most, because something is elsewhere", 0, 50),
        seconds=of("seconds", "time", "s after the first motion's beginning after which nothing is begun again", 0.0, 36000.0),
        look_time=of("look_time", "look_time", "s that a picture of what has just happened is waited for", 0.1, 600.0),
        rest_time=of("rest_time", "rest_time", "s that a stopped arm is given to come to rest", 0.1, 60.0),
        tool_shift=of("tool_shift", "tool_shift", "m that the tool may be off in the hand without a new plan", 0.0, 0.5),
        tool_turn=of("tool_turn", "tool_turn", "rad that the tool may be off in the hand without a new plan", 0.0, 3.2),
        slip_shift=of("slip_shift", "slip_shift", "m beyond which a tool that is off in the hand is given up", 0.0, 0.5),
        slip_turn=of("slip_turn", "slip_turn", "rad beyond which a tool that is off in the hand is given up", 0.0, 3.2),
        watch_tolerance=of(
            "watch_tolerance", "watch_tolerance", "m that a point of a thing may move while the arm moves, all of it half as much", 0.0, 0.5
        ),
        intrusion=of(
            "intrusion",
            "intrusion",
            "m that what comes in while the arm moves has to be away from where arm and tool are still to go, else the arm is stopped and the "
            "run ends; 0: it is not looked for. Not a safety function",
            0.0,
            1.0,
        ),
        accuracy=of("accuracy", "accuracy", "m to which the middle of a thing is known that is seen before and after the task", 0.0, 0.1),
        torque_error=parameter(
            node,
            "loop.torque_error",
            PRESETS[preset].torque_error if preset else 0.0,
            "Nm to which each joint repeats the effort that joint_states tell of it: with it the tool is weighed in the hand; 0: it is not",
            low=0.0,
            high=20.0,
        ),
    )
    for small, large in (("tool_shift", "slip_shift"), ("tool_turn", "slip_turn")):
        if getattr(found, small) > getattr(found, large):
            allowed = f"at most loop.{large}, {getattr(found, large):g}"
            raise MagicError(Code.BAD_REQUEST, f"parameter loop.{small}", getattr(found, small), allowed)
    return found
