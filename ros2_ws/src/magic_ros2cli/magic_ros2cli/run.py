"""``ros2 run``: replaces this process by the node's, so that signals and the exit status are the node's own."""

from __future__ import annotations

import argparse
import os
import shlex
import sys

from magic_ros2cli import packages
from magic_ros2cli.errors import CommandError


def run(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 run", description="Run a package specific executable")
    parser.add_argument("--prefix", help="command to put in front of the executable (for example 'gdb -ex run --args')")
    parser.add_argument("package_name", help="name of the ROS package")
    parser.add_argument("executable_name", help="name of the executable")
    parser.add_argument("argv", nargs=argparse.REMAINDER, help="arguments of the executable")
    parsed = parser.parse_args(arguments)
    path = str(packages.executable(parsed.package_name, parsed.executable_name))
    command = [*shlex.split(parsed.prefix or ""), path, *parsed.argv]
    sys.stdout.flush()
    try:
        os.execvp(command[0], command)
    except OSError as error:
        raise CommandError(f"cannot run {command[0]}: {error.strerror}") from None
