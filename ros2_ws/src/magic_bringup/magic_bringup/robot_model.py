"""The node ``robot_model``: what RViz and Foxglove need to show the arm, and the verified trajectory played by a second, ghostly one."""

from __future__ import annotations

import copy
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory

from magic_core import conversions, qos
from magic_core.node import robot_parameters, run
from magic_core.robot import Description, RobotConfig

#: The second arm's frames are the first one's with this before them: the "TF Prefix" of RViz's RobotModel.
GHOST = "ghost"
#: How long the ghost stands at the end of the trajectory, before it begins again, s.
PAUSE = 1.5
#: Between two pictures, s.
PERIOD = 0.05


def shown(robot: Description) -> str:
    """The URDF with its meshes named by absolute files, as programs that know no package of this name can load them."""
    root = copy.deepcopy(robot.root)
    for mesh in root.iter("mesh"):
        path = robot.mesh_file(mesh.get("filename", ""))
        if path is not None:
            mesh.set("filename", f"file://{path}")
    return ET.tostring(root, encoding="unicode")


def link_frames(robot: Description, positions: Mapping[str, float], prefix: str = "") -> dict[tuple[str, str], NDArray[np.float64]]:
    """parent_from_child (4, 4) by the names of both, for each joint of the URDF, as robot_state_publisher tells it; joints not named
    are at zero.  With a prefix the names have it, and the root stands where the robot's does."""
    before = f"{prefix}/" if prefix else ""
    frames = {
        (before + joint.parent, before + joint.child): joint.parent_from_joint @ joint.motion(float(positions.get(joint.name, 0.0)))
        for joint in robot.joints.values()
    }
    if prefix or robot.base_frame != robot.base:
        frames[robot.base_frame, before + robot.base] = np.eye(4)
    return frames


def played(times: Sequence[float], positions: NDArray[np.float64], since: float) -> NDArray[np.float64]:
    """Where a trajectory, positions (N, J) at times (N,) s, is ``since`` seconds after it was begun; after a pause it begins again."""
    at = since % (times[-1] + PAUSE)
    return np.array([np.interp(at, times, column) for column in np.asarray(positions).T])


class RobotModel(Node):
    """Subscribes ``joint_states`` and ``verified_trajectory`` (latched); publishes ``robot_description`` (latched) and ``/tf``.

    It does what robot_state_publisher does, and is not to run beside one but with the parameter ``ghost_only``.  Parameters:
    ``robot.*`` and ``ghost_only``.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("robot_model", **kwargs)
        self.robot = Description(RobotConfig(**robot_parameters(self)))
        self._ghost_only = self.declare_parameter("ghost_only", False).value
        self._heard: dict[str, float] = dict(zip(self.robot.names, self.robot.config.home, strict=True))
        self._ghost: tuple[list[str], list[float], NDArray[np.float64], float] | None = None
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        if not self._ghost_only:
            self._description = self.create_publisher(String, "robot_description", qos.LATCHED)
            self._description.publish(String(data=shown(self.robot)))
        self.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR)
        self.create_subscription(JointTrajectory, "verified_trajectory", self._on_trajectory, qos.LATCHED)
        self.create_timer(PERIOD, self._tell)

    def _on_joints(self, message: JointState) -> None:
        self._heard.update(zip(message.name, message.position, strict=False))

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if not message.points:
            self._ghost = None
            return
        times = [conversions.time_from_msg(point.time_from_start) for point in message.points]
        rows = np.array([point.positions for point in message.points])
        self._ghost = list(message.joint_names), times, rows, time.monotonic()

    def _tell(self) -> None:
        frames = {} if self._ghost_only else link_frames(self.robot, self._heard)
        ghost = dict(self._heard)
        if self._ghost is not None:
            names, times, rows, began = self._ghost
            ghost.update(zip(names, played(times, rows, time.monotonic() - began), strict=True))
        frames |= link_frames(self.robot, ghost, GHOST)
        stamp = self.get_clock().now().to_msg()
        moved = conversions.transforms_to_msgs(np.stack(list(frames.values())))
        self._tf.publish(
            TFMessage(
                transforms=[
                    TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child, transform=transform)
                    for (parent, child), transform in zip(frames, moved, strict=True)
                ]
            )
        )


def main() -> None:
    """Entry point of ``ros2 run magic_bringup robot_model``."""
    run(RobotModel)


if __name__ == "__main__":
    main()
