"""How a mesh from a file lies or stands on the table.

A folder of meshes may hold ``poses.yaml``, which says it for some or all of them::

    mugs/blue.obj:                      # path of the mesh, relative to the folder
      orientation: [0, 0, 0, 1]         # object from mesh, quaternion xyzw; z of the object is up
      scale: 1.0                        # metres in one unit of the file
      contact:                          # targets only: where tools are to act, in the mesh's own frame and unit
        point: [0.02, 0, 0.15]
        normal: [-0.5, 0, 0.87]         # out of the surface
        direction: [0.87, 0, 0.5]       # along which the target is looked at and the tool moves on to it
    default: {scale: 0.001}             # for the meshes not named

Everything is optional.  Where no orientation is given, the canonical pose is found:
a tool that is matched from above lies on its broad side; one matched from the side
or in section stands or lies so that it holds the most water (a mug upright, a spoon
on its back); what holds none stays as the file has it.  The view is then found by
:func:`magic_core.views.find_view`.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.decomposition import extremes
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_verifier.simulation import MANY_POINTS

#: Cells along the longer side of the height map that water is poured on.
CELLS = 40
#: Water below this share of the bounding box's volume is noise of the height map.
DRY = 0.003


@dataclass(frozen=True)
class PoseEntry:
    """What ``poses.yaml`` says of a mesh; contact (point, normal, direction), each (3,) in the mesh's frame and unit."""

    orientation: NDArray[np.float64] | None = None
    scale: float = 1.0
    contact: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None


def read_poses(folder: Path) -> dict[str, PoseEntry]:
    """The entries of ``folder/poses.yaml`` by relative path, ``default`` among them; empty without the file.

    Raises ``BAD_REQUEST`` naming the entry that cannot be read.
    """
    path = folder / "poses.yaml"
    if not path.is_file():
        return {}
    try:
        data = yaml.safe_load(path.read_text()) or {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise MagicError(Code.BAD_REQUEST, str(path), str(error), "a readable YAML file") from error
    if not isinstance(data, Mapping):
        raise MagicError(Code.BAD_REQUEST, str(path), type(data).__name__, "a map from mesh paths to poses")
    return {str(name): _entry(f"{path}: {name}", entry) for name, entry in data.items()}


def _entry(what: str, data: Any) -> PoseEntry:
    if not isinstance(data, Mapping) or set(data) - {"orientation", "scale", "contact"}:
        raise MagicError(Code.BAD_REQUEST, what, data, "a map with orientation, scale and contact")

    def vector(of: Mapping[str, Any], key: str, length: int) -> NDArray[np.float64]:
        try:
            value = np.asarray(of[key], dtype=float)
        except (KeyError, TypeError, ValueError) as error:
            raise MagicError(Code.BAD_REQUEST, f"{what}: {key}", of.get(key), f"{length} numbers") from error
        if value.shape != (length,) or not np.all(np.isfinite(value)):
            raise MagicError(Code.BAD_REQUEST, f"{what}: {key}", of.get(key), f"{length} finite numbers")
        if key != "point" and np.linalg.norm(value) < 1e-9:
            raise MagicError(Code.BAD_REQUEST, f"{what}: {key}", of.get(key), "not all zero")
        return value

    scale = data.get("scale", 1.0)
    if not isinstance(scale, (int, float)) or not np.isfinite(scale) or scale <= 0:
        raise MagicError(Code.BAD_REQUEST, f"{what}: scale", scale, "a number above 0")
    contact = data.get("contact")
    if contact is not None:
        if not isinstance(contact, Mapping):
            raise MagicError(Code.BAD_REQUEST, f"{what}: contact", contact, "a map with point, normal and direction")
        contact = tuple(vector(contact, key, 3) for key in ("point", "normal", "direction"))
        if np.linalg.norm(np.cross(transforms.unit(contact[1]), transforms.unit(contact[2]))) < 0.1:
            raise MagicError(Code.BAD_REQUEST, f"{what}: contact", "normal along direction", "a normal across the direction")
    return PoseEntry(vector(data, "orientation", 4) if "orientation" in data else None, float(scale), contact)


def posed(mesh: Mesh, kind: str | None, entry: PoseEntry) -> tuple[Mesh, NDArray[np.float64]]:
    """The mesh in its object frame (z up, metres, origin in the middle of its box) and object_from_mesh (4, 4) of the scaled mesh.

    ``kind``: the view that it is to be matched in; ``None`` leaves a mesh without an entry as its file has it.
    """
    mesh = mesh.scaled(entry.scale)
    if entry.orientation is not None:
        turn = transforms.from_quaternion([0, 0, 0], entry.orientation)
    elif kind is not None:
        turn = canonical_turn(mesh, kind)
    else:
        turn = np.eye(4)
    turned = mesh.transformed(turn)
    low, high = turned.bounds
    object_from_mesh = transforms.make(translation=-(low + high) / 2) @ turn
    return mesh.transformed(object_from_mesh), object_from_mesh


def canonical_turn(mesh: Mesh, kind: str) -> NDArray[np.float64]:
    """object_from_mesh (4, 4), a turn alone: how a mesh without a given pose is set on the table (see the module)."""
    box, extents = box_axes(mesh)
    if kind == "top":
        # Already flat: not to be turned by the little that the least box differs from it.
        return np.eye(4) if mesh.extents[2] <= 1.05 * extents[0] + 1e-6 else _turn_up(box[0])
    from magic_core.rendering import Raycaster

    caster = Raycaster([mesh])
    points = mesh.vertices if len(mesh.vertices) <= MANY_POINTS else extremes(mesh.vertices, 300)
    ups = [sign * axis for axis in (*np.eye(3)[::-1], *box) for sign in (1.0, -1.0)]
    water = np.array([capacity(caster, points, _turn_up(up)) for up in ups])
    best = int(np.argmax(water))
    if water[best] < DRY * float(np.prod(np.ptp(transforms.apply(_turn_up(ups[best]), points), axis=0))):
        return np.eye(4)
    # The first of those that hold as much: the file's own axes before the box's.
    first = int(np.argmax(water >= 0.95 * water[best]))
    if first < 6:
        return _turn_up(ups[first])
    # The box of a ladle is tilted: level the rim.
    turn, most = _turn_up(ups[best]), float(water[best])
    for step in np.deg2rad([24.0, 12.0, 6.0, 3.0]):
        for roll, pitch in ((step, 0), (-step, 0), (0, step), (0, -step)):
            tried = transforms.from_rpy(roll, pitch, 0) @ turn
            while (held := capacity(caster, points, tried)) > 1.02 * most:
                turn, most = tried, held
                tried = transforms.from_rpy(roll, pitch, 0) @ turn
    return turn


def _turn_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The least turn (4, 4) that brings a unit direction (3,) to +z."""
    axis = np.cross(up, [0, 0, 1.0])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        return np.eye(4) if up[2] > 0 else transforms.from_rpy(np.pi, 0, 0)
    return transforms.from_rotvec(axis / length * np.arctan2(length, up[2]))


def box_axes(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axes (3, 3) of the least box as rows and its edges (3,), the shortest first; the mesh's own box where there is none."""
    import trimesh

    points = mesh.vertices if len(mesh.vertices) <= 1000 else extremes(mesh.vertices, 300)
    try:
        box_from_mesh, extents = trimesh.bounds.oriented_bounds(points)
    except Exception:  # qhull's and numpy's errors for flat or pointed meshes
        box_from_mesh, extents = np.eye(4), mesh.extents
    order = np.argsort(extents, kind="stable")
    return box_from_mesh[:3, :3][order], np.asarray(extents)[order]


def capacity(caster: Any, points: NDArray[np.float64], turn: NDArray[np.float64]) -> float:
    """Cubic metres of water that stay on a mesh, turned by ``turn`` (4, 4) so that z is up, when it is rained on.

    caster: a :class:`magic_core.rendering.Raycaster` of the mesh as it is; points (N, 3) span its box.  The ground is
    looked at on a grid of CELLS along the longer side.
    """
    turned = transforms.apply(turn, points)
    low, high = turned.min(axis=0), turned.max(axis=0)
    pitch = float((high - low)[:2].max()) / CELLS
    if pitch <= 0:
        return 0.0
    shape = np.maximum(np.ceil((high - low)[:2] / pitch).astype(int), 1)
    x, y = (low[axis] + (np.arange(shape[axis]) + 0.5) * pitch for axis in (0, 1))
    origins = np.empty((shape[0], shape[1], 3))
    origins[..., 0], origins[..., 1], origins[..., 2] = x[:, None], y[None, :], high[2] + 0.01
    back = transforms.inverse(turn)
    distance = caster.cast(transforms.apply(back, origins.reshape(-1, 3)).reshape(origins.shape), -back[:3, 2]).distance
    ground = np.pad(np.where(np.isfinite(distance), high[2] + 0.01 - distance, -np.inf), 1, constant_values=-np.inf)
    # Priority flood (Barnes et al. 2014): water leaves where nothing is below, and stands elsewhere up to the lowest way out.
    level = np.full(ground.shape, np.inf)
    queue = [(-np.inf, int(i), int(j)) for i, j in np.argwhere(~np.isfinite(ground))]
    for _, i, j in queue:
        level[i, j] = -np.inf
    heapq.heapify(queue)
    while queue:
        height, i, j = heapq.heappop(queue)
        for a, b in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if 0 <= a < level.shape[0] and 0 <= b < level.shape[1] and level[a, b] == np.inf:
                level[a, b] = max(height, ground[a, b])
                heapq.heappush(queue, (level[a, b], a, b))
    dry = ~np.isfinite(ground)
    return float((level[~dry] - ground[~dry]).sum() * pitch**2)
