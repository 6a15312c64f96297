"""A verified plan is carried out by an arm and a gripper that speak the actions of real ones."""

# In a file of its own: a graph that a module's fixture still holds would share its ROS context.

import threading
from itertools import pairwise
from pathlib import Path

import numpy as np

from magic_bringup.testing import ONCE, feeding, first_messages, started, until
from magic_core.errors import Code
from magic_core.executor import ThreadedExecutor
from magic_server.testing import fakes

BAG = Path(__file__).resolve().parents[1] / "bags" / "hanging"
HOME = [0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4]
SERVER = {
    "execute": True,
    "autostart": True,
    "state_age": 10.0,
    "objects_age": 20.0,
    # The cameras show the same moment for ever: neither the mug in the hand nor where it hangs in the end.
    **fakes.OPEN_LOOP,
    "trajectory_action": "arm/follow_joint_trajectory",
    "gripper_action": "gripper/gripper_action",
    **ONCE,
}


def test_a_mug_is_hung_by_arm_and_gripper(tmp_path):
    messages = first_messages(BAG)
    del messages["/joint_states"]  # the arm tells its own
    with started(tmp_path, BAG, {"strategy_server": SERVER}) as bench:
        bench.ready()
        arm = fakes.FakeArm(thickness=0.0)
        arm.positions = list(HOME)
        executor = ThreadedExecutor(4)
        executor.add_node(arm)
        thread = threading.Thread(target=executor.spin, daemon=True)
        thread.start()
        try:
            with feeding(messages):  # as cameras would: the objects must have been seen just now where the arm begins to move
                until(lambda: bench.watcher.objects_at is not None, what="objects are published")
                result = bench.run(strategy="hanging", variant="arm")
        finally:
            executor.shutdown(timeout_sec=2.0)
            arm.destroy_node()
            thread.join(5.0)
    assert (result.code, result.verified, result.executed) == (0, True, True), f"{Code(result.code).name}: {result.message}"
    moves = [entry for entry in arm.log if not isinstance(entry, tuple)]
    fingers = [entry for entry in arm.log if isinstance(entry, tuple)]
    # To the mug, to the rod, away: each begins where the one before ended.
    assert [f[0] for f in fingers] == ["open", "close", "open"]
    assert fingers[1][1] == result.plan.grasp_width / 2
    assert len(moves) == 3
    np.testing.assert_allclose(moves[0].points[0].positions, HOME, atol=0.02)
    for before, after in pairwise(moves):
        np.testing.assert_allclose(before.points[-1].positions, after.points[0].positions)
    assert sum(len(m.points) for m in moves) == len(result.plan.arm_trajectory.points) + 2
    assert any(line.startswith("execute: step 5 of 6") for line in bench.lines), bench.lines
