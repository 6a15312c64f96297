"""What becomes of a mug's handle: ``evaluate --mugs N``.

Each of N made mugs of a drawn form, colour and place, two of three upright in a drawn turn, the third on its side, is seen by the two
smearing D435 of the station.  Of each it is told how much of its handle's opening the better of the cameras has in sight
(:class:`magic_core.loops.Opening`), whether the opening is open and the handle there in what perception makes of it, and how far the two
surfaces are apart.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magic_core import shapes, transforms
from magic_core.loops import Opening
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_core.sensor import D435, SMEARED, STATION, capture, scene_raycaster
from magic_perception.averaging import average
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.pipeline import perceive
from magic_perception.surface_error import distance

#: Frames that are averaged, as perception does with those of a camera at rest.
AVERAGED = 3
#: From which share of its opening on a handle counts as in sight.
IN_SIGHT = 0.15
#: How far about its opening a handle is looked for, and through how much, m.
ABOUT, THROUGH = 0.012, 0.03
ATTITUDES = ("upright", "on its side")


def measure(count: int, seed: int, said: Callable[[str], None] = lambda _: None) -> dict[str, object]:
    """Of ``count`` mugs: share of the opening in sight, open, barred, error_mm, and attitude; said: is told of each that is done."""
    rows: list[dict[str, object]] = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        mug = shapes.make("mug", int(rng.integers(1 << 30)))
        attitude = ATTITUDES[number % 3 == 2]
        turned = transforms.from_rpy(0, 0, rng.uniform(-np.pi, np.pi))
        if attitude == ATTITUDES[1]:
            turned = transforms.from_rpy(0, np.pi / 2, rng.uniform(-np.pi, np.pi)) @ turned
        low = float(mug.mesh.transformed(turned).bounds[0, 2])
        pose = transforms.make(translation=[*(np.array([0.5, 0.0]) + rng.uniform(-0.08, 0.08, 2)), -low]) @ turned
        truth = mug.mesh.transformed(pose).painted(tuple(int(c) for c in rng.integers(30, 220, 3)))
        caster = scene_raycaster([truth])
        frames = [
            average([capture([], D435, eye, [seed, number, i, k], camera=name, raycaster=caster, model=SMEARED) for k in range(AVERAGED)])
            for i, (name, eye) in enumerate(STATION.items())
        ]
        scene = perceive(frames, (), Parameters(**WORKSPACE))
        opening = Opening.within(mug.region("handle_loop").points).moved(pose)
        row: dict[str, object] = {
            "attitude": attitude,
            "in_sight": round(max(opening.in_sight(eye[:3, 3], Raycaster([truth])) for eye in STATION.values()), 3),
            "objects": len(scene.objects),
        }
        if len(scene.objects) == 1:
            found = scene.objects[0].mesh.transformed(scene.objects[0].world_from_object)
            row |= {**_handle(opening, truth, found), "error_mm": round(1000 * distance(truth, found), 2)}
        rows.append(row)
        said(f"mugs: {number + 1} of {count}")
    return {"mugs": count, "seed": seed, "rows": rows}


def _handle(opening: Opening, truth: Mesh, found: Mesh) -> dict[str, object]:
    """Whether most of a handle's opening is open in what was found, and most of the bars about it are there."""
    plane = np.linalg.svd(opening.through[None])[2]  # the way through, and two directions in the opening
    flat = (opening.points - opening.points.mean(axis=0)) @ plane[1:].T
    low, high = flat.min(axis=0) - ABOUT, flat.max(axis=0) + ABOUT
    grid = np.stack(np.meshgrid(*(np.arange(a, b, 0.001) for a, b in zip(low, high, strict=True))), axis=-1).reshape(-1, 2)
    around = opening.points.mean(axis=0) + grid @ plane[1:]

    def solid(mesh: Mesh, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        starts = points - THROUGH * opening.through
        return Raycaster([mesh]).cast(starts[None], np.broadcast_to(opening.through, starts.shape)[None]).distance[0] < 2 * THROUGH

    free = opening.points[~solid(truth, opening.points)]
    bars = around[solid(truth, around)]
    return {"open": bool(np.mean(solid(found, free)) < 0.5), "barred": bool(np.mean(solid(found, bars)) > 0.5)}


def markdown(result: dict) -> str:
    """The table, by attitude and by whether the opening is in sight."""
    lines = [
        f"Made mugs: {result['mugs']}, seed {result['seed']}; the opening is in sight where a camera has {IN_SIGHT:.0%} of it.",
        "",
        "| | opening | one thing | its handle open and there | surface off, mm: middle | nine of ten below |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for attitude in ATTITUDES:
        for sight, shown in (("in sight", True), ("out of sight", False)):
            rows = [r for r in result["rows"] if r["attitude"] == attitude and (r["in_sight"] >= IN_SIGHT) == shown]
            one = [r for r in rows if r["objects"] == 1]
            off = [r["error_mm"] for r in one]
            good = sum(r["open"] and r["barred"] for r in one)
            figures = f"{np.median(off):.1f} | {np.percentile(off, 90):.1f}" if off else " | "
            lines.append(f"| {attitude} | {sight} | {len(one)} of {len(rows)} | {good} | {figures} |")
    return "\n".join([*lines, ""])
