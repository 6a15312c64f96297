"""Several views of one scene: what one misses another fills, what the robot hides is remembered, what has moved is not smeared."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.mesh import Mesh
from magic_core.scene import PICTURE, UNSEEN, Scene
from magic_core.sensor import SMEARED, STATION, capture, looking_at
from magic_core.shapes import make
from magic_perception import coverage, evaluate
from magic_perception.coverage import REGION, WRIST, compared, views
from magic_perception.keyframes import Keyframes
from magic_perception.pipeline import Report, perceive
from magic_perception.tracking import Tracker


def placed(family, seed, x, y, yaw=0.0, **parameters):
    mesh = make(family, seed, **parameters).mesh
    return mesh.transformed(transforms.from_rpy(0, 0, yaw, [x, y, -mesh.bounds[0, 2]]))


class Watcher:
    """Perception with its memory, as the node has it."""

    def __init__(self, **memory):
        self.keyframes, self.tracker = Keyframes(**memory), Tracker()

    def look(self, frames, still=("left", "right", "wrist")):
        report = Report()
        earlier = self.keyframes.useful(frames)
        scene = perceive(frames, (), REGION, None, report, earlier)
        numbers = [report.numbers[item.id] for item in scene.objects]
        scene = self.tracker.update(scene)
        carried = [n for n, item in zip(numbers, scene.objects, strict=True) if self.tracker.carried(item)]
        self.keyframes.update(frames, report.labels, report.earlier, still, carried)
        return scene, earlier, report


def only(scene, at, within=0.06):
    """The one object whose box is centred there."""
    found = [o for o in scene.objects if np.linalg.norm(o.world_from_box[:2, 3] - at) < within]
    assert len(found) == 1, [o.world_from_box[:3, 3] for o in scene.objects]
    return found[0]


def hidden(frame: RgbdFrame, mesh: Mesh, wider: int = 25, share: float = 1.0) -> RgbdFrame:
    """The frame with something blind before a thing; share < 1: before its left part only."""
    import cv2

    pixels = frame.intrinsics.project(transforms.apply(transforms.inverse(frame.world_from_camera), mesh.vertices))
    low, high = pixels.min(axis=0) - wider, pixels.max(axis=0) + wider
    high[0] = low[0] + share * (high[0] - low[0])
    blind = np.zeros(frame.depth.shape, np.uint8)
    cv2.rectangle(blind, *(tuple(int(x) for x in corner) for corner in (low, high)), 1, -1)
    return frame.blinded(blind > 0)


MUG = (0.52, -0.15)


@pytest.fixture(scope="module")
def table():
    """A mug whose handle points away from the left camera, and two more things; frames of both fixed cameras and three of the wrist's."""
    meshes = [placed("mug", 1, *MUG, yaw=-2.2), placed("caliper", 4, 0.45, 0.15, 0.5), placed("cylinder", 9, 0.70, 0.05, radius=0.03)]
    return meshes, views(meshes, {**STATION, **{f"wrist{i}": pose for i, pose in enumerate(WRIST)}}, 1.0, 0)


def test_more_views_show_more_and_worsen_nothing(table):
    meshes, frames = table
    told = []
    for now, earlier in ((1, 0), (2, 0), (2, 3)):
        scene = perceive(frames[:now], (), REGION, None, None, [replace(f, stamp=0.5) for f in frames[2 : 2 + earlier]])
        assert len(scene.objects) == 3
        found = [only(scene, mesh.bounds[:, :2].mean(axis=0)) for mesh in meshes]
        told.append([(o.seen_share, *compared(o, mesh)) for o, mesh in zip(found, meshes, strict=True)])
    one, two, five = np.array(told).transpose(0, 2, 1)
    assert np.all(one[0] < two[0]) and np.all(two[0] < five[0] - 0.1)  # what was seen
    assert one[1].mean() < two[1].mean() < five[1].mean() and five[1].min() > 0.97  # what of the true surface is there
    assert five[2].max() < 0.003  # m beside it


@pytest.mark.parametrize("distance", [0.010, 0.25])
def test_what_has_moved_is_not_smeared_over_where_it_was(table, distance):
    meshes, frames = table
    watcher = Watcher()
    before, _, _ = watcher.look([*frames[:2], replace(frames[2], camera="wrist")])
    moved = [meshes[0].transformed(transforms.make(translation=[0.6 * distance, -0.8 * distance, 0])), *meshes[1:]]
    scene, earlier, report = watcher.look(views(moved, STATION, 2.0, 1))
    assert [f.camera for f in earlier] == ["wrist"]
    assert len(scene.objects) == 3
    mug = only(scene, moved[0].bounds[:, :2].mean(axis=0))
    _, error = compared(mug, moved[0])
    assert error < 0.0035
    np.testing.assert_allclose(mug.box_extents.max(), only(before, MUG).box_extents.max(), atol=0.008)
    ((old, new),) = report.earlier
    for mesh, stays in zip(meshes, (False, True, True), strict=True):
        u, v = np.rint(
            old.intrinsics.project(transforms.apply(transforms.inverse(old.world_from_camera), mesh.vertices.mean(axis=0)))
        ).astype(int)
        assert new.blind[v, u] != stays
    for mesh in meshes[1:]:
        middle = mesh.bounds[:, :2].mean(axis=0)
        assert only(scene, middle).id == only(before, middle).id


def test_what_the_hand_hides_is_remembered_until_it_is_seen_to_be_gone(table):
    meshes, frames = table
    watcher = Watcher()
    first, _, _ = watcher.look(frames[:2])
    mug = only(first, MUG)
    # Wholly hidden in both pictures: as it was, under its id, and marked.
    scene, _, report = watcher.look([replace(hidden(f, meshes[0]), stamp=2.0) for f in views(meshes, STATION, 2.0, 1)])
    now = only(scene, MUG)
    assert now.id == mug.id and now.cut_off == (UNSEEN,) and [o.cut_off for o in scene.objects if o is not now] == [(), ()]
    np.testing.assert_allclose(now.box_extents, mug.box_extents, atol=0.004)
    assert len(report.labels) == 2
    # In part: what is seen of it shows that it has not moved, so that it is whole.
    scene, _, _ = watcher.look([replace(hidden(f, meshes[0], 5, 0.5), stamp=3.0) for f in views(meshes, STATION, 3.0, 2)])
    now = only(scene, MUG)
    assert now.id == mug.id and now.cut_off == ()
    np.testing.assert_allclose(now.box_extents, mug.box_extents, atol=0.004)
    # Without the memory it is cut, or gone.
    alone = perceive([hidden(f, meshes[0]) for f in views(meshes, STATION, 3.0, 2)], (), REGION)
    assert len(alone.objects) == 2
    # The hand has taken it away.
    scene, _, _ = watcher.look(views(meshes[1:], STATION, 4.0, 3))
    assert len(scene.objects) == 2
    scene, _, _ = watcher.look([hidden(f, meshes[0]) for f in views(meshes[1:], STATION, 5.0, 4)])
    assert len(scene.objects) == 2


def test_what_the_border_cuts_is_completed_by_another_view(table):
    meshes, frames = table
    # A camera whose picture ends in the middle of the mug.
    pose = looking_at([0.94, 0.1, 0.6], [0.60, 0.20, 0.04])
    k = Intrinsics(460, 480, 615.0, 615.0, 320.0, 240.0)
    (frame,) = [capture(meshes, k, pose, 5, camera="wrist", stamp=2.0, model=SMEARED)]
    cut = perceive([frame], (), REGION)
    assert PICTURE in min(cut.objects, key=lambda o: np.linalg.norm(o.world_from_box[:2, 3] - MUG)).cut_off
    whole = perceive([frame], (), REGION, None, None, [frames[1]])
    mug = only(whole, MUG)
    assert mug.cut_off == () and compared(mug, meshes[0])[0] > 0.9


def test_memory_is_bounded_and_ends():
    k = Intrinsics(32, 24, 30.0, 30.0, 16.0, 12.0)
    image = np.ones((24, 32), np.int32)
    poses = [looking_at([0.5 + 0.3 * np.cos(a), -0.15 + 0.3 * np.sin(a), 0.45], [*MUG, 0.03]) for a in range(6)]
    frames = [
        RgbdFrame(np.zeros((24, 32, 3), np.uint8), np.full((24, 32), 0.5, np.float32), k, pose, "wrist", 1.0 + i)
        for i, pose in enumerate(poses)
    ]
    memory = Keyframes(limit=3, memory=10.0)
    for frame in frames:
        memory.update([frame], [image], [], {"wrist"})
    elsewhere = replace(frames[0], stamp=7.0, world_from_camera=STATION["left"])
    assert [f.stamp for f in memory.useful([elsewhere])] == [4.0, 5.0, 6.0]
    assert [f.stamp for f in memory.useful([frames[5]])] == [4.0, 5.0]  # the third is what is seen now
    memory.update([replace(frames[1], stamp=7.0)], [image], [], set())  # moving: not kept
    assert [f.stamp for f in memory.useful([replace(elsewhere, stamp=14.5)])] == [5.0, 6.0]
    # What a newer frame has shown to be otherwise is not kept, nor is a frame of which nothing is left.
    (old, other) = memory.useful([elsewhere])
    memory.update([], [], [(old, old.blinded(np.ones((24, 32), bool))), (other, other)], set())
    assert [f.stamp for f in memory.useful([elsewhere])] == [6.0]
    assert memory.useful([replace(elsewhere, stamp=1.0)]) == []  # a bag began again
    none = Keyframes(limit=0)
    none.update(frames[:1], [image], [], {"wrist"})
    assert none.useful([elsewhere]) == []


def test_what_the_robot_carries_is_not_remembered_where_it_was(table):
    """A mug in the hand, and where it was a moment ago hidden by the arm: nothing is there."""
    _, frames = table
    report, memory = Report(), Keyframes()
    scene = perceive(frames[:2], (), REGION, None, report)
    mug = report.numbers[only(scene, MUG).id]
    memory.update(frames[:2], report.labels, [], {"left", "right"}, [mug])
    blind = [replace(hidden(f, table[0][0], 12), stamp=2.0) for f in frames[:2]]
    assert len(perceive(blind, (), REGION, earlier=memory.useful(blind)).objects) == 2
    memory.update(frames[:2], report.labels, [], {"left", "right"})
    assert len(perceive(blind, (), REGION, earlier=memory.useful(blind)).objects) == 3


def test_what_hangs_or_comes_before_the_robot_is_carried(table):
    mug = only(perceive(table[1][:2], (), REGION), MUG)

    def item(x, **told):
        return replace(mug, world_from_object=transforms.make(translation=[x, 0.0, 0.1]), **told)

    tracker = Tracker()
    for stamp, x, told, carried in (
        (1.0, 0.5, {"cut_off": ("robot",)}, True),  # there was nothing before
        (2.0, 0.5, {"cut_off": ("robot",)}, False),
        (3.0, 0.56, {"cut_off": ("robot",)}, True),
        (4.0, 0.62, {}, False),
        (5.0, 0.62, {"hanging": True}, True),
    ):
        (found,) = tracker.update(Scene((item(x, **told),), np.array([0.0, 0.0, 1.0, 0.0]), stamp)).objects
        assert found.id == "object_1" and tracker.carried(found) == carried


def test_what_several_views_bring_is_measured(tmp_path, monkeypatch, capsys):
    """The command on one scene and one move, to its end and its files."""
    monkeypatch.setattr(coverage, "measure", partial(coverage.measure, moves=(0.02,)))
    with pytest.raises(SystemExit) as end:
        evaluate.main(["--views", "1", "--out", str(tmp_path)])
    assert end.value.code == 0
    told = json.loads((tmp_path / "evaluation.json").read_text())["views"]
    one, two, five = (told["surfaces"][n] for n in ("1", "2", "5"))
    assert one["things"] == five["things"] == 4 and five["found"] >= 3
    assert one["seen"] <= two["seen"] + 0.02 and two["seen"] < five["seen"]
    moved = told["moved"]["20"]
    assert moved["dropped"] == 1 and moved["of"] == 9 and moved["others_dropped"] <= 2
    assert "| 20 | 1 of 1 |" in (tmp_path / "evaluation.md").read_text()
    assert "scene 1 of 1" in capsys.readouterr().err
