"""Success rates of a strategy over a set of objects: ``ros2 run magic_verifier evaluate``.

A case is one tool with one target (with tool selection: one target with all tools).
It is matched, planned and verified as the graph does it, candidate by candidate,
until one passes.  Cases run in parallel by joblib; each is stored as soon as it is
done, so that an interrupted evaluation goes on where it stopped.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.goal import words
from magic_core.motion import MotionPlan
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_verifier import captured, placing, reliability
from magic_verifier.cases import BASELINES, METHODS, SOURCES, TARGET_SETS, VARIANTS, Options, all_cases, evaluated, strategy_for
from magic_verifier.feasibility import impossible
from magic_verifier.floating import settled
from magic_verifier.rates import wilson
from magic_verifier.rollout import Limits
from magic_verifier.subjects import Case, Meeting, met_at, scene_for, short_name, tool_object
from magic_verifier.verification import Verdict

TABLE = np.array([0.0, 0.0, 1.0, 0.0])
#: How long planning for the arm may take (s of this process's processor: what else the machine does changes no result) and how many
#: grasps are tried.
PLANNING_TIME = 10.0
ARM_ATTEMPTS = 3
#: The method that takes the best candidate, whatever simulation says of it.
ONLY_BEST = "no_simulation_verification"
#: Pictures in a row of a contact sheet, and on it at most.
COLUMNS = 4
PICTURES = 80


@lru_cache(maxsize=16)
def _strategy(options: Options, tool: str = "") -> Strategy:
    """The strategy with the goal that it is evaluated by (see :func:`tested`)."""
    strategy = strategy_for(options)
    return replace(strategy, goal=strategy.goal.with_values(tested(options, tool)))


def tested(options: Options, tool: str = "") -> dict[str, float]:
    """The goal's numbers that the evaluation sets for a tool: those of the strategy's folder, and the noise that was asked for."""
    values = evaluated(options).numbers(tool.rpartition("//")[2])
    if options.noise is not None:
        if "noise" not in strategy_for(options).goal.numbers:
            raise MagicError(Code.BAD_REQUEST, f"noise for {options.task}", options.noise, "none: its goal names no such number")
        values["noise"] = options.noise
    return values


@lru_cache(maxsize=4)
def _matcher(features: str, weights: str, method: str) -> Any:
    from magic_matcher.features import load
    from magic_matcher.matching import Matcher

    if method == "no_feature_pca_patch":
        return Matcher(load(features, weights, components=None, aggregation="none"))
    backend = load(features, weights)
    if method == "dino":
        return Matcher(backend, weight=0.0, two_step=False)
    return Matcher(backend, two_step=method != "no_two_step_curvature")


@lru_cache(maxsize=1)
def _arm_planner() -> Any:
    from magic_planner.arm import ArmPlanner
    from magic_planner.robot import Robot

    planner = ArmPlanner(Robot())
    planner.warm_up()
    return planner


@lru_cache(maxsize=4)
def _ready(variant: str) -> None:
    """Load what the first case of a process would otherwise pay for, as the nodes do when they start."""
    import mplib  # noqa: F401

    from magic_core.threads import one_thread
    from magic_verifier.simulation import engine

    engine()
    if variant == "arm":
        _arm_planner()
    one_thread()


@dataclass(frozen=True)
class _Tried:
    """One motion that was planned: with which tool, what it was, and the verdict on it."""

    name: str
    tool: SceneObject
    plan: MotionPlan
    verdict: Verdict


@dataclass(frozen=True)
class _Problem:
    """What a case gives the matcher, planner and verifier to work on; ``layout`` is the truth behind it, where that is another."""

    tools: list[SceneObject]
    names: list[str]
    target: SceneObject
    obstacles: dict[str, tuple[SceneObject, ...]]
    table: NDArray[np.float64]
    meeting: Meeting | None
    layout: captured.Layout | None = None
    left_out: tuple[str, ...] = ()

    def tool(self, tool_id: str) -> tuple[SceneObject, str]:
        """The tool of that id, and what the case calls it."""
        return {tool.id: (tool, name) for tool, name in zip(self.tools, self.names, strict=True)}[tool_id]


def _as_given(options: Options, strategy: Strategy, case: Case) -> _Problem:
    """The meshes themselves, each tool beside the others and the target in a turn drawn by the seed."""
    tools, names, left_out = [], [], []
    for index, name in enumerate(case.tools):
        try:
            tools.append(tool_object(name, index, strategy.view))
            names.append(name)
        except MagicError as error:  # where there are others to choose from, one that is no body takes no part
            if error.code != Code.BAD_MESH or len(case.tools) == 1:
                raise
            left_out.append(f"{short_name(name)}: {error.message}")
    if not tools:
        raise MagicError(Code.BAD_MESH, "; ".join(left_out))
    if options.variant == "arm":
        # The arm takes the tool as it lies by itself: a spoon set on the bottom of its bowl tips on to its handle.
        tools = [settled(tool, TABLE, strategy.physics) for tool in tools]
    target, obstacles, meeting = scene_for(strategy, case.target)
    # Where nothing else stands, turned as the seed has it: neither a file's own yaw nor a place that suits one task is given.
    rng = np.random.default_rng(placing.seed_of(case.name, options.seed))
    yaws = rng.uniform(-np.pi, np.pi, len(case.tools))
    tools = placing.place_all([placing.turned(tool, yaw) for tool, yaw in zip(tools, yaws, strict=False)], (target, *obstacles), rng)
    tools = [placing.seen_from_above(tool) for tool in tools]
    return _Problem(tools, names, target, {tool.id: obstacles for tool in tools}, TABLE, meeting, left_out=tuple(left_out))


def _as_seen(options: Options, strategy: Strategy, case: Case, seconds: dict[str, float], film: Path | None) -> _Problem:
    """What two cameras see of the true objects.  Raises ``UNKNOWN_OBJECT`` where tool or target are not among it."""
    layout = captured.lay_out(strategy, case, options.seed)
    frames = captured.capture(layout, case, options.seed)
    started = time.perf_counter()
    scene = captured.perceive(layout, frames, strategy.physics)
    seconds["perceive"] = time.perf_counter() - started
    if film is not None:
        film.parent.mkdir(parents=True, exist_ok=True)
        captured.sheet(frames, scene, film.with_suffix(".scene.png"))
    tools, target = captured.pair(layout, scene)
    seen = [(tool, name) for tool, name in zip(tools, case.tools, strict=True) if tool is not None]
    if not seen or target is None:
        what = "the target" if target is None else "a tool"
        raise MagicError(Code.UNKNOWN_OBJECT, f"reconstruction of {what}", [o.id for o in scene.objects], "one where it truly stands")
    obstacles = {tool.id: tuple(o for o in scene.objects if o.id not in (tool.id, target.id)) for tool, _ in seen}
    return _Problem([tool for tool, _ in seen], [name for _, name in seen], target, obstacles, scene.table, layout.meeting, layout)


def run_case(options: Options, case: Case, film: Path | None = None) -> dict[str, Any]:
    """Match, plan and verify one case; the answer is plain data for ``results.json``."""
    import torch

    _ready(options.variant)
    torch.set_num_threads(1)
    seconds = {"perceive": 0.0, "match": 0.0, "plan": 0.0, "verify": 0.0}
    tried: list[dict[str, Any]] = []
    answer: dict[str, Any] = {
        "object": case.name,
        "success": False,
        "reason": "",
        "candidates": tried,
        "simulations": 0,
        "seconds": seconds,
    }
    runs: list[_Tried] = []
    problem = None
    try:
        strategy = _strategy(options)
        answer["impossible"] = impossible(strategy, case)
        problem = _as_seen(options, strategy, case, seconds, film) if options.source == "images" else _as_given(options, strategy, case)
        if problem.left_out:
            answer["left_out"] = list(problem.left_out)
        if options.method not in BASELINES:
            # Once for a strategy, not for a problem.
            _matcher(options.features, options.weights, options.method).prepare(_reference(strategy))
        started = time.perf_counter()
        top_k = 1 if options.method == ONLY_BEST else options.top_k
        candidates, answer["features"] = _candidates(options, strategy, problem, top_k)
        seconds["match"] = time.perf_counter() - started
        _try_all(options, strategy, problem, candidates, answer, runs)
        # The reason of a failure is that of the best-scored candidate.
        answer["reason"] = "NO_MATCH" if not tried else "OK" if answer["success"] else tried[0]["code"]
    except MagicError as error:
        if error.code in (Code.BAD_REQUEST, Code.BAD_STRATEGY) and problem is None:
            raise  # a name by which nothing can be made, a scene that is not told: no failure of the method
        answer["reason"] = error.code.name
        tried.append({"code": error.code.name, "message": error.message})
    if options.source == "images":
        _judge(options, case, problem, runs, answer)
        answer["seen"] = _seen(case, problem)
    if film is not None and runs and problem is not None:
        _draw(film, runs[-1], problem)
    seconds["total"] = sum(seconds.values())
    return answer


def _try_all(
    options: Options, strategy: Strategy, problem: _Problem, candidates: Sequence[Any], answer: dict[str, Any], runs: list[_Tried]
) -> None:
    """Plan and verify candidates, those that promise most first, until one passes surely enough; each is told in the answer, and its
    motions are put to ``runs``, that which is taken last."""
    from magic_server.pipeline import Agenda, Choice

    most = 1 if options.method == ONLY_BEST else None
    attempts = ARM_ATTEMPTS if options.variant == "arm" and most is None else 1
    agenda, choice = Agenda(candidates[:most], strategy.reflections[:most], attempts), Choice()
    entries: dict[tuple[int, str], dict[str, Any]] = {}
    while not choice.over and (following := agenda.next()) is not None:
        promise, trial = following
        tool, name = problem.tool(trial.candidate.tool_id)
        entry, run = _try(options, _strategy(options, name), trial, tool, name, problem, answer)
        if run is not None:
            runs.append(run)
        key = trial.index, trial.reflection
        if key not in entries:
            entries[key] = {"tool": short_name(name), "score": float(trial.candidate.score), "reflection": trial.reflection, **entry}
            answer["candidates"].append(entries[key])
        elif entry["stage"] == "verify":  # where no further grasp is found, what the last one came to says more
            entries[key].update(entry)
        entries[key]["attempts"] = trial.attempt + 1
        passed = run if run is not None and run.verdict.success else None
        choice.tried(passed, passed.verdict.success_rate if passed is not None else 0.0)
        agenda.failed(promise, trial, Code[entry["code"]])
    if choice.best is not None:
        answer["success"] = True
        runs.sort(key=lambda run: run is choice.best)


def _candidates(options: Options, strategy: Strategy, problem: _Problem, top_k: int) -> tuple[Sequence[Any], str]:
    """Ranked contacts by the method that is evaluated, and the features that it used."""
    from magic_matcher import baselines
    from magic_matcher.matching import Target, target_contact, target_view, tool_of

    tools, target = problem.tools, problem.target
    met = met_at(problem.meeting, target, strategy.view) if problem.meeting is not None else None
    if options.method in BASELINES:
        if met is None:
            view = target_view(target, strategy)
            met = Target(target.id, view, target_contact(strategy, view, target.world_from_object))
        if options.method == "curvature":
            return baselines.by_curvature(strategy, tools, met, top_k, options.seed), "none"
        return baselines.by_shape(options.method, strategy, tools, met, top_k, options.seed), "none"
    matcher = _matcher(options.features, options.weights, options.method)
    if met is None:
        found = matcher.match(strategy, tools, target, top_k)
    else:
        drawn = [tool_of(tool, strategy.view) for tool in tools]
        reference = _reference(strategy)
        found = matcher.match_views(reference, strategy.tool_contact, drawn, met, top_k, False, strategy.target_contact.disc_radius)
    return found.candidates, found.features


def _judge(options: Options, case: Case, problem: _Problem | None, runs: list[_Tried], answer: dict[str, Any]) -> None:
    """What would truly have come of the motions, of each that was tried; ``true_success``: of the verified one, else of any that was
    refused."""
    answer["true"], answer["true_success"] = [], False
    if problem is None or problem.layout is None:
        return
    for run in runs:
        strategy = _strategy(options, run.name)
        verdict = captured.judge(strategy, problem.layout, case.tools.index(run.name), run.tool, run.plan, options.seed)
        said = {"rate": run.verdict.success_rate, "rate_low": run.verdict.rate_low, "rollouts": len(run.verdict.runs)}
        answer["true"].append({"code": verdict.code.name, "message": verdict.message, "verified": run.verdict.success, **said})
    succeeded = [entry["code"] == Code.OK.name for entry in answer["true"]]
    answer["true_success"] = bool(succeeded) and (succeeded[-1] if answer["success"] else any(succeeded))


def _seen(case: Case, problem: _Problem | None) -> list[dict[str, float]]:
    """How sure perception was of each tool, how much of it was seen, and how far it is off (m) and was stated to be at most, five times of
    six."""
    if problem is None or problem.layout is None:
        return []
    true = dict(zip(case.tools, problem.layout.tools, strict=True))
    return [
        {
            "confidence": round(float(tool.confidence), 3),
            "seen_share": round(float(tool.seen_share), 3),
            "surface_error": round(captured.surface_error(true[name], tool), 5),
            "stated_error": round(float(tool.surface_error), 5),
        }
        for tool, name in zip(problem.tools, problem.names, strict=True)
    ]


def _reference(strategy: Strategy) -> Any:
    from magic_matcher.global_stage import from_strategy

    return from_strategy(strategy)


def _try(
    options: Options,
    strategy: Strategy,
    trial: Any,
    tool: SceneObject,
    name: str,
    problem: _Problem,
    answer: dict[str, Any],
) -> tuple[dict[str, Any], _Tried | None]:
    """Plan and verify one trial: what is stored of it, and the motion if there was one; the answer's seconds and simulations go on."""
    from magic_planner.budget import Budget
    from magic_planner.giving_way import gap_of
    from magic_planner.object_motion import plan_tool_motion
    from magic_planner.request import Problem
    from magic_verifier.verification import Proposal, verify_proposal

    started = time.perf_counter()
    candidate, reflection = trial.candidate, trial.reflection
    target, obstacles, table = problem.target, problem.obstacles[tool.id], problem.table
    try:
        motion = plan_tool_motion(strategy, tool, target, candidate, reflection, table, obstacles, gap_of(tool, options.variant))
        if options.variant == "arm":
            given = (strategy, tool, target, candidate, reflection, motion, table, obstacles)
            budget = Budget(PLANNING_TIME, clock=time.process_time)
            plan = _arm_planner().solve(Problem(*given, attempt=trial.attempt, seed=options.seed), budget=budget)
        else:
            plan = MotionPlan("fg", motion)
    except MagicError as error:
        return {"code": error.code.name, "message": error.message, "stage": "plan"}, None
    finally:
        answer["seconds"]["plan"] += time.perf_counter() - started
    limits = Limits(required_rate=options.required_rate)
    proposal = Proposal(strategy, tool, target, obstacles, table, plan, options.seed, limits=limits)
    verdict = verify_proposal(proposal, tried=answer["simulations"])
    answer["seconds"]["verify"] += verdict.seconds
    answer["simulations"] += 1
    metrics = {k: round(v, 5) for k, v in verdict.metrics.items() if math.isfinite(v)}
    entry = {"code": verdict.code.name, "message": verdict.message, "stage": "verify", "metrics": metrics}
    entry |= {"rate": verdict.success_rate, "rate_low": verdict.rate_low, "rollouts": len(verdict.runs)}
    entry["released_test"] = bool(verdict.runs and verdict.runs[0].metrics.get("released_test"))  # in the scene as given
    return entry, _Tried(name, tool, plan, verdict)


def _draw(path: Path, run: _Tried, problem: _Problem) -> None:
    """Three moments of the last simulation, for the contact sheet."""
    import cv2

    from magic_verifier.film import film_strip

    if run.verdict.recording is None:
        return
    obstacles = problem.obstacles[run.tool.id]
    strip = film_strip(run.verdict.recording, run.tool, problem.target, obstacles, problem.table, frames=3, columns=3, size=(220, 165))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), strip[:, :, ::-1])


def summarise(options: Options, done: list[dict[str, Any]]) -> dict[str, Any]:
    """Success rate with its interval, reasons and mean times."""
    hopeless = [c for c in done if c.get("impossible")]
    if options.set != "controls":  # what geometry forbids is listed apart; of controls it is all that there is
        done = [c for c in done if not c.get("impossible")]
    good = sum(bool(c["success"]) for c in done)
    low, high = wilson(good, len(done))
    stages = ("perceive", "match", "plan", "verify", "total")
    summary = {
        "task": options.task,
        "variant": options.variant,
        "method": options.method,
        "features": options.features,
        "objects": options.objects or "the project's own",
        "targets": options.targets or "the project's own",
        "test": _test_sentence(options),
        "cases": len(done),
        "impossible": {c["object"]: c["impossible"] for c in hopeless},
        "impossible_successes": sum(bool(c["success"]) for c in hopeless),
        "successes": good,
        "success_rate": good / len(done) if done else 0.0,
        "interval_95": [low, high],
        "reasons": dict(Counter(c["reason"] for c in done if not c["success"])),
        "simulations": sum(c["simulations"] for c in done),
        "mean_seconds": {s: float(np.mean([c["seconds"].get(s, 0.0) for c in done])) if done else 0.0 for s in stages},
    }
    if options.source == "images":
        summary["truth"] = truths(done)
        summary["reliability"] = reliability.rows(judged(done))
    return summary


def judged(done: list[dict[str, Any]]) -> list[reliability.Judged]:
    """Every motion that was simulated, verified or not, with what truly came of it."""
    entries = [entry for case in done for entry in case.get("true", ())]
    return [reliability.Judged(e["rate"], e["rate_low"], e["rollouts"], e["code"] == Code.OK.name) for e in entries]


def truths(done: list[dict[str, Any]]) -> dict[str, Any]:
    """What was verified against what is true: the four counts, and the share of the verified that truly succeeds with its interval."""
    counts = Counter((bool(c["success"]), bool(c.get("true_success"))) for c in done)
    verified = counts[True, True] + counts[True, False]
    return {
        "verified_and_succeeds": counts[True, True],
        "verified_but_fails": counts[True, False],
        "refused_but_would_succeed": counts[False, True],
        "refused_and_fails": counts[False, False],
        "verified_is_true": counts[True, True] / verified if verified else None,
        "verified_is_true_interval_95": list(wilson(counts[True, True], verified)),
    }


def _test_sentence(options: Options) -> str:
    """What success means here, in words and numbers."""
    strategy = _strategy(options)
    text = "; ".join(line.strip() for line in words(strategy.goal))
    others = [f"{part}: {key} {value:g}" for part, values in evaluated(options).values_of.items() for key, value in values.items()]
    return text + (f"; of others {', '.join(others)}" if others else "")


def contact_sheet(folder: Path, done: list[dict[str, Any]], success: bool, path: Path) -> None:
    """One picture of the cases that passed, or of those that failed, each with its name and reason."""
    import cv2

    tiles = []
    for case in [c for c in done if bool(c["success"]) is success][:PICTURES]:
        film = folder / f"{_key(case['object'])}.png"
        picture = cv2.imread(str(film)) if film.exists() else None  # OpenCV writes a warning for each that is not there
        if picture is None:
            continue
        label = np.full((22, picture.shape[1], 3), 255, np.uint8)
        cv2.putText(
            label, f"{case['object']}: {case['reason']}"[:90], (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 40), 1, cv2.LINE_AA
        )
        tiles.append(np.concatenate([label, picture]))
    if not tiles:
        path.unlink(missing_ok=True)
        return
    height, width = (max(t.shape[i] for t in tiles) for i in (0, 1))
    sheet: NDArray[np.uint8] = np.full((height * math.ceil(len(tiles) / COLUMNS), width * min(COLUMNS, len(tiles)), 3), 255, np.uint8)
    for index, tile in enumerate(tiles):
        v, u = height * (index // COLUMNS), width * (index % COLUMNS)
        sheet[v : v + tile.shape[0], u : u + tile.shape[1]] = tile
    cv2.imwrite(str(path), sheet)


def _key(name: str) -> str:
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in name)


def _stored(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):
        return None


def attempt(options: Options, case: Case, film: Path | None) -> dict[str, Any]:
    """:func:`run_case` with its wall time; an error that nothing foresaw is a failure of this case alone.  Raises BAD_REQUEST
    for names of nothing, BAD_STRATEGY for a scene that the strategy does not tell."""
    started = time.perf_counter()
    try:
        result = run_case(options, case, film)
    except MagicError:
        raise
    except Exception as error:  # the others are worth the same whatever became of this one
        print("".join(traceback.format_exception(error)), file=sys.stderr, flush=True)
        message = {"code": Code.INTERNAL.name, "message": f"{type(error).__name__}: {error}"}
        result = {"object": case.name, "success": False, "reason": Code.INTERNAL.name, "candidates": [message], "simulations": 0}
        result["seconds"] = {"total": time.perf_counter() - started}
    result["wall"] = time.perf_counter() - started
    return result


def _work(options: Options, case: Case, folder: Path, films: bool) -> dict[str, Any]:
    key = _key(case.name)
    result = attempt(options, case, folder / "films" / f"{key}.png" if films else None)
    path = folder / "cases" / f"{key}.json"
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(result))
    temporary.replace(path)
    return result


def evaluate(options: Options, out: Path, limit: int = 0, jobs: int = 1, films: bool = True, log: Any = print) -> dict[str, Any]:
    """Run all cases that are not stored yet and write ``results.json``, ``summary.txt`` and the contact sheets.  Raises BAD_REQUEST."""
    from joblib import Parallel, delayed

    _check(options)
    todo = all_cases(options)[: limit or None]
    if not todo:
        why = "; controls are things of which geometry tells that they cannot do the task" if options.set == "controls" else ""
        raise MagicError(Code.BAD_REQUEST, f"cases of the set {options.set} of {options.task}", 0, f"a set with a case at least{why}")
    _take_folder(options, out)
    known = {case.name: stored for case in todo if (stored := _stored(out / "cases" / f"{_key(case.name)}.json")) is not None}
    waiting = [case for case in todo if case.name not in known]
    if known:
        log(f"{len(known)} of {len(todo)} cases are done already")
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
    for count, result in enumerate(parallel(delayed(_work)(options, case, out, films) for case in waiting), len(known) + 1):
        known[result["object"]] = result
        good = sum(bool(c["success"]) for c in known.values())
        log(f"[{count}/{len(todo)}] {result['object']}: {result['reason']} ({result['seconds']['total']:.2f} s), {good} of {count} so far")
    done = [known[case.name] for case in todo]
    summary = summarise(options, done)
    (out / "results.json").write_text(json.dumps({"cases": done, "summary": summary}, indent=1))
    text = _summary_text(options, summary)
    if options.source == "images":
        text += _truth_text(summary["truth"], done) + _surface_text(done)
        motions = judged(done)
        title = f"{options.task}, {options.variant}: {len(motions)} motions (number at each point)"
        said, true = "success rate in simulation", "share that truly succeeds"
        reliability.draw(reliability.points(motions), out / "reliability.png", title, said, true)
    (out / "summary.txt").write_text(text)
    if films:
        contact_sheet(out / "films", done, True, out / "successes.png")
        contact_sheet(out / "films", done, False, out / "failures.png")
    log(text)
    return summary


def _check(options: Options) -> None:
    """Refuse what cannot be evaluated before any work."""
    if options.method == "no_feature_pca_patch" and options.features != "dinov2":
        raise MagicError(
            Code.BAD_REQUEST,
            f"features of the method {options.method}",
            options.features,
            "dinov2, which has a PCA and patches to leave out",
        )
    if not 0 <= options.required_rate < 1:
        raise MagicError(Code.BAD_REQUEST, "required rate", options.required_rate, "0 or more, below 1")


def _take_folder(options: Options, out: Path) -> None:
    """Make the folder for the results, or take it up where it is of the same options: what is stored in it belongs to these alone."""
    (out / "cases").mkdir(parents=True, exist_ok=True)
    mark = hashlib.sha256(json.dumps(vars(options), sort_keys=True).encode()).hexdigest()[:16]
    if (out / "options").exists() and (out / "options").read_text() != mark:
        raise MagicError(Code.BAD_REQUEST, "output folder", str(out), "an empty folder, or one of an evaluation with the same options")
    (out / "options").write_text(mark)


def _summary_text(options: Options, summary: dict[str, Any]) -> str:
    """How many cases passed, how long that took, and why the others did not."""
    low, high = summary["interval_95"]
    times = summary["mean_seconds"]
    text = (
        f"{options.task} {options.variant} {options.method} ({options.features}): {summary['successes']} of {summary['cases']} = "
        f"{100 * summary['success_rate']:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %)\n"
        f"mean seconds: perceive {times['perceive']:.3f}, match {times['match']:.3f}, plan {times['plan']:.3f}, verify {times['verify']:.3f}, total {times['total']:.3f}; "
        f"{summary['simulations']} simulations\nreasons: {summary['reasons']}\n"
    )
    if summary["impossible"] and options.set != "controls":
        text += (
            f"impossible by geometry, not counted above: {len(summary['impossible'])}, of which {summary['impossible_successes']} passed\n"
        )
        text += "".join(f"  {name}: {reason}\n" for name, reason in summary["impossible"].items())
    return text


def _truth_text(truth: dict[str, Any], done: list[dict[str, Any]]) -> str:
    """What truly came of the motions, of the verified ones and of all that were simulated; truth: as :func:`truths` has it."""
    verified = truth["verified_and_succeeds"] + truth["verified_but_fails"]
    low, high = truth["verified_is_true_interval_95"]
    share = f" = {100 * truth['verified_is_true']:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %)" if verified else ""
    return (
        f"on the true objects: {truth['verified_and_succeeds']} of {verified} verified motions succeed{share}; of those refused "
        f"{truth['refused_but_would_succeed']} would have succeeded, {truth['refused_and_fails']} not\n"
        f"every simulated motion on the true objects:\n{reliability.table(judged(done))}\n"
    )


def _surface_text(done: list[dict[str, Any]]) -> str:
    """How far the surfaces of the reconstructed tools are off, of those that perception was sure of and of the others, and against what was
    stated."""
    seen = [item for case in done for item in case.get("seen", ())]
    text = ""
    for range_, sure in (("above 0.5", True), ("up to 0.5", False)):
        errors = [item["surface_error"] for item in seen if (item["confidence"] > 0.5) == sure]
        if errors:
            low, middle, high = 1000 * np.percentile(errors, [16, 50, 84])
            text += (
                f"reconstructions of confidence {range_}: surface error {middle:.1f} mm (the middle two thirds {low:.1f} to {high:.1f}) "
                f"of {len(errors)}\n"
            )
    told = [item for item in seen if item["stated_error"] > 0]
    if told:
        below, middle = sum(s["surface_error"] <= s["stated_error"] for s in told), 1000 * np.median([s["stated_error"] for s in told])
        text += f"{below} of {len(told)} surface errors are below what was stated (5 of 6 are to be), {middle:.1f} mm in the middle\n"
    return text


def main(args: list[str] | None = None) -> None:
    """Entry point of ``ros2 run magic_verifier evaluate``."""
    parser = argparse.ArgumentParser(prog="evaluate", description="Success rate of a strategy over a set of objects, in simulation.")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--strategy", dest="task", metavar="DIR", help="folder of the strategy: its path, or its name among --strategies")
    which.add_argument("--task", metavar="NAME", help="the same, by its name")
    parser.add_argument("--variant", default="fg", choices=VARIANTS)
    parser.add_argument("--method", default="magic", choices=METHODS, help="magic, or an ablation of it")
    parser.add_argument(
        "--from", dest="source", default="meshes", choices=SOURCES,
        help="what tools and target are taken for: their meshes, or what perception makes of two cameras' images (then judged on the meshes)",
    )  # fmt: skip
    parser.add_argument(
        "--set", default="own",
        help="one of the sets that the strategy's folder names (own, unseen, ...), alphabet: the capital letters, or controls: what nothing can do",
    )  # fmt: skip
    parser.add_argument("--turns", type=int, default=1, help="turns, drawn by the seed, in which each tool lies")
    parser.add_argument("--features", default="embedded", help="feature backend: auto, embedded, dinov2, dift or sd_dino")
    parser.add_argument("--weights", default="", help="hub name or folder of the backend's weights")
    parser.add_argument("--objects", default="", help="folder of tool meshes, with or without poses.yaml, instead of the project's own set")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the meshes of --objects")
    parser.add_argument(
        "--targets", default="", help=f"folder of target meshes, or a set ({', '.join(TARGET_SETS)}), instead of the project's own"
    )
    parser.add_argument("--limit", type=int, default=0, help="only the first so many cases")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time")
    parser.add_argument(
        "--required-rate",
        type=float,
        default=Options.required_rate,
        help="lower end of the success rate's interval that a motion must have",
    )
    parser.add_argument("--top-k", type=int, default=3, help="candidates tried for a case")
    parser.add_argument("--noise", type=float, default=None, help="the goal's number of that name: sideways velocity noise in target radii")
    parser.add_argument("--strategies", default="", help="folder of strategies; by default the installed ones")
    parser.add_argument(
        "--like",
        default="",
        metavar="STRATEGY",
        help="what is asked of the strategy, and of which things, is that of another: its goal, scene, friction, densities and sets",
    )
    parser.add_argument("--demonstration", default="", help="tool that the strategy is demonstrated with instead, such as mug:1000")
    parser.add_argument("--no-films", action="store_true", help="draw no contact sheets")
    parser.add_argument("--out", required=True, help="folder for results.json, summary.txt and contact sheets")
    given = parser.parse_args(args)
    options = Options(**{field.name: getattr(given, field.name) for field in fields(Options)})
    try:
        evaluate(options, Path(given.out), given.limit, given.jobs, not given.no_films, lambda text: print(text, flush=True))
    except MagicError as error:
        print(f"evaluate: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("evaluate: interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
