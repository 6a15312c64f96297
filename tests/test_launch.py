"""The launch files: everything that they name exists, and the graph comes up through them."""

import os
import re
import shutil
import signal
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from magic_bringup.graph import NODES, Process, executable
from magic_bringup.testing import DEADLINE, until
from magic_core.domain import isolated

LAUNCH = Path(__file__).resolve().parents[1] / "ros2_ws/src/magic_bringup/launch"


@pytest.mark.parametrize("path", sorted(LAUNCH.glob("*.launch.xml")), ids=lambda p: p.name)
def test_what_launch_files_name_exists(path):
    root = ElementTree.parse(path).getroot()
    for argument in root.iter("arg"):
        if "value" not in argument.attrib:
            assert argument.get("description"), argument.get("name")
    for node in root.iter("node"):
        if node.get("pkg").startswith("magic_"):
            assert executable(node.get("pkg"), node.get("exec")).is_file()
    for package, relative in re.findall(r"\$\(find-pkg-share (\w+)\)/([\w/.]+)", path.read_text()):
        file = Path(get_package_share_directory(package)) / relative
        assert file.is_file(), file
        if file.suffix == ".yaml":
            content = yaml.safe_load(file.read_text())
            assert list(content) == ["/**"], "a node's bare name is not found under a namespace"
            assert content["/**"]["ros__parameters"]


def test_a_folder_of_strategies_is_given_to_all_who_read_strategies():
    root = ElementTree.parse(LAUNCH / "magic.launch.xml").getroot()
    given = {node.get("exec") for node in root.iter("node") for p in node.iter("param") if p.get("from") == "$(var strategies_file)"}
    assert given == set(NODES) - {"perception"}


@pytest.fixture
def own_files(tmp_path):
    """Parameter files of a user's own, in which what launch arguments could say is said."""
    for name, values in {
        "matcher": {"features": "embedded", "strategies": "/from/the/file", "use_sim_time": True},
        "server": {"strategies": "/from/the/file"},
    }.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    return [f"{name}_params:={tmp_path}/{name}.yaml" for name in ("matcher", "server")]


def parameters_of(program, *arguments):
    """What a launch file gives to a node in the end: its parameter files, the last one first, and so the first to be asked."""
    from magic_ros2cli import launch_file

    given = dict(a.split(":=") for a in arguments)
    path = launch_file.find("magic_bringup", "magic.launch.xml")
    process = next(p for p in launch_file.parse(path, given).processes if p.label == program)
    found = {}
    for part in process.parameters:
        found.update(yaml.safe_load(part.text or Path(part.file).read_text())["/**"]["ros__parameters"])
    return found


def test_parameter_files_win_over_arguments_that_are_not_given(own_files):
    found = parameters_of("matcher", *own_files)
    assert (found["features"], found["strategies"], found["use_sim_time"]) == ("embedded", "/from/the/file", True)
    assert parameters_of("strategy_server", *own_files)["strategies"] == "/from/the/file"


def test_arguments_that_are_given_win_over_parameter_files(own_files):
    given = ["features:=dinov2", "strategies:=/given", "use_sim_time:=false"]
    found = parameters_of("matcher", *own_files, *given)
    assert (found["features"], found["strategies"], found["use_sim_time"]) == ("dinov2", "/given", False)
    for program in ("planner", "verifier", "strategy_server"):
        assert parameters_of(program, *own_files, *given)["strategies"] == "/given"


def test_all_nodes_follow_the_laboratorys_clock_and_an_arm_is_moved_where_that_is_wanted():
    from magic_lab.scenarios import SCENARIOS
    from magic_ros2cli import launch_file

    path = launch_file.find("magic_bringup", "lab.launch.xml")

    def given(**arguments):
        found = {}
        for process in launch_file.parse(path, arguments).processes:
            values = found.setdefault(process.label, {})
            for part in process.parameters:
                named = {part.name: part.value} if part.name else None
                values.update(named or yaml.safe_load(part.text or Path(part.file).read_text())["/**"]["ros__parameters"])
        return found

    plain, other = given(), given(scenario="hanging", object="mug:46", seed="4", execute="false")
    assert set(plain) == {*NODES, "lab"}
    assert all(plain[name]["use_sim_time"] is True for name in NODES) and "use_sim_time" not in plain["lab"]
    assert plain["strategy_server"]["execute"] is True and other["strategy_server"]["execute"] is False
    assert [other["lab"][name] for name in ("scenario", "object", "seed")] == ["hanging", "mug:46", 4]
    choices = ElementTree.parse(LAUNCH / "lab.launch.xml").getroot().find("arg[@name='scenario']")
    assert {choice.get("value") for choice in choices} == set(SCENARIOS)


@pytest.mark.parametrize("given, wanted", [([], False), (["respawn:=true"], True)])
@pytest.mark.parametrize("name, more", [("magic.launch.xml", ()), ("replay.launch.xml", ("bag:=here",))])
def test_nodes_that_end_are_started_again_where_that_is_asked_for(name, more, given, wanted):
    from magic_ros2cli import launch_file

    path = launch_file.find("magic_bringup", name)
    processes = launch_file.parse(path, dict(a.split(":=") for a in (*given, *more))).processes
    nodes = [p for p in processes if p.label in NODES]
    assert len(nodes) == len(NODES)
    assert all(p.respawn is wanted and p.respawn_delay == 1.0 for p in nodes)
    assert [p.label for p in processes if p not in nodes] == ["bag_player"] * len(more)


def test_a_launched_graph_comes_up_with_its_files_starts_a_killed_node_again_and_ends(tmp_path):
    program = shutil.which("ros2")
    assert program, "there is no ros2 command"
    files = {"matcher": {"features": "embedded", "top_k": 2}, "server": {"timeout": 77.0}}
    for name, values in files.items():
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    given = ["respawn:=true", *(f"{name}_params:={tmp_path}/{name}.yaml" for name in files)]
    env = isolated()
    process = Process.start("launch", [program, "launch", "magic_bringup", "magic.launch.xml", *given], tmp_path / "launch.log", env)

    def up(name, times=1):
        # A node says it once for all that it waits for, or several times: what comes after its last start counts.
        text = process.log.read_text()
        begun = list(re.finditer(rf"\[{name}-\d+\]: process started with pid \[(\d+)\]", text))
        assert process.status is None, process.tail(50)
        ready = len(begun) == times and re.search(rf"\[{name}\]: .*(waiting for|ready)", text[begun[-1].end() :])
        return int(begun[-1][1]) if ready else None

    def value(node, name):
        return subprocess.run([program, "param", "get", "--hide-type", node, name], env=env, capture_output=True, text=True).stdout.strip()

    try:
        pids = {name: until(lambda n=name: up(n), what=f"{name} is up") for name in NODES}
        os.kill(pids["strategy_server"], signal.SIGKILL)
        assert (value("/matcher", "features"), value("/matcher", "top_k")) == ("embedded", "2")
        assert until(lambda: up("strategy_server", 2), what="it is there again") != pids["strategy_server"]
        assert value("/strategy_server", "timeout") == "77.0"
        process.signal(signal.SIGINT)
        assert process.wait(DEADLINE) is not None
        assert "Traceback" not in process.tail(500), process.tail(100)
    finally:
        process.signal(signal.SIGTERM)
        process.wait(10.0)
        process.signal(signal.SIGKILL)
