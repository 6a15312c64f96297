"""Other arms with other grippers, by configuration alone: planned, and proven in physics."""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import combinations
from pathlib import Path

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import numpy as np
import pytest
import robots
import scenes
from demonstrations import demonstration

pytest.importorskip("magic_planner.object_motion")

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description, RobotConfig
from magic_core.testing import six_axis
from magic_planner.arm import ArmPlanner
from magic_planner.budget import Budget
from magic_planner.object_motion import plan_tool_motion
from magic_planner.request import Problem
from magic_planner.robot import Robot
from magic_verifier import verification
from magic_verifier.articulation import ArmOptions, Articulation, collision_groups
from magic_verifier.film import film_strip
from magic_verifier.simulation import Settings, World, from_pose
from magic_verifier.verification import Proposal, verify_proposal

#: One gain for all joints: neither of these arms has the Panda's seven.
GAINS = ArmOptions(stiffness=(3000.0,), damping=(100.0,))


def planned(config, name):
    """Scene and plan of a demonstrated task for a robot."""
    strategy, tool, target, obstacles, candidate = demonstration(name)
    motion = plan_tool_motion(strategy, tool, target, candidate, "keep", scenes.TABLE, obstacles)
    planner = ArmPlanner(Robot(config))
    plan = planner.solve(Problem(strategy, tool, target, candidate, "keep", motion, scenes.TABLE, obstacles), budget=Budget(60.0))
    return (strategy, tool, target, obstacles, scenes.TABLE), plan


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return six_axis.describe(tmp_path_factory.mktemp("six_axis"))


@pytest.fixture(scope="module")
def pull(config):
    """Scene and plan of a pull by the six-axis arm."""
    return planned(config, "hooking")


def edited(config, folder, *changes):
    """The description of the same robot with its URDF changed: pairs of what there was and what is to be there."""
    text = Path(config.urdf).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "edited.urdf"
    path.write_text(text)
    return Description(replace(config, urdf=str(path)))


def test_a_six_axis_arm_pulls_with_the_hook(config, pull):
    scene, plan = pull
    robot = Description(config)
    verdict = verify_proposal(Proposal(*scene, plan, arm_options=GAINS, robot=robot), repetitions=1)
    assert verdict.success, verdict.message
    assert verdict.recording.joints.shape[1] == 8
    metrics = verdict.metrics
    assert metrics["pulled_distance"] > 0.25 and metrics["grasp_slip"] < 0.005
    assert metrics["tracking_error"] < 0.02 and "tracking_error_slide" not in metrics
    # The fingers close along x of the tip, as far apart as planned.
    assert metrics["grip_width"] == pytest.approx(plan.arm_motion.grasp_width, abs=1e-3)
    again = verify_proposal(Proposal(*scene, plan, arm_options=GAINS, robot=robot), repetitions=1)
    assert np.array_equal(verdict.recording.joints, again.recording.joints)
    film = film_strip(verdict.recording, *scene[1:5], frames=2, columns=2, size=(160, 120), robot=robot)
    assert film.std() > 10


def test_a_tool_that_is_in_the_hand_off_its_place_is_carried_on(config, pull):
    """Planned on from where the lift ends with the tool 4 mm deeper in the hand than it was grasped."""
    (strategy, tool, target, obstacles, table), before = pull
    candidate = demonstration("hooking")[-1]
    robot, arm = Description(config), before.arm_motion
    still = (arm.times > arm.grasp_time + 0.6) & (np.abs(arm.velocities).max(axis=1) < 1e-6)
    start = arm.positions[np.flatnonzero(still)[0]]
    off = arm.tool_from_tcp @ transforms.make(translation=[0.0, 0.0, 0.004])
    held = replace(tool, world_from_object=robot.forward(start)[0] @ transforms.inverse(off), hanging=True)
    motion = plan_tool_motion(strategy, held, target, candidate, "keep", table, obstacles)
    plan = ArmPlanner(Robot(config)).solve(
        Problem(strategy, held, target, candidate, "keep", motion, table, obstacles, start=start), budget=Budget(60.0)
    )
    verdict = verify_proposal(Proposal(strategy, held, target, obstacles, table, plan, arm_options=GAINS, robot=robot), repetitions=3)
    assert len(verdict.runs) > 1 and all(run.code == Code.OK for run in verdict.runs), verdict.message
    assert verdict.metrics["pulled_distance"] > 0.25 and verdict.metrics["grasp_slip"] < 0.005
    assert verdict.metrics["grasp_shift"] < 0.002  # it is held where it is said to be, and has not fallen meanwhile


@pytest.mark.parametrize(
    ("options", "changes", "code", "words"),
    [
        (replace(GAINS, grip_force=0.3), (), Code.GRASP_SLIPPED, "gripper"),
        (GAINS, (('velocity="2.5" effort="150"', 'velocity="2.5" effort="12"'),), Code.LIMIT_EXCEEDED, "joint_shoulder"),
        (replace(GAINS, stiffness=(2.0,), damping=(5.0,)), (), Code.LIMIT_EXCEEDED, "lags"),
        (ArmOptions(), (), Code.BAD_REQUEST, "arm stiffness"),
    ],
    ids=["weak grip", "weak motors", "soft drives", "gains of the Panda"],
)
def test_what_an_arm_cannot_do_is_found_out(config, pull, tmp_path, options, changes, code, words):
    scene, plan = pull
    verdict = verify_proposal(Proposal(*scene, plan, arm_options=options, robot=edited(config, tmp_path, *changes)), repetitions=1)
    assert verdict.code == code, verdict.message
    assert words in verdict.message


def test_a_plan_for_another_arm_is_refused(pull):
    scene, plan = pull
    verdict = verify_proposal(Proposal(*scene, plan))
    assert verdict.code == Code.BAD_MOTION
    assert "panda_joint1" in verdict.message and "joint_turn" in verdict.message


def test_a_thing_that_calls_itself_the_arm_is_refused(config, pull):
    (strategy, tool, target, _, table), plan = pull
    thing = scenes.item("arm", [scenes.block((-0.5, -0.4), (-0.5, -0.4), (0, 0.1))])
    verdict = verify_proposal(Proposal(strategy, tool, target, (thing,), table, plan, arm_options=GAINS, robot=Description(config)))
    assert verdict.code == Code.BAD_SCENE and "'arm'" in verdict.message


@pytest.mark.parametrize("what", ["mass", "inertia"])
def test_what_a_urdf_leaves_out_of_masses_is_filled_in(config, pull, tmp_path, what):
    """Links without a mass are as heavy as water, a mass without an inertia is a box of its shapes' size."""
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    zero = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
    mass = '<mass value="5.0"/>'
    robot = edited(config, tmp_path, (mass, "")) if what == "mass" else edited(config, tmp_path, (inertia, zero))
    arm = Articulation(World(Settings()), robot, GAINS)
    links = {link.name: link for link in arm.body.links}
    shoulder, size = links["shoulder"], np.array([0.08, 0.08, 0.32])
    assert shoulder.mass == pytest.approx(1000 * size.prod() if what == "mass" else 5.0, rel=1e-3)
    np.testing.assert_allclose(np.sort(shoulder.inertia), np.sort(shoulder.mass * ((size**2).sum() - size**2) / 12), rtol=1e-3)
    scene, plan = pull
    assert verify_proposal(Proposal(*scene, plan, arm_options=GAINS, robot=robot), repetitions=1).success


@pytest.mark.parametrize("name", ["panda", "ur5", "baxter"])
def test_links_that_only_name_a_place_are_not_solved_and_none_is_elsewhere_for_it(name, tmp_path):
    robot = Description({"panda": RobotConfig, "ur5": lambda: robots.ur5_with_franka_hand(tmp_path), "baxter": robots.baxter}[name]())
    arm = Articulation(World(Settings()), robot, GAINS)
    q = np.array(robot.config.home) + 0.1
    arm.place(q)
    np.testing.assert_allclose(arm.tcp(), robot.forward(q)[0], atol=1e-5)
    poses = robot.poses(robot.arm_positions(np.append(q, robot.opened)))
    there = {link.name: from_pose(link.entity_pose) for link in arm.body.links}
    for link, pose in there.items():
        np.testing.assert_allclose(pose, poses[link], atol=1e-5)
    gone = set(robot.links) - set(there)
    assert (
        gone >= {"panda": {"panda_link8", "panda_hand_tcp"}, "ur5": {"panda_hand_tcp"}, "baxter": set()}[name]
    )  # each of Baxter's has a mass
    assert not any(robot.shapes(link) or robot.masses.get(link, (0.0,))[0] > 0 for link in gone)


@pytest.mark.parametrize("content", ["", "solid nothing\nendsolid nothing\n", "garbage"])
def test_a_mesh_that_is_none_is_refused(config, tmp_path, content):
    """The engine would go on without the shape."""
    (tmp_path / "hollow.stl").write_text(content)
    robot = edited(config, tmp_path, ('<box size="0.08 0.08 0.32"/>', '<mesh filename="hollow.stl"/>'))
    with pytest.raises(MagicError) as error:
        Articulation(World(Settings()), robot, GAINS)
    assert error.value.code == Code.BAD_REQUEST and "shoulder" in error.value.message


def test_the_files_of_a_robot_are_read_once_for_all_runs(config, tmp_path, monkeypatch):
    robot = edited(config, tmp_path, ("", ""))
    Articulation(World(Settings()), robot, GAINS)
    monkeypatch.setattr(type(robot), "shapes", lambda *_: pytest.fail("the shapes are read again"))
    Articulation(World(Settings()), robot, GAINS)


def test_a_sliding_joint_is_measured_in_metres_and_newtons(config, pull, tmp_path, monkeypatch):
    """The first joint becomes an upright axis: at rest it carries the weight of all above it."""
    first = '<joint name="joint_turn" type="revolute">'
    robot = edited(config, tmp_path, (first, first.replace("revolute", "prismatic")))
    world = World(Settings())
    arm = Articulation(world, robot, ArmOptions(stiffness=(1e5,), damping=(3e3,)))
    home = np.array(config.home)
    arm.place(home)
    for _ in range(120):
        arm.open_fingers()
        arm.command(home, np.zeros(6))
        world.step()
    above = sum(mass for name, (_, _, mass) in six_axis.BOXES.items() if name != "foot") + 2 * 0.05
    assert abs(arm.transmitted()[0]) == pytest.approx(9.81 * above, rel=0.01)
    # A soft drive of that axis lags by more than 10 mm, where 0.1 rad would be allowed.
    scene, plan = pull
    monkeypatch.setattr(verification.motion_check, "check", lambda *_: None)  # the plan was made for the arm as it was
    soft = ArmOptions(stiffness=(200.0,) + (3000.0,) * 5, damping=(100.0,))
    verdict = verify_proposal(Proposal(*scene, plan, arm_options=soft, robot=robot), repetitions=1)
    assert verdict.code == Code.LIMIT_EXCEEDED and "joint_turn lags" in verdict.message and "up to 0.01 m" in verdict.message
    assert 0.01 < verdict.metrics["tracking_error_slide"] < 0.1


@pytest.mark.parametrize("task", ["hooking", "hanging"])
def test_a_ur5_with_frankas_hand_does_the_tasks(tmp_path, task):
    config = robots.ur5_with_franka_hand(tmp_path)
    scene, plan = planned(config, task)
    robot = Description(config)
    verdict = verify_proposal(Proposal(*scene, plan, arm_options=GAINS, robot=robot), repetitions=1)
    assert verdict.success, verdict.message
    assert verdict.metrics["torque_ratio"] < 0.6
    film = film_strip(verdict.recording, *scene[1:5], frames=1, columns=1, size=(160, 120), robot=robot)
    assert film.std() > 10


@pytest.mark.parametrize("which", ["panda", "six_axis", "ur5", "baxter"])
def test_links_share_a_bit_exactly_where_they_may_touch(config, tmp_path, which):
    description = {
        "panda": lambda: Description(),
        "six_axis": lambda: Description(config),
        "ur5": lambda: Description(robots.ur5_with_franka_hand(tmp_path)),
        "baxter": lambda: Description(robots.baxter()),
    }[which]()
    groups = collision_groups(description)
    neighbours = {frozenset((joint.parent, joint.child)) for joint in description.joints.values()}
    for first, second in combinations(groups, 2):
        pair = frozenset((first, second))
        if pair in neighbours:
            continue
        allowed = pair in description.disabled or any(pair <= body for body in description.bodies)
        assert bool(groups[first] & groups[second]) == allowed, pair


def test_fingers_that_open_to_either_side_close_on_what_is_between():
    """Baxter's: one opens towards its upper, one towards its lower limit, and closed they are 6.3 mm apart."""
    robot = Description(robots.baxter())
    home = np.array(robot.config.home)
    world = World(Settings(position_iterations=25))
    arm = Articulation(world, robot, ArmOptions())
    arm.place(home)
    assert arm.width() == pytest.approx(0.048, abs=1e-4)
    for _ in range(360):
        arm.close_fingers()
        arm.command(home, np.zeros(7))
        world.step()
    assert arm.width() == pytest.approx(0.0063, abs=1e-3)
    opened = arm.joints()[7:]
    assert abs(opened[0]) == pytest.approx(abs(opened[1]), abs=1e-3)


def given(config):
    """The configuration as parameters of a node."""
    names = ("urdf", "srdf", "move_group", "closing_axis", "opening", "home", "acceleration")
    given = {f"robot.{name}": list(value) if isinstance(value := getattr(config, name), tuple) else value for name in names}
    return {**given, "robot.base_frame": "panda_link0"}  # what the objects of these tests call the root of any arm


def test_the_node_takes_it_by_the_planners_parameters(config, pull, tmp_path):
    pytest.importorskip("rclpy")
    from verifier_graph import goal_message, verifier

    from magic_core.testing.served import ask

    (_, tool, target, _, _), plan = pull
    with verifier(tmp_path, **given(config), **{"arm.stiffness": [3000.0], "arm.damping": [100.0]}) as client:
        goal = goal_message("pulling", tool=tool, target=target, plan=plan, want_film=True, repetitions=1)
        result = ask(client, goal)
        assert result.code == Code.OK, result.message
        assert result.film.height > 100


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"robot.urdf": "/nowhere.urdf"}, "URDF"),
        ({"robot.move_group": "elsewhere"}, "tip link"),
        ({"robot.home": [0.0]}, "home"),
        ({"arm.stiffness": [1.0, 2.0]}, "arm stiffness"),
        ({"arm.damping": [-1.0]}, "arm damping"),
    ],
)
def test_an_arm_that_cannot_be_loaded_ends_the_start(config, change, words):
    rclpy = pytest.importorskip("rclpy")
    from rclpy.parameter import Parameter

    from magic_core.domain import free_domain
    from magic_verifier.node import VerifierNode

    parameters = {**given(config), "arm.stiffness": [3000.0], "arm.damping": [100.0], **change}
    rclpy.init(domain_id=free_domain())
    try:
        with pytest.raises(MagicError) as error:
            VerifierNode(parameter_overrides=[Parameter(name, value=value) for name, value in parameters.items()])
        assert error.value.code == Code.BAD_REQUEST and words in error.value.message
    finally:
        rclpy.try_shutdown()
