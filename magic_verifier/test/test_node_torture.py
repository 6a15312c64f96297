"""What nobody should send to the verifier node: each goal is answered with a code and a sentence, in bounded time, and the node lives
on."""

import os
import threading
import time
from dataclasses import replace

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import pytest
import scenes
import trimesh

pytest.importorskip("rclpy")

from verifier_graph import goal_message, slow_plan, verifier

from magic_core import conversions as convert
from magic_core import transforms
from magic_core.errors import Code
from magic_core.mesh import Mesh
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.testing.served import ask, wait

#: Seconds that a goal here may take.
ALLOWED = 60.0


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    with verifier(tmp_path_factory.mktemp("strategies")) as client:
        yield client


def answered(client, goal, *codes):
    """The answer to a goal is one of the codes, says something and comes in time."""
    goal.timeout = ALLOWED
    started = time.monotonic()
    result = ask(client, goal)
    assert time.monotonic() - started < ALLOWED + 5.0
    assert result.code in codes, f"{Code(result.code).name}: {result.message}"
    assert result.success == (result.code == Code.OK)
    assert len(result.message) > 10
    return result


def parts():
    """Tool, target and plan of a pull that passes."""
    _, tool, target, plan = scenes.hooking("L")
    return tool, target, plan


def of(item, *pieces):
    return replace(item, mesh=pieces[0], pieces=tuple(pieces))


def damaged(mesh, how):
    faces = mesh.faces[:, ::-1] if how == "flipped" else mesh.faces[::3]
    return Mesh(mesh.vertices, np.ascontiguousarray(faces))


@pytest.mark.parametrize("how", ["flipped", "holes"])
def test_damaged_surfaces(graph, how):
    """A convex piece is what its corners span: whatever its triangles are, the verdict is that on the whole one."""
    tool, target, _ = parts()
    whole = answered(graph, goal_message(target=of(target, target.pieces[0])), Code.OK, Code.DRIFT, Code.LOST_CONTACT)
    broken = answered(graph, goal_message(target=of(target, damaged(target.pieces[0], how))), whole.code)
    assert (broken.message, broken.rollouts) == (whole.message, whole.rollouts)
    whole = answered(graph, goal_message(tool=of(tool, *tool.pieces)), Code.OK, Code.DRIFT, Code.LOST_CONTACT)
    broken = answered(graph, goal_message(tool=of(tool, *(damaged(p, how) for p in tool.pieces))), whole.code)
    assert (broken.message, broken.rollouts) == (whole.message, whole.rollouts)


@pytest.mark.parametrize(
    "mesh",
    [
        Mesh(np.array([[0, 0, 0], [0.05, 0, 0], [0.05, 0.05, 0], [0, 0.05, 0]]), np.array([[0, 1, 2], [0, 2, 3]])),
        Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]), np.array([[0, 1, 2]])),
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])),
    ],
    ids=["sheet", "line", "point"],
)
def test_things_without_volume(graph, mesh):
    tool, target, _ = parts()
    answered(graph, goal_message(target=of(target, mesh)), Code.BAD_MESH)
    answered(graph, goal_message(tool=of(tool, mesh)), Code.BAD_MESH)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_microscopic_and_gigantic_things(graph, factor):
    tool, target, _ = parts()
    answered(graph, goal_message(target=of(target, *(p.scaled(factor) for p in target.pieces))), Code.BAD_SCENE)
    answered(graph, goal_message(tool=of(tool, *(p.scaled(factor) for p in tool.pieces))), Code.BAD_SCENE)


def test_many_triangles(graph):
    """As many as come over ROS in a second; the core is tested with a million."""
    _, target, _ = parts()
    ball = trimesh.creation.icosphere(6, 0.025)  # 81,920
    goal = goal_message("pulling", target=of(target, Mesh(ball.vertices, ball.faces)))
    result = answered(graph, goal, Code.OK, Code.DRIFT, Code.LOST_CONTACT)
    goal.want_film = True
    again = answered(graph, goal, result.code)
    assert len(again.film.data) and again.message == result.message


def test_more_triangles_than_are_taken(graph, monkeypatch):
    monkeypatch.setattr(convert, "MOST_TRIANGLES", 1000)
    _, target, _ = parts()
    ball = trimesh.creation.icosphere(4, 0.025)  # 5,120
    result = answered(graph, goal_message(target=of(target, Mesh(ball.vertices, ball.faces))), Code.BAD_MESH)
    assert "triangles of target: 10240" in result.message and "1000" in result.message


def test_targets_out_of_reach_and_below_the_table(graph):
    _, target, _ = parts()
    for place, code in (([0.6, 3.0, 0.025], Code.LOST_CONTACT), ([0.6, 0, -0.4], Code.BAD_SCENE), ([1e7, 0, 0.025], None)):
        moved = replace(target, world_from_object=transforms.make(translation=place))
        codes = (code,) if code is not None else (Code.SIMULATION_EXPLODED, Code.BAD_SCENE, Code.LOST_CONTACT)
        answered(graph, goal_message(target=moved), *codes)


def test_a_start_in_collision(graph):
    _, _, plan = parts()
    goal = goal_message()
    inside = scenes.item("box", [scenes.block((-0.03, 0.03), (-0.03, 0.03), (-0.03, 0.03))], plan.tool_motion.world_from_tool[0])
    goal.obstacles = [convert.object_to_msg(inside, convert.header("panda_link0"))]
    assert "box" in answered(graph, goal, Code.PRE_CONTACT_COLLISION).message


def test_a_simulation_that_explodes(graph):
    """A motion of ten kilometres a second is refused as it stands; a target in the tool bursts, or not."""
    _, target, plan = parts()
    start = target.world_from_object @ transforms.make(translation=[0.2, 0, 0])
    poses = np.repeat(start[None], 3, axis=0)
    poses[1, 0, 3] -= 0.4
    poses[2, 0, 3] -= 100.0
    wild = MotionPlan("fg", ToolMotion(np.array([0.0, 0.004, 0.01]), poses, (Phase("contact", 0.0, 0.004), Phase("goal", 0.004, 0.01))))
    codes = (Code.SIMULATION_EXPLODED, Code.LOST_CONTACT, Code.DRIFT, Code.UNSTABLE, Code.GOAL_NOT_REACHED)
    answered(graph, goal_message(plan=wild), Code.BAD_MOTION)
    overlapping = replace(target, world_from_object=plan.tool_motion.world_from_tool[0] @ transforms.make(translation=[0.01, 0, 0.015]))
    answered(graph, goal_message(target=overlapping), *codes, Code.PRE_CONTACT_COLLISION)


def _nan_pose(goal):
    goal.tool.pose.position.z = float("nan")


def _nan_vertex(goal):
    goal.target.pieces[0].vertices[0].x = float("inf")


def _nan_motion(goal):
    goal.plan.tool_trajectory.points[3].transforms[0].translation.x = float("nan")


def _no_rotation(goal):
    goal.plan.tool_trajectory.points[3].transforms[0].rotation.w = 0.0
    goal.plan.tool_trajectory.points[3].transforms[0].rotation.z = 0.0


def _backwards(goal):
    goal.plan.tool_trajectory.points[5].time_from_start.sec = 100


def _nan_table(goal):
    goal.table.coef = [0.0, 0.0, float("nan"), 0.0]


def _missing_face(goal):
    goal.tool.mesh.triangles[0].vertex_indices = [0, 1, 4_000_000]


@pytest.mark.parametrize("change", [_nan_pose, _nan_vertex, _nan_motion, _no_rotation, _backwards, _nan_table, _missing_face])
def test_numbers_that_are_none(graph, change):
    goal = goal_message()
    change(goal)
    answered(graph, goal, Code.BAD_REQUEST, Code.BAD_MOTION, Code.BAD_MESH, Code.BAD_SCENE)


def test_a_motion_without_end_is_refused(graph):
    goal = goal_message()
    goal.plan.tool_trajectory.points[-1].time_from_start.sec = 10**6
    answered(graph, goal, Code.BAD_SCENE, Code.BAD_MOTION)


def test_goals_at_once_are_refused_and_a_cancel_ends_the_running_one_only(graph):
    running = threading.Event()
    first = wait(graph.send_goal_async(goal_message(plan=slow_plan(), timeout=60.0), feedback_callback=lambda _m: running.set()))
    assert running.wait(20)
    others = [wait(graph.send_goal_async(goal_message(seed=n))) for n in range(3)]
    assert [wait(handle.get_result_async()).result.code for handle in others] == [Code.BUSY] * 3
    started = time.monotonic()
    wait(first.cancel_goal_async())
    result = wait(first.get_result_async(), 10).result
    assert result.code == Code.CANCELED and not result.success
    assert time.monotonic() - started < 12.0
    answered(graph, goal_message(repetitions=1), Code.OK)
