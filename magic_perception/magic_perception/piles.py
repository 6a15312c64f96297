"""Procedural table-tops whose things are known: single things, and piles of boxes, tins, bowls, mugs and tools that touch and stand on each
other.

What a segmentation is taught and judged by where labelled pictures are few: seams between things, and the seams that one thing has itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from magic_core import sensor, shapes, transforms
from magic_core.camera import RgbdFrame
from magic_core.mesh import Mesh, concatenate
from magic_perception.primitives import revolve, turn_ring

#: Families of procedural things that stand with seams of their own, and what lies.
OWN_SEAMS = ("mug", "mug", "mug", "ladle", "measuring_cup", "mug_tree", "mallet", "hammer")
#: Where the pile is, m.
MIDDLE = (0.5, 0.0)


@dataclass(frozen=True)
class Pile:
    """Frames of one scene, for each (H, W) the number of the thing at each pixel (from 1, 0 for the table, -1 for nothing), and the things'
    meshes."""

    frames: list[RgbdFrame]
    truth: list[NDArray[np.int32]]
    meshes: list[Mesh]

    @property
    def things(self) -> int:
        """How many."""
        return len(self.meshes)


def pile(seed: int, single: float = 0.4) -> Pile:
    """The scene of a seed; ``single``: how often it is one thing alone."""
    random = np.random.default_rng([seed, 1105])
    count = 1 if random.random() < single else int(random.integers(2, 7))
    meshes: list[Mesh] = []
    tops: list[tuple[Mesh, float]] = []
    for number in range(count):
        mesh, carries = _thing(random, int(seed * 16 + number), count == 1)
        carrier = tops[int(random.integers(len(tops)))] if tops and random.random() < 0.45 else None
        if carrier is not None:
            below, top = carrier
            span = 0.3 * (below.bounds[1, :2] - below.bounds[0, :2])
            place = below.bounds[:, :2].mean(axis=0) + random.uniform(-span, span)
            if number and any(_overlap(_at(mesh, place, top), other) for other in meshes if other is not below):
                carrier = None
            else:
                mesh = _at(mesh, place, top)
                tops = [item for item in tops if item[0] is not below]
        if carrier is None:
            mesh = _beside(random, mesh, meshes)
        meshes.append(mesh)
        if carries:
            tops.append((mesh, float(mesh.bounds[1, 2])))
    model = sensor.SMEARED if random.random() < 0.6 else None
    table = sensor.table_mesh(
        color=tuple(int(c) for c in random.choice([[186, 152, 112], [205, 190, 175], [120, 118, 115], [235, 235, 232]]))
    )
    caster = sensor.scene_raycaster(meshes, table)
    frames, truth = [], []
    azimuth, elevation = random.uniform(-np.pi, np.pi), np.radians(random.uniform(28, 62))
    for i in range(1 if random.random() < 0.6 else 2):
        way = azimuth + i * random.uniform(0.6, 1.4)
        distance = random.uniform(0.6, 1.0)
        level = np.cos(elevation) * distance
        eye = [MIDDLE[0] + level * np.cos(way), MIDDLE[1] + level * np.sin(way), 0.04 + distance * np.sin(elevation)]
        pose = sensor.looking_at(eye, [*MIDDLE, 0.04])
        frames.append(sensor.capture([], sensor.D435, pose, [seed, i], model=model, camera=f"camera_{i}", raycaster=caster))
        truth.append(caster.perspective(sensor.D435, pose)[0].ids)
    return Pile(frames, truth, meshes)


def _at(mesh: Mesh, place: NDArray[np.float64], height: float) -> Mesh:
    """The mesh with the middle of its box at a place (2,), standing at a height."""
    low, high = mesh.bounds
    return mesh.transformed(transforms.make(None, [*(np.asarray(place) - (low + high)[:2] / 2), height - low[2]]))


def _footprint(mesh: Mesh) -> shapely.Geometry:
    return shapely.MultiPoint(mesh.vertices[:, :2]).convex_hull


def _overlap(a: Mesh, b: Mesh) -> bool:
    return a.bounds[0, 2] < b.bounds[1, 2] - 0.001 and a.bounds[1, 2] > b.bounds[0, 2] + 0.001 and _footprint(a).intersects(_footprint(b))


def _beside(random: np.random.Generator, mesh: Mesh, others: list[Mesh]) -> Mesh:
    """The mesh on the table, up to 12 mm beside the others."""
    mesh = _at(mesh, np.array(MIDDLE), 0.0)
    if not others:
        return mesh
    way = random.uniform(-np.pi, np.pi)
    step = np.array([np.cos(way), np.sin(way)])
    gap = random.choice([0.0, random.uniform(0, 0.012)])
    taken = shapely.union_all([_footprint(other) for other in others])
    mine = _footprint(mesh)
    low, high = 0.0, 0.8
    for _ in range(14):
        middle = (low + high) / 2
        near = shapely.affinity.translate(mine, *(middle * step)).distance(taken) <= gap
        low, high = (middle, high) if near else (low, middle)
    return mesh.transformed(transforms.make(None, [*(high * step), 0.0]))


def _thing(random: np.random.Generator, seed: int, alone: bool) -> tuple[Mesh, bool]:
    """A thing at the origin, turned at random, and whether others may stand on it."""
    draw = random.random()
    if alone or draw < 0.25:
        kind = str(random.choice(["family", "family", "bottle", "bowl", "tee", "box"])) if alone else "family"
    else:
        kind = "box" if draw < 0.72 else "tin" if draw < 0.86 else "bowl" if draw < 0.93 else "bottle"
    if kind == "family":
        mesh = shapes.make(str(random.choice(OWN_SEAMS)), seed).mesh
    elif kind == "box":
        mesh = _box(random, np.sort(random.uniform(0.03, 0.22, 3))[random.permutation(3)])
    elif kind == "tin":
        radius, height = random.uniform(0.025, 0.055), random.uniform(0.03, 0.16)
        mesh = _banded(random, revolve(np.array([[radius, z] for z in np.linspace(0, height, 12)]), np.zeros(2)))
    elif kind == "bottle":
        radius, neck, height = random.uniform(0.025, 0.045), random.uniform(0.3, 0.55), random.uniform(0.1, 0.17)
        profile = [[radius, z] for z in np.linspace(0, height, 10)] + [
            [neck * radius, height + 0.2 * radius],
            [neck * radius, height + random.uniform(0.03, 0.07)],
        ]
        mesh = _banded(random, revolve(np.array(profile), np.zeros(2)))
    elif kind == "bowl":
        radius, height, wall = random.uniform(0.05, 0.09), random.uniform(0.04, 0.08), 0.004
        rise = np.linspace(0.02, 1, 9)
        outer = np.column_stack([radius * (0.45 + 0.55 * np.sqrt(rise)), height * (rise - 0.02)])
        inner = outer[::-1] - [wall, -wall * 0.5]
        mesh = turn_ring(np.vstack([[[0.0005, 0]], outer, inner, [[0.0005, inner[-1, 1]]]]), np.zeros(2)).painted(_paint(random))
    else:
        stem, head = random.uniform(0.015, 0.035), random.uniform(0.05, 0.11)
        base = _box(random, np.array([head, random.uniform(0.04, 0.1), random.uniform(0.03, 0.06)]))
        post = _box(random, np.array([stem, stem, random.uniform(0.08, 0.2)]))
        mesh = concatenate([_at(base, np.zeros(2), 0.0), _at(post, np.zeros(2), float(base.extents[2]) - 0.0005)])
    return mesh.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi))), kind in ("box", "tin")


def _paint(random: np.random.Generator) -> tuple[int, int, int]:
    r, g, b = random.uniform(25, 240, 3).astype(int) if random.random() < 0.7 else np.full(3, random.integers(30, 240))
    return int(r), int(g), int(b)


def _box(random: np.random.Generator, size: NDArray[np.float64]) -> Mesh:
    """A box (3,) printed with a few patches, or plain."""
    base, patches = _paint(random), [_paint(random) for _ in range(int(random.integers(0, 5)))]
    vertices, faces, colors = [], [], []
    total = 0
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        n, m = (max(2, int(np.ceil(size[k] / 0.012)) + 1) for k in (i, j))
        s, t = np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, m), indexing="ij")
        grid = np.arange(n * m).reshape(n, m)
        quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
        for side in (-0.5, 0.5):
            points = np.empty((n * m, 3))
            points[:, axis], points[:, i], points[:, j] = side * size[axis], s.ravel() * size[i], t.ravel() * size[j]
            paint = np.tile(np.array(base, np.uint8), (n * m, 1))
            for patch in patches:
                low = random.uniform(-0.5, 0.4, 2)
                high = low + random.uniform(0.1, 0.7, 2)
                inside = (s.ravel() > low[0]) & (s.ravel() < high[0]) & (t.ravel() > low[1]) & (t.ravel() < high[1])
                paint[inside] = patch
            turn = quads if side > 0 else quads[:, ::-1]
            vertices.append(points)
            colors.append(paint)
            faces.append(np.concatenate([turn[:, [0, 1, 2]], turn[:, [0, 2, 3]]]) + total)
            total += n * m
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors))


def _banded(random: np.random.Generator, mesh: Mesh) -> Mesh:
    """A turned thing with up to two bands of other colours."""
    colors = np.tile(np.array(_paint(random), np.uint8), (len(mesh.vertices), 1))
    for _ in range(int(random.integers(0, 3))):
        low = random.uniform(0, 0.8) * mesh.bounds[1, 2]
        colors[(mesh.vertices[:, 2] > low) & (mesh.vertices[:, 2] < low + random.uniform(0.02, 0.08))] = _paint(random)
    return Mesh(mesh.vertices, mesh.faces, colors)
