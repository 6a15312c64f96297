"""What more views bring: surfaces of procedural things with one, two and five views, and what has moved between them:
``evaluate --views N``.

Every scene holds four things; the model of a D435 with smear (:data:`magic_core.sensor.SMEARED`) sees it from one fixed camera, from two,
and from two and three earlier places of a camera at the wrist.  Then one thing is moved by some millimetres, and the two fixed
cameras look again: the earlier views of it have to be dropped, those of the others kept.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magic_core import shapes, transforms
from magic_core.camera import RgbdFrame
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_core.scene import Scene, SceneObject
from magic_core.sensor import D435, SMEARED, STATION, capture, looking_at, scene_raycaster
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.pipeline import Report, perceive

REGION = Parameters(**WORKSPACE)
#: Where the camera at the wrist has looked from.
WRIST = (
    looking_at([0.25, 0.3, 0.5], [0.5, 0, 0.02]),
    looking_at([0.2, -0.3, 0.5], [0.55, -0.1, 0.02]),
    looking_at([0.5, -0.6, 0.35], [0.55, -0.1, 0.02]),
)
#: Of what families things are, where each stands (x, y), m, and by how much, m, that one of them is moved.
FAMILIES = ("mug", "caliper", "cylinder", "l_hook", "hanger", "spoon")
PLACES = ((0.42, -0.25), (0.42, 0.20), (0.68, -0.20), (0.68, 0.22))
MOVES = (0.0, 0.005, 0.010, 0.020, 0.100)
#: A true surface is there where the reconstructed one is so near, m.
NEAR = 0.004


def views(meshes: list[Mesh], poses: dict[str, NDArray[np.float64]], stamp: float, seed: int) -> list[RgbdFrame]:
    """A frame from each pose, by the name of its camera."""
    caster = scene_raycaster(meshes)
    return [
        capture([], D435, pose, [seed, i], camera=name, stamp=stamp, raycaster=caster, model=SMEARED)
        for i, (name, pose) in enumerate(poses.items())
    ]


def compared(item: SceneObject, truth: Mesh, count: int = 3000) -> tuple[float, float]:
    """Share of the true surface (world), what rests on the table left out, that lies within ``NEAR`` of the reconstructed one, and
    the 90th percentile of the distances of the reconstructed surface from the true one, m."""
    mesh = item.mesh.transformed(item.world_from_object)
    return (
        float(np.mean(Raycaster([mesh]).distances(_surface(truth, count)) < NEAR)),
        float(np.percentile(Raycaster([truth]).distances(_surface(mesh, count)), 90)),
    )


def _surface(mesh: Mesh, count: int) -> NDArray[np.float64]:
    """Points (count, 3) spread evenly over a mesh, without what rests on the table."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) * (np.stack([a, b, c])[..., 2].max(axis=0) > 0.002)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def _at(scene: Scene, mesh: Mesh) -> SceneObject | None:
    """The one object whose box is centred within 60 mm of a mesh's."""
    found = [o for o in scene.objects if np.linalg.norm(o.world_from_box[:2, 3] - mesh.bounds[:, :2].mean(axis=0)) < 0.06]
    return found[0] if len(found) == 1 else None


def measure(count: int, seed: int, moves: tuple[float, ...] = MOVES, said: Callable[[str], None] = lambda _: None) -> dict[str, object]:
    """Over ``count`` scenes: by the number of views what of the surfaces is there, and by how far a thing was moved what became of its
    earlier views.

    moves: by how much one thing is moved, m; said: is told of each scene that is done.
    """
    surfaces: dict[int, list[tuple[float, float, float] | None]] = {1: [], 2: [], 5: []}
    moved: dict[float, list[tuple[bool, int, float | None]]] = {move: [] for move in moves}
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        meshes = []
        for place in PLACES:
            mesh = shapes.make(FAMILIES[rng.integers(len(FAMILIES))], int(rng.integers(10000))).mesh
            x, y = place + rng.uniform(-0.03, 0.03, 2)
            meshes.append(mesh.transformed(transforms.from_rpy(0, 0, rng.uniform(-np.pi, np.pi), [x, y, -mesh.bounds[0, 2]])))
        frames = views(meshes, {**{f"wrist {i}": pose for i, pose in enumerate(WRIST)}, **STATION}, 1.0, int(rng.integers(2**31)))
        earlier, fixed = frames[: len(WRIST)], frames[len(WRIST) :]
        for views_used in surfaces:
            scene = perceive(fixed[: min(views_used, 2)], (), REGION, earlier=earlier if views_used == 5 else ())
            for mesh in meshes:
                item = _at(scene, mesh)
                surfaces[views_used].append((item.seen_share, *compared(item, mesh)) if item is not None else None)
        way = rng.uniform(-np.pi, np.pi)
        for move in moves:
            now = [meshes[0].transformed(transforms.make(translation=[move * np.cos(way), move * np.sin(way), 0])), *meshes[1:]]
            report = Report()
            scene = perceive(views(now, STATION, 2.0, int(rng.integers(2**31))), (), REGION, None, report, earlier)
            dropped = [[_blind_at(new, mesh) for mesh in meshes] for _, new in report.earlier]
            item = _at(scene, now[0])
            moved[move].append(
                (
                    all(row[0] for row in dropped),
                    sum(sum(row[1:]) for row in dropped),
                    compared(item, now[0])[1] if item is not None else None,
                )
            )
        said(f"views: scene {number + 1} of {count}")
    return {
        "scenes": count,
        "seed": seed,
        "surfaces": {
            views_used: {
                "things": len(rows),
                "found": len(told := [r for r in rows if r is not None]),
                "seen": _mean([r[0] for r in told], 3),
                "there": _mean([r[1] for r in told], 3),
                "off_mm": _mean([1000 * r[2] for r in told], 2),
            }
            for views_used, rows in surfaces.items()
        },
        "moved": {
            f"{1000 * move:.0f}": {
                "dropped": sum(r[0] for r in rows),
                "others_dropped": sum(r[1] for r in rows),
                "of": len(rows) * len(WRIST) * (len(PLACES) - 1),
                "found": len(offs := [r[2] for r in rows if r[2] is not None]),
                "off_mm": _mean([1000 * off for off in offs], 2),
            }
            for move, rows in moved.items()
        },
    }


def _mean(values: list[float], digits: int) -> float | None:
    """``None`` of nothing."""
    return round(float(np.mean(values)), digits) if values else None


def _blind_at(frame: RgbdFrame, mesh: Mesh) -> bool:
    """Whether a frame says nothing of most of a mesh (world)."""
    if frame.blind is None:
        return False
    k = frame.intrinsics
    pixels = np.rint(k.project(transforms.apply(transforms.inverse(frame.world_from_camera), mesh.vertices))).astype(int)
    pixels = pixels[np.all((pixels >= 0) & (pixels < (k.width, k.height)), axis=1)]
    return len(pixels) > 0 and float(frame.blind[pixels[:, 1], pixels[:, 0]].mean()) > 0.5


def markdown(result: dict) -> str:
    """The two tables."""
    lines = [
        f"Several views: {result['scenes']} scenes of four things, seed {result['seed']}.",
        "",
        f"| views | things found | surface seen | true surface within {1000 * NEAR:.0f} mm | own surface off, mm (90 %) |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {n} | {r['found']} of {r['things']} | {r['seen']:.1%} | {r['there']:.1%} | {r['off_mm']:.2f} |"
        if r["found"]
        else f"| {n} | 0 of {r['things']} | | | |"
        for n, r in result["surfaces"].items()
    ]
    lines += [
        "",
        "| moved by, mm | scenes in which all its earlier views were dropped | of the other things dropped | found once | own surface off, mm (90 %) |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {move} | {r['dropped']} of {result['scenes']} | {r['others_dropped']} of {r['of']} | {r['found']} | {r['off_mm']} |"
        for move, r in result["moved"].items()
    ]
    return "\n".join(lines) + "\n"
