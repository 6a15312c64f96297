"""Where the tool is in the hand, by what is seen of it."""

import numpy as np
import pytest
import trimesh

from magic_core import shapes, transforms
from magic_core.mesh import from_trimesh
from magic_server.in_hand import BY_FINGERS, LET_GO, Deviation, Shape, clear_of, locate

EXPECTED = transforms.make(translation=[0.5, 0.1, 0.3]) @ transforms.from_rpy(0.1, 0.4, 1.0)
NOTHING = np.zeros((0, 3))


def seen(mesh, pose, rng, noise=0.0015, bias=(0.0, 0.0, 0.001)):
    """Points that two cameras, left and right above, see of a mesh at a pose: noisy, off a little as a whole, without what is hidden."""
    local, face = trimesh.sample.sample_surface(mesh.to_trimesh(), 3000, seed=int(rng.integers(1000)))
    local = np.asarray(local)
    normals = mesh.to_trimesh().face_normals[face] @ pose[:3, :3].T
    eyes = transforms.unit([-0.5, 0.6, 0.7]), transforms.unit([-0.5, -0.6, 0.7])
    shown = np.any([normals @ eye > 0.2 for eye in eyes], axis=0)
    return transforms.apply(pose, local[shown]) + rng.normal(0, noise, (shown.sum(), 3)) + np.asarray(bias)


def slipped(hand, shift, turn):
    """EXPECTED with the tool off in the hand: shift (3,) m and rotation vector (3,) rad, in the hand's frame, whose y closes."""
    return hand @ transforms.from_rotvec(turn, shift) @ transforms.inverse(hand) @ EXPECTED


@pytest.mark.parametrize("name", ["l_hook", "caliper", "spoon"])
@pytest.mark.parametrize("seed", range(4))
def test_a_slipped_tool_is_found_again(name, seed):
    rng = np.random.default_rng(seed)
    mesh = shapes.make(name, seed).mesh
    hand = EXPECTED @ transforms.make(translation=mesh.vertices[int(rng.integers(len(mesh.vertices)))])
    pose = slipped(hand, rng.uniform(-0.015, 0.015, 3) * [1, 0.1, 1], rng.uniform(-0.25, 0.25, 3) * [0.5, 1, 0.5])
    points = clear_of(hand, seen(mesh, pose, rng))
    found = locate(Shape.of(mesh, NOTHING), EXPECTED, points, hand, 1)
    off = Deviation.of(mesh, pose, found.world_from_tool)
    assert off.within(0.004, np.deg2rad(4)), f"{name} {seed}: {off}"
    assert found.distance < 0.004


def test_what_is_not_seen_stays_as_the_grasp_has_it():
    rod = from_trimesh(trimesh.creation.cylinder(0.006, 0.2))
    turned = EXPECTED @ transforms.from_rpy(0.0, 0.0, 0.6)  # about its own axis: nobody can see that
    points = seen(rod, transforms.make(translation=[0.0, 0.01, 0.0]) @ turned, np.random.default_rng(0), bias=(0, 0, 0))
    found = locate(Shape.of(rod, NOTHING), EXPECTED, points, EXPECTED, 0)
    assert found.world_from_tool[:3, 3] - EXPECTED[:3, 3] == pytest.approx([0.0, 0.01, 0.0], abs=0.002)
    assert transforms.rotation_angle(EXPECTED, found.world_from_tool) < 0.15


def test_a_tool_that_is_not_there_is_not_found():
    mesh = shapes.make("l_hook", 1).mesh
    rng = np.random.default_rng(0)
    lying = transforms.make(translation=[0.5, 0.1, 0.0])
    # The last: something is about it, but of another shape, a ball of points.
    ball = EXPECTED[:3, 3] + rng.normal(0, 0.04, (800, 3))
    for points in (NOTHING, np.full((500, 3), np.nan), seen(mesh, lying, rng), ball):
        assert locate(Shape.of(mesh, NOTHING), EXPECTED, points, EXPECTED, 1) is None


def test_what_was_seen_of_a_surface_is_the_surface():
    cube = from_trimesh(trimesh.creation.box([0.1, 0.1, 0.1]))
    rng = np.random.default_rng(0)
    # The top of the real one is 2 mm lower than the reconstruction has it; the rest was not seen.
    top = np.column_stack([rng.uniform(-0.05, 0.05, (20000, 2)), 0.048 + rng.normal(0, 0.0005, 20000)])
    shape = Shape.of(cube, top)
    up = shape.normals[:, 2] > 0.9
    assert np.median(shape.points[up, 2]) == pytest.approx(0.048, abs=0.0003)
    below = ~up & (shape.points[:, 2] < 0.045)
    assert np.abs(shape.points[below]).max(axis=1) == pytest.approx(0.05, abs=1e-9)


def test_far_from_the_fingers_an_error_of_what_is_seen_does_not_move_what_they_hold():
    """A bar that is held where it is expected, of which one end is seen, and that 2 mm to the side where it is nearer to the fingers."""
    bar = from_trimesh(trimesh.creation.box([0.24, 0.025, 0.025]))
    rng = np.random.default_rng(0)
    local = np.asarray(trimesh.sample.sample_surface(bar.to_trimesh(), 6000, seed=0)[0])
    local = local[(local[:, 0] > 0.05) & (local[:, 2] > -0.012)] + rng.normal(0, 0.001, 3)
    local[:, 1] += 0.002 * np.clip((0.09 - local[:, 0]) / 0.04, 0, 1)
    found = locate(Shape.of(bar, NOTHING), EXPECTED, transforms.apply(EXPECTED, local), EXPECTED, 1)
    off = Deviation.of(bar, EXPECTED, found.world_from_tool)
    assert off.within(0.002, np.deg2rad(2.0)), str(off)


def test_beside_the_fingers_nothing_is_believed():
    points = EXPECTED[:3, 3] + np.array([[0.9 * BY_FINGERS, 0, 0], [0, 1.1 * BY_FINGERS, 0]])
    assert clear_of(EXPECTED, points).tolist() == points[1:].tolist()


@pytest.mark.parametrize("seed", range(3))
def test_what_was_let_go_is_found_where_it_has_swung(seed):
    rng = np.random.default_rng(seed)
    mug = shapes.make("mug", 46).mesh
    swung = transforms.make(translation=rng.uniform(-0.012, 0.012, 3)) @ EXPECTED @ transforms.from_rpy(*rng.uniform(-0.12, 0.12, 3))
    hand = EXPECTED @ transforms.make(translation=mug.bounds[1])
    found = locate(Shape.of(mug, NOTHING), EXPECTED, seen(mug, swung, rng), hand, 1, LET_GO)
    off = Deviation.of(mug, swung, found.world_from_tool)
    assert off.within(0.004, np.deg2rad(4)), str(off)
