"""The adapter to ManiSkill, on an environment that is none: poses, targets, the pull."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import ArmMotion, MotionPlan, Phase, ToolMotion
from magic_core.strategy import find
from magic_verifier import maniskill

BASE = -0.615
HANDLE, HOOK = (0.1, 0.025, 0.025), (0.025, 0.05, 0.025)


@dataclass
class Pose:
    position: tuple
    turn: float = 0.0

    @property
    def raw_pose(self):
        return np.array([[*self.position, np.cos(self.turn / 2), 0.0, 0.0, np.sin(self.turn / 2)]], dtype=np.float32)

    def to_transformation_matrix(self):
        return transforms.from_quaternion_wxyz(self.raw_pose[0, :3], self.raw_pose[0, 3:])


def box(half, position=(0.0, 0.0, 0.0), density=1000.0):
    material = SimpleNamespace(static_friction=0.3, dynamic_friction=0.3)
    return SimpleNamespace(half_size=np.array(half), local_pose=Pose(position), physical_material=material, density=density)


def actor(pose, mass, *boxes):
    body = SimpleNamespace(mass=mass, collision_shapes=list(boxes), angular_damping=0.05, max_depenetration_velocity=1e32)
    return SimpleNamespace(pose=pose, _bodies=[body])


@dataclass
class Fake:
    """The parts of the environment that the adapter reads, and a cube that comes nearer by 1 cm a step."""

    cube: object = None
    tool_at: tuple = (-0.2, -0.2, 0.025)
    cube_at: tuple = (0.15, -0.1, 0.025)
    turn: float = 0.3
    limit: int = 100
    sent: list = field(default_factory=list)
    control_freq = 20
    sim_freq = 100
    width = 0.05
    sim_config = SimpleNamespace(
        scene_config=SimpleNamespace(solver_position_iterations=15, solver_velocity_iterations=1, contact_offset=0.02, rest_offset=0)
    )

    def __post_init__(self):
        self.unwrapped = self
        self.cube = actor(Pose(self.cube_at, self.turn), 0.064, box((0.02, 0.02, 0.02)))
        self.l_shape_tool = actor(Pose(self.tool_at), 0.5, box(HANDLE, (0.1, 0.0, 0.0), 500.0), box(HOOK, (0.175, 0.05, 0.0)))
        self.agent = SimpleNamespace(
            robot=SimpleNamespace(pose=Pose((BASE, 0.0, 0.0)), get_qpos=lambda: np.arange(9.0)[None] / 10),
            arm_joint_names=[f"panda_joint{n}" for n in range(1, 8)],
            arm_stiffness=1e3,
            arm_damping=1e2,
            arm_force_limit=100,
            gripper_stiffness=1e3,
            gripper_damping=1e2,
            gripper_force_limit=100,
            urdf_path="/robots/panda_v2.urdf",
            urdf_config={"_materials": {"gripper": {"dynamic_friction": 2.0}}},
        )

    def step(self, row):
        self.sent.append(row)
        x, y, z = self.cube.pose.position
        self.cube.pose = Pose((x - 0.01, y, z), self.turn)
        near = np.linalg.norm(np.array([x - 0.01 - BASE, y])) < maniskill.NEAR
        return None, 0.0, np.array([False]), np.array([len(self.sent) >= self.limit]), {"success": np.array([near])}


def test_what_the_environment_shows_is_told_in_the_frame_of_the_base():
    given = maniskill.episode(Fake(), 100)
    np.testing.assert_allclose(given.tool.world_from_object[:3, 3], [-0.2 - BASE, -0.2, 0.025], atol=1e-6)
    np.testing.assert_allclose(given.target.world_from_object[:3, 3], [0.15 - BASE, -0.1, 0.025], atol=1e-6)
    np.testing.assert_allclose(given.target.world_from_object[:2, 0], [np.cos(0.3), np.sin(0.3)], atol=1e-6)
    np.testing.assert_allclose(given.joints, np.arange(7) / 10)
    np.testing.assert_allclose(given.tool.mesh.bounds, [[0, -0.025, -0.025], [0.2, 0.1, 0.025]], atol=1e-6)
    volume = 0.2 * 0.05 * 0.05 + 0.05 * 0.075 * 0.05  # the boxes lie over each other
    assert given.tool.mesh.to_trimesh().volume == pytest.approx(volume, rel=1e-5)
    # The pieces weigh what the actor does, and where it does: the hook is of twice the handle's density.
    volumes = [piece.to_trimesh().volume for piece in given.tool.pieces]
    assert given.tool_density * sum(volumes) == pytest.approx(0.5)
    middles = [piece.vertices.mean(axis=0) for piece in given.tool.pieces]
    middle = np.average(middles, axis=0, weights=volumes)
    np.testing.assert_allclose(middle, [0.1375, 0.025, 0.0], atol=1e-3)
    assert given.target_density == pytest.approx(1000, rel=1e-4)
    assert (given.step, given.lag, given.friction) == pytest.approx((0.05, 0.1, 0.3))
    assert given.grip_force == pytest.approx(35)  # 1000 N/m, 25 mm and 10 mm more
    assert (given.settings.frequency, given.settings.position_iterations, given.settings.contact_offset) == (100, 15, 0.02)
    assert (given.gains, given.effort) == ((1e3, 1e2, 1e3, 1e2), 100)
    assert maniskill.arm_of(Fake()).srdf == "/robots/panda_v2.srdf"
    down = maniskill.laid(given.target, given.table)
    assert transforms.apply(down.world_from_object, down.mesh.vertices)[:, 2].min() == pytest.approx(0, abs=2e-4)


@pytest.mark.parametrize("turn", np.deg2rad([0.0, -15.0, 30.0]))
def test_a_pull_ends_where_it_is_to_end(turn):
    middle = np.array([0.75, -0.2, 0.02])
    direction, length = maniskill.pull_for(middle, turn)
    assert np.linalg.norm((middle - length * direction)[:2]) == pytest.approx(maniskill.NEAR)
    assert direction[:2] @ middle[:2] / np.linalg.norm(middle[:2]) == pytest.approx(np.cos(turn))


def test_a_pull_straight_to_the_base_is_as_long_as_what_is_too_far():
    assert maniskill.pull_for(np.array([0.8, 0.0, 0.02]), 0.0)[1] == pytest.approx(0.2)
    assert maniskill.pull_for(np.array([0.5, 0.0, 0.02]), 0.0)[1] == 0  # near already
    assert maniskill.pull_for(np.array([0.9, 0.0, 0.02]), np.deg2rad(60))[1] == np.inf


def test_the_strategy_is_told_how_far_and_nothing_else_of_its_way_changes():
    shipped, given = find("hooking"), maniskill.episode(Fake(), 100)
    told = maniskill.posed(shipped, given, 0.0)
    middle = given.target.world_from_object[:3, 3]
    pulled = next(w for w in told.waypoints if w.phase == "goal")
    touch = next(w for w in told.waypoints if w.phase == "contact")
    end = np.linalg.norm(middle[:2]) + (pulled.offset - touch.offset)[0]
    assert end == pytest.approx(maniskill.NEAR - maniskill.BEYOND)
    assert told.goal.numbers["distance"] == pytest.approx(np.linalg.norm(middle[:2]) - maniskill.NEAR)
    kept = [w for w in shipped.waypoints if w.phase != "retreat"]
    for before, after in zip(kept, told.waypoints, strict=True):
        assert (before.name, before.speed) == (after.name, after.speed)
        if before.phase != "goal":
            np.testing.assert_array_equal(before.offset, after.offset)
    assert (told.physics.friction, told.physics.target_density) == pytest.approx((0.3, 1000), rel=1e-4)
    with pytest.raises(MagicError) as caught:
        maniskill.posed(shipped, maniskill.episode(Fake(cube_at=(0.25, 0.0, 0.02)), 100), np.deg2rad(60))
    assert caught.value.code == Code.GOAL_NOT_REACHED


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4])
def test_the_cube_is_met_on_the_circle_about_it(turn):
    strategy = find("hooking")
    given = maniskill.episode(Fake(turn=turn), 100)
    contact = maniskill.circle_about(given.target, strategy).contact
    assert contact.radius == pytest.approx(0.02 * np.sqrt(2))
    world = given.target.world_from_object @ contact.object_from_contact
    np.testing.assert_allclose(world[:3, 0], strategy.target_normal, atol=1e-6)
    np.testing.assert_allclose(world[:3, 2], strategy.target_view_direction, atol=1e-6)
    np.testing.assert_allclose(world[:3, 3] - given.target.world_from_object[:3, 3], contact.radius * strategy.target_normal, atol=1e-6)


def arm_motion(release=None):
    times = np.linspace(0, 2, 201)
    positions, velocities = np.outer(times**2, np.ones(7)), np.outer(2 * times, np.ones(7))
    phases = (Phase("grasp", 0, 1), Phase("goal", 1, 1.6), Phase("retreat", 1.6, 2))
    return ArmMotion(times, tuple("abcdefg"), positions, velocities, velocities * 0 + 2, np.eye(4), 0.05, 0.8, release, phases)


def test_targets_lead_by_as_much_as_the_drives_lag():
    """A drive without a velocity target, q' = (target - q) / lag, that gets these targets follows a quadratic to its second order."""
    motion, step, lag = arm_motion(), 0.05, 0.1
    rows = maniskill.actions(motion, step, lag, 1000)
    assert len(rows) == 43  # 2 s, and what the arm needs to come to rest
    fine, q, worst = 50, 0.0, 0.0
    for k in range(40):
        for _ in range(fine):
            q += (rows[k, 0] - q) / lag * step / fine
        worst = max(worst, abs(q - ((k + 1) * step) ** 2))
    assert worst < 0.02  # without the lead it is 0.4, the lag times the velocity
    grip = rows[:, 7]
    np.testing.assert_array_equal(grip[:15], 1)
    np.testing.assert_array_equal(grip[16:], -1)
    assert len(maniskill.actions(motion, step, lag, 20)) == 20
    assert maniskill.actions(arm_motion(1.5), step, lag, 1000)[32, 7] == 1


def test_the_clock_is_an_upper_bound_that_is_raised():
    poses = np.tile(np.eye(4), (3, 1, 1))
    motion = ToolMotion(np.array([0.0, 1.0, 3.0]), poses, (Phase("goal", 1.0, 3.0),), (("pulled", 3.0),))
    quick = maniskill.hastened(motion, 2.0)
    assert (quick.times[-1], quick.phases[0].start, quick.marks[0][1]) == (1.5, 0.5, 1.5)


def test_a_pull_is_done_when_it_is_long_enough():
    times = np.linspace(0, 4, 41)
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, 0, 3] = -0.1 * np.maximum(times - 2, 0)
    plan = SimpleNamespace(tool_motion=ToolMotion(times, poses, (Phase("contact", 0, 2), Phase("goal", 2, 4))))
    out = np.array([1.0, 0.0, 0.0])
    assert maniskill.done_at(plan, out, 0.1) == pytest.approx(2 + 10 * (0.1 + maniskill.PLAY))
    assert maniskill.done_at(plan, out, 0.5) == 4  # it never is


def test_what_time_there_is_goes_to_the_tool_in_the_hand():
    """A pull of 0.3 m, grasped after 1 s and done after 3.2 s, in 5 s."""
    times = np.linspace(0, 4, 401)
    poses = np.tile(np.eye(4), (401, 1, 1))
    poses[:, 0, 3] = -0.2 * np.maximum(times - 2, 0)
    phases = (Phase("grasp", 0, 1), Phase("transfer", 1, 2), Phase("goal", 2, 4))
    joints = np.tile(times[:, None], (1, 7))
    arm = ArmMotion(times, tuple("abcdefg"), joints, joints * 0 + 1, joints * 0, np.eye(4), 0.05, 0.8, None, phases)
    plan = MotionPlan("arm", ToolMotion(times, poses, phases), arm)
    strategy = SimpleNamespace(target_normal=np.array([1.0, 0.0, 0.0]), goal=SimpleNamespace(numbers={"distance": 0.23}))
    slower, end = maniskill.unhurried(plan, strategy, SimpleNamespace(steps=100, step=0.05, lag=0.1))
    assert maniskill.done_at(plan, strategy.target_normal, 0.23) == pytest.approx(3.2, abs=0.01)
    assert end == pytest.approx(5.0 - 0.1 - maniskill.SPARE, abs=0.02)
    assert slower.arm_motion.grasp_time == 0.8
    np.testing.assert_array_equal(slower.arm_motion.positions, arm.positions)
    hurried, _ = maniskill.unhurried(plan, strategy, SimpleNamespace(steps=67, step=0.05, lag=0.1))
    np.testing.assert_array_equal(hurried.arm_motion.times, times)  # as quick as it can be, and in time
    with pytest.raises(MagicError) as caught:
        maniskill.unhurried(plan, strategy, SimpleNamespace(steps=60, step=0.05, lag=0.1))
    assert caught.value.code == Code.TIME_PARAMETERISATION


def test_an_episode_is_played_to_its_step_limit():
    env = Fake(cube_at=(0.05, 0.0, 0.02), limit=12)
    played = maniskill.play(env, np.arange(5 * 8, dtype=np.float32).reshape(5, 8))
    assert len(env.sent) == 12
    np.testing.assert_array_equal(env.sent[-1], env.sent[4])  # the last target is held
    assert (played.once, played.at_end, played.steps) == (True, True, 7)
    assert played.distance == pytest.approx(0.665 - 0.12, abs=1e-6)
    never = maniskill.play(Fake(cube_at=(0.25, 0.0, 0.02), limit=3), np.zeros((1, 8), np.float32))
    assert (never.once, never.at_end, never.steps) == (False, False, 3)


def test_what_lies_in_each_other_is_known():
    assert not maniskill.beside(maniskill.episode(Fake(), 100))
    assert maniskill.beside(maniskill.episode(Fake(tool_at=(-0.1, -0.1, 0.025), cube_at=(0.09, -0.05, 0.025)), 100))
    env = Fake()
    maniskill.still(env, 3)
    np.testing.assert_allclose(env.sent, np.tile([*np.arange(7) / 10, 1.0], (3, 1)), rtol=1e-6)


def test_the_summary_counts_what_was_not_even_tried_as_a_failure():
    tried = [{"code": "NO_IK"}]
    results = [
        {"seed": 0, "success": True, "verified": True, "at_end": True, "steps": 80, "seconds": 2.0, "tried": []},
        {"seed": 1, "success": False, "verified": True, "at_end": False, "steps": 100, "seconds": 2.0, "tried": []},
        {"seed": 2, "success": False, "verified": False, "seconds": 2.0, "tried": tried},
    ]
    text = maniskill.summarise(results)
    assert "1 of 3 = 33.3 %" in text and "1 of 2 = 50.0 %" in text and "1 NO_IK" in text and "seeds 1" in text


def test_without_maniskill_one_sentence_says_what_to_install(monkeypatch, tmp_path, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "mani_skill", None)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(SystemExit) as caught:
        maniskill.main(["--seeds", "1", "--out", str(tmp_path)])
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert "requirements-maniskill.txt" in said and "Traceback" not in said
