"""Hit rates of the matcher on labelled procedural shapes: ``ros2 run magic_matcher bench``.

For each job, reference family and tool family: the share of tools on which the first
candidate, and one of the first three, lies on a region that does the job (within a
fiftieth of the tool's size, normals agreeing within 60 degrees).  ``--ablation
no_two_step`` leaves out the second curvature estimate and the convexity search.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magic_matcher import features, jobs, matching
from magic_matcher.features import make_reference


@dataclass(frozen=True)
class Row:
    """One category pair: how many matches, hit rates of the first and of the first three, median seconds a match."""

    job: str
    reference: str
    tool: str
    count: int
    first: float
    third: float
    seconds: float


def run(matcher: matching.Matcher, count: int = 20, seed: int = 0, only: str = "", references: int = 3, tools: tuple[str, ...] = ()) -> list[Row]:
    """Match ``count`` seeded tools of every family with each job's references; targets of drawn sizes."""
    rows = []
    for job in jobs.JOBS.values():
        if only and job.name != only:
            continue
        for source, region in job.references.items():
            for family in job.regions:
                if tools and family not in tools:
                    continue
                random = np.random.default_rng([seed, *family.encode()])
                first, third, seconds = [], [], []
                for k in range(count):
                    shown = jobs.example(job.name, source, 5000 + int(random.integers(references)))
                    tool = jobs.example(job.name, family, 7000 + 100 * seed + k)
                    old, new = random.uniform(*job.targets, size=2)
                    contact = shown.contact(region)
                    if not jobs.usable(tool, new / tool.view.metres_per_pixel):
                        continue
                    reference = make_reference(shown.view, contact.pixel, contact.normal, old / shown.view.metres_per_pixel, shown.contour)
                    target = jobs.disc_target(new, job.view)
                    start = time.perf_counter()
                    result = matcher.match_views(reference, contact, [matching.Tool(family, tool.view)], target, 3, False, old)
                    seconds.append(time.perf_counter() - start)
                    points = np.array([c.tool.pixel for c in result.candidates])
                    normals = np.array([c.tool.normal for c in result.candidates])
                    right = tool.near(points, normals, tool.contour.size / 50)
                    first.append(bool(right[0]))
                    third.append(bool(right[:3].any()))
                if first:
                    rows.append(Row(job.name, source, family, len(first), float(np.mean(first)), float(np.mean(third)), float(np.median(seconds))))
    return rows


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table, with the means over the rows."""
    lines = ["| job | reference | tool | n | first | first three | s |", "| --- | --- | --- | --- | --- | --- | --- |"]
    lines += [f"| {r.job} | {r.reference} | {r.tool} | {r.count} | {100 * r.first:.0f} | {100 * r.third:.0f} | {r.seconds:.3f} |" for r in rows]
    for label, chosen in (("families fitted on", [r for r in rows if r.tool in jobs.TRAINING]), ("other families", [r for r in rows if r.tool not in jobs.TRAINING])):
        if chosen:
            lines.append(
                f"| mean | | {label} | {sum(r.count for r in chosen)} | {100 * np.mean([r.first for r in chosen]):.1f} "
                f"| {100 * np.mean([r.third for r in chosen]):.1f} | {np.median([r.seconds for r in chosen]):.3f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--features", default="embedded", choices=features.BACKENDS)
    parser.add_argument("--weights", default="", help="weights of dinov2")
    parser.add_argument("--count", type=int, default=20, help="tools of each family (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", default="", choices=("", *jobs.JOBS))
    parser.add_argument("--ablation", default="none", choices=("none", "no_two_step", "no_curvature"))
    parser.add_argument("--out", type=Path, help="also write the rows as JSON")
    given = parser.parse_args()
    matcher = matching.Matcher(
        features.load(given.features, given.weights), 0.0 if given.ablation == "no_curvature" else matching.score.LAMBDA, two_step=given.ablation != "no_two_step"
    )
    rows = run(matcher, given.count, given.seed, given.job)
    print(table(rows))
    if given.out:
        given.out.write_text(json.dumps([vars(r) for r in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
