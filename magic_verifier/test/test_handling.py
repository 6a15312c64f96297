"""Pushing, tipping, pressing, reaching, pulling a ring: the goals of the strategies that ship refuse what only looks like it."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("magic_planner.object_motion")

from magic_bringup import handling
from magic_core import transforms
from magic_core.contact import Companion, ContactCandidate
from magic_core.errors import Code
from magic_core.motion import MotionPlan
from magic_core.shapes import make
from magic_planner.object_motion import plan_tool_motion
from magic_verifier import evaluate as ev
from magic_verifier.subjects import scene_for
from magic_verifier.verification import Proposal, verify_proposal


def shown(name, change=lambda offset, phase: offset):
    """The verdict on a demonstration whose waypoints were changed, in the scene as given."""
    strategy = handling.STRATEGIES[name]()
    waypoints = tuple(replace(w, offset=np.asarray(change(w.offset.copy(), w.phase))) for w in strategy.waypoints)
    strategy = replace(strategy, waypoints=waypoints)
    target, obstacles, _ = scene_for(strategy, "demonstration")
    entry = strategy.environment["tool"]
    item = make(entry["family"], entry["seed"], **entry["parameters"]).as_object("tool", transforms.make(translation=[0.4, -0.3, 0.02]))
    candidate = ContactCandidate("tool", strategy.tool_contact, strategy.target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4))
    motion = plan_tool_motion(strategy, item, target, candidate, "keep", ev.TABLE, obstacles)
    return verify_proposal(Proposal(strategy, item, target, obstacles, ev.TABLE, MotionPlan("fg", motion)), repetitions=1)


def shorter(by):
    """The way of the goal and of what follows ends so much (m) earlier."""
    return lambda offset, phase: offset + (np.array([by, 0, 0]) if phase in ("goal", "retreat") else 0)


def shifted(**by):
    return lambda offset, phase: offset + np.array([by.get(axis, 0.0) for axis in "xyz"])


@pytest.mark.parametrize(
    ("name", "change", "codes", "words"),
    [
        ("pushing", shorter(0.1), (Code.GOAL_NOT_REACHED,), "not pushed far enough"),
        # Met near its end the block turns away from the tool.
        ("pushing", shifted(y=0.13), (Code.DRIFT, Code.GOAL_NOT_REACHED), ""),
        ("pushing", shifted(z=-0.06), (Code.GOAL_NOT_REACHED,), "not pushed far enough"),
        # Low on its side a block slides and does not tip.
        ("tipping", shifted(z=0.075), (Code.GOAL_NOT_REACHED,), "not tipped over"),
        ("tipping", shorter(0.06), (Code.GOAL_NOT_REACHED,), "not tipped over"),
        ("pressing", shorter(0.03), (Code.LOST_CONTACT, Code.GOAL_NOT_REACHED), ""),
        ("pressing", shifted(y=0.25), (Code.LOST_CONTACT,), "the tool did not press on the target"),
        ("reaching", shifted(x=0.02), (Code.LOST_CONTACT,), "does not reach"),
        ("reaching", shorter(-0.04), (Code.DRIFT,), "the target was moved"),
        ("ring_pulling", shorter(0.1), (Code.GOAL_NOT_REACHED,), "not pulled far enough"),
        # In front of the ring it pulls nothing.
        ("ring_pulling", shifted(x=-0.12), (Code.LOST_CONTACT,), "lost the target"),
    ],
)
def test_what_only_looks_like_it_is_refused(name, change, codes, words):
    verdict = shown(name, change)
    assert not verdict.success and verdict.code in codes, verdict.message
    assert words in verdict.message


def shunted(change=lambda w: w, contact=lambda c: c):
    """The verdict on shunting with changed waypoints, or a changed contact on the outside."""
    strategy = handling.STRATEGIES["shunting"]()
    strategy = replace(strategy, waypoints=tuple(change(w) for w in strategy.waypoints))
    target, obstacles, _ = scene_for(strategy, "demonstration")
    entry = strategy.environment["tool"]
    item = make(entry["family"], entry["seed"], **entry["parameters"]).as_object("tool", transforms.make(translation=[0.4, -0.3, 0.02]))
    further = tuple(Companion(pair.name, contact(pair.tool), pair.target) for pair in strategy.contacts)
    candidate = ContactCandidate("tool", strategy.tool_contact, strategy.target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4), further)
    motion = plan_tool_motion(strategy, item, target, candidate, "keep", ev.TABLE, obstacles)
    return verify_proposal(Proposal(strategy, item, target, obstacles, ev.TABLE, MotionPlan("fg", motion)), repetitions=1)


def test_shunting_takes_both_contacts():
    verdict = shunted()
    assert verdict.success, verdict.message
    # Not pushed: the tool stays back by 80 mm.
    verdict = shunted(lambda w: replace(w, offset=w.offset + [0.08, 0, 0]) if w.contact else w)
    assert not verdict.success and "not pushed away first" in verdict.message
    # Not pulled: it comes down beside the block's far side.
    verdict = shunted(lambda w: w if w.contact else replace(w, offset=w.offset + [0, 0.15, 0]))
    assert not verdict.success and "not brought nearer" in verdict.message
    # Of the outside what is told as 90 mm behind where it is leaves the block unmoved, though the inside is right.
    verdict = shunted(contact=lambda c: replace(c, object_from_contact=c.object_from_contact @ transforms.make(translation=[0.09, 0, 0])))
    assert not verdict.success and "not pushed away first" in verdict.message


@pytest.mark.parametrize(("aside", "words"), [(0.0, ""), (0.025, "not where it was to be brought")])
def test_cornering_takes_both_sides_at_once(aside, words):
    """Of the flank what is told so far aside (m) of where it is leads the block elsewhere, though the head is right."""
    strategy = handling.STRATEGIES["cornering"]()
    target, obstacles, _ = scene_for(strategy, "demonstration")
    entry = strategy.environment["tool"]
    item = make(entry["family"], entry["seed"], **entry["parameters"]).as_object("tool", transforms.make(translation=[0.4, -0.3, 0.02]))
    (pair,) = strategy.contacts
    told = replace(pair.tool, object_from_contact=pair.tool.object_from_contact @ transforms.make(translation=[-aside, 0, 0]))
    further = (Companion(pair.name, told, pair.target),)
    candidate = ContactCandidate("tool", strategy.tool_contact, strategy.target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4), further)
    motion = plan_tool_motion(strategy, item, target, candidate, "keep", ev.TABLE, obstacles)
    verdict = verify_proposal(Proposal(strategy, item, target, obstacles, ev.TABLE, MotionPlan("fg", motion)), repetitions=1)
    assert verdict.success == (aside == 0.0) and words in verdict.message, verdict.message


def test_a_ring_is_held_to_both_sides():
    verdict = shown("ring_pulling")
    assert verdict.success and verdict.metrics["sides_held"] == 2.0, verdict.message
