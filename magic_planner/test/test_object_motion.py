"""The motion of the tool: contacts meet, the table stays clear, the target's frame is all that matters."""

from __future__ import annotations

import dataclasses

import numpy as np
import planner_scenes as scenes
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.contact import OPPOSED, turned_over
from magic_core.errors import Code, MagicError
from magic_core.strategy import Waypoint
from magic_planner.collision import Body
from magic_planner.object_motion import STEP_LENGTH, TABLE_CLEARANCE, _room_beneath, plan_tool_motion, straight_line

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


def setup(flipped=False, **changes):
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    return scenes.pulling(**changes), tool, target, scenes.candidate(tool, tool_contact, target_contact, flipped)


def at(motion, seconds):
    return transforms.interpolate(motion.times, motion.world_from_tool, [seconds])[0]


def contact_end(motion):
    return next(p.end for p in motion.phases if p.name == "contact")


def test_contact_frames_meet_squarely_at_the_contact_waypoint():
    strategy, tool, target, candidate = setup()
    motion = plan_tool_motion(strategy, tool, target, candidate, "keep", TABLE)
    tool_contact = at(motion, contact_end(motion)) @ candidate.tool.object_from_contact
    target_contact = target.world_from_object @ candidate.target.object_from_contact
    np.testing.assert_allclose(tool_contact[:3, 3], target_contact[:3, 3], atol=1e-9)
    np.testing.assert_allclose(tool_contact[:3, 0], -target_contact[:3, 0], atol=1e-9)
    np.testing.assert_allclose(tool_contact[:3, 2], target_contact[:3, 2], atol=1e-9)


def test_phases_follow_the_waypoints_and_times_increase():
    strategy, tool, target, candidate = setup()
    motion = plan_tool_motion(strategy, tool, target, candidate)
    assert [p.name for p in motion.phases] == ["approach", "contact", "goal"]
    assert motion.phases[0].start == 0 and motion.phases[-1].end == pytest.approx(motion.times[-1])
    assert all(a.end == b.start for a, b in zip(motion.phases, motion.phases[1:], strict=False))
    assert np.all(np.diff(motion.times) > 0)
    steps = np.linalg.norm(np.diff(motion.world_from_tool[:, :3, 3], axis=0), axis=1)
    assert steps.max() <= STEP_LENGTH + 1e-9
    assert (steps / np.diff(motion.times)).max() <= 0.1 + 1e-9


def test_a_line_keeps_speed_and_acceleration():
    times, share = straight_line(0.3, 0.1, 1.0)
    assert times[-1] == pytest.approx(3.1)
    assert share[-1] == 1 and np.all(np.diff(share) > 0)
    short, _ = straight_line(0.001, 0.1, 1.0)
    assert short[-1] == pytest.approx(2 * np.sqrt(0.001))


def demonstration():
    """A demonstrated sweep with a turn, given as target_from_tool, and the strategy that holds it."""
    _tool, tool_contact = scenes.hook()
    _target, target_contact = scenes.standing_cylinder()
    times = np.linspace(0, 2, 9)
    poses = []
    for share in times / 2:
        c = transforms.from_rpy(0, 0, 0.4 * share, [0.05 * (1 - share), -0.05 * share, 0]) @ OPPOSED
        poses.append(target_contact.object_from_contact @ c @ transforms.inverse(tool_contact.object_from_contact))
    return scenes.pulling(waypoints=(), mode="retarget", times=times, target_from_tool=np.stack(poses))


def with_no_waypoints(strategy):
    return dataclasses.replace(strategy, waypoints=())


def test_retargeting_with_the_references_own_contact_reproduces_the_demonstration():
    strategy = with_no_waypoints(demonstration())
    _, tool, target, candidate = setup()
    motion = plan_tool_motion(strategy, tool, target, candidate, "keep", TABLE)
    raised = motion.world_from_tool[0, 2, 3] - (target.world_from_object @ strategy.target_from_tool[0])[2, 3]
    assert raised == pytest.approx(0, abs=1e-9)
    for t, pose in zip(strategy.times, strategy.target_from_tool, strict=True):
        np.testing.assert_allclose(at(motion, t), target.world_from_object @ pose, atol=1e-9)
        assert np.abs(motion.times - t).min() < 1e-12


def test_retargeting_carries_the_contact_and_not_the_tool():
    strategy = with_no_waypoints(demonstration())
    tool, tool_contact = scenes.hook(handle=0.2)
    target, target_contact = scenes.standing_cylinder(0.03, (0.5, 0.1))
    motion = plan_tool_motion(strategy, tool, target, scenes.candidate(tool, tool_contact, target_contact), "keep", TABLE)
    for t, pose in zip(strategy.times, strategy.target_from_tool, strict=True):
        expected = transforms.inverse(strategy.target_contact.object_from_contact) @ pose @ strategy.tool_contact.object_from_contact
        got = (
            transforms.inverse(target.world_from_object @ target_contact.object_from_contact)
            @ at(motion, t)
            @ tool_contact.object_from_contact
        )
        np.testing.assert_allclose(got, expected, atol=1e-9)


def test_turned_over_is_a_proper_rotation_and_keeps_the_normals_opposed():
    strategy, tool, target, candidate = setup(flipped=True)
    keep = plan_tool_motion(strategy, tool, target, candidate, "keep", TABLE)
    turn = plan_tool_motion(strategy, tool, target, candidate, "turn", TABLE)
    assert np.allclose(np.linalg.det(turn.world_from_tool[:, :3, :3]), 1)
    np.testing.assert_allclose(turn.world_from_tool[0, :3, 2], -keep.world_from_tool[0, :3, 2], atol=1e-9)
    frame = at(turn, contact_end(turn)) @ turned_over(candidate.tool.object_from_contact)
    target_frame = target.world_from_object @ candidate.target.object_from_contact
    np.testing.assert_allclose(transforms.inverse(target_frame) @ frame, OPPOSED, atol=1e-9)
    plain = dataclasses.replace(candidate, flipped=False)
    np.testing.assert_array_equal(plan_tool_motion(strategy, tool, target, plain, "turn", TABLE).world_from_tool, keep.world_from_tool)


@pytest.mark.parametrize("table", [[0, 0, 1, 0], [0.05, 0.02, 1.0, -0.01], [0, 0, -2.0, 0.06]])
def test_the_tool_is_raised_by_the_least_amount_that_clears_the_table(table):
    strategy, _tool, _, _ = setup()
    _, tool_contact = scenes.hook(thickness=0.08)
    tall, _ = scenes.hook(thickness=0.08)
    target, target_contact = scenes.standing_cylinder(0.02)
    motion = plan_tool_motion(strategy, tall, target, scenes.candidate(tall, tool_contact, target_contact), "keep", table)
    plane = np.array(table, dtype=float) / np.linalg.norm(table[:3]) * np.sign(table[2])
    vertices = np.concatenate([p.vertices for p in tall.pieces])
    gaps = [(transforms.apply(pose, vertices) @ plane[:3] + plane[3]).min() for pose in motion.world_from_tool]
    assert min(gaps) == pytest.approx(TABLE_CLEARANCE, abs=1e-9)


@pytest.mark.parametrize(("radius", "above"), [(0.02, 0.004), (0.006, 0.0024), (0.002, TABLE_CLEARANCE)])
def test_a_tool_in_a_gripper_keeps_off_the_table_as_off_other_things_and_meets_a_low_target_all_the_same(radius, above):
    strategy, _tool, _, _ = setup()
    tall, tool_contact = scenes.hook(thickness=0.08)
    target, target_contact = scenes.standing_cylinder(radius)
    candidate = scenes.candidate(tall, tool_contact, target_contact)
    motion = plan_tool_motion(strategy, tall, target, candidate, "keep", TABLE, gap=0.004)
    vertices = np.concatenate([p.vertices for p in tall.pieces])
    lowest = min(transforms.apply(pose, vertices)[:, 2].min() for pose in motion.world_from_tool)
    assert lowest == pytest.approx(above, abs=1e-6)


@pytest.mark.parametrize(("high", "above"), [(0.018, 0.0024), (0.025, TABLE_CLEARANCE), (0.010, 0.0036)])
def test_a_stem_that_the_table_holds_up_is_not_led_over_its_target(high, above):
    """A plate on edge and the stem that it carries, whose lower side is ``high`` over the plate's: the target, 30 mm high, is to be met by
    both."""
    strategy, _tool, _, _ = setup()
    plate, stem = scenes.box([0.004, 0.08, 2 * high + 0.006]), scenes.box([0.1, 0.006, 0.006], [-0.05, 0, 0])
    tool = scenes.item("tool", [plate, stem], transforms.make(translation=[0.45, 0.25, high + 0.003]), scenes.DOWN)
    contact = scenes.contact(scenes.DOWN, [-0.002, 0.003, 0], [-np.sqrt(0.5), np.sqrt(0.5), 0])
    target, target_contact = scenes.standing_cylinder(0.015)
    motion = plan_tool_motion(strategy, tool, target, scenes.candidate(tool, contact, target_contact), "keep", TABLE, gap=0.004)
    vertices = np.concatenate([p.vertices for p in tool.pieces])
    lowest = min(transforms.apply(pose, vertices)[:, 2].min() for pose in motion.world_from_tool)
    assert lowest == pytest.approx(above, abs=1e-4)


@pytest.mark.parametrize("turn", [90, 30])
def test_a_tool_that_goes_beneath_its_target_keeps_off_the_table_as_others_do(turn):
    """It goes beneath where it turns, at a wall: until then it pushes its target along, and scraped along the table a long one slips in the
    fingers."""
    tall, tool_contact = scenes.hook(thickness=0.08)
    target, target_contact = scenes.standing_cylinder(0.02)
    times = np.linspace(0, 2, 9)
    poses = [
        target_contact.object_from_contact
        @ transforms.from_rpy(0, -np.deg2rad(turn) * share, 0, [0.05 * (1 - share), 0, 0])
        @ OPPOSED
        @ transforms.inverse(tool_contact.object_from_contact)
        for share in times / 2
    ]
    strategy = scenes.pulling(waypoints=(), mode="retarget", times=times, target_from_tool=np.stack(poses))
    motion = plan_tool_motion(strategy, tall, target, scenes.candidate(tall, tool_contact, target_contact), "keep", TABLE, gap=0.004)
    vertices = np.concatenate([p.vertices for p in tall.pieces])
    lowest = min(transforms.apply(pose, vertices)[:, 2].min() for pose in motion.world_from_tool)
    assert lowest == pytest.approx(0.004, abs=1e-6)


@pytest.mark.parametrize(("length", "radius", "room"), [(0.1, 0.02, 0.002), (0.6, 0.02, 0.003), (1.2, 0.02, 0.004), (0.1, 0.1, 0.004)])
def test_the_longer_a_tool_the_more_room_it_keeps_to_what_it_goes_up_beneath_a_target(length, radius, room):
    """Its tip is farther off when it turns in the hand; a short one may go closer beneath a small target."""
    tool = scenes.item("tool", [scenes.box([length, 0.04, 0.02])], np.eye(4), scenes.DOWN)
    tip = scenes.contact(scenes.DOWN, [length / 2, 0, 0], [1, 0, 0])
    target, _ = scenes.standing_cylinder(radius)
    assert _room_beneath(tool, tip.object_from_contact, target, np.array(TABLE, dtype=float), 0.004) == pytest.approx(room)


@pytest.mark.parametrize(("askew", "height", "flat"), [(20, 0.03, True), (20, 0.3, False), (40, 0.03, True), (60, 0.03, False)])
def test_a_tool_seen_a_little_askew_is_led_flat_where_it_would_pass_over_a_low_target(askew, height, flat):
    strategy, _tool, _, _ = setup()
    tool, tool_contact = scenes.hook()
    tilt = transforms.from_rpy(0, np.deg2rad(askew), 0)  # the far end of the handle down, the contact up
    frame = tool_contact.object_from_contact.copy()
    frame[:3, :3] = tilt[:3, :3] @ frame[:3, :3]
    seen = dataclasses.replace(tool_contact, object_from_contact=frame)
    _, target_contact = scenes.standing_cylinder(0.015)
    standing = transforms.make(translation=[0.6, 0.0, height / 2])
    target = scenes.item("target", [scenes.cylinder(0.015, height)], standing, scenes.DOWN)
    motion = plan_tool_motion(strategy, tool, target, scenes.candidate(tool, seen, target_contact), "keep", TABLE)
    met = at(motion, contact_end(motion))
    assert np.degrees(np.arccos(np.clip(met[2, 2], -1, 1))) == pytest.approx(0 if flat else askew, abs=1e-3)
    assert ((met @ frame)[2, 3] < height) == (flat or height > 0.1)


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(-1, 1),
    y=st.floats(-1, 1),
    z=st.floats(0.5, 1),
    yaw=st.floats(-3.1, 3.1),
    roll=st.floats(-1, 1),
    mode=st.sampled_from(["plan", "retarget"]),
)
def test_the_motion_moves_with_the_target(x, y, z, yaw, roll, mode):
    strategy, tool, target, candidate = setup()
    if mode == "retarget":
        strategy = with_no_waypoints(demonstration())
    shift = transforms.from_rpy(roll, 0, yaw, [x, y, z])
    far = (0, 0, 1.0, 5.0)  # a table far below, so that nothing is raised
    moved = dataclasses.replace(target, world_from_object=shift @ target.world_from_object)
    a = plan_tool_motion(strategy, tool, target, candidate, "keep", far)
    b = plan_tool_motion(strategy, tool, moved, candidate, "keep", far)
    np.testing.assert_allclose(b.world_from_tool, shift @ a.world_from_tool, atol=1e-9)
    np.testing.assert_array_equal(a.times, b.times)


def test_a_releasing_strategy_ends_with_the_release():
    strategy, tool, target, candidate = setup(releases=True)
    motion = plan_tool_motion(strategy, tool, target, candidate)
    assert motion.phases[-1].name == "release"
    assert motion.phases[-1].end - motion.phases[-1].start == pytest.approx(0.5)
    np.testing.assert_array_equal(motion.world_from_tool[-1], motion.world_from_tool[-2])
    hand = (
        *strategy.waypoints,
        Waypoint("let go", np.array([-0.25, 0, 0]), "release", 0.1),
        Waypoint("away", np.array([0, 0, -0.1]), "retreat", 0.1),
    )
    longer = plan_tool_motion(dataclasses.replace(strategy, waypoints=hand), tool, target, candidate)
    assert longer.phases == motion.phases


def test_a_start_inside_the_target_or_an_obstacle_names_the_pair():
    strategy, tool, target, candidate = setup()
    inside = dataclasses.replace(strategy, waypoints=(Waypoint("start", np.array([-0.02, 0, 0]), "approach"), *strategy.waypoints[2:]))
    with pytest.raises(MagicError, match="tool and target") as raised:
        plan_tool_motion(inside, tool, target, candidate)
    assert raised.value.code == Code.PATH_IN_COLLISION
    wall = scenes.item("wall", [scenes.box([0.02, 0.5, 0.5])], transforms.make(translation=[0.5, 0, 0.25]))
    with pytest.raises(MagicError, match="tool and wall") as raised:
        plan_tool_motion(strategy, tool, target, candidate, "keep", TABLE, [wall])
    assert raised.value.code == Code.PATH_IN_COLLISION


def broken(strategy, tool, target, candidate, case):
    nan = np.eye(4)
    nan[0, 3] = np.nan
    mirror = np.diag([-1.0, 1, 1, 1])
    replace = dataclasses.replace
    empty = scenes.box([1, 1, 1])
    empty = dataclasses.replace(empty, vertices=np.zeros((0, 3)), faces=np.zeros((0, 3)))
    return {
        "no target": (strategy, tool, target, replace(candidate, target=None), "keep", TABLE, Code.BAD_REQUEST),
        "other tool": (strategy, tool, target, replace(candidate, tool_id="spoon"), "keep", TABLE, Code.BAD_REQUEST),
        "reflection": (strategy, tool, target, candidate, "swap", TABLE, Code.BAD_REQUEST),
        "nan pose": (strategy, replace(tool, world_from_object=nan), target, candidate, "keep", TABLE, Code.BAD_MOTION),
        "nan contact": (
            strategy,
            tool,
            target,
            replace(candidate, tool=replace(candidate.tool, object_from_contact=nan)),
            "keep",
            TABLE,
            Code.BAD_MOTION,
        ),
        "mirrored": (
            strategy,
            tool,
            target,
            replace(candidate, target=replace(candidate.target, object_from_contact=mirror)),
            "keep",
            TABLE,
            Code.BAD_MOTION,
        ),
        "degenerate": (
            strategy,
            tool,
            target,
            replace(candidate, tool=replace(candidate.tool, object_from_contact=np.diag([1.0, 0, 0, 1]))),
            "keep",
            TABLE,
            Code.BAD_MOTION,
        ),
        "table on edge": (strategy, tool, target, candidate, "keep", (1, 0, 0, 0), Code.BAD_MOTION),
        "nan table": (strategy, tool, target, candidate, "keep", (0, 0, np.nan, 0), Code.BAD_MOTION),
        "no waypoints": (replace(strategy, waypoints=strategy.waypoints[:1]), tool, target, candidate, "keep", TABLE, Code.BAD_STRATEGY),
        "no speed": (
            replace(strategy, waypoints=(*strategy.waypoints[:3], Waypoint("goal", np.ones(3), "goal", 0.0))),
            tool,
            target,
            candidate,
            "keep",
            TABLE,
            Code.BAD_STRATEGY,
        ),
        "mode": (replace(strategy, mode="dance"), tool, target, candidate, "keep", TABLE, Code.BAD_STRATEGY),
        "times": (replace(strategy, mode="retarget", times=np.zeros(2)), tool, target, candidate, "keep", TABLE, Code.BAD_STRATEGY),
        "empty tool": (strategy, replace(tool, mesh=empty, pieces=()), target, candidate, "keep", TABLE, Code.BAD_MESH),
    }[case]


@pytest.mark.parametrize(
    "case",
    ["no target", "other tool", "reflection", "nan pose", "nan contact", "mirrored", "degenerate", "table on edge", "nan table"]
    + ["no waypoints", "no speed", "mode", "times", "empty tool"],
)  # fmt: skip
def test_bad_input_gets_its_code(case):
    *arguments, code = broken(*setup(), case)
    with pytest.raises(MagicError) as raised:
        plan_tool_motion(*arguments)
    assert raised.value.code == code


def test_a_sheet_without_volume_is_still_a_tool():
    strategy, tool, target, candidate = setup()
    flat = [scenes.box([0.3, 0.02, 0.0]), scenes.box([0.02, 0.08, 0.0], [0.14, 0.05, 0])]
    sheet = dataclasses.replace(tool, pieces=tuple(flat), mesh=flat[0])
    motion = plan_tool_motion(strategy, sheet, target, candidate)
    assert motion.phases[-1].name == "goal"


def ring(radius=0.04, thickness=0.006, parts=24):
    """A ring lying flat, its contact inside at +x, which faces the middle."""
    turns = np.arange(parts) * 2 * np.pi / parts
    length = 2 * (radius + thickness) * np.tan(np.pi / parts)
    pieces = [
        scenes.box([thickness, length, 0.02]).transformed(
            transforms.from_rpy(0, 0, t, [np.cos(t) * (radius + thickness / 2), np.sin(t) * (radius + thickness / 2), 0])
        )
        for t in turns
    ]
    tool = scenes.item("tool", pieces, transforms.from_rpy(0, 0, 0, [0.45, 0.25, 0.01]), scenes.DOWN)
    return tool, scenes.contact(scenes.DOWN, [radius, 0, 0], [-1, 0, 0])


def test_a_ring_is_lowered_over_its_target_where_the_hook_comes_from_behind():
    """The demonstrated approach comes down 30 mm behind the target, where the ring's other side would land on it."""
    tool, tool_contact = ring()
    target, target_contact = scenes.standing_cylinder(0.025)
    motion = plan_tool_motion(scenes.pulling(), tool, target, scenes.candidate(tool, tool_contact, target_contact))
    body, other = Body("tool", tool.pieces), Body.from_object(target)
    approach = motion.world_from_tool[motion.times <= motion.phases[0].end + 1e-9]
    for pose in approach:
        body.move(pose)
        assert not body.touches(other)
    offset = approach[-1, 0, 3] + 0.04 - (0.6 + 0.025)
    assert 0.0015 < offset < 0.03
    assert dict(motion.marks)["behind"] == pytest.approx(motion.phases[0].end)
    met = at(motion, contact_end(motion)) @ tool_contact.object_from_contact
    np.testing.assert_allclose(met[:3, 3], (target.world_from_object @ target_contact.object_from_contact)[:3, 3], atol=1e-9)


@pytest.mark.parametrize(("radius", "room"), [(0.0262, 0.0005), (0.029, 0.0035), (0.03, 0.0045), (0.0405, 0.006)])
def test_a_tool_is_lowered_over_its_target_with_the_room_that_there_is(radius, room):
    """Of a cylinder of 50 mm a ring of 60 mm is 5 mm clear about its middle, and 1.6 mm at the first share of the approach that is clear at
    all; one of 81 mm is 1 mm clear of its far side as the approach was shown."""
    tool, tool_contact = ring(radius)
    target, target_contact = scenes.standing_cylinder(0.025)
    motion = plan_tool_motion(scenes.pulling(), tool, target, scenes.candidate(tool, tool_contact, target_contact))
    wide, _ = scenes.standing_cylinder(0.025 + room)
    body, wall = Body("tool", tool.pieces), Body("target", wide.pieces)
    wall.move(target.world_from_object)
    approach = motion.world_from_tool[motion.times <= motion.phases[0].end + 1e-9]
    for pose in approach:
        body.move(pose)
        assert not body.touches(wall)
    # Straight from there to the contact: the target is not passed by.
    assert abs(approach[-1, 1, 3] - target.world_from_object[1, 3]) < 0.002


def test_an_approach_with_room_is_left_as_it_is_and_so_is_one_without_hope():
    strategy, tool, target, candidate = setup()
    motion = plan_tool_motion(strategy, tool, target, candidate)
    start = motion.world_from_tool[0] @ candidate.tool.object_from_contact
    expected = target.world_from_object @ candidate.target.object_from_contact @ transforms.make(translation=[0.03, 0, -0.10])
    np.testing.assert_allclose(start[:3, 3], expected[:3, 3], atol=1e-9)
    tool, tool_contact = ring(radius=0.02)  # narrower than the target
    candidate = scenes.candidate(tool, tool_contact, candidate.target)
    start = plan_tool_motion(strategy, tool, target, candidate).world_from_tool[0] @ tool_contact.object_from_contact
    np.testing.assert_allclose(start[:3, 3], expected[:3, 3], atol=1e-9)


def hung(tool, tool_contact):
    """The motion of a ring that is slid over a standing rod 12 mm thick, lowered by 12 mm and let go; and the rod."""
    offsets = {"before": [0.012, 0, -0.2], "over": [0.012, 0, 0], "touch": [0, 0, 0], "let_go": [0, 0, 0]}
    phases = ("approach", "approach", "contact", "release")
    strategy = scenes.pulling([Waypoint(n, np.array(o), phase) for (n, o), phase in zip(offsets.items(), phases, strict=True)])
    strategy = dataclasses.replace(strategy, releases=True, physics=dataclasses.replace(strategy.physics, target_is_fixed=True))
    rod = scenes.item("target", [scenes.cylinder(0.006, 0.1)], transforms.make(translation=[0.6, 0, 0.05]), scenes.DOWN)
    candidate = scenes.candidate(tool, tool_contact, scenes.contact(scenes.DOWN, [0.006, 0, 0], [1, 0, 0]))
    return plan_tool_motion(strategy, tool, rod, candidate), rod


@pytest.mark.parametrize(("radius", "room", "aside"), [(0.014, 0.0072, 0.004), (0.04, 0.0095, 0.0)])
def test_a_tool_is_slid_over_a_fixed_target_where_there_is_most_room(radius, room, aside):
    """In a hole of 28 mm a rod of 12 mm has 8 mm about it, but only 4 as it was shown; in one of 80 mm the 10 that are asked for, as it was
    shown."""
    tool, tool_contact = ring(radius)
    motion, rod = hung(tool, tool_contact)
    body = Body("tool", tool.pieces)
    wall = Body.from_object(scenes.item("target", [scenes.cylinder(0.006 + room, 0.1)], rod.world_from_object))
    slide = motion.world_from_tool[motion.times <= motion.phases[0].end + 1e-9]
    for pose in slide:
        body.move(pose)
        assert not body.touches(wall)
    met = transforms.inverse(rod.world_from_object) @ slide[-1] @ tool_contact.object_from_contact
    assert 0.018 - met[0, 3] == pytest.approx(aside, abs=0.0015)
    if not aside:
        assert met[:2, 3] == pytest.approx([0.018, 0.0], abs=1e-9)


def test_a_tool_that_cannot_be_let_go_at_the_contact_is_let_go_on_the_way_to_it():
    """What was seen of a handle is 8 mm thicker at the contact than where that was found."""
    tool, tool_contact = ring(0.02)
    block = scenes.box([0.008, 0.03, 0.02], [0.016, 0, 0])
    motion, rod = hung(scenes.item("tool", [*tool.pieces, block], tool.world_from_object, scenes.DOWN), tool_contact)
    body = Body("tool", (*tool.pieces, block))
    slide = motion.times <= motion.phases[0].end + 1e-9
    for room, poses in ((0.0085, motion.world_from_tool[slide]), (0.0055, motion.world_from_tool)):
        wall = Body.from_object(scenes.item("target", [scenes.cylinder(0.006 + room, 0.1)], rod.world_from_object))
        for pose in poses:
            body.move(pose)
            assert not body.touches(wall)
    met = transforms.inverse(rod.world_from_object) @ at(motion, motion.times[-1]) @ tool_contact.object_from_contact
    assert 0.014 <= met[0, 3] - 0.006 < 0.018 and abs(met[1, 3]) < 0.003


@pytest.mark.parametrize(("radius", "bump", "gap"), [(0.02, False, 0.006), (0.009, False, 0.003), (0.02, True, 0.006)])
def test_a_tool_is_let_go_clear_of_a_fixed_target_as_far_as_there_is_room(radius, bump, gap):
    """A rod 12 mm thick has 3 mm to each side of it in the middle of a hole of 18 mm; a bump at the contact is stepped aside from."""
    tool, tool_contact = ring(radius)
    if bump:
        block = scenes.box([0.012, 0.006, 0.02], [radius - 0.006, 0.014, 0])
        tool = scenes.item("tool", [*tool.pieces, block], tool.world_from_object, scenes.DOWN)
    motion, rod = hung(tool, tool_contact)
    thick = scenes.item("target", [scenes.cylinder(0.006 + 0.5 * gap, 0.1)], rod.world_from_object)
    body, wall = Body("tool", tool.pieces), Body.from_object(thick)
    for pose in motion.world_from_tool:
        body.move(pose)
        assert not body.touches(wall)
    met = transforms.inverse(rod.world_from_object) @ at(motion, motion.times[-1]) @ tool_contact.object_from_contact
    assert met[0, 3] - 0.006 == pytest.approx(gap, abs=1e-6)
    assert (abs(met[1, 3]) > 0.001) == bump
