"""Things that have no part in the motion: what cameras saw is loose, and nothing may move it; a fixture stands fast."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scenes

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_verifier import rollout
from magic_verifier.displacement import Place
from magic_verifier.verification import Proposal, verify_proposal

#: Half the side of a block beside the pulled cylinder's way, and the cylinder's radius, m.
HALF, RADIUS = 0.02, 0.025


def beside(gap, source="camera", height=0.05, x=0.31, sunk=0.0):
    """A block whose face is so far (m) from the way of the cylinder that the L hook pulls; the hook's own bar stops 15 mm before it."""
    y = RADIUS + gap + HALF
    block = scenes.block((-HALF, HALF), (-HALF, HALF), (-height / 2, height / 2))
    return replace(scenes.item("block", [block], transforms.make(translation=[x, y, height / 2 - sunk])), source=source)


def pulled(*others, repetitions=1):
    strategy, tool, target, plan = scenes.hooking("L", RADIUS, noise=0.0)
    return verify_proposal(Proposal(strategy, tool, target, others, scenes.TABLE, plan), repetitions=repetitions)


def test_nothing_beside_the_way_changes_a_verdict():
    assert pulled().success
    free = pulled(beside(0.05))
    assert free.success and free.metrics == pulled().metrics


def test_a_loose_thing_that_the_target_pushes_is_named_with_how_far():
    verdict = pulled(beside(-0.01))
    assert verdict.code == Code.OBSTACLE_PUSHED and not verdict.success
    assert "target" in verdict.message and "block" in verdict.message and "mm" in verdict.message and "(goal)" in verdict.message


def test_a_brush_that_moves_nothing_is_allowed():
    assert pulled(beside(-0.001)).success


def test_a_thing_turned_on_the_spot_has_moved():
    """A bar with a weight at its near end, which stays about where it is while the cylinder pushes the far end."""
    light = scenes.block((0.0, 0.13), (-0.003, 0.003), (-0.02, 0.02))
    heavy = scenes.block((-0.06, 0.0), (-0.03, 0.03), (-0.02, 0.02))
    pose = transforms.make(translation=[0.205, RADIUS - 0.006, 0.02])
    verdict = pulled(replace(scenes.item("block", [light, heavy], pose), source="camera"))
    assert verdict.code == Code.OBSTACLE_PUSHED and "block is pushed by the target" in verdict.message


def test_how_far_a_thing_has_left_its_place():
    up, middle = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    bar = scenes.block((-0.1, 0.1), (-0.01, 0.01), (-0.02, 0.02)).vertices
    stood = transforms.from_rpy(0.0, 0.0, 0.7)
    place = Place(bar, stood, middle, up)
    assert place.left_by(stood, middle) == pytest.approx(0.0, abs=1e-12)
    # By its middle, as well where that is not the way of a face; lifted straight up it has left nothing.
    moved = transforms.make(translation=[0.03, 0.04, 0.2])
    assert place.left_by(moved @ stood, moved[:3, 3]) == pytest.approx(0.05, abs=1e-9)
    # Turned about its middle by its corners: each then stands half the length times the sine beyond the side.
    angle = np.radians(30.0)
    turned = stood @ transforms.from_rpy(0.0, 0.0, angle)
    assert place.left_by(turned, middle) == pytest.approx(0.1 * np.sin(angle) + 0.01 * np.cos(angle) - 0.01)
    # A round thing stays where it is, whichever way it is turned.
    can = scenes.standing_cylinder(0.03, sections=360).vertices
    assert Place(can, stood, middle, up).left_by(turned, middle) < 1e-5
    # On a table that leans the same is so in the table's own plane.
    leaning = transforms.from_rpy(0.5, 0.2, 0.0)
    assert Place(bar, leaning @ stood, middle, leaning[:3, 2]).left_by(leaning @ turned, middle) == pytest.approx(
        0.1 * np.sin(angle) + 0.01 * np.cos(angle) - 0.01
    )


def test_what_the_led_tool_goes_through_is_named():
    """8 mm deep: along a wall a tool may slide so, a loose thing it would push."""
    aside = 2.2 * RADIUS - 0.008 - RADIUS
    verdict = pulled(beside(aside, x=0.4))
    assert verdict.code == Code.OBSTACLE_PUSHED and "the tool goes through block" in verdict.message
    assert pulled(beside(aside, source="known", x=0.4)).success


def test_what_the_tool_goes_through_is_named_though_it_is_deeper_in_something_else():
    """Its shaft slides along a wall, 9 mm deep, which it may, while its end goes 8 mm deep through a loose block."""
    side = -RADIUS - 0.022
    wall = scenes.item("wall", [scenes.block((0.0, 0.25), (side - 0.05, side + 0.009), (0.0, 0.05))])
    assert pulled(wall).success
    verdict = pulled(wall, beside(2.2 * RADIUS - 0.008 - RADIUS, x=0.4))
    assert verdict.code == Code.OBSTACLE_PUSHED and "the tool goes through block" in verdict.message


def test_a_loose_thing_that_is_nowhere_has_not_stayed():
    """By an engine that has lost it; a comparison with what is no number is never true."""
    places = [np.eye(4), np.full((4, 4), np.nan)]
    world = SimpleNamespace(
        touched_by=lambda name: ("tool",),
        let_go=lambda name: None,
        pose=lambda name: places.pop(0),
        centre_of_mass=lambda name: np.zeros(3),
    )
    block = SimpleNamespace(id="block", loose=True, outermost=scenes.block((-0.1, 0.1), (-0.1, 0.1), (0.0, 0.1)).vertices)
    run = SimpleNamespace(world=world, setup=SimpleNamespace(obstacles=(block,), table=scenes.TABLE), time=1.0, phase="goal")
    with pytest.raises(MagicError, match="OBSTACLE_PUSHED"):
        rollout._Others(run, rollout.Limits()).check()


def test_a_fixture_stands_fast():
    assert pulled(beside(-0.01, source="known")).code != Code.OBSTACLE_PUSHED


@pytest.mark.parametrize("sunk", [0.004, 0.03])
def test_a_reconstruction_that_reaches_into_the_table_is_no_push(sunk):
    """Raised out of it where that is little; what is deep in it stands fast."""
    assert pulled(beside(0.05, sunk=sunk)).success


def test_in_drawn_rollouts_as_well():
    """What is brushed in the scene as given is pushed where the target is drawn some millimetres off."""
    verdict = pulled(beside(-0.003), repetitions=12)
    assert verdict.runs[0].code == Code.OK and verdict.code == Code.OBSTACLE_PUSHED
    assert any("block" in text for text in verdict.failures)
    assert pulled(beside(-0.003, source="known"), repetitions=12).success
