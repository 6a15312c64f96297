"""Measured points as obstacles: what no shape accounts for is avoided, what one does is left to it."""

from __future__ import annotations

import dataclasses

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_planner.arm import ArmPlanner
from magic_planner.cloud import CloudSettings, outside, thinned, unexplained
from magic_planner.collision import shell
from magic_planner.object_motion import plan_tool_motion
from magic_planner.request import Problem

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


def grid(low, high, step=0.005):
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def seen(points, name="seen", at=(0.3, -0.4)):
    """A block of 4 cm standing at ``at`` with measured points anywhere."""
    item = scenes.item(name, [scenes.box([0.04, 0.04, 0.04])], transforms.make(translation=[*at, 0.02]))
    return dataclasses.replace(item, points=np.asarray(points, dtype=float))


def test_points_are_thinned_to_voxel_centres():
    points = grid([0.0, 0.0, 0.0], [0.019, 0.009, 0.009], 0.001)
    np.testing.assert_allclose(thinned(points, 0.01), [[0.005, 0.005, 0.005], [0.015, 0.005, 0.005]])
    assert thinned(np.zeros((0, 3)), 0.01).shape == (0, 3)


def test_the_distance_to_a_box_is_the_one_to_its_faces():
    pose = transforms.from_rpy(0, 0, np.pi / 2, [0.5, 0, 0])  # its long side along y
    beside = np.array([[0.5, 0.109, 0], [0.5, 0.111, 0], [0.529, 0, 0], [0.531, 0, 0], [0.5, 0, 0]])
    np.testing.assert_array_equal(outside(beside, [scenes.box([0.2, 0.04, 0.04])], pose, 0.01), [False, True, False, True, False])


def test_only_points_without_a_shape_are_obstacles():
    tool, _ = scenes.hook()
    block = seen([])
    on_block = transforms.apply(block.world_from_object, block.pieces[0].vertices) + 0.003
    on_tool = transforms.apply(tool.world_from_object, tool.pieces[0].vertices)
    on_table = np.array([[0.5, 0.5, 0.004]])
    alone, bad = np.array([[0.5, -0.3, 0.2]]), np.array([[np.nan, 0, 0], [np.inf, 0, 0]])
    block = dataclasses.replace(block, points=np.concatenate([on_block, on_tool, on_table, alone, bad]))
    settings = CloudSettings()
    found = unexplained([block], tool, TABLE, settings)
    assert list(found) == ["seen"]
    assert len(found["seen"]) == 1 and np.abs(found["seen"] - alone).max() <= settings.resolution / 2 + 1e-9
    assert unexplained([block], tool, TABLE, dataclasses.replace(settings, use=False)) == {}
    # A fixture's exact shape accounts for what the cameras measured of it.
    fixture = scenes.item("rod", [scenes.box([0.02, 0.2, 0.02])], transforms.make(translation=[0.5, -0.3, 0.2]))
    assert unexplained([block, fixture], tool, TABLE, settings) == {}


@pytest.mark.parametrize("changes", [{"resolution": 0.0}, {"resolution": float("nan")}, {"margin": -0.1}])
def test_bad_settings_are_refused(changes):
    with pytest.raises(MagicError) as raised:
        CloudSettings(**changes)
    assert raised.value.code == Code.BAD_REQUEST


def problem(**changes):
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    strategy, candidate = scenes.pulling(), scenes.candidate(tool, tool_contact, target_contact)
    return strategy, tool, target, candidate, "keep", plan_tool_motion(strategy, tool, target, candidate)


def blocked(robot, plan, given, wall) -> int:
    """How many samples of the free motion with the tool in hand have arm or tool in a wall."""
    tool, motion = given[1], plan.arm_motion
    robot.clear()
    robot.add("wall", shell(wall.pieces), wall.world_from_object)
    robot.open_to(motion.grasp_width)
    robot.attach(tool.id, shell(tool.pieces), transforms.inverse(motion.tool_from_tcp), tuple(robot.hand))
    carried = next(p for p in motion.phases if p.name == "transfer")
    during = (motion.times >= carried.start) & (motion.times <= carried.end)
    return sum(robot.collides(q) for q in motion.positions[during])


def test_a_wall_of_points_without_pieces_is_gone_around(arm):
    given = problem()
    wall = scenes.item("wall", [scenes.box([0.15, 0.02, 0.25])], transforms.make(translation=[0.45, 0.12, 0.185]))
    obstacle = seen(grid([0.375, 0.11, 0.06], [0.525, 0.13, 0.31]))
    through = ArmPlanner(arm.robot, cloud=CloudSettings(use=False)).solve(Problem(*given, obstacles=[obstacle]))
    assert blocked(arm.robot, through, given, wall) > 0
    around = ArmPlanner(arm.robot).solve(Problem(*given, obstacles=[obstacle]))
    assert blocked(arm.robot, around, given, wall) == 0


def test_a_start_among_points_names_them(arm):
    tip = arm.robot.chain.forward(arm.robot.home)[:3, 3]
    obstacle = seen(grid(tip + [-0.03, -0.03, 0.08], tip + [0.03, 0.03, 0.14]))
    with pytest.raises(MagicError, match="points of seen") as raised:
        arm.solve(Problem(*problem(), obstacles=[obstacle]))
    assert raised.value.code == Code.START_IN_COLLISION


def test_the_points_of_tool_and_target_do_not_stand_in_the_way(arm):
    strategy, tool, target, candidate, keep, motion = problem()
    rng = np.random.default_rng(0)
    measured = [
        dataclasses.replace(o, points=transforms.apply(o.world_from_object, np.concatenate([p.vertices for p in o.pieces])))
        for o in (tool, target)
    ]
    measured = [dataclasses.replace(o, points=np.repeat(o.points, 20, axis=0)) for o in measured]
    measured = [dataclasses.replace(o, points=o.points + rng.normal(0, 0.002, o.points.shape)) for o in measured]
    plan = arm.solve(Problem(strategy, tool, target, candidate, keep, motion))
    same = arm.solve(Problem(strategy, measured[0], measured[1], candidate, keep, motion))
    np.testing.assert_array_equal(plan.arm_motion.positions, same.arm_motion.positions)
