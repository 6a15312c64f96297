"""The node against synthetic cameras: good input gives the core's objects, bad input gives a diagnostic."""

import os

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import time
from pathlib import Path

import numpy as np
import pytest
import scenes

rclpy = pytest.importorskip("rclpy")
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo, Image, JointState
from visualization_msgs.msg import Marker, MarkerArray

from magic_core import conversions as cv
from magic_core import shapes, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.domain import free_domain
from magic_core.qos import LATCHED, RELIABLE, SENSOR, STATIC_TF
from magic_core.scene import Scene
from magic_interfaces.msg import SceneObjectArray
from magic_perception import conversions as pc
from magic_perception import node
from magic_perception.meanwhile import LOOKS
from magic_perception.node import Perception
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.pipeline import perceive

tf2_msgs = pytest.importorskip("tf2_msgs.msg")


class Bench:
    """One perception node and a tester that plays two cameras."""

    def __init__(self, **parameters):
        rclpy.init(domain_id=free_domain())
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
        used = [self.out[name][i] for name in self.node.settings.cameras for i in ((0, 1, 2) if self.node.settings.aligned else (0, 2))]
        try:
            self.until(lambda: all(p.get_subscription_count() for p in [*used, self.tf]), "discovery")
        except BaseException:
            self.__exit__()
            raise
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
        head = cv.header(changes.get("frame_id", f"{frame.camera}_color_optical_frame"), frame.stamp)
        color, depth, camera_info = self.out[frame.camera]
        if info:
            camera_info.publish(changes.get("info_msg") or cv.intrinsics_to_msg(frame.intrinsics, head))
        pixels = np.nan_to_num(frame.depth * 1000).round() if encoding == "16UC1" else frame.depth
        msg = cv.image_to_msg(pixels, encoding if encoding in ("16UC1", "32FC1") else "32FC1", head)
        msg.encoding = encoding
        if "step" in changes:
            msg.step = changes["step"]
        if "depth_pixels" in changes:
            msg = cv.image_to_msg(changes["depth_pixels"], "16UC1", head)
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
    # Poses go through quaternions on their way: so do the core's.
    rounded = [
        type(f)(f.color, f.depth, f.intrinsics, cv.transform_from_msg(cv.transform_to_msg(f.world_from_camera)), f.camera, f.stamp)
        for f in frames
    ]
    expected = perceive(rounded, parameters=Parameters(**WORKSPACE))
    with Bench() as bench:
        bench.transforms()
        bench.until(lambda: bench.objects and bench.markers, "objects", tick=lambda: [bench.send(f) for f in frames])
        scene = cv.scene_from_msg(bench.objects[-1])
        assert scene.frame_id == "panda_link0" and scene.stamp == pytest.approx(frames[0].stamp)
        assert [o.id for o in scene.objects] == [o.id for o in expected.objects] == ["object_1", "object_2"]
        for got, want in zip(scene.objects, expected.objects, strict=True):
            # The mean of several pictures of single precision is not each of them to the last digit: micrometres.
            np.testing.assert_allclose(got.mesh.vertices, want.mesh.vertices, atol=1e-5)
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


def test_a_scene_that_stays_is_looked_at_once_more_by_the_mean_of_several_looks(monkeypatch):
    """The noise of one look is not for ever, nor that of each later one for ten seconds: that made handles come and go."""
    meshes, stamps = things(), iter(range(1, 100))
    true = {name: scenes.capture(meshes, name, noise=0.0)[0] for name in ("left", "right")}
    seen, original = [], node.perceive

    def perceive_it(frames, *rest):
        seen.append(frames)
        return original(frames, *rest)

    def off(frames):
        return np.mean([np.nanstd(f.depth - true[f.camera].depth) for f in frames])

    with Bench(rate=20.0) as bench:
        monkeypatch.setattr(node, "perceive", perceive_it)
        bench.transforms()

        def look():
            stamp = next(stamps)
            for k, name in enumerate(true):
                bench.send(scenes.capture(meshes, name, 10 * stamp + k, stamp=float(stamp))[0])

        bench.until(lambda: len({cv.time_from_msg(o.header.stamp) for o in bench.objects}) >= LOOKS + 3, "objects", 40.0, tick=look)
        shapes_told = [o.objects[0].mesh.vertices for o in bench.objects]
    assert len(seen) == 2, "anew by the mean, and not again meanwhile"
    assert off(seen[1]) < 0.65 * off(seen[0])
    assert shapes_told[0] == shapes_told[1] != shapes_told[-1]


def test_one_camera_is_enough_and_the_other_is_named(frames):
    with Bench() as bench:
        bench.transforms()
        bench.until(lambda: bench.objects and "NO_FRAMES" in bench.codes(), "objects of one camera", tick=lambda: bench.send(frames[0]))
        assert any("camera/right" in m for m in bench.messages())


def test_cameras_that_begin_late_are_waited_for(frames):
    """A bag played, or cameras started, long after the node: the first to speak is not taken for the only one."""
    with Bench(camera_timeout=10.0) as bench:
        bench.node.started -= 60.0
        bench.transforms()
        left = bench.node.streams["left"]
        bench.until(lambda: left.pairs and left.intrinsics is not None, "frames of the left camera", tick=lambda: bench.send(frames[0]))
        assert bench.node.gather(time.monotonic()) == ([], [], set())
        bench.until(lambda: bench.objects, "objects of both cameras", tick=lambda: [bench.send(f) for f in frames])
        assert bench.node.outcome[3]["cameras"] == "left, right"


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


def altered(message, **changes):
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_more_bad_input_is_answered_by_diagnostics(frames):
    frame = frames[0]
    clock = iter(range(10, 100000))
    good = cv.intrinsics_to_msg(frame.intrinsics)
    half = Intrinsics(320, 240, 307.0, 307.0, 160.0, 120.0)
    k = list(good.k)

    def depth(values):
        return type(frame)(frame.color, values.astype(np.float32), frame.intrinsics, frame.world_from_camera, "left", float(next(clock)))

    def send(**changes):
        return lambda: bench.send(later(frame, float(next(clock))), **changes)

    def info(**changes):
        return send(info_msg=altered(cv.intrinsics_to_msg(frame.intrinsics), **changes))

    def short(bench):
        head = cv.header("left_color_optical_frame", float(next(clock)))
        bench.out["left"][2].publish(good)
        bench.out["left"][0].publish(cv.image_to_msg(frame.color, "rgb8", head))
        whole = cv.image_to_msg(np.nan_to_num(frame.depth * 1000).round(), "16UC1", head)
        bench.out["left"][1].publish(altered(whole, data=bytes(whole.data)[:-100]))

    with Bench(camera_timeout=0.3, cameras=["left"]) as bench:
        bench.transforms()
        for what, code, act in [
            ("infinite depth", "NO_DEPTH", lambda: bench.send(depth(np.full_like(frame.depth, np.inf)), "32FC1")),
            ("depth of zeros", "NO_DEPTH", lambda: bench.send(depth(np.zeros_like(frame.depth)))),
            ("negative depth", "NO_DEPTH", lambda: bench.send(depth(np.full_like(frame.depth, -1.0)), "32FC1")),
            ("depth of another size", "BAD_IMAGE", send(depth_pixels=np.ones((240, 320)))),
            ("camera_info of another size", "BAD_IMAGE", send(info_msg=cv.intrinsics_to_msg(half))),
            ("data cut short", "BAD_IMAGE", lambda: short(bench)),
            ("NaN in K", "BAD_INTRINSICS", info(k=[float("nan")] * 9)),
            ("negative focal length", "BAD_INTRINSICS", info(k=[-k[0], *k[1:]])),
            ("transposed K", "BAD_INTRINSICS", info(k=np.reshape(k, (3, 3)).T.ravel().tolist())),
            ("centre off the image", "BAD_INTRINSICS", info(k=[*k[:2], 5000.0, *k[3:]])),
            ("no size", "BAD_INTRINSICS", info(width=0, height=0)),
            ("no frame_id", "NO_TRANSFORM", send(frame_id="")),
            ("unknown frame_id", "NO_TRANSFORM", send(frame_id="nowhere")),
        ]:
            bench.diagnostics.clear()
            count = len(bench.objects)
            bench.until(lambda code=code: bench.diagnostics and code in bench.codes(), f"{code} for {what}", tick=act)
            assert all(o.objects for o in bench.objects[count:]), what
        bench.until(lambda: bench.objects and bench.objects[-1].objects, "objects after bad input", tick=send())


@pytest.mark.parametrize(
    "model, coefficients, pixels",
    [
        ("plumb_bob", [0.0] * 5, 0.0),
        (
            "plumb_bob",
            [0.1, 0.0, 0.0, 0.0, 0.0],
            0.1 * np.hypot(319.5, 239.5) ** 3 / 600**2,
        ),  # the corner's r, of k1 r^3 times the focal length
        ("equidistant", [0.0] * 4, 0.0),  # as drivers fill in what is rectified
        ("plumb_bob", [0.1, 0.2], np.inf),
        ("plumb_bob", [np.nan] * 5, np.inf),
    ],
)
def test_what_a_lens_bends_is_told_in_pixels(model, coefficients, pixels):
    k = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    assert pc.distortion(CameraInfo(distortion_model=model, d=coefficients), k) == pytest.approx(pixels, rel=1e-6)


def test_a_lens_that_bends_its_picture_is_named(frames):
    info = cv.intrinsics_to_msg(frames[0].intrinsics)
    info.d = [-0.055, 0.065, 0.0, 0.0, -0.02]  # of a D455
    clock = iter(range(10, 1000))
    with Bench(cameras=["left"]) as bench:
        bench.transforms()
        bench.until(
            lambda: bench.objects and any("distortion" in m and "pixels" in m for m in bench.messages()),
            "objects, and what the lens does",
            tick=lambda: bench.send(later(frames[0], float(next(clock))), info_msg=info),
        )


def test_sprinkled_bad_pixels_do_no_harm(frames):
    clock = iter(range(10, 100000))
    rng = np.random.default_rng(0)
    depth = frames[0].depth.copy()
    for value in (np.nan, np.inf, -np.inf, -1.0, 0.0, 60.0):
        depth[rng.random(depth.shape) < 0.01] = value
    with Bench(cameras=["left"]) as bench:
        bench.transforms()

        def act():
            f = frames[0]
            bench.send(type(f)(f.color, depth, f.intrinsics, f.world_from_camera, "left", float(next(clock))), "32FC1")

        bench.until(lambda: bench.objects, "objects", tick=act)
        assert len(bench.objects[-1].objects) == 2


def test_depth_of_another_unit_is_named_and_read_where_it_is_told(frames):
    """A driver that counts in quarters of a millimetre, with its largest number where it saw nothing."""
    clock = iter(range(10, 100000))
    quarters = np.where(np.isfinite(frames[0].depth), np.nan_to_num(frames[0].depth) * 4000, 65535).round().clip(0, 65535).astype(np.uint16)

    def act():
        bench.send(later(frames[0], float(next(clock))), depth_pixels=quarters)

    with Bench(cameras=["left"]) as bench:
        bench.transforms()
        bench.until(lambda: "DEPTH_UNIT" in bench.codes(), "DEPTH_UNIT", tick=act)
        assert any("0.25mm" in m and "depth_unit" in m for m in bench.messages()) and not bench.objects
    with Bench(cameras=["left"], depth_unit="0.25mm") as bench:
        bench.transforms()
        bench.until(lambda: bench.objects, "objects", tick=act)
        assert_places(cv.scene_from_msg(bench.objects[-1]).objects, things())


def test_images_that_come_compressed_only_are_decoded(frames):
    import cv2
    from sensor_msgs.msg import CompressedImage

    clock = iter(range(10, 100000))
    with Bench(cameras=["left"]) as bench:
        for publisher in bench.out["left"][:2]:
            bench.tester.destroy_publisher(publisher)
        base = "camera/left"
        color_out = bench.tester.create_publisher(CompressedImage, f"{base}/color/image_raw/compressed", SENSOR)
        depth_out = bench.tester.create_publisher(CompressedImage, f"{base}/aligned_depth_to_color/image_raw/compressedDepth", SENSOR)
        jpeg = cv2.imencode(".jpg", frames[0].color[..., ::-1])[1].tobytes()
        millimetres = np.nan_to_num(frames[0].depth * 1000).round().astype(np.uint16)
        png = bytes(12) + cv2.imencode(".png", millimetres)[1].tobytes()
        bench.transforms()

        def act(depth_format="16UC1; compressedDepth png"):
            head = cv.header("left_color_optical_frame", float(next(clock)))
            bench.out["left"][2].publish(cv.intrinsics_to_msg(frames[0].intrinsics, head))
            color_out.publish(CompressedImage(header=head, format="rgb8; jpeg compressed bgr8", data=jpeg))
            depth_out.publish(CompressedImage(header=head, format=depth_format, data=png))

        bench.until(
            lambda: "BAD_ENCODING" in bench.codes(), "a format of depth that is not read", tick=lambda: act("16UC1; compressedDepth rvl")
        )
        bench.until(lambda: bench.objects, "objects", tick=act)
        assert_places(cv.scene_from_msg(bench.objects[-1]).objects, things())


def test_images_of_other_names_are_named(frames):
    with Bench(cameras=["left"]) as bench:
        for publisher in bench.out["left"][:2]:
            bench.tester.destroy_publisher(publisher)
        bench.tester.create_publisher(Image, "wrist/rgb", SENSOR)
        bench.until(lambda: any("NO_FRAMES" in m and "/wrist/rgb" in m for m in bench.messages()), "the name of the other topic")


def moving_camera(bench):
    """The left camera's pose at a time, along y by 0.25 m/s, and what publishes it."""
    out = bench.tester.create_publisher(tf2_msgs.TFMessage, "/tf", RELIABLE)
    bench.until(lambda: out.get_subscription_count(), "discovery of /tf")

    def at(seconds):
        return transforms.make(translation=[0, 0.25 * (seconds - 10.0), 0]) @ scenes.POSES["left"]

    def publish(seconds):
        t = TransformStamped(child_frame_id="left_color_optical_frame", transform=cv.transform_to_msg(at(seconds)))
        t.header = cv.header("panda_link0", seconds)
        out.publish(tf2_msgs.TFMessage(transforms=[t]))

    return at, publish


def test_a_moving_camera_s_frames_wait_for_their_transform():
    """Transforms come 0.3 s after the images, and between their stamps: the things stay where they are."""
    meshes = things()
    with Bench(cameras=["left"]) as bench:
        at, publish = moving_camera(bench)
        shots = {}
        for k in range(3):
            seconds = 10.0 + 0.2 * k
            shots[seconds], _ = scenes.capture(meshes, "left", k, world_from_camera=at(seconds), stamp=seconds)
        publish(9.95)
        for seconds, frame in shots.items():
            bench.send(frame)
            bench.until(
                lambda: bench.node.streams["left"].pairs and bench.node.streams["left"].pairs[-1].stamp >= seconds - 1e-6, "the pair"
            )
        assert not bench.objects and bench.node.done == 0
        for seconds in np.arange(10.0, 10.6, 0.07):
            publish(float(seconds))
        bench.until(lambda: bench.objects, "objects")
        for message in bench.objects:
            assert_places(cv.scene_from_msg(message).objects, meshes)


def test_a_camera_at_the_wrist_remembers_what_it_no_longer_sees():
    """It looks at two things, then, after a way on which nothing is kept, at one of them: both are told, the one out of sight as such."""
    meshes = things()
    poses = {20.0: ([0.25, 0.45, 0.62], [0.55, 0.0, 0.02]), 30.0: ([0.45, -0.5, 0.35], [0.5, -0.25, 0.02])}
    with Bench(cameras=["left"], average=2, rate=1.0, self_filter=False) as bench:
        broadcaster = bench.tester.create_publisher(tf2_msgs.TFMessage, "/tf", RELIABLE)
        bench.until(broadcaster.get_subscription_count, "discovery of /tf")
        told = []
        for start, where in poses.items():
            pose = scenes.pose(*where)
            for k in range(4):
                stamp = start + 0.5 * k
                t = TransformStamped(child_frame_id="left_color_optical_frame", transform=cv.transform_to_msg(pose))
                t.header = cv.header("panda_link0", stamp)
                broadcaster.publish(tf2_msgs.TFMessage(transforms=[t]))
                bench.send(scenes.capture(meshes, "left", k, world_from_camera=pose, stamp=stamp)[0])
                bench.until(
                    lambda: bench.node.streams["left"].pairs and bench.node.streams["left"].pairs[-1].stamp >= stamp - 1e-6, "the pair"
                )
            bench.until(lambda: bench.objects and cv.time_from_msg(bench.objects[-1].header.stamp) >= start + 0.4, "the scene")
            told.append(cv.scene_from_msg(bench.objects[-1]).objects)
        first, second = told
        assert_places(second, meshes)
        assert {o.id for o in first} == {o.id for o in second} and all(o.cut_off == () for o in first)
        hook, cylinder = sorted(second, key=lambda o: o.world_from_box[1, 3])
        assert hook.cut_off == () and cylinder.cut_off == ("unseen",)


def test_an_image_later_than_every_transform_is_refused_by_name(frames):
    with Bench(cameras=["left"], transform_timeout=0.3) as bench:
        _, publish = moving_camera(bench)
        publish(9.0)
        publish(10.0)
        clock = iter(range(11, 100000))
        bench.until(
            lambda: any("NO_TRANSFORM" in m and "10.000" in m for m in bench.messages()),
            "the newest transform's stamp",
            tick=lambda: bench.send(later(frames[0], float(next(clock)))),
        )
        assert not bench.objects


def test_a_short_bag_without_transforms_is_not_waited_for_without_end(frames):
    """Played in a loop its frames are young again and again."""
    with Bench(cameras=["left"], transform_timeout=1.0) as bench:
        clock = iter([10.0, 10.2, 10.4] * 1000)
        bench.until(
            lambda: bench.node.outcome[1].name == "NO_TRANSFORM",
            "the missing transform",
            tick=lambda: bench.send(later(frames[0], next(clock))),
        )


@pytest.mark.parametrize("stamps", [(10.0, 10.2), (10.0, 11.5)], ids=["shorter than a second", "longer"])
def test_a_bag_with_fewer_frames_than_are_averaged_is_not_waited_for_without_end(frames, stamps):
    """As a killed recorder leaves it, played in a loop: its first frame is young again and again."""
    with Bench(cameras=["left"], camera_timeout=0.5, average=3) as bench:
        bench.transforms()
        clock = iter(stamps * 1000)
        bench.until(lambda: bench.objects, "objects", tick=lambda: bench.send(later(frames[0], next(clock))))


@pytest.mark.parametrize("stamps", [(10.0,), (10.0, 10.2, 10.4)], ids=["one frame", "shorter than a second"])
def test_the_things_of_a_short_bag_are_told_each_time_it_is_played(frames, stamps, monkeypatch):
    """Who asks how long ago they came hears that they are still there; the pictures being the same, nothing is perceived anew."""
    perceived = []
    monkeypatch.setattr(node, "perceive", lambda *given: perceived.append(1) or perceive(*given))
    with Bench(cameras=["left"], camera_timeout=0.5, average=3) as bench:
        perceived.clear()  # that of the warm-up
        bench.transforms()
        clock = iter(stamps * 1000)
        bench.until(
            lambda: len(bench.objects) > LOOKS + 1, "the same objects again", tick=lambda: bench.send(later(frames[0], next(clock)))
        )
        assert {m.header.stamp.nanosec for m in bench.objects[1:]} == {bench.objects[-1].header.stamp.nanosec}
    assert len(perceived) <= 2  # of the first frames, and of all of them


def test_a_frame_that_is_played_again_and_again_waits_once_for_joint_states(frames):
    """A bag of one frame whose only joint state is a little older."""
    with Bench(cameras=["left"], camera_timeout=0.5, average=3) as bench:
        bench.transforms()
        joints = bench.tester.create_publisher(JointState, "joint_states", 10)
        names = [*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"]
        state = JointState(name=names, position=[0.0, -0.78, 0.0, -2.36, 0.0, 1.57, 0.78, 0.04, 0.04])
        state.header.stamp = cv.time_to_msg(9.9)

        def seen():  # asked every 0.05 s: more often than joint states are waited for
            joints.publish(state)
            bench.send(later(frames[0], 10.0))
            return bench.objects

        bench.until(seen, "objects")


def test_static_transforms_of_volatile_publishers_are_heard_and_bad_rotations_named(frames):
    from rclpy.qos import QoSProfile

    clock = iter(range(10, 100000))
    with Bench(cameras=["left"], transform_timeout=0.2) as bench:
        bench.tester.destroy_publisher(bench.tf)
        bench.tf = bench.tester.create_publisher(tf2_msgs.TFMessage, "/tf_static", QoSProfile(depth=1))
        bench.until(lambda: bench.tf.get_subscription_count(), "discovery")
        t = TransformStamped(child_frame_id="left_color_optical_frame", transform=cv.transform_to_msg(scenes.POSES["left"]))
        t.header.frame_id = "panda_link0"
        q = t.transform.rotation
        good = (q.x, q.y, q.z, q.w)

        def act(factor):
            q.x, q.y, q.z, q.w = (factor * v for v in good)
            bench.tf.publish(tf2_msgs.TFMessage(transforms=[t]))
            bench.send(later(frames[0], float(next(clock))))

        for factor, said in ((0.0, "here 0,"), (1.25, "here 1.25,")):
            bench.until(
                lambda said=said: any("NO_TRANSFORM" in m and "left_color_optical_frame" in m and said in m for m in bench.messages()),
                f"the rotation of length {factor}",
                tick=lambda factor=factor: act(factor),
            )
        assert any("volatile" in m for m in bench.messages()) and not bench.objects
        bench.until(lambda: bench.objects, "objects once the rotation is nearly of length 1", tick=lambda: act(1.02))
        assert_places(cv.scene_from_msg(bench.objects[-1]).objects, things())


def test_stale_images_are_refused(frames):
    with Bench(cameras=["left"], max_age=5.0) as bench:
        bench.transforms()
        bench.until(lambda: "STALE_DATA" in bench.codes(), "STALE_DATA", tick=lambda: bench.send(later(frames[0], 1000.0)))
        assert not bench.objects
        bench.until(lambda: bench.objects, "objects of fresh images", tick=lambda: bench.send(later(frames[0], time.time())))


def assert_places(found, meshes):
    """As many objects as meshes, each where one of them is and as large."""
    assert len(found) == len(meshes)
    bounds = np.stack([o.mesh.transformed(o.world_from_object).bounds for o in found])
    for mesh in meshes:
        assert np.abs(bounds - mesh.bounds).max(axis=(1, 2)).min() < 0.007


def test_pixels_need_not_be_square():
    wide = Intrinsics(640, 480, 640.0, 500.0, 322.0, 236.0)
    meshes = things()
    clock = iter(range(10, 100000))
    frame, _ = scenes.capture(meshes, "left", intrinsics=wide)
    with Bench(cameras=["left"]) as bench:
        bench.transforms()
        bench.until(lambda: bench.objects, "objects", tick=lambda: bench.send(later(frame, float(next(clock)))))
        assert_places(cv.scene_from_msg(bench.objects[-1]).objects, meshes)


def test_depth_that_is_not_aligned(frames):
    """Depth measured 15 mm beside the colour camera by a camera of its own comes out at the same places."""
    color_from_depth = transforms.from_rpy(0.0, 0.0, 0.004, [0.015, 0.0, 0.0])
    depth_camera = Intrinsics(640, 480, 460.0, 460.0, 320.0, 240.0)
    meshes = things()
    seen, _ = scenes.capture(meshes, "left", world_from_camera=scenes.POSES["left"] @ color_from_depth, intrinsics=depth_camera)
    clock = iter(range(10, 100000))
    with Bench(cameras=["left"], aligned=False) as bench:
        bench.transforms()
        stamped = TransformStamped(child_frame_id="left_depth_optical_frame", transform=cv.transform_to_msg(color_from_depth))
        stamped.header.frame_id = "left_color_optical_frame"
        bench.tf.publish(tf2_msgs.TFMessage(transforms=[stamped]))
        depth_out = bench.tester.create_publisher(Image, "camera/left/depth/image_rect_raw", SENSOR)
        info_out = bench.tester.create_publisher(CameraInfo, "camera/left/depth/camera_info", SENSOR)

        def act(with_info=True):
            seconds = float(next(clock))
            color, depth = cv.header("left_color_optical_frame", seconds), cv.header("left_depth_optical_frame", seconds)
            bench.out["left"][2].publish(cv.intrinsics_to_msg(frames[0].intrinsics, color))
            bench.out["left"][0].publish(cv.image_to_msg(frames[0].color, "rgb8", color))
            if with_info:
                info_out.publish(cv.intrinsics_to_msg(depth_camera, depth))
            depth_out.publish(cv.image_to_msg(np.nan_to_num(seen.depth * 1000).round(), "16UC1", depth))

        bench.until(
            lambda: any("camera/left/depth/camera_info" in m for m in bench.messages()), "the missing camera_info", tick=lambda: act(False)
        )
        bench.until(lambda: bench.objects, "objects", tick=act)
        assert_places(cv.scene_from_msg(bench.objects[-1]).objects, meshes)


def test_a_publisher_of_other_qos_is_named():
    from rclpy.qos import QoSProfile

    with Bench(cameras=["left"]) as bench:
        bench.tester.create_publisher(SceneObjectArray, "known_objects", QoSProfile(depth=1))
        bench.until(lambda: any("known_objects" in m and "durability" in m for m in bench.messages()), "the name of the topic and policy")


BAG = Path(__file__).resolve().parents[2] / "bags/hooking"


@pytest.mark.skipif(not BAG.is_dir(), reason=f"no bag at {BAG}")
def test_a_bag_through_the_node_and_through_the_core():
    highlevel = pytest.importorskip("rosbags.highlevel")
    from rclpy.serialization import deserialize_message

    from magic_perception.averaging import average

    kinds = {"sensor_msgs/msg/Image": Image, "sensor_msgs/msg/CameraInfo": CameraInfo, "tf2_msgs/msg/TFMessage": tf2_msgs.TFMessage}
    with highlevel.AnyReader([BAG]) as reader:
        messages = [(c.topic, kinds[c.msgtype], bytes(raw)) for c, _, raw in reader.messages() if c.msgtype in kinds]
    poses, infos, images = {}, {}, {}
    for topic, kind, raw in messages:
        msg = deserialize_message(raw, kind)
        if kind is tf2_msgs.TFMessage:
            poses.update({t.child_frame_id: cv.transform_from_msg(t.transform) for t in msg.transforms})
        elif topic.endswith("color/camera_info"):
            infos[topic.split("/")[2]] = cv.intrinsics_from_msg(msg)
        elif topic.endswith("image_raw"):
            images.setdefault(topic.split("/")[2], {}).setdefault(cv.time_from_msg(msg.header.stamp), {})[
                "depth" if "depth" in topic else "color"
            ] = msg
    frames = [
        average(
            [
                RgbdFrame(
                    cv.color_from_msg(p["color"]),
                    cv.depth_from_msg(p["depth"]),
                    infos[name],
                    poses[p["color"].header.frame_id],
                    name,
                    stamp,
                )
                for stamp, p in sorted(pairs.items())
            ]
        )
        for name, pairs in sorted(images.items())
    ]
    count = len(images["left"])
    expected = perceive(frames, parameters=Parameters(**WORKSPACE))
    with Bench(average=count, camera_timeout=10.0) as bench:
        out = {t: bench.tester.create_publisher(k, t, SENSOR) for t, k, _ in messages if t.startswith("/camera")}
        used = {t: p for t, p in out.items() if "aligned_depth_to_color/camera_info" not in t}
        bench.until(lambda: all(p.get_subscription_count() for p in used.values()), "discovery")
        for topic, _, raw in messages:
            (bench.tf if topic == "/tf_static" else out[topic]).publish(raw) if topic in out or topic == "/tf_static" else None
            for _ in range(5):
                bench.executor.spin_once(timeout_sec=0.01)
        bench.until(lambda: bench.objects, "objects of the bag", 30.0)
        found = cv.scene_from_msg(bench.objects[-1])
    assert len(found.objects) == len(expected.objects) > 1
    for got, want in zip(found.objects, expected.objects, strict=True):
        np.testing.assert_allclose(got.mesh.vertices, want.mesh.vertices, atol=1e-6)
        np.testing.assert_allclose(got.world_from_object, want.world_from_object, atol=1e-6)
        np.testing.assert_array_equal(got.mask, want.mask)


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
    rclpy.init(domain_id=free_domain())
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


def test_the_arm_is_cut_out_where_joint_states_tell_of_it(frames):
    """With the arm before the cameras: without joint states what hangs is told, with them it is gone and the diagnostics are content."""
    from magic_core.robot import Description
    from magic_core.robot_pictures import RobotPictures

    robot = Description()
    joints = np.array([0.0, 0.35, 0.0, -2.1, 0.0, 2.45, np.pi / 4, 0.04, 0.04])
    meshes = [scenes.shape("cylinder", 2, 0.70, 0.0), *RobotPictures(robot).at(joints)]
    # Before the arm, as the recorded scenes have it: from behind it hides what is on the table.
    eyes = {"left": scenes.pose([0.94, 0.42, 0.66], [0.52, 0.0, 0.04]), "right": scenes.pose([0.94, -0.42, 0.66], [0.52, 0.0, 0.04])}
    views = [scenes.capture(meshes, name, i, world_from_camera=eye)[0] for i, (name, eye) in enumerate(eyes.items())]
    positions = robot.arm_positions(joints)
    with Bench(region_low=[0.15, -0.6, -0.05]) as bench:
        stamped = []
        for name, eye in eyes.items():
            t = TransformStamped(child_frame_id=f"{name}_color_optical_frame", transform=cv.transform_to_msg(eye))
            t.header.frame_id = "panda_link0"
            stamped.append(t)
        told = bench.tester.create_publisher(JointState, "joint_states", SENSOR)
        seconds = [0.0]

        def tick(with_joints):
            bench.tf.publish(tf2_msgs.TFMessage(transforms=stamped))
            seconds[0] += 0.15
            if with_joints:
                told.publish(JointState(header=cv.header("", 10.0 + seconds[0]), name=list(positions), position=list(positions.values())))
            for view in views:
                bench.send(later(view, 10.0 + seconds[0]))

        bench.until(lambda: "SOMETHING_HANGS" in bench.codes(), "word of what hangs", 60, lambda: tick(False))
        assert any(item.hanging for item in bench.objects[-1].objects)
        bench.until(lambda: len(bench.objects[-1].objects) == 1, "scene without the arm", 60, lambda: tick(True))
        assert not bench.objects[-1].objects[0].hanging
        bench.until(lambda: any(m.endswith("robot: OK") for m in bench.messages()), "content with the robot", 30, lambda: tick(True))
        # States that are missing for a moment: the arm is somewhere in the pictures, and no scene is made of them.
        count, end = len(bench.objects), seconds[0] + 1.5

        def gap():
            if seconds[0] < end:
                tick(False)

        bench.until(lambda: seconds[0] >= end and "STALE_DATA" in bench.codes(), "word of what is missing", 30, gap)
        assert not any(item.hanging for message in bench.objects[count:] for item in message.objects)


def test_what_the_hand_holds_is_heard():
    item = shapes.make("l_hook", 1).as_object("object_1", transforms.from_rpy(0, 0, 0.3, [0.0, 0.0, 0.02]))
    header = cv.header("panda_hand_tcp")
    with Bench() as bench:
        out = bench.tester.create_publisher(SceneObjectArray, "in_hand", LATCHED)
        out.publish(SceneObjectArray(header=header, objects=[cv.object_to_msg(item, header)]))
        bench.until(lambda: bool(bench.node.robot.held), "what is held", 30)
        (held,) = bench.node.robot.held
        assert held.link == "panda_hand_tcp"
        np.testing.assert_allclose(held.link_from_object, item.world_from_object, atol=1e-9)
        out.publish(SceneObjectArray(header=cv.header("no_link"), objects=[cv.object_to_msg(item, header)]))
        out.publish(SceneObjectArray(header=header))
        bench.until(lambda: not bench.node.robot.held, "nothing held", 30)
