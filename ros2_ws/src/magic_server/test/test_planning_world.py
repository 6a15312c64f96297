"""MoveIt's world in: what its messages say becomes obstacles, and nothing else does."""

import numpy as np
import pytest
from foreign import MOVEIT
from geometry_msgs.msg import Pose
from hypothesis import given, settings
from hypothesis import strategies as st
from shape_msgs.msg import Plane, SolidPrimitive
from std_msgs.msg import Header

from magic_core import conversions, transforms
from magic_core.errors import Code, MagicError
from magic_server.planning_world import PlanningWorld, pose_of, solid_of
from magic_server.testing import fakes

LIFTED = transforms.make(translation=[0.0, 0.0, 0.5])


def base_from(header):
    """Frames as a robot on a stand has them."""
    if header.frame_id in ("", "panda_link0"):
        return np.eye(4)
    if header.frame_id == "stand":
        return LIFTED
    raise MagicError(Code.NO_TRANSFORM, "frame", header.frame_id, "panda_link0, stand")


def primitive(kind, *dimensions):
    return SolidPrimitive(type=kind, dimensions=[float(d) for d in dimensions])


def collision_object(name, *shapes, at=(0.5, 0.0, 0.1), frame="panda_link0", operation=None):
    out = MOVEIT.CollisionObject()
    out.id, out.header = name, Header(frame_id=frame)
    out.operation = operation or MOVEIT.CollisionObject.ADD
    out.pose = conversions.pose_to_msg(transforms.make(translation=at))
    out.primitives, out.primitive_poses = list(shapes), [Pose() for _ in shapes]
    return out


def where(world):
    """Names, and lower and upper corners in the base's frame."""
    found = {}
    for item in world.obstacles():
        assert item.source == "known" and item.pieces and item.view.mask.any()
        found[item.id] = transforms.apply(item.world_from_object, item.mesh.vertices)
    return {name: np.array([v.min(axis=0), v.max(axis=0)]) for name, v in found.items()}


@pytest.mark.parametrize(
    ("kind", "dimensions", "inner"),
    [
        (SolidPrimitive.BOX, (0.1, 0.2, 0.3), [0.05, 0.1, 0.15]),
        (SolidPrimitive.SPHERE, (0.1,), [0.1, 0.1, 0.1]),
        (SolidPrimitive.CYLINDER, (0.3, 0.1), [0.1, 0.1, 0.15]),
        (SolidPrimitive.CONE, (0.3, 0.1), [0.1, 0.1, 0.15]),
    ],
)
def test_a_primitive_is_enclosed_and_no_wider_than_it_must_be(kind, dimensions, inner):
    mesh = solid_of(primitive(kind, *dimensions))
    assert mesh.to_trimesh().is_watertight and mesh.to_trimesh().volume > 0
    low, high = mesh.bounds
    assert np.all(high >= np.array(inner) - 1e-9) and np.all(high <= 1.06 * np.array(inner))
    np.testing.assert_allclose(low, -high, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([SolidPrimitive.SPHERE, SolidPrimitive.CYLINDER, SolidPrimitive.CONE]), st.integers(0, 2**31))
def test_no_point_of_what_is_round_lies_outside_of_what_stands_for_it(kind, seed):
    rng = np.random.default_rng(seed)
    radius, height = rng.uniform(0.02, 0.5, 2)
    mesh = solid_of(primitive(kind, radius) if kind == SolidPrimitive.SPHERE else primitive(kind, height, radius))
    directions = transforms.unit(rng.normal(size=(200, 3))) if kind == SolidPrimitive.SPHERE else None
    if directions is not None:
        points = radius * directions
    else:
        z, angle = rng.uniform(-0.5, 0.5, 200), rng.uniform(0, 2 * np.pi, 200)
        reach = radius * (np.ones(200) if kind == SolidPrimitive.CYLINDER else 0.5 - z)
        points = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), height * z])
    solid = mesh.to_trimesh()
    along = np.einsum("fj,pj->pf", solid.face_normals, points)
    assert np.all(along <= np.einsum("fj,fj->f", solid.face_normals, solid.triangles[:, 0]) + 1e-9)


@pytest.mark.parametrize("dimensions", [(0.1,), (0.1, -0.2, 0.1), (0.1, float("nan"), 0.1), ()])
def test_a_box_without_edges_is_refused(dimensions):
    with pytest.raises(MagicError) as caught:
        solid_of(primitive(SolidPrimitive.BOX, *dimensions))
    assert caught.value.code == Code.BAD_MESH


def test_a_quaternion_that_nobody_filled_in_turns_nothing():
    message = Pose()
    message.orientation.w = 0.0
    np.testing.assert_array_equal(pose_of(message), np.eye(4))


def test_objects_are_added_moved_added_to_and_removed():
    world, kind = PlanningWorld(base_from), MOVEIT.CollisionObject
    box = primitive(SolidPrimitive.BOX, 0.2, 0.1, 0.2)
    assert world.take(collision_object("shelf", box)) == []
    np.testing.assert_allclose(where(world)["shelf"], [[0.4, -0.05, 0.0], [0.6, 0.05, 0.2]], atol=1e-6)
    # The same again, in another frame: it replaces.
    world.take(collision_object("shelf", box, at=(0.5, 0.0, -0.4), frame="stand"))
    np.testing.assert_allclose(where(world)["shelf"], [[0.4, -0.05, 0.0], [0.6, 0.05, 0.2]], atol=1e-6)
    moved = collision_object("shelf", at=(0.5, 0.3, 0.1), operation=kind.MOVE)
    assert world.take(moved) == []
    np.testing.assert_allclose(where(world)["shelf"], [[0.4, 0.25, 0.0], [0.6, 0.35, 0.2]], atol=1e-6)
    # A second box upon it, told from elsewhere.
    world.take(collision_object("shelf", box, at=(0.5, 0.3, 0.3), operation=kind.APPEND))
    np.testing.assert_allclose(where(world)["shelf"], [[0.4, 0.25, 0.0], [0.6, 0.35, 0.4]], atol=1e-6)
    assert len(world.obstacles()[0].pieces) == 2
    world.take(collision_object("post", primitive(SolidPrimitive.CYLINDER, 0.4, 0.02), operation=kind.APPEND))
    assert set(where(world)) == world.names() == {"shelf", "post"}
    kept = world.obstacles()
    world.take(collision_object("third", box, at=(-0.5, 0.0, 0.1)))
    assert [item for item in world.obstacles() if item.id != "third"] == list(kept), "what has not changed is not made again"
    world.take(collision_object("third", operation=kind.REMOVE))
    world.take(collision_object("shelf", operation=kind.REMOVE))
    assert set(where(world)) == {"post"}
    assert "nobody has said" in world.take(collision_object("ghost", operation=kind.MOVE))[0]
    world.take(collision_object("", operation=kind.REMOVE))
    assert where(world) == {}


def test_a_mesh_is_cut_into_convex_pieces_once():
    world = PlanningWorld(base_from)
    message = collision_object("bracket")
    message.meshes, message.mesh_poses = [conversions.mesh_to_msg(fakes.box(0.1))], [Pose()]
    world.take(message)
    first = world.obstacles()[0]
    np.testing.assert_allclose(first.mesh.extents, [0.1, 0.1, 0.1], atol=1e-6)
    cut = dict(world._cut)
    world.take(message)
    assert world._cut == cut and len(cut) == 1


def test_a_scene_replaces_and_a_difference_adds():
    world = PlanningWorld(base_from)
    box = primitive(SolidPrimitive.BOX, 0.1, 0.1, 0.1)

    def scene(is_diff, *objects):
        message = MOVEIT.PlanningScene()
        message.is_diff = is_diff
        message.world.collision_objects = list(objects)
        return message

    world.take_scene(scene(False, collision_object("a", box), collision_object("b", box)))
    world.take_scene(scene(True, collision_object("c", box)))
    assert set(where(world)) == {"a", "b", "c"}
    # What this software has told MoveIt comes back, and is no obstacle.
    world.take_scene(
        scene(False, collision_object("b", box), collision_object("object_1", box), collision_object("table", box)), {"object_1", "table"}
    )
    assert set(where(world)) == {"b"}
    # What is attached moves with the robot.
    carried = scene(True)
    attached = MOVEIT.AttachedCollisionObject()
    attached.link_name, attached.object = "panda_hand", collision_object("b", box)
    carried.robot_state.attached_collision_objects = [attached]
    (note,) = world.take_scene(carried)
    assert "attached to panda_hand" in note and where(world) == {}


def test_what_cannot_be_taken_is_said_and_half_of_it_is_not_taken():
    world = PlanningWorld(base_from)
    box = primitive(SolidPrimitive.BOX, 0.1, 0.1, 0.1)
    floor = collision_object("floor", box)
    floor.planes, floor.plane_poses = [Plane()], [Pose()]
    assert "planes of floor are left out" in world.take(floor)[0]
    for bad, code in (
        (collision_object("a", box, primitive(SolidPrimitive.PRISM, 0.1)), Code.BAD_MESH),
        (collision_object("a", box, frame="moon"), Code.NO_TRANSFORM),
        (collision_object("", box), Code.BAD_REQUEST),
        (collision_object("a", box, operation=b"\x09"), Code.BAD_REQUEST),
    ):
        with pytest.raises(MagicError) as caught:
            world.take(bad)
        assert caught.value.code == code
    short = collision_object("a", box, box)
    short.primitive_poses = [Pose()]
    with pytest.raises(MagicError, match="poses of a's primitives"):
        world.take(short)
    assert set(where(world)) == {"floor"}
