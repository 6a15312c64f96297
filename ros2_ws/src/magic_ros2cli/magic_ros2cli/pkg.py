"""``ros2 pkg`` list, prefix and executables."""

from __future__ import annotations

import argparse

from magic_ros2cli import packages
from magic_ros2cli.errors import CommandError


def pkg_list(arguments: list[str]) -> int:
    argparse.ArgumentParser(prog="ros2 pkg list", description="Output a list of available packages").parse_args(arguments)
    for name in packages.names():
        print(name)
    return 0


def pkg_prefix(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 pkg prefix", description="Output the prefix path of a package")
    parser.add_argument("package_name", help="the package name")
    parser.add_argument("--share", action="store_true", help="show share directory for the package")
    parsed = parser.parse_args(arguments)
    try:
        print(packages.share_of(parsed.package_name) if parsed.share else packages.prefix_of(parsed.package_name))
    except CommandError:
        raise CommandError("Package not found") from None
    return 0


def pkg_executables(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 pkg executables", description="Output a list of package specific executables")
    parser.add_argument("package_name", nargs="?", help="the package name")
    parser.add_argument("--full-path", action="store_true", help="show full path of each executable")
    parsed = parser.parse_args(arguments)
    for name in [parsed.package_name] if parsed.package_name else packages.names():
        for path in packages.executables_of(name):
            print(path if parsed.full_path else f"{name} {path.name}")
    return 0
