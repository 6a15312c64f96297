"""Fit the weights of the embedded features: ``python3 -m magic_matcher.train_embedded``.

A contact's similarity is exp(-w . d) with distances d from the reference contact.  For
every training pair (reference, tool) the contour points of the tool compete in a softmax
of -w . d / T; the loss is the negative log of the share that falls on the right points.
w >= 0 by softplus; a small L1 pull keeps weights that do not matter at nothing.  Everything
is seeded; the families used are ``jobs.TRAINING``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_matcher import jobs
from magic_matcher.embedded import DISTANCES, EmbeddedFeatures, default_weights
from magic_matcher.features import make_reference

Pair = tuple[NDArray[np.float32], NDArray[np.bool_]]


def pairs(families: tuple[str, ...], per_family: int, seed: int, references: int = 6, any_reference: bool = False) -> list[tuple[str, str, str, Pair]]:
    """(job, reference family, tool family, (distances (2, B, D), right (B,))) over seeded shapes and target sizes."""
    random = np.random.default_rng(seed)
    backend = EmbeddedFeatures(default_weights())
    result = []
    for job in jobs.JOBS.values():
        tools = [f for f in job.regions if f in families]
        for family in tools:
            for k in range(per_family):
                starts = dict(job.references)
                if any_reference:
                    starts.update({f: "" for f in tools})
                source = str(random.choice(sorted(starts)))
                first = jobs.example(job.name, source, int(random.integers(1000, 1000 + references)))
                names = first.names()
                if not names:
                    continue
                name = starts[source] or str(random.choice(names))
                contact = first.contact(name)
                tool = jobs.example(job.name, family, int(2000 + 50 * seed + k))
                old, new = random.uniform(*job.targets, size=2)
                old_px = old / first.view.metres_per_pixel
                if not first.admits(contact.pixel[None], contact.normal[None], old_px).all():
                    continue
                reference = make_reference(first.view, contact.pixel, contact.normal, old_px, first.contour)
                radius = new / tool.view.metres_per_pixel
                found, parts = backend.dissimilarities(backend.prepare(reference), tool.contour, radius)
                right = tool.near(found.points, found.normals, 3.0)
                right[right] = tool.admits(found.points[right], found.normals[right], radius)
                if right.any():
                    result.append((job.name, source, family, (parts.astype(np.float32), right)))
    return result


def hits(data: list[tuple[str, str, str, Pair]], weights: NDArray[np.float64]) -> dict[tuple[str, str], float]:
    """Share of pairs whose best point is right, by job and tool family."""
    table: dict[tuple[str, str], list[bool]] = {}
    for job, _, family, (parts, right) in data:
        best = int(np.argmin((parts @ weights).min(axis=0)))
        table.setdefault((job, family), []).append(bool(right[best]))
    return {key: float(np.mean(value)) for key, value in table.items()}


def fit(data: list[tuple[str, str, str, Pair]], steps: int = 400, pull: float = 2e-3, temperature: float = 0.25, seed: int = 0) -> NDArray[np.float64]:
    """Weights (len(DISTANCES),) that put the share of the softmax on the right points; jobs and families count alike."""
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(2)
    counts: dict[tuple[str, str], int] = {}
    for job, _, family, _ in data:
        counts[job, family] = counts.get((job, family), 0) + 1
    jobs_of = {job: len({f for j, f in counts if j == job}) for job, _ in counts}
    tensors = [
        (torch.from_numpy(parts), torch.from_numpy(right), 1.0 / (counts[job, family] * jobs_of[job]))
        for job, _, family, (parts, right) in data
    ]
    total = sum(t[2] for t in tensors)
    raw = torch.from_numpy(np.log(np.expm1(np.maximum(default_weights(), 1e-3)))).float().requires_grad_(True)
    optimiser = torch.optim.Adam([raw], lr=0.05)
    for step in range(steps):
        optimiser.zero_grad()
        weights = torch.nn.functional.softplus(raw)
        loss = pull * weights.sum()
        for parts, right, share in tensors:
            score = -(parts @ weights) / temperature
            score = torch.logsumexp(score, dim=0)
            loss = loss + share / total * (torch.logsumexp(score, 0) - torch.logsumexp(score[right], 0))
        loss.backward()
        optimiser.step()
        if step % 50 == 0:
            print(f"step {step}: loss {float(loss):.4f}", flush=True)
    return torch.nn.functional.softplus(raw).detach().numpy().astype(float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("embedded_weights.json"))
    parser.add_argument("--per-family", type=int, default=30)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    data = pairs(jobs.TRAINING, given.per_family, given.seed, any_reference=True)
    others = tuple({f for job in jobs.JOBS.values() for f in job.regions} - set(jobs.TRAINING))
    test = pairs(others, 12, given.seed + 1)
    print(f"{len(data)} training pairs, {len(test)} test pairs")
    for label, weights in (("by hand", default_weights()), ("fitted", fit(data, given.steps, seed=given.seed))):
        for part, items in (("training", data), ("test", test)):
            table = hits(items, weights)
            print(label, part, {f"{job}/{family}": round(v, 2) for (job, family), v in sorted(table.items())}, f"mean {np.mean(list(table.values())):.3f}")
    table = {name: round(float(w), 4) for name, w in zip(DISTANCES, weights, strict=True)}
    given.out.write_text(json.dumps({"families": jobs.TRAINING, "seed": given.seed, "per_family": given.per_family, "steps": given.steps, "weights": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
