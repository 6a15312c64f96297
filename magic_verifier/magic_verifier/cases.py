"""The cases of an evaluation: which tools and targets there are, how they stand, and where the target is to be met."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_verifier.posing import PoseEntry, posed, read_poses
from magic_verifier.toolsets import Evaluation, evaluation_of

VARIANTS = ("fg", "arm", "fg_no_selection")
#: ``magic``: all of it.  The paper's baselines: ``pca`` and ``fpfh_icp`` align the whole shape, ``dino`` takes the best places of the
#: features, neither refined nor ranked by curvature, ``curvature`` draws contact points at random and ranks them by curvature alone.  The
#: ablations of its Table III: ``no_feature_pca_patch`` (of features that have both), ``no_two_step_curvature`` (without the second estimate
#: and the convexity search), ``no_simulation_verification`` (the best-scored candidate is carried out, unseen by the verifier, which then
#: only judges it).  All but the last get as many candidates as ``magic``, and the same planner and verifier.
BASELINES = ("pca", "fpfh_icp", "curvature")
METHODS = ("magic", *BASELINES, "dino", "no_feature_pca_patch", "no_two_step_curvature", "no_simulation_verification")
#: What the tools of an evaluation are taken for: ``meshes`` as they are, ``images`` as two cameras see them (:mod:`magic_verifier.captured`).
SOURCES = ("meshes", "images")
#: Sets that there are for every strategy, beside those of its own: the capital letters, and negative controls, which no method can do:
#: the strategy's near misses, and plain things of the matcher's own control families (bars, discs, blades, bottles, ...).  Of these the first
#: :data:`CONTROL_COUNT` that geometry forbids (:mod:`magic_verifier.feasibility`) are taken.
SETS = ("alphabet", "controls")
PLAIN = ("bar", "disc", "rod", "torch", "blade", "polygon", "bottle", "driver", "segment", "bent")
CONTROL_COUNT, CONTROL_SEEDS = 12, 60_000
#: How thick (m) a control that has only an outline is.
PLAIN_THICKNESS = 0.016
#: Sets of targets that ``--targets`` takes by name instead of a folder: seeds of the family.
TARGET_SETS = {"mug_tree": tuple(range(3))}
#: How far (m) from the post of a mug tree things are hung on its first peg, at least.
PEG_REACH = 0.05
#: Where tools stand before they are laid somewhere (m).
TOOL_PLACE = (0.45, -0.32)


@dataclass(frozen=True)
class Case:
    """One problem: names of tools (several: the tool is to be chosen) and of the target."""

    name: str
    tools: tuple[str, ...]
    target: str


@dataclass(frozen=True)
class Options:
    """What an evaluation is run with; see the command's ``--help``.  ``task``: the name of a strategy's folder, or its path."""

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
    from magic_verifier.feasibility import impossible

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
    return cases


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


def short_name(name: str) -> str:
    return name.rpartition("//")[2].rpartition("@")[0].rpartition(".")[0] if "//" in name else name


def tool_object(name: str, index: int, kind: str) -> SceneObject:
    """The tool as an object that lies or stands on the table."""
    mesh, pieces, shape, _ = load_object(name, kind)
    low, _ = mesh.bounds
    pose = transforms.make(translation=[*TOOL_PLACE, 0.0005 - float(low[2])])
    object_id = f"tool_{index + 1}"
    if shape is not None:
        return shape.as_object(object_id, pose, kind)
    from magic_core.views import find_view

    return SceneObject(object_id, mesh, pieces, pose, find_view(mesh, pieces, kind), source="known")


@dataclass(frozen=True)
class Meeting:
    """Where on a target tools are to act: point, outward normal and view direction, each (3,), and the radius of curvature (m)."""

    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    direction: NDArray[np.float64]
    radius: float


def scene_for(strategy: Strategy, name: str) -> tuple[SceneObject, tuple[SceneObject, ...], Meeting | None]:
    """The target at the place of the demonstration's, on the table, the fixtures around it, and where tools are to act
    on it (object frame) where that is given rather than found in the target's silhouette."""
    from magic_core.shapes import make
    from magic_core.shapes.fixtures import demonstrated_pose, fixtures

    environment = strategy.environment
    pose = demonstrated_pose(environment)
    meeting = None
    entry = environment.get("target")
    if name == "demonstration" and entry:
        target = make(entry["family"], entry["seed"], **entry["parameters"]).as_object("target", pose)
    elif name == "demonstration":  # one that cameras saw
        from magic_core.decomposition import convex_pieces
        from magic_core.views import find_view

        pieces = convex_pieces(strategy.target_mesh)
        target = SceneObject("target", strategy.target_mesh, pieces, pose, find_view(strategy.target_mesh, pieces, "top"), source="known")
    else:
        mesh, pieces, shape, meeting = load_object(name, None)
        pose = transforms.make(translation=[*pose[:2, 3], -float(mesh.bounds[0][2])])
        if shape is not None:
            target = shape.as_object("target", pose)
        else:
            from magic_core.views import find_view

            target = SceneObject("target", mesh, pieces, pose, find_view(mesh, pieces, "top"), source="known")
    corners = transforms.apply(pose, target.mesh.vertices)
    # The contact point is where the silhouette reaches farthest along the target's normal.
    reach = corners @ strategy.target_normal
    contact = corners[reach > reach.max() - 1e-4].mean(axis=0)
    return target, tuple(fixtures(environment, contact)), meeting


def met_at(meeting: Meeting, target: SceneObject, kind: str) -> Any:
    """The matcher's Target for a given place: seen along the meeting's direction, the contact frame at its point."""
    from magic_core.contact import Contact
    from magic_core.rendering import canonical_view
    from magic_matcher.matching import Target

    along = transforms.unit(meeting.direction)
    normal = transforms.unit(meeting.normal - (meeting.normal @ along) * along)
    view = canonical_view(target.mesh, along, [0, 0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0, 0], kind)
    frame = transforms.frame(meeting.point, normal, along)
    picture = transforms.unit(normal @ view.object_from_view[:3, :2])
    contact = Contact(view.pixels(meeting.point), picture, meeting.radius, False, 3.5 * meeting.radius, frame)
    return Target(target.id, view, contact)


def _peg(shape: Any) -> Meeting:
    """The first peg of a mug tree, approached along it from its free end."""
    region = shape.region("peg_1")
    along = transforms.unit(region.points[0] - region.points[-1])
    distance = np.linalg.norm(region.points[:, :2], axis=1)
    fits = np.flatnonzero(distance >= PEG_REACH)
    index = int(fits[0]) if len(fits) else len(region.points) - 1
    return Meeting(region.points[index], region.normals[index], along, float(shape.parameters["peg_radius"]))


def _plain(family: str, seed: int) -> Any:
    """A plate with the outline of one of the matcher's control families."""
    import shapely

    from magic_core.shapes.shape import assemble
    from magic_core.shapes.solids import plate
    from magic_matcher.plain import outline

    points = outline(family.removeprefix("plain_"), seed)
    part = plate(shapely.Polygon(points).buffer(0), -PLAIN_THICKNESS / 2, PLAIN_THICKNESS / 2, (120, 120, 126))
    return assemble(family, seed, {}, [part], {}, "top", (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))


@lru_cache(maxsize=256)
def load_object(name: str, kind: str | None) -> tuple[Any, Any, Any, Meeting | None]:
    """Mesh and pieces in the object frame, the Shape they came from (None: a file), and where to act on it if that is given."""
    from magic_core import shapes

    if "//" in name:
        from magic_core.decomposition import convex_pieces
        from magic_core.mesh import check_solid, load

        folder, _, rest = name.partition("//")
        path, _, scale = rest.rpartition("@")
        poses = read_poses(Path(folder))
        entry = poses.get(path, poses.get("default", PoseEntry()))
        entry = replace(entry, scale=entry.scale * float(scale))
        loaded = load(Path(folder) / path)
        check_solid(loaded, path)
        mesh, object_from_mesh = posed(loaded, kind, entry)
        meeting = None
        if entry.contact is not None:
            point, normal, direction = entry.contact
            turn = object_from_mesh[:3, :3]
            meeting = Meeting(transforms.apply(object_from_mesh, entry.scale * point), turn @ normal, turn @ direction, 0.006)
        return mesh, convex_pieces(mesh), None, meeting
    family, _, rest = name.partition(":")
    number, *given = rest.split(",")
    parameters: dict[str, float | str] = {}
    for item in given:
        key, _, value = item.partition("=")
        parameters[key] = value if value.isalpha() else float(value)
    meeting = None
    if family == "mug" and not parameters:
        shape = shapes.mug_of_set(int(number))
    elif family == "capital":
        shape = shapes.make(family, 0, glyph=number)
    elif family.startswith("plain_"):
        shape = _plain(family, int(number))
    elif family in ("sphere", "cylinder"):
        size = {"radius": float(number)}
        if family == "cylinder":
            size["half_height"] = float(number)
        shape = shapes.make(family, 0, **size)
    else:
        shape = shapes.make(family, int(number), **parameters)
        meeting = _peg(shape) if family == "mug_tree" else None
    return shape.mesh, shape.pieces, shape, meeting
