"""The node answers every goal with a code, runs one simulation at a time and stops when told to."""

import copy
import os
import threading
import time
from dataclasses import replace

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import pytest
import scenes

pytest.importorskip("rclpy")

from verifier_graph import goal_message, save, slow_plan, verifier

from magic_core import conversions as convert
from magic_core.errors import Code
from magic_core.strategy import Goal
from magic_core.testing.served import ask, wait
from magic_interfaces.msg import SceneObject as SceneObjectMsg
from magic_verifier import node as verifier_node

SIMULATED: list[int] = []


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    """A client of a verifier that counts its simulations."""
    simulate = verifier_node.verify_proposal
    verifier_node.verify_proposal = lambda *a, **k: SIMULATED.append(1) or simulate(*a, **k)
    with verifier(tmp_path_factory.mktemp("strategies")) as client:
        yield client
    verifier_node.verify_proposal = simulate


def test_a_good_motion_passes_with_metrics_film_and_feedback(graph):
    heard = []
    result = ask(graph, goal_message("pulling", want_film=True), lambda message: heard.append(message.feedback.phase))
    assert result.code == Code.OK, result.message
    assert result.success
    metrics = dict(zip(result.metric_names, result.metric_values, strict=True))
    assert metrics["pulled_distance"] == pytest.approx(0.28, abs=0.01)
    film = convert.color_from_msg(result.film)
    assert film.shape[0] > 200
    assert film.std() > 5
    assert "goal" in heard
    assert 0 < result.seconds < 60
    assert result.rollouts >= 8 and result.rate_low >= 0.7
    assert result.rate_low < result.success_rate <= result.rate_high <= 1
    assert not result.failures or " of " in result.failures[0]


def test_each_phase_is_told_once_and_not_every_moment_of_it(graph, monkeypatch):
    def told(seed):
        heard = []
        ask(graph, goal_message("pulling", seed=seed, repetitions=3), lambda message: heard.append(message.feedback.phase))
        return heard

    monkeypatch.setattr(verifier_node, "FEEDBACK_PERIOD", 1e9)
    few = told(11)
    assert "goal" in few and len(few) == len(set(few))
    monkeypatch.setattr(verifier_node, "FEEDBACK_PERIOD", 0.0)
    many = told(12)
    assert set(many) == set(few) and len(many) > len(few)


def test_tool_and_target_are_as_heavy_as_the_goal_says(graph):
    simulated = len(SIMULATED)
    given = ask(graph, goal_message("pulling", repetitions=1))
    again = ask(graph, goal_message("pulling", repetitions=1, want_film=True))
    assert len(SIMULATED) == simulated + 1 and again.metric_values == given.metric_values
    heavy = ask(graph, goal_message("pulling", repetitions=1, want_film=True, target_mass=1.2))
    assert len(SIMULATED) == simulated + 2  # another verdict, not the one that is kept
    assert heavy.metric_values != given.metric_values
    wrong = ask(graph, goal_message("pulling", tool_mass=float("nan")))
    assert wrong.code == Code.BAD_REQUEST and "tool_mass" in wrong.message


def test_a_tool_by_another_name_is_refused(graph):
    goal = goal_message()
    goal.plan.tool_trajectory.joint_names = ["spoon"]
    result = ask(graph, goal)
    assert result.code == Code.BAD_MOTION and "spoon" in result.message


def test_the_film_of_the_last_goal_needs_no_second_simulation(graph):
    first = ask(graph, goal_message(seed=5, repetitions=2))
    assert not len(first.film.data)
    before = len(SIMULATED)
    again = ask(graph, goal_message(seed=5, repetitions=2, want_film=True, timeout=20.0))
    assert len(SIMULATED) == before
    assert len(again.film.data)
    assert (again.code, again.message, again.metric_values) == (first.code, first.message, first.metric_values)
    ask(graph, goal_message(seed=6, repetitions=2, want_film=True))
    assert len(SIMULATED) == before + 1


def test_a_strategy_whose_files_have_changed_is_judged_anew(graph, tmp_path):
    """Though it has the same name: a film is drawn of the last verdict only where that was by the same goal."""
    folder = tmp_path / "pulling"
    save(tmp_path, "pulling", Goal("hook", {"noise": 0.0}))
    first = ask(graph, goal_message(str(folder), seed=8, repetitions=1))
    assert first.code == Code.OK, first.message
    save(tmp_path, "pulling", Goal("hook", {"noise": 0.0, "distance": 2.0}))
    assert ask(graph, goal_message(str(folder), seed=8, repetitions=1, want_film=True)).code == Code.GOAL_NOT_REACHED


def test_what_obstacles_look_like_is_in_the_film_alone(graph):
    def beside(surface, x=0.0):
        goal = goal_message(seed=7, repetitions=2, want_film=surface)
        obstacle = copy.deepcopy(goal.target)
        obstacle.id = "obstacle"
        obstacle.pose.position.x += x
        obstacle.pose.position.y += 0.4
        goal.obstacles = [convert.without_pictures(obstacle, cloud=False, surface=surface)]
        return goal

    before = len(SIMULATED)
    first = ask(graph, beside(False))
    again = ask(graph, beside(True))
    assert len(again.film.data) and (again.code, again.message) == (first.code, first.message)
    assert len(SIMULATED) == before + 1
    ask(graph, beside(True, x=0.01))
    assert len(SIMULATED) == before + 2


def test_a_bad_motion_fails_with_its_reason(graph):
    result = ask(graph, goal_message(kind="bar"))
    assert not result.success
    assert result.code in (Code.LOST_CONTACT, Code.DRIFT)
    assert "mm" in result.message


def _without_pieces(goal):
    goal.tool.pieces = []


def _with_nan(goal):
    goal.tool.mesh.vertices[0].x = float("nan")


def _with_bad_pose(goal):
    goal.target.pose.orientation.w = 7.0


def _without_points(goal):
    goal.plan.tool_trajectory.points = []


def _with_unknown_variant(goal):
    goal.plan.variant = "leg"


def _with_empty_object(goal):
    goal.target = SceneObjectMsg()


def _with_equal_ids(goal):
    goal.target.id = goal.tool.id


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (_without_pieces, Code.BAD_SCENE),
        (_with_nan, Code.BAD_MESH),
        (_with_bad_pose, Code.BAD_REQUEST),
        (_without_points, Code.BAD_MOTION),
        (_with_unknown_variant, Code.UNKNOWN_VARIANT),
        (_with_empty_object, Code.BAD_MESH),
        (_with_equal_ids, Code.BAD_REQUEST),
        (lambda goal: setattr(goal, "strategy", "dancing"), Code.UNKNOWN_STRATEGY),
        (lambda goal: setattr(goal, "strategy", "juggling"), Code.UNKNOWN_GOAL),
        (lambda goal: setattr(goal, "repetitions", 10**6), Code.BAD_REQUEST),
        (lambda goal: setattr(goal, "timeout", -1.0), Code.BAD_REQUEST),
    ],
)
def test_every_bad_request_has_a_code_and_a_message(graph, change, code):
    goal = goal_message()
    change(goal)
    result = ask(graph, goal)
    assert result.code == code, result.message
    assert result.message
    assert not result.success


def test_a_timeout_is_kept(graph):
    started = time.monotonic()
    result = ask(graph, goal_message(plan=slow_plan(), timeout=0.5))
    assert result.code == Code.SIMULATION_TIMEOUT
    assert time.monotonic() - started < 15


def test_a_second_goal_is_refused_and_a_cancel_ends_the_first(graph):
    running = threading.Event()
    first = wait(graph.send_goal_async(goal_message(plan=slow_plan(), timeout=60.0), feedback_callback=lambda _m: running.set()))
    assert running.wait(20)
    second = ask(graph, goal_message())
    assert second.code == Code.BUSY
    wait(first.cancel_goal_async())
    result = wait(first.get_result_async(), 10).result
    assert result.code == Code.CANCELED
    assert ask(graph, goal_message(repetitions=1)).code == Code.OK


def test_digests_are_equal_for_equal_values_only():
    scene = scenes.hooking("L")
    same = verifier_node.digest((scenes.hooking("L"), float("nan")))
    assert verifier_node.digest((scene, float("nan"))) == same
    moved = replace(scene[2], world_from_object=scene[2].world_from_object + 1e-12)
    assert verifier_node.digest(((*scene[:2], moved, scene[3]), float("nan"))) != same
    assert verifier_node.digest((("a",), "b")) != verifier_node.digest(("a", ("b",)))
    assert verifier_node.digest(np.zeros(2)) != verifier_node.digest(np.zeros((2, 1)))
