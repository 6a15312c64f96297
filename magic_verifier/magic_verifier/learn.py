"""A strategy folder from the recorded bag of one demonstration: ``ros2 run magic_verifier learn``.

How to record one: tool and target lie apart on the table, both cameras see them; start the recording; take the tool and use it; stop.
The bag holds the cameras' topics, the static transforms, calibrated fixtures on ``known_objects`` if there are any, and the
motion of the tool: stamped poses of any frame that is fixed to it (a marker, a motion capture body) on a topic, or a frame of
/tf (a marker's, or the hand's, with robot_state_publisher running, where the arm is led by hand with the tool in the gripper).  Where
neither is in the bag (or with --track) the tool's own shape is followed through the pictures: a bare hand will do, pictures at 10 a
second or more, and the hand not over all of the tool.

The folder is written when all of it is known to be a strategy, trial included, and not before.  Exit status: 0 it is; 1 the strategy
does not do its own task, with what to change (--keep-failed leaves it as OUT.failed); 2 nothing could be learned, with what is wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from magic_core import goal as goals
from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.scene import VIEW_KINDS, Scene, SceneObject
from magic_core.shapes.fixtures import pose_data
from magic_core.strategy import MODES, Goal, Physics, Strategy, load, save
from magic_verifier import track
from magic_verifier.track import Track

if TYPE_CHECKING:  # physics is loaded when the arguments are known to be right
    from magic_verifier.learning import Demonstration, Learned

Array = NDArray[np.float64]
COLOR, DEPTH, INFO = "color/image_raw", "aligned_depth_to_color/image_raw", "aligned_depth_to_color/camera_info"
#: So many pictures of a topic are read: the first colour and the depth that goes with it are among them.
PICTURES = 5
#: Colour and depth belong together whose stamps differ by no more (s); so many of a topic wait for their other half.
TOGETHER, WAITING = 0.02, 4
#: Of the depth pictures after them every tenth, and of these no more than so many, evenly over the bag.
EVERY, LATER = 10, 60
#: The tool's surface is mended by the pictures of its use if these show it in so many moments.
MOMENTS = 8
#: The tool's track and the tool as it was first seen belong together if they are so near each other (m); so far where the tool is named.
NEAR, FAR = 0.10, 0.30
#: A pose that came so long (s) before or after the pictures does not tell where the tool was in them.
APART = 0.5
#: What may be given: name: (what it is, least, greatest); least itself is allowed.
RANGES = {
    "friction": ("friction coefficient", 0.01, 5.0),
    "tool_density": ("density of the tool, kg/m^3", 5.0, 25000.0),
    "target_density": ("density of the target, kg/m^3", 5.0, 25000.0),
}
#: The greatest number of a goal (m, m/s, s, degrees, or a factor).
LARGEST = 100.0
#: Numbers of a goal that mean nothing at zero.
ABOVE_ZERO = ("distance", "height", "drift", "max_speed")
#: What a strategy's folder may be called, and topics and frames.
NAME, TOPIC, FRAME = r"[A-Za-z0-9][A-Za-z0-9_.-]*", r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", r"/?[A-Za-z_][\w/.-]*"
TOOL_POSE = "/demonstration/tool_pose"


class Recorded:
    """The messages of a bag that a demonstration is read from, by topic."""

    def __init__(self, path: Path) -> None:
        from magic_bags import bag_file, bag_messages

        self.path = path
        self.types = {topic.name: topic.type_name for topic in bag_file.info(path).topics}
        self._messages: dict[str, list[Any]] = {topic: [] for topic in self.types}
        self._later: dict[str, list[Any]] = {}
        self.counts = counts = dict.fromkeys(self.types, 0)
        strides = dict.fromkeys(self.types, EVERY)

        def wanted(topic: str, type_name: str) -> bool:
            counts[topic] += 1
            if type_name != "sensor_msgs/msg/Image" or counts[topic] <= PICTURES:
                return True
            return topic.endswith(DEPTH) and counts[topic] % strides[topic] == 0

        for topic, _, message in bag_messages.messages(path, wanted):
            if self.types[topic] != "sensor_msgs/msg/Image" or counts[topic] <= PICTURES:
                self._messages[topic].append(message)
                continue
            later = self._later.setdefault(topic, [])
            later.append(message)
            if len(later) > LATER:
                later[:] = later[::2]
                strides[topic] *= 2

    @property
    def topics(self) -> set[str]:
        """The names of its topics."""
        return set(self.types)

    def of(self, topic: str) -> list[Any]:
        """The messages of a topic (of pictures the first); NO_FRAMES where there are none."""
        found = self._messages.get(topic, [])
        if not found:
            raise MagicError(Code.NO_FRAMES, f"messages of {topic} in {self.path}", 0, f"one of the bag's topics: {sorted(self.topics)}")
        return found

    def depths(self, topic: str) -> list[Any]:
        """Depth pictures of a topic all over the bag."""
        return [*self._messages.get(topic, []), *self._later.get(topic, [])]

    def transforms(self) -> tuple[Any, dict[str, str], dict[str, Track]]:
        """All of /tf and /tf_static in a buffer; the parent of each frame; and what /tf told of each frame that it moves."""
        from magic_core.conversions import remember_transform, time_from_msg
        from magic_core.tf import TransformBuffer

        buffer, parents = TransformBuffer(memory=float("inf")), {}
        raw: dict[str, list[tuple[float, list[float], list[float]]]] = {}
        for topic in ("/tf_static", "/tf"):
            for message in self._messages.get(topic, []):
                for transform in message.transforms:
                    child = transform.child_frame_id.lstrip("/")
                    parents[child] = transform.header.frame_id.lstrip("/")
                    if topic == "/tf":
                        t, q = transform.transform.translation, transform.transform.rotation
                        raw.setdefault(child, []).append((time_from_msg(transform.header.stamp), [t.x, t.y, t.z], [q.x, q.y, q.z, q.w]))
                    # What is wrong with a frame that moves is said where it is needed: another marker's does not matter here.
                    with contextlib.suppress(MagicError) if topic == "/tf" else contextlib.nullcontext():
                        remember_transform(buffer, transform, topic == "/tf_static")
        return buffer, parents, {child: _track(f"frame {child}", rows) for child, rows in raw.items()}


def _track(what: str, rows: list[tuple[float, list[float], list[float]]]) -> Track:
    stamps, positions, quaternions = zip(*rows, strict=True) if rows else ((), np.zeros((0, 3)), np.zeros((0, 4)))
    return Track(what, np.array(stamps), np.array(positions, dtype=float), np.array(quaternions, dtype=float))


def _cameras(bag: Recorded) -> list[str]:
    found = sorted(m[1] for t in bag.topics if (m := re.fullmatch(rf"(.*)/{COLOR}", t)) and f"{m[1]}/{DEPTH}" in bag.topics)
    if not found:
        raise MagicError(Code.NO_FRAMES, f"cameras in {bag.path}", sorted(bag.topics), f"topics .../{COLOR} and .../{DEPTH}")
    return found


def frames_of(bag: Recorded, world: str) -> list[RgbdFrame]:
    """The first colour and depth image of each camera, with its pose in the world."""
    from magic_core import conversions

    buffer, _, _ = bag.transforms()
    frames = []
    for camera in _cameras(bag):
        color = bag.of(f"{camera}/{COLOR}")[0]
        stamp = conversions.time_from_msg(color.header.stamp)
        depth = min(bag.of(f"{camera}/{DEPTH}"), key=lambda m: abs(conversions.time_from_msg(m.header.stamp) - stamp))
        info = bag.of(f"{camera}/{INFO}")[0]
        frames.append(
            RgbdFrame(
                conversions.color_from_msg(color),
                conversions.depth_from_msg(depth),
                conversions.intrinsics_from_msg(info),
                buffer.lookup(world, depth.header.frame_id, stamp),
                camera,
                stamp,
            )
        )
    return frames


@dataclass(frozen=True)
class Pictures:
    """Every colour picture of a bag with the depth that goes with it, of all cameras, by their stamps, as often as they are gone
    through."""

    bag: Recorded
    world: str

    def __iter__(self) -> Iterator[RgbdFrame]:
        from magic_bags import bag_messages
        from magic_core import conversions

        buffer, _, _ = self.bag.transforms()
        cameras = _cameras(self.bag)
        intrinsics = {camera: conversions.intrinsics_from_msg(self.bag.of(f"{camera}/{INFO}")[0]) for camera in cameras}
        kinds = {f"{camera}/{kind}": (camera, kind) for camera in cameras for kind in (COLOR, DEPTH)}
        waiting: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in kinds}
        ready: list[tuple[float, int, RgbdFrame]] = []
        for count, (topic, _, message) in enumerate(bag_messages.messages(self.bag.path, lambda topic, _kind: topic in kinds)):
            camera, kind = kinds[topic]
            stamp = conversions.time_from_msg(message.header.stamp)
            other = f"{camera}/{DEPTH if kind == COLOR else COLOR}"
            near = [entry for entry in waiting[other] if abs(entry[0] - stamp) <= TOGETHER]
            if not near:
                waiting[topic] = [*waiting[topic][-WAITING:], (stamp, message)]
                continue
            found = min(near, key=lambda entry: abs(entry[0] - stamp))
            waiting[other] = [entry for entry in waiting[other] if entry[0] > found[0]]
            color, depth = (message, found[1]) if kind == COLOR else (found[1], message)
            at = conversions.time_from_msg(depth.header.stamp)
            pose = buffer.lookup(self.world, depth.header.frame_id, at)
            frame = RgbdFrame(conversions.color_from_msg(color), conversions.depth_from_msg(depth), intrinsics[camera], pose, camera, at)
            heapq.heappush(ready, (at, count, frame))
            if len(ready) > WAITING * len(cameras):
                yield heapq.heappop(ready)[2]
        while ready:
            yield heapq.heappop(ready)[2]


def left_first(scene: Scene, frames: list[RgbdFrame]) -> str:
    """Id of the object that is the first not to be where it was: the one that a hand took.  Raises BAD_MOTION where none leaves its
    place."""
    from magic_perception.following import FEWEST, THROUGH, Follower

    seen = [item for item in scene.objects if item.source == "camera"]
    followers = {item.id: Follower(item.mesh, item.world_from_object, scene.table) for item in seen}
    for frame in sorted(frames, key=lambda f: f.stamp):
        gone = {}
        for item in seen:
            on, through, _ = followers[item.id].looked_at([frame], item.world_from_object)
            if through > max(FEWEST, THROUGH * (on + through)):
                gone[item.id] = through / (on + through)
        if gone:
            return max(gone, key=lambda name: gone[name])
    raise MagicError(Code.BAD_MOTION, "the tool", "nothing leaves its place", "a tool that a hand takes while the cameras look, or --tool")


def followed(bag: Recorded, world: str, tool: SceneObject, scene: Scene) -> tuple[Array, Array, SceneObject]:
    """Times (T,) in seconds and world_from_tool (T, 4, 4), by nothing but pictures, and the tool as these show it, which its first look
    showed from one side alone; raises BAD_MOTION where the tool is lost."""
    from magic_perception.following import follow

    others = [item.mesh.transformed(item.world_from_object) for item in scene.objects if item.id != tool.id]
    found = follow(tool.mesh, tool.world_from_object, scene.table, Pictures(bag, world), others)
    print(
        f"followed {tool.id} through {len(found.times)} moments, found in {found.seen}; known to {1000 * found.shift.max():.1f} mm and "
        f"{np.degrees(found.turn.max()):.1f} degrees or better"
    )
    times, poses = found.times, found.world_from_tool
    track.check_motion(f"track of {tool.id}", times, poses)
    mesh, pieces = found.surface.mended(tool.pieces)
    return times, poses, replace(tool, mesh=mesh, pieces=pieces)


def all_shown(bag: Recorded, world: str, tool: SceneObject, scene: Scene, times: Array, poses: Array) -> SceneObject:
    """The tool as all pictures show it that there are of its use, along a track that something else told, times (T,) and world_from_tool
    (T, 4, 4); as it was first seen where they do not show it in :data:`MOMENTS` moments."""
    if min(bag.counts[f"{camera}/{COLOR}"] for camera in _cameras(bag)) < MOMENTS:
        return tool
    from magic_perception.following import reshaped_along

    others = [item.mesh.transformed(item.world_from_object) for item in scene.objects if item.id != tool.id]
    surface, shown = reshaped_along(tool.mesh, tool.world_from_object, scene.table, Pictures(bag, world), times, poses, others)
    if shown < MOMENTS:
        return tool
    print(f"{tool.id}: its surface is mended by {shown} moments of its use")
    mesh, pieces = surface.mended(tool.pieces)
    return replace(tool, mesh=mesh, pieces=pieces)


def later_frames(bag: Recorded, world: str) -> list[RgbdFrame]:
    """Depth pictures all over the bag, with the camera's pose; their colour is black."""
    from magic_core import conversions

    buffer, _, _ = bag.transforms()
    frames = []
    for camera in _cameras(bag):
        intrinsics = conversions.intrinsics_from_msg(bag.of(f"{camera}/{INFO}")[0])
        blank = np.zeros((intrinsics.height, intrinsics.width, 3), np.uint8)
        for message in bag.depths(f"{camera}/{DEPTH}"):
            stamp = conversions.time_from_msg(message.header.stamp)
            try:
                pose = buffer.lookup(world, message.header.frame_id, stamp)
            except MagicError:  # a camera that moves, later than what /tf tells
                continue
            frames.append(RgbdFrame(blank, conversions.depth_from_msg(message), intrinsics, pose, camera, stamp))
    return frames


def track_of(bag: Recorded, world: str, topic: str, frame: str, since: float = -np.inf) -> tuple[Array, Array]:
    """Times (T,) in seconds and world_from_frame (T, 4, 4) of what is fixed to the tool: a frame of /tf, else the poses of a topic.

    Checked is what came from ``since`` on (seconds), see :mod:`magic_verifier.track`; raises BAD_MOTION, NO_TRANSFORM, NO_FRAMES.
    """
    buffer, parents, moving = bag.transforms()
    if frame:
        return _frames_track(buffer, parents, moving, world, frame.lstrip("/"), since)
    messages = bag.of(topic)
    if not (hasattr(messages[0], "header") and hasattr(getattr(messages[0], "pose", None), "position")):
        raise MagicError(Code.BAD_REQUEST, f"messages of {topic}", bag.types[topic], "geometry_msgs/msg/PoseStamped")
    from magic_core import conversions

    rows = [
        (
            conversions.time_from_msg(m.header.stamp),
            [m.pose.position.x, m.pose.position.y, m.pose.position.z],
            [m.pose.orientation.x, m.pose.orientation.y, m.pose.orientation.z, m.pose.orientation.w],
        )
        for m in messages
    ]
    raw = _track(topic, rows)
    track.check_raw(raw)
    poses = [conversions.pose_from_msg(m.pose) for m in messages]
    poses = [
        p if m.header.frame_id.lstrip("/") == world else buffer.lookup(world, m.header.frame_id, s) @ p
        for m, s, p in zip(messages, raw.stamps, poses, strict=True)
    ]
    return _checked_motion(topic, raw.stamps, np.stack(poses), since)


def _frames_track(
    buffer: Any, parents: dict[str, str], moving: dict[str, Track], world: str, frame: str, since: float
) -> tuple[Array, Array]:
    """The track of a frame of /tf, at the stamps of all that moves between it and the world."""
    if frame not in buffer.frames():
        raise MagicError(Code.NO_TRANSFORM, "frame of the tool", frame, buffer.frames())
    chain = [name for name in dict.fromkeys([*_up(parents, frame), *_up(parents, world)]) if name in moving]
    if not chain:
        raise MagicError(Code.BAD_MOTION, f"frame {frame}", "never moves: /tf tells nothing of it", "a frame fixed to the tool in use")
    for name in chain:
        track.check_raw(moving[name], tracker=len(chain) == 1)
        stamps = moving[name].stamps
        track.check_gaps(f"frame {name}", stamps[_from(stamps, since) :] - stamps[0])
    first, last = max(moving[name].stamps[0] for name in chain), min(moving[name].stamps[-1] for name in chain)
    times = np.unique(np.concatenate([moving[name].stamps for name in chain]))
    times = times[(times >= first) & (times <= last)]
    poses = [buffer.lookup(world, frame, float(stamp)) for stamp in times]
    return _checked_motion(f"frame {frame}", times, np.stack(poses), since)


def _up(parents: dict[str, str], frame: str) -> Iterator[str]:
    """A frame and all above it."""
    seen: set[str] = set()
    while frame and frame not in seen:
        seen.add(frame)
        yield frame
        frame = parents.get(frame, "")


def _from(stamps: Array, since: float) -> int:
    """Index of the last stamp up to ``since``."""
    return max(0, int(np.searchsorted(stamps, since, side="right")) - 1)


def _checked_motion(what: str, times: Array, poses: Array, since: float) -> tuple[Array, Array]:
    first = _from(times, since)
    track.check_motion(what, times[first:], poses[first:])
    return times, poses


def choose(scene: Scene, tool: str, target: str, origin: Array) -> tuple[SceneObject, SceneObject]:
    """Tool and target by id; where none is given, the object that a camera sees nearest to where the tool's track begins (3,), and
    the only other thing that a camera sees, or else the only known one."""
    by_id = {item.id: item for item in scene.objects}
    for what, name in (("tool", tool), ("target", target)):
        if name and name not in by_id:
            raise MagicError(Code.UNKNOWN_OBJECT, what, name, list(by_id))
    seen = [item for item in scene.objects if item.source == "camera"]
    if not tool and not seen:
        raise MagicError(Code.NO_OBJECTS, "objects that the cameras see", 0, "the tool and the target on the table, apart")
    away = {
        item.id: float(np.linalg.norm(transforms.apply(item.world_from_object, item.mesh.vertices) - origin, axis=1).min())
        for item in scene.objects
    }
    if not tool:
        tool = min((item.id for item in seen), key=lambda name: away[name])
        if away[tool] > NEAR:
            raise MagicError(
                Code.BAD_REQUEST,
                "distance of the tool's track from the nearest object",
                f"{away[tool]:.3f} m to {tool}",
                f"at most {NEAR:g} m, or name the tool: {sorted(item.id for item in seen)}",
            )
    if away[tool] > FAR:
        raise MagicError(
            Code.BAD_REQUEST,
            f"distance of the tool's track from {tool}",
            f"{away[tool]:.3f} m",
            f"at most {FAR:g} m: a body that is fixed to the tool, in the world of the cameras",
        )
    if not target:
        others = [item for item in seen if item.id != tool] or [item for item in scene.objects if item.id != tool]
        if len(others) != 1:
            raise MagicError(Code.BAD_REQUEST, "target", "not given", [item.id for item in others])
        target = others[0].id
    return by_id[tool], by_id[target]


def main(arguments: list[str] | None = None) -> int:
    """The command; errors are one line on stderr and exit status 2, a strategy that does not do its own task 1."""
    parser = argparse.ArgumentParser(
        prog="learn", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--bag", type=Path, required=True, help="the recorded demonstration")
    parser.add_argument("--out", type=Path, required=True, help="the new strategy's folder; its name is the strategy's")
    parser.add_argument(
        "--goal",
        default="",
        help=f"name of a goal that ships ({', '.join(goals.names())}), a .yaml file with a tree (magic_core/goal.py), "
        "or 'none': simulation cannot judge it; by default found from what the "
        "demonstration changes",
    )
    parser.add_argument("--value", nargs="*", default=[], metavar="NAME=NUMBER", help="numbers of the goal")
    parser.add_argument("--tool-pose", help=f"topic with the poses of a frame fixed to the tool (default {TOOL_POSE})")
    parser.add_argument("--tool-frame", help="a frame of /tf fixed to the tool, instead")
    parser.add_argument("--track", action="store_true", help="follow the tool itself, whatever else the bag has of its motion")
    parser.add_argument("--world", default="panda_link0", help="the arm's base frame")
    parser.add_argument("--tool", default="", help="id of the tool among the objects; by default the one that the track begins at")
    parser.add_argument("--target", default="", help="id of the target; by default the only other object")
    parser.add_argument("--releases", action="store_true", help="the tool is let go at the end")
    parser.add_argument("--fixed-target", action="store_true", help="the target does not move (known fixtures never do)")
    parser.add_argument("--view", default="", choices=("", *VIEW_KINDS), help="plane of the contact; by default found")
    parser.add_argument("--mode", default="", choices=("", *MODES), help="waypoints or the motion itself; by default by whether it turns")
    physics = Physics()
    parser.add_argument("--friction", type=float, default=physics.friction)
    parser.add_argument("--tool-density", type=float, default=physics.tool_density, help="kg/m^3")
    parser.add_argument("--target-density", type=float, default=physics.target_density, help="kg/m^3")
    parser.add_argument("--description", default="", help="a sentence for strategy.yaml")
    parser.add_argument("--keep-failed", action="store_true", help="leave a strategy that fails its trial as OUT.failed, to look at")
    given = parser.parse_args(arguments)
    try:
        return _learn(given)
    except (MagicError, OSError) as error:
        print(f"learn: {error}", file=sys.stderr)
        return 2


def goal_of(given: argparse.Namespace) -> tuple[Goal | None, dict[str, float]]:
    """The goal, ``None`` where it is to be found, and its numbers, as far as they can be checked; raises UNKNOWN_GOAL or BAD_REQUEST."""
    values: dict[str, float] = {}
    for text in given.value:
        name, equals, number = text.partition("=")
        try:
            value = float(number)
        except ValueError:
            raise MagicError(Code.BAD_REQUEST, "--value", text, "NAME=NUMBER") from None
        if not equals or name in values:
            raise MagicError(Code.BAD_REQUEST, "--value", text, "NAME=NUMBER, each name once")
        values[name] = value
    if given.goal == "none":
        if values:
            raise MagicError(Code.BAD_REQUEST, "--value", ", ".join(values), "no numbers with --goal none: nothing is judged")
        return Goal("none"), {}
    if given.goal and Path(given.goal).suffix in (".yaml", ".yml"):
        return _read_goal(Path(given.goal), values), values
    if given.goal and given.goal not in goals.names():
        raise MagicError(Code.UNKNOWN_GOAL, "goal test", given.goal, [*goals.names(), "none", "a .yaml file with a tree"])
    known = goals.named(given.goal).values if given.goal else {}
    for name, value in values.items():
        if known and name not in known:
            raise MagicError(Code.BAD_REQUEST, f"--value of goal {given.goal}", name, list(known))
        if not 0 <= value <= LARGEST or (value == 0 and name in ABOVE_ZERO):
            least = "above 0" if name in ABOVE_ZERO else "from 0"
            raise MagicError(Code.BAD_REQUEST, f"--value {name}", value, f"{least} to {LARGEST:g}")
    # The kicks of the released code's test belong to its set of standing cylinders, not to whatever was demonstrated.
    if not given.goal:
        return None, values
    return goals.shipped(given.goal, **({"noise": 0.0, **values} if "noise" in known else values)), values


def _read_goal(path: Path, values: dict[str, float]) -> Goal:
    """The goal that a file holds as ``goal`` of a ``strategy.yaml`` does, with numbers of it that are given; raises BAD_STRATEGY,
    BAD_REQUEST."""
    try:
        data = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise MagicError(Code.BAD_REQUEST, "--goal", f"{path}: {str(error).splitlines()[0]}", "a file with a goal in YAML") from None
    goal = goals.from_data(data["goal"] if isinstance(data, dict) and set(data) == {"goal"} else data)
    unknown = sorted(set(values) - set(goal.numbers))
    if unknown:
        raise MagicError(Code.BAD_REQUEST, f"--value of the goal in {path}", ", ".join(unknown), list(goal.numbers))
    goal = goal.with_values(values)
    goal.resolved()
    return goal


def check_given(given: argparse.Namespace) -> None:
    """Everything on the command line but the goal, before anything is read; raises BAD_REQUEST."""

    def require(fine: bool, what: str, value: object, allowed: str) -> None:
        if not fine:
            raise MagicError(Code.BAD_REQUEST, what, value, allowed)

    for key, (what, least, greatest) in RANGES.items():
        value = getattr(given, key)
        require(least <= value <= greatest, what, value, f"{least:g} to {greatest:g}")
    ways = [name for name in ("tool_pose", "tool_frame") if getattr(given, name) is not None] + ["track"] * given.track
    require(len(ways) <= 1, " and ".join(f"--{name.replace('_', '-')}" for name in ways), "both", "one of them")
    for option, value, pattern in (
        ("--tool-pose", given.tool_pose, TOPIC),
        ("--tool-frame", given.tool_frame, FRAME),
        ("--world", given.world, FRAME),
    ):
        require(value is None or bool(re.fullmatch(pattern, value)), option, value, "a name of letters, digits, _ and /")
    require(not given.tool or given.tool != given.target, "--tool and --target", given.tool, "two objects")
    require(given.goal != "hang" or given.releases, "--goal hang without --releases", "the tool stays in the hand", "--releases")
    require(
        given.goal not in ("hook", "scoop") or not given.fixed_target,
        f"--goal {given.goal} with --fixed-target",
        "a target that cannot move",
        "a free target, or another goal",
    )
    out = given.out.absolute()
    require(bool(re.fullmatch(NAME, out.name)), "name of the new strategy", out.name, "letters, digits, _, - and .")
    for folder in (out, _failed(out)) if given.keep_failed else (out,):
        # Written over is nothing, and an empty folder is nothing.
        empty = folder.is_dir() and not folder.is_symlink() and not any(folder.iterdir())
        require(empty or not os.path.lexists(folder), "folder of the new strategy", str(folder), "a new or an empty folder")
    above = next(p for p in out.parents if p.exists())
    require(above.is_dir() and os.access(above, os.W_OK), "folder of the new strategy", f"{above} cannot be written", "a folder of yours")


def _failed(out: Path) -> Path:
    return out.with_name(f"{out.name}.failed")


def demonstrated(given: argparse.Namespace) -> Demonstration:
    """What the bag shows: the scene before anything moved, and the tool's motion from then on; says what it finds.

    Raises ``BAD_REQUEST``, ``STALE_DATA`` and what :mod:`magic_verifier.track` refuses of a motion.
    """
    from magic_core import conversions
    from magic_perception.pipeline import perceive
    from magic_verifier.learning import Demonstration

    topic = TOOL_POSE if given.tool_pose is None else "/" + given.tool_pose.lstrip("/")
    bag = Recorded(given.bag)
    frames = frames_of(bag, given.world)
    seen = max(frame.stamp for frame in frames)
    bare = given.track or (given.tool_pose is None and given.tool_frame is None and topic not in bag.topics)
    what = "the tool's own track" if bare else f"frame {given.tool_frame}" if given.tool_frame else topic
    if not bare:
        times, poses = _reported(given, bag, what, topic, min(frame.stamp for frame in frames), seen)
    known = conversions.scene_from_msg(bag.of("/known_objects")[-1]).objects if "/known_objects" in bag.topics else ()
    scene = perceive(frames, tuple(known))
    print(f"objects: {', '.join(item.id for item in scene.objects)}")
    for note in scene.notes:
        print(f"note: {note}")
    if bare:
        taken = given.tool or left_first(scene, later_frames(bag, given.world))
        tool, target = choose(scene, taken, given.target, scene.find(taken).world_from_object[:3, 3])
    else:
        tool, target = choose(scene, given.tool, given.target, transforms.interpolate(times, poses, [seen])[0][:3, 3])
    for item in (tool, target):
        if item.cut_off:
            raise MagicError(
                Code.BAD_REQUEST,
                f"{item.id} is seen in part only, cut off by",
                ", ".join(item.cut_off),
                "tool and target in full view, apart",
            )
    fixed = _is_fixed(given, target)
    if fixed and given.goal in ("hook", "scoop"):
        raise MagicError(Code.BAD_REQUEST, f"target of --goal {given.goal}", f"{target.id} is a known fixture", "a target that can move")
    if bare:
        times, poses, tool = followed(bag, given.world, tool, scene)
    # What is tracked is fixed to the tool, wherever on it.
    first, later = transforms.interpolate(times, poses, [seen])[0], times > seen
    times = np.concatenate([[seen], times[later]])
    world_from_tool = np.concatenate([[first], poses[later]]) @ (transforms.inverse(first) @ tool.world_from_object)
    track.check_above(what, tool.mesh, times, world_from_tool, scene.table)
    told = track.check_seen(what, tool.mesh, times, world_from_tool, later_frames(bag, given.world))
    print(
        f"tool: {tool.id}, target: {target.id}{' (fixed)' if fixed else ''}, {len(times)} poses over {times[-1] - times[0]:.1f} s, "
        + (f"seen there in {told} depth pictures" if told else "compared with no later picture: there is none")
    )
    if not bare:
        tool = all_shown(bag, given.world, tool, scene, times, world_from_tool)
    others = tuple(item for item in scene.objects if item.id not in (tool.id, target.id))
    return Demonstration(tool, target, others, scene.table, times, world_from_tool)


def _is_fixed(given: argparse.Namespace, target: SceneObject) -> bool:
    return given.fixed_target or target.source != "camera"


def _reported(given: argparse.Namespace, bag: Recorded, what: str, topic: str, begin: float, seen: float) -> tuple[Array, Array]:
    """The recorded track of a frame that is fixed to the tool: times (T,) s and poses (T, 4, 4), at rest while the pictures of ``begin``
    to ``seen`` were taken."""
    times, poses = track_of(bag, given.world, topic, given.tool_frame or "", since=begin)
    if not times[0] - APART <= seen <= times[-1]:
        raise MagicError(
            Code.STALE_DATA,
            "the tool's track begins after the pictures, s",
            round(times[0] - seen, 2),
            f"at most {APART:g}, and ends after them",
        )
    track.check_still(what, times, poses, begin, max(seen, times[0]))
    return times, poses


def _say(learned: Learned, strategy: Strategy) -> None:
    """What was learned, in words."""
    from magic_verifier.learning import doubts

    if learned.changed is not None:
        print("what the demonstration changes, replayed:")
        print("\n".join(f"  {line}" for line in learned.changed.words()))
        for line in learned.rejected:
            print(f"not the goal: {line}")
        print(f"the goal, as it was found{' (the tool is let go)' if strategy.releases else ''}:")
        print("\n".join(f"  {line}" for line in goals.words(strategy.goal)))
    print(
        f"mode {strategy.mode}, matched in the view {strategy.view}, the target met at the {strategy.target_outline} outline; contacts of the "
        f"replay: {1000 * learned.tool_gap:.1f} mm from the strategy's on the tool, {1000 * learned.target_gap:.1f} mm on the target"
    )
    if strategy.contacts:
        print(
            f"contacts, one after the other: {', '.join(pair.name for pair in strategy.contacts)}, and the one that the goal is reached with"
        )
    for waypoint in strategy.waypoints:
        offset = " ".join(f"{1000 * x:7.1f}" for x in waypoint.offset)
        print(f"  {waypoint.phase:9} {waypoint.name:12} {offset} mm{f' of {waypoint.contact}' if waypoint.contact else ''}")
    if learned.verdict is None:
        print("not tried in simulation: it cannot judge this goal")
    else:
        print(f"tried with the demonstrated objects: {learned.verdict.code.name}, {learned.verdict.message}")
    for line in doubts(learned):
        print(f"note: {line}")


def _keep(learned: Learned, strategy: Strategy, given: argparse.Namespace) -> int:
    """Write the strategy, or what failed its own trial where that is asked for; the exit status."""
    from magic_verifier.learning import advice

    verdict = learned.verdict
    if verdict is None or verdict.success:
        write(strategy, given.out.absolute())
        print(f"strategy: {given.out}, picture: {given.out / 'contacts.png'}")
        return 0
    for line in advice(learned):
        print(line)
    if not given.keep_failed:
        print(f"no strategy was written (--keep-failed leaves it as {_failed(given.out)})")
        return 1
    marked = f"FAILED ITS OWN TRIAL ({verdict.code.name}: {verdict.message}). {strategy.description}".strip()
    write(replace(strategy, description=marked), _failed(given.out.absolute()))
    print(f"strategy that failed, to look at: {_failed(given.out)}")
    return 1


def _learn(given: argparse.Namespace) -> int:
    from magic_verifier.learning import Task, learn

    goal, values = goal_of(given)
    check_given(given)
    demonstration = demonstrated(given)
    target = demonstration.target
    task = Task(
        given.out.absolute().name,
        goal,
        Physics(given.friction, given.tool_density, given.target_density, _is_fixed(given, target)),
        given.releases,
        given.view,
        given.mode,
        given.description,
        simulatable=given.goal != "none",
        values=values if goal is None else {},
    )
    learned = learn(demonstration, task)
    # Where its target stood, so that it can be evaluated; fixtures are known to the scene, not to the strategy.
    alone = not demonstration.obstacles
    strategy = replace(learned.strategy, environment={"world_from_target": pose_data(target.world_from_object)} if alone else {})
    _say(learned, strategy)
    if not alone:
        print(
            "note: fixtures and other things stood there, which a strategy does not tell of: to evaluate it, write world_from_target and fixtures "
            "under environment in strategy.yaml (magic_core/shapes/fixtures.py says how)"
        )
    return _keep(learned, strategy, given)


def write(strategy: Strategy, out: Path) -> None:
    """A strategy's folder with a picture of its contacts, all at once: nothing is at ``out`` unless all of it can be read again.

    Raises BAD_STRATEGY where it cannot, OSError where the disk does not take it or somebody has put something there meanwhile.
    """
    import cv2

    from magic_matcher import drawing

    out.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=".learning_", dir=out.parent))
    try:
        save(strategy, beside)
        load(beside)
        pairs = ((strategy.tool_view, strategy.tool_contact), (strategy.target_view, strategy.target_contact))
        picture = drawing.side_by_side([drawing.draw_match(view, contact) for view, contact in pairs], ("tool", "target"))
        if not cv2.imwrite(str(beside / "contacts.png"), picture[..., ::-1]):
            raise OSError(f"{beside / 'contacts.png'} cannot be written")
        umask = os.umask(0)
        os.umask(umask)
        beside.chmod(0o777 & ~umask)
        beside.rename(out)  # an empty folder is replaced, another one is not
    finally:
        shutil.rmtree(beside, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
