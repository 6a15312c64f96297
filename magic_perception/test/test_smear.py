"""Smear at edges and over holes is taken out by colour, and what has the table's colour is left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import scenes

from magic_core import sensor
from magic_perception import smear
from magic_perception.evaluate import overlap
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive

TABLE, THING = (150, 120, 90), (60, 70, 120)


def ring(outer: int = 50, inner: int = 20) -> np.ndarray:
    """A flat ring (200, 200) in the middle."""
    v, u = np.mgrid[0:200, 0:200]
    away = np.hypot(u - 100, v - 100)
    return (away < outer) & (away >= inner)


def picture(thing: np.ndarray, color: tuple[int, int, int] = THING, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.where(thing[..., None], color, TABLE) + rng.normal(0, 2, (*thing.shape, 3))
    return np.clip(cv2.GaussianBlur(image, (0, 0), 0.6), 0, 255).astype(np.uint8)


def cleared(mask: np.ndarray, color: np.ndarray, depth: np.ndarray, seen: np.ndarray, unlike: float = 0.0) -> np.ndarray:
    table = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) == 0
    everywhere = np.ones(mask.shape, bool)
    return smear.cleared(
        mask, smear.softened(color), depth, table, np.where(seen, 100, unlike).astype(np.float32), everywhere, everywhere, 615.0
    )[0]


@pytest.mark.parametrize("hollow", [0.0, 0.02])
def test_a_fattened_ring_with_its_hole_filled_becomes_the_ring_again(hollow: float) -> None:
    truth = ring(18, 8)
    wide = ring(23, 0)
    depth = np.where(ring(200, 8), 0.6, 0.6 + hollow).astype(np.float32)
    found = cleared(wide, picture(truth), depth, truth)
    # To a pixel at either edge, which the segmenter then puts where the colour is half way.
    assert overlap(truth, found) > 0.85 > 0.5 > overlap(truth, wide)
    assert not found[96:104, 96:104].any()


@pytest.mark.parametrize(("hollow", "remains"), [(0.003, False), (0.0, True)])
def test_a_hole_that_depth_filled_almost_is_open_also_where_depth_goes_on_past_the_rim(hollow: float, remains: bool) -> None:
    # A handle close to the table; and a label of the table's colour, which lies on its face.
    truth = ring(24, 12)
    table = cv2.dilate(ring(24, 0).astype(np.uint8), np.ones((9, 9))) == 0
    depth = np.where(ring(200, 12), 0.6, 0.6 + hollow).astype(np.float32)
    unlike, everywhere = np.where(truth, 100, 0.0).astype(np.float32), np.ones(truth.shape, bool)
    color = picture(truth)
    found, _ = smear.cleared(ring(24, 0), smear.softened(color), depth, table, unlike, everywhere, np.zeros(truth.shape, bool), 615.0)
    assert found[96:104, 96:104].any() == remains


def test_a_rim_that_depth_lost_is_put_back() -> None:
    truth = ring(50, 0)
    found = cleared(ring(44, 0), picture(truth), np.full(truth.shape, 0.6, np.float32), truth)
    assert overlap(truth, found) > 0.94


def test_what_has_the_colour_of_the_table_keeps_its_mask() -> None:
    truth = ring(50, 0)
    depth = np.full(truth.shape, 0.6, np.float32)
    assert overlap(truth, cleared(truth, picture(truth, TABLE), depth, np.zeros(truth.shape, bool))) > 0.97
    # A face of the table's colour that goes on farther in than smear reaches is no smear.
    striped = truth & (np.mgrid[0:200, 0:200][0] > 85)
    assert overlap(truth, cleared(truth, picture(striped), depth, striped)) > 0.9


def test_where_depth_goes_on_beyond_an_edge_it_was_not_carried_there() -> None:
    # A face of the table's colour at the foot of a thing: towards the camera depth goes on, away from it falls back.
    mask = np.zeros((200, 200), bool)
    mask[60:140, 60:140] = True
    rows = np.arange(200)[:, None] * np.ones((1, 200))
    depth = (0.9 - 0.0015 * (rows - 60)).astype(np.float32)
    depth[mask] = (0.70 + 0.001 * (rows - 60))[mask]
    depth[139:, :] = 0.78
    jump = smear.falls_back(mask, depth, 615.0)
    assert jump[62, 100] and jump[100, 62] and not jump[136, 100]
    depth[:57] = np.nan
    assert smear.falls_back(mask, depth, 615.0)[62, 100]
    assert not smear.falls_back(mask, depth, 615.0)[~mask].any()


@pytest.mark.parametrize("wide, shade, kept", [(2, 7, True), (6, 3, False)])
def test_how_far_smear_reaches_is_measured_in_each_picture(wide: int, shade: int, kept: bool) -> None:
    # On one side a rim of the thing is in the shade and has almost the table's colour: 9 pixels of it, with the smear beyond.
    truth, shaded = ring(50, 0), np.mgrid[0:200, 0:200][1] > 150 - shade
    smeared = ring(50 + wide, 0)
    depth = np.where(smeared, 0.6, 0.8).astype(np.float32)
    found = cleared(smeared, picture(truth & ~shaded), depth, truth & ~shaded, unlike=10.0)
    assert overlap(truth & ~shaded, found & ~shaded) > 0.95
    assert bool(found[97:104, 152 - shade : 150].all()) == kept and bool(found[97:104, 152 - shade : 150].any()) == kept


def test_depth_of_the_table_in_a_high_thing_is_not_its_own() -> None:
    mask, heights = ring(), np.full((200, 200), 0.05, np.float32)
    heights[95:105, 130:150] = 0.001
    lost = smear.behind(mask, heights)
    assert lost[100, 140] and lost.sum() == (mask & (heights < 0.01)).sum()
    assert not smear.behind(mask, np.full((200, 200), 0.006, np.float32)).any()


def test_the_hole_of_a_handle_opens_under_smeared_depth() -> None:
    mug = scenes.shape("mug", 3, 0.55, 0.0, 3.3)
    frames = [
        sensor.capture([mug], scenes.INTRINSICS, pose, [1, i], camera=name, model=sensor.SMEARED)
        for i, (name, pose) in enumerate(scenes.POSES.items())
    ]
    scene = perceive(frames, parameters=Parameters())
    assert [item.view.kind for item in scene.objects] == ["side"]


def test_a_bar_whose_middle_a_thing_of_another_colour_hides_is_one() -> None:
    import trimesh

    from magic_core.mesh import Mesh

    def solid(shape: trimesh.Trimesh, x: float, y: float, color: tuple[int, int, int]) -> Mesh:
        return scenes.placed(Mesh(shape.vertices, shape.faces).painted(color), x, y)

    bar = solid(trimesh.creation.box((0.03, 0.26, 0.02)), 0.58, 0.0, (96, 98, 112))
    tin = solid(trimesh.creation.cylinder(0.03, 0.06), 0.58 - 0.015 - 0.003 - 0.03, 0.0, (180, 40, 40))
    pose = scenes.pose([0.1, 0.0, 0.35], [0.56, 0.0, 0.0])
    scene = perceive([sensor.capture([bar, tin], scenes.INTRINSICS, pose, 2)], parameters=Parameters())
    sizes = sorted(float(item.box_extents.max()) for item in scene.objects)
    assert len(sizes) == 2
    assert sizes == pytest.approx([0.06, 0.26], abs=0.01)


@pytest.mark.parametrize("stands", [True, False])
def test_a_foot_of_the_tables_colour_is_no_hole_where_depth_goes_on_past_it(stands: bool) -> None:
    # The lower part of a thing that tapers to its foot has the table's colour, and falls back from its upper part as the bottom of a hollow
    # does.
    mask, foot = np.zeros((200, 200), bool), np.zeros((200, 200), bool)
    mask[60:140, 60:140] = True
    foot[118:140, 60:140] = True
    rows = np.mgrid[0:200, 0:200][0]
    depth = (0.6 + np.where(foot, 0.002 * (rows - 110), 0)).astype(np.float32)
    table = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) == 0
    unlike = np.where(mask & ~foot, 100, 1).astype(np.float32)
    jump = mask & ~(stands & (rows > 130) & (np.mgrid[0:200, 0:200][1] > 62) & (np.mgrid[0:200, 0:200][1] < 137))
    found = smear.cleared(mask, smear.softened(picture(mask & ~foot)), depth, table, unlike, np.ones(mask.shape, bool), jump, 615.0)[0]
    assert found[60:116, 66:134].mean() > 0.98
    assert (found[122:134, 80:120].mean() > 0.95) == stands


@pytest.mark.parametrize("length, kept", [(70, True), (8, False)])
def test_what_sticks_out_farther_than_smear_is_carried_is_no_smear(length: int, kept: bool) -> None:
    # The end of a wooden handle on a wooden table: raised as its head is, of the table's colour, and narrower than twice what smear
    # reaches.
    head, bar = np.zeros((200, 200), bool), np.zeros((200, 200), bool)
    head[60:140, 30:90] = True
    bar[93:107, 90 : 90 + length] = True
    depth = np.where(head | bar, 0.6, 0.63).astype(np.float32)
    found = cleared(head | bar, picture(head), depth, head, unlike=1.0)
    assert found[head].mean() > 0.97
    assert (found[bar].mean() > 0.9) == kept and (found[bar].mean() < 0.4) != kept


@pytest.mark.parametrize("light, unlike, kept", [((180, 150, 118), 10.0, True), ((60, 70, 120), 100.0, False)])
def test_a_bar_is_cut_along_an_edge_of_colour_and_not_where_its_own_runs_into_the_tables(
    light: tuple[int, int, int], unlike: float, kept: bool
) -> None:
    """A third of a bar has the table's colour, the rest hardly another: that third is the bar's own.  Beside quite another colour it is
    smear."""
    mask, lit = np.zeros((200, 200), bool), np.zeros((200, 200), bool)
    mask[93:107, 30:170] = True
    lit[93:102, 30:170] = True
    depth = np.where(mask, 0.6, 0.63).astype(np.float32)
    found = cleared(mask, picture(lit, light), depth, lit & (unlike > smear.LIKE), 10.0)
    assert found[94:101, 34:166].mean() > 0.95
    assert (found[103:106, 34:166].mean() > 0.95) == kept


def test_smear_is_cut_beside_a_thing_whose_colour_the_room_behind_the_table_has() -> None:
    """The histogram of what lies around has its colour too, so that this one does not tell; that the table has not does."""
    thing, wide = np.zeros((200, 200), bool), np.zeros((200, 200), bool)
    thing[90:130, 60:100] = True
    wide[90:130, 60:107] = True
    room = cv2.dilate(wide.astype(np.uint8), np.ones((13, 13))) == 0
    depth = np.where(wide, 0.6, 0.63).astype(np.float32)
    found = cleared(wide, picture(thing | room), depth, thing)
    assert found[94:126, 64:98].mean() > 0.95
    assert not found[94:126, 102:].any()


def test_depth_of_what_stands_before_a_thing_is_none_of_the_thing():
    # A post 0.3 m before a plate; its depth is carried 6 pixels over the plate, and pixels between are of both.
    u = np.mgrid[0:120, 0:160][1]
    post, plate = (u >= 70) & (u < 84), np.zeros((120, 160), bool)
    plate[20:100, 20:140] = True
    depth = np.where(post, 0.6, 0.9).astype(np.float32)
    depth[(u >= 64) & (u < 70)] = 0.6
    depth[(u >= 84) & (u < 88)] = 0.8
    carried = smear.before(plate & ~post, post, depth, 615.0)
    assert np.array_equal(carried, plate & ~post & (depth < 0.85))
    # A handle that reaches towards the camera beside the post is the thing's.
    depth[40:60, 60:64] = 0.85
    assert not smear.before(plate & ~post, post, depth, 615.0)[40:60, 60:64].any()
    # Nothing is taken from what lies behind, or beside what is as near.
    assert not smear.before(plate & ~post, post, np.where(post, 1.2, 0.9).astype(np.float32), 615.0).any()
    assert not smear.before(plate & ~post, post, np.where(post, 0.88, 0.9).astype(np.float32), 615.0).any()
