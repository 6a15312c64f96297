"""Low neighbours of different colours are two where the table shows between them; one thing of two colours is one."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor
from magic_core.mesh import Mesh, concatenate
from magic_perception import between
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive
from magic_perception.segmentation import look
from magic_perception.table import Plane

BLUE, RED = (60, 90, 200), (180, 60, 50)


def card(x: float, color: tuple[int, int, int]) -> Mesh:
    """A plate of 60 x 80 x 10 mm with its middle at x."""
    solid = trimesh.creation.box([0.06, 0.08, 0.010])
    return scenes.placed(Mesh(solid.vertices, solid.faces).painted(color), x, 0.0)


def objects(meshes: list[Mesh], names: tuple[str, ...]) -> int:
    """How many things perception sees, by the sensor that smears."""
    frames = [
        sensor.capture(meshes, scenes.INTRINSICS, scenes.POSES[name], [3, i], camera=name, model=sensor.SMEARED)
        for i, name in enumerate(names)
    ]
    return len(perceive(frames, parameters=Parameters()).objects)


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
def test_cards_of_two_colours_a_few_millimetres_apart_are_two(names):
    apart = 0.010
    assert objects([card(0.5, BLUE), card(0.56 + apart, RED)], names) == 2


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
def test_one_card_of_two_colours_is_one(names):
    assert objects([concatenate([card(0.5, BLUE), card(0.56, RED)])], names) == 1


def regions(between_them: int) -> np.ndarray:
    """Two regions of a picture with something between: 0 for nothing, or a third region."""
    image = np.zeros((480, 640), np.int32)
    image[200:260, 250:300], image[200:260, 300:306], image[200:260, 306:360] = 1, between_them, 2
    return image


@pytest.mark.parametrize(
    ("third", "first", "second", "filled", "groups"),
    [
        pytest.param(0, BLUE, RED, (150, 120, 90), 2, id="the table between"),
        pytest.param(0, BLUE, BLUE, (150, 120, 90), 1, id="one colour"),
        pytest.param(3, BLUE, RED, (150, 120, 90), 1, id="a third thing between"),
        pytest.param(0, BLUE, RED, (120, 75, 125), 1, id="a mixture of both"),
    ],
)
def test_regions_are_two_by_colour_and_where_nothing_else_is_between(third, first, second, filled, groups):
    frame, _ = scenes.capture([], "left")
    image = regions(third)
    frame.color[200:260, 250:360] = filled
    frame.color[image == 1], frame.color[image == 2] = first, second
    mask = np.zeros(image.shape, bool)
    mask[200:260, 250:360] = True
    looked = look(frame, Plane(np.array([0.0, 0.0, 1.0, 0.0])), np.eye(4), Parameters())
    assert between._groups(looked, mask, image, np.array([1, 2])).max() + 1 == groups
