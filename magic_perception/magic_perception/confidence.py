"""How likely it is that a reconstructed thing is right, computed from what was seen of it.

A thing is right where its masks and its solid overlap the truth (intersection over union, seen by each camera and by volume) by more
than 0.8.  The chance of that is a logistic function of a few numbers.  ``confidence.json`` holds its weights, fitted with a
ridge penalty to 260 things of procedural scenes; ``ros2 run magic_perception learn_confidence`` fits them anew.
``docs/results_perception.md`` says how it does on others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core.scene import PICTURE, REGION, UNSEEN
from magic_perception import logistic
from magic_perception.seen import Witnessed
from magic_perception.sight import Agreement

#: Shapes that have a few numbers, all of which are fitted; those with a body of revolution; what ends a thing out of sight at nobody knows
#: what length.
TURNED, ROUND, ENDED = ("sphere", "cylinder", "rounded box"), ("round", "round with handle"), (PICTURE, REGION, UNSEEN)
#: The numbers that speak for or against a solid: what they are, and their :data:`SIGNS`.
NUMBERS = {
    "overlap": ("of its silhouette with the masks", 1),
    "seen": ("share of its surface that was seen", 1),
    "residual_mm": ("median distance between measured and drawn depth, up to 8", -1),
    "far": ("share of the measured points farther than 6 mm from it", -1),
    "box": ("1 for a box with sharp edges", 0),
    "turned": ("1 for a ball, a cylinder or a box with rounded edges", 0),
    "flat": ("1 for a flat thing", 0),
    "round": ("1 for a body of revolution with a profile", 0),
    "layers": ("1 for what is stacked from layers", 0),
    "thin": ("log of its smallest size over 20 mm", 0),
    "border": ("1 where the picture or the region cuts it off", -1),
    "joined": ("share of its outline along which another thing goes on at its depth, up to 0.3: they may be one", -1),
    "several": ("1 where several cameras saw it", 0),
    "apart": ("how far they disagree, over its smallest size, up to 0.5", -1),
}
#: 1 or -1 for a number that speaks for or against, whatever chance makes of it in the scenes that teach.
SIGNS = np.array([sign for _, sign in NUMBERS.values()])


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a solid.

    shape: how it came about (:class:`magic_perception.solids.Reconstruction`); fit: with masks and free space; witnessed: with the measured
    depth; extents (3,): its sizes, m; cameras: how many saw it; apart: how far they disagree, m, 0 where that was not measured;
    cut: what cuts it off, names and labels; joined: as :func:`magic_perception.seen.joined` has it.
    """

    shape: str
    fit: Agreement
    witnessed: Witnessed
    extents: NDArray[np.float64]
    cameras: int
    apart: float
    cut: Sequence[int | str]
    joined: float

    def row(self) -> NDArray[np.float64]:
        """The :data:`NUMBERS`, each within the range of what the chance was fitted to."""
        told = {
            "overlap": min(self.fit.overlap, 1.0),
            "seen": self.witnessed.seen,
            "residual_mm": min(1000 * self.witnessed.residual, 8.0),
            "far": self.witnessed.far,
            "box": float(self.shape == "box"),
            "turned": float(self.shape in TURNED),
            "flat": float(self.shape == "flat"),
            "round": float(self.shape in ROUND),
            "layers": float(self.shape == "layers"),
            "thin": float(np.clip(np.log(max(float(self.extents.min()), 1e-6) / 0.02), -2, 2)),
            "border": float(any(by in ENDED for by in self.cut)),
            "joined": min(self.joined, 0.3),
            "several": float(self.cameras > 1),
            "apart": min(self.apart / max(float(self.extents.min()), 1e-3), 0.5),
        }
        return np.array([told[name] for name in NUMBERS])


@cache
def _learned() -> logistic.Logistic:
    return logistic.load(Path(__file__).with_name("confidence.json"), NUMBERS)


def chance(evidence: Evidence) -> float:
    """0..1: how likely masks and solid overlap the truth by more than 0.8."""
    return _learned().chance(evidence.row())
