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


def seen_past(asked: np.ndarray, other: float = 0.04) -> np.ndarray:
    """A camera sees to be empty all that is in neither rectangle of :func:`side_by_side`, 80 mm wide and ``other``."""
    return np.abs(asked[:, 1] - 0.1) > np.where(asked[:, 0] < 0.5, 0.04, other / 2)


@pytest.mark.parametrize("turn", [0.0, 0.5, 1.9])
def test_the_plane_between_two_colours_is_found(turn):
    plane = cuts.planes(side_by_side(0.08, 0.05, turn))[0]
    assert abs(plane.distance(np.array([[0.5, 0.1]]))[0]) < cuts.STEP
    assert abs(np.sin(plane.angle - turn)) < np.sin(np.pi / cuts.DIRECTIONS)


@pytest.mark.parametrize(("other", "one"), [(0.08, True), (0.05, False)])
def test_what_is_one_convex_body_is_not_asked_for_its_colours(other, one):
    seen = cuts.Seen.of(side_by_side(0.08, other, 0.0), lambda asked: seen_past(asked, other))
    row = cuts.measured(seen, cuts.planes(seen.points)[0])
    assert cuts.convex(row) == one
    assert (cuts.best(cuts.rated(seen), lambda _: 1.0) is None) == one


def test_criteria_of_two_rectangles(monkeypatch):
    monkeypatch.setattr(cuts, "CELL", 0.001)
    seen = cuts.Seen.of(side_by_side(0.08, 0.07, 0.0), lambda asked: seen_past(asked, 0.07))
    told_ = dict(zip(cuts.CRITERIA, cuts.measured(seen, cuts.Plane(0.0, 0.5, 3.0)), strict=True))
    # The hull is a rectangle of 60 x 80 mm and a trapezoid from 80 to 70; in it beside the smaller rectangle two triangles, of which 4 mm
    # beside the plane are nobody's.
    hull, beside = 60 * 80 + 60 * 75, 60 * 5 * (56 / 60) ** 2
    assert cuts.SEEN * np.exp(told_["hull"]) == pytest.approx(beside / hull, abs=0.005)
    assert told_["block"] == pytest.approx(told_["hull"])
    assert told_["hollow"] == 0.0
    assert told_["contrast"] == pytest.approx(np.log(4))
    assert told_["own"] == pytest.approx(0.5, abs=0.01)
    assert told_["breadth"] == 0.0
    assert told_["slim"] == pytest.approx(56 / 80, abs=0.05)


def test_above_a_lower_side_a_block_is_seen_to_be_empty():
    """Two rectangles as broad, one half as high: the plan does not tell."""
    points = side_by_side(0.08, 0.08, 0.0)
    points.height[points.place[:, 0] > 0.5] /= 2
    seen = cuts.Seen.of(points, lambda asked: (asked[:, 0] > 0.5) & (asked[:, 2] > 0.015))
    told_ = dict(zip(cuts.CRITERIA, cuts.measured(seen, cuts.Plane(0.0, 0.5, 3.0)), strict=True))
    assert cuts.SEEN * np.exp(told_["hull"]) == pytest.approx(cuts.LEAST_SEEN)
    assert cuts.SEEN * np.exp(told_["block"]) == pytest.approx(cuts.MOST_SEEN)


def test_a_ring_is_hollow_on_both_sides_and_a_ring_beside_a_block_is_not():
    long = np.arange(-0.04, 0.04, 0.0012)
    grid = np.stack(np.meshgrid(long, long), axis=-1).reshape(-1, 2)
    ring = grid[np.abs(grid).max(axis=1) > 0.025]
    for other, hollow in ((ring, True), (grid, False)):
        place = np.concatenate([ring - [0.042, 0], other + [0.042, 0]])
        lab = np.repeat([[120.0, 150.0, 90.0], [120.0, 110.0, 160.0]], [len(ring), len(other)], axis=0)
        free = [-0.042, 0.042] if hollow else [-0.042]
        seen = cuts.Seen.of(
            cuts.Points(place, np.full(len(place), 0.03), lab),
            lambda asked, free=free: np.any([np.abs(asked[:, :2] - [x, 0]).max(axis=1) < 0.025 for x in free], axis=0),
        )
        told_ = dict(zip(cuts.CRITERIA, cuts.measured(seen, cuts.Plane(0.0, 0.0, 3.0)), strict=True))
        assert told_["hollow"] == pytest.approx((50 / 78) ** 2 if hollow else 0.0, abs=0.06)


def test_a_narrow_side_is_as_narrow_as_it_is():
    points = side_by_side(0.024, 0.03, 0.0)
    seen = cuts.Seen.of(points, lambda asked: np.zeros(len(asked), bool))
    told_ = dict(zip(cuts.CRITERIA, cuts.measured(seen, cuts.Plane(0.0, 0.5, 3.0)), strict=True))
    assert 0.040 * np.exp(told_["breadth"]) == pytest.approx(0.024, abs=0.002)
    assert told_["slim"] == pytest.approx(24 / 60, abs=0.05)


def test_what_no_camera_sees_is_no_evidence():
    """A rectangle of two colours, one of whose halves is narrower: two things only where a camera sees that what it lacks is not there."""
    points, plane = side_by_side(0.08, 0.04, 0.0), cuts.Plane(0.0, 0.5, 3.0)
    past, none = (cuts.measured(cuts.Seen.of(points, told_), plane) for told_ in (seen_past, lambda asked: np.zeros(len(asked), bool)))
    assert not cuts.convex(past) and cuts.convex(none)


def test_a_notch_is_seen_to_be_empty_unless_something_stands_before_it():
    """Of a thing with a notch, before which a post stands, as the left camera sees it."""
    back = concatenate([box((0.07, 0.10, 0.05), 0.465, 0.0, BLUE), box((0.07, 0.05, 0.05), 0.535, -0.025, BLUE)])
    post = box((0.07, 0.07, 0.16), 0.62, 0.11, RED)
    notch, inside = np.array([[0.535, 0.025, 0.02]]), np.array([[0.465, 0.0, 0.02]])
    for meshes, names, told_ in (([back], ("left",), True), ([back, post], ("left",), False), ([back, post], ("left", "right"), True)):
        caster = sensor.scene_raycaster(meshes)
        frames = [
            sensor.capture([], sensor.D435, sensor.STATION[name], [5, i], camera=name, raycaster=caster) for i, name in enumerate(names)
        ]
        looks = learn_cuts.looked_at(Pile(frames, [], meshes), Parameters())
        bared = cuts.bare(looks, clustered(looks, (), Parameters()))
        assert cuts.empty(looks, bared, notch)[0] == told_
        assert not cuts.empty(looks, bared, inside)[0]


def test_depth_that_is_lost_shows_nothing_to_be_empty():
    """A block whose middle has no depth, as a dark carton's: where its mask goes on nothing is empty."""
    block = box((0.10, 0.10, 0.05), 0.5, 0.0, BLUE)
    frame = sensor.capture([block], sensor.D435, sensor.STATION["left"], 5, camera="left")
    rows, columns = np.nonzero(frame.color[..., 2] > frame.color[..., 0].astype(int) + 40)
    v, u = int(np.median(rows)), int(np.median(columns))
    frame.depth[v - 8 : v + 8, u - 8 : u + 8] = np.nan
    looks = learn_cuts.looked_at(Pile([frame], [], [block]), Parameters())
    found = clustered(looks, (), Parameters())
    assert np.isnan(looks[0].frame.depth[v, u]) and not cuts.bare(looks, found)[0][v, u]
    grid = np.stack(np.meshgrid(np.arange(0.46, 0.54, 0.004), np.arange(-0.04, 0.04, 0.004), [0.03]), axis=-1).reshape(-1, 3)
    assert not cuts.empty(looks, cuts.bare(looks, found), grid).any()


@pytest.mark.parametrize("number", [54, 64])
def test_a_striped_thing_that_another_hides_in_part_is_one(number):
    made = neighbours.behind(2001, number)
    assert len(made.meshes) == 2 and learn_cuts.told(made, DepthSegmenter()) == "right"


def test_a_box_on_a_box_is_another():
    made = neighbours.stacked(5000, 19)
    assert len(made.meshes) == 2 and learn_cuts.told(made, DepthSegmenter()) == "right"


def test_of_a_torn_scene_the_asked_share_of_the_things_depth_is_missing_and_no_colour():
    whole = neighbours.pair(5, 3)
    for number, share in enumerate(neighbours.MISSING):
        made = neighbours.torn(whole, number)
        for before, after, truth in zip(whole.frames, made.frames, made.truth, strict=True):
            seen = np.isfinite(before.depth) & (truth > 0)
            assert np.mean(np.isnan(after.depth[seen])) == pytest.approx(share, abs=0.05)
            assert np.array_equal(after.color, before.color)


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
