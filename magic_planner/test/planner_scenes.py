"""Small scenes of boxes and cylinders for the tests and the benchmark, with hand-made contacts."""

from __future__ import annotations

import numpy as np
import trimesh

from magic_core import mesh as mesh_module
from magic_core import transforms
from magic_core.contact import Contact, ContactCandidate, contact_frame
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Goal, Physics, Strategy, Waypoint

SIZE = 64
PIXEL = 0.005


def flipped(mesh: Mesh) -> Mesh:
    """The mesh inside out."""
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))


def view(object_from_view: np.ndarray, kind: str = "top") -> CanonicalView:
    mask = np.ones((SIZE, SIZE), dtype=bool)
    return CanonicalView(np.zeros((SIZE, SIZE, 3), np.uint8), mask, PIXEL, object_from_view, kind)


def looking(direction, right) -> np.ndarray:
    """object_from_view at the origin with z along ``direction`` and x along ``right``."""
    return transforms.frame(np.zeros(3), right, direction)


def contact(look: CanonicalView, point, normal) -> Contact:
    """The contact at a point (3,) with a normal (3,) in the view's plane, both in the object frame."""
    pixel = look.pixels(np.asarray(point, dtype=float))
    flat = np.asarray(normal, dtype=float) @ look.object_from_view[:3, :2]
    return Contact(pixel, flat, 0.02, False, 0.02, contact_frame(look, pixel, flat))


def box(extents, centre=(0, 0, 0)) -> Mesh:
    return mesh_module.from_trimesh(trimesh.creation.box(extents=extents)).transformed(transforms.make(translation=centre))


def cylinder(radius: float, height: float) -> Mesh:
    return mesh_module.from_trimesh(trimesh.creation.cylinder(radius=radius, height=height, sections=32))


def item(name: str, pieces, pose: np.ndarray, look: CanonicalView | None = None) -> SceneObject:
    return SceneObject(name, mesh_module.concatenate(list(pieces)), tuple(pieces), pose, look or view(looking([0, 0, -1], [1, 0, 0])))


DOWN = view(looking([0, 0, -1], [0, -1, 0]))


def hook(handle: float = 0.30, thickness: float = 0.02) -> tuple[SceneObject, Contact]:
    """An L hook lying along its x axis: the foot at +x points to +y; its inner side (facing -x) is the contact."""
    pieces = [box([handle, 0.02, thickness]), box([0.02, 0.08, thickness], [handle / 2 - 0.01, 0.05, 0])]
    tool = item("tool", pieces, transforms.from_rpy(0, 0, 0, [0.45, 0.25, thickness / 2]), DOWN)
    return tool, contact(DOWN, [handle / 2 - 0.02, 0.06, 0], [-1, 0, 0])


def standing_cylinder(radius: float = 0.025, at=(0.6, 0.0)) -> tuple[SceneObject, Contact]:
    target = item("target", [cylinder(radius, 2 * radius)], transforms.make(translation=[*at, radius]), DOWN)
    return target, contact(DOWN, [radius, 0, 0], [1, 0, 0])


def candidate(tool: SceneObject, tool_contact: Contact, target_contact: Contact | None, flipped: bool = False) -> ContactCandidate:
    return ContactCandidate(tool.id, tool_contact, target_contact, 0.0, flipped, 1.0, 1.0, 1.0, np.eye(4))


def pulling(waypoints=None, **changes) -> Strategy:
    """A ``plan`` strategy: from above to behind the target, onto it, and 0.25 m towards the robot."""
    tool, tool_contact = hook()
    target, target_contact = standing_cylinder()
    values = {
        "name": "pulling",
        "description": "",
        "view": "top",
        "mode": "plan",
        "tool_view": DOWN,
        "tool_contact": tool_contact,
        "target_view": DOWN,
        "target_contact": target_contact,
        "target_normal": np.array([1.0, 0, 0]),
        "target_view_direction": np.array([0, 0, -1.0]),
        "times": np.array([0.0, 1.0]),
        "target_from_tool": np.stack([np.eye(4)] * 2),
        "tool_mesh": tool.mesh,
        "target_mesh": target.mesh,
        "waypoints": waypoints
        or (
            Waypoint("above", np.array([0.03, 0, -0.10]), "approach", 0.1),
            Waypoint("behind", np.array([0.03, 0, 0]), "approach", 0.1),
            Waypoint("contact", np.zeros(3), "contact", 0.05),
            Waypoint("goal", np.array([-0.25, 0, 0]), "goal", 0.1),
        ),
        "goal": Goal("hook"),
        "physics": Physics(),
    }
    return Strategy(**{**values, **changes})
