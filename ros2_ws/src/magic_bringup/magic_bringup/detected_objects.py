"""The node ``detected_objects``: objects by somebody else's detector, in place of perception."""

from __future__ import annotations

from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header

from magic_bringup.bridge import module_of
from magic_core import conversions, qos
from magic_core.diagnostics import Diagnostics, status
from magic_core.errors import Code, MagicError
from magic_core.node import describe, parameter, run
from magic_core.scene import SceneObject
from magic_core.tf_listener import TransformListener
from magic_interfaces.msg import SceneObjectArray
from magic_server.detected import Meshes, scene_of


class DetectedObjects(Node):
    """Subscribes ``detections_in`` (vision_msgs/Detection3DArray) and, latched, ``known_objects`` and
    ``obstacles``; publishes ``objects``, latched.

    A detection's class id names its mesh in the folder ``meshes``; its pose is the mesh's.  The table is the plane ``table``.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("detected_objects", **kwargs)
        vision = module_of("vision_msgs.msg")
        if vision is None:
            raise MagicError(Code.BAD_REQUEST, "package vision_msgs", "not installed", "installed: the detections come in its messages")
        self._frame = parameter(self, "frame", "panda_link0", "frame of the results, z up: the robot's base")
        self._meshes = Meshes(
            parameter(self, "meshes", ".", "folder with a mesh in metres for each class id: <class id>.ply, .obj or .stl")
        )
        self._score = parameter(self, "least_score", 0.3, "a hypothesis with a lower score is left out", low=0.0, high=1.0)
        self._table = np.array(parameter(self, "table", [0.0, 0.0, 1.0, 0.0], "a, b, c, d of the table a x + b y + c z + d = 0 in frame"))
        if self._table.shape != (4,) or not self._table[2] > 0:
            raise MagicError(
                Code.BAD_REQUEST, "parameter table", self._table.tolist(), "four numbers, the normal (the first three) upwards"
            )
        self._table = self._table / np.linalg.norm(self._table[:3])
        self._known: dict[str, tuple[SceneObject, ...]] = {}
        self._outcome = (DiagnosticStatus.WARN, "no detections yet", {"code": Code.NO_FRAMES.name})
        self._transforms = TransformListener(self, MutuallyExclusiveCallbackGroup())
        self._out = self.create_publisher(SceneObjectArray, "objects", qos.LATCHED)
        for topic in ("known_objects", "obstacles"):
            self.create_subscription(SceneObjectArray, topic, lambda m, topic=topic: self._on_known(topic, m), qos.LATCHED)
        self.create_subscription(vision.Detection3DArray, "detections_in", self._on_detections, qos.SENSOR)
        self._diagnostics = Diagnostics(self, self._report)
        self.get_logger().info(f"meshes of {', '.join(self._meshes.names()) or 'nothing: every detection is a box'}")

    def _base_from(self, header: Header) -> NDArray[np.float64]:
        frame = header.frame_id.lstrip("/")
        if frame == self._frame:
            return np.eye(4)
        with self._transforms.lock:
            return self._transforms.buffer.lookup(self._frame, frame, conversions.time_from_msg(header.stamp) or None)

    def _on_known(self, topic: str, message: SceneObjectArray) -> None:
        try:
            if message.header.frame_id.lstrip("/") not in ("", self._frame):
                raise MagicError(Code.NO_TRANSFORM, f"frame of {topic}", message.header.frame_id, self._frame)
            self._known[topic] = conversions.scene_from_msg(message).objects
        except Exception as error:
            self.get_logger().error(describe(self, error)[1])

    def _on_detections(self, message: Any) -> None:
        try:
            known = [item for items in self._known.values() for item in items]
            scene = scene_of(message, self._meshes, self._score, self._table, self._frame, self._base_from, known)
            self._out.publish(conversions.scene_to_msg(scene))
            self._outcome = (DiagnosticStatus.OK, f"{len(message.detections)} detections, {len(scene.objects)} objects", {})
            for note in scene.notes:
                self.get_logger().warning(note, throttle_duration_sec=10.0)
        except Exception as error:
            code, text = describe(self, error)
            self._outcome = (DiagnosticStatus.ERROR, text, {"code": Code(code).name})
            self.get_logger().error(text, throttle_duration_sec=5.0)

    def _report(self) -> list[DiagnosticStatus]:
        level, text, values = self._outcome
        return [status(self, "detections", level, text, values)]


def main() -> None:
    """Entry point of ``ros2 run magic_bringup detected_objects``."""
    run(DetectedObjects)


if __name__ == "__main__":
    main()
