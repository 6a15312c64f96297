"""Whole arm motions: they do what the tool's motion asks, within the limits, the same each time, or say why not."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import planner_scenes as scenes
import pytest

from magic_core import interpolation, transforms
from magic_core.errors import Code, MagicError
from magic_core.joint_limits import PUBLISHED
from magic_core.strategy import Waypoint
from magic_planner import timing
from magic_planner.budget import Budget
from magic_planner.choice import GraspChoice
from magic_planner.collision import Body, grown, roomy_shell, shell, solid_pieces
from magic_planner.free_motion import LONGEST
from magic_planner.margins import margins
from magic_planner.object_motion import plan_tool_motion, tool_contact_frame
from magic_planner.pace import Pace, haste
from magic_planner.request import ArmSettings, Problem, StageError
from magic_planner.schedule import slowed
from magic_planner.task_path import TaskPath
from magic_planner.workspace import DEEPER


def problem(at=(0.6, 0.0), **changes):
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder(at=at)
    strategy = scenes.pulling(**changes)
    candidate = scenes.candidate(tool, tool_contact, target_contact)
    return strategy, tool, target, candidate, "keep", plan_tool_motion(strategy, tool, target, candidate)


@pytest.fixture(scope="module")
def solved(arm):
    given = problem()
    return given, arm.solve(Problem(*given))


def span(plan, name):
    return next(p for p in plan.arm_motion.phases if p.name == name)


def test_the_hand_carries_the_tool_along_the_asked_path(arm, solved):
    (_, tool, _, _, _, motion), plan = solved
    times, held = plan.arm_motion.times, plan.arm_motion.times >= plan.arm_motion.grasp_time
    tips = arm.robot.chain.forward(plan.arm_motion.positions)
    expected = plan.tool_motion.world_from_tool @ plan.arm_motion.tool_from_tcp
    assert np.linalg.norm(tips[held, :3, 3] - expected[held, :3, 3], axis=1).max() < 1e-3
    # ... which is the tool's own motion: each pose of the task lies on it.
    began = span(plan, "approach").start
    task = times >= began + 1e-9
    asked = motion.world_from_tool
    for pose in plan.tool_motion.world_from_tool[task][::5]:
        gap = np.linalg.norm(asked[:, :3, 3] - pose[:3, 3], axis=1)
        near = asked[int(gap.argmin())]
        assert gap.min() < 0.0035  # half a step between samples, and a millimetre
        assert transforms.rotation_angle(near, pose) < np.deg2rad(0.5)
    np.testing.assert_allclose(plan.tool_motion.world_from_tool[task][0], asked[0], atol=1e-3)
    np.testing.assert_allclose(plan.tool_motion.world_from_tool[-1], asked[-1], atol=1e-3)
    np.testing.assert_array_equal(plan.tool_motion.world_from_tool[0], tool.world_from_object)


def test_the_hand_leaves_room_for_the_target_in_the_tool(arm):
    """A ball that is met with a scoop's lip rolls on into the bowl: where the contacts meet, not where it is met, no finger may be."""
    strategy, tool, target, candidate, reflection, motion = problem()
    request = arm._request(Problem(strategy, tool, target, candidate, reflection, motion), Budget(), lambda stage, message: None)
    frame = tool_contact_frame(candidate, reflection)

    def best(tool_from_target):
        lots = GraspChoice(arm.robot, arm.grasping, arm.settings, request, frame, tool_from_target).lots()
        return np.stack([grasp.tool_from_tcp for grasp in next(lots)])

    def beside(frames, tool_from_target):
        hand, ball = arm.robot.hand_body(), Body("ball", solid_pieces(target))
        ball.move(tool_from_target)
        return [hand.move(frame) or hand.touches(ball) for frame in frames]

    anywhere = best(None)
    finger = anywhere[0] @ transforms.make(translation=0.045 * arm.robot.closing)
    assert any(beside(anywhere, finger)) and not any(beside(best(finger), finger))
    np.testing.assert_array_equal(best(transforms.make(translation=[0, 0, 1.0])), anywhere)


def test_hands_that_would_brush_the_tool_come_last(arm):
    """A hand is a millimetre or two off where it was sent: a light tool that it brushes is gone before the fingers close."""
    strategy, tool, target, candidate, reflection, motion = problem()
    request = arm._request(Problem(strategy, tool, target, candidate, reflection, motion), Budget(), lambda stage, message: None)
    choice = GraspChoice(arm.robot, arm.grasping, arm.settings, request, tool_contact_frame(candidate, reflection))
    roomy = next(choice.lots())[0]
    deep = roomy.tool_from_tcp.copy()
    hand, body = arm.robot.hand_body(), Body("tool", solid_pieces(tool))
    while True:  # as deep as it can come
        hand.move(deep @ transforms.make(translation=[0, 0, 0.0005]))
        if hand.touches(body):
            break
        deep = deep @ transforms.make(translation=[0, 0, 0.0005])
    close = dataclasses.replace(roomy, tool_from_tcp=deep, cost=roomy.cost - 1)
    assert choice._with_room([close, roomy]) == [roomy, close]


def test_the_contact_is_reached_at_the_end_of_its_phase(solved):
    (_, _, target, candidate, _, _), plan = solved
    when = span(plan, "contact").end
    pose = transforms.interpolate(plan.tool_motion.times, plan.tool_motion.world_from_tool, [when])[0]
    tool_contact = pose @ candidate.tool.object_from_contact
    target_contact = target.world_from_object @ candidate.target.object_from_contact
    assert np.linalg.norm(tool_contact[:3, 3] - target_contact[:3, 3]) < 1e-3


def test_limits_are_kept_and_derivatives_are_derivatives(arm, solved):
    _, plan = solved
    motion, robot = plan.arm_motion, arm.robot
    assert np.all(motion.positions >= robot.chain.lower) and np.all(motion.positions <= robot.chain.upper)
    fast, strong, sharp = interpolation.extremes(motion.times, motion.positions, motion.velocities, motion.accelerations)
    # What lies between the points, as a controller joins them: within 2 % of the shares of the limits that are used.
    assert np.all(fast <= robot.limits.velocity * 1.02)
    assert np.all(strong <= robot.limits.acceleration * 1.02)
    # ... and far below the published jerk, of which 3 % are aimed at: a step of 20 ms rounds the corners of the acceleration.
    assert np.all(sharp <= np.array(PUBLISHED["panda"].jerk) * 0.06)
    rests = np.searchsorted(motion.times, [0.0, motion.grasp_time, motion.times[-1]])
    np.testing.assert_allclose(motion.accelerations[rests], 0, atol=1e-9)
    assert np.all(np.diff(motion.times) > 0)
    middle = 0.5 * (motion.velocities[1:] + motion.velocities[:-1]) * np.diff(motion.times)[:, None]
    assert np.abs(np.diff(motion.positions, axis=0) - middle).max() < 2e-3
    np.testing.assert_allclose(motion.velocities[[0, -1]], 0, atol=1e-9)
    np.testing.assert_allclose(motion.positions[0], robot.home, atol=1e-9)
    assert motion.joint_names == tuple(f"panda_joint{i}" for i in range(1, 8))


def test_phases_cover_the_motion_and_the_gripper_closes_on_the_tool(solved):
    _, plan = solved
    motion = plan.arm_motion
    assert [p.name for p in motion.phases] == ["grasp", "transfer", "approach", "contact", "goal"]
    assert motion.phases[0].start == 0 and motion.phases[-1].end == pytest.approx(motion.times[-1], abs=1e-6)
    assert motion.grasp_width == pytest.approx(0.02, abs=1e-3)
    assert motion.phases[0].end - motion.grasp_time == pytest.approx(0.5)
    assert motion.release_time is None
    still = (motion.times > motion.grasp_time) & (motion.times < motion.phases[0].end)
    assert np.abs(motion.velocities[still]).max() == 0


def test_no_pose_of_the_plan_is_in_collision(arm, solved):
    (_, tool, target, _, _, _), plan = solved
    robot, motion = arm.robot, plan.arm_motion
    robot.clear()
    robot.add_table(np.array([0, 0, 1.0, 0]))
    from magic_planner.collision import shell

    robot.add(target.id, shell(target.pieces), target.world_from_object)
    robot.open_to(motion.grasp_width)
    robot.attach(tool.id, shell(tool.pieces), transforms.inverse(motion.tool_from_tcp), tuple(robot.hand))
    lifted = (motion.times > span(plan, "transfer").start + 1.0) & (motion.times < span(plan, "approach").end)
    assert lifted.sum() > 20
    assert not any(robot.collides(q) for q in motion.positions[lifted][::3])


def test_the_same_problem_by_its_parts_has_the_same_plan(arm, solved):
    given, plan = solved
    again = arm.plan(*given)
    np.testing.assert_array_equal(plan.arm_motion.positions, again.arm_motion.positions)
    np.testing.assert_array_equal(plan.arm_motion.times, again.arm_motion.times)


def test_another_attempt_is_another_grasp(arm, solved):
    given, plan = solved
    other = arm.solve(Problem(*given, attempt=1))
    a, b = plan.arm_motion.tool_from_tcp, other.arm_motion.tool_from_tcp
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) > 0.014 or transforms.rotation_angle(a, b) > np.deg2rad(19)


def test_where_no_grasp_of_the_quick_look_serves_more_are_looked_for(arm, solved, monkeypatch):
    given, _ = solved
    asked = []
    follow = arm.task.branches

    def branches(request, grasps, failures):
        asked.append(len(grasps))
        if len(asked) > len(arm.settings.lots):
            return follow(request, grasps, failures)
        failures.add("task", MagicError(Code.NO_IK, "every grasp of the quick look", "out of reach", "others"))
        return []

    monkeypatch.setattr(arm.task, "branches", branches)
    assert arm.solve(Problem(*given)).arm_motion is not None
    assert len(asked) == len(arm.settings.lots) + 1


def test_what_fails_before_the_tool_is_lifted_uses_up_no_try(arm, solved, monkeypatch):
    """Each is found in a few milliseconds, and of a tool that the forearm meets with one grasp it is met with most."""
    given, plan = solved
    failed = []
    check = arm.task.check

    def met(request, branch):
        if len(failed) < 2 * arm.settings.tries:
            failed.append(branch)
            raise StageError("task", MagicError(Code.PATH_IN_COLLISION, "forearm and tool", "in collision", "a clear path"))
        check(request, branch)

    monkeypatch.setattr(arm.task, "check", met)
    other = arm.solve(Problem(*given))
    assert len(failed) == 2 * arm.settings.tries
    assert not np.array_equal(other.arm_motion.tool_from_tcp, plan.arm_motion.tool_from_tcp)


def test_a_releasing_strategy_lets_go_and_backs_off(arm):
    strategy = scenes.pulling()
    waypoints = (*strategy.waypoints[:3], Waypoint("let go", np.zeros(3), "release"))
    given = problem(waypoints=waypoints, releases=True)
    plan = arm.solve(Problem(*given))
    motion = plan.arm_motion
    assert [p.name for p in motion.phases][-2:] == ["release", "retreat"]
    assert motion.release_time == pytest.approx(span(plan, "release").start)
    after = plan.tool_motion.times > motion.release_time
    np.testing.assert_allclose(
        plan.tool_motion.world_from_tool[after], np.repeat(plan.tool_motion.world_from_tool[-1:], after.sum(), axis=0)
    )
    tips = arm.robot.chain.forward(motion.positions[[np.searchsorted(motion.times, motion.release_time), -1]])
    assert np.linalg.norm(tips[1, :3, 3] - tips[0, :3, 3]) == pytest.approx(arm.settings.retreat, abs=2e-3)


def test_out_of_reach_names_the_waypoint(arm):
    with pytest.raises(MagicError, match="waypoint 'above'") as raised:
        arm.solve(Problem(*problem(at=(1.6, 0.0))))
    assert raised.value.code == Code.NO_IK
    strategy = scenes.pulling()
    far = (*strategy.waypoints[:3], Waypoint("far", np.array([0.9, 0, 0]), "goal", 0.1))
    with pytest.raises(MagicError, match="waypoint 'far'") as raised:
        arm.solve(Problem(*problem(waypoints=far)))
    assert raised.value.code in (Code.NO_IK, Code.JOINT_LIMIT)


def test_a_tool_out_of_reach_is_said(arm):
    strategy, tool, target, candidate, keep, motion = problem()
    away = dataclasses.replace(tool, world_from_object=transforms.make(translation=[-1.5, 0, 0.01]))
    with pytest.raises(MagicError, match="where it lies") as raised:
        arm.solve(Problem(strategy, away, target, candidate, keep, motion))
    assert raised.value.code == Code.NO_IK


def test_a_start_in_collision_names_the_pair(arm):
    block = scenes.item("block", [scenes.box([0.1, 0.1, 0.1])], transforms.make(translation=[0.3, 0, 0.5]))
    with pytest.raises(MagicError, match="panda_.* and block|block and panda_") as raised:
        arm.solve(Problem(*problem(), obstacles=[block]))
    assert raised.value.code == Code.START_IN_COLLISION


def test_a_start_beyond_the_limits_names_the_joint(arm):
    start = arm.robot.home.copy()
    start[3] = 0.5
    with pytest.raises(MagicError, match="panda_joint4") as raised:
        arm.solve(Problem(*problem(), start=start))
    assert raised.value.code == Code.JOINT_LIMIT
    with pytest.raises(MagicError) as raised:
        arm.solve(Problem(*problem(), start=np.zeros(3)))
    assert raised.value.code == Code.BAD_REQUEST


def test_an_obstacle_is_gone_around(arm):
    wall = scenes.item("wall", [scenes.box([0.15, 0.02, 0.25])], transforms.make(translation=[0.45, 0.14, 0.125]))
    plan = arm.solve(Problem(*problem(), obstacles=[wall]))
    assert plan.arm_motion.times[-1] > 5


def test_a_cage_about_the_target_is_a_collision_and_not_a_hang(arm):
    lid = scenes.item("lid", [scenes.box([0.5, 0.5, 0.02])], transforms.make(translation=[0.55, 0, 0.11]))
    with pytest.raises(MagicError) as raised:
        arm.solve(Problem(*problem(), obstacles=[lid]), budget=Budget(6.0))
    assert raised.value.code in (Code.NO_GRASP, Code.PATH_IN_COLLISION, Code.NO_PATH, Code.NO_IK, Code.JOINT_LIMIT, Code.PLANNING_TIMEOUT)


def test_cancel_and_deadline_stop_inside_the_stages(arm):
    asked = []

    def cancelled():
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(MagicError) as raised:
        arm.solve(Problem(*problem()), budget=Budget(10.0, cancelled))
    assert raised.value.code == Code.CANCELED
    with pytest.raises(MagicError, match="stage") as raised:
        arm.solve(Problem(*problem()), budget=Budget(0.02))
    assert raised.value.code == Code.PLANNING_TIMEOUT


def test_feedback_names_the_stages(arm):
    stages = []
    arm.solve(Problem(*problem()), feedback=lambda stage, message: stages.append(stage))
    assert stages[0] == "grasp" and set(stages) >= {"grasp", "task", "lift", "transfer", "approach", "timing"}


def test_a_retreat_out_of_reach_is_left_out(arm):
    strategy = scenes.pulling()
    waypoints = (*strategy.waypoints, Waypoint("up", np.array([-0.25, 0, -1.2]), "retreat", 0.3))
    given = problem(waypoints=waypoints)
    assert given[-1].phases[-1].name == "retreat"
    plan = arm.solve(Problem(*given))
    assert [p.name for p in plan.arm_motion.phases][-1] == "goal"


def test_a_free_motion_is_clear_as_it_is_timed_and_not_only_as_it_was_found(arm):
    """The spline through the corners of a path swings out; what it meets is looked for on the spline."""
    corner = np.zeros((3, 7))
    corner[1, 0], corner[2, :2] = 1.0, 1.0
    passed = timing.swept(corner, 0.02)
    assert np.abs(passed[:, 0] - np.clip(passed[:, 0], 0, 1)).max() < 0.01
    assert np.abs(np.diff(passed, axis=0)).max() < 0.025
    strategy, tool, target, candidate, reflection, motion = problem()
    post = scenes.item("post", [scenes.box([0.06, 0.06, 0.5])], transforms.make(translation=[0.45, 0.08, 0.25]))
    plan = arm.solve(Problem(strategy, tool, target, candidate, reflection, motion, obstacles=(post,)))
    held, fixed = Body("tool", tool.pieces), Body.from_object(post)
    carried = (plan.arm_motion.times > span(plan, "grasp").end) & (plan.arm_motion.times < span(plan, "transfer").end)
    gaps = []
    for pose in plan.tool_motion.world_from_tool[carried]:
        held.move(pose)
        gaps.append(held.touches(fixed))
    assert not any(gaps)


def test_the_empty_hand_keeps_room_about_what_it_passes(arm, monkeypatch):
    asked = []
    come = arm.free.come
    monkeypatch.setattr(arm.free, "come", lambda request, goal: asked.append((request, goal, come(request, goal))) or asked[-1][2])
    arm.solve(Problem(*problem()))
    request, goal, path = asked[-1]
    robot = arm.robot
    middle = robot.chain.forward(path[None, 0] + 0.5 * (path[None, -1] - path[None, 0]))[0, :3, 3]
    plate = scenes.box([0.04, 0.04, 0.01])

    def clear(path, height, room):
        robot.clear()
        robot.add("plate", shell(grown([plate], room) if room else [plate]), transforms.make(translation=[*middle[:2], height]))
        robot.open_to(robot.config.opening)
        return not any(robot.collides(q) for q in timing.swept(path, 0.01))

    # Some 2 mm below the hand.
    height = next(z for z in np.arange(middle[2], 0.0, -0.001) if clear(path, z, 0.0)) - 0.002
    assert not clear(path, height, 0.005)
    request = dataclasses.replace(
        request, obstacles=(scenes.item("plate", [plate], transforms.make(translation=[*middle[:2], height])),), roomy_searches=2
    )
    arm.space.build(request)
    assert clear(come(request, goal), height, 0.005)


@pytest.mark.parametrize("share, asked", [(1.0, [1]), (0.25, [1, 6]), (0.01, [1, LONGEST])])
def test_a_search_that_other_work_kept_from_the_processor_is_done_again_for_longer(arm, monkeypatch, share, asked):
    """``share``: of the clock's seconds that the search has the processor; ``asked``: what it is given, in times of what it may take."""
    seconds, worked = [], [0.0]

    class Library:
        def plan(self, start, goals, time, **kwargs):
            seconds.append(time)
            worked[0] += share * time
            return "Timeout", None

    monkeypatch.setattr(arm.robot.planner, "planner", Library())
    monkeypatch.setattr("magic_planner.free_motion.time.thread_time", lambda: worked[0])
    request = SimpleNamespace(budget=Budget(60.0))
    status, _ = arm.free._search(request, arm.robot.home, arm.robot.home, 1)
    assert status == "Timeout" and seconds == pytest.approx([arm.settings.free_time * times for times in asked])


def test_the_straight_way_to_a_grasp_begins_with_room_about_the_tool_where_it_can(arm, solved):
    (_, tool, *_), plan = solved
    robot = arm.robot
    tips = robot.chain.forward(plan.arm_motion.positions)[:, :3, 3]
    grasped = int(np.searchsorted(plan.arm_motion.times, plan.arm_motion.grasp_time))
    robot.clear()
    robot.add("tool", roomy_shell(tool.pieces, arm.settings.room), tool.world_from_object)
    robot.open_to(robot.config.opening)
    away = np.linalg.norm(tips[:grasped] - tips[grasped], axis=1) >= arm.settings.standoff - 1e-3
    assert away.any() and not any(robot.collides(q) for q in plan.arm_motion.positions[:grasped][away])


def test_a_carried_tool_keeps_room_about_it():
    box = scenes.box([0.1, 0.1, 0.1])
    (large,) = grown([box], 0.01)
    np.testing.assert_allclose(np.ptp(large.vertices, axis=0), 0.12)


def test_a_tool_that_is_carried_with_room_does_not_pass_through_the_table(arm, monkeypatch):
    asked = []
    carry = arm.free.carry
    monkeypatch.setattr(arm.free, "carry", lambda *given: asked.append(given) or carry(*given))
    strategy, tool, *rest = problem()
    arm.solve(Problem(strategy, tool, *rest))
    request, branch, q, _ = asked[-1]
    robot, space, room = arm.robot, arm.space, arm.settings.room
    pose = robot.chain.forward(q[None])[0] @ transforms.inverse(branch.grasp.tool_from_tcp)
    lowest = float(transforms.apply(pose, tool.mesh.vertices)[:, 2].min())

    def meets(above, *ends):
        """Whether the tool meets the table that it is so far above."""
        at = dataclasses.replace(request, plane=np.array([0.0, 0.0, 1.0, above - lowest]), obstacles=(), cloud={})
        space.build(at)
        space.hold_with_room(at, branch.grasp, room, ends)
        for table in ("table", DEEPER):
            robot.allow(table, *robot.planner.user_link_names)
        return robot.collides(q)

    assert not meets(0.005)
    assert meets(-2 * room)
    assert not meets(-2 * room, q)  # nothing is found between ends that meet it: it is left to the look without room
    space.hold(request, branch.grasp)
    assert not robot.world.has_object(DEEPER)


def test_a_plan_carries_its_margins_and_a_heavy_tool_is_refused_with_its_number(arm, solved):
    (_, tool, _, candidate, reflection, _), plan = solved
    found = {margin.name: margin for margin in plan.margins}
    assert set(found) == {"grip", "torque", "joint limit", "singularity"}
    assert all(0 < margin.left < 1 and 0 <= margin.time <= plan.arm_motion.times[-1] for margin in found.values())
    # The motion is slow: most of the torque is that of gravity.
    still = np.abs(arm.robot.chain.gravity_torques(plan.arm_motion.positions)) / arm.robot.chain.effort
    assert 1 - found["torque"].left == pytest.approx(still.max(), abs=0.1)
    slack = np.minimum(plan.arm_motion.positions - arm.robot.chain.lower, arm.robot.chain.upper - plan.arm_motion.positions)
    assert found["joint limit"].left == pytest.approx((slack / (arm.robot.chain.upper - arm.robot.chain.lower) * 2).min())
    contact = tool_contact_frame(candidate, reflection)
    shares = []
    for density in (600.0, 1200.0):
        heavier = Pace(arm.robot, dataclasses.replace(arm.grasping, density=density, force=0.0), tool, contact).with_margins(plan)
        shares.append(1 - next(m.left for m in heavier.margins if m.name == "grip"))
    assert shares[1] == pytest.approx(2 * shares[0], rel=1e-6)
    with pytest.raises(StageError) as caught:
        Pace(arm.robot, dataclasses.replace(arm.grasping, density=1.2 * 600.0 / shares[0], force=0.0), tool, contact).with_margins(plan)
    assert caught.value.error.code in (Code.NO_GRASP, Code.DYNAMIC_LIMIT) and "margin of grip: 120 %" in caught.value.error.message


def test_a_plan_is_slowed_from_when_the_tool_is_taken_until_it_is_let_go(solved):
    _, plan = solved
    slow = slowed(plan, 2.0)
    before, after = plan.arm_motion, slow.arm_motion
    taken = span(plan, "grasp").end
    first = before.times <= taken
    for field in ("times", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(after, field)[first], getattr(before, field)[first])
    np.testing.assert_allclose(after.times[-1] - taken, 2 * (before.times[-1] - taken))
    np.testing.assert_array_equal(after.positions, before.positions)
    np.testing.assert_allclose(after.velocities[~first], before.velocities[~first] / 2)
    np.testing.assert_allclose(after.accelerations[~first], before.accelerations[~first] / 4)
    middle = 0.5 * (after.velocities[1:] + after.velocities[:-1]) * np.diff(after.times)[:, None]
    assert np.abs(np.diff(after.positions, axis=0) - middle).max() < 2e-3
    assert (after.grasp_time, after.release_time) == (before.grasp_time, None)
    np.testing.assert_array_equal(slow.tool_motion.times, after.times)
    np.testing.assert_allclose(span(slow, "goal").start - taken, 2 * (span(plan, "goal").start - taken))
    let_go = dataclasses.replace(plan, arm_motion=dataclasses.replace(before, release_time=float(before.times[-50])))
    after = slowed(let_go, 2.0).arm_motion
    np.testing.assert_allclose(np.diff(after.times[-50:]), np.diff(before.times[-50:]))
    np.testing.assert_array_equal(after.velocities[-49:], before.velocities[-49:])
    assert after.release_time == pytest.approx(after.times[-50])


def test_a_tool_that_the_grip_would_lose_at_the_arms_speed_is_carried_slower(arm, solved):
    (_, tool, _, candidate, reflection, _), plan = solved
    contact = tool_contact_frame(candidate, reflection)
    plan = slowed(plan, 0.4)

    def grip(density, motion):
        found = Pace(arm.robot, dataclasses.replace(arm.grasping, density=density, force=0.0), tool, contact).margins(motion)
        return 1 - next(m.left for m in found if m.name == "grip")

    # As dense as leaves a fifth of the grip for what the tool's inertia asks, which is more at this speed.
    density = 600.0 * 0.8 / grip(600.0, slowed(plan, 100.0))
    assert grip(density, plan) > 1.05
    grasping = dataclasses.replace(arm.grasping, density=density, force=0.0)
    gentle = Pace(arm.robot, grasping, tool, contact).bearable(plan)
    least = min(gentle.margins, key=lambda margin: margin.left)
    assert least.name == "grip" and 0 <= least.left < 0.1
    assert gentle.arm_motion.times[-1] > plan.arm_motion.times[-1]
    np.testing.assert_array_equal(gentle.arm_motion.positions, plan.arm_motion.positions)
    with pytest.raises(StageError) as caught:  # what it cannot hold at rest it holds at no speed
        Pace(arm.robot, dataclasses.replace(grasping, density=1.5 * density), tool, contact).bearable(plan)
    assert "margin of grip" in caught.value.error.message


def test_a_tool_is_carried_no_faster_than_a_tool_may_go(arm, solved):
    (_, tool, _, candidate, reflection, _), plan = solved
    quick = slowed(plan, max(haste(plan.tool_motion)) / 1.5)
    assert max(haste(quick.tool_motion)) == pytest.approx(1.5)
    light = dataclasses.replace(arm.grasping, density=1.0, force=0.0)
    allowed = Pace(arm.robot, light, tool, tool_contact_frame(candidate, reflection)).bearable(quick)
    assert max(haste(allowed.tool_motion)) <= 1 + 1e-9


def test_how_the_empty_hand_comes_to_rest_is_no_load_on_the_grip(arm, solved):
    (_, tool, _, candidate, reflection, _), plan = solved
    motion, contact = plan.arm_motion, tool_contact_frame(candidate, reflection)
    given = arm.robot, arm.grasping, tool, motion.tool_from_tcp, contact
    rest = motion.positions, (motion.grasp_time, np.inf), plan.tool_motion.phases
    # The same approach, five times as fast: only what comes before the grasp differs.
    before = motion.times < motion.grasp_time
    times = np.where(before, motion.grasp_time - (motion.grasp_time - motion.times) / 5, motion.times)
    usual, rushed = (next(m for m in margins(*given, t, *rest) if m.name == "grip") for t in (motion.times, times))
    assert rushed.left == pytest.approx(usual.left, abs=1e-9)


def test_grasps_that_cannot_hold_the_tool_at_rest_are_not_planned_with(arm):
    strategy, *rest = problem()
    heavy = dataclasses.replace(strategy, physics=dataclasses.replace(strategy.physics, tool_density=60000.0))
    heard = []
    with pytest.raises(MagicError) as caught:
        arm.solve(Problem(heavy, *rest), feedback=lambda stage, message: heard.append(stage))
    assert caught.value.code == Code.NO_GRASP and "at rest" in caught.value.message and "margin of grip" in caught.value.message
    assert set(heard) == {"grasp"}


@pytest.mark.parametrize("there", [2, 5])
def test_where_one_way_to_follow_the_task_meets_something_the_next_is_looked_at_first(there):
    """Be it before or after the target is met."""
    asked = []

    def collides(q):
        asked.append(int(q[0]))
        return asked[-1] == there

    space = SimpleNamespace(
        robot=SimpleNamespace(collides=collides), empty=lambda request: None, ignore_target=lambda request, ignored: None
    )
    orders = [(False, [0, 2, 1, 3]), (True, [4, 6, 5, 7])]
    task, branch = TaskPath(space, ArmSettings()), SimpleNamespace(path=np.arange(8.0)[:, None])
    assert task._met_key(None, branch, orders) == there
    asked.clear()
    assert task._met_key(None, branch, orders) == there
    assert asked == [there]
    assert sorted(key for _, order in orders for key in order) == list(range(8))


def in_hand(solved, arm, after, shift=(0.0, 0.0, 0.0)):
    """The problem of ``solved`` with the tool in the hand, at some seconds of that plan, and off by ``shift`` in the hand, m."""
    (strategy, tool, target, candidate, keep, _), plan = solved
    row = int(np.searchsorted(plan.arm_motion.times, after))
    start = plan.arm_motion.positions[row]
    held = plan.arm_motion.tool_from_tcp @ transforms.make(translation=shift)
    pose = arm.robot.chain.forward(start[None])[0] @ transforms.inverse(held)
    tool = dataclasses.replace(tool, world_from_object=pose, hanging=True)
    return (strategy, tool, target, candidate, keep, plan_tool_motion(strategy, tool, target, candidate)), start, held


@pytest.mark.parametrize("where", ["grasped", "in the air"])
def test_a_tool_in_the_hand_is_carried_on_as_it_is_held(arm, solved, where):
    plan = solved[1]
    after = plan.arm_motion.grasp_time if where == "grasped" else span(plan, "transfer").end
    given, start, held = in_hand(solved, arm, after, (0.0, 0.0, 0.004))
    again = arm.solve(Problem(*given, start=start))
    motion = again.arm_motion
    assert motion.grasp_time == 0
    np.testing.assert_allclose(motion.positions[0], start)
    np.testing.assert_allclose(motion.tool_from_tcp, held, atol=1e-9)
    np.testing.assert_allclose(again.tool_motion.world_from_tool[0], given[1].world_from_object, atol=1e-6)
    # It was off in the hand, and yet it does what it is to do.
    np.testing.assert_allclose(again.tool_motion.world_from_tool[-1], given[-1].world_from_tool[-1], atol=1e-3)
    assert motion.grasp_width == pytest.approx(plan.arm_motion.grasp_width, abs=1e-3)
    lifted = again.tool_motion.world_from_tool[:, 2, 3].max() - given[1].world_from_object[2, 3]
    assert where != "grasped" or lifted > 0.02
    with pytest.raises(MagicError, match="0 to 0") as raised:
        arm.solve(Problem(*given, start=start, attempt=1))
    assert raised.value.code == Code.NO_GRASP


def test_a_tool_that_hangs_elsewhere_is_not_in_the_hand(arm, solved):
    given, start, _ = in_hand(solved, arm, solved[1].arm_motion.times[-1], (0.0, 0.0, 0.15))
    with pytest.raises(MagicError, match="nothing of it") as raised:
        arm.solve(Problem(*given, start=start))
    assert raised.value.code == Code.BAD_REQUEST
    with pytest.raises(MagicError, match="where the arm is"):
        arm.solve(Problem(*given))


def test_a_refusal_says_by_how_much_the_tool_has_to_be_tipped(arm, monkeypatch):
    given = problem()
    tool, motion = given[1], given[5]
    attitude = motion.world_from_tool[0][:3, :3]

    def refuse(*_):
        raise MagicError(Code.NO_GRASP, "stage grasp: faces", 0, "two that fit")

    monkeypatch.setattr(arm, "_solved", refuse)
    upright = dataclasses.replace(tool, world_from_object=transforms.make(attitude, tool.world_from_object[:3, 3]))
    lying = dataclasses.replace(tool, world_from_object=transforms.from_rpy(np.pi / 2, 0, 0) @ upright.world_from_object)
    for item, tipped in ((upright, False), (lying, True)):
        with pytest.raises(MagicError) as caught:
            arm.solve(Problem(given[0], item, *given[2:]))
        assert caught.value.code is Code.NO_GRASP and "two that fit" in caught.value.message
        assert ("tipped by 90 degrees" in caught.value.message) == tipped
