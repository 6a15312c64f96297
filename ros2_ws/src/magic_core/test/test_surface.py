"""Principal curvatures against what geometry says, and where a silhouette's edge lies in depth."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.mesh import from_trimesh
from magic_core.rendering import canonical_view
from magic_core.surface import Surface

SPHERE = from_trimesh(trimesh.creation.icosphere(5, 0.03))
CYLINDER = from_trimesh(trimesh.creation.cylinder(0.02, 0.15, sections=256))
TORUS = from_trimesh(trimesh.creation.torus(0.05, 0.012, major_sections=256, minor_sections=128))


def asked(mesh, point, normal, across=(0.0, 0.0, 1.0), turn=None):
    turn = np.eye(4) if turn is None else turn
    frame = turn @ transforms.frame(np.asarray(point, float), np.asarray(normal, float), np.asarray(across, float))
    return Surface(mesh.transformed(turn)).principal_frame(frame), frame


@given(angle=st.floats(0, 2 * np.pi), lift=st.floats(-1.2, 1.2))
@settings(max_examples=10, deadline=None)
def test_a_sphere_bends_alike_both_ways(angle, lift):
    normal = np.array([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)])
    across = np.array([-np.cos(angle) * np.sin(lift), -np.sin(angle) * np.sin(lift), np.cos(lift)])
    found, frame = asked(SPHERE, 0.03 * normal, normal, across)
    assert found.radii == pytest.approx([0.03, 0.03], rel=0.03) and (found.curvatures > 0).all()
    np.testing.assert_allclose(found.object_from_surface[:3, 0], normal, atol=0.02)
    np.testing.assert_allclose(found.object_from_surface[:3, :3], frame[:3, :3], atol=0.03)


@pytest.mark.parametrize("rpy", [(0, 0, 0), (0.7, -1.1, 2.0), (2.4, 0.3, -0.6)])
def test_a_cylinder_bends_one_way(rpy):
    turn = transforms.from_rpy(*rpy, (0.1, 0.2, -0.1))
    # The view is along the axis: the picture shows the circle; then across it: the picture shows a straight edge.
    found, _ = asked(CYLINDER, (0.02, 0, 0), (1, 0, 0), (0, 0, 1), turn)
    assert found.curvatures == pytest.approx([50, 0], abs=1.5)
    found, _ = asked(CYLINDER, (0.02, 0, 0), (1, 0, 0), (0, 1, 0), turn)
    assert found.curvatures == pytest.approx([0, 50], abs=1.5)
    np.testing.assert_allclose(np.abs(found.object_from_surface[:3, 1] @ turn[:3, :3]), [0, 0, 1], atol=0.03)


def test_directions_are_the_surfaces_own_not_the_pictures():
    # The picture is askew to the axis by half a right angle less a little.
    across = transforms.unit([0.0, np.sin(0.6), np.cos(0.6)])
    found, _ = asked(CYLINDER, (0.02, 0, 0), (1, 0, 0), across)
    assert found.curvatures == pytest.approx([50, 0], abs=1.5)
    assert abs(found.object_from_surface[2, 2]) > 0.999


@pytest.mark.parametrize(
    ("point", "normal", "wanted"),
    [((0.062, 0, 0), (1, 0, 0), (1 / 0.062, 1 / 0.012)), ((0.038, 0, 0), (-1, 0, 0), (-1 / 0.038, 1 / 0.012))],
)
def test_a_torus_is_a_saddle_on_its_inside(point, normal, wanted):
    found, _ = asked(TORUS, point, normal)
    assert found.curvatures == pytest.approx(wanted, rel=0.06)
    np.testing.assert_allclose(found.object_from_surface[:3, 3], point, atol=1e-4)


def test_a_contact_beside_the_surface_is_put_onto_it():
    found, _ = asked(TORUS, (0.0375, 0.0006, 0.0002), (-1, 0, 0))
    assert np.hypot(np.hypot(*found.object_from_surface[:2, 3]) - 0.05, found.object_from_surface[2, 3]) == pytest.approx(0.012, abs=2e-5)


def test_a_corner_has_no_curvatures():
    box = from_trimesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    assert asked(box, (0.05, 0.05, 0.0), transforms.unit([1, 1, 0]))[0] is None


def test_the_side_of_a_plate_is_flat_and_its_edge_lies_in_its_middle():
    plate = from_trimesh(trimesh.creation.box((0.2, 0.06, 0.004)))
    high = plate.transformed(transforms.make(translation=[0, 0, 0.05]))
    both = from_trimesh(trimesh.util.concatenate([high.to_trimesh(), trimesh.creation.box((0.02, 0.02, 0.02))]))
    view = canonical_view(both, (0, 0, -1), (0, 1, 0), "top")
    pixel = view.pixels([0.1, 0.0, 0.0])
    depth = Surface(both).depth_of_edge(view, pixel, (1.0, 0.0))
    assert view.points(pixel, depth)[2] == pytest.approx(0.05, abs=1e-5)
    found, _ = asked(high, (0.1, 0.0, 0.05), (1, 0, 0))
    assert found.curvatures == pytest.approx([0, 0], abs=0.1)


def test_what_no_line_of_sight_meets_has_no_depth():
    view = canonical_view(SPHERE, (0, 0, -1), (0, 1, 0), "top")
    assert Surface(SPHERE).depth_of_edge(view, (2.0, 2.0), (1.0, 0.0)) is None


def test_what_has_nothing_in_sight_is_as_deep_as_what_is_next_to_it():
    """Between two bars at other depths: as deep as the nearer one's middle."""
    near = trimesh.creation.box(extents=[0.02, 0.1, 0.01], transform=trimesh.transformations.translation_matrix([0.04, 0, 0.013]))
    far = trimesh.creation.box(extents=[0.02, 0.1, 0.01], transform=trimesh.transformations.translation_matrix([-0.06, 0, -0.02]))
    both = from_trimesh(trimesh.util.concatenate([near, far]))
    view = canonical_view(both, (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), "top")
    pixel = view.pixels(np.array([0.02, 0.0, 0.0]))
    height = (view.points(pixel) + Surface(both).depth_beside(view, pixel) * view.direction)[2]
    assert height == pytest.approx(0.013, abs=0.001)
