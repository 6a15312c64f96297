"""What stands on its own form: tins with rounded edges, small cans, mugs with something in them or before them, and what is no handle."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import shapely
import trimesh
from test_round_things import seen

from magic_core.mesh import Mesh, concatenate
from magic_perception import boxes, convexity, reconstruction
from magic_perception.boxes import Box
from magic_perception.turned import round_body

EYE = np.array([-0.5, 0.0, 0.5])


def prism(width: float, length: float, corner: float, height: float) -> Mesh:
    """An upright box with rounded edges, metres."""
    inner = shapely.box(corner - width / 2, corner - length / 2, width / 2 - corner, length / 2 - corner)
    solid = trimesh.creation.extrude_polygon(inner.buffer(corner, quad_segs=8), height)
    return Mesh(solid.vertices, solid.faces)


@pytest.mark.parametrize(
    ("size", "corner", "names"),
    [((0.06, 0.10, 0.08), 0.022, ("left",)), ((0.08, 0.12, 0.06), 0.02, ("left", "right")), ((0.055, 0.11, 0.11), 0.02, ("left",))],
)
def test_a_tin_with_rounded_edges_is_neither_a_sharp_box_nor_a_round_body_with_a_handle(size, corner, names):
    item, shape = seen(scenes.placed(prism(*size[:2], corner, size[2]), 0.58, 0.05, 0.5).painted((190, 60, 50)), names)
    assert shape == "rounded box"
    assert np.sort(item.mesh.extents) == pytest.approx(np.sort(size), abs=0.001)
    truth = (size[0] * size[1] - (4 - np.pi) * corner**2) * size[2]
    assert item.mesh.to_trimesh().volume == pytest.approx(truth, rel=0.03)


def test_what_is_fitted_does_not_hang_on_the_last_digits_of_what_was_measured(monkeypatch):
    given = []
    monkeypatch.setattr(reconstruction, "recognise_box", lambda *args: given.append(args) or boxes.recognise_box(*args))
    seen(scenes.placed(prism(0.06, 0.10, 0.022, 0.08), 0.58, 0.05, 0.5).painted((190, 60, 50)), ("left",))
    (sights, height, noise), *_ = given
    exact = boxes.recognise_box(sights, height, noise).mesh.vertices
    rng, measured = np.random.default_rng(0), [sight.measured for sight in sights]
    for _ in range(5):
        for sight, points in zip(sights, measured, strict=True):
            vars(sight)["measured"] = points + rng.normal(0, 1e-9, points.shape)
        assert np.abs(boxes.recognise_box(sights, height, noise).mesh.vertices - exact).max() < 1e-4


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_square_block_stays_a_box_and_a_thin_can_a_cylinder(yaw):
    block, shape = seen(scenes.placed(prism(0.06, 0.06, 1e-4, 0.09), 0.58, 0.05, yaw).painted((190, 60, 50)), ("left",))
    assert shape == "box"
    assert np.sort(block.mesh.extents) == pytest.approx([0.06, 0.06, 0.09], abs=0.006)
    can = trimesh.creation.cylinder(0.021, 0.09, sections=48)
    found, shape = seen(scenes.placed(Mesh(can.vertices, can.faces), 0.58, 0.05, yaw).painted((60, 70, 120)), ("left",))
    assert shape == "cylinder"
    assert np.sort(found.mesh.extents) == pytest.approx([0.042, 0.042, 0.09], abs=0.006)


@pytest.mark.parametrize("corner", [0.0, 0.01, 0.03])
def test_the_distance_to_a_rounded_box_is_zero_on_its_corners_and_exact_beside_its_edges(corner):
    box = Box(np.array([0.1, -0.2]), np.array([0.06, 0.1, 0.08]), 0.4, corner)
    assert box.distance(box.corners()) == pytest.approx(0, abs=1e-9)
    assert box.round == (corner == box.size[:2].max() / 2)
    c, s = np.cos(0.4), np.sin(0.4)
    inner = box.size[:2] / 2 - corner
    for away in (0.004, 0.02):
        local = inner + (corner + away) * np.array([0.6, 0.8])
        place = box.middle + [c * local[0] - s * local[1], s * local[0] + c * local[1]]
        assert box.distance(np.array([[*place, 0.04]]))[0] == pytest.approx(away)


def arcs(pen: bool, handle: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3), normals (N, 3) and labels (N,) of a tapered mug: its outside before the axis, its inside beyond, and what belongs to
    either."""
    turn, z = (a.ravel() for a in np.meshgrid(np.linspace(-1.2, 1.2, 40), np.linspace(0.01, 0.1, 30)))
    radius = 0.03 + 0.13 * z
    front = np.column_stack([-radius * np.cos(turn), radius * np.sin(turn), z])
    out = np.column_stack([-np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    high = z > 0.06
    back = np.column_stack([(radius - 0.003) * np.cos(turn), (radius - 0.003) * np.sin(turn), z])[high]
    parts = [(front, out, 0), (back, np.column_stack([-np.cos(turn), -np.sin(turn), np.zeros(len(turn))])[high], 1)]
    a, h = (x.ravel() for x in np.meshgrid(np.linspace(-1.2, 1.2, 8), np.linspace(0.04, 0.105, 20)))
    side = np.column_stack([-np.cos(a), np.sin(a), np.zeros(len(a))])
    if pen:
        parts.append((np.column_stack([0.015 + 0.006 * side[:, 0], 0.012 + 0.006 * side[:, 1], h]), side, 1))
    if handle:
        parts.append((np.column_stack([-0.075 + 0.008 * side[:, 0], 0.008 * side[:, 1], h - 0.02]), side, 0))
    points, normals = (np.concatenate([part[i] for part in parts]).astype(np.float32) for i in range(2))
    return points, normals, np.repeat([part[2] for part in parts], [len(part[0]) for part in parts])


@pytest.mark.parametrize(("pen", "handle"), [(False, False), (True, False), (False, True), (True, True)])
def test_inside_and_outside_of_a_mug_are_one_whatever_stands_in_it_or_before_it(pen, handle):
    points, normals, labels = arcs(pen, handle)
    assert np.unique(convexity.insides(points, normals, labels.astype(np.int64), points[:, 2])).size == 1


def test_a_can_beside_a_bowl_s_inside_is_not_its_outside():
    points, normals, labels = arcs(False, False)
    points = points.copy()
    points[labels == 0] += [-0.09, 0.03, 0]
    assert np.unique(convexity.insides(points, normals, labels.astype(np.int64), points[:, 2])).size == 2


@pytest.mark.parametrize("pen", [False, True])
def test_a_pen_that_leans_on_the_rim_does_not_raise_it(pen):
    points, _, _ = arcs(False, False)
    rim = 0.1
    if pen:
        z = np.linspace(0.05, 0.14, 60)
        points = np.concatenate([points, np.column_stack([np.full(60, 0.038), np.linspace(-0.006, 0.006, 60), z])])
    points = points.astype(float)
    body = round_body(points, np.broadcast_to(EYE, points.shape), float(points[:, 2].max()), 0.001, 0.003, 0)
    assert body is not None
    assert body.profile[-1, 1] == pytest.approx(rim, abs=0.004)
    assert body.profile[-1, 0] == pytest.approx(0.043, abs=0.004)


def test_a_lug_at_the_foot_of_a_tin_is_no_handle():
    can = trimesh.creation.cylinder(0.045, 0.16, sections=64)
    lug = trimesh.creation.box((0.03, 0.03, 0.05))
    lug.apply_translation([-0.01, 0.055, -0.055])
    tin = concatenate([Mesh(can.vertices, can.faces), Mesh(lug.vertices, lug.faces)])
    _, shape = seen(scenes.placed(tin, 0.6, 0.05, 0.4).painted((60, 90, 160)), ("left",))
    assert shape != "round with handle"
