"""What is written of the tables: text, CSV, and one self-contained HTML page with plots, pictures and the failures by reason."""

from __future__ import annotations

import base64
import csv
import html
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magic_verifier.evaluate import truths
from magic_verifier.rates import wilson

#: Pictures of successes and of failures on the page, for each table, and their width in pixels.
PICTURES, PICTURE_WIDTH = 12, 420


@dataclass(frozen=True)
class Figure:
    """What came of a cell: counts without the cases that geometry forbids, which stand apart, and the median of the seconds a problem: a
    machine may have been suspended in one.

    ``wanted`` and ``done``: cases asked for and finished; ``missing``: why nothing was run; ``truth``: the four counts of
    :func:`magic_verifier.evaluate.truths`, for cases from images.
    """

    table: str
    row: str
    column: str
    key: str
    paper: float | None
    paper_seconds: float | None
    missing: str
    control: bool
    wanted: int
    done: int
    cases: int
    successes: int
    interval: tuple[float, float]
    seconds: float
    reasons: Mapping[str, int]
    failures: Sequence[tuple[str, str, str]]
    impossible: Mapping[str, str]
    impossible_successes: int
    truth: Mapping[str, Any] | None

    @property
    def rate(self) -> float:
        """Success rate in percent, NaN of no cases."""
        return 100.0 * self.successes / self.cases if self.cases else math.nan


def figure(cell: Any, results: Sequence[Mapping[str, Any]], wanted: int) -> Figure:
    """The figure of a cell (:class:`magic_verifier.tables.Cell`) from its results, of which there are to be ``wanted``."""
    if cell.missing:  # what is not run has no results, whoever else was run with the same options
        results = ()
    hopeless = {r["object"]: r["impossible"] for r in results if r.get("impossible")}
    counted = [r for r in results if cell.control or r["object"] not in hopeless]
    failed = [r for r in counted if not r["success"]]
    good = len(counted) - len(failed)
    return Figure(
        cell.table,
        cell.row,
        cell.column,
        cell.key,
        cell.paper,
        cell.paper_seconds,
        cell.missing,
        cell.control,
        wanted,
        len(results),
        len(counted),
        good,
        wilson(good, len(counted)),
        float(np.median([r["seconds"]["total"] for r in counted])) if counted else math.nan,
        dict(Counter(r["reason"] for r in failed).most_common()),
        [(r["object"], r["reason"], (r["candidates"] or [{}])[0].get("message", "")) for r in failed],
        {} if cell.control else hopeless,
        sum(bool(r["success"]) for r in results if r["object"] in hopeless and not cell.control),
        truths(list(counted)) if counted and cell.options.source == "images" else None,
    )


def words(found: Figure) -> str:
    """A figure in a line: ours with its 95 % interval and count, the time, what geometry forbids, the truth."""
    if found.missing:
        return found.missing
    if not found.wanted:
        return "not in this run"
    if not found.done:
        return "not run yet"
    if not found.cases:
        return f"no case but {len(found.impossible)} impossible"
    left = f"; {found.wanted - found.done} cases still to run" if found.done < found.wanted else ""
    if found.control:
        return f"{found.successes} of {found.cases} passed (should be 0){left}"
    low, high = (100 * x for x in found.interval)
    text = f"{found.rate:.1f} % ({low:.0f} to {high:.0f}; {found.successes} of {found.cases}), {found.seconds:.1f} s"
    if found.impossible:
        text += f"; {len(found.impossible)} impossible, {found.impossible_successes} of them passed"
    if found.truth is not None:
        truth = found.truth
        text += (
            f"; on the true objects: {truth['verified_and_succeeds']} verified and succeed, {truth['verified_but_fails']} verified but fail, "
            f"{truth['refused_but_would_succeed']} refused though they would succeed, {truth['refused_and_fails']} refused rightly"
        )
    return text + left


def paper_words(found: Figure) -> str:
    """The paper's figure, empty where it has none."""
    if found.paper is None:
        return ""
    return f"{found.paper:.1f} %" + (f", {found.paper_seconds:.1f} s" if found.paper_seconds is not None else "")


def _tables(figures: Sequence[Figure]) -> dict[str, list[Figure]]:
    tables: dict[str, list[Figure]] = {}
    for found in figures:
        tables.setdefault(found.table, []).append(found)
    return tables


def text_of(figures: Sequence[Figure], titles: Mapping[str, str]) -> str:
    """All tables as plain text."""
    lines = []
    for name, members in _tables(figures).items():
        lines += [f"Table {name}: {titles[name]}", ""]
        width = max(len(f"{f.row} | {f.column}") for f in members)
        lines += [f"{f'{f.row} | {f.column}':<{width}}  paper {paper_words(f) or '-':<16} here {words(f)}" for f in members]
        lines += ["", *(f"  {row}, {column}: {reasons}" for row, column, reasons in _reasons(members)), ""]
    return "\n".join(lines)


def _reasons(members: Sequence[Figure]) -> list[tuple[str, str, str]]:
    return [
        (f.row, f.column, ", ".join(f"{count} {reason}" for reason, count in f.reasons.items()))
        for f in members
        if f.reasons and not f.control
    ]


def write_csv(figures: Sequence[Figure], path: Path) -> None:
    """One line a figure."""
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["table", "row", "column", "paper_percent", "paper_seconds", "percent", "low_95", "high_95", "successes", "cases", "seconds"]
            + ["impossible", "impossible_successes", "verified_and_succeeds", "verified_but_fails"]
            + ["refused_but_would_succeed", "refused_and_fails", "missing", "reasons"]
        )
        for f in figures:
            truth = f.truth or {}
            low, high = (100 * x for x in f.interval)
            ours = [f"{f.rate:.2f}", f"{low:.2f}", f"{high:.2f}", f.successes, f.cases, f"{f.seconds:.3f}"] if f.cases else [""] * 6
            known = ("verified_and_succeeds", "verified_but_fails", "refused_but_would_succeed", "refused_and_fails")
            writer.writerow(
                [f.table, f.row, f.column, f.paper if f.paper is not None else "", f.paper_seconds or "", *ours]
                + [len(f.impossible), f.impossible_successes, *(truth.get(k, "") for k in known), f.missing]
                + ["; ".join(f"{count} {reason}" for reason, count in f.reasons.items())]
            )


def plot(name: str, members: Sequence[Figure]) -> bytes:
    """A PNG of a table: ours with its interval, the paper's figure as a hollow mark, one column of the table under the other."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = [f for f in members if f.cases and not f.control]
    columns = list(dict.fromkeys(f.column for f in shown))
    rows = list(dict.fromkeys(f.row for f in shown))
    picture, axes = pyplot.subplots(figsize=(8, 1.2 + 0.22 * len(rows) * len(columns)))
    shades = pyplot.get_cmap("tab10")
    for f in shown:
        y = columns.index(f.column) + (rows.index(f.row) + 0.5) / (len(rows) + 1)
        low, high = (100 * x for x in f.interval)
        shade = shades(rows.index(f.row) % 10)
        axes.plot([low, high], [y, y], color=shade, lw=2)
        axes.plot([f.rate], [y], "o", color=shade, ms=5)
        if f.paper is not None:
            axes.plot([f.paper], [y], "D", mfc="white", mec=shade, ms=5)
    for k, row in enumerate(rows):
        axes.plot([], [], "o-", color=shades(k % 10), label=row)
    axes.plot([], [], "D", mfc="white", mec="black", label="the paper's")
    axes.set_yticks([k + 0.5 for k in range(len(columns))], columns)
    axes.set_ylim(len(columns), 0)
    axes.set_xlim(-3, 103)
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("success rate in %, with its 95 % interval")
    axes.set_title(f"Table {name}")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    buffer = io.BytesIO()
    picture.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    pyplot.close(picture)
    return buffer.getvalue()


def _image(data: bytes, kind: str, caption: str) -> str:
    encoded = base64.b64encode(data).decode()
    return f'<figure><img src="data:image/{kind};base64,{encoded}" alt="{html.escape(caption)}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def _small(path: Path) -> bytes | None:
    import cv2

    picture = cv2.imread(str(path)) if path.exists() else None  # OpenCV writes a warning for each that is not there
    if picture is None:
        return None
    height = max(1, round(picture.shape[0] * PICTURE_WIDTH / picture.shape[1]))
    return cv2.imencode(".jpg", cv2.resize(picture, (PICTURE_WIDTH, height), interpolation=cv2.INTER_AREA))[1].tobytes()


def _sheets(members: Sequence[Figure], pictures: Mapping[tuple[str, str], Path]) -> str:
    """Contact sheets: the first successes, and every failure up to as many."""
    keys = {f.key: f"{f.row}, {f.column}" for f in members}
    failed = {(f.key, name): reason for f in members for name, reason, _ in f.failures}
    parts = []
    for title, wanted in (("Successes", False), ("Failures", True)):
        tiles: list[str] = []
        for (key, name), path in pictures.items():
            if key not in keys or ((key, name) in failed) is not wanted or len(tiles) == PICTURES:
                continue
            data = _small(path)
            if data is not None:
                tiles.append(_image(data, "jpeg", f"{keys[key]}: {name}" + (f": {failed[key, name]}" if wanted else "")))
        if tiles:
            parts.append(f'<h3>{title}</h3><div class="sheet">{"".join(tiles)}</div>')
    return "".join(parts)


def page(figures: Sequence[Figure], titles: Mapping[str, str], pictures: Mapping[tuple[str, str], Path]) -> str:
    """The HTML page."""
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>Tables</title><style>"
        "body{font:15px/1.4 sans-serif;margin:2em auto;max-width:76em;padding:0 1em;color:#222}table{border-collapse:collapse;margin:1em 0}"
        "td,th{border:1px solid #ccc;padding:.3em .6em;text-align:left;vertical-align:top}th{background:#f2f2f2}"
        ".sheet{display:flex;flex-wrap:wrap;gap:8px}figure{margin:0}.sheet figure{width:300px}img{max-width:100%}figcaption{font-size:12px}"
        "</style><h1>The paper's tables, measured here</h1><p>The paper's figures are for other objects (ShapeNet mugs, its own tools) with DINOv2. "
        "Ours: success rate, its 95 % interval (Wilson) and count, median seconds a problem. What geometry forbids is counted apart.</p>"
    ]
    for name, members in _tables(figures).items():
        parts.append(f"<h2>Table {html.escape(name)}</h2><p>{html.escape(titles[name])}</p>")
        if any(f.cases and not f.control for f in members):
            parts.append(_image(plot(name, members), "png", f"Table {name}"))
        cells = "".join(
            f"<tr><td>{html.escape(f.row)}</td><td>{html.escape(f.column)}</td><td>{paper_words(f)}</td><td>{html.escape(words(f))}</td></tr>"
            for f in members
        )
        parts.append(f"<table><tr><th>method</th><th>task</th><th>the paper</th><th>here</th></tr>{cells}</table>")
        reasons = "".join(
            f"<tr><td>{html.escape(a)}</td><td>{html.escape(b)}</td><td>{html.escape(c)}</td></tr>" for a, b, c in _reasons(members)
        )
        if reasons:
            parts.append(f"<h3>Failures by reason</h3><table><tr><th>method</th><th>task</th><th>reasons</th></tr>{reasons}</table>")
        apart = {f"{case}: {reason}" for f in members for case, reason in f.impossible.items()}
        if apart:
            parts.append(
                "<h3>Impossible by geometry</h3><ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in sorted(apart)) + "</ul>"
            )
        parts.append(_sheets(members, pictures))
        own = [f for f in members if f.row.startswith("MAGIC") and f.failures]
        if own:
            lines = "".join(
                f"<li>{html.escape(f'{f.column}: {case}: {reason}: {message}')}</li>" for f in own for case, reason, message in f.failures
            )
            parts.append(f"<details><summary>Each failure of MAGIC</summary><ul>{lines}</ul></details>")
    return "".join(parts) + "</html>"


def write(figures: Sequence[Figure], titles: Mapping[str, str], pictures: Mapping[tuple[str, str], Path], out: Path) -> None:
    """``tables.txt``, ``tables.csv`` and ``tables.html`` in a folder."""
    (out / "tables.txt").write_text(text_of(figures, titles))
    write_csv(figures, out / "tables.csv")
    (out / "tables.html").write_text(page(figures, titles, pictures))
