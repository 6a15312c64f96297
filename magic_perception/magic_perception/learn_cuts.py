"""Learn which upright planes part things of different colours: ``python -m magic_perception.learn_cuts --out cuts.json``.

The scenes are procedural: two and three neighbours of different colours and single things of several (:mod:`magic_perception.neighbours`),
and piles (:mod:`magic_perception.piles`).  Every plane that is looked at in what seams leave together (:mod:`magic_perception.cuts`) is an
example, which parts things where none has more than a tenth of itself on the other side.  The labelled scenes of OSD are left out, and
judge the result.

The figures are of scenes that the weights know nothing of: each fifth of the scenes is judged by weights from the others.  With ``--first``
the scenes of other seeds are segmented whole, by the weights that ship: how many neighbours are so many things, things on each other two,
and single things one; with ``--missing`` 30, 50 or 70 % of their depth is taken away, in blobs of 10 to 80 pixels.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_perception import cuts, logistic, neighbours
from magic_perception.clustered import clustered, surfaces
from magic_perception.looks import Looked, find_table, frame_on, look
from magic_perception.parameters import Parameters
from magic_perception.piles import Pile, pile
from magic_perception.seams import learned
from magic_perception.segmentation import DepthSegmenter, uncut

#: What has so little of a cluster is no thing of it; a plane leaves a thing whole that has so little of itself on one side.
TRACE, WHOLE = 0.05, 0.1
#: What an example of a single thing weighs: in practice there are more of these than of pairs and threes, and parting one is as wrong.
SINGLE = 5.0
#: The region of interest of piles.
PILES = Parameters(region_low=(-0.3, -0.8, -0.05), region_high=(1.3, 0.8, 0.6))


@dataclass(frozen=True)
class Cluster:
    """The planes of a cluster: rows (N, C), two (N,): whether they part things; how many things it is, and of which scene and kind."""

    rows: NDArray[np.float64]
    two: NDArray[np.bool_]
    things: int
    scene: int
    kind: str


def looked_at(made: Pile, parameters: Parameters) -> list[Looked]:
    """The frames of a procedural scene over their table."""
    table, own = find_table(made.frames, parameters)
    return [look(frame, plane, frame_on(table, np.eye(4)), parameters) for frame, plane in zip(made.frames, own, strict=True)]


def clusters_of(made: Pile, parameters: Parameters, scene: int, kind: str) -> list[Cluster]:
    """The clusters of a scene that have planes."""
    looks = looked_at(made, parameters)
    found = clustered(looks, (), parameters)
    instance = uncut(looks, found, surfaces(looks, found), learned(), parameters)
    points, bared = cuts.points_of(looks, found), cuts.bare(looks, found)
    truth = np.concatenate([image[where] for image, where in zip(made.truth, found.spots, strict=True)])
    result = []
    for label in range(int(instance.max(initial=-1)) + 1):
        mine = np.nonzero(instance == label)[0]
        if len(mine) < 2 * cuts.LEAST:
            continue
        things = [thing for thing in np.unique(truth[mine]) if thing > 0 and np.mean(truth[mine] == thing) > TRACE]
        own = points.of(mine)
        seen, rows, two = cuts.seen_of(looks, bared, found.cloud[mine], own), [], []
        for plane in cuts.planes(seen.points):
            row = cuts.measured(seen, plane)
            if row is not None:
                first = plane.distance(own.place) < 0
                shares = [float(np.mean(first[truth[mine] == thing])) for thing in things]
                rows.append(row)
                two.append(len(things) > 1 and not any(WHOLE < s < 1 - WHOLE for s in shares) and min(shares) < 0.5 < max(shares))
        if rows:
            result.append(Cluster(np.array(rows), np.array(two), len(things), scene, kind))
    return result


def fit(found: list[Cluster]) -> logistic.Logistic:
    """The weights that examples ask for."""
    weight = [np.full(len(c.rows), SINGLE if c.kind == "single" else 1.0) for c in found]
    return logistic.fit(np.concatenate([c.rows for c in found]), np.concatenate([c.two for c in found]), np.concatenate(weight))


def cross_validated(found: list[Cluster], folds: int = 5) -> str:
    """How the clusters of each fold are parted by weights from the others."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for fold in range(folds):
        model = fit([c for c in found if c.scene % folds != fold])
        for cluster in (c for c in found if c.scene % folds == fold):
            odds = np.array([-np.inf if cuts.convex(row) else model.odds(row) for row in cluster.rows])
            best = int(odds.argmax())
            said = "kept" if odds[best] <= 0 else "right" if cluster.two[best] else "wrong"
            counts[cluster.kind, "of several things" if cluster.things > 1 else "of one thing", said] += 1
    lines = ["| clusters, held out | kept one | parted rightly | parted wrongly |", "| --- |" + " --- |" * 3]
    for kind, of in sorted({key[:2] for key in counts}):
        lines.append(f"| {kind}, {of} | " + " | ".join(str(counts[kind, of, said]) for said in ("kept", "right", "wrong")) + " |")
    return "\n".join(lines)


def told(made: Pile, segmenter: DepthSegmenter) -> str:
    """What becomes of a scene of neighbours, segmented whole: ``right``; ``merged``: some are one; ``torn``: there are more things than
    are; ``lost``."""
    labels = segmenter.segment(looked_at(made, Parameters()), (), Parameters())
    top = max(int(image.max()) for image in labels)
    votes = np.zeros((made.things, top + 1))
    for image, truth in zip(labels, made.truth, strict=True):
        for thing in range(made.things):
            votes[thing] += np.bincount(image[truth == thing + 1], minlength=top + 1)
    if np.any(votes[:, 1:].max(axis=1, initial=0) < 0.3 * votes.sum(axis=1)):
        return "lost"
    if len(set(votes[:, 1:].argmax(axis=1))) < made.things:
        return "merged"
    return "torn" if top > made.things else "right"


def judged(first: int, rounds: int, missing: bool = False) -> str:
    """Tables of the scenes of some seeds, by the weights that ship; with ``missing`` depth of theirs is."""
    segmenter, counts = DepthSegmenter(), Counter[tuple[str, str]]()
    for seed in range(first, first + rounds):
        for number, (_, gap, _, _) in enumerate(neighbours.PAIRS):
            for what, scene in (
                (f"two, {1000 * gap:.0f} mm apart", neighbours.pair),
                (f"three, {1000 * gap:.0f} mm apart", neighbours.three),
                ("one on the other", neighbours.stacked),
                ("partly hidden", neighbours.behind),
                (neighbours.kind_of(number), neighbours.single),
            ):
                made = scene(seed, number)
                counts[what, told(neighbours.torn(made, number) if missing else made, segmenter)] += 1
    lines = ["| what | right | taken for one | torn | not found |", "| --- |" + " --- |" * 4]
    for what in dict.fromkeys(key[0] for key in counts):
        lines.append(f"| {what} | " + " | ".join(str(counts[what, said]) for said in ("right", "merged", "torn", "lost")) + " |")
    return "\n".join(lines)


def main(args: list[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=2, help="rounds of pairs, threes and single things (default 2)")
    parser.add_argument("--piles", type=int, default=100, help="piles (default 100)")
    parser.add_argument("--out", type=Path, help="file for the weights; without it nothing is written")
    parser.add_argument("--first", type=int, help="learn nothing, but judge scenes from this seed on (those of 0 and 1 are learned from)")
    parser.add_argument("--missing", action="store_true", help="with --first: a part of the depth of the scenes is missing in blobs")
    given = parser.parse_args(args)
    if given.first is not None:
        print(judged(given.first, given.rounds, given.missing))
        sys.exit(0)
    found = []
    for seed in range(given.rounds):
        for number in range(len(neighbours.PAIRS)):
            scene = seed * len(neighbours.PAIRS) + number
            found += clusters_of(neighbours.pair(seed, number), Parameters(), scene, "pair")
            found += clusters_of(neighbours.three(seed, number), Parameters(), scene, "three")
            found += clusters_of(neighbours.single(seed, number), Parameters(), scene, "single")
    for seed in range(given.piles):
        found += clusters_of(pile(seed), PILES, seed, "pile")
    print(cross_validated(found))
    if given.out is not None:
        fit(found).save(given.out, cuts.CRITERIA)
    sys.exit(0)


if __name__ == "__main__":
    main()
