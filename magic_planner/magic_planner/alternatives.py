"""The Panda's inverse kinematics here against ssik's analytic one: ``python -m magic_planner.alternatives`` (needs the package ssik).

Poses of the hand are drawn by drawing joint positions within the limits, so that each can be reached.  Both are asked for all solutions
within the limits, by the same margin.  Told are milliseconds of the processor for each pose, how many poses had a solution, solutions a
pose, and the largest error of what was answered, by the chain's own forward kinematics.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.threads import one_thread
from magic_planner.robot import Robot

#: As :meth:`magic_planner.robot.Robot.inverse` keeps from the limits, rad.
MARGIN = 0.02


@dataclass(frozen=True)
class Answer:
    """What one way answered: ms of the processor a pose, poses with a solution, solutions a pose, largest errors in mm and mrad."""

    name: str
    milliseconds: float
    solved: int
    solutions: float
    position: float
    angle: float


def drawn(robot: Robot, count: int, seed: int) -> NDArray[np.float64]:
    """Poses (N, 4, 4) of the hand above the table, of joint positions drawn within the limits without a self-collision."""
    rng, found = np.random.default_rng(seed), []
    robot.clear()
    while len(found) < count:
        q = rng.uniform(robot.chain.lower + MARGIN, robot.chain.upper - MARGIN)
        tip = robot.chain.forward(q)
        if tip[2, 3] > 0.02 and not robot.collides(q):
            found.append(tip)
    return np.stack(found)


def asked(robot: Robot, name: str, targets: NDArray[np.float64], solve: Callable[[NDArray[np.float64]], Any]) -> Answer:
    """Ask for every pose; ``solve(targets)`` answers (index (S,), joint positions (S, J))."""
    began = time.process_time()
    index, q = solve(targets)
    spent = time.process_time() - began
    worst = [0.0, 0.0]
    if len(q):
        off = np.linalg.inv(robot.chain.forward(q)) @ targets[index]
        worst = [float(np.linalg.norm(off[:, :3, 3], axis=1).max()), float(Rotation.from_matrix(off[:, :3, :3]).magnitude().max())]
    return Answer(name, 1000 * spent / len(targets), len(set(index.tolist())), len(q) / len(targets), 1000 * worst[0], 1000 * worst[1])


def analytic(robot: Robot) -> Callable[[NDArray[np.float64]], Any]:
    """ssik's solver for the same link and limits."""
    from ssik.prebuilt import franka_panda_ik

    rest = robot.description.poses({})
    tip_from_flange = transforms.inverse(rest[robot.description.config.move_group]) @ rest[franka_panda_ik.EE_LINK]
    lower, upper = robot.chain.lower + MARGIN, robot.chain.upper - MARGIN

    def solve(targets: NDArray[np.float64]) -> Any:
        index, rows = [], []
        for i, target in enumerate(targets):
            for found in franka_panda_ik.solve(target @ tip_from_flange):
                if np.all((found.q > lower) & (found.q < upper)):
                    index.append(i)
                    rows.append(found.q)
        return np.array(index, dtype=int), np.array(rows).reshape(-1, robot.count)

    return solve


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="alternatives", description="Compare the Panda's inverse kinematics with ssik's.")
    parser.add_argument("--count", type=int, default=200, help="poses (default 200)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    one_thread()
    robot = Robot()
    robot.warm_up()
    targets = drawn(robot, options.count, options.seed)

    def each(solve: Callable[[NDArray[np.float64]], Any]) -> Callable[[NDArray[np.float64]], Any]:
        def one_by_one(targets: NDArray[np.float64]) -> Any:
            answers = [solve(target[None]) for target in targets]
            return np.concatenate([np.full(len(q), i) for i, (_, q) in enumerate(answers)]).astype(int), np.concatenate(
                [q for _, q in answers]
            )

        return one_by_one

    ways = {"here, all poses at once": robot.inverse, "here, one by one": each(robot.inverse)}
    try:
        ways["ssik, one by one"] = analytic(robot)
    except ImportError:
        print("ssik is not installed: pip install ssik")
    print(
        "| inverse kinematics | ms a pose | poses solved | solutions a pose | largest error, mm | mrad |\n| --- | --- | --- | --- | --- | --- |"
    )
    for name, solve in ways.items():
        solve(targets[:2])
        a = asked(robot, name, targets, solve)
        print(f"| {name} | {a.milliseconds:.2f} | {a.solved} of {len(targets)} | {a.solutions:.1f} | {a.position:.1e} | {a.angle:.1e} |")


if __name__ == "__main__":
    main()
