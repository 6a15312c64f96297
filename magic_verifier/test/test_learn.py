"""``learn``: from a recorded bag to a strategy folder that serves other tools."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scenes

pytest.importorskip("magic_perception.pipeline")
pytest.importorskip("magic_bringup.bag_file")

from magic_core import conversions, transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.scene import Scene
from magic_core.shapes import make
from magic_core.strategy import load
from magic_matcher.features import load as load_features
from magic_matcher.matching import Matcher
from magic_planner.object_motion import plan_tool_motion
from magic_verifier.learn import choose, main, track_of
from magic_verifier.verification import verify

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """The folder of a strategy learned from the recorded images and poses of the hooking demonstration."""
    folder = tmp_path_factory.mktemp("strategies") / "pulling"
    given = ["--bag", str(BAGS / "hooking_demonstration"), "--out", str(folder), "--goal", "hook", "--friction", "0.3"]
    assert main([*given, "--value", "distance=0.2", "noise=0"]) == 0
    return folder


def test_a_recorded_demonstration_becomes_a_strategy(learned):
    strategy = load(learned)
    assert (strategy.name, strategy.view, strategy.mode) == ("pulling", "top", "plan")
    assert strategy.goal.values == {"distance": 0.2, "noise": 0.0} and strategy.physics.friction == 0.3
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
        verdicts.append(verify(strategy, tool, target, (), scenes.TABLE, candidate, MotionPlan("fg", motion)))
    assert any(v.success for v in verdicts), [v.message for v in verdicts]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--goal": "juggle"}, "UNKNOWN_GOAL"),
        ({"--bag": "nowhere"}, "BAD_BAG"),
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
    assert not (tmp_path / "new").exists()


def test_a_strategy_that_is_there_is_not_written_over(learned, capsys):
    assert main(["--bag", str(BAGS / "hooking_demonstration"), "--out", str(learned), "--goal", "hook"]) == 2
    assert "empty folder" in capsys.readouterr().err


def pose_message(stamp, frame, pose):
    header = conversions.header(frame, stamp)
    return SimpleNamespace(header=header, pose=conversions.pose_to_msg(pose))


class FakeBag:
    """A bag with a moving /tf and poses in a camera's frame."""

    path = Path("fake")

    def __init__(self):
        from magic_core.tf import TransformBuffer

        self.buffer = TransformBuffer(memory=float("inf"))
        self.world_from_camera = transforms.from_rpy(0.1, 0.2, 0.3, [1, 2, 3])
        self.buffer.set("base", "camera", self.world_from_camera, static=True)
        self.stamps = [1.0, 1.5, 2.0]
        self.poses = [transforms.from_rpy(0, 0, 0.1 * s, [s, 0, 0]) for s in self.stamps]
        for stamp, pose in zip(self.stamps, self.poses, strict=True):
            self.buffer.set("camera", "tag", pose, stamp)

    def transforms(self):
        return self.buffer, self.stamps

    def of(self, topic):
        # Out of order, and one twice.
        return [pose_message(s, "camera", p) for s, p in [*zip(self.stamps, self.poses, strict=True)][::-1]] + [
            pose_message(self.stamps[0], "camera", self.poses[0])
        ]


@pytest.mark.parametrize("frame", ["", "tag"])
def test_the_track_is_in_the_world_whether_it_comes_as_poses_or_as_a_frame(frame):
    bag = FakeBag()
    times, poses = track_of(bag, "base", "/poses", frame)
    np.testing.assert_allclose(times, bag.stamps)
    np.testing.assert_allclose(poses, [bag.world_from_camera @ p for p in bag.poses], atol=1e-9)


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
    with pytest.raises(MagicError) as error:
        choose(scene_of(), "", "", np.zeros(3))
    assert error.value.code == Code.NO_OBJECTS
