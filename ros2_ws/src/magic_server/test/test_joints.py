"""What is known of the joints, and whether the arm stands where a trajectory begins."""

import math
from dataclasses import replace

import pytest

from magic_core.errors import Code, MagicError
from magic_server.joints import Joint, JointStates, check_start
from magic_server.testing import fakes

NAMES = fakes.JOINTS
CLOCK, NOW = 1000.0, 50.0
AT = Joint(0.1, 0.0, CLOCK - 0.01, NOW - 0.01)
HERE = {
    "names": NAMES,
    "first": [0.1] * 7,
    "joints": dict.fromkeys((*fakes.FINGERS, *NAMES), AT),
    "clock": CLOCK,
    "now": NOW,
    "tolerance": 0.02,
    "max_age": 0.5,
}


def but(name="panda_joint1", **changes):
    """The joints as they should be, but one."""
    return {"joints": {**HERE["joints"], name: replace(AT, **changes)}}


def test_an_arm_at_the_start_is_accepted():
    check_start(**HERE)
    check_start(**{**HERE, "first": [0.119] * 7})
    check_start(**{**HERE, **but(stamp=CLOCK + 0.1)})
    check_start(**{**HERE, **but(velocity=math.nan)})  # not told
    check_start(**{**HERE, **but("panda_finger_joint1", position=math.nan, stamp=0.0, velocity=9.0)})  # not of the trajectory


@pytest.mark.parametrize(
    "change, code, says",
    [
        ({"joints": {}}, Code.NO_FRAMES, "none received"),
        (but(stamp=CLOCK - 0.6), Code.STALE_DATA, "0.6"),
        (but(came=NOW - 0.6), Code.STALE_DATA, "0.6"),
        (but(stamp=CLOCK + 0.6), Code.STALE_DATA, "-0.6"),
        (but(stamp=math.nan), Code.STALE_DATA, "nan"),
        ({"clock": 0.0}, Code.STALE_DATA, "-999.99"),  # simulated time without a clock
        ({"joints": dict.fromkeys(NAMES[:-1], AT)}, Code.BAD_MOTION, "nothing about panda_joint7"),
        ({"first": [0.1] * 6 + [0.13]}, Code.BAD_MOTION, "0.0300 at panda_joint7"),
        (but(position=math.nan), Code.BAD_MOTION, "panda_joint1"),
        (but(velocity=-0.2), Code.BAD_MOTION, "speed of the arm in rad/s where a move begins: '0.200 at panda_joint1'"),
        ({"first": []}, Code.BAD_MOTION, "0 positions"),
    ],
    ids=[
        "absent",
        "old stamp",
        "came long ago",
        "of the future",
        "no age",
        "no clock",
        "joint missing",
        "far",
        "not a number",
        "moving",
        "empty",
    ],
)
def test_any_other_arm_is_refused(change, code, says):
    with pytest.raises(MagicError) as caught:
        check_start(**{**HERE, **change})
    assert caught.value.code == code
    assert says in caught.value.message


def test_messages_may_tell_of_some_joints_only():
    states = JointStates()
    states.take(["a", "b"], [1.0, 2.0], [0.5, 0.6], 10.0, 1.0)
    states.take(["c"], [3.0], [], 11.0, 2.0)
    states.take(["b"], [2.5], [0.0], 12.0, 3.0)
    joints = states.all()
    assert [joints[n].position for n in "abc"] == [1.0, 2.5, 3.0]
    assert (joints["a"].velocity, joints["b"].velocity) == (0.5, 0.0)
    assert math.isnan(joints["c"].velocity)
    assert (joints["a"].stamp, joints["b"].came) == (10.0, 3.0)


def test_a_message_whose_positions_do_not_go_with_its_names_says_nothing():
    states = JointStates()
    states.take(["a", "b"], [1.0], [], 10.0, 1.0)
    states.take([], [1.0], [], 10.0, 1.0)
    assert states.all() == {}
