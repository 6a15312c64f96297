"""A mesh is mended by measured points, while where it is may be a little off."""

import numpy as np
import open3d as o3d
import pytest
import trimesh

from magic_core import transforms
from magic_core.mesh import from_trimesh
from magic_perception.reshaped import CLOSE, Aside, Picture, Reshaping, divided, met, raycaster

EYES = np.array([[0.5, 0.45, 0.6], [0.5, -0.45, 0.6]])
NOTHING = Aside(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
#: The tool's own pose is known while it lies, and hardly later.
LYING, MOVED = (np.diag(np.repeat([s, 10 * s], 3) ** -2.0) for s in (0.0003, 0.02))


def measured(true, pose, eye, rng):
    """Points that a camera measures of a thing, in the world."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(true.vertices.astype(np.float32)), o3d.core.Tensor(true.faces.astype(np.uint32)))
    source = transforms.apply(transforms.inverse(pose), eye)
    rays = np.concatenate([np.tile(source, (2000, 1)), rng.uniform(-0.05, 0.05, (2000, 3)) - source], axis=1).astype(np.float32)
    far = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    hit = np.isfinite(far)
    points = transforms.apply(pose, rays[hit, :3] + far[hit, None] * rays[hit, 3:])
    return points[rng.permutation(len(points))[:700]] + rng.normal(0, 0.001, (min(len(points), 700), 3))


def mended(model, true, turned, rng):
    """The model, and as a piece of itself, after a moment in which it lies and those in which it is turned (N, 4, 4), then 3 mm from where
    it is thought to be."""
    mesh = from_trimesh(model)
    points, face = trimesh.sample.sample_surface(model, 500, seed=1)
    reshaping = Reshaping(mesh, np.asarray(points), np.asarray(model.face_normals[face]))
    for k, pose in enumerate([np.eye(4)] * 5 + list(turned)):
        shown = [Picture(measured(true, pose, eye, rng), eye, NOTHING) for eye in EYES]
        aside = transforms.make(translation=[0.003, 0, 0]) if k >= 5 else np.eye(4)
        reshaping.see(shown, aside @ pose, np.zeros(3), LYING if k < 5 else MOVED)
    found, (piece,) = reshaping.mended([from_trimesh(model.subdivide().subdivide())])
    return found, piece


@pytest.mark.parametrize("off", [-0.002, 0.002])
def test_a_ball_of_the_wrong_size_is_not_taken_for_one_elsewhere(off):
    rng = np.random.default_rng(0)
    true, model = (trimesh.creation.icosphere(3, radius) for radius in (0.03, 0.03 + off))
    turned = [transforms.make(translation=[0.0, 0.02 * k, 0.05]) @ transforms.from_rpy(0.5 * k, 0.4 * k, 0) for k in range(12)]
    radii = np.linalg.norm(mended(model, true, turned, rng)[0].vertices, axis=1)
    assert abs(radii.mean() - 0.03) < 0.4 * abs(off) and radii.std() < 0.0005


def test_what_was_hidden_as_it_lay_is_seen_as_it_turns():
    rng = np.random.default_rng(0)
    model = trimesh.creation.box([0.08, 0.05, 0.03])
    true = model.copy()
    true.vertices[true.vertices[:, 2] < 0, 2] -= 0.003  # its lower side
    turned = [transforms.from_rpy(0.15 * k, 0, 0.1 * k) for k in range(21)]
    found, piece = mended(model, true, turned, rng)
    below = (np.abs(found.vertices[:, :2]) < [0.03, 0.015]).all(axis=1) & (found.vertices[:, 2] < 0)
    above = (np.abs(found.vertices[:, :2]) < [0.03, 0.015]).all(axis=1) & (found.vertices[:, 2] > 0)
    # How thick it is hangs on the moments in which one camera sees it from above and the other from below.
    assert found.vertices[below, 2].mean() < -0.0157
    assert found.vertices[above, 2].mean() == pytest.approx(0.015, abs=0.0003)
    assert found.to_trimesh().is_watertight  # its long sides were divided first
    np.testing.assert_allclose(piece.bounds, found.bounds, atol=0.0005)  # what physics takes it for


def test_a_thin_wall_does_not_grow_by_the_sensor_s_noise():
    """2 mm along the rays, of a wall of 3 mm: what is measured behind its middle is of the side in sight as well."""
    rng = np.random.default_rng(0)
    model = trimesh.creation.box([0.08, 0.05, 0.003])
    points, face = trimesh.sample.sample_surface(model, 500, seed=1)
    reshaping = Reshaping(from_trimesh(model), np.asarray(points), np.asarray(model.face_normals[face]))
    for _ in range(10):
        shown = []
        for eye in EYES:
            seen = measured(model, np.eye(4), eye, rng)
            rays = (seen - eye) / np.linalg.norm(seen - eye, axis=1)[:, None]
            shown.append(Picture(seen + rng.normal(0, 0.002, (len(seen), 1)) * rays, eye, NOTHING))
        reshaping.see(shown, np.eye(4), np.zeros(3), LYING)
    vertices = reshaping.mended()[0].vertices
    above = (np.abs(vertices[:, :2]) < [0.03, 0.015]).all(axis=1) & (vertices[:, 2] > 0)
    assert vertices[above, 2].mean() == pytest.approx(0.0015, abs=0.0001)


def test_what_is_mended_twice_takes_its_pieces_along():
    rng = np.random.default_rng(0)
    true, model = (trimesh.creation.icosphere(3, radius) for radius in (0.03, 0.027))
    pieces, first = [from_trimesh(model)], None
    mesh = pieces[0]
    for _ in range(2):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        first = Reshaping(mesh, solid.triangles_center[::3], solid.face_normals[::3], first)
        for _ in range(5):
            first.see(
                [Picture(measured(true, np.eye(4), eye, rng), eye, NOTHING) for eye in [*EYES, *-EYES]], np.eye(4), np.zeros(3), LYING
            )
        mesh, (piece,) = first.mended(pieces)
    np.testing.assert_allclose(piece.bounds, mesh.bounds, atol=0.0005)
    assert np.linalg.norm(mesh.vertices, axis=1).mean() == pytest.approx(0.03, abs=0.0005)


def test_the_depth_of_a_rim_over_the_hollow_behind_it_is_of_neither():
    """Of a box with a plate over half of it: a camera above measures the plate's depth some way past its edge."""
    box, plate = trimesh.creation.box([0.08, 0.05, 0.01]), trimesh.creation.box([0.04, 0.05, 0.004])
    plate.apply_translation([-0.02, 0, 0.03])
    scene = raycaster(from_trimesh(trimesh.util.concatenate([box, plate])))
    x = np.array([-0.02, -0.001, 0.002, 0.004, 0.02])
    points = np.column_stack([x, np.zeros(5), [0.033, 0.033, 0.032, 0.032, 0.003]])
    found = met(scene, points, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(found.which, [True, True, False, False, True])
    np.testing.assert_allclose(found.off, [0.001, 0.001, -0.002], atol=1e-6)
    np.testing.assert_allclose(found.feet[:, 2], [0.032, 0.032, 0.005], atol=1e-6)
    aside = met(scene, points[:1] + [0, 0, 2 * CLOSE], np.array([0.0, 0.0, 1.0]))
    assert not aside.which.any()


def test_a_surface_is_divided_for_both_of_its_sides():
    for solid in (
        trimesh.creation.box([0.3, 0.02, 0.004]),
        trimesh.creation.cylinder(0.01, 0.2, sections=7),
        trimesh.creation.icosphere(1, 0.02),
    ):
        fine = trimesh.Trimesh(*divided(solid.vertices, solid.faces, 0.006), process=False)
        assert fine.edges_unique_length.max() <= 0.006
        assert fine.is_watertight and fine.volume == pytest.approx(solid.volume) and fine.area == pytest.approx(solid.area)
