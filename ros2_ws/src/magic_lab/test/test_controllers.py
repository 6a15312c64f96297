"""Controllers against what ros2_controllers document, on a joint that is where it is told to be, or is not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_lab.controllers import Error, GripperController, Point, RefusedError, Tolerance, Trajectory, TrajectoryController

NAMES = ("a", "b")
ZERO = np.zeros(2)


def controller(**more):
    return TrajectoryController(NAMES, ZERO, Tolerance(0.1, 0.02, 0.05), **more)


def follow(control, until, lag=lambda q: q, start=0.0, dt=0.01):
    """Step a controller over an arm whose state is a function of what is commanded; the last state."""
    q, qd, now = ZERO.copy(), ZERO.copy(), start
    while now < until:
        wanted, speed = control.update(now, q, qd)
        q, qd = np.asarray(lag(wanted), dtype=float), np.asarray(speed)
        now += dt
    return q


finite = st.floats(-2, 2)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(finite, finite, finite), min_size=2, max_size=5), st.floats(0.1, 3))
def test_interpolation_passes_through_its_points_with_their_velocities(rows, step):
    points = [Point(k * step, [p, -p], [v, 2 * v], [a, a]) for k, (p, v, a) in enumerate(rows)]
    way = Trajectory(points, ZERO, ZERO)
    for k, (p, v, _) in enumerate(rows[:-1]):
        q, qd = way.sample(k * step)
        np.testing.assert_allclose((q, qd), ([p, -p], [v, 2 * v]), atol=1e-9)
        # From the left as well, and the velocity is the positions' slope.
        q, qd = way.sample((k + 1) * step - 1e-9)
        np.testing.assert_allclose(q, [rows[k + 1][0], -rows[k + 1][0]], atol=1e-6)
        middle, h = (k + 0.4) * step, 1e-6
        slope = (way.sample(middle + h)[0] - way.sample(middle - h)[0]) / (2 * h)
        np.testing.assert_allclose(slope, way.sample(middle)[1], rtol=1e-4, atol=1e-4)


def test_positions_alone_are_joined_by_lines_and_velocities_by_cubics():
    assert Trajectory([Point(2, [1, 2])], ZERO, ZERO).sample(0.5)[0].tolist() == [0.25, 0.5]
    cubic = Trajectory([Point(1, [1, 1], [0, 0])], ZERO, ZERO)
    assert cubic.sample(0.5)[0] == pytest.approx([0.5, 0.5])
    assert cubic.sample(0.25)[0] == pytest.approx([3 / 16 - 2 / 64] * 2)


def test_an_arm_that_follows_reaches_its_goal_and_holds_it():
    control = controller()
    goal = control.begin(("b", "a"), [Point(1.0, [0.4, 0.2], [0, 0])], 0.0)
    q = follow(control, 1.5)
    assert (goal.code, goal.canceled, goal.done.is_set(), control.goal) == (Error.SUCCESSFUL, False, True, None)
    assert q == pytest.approx([0.2, 0.4]), "names decide, not their order"
    assert control.update(9.0, q, ZERO)[0] == pytest.approx([0.2, 0.4])


@pytest.mark.parametrize(
    "names, points, stamp, code",
    [
        (NAMES, [], 0, Error.INVALID_GOAL),
        (("a",), [Point(1, [0])], 0, Error.INVALID_JOINTS),
        (("a", "c"), [Point(1, [0, 0])], 0, Error.INVALID_JOINTS),
        (("a", "a"), [Point(1, [0, 0])], 0, Error.INVALID_JOINTS),
        (NAMES, [Point(1, [0, 0]), Point(1, [1, 1])], 0, Error.INVALID_GOAL),
        (NAMES, [Point(1, [0])], 0, Error.INVALID_GOAL),
        (NAMES, [Point(1, [0, 0], [0])], 0, Error.INVALID_GOAL),
        (NAMES, [Point(1, [0, float("nan")])], 0, Error.INVALID_GOAL),
        (NAMES, [Point(1, [0, 0], [0, 0.1])], 0, Error.INVALID_GOAL),
        (NAMES, [Point(1, [0, 0])], 5, Error.OLD_HEADER_TIMESTAMP),
    ],
)
def test_what_is_no_goal_is_refused_and_leaves_the_one_at_work(names, points, stamp, code):
    control = controller()
    at_work = control.begin(NAMES, [Point(100, [0.1, 0.1])], 0.0)
    with pytest.raises(RefusedError) as refused:
        control.begin(names, points, 7.0, stamp)
    assert refused.value.code == code
    assert control.goal is at_work and not at_work.done.is_set()


def test_a_joint_that_stays_behind_aborts_on_the_way_and_the_arm_holds_where_it_is():
    control = controller()
    goal = control.begin(NAMES, [Point(1.0, [1, 0], [0, 0])], 0.0)
    stuck = follow(control, 1.0, lambda q: np.minimum(q, 0.3))
    assert goal.code == Error.PATH_TOLERANCE_VIOLATED and "a is off by 0.1" in goal.reason
    assert stuck[0] <= 0.41 and control.update(2.0, stuck, ZERO)[0] == pytest.approx(stuck)


def test_tolerances_of_the_goal_come_before_the_controllers():
    for given_path, code in (({"a": -1.0}, Error.GOAL_TOLERANCE_VIOLATED), ({"a": 0.0}, Error.PATH_TOLERANCE_VIOLATED)):
        control = controller(goal_time=0.5)
        goal = control.begin(NAMES, [Point(1.0, [1, 0], [0, 0])], 0.0, path=given_path)
        follow(control, 3.0, lambda q: np.minimum(q, 0.3))
        assert goal.code == code
    control = controller(goal_time=0.5)
    goal = control.begin(NAMES, [Point(1.0, [1, 0], [0, 0])], 0.0, path={"a": -1.0}, goal={"a": 0.8})
    follow(control, 3.0, lambda q: np.minimum(q, 0.3))
    assert goal.code == Error.SUCCESSFUL


def test_an_end_that_is_not_reached_in_time_aborts_then_and_not_before():
    control = controller(goal_time=5.0)
    goal = control.begin(NAMES, [Point(1.0, [0.2, 0])], 0.0, goal_time=0.5)
    follow(control, 1.4, lambda q: q - [0.05, 0])
    assert not goal.done.is_set()
    follow(control, 1.7, lambda q: q - [0.05, 0], start=1.4)
    assert goal.code == Error.GOAL_TOLERANCE_VIOLATED and "goal_time" in goal.reason


def test_cancel_holds_and_a_new_goal_cancels_the_old_one_and_begins_where_the_arm_was_told_to_be():
    control = controller()
    first = control.begin(NAMES, [Point(1.0, [0.1, 0.1], [0, 0])], 0.0)
    q = follow(control, 0.5)
    second = control.begin(NAMES, [Point(1.0, [0.0, 0.0], [0, 0])], 0.5)
    assert first.canceled and "new incoming" in first.reason
    assert control.update(0.5, q, ZERO)[0] == pytest.approx(q, abs=2e-3)
    q = follow(control, 0.8, start=0.5)
    control.cancel(second)
    assert second.canceled and control.update(5.0, q, ZERO)[0] == pytest.approx(q, abs=1e-3)
    control.cancel(first)
    assert "new incoming" in first.reason, "what has ended stays as it ended"


def test_a_goal_with_a_stamp_runs_by_it():
    """As joint_trajectory_controller has it: the way to the first point begins when the goal comes, a late one is entered in its middle."""
    control = TrajectoryController(NAMES, ZERO, Tolerance(path=0.0))
    control.begin(NAMES, [Point(1.0, [1, 1]), Point(2.0, [1, 2])], 10.0, stamp=12.0)
    for now, there in ((10.0, [0, 0]), (11.5, [0.5, 0.5]), (13.0, [1, 1]), (13.5, [1, 1.5])):
        assert control.update(now, np.array(there), ZERO)[0] == pytest.approx(there)
    late = controller()
    late.begin(NAMES, [Point(0.0, [0, 0]), Point(1.0, [1, 1]), Point(2.0, [1, 3])], 10.0, stamp=8.5)
    assert late.update(10.0, ZERO, ZERO)[0] == pytest.approx([1, 2])
    goal = late.goal
    late.update(10.01, ZERO, ZERO)
    assert goal.code == Error.PATH_TOLERANCE_VIOLATED, "the arm does not jump there"


@pytest.mark.parametrize(
    "thickness, target, allowed, ends",
    [
        (0.015, 0.015, False, ("reached", False)),
        (0.012, 0.015, False, ("reached", False)),
        (0.000, 0.015, False, ("stalled", True)),
        (0.030, 0.015, False, ("stalled", True)),
        (0.030, 0.015, True, ("stalled", False)),
    ],
)
def test_fingers_press_until_they_stand_and_where_they_stand_decides(thickness, target, allowed, ends):
    gripper = GripperController(allow_stalling=allowed)
    goal = gripper.begin(target, 20.0, 0.0, 0.04)
    position, now = 0.04, 0.0
    while not goal.done.is_set():
        now += 0.01
        before, position = position, max(thickness, position - 0.001)
        gripper.update(now, position, (position - before) / 0.01)
        assert now < 2.0
    what, aborted = ends
    assert (goal.reached, goal.stalled) == (what == "reached", what == "stalled")
    assert goal.aborted is aborted and goal.found == pytest.approx(thickness)


def test_fingers_open_until_they_are_there_and_a_newer_goal_ends_an_older_one():
    gripper = GripperController()
    goal = gripper.begin(0.04, 0.0, 0.0, 0.01)
    gripper.update(0.1, 0.03, 0.1)
    assert not goal.done.is_set()
    gripper.update(0.2, 0.0395, 0.1)
    assert goal.reached and not goal.aborted
    older = gripper.begin(0.0, 20.0, 0.3, 0.04)
    gripper.begin(0.04, 0.0, 0.4, 0.02)
    assert older.canceled and older.done.is_set()
