"""What is missing for the graph to work, and how to mend it: ``ros2 run magic_bringup magic doctor``.

:class:`Look` asks the graph and listens for some seconds; what follows from that is found by functions that need no graph.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, JointState

from magic_bringup.connection import Client
from magic_bringup.graph import NODES
from magic_core import conversions, presence, qos
from magic_core.entry import version
from magic_core.errors import Code, MagicError
from magic_core.remedies import REMEDIES
from magic_core.robot import Description, RobotConfig
from magic_core.tf import TransformBuffer
from magic_core.tf_listener import TransformListener
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_interfaces.srv import MatchContact
from magic_server.remote import servers_of

#: What is listened for at least, s: every node reports once a second.
LISTEN = 3.0
#: What a node is given to tell its parameters, s.
ASK = 2.0
#: Stamps that are off the clock by more than this tell of clocks that differ, s.
CLOCKS = 5.0
#: Modules whose versions matter when somebody is asked for help, with the packages that bring them.
MODULES = {
    "numpy": "numpy",
    "torch": "torch",
    "open3d": "open3d",
    "sapien": "sapien",
    "mplib": "mplib",
    "cv2": "opencv-python-headless",
    "sklearn": "scikit-learn",
}
#: The packages of this project that have to be of one version.
OWN = ("magic_core", "magic_bringup", "magic_perception", "magic_matcher", "magic_planner", "magic_verifier")
#: Parameters that are asked for.
ASKED = {
    "perception": ("cameras", "frame", "aligned", "depth_unit", "self_filter", "segmenter", "weights", "device"),
    "matcher": ("features", "weights", "device"),
    "planner": ("robot.urdf", "robot.srdf", "robot.package_root", "robot.move_group", "robot.closing_axis", "robot.opening", "robot.home", "robot.base_frame"),
    "verifier": (),
    "strategy_server": ("execute", "trajectory_action", "gripper_action"),
}  # fmt: skip
START = "ros2 launch magic_bringup magic.launch.xml"


class Finding(NamedTuple):
    """level: ok, note or FAIL; what was found; how to mend it, empty where nothing is to mend."""

    level: str
    text: str
    mend: str = ""


@dataclass
class Topic:
    """What is known of a topic: its types, how many publish it, how many of them are not latched, and the first message that came."""

    types: tuple[str, ...] = ()
    publishers: int = 0
    volatile: int = 0
    message: Any = None


@dataclass
class Seen:
    """All that was seen of a graph; ``parameters`` by node, of those that told them; ``topics`` by full name; ``now`` s.

    actions: action name -> how many serve it.  playing: a bag is being played.
    """

    namespace: str = ""
    now: float = 0.0
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)
    topics: dict[str, Topic] = field(default_factory=dict)
    actions: dict[str, int] = field(default_factory=dict)
    transforms: TransformBuffer = field(default_factory=TransformBuffer)
    diagnostics: dict[str, DiagnosticStatus] = field(default_factory=dict)
    joints: set[str] = field(default_factory=set)
    playing: bool = False

    def name(self, relative: str) -> str:
        """The full name of a relative one."""
        return relative if relative.startswith("/") else f"{self.namespace.rstrip('/')}/{relative}"

    def topic(self, relative: str) -> Topic:
        """What is known of a topic; empty where nothing is."""
        return self.topics.get(self.name(relative), Topic())


# ------------------------------------------------------------ asking the graph


class Look:
    """Asks and listens with a client's node."""

    def __init__(self, client: Client, cameras: Sequence[str]) -> None:
        self.client, self.node = client, client.node
        self.seen = Seen(self.node.get_namespace())
        self._given = tuple(cameras)
        self._listener = TransformListener(self.node, client.group)
        self._remotes = {
            "matcher": client.service(MatchContact, "match_contact", "matcher"),
            "planner": client.action(PlanMotion, "plan_motion", "planner"),
            "verifier": client.action(VerifyMotion, "verify_motion", "verifier"),
            "strategy_server": client.action(RunStrategy, "run_strategy", "strategy server"),
        }
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE, callback_group=client.group)
        self.node.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR, callback_group=client.group)

    def _on_diagnostics(self, message: Any) -> None:
        self.seen.diagnostics.update({status.name: status for status in message.status})

    def _on_joints(self, message: Any) -> None:
        self.seen.joints.update(message.name)
        self.seen.topics.setdefault(self.seen.name("joint_states"), Topic()).message = message

    def servers(self) -> dict[str, tuple[str, int]]:
        """Node -> what it serves, and how many do."""
        found = {name: (remote.name, len(remote.servers())) for name, remote in self._remotes.items()}
        topic = self.node.resolve_topic_name("objects")
        return {n: found[n] if n in found else (topic, self.node.count_publishers(topic)) for n in NODES}

    def take(self, timeout: float) -> Seen:
        """Look until all servers are there and something was heard of everything, ``timeout`` seconds at most and LISTEN at least."""
        begin, seen = time.monotonic(), self.seen
        deadline = begin + max(LISTEN, timeout)
        wait = self.client.token.wait
        wait(lambda: time.monotonic() > begin + 1.0 and all(n == 1 for _, n in self.servers().values()), deadline, alive=lambda: None)
        seen.parameters = {name: told for name in NODES if (told := self._parameters(name)) is not None}
        heard = self._cameras()
        wait(
            lambda: time.monotonic() > begin + LISTEN and all(seen.topics[t].message is not None for t in heard),
            max(deadline, time.monotonic() + LISTEN),
            alive=lambda: None,
        )
        self._graph()
        seen.now = self.node.get_clock().now().nanoseconds * 1e-9
        seen.transforms = self._listener.buffer
        return seen

    def _parameters(self, name: str) -> dict[str, Any] | None:
        """What a node says of its parameters; None where it says nothing."""
        service = self.client.service(GetParameters, f"{name}/get_parameters", name)
        if not service.servers():
            return None
        wanted = (*ASKED[name], "use_sim_time")
        try:
            answer = service.call(GetParameters.Request(names=list(wanted)), ASK, self.client.token, presence=0.5)
        except MagicError as error:
            if error.code == Code.CANCELED:
                raise
            return None
        return dict(zip(wanted, map(parameter_value_to_python, answer.values)))

    def _cameras(self) -> list[str]:
        """Listen to every camera's topics once; the names of those that are published."""
        kinds = {"Image": Image, "CameraInfo": CameraInfo}
        wanted = [(t, kind) for camera in cameras_of(self.seen, self._given) for t, kind in camera_topics(camera, self.seen)]
        for topic, kind in wanted:
            name = self.seen.name(topic)
            found = self.seen.topics.setdefault(name, Topic())

            def first(message: Any, found: Topic = found) -> None:
                found.message = found.message or message

            self.node.create_subscription(kinds[kind], name, first, qos.SENSOR, callback_group=self.client.group)
        return [self.seen.name(t) for t, _ in wanted if self.node.count_publishers(self.seen.name(t))]

    def _graph(self) -> None:
        """Who publishes what, and which actions there are."""
        seen = self.seen
        for name, types in self.node.get_topic_names_and_types():
            infos = self.node.get_publishers_info_by_topic(name)
            topic = seen.topics.setdefault(name, Topic())
            topic.types, topic.publishers = tuple(types), len(infos)
            topic.volatile = sum(i.qos_profile.durability == DurabilityPolicy.VOLATILE for i in infos)
        for key in ("trajectory_action", "gripper_action"):
            action = seen.parameters.get("strategy_server", {}).get(key)
            if action:
                seen.actions[action] = len(servers_of(self.node, self.node.resolve_service_name(f"{action}/_action/send_goal")))
        seen.playing = presence.playing(self.node)


def examine(client: Client, timeout: float, cameras: Sequence[str] = ()) -> list[Finding]:
    """Everything that is to be said of the graph around a client."""
    look = Look(client, cameras)
    seen = look.take(timeout)
    return [
        *environment_findings(),
        *(server_finding(name, *there) for name, there in look.servers().items()),
        *clock_findings(seen),
        *(f for camera in cameras_of(seen, cameras) for f in camera_findings(camera, seen)),
        *fixture_findings(seen),
        *joint_findings(seen),
        *weight_findings(seen),
        *controller_findings(seen),
        *diagnostic_findings(seen.diagnostics, seen.namespace),
    ]


# ------------------------------------------------------------ this process


def environment_findings() -> Iterator[Finding]:
    """Of this process: middleware, domain, versions, what the features have to work with."""
    rmw = os.environ.get("RMW_IMPLEMENTATION", "the default one")
    where = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    yield Finding("ok", f"ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')}, discovery {where}, middleware {rmw}")
    own = {name: version(name) for name in OWN}
    numbers = sorted(set(own.values()))
    if len(numbers) == 1:
        yield Finding("ok", f"version {numbers[0]} of every package")
    else:
        text = "packages of several versions: " + ", ".join(f"{name} {number}" for name, number in own.items())
        yield Finding("FAIL", text, "bash ros2_ws/setup.sh --rebuild")
    versions, missing = [], []
    for module, package in MODULES.items():
        if importlib.util.find_spec(module) is None:
            missing.append(package)
            continue
        try:
            versions.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:  # a distribution's own package has no such record
            versions.append(f"{package} as installed by the system")
    yield Finding("ok", "versions: " + ", ".join(versions))
    if missing:
        yield Finding("FAIL", "not installed here: " + ", ".join(missing), "bash ros2_ws/setup.sh, then source ros2_ws/env.sh")


# ------------------------------------------------------------ servers


def server_finding(name: str, serves: str, count: int) -> Finding:
    """Of one node of the graph, by what it serves."""
    what = f"{name} ({serves})"
    if count == 1:
        return Finding("ok", f"{what} is there")
    if count == 0:
        package, program = NODES[name]
        return Finding("FAIL", f"{what} is not there", f"ros2 run {package} {program}, or all at once: {START}")
    return Finding("FAIL", f"{what} is there {count} times", "end all but one: their answers cannot be told apart (ros2 node list)")


# ------------------------------------------------------------ cameras


def cameras_of(seen: Seen, given: Collection[str] = ()) -> tuple[str, ...]:
    """The cameras to look at: those that are given, else perception's."""
    return tuple(given) or tuple(seen.parameters.get("perception", {}).get("cameras") or ())


def camera_topics(camera: str, seen: Seen) -> list[tuple[str, str]]:
    """Topics of a camera as perception subscribes to them, each with the name of its message."""
    base = f"camera/{camera}"
    topics = [(f"{base}/color/image_raw", "Image"), (f"{base}/color/camera_info", "CameraInfo")]
    if seen.parameters.get("perception", {}).get("aligned", True):
        return [*topics, (f"{base}/aligned_depth_to_color/image_raw", "Image")]
    return [*topics, (f"{base}/depth/image_rect_raw", "Image"), (f"{base}/depth/camera_info", "CameraInfo")]


def camera_findings(camera: str, seen: Seen) -> list[Finding]:
    """Topics, types, encodings, sizes, stamps and frames of one camera."""
    found, heard = [], {}
    for relative, kind in camera_topics(camera, seen):
        name, topic = seen.name(relative), seen.topic(relative)
        compressed = next((s for s in ("compressed", "compressedDepth") if seen.topic(f"{relative}/{s}").publishers), "")
        if not topic.publishers:
            if compressed and kind == "Image":
                found.append(Finding("ok", f"{name}: comes {compressed}"))
                continue
            found.append(Finding("FAIL", f"nobody publishes {name}", _missing(relative, kind, seen)))
            continue
        if topic.types != (f"sensor_msgs/msg/{kind}",):
            mend = f"publish sensor_msgs/msg/{kind} under this name, or rename the other topic"
            found.append(Finding("FAIL", f"{name} is of type {', '.join(topic.types)}", mend))
            continue
        if topic.publishers > 1:
            found.append(
                Finding(
                    "FAIL", f"{name} has {topic.publishers} publishers, whose messages mix", f"end all but one: ros2 topic info -v {name}"
                )
            )
        if topic.message is None:
            mend = f"ros2 topic hz {name}; large messages are lost over Wi-Fi and by small buffers: raise net.core.rmem_max, or subscribe on the camera's machine"
            found.append(Finding("FAIL", f"{name} is published, but nothing came", mend))
            continue
        heard[relative.rsplit("/", 2)[1] + "/" + kind] = topic.message
        found += _message_findings(name, topic.message, kind, "depth" in relative, seen)
    color, info = heard.get("color/Image"), heard.get("color/CameraInfo")
    if color is not None and info is not None and (color.width, color.height) != (info.width, info.height):
        text = f"{camera}: image of {color.width} x {color.height}, intrinsics of {info.width} x {info.height}"
        found.append(Finding("FAIL", text, "give the intrinsics of the images' own resolution"))
    depth = heard.get("aligned_depth_to_color/Image")
    if color is not None and depth is not None and (color.width, color.height) != (depth.width, depth.height):
        text = f"{camera}: colour {color.width} x {color.height}, aligned depth {depth.width} x {depth.height}"
        found.append(Finding("FAIL", text, "align_depth.enable:=true in the driver, or perception's aligned: false"))
    if color is not None:
        found += _frame_findings(camera, color, seen)
    return (
        found if any(f.level != "ok" for f in found) else [Finding("ok", f"camera {camera}: colour, depth, intrinsics and pose are there")]
    )


def _missing(relative: str, kind: str, seen: Seen) -> str:
    """How to get a camera's topic: by the driver's option, or by what comes under another name."""
    others = sorted(n for n, t in seen.topics.items() if t.publishers and f"sensor_msgs/msg/{kind}" in t.types and n != seen.name(relative))
    named = f"; published is: {', '.join(others[:6])} (remap: -r {seen.name(relative)}:={others[0]})" if others else ""
    if "aligned_depth" in relative:
        return "start the camera's driver with align_depth.enable:=true, or set perception's aligned: false" + named
    return "start the camera's driver, or set perception's cameras to the names that there are" + named


def _message_findings(name: str, message: Any, kind: str, is_depth: bool, seen: Seen) -> Iterator[Finding]:
    try:
        if kind == "CameraInfo":
            conversions.intrinsics_from_msg(message)
        elif is_depth:
            conversions.depth_from_msg(message, seen.parameters.get("perception", {}).get("depth_unit") or "")
        else:
            conversions.color_from_msg(message)
    except MagicError as error:
        yield Finding("FAIL", f"{name}: {error.code.name}: {error.message}", REMEDIES[error.code].mend)
    if not message.header.frame_id:
        yield Finding("FAIL", f"{name}: frame_id is empty", "set the driver's frame names: TF cannot say where a nameless camera is")
    yield from _stamp_findings(name, message.header.stamp, seen)


def _stamp_findings(name: str, stamp: Any, seen: Seen) -> Iterator[Finding]:
    age = seen.now - (stamp.sec + 1e-9 * stamp.nanosec)
    simulated = any(p.get("use_sim_time") for p in seen.parameters.values())
    if abs(age) > CLOCKS and not simulated and not seen.playing:
        where = f"{abs(age):.0f} s in the {'past' if age > 0 else 'future'}"
        mend = "set the clocks of the machines by one server (chronyc tracking), or the driver's to the system's time"
        yield Finding("FAIL", f"{name}: stamps lie {where}", mend)


def _frame_findings(camera: str, image: Any, seen: Seen) -> Iterator[Finding]:
    target = seen.parameters.get("perception", {}).get("frame", "panda_link0")
    try:
        seen.transforms.lookup(target, image.header.frame_id)
    except MagicError as error:
        given = f"extrinsics.{camera}"
        mend = f"publish the static transform, or give perception its {given}: calibrate_cameras writes them (cameras.param.yaml)"
        yield Finding("note", f"camera {camera}: no pose in TF: {error.message} (none is needed where {given} is set)", mend)


# ------------------------------------------------------------ clock, fixtures, joints


def clock_findings(seen: Seen) -> list[Finding]:
    """Whether all nodes go by one clock, and whether it goes."""
    simulated = {name: bool(told.get("use_sim_time")) for name, told in seen.parameters.items()}
    if not simulated:
        return []
    by = [name for name, flag in simulated.items() if flag]
    if by and len(by) < len(simulated):
        mend = "the same for all: launch with use_sim_time:=true, or without it"
        return [Finding("FAIL", f"use_sim_time is set for {', '.join(by)} and not for the others", mend)]
    if by and not seen.topic("/clock").publishers:
        return [Finding("FAIL", "use_sim_time is set, but nobody publishes /clock", "play the bag with --clock, or unset use_sim_time")]
    replayed = "; a bag is being played: its stamps are not compared with it" if seen.playing else ""
    return [Finding("ok", "clock: " + ("simulated, by /clock" if by else "the system's") + replayed)]


def fixture_findings(seen: Seen) -> list[Finding]:
    """Known objects have to be latched."""
    known = seen.topic("known_objects")
    if not known.volatile:
        return []
    return [
        Finding(
            "FAIL",
            f"{seen.name('known_objects')} is not latched: who starts later never hears it",
            "publish it with durability transient local",
        )
    ]


def joint_findings(seen: Seen) -> list[Finding]:
    """Whether the arm's own joints are told."""
    told = seen.parameters.get("planner")
    if told is None:
        return []
    values = {name.removeprefix("robot."): value for name, value in told.items() if name.startswith("robot.") and value is not None}
    try:
        values["home"] = tuple(values.get("home") or RobotConfig().home)
        arm = Description(RobotConfig(**values)).names
    except MagicError as error:
        return [Finding("FAIL", f"the robot's description: {error.message}", "ros2 run magic_planner describe_robot --help")]
    name = seen.name("joint_states")
    missing = [joint for joint in arm if joint not in seen.joints]
    if not missing:
        return list(_stamp_findings(name, seen.topic(name).message.header.stamp, seen)) or [Finding("ok", f"{name}: all joints of the arm")]
    executes = bool(seen.parameters.get("strategy_server", {}).get("execute"))
    hides = "the arm is not cut out of the pictures, and plans begin at robot.home"
    if seen.joints:
        text = f"{name} says nothing of {', '.join(missing)}; it names {', '.join(sorted(seen.joints))}"
        return [Finding("FAIL", text, "describe this arm by robot_params, or publish its joint states under these names")]
    return [
        Finding("FAIL" if executes else "note", f"nothing came on {name}: {hides}", "start the arm's driver or joint_state_broadcaster")
    ]


# ------------------------------------------------------------ weights and controllers


def weight_findings(seen: Seen) -> list[Finding]:
    """Whether the networks that are asked for have their weights and their device."""
    found = []
    for node, key, plain in (("matcher", "features", ("embedded",)), ("perception", "segmenter", ("depth",))):
        told = seen.parameters.get(node)
        if told is None or told.get(key) is None:
            continue
        kind, weights, device = told[key], told.get("weights") or "", told.get("device") or ""
        if kind in plain or (kind == "auto" and not weights):
            found.append(Finding("ok", f"{node}: {key} {kind}, which needs no weights"))
            continue
        remedy = REMEDIES[Code.FEATURE_WEIGHTS if node == "matcher" else Code.SEGMENTER_WEIGHTS].mend
        path = Path(weights).expanduser()
        if (("/" in weights and weights.count("/") != 1) or weights.startswith((".", "~"))) and not path.is_dir():
            found.append(Finding("FAIL", f"{node}: weights {weights}: no such folder", remedy))
        elif path.is_dir() and not any(path.rglob("config.json")):
            found.append(Finding("FAIL", f"{node}: weights {weights}: no config.json in it", remedy))
        else:
            found.append(Finding("ok", f"{node}: {key} {kind}, weights {weights or 'by default'}"))
        if device.startswith("cuda") and not Path("/proc/driver/nvidia/version").exists():
            found.append(
                Finding(
                    "note",
                    f"{node}: device {device}, but this machine has no NVIDIA driver",
                    "device: auto, or run the doctor where the node runs",
                )
            )
    return found


def controller_findings(seen: Seen) -> list[Finding]:
    """The controllers of arm and gripper: wanted where plans are carried out."""
    told = seen.parameters.get("strategy_server")
    if told is None:
        return []
    executes = bool(told.get("execute"))
    found = [
        Finding(
            "ok" if executes else "note", f"execute: {str(executes).lower()}" + ("" if executes else ": plans are published, nothing moves")
        )
    ]
    for key, what in (("trajectory_action", "the arm's controller"), ("gripper_action", "the gripper's")):
        action = told.get(key)
        if not action:
            continue
        count, name = seen.actions.get(action, 0), seen.name(action)
        mend = f"ros2 control list_controllers; start it, or set {key} to one of `ros2 action list`"
        if count == 1:
            found.append(Finding("ok", f"{what} ({name}) is there"))
        elif count:
            found.append(Finding("FAIL", f"{what} ({name}) is there {count} times", "end all but one: each would carry every motion out"))
        else:
            found.append(Finding("FAIL" if executes else "note", f"{what} ({name}) is not there", mend))
    return found


# ------------------------------------------------------------ what nodes say


def diagnostic_findings(heard: Mapping[str, DiagnosticStatus], namespace: str) -> list[Finding]:
    """What the nodes of a namespace say about themselves, with the remedy of the code that they name."""
    prefix = namespace.strip("/")
    own = {n: s for n, s in sorted(heard.items()) if not prefix or n.startswith(f"{prefix}/")}
    levels = {DiagnosticStatus.OK: "ok", DiagnosticStatus.WARN: "note"}
    return [Finding(levels.get(status.level, "FAIL"), f"{name}: {status.message}", _remedy(status)) for name, status in own.items()]


def _remedy(status: DiagnosticStatus) -> str:
    """What to do about the code that a diagnostic carries as a value, or names in brackets; empty where it has none."""
    told = next((v.value for v in status.values if v.key == "code"), "")
    match = re.search(r"\[(\d{3})\b", status.message)
    number = told if told else match[1] if match else ""
    code = next((c for c in Code if number in (c.name, str(int(c)))), Code.OK)
    return "" if code == Code.OK else REMEDIES[code].mend
