"""How often and how quickly the planner serves the strategies, on procedural objects with their labelled contacts.

``python -m magic_planner.benchmark --strategies FOLDER [--task hooking ...] [--variant fg arm] [--count N]``
prints one line for each case and a summary for each task and variant.  It measures
the planner alone: the contacts are the analytic ones, so nothing has to be matched,
and nothing is simulated.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from magic_core import transforms
from magic_core.contact import Contact, ContactCandidate, contact_frame
from magic_core.errors import MagicError
from magic_core.rendering import canonical_view
from magic_core.scene import SceneObject
from magic_core.shapes import Shape, make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_core.shapes.shape import section_view
from magic_core.strategy import Strategy, find
from magic_core.threads import one_thread
from magic_planner.budget import Budget
from magic_planner.collision import mass_centre
from magic_planner.object_motion import plan_tool_motion
from magic_planner.request import Problem

#: For each task: the tool families with the region that does the job, the target's family, and where the tool lies (x, y).
TASKS = {
    "hooking": ((("l_hook", "inner"), ("j_hook", "inner"), ("caliper", "jaw"), ("scissors", "inner")), "cylinder", (0.44, -0.22)),
    "hanging": ((("mug", "handle"), ("hanger", "hook")), "rod", (0.50, -0.28)),
    "scooping": ((("spoon", "bowl"), ("ladle", "bowl"), ("measuring_cup", "bowl")), "sphere", (0.45, 0.31)),
}


@dataclass(frozen=True)
class Case:
    """One problem for the planner."""

    name: str
    tool: SceneObject
    target: SceneObject
    obstacles: tuple[SceneObject, ...]
    candidate: ContactCandidate


def target_contact(shape: Shape, strategy: Strategy) -> Contact:
    """The support point of a standing target along the strategy's normal, in a view along its direction."""
    direction, normal = strategy.target_view_direction, strategy.target_normal
    up = np.array([1.0, 0, 0]) if abs(direction[2]) > 0.9 else np.array([0, 0, 1.0])
    view = (
        section_view(shape.mesh, direction, up) if strategy.view == "section" else canonical_view(shape.mesh, direction, up, strategy.view)
    )
    reach = shape.mesh.vertices @ normal
    top = shape.mesh.vertices[reach > reach.max() - 1e-4]
    point = view.points(view.pixels(top.mean(axis=0)))
    pixel = view.pixels(point)
    picture = transforms.unit(normal @ view.object_from_view[:3, :2])
    return Contact(
        pixel, picture, strategy.target_contact.radius, False, strategy.target_contact.scale, contact_frame(view, pixel, picture)
    )


def region_name(shape: Shape, wanted: str) -> str:
    """The region that does the job: the wanted one, else the first there is."""
    return wanted if wanted in shape.regions else next(iter(shape.regions))


def resting(shape: Shape) -> np.ndarray:
    """A tilt about y, as a transform, in which the shape lies still: downhill from upright to the lowest centre of mass."""
    vertices, centre = shape.mesh.vertices, mass_centre(shape.pieces)[1]

    def height(angle: float) -> float:
        turn = transforms.from_rpy(0, angle, 0)[:3, :3]
        return float((turn @ centre)[2] - (vertices @ turn.T)[:, 2].min())

    angle, step = 0.0, np.deg2rad(0.5)
    while min(height(angle + step), height(angle - step)) < height(angle) - 1e-7 and abs(angle) < np.pi / 2:
        angle += step if height(angle + step) < height(angle - step) else -step
    return transforms.from_rpy(0, angle, 0)


def make_case(
    strategy: Strategy, family: str, region: str, seed: int, at: tuple[float, float] | None = None, yaw: float | None = None
) -> Case:
    """A tool of a family and seed lying at ``at`` (default: the task's place) with a drawn yaw, the strategy's target and fixtures."""
    rng = np.random.default_rng(seed)
    tool_shape = make(family, seed)
    target_family = TASKS[strategy.name][1]
    if target_family == "rod":
        target_shape = make("rod", 0, **strategy.environment["target"]["parameters"])
    elif target_family == "sphere":
        target_shape = make("sphere", seed, radius=float(rng.choice([0.015, 0.035, 0.045])))
    else:
        target_shape = make(target_family, seed)
    turn = float(rng.uniform(-0.4, 0.4)) if yaw is None else yaw
    at = TASKS[strategy.name][2] if at is None else at
    tilt = resting(tool_shape)
    low = transforms.apply(tilt, tool_shape.mesh.vertices)[:, 2].min()
    tool = tool_shape.as_object("tool", transforms.from_rpy(0, 0, turn, [*at, 0.0005 - low]) @ tilt, strategy.view)
    demonstrated = demonstrated_pose(strategy.environment)
    contact = target_contact(target_shape, strategy)
    # The contact point stands where the demonstration's stood, whatever the size of the target.
    offset = (demonstrated @ strategy.target_contact.object_from_contact)[:3, 3] - contact.object_from_contact[:3, 3]
    target = target_shape.as_object("target", transforms.make(translation=[*offset[:2], -target_shape.mesh.bounds[0, 2]]), strategy.view)
    around = tuple(fixtures(strategy.environment, (target.world_from_object @ contact.object_from_contact)[:3, 3]))
    name = region_name(tool_shape, region)
    towards = (0, 0, 1) if strategy.view == "section" else None
    tool_contact = tool_shape.contact(name, tool_shape.view(strategy.view), towards=towards)
    return Case(
        f"{family}-{seed}/{name}",
        tool,
        target,
        around,
        ContactCandidate("tool", tool_contact, contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4)),
    )


@dataclass(frozen=True)
class Result:
    """How one case went: whether it was planned, seconds by the clock and of the processor."""

    name: str
    planned: bool
    wall: float
    busy: float


def summary(rows: Sequence[Result]) -> str:
    """A line about the cases of a task: how many were planned, their times, the longest with its name."""
    parts = [f"{sum(row.planned for row in rows)} of {len(rows)} planned"]
    for title, key in (("by the clock", "wall"), ("of the processor", "busy")):
        seconds = np.array([getattr(row, key) for row in rows])
        longest = rows[int(seconds.argmax())]
        parts.append(
            f"{title} mean {seconds.mean():.3f} s, median {np.median(seconds):.3f} s, longest {seconds.max():.3f} s ({longest.name})"
        )
    return "; ".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description="Measure the planner on procedural objects.")
    parser.add_argument("--strategies", type=Path, default=None, help="folder of strategies; the installed ones by default")
    parser.add_argument("--task", nargs="*", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--variant", nargs="*", default=["fg", "arm"], choices=["fg", "arm"])
    parser.add_argument("--count", type=int, default=3, help="objects of each family")
    parser.add_argument("--family", nargs="*", default=None, help="only these families of tools")
    parser.add_argument("--timeout", type=float, default=10.0, help="seconds for one plan")
    options = parser.parse_args(arguments)
    one_thread()
    planner = None
    if "arm" in options.variant:
        from magic_planner.arm import ArmPlanner
        from magic_planner.robot import Robot

        started = time.perf_counter()
        planner = ArmPlanner(Robot())
        planner.warm_up()
        print(f"arm ready after {time.perf_counter() - started:.2f} s")
    for task in options.task:
        strategy = find(task, options.strategies)
        results: dict[str, list[Result]] = {v: [] for v in options.variant}
        for family, region in TASKS[task][0]:
            if options.family and family not in options.family:
                continue
            for seed in range(options.count):
                case = make_case(strategy, family, region, seed)
                motion, started, busy = None, time.perf_counter(), time.process_time()
                try:
                    motion = plan_tool_motion(strategy, case.tool, case.target, case.candidate, "keep", (0, 0, 1, 0), case.obstacles)
                    text = f"ok, {motion.times[-1]:.1f} s of motion"
                except MagicError as error:
                    text = str(error)
                fg, fg_busy = time.perf_counter() - started, time.process_time() - busy
                if "fg" in options.variant:
                    results["fg"].append(Result(case.name, motion is not None, fg, fg_busy))
                    print(f"{task:9} fg  {case.name:28} {1e3 * fg:7.1f} ms  {text}")
                if planner is None:
                    continue
                if motion is not None:
                    try:
                        plan = planner.solve(
                            Problem(strategy, case.tool, case.target, case.candidate, "keep", motion, (0, 0, 1, 0), case.obstacles),
                            budget=Budget(options.timeout),
                        )
                        assert plan.arm_motion is not None
                        text = f"ok, {plan.arm_motion.times[-1]:.1f} s of motion, {1e3 * plan.arm_motion.grasp_width:.0f} mm grasp"
                    except MagicError as error:
                        motion, text = None, str(error)
                arm, arm_busy = time.perf_counter() - started, time.process_time() - busy
                results["arm"].append(Result(case.name, motion is not None, arm, arm_busy))
                print(f"{task:9} arm {case.name:28} {1e3 * arm:7.1f} ms  {text}")
        for variant, rows in results.items():
            if rows:
                print(f"{task:9} {variant:3} {summary(rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
