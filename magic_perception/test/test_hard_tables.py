"""Segmentation of table-tops that are hard to see, by the sensor model with smear: near neighbours, boards, dark and glossy tables, lost
depth.

What is asked is that each thing is found once, with its mask, and nothing else of a thing's size.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor, shapes, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.mesh import Mesh
from magic_perception import evaluate, measures
from magic_perception.averaging import average
from magic_perception.behind_one import one_face
from magic_perception.labels import with_depth
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive
from magic_perception.segmentation import DepthSegmenter
from magic_perception.surface_edges import on_surfaces

RED, BLUE, WOOD, DARK, BLACK, LACQUER = (180, 60, 50), (50, 80, 170), (186, 152, 112), (34, 32, 31), (12, 12, 13), (90, 88, 86)
POSE = scenes.pose([0.12, 0.30, 0.55], [0.5, 0.0, 0.02])
PARAMETERS = Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.2, 0.8, 0.5))


def box(size, x, y, color, z=0.0) -> Mesh:
    made = trimesh.creation.box(size)
    return Mesh(made.vertices + [x, y, z + size[2] / 2], made.faces).painted(color)


def seen(meshes, table=WOOD, seed=0, pose=POSE) -> tuple[RgbdFrame, np.ndarray]:
    """A frame, and for each pixel the number of the mesh, from 1; 0 for the table."""
    caster = sensor.scene_raycaster(meshes, sensor.table_mesh(color=table))
    frame = sensor.capture([], sensor.D435, pose, seed, model=sensor.SMEARED, raycaster=caster)
    return frame, caster.perspective(sensor.D435, pose)[0].ids.clip(0)


def labelled(frame) -> np.ndarray:
    return DepthSegmenter().segment([evaluate.looked_at(frame, PARAMETERS)], (), PARAMETERS)[0]


def check(frame, truth, least=0.8, most_other=0) -> None:
    """Each true thing is found as one, with an overlap above ``least``; whatever else is found has at most so many pixels."""
    labels = labelled(frame)
    assert measures.best_ious(labels, truth).min() > least
    true = [int(np.bincount(labels[truth == i].clip(0), minlength=2)[1:].argmax()) + 1 for i in np.unique(truth[truth > 0])]
    assert len(set(true)) == len(true)
    others = np.bincount(labels[labels > 0], minlength=labels.max() + 1)
    others[true] = 0
    assert others.max() <= most_other


def blobs(shape, share, size, seed) -> np.ndarray:
    """(H, W): a share of the picture in blobs of some ``size`` pixels."""
    wander = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(shape), (0, 0), size)
    return wander < np.quantile(wander, share)


@pytest.mark.parametrize(
    "gap, colors, heights",
    [
        (0.003, (RED, RED), (0.07, 0.04)),
        (0.0, (RED, RED), (0.05, 0.11)),
        (0.0, (RED, BLUE), (0.05, 0.11)),
        (0.0, (BLUE, BLUE), (0.11, 0.05)),
    ],
    ids=["3 mm", "touching", "touching, by both", "touching, the higher one in front"],
)
def test_near_neighbours_of_other_heights_are_two(gap, colors, heights):
    turned = transforms.from_rpy(0, 0, 0.8, [0.5, 0.0, 0.0]) @ transforms.make(None, [-0.5, 0.0, 0.0])
    pair = [box((0.09, 0.07, h), 0.5, sign * (0.07 + gap) / 2, c) for h, c, sign in zip(heights, colors, (1, -1), strict=True)]
    frame, truth = seen([mesh.transformed(turned) for mesh in pair])
    if np.count_nonzero(truth == 2) > 1000:
        check(frame, truth)
    else:
        check(frame, np.where(truth == 2, 0, truth), most_other=1000)


@pytest.mark.parametrize("thickness", [0.006, 0.018])
def test_things_on_a_board_are_apart_and_the_board_is_none(thickness):
    board = box((0.42, 0.5, thickness), 0.55, 0.0, (60, 90, 120))
    mug = scenes.shape("mug", 3, 0.58, 0.08, 1.0).transformed(transforms.make(None, [0, 0, thickness]))
    frame, ids = seen([board, box((0.09, 0.06, 0.07), 0.5, -0.1, RED, thickness), mug])
    # At its far edge and in its shadow there may be slivers.
    check(frame, np.where(ids > 1, ids - 1, 0), least=0.9, most_other=300)


@pytest.mark.parametrize("table", [DARK, BLACK], ids=["dark", "black"])
def test_things_on_a_dark_table_are_found_dark_ones_too(table):
    mug = scenes.shape("mug", 3, 0.58, 0.08, 2.0).painted((45, 44, 46))
    check(*seen([box((0.09, 0.06, 0.07), 0.5, -0.12, RED), mug, scenes.shape("l_hook", 1, 0.42, 0.1, 0.4)], table), least=0.85)


def test_of_what_a_glossy_table_mirrors_and_of_its_glare_nothing_comes():
    things = [box((0.09, 0.06, 0.08), 0.52, -0.10, RED), scenes.shape("mug", 3, 0.58, 0.10, 2.0)]
    frame, truth = seen(things, LACQUER)
    # Things are mirrored, faintly, and stereo matches some of that: depth behind the table.
    below = [mesh.transformed(np.diag([1.0, 1.0, -1.0, 1.0])) for mesh in things]
    out_of_sight = Mesh([[9, 9, 9], [9, 9, 8], [9, 8, 9]], [[0, 1, 2]])
    cast, behind = sensor.scene_raycaster(below, out_of_sight).perspective(sensor.D435, POSE)
    mirrored = (cast.ids > 0) & (truth == 0)
    assert np.count_nonzero(mirrored) > 2000
    color, depth = frame.color.astype(float), frame.depth.copy()
    color[mirrored] = 0.7 * color[mirrored] + 0.3 * np.array(RED)
    taken = mirrored & blobs(truth.shape, 0.4, 6, 3)
    depth[taken] = behind[taken]
    # A lamp's glare on the bare table: white, and without depth.
    v, u = np.mgrid[0:480, 0:640]
    glare = np.exp(-(((u - 420) / 45) ** 2) - ((v - 330) / 25) ** 2) * (truth == 0)
    color += glare[..., None] * (255 - color)
    depth[glare > 0.5] = np.nan
    check(replace(frame, color=color.astype(np.uint8), depth=depth), truth, least=0.9)


@pytest.mark.parametrize("share, size, least", [(0.3, 5, 9), (0.5, 5, 9), (0.7, 5, 7), (0.5, 10, 9)])
def test_what_has_lost_depth_in_blobs_stays_one_thing(share, size, least):
    hook, mug = scenes.shape("l_hook", 1, 0.40, 0.10, 0.4), scenes.shape("mug", 3, 0.58, 0.10, 2.0)
    frame, truth = seen([box((0.10, 0.07, 0.08), 0.50, -0.12, RED), mug, hook])
    whole = 0
    for seed in range(3):
        depth = np.where(blobs(truth.shape, share, size, seed), np.nan, frame.depth).astype(np.float32)
        whole += int((measures.best_ious(labelled(replace(frame, depth=depth)), truth) > 0.85).sum())
    # A blob may hide a mug's rim, or leave less than a fifth of a thing's depth: that is no thing any more.
    assert whole >= least


def test_a_thin_bar_is_one_whose_depth_is_missing_for_longer_than_clusters_reach():
    frame, truth = seen([box((0.012, 0.18, 0.012), 0.50, 0.0, RED)])
    frame.depth[:, 290:345] = np.nan
    check(frame, truth)


@pytest.mark.parametrize(
    "blocks",
    [
        [box((0.09, 0.06, 0.06), 0.50, 0.03, RED), box((0.05, 0.06, 0.11), 0.52, -0.03, RED)],
        [box((0.05, 0.06, 0.06), 0.525, 0.03, RED), box((0.09, 0.06, 0.06), 0.545, -0.03, BLUE)],
    ],
    ids=["of two heights", "of two colours"],
)
def test_two_blocks_that_touch_where_no_depth_is_are_two(blocks):
    frame, truth = seen(blocks)
    met = cv2.dilate((truth == 1).astype(np.uint8), np.ones((25, 25))) & cv2.dilate((truth == 2).astype(np.uint8), np.ones((25, 25)))
    frame.depth[met > 0] = np.nan
    check(frame, truth, most_other=400)


def test_a_box_that_another_hides_in_its_middle_is_one_whatever_its_print():
    """And two boxes whose faces are not in one plane are two."""
    left, right, post = (0.05, 0.13, 0.09), (0.05, 0.13, 0.09), (0.06, 0.05, 0.14)
    pose = scenes.pose([-0.05, 0.0, 0.40], [0.5, 0.0, 0.04])
    for aside, count in ((0.0, 2), (0.025, 3)):
        parts = [box(left, 0.60, 0.065, RED), box(right, 0.60 - aside, -0.065, BLUE), box(post, 0.50, 0.0, (40, 140, 60))]
        frame, truth = seen(parts, pose=pose)
        check(frame, np.where((truth == 2) & (count == 2), 1, truth))


def test_a_seam_in_steps_follows_the_surfaces():
    """Two boxes, one on the other, whose labels were cut some pixels beside their seam."""
    frame, truth = seen([box((0.16, 0.16, 0.06), 0.5, 0.0, RED), box((0.08, 0.08, 0.08), 0.5, 0.0, RED, 0.06)])
    look = evaluate.looked_at(frame, PARAMETERS)
    stepped = np.where(truth > 0, cv2.resize(truth[2::5, 2::5].astype(np.uint8), (640, 480), interpolation=cv2.INTER_NEAREST), 0).astype(
        np.int32
    )
    stepped[(truth > 0) & (stepped == 0)] = 1
    stepped = np.where(truth > 0, stepped, 0)
    sharp = on_surfaces(stepped, look)
    seams = [(image != truth) & (truth > 0) for image in (stepped, sharp)]
    assert np.count_nonzero(seams[1]) < 0.7 * np.count_nonzero(seams[0])
    assert np.array_equal(sharp > 0, stepped > 0)


def test_a_thin_bar_before_another_thing_keeps_its_width():
    depth = np.full((200, 200), 0.7, np.float32) + 0.0003 * np.arange(200, dtype=np.float32)[:, None]
    labels = np.zeros((200, 200), np.int32)
    labels[40:160, 40:160] = 1
    labels[98:102, 30:170] = 2
    depth[98:102, 30:170] -= 0.03
    depth += np.random.default_rng(0).normal(0, 0.001, depth.shape).astype(np.float32)
    frame = RgbdFrame(np.zeros((200, 200, 3), np.uint8), depth, Intrinsics(200, 200, 600.0, 600.0, 100.0, 100.0), np.eye(4), "camera")
    look = Looked(frame, depth, depth, np.ones_like(labels, bool), np.full_like(depth, 0.0015))
    assert np.array_equal(on_surfaces(labels, look), labels)


def test_what_has_hardly_any_depth_of_its_own_is_no_thing():
    # A shadow of stereo at the table's edge: the floor's colour, the table's depth, and a few stray pixels.
    shape = (120, 160)
    labels, heights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    labels[20:60, 20:60], heights[20:60, 20:60] = 1, 0.05
    labels[20:32, 100:114] = 2
    heights[20:32, 100:114] = np.where(np.arange(14) % 2 == 0, 0.0, np.nan)
    heights[24:28, 105:109] = 0.05
    depth = np.where(np.isfinite(heights), 0.8, np.nan).astype(np.float32)
    frame = RgbdFrame(np.zeros((*shape, 3), np.uint8), depth, Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0), np.eye(4), "camera")
    look = Looked(frame, heights, heights, np.ones(shape, bool), np.full(shape, 0.001, np.float32))
    (kept,) = with_depth([labels], [look], Parameters())
    assert kept[40, 40] == 1 and kept.max() == 1


@pytest.mark.parametrize(("behind", "one"), [(0.0, True), (0.05, False)])
def test_a_face_that_the_picture_ends_is_one_with_what_lies_in_its_plane(behind, one):
    labels = np.zeros((120, 160), np.int32)
    labels[60:, 20:60], labels[60:, 100:] = 1, 2
    depth = np.full(labels.shape, 0.8, np.float32)
    depth[:, 100:] += behind
    frame = RgbdFrame(np.zeros((*labels.shape, 3), np.uint8), depth, Intrinsics(160, 120, 150.0, 150.0, 80.0, 60.0), np.eye(4), "camera")
    look = Looked(frame, depth, depth, np.ones(labels.shape, bool), np.full_like(depth, 0.001), np.array([0.0, -1.0, 0.0]))
    assert one_face(look, labels, 1, 2) == one


def test_beside_a_post_a_cup_does_not_end():
    """One camera has a post before the cup, and beside the post stereo has no depth: half the cup is colour alone there, which is neither
    cup nor table."""
    post = shapes.make("rod", 0, radius=0.006, height=0.38, length=0.19, foot=0.05)
    post = replace(post.as_object("post", transforms.make(translation=[0.56, 0.0, -post.mesh.bounds[0, 2]])), source="known")
    cup = scenes.placed(shapes.make("mug", 89).mesh, 0.446, 0.272, 1.025)
    caster = sensor.scene_raycaster([cup, post.mesh.transformed(post.world_from_object)])
    frames = [
        average([sensor.capture([], sensor.D435, pose, [k, n], camera=name, raycaster=caster) for n in range(3)])
        for k, (name, pose) in enumerate(sensor.STATION.items())
    ]
    looks = [evaluate.looked_at(frame, PARAMETERS) for frame in frames]
    labels = DepthSegmenter().segment(looks, (post.mesh.transformed(post.world_from_object),), PARAMETERS)[1]
    mine = caster.perspective(sensor.D435, sensor.STATION["right"])[0].ids == 1
    blank = mine & ~np.isfinite(frames[1].depth)
    assert np.mean(blank[mine]) > 0.2 and np.mean(labels[blank] != 0) > 0.9
    found = next(item for item in perceive(frames, (post,), PARAMETERS).objects if item.source == "camera")
    assert found.surface_error < 0.004
    assert found.mesh.transformed(found.world_from_object).bounds == pytest.approx(cup.bounds, abs=0.004)
