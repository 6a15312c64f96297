"""What a case of an evaluation is about: the tool, the target and where it is to be met, by their names."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_verifier.posing import PoseEntry, posed, read_poses

#: How thick (m) a control that has only an outline is.
PLAIN_THICKNESS = 0.016
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
    from magic_matcher.targets import Target

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
