"""Shapes against analytic truths: closed, filled by convex pieces, regions on the surface with outward normals."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.shapes import FAMILIES, HANDLES, PROFILES, Shape, make, mug_set, section_view
from magic_core.shapes.fixtures import demonstrated_pose, fixtures, pose_data
from magic_core.shapes.solids import Part, ball, convex_parts, hull, join, plate, turned, volume

GREY = (128, 128, 128)
SEEDS = (0, 1, 2)
SHAPES = {(family, seed): make(family, seed) for family in FAMILIES for seed in SEEDS}


def signed_distance(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene.compute_signed_distance(o3d.core.Tensor(np.asarray(points, np.float32))).numpy()


@pytest.fixture(params=SHAPES, ids=lambda key: f"{key[0]}-{key[1]}")
def shape(request: pytest.FixtureRequest) -> Shape:
    return SHAPES[request.param]


def test_the_mesh_is_closed_and_faces_outward(shape: Shape) -> None:
    solid = shape.mesh.to_trimesh()
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume > 0
    assert shape.mesh.colors is not None and len(shape.mesh.colors) == len(shape.mesh.vertices)
    np.testing.assert_allclose(shape.mesh.bounds.mean(axis=0), 0, atol=1e-6)


def test_the_pieces_are_convex_and_fill_the_mesh(shape: Shape) -> None:
    for piece in shape.pieces:
        centres = piece.vertices[piece.faces].mean(axis=1)
        a, b, c = (piece.vertices[piece.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        above = (piece.vertices[None] - centres[:, None]) @ normals[:, :, None]
        assert above.max() < 1e-6
    together = sum(volume(p.vertices, p.faces) for p in shape.pieces)
    # Parts overlap a little where they are joined; turned bodies have fewer sectors as pieces.
    assert 0.97 < together / shape.mesh.to_trimesh().volume < 1.09
    corners = np.concatenate([p.vertices for p in shape.pieces])
    assert signed_distance(shape.mesh, corners).max() < 0.0008


def test_the_regions_lie_on_the_surface_with_outward_normals(shape: Shape) -> None:
    for name, region in shape.regions.items():
        assert len(region.points) == len(region.normals) > 0, name
        np.testing.assert_allclose(np.linalg.norm(region.normals, axis=1), 1, atol=1e-6)
        assert np.abs(signed_distance(shape.mesh, region.points)).max() < 0.0004, name
        if np.ptp(region.points, axis=0).max() < 1e-9:
            continue  # a sharp corner: both sides of it are near
        # 0.8 mm out is outside, 0.8 mm in is inside (walls are 3 mm and more).
        assert signed_distance(shape.mesh, region.points + 0.0008 * region.normals).min() > 0, name
        assert signed_distance(shape.mesh, region.points - 0.0008 * region.normals).max() < 0, name


def test_the_radius_of_a_region_is_that_of_its_points(shape: Shape) -> None:
    for name, region in shape.regions.items():
        if (
            not np.isfinite(region.radius)
            or len(region.points) < 9
            or name in ("handle", "handle_loop", "bowl_inside", "band", "ring_1", "ring_2")
        ):
            continue  # not circles: the radius is that in the middle
        if shape.family in ("spoon", "ladle", "measuring_cup", "rod", "mug_tree"):
            continue
        turned_by = np.arccos(np.clip(np.einsum("ij,ij->i", region.normals[:-1], region.normals[1:]), -1, 1)).sum()
        length = np.linalg.norm(np.diff(region.points, axis=0), axis=1).sum()
        assert length / turned_by == pytest.approx(region.radius, rel=0.01), name


def test_a_contact_lies_on_the_outline_of_the_view(shape: Shape) -> None:
    view = shape.view()
    assert view.kind == shape.view_kind
    for name in shape.regions:
        if shape.family in ("mug_tree", "rod", "quarter_pipe", "sphere") or name in ("rim",):
            continue
        contact = shape.contact(name, view)
        inside, outside = contact.pixel - 1.2 * contact.normal, contact.pixel + 1.5 * contact.normal
        u, v = np.round(inside).astype(int)
        assert view.mask[v, u], name
        u, v = np.round(outside).astype(int)
        if shape.family != "watch":
            assert not view.mask[v, u], name
        # The contact frame: x along the normal, z into the picture.
        np.testing.assert_allclose(contact.object_from_contact[:3, 2], view.direction, atol=1e-9)


def test_volumes_against_formulas() -> None:
    assert SHAPES["cylinder", 0].mesh.to_trimesh().volume == pytest.approx(
        2 * np.pi * SHAPES["cylinder", 0].parameters["radius"] ** 3, rel=0.003
    )
    radius = SHAPES["sphere", 1].parameters["radius"]
    assert SHAPES["sphere", 1].mesh.to_trimesh().volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    assert sum(volume(p.vertices, p.faces) for p in SHAPES["sphere", 1].pieces) == pytest.approx(
        SHAPES["sphere", 1].mesh.to_trimesh().volume, rel=1e-6
    )
    arc = make("quarter_pipe", 0, radius=0.2, width=0.1, back=0.02)
    expected = 0.1 * (0.2**2 * (1 - np.pi / 4) + 0.02 * 0.2)
    assert arc.mesh.to_trimesh().volume == pytest.approx(expected, rel=0.01)
    # A straight mug without its handle: outer minus inner cylinder.
    mug = make("mug", 0, profile="straight", radius=0.04, height=0.1, wall=0.004, floor=0.006)
    body = np.pi * (0.04**2 * 0.1 - 0.036**2 * 0.094)
    assert body * 0.99 < mug.mesh.to_trimesh().volume < body * 1.15


def test_an_l_hook_bends_where_its_parameters_say() -> None:
    hook = make("l_hook", 0, inner_radius=0.03, bend=np.pi / 2, width=0.02, length=0.25, tip=0.07)
    region = hook.region("inner")
    assert region.concave and region.radius == 0.03
    _, normal = region.middle()
    np.testing.assert_allclose(normal, [-np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)
    fitted = np.linalg.lstsq(np.column_stack([2 * region.points[:, :2], np.ones(25)]), (region.points[:, :2] ** 2).sum(axis=1), rcond=None)[
        0
    ]
    assert np.sqrt(fitted[2] + fitted[:2] @ fitted[:2]) == pytest.approx(0.03, rel=1e-6)


def test_a_plate_with_a_hole_is_partitioned_without_loss() -> None:
    import shapely

    ring = shapely.Point(0, 0).buffer(0.05).difference(shapely.box(-0.02, -0.01, 0.02, 0.015))
    part = plate(ring, 0.0, 0.01, GREY)
    assert volume(part.vertices, part.faces) == pytest.approx(ring.area * 0.01, rel=2e-3)
    assert sum(volume(p.vertices, p.faces) for p in part.pieces) == pytest.approx(volume(part.vertices, part.faces), rel=1e-3)
    assert len(convex_parts(shapely.box(0, 0, 1, 1))) == 1
    assert len(convex_parts(shapely.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]))) <= 3


def test_a_union_keeps_the_colours_of_its_parts() -> None:
    low: Part = turned([0, 0.1], [0.05, 0.05], (200, 0, 0))
    high = ball(0.03, (0, 0, 200)).moved(transforms.make(translation=[0, 0, 0.12]))
    mesh = join([low, high])
    assert mesh.to_trimesh().is_watertight
    assert np.all(mesh.colors[mesh.vertices[:, 2] > 0.11] == (0, 0, 200))
    assert np.all(mesh.colors[mesh.vertices[:, 2] < 0.05] == (200, 0, 0))


def test_a_hull_of_a_cube() -> None:
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    cube = hull(np.concatenate([corners, [[0.5, 0.5, 0.5]]]))
    assert len(cube.vertices) == 8 and volume(cube.vertices, cube.faces) == pytest.approx(1)


def test_the_same_seed_gives_the_same_object_and_another_seed_another() -> None:
    for family in FAMILIES:
        again = FAMILIES[family](0)
        np.testing.assert_array_equal(again.mesh.vertices, SHAPES[family, 0].mesh.vertices)
        assert again.parameters == SHAPES[family, 0].parameters
    assert SHAPES["mug", 0].parameters != SHAPES["mug", 1].parameters
    # A given parameter leaves the others as the seed drew them.
    given = make("caliper", 1, opening=0.1)
    assert {k: v for k, v in given.parameters.items() if k != "opening"} == {
        k: v for k, v in SHAPES["caliper", 1].parameters.items() if k != "opening"
    }


def test_there_are_134_different_mugs() -> None:
    mugs = mug_set(134)
    assert {(m.parameters["profile"], m.parameters["handle"]) for m in mugs} == {(p, h) for p in PROFILES for h in HANDLES}
    assert len({round(m.mesh.to_trimesh().volume, 10) for m in mugs}) == 134
    for mug in mugs[::7]:
        assert mug.mesh.to_trimesh().is_watertight
        assert mug.mesh.to_trimesh().euler_number == 0  # one hole: that of the handle
        # The contact that hangs it: down and towards the body, with a peg's room beside it.
        point, normal = mug.region("handle").middle(towards=(-1, 0, -1))
        assert normal[2] < -0.3 and normal[0] < 0.2
        assert signed_distance(mug.mesh, (point + 0.007 * normal)[None])[0] > 0.0055


def test_the_section_of_a_spoon_is_its_profile() -> None:
    spoon = make("spoon", 0, bowl_half_length=0.05, bowl_half_width=0.04, depth=0.025, wall=0.004)
    view = spoon.view()
    assert view.kind == "section"
    # Through the middle of the bowl the cut shows the wall only, not the rim behind it.
    bottom = spoon.region("bowl").middle(towards=(0, 0, 1))[0]
    u, _v = np.round(view.pixels(bottom)).astype(int)
    column = view.mask[:, u]
    assert column.sum() * view.metres_per_pixel == pytest.approx(0.004, abs=2 * view.metres_per_pixel)
    area = view.mask.sum() * view.metres_per_pixel**2
    shell = np.pi / 2 * (0.054 * 0.029 - 0.05 * 0.025)
    assert shell < area < shell + 0.3 * 0.016
    ball_view = section_view(make("sphere", 0, radius=0.03).mesh, (0, -1, 0), (0, 0, 1))
    assert ball_view.mask.sum() * ball_view.metres_per_pixel**2 == pytest.approx(np.pi * 0.03**2, rel=0.01)


def test_a_sheet_has_no_section() -> None:
    sheet = Mesh(np.array([[0.0, -0.05, 0.0], [0.1, -0.05, 0.0], [0.1, 0.05, 0.0], [0.0, 0.05, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(MagicError, match="closed mesh") as caught:
        section_view(sheet, (0, -1, 0), (0, 0, 1))
    assert caught.value.code == Code.BAD_MESH


def test_as_object_is_complete() -> None:
    pose = transforms.from_rpy(0.1, 0.2, 0.3, [0.4, 0.1, 0.2])
    item = SHAPES["caliper", 0].as_object("caliper", pose)
    assert item.source == "known" and item.view.kind == "top" and item.pieces
    np.testing.assert_allclose(item.world_from_box, pose, atol=1e-6)
    np.testing.assert_allclose(item.box_extents, SHAPES["caliper", 0].mesh.extents)


def test_bad_requests_say_what_is_allowed() -> None:
    for call, text in (
        (lambda: make("teapot"), "l_hook"),
        (lambda: make("mug", 0, lid=1.0), "profile"),
        (lambda: make("mug", 0, handle="loop"), "square"),
        (lambda: make("mug", 0, radius=float("nan")), "number"),
        (lambda: make("mug", -1), "integer"),
        (lambda: SHAPES["mug", 0].region("spout"), "handle"),
    ):
        with pytest.raises(MagicError) as caught:
            call()
        assert caught.value.code == Code.BAD_REQUEST and text in caught.value.message
    with pytest.raises(MagicError) as caught:
        fixtures({"fixtures": [{"id": "arc"}]}, np.zeros(3))
    assert caught.value.code == Code.BAD_STRATEGY
    with pytest.raises(MagicError) as caught:
        demonstrated_pose({})
    assert caught.value.code == Code.BAD_STRATEGY


def test_fixtures_stand_where_the_target_is() -> None:
    pose = transforms.from_rpy(0, 0, np.pi, [-0.2, 0.0, 0.1])
    environment = {"fixtures": [{"id": "arc", "family": "quarter_pipe", "parameters": {"radius": 0.2}, "from_target": pose_data(pose)}]}
    (arc,) = fixtures(environment, [0.7, 0.1, 0.035])
    np.testing.assert_allclose(arc.world_from_object[:3, 3], [0.5, 0.1, 0.1], atol=1e-9)
    assert arc.id == "arc" and arc.source == "known"
