"""The node ``bridge``: between the graph and the messages of other software, each where that is installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from magic_core import conversions, qos
from magic_core.errors import Code, MagicError
from magic_core.node import describe, parameter, robot_parameters, run
from magic_core.robot import Description, RobotConfig
from magic_core.scene import Scene
from magic_core.tf_listener import TransformListener
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import SceneObjectArray
from magic_server import interop
from magic_server.planning_world import PlanningWorld

#: How often MoveIt is looked for, to be asked once for what it knows already, s.
ASKING = 1.0


def module_of(name: str) -> Any:
    """A module of message definitions, None where its package is not installed."""
    try:
        return import_module(name)
    except ImportError:
        return None


class Bridge(Node):
    """Speaks for the graph in the messages of vision_msgs and moveit_msgs, and hears MoveIt's obstacles.

    Subscribes ``objects``, ``in_hand``, ``verified_trajectory`` and the feedback of ``run_strategy``; of MoveIt
    ``monitored_planning_scene`` (PlanningScene, whole or a difference) and ``collision_object`` (CollisionObject).
    Publishes latched ``detections`` (vision_msgs/Detection3DArray), ``planning_scene`` (moveit_msgs/PlanningScene, a difference with
    the tool attached that is in the hand; remap it to MoveIt's ``/planning_scene``), ``verified_robot_trajectory``
    (moveit_msgs/RobotTrajectory, empty where nothing is valid), and ``obstacles`` (SceneObjectArray): what MoveIt knows of and this
    software has not told it itself, which perception puts among the objects.
    Serves ``plan_grasps`` (moveit_msgs/GraspPlanning): the grasp at the matched contact of the tool named, as the newest run verified it.
    Asks ``get_planning_scene`` (moveit_msgs/GetPlanningScene) once, for what MoveIt knew before this node began.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("bridge", **kwargs)
        robot = robot_parameters(self)
        link = parameter(
            self, "grasp_link", "", "link whose pose a Grasp tells, the end effector's parent link in MoveIt; empty: robot.move_group"
        )
        self._robot = Description(RobotConfig(**robot))
        self._link = link or self._robot.config.move_group
        if self._link not in self._robot.links:
            raise MagicError(Code.BAD_REQUEST, "parameter grasp_link", self._link, self._robot.links)
        self._vision, self._moveit = module_of("vision_msgs.msg"), module_of("moveit_msgs.msg")
        if self._vision is None and self._moveit is None:
            raise MagicError(Code.BAD_REQUEST, "messages of other software", "none installed", "vision_msgs or moveit_msgs")
        self._scene = self._held = None
        self._told: set[str] = set()
        self._attached: set[str] = set()
        self._out: dict[str, Any] = {}
        if self._vision is not None:
            self._out["detections"] = self.create_publisher(self._vision.Detection3DArray, "detections", qos.LATCHED)
        if self._moveit is not None:
            self._join_moveit()
        self.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED)
        self.get_logger().info("publishing " + ", ".join(self._out))

    def _join_moveit(self) -> None:
        moveit, services = self._moveit, import_module("moveit_msgs.srv")
        self._out["planning_scene"] = self.create_publisher(moveit.PlanningScene, "planning_scene", qos.LATCHED)
        self._out["verified_robot_trajectory"] = self.create_publisher(moveit.RobotTrajectory, "verified_robot_trajectory", qos.LATCHED)
        self._out["obstacles"] = self.create_publisher(SceneObjectArray, "obstacles", qos.LATCHED)
        self._transforms = TransformListener(self, MutuallyExclusiveCallbackGroup())
        self._world = PlanningWorld(self._base_from)
        self._grasps: dict[str, list[Any]] = {}
        self._runs: set[bytes] = set()
        self.create_subscription(SceneObjectArray, "in_hand", self._on_held, qos.LATCHED)
        self.create_subscription(JointTrajectory, "verified_trajectory", self._on_trajectory, qos.LATCHED)
        self.create_subscription(
            moveit.PlanningScene, "monitored_planning_scene", lambda m: self._hear(self._world.take_scene, m), qos.RELIABLE
        )
        self.create_subscription(moveit.CollisionObject, "collision_object", lambda m: self._hear(self._world.take, m), qos.RELIABLE)
        self.create_subscription(RunStrategy.Impl.FeedbackMessage, "run_strategy/_action/feedback", self._on_feedback, qos.RELIABLE)
        self._results = self.create_client(RunStrategy.Impl.GetResultService, "run_strategy/_action/get_result")
        self.create_service(services.GraspPlanning, "plan_grasps", self._on_grasps)
        self._asked = self.create_client(services.GetPlanningScene, "get_planning_scene")
        self._asking = self.create_timer(ASKING, lambda: self._ask(services.GetPlanningScene))

    # ------------------------------------------------------------ out

    def _on_objects(self, scene: SceneObjectArray) -> None:
        try:
            self._scene = scene
            if "detections" in self._out:
                self._out["detections"].publish(interop.detections(scene, self._vision))
            self._tell_scene()
        except Exception as error:  # the next objects may be told
            self.get_logger().error(describe(self, error)[1])

    def _on_held(self, held: SceneObjectArray) -> None:
        try:
            loose = self._attached - {item.id for item in held.objects}
            self._held, self._attached = held, {item.id for item in held.objects}
            if loose:
                self._out["planning_scene"].publish(interop.let_go(loose, self._moveit))
            self._tell_scene()
        except Exception as error:
            self.get_logger().error(describe(self, error)[1])

    def _tell_scene(self) -> None:
        if self._scene is None or self._moveit is None:
            return
        leave = self._world.names()
        here = {item.id for item in self._scene.objects} - leave
        message = interop.planning_scene(
            self._scene, self._moveit, self._held, sorted(self._robot.finger_links), self._told - here - leave, leave
        )
        self._told = here
        self._out["planning_scene"].publish(message)

    def _on_trajectory(self, trajectory: JointTrajectory) -> None:
        self._out["verified_robot_trajectory"].publish(interop.robot_trajectory(trajectory, self._moveit))

    # ------------------------------------------------------------ grasps

    def _on_feedback(self, message: Any) -> None:
        """A run is at work: ask for its result, which comes when it has ended."""
        run = bytes(message.goal_id.uuid)
        if run in self._runs:
            return
        self._runs = {run}
        request = RunStrategy.Impl.GetResultService.Request(goal_id=message.goal_id)
        self._results.call_async(request).add_done_callback(lambda future: self._on_result(future.result().result))

    def _on_result(self, result: RunStrategy.Result) -> None:
        try:
            # What an earlier run found is for a scene that is past.
            self._grasps = {result.tool_id: interop.grasps(result, self._robot, self._link, self._moveit)}
        except Exception as error:
            self.get_logger().error(describe(self, error)[1])

    def _on_grasps(self, request: Any, response: Any) -> Any:
        response.grasps = self._grasps.get(request.target.id, [])
        codes = self._moveit.MoveItErrorCodes
        response.error_code.val = codes.SUCCESS if response.grasps else codes.PLANNING_FAILED
        return response

    # ------------------------------------------------------------ obstacles in

    def _base_from(self, header: Header) -> NDArray[np.float64]:
        frame, base = header.frame_id.lstrip("/"), self._robot.base_frame
        if frame in ("", base):
            return np.eye(4)
        with self._transforms.lock:
            stamp = conversions.time_from_msg(header.stamp)
            return self._transforms.buffer.lookup(base, frame, stamp or None)

    def _ask(self, service: Any) -> None:
        if not self._asked.service_is_ready():
            return
        self._asking.cancel()
        request = service.Request()
        components = self._moveit.PlanningSceneComponents
        request.components.components = (
            components.WORLD_OBJECT_NAMES | components.WORLD_OBJECT_GEOMETRY | components.ROBOT_STATE_ATTACHED_OBJECTS
        )
        self._asked.call_async(request).add_done_callback(lambda future: self._hear(self._world.take_scene, future.result().scene))

    def _hear(self, take: Any, message: Any) -> None:
        own = {interop.TABLE, *self._attached, *self._told}
        try:
            notes = take(message, own)
            found = Scene(self._world.obstacles(), np.array([0.0, 0.0, 1.0, 0.0]), frame_id=self._robot.base_frame)
        except Exception as error:
            self.get_logger().error(f"of MoveIt's scene: {describe(self, error)[1]}")
            return
        for note in notes:
            self.get_logger().warning(note)
        out = conversions.scene_to_msg(found)
        out.header.stamp = self.get_clock().now().to_msg()
        self._out["obstacles"].publish(out)


def main() -> None:
    """Entry point of ``ros2 run magic_bringup bridge``."""
    run(Bridge)


if __name__ == "__main__":
    main()
