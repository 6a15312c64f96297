"""Procedural neighbours of different colours, two or three, things on each other, and single things of several colours: what is to be
parted, and what is to stay one.

A round of a seed is one pair for each kind of pair, gap, height and equality of heights (108 of them), and as many threes, things that
stand on another, single things, and single things that another hides in part.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from magic_core import sensor, shapes, transforms
from magic_core.mesh import Mesh, concatenate
from magic_perception.piles import Pile, _at, _box

#: What pairs are drawn of: forms, gaps between the two, m, lowest and highest, m, and whether both are equally high.
FORMS, GAPS = (("box", "box"), ("box", "cylinder"), ("cylinder", "cylinder")), (0.0, 0.003, 0.005, 0.008, 0.010, 0.015)
HEIGHTS, EQUAL = ((0.012, 0.045), (0.05, 0.07), (0.07, 0.14)), (True, False)
PAIRS = tuple(itertools.product(FORMS, GAPS, HEIGHTS, EQUAL))
#: Single things, in turn: of two halves, of stripes, with a strap of the table's colour or a dark one, with a lid or a cap, printed, with a
#: handle; a lying bottle; and families whose parts are repainted.
SINGLE = (
    "halves", "stripes", "strap", "lid", "cap", "bands", "print", "printed", "handle", "bottle",
    "mug", "hammer", "mallet", "ladle", "caliper", "scissors", "spoon", "mug_tree",
)  # fmt: skip
#: How often a thing of a pair is printed on its top.
PRINTED = 0.3
#: The table's colours.
TABLES = ((186, 152, 112), (205, 190, 175), (120, 118, 115), (235, 235, 232), (70, 60, 52))
#: Least difference of two colours, in the two colour axes or in lightness (OpenCV's Lab of 8 bits).
HUE, LIGHTNESS = 20.0, 90.0
#: What share of things' depth is taken away, and in blobs of how many pixels.
MISSING, BLOBS = (0.3, 0.5, 0.7), (10, 20, 40, 80)
#: The middle of the scene, m.
MIDDLE = (0.52, 0.0)


def pair(seed: int, number: int) -> Pile:
    """The pair of a seed and of a number in :data:`PAIRS`."""
    random = np.random.default_rng([seed, number, 2911])
    table = TABLES[int(random.integers(len(TABLES)))]
    meshes, _, turn = _two(random, number, table)
    place = transforms.from_rpy(0, 0, turn, [*MIDDLE, 0])
    return _seen(random, [mesh.transformed(place) for mesh in meshes], table)


def three(seed: int, number: int) -> Pile:
    """Such a pair and a third thing beside it on any side, as far from it as its two are from each other."""
    random = np.random.default_rng([seed, number, 2913])
    table = TABLES[int(random.integers(len(TABLES)))]
    meshes, colors, turn = _two(random, number, table)
    (_, form), gap, (low, high), _ = PAIRS[number]
    color = _color(random, [table, *colors])
    third = _standing(random, form, random.uniform(low, high), color).transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
    meshes = [mesh.transformed(transforms.from_rpy(0, 0, turn)) for mesh in meshes]
    meshes = [*meshes, _beside(meshes, third, gap)]
    middle = np.mean([mesh.vertices[:, :2].mean(axis=0) for mesh in meshes], axis=0)
    place = transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi), [*MIDDLE, 0]) @ transforms.from_rpy(0, 0, 0, [*-middle, 0])
    return _seen(random, [mesh.transformed(place) for mesh in meshes], table)


def _two(random: np.random.Generator, number: int, table: tuple[int, int, int]) -> tuple[list[Mesh], list[tuple[int, int, int]], float]:
    """Two things side by side about the origin, their colours, and a turn to place them by."""
    forms, gap, (low, high), equal = PAIRS[number]
    first = _color(random, [table])
    colors = [first, _color(random, [table, first])]
    tall = random.uniform(low, high)
    heights = [tall, tall if equal else max(tall * random.uniform(0.4, 0.8), 0.010)]
    turn = random.uniform(-np.pi, np.pi)
    # Boxes side by side mostly, else in any direction; beside each other within a third of their width.
    turns = [0.0, 0.0 if random.random() < 0.7 else random.uniform(-np.pi, np.pi)]
    one, two = (
        _standing(random, form, height, color).transformed(transforms.from_rpy(0, 0, own, [0, random.uniform(-0.012, 0.012), 0]))
        for form, color, height, own in zip(forms, colors, heights, turns, strict=True)
    )
    meshes = [one, _beside([one], two, gap)]
    middle = transforms.from_rpy(0, 0, 0, [-float(meshes[1].vertices[:, 0].mean() - two.vertices[:, 0].mean()) / 2, 0, 0])
    return [mesh.transformed(middle) for mesh in meshes], colors, turn


def _standing(random: np.random.Generator, form: str, height: float, color: tuple[int, int, int]) -> Mesh:
    """A box or a cylinder on the table's origin, printed now and then."""
    if form == "box":
        solid = trimesh.creation.box([*random.uniform(0.035, 0.10, 2), height])
    else:
        solid = trimesh.creation.cylinder(random.uniform(0.018, 0.045), height, sections=64)
    solid.apply_translation([0, 0, height / 2])
    mesh = Mesh(solid.vertices, solid.faces).painted(color)
    return _printed(random, mesh, solid.extents, color) if random.random() < PRINTED else mesh


def _beside(meshes: list[Mesh], mesh: Mesh, gap: float) -> Mesh:
    """The mesh moved along x until it is so far from the others, m."""
    others = shapely.union_all([shapely.MultiPoint(other.vertices[:, :2]).convex_hull for other in meshes])
    outline = shapely.MultiPoint(mesh.vertices[:, :2]).convex_hull
    near, far = 0.0, 0.4
    for _ in range(20):
        middle = (near + far) / 2
        close = others.distance(shapely.affinity.translate(outline, middle, 0.0)) <= gap
        near, far = (middle, far) if close else (near, middle)
    return mesh.transformed(transforms.from_rpy(0, 0, 0, [far, 0, 0]))


def kind_of(number: int) -> str:
    """The kind of the single things of a number."""
    return SINGLE[number % len(SINGLE)]


def single(seed: int, number: int) -> Pile:
    """The single thing of a seed and of a number."""
    random = np.random.default_rng([seed, number, 2912])
    kind = kind_of(number)
    table = TABLES[int(random.integers(len(TABLES)))]
    one = _color(random, [table])
    two = _color(random, [table, one])
    low, high = HEIGHTS[int(random.integers(len(HEIGHTS)))]
    size = np.array([random.uniform(0.06, 0.16), random.uniform(0.04, 0.10), random.uniform(low, high)])
    if kind in shapes.FAMILIES:
        mesh = _repainted(random, shapes.make(kind, int(random.integers(1 << 20))).mesh, table)
    elif kind == "halves":
        mesh = _row(size, [random.uniform(0.3, 0.7)], [one, two], round_=random.random() < 0.25)
    elif kind == "stripes":
        cuts = np.sort(random.uniform(0.1, 0.9, int(random.integers(2, 5))))
        mesh = _row(size, list(cuts), [(one, two)[i % 2] for i in range(len(cuts) + 1)], round_=random.random() < 0.25)
    elif kind == "strap":
        width, start = random.uniform(0.003, 0.012) / size[0], random.uniform(0.25, 0.65)
        strap = table if random.random() < 0.5 else (25, 24, 26)
        mesh = _row(size, [start, start + width], [one, strap, two if random.random() < 0.5 else one])
    elif kind in ("lid", "cap", "bands"):
        radius = random.uniform(0.02, 0.045)
        wide = radius + (random.uniform(0.001, 0.003) if kind == "lid" else -random.uniform(0.3, 0.6) * radius if kind == "cap" else 0.0)
        part = random.uniform(0.2, 0.4) * size[2]
        box = kind == "lid" and random.random() < 0.5
        mesh = concatenate([_post(radius, 0.0, size[2] - part, one, box), _post(wide, size[2] - part, size[2], two, box)])
    elif kind == "handle":
        head = random.uniform([0.03, 0.03, 0.02], [0.09, 0.09, 0.06])
        solid = trimesh.creation.box([random.uniform(0.06, 0.14), *random.uniform(0.010, 0.028, 2)])
        solid.apply_translation(
            [(head[0] + solid.extents[0]) / 2, random.choice([0.0, random.uniform(-0.3, 0.3) * head[1]]), solid.extents[2] / 2]
        )
        mesh = concatenate([_row(head, [], [one], round_=random.random() < 0.5), Mesh(solid.vertices, solid.faces).painted(two)])
    elif kind == "bottle":
        radius, long, cap = random.uniform(0.015, 0.035), random.uniform(0.08, 0.16), random.uniform(0.015, 0.04)
        body = _post(radius, 0.0, long, one, box=False)
        mesh = concatenate([body, _post(random.uniform(0.4, 1.05) * radius, long, long + cap, two, box=False)])
        mesh = mesh.transformed(transforms.from_rpy(0, np.pi / 2, 0))
    elif kind == "printed":
        mesh = _box(random, size)
    else:
        mesh = _printed(random, _row(size, [], [one]), size, one)
    mesh = mesh.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
    return _seen(random, [_at(mesh, np.array(MIDDLE), 0.0)], table)


def behind(seed: int, number: int) -> Pile:
    """A thing of several colours, and another thing between it and a camera, which hides a part of it; both stand apart."""
    random = np.random.default_rng([seed, number, 2914])
    table = TABLES[int(random.integers(len(TABLES)))]
    one = _color(random, [table])
    two = _color(random, [table, one])
    low, high = HEIGHTS[number % len(HEIGHTS)]
    size = np.array([random.uniform(0.08, 0.22), random.uniform(0.06, 0.16), random.uniform(low, high)])
    kind = ("printed", "print", "halves", "stripes")[int(random.integers(4))]
    if kind == "printed":
        mesh = _box(random, size)
    elif kind == "print":
        mesh = _printed(random, _row(size, [], [one]), size, one)
    else:
        cuts = np.sort(random.uniform(0.1, 0.9, 1 if kind == "halves" else int(random.integers(2, 5))))
        mesh = _row(size, list(cuts), [(one, two)[i % 2] for i in range(len(cuts) + 1)])
    mesh = _at(mesh.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi))), np.array(MIDDLE), 0.0)
    names = (("left", "right"), ("left",), ("right",))[int(random.integers(3))]
    front = _standing(random, FORMS[int(random.integers(3))][1], random.uniform(0.04, 0.20), _color(random, [table]))
    front = front.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
    way = sensor.STATION[names[0]][:2, 3] - MIDDLE
    turn = transforms.from_rpy(0, 0, float(np.arctan2(way[1], way[0])), [*MIDDLE, 0])
    away = transforms.from_rpy(0, 0, 0, [0, random.uniform(-0.08, 0.08), 0])
    front = _beside([mesh.transformed(transforms.inverse(turn))], front.transformed(away), random.uniform(0.012, 0.06)).transformed(turn)
    return _seen(random, [mesh, front], table, names)


def stacked(seed: int, number: int) -> Pile:
    """A thing with a flat top, and a smaller one of another colour anywhere on it: a box, a cylinder, or a mug; by two cameras."""
    random = np.random.default_rng([seed, number, 2915])
    table = TABLES[int(random.integers(len(TABLES)))]
    first = _color(random, [table])
    color = _color(random, [table, first])
    height = random.uniform(*HEIGHTS[number % len(HEIGHTS)])
    top = ("box", "cylinder", "mug")[number // len(HEIGHTS) % 3]
    if top == "mug":
        upper = shapes.make("mug", int(random.integers(1 << 20))).mesh
        upper = Mesh(upper.vertices, upper.faces).painted(color)
    else:
        upper = _standing(random, top, random.uniform(*HEIGHTS[int(random.integers(len(HEIGHTS)))]), color)
    upper = upper.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
    reach = np.ptp(upper.vertices[:, :2], axis=0)
    if top == "cylinder" and random.random() < 0.5:
        radius = np.hypot(*reach) / 2 + random.uniform(0.005, 0.03)
        size = np.array([2 * radius, 2 * radius, height])
        lower = _row(size, [], [first], round_=True)
        room = np.full(2, (radius - np.hypot(*reach) / 2) / np.sqrt(2))
    else:
        size = np.array([*(reach + random.uniform(0.01, 0.12, 2)), height])
        lower = _row(size, [], [first])
        if random.random() < PRINTED:
            lower = _printed(random, lower, size, first)
        room = (size[:2] - reach) / 2
    upper, lower = _at(upper, random.uniform(-room, room), height), _at(lower, np.zeros(2), 0.0)
    place = transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi), [*MIDDLE, 0])
    return _seen(random, [mesh.transformed(place) for mesh in (lower, upper)], table, ("left", "right"))


def torn(made: Pile, number: int) -> Pile:
    """A scene of a number with a share of its things' depth missing in each picture, and as much of the rest, in blobs of one size; colour
    is whole."""
    share, wide = MISSING[number % len(MISSING)], BLOBS[number // len(MISSING) % len(BLOBS)]
    frames = []
    for i, (frame, truth) in enumerate(zip(made.frames, made.truth, strict=True)):
        # Noise that is smoothed so passes its mean every so many pixels.
        wander = cv2.GaussianBlur(np.random.default_rng([number, i, 2916]).standard_normal(truth.shape), (0, 0), wide / 4.4)
        lost = wander < np.quantile(wander[truth > 0], share) if np.any(truth > 0) else np.zeros(truth.shape, bool)
        frames.append(replace(frame, depth=np.where(lost, np.float32(np.nan), frame.depth)))
    return replace(made, frames=frames)


def _seen(random: np.random.Generator, meshes: list[Mesh], table: tuple[int, int, int], names: tuple[str, ...] | None = None) -> Pile:
    """The scene by the station's cameras of these names, or by one of them or both, by the sensor that smears."""
    caster = sensor.scene_raycaster(meshes, sensor.table_mesh(color=table))
    names = names or (("left", "right"), ("left", "right"), ("left",), ("right",))[int(random.integers(4))]
    seed = int(random.integers(1 << 30))
    frames = [
        sensor.capture([], sensor.D435, sensor.STATION[name], [seed, i], model=sensor.SMEARED, camera=name, raycaster=caster)
        for i, name in enumerate(names)
    ]
    return Pile(frames, [caster.perspective(sensor.D435, sensor.STATION[name])[0].ids for name in names], meshes)


def _row(size: NDArray[np.float64], cuts: list[float], colors: list[tuple[int, int, int]], round_: bool = False) -> Mesh:
    """A box (3,), or a cylinder as wide, of pieces of these colours side by side, cut at these shares of its length."""
    edges = [0.0, *cuts, 1.0]
    outline = shapely.Point(0, 0).buffer(size[1] / 2, 32) if round_ else shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
    low, _, high, _ = outline.bounds
    pieces = []
    for color, start, end in zip(colors, edges[:-1], edges[1:], strict=True):
        piece = outline.intersection(shapely.box(low + start * (high - low), -1, low + end * (high - low), 1))
        solid = trimesh.creation.extrude_polygon(piece, size[2])
        pieces.append(Mesh(solid.vertices, solid.faces).painted(color))
    return concatenate(pieces)


def _printed(random: np.random.Generator, mesh: Mesh, size: NDArray[np.float64], color: tuple[int, int, int]) -> Mesh:
    """The mesh, whose box (3,) stands on the table's origin, with patches as thin as paint on its top."""
    patches = []
    for _ in range(int(random.integers(1, 4))):
        extent = size[:2] * random.uniform(0.2, 0.6, 2)
        solid = trimesh.creation.box([*extent, 0.0004])
        solid.apply_translation([*(random.uniform(-0.35, 0.35, 2) * (size[:2] - extent)), size[2]])
        patches.append(Mesh(solid.vertices, solid.faces).painted(_color(random, [color])))
    return concatenate([mesh, *patches])


def _post(radius: float, low: float, high: float, color: tuple[int, int, int], box: bool) -> Mesh:
    solid = (
        trimesh.creation.box([2 * radius, 2 * radius, high - low]) if box else trimesh.creation.cylinder(radius, high - low, sections=64)
    )
    solid.apply_translation([0, 0, (low + high) / 2])
    return Mesh(solid.vertices, solid.faces).painted(color)


def _repainted(random: np.random.Generator, mesh: Mesh, table: tuple[int, int, int]) -> Mesh:
    """The mesh with each of its colours another."""
    _, index = np.unique(mesh.colors, axis=0, return_inverse=True)
    paints: list[tuple[int, int, int]] = []
    for _ in range(int(index.max()) + 1):
        paints.append(_color(random, [table, *paints[-1:]]))
    return Mesh(mesh.vertices, mesh.faces, np.array(paints, np.uint8)[index.ravel()])


def _color(random: np.random.Generator, others: list[tuple[int, int, int]]) -> tuple[int, int, int]:
    """A colour that differs from others."""
    while True:
        r, g, b = random.uniform(20, 240, 3).astype(int) if random.random() < 0.75 else np.full(3, random.integers(20, 245))
        lab = cv2.cvtColor(np.array([[(r, g, b), *others]], np.uint8), cv2.COLOR_RGB2LAB)[0].astype(float)
        light, *hue = np.abs(lab[1:] - lab[0]).T
        if np.all((np.hypot(*hue) > HUE) | (light > LIGHTNESS)):
            return int(r), int(g), int(b)
