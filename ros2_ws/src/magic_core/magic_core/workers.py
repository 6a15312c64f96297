"""Processes that work beside this one."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from typing import ParamSpec, TypeVar

P, R = ParamSpec("P"), TypeVar("R")


class Workers:
    """So many processes (0: none), each made ready by a function of a module; :meth:`close` ends them.

    They are spawned, not forked: a process with threads of ROS in it cannot be forked safely.
    """

    def __init__(self, count: int, ready: Callable[[], object]) -> None:
        self.count = count
        self.executor: ProcessPoolExecutor | None = None
        self._make_ready = ready
        self._begun: list[Future[None]] = []
        self._begin()

    def _begin(self) -> None:
        if self.count > 0:
            context = multiprocessing.get_context("spawn")
            self.executor = ProcessPoolExecutor(
                self.count, mp_context=context, initializer=_start_up, initargs=(os.getpid(), self._make_ready)
            )
            # A process is started with the first work that it is given.
            self._begun = [self.executor.submit(_nothing) for _ in range(self.count)]

    @property
    def ready(self) -> bool:
        """Whether what is given to them is begun at once."""
        return bool(self._begun) and all(future.done() for future in self._begun)

    def submit(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> Future[R] | None:
        """Have a function of a module computed; ``None`` where nobody is ready to.  Where one of them was killed all are begun anew, but
        not where one died as it began: the next would as well."""
        if self.executor is None or not self.ready:
            return None
        if any(future.cancelled() or future.exception() is not None for future in self._begun):
            self.close()
            return None
        try:
            return self.executor.submit(function, *args, **kwargs)
        except BrokenExecutor:
            self._begin()
            return None

    def begin_anew(self) -> None:
        """End them, whatever they are at, and begin others."""
        self.close()
        self._begin()

    def close(self) -> None:
        """End the processes, whatever they are at: else this one would wait for it when it ends itself."""
        if self.executor is None:
            return
        # Python 3.14 has kill_workers() for this; a process that stands still hears no milder word.
        processes = list((self.executor._processes or {}).values())
        manager = self.executor._executor_manager_thread
        self.executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        if manager is not None:  # else it may close its pipe while the interpreter's end is writing to it
            manager.join(5.0)
        self.executor = None


def _start_up(parent: int, ready: Callable[[], object]) -> None:
    """Load what the first work would otherwise wait for; leave signals to the process that asked for this one."""
    import signal

    from magic_core.threads import one_thread

    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ready()
    one_thread()


def _end_with(parent: int) -> None:
    """End with the process that asked for this one, also where that was killed."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _nothing() -> None:
    return
