"""Learn how far the surface of a reconstruction is off: ``ros2 run magic_perception learn_surface_error --out surface_error.json``.

Procedural scenes are perceived: one of four of :mod:`magic_perception.piles`, and beside it a ball or a cylinder alone, of the others one
tool alone, with one camera, with two, and with two of which one is off by up to 10 mm.  The error of a found thing is the root mean square
distance between its surface and that of the true thing that it shares most pixels with.  What five of six stay below is the exponential of
a linear function of what was seen (:mod:`magic_perception.surface_error`).  A few more things than that lie above what weights state that
were fitted to others, so the constant is raised until five of six lie below on scenes held out from the fit.  The table is of scenes that
neither knows (five folds by scene, within each of which it is done anew); ``--out`` then gets the weights from everything.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core import sensor, shapes, transforms
from magic_core.errors import MagicError
from magic_perception import surface_error
from magic_perception.learn_confidence import ALONE, shared_most, shifted
from magic_perception.parameters import Parameters
from magic_perception.piles import MIDDLE, Pile, pile
from magic_perception.pipeline import Report, perceive

#: Penalty of the fit: of 1, 3 and 10 that with the least loss of what was held out.
RIDGE = 3.0
#: What is drawn first, and then a family of it: vessels with a handle, scoops, and all others but what stands fixed.
VESSELS, SCOOPS, FIXED = ("mug",), ("spoon", "ladle", "measuring_cup"), ("mug_tree", "rod")
#: What tools are used on, most of all.
TARGETS = ("sphere", "cylinder")
OTHERS = tuple(name for name in shapes.FAMILIES if name not in (*VESSELS, *SCOOPS, *FIXED))
#: Of so many scenes one is a pile.
PILES = 4
#: Bounds of the table's rows, mm.
BINS = (0.0, 1.0, 1.5, 2.5, 5.0, 30.0)
#: Parts of the scenes that are held out in turn.
FOLDS = 5


@dataclass(frozen=True)
class Judged:
    """A found thing: its scene, how its solid came about, the numbers (C,) that tell its error, and the error, m."""

    scene: int
    shape: str
    row: NDArray[np.float64]
    error: float


def drawn(seed: int) -> list[Pile]:
    """The scenes of a seed."""
    if seed % PILES:
        kinds = (VESSELS, SCOOPS, OTHERS)
        return [alone(seed, lambda random: kinds[int(random.integers(len(kinds)))])]
    return [pile(seed, ALONE), alone(seed, lambda _: TARGETS)]


def alone(seed: int, kind: Callable[[np.random.Generator], tuple[str, ...]]) -> Pile:
    """One thing alone of a family of the kind, seen by two cameras or one that smear depth."""
    random = np.random.default_rng([seed, 2911])
    family = str(random.choice(kind(random)))
    mesh = shapes.make(family, seed).mesh
    mesh = mesh.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
    low, high = mesh.bounds
    place = [*(np.array(MIDDLE) + random.uniform(-0.15, 0.15, 2) - (low + high)[:2] / 2), -low[2]]
    mesh = mesh.transformed(transforms.make(None, place))
    caster = sensor.scene_raycaster([mesh])
    frames, truth = [], []
    way, across = random.uniform(-np.pi, np.pi), random.uniform(0.8, 2.2)
    for i in range(2 if random.random() < 0.7 else 1):
        elevation, distance = np.radians(random.uniform(35, 60)), random.uniform(0.6, 0.95)
        level = np.cos(elevation) * distance
        turned = way + i * across
        eye = [MIDDLE[0] + level * np.cos(turned), MIDDLE[1] + level * np.sin(turned), 0.04 + distance * np.sin(elevation)]
        pose = sensor.looking_at(eye, [*MIDDLE, 0.04])
        frames.append(sensor.capture([], sensor.D435, pose, [seed, i], model=sensor.SMEARED, camera=f"camera_{i}", raycaster=caster))
        truth.append(caster.perspective(sensor.D435, pose)[0].ids)
    return Pile(frames, truth, [mesh])


def judged(seed: int) -> list[Judged]:
    """The things found in the scenes of a seed."""
    result = []
    for made in drawn(seed):
        report = Report()
        region = Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.3, 0.8, 0.6))
        try:
            scene = perceive(shifted(made.frames, seed), parameters=region, report=report)
        except MagicError:
            continue
        for item in scene.objects:
            thing = shared_most([image == report.numbers[item.id] for image in report.labels], made)
            if thing:
                error = surface_error.distance(made.meshes[thing - 1], item.mesh.transformed(item.world_from_object))
                row = surface_error.row(report.evidence[item.id], report.departures[item.id])
                result.append(Judged(seed, report.shapes[item.id], row, error))
    return result


def learned(things: list[Judged]) -> surface_error.Quantile:
    """The weights of all things, with a constant by which :data:`surface_error.SHARE` of them lie below what weights state that do not know
    their scene."""
    errors = _numbers(things)[1]
    over = np.sort(np.log(np.maximum(errors, surface_error.LEAST) / _held_out(things, FOLDS, _fitted)))
    place = min(int(np.ceil((len(over) + 1) * surface_error.SHARE)), len(over)) - 1
    model = _fitted(things)
    return replace(model, constant=model.constant + max(float(over[place]), 0.0))


def _fitted(things: list[Judged]) -> surface_error.Quantile:
    return surface_error.fit(*_numbers(things), ridge=RIDGE)


def _numbers(things: list[Judged]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.stack([t.row for t in things]), np.array([t.error for t in things])


def _held_out(things: list[Judged], folds: int, fit: Callable[[list[Judged]], surface_error.Quantile]) -> NDArray[np.float64]:
    """What is stated of each thing, m, by a fit to the scenes of the other folds."""
    fold = np.array([t.scene // PILES for t in things]) % folds
    stated = np.zeros(len(things))
    for number in range(folds):
        model = fit([t for t, other in zip(things, fold, strict=True) if other != number])
        stated[fold == number] = [model.error(t.row) for t, other in zip(things, fold, strict=True) if other == number]
    return stated


def cross_validated(things: list[Judged], folds: int = 5) -> tuple[str, float]:
    """How often things are off by less than is stated, by weights that know nothing of their scene; and the quantile's loss, in the
    logarithm."""
    errors = _numbers(things)[1]
    stated = _held_out(things, folds, learned)
    over = np.log(np.maximum(errors, surface_error.LEAST) / stated)
    loss = float(np.mean(np.maximum(surface_error.SHARE * over, (surface_error.SHARE - 1) * over)))
    lines = ["| stated, mm, held out | things | below | share | true, mm: median, 84 % |", "| --- | --- | --- | --- | --- |"]

    def line(name: str, here: NDArray[np.bool_]) -> str:
        middle, most = 1000 * np.percentile(errors[here], [50, 84])
        below = errors[here] <= stated[here]
        return f"| {name} | {here.sum()} | {below.sum()} | {below.mean():.2f} | {middle:.1f}, {most:.1f} |"

    for low, high in itertools.pairwise(BINS):
        here = (1000 * stated > low) & (1000 * stated <= high)
        if here.any():
            lines.append(line(f"{low} to {high}", here))
    lines += [line(shape, np.array([t.shape == shape for t in things])) for shape in sorted({t.shape for t in things})]
    lines.append(line("all", np.ones(len(things), bool)))
    return "\n".join(lines) + f"\n\nloss {loss:.4f} of {len(things)} things of {len({t.scene for t in things})} seeds", loss


def main(args: list[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=84, help="seeds of procedural scenes (default 84)")
    parser.add_argument("--first", type=int, default=710000, help="seed of the first (default 710000)")
    parser.add_argument("--out", type=Path, help="file for the weights; without it nothing is written")
    given = parser.parse_args(args)
    things = [thing for seed in range(given.first, given.first + given.scenes) for thing in judged(seed)]
    print(cross_validated(things)[0])
    if given.out is not None:
        learned(things).save(given.out, surface_error.NUMBERS)
    sys.exit(0)


if __name__ == "__main__":
    main()
