"""Writes what two cameras, a robot and calibrated fixtures would publish as a bag.  Needs the message packages, but no running graph.

Topics, types, frames and QoS are those of the RealSense driver with ``align_depth`` and of
the Panda's state broadcaster::

    /camera/NAME/color/image_raw                    sensor_msgs/msg/Image       rgb8
    /camera/NAME/color/camera_info                  sensor_msgs/msg/CameraInfo
    /camera/NAME/aligned_depth_to_color/image_raw   sensor_msgs/msg/Image       16UC1, mm, 0: none
    /camera/NAME/aligned_depth_to_color/camera_info sensor_msgs/msg/CameraInfo
    /tf_static                                      tf2_msgs/msg/TFMessage      panda_link0 -> NAME_color_optical_frame, latched
    /joint_states                                   sensor_msgs/msg/JointState
    /known_objects                                  magic_interfaces/msg/SceneObjectArray, latched
    /demonstration/tool_pose, target_pose           geometry_msgs/msg/PoseStamped
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_bags.bag_file import BagWriter, message_definition
from magic_core import conversions as convert
from magic_core.camera import RgbdFrame
from magic_core.scene import Scene, SceneObject

#: Frame of all poses, and the arm's joints with its usual ready pose, fingers open (rad, m).
WORLD = "panda_link0"
JOINTS = (*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2")
READY = (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4, 0.04, 0.04)


def _profile(latched: bool, depth: int) -> Any:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(sec=9223372036, nsec=854775807)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def _type_name(message: Any) -> str:
    """``sensor_msgs/msg/Image`` of a message of that type."""
    package, kind = type(message).__module__.split(".")[0], type(message).__name__
    return f"{package}/msg/{kind}"


class Recording:
    """A bag under construction; use it in a ``with`` statement.  Raises ``BAD_BAG`` where the folder exists.

    Equal content gives equal bytes, unless ``repeatable`` is false, which takes half the time.  Stamps are seconds since the epoch.
    """

    def __init__(self, path: Path | str, repeatable: bool = True) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._writer = BagWriter(path)
        self._repeatable = repeatable
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._topics: set[str] = set()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writer.close()

    def write(self, topic: str, message: Any, stamp: float, latched: bool = False, depth: int = 10) -> None:
        """One message of any installed type; the topic is declared with its first message."""
        from rclpy.serialization import serialize_message
        from rosbags.serde import SerdeError
        from rosbags.typesys import get_types_from_msg

        name = _type_name(message)
        if topic not in self._topics:
            self._topics.add(topic)
            self._writer.add_topic(topic, name, (_profile(latched, depth),))
            if name not in self._store.fielddefs:
                self._store.register(
                    {k: v for k, v in get_types_from_msg(message_definition(name)[0], name).items() if k not in self._store.fielddefs}
                )
        data = serialize_message(message)
        if self._repeatable:
            # Padding in DDS's serialisation is whatever was in memory; written once more, it is zero.  What the library cannot read over
            # again is written as it is.
            with contextlib.suppress(SerdeError):
                data = bytes(self._store.serialize_cdr(self._store.deserialize_cdr(data, name), name))
        self._writer.write(topic, round(stamp * 1e9), data)

    def cameras(self, frames: Sequence[RgbdFrame], stamp: float) -> None:
        """The static transforms of the cameras that took these frames, one frame a camera, in one message."""
        from geometry_msgs.msg import TransformStamped
        from tf2_msgs.msg import TFMessage

        transforms = [
            TransformStamped(
                header=convert.header(WORLD, stamp),
                child_frame_id=f"{frame.camera}_color_optical_frame",
                transform=convert.transform_to_msg(frame.world_from_camera),
            )
            for frame in frames
        ]
        self.write("/tf_static", TFMessage(transforms=transforms), stamp, latched=True, depth=1)

    def frame(self, frame: RgbdFrame) -> None:
        """Colour, depth and their camera_info of one frame, at its stamp."""
        for topic, message in convert.frame_to_msgs(frame).items():
            self.write(f"/camera/{frame.camera}/{topic}", message, frame.stamp)

    def joints(self, stamp: float, positions: Sequence[float] = READY) -> None:
        """The arm's joint positions (9,), rad and m."""
        from sensor_msgs.msg import JointState

        self.write(
            "/joint_states",
            JointState(
                header=convert.header("", stamp),
                name=list(JOINTS),
                position=[float(p) for p in positions],
                velocity=[0.0] * 9,
                effort=[0.0] * 9,
            ),
            stamp,
        )

    def known_objects(self, objects: Sequence[SceneObject], stamp: float) -> None:
        """Calibrated fixtures."""
        scene = Scene(tuple(objects), np.array([0.0, 0.0, 1.0, 0.0]), stamp, WORLD)
        self.write("/known_objects", convert.scene_to_msg(scene), stamp, latched=True, depth=1)

    def pose(self, topic: str, world_from_object: NDArray[np.float64], stamp: float) -> None:
        """A pose in the world."""
        from geometry_msgs.msg import PoseStamped

        self.write(topic, PoseStamped(header=convert.header(WORLD, stamp), pose=convert.pose_to_msg(world_from_object)), stamp)
