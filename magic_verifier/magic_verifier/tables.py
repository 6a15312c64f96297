"""The paper's whole evaluation by one command: ``bash ros2_ws/tables.sh`` (``python -m magic_verifier.tables``).

A table is a grid of cells; a cell is a set of cases under one :class:`Options`, the paper's figure beside ours.  Cells that several
tables share are run once.  Each finished case is a line of ``cases.jsonl`` in the output folder, so that the command goes on where it
stopped, and a short run is the beginning of the long one: of each cell the cases are taken in an order drawn by the seed.  What is
written from them (``tables.txt``, ``tables.csv``, ``tables.html``) is a function of these lines alone, and a case is one of its options,
its name and the
seed: the number of jobs changes the time, not the result.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from magic_core.errors import Code, MagicError
from magic_verifier import tables_report
from magic_verifier.cases import TARGET_SETS, Options, all_cases
from magic_verifier.evaluate import attempt
from magic_verifier.subjects import Case

#: The held-out mug of Table II's demonstration: no mug of the set has its seed.
HELD_OUT_MUG = "mug:1000"
#: Rows of Table I and II: the paper's name and ours.
METHODS = {"PCA": "pca", "FPFH+ICP": "fpfh_icp", "DINO Matching": "dino", "Curvature-Only": "curvature", "MAGIC": "magic"}
#: Columns of Table I: name, task, variant.
COLUMNS_1 = (
    ("Scooping FG", "scooping", "fg"),
    ("Scooping Arm", "scooping", "arm"),
    ("Hanging FG", "hanging", "fg"),
    ("Hanging Arm", "hanging", "arm"),
    ("Hooking No Tool Sel.", "hooking", "fg_no_selection"),
    ("Hooking FG", "hooking", "fg"),
    ("Hooking Arm", "hooking", "arm"),
)
#: The paper's success rates in percent, in the order of the columns.
PAPER_1 = {
    "PCA": (27.6, 16.7, 0.0, 0.0, 5.0, 0.0, 0.0),
    "FPFH+ICP": (32.9, 27.2, 0.0, 0.0, 6.7, 0.0, 0.0),
    "DINO Matching": (55.7, 41.4, 23.9, 21.6, 49.2, 66.7, 24.0),
    "Curvature-Only": (13.9, 5.6, 68.7, 38.1, 60.0, 76.7, 3.3),
    "MAGIC": (94.4, 65.4, 92.9, 84.3, 65.0, 100.0, 63.3),
}
PAPER_2 = {
    "PCA": (5.2, 0.0),
    "FPFH+ICP": (41.1, 0.0),
    "DINO Matching": (64.9, 23.9),
    "Curvature-Only": (67.9, 68.7),
    "MAGIC": (94.0, 92.9),
}
ROWS_3 = {
    "DINO Matching": "dino",
    "MAGIC": "magic",
    "w/o Feature PCA and Patch": "no_feature_pca_patch",
    "w/o Two-Step Curvature": "no_two_step_curvature",
    "w/o Simulation Verification": "no_simulation_verification",
}
PAPER_3 = {
    "DINO Matching": (55.7, 23.9, 66.7, 12.4),
    "MAGIC": (94.4, 92.9, 100.0, 34.0),
    "w/o Feature PCA and Patch": (71.7, 93.3, 62.0, 33.8),
    "w/o Two-Step Curvature": (83.3, 53.7, 75.6, 14.1),
    "w/o Simulation Verification": (77.8, 71.6, 50.0, 19.7),
}
ROWS_4 = {"DIFT": "dift", "SD-DINO": "sd_dino", "DINOv2": "dinov2", "embedded": "embedded"}
PAPER_4 = {"DIFT": (62.2, 81.3, 100.0, 60.8), "SD-DINO": (73.8, 91.8, 96.0, 50.7), "DINOv2": (94.4, 92.9, 100.0, 34.0)}
#: Table V: rows with our method (none: KETO, whose figures are the paper's alone), columns with task and set.
ROWS_5 = {"KETO": "", "MAGIC": "magic", "MAGIC, highest score without simulation": "no_simulation_verification"}
COLUMNS_5 = (
    ("Hammering, hammers to hammers", "hammering", "hammers"),
    ("Hammering, hammers to non-hammers", "hammering", "non_hammers"),
    ("Pushing", "sweeping", "own"),
)
PAPER_5 = {"KETO": (66.4, 46.3, 71.7), "MAGIC": (75.6, 53.7, 76.3)}
TASKS_FG = (("Scooping", "scooping"), ("Hanging", "hanging"), ("Hooking", "hooking"))
#: Cases of a cell in the short run, by variant (see :func:`short`); negative controls; cases from images.
QUICK = {"fg": 5, "fg_no_selection": 5, "arm": 2}
QUICK_CONTROLS, QUICK_IMAGES = 3, {"fg": 4, "arm": 2}
#: The reports are written anew every so many seconds while cases run.
REPORT_EVERY = 300.0
NO_WEIGHTS = "no weights at hand"


@dataclass(frozen=True)
class Cell:
    """One figure: where it stands, what is run for it (nothing, for the reason given in ``missing``), and what the paper says.

    ``paper``: percent; ``paper_seconds`` a problem; ``one_each``: each tool with one of the targets, in turn; quick: cases of the short
    run.
    """

    table: str
    row: str
    column: str
    options: Options
    quick: int
    paper: float | None = None
    paper_seconds: float | None = None
    one_each: bool = False
    missing: str = ""
    control: bool = False

    @property
    def key(self) -> str:
        """A name for the options, the same in all tables."""
        return hashlib.sha256(json.dumps(vars(self.options), sort_keys=True).encode()).hexdigest()[:12]


def short(method: str, variant: str) -> int:
    """Cases of the short run: an arm's and those of the curvature baseline, which looks at all of an outline, take longest."""
    if variant == "arm":
        return QUICK["arm"] if method == "magic" else 0
    return 1 if method == "curvature" else QUICK[variant]


def cases_of(cell: Cell, quick: bool) -> list[Case]:
    """The cases of a cell in an order drawn by the seed; the short run takes the first of them."""
    if cell.missing:
        return []
    cases = all_cases(cell.options)
    if cell.one_each:
        count = len(TARGET_SETS[cell.options.targets])
        cases = [case for number, case in enumerate(cases) if number % count == number // count % count]
    order = np.random.default_rng([cell.options.seed, zlib.crc32(cell.options.task.encode())]).permutation(len(cases))
    return [cases[k] for k in (order[: cell.quick] if quick else order)]


def cells(seed: int = 0, strategies: str = "", weights: dict[str, str] | None = None) -> list[Cell]:
    """All cells of all tables; ``weights``: hub names or folders by the name of the features."""
    weights = weights or {}
    base = Options("hanging", seed=seed, strategies=strategies)

    def options(task: str, variant: str = "fg", **more: Any) -> Options:
        found = replace(base, task=task, variant=variant, **more)
        # Hanging as the paper has it: on a mug tree.
        return replace(found, targets="mug_tree") if task == "hanging" and found.set == "own" and found.source == "meshes" else found

    def of_dino(method: str) -> tuple[dict[str, str], str]:
        """Features of a method of the paper that is about DINOv2's, and why it cannot be run."""
        if method != "no_feature_pca_patch":
            return {}, ""
        return {"features": "dinov2", "weights": weights.get("dinov2", "")}, "" if "dinov2" in weights else NO_WEIGHTS

    result: list[Cell] = []
    for row, method in METHODS.items():
        for k, (column, task, variant) in enumerate(COLUMNS_1):
            given = options(task, variant, method=method)
            result.append(Cell("I", row, column, given, short(method, variant), PAPER_1[row][k], one_each=task == "hanging"))
        for column, variant in (("Hanging on a rod FG", "fg"), ("Hanging on a rod Arm", "arm")):
            result.append(Cell("I", row, column, replace(base, variant=variant, method=method), short(method, variant)))
        for column, task in TASKS_FG:
            variant = "fg_no_selection" if task == "hooking" else "fg"
            controls = replace(base, task=task, variant=variant, method=method, set="controls")
            result.append(Cell("I", row, f"{column} controls", controls, min(QUICK_CONTROLS, short(method, "fg")), control=True))
        intra = options("hanging", method=method, demonstration=HELD_OUT_MUG)
        result.append(Cell("II", row, "Hanging (intra-cat.)", intra, short(method, "fg"), PAPER_2[row][0], one_each=True))
        result.append(
            Cell("II", row, "Hanging (inter-cat.)", options("hanging", method=method), short(method, "fg"), PAPER_2[row][1], one_each=True)
        )
    for row, method in ROWS_3.items():
        features, missing = of_dino(method)
        for k, (column, task) in enumerate(TASKS_FG):
            given = options(task, method=method, **features)
            result.append(Cell("III", row, column, given, QUICK["fg"], PAPER_3[row][k], PAPER_3[row][3], task == "hanging", missing))
    for row, name in ROWS_4.items():
        missing = "" if name == "embedded" or name in weights else NO_WEIGHTS
        for k, (column, task) in enumerate(TASKS_FG):
            given = options(task, features=name, weights=weights.get(name, ""))
            paper = PAPER_4.get(row)
            figures = (paper[k], paper[3]) if paper else (None, None)
            result.append(Cell("IV", row, column, given, QUICK["fg"], *figures, task == "hanging", missing))
    for row, method in ROWS_5.items():
        missing = "" if method else "the paper's figure alone"
        for k, (column, task, which) in enumerate(COLUMNS_5):
            given = options(task, method=method or "magic", set=which)
            result.append(Cell("V", row, column, given, QUICK["fg"], PAPER_5[row][k] if row in PAPER_5 else None, missing=missing))
    for variant in ("fg", "arm"):
        for column, task in TASKS_FG:
            seen = replace(base, task=task, variant=variant, source="images", set="unseen")
            result.append(Cell("images", f"MAGIC, {variant}", column, seen, QUICK_IMAGES[variant]))
    for column, task, variant in (("Hanging", "hanging", "fg"), ("Hooking", "hooking", "fg_no_selection")):
        letters = replace(base, task=task, variant=variant, set="alphabet")
        result.append(Cell("alphabet", "MAGIC", column, letters, QUICK["fg"]))
    return result


TABLES = {
    "I": "Average success rates of the tasks; hanging on a mug tree of inclined pegs as in the paper, and on a rod; negative controls",
    "II": f"Hanging on a mug tree, demonstrated with a mug ({HELD_OUT_MUG}, held out) and with a coat hanger on a rod, FG",
    "III": "Ablations, FG",
    "IV": "Features, FG",
    "V": "Hammering and pushing with a mallet's one demonstration; hammers are T, L and X of two blocks and real-looking ones, FG",
    "images": "From images: planned and verified on what two cameras see, judged on the true objects",
    "alphabet": "The alphabet toolkit: capital letters of DejaVu Sans, FG",
}


class Store:
    """Finished cases, one line of JSON each; a line that a crash cut off is left out and written anew."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.done: dict[tuple[str, str], dict[str, Any]] = {}
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        if len(whole) != len(text):
            path.write_bytes(whole)
        for line in whole.splitlines():
            entry = json.loads(line)
            self.done[entry["cell"], entry["case"]] = entry["result"]

    def add(self, cell: str, case: str, result: dict[str, Any]) -> None:
        """Keep a result, on the disk as well."""
        self.done[cell, case] = result
        with open(self._path, "a") as file:
            file.write(json.dumps({"cell": cell, "case": case, "result": result}) + "\n")
            file.flush()
            os.fsync(file.fileno())


def _run(cell: Cell, case: Case, film: Path | None) -> tuple[Cell, Case, dict[str, Any]]:
    return cell, case, attempt(cell.options, case, film)


def film_of(out: Path, cell: Cell, case: str) -> Path:
    """Where the pictures of a case are."""
    return out / "films" / f"{cell.key}_{zlib.crc32(case.encode()):08x}.png"


class Remaining:
    """How long what is left takes: by the mean wall time of the cases of a kind that are done, else of all that are."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._wall: dict[Any, list[float]] = defaultdict(list)

    @staticmethod
    def _kind(cell: Cell) -> tuple[str, ...]:
        return cell.options.task, cell.options.variant, cell.options.method, cell.options.source

    def note(self, cell: Cell, result: dict[str, Any]) -> None:
        """One more is done."""
        self._wall[self._kind(cell)].append(float(result["wall"]))

    def seconds(self, left: Iterable[Cell]) -> float:
        """An estimate for these cells' cases, one for each."""
        every = [seconds for kind in self._wall.values() for seconds in kind]
        mean = float(np.mean(every)) if every else 0.0
        return sum(float(np.mean(self._wall[kind])) if (kind := self._kind(cell)) in self._wall else mean for cell in left) / self._jobs


def run(
    chosen: Sequence[Cell], out: Path, quick: bool, jobs: int = 1, films: bool = True, log: Callable[[str], None] = print
) -> dict[str, list[dict[str, Any]]]:
    """Run what is not stored yet, write the reports, and return the results of each cell by its key."""
    from joblib import Parallel, delayed

    out.mkdir(parents=True, exist_ok=True)
    store = Store(out / "cases.jsonl")
    by_key = {cell.key: cell for cell in chosen if not cell.missing}
    wanted = {key: cases_of(cell, quick) for key, cell in by_key.items()}
    estimate = Remaining(jobs)
    for (key, _), result in store.done.items():
        if key in by_key:
            estimate.note(by_key[key], result)
    most = max((len(cases) for cases in wanted.values()), default=0)
    # The first case of each cell, then the second of each, ..., our own method before the others: what is there when it is stopped
    # says something of everything.
    in_turn = sorted(by_key.items(), key=lambda item: item[1].options.method != "magic")
    waiting = [
        (cell, wanted[key][k])
        for k in range(most)
        for key, cell in in_turn
        if k < len(wanted[key]) and (key, wanted[key][k].name) not in store.done
    ]
    total = sum(len(cases) for cases in wanted.values())
    log(f"{total} cases, {total - len(waiting)} done before, {len(waiting)} to do, {jobs} at a time")
    left = [cell for cell, _ in waiting]
    started = time.monotonic()
    tasks = (delayed(_run)(c, case, film_of(out, c, case.name) if films and c.options.method == "magic" else None) for c, case in waiting)
    reported = time.monotonic()

    def report() -> dict[str, list[dict[str, Any]]]:
        """Write what there is, and answer it."""
        results = {key: [store.done[key, c.name] for c in cases if (key, c.name) in store.done] for key, cases in wanted.items()}
        figures = [tables_report.figure(cell, results.get(cell.key, []), len(wanted.get(cell.key, []))) for cell in chosen]
        pictures = {(key, r["object"]): film_of(out, by_key[key], r["object"]) for key, several in results.items() for r in several}
        tables_report.write(figures, TABLES, pictures, out)
        return results

    try:
        for number, (cell, case, result) in enumerate(Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks), 1):
            store.add(cell.key, case.name, result)
            estimate.note(cell, result)
            left.remove(cell)
            remains = estimate.seconds(left) / 60
            log(
                f"[{total - len(left)}/{total}] {cell.table} {cell.row}, {cell.column}: {case.name}: {result['reason']} "
                f"({result['wall']:.1f} s); {len(left)} left, about {remains:.0f} min"
            )
            if number == len(waiting):
                minutes = (time.monotonic() - started) / 60
                log(f"{number} problems in {minutes:.1f} min: {number / minutes:.1f} a minute with {jobs} job(s)")
            elif time.monotonic() - reported > REPORT_EVERY:
                report()
                reported = time.monotonic()
    finally:  # what was done before an interruption can be looked at
        results = report()
    return results


def main(args: list[str] | None = None) -> None:
    """Entry point of ``tables.sh``."""
    parser = argparse.ArgumentParser(prog="tables.sh", description="The paper's tables, measured here, each figure beside the paper's.")
    parser.add_argument("--quick", action="store_true", help="a few cases of each cell, within 10 minutes on 2 cores; the full sets else")
    parser.add_argument("--only", action="append", choices=tuple(TABLES), help="this table (may be given several times)")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="cases at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--weights", action="append", default=[], metavar="FEATURES=PATH", help="weights of dinov2, dift or sd_dino: a hub name or a folder"
    )
    parser.add_argument("--strategies", default="", help="folder of strategies; by default the installed ones")
    parser.add_argument("--out", default="out/tables", help="folder for results; the same folder goes on where it stopped")
    given = parser.parse_args(args)
    try:
        weights = dict(item.split("=", 1) for item in given.weights)
    except ValueError:
        parser.error(f"--weights {given.weights}: FEATURES=PATH is wanted, such as dinov2=/models/dinov2-base")
    unknown = sorted(set(weights) - set(ROWS_4.values()))
    if unknown:
        parser.error(f"--weights: features {unknown[0]!r} (allowed: {', '.join(ROWS_4.values())})")
    try:
        if given.jobs < 1:
            raise MagicError(Code.BAD_REQUEST, "--jobs", given.jobs, "1 or more")
        chosen = [cell for cell in cells(given.seed, given.strategies, weights) if not given.only or cell.table in given.only]
        out = Path(given.out)
        run(chosen, out, given.quick, given.jobs, True, lambda text: print(text, flush=True))
    except MagicError as error:
        print(f"tables: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"tables: interrupted; {given.out} holds what was done, the same command goes on", file=sys.stderr)
        sys.exit(130)
    print((out / "tables.txt").read_text())


if __name__ == "__main__":
    main()
