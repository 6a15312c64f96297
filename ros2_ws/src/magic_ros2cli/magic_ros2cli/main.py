"""Dispatch: which module has which verb. Nothing of ROS is imported before a verb needs it."""

from __future__ import annotations

import importlib
import os
import signal
import sys

from magic_core import environment
from magic_core.errors import MagicError
from magic_ros2cli.errors import CommandError

#: command -> verb -> module that has ``<command>_<verb>(arguments) -> int``; a command without verbs has the verb "".
VERBS: dict[str, dict[str, str]] = {
    "action": {"info": "action", "list": "action", "send_goal": "action"},
    "bag": {"info": "bag", "play": "bag", "record": "bag"},
    "interface": {"show": "interface"},
    "launch": {"": "launch"},
    "lifecycle": {"get": "lifecycle", "list": "lifecycle", "nodes": "lifecycle", "set": "lifecycle"},
    "node": {"info": "node", "list": "node"},
    "param": {"describe": "param", "dump": "param", "get": "param", "list": "param", "set": "param"},
    "pkg": {"executables": "pkg", "list": "pkg", "prefix": "pkg"},
    "run": {"": "run"},
    "service": {"call": "service", "list": "service", "type": "service"},
    "topic": {"echo": "topic", "hz": "topic", "info": "topic", "list": "topic", "pub": "topic", "type": "topic"},
}


def usage(command: str | None = None) -> str:
    """The text of ``ros2 --help`` and of ``ros2 <command> --help``."""
    if command is None:
        lines = ["usage: ros2 <command> ...", "", "Commands:"]
        lines += [f"  {name:10} {', '.join(v for v in verbs if v)}".rstrip() for name, verbs in VERBS.items()]
        lines += ["", "  Call `ros2 <command> <verb> -h` for more detailed usage."]
    else:
        lines = [f"usage: ros2 {command} <verb> ...", "", "Commands:"] + [f"  {verb}" for verb in VERBS[command]]
        lines += ["", f"  Call `ros2 {command} <verb> -h` for more detailed usage."]
    return "\n".join(lines)


def dispatch(arguments: list[str]) -> int:
    """Run one command; the exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0
    command, rest = arguments[0], arguments[1:]
    if command not in VERBS:
        raise CommandError(f"ros2: unknown command '{command}'; there are: {', '.join(VERBS)}", 2)
    verbs = VERBS[command]
    verb = ""
    if "" not in verbs:
        if not rest or rest[0] in ("-h", "--help"):
            print(usage(command))
            return 0
        verb, rest = rest[0], rest[1:]
        if verb not in verbs:
            raise CommandError(f"ros2 {command}: unknown verb '{verb}'; there are: {', '.join(verbs)}", 2)
    try:
        environment.prepare()
    except MagicError as error:
        raise CommandError(f"ros2: {error}") from None
    module = importlib.import_module(f"magic_ros2cli.{verbs[verb]}")
    return getattr(module, f"{command}_{verb}".rstrip("_"))(rest) or 0


def main() -> int:
    """Exit status as ros2cli's: 0, 1 for an error, 2 for a wrong command line, the signal's number after SIGINT or SIGTERM."""

    def terminate(_signum: int, _frame: object) -> None:
        raise SystemExit(int(signal.SIGTERM))

    signal.signal(signal.SIGTERM, terminate)
    try:
        # The script begins with SIGINT blocked: one that came while Python started is heeded here, without a traceback.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        status = dispatch(sys.argv[1:])
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # all is said: an interrupt of Python's own end would leave a traceback
        sys.stdout.flush()
        return status
    except CommandError as error:
        print(error, file=sys.stderr)
        return error.status
    except KeyboardInterrupt:
        return int(signal.SIGINT)
    except BrokenPipeError:
        # The reader (`| head`) has gone; without this the interpreter complains again while it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
