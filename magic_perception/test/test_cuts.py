"""Neighbours of different colours are two things though depth fills the gap between them; one thing of two colours is one."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import scenes
import shapely
import trimesh

from magic_core import sensor
from magic_core.camera import Intrinsics
from magic_core.mesh import Mesh, concatenate
from magic_perception import cuts, evaluate, learn_cuts, logistic, neighbours
from magic_perception.clustered import clustered
from magic_perception.parameters import Parameters
from magic_perception.piles import Pile
from magic_perception.segmentation import DepthSegmenter

BLUE, RED = (60, 90, 200), (180, 60, 50)


def box(size: tuple[float, float, float], x: float, y: float, color: tuple[int, int, int]) -> Mesh:
    solid = trimesh.creation.box(size)
    return scenes.placed(Mesh(solid.vertices, solid.faces).painted(color), x, y)


def can(radius: float, height: float, x: float, color: tuple[int, int, int]) -> Mesh:
    solid = trimesh.creation.cylinder(radius, height, sections=64)
    return scenes.placed(Mesh(solid.vertices, solid.faces).painted(color), x, 0.0)


def told(meshes: list[Mesh], names: tuple[str, ...]) -> str:
    """What becomes of things by the sensor that smears."""
    caster = sensor.scene_raycaster(meshes)
    frames = [
        sensor.capture([], sensor.D435, sensor.STATION[name], [4, i], camera=name, model=sensor.SMEARED, raycaster=caster)
        for i, name in enumerate(names)
    ]
    truth = [caster.perspective(sensor.D435, sensor.STATION[name])[0].ids for name in names]
    return learn_cuts.told(Pile(frames, truth, meshes), DepthSegmenter())


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
@pytest.mark.parametrize(
    "meshes",
    [
        pytest.param([box((0.06, 0.10, 0.03), 0.50, 0.0, BLUE), box((0.05, 0.06, 0.03), 0.558, 0.01, RED)], id="low boxes, 3 mm"),
        pytest.param([box((0.06, 0.10, 0.09), 0.50, 0.0, BLUE), box((0.06, 0.07, 0.09), 0.565, 0.0, RED)], id="tall boxes, 5 mm"),
        pytest.param([can(0.03, 0.08, 0.50, BLUE), can(0.03, 0.08, 0.563, RED)], id="cans, 3 mm"),
        pytest.param([box((0.06, 0.08, 0.04), 0.50, 0.0, BLUE), box((0.06, 0.06, 0.02), 0.56, 0.0, RED)], id="of two heights, touching"),
    ],
)
def test_neighbours_of_two_colours_are_two(meshes, names):
    assert told(meshes, names) == "right"


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
@pytest.mark.parametrize(
    "mesh",
    [
        pytest.param(
            concatenate([box((0.06, 0.08, 0.04), 0.50, 0.0, BLUE), box((0.05, 0.08, 0.04), 0.555, 0.0, RED)]), id="a block of two halves"
        ),
        pytest.param(
            concatenate([box((0.06, 0.09, 0.04), 0.50, 0.0, BLUE), box((0.10, 0.02, 0.02), 0.58, 0.0, RED)]), id="a head with a handle"
        ),
    ],
)
def test_one_thing_of_two_colours_is_one(mesh, names):
    assert told([mesh], names) == "right"


CAPTURE = Path(__file__).resolve().parents[3] / "shared/data/rgbd/mugs"


@pytest.mark.skipif(not CAPTURE.is_dir(), reason="the shared captures are not here")
def test_a_figure_and_the_carton_before_it_are_two_in_a_real_capture():
    k = json.loads((CAPTURE / "intrinsics.json").read_text())["cluttered_6"]
    intrinsics = Intrinsics(640, 480, k["fx"], k["fy"], k["cx"], k["cy"])
    frame = evaluate.read_frame(CAPTURE / "cluttered_6_color.png", CAPTURE / "cluttered_6_depth_mm.png", intrinsics, "camera")
    parameters = Parameters(region_low=(-1.3, -1.3, -0.05), region_high=(1.3, 1.3, 0.6))
    labels = DepthSegmenter().segment([evaluate.looked_at(frame, parameters)], (), parameters)[0]
    figure, carton = labels[120, 252], labels[195, 280]
    assert figure > 0 and carton > 0 and figure != carton


def side_by_side(wide: float, other: float, turn: float) -> cuts.Points:
    """Two flat rectangles beside each other, 60 mm long and so wide, m, the plane between them through (0.5, 0.1) and turned."""
    long = np.arange(0.0005, 0.06, 0.0012)
    grids = [np.stack(np.meshgrid(s * long, np.arange(-w / 2, w / 2, 0.0012)), axis=-1).reshape(-1, 2) for s, w in ((-1, wide), (1, other))]
    c, s = np.cos(turn), np.sin(turn)
    place = np.concatenate(grids) @ np.array([[c, s], [-s, c]]) + [0.5, 0.1]
    lab = np.repeat([[120.0, 150.0, 90.0], [120.0, 110.0, 160.0]], [len(grid) for grid in grids], axis=0)
    return cuts.Points(place, np.full(len(place), 0.03), lab + np.random.default_rng(0).normal(0, 2, lab.shape))


@pytest.mark.parametrize("turn", [0.0, 0.5, 1.9])
def test_the_plane_between_two_colours_is_found(turn):
    plane = cuts.planes(side_by_side(0.08, 0.05, turn))[0]
    assert abs(plane.distance(np.array([[0.5, 0.1]]))[0]) < cuts.STEP
    assert abs(np.sin(plane.angle - turn)) < np.sin(np.pi / cuts.DIRECTIONS)


@pytest.mark.parametrize(("other", "one"), [(0.08, True), (0.05, False)])
def test_what_is_one_convex_body_is_not_asked_for_its_colours(other, one):
    seen = cuts.Seen.of(side_by_side(0.08, other, 0.0))
    row = cuts.measured(seen, cuts.planes(seen.points)[0])
    assert cuts.convex(row) == one
    assert (cuts.best(seen, lambda _: 1.0) is None) == one


def test_criteria_of_two_rectangles():
    seen = cuts.Seen.of(side_by_side(0.08, 0.04, 0.0))
    told_ = dict(zip(cuts.CRITERIA, cuts.measured(seen, cuts.Plane(0.0, 0.5, 3.0)), strict=True))
    # Without 4 mm on either side of the plane, in mm2: rectangles of 56 x 80 and 56 x 40; a trapezoid from 80 to 40 between; 77.5 are its width at the plane.
    hull = 56 * 80 + 64 * 60
    assert 0.03 * np.exp(told_["hull"]) == pytest.approx(1 - (56 * 80 + 56 * 40 + 8 * 77.5) / hull, abs=0.005)
    assert told_["contrast"] == pytest.approx(np.log(4))
    assert told_["own"] == pytest.approx(0.5, abs=0.01)
    assert 0.040 * np.exp(told_["breadth"]) == pytest.approx(0.04, abs=0.002)
    assert told_["slim"] == pytest.approx(40 / 60, abs=0.05)


def test_what_other_things_hide_is_no_evidence():
    """A rectangle of two colours, one of whose halves is narrower: two things, unless other things hide what it lacks."""
    seen = side_by_side(0.08, 0.04, 0.0)
    places = np.stack(np.meshgrid(np.arange(0.504, 0.56, cuts.PLACE), np.arange(0.064, 0.14, cuts.PLACE)), axis=-1).reshape(-1, 2)
    places = places[np.abs(places[:, 1] - 0.1) > 0.02]
    plane = cuts.Plane(0.0, 0.5, 3.0)
    alone, behind = (cuts.measured(cuts.Seen.of(seen, hidden), plane) for hidden in (cuts.NOWHERE, places))
    assert not cuts.convex(alone) and cuts.convex(behind)
    filled = list(cuts.CRITERIA).index("filled")
    assert behind[filled] > alone[filled] + 0.1


def test_what_is_behind_another_thing_is_hidden_unless_a_camera_sees_that_it_is_empty():
    """Of a thing with a notch, before which a post stands, as the left camera sees it."""
    back = concatenate([box((0.07, 0.10, 0.05), 0.465, 0.0, BLUE), box((0.07, 0.05, 0.05), 0.535, -0.025, BLUE)])
    post = box((0.07, 0.07, 0.16), 0.62, 0.11, RED)
    caster = sensor.scene_raycaster([back, post])
    notch = {}
    for names in (("left",), ("left", "right")):
        frames = [
            sensor.capture([], sensor.D435, sensor.STATION[name], [5, i], camera=name, raycaster=caster) for i, name in enumerate(names)
        ]
        looks = learn_cuts.looked_at(Pile(frames, [], [back, post]), Parameters())
        found = clustered(looks, (), Parameters())
        images, height = cuts.images_of(looks, found, found.instance), cuts.points_of(looks, found).height
        for label in np.flatnonzero(np.bincount(found.instance[found.instance >= 0]) > cuts.LEAST):
            mine = np.nonzero(found.instance == label)[0]
            place = cuts.hidden(looks, images, int(label), found.cloud[mine], height[mine])
            if np.median(found.cloud[mine, 0]) > 0.6:
                assert len(place) == 0
            else:
                notch[names] = np.count_nonzero(np.all((place > [0.51, 0.005]) & (place < [0.56, 0.045]), axis=1))
    assert notch["left",] > 10 and notch["left", "right"] < 4


@pytest.mark.parametrize("number", [54, 64])
def test_a_striped_thing_that_another_hides_in_part_is_one(number):
    made = neighbours.behind(2001, number)
    assert len(made.meshes) == 2 and learn_cuts.told(made, DepthSegmenter()) == "right"


def test_a_box_on_a_box_is_another():
    made = neighbours.stacked(5000, 19)
    assert len(made.meshes) == 2 and learn_cuts.told(made, DepthSegmenter()) == "right"


def test_three_boxes_are_as_far_from_each_other_as_asked():
    """The gap of a pair is that of the third thing from the nearer of the two."""
    number = next(i for i, (_, gap, *_) in enumerate(neighbours.PAIRS) if gap == 0.010)
    outlines = [shapely.MultiPoint(mesh.vertices[:, :2]).convex_hull for mesh in neighbours.three(5000, number).meshes]
    far = sorted(a.distance(b) for a, b in itertools.combinations(outlines, 2))
    assert far[:2] == pytest.approx([0.010, 0.010], abs=1e-4)


def test_points_near_the_plane_follow_their_colour():
    points = side_by_side(0.08, 0.05, 0.0)
    # 6 mm beside the edge of the colours.
    first = cuts._first(points, cuts.Plane(0.0, 0.506, 3.0))
    assert np.mean(first == (points.place[:, 0] < 0.5)) > 0.99


def test_examples_are_planes_that_leave_things_whole():
    made = neighbours.pair(0, neighbours.PAIRS.index((("box", "box"), 0.005, (0.012, 0.045), True)))
    (cluster,) = learn_cuts.clusters_of(made, Parameters(), 0, "pair")
    assert cluster.things == 2 and cluster.two.any() and not cluster.two.all()
    alone = learn_cuts.clusters_of(neighbours.single(0, 0), Parameters(), 0, "single")
    assert not any(c.two.any() for c in alone)
    assert isinstance(learn_cuts.fit([cluster]), logistic.Logistic)
