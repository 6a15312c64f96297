"""A scoop keeps to the things about it in the measure of its target: half as far off with a target half as large."""

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import transforms
from magic_core.contact import OPPOSED
from magic_planner.object_motion import plan_tool_motion

TABLE = (0.0, 0.0, 1.0, 0.0)
SHOWN = 0.025
#: x at which the contact of the demonstrated size ends, m.
END = 0.525


def scoop(radius, before=0.04):
    """The motion that brings a plate's contact to a cylinder's, 0.1 m along and up with it, turned beneath it, and 0.2 m up; without a
    wall, and with one so far beyond."""
    plate = scenes.item("tool", [scenes.box([0.01, 0.04, 0.02])], transforms.make(translation=[0.8, 0.3, 0.05]), scenes.DOWN)
    on_plate = scenes.contact(scenes.DOWN, [-0.005, 0, 0], [-1, 0, 0])
    _, shown_contact = scenes.standing_cylinder(SHOWN)
    far, turned, up = 0.05 * (np.arange(17) == 0), np.clip(np.linspace(0, 2, 17), 0, 1), np.linspace(0, 0.2, 17)
    contacts = np.stack([transforms.from_rpy(0, -np.pi / 2 * t, 0, [f - 0.1 * t, 0, -u]) for f, t, u in zip(far, turned, up, strict=True)])
    poses = shown_contact.object_from_contact @ contacts @ OPPOSED @ transforms.inverse(on_plate.object_from_contact)
    strategy = scenes.pulling(
        waypoints=(), mode="retarget", times=np.linspace(0, 4, 17), target_from_tool=poses,
        tool_contact=on_plate, target_contact=shown_contact, target_mesh=scenes.cylinder(SHOWN, 2 * SHOWN),
    )  # fmt: skip
    target, target_contact = scenes.standing_cylinder(radius)
    wall = scenes.item("wall", [scenes.box([0.04, 1.0, 0.6])], transforms.make(translation=[END - before - 0.02, 0, 0.3]), scenes.DOWN)
    given = strategy, plate, target, scenes.candidate(plate, on_plate, target_contact), "keep", TABLE
    return plan_tool_motion(*given), plan_tool_motion(*given, [wall])


@pytest.mark.parametrize(("share", "before"), [(0.4, 0.04), (0.5, 0.03), (0.8, 0.04), (0.5, 0.09)])
def test_a_smaller_target_is_scooped_nearer_to_the_wall(share, before):
    free, walled = scoop(share * SHOWN, before)
    moved = (walled.world_from_tool - free.world_from_tool)[:, :3, 3]
    np.testing.assert_allclose(moved[0], 0, atol=1e-3)
    shown = before + 0.1 * 2 / 90  # where the plate has turned but for 2 degrees; from there on it is led as was shown
    smaller = (1 - share) * SHOWN
    np.testing.assert_allclose(moved[-1], [-min((1 - share) * shown - smaller, smaller), 0, 0], atol=2e-4)
    assert np.abs(np.diff(moved[:, 0])).max() < 0.003, "smoothly"
    np.testing.assert_array_equal(walled.times, free.times)


@pytest.mark.parametrize("share", [1.0, 1.5])
def test_a_target_that_is_no_smaller_is_scooped_as_was_shown(share):
    free, walled = scoop(share * SHOWN)
    np.testing.assert_array_equal(walled.world_from_tool, free.world_from_tool)
