"""The scene and the verified motion in the messages of other software: vision_msgs and moveit_msgs.

No function here imports these packages: each takes the module of the messages (``vision_msgs.msg``, ``moveit_msgs.msg``), so that
everything else runs where they are not installed.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Pose
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory

from magic_core import conversions
from magic_interfaces.msg import SceneObject, SceneObjectArray

#: What each detection is called: perception knows shapes, not names of things.
CLASS = "object"
#: The table in a planning scene.
TABLE = "table"


def detections(scene: SceneObjectArray, vision: Any) -> Any:
    """vision_msgs/Detection3DArray: each object's box, id and pose, with perception's confidence as the score."""
    array = vision.Detection3DArray()
    array.header = scene.header
    for item in scene.objects:
        found = vision.Detection3D()
        found.header, found.id = scene.header, item.id
        found.bbox.center, found.bbox.size = item.box_pose, item.box_size
        what = vision.ObjectHypothesisWithPose()
        what.hypothesis.class_id, what.hypothesis.score = CLASS, float(item.confidence)
        what.pose.pose = item.pose
        found.results = [what]
        array.detections = [*array.detections, found]
    return array


def planning_scene(scene: SceneObjectArray, moveit: Any, held: str = "", link: str = "", touching: tuple[str, ...] = ()) -> Any:
    """moveit_msgs/PlanningScene, as a difference: each object as its convex pieces, and the table as a plane.

    ``held``: the object in the hand, attached to ``link``, which ``touching`` links may touch; it keeps its pose of the scene.
    """
    out = moveit.PlanningScene()
    out.is_diff = out.robot_state.is_diff = True
    table = _collision_object(moveit, scene.header, TABLE)
    table.planes, table.plane_poses = [scene.table], [Pose()]
    solids = [table]
    for item in scene.objects:
        solid = _collision_object(moveit, scene.header, item.id)
        solid.pose = item.pose
        solid.meshes = list(item.pieces) or [item.mesh]
        solid.mesh_poses = [Pose() for _ in solid.meshes]
        if item.id != held:
            solids.append(solid)
            continue
        attached = moveit.AttachedCollisionObject()
        attached.link_name, attached.object, attached.touch_links = link, solid, list(touching)
        out.robot_state.attached_collision_objects = [attached]
        # What is attached is not in the world any more.
        gone = _collision_object(moveit, scene.header, item.id)
        gone.operation = moveit.CollisionObject.REMOVE
        solids.append(gone)
    out.world.collision_objects = solids
    return out


def _collision_object(moveit: Any, header: Header, name: str) -> Any:
    out = moveit.CollisionObject()
    out.header, out.id, out.operation = header, name, moveit.CollisionObject.ADD
    return out


def robot_trajectory(trajectory: JointTrajectory, moveit: Any) -> Any:
    """moveit_msgs/RobotTrajectory of an arm's trajectory."""
    out = moveit.RobotTrajectory()
    out.joint_trajectory = trajectory
    return out


def contact_frames(scene: SceneObjectArray, candidate: Any, target_id: str) -> dict[str, Any]:
    """world_from_contact (4, 4) by frame name, ``<object>/contact``, of a candidate's contacts with objects of the scene."""
    items: dict[str, SceneObject] = {item.id: item for item in scene.objects}
    found = {}
    for name, contact in ((candidate.tool_id, candidate.tool), *([(target_id, candidate.target)] if candidate.has_target else [])):
        if name in items:
            found[f"{name}/contact"] = conversions.pose_from_msg(items[name].pose) @ conversions.pose_from_msg(contact.object_from_contact)
    return found
