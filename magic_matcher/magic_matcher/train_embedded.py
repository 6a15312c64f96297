"""Fit the weights of the embedded features: ``python3 -m magic_matcher.train_embedded``.

A contact's similarity is exp(-w . d) with distances d from the reference contact.  For
every pair (reference, tool) the contour points of the tool, kept and mirrored, compete
in a softmax of -w . d / T; the loss is the negative log of the share that falls on the
right points.  w >= 0 by softplus; a small L1 pull takes weights that do not matter to
nothing.  Everything is seeded.

The figures are by families: for each family of tools the weights are fitted on all the
others, and the first choice is counted on the family left out (``left out``), beside the
weights by hand and the shipped ones, which are fitted on all families.  The weights
that never saw a family are kept beside the shipped ones: the bench judges with them, on other seeds.
"""

from __future__ import annotations

import argparse
import json
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_matcher import jobs
from magic_matcher.embedded import DISTANCES, EmbeddedFeatures, default_weights
from magic_matcher.global_stage import make_reference

#: By so much (rad) the local stage's normal, taken at a larger scale, may differ from the contour's.
TILT = np.deg2rad(12.0)
#: What a right place is worth that is not in the middle of a region, or not whatever the normal's error.
ENDS = 0.1


@dataclass(frozen=True)
class Pair:
    """One reference and one tool: distances (2, B, D), right (B,) whole regions, middle (B,) the steady places in them."""

    job: str
    reference: str
    family: str
    distances: NDArray[np.float32]
    right: NDArray[np.bool_]
    middle: NDArray[np.bool_]


def pairs(per_family: int, seed: int, references: int = 8) -> list[Pair]:
    """Seeded pairs over all jobs and families; the references are the job's own and, half of the time, any other family.

    Every other tool is seen as a camera's segmentation has it (:func:`jobs.roughen`).
    """
    random = np.random.default_rng(seed)
    backend = EmbeddedFeatures(default_weights())
    result = []
    for job in jobs.JOBS.values():
        for family in job.regions:
            made = 0
            for k in range(3 * per_family):
                if made == per_family:
                    break
                own = random.random() < 0.7
                source = str(random.choice(sorted(job.references if own else job.regions)))
                first = jobs.example(job.name, source, int(random.integers(1000, 1000 + references)), bool(random.random() < 0.3))
                names = first.names()
                if not names:
                    continue
                contact = first.contact(job.references[source] if own else str(random.choice(names)))
                tool = jobs.example(job.name, family, 2000 + 50 * seed + k, k % 2 == 1)
                old, new = random.uniform(*job.targets, size=2)
                old_px = old / first.view.metres_per_pixel
                if not first.works(contact.pixel[None], contact.normal[None], old_px).all():
                    continue
                reference = make_reference(first.view, contact.pixel, contact.normal, old_px, first.contour)
                radius = new / tool.view.metres_per_pixel
                found, parts = backend.dissimilarities(backend.prepare(reference), tool.contour, radius)
                right = tool.works(found.points, found.normals, radius)
                if job.needs == "region":
                    middle = right & tool.near(found.points, found.normals, 3.0, share=0.5)
                else:
                    # Where the disc need not slide first, nor would if the normal were read a little otherwise.
                    held = tool.held(found.points, found.normals, radius)
                    middle = right & (held.drift <= 0.5 * jobs.DRIFT)
                    for angle in (-TILT, TILT):
                        c, s = np.cos(angle), np.sin(angle)
                        middle &= tool.works(found.points, found.normals @ np.array([[c, s], [-s, c]]), radius)
                if right.any():
                    made += 1
                    result.append(Pair(job.name, source, family, parts.astype(np.float32), right, middle if middle.any() else right))
    return result


def hits(data: list[Pair], weights: NDArray[np.float64]) -> dict[tuple[str, str], float]:
    """Share of pairs whose best point is right, by job and tool family."""
    table: dict[tuple[str, str], list[bool]] = {}
    for pair in data:
        best = int(np.argmin((pair.distances @ weights).min(axis=0)))
        table.setdefault((pair.job, pair.family), []).append(bool(pair.right[best]))
    return {key: float(np.mean(value)) for key, value in table.items()}


def fit(data: list[Pair], steps: int, pull: float = 1e-3, temperature: float = 0.25, seed: int = 0) -> NDArray[np.float64]:
    """Weights (len(DISTANCES),); jobs and, within a job, families count alike."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(2)
    groups: dict[tuple[str, str], int] = {}
    for pair in data:
        groups[pair.job, pair.family] = groups.get((pair.job, pair.family), 0) + 1
    families = {job: sum(1 for j, _ in groups if j == job) for job, _ in groups}
    share = torch.tensor([1.0 / (groups[p.job, p.family] * families[p.job]) for p in data])
    share /= share.sum()
    # Some of the points: neighbours are nearly the same.
    kept = [np.nonzero(np.arange(len(p.right)) % np.where(p.right, 3, 5) == 0)[0] for p in data]
    kept = [k if p.right[k].any() else np.append(k, np.argmax(p.right)) for k, p in zip(kept, data, strict=True)]
    longest = max(len(k) for k in kept)
    distances = torch.full((len(data), 2, longest, len(DISTANCES)), 50.0)
    good = torch.full((len(data), longest), -torch.inf)
    for k, pair in enumerate(data):
        distances[k, :, : len(kept[k])] = torch.from_numpy(pair.distances[:, kept[k]])
        worth = np.where(pair.middle, 0.0, np.where(pair.right, np.log(ENDS), -np.inf)).astype(np.float32)
        good[k, : len(kept[k])] = torch.from_numpy(worth[kept[k]])
    raw = torch.from_numpy(np.log(np.expm1(np.maximum(default_weights(), 1e-3)))).float().requires_grad_(True)
    optimiser = torch.optim.Adam([raw], lr=0.06)
    for _ in range(steps):
        optimiser.zero_grad()
        weights = torch.nn.functional.softplus(raw)
        score = torch.logsumexp(-(distances @ weights) / temperature, dim=1)
        loss = pull * weights.sum() + (share * (torch.logsumexp(score, 1) - torch.logsumexp(score + good, 1))).sum()
        loss.backward()
        optimiser.step()
    return torch.nn.functional.softplus(raw).detach().numpy().astype(float)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("embedded_weights.json"))
    parser.add_argument(
        "--left-out",
        type=Path,
        default=Path(__file__).with_name("embedded_left_out.json"),
        help="where the weights go that never saw one family",
    )
    parser.add_argument("--per-family", type=int, default=20)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-left-out", action="store_true", help="only fit the shipped weights")
    parser.add_argument("--pairs", type=Path, help="keep the pairs in this file, or take them from it where it is there")
    given = parser.parse_args()
    if given.pairs and given.pairs.is_file():
        data = pickle.loads(given.pairs.read_bytes())
    else:
        data = pairs(given.per_family, given.seed)
        if given.pairs:
            given.pairs.write_bytes(pickle.dumps(data))
    print(f"{len(data)} pairs", flush=True)

    def record(weights: NDArray[np.float64]) -> dict[str, float]:
        return {name: round(float(w), 4) for name, w in zip(DISTANCES, weights, strict=True)}

    by_hand = hits(data, default_weights())
    weights = fit(data, given.steps, seed=given.seed)
    everything = hits(data, weights)
    about = {"seed": given.seed, "pairs": len(data), "steps": given.steps}
    given.out.write_text(json.dumps({**about, "weights": record(weights)}, indent=1) + "\n")
    left_out: dict[tuple[str, str], float] = {}
    if not given.no_left_out:
        kept = {}
        for family in sorted({p.family for p in data}):
            part = fit([p for p in data if family not in (p.family, p.reference)], given.steps, seed=given.seed)
            kept[family] = record(part)
            left_out.update(hits([p for p in data if p.family == family], part))
        given.left_out.write_text(json.dumps({**about, "weights": kept}) + "\n")
    print("| job | tool | by hand | left out | fitted |\n| --- | --- | --- | --- | --- |")
    for job, family in sorted(by_hand):
        print(
            f"| {job} | {family} | "
            + " | ".join(f"{100 * t.get((job, family), float('nan')):.0f}" for t in (by_hand, left_out, everything))
            + " |"
        )
    print("| mean | | " + " | ".join(f"{100 * np.mean(list(t.values()) or [np.nan]):.1f}" for t in (by_hand, left_out, everything)) + " |")


if __name__ == "__main__":
    main()
