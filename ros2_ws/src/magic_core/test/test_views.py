"""The canonical view is found: handles, holes and bowls show."""

import cv2
import numpy as np
import pytest

from magic_core import shapes
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.views import find_view, holes_of, long_axis


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
    assert view.kind == "section" and abs(view.direction[2]) < 1e-9 and abs(view.direction @ long_axis(ladle.mesh)) < 0.02
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
