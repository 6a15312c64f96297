"""Two soft pads hold what friction holds: forces along them and torques, up to a limit that analysis gives, and no more."""

from dataclasses import replace

import numpy as np
import pytest
import scenes

from magic_core import transforms
from magic_core.motion import ArmMotion, MotionPlan, ToolMotion
from magic_core.robot import Description
from magic_core.strategy import Physics
from magic_verifier import arm_simulation
from magic_verifier.arm_simulation import LYING, ArmRun
from magic_verifier.articulation import ArmOptions
from magic_verifier.floating import make_setup
from magic_verifier.grip import LEAST, Grip, Patch, patch_of
from magic_verifier.rollout import Limits
from magic_verifier.simulation import DYNAMIC, KINEMATIC, Settings, Touch, World, to_pose, usable_pieces
from magic_verifier.subjects import tool_object
from magic_verifier.verification import DEFAULTS

FORCE, FRICTION = 40.0, 0.8
PATCH = Patch(np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]]), 0.006, (0.008, 0.006))


def hand_and_tool(mass, offset, settings=None):
    """A fixed hand and a cube of a mass (kg) whose middle is ``offset`` (3,) m from where it is held."""
    world = World(settings or Settings())
    half = 0.05
    hulls = usable_pieces("tool", (scenes.block(*[(c - half, c + half) for c in offset]),))
    world.add("hand", usable_pieces("hand", (scenes.block((-0.02, 0.02), (-0.02, 0.02), (0.2, 0.24)),)), np.eye(4), KINEMATIC, 1000.0, 0.5)
    world.add("tool", hulls, np.eye(4), DYNAMIC, mass / (2 * half) ** 3, 0.5)
    return world, Grip(world.component("hand"), PATCH.tcp_from_patch, world.component("tool"), PATCH, FORCE, FRICTION, world.timestep)


def after(world, grip, seconds):
    loads = []
    for step in range(round(seconds * world.settings.frequency)):
        world.step()
        if step % 6 == 0:
            loads.append(grip.load())
    pose = world.pose("tool")
    return loads[-1], float(np.linalg.norm(pose[:3, 3])), transforms.rotation_angle(pose, np.eye(4))


@pytest.mark.parametrize("frequency", [240.0, 480.0])
@pytest.mark.parametrize("share", [0.05, 0.9, 1.15])
def test_weight_along_the_pads_slips_exactly_where_it_exceeds_friction(share, frequency):
    mass = share * 2 * FRICTION * FORCE / 9.81
    load, slip, _ = after(*hand_and_tool(mass, (0, 0, 0), Settings(frequency=frequency)), 0.5)
    if share < 1:
        assert load == pytest.approx(share, abs=0.06)
        assert slip < 0.002
    else:  # g (1 - 1 / share) t^2 / 2, and what it gains before fingers have given way by what they do under so much
        assert slip == pytest.approx(9.81 * (1 - 1 / share) * 0.5**2 / 2, rel=0.15)


@pytest.mark.parametrize("share", [0.8, 1.3])
def test_a_lever_about_the_closing_axis_turns_exactly_where_it_exceeds_the_patches(share):
    # The closing axis is y of the world; the weight pulls at a lever along x.
    mass = 1.0
    lever = share * 2 * FRICTION * FORCE * PATCH.radius / (mass * 9.81)
    load, _, angle = after(*hand_and_tool(mass, (lever, 0, 0)), 0.5)
    assert (angle < 0.1) if share < 1 else (angle > 0.5)
    assert share > 1 or load == pytest.approx(share, abs=0.1)


@pytest.mark.parametrize(("length", "lever", "mass"), [(0.3, 0.12, 0.05), (0.2, 0.08, 0.03), (0.4, 0.18, 0.1)])
def test_a_long_light_tool_loads_the_pads_by_what_it_weighs(length, lever, mass):
    world = World(DEFAULTS["arm"])
    bar = scenes.block((lever - length / 2, lever + length / 2), (-0.005, 0.005), (-0.005, 0.005))
    world.add("hand", usable_pieces("hand", (scenes.block((-0.02, 0.02), (-0.02, 0.02), (0.2, 0.24)),)), np.eye(4), KINEMATIC, 1000.0, 0.5)
    world.add("tool", usable_pieces("tool", (bar,)), np.eye(4), DYNAMIC, mass / (length * 0.01**2), 0.5)
    grip = Grip(world.component("hand"), PATCH.tcp_from_patch, world.component("tool"), PATCH, FORCE, FRICTION, world.timestep)
    holds = 2 * FRICTION * FORCE
    asked = np.hypot(9.81 * mass / holds, 9.81 * mass * lever / (holds * PATCH.radius))
    assert after(world, grip, 0.5)[0] == pytest.approx(asked, abs=0.06)


def test_a_light_tool_is_held_as_a_heavy_one_and_falls_when_let_go():
    world, grip = hand_and_tool(0.002, (0, 0, 0))
    assert after(world, grip, 0.5)[1] < 1e-4
    grip.open()
    for _ in range(48):
        world.step()
    assert world.position("tool")[2] == pytest.approx(-9.81 * 0.2**2 / 2, rel=0.05)


def touch(x, y, z, side):
    return Touch(np.array([x, y, z]), np.array([0, -side, 0.0]), 0.0, np.zeros(3))


def test_a_patch_is_what_both_pads_touch():
    both = [touch(x, side * 0.01, z, side) for side in (1, -1) for x in (-0.008, 0.008) for z in (-0.004, 0.006)]
    patch = patch_of(both, np.eye(4), 1, FRICTION)
    assert patch.tcp_from_patch[:3, 3] == pytest.approx([0, 0, 0.001])
    assert patch.half == pytest.approx((0.008, 0.005))
    assert 0.004 < patch.radius < 0.008
    line = patch_of([t for t in both if t.position[0] > 0], np.eye(4), 1, FRICTION)
    assert line.half == pytest.approx((LEAST, 0.005))
    holds = patch.holds(FORCE, FRICTION)
    assert holds[1] == holds[2] == 2 * FORCE * FRICTION and holds[4] == pytest.approx(2 * FORCE * 0.005)


def test_no_patch_where_one_pad_touches_nothing_or_only_pushes():
    one = [touch(0, 0.01, 0, 1), touch(0.01, 0.01, 0, 1)]
    assert patch_of(one, np.eye(4), 1, FRICTION) is None
    assert patch_of([], np.eye(4), 1, FRICTION) is None
    steep = Touch(np.array([0, -0.01, 0.0]), np.array([0.95, 0.31, 0.0]), 0.0, np.zeros(3))
    assert patch_of([*one, steep], np.eye(4), 1, FRICTION) is None
    aside = [touch(0, -0.01, 0.04, -1)]
    assert patch_of([*one, *aside], np.eye(4), 1, FRICTION) is None


def test_the_edges_of_a_pad_in_a_hollow_hold_it_together():
    """Each of them would push it aside; both press it against the other pad."""
    flat = [touch(x, -0.01, z, -1) for x in (-0.008, 0.008) for z in (-0.004, 0.006)]
    slant = np.array([0.8, -0.6, 0.0])  # 53 degrees from the closing axis, where friction bears 39
    left = [Touch(np.array([-0.009, 0.008, z]), slant, 0.0, np.zeros(3)) for z in (-0.004, 0.006)]
    right = [Touch(np.array([0.009, 0.007, z]), slant * [-1, 1, 1], 0.0, np.zeros(3)) for z in (-0.004, 0.006)]
    assert patch_of([*flat, *left], np.eye(4), 1, FRICTION) is None
    patch = patch_of([*flat, *left, *right], np.eye(4), 1, FRICTION)
    assert patch is not None and patch.half[0] == pytest.approx(0.008)


def test_a_pad_that_gives_way_touches_as_far_as_it_does_what_lies_askew():
    """Rigid faces a little askew touch along an edge; one that gives way by 1 mm touches 1 mm / slope of the other."""
    slope = 0.06
    world = World(Settings(frequency=960.0, contact_offset=0.002))
    world.add("pad", usable_pieces("pad", (scenes.block((-0.01, 0.01), (-0.01, 0.01), (-0.02, 0)),)), np.eye(4), KINEMATIC, 1000.0, 0.5)
    askew = transforms.from_rpy(0.0, -slope, 0.0, [-0.01, 0.0, 0.0])
    tool = usable_pieces("tool", (scenes.block((-0.02, 0.04), (-0.03, 0.03), (0, 0.01)),))
    world.add("tool", tool, askew, DYNAMIC, 600.0, 0.5)
    world.step()
    rigid = [touch.position[0] for touch in world.touches("tool", "pad", 0.0005)]
    assert rigid and max(rigid) < -0.009
    soft = world.pressed("tool", "pad", 0.001, np.array([0.0, 0.0, 1.0]))
    assert max(touch.position[0] for touch in soft) == pytest.approx(-0.01 + 0.001 / slope, abs=0.0026)  # the grid is 2.5 mm wide
    assert 0.0005 < max(touch.separation for touch in soft) <= 0.001
    assert sum(touch.impulse for touch in soft) == pytest.approx(sum(touch.impulse for touch in world.touches("tool", "pad", 0.001)))
    np.testing.assert_allclose([t.normal for t in soft], np.tile([np.sin(-slope), 0, np.cos(slope)], (len(soft), 1)), atol=0.02)


def test_a_plate_a_little_askew_is_held_between_pads_that_give_way():
    """The pads of rigid fingers touch it at opposite edges; what holds it is what the pads touch when they give way."""
    plate = scenes.block((-0.03, 0.03), (-0.0015, 0.0015), (-0.05, 0.03))
    tcp = np.eye(4)
    world = World(Settings(frequency=960.0, contact_offset=0.002))
    world.add("tool", usable_pieces("tool", (plate,)), transforms.from_rpy(0.06, 0.0, 0.0), DYNAMIC, 600.0, 2.0)
    edge = 0.0015 / np.cos(0.06) + 0.009 * np.tan(0.06)  # where a pad of 18 mm first meets the plate
    for name, side in (("left", 1), ("right", -1)):
        y = sorted((side * edge, side * (edge + 0.01)))
        hull = usable_pieces(name, (scenes.block((-0.009, 0.009), tuple(y), (-0.009, 0.009)),))
        world.add(name, hull, np.eye(4), KINEMATIC, 1000.0, 2.0)
    world.step()
    rigid = [t for name in ("left", "right") for t in world.touches("tool", name, 0.001)]
    soft = [t for name in ("left", "right") for t in world.pressed("tool", name, 0.001, np.array([0.0, 1.0, 0.0]))]
    assert patch_of(rigid, tcp, 1, 2.0) is None
    patch = patch_of(soft, tcp, 1, 2.0)
    assert patch is not None and patch.half[1] == pytest.approx(0.001 / 0.06 / 2, abs=0.0013)


def test_what_is_in_the_hand_already_is_held_as_it_is():
    """A bar lies askew between the pads, as it was seen there: that they would turn it true has been settled in the real hand."""
    robot = Description()
    home = np.asarray(robot.config.home, dtype=float)
    tcp = robot.forward(home)[0]
    askew = tcp @ transforms.from_rpy(0.0, 0.0, 0.12)
    tool = scenes.item("tool", [scenes.block((-0.08, 0.08), (-0.006, 0.006), (-0.008, 0.008))], askew)
    target = scenes.item("target", [scenes.block((-0.03, 0.03), (-0.03, 0.03), (0, 0.06))], transforms.make(translation=[0.5, 0.4, 0]))
    setup = make_setup(tool, target, (), scenes.TABLE, Physics(0.5, 600.0, 600.0), Settings(frequency=300.0))
    times, still = np.array([0.0, 0.3]), np.zeros((2, len(home)))
    held = transforms.inverse(askew) @ tcp
    arm = ArmMotion(times, robot.names, np.stack([home, home]), still, still, held, 0.012, 0.0)
    run = ArmRun(setup, MotionPlan("arm", ToolMotion(times, np.stack([askew, askew])), arm), None, Limits(), robot)
    while run.time < 0.3:
        run.advance()
    off = transforms.inverse(held) @ run.held().tool_from_tcp
    assert np.linalg.norm(off[:3, 3]) < 0.0005 and transforms.rotation_angle(off, np.eye(4)) < 0.005


def run_of(options, speed=0.0, grasp_time=0.1):
    """The Panda at home, its first joint turned at a speed (rad/s), closing on a bar that lies on a post between its fingers."""
    robot = Description()
    home = np.asarray(robot.config.home, dtype=float)
    tcp = robot.forward(home)[0]
    tool = scenes.item("tool", [scenes.block((-0.08, 0.08), (-0.006, 0.006), (-0.008, 0.008))], tcp)
    post = scenes.item("post", [scenes.block((-0.03, 0.03), (-0.004, 0.004), (0.008, 0.05))], tcp)
    target = scenes.item("target", [scenes.block((-0.03, 0.03), (-0.03, 0.03), (0, 0.06))], transforms.make(translation=[0.5, 0.4, 0]))
    around = () if speed else (post,)  # a hand that moves would meet it
    setup = make_setup(tool, target, around, scenes.TABLE, Physics(0.5, 600.0, 600.0), Settings(frequency=200.0, contact_offset=0.002))
    times = np.linspace(0.0, 0.8, 81)
    q = home + np.outer(speed * times, np.eye(len(home))[0])
    qd = np.tile(speed * np.eye(len(home))[0], (len(times), 1))
    arm = ArmMotion(times, robot.names, q, qd, 0 * qd, np.eye(4), 0.012, grasp_time)
    return ArmRun(setup, MotionPlan("arm", ToolMotion(times, np.tile(tcp, (len(times), 1, 1))), arm), options, Limits(), robot)


def closing_on(block, physics, rests=False, grasp_time=0.2, offset=None):
    """The Panda at home, its hand straight down to a stand 20 mm below the tip, closing after so many seconds on a block (its ranges about
    the tip, y along the fingers' way, z up); also where the block is put."""
    robot = Description()
    home = np.asarray(robot.config.home, dtype=float)
    tcp = robot.forward(home)[0]
    pose = transforms.make(tcp[:3, :3] @ np.diag([1.0, -1.0, -1.0]), tcp[:3, 3])
    tool = scenes.item("tool", [scenes.block(*block)], pose)
    stand = scenes.item("stand", [scenes.block((-0.1, 0.1), (-0.1, 0.1), (-0.05, -0.02))], pose)
    target = scenes.item("target", [scenes.block((-0.03, 0.03), (-0.03, 0.03), (0, 0.06))], transforms.make(translation=[0.5, 0.4, 0]))
    settings = Settings(position_iterations=8, velocity_iterations=1, contact_offset=0.002)
    times = np.linspace(0.0, 0.8, 81)
    q, still = np.tile(home, (len(times), 1)), np.zeros((len(times), len(home)))
    arm = ArmMotion(times, robot.names, q, still, still, transforms.inverse(pose) @ tcp, 0.012, grasp_time)
    plan = MotionPlan("arm", ToolMotion(times, np.tile(pose, (len(times), 1, 1))), arm)
    return ArmRun(
        make_setup(tool, target, (stand,), scenes.TABLE, physics, settings), plan, None, Limits(), robot, rests=rests, offset=offset
    ), pose


def test_fingers_press_harder_on_what_sticks_to_the_table():
    """A block of 3 kg, 8 mm aside, on a stand with a friction of 0.8: it takes 24 N to shift it, and fingers close with 8."""
    size = (0.08, 0.04, 0.05)
    run, pose = closing_on(((-0.04, 0.04), (-0.012, 0.028), (-0.02, 0.03)), Physics(0.8, 3.0 / np.prod(size), 600.0))
    while run.time < 0.3:
        run.advance()
    assert run.held() is not None and run.held().width == pytest.approx(0.04, abs=0.001)
    assert np.linalg.norm((run.world.pose("tool") - pose)[:3, 3]) == pytest.approx(0.008, abs=0.002)


@pytest.mark.parametrize(("mass", "may", "stays"), [(0.05, True, True), (0.05, False, False), (7.0, True, False)])
def test_when_the_motion_is_over_a_tool_that_is_held_with_ease_is_left_where_it_is(mass, may, stays):
    """A block whose stand is taken away; one of 7 kg asks for more than half of what the pads hold."""
    run, _ = closing_on(((-0.03, 0.03), (-0.012, 0.012), (-0.02, 0.03)), Physics(0.5, mass / (0.06 * 0.024 * 0.05), 600.0))
    run.stands_still = may
    while run.time < 0.4:
        run.advance()
    run.world.component("stand").entity_pose = to_pose(transforms.make(translation=[5.0, 0.0, 1.0]))
    while run.time < 0.79:
        run.advance()
    assert not run.world.component("tool").kinematic, "the motion goes on"
    while run.time < 1.2:
        run.advance()
    assert run.world.component("tool").kinematic is stays
    if stays:
        before = run.world.pose("tool"), run.joints()
        while run.time < 1.4:
            run.advance()
        assert np.array_equal(run.world.pose("tool"), before[0]) and np.array_equal(run.joints(), before[1])
        assert np.linalg.norm(run.world.velocity("tool")) == 0


@pytest.mark.parametrize("mass", [0.009, 0.018])
def test_fingers_do_not_sink_into_what_weighs_little(mass):
    """A spoon on the table, its round handle 21 mm thick between the tips of the pads."""
    robot = Description()
    q = np.tile([-1.46, 0.797, 0.788, -2.192, -1.074, 2.526, -1.447], (81, 1))
    pose = transforms.make([[-0.7149, -0.6969, 0.0575], [0.6947, -0.7172, -0.0558], [0.0801, 0.0, 0.9968]], [0.3555, -0.2053, 0.0057])
    spoon = replace(tool_object("spoon:290063", 0, "side"), world_from_object=pose)
    target = scenes.item("target", [scenes.block((-0.03, 0.03), (-0.03, 0.03), (0, 0.06))], transforms.make(translation=[0.5, 0.4, 0]))
    setup = make_setup(spoon, target, (), scenes.TABLE, Physics(0.3, 600.0 * mass / 0.036, 600.0), DEFAULTS["arm"])
    times = np.linspace(0.0, 0.8, 81)
    held = transforms.inverse(pose) @ robot.forward(q[:1])[0]
    motion = ToolMotion(times, np.tile(pose, (81, 1, 1)))
    run = ArmRun(setup, MotionPlan("arm", motion, ArmMotion(times, robot.names, q, 0 * q, 0 * q, held, 0.021, 0.2)), None, Limits(), robot)
    assert run.world.component("tool").mass == pytest.approx(mass, rel=0.05)
    while run.time < 0.3:
        run.advance()
    assert run.held() is not None and run.held().width == pytest.approx(0.021, abs=0.001)


@pytest.mark.parametrize("rests", [True, False])
def test_what_was_seen_to_lie_lies_until_it_is_touched(rests):
    """A bar beside its stand, as a ladle lies on a handle's end that no camera saw."""
    run, pose = closing_on(((-0.3, 0.05), (-0.006, 0.006), (-0.02, 0.006)), Physics(0.5, 600.0, 600.0), rests)
    while run.time < 0.195:
        run.advance()
    turned = transforms.rotation_angle(run.world.pose("tool"), pose)
    assert turned < 1e-6 if rests else turned > 0.02
    while run.time < 0.3:
        run.advance()
    if rests:
        assert run.held() is not None and transforms.rotation_angle(run.world.pose("tool"), pose) < 0.02
        assert not run.world.component("tool").kinematic


def test_contacts_are_solved_less_far_ahead_once_the_tool_is_held():
    run, _ = closing_on(((-0.04, 0.04), (-0.006, 0.006), (-0.02, 0.006)), Physics(0.5, 600.0, 600.0), offset=0.0005)

    def offsets():
        return {
            name: {round(s.contact_offset, 6) for s in run.world.component(name).collision_shapes} for name in ("tool", "target", "stand")
        }

    assert offsets() == {"tool": {0.002}, "target": {0.002}, "stand": {0.002}}
    while run.held() is None:
        run.advance()
    assert offsets() == {"tool": {0.0005}, "target": {0.0005}, "stand": {0.002}}


@pytest.mark.parametrize("ends", [-0.3, -0.04])
def test_what_lies_still_is_not_solved_until_the_fingers_close(ends, monkeypatch):
    """A bar that lies on its stand, and one that reaches beyond it and tips; fingers close on the first as on one that was solved all the
    time."""
    held = []
    for speed in (LYING, 0.0):
        monkeypatch.setattr(arm_simulation, "LYING", speed)
        run, pose = closing_on(((ends, 0.04), (-0.006, 0.006), (-0.02, 0.006)), Physics(0.5, 600.0, 600.0), grasp_time=0.6)
        while run.time < 0.595:
            run.advance()
        lies = transforms.rotation_angle(run.world.pose("tool"), pose) < 0.01
        assert lies == (ends == -0.04)
        assert run.world.component("tool").is_sleeping == (lies and speed > 0)
        while lies and run.held() is None:
            run.advance()
            assert run.time < 0.7 and (run.time < 0.602 or not run.world.component("tool").is_sleeping)
        held.append(run.world.pose("tool"))
    np.testing.assert_allclose(*held, atol=3e-4)


def test_what_is_held_is_free_whatever_touches_it():
    """Soft pads hold what they would touch if they gave way, which the engine may say they do not touch yet."""
    run, _ = closing_on(((-0.04, 0.04), (-0.006, 0.006), (-0.02, 0.006)), Physics(0.5, 600.0, 600.0), True)
    run.world.touched_by = lambda *given: ()
    while run.time < 0.3:
        run.advance()
    assert run.held() is not None and not run.world.component("tool").kinematic


def test_fingers_that_are_driven_one_by_one_hold_by_contacts_alone_while_the_arm_goes_on():
    run = run_of(ArmOptions(finger_stiffness=1000.0, finger_armature=0.0, past=0.01))
    while run.time < 0.75:
        run.advance()
    assert run.world.time == pytest.approx(run.time)
    assert run.held() is not None and 0.008 < run.held().width < 0.0125
    assert "grip_load" not in run.metrics() or run.metrics()["grip_load"] == 0.0
    assert run.metrics()["grasp_slip"] < 0.003


def test_a_command_that_stays_jerks_the_arm():
    def ripple(period):
        run = run_of(
            ArmOptions(stiffness=(1000.0,), damping=(100.0,), armature=0.0, effort=100.0, command_period=period), 0.3, grasp_time=5.0
        )
        speeds = []
        while run.time < 0.75:
            run.advance()
            if run.time > 0.4:
                speeds.append(float(run._arm.speeds()[0]))
        assert np.mean(speeds) == pytest.approx(0.3, rel=0.1)
        return float(np.std(speeds))

    assert ripple(0.0) < 0.01 < 0.03 < ripple(0.05)
