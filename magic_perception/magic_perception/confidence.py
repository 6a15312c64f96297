"""How likely it is that a reconstructed thing is right, computed from what was seen of it.

A thing is right where its masks and its solid overlap the truth (intersection over union, seen by each camera and by volume) by more
than 0.8.  The chance of that is a logistic function of a few numbers.  ``confidence.json`` holds its weights, fitted with a
ridge penalty to 257 things of procedural scenes; ``ros2 run magic_perception learn_confidence`` fits them anew. README.md says how it does on others.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_perception import logistic
from magic_perception.seen import Witnessed
from magic_perception.sight import Agreement

#: Shapes that are fitted or carved whole from what masks tell; and those with a body of revolution.
EXACT, ROUND = ("sphere", "cylinder", "box", "rounded box", "flat"), ("round", "round with handle")
#: The numbers that speak for or against a solid, and what they are.
NUMBERS = {
    "exact": "1 for a ball, cylinder, box with sharp or rounded edges, or flat thing",
    "overlap": "of its silhouette with the masks",
    "through": "share of rays that pass through it, up to 0.3",
    "seen": "share of its surface that was seen",
    "residual_mm": "median distance between measured and drawn depth, up to 8",
    "far": "share of the measured points farther than 6 mm from it",
    "flat": "1 for a flat thing",
    "round": "1 for a body of revolution",
    "thin": "log of its smallest size over 20 mm",
    "cut": "1 where it is cut off",
    "several": "1 where several cameras saw it",
    "apart_mm": "how far they disagree, up to 12",
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

    def row(self) -> NDArray[np.float64]:
        """The :data:`NUMBERS`, each within the range of what the chance was fitted to."""
        told = {
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
        return np.array([told[name] for name in NUMBERS])


@cache
def _learned() -> logistic.Logistic:
    return logistic.load(Path(__file__).with_name("confidence.json"), NUMBERS)


def chance(evidence: Evidence) -> float:
    """0..1: how likely masks and solid overlap the truth by more than 0.8."""
    return _learned().chance(evidence.row())
