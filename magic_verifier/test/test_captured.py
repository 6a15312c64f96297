"""Cases seen by cameras: the layout is fair, reconstructions belong to the right things, and the truth is judged apart from what was
seen."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("magic_matcher.matching")
pytest.importorskip("magic_planner.object_motion")

from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.motion import MotionPlan
from magic_verifier import captured, placing
from magic_verifier import evaluate as ev
from magic_verifier.cases import Options, all_cases
from magic_verifier.reliability import Judged, points, rows, table
from magic_verifier.subjects import Case

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")
CASE = Case("caliper", ("caliper:50000",), "cylinder:0.025")


@pytest.fixture(scope="module")
def strategy():
    return strategies.find("hooking", STRATEGIES)


@pytest.fixture(scope="module")
def layout(strategy):
    return captured.lay_out(strategy, CASE, 3)


def test_a_layout_is_a_function_of_its_seed_and_turns_the_tool(strategy, layout):
    again, other = captured.lay_out(strategy, CASE, 3), captured.lay_out(strategy, CASE, 4)
    assert np.array_equal(layout.tools[0].world_from_object, again.tools[0].world_from_object)
    assert layout.physics == again.physics
    turn = transforms.inverse(layout.tools[0].world_from_object) @ other.tools[0].world_from_object
    assert np.linalg.norm(turn[:3, :3] - np.eye(3)) > 0.1
    assert layout.physics != other.physics
    assert layout.physics.friction == pytest.approx(strategy.physics.friction, rel=captured.TRUE_FRICTION)


def test_nothing_stands_where_something_else_does(strategy):
    several = captured.lay_out(
        strategy, Case("four", ("caliper:50000", "watch:50001", "hanger:50002", "scissors:50003"), "cylinder:0.035"), 0
    )
    covered = [placing.footprint(item) for item in (*several.tools, several.target)]
    assert all(a.distance(b) >= placing.CLEARANCE for k, a in enumerate(covered) for b in covered[:k])
    lowest = [transforms.apply(t.world_from_object, t.mesh.vertices)[:, 2].min() for t in several.tools]
    assert np.abs(lowest).max() < 0.002


def test_reconstructions_belong_to_the_things_that_stand_there(strategy, layout):
    frames = captured.capture(layout, CASE, 3)
    assert [f.camera for f in frames] == ["left", "right"]
    scene = captured.perceive(layout, frames, strategy.physics)
    tools, target = captured.pair(layout, scene)
    for seen, true in ((tools[0], layout.tools[0]), (target, layout.target)):
        apart = transforms.apply(seen.world_from_object, seen.mesh.bounds.mean(axis=0)) - true.world_from_object[:3, 3]
        assert np.linalg.norm(apart) < 0.02
    nothing = replace(scene, objects=())
    assert captured.pair(layout, nothing) == ([None], None)


def _planned(strategy, layout, tool):
    from magic_planner.object_motion import plan_tool_motion

    found = ev._matcher("embedded", "", "magic").match(strategy, [tool], layout.target, 1)
    candidate = found.candidates[0]
    motion = plan_tool_motion(strategy, tool, layout.target, candidate, strategy.reflections[0], captured.TABLE, ())
    return MotionPlan("fg", motion)


def test_the_truth_is_judged_by_where_the_true_tool_is_held(strategy, layout):
    tool = layout.tools[0]
    plan = _planned(strategy, layout, tool)
    assert captured.judge(strategy, layout, 0, tool, plan, 0).success
    # Taken for a tool that lies 60 mm beside the true one, across the pull: the true one misses.
    aside = transforms.make(translation=0.06 * np.array([-strategy.target_normal[1], strategy.target_normal[0], 0.0]))
    for sign in (aside, transforms.inverse(aside)):
        motion = replace(plan.tool_motion, world_from_tool=sign @ plan.tool_motion.world_from_tool)
        if not captured.judge(strategy, layout, 0, tool, MotionPlan("fg", motion), 0).success:
            return
    pytest.fail("a tool that passes the target 60 mm aside pulled it")


def test_an_evaluation_from_images_counts_what_was_verified_against_what_is_true(tmp_path):
    options = Options("hooking", variant="fg_no_selection", strategies=STRATEGIES, source="images", set="unseen")
    cases = all_cases(options)
    assert len({case.name for case in cases}) == len(cases) == 60
    assert {case.target for case in cases if case.tools[0].startswith("hammer")} == {case.target for case in cases}
    summary = ev.evaluate(options, tmp_path, limit=1, films=True, log=lambda _text: None)
    truth = summary["truth"]
    assert sum(truth[k] for k in ("verified_and_succeeds", "verified_but_fails", "refused_but_would_succeed", "refused_and_fails")) == 1
    assert "true objects" in (tmp_path / "summary.txt").read_text()
    assert list((tmp_path / "films").glob("*.scene.png"))
    assert sum(row["motions"] for row in summary["reliability"]) == len(ev.judged(ev_cases(tmp_path)))
    assert (tmp_path / "reliability.png").is_file()


def ev_cases(folder):
    return json.loads((folder / "results.json").read_text())["cases"]


def test_what_was_said_is_counted_against_what_was_the_case():
    sure = [Judged(1.0, 0.81, 16, k > 0) for k in range(20)]
    doubtful = [Judged(0.5, 0.25, 8, k % 2 == 0) for k in range(6)]
    failing = [Judged(0.0, 0.0, 1, False)]
    found = {row["from"]: (row["motions"], row["succeeded"]) for row in rows([*sure, *doubtful, *failing])}
    assert found == {0.0: (1, 0), 0.2: (6, 3), 0.5: (0, 0), 0.7: (0, 0), 0.8: (20, 19)}
    assert points([*sure, *doubtful, *failing]) == [(0.0, 0.0, 1), (0.5, 0.5, 6), (1.0, 0.95, 20)]
    assert "95.0 % (76 to 99 %)" in table(sure)
    assert len(table([]).splitlines()) == 6


def test_the_four_counts():
    done = [{"success": a, "true_success": b} for a, b in [(True, True)] * 3 + [(True, False), (False, True), (False, False)]]
    truth = ev.truths(done)
    assert truth["verified_is_true"] == 0.75
    assert (truth["verified_but_fails"], truth["refused_but_would_succeed"], truth["refused_and_fails"]) == (1, 1, 1)
    assert ev.truths([])["verified_is_true"] is None
