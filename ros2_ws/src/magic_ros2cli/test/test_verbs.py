"""The verbs of the small ros2 command against a node in a process and a domain of its own, in ros2cli's output shape."""

from __future__ import annotations

import concurrent.futures
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from magic_core.domain import free_domain

HERE = Path(__file__).parent
ENVIRONMENT = {
    **os.environ,
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "PYTHONUNBUFFERED": "1",
}
ROS2 = [sys.executable, "-c", "import sys; from magic_ros2cli.main import main; sys.exit(main())"]
TIMEOUT = 60.0
#: The output of commands of ros2cli 0.32 on the graph of ``small_node.py``.  Written from ros2cli's own format strings and from what its
#: own tests expect: ros2cli itself does not run without a ROS installation.
RECORDED = HERE / "ros2cli.txt"


def ros2(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*ROS2, *arguments], env=ENVIRONMENT, capture_output=True, text=True, timeout=TIMEOUT)


def out(*arguments: str) -> str:
    result = ros2(*arguments)
    assert result.returncode == 0, result.stderr
    return result.stdout


def outs(*commands: tuple[str, ...]) -> list[str]:
    """Outputs of several commands that run at the same time: what takes long in each is the discovery of the graph, up to 3 s."""
    pipe = subprocess.PIPE
    running = [subprocess.Popen([*ROS2, *c], env=ENVIRONMENT, stdout=pipe, stderr=pipe, text=True) for c in commands]
    answers = [process.communicate(timeout=TIMEOUT) for process in running]
    assert [p.returncode for p in running] == [0] * len(running), [error for _, error in answers]
    return [text for text, _ in answers]


class Follow:
    """A command that is left running; :meth:`until` reads its output up to a pattern, with a deadline."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(arguments, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        os.set_blocking(self.process.stdout.fileno(), False)
        self.text = ""

    def until(self, pattern: str) -> str:
        deadline = time.monotonic() + TIMEOUT
        while not re.search(pattern, self.text):
            assert time.monotonic() < deadline, f"no {pattern!r} in {self.text!r}"
            self.text += (self.process.stdout.read() or b"").decode()
            if self.process.poll() is not None:
                self.text += (self.process.stdout.read() or b"").decode()
                assert re.search(pattern, self.text), f"ended with {self.process.returncode}: {self.text!r}"
            time.sleep(0.01)
        return self.text

    def end(self, number: int = signal.SIGINT) -> int:
        self.process.send_signal(number)
        status = self.process.wait(TIMEOUT)
        self.text += (self.process.stdout.read() or b"").decode()
        return status


@pytest.fixture(scope="module", autouse=True)
def domain() -> None:
    """Drawn when the tests begin: one drawn while they are collected is free for others until then."""
    ENVIRONMENT["ROS_DOMAIN_ID"] = str(free_domain(for_good=True))


@pytest.fixture(scope="module")
def small() -> Iterator[Follow]:
    node = Follow(sys.executable, str(HERE / "small_node.py"))
    node.until("ready")
    yield node
    assert node.end() == 0


def test_help_and_unknown_words() -> None:
    assert "topic      echo, hz, info, list, pub, type" in out()
    assert out("--help") == out()
    for words, names in ((("nonsense",), "topic"), (("topic", "nonsense"), "echo")):
        result = ros2(*words)
        assert result.returncode == 2
        assert "'nonsense'" in result.stderr and names in result.stderr and len(result.stderr.splitlines()) == 1


def test_run_replaces_itself_by_the_executable(tmp_path: Path) -> None:
    assert ros2("run", "no_such_package", "x").stderr == "Package 'no_such_package' not found\n"
    prefix = fake_package(tmp_path, '#!/bin/sh\necho $$ "$@"\nexit 7\n')
    environment = {**ENVIRONMENT, "AMENT_PREFIX_PATH": f"{prefix}:{ENVIRONMENT['AMENT_PREFIX_PATH']}"}
    with subprocess.Popen([*ROS2, "run", "fake", "tool", "-a", "b c"], env=environment, stdout=subprocess.PIPE, text=True) as process:
        text, _ = process.communicate(timeout=TIMEOUT)
        assert text == f"{process.pid} -a b c\n" and process.returncode == 7
    result = subprocess.run([*ROS2, "run", "fake", "absent"], env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    assert (result.returncode, result.stderr) == (1, "No executable found\n")


def fake_package(folder: Path, script: str) -> Path:
    index = folder / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "fake").touch()
    (folder / "lib" / "fake").mkdir(parents=True)
    tool = folder / "lib" / "fake" / "tool"
    tool.write_text(script)
    tool.chmod(0o755)
    return folder


def test_lists(small: Follow) -> None:
    nodes, topics, plain, services, kind, actions = outs(
        ("node", "list"),
        ("topic", "list", "-t"),
        ("topic", "list"),
        ("service", "list", "-t"),
        ("service", "type", "/switch"),
        ("action", "list", "-t"),
    )
    assert nodes == "/cycling\n/small\n"
    assert {"/latched [std_msgs/msg/String]", "/image [sensor_msgs/msg/Image]"} <= set(topics.splitlines())
    assert "/latched" in plain.splitlines()
    assert "/switch [std_srvs/srv/SetBool]" in services.splitlines() and "_action" not in services
    assert kind == "std_srvs/srv/SetBool\n"
    assert actions == "/work [magic_interfaces/action/RunStrategy]\n"


def test_topic_info(small: Follow) -> None:
    short, verbose = outs(("topic", "info", "/latched"), ("topic", "info", "-v", "/latched"))
    assert short == "Type: std_msgs/msg/String\nPublisher count: 1\nSubscription count: 0\n"
    assert "Node name: small" in verbose and "Durability: TRANSIENT_LOCAL" in verbose and "Endpoint type: PUBLISHER" in verbose
    result = ros2("topic", "info", "/nowhere")
    assert (result.returncode, result.stderr) == (1, "Unknown topic '/nowhere'\n")


def test_topic_echo(small: Follow) -> None:
    once = ("topic", "echo", "--once")
    latched, image, full, bare, field = outs(
        (*once, "/latched"),
        (*once, "/image"),
        (*once, "--full-length", "/image"),
        (*once, "--no-arr", "/image"),
        (*once, "--field", "encoding", "/image"),
    )
    # Latched before this subscriber came: the QoS has to be matched to the publisher's.
    assert latched == "data: kept\n---\n"
    assert image.startswith("header:\n  stamp:\n    sec: 0\n    nanosec: 0\n  frame_id: ''\nheight: 2\nwidth: 100\n")
    assert image.count("\n- 0") == 128 and image.endswith("- '...'\n---\n")
    assert full.count("\n- 0") == 200
    assert "data: '<sequence type: uint8, length: 200>'" in bare
    assert field == "mono8\n---\n"
    assert "no field 'nonsense'" in ros2("topic", "echo", "--once", "--field", "nonsense", "/image").stderr


def test_topic_hz(small: Follow) -> None:
    hz = Follow(*ROS2, "topic", "hz", "/image")
    # On a busy machine the first second may bring what was late; the window grows over the later ones.
    text = hz.until(r"(average rate: [\d.]+\n\tmin: [\d.]+s max: [\d.]+s std dev: [\d.]+s window: \d+\n){4}")
    assert hz.end() == signal.SIGINT and "Traceback" not in hz.text
    assert float(re.findall(r"average rate: ([\d.]+)", text)[-1]) == pytest.approx(20, rel=0.3)


def test_topic_pub(small: Follow) -> None:
    text = out("topic", "pub", "--once", "/heard", "std_msgs/msg/String", "{data: hello}")
    assert "publisher: beginning loop\npublishing #1: std_msgs.msg.String(data='hello')\n" in text
    small.until("heard hello")
    out("topic", "pub", "-r", "20", "-t", "3", "/heard", "std_msgs/msg/String", "data: again")
    small.until("(heard again\n){3}")
    for arguments, word in (
        (("std_msgs/msg/Nope",), "std_msgs/msg/Nope"),
        (("std_msgs/msg/String", "{nope: 1}"), "nope"),
        (("std_msgs/msg/UInt8", "{data: 300}"), "300"),
        (("std_msgs/msg/UInt8", "{data: [1]}"), "[1]"),
        (("std_msgs/msg/UInt8", "3"), "3"),
    ):
        result = ros2("topic", "pub", "--once", "/heard", *arguments)
        assert result.returncode == 1 and word in result.stderr and "Traceback" not in result.stderr


def test_service_call(small: Follow) -> None:
    text = out("service", "call", "/switch", "std_srvs/srv/SetBool", "{data: true}")
    assert "requester: making request: std_srvs.srv.SetBool_Request(data=True)\n\n" in text
    assert "response:\nstd_srvs.srv.SetBool_Response(success=True, message='switched')\n" in text


def test_action_send_goal(small: Follow) -> None:
    text = out("action", "send_goal", "--feedback", "/work", "magic_interfaces/action/RunStrategy", "{strategy: short}")
    assert re.search(r"Sending goal:\n     strategy: short\n", text)
    assert re.search(r"Goal accepted with ID: [0-9a-f]{32}\n", text)
    assert "Feedback:\n    stage: match\n" in text
    assert "message: did short\n" in text and text.endswith("Goal finished with status: SUCCEEDED\n")


def test_interrupt_cancels_the_goal(small: Follow) -> None:
    goal = Follow(*ROS2, "action", "send_goal", "-f", "/work", "magic_interfaces/action/RunStrategy", "{strategy: long}")
    goal.until("Feedback:")
    goal.end()
    assert "Canceling goal..." in goal.text and "Goal canceled." in goal.text
    assert "Goal finished with status: CANCELED" in goal.text and "Traceback" not in goal.text


def test_parameters(small: Follow) -> None:
    listed, everything, gain, sizes, label = outs(
        ("param", "list", "/small"),
        ("param", "list"),
        ("param", "get", "/small", "gain"),
        ("param", "get", "/small", "sizes"),
        ("param", "get", "--hide-type", "/small", "label"),
    )
    assert "  gain\n" in listed and re.search(r"/small:\n(  \w.*\n)*  gain\n", everything)
    assert (gain, sizes, label) == ("Double value is: 0.5\n", "Double values are: [1.0, 2.5]\n", "one\n")
    assert out("param", "set", "/small", "count", "4") == "Set parameter successful\n"
    assert out("param", "get", "/small", "count") == "Integer value is: 4\n"
    absent = ros2("param", "get", "/small", "absent")
    assert (absent.returncode, absent.stderr) == (1, "Parameter not set\n")
    refused = ros2("param", "set", "/small", "gain", "-1.5")
    assert (refused.returncode, refused.stdout) == (1, "Setting parameter failed: gain is below 0\n")
    result = ros2("param", "get", "/nobody", "x")
    assert (result.returncode, result.stderr) == (1, "Node not found\n")


def test_interface_show() -> None:
    text = out("interface", "show", "geometry_msgs/msg/PoseStamped")
    assert "std_msgs/Header header\n\tbuiltin_interfaces/Time stamp\n\t\tint32 sec\n" in text and text.startswith("# A Pose with")
    bare = out("interface", "show", "--no-comments", "magic_interfaces/srv/MatchContact")
    assert "#" not in bare and "\n---\n" in bare
    assert ros2("interface", "show", "std_msgs/msg/Nope").returncode == 1


def test_bag_verbs(small: Follow, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    record = Follow(*ROS2, "bag", "record", "-o", str(bag), "-s", "mcap", "/latched")
    record.until("Subscribed to topic '/latched'")
    deadline = time.monotonic() + TIMEOUT
    while record.end() != 0:
        assert time.monotonic() < deadline
    assert "Topic: /latched | Type: std_msgs/msg/String | Count: 1 | Serialization Format: cdr" in out("bag", "info", str(bag))
    assert "played 1 messages" in ros2("bag", "play", str(bag), "--rate", "2.0").stderr
    result = ros2("bag", "play", str(tmp_path / "absent"))
    assert result.returncode == 1 and "no such bag" in result.stderr


def recorded() -> Iterator[tuple[str, list[str]]]:
    """Each command with the lines that it prints; an exit status that is not 0 is the last of them."""
    command, lines = "", []
    for line in RECORDED.read_text().splitlines():
        if line.startswith("$ ros2 "):
            if command:
                yield command, lines
            command, lines = line.removeprefix("$ ros2 "), []
        else:
            lines.append(line)
    yield command, lines


@pytest.fixture(scope="module")
def printed(small: Follow) -> dict[str, list[str]]:
    """What the commands print, several at a time: what takes long in each is the discovery of the graph."""

    def lines(command: str) -> list[str]:
        result = ros2(*shlex.split(command))
        found = (result.stdout + result.stderr).splitlines()
        return [*found, f"exit status {result.returncode}"] if result.returncode else found

    commands = [command for command, _ in recorded()]
    with concurrent.futures.ThreadPoolExecutor(6) as pool:
        return dict(zip(commands, pool.map(lines, commands), strict=True))


@pytest.mark.parametrize(("command", "lines"), [pytest.param(c, lines, id=c) for c, lines in recorded()])
def test_it_prints_what_ros2cli_prints(printed: dict[str, list[str]], command: str, lines: list[str]) -> None:
    assert printed[command] == lines


def test_a_lifecycle_is_gone_through(small: Follow) -> None:
    for transition, state in (
        ("configure", "inactive [2]"),
        ("activate", "active [3]"),
        ("4", "inactive [2]"),
        ("cleanup", "unconfigured [1]"),
    ):
        assert out("lifecycle", "set", "/cycling", transition) == "Transitioning successful\n"
        assert out("lifecycle", "get", "cycling") == f"{state}\n"
    every = out("lifecycle", "list", "/cycling", "-a").splitlines()
    assert len(every) == 3 * 25 and every[:3] == ["- configure [1]", "\tStart: unconfigured", "\tGoal: configuring"]


def test_packages_and_their_executables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prefix = fake_package(tmp_path, "#!/bin/sh\n")
    (prefix / "lib" / "fake" / "notes.txt").write_text("not to be run")
    monkeypatch.setitem(ENVIRONMENT, "AMENT_PREFIX_PATH", f"{prefix}:{ENVIRONMENT['AMENT_PREFIX_PATH']}")
    names = out("pkg", "list").splitlines()
    assert names == sorted(set(names)) and {"fake", "rclpy"} <= set(names)
    assert out("pkg", "prefix", "fake") == f"{prefix}\n"
    assert out("pkg", "prefix", "--share", "fake") == f"{prefix}/share/fake\n"
    assert out("pkg", "executables", "fake") == "fake tool\n"
    assert out("pkg", "executables", "--full-path", "fake") == f"{prefix}/lib/fake/tool\n"
