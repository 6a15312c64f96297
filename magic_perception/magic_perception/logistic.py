"""A chance as a logistic function of a few numbers, and how a linear function is kept in a readable file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Names = Mapping[str, object] | list[str]


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

    def save(self, path: Path, names: Names) -> None:
        """Write a JSON file; names: of the numbers, in their order."""
        save_linear(path, self.constant, self.weights, names)


def load(path: Path, names: Names) -> Logistic:
    """What :meth:`Logistic.save` wrote; names: of the numbers, in their order."""
    return Logistic(*load_linear(path, names))


def save_linear(path: Path, constant: float, weights: NDArray[np.float64], names: Names) -> None:
    """Write constant and weights (C,) as a JSON file, to four decimals; names: of the numbers, in their order."""
    named = {name: round(float(weight), 4) for name, weight in zip(names, weights, strict=True)}
    path.write_text(json.dumps({"constant": round(constant, 4), "weights": named}, indent=1) + "\n")


def load_linear(path: Path, names: Names) -> tuple[float, NDArray[np.float64]]:
    """Constant and weights (C,) that :func:`save_linear` wrote; names: of the numbers, in their order."""
    told = json.loads(path.read_text())
    return float(told["constant"]), np.array([float(told["weights"][name]) for name in names])


def fit(
    rows: NDArray[np.float64],
    truth: NDArray[np.bool_],
    weight: NDArray[np.float64] | None = None,
    ridge: float = 1.0,
    signs: NDArray[np.int64] | None = None,
) -> Logistic:
    """Logistic regression with a ridge penalty on the standardised numbers: rows (N, C), truth (N,), weight (N,) of each; signs (C,): 1 or
    -1 where a number is known to speak for or against, and its weight may not say otherwise."""
    from scipy.optimize import minimize

    mean, scale = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
    columns = np.column_stack([np.ones(len(rows)), (rows - mean) / scale])
    side, count = np.where(truth, 1.0, -1.0), np.ones(len(rows)) if weight is None else weight
    penalty = np.append(0.0, np.full(rows.shape[1], ridge))

    def loss(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        margin = side * (columns @ x)
        value = count @ np.logaddexp(0, -margin) + 0.5 * penalty @ x**2
        return float(value), -(count * side * np.exp(-np.logaddexp(0, margin))) @ columns + penalty * x

    bounds = [
        (None, None),
        *((0 if s > 0 else None, 0 if s < 0 else None) for s in (signs if signs is not None else np.zeros(rows.shape[1]))),
    ]
    x = minimize(loss, np.zeros(columns.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 1000}).x
    weights = x[1:] / scale
    return Logistic(float(x[0] - weights @ mean), weights)
