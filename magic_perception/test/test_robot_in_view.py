"""The arm in the picture is neither thing nor free space, what it hides keeps together, and what hangs is told from what stands."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from magic_core import transforms
from magic_core.camera import NEARLY, SURELY, Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.robot import Description
from magic_core.robot_pictures import RobotPictures
from magic_core.sensor import D435, capture, looking_at, scene_raycaster
from magic_core.shapes import make
from magic_perception.averaging import average, unchanged
from magic_perception.hidden import ROBOT, parted
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.robot_in_view import Held, RobotInView

CAMERAS = {"left": looking_at([0.94, 0.42, 0.66], [0.52, 0.0, 0.04]), "right": looking_at([0.94, -0.42, 0.66], [0.52, 0.0, 0.04])}
OVER_THE_TABLE = np.array([0.0, 0.35, 0.0, -2.1, 0.0, 2.45, np.pi / 4, 0.04, 0.04])
REGION = Parameters(region_low=(0.15, -0.6, -0.05), region_high=(0.95, 0.6, 0.5))


@pytest.fixture(scope="module")
def panda():
    robot = Description()
    return robot, RobotPictures(robot)


def placed(family, seed, x, y, yaw=0.0, **parameters):
    mesh = make(family, seed, **parameters).mesh
    return mesh.transformed(transforms.from_rpy(0, 0, yaw, [x, y, -mesh.bounds[0, 2]]))


def seen(meshes, seed=0, stamp=10.0):
    """Frames of both cameras."""
    caster = scene_raycaster(meshes)
    return [
        capture([], D435, pose, [seed, i], camera=name, stamp=stamp, raycaster=caster) for i, (name, pose) in enumerate(CAMERAS.items())
    ]


def told(robot, joints, at=10.0, **settings):
    """The filter, told of joint positions at a stamp."""
    view = RobotInView(robot, **settings)
    positions = robot.arm_positions(joints)
    view.history.take(list(positions), list(positions.values()), at)
    return view


def things():
    return [
        placed("caliper", 4, 0.44, -0.22, 0.5, beam=0.26, opening=0.105, jaw=0.07, width=0.022, thickness=0.018),
        placed("cylinder", 9, 0.70, 0.0, radius=0.03),
    ]


def middles(scene):
    return np.array(sorted((o.world_from_box[:2, 3].tolist() for o in scene.objects), key=lambda c: c[1]))


def test_the_arm_alone_is_nothing(panda):
    robot, pictures = panda
    view = told(robot, OVER_THE_TABLE)
    scene = perceive([view.cut(frame) for frame in seen(pictures.at(OVER_THE_TABLE))], (), REGION)
    assert scene.objects == ()


def test_things_under_an_arm_are_those_without_it(panda):
    robot, pictures = panda
    view = told(robot, OVER_THE_TABLE)
    with_arm = perceive([view.cut(frame) for frame in seen([*things(), *pictures.at(OVER_THE_TABLE)])], (), REGION)
    without = perceive(seen(things()), (), REGION)
    assert len(with_arm.objects) == len(without.objects) == 2
    np.testing.assert_allclose(middles(with_arm), middles(without), atol=0.005)


def test_an_arm_that_is_not_cut_hangs(panda):
    """Without joint states hand, arm and fingers are seen; they are told from what stands."""
    _, pictures = panda
    report = Report()
    scene = perceive(seen([*things(), *pictures.at(OVER_THE_TABLE)]), (), REGION, report=report)
    standing = [o for o in scene.objects if not o.hanging]
    assert len(standing) == 2 and len(scene.objects) > 2
    np.testing.assert_allclose(
        np.sort([o.world_from_box[1, 3] for o in standing]), np.sort(middles(perceive(seen(things()), (), REGION))[:, 1]), atol=0.005
    )
    assert any("hang" in note for note in report.notes)


def test_what_stands_or_hangs_on_a_fixture_does_not_hang():
    """A mug on its foot, a watch as an arch; a ball on a calibrated post, and the same ball in the air."""
    standing = [placed("mug", 3, 0.5, -0.3, 1.2), placed("watch", 2, 0.42, 0.24, 2.4)]
    scene = perceive(seen(standing), (), REGION)
    assert len(scene.objects) == 2 and not any(o.hanging for o in scene.objects)
    post = make("cylinder", 1, radius=0.015, half_height=0.1).as_object("post", transforms.make(translation=[0.5, 0.0, 0.1]))
    ball = make("sphere", 0, radius=0.03).mesh.transformed(transforms.make(translation=[0.5, 0.0, 0.23]))
    on_it = perceive(seen([post.mesh.transformed(post.world_from_object), ball]), (post,), REGION)
    floating = perceive(seen([ball]), (), REGION)
    assert [o.hanging for o in on_it.objects if o.source == "camera"] == [False]
    assert [o.hanging for o in floating.objects] == [True]
    # Where it is, is told as it was seen.
    np.testing.assert_allclose(floating.objects[0].world_from_box[:3, 3], [0.5, 0.0, 0.23], atol=0.012)


def test_what_is_on_its_way_does_not_set_the_cameras_against_each_other(monkeypatch):
    """Two pictures of two moments, between which a carried box has moved by 30 mm; what stands tells that the cameras agree."""
    import trimesh

    def carried(x):
        box = trimesh.creation.box(extents=(0.09, 0.07, 0.05))
        return Mesh(box.vertices + [x, 0.0, 0.25], box.faces).painted((200, 60, 60))

    standing = placed("cylinder", 9, 0.45, -0.2, radius=0.03)
    pictures = [seen([standing, carried(0.50)])[0], seen([standing, carried(0.53)])[1]]
    scene = perceive(pictures, (), REGION)
    assert not scene.camera_offset > 0.006
    np.testing.assert_allclose([o.world_from_box[:2, 3] for o in scene.objects if not o.hanging], [[0.45, -0.2]], atol=0.005)
    monkeypatch.setattr("magic_perception.pipeline._at_rest", lambda labels, _hanging: labels)
    assert perceive(pictures, (), REGION).camera_offset > 0.02


def across(frame, start, end, width):
    """The frame, blind in a stripe between two places of the table."""
    camera = transforms.inverse(frame.world_from_camera)
    (u0, v0), (u1, v1) = frame.intrinsics.project(transforms.apply(camera, [start, end]))
    stripe = np.zeros(frame.depth.shape, np.uint8)
    cv2.line(stripe, (round(u0), round(v0)), (round(u1), round(v1)), 1, width)
    return frame.blinded(stripe.astype(bool))


def test_a_thing_on_both_sides_of_what_hides_it_is_one():
    bar = make("cylinder", 1, radius=0.012, half_height=0.15).mesh.transformed(transforms.from_rpy(0, np.pi / 2, 0, [0.5, 0.1, 0.012]))
    frames = [across(f, [0.5, -0.2, 0.0], [0.5, 0.4, 0.0], 60) for f in seen([bar])]
    report = Report()
    scene = perceive(frames, (), REGION, report=report)
    assert len(scene.objects) == 1
    assert scene.objects[0].box_extents.max() == pytest.approx(0.30, abs=0.03)
    assert scene.objects[0].cut_off == ("robot",)
    assert all((image[frame.blind] == ROBOT).all() for image, frame in zip(report.labels, frames, strict=True))


def test_two_things_beside_each_other_stay_two_where_a_camera_sees_between():
    pair = [
        placed("cylinder", 1, 0.45, 0.1, radius=0.02, half_height=0.02),
        placed("cylinder", 1, 0.58, 0.1, radius=0.02, half_height=0.02),
    ]
    left, right = seen(pair)
    assert len(perceive([across(left, [0.515, -0.2, 0.0], [0.515, 0.4, 0.0], 70), right], (), REGION).objects) == 2


def test_what_is_blind_in_the_last_frame_is_blind_in_the_mean():
    frames = seen(things())[:1] * 3
    stripe = np.zeros(frames[0].depth.shape, bool)
    stripe[:, 100:150] = True
    mean = average([*frames[:2], frames[2].blinded(stripe)])
    assert (mean.blind == stripe).all() and np.isnan(mean.depth[stripe]).all()
    assert average(frames).blind is None


def test_fingers_that_nothing_is_told_of_may_be_anywhere(panda):
    robot, _ = panda
    view = RobotInView(robot)
    view.history.take(robot.names, OVER_THE_TABLE[:7].tolist(), 10.0)
    widths = {(s["panda_finger_joint1"], s["panda_finger_joint2"]) for s in view.states(10.0)}
    assert widths == {(0.0, 0.0), (0.02, 0.02), (0.04, 0.04)}
    view.history.take(["panda_finger_joint1"], [0.03], 10.0)
    assert {s["panda_finger_joint2"] for s in view.states(10.0)} == {0.03}


def test_where_the_joints_are_not_known_is_told(panda):
    robot, _ = panda
    frame = seen([])[0]
    with pytest.raises(MagicError) as nothing:
        RobotInView(robot).cut(frame)
    assert nothing.value.code == Code.NO_FRAMES
    with pytest.raises(MagicError) as stale:
        told(robot, OVER_THE_TABLE, at=9.0).cut(frame)
    assert stale.value.code == Code.STALE_DATA and "1.0" in stale.value.message
    with pytest.raises(MagicError) as absent:
        told(robot, OVER_THE_TABLE).cut(frame)
    assert absent.value.code == Code.ROBOT_NOT_THERE


def off(frames, *by):
    """The frames of cameras that are said to stand elsewhere, all by the same."""
    return [replace(frame, world_from_camera=transforms.make(translation=by) @ frame.world_from_camera) for frame in frames]


@pytest.mark.parametrize("joints", [OVER_THE_TABLE, np.array([0.3, -0.6, 0.1, -2.2, 0.2, 1.7, 0.9, 0.02, 0.02])])
def test_cameras_are_measured_against_the_arm(panda, joints):
    """Two cameras that agree are off the arm: what is seen of it says by how much, and a scene that would be grasped beside is refused."""
    robot, pictures = panda
    frames = seen([*things(), *pictures.at(joints)])
    view = told(robot, joints)
    for right in (view.cut(frame) for frame in frames):
        assert np.linalg.norm(right.arm.offset) < 0.004 and right.arm.error < 0.006
    assert set(view.offsets()) == set(CAMERAS) and max(view.offsets().values()) < 0.004
    report = Report()
    perceive([told(robot, joints).cut(frame) for frame in frames], (), REGION, None, report)
    assert not [note for note in report.notes if "sees the arm" in note]

    by = np.array([0.012, -0.009, 0.0])
    near = [told(robot, joints).cut(frame) for frame in off(frames, *by)]
    for frame in near:
        np.testing.assert_allclose(frame.arm.offset, -by, atol=0.004)
    there = perceive([told(robot, joints).cut(frame) for frame in frames], (), REGION)
    moved = perceive(near, (), REGION, None, report)
    assert any("sees the arm" in note and "is moved" in note for note in report.notes)
    assert np.abs(middles(moved) - middles(there)).max() < 0.004
    left = perceive(near, (), replace(REGION, arm_offset=0.0))
    assert np.abs(middles(left) - middles(there)).max() > 0.009

    far = [told(robot, joints).cut(frame) for frame in off(frames, 0.0, 0.03, 0.0)]
    with pytest.raises(MagicError) as error:
        perceive(far, (), REGION)
    assert error.value.code is Code.ROBOT_ELSEWHERE and "15 mm" in error.value.message
    perceive(far, (), replace(REGION, arm_offset=0.0))


def test_cameras_that_see_the_arm_at_two_places_are_not_believed(panda):
    """One of them, of cameras that agree on the table, took something else for it."""
    robot, pictures = panda
    left, right = (told(robot, OVER_THE_TABLE).cut(frame) for frame in seen([*things(), *pictures.at(OVER_THE_TABLE)]))
    wrong = replace(right, arm=replace(right.arm, offset=right.arm.offset + (0.0, 0.03, 0.0)))
    report = Report()
    scene = perceive([left, wrong], (), REGION, None, report)
    assert any("does not agree" in note for note in report.notes)
    assert np.abs(middles(scene) - middles(perceive([left, right], (), REGION))).max() < 0.001


def test_a_table_that_is_put_right_counts_in_where_the_arm_is_seen(panda):
    """Cameras 6 mm too high see table and arm too high; with the table where it is, the arm is too."""
    robot, pictures = panda
    report = Report()
    frames = off(seen([*things(), *pictures.at(OVER_THE_TABLE)]), 0.0, 0.0, 0.006)
    cut = [told(robot, OVER_THE_TABLE).cut(frame) for frame in frames]
    assert all(frame.arm.offset[2] < -0.003 for frame in cut)
    perceive(cut, (), REGION, None, report)
    assert not [note for note in report.notes if "sees the arm" in note]


def test_an_arm_that_moves_or_holds_is_not_measured(panda):
    robot, pictures = panda
    frame = seen(pictures.at(OVER_THE_TABLE))[0]
    moving = told(robot, OVER_THE_TABLE)
    before = robot.arm_positions(OVER_THE_TABLE + 0.02)
    moving.history.take(list(before), list(before.values()), 9.9)
    assert moving.cut(frame).arm is None
    # What was measured before still holds, as long as the camera stands where it stood.
    resting = told(robot, OVER_THE_TABLE)
    known = resting.cut(frame).arm
    resting.history.take(list(before), list(before.values()), 10.1)
    later = replace(frame, stamp=10.1)
    assert resting.moves(10.1) and np.array_equal(resting.cut(later).arm.offset, known.offset)
    assert resting.cut(off([later], 0.01, 0.0, 0.0)[0]).arm is None
    holding = told(robot, OVER_THE_TABLE)
    holding.held = (Held.of(hook_at(robot)[0], robot.config.move_group),)
    assert holding.cut(frame).arm is None


def test_joint_states_on_their_way_are_waited_for(panda):
    view = told(panda[0], OVER_THE_TABLE, at=10.0)
    assert view.waits(10.1) and not view.waits(10.0) and not view.waits(12.0)
    # One that is missing in between is no silence.
    assert view.told(9.0) and view.told(11.9) and not view.told(12.0)


def hook_at(robot, away=0.0):
    """An L hook in the hand of an arm over the table, as it is told of, and its mesh in the world: ``away`` metres from there along its
    shaft."""
    world_from_tip = robot.poses(robot.arm_positions(OVER_THE_TABLE))[robot.config.move_group]
    hook = make("l_hook", 3, length=0.22, tip=0.08, width=0.02, thickness=0.015)
    # Level, the shaft between the fingers, its bend beyond them.
    x, y, z = world_from_tip[:3, 3]
    world_from_hook = transforms.make(translation=[x, y, z])
    held = replace(hook.as_object("object_1", np.eye(4)), world_from_object=transforms.inverse(world_from_tip) @ world_from_hook)
    return held, hook.mesh.transformed(transforms.make(translation=[x + away, y, z]))


def at_the_hook(hook, out, aside):
    """A cylinder that stands on the table and reaches above the hook, so far (m) inside of its bend."""
    target = make("cylinder", 9, radius=0.03, half_height=0.085).mesh
    bend = hook.bounds[1, 0]
    return target.transformed(transforms.make(translation=[bend - out, aside, -target.bounds[0, 2]]))


def told_what_is_held(robot, held):
    view = told(robot, OVER_THE_TABLE)
    view.held = (Held.of(held, robot.config.move_group),)
    return view


def test_pixels_of_what_is_held_are_told(panda):
    robot, pictures = panda
    held, hook = hook_at(robot)
    arm = pictures.at(OVER_THE_TABLE)
    view = told_what_is_held(robot, held)
    without = seen(arm, seed=1)
    for frame, empty in zip(seen([hook, *arm], seed=1), without, strict=True):
        cut = view.cut(frame)
        # It is where the picture is nearer for it, as far as the arm does not hide it.
        with np.errstate(invalid="ignore"):
            truth = (frame.depth < empty.depth - 0.03) & ~cut.blind
        inner = cv2.erode(truth.view(np.uint8), np.ones((5, 5), np.uint8)).view(bool)
        assert inner.sum() > 300
        assert (cut.held[inner] == SURELY).mean() > 0.97
        assert (cut.held[cv2.dilate(truth.view(np.uint8), np.ones((41, 41), np.uint8)) == 0] == SURELY).mean() < 0.002
        assert not cut.held[cut.blind].any()
        assert not np.isfinite(cut.free.depth[cut.held > 0]).any()


@pytest.mark.parametrize(("out", "aside", "away"), [(0.05, 0.02, 0.0), (0.045, 0.01, 0.0), (0.055, 0.045, 0.0), (0.05, 0.02, 0.006)])
def test_what_is_held_to_a_thing_and_the_thing_are_two(panda, out, aside, away):
    robot, pictures = panda
    held, hook = hook_at(robot, away)
    target = at_the_hook(hook, out, aside)
    view = told_what_is_held(robot, held)
    report = Report()
    scene = perceive([view.cut(frame) for frame in seen([target, hook, *pictures.at(OVER_THE_TABLE)])], (), REGION, report=report)
    assert len(scene.objects) == 2
    (hanging,) = (o for o in scene.objects if o.hanging)
    assert report.held == [hanging.id]
    (stands,) = (o for o in scene.objects if not o.hanging)
    np.testing.assert_allclose(stands.box_extents, target.extents, atol=0.004)
    np.testing.assert_allclose(stands.world_from_box[:3, 3], target.bounds.mean(axis=0), atol=0.004)
    assert (hanging.world_from_box[:3, 3] > hook.bounds[0] - 0.02).all() and (hanging.world_from_box[:3, 3] < hook.bounds[1] + 0.02).all()


def flat_looks(held):
    """One look of 120 x 160 pixels with so much told of what is held."""
    shape = held.shape
    frame = RgbdFrame(
        np.zeros((*shape, 3), np.uint8), np.ones(shape, np.float32), Intrinsics(shape[1], shape[0], 100, 100, 80, 60), np.eye(4), held=held
    )
    zeros = np.zeros(shape, np.float32)
    return [Looked(frame, zeros, zeros, np.ones(shape, bool), zeros)]


def test_one_mask_over_both_is_parted():
    """A merged mask: of a thing with a part of the tool before it, and of a tool that has taken a part of a thing."""
    held = np.zeros((120, 160), np.uint8)
    held[38:64, 18:144] = NEARLY
    held[40:62, 20:142] = SURELY
    thing = np.zeros(held.shape, bool)
    thing[55:115, 60:100] = True
    both = np.where(thing | (held == SURELY), 1, 0).astype(np.int32)
    both[0:10, 0:10] = 2
    (labels,) = parted(flat_looks(held), [both])
    (tool,) = np.unique(labels[held == SURELY])
    rest, other = labels[thing & (held == 0)], labels[0:10, 0:10]
    assert len({tool, *np.unique(rest), *np.unique(other)}) == 3 and sorted(np.unique(labels)) == [0, 1, 2, 3]
    # Mostly the thing: what is surely held goes, what is in front of it stays whole.
    large = np.where(thing, 1, 0).astype(np.int32)
    large[:, 100:140] = 1
    (labels,) = parted(flat_looks(held), [large])
    assert (labels[(large > 0) & (held == 0)] == 1).all() and (labels[(large > 0) & (held == SURELY)] == 2).all()
    # The edge of a thing that is told apart already stays its own.
    beside = np.zeros(held.shape, np.int32)
    beside[40:62, 20:142], beside[62:90, 60:100], beside[60:62, 60:100] = 1, 2, 2
    (labels,) = parted(flat_looks(held), [beside])
    assert (labels[60:90, 60:100] == 1).all() and (labels[40:60, 20:142] == 2).all()
    # Nothing held, nothing done.
    assert parted([replace(flat_looks(held)[0], frame=replace(flat_looks(held)[0].frame, held=None))], [both])[0] is both


def test_what_is_held_in_the_last_frame_is_held_in_the_mean_and_a_change_of_it_is_one(panda):
    robot, pictures = panda
    held, hook = hook_at(robot)
    arm = pictures.at(OVER_THE_TABLE)
    view = told(robot, OVER_THE_TABLE)
    frames = [view.cut(seen([hook, *arm], seed=k)[0]) for k in range(2)]
    before = average(frames)
    assert before.held is None
    view.held = (Held.of(held, robot.config.move_group),)
    after = average([frames[0], view.cut(seen([hook, *arm], seed=1)[0])])
    assert (after.held == SURELY).sum() > 300
    assert not unchanged(after, before) and unchanged(after, after)
