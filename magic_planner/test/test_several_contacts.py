"""Motions of tools that meet their target at more than one place."""

from dataclasses import replace

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import transforms
from magic_core.contact import OPPOSED, Companion, turned_over
from magic_core.errors import Code, MagicError
from magic_core.strategy import ContactPair, Waypoint
from magic_planner.object_motion import STEP_ANGLE, placed_contact_frame, plan_tool_motion, turning, waypoint_times

TABLE = (0.0, 0.0, 1.0, 0.0)
WAYPOINTS = (
    Waypoint("above", np.array([0.05, 0, -0.12]), "approach", 0.1, "back"),
    Waypoint("before", np.array([0.05, 0, 0]), "approach", 0.1, "back"),
    Waypoint("touch", np.zeros(3), "contact", 0.05, "back"),
    Waypoint("pushed", np.array([-0.06, 0, 0]), "push", 0.1, "back"),
    Waypoint("clear", np.array([0.03, 0, -0.12]), "back_off", 0.1, "back"),
    Waypoint("over", np.array([0.09, 0, -0.12]), "over"),
    Waypoint("behind", np.array([0.09, 0, 0]), "over"),
    Waypoint("met", np.array([0.06, 0, 0]), "goal"),
    Waypoint("pulled", np.array([-0.1, 0, 0]), "goal"),
)


def two_contacts(waypoints=WAYPOINTS, twist=0.0):
    """The hook with its inner side and its outer, the cylinder with its far side and its near; the outer side's normal turned by
    ``twist``."""
    tool, inner = scenes.hook()
    target, far = scenes.standing_cylinder()
    outer = scenes.contact(scenes.DOWN, [0.15, 0.05, 0], [np.cos(twist), np.sin(twist), 0])
    near = scenes.contact(scenes.DOWN, [-0.025, 0, 0], [-1, 0, 0])
    pair = ContactPair("back", outer, near, np.array([-1.0, 0, 0]))
    strategy = replace(scenes.pulling(waypoints), contacts=(pair,))
    candidate = replace(scenes.candidate(tool, inner, far), companions=(Companion("back", outer, near),))
    return strategy, tool, target, candidate


@pytest.mark.parametrize("twist", [0.0, 0.4])
def test_each_contact_goes_through_its_own_waypoints(twist):
    strategy, tool, target, candidate = two_contacts(twist=twist)
    motion = plan_tool_motion(strategy, tool, target, candidate, "keep", TABLE)
    companion = candidate.companions[0]
    marks = dict(motion.marks)
    assert [name for name, _ in motion.marks] == [w.name for w in WAYPOINTS]
    for waypoint in WAYPOINTS:
        index = int(np.argmin(np.abs(motion.times - marks[waypoint.name])))
        assert motion.times[index] == pytest.approx(marks[waypoint.name], abs=1e-6)
        of_tool, of_target = (companion.tool, companion.target) if waypoint.contact else (candidate.tool, candidate.target)
        wanted = target.world_from_object @ of_target.object_from_contact @ transforms.make(translation=waypoint.offset) @ OPPOSED
        found = motion.world_from_tool[index] @ of_tool.object_from_contact
        found[2, 3] = wanted[2, 3]  # the table may have raised it
        np.testing.assert_allclose(found, wanted, atol=1e-9)
    assert turning(motion.world_from_tool[:-1], motion.world_from_tool[1:]).max() < 1.5 * STEP_ANGLE
    assert {phase.name for phase in motion.phases} == {w.phase for w in WAYPOINTS}


def test_a_contact_that_no_waypoint_names_turns_the_tool_to_meet_both():
    strategy, _, _, candidate = two_contacts()
    plain = replace(strategy, waypoints=scenes.pulling().waypoints)
    # On the target the second place is turned by 0.3 rad about the first against where it is on the tool.
    first, second = candidate.tool.object_from_contact, candidate.companions[0].tool.object_from_contact
    turn = transforms.from_rotvec([0, 0, 0.3])
    on_target = candidate.target.object_from_contact @ OPPOSED @ turn @ transforms.inverse(first) @ second @ OPPOSED
    companion = replace(candidate.companions[0], target=replace(candidate.companions[0].target, object_from_contact=on_target))
    both = replace(candidate, companions=(companion,))
    frame = placed_contact_frame(plain, both, "keep")
    placed = candidate.target.object_from_contact @ OPPOSED @ transforms.inverse(frame)
    before = candidate.target.object_from_contact @ OPPOSED @ transforms.inverse(first)
    wanted = on_target @ OPPOSED

    def off(pose):
        return float(turning(pose @ second, wanted[None])[0]), float(np.linalg.norm((pose @ second)[:3, 3] - wanted[:3, 3]))

    # The first normal, the second's and the way between them share the turn: two thirds of it are taken.
    assert off(before)[0] == pytest.approx(0.3, abs=1e-6)
    assert off(placed)[0] == pytest.approx(0.1, abs=1e-3) and off(placed)[1] < 0.4 * off(before)[1]
    np.testing.assert_array_equal(placed_contact_frame(replace(plain, contacts=()), replace(candidate, companions=()), "keep"), first)


def test_two_sides_of_a_corner_are_met_at_once_by_a_corner_of_other_lengths():
    """Both straight sides lie on the target's, though the places that were told on them are at other distances from the corner."""
    strategy, _, _, candidate = two_contacts()
    plain = replace(strategy, waypoints=scenes.pulling().waypoints)

    def side(point, normal):
        return replace(scenes.contact(scenes.DOWN, point, normal), radius=np.inf)

    far, flank = side([0.02, 0, 0], [1, 0, 0]), side([0, 0.025, 0], [0, 1, 0])
    head, handle = side([0.2, -0.07, 0], [-1, 0, 0]), side([0.12, -0.01, 0], [0, -1, 0])
    both = replace(candidate, tool=head, target=far, companions=(Companion("back", handle, flank),))
    placed = far.object_from_contact @ OPPOSED @ transforms.inverse(placed_contact_frame(plain, both, "keep"))
    for of_tool, of_target in ((head, far), (handle, flank)):
        met, wanted = placed @ of_tool.object_from_contact, of_target.object_from_contact
        np.testing.assert_allclose(met[:3, 0], -wanted[:3, 0], atol=1e-9)
        assert abs((met[:3, 3] - wanted[:3, 3]) @ wanted[:3, 0]) < 1e-3


def test_further_contacts_are_turned_over_with_the_tool():
    strategy, tool, target, candidate = two_contacts()
    flipped = replace(candidate, flipped=True)
    motion = plan_tool_motion(strategy, tool, target, flipped, "turn", TABLE)
    index = int(np.argmin(np.abs(motion.times - dict(motion.marks)["pushed"])))
    companion = candidate.companions[0]
    wanted = target.world_from_object @ companion.target.object_from_contact @ transforms.make(translation=[-0.06, 0, 0]) @ OPPOSED
    found = motion.world_from_tool[index] @ turned_over(companion.tool.object_from_contact)
    np.testing.assert_allclose(found[:2], wanted[:2], atol=1e-9)


def test_what_lacks_a_contact_is_refused():
    strategy, tool, target, candidate = two_contacts()
    for wrong in (replace(candidate, companions=()), replace(candidate, companions=(replace(candidate.companions[0], target=None),))):
        with pytest.raises(MagicError) as error:
            plan_tool_motion(strategy, tool, target, wrong, "keep", TABLE)
        assert error.value.code is Code.BAD_REQUEST and "back" in error.value.message
    with pytest.raises(MagicError) as error:
        waypoint_times(strategy)
    assert error.value.code is Code.BAD_STRATEGY
