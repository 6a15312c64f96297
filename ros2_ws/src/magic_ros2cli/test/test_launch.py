"""Launch files: what they amount to, what is refused, and that processes get their signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from magic_ros2cli import launch_file
from magic_ros2cli.errors import CommandError
from magic_ros2cli.launch import Launcher, describe
from magic_ros2cli.launch_file import Process

FILE = """
<launch>
  <arg name="variant" default="fg" description="Who carries the tool."><choice value="fg"/><choice value="arm"/></arg>
  <arg name="seed" description="Of every random choice."/>
  <arg name="file" default="$(find-pkg-share fake)/config/fake.param.yaml"/>
  <let name="both" value="$(var variant)-$(env MAGIC_TEST_WORD none)"/>
  <group>
    <push_ros_namespace namespace="robot"/>
    <let name="inside" value="yes"/>
    <node pkg="fake" exec="tool" name="first" namespace="left" output="screen" args="--flag 'a b'" respawn="true" respawn_delay="0.5">
      <param name="seed" value="$(var seed)"/>
      <param name="label" value="12" type="str"/>
      <param name="on" value="true" unless="$(equals $(var variant) arm)"/>
      <param from="$(var file)"/>
      <remap from="objects" to="things"/>
      <env name="WORD" value="$(var both)"/>
    </node>
  </group>
  <include file="$(dirname)/other.launch.xml"><arg name="who" value="$(var variant) $(eval '1 + 2')"/></include>
  <executable cmd="echo $(var inside none)" if="$(eval '\\'$(var variant)\\' == \\'arm\\'')"/>
</launch>
"""
OTHER = '<launch><arg name="who"/><executable cmd="echo" args="\'$(var who)\'" name="other" output="both" on_exit="shutdown"/></launch>'


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package with an executable, a parameter file and a launch file that includes another."""
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "fake").touch()
    (tmp_path / "lib" / "fake").mkdir(parents=True)
    tool = tmp_path / "lib" / "fake" / "tool"
    tool.write_text("#!/bin/sh\nexit 0\n")
    tool.chmod(0o755)
    share = tmp_path / "share" / "fake"
    (share / "config").mkdir(parents=True)
    (share / "config" / "fake.param.yaml").write_text("/**:\n  ros__parameters:\n    seed: 1\n")
    (share / "launch").mkdir()
    (share / "launch" / "all.launch.xml").write_text(FILE)
    (share / "launch" / "other.launch.xml").write_text(OTHER)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    monkeypatch.setenv("MAGIC_TEST_WORD", "word")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    return launch_file.find("fake", "all.launch.xml")


def test_a_file_is_evaluated(file: Path, tmp_path: Path) -> None:
    node, other = launch_file.parse(file, {"seed": "7"}).processes
    assert node.command == (str(tmp_path / "lib" / "fake" / "tool"), "--flag", "a b")
    assert node.ros_arguments == ("-r", "__node:=first", "-r", "__ns:=/robot/left", "-r", "objects:=things")
    assert [(p.name, p.value) for p in node.parameters] == [("seed", 7), ("label", "12"), ("on", True), ("", None)]
    assert node.parameters[-1].file.endswith("fake.param.yaml")
    assert (node.output, node.respawn, node.respawn_delay, node.environment) == ("screen", True, 0.5, (("WORD", "fg-word"),))
    assert other.command == ("echo", "fg 3") and other.ends_launch and other.label == "other"


def test_conditions_and_scopes(file: Path) -> None:
    processes = launch_file.parse(file, {"seed": "7", "variant": "arm"}).processes
    assert "on" not in [p.name for p in processes[0].parameters]
    assert processes[-1].command == ("echo", "none")  # 'inside' was set in the group and is not known outside


def test_arguments_are_shown(file: Path) -> None:
    text = describe(launch_file.parse(file, {}, declared_only=True).arguments)
    assert text.startswith("Arguments (pass arguments as '<name>:=<value>'):\n\n    'variant': Valid choices are: ['fg', 'arm']\n")
    assert "        Who carries the tool.\n        (default: 'fg')\n" in text and "'seed':\n        Of every random choice.\n" in text
    assert "'who':" in text


@pytest.mark.parametrize(
    ("body", "given", "words"),
    [
        ("", {}, None),
        ('<arg name="a"/>', {}, "missing required argument 'a'"),
        ('<arg name="a"><choice value="x"/></arg>', {"a": "y"}, "Valid options are: ['x']"),
        ("<nodes/>", {}, "unknown tag <nodes>"),
        ('<node pkg="absent" exec="x"/>', {}, "Package 'absent' not found"),
        ('<node pkg="fake" exec="x"/>', {}, "No executable found"),
        ('<node pkg="fake" exec="tool" outputs="screen"/>', {}, "no attribute 'outputs'"),
        ('<node pkg="fake" exec="tool" output="loud"/>', {}, "'loud'"),
        ('<node pkg="fake" exec="tool"><param from="/no/such.yaml"/></node>', {}, "/no/such.yaml"),
        ('<executable cmd="x" if="maybe"/>', {}, "'maybe'"),
        ('<executable cmd="$(var b)"/>', {}, "'b' does not exist"),
        ('<executable cmd="$(nonsense b)"/>', {}, "$(nonsense)"),
        ('<executable cmd="$(var b"/>', {}, "not closed"),
        ('<executable cmd="$(eval 1/0)"/>', {}, "ZeroDivisionError"),
        ('<executable cmd="$(env NO_SUCH_VARIABLE)"/>', {}, "NO_SUCH_VARIABLE"),
        ('<include file="$(dirname)/bad.launch.xml"/>', {}, "includes itself"),
        ('<include file="x.launch.py"/>', {}, "*.xml"),
        ("<", {}, "no XML launch file"),
    ],
)
def test_what_is_wrong_is_named(file: Path, body: str, given: dict[str, str], words: str | None) -> None:
    path = file.parent / "bad.launch.xml"
    path.write_text(f"<launch>{body}</launch>")
    if words is None:
        assert launch_file.parse(path, given).processes == []
        return
    with pytest.raises(CommandError) as caught:
        launch_file.parse(path, given)
    assert words in str(caught.value)


def test_launcher_prefixes_and_reports(file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    script = "import sys, os; print('out', os.environ['WORD']); print('err', file=sys.stderr); sys.exit(3)"
    environment = (("WORD", "w"),)
    quiet = Process("quiet", (sys.executable, "-c", script), environment)
    loud = Process("loud", (sys.executable, "-c", script), environment, output="screen")
    absent = Process("absent", ("/no/such/program",))
    assert Launcher([quiet, loud, absent]).run() == 1
    text = capfd.readouterr().out
    assert "[loud-2] out w\n" in text and "[loud-2] err\n" in text and "[quiet-1] err\n" in text and "[quiet-1] out" not in text
    assert "[INFO] [loud-2]: process started with pid [" in text
    assert "[ERROR] [loud-2]: process has died [pid " in text and "exit code 3" in text
    assert "[ERROR] [absent-3]: process could not be started" in text
    logs = list(Path(os.environ["ROS_LOG_DIR"]).glob("*/quiet-1.log"))
    assert len(logs) == 1 and "out w" in logs[0].read_text()


def test_parameters_reach_the_node_typed(file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    script = "import sys; a = sys.argv; print(open(a[a.index('--params-file') + 1]).read())"
    parameters = (launch_file.Parameters(name="list", value=[1.0, 2.0]),)
    process = Process("node", (sys.executable, "-c", script), output="screen", is_node=True, parameters=parameters)
    assert Launcher([process]).run() == 0
    lines = [line.removeprefix("[node-1] ") for line in capfd.readouterr().out.splitlines() if line.startswith("[node-1]")]
    assert yaml.safe_load("\n".join(lines)) == {"/**": {"ros__parameters": {"list": [1.0, 2.0]}}}


def test_exit_of_one_ends_all_and_respawn_stops_then(file: Path, capfd: pytest.CaptureFixture[str]) -> None:
    again = Process("again", ("true",), respawn=True, respawn_delay=0.05)
    last = Process("last", ("sleep", "1.0"), ends_launch=True)
    waits = Process("waits", ("sleep", "60"))
    start = time.monotonic()
    assert Launcher([again, last, waits]).run() == 0
    assert time.monotonic() - start < 15
    text = capfd.readouterr().out
    assert text.count("[again-1]: process started") >= 2
    assert "[INFO] [waits-3]: sending signal 'SIGINT' to process[waits-3]" in text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_reach_the_processes(file: Path, number: int) -> None:
    path = file.parent / "waits.launch.xml"
    script = "import signal; print('waiting', flush=True); signal.sigwait([signal.SIGINT]); print('told to end', flush=True)"
    (file.parent / "waits.py").write_text("import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]);" + script)
    path.write_text(f'<launch><executable cmd="{sys.executable} $(dirname)/waits.py" name="waits" output="screen"/></launch>')
    code = "import sys; from magic_ros2cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "launch", "fake", "waits.launch.xml"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as launch:
        text = ""
        while "waiting" not in text:
            line = launch.stdout.readline()
            assert line, text
            text += line
        launch.send_signal(number)
        rest, _ = launch.communicate(timeout=20)
    assert launch.returncode == 0, text + rest
    assert "[waits-1] told to end" in rest and "process has finished cleanly" in rest
