"""A chance as a logistic function of a few numbers, kept in a readable file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Logistic:
    """The logarithm of the odds: a constant, and a weight (C,) for each of the numbers."""

    constant: float
    weights: NDArray[np.float64]

    def odds(self, numbers: NDArray[np.float64]) -> float:
        """The logarithm of the odds at numbers (C,)."""
        return float(self.constant + self.weights @ numbers)

    def chance(self, numbers: NDArray[np.float64]) -> float:
        """0..1."""
        return float(1 / (1 + np.exp(-np.clip(self.odds(numbers), -30, 30))))

    def save(self, path: Path, names: Mapping[str, object] | list[str]) -> None:
        """Write a JSON file; names: of the numbers, in their order."""
        weights = {name: round(float(weight), 4) for name, weight in zip(names, self.weights, strict=True)}
        path.write_text(json.dumps({"constant": round(self.constant, 4), "weights": weights}, indent=1) + "\n")


def load(path: Path, names: Mapping[str, object] | list[str]) -> Logistic:
    """What :meth:`Logistic.save` wrote; names: of the numbers, in their order."""
    told = json.loads(path.read_text())
    return Logistic(float(told["constant"]), np.array([float(told["weights"][name]) for name in names]))


def fit(rows: NDArray[np.float64], truth: NDArray[np.bool_], weight: NDArray[np.float64] | None = None, ridge: float = 1.0) -> Logistic:
    """Logistic regression with a ridge penalty on the standardised numbers: rows (N, C), truth (N,), weight (N,) of each."""
    from sklearn.linear_model import LogisticRegression

    mean, scale = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
    model = LogisticRegression(C=1 / ridge, max_iter=1000).fit((rows - mean) / scale, truth, weight)
    weights = model.coef_[0] / scale
    return Logistic(float(model.intercept_[0] - weights @ mean), weights)
