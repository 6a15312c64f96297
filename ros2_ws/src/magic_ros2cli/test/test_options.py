"""Every option of the small ros2 command is tried, from the command line, against what it is for."""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from magic_core.domain import free_domain
from magic_ros2cli import main

HERE = Path(__file__).parent
ENVIRONMENT = {
    **os.environ,
    "ROS_DOMAIN_ID": str(free_domain(for_good=True)),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "PYTHONUNBUFFERED": "1",
}
ROS2 = [sys.executable, "-c", "import sys; from magic_ros2cli.main import main; sys.exit(main())"]
TIMEOUT = 60.0

#: A command line, and what its output (both streams) has to hold; it is interrupted then, where it has not ended.  BAG and FOLDER stand
#: for a small bag and an empty folder, LAUNCH for a launch file.
TRIED: list[tuple[str, str]] = [
    ("topic list -t --include-hidden-topics", r"/work/_action/status \[action_msgs/msg/GoalStatusArray\]"),
    ("topic list -c", r"^\d+\n"),
    ("topic info -v /latched", "TRANSIENT_LOCAL"),
    ("topic echo --once --no-arr --no-str --flow-style /image", r"height: 2.*data: '<sequence type: uint8, length: 200>'"),
    ("topic echo --once -l 3 /image", r"- 0\n- 0\n- 0\n- '\.\.\.'"),
    ("topic echo --once -f --field data /image", "0"),
    ("topic echo --once --qos-reliability reliable --qos-durability transient_local --qos-depth 1 /latched", "data: kept"),
    ("topic echo --once --timeout 0.5 /silent std_msgs/msg/String", "(?i)timeout|0.5|no message"),
    ("topic hz -w 5 --qos-reliability best_effort --qos-durability volatile --qos-depth 5 /image", r"window: 5\n"),
    ("topic pub -r 20 -p 2 -w 1 --keep-alive 0.2 -n my_name -t 4 /heard std_msgs/msg/String data:\\ four", "publishing #4"),
    (
        "topic pub -1 --qos-reliability reliable --qos-durability volatile --qos-depth 3 /heard std_msgs/msg/String data:\\ x",
        "publishing #1",
    ),
    ("service list -t --include-hidden-services", r"/work/_action/send_goal \[magic_interfaces/action/RunStrategy_SendGoal\]"),
    ("service list -c", r"^\d+\n"),
    ("service call -r 5 /switch std_srvs/srv/SetBool {data:\\ true}", r"(?s)(response:.*){2}"),
    ("action list -t", r"/work \[magic_interfaces/action/RunStrategy\]"),
    ("action list -c", "^1\n"),
    ("action send_goal --stdin -f /work magic_interfaces/action/RunStrategy", "(?s)stage: match.*did short.*SUCCEEDED"),
    ("param list --filter ga.n /small", "^  gain\n$"),
    ("param get --hide-type /small label", "^one\n"),
    (
        "param dump /small",
        r'(?s)/small:\n  ros__parameters:\n.*    gain: 0.5\n    label: "one"\n    odd: 3\n    sizes:\n    - 1.0\n    - 2.5\n',
    ),
    ("node list -a", "(?s)/_ros2cli_.*/small"),
    ("node list -c", r"^\d+\n"),
    ("interface show --all-comments geometry_msgs/msg/PoseStamped", "(?s)# A Pose.*# "),
    ("interface show --no-comments geometry_msgs/msg/PoseStamped", r"^std_msgs/Header header\n\tbuiltin_interfaces/Time stamp"),
    ("lifecycle list -a /cycling", r"- configure \[1\]\n"),
    ("lifecycle nodes -a", r"/cycling\n"),
    ("node info --include-hidden /small", r"^/small\n  Subscribers:\n"),
    ("pkg executables --full-path magic_bags", r"/lib/magic_bags/bag_player\n"),
    ("pkg prefix --share magic_bags", r"/share/magic_bags\n$"),
    ("bag info -t BAG", "^/recorded\n$"),
    (
        "bag play BAG -r 2 -d 0.1 --start-offset 0.1 --playback-duration 0.5 --topics /recorded -m /recorded:=/heard",
        "played [1-9] messages",
    ),
    ("bag play BAG --clock 50 -l --exclude-topics /recorded", "nothing in the bag can be played"),
    ("bag play BAG --topics /nowhere", "no such topic"),
    (
        "bag record -o FOLDER/a -s mcap --compression-mode message --compression-format zstd --topics /latched",
        "Subscribed to topic '/latched'",
    ),
    ("bag record -o FOLDER/b -a --exclude-topics /latched", "Subscribed to topic '/image'"),
    ("bag record -o FOLDER/c -e ^/lat", "Subscribed to topic '/latched'"),
    ("launch -s LAUNCH", "'who':"),
    ("launch -p LAUNCH who:=me", "echo me"),
    ("launch -n -d LAUNCH who:=me", r"(?s)DEBUG.*\[echo-1\] me"),
    ("run --prefix env magic_bringup bag_player --help", "usage: bag_player"),
]


def parsers() -> dict[tuple[str, str], argparse.ArgumentParser]:
    """The parser of each verb, taken where the verb asks it."""

    class Found(Exception):
        pass

    found: dict[tuple[str, str], argparse.ArgumentParser] = {}
    original = argparse.ArgumentParser.parse_args

    def take(parser: argparse.ArgumentParser, *_: object, **__: object) -> None:
        raise Found(parser)

    argparse.ArgumentParser.parse_args = take  # type: ignore[method-assign,assignment]
    try:
        for command, verbs in main.VERBS.items():
            for verb in verbs:
                try:
                    main.dispatch([command, *filter(None, [verb]), "x"])
                except Found as caught:
                    found[command, verb] = caught.args[0]
    finally:
        argparse.ArgumentParser.parse_args = original  # type: ignore[method-assign]
    return found


def test_every_option_is_tried() -> None:
    found = parsers()
    assert set(found) == {(command, verb) for command, verbs in main.VERBS.items() for verb in verbs}
    # What is printed of some is held against ros2cli's own, line by line (test_verbs.py).
    compared = [line.removeprefix("$ ros2 ") for line in (HERE / "ros2cli.txt").read_text().splitlines() if line.startswith("$ ros2 ")]
    lines = [*(line for line, _ in TRIED), *compared]
    untried = []
    for (command, verb), parser in found.items():
        words = {w for line in lines if line.startswith(f"{command} {verb}".strip() + " ") for w in line.split()}
        for action in parser._actions:
            if action.option_strings and "--help" not in action.option_strings and not words & set(action.option_strings):
                untried.append(f"ros2 {command} {verb} {'/'.join(action.option_strings)}")
    assert not untried


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """What each command said; several at a time, as most of it is waiting for the graph to be discovered."""
    folder = tmp_path_factory.mktemp("options")
    launch = folder / "one.launch.xml"
    launch.write_text('<launch><arg name="who"/><executable cmd="echo $(var who)" output="screen"/></launch>')
    bag = folder / "bag"
    write_bag(bag)
    with subprocess.Popen([sys.executable, str(HERE / "small_node.py")], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as node:
        assert "ready" in node.stdout.readline()
        try:
            with ThreadPoolExecutor(6) as pool:
                lines = [re.sub("BAG", str(bag), line).replace("FOLDER", str(folder)).replace("LAUNCH", str(launch)) for line, _ in TRIED]
                yield dict(zip((line for line, _ in TRIED), pool.map(run, lines, (wanted for _, wanted in TRIED))))
        finally:
            node.kill()


def write_bag(path: Path) -> None:
    from rclpy.serialization import serialize_message
    from std_msgs.msg import String

    from magic_bags.bag_file import BagWriter

    writer = BagWriter(path)
    writer.add_topic("/recorded", "std_msgs/msg/String")
    for number in range(10):
        writer.write("/recorded", 10**9 + number * 10**8, serialize_message(String(data=f"number {number}")))
    writer.close()


def run(line: str, wanted: str) -> str:
    """What a command said; a list of the graph is asked for again where the graph was not known yet."""
    deadline = time.monotonic() + TIMEOUT
    text = once(line, wanted)
    while " list " in line and not re.search(wanted, text) and time.monotonic() < deadline:
        text = once(line, wanted)
    return text


def once(line: str, wanted: str) -> str:
    command = subprocess.Popen(
        [*ROS2, *shlex.split(line)], env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    if "--stdin" in line:
        command.stdin.write(b"strategy: short")
    command.stdin.close()
    os.set_blocking(command.stdout.fileno(), False)
    text, deadline = "", time.monotonic() + TIMEOUT
    while command.poll() is None and not re.search(wanted, text) and time.monotonic() < deadline:
        text += (command.stdout.read() or b"").decode()
        time.sleep(0.02)
    with contextlib.suppress(subprocess.TimeoutExpired):  # those that go on are interrupted
        command.wait(1.5)
    if command.poll() is None:
        command.send_signal(signal.SIGINT)
        try:
            command.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            command.kill()
            text += "\nnot ended by SIGINT"
    return text + (command.stdout.read() or b"").decode()


@pytest.mark.parametrize("line, wanted", TRIED, ids=[line for line, _ in TRIED])
def test_what_a_command_with_these_options_says(outputs: dict[str, str], line: str, wanted: str) -> None:
    text = outputs[line]
    assert re.search(wanted, text), text
    assert "Traceback" not in text and "not ended by SIGINT" not in text, text


def test_what_was_recorded_with_options_is_in_the_bags(outputs: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> None:
    from magic_bags import bag_file

    folder = next(p for p in tmp_path_factory.getbasetemp().glob("options*") if (p / "a").is_dir())
    infos = {name: bag_file.info(folder / name) for name in "abc"}
    assert [t.name for t in infos["a"].topics] == ["/latched"] and infos["a"].compression == "zstd (message)"
    assert "/latched" not in [t.name for t in infos["b"].topics] and "/image" in [t.name for t in infos["b"].topics]
    assert [t.name for t in infos["c"].topics] == ["/latched"]
