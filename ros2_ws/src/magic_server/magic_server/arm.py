"""The arm and its gripper as the strategy server sees them: a trajectory controller and a gripper driver, both actions."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from magic_core.conversions import duration_to_msg, time_from_msg
from magic_core.errors import Code, MagicError
from magic_interfaces.msg import MotionPlan
from magic_server import execution, gripper
from magic_server.remote import RemoteAction, Token

#: A move is given this many times its own length, and this much besides, s: controllers add their settling.
PATIENCE, MARGIN = 1.5, 5.0
#: What the fingers are given to open or close, s.
FINGER_TIME = 10.0
#: A simulated clock may be so many times slower than the wall's, by which answers are waited for.
SLOW = 10.0


@dataclass(frozen=True)
class ArmSettings:
    """How a plan is carried out.

    Attributes
    ----------
    speed : 1 as planned, less: slower by that factor.
    start_tolerance : rad that a joint may be off where a move begins.
    path_tolerance, goal_tolerance, goal_time : rad that a joint may be off its trajectory on the way, and at the end within so many s after
        its time; 0: the controller's own.  They are sent with each move, and the controller ends it where one is exceeded.
    state_age : s that a joint state may be old.
    opening : m between the open fingers.
    finger_scale : position of the gripper's joint for a metre of opening; 0.5 where the joint is one of two fingers.
    squeeze : m that the fingers are told to close beyond the tool's thickness, for drivers that only control position.
    effort : N of the gripper; 0: the driver's own.
    grasp_tolerance : m that the opening of the closed fingers may differ from the planned one.
    presence : s to wait for a server.
    gripper_command, gripper_joint : the gripper's action, of :mod:`magic_server.gripper`, and the joint's name, which
    ParallelGripperCommand
        asks for.
    """

    speed: float = 1.0
    start_tolerance: float = 0.02
    path_tolerance: float = 0.1
    goal_tolerance: float = 0.01
    goal_time: float = 1.0
    state_age: float = 0.5
    opening: float = 0.08
    finger_scale: float = 0.5
    squeeze: float = 0.0
    effort: float = 60.0
    grasp_tolerance: float = 0.01
    presence: float = 5.0
    gripper_command: str = "GripperCommand"
    gripper_joint: str = ""


class Guard(Protocol):
    """Who has a say while a plan is carried out; each method raises what speaks against going on."""

    def ask(self, point: int) -> None:
        """Before anything moves, and before each move: that begins at this point of the trajectory."""

    def watch(self, move: execution.Move, speed: float) -> Callable[[], None]:
        """The move begins, at that share of the planned speed: what is called again and again until it ends."""

    def look(self, point: int) -> None:
        """The arm stands at this point with the tool in its hand."""

    def closing(self) -> None:
        """The arm stands, its hand empty, and the fingers are about to close on the tool."""

    def closed(self, opening: float) -> None:
        """The fingers have closed on the tool, and are so many metres apart."""

    def opened(self) -> None:
        """The fingers are about to open."""


class Arm:
    """Carries out verified plans, step by step: the next step begins only where the one before has succeeded.

    On a failure or a cancel the goal at work is canceled, the arm stays where its controller stops it, and the fingers stay as
    they are: what to do with a tool in the hand is for a person to decide.
    """

    def __init__(self, node: Node, trajectory_action: str, gripper_action: str, settings: ArmSettings, group: CallbackGroup) -> None:
        self.settings = settings
        self._patience = SLOW if node.get_parameter("use_sim_time").value else 1.0
        self._mover = RemoteAction(node, FollowJointTrajectory, trajectory_action, "arm's controller", group, Code.EXECUTION_FAILED)
        self._command = gripper.action_of(settings.gripper_command)
        self._gripper = RemoteAction(node, self._command, gripper_action, "gripper", group, Code.EXECUTION_FAILED)

    def ready(self) -> list[str]:
        """The servers that are missing."""
        return [f"{r.server} ({r.name})" for r in (self._mover, self._gripper) if not r.ready()]

    def servers(self) -> dict[str, frozenset[bytes]]:
        """Those who serve it, by what they do."""
        return {r.server: r.servers() for r in (self._mover, self._gripper)}

    def execute(self, plan: MotionPlan, token: Token, tell: Callable[[str], None], guard: Guard, holding: bool, look: bool) -> None:
        """Carry out a plan; ``holding``: the tool is in the hand already; ``look``: it is looked at after the lift.

        Everything that can be checked is checked before anything moves.  Raises BAD_MOTION, SERVER_UNAVAILABLE (before the first
        move), EXECUTION_FAILED, GRASP_FAILED, SERVER_TIMEOUT, CANCELED, and what the guard does.
        """
        settings, trajectory = self.settings, plan.arm_trajectory
        times = [time_from_msg(p.time_from_start) for p in trajectory.points]
        actions = execution.steps(
            times,
            [p.velocities for p in trajectory.points],
            plan.grasp_time,
            plan.release_time,
            plan.grasp_width,
            settings.opening,
            holding=holding,
            look=look,
        )
        for remote in (self._mover, self._gripper):
            remote.require(settings.presence, token)
        guard.ask(0)
        for number, action in enumerate(actions, 1):
            where = f"step {number} of {len(actions)}"
            if isinstance(action, execution.Move):
                tell(f"{where}: the arm moves for {(times[action.last] - times[action.first]) / settings.speed:.1f} s")
                guard.ask(action.first)
                with token.minding(guard.watch(action, settings.speed)):
                    self._move(trajectory, times, action, token)
            elif isinstance(action, execution.Look):
                tell(f"{where}: the tool in the hand is looked at")
                guard.look(action.point)
            else:
                tell(f"{where}: the fingers {'close on the tool' if action.close else 'open'}")
                if action.close:
                    guard.closing()
                else:
                    guard.opened()
                found = self._fingers(action, token, look)
                if action.close:
                    guard.closed(found)

    def _move(self, trajectory: JointTrajectory, times: list[float], move: execution.Move, token: Token) -> None:
        speed = self.settings.speed
        goal = FollowJointTrajectory.Goal()
        # A stamp of 0: begin at once.
        goal.trajectory = JointTrajectory(header=Header(frame_id=trajectory.header.frame_id), joint_names=trajectory.joint_names)
        for index in range(move.first, move.last + 1):
            point = copy.copy(trajectory.points[index])
            point.time_from_start = duration_to_msg((times[index] - times[move.first]) / speed)
            point.velocities = [v * speed for v in point.velocities]
            point.accelerations = [a * speed**2 for a in point.accelerations]
            if (
                index == move.last
            ):  # where the arm stands, to a hundredth of a radian a second: controllers take no end at which it moves at all
                point.velocities, point.accelerations = [0.0] * len(point.velocities), [0.0] * len(point.accelerations)
            goal.trajectory.points.append(point)
        names = trajectory.joint_names
        goal.path_tolerance = [JointTolerance(name=name, position=self.settings.path_tolerance) for name in names]
        goal.goal_tolerance = [JointTolerance(name=name, position=self.settings.goal_tolerance) for name in names]
        goal.goal_time_tolerance = duration_to_msg(self.settings.goal_time)
        seconds = (times[move.last] - times[move.first]) / speed
        response = self._mover.respond(goal, self._patience * (PATIENCE * seconds + MARGIN), token, self.settings.presence)
        result = response.result
        if response.status != GoalStatus.STATUS_SUCCEEDED or result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            raise execution.controller_error(result.error_code, response.status, result.error_string)

    def _fingers(self, fingers: execution.Fingers, token: Token, looked: bool) -> float:
        """Open or close; metres between the fingers afterwards."""
        settings = self.settings
        opening = max(0.0, fingers.opening - settings.squeeze) if fingers.close else fingers.opening
        goal = gripper.goal(self._command, settings.gripper_joint, opening * settings.finger_scale, settings.effort)
        response = self._gripper.respond(goal, self._patience * FINGER_TIME, token, settings.presence)
        result = gripper.found(response.result, settings.gripper_joint)
        found = result.position / settings.finger_scale
        if fingers.close:
            # A gripper that squeezes a tool may say that it stalled, or abort because it did not get where it was told to.
            if response.status != GoalStatus.STATUS_SUCCEEDED and not result.stalled:
                raise MagicError(Code.GRASP_FAILED, f"the gripper ended its goal with status {response.status}")
            execution.check_grasp(fingers.opening, found, settings.grasp_tolerance, looked)
        elif response.status != GoalStatus.STATUS_SUCCEEDED or not (result.reached or found >= fingers.opening - settings.grasp_tolerance):
            raise MagicError(
                Code.EXECUTION_FAILED, f"the gripper did not open: mm between the fingers {1000 * found:.1f}, status {response.status}"
            )
        return float(found)
