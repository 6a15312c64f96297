"""Segmentation of table-tops that are hard to see, by the sensor model with smear: near neighbours, boards, dark and glossy tables, lost depth.

Nothing is fitted to these scenes; what is asked is that each thing is found once, with its mask, and nothing else.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor, shapes, transforms
from magic_core.camera import RgbdFrame
from magic_core.mesh import Mesh
from magic_perception import evaluate, measures
from magic_perception.parameters import Parameters
from magic_perception.segmentation import DepthSegmenter

RED, BLUE, WHITE, GREY = (180, 60, 50), (50, 80, 170), (228, 228, 224), (120, 120, 122)
WOOD, DARK = (186, 152, 112), (34, 32, 31)
EYE = ([0.12, 0.30, 0.55], [0.5, 0.0, 0.02])


def box(size: tuple[float, float, float], x: float, y: float, color: tuple[int, int, int], z: float = 0.0) -> Mesh:
    made = trimesh.creation.box(size)
    return Mesh(made.vertices + [x, y, z + size[2] / 2], made.faces).painted(color)


def seen(meshes: list[Mesh], table: tuple[int, int, int] = WOOD, seed: int = 0, eye: tuple = EYE) -> tuple[RgbdFrame, np.ndarray]:
    """A frame and for each pixel the number of the mesh, from 1; 0 for the table."""
    caster = sensor.scene_raycaster(meshes, sensor.table_mesh(color=table))
    pose = scenes.pose(*eye)
    frame = sensor.capture([], sensor.D435, pose, seed, model=sensor.SMEARED, raycaster=caster)
    return frame, caster.perspective(sensor.D435, pose)[0].ids.clip(0)


def labelled(frame: RgbdFrame) -> np.ndarray:
    parameters = Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.2, 0.8, 0.5))
    return DepthSegmenter().segment([evaluate.looked_at(frame, parameters)], (), parameters)[0]


def check(frame: RgbdFrame, truth: np.ndarray, least: float = 0.8) -> None:
    labels = labelled(frame)
    assert int(labels.max()) == len(np.unique(truth[truth > 0]))
    assert measures.best_ious(labels, truth).min() > least


@pytest.mark.parametrize("turn", [0.0, 0.8])
@pytest.mark.parametrize(
    "gap, colors, heights",
    [
        (0.003, (RED, BLUE), (0.07, 0.07)),
        (0.003, (RED, RED), (0.07, 0.04)),
        (0.007, (GREY, GREY), (0.09, 0.09)),
        (0.0, (WHITE, BLUE), (0.06, 0.06)),
        (0.0, (RED, RED), (0.05, 0.11)),
        (0.0, (RED, BLUE), (0.05, 0.11)),
        (0.003, (RED, BLUE), (0.03, 0.03)),
    ],
    ids=["3 mm, by colour", "3 mm, by height", "7 mm", "touching, by colour", "touching, by height", "touching, by both", "3 mm, low"],
)
def test_near_neighbours_are_two(gap, colors, heights, turn):
    turned = transforms.from_rpy(0, 0, turn, [0.5, 0.0, 0.0]) @ transforms.make(None, [-0.5, 0.0, 0.0])
    pair = [box((0.09, 0.07, h), 0.5, sign * (0.07 + gap) / 2, color) for h, color, sign in zip(heights, colors, (1, -1), strict=True)]
    check(*seen([mesh.transformed(turned) for mesh in pair]))


@pytest.mark.parametrize("thickness", [0.006, 0.018])
def test_things_on_a_board_are_apart_and_the_board_is_none(thickness):
    board = box((0.42, 0.5, thickness), 0.55, 0.0, (60, 90, 120))
    things = [box((0.09, 0.06, 0.07), 0.5, -0.1, RED, thickness), scenes.shape("mug", 3, 0.58, 0.08, 1.0).transformed(transforms.make(None, [0, 0, thickness]))]
    frame, ids = seen([board, *things])
    check(frame, np.where(ids > 1, ids - 1, 0))


@pytest.mark.parametrize("table", [DARK, (12, 12, 13)], ids=["dark", "black"])
def test_things_on_a_dark_table(table):
    things = [box((0.09, 0.06, 0.07), 0.5, -0.12, RED), scenes.shape("mug", 3, 0.58, 0.08, 2.0).painted((45, 44, 46)), scenes.shape("l_hook", 1, 0.42, 0.1, 0.4)]
    check(*seen(things, table), least=0.75)


def test_a_glossy_table_mirrors_and_glares_and_nothing_comes_of_it():
    things = [box((0.09, 0.06, 0.08), 0.52, -0.10, RED), scenes.shape("mug", 3, 0.58, 0.10, 2.0)]
    frame, truth = seen(things, (90, 88, 86))
    mirrored, ids = seen([m.transformed(np.diag([1.0, 1.0, -1.0, 1.0])) for m in things], (90, 88, 86))
    # What stands on the table is seen in it, faintly, and stereo matches parts of that: depth behind the table.
    below = Mesh.__new__
    del below
    caster = sensor.scene_raycaster([m.transformed(np.diag([1.0, 1.0, -1.0, 1.0])) for m in things], Mesh([[9, 9, 9], [9, 9, 8], [9, 8, 9]], [[0, 1, 2]]))
    cast, depth = caster.perspective(sensor.D435, scenes.pose(*EYE))
    image = (cast.ids > 0) & (truth == 0)
    color, measured = frame.color.copy(), frame.depth.copy()
    color[image] = (0.7 * color[image] + 0.3 * np.array(RED)).astype(np.uint8)
    wander = cv2.GaussianBlur(np.random.default_rng(3).standard_normal(truth.shape), (0, 0), 6)
    taken = image & (wander > np.percentile(wander, 60))
    measured[taken] = depth[taken]
    # A lamp's glare on the bare table: white, without depth.
    v, u = np.mgrid[0:480, 0:640]
    glare = np.exp(-(((u - 420) / 45) ** 2 + ((v - 330) / 25) ** 2)) * (truth == 0)
    color = (color + glare[..., None] * (255 - color)).astype(np.uint8)
    measured[glare > 0.5] = np.nan
    check(replace(frame, color=color, depth=measured), truth)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_depth_that_is_missing_in_blobs(share):
    things = [box((0.10, 0.07, 0.08), 0.50, -0.12, RED), scenes.shape("mug", 3, 0.58, 0.10, 2.0), scenes.shape("l_hook", 1, 0.40, 0.10, 0.4)]
    frame, truth = seen(things)
    for seed in range(3):
        wander = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(truth.shape), (0, 0), 5)
        check(replace(frame, depth=np.where(wander < np.quantile(wander, share), np.nan, frame.depth).astype(np.float32)), truth, least=0.7)
