"""Processes that simulate rollouts beside this one."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from concurrent.futures import ProcessPoolExecutor


class Workers:
    """So many processes (0: none), each with the physics engine loaded; :meth:`close` ends them.

    They are spawned, not forked: a process with threads of ROS in it cannot be forked safely.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.executor: ProcessPoolExecutor | None = None
        if count > 0:
            context = multiprocessing.get_context("spawn")
            self.executor = ProcessPoolExecutor(count, mp_context=context, initializer=_ready, initargs=(os.getpid(),))
            for _ in range(count):  # a process is started with the first work that it is given
                self.executor.submit(_nothing)

    def close(self) -> None:
        """End the processes, whatever they are at: else this one would wait for it when it ends itself."""
        if self.executor is None:
            return
        # Python 3.14 has terminate_workers() for this.
        processes = list((self.executor._processes or {}).values())
        manager = self.executor._executor_manager_thread
        self.executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        if manager is not None:  # else it may close its pipe while the interpreter's end is writing to it
            manager.join(5.0)


def _ready(parent: int) -> None:
    """Load what the first rollout would otherwise wait for; leave signals to the process that asked for this one."""
    import signal

    import magic_verifier.verification  # noqa: F401
    from magic_core.threads import one_thread
    from magic_verifier.articulation import panda, prepare
    from magic_verifier.simulation import engine

    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread()
    engine()
    prepare(panda())


def _end_with(parent: int) -> None:
    """End with the process that asked for this one, also where that was killed."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _nothing() -> None:
    return
