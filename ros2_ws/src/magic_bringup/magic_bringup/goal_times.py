"""How long the graph takes from a goal to its verdict, the objects being known: ``ros2 run magic_bringup goal_times``.

For each task its bag is replayed to the five nodes until perception has published objects, and then stopped; perception stays, and has
nothing to do.  Then the same goal is sent again and again, each motion simulated once, as given (``--rollouts``).  Told are the seconds by
the clock of each stage, from goal to answer at the client, and of the processors that the nodes have spent, which a busy machine
lengthens less; and those of the first goal beside those of the others, which find what it has left: of the same objects the matcher
knows the answer.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from magic_bringup.demo import Options, Watcher, look_into
from magic_bringup.graph import NODES, Graph
from magic_core import environment
from magic_core.domain import isolated
from magic_core.errors import Code, MagicError

TASKS = ("hooking", "hanging", "scooping")
STAGES = ("match", "plan", "verify", "total")
#: Waited for the graph to come up and for objects, and for one answer, s.
START, ANSWER = 180.0, 120.0


@dataclass(frozen=True)
class Run:
    """One goal: its code, how many candidates were tried, seconds by stage, at the client from goal to answer, and of the processors
    by node.  first: of its task and variant."""

    task: str
    variant: str
    code: str
    tried: int
    seconds: dict[str, float]
    client: float
    processors: dict[str, float]
    first: bool = False


def processor_seconds(pid: int, proc: Path = Path("/proc")) -> float:
    """Seconds of the processors that a process and its living descendants have spent."""
    parents: dict[int, list[int]] = {}
    spent: dict[int, float] = {}
    for entry in proc.iterdir():
        if entry.name.isdigit():
            try:
                # The name in brackets may hold blanks.
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(fields[1]), []).append(int(entry.name))
            spent[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    total, family = 0.0, [pid]
    while family:
        member = family.pop()
        total += spent.get(member, 0.0)
        family += parents.get(member, [])
    return total


def table(runs: Sequence[Run]) -> str:
    """One line for each task and variant: what the first goal took, the median over the others, and the least of the time at the client."""
    lines = ["| task, variant | first: match | total | others | match | plan | verify | total | client | least | processors | tried |"]
    lines.append("|" + " --- |" * 12)
    for key in dict.fromkeys((run.task, run.variant) for run in runs):
        every = [run for run in runs if (run.task, run.variant) == key]
        first, mine = next((run for run in every if run.first), None), [run for run in every if not run.first]
        cells = [*(f"{first.seconds[s]:.2f}" for s in ("match", "total"))] if first is not None else ["", ""]
        client = [run.client for run in mine]
        busy = float(np.median([sum(run.processors.values()) for run in mine]))
        cells += [str(len(mine)), *(f"{np.median([run.seconds[s] for run in mine]):.2f}" for s in STAGES)]
        cells += [f"{np.median(client):.2f}", f"{min(client):.2f}", f"{busy:.2f}"]
        tried = "/".join(map(str, sorted({run.tried for run in every})))
        codes = sorted({run.code for run in every} - {"OK"})
        lines.append(f"| {', '.join(key)} | {' | '.join(cells)} | {tried}{' ' + ', '.join(codes) if codes else ''} |")
    return "\n".join(lines)


def measure(task: str, variants: Sequence[str], count: int, rollouts: int, bags: Path, scratch: Path) -> list[Run]:
    """The runs of one task, of a graph of its own; raises what keeps it from coming up."""
    bag = bags / task
    topics, _ = look_into(bag)
    env = isolated()
    os.environ.update({k: env[k] for k in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")})
    server = {"recorded": True, "repetitions": rollouts, "required_rate": 0.0 if rollouts == 1 else 0.7}
    runs = []
    with Graph(scratch, env) as graph:
        graph.start_nodes({"strategy_server": server})
        watcher = Watcher(topics, lambda line: None)
        try:
            _until(lambda: not watcher.ready(), START, f"the graph of {task}", graph)
            graph.start("bag_player", "magic_bringup", "bag_player", str(bag), "--loop", "--delay", "0.7")
            _until(lambda: watcher.objects_at is not None, START, f"objects of {bag}", graph)
            graph.stop(["bag_player"])
            # Of a goal's time, none is to be this process's own, in which the collector would walk through all that it has imported.
            gc.collect()
            gc.freeze()
            pids = {name: graph.processes[name].popen.pid for name in NODES}
            for variant in variants:
                options = Options(task, variant, bag, scratch, timeout=ANSWER, pictures=False)
                runs += [replace(_run(watcher, options, pids, graph), first=not index) for index in range(count + 1)]
        finally:
            watcher.close()
    return runs


def _run(watcher: Watcher, options: Options, pids: Mapping[str, int], graph: Graph) -> Run:
    before, began = {name: processor_seconds(pid) for name, pid in pids.items()}, time.monotonic()
    pending = watcher.send(options)
    with watcher.changed:
        while pending.result is None and time.monotonic() < began + 2 * ANSWER:
            watcher.changed.wait(0.05)
            graph.check()
    client, result = time.monotonic() - began, pending.result
    if result is None:
        raise MagicError(Code.SERVER_TIMEOUT, f"{options.strategy}, {options.variant}", "no answer", f"one within {2 * ANSWER:g} s")
    spent = {name: processor_seconds(pid) - before[name] for name, pid in pids.items()}
    seconds = {stage: float(getattr(result.times, stage)) for stage in STAGES}
    return Run(options.strategy, options.variant, Code(result.code).name, len(result.candidates), seconds, client, spent)


def _until(condition: Callable[[], Any], seconds: float, what: str, graph: Graph) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        graph.check()
        if time.monotonic() > deadline:
            raise MagicError(Code.SERVER_TIMEOUT, what, f"not there after {seconds:g} s", "see the nodes' logs")
        time.sleep(0.02)


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="goal_times", description="Measure the graph from a goal to its verdict, the objects being known."
    )
    parser.add_argument("--task", nargs="*", default=list(TASKS), choices=TASKS)
    parser.add_argument("--variant", nargs="*", default=["arm", "fg"], choices=["arm", "fg"])
    parser.add_argument("--count", type=int, default=5, help="goals of each task and variant, after the first (default 5)")
    parser.add_argument("--rollouts", type=int, default=1, help="simulations of each motion (default 1: as given)")
    parser.add_argument("--bags", type=Path, default=Path("bags"), help="folder of the recorded bags (default bags)")
    parser.add_argument("--json", type=Path, help="also write every run to this file")
    options = parser.parse_args(arguments)
    if options.count < 1:
        parser.error(f"--count {options.count}: at least 1")
    runs: list[Run] = []
    try:
        environment.prepare()
        load = os.getloadavg()[0]
        with tempfile.TemporaryDirectory() as scratch:
            for task in options.task:
                runs += measure(task, options.variant, options.count, options.rollouts, options.bags, Path(scratch) / task)
    except MagicError as error:
        print(f"goal_times: {error}", file=sys.stderr)
        return 1
    print(table(runs))
    print(f"seconds, medians; load of the machine before: {load:.1f}, after: {os.getloadavg()[0]:.1f}, of {os.cpu_count()} cores")
    if options.json:
        options.json.write_text(json.dumps([asdict(run) for run in runs], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
