"""Messages of software that is not installed here, built against their definitions (``foreign.py``)."""

from array import array

import numpy as np
import pytest
from foreign import CONSTANTS, DEFINITIONS, MOVEIT, PARALLEL, VISION, stand_in
from geometry_msgs.msg import Pose
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from magic_core import conversions, transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import SceneObjectArray
from magic_server import gripper, interop
from magic_server.held import Held
from magic_server.testing import fakes


@pytest.fixture(scope="module")
def vision():
    return VISION


@pytest.fixture(scope="module")
def moveit():
    return MOVEIT


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

    # The tool that the hand holds is not in the world, and is told in the hand's frame.
    tool = Held(scene.objects[0], transforms.make(translation=[0.0, 0.0, 0.03]))
    hand = SceneObjectArray(header=Header(frame_id="panda_hand_tcp"), objects=[tool.in_hand()])
    held = interop.planning_scene(scene, moveit, hand, ["panda_leftfinger", "panda_rightfinger"], gone={"object_0"})
    (attached,) = held.robot_state.attached_collision_objects
    assert (attached.link_name, attached.object.id, attached.object.header.frame_id) == ("panda_hand_tcp", "object_1", "panda_hand_tcp")
    assert attached.touch_links == ["panda_leftfinger", "panda_rightfinger"] and attached.object.pose.position.z == -0.03
    told = [(o.id, o.operation) for o in held.world.collision_objects]
    assert told == [("table", b"\x00"), ("object_2", b"\x00"), ("object_0", b"\x01"), ("object_1", b"\x01")]
    # What MoveIt knows better is left to it.
    left = interop.planning_scene(scene, moveit, leave={"object_2"})
    assert [o.id for o in left.world.collision_objects] == ["table", "object_1"]
    (loose,) = interop.let_go({"object_1"}, moveit).robot_state.attached_collision_objects
    assert (loose.object.id, loose.object.operation) == ("object_1", b"\x01")


def test_the_grasp_at_the_contact_is_where_the_arm_closes_its_fingers(moveit):
    robot = Description()
    result = RunStrategy.Result(verified=True, rate_low=0.8, tool_id="object_1")
    result.plan = conversions.plan_to_msg(fakes.plan("arm", start=0.1), "object_1")
    (grasp,) = interop.grasps(result, robot, "panda_hand", moveit)
    closing = dict.fromkeys(robot.names, 0.1 + 0.1)  # where the stand-in's plan stands at its grasp_time of 1 s
    np.testing.assert_allclose(conversions.pose_from_msg(grasp.grasp_pose.pose), robot.poses(closing)["panda_hand"], atol=1e-9)
    assert (grasp.grasp_pose.header.frame_id, grasp.grasp_quality, grasp.allowed_touch_objects) == ("panda_link0", 0.8, ["object_1"])
    wide, narrow = [sum(t.points[0].positions) for t in (grasp.pre_grasp_posture, grasp.grasp_posture)]
    assert (wide, narrow) == (pytest.approx(0.08), pytest.approx(0.03))
    v = grasp.pre_grasp_approach.direction.vector
    np.testing.assert_allclose([v.x, v.y, v.z], robot.poses(closing)["panda_hand_tcp"][:3, 2], atol=1e-9)
    result.verified = False
    assert interop.grasps(result, robot, "panda_hand", moveit) == []
    result.verified, result.plan = True, conversions.plan_to_msg(fakes.plan("fg"), "object_1")
    assert interop.grasps(result, robot, "panda_hand", moveit) == []


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
