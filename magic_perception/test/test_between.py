"""Low neighbours of different colours are two where the table shows between them; one thing of two colours is one."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor
from magic_core.mesh import Mesh, concatenate
from magic_core.rendering import canonical_view
from magic_core.scene import SceneObject
from magic_perception import between
from magic_perception.looks import look
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive
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


def test_one_bar_of_two_colours_whose_joint_a_known_post_hides_from_one_camera_is_one():
    ends = [trimesh.creation.box([0.15, 0.014, 0.010]) for _ in range(2)]
    bar = concatenate([scenes.placed(Mesh(e.vertices, e.faces).painted(c), x, 0.0) for e, c, x in zip(ends, (BLUE, RED), (0.425, 0.575))])
    solid = trimesh.creation.box([0.02, 0.02, 0.30])
    # On the way from the left camera to the joint.
    post = scenes.placed(Mesh(solid.vertices, solid.faces).painted((90, 90, 95)), 0.45, 0.09)
    known = SceneObject("post", post, (post,), np.eye(4), canonical_view(post, [0, 0, -1.0], [1.0, 0, 0], "top"), source="known")
    frames = [
        sensor.capture([bar, post], scenes.INTRINSICS, scenes.POSES[name], [3, i], camera=name, model=sensor.SMEARED)
        for i, name in enumerate(("left", "right"))
    ]
    (found,) = [o for o in perceive(frames, (known,), Parameters()).objects if o.source != "known"]
    assert max(found.box_extents) == pytest.approx(0.30, abs=0.006) and not found.cut_off


def regions(between_them: int) -> np.ndarray:
    """Two regions of a picture with something between: 0 for nothing, or a third region."""
    image = np.zeros((480, 640), np.int32)
    image[200:260, 250:300], image[200:260, 300:306], image[200:260, 306:360] = 1, between_them, 2
    return image


@pytest.mark.parametrize(
    ("third", "first", "second", "filled", "known", "groups"),
    [
        pytest.param(0, BLUE, RED, (150, 120, 90), False, 2, id="the table between"),
        pytest.param(0, BLUE, BLUE, (150, 120, 90), False, 1, id="one colour"),
        pytest.param(0, (220, 170, 60), (160, 124, 44), (90, 120, 150), False, 1, id="one colour, in the shade"),
        pytest.param(3, BLUE, RED, (150, 120, 90), False, 1, id="a third thing between"),
        pytest.param(0, BLUE, RED, (150, 120, 90), True, 1, id="something known between"),
        pytest.param(0, BLUE, RED, (120, 75, 125), False, 1, id="a mixture of both"),
    ],
)
def test_regions_are_two_by_colour_and_where_nothing_else_is_between(third, first, second, filled, known, groups):
    frame, _ = scenes.capture([], "left")
    image = regions(third)
    frame.color[200:260, 250:360] = filled
    frame.color[image == 1], frame.color[image == 2] = first, second
    mask = np.zeros(image.shape, bool)
    mask[200:260, 250:360] = True
    looked = look(frame, Plane(np.array([0.0, 0.0, 1.0, 0.0])), np.eye(4), Parameters())
    fixed = (image == 0) & mask & known
    assert between._groups(looked, mask, fixed, image, np.array([1, 2])).max() + 1 == groups
