"""Hit rates of the matcher on labelled procedural shapes: ``ros2 run magic_matcher bench --out DIR``.

For each job, reference family and tool family: the share of tools on which the first
candidate, and one of the first three, would do the job with a target of the drawn size
(:meth:`magic_matcher.jobs.Example.works`); ``marked`` counts the first candidates that
lie on a region which the generator marked.  Tools that cannot do the job are not
counted.  Every other tool is seen as a camera's segmentation has it.

Nothing that was fitted has seen what it is judged on: other seeds for references and
tools, and for each family of tools the weights whose fit never saw that family, neither as
tool nor as reference.  The variants leave out what Table III of the paper leaves out:

* ``full``: both stages, with the weights that never saw the tool's family;
* ``no two-step``: without the second curvature estimate and the convexity search;
* ``no curvature``: s_curv left out of the score (lambda = 0);
* ``global only``: the features' own places, without the local stage;
* ``no patch, no PCA``: DINOv2 only, single tokens of the network as they come;
* ``shipped``: embedded only, both stages with the weights that ship, fitted on all families.

Writes ``bench.json``, ``bench.md`` and the contact sheet ``bench.png`` (a row for each
pair of families; frames green: first, yellow: among the first three, red: missed).
``--speed`` measures speed and memory instead.  ``--controls`` counts how many things that can do none of the jobs are refused
(:mod:`magic_matcher.plain`: families on which the floor of the score was fitted, and others), and tools that are too small for
the drawn target; writes ``controls.json`` and ``controls.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.contact import Contact
from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView
from magic_matcher import contour as contours
from magic_matcher import drawing, embedded, features, jobs, matching, plain, score, speed
from magic_matcher.contour import Contour
from magic_matcher.global_stage import Reference, make_reference

#: First seeds of references and of tools; the fit uses 1000 to 1999 and 2000 to 4999.
REFERENCES, TOOLS = 5000, 7000
TILE = 144


@dataclass(frozen=True)
class Case:
    """One match to make: who shows whom what, radii (m) of the reference's target and of the new one."""

    job: str
    source: str
    family: str
    contact: Contact
    shown: jobs.Example
    tool: jobs.Example
    old: float
    new: float

    def reference(self) -> Reference:
        """The reference contact with its target's size."""
        return make_reference(
            self.shown.view, self.contact.pixel, self.contact.normal, self.old / self.shown.view.metres_per_pixel, self.shown.contour
        )


@dataclass(frozen=True)
class Row:
    """One variant and category pair: number of matches, shares of first and first three that would work, of first choices on
    a marked region, median CPU seconds a match."""

    variant: str
    job: str
    reference: str
    tool: str
    count: int
    first: float
    third: float
    marked: float
    seconds: float


class _Remembering(embedded.EmbeddedFeatures):
    """Embedded features that describe a tool once for all variants."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.memory: dict[Any, Any] = {}

    def dissimilarities(self, prepared: embedded.Prepared, contour: Contour, target_radius: float | None) -> Any:
        key = (prepared.description.wide.tobytes(), prepared.description.probe.tobytes(), contour.points.tobytes(), target_radius)
        if key not in self.memory:
            self.memory.clear()
            self.memory[key] = super().dissimilarities(prepared, contour, target_radius)
        return self.memory[key]


def cases(count: int, seed: int = 0, only: str = "", tools: tuple[str, ...] = (), references: int = 3) -> Iterator[Case]:
    """Up to ``count`` seeded matches a pair of families, of which a tool can do the job."""
    for job in jobs.JOBS.values():
        if only and job.name != only:
            continue
        for source, region in job.references.items():
            for family in job.regions:
                if tools and family not in tools:
                    continue
                random = np.random.default_rng([seed, *family.encode()])
                made = 0
                for k in range(3 * count):
                    if made == count:
                        break
                    shown = jobs.example(job.name, source, REFERENCES + 10 * seed + int(random.integers(references)))
                    tool = jobs.example(job.name, family, TOOLS + 100 * seed + k, k % 2 == 1)
                    old, new = random.uniform(*job.targets, size=2)
                    contact = shown.contact(region)
                    if not jobs.usable(tool, new / tool.view.metres_per_pixel):
                        continue
                    if not shown.works(contact.pixel[None], contact.normal[None], old / shown.view.metres_per_pixel).all():
                        continue
                    made += 1
                    yield Case(job.name, source, family, contact, shown, tool, old, new)


def variants(name: str, weights: str, family: str) -> dict[str, matching.Matcher | None]:
    """Matchers by variant for tools of a family; ``None``: the global stage alone, of ``full``."""
    if name == "dinov2":
        full = features.load("dinov2", weights)
        single = features.load("dinov2", weights, aggregation="none", components=None)
        return {
            "full": matching.Matcher(full),
            "no patch, no PCA": matching.Matcher(single),
            "no two-step": matching.Matcher(full, two_step=False),
            "no curvature": matching.Matcher(full, 0.0),
            "global only": None,
        }
    held_out = _Remembering(embedded.weights(family))
    return {
        "full": matching.Matcher(held_out),
        "no two-step": matching.Matcher(held_out, two_step=False),
        "no curvature": matching.Matcher(held_out, 0.0),
        "global only": None,
        "shipped": matching.Matcher(_Remembering()),
    }


def judge(case: Case, points: NDArray[np.float64], normals: NDArray[np.float64]) -> tuple[NDArray[np.bool_], bool]:
    """Which contacts (K, 2) would work, and whether the first lies on a marked region."""
    works = case.tool.works(points, normals, case.new / case.tool.view.metres_per_pixel)
    return works, bool(case.tool.near(points[:1], normals[:1], case.tool.contour.size / 50)[0])


def contacts(
    case: Case, matcher: matching.Matcher | None, full: matching.Matcher
) -> tuple[NDArray[np.float64], NDArray[np.float64], matching.MatchResult | None]:
    """Pixels and normals (K, 2) of the first three candidates, best first."""
    reference = case.reference()
    if matcher is None:
        radius = case.new / case.tool.view.metres_per_pixel
        found = full.backend.propose(full.prepare(reference), case.tool.view, case.tool.contour, radius, 3).proposals
        index = [case.tool.contour.nearest(p.pixel) for p in found]
        return np.array([p.pixel for p in found]), case.tool.contour.normals[index], None
    target = jobs.disc_target(case.new, jobs.JOBS[case.job].view)
    result = matcher.match_views(reference, case.contact, [matching.Tool(case.family, case.tool.view)], target, 3, False, case.old)
    return np.array([c.tool.pixel for c in result.candidates]), np.array([c.tool.normal for c in result.candidates]), result


def tile(case: Case, result: matching.MatchResult, works: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A small picture (TILE, TILE, 3): the candidates, the target at the first, a frame in the verdict's colour."""
    picture = drawing.draw_match(case.tool.view, [c.tool for c in result.candidates])
    best, radius = result.candidates[0].tool, case.new / case.tool.view.metres_per_pixel
    centre = best.pixel + radius * best.normal
    cv2.circle(picture, tuple(int(round(v)) for v in centre), int(round(radius)), (90, 255, 90), 2, cv2.LINE_AA)
    colour = (60, 200, 60) if works[0] else (235, 190, 40) if works.any() else (230, 50, 50)
    small = cv2.resize(picture, (TILE, TILE), interpolation=cv2.INTER_AREA)
    cv2.rectangle(small, (0, 0), (TILE - 1, TILE - 1), colour, 3)
    return small


def run(
    name: str = "embedded", weights: str = "", count: int = 6, seed: int = 0, only: str = "", tools: tuple[str, ...] = ()
) -> tuple[list[Row], NDArray[np.uint8]]:
    """All variants on all cases: the rows and the contact sheet of ``full``."""
    kept: dict[tuple[str, str, str, str], list[tuple[bool, bool, bool, float]]] = {}
    sheet: dict[tuple[str, str, str], list[NDArray[np.uint8]]] = {}
    matchers: dict[str, dict[str, matching.Matcher | None]] = {}
    for case in cases(count, seed, only, tools):
        group = case.family if name == "embedded" else ""
        if group not in matchers:
            matchers[group] = variants(name, weights, case.family)
        full = matchers[group]["full"]
        assert full is not None
        for variant, matcher in matchers[group].items():
            start = time.process_time()
            try:
                points, normals, result = contacts(case, matcher, full)
                seconds = time.process_time() - start
                works, marked = judge(case, points, normals)
            except MagicError as error:
                print(f"{variant}: {case.job}, {case.source} to {case.family}: {error}", file=sys.stderr)
                works, marked, seconds, result = np.zeros(1, bool), False, time.process_time() - start, None
            kept.setdefault((variant, case.job, case.source, case.family), []).append(
                (bool(works[0]), bool(works[:3].any()), marked, seconds)
            )
            if variant == "full" and result is not None:
                sheet.setdefault((case.job, case.source, case.family), []).append(tile(case, result, works))
    rows = [
        Row(*key, len(values), *(float(np.mean([v[i] for v in values])) for i in range(3)), float(np.median([v[3] for v in values])))
        for key, values in kept.items()
    ]
    return sorted(rows, key=lambda row: list(next(iter(matchers.values()))).index(row.variant)), contact_sheet(sheet, count)


@dataclass(frozen=True)
class Control:
    """Things of a family that cannot do a job: how many, how many were refused, and the greatest similarity of those that were not."""

    job: str
    family: str
    fitted: bool
    count: int
    refused: int
    most: float


def controls(name: str = "embedded", weights: str = "", count: int = 6, seed: int = 0, only: str = "") -> list[Control]:
    """Refusals of plain things and of tools that no target of the drawn size fits, with the weights that ship."""
    matcher = matching.Matcher(features.load(name, weights))
    rows = []
    for job in jobs.JOBS.values():
        if only and job.name != only:
            continue
        # Every tool of a bowl's job has a bowl.
        for family in (*plain.FITTED, *plain.HELD_OUT, *(job.regions if job.needs != "region" else ())):
            random = np.random.default_rng([seed, 9, *family.encode()])
            similarities: list[float] = []
            made = 0
            for k, (source, region) in ((k, item) for k in range(3 * count) for item in job.references.items()):
                shown = jobs.example(job.name, source, REFERENCES + 10 * seed + int(random.integers(3)))
                old, new = random.uniform(*job.targets, size=2)
                contact = shown.contact(region)
                if made == count or not shown.works(contact.pixel[None], contact.normal[None], old / shown.view.metres_per_pixel).all():
                    continue
                view, true = _control(job, family, TOOLS + 100 * seed + k, k % 2 == 1)
                radius = new / view.metres_per_pixel
                if job.needs != "region" and jobs.holds(job, true, true.points[::3], true.normals[::3], radius).any():
                    continue
                made += 1
                reference = make_reference(shown.view, contact.pixel, contact.normal, old / shown.view.metres_per_pixel, shown.contour)
                target = jobs.disc_target(new, job.view)
                try:
                    found = matcher.match_views(reference, contact, [matching.Tool(family, view)], target, 3, False, old)
                    similarities.append(max(c.s_dino for c in found.candidates))
                except MagicError as error:
                    if error.code is not Code.NO_MATCH:
                        raise
            if made:
                most = max(similarities, default=0.0)
                rows.append(Control(job.name, family, family in plain.FITTED, made, made - len(similarities), most))
    return rows


def _control(job: jobs.Job, family: str, seed: int, rough: bool) -> tuple[CanonicalView, Contour]:
    """The view of a plain thing, or of a tool of the job, and its true outline."""
    if family in job.regions:
        tool = jobs.example(job.name, family, seed, rough)
        return tool.view, tool.true
    return plain.view(family, seed, job.view, rough), contours.extract(plain.view(family, seed, job.view).mask)


def controls_table(rows: list[Control]) -> str:
    """The refusals as Markdown, sums by kind first."""
    kinds = {
        "plain things, fitted families": [r for r in rows if r.fitted],
        "plain things, families held out": [r for r in rows if r.family in plain.HELD_OUT],
        "tools too small for the target": [r for r in rows if not r.fitted and r.family not in plain.HELD_OUT],
    }
    lines = ["| controls | hooking | hanging | scooping | all |", "| --- | --- | --- | --- | --- |"]
    for kind, part in kinds.items():
        cells = []
        for job in (*jobs.JOBS, ""):
            some = [r for r in part if not job or r.job == job]
            cells.append(f"{sum(r.refused for r in some)} of {sum(r.count for r in some)}" if some else "")
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    lines += ["", "| job | family | n | refused | greatest similarity of the others |", "| --- | --- | --- | --- | --- |"]
    lines += [f"| {r.job} | {r.family} | {r.count} | {r.refused} | {f'{r.most:.2f}' if r.refused < r.count else ''} |" for r in rows]
    return "\n".join(lines)


def contact_sheet(sheet: dict[tuple[str, str, str], list[NDArray[np.uint8]]], columns: int) -> NDArray[np.uint8]:
    """One row of tiles for each pair of families, its names in front."""
    lines = []
    for key, tiles in sheet.items():
        label = np.full((TILE, TILE, 3), 24, np.uint8)
        for k, text in enumerate(key):
            cv2.putText(label, text, (6, 34 + 26 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (230, 230, 230), 1, cv2.LINE_AA)
        empty = np.full((TILE, TILE, 3), 24, np.uint8)
        lines.append(np.hstack([label, *tiles[:columns], *[empty] * (columns - len(tiles))]))
    return np.vstack(lines) if lines else np.zeros((TILE, TILE, 3), np.uint8)


def means(rows: list[Row]) -> list[dict[str, Any]]:
    """For each variant the number of matches and the shares over all of them, and over the category pairs alike."""
    result = []
    for variant in dict.fromkeys(row.variant for row in rows):
        part = [row for row in rows if row.variant == variant]
        number = sum(row.count for row in part)
        entry: dict[str, Any] = {"variant": variant, "matches": number, "pairs": len(part)}
        for name in ("first", "third", "marked"):
            entry[name] = sum(getattr(row, name) * row.count for row in part) / number
            entry[f"{name}_mean_of_pairs"] = float(np.mean([getattr(row, name) for row in part]))
        entry["cpu_seconds"] = float(np.median([row.seconds for row in part]))
        result.append(entry)
    return result


def table(rows: list[Row]) -> str:
    """The figures as Markdown: the variants' means, then ``full`` by category pair."""
    lines = ["| variant | matches | first | first three | first on a marked region |", "| --- | --- | --- | --- | --- |"]
    lines += [
        f"| {m['variant']} | {m['matches']} | {100 * m['first']:.1f} | {100 * m['third']:.1f} | {100 * m['marked']:.1f} |"
        for m in means(rows)
    ]
    lines += ["", "| job | reference | tool | n | first | first three | marked |", "| --- | --- | --- | --- | --- | --- | --- |"]
    lines += [
        f"| {r.job} | {r.reference} | {r.tool} | {r.count} | {100 * r.first:.0f} | {100 * r.third:.0f} | {100 * r.marked:.0f} |"
        for r in rows
        if r.variant == "full"
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--features", default="embedded", choices=("embedded", "dinov2"))
    parser.add_argument("--weights", default="", help="hub name or folder, for dinov2")
    parser.add_argument("--count", type=int, default=6, help="tools a pair of families (default: 6)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--job", default="", choices=("", *jobs.JOBS))
    parser.add_argument("--tool", nargs="*", default=(), help="only these families of tools")
    parser.add_argument("--out", type=Path, help="folder for bench.json, bench.md and bench.png (or speed.json)")
    parser.add_argument("--speed", action="store_true", help="measure speed and memory instead")
    parser.add_argument("--controls", action="store_true", help="count the refusals of things that can do none of the jobs instead")
    parser.add_argument("--requests", type=int, default=1000, help="requests over which --speed watches the memory (default: 1000)")
    given = parser.parse_args(argv)
    try:
        if given.speed:
            data = speed.measure(given.weights, given.requests)
            text = json.dumps(data, indent=1)
        elif given.controls:
            refused = controls(given.features, given.weights, given.count, given.seed, given.job)
            text, data = controls_table(refused), {"rows": [asdict(row) for row in refused]}
        else:
            start = time.process_time()
            rows, sheet = run(given.features, given.weights, given.count, given.seed, given.job, tuple(given.tool))
            text = table(rows)
            data = {
                "features": given.features,
                "seed": given.seed,
                "count": given.count,
                "lambda": score.LAMBDA,
                "cpu_seconds": time.process_time() - start,
                "means": means(rows),
                "rows": [asdict(row) for row in rows],
            }
    except MagicError as error:
        print(f"bench: {error}", file=sys.stderr)
        sys.exit(2)
    print(text)
    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        name = "speed" if given.speed else "controls" if given.controls else "bench"
        (given.out / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n")
        if not given.speed:
            (given.out / f"{name}.md").write_text(text + "\n")
        if name == "bench":
            cv2.imwrite(str(given.out / "bench.png"), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
