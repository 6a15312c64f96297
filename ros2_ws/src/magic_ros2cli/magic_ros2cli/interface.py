"""``ros2 interface show``; reads the installed definitions and imports nothing of ROS."""

from __future__ import annotations

import argparse

from magic_bags.bag_file import nested_type
from magic_ros2cli import packages
from magic_ros2cli.errors import CommandError


def definition(name: str) -> str:
    """Text of an installed interface such as ``std_msgs/msg/String``."""
    parts = name.split("/")
    if len(parts) != 3 or parts[1] not in ("msg", "srv", "action"):
        raise CommandError(f"Invalid name '{name}'. Expected three parts separated by '/': package/msg|srv|action/Type")
    try:
        share = packages.share_of(parts[0])
    except CommandError:
        raise CommandError(f"Unknown package '{parts[0]}'") from None
    path = share / parts[1] / f"{parts[2]}.{parts[1]}"
    if not path.is_file():
        raise CommandError(f"Could not find the interface '{name}' in {share}")
    return path.read_text()


def lines(name: str, comments: bool = True, nested_comments: bool = False, level: int = 0) -> list[str]:
    """The lines of an interface, those of nested messages after the field that has them, one tab deeper for each level."""
    result = []
    for line in definition(name).splitlines():
        code, hash_sign, _ = line.partition("#")
        if "'" in code or '"' in code:  # a # inside a string constant or default is no comment
            code, hash_sign = line, ""
        if not comments:
            if not code.strip():
                continue
            line = code.rstrip() if hash_sign else line
        result.append("\t" * level + line.rstrip())
        nested = nested_type(code, name.split("/")[0])
        if nested is not None:
            result += lines(nested, nested_comments, nested_comments, level + 1)
    return result


def interface_show(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 interface show", description="Output the interface definition")
    parser.add_argument("type", help="show an interface definition (e.g. 'example_interfaces/msg/String')")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--all-comments", action="store_true", help="show all comments, including those of nested interfaces")
    group.add_argument("--no-comments", action="store_true", help="show no comments or whitespace")
    parsed = parser.parse_args(arguments)
    print("\n".join(lines(parsed.type, not parsed.no_comments, parsed.all_comments)))
    return 0
