"""Where a tool was at the moment of a picture: lying, in the hand on its way, and where the hand let it go."""

import numpy as np
import pytest

from magic_core import conversions, transforms
from magic_server.held import Carried, Held
from magic_server.testing import fakes

TOOL = conversions.scene_to_msg(fakes.scene()).objects[0]
HELD = Held(TOOL, np.eye(4))


def hand(stamp):
    """It goes along x by 0.2 m/s."""
    return transforms.make(translation=[0.2 * stamp, 0.0, 0.3])


def x_of(hull):
    """The middle of a hull along x, by the directions that are nearest to it."""
    from magic_server.scene_change import DIRECTIONS

    along, against = (int(np.argmax(sign * DIRECTIONS[:, 0])) for sign in (1, -1))
    return (hull[along] - hull[against]) / 2


def test_a_picture_shows_the_tool_where_the_hand_was_and_not_where_it_is():
    start = x_of(HELD.hull(transforms.make(translation=[0.0, 0.0, 0.3])))
    carried = Carried(HELD, taken=2.0, taken_at=hand(2.0), let_go=7.0, let_go_at=hand(7.0))
    for stamp, place in ((1.0, 0.4), (2.0, 0.4), (4.5, 0.9), (7.0, 1.4), (60.0, 1.4)):
        assert x_of(carried.hull(stamp, hand)) - start == pytest.approx(place, abs=0.02)
    # In the hand since before the motion began, and still.
    assert x_of(Carried(HELD).hull(1.0, hand)) - start == pytest.approx(0.2, abs=0.02)


def test_of_a_moment_that_nobody_remembers_nothing_is_asked_of_the_hand():
    def forgotten(stamp):
        raise AssertionError(stamp)

    carried = Carried(HELD, taken=2.0, taken_at=hand(2.0), let_go=7.0, let_go_at=hand(7.0))
    for stamp in (1.0, 60.0):
        assert np.isfinite(carried.hull(stamp, forgotten)).all()
