"""An executor with worker threads that waits for them instead of asking them without pause."""

from __future__ import annotations

import concurrent.futures
import threading
import time
import traceback

from rclpy.context import Context
from rclpy.executors import ConditionReachedException, Executor, ExternalShutdownException, ShutdownException, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.logging import get_logger
from rclpy.task import Task

#: Waits that fail for so many seconds in a row do not fail for what is just being destroyed; between two of them the thread that destroys
#: it is given time, s.
FAILING, PAUSE = 5.0, 0.001


class ThreadedExecutor(Executor):
    """Takes what comes in one thread, and has callbacks done by others; otherwise like rclpy's ``MultiThreadedExecutor``.

    That one goes on asking for a callback that it has handed to a thread until that thread has begun, and holds Python's lock
    while it does: with cameras at 30 Hz it takes a whole core, loses most of the images and holds up every computation.  This
    one waits until the thread has begun.

    An exception out of a callback is logged; the others go on.
    """

    def __init__(self, threads: int, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._pool = concurrent.futures.ThreadPoolExecutor(threads, thread_name_prefix="callback")
        self._handed: dict[concurrent.futures.Future[None], Task] = {}  # over to the threads, and not done yet
        self._taking = threading.Lock()  # held while callbacks are waited for: what is waited on must not be destroyed meanwhile
        self._closed = False
        self._failing: float | None = None  # since when, by the clock, waits have failed in a row

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback, and until a thread has begun it; each at most ``timeout_sec``, s."""
        begun = threading.Event()
        with self._taking:
            if self._closed:
                return
            try:
                callback, _, _ = self.wait_for_ready_callbacks(timeout_sec=timeout_sec, condition=self._is_closed)
            except (TimeoutException, ConditionReachedException, ShutdownException, ExternalShutdownException):
                self._failing = None
                return
            except _rclpy.RCLError:
                # An action server or client that another thread destroys between being listed and being waited for: rclpy leaves
                # the dead handle in its list.  The next wait lists anew.
                now = time.monotonic()
                self._failing = now if self._failing is None else self._failing
                if now - self._failing > FAILING:
                    raise
                time.sleep(PAUSE)
                return
            self._failing = None
            future = self._pool.submit(self._work, callback, begun)
            self._handed[future] = callback
        future.add_done_callback(self._handed.pop)
        future.add_done_callback(lambda _: begun.set())  # also where the shutdown cancels it
        # Where no thread is free by then, the callback comes once more, which does no harm: it is only done once.
        begun.wait(timeout_sec)

    def _is_closed(self) -> bool:
        return self._closed

    def _work(self, callback: Task, begun: threading.Event) -> None:
        begun.set()
        callback()
        error = callback.exception() if callback.done() else None
        if error is not None and not self._closed:  # what a node's entities say after its end is no news
            get_logger("executor").error("".join(traceback.format_exception(error)))

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Take nothing more, and wait for the callbacks at work; false where some have not ended in ``timeout_sec``, s."""
        self._closed = True
        self.wake()
        with self._taking:
            super().shutdown(timeout_sec)
            handed = dict(self._handed)
        self._pool.shutdown(wait=False, cancel_futures=True)
        for future, callback in handed.items():
            if future.cancelled():
                callback.cancel()
        return not concurrent.futures.wait([f for f in handed if not f.cancelled()], timeout_sec).not_done
