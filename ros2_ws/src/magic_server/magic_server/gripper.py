"""The two actions that a parallel gripper may be commanded by, as one.

``control_msgs/GripperCommand`` tells one joint and is what Franka's driver speaks; ``control_msgs/ParallelGripperCommand`` has taken its
place in ros2_control and names its joint.  control_msgs has the latter from 5.3 (ROS 2 Jazzy) on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from control_msgs import action
from control_msgs.action import GripperCommand

from magic_core.errors import Code, MagicError

#: The actions by name; None where the installed control_msgs has none of it.
ACTIONS = {"GripperCommand": GripperCommand, "ParallelGripperCommand": getattr(action, "ParallelGripperCommand", None)}


def action_of(name: str) -> Any:
    """The action of this name; raises BAD_REQUEST where control_msgs has none."""
    if ACTIONS.get(name) is None:
        raise MagicError(Code.BAD_REQUEST, "gripper_command", name, [known for known, kind in ACTIONS.items() if kind is not None])
    return ACTIONS[name]


@dataclass(frozen=True)
class Found:
    """What a gripper says at the end: position of its joint (m or rad), whether it pushes and does not
    move, whether it is where it was told."""

    position: float
    stalled: bool
    reached: bool


def goal(kind: Any, joint: str, position: float, effort: float) -> Any:
    """A goal of either action: the joint (which only ParallelGripperCommand names) to a position; effort 0: the driver's own."""
    message = kind.Goal()
    if kind is GripperCommand:
        message.command.position, message.command.max_effort = position, effort
        return message
    message.command.name, message.command.position = [joint], [position]
    message.command.effort = [effort] if effort > 0 else []
    return message


def found(result: Any, joint: str) -> Found:
    """What the result of either action says; raises EXECUTION_FAILED where it says nothing of the joint."""
    if not hasattr(result, "state"):
        return Found(result.position, result.stalled, result.reached_goal)
    state = dict(zip(result.state.name, result.state.position, strict=False))
    if joint not in state:
        raise MagicError(Code.EXECUTION_FAILED, "joint that the gripper's answer should tell of", joint, list(state))
    return Found(state[joint], result.stalled, result.reached_goal)
