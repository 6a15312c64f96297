"""Objects named in words: what is measured of them, the grammar, and refusals that list what there is."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from magic_core import naming, transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_core.shapes import make

RED, BLUE, WHITE, YELLOW = (200, 30, 25), (20, 60, 190), (235, 235, 230), (230, 200, 30)


def box(size):
    import trimesh

    made = trimesh.creation.box(size)
    return Mesh(made.vertices, made.faces)


@lru_cache
def item_of(family, seed):
    """Made once: drawing its view takes most of a test's time."""
    return make(family, seed).as_object("item", np.eye(4))


def thing(name, shape, place, color, source="camera", yaw=0.0):
    """An object of one colour, standing at a level place."""
    if isinstance(shape, Mesh):
        item = replace(item_of("sphere", 0), mesh=shape, pieces=(shape,))
    else:
        item = item_of(*shape)
    low = item.mesh.bounds[0]
    c, s = np.cos(yaw), np.sin(yaw)
    pose = transforms.make(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), [*place, -low[2]])
    return replace(item, id=name, world_from_object=pose, source=source, colors=np.tile(np.array(color, np.uint8), (50, 1)))


@pytest.fixture(scope="module")
def table() -> list[SceneObject]:
    return [
        thing("object_1", ("mug", 1), (0.5, 0.2), RED),
        thing("object_2", ("mug", 2), (0.5, -0.2), BLUE),
        thing("object_3", ("l_hook", 1), (0.35, 0.0), WHITE),
        thing("object_4", box((0.1, 0.06, 0.15)), (0.7, 0.0), RED),
        thing("object_5", ("cylinder", 1), (0.7, 0.3), YELLOW),
        thing("post", ("rod", 1), (0.3, 0.5), WHITE, source="known"),
    ]


@pytest.mark.parametrize("family, noun", [("mug", "mug"), ("cylinder", "cylinder"), ("sphere", "ball")])
def test_classes_of_shape(family, noun):
    for seed in range(2):
        for yaw in (0.0, 0.7):
            seen = naming.looks(thing("x", (family, seed), (0.0, 0.0), RED, yaw=yaw))
            assert noun in seen.shapes, (family, seed, sorted(seen.shapes))


@pytest.mark.parametrize("family", ["l_hook", "spoon", "quarter_pipe", "hammer", "sphere", "cylinder", "mug_tree"])
def test_other_things_are_no_mugs(family):
    assert not any("mug" in naming.looks(thing("x", (family, seed), (0.0, 0.0), RED)).shapes for seed in range(2))


@pytest.mark.parametrize(
    "rgb, word",
    [((255, 0, 0), "red"), ((0, 0, 255), "blue"), ((20, 140, 40), "green"), ((250, 250, 250), "white"), ((12, 12, 14), "black"), ((128, 128, 130), "grey"),
     ((255, 230, 0), "yellow"), ((255, 130, 0), "orange"), ((110, 65, 30), "brown"), ((120, 40, 170), "purple"), ((255, 105, 180), "pink")],
)  # fmt: skip
def test_colour_words(rgb, word):
    assert naming.colour_shares(np.tile(np.array(rgb, np.uint8), (10, 1))) == {word: 1.0}


@pytest.mark.parametrize(
    "rgb, word",
    [((220, 30, 30), "red"), ((30, 60, 210), "blue"), ((30, 180, 60), "green"), ((128, 128, 128), "grey"), ((30, 27, 24), "black")],
)
def test_a_colour_keeps_its_name_in_the_shade(rgb, word):
    """And in a camera's noise; what has little hue becomes black."""
    rng = np.random.default_rng(3)
    for light in (1.0, 0.5, 0.25, 0.15):
        seen = np.clip(light * np.array(rgb) + rng.normal(0, 2, (500, 3)), 0, 255).astype(np.uint8)
        dark = word if word not in ("grey", "black") or light * max(rgb) > 60 else "black"
        assert naming.colour_shares(seen).get(dark, 0.0) > 0.9, (light, naming.colour_shares(seen))


@pytest.mark.parametrize(
    "name, found",
    [
        ("the red mug", "object_1"),
        ("blue cup", "object_2"),
        ("the box", "object_4"),
        ("the red box", "object_4"),
        ("the longest tool", "object_3"),
        ("the yellow one", "object_5"),
        ("the mug left of the blue mug", "object_1"),
        ("the mug to the right of the red mug", "object_2"),
        ("the cylinder left of the box", "object_5"),
        ("the red thing behind the white tool", "object_4"),
        ("The Leftmost Mug", "object_1"),
        ("the cylinder that is left of the box", "object_5"),
        ("the known object", "post"),
        ("the mug nearest to the white tool", None),
        ("the mug nearest to the cylinder", "object_1"),
        ("a mug", None),
        ("the red thing", None),
    ],
)
def test_names(table, name, found):
    assert naming.is_name(name)
    if found is None:
        with pytest.raises(MagicError) as error:
            naming.resolve(name, table)
        assert error.value.code == Code.AMBIGUOUS_OBJECT
        assert all(item.id in error.value.message for item in table)
        return
    reading = naming.resolve(name, table)
    assert reading.id == found and found in reading.sentence


def test_nothing_fits_or_no_word(table):
    with pytest.raises(MagicError, match="no object is called.*object_1: red mug") as error:
        naming.resolve("the green mug", table)
    assert error.value.code == Code.UNKNOWN_OBJECT
    for text in ("object_7", "the spanner", "", "left of the mug", "the mug left of", "red red", "the"):
        assert not naming.is_name(text) or text == "red red"
    with pytest.raises(MagicError, match="'the spanner'.*left of"):
        naming.resolve("the spanner", table)


def test_alike_within_what_measuring_errs_by(table):
    near = [thing("a", box((0.1, 0.05, 0.05)), (0.5, 0.2), RED), thing("b", box((0.106, 0.05, 0.05)), (0.5, -0.2), RED)]
    with pytest.raises(MagicError, match="a and b|b and a") as error:
        naming.resolve("the longest box", near)
    assert error.value.code == Code.AMBIGUOUS_OBJECT
    assert naming.resolve("the longest box", [near[0], thing("b", box((0.14, 0.05, 0.05)), (0.5, -0.2), RED)]).id == "b"


def test_what_is_near_to_a_limit_is_not_told_apart():
    """A third of the one box is red and a quarter of the other; the one is as far behind as to the left."""
    shape = box((0.1, 0.05, 0.05))
    part = np.array([RED] * 17 + [WHITE] * 33, np.uint8), np.array([RED] * 13 + [WHITE] * 37, np.uint8)
    items = [replace(thing(name, shape, (0.5, y), RED), colors=c) for name, y, c in zip("ab", (0.2, -0.2), part, strict=True)]
    for objects in (items, items[1:]):
        with pytest.raises(MagicError) as error:
            naming.resolve("the red box", objects)
        assert error.value.code == Code.AMBIGUOUS_OBJECT
    corner = [thing("a", shape, (0.5, 0.0), RED), thing("b", shape, (0.7, 0.2), BLUE)]
    for words in ("the blue box left of the red box", "the blue box behind the red box"):
        with pytest.raises(MagicError, match="b is too near to the limit"):
            naming.resolve(words, corner)
    assert naming.resolve("the blue box behind the red box", [corner[0], thing("b", shape, (0.8, 0.1), BLUE)]).id == "b"
