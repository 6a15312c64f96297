"""A body of revolution that stands on the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Body:
    """A round body: axis (2,), profile (K, 2) of radius and z from the table up, open at the top or not, or through and through (a band).

    floor: height of the floor inside, m, where it was seen.
    """

    axis: NDArray[np.float64]
    profile: NDArray[np.float64]
    open: bool = False
    through: bool = False
    floor: float | None = None

    def radius(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(z, self.profile[:, 1], self.profile[:, 0])
