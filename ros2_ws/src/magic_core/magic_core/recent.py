"""What was made lately, kept up to a number of bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Recent(Generic[K, V]):
    """Values by key; of more than ``most`` bytes those go that were not asked for the longest.  The newest one always stays.

    By bytes and not by number: an object may have one convex piece or hundreds.
    """

    def __init__(self, most: int) -> None:
        self.most, self.held = most, 0
        self._known: OrderedDict[K, tuple[V, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._known)

    def get(self, key: K) -> V | None:
        """The value of a key, if it is still there."""
        found = self._known.get(key)
        if found is None:
            return None
        self._known.move_to_end(key)
        return found[0]

    def put(self, key: K, value: V, size: int) -> V:
        """Keep a value of ``size`` bytes for a key that has none; returns it."""
        self._known[key] = value, size
        self.held += size
        while self.held > self.most and len(self._known) > 1:
            self.held -= self._known.popitem(last=False)[1][1]
        return value
