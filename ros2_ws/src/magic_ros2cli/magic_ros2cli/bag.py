"""``ros2 bag`` info, play and record: the tools of magic_bags under ros2cli's names."""

from __future__ import annotations

import argparse

from magic_ros2cli.errors import CommandError


def bag_info(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 bag info", description="Print information about a bag to the screen")
    parser.add_argument("bag_path", help="bag to describe: a rosbag2 folder, or an .mcap or .db3 file")
    parser.add_argument("-t", "--topic-name", action="store_true", help="only display topic names")
    parsed = parser.parse_args(arguments)
    from magic_bags.bag_file import info
    from magic_core.errors import MagicError

    try:
        found = info(parsed.bag_path)
    except MagicError as error:
        raise CommandError(f"ros2 bag info: {error}") from None
    if parsed.topic_name:
        print("\n".join(t.name for t in found.topics))
    else:
        print(found.format())
    return 0


def bag_play(arguments: list[str]) -> int:
    from magic_bags.bag_player import main

    return _status(main, arguments)


def bag_record(arguments: list[str]) -> int:
    from magic_bags.bag_recorder import main

    return _status(main, arguments)


def _status(main: object, arguments: list[str]) -> int:
    try:
        main(arguments)
    except SystemExit as end:
        return int(end.code or 0)
    return 0
