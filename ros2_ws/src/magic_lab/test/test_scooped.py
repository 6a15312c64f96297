"""A ball in the bowl that the hand holds, and balls that are not in it, as two cameras see them: what is told of the goal."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from magic_core import conversions, sensor, transforms
from magic_core.camera import NEARLY, SURELY
from magic_core.self_filter import Body, Margins, shown
from magic_lab.cameras import Bodies, Camera
from magic_lab.scenarios import SCENARIOS, case_of, draw
from magic_perception.averaging import average
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive
from magic_perception.robot_in_view import DRAWN, IN_HAND
from magic_server.after_task import After, thing
from magic_server.held import Carried, Held
from magic_server.seen_goal import Hand, SeenGoal, Sight, judge
from magic_server.stages import hull_of

#: Where hand and bowl are at the end, as they were in trials, and where the ball is in it.
ENDS = {
    "measuring_cup": (
        transforms.from_rotvec([1.719, -1.694, 0.75], [0.5193, -0.0474, 0.261]),
        transforms.from_rotvec([-0.15, -0.141, -1.559], [0.5194, -0.0442, 0.248]),
        [0.5201, -0.1243, 0.2838],
    ),
    "ladle": (
        transforms.from_rotvec([2.091, -1.977, 0.262], [0.5213, -0.0207, 0.3085]),
        transforms.from_rotvec([0.033, -0.005, -1.561], [0.5209, -0.0208, 0.3114]),
        [0.5225, -0.1205, 0.2854],
    ),
}
PHASES, ACCURACY = ("grasp", "approach", "contact", "goal"), 0.005
#: The arm is out of the pictures.
ARM = Hand(False, None, np.array([[0.0, 0.0, 1.0]]))


@lru_cache
def scene(case):
    return draw(SCENARIOS["scooping"], case_of(SCENARIOS["scooping"], case, 300), 300)


@lru_cache
def cameras(case):
    bodies = Bodies({one.name: one.item.mesh for one in scene(case).things})
    return [Camera(name, pose, bodies) for name, pose in sensor.STATION.items()]


def seen(case, poses, look, held=None):
    """What perception makes of bodies at poses, the arm out of sight; look: a number of its own for the noise;
    held: a mesh and its pose in the hand."""
    fixed = {item.id: item.world_from_object for item in scene(case).known}
    frames = []
    for number, camera in enumerate(cameras(case)):
        frame = average([camera.picture({**fixed, **poses}, [70, 3 * look + k, number], float(look)) for k in range(3)])
        if held is not None:
            near, sure = (shown(frame, Body(held[0]), [held[1]], margins) for margins in (Margins(space=IN_HAND), DRAWN))
            frame = replace(frame, held=np.where(sure, SURELY, np.where(near, NEARLY, 0)).astype(np.uint8))
        frames.append(frame)
    region = Parameters(region_low=(0.15, -0.6, -0.05), region_high=(0.95, 0.6, 0.5))
    return conversions.scene_to_msg(perceive(frames, scene(case).known, region))


@lru_cache
def before(case):
    """The scene before, as perceived, with tool and target by their true names."""
    true = {name: scene(case).thing(name).item for name in ("tool_1", "target")}
    message = seen(case, {name: item.world_from_object for name, item in true.items()}, 100)
    for item in message.objects:
        place = conversions.pose_from_msg(item.box_pose)[:3, 3]
        if item.source == "camera":
            middles = {n: transforms.apply(one.world_from_object, one.mesh.bounds.mean(axis=0)) for n, one in true.items()}
            item.id = min(middles, key=lambda name: float(np.linalg.norm(middles[name] - place)))
    return message


def told(case, ball, slipped=(0.0, 0.0, 0.0), handed_on=False):
    """What is told of the goal with the ball at a place (3,; None: nowhere) and the bowl so far (3,) from where it was grasped;
    handed_on: what is seen of the bowl goes by the ball's id."""
    world_from_hand, world_from_tool, _ = ENDS[case]
    tool = next(item for item in before(case).objects if item.id == "tool_1")
    seen_from_true = transforms.inverse(scene(case).thing("tool_1").item.world_from_object) @ conversions.pose_from_msg(tool.pose)
    held = Held(tool, transforms.inverse(world_from_tool @ seen_from_true) @ world_from_hand)
    stood = {item.id: hull_of(item) for item in before(case).objects}
    after = After(before(case), stood, "tool_1", "target", Carried(held), held, 1, 0.02, ACCURACY)
    poses = {"tool_1": transforms.make(translation=slipped) @ world_from_tool}
    if ball is not None:
        poses["target"] = transforms.from_rotvec([2.0, 0.4, 0.1], ball)
    sights = []
    for look in (1, 2):
        message = seen(case, poses, look, (held.mesh, held.pose(world_from_hand)))
        for item in message.objects:
            near = np.linalg.norm(conversions.pose_from_msg(item.box_pose)[:3, 3] - world_from_tool[:3, 3])
            item.id = item.id if item.source == "known" else "target" if handed_on and near < 0.15 else f"new_{item.id}"
        sights.append(after.sights(message, lambda _: world_from_hand))
    first = Sight({item.id: thing(item) for item in before(case).objects}, 0.0)
    names, table = {"tool": "tool_1", "target": "target"}, conversions.plane_from_msg(before(case).table)
    return SeenGoal.of_all(
        [judge(scene(case).strategy, names, PHASES, (first, sights[0][0], now), table, ARM, ACCURACY) for now in sights[1]]
    )


@pytest.mark.parametrize("case", list(ENDS))
@pytest.mark.parametrize("handed_on", [False, True])
def test_a_ball_that_looks_over_the_rim_is_seen_to_lie_in_the_bowl(case, handed_on):
    found = told(case, ENDS[case][2], handed_on=handed_on)
    assert found.met, found.message


@pytest.mark.parametrize("case", list(ENDS))
@pytest.mark.parametrize("handed_on", [False, True])
def test_a_ball_that_fell_beside_is_seen_to_lie_there(case, handed_on):
    found = told(case, [0.62, 0.10, 0.035], handed_on=handed_on)
    assert found.met is False and "above the table" in found.message


@pytest.mark.parametrize("case", list(ENDS))
@pytest.mark.parametrize("slipped", [(0.0, 0.0, 0.0), (0.0, 0.015, -0.02), (0.03, 0.0, -0.03)])
@pytest.mark.parametrize("handed_on", [False, True])
def test_of_a_ball_that_no_camera_sees_nobody_says_that_it_is_in_the_bowl(case, slipped, handed_on):
    """Nor of the bowl itself, elsewhere than the hand has it."""
    found = told(case, None, slipped, handed_on)
    assert found.met is None, found.message


def test_a_ball_that_floats_above_the_bowl_is_not_in_it():
    x, y, z = ENDS["measuring_cup"][2]
    found = told("measuring_cup", [x, y, z + 0.05])
    assert not found.met, found.message
