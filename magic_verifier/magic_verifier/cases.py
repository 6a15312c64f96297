"""The cases of an evaluation: which tools and targets there are, how they stand, and where the target is to be met."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from string import ascii_uppercase

from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.strategy import Strategy
from magic_verifier.feasibility import impossible
from magic_verifier.posing import read_poses
from magic_verifier.subjects import Case, load_object, short_name
from magic_verifier.toolsets import Evaluation, evaluation_of

VARIANTS = ("fg", "arm", "fg_no_selection")
#: ``magic``: all of it.  The paper's baselines: ``pca`` and ``fpfh_icp`` align the whole shape, ``dino`` takes the best places of the
#: features, neither refined nor ranked by curvature, ``curvature`` draws contact points at random and ranks them by curvature alone.  The
#: ablations of its Table III: ``no_feature_pca_patch`` (of features that have both), ``no_two_step_curvature`` (without the second estimate
#: and the convexity search), ``no_simulation_verification`` (the best-scored candidate is carried out, unseen by the verifier, which then
#: only judges it).  All but the last get as many candidates as ``magic``, and the same planner and verifier.
BASELINES = ("pca", "fpfh_icp", "curvature")
METHODS = ("magic", *BASELINES, "dino", "no_feature_pca_patch", "no_two_step_curvature", "no_simulation_verification")
#: What the tools of an evaluation are taken for: ``meshes`` as they are, ``images`` as two cameras see them
#: (:mod:`magic_verifier.captured`).
SOURCES = ("meshes", "images")
#: Sets that there are for every strategy, beside those of its own: the capital letters, and negative controls, which no method can do:
#: the strategy's near misses, and plain things of the matcher's own control families (bars, discs, blades, bottles, ...).  Of these the
#: first :data:`CONTROL_COUNT` that geometry forbids (:mod:`magic_verifier.feasibility`) are taken.
SETS = ("alphabet", "controls")
PLAIN = ("bar", "disc", "rod", "torch", "blade", "polygon", "bottle", "driver", "segment", "bent")
CONTROL_COUNT, CONTROL_SEEDS = 12, 60_000
#: Sets of targets that ``--targets`` takes by name instead of a folder: seeds of the family.
TARGET_SETS = {"mug_tree": tuple(range(3))}


@dataclass(frozen=True)
class Options:
    """What an evaluation is run with; see the command's ``--help``.  ``task`` and ``like``: the name of a strategy's folder, or its
    path."""

    task: str
    variant: str = "fg"
    method: str = "magic"
    features: str = "embedded"
    weights: str = ""
    objects: str = ""
    targets: str = ""
    seed: int = 0
    top_k: int = 3
    noise: float | None = None
    strategies: str = ""
    scale: float = 1.0
    source: str = "meshes"
    set: str = "own"
    turns: int = 1
    demonstration: str = ""
    required_rate: float = 0.7
    like: str = ""


def tool_names(options: Options) -> list[str]:
    """Names of the tools: ``family:seed``, or the paths of meshes under ``objects``; parameters of a family may follow its seed."""
    if options.objects:
        return _meshes(options.objects, options.scale)
    if options.set == "alphabet":
        return [f"capital:{letter}" for letter in ascii_uppercase]
    return evaluated(options).sets[options.set].names(options.seed)


def target_names(options: Options) -> list[str]:
    """Names of the targets: ``family:number``, ``demonstration``, or the paths of meshes under ``targets``."""
    if options.targets in TARGET_SETS:
        return [f"{options.targets}:{seed}" for seed in TARGET_SETS[options.targets]]
    if options.targets:
        return _meshes(options.targets)
    return list(evaluated(options).targets)


def _meshes(folder: str, scale: float = 1.0) -> list[str]:
    """Names ``folder//path@scale`` of the meshes under a folder."""
    root = Path(folder)
    found = sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.suffix.lower() in (".obj", ".ply", ".stl", ".off"))
    if not found:
        raise MagicError(
            Code.BAD_REQUEST, "folder of meshes", folder, f"a folder with obj, ply, stl or off files, or a set: {', '.join(TARGET_SETS)}"
        )
    poses = read_poses(root)
    unknown = sorted(set(poses) - set(found) - {"default"})
    if unknown:
        raise MagicError(Code.BAD_REQUEST, f"{root / 'poses.yaml'}: mesh", unknown[0], found[:20])
    return [f"{root}//{name}@{scale!r}" for name in found]


def check(options: Options) -> None:
    """Raise ``BAD_REQUEST`` for a set that a strategy does not have, or a variant that it is not made for."""
    strategy = strategy_for(options)
    sets = (*evaluated(options).sets, *SETS)
    if options.set not in sets and not (options.set == "own" and options.objects):
        raise MagicError(Code.BAD_REQUEST, f"set of {strategy.name}", options.set, [*sets, "own with --objects DIR"])
    flies = any(waypoint.phase == "strike" for waypoint in strategy.waypoints)
    beside = "row" in strategy.goal.resolved().trial
    if (flies or beside) and (options.variant != "fg" or options.source != "meshes"):
        why = (
            "an arm holds no tool loosely"
            if flies
            else "what the goal's trial puts beside the target is in no picture and no planner's scene"
        )
        raise MagicError(Code.BAD_REQUEST, f"{strategy.name} as", f"{options.variant} from {options.source}", f"fg from meshes: {why}")


@lru_cache(maxsize=8)
def _found(options: Options) -> tuple[Strategy, Evaluation]:
    strategy = strategies.find(options.task, options.strategies or None)
    if options.like:
        asked = strategies.find(options.like)
        strategy = replace(strategy, goal=asked.goal, physics=asked.physics, environment=asked.environment)
    evaluation = evaluation_of(strategy)
    return (shown_by(strategy, options.demonstration) if options.demonstration else strategy), evaluation


def strategy_for(options: Options) -> Strategy:
    """The strategy that is evaluated, as it is demonstrated; raises ``UNKNOWN_STRATEGY``."""
    return _found(options)[0]


def evaluated(options: Options) -> Evaluation:
    """The sets that its folder names; raises ``UNKNOWN_STRATEGY``, ``BAD_STRATEGY``."""
    return _found(options)[1]


def all_cases(options: Options) -> list[Case]:
    """All cases of an evaluation, in their order; each in so many turns of the tool as the options say, the first turn of all first."""
    check(options)
    cases = _cases(options)
    later = [replace(case, name=f"{case.name} turn {turn}") for turn in range(2, options.turns + 1) for case in cases]
    return [*cases, *later]


def _cases(options: Options) -> list[Case]:
    if options.set == "controls" and not options.objects:
        return control_cases(options)
    tools, targets = tool_names(options), target_names(options)
    chosen = evaluated(options)
    if not options.objects and options.set in chosen.sets and chosen.sets[options.set].paired:
        count = len(chosen.sets[options.set].each)
        # So that a family meets all targets, however many there are of both.
        pairs = [(tool, targets[(number + number // count) % len(targets)]) for number, tool in enumerate(tools)]
        return [Case(f"{tool} {short_name(target)}", (tool,), target) for tool, target in pairs]
    if chosen.choose and options.variant == "fg":
        return [Case(short_name(target), tuple(tools), target) for target in targets]
    return [
        Case(short_name(tool) + ("" if len(targets) == 1 else " " + short_name(target)), (tool,), target)
        for tool in tools
        for target in targets
    ]


def control_cases(options: Options) -> list[Case]:
    """Things that cannot do the task with the targets that they are given: near misses, and plain things drawn by the seed."""
    asked = {name: getattr(options, name) for name in ("task", "targets", "seed", "strategies", "demonstration")}
    return list(_control_cases(Options(**asked)))


@lru_cache(maxsize=8)
def _control_cases(options: Options) -> tuple[Case, ...]:
    """The same for all methods and variants: geometry alone is asked, which takes a second or more."""
    strategy = strategy_for(options)
    targets = target_names(options)
    first = CONTROL_SEEDS + 1000 * options.seed
    plain = [f"plain_{family}:{first + number}" for number in range(10) for family in PLAIN]
    cases: list[Case] = []
    for number, tool in enumerate((*evaluated(options).near_misses, *plain)):
        target = targets[number % len(targets)]
        case = Case(f"{tool} {short_name(target)}", (tool,), target)
        if impossible(strategy, case):
            cases.append(case)
        if len(cases) == CONTROL_COUNT:
            break
    return tuple(cases)


def shown_by(strategy: Strategy, name: str) -> Strategy:
    """A strategy demonstrated with another tool: its contact in that tool's first labelled region, moved as the old tool's contact was.

    Raises ``BAD_REQUEST`` for a tool without labelled regions.
    """
    _, _, shape, _ = load_object(name, strategy.view)
    if shape is None or not shape.regions:
        raise MagicError(Code.BAD_REQUEST, "tool of the demonstration", name, "one with a labelled region, such as mug:1000")
    view = shape.view(strategy.view)
    contact = shape.contact(next(iter(shape.regions)), view)
    to_new = strategy.tool_contact.object_from_contact @ transforms.inverse(contact.object_from_contact)
    return replace(
        strategy, tool_view=view, tool_contact=contact, tool_mesh=shape.mesh, target_from_tool=strategy.target_from_tool @ to_new
    )
