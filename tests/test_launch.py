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
    given = {node.get("exec") for node in root.iter("node") for p in node.iter("param") if p.get("name") == "strategies"}
    assert given == set(NODES) - {"perception"}


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
