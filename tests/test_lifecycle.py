"""Each node starts alone with default parameters, says what it waits for, and ends cleanly."""

import re
import signal

import pytest

from magic_bringup.domain import free_domain, isolated
from magic_bringup.graph import NODES, Graph
from magic_bringup.testing import DEADLINE, until


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_every_node_starts_alone_and_ends_cleanly(tmp_path, number):
    # Alone: each in a domain of its own. At the same time, because most of a start is waiting for the disk.
    with Graph(tmp_path, isolated()) as graph:
        taken: tuple[int, ...] = ()
        for name, (package, program) in NODES.items():
            taken += (free_domain(exclude=taken),)
            graph.env = isolated(taken[-1])
            graph.start(name, package, program)
        for name, process in graph.processes.items():
            until(lambda p=process: re.search("waiting for", p.tail(50)) or p.status is not None, what=f"{name} says what it waits for")
            assert process.status is None, process.tail(50)
        for process in graph.processes.values():
            process.signal(number)
        for name, process in graph.processes.items():
            assert process.wait(DEADLINE) == 0, f"{name}: {process.status}\n{process.tail(50)}"
            assert "Traceback" not in process.tail(50), process.tail(50)


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
