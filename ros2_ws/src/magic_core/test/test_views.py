"""The canonical view is found: handles, holes and bowls show."""

import cv2
import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.views import along, find_view, holes_of, own_directions, own_views, square_axis


@pytest.mark.parametrize("seed", [1, 3, 8])
def test_a_mug_shows_its_handle(seed):
    mug = shapes.make("mug", seed)
    view = find_view(mug.mesh)
    assert view.kind == "side" and view.confidence > 0.9
    assert holes_of(view.mask).sum() > 0.005 * view.mask.sum()
    # Horizontal, across the handle's plane (the handle is at +x), up at the top, the handle on the right.
    assert abs(view.direction[2]) < 1e-9 and abs(view.direction[0]) < 0.35
    np.testing.assert_allclose(view.object_from_view[:3, 1], [0, 0, -1], atol=1e-9)
    assert view.pixels([mug.mesh.bounds[1][0], 0, 0])[0] > view.mask.shape[1] / 2


@pytest.mark.parametrize("family", ["l_hook", "scissors", "hanger", "caliper"])
def test_what_lies_is_seen_from_above(family):
    view = find_view(shapes.make(family, 1).mesh)
    assert view.kind == "top" and view.confidence > 0.8
    np.testing.assert_allclose(view.direction, [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(view.object_from_view[:3, 0], [1, 0, 0], atol=1e-9)


def test_the_cut_of_a_ladle_shows_its_bowl_open_upwards():
    ladle = shapes.make("ladle", 2)
    view = find_view(ladle.mesh, ladle.pieces, "section")
    assert view.kind == "section" and abs(view.direction[2]) < 1e-9 and abs(view.direction[0]) < 0.02  # a ladle is made along x
    hull = np.zeros(view.mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(view.mask)[:, ::-1].astype(np.int32)), 1)
    assert view.mask.sum() < 0.4 * hull.sum()
    # Column by column over the bowl (right), material lies below, air above.
    right = np.nonzero(view.mask.any(axis=0))[0][-1]
    column = view.mask[:, right - 40]
    assert column.any() and np.nonzero(column)[0].min() > np.nonzero(view.mask.any(axis=1))[0].min() + 10


def test_the_cut_of_a_box_is_its_rectangle():
    import trimesh

    box = trimesh.creation.box((0.2, 0.05, 0.04))
    view = find_view(Mesh(box.vertices, box.faces), None, "section")
    assert view.mask.sum() * view.metres_per_pixel**2 == pytest.approx(0.2 * 0.04, rel=0.02)
    np.testing.assert_allclose(view.points([[191.5, 191.5]]), 0, atol=1e-9)


def test_a_kind_can_be_given():
    mug = shapes.make("mug", 1)
    for kind in ("top", "side", "section"):
        assert find_view(mug.mesh, mug.pieces, kind).kind == kind
    with pytest.raises(MagicError) as error:
        find_view(mug.mesh, None, "below")
    assert error.value.code is Code.BAD_REQUEST_IMAGE
    with pytest.raises(MagicError) as error:
        find_view(Mesh(np.zeros((0, 3)), np.zeros((0, 3))))
    assert error.value.code is Code.BAD_MESH


@pytest.mark.parametrize(("family", "normal"), [("mug", (0, 1, 0)), ("hanger", (0, 0, 1)), ("scissors", (0, 0, 1)), ("s_hook", (0, 0, 1))])
def test_a_shapes_own_view_turns_with_it(family, normal):
    made = shapes.make(family, 2).mesh
    for angles in ((0, 0, 0), (1.2, 0.4, -2.0), (np.pi / 2, 0, 0), (0.1, -1.4, 0.9)):
        turn = transforms.from_rpy(*angles, (0.1, 0.0, -0.3))
        mesh = made.transformed(turn)
        directions = own_directions(mesh, "side")
        # The plane of symmetry is across the first of them, whichever way the thing lies.
        assert abs(directions[0] @ turn[:3, :3] @ np.array(normal)) > np.cos(np.deg2rad(1.0))
        assert len(directions) <= 3 and np.all(directions[:, 2] <= 1e-6)
        assert square_axis(mesh, directions[0], "side") is not None
        assert square_axis(mesh, turn[:3, :3] @ transforms.unit([1, 1, 1]), "side") is None


@pytest.mark.parametrize("family", ["sphere", "cylinder"])
def test_what_is_convex_from_everywhere_has_no_view_of_its_own(family):
    assert len(own_directions(shapes.make(family, 1).mesh, "side")) == 0


def test_a_spoon_is_cut_along_its_plane_of_symmetry_however_it_lies():
    made = shapes.make("ladle", 2)
    upright = find_view(made.mesh, made.pieces, "section")
    turn = transforms.from_rpy(1.0, 0.5, 2.0)
    mesh = made.mesh.transformed(turn)
    views = own_views(mesh, None, "section")
    across = [abs(view.direction @ turn[:3, :3] @ upright.direction) for view in views]
    best = views[int(np.argmax(across))]
    assert max(across) > 0.999 and square_axis(mesh, best.direction, "section") is not None
    area = best.mask.sum() * best.metres_per_pixel**2
    assert area == pytest.approx(upright.mask.sum() * upright.metres_per_pixel**2, rel=0.03)
    assert sum(square_axis(mesh, view.direction, "section") is not None for view in views) == 1


@pytest.mark.parametrize("kind", [None, "top", "side", "section"])
@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)],
        [(0, 0, 0), (0.1, 0, 0), (0, 0, 0.1)],
        [(0, 0, 0), (0.1, 0, 0), (0.2, 0, 0)],
        [(0, 0, 0), (0, 0, 0), (0, 0, 0)],
    ],
)
def test_a_sheet_a_needle_and_a_point_are_seen_or_refused(kind, corners):
    mesh = Mesh(np.array(corners, dtype=float), np.array([[0, 1, 2]]))
    for look in (
        lambda: [find_view(mesh, None, kind)],
        lambda: own_views(mesh, None, kind or "side"),
        lambda: [along(mesh, None, kind or "side", (1, 0, 0))],
    ):
        try:
            assert all(view.mask.any() for view in look())
        except MagicError as error:
            assert error.code is Code.BAD_MESH


def cloud_of(family, seed, count=8000):
    import trimesh

    made = shapes.make(family, seed).mesh
    return made, np.asarray(trimesh.sample.sample_surface(made.to_trimesh(), count, seed=0)[0])


@pytest.mark.parametrize("family, seed, kind", [("mug", 1, "side"), ("mug", 3, "side"), ("scissors", 1, "top"), ("hanger", 1, "top")])
def test_a_cloud_is_seen_as_its_mesh_is(family, seed, kind):
    mesh, points = cloud_of(family, seed)
    view, true = find_view(points), find_view(mesh)
    assert view.kind == true.kind == kind
    if kind == "side":
        assert abs(view.direction[0]) < 0.35
    assert holes_of(view.mask).sum() > 0.005 * view.mask.sum()
    # The same silhouette but for the points' size.
    again = find_view(points, kind="top")
    flat = find_view(mesh, kind="top")
    pixels = flat.pixels(again.points(np.argwhere(again.mask)[::7, ::-1]))
    u, v = np.clip(pixels.round().astype(int), 0, flat.mask.shape[0] - 1).T
    assert cv2.dilate(flat.mask.astype(np.uint8), np.ones((15, 15)))[v, u].mean() > 0.97


def test_the_cut_of_a_cloud_shows_the_bowl():
    _, points = cloud_of("ladle", 2)
    view = find_view(points, kind="section")
    hull = np.zeros(view.mask.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(view.mask)[:, ::-1].astype(np.int32)), 1)
    assert view.kind == "section" and view.mask.sum() < 0.6 * hull.sum()


def test_no_cloud_is_refused():
    for points in (np.zeros((3, 3)), np.full((50, 3), np.nan), np.zeros((50, 2))):
        with pytest.raises(MagicError) as error:
            find_view(points)
        assert error.value.code is Code.BAD_MESH
