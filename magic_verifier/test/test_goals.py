"""What passes a goal test by chance, held by something else or glued by friction, does not pass."""

from dataclasses import replace

import numpy as np
import pytest
import scenes

from magic_core import transforms
from magic_core.errors import Code
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.strategy import Physics
from magic_verifier.verification import Proposal, verify_proposal


def judge(strategy, tool, target, motion, obstacles=()):
    return verify_proposal(Proposal(strategy, tool, target, tuple(obstacles), scenes.TABLE, motion), repetitions=1)


def refused(verdict, code, *words):
    assert (verdict.success, verdict.code) == (False, code), verdict.message
    assert all(word in verdict.message for word in words), verdict.message
    assert verdict.metrics["released_test"] == 1.0, "the released code's test has passed it"


def lowered(at, by=0.01, seconds=0.3):
    """A motion that lowers the tool to a pose and lets it go."""
    above = transforms.make(translation=[0, 0, by]) @ at
    return scenes.plan([(above, "", 0), (at, "contact", seconds), (at, "release", 0.1)])


def hung(parts, at, friction=3.0, obstacles=()):
    """The verdict on a tool that is let go above the rod of the ring's scene (top at z = 0.406 over x = 0.5, y = 0 to 0.15)."""
    strategy, _, rod, _ = scenes.hanging()
    strategy = replace(strategy, physics=Physics(friction, 600.0, 600.0, True))
    return judge(strategy, scenes.item("tool", parts), rod, lowered(np.asarray(at)), obstacles)


def test_a_board_across_the_rod_is_balanced_and_does_not_hang():
    board = [scenes.block((-0.08, 0.08), (-0.03, 0.03), (0, 0.008))]
    refused(hung(board, transforms.make(translation=[0.5, 0.075, 0.4062])), Code.UNSTABLE, "balanced", "above what holds it")


def test_what_only_friction_holds_up_falls_when_pushed():
    # A shallow roof astride the rod: its middle is below the ridge, and it rests there, until it slides off along its slope.
    roof = [scenes.hull([(x, y, z + 0.45 * s * x) for x in (0, 0.09 * s) for y in (-0.02, 0.02) for z in (0, 0.004)]) for s in (-1.0, 1.0)]
    slope = np.arctan(0.45)  # atan(0.3) is 17 degrees, this 24
    pose = transforms.from_rpy(0, slope, 0, [0.5, 0.075, 0.4])
    # One leaf lies on the rod, the other hangs down behind it.
    verdict = hung(roof, pose @ transforms.make(translation=[0.02, 0, 0]), friction=3.0)
    assert not verdict.success, verdict.message


def test_what_lies_on_something_else_as_well_does_not_hang():
    shelf = scenes.item("shelf", [scenes.block((0.45, 0.55), (-0.02, 0.05), (0.3, 0.3535))])
    strategy, tool, rod, motion = scenes.hanging()
    refused(judge(strategy, tool, rod, motion, [shelf]), Code.GOAL_NOT_REACHED, "touches", "shelf", "allowed: the target alone")


def test_what_touches_nothing_of_the_target_does_not_hang():
    shelf = scenes.item("shelf", [scenes.block((0.55, 0.75), (-0.1, 0.2), (0.28, 0.325))])
    strategy, tool, rod, motion = scenes.hanging(aside=0.15)
    low = scenes.plan([(p, n, s) for p, n, s in zip(*_shifted(motion, -0.02), strict=True)])
    refused(judge(strategy, tool, rod, low, [shelf]), Code.GOAL_NOT_REACHED, "shelf")


def _shifted(motion, by):
    poses = motion.tool_motion.world_from_tool[[0, 100, 130, -1]].copy()
    poses[:, 2, 3] += by
    return list(poses), ["", "approach", "contact", "release"], [0, 1.0, 0.3, 0.1]


def test_a_ring_hangs_whatever_the_friction():
    strategy, tool, rod, motion = scenes.hanging()
    for friction in (0.1, 3.0):
        verdict = judge(replace(strategy, physics=Physics(friction, 600.0, 600.0, True)), tool, rod, motion)
        assert verdict.success, verdict.message
        assert verdict.metrics["below_support"] == pytest.approx(0.026, abs=0.003)


# ------------------------------------------------------------ scooping


def lifted(tool, target, obstacles, start, rise=0.26):
    """The verdict on a tool that goes up by ``rise`` from where it is."""
    strategy = scenes.strategy("scoop", {}, Physics(0.5, 300.0, 100.0), normal=(-1.0, 0.0, 0.0))
    motion = scenes.plan([(start, "", 0), (start, "contact", 0.1), (transforms.make(translation=[0, 0, rise]) @ start, "goal", 2.0)])
    return judge(strategy, tool, target, motion, obstacles)


def ball(radius, at, name="ball"):
    import trimesh

    from magic_core.mesh import from_trimesh

    return scenes.item(name, [from_trimesh(trimesh.creation.icosphere(3, radius))], transforms.make(translation=at))


def test_a_ball_that_lies_on_something_else_is_not_scooped():
    shelf = scenes.item(
        "shelf", [scenes.block((0.45, 0.6), (-0.1, 0.1), (0.2, 0.25)), scenes.block((0.44, 0.45), (-0.1, 0.1), (0.2, 0.27))]
    )
    board = scenes.item("tool", [scenes.block((0.0, 0.01), (-0.05, 0.05), (0.0, 0.06))])
    strategy = scenes.strategy("scoop", {}, Physics(0.5, 300.0, 100.0), normal=(-1.0, 0.0, 0.0))
    at = transforms.make(translation=[0.491, 0, 0.26])
    motion = scenes.plan([(transforms.make(translation=[0.06, 0, 0]) @ at, "", 0), (at, "contact", 1.5), (at, "goal", 0.5)])
    verdict = judge(strategy, board, ball(0.02, [0.47, 0, 0.27]), motion, [shelf])
    refused(verdict, Code.GOAL_NOT_REACHED, "shelf", "allowed: the tool alone")


def test_a_ball_on_a_flat_board_is_pushed_off():
    board = scenes.item("tool", [scenes.block((-0.012, 0.012), (-0.012, 0.012), (0.0, 0.01))])
    strategy = scenes.strategy("scoop", {}, Physics(0.5, 300.0, 100.0), normal=(-1.0, 0.0, 0.0))
    at = transforms.make(translation=[0.5, 0, 0.3])
    motion = MotionPlan("fg", ToolMotion(np.array([0.0, 0.5]), np.stack([at, at]), (Phase("goal", 0.0, 0.5),)))
    verdict = judge(strategy, board, ball(0.02, [0.5, 0, 0.3302]), motion)
    refused(verdict, Code.LOST_CONTACT, "fell out of the tool", "pushed")


def test_a_ball_that_is_stuck_between_two_boards_is_not_scooped():
    boards = scenes.item(
        "tool", [scenes.block((-0.04, -0.0165), (-0.05, 0.05), (0, 0.06)), scenes.block((0.0165, 0.04), (-0.05, 0.05), (0, 0.06))]
    )
    verdict = lifted(boards, ball(0.02, [0.5, 0, 0.02]), (), transforms.make(translation=[0.5, 0, 0.001]))
    assert not verdict.success, verdict.message
    if verdict.metrics.get("released_test"):
        assert verdict.code == Code.UNSTABLE and "stuck" in verdict.message


# ------------------------------------------------------------ hooking


def pulled(parts, radius=0.025, friction=0.3):
    strategy, _, target, motion = scenes.hooking("L", radius, noise=0.0, friction=friction)
    return judge(strategy, scenes.item("tool", parts), target, motion)


def test_a_flat_board_pushes_and_does_not_hook():
    for friction in (0.1, 0.3, 0.45):
        verdict = pulled([scenes.block((0, 0.02), (-0.1, 0.1), (0.001, 0.05))], friction=friction)
        refused(verdict, Code.DRIFT, "does not hold it", "30 degrees")
        assert verdict.metrics["holds"] == verdict.metrics["sides_held"] == 0.0


def test_a_round_thing_pushes_and_does_not_hook():
    verdict = pulled([scenes.standing_cylinder(0.025).transformed(transforms.make(translation=[0.025, 0, 0.026]))])
    assert verdict.code in (Code.DRIFT, Code.LOST_CONTACT), verdict.message


def test_a_pocket_holds_on_both_sides_and_an_l_on_one():
    side = [scenes.block((-0.05, 0.02), sorted((s * 0.029, s * 0.049)), (0.001, 0.05)) for s in (-1, 1)]
    pocket = pulled([scenes.block((0, 0.02), (-0.049, 0.049), (0.001, 0.05)), *side])
    assert pocket.success and pocket.metrics["sides_held"] == 2.0, pocket.message
    strategy, tool, target, motion = scenes.hooking("L", noise=0.0)
    corner = judge(strategy, tool, target, motion)
    assert corner.success and corner.metrics["sides_held"] == 1.0, corner.message


def test_a_strategy_may_ask_less():
    strategy, _, target, motion = scenes.hooking("L", noise=0.0)
    board = scenes.item("tool", [scenes.block((0, 0.02), (-0.1, 0.1), (0.001, 0.05))])
    easy = replace(strategy, goal=replace(strategy.goal, values={**strategy.goal.values, "hold": 0.0}))
    assert judge(easy, board, target, motion).success


# ------------------------------------------------------------ what moves by itself

BLOCK = scenes.block((-0.02, 0.02), (-0.03, 0.03), (-0.05, 0.05))
#: Tilted by so much (rad) the block's middle is above its lower edge.
BALANCED = float(np.arctan(0.02 / 0.05))


def untouched(test, target, obstacles=(), values=None, contact=1.0, friction=0.5):
    """The verdict on a tool that moves far from the target and never touches it."""
    strategy = scenes.strategy(test, values, Physics(friction, 600.0, 300.0))
    start = transforms.make(translation=[0.5, 0.5, 0.3])
    aside = transforms.make(translation=[0, 0.05, 0]) @ start
    motion = scenes.plan([(start, "", 0), (start, "approach", contact), (aside, "contact", 0.5), (aside, "goal", 2.0)])
    tool = scenes.item("tool", [scenes.block((-0.01, 0.01), (-0.01, 0.01), (-0.1, 0.1))])
    return judge(strategy, tool, target, motion, obstacles)


def leaning(tilt):
    return scenes.item("target", [BLOCK], transforms.from_rpy(0, -tilt, 0, [0.5, 0, 0.07]))


@pytest.mark.parametrize("beyond, contact", [(0.3, 1.0), (0.003, 0.1)])
def test_a_block_that_topples_by_itself_was_not_tipped(beyond, contact):
    verdict = untouched("tip", leaning(BALANCED + beyond), values={"angle": 45.0}, contact=contact)
    assert (verdict.success, verdict.code) == (False, Code.UNSTABLE), verdict.message
    assert verdict.message.startswith("the target moves by itself at") and "(allowed: up to 5.0 mm)" in verdict.message
    fallen = verdict.recording.times[-1]
    assert fallen < 1.0 if contact == 1.0 else fallen > contact, "later it is no less by itself"


def test_a_ball_that_rolls_off_by_itself_was_not_pushed():
    ramp = scenes.item("ramp", [scenes.hull([(x, y, z) for x, z in ((0.3, 0.0), (0.6, 0.0), (0.6, 0.06)) for y in (-0.1, 0.1)])])
    verdict = untouched("push", ball(0.02, [0.5, 0, 0.0606]), [ramp], {"upright": 180.0})
    assert verdict.code == Code.UNSTABLE and verdict.message.startswith("the target moves by itself"), verdict.message


def test_what_stands_still_does_not_move_by_itself():
    verdict = untouched("push", scenes.item("target", [BLOCK], transforms.make(translation=[0.5, 0, 0.05])))
    assert verdict.code == Code.GOAL_NOT_REACHED and "not pushed far enough" in verdict.message
    # It drops upright, and stands.
    assert "not pushed far enough" in untouched("push", scenes.item("target", [BLOCK], transforms.make(translation=[0.5, 0, 0.06]))).message
