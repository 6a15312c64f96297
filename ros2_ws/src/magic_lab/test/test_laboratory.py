"""The world, its controllers and its cameras together, without ROS."""

import numpy as np
import pytest
from lab_scenes import ABOVE, HOME, empty, lowered, robot

from magic_core import sensor, transforms
from magic_core.errors import Code, MagicError
from magic_core.shapes import make
from magic_lab.cameras import Bodies, Camera
from magic_lab.controllers import Error, Point
from magic_lab.laboratory import Lab
from magic_lab.scenarios import EVENTS, FACTOR, SCENARIOS, TARGET, Event, case_of, draw, hand_pose, scenario_of
from magic_server.weighing import Reading, weighed
from magic_verifier.simulation import DYNAMIC


def lab(*events, things=None):
    scene = empty()
    return Lab(scene, robot(), tuple(map(Event.parse, events)))


def go(lab, done, most=8.0):
    end = lab.time + most
    while not done():
        lab.tick()
        assert lab.time < end, "it never came to an end"


def move(lab, q, seconds=1.5):
    goal = lab.arm.begin(robot().names, [Point(seconds, list(q), [0.0] * 7, [0.0] * 7)], lab.time)
    lab.moved()
    go(lab, goal.done.is_set)
    return goal


@pytest.fixture(scope="module")
def gripped():
    """A laboratory whose hand has taken up the block."""
    it = lab()
    assert move(it, ABOVE).code == Error.SUCCESSFUL
    low = lowered(0.07)
    assert move(it, low).code == Error.SUCCESSFUL
    goal = it.grip(0.015, 40.0)
    go(it, goal.done.is_set)
    assert (goal.reached, goal.stalled, it.world.held) == (True, False, "tool_1")
    assert goal.found == pytest.approx(0.015, abs=0.002)
    move(it, ABOVE)
    return it


def test_the_arm_holds_its_ready_pose_and_things_stay_where_they_are():
    it = lab()
    before = it.world.poses()
    go(it, lambda: it.time >= 1.0)
    assert np.abs(it.joints[0][:7] - HOME).max() < 0.005
    for name, pose in it.world.poses().items():
        assert np.linalg.norm((pose - before[name])[:3, 3]) < 0.001, name


def test_the_arm_weighs_what_it_takes_up():
    it = lab()
    arm = robot()
    for q in (ABOVE, lowered(0.07)):
        move(it, q)

    def reading():
        go(it, lambda end=it.time + 0.3: it.time >= end)
        told = []
        go(it, lambda end=it.time + 0.3: told.append(it.torques()) or it.time >= end)
        return Reading(arm.arm_positions(it.joints[0]), np.mean(told, axis=0))

    empty = reading()
    go(it, it.grip(0.015, 40.0).done.is_set)
    move(it, ABOVE)
    tip_from_tool = transforms.inverse(it.world.tcp()) @ it.world.pose("tool_1")
    found = weighed(arm, 0.2, empty, reading(), tip_from_tool[:3, 3])
    true = it.world.engine.component("tool_1").mass
    assert abs(found.mass - true) < 2 * found.error and found.error < 0.08


def test_fingers_take_up_what_is_between_them_and_let_go(gripped):
    assert gripped.world.held == "tool_1"
    raised = gripped.world.pose("tool_1")[2, 3]
    assert raised > 0.07
    goal = gripped.grip(0.04, 0.0)
    go(gripped, goal.done.is_set)
    assert goal.reached and gripped.world.held == ""
    go(gripped, lambda: gripped.time > 0 and gripped.world.pose("tool_1")[2, 3] < raised - 0.02)


def test_fingers_that_close_on_nothing_stall_at_nothing():
    it = lab()
    goal = it.grip(0.015, 40.0)
    go(it, goal.done.is_set)
    assert (goal.stalled, goal.reached, goal.aborted) == (True, False, True) and goal.found < 0.002
    assert it.world.held == ""


def test_what_is_blocked_stops_within_its_tolerance_and_the_next_move_works():
    it = lab("block@1+0.3")
    goal = move(it, [1.2, -0.3, 0, -2.3, 0, 1.5, 0.8], 2.0)
    assert goal.code == Error.PATH_TOLERANCE_VIOLATED
    stands = it.joints[0][:7].copy()
    go(it, lambda: it.time > 4.0)
    assert np.abs(it.joints[0][:7] - stands).max() < 0.05
    assert move(it, HOME, 3.0).code == Error.SUCCESSFUL


@pytest.mark.parametrize(
    "event, seen",
    [
        ("nudge@1+0.2", lambda it: np.linalg.norm((it.world.pose(TARGET) - empty().thing(TARGET).item.world_from_object)[:2, 3]) > 0.04),
        ("take_target+0.1", lambda it: it.world.pose(TARGET)[0, 3] < -2),
        ("take_tool+0.1", lambda it: it.world.pose("tool_1")[0, 3] < -2),
        ("hand+0.1", lambda it: it.world.pose("hand")[0, 3] > -1 and it.world.pose("hand")[1, 3] < 0.4),
        ("freeze", lambda it: it.silent.camera),
        ("silence", lambda it: it.silent.joints),
    ],
)
def test_events_happen_once_when_it_is_time(event, seen):
    it = lab(event)
    assert not it.happened
    goal = it.arm.begin(robot().names, [Point(3.0, HOME.tolist(), [0.0] * 7)], it.time)
    it.moved()
    go(it, lambda: seen(it), 2.5)
    assert [e.kind for e in it.happened] == [event.partition("@")[0].partition("+")[0]]
    assert not goal.done.is_set()


def test_an_abort_ends_the_goal_at_work_with_its_code():
    it = lab("abort@1+0.2")
    goal = move(it, ABOVE, 2.0)
    assert goal.code == Error.PATH_TOLERANCE_VIOLATED and it.time == pytest.approx(0.22, abs=0.03)


def test_events_are_read_and_what_is_none_is_refused():
    assert Event.parse("nudge@2+0.5") == Event("nudge", 2, 0.5) and Event.parse("hand") == Event("hand")
    for wrong in ("", "fire", "nudge@", "nudge+x", "nudge@2-1"):
        with pytest.raises(MagicError) as error:
            Event.parse(wrong)
        assert error.value.code == Code.BAD_REQUEST and "take_tool" in error.value.message
    assert set(EVENTS) >= {"nudge", "abort"} and hand_pose(99.0) is None


def test_a_seed_draws_a_scene_and_the_same_one_again():
    scenario = scenario_of("hooking")
    one, again, other = (draw(scenario, case_of(scenario, "caliper", seed), seed) for seed in (3, 3, 4))
    for a, b in zip(one.things, again.things, strict=True):
        assert (a.density, a.friction) == (b.density, b.friction)
        np.testing.assert_array_equal(a.item.world_from_object, b.item.world_from_object)
    assert one.things[0].density != other.things[0].density
    assert all(t.density != one.strategy.physics.tool_density for t in one.things), "what is true is not what the strategy assumes"
    for wrong in (lambda: scenario_of("x"), lambda: case_of(scenario, "x", 0)):
        with pytest.raises(MagicError, match="allowed"):
            wrong()


def test_true_densities_are_half_to_twice_what_the_strategy_assumes_of_each_thing():
    scenario = scenario_of("scooping")  # whose ball is lighter than its tools
    for seed in (94, 95):
        scene = draw(scenario, case_of(scenario, "ladle", seed), seed)
        physics = scene.strategy.physics
        assert physics.target_density < physics.tool_density
        for name, assumed in ((scene.tools[0], physics.tool_density), (scene.target, physics.target_density)):
            assert assumed / FACTOR <= scene.thing(name).density <= FACTOR * assumed


def test_a_camera_sees_what_the_sensor_model_sees_and_moving_things_move_in_it():
    tool, ball = make("caliper", 1).mesh, make("sphere", 0, radius=0.04).mesh
    poses = {"tool": transforms.from_rpy(0, 0, 0.4, [0.5, 0.1, 0.02]), "ball": transforms.make(translation=[0.55, -0.1, 0.04])}
    pose = sensor.STATION["left"]
    camera = Camera("left", pose, Bodies({"tool": tool, "ball": ball}))
    quiet = sensor.Noise(
        *(np.zeros((480, 640), np.float32),),
        np.ones((480, 640)),
        np.ones((480, 640)),
        np.zeros((2, 480, 640), int),
        np.zeros((480, 640, 3)),
    )
    camera._noise = [quiet] * len(camera._noise)
    for _ in range(2):
        meshes = [tool.transformed(poses["tool"]), ball.transformed(poses["ball"])]
        frame = camera.picture(poses, 0)
        cast, true = sensor.scene_raycaster(meshes).perspective(sensor.D435, pose)
        rays = sensor.D435.unproject(np.ones((480, 640)))
        cosine = np.abs(np.einsum("hwi,hwi->hw", rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ pose[:3, :3].T, cast.normals))
        wanted = sensor.degrade(true, cosine, sensor.D435, 0, noise=quiet)
        assert np.mean(np.isnan(wanted) != np.isnan(frame.depth)) < 1e-4
        assert np.nanquantile(np.abs(wanted - frame.depth), 0.9999) <= 0.0021
        colour = sensor.capture(meshes, sensor.D435, pose, 0).color.astype(int)
        assert np.abs(colour - frame.color).mean() < 2.0
        poses["ball"] = transforms.make(translation=[0.5, -0.05, 0.1])
    gone = camera.picture({"tool": poses["tool"]}, 1)
    assert np.abs(gone.color.astype(int) - frame.color).max() > 50


def test_noise_is_new_in_each_frame_and_of_the_seed():
    camera = Camera("left", sensor.STATION["left"], Bodies({}))
    one, again, other = camera.picture({}, 1), camera.picture({}, 1), camera.picture({}, 2)
    np.testing.assert_array_equal(one.color, again.color)
    assert (one.color != other.color).mean() > 0.3 and np.nanstd(one.depth - other.depth) > 0.001


def test_every_scenario_can_be_drawn_and_stands():
    for scenario in SCENARIOS.values():
        scene = draw(scenario, scenario.cases[-1], 1)
        it = Lab(scene, robot())
        go(it, lambda it=it: it.time >= 0.3)
        for thing in scene.things:
            way = np.linalg.norm((it.world.pose(thing.name) - thing.item.world_from_object)[:3, 3])
            assert way < (0.005 if thing.kind == DYNAMIC else 1e-6), (scenario.name, thing.name, way)
