"""Antipodal grasps: what they are on bodies whose answers are known."""

from __future__ import annotations

import itertools

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_planner.budget import Budget
from magic_planner.collision import Body, hull, mass_centre
from magic_planner.grasps import (
    GraspSettings,
    Patches,
    _centred,
    _misfit,
    _Terms,
    antipodal,
    collision_free,
    in_the_way,
    pad_profiles,
    propose,
)

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


def pairs(pieces, **changes):
    return antipodal(pieces, 0.08, GraspSettings(**changes), np.random.default_rng(0))


def test_a_box_is_gripped_across_its_narrow_sides():
    centres, closing, widths = pairs([scenes.box([0.2, 0.03, 0.05])])
    assert len(widths)
    assert set(np.round(widths, 6)) == {0.03, 0.05}  # 0.2 m does not fit into the hand
    across = np.isclose(widths, 0.03)
    np.testing.assert_allclose(np.abs(closing[across]), np.tile([0, 1.0, 0], (across.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(centres[across, 1], 0, atol=1e-9)


def test_a_cylinder_is_gripped_through_its_axis():
    centres, closing, widths = pairs([scenes.cylinder(0.02, 0.15)])
    assert len(widths) > 100
    np.testing.assert_allclose(widths, 0.04, atol=5e-4)
    assert np.abs(closing[:, 2]).max() < 1e-6
    assert np.linalg.norm(centres[:, :2], axis=1).max() < 0.0045  # of 32 facets, each 3.9 mm wide


def test_pieces_that_abut_are_one_body():
    halves = [scenes.box([0.1, 0.03, 0.03], [0.05, 0, 0]), scenes.box([0.1, 0.03, 0.03], [-0.05, 0, 0])]
    _, closing, widths = pairs(halves)
    np.testing.assert_allclose(widths, 0.03, atol=1e-9)
    assert np.abs(closing[:, 0]).max() < 1e-6  # nothing grips the faces between them
    stacked = [scenes.box([0.2, 0.03, 0.02], [0, 0, 0.01]), scenes.box([0.2, 0.03, 0.02], [0, 0, -0.01])]
    assert set(np.round(pairs(stacked)[2], 6)) == {0.03, 0.04}


def test_a_fork_is_gripped_by_both_prongs():
    """Fingers open wider than the gap do not get in between: to close on one prong one of them would push the other."""
    prongs = [scenes.box([0.2, 0.008, 0.02], [0, y, 0]) for y in (-0.014, 0.014)]
    _, closing, widths = pairs([*prongs, scenes.box([0.02, 0.02, 0.02], [-0.09, 0, 0])])
    across = np.abs(closing[:, 1]) > 0.99
    assert across.any()
    np.testing.assert_allclose(widths[across], 0.036, atol=1e-9)
    apart = [scenes.box([0.2, 0.008, 0.02], [0, y, 0]) for y in (-0.05, 0.05)]
    widths = pairs(apart)[2]
    assert np.isclose(widths, 0.008).any() and widths.max() < 0.021, "a prong alone, where the other is not between the fingers"


def test_slanted_faces_count_only_as_far_as_the_normals_agree():
    wedge = scenes.box([0.1, 0.04, 0.04])
    vertices = wedge.vertices.copy()
    vertices[:, 1] *= np.where(vertices[:, 2] > 0, 0.2, 1.0)  # sides 21.8 degrees from the upright
    wedge = type(wedge)(vertices, wedge.faces)
    sides = [np.abs(c[:, 1]).max() > 0.9 if len(c) else False for c in (pairs([wedge], agreement=a)[1] for a in (0.95, 0.7))]
    assert sides == [False, True]


def test_the_mass_of_pieces_and_the_outward_faces_of_hulls():
    pieces = [scenes.box([0.1, 0.1, 0.1], [0.05 + 0.1 * k, 0, 0]) for k in range(12)]
    volume, centre = mass_centre(pieces)
    assert volume == pytest.approx(0.012)
    np.testing.assert_allclose(centre, [0.6, 0, 0], atol=1e-9)
    vertices, faces = hull(pieces[0].vertices)
    corners = vertices[faces]
    assert np.all(
        np.einsum("ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1) - [0.05, 0, 0])
        > 0
    )


def test_a_hand_stays_above_the_table_and_out_of_the_tool(arm):
    tool, tool_contact = scenes.hook(thickness=0.01)
    poses = np.stack([tool.world_from_object, transforms.make(translation=[0.5, 0, 0.1]) @ tool.world_from_object])
    grasps = propose(arm.robot, tool, tool_contact.object_from_contact, TABLE, poses, GraspSettings(), 0)
    assert grasps
    corners = np.concatenate([m.vertices for m in arm.robot.hand.values()])
    for grasp in grasps:
        low = transforms.apply(tool.world_from_object @ grasp.tool_from_tcp, corners)[:, 2].min()
        assert low > 0.0014
        # Where the pads' middle is moved over what they touch the hand may come a little nearer.
        away = np.linalg.norm(grasp.tool_from_tcp[:3, 3] - tool_contact.object_from_contact[:3, 3])
        assert away > GraspSettings().away - 0.01
    free = list(itertools.islice(collision_free(arm.robot, grasps, tool, [], {}, Budget()), 20))
    hand, held = arm.robot.hand_body(), Body("tool", tool.pieces)
    assert free
    for grasp in free:
        hand.move(grasp.tool_from_tcp)
        assert not hand.touches(held)


def test_bodies_touch_where_they_share_a_point_and_only_there():
    bar, ball = Body("bar", [scenes.cylinder(0.01, 0.2)]), Body("ball", [scenes.box([0.02, 0.02, 0.02])])
    for gap, touch in ((0.0005, False), (-0.0005, True)):
        ball.move(transforms.make(translation=[0.02 + gap, 0, 0.05]))
        assert bar.touches(ball) is touch and ball.touches(bar) is touch
    ball.move(transforms.make(translation=[0, 0, 0.02]))
    assert bar.touches(ball)
    big = Body("big", [scenes.box([0.3, 0.3, 0.3]), scenes.box([0.1, 0.1, 0.1], [0.5, 0, 0])])
    assert big.touches(ball) and ball.touches(big)  # wholly inside, no surface meets another
    ball.move(transforms.make(translation=[0.3, 0, 0.0]))
    assert not big.touches(ball) and not ball.touches(big)


def test_a_long_piece_of_many_corners_between_open_fingers_is_free(arm):
    # FCL's convex geometries of more than 32 vertices reported this one as touching a finger 3 cm away.
    angle = np.pi / 2 + np.linspace(0, np.pi, 17)
    outline = np.concatenate([[[0.097, 0.009], [0.097, -0.009]], [[-0.1317, 0.0]] + 0.009 * np.stack([np.cos(angle), np.sin(angle)], 1)])
    vertices = np.concatenate([np.column_stack([outline, np.full(len(outline), z)]) for z in (-0.0075, 0.0075)])
    held, hand = Body("bar", [Mesh(*hull(vertices))]), arm.robot.hand_body()
    for x in np.linspace(-0.08, 0.08, 17):
        for z in (0.0, 0.002, 0.005):
            hand.move(transforms.from_rpy(np.pi, 0, 0, [x, 0, z]))
            assert not hand.touches(held)
    hand.move(transforms.from_rpy(np.pi, 0, 0, [0, 0.04, 0]))
    assert hand.touches(held)


def test_pads_that_meet_flat_opposite_faces_are_preferred(arm):
    frame = np.eye(4)[None]
    widths = np.array([0.02])
    bar = scenes.box([0.2, 0.02, 0.02])
    heights, grid = pad_profiles(arm.robot, frame, [bar])
    on = np.abs(grid[..., 1]) < 0.01
    np.testing.assert_allclose(heights[0][on], 0.01)
    flat = _misfit(arm.robot, frame, widths, [bar])[0]
    assert flat < 0.05
    ledge = _misfit(arm.robot, frame, widths, [bar, scenes.box([0.004, 0.06, 0.02], [0.007, 0, 0])])[0]  # meets the pads 2 cm too early
    askew = _misfit(arm.robot, transforms.from_rpy(0, 0, np.deg2rad(15))[None], widths, [bar])[0]
    end = _misfit(arm.robot, transforms.make(translation=[0.103, 0, 0])[None], widths, [bar])[0]  # the pads hang over the bar's end
    assert ledge > 2 and askew > 0.4 and end > 0.15
    assert _misfit(arm.robot, transforms.make(translation=[0.3, 0, 0])[None], widths, [bar])[0] == np.inf


def test_patches_are_as_large_as_what_the_pads_touch(arm):
    frame = np.eye(4)[None]
    whole = Patches.of(arm.robot, frame, [scenes.box([0.2, 0.02, 0.1])])
    line = Patches.of(arm.robot, frame, [scenes.box([0.2, 0.02, 0.002])])
    point = Patches.of(arm.robot, frame, [scenes.box([0.002, 0.02, 0.002])])
    assert whole.there.all() and whole.contact.all()
    arms = [float(p.spans()[0][0]) for p in (whole, line, point)]
    assert arms[0] == pytest.approx(0.0085, abs=0.002)  # the mean distance from the middle of a rectangle of 17.6 by 17 mm
    assert arms[1] == pytest.approx(0.0055, abs=0.0015)  # of a line of 17.6 mm: a quarter of it, and a bit for its breadth
    assert arms[2] < 0.001
    assert point.spans()[1].max() < 0.002 < line.spans()[1][0, 0]
    assert not Patches.of(arm.robot, transforms.make(translation=[0, 0, 0.3])[None], [scenes.box([0.2, 0.02, 0.02])]).there.any()


def test_a_grip_by_the_edge_of_the_pads_is_moved_to_their_middle(arm):
    bar = [scenes.box([0.2, 0.02, 0.004])]
    frames = np.stack([np.eye(4), transforms.make(translation=[0, 0, -0.006])])
    moved, shift = _centred(arm.robot, frames, bar)
    np.testing.assert_allclose(moved[:, 2, 3], 0, atol=0.0025)
    assert shift[0] < 0.0025 < 0.003 < shift[1]
    np.testing.assert_allclose(moved[:, :2, 3], 0, atol=1e-6)
    assert _misfit(arm.robot, moved[1:], np.array([0.02]), bar)[0] < _misfit(arm.robot, frames[1:], np.array([0.02]), bar)[0]


def test_a_grip_that_one_pad_would_begin_is_moved_to_where_both_meet_the_tool(arm):
    bar = [scenes.box([0.2, 0.02, 0.02])]
    frames = np.stack([transforms.make(translation=aside * arm.robot.closing) for aside in (0.0, 0.006, -0.009)])
    moved, shift = _centred(arm.robot, frames, bar)
    np.testing.assert_allclose(moved[:, :3, 3] @ arm.robot.closing, 0, atol=1e-6)
    np.testing.assert_allclose(shift, [0, 0.006, 0.009], atol=1e-6)


def test_what_the_edge_of_the_pads_holds_is_lost_by_a_small_shift(arm):
    tall, flat = [scenes.box([0.2, 0.02, 0.1])], [scenes.box([0.2, 0.02, 0.003])]
    reach = arm.robot.tip_reach
    frames = np.stack([np.eye(4), transforms.make(translation=[0, 0, -reach + 0.001])])  # the second by the very tips
    assert Patches.of(arm.robot, frames[:1], tall).secure()[0] == 1.0
    middle, tips = Patches.of(arm.robot, frames, flat).secure()
    assert middle > 0.7 and tips == 0.0
    misfit = _misfit(arm.robot, frames, np.array([0.02, 0.02]), flat)
    assert misfit[1] > misfit[0] + 5


def test_a_flat_tool_is_gripped_as_deep_as_the_table_lets_the_fingers(arm):
    """A bar 7 mm high on the table: whatever the height of a sampled point, level fingers reach down to the table."""
    bar = scenes.item("bar", [scenes.box([0.2, 0.02, 0.007])], transforms.from_rpy(0.05, 0, 0, [0.5, 0, 0.0045]))
    contact = transforms.make(translation=[0.1, 0, 0])
    grasps = propose(arm.robot, bar, contact, TABLE, bar.world_from_object[None], GraspSettings(), 0)
    tips = np.array([0.0, 0, arm.robot.tip_reach])
    for grasp in grasps[:5]:
        hand = bar.world_from_object @ grasp.tool_from_tcp
        assert abs(hand[2, 1]) < 1e-6, "level"
        assert transforms.apply(hand, tips)[2] < 0.003, "down to the table"


def test_what_the_pads_are_asked_to_hold_is_weight_and_lever(arm):
    """A bar of known mass held level at a known distance from its middle: force and torque by hand."""
    bar = [scenes.box([0.4, 0.02, 0.02])]
    settings = GraspSettings(density=1000.0, force=0.0, grip_force=50.0, friction=0.5)
    contact = transforms.make(translation=[0.2, 0, 0])
    terms = _Terms(bar, contact, np.eye(4)[None], TABLE, arm.robot, settings)
    weight = 0.4 * 0.02 * 0.02 * 1000 * 9.81
    spans = np.array([0.008]), np.array([[0.009, 0.009]])
    held = np.stack([transforms.from_rpy(np.pi, 0, 0, [x, 0, 0]) for x in (0.0, 0.1)])
    used = terms.used(arm.robot, held, np.repeat(spans[0], 2), np.repeat(spans[1], 2, axis=0))
    assert used[0] == pytest.approx(weight / (2 * 0.5 * 50))
    # The lever lies across the closing axis (y), so the torque is about it: friction in the patches holds it.
    assert used[1] == pytest.approx(weight / (2 * 0.5 * 50) + 0.1 * weight / (2 * 0.5 * 50 * 0.008))
    upright = np.stack([transforms.from_rpy(0, -np.pi / 2, 0)])
    terms = _Terms(bar, contact, upright, TABLE, arm.robot, settings)
    assert terms.used(arm.robot, held[1:], *spans)[0] == pytest.approx(weight / (2 * 0.5 * 50)), "hung from above, no lever is left"


def test_points_in_the_hand_are_found_and_points_between_the_fingers_are_not(arm):
    frames = np.eye(4)[None]
    nothing = np.zeros((0, 3))
    assert not in_the_way(arm.robot, frames, np.array([[0.0, 0, 0]]), nothing, 0.08)[0]
    assert in_the_way(arm.robot, frames, np.array([[0.0, 0.05, 0]]), nothing, 0.08)[0]
    behind = np.array([[0.0, 0, -0.18]])  # where the hand was on its way
    assert not in_the_way(arm.robot, frames, behind, nothing, 0.08)[0]
    assert in_the_way(arm.robot, frames, nothing, behind, 0.08)[0]


def test_what_does_not_fit_is_said(arm):
    _, tool_contact = scenes.hook()
    brick = scenes.item("brick", [scenes.box([0.2, 0.2, 0.2])], transforms.make(translation=[0.5, 0, 0.1]))
    with pytest.raises(MagicError, match="0.074 m apart") as raised:
        propose(arm.robot, brick, tool_contact.object_from_contact, TABLE, brick.world_from_object[None], GraspSettings(), 0)
    assert raised.value.code == Code.NO_GRASP
    sheet = scenes.item("sheet", [scenes.box([0.2, 0.1, 0.002])], transforms.make(translation=[0.5, 0, 0.001]))
    with pytest.raises(MagicError) as raised:
        propose(arm.robot, sheet, tool_contact.object_from_contact, TABLE, sheet.world_from_object[None], GraspSettings(), 0)
    assert raised.value.code == Code.NO_GRASP
