"""How an installed executable begins: what can go wrong before its module is imported is said in one line.  Imports nothing of ROS."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import signal
import sys
from collections.abc import Callable

from magic_core import environment, viewerless
from magic_core.errors import MagicError


def version(package: str = "magic_core") -> str:
    """The version of an installed package of this project, from its package.xml by way of setup.py."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # used from its folder, without an installation
        return "not installed"


def program(module: str, function: str = "main") -> Callable[[], object]:
    """An entry point that prepares the environment, imports a module and calls its function.

    The imports take seconds.  Ctrl-C during them ends the process as a signal does, without a traceback.  What comes before, Python's own
    start and the script's, is a quarter of a second in which nothing can be caught: ``setup.sh`` makes the installed scripts begin with
    SIGINT blocked, and one that came meanwhile is heeded here.  ``--version`` alone is answered without the imports.
    """
    package = module.partition(".")[0]

    def begin() -> object:
        before = signal.getsignal(signal.SIGINT)
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        if sys.argv[1:] == ["--version"]:
            print(f"{package} {version(package)}")
            return 0
        try:
            environment.prepare()
        except MagicError as error:
            print(f"{package}: {error}", file=sys.stderr)
            return 1
        viewerless.prepare()
        main = getattr(importlib.import_module(module), function)
        signal.signal(signal.SIGINT, before)
        try:
            return main()
        except BrokenPipeError:
            # Who read what is said has gone, as ``head`` does: no fault, and nothing more to say, at Python's end either.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 128 + signal.SIGPIPE

    begin.__doc__ = f"Begin ``{module}.{function}``."
    return begin
