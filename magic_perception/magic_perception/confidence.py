"""How likely it is that a reconstructed thing is right, computed from what was seen of it.

A thing is right where its masks and its solid overlap the truth (intersection over union, seen by each camera and by volume) by more
than 0.8.  The chance of that is a logistic function of a few numbers, fitted with a ridge penalty to 356 things of procedural scenes that the
model of a D435 saw with two cameras, with one, and with two whose poses were off by up to 10 mm.  README.md says how it does on others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_perception.seen import Witnessed
from magic_perception.sight import Agreement

#: Shapes that are fitted or carved whole from what masks tell; and those with a body of revolution.
EXACT, ROUND = ("sphere", "cylinder", "flat"), ("round", "round with handle")
#: What each number adds to the logarithm of the odds.
CONSTANT = -26.249
WEIGHTS = {
    "exact": 4.492,
    "overlap": 20.888,
    "through": 4.390,
    "seen": 8.936,
    "residual_mm": -1.372,
    "far": 3.632,
    "flat": -0.554,
    "round": 2.095,
    "thin": 1.539,
    "cut": -1.587,
    "several": 0.619,
    "apart_mm": -0.671,
}


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a solid.

    shape: how it came about (:class:`magic_perception.solids.Reconstruction`); fit: with masks and free space; witnessed: with the measured
    depth; extents (3,): its sizes, m; cameras: how many saw it; apart: how far they disagree, m, 0 where that was not measured;
    cut: whether it is cut off.
    """

    shape: str
    fit: Agreement
    witnessed: Witnessed
    extents: NDArray[np.float64]
    cameras: int
    apart: float
    cut: bool

    def numbers(self) -> dict[str, float]:
        """What the chance is computed from, each within the range of what it was fitted to."""
        return {
            "exact": float(self.shape in EXACT),
            "overlap": min(self.fit.overlap, 1.0),
            "through": min(self.fit.through, 0.3),
            "seen": self.witnessed.seen,
            "residual_mm": min(1000 * self.witnessed.residual, 8.0),
            "far": self.witnessed.far,
            "flat": float(self.shape == "flat"),
            "round": float(self.shape in ROUND),
            "thin": float(np.clip(np.log(max(float(self.extents.min()), 1e-6) / 0.02), -2, 2)),
            "cut": float(self.cut),
            "several": float(self.cameras > 1),
            "apart_mm": min(1000 * self.apart, 12.0),
        }


def chance(evidence: Evidence) -> float:
    """0..1: how likely masks and solid overlap the truth by more than 0.8."""
    odds = CONSTANT + sum(WEIGHTS[name] * value for name, value in evidence.numbers().items())
    return float(1 / (1 + np.exp(-np.clip(odds, -30, 30))))
