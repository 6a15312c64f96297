"""Thin things that lie on the table: noise lifts a part of them here and there, and colour shows the rest."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
import trimesh

from magic_core import sensor, transforms
from magic_core.mesh import Mesh
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.pipeline import Report, perceive

GREEN, RED = (40, 120, 70), (190, 60, 60)


def flat(outline: shapely.Polygon, height: float, color: tuple[int, int, int]) -> Mesh:
    """A flat thing of an outline (m), turned, on the table."""
    solid = trimesh.creation.extrude_polygon(outline, height)
    return Mesh(solid.vertices, solid.faces).painted(color).transformed(transforms.from_rpy(0, 0, 0.5, [0.5, 0.0, 0.0]))


def pair_of_loops() -> shapely.Polygon:
    """Two open loops on a blade of two arms, 7 mm wide."""
    loops = [
        shapely.Point(-0.06, side * 0.03).buffer(0.025).difference(shapely.Point(-0.06, side * 0.03).buffer(0.018)) for side in (1, -1)
    ]
    arms = [shapely.LineString([(-0.04, side * 0.02), (0.0, 0.0), (0.09, -side * 0.006)]).buffer(0.006) for side in (1, -1)]
    return shapely.union_all([*loops, *arms])


def seen(meshes: list[Mesh], seed: int, names: tuple[str, ...]):
    """Frames of both cameras, or one, that smear depth, and where each shows the first mesh."""
    caster = sensor.scene_raycaster(meshes, sensor.table_mesh(color=(120, 118, 115)))
    frames, truth = [], []
    for i, name in enumerate(names):
        pose = sensor.STATION[name]
        frames.append(sensor.capture([], sensor.D435, pose, [seed, i], model=sensor.SMEARED, camera=name, raycaster=caster))
        truth.append(caster.perspective(sensor.D435, pose)[0].ids == 1)
    return frames, truth


@pytest.mark.parametrize("names", [("left",), ("left", "right")])
@pytest.mark.parametrize(
    "thing",
    [
        pytest.param(flat(pair_of_loops(), 0.004, RED), id="loops of 4 mm"),
        pytest.param(flat(shapely.box(-0.11, -0.015, 0.11, 0.015), 0.003, GREEN), id="a rule of 3 mm"),
    ],
)
def test_a_thin_thing_is_whole(thing, names):
    for seed in range(2):
        frames, truth = seen([thing], seed, names)
        report = Report()
        scene = perceive(frames, (), Parameters(**WORKSPACE), report=report)
        assert len(scene.objects) == 1
        for image, mask in zip(report.labels, truth, strict=True):
            assert np.count_nonzero(mask & (image == 1)) > 0.95 * np.count_nonzero(mask)
            assert np.count_nonzero(~mask & (image == 1)) < 0.2 * np.count_nonzero(mask)


def test_a_print_on_the_table_is_no_thing_nor_part_of_one():
    """A patch of a thin thing's colour that goes on from it has no height."""
    patch = flat(shapely.box(0.05, -0.06, 0.20, 0.06), 0.0001, GREEN)
    rule = flat(shapely.box(-0.06, -0.02, 0.05, 0.02), 0.005, GREEN)
    frames, _ = seen([patch], 3, ("left", "right"))
    assert not perceive(frames, (), Parameters(**WORKSPACE)).objects
    frames, truth = seen([rule, patch], 4, ("left", "right"))
    report = Report()
    assert len(perceive(frames, (), Parameters(**WORKSPACE), report=report).objects) == 1
    for image, mask in zip(report.labels, truth, strict=True):
        assert np.count_nonzero(~mask & (image == 1)) < 0.3 * np.count_nonzero(mask)
