"""One piece of work that is begun before it is known whether it will be asked for."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

T = TypeVar("T")


class Ahead(Generic[T]):
    """At most one piece of work at a time, known by its key, in a thread of its own.

    What is not asked for is canceled, and its end can be waited for, before which nothing else is to be begun in its place.  To be used
    from one thread.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "ahead")
        self._key: Hashable = None
        self._future: Future[T] | None = None
        self._cancel: Callable[[], None] = lambda: None

    def begin(self, key: Hashable, work: Callable[[], T], cancel: Callable[[], None]) -> None:
        """Begin ``work()``, which ends soon after ``cancel()`` was called; what was begun before is
        dropped, and this comes after its end."""
        self.drop()
        self._key, self._cancel, self._future = key, cancel, self._pool.submit(work)

    def take(self, key: Hashable) -> tuple[Future[T] | None, bool]:
        """What was begun last, with whether it is the work of this key, which is told once; else it is
        canceled.  ``None``: nothing was begun."""
        mine = self._future is not None and self._key == key
        if mine:
            self._key = None
        else:
            self.drop()
        return self._future, mine

    def drop(self) -> None:
        """What was begun is not wanted any more; does not wait for its end."""
        self._key = None
        if self._future is not None and not self._future.cancel():
            self._cancel()

    def clear(self) -> None:
        """Drop what was begun, and wait until nothing of it is under way."""
        self.drop()
        if self._future is not None:
            wait([self._future])
        self._future = None
