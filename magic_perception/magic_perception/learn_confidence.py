"""Learn how far a reconstruction is to be trusted: ``ros2 run magic_perception learn_confidence --out confidence.json``.

Procedural scenes (:mod:`magic_perception.piles`) are perceived, with one camera, with two, and with two of which one is off by up to 10 mm.
A found thing is right where its masks and its solid overlap those of the true thing that it shares most pixels with by more than 0.8 (mean
over the cameras that see it; by volume).  The chance of that is a logistic function of what speaks for and against the solid
(:mod:`magic_perception.confidence`).  The table is of scenes that the weights know nothing of (five folds by scene); ``--out`` then gets
the weights from everything.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import MagicError
from magic_perception import logistic
from magic_perception.confidence import NUMBERS, SIGNS
from magic_perception.evaluate import overlap, shared_volume
from magic_perception.parameters import Parameters
from magic_perception.piles import Pile, pile
from magic_perception.pipeline import Report, perceive

#: Overlap of masks and of volumes from which a thing is right.
RIGHT = 0.8
#: Penalty of the fit: of 1, 2, 3 and 5 that with the best likelihood of what was held out (seeds from 300000 on).
RIDGE = 2.0
#: How often a scene is one thing alone.
ALONE = 0.75
#: Bounds of the bins of the table.
BINS = (0.0, 0.2, 0.5, 0.8, 1.0)


@dataclass(frozen=True)
class Judged:
    """A found thing: its scene, how its solid came about, what its confidence is computed from (C,), and its overlaps with the truth
    (0..1)."""

    scene: int
    shape: str
    row: NDArray[np.float64]
    mask_iou: float
    volume_iou: float

    @property
    def right(self) -> bool:
        """Whether both overlaps are large enough."""
        return min(self.mask_iou, self.volume_iou) > RIGHT


def judged(seed: int) -> list[Judged]:
    """The things found in the scene of a seed; every third of those with two cameras has one off by up to 10 mm."""
    made = pile(seed, ALONE)
    frames = shifted(made.frames, seed)
    report = Report()
    try:
        scene = perceive(frames, parameters=Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.3, 0.8, 0.6)), report=report)
    except MagicError:
        return []
    numbers = sorted({int(n) for image in report.labels for n in np.unique(image) if n > 0})
    result = []
    for item, number in zip(scene.objects, numbers, strict=True):
        masks = [image == number for image in report.labels]
        thing = shared_most(masks, made)
        if thing == 0:
            volume, mask = 0.0, 0.0
        else:
            mask = float(np.mean([overlap(m, t == thing) for m, t in zip(masks, made.truth, strict=True) if (t == thing).any()]))
            # A mask that is amiss is wrong whatever the volume.
            volume = (
                (shared_volume(made.meshes[thing - 1], item.mesh.transformed(item.world_from_object), 20000) or 0.0) if mask > 0.5 else 0.0
            )
        result.append(Judged(seed, report.shapes[item.id], report.evidence[item.id].row(), mask, volume))
    return result


def shifted(frames: list[RgbdFrame], seed: int) -> list[RgbdFrame]:
    """Frames of a scene, the second camera of every third of those with two off by 2 to 10 mm."""
    random = np.random.default_rng([seed, 7])
    frames = list(frames)
    if len(frames) > 1 and random.random() < 1 / 3:
        shift = random.normal(size=3)
        shift *= random.uniform(0.002, 0.010) / np.linalg.norm(shift)
        frames[1] = replace(frames[1], world_from_camera=transforms.make(None, shift) @ frames[1].world_from_camera)
    return frames


def shared_most(masks: list[NDArray[np.bool_]], made: Pile) -> int:
    """The true thing with most pixels in the masks; 0 for the table."""
    count = sum(np.bincount(truth[mask].clip(0), minlength=made.things + 1) for mask, truth in zip(masks, made.truth, strict=True))
    return int(np.argmax(count))


def cross_validated(things: list[Judged], folds: int = 5) -> str:
    """How often things of a confidence are right, by weights that know nothing of their scene."""
    rows, right = np.stack([t.row for t in things]), np.array([t.right for t in things])
    fold = np.array([t.scene for t in things]) % folds
    chance = np.zeros(len(things))
    for number in range(folds):
        model = logistic.fit(rows[fold != number], right[fold != number], ridge=RIDGE, signs=SIGNS)
        chance[fold == number] = [model.chance(row) for row in rows[fold == number]]
    lines = ["| confidence, held out | things | right | share | mean confidence |", "| --- | --- | --- | --- | --- |"]
    for low, high in itertools.pairwise(BINS):
        here = (chance > low) & (chance <= high)
        if here.any():
            lines.append(f"| {low} to {high} | {here.sum()} | {right[here].sum()} | {right[here].mean():.2f} | {chance[here].mean():.2f} |")
    brier = float(np.mean((chance - right) ** 2))
    lines += [
        "",
        f"{right.sum()} of {len(things)} things in {len({t.scene for t in things})} scenes right; Brier score {brier:.3f}.",
        "",
    ]
    lines += ["| shape | things | right | mask IoU, mean | volumetric IoU, mean |", "| --- | --- | --- | --- | --- |"]
    for shape in sorted({t.shape for t in things}):
        mine = [t for t in things if t.shape == shape]
        lines.append(
            f"| {shape} | {len(mine)} | {sum(t.right for t in mine)} | {np.mean([t.mask_iou for t in mine]):.2f} | {np.mean([t.volume_iou for t in mine]):.2f} |"
        )
    return "\n".join(lines)


def main(args: list[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=160, help="procedural scenes (default 160)")
    parser.add_argument(
        "--first", type=int, default=100000, help="seed of the first; far from those that learn_seams knows (default 100000)"
    )
    parser.add_argument("--out", type=Path, help="file for the weights; without it nothing is written")
    given = parser.parse_args(args)
    things = [thing for seed in range(given.first, given.first + given.scenes) for thing in judged(seed)]
    print(cross_validated(things))
    if given.out is not None:
        logistic.fit(np.stack([t.row for t in things]), np.array([t.right for t in things]), ridge=RIDGE, signs=SIGNS).save(
            given.out, NUMBERS
        )
    sys.exit(0)


if __name__ == "__main__":
    main()
