"""Processes that work beside this one are begun, replaced where they die, and end."""

import math
import os
import signal
import time
from concurrent.futures import BrokenExecutor
from functools import partial
from pathlib import Path

import pytest

from magic_core.workers import Workers


def wait_for(what, seconds=60.0):
    """Wait until it is true; a busy machine takes its time to begin a process."""
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return found


def test_none_are_begun_where_none_are_asked_for():
    none = Workers(0, dict)
    assert none.executor is None and not none.ready and none.submit(os.getpid) is None
    none.close()


def test_another_process_works_once_it_is_ready():
    workers = Workers(1, dict)
    try:
        assert workers.submit(os.getpid) is None or workers.ready
        wait_for(lambda: workers.ready)
        assert workers.submit(os.getpid).result(30.0) != os.getpid()
        assert workers.submit(math.hypot, 3.0, 4.0).result(30.0) == 5.0
    finally:
        workers.close()
    assert workers.submit(os.getpid) is None


def test_one_that_is_killed_is_replaced():
    workers = Workers(1, dict)
    try:
        wait_for(lambda: workers.ready)
        first = workers.submit(os.getpid).result(30.0)
        os.kill(first, signal.SIGKILL)
        with pytest.raises(BrokenExecutor):
            workers.submit(time.sleep, 60.0).result(30.0)
        assert workers.submit(os.getpid) is None  # others are begun
        wait_for(lambda: workers.ready)
        assert workers.submit(os.getpid).result(30.0) not in (first, os.getpid())
    finally:
        workers.close()


def test_one_that_dies_as_it_begins_is_not_begun_again():
    workers = Workers(1, partial(os._exit, 1))
    wait_for(lambda: workers.ready)
    assert workers.submit(os.getpid) is None and workers.executor is None
    assert workers.submit(os.getpid) is None


def test_one_that_stands_still_ends_with_the_others():
    workers = Workers(1, dict)
    wait_for(lambda: workers.ready)
    still = workers.submit(os.getpid).result(30.0)
    os.kill(still, signal.SIGSTOP)
    begin = time.monotonic()
    workers.close()
    assert time.monotonic() - begin < 30.0
    state = Path(f"/proc/{still}/stat")
    wait_for(lambda: not state.exists() or state.read_text().split()[2] == "Z")
