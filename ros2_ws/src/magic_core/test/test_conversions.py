"""Messages and plain types: there and back."""

import dataclasses
import math
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage

from magic_core import conversions as cv
from magic_core import shapes
from magic_core import transforms as tf
from magic_core.camera import Intrinsics
from magic_core.contact import Companion, Contact, ContactCandidate, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.surface import PrincipalFrame

number = st.floats(-5, 5, allow_nan=False)
poses = st.builds(lambda r, t: tf.from_rotvec(r, t), st.tuples(number, number, number), st.tuples(number, number, number))
fast = settings(max_examples=40, deadline=None)


@given(st.floats(0, 4e9, allow_nan=False))
@fast
def test_time(seconds):
    assert cv.time_from_msg(cv.time_to_msg(seconds)) == pytest.approx(seconds, abs=1e-6)
    assert 0 <= cv.time_to_msg(seconds).nanosec < 1_000_000_000


@given(poses)
@fast
def test_pose_and_transform(pose):
    np.testing.assert_allclose(cv.pose_from_msg(cv.pose_to_msg(pose)), pose, atol=1e-9)
    np.testing.assert_allclose(cv.transform_from_msg(cv.transform_to_msg(pose)), pose, atol=1e-9)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0), (math.nan, 0.0, 0.0, 1.0)])
def test_no_pose(quaternion):
    msg = cv.pose_to_msg(np.eye(4))
    msg.orientation.x, msg.orientation.y, msg.orientation.z, msg.orientation.w = quaternion
    with pytest.raises(MagicError) as error:
        cv.pose_from_msg(msg)
    assert error.value.code == Code.BAD_REQUEST


@given(arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3))))
@fast
def test_colour(image):
    np.testing.assert_array_equal(cv.color_from_msg(cv.image_to_msg(image, "rgb8")), image)
    np.testing.assert_array_equal(cv.color_from_msg(cv.image_to_msg(image, "bgr8")), image[..., ::-1])
    grey = cv.color_from_msg(cv.image_to_msg(image[..., 0], "mono8"))
    np.testing.assert_array_equal(grey, np.repeat(image[..., :1], 3, axis=2))


@given(arrays(np.uint16, st.tuples(st.integers(1, 9), st.integers(1, 9))))
@fast
def test_depth_in_millimetres(raw):
    depth = cv.depth_from_msg(cv.image_to_msg(raw, "16UC1"))
    seen = (raw > 0) & (raw < 65535)  # the largest number is what some drivers write into holes
    np.testing.assert_allclose(depth[seen], raw[seen] * 0.001, rtol=1e-6)
    assert np.isnan(depth[~seen]).all()


def test_compressed_images_are_what_was_sent():
    rng = np.random.default_rng(0)
    color = cv2.resize(rng.integers(0, 255, (4, 5, 3), dtype=np.uint8), (80, 64))
    png = cv2.imencode(".png", color[..., ::-1])[1].tobytes()
    as_it_is = cv2.imencode(".png", color)[1].tobytes()
    for kind, data in (
        ("png", png),
        ("rgb8; png compressed bgr8", png),
        ("rgb8; png compressed rgb8", as_it_is),
        ("rgb8; png compressed ", as_it_is),
    ):
        np.testing.assert_array_equal(cv.color_from_compressed_msg(CompressedImage(format=kind, data=data)), color)
    raw = rng.integers(300, 1500, (6, 7)).astype(np.uint16)
    raw[0, :2] = 0, 65535
    packed = cv2.imencode(".png", raw)[1].tobytes()
    expected = np.where((raw > 0) & (raw < 65535), raw * np.float32(0.001), np.nan)
    for kind, data in (
        ("16UC1; compressedDepth png", bytes(12) + packed),
        ("16UC1; compressedDepth", bytes(12) + packed),
        ("16UC1; png compressed ", packed),
    ):
        np.testing.assert_allclose(cv.depth_from_compressed_msg(CompressedImage(format=kind, data=data)), expected, rtol=1e-6)
    # Floating-point depth goes as a / depth + b.
    metres, a, b = np.array([[0.5, 0.75, 2.0]]), 10000.0, -100.0
    inverse = cv2.imencode(".png", np.round(a / metres + b).astype(np.uint16))[1].tobytes()
    msg = CompressedImage(format="32FC1; compressedDepth png", data=struct.pack("<iff", 0, a, b) + inverse)
    np.testing.assert_allclose(cv.depth_from_compressed_msg(msg), metres, rtol=1e-3)


@pytest.mark.parametrize(
    "kind, data",
    [
        ("16UC1; compressedDepth rvl", bytes(40)),
        ("jpeg", bytes(40)),
        ("16UC1; compressedDepth png", b""),
        ("16UC1; compressedDepth png", bytes(40)),
    ],
)
def test_compressed_depth_that_cannot_be_read_has_a_code(kind, data):
    with pytest.raises(MagicError) as caught:
        cv.depth_from_compressed_msg(CompressedImage(format=kind, data=data))
    assert caught.value.code in (Code.BAD_ENCODING, Code.BAD_IMAGE)


def test_depth_in_metres_and_what_is_none():
    raw = np.array([[0.5, np.nan, 0.0, np.inf, -1.0]], np.float32)
    np.testing.assert_array_equal(cv.depth_from_msg(cv.image_to_msg(raw, "32FC1")), [[np.float32(0.5)] + [np.nan] * 4])


def test_rows_may_be_padded_and_bytes_swapped():
    raw = np.arange(6, dtype=np.uint16).reshape(2, 3)
    msg = cv.image_to_msg(raw, "16UC1")
    padded = np.zeros((2, 8), np.uint8)
    padded[:, :6] = raw.astype(">u2").view(np.uint8)
    msg.is_bigendian, msg.step, msg.data = 1, 8, padded.tobytes()
    depth = cv.depth_from_msg(msg)
    np.testing.assert_allclose(np.nan_to_num(depth), raw * 0.001, rtol=1e-6)


@pytest.mark.parametrize("change", [{"width": 9}, {"height": 0}, {"step": 1}, {"data": b"123"}])
def test_images_that_contradict_themselves(change):
    msg = cv.image_to_msg(np.zeros((4, 5, 3), np.uint8), "rgb8")
    for key, value in change.items():
        setattr(msg, key, value)
    with pytest.raises(MagicError) as error:
        cv.color_from_msg(msg)
    assert error.value.code == Code.BAD_IMAGE


def test_unknown_encodings_name_what_is_allowed():
    msg = cv.image_to_msg(np.zeros((4, 5, 3), np.uint8), "rgb8")
    msg.encoding = "bayer_rggb8"
    with pytest.raises(MagicError, match="bayer_rggb8.*rgb8, bgr8") as error:
        cv.color_from_msg(msg)
    assert error.value.code == Code.BAD_ENCODING
    with pytest.raises(MagicError, match="16UC1, mono16, 32FC1"):
        cv.depth_from_msg(msg)


def test_masks():
    mask = np.random.default_rng(0).random((5, 7)) > 0.5
    np.testing.assert_array_equal(cv.mask_from_msg(cv.image_to_msg(mask, "mono8")), mask)


def test_the_image_does_not_share_the_messages_buffer():
    msg = cv.image_to_msg(np.zeros((2, 2, 3), np.uint8), "rgb8")
    image = cv.color_from_msg(msg)
    msg.data[0] = 99
    assert image.max() == 0
    image[:] = 1  # and may be written to


def test_intrinsics():
    k = Intrinsics(640, 480, 600.5, 601.5, 320.25, 240.75)
    assert cv.intrinsics_from_msg(cv.intrinsics_to_msg(k)) == k
    msg = cv.intrinsics_to_msg(k)
    msg.k[0] = 0.0
    with pytest.raises(MagicError) as error:
        cv.intrinsics_from_msg(msg)
    assert error.value.code == Code.BAD_INTRINSICS


def test_clouds():
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), dtype=np.uint8)
    back, back_colors = cv.cloud_from_msg(cv.cloud_to_msg(points, colors, cv.header("world")))
    np.testing.assert_allclose(back, points, atol=1e-6)
    np.testing.assert_array_equal(back_colors, colors)
    empty, _ = cv.cloud_from_msg(cv.cloud_to_msg(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), cv.header("world")))
    assert empty.shape == (0, 3)


@pytest.mark.parametrize(
    "coef, plane", [((0, 0, 2, -1), (0, 0, 1, -0.5)), ((0, 0, -1, 0.5), (0, 0, 1, -0.5)), ((0, 0, 0, 0), (0, 0, 1, 0))]
)
def test_planes_are_unit_and_point_up(coef, plane):
    np.testing.assert_allclose(cv.plane_from_msg(cv.plane_to_msg(np.array(coef))), plane, atol=1e-12)


# ---------------------------------------------------------------- composed types


def tetrahedron():
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    return Mesh(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.arange(12, dtype=np.uint8).reshape(4, 3))


def view(kind="top"):
    rng = np.random.default_rng(1)
    mask = rng.random((6, 8)) > 0.5
    depth = np.where(mask, rng.random((6, 8)), np.nan).astype(np.float32)
    return CanonicalView(
        rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), mask, 0.002, tf.from_rpy(0.1, 0.2, 0.3, [1, 2, 3]), kind, depth, 0.75
    )


def contact():
    v = view()
    return Contact(
        np.array([3.0, 2.5]), tf.unit([1.0, -1.0]), 0.012, True, 0.004, contact_frame(v, np.array([3.0, 2.5]), tf.unit([1.0, -1.0]))
    )


def same_view(a, b):
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.mask, b.mask)
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_allclose(a.object_from_view, b.object_from_view, atol=1e-9)
    assert (a.kind, a.metres_per_pixel, a.confidence) == (b.kind, b.metres_per_pixel, b.confidence)


def test_views():
    same_view(cv.view_from_msg(cv.view_to_msg(view())), view())
    msg = cv.view_to_msg(view())
    msg.mask = cv.image_to_msg(np.zeros((5, 8), bool), "mono8")
    with pytest.raises(MagicError) as error:
        cv.view_from_msg(msg)
    assert error.value.code == Code.BAD_REQUEST_IMAGE


def test_scenes():
    mesh = tetrahedron()
    item = SceneObject(
        id="object_1",
        mesh=mesh,
        pieces=(mesh, mesh.scaled(0.5)),
        world_from_object=tf.from_rpy(0, 0, 1, [0.4, 0.1, 0.02]),
        view=view(),
        points=np.random.default_rng(2).normal(size=(9, 3)),
        colors=np.zeros((9, 3), np.uint8),
        mask=np.eye(4, 5, dtype=bool),
        camera="left",
        world_from_box=tf.from_rpy(0, 0, 0.5),
        box_extents=np.array([0.1, 0.2, 0.3]),
        confidence=0.5,
        seen_share=0.25,
        cut_off=("picture", "object_2"),
        surface_error=0.0625,
    )
    scene = Scene((item,), np.array([0, 0, 1.0, -0.01]), stamp=12.5, camera_offset=0.03125, camera_angle=0.125, notes=("a", "b"))
    back = cv.scene_from_msg(cv.scene_to_msg(scene))
    assert (back.stamp, back.frame_id, back.table_height) == (12.5, "panda_link0", pytest.approx(0.01))
    assert (back.camera_offset, back.camera_angle, back.notes) == (0.03125, 0.125, ("a", "b"))
    other = back.find("object_1")
    assert (other.seen_share, other.cut_off, other.confidence) == (0.25, ("picture", "object_2"), 0.5)
    assert other.surface_error == 0.0625
    np.testing.assert_allclose(other.mesh.vertices, mesh.vertices)
    np.testing.assert_array_equal(other.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(other.mesh.colors, mesh.colors)
    assert [len(p.faces) for p in other.pieces] == [4, 4]
    np.testing.assert_allclose(other.world_from_object, item.world_from_object, atol=1e-9)
    np.testing.assert_allclose(other.points, item.points, atol=1e-6)
    np.testing.assert_array_equal(other.mask, item.mask)
    np.testing.assert_allclose(other.box_extents, item.box_extents)
    same_view(other.view, item.view)
    with pytest.raises(MagicError, match="object_1") as error:
        back.find("object_2")
    assert error.value.code == Code.UNKNOWN_OBJECT


@given(poses)
@fast
def test_a_scene_told_in_another_frame_is_the_same_scene(frame_from_own):
    """What was on the table is on it, what was apart is as far apart, and what is shared is not copied."""
    mesh = Mesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), np.array([[0, 1, 2]]))
    mask = np.ones((2, 2), bool)
    view = CanonicalView(np.zeros((2, 2, 3), np.uint8), mask, 0.01, np.eye(4))
    pose, box = tf.from_rpy(0.1, 0.2, 0.3, [0.4, 0.5, 0.6]), tf.from_rpy(0.0, 0.0, 1.0, [0.4, 0.5, 0.0])
    points = np.array([[0.4, 0.5, 0.02], [0.1, 0.2, 0.02]])
    item = SceneObject("a", mesh, (), pose, view, points, np.full((2, 3), 7, np.uint8), world_from_box=box)
    msg = cv.scene_to_msg(Scene((item,), np.array([0.0, 0.0, 1.0, -0.02]), 12.5, "world"))
    told = cv.carried(msg, "base", frame_from_own)
    assert (told.header.frame_id, told.objects[0].cloud.header.frame_id, msg.header.frame_id) == ("base", "base", "world")
    assert told.objects[0].mesh is msg.objects[0].mesh
    back = cv.scene_from_msg(told)
    np.testing.assert_allclose(back.objects[0].world_from_object, frame_from_own @ pose, atol=1e-9)
    np.testing.assert_allclose(back.objects[0].world_from_box, frame_from_own @ box, atol=1e-9)
    np.testing.assert_allclose(back.objects[0].points, tf.apply(frame_from_own, points), atol=1e-5)
    np.testing.assert_array_equal(back.objects[0].colors, item.colors)
    heights = tf.apply(frame_from_own, points) @ back.table[:3] + back.table[3]
    np.testing.assert_allclose(heights, 0.0, atol=1e-6)
    np.testing.assert_allclose(cv.scene_from_msg(msg).objects[0].world_from_object, pose, atol=1e-9)  # as it was


def test_what_is_told_in_another_frame_is_refused():
    from magic_interfaces.msg import SceneObject as SceneObjectMsg

    def named(frame):
        item = SceneObjectMsg(id="cup")
        item.cloud.header.frame_id = frame
        return item

    trajectory = cv.arm_motion_to_msg(ArmMotion(np.zeros(1), ("j",), *[np.zeros((1, 1))] * 3, np.eye(4), 0.0, 0.0), "world")
    cv.check_frames("base", [named("base"), named("/base"), named("")], type(trajectory)())
    for objects, trajectories, says in (
        ([named("base"), named("map")], (), "frame of object cup: 'map' (allowed: base"),
        ([], (trajectory,), "frame of the trajectory of j: 'world' (allowed: base"),
    ):
        with pytest.raises(MagicError) as caught:
            cv.check_frames("base", objects, *trajectories)
        assert caught.value.code == Code.BAD_REQUEST
        assert says in caught.value.message


def test_mesh_colours_of_the_wrong_length():
    msg = cv.scene_to_msg(Scene((SceneObject("a", tetrahedron(), (), np.eye(4), view()),), np.array([0, 0, 1.0, 0])))
    msg.objects[0].mesh_colors = msg.objects[0].mesh_colors[:-1]
    with pytest.raises(MagicError) as error:
        cv.scene_from_msg(msg)
    assert error.value.code == Code.BAD_MESH


@pytest.mark.parametrize("most", [11, 12])
def test_more_triangles_than_are_taken(monkeypatch, most):
    """Mesh and pieces of an object count together: three tetrahedra here."""
    monkeypatch.setattr(cv, "MOST_TRIANGLES", most)
    scene = Scene((SceneObject("a", tetrahedron(), (tetrahedron(),) * 2, np.eye(4), view()),), np.array([0, 0, 1.0, 0]))
    if most == 12:
        assert len(cv.scene_from_msg(cv.scene_to_msg(scene)).objects) == 1
        return
    with pytest.raises(MagicError, match=r"triangles of a: 12 .*up to 11") as error:
        cv.scene_from_msg(cv.scene_to_msg(scene))
    assert error.value.code == Code.BAD_MESH


@pytest.mark.parametrize("with_target", [True, False])
def test_candidates(with_target):
    before = ContactCandidate(
        "object_1", contact(), contact() if with_target else None, 1.5, True, 0.5, 0.25, 0.75, tf.from_rpy(0.3, 0, 0, [1, 0, 0])
    )
    pose = tf.from_rpy(0, 0, 0.5, [0.2, 0, 0])
    msg = cv.candidate_to_msg(before, pose)
    after = cv.candidate_from_msg(msg)
    assert (after.tool_id, after.rotation, after.flipped, after.s_dino, after.s_curv, after.score) == (
        "object_1",
        1.5,
        True,
        0.5,
        0.25,
        0.75,
    )
    assert (after.target is not None) == with_target
    np.testing.assert_allclose(after.tool.object_from_contact, before.tool.object_from_contact, atol=1e-9)
    assert after.tool.signed_curvature == pytest.approx(-1 / 0.012)
    np.testing.assert_allclose([msg.point.x, msg.point.y, msg.point.z], (pose @ before.tool.object_from_contact)[:3, 3])
    assert math.isnan(cv.candidate_to_msg(before).point.x)
    assert after.companions == () and after.tool.surface is None


def test_candidates_with_a_surface_and_further_contacts():
    surface = PrincipalFrame(tf.from_rpy(0.1, 0.2, 0.3, [0.01, 0.02, 0.03]), np.array([20.0, -5.0]), 0.004, 1e-5)
    further = (Companion("heel", replace(contact(), surface=surface), contact()), Companion("tip", contact(), None))
    before = ContactCandidate(
        "object_1", replace(contact(), surface=surface), contact(), 1.5, True, 0.5, 0.25, 0.75, np.eye(4), companions=further
    )
    after = cv.candidate_from_msg(cv.candidate_to_msg(before))
    assert [(c.name, c.target is None) for c in after.companions] == [("heel", False), ("tip", True)]
    for found in (after.tool.surface, after.companions[0].tool.surface):
        np.testing.assert_allclose(found.object_from_surface, surface.object_from_surface, atol=1e-9)
        np.testing.assert_allclose(found.curvatures, [20.0, -5.0])
        assert (found.reach, found.residue) == (0.004, 1e-5)
    assert after.companions[1].tool.surface is None and after.target.surface is None
    np.testing.assert_allclose(after.companions[0].target.object_from_contact, contact().object_from_contact, atol=1e-9)


def plan(variant):
    times = np.array([0.0, 0.5, 1.25])
    motion = ToolMotion(
        times, np.stack([tf.from_rpy(0, 0, t, [t, 0, 0]) for t in times]), (Phase("contact", 0.0, 0.5), Phase("goal", 0.5, 1.25))
    )
    if variant == "fg":
        return MotionPlan("fg", motion)
    rng = np.random.default_rng(3)
    names = tuple(f"panda_joint{i}" for i in range(1, 8))
    arm = ArmMotion(
        times,
        names,
        rng.normal(size=(3, 7)),
        rng.normal(size=(3, 7)),
        rng.normal(size=(3, 7)),
        tf.from_rpy(1, 0, 0),
        0.03,
        0.25,
        None,
        motion.phases,
    )
    return MotionPlan("arm", motion, arm)


@pytest.mark.parametrize("variant", ["fg", "arm"])
def test_plans(variant):
    before = plan(variant)
    msg = cv.plan_to_msg(before, "object_1")
    after = cv.plan_from_msg(msg)
    assert msg.tool_trajectory.joint_names == ["object_1"]
    np.testing.assert_allclose(after.tool_motion.times, before.tool_motion.times)
    np.testing.assert_allclose(after.tool_motion.world_from_tool, before.tool_motion.world_from_tool, atol=1e-9)
    assert after.tool_motion.phases == before.tool_motion.phases
    if variant == "arm":
        for name in ("times", "positions", "velocities", "accelerations", "tool_from_tcp"):
            np.testing.assert_allclose(getattr(after.arm_motion, name), getattr(before.arm_motion, name), atol=1e-9)
        assert after.arm_motion.release_time is None
        assert after.arm_motion.joint_names == before.arm_motion.joint_names


def test_many_transforms_are_what_each_of_them_is():
    rng = np.random.default_rng(3)
    turns = rng.normal(size=(300, 3)) * np.repeat([1e-9, 0.1, 3.0], 100)[:, None]
    poses = np.stack([tf.from_rotvec(turn, rng.normal(size=3)) for turn in turns])
    msgs = cv.transforms_to_msgs(poses)
    assert msgs == [cv.transform_to_msg(pose) for pose in poses]
    assert np.array_equal(cv.transforms_from_msgs(msgs), np.stack([cv.transform_from_msg(msg) for msg in msgs]))
    assert cv.transforms_to_msgs(poses[:0]) == [] and cv.transforms_from_msgs([]).shape == (0, 4, 4)
    msgs[7].rotation.w += 1.0
    with pytest.raises(MagicError) as one:
        cv.transform_from_msg(msgs[7])
    with pytest.raises(MagicError) as many:
        cv.transforms_from_msgs(msgs)
    assert (many.value.code, many.value.message) == (one.value.code, one.value.message)


def test_plans_that_are_none():
    def code(change):
        msg = cv.plan_to_msg(plan("arm"), "object_1")
        change(msg)
        with pytest.raises(MagicError) as error:
            cv.plan_from_msg(msg)
        return error.value.code

    assert code(lambda m: setattr(m, "variant", "legs")) == Code.UNKNOWN_VARIANT
    assert code(lambda m: setattr(m.tool_trajectory, "points", [])) == Code.BAD_MOTION
    assert code(lambda m: setattr(m.arm_trajectory, "points", [])) == Code.BAD_MOTION
    assert code(lambda m: m.arm_trajectory.points[0].positions.pop()) == Code.BAD_MOTION
    assert code(lambda m: m.tool_trajectory.points.reverse()) == Code.BAD_MOTION


@pytest.mark.parametrize(
    "coefficients", [[np.nan, 0.0, 1.0, 0.0], [0.0, 0.0, np.inf, 0.0], [0.0, 0.0, 1.0, np.nan], [1e300, 1e300, 1e300, 0.0]]
)
def test_planes_that_are_none_are_refused(coefficients):
    from shape_msgs.msg import Plane

    with pytest.raises(MagicError) as caught:
        cv.plane_from_msg(Plane(coef=coefficients))
    assert caught.value.code is Code.BAD_REQUEST


@pytest.mark.parametrize("scale", [np.nan, np.inf, -1.0, 0.0, 1e-300, 1e300])
def test_views_of_no_possible_scale_are_refused(scale):
    with pytest.raises(MagicError) as caught:
        CanonicalView(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), bool), scale, np.eye(4))
    assert caught.value.code is Code.BAD_REQUEST_IMAGE
    assert CanonicalView(np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), bool), 1.0, np.eye(4)).kind == "top"


def test_what_planner_and_verifier_are_sent_is_the_object_without_its_pictures():
    item = dataclasses.replace(shapes.make("mug", 1).as_object("mug", tf.from_rpy(0, 0, 0.3, [0.4, 0.1, 0.0])), points=np.ones((5, 3)))
    shown = {"mask": np.ones((4, 6), bool), "camera": "left", "picture": np.ones((3, 5, 3), np.uint8)}
    item = dataclasses.replace(item, colors=np.zeros((5, 3), np.uint8), **shown, cut_off=("picture",))
    whole = cv.object_to_msg(item, cv.header("panda_link0"))
    light = cv.without_pictures(whole, cloud=False, surface=False)
    assert len(serialize_message(light)) < 0.2 * len(serialize_message(whole))
    assert light.cloud.header == whole.cloud.header and len(whole.view.image.data) and len(whole.mask.data), "the whole one is as it was"
    np.testing.assert_array_equal(cv.object_from_msg(whole).picture, item.picture)
    same, bare = cv.object_from_msg(whole, pictures=False), cv.object_from_msg(light, pictures=False)
    for got in (same, bare):
        assert (got.id, got.camera, got.cut_off, got.confidence) == (item.id, "left", ("picture",), item.confidence)
        assert got.mask is None and got.picture is None and not got.view.mask.any()
        np.testing.assert_array_equal(got.world_from_object, same.world_from_object)
        assert len(got.pieces) == len(item.pieces)
        for a, b in zip(got.pieces, item.pieces):
            np.testing.assert_array_equal(a.vertices, b.vertices)
    np.testing.assert_array_equal(same.mesh.vertices, item.mesh.vertices)
    assert len(bare.mesh.vertices) == 0 and len(bare.points) == 0 and len(same.points) == 5
    # Without pieces the mesh is all that there is of its shape.
    for pieces in ([], [type(whole.mesh)()]):
        whole.pieces = pieces
        assert cv.without_pictures(whole, cloud=False, surface=False).mesh is whole.mesh
