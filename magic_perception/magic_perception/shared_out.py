"""Work that this process and others beside it do together."""

from __future__ import annotations

import mmap
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
#: Another process is waited for so many times as long as this one took for what it did itself, and so many seconds more; then this one does
#: that as well.
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
    """``work``, a function of a module, of what is given and each of the items: of some of them in the processes that are ready to, of the
    others here.

    The dearest by costs are begun first.  Results do not depend on who did what.  A process that was killed, or is not heard of, is
    replaced.
    """
    with Shared(work, given, items, costs, workers) as shared:
        return shared.done()


class Shared(Generic[S, T, R]):
    """The same, begun by the others as soon as the context is entered: this process joins them in :meth:`done`.  What nobody has begun when
    the context is left is not done."""

    def __init__(self, work: Callable[[S, T], R], given: S, items: Sequence[T], costs: Sequence[float], workers: Workers | None) -> None:
        self._work, self._given, self._items, self._workers = work, given, items, workers
        # Those that nobody has begun, in their order, and what others are at.
        order = np.argsort(-np.asarray(costs, float), kind="stable").tolist()
        self._open, self._elsewhere, self._lock = deque(order), dict[int, Future[R]](), threading.Lock()
        self._path: Path | None = None
        self._begun = time.monotonic()

    def __enter__(self) -> Shared[S, T, R]:
        if self._workers is not None and self._workers.ready and len(self._items) > 1:
            self._path = _written(self._given)
            for _ in range(0 if self._path is None else self._workers.count):
                self._hand_out()
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._open.clear()
        for future in self._elsewhere.values():
            future.cancel()
        # They know this one by what they call when they are done: it would keep what was given until somebody looks for such circles.
        self._elsewhere.clear()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def done(self) -> list[R]:
        """What has been done of the items, in their order."""
        found: dict[int, R] = {}
        while (index := self._following()) is not None:
            found[index] = self._work(self._given, self._items[index])
        patience = self._begun + (1 + PATIENCE) * (time.monotonic() - self._begun) + MOMENT
        for index, future in self._elsewhere.items():
            try:
                found[index] = future.result(timeout=max(patience - time.monotonic(), 0.0))
            except (BrokenExecutor, CancelledError):
                continue
            except Late:
                assert self._workers is not None
                self._workers.begin_anew()
        # And here what a process was lost with.
        return [found[index] if index in found else self._work(self._given, self._items[index]) for index in range(len(self._items))]

    @property
    def left(self) -> int:
        """How many nobody has begun."""
        return len(self._open)

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
            assert self._workers is not None and self._path is not None
            future = self._workers.submit(_elsewhere, self._work, self._path, self._items[self._open[0]])
            if future is None:
                return
            self._elsewhere[self._open.popleft()] = future
        future.add_done_callback(self._hand_out)


def _elsewhere(work: Callable[[S, T], R], path: Path, item: T) -> R:
    return work(_read(path), item)


#: Arrays begin at multiples of so many bytes, as in memory.
ALIGNED = 64


def _written(given: object) -> Path | None:
    """A file of what is given, arrays as they are in memory; ``None`` where there is no room for it, or nowhere to write."""
    path = None
    try:
        number, name = tempfile.mkstemp(prefix="magic_")
        path = Path(name)
        arrays: list[pickle.PickleBuffer] = []
        rest = pickle.dumps(given, 5, buffer_callback=arrays.append)
        with open(number, "wb") as file:
            pickle.dump((rest, [array.raw().nbytes for array in arrays]), file)
            for array in arrays:
                file.seek(_aligned(file.tell()))
                file.write(array.raw())
            file.truncate()
    except OSError:
        if path is not None:
            path.unlink(missing_ok=True)
        return None
    return path


@lru_cache(maxsize=1)
def _read(path: Path) -> Any:
    """What is given to all of the items, read once: of the arrays what is looked at, where the file is in memory."""
    with open(path, "rb") as file:
        whole = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    rest, sizes = pickle.load(whole)
    arrays, at = [], whole.tell()
    for size in sizes:
        at = _aligned(at)
        arrays.append(memoryview(whole)[at : at + size])
        at += size
    return pickle.loads(rest, buffers=arrays)


def _aligned(at: int) -> int:
    """The next place, in bytes, at which an array may begin."""
    return -(-at // ALIGNED) * ALIGNED
