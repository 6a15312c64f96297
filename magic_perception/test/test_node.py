"""The node against synthetic cameras: good input gives the core's objects, bad input gives a diagnostic."""

import os

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import time

import numpy as np
import pytest
import scenes

rclpy = pytest.importorskip("rclpy")
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import Marker, MarkerArray

from magic_core import conversions as cv
from magic_core.qos import LATCHED, RELIABLE, SENSOR, STATIC_TF
from magic_core.scene import Scene
from magic_interfaces.msg import SceneObjectArray
from magic_perception.node import Perception
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive

tf2_msgs = pytest.importorskip("tf2_msgs.msg")


class Bench:
    """One perception node and a tester that plays two cameras."""

    def __init__(self, **parameters):
        rclpy.init(domain_id=scenes.free_domain())
        values = {"average": 1, "rate": 10.0, "camera_timeout": 1.0, **parameters}
        self.node = _with_overrides(values)
        self.tester = rclpy.create_node("tester")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.tester)
        self.objects, self.markers, self.diagnostics = [], [], []
        self.tester.create_subscription(SceneObjectArray, "objects", self.objects.append, LATCHED)
        self.tester.create_subscription(MarkerArray, "perception/markers", self.markers.append, LATCHED)
        self.tester.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, RELIABLE)
        self.tf = self.tester.create_publisher(tf2_msgs.TFMessage, "/tf_static", STATIC_TF)
        self.known = self.tester.create_publisher(SceneObjectArray, "known_objects", LATCHED)
        self.out = {}
        for name in ("left", "right"):
            base = f"camera/{name}"
            self.out[name] = (
                self.tester.create_publisher(Image, f"{base}/color/image_raw", SENSOR),
                self.tester.create_publisher(Image, f"{base}/aligned_depth_to_color/image_raw", SENSOR),
                self.tester.create_publisher(CameraInfo, f"{base}/color/camera_info", SENSOR),
            )

    def __enter__(self):
        used = self.node.cameras
        self.until(
            lambda: all(p.get_subscription_count() for name in used for p in self.out[name]) and self.tf.get_subscription_count(),
            "discovery",
        )
        return self

    def __exit__(self, *_):
        self.executor.shutdown()
        self.node.destroy_node()
        self.tester.destroy_node()
        rclpy.try_shutdown()

    def until(self, ready, what, seconds=15.0, tick=None):
        deadline = time.monotonic() + seconds
        last = 0.0
        while not ready():
            assert time.monotonic() < deadline, f"no {what} within {seconds} s; diagnostics: {self.messages()}"
            if tick is not None and time.monotonic() - last > 0.2:
                tick()
                last = time.monotonic()
            self.executor.spin_once(timeout_sec=0.05)

    def messages(self):
        return [f"{s.name}: {s.message}" for s in self.diagnostics[-1].status] if self.diagnostics else []

    def transforms(self, names=("left", "right")):
        stamped = []
        for name in names:
            t = TransformStamped(child_frame_id=f"{name}_color_optical_frame", transform=cv.transform_to_msg(scenes.POSES[name]))
            t.header.frame_id = "panda_link0"
            stamped.append(t)
        self.tf.publish(tf2_msgs.TFMessage(transforms=stamped))

    def send(self, frame, encoding="16UC1", info=True, **changes):
        head = cv.header(f"{frame.camera}_color_optical_frame", frame.stamp)
        color, depth, camera_info = self.out[frame.camera]
        if info:
            camera_info.publish(changes.get("info_msg") or cv.intrinsics_to_msg(frame.intrinsics, head))
        pixels = np.nan_to_num(frame.depth * 1000).round() if encoding == "16UC1" else frame.depth
        msg = cv.image_to_msg(pixels, encoding if encoding in ("16UC1", "32FC1") else "32FC1", head)
        msg.encoding = encoding
        if "step" in changes:
            msg.step = changes["step"]
        color.publish(cv.image_to_msg(frame.color, "rgb8", head))
        depth.publish(msg)

    def codes(self):
        return {v.value for d in self.diagnostics[-3:] for s in d.status for v in s.values if v.key == "code_name"}


def _with_overrides(values):
    from rclpy.node import Node

    original = Node.__init__

    def patched(self, name, **kwargs):
        original(self, name, parameter_overrides=[Parameter(k, value=v) for k, v in values.items()], **kwargs)

    Node.__init__ = patched
    try:
        return Perception()
    finally:
        Node.__init__ = original


def things():
    return [scenes.shape("l_hook", 1, 0.5, -0.1, 0.4), scenes.shape("cylinder", 1, 0.6, 0.12)]


@pytest.fixture(scope="module")
def frames():
    meshes = things()
    return [scenes.capture(meshes, name, seed)[0] for seed, name in enumerate(("left", "right"))]


def test_the_node_gives_what_the_core_gives(frames):
    low, high = (0.15, -0.6, -0.05), (0.95, 0.6, 0.5)
    # Poses go through quaternions on their way: so do the core's.
    rounded = [
        type(f)(f.color, f.depth, f.intrinsics, cv.transform_from_msg(cv.transform_to_msg(f.world_from_camera)), f.camera, f.stamp)
        for f in frames
    ]
    expected = perceive(rounded, parameters=Parameters(region_low=low, region_high=high))
    with Bench() as bench:
        bench.transforms()
        bench.until(lambda: bench.objects and bench.markers, "objects", tick=lambda: [bench.send(f) for f in frames])
        scene = cv.scene_from_msg(bench.objects[-1])
        assert scene.frame_id == "panda_link0" and scene.stamp == pytest.approx(frames[0].stamp)
        assert [o.id for o in scene.objects] == [o.id for o in expected.objects] == ["object_1", "object_2"]
        for got, want in zip(scene.objects, expected.objects, strict=True):
            np.testing.assert_allclose(got.mesh.vertices, want.mesh.vertices, atol=1e-6)
            np.testing.assert_array_equal(got.mask, want.mask)
            assert len(got.pieces) == len(want.pieces) and got.view.kind == want.view.kind
        assert bench.markers[-1].markers[0].action == Marker.DELETEALL
        # The same in metres.
        count = len(bench.objects)
        bench.until(
            lambda: len(bench.objects) > count,
            "objects from 32FC1",
            tick=lambda: [
                bench.send(type(f)(f.color, f.depth, f.intrinsics, f.world_from_camera, f.camera, f.stamp + 1), "32FC1") for f in frames
            ],
        )
        again = cv.scene_from_msg(bench.objects[-1])
        np.testing.assert_allclose(again.objects[0].mesh.vertices, scene.objects[0].mesh.vertices, atol=1e-4)


def test_one_camera_is_enough_and_the_other_is_named(frames):
    with Bench() as bench:
        bench.transforms()
        bench.until(lambda: bench.objects and "NO_FRAMES" in bench.codes(), "objects of one camera", tick=lambda: bench.send(frames[0]))
        assert any("camera/right" in m for m in bench.messages())


def test_known_objects_are_merged(frames):
    cylinder = things()[1]
    scene = perceive(list(frames))
    known = [o for o in scene.objects if abs(o.world_from_object[0, 3] - cylinder.bounds.mean(axis=0)[0]) < 0.03]
    assert len(known) == 1
    from dataclasses import replace

    fixture = replace(known[0], id="post", source="known", mask=None)
    with Bench() as bench:
        bench.transforms()
        bench.known.publish(cv.scene_to_msg(Scene((fixture,), scene.table)))
        bench.until(
            lambda: any("post" in [o.id for o in m.objects] for m in bench.objects),
            "the known object",
            tick=lambda: [bench.send(f) for f in frames],
        )
        assert sorted(o.id for o in bench.objects[-1].objects)[-1] == "post" and len(bench.objects[-1].objects) == 2


def test_bad_input_is_answered_by_diagnostics(frames):
    frame = frames[0]
    empty, _ = scenes.capture([], "left")

    def later(base, seconds, **changes):
        return type(base)(
            changes.get("color", base.color),
            changes.get("depth", base.depth),
            base.intrinsics,
            base.world_from_camera,
            base.camera,
            seconds,
        )

    clock = iter(range(10, 100000))
    zero = cv.intrinsics_to_msg(frame.intrinsics)
    zero.k = [0.0] * 9
    cases = [
        ("NO_CAMERA_INFO", lambda: bench.send(later(frame, next(clock)), info=False)),
        ("BAD_INTRINSICS", lambda: bench.send(later(frame, next(clock)), info_msg=zero)),
        ("NO_TRANSFORM", lambda: bench.send(later(frame, next(clock)))),
        ("BAD_ENCODING", lambda: bench.send(later(frame, next(clock)), "64FC1")),
        ("BAD_IMAGE", lambda: bench.send(later(frame, next(clock)), step=7)),
        ("NO_DEPTH", lambda: bench.send(later(frame, next(clock), depth=np.full_like(frame.depth, np.nan)), "32FC1")),
        ("NO_OBJECTS", lambda: bench.send(later(empty, next(clock)))),
    ]
    with Bench(camera_timeout=0.3, cameras=["left"]) as bench:
        for code, act in cases:
            if code == "BAD_ENCODING":
                bench.transforms()
            bench.diagnostics.clear()
            bench.until(lambda code=code: bench.diagnostics and code in bench.codes(), code, tick=act)
        # An empty table is a scene without objects, not silence.
        assert bench.objects and not bench.objects[-1].objects
        # And after all this a good frame is perceived.
        bench.until(lambda: bench.objects[-1].objects, "objects after bad input", tick=lambda: bench.send(later(frame, next(clock))))


def later(frame, seconds):
    return type(frame)(frame.color, frame.depth, frame.intrinsics, frame.world_from_camera, frame.camera, seconds)


def test_swapped_topics_are_named(frames):
    frame = frames[0]
    clock = iter(range(1, 100000))
    with Bench(cameras=["left"]) as bench:
        bench.transforms()
        color, depth, info = bench.out["left"]

        def swapped():
            head = cv.header("left_color_optical_frame", float(next(clock)))
            info.publish(cv.intrinsics_to_msg(frame.intrinsics, head))
            depth.publish(cv.image_to_msg(frame.color, "rgb8", head))
            color.publish(cv.image_to_msg(np.nan_to_num(frame.depth * 1000).round(), "16UC1", head))

        bench.until(lambda: "BAD_ENCODING" in bench.codes(), "BAD_ENCODING", tick=swapped)
        assert any("camera/left/" in m and "16UC1" in m for m in bench.messages()) and not bench.objects
        bench.until(lambda: bench.objects, "objects once the topics are right", tick=lambda: bench.send(later(frame, float(next(clock)))))


def test_stamps_that_jump_back_are_named_and_survived(frames):
    frame = frames[0]
    with Bench(cameras=["left"]) as bench:
        bench.transforms()
        clock = iter(range(1000, 100000))
        bench.until(lambda: bench.objects, "objects", tick=lambda: bench.send(later(frame, float(next(clock)))))
        count = len(bench.objects)
        past = iter(range(10, 900))
        # The diagnostic lasts some seconds, a slow machine's objects may come later: each is waited for by itself.
        told = set()

        def survived():
            told.update(bench.codes())
            return "STALE_DATA" in told and len(bench.objects) > count and bench.objects[-1].header.stamp.sec < 900

        bench.until(
            survived, "objects and STALE_DATA after stamps went back", 30.0, tick=lambda: bench.send(later(frame, float(next(past))))
        )


def test_a_camera_that_dies_is_named_and_the_other_goes_on(frames):
    clock = iter(range(1, 100000))
    with Bench() as bench:
        bench.transforms()

        def both():
            seconds = float(next(clock))
            for frame in frames:
                bench.send(later(frame, seconds))

        bench.until(lambda: bench.objects, "objects of two cameras", tick=both)
        count, last = len(bench.objects), bench.objects[-1].header.stamp.sec
        told = set()

        def alone():
            told.update(m for m in bench.messages() if "camera right" in m and "STALE_DATA" in m)
            return told and len(bench.objects) > count + 1

        bench.until(
            alone,
            "objects of one camera and a diagnostic of the other",
            30.0,
            tick=lambda: bench.send(later(frames[0], float(next(clock)))),
        )
        assert bench.objects[-1].header.stamp.sec > last and len(bench.objects[-1].objects) == 2


def test_a_bad_start_is_refused():
    rclpy.init(domain_id=scenes.free_domain())
    try:
        from magic_core.errors import Code, MagicError

        with pytest.raises(MagicError) as error:
            _with_overrides({"segmenter": "magic"})
        assert error.value.code in (Code.BAD_REQUEST, Code.UNKNOWN_SEGMENTER)
        with pytest.raises(MagicError) as error:
            _with_overrides({"extrinsics.left": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 3.0]})
        assert "extrinsics.left" in error.value.message
    finally:
        rclpy.try_shutdown()


def test_what_never_came_is_named_before_what_has_stopped():
    with Bench(cameras=["left"]) as bench:
        stream, now = bench.node.streams["left"], time.monotonic()
        stream.last["color"] = stream.last["camera_info"] = now - 30.0
        assert "aligned_depth_to_color/image_raw" in bench.node.camera_status("left", now).message
        assert "NO_FRAMES" in bench.node.camera_status("left", now).message
        stream.last["depth"] = now - 30.0
        assert "STALE_DATA" in bench.node.camera_status("left", now).message
        assert "color/image_raw" in bench.node.camera_status("left", now).message
