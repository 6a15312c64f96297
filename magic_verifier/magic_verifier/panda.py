"""The Panda's description: where it is installed, its joints, its pictures.

The description is that of the package ``example-robot-data`` (URDF, collision and
visual meshes).  Any other arm whose URDF has one chain and two sliding fingers can
be given by its URDF and the folder that ``package://`` stands for.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate, load

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
FINGER_LINKS = ("panda_leftfinger", "panda_rightfinger")
TCP_LINK = "panda_hand_tcp"


@lru_cache(maxsize=1)
def description_folder() -> Path:
    """The folder that ``package://`` stands for in the Panda's URDF, from the installed package example-robot-data."""
    try:
        for file in metadata.files("example-robot-data") or ():
            if file.name == "panda.urdf":
                return Path(str(file.locate())).resolve().parents[4]
    except metadata.PackageNotFoundError:
        pass
    raise MagicError(Code.BAD_REQUEST, "URDF of the Panda", "not found", "the Python package example-robot-data")


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF: parent_from_joint (4, 4), unit axis (3,), limits, effort in N or Nm."""

    name: str
    kind: str
    parent: str
    child: str
    parent_from_joint: NDArray[np.float64]
    axis: NDArray[np.float64]
    lower: float
    upper: float
    effort: float
    velocity: float


def _numbers(text: str | None, default: str) -> NDArray[np.float64]:
    return np.array([float(x) for x in (text or default).split()])


def _origin(element: ET.Element | None) -> NDArray[np.float64]:
    if element is None:
        return np.eye(4)
    return transforms.from_rpy(*_numbers(element.get("rpy"), "0 0 0"), translation=_numbers(element.get("xyz"), "0 0 0"))


class Panda:
    """Joints, forward kinematics and visual meshes of the Panda."""

    def __init__(self) -> None:
        self.root = description_folder()
        self.urdf = self.root / "example-robot-data/robots/panda_description/urdf/panda.urdf"
        tree = ET.parse(self.urdf).getroot()
        self.joints: dict[str, Joint] = {}
        for element in tree.findall("joint"):
            limit, axis = element.find("limit"), element.find("axis")
            self.joints[element.get("name", "")] = Joint(
                element.get("name", ""),
                element.get("type", "fixed"),
                element.find("parent").get("link"),  # type: ignore[union-attr]
                element.find("child").get("link"),  # type: ignore[union-attr]
                _origin(element.find("origin")),
                transforms.unit(_numbers(axis.get("xyz") if axis is not None else None, "1 0 0")),
                float(limit.get("lower", 0)) if limit is not None else 0.0,
                float(limit.get("upper", 0)) if limit is not None else 0.0,
                float(limit.get("effort", 0)) if limit is not None else 0.0,
                float(limit.get("velocity", 0)) if limit is not None else 0.0,
            )
        self._visuals = {link.get("name", ""): link.findall("visual") for link in tree.findall("link")}

    def links(self, positions: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """world_from_link (4, 4) of each link for joint positions (9,): seven of the arm in rad, two fingers in m."""
        values = dict(zip((*ARM_JOINTS, *FINGER_JOINTS), np.asarray(positions, dtype=float), strict=True))
        children = {joint.child for joint in self.joints.values()}
        poses = {link: np.eye(4) for link in self._visuals if link not in children}
        waiting = list(self.joints.values())
        while waiting:
            ready = [joint for joint in waiting if joint.parent in poses]
            if not ready:
                raise MagicError(Code.BAD_REQUEST, f"joints of {self.urdf.name}", [j.name for j in waiting], "a tree")
            for joint in ready:
                move = np.eye(4)
                if joint.kind in ("revolute", "continuous"):
                    move = transforms.from_rotvec(values[joint.name] * joint.axis)
                elif joint.kind == "prismatic":
                    move = transforms.make(translation=values[joint.name] * joint.axis)
                poses[joint.child] = poses[joint.parent] @ joint.parent_from_joint @ move
                waiting.remove(joint)
        return poses

    def visual(self, positions: NDArray[np.float64]) -> list[Mesh]:
        """Coloured meshes of the links in world coordinates."""
        poses = self.links(positions)
        return [mesh.transformed(poses[name]) for name in poses if (mesh := self._mesh(name)) is not None]

    def _mesh(self, link: str) -> Mesh | None:
        parts = []
        for visual in self._visuals[link]:
            mesh = visual.find("geometry/mesh")
            if mesh is not None:
                path = self.root / mesh.get("filename", "").removeprefix("package://")
                parts.append(_load(path).transformed(_origin(visual.find("origin"))))
        return concatenate(parts) if parts else None


@lru_cache(maxsize=32)
def _load(path: Path) -> Mesh:
    return read_collada(path) if path.suffix.lower() == ".dae" else load(path)


def read_collada(path: Path) -> Mesh:
    """The triangles of a COLLADA file with their diffuse colours; what the Panda's visual meshes need, no more.

    Open3D's wheels and trimesh without pycollada read no COLLADA.  Triangle lists, nodes with matrices, plain
    colours; no textures, no polygons with holes.
    """
    try:
        text = re.sub(r'\sxmlns="[^"]*"', "", path.read_text(), count=1)
        root = ET.fromstring(text)
        effects = {}
        for effect in root.iterfind("library_effects/effect"):
            color = effect.find(".//diffuse/color")
            rgb = _numbers(color.text if color is not None else None, "0.7 0.7 0.7 1")[:3]
            effects["#" + effect.get("id", "")] = (255 * rgb.clip(0, 1) ** 0.6).astype(np.uint8)
        materials = {}
        for material in root.iterfind("library_materials/material"):
            instance = material.find("instance_effect")
            materials[material.get("id", "")] = effects.get(instance.get("url", "") if instance is not None else "")
        geometries = {"#" + g.get("id", ""): g for g in root.iterfind("library_geometries/geometry")}
        parts: list[Mesh] = []

        def visit(node: ET.Element, pose: NDArray[np.float64]) -> None:
            matrix = node.find("matrix")
            if matrix is not None:
                pose = pose @ _numbers(matrix.text, "").reshape(4, 4)
            for instance in node.iterfind("instance_geometry"):
                symbols = {b.get("symbol", ""): b.get("target", "#")[1:] for b in instance.iterfind(".//instance_material")}
                parts.extend(_collada_geometry(geometries[instance.get("url", "")], pose, symbols, materials))
            for child in node.iterfind("node"):
                visit(child, pose)

        for node in root.iterfind("library_visual_scenes/visual_scene/node"):
            visit(node, np.eye(4))
        return concatenate(parts)
    except (OSError, ET.ParseError, KeyError, ValueError, AttributeError) as error:
        raise MagicError(Code.BAD_MESH, f"mesh file {path.name}", str(error), "a COLLADA file of triangles") from error


def _collada_geometry(geometry: ET.Element, pose: NDArray[np.float64], symbols: dict[str, str], materials: dict) -> list[Mesh]:
    mesh = geometry.find("mesh")
    if mesh is None:
        return []
    sources = {
        s.get("id", ""): _numbers(s.findtext("float_array"), "").reshape(-1, 3)
        for s in mesh.iterfind("source")
        if "position" in s.get("id", "")
    }
    positions = {
        "#" + v.get("id", ""): sources[i.get("source", "#")[1:]]
        for v in mesh.iterfind("vertices")
        for i in v.iterfind("input")
        if i.get("semantic") == "POSITION"
    }
    parts = []
    for triangles in mesh.iterfind("triangles"):
        inputs = triangles.findall("input")
        stride = 1 + max(int(i.get("offset", 0)) for i in inputs)
        vertex = next(i for i in inputs if i.get("semantic") == "VERTEX")
        indices = np.array((triangles.findtext("p") or "").split(), dtype=np.int64).reshape(-1, stride)[:, int(vertex.get("offset", 0))]
        points = positions[vertex.get("source", "")]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        color = materials.get(symbols.get(triangles.get("material", ""), triangles.get("material", "")))
        part = Mesh(points, indices.reshape(-1, 3))
        parts.append(part.painted(tuple(int(c) for c in (color if color is not None else (200, 200, 205)))))
    return parts
