"""While the arm moves, and nothing else does, the scene stays, what the arm holds goes along, and what it hides is marked."""

import numpy as np
import pytest
from test_robot_in_view import OVER_THE_TABLE, REGION, hook_at, placed, seen, things

from magic_core import transforms
from magic_core.robot import Description
from magic_core.robot_pictures import RobotPictures
from magic_core.scene import ROBOT
from magic_perception.averaging import average
from magic_perception.meanwhile import AFRESH, Made
from magic_perception.pipeline import Report, perceive
from magic_perception.robot_in_view import Held, RobotInView

#: From beside the things to over one of them, at two stamps, s.
ASIDE, OVER = OVER_THE_TABLE + np.array([1.1, -0.3, 0, 0, 0, 0, 0, 0, 0]), OVER_THE_TABLE
THEN, NOW = 10.0, 13.0


@pytest.fixture(scope="module")
def panda():
    robot = Description()
    return robot, RobotPictures(robot)


def told(robot, joints, held=()):
    """What is told of joints that stand, move from THEN on, and are elsewhere NOW, still moving."""
    view = RobotInView(robot)
    view.held = held
    for stamp in np.arange(THEN - 1.0, NOW + 0.2, 0.05):
        share = np.clip((stamp - THEN) / (NOW - THEN), 0.0, 1.1)
        positions = robot.arm_positions(joints[0] + share * (joints[1] - joints[0]))
        view.history.take(list(positions), list(positions.values()), float(stamp))
    return view


def means(view, meshes, seed, stamp):
    """The mean of three frames of each camera."""
    return [
        average([view.cut(frame) for frame in frames]) for frames in zip(*(seen(meshes, seed + k, stamp) for k in range(3)), strict=True)
    ]


def made(view, meshes, carried=()):
    frames = means(view, meshes, 10, THEN)
    report = Report()
    scene = perceive(frames, (), REGION, report=report)
    masks = {i: [image == n for image in report.labels] for i, n in report.numbers.items()}
    hanging = frozenset(o.id for o in scene.objects if o.hanging)
    return Made(scene, frames, (), view.held, masks, hanging)


def now(view, meshes):
    return means(view, meshes, 20, NOW)


def test_the_scene_stays_while_the_arm_alone_moves(panda):
    robot, pictures = panda
    view = told(robot, (ASIDE, OVER))
    before = made(view, [*things(), *pictures.at(ASIDE)])
    assert len(before.scene.objects) == 2 and not any(o.cut_off for o in before.scene.objects)
    frames = now(view, [*things(), *pictures.at(OVER)])
    assert not before.same(frames)
    scene = before.meanwhile(frames, view)
    assert scene is not None and scene.stamp == NOW
    for item, was in zip(scene.objects, before.scene.objects, strict=True):
        assert item.id == was.id and item.mesh is was.mesh
        hidden = [m & f.blind for m, f in zip(before.masks[item.id], frames, strict=True)]
        share = max(h.sum() / m.sum() for h, m in zip(hidden, before.masks[item.id], strict=True))
        assert (ROBOT in item.cut_off) == (share >= 0.05)
    assert any(ROBOT in item.cut_off for item in scene.objects)


@pytest.mark.parametrize("what", ["moved", "come", "gone"])
def test_what_else_changes_is_looked_at(panda, what):
    robot, pictures = panda
    view = told(robot, (OVER, ASIDE))
    caliper, cylinder = things()
    before = made(view, [caliper, cylinder, *pictures.at(OVER)])
    before = Made(before.scene, before.frames, (), (), before.masks, frozenset(o.id for o in before.scene.objects if o.cut_off))
    after = {
        "moved": [caliper.transformed(transforms.make(translation=[0.0, 0.01, 0.0])), cylinder],
        "come": [caliper, cylinder, placed("cylinder", 9, 0.45, 0.2, radius=0.015)],
        "gone": [cylinder],
    }[what]
    assert before.meanwhile(now(view, [*after, *pictures.at(ASIDE)]), view) is None


def test_an_arm_that_stands_is_looked_past(panda):
    robot, pictures = panda
    view = told(robot, (ASIDE, ASIDE))
    before = made(view, [*things(), *pictures.at(ASIDE)])
    frames = now(view, [*things(), *pictures.at(ASIDE)])
    assert before.meanwhile(frames, view) is None and before.same(frames) and before.recent(frames, ())
    later = [type(f)(f.color, f.depth, f.intrinsics, f.world_from_camera, f.camera, THEN + AFRESH) for f in frames]
    assert not before.recent(later, ())


def test_what_is_held_goes_along(panda):
    robot, pictures = panda
    item, hook = hook_at(robot)
    link = robot.config.move_group
    turned = OVER_THE_TABLE + np.array([0.3, 0, 0, 0, 0, 0, 0, 0, 0])
    view = told(robot, (OVER_THE_TABLE, turned), (Held.of(item, link),))
    tips = [robot.forward(joints[:7])[0] for joints in (OVER_THE_TABLE, turned)]
    way = tips[1] @ transforms.inverse(tips[0])
    before = made(view, [hook, *pictures.at(OVER_THE_TABLE)])
    assert len(before.carried) == 1
    scene = before.meanwhile(now(view, [hook.transformed(way), *pictures.at(turned)]), view)
    assert scene is not None
    (carried,), (was,) = scene.objects, before.scene.objects
    np.testing.assert_allclose(carried.world_from_object, way @ was.world_from_object, atol=1e-3)
    np.testing.assert_allclose(carried.points, transforms.apply(way, was.points), atol=1e-3)
    # Let go meanwhile, or something else is held: looked at anew.
    view.held = ()
    assert before.meanwhile(now(view, [hook.transformed(way), *pictures.at(turned)]), view) is None
