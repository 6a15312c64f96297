"""What is left of a planned motion after the lift, with the tool as it is in the hand: held against the arm's limits and run in physics."""

from dataclasses import replace

import numpy as np
import pytest

from magic_core import conversions, transforms
from magic_core.errors import Code
from magic_core.robot import Description
from magic_core.strategy import find
from magic_planner.arm import ArmPlanner
from magic_planner.benchmark import make_case
from magic_planner.robot import Robot
from magic_server import execution
from magic_server.held import rest_of
from magic_verifier import motion_check
from magic_verifier.benchmark import TABLE, planned
from magic_verifier.verification import Proposal, verify_proposal

ROBOT = Description()


@pytest.fixture(scope="module")
def hooking():
    """A strategy, a case and its motion."""
    strategy = find("hooking")
    case = make_case(strategy, "l_hook", "inner", 900)
    return strategy, case, planned(strategy, case, "arm", ArmPlanner(Robot()))


@pytest.mark.parametrize(("shift", "passes"), [(0.0, True), (0.004, True), (0.06, False)])
def test_the_rest_of_a_motion_has_a_verdict_of_its_own(hooking, shift, passes):
    strategy, case, plan = hooking
    message = conversions.plan_to_msg(plan, case.tool.id)
    points = message.arm_trajectory.points
    times = [conversions.time_from_msg(p.time_from_start) for p in points]
    steps = execution.steps(
        times, [p.velocities for p in points], message.grasp_time, message.release_time, message.grasp_width, 0.08, look=True
    )
    (look,) = (step for step in steps if isinstance(step, execution.Look))
    held = plan.arm_motion.tool_from_tcp @ transforms.make(translation=[shift, 0.0, 0.0])
    rest = conversions.plan_from_msg(rest_of(message, look.point, held, ROBOT))
    motion_check.check(rest, ROBOT)
    assert rest.arm_motion.times[-1] == pytest.approx(plan.arm_motion.times[-1] - times[look.point])
    pose = ROBOT.forward(rest.arm_motion.positions[:1])[0] @ transforms.inverse(held)
    tool = replace(case.tool, world_from_object=pose, hanging=True)
    verdict = verify_proposal(Proposal(strategy, tool, case.target, case.obstacles, TABLE, rest, 0), repetitions=1)
    assert (verdict.code == Code.OK) == passes, verdict.message
    np.testing.assert_allclose(rest.tool_motion.world_from_tool[0], pose, atol=1e-6)
