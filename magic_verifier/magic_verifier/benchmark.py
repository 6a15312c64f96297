"""How long the rollouts of a verdict take, on procedural objects with their labelled contacts: ``ros2 run magic_verifier benchmark``.

Each case is planned as :mod:`magic_planner.benchmark` does, with the first grasp.  Then all
rollouts are computed, decided or not, by this process and ``--workers`` others that are warm, as the node has them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan
from magic_core.strategy import Strategy, find
from magic_core.threads import one_thread
from magic_core.workers import Workers
from magic_planner.arm import ArmPlanner
from magic_planner.benchmark import TASKS, Case, make_case
from magic_planner.budget import Budget
from magic_planner.giving_way import gap_of
from magic_planner.object_motion import plan_tool_motion
from magic_planner.request import Problem
from magic_planner.robot import Robot
from magic_verifier import verification
from magic_verifier.rollout import Task, rollout
from magic_verifier.verification import Proposal
from magic_verifier.workers import simulating

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Timing:
    """One case: seconds by the clock of the rollout of the scene as given, alone, and of all of them; seconds of this process's processor
    meanwhile; how many passed."""

    name: str
    first: float
    everything: float
    busy: float
    passed: int
    count: int

    def __str__(self) -> str:
        return (
            f"{self.everything:.2f} s for {self.count} rollouts ({self.busy:.2f} s of this process), {self.first:.2f} s for the first alone; "
            f"{self.passed} passed"
        )


def measured(task: Task, name: str, count: int, pool: Workers) -> Timing | None:
    """The rollouts of one task, timed; ``None`` where the scene as given fails, after which there are none."""
    started = time.perf_counter()
    first = rollout(task, 0)
    alone = time.perf_counter() - started
    if first.judgement.code != Code.OK:
        return None
    started, busy = time.perf_counter(), time.process_time()
    outcomes = verification.rollouts(task, count, None, pool.executor, pool.count)
    passed = sum(outcome.judgement.code == Code.OK for outcome in outcomes)
    return Timing(name, alone, time.perf_counter() - started, time.process_time() - busy, passed, count)


def planned(strategy: Strategy, case: Case, variant: str, planner: ArmPlanner | None) -> MotionPlan:
    """The motion of a case; planner: of the variant arm.  Raises what planning does."""
    scene = (strategy, case.tool, case.target, case.candidate, "keep")
    motion = plan_tool_motion(*scene, TABLE, case.obstacles, gap_of(case.tool, variant))
    if planner is None or variant == "fg":
        return MotionPlan("fg", motion)
    return planner.solve(Problem(*scene, motion, TABLE, case.obstacles), budget=Budget(10.0))


def summary(timings: list[Timing], rollouts: int) -> str:
    """How long the cases of a task took."""
    seconds = np.array([row.everything for row in timings])
    return (
        f"{len(timings)} cases: {rollouts} rollouts take {seconds.mean():.2f} s in the mean, "
        f"median {np.median(seconds):.2f} s, longest {seconds.max():.2f} s; the first alone "
        f"{np.mean([row.first for row in timings]):.2f} s; this process is busy for {np.mean([row.busy for row in timings]):.2f} s"
    )


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``ros2 run magic_verifier benchmark``."""
    parser = argparse.ArgumentParser(prog="benchmark", description="Measure the rollouts of a verdict on procedural objects.")
    parser.add_argument("--strategies", type=Path, default=None, help="folder of strategies; the installed ones by default")
    parser.add_argument("--task", nargs="*", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--variant", nargs="*", default=["fg", "arm"], choices=["fg", "arm"])
    parser.add_argument("--count", type=int, default=4, help="objects for each task, the families in turn")
    parser.add_argument("--rollouts", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1, help="processes beside this one")
    parser.add_argument("--seed", type=int, default=0, help="of the first object and of the draws")
    options = parser.parse_args(arguments)
    one_thread()
    planner = ArmPlanner(Robot()) if "arm" in options.variant else None
    pool = simulating(options.workers)
    try:
        print(f"load of the machine before: {os.getloadavg()[0]:.1f} of {os.cpu_count()} cores")
        for task in options.task:
            strategy, families = find(task, options.strategies), TASKS[task][0]
            rows: dict[str, list[Timing]] = {variant: [] for variant in options.variant}
            for number in range(options.count):
                case = make_case(strategy, *families[number % len(families)], options.seed + number)
                for variant in options.variant:
                    label = f"{task:9} {variant:3} {case.name:28}"
                    try:
                        plan = planned(strategy, case, variant, planner)
                        scene = (strategy, case.tool, case.target, case.obstacles, TABLE)
                        found = measured(verification.make_task(Proposal(*scene, plan, options.seed)), case.name, options.rollouts, pool)
                    except MagicError as error:
                        print(f"{label} {error}")
                        continue
                    print(f"{label} {found if found is not None else 'fails in the scene as given'}", flush=True)
                    rows[variant] += [found] if found is not None else []
            for variant, timings in rows.items():
                if timings:
                    print(f"{task:9} {variant:3} {summary(timings, options.rollouts)}")
    finally:
        pool.close()


if __name__ == "__main__":
    sys.exit(main())
