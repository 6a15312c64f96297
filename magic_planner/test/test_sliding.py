"""The contact that slides along the tool: outlines known exactly, and tools that would not fit above the table."""

from __future__ import annotations

import dataclasses

import numpy as np
import planner_scenes as scenes
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import mesh as mesh_module
from magic_core import transforms
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_planner.collision import Body
from magic_planner.sliding import FURTHEST, SLACK, STEEPEST, STEP, lowest, outline, slid_contacts

TABLE = np.array([0.0, 0.0, 1.0, 0.0])
CLEARANCE = 0.001
#: A contact frame whose normal points along -y of the world and whose tangent points down, as a scoop's that moves along -y.
FACING = transforms.frame(np.zeros(3), [0, -1.0, 0], [1.0, 0, 0])


def plate(above: float, below: float) -> SceneObject:
    """An upright plate in the plane y = 0, its face to -y; the contact at the origin, so much of it above and below."""
    piece = scenes.box([0.06, 0.01, above + below], [0, 0.005, (above - below) / 2])
    return scenes.item("plate", [piece], np.eye(4))


def shell(radius: float, half_angle: float) -> SceneObject:
    """A trough: part of a cylinder's inside about an axis along x, its middle at the origin, opening to -y."""
    angle = np.linspace(-half_angle, half_angle, 181)
    rows = [np.column_stack([r * np.cos(angle) - radius, r * np.sin(angle)]) for r in (radius, radius + 0.004)]
    polygon = np.concatenate([rows[0], rows[1][::-1]])
    mesh = trimesh.creation.extrude_polygon(shapely.Polygon(polygon), 0.05)
    # The polygon's axes become y and z, its height x.
    return scenes.item(
        "trough", [mesh_module.from_trimesh(mesh).transformed(transforms.frame([-0.025, 0, 0], [0, 1.0, 0], [1.0, 0, 0]))], np.eye(4)
    )


def upright(heights) -> np.ndarray:
    """world_from_contact (T, 4, 4): the contact at these heights above the table, moving along -y."""
    poses = np.tile(FACING, (len(heights), 1, 1))
    poses[:, 1, 3] = -0.005 * np.arange(len(heights))
    poses[:, 2, 3] = heights
    return poses


def led(tool, frames, path):
    return path @ transforms.inverse(frames)


def test_the_outline_of_a_plate_is_its_face():
    down, up = outline(plate(0.05, 0.1), FACING)
    for points, reach in ((up, 0.05), (down, 0.1)):
        np.testing.assert_allclose(points[:, 0], 0, atol=1e-12)
        assert np.abs(points[:, 1]).max() == pytest.approx(reach, abs=1.01 * STEP)


@settings(max_examples=20, deadline=None)
@given(radius=st.floats(0.03, 0.2))
def test_the_outline_of_a_trough_is_its_circle_as_far_as_it_is_not_steep(radius):
    for points in outline(shell(radius, 1.4), FACING):
        y = points[:, 1]
        np.testing.assert_allclose(points[:, 0], radius - np.sqrt(radius**2 - y**2), atol=3e-4 * radius / 0.03)
        # sin of the angle at which it ends; a step may lead across it, and a flat of the circle is as steep all along.
        steepest, flat = radius * STEEPEST / np.hypot(1, STEEPEST), radius * 2 * 1.4 / 180
        assert min(steepest - 3 * STEP - flat, FURTHEST - STEP) <= np.abs(y).max() <= steepest + STEP + flat


def test_an_outline_begins_only_near_the_surface():
    far = FACING @ transforms.make(translation=[2 * SLACK, 0, 0])
    assert all(len(points) == 1 for points in outline(plate(0.05, 0.1), far))


def test_pieces_serve_where_there_is_no_mesh():
    tool = plate(0.05, 0.1)
    bare = dataclasses.replace(tool, mesh=Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)))
    for ours, theirs in zip(outline(bare, FACING), outline(tool, FACING), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_with_room_the_frame_stays_what_it_was():
    frames = slid_contacts(plate(0.1, 0.03), FACING, upright(np.full(20, 0.04)), (), TABLE, CLEARANCE)
    np.testing.assert_array_equal(frames, np.tile(FACING, (20, 1, 1)))


@pytest.mark.parametrize("height", [0.015, 0.035, 0.06])
def test_a_plate_that_reaches_too_low_meets_the_target_with_its_lower_part(height):
    tool, path = plate(0.1, 0.09), upright(np.full(20, height))
    frames = slid_contacts(tool, FACING, path, (), TABLE, CLEARANCE)
    np.testing.assert_allclose(frames[:, :3, :3], path[:, :3, :3])
    np.testing.assert_allclose(frames[:, 1, 3], 0, atol=1e-9)  # on the face
    gaps = lowest(TABLE, led(tool, frames, path), tool.pieces[0].vertices)
    assert np.all(gaps >= CLEARANCE - 1e-9) and np.all(gaps < CLEARANCE + STEP)


def test_a_trough_meets_the_target_with_its_surface_and_not_before_it():
    tool, path = shell(0.1, 0.9), upright(np.full(20, 0.03))
    frames = slid_contacts(tool, FACING, path, (), TABLE, CLEARANCE)
    origin = frames[0, :3, 3]
    assert origin[2] < -0.04, "no slide was needed"
    assert np.hypot(origin[1] + 0.1, origin[2]) == pytest.approx(0.1, abs=5e-4)


def test_a_slide_ends_where_there_is_room_again_and_is_nowhere_sudden():
    heights = np.concatenate([np.full(20, 0.03), np.linspace(0.03, 0.16, 40), np.full(60, 0.16)])
    tool, path = plate(0.1, 0.09), upright(heights)
    frames = slid_contacts(tool, FACING, path, (), TABLE, CLEARANCE)
    poses = led(tool, frames, path)
    assert lowest(TABLE, poses, tool.pieces[0].vertices).min() >= CLEARANCE - 1e-9
    np.testing.assert_allclose(frames[-1], FACING, atol=1e-12)
    slide = np.linalg.norm(frames[:, :3, 3], axis=1)
    steps = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    assert np.all(np.abs(np.diff(slide)) <= 2.0 * steps.max())


def test_before_a_wall_the_tool_draws_back_along_itself():
    """A plate turned level, its lower end ahead, led along -y towards an upright wall."""
    tool = plate(0.1, 0.09)
    wall = scenes.item("wall", [scenes.box([0.3, 0.02, 0.6])], transforms.make(translation=[0, -0.21, 0.3]))
    count = 40
    path = np.tile(transforms.frame(np.zeros(3), [0, 0, 1.0], [1.0, 0, 0]), (count, 1, 1))
    path[:, 1, 3], path[:, 2, 3] = np.linspace(0, -0.15, count), 0.3
    frames = slid_contacts(tool, FACING, path, (wall,), TABLE, CLEARANCE)
    poses, body, fixed = led(tool, frames, path), Body("plate", tool.pieces), Body.from_object(wall)
    for pose in poses:
        body.move(pose)
        assert not body.touches(fixed)
    np.testing.assert_allclose(poses[:, 2, 3], led(tool, FACING, path)[:, 2, 3], atol=1e-9)  # not raised
    np.testing.assert_allclose(frames[0], FACING, atol=1e-12)


def test_where_no_slide_makes_room_nothing_slides():
    """The table is across the outline: a plate that lies too low cannot slide out of it."""
    path = np.tile(transforms.frame(np.zeros(3), [0, -1.0, 0], [0, 0, 1.0]), (10, 1, 1))
    path[:, 1, 3] = -0.005 * np.arange(10)
    tool = scenes.item("flat", [scenes.box([0.2, 0.01, 0.06], [0, 0.005, 0])], np.eye(4))
    frame = transforms.frame(np.zeros(3), [0, -1.0, 0], [0, 0, 1.0])
    frames = slid_contacts(tool, frame, path, (), TABLE, CLEARANCE)
    np.testing.assert_array_equal(frames, np.tile(frame, (10, 1, 1)))
