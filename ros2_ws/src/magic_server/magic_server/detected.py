"""Objects that somebody else's detector has found, made whole by their meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_core import conversions
from magic_core.decomposition import convex_pieces
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, check_solid, from_trimesh, load
from magic_core.scene import Scene, SceneObject
from magic_core.upright import placed

#: Endings of mesh files, the first that is there is taken.
ENDINGS = (".ply", ".obj", ".stl", ".glb", ".dae")


class Meshes:
    """The meshes of a folder, in metres, by class id: ``<folder>/<class id>.ply`` and the like; read and cut into pieces once."""

    def __init__(self, folder: str | Path) -> None:
        self._folder = Path(folder).expanduser()
        if not self._folder.is_dir():
            raise MagicError(Code.BAD_REQUEST, "folder of meshes", str(folder), "an existing folder")
        self._known: dict[str, tuple[Mesh, tuple[Mesh, ...]] | None] = {}

    def names(self) -> list[str]:
        """The classes there are."""
        return sorted({p.stem for p in self._folder.iterdir() if p.suffix.lower() in ENDINGS})

    def find(self, name: str) -> tuple[Mesh, tuple[Mesh, ...]] | None:
        """Mesh and convex pieces of a class; None: there is no file of it.  Raises BAD_MESH for one that is no solid."""
        if name not in self._known:
            # A name from a message must not lead out of the folder.
            files = [self._folder / (name + ending) for ending in ENDINGS] if name and Path(name).name == name else []
            path = next((p for p in files if p.is_file()), None)
            if path is None:
                self._known[name] = None
            else:
                mesh = load(path)
                check_solid(mesh, str(path))
                self._known[name] = mesh, convex_pieces(mesh)
        return self._known[name]


def scene_of(
    message: Any,
    meshes: Meshes,
    least_score: float,
    table: NDArray[np.float64],
    base: str,
    base_from: Callable[[Any], NDArray[np.float64]],
    known: Sequence[SceneObject] = (),
) -> Scene:
    """The scene of a vision_msgs/Detection3DArray, in the robot's base frame.

    Of each detection the hypothesis with the best score counts, whose pose is its mesh's; below ``least_score`` the detection is left
    out.  What has no mesh is its box, of confidence 0: something stands there, and what it looks like nobody knows.  Ids are the
    detections' own, else ``<class>_<number>``.  ``known``: fixtures and obstacles, which are there besides.  What was left out and why is
    in the scene's notes.  Raises BAD_REQUEST where two ids are the same.
    """
    base_from_frame = base_from(message.header)
    objects: list[SceneObject] = []
    notes: list[str] = []
    counts: dict[str, int] = {}
    for detection in message.detections:
        best = max(detection.results, key=lambda result: result.hypothesis.score, default=None)
        kind = best.hypothesis.class_id if best is not None else ""
        counts[kind] = counts.get(kind, 0) + 1
        name = detection.id or f"{kind or 'object'}_{counts[kind]}"
        score = float(best.hypothesis.score) if best is not None else 0.0
        if best is not None and not score >= least_score:  # nor is NaN
            notes.append(f"{name} left out: score {score:.2f}, at least {least_score:g} is asked")
            continue
        try:
            found = meshes.find(kind)
            if best is not None and found is not None:
                pose = conversions.pose_from_msg(best.pose.pose)
                objects.append(placed(name, *found, base_from_frame @ pose, "camera", min(score, 1.0)))
            else:
                box = _box(detection)
                pose = conversions.pose_from_msg(detection.bbox.center)
                objects.append(placed(name, box, (box,), base_from_frame @ pose, "camera", 0.0))
                notes.append(f"{name} is a box: there is no mesh of {kind!r} ({', '.join(meshes.names()) or 'none at all'})")
        except MagicError as error:
            notes.append(f"{name} left out: {error.message}")
    ids = [item.id for item in (*objects, *known)]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise MagicError(Code.BAD_REQUEST, "ids of detections and obstacles", ", ".join(twice), "each once")
    stamp = conversions.time_from_msg(message.header.stamp)
    return Scene((*objects, *known), table, stamp, base, notes=tuple(notes))


def _box(detection: Any) -> Mesh:
    size = detection.bbox.size
    edges = np.array([size.x, size.y, size.z])
    if not (np.isfinite(edges).all() and (edges > 0).all()):
        raise MagicError(Code.BAD_MESH, "there is neither a mesh of it nor a box: its size in m", edges.tolist(), "three numbers above 0")
    return from_trimesh(trimesh.creation.box(edges))
