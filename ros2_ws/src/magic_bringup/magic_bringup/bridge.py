"""The node ``bridge``: what the graph sees and has verified, in the messages of other software, each where that is installed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory

from magic_core import qos
from magic_core.errors import Code, MagicError
from magic_core.node import describe, run
from magic_interfaces.msg import SceneObjectArray
from magic_server import interop


def messages_of(package: str) -> Any:
    """The messages of a package, None where it is not installed."""
    try:
        return import_module(f"{package}.msg")
    except ImportError:
        return None


class Bridge(Node):
    """Subscribes ``objects`` and ``verified_trajectory``, publishes latched

    ``detections`` (vision_msgs/Detection3DArray), ``planning_scene`` (moveit_msgs/PlanningScene, a difference; remap it to MoveIt's
    ``/planning_scene``) and ``verified_robot_trajectory`` (moveit_msgs/RobotTrajectory, empty where nothing is valid).
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("bridge", **kwargs)
        self._vision, self._moveit = messages_of("vision_msgs"), messages_of("moveit_msgs")
        self._out: dict[str, Any] = {}
        if self._vision is not None:
            self._out["detections"] = self.create_publisher(self._vision.Detection3DArray, "detections", qos.LATCHED)
        if self._moveit is not None:
            self._out["planning_scene"] = self.create_publisher(self._moveit.PlanningScene, "planning_scene", qos.LATCHED)
            self._out["verified_robot_trajectory"] = self.create_publisher(
                self._moveit.RobotTrajectory, "verified_robot_trajectory", qos.LATCHED
            )
            self.create_subscription(JointTrajectory, "verified_trajectory", self._on_trajectory, qos.LATCHED)
        if not self._out:
            raise MagicError(Code.BAD_REQUEST, "messages of other software", "none installed", "vision_msgs or moveit_msgs")
        self.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED)
        self.get_logger().info("publishing " + ", ".join(self._out))

    def _on_objects(self, scene: SceneObjectArray) -> None:
        try:
            if "detections" in self._out:
                self._out["detections"].publish(interop.detections(scene, self._vision))
            if "planning_scene" in self._out:
                self._out["planning_scene"].publish(interop.planning_scene(scene, self._moveit))
        except Exception as error:  # the next objects may be told
            self.get_logger().error(describe(self, error)[1])

    def _on_trajectory(self, trajectory: JointTrajectory) -> None:
        self._out["verified_robot_trajectory"].publish(interop.robot_trajectory(trajectory, self._moveit))


def main() -> None:
    """Entry point of ``ros2 run magic_bringup bridge``."""
    run(Bridge)


if __name__ == "__main__":
    main()
