"""What stops the arm because it came in where that is still to go."""

import numpy as np
import pytest

from magic_core import transforms
from magic_core.errors import Code
from magic_core.robot import PANDA_HOME, Description
from magic_server import scene_change
from magic_server.intrusion import Intruded, Intrusion, Way, away, middle, strangers

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.025
TIP = "panda_hand"


def cube(*place):
    return scene_change.hull(CORNERS + place)


@pytest.fixture(scope="module")
def robot():
    return Description()


@pytest.fixture
def way(robot):
    """The first joint turns by a quarter in a second; one point stands for the hand, and one 0.1 m below the tip for a tool."""
    turns = np.linspace(0.0, np.pi / 2, 11)
    positions = np.tile(np.array(PANDA_HOME), (11, 1))
    positions[:, 0] = turns
    return Way(robot, np.linspace(0.0, 1.0, 11), positions, {TIP: np.zeros((1, 3))}, np.array([[0.0, 0.0, 0.1]]), {})


def test_the_way_is_what_is_still_to_be_passed(robot, way):
    tips = robot.forward(way.positions)
    tool = tips[:, :3, 3] + 0.1 * tips[:, :3, 2]
    all_of_it, rest = way.after(0.0), way.after(0.75)
    assert len(all_of_it) == 22 and len(rest) == 6
    assert np.allclose(rest[-3:], tool[:-4:-1])  # from its end on
    assert np.allclose(way.after(9.0)[-1], tool[-1])


def test_how_far_a_thing_is_from_points():
    there = cube(0.4, 0.1, 0.2)
    assert away(there, np.array([[0.41, 0.1, 0.2], [1.0, 1.0, 1.0]])) == 0.0
    assert away(there, np.array([[0.525, 0.1, 0.2]])) == pytest.approx(0.1, abs=0.005)
    assert np.allclose(middle(there), [0.4, 0.1, 0.2], atol=2e-3)


def test_who_is_a_stranger():
    before = {"cup": cube(0.5, 0.0, 0.0), "target": cube(0.3, 0.0, 0.0)}
    after = {
        "cup": cube(0.9, 0.0, 0.0),  # has moved: watched elsewhere
        "part": scene_change.hull(0.4 * CORNERS + [0.51, 0.0, 0.0]),
        "tool_again": cube(0.0, 0.31, 0.2),
        "tool": cube(0.0, 0.9, 0.0),
        "hand": cube(0.5, 0.3, 0.2),
    }
    assert strangers(before, after, {"tool"}, cube(0.0, 0.3, 0.2)).keys() == {"hand"}
    assert strangers(before, after, {"tool"}, None).keys() == {"hand", "tool_again"}


def test_what_is_in_the_way_in_two_pictures_stops_the_arm(way):
    ahead = {"hand": cube(*way.after(1.0)[0])}
    seeking = Intrusion(way, 0.1)
    seeking.take(ahead, 5.0, 0.1)
    seeking.take(ahead, 5.0, 0.2)  # the same picture again
    with pytest.raises(Intruded, match=r"hand has come in while the arm moved, at \(-?0\.\d\d, 0\.\d\d, 0\.\d\d\) m") as caught:
        seeking.take(ahead, 6.0, 0.3)
    assert caught.value.code == Code.SCENE_CHANGED


def test_what_is_seen_once_or_aside_or_behind_the_arm_stops_nothing(robot, way):
    seeking = Intrusion(way, 0.1)
    tip = robot.forward(way.positions[:1])[0]
    begin = transforms.apply(tip, way.tool)[0]  # where the tool was at first
    here, aside = {"hand": cube(*begin)}, {"hand": cube(*(begin - [0.0, 0.4, 0.0]))}
    for stamp, come in enumerate((here, {}, here, aside, here, {}, aside, aside)):
        seeking.take(come, float(stamp), 0.0)
    for stamp in (10.0, 11.0):
        seeking.take(here, stamp, 0.9)
    with pytest.raises(Intruded):
        for stamp in (12.0, 13.0):
            seeking.take(here, stamp, 0.0)
