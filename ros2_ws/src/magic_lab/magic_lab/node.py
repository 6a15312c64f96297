"""The laboratory as a node: what two RealSense cameras, a Panda and its controllers would publish and serve."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from control_msgs.action import FollowJointTrajectory, GripperCommand
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from magic_core import conversions as cv
from magic_core import qos, sensor, transforms
from magic_core.diagnostics import Diagnostics, status
from magic_core.node import RESULT_TIMEOUT, describe, parameter, robot_parameters, run
from magic_core.robot import Description, RobotConfig
from magic_core.robot_pictures import link_mesh
from magic_core.scene import Scene as KnownScene
from magic_interfaces.msg import SceneObjectArray
from magic_lab.cameras import Bodies, Camera
from magic_lab.controllers import Error, Point, RefusedError
from magic_lab.judge import PUT
from magic_lab.laboratory import TICK, Lab
from magic_lab.scenarios import EVENTS, SCENARIOS, Event, Scenario, case_of, draw, scenario_of
from magic_verifier.cases import Case

Array = NDArray[np.float64]

#: Ticks between two messages of each kind: /clock at 10 Hz, as each of them wakes every node; /tf at 20 Hz (robot_state_publisher's own);
#: the truth at 20 Hz.
CLOCK_EVERY, TF_EVERY, TRUTH_EVERY = 10, 5, 5
#: Seconds between two words of a trajectory's feedback.
FEEDBACK = 0.05
#: How far this clock may be behind the wall's before the difference is given up, s: it never runs faster to catch up.
BEHIND = 0.05
#: How long a reset may take, s.
RESET = 60.0
#: The truth's name for the point between the fingertips.
TCP = "tcp"
#: Pose of the optical frame in the camera's colour frame, as the RealSense driver has it (REP-103).
OPTICAL = transforms.from_rpy(-np.pi / 2, 0.0, -np.pi / 2)


class LabNode(Node):
    """A simulated laboratory behind the names of a real one.

    Publishes
        /clock: its own, which follows the wall's at ``rate`` and is slower where the machine is: every other node needs use_sim_time.
        For each camera NAME, left and right, at ``camera_rate``: ``camera/NAME/color/image_raw`` (rgb8), ``color/camera_info``,
        ``aligned_depth_to_color/image_raw`` (16UC1, mm), ``aligned_depth_to_color/camera_info``; ``joint_states`` at 100 Hz;
        /tf (the arm's links, 20 Hz), /tf_static (cameras, fixed links); ``known_objects`` (latched): the scene's fixtures.
        ``lab/truth`` (tf2_msgs/TFMessage, 20 Hz): where everything truly is, for judging alone.
    Serves
        ``trajectory_action`` (control_msgs/FollowJointTrajectory), ``gripper_action`` (control_msgs/GripperCommand), and
        ``lab/reset`` (std_srvs/Trigger): the scene anew, of the parameters scenario, object, seed and events as they are then.
    """

    def __init__(self) -> None:
        super().__init__("lab")
        self._read()
        self.robot = Description(RobotConfig(**robot_parameters(self)))
        self._base = self.robot.base_frame
        links = {link: mesh for link in self.robot.links if (mesh := link_mesh(self.robot, link)) is not None and len(mesh.faces)}
        self._links = Bodies(links)
        self._lock = threading.Lock()  # of the lab between two ticks
        self._resets: list[tuple[threading.Event, list[str]]] = []
        self._stopping = False
        self._epoch = time.time()  # of the clock
        self._ticks = 0  # of it since then; goes on through resets
        self._began = 0  # tick of the last reset
        self._speed = 0.0
        self._pictures = 0
        self._trouble = ""
        group = ReentrantCallbackGroup()
        out = self.create_publisher
        self._clock_out = out(Clock, "/clock", 10)
        self._joints_out = out(JointState, "joint_states", qos.RELIABLE)
        self._tf_out, self._static_out = out(TFMessage, "/tf", qos.RELIABLE), out(TFMessage, "/tf_static", qos.STATIC_TF)
        self._known_out = out(SceneObjectArray, "known_objects", qos.LATCHED)
        self._truth_out = out(TFMessage, "lab/truth", qos.RELIABLE)
        self._camera_out: dict[str, Any] = {}
        self._reset()
        self._static_out.publish(TFMessage(transforms=self._static()))
        self._arm_server = self._server(FollowJointTrajectory, self._arm_action, self._follow, self._admit, group)
        self._gripper_server = self._server(GripperCommand, self._gripper_action, self._grip, self._admit_grip, group)
        self.create_service(Trigger, "lab/reset", self._on_reset, callback_group=group)
        self._diagnostics = Diagnostics(self, self._report, group)
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _server(self, kind: Any, name: str, execute: Callable[[Any], Any], admit: Callable[[Any], Any], group: Any) -> ActionServer:
        """An action server whose goals may always be cancelled."""
        return ActionServer(
            self,
            kind,
            name,
            execute,
            goal_callback=admit,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
            result_timeout=RESULT_TIMEOUT,
        )

    # ------------------------------------------------------------ parameters

    def _read(self) -> None:
        parameter(self, "scenario", "hooking", "what stands there and what happens", choices=tuple(SCENARIOS), read_only=False)
        parameter(self, "object", "", "which of the scenario's objects; empty: the seed chooses", read_only=False)
        parameter(self, "seed", 0, "of everything that is drawn", low=0, high=2**31 - 1, read_only=False)
        kinds = "; ".join(f"{kind}: {what}" for kind, what in EVENTS.items())
        parameter(self, "events", "", f"more that happens, KIND@MOVE+SECONDS with spaces between; {kinds}", read_only=False)
        self._rate = parameter(self, "rate", 1.0, "of this clock, as a share of the wall's, at most", low=0.05, high=20.0)
        camera_rate = parameter(self, "camera_rate", 5.0, "pictures of each camera a second", low=0.1, high=30.0)
        self._picture_every = max(1, round(1 / (camera_rate * TICK)))
        self._strategies = parameter(self, "strategies", "", "folder of the strategies; empty: the installed ones")
        self._arm_action = parameter(self, "trajectory_action", "panda_arm_controller/follow_joint_trajectory", "action of the arm")
        self._gripper_action = parameter(self, "gripper_action", "panda_gripper/gripper_action", "action of the gripper")
        self._allow_stalling = parameter(
            self,
            "allow_stalling",
            False,
            "the gripper succeeds where it stalls elsewhere than it was told to close to, instead of aborting",
        )
        self.add_on_set_parameters_callback(self._on_parameters)

    def _scene_parameters(self) -> tuple[Scenario, Case, int, tuple[Event, ...]]:
        """Scenario, case, seed and events as the parameters have them; raises BAD_REQUEST."""
        value = {name: self.get_parameter(name).value for name in ("scenario", "object", "seed", "events")}
        scenario = scenario_of(value["scenario"])
        return scenario, case_of(scenario, value["object"], value["seed"]), value["seed"], _events(value["events"])

    def _on_parameters(self, given: list[Parameter]) -> SetParametersResult:
        """Refuse what is none; an object is looked for at the reset: another scenario may be set after it."""
        checks: dict[str, Callable[[Any], Any]] = {"scenario": scenario_of, "events": _events}
        try:
            for one in given:
                checks.get(one.name, lambda _: None)(one.value)
        except Exception as error:
            return SetParametersResult(successful=False, reason=describe(self, error)[1])
        return SetParametersResult(successful=True)

    # ------------------------------------------------------------ the scene

    def _reset(self) -> str:
        """The scene anew; what came of it, in a sentence.  Raises BAD_REQUEST, BAD_SCENE."""
        scenario, case, seed, events = self._scene_parameters()
        scene = draw(scenario, case, seed, self._strategies)
        lab = Lab(scene, self.robot, events, self._allow_stalling)
        bodies = Bodies({thing.name: thing.item.mesh for thing in lab.scene.things}, self._links)
        self._cameras = [Camera(name, pose, bodies) for name, pose in sensor.STATION.items()]
        old = getattr(self, "lab", None)
        with self._lock:
            self.lab, self._began = lab, self._ticks
            self._pictures = 0
        if old is not None:
            self._end_goals(old, "the laboratory was reset")
        known = KnownScene(scene.known, np.array([0.0, 0.0, 1.0, 0.0]), self.now, self._base)
        self._known_out.publish(cv.scene_to_msg(known))
        names = ", ".join(f"{thing.name} ({thing.density:.0f} kg/m^3, friction {thing.friction:.2f})" for thing in scene.things)
        return f"{scenario.name}, {case.name}, seed {seed}: {names}"

    @staticmethod
    def _end_goals(lab: Lab, reason: str) -> None:
        lab.arm.abort(Error.INVALID_GOAL, reason)
        if lab.gripper.goal is not None:
            lab.gripper.cancel(lab.gripper.goal)

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        asked, answer = threading.Event(), []
        self._resets.append((asked, answer))
        response.success = asked.wait(RESET) and answer[0] == ""
        response.message = answer[-1] if answer else f"no answer within {RESET:g} s"
        return response

    # ------------------------------------------------------------ time

    @property
    def now(self) -> float:
        """Seconds since the epoch by the laboratory's clock."""
        return self._epoch + self._ticks * TICK

    def _live(self) -> None:
        """Go on tick by tick, no faster than the wall's clock times ``rate``."""
        due = time.monotonic()
        second, ticks = due, self._ticks
        while not self._stopping:
            try:
                self._answer_resets()
                with self._lock:
                    self.lab.tick()
                    self._ticks += 1
                self._publish()
                self._trouble = ""
            except Exception as error:
                if self._stopping:
                    return
                self._trouble = describe(self, error)[1]
                self.get_logger().error(f"{self._trouble}: the scene begins anew")
                self._begin_anew()
            due += TICK / self._rate
            late = time.monotonic() - due
            if late > BEHIND:
                due += late - BEHIND
            elif late < 0:
                time.sleep(-late)
            if time.monotonic() - second > 1.0:
                self._speed = (self._ticks - ticks) * TICK / (time.monotonic() - second)
                second, ticks = time.monotonic(), self._ticks

    def _begin_anew(self) -> None:
        """After what must not happen; where that fails as well the laboratory stands still, and its goals end."""
        try:
            self._reset()
        except Exception as error:
            self._trouble = describe(self, error)[1]
            self.get_logger().error(f"{self._trouble}: the laboratory stands still")
            self._stopping = True

    def _answer_resets(self) -> None:
        while self._resets:
            asked, answer = self._resets.pop(0)
            try:
                told = self._reset()
                answer += ["", told]
            except Exception as error:
                told = describe(self, error)[1]
                answer += ["refused", told]
            self.get_logger().info(told)
            asked.set()

    # ------------------------------------------------------------ what comes out

    def _publish(self) -> None:
        lab, tick, stamp = self.lab, self._ticks - self._began, self.now
        if self._ticks % CLOCK_EVERY == 0:
            self._clock_out.publish(Clock(clock=cv.time_to_msg(stamp)))
        q, qd = lab.joints
        positions = self.robot.arm_positions(q)
        if not lab.silent.joints:
            efforts = [*lab.torques().tolist(), 0.0, 0.0]
            self._joints_out.publish(
                JointState(header=cv.header("", stamp), name=list(positions), position=q.tolist(), velocity=qd.tolist(), effort=efforts)
            )
            if tick % TF_EVERY == 0:
                moving = [joint for joint in self.robot.joints.values() if joint.name in positions]
                places = [(j.parent, j.child, j.parent_from_joint @ j.motion(positions[j.name])) for j in moving]
                self._tf_out.publish(TFMessage(transforms=self._transforms(places, stamp)))
        if tick % TRUTH_EVERY == 0:
            truth = {**lab.world.poses(), TCP: lab.world.tcp(), **{name + PUT: pose for name, pose in lab.put.items()}}
            places = [(self._base, name, pose) for name, pose in truth.items()]
            self._truth_out.publish(TFMessage(transforms=self._transforms(places, stamp)))
        if tick % self._picture_every == 0:
            self._photograph(lab, positions, stamp)

    def _photograph(self, lab: Lab, positions: dict[str, float], stamp: float) -> None:
        links = self.robot.poses(positions)
        poses = {**{name: links[name] for name in self._links.casters}, **lab.world.poses()}
        self._pictures += 1
        for number, camera in enumerate(self._cameras):
            if number == 0 and lab.silent.camera:
                continue
            frame = camera.picture(poses, [lab.scene.seed, self._pictures, number], stamp)
            for topic, message in cv.frame_to_msgs(frame).items():
                name = f"camera/{camera.name}/{topic}"
                if name not in self._camera_out:
                    self._camera_out[name] = self.create_publisher(type(message), name, qos.RELIABLE)
                self._camera_out[name].publish(message)

    def _transforms(self, places: Sequence[tuple[str, str, Array]], stamp: float) -> list[TransformStamped]:
        """Of parents, children and poses parent_from_child (4, 4)."""
        names = {self.robot.base: self._base}
        return [
            TransformStamped(header=cv.header(names.get(parent, parent), stamp), child_frame_id=child, transform=transform)
            for (parent, child, _), transform in zip(places, cv.transforms_to_msgs(np.stack([pose for *_, pose in places])), strict=True)
        ]

    def _static(self) -> list[TransformStamped]:
        """The cameras as calibrated, each with its driver's frames, and the links that do not move."""
        places: list[tuple[str, str, Array]] = []
        for camera in self._cameras:
            name = camera.name
            places += (
                (self._base, f"{name}_link", camera.world_from_camera @ transforms.inverse(OPTICAL)),
                (f"{name}_link", f"{name}_color_frame", np.eye(4)),
                (f"{name}_color_frame", f"{name}_color_optical_frame", OPTICAL),
            )
        places += [(j.parent, j.child, j.parent_from_joint) for j in self.robot.joints.values() if j.name not in self.robot.moving]
        return self._transforms(places, self.now)

    def _report(self) -> list[DiagnosticStatus]:
        lab = self.lab
        level = DiagnosticStatus.ERROR if self._trouble else DiagnosticStatus.OK
        message = self._trouble or f"simulated: /clock runs at {self._speed:.2f} of the wall's speed; other nodes need use_sim_time"
        values = {
            "scenario": lab.scene.scenario.name,
            "object": lab.scene.case.name,
            "seed": lab.scene.seed,
            "seconds since the reset": round(lab.time, 2),
            "held": lab.world.held or "nothing",
            "happened": ", ".join(event.kind for event in lab.happened) or "nothing",
        }
        return [status(self, "laboratory", level, message, values)]

    # ------------------------------------------------------------ actions

    def _points(self, trajectory: Any) -> list[Point]:
        return [
            Point(cv.time_from_msg(p.time_from_start), list(p.positions), list(p.velocities), list(p.accelerations))
            for p in trajectory.points
        ]

    def _stamp(self, message: Any) -> float:
        """A trajectory's stamp by the lab's own time since its reset; 0: at once."""
        stamp = cv.time_from_msg(message)
        return stamp - self._epoch - self._began * TICK if stamp > 0 else 0.0

    def _admit(self, request: FollowJointTrajectory.Goal) -> GoalResponse:
        try:
            trajectory = request.trajectory
            self.lab.arm.check(trajectory.joint_names, self._points(trajectory), self._stamp(trajectory.header.stamp), self.lab.time)
        except RefusedError as error:
            self.get_logger().warning(f"trajectory refused [{error.code.name}]: {error.reason}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _admit_grip(self, request: GripperCommand.Goal) -> GoalResponse:
        command = request.command
        if np.isfinite([command.position, command.max_effort]).all():
            return GoalResponse.ACCEPT
        self.get_logger().warning(
            f"gripper command refused: position {command.position}, effort {command.max_effort} (allowed: finite numbers)"
        )
        return GoalResponse.REJECT

    def _follow(self, handle: Any) -> FollowJointTrajectory.Result:
        request, result = handle.request, FollowJointTrajectory.Result()
        trajectory = request.trajectory
        try:
            with self._lock:
                lab = self.lab
                goal = lab.arm.begin(
                    trajectory.joint_names,
                    self._points(trajectory),
                    lab.time,
                    self._stamp(trajectory.header.stamp),
                    {t.name: t.position for t in request.path_tolerance},
                    {t.name: t.position for t in request.goal_tolerance},
                    cv.time_from_msg(request.goal_time_tolerance),
                )
                lab.moved()
        except RefusedError as error:
            result.error_code, result.error_string = int(error.code), error.reason
            handle.abort()
            return result
        told = 0.0

        def look() -> None:
            nonlocal told
            if lab.time - told >= FEEDBACK:
                told = lab.time
                handle.publish_feedback(self._feedback(lab))

        self._wait(handle, goal.done, lambda: lab.arm.cancel(goal), look)
        result.error_code, result.error_string = int(goal.code), goal.reason
        self._end(handle, goal.canceled, goal.code != Error.SUCCESSFUL)
        return result

    def _feedback(self, lab: Lab) -> FollowJointTrajectory.Feedback:
        count = len(self.robot.names)
        (wanted, speed), q, qd = lab.arm.desired, lab.joints[0][:count], lab.joints[1][:count]
        feedback = FollowJointTrajectory.Feedback(header=cv.header(self._base, self.now), joint_names=list(self.robot.names))
        for point, positions, velocities in (
            (feedback.desired, wanted, speed),
            (feedback.actual, q, qd),
            (feedback.error, wanted - q, speed - qd),
        ):
            point.positions, point.velocities = positions.tolist(), velocities.tolist()
        return feedback

    def _grip(self, handle: Any) -> GripperCommand.Result:
        command = handle.request.command
        with self._lock:
            lab = self.lab
            goal = lab.grip(command.position, command.max_effort)

        def stop() -> None:
            lab.leave_fingers(goal)

        self._wait(handle, goal.done, stop)
        self._end(handle, goal.canceled, goal.aborted)
        found = float(lab.joints[0][-1])
        return GripperCommand.Result(position=found, effort=command.max_effort, stalled=goal.stalled, reached_goal=goal.reached)

    def _wait(self, handle: Any, done: threading.Event, cancel: Callable[[], None], look: Callable[[], None] = lambda: None) -> None:
        """Until a goal has ended; a cancel request is passed on."""
        while not done.wait(TICK):
            if handle.is_cancel_requested or self._stopping:
                with self._lock:
                    cancel()
            look()

    @staticmethod
    def _end(handle: Any, canceled: bool, failed: bool) -> None:
        """Bring a goal into the state that belongs to what became of it."""
        if canceled and handle.is_cancel_requested:
            handle.canceled()
        elif failed or canceled:
            handle.abort()
        else:
            handle.succeed()

    # ------------------------------------------------------------ end

    def wind_down(self) -> bool:
        """End what is at work; whether all has ended."""
        self._stopping = True
        with self._lock:
            self._end_goals(self.lab, "the laboratory closes")
        self._thread.join(0.5)
        return not self._thread.is_alive()

    def destroy_node(self) -> None:
        """Stop the world and take the action servers down before the node."""
        self._stopping = True
        if hasattr(self, "_thread"):
            self._thread.join(5.0)
            self._arm_server.destroy()
            self._gripper_server.destroy()
        super().destroy_node()


def _events(text: str) -> tuple[Event, ...]:
    return tuple(map(Event.parse, text.split()))


def main() -> None:
    """Entry point of ``ros2 run magic_lab lab``."""
    run(LabNode, threads=8)


if __name__ == "__main__":
    main()
