"""Cameras that disagree, the table among planes, and what is seen in part, on ray-cast scenes."""

import json
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor, shapes, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate
from magic_core.scene import SceneObject
from magic_core.views import find_view
from magic_perception import evaluate, moved_cameras
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.seen import joined
from magic_perception.solids import hangs_together
from magic_perception.surface_error import distance
from magic_perception.table import Plane, camera_over_table, supports, table_in_view

REGION = Parameters(region_low=(0.15, -0.6, -0.05), region_high=(0.95, 0.6, 0.5))


@pytest.fixture(scope="module")
def pair():
    meshes = [
        scenes.shape("l_hook", 1, 0.5, -0.1, 0.4),
        scenes.shape("cylinder", 1, 0.62, 0.12),
        scenes.shape("scissors", 1, 0.6, -0.27, 0.2),
    ]
    return seen_by_both(meshes)


def seen_by_both(meshes):
    caster = sensor.scene_raycaster(meshes)
    return [
        sensor.capture([], scenes.INTRINSICS, pose, [5, i], camera=name, raycaster=caster)
        for i, (name, pose) in enumerate(scenes.POSES.items())
    ]


def moved(frames, motion):
    """The second camera's extrinsics off by a motion (4, 4) of the world."""
    return [frames[0], replace(frames[1], world_from_camera=motion @ frames[1].world_from_camera)]


def test_good_cameras_agree(pair):
    report = Report()
    scene = perceive(pair, parameters=REGION, report=report)
    assert len(scene.objects) == 3 and scene.camera_offset < 0.004 and not report.notes and not scene.notes


@pytest.mark.parametrize(
    "motion",
    [
        transforms.make(translation=[0.018, -0.012, 0]),
        transforms.make(translation=[0, 0, 0.03]),
        scenes.POSES["right"] @ transforms.from_rpy(0, np.radians(2), 0) @ transforms.inverse(scenes.POSES["right"]),
    ],
    ids=["beside", "above", "turned"],
)
def test_cameras_far_apart_are_refused_with_how_far(pair, motion):
    with pytest.raises(MagicError, match="right sees the scene") as caught:
        perceive(moved(pair, motion), parameters=REGION)
    assert caught.value.code == Code.CAMERAS_DISAGREE
    told = float(str(caught.value).split("sees the scene ")[1].split(" mm")[0])
    middle = np.array([0.57, -0.1, 0.02])
    assert told == pytest.approx(1000 * np.linalg.norm(transforms.apply(motion, middle) - middle), abs=5)


def test_cameras_that_were_exchanged_are_refused():
    """Of cameras that mirror each other each sees its things where the other sees the bare table: nothing is common to both, and everything is there twice."""
    things = [scenes.shape("caliper", 1, 0.45, -0.22, 0.5), scenes.shape("cylinder", 1, 0.7, 0.1)]
    left, right = seen_by_both(things)
    exchanged = [replace(left, world_from_camera=right.world_from_camera), replace(right, world_from_camera=left.world_from_camera)]
    with pytest.raises(MagicError, match="left.*looks through.*exchanged") as caught:
        perceive(exchanged, parameters=REGION)
    assert caught.value.code is Code.CAMERAS_DISAGREE


@pytest.mark.parametrize("shares", [(0.5, np.nan), (np.nan, 0.5)])
def test_cameras_of_which_one_sees_too_little_to_tell_are_not_taken_for_exchanged(pair, shares, monkeypatch):
    told = iter(shares)
    monkeypatch.setattr("magic_perception.cameras.looked_through", lambda *_: next(told))
    assert perceive(pair, parameters=REGION).objects


def test_cameras_of_which_each_sees_its_own_side_do_not_look_through_things():
    """A wall between them: of its sides neither sees the other's."""
    wall = slab([0.2, 0.003, 0.1], [0.55, 0.0, 0.05], (200, 60, 60))
    found = perceive(seen_by_both([wall]), parameters=REGION)
    assert len(found.objects) >= 1


def test_cameras_a_little_apart_are_brought_together(pair):
    motion = transforms.make(translation=[0.0065, 0.004, 0])
    report = Report()
    scene = perceive(moved(pair, motion), parameters=REGION, report=report)
    assert scene.camera_offset == pytest.approx(0.0076, abs=0.003) and "cameras disagree" in scene.notes[0]
    # Each is moved half way, so that a tin is as round and as large as where they agree, to within what the motion is known.
    tins = [
        min(s.objects, key=lambda o: np.linalg.norm(o.world_from_object[:2, 3] - [0.62, 0.12]))
        for s in (scene, perceive(pair, parameters=REGION))
    ]
    np.testing.assert_allclose(tins[0].box_extents, tins[1].box_extents, atol=0.005)
    np.testing.assert_allclose(tins[0].world_from_object[:2, 3] - tins[1].world_from_object[:2, 3], motion[:2, 3] / 2, atol=0.003)


@pytest.mark.parametrize(
    ("things", "seed", "intrinsics"),
    [
        ([("l_hook", 43, 43.0, 0.5, 0.0)], 43, sensor.D435),
        ([("l_hook", 45, 0.3, 0.44, -0.24), ("cylinder", 45, 0.0, 0.7, 0.0)], 45, Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)),
    ],
    ids=["hook alone", "hook and tin, few pixels"],
)
def test_little_on_the_table_does_not_set_right_cameras_against_each_other_and_tells_wrong_ones(things, seed, intrinsics):
    """What surfaces alone made of a hook's masks and smear was 7 mm with 2.5 degrees, and 9 mm."""
    caster = sensor.scene_raycaster([lying(*thing) for thing in things])
    frames = [
        sensor.capture([], intrinsics, pose, [seed, i], model=sensor.SMEARED, camera=name, raycaster=caster)
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    report = Report()
    perceive(frames, parameters=Parameters(), report=report)
    assert not report.cameras[0].certain and not report.cameras[0].motion.any()
    with pytest.raises(MagicError, match="CAMERAS_DISAGREE"):
        perceive(moved(frames, transforms.make(translation=[0.013, 0.0125, 0])), parameters=Parameters())


def test_the_table_tells_a_tilt_whatever_stands_on_it():
    """A ball alone tells no turn, and need not: that the table is tilted is seen on the table."""
    frames = [
        sensor.capture([], sensor.D435, pose, [40, i], camera=name, raycaster=sensor.scene_raycaster([lying("sphere", 40, 0.0, 0.5, 0.1)]))
        for i, (name, pose) in enumerate(sensor.STATION.items())
    ]
    middle = transforms.make(translation=[0.5, 0.1, 0.03])
    tilted = middle @ transforms.from_rpy(np.radians(2), 0, 0) @ transforms.inverse(middle)
    with pytest.raises(MagicError, match="CAMERAS_DISAGREE"):
        perceive(moved(frames, tilted), parameters=Parameters())


def test_cameras_that_see_opposite_sides_of_a_ball_are_not_drawn_together():
    """A motion by which both see the same side, where they do not, is no better than none."""
    ball = lying("sphere", 65, 0.0, 0.5, 0.0)
    poses = [sensor.looking_at([0.5, y, 0.45], [0.5, 0.0, 0.03]) for y in (0.6, -0.6)]
    caster = sensor.scene_raycaster([ball])
    frames = [
        sensor.capture([], sensor.D435, pose, [65, i], model=sensor.SMEARED, camera=name, raycaster=caster)
        for i, (name, pose) in enumerate(zip(("left", "right"), poses, strict=True))
    ]
    assert perceive(frames, parameters=Parameters()).camera_offset < 0.005


def test_a_table_below_the_base_is_used_and_said(pair):
    motion = transforms.make(translation=[0, 0, -0.09])
    low = [replace(frame, world_from_camera=motion @ frame.world_from_camera) for frame in pair]
    scene = perceive(low, parameters=REGION)
    assert len(scene.objects) == 3 and scene.table_height == pytest.approx(-0.09, abs=0.002)
    assert "-90 mm" in scene.notes[0] and "region_low" in scene.notes[0]


def slab(size, centre, color):
    import trimesh

    box = trimesh.creation.box(size)
    return Mesh(np.asarray(box.vertices) + centre, np.asarray(box.faces)).painted(color)


@pytest.mark.parametrize("thickness", [0.018, 0.030], ids=["tray", "board"])
def test_things_on_a_tray_stand_on_the_tray(thickness):
    tray = slab([0.36, 0.44, thickness], [0.55, 0.0, thickness / 2], (60, 90, 120))
    things = [scenes.shape("l_hook", 1, 0.5, -0.08, 0.4), scenes.shape("cylinder", 1, 0.6, 0.1)]
    lifted = [mesh.transformed(transforms.make(translation=[0, 0, thickness])) for mesh in things]
    caster = sensor.scene_raycaster([tray, *lifted])
    frames = [
        sensor.capture([], scenes.INTRINSICS, pose, [6, i], camera=name, raycaster=caster)
        for i, (name, pose) in enumerate(scenes.POSES.items())
    ]
    scene = perceive(frames, parameters=REGION)
    assert len(scene.objects) == 2 and scene.table_height == pytest.approx(thickness, abs=0.002)
    for mesh in lifted:
        found = min(scene.objects, key=lambda o: np.linalg.norm(o.world_from_object[:3, 3] - mesh.bounds.mean(axis=0)))
        assert found.mesh.transformed(found.world_from_object).bounds[0, 2] == pytest.approx(thickness, abs=0.003)
        np.testing.assert_allclose(np.sort(found.box_extents)[-1], np.sort(mesh.extents)[-1], rtol=0.25)


def patch(random, low, high, z, step):
    """Points (N, 3) of a level rectangle from low to high (x, y), with 1 mm of noise."""
    grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low, high, strict=True))), axis=-1).reshape(-1, 2)
    return np.column_stack([grid, random.normal(z, 0.001, len(grid))])


def over_floor(turn):
    """Points (N, 3) of a table of 0.32 by 0.80 m with two boxes on it, half a metre above a floor that shows more of itself, and on which
    four specks of noise lie, each seen from one side only; all turned about the vertical."""
    random = np.random.default_rng(0)
    made = partial(patch, random)
    top, floor, rest = made((-0.16, -0.40), (0.16, 0.40), 0.5, 0.006), made((0.3, -0.8), (1.3, 0.8), 0.0, 0.009), []
    for x, y in ((-0.05, -0.2), (0.03, 0.22)):
        top = top[np.abs(top[:, :2] - (x, y)).max(axis=1) > 0.04]
        rest.append(made((x - 0.04, y - 0.04), (x + 0.04, y + 0.04), 0.57, 0.006))
    for x, y in ((0.5, -0.6), (0.7, 0.0), (0.9, 0.5), (1.1, -0.3)):
        away = floor[:, :2] - (x, y)
        floor = floor[(np.abs(away).max(axis=1) > 0.05) | (away[:, 0] > 0.02)]
        rest.append(made((x - 0.015, y - 0.015), (x + 0.015, y + 0.015), 0.03, 0.006))
    return transforms.apply(transforms.from_rpy(0, 0, turn), np.concatenate([top, floor, *rest]))


@pytest.mark.parametrize("turn", np.radians([0, 20, 45, 70, 90]))
def test_a_narrow_table_is_told_from_the_floor_below_it_whichever_way_it_stands(turn):
    found = supports(over_floor(turn), Plane(np.array([0.0, 0.0, 1.0, 0.0])))
    assert -found[0].plane.coefficients[3] == pytest.approx(0.5, abs=0.003)
    assert found[0].things == pytest.approx(2, abs=0.1)
    floor = next(support for support in found if abs(support.plane.coefficients[3]) < 0.003)
    assert floor.share > 1.5 * found[0].share and 0.5 < floor.things < 1.6


def wall_scene(elevation, wall):
    """Depth points (H, W, 3) and world_from_camera of a table of 0.25 m depth before a high wall, with two things on it."""
    k = Intrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
    table = Mesh([[-0.6, -0.25, 0], [0.6, -0.25, 0], [0.6, 0.2, 0], [-0.6, 0.2, 0]], [[0, 1, 2], [0, 2, 3]]).painted((150, 120, 90))
    meshes = [scenes.placed(shapes.make("mug", 3).mesh, -0.12, 0.0, 0.5), scenes.placed(shapes.make("cylinder", 2).mesh, 0.15, 0.02)]
    if wall:
        meshes.append(slab([2.4, 0.01, 1.6], [0, 0.205, 0.8], (200, 200, 205)))
    at, away = np.array([0, 0.1, 0.12]), 0.8
    pose = sensor.looking_at(at + away * np.array([0, -np.cos(elevation), np.sin(elevation)]), at)
    frame = sensor.capture(meshes, k, pose, 3, table=table)
    return k.unproject(frame.depth), pose


@pytest.mark.parametrize("degrees", [15, 25, 40])
def test_a_wall_is_no_table(degrees):
    points, pose = wall_scene(np.radians(degrees), wall=True)
    notes = []
    found = camera_over_table(points, notes=notes)
    assert found[2, 3] == pytest.approx(pose[2, 3], abs=0.01)
    assert np.degrees(np.arccos(np.clip(found[2, :3] @ pose[2, :3], -1, 1))) < 1.5
    assert any("upright in the picture" in note for note in notes)


def test_a_wall_alone_is_refused():
    k = Intrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
    wall = slab([4, 0.01, 4], [0, 0.5, 0], (200, 200, 205))
    pose = sensor.looking_at([0, -0.5, 0.6], [0, 0.5, 0.1])
    frame = sensor.capture([wall], k, pose, 3, table=Mesh([[0, 9, -9], [1, 9, -9], [0, 9.1, -9]], [[0, 1, 2]]).painted((9, 9, 9)))
    with pytest.raises(MagicError, match="upright in the picture") as caught:
        table_in_view(k.unproject(frame.depth))
    assert caught.value.code == Code.TABLE_AMBIGUOUS


# ---------------------------------------------------------------- what is seen in part


def seen_by(meshes, names=("left", "right"), intrinsics=scenes.INTRINSICS, parameters=REGION):
    caster = sensor.scene_raycaster(meshes)
    frames = [sensor.capture([], intrinsics, scenes.POSES[name], [8, i], camera=name, raycaster=caster) for i, name in enumerate(names)]
    return perceive(frames, parameters=parameters)


def at(scene, x, y):
    return min(scene.objects, key=lambda o: np.linalg.norm(o.world_from_object[:2, 3] - [x, y]))


def test_the_border_of_the_picture_cuts():
    hook = scenes.shape("l_hook", 1, 0.5, 0.0, 0.4)
    # The right half of the left camera's picture, so that the border runs through the hook.
    k = scenes.INTRINSICS
    narrow = Intrinsics(320, 480, k.fx, k.fy, 319.5, k.cy)
    whole, part = seen_by([hook], ("left",)), seen_by([hook], ("left",), narrow)
    assert at(whole, 0.5, 0.0).cut_off == () and at(part, 0.5, 0.0).cut_off == ("picture",)
    assert at(part, 0.5, 0.0).box_extents.max() < 0.9 * at(whole, 0.5, 0.0).box_extents.max()


def test_the_region_cuts():
    hook = scenes.shape("l_hook", 1, 0.5, 0.0, 0.4)
    scene = seen_by([hook], parameters=replace(REGION, region_low=(0.5, -0.6, -0.05)))
    assert scene.objects[0].cut_off == ("region",)


def test_what_lies_beyond_the_region_behind_a_tall_thing_does_not_cut_it():
    post = slab([0.06, 0.06, 0.25], [0.7, 0.0, 0.125], (90, 140, 90))
    assert seen_by([post]).objects[0].cut_off == ()


def test_what_hides_a_thing_is_named_unless_another_camera_looks_behind_it():
    eye = scenes.POSES["left"][:3, 3]
    hook = scenes.shape("l_hook", 1, 0.6, -0.1, 0.4)
    place = np.array([0.6, -0.1]) + 0.11 * transforms.unit(eye[:2] - [0.6, -0.1])
    tin = scenes.placed(slab([0.07, 0.07, 0.12], [0, 0, 0], (90, 140, 90)), *place)
    alone = seen_by([hook, tin], ("left",))
    found = max((o for o in alone.objects if o.box_extents[2] < 0.06), key=lambda o: o.box_extents.max())
    front = max(alone.objects, key=lambda o: o.box_extents[2])
    assert found.cut_off == (front.id,) and front.cut_off == ()
    both = seen_by([hook, tin])
    assert [o.cut_off for o in both.objects] == [(), ()]


def lying(family, seed, yaw, x, y):
    """A procedural object on the table, turned, with the middle of its box there."""
    mesh = shapes.make(family, seed).mesh.transformed(transforms.from_rpy(0, 0, yaw))
    middle = mesh.bounds.mean(axis=0)
    return mesh.transformed(transforms.make(translation=[x - middle[0], y - middle[1], -mesh.bounds[0, 2]]))


def tin(radius, height, x, y):
    cylinder = trimesh.creation.cylinder(radius, height, sections=48)
    return scenes.placed(Mesh(cylinder.vertices, cylinder.faces).painted((60, 140, 70)), x, y)


def before_the_station(thing, before, seed, names=("left", "right"), model=None, fixture=False):
    """What is told of a thing, and what stands before it, which may be a known fixture."""
    caster = sensor.scene_raycaster([thing, before])
    frames = [
        sensor.capture([], sensor.D435, sensor.STATION[name], [seed, i], model=model, camera=name, raycaster=caster)
        for i, name in enumerate(names)
    ]
    known = (SceneObject("post", before, (before,), np.eye(4), find_view(before, (before,)), source="known"),) if fixture else ()
    found = [item for item in perceive(frames, known, Parameters(region_low=(0.0, -0.7, -0.05))).objects if item.source == "camera"]
    middle = thing.bounds.mean(axis=0)[:2]
    return min(found, key=lambda item: np.linalg.norm(item.world_from_box[:2, 3] - middle)), found


@pytest.mark.parametrize(
    ("thing", "before", "seed", "fixture"),
    [
        (("l_hook", 88, -0.275, 0.55, -0.107), (0.027, 0.049, 0.707, -0.027), 88, False),
        (("caliper", 107, 0.157, 0.505, 0.03), (0.027, 0.115, 0.582, 0.133), 107, False),
        (("mug", 14, 2.927, 0.516, 0.116), (0.007, 0.346, 0.586, 0.111), 14, True),
    ],
    ids=["hook", "caliper", "cup behind a post"],
)
def test_a_thing_is_whole_where_what_stands_before_it_leaves_no_room_for_more(thing, before, seed, fixture):
    """In each picture a strip of it is hidden, in both the same corner: a few millimetres."""
    thing, before = lying(*thing), tin(*before)
    item, _ = before_the_station(thing, before, seed, fixture=fixture)
    assert item.cut_off == ()
    found = item.mesh.transformed(item.world_from_object)
    assert distance(thing, found) < 0.003


def test_a_wire_that_goes_on_behind_a_tin_is_cut_off():
    """What is thin has a short outline where it ends."""
    hanger = lying("hanger", 7, -1.830, 0.495, -0.094)
    item, found = before_the_station(hanger, tin(0.037, 0.126, 0.4, -0.205), 7, ("left",), sensor.SMEARED)
    front = max(found, key=lambda other: other.box_extents[2])
    assert item.box_extents.max() < hanger.extents.max() - 0.03 and item.cut_off == (front.id,)


@pytest.mark.parametrize(("color", "cut"), [((120, 60, 50), True), ((60, 90, 150), False)], ids=["one colour", "two colours"])
def test_what_may_be_the_rest_of_a_thing_leaves_it_cut_off(color, cut):
    """Two bars in one line, or one: between them is no room for more, and a tin is before that."""
    bars = [slab([0.02, 0.14, 0.016], [0.55, y, 0.008], paint) for y, paint in ((-0.077, (120, 60, 50)), (0.077, color))]
    _, found = before_the_station(concatenate(bars), tin(0.04, 0.15, 0.606, 0.0), 3)
    front = max(found, key=lambda item: item.box_extents[2])
    assert [item.cut_off for item in found if item is not front] == [(front.id,) if cut else ()] * 2


@pytest.mark.parametrize(("color", "count"), [((120, 60, 50), 1), ((60, 90, 150), 2)], ids=["part", "other colour"])
def test_what_hangs_beside_a_thing_of_its_colour_is_its_part(color, count):
    body = slab([0.08, 0.08, 0.10], [0.55, 0, 0.05], (120, 60, 50))
    # Before the body and apart by more than clusters reach over.
    bar = slab([0.012, 0.014, 0.06], [0.55 - 0.04 - 0.017 - 0.006, 0, 0.06], color)
    scene = seen_by([body, bar])
    assert len(scene.objects) == count
    if count == 1:
        assert scene.objects[0].box_extents.max() > 0.1


@pytest.mark.parametrize(("step", "share"), [(0.0, 40 / 156), (0.005, 40 / 156), (0.03, 0.0)])
def test_what_goes_on_at_its_depth_beside_a_thing_is_joined_to_it(step, share):
    labels, depth = np.zeros((120, 160), np.int32), np.full((120, 160), 0.8, np.float32)
    labels[40:80, 40:80], labels[40:80, 80:120] = 1, 2
    depth[40:80, 80:120] -= step
    frame = RgbdFrame(np.zeros((120, 160, 3), np.uint8), depth, Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0), np.eye(4), "camera")
    look = Looked(frame, depth, depth, np.ones((120, 160), bool), depth)
    assert joined([look], [labels], 1) == pytest.approx(share)
    assert joined([look], [np.minimum(labels, 1)], 1) == 0


def test_confidence_falls_with_what_was_seen(pair):
    """A tin seen by two cameras is near certain; by cameras apart, or cut by the picture, it is less so."""
    tin = scenes.shape("cylinder", 1, 0.5, 0.0)
    k = scenes.INTRINSICS
    # A picture that ends in the middle of the tin.
    middle = k.project(transforms.apply(transforms.inverse(scenes.POSES["left"]), tin.bounds.mean(axis=0)[None]))[0]
    narrow = Intrinsics(int(middle[0]), 480, k.fx, k.fy, k.cx, k.cy)
    both, part = seen_by([tin]).objects[0], seen_by([tin], ("left",), narrow).objects[0]
    assert both.confidence > 0.9 and both.seen_share > 0.6
    assert part.cut_off == ("picture",) and part.confidence < 0.5 and part.seen_share < both.seen_share
    good = {o.id: o.confidence for o in perceive(pair, parameters=REGION).objects}
    apart = {o.id: o.confidence for o in perceive(moved(pair, transforms.make(translation=[0.0065, 0.004, 0])), parameters=REGION).objects}
    assert all(apart[name] < good[name] for name in good)


@dataclass(frozen=True)
class Told:
    """A segmenter that is told the labels."""

    labels: list[np.ndarray]
    name: str = "told"

    def segment(self, looks, known, parameters):
        return [image.copy() for image in self.labels]


def test_what_goes_on_as_another_thing_is_cut_off_by_it():
    """A bar that segmentation has parted is no tool, and a bar beside a block of another height or colour is one."""
    bar = slab([0.02, 0.2, 0.016], [0.55, 0, 0.008], (120, 60, 50))
    upper = slab([0.02, 0.1, 0.05], [0.55, 0.05, 0.025], (120, 60, 50))
    blue = slab([0.02, 0.1, 0.016], [0.55, 0.05, 0.008], (60, 90, 150))
    lower = slab([0.02, 0.1, 0.016], [0.55, -0.05, 0.008], (120, 60, 50))
    for things, cut in (([bar], True), ([lower, upper], False), ([lower, blue], False)):
        caster = sensor.scene_raycaster(things)
        frames, parts = [], []
        for i, (name, pose) in enumerate(sensor.STATION.items()):
            frames.append(sensor.capture([], sensor.D435, pose, [7, i], camera=name, raycaster=caster))
            cast, depth = caster.perspective(sensor.D435, pose)
            y = transforms.apply(pose, sensor.D435.unproject(depth))[..., 1]
            parts.append(np.where(cast.ids > 0, np.where(y < 0, 1, 2), 0).astype(np.int32))
        found = perceive(frames, parameters=Parameters(region_low=(0.0, -0.7, -0.05)), segmenter=Told(parts)).objects
        assert [item.cut_off for item in found] == ([("object_2",), ("object_1",)] if cut else [(), ()])


def test_what_may_be_a_part_of_a_thing_is_counted_in_what_its_surface_may_be_off_by():
    """Each half of a bar that was parted is off by all of the other; of two colours they are two things, each as right as it is."""
    stated = {}
    for name, color in (("one", (120, 60, 50)), ("two", (60, 90, 150))):
        bars = [slab([0.02, 0.1, 0.03], [0.55, y, 0.015], c) for y, c in ((-0.05, (120, 60, 50)), (0.05, color))]
        caster = sensor.scene_raycaster(bars)
        frames = [
            sensor.capture([], sensor.D435, pose, [8, i], camera=camera, raycaster=caster)
            for i, (camera, pose) in enumerate(sensor.STATION.items())
        ]
        labels = [caster.perspective(sensor.D435, pose)[0].ids.clip(0).astype(np.int32) for pose in sensor.STATION.values()]
        found = perceive(frames, parameters=Parameters(region_low=(0.0, -0.7, -0.05)), segmenter=Told(labels)).objects
        whole = concatenate(bars) if name == "one" else None
        for item, bar in zip(found, bars, strict=True):
            assert distance(whole or bar, item.mesh.transformed(item.world_from_object)) < item.surface_error
        stated[name] = max(item.surface_error for item in found)
    assert stated["two"] < 0.010 < 0.025 < stated["one"]


def test_what_has_no_depth_of_its_own_is_left_out_with_a_note():
    bar = slab([0.02, 0.1, 0.03], [0.55, 0.0, 0.015], (120, 60, 50))
    frame = sensor.capture([bar], sensor.D435, sensor.STATION["left"], 9)
    blank = np.zeros(frame.depth.shape, bool)
    blank[60:90, 60:100] = True
    frame = replace(frame, depth=np.where(blank, np.float32(np.nan), frame.depth))
    report = Report()
    assert perceive([frame], segmenter=Told([blank.astype(np.int32)]), report=report).objects == ()
    assert any("is no object" in note for note in report.notes)


def test_a_thing_whose_parts_nothing_joins_is_not_whole():
    bar, rest = (slab([0.1, 0.02, 0.016], [x, 0, 0.008], (120, 60, 50)) for x in (0.0, 0.13))
    assert not hangs_together(concatenate([bar, rest]), 0.006)
    near = slab([0.1, 0.02, 0.016], [0.104, 0, 0.008], (120, 60, 50))
    assert hangs_together(bar, 0.006) and hangs_together(concatenate([bar, near]), 0.006)


def test_what_is_said_of_moved_cameras_is_measured(tmp_path, monkeypatch, capsys):
    """The command on one scene, to its end and its files: right cameras are left alone, cameras 40 mm apart are refused."""
    monkeypatch.setattr(moved_cameras, "measure", partial(moved_cameras.measure, shifts=(0.04,), turns=()))
    with pytest.raises(SystemExit) as end:
        evaluate.main(["--moved-cameras", "1", "--seed", "5", "--out", str(tmp_path)])
    assert end.value.code == 0
    told = json.loads((tmp_path / "evaluation.json").read_text())["moved_cameras"]["rows"]
    right, moved = told["right"], told["40 mm"]
    assert right["measured"] == moved["measured"] == 1
    assert right["said"] == right["refused"] == 0 and moved["said"] == moved["refused"] == 1
    assert right["error_mm"][0] < 10 and moved["error_mm"][0] < 10
    arm = json.loads((tmp_path / "evaluation.json").read_text())["moved_cameras"]["arm"]
    assert arm["0"]["measured"] == arm["40"]["measured"] == 2 and max(arm["0"]["error_mm"]) < 4 and max(arm["40"]["error_mm"]) < 8
    assert "| 40 mm | 1 of 1 | 1 | 1 | 0 |" in (tmp_path / "evaluation.md").read_text()
    assert "scene 1 of 1" in capsys.readouterr().err
