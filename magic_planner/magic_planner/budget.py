"""How long a request may still take, and whether someone has called it off."""

from __future__ import annotations

import time
from collections.abc import Callable

from magic_core.errors import Code, MagicError


class Budget:
    """A deadline and a cancel test, asked inside every long loop; ``clock`` counts the seconds."""

    def __init__(
        self,
        seconds: float = float("inf"),
        cancelled: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.seconds = float(seconds)
        self._clock = clock
        self.started = clock()
        self._cancelled = cancelled

    @property
    def spent(self) -> float:
        """Seconds since the request began."""
        return self._clock() - self.started

    @property
    def left(self) -> float:
        """Seconds until the deadline, never below zero."""
        return max(0.0, self.seconds - self.spent)

    def check(self, stage: str) -> None:
        """Raise CANCELED or PLANNING_TIMEOUT, naming the stage that was interrupted."""
        if self._cancelled():
            raise MagicError(Code.CANCELED, f"planning was cancelled during stage {stage}")
        if self.spent > self.seconds:
            raise MagicError(Code.PLANNING_TIMEOUT, f"planning time at stage {stage}", f"{self.spent:.2f} s", f"{self.seconds:.2f} s")
