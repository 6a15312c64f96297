"""A strategy folder from the recorded bag of one demonstration: ``ros2 run magic_verifier learn``.

How to record one: tool and target lie apart on the table, both cameras see them; start the recording; take the tool and use it; stop.
The bag holds the cameras' topics, the static transforms, calibrated fixtures on ``known_objects`` if there are any, and the
motion of the tool: stamped poses of any frame that is fixed to it (a marker, a motion capture body) on a topic, or a frame of
/tf (a marker's, or the hand's, with robot_state_publisher running, where the arm is led by hand with the tool in the gripper).
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.scene import VIEW_KINDS, Scene, SceneObject
from magic_core.strategy import MODES, Goal, Physics, save

Array = NDArray[np.float64]
COLOR, DEPTH, INFO = "color/image_raw", "aligned_depth_to_color/image_raw", "aligned_depth_to_color/camera_info"
#: So many pictures of a topic are read: the first colour and the depth that goes with it are among them.
PICTURES = 5
#: The tool's track and the tool as it was first seen belong together if they are so near each other (m).
NEAR = 0.10
#: A pose that came so long (s) before or after the pictures does not tell where the tool was in them.
APART = 0.5


class Recorded:
    """The messages of a bag that a demonstration is read from, by topic."""

    def __init__(self, path: Path) -> None:
        from magic_bringup import bag_file, bag_messages

        self.path = path
        self.topics = {topic.name for topic in bag_file.info(path).topics}
        self._messages: dict[str, list[Any]] = {topic: [] for topic in self.topics}

        def wanted(topic: str, type_name: str) -> bool:
            # Of the pictures the first are enough.
            return type_name != "sensor_msgs/msg/Image" or len(self._messages[topic]) < PICTURES

        for topic, _, message in bag_messages.messages(path, wanted):
            self._messages[topic].append(message)

    def of(self, topic: str) -> list[Any]:
        """The messages of a topic; NO_FRAMES where there are none."""
        found = self._messages.get(topic, [])
        if not found:
            raise MagicError(Code.NO_FRAMES, f"messages of {topic} in {self.path}", 0, f"one of the bag's topics: {sorted(self.topics)}")
        return found

    def transforms(self) -> tuple[Any, list[float]]:
        """All of /tf and /tf_static in a buffer, and the stamps (s) of what moves."""
        from magic_core.conversions import remember_transform, time_from_msg
        from magic_core.tf import TransformBuffer

        buffer, stamps = TransformBuffer(memory=float("inf")), []
        for topic in ("/tf_static", "/tf"):
            for message in self._messages.get(topic, []):
                for transform in message.transforms:
                    remember_transform(buffer, transform, topic == "/tf_static")
                    if topic == "/tf":
                        stamps.append(time_from_msg(transform.header.stamp))
        return buffer, sorted(set(stamps))


def frames_of(bag: Recorded, world: str) -> list[RgbdFrame]:
    """The first colour and depth image of each camera, with its pose in the world."""
    from magic_core import conversions

    buffer, _ = bag.transforms()
    cameras = sorted(m[1] for t in bag.topics if (m := re.fullmatch(rf"(.*)/{COLOR}", t)) and f"{m[1]}/{DEPTH}" in bag.topics)
    if not cameras:
        raise MagicError(Code.NO_FRAMES, f"cameras in {bag.path}", sorted(bag.topics), f"topics .../{COLOR} and .../{DEPTH}")
    frames = []
    for camera in cameras:
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


def track_of(bag: Recorded, world: str, topic: str, frame: str) -> tuple[Array, Array]:
    """Times (T,) in seconds and world_from_frame (T, 4, 4) of what is fixed to the tool: a frame of /tf, else the poses of a topic."""
    from magic_core import conversions

    buffer, stamps = bag.transforms()
    if frame:
        stamps, poses = _where_known(buffer, world, frame, stamps)
    else:
        messages = bag.of(topic)
        stamps = [conversions.time_from_msg(m.header.stamp) for m in messages]
        poses = [conversions.pose_from_msg(m.pose) for m in messages]
        away = {m.header.frame_id for m in messages} - {world}
        if away:
            poses = [buffer.lookup(world, m.header.frame_id, s) @ p for m, s, p in zip(messages, stamps, poses, strict=True)]
    times, first = np.unique(stamps, return_index=True)
    if len(times) < 2:
        raise MagicError(Code.BAD_MOTION, "poses of the tool", len(times), "two or more at different times")
    return times, np.stack([poses[k] for k in first])


def _where_known(buffer: Any, world: str, frame: str, stamps: list[float]) -> tuple[list[float], list[Array]]:
    """The stamps at which the frame's pose in the world is known, and the poses: a marker may be hidden for a while."""
    if frame not in buffer.frames():
        raise MagicError(Code.NO_TRANSFORM, "frame of the tool", frame, buffer.frames())
    found, why = [], None
    for stamp in stamps:
        try:
            found.append((stamp, buffer.lookup(world, frame, stamp)))
        except MagicError as error:
            why = error
    if not found and why is not None:
        raise why
    return [stamp for stamp, _ in found], [pose for _, pose in found]


def choose(scene: Scene, tool: str, target: str, origin: Array) -> tuple[SceneObject, SceneObject]:
    """Tool and target by id; where none is given, the object that a camera sees nearest to where the tool's track begins (3,), and
    the only other thing that a camera sees, or else the only known one."""
    by_id = {item.id: item for item in scene.objects}
    for what, name in (("tool", tool), ("target", target)):
        if name and name not in by_id:
            raise MagicError(Code.UNKNOWN_OBJECT, what, name, list(by_id))
    seen = [item for item in scene.objects if item.source == "camera"]
    if not tool:
        if not seen:
            raise MagicError(Code.NO_OBJECTS, "objects that the cameras see", 0, "the tool and the target on the table, apart")
        away = {
            item.id: float(np.linalg.norm(transforms.apply(item.world_from_object, item.mesh.vertices) - origin, axis=1).min())
            for item in seen
        }
        tool = min(away, key=lambda name: away[name])
        if away[tool] > NEAR:
            raise MagicError(
                Code.BAD_REQUEST,
                "distance of the tool's track from the nearest object",
                f"{away[tool]:.3f} m to {tool}",
                f"at most {NEAR:g} m, or name the tool: {sorted(away)}",
            )
    if not target:
        others = [item for item in seen if item.id != tool] or [item for item in scene.objects if item.id != tool]
        if len(others) != 1:
            raise MagicError(Code.BAD_REQUEST, "target", "not given", [item.id for item in others])
        target = others[0].id
    return by_id[tool], by_id[target]


def main(arguments: list[str] | None = None) -> int:
    """The command; errors are one line on stderr and exit status 2, a strategy that does not do its own task 1."""
    parser = argparse.ArgumentParser(prog="learn", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bag", type=Path, required=True, help="the recorded demonstration")
    parser.add_argument("--out", type=Path, required=True, help="the new strategy's folder; its name is the strategy's")
    parser.add_argument("--goal", required=True, help="goal test (hook, hang, scoop), or 'none': simulation cannot judge it")
    parser.add_argument("--value", nargs="*", default=[], metavar="NAME=NUMBER", help="numbers of the goal test")
    parser.add_argument("--tool-pose", default="/demonstration/tool_pose", help="topic with the poses of a frame fixed to the tool")
    parser.add_argument("--tool-frame", default="", help="a frame of /tf fixed to the tool, instead")
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
    given = parser.parse_args(arguments)
    try:
        return _learn(given)
    except MagicError as error:
        print(f"learn: {error}", file=sys.stderr)
        return 2


def _learn(given: argparse.Namespace) -> int:
    import cv2

    from magic_core import conversions
    from magic_matcher import drawing
    from magic_perception.pipeline import perceive
    from magic_verifier import goals
    from magic_verifier.learning import Demonstration, Task, learn

    goal = Goal("none" if given.goal == "none" else given.goal, _values(given.value))
    if given.goal != "none" and given.goal not in goals.GOALS:
        raise MagicError(Code.UNKNOWN_GOAL, "goal test", given.goal, [*goals.GOALS, "none"])
    if given.out.exists() and any(given.out.iterdir()):
        raise MagicError(Code.BAD_REQUEST, "folder of the new strategy", str(given.out), "a new or an empty folder")
    bag = Recorded(given.bag)
    frames = frames_of(bag, given.world)
    known = conversions.scene_from_msg(bag.of("/known_objects")[-1]).objects if "/known_objects" in bag.topics else ()
    scene = perceive(frames, tuple(known))
    print(f"objects: {', '.join(item.id for item in scene.objects)}")
    times, poses = track_of(bag, given.world, given.tool_pose, given.tool_frame)
    seen = max(frame.stamp for frame in frames)
    if not times[0] - APART <= seen <= times[-1]:
        raise MagicError(
            Code.STALE_DATA,
            "the tool's track begins after the pictures, s",
            round(times[0] - seen, 2),
            f"at most {APART:g}, and ends after them",
        )
    first = transforms.interpolate(times, poses, [seen])[0]
    tool, target = choose(scene, given.tool, given.target, first[:3, 3])
    # What is tracked is fixed to the tool, wherever on it.
    later = times > seen
    times = np.concatenate([[seen], times[later]])
    world_from_tool = np.concatenate([[first], poses[later]]) @ (transforms.inverse(first) @ tool.world_from_object)
    fixed = given.fixed_target or target.source != "camera"
    print(f"tool: {tool.id}, target: {target.id}{' (fixed)' if fixed else ''}, {len(times)} poses over {times[-1] - times[0]:.1f} s")
    demonstration = Demonstration(
        tool, target, tuple(o for o in scene.objects if o.id not in (tool.id, target.id)), scene.table, times, world_from_tool
    )
    task = Task(
        given.out.resolve().name,
        goal,
        Physics(given.friction, given.tool_density, given.target_density, fixed),
        given.releases,
        given.view,
        given.mode,
        given.description,
        simulatable=given.goal != "none",
    )
    learned = learn(demonstration, task)
    strategy = replace(learned.strategy, environment={})
    save(strategy, given.out)
    views = [
        drawing.draw_match(view, contact)
        for view, contact in ((strategy.tool_view, strategy.tool_contact), (strategy.target_view, strategy.target_contact))
    ]
    cv2.imwrite(str(given.out / "contacts.png"), drawing.side_by_side(views, ("tool", "target"))[..., ::-1])
    print(
        f"mode {strategy.mode}, matched in the view {strategy.view}; contacts found by replay, {1000 * learned.tool_gap:.1f} mm from the tool's outline"
    )
    for waypoint in strategy.waypoints:
        print(f"  {waypoint.phase:9} {waypoint.name:12} " + " ".join(f"{1000 * x:7.1f}" for x in waypoint.offset) + " mm")
    print(f"strategy: {given.out}, picture: {given.out / 'contacts.png'}")
    if learned.verdict is None:
        print("not tried in simulation: it cannot judge this goal")
        return 0
    print(f"tried with the demonstrated objects: {learned.verdict.code.name}, {learned.verdict.message}")
    return 0 if learned.verdict.success else 1


def _values(texts: list[str]) -> dict[str, float]:
    values = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            raise MagicError(Code.BAD_REQUEST, "--value", text, "NAME=NUMBER") from None
    return values


if __name__ == "__main__":
    sys.exit(main())
