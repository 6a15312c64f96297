"""Seconds by stage and memory, for a benchmark of two cameras over four objects: ``ros2 run magic_perception evaluate --speed``."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path

import numpy as np

from magic_core import sensor, shapes, transforms
from magic_core.camera import RgbdFrame
from magic_core.threads import one_thread
from magic_core.workers import Workers
from magic_perception.parameters import Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.segmentation import Segmenter
from magic_perception.tracking import Tracker

#: Family, seed, x and y in metres and yaw in radians of what stands and lies on the table.
OBJECTS = (("l_hook", 1, 0.50, -0.10, 0.4), ("cylinder", 1, 0.62, 0.12, 0.0), ("mug", 3, 0.48, 0.10, 2.5), ("caliper", 2, 0.68, -0.05, 1.2))

#: Eyes of the two cameras, which look at the table's middle.
EYES = ((0.25, 0.45, 0.62), (0.25, -0.45, 0.62))

#: What is measured in all: from the masks on, and from the images on, to meshes with convex pieces.
SUMS = {
    "masks to meshes": ("meshes",),
    "images to meshes": ("table", "masks", "cameras", "meshes"),
    "all": ("table", "masks", "cameras", "meshes", "views"),
}


def frame_pairs(count: int, seed: int = 0) -> list[list[RgbdFrame]]:
    """``count`` pairs of 640x480 frames of one scene, each with noise of its own."""
    meshes = []
    for family, number, x, y, yaw in OBJECTS:
        mesh = shapes.make(family, number).mesh
        meshes.append(mesh.transformed(transforms.from_rpy(0, 0, yaw, [x, y, -mesh.bounds[0, 2]])))
    caster = sensor.scene_raycaster(meshes)
    return [
        [
            sensor.capture(
                meshes, sensor.D435, sensor.looking_at(eye, (0.55, 0.0, 0.02)), [seed, n, i], camera=f"camera_{i}", raycaster=caster
            )
            for i, eye in enumerate(EYES)
        ]
        for n in range(count)
    ]


#: The Panda with its hand over the table, rad and m, and a camera before it.
ARM = (0.0, 0.35, 0.0, -2.1, 0.0, 2.45, 0.785, 0.04, 0.04)
BEFORE = (0.94, 0.42, 0.66)


def robot_seconds(frames: int, seed: int = 0) -> dict[str, tuple[list[float], list[float]]]:
    """Seconds by the clock and of the processor to cut the Panda out of one 640x480 frame: at rest (drawn before), and moved since."""
    from magic_core.robot import Description
    from magic_core.robot_pictures import RobotPictures
    from magic_core.self_filter import SelfFilter

    robot = Description()
    pose = sensor.looking_at(BEFORE, (0.52, 0.0, 0.04))
    frame = sensor.capture(RobotPictures(robot).at(np.array(ARM)), sensor.D435, pose, seed)
    cutter = SelfFilter(robot)
    result: dict[str, tuple[list[float], list[float]]] = {}
    for name, step in (("robot cut, moved", 1e-3), ("robot cut, at rest", 0.0)):
        wall, cpu = result[name] = ([], [])
        for number in range(frames):
            positions = robot.arm_positions(np.array(ARM) + np.eye(9)[0] * step * (number + 1))
            begin, used = time.perf_counter(), time.process_time()
            cutter.cut(frame, [positions])
            wall.append(time.perf_counter() - begin)
            cpu.append(time.process_time() - used)
    return {name: (wall[1:], cpu[1:]) if len(wall) > 1 else (wall, cpu) for name, (wall, cpu) in result.items()}


def resident() -> float:
    """Resident memory of this process in MiB; NaN where the system does not tell it as Linux does."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        return float("nan")


def measure(frames: int, segmenter: Segmenter, seed: int = 0, workers: Workers | None = None, pairs: int = 8) -> dict:
    """Seconds by stage and resident memory over ``frames`` scenes, made of ``pairs`` captures over and over, ids tracked as the node
    does."""
    captured = frame_pairs(min(pairs, frames), seed)
    parameters = Parameters(seed=seed)
    tracker = Tracker()
    one_thread()  # as the node
    while workers is not None and workers.count and not workers.ready:
        time.sleep(0.05)
    perceive(captured[0], parameters=parameters, segmenter=segmenter, workers=workers)  # loads libraries
    reports, memory = [], []
    begin = time.perf_counter()
    scene = None
    for number in range(frames):
        report = Report()
        frames_now = captured[number % len(captured)]
        scene = tracker.update(perceive(frames_now, parameters=parameters, segmenter=segmenter, report=report, workers=workers))
        report.labels = []
        reports.append(report)
        if (number + 1) % max(1, frames // 20) == 0:
            memory.append(round(resident(), 1))
    assert scene is not None
    stages = {name: (name,) for name in reports[0].seconds} | SUMS
    taken = {
        name: tuple([sum(times[p] for p in parts) for times in ([r.seconds for r in reports], [r.cpu for r in reports])[i]] for i in (0, 1))
        for name, parts in stages.items()
    } | robot_seconds(min(frames, 40), seed)
    table = {}
    for name, both in taken.items():
        wall, cpu = (np.array(times) for times in both)
        table[name] = {
            "wall_least": round(float(wall.min()), 4),
            "wall_median": round(float(np.median(wall)), 4),
            "cpu_least": round(float(cpu.min()), 4),
            "cpu_median": round(float(np.median(cpu)), 4),
        }
    half = np.array(memory[len(memory) // 2 :])
    return {
        "frames": frames,
        "processes": 1 if workers is None else 1 + workers.count,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "machine": platform.processor() or platform.machine(),
        "load": round(os.getloadavg()[0], 1),
        "shapes": list(reports[-1].shapes.values()),
        "pieces": [len(item.pieces) for item in scene.objects],
        "seconds": table,
        "seconds_in_all": round(time.perf_counter() - begin, 1),
        "memory_mib": memory,
        "memory_growth_second_half_mib": round(float(half[-1] - half[0]), 1) if len(half) > 1 else None,
    }


def markdown(result: dict) -> str:
    """The measurement as a table."""
    lines = [
        f"{result['frames']} scenes of {len(result['shapes'])} objects ({', '.join(result['shapes'])}; {sum(result['pieces'])} convex pieces), "
        f"two 640x480 cameras, {result['cores']} cores, {result['processes']} processes, load {result['load']}:",
        "",
        "| stage | wall, least s | wall, median s | CPU, least s | CPU, median s |",
        "| --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {name} | {row['wall_least']:.3f} | {row['wall_median']:.3f} | {row['cpu_least']:.3f} | {row['cpu_median']:.3f} |"
        for name, row in result["seconds"].items()
    ]
    lines += ["", f"Resident memory, MiB, at each twentieth: {', '.join(f'{m:.0f}' for m in result['memory_mib'])}"]
    return "\n".join(lines) + "\n"
