"""Meshes of an arm's links where its joints put them, from visual and collision shapes, and COLLADA files of them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate, from_trimesh, load
from magic_core.robot import Description, Shape, numbers

#: Of what has no colour of its own, RGB.
PLAIN = (200, 200, 205)


class RobotPictures:
    """Coloured meshes of an arm's links; a link without a readable visual shape is shown by its collision shapes."""

    def __init__(self, robot: Description) -> None:
        self._robot = robot
        self._meshes = {link: link_mesh(robot, link) for link in robot.links}

    def at(self, joints: NDArray[np.float64], world_from_base: NDArray[np.float64] | None = None) -> list[Mesh]:
        """The meshes in world coordinates for (J + 2,): the arm's joints, then the fingers; the base
        stands in the world's origin by default."""
        poses = self._robot.poses(self._robot.arm_positions(joints))
        base = np.eye(4) if world_from_base is None else np.asarray(world_from_base, dtype=float)
        return [mesh.transformed(base @ poses[link]) for link, mesh in self._meshes.items() if mesh is not None]


def link_mesh(robot: Description, link: str, kinds: Sequence[str] = ("visual", "collision")) -> Mesh | None:
    """The shapes of the first of ``kinds`` that a link has and that can be read, as one mesh in the link's frame; ``None``: it has none."""
    for what in kinds:
        try:
            parts = [shape_mesh(shape) for shape in robot.shapes(link, what)]
        except MagicError:  # a picture in another format, or a file that is not installed
            continue
        if parts:
            return concatenate(parts)
    return None


def shape_mesh(shape: Shape) -> Mesh:
    """A shape as a coloured mesh in its link's frame; raises BAD_MESH for a file that is missing or cannot be read."""
    if shape.kind == "mesh":
        if shape.file is None:
            raise MagicError(Code.BAD_MESH, "mesh file of a link", "not found", "an existing file")
        mesh = _load(shape.file)
        mesh = Mesh(mesh.vertices * np.array(shape.size), mesh.faces, mesh.colors)
    else:
        mesh = from_trimesh(_solid(shape.kind, shape.size))
        mesh = Mesh(mesh.vertices, mesh.faces)
    if mesh.colors is None or shape.color is not None:
        mesh = mesh.painted(shape.color or PLAIN)
    return mesh.transformed(shape.link_from_shape)


def _solid(kind: str, size: Sequence[float]) -> trimesh.Trimesh:
    make = trimesh.creation
    if kind == "box":
        return make.box(extents=size)
    if kind == "sphere":
        return make.icosphere(3, size[0])
    if kind == "cylinder":
        return make.cylinder(size[0], size[1])
    capsule = make.capsule(radius=size[0], height=size[1])
    capsule.apply_translation(-capsule.bounds.mean(axis=0))  # trimesh's stands on the origin
    return capsule


@lru_cache(maxsize=32)
def _load(path: Path) -> Mesh:
    return read_collada(path) if path.suffix.lower() == ".dae" else load(path)


def read_collada(path: Path) -> Mesh:
    """The triangles of a COLLADA file with their diffuse colours; what pictures of arms need, no more.

    Open3D's wheels and trimesh without pycollada read no COLLADA.  Triangle and polygon lists, nodes with matrices, plain
    colours; no textures, no polygons with holes.
    """
    try:
        text = re.sub(r'\sxmlns="[^"]*"', "", path.read_text(), count=1)
        root = ET.fromstring(text)
        unit = root.find("asset/unit")
        metres = float(unit.get("meter", 1)) if unit is not None else 1.0
        effects = {}
        for effect in root.iterfind("library_effects/effect"):
            color = effect.find(".//diffuse/color")
            rgb = numbers(color.text if color is not None else None, "0.7 0.7 0.7 1")[:3]
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
                pose = pose @ numbers(matrix.text, "").reshape(4, 4)
            for instance in node.iterfind("instance_geometry"):
                symbols = {b.get("symbol", ""): b.get("target", "#")[1:] for b in instance.iterfind(".//instance_material")}
                parts.extend(_collada_geometry(geometries[instance.get("url", "")], pose, symbols, materials))
            for child in node.iterfind("node"):
                visit(child, pose)

        for node in root.iterfind("library_visual_scenes/visual_scene/node"):
            visit(node, np.diag([metres, metres, metres, 1.0]))
        return concatenate(parts)
    except (OSError, ET.ParseError, KeyError, ValueError, AttributeError) as error:
        raise MagicError(Code.BAD_MESH, f"mesh file {path.name}", str(error), "a COLLADA file of triangles") from error


def _collada_geometry(geometry: ET.Element, pose: NDArray[np.float64], symbols: dict[str, str], materials: dict) -> list[Mesh]:
    mesh = geometry.find("mesh")
    if mesh is None:
        return []
    sources = {
        s.get("id", ""): numbers(s.findtext("float_array"), "").reshape(-1, 3)
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
    for faces in (*mesh.iterfind("triangles"), *mesh.iterfind("polylist")):
        inputs = faces.findall("input")
        stride = 1 + max(int(i.get("offset", 0)) for i in inputs)
        vertex = next(i for i in inputs if i.get("semantic") == "VERTEX")
        indices = np.array((faces.findtext("p") or "").split(), dtype=np.int64).reshape(-1, stride)[:, int(vertex.get("offset", 0))]
        if faces.tag == "polylist":
            indices = _fans(indices, np.array((faces.findtext("vcount") or "").split(), dtype=np.int64))
        points = positions[vertex.get("source", "")]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        color = materials.get(symbols.get(faces.get("material", ""), faces.get("material", "")))
        part = Mesh(points, indices.reshape(-1, 3))
        parts.append(part.painted(tuple(int(c) for c in (color if color is not None else PLAIN))))
    return parts


def _fans(corners: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Corners (N,) of polygons with ``counts`` (P,) corners each, cut into triangles about the first corner of each."""
    first = np.repeat(np.cumsum(counts) - counts, counts - 2)
    step = np.concatenate([np.arange(count - 2) for count in counts]) if len(counts) else np.zeros(0, np.int64)
    return corners[np.stack([first, first + step + 1, first + step + 2], axis=1)]
