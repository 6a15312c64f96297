"""Each node starts alone with default parameters, says what it waits for, and ends cleanly."""

import re
import shutil
import signal
from pathlib import Path

import pytest
import yaml
from ament_index_python.packages import get_package_share_directory

from magic_bringup.graph import NODES, Graph, Process
from magic_bringup.testing import DEADLINE, until
from magic_core.domain import free_domain, isolated


def test_every_node_starts_alone_ends_cleanly_and_starts_again_with_what_was_dumped(tmp_path):
    dumped = alone(tmp_path / "first", signal.SIGINT, {})
    for name, file in dumped.items():
        found = yaml.safe_load(file.read_text())[f"/{name}"]["ros__parameters"]
        assert found.keys() >= {"use_sim_time"} | yaml.safe_load(own_file(name).read_text())["/**"]["ros__parameters"].keys()
    again = alone(tmp_path / "second", signal.SIGTERM, dumped)
    assert {name: file.read_text() for name, file in again.items()} == {name: file.read_text() for name, file in dumped.items()}


def alone(folder, number, given):
    """Start each node, with the given parameter files, dump its parameters, end it by a signal: the dumped files."""
    # Alone: each in a domain of its own. At the same time, because most of a start is waiting for the disk.
    with Graph(folder, isolated()) as graph:
        taken, dumps = (), {}
        for name, (package, program) in NODES.items():
            taken += (free_domain(exclude=taken),)
            graph.env = isolated(taken[-1])
            arguments = ("--ros-args", "--params-file", str(given[name])) if name in given else ()
            graph.start(name, package, program, *arguments)
            dumps[name] = [shutil.which("ros2"), "param", "dump", f"/{name}"], graph.env
        for name, process in graph.processes.items():
            until(lambda p=process: re.search("waiting for", p.tail(50)) or p.status is not None, what=f"{name} says what it waits for")
            assert process.status is None, process.tail(50)
        for name, (command, env) in dumps.items():
            dumps[name] = Process.start(f"dump of {name}", command, folder / f"{name}.yaml", env)
        for name, process in dumps.items():
            assert process.wait(DEADLINE) == 0, f"{name}: {process.tail(50)}"
        for process in graph.processes.values():
            process.signal(number)
        for name, process in graph.processes.items():
            assert process.wait(DEADLINE) == 0, f"{name}: {process.status}\n{process.tail(50)}"
            assert "Traceback" not in process.tail(50), process.tail(50)
    return {name: process.log for name, process in dumps.items()}


def own_file(name):
    """The installed parameter file of a node, with all of its parameters."""
    return Path(get_package_share_directory(NODES[name][0])) / f"config/{name}.param.yaml"


@pytest.mark.parametrize("name", list(NODES))
def test_a_parameter_out_of_range_is_refused_with_its_name(tmp_path, name):
    wrong = {
        "perception": ("segmenter", "magic"),
        "matcher": ("features", "magic"),
        "planner": ("timeout", "-1.0"),
        "verifier": ("timeout", "-1.0"),
        "strategy_server": ("timeout", "-1.0"),
    }[name]
    with Graph(tmp_path, isolated()) as graph:
        process = graph.start(name, *NODES[name], "--ros-args", "-p", f"{wrong[0]}:={wrong[1]}")
        assert process.wait(DEADLINE) not in (0, None)
        assert wrong[0] in process.tail(50)
