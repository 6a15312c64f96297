"""Arm and gripper move only where that is wanted, for a verified plan, and while the arm is where the plan believes it."""

import math
import threading
import time
from dataclasses import replace
from functools import partial

import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionServer, GoalResponse
from rclpy.node import Node
from std_srvs.srv import Trigger

from magic_core import conversions
from magic_core.errors import Code, MagicError
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_server.execution import Fingers, Look, Move, check_grasp, controller_error, steps
from magic_server.testing import fakes
from magic_server.testing.bench import Bench

TIMES = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
SPEEDS = ((0.0,), (0.1,), (0.0,), (0.0,), (0.1,), (0.0,), (0.0,))
PLAN = {"times": TIMES, "velocities": SPEEDS, "grasp_time": 1.0, "release_time": math.nan, "grasp_width": 0.03, "opening": 0.08}


def test_fingers_open_first_and_close_at_the_tool():
    assert steps(**PLAN) == (Fingers(False, 0.08), Move(0, 2), Fingers(True, 0.03), Move(2, 6))
    assert steps(**{**PLAN, "release_time": 2.5}) == (
        Fingers(False, 0.08),
        Move(0, 2),
        Fingers(True, 0.03),
        Move(2, 5),
        Fingers(False, 0.08),
        Move(5, 6),
    )
    assert steps(**{**PLAN, "release_time": 3.0})[-1] == Fingers(False, 0.08)  # nothing is left to move
    assert steps(**{**PLAN, "grasp_time": 0.0})[:2] == (Fingers(False, 0.08), Fingers(True, 0.03))


def test_the_tool_is_looked_at_where_the_arm_stands_after_it_has_moved_it():
    times = (*TIMES[:4], 1.7, 1.9, 2.0, 2.5, 3.0)
    speeds = (*SPEEDS[:4], (0.1,), (0.0,), (0.1,), (0.0,), (0.0,))
    lifting = {**PLAN, "times": times, "velocities": speeds}
    assert steps(**lifting, look=True)[2:] == (Fingers(True, 0.03), Move(2, 5), Look(5), Move(5, 8))
    assert steps(**lifting)[2:] == (Fingers(True, 0.03), Move(2, 8))
    released = steps(**{**lifting, "release_time": 2.5}, look=True)
    assert released[2:] == (Fingers(True, 0.03), Move(2, 5), Look(5), Move(5, 7), Fingers(False, 0.08), Move(7, 8))
    # Where it does not stand before the end of the task there is nothing to look at.
    assert steps(**PLAN, look=True) == (*steps(**PLAN)[:3], Move(2, 5), Look(5), Move(5, 6))
    assert steps(**{**PLAN, "release_time": 2.5}, look=True) == steps(**{**PLAN, "release_time": 2.5})


def test_what_is_in_the_hand_is_not_let_go_before_the_release():
    held = {**PLAN, "grasp_time": 0.0}
    assert steps(**held, holding=True) == (Move(0, 6),)
    assert steps(**{**held, "release_time": 2.5}, holding=True) == (Move(0, 5), Fingers(False, 0.08), Move(5, 6))
    assert steps(**held, holding=True, look=True) == (Move(0, 2), Look(2), Move(2, 6))
    with pytest.raises(MagicError, match="grasp_time of a tool that is in the hand"):
        steps(**PLAN, holding=True)


@pytest.mark.parametrize(
    "change, says",
    [
        ({"grasp_time": 0.5}, "speed of the arm in rad/s at 0.500 s"),
        ({"release_time": 2.0}, "speed of the arm in rad/s at 2.000 s"),
        ({"velocities": (*SPEEDS[:-1], (0.1,))}, "at 3.000 s"),
        ({"velocities": ((math.nan,), *SPEEDS[1:])}, "at 0.000 s"),
        ({"grasp_time": 3.5}, "grasp_time: 3.5"),
        ({"grasp_time": math.nan}, "grasp_time: nan"),
        ({"release_time": 1.0}, "release_time: 1.0"),
        ({"grasp_width": 0.09}, "grasp_width in m: 0.09"),
        ({"grasp_width": -0.01}, "grasp_width in m: -0.01"),
        ({"times": (0.0, 0.5, 0.5, 1.5, 2.0, 2.5, 3.0)}, "rising times"),
        ({"times": (0.0,)}, "1 points"),
    ],
)
def test_plans_that_cannot_be_carried_out(change, says):
    with pytest.raises(MagicError) as caught:
        steps(**{**PLAN, **change})
    assert caught.value.code == Code.BAD_MOTION
    assert says in caught.value.message


@pytest.mark.parametrize(
    "found, says", [(0.0, "closed on nothing"), (0.019, "closed on nothing"), (0.05, "did not close"), (math.nan, "nan")]
)
def test_what_is_between_the_fingers(found, says):
    check_grasp(0.03, 0.025, 0.01)
    check_grasp(0.03, 0.008, 0.01, looked=True)
    for never in (0.001, 0.045):
        with pytest.raises(MagicError, match="GRASP_FAILED"):
            check_grasp(0.03, never, 0.01, looked=True)
    with pytest.raises(MagicError) as caught:
        check_grasp(0.03, found, 0.01)
    assert caught.value.code == Code.GRASP_FAILED
    assert says in caught.value.message


def test_each_code_of_a_trajectory_controller_is_told_by_its_name():
    """Against the constants of the installed FollowJointTrajectory."""
    result = FollowJointTrajectory.Result
    for name in ("INVALID_GOAL", "INVALID_JOINTS", "OLD_HEADER_TIMESTAMP", "PATH_TOLERANCE_VIOLATED", "GOAL_TOLERANCE_VIOLATED"):
        error = controller_error(getattr(result, name), GoalStatus.STATUS_ABORTED, "because")
        assert error.code == Code.EXECUTION_FAILED
        assert f"({name}: " in error.message
        assert error.message.endswith(": because")
    assert "SUCCESSFUL" in controller_error(result.SUCCESSFUL, GoalStatus.STATUS_CANCELED, "").message
    assert "an error of its own" in controller_error(-77, GoalStatus.STATUS_ABORTED, "").message


ACTIONS = {"autostart": True, "trajectory_action": "arm/follow_joint_trajectory", "gripper_action": "gripper/gripper_action"}
OPEN = fakes.OPEN_LOOP  # closed: test_closed_loop.py


@pytest.fixture(scope="module")
def shared(folder):
    """A server that may move an arm, and the arm."""
    bench = Bench(folder, execute=True, state_age=10.0, objects_age=2.0, objects_timeout=0.5, speed=0.5, **ACTIONS, **OPEN)
    bench.arm = fakes.FakeArm(context=bench.context)
    bench.executor.add_node(bench.arm)
    bench.until(lambda: not bench.server._arm.ready())
    yield bench
    bench.close()
    bench.arm.destroy_node()


@pytest.fixture
def bench(shared):
    """The arm at its start, telling so."""
    arm = shared.arm
    shared.fakes.clear()
    shared.feedback.clear()
    arm.log.clear()
    arm.goals.clear()
    arm.moving.clear()
    arm.positions, arm.thickness, arm.opening, arm.tells, arm.squeezes, arm.late = [0.0] * 7, 0.03, 0.08, True, False, 0.0
    arm.velocity, arm.apart = 0.0, False
    if not shared.server._active or shared.server._stopped:
        shared.server.trigger_deactivate()
        shared.server.trigger_activate()
    arm.on_move = lambda trajectory, canceled: (0, "")
    sees(shared, fakes.scene())
    believes(shared, [0.0] * 7)
    return shared


def sees(bench, scene):
    """Wait until the server has heard what is on the table, just now."""
    begin = time.monotonic()
    bench.fakes.publish(scene)
    bench.until(lambda: bench.server.scene_came > begin)


def believes(bench, positions):
    """Wait until the server has heard where the arm is, just now."""
    begin = time.monotonic()

    def heard():
        joints = bench.server.joints.all()
        return all(
            name in joints and joints[name].came > begin and joints[name].position == pytest.approx(position, nan_ok=True)
            for name, position in zip(fakes.JOINTS, positions)
        )

    bench.until(heard)


def told(bench):
    """What the arm was told, in short."""
    return [entry if isinstance(entry, tuple) else "move" for entry in bench.arm.log]


def test_arm_and_gripper_carry_a_verified_plan_out(bench):
    result, status = bench.run(variant="arm")
    assert (result.code, result.verified, result.executed) == (0, True, True), result.message
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert "carried out by the arm" in result.message
    assert told(bench) == [("open", 0.04, 60.0), "move", ("close", 0.015, 60.0), "move"]
    there, task = (entry for entry in bench.arm.log if not isinstance(entry, tuple))
    assert tuple(there.joint_names) == fakes.JOINTS
    assert (there.header.stamp.sec, there.header.stamp.nanosec) == (0, 0)  # begin at once
    # At half the planned speed: twice the time, half the velocity; each move begins at 0 s.
    assert [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in there.points] == pytest.approx([0.0, 1.0, 2.0])
    assert [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in task.points] == pytest.approx(
        [0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0]
    )
    assert list(there.points[1].velocities) == pytest.approx([0.05] * 7)
    assert list(task.points[0].positions) == list(there.points[-1].positions)
    for goal in bench.arm.goals:
        for tolerances, allowed in ((goal.path_tolerance, 0.1), (goal.goal_tolerance, 0.01)):
            assert [(t.name, t.position, t.velocity, t.acceleration) for t in tolerances] == [(n, allowed, 0.0, 0.0) for n in fakes.JOINTS]
        assert (goal.goal_time_tolerance.sec, goal.goal_time_tolerance.nanosec) == (1, 0)
    assert {f.stage for f in bench.feedback} >= {"plan", "verify", "execute"}
    assert any("step 3 of 4: the fingers close" in f.message for f in bench.feedback)


def test_a_release_opens_the_fingers(bench):
    bench.fakes.on_plan = lambda goal, canceled: PlanMotion.Result(
        plan=conversions.plan_to_msg(fakes.plan("arm", release=True), goal.tool.id)
    )
    result, _ = bench.run(variant="arm")
    assert result.executed, result.message
    assert told(bench) == [("open", 0.04, 60.0), "move", ("close", 0.015, 60.0), "move", ("open", 0.04, 60.0), "move"]


def refused(bench, code, published=True):
    """The message of a run that physics has passed and that was not carried out; ``published``: it got as far as that."""
    result, status = bench.run(variant="arm")
    assert (result.code, result.verified, result.executed) == (code, published, False), result.message
    assert status == GoalStatus.STATUS_ABORTED
    assert ("but not carried out" if published else "but not published") in result.message
    assert bench.server.publication.standing is None
    return result.message


@pytest.mark.parametrize(
    "change, code, says",
    [
        ({"late": 15.0}, Code.STALE_DATA, "age of joint_states"),
        ({"positions": [0.0] * 6 + [0.5]}, Code.BAD_MOTION, "0.5000 at panda_joint7"),
    ],
    ids=["old", "elsewhere"],
)
def test_an_arm_that_is_not_known_to_stand_at_the_start_is_not_moved(bench, change, code, says):
    for name, value in change.items():
        setattr(bench.arm, name, value)
    believes(bench, bench.arm.positions)
    assert says in refused(bench, code, published=False)
    assert not bench.arm.log


def test_an_arm_that_has_fallen_silent_is_not_moved(bench):
    bench.arm.tells = False
    joints = bench.server.joints
    bench.until(lambda: joints.all()["panda_joint1"].came < time.monotonic() - 0.1)  # what was on its way has come
    joints._joints = {name: replace(joint, came=joint.came - 15.0) for name, joint in joints.all().items()}
    assert "age of joint_states" in refused(bench, Code.STALE_DATA, published=False)
    assert not bench.arm.log


def test_an_arm_that_moves_is_not_given_a_trajectory(bench):
    bench.arm.velocity = 0.3
    bench.until(lambda: bench.server.joints.all()["panda_joint7"].velocity == 0.3)
    assert "speed of the arm in rad/s where a move begins: '0.300 at panda_joint1'" in refused(bench, Code.BAD_MOTION, published=False)
    assert not bench.arm.log


def test_arm_and_gripper_may_speak_of_their_joints_apart(bench):
    bench.arm.apart = True
    result, _ = bench.run(variant="arm")
    assert result.executed, result.message


def moved(by):
    first, second = fakes.scene().objects
    pose = first.world_from_object.copy()
    pose[0, 3] += by
    return replace(fakes.scene(), objects=(replace(first, world_from_object=pose), second))


@pytest.mark.parametrize(
    "now, says, code",
    [
        (moved(0.03), "object_1 has moved since the plan, in mm: 29.9", Code.OK),
        (fakes.scene(("object_1",)), "objects gone since the plan: 'object_2'", Code.NO_OBJECTS),
        (fakes.scene(("object_1", "object_2", "object_3")), "objects come since the plan: 'object_3'", Code.OK),
    ],
    ids=["moved", "gone", "come"],
)
def test_the_arm_is_moved_among_the_objects_alone_that_were_planned_for(bench, now, says, code):
    moves = []

    def verify(goal, canceled):
        moves.append(len(bench.arm.log))
        sees(bench, now)
        return fakes.FakeServers.verify(goal, canceled)

    bench.fakes.on_verify = verify
    result, _ = bench.run(variant="arm")
    assert (result.code, result.executed) == (code, code == Code.OK), result.message
    assert says in result.notes[0]
    # It stands until a motion is verified for what is there.
    assert moves == [0] * (1 + result.executed) and bool(bench.arm.log) == result.executed


def test_objects_that_stay_within_the_tolerance_are_the_same(bench):
    def verify(goal, canceled):
        sees(bench, moved(0.005))
        return fakes.FakeServers.verify(goal, canceled)

    bench.fakes.on_verify = verify
    result, _ = bench.run(variant="arm")
    assert result.executed, result.message


@pytest.mark.parametrize("how", ["came", "stamp"])
def test_the_arm_is_not_moved_among_objects_that_nobody_has_seen_lately(bench, how):
    def verify(goal, canceled):
        if how == "came":
            bench.server.scene_came -= 10.0
        else:
            bench.server.scene.header.stamp.sec -= 10
        return fakes.FakeServers.verify(goal, canceled)

    bench.fakes.on_verify = verify
    assert "age of the objects in s, by " in refused(bench, Code.STALE_DATA, published=False)
    assert not bench.arm.log


def test_objects_that_are_seen_again_are_waited_for(bench):
    def verify(goal, canceled):
        bench.server.scene_came -= 10.0
        threading.Timer(0.2, bench.fakes.publish, [fakes.scene()]).start()
        return fakes.FakeServers.verify(goal, canceled)

    bench.fakes.on_verify = verify
    result, _ = bench.run(variant="arm")
    assert result.executed, result.message


def test_fingers_that_close_on_nothing_end_it(bench):
    bench.arm.thickness, bench.arm.squeezes = 0.0, True
    assert "closed on nothing" in refused(bench, Code.GRASP_FAILED)
    assert told(bench)[-1][0] == "close"
    assert told(bench).count("move") == 1


def test_fingers_that_meet_something_thicker_end_it(bench):
    bench.arm.thickness = 0.05
    assert "did not close on the tool as planned: opening in mm: 50.0" in refused(bench, Code.GRASP_FAILED)
    assert told(bench).count("move") == 1


def test_a_controller_that_gives_up_ends_it(bench):
    bench.arm.on_move = lambda trajectory, canceled: (-4, "joint 3 lags")
    message = refused(bench, Code.EXECUTION_FAILED)
    assert "error -4 (PATH_TOLERANCE_VIOLATED" in message
    assert "joint 3 lags" in message
    assert told(bench) == [("open", 0.04, 60.0), "move"]


def test_an_arm_that_did_not_arrive_goes_no_further(bench):
    bench.arm.on_move = lambda trajectory, canceled: (setattr(trajectory.points[-1], "positions", [0.05] * 7), (0, ""))[1]
    assert "distance of the arm" in refused(bench, Code.BAD_MOTION)
    assert told(bench).count("move") == 1


def test_a_cancel_stops_the_arm(bench):
    stopped = []

    def move(trajectory, canceled):
        deadline = time.monotonic() + 10.0
        while not canceled() and time.monotonic() < deadline:
            time.sleep(0.002)
        stopped.append(canceled())
        return 0, ""

    bench.arm.on_move = move
    handle = bench.send(variant="arm")
    assert bench.arm.moving.wait(10.0)
    bench.result(handle.cancel_goal_async())
    response = bench.result(handle.get_result_async())
    assert (response.result.code, response.status) == (Code.CANCELED, GoalStatus.STATUS_CANCELED)
    assert (response.result.verified, response.result.executed) == (False, False)
    assert stopped == [True]
    assert told(bench) == [("open", 0.04, 60.0), "move"]


def test_an_emergency_stop_stops_the_arm_and_lasts_until_the_server_is_activated_again(bench):
    answers = []

    def move(trajectory, canceled):
        stop = bench.arm.create_client(Trigger, "/strategy_server/emergency_stop")
        assert stop.wait_for_service(timeout_sec=10.0)
        asked = stop.call_async(Trigger.Request())
        deadline = time.monotonic() + 10.0
        while not (canceled() and asked.done()) and time.monotonic() < deadline:
            time.sleep(0.01)
        answers.append(asked.result())
        return 0, ""

    bench.arm.on_move = move
    result, _ = bench.run(variant="arm")
    assert (result.code, result.verified, result.executed) == (Code.CANCELED, False, False), result.message
    assert "an emergency stop was asked for" in result.message
    assert answers[0].success and "the arm was moving" in answers[0].message
    assert told(bench) == [("open", 0.04, 60.0), "move"]
    # Nothing is published, and nothing moves.
    bench.arm.on_move = lambda trajectory, canceled: (0, "")
    sees(bench, fakes.scene())
    for variant in ("fg", "arm"):
        result, _ = bench.run(variant=variant)
        assert (result.code, result.verified, result.executed) == (Code.CANCELED, False, False)
        assert "an emergency stop was asked for" in result.message
    assert told(bench).count("move") == 1
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
        change(bench, transition)
    sees(bench, fakes.scene())
    believes(bench, [0.0] * 7)
    assert bench.run(variant="arm")[0].executed


def change(bench, transition):
    """As ``ros2 lifecycle set`` does."""
    client = bench.arm.create_client(ChangeState, "/strategy_server/change_state")
    assert client.wait_for_service(timeout_sec=10.0)
    asked = client.call_async(ChangeState.Request(transition=Transition(id=transition)))
    bench.until(asked.done)
    assert asked.result().success


def test_nothing_moves_before_the_server_is_activated(folder):
    bench = Bench(folder, execute=True, state_age=10.0, objects_age=10.0, **{**ACTIONS, "autostart": False}, **OPEN)
    bench.arm = fakes.FakeArm(context=bench.context)
    bench.executor.add_node(bench.arm)
    try:
        bench.until(lambda: not bench.server._arm.ready())
        believes(bench, [0.0] * 7)
        for transition in (None, Transition.TRANSITION_CONFIGURE):
            if transition is not None:
                change(bench, transition)
            sees(bench, fakes.scene())
            result, _ = bench.run(variant="arm")
            assert (result.code, result.verified, result.executed) == (Code.SERVER_UNAVAILABLE, True, False), result.message
            assert "lifecycle is not active" in result.message
        assert told(bench) == []
        change(bench, Transition.TRANSITION_ACTIVATE)
        sees(bench, fakes.scene())
        assert bench.run(variant="arm")[0].executed
        # Leaving the state stops what is under way.
        bench.arm.positions = [0.0] * 7
        believes(bench, [0.0] * 7)

        def move(trajectory, canceled):
            change(bench, Transition.TRANSITION_DEACTIVATE)
            deadline = time.monotonic() + 10.0
            while not canceled() and time.monotonic() < deadline:
                time.sleep(0.01)
            return 0, ""

        bench.arm.on_move = move
        sees(bench, fakes.scene())
        result, _ = bench.run(variant="arm")
        assert (result.code, result.executed) == (Code.CANCELED, False)
    finally:
        bench.close()
        bench.arm.destroy_node()


def test_a_cancel_between_two_steps_sends_nothing_more(bench, monkeypatch):
    sent = []
    fingers = bench.server._arm._fingers

    def canceled_afterwards(action, token, looked):
        fingers(action, token, looked)
        token.cancel()

    monkeypatch.setattr(bench.server._arm, "_fingers", canceled_afterwards)
    bench.arm._servers[0].register_goal_callback(lambda goal: sent.append(goal) or GoalResponse.ACCEPT)
    try:
        result, _ = bench.run(variant="arm")
        assert (result.code, result.executed) == (Code.CANCELED, False), result.message
        assert told(bench) == [("open", 0.04, 60.0)]
        monkeypatch.undo()
        sees(bench, fakes.scene())
        assert bench.run(variant="arm")[0].executed  # what the first run had sent would have come before this
        assert len(sent) == 2
    finally:
        bench.arm._servers[0].register_goal_callback(bench.arm._admit)


def test_a_controller_that_does_not_stop_is_named(bench):
    over = threading.Event()

    def move(trajectory, canceled):
        over.wait(10.0)
        return 0, ""

    bench.arm.on_move = move
    try:
        handle = bench.send(variant="arm")
        assert bench.arm.moving.wait(10.0)
        bench.result(handle.cancel_goal_async())
        message = bench.result(handle.get_result_async()).result.message
    finally:
        over.set()
    assert "the arm's controller did not say that its goal has ended" in message


def test_a_controller_that_refuses_a_trajectory_has_failed(bench):
    bench.arm._servers[0].register_goal_callback(lambda goal: GoalResponse.REJECT)
    try:
        assert "refused the goal" in refused(bench, Code.EXECUTION_FAILED)
    finally:
        bench.arm._servers[0].register_goal_callback(bench.arm._admit)


@pytest.mark.parametrize(
    "kind, name, says",
    [
        (FollowJointTrajectory, "arm/follow_joint_trajectory", "/arm/follow_joint_trajectory"),
        (RunStrategy, "run_strategy", "strategy server"),
    ],
    ids=["controller", "strategy server"],
)
def test_two_that_would_move_one_arm_do_not(bench, kind, name, says):
    other = Node("other", context=bench.context)  # nobody spins it, so that it answers nothing
    second = ActionServer(other, kind, name, lambda handle: kind.Result())
    count = partial(bench.server.count_services, f"/{name}/_action/send_goal")
    try:
        bench.until(lambda: count() == 2)
        result, _ = bench.run(variant="arm")
        assert (result.code, result.executed) == (Code.NOT_ALONE, False)
        assert f"servers of {says}: 2" in result.message
        assert not bench.arm.log
    finally:
        second.destroy()
        other.destroy_node()
        bench.until(lambda: count() == 1)


def test_what_is_not_verified_or_not_for_the_arm_moves_nothing(bench):
    bench.fakes.on_verify = lambda goal, canceled: VerifyMotion.Result(code=int(Code.DRIFT), message="it drifted")
    result, _ = bench.run(variant="arm")
    assert (result.verified, result.executed) == (False, False)
    bench.fakes.clear()
    result, _ = bench.run(strategy="dynamic", variant="arm", allow_unverified=True)
    assert (result.code, result.verified, result.executed) == (0, False, False)
    sees(bench, fakes.scene())
    result, _ = bench.run(variant="fg")
    assert (result.code, result.verified, result.executed) == (0, True, False)
    assert not bench.arm.log


@pytest.mark.parametrize("allow", [True, False])
def test_what_simulation_cannot_judge_moves_the_arm_only_if_goal_and_server_say_so(folder, allow):
    """The server's half of it is missing in the test above."""
    bench = Bench(folder, execute=True, execute_unverified=True, state_age=10.0, objects_age=10.0, **ACTIONS, **OPEN)
    arm = fakes.FakeArm(context=bench.context)
    try:
        bench.executor.add_node(arm)
        bench.until(lambda: not bench.server._arm.ready())
        sees(bench, fakes.scene())
        believes(bench, [0.0] * 7)
        result, _ = bench.run(strategy="dynamic", variant="arm", allow_unverified=allow)
        assert (result.code, result.verified, result.executed) == (0 if allow else Code.NOT_VERIFIABLE, False, allow), result.message
        assert bool(arm.log) == allow
        # A verified run proves that the channel works and that nothing came before it.
        assert bench.run(variant="fg")[0].verified
        bench.wait(lambda: bench.messages["tool"])
        assert not bench.messages["arm"]
    finally:
        bench.close()
        arm.destroy_node()


def test_without_a_gripper_nothing_moves(folder):
    bench = Bench(
        folder, execute=True, trajectory_action="arm/follow_joint_trajectory", gripper_action="nowhere", server_timeout=0.5, **OPEN
    )
    arm = fakes.FakeArm(context=bench.context)
    try:
        bench.executor.add_node(arm)
        bench.fakes.publish(fakes.scene())
        result, _ = bench.run(variant="arm")
        assert result.code == Code.SERVER_UNAVAILABLE
        assert "/nowhere" in result.message
        assert (result.verified, result.executed) == (True, False)
        assert not arm.log
    finally:
        bench.close()
        arm.destroy_node()


def test_by_default_nobody_can_be_moved(folder):
    bench = Bench(folder)
    try:
        assert bench.server._arm is None
        assert not [name for name, _ in bench.server.get_service_names_and_types() if "follow_joint" in name or "gripper" in name]
    finally:
        bench.close()
