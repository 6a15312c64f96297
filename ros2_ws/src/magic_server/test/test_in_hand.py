"""Where the tool is in the hand, by what is seen of it."""

import numpy as np
import pytest
import trimesh

from magic_core import shapes, transforms
from magic_core.mesh import from_trimesh
from magic_server.in_hand import Deviation, locate

EXPECTED = transforms.make(translation=[0.5, 0.1, 0.3]) @ transforms.from_rpy(0.1, 0.4, 1.0)
CLOSING = EXPECTED[:3, 1]


def seen(mesh, pose, rng, noise=0.0015, hidden=lambda local: np.zeros(len(local), bool), bias=(0.0, 0.0, 0.001)):
    """Points that two cameras, left and right above, see of a mesh at a pose: noisy, off a little as a whole, without what is hidden."""
    local, face = trimesh.sample.sample_surface(mesh.to_trimesh(), 3000, seed=int(rng.integers(1000)))
    local = np.asarray(local)
    normals = mesh.to_trimesh().face_normals[face] @ pose[:3, :3].T
    eyes = transforms.unit([-0.5, 0.6, 0.7]), transforms.unit([-0.5, -0.6, 0.7])
    shown = np.any([normals @ eye > 0.2 for eye in eyes], axis=0) & ~hidden(local)
    return transforms.apply(pose, local[shown]) + rng.normal(0, noise, (shown.sum(), 3)) + np.asarray(bias)


def slipped(shift, turn):
    """EXPECTED with the tool off in the hand: shift (3,) m and turn rad about the closing axis, at the tool's middle."""
    about = transforms.make(translation=EXPECTED[:3, 3])
    return about @ transforms.from_rotvec(turn * CLOSING, shift) @ transforms.inverse(about) @ EXPECTED


@pytest.mark.parametrize("name", ["l_hook", "caliper", "spoon"])
@pytest.mark.parametrize("seed", range(4))
def test_a_slipped_tool_is_found_again(name, seed):
    rng = np.random.default_rng(seed)
    mesh = shapes.make(name, seed).mesh
    middle = mesh.bounds.mean(axis=0)
    pose = slipped(rng.uniform(-0.015, 0.015, 3), rng.uniform(-0.25, 0.25))
    held = mesh.vertices[int(rng.integers(len(mesh.vertices)))]
    found = locate(mesh, EXPECTED, seen(mesh, pose, rng, hidden=lambda p: np.linalg.norm(p - held, axis=1) < 0.025), CLOSING)
    off = Deviation.of(mesh, pose, found.world_from_tool)
    assert np.linalg.norm(transforms.apply(pose, middle) - transforms.apply(EXPECTED, middle)) > 0
    assert off.within(0.004, np.deg2rad(4)), f"{name} {seed}: {off}"
    assert found.distance < 0.004


def test_what_is_not_seen_stays_as_the_grasp_has_it():
    rod = from_trimesh(trimesh.creation.cylinder(0.006, 0.2))
    turned = EXPECTED @ transforms.from_rpy(0.0, 0.0, 0.6)  # about its own axis: nobody can see that
    points = seen(rod, transforms.make(translation=[0.0, 0.01, 0.0]) @ turned, np.random.default_rng(0), bias=(0, 0, 0))
    found = locate(rod, EXPECTED, points, CLOSING)
    assert found.world_from_tool[:3, 3] - EXPECTED[:3, 3] == pytest.approx([0.0, 0.01, 0.0], abs=0.002)
    assert transforms.rotation_angle(EXPECTED, found.world_from_tool) < 0.05


def test_a_tool_that_is_not_there_is_not_found():
    mesh = shapes.make("l_hook", 1).mesh
    rng = np.random.default_rng(0)
    assert locate(mesh, EXPECTED, np.zeros((0, 3)), CLOSING) is None
    assert locate(mesh, EXPECTED, np.full((500, 3), np.nan), CLOSING) is None
    lying = transforms.make(translation=[0.5, 0.1, 0.0])
    assert locate(mesh, EXPECTED, seen(mesh, lying, rng), CLOSING) is None
    # Something is about it, but of another shape: a ball of points.
    assert locate(mesh, EXPECTED, EXPECTED[:3, 3] + rng.normal(0, 0.04, (800, 3)), CLOSING) is None
