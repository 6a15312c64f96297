"""Messages of software that is not installed here, built against their definitions.

The field lists are those of vision_msgs 4.1, moveit_msgs 2.6 and control_msgs 5 (ROS 2 Jazzy), as far as they are used; where a package is
installed, its own definitions are compared with them.
"""

from array import array
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseWithCovariance, Vector3
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, Plane, SolidPrimitive
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from magic_core import conversions
from magic_core.errors import Code, MagicError
from magic_server import gripper, interop
from magic_server.testing import fakes

STANDARD = {
    "std_msgs/Header": Header,
    "geometry_msgs/Pose": Pose,
    "geometry_msgs/Vector3": Vector3,
    "geometry_msgs/PoseWithCovariance": PoseWithCovariance,
    "shape_msgs/Mesh": Mesh,
    "shape_msgs/Plane": Plane,
    "shape_msgs/SolidPrimitive": SolidPrimitive,
    "trajectory_msgs/JointTrajectory": JointTrajectory,
    "trajectory_msgs/MultiDOFJointTrajectory": MultiDOFJointTrajectory,
    "sensor_msgs/JointState": JointState,
}
PLAIN = {"string": str, "double": float, "boolean": bool, "octet": bytes}
DEFINITIONS = {
    "vision_msgs": {
        "ObjectHypothesis": {"class_id": "string", "score": "double"},
        "ObjectHypothesisWithPose": {"hypothesis": "vision_msgs/ObjectHypothesis", "pose": "geometry_msgs/PoseWithCovariance"},
        "BoundingBox3D": {"center": "geometry_msgs/Pose", "size": "geometry_msgs/Vector3"},
        "Detection3D": {
            "header": "std_msgs/Header",
            "results": "sequence<vision_msgs/ObjectHypothesisWithPose>",
            "bbox": "vision_msgs/BoundingBox3D",
            "id": "string",
        },
        "Detection3DArray": {"header": "std_msgs/Header", "detections": "sequence<vision_msgs/Detection3D>"},
    },
    "moveit_msgs": {
        "CollisionObject": {
            "header": "std_msgs/Header",
            "pose": "geometry_msgs/Pose",
            "id": "string",
            "primitives": "sequence<shape_msgs/SolidPrimitive>",
            "primitive_poses": "sequence<geometry_msgs/Pose>",
            "meshes": "sequence<shape_msgs/Mesh>",
            "mesh_poses": "sequence<geometry_msgs/Pose>",
            "planes": "sequence<shape_msgs/Plane>",
            "plane_poses": "sequence<geometry_msgs/Pose>",
            "subframe_names": "sequence<string>",
            "subframe_poses": "sequence<geometry_msgs/Pose>",
            "operation": "octet",
        },
        "AttachedCollisionObject": {
            "link_name": "string",
            "object": "moveit_msgs/CollisionObject",
            "touch_links": "sequence<string>",
            "detach_posture": "trajectory_msgs/JointTrajectory",
            "weight": "double",
        },
        "RobotState": {"attached_collision_objects": "sequence<moveit_msgs/AttachedCollisionObject>", "is_diff": "boolean"},
        "PlanningSceneWorld": {"collision_objects": "sequence<moveit_msgs/CollisionObject>"},
        "PlanningScene": {
            "name": "string",
            "robot_state": "moveit_msgs/RobotState",
            "robot_model_name": "string",
            "world": "moveit_msgs/PlanningSceneWorld",
            "is_diff": "boolean",
        },
        "RobotTrajectory": {
            "joint_trajectory": "trajectory_msgs/JointTrajectory",
            "multi_dof_joint_trajectory": "trajectory_msgs/MultiDOFJointTrajectory",
        },
    },
}
CONSTANTS = {"CollisionObject": {"ADD": b"\x00", "REMOVE": b"\x01", "APPEND": b"\x02", "MOVE": b"\x03"}}
PARALLEL = {
    "Goal": {"command": "sensor_msgs/JointState"},
    "Result": {"state": "sensor_msgs/JointState", "stalled": "boolean", "reached_goal": "boolean"},
}


def stand_in(definitions, package):
    """Classes that take the fields of their definitions, of their types, and no others."""
    made = {}

    def kind_of(name):
        return PLAIN.get(name) or STANDARD.get(name) or made[name.removeprefix(f"{package}/")]

    def make(name, fields):
        def init(self):
            for field, kind in fields.items():
                object.__setattr__(self, field, [] if kind.startswith("sequence<") else kind_of(kind)())

        def assign(self, field, value):
            assert field in fields, f"{package}/{name} has no field {field}"
            kind = fields[field]
            many = kind.startswith("sequence<")
            values = value if many else [value]
            assert isinstance(values, list)
            wanted = kind_of(kind[len("sequence<") : -1] if many else kind)
            assert all(type(v) is wanted for v in values), (name, field, values)
            object.__setattr__(self, field, value)

        return type(name, (), {"__init__": init, "__setattr__": assign, "__slots__": tuple(fields), **CONSTANTS.get(name, {})})

    for name, fields in definitions.items():
        made[name] = make(name, fields)
    return SimpleNamespace(**made)


@pytest.fixture(scope="module")
def vision():
    return stand_in(DEFINITIONS["vision_msgs"], "vision_msgs")


@pytest.fixture(scope="module")
def moveit():
    return stand_in(DEFINITIONS["moveit_msgs"], "moveit_msgs")


@pytest.fixture(scope="module")
def scene():
    return conversions.scene_to_msg(fakes.scene())


@pytest.mark.parametrize("package", DEFINITIONS)
def test_the_field_lists_are_those_of_the_installed_package(package):
    installed = pytest.importorskip(f"{package}.msg")
    for name, fields in DEFINITIONS[package].items():
        true = getattr(installed, name).get_fields_and_field_types()
        assert {field: true.get(field) for field in fields} == fields, name
        for constant, value in CONSTANTS.get(name, {}).items():
            assert getattr(getattr(installed, name), constant) == value


def test_detections_are_the_objects(scene, vision):
    found = interop.detections(scene, vision)
    assert found.header == scene.header
    assert [d.id for d in found.detections] == ["object_1", "object_2"]
    for detection, item in zip(found.detections, scene.objects):
        assert (detection.bbox.center, detection.bbox.size) == (item.box_pose, item.box_size)
        (result,) = detection.results
        assert (result.pose.pose, result.hypothesis.class_id) == (item.pose, "object")
        assert result.hypothesis.score == item.confidence


def test_a_planning_scene_has_objects_table_and_the_tool_in_the_hand(scene, moveit):
    out = interop.planning_scene(scene, moveit)
    assert out.is_diff and out.robot_state.is_diff
    assert [(o.id, o.operation) for o in out.world.collision_objects] == [("table", b"\x00"), ("object_1", b"\x00"), ("object_2", b"\x00")]
    table, first, _ = out.world.collision_objects
    assert list(table.planes[0].coef) == [0.0, 0.0, 1.0, 0.0] and len(table.plane_poses) == 1
    assert first.pose == scene.objects[0].pose
    assert first.meshes == list(scene.objects[0].pieces) and first.mesh_poses == [Pose()] * len(first.meshes)

    held = interop.planning_scene(scene, moveit, "object_1", "panda_hand", ("panda_leftfinger", "panda_rightfinger"))
    (attached,) = held.robot_state.attached_collision_objects
    assert (attached.link_name, attached.object.id, attached.touch_links) == (
        "panda_hand",
        "object_1",
        ["panda_leftfinger", "panda_rightfinger"],
    )
    assert [(o.id, o.operation) for o in held.world.collision_objects] == [("table", b"\x00"), ("object_1", b"\x01"), ("object_2", b"\x00")]


def test_a_robot_trajectory_is_the_verified_one(moveit):
    arm = conversions.arm_motion_to_msg(fakes.plan("arm").arm_motion)
    assert interop.robot_trajectory(arm, moveit).joint_trajectory is arm


def test_frames_of_contacts_stand_where_the_contacts_are(scene):
    candidate = conversions.candidate_to_msg(fakes.candidate())
    frames = interop.contact_frames(scene, candidate, "object_2")
    assert set(frames) == {"object_1/contact", "object_2/contact"}
    between = np.linalg.inv(frames["object_1/contact"]) @ frames["object_2/contact"]
    assert np.linalg.norm(between[:3, 3]) == pytest.approx(0.2)  # as the objects: the contacts are alike
    assert set(interop.contact_frames(scene, candidate, "somewhere")) == {"object_1/contact"}


def test_either_gripper_action_is_told_and_understood():
    command = gripper.goal(gripper.ACTIONS["GripperCommand"], "finger", 0.015, 20.0).command
    assert (command.position, command.max_effort) == (0.015, 20.0)
    parallel = gripper.ACTIONS["ParallelGripperCommand"] or stand_in(PARALLEL, "control_msgs")
    command = gripper.goal(parallel, "finger", 0.015, 20.0).command
    assert (command.name, command.position, command.effort) == (["finger"], array("d", [0.015]), array("d", [20.0]))
    assert not gripper.goal(parallel, "finger", 0.015, 0.0).command.effort
    result = parallel.Result()
    result.state = JointState(name=["other", "finger"], position=[0.7, 0.02])
    result.stalled = True
    assert gripper.found(result, "finger") == gripper.Found(0.02, True, False)
    with pytest.raises(MagicError) as caught:
        gripper.found(result, "thumb")
    assert caught.value.code == Code.EXECUTION_FAILED
    with pytest.raises(MagicError, match="GripperCommand"):
        gripper.action_of("PneumaticGripper")
    if gripper.ACTIONS["ParallelGripperCommand"] is not None:
        for part, fields in PARALLEL.items():
            assert getattr(parallel, part).get_fields_and_field_types() == fields
