"""What geometry forbids: against shapes whose answer is known, and fairness of where things are laid."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import trimesh

from magic_core import shapes
from magic_core import strategy as strategies
from magic_core.shapes.solids import stroke
from magic_verifier import feasibility, placing
from magic_verifier.cases import CONTROL_COUNT, Options, all_cases, control_cases
from magic_verifier.subjects import Case

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")


def ring(inner, outer):
    return shapely.Point(0, 0).buffer(outer, quad_segs=32).difference(shapely.Point(0, 0).buffer(inner, quad_segs=32))


@pytest.mark.parametrize(
    ("area", "radius", "turn"),
    [
        (shapely.Point(0, 0).buffer(0.05), 0.02, 0.0),
        (shapely.box(0, 0, 0.2, 0.02), 0.02, 0.0),
        (shapely.LineString([(0.1, 0), (0, 0), (0, 0.1)]).buffer(0.01, cap_style="flat", join_style="mitre"), 0.02, 90.0),
        (ring(0.03, 0.04), 0.02, 360.0),
        (ring(0.03, 0.04), 0.035, 0.0),  # too narrow
    ],
)
def test_how_far_a_tool_turns_around_a_target(area, radius, turn):
    assert feasibility.pocket(area, radius) == pytest.approx(turn, abs=2.0)


def test_a_hook_of_an_arc_turns_by_its_arc_if_the_target_fits_in():
    angle = np.linspace(0, np.deg2rad(120), 40)
    hook = stroke(0.04 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.01)
    assert feasibility.pocket(hook, 0.02) == pytest.approx(120, abs=8)


def test_what_hangs_on_a_rod():
    middle = np.zeros(2)
    assert feasibility.hangs(ring(0.03, 0.04), middle, 0.006)
    assert not feasibility.hangs(ring(0.004, 0.04), middle, 0.006)
    assert not feasibility.hangs(shapely.box(-0.1, -0.01, 0.1, 0.01), middle, 0.006)
    # A ring hangs 30 mm below the rod's underside; where less is allowed it does not.
    assert feasibility.hangs(ring(0.03, 0.04), middle, 0.006, drop=0.035)
    assert not feasibility.hangs(ring(0.03, 0.04), middle, 0.006, drop=0.025)


def test_a_ball_lies_in_a_spoon_and_on_no_plate():
    assert feasibility.basin(shapes.make("spoon", 11).mesh, 0.015) > 0.01
    assert feasibility.basin(shapes.make("letter", 1, glyph="I").mesh, 0.02) < feasibility.SCOOP_RISE


@pytest.mark.parametrize("task", ["hanging", "hooking"])
def test_controls_are_what_geometry_forbids_and_the_sets_are_not(task):
    options = Options(task, strategies=STRATEGIES, set="controls", variant="fg_no_selection" if task == "hooking" else "fg")
    cases = control_cases(options)
    assert len(cases) == CONTROL_COUNT == len({case.name for case in cases})
    strategy = strategies.find(task, STRATEGIES)
    own = all_cases(replace(options, set="own"))
    assert not any(feasibility.impossible(strategy, case) for case in (own[0], own[-1]))


@pytest.mark.parametrize(("inner", "forbidden"), [(0.02, False), (0.004, True)])
def test_a_mesh_is_looked_at_along_its_own_directions_before_geometry_forbids_it(tmp_path, inner, forbidden):
    """A ring that lies flat is edge-on in the side view of how it lies, and hangs by its hole where the rod of 6 mm radius fits in."""
    trimesh.creation.annulus(r_min=inner, r_max=0.03, height=0.01).export(tmp_path / "ring.obj")
    (tmp_path / "poses.yaml").write_text("ring.obj: {orientation: [0, 0, 0, 1]}\n")
    said = feasibility.impossible(strategies.find("hanging", STRATEGIES), Case("ring", (f"{tmp_path}//ring.obj@1.0",), "demonstration"))
    assert said.startswith("nothing in it holds a rod") if forbidden else said == ""


def test_what_is_impossible_is_said_anew_of_a_strategy_that_meets_the_target_otherwise_or_another_target():
    strategy = strategies.find("hooking", STRATEGIES)
    case = Case("bar", ("letter:1,glyph=I",), "demonstration")
    assert "around a disc of 25 mm" in feasibility.impossible(strategy, case)
    assert feasibility.impossible(replace(strategy, target_outline="inner"), case) == ""
    larger = {"family": "sphere", "seed": 0, "parameters": {"radius": 0.04}}
    assert "around a disc of 40 mm" in feasibility.impossible(
        replace(strategy, environment=strategy.environment | {"target": larger}), case
    )


def test_turns_are_cases_of_their_own_and_lie_differently():
    options = Options("hooking", "fg_no_selection", strategies=STRATEGIES, turns=3)
    names = [case.name for case in all_cases(options)]
    assert len(names) == len(set(names)) == 60
    yaws = {np.random.default_rng(placing.seed_of(name, 0)).uniform() for name in names}
    assert len(yaws) == 60


def test_tools_lie_beside_everything_else_and_are_seen_as_they_lie():
    from magic_verifier import evaluate as ev

    options = Options("hooking", strategies=STRATEGIES)
    case = Case("two", ("caliper:1", "hanger:1"), "cylinder:0.03")
    problem = ev._as_given(options, strategies.find("hooking", STRATEGIES), case)
    covered = [placing.footprint(item) for item in (*problem.tools, problem.target)]
    assert all(a.distance(b) >= placing.CLEARANCE for k, a in enumerate(covered) for b in covered[:k])
    for tool in problem.tools:
        up_in_world = tool.world_from_object[:3, :3] @ -tool.view.object_from_view[:3, 1]
        assert up_in_world == pytest.approx([1, 0, 0], abs=1e-6)
    again = ev._as_given(options, strategies.find("hooking", STRATEGIES), case)
    assert np.array_equal(problem.tools[0].world_from_object, again.tools[0].world_from_object)
