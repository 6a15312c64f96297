"""While the arm moves, and nothing else does, the scene stays, what the arm holds goes along, and what it hides is marked."""

from dataclasses import replace
from functools import cache

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
def robot():
    return Description()


def told(robot, joints, held=()):
    """What is told of joints that stand, move from THEN on, and are elsewhere NOW, still moving."""
    view = RobotInView(robot)
    view.held = held
    for stamp in np.arange(THEN - 1.0, NOW + 0.2, 0.05):
        share = np.clip((stamp - THEN) / (NOW - THEN), 0.0, 1.1)
        positions = robot.arm_positions(joints[0] + share * (joints[1] - joints[0]))
        view.history.take(list(positions), list(positions.values()), float(stamp))
    return view


@cache
def pictures(what, where):
    """Three frames of each camera of what is there, by name, with the arm at joints."""
    robot = Description()
    caliper, cylinder = things()
    meshes = {
        "things": [caliper, cylinder],
        "moved": [caliper.transformed(transforms.make(translation=[0.0, 0.01, 0.0])), cylinder],
        "come": [caliper, cylinder, placed("cylinder", 9, 0.45, 0.2, radius=0.015)],
        "gone": [cylinder],
        "hook": [hook_at(robot)[1].transformed(way(robot, OVER, where))],
    }[what]
    meshes += RobotPictures(robot).at(np.array(where))
    return [seen(meshes, len(what) + 10 * k) for k in range(3)]


def way(robot, *joints):
    """What carries a thing in the hand from one place of the arm to another."""
    then, now = (robot.forward(np.array(each[:7]))[0] for each in joints)
    return now @ transforms.inverse(then)


def means(view, what, where, stamp):
    """The mean of three frames of each camera."""
    frames = [[view.cut(replace(frame, stamp=stamp)) for frame in each] for each in pictures(what, tuple(where))]
    return [average(list(each)) for each in zip(*frames, strict=True)]


def made(view, what, where):
    frames = means(view, what, where, THEN)
    report = Report()
    scene = perceive(frames, (), REGION, report=report)
    masks = {i: [image == n for image in report.labels] for i, n in report.numbers.items()}
    hanging = frozenset(o.id for o in scene.objects if o.hanging)
    return Made(scene, frames, (), view.held, masks, hanging)


def test_the_scene_stays_while_the_arm_alone_moves(robot):
    view = told(robot, (ASIDE, OVER))
    before = made(view, "things", ASIDE)
    assert len(before.scene.objects) == 2 and not any(o.cut_off for o in before.scene.objects)
    frames = means(view, "things", OVER, NOW)
    assert not before.same(frames)
    scene = before.meanwhile(frames, view)
    assert scene is not None and scene.stamp == NOW
    for item, was in zip(scene.objects, before.scene.objects, strict=True):
        assert item.id == was.id and item.mesh is was.mesh
        hidden = [(m & f.blind).sum() / m.sum() for m, f in zip(before.masks[item.id], frames, strict=True)]
        assert (ROBOT in item.cut_off) == (max(hidden) >= 0.05)
    assert any(ROBOT in item.cut_off for item in scene.objects)


@pytest.mark.parametrize("what", ["moved", "come", "gone"])
def test_what_else_changes_is_looked_at(robot, what):
    view = told(robot, (ASIDE, OVER))
    assert made(view, "things", ASIDE).meanwhile(means(view, what, OVER, NOW), view) is None


def test_an_arm_that_stands_is_looked_past(robot):
    view = told(robot, (ASIDE, ASIDE))
    before, frames = made(view, "things", ASIDE), means(view, "things", ASIDE, NOW)
    assert before.meanwhile(frames, view) is None and before.same(frames) and before.shows(frames, ()) and before.recent(frames)
    assert not before.recent([replace(frame, stamp=THEN + AFRESH) for frame in frames])


def test_an_arm_stands_a_moment_after_it_stopped(robot):
    view = RobotInView(robot)
    for stamp in np.arange(9.0, 11.0, 0.01):
        positions = robot.arm_positions(OVER + min(stamp - 10.0, 0.0) * 0.2)
        view.history.take(list(positions), list(positions.values()), float(stamp))
    assert view.moves(9.99) and view.moves(10.05) and not view.moves(10.2) and not view.moves(20.0)


def test_what_is_held_goes_along(robot):
    item, _ = hook_at(robot)
    turned = OVER + np.array([0.3, 0, 0, 0, 0, 0, 0, 0, 0])
    view = told(robot, (OVER, turned), (Held.of(item, robot.config.move_group),))
    before, frames = made(view, "hook", OVER), means(view, "hook", turned, NOW)
    assert len(before.carried) == 1
    scene = before.meanwhile(frames, view)
    assert scene is not None
    (carried,), (was,) = scene.objects, before.scene.objects
    gone = way(robot, OVER, turned)
    np.testing.assert_allclose(carried.world_from_object, gone @ was.world_from_object, atol=1e-3)
    assert len(carried.points) == 0 < len(was.points), "where it is in the hand nobody has looked"
    # Let go meanwhile: looked at anew.
    view.held = ()
    assert before.meanwhile(frames, view) is None
