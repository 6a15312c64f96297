"""``learn``: from a recorded bag to a strategy folder that serves other tools."""

import contextlib
import io
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import scenes
from demonstrations import ring_pulling

pytest.importorskip("magic_perception.pipeline")
pytest.importorskip("magic_bags.bag_file")

from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from magic_core import conversions, transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.goal import words
from magic_core.motion import MotionPlan
from magic_core.scene import Scene
from magic_core.sensor import capture, looking_at, scene_raycaster
from magic_core.shapes import make
from magic_core.strategy import Goal, Physics, load
from magic_matcher.features import load as load_features
from magic_matcher.matching import Matcher
from magic_perception import following
from magic_perception.following import Followed
from magic_perception.pipeline import perceive
from magic_planner.object_motion import plan_tool_motion
from magic_verifier.learn import (
    COLOR,
    DEPTH,
    MOMENTS,
    Pictures,
    Recorded,
    all_shown,
    choose,
    followed,
    goal_of,
    left_first,
    main,
    track_of,
    write,
)
from magic_verifier.learning import Demonstration, Task, learn
from magic_verifier.verification import Proposal, verify_proposal

BAGS = Path(__file__).resolve().parents[2] / "bags"
STRATEGIES = BAGS.with_name("ros2_ws") / "src/magic_bringup/strategies"


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """The folder of a strategy learned from the recorded images and poses of the hooking demonstration, by the README's own command: the
    goal is found, and told in words."""
    folder = tmp_path_factory.mktemp("strategies") / "new" / "pulling"
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["--bag", str(BAGS / "hooking_demonstration"), "--out", str(folder)]) == 0
    for line in ("the target moved 2", "the tool encloses it", "the goal, as it was found:", "200 mm along the pull or more"):
        assert line in said.getvalue()
    assert [p.name for p in folder.parent.iterdir()] == ["pulling"], "nothing is left beside it"
    return folder


def test_a_recorded_demonstration_becomes_a_strategy(learned):
    strategy = load(learned)
    assert (strategy.name, strategy.view, strategy.mode) == ("pulling", "top", "plan")
    assert strategy.goal == load(STRATEGIES / "hooking").goal and strategy.target_outline == "outer"
    np.testing.assert_allclose(strategy.target_normal, [1, 0, 0], atol=0.05)
    assert strategy.tool_contact.concave
    assert (learned / "contacts.png").stat().st_size > 1000


@pytest.mark.parametrize(("family", "seed"), [("caliper", 1), ("scissors", 1)])
def test_what_was_learned_serves_a_tool_that_was_never_seen(learned, family, seed):
    strategy = load(learned)
    tool = make(family, seed)
    tool = tool.as_object("tool", transforms.make(translation=[0.45, -0.3, 0.0005 - tool.mesh.bounds[0, 2]]), "top")
    target = make("cylinder", 0, radius=0.025, half_height=0.025)
    target = target.as_object("target", transforms.make(translation=[0.7, 0.0, 0.025]), "top")
    candidates = Matcher(load_features("embedded", "")).match(strategy, [tool], target, 3).candidates
    verdicts = []
    for candidate in candidates:
        motion = plan_tool_motion(strategy, tool, target, candidate, "keep", scenes.TABLE)
        verdicts.append(verify_proposal(Proposal(strategy, tool, target, (), scenes.TABLE, MotionPlan("fg", motion))))
    assert any(v.success for v in verdicts), [v.message for v in verdicts]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--goal": "juggle"}, "UNKNOWN_GOAL"),
        ({"--goal": "nowhere/mine.yaml"}, "nowhere/mine.yaml: [Errno 2]"),
        ({"--bag": "nowhere"}, "BAD_BAG"),
        ({"--goal": "hang"}, "--releases"),
        ({"--goal": "none", "--value": "distance=0.1"}, "no numbers"),
        ({"--value": "distance=nan"}, "--value distance: nan (allowed: above 0 to 100)"),
        ({"--value": "distance=0"}, "--value distance: 0.0"),
        ({"--value": "height=0.2"}, "'height' (allowed: distance, drift"),
        ({"--friction": "-0.1"}, "friction coefficient: -0.1 (allowed: 0.01 to 5)"),
        ({"--friction": "nan"}, "friction coefficient: nan"),
        ({"--tool-density": "0"}, "density of the tool, kg/m^3: 0.0 (allowed: 5 to 25000)"),
        ({"--target-density": "inf"}, "density of the target"),
        ({"--tool-pose": "not a topic"}, "--tool-pose: 'not a topic'"),
        ({"--tool-pose": "/joint_states"}, "sensor_msgs/msg/JointState"),
        ({"--tool-frame": "hand", "--tool-pose": "/pose"}, "--tool-pose and --tool-frame: 'both'"),
        ({"--world": ""}, "--world: ''"),
        ({"--world": "map"}, "'map': 'not connected'"),
        ({"--tool": "object_1", "--target": "object_1"}, "two objects"),
        ({"--tool-pose": "/nobody"}, "/nobody"),
        ({"--tool-frame": "hand"}, "NO_TRANSFORM"),
        ({"--tool": "object_9"}, "UNKNOWN_OBJECT"),
        ({"--value": "far"}, "NAME=NUMBER"),
    ],
)
def test_what_cannot_be_learned_is_said_in_one_line(change, said, tmp_path, capsys):
    given = {"--bag": str(BAGS / "hooking_demonstration"), "--out": str(tmp_path / "new"), "--goal": "hook", **change}
    assert main([word for pair in given.items() for word in pair]) == 2
    error = capsys.readouterr().err
    assert said in error and error.startswith("learn: ") and error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_goal_of_ones_own_is_read_from_a_file(tmp_path):
    tree = "values: {far: 0.1}\ntest: {moved: {what: target, along: pull, by: far}, after: {phase: goal}}\n"
    for text in (tree, "goal:\n" + "".join(f"  {line}\n" for line in tree.splitlines())):
        (tmp_path / "mine.yaml").write_text(text)
        goal, _ = goal_of(SimpleNamespace(goal=str(tmp_path / "mine.yaml"), value=["far=0.2"]))
        assert words(goal) == ["at the end of the phase goal, the target has moved 200 mm along the pull or more"]
    with pytest.raises(MagicError, match="'distance'"):
        goal_of(SimpleNamespace(goal=str(tmp_path / "mine.yaml"), value=["distance=0.2"]))


def test_a_target_that_is_held_cannot_be_pulled(tmp_path, capsys):
    given = ["--bag", str(BAGS / "hooking_demonstration"), "--goal", "hook", "--fixed-target", "--out", str(tmp_path / "new")]
    assert main(given) == 2
    assert "a target that cannot move" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["two words", ".hidden", "file", "file/below"])
def test_a_folder_that_cannot_be_is_said_before_anything_is_read(name, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["--bag", "nowhere", "--goal", "hook", "--out", str(tmp_path / name)]) == 2
    assert "the new strategy" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_strategy_that_is_there_is_not_written_over(learned, capsys):
    before = (learned / "strategy.yaml").read_bytes()
    assert main(["--bag", "nowhere", "--out", str(learned), "--goal", "hook"]) == 2
    assert "empty folder" in capsys.readouterr().err
    with pytest.raises(OSError):
        write(load(learned), learned)
    assert (learned / "strategy.yaml").read_bytes() == before
    assert [p.name for p in learned.parent.iterdir()] == ["pulling"]


def test_a_strategy_that_cannot_be_read_again_is_not_written(learned, tmp_path):
    strategy = load(learned)
    with pytest.raises(MagicError) as error:
        write(replace(strategy, physics=replace(strategy.physics, friction=-1.0)), tmp_path / "new")
    assert error.value.code == Code.BAD_STRATEGY and not any(tmp_path.iterdir())


def test_a_trial_that_fails_says_what_to_change_and_leaves_no_strategy(tmp_path, capsys):
    # Asked for is more than was shown.
    given = ["--bag", str(BAGS / "hooking_demonstration"), "--goal", "hook", "--value", "distance=0.5", "--out", str(tmp_path / "far")]
    assert main([*given, "--keep-failed"]) == 1
    said = capsys.readouterr().out
    assert "not pulled far enough" in said and "needed: 500 mm" in said
    assert (found := re.search(r"--value distance=([0-9.]+)", said)) and 0.2 <= float(found[1]) < 0.3
    assert [p.name for p in tmp_path.iterdir()] == ["far.failed"]
    assert load(tmp_path / "far.failed").description.startswith("FAILED ITS OWN TRIAL (GOAL_NOT_REACHED")
    assert main([*given, "--keep-failed"]) == 2, "nor is what failed written over"


def pose_message(stamp, frame, pose):
    header = conversions.header(frame, stamp)
    return SimpleNamespace(header=header, pose=conversions.pose_to_msg(pose))


class FakeBag:
    """A bag of a marker seen by a camera: as poses in the camera's frame, and as a frame of /tf beside a faster one."""

    path = Path("fake")
    types: ClassVar = {"/poses": "geometry_msgs/msg/PoseStamped"}

    def __init__(self):
        self.world_from_camera = transforms.from_rpy(0.1, 0.2, 0.3, [1, 2, 3])
        self.stamps = 1.0 + 0.05 * np.arange(41)
        self.poses = [transforms.from_rpy(0, 0, 0.1 * s, [0.2 * s, 0, 0.1]) for s in self.stamps]
        self.skipped: set[int] = set()
        self.bad: set[int] = set()

    def kept(self):
        return [k for k in range(len(self.stamps)) if k not in self.skipped]

    def _tf(self):
        def message(parent, child, pose, stamp):
            result = TransformStamped(header=conversions.header(parent, stamp), child_frame_id=child)
            result.transform = conversions.transform_to_msg(pose)
            return result

        static = [message("base", "camera", self.world_from_camera, 0.0)]
        tags = [message("camera", "tag", self.poses[k], self.stamps[k]) for k in self.kept()]
        for k in self.bad:
            tags[k].transform.rotation.w = 7.0
        other = [message("base", "other", np.eye(4), 1.0 + 0.01 * k) for k in range(201)]
        other[7].transform.rotation.w = 0.0
        return {"/tf_static": [TFMessage(transforms=static)], "/tf": [TFMessage(transforms=[t]) for t in [*tags, *other]]}

    def transforms(self):
        return Recorded.transforms(SimpleNamespace(_messages=self._tf()))

    def of(self, topic):
        return [pose_message(self.stamps[k], "camera", self.poses[k]) for k in self.kept()]


@pytest.mark.parametrize("frame", ["", "tag"])
def test_the_track_is_in_the_world_whether_it_comes_as_poses_or_as_a_frame(frame):
    bag = FakeBag()
    times, poses = track_of(bag, "base", "/poses", frame)
    np.testing.assert_allclose(times, bag.stamps)
    np.testing.assert_allclose(poses, [bag.world_from_camera @ p for p in bag.poses], atol=1e-9)


@pytest.mark.parametrize("frame", ["", "tag"])
def test_a_marker_that_was_hidden_is_refused_though_other_frames_go_on(frame):
    bag = FakeBag()
    bag.skipped = set(range(20, 27))
    with pytest.raises(MagicError, match=r"gap in .* from 0.95 to 1.35 s: '0.40 s' \(allowed: at most 0.25 s"):
        track_of(bag, "base", "/poses", frame)
    track_of(bag, "base", "/poses", frame, since=bag.stamps[30])


def test_a_frame_whose_orientation_is_none_is_refused_and_anothers_is_not_asked_for():
    bag = FakeBag()
    bag.bad = {5}
    with pytest.raises(MagicError, match=r"length of the orientation's quaternion of frame tag, 0.25 s"):
        track_of(bag, "base", "/poses", "tag")
    with pytest.raises(MagicError, match="never moves"):
        track_of(bag, "base", "/poses", "camera")


def scene_of(*places, known=()):
    cube = scenes.block((-0.025, 0.025), (-0.025, 0.025), (-0.025, 0.025))
    objects = [replace(scenes.item(name, [cube], transforms.make(translation=[x, 0, 0.025])), source="camera") for name, x in places]
    return Scene((*objects, *known), np.array([0, 0, 1.0, 0]), 0.0)


def test_tool_and_target_are_found_by_the_track():
    scene = scene_of(("object_1", 0.3), ("object_2", 0.6))
    tool, target = choose(scene, "", "", np.array([0.62, 0.05, 0.03]))
    assert (tool.id, target.id) == ("object_2", "object_1")
    tool, target = choose(scene, "object_1", "", np.array([0.62, 0.05, 0.03]))
    assert (tool.id, target.id) == ("object_1", "object_2")


def test_what_is_not_clear_is_asked_for():
    with pytest.raises(MagicError) as error:
        choose(scene_of(("object_1", 0.3), ("object_2", 0.6)), "", "", np.array([0.45, 0.3, 0.0]))
    assert error.value.code == Code.BAD_REQUEST and "name the tool" in error.value.message
    with pytest.raises(MagicError) as error:
        choose(scene_of(("object_1", 0.3), ("object_2", 0.6), ("object_3", 0.9)), "", "", np.array([0.3, 0.0, 0.0]))
    assert "target" in error.value.message and "object_3" in error.value.message
    with pytest.raises(MagicError, match=r"distance of the tool's track from object_1: '0.4"):
        choose(scene_of(("object_1", 0.3), ("object_2", 0.6)), "object_1", "", np.array([0.3, 0.5, 0.0]))
    with pytest.raises(MagicError) as error:
        choose(scene_of(), "", "", np.zeros(3))
    assert error.value.code == Code.NO_OBJECTS


TINY = Intrinsics(106, 60, 76.9, 76.9, 53.0, 30.0)
STATION = {"left": looking_at([0.94, 0.42, 0.66], [0.52, 0.0, 0.04]), "right": looking_at([0.94, -0.42, 0.66], [0.52, 0.0, 0.04])}


def test_the_tool_is_what_leaves_its_place_first():
    scene = scene_of(("object_1", 0.4), ("object_2", 0.6))
    meshes = {item.id: item.mesh.transformed(item.world_from_object) for item in scene.objects}
    there = {0.0: ("object_1", "object_2"), 1.0: ("object_1", "object_2"), 2.0: ("object_1",), 3.0: ()}
    frames = [
        capture(
            [meshes[name] for name in names], Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0), pose, [1, n], camera=camera, stamp=stamp
        )
        for stamp, names in there.items()
        for n, (camera, pose) in enumerate(STATION.items())
    ]
    assert left_first(scene, frames[::-1]) == "object_2"  # in whatever order they come
    with pytest.raises(MagicError, match="nothing leaves its place"):
        left_first(scene, frames[:4])


def test_every_picture_finds_its_depth_and_its_place_in_time(tmp_path):
    """Two cameras that are not in step; of one the colour comes last, and one picture never gets its depth."""
    from magic_bags.recording import Recording

    caster = scene_raycaster([])
    frames = [
        capture([], TINY, pose, [k, n], camera=name, stamp=100.0 + 0.1 * k + 0.033 * n, raycaster=caster)
        for k in range(8)
        for n, (name, pose) in enumerate(STATION.items())
    ]
    with Recording(tmp_path / "bag") as bag:
        bag.cameras(frames[:2], 99.9)
        for index, frame in enumerate(frames):
            messages = list(conversions.frame_to_msgs(frame).items())
            for topic, message in messages[:: -1 if frame.camera == "left" else 1]:
                if index != 5 or "depth" not in topic or "info" in topic:
                    bag.write(f"/camera/{frame.camera}/{topic}", message, frame.stamp)
    pictures = Pictures(Recorded(tmp_path / "bag"), "panda_link0")
    found = list(pictures)
    assert [frame.stamp for frame in pictures] == [frame.stamp for frame in found]  # as often as they are asked for
    wanted = [frame for index, frame in enumerate(frames) if index != 5]
    assert [(f.camera, round(f.stamp, 3)) for f in found] == [(f"/camera/{f.camera}", round(f.stamp, 3)) for f in wanted]
    for read, written in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(read.color, written.color)
        np.testing.assert_allclose(read.depth, written.depth, atol=1e-6)
        np.testing.assert_allclose(read.world_from_camera, written.world_from_camera, atol=1e-6)


def test_a_tool_that_was_followed_is_what_all_pictures_showed_of_it(monkeypatch):
    first = ring_pulling().tool
    mended = [mesh.scaled(1.02) for mesh in (first.mesh, *first.pieces)]
    times = np.arange(0.0, 2.0, 0.1)
    poses = np.stack([first.world_from_object @ transforms.make(translation=[0.02 * t, 0, 0.05 * t]) for t in times])
    surface = SimpleNamespace(mended=lambda pieces: (mended[0], tuple(mended[1:])) if pieces is first.pieces else None)
    monkeypatch.setattr(following, "follow", lambda *seen: Followed(times, poses, 0.001 + 0 * times, 0.01 + 0 * times, 20, surface))
    tool = followed(SimpleNamespace(), "panda_link0", first, Scene((first,), scenes.TABLE))[2]
    assert [tool.mesh, *tool.pieces] == mended and tool.id == first.id


@pytest.mark.parametrize(("pictures", "shown", "is_mended"), [(MOMENTS - 1, None, False), (20, MOMENTS - 1, False), (20, MOMENTS, True)])
def test_a_tool_that_something_else_tracked_is_what_enough_pictures_show_of_it(pictures, shown, is_mended, monkeypatch):
    first = ring_pulling().tool
    mended = [mesh.scaled(1.02) for mesh in (first.mesh, *first.pieces)]
    surface = SimpleNamespace(mended=lambda pieces: (mended[0], tuple(mended[1:])))
    monkeypatch.setattr(following, "reshaped_along", lambda *seen: (surface, shown))
    topics = [f"/camera/left/{kind}" for kind in (COLOR, DEPTH)]
    bag = SimpleNamespace(topics=set(topics), counts=dict.fromkeys(topics, pictures))
    tool = all_shown(bag, "panda_link0", first, Scene((first,), scenes.TABLE), np.arange(2.0), np.stack([first.world_from_object] * 2))
    assert [tool.mesh, *tool.pieces] == (mended if is_mended else [first.mesh, *first.pieces])


def test_a_ring_that_the_cameras_see_is_pulled_by_its_inside():
    shown = ring_pulling()
    cameras = STATION
    caster = scene_raycaster([item.mesh.transformed(item.world_from_object) for item in (shown.tool, shown.target)])
    small = Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)
    frames = [capture([], small, pose, [3, n], camera=name, raycaster=caster) for n, (name, pose) in enumerate(cameras.items())]
    scene = perceive(frames)
    tool, target = choose(scene, "", "", shown.tool.world_from_object[:3, 3])
    moved = shown.world_from_tool @ (transforms.inverse(shown.tool.world_from_object) @ tool.world_from_object)
    seen = Demonstration(tool, target, (), scene.table, shown.times, moved)
    found = learn(seen, Task("ring", Goal("hook", {"noise": 0.0}), Physics(0.3)))
    assert found.strategy.target_outline == "cut"
    # Led 3 mm above the table it passes as shown; whether in most of the rollouts too is another question than where the contact is.
    assert found.verdict.success or found.verdict.message.startswith("passes in the scene as given"), found.verdict.message
    contact = target.world_from_object @ found.strategy.target_contact.object_from_contact
    np.testing.assert_allclose(contact[:2, 3], [0.6 - 0.034, 0.0], atol=0.005)
    np.testing.assert_allclose(contact[:3, 0], [1, 0, 0], atol=0.05)
