"""A verified trajectory reaches the arm's controller only where that is wanted and the arm stands at its start."""

import math

import pytest
from sensor_msgs.msg import JointState
from test_strategy_server import Bench
from trajectory_msgs.msg import JointTrajectory

from magic_bringup import fakes
from magic_bringup.execution import check_start
from magic_core import qos
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_interfaces.action import VerifyMotion

NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
TOPIC = "controller/joint_trajectory"
HERE = {
    "names": NAMES,
    "first": [0.1] * 7,
    "state_names": FINGERS + NAMES,
    "state_positions": [0.04] * 2 + [0.1] * 7,
    "age": 0.01,
    "tolerance": 0.02,
    "max_age": 0.5,
}


def test_an_arm_at_the_start_is_accepted():
    check_start(**HERE)
    check_start(**{**HERE, "age": -0.01, "first": [0.119] * 7})


@pytest.mark.parametrize(
    "change, code, says",
    [
        ({"age": math.inf}, Code.NO_FRAMES, "none received"),
        ({"age": 0.6}, Code.STALE_DATA, "0.6"),
        ({"age": -0.6}, Code.STALE_DATA, "-0.6"),
        ({"age": math.nan}, Code.STALE_DATA, "nan"),
        ({"state_names": FINGERS + NAMES[:-1], "state_positions": [0.1] * 8}, Code.BAD_MOTION, "panda_joint7"),
        ({"first": [0.1] * 6 + [0.13]}, Code.BAD_MOTION, "0.0300 at panda_joint7"),
        ({"state_positions": [0.04] * 2 + [math.nan] + [0.1] * 6}, Code.BAD_MOTION, "panda_joint1"),
        ({"first": []}, Code.BAD_MOTION, "0 positions"),
    ],
    ids=["absent", "old", "of the future", "no age", "joint missing", "far", "not a number", "empty"],
)
def test_any_other_arm_is_refused(change, code, says):
    with pytest.raises(MagicError) as caught:
        check_start(**{**HERE, **change})
    assert caught.value.code == code
    assert says in caught.value.message


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("strategies")
    strategies.save(fakes.strategy("fake"), root / "fake")
    strategies.save(fakes.strategy("dynamic", simulatable=False), root / "dynamic")
    return root


@pytest.fixture(scope="module")
def arm(folder):
    """A server that may execute, with an arm that hears orders and tells where it is; no state has been told yet."""
    bench = Bench(folder, execute=True, execute_topic=TOPIC, state_age=10.0)
    bench.orders = bench.messages["orders"] = []
    bench.states = bench.node.create_publisher(JointState, "joint_states", 10)
    bench.fakes.publish(fakes.scene())
    yield bench
    bench.close()


def tell(bench, positions, late=0.0):
    """Publish a joint state until it has arrived."""
    message = JointState(name=list(FINGERS + NAMES), position=[0.04, 0.04, *positions])
    now = bench.node.get_clock().now().nanoseconds - int(late * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(now, 10**9)
    bench.server._joints = None
    bench.wait_for_match(bench.states)
    bench.states.publish(message)
    bench.until(lambda: bench.server._joints is not None)


def refused(bench):
    result, _ = bench.run(variant="arm")
    assert (result.code, result.verified) == (0, True), result.message
    assert "; not executed: " in result.message, result.message
    assert not bench.orders
    return result.message


def test_without_a_joint_state_nothing_is_executed(arm):
    assert "none received" in refused(arm)


def test_without_a_controller_nothing_is_executed(arm):
    tell(arm, [0.0] * 7)
    assert f"subscribers of /{TOPIC}" in refused(arm)


@pytest.fixture(scope="module")
def controlled(arm):
    subscription = arm.node.create_subscription(JointTrajectory, TOPIC, lambda m: arm._hear("orders", m), qos.RELIABLE)
    arm.wait_for_match(arm.server._controller)
    yield arm
    arm.node.destroy_subscription(subscription)


def test_an_old_joint_state_is_refused(controlled):
    tell(controlled, [0.0] * 7, late=15.0)
    assert "age of joint_states" in refused(controlled)


def test_an_arm_elsewhere_is_refused(controlled):
    tell(controlled, [0.0] * 6 + [0.5])
    assert "0.5000 at panda_joint7" in refused(controlled)


def test_what_is_not_verified_or_not_for_the_arm_is_never_executed(controlled):
    bench = controlled
    tell(bench, [0.0] * 7)
    bench.fakes.on_verify = lambda goal, canceled: VerifyMotion.Result(code=int(Code.DRIFT), message="it drifted")
    result, _ = bench.run(variant="arm")
    assert not result.verified
    bench.fakes.clear()
    result, _ = bench.run(strategy="dynamic", variant="arm", allow_unverified=True)
    assert (result.code, result.verified) == (0, False)
    result, _ = bench.run(variant="fg")
    assert (result.code, result.verified) == (0, True)
    assert "execut" not in result.message
    assert not bench.orders


def test_a_verified_trajectory_goes_to_the_arm_at_its_start(controlled):
    bench = controlled
    tell(bench, [0.01] * 7)
    result, _ = bench.run(variant="arm")
    assert f"sent to /{TOPIC}" in result.message
    bench.wait(lambda: bench.orders)
    (order,) = bench.orders
    assert tuple(order.joint_names) == NAMES
    assert (order.header.stamp.sec, order.header.stamp.nanosec) == (0, 0)
    assert len(order.points) == 2


def test_by_default_nobody_can_be_moved(folder):
    bench = Bench(folder)
    try:
        assert bench.server._controller is None
    finally:
        bench.close()
