"""What other libraries would bring, on the Panda: ``python -m magic_planner.alternatives``.

**Inverse kinematics** against ssik's analytic one (where the package ssik is installed).  Poses of the hand are drawn by drawing joint
positions within the limits, so that each can be reached.  Both are asked for all solutions within the limits, by the same margin.  Told are
milliseconds of the processor for each pose, how many poses had a solution, solutions a pose, and the largest error of what was answered, by
the chain's own forward kinematics.

**Free motions** against roboplan's (``--roboplan PYTHON``, of an environment that has it).  Among boxes drawn about the arm, pairs of free
joint positions are drawn whose straight line meets something.  RRT-Connect of MPlib and of roboplan are asked for a path; told are
milliseconds of the processor, paths found, and those that are free where MPlib's world is asked every ``FINE`` rad.
"""

from __future__ import annotations

import argparse
import itertools
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.shapes.solids import hull
from magic_core.threads import one_thread
from magic_planner import free_by_roboplan
from magic_planner.collision import shell
from magic_planner.free_motion import straight
from magic_planner.robot import Robot

#: As :meth:`magic_planner.robot.Robot.inverse` keeps from the limits, rad.
MARGIN = 0.02
#: Boxes about the arm: how many, edges in m, how far from a point above its foot.
BOXES, EDGES, AWAY = 42, (0.03, 0.12), (0.35, 0.85)
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
#: Joint step, rad, at which a path is looked at in the end, and at which a straight line is tried.
FINE, COARSE = 0.02, 0.08


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


@dataclass(frozen=True)
class Boxes:
    """Boxes (B, 3) edges and (B, 4, 4) poses, all in a robot's world, and pairs (P, 2, J) of free
    joint positions with something between."""

    sizes: NDArray[np.float64]
    poses: NDArray[np.float64]
    pairs: NDArray[np.float64]


def among_boxes(robot: Robot, count: int, seed: int) -> Boxes:
    """Boxes that leave the arm's home free, and pairs of joint positions."""
    rng = np.random.default_rng(seed)
    robot.clear()
    sizes: list[NDArray[np.float64]] = []
    poses: list[NDArray[np.float64]] = []
    while len(sizes) < BOXES:
        size, direction = rng.uniform(*EDGES, 3), transforms.unit(rng.normal(size=3))
        direction[2] = abs(direction[2])
        pose = transforms.from_rpy(0, 0, rng.uniform(-np.pi, np.pi), direction * rng.uniform(*AWAY) + [0.0, 0.0, 0.1])
        name = f"box_{len(sizes)}"
        robot.add(name, shell((hull(size * CORNERS),)), pose)
        if robot.collides(robot.home):
            robot.world.remove_object(name)
            continue
        sizes.append(size)
        poses.append(pose)
    pairs: list[NDArray[np.float64]] = []
    while len(pairs) < count:
        ends = rng.uniform(robot.chain.lower + 0.05, robot.chain.upper - 0.05, (2, robot.count))
        if not any(map(robot.collides, ends)) and not _free(robot, ends, COARSE):
            pairs.append(ends)
    return Boxes(np.array(sizes), np.array(poses), np.array(pairs))


def _free(robot: Robot, path: NDArray[np.float64], step: float) -> bool:
    return not any(robot.collides(q) for a, b in itertools.pairwise(path) for q in straight(a, b, step))


def by_mplib(robot: Robot, boxes: Boxes) -> tuple[list[NDArray[np.float64] | None], list[float]]:
    """Paths by MPlib's RRT-Connect, as the planner asks for them, with the same time as roboplan; seconds of the processor."""
    import mplib

    paths: list[NDArray[np.float64] | None] = []
    seconds = []
    for index, (start, goal) in enumerate(boxes.pairs):
        mplib.set_global_seed(index + 1)
        began = time.process_time()
        status, path = robot.planner.planner.plan(start, [goal], time=free_by_roboplan.SECONDS, range=0.3, simplify=False)
        seconds.append(time.process_time() - began)
        paths.append(np.asarray(path, dtype=float) if str(status).startswith("Exact") else None)
    return paths, seconds


def by_roboplan(robot: Robot, boxes: Boxes, python: str) -> tuple[list[NDArray[np.float64] | None], list[float]]:
    """Paths by roboplan's RRT-Connect, in a process of another environment."""
    description = robot.description
    packages = str(description.urdf).split("/example-robot-data/")[0]
    with tempfile.TemporaryDirectory() as scratch:
        given, found = Path(scratch, "in.npz"), Path(scratch, "out.npz")
        np.savez(
            given, sizes=boxes.sizes, poses=boxes.poses, pairs=boxes.pairs, names=list(description.names), urdf=str(description.urdf),
            srdf=str(description.srdf), packages=packages, base=description.base, tip=description.config.move_group,
            finger=float(description.opened[0]),
        )  # fmt: skip
        subprocess.run([python, free_by_roboplan.__file__, str(given), str(found)], check=True, stdout=subprocess.DEVNULL)
        answer = np.load(found, allow_pickle=True)  # of our own making
        return list(answer["paths"]), list(answer["seconds"])


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="alternatives", description="Compare inverse kinematics and free motions with other libraries.")
    parser.add_argument("--count", type=int, default=200, help="poses (default 200)")
    parser.add_argument("--pairs", type=int, default=40, help="free motions (default 40)")
    parser.add_argument("--roboplan", default="", metavar="PYTHON", help="Python of an environment that has roboplan")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    one_thread()
    robot = Robot()
    robot.warm_up()
    if options.count:
        compare_kinematics(robot, drawn(robot, options.count, options.seed))
    if options.roboplan:
        compare_free(robot, among_boxes(robot, options.pairs, options.seed), options.roboplan)


def compare_free(robot: Robot, boxes: Boxes, python: str) -> None:
    """Print the table of free motions."""
    print("| free motion among boxes | found | free in the end | ms, median | p95 |\n| --- | --- | --- | --- | --- |")
    ways = {"MPlib (OMPL)": lambda: by_mplib(robot, boxes), "roboplan": lambda: by_roboplan(robot, boxes, python)}
    for name, ask in ways.items():
        paths, seconds = ask()
        there = [path for path in paths if path is not None]
        good = sum(_free(robot, path, FINE) for path in there)
        median, most = 1000 * np.median(seconds), 1000 * np.percentile(seconds, 95)
        print(f"| {name} | {len(there)} of {len(paths)} | {good} | {median:.1f} | {most:.1f} |", flush=True)


def compare_kinematics(robot: Robot, targets: NDArray[np.float64]) -> None:
    """Print the table of inverse kinematics."""

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
