"""Pictures by ray casting against shapes whose pictures are known."""

import numpy as np
import pytest
import trimesh

from magic_core import mesh as meshes
from magic_core import transforms as tf
from magic_core.camera import Intrinsics
from magic_core.rendering import VIEW_FILL, VIEW_SIZE, Raycaster, canonical_view, shade

RADIUS = 0.05


@pytest.fixture(scope="module")
def sphere():
    return meshes.from_trimesh(trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)).painted((200, 100, 50))


@pytest.mark.parametrize("direction, up", [((0, 0, -1), (1, 0, 0)), ((1, 0, 0), (0, 0, 1)), ((1, 2, -3), (0, 0, 1))])
def test_a_spheres_view_is_a_disc_of_the_right_radius(sphere, direction, up):
    view = canonical_view(sphere, direction, up, "top")
    assert view.mask.shape == (VIEW_SIZE, VIEW_SIZE)
    radius = VIEW_FILL * VIEW_SIZE / 2
    assert view.metres_per_pixel * radius == pytest.approx(RADIUS, rel=5e-3)
    v, u = np.mgrid[0:VIEW_SIZE, 0:VIEW_SIZE] - (VIEW_SIZE - 1) / 2
    distance = np.hypot(u, v)
    # The icosphere's facets lie within half a percent of the sphere.
    assert view.mask[distance < radius - 2].all()
    assert not view.mask[distance > radius + 1].any()
    # Nearest in the middle, by the radius; on the mid-plane at the rim.
    middle = VIEW_SIZE // 2
    assert view.depth[middle, middle] == pytest.approx(-RADIUS, rel=1e-2)
    assert np.isnan(view.depth[~view.mask]).all()
    assert (view.image[~view.mask] == 0).all()


def test_pixels_and_points_are_inverse(sphere):
    view = canonical_view(sphere, (0, 0, -1), (1, 0, 0), "top")
    pixels = np.array([[0.0, 0.0], [100.5, 7.25], [383.0, 383.0]])
    np.testing.assert_allclose(view.pixels(view.points(pixels)), pixels, atol=1e-9)
    np.testing.assert_allclose(view.points([191.5, 191.5]), [0, 0, 0], atol=1e-3 * RADIUS)


def test_the_picture_is_not_mirrored():
    # A long bar along +x with a knob on its +y side: seen from above with +x up, +y is to the left.
    bar = meshes.from_trimesh(trimesh.creation.box((0.2, 0.02, 0.02)))
    knob = meshes.from_trimesh(trimesh.creation.box((0.02, 0.06, 0.02))).transformed(tf.make(translation=[0.09, 0.04, 0.0]))
    view = canonical_view(meshes.concatenate([bar, knob]), (0, 0, -1), (1, 0, 0), "top")
    u, v = view.pixels(np.array([0.09, 0.06, 0.0]))
    bar_u, bar_v = view.pixels(np.array([0.0, 0.0, 0.0]))
    assert u < bar_u
    assert v < bar_v
    assert view.mask[int(v), int(u)]
    assert not view.mask[int(v), int(2 * bar_u - u)]
    np.testing.assert_allclose(view.directions([1.0, 0.0]), [0, -1, 0], atol=1e-12)


def test_perspective_depth_and_projection(sphere):
    intrinsics = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    world_from_camera = tf.make(translation=[0, 0, -0.5])
    cast, depth = Raycaster([sphere]).perspective(intrinsics, world_from_camera)
    assert np.nanmin(depth) == pytest.approx(0.5 - RADIUS, rel=2e-2)
    assert np.isnan(depth[0, 0])
    # Points from depth lie on the sphere, and project back to their pixels.
    points = intrinsics.unproject(depth)
    known = np.isfinite(depth)
    world = tf.apply(world_from_camera, points[known])
    np.testing.assert_allclose(np.linalg.norm(world, axis=1), RADIUS, rtol=1e-2)
    pixels = intrinsics.project(points[known])
    v, u = np.nonzero(known)
    np.testing.assert_allclose(pixels, np.column_stack([u, v]), atol=1e-4)
    # Normals point towards the eye; colours are those of the mesh.
    towards = np.sum(cast.normals[known] * (world_from_camera[:3, 3] - world), axis=1)
    assert (towards > 0).all()
    assert (np.abs(cast.color[known].astype(int) - (200, 100, 50)) <= 1).all()


def test_ids_name_the_nearer_mesh_and_the_background_shows(sphere):
    behind = sphere.scaled(2).transformed(tf.make(translation=[0, 0, 0.5]))
    cast, _ = Raycaster([behind, sphere]).orthographic(np.eye(4), (40, 40), 0.01, 1.0)
    assert cast.ids[20, 20] == 1
    assert cast.ids[20, 28] == 0
    assert cast.ids[0, 0] == -1
    assert shade(cast, background=(1, 2, 3))[0, 0].tolist() == [1, 2, 3]


def test_distances_to_a_sphere_are_those_of_its_radius(sphere):
    points = np.array([[0, 0, 0], [2 * RADIUS, 0, 0], [0, 0.5 * RADIUS, 0]])
    np.testing.assert_allclose(Raycaster([sphere]).distances(points), [RADIUS, RADIUS, 0.5 * RADIUS], rtol=1e-2)
