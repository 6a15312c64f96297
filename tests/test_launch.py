"""The launch files: everything that they name exists, and the graph comes up through them."""

import re
import shutil
import signal
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from magic_bringup.domain import isolated
from magic_bringup.graph import NODES, Process, executable
from magic_bringup.testing import DEADLINE, until

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


@pytest.mark.parametrize("given, wanted", [([], False), (["respawn:=true"], True)])
def test_nodes_that_end_are_started_again_where_that_is_asked_for(given, wanted):
    from magic_ros2cli import launch_file

    path = launch_file.find("magic_bringup", "magic.launch.xml")
    processes = launch_file.parse(path, dict(a.split(":=") for a in given)).processes
    assert len(processes) == len(NODES)
    assert all(p.respawn is wanted and p.respawn_delay == 1.0 for p in processes)


def test_the_graph_comes_up_and_ends_through_ros2_launch(tmp_path):
    program = shutil.which("ros2")
    assert program, "there is no ros2 command"
    process = Process.start(
        "launch", [program, "launch", "magic_bringup", "magic.launch.xml", "features:=embedded"], tmp_path / "launch.log", isolated()
    )
    try:
        for name in NODES:
            until(
                lambda n=name: re.search(rf"\[{n}\]: .*(waiting for|ready)", process.tail(500)) or process.status is not None,
                what=f"{name} is up",
            )
        assert process.status is None, process.tail(50)
        process.signal(signal.SIGINT)
        assert process.wait(DEADLINE) is not None
        assert "Traceback" not in process.tail(500), process.tail(100)
    finally:
        process.signal(signal.SIGTERM)
        process.wait(10.0)
        process.signal(signal.SIGKILL)
