"""Work that tests give to other processes, which load it from here: a module of tests is not theirs to load."""

import os
import signal
import time


def who(given, item):
    """The item, what was given, and the process; another process than that of the test lets it begin something first."""
    if os.getpid() != given:
        time.sleep(0.02 * item)
    return item, given, os.getpid()


def dies(given, item):
    """Whatever is begun elsewhere dies with its process."""
    if os.getpid() != given:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def stands_still(given, item):
    """Whatever is begun elsewhere is never done."""
    if os.getpid() != given:
        os.kill(os.getpid(), signal.SIGSTOP)
    return item


def refuses(_given, item):
    if item == 0:
        raise ValueError("no such thing")
    return item
