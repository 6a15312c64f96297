"""A motion is judged by every number that would be published."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.presets import PRESETS
from magic_core.robot import Description, RobotConfig
from magic_verifier import motion_check
from magic_verifier.verification import Proposal, verify_proposal

ROBOT = Description()
COUNT, JOINTS = 101, 7
#: From rest to rest over 2 s, by no more than 0.5 rad.
SWING = np.array([0.5, -0.3, 0.2, 0.4, -0.2, 0.3, 0.1])


def arm_plan():
    """A good plan, written out: the joints go from home to home + SWING and stand still at the grasp, which is at 0.4 s."""
    times = np.linspace(0.0, 2.5, COUNT)
    share = np.clip((times - 0.5) / 2.0, 0, 1)
    place = 10 * share**3 - 15 * share**4 + 6 * share**5
    speed = (30 * share**2 - 60 * share**3 + 30 * share**4) / 2.0
    pull = (60 * share - 180 * share**2 + 120 * share**3) / 4.0
    q = np.array(ROBOT.config.home) + place[:, None] * SWING
    grasp = transforms.from_rpy(0.1, 0.2, 0.3, [0.01, 0.02, 0.1])
    poses = ROBOT.forward(q) @ transforms.inverse(grasp)
    poses[times < 0.4] = transforms.make(translation=[0.5, 0.1, 0.01])
    # Before the grasp the tool lies where it is taken from.
    poses[times < 0.4] = poses[times >= 0.4][0]
    phases = (Phase("grasp", 0.0, 0.5), Phase("goal", 0.5, 2.5))
    arm = ArmMotion(times, ROBOT.names, q, speed[:, None] * SWING, pull[:, None] * SWING, grasp, 0.02, 0.4, None, phases)
    return MotionPlan("arm", ToolMotion(times, poses, phases), arm)


PLAN = arm_plan()
FLOATING = scenes.hooking("L")[3]


def refused(plan, code, *words):
    with pytest.raises(MagicError) as error:
        motion_check.check(plan, ROBOT)
    assert error.value.code == code, error.value.message
    assert all(word in error.value.message for word in words), error.value.message
    assert "allowed" in error.value.message


def with_arm(**changes):
    return replace(PLAN, arm_motion=replace(PLAN.arm_motion, **changes))


def test_forward_kinematics_are_those_of_the_links():
    for q in np.random.default_rng(0).uniform(-1, 1, (5, JOINTS)):
        link = ROBOT.poses(dict(zip(ROBOT.names, q, strict=True)))[ROBOT.config.move_group]
        assert np.allclose(ROBOT.forward(q)[0], link, atol=1e-12)


def test_good_plans_pass():
    motion_check.check(PLAN, ROBOT)
    for scene in (scenes.hooking("L"), scenes.hanging(), scenes.scooping()):
        motion_check.check(scene[-1])


@given(
    what=st.sampled_from(["positions", "velocities", "accelerations"]),
    row=st.integers(0, COUNT - 1),
    joint=st.integers(0, JOINTS - 1),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
)
@settings(max_examples=40, deadline=None)
def test_a_number_that_is_none_is_found_wherever_it_is(what, row, joint, value):
    values = getattr(PLAN.arm_motion, what).copy()
    values[row, joint] = value
    refused(with_arm(**{what: values}), Code.BAD_MOTION, what, f"waypoint {row} ", ROBOT.names[joint])


@given(
    what=st.sampled_from(["positions", "velocities", "accelerations"]),
    row=st.integers(0, COUNT - 1),
    joint=st.integers(0, JOINTS - 1),
    value=st.sampled_from([-99.0, 99.0]),
)
@settings(max_examples=40, deadline=None)
def test_what_no_joint_can_do_is_found_wherever_it_is(what, row, joint, value):
    values = getattr(PLAN.arm_motion, what).copy()
    values[row, joint] = value
    code = Code.JOINT_LIMIT if what == "positions" else Code.DYNAMIC_LIMIT
    refused(with_arm(**{what: values}), code, f"waypoint {row} ", ROBOT.names[joint], "99.0")


@given(
    what=st.sampled_from(["positions", "velocities"]),
    row=st.integers(1, COUNT - 2),
    joint=st.integers(0, JOINTS - 1),
    by=st.floats(0.05, 0.5),
    up=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_positions_and_velocities_that_contradict_each_other_are_found(what, row, joint, by, up):
    """A jump of a position by 0.05 rad, or a velocity that is off by more than the joint could gain, within the arm's limits or not."""
    values = getattr(PLAN.arm_motion, what).copy()
    values[row, joint] += (1 if up else -1) * by * (1 if what == "positions" else 10)
    with pytest.raises(MagicError) as error:
        motion_check.check(with_arm(**{what: values}), ROBOT)
    assert error.value.code in (Code.BAD_MOTION, Code.DYNAMIC_LIMIT, Code.JOINT_LIMIT)
    assert ROBOT.names[joint] in error.value.message


def test_velocities_that_are_all_zero_contradict_a_motion():
    refused(with_arm(velocities=np.zeros((COUNT, JOINTS))), Code.BAD_MOTION, "contradict", "rad/s")


def test_a_jerk_beyond_the_limits_is_refused():
    """The swing's own is 60 / 2^3 rad/s^3 at its ends, times how far a joint goes: 3.75 for the first."""
    motion_check.check(PLAN, Description(RobotConfig(jerk=(3.8,))))
    with pytest.raises(MagicError) as error:
        motion_check.check(PLAN, Description(RobotConfig(jerk=(3.7,))))
    assert error.value.code == Code.DYNAMIC_LIMIT
    assert "jerk that a controller makes of it" in error.value.message and "rad/s^3" in error.value.message


def test_an_arm_that_pushes_off_at_once_where_it_stands_is_refused():
    """A controller begins and ends its moves without acceleration: more would be a jump."""
    for name, row in (("start", 0), ("grasp", int(np.searchsorted(PLAN.arm_motion.times, 0.4))), ("end", COUNT - 1)):
        pull = PLAN.arm_motion.accelerations.copy()
        pull[row, 1] = 0.5
        refused(with_arm(accelerations=pull), Code.BAD_MOTION, f"acceleration at the {name}", ROBOT.names[1], "up to 0.075 rad/s^2")


def test_an_fr3_goes_slowly_towards_the_end_of_a_joint():
    """Away from the end of its second joint, or towards it: 0.49 rad/s, 53 mrad before it."""
    files = {"urdf": str(ROBOT.urdf), "srdf": str(ROBOT.srdf), "move_group": ROBOT.config.move_group}
    fr3 = Description(replace(PRESETS["fr3"].config, **files))
    arm = PLAN.arm_motion
    end = fr3.arm[1].upper - 0.003
    q = arm.positions + np.where(np.arange(JOINTS) == 1, end - arm.positions[:, 1].max(), 0.0)
    # Three times as fast; away from the end, and the same towards it.
    speeds, pulls = 3 * arm.velocities, 9 * arm.accelerations
    away = replace(arm, times=arm.times / 3, positions=q, velocities=speeds, accelerations=pulls, grasp_time=0.13)
    motion_check.check_arm(away, fr3)
    back = {"positions": q[::-1], "velocities": -speeds[::-1], "accelerations": pulls[::-1]}
    towards = replace(away, **back, grasp_time=0.0)
    with pytest.raises(MagicError) as error:
        motion_check.check_arm(towards, fr3)
    assert error.value.code == Code.DYNAMIC_LIMIT
    assert "this near to the end of its range" in error.value.message


@given(first=st.integers(0, JOINTS - 1), second=st.integers(0, JOINTS - 1))
@settings(max_examples=20, deadline=None)
def test_joints_in_another_order_are_other_joints(first, second):
    names = list(ROBOT.names)
    names[first], names[second] = names[second], names[first]
    if first != second:
        refused(with_arm(joint_names=tuple(names)), Code.BAD_MOTION, "joints")


@given(row=st.integers(1, COUNT - 1), back=st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_times_strictly_increase(row, back):
    times = PLAN.arm_motion.times.copy()
    times[row] = times[row - 1] - back
    refused(with_arm(times=times), Code.BAD_MOTION, f"waypoint {row}", "increasing")


@given(row=st.integers(20, COUNT - 1), shift=st.floats(0.003, 0.04), axis=st.integers(0, 2))
@settings(max_examples=20, deadline=None)
def test_the_held_tool_is_where_the_joints_take_it(row, shift, axis):
    poses = PLAN.tool_motion.world_from_tool.copy()
    poses[row, axis, 3] += shift
    refused(replace(PLAN, tool_motion=replace(PLAN.tool_motion, world_from_tool=poses)), Code.BAD_MOTION, "waypoint")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"grasp_time": 9.0}, "time of the grasp"),
        ({"grasp_time": np.nan}, "time of the grasp"),
        ({"grasp_time": 1.5}, "velocity at the grasp"),
        ({"release_time": 0.1}, "after the grasp"),
        ({"grasp_width": 0.5}, "width of the grasp"),
        ({"tool_from_tcp": np.full((4, 4), np.nan)}, "grasp"),
        ({"velocities": np.zeros((COUNT, 6))}, "shape"),
        ({"phases": (Phase("goal", 1.0, 0.5),)}, "phase 'goal'"),
    ],
)
def test_what_else_is_wrong_with_an_arm_motion(changes, words):
    refused(with_arm(**changes), Code.BAD_MOTION, words)


def test_an_arm_that_is_still_moving_at_the_end_is_refused():
    arm, cut = PLAN.arm_motion, 60
    cut_off = replace(
        arm,
        times=arm.times[:cut],
        phases=(),
        **{name: getattr(arm, name)[:cut] for name in ("positions", "velocities", "accelerations")},
    )
    tool = ToolMotion(PLAN.tool_motion.times[:cut], PLAN.tool_motion.world_from_tool[:cut])
    refused(MotionPlan("arm", tool, cut_off), Code.BAD_MOTION, "velocity at the end", "rest")


@given(row=st.integers(1, len(FLOATING.tool_motion.times) - 2), axis=st.integers(0, 2), jump=st.floats(0.06, 1.0))
@settings(max_examples=20, deadline=None)
def test_a_floating_tool_does_not_jump(row, axis, jump):
    poses = FLOATING.tool_motion.world_from_tool.copy()
    poses[row, axis, 3] += jump
    refused(replace(FLOATING, tool_motion=replace(FLOATING.tool_motion, world_from_tool=poses)), Code.BAD_MOTION, f"waypoint {row}")
    poses[row:, axis, 3] = poses[row, axis, 3]  # nor does it stay there
    refused(replace(FLOATING, tool_motion=replace(FLOATING.tool_motion, world_from_tool=poses)), Code.BAD_MOTION, f"waypoint {row}")


def test_a_tool_does_not_turn_at_once_nor_race():
    poses = FLOATING.tool_motion.world_from_tool.copy()
    poses[100:] = poses[100:] @ transforms.from_rpy(0, 0, 1.0)
    refused(replace(FLOATING, tool_motion=replace(FLOATING.tool_motion, world_from_tool=poses)), Code.BAD_MOTION, "turn", "waypoint 100")
    faster = replace(FLOATING.tool_motion, times=FLOATING.tool_motion.times / 50, phases=())
    refused(replace(FLOATING, tool_motion=faster), Code.BAD_MOTION, "speed of the tool", "1.7 m/s")


def test_a_tool_that_is_let_go_is_at_rest():
    plan = scenes.hanging()[3]
    early = tuple(
        replace(p, start=0.5, end=0.6) if p.name == "release" else replace(p, end=min(p.end, 0.5)) for p in plan.tool_motion.phases
    )
    early = tuple(p for p in early if p.start < 0.5 or p.name == "release")
    refused(replace(plan, tool_motion=replace(plan.tool_motion, phases=early)), Code.BAD_MOTION, "let go", "m/s")


def test_what_is_refused_is_refused_before_any_physics():
    strategy, tool, target, plan = scenes.hooking("L")
    poses = plan.tool_motion.world_from_tool.copy()
    poses[50:, 2, 3] += 0.3
    jump = replace(plan, tool_motion=replace(plan.tool_motion, world_from_tool=poses))
    verdict = verify_proposal(Proposal(strategy, tool, target, (), scenes.TABLE, jump))
    assert (verdict.code, verdict.runs, verdict.simulated) == (Code.BAD_MOTION, (), 0.0)
    assert "waypoint 50" in verdict.message


def test_a_trajectory_names_its_tool_and_keeps_its_own_velocities():
    messages = pytest.importorskip("geometry_msgs.msg")
    from magic_core import conversions as convert

    motion = FLOATING.tool_motion
    message = convert.tool_motion_to_msg(motion, "tool")
    motion_check.check_trajectory(message, "tool", motion)
    with pytest.raises(MagicError, match="joint names"):
        motion_check.check_trajectory(message, "spoon", motion)
    speeds = np.gradient(motion.world_from_tool[:, :3, 3], motion.times, axis=0)
    for point, speed in zip(message.points, speeds, strict=True):
        point.velocities = [messages.Twist(linear=messages.Vector3(x=speed[0], y=speed[1], z=speed[2]))]
    smooth = convert.tool_motion_to_msg(motion, "tool")
    for point in smooth.points:
        point.velocities = [messages.Twist()]
    with pytest.raises(MagicError, match="away from that of its poses"):
        motion_check.check_trajectory(smooth, "tool", motion)
    message.points[30].velocities[0].angular.z = float("nan")
    with pytest.raises(MagicError, match="waypoint 30"):
        motion_check.check_trajectory(message, "tool", motion)
