"""The strategy server's parameters; ``config/strategy_server.param.yaml`` lists them with their defaults."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.node import Node

from magic_bringup.arm import ArmSettings
from magic_core.node import parameter
from magic_core.presets import PRESETS


@dataclass(frozen=True)
class Settings:
    """What a run may take, and whether the arm is moved.

    strategies: folder of the strategies, empty: the installed ones.  top_k: candidates where the goal names no number.
    attempts: grasps for one contact.  repetitions: rollouts of one motion at most, 0: the verifier's own number.  timeout: s for
    a whole run where the goal says nothing.  presence: s to wait for a server that is not there.  objects, match, plan, verify:
    s for each.  grace: s that an answer may come late.  required_rate: least lower end of the success rate's interval;
    objects_age: s that objects may be old, and object_tolerance: m that they may have moved, where a trajectory is published or
    the arm begins to move.  recorded: what comes in is a recording.
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
    execute_unverified: bool
    trajectory_action: str
    gripper_action: str
    objects_age: float
    object_tolerance: float
    required_rate: float
    recorded: bool


def read(node: Node, preset: str = "") -> Settings:
    """Declare the parameters of a run and read them; ``preset``: the arm's, which names its driver's actions (empty: the Panda's)."""
    driver = PRESETS[preset or "panda"]

    def count(name: str, default: int, text: str, high: int) -> int:
        return parameter(node, name, default, text, low=1, high=high, read_only=True)

    def seconds(name: str, default: float, text: str) -> float:
        return parameter(node, name, default, text, low=0.05, high=3600.0, read_only=True)

    return Settings(
        strategies=parameter(node, "strategies", "", "folder of the strategies; empty: the installed ones", read_only=True),
        top_k=count("top_k", 3, "candidates to try where the goal does not say", 50),
        attempts=count("attempts", 3, "grasps to try for one contact (variant arm)", 50),
        repetitions=parameter(
            node, "repetitions", 0, "rollouts of one motion at most; 0: the verifier's own number", low=0, high=1000, read_only=True
        ),
        timeout=seconds("timeout", 300.0, "s for a whole run where the goal does not say"),
        presence=seconds("server_timeout", 5.0, "s to wait for a server that is not there"),
        objects=seconds("objects_timeout", 10.0, "s to wait for objects"),
        match=seconds("match_timeout", 60.0, "s for one match"),
        plan=seconds("plan_timeout", 30.0, "s for one plan"),
        verify=seconds("verify_timeout", 120.0, "s for one verification"),
        grace=seconds("grace", 5.0, "s that an answer may come late before its server counts as dead"),
        execute=parameter(node, "execute", False, "carry verified plans out with arm and gripper", read_only=True),
        execute_unverified=parameter(
            node,
            "execute_unverified",
            False,
            "with execute: also what simulation cannot judge, where the goal has allow_unverified",
            read_only=True,
        ),
        trajectory_action=parameter(
            node,
            "trajectory_action",
            driver.trajectory_action,
            "action of the arm's controller (control_msgs/FollowJointTrajectory)",
            read_only=True,
        ),
        gripper_action=parameter(
            node, "gripper_action", driver.gripper_action, "action of the gripper (control_msgs/GripperCommand)", read_only=True
        ),
        objects_age=seconds("objects_age", 5.0, "s that the objects may be old where a trajectory is published or the arm begins to move"),
        object_tolerance=parameter(
            node, "object_tolerance", 0.02, "m that an object may have moved since it was planned for", low=0.0, high=0.5, read_only=True
        ),
        required_rate=parameter(
            node,
            "required_rate",
            0.7,
            "least lower end of the success rate's 95 % interval; the verifier requires its own besides",
            low=0.0,
            high=0.99,
            read_only=True,
        ),
        recorded=parameter(
            node, "recorded", False, "what comes in is a recording: it gets no older, and no arm is moved by it", read_only=True
        ),
    )


def read_arm(node: Node, presence: float) -> ArmSettings:
    """Declare the parameters of the execution and read them."""

    def number(name: str, text: str, low: float, high: float) -> float:
        return parameter(node, name, getattr(ArmSettings, name), text, low=low, high=high, read_only=True)

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
    )
