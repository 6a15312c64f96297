"""The main job from a recorded bag: start the graph, replay, run the strategy, write ``summary.json`` and ``report.html``.

Run by ``ros2_ws/demo.sh``; it needs the built workspace.  Exit status: 0 when a
verified trajectory was published, 1 when not, 2 for wrong arguments, 130 when interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magic_bringup.graph import Graph, peak_memory
from magic_bringup.record import CAMERA_TOPIC, IMAGES, Record, empty_summary, is_picture, raw_topic, shown, take, write_summary
from magic_core import environment, viewerless
from magic_core import strategy as strategies
from magic_core.domain import isolated
from magic_core.entry import version
from magic_core.errors import Code, MagicError
from magic_core.motion import VARIANTS
from magic_server.pipeline import split_metrics

#: How long the nodes may take to come up, s; the first start after a boot reads gigabytes of libraries.
START_TIMEOUT = 120.0
#: How long to wait for objects beyond the bag's own length, s.  The bag is played in a loop: a camera would go on, too.
#: Generous, as a busy machine takes its time; the shorter one holds once perception has said what is wrong.
PATIENCE, PATIENCE_AFTER_ERROR = 60.0, 8.0
#: Between the advertisement and the first message of the replay, s, so that the subscriptions have met their publishers.
PLAYER_DELAY = 0.7

#: Option of a parameters file -> the nodes that get it, and the nodes that know an arm.
FILES = {
    "perception": ("perception",),
    "matcher": ("matcher",),
    "planner": ("planner",),
    "verifier": ("verifier",),
    "server": ("strategy_server",),
}
ROBOT_NODES = ("perception", "planner", "verifier", "strategy_server")


@dataclass(frozen=True)
class Options:
    """What to do.  tool and target may be empty: the matcher chooses.  timeout in seconds for the run itself.  pictures: for the report.

    command: what the user typed, for the report.  weights: of the features.  launch: a launch file and its arguments, which start the
    nodes instead.  cameras: their names, empty: those of perception's parameters.  topics: of the bag, each with the name under which it
    is played. files: parameters files by node.  rerun: a recording for the rerun viewer as well.
    """

    strategy: str
    variant: str
    bag: Path
    out: Path
    features: str = "auto"
    tool: str = ""
    target: str = ""
    seed: int = 0
    timeout: float = 300.0
    pictures: bool = True
    command: str = ""
    weights: str = ""
    launch: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    topics: tuple[tuple[str, str], ...] = ()
    files: Mapping[str, Sequence[Path]] = field(default_factory=dict)
    rerun: bool = False


def look_into(bag: Path, topics: Sequence[tuple[str, str]] = (), cameras: Sequence[str] = ()) -> tuple[tuple[str, ...], float]:
    """The camera topics of a bag with messages in them, as they are played, and its length in seconds.

    topics: recorded name and the name that it is played under.  Raises BAD_BAG for what is no bag, an empty one, one without such a
    topic or without a topic of one of these cameras.
    """
    from magic_bags import bag_file

    info = bag_file.info(bag)
    if info.count == 0:
        raise MagicError(Code.BAD_BAG, f"the bag is empty{info.note and '; '}{info.note}", str(bag), "a bag with at least one message")
    if info.note:
        print(f"demo: {info.note}", file=sys.stderr)
    renamed = dict(topics)
    names = [t.name for t in info.topics if t.count]
    for recorded in renamed:
        if recorded not in names:
            raise MagicError(Code.BAD_BAG, "the bag has no such topic", recorded, sorted(names))
    played = [renamed.get(name, name) for name in names]
    for camera in cameras:
        if not any(name.startswith(f"/camera/{camera}/") for name in played):
            raise MagicError(Code.BAD_BAG, f"the bag has no topic /camera/{camera}/...", camera, sorted(played))
    return tuple(name for name in played if CAMERA_TOPIC.match(name)), (info.end - info.start) * 1e-9


def first_images(bag: Path, topics: Sequence[tuple[str, str]] = ()) -> dict[str, Any]:
    """The first image of each camera topic of a bag, by the name that it is played under, as messages:
    what the report shows.  Raises BAD_BAG."""
    from magic_bags import bag_messages

    renamed = dict(topics)
    found: dict[str, Any] = {}

    def wanted(topic: str, kind: str) -> bool:
        name = renamed.get(topic, topic)
        return is_picture(name) and raw_topic(name) not in found and kind in IMAGES

    for topic, _, message in bag_messages.messages(bag, wanted):
        name = renamed.get(topic, topic)
        with contextlib.suppress(MagicError):  # a picture less in the report
            found[raw_topic(name)] = shown(message)
    return found


def perceive_seconds(heard: Mapping[str, float], topics: Collection[str], objects_at: float, replay_at: float) -> float:
    """Seconds from the first whole set of one camera's ``topics`` to ``objects_at``; ``heard``: topic -> moment of its first message."""
    cameras: dict[str, list[str]] = {}
    for topic in topics:
        match = CAMERA_TOPIC.match(topic)
        if match:
            cameras.setdefault(match["camera"], []).append(topic)
    whole = [max(heard[t] for t in own) for own in cameras.values() if all(t in heard for t in own)]
    before = [at for at in (*whole, *heard.values()) if at < objects_at]
    begin = min([at for at in whole if at < objects_at] or before or [min(replay_at, objects_at)])
    return objects_at - begin


class Watcher:
    """The demo's own node: hears cameras and objects as they pass, and runs the action.  Spins in a thread of its own."""

    def __init__(self, topics: Sequence[str], say: Any) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions
        from sensor_msgs.msg import CameraInfo
        from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

        from magic_core import qos
        from magic_core.actions import ActionClient
        from magic_core.listening import join_all
        from magic_interfaces.action import RunStrategy
        from magic_interfaces.msg import SceneObjectArray

        # Not the command line: its --topics and --launch hold words that look like remappings.
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._rclpy, self._joined = rclpy, join_all
        self._say = say
        self._goal_type = RunStrategy.Goal
        self.node = Node("demo")
        self.client = ActionClient(self.node, RunStrategy, "run_strategy")
        self.changed = threading.Condition()
        # The camera_info of an image goes out with it and is small: hearing it tells when the image went, and burdens nobody.
        self._topics = tuple(t for t in topics if t.endswith("camera_info"))
        self.first: dict[str, float] = {}
        self._objects_type = SceneObjectArray
        self._objects: bytes | None = None  # as they came last: making objects of them takes long, and few are looked at
        self._scene: Any = None  # what they are
        self.objects_at: float | None = None
        self.complained_at: float | None = None
        self.replay_at = time.monotonic()
        self.trajectory: Any = None
        self._last = ""
        self.node.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED, raw=True)
        self.node.create_subscription(JointTrajectory, "verified_trajectory", self._on_trajectory, qos.LATCHED)
        self.node.create_subscription(MultiDOFJointTrajectory, "verified_tool_trajectory", self._on_trajectory, qos.LATCHED)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE)
        for topic in self._topics:
            self.node.create_subscription(CameraInfo, topic, lambda _, t=topic: self._on_camera(t), qos.SENSOR, raw=True)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _on_camera(self, topic: str) -> None:
        with self.changed:
            self.first.setdefault(topic, time.monotonic())

    def _on_objects(self, message: bytes) -> None:
        with self.changed:
            self._objects, self._scene = message, None
            if self.objects_at is None and any(o.source == "camera" for o in self.scene.objects):
                self.objects_at = time.monotonic()
            self.changed.notify_all()

    @property
    def scene(self) -> Any:
        """The newest objects; ``None``: none have come."""
        from rclpy.serialization import deserialize_message

        with self.changed:
            if self._scene is None and self._objects is not None:
                self._scene = deserialize_message(self._objects, self._objects_type)
            return self._scene

    def _on_diagnostics(self, message: Any) -> None:
        """Note since when perception has had frames but no objects; waiting for the first frames is no complaint."""
        for status in message.status:
            if status.name == "perception: scene":
                code = next((v.value for v in status.values if v.key == "code"), "")
                wrong = status.level != b"\x00" and code not in (
                    Code.OK.name,
                    Code.NO_FRAMES.name,
                    str(int(Code.OK)),
                    str(int(Code.NO_FRAMES)),
                )
                with self.changed:
                    self.complained_at = (self.complained_at or time.monotonic()) if wrong else None

    def _on_trajectory(self, message: Any) -> None:
        if not message.points:  # takes the last run's back, or this one's where the scene has changed since
            return
        self._say(f"verified trajectory with {len(message.points)} points published")
        with self.changed:
            self.trajectory = message
            self.changed.notify_all()

    def perceive_seconds(self) -> float:
        """From the first moment at which a camera had sent colour and depth to the first objects seen by a camera; 0 without any.

        Where they came before this node had heard a whole set, which best-effort messages do not
        exclude: from the first that it had heard, or else from the start of the replay.
        """
        if self.objects_at is None:
            return 0.0
        return perceive_seconds(dict(self.first), self._topics, self.objects_at, self.replay_at)

    def ready(self) -> list[str]:
        """What of the graph is still missing."""
        missing = []
        services = {name for name, _ in self.node.get_service_names_and_types()}
        for server, name in (
            ("matcher", "match_contact"),
            ("planner", "plan_motion/_action/send_goal"),
            ("verifier", "verify_motion/_action/send_goal"),
        ):
            if self.node.resolve_service_name(name) not in services:
                missing.append(server)
        if not self.client.server_is_ready():  # more than that its name is known: a goal sent before that is lost
            missing.append("strategy_server")
        if ("perception", "/") not in self.node.get_node_names_and_namespaces() or not self.node.count_publishers("objects"):
            missing.append("perception")
        return missing

    def send(self, options: Options) -> Any:
        """Send the goal; returns a holder whose ``result`` is filled in."""
        self.trajectory = None
        goal = self._goal_type(
            strategy=options.strategy,
            variant=options.variant,
            tool_id=options.tool,
            target_id=options.target,
            seed=options.seed,
            timeout=options.timeout,
            want_pictures=options.pictures,
        )
        return Pending(self, self.client.send_goal_async(goal, feedback_callback=self._on_feedback))

    def _on_feedback(self, message: Any) -> None:
        line = f"{message.feedback.stage}: {split_metrics(message.feedback.message)[0]}"
        if line != self._last:
            self._last = line
            self._say(line)

    def close(self) -> None:
        self._executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        self._rclpy.try_shutdown()
        self._thread.join(2.0)
        self._joined()


class Pending:
    """A goal on its way."""

    def __init__(self, watcher: Watcher, future: Any) -> None:
        self.handle: Any = None
        self.result: Any = None
        self._watcher = watcher
        future.add_done_callback(self._accepted)

    def _accepted(self, future: Any) -> None:
        from magic_interfaces.action import RunStrategy

        self.handle = future.result()
        if self.handle.accepted:
            self.handle.get_result_async().add_done_callback(lambda answer: self._end(answer.result().result))
        else:
            self._end(RunStrategy.Result(code=int(Code.SERVER_UNAVAILABLE), message="the strategy server takes no goals any more"))

    def _end(self, result: Any) -> None:
        with self._watcher.changed:
            self.result = result
            self._watcher.changed.notify_all()


class Demo:
    """One replay with one run."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.record = Record(empty_summary(options.strategy, options.variant, options.features, options.command))
        self._begin = time.monotonic()
        self._length = 0.0

    def say(self, line: str) -> None:
        """One line of progress."""
        print(f"[{time.monotonic() - self._begin:6.1f} s] {line}", flush=True)

    def run(self) -> Record:
        """Do it all; what goes wrong ends up in the summary's code and message."""
        summary = self.record.summary
        try:
            self._run()
        except MagicError as error:
            summary.update(code=int(error.code), message=error.message, success=False)
        except KeyboardInterrupt:
            summary.update(code=int(Code.CANCELED), message="interrupted", success=False)
        except Exception as error:
            import traceback

            traceback.print_exc()
            summary.update(code=int(Code.INTERNAL), message=f"{type(error).__name__}: {error}", success=False)
        return self.record

    def _run(self) -> None:
        options = self.options
        environment.prepare()
        viewerless.prepare()
        strategies.find(options.strategy)  # a wrong name is told before anything is started
        topics, self._length = look_into(options.bag, options.topics, options.cameras)
        env = isolated()
        os.environ.update({k: env[k] for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")})
        matcher: dict[str, object] = {"features": options.features, **({"weights": options.weights} if options.weights else {})}
        parameters: dict[str, dict[str, object]] = {
            "matcher": matcher,
            # The bag's last scene is what there is, however long the run takes.
            "strategy_server": {"objects_timeout": 5.0, "recorded": True},
        }
        if options.cameras:
            parameters["perception"] = {"cameras": json.dumps(options.cameras)}
        with Graph(options.out / "logs", env) as graph:
            self.say(f"starting the graph (ROS domain {env['ROS_DOMAIN_ID']})")
            if options.launch:
                graph.start_launch(options.launch)
            else:
                graph.start_nodes(parameters, files=options.files)
            watcher = Watcher(topics, self.say)
            try:
                self._drive(graph, watcher)
            finally:
                self._collect(graph, watcher)
                watcher.close()

    def _wait(self, graph: Graph, watcher: Watcher, done: Any, timeout: float) -> bool:
        """Wait on the watcher's events; raises where a node dies."""
        deadline = time.monotonic() + timeout
        while True:
            with watcher.changed:
                if watcher.changed.wait_for(done, min(0.25, max(0.0, deadline - time.monotonic()))):
                    return True
            graph.sample()
            graph.check()
            if time.monotonic() >= deadline:
                return False

    def _drive(self, graph: Graph, watcher: Watcher) -> None:
        options = self.options
        missing: list[str] = watcher.ready()

        def up() -> bool:
            nonlocal missing
            now = watcher.ready()
            for name in [n for n in missing if n not in now]:
                self.say(f"{name} is up")
            missing = now
            return not now

        if not self._wait(graph, watcher, up, START_TIMEOUT):
            raise MagicError(Code.SERVER_UNAVAILABLE, f"not up after {START_TIMEOUT:g} s: {', '.join(missing)}")
        self.say(f"replaying {options.bag}")
        remap = ["--remap", *(f"{recorded}:={played}" for recorded, played in options.topics)] if options.topics else []
        player = graph.start("bag_player", "magic_bringup", "bag_player", str(options.bag), "--loop", "--delay", str(PLAYER_DELAY), *remap)

        watcher.replay_at = time.monotonic() + PLAYER_DELAY

        def seen() -> bool:
            waited = time.monotonic() - watcher.complained_at if watcher.complained_at is not None else 0.0
            return watcher.objects_at is not None or player.status is not None or waited > PATIENCE_AFTER_ERROR

        self._wait(graph, watcher, seen, PLAYER_DELAY + self._length + PATIENCE)
        if player.status is not None:
            raise MagicError(Code.BAD_BAG, f"the bag cannot be played: {player.tail(1)}")
        if watcher.objects_at is None:
            self.say(f"no objects within {time.monotonic() - watcher.replay_at:.1f} s")
        else:
            ids = ", ".join(o.id for o in watcher.scene.objects)
            self.say(f"perceive: objects after {watcher.perceive_seconds():.2f} s: {ids}")
            if not options.launch:  # whose strategy server does not know that what comes is a recording
                # What is known by now is enough; the replay would only take time from the stages after it.
                player.sample()
                player.signal(signal.SIGINT)
        pending = watcher.send(options)
        if not self._wait(graph, watcher, lambda: pending.result is not None, options.timeout + 30.0):
            raise MagicError(Code.SERVER_TIMEOUT, f"the strategy_server (run_strategy) did not answer within {options.timeout + 30:g} s")
        result = self.record.result = pending.result
        summary = self.record.summary
        take(summary, result, watcher.perceive_seconds())
        summary["success"] = False  # until the trajectory has come
        if result.verified and result.code == 0:
            came = self._wait(graph, watcher, lambda: watcher.trajectory is not None, 5.0)
            summary["success"] = came
            if not came:
                summary.update(code=int(Code.INTERNAL), message="physics agreed, but no trajectory was published")

    def _collect(self, graph: Graph, watcher: Watcher) -> None:
        graph.sample()
        graph.stop()
        memory = graph.peak_memory_mb()
        memory["demo"] = round(peak_memory(os.getpid()), 1)
        self.record.summary["peak_memory_mb"] = memory
        self.record.images = first_images(self.options.bag, self.options.topics)
        self.record.scene = watcher.scene


def _parser() -> argparse.ArgumentParser:
    """The options of the command line."""
    parser = argparse.ArgumentParser(prog="demo.sh", description="From a recorded bag to a trajectory that physics has agreed to.")
    parser.add_argument("--strategy", default="hooking", help="hooking, hanging, scooping, or the folder of a strategy (default hooking)")
    parser.add_argument("--variant", default="arm", choices=VARIANTS, help="fg: a floating gripper; arm: the Panda (default arm)")
    parser.add_argument("--bag", type=Path, help="folder of the bag (default bags/<strategy>)")
    parser.add_argument("--features", default="auto", help="feature backend: auto, embedded or dinov2 (default auto)")
    parser.add_argument("--weights", default="", help="weights of the features: a hub name or a local folder (facebook/dinov2-base)")
    parser.add_argument("--out", type=Path, help="folder for summary.json and report.html (default out/<strategy>_<variant>)")
    parser.add_argument("--rerun", action="store_true", help="write run.rrd into it as well, for the rerun viewer (an extra)")
    parser.add_argument("--tool", default="", help="the tool: an id, or a name such as 'the red mug' (default: the matcher chooses)")
    parser.add_argument("--target", default="", help="the target: an id or a name (default: the matcher chooses)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random choices (default 0)")
    parser.add_argument("--timeout", type=float, default=300.0, help="s for the run from match to verify (default 300)")
    parser.add_argument(
        "--cameras", nargs="+", default=[], metavar="NAME", help="the cameras, by the name in their topics (default left right)"
    )
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="RECORDED:=PLAYED",
        help="topics of the bag under other names: /rs/rgb:=/camera/left/color/image_raw",
    )
    for node in FILES:
        parser.add_argument(f"--{node}-params", type=Path, metavar="FILE", help=f"parameters file of {FILES[node][0]}")
    parser.add_argument(
        "--robot-params", type=Path, metavar="FILE", help="parameters file of the arm, for all nodes, after their own files"
    )
    parser.add_argument(
        "--launch",
        nargs="+",
        default=[],
        metavar=("FILE", "NAME:=VALUE"),
        help="a launch file that starts the nodes instead, with its arguments; parameters are then its own business",
    )
    parser.add_argument("--version", action="version", version=f"magic_bringup {version('magic_bringup')}")
    parser.add_argument("--root", type=Path, default=Path.cwd(), help=argparse.SUPPRESS)
    return parser


def parse(argv: list[str] | None = None) -> Options:
    """The command line, checked; ends the process where it makes no sense."""
    parser = _parser()
    given = sys.argv[1:] if argv is None else argv
    a = parser.parse_args(given)
    if a.rerun:
        from magic_bringup import rerun_recording

        try:
            rerun_recording.rerun()
        except MagicError as error:
            parser.error(error.message)
    if a.launch:
        _check_launch(parser, a)
    topics = [tuple(rule.split(":=")) for rule in a.topics]
    for rule in topics:
        if len(rule) != 2 or not all(name.startswith("/") and len(name) > 1 for name in rule):
            parser.error(f"--topics: {':='.join(rule)!r} (allowed: /RECORDED:=/PLAYED)")
    name = Path(a.strategy).name
    return Options(
        strategy=str(Path(a.strategy).resolve()) if "/" in a.strategy else a.strategy,
        variant=a.variant,
        bag=(a.bag or a.root / "bags" / name).resolve(),
        out=(a.out or a.root / "out" / f"{name}_{a.variant}").resolve(),
        features=a.features,
        tool=a.tool,
        target=a.target,
        seed=a.seed,
        timeout=a.timeout,
        command=shlex.join(["bash", "ros2_ws/demo.sh", *_typed(given)]),
        weights=str(Path(a.weights).resolve()) if Path(a.weights).is_dir() and a.weights else a.weights,
        launch=(str(Path(a.launch[0]).resolve()), *a.launch[1:]) if a.launch else (),
        cameras=tuple(a.cameras),
        topics=tuple(topics),
        files=_parameter_files(parser, a),
        rerun=a.rerun,
    )


def _check_launch(parser: argparse.ArgumentParser, a: argparse.Namespace) -> None:
    """Refuse a launch file that is not there, and options that only nodes started by the demo would get."""
    if not Path(a.launch[0]).is_file():
        parser.error(f"--launch: {a.launch[0]}: no such file")
    own = ("features", "weights", "cameras", *(f"{node}_params" for node in (*FILES, "robot")))
    beside = [option for option in own if getattr(a, option) != parser.get_default(option)]
    if beside:
        parser.error(f"--launch: not together with --{beside[0].replace('_', '-')}: give the launch file's own arguments (NAME:=VALUE)")


def _parameter_files(parser: argparse.ArgumentParser, a: argparse.Namespace) -> dict[str, list[Path]]:
    """The parameters files of each node, the arm's after its own; refuses what is none."""
    files: dict[str, list[Path]] = {}
    for option, nodes in (*FILES.items(), ("robot", ROBOT_NODES)):
        path = getattr(a, f"{option}_params")
        if path is None:
            continue
        problem = _no_parameters(path)
        if problem:
            parser.error(f"--{option}-params: {path}: {problem}")
        for node in nodes:
            files.setdefault(node, []).append(path.resolve())
    return files


def _typed(arguments: Sequence[str]) -> list[str]:
    """The command line without what ``demo.sh`` adds to it."""
    words = list(arguments)
    return words[2:] if words[:1] == ["--root"] else words


def _no_parameters(path: Path) -> str:
    """Why a file is no ROS 2 parameters file; empty: it is one."""
    import yaml

    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        return str(error.strerror)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        return " ".join(str(error).split())
    if not isinstance(content, dict) or not all(isinstance(v, dict) for v in content.values()) or "ros__parameters" not in str(content):
        return "holds no ros__parameters (NODE: {ros__parameters: {NAME: VALUE}})"
    return ""


def _interrupt(_signum: int, _frame: Any) -> None:
    """The first signal ends the run; the stopping of the processes that follows takes bounded time and is not to be cut short."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise KeyboardInterrupt


def main(argv: list[str] | None = None) -> int:
    """Run the demo; returns the exit status, with the signals handled as before."""
    options = parse(argv)
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return _run(options)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(options: Options) -> int:
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"demo: cannot write into {options.out}: {error.strerror}", file=sys.stderr)
        return 2
    demo = Demo(options)
    record = demo.run()
    summary = record.summary
    # Once everything has stopped, a further signal must not leave half a file.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    page = options.out / "report.html"
    try:
        for old in ("summary.json", page.name):  # of a run before: what cannot be written must not look as if it were there
            (options.out / old).unlink(missing_ok=True)
        write_summary(record, options.out)
        _write_report(record, page, options.rerun)
    except OSError as error:
        print(f"demo: cannot write into {options.out}: {error.strerror}", file=sys.stderr)
    except Exception as error:  # the summary counts, the pictures are an addition
        import traceback

        traceback.print_exc()
        print(f"demo: the report could not be drawn: {error}", file=sys.stderr)
    verdict = "verified" if summary["success"] else f"not verified ({summary['code']} {Code(summary['code']).name})"
    demo.say(f"{verdict}: {summary['message']}")
    seconds = ", ".join(f"{k} {v:.2f}" for k, v in summary["seconds"].items())
    demo.say(f"seconds: {seconds}; simulations: {summary['simulations']}")
    demo.say("peak memory, MB: " + ", ".join(f"{k} {v:.0f}" for k, v in summary["peak_memory_mb"].items()))
    for what, path in (("summary: ", options.out / "summary.json"), ("report:  ", page)):
        if path.is_file():
            print(f"{what}{path}", flush=True)
    if summary["success"]:
        return 0
    return 130 if summary["code"] == Code.CANCELED else 1


def _write_report(record: Record, page: Path, rerun: bool) -> None:
    """The page and, beside it, what it was drawn from."""
    from magic_bringup import report, rerun_recording, run_bag

    folder = page.parent
    report.save(record, folder)
    report.write(record, page, folder / "logs")
    run_bag.write(record, folder)
    if rerun:
        rerun_recording.write(record, folder)


if __name__ == "__main__":
    sys.exit(main())
