"""Learn which seams part things: ``ros2 run magic_perception learn_seams --data FOLDER --out seams.json``.

The scenes are the labelled ones of OSD (FOLDER/rgbd/osd) and procedural piles (:mod:`magic_perception.piles`).  Every cluster is cut at all
concave seams, and joined again by the truth; the criteria of each seam on the way (:mod:`magic_perception.seams`) are an example.  The
chance of two things is a logistic function of them, fitted with a ridge penalty.

The figures are of scenes that the weights know nothing of: the labelled scenes are cut into blocks of neighbouring numbers, since
neighbours show the same things, and each block is segmented whole with weights from all others and one part of the piles; the other piles
are judged by them as well. ``--out`` then gets the weights from everything.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_perception import convexity, evaluate, logistic, measures, seams
from magic_perception.clustered import clustered, surfaces
from magic_perception.looks import Looked, find_table, frame_on, look
from magic_perception.parameters import Parameters
from magic_perception.piles import pile
from magic_perception.segmentation import DepthSegmenter

#: A part is a thing's where so much of it is; less tells nothing.
PURE = 0.8
#: What an example of a labelled scene weighs; those of piles weigh 1, of which there are twenty times as many.
REAL = 10.0


@dataclass(frozen=True)
class Cluster:
    """One cluster, cut at every concave seam: its voxels, the part of each (V,) and the number of the thing it is of, 0 where none is."""

    voxels: seams.Voxels
    part: NDArray[np.int64]
    truth: NDArray[np.int64]


@dataclass(frozen=True)
class Examples:
    """rows (N, C): the criteria of seams; two (N,): whether they part things; weight (N,)."""

    rows: NDArray[np.float64]
    two: NDArray[np.bool_]
    weight: NDArray[np.float64]


def clusters_of(looks: list[Looked], truth: list[NDArray[np.integer]], parameters: Parameters) -> list[Cluster]:
    """The clusters of a scene that may be more than one thing; truth (H, W): for each look the number of the thing at each pixel, 0 and
    below for none."""
    found = clustered(looks, (), parameters)
    seen = surfaces(looks, found)
    things = np.concatenate([image[where] for image, where in zip(truth, found.spots, strict=True)]).clip(0)
    result = []
    for mine in seen.tall:
        sound = mine[np.isfinite(seen.normal[mine, 0]) & np.isfinite(seen.heights[mine])]
        if len(sound) < 200:
            continue
        made = convexity.voxels_of(found.cloud[sound], seen.normal[sound], seen.heights[sound], seen.rgb[sound] / 255)
        if made is None:
            continue
        voxels, index = made
        values, local = np.unique(things[sound], return_inverse=True)
        votes = np.zeros((len(voxels.centre), len(values)))
        np.add.at(votes, (index, local), 1)
        result.append(Cluster(voxels, convexity.pieces(voxels), values[votes.argmax(axis=1)]))
    return result


def _owner(truth: NDArray[np.int64]) -> int:
    """The thing that voxels belong to; 0 where that is not clear."""
    some = truth[truth > 0]
    if len(some) < 0.5 * len(truth):
        return 0
    count = np.bincount(some)
    return int(count.argmax()) if count.max() >= PURE * len(some) else 0


def examples(clusters: Iterable[Cluster], weight: float) -> Examples:
    """The seams met while the parts of clusters are joined by the truth, the smoothest first."""
    rows, two = [], []
    for cluster in clusters:

        def judge(
            row: NDArray[np.float64], first: NDArray[np.int64], second: NDArray[np.int64], truth: NDArray[np.int64] = cluster.truth
        ) -> float:
            a, b = _owner(truth[first]), _owner(truth[second])
            if a == 0 or b == 0:
                return 1.0
            rows.append(row)
            two.append(a != b)
            return 1.0 if a != b else row[2] - 2.0

        seams.joined(cluster.voxels, cluster.part, judge)
    return Examples(np.array(rows).reshape(-1, len(seams.CRITERIA)), np.array(two, bool), np.full(len(rows), weight))


def together(sets: list[Examples]) -> Examples:
    """Examples of several sets."""
    return Examples(*(np.concatenate([getattr(s, name) for s in sets]) for name in ("rows", "two", "weight")))


def fit(given: Examples) -> logistic.Logistic:
    """The weights that examples ask for."""
    return logistic.fit(given.rows, given.two, given.weight)


def main(args: list[str] | None = None) -> None:
    """Entry point; exit status 1 where there are no labelled scenes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with rgbd/osd")
    parser.add_argument("--piles", type=int, default=160, help="procedural scenes (default 160)")
    parser.add_argument("--folds", type=int, default=5, help="blocks of the labelled scenes (default 5)")
    parser.add_argument("--out", type=Path, help="file for the weights; without it nothing is written")
    given = parser.parse_args(args)
    folder = given.data / "rgbd/osd"
    if not folder.is_dir():
        print(f"learn_seams: no folder {folder}", file=sys.stderr)
        sys.exit(1)
    scenes = [_real(name, evaluate.looked_at(frame, evaluate.OSD_PARAMETERS), truth) for name, frame, truth in evaluate.osd_scenes(folder)]
    scenes.sort(key=lambda scene: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", scene.name)])
    piles = [_procedural(seed) for seed in range(given.piles)]
    report = cross_validated(scenes, piles, given.folds)
    print(report)
    if given.out is not None:
        final = fit(together([s.examples for s in scenes] + [p.examples for p in piles]))
        final.save(given.out, seams.CRITERIA)
    sys.exit(0)


@dataclass(frozen=True)
class _Scene:
    """A labelled scene, or a pile (without looks, which take much memory)."""

    name: str
    looks: list[Looked]
    truth: NDArray[np.integer]
    clusters: list[Cluster]
    examples: Examples
    things: int


def _real(name: str, looked: Looked, truth: NDArray[np.integer]) -> _Scene:
    found = clusters_of([looked], [truth], evaluate.OSD_PARAMETERS)
    return _Scene(name, [looked], truth, found, examples(found, REAL), len(np.unique(truth[truth > 0])))


def _procedural(seed: int) -> _Scene:
    made = pile(seed)
    parameters = Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.3, 0.8, 0.6))
    table, own = find_table(made.frames, parameters)
    looks = [look(frame, plane, frame_on(table, np.eye(4)), parameters) for frame, plane in zip(made.frames, own, strict=True)]
    found = clusters_of(looks, list(made.truth), parameters)
    return _Scene(f"pile {seed}", [], np.zeros((0, 0)), found, examples(found, 1.0), made.things)


def cross_validated(scenes: list[_Scene], piles: list[_Scene], folds: int) -> str:
    """A table of what weights do on scenes that they were not fitted to."""
    blocks = np.array_split(np.arange(len(scenes)), folds)
    rows, lines = [], ["| held out | best IoU | overlap P | R | F | boundary P | R | F | F@.75 |", "| --- |" + " --- |" * 8]
    ious: list[float] = []
    seam_right, seam_all, one, ones = 0, 0, 0, 0
    pile_scores = []
    for number, block in enumerate(blocks):
        away = [p for k, p in enumerate(piles) if k % folds != number]
        weights = fit(together([s.examples for k, s in enumerate(scenes) if k not in block] + [p.examples for p in away]))
        segmenter = DepthSegmenter(seams.judge_by(weights))
        mine = []
        for scene in (scenes[k] for k in block):
            labels = segmenter.segment(scene.looks, (), evaluate.OSD_PARAMETERS)[0]
            mine.append(measures.measure(labels, scene.truth))
            ious += measures.best_ious(labels, scene.truth).tolist()
        lines.append(_line(f"{scenes[block[0]].name} to {scenes[block[-1]].name}", measures.mean(mine)))
        rows += mine
        for scene in (p for k, p in enumerate(piles) if k % folds == number):
            told = np.array([weights.odds(row) > 0 for row in scene.examples.rows], bool)
            seam_right, seam_all = seam_right + int((told == scene.examples.two).sum()), seam_all + len(told)
            for cluster in scene.clusters:
                part = seams.joined(cluster.voxels, cluster.part, seams.judge_by(weights))
                if scene.things == 1:
                    one, ones = one + int(part.max() == 0), ones + 1
                pile_scores.append(measures.measure(part[None] + 1, cluster.truth[None]).overlap_f)
    lines.append(_line("all", measures.mean(rows)))
    lines.append("")
    lines.append(
        f"Mean best IoU of all {len(ious)} objects: {np.mean(ious):.3f}.  Piles held out: {seam_right} of {seam_all} seams told right, "
        f"{one} of {ones} single things one, overlap F of the voxels {np.mean(pile_scores):.3f}."
    )
    return "\n".join(lines)


def _line(name: str, m: measures.Measures) -> str:
    values = asdict(m)
    return f"| {name} | {values.pop('iou'):.3f} | " + " | ".join(f"{100 * v:.1f}" for v in values.values()) + " |"


if __name__ == "__main__":
    main()
