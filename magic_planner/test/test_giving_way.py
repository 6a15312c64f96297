"""Giving way to what stands fast: analytic walls, the way round a quarter pipe, and what cannot be done."""

from __future__ import annotations

import dataclasses

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.shapes import make
from magic_planner.collision import Body
from magic_planner.giving_way import GAP, GAP_IN_HAND, IN_PLANE, MOST, NEAR, WIDEST_GAP, Pieces, gap_of, give_way, nearest, separations
from magic_planner.object_motion import plan_tool_motion

FAR_BELOW = np.array([0.0, 0.0, 1.0, 5.0])
ACROSS = np.array([0.0, 1.0, 0.0])  # the plane of the displacement is x, z


def cube(half=0.02, name="tool"):
    return scenes.item(name, [scenes.box([2 * half] * 3)], np.eye(4))


def wall(extents, centre, name="wall"):
    return scenes.item(name, [scenes.box(extents)], transforms.make(translation=centre))


def line(start, end, count=60):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.linspace(start, end, count)
    return poses


def gave_way(path, tool, *walls, plane=FAR_BELOW, direction=ACROSS, clearance=0.001):
    found = give_way(path, tool, walls, direction, plane, clearance)
    bodies = [Body.from_object(w) for w in walls]
    body = Body(tool.id, tool.pieces)
    for pose in found:
        body.move(pose)
        assert not any(body.touches(b) for b in bodies)
    return found[:, :3, 3] - path[:, :3, 3], found


def test_a_clear_path_comes_back_as_it_is():
    path = line([0, 0, 0], [0.2, 0, 0])
    assert give_way(path, cube(), [wall([0.1, 0.1, 0.1], [0, 0.3, 0])], ACROSS, FAR_BELOW, 0.001) is path
    assert give_way(path, cube(), [], ACROSS, FAR_BELOW, 0.001) is path


def test_a_tool_led_square_into_a_wall_stops_before_it_and_no_further():
    shift, found = gave_way(line([0, 0, 0], [0.10, 0, 0]), cube(), wall([0.02, 0.2, 0.2], [0.09, 0, 0]))
    reach = found[-1, 0, 3] + 0.02
    assert reach == pytest.approx(0.08 - GAP, abs=1e-6)
    np.testing.assert_allclose(shift[:, 1], 0, atol=1e-12)
    np.testing.assert_allclose(shift[:, 2], 0, atol=1e-6)


def test_a_tool_led_askew_into_a_wall_slides_along_it():
    path = line([0, 0, 0], [0.09, 0, 0.09])
    _shift, found = gave_way(path, cube(), wall([0.02, 0.2, 0.6], [0.08, 0, 0]))
    np.testing.assert_allclose(found[:, 2, 3], path[:, 2, 3], atol=1e-6)
    assert found[-1, 0, 3] == pytest.approx(0.07 - 0.02 - GAP, abs=1e-6)
    assert np.all(np.diff(found[:, 0, 3]) > -1e-4), "it turns back before the wall"


@pytest.mark.parametrize("parts", [1, 4, 25])
def test_where_pieces_of_a_wall_abut_nothing_is_felt(parts):
    size = 0.5 / parts
    pieces = [scenes.box([0.02, 0.2, size], [0, 0, (n + 0.5) * size - 0.25]) for n in range(parts)]
    fence = scenes.item("wall", pieces, transforms.make(translation=[0.035, 0, 0]))
    path = line([-0.03, 0, -0.2], [0.03, 0, 0.2], 90)
    shift, found = gave_way(path, cube(), fence)
    assert found[:, 0, 3].max() == pytest.approx(0.025 - 0.02 - GAP, abs=1e-6)
    # The smoothing lets it begin early; along the wall it gives way by nothing but its own smoothness.
    assert np.abs(shift[:, 2]).max() < 1e-3


def test_a_thin_wall_is_not_passed_through():
    thin = wall([0.002, 0.2, 0.4], [0.05, 0, 0])
    shift, found = gave_way(line([0, 0, 0], [0.12, 0, 0.01], 40), cube(), thin)
    assert found[:, 0, 3].max() <= 0.049 - 0.02 - GAP + 1e-6
    assert shift[-1, 0] == pytest.approx(-(0.12 - 0.029 + GAP), abs=1e-4)


def test_a_tool_too_long_for_a_quarter_pipe_is_led_round_it_at_its_radius():
    """A bar turns about the pipe's axis with its tip outside the pipe: it has to give way along the radius by just that."""
    radius, beyond = 0.2, 0.012
    shape = make("quarter_pipe", 0, radius=radius, width=0.2, back=0.02, extent=np.pi / 2)
    pipe = shape.as_object("pipe", np.eye(4))
    half = np.array([0.005, 0.02, 0.03])
    bar = scenes.item("tool", [scenes.box(2 * half)], np.eye(4))
    # The distance of the bar's lower corners from the axis is radius + beyond.
    middle = np.sqrt((radius + beyond) ** 2 - half[0] ** 2) - half[2]
    surface = shape.region("arc")
    axis = (surface.points + radius * surface.normals).mean(axis=0)
    angles = np.linspace(np.deg2rad(14), np.deg2rad(70), 80)
    # It comes in from nearer the axis and is at its full length from 26 degrees on.
    drawn = (beyond + 0.004) * np.clip((np.deg2rad(26) - angles) / np.deg2rad(12), 0, 1)
    path = np.stack(
        [
            transforms.from_rpy(0, -a, 0, axis + (middle - d) * np.array([np.sin(a), 0, -np.cos(a)]))
            for a, d in zip(angles, drawn, strict=True)
        ]
    )
    shift, _found = gave_way(path, bar, pipe, plane=np.array([0, 0, 1.0, 1.0]))
    inside = (angles > np.deg2rad(30)) & (angles < np.deg2rad(68))
    radial = np.column_stack([np.sin(angles), 0 * angles, -np.cos(angles)])
    inward = -np.einsum("ij,ij->i", shift, radial)[inside]
    # The pipe is a polygon: its chords stand up to 0.1 mm inside the circle.
    assert inward.min() > beyond - 0.5e-3
    assert inward.max() < beyond + GAP + 1.5e-3
    along = np.linalg.norm(shift[inside] + inward[:, None] * radial[inside], axis=1)
    assert along.max() < 2.5e-3, "it drags along the pipe"
    assert np.linalg.norm(np.diff(shift, axis=0), axis=1).max() <= NEAR / IN_PLANE


def test_it_stays_in_the_plane_of_the_contact():
    shift, _ = gave_way(line([0, 0, 0], [0.1, 0, 0]), cube(), wall([0.02, 0.05, 0.06], [0.06, 0.012, 0]), direction=ACROSS)
    np.testing.assert_allclose(shift[:, 1], 0, atol=1e-12)
    shift, _ = gave_way(line([0, 0, 0], [0.1, 0, 0]), cube(), wall([0.02, 0.05, 0.06], [0.06, 0.012, 0]), direction=np.array([0, 0, 1.0]))
    np.testing.assert_allclose(shift[:, 2], 0, atol=1e-12)


def test_the_table_bounds_it_too():
    table = np.array([0.0, 0.0, 1.0, 0.0])
    ceiling = wall([0.04, 0.2, 0.04], [0.1, 0, 0.055])  # 35 mm above the table, the tool is 40 mm tall
    with pytest.raises(MagicError) as error:
        give_way(line([0, 0, 0.021], [0.25, 0, 0.021]), cube(), [ceiling], ACROSS, table, 0.001, lambda i: f"place {i}")
    assert error.value.code == Code.PATH_IN_COLLISION
    assert "tool and wall" in str(error.value) and "place" in str(error.value)


def test_further_than_allowed_is_refused_with_the_place_and_the_pair():
    with pytest.raises(MagicError) as error:
        give_way(line([0, 0, 0], [0.4, 0, 0]), cube(), [wall([0.1, 0.4, 0.8], [0.1, 0, 0])], ACROSS, FAR_BELOW, 0.001)
    assert error.value.code == Code.PATH_IN_COLLISION
    assert f"{1000 * MOST:.0f} mm" in str(error.value)


def test_least_distance_against_known_answers():
    one = nearest(np.zeros(2), np.array([[1.0, 0.0]]), np.array([0.3]))
    np.testing.assert_allclose(one, [0.3, 0], atol=1e-9)
    corner = nearest(np.zeros(2), np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([0.3, 0.4]))
    np.testing.assert_allclose(corner, [0.3, 0.4], atol=1e-9)
    idle = nearest(np.array([1.0, 0.0]), np.array([[1.0, 0.0]]), np.array([0.3]))
    np.testing.assert_array_equal(idle, [1.0, 0.0])
    assert nearest(np.zeros(2), np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0.1, 0.1])) is None


def test_separations_of_two_boxes_are_their_gaps():
    a, b = Pieces.of([scenes.box([0.1, 0.1, 0.1])]), Pieces.of([scenes.box([0.1, 0.1, 0.1], [0.13, 0, 0])])
    gaps, away = separations(a, np.eye(4), b, np.array([0]), np.array([0]))
    assert gaps.max() == pytest.approx(0.03)
    assert away[0, gaps[0].argmax()] == pytest.approx([-1, 0, 0])


def test_a_planned_motion_gives_way_to_an_obstacle_and_keeps_clear_of_it():
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    strategy, candidate = scenes.pulling(), scenes.candidate(tool, tool_contact, target_contact)
    free = plan_tool_motion(strategy, tool, target, candidate)
    beside = free.world_from_tool[:, 1, 3].min() - 0.01  # the handle's side is at -10 mm
    # A post that the handle's flank meets on the way, 6 mm deep.
    post = scenes.item("post", [scenes.box([0.02, 0.04, 0.2])], transforms.make(translation=[0.22, beside + 0.006 - 0.02, 0.1]))
    motion = plan_tool_motion(strategy, tool, target, candidate, obstacles=(post,))
    tool_body, post_body = Body("tool", tool.pieces), Body.from_object(post)
    touched = 0
    for before, pose in zip(free.world_from_tool, motion.world_from_tool, strict=True):
        tool_body.move(before)
        touched += tool_body.touches(post_body)
        tool_body.move(pose)
        assert not tool_body.touches(post_body)
    assert touched > 0
    shift = (motion.world_from_tool - free.world_from_tool)[:, :3, 3]
    assert np.abs(shift[:, 2]).max() < 1e-9, "it leaves the table's plane, in which the contact lies"
    assert 0.006 < np.linalg.norm(shift, axis=1).max() < 0.012
    np.testing.assert_array_equal(motion.times, free.times)


def test_a_start_in_an_obstacle_is_refused_and_not_mended():
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    candidate = scenes.candidate(tool, tool_contact, target_contact)
    free = plan_tool_motion(scenes.pulling(), tool, target, candidate)
    block = dataclasses.replace(wall([0.05, 0.05, 0.05], free.world_from_tool[0, :3, 3]), id="block")
    with pytest.raises(MagicError) as error:
        plan_tool_motion(scenes.pulling(), tool, target, candidate, obstacles=(block,))
    assert error.value.code == Code.PATH_IN_COLLISION and "block" in str(error.value)


def test_a_tool_that_is_badly_known_keeps_farther_off():
    tool = cube()
    assert gap_of(tool, "fg") == GAP and gap_of(tool, "arm") == GAP_IN_HAND
    assert gap_of(dataclasses.replace(tool, surface_error=0.002), "arm") == pytest.approx(GAP_IN_HAND + 0.002)
    assert gap_of(dataclasses.replace(tool, surface_error=0.05), "arm") == WIDEST_GAP < NEAR
    # It passes a wall that is as far below its way as that.
    floor = wall([0.4, 0.1, 0.02], [0.15, 0.0, -0.032])
    for off in (0.0, 0.002):
        off_by = dataclasses.replace(tool, surface_error=off)
        path = give_way(line([-0.3, 0, -0.001], [0.5, 0, -0.001]), off_by, [floor], ACROSS, FAR_BELOW, 0.001, gap=gap_of(off_by, "arm"))
        assert path[len(path) // 2, 2, 3] - 0.02 - -0.022 == pytest.approx(GAP_IN_HAND + off, abs=3e-4)
