"""How often verdicts are right: a table and a diagram of what was said against what was the case."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

#: Lower bounds of a success rate by which verdicts are sorted into rows.
ROWS = (0.0, 0.2, 0.5, 0.7, 0.8, 1.0)
#: Edges of the diagram's bins of success rates; the first holds what failed in every rollout.
BINS = (-0.01, 0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.99, 1.0)


@dataclass(frozen=True)
class Judged:
    """A verdict on a motion and what came of it: success rate over the rollouts, lower end of its interval, rollouts; whether it truly
    succeeded."""

    rate: float
    rate_low: float
    rollouts: int
    succeeded: bool


def rows(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """By the lower bound of the success rate: how many motions there are and how many of them truly succeeded."""
    found = []
    for low, high in itertools.pairwise(ROWS):
        some = [j for j in judged if low <= j.rate_low < high]
        found.append({"from": low, "below": high, "motions": len(some), "succeeded": sum(j.succeeded for j in some)})
    return found


def points(judged: Sequence[Judged]) -> list[tuple[float, float, int]]:
    """The diagram's points: mean success rate in simulation, share that truly succeeded, number of motions."""
    rate, right = np.array([j.rate for j in judged]), np.array([j.succeeded for j in judged], dtype=float)
    found = []
    for low, high in itertools.pairwise(BINS):
        inside = (rate > low) & (rate <= high)
        if inside.any():
            found.append((float(rate[inside].mean()), float(right[inside].mean()), int(inside.sum())))
    return found


def table(judged: Sequence[Judged]) -> str:
    """The rows as lines of text, the intervals 95 %, the highest bounds first."""
    from magic_verifier.rates import wilson

    lines = [f"{'lower bound of the success rate':<34}{'motions':>8}{'truly succeed':>15}"]
    for row in reversed(rows(judged)):
        count, good = row["motions"], row["succeeded"]
        low, high = wilson(good, count)
        share = f"{100 * good / count:6.1f} % ({100 * low:.0f} to {100 * high:.0f} %)" if count else ""
        lines.append(f"{row['from']:.1f} or more, below {row['below']:<15.1f}{count:>8}{good:>15}   {share}".rstrip())
    return "\n".join(lines)


def draw(given: Sequence[tuple[float, float, int]], path: Path, title: str, said: str, true: str, lowest: float = 0.0) -> None:
    """The reliability diagram of points (what was said, how often it was right, of how many); ``lowest``: the left edge."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 5))
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    agreed, right, counts = np.array(given, dtype=float).reshape(-1, 3).T
    # One standard error of a share.
    error = np.sqrt(np.maximum(right * (1 - right), 1e-9) / np.maximum(counts, 1))
    axes.errorbar(agreed, right, yerr=error, fmt="o", color="tab:blue", capsize=3)
    for x, y, n in zip(agreed, right, counts, strict=True):
        axes.annotate(f"{int(n)}", (x, y), textcoords="offset points", xytext=(7, -11), fontsize=8)
    axes.set(xlim=(lowest - 0.03, 1.03), ylim=(-0.03, 1.05), xlabel=said, ylabel=true)
    axes.set_title(title, fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
