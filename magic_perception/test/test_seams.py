"""Which seams part things, boxes by their faces, things without depth, and how chances are fitted."""

import numpy as np
import pytest
import scenes
import trimesh
from scipy.spatial import cKDTree

from magic_core import sensor, shapes, transforms
from magic_core.errors import Code
from magic_core.mesh import Mesh
from magic_perception import convexity, learn_confidence, learn_seams, logistic, seams
from magic_perception.parameters import Parameters
from magic_perception.piles import pile
from magic_perception.pipeline import Report, perceive


def box(size, x=0.0, y=0.0, z=0.0, yaw=0.0, color=(180, 60, 50)):
    made = trimesh.creation.box(size)
    made.apply_transform(transforms.from_rpy(0, 0, yaw, [x, y, z + size[2] / 2]))
    return Mesh(made.vertices, made.faces).painted(color)


def test_a_fit_finds_the_weights_that_made_its_examples(tmp_path):
    random = np.random.default_rng(0)
    rows = random.normal(size=(6000, 2)) * [1.0, 5.0]
    truth = random.random(6000) < 1 / (1 + np.exp(-(0.5 + rows @ [2.0, -0.3])))
    model = logistic.fit(rows, truth)
    assert model.constant == pytest.approx(0.5, abs=0.15) and model.weights == pytest.approx([2.0, -0.3], abs=0.15)
    model.save(tmp_path / "m.json", ["a", "b"])
    again = logistic.load(tmp_path / "m.json", ["b", "a"])
    assert again.odds(np.array([1.0, 2.0])) == pytest.approx(model.odds(np.array([2.0, 1.0])), abs=1e-3)
    assert again.chance(np.array([0.0, 50.0])) > 0.999


def two_faces(angle):
    """Voxels of two strips (0 to 60 mm) that meet at an edge and bend there by ``angle`` degrees, inward where it is positive."""
    steps = np.arange(8) * 0.008 + 0.004
    s, t = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    zero, one = np.zeros_like(s), np.ones_like(s)
    c, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    centre = np.vstack([np.column_stack([-s, t, zero]), np.column_stack([s * c, t, s * sine])])
    normal = np.vstack([np.column_stack([zero, zero, one]), np.column_stack([-sine * one, zero, c * one])])
    a, b = (i.ravel() for i in np.triu_indices(len(centre), 1))
    near = np.linalg.norm(centre[a] - centre[b], axis=1) < 0.0144
    a, b = a[near], b[near]
    d = (centre[a] - centre[b]) / np.linalg.norm(centre[a] - centre[b], axis=1, keepdims=True)
    opening = np.sum((normal[a] - normal[b]) * d, axis=1)
    bend = np.degrees(np.arccos(np.clip(np.sum(normal[a] * normal[b], axis=1), -1, 1)))
    color = np.vstack([np.tile([0.6, 0.2, 0.2], (64, 1)), np.tile([0.2, 0.2, 0.6], (64, 1))])
    return seams.Voxels(centre, normal, centre[:, 2], color, a, b, opening, bend, np.ones(len(a), bool)), np.repeat([0, 1], 64)


@pytest.mark.parametrize("angle", [60, -60])
def test_what_is_measured_at_an_edge(angle):
    voxels, part = two_faces(angle)
    seen = []
    joined = seams.joined(voxels, part, lambda row, *_: seen.append(dict(zip(seams.CRITERIA, row, strict=True))) or 1.0)
    assert np.array_equal(joined, part)
    (told,) = seen
    assert told["bend"] == pytest.approx(angle / 90, abs=0.01)
    assert told["concave"] == (1.0 if angle > 0 else 0.0)
    assert (told["hull"] > 0.7) == (angle > 0)
    assert told["own"] == 0.5 and told["hue"] == pytest.approx(0.3) and told["edge"] > 2
    assert told["told"] == 1.0


def test_parts_are_joined_until_none_is_likelier_one():
    voxels, part = two_faces(60)
    assert seams.joined(voxels, part, lambda *_: -1.0).max() == 0
    fine = part * 2 + (voxels.centre[:, 1] > 0.03)
    # Only what differs in colour is two.
    by_color = seams.joined(voxels, fine, lambda row, *_: row[list(seams.CRITERIA).index("hue")] - 0.1)
    assert np.array_equal(by_color, part)


def faces_of(blocks):
    """Voxels of the front, left and top faces of blocks (low and high corner, m, colour 0..1), where no other block covers them; normals as
    smooth as cameras'."""
    points, normal, color = [], [], []
    for number, (low, high, paint) in enumerate(blocks):
        for axis, end, way in ((1, low, -1.0), (0, low, -1.0), (2, high, 1.0)):
            spans = [np.arange(low[i] + 0.001, high[i], 0.002) for i in range(3)]
            spans[axis] = np.array([end[axis]])
            face = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 3)
            for other in blocks[:number] + blocks[number + 1 :]:
                face = face[~np.all((face >= np.array(other[0]) - 1e-6) & (face <= np.array(other[1]) + 1e-6), axis=1)]
            points.append(face)
            normal.append(np.tile(way * np.eye(3)[axis], (len(face), 1)))
            color.append(np.tile(paint, (len(face), 1)))
    place, faced = np.concatenate(points), np.concatenate(normal)
    near = cKDTree(place).query_ball_point(place, 0.010)
    smooth = np.array([faced[some].mean(axis=0) for some in near])
    smooth /= np.linalg.norm(smooth, axis=1, keepdims=True)
    return convexity.voxels_of(place, smooth, place[:, 2], np.concatenate(color))[0]


RED, BLUE = (0.7, 0.2, 0.2), (0.2, 0.2, 0.7)


def test_what_stands_on_a_top_is_cut_from_it_though_their_fronts_go_on_in_one_plane():
    voxels = faces_of([((0, 0, 0), (0.12, 0.10, 0.06), RED), ((0.04, 0, 0.06), (0.10, 0.05, 0.11), BLUE)])
    part = convexity.on_tops(voxels)
    upper = voxels.height > 0.066
    assert len(set(part[upper])) == 1 and not set(part[upper]) & set(part[voxels.height < 0.054])


def test_what_stands_beside_a_top_is_not_cut_at_its_height():
    voxels = faces_of([((0, 0, 0), (0.10, 0.10, 0.05), RED), ((0.10, 0, 0), (0.16, 0.10, 0.14), BLUE)])
    assert convexity.on_tops(voxels).max() == 0


def test_examples_tell_things_from_parts_of_one():
    single = next(s for s in (learn_seams._procedural(k) for k in range(3, 9)) if s.things == 1)
    assert not single.examples.two.any()
    made = pile(6)
    again = pile(6)
    assert made.things == 6 and np.array_equal(made.frames[0].color, again.frames[0].color)
    assert np.array_equal(made.frames[0].depth, again.frames[0].depth, equal_nan=True)
    assert set(np.unique(made.truth[0])) <= set(range(-1, 7))


def test_a_box_of_which_two_faces_show_has_its_sizes():
    size = (0.158, 0.060, 0.210)
    mesh = scenes.placed(box(size, yaw=0.6), 0.5, 0.02)
    pose = scenes.pose([-0.15, 0.1, 0.55], [0.5, 0.0, 0.08])
    frame = sensor.capture([mesh], sensor.D435, pose, 3, model=sensor.SMEARED)
    report = Report()
    (item,) = perceive([frame], report=report).objects
    assert report.shapes[item.id] == "box"
    assert np.sort(item.box_extents) == pytest.approx(np.sort(size), abs=0.001)
    assert item.mesh.to_trimesh().is_watertight and len(item.pieces) == 1


def test_a_mug_and_a_bottle_are_no_boxes():
    for family, seed in (("mug", 1), ("mug", 4)):
        mesh = scenes.placed(shapes.make(family, seed).mesh, 0.5, 0.0, 0.4)
        report = Report()
        perceive([scenes.capture([mesh])[0]], report=report)
        assert "box" not in report.shapes.values()


def without_depth(frame, ids, number):
    depth = frame.depth.copy()
    depth[ids == number] = np.nan
    return type(frame)(frame.color, depth, frame.intrinsics, frame.world_from_camera, frame.camera, frame.stamp)


def test_a_glass_without_depth_is_said_and_no_object():
    glass = scenes.placed(
        Mesh(*(lambda m: (m.vertices, m.faces))(trimesh.creation.cylinder(0.035, 0.11))).painted((190, 205, 215)), 0.5, 0.08
    )
    block = scenes.placed(box((0.08, 0.06, 0.06)), 0.5, -0.1)
    frame, ids = scenes.capture([glass, block], "left")
    scene = perceive([without_depth(frame, ids, 0)], parameters=Parameters())
    assert len(scene.objects) == 1
    (note,) = [n for n in scene.notes if "gives no depth" in n]
    assert (f"{int(Code.NO_DEPTH)} NO_DEPTH" in note and "(0.50, 0.0" in note) or "(0.49, 0.0" in note or "(0.51, 0.0" in note
    # A hole in the depth of the bare table is none.
    bare, ids = scenes.capture([block], "left")
    bare.depth[200:260, 250:300] = np.nan
    assert not [n for n in perceive([bare]).notes if "gives no depth" in n]


def test_confidence_is_judged_by_scenes_it_does_not_know():
    random = np.random.default_rng(1)
    things = []
    for scene in range(100):
        good = bool(random.random() < 0.5)
        row = random.normal(size=len(learn_confidence.NUMBERS)) + 2.0 * good
        things.append(learn_confidence.Judged(scene, "box", row, 0.9 if good else 0.4, 0.9))
    text = learn_confidence.cross_validated(things)
    assert "100 things in 100 scenes" in text and "| 0.8 to 1.0 |" in text


def ring(radius, inward):
    """Voxels on the upright wall of half a round body, 48 mm high."""
    turn, z = (a.ravel() for a in np.meshgrid(np.linspace(0, np.pi, 20), np.arange(6) * 0.008, indexing="ij"))
    way = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    return radius * way + [0.3, 0.1, 0] + np.column_stack([0 * z, 0 * z, z]), -way if inward else way


@pytest.mark.parametrize("inward, aside, cup", [(True, 0.0, True), (False, 0.0, False), (True, 0.05, False)])
def test_the_inside_and_the_outside_of_a_bowl_are_told_by_their_normals(inward, aside, cup):
    (outer, away), (inner, toward) = ring(0.06, False), ring(0.055, inward)
    centre, normal = np.vstack([outer, inner + [aside, 0, 0]]), np.vstack([away, toward])
    part = np.repeat([0, 1], len(outer))
    voxels = seams.Voxels(centre, normal, centre[:, 2], np.full_like(centre, 0.5), *(np.zeros(0, int),) * 2, *(np.zeros(0),) * 3)
    assert seams._cup(voxels, *(seams._part(voxels, part, i, voxels.shade) for i in (0, 1))) == cup


def test_what_colour_alone_tells_of_beyond_the_tables_edge_is_no_thing():
    block = scenes.placed(box((0.08, 0.06, 0.06)), 0.5, -0.1)
    frame, _ = scenes.capture([block], "left")
    # The floor: another colour, and depth in a few spots, some mm over the table's plane.
    frame.color[100:300, :60] = (60, 40, 30)
    spots = np.zeros(frame.depth.shape, bool)
    spots[150:260:30, 20:26] = spots[151:261:30, 20:26] = spots[152:262:30, 20:26] = True
    floor = np.zeros(frame.depth.shape, bool)
    floor[100:300, :60] = True
    frame.depth[spots] -= 0.008
    frame.depth[floor & ~spots] = np.nan
    assert len(perceive([frame]).objects) == 1


def test_parts_across_a_gap_are_judged_too():
    voxels, part = two_faces(60)
    keep = part[voxels.a] == part[voxels.b]
    cut = seams.Voxels(
        *(getattr(voxels, n) for n in ("centre", "normal", "height", "rgb")),
        *(getattr(voxels, n)[keep] for n in ("a", "b", "opening", "bend", "clear")),
    )
    seen = []
    assert seams.joined(cut, part, lambda row, *_: seen.append(row) or -1.0).max() == 0
    (row,) = seen
    assert dict(zip(seams.CRITERIA, row, strict=True))["told"] == 0
    assert seams.joined(cut, part, lambda *_: 1.0).max() == 1


@pytest.mark.parametrize(
    ("rise", "bend", "count"),
    [(0.0, 0, 1), (0.0, -70, 1), (0.0, 25, 1), (0.0, 70, 2), (0.020, 0, 2)],
    ids=["level", "an edge", "a hollow", "a corner", "a step"],
)
def test_parts_on_both_sides_of_a_gap_in_depth_are_one_where_their_surface_goes_on(rise, bend, count):
    """Two patches of different colours, 40 mm apart: the second ``rise`` metres higher, or bent up about the middle of the gap by so many
    degrees."""
    s, t = (a.ravel() for a in np.meshgrid(np.arange(0.020, 0.080, 0.004), np.arange(0, 0.060, 0.004), indexing="ij"))
    zero, turn = np.zeros_like(s), np.radians(bend)
    place = np.vstack([np.column_stack([-s, t, zero]), np.column_stack([s * np.cos(turn), t, s * np.sin(turn) + rise])])
    place[:, 2] += 0.2
    normal = np.repeat([[0, 0, 1], [-np.sin(turn), 0, np.cos(turn)]], len(s), axis=0)
    color = np.repeat([[180.0, 60, 50], [50, 80, 170]], len(s), axis=0)
    edge = np.nonzero(s < 0.022)[0]
    across = np.column_stack([edge, len(s) + edge])

    def parts(across):
        return len(np.unique(convexity.parts(place, normal, place[:, 2], color, lambda *_: 1.0, across=across)))

    assert parts(across) == count
    assert parts(None) == 2


def test_the_outside_of_a_bowl_belongs_to_its_inside_though_little_of_it_shows():
    turn, up = (a.ravel() for a in np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 1, 12), indexing="ij"))
    way = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    wall = np.column_stack([(0.05 + 0.03 * up)[:, None] * way[:, :2], 0.05 * up])
    near = np.cos(turn) < -0.5
    points = np.vstack([wall, wall[near] + 0.004 * way[near]])
    normal = np.vstack([-way, way[near]])
    labels = np.repeat([0, 1], [len(wall), near.sum()])
    assert convexity.insides(points, normal, labels, points[:, 2]).max() == 0
    # An egg in the bowl is no part of it.
    egg = np.column_stack([0.015 * way[:, :2], 0.02 + 0.025 * up])
    apart = convexity.insides(
        np.vstack([wall, egg]), np.vstack([-way, way]), np.repeat([0, 1], len(wall)), np.concatenate([wall[:, 2], egg[:, 2]])
    )
    assert apart.max() == 1


def ladle():
    """Points and normals (N, 3) of a bowl's inside, of its near wall's outside with a long handle, and of an egg that lies in it at the
    wall."""
    turn, up = (a.ravel() for a in np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 1, 16), indexing="ij"))
    way = np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    wall = np.column_stack([(0.03 + 0.02 * up)[:, None] * way[:, :2], 0.03 + 0.05 * up])
    near = np.cos(turn) < -0.3
    along, around = (a.ravel() for a in np.meshgrid(np.linspace(-0.30, -0.055, 90), np.linspace(0.2, 2.9, 8), indexing="ij"))
    side = np.column_stack([np.zeros_like(around), np.cos(around), np.sin(around)])
    bar = np.column_stack([along, 0.006 * side[:, 1], 0.07 + 0.006 * side[:, 2]])
    egg = np.column_stack([0.030 + 0.015 * way[:, 0], 0.015 * way[:, 1], 0.04 + 0.025 * up])
    return (wall, -way), (np.vstack([wall[near] + 0.003 * way[near], bar]), np.vstack([way[near], side])), (egg, way)


def test_the_parts_of_a_ladle_s_bowl_are_one_though_its_handle_belongs_to_one_of_them():
    inside, handled, egg = ladle()
    red, blue = (180.0, 40.0, 40.0), (40.0, 60.0, 180.0)

    def one(first, second, colors=(red, red)):
        points, normal = (np.vstack([first[i], second[i]]) for i in range(2))
        labels = np.repeat([0, 1], [len(first[0]), len(second[0])])
        return (
            convexity.with_handles(points, normal, labels, points[:, 2], np.repeat(colors, [len(first[0]), len(second[0])], axis=0)).max()
            == 0
        )

    assert one(inside, handled)
    # So they are where a part of the inside is the handle's.
    half, bar = inside[0][:, 0] < 0.0, tuple(x[-720:] for x in handled)
    assert one(tuple(x[~half] for x in inside), tuple(np.vstack([b, a[half]]) for a, b in zip(inside, bar, strict=True)))
    assert not one(inside, handled, (red, blue))
    # Nor is it so of what lies in the bowl, or touches it from without.
    assert not one(inside, egg)
    assert not one(inside, (bar[0] + [0.006, 0.0, 0.0], bar[1]))
