"""What MoveIt knows of the world, as obstacles: its messages in, objects out.

Imports neither moveit_msgs nor rclpy: the messages' fields are all that is asked of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from geometry_msgs.msg import Pose
from numpy.typing import NDArray
from shape_msgs.msg import SolidPrimitive

from magic_core import conversions
from magic_core.decomposition import convex_pieces
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, check_solid, concatenate, from_trimesh
from magic_core.scene import SceneObject
from magic_core.upright import placed

#: Sides of what stands for something round.
SIDES = 32

Frames = Callable[[Any], NDArray[np.float64]]


@dataclass(frozen=True)
class Shape:
    """One shape of an obstacle: object_from_shape (4, 4), its mesh and convex pieces in its own frame."""

    object_from_shape: NDArray[np.float64]
    mesh: Mesh
    pieces: tuple[Mesh, ...]


@dataclass(frozen=True)
class Obstacle:
    """What a CollisionObject says: base_from_object (4, 4) and its shapes."""

    base_from_object: NDArray[np.float64]
    shapes: tuple[Shape, ...]


def pose_of(message: Pose) -> NDArray[np.float64]:
    """A pose (4, 4); as in MoveIt a quaternion of zeros, which nobody has filled in, turns nothing."""
    q = message.orientation
    if q.x == q.y == q.z == q.w == 0.0:
        message = Pose(position=message.position)
    return conversions.pose_from_msg(message)


def solid_of(primitive: SolidPrimitive) -> Mesh:
    """A primitive's mesh about its own origin, z along the axis; what is round is enclosed.  Raises BAD_MESH for what is none of these.

    BOX: edges x, y, z; SPHERE: radius; CYLINDER and CONE: height, radius, the origin at half the height, a cone's tip up.
    """
    names = {
        SolidPrimitive.BOX: ("BOX", 3),
        SolidPrimitive.SPHERE: ("SPHERE", 1),
        SolidPrimitive.CYLINDER: ("CYLINDER", 2),
        SolidPrimitive.CONE: ("CONE", 2),
    }
    if primitive.type not in names:
        raise MagicError(Code.BAD_MESH, "type of a primitive", int(primitive.type), ", ".join(name for name, _ in names.values()))
    name, count = names[primitive.type]
    size = [float(v) for v in primitive.dimensions]
    if len(size) < count or not all(np.isfinite(v) and v > 0 for v in size[:count]):
        raise MagicError(Code.BAD_MESH, f"dimensions of a {name}", size, f"{count} finite numbers above 0")
    outside = 1.0 / np.cos(np.pi / SIDES)
    if name == "BOX":
        made = trimesh.creation.box(size[:3])
    elif name == "SPHERE":
        made = trimesh.creation.icosphere(subdivisions=2)
        nearest = np.abs(np.einsum("ij,ij->i", made.face_normals, made.triangles[:, 0])).min()
        made.apply_scale(size[0] / nearest)
    elif name == "CYLINDER":
        made = trimesh.creation.cylinder(size[1] * outside, size[0], sections=SIDES)
    else:
        made = trimesh.creation.cone(size[1] * outside, size[0], sections=SIDES)
        made.apply_translation([0.0, 0.0, -size[0] / 2])
    return from_trimesh(made)


class PlanningWorld:
    """The collision objects that messages have told of, one after another; a whole scene replaces what there was.

    ``base_from(header)`` answers base_from_frame (4, 4) of a message's frame, or raises.  ``own``: ids that this software has told MoveIt
    itself, which are no news.  What cannot be taken is said in the notes that each method returns; an obstacle that cannot be read is
    refused whole, so that half of it is never taken for all.
    """

    def __init__(self, base_from: Frames) -> None:
        self._base_from = base_from
        self._found: dict[str, Obstacle] = {}
        self._cut: dict[bytes, tuple[Mesh, ...]] = {}
        self._made: dict[str, tuple[Obstacle, SceneObject]] = {}

    def take_scene(self, message: Any, own: Collection[str] = ()) -> list[str]:
        """A PlanningScene, whole or a difference."""
        if not message.is_diff:
            self._found.clear()
        notes = [note for item in message.world.collision_objects for note in self.take(item, own)]
        for attached in message.robot_state.attached_collision_objects:
            # It moves with the robot from here on.
            if self._found.pop(attached.object.id, None) is not None or attached.object.id not in own:
                notes.append(f"{attached.object.id} is attached to {attached.link_name} in MoveIt: it is not an obstacle that stands")
        return notes

    def take(self, message: Any, own: Collection[str] = ()) -> list[str]:
        """A CollisionObject: added, removed (all of them where it names none), added to, or moved."""
        name, operation = message.id, message.operation
        if operation == message.REMOVE:
            if name:
                self._found.pop(name, None)
            else:
                self._found.clear()
            return []
        if name in own:
            return []
        if not name:
            raise MagicError(Code.BAD_REQUEST, "id of a collision object", name, "a name")
        before = self._found.get(name)
        if operation == message.MOVE:
            if before is None:
                return [f"{name} is moved, but nobody has said what it is"]
            self._found[name] = replace(before, base_from_object=self._base_from(message.header) @ pose_of(message.pose))
            return []
        if operation not in (message.ADD, message.APPEND):
            raise MagicError(Code.BAD_REQUEST, f"operation of {name}", operation, "ADD, REMOVE, APPEND, MOVE")
        shapes, notes = self._shapes(message)
        if operation == message.APPEND and before is not None:
            # What comes is told in this message's frames, what there is in its own.
            pose = np.linalg.inv(before.base_from_object) @ self._base_from(message.header) @ pose_of(message.pose)
            shapes = tuple(replace(s, object_from_shape=pose @ s.object_from_shape) for s in shapes)
            self._found[name] = replace(before, shapes=before.shapes + shapes)
        elif shapes:
            self._found[name] = Obstacle(self._base_from(message.header) @ pose_of(message.pose), shapes)
        else:
            self._found.pop(name, None)
        return notes

    def names(self) -> frozenset[str]:
        """Ids of what there is."""
        return frozenset(self._found)

    def obstacles(self) -> tuple[SceneObject, ...]:
        """What there is, as known objects in the base's frame; one that has not changed is the same object as before."""
        for name in set(self._made) - set(self._found):
            del self._made[name]
        for name, found in self._found.items():
            if name not in self._made or self._made[name][0] is not found:
                meshes = [s.mesh.transformed(s.object_from_shape) for s in found.shapes]
                pieces = [piece.transformed(s.object_from_shape) for s in found.shapes for piece in s.pieces]
                self._made[name] = found, placed(name, concatenate(meshes), pieces, found.base_from_object, "known")
        return tuple(self._made[name][1] for name in sorted(self._made))

    def _shapes(self, message: Any) -> tuple[tuple[Shape, ...], list[str]]:
        name = message.id
        result = []
        for what, items, poses in (
            ("primitives", message.primitives, message.primitive_poses),
            ("meshes", message.meshes, message.mesh_poses),
        ):
            # Of one shape alone MoveIt lets the pose be left out.
            poses = poses or [Pose()] * min(1, len(items))
            if len(items) != len(poses):
                raise MagicError(Code.BAD_REQUEST, f"poses of {name}'s {what}", len(poses), len(items))
            for item, pose in zip(items, poses):
                if what == "primitives":
                    mesh = solid_of(item)
                    pieces: tuple[Mesh, ...] = (mesh,)
                else:
                    mesh = conversions.mesh_from_msg(item)
                    check_solid(mesh, name)
                    pieces = self._pieces(mesh)
                result.append(Shape(pose_of(pose), mesh, pieces))
        notes = [f"{len(message.planes)} planes of {name} are left out: the table is what is perceived"] if message.planes else []
        return tuple(result), notes

    def _pieces(self, mesh: Mesh) -> tuple[Mesh, ...]:
        """Convex pieces, kept by the mesh's numbers: a scene comes again and again."""
        key = mesh.vertices.tobytes() + mesh.faces.tobytes()
        if key not in self._cut:
            while len(self._cut) >= 64:
                self._cut.pop(next(iter(self._cut)))
            self._cut[key] = convex_pieces(mesh)
        return self._cut[key]
