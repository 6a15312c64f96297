"""Stand-ins for the messages of packages that are not installed here.

The field lists are those of vision_msgs 4.1, moveit_msgs 2.6 and control_msgs 5 (ROS 2 Jazzy), as far as they are used, held against the
packages' own definition files; where a package is installed, a test compares its definitions with them.
"""

from types import SimpleNamespace

from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovariance, Vector3, Vector3Stamped
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh, Plane, SolidPrimitive
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

STANDARD = {
    "std_msgs/Header": Header,
    "geometry_msgs/Pose": Pose,
    "geometry_msgs/PoseStamped": PoseStamped,
    "geometry_msgs/Vector3": Vector3,
    "geometry_msgs/Vector3Stamped": Vector3Stamped,
    "geometry_msgs/PoseWithCovariance": PoseWithCovariance,
    "shape_msgs/Mesh": Mesh,
    "shape_msgs/Plane": Plane,
    "shape_msgs/SolidPrimitive": SolidPrimitive,
    "trajectory_msgs/JointTrajectory": JointTrajectory,
    "trajectory_msgs/MultiDOFJointTrajectory": MultiDOFJointTrajectory,
    "sensor_msgs/JointState": JointState,
}
PLAIN = {"string": str, "double": float, "boolean": bool, "octet": bytes, "float": float, "int32": int}
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
        "GripperTranslation": {"direction": "geometry_msgs/Vector3Stamped", "desired_distance": "float", "min_distance": "float"},
        "Grasp": {
            "id": "string",
            "pre_grasp_posture": "trajectory_msgs/JointTrajectory",
            "grasp_posture": "trajectory_msgs/JointTrajectory",
            "grasp_pose": "geometry_msgs/PoseStamped",
            "grasp_quality": "double",
            "pre_grasp_approach": "moveit_msgs/GripperTranslation",
            "post_grasp_retreat": "moveit_msgs/GripperTranslation",
            "post_place_retreat": "moveit_msgs/GripperTranslation",
            "max_contact_force": "float",
            "allowed_touch_objects": "sequence<string>",
        },
        "MoveItErrorCodes": {"val": "int32"},
    },
}
CONSTANTS = {
    "CollisionObject": {"ADD": b"\x00", "REMOVE": b"\x01", "APPEND": b"\x02", "MOVE": b"\x03"},
    "MoveItErrorCodes": {"SUCCESS": 1, "PLANNING_FAILED": -1},
}
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
                empty = [] if kind.startswith("sequence<") else b"\x00" if kind == "octet" else kind_of(kind)()
                object.__setattr__(self, field, empty)

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


VISION = stand_in(DEFINITIONS["vision_msgs"], "vision_msgs")
MOVEIT = stand_in(DEFINITIONS["moveit_msgs"], "moveit_msgs")
