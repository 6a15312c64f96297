"""Speed and memory of the matcher, each against what it is measured by, in one run."""

from __future__ import annotations

import gc
import resource
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_matcher import features, jobs, matching
from magic_matcher.global_stage import Reference, make_reference


def resident() -> float:
    """Memory of this process now, MB (the peak, where /proc is not there)."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def timed(work: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Median and least seconds of a call: on the clock, and of this process's CPU time (all threads)."""
    work()
    clock, cpu = [], []
    for _ in range(repeats):
        a, b = time.perf_counter(), time.process_time()
        work()
        clock.append(time.perf_counter() - a)
        cpu.append(time.process_time() - b)
    return {"median_s": float(np.median(clock)), "least_s": min(clock), "median_cpu_s": float(np.median(cpu)), "least_cpu_s": min(cpu)}


def random_vit_s(folder: str) -> str:
    """Randomly initialised weights of DINOv2 ViT-S/14 in a folder: as fast as trained ones."""
    import torch
    from transformers import Dinov2Config, Dinov2Model

    torch.manual_seed(0)
    config = Dinov2Config(hidden_size=384, num_hidden_layers=12, num_attention_heads=6, image_size=518, patch_size=14)
    Dinov2Model(config).save_pretrained(folder)
    return folder


def measure(weights: str = "", requests: int = 1000, repeats: int = 7) -> dict[str, Any]:
    """Seconds a match of both backends after the reference is prepared, DINOv2's one network pass, memory over many requests."""
    job = jobs.JOBS["hooking"]
    shown = jobs.example("hooking", "l_hook", 5000)
    contact = shown.contact("inner")
    reference = make_reference(shown.view, contact.pixel, contact.normal, 0.025 / shown.view.metres_per_pixel, shown.contour)
    target = jobs.disc_target(0.02, job.view)
    tools = [matching.Tool(name, jobs.example("hooking", name, 7000).view) for name in ("caliper", "hammer", "scissors", "watch")]

    def match(matcher: matching.Matcher, tool: matching.Tool) -> None:
        matcher.match_views(reference, contact, [tool], target, 3, False, 0.025)

    embedded = matching.Matcher(features.load("embedded"))
    return {
        "embedded": {tool.id: timed(lambda tool=tool: match(embedded, tool), repeats) for tool in tools},
        "dinov2": _network(weights, reference, lambda matcher: match(matcher, tools[0]), repeats),
        "memory": _memory(lambda k: match(embedded, tools[k % len(tools)]), requests),
    }


def _network(weights: str, reference: Reference, match: Callable[[matching.Matcher], None], repeats: int) -> dict[str, Any]:
    """Seconds of DINOv2's pass and of a match with it, and their ratio, on all threads and on one."""
    import torch

    with tempfile.TemporaryDirectory() as folder:
        backend = features.load("dinov2", weights or random_vit_s(folder))
        matcher = matching.Matcher(backend)
        matcher.prepare(reference)
        picture = np.zeros((1, backend.size, backend.size, 3), np.uint8)
        backend.extract(picture)

        def turns() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            """Passes and matches in turns, so that what else runs on the machine slows both alike."""
            pairs = [(timed_once(lambda: backend.extract(picture)), timed_once(lambda: match(matcher))) for _ in range(repeats)]
            return np.array([p for p, _ in pairs]), np.array([m for _, m in pairs])

        passes, matches = turns()
        threads = torch.get_num_threads()
        # Threads that wait for each other's core cost time of their own on a busy machine; one alone does not.
        torch.set_num_threads(1)
        try:
            alone, alone_matches = turns()
        finally:
            torch.set_num_threads(threads)
    one, all_ = np.median(passes, axis=0), np.median(matches, axis=0)
    return {
        "weights": weights or "ViT-S/14, random",
        "side_px": backend.size,
        "pass_s": float(one[0]),
        "match_s": float(all_[0]),
        "threads": threads,
        "ratio": float(np.median(matches[:, 0] / passes[:, 0])),
        "ratio_of_least": float(matches[:, 0].min() / passes[:, 0].min()),
        "pass_cpu_s": float(one[1]),
        "match_cpu_s": float(all_[1]),
        "ratio_cpu": float(np.median(matches[:, 1] / passes[:, 1])),
        "one_thread_ratio": float(np.median(alone_matches[:, 0] / alone[:, 0])),
        "one_thread_ratio_cpu": float(np.median(alone_matches[:, 1] / alone[:, 1])),
    }


def _memory(match: Callable[[int], None], requests: int) -> dict[str, Any]:
    """Memory of this process, MB, over so many requests: at a tenth of them each, and how it grew after the first."""
    memory = []
    for k in range(requests):
        if k % max(1, requests // 10) == 0:
            gc.collect()
            memory.append(resident())
        match(k)
    gc.collect()
    memory.append(resident())
    return {
        "requests": requests,
        "resident_mb": [round(m, 1) for m in memory],
        "growth_mb": round(memory[-1] - memory[min(1, len(memory) - 1)], 1),
    }


def timed_once(work: Callable[[], Any]) -> tuple[float, float]:
    """Seconds on the clock and of CPU time of one call."""
    a, b = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - a, time.process_time() - b
