"""Bowls keep floor and both sides, lids stay closed, and a handle that goes out of sight behind its body goes on to it."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scenes
import shapely
import trimesh

from magic_core import sensor, shapes, transforms
from magic_core.loops import Opening
from magic_core.mesh import Mesh, concatenate
from magic_core.views import find_view, holes_of
from magic_perception import evaluate, handles, made_mugs, scoops
from magic_perception.averaging import average
from magic_perception.parameters import Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.surface_error import distance


def seen(mesh: Mesh, names: tuple[str, ...], seed: int = 0, poses=scenes.POSES):
    """The one thing perceived of a mesh on the table, and what kind of solid it became; by the sensor that smears."""
    frames = [
        sensor.capture([mesh], scenes.INTRINSICS, poses[name], [seed, i], camera=name, model=sensor.SMEARED) for i, name in enumerate(names)
    ]
    report = Report()
    (item,) = perceive(frames, parameters=Parameters(), report=report).objects
    return item, report.shapes[item.id]


def bowl(rim: float, foot: float, height: float, wall: float = 0.004) -> Mesh:
    """A bowl whose wall is a part of a parabola."""
    z = np.linspace(0, height, 12)
    outer = np.column_stack([foot + (rim - foot) * np.sqrt(z / height), z])
    inner = np.column_stack([outer[1:, 0] - wall, outer[1:, 1]])[::-1]
    profile = np.vstack([[0, 0], outer, inner[:-1], [inner[-1, 0] - 0.002, wall], [0, wall]])
    solid = trimesh.creation.revolve(profile, sections=64)
    return Mesh(solid.vertices, solid.faces)


@pytest.mark.parametrize(("rim", "foot", "height"), [(0.075, 0.035, 0.055), (0.07, 0.04, 0.08), (0.08, 0.045, 0.038)])
@pytest.mark.parametrize("names", [("left",), ("left", "right"), ("low",)])
def test_a_bowl_is_one_hollow_thing(rim, foot, height, names):
    truth = scenes.placed(bowl(rim, foot, height), 0.55, 0.02).painted((70, 90, 160))
    # From low down the rim hides the floor.
    poses = {**scenes.POSES, "low": scenes.pose([0.0, 0.1, 0.36], [0.55, 0.0, 0.02])}
    item, shape = seen(truth, names, poses=poses)
    assert shape == "round"
    assert item.mesh.extents == pytest.approx([2 * rim, 2 * rim, height], abs=0.008)
    solid = item.mesh.to_trimesh()
    assert solid.is_watertight and solid.euler_number == 2
    # Hollow, with a floor: nothing of the table shows through, and most of its hull is empty.
    assert not holes_of(find_view(item.mesh, item.pieces, "top").mask).any()
    assert solid.volume < 0.5 * solid.convex_hull.volume
    assert abs(solid.volume - truth.to_trimesh().volume) < 0.4 * truth.to_trimesh().volume


def lain(mesh: Mesh, roll: float, yaw: float) -> Mesh:
    """The mesh on its side, turned about its own axis by ``roll`` first, radians."""
    side = transforms.from_rpy(0, np.pi / 2, 0) @ transforms.from_rpy(0, 0, roll)
    return scenes.placed(mesh.transformed(side), 0.5, 0.0, yaw)


@pytest.mark.parametrize(("seed", "roll", "yaw"), [(7002, 1.6, 0.4), (7003, 1.2, 2.2)])
def test_a_mug_on_its_side_is_a_round_body_with_an_open_handle(seed, roll, yaw):
    truth = lain(shapes.make("mug", seed).mesh, roll, yaw).painted((60, 90, 200))
    item, shape = seen(truth, ("left", "right"), poses=sensor.STATION)
    assert shape == "round with handle"
    solid = item.mesh.transformed(item.world_from_object).to_trimesh()
    assert solid.euler_number == 0
    assert solid.bounds == pytest.approx(truth.to_trimesh().bounds, abs=0.012)


@pytest.mark.parametrize(("seed", "roll", "yaw"), [(28567, 3.77, -1.13), (28111, 3.74, -0.65)])
def test_a_mug_on_its_side_is_open_though_one_camera_sees_its_foot(seed, roll, yaw):
    truth = lain(shapes.make("mug", seed).mesh, roll, yaw).painted((60, 90, 200))
    item, shape = seen(truth, ("left", "right"), poses=sensor.STATION)
    assert shape == "round with handle"
    found = item.mesh.transformed(item.world_from_object)
    assert found.to_trimesh().euler_number == 0
    assert distance(truth, found) < 0.0025


def test_a_handle_beside_its_mug_on_the_table_is_no_thing_of_its_own():
    truth = lain(shapes.make("mug", 7013).mesh, -1.6, 5.0).painted((60, 90, 200))
    item, _ = seen(truth, ("left", "right"), poses=sensor.STATION)
    solid = item.mesh.transformed(item.world_from_object).to_trimesh()
    assert solid.bounds == pytest.approx(truth.to_trimesh().bounds, abs=0.012)


def test_a_can_on_its_side():
    can = trimesh.creation.cylinder(0.033, 0.12)
    truth = lain(Mesh(can.vertices, can.faces), 0.0, 0.6).painted((180, 60, 50))
    item, shape = seen(truth, ("left",))
    assert shape == "round"
    solid = item.mesh.transformed(item.world_from_object).to_trimesh()
    assert solid.bounds == pytest.approx(truth.to_trimesh().bounds, abs=0.008)
    assert solid.volume == pytest.approx(truth.to_trimesh().volume, rel=0.1)


@pytest.mark.parametrize(("floor", "holes"), [(0.004, 0), (0.0, 1)])
def test_of_the_table_in_a_narrow_band_a_sliver_tells_that_it_has_no_floor(floor, holes):
    # 58 mm wide and 40 mm high: its own wall hides most of what is in it, and smear fills a part of the rest.
    outside = trimesh.creation.cylinder(0.029, 0.04).apply_translation([0, 0, 0.02])
    inside = trimesh.creation.cylinder(0.026, 0.06).apply_translation([0, 0, 0.03 + (floor or -0.01)])
    band = trimesh.boolean.difference([outside, inside], engine="manifold")
    truth = Mesh(band.vertices, band.faces).painted((60, 90, 200)).transformed(transforms.make(translation=[0.45, -0.05, 0]))
    caster = sensor.scene_raycaster([truth])
    frames = [
        sensor.capture([], sensor.D435, pose, [0, i], camera=name, raycaster=caster, model=sensor.SMEARED)
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    (item,) = perceive(frames).objects
    assert item.mesh.to_trimesh().euler_number == 2 - 2 * holes
    assert distance(truth, item.mesh.transformed(item.world_from_object)) < 0.0025


PLACES = ((0.38, -0.28), (0.62, -0.2), (0.42, 0.02), (0.66, 0.1), (0.4, 0.3))


@pytest.mark.parametrize(
    ("kind", "radii"),
    [
        ("sphere", (0.015, 0.025, 0.035, 0.045, 0.06)),
        ("sphere", (0.055, 0.05, 0.04, 0.03, 0.02)),
        ("cylinder", (0.015, 0.025, 0.035, 0.045, 0.06)),
    ],
)
def test_balls_and_cylinders_of_all_sizes_stand(kind, radii):
    """Nothing of a large ball is seen as low as the table, and beside its underside both cameras look past it: it stands all the same."""
    made = {"sphere": lambda r: trimesh.creation.icosphere(4, r), "cylinder": lambda r: trimesh.creation.cylinder(r, 2 * r, sections=64)}
    meshes = [
        scenes.placed(Mesh(m.vertices, m.faces), *at).painted((180, 60, 50)) for at, m in zip(PLACES, map(made[kind], radii), strict=True)
    ]
    caster = sensor.scene_raycaster(meshes)
    frames = [
        sensor.capture([], sensor.D435, pose, [3, i], camera=name, raycaster=caster, model=sensor.SMEARED)
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    report = Report()
    objects = perceive(frames, parameters=Parameters(), report=report).objects
    assert len(objects) == len(radii)
    for radius, (x, y) in zip(radii, PLACES, strict=True):
        item = min(objects, key=lambda o: np.hypot(*(o.world_from_box[:2, 3] - (x, y))))
        assert not item.hanging and report.shapes[item.id] == kind
        assert item.mesh.extents == pytest.approx([2 * radius] * 3, abs=0.003)
        assert item.world_from_box[:3, 3] == pytest.approx([x, y, radius], abs=0.003)


@pytest.mark.parametrize("size", [(0.18, 0.09, 0.03), (0.1, 0.1, 0.1)])
def test_what_is_well_above_the_table_hangs_however_broad(size):
    box = trimesh.creation.box(extents=size)
    truth = Mesh(box.vertices + [0.5, 0.05, 0.08 + size[2] / 2], box.faces).painted((180, 60, 50))
    item, shape = seen(truth, ("left", "right"), poses=sensor.STATION)
    assert item.hanging and shape == "hull"


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
def test_a_wide_tin_is_a_cylinder(names):
    tin = trimesh.creation.cylinder(0.1, 0.068, sections=64)
    item, shape = seen(scenes.placed(Mesh(tin.vertices, tin.faces), 0.6, 0.05).painted((120, 60, 40)), names)
    assert shape == "cylinder"
    assert item.mesh.extents == pytest.approx([0.2, 0.2, 0.068], abs=0.006)


@pytest.mark.parametrize(("radius", "height", "recess"), [(0.033, 0.10, 0.003), (0.05, 0.21, 0.0), (0.042, 0.14, 0.005)])
def test_a_lid_is_no_opening(radius, height, recess):
    rim = radius - 0.003
    profile = [[0, 0], [radius, 0], [radius, height], [rim, height], [rim, height - recess - 1e-4], [0, height - recess - 1e-4]]
    solid = trimesh.creation.revolve(np.array(profile), sections=64)
    item, _ = seen(scenes.placed(Mesh(solid.vertices, solid.faces), 0.6, 0.05).painted((180, 60, 50)), ("left",))
    found = item.mesh.to_trimesh()
    assert found.volume > 0.9 * found.convex_hull.volume
    assert item.mesh.extents[2] == pytest.approx(height, abs=0.008)


@pytest.mark.parametrize(("seed", "yaw", "names"), [(7009, 3.49, ("right",)), (7003, 2.09, ("left", "right"))])
def test_a_handle_partly_behind_its_body_stays_open(seed, yaw, names):
    mug = scenes.shape("mug", seed, 0.47, 0.15, yaw).painted((60, 90, 200))
    item, shape = seen(mug, names, poses=sensor.STATION)
    assert shape == "round with handle"
    assert holes_of(find_view(item.mesh, item.pieces, "side").mask).sum() > 40
    assert item.mesh.to_trimesh().euler_number == 0  # one handle, one loop, nothing apart


@pytest.mark.parametrize("yaw", [0.25 * np.pi, 0.75 * np.pi])
def test_the_hole_of_a_broad_handle_is_open_where_smear_leaves_little_of_it(yaw):
    mug = shapes.make("mug", 0, handle_reach=0.038, profile="tapered", height=0.1, radius=0.045, bulge=0.1, handle_breadth=0.016)
    item, shape = seen(scenes.placed(mug.mesh, 0.5, 0.0, yaw).painted((170, 40, 40)), ("left", "right"))
    assert shape == "round with handle"
    assert item.mesh.to_trimesh().euler_number == 0


@pytest.mark.parametrize("color", [(170, 40, 40), (70, 74, 80), (200, 200, 205)])
@pytest.mark.parametrize("yaw", [0.2, 0.3])
def test_the_hole_of_a_handle_before_its_body_is_open(yaw, color):
    # Depth fills it and the mask says nothing of it: the picture shows the body through it.
    mug = scenes.shape("mug", 8, 0.5, 0.0, yaw).painted(color)
    item, shape = seen(mug, ("left",), poses=sensor.STATION)
    assert shape == "round with handle"
    assert item.mesh.to_trimesh().euler_number == 0
    assert distance(mug, item.mesh.transformed(item.world_from_object)) < 0.003


def test_a_fin_before_its_body_has_no_hole():
    mug = shapes.make("mug", 8)
    loop = mug.region("handle_loop").points[:, [0, 2]]
    fin = trimesh.creation.extrude_polygon(shapely.Polygon(loop).buffer(0.004), 0.008)
    fin = Mesh(fin.vertices, fin.faces).transformed(transforms.make(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]), [0, 0.004, 0]))
    mug = scenes.placed(concatenate([mug.mesh, fin]), 0.5, 0.0, 0.25).painted((170, 40, 40))
    item, shape = seen(mug, ("left",), poses=sensor.STATION)
    assert shape == "round with handle"
    assert item.mesh.to_trimesh().euler_number == 2


@pytest.mark.parametrize("is_open", [True, False])
def test_a_narrow_cup_that_one_camera_sees_is_open_and_a_tin_is_not(is_open):
    radius, height = 0.028, 0.137
    inside = [[radius - 0.0035, height], [radius - 0.0035, 0.004], [0, 0.004]]
    solid = trimesh.creation.revolve(
        np.array([[0, 0], [radius, 0], [radius, height], *(inside if is_open else [[0, height]])]), sections=64
    )
    cup = scenes.placed(Mesh(solid.vertices, solid.faces), 0.6, 0.1).painted((60, 120, 170))
    item, _ = seen(cup, ("right",), poses=sensor.STATION)
    found = item.mesh.to_trimesh()
    assert (found.volume < 0.6 * found.convex_hull.volume) == is_open
    assert distance(cup, item.mesh.transformed(item.world_from_object)) < 0.002


def test_a_waisted_body_is_no_handle():
    z = np.linspace(0, 0.09, 40)
    outer = np.column_stack([0.036 + 0.008 * np.sin(2 * np.pi * z / 0.09), z])
    profile = np.vstack([[0, 0], outer, outer[:0:-1] - [0.004, 0], [0, 0.004]])
    solid = trimesh.creation.revolve(profile, sections=64)
    cup = scenes.placed(Mesh(solid.vertices, solid.faces), 0.5, 0.0).painted((60, 120, 70))
    item, shape = seen(cup, ("left", "right"), poses=sensor.STATION)
    assert shape == "round"
    assert distance(cup, item.mesh.transformed(item.world_from_object)) < 0.003


def test_the_widest_handle_is_one_where_no_camera_sees_through_it():
    # Of made mugs that stand off farthest, a bar and its hole together are as wide as their handle.
    off = [float(np.ptp(mug.mesh.vertices[:, 0]) - np.ptp(mug.mesh.vertices[:, 1])) for mug in shapes.mug_set()]
    assert max(off) < handles.BAR


def test_a_handle_stands_where_it_stands_off_farthest_whatever_lies_at_the_foot():
    random = np.random.default_rng(3)
    reach, side = random.uniform(0.042, 0.085, 1000), random.uniform(-0.005, 0.005, 1000)
    handle = np.column_stack([reach, side])
    # Smear and what is not round: near the body, on one side of the handle.
    turn = random.uniform(0.3, 1.2, 90)
    foot = random.uniform(0.045, 0.050, 90)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    local = np.vstack([handle, foot])
    along, thickness = handles._handle_plane(local, np.linalg.norm(local, axis=1) - 0.04)
    assert np.degrees(np.arctan2(along[1], along[0])) == pytest.approx(0, abs=1)
    assert thickness == pytest.approx(0.01, abs=0.001)


@pytest.mark.parametrize("yaw", [0.4, 3.5])
def test_an_eye_on_a_stem_is_no_scoop(yaw):
    # Nothing is seen of a floor in it: the table shows through.
    eye, stem = trimesh.creation.torus(0.02, 0.004), trimesh.creation.cylinder(0.004, 0.06)
    stem.apply_transform(transforms.from_rpy(0, np.pi / 2, 0, [0.05, 0, 0]))
    hook = concatenate([Mesh(part.vertices, part.faces) for part in (eye, stem)]).transformed(transforms.from_rpy(0, 0.1, 0))
    _, shape = seen(scenes.placed(hook, 0.5, 0.0, yaw).painted((70, 90, 160)), ("left", "right"), poses=sensor.STATION)
    assert shape != "scoop"


def laid_down(mesh: Mesh) -> Mesh:
    """A scoop on its bowl and the end of its handle, which goes to -x."""
    low, high = -0.6, 0.6
    for _ in range(30):
        pitch = (low + high) / 2
        turned = mesh.transformed(transforms.from_rpy(0, pitch, 0))
        handle = turned.vertices[:, 0] < turned.bounds[0, 0] + 0.3 * turned.extents[0]
        low, high = (pitch, high) if turned.vertices[handle, 2].min() < turned.vertices[~handle, 2].min() else (low, pitch)
    return turned


def off_by(truth: Mesh, found: Mesh) -> float:
    """How far two surfaces are apart, m: root mean square of points on each to the other."""
    import open3d as o3d

    off = []
    for here, there in ((truth, found), (found, truth)):
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(there.vertices.astype(np.float32)), o3d.core.Tensor(there.faces.astype(np.uint32)))
        sample = trimesh.sample.sample_surface(here.to_trimesh(), 1500, seed=0)[0].astype(np.float32)
        off.append(scene.compute_distance(o3d.core.Tensor(sample)).numpy() ** 2)
    return float(np.sqrt(np.mean(off)))


@pytest.mark.parametrize(
    ("family", "seed", "yaw", "least"), [("spoon", 7101, 0.4, 0.002), ("ladle", 7102, 2.2, 0.002), ("measuring_cup", 7103, 4.0, 0.003)]
)
def test_a_scoop_is_hollow_also_where_its_near_wall_hides_it(family, seed, yaw, least):
    truth = scenes.placed(laid_down(shapes.make(family, seed).mesh), 0.5, 0.0, yaw).painted((70, 140, 90))
    item, shape = seen(truth, ("left", "right"), poses=sensor.STATION)
    assert shape == "scoop"
    found = item.mesh.transformed(item.world_from_object)
    assert found.to_trimesh().is_watertight
    assert off_by(truth, found) < least


def test_a_handle_keeps_the_bar_about_the_hole_that_it_hangs_by_and_loses_whiskers():
    # 30 mm wide; a hole of 22 mm leaves 4 mm about it at the end, and smear sticks out of the side as narrow.
    bar = shapely.LineString([(0, 0), (0.1, 0)]).buffer(0.015).difference(shapely.Point(0.1, 0).buffer(0.011))
    whisker = shapely.box(0.04, 0.0, 0.043, 0.03)
    left = scoops._without_whiskers(bar.union(whisker))
    assert bar.difference(left).area < 0.02 * bar.area
    assert left.difference(bar).area < 0.2 * whisker.area
    assert len(left.interiors) == 1


def test_a_ladle_that_lies_so_far_on_its_side_that_it_would_hold_no_water_is_a_scoop():
    """With a stem that rises steeply its rim leans by 40 degrees; as a height field it was filled down to the table."""
    ladle = laid_down(shapes.make("ladle", 5, angle=0.78, handle=0.30, bowl_radius=0.06, depth=0.03, aspect=1.0).mesh)
    truth = scenes.placed(ladle, 0.5, 0.0, 2.5).painted((70, 140, 90))
    item, shape = seen(truth, ("left", "right"), poses=sensor.STATION)
    assert shape == "scoop"
    assert off_by(truth, item.mesh.transformed(item.world_from_object)) < 0.0025


@pytest.mark.parametrize("seed", [1, 2])
def test_of_a_bowl_that_opens_wide_the_rim_is_not_taken_for_the_side_below(seed):
    item, _ = seen(scenes.placed(bowl(0.08, 0.045, 0.038), 0.55, 0.02).painted((70, 90, 160)), ("left", "right"), seed)
    assert item.mesh.extents == pytest.approx([0.16, 0.16, 0.038], abs=0.002)


def test_a_spoon_of_the_tables_own_colour_is_what_depth_has_it_for():
    """Colour has no edge to cut along, and pixels that lose their depth at rim and handle are told by those about them: the ball shows that
    none is carried."""
    spoon = shapes.make("spoon", 4016).mesh
    truth = scenes.placed(laid_down(spoon), 0.5, 0.0, 0.8).painted((206, 160, 117))
    caster = sensor.scene_raycaster([truth, scenes.placed(shapes.make("sphere", 1).mesh, 0.42, 0.2)])
    frames = [
        average([sensor.capture([], sensor.D435, pose, [5, i, k], camera=name, raycaster=caster) for k in range(3)])
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    report = Report()
    scene = perceive(frames, parameters=Parameters(region_low=(0.0, -0.7, -0.05)), report=report)
    (item,) = (item for item in scene.objects if report.shapes[item.id] != "sphere")
    assert report.shapes[item.id] == "scoop"
    assert distance(truth, item.mesh.transformed(item.world_from_object)) < 0.003


@pytest.mark.parametrize(("deep", "half"), [(0.02, 0.04), (0.012, 0.03), (0.008, 0.025)])
def test_the_pieces_of_a_bowl_do_not_fill_its_hollow(deep, half):
    bowl = scoops.Bowl(transforms.make(translation=[0, 0, deep + 0.004]), np.array([half, half]), deep * (1 - scoops.RINGS**2), 0.002)
    _, pieces = scoops.bowl_solid(bowl)
    assert len(pieces) <= 49
    above = bowl.surface(np.linspace(0.02, 0.95, 30), 32, 0.0).reshape(-1, 3) + [0, 0, 0.002]
    for piece in pieces:
        corners = piece.vertices[piece.faces]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        off = np.einsum("fi,pfi->pf", outward, above[:, None] - corners[None, :, 0])
        assert (off > 0).any(axis=1).all()


def test_a_hollow_is_held_against_all_that_is_seen_in_it():
    """A lump in a bowl, below its rim or above it, is no hollow, though most of what is seen fits one."""
    depths = 0.02 * np.sqrt(np.maximum(1 - scoops.RINGS**2, 0))
    bowl = scoops.Bowl(transforms.from_rpy(0.1, -0.05, 0.7, [0.5, 0.1, 0.024]), np.array([0.035, 0.028]), depths, 0.002)
    hollow = bowl.surface(np.linspace(0.05, 0.95, 24), 48, 0.0).reshape(-1, 3)
    hollow = hollow + np.random.default_rng(0).normal(scale=0.0008, size=hollow.shape)

    def holds(points):
        return scoops.explains(bowl, points, np.broadcast_to(bowl.table_from_bowl[:3, 3] + [0, 0, 0.8], points.shape), 0.001)

    assert holds(hollow)
    x, y, _ = bowl.local(hollow).T
    assert not holds(hollow[np.hypot(x / bowl.half[0], y / bowl.half[1]) > 0.65]), "its floor is out of sight"
    for top in (-0.006, 0.012):  # of the lump, above the rim's plane
        x, y, z = bowl.local(hollow).T
        lump = np.where(np.hypot(x, y) < 0.014, top - 30 * (x**2 + y**2), z)
        full = transforms.apply(bowl.table_from_bowl, np.column_stack([x, y, np.maximum(z, lump)]))
        assert not holds(full), top


def test_specks_about_a_stick_are_no_handle():
    """What stands off a round body in clusters too small to tell anything: nothing is left of it, and nothing is asked of that."""
    hook = shapes.make("s_hook", 1129).mesh.transformed(transforms.from_rpy(0, 0, 2.939))
    middle = hook.bounds.mean(axis=0)
    hook = hook.transformed(transforms.make(translation=[0.454 - middle[0], 0.04 - middle[1], -hook.bounds[0, 2]]))
    stick = trimesh.creation.cylinder(0.0086, 0.2622, sections=48)
    caster = sensor.scene_raycaster([hook, scenes.placed(Mesh(stick.vertices, stick.faces).painted((60, 90, 160)), 0.51, 0.026)])
    frames = [
        sensor.capture([], sensor.D435, pose, [1129, i], camera=name, raycaster=caster)
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    assert len(perceive(frames, parameters=Parameters(region_low=(0.0, -0.7, -0.05))).objects) == 2


def test_what_becomes_of_handles_is_measured(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        evaluate.main(["--mugs", "3", "--seed", "901", "--out", str(tmp_path)])
    assert ended.value.code == 0
    rows = json.loads((tmp_path / "evaluation.json").read_text())["mugs"]["rows"]
    assert [row["attitude"] for row in rows] == ["upright", "upright", "on its side"]
    assert all(row["objects"] == 1 and row["error_mm"] < 6 for row in rows)
    assert any(row["in_sight"] > made_mugs.IN_SIGHT and row["open"] and row["barred"] for row in rows)
    assert "| upright | in sight |" in capsys.readouterr().out


def test_an_open_handle_is_told_from_a_filled_and_from_a_lost_one():
    mug = shapes.make("mug", 8)
    opening = Opening.within(mug.region("handle_loop").points)
    fin = mug.mesh.convex_hull()
    body = mug.mesh.to_trimesh().slice_plane([mug.mesh.bounds[1, 0] - 0.04, 0, 0], [-1, 0, 0], cap=True)
    told = [made_mugs._handle(opening, mug.mesh, mesh) for mesh in (mug.mesh, fin, Mesh(body.vertices, body.faces))]
    assert [(t["open"], t["barred"]) for t in told] == [(True, True), (False, True), (True, False)]
