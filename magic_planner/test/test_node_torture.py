"""What nobody should send to the planner node: each goal is answered with a code and a sentence, in bounded time, and the node lives on."""

from __future__ import annotations

import dataclasses
import os
import threading
import time

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import planner_scenes as scenes
import pytest
import trimesh
from planner_graph import DEADLINE, goal, planner

from magic_core import transforms
from magic_core.errors import Code
from magic_core.mesh import Mesh
from magic_core.testing.served import ask, wait

pytest.importorskip("rclpy")
pytest.importorskip("magic_interfaces.action")

#: Seconds of planning that the goals here allow.
ALLOWED = 5.0


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    with planner(tmp_path_factory.mktemp("strategies")) as client:
        yield client


def answered(client, message, *codes):
    """The answer to a goal is one of the codes, says something and comes in time."""
    message.timeout = ALLOWED
    started = time.monotonic()
    result = ask(client, message)
    assert time.monotonic() - started < DEADLINE
    assert result.seconds < ALLOWED + 3.0
    assert result.code in codes, f"{Code(result.code).name}: {result.message}"
    assert len(result.message) > 10
    if result.code != Code.OK:
        assert not result.plan.tool_trajectory.points and not result.plan.arm_trajectory.points, "a refused goal carries a motion"
    return result


def shaped(item, *pieces, mesh=None):
    return dataclasses.replace(item, mesh=mesh or pieces[0], pieces=tuple(pieces))


def tool():
    return scenes.hook()[0]


def target():
    return scenes.standing_cylinder()[0]


def with_holes(mesh):
    return Mesh(mesh.vertices, mesh.faces[::3].copy())


LINE = Mesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]), np.array([[0, 1, 2]], dtype=np.int32))
POINT = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))


@pytest.mark.parametrize("variant", ["fg", "arm"])
@pytest.mark.parametrize("damage", [scenes.flipped, with_holes])
def test_damaged_surfaces_are_planned_for_as_what_they_look_like(graph, damage, variant):
    damaged = shaped(tool(), *(damage(p) for p in tool().pieces), mesh=damage(tool().mesh))
    answered(graph, goal(tool=damaged, variant=variant), Code.OK)
    damaged = shaped(target(), *(damage(p) for p in target().pieces), mesh=damage(target().mesh))
    answered(graph, goal(target=damaged, variant=variant), Code.OK)


@pytest.mark.parametrize("variant", ["fg", "arm"])
@pytest.mark.parametrize(
    ("mesh", "codes"),
    [
        (scenes.box([0.3, 0.05, 0.0]), (Code.BAD_MESH,)),
        (LINE, (Code.BAD_MESH,)),
        (POINT, (Code.BAD_MESH,)),
        (NOTHING, (Code.BAD_MESH,)),
    ],
    ids=["sheet", "line", "point", "nothing"],
)
def test_tools_without_volume(graph, mesh, codes, variant):
    pieces = (mesh,) if len(mesh.vertices) else ()
    answered(graph, goal(tool=dataclasses.replace(tool(), mesh=mesh, pieces=pieces), variant=variant), *codes)


@pytest.mark.parametrize("variant", ["fg", "arm"])
def test_many_triangles(graph, variant):
    """As many as come over ROS in seconds; the core is tested with a million."""
    ball = trimesh.creation.icosphere(subdivisions=5)  # 20,480
    fine = Mesh(ball.vertices * [0.15, 0.01, 0.01], np.asarray(ball.faces, dtype=np.int32))
    answered(graph, goal(tool=shaped(tool(), fine), variant=variant), Code.OK)


@pytest.mark.parametrize("variant", ["fg", "arm"])
@pytest.mark.parametrize(
    ("factor", "codes"),
    [
        (1e-6, (Code.OK, Code.NO_GRASP)),
        (1e3, (Code.OK, Code.PATH_IN_COLLISION, Code.NO_GRASP)),  # nothing is in a floating giant's way
        (1e30, (Code.BAD_MESH,)),
    ],
)
def test_microscopic_and_gigantic_tools(graph, factor, codes, variant):
    item = tool()
    scaled = shaped(
        item, *(Mesh(p.vertices * factor, p.faces) for p in item.pieces), mesh=Mesh(item.mesh.vertices * factor, item.mesh.faces)
    )
    answered(graph, goal(tool=scaled, variant=variant), *codes)


@pytest.mark.parametrize("place", [[3.0, 0, 0.025], [-2.0, 1.0, 0.025], [0.6, 0, 2.5]])
def test_targets_out_of_reach(graph, place):
    far = dataclasses.replace(target(), world_from_object=transforms.make(translation=place))
    answered(graph, goal(target=far), Code.NO_IK, Code.NO_GRASP, Code.JOINT_LIMIT)
    answered(graph, goal(target=far, variant="fg"), Code.OK)  # a floating gripper reaches everything


def test_a_tool_out_of_reach(graph):
    far = dataclasses.replace(tool(), world_from_object=transforms.make(translation=[0, 2.5, 0.01]))
    result = answered(graph, goal(tool=far), Code.NO_IK)
    assert "reach" in result.message


def test_starts_in_collision(graph):
    from magic_core import conversions as convert
    from magic_core.robot import PANDA_HOME

    head = convert.header("panda_link0")
    start = transforms.make(translation=[0.56, -0.06, 0.12])
    message = goal(variant="fg")
    message.obstacles = [convert.object_to_msg(scenes.item("block", [scenes.box([0.3, 0.3, 0.1])], start), head)]
    assert "block" in answered(graph, message, Code.PATH_IN_COLLISION).message
    message = goal()
    message.obstacles = [
        convert.object_to_msg(scenes.item("block", [scenes.box([0.2, 0.2, 0.2])], transforms.make(translation=[0.3, 0, 0.6])), head)
    ]
    assert "block" in answered(graph, message, Code.START_IN_COLLISION).message
    folded = goal()
    folded.start.name = [f"panda_joint{i}" for i in range(1, 8)]
    folded.start.position = [0.0, 1.7, 0.0, -0.1, 0.0, 1.5, 0.8]  # the hand is in the table
    assert "table" in answered(graph, folded, Code.START_IN_COLLISION).message
    bent = goal()
    bent.start.name, bent.start.position = folded.start.name, [*PANDA_HOME[:6], 9.0]
    assert "panda_joint7" in answered(graph, bent, Code.JOINT_LIMIT).message


def _nan_position(message):
    message.tool.pose.position.x = float("nan")


def _nan_vertex(message):
    message.target.mesh.vertices[0].z = float("inf")


def _no_rotation(message):
    message.target.pose.orientation.w = 0.0


def _nan_contact(message):
    message.candidate.tool.object_from_contact.position.y = float("nan")


def _nan_table(message):
    message.table.coef = [0.0, 0.0, float("nan"), 0.0]


def _standing_table(message):
    message.table.coef = [1.0, 0.0, 0.0, 0.0]


def _nan_start(message):
    message.start.name = [f"panda_joint{i}" for i in range(1, 8)]
    message.start.position = [float("nan")] * 7


def _bad_faces(message):
    message.tool.mesh.triangles[0].vertex_indices = [0, 1, 4_000_000]


@pytest.mark.parametrize("variant", ["fg", "arm"])
@pytest.mark.parametrize(
    "change", [_nan_position, _nan_vertex, _no_rotation, _nan_contact, _nan_table, _standing_table, _nan_start, _bad_faces]
)
def test_numbers_that_are_none(graph, change, variant):
    message = goal(variant=variant)
    change(message)
    allowed = (Code.BAD_REQUEST, Code.BAD_MOTION, Code.BAD_MESH, Code.BAD_SCENE, Code.BAD_ENCODING)
    if change is _nan_start and variant == "fg":
        allowed = (*allowed, Code.OK)  # nothing of the arm is used
    answered(graph, message, *allowed)


def test_a_second_goal_is_busy_and_a_cancelled_one_leaves_nothing_running(graph):
    """The first goal is one that takes long: no path round a box about the target."""
    from magic_core import conversions as convert

    head = convert.header("panda_link0")
    slow = goal(timeout=15.0)
    slow.obstacles = [
        convert.object_to_msg(scenes.item(f"wall_{n}", [scenes.box(size)], transforms.make(translation=place)), head)
        for n, (size, place) in enumerate([([0.15, 0.02, 0.35], [0.45, 0.14, 0.175]), ([0.02, 0.3, 0.3], [0.30, 0.30, 0.15])])
    ]
    for _ in range(3):
        heard = threading.Event()
        first = wait(graph.send_goal_async(slow, feedback_callback=lambda _m, heard=heard: heard.set()))
        assert heard.wait(DEADLINE)
        second = ask(graph, goal(variant="fg"))
        started = time.monotonic()
        wait(first.cancel_goal_async())
        answer = wait(first.get_result_async())
        assert answer.result.code in (Code.CANCELED, Code.OK, Code.PATH_IN_COLLISION, Code.NO_GRASP)
        assert time.monotonic() - started < 12.0, "a cancel is answered within one search"
        if second.code == Code.BUSY and answer.result.code == Code.CANCELED:
            break
    else:
        pytest.fail(f"never busy and cancelled: {second.code} {answer.result.code}")
    assert "again" in second.message
    answered(graph, goal(), Code.OK)
