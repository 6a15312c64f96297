"""How long a request may still take, and whether someone has called it off."""

from __future__ import annotations

import time
from collections.abc import Callable

from magic_core.errors import Code, MagicError


class Budget:
    """A deadline and a cancel test, asked inside every long loop."""

    def __init__(self, seconds: float = float("inf"), cancelled: Callable[[], bool] = lambda: False) -> None:
        self.seconds = float(seconds)
        self.started = time.monotonic()
        self._cancelled = cancelled

    @property
    def spent(self) -> float:
        """Seconds since the request began."""
        return time.monotonic() - self.started

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
