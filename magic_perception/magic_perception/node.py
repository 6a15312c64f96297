"""The perception node: RGB-D topics in, ``objects`` out."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from visualization_msgs.msg import MarkerArray

from magic_core import conversions as cv
from magic_core import depth as depths
from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.diagnostics import Diagnostics, label, wall_timer
from magic_core.errors import Code, MagicError
from magic_core.listening import listen_apart
from magic_core.node import describe, run
from magic_core.qos import LATCHED, SENSOR, STATES
from magic_core.scene import Scene, SceneObject
from magic_core.tf_listener import TransformListener
from magic_interfaces.msg import SceneObjectArray
from magic_perception import conversions as pc
from magic_perception import node_parameters
from magic_perception.averaging import average
from magic_perception.keyframes import STEADY, STILL, Keyframes
from magic_perception.meanwhile import Made
from magic_perception.pipeline import Report, perceive
from magic_perception.registration import register_depth
from magic_perception.robot_in_view import Held, RobotInView
from magic_perception.segmenters import make_segmenter
from magic_perception.shared_out import perceiving
from magic_perception.stream import WAITING, Pair, Stream, next_scene
from magic_perception.tracking import Tracker

#: What image_transport calls its compressed images, and who reads them: raw, compressed.
DECODERS = {
    "color": (("compressed",), cv.color_from_msg, cv.color_from_compressed_msg),
    "depth": (("compressedDepth", "compressed"), cv.depth_from_msg, cv.depth_from_compressed_msg),
}
#: What a user can do about a unit.
REMEDY = "set the driver's depth unit, or this node's parameter depth_unit"
#: Pixels by which a lens may bend its picture without a word: that is not taken out.
BENT = 2.0
#: After so long without a new pair of images, s, none of those that were taken together is still on its way.
SETTLED = 0.5


class Placed(NamedTuple):
    """A pair and where its camera was at its stamp: world_from_camera (4, 4), and where depth is not registered color_from_depth (4, 4)."""

    pair: Pair
    world_from_camera: np.ndarray
    color_from_depth: np.ndarray | None


class Outcome(NamedTuple):
    """How the last look came out, for the diagnostics."""

    level: bytes
    code: Code
    message: str
    values: dict[str, object]


class Perception(Node):
    """Turns the newest frames of all cameras into objects, at most ``rate`` times a second.

    Subscribes (sensor QoS), for each camera NAME of ``cameras``: ``camera/NAME/color/image_raw`` (rgb8, bgr8, rgba8, bgra8,
    mono8), ``camera/NAME/color/camera_info`` and ``camera/NAME/aligned_depth_to_color/image_raw`` (16UC1 mm or 32FC1 m);
    where an image is not published but its ``/compressed`` or ``/compressedDepth`` is, those;
    with ``aligned`` false, ``camera/NAME/depth/image_rect_raw`` and ``camera/NAME/depth/camera_info`` instead, and depth
    is registered through TF.  ``/tf``, ``/tf_static``; ``known_objects`` (latched): fixtures; ``in_hand`` (latched): what the robot holds;
    ``obstacles`` (latched): what other software knows of; ``joint_states``: the robot (parameters ``robot.*``) is cut out of every picture.
    Publishes ``objects`` and ``perception/markers`` (latched), ``/diagnostics`` (1 Hz).
    """

    def __init__(self) -> None:
        super().__init__("perception")
        self.settings = node_parameters.read(self)
        self.workers = perceiving(self.settings.workers - 1)
        self.segmenter = make_segmenter(self.settings.segmenter, self.settings.weights, self.settings.device, self.workers)
        self.robot = node_parameters.read_robot(self, self.settings.tolerance)
        self.keyframes = Keyframes(self.settings.keyframes, self.settings.keyframe_age)
        self.warm_up()

        self.streams = {camera: Stream(camera, self.settings.tolerance, self.settings.count + WAITING) for camera in self.settings.cameras}
        self.tracker = Tracker()
        # The last scene and what it was made of.
        self.made: Made | None = None
        # What was published last: the scene that it is but for its stamp, and the message.  And the scene whose markers nobody has seen
        # yet.
        self.told: tuple[Scene, SceneObjectArray] | None = None
        self.unshown: Scene | None = None
        # By topic: calibrated fixtures, and what other software knows of.
        self.known: dict[str, tuple[SceneObject, ...]] = {}
        self.known_problems: dict[str, tuple[Code, str]] = {}
        self.unheard: dict[str, str] = {}
        self.distortion: dict[str, float] = {}
        # Of each camera: the share of its last picture that was cut as the robot, or why it was not.
        self.cut: dict[str, float | MagicError] = {}
        self.joints_problem: MagicError | None = None
        self.done_stamp = self.last_run = -math.inf
        self.again = False  # the newest frames are to be looked at once more
        self.done = 0
        self.outcome = Outcome(DiagnosticStatus.WARN, Code.NO_FRAMES, "no frames yet", {})
        self.lock = threading.Lock()
        self.started = time.monotonic()
        # When images began to come after nobody had sent any for a while: from then on a camera that says nothing is waited for.
        self.resumed = self.heard = -math.inf

        self.objects_out = self.create_publisher(SceneObjectArray, "objects", LATCHED)
        self.markers_out = self.create_publisher(MarkerArray, "perception/markers", LATCHED)
        inputs, work, report = (MutuallyExclusiveCallbackGroup() for _ in range(3))
        self.inputs = inputs
        self.topics = {camera: self._subscribe(camera, inputs) for camera in self.settings.cameras}
        self.compressed: dict[tuple[str, str], Subscription] = {}
        self.transforms = TransformListener(self, inputs, self.lock)
        for topic in ("known_objects", "obstacles"):
            self.listen(SceneObjectArray, topic, partial(self.on_known, topic), LATCHED, inputs)
        if self.robot is not None:
            # Not behind the images: who is cut out by a state that is missing is not cut out.
            self.listen(SceneObjectArray, "in_hand", self.on_held, LATCHED, inputs)
            listen_apart(self, JointState, "joint_states", self.on_joints, STATES)
        wall_timer(self, min(0.1, self.settings.period / 4), self.on_work, work)
        wall_timer(self, 0.5, self.on_look, report)
        self.diagnostics = Diagnostics(self, self.on_report, report)
        self.get_logger().info(
            f"waiting for {', '.join(t for c in self.topics.values() for t in c.values())} and TF to {self.settings.frame}"
        )

    def _subscribe(self, camera: str, group: MutuallyExclusiveCallbackGroup) -> dict[str, str]:
        """Subscribe to one camera; what of it comes on which topic."""
        base = f"camera/{camera}"
        depth = "aligned_depth_to_color/image_raw" if self.settings.aligned else "depth/image_rect_raw"
        topics = {"color": f"{base}/color/image_raw", "camera_info": f"{base}/color/camera_info", "depth": f"{base}/{depth}"}
        if not self.settings.aligned:
            topics["depth_camera_info"] = f"{base}/depth/camera_info"
        for what, topic in topics.items():
            if what.endswith("camera_info"):
                callback = partial(self.on_info, camera, what == "depth_camera_info")
                self.create_subscription(CameraInfo, topic, callback, SENSOR, callback_group=group)
            else:
                self.create_subscription(Image, topic, partial(self.on_image, camera, what), SENSOR, callback_group=group)
        return topics

    def find_compressed(self) -> None:
        """Subscribe to the compressed images of what is published compressed and not raw, for as long as that is so."""
        for camera, topics in self.topics.items():
            for what, (suffixes, _, _) in DECODERS.items():
                raw, key = topics[what], (camera, what)
                if self.count_publishers(raw):
                    if key in self.compressed:
                        self.destroy_subscription(self.compressed.pop(key))
                elif key not in self.compressed:
                    topic = next((f"{raw}/{suffix}" for suffix in suffixes if self.count_publishers(f"{raw}/{suffix}")), None)
                    if topic is not None:
                        callback = partial(self.on_image, camera, what)
                        self.compressed[key] = self.create_subscription(
                            CompressedImage, topic, callback, SENSOR, callback_group=self.inputs
                        )
                        self.get_logger().info(f"{raw} comes compressed only: listening to {topic}")

    def elsewhere(self) -> str:
        """Where images of other names come, for the message that none came here."""
        kinds = {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"}
        own = {self.resolve_topic_name(t) for topics in self.topics.values() for t in topics.values()}
        own |= {s.topic_name for s in self.compressed.values()}
        found = sorted(name for name, types in self.get_topic_names_and_types() if kinds & set(types) and name not in own)
        found = [name for name in found if self.count_publishers(name)]
        return f"; images come on {', '.join(found[:8])}: remap them, or name the cameras" if found else ""

    def destroy_node(self) -> None:
        """End the processes beside this one with the node."""
        self.workers.close()
        super().destroy_node()

    def warm_up(self) -> None:
        """Look at a small made-up scene, so that the first real one does not pay for loading the libraries."""
        from magic_core import sensor, shapes

        begin = time.monotonic()
        try:
            tool = shapes.make("l_hook", 1).mesh
            tool = tool.transformed(transforms.make(translation=[0.5, 0.0, -tool.bounds[0, 2]]))
            small = Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0)
            frame = sensor.capture([tool], small, sensor.looking_at([0.2, 0.0, 0.6], [0.5, 0.0, 0.0]), 0, camera="warm_up")
            pc.markers(perceive([frame], (), self.settings.algorithm, self.segmenter, Report()))
        except Exception as error:  # what is wrong will be told when real images come
            self.get_logger().debug(f"warm-up: {describe(self, error)[1]}")
        self.get_logger().debug(f"warmed up in {time.monotonic() - begin:.2f} s")

    # ------------------------------------------------------------ input

    def listen(self, kind: type, topic: str, callback: Callable, qos: QoSProfile, group: MutuallyExclusiveCallbackGroup) -> None:
        """Subscribe; a publisher whose QoS keeps its messages from coming is named in the diagnostics."""

        def incompatible(event: object) -> None:
            what = event.last_policy_kind  # type: ignore[attr-defined]
            policy = getattr(what, "name", str(what)).lower()
            self.unheard[topic] = f"{self.resolve_topic_name(topic)}: a publisher's QoS does not fit ({policy}); wanted {_wanted(qos)}"
            self.get_logger().warning(self.unheard[topic])

        try:
            self.create_subscription(
                kind, topic, callback, qos, callback_group=group, event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible)
            )
        except UnsupportedEventTypeError:
            self.create_subscription(kind, topic, callback, qos, callback_group=group)

    def on_image(self, camera: str, what: str, msg: Image | CompressedImage) -> None:
        """One colour or depth image, raw or compressed."""
        now = time.monotonic()
        stream = self.streams[camera]
        with self.lock:
            if now - self.heard > self.settings.patience:
                self.resumed = now
            self.heard = now
            try:
                stamp = cv.time_from_msg(msg.header.stamp)
                if not msg.header.frame_id:
                    raise MagicError(
                        Code.NO_TRANSFORM, f"frame_id on {self.topics[camera][what]}", "empty", "the name of the optical frame"
                    )
                if self.settings.max_age > 0:
                    age = self.get_clock().now().nanoseconds * 1e-9 - stamp
                    if age > self.settings.max_age:
                        raise MagicError(
                            Code.STALE_DATA,
                            f"age in s of the image on {self.topics[camera][what]}",
                            round(age, 2),
                            f"at most {self.settings.max_age}",
                        )
                compressed = isinstance(msg, CompressedImage)
                _, raw_decoder, decoder = DECODERS[what]
                decode = decoder if compressed else raw_decoder
                if what == "color":
                    stream.color(stamp, decode(msg), msg.header.frame_id, now)
                else:
                    stream.unit = self.settings.depth_unit or (
                        "m" if (msg.format if compressed else msg.encoding).startswith("32FC1") else "mm"
                    )
                    stream.depth(stamp, decode(msg, self.settings.depth_unit), msg.header.frame_id, now)
            except Exception as error:
                code, message = describe(self, error)
                stream.last[what] = now
                stream.wrong(what, Code(code), f"{self.topics[camera][what]}: {message}", now)

    def on_info(self, camera: str, of_depth: bool, msg: CameraInfo) -> None:
        """Intrinsics of the colour or of the depth camera."""
        now = time.monotonic()
        stream = self.streams[camera]
        what = "depth_camera_info" if of_depth else "camera_info"
        with self.lock:
            try:
                intrinsics = cv.intrinsics_from_msg(msg)
                _check_matrix(msg, intrinsics)
                self.distortion[camera] = pc.distortion(msg, intrinsics)
                if of_depth:
                    stream.depth_intrinsics = intrinsics
                    stream.last[what] = now
                    stream.counts[what] = stream.counts.get(what, 0) + 1
                    stream.clear(what)
                else:
                    stream.info(intrinsics, now)
            except Exception as error:
                code, message = describe(self, error)
                stream.wrong(what, Code(code), f"{self.topics[camera][what]}: {message}", now)

    def on_known(self, topic: str, msg: SceneObjectArray) -> None:
        """Calibrated fixtures, and obstacles that other software tells."""
        try:
            if msg.header.frame_id and msg.header.frame_id.lstrip("/") != self.settings.frame:
                raise MagicError(Code.NO_TRANSFORM, f"frame of {topic}", msg.header.frame_id, self.settings.frame)
            known = cv.scene_from_msg(msg).objects
            with self.lock:
                others = [item.id for name, items in self.known.items() if name != topic for item in items]
                twice = sorted({item.id for item in known} & set(others))
                if twice:
                    raise MagicError(Code.BAD_REQUEST, f"ids of {topic}", ", ".join(twice), "ids that no other known object has")
                self.known[topic] = known
                self.known_problems.pop(topic, None)
                self.again = True
        except Exception as error:
            code, message = describe(self, error)
            self.known_problems[topic] = (Code(code), f"{topic}: {message}")
            self.get_logger().error(self.known_problems[topic][1])

    def on_held(self, msg: SceneObjectArray) -> None:
        """What the strategy server has made the hand hold, in the frame of a link."""
        assert self.robot is not None
        try:
            link = msg.header.frame_id.lstrip("/")
            if link not in self.robot.robot.links:
                raise MagicError(Code.NO_TRANSFORM, "frame of in_hand", link, "a link of the robot")
            self.robot.held = tuple(Held.of(item, link) for item in (cv.object_from_msg(o, pictures=False) for o in msg.objects))
            self.again = True
        except Exception as error:
            self.get_logger().error(describe(self, error)[1])

    def on_joints(self, msg: JointState) -> None:
        """Where the arm's joints are."""
        assert self.robot is not None
        try:
            self.robot.history.take(msg.name, msg.position, cv.time_from_msg(msg.header.stamp))
            self.joints_problem = None
        except MagicError as error:
            self.joints_problem = error
        except Exception as error:
            self.get_logger().error(describe(self, error)[1], throttle_duration_sec=5.0)

    # ------------------------------------------------------------ work

    def on_work(self) -> None:
        """Perceive when there is something new; no exception leaves."""
        now = time.monotonic()
        if now - self.last_run < self.settings.period:
            return
        try:
            held = () if self.robot is None else self.robot.held
            frames, notes, still = self.gather(now)
            if not frames:
                return
            self.last_run = now
            with self.lock:
                known = tuple(item for items in self.known.values() for item in items)
            made = self.made if self.made is not None and self.made.shows(frames, known) else None
            same = made is not None and made.same(frames)
            looks: tuple[list[RgbdFrame], ...] = (frames,)
            if made is not None:
                if same and made.earlier(frames):
                    made = self.made = made.seen_again(frames)
                if self.tell_again(made, frames, same):
                    self.done += 1
                    return
                if same:
                    looks, frames = made.looks, made.mean()
            report = Report(notes=notes)
            earlier = self.keyframes.useful(frames)
            scene = perceive(frames, known, self.settings.algorithm, self.segmenter, report, earlier, self.workers)
            scene, masks, carried = self.remember(scene, frames, report, still, held)
            self.made = Made(scene, frames, known, held, masks, carried, looks, len(looks))
            self.publish(scene)
            seconds = time.monotonic() - now
            self.done += 1
            self.outcome = self.outcome_of(scene, report, _values(scene, report, frames, earlier, seconds))
            if self.done == 1:
                self.get_logger().info(f"first scene after {now - self.started:.1f} s: {self.outcome.message}, in {seconds:.2f} s")
        except Exception as error:
            code, message = describe(self, error)
            self.last_run, self.made = now, None
            self.outcome = Outcome(DiagnosticStatus.ERROR, Code(code), f"[{code} {Code(code).name}] {message}", {})
            self.get_logger().error(self.outcome.message, throttle_duration_sec=5.0)

    def tell_again(self, made: Made, frames: list[RgbdFrame], same: bool) -> bool:
        """Publish the last scene once more where that is all that the newest frames tell: they show the same, or that and the arm on its
        way; false: there is more to see."""
        if not made.recent(frames):
            return False
        if same:
            if made.better:
                return False
            self.publish(replace(made.scene, stamp=max(frame.stamp for frame in frames)), made.scene)
            return True
        if self.robot is None:
            return False
        scene = made.meanwhile(frames, self.robot, self.world_from_base(frames[-1]))
        if scene is not None:
            self.publish(scene)
        return scene is not None

    def remember(
        self, scene: Scene, frames: list[RgbdFrame], report: Report, still: set[str], held: tuple[Held, ...]
    ) -> tuple[Scene, dict[str, list[np.ndarray]], frozenset[str]]:
        """The scene under the names that its things had before, the masks (H, W) of each of them in the frames, and the names of those that
        the robot carries.

        The frames are kept for what they show; still: the cameras that did not move; held: what the robot held.
        """
        numbers = [report.numbers.get(item.id, 0) for item in scene.objects]
        # What passes over others on its way is not to be taken for one of them.
        in_hand = {report.held[0]: held[0].id} if len(held) == 1 and report.held else {}
        scene = self.tracker.update(replace(scene, frame_id=self.settings.frame), in_hand)
        named = {item.id: n for n, item in zip(numbers, scene.objects, strict=True) if n}
        carried = frozenset(item.id for item in scene.objects if self.tracker.carried(item))
        # An arm that could not be cut out would be remembered as a thing.
        whole = {f.camera for f in frames if not isinstance(self.cut.get(f.camera), MagicError)}
        # What the robot holds is elsewhere in the next picture.
        there = [_free(frame, image) for frame, image in zip(frames, report.labels, strict=True)]
        passing = [named[i] for i in carried if i in named]
        self.keyframes.update([frame.free for frame in frames], there, report.earlier, still & whole, passing)
        return scene, {i: [image == n for image in report.labels] for i, n in named.items()}, carried

    def outcome_of(self, scene: Scene, report: Report, values: dict[str, object]) -> Outcome:
        """How a scene came out: with things, with none, or with some that nothing carries."""
        seen = [o for o in scene.objects if o.source == "camera"]
        hanging = [o.id for o in seen if o.hanging]
        if hanging:
            uncut = "; ".join(sorted({e.message for e in self.cut.values() if isinstance(e, MagicError)}))
            message = f"[{int(Code.SOMETHING_HANGS)} SOMETHING_HANGS] {', '.join(hanging)}: {values['notes']}"
            message += f"; the robot was not cut out of all pictures: {uncut}" if uncut else ""
            return Outcome(DiagnosticStatus.WARN, Code.SOMETHING_HANGS, message, values)
        if seen:
            message = f"{len(seen)} objects seen, {len(scene.objects) - len(seen)} known" + (f"; {values['notes']}" if report.notes else "")
            return Outcome(DiagnosticStatus.WARN if report.notes else DiagnosticStatus.OK, Code.OK, message, values)
        message = "[106 NO_OBJECTS] nothing stands on the table in the region of interest"
        return Outcome(DiagnosticStatus.WARN, Code.NO_OBJECTS, message, values)

    def gather(self, now: float) -> tuple[list[RgbdFrame], list[str], set[str]]:
        """One averaged frame for each camera that is ready, once there is something new and nobody is worth waiting for; notes; and which
        cameras stood still."""
        notes: list[str] = []
        with self.lock:
            streams = self.speaking(now, notes)
            if streams is None:
                return [], notes, set()
            newest = max(s.pairs[-1].stamp for s in self.streams.values() if s.pairs)
            placed: dict[str, list[Placed]] = {}
            limit = math.inf
            for stream in streams:
                found, pending, error = self.place(stream, now)
                if error is not None and (not found or newest - found[-1].pair.stamp > self.settings.skew):
                    self.leave_out(stream, error, notes, now)
                else:
                    placed[stream.name], limit = found, min(limit, pending)
            stamps = {camera: [p.pair.stamp for p in found] for camera, found in placed.items()}
            done, period = (math.nextafter(self.done_stamp, -math.inf), 0.0) if self.again else (self.done_stamp, self.settings.period)
            settled = now - max(s.pairs[-1].arrived for s in streams) > SETTLED if streams else False
            stamp = next_scene(stamps, self.settings.count, done, period, self.settings.skew, limit, settled)
            if stamp is not None:
                # Whatever comes of it: frames that are no good must not be in the way of the next.
                self.done_stamp, self.again = stamp, False
                placed = {camera: [p for p in found if p.pair.stamp <= stamp][-self.settings.count :] for camera, found in placed.items()}
            elif placed:
                return [], notes, set()
        frames = []
        for camera, found in placed.items():
            try:
                frames.append(self.frame_of(self.streams[camera], found))
                self.streams[camera].clear("frames")
            except MagicError as error:
                self.leave_out(self.streams[camera], error, notes, now)
        if not frames and streams:
            worst = next(s.problems["frames"] for s in streams if "frames" in s.problems)
            raise MagicError(worst.code, worst.message)
        return frames, notes, {camera for camera, found in placed.items() if all(_still(p, found[-1]) for p in found)}

    @staticmethod
    def leave_out(stream: Stream, error: MagicError, notes: list[str], now: float) -> None:
        """A camera whose frames cannot be used now."""
        stream.wrong("frames", error.code, f"camera {stream.name}: {error.message}", now)
        notes.append(f"camera {stream.name} left out: {error.message}")

    def speaking(self, now: float, notes: list[str]) -> list[Stream] | None:
        """The cameras whose frames there are, the others in the notes; ``None`` where nothing is new or a camera is waited for."""
        newest = max((s.pairs[-1].stamp for s in self.streams.values() if s.pairs), default=None)
        if newest is None:
            return None
        if newest < self.done_stamp - 1.0:
            self.done_stamp = -math.inf  # a bag began again
        elif newest >= self.done_stamp and any(stream.repeated for stream in self.streams.values()):
            # A bag shorter than that is played again, and is where it was: its things stand there as they did.
            self.again = True
            for stream in self.streams.values():
                stream.repeated = False
        if newest - self.done_stamp < self.settings.period * (1 - 1e-6) and not self.again:
            return None  # the next scene's stamp is still to come
        streams = []
        for camera, stream in self.streams.items():
            silent = now - max(stream.last.get("pair", -math.inf), self.resumed)
            few = stream.intrinsics is None or len(stream.pairs) < self.settings.count
            # Of a bag that has fewer frames and is played again and again the first one is always young.
            stream.few = min(stream.few, stream.pairs[0].arrived if stream.pairs else math.inf) if few else math.inf
            if few and silent < self.settings.patience:
                # The first frames of a camera that speaks, or the wait for one that has not spoken yet.
                first = self.resumed if math.isinf(stream.few) else max(stream.few, self.resumed)
                if now - first < self.settings.patience:
                    return None
            if stream.intrinsics is None:
                if (stream.pairs or stream.counts["color"]) and "camera_info" not in stream.problems:
                    stream.wrong(
                        "camera_info", Code.NO_CAMERA_INFO, f"no camera_info received on {self.topics[camera]['camera_info']}", now
                    )
                notes.append(f"camera {camera} left out: no camera_info")
            elif not stream.pairs:
                notes.append(f"camera {camera} left out: no frames")
            elif newest - stream.pairs[-1].stamp > self.settings.skew:
                message = f"newest frame is {newest - stream.pairs[-1].stamp:.2f} s older than the other cameras' (allowed: {self.settings.skew} s)"
                stream.wrong("stamps", Code.STALE_DATA, f"{self.topics[camera]['color']}: {message}", now)
                notes.append(f"camera {camera} left out: {message}")
            else:
                if "stamps" in stream.problems and now - stream.problems["stamps"].when > 3.0:
                    stream.clear("stamps")
                streams.append(stream)
        return streams

    def place(self, stream: Stream, now: float) -> tuple[list[Placed], float, MagicError | None]:
        """A camera's pairs with where it was at their stamps; the first stamp, s, whose transform may still come (infinite: none); and why
        it no longer may for a later pair than these."""
        found: list[Placed] = []
        pending = math.inf
        wrong: MagicError | None = None
        last: MagicError | None = None
        for pair in stream.pairs:
            try:
                pose = self.settings.extrinsics.get(stream.name)
                if pose is None:
                    pose = self.transforms.buffer.lookup(self.settings.frame, pair.frame_id, pair.stamp)
                moved = None if self.settings.aligned else self.transforms.buffer.lookup(pair.frame_id, pair.depth_frame_id, pair.stamp)
            except MagicError as error:
                if now - pair.arrived < self.settings.transform_timeout:
                    pending = min(pending, pair.stamp)
                else:
                    wrong = error
                last = error
                continue
            if self.robot is not None and self.robot.waits(pair.stamp) and now - pair.arrived < self.settings.transform_timeout:
                pending = min(pending, pair.stamp)
                continue
            found.append(Placed(pair, pose, moved))
            wrong = None
        if found or not stream.pairs:
            stream.unplaced = math.inf
        else:
            # Of a camera that was never placed the newest frames are always young, and those of a short bag are again and again.
            stream.unplaced = min(stream.unplaced, now)
            wrong = last if now - stream.unplaced >= self.settings.transform_timeout else wrong
        return found, pending, self.transforms.explain(wrong) if wrong is not None else None

    def frame_of(self, stream: Stream, placed: list[Placed]) -> RgbdFrame:
        """The average of a camera's frames at rest, with its pose."""
        intrinsics = stream.intrinsics
        assert intrinsics is not None
        last = placed[-1].world_from_camera
        frames = []
        for place in placed:
            if not _still(place, placed[-1]):
                continue  # averaging is for a camera that stands still
            pair, _, color_from_depth = place
            depth = pair.depth
            if color_from_depth is not None:
                if stream.depth_intrinsics is None:
                    raise MagicError(
                        Code.NO_CAMERA_INFO,
                        f"camera_info of {stream.name}'s depth",
                        "none received",
                        self.topics[stream.name]["depth_camera_info"],
                    )
                depth = register_depth(depth, stream.depth_intrinsics, intrinsics, color_from_depth)
            elif pair.depth_frame_id.lstrip("/") != pair.frame_id.lstrip("/"):
                raise MagicError(
                    Code.NO_TRANSFORM,
                    f"frame of {self.topics[stream.name]['depth']}",
                    pair.depth_frame_id,
                    f"{pair.frame_id}, that of colour; else set aligned to false",
                )
            try:
                frames.append(self.without_robot(RgbdFrame(pair.color, depth, intrinsics, last, stream.name, pair.stamp)))
            except MagicError:
                if place is placed[-1]:
                    raise
        result = average(frames)
        if np.isfinite(result.depth).sum() < 100:
            raise MagicError(
                Code.NO_DEPTH,
                f"pixels with depth on {self.topics[stream.name]['depth']}",
                int(np.isfinite(result.depth).sum()),
                "at least 100",
            )
        self.check_unit(stream, result)
        return replace(result, depth=depths.without_far(result.depth))

    def check_unit(self, stream: Stream, frame: RgbdFrame) -> None:
        """Depth that is no table-top's, or not that of the table under this camera, is of another unit than its encoding says."""
        depths.check_distance(frame.depth, self.topics[stream.name]["depth"], stream.unit, True, REMEDY)
        depths.check_pose(frame, stream.unit, REMEDY, self.settings.algorithm.region_low, self.settings.algorithm.region_high)

    def world_from_base(self, frame: RgbdFrame) -> np.ndarray | None:
        """Where the robot's base was at a frame's stamp (4, 4); ``None``: it is the frame of the results.  Raises NO_TRANSFORM."""
        assert self.robot is not None
        base = self.robot.robot.base
        if base == self.settings.frame:
            return None
        with self.lock:
            return self.transforms.buffer.lookup(self.settings.frame, base, frame.stamp)

    def without_robot(self, frame: RgbdFrame) -> RgbdFrame:
        """The frame, blind where the robot is; as it is where nobody tells, which the diagnostics then say.  Raises STALE_DATA where the
        arm is told of, but not where it was then: an arm that is not cut out is a thing on the table."""
        if self.robot is None:
            return frame
        try:
            frame = self.robot.cut(frame, self.world_from_base(frame))
            self.cut[frame.camera] = float(frame.blind.mean()) if frame.blind is not None else 0.0
        except MagicError as error:
            self.cut[frame.camera] = error
            if error.code == Code.STALE_DATA and self.robot.told(frame.stamp):
                raise
        return frame

    def publish(self, scene: Scene, kept: Scene | None = None) -> None:
        """Objects and markers; kept: the scene that this one is but for its stamp."""
        if self.told is not None and self.told[0] is kept:
            message = self.told[1]
            message.header.stamp = cv.time_to_msg(scene.stamp)
            for item in message.objects:
                item.cloud.header.stamp = message.header.stamp
        else:
            message = cv.scene_to_msg(scene)
            self.told, self.unshown = (kept or scene, message), scene
        self.objects_out.publish(message)
        self.show()

    def show(self) -> None:
        """Markers, once for a scene, as soon as somebody is there to see them: making them takes as long as all else of publishing."""
        scene = self.unshown
        if scene is not None and self.markers_out.get_subscription_count():
            self.unshown = None
            self.markers_out.publish(pc.markers(scene))

    # ------------------------------------------------------------ diagnostics

    def on_look(self) -> None:
        """Look twice a second for images that come compressed only, and for who wants to see markers."""
        try:
            self.find_compressed()
            self.show()
        except Exception as error:
            self.get_logger().error(describe(self, error)[1], throttle_duration_sec=5.0)

    def on_report(self) -> list[DiagnosticStatus]:
        """Once a second: what is there and what is missing."""
        now = time.monotonic()
        with self.lock:
            states = [self.camera_status(camera, now) for camera in self.settings.cameras]
        level, code, message, values = self.outcome
        worst = [s for s in states if s.level != DiagnosticStatus.OK]
        if self.done == 0 and code is Code.NO_FRAMES and worst:
            message = f"[100 NO_FRAMES] nothing to look at; {worst[0].message}"
        states.append(pc.status(f"{label(self)}: scene", level, message, code, values))
        if self.robot is not None:
            states.append(self.robot_status(self.robot))
        for topic, message in self.unheard.items():
            message = f"[{int(Code.NO_FRAMES)} QoS] {message}"
            states.append(pc.status(f"{label(self)}: topic {topic}", DiagnosticStatus.ERROR, message, Code.NO_FRAMES, {}))
        for code, message in list(self.known_problems.values()):
            message = f"[{int(code)} {code.name}] {message}"
            states.append(pc.status(f"{label(self)}: known objects", DiagnosticStatus.ERROR, message, code, {}))
        for state in states:
            state.hardware_id = self.get_fully_qualified_name()
        return states

    def robot_status(self, robot: RobotInView) -> DiagnosticStatus:
        """Whether the robot is cut out of the pictures."""
        name, cut = f"{label(self)}: robot", dict(self.cut)
        problems = {f"camera {camera}: ": error for camera, error in cut.items() if isinstance(error, MagicError)}
        if self.joints_problem is not None:
            problems[""] = self.joints_problem
        elif not cut and not robot.history.known():
            problems[""] = MagicError(Code.NO_FRAMES, self.resolve_topic_name("joint_states"), "none received")
        if problems:
            where, error = next(iter(problems.items()))
            message = f"{where}{error.message}; an arm in the pictures is not cut out (parameter self_filter: false where there is none)"
            return pc.status(name, DiagnosticStatus.WARN, f"[{int(error.code)} {error.code.name}] {message}", error.code, {})
        values = {f"share of the picture of {camera}": f"{share:.3f}" for camera, share in cut.items()}
        values |= {f"{camera} sees the arm off by": f"{1000 * off:.1f} mm" for camera, off in robot.offsets().items()}
        return pc.status(name, DiagnosticStatus.OK, "OK", Code.OK, values)

    def camera_status(self, camera: str, now: float) -> DiagnosticStatus:
        """One camera: its problems, else what of it is silent, else OK."""
        stream = self.streams[camera]
        values: dict[str, object] = {}
        for what, topic in self.topics[camera].items():
            values[topic] = f"{stream.counts.get(what, 0)} messages" + (
                f", last {now - stream.last[what]:.1f} s ago" if what in stream.last else ""
            )
        if stream.pairs:
            values["frame"] = stream.pairs[-1].frame_id
            values["stamp"] = f"{stream.pairs[-1].stamp:.3f}"
        name = f"{label(self)}: camera {camera}"
        for what in ("camera_info", "depth_camera_info", "color", "depth", "stamps", "pairing", "frames"):
            if what in stream.problems:
                problem = stream.problems[what]
                return pc.status(
                    name, DiagnosticStatus.ERROR, f"[{int(problem.code)} {problem.code.name}] {problem.message}", problem.code, values
                )
        # What has never come explains more than what has stopped.
        inputs = ("color", "depth", "camera_info", *(("depth_camera_info",) if "depth_camera_info" in self.topics[camera] else ()))
        for what in sorted(inputs, key=lambda w: w in stream.last):
            silent = now - stream.last.get(what, self.started)
            limit = math.inf if what.endswith("camera_info") else self.settings.patience
            if what not in stream.last or silent > limit:
                topic = self.topics[camera][what]
                publishers = self.get_publishers_info_by_topic(self.resolve_topic_name(topic))
                expected = "sensor_msgs/msg/CameraInfo" if what.endswith("camera_info") else "sensor_msgs/msg/Image"
                other = [i.topic_type for i in publishers if i.topic_type != expected]
                if other:
                    why = f"published as {other[0]}"
                else:
                    why = f"{len(publishers)} publishers" + (
                        f", silent for {silent:.1f} s" if what in stream.last else ", nothing received"
                    )
                    if not publishers and not what.endswith("camera_info"):
                        why += self.elsewhere()
                code = Code.NO_CAMERA_INFO if what.endswith("camera_info") else (Code.STALE_DATA if what in stream.last else Code.NO_FRAMES)
                return pc.status(
                    name, DiagnosticStatus.WARN, f"[{int(code)} {code.name}] {self.resolve_topic_name(topic)}: {why}", code, values
                )
        bent = self.distortion.get(camera, 0.0)
        if bent > BENT:
            message = f"the lens' distortion in camera_info, up to {bent:.0f} pixels (allowed: {BENT:g}), is left out: publish rectified images, and their camera_info"
            return pc.status(name, DiagnosticStatus.WARN, message, Code.BAD_INTRINSICS, values)
        return pc.status(name, DiagnosticStatus.OK, "OK", Code.OK, values)


def _still(one: Placed, other: Placed) -> bool:
    """Whether a camera was at one place at two times."""
    apart = np.linalg.norm(one.world_from_camera[:3, 3] - other.world_from_camera[:3, 3])
    return bool(apart <= STILL and transforms.rotation_angle(one.world_from_camera, other.world_from_camera) <= STEADY)


def _values(scene: Scene, report: Report, frames: list[RgbdFrame], earlier: list[RgbdFrame], seconds: float) -> dict[str, object]:
    """What the diagnostics tell of a scene beside how it came out; seconds: that it took."""
    values: dict[str, object] = {
        "objects": ", ".join(o.id for o in scene.objects),
        "seconds": round(seconds, 3),
        "cameras": ", ".join(f.camera for f in frames),
        "earlier views": ", ".join(f"{f.camera}, {frames[-1].stamp - f.stamp:.1f} s before" for f in earlier),
    }
    values.update({f"seconds {k}": round(v, 4) for k, v in report.seconds.items()})
    if report.cameras:
        values["camera poses"] = "; ".join(str(pair) for pair in report.cameras)
    values["notes"] = "; ".join(report.notes)
    return values


def _free(frame: RgbdFrame, labels: np.ndarray) -> np.ndarray:
    """Labels (H, W) without what the robot holds."""
    return labels if frame.held is None else np.where(frame.held > 0, 0, labels)


def _wanted(qos: QoSProfile) -> str:
    return f"{qos.reliability.name.lower()}, {qos.durability.name.lower()}"


def _check_matrix(msg: CameraInfo, intrinsics: Intrinsics) -> None:
    """Raises ``BAD_INTRINSICS`` for a matrix that is no camera's: skewed, transposed, or with its centre outside of the image."""
    k = [float(x) for x in msg.k]
    if abs(k[1]) > 1e-6 * k[0] or any(abs(x) > 1e-9 for x in (k[3], k[6], k[7])) or abs(k[8] - 1) > 1e-6:
        raise MagicError(Code.BAD_INTRINSICS, "K", k, "fx, 0, cx, 0, fy, cy, 0, 0, 1, row by row")
    if not (0 < intrinsics.cx < intrinsics.width and 0 < intrinsics.cy < intrinsics.height):
        raise MagicError(
            Code.BAD_INTRINSICS,
            "cx, cy",
            (intrinsics.cx, intrinsics.cy),
            f"a centre inside of {intrinsics.width} x {intrinsics.height} pixels",
        )


def main() -> None:
    """Entry point of ``ros2 run magic_perception perception``."""
    run(Perception)
