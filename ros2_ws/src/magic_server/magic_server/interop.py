"""The scene and the verified motion in the messages of other software: vision_msgs and moveit_msgs.

No function here imports these packages: each takes the module of the messages (``vision_msgs.msg``, ``moveit_msgs.msg``), so that
everything else runs where they are not installed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, Vector3
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from magic_core import conversions, transforms
from magic_core.robot import Description
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import MotionPlan, SceneObject, SceneObjectArray

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


def planning_scene(
    scene: SceneObjectArray,
    moveit: Any,
    held: SceneObjectArray | None = None,
    touching: Sequence[str] = (),
    gone: Collection[str] = (),
    leave: Collection[str] = (),
) -> Any:
    """moveit_msgs/PlanningScene, as a difference: each object as its convex pieces, and the table as a plane.

    held: what the hand holds, as the topic ``in_hand`` says: attached to the link that its header names, which ``touching`` links may
    touch.  gone: ids that were told before and are there no more.  leave: ids that are not to be told, as MoveIt knows them better.
    """
    out = moveit.PlanningScene()
    out.is_diff = out.robot_state.is_diff = True
    table = _collision_object(moveit, scene.header, TABLE)
    table.planes, table.plane_poses = [scene.table], [Pose()]
    # Each with the header of those that are held.
    attached = [(held.header, item) for item in held.objects] if held is not None else []
    carried = {item.id for _, item in attached}
    solids = [table, *(_solid(moveit, scene.header, item) for item in scene.objects if item.id not in carried and item.id not in leave)]
    there = {solid.id for solid in solids}
    # What is attached is not in the world any more.
    for name in sorted({*carried, *gone} - there):
        solid = _collision_object(moveit, scene.header, name)
        solid.operation = moveit.CollisionObject.REMOVE
        solids.append(solid)
    for header, item in attached:
        it = moveit.AttachedCollisionObject()
        it.link_name, it.object, it.touch_links = header.frame_id, _solid(moveit, header, item), list(touching)
        out.robot_state.attached_collision_objects = [*out.robot_state.attached_collision_objects, it]
    out.world.collision_objects = solids
    return out


def let_go(names: Collection[str], moveit: Any) -> Any:
    """moveit_msgs/PlanningScene, as a difference: these objects are not attached to the robot any more; they are in the world again."""
    out = moveit.PlanningScene()
    out.is_diff = out.robot_state.is_diff = True
    loose = []
    for name in sorted(names):
        it = moveit.AttachedCollisionObject()
        it.object.id, it.object.operation = name, moveit.CollisionObject.REMOVE
        loose.append(it)
    out.robot_state.attached_collision_objects = loose
    return out


def _solid(moveit: Any, header: Header, item: SceneObject) -> Any:
    solid = _collision_object(moveit, header, item.id)
    solid.pose = item.pose
    solid.meshes = list(item.pieces) or [item.mesh]
    solid.mesh_poses = [Pose() for _ in solid.meshes]
    return solid


def _collision_object(moveit: Any, header: Header, name: str) -> Any:
    out = moveit.CollisionObject()
    out.header, out.id, out.operation = header, name, moveit.CollisionObject.ADD
    return out


def robot_trajectory(trajectory: JointTrajectory, moveit: Any) -> Any:
    """moveit_msgs/RobotTrajectory of an arm's trajectory."""
    out = moveit.RobotTrajectory()
    out.joint_trajectory = trajectory
    return out


def grasps(result: RunStrategy.Result, robot: Description, link: str, moveit: Any, approach: float = 0.08, lift: float = 0.06) -> list[Any]:
    """moveit_msgs/Grasp[]: the grasp at the matched contact that physics has passed; none of a run that ended otherwise.

    ``link``: whose pose a grasp tells, the parent link of the end effector in MoveIt's setup; it must be fixed to the hand.  The pose is
    in the robot's base frame, for the tool where it lay when it was planned: where the arm's trajectory closes the fingers.  approach,
    lift (m): of the planner's parameters ``standoff`` and ``lift``.
    """
    plan = result.plan
    if not result.verified or plan.variant != MotionPlan.ARM or not plan.arm_trajectory.points:
        return []
    rest = robot.poses({})
    tip_from_link = transforms.inverse(rest[robot.config.move_group]) @ rest[link]
    points = plan.arm_trajectory.points
    closing = min(points, key=lambda point: abs(point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec - plan.grasp_time))
    column = {name: index for index, name in enumerate(plan.arm_trajectory.joint_names)}
    base_from_tip = robot.forward(np.array([closing.positions[column[name]] for name in robot.names]))[0]
    grasp = moveit.Grasp()
    grasp.id = f"{result.tool_id}/contact"
    grasp.pre_grasp_posture, grasp.grasp_posture = (_posture(robot, width) for width in (robot.config.opening, plan.grasp_width))
    grasp.grasp_pose.header = grasp.pre_grasp_approach.direction.header = grasp.post_grasp_retreat.direction.header = Header(
        frame_id=robot.base_frame
    )
    grasp.grasp_pose.pose = conversions.pose_to_msg(base_from_tip @ tip_from_link)
    grasp.grasp_quality = float(result.rate_low)
    along = base_from_tip[:3, 2]
    for way, direction, metres in (
        (grasp.pre_grasp_approach, along, approach),
        (grasp.post_grasp_retreat, np.array([0.0, 0.0, 1.0]), lift),
    ):
        way.direction.vector = Vector3(x=float(direction[0]), y=float(direction[1]), z=float(direction[2]))
        way.desired_distance = way.min_distance = float(metres)
    grasp.allowed_touch_objects = [result.tool_id]
    return [grasp]


def _posture(robot: Description, width: float) -> JointTrajectory:
    """The fingers ``width`` metres apart."""
    return JointTrajectory(
        joint_names=[joint.name for joint in robot.fingers],
        points=[JointTrajectoryPoint(positions=robot.finger_positions(width).tolist())],
    )


def contact_frames(scene: SceneObjectArray, candidate: Any, target_id: str) -> dict[str, Any]:
    """world_from_contact (4, 4) by frame name, ``<object>/contact``, of a candidate's contacts with objects of the scene."""
    items: dict[str, SceneObject] = {item.id: item for item in scene.objects}
    found = {}
    for name, contact in ((candidate.tool_id, candidate.tool), *([(target_id, candidate.target)] if candidate.has_target else [])):
        if name in items:
            found[f"{name}/contact"] = conversions.pose_from_msg(items[name].pose) @ conversions.pose_from_msg(contact.object_from_contact)
    return found
