"""What lies beside a larger thing and belongs to it: labels are told from the truth, and one part is taken for a thing of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import shapely
import trimesh

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_perception import attached
from magic_perception.looks import look
from magic_perception.parameters import Parameters
from magic_perception.table import Plane

PLANE = Plane(np.array([0.0, 0.0, 1.0, 0.0]))
BLUE, RED = (60, 90, 200), (180, 60, 50)


def mesh(solid: trimesh.Trimesh, color: tuple[int, int, int]) -> Mesh:
    return Mesh(solid.vertices, solid.faces).painted(color)


def block(color: tuple[int, int, int] = BLUE) -> Mesh:
    """A body 80 mm high whose side that faces the cameras is the plane x = 0.46."""
    return scenes.placed(mesh(trimesh.creation.box([0.08, 0.10, 0.08]), color), 0.50, 0.0)


def bow(apart: float, color: tuple[int, int, int] = BLUE) -> Mesh:
    """Half a ring that lies on the table with both ends on the body's side, ``apart`` metres from it."""
    turn = np.linspace(np.pi / 2, 3 * np.pi / 2, 25)
    path = 0.03 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    swept = trimesh.creation.sweep_polygon(shapely.Point(0, 0).buffer(0.006), path)
    return mesh(swept, color).transformed(transforms.from_rpy(0, 0, 0, [0.46 - apart, 0.0, 0.006]))


def bar(apart: float) -> Mesh:
    """A straight bar beside the body's side, as long as that."""
    return scenes.placed(mesh(trimesh.creation.box([0.012, 0.09, 0.012]), BLUE), 0.46 - apart - 0.006, 0.0)


def told(meshes: list[Mesh], names: tuple[str, ...] = ("left", "right")) -> list[int]:
    """The owners of labels 1 for the first mesh and 2 for the second, as if each had been segmented without error."""
    looks, labels = [], []
    for i, name in enumerate(names):
        frame, ids = scenes.capture(meshes, name, seed=i)
        looks.append(look(frame, PLANE, np.eye(4), Parameters()))
        labels.append((ids + 1).astype(np.int32))
    return attached.owners(labels, looks).tolist()


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
def test_a_handle_that_lies_on_the_table_belongs_to_its_body(names):
    assert told([block(), bow(0.0)], names) == [0, 1, 1]


@pytest.mark.parametrize(
    "meshes",
    [
        pytest.param([block(), bow(0.012)], id="the table shows between"),
        pytest.param([block(), bow(0.0, RED)], id="another colour"),
        pytest.param([block(), bar(0.0)], id="nothing enclosed"),
    ],
)
def test_a_neighbour_is_a_thing_of_its_own(meshes):
    assert told(meshes) == [0, 1, 2]


@pytest.mark.parametrize(
    ("width", "lost", "names", "owner"),
    [
        pytest.param(0.008, 0.015, ("left", "right"), 1, id="a thin bar without depth where the labels meet"),
        pytest.param(0.008, 0.0, ("left", "right"), 2, id="depth tells where the second begins"),
        pytest.param(0.008, 0.035, ("left",), 2, id="what has depth is far from each other"),
        pytest.param(0.008, 0.035, ("left", "right"), 1, id="it is far, but both pictures show them meet"),
        pytest.param(0.008, 0.050, ("left", "right"), 2, id="it is too far for that"),
        pytest.param(0.040, 0.015, ("left", "right"), 2, id="no thin bar"),
    ],
)
def test_a_bar_that_has_lost_its_depth_where_it_meets_a_thing_belongs_to_it(width, lost, names, owner):
    rod = scenes.placed(mesh(trimesh.creation.box([0.07, width, 0.008]), BLUE), 0.46 - 0.035, 0.0)
    looks, labels = [], []
    for i, name in enumerate(names):
        frame, ids = scenes.capture([block(), rod], name, seed=i)
        seen, image = look(frame, PLANE, np.eye(4), Parameters()), (ids + 1).astype(np.int32)
        near = seen.points(*np.mgrid[: image.shape[0], : image.shape[1]])[..., 0]
        # Each pixel without depth has the label of the nearest that has it.
        image[(image == 2) & (near > 0.46 - max(lost, 0.015) / 2)] = 1
        blank = (ids == 1) & (near > 0.46 - lost)
        looks.append(look(replace(frame, depth=np.where(blank, np.nan, frame.depth).astype(np.float32)), PLANE, np.eye(4), Parameters()))
        labels.append(image)
    assert attached.owners(labels, looks)[2] == owner


def disc(radius: float, low: float, high: float, color: tuple[int, int, int] = BLUE) -> Mesh:
    """An upright disc between two heights, m."""
    solid = trimesh.creation.cylinder(radius, segment=[[0.5, 0.0, low], [0.5, 0.0, high]])
    return mesh(solid, color)


@pytest.mark.parametrize(
    ("color", "radius", "post", "owner"),
    [
        pytest.param(BLUE, 0.045, 0.018, 1, id="a post that the cameras do not see through carries it"),
        pytest.param(BLUE, 0.025, None, 2, id="the cameras see that nothing carries it"),
        pytest.param(RED, 0.045, 0.018, 2, id="another colour"),
    ],
)
def test_what_would_hang_over_a_foot_of_its_colour_is_carried_by_it(color, radius, post, owner):
    top, foot = disc(radius, 0.07, 0.085), disc(0.045, 0.0, 0.012, color)
    hidden = [] if post is None else [disc(post, 0.012, 0.07, color)]
    looks, labels = [], []
    for i, name in enumerate(("left", "right")):
        frame, ids = scenes.capture([top, foot, *hidden], name, seed=i)
        looks.append(look(frame, PLANE, np.eye(4), Parameters()))
        labels.append(np.where(ids == 2, 0, ids + 1).astype(np.int32))  # what depth lost of the post is nobody's
    assert attached.owners(labels, looks)[2] == owner


@pytest.mark.parametrize(
    ("other", "doubt"),
    [
        pytest.param(bar(0.0), [(1, 2)], id="beside it, of its colour"),
        pytest.param(bar(0.02), [], id="the table shows between"),
        pytest.param(bow(0.0, RED), [], id="another colour"),
    ],
)
def test_what_may_be_a_part_of_a_thing(other, doubt):
    looks, labels = [], []
    for i, name in enumerate(("left", "right")):
        frame, ids = scenes.capture([block(), other], name, seed=i)
        looks.append(look(frame, PLANE, np.eye(4), Parameters()))
        labels.append((ids + 1).astype(np.int32))
    assert attached.doubtful(labels, looks) == doubt


@pytest.mark.parametrize(("width", "owner"), [(3, 1), (12, 2)])
def test_a_strip_along_the_edge_of_a_thing_is_its_rim(width, owner):
    frame, ids = scenes.capture([block()], "left")
    labels = (ids + 1).astype(np.int32)
    # The lowest pixels of each column were parted from the rest.
    foot = (labels > 0) & ~np.roll(labels > 0, -width, axis=0)
    labels[foot] = 2
    assert attached.owners([labels], [look(frame, PLANE, np.eye(4), Parameters())])[2] == owner


def test_one_thing_or_none_has_nothing_to_be_attached():
    frame, _ = scenes.capture([block()], "left")
    seen = look(frame, PLANE, np.eye(4), Parameters())
    assert attached.owners([np.zeros(frame.depth.shape, np.int32)], [seen]).tolist() == [0]
