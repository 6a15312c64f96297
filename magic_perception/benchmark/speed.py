"""Seconds by stage for two 640x480 cameras over four objects, wall clock and CPU, and the memory: ``python benchmark/speed.py [--rounds N]``.

With many rounds (1,000) the resident memory at each tenth of them shows whether it is flat.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

import scenes

from magic_perception.pipeline import Report, perceive


def resident() -> float:
    """Resident memory of this process in MiB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
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
    rows, wall, cpu, memory = [], [], [], []
    for number in range(given.rounds):
        report = Report()
        start, used = time.perf_counter(), time.process_time()
        scene = perceive(frames, report=report)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - used)
        rows.append(report.seconds)
        if (number + 1) % max(1, given.rounds // 10) == 0:
            memory.append(resident())
    print(f"{len(scene.objects)} objects, {', '.join(report.shapes.values())}; {given.rounds} rounds")
    for stage in rows[0]:
        print(f"{stage:12s} median {np.median([r[stage] for r in rows]):.3f} s, least {min(r[stage] for r in rows):.3f} s")
    print(f"resident memory, MiB, at each tenth of the rounds: {', '.join(f'{m:.0f}' for m in memory)}")
    print(f"{'total':12s} median {np.median(wall):.3f} s, least {min(wall):.3f} s; CPU median {np.median(cpu):.3f} s")


if __name__ == "__main__":
    main()
