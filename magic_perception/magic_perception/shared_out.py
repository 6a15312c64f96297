"""Work that this process and others beside it do together."""

from __future__ import annotations

import pickle
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from concurrent.futures import TimeoutError as Late  # Python 3.10 has another one of its own
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from magic_core.workers import Workers

S, T, R = TypeVar("S"), TypeVar("T"), TypeVar("R")
#: Another process is waited for so many times as long as this one took for what it did itself, and so many seconds more; then this one does that as well.
PATIENCE, MOMENT = 5.0, 1.0


def perceiving(count: int) -> Workers:
    """So many processes (0: none), each with the libraries of perception loaded."""
    return Workers(count, _ready)


def _ready() -> None:
    import open3d  # noqa: F401
    import scipy.optimize
    import scipy.spatial  # noqa: F401

    import magic_perception.pipeline  # noqa: F401


def shared_out(work: Callable[[S, T], R], given: S, items: Sequence[T], costs: Sequence[float], workers: Workers | None) -> list[R]:
    """``work``, a function of a module, of what is given and each of the items: of some of them in the processes that are ready to, of the others here.

    The dearest by costs are begun first.  Results do not depend on who did what.  A process that was killed, or is not heard of, is replaced.
    """
    order = np.argsort(-np.asarray(costs, float), kind="stable").tolist()
    found: dict[int, R] = {}
    if workers is not None and workers.ready and len(items) > 1 and (path := _written(given)) is not None:
        try:
            found = _Shared(work, given, path, items, order, workers).done()
        finally:
            path.unlink(missing_ok=True)
    return [found[index] if index in found else work(given, items[index]) for index in range(len(items))]


def _written(given: object) -> Path | None:
    """A file of what is given; ``None`` where there is no room for it, or nowhere to write."""
    path = None
    try:
        number, name = tempfile.mkstemp(prefix="magic_")
        path = Path(name)
        with open(number, "wb") as file:
            pickle.dump(given, file, pickle.HIGHEST_PROTOCOL)
    except OSError:
        if path is not None:
            path.unlink(missing_ok=True)
        return None
    return path


class _Shared(Generic[S, T, R]):
    """Items by index, those that nobody has begun in their order, and what others are at."""

    def __init__(self, work: Callable[[S, T], R], given: S, path: Path, items: Sequence[T], order: list[int], workers: Workers) -> None:
        self._work, self._given, self._path, self._items, self._workers = work, given, path, items, workers
        self._open, self._elsewhere, self._lock = deque(order), dict[int, Future[R]](), threading.Lock()

    def done(self) -> dict[int, R]:
        """What has been done of them, here and elsewhere: all, but what a process was lost with."""
        begin = time.monotonic()
        for _ in range(self._workers.count):
            self._hand_out()
        found: dict[int, R] = {}
        while (index := self._following()) is not None:
            found[index] = self._work(self._given, self._items[index])
        patience = begin + (1 + PATIENCE) * (time.monotonic() - begin) + MOMENT
        for index, future in self._elsewhere.items():
            try:
                found[index] = future.result(timeout=max(patience - time.monotonic(), 0.0))
            except (BrokenExecutor, CancelledError):
                continue
            except Late:
                self._workers.begin_anew()
        # They know this one by what they call when they are done: it would keep what was given until somebody looks for such circles.
        self._elsewhere.clear()
        return found

    def _following(self) -> int | None:
        with self._lock:
            return self._open.popleft() if self._open else None

    def _hand_out(self, before: Future[R] | None = None) -> None:
        """Give another process the next one, as soon as it has done what it was given ``before``."""
        if before is not None and (before.cancelled() or before.exception() is not None):
            return
        with self._lock:
            if not self._open:
                return
            future = self._workers.submit(_elsewhere, self._work, self._path, self._items[self._open[0]])
            if future is None:
                return
            self._elsewhere[self._open.popleft()] = future
        future.add_done_callback(self._hand_out)


def _elsewhere(work: Callable[[S, T], R], path: Path, item: T) -> R:
    return work(_read(path), item)


@lru_cache(maxsize=1)
def _read(path: Path) -> Any:
    """What is given to all of the items, read once."""
    return pickle.loads(path.read_bytes())
