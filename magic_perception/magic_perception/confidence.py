"""How likely it is that a reconstructed thing is right, from what was seen of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_perception.seen import Witnessed
from magic_perception.sight import Agreement


@dataclass(frozen=True)
class Evidence:
    """What speaks for and against a solid.

    shape: how it came about (:class:`magic_perception.solids.Reconstruction`); fit: with masks and free space; witnessed: with the measured depth;
    thickness: its smallest extent over its longest; apart: how far the cameras disagree, m, 0 where it was not measured; cut: cut off.
    """

    shape: str
    fit: Agreement
    witnessed: Witnessed
    extents: NDArray[np.float64]
    cameras: int
    apart: float
    cut: bool

    def features(self) -> NDArray[np.float64]:
        """The numbers that the chance is computed from."""
        size = np.sort(self.extents)
        return np.array(
            [
                1.0,
                self.fit.overlap,
                self.fit.through,
                self.witnessed.seen,
                1000 * self.witnessed.residual,
                self.witnessed.far,
                np.log(max(size[0], 1e-3) / 0.02),
                np.log(max(size[2], 1e-3) / 0.1),
                float(self.cameras > 1),
                1000 * self.apart,
                float(self.cut),
                *(float(self.shape == name) for name in SHAPES),
            ]
        )


#: Shapes that are judged each by itself; the others together.
SHAPES = ("sphere", "cylinder", "flat", "height field", "shell", "round", "round with handle", "layers", "carved")
