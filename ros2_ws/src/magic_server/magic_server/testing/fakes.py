"""Stand-ins for the graph's other nodes, for tests of the strategy server and of clients of it.

They speak the true interfaces; what they answer is set by plain functions.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import JointState

from magic_core import conversions, qos, transforms
from magic_core.contact import Contact, ContactCandidate, contact_frame
from magic_core.errors import Code
from magic_core.mesh import Mesh
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.strategy import Goal, Physics, Strategy, Waypoint
from magic_interfaces.action import PlanMotion, VerifyMotion
from magic_interfaces.msg import SceneObjectArray
from magic_interfaces.srv import MatchContact

#: What :class:`FakeServers` stands in for.
SERVICES = ("match", "plan", "verify", "objects")
#: Parameters of a strategy server that leave its loop open: what these stand-ins do not show is not looked for.
OPEN_LOOP = {"loop.look": False, "loop.watch": False, "loop.judge": False, "loop.executions": 1}


def box(size: float = 0.05) -> Mesh:
    """A cube about the origin with edges of ``size`` metres, faces counter-clockwise from outside."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float) * size / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def view(kind: str = "top", size: int = 64) -> CanonicalView:
    """A square seen from above, half the picture wide."""
    mask = np.zeros((size, size), bool)
    mask[size // 4 : 3 * size // 4, size // 4 : 3 * size // 4] = True
    return CanonicalView(
        np.where(mask[..., None], 180, 0).astype(np.uint8).repeat(3, axis=2), mask, 0.1 / size, transforms.from_rpy(np.pi, 0.0, 0.0), kind
    )


def contact(of: CanonicalView) -> Contact:
    """The middle of the square's right edge."""
    height, width = of.mask.shape
    pixel, normal = np.array([0.75 * width, height / 2]), np.array([1.0, 0.0])
    return Contact(pixel, normal, 0.02, False, 0.01, contact_frame(of, pixel, normal))


def scene(ids: tuple[str, ...] = ("object_1", "object_2")) -> Scene:
    """Cubes in a row on the table, 0.2 m apart."""
    items = [
        SceneObject(name, box(), (box(),), transforms.make(translation=[0.4, 0.2 * i, 0.025]), view(), box_extents=np.full(3, 0.05))
        for i, name in enumerate(ids)
    ]
    return Scene(tuple(items), np.array([0.0, 0.0, 1.0, 0.0]))


def candidate(tool_id: str = "object_1", score: float = 1.0, flipped: bool = False) -> ContactCandidate:
    """A candidate with a target."""
    return ContactCandidate(tool_id, contact(view()), contact(view()), 0.0, flipped, score, score, score, np.eye(4))


def strategy(name: str = "fake", simulatable: bool = True) -> Strategy:
    """The least strategy that can be saved and loaded."""
    return Strategy(
        name=name,
        description="a stand-in",
        view="top",
        mode="plan",
        tool_view=view(),
        tool_contact=contact(view()),
        target_view=view(),
        target_contact=contact(view()),
        target_normal=np.array([1.0, 0.0, 0.0]),
        target_view_direction=np.array([0.0, 0.0, -1.0]),
        times=np.array([0.0, 1.0]),
        target_from_tool=np.stack([np.eye(4), transforms.make(translation=[0.1, 0.0, 0.0])]),
        tool_mesh=box(),
        target_mesh=box(),
        waypoints=(Waypoint("contact", np.zeros(3), "contact"), Waypoint("goal", np.array([-0.2, 0.0, 0.0]), "goal")),
        goal=Goal("hook", {"distance": 0.2}),
        physics=Physics(),
        simulatable=simulatable,
    )


#: Joints of the stand-in arm.
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")


def plan(variant: str = "fg", release: bool = False, lift: bool = False, start: float = 0.0, held: bool = False) -> MotionPlan:
    """The tool moves 0.1 m in one second; the arm goes to it in one second, grasps 30 mm, and turns by 0.2 rad at every joint.

    It stands at 0, 1, 1.5, 2.5 and 3 s; with ``release`` the fingers open at 2.5 s, with ``lift`` it stands at 2 s as well.  All joints
    begin at ``start`` rad.  ``held``: the tool is in the hand from the start, and what comes before is left out.
    """
    times = np.array([0.0, 1.0])
    motion = ToolMotion(times, np.stack([np.eye(4), transforms.make(translation=[0.1, 0.0, 0.0])]), (Phase("goal", 0.0, 1.0),))
    if variant == "fg":
        return MotionPlan(variant, motion)
    times = np.array([0.0, 0.5, 1.0, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0])
    rows = np.array([0.0, 0.05, 0.1, 0.1, 0.125, 0.15, 0.175, 0.2, 0.2])
    speeds = np.array([0.0, 0.1, 0.0, 0.0, 0.1, 0.0 if lift else 0.1, 0.1, 0.0, 0.0])
    phases: tuple[Phase, ...] = (Phase("grasp", 0.0, 1.5), Phase("transfer", 1.5, 2.25), Phase("goal", 2.25, 3.0))
    if held:
        times, rows, speeds = times[2:] - 1.0, rows[2:] - rows[2], speeds[2:]
        phases = tuple(Phase(p.name, max(0.0, p.start - 1.0), p.end - 1.0) for p in phases)
    positions, velocities = (np.outer(column, np.ones(7)) for column in (start + rows, speeds))
    grasp, end = (0.0, 1.5) if held else (1.0, 2.5)
    arm = ArmMotion(
        times, JOINTS, positions, velocities, np.zeros_like(positions), np.eye(4), 0.03, grasp, end if release else None, phases
    )
    return MotionPlan(variant, motion, arm)


class FakeServers(Node):
    """``match_contact``, ``plan_motion`` and ``verify_motion`` in one node, and a publisher of ``objects``; ``services``: which of them.

    ``on_match(request)``, ``on_plan(goal, canceled)`` and ``on_verify(goal, canceled)``
    may be replaced; each returns a response or result.  ``canceled`` is a function.
    ``goals`` lists the goals as (name, goal); ``canceled_goals`` the names of those canceled.
    """

    def __init__(self, name: str = "fakes", services: tuple[str, ...] = SERVICES, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.goals: list[tuple[str, Any]] = []
        self.canceled_goals: list[str] = []
        self.started = threading.Event()
        self.on_match: Callable[[Any], Any] = self.match
        self.on_plan: Callable[[Any, Callable[[], bool]], Any] = self.plan
        self.on_verify: Callable[[Any, Callable[[], bool]], Any] = self.verify
        group = ReentrantCallbackGroup()
        if "objects" in services:
            self._objects = self.create_publisher(SceneObjectArray, "objects", qos.LATCHED)
        self._eyes: Callable[[], Scene | None] = lambda: None
        self.create_timer(0.2, self._see, callback_group=group)
        self._servers: list[Any] = []
        if "match" in services:
            self.create_service(MatchContact, "match_contact", self._match, callback_group=group)
        if "plan" in services:
            self._servers.append(self._action(PlanMotion, "plan_motion", lambda g, c: self.on_plan(g, c), group))
        if "verify" in services:
            self._servers.append(self._action(VerifyMotion, "verify_motion", lambda g, c: self.on_verify(g, c), group))

    def destroy_node(self) -> None:
        """Take the action servers down with the node."""
        for server in self._servers:
            server.destroy()
        super().destroy_node()

    def publish(self, of: Scene) -> None:
        """Publish a scene as perception would, as seen just now."""
        stamp = self.get_clock().now().nanoseconds * 1e-9
        self._objects.publish(conversions.scene_to_msg(replace(of, stamp=stamp)))

    def see(self, eyes: Callable[[], Scene | None]) -> None:
        """Publish what ``eyes()`` gives, five times a second from now on; nothing where it gives ``None``."""
        self._eyes = eyes

    def _see(self) -> None:
        seen = self._eyes()
        if seen is not None:
            self.publish(seen)

    def clear(self) -> None:
        """Go back to the answers and lists of the start."""
        self.goals.clear()
        self.canceled_goals.clear()
        self.started.clear()
        self._eyes = lambda: None
        self.on_match, self.on_plan, self.on_verify = self.match, self.plan, self.verify

    @staticmethod
    def match(request: Any) -> Any:
        """Three candidates, the second one mirrored."""
        found = [candidate(score=1.0), candidate(score=0.9, flipped=True), candidate(score=0.8)]
        target = request.target_id or "object_2"
        return MatchContact.Response(code=0, candidates=[conversions.candidate_to_msg(c) for c in found], target_id=target, features="fake")

    @staticmethod
    def plan(goal: Any, canceled: Callable[[], bool]) -> Any:
        """The motion of :func:`plan`."""
        return PlanMotion.Result(code=0, message="planned", plan=conversions.plan_to_msg(plan(goal.variant), goal.tool.id))

    @staticmethod
    def verify(goal: Any, canceled: Callable[[], bool]) -> Any:
        """Every motion passes."""
        return VerifyMotion.Result(
            code=0,
            message="passed",
            success=True,
            success_rate=1.0,
            rate_low=0.86,
            rate_high=1.0,
            rollouts=1,
            metric_names=["pulled"],
            metric_values=[0.25],
        )

    @staticmethod
    def until_canceled(result: Any) -> Callable[[Any, Callable[[], bool]], Any]:
        """A handler that works until its goal is canceled, at most ten seconds."""

        def handler(goal: Any, canceled: Callable[[], bool]) -> Any:
            deadline = time.monotonic() + 10.0
            while not canceled() and time.monotonic() < deadline:
                time.sleep(0.005)
            result.code = int(Code.CANCELED)
            return result

        return handler

    def _match(self, request: Any, response: Any) -> Any:
        self.goals.append(("match", request))
        return self.on_match(request)

    def _action(self, kind: Any, name: str, handler: Callable[[Any, Callable[[], bool]], Any], group: Any) -> ActionServer:
        def execute(handle: Any) -> Any:
            self.goals.append((name, handle.request))
            self.started.set()
            result = handler(handle.request, lambda: handle.is_cancel_requested)
            if handle.is_cancel_requested:
                self.canceled_goals.append(name)
                handle.canceled()
            elif result.code == 0:
                handle.succeed()
            else:
                handle.abort()
            return result

        return ActionServer(self, kind, name, execute, cancel_callback=lambda handle: CancelResponse.ACCEPT, callback_group=group)


class FakeArm(Node):
    """A trajectory controller, a gripper and joint states: an arm that is where its last point told it to be, at once.

    ``log`` lists what it was told: the trajectories, and ("open" or "close", position, effort); ``goals`` the moves' goals.
    ``thickness`` is what is between the fingers, m.  ``on_move(trajectory, canceled)`` may be replaced; it returns (error_code,
    error_string). ``asked`` is set by the first trajectory, which is accepted once ``admits`` is set; ``moving`` by the first accepted
    one. ``positions`` of the joints, rad, and ``velocity``, rad/s, are told at 50 Hz while ``tells`` is set, ``late`` seconds late, with
    ``apart`` in two messages.  With ``squeezes`` the fingers close as far as they can, whatever they are told.
    ``bears(positions, closed)`` gives the joints' torques, Nm, where they are told.
    """

    def __init__(self, name: str = "fake_arm", thickness: float = 0.03, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.log: list[Any] = []
        self.goals: list[Any] = []
        self.thickness = thickness
        self.opening = 0.08
        self.positions = [0.0] * len(JOINTS)
        self.tells, self.squeezes = True, False
        self.late = self.velocity = 0.0
        self.apart = False
        self.bears: Callable[[Sequence[float], bool], Sequence[float]] | None = None
        #: Where the joints are is told in the order in which they were there.
        self._telling = threading.Lock()
        self.moving, self.admits = threading.Event(), threading.Event()
        self.admits.set()
        self.asked = threading.Event()
        self.on_move: Callable[[Any, Callable[[], bool]], tuple[int, str]] = lambda trajectory, canceled: (0, "")
        group = ReentrantCallbackGroup()
        self._states = self.create_publisher(JointState, "joint_states", qos.RELIABLE)
        self._servers = [
            ActionServer(
                self,
                FollowJointTrajectory,
                "arm/follow_joint_trajectory",
                self._move,
                goal_callback=self._admit,
                cancel_callback=lambda handle: CancelResponse.ACCEPT,
                callback_group=group,
            ),
            ActionServer(self, GripperCommand, "gripper/gripper_action", self._grip, callback_group=group),
        ]
        self.create_timer(0.02, self._tell, callback_group=group)

    def _tell(self) -> None:
        with self._telling:
            if self.tells:
                self._publish_state()

    def _publish_state(self) -> None:
        fingers, arm = [self.opening / 2] * len(FINGERS), list(self.positions)
        parts = [(JOINTS, arm), (FINGERS, fingers)] if self.apart else [((*FINGERS, *JOINTS), fingers + arm)]
        stamp = self.get_clock().now().nanoseconds - int(1e9 * self.late)
        for names, positions in parts:
            message = JointState(name=names, position=positions, velocity=[self.velocity] * len(names))
            if self.bears is not None:
                told = dict(zip(JOINTS, self.bears(arm, self.opening < 0.05)))
                message.effort = [float(told.get(name, 0.0)) for name in names]
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
            self._states.publish(message)

    def _admit(self, goal: Any) -> GoalResponse:
        self.asked.set()
        return GoalResponse.ACCEPT if self.admits.wait(10.0) else GoalResponse.REJECT

    def _move(self, handle: Any) -> Any:
        trajectory = handle.request.trajectory
        self.log.append(trajectory)
        self.goals.append(handle.request)
        self.moving.set()
        code, reason = self.on_move(trajectory, lambda: handle.is_cancel_requested)
        result = FollowJointTrajectory.Result(error_code=code, error_string=reason)
        if handle.is_cancel_requested:
            handle.canceled()
        elif code:
            handle.abort()
        else:
            with self._telling:
                self.positions = list(trajectory.points[-1].positions)
            self._tell()
            handle.succeed()
        return result

    def _grip(self, handle: Any) -> Any:
        command = handle.request.command
        wanted = 2 * command.position
        closing = wanted < self.opening
        self.log.append(("close" if closing else "open", command.position, command.max_effort))
        self.opening = max(0.0 if self.squeezes else wanted, self.thickness) if closing else wanted
        handle.succeed()
        return GripperCommand.Result(position=self.opening / 2, stalled=self.opening > wanted, reached_goal=self.opening == wanted)
