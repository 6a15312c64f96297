"""Whether the scene stays as a motion believes it, while the motion runs.  No ROS here."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_server import scene_change
from magic_server.permission import AHEAD, Look
from magic_server.scene_change import Changed, beyond

#: What is in none of so many looks that follow each other is gone: a single picture may miss a thing.
GONE = 2
#: A thing that is nearer to the hand than this, m, may be hidden by it, or by what it holds: it is not said to be gone.
HIDES = 0.3


class Unwatched(MagicError):
    """Nobody has seen for too long what the arm moves among: a newer look at it, and another plan, may help."""


class SceneWatch:
    """Looks at target and obstacles while the arm moves.

    planned: the objects that the motion was planned for.  meant: ids of what is moved on purpose.  target: its id, and ``contact``:
    from how many seconds after the move's beginning on the tool may move it (infinite: not in this move).  tolerance: m that points of a
    thing may have moved (:func:`magic_server.scene_change.beyond`); age: s that the newest look may be old.  An id may be handed on to
    another thing: what stands where a thing stood, as it stood, is that thing by whatever new id.  What has come is not looked at here, but
    before each move of the arm, and by :mod:`magic_server.intrusion`.
    """

    def __init__(self, planned: Look, meant: Collection[str], target: str, contact: float, tolerance: float, age: float) -> None:
        self._planned, self._meant, self._target, self._contact = planned, frozenset(meant), target, contact
        self._tolerance, self._age = tolerance, age
        self._missing: Counter[str] = Counter()
        self._last = -math.inf

    def take(self, look: Look | None, began: float, clock: float, now: float, hand: NDArray[np.float64]) -> None:
        """Take in the newest look there is; raises :class:`Changed`, and :class:`Unwatched` (STALE_DATA) where none came for too long.

        began, clock: when the move began, and now, s by the clock of the stamps; now: by the monotonic clock of this process; hand
        (3,): where it is, m.
        """
        age = math.inf if look is None else max(clock - look.stamp, now - look.came)
        if look is None or not age <= self._age or clock - look.stamp < -AHEAD:
            raise Unwatched(
                Code.STALE_DATA,
                "age in s of the objects while the arm moves",
                round(age, 1),
                f"at most {self._age:g}: it is not moved blindly",
            )
        if look.stamp == self._last:
            return
        self._last = look.stamp
        partly = look.partly(self._planned, self._meant)
        there = scene_change.parts(self._planned.objects, look.objects, partly, self._tolerance)
        hidden = set(look.remembered).union(*there.values())
        strangers = look.objects.keys() - self._planned.objects.keys() - self._planned.remembered.keys() - partly
        shown = {name: before for name, before in self._planned.remembered.items() if name in look.objects}
        for name, before in {**shown, **self._planned.objects}.items():
            if name in self._meant or (name == self._target and look.stamp - began >= self._contact):
                continue
            handed_on = any(beyond(before, look.objects[other], False, self._tolerance) is None for other in strangers)
            if name not in look.objects:
                if name in hidden or handed_on:
                    self._missing[name] = 0
                    continue
                away = float((before - scene_change.hull(hand[None])).min())  # how deep the hand is in its hull; below 0: outside
                self._missing[name] = 0 if away > -HIDES else self._missing[name] + 1
                if self._missing[name] >= GONE:
                    raise Changed(Code.SCENE_CHANGED, f"{name} has gone while the arm moved", allowed="what the motion was planned for")
                continue
            self._missing[name] = 0
            moved = beyond(before, look.objects[name], name in partly, self._tolerance)
            if moved is not None and not handed_on:
                found, allowed = moved
                raise Changed(
                    Code.SCENE_CHANGED,
                    f"{name} has moved while the arm moved, in mm",
                    round(1000 * found, 1),
                    f"at most {1000 * allowed:g}",
                )


class Bounds:
    """How often, and for how long, a goal is tried anew.

    executions: how often the arm begins at most, ``replans``: how often a motion is planned anew because something is elsewhere,
    both of one goal; ``end``: the moment (of a monotonic clock, s) after which nothing is begun any more.
    """

    def __init__(self, executions: int, replans: int, end: float) -> None:
        self.executions, self.replans, self.end = executions, replans, end
        self.executed, self.replanned = 1, 0

    def fail(self, error: MagicError, now: float) -> None:
        """An execution has failed: count the next one; raises the failure, with what bounds it, where there is none."""
        if self.executed >= self.executions:
            raise self._over(error, error.code, f"{self.executed} executions are over (parameter loop.executions)")
        self._in_time(error, error.code, now)
        self.executed += 1

    def elsewhere(self, error: MagicError, code: Code, now: float) -> None:
        """Something is elsewhere: count the next plan; raises ``code``, with what bounds it, where there is none."""
        if self.replanned >= self.replans:
            raise self._over(error, code, f"the motion was planned anew {self.replanned} times (parameter loop.replans)")
        self._in_time(error, code, now)
        self.replanned += 1

    def _in_time(self, error: MagicError, code: Code, now: float) -> None:
        if now >= self.end:
            raise self._over(error, code, "the time for trying again is over (parameter loop.time)")

    @staticmethod
    def _over(error: MagicError, code: Code, why: str) -> MagicError:
        return MagicError(code, f"{error.message}; {why}")
