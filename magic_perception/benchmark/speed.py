"""Seconds by stage for two 640x480 cameras over four objects, wall clock and CPU: ``python benchmark/speed.py [--rounds N]``."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

import scenes

from magic_perception.pipeline import Report, perceive


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    given = parser.parse_args()
    meshes = [
        scenes.shape("l_hook", 1, 0.5, -0.1, 0.4),
        scenes.shape("cylinder", 1, 0.62, 0.12),
        scenes.shape("mug", 3, 0.48, 0.1, 2.5),
        scenes.shape("caliper", 2, 0.68, -0.05, 1.2),
    ]
    frames = [scenes.capture(meshes, name, seed)[0] for seed, name in enumerate(("left", "right"))]
    perceive(frames)
    rows, wall, cpu = [], [], []
    for _ in range(given.rounds):
        report = Report()
        start, used = time.perf_counter(), time.process_time()
        scene = perceive(frames, report=report)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - used)
        rows.append(report.seconds)
    print(f"{len(scene.objects)} objects, {', '.join(report.shapes.values())}; {given.rounds} rounds")
    for stage in rows[0]:
        print(f"{stage:12s} median {np.median([r[stage] for r in rows]):.3f} s, least {min(r[stage] for r in rows):.3f} s")
    print(f"{'total':12s} median {np.median(wall):.3f} s, least {min(wall):.3f} s; CPU median {np.median(cpu):.3f} s")


if __name__ == "__main__":
    main()
