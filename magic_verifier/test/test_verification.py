"""The goal tests say yes to what works, and no with the right reason to what does not."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
import scenes

from magic_core import transforms
from magic_core.errors import Code
from magic_core.mesh import Mesh
from magic_core.motion import MotionPlan, ToolMotion
from magic_verifier.rollout import Limits
from magic_verifier.simulation import Settings
from magic_verifier.verification import Proposal, verify, verify_proposal


def judge(strategy, tool, target, motion, obstacles=(), **options):
    """The scene as given alone, unless told otherwise: what a goal test says does not hang on what is drawn."""
    proposed = {name: options.pop(name) for name in ("seed", "settings", "limits") if name in options}
    return verify_proposal(Proposal(strategy, tool, target, obstacles, scenes.TABLE, motion, **proposed), **{"repetitions": 1, **options})


@pytest.mark.parametrize("radius", [0.015, 0.025, 0.035])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_an_l_hook_pulls_a_cylinder(radius, noise):
    verdict = judge(*scenes.hooking("L", radius, noise))
    assert verdict.success, verdict.message
    assert verdict.code == Code.OK
    assert verdict.metrics["pulled_distance"] == pytest.approx(0.28, abs=0.01)
    assert verdict.metrics["sideways_drift"] < radius / 2


@pytest.mark.parametrize("radius", [0.015, 0.025, 0.035])
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_end_of_a_straight_bar_loses_the_cylinder(radius, noise):
    verdict = judge(*scenes.hooking("bar", radius, noise))
    assert not verdict.success
    assert verdict.code in (Code.LOST_CONTACT, Code.DRIFT)
    assert "mm" in verdict.message


def test_a_ring_hangs_on_a_rod():
    verdict = judge(*scenes.hanging())
    assert verdict.success, verdict.message
    assert verdict.metrics["tool_height"] == pytest.approx(0.38, abs=0.005)
    assert verdict.metrics["below_support"] == pytest.approx(0.026, abs=0.003)


def test_a_ring_beside_the_rod_falls():
    verdict = judge(*scenes.hanging(aside=0.06))
    assert verdict.code == Code.LOST_CONTACT
    assert verdict.metrics["tool_height"] < 0.1


def test_a_ring_that_is_let_go_inside_the_rod_is_refused():
    verdict = judge(*scenes.hanging(lower=0.005))
    assert verdict.code == Code.PRE_CONTACT_COLLISION
    assert "4.5 mm" in verdict.message


@pytest.mark.parametrize("radius", [0.015, 0.035, 0.045])
def test_a_bowl_scoops_a_ball_up_the_arc(radius):
    strategy, tool, ball, arc, motion = scenes.scooping(ball_radius=radius)
    verdict = judge(strategy, tool, ball, motion, (arc,))
    assert verdict.success, verdict.message
    assert verdict.metrics["target_height"] > 0.2


def test_without_the_arc_the_ball_is_lost():
    strategy, tool, ball, _, motion = scenes.scooping()
    verdict = judge(strategy, tool, ball, motion)
    assert verdict.code == Code.LOST_CONTACT


def test_an_obstacle_in_the_way_of_the_approach_is_a_collision():
    strategy, tool, target, motion = scenes.hooking("L")
    obstacle = scenes.item("box", [scenes.block((0.62, 0.66), (0.0, 0.05), (0.0, 0.06))])
    verdict = judge(strategy, tool, target, motion, (obstacle,))
    assert verdict.code == Code.PRE_CONTACT_COLLISION
    assert "box" in verdict.message


@pytest.mark.parametrize("number", range(6))
def test_a_fast_tool_does_not_slip_past_a_thin_rod_between_two_looks(number):
    """The L's shaft, 20 mm thick, comes along by 32 mm in 20 ms; the rod of 4 mm stands where a look may fall behind it."""
    strategy, tool, target, _ = scenes.hooking("L", noise=0.0)

    def at(x, y=0.0, z=0.0):
        return transforms.make(translation=[0.625 + x, y, z])

    poses = [
        (at(0.03, 0.5, 0.15), "", 0),
        (at(0.03, 0.0, 0.15), "approach", 0.5 / 1.6),
        (at(0.03), "approach", 0.7),
        (at(0.0), "contact", 0.3),
    ]
    motion = scenes.plan([*poses, (at(-0.28), "goal", 2.8)])
    beside = 0.3 + 0.0054 * number
    rod = scenes.item("rod", [scenes.block((0.45, 0.454), (beside, beside + 0.004), (0.0, 0.3))])
    verdict = verify_proposal(Proposal(strategy, tool, target, (rod,), scenes.TABLE, motion), repetitions=1)
    assert verdict.code == Code.PRE_CONTACT_COLLISION and "the tool is in the rod" in verdict.message


def test_pushing_the_target_away_before_the_contact_is_a_collision():
    strategy, tool, target, motion = scenes.hooking("L")
    shifted = replace(target, world_from_object=transforms.make(translation=[0.65, 0, 0.025]))
    verdict = judge(strategy, tool, shifted, motion)
    assert verdict.code == Code.PRE_CONTACT_COLLISION
    assert "target" in verdict.message


def test_a_tool_that_goes_through_the_table_is_refused():
    strategy, tool, target, motion = scenes.hooking("L")
    poses = motion.tool_motion.world_from_tool.copy()
    for depth, code in ((0.004, Code.LIMIT_EXCEEDED), (0.02, Code.PRE_CONTACT_COLLISION)):
        lowered = poses.copy()
        lowered[:, 2, 3] -= depth
        verdict = judge(strategy, tool, target, MotionPlan("fg", ToolMotion(motion.tool_motion.times, lowered, motion.tool_motion.phases)))
        assert verdict.code == code
        assert "table" in verdict.message


def test_the_same_seed_gives_the_same_poses_and_another_seed_others():
    scene = scenes.hooking("L")
    first, again, other = (judge(*scene, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.recording.poses["target"], again.recording.poses["target"])
    assert first.metrics == again.metrics
    assert not np.array_equal(first.recording.poses["target"], other.recording.poses["target"])


def test_a_deadline_ends_the_simulation():
    started = time.monotonic()
    verdict = judge(*scenes.hooking("L"), repetitions=1000, limits=Limits(required_rate=0.99), deadline=started + 0.05)
    assert verdict.code == Code.SIMULATION_TIMEOUT
    assert time.monotonic() - started < 15.0


def test_a_cancel_ends_the_simulation():
    asked = []

    def cancel():
        asked.append(time.monotonic())
        return len(asked) > 5

    verdict = judge(*scenes.hooking("L"), repetitions=1000, limits=Limits(required_rate=0.99), cancel=cancel)
    assert verdict.code == Code.CANCELED
    assert not verdict.success


def test_progress_names_the_phases():
    heard = []
    judge(*scenes.hooking("L"), progress=lambda phase, simulated: heard.append((phase, simulated)))
    assert {"approach", "goal"} <= {phase for phase, _ in heard}
    assert all(a[1] < b[1] for a, b in itertools.pairwise(heard))


def test_what_cannot_be_judged_has_its_own_codes():
    strategy, tool, target, motion = scenes.hooking("L")
    assert judge(scenes.strategy("juggle"), tool, target, motion).code == Code.UNKNOWN_GOAL
    assert judge(scenes.strategy("hook", simulatable=False), tool, target, motion).code == Code.NOT_VERIFIABLE
    assert judge(scenes.strategy("hook", {"distanse": 0.2}), tool, target, motion).code == Code.BAD_STRATEGY
    assert judge(strategy, replace(tool, pieces=()), target, motion).code == Code.BAD_SCENE


def test_flat_tiny_and_sunken_things_are_bad_scenes():
    strategy, tool, target, motion = scenes.hooking("L")
    flat = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]), np.array([[0, 1, 2]]))
    for bad in (
        replace(target, pieces=(flat,)),
        replace(target, world_from_object=np.full((4, 4), np.nan)),
        replace(target, world_from_object=np.eye(4)),
    ):
        verdict = judge(strategy, tool, bad, motion)
        assert verdict.code == Code.BAD_SCENE, verdict.message


@pytest.mark.parametrize(
    ("task", "values", "code", "words"),
    [
        ("hook", {"distance": 0.5}, Code.GOAL_NOT_REACHED, "needed: 500 mm"),
        ("hook", {"drift": 1e-4}, Code.DRIFT, "sideways"),
        ("hook", {"max_speed": 0.001}, Code.UNSTABLE, "0.001 m/s"),
        ("hang", {"height": 0.5}, Code.GOAL_NOT_REACHED, "needed: above 500 mm"),
        ("hang", {"max_speed": 1e-6}, Code.UNSTABLE, "come to rest"),
        ("scoop", {"height": 0.9}, Code.GOAL_NOT_REACHED, "needed: above 900 mm"),
        ("scoop", {"max_speed": 1e-6}, Code.UNSTABLE, "not at rest"),
    ],
)
def test_every_goal_says_by_which_of_its_numbers_a_motion_fails(task, values, code, words):
    if task == "scoop":
        strategy, tool, target, *obstacles, motion = scenes.scooping()
    else:
        (strategy, tool, target, motion), obstacles = scenes.hooking("L", noise=0.0) if task == "hook" else scenes.hanging(), ()
    strict = replace(strategy, goal=replace(strategy.goal, values={**strategy.goal.values, **values}))
    verdict = judge(strict, tool, target, motion, obstacles)
    assert (verdict.success, verdict.code) == (False, code), verdict.message
    assert words in verdict.message


def test_an_exploding_simulation_is_reported():
    strategy, tool, target, motion = scenes.hooking("L", noise=1e6)
    verdict = judge(strategy, tool, target, motion)
    assert verdict.code == Code.SIMULATION_EXPLODED
    assert "m/s" in verdict.message or "m " in verdict.message


def test_frequency_changes_little():
    pulled = [judge(*scenes.hooking("L", noise=0.0), settings=Settings(frequency=f)).metrics["pulled_distance"] for f in (240.0, 480.0)]
    assert pulled[0] == pytest.approx(pulled[1], abs=0.003)


def test_a_plan_by_its_parts_is_judged_as_a_proposal_is():
    strategy, tool, target, motion = scenes.hooking("L", 0.03, 0.0)
    limits = Limits(required_rate=0.5)
    proposal = Proposal(strategy, tool, target, (), scenes.TABLE, motion, 3, limits=limits)
    one = verify_proposal(proposal, repetitions=2)
    other = verify(strategy, tool, target, (), scenes.TABLE, None, motion, seed=3, limits=limits, repetitions=2, deadline=None)
    assert (one.code, one.message, one.metrics) == (other.code, other.message, other.metrics)
