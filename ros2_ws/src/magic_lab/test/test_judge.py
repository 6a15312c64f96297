"""The truth is judged as the strategy's goal says: on tracks whose end is known."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from magic_core import transforms
from magic_core.contact import OPPOSED
from magic_core.errors import Code
from magic_core.shapes import make, mug_of_set
from magic_lab.judge import Replay, Track, judge, loop_in_sight, nearest
from magic_lab.scenarios import SCENARIOS, draw
from magic_lab.world import SETTINGS, Thing


@lru_cache
def scene(name):
    return draw(SCENARIOS[name], SCENARIOS[name].cases[0], 0)


def track(scene, moves, tcp, rate=20.0):
    """A track of (seconds, {name: pose}) way points, the hand at ``tcp(time)``."""
    times = np.arange(0, moves[-1][0] + 1e-9, 1 / rate)
    start = {thing.name: thing.item.world_from_object for thing in scene.things}
    at = np.array([time for time, _ in moves])
    poses = {n: transforms.interpolate(at, np.stack([m.get(n, start[n]) for _, m in moves]), times) for n in start}
    return Track(times, poses, np.stack([tcp(time, {n: p[k] for n, p in poses.items()}) for k, time in enumerate(times)]))


def shifted(pose, x):
    return transforms.make(translation=[x, 0, 0]) @ pose


@pytest.mark.parametrize("way, code", [(-0.22, Code.DRIFT), (-0.12, Code.LOST_CONTACT), (0.0, Code.LOST_CONTACT)])
def test_a_target_that_no_tool_holds_is_not_hooked_however_far_it_went(way, code):
    s = scene("hooking")
    target = s.thing("target").item.world_from_object
    tool = s.thing("tool_1").item.world_from_object
    moved = track(
        s, [(0, {}), (1, {"tool_1": shifted(tool, 0.05)}), (3, {"target": shifted(target, way), "tool_1": tool})], lambda _t, p: p["tool_1"]
    )
    assert judge(s, "tool_1", moved).code == code


def test_what_the_scenario_has_pushed_no_tool_has_moved():
    """A target that is nudged along the pull began where the nudge has put it."""
    s = scene("hooking")
    target, tool = s.thing("target").item.world_from_object, s.thing("tool_1").item.world_from_object
    moves = [(0, {}), (1, {"tool_1": shifted(tool, 0.05)}), (1.05, {"target": shifted(target, -0.1), "tool_1": shifted(tool, 0.05)})]
    moved = track(s, [*moves, (4, {"target": shifted(target, -0.25), "tool_1": tool})], lambda _t, p: p["tool_1"])
    assert "moved 150 mm" in judge(s, "tool_1", replace(moved, put={"target": shifted(target, -0.1)})).message
    assert "moved 250 mm" in judge(s, "tool_1", moved).message
    samples = [
        (t, {"hand": tool, **{n: p[k] for n, p in moved.poses.items()}, **({"target/put": target} if k > 9 else {})})
        for k, t in enumerate(moved.times)
    ]
    told = Track.of(samples, "hand")
    assert told.poses.keys() == moved.poses.keys() and told.put.keys() == {"target"}


def test_each_step_is_looked_at():
    """What presses is told by each step of the engine, and there are as many as the truth lasts."""
    s = scene("hooking")
    still = track(s, [(0, {}), (2, {})], lambda _t, p: p["tool_1"])
    run, steps = Replay(s, "tool_1", still), 0
    while run.time < run.duration - 1e-9:
        run.advance()
        steps += 1
    assert steps == round(2.0 * SETTINGS.frequency) == run.world.steps


def test_a_cup_on_the_rod_hangs_and_one_on_the_table_does_not():
    s = scene("hanging")
    cup = s.thing("tool_1").item.world_from_object
    lifted = transforms.make(translation=[0, 0, 0.3]) @ cup

    def hand(time, poses):
        # It leaves after two seconds.
        return transforms.make(translation=[-0.2 * max(0.0, time - 2.0), 0, 0]) @ poses["tool_1"]

    back = judge(s, "tool_1", track(s, [(0, {}), (1, {"tool_1": lifted}), (2, {}), (3.5, {})], hand))
    assert back.code in (Code.GOAL_NOT_REACHED, Code.LOST_CONTACT) and "fell" in back.message
    held = judge(s, "tool_1", track(s, [(0, {}), (1, {"tool_1": lifted}), (3.5, {"tool_1": lifted})], lambda _t, p: p["tool_1"]))
    assert held.code == Code.GOAL_NOT_REACHED and "never let go" in held.message
    floating = judge(s, "tool_1", track(s, [(0, {}), (1, {"tool_1": lifted}), (3.5, {"tool_1": lifted})], hand))
    assert floating.code != Code.OK, "nothing holds it up there"


def test_a_cup_hung_by_its_handle_passes():
    s = scene("hanging")
    region = s.strategy.target_contact
    rod = s.thing("target").item.world_from_object
    shape = mug_of_set(int(s.case.tools[0].partition(":")[2]))
    inside = shape.contact(next(iter(shape.regions)), shape.view(s.strategy.view), towards=(0, 0, -1))
    up = transforms.make(translation=[0, 0, 0.002])
    hung = up @ rod @ region.object_from_contact @ OPPOSED @ transforms.inverse(inside.object_from_contact)

    def hand(time, poses):
        return transforms.make(translation=[-0.2 * max(0.0, time - 2.0), 0, 0]) @ poses["tool_1"]

    found = judge(s, "tool_1", track(s, [(0, {}), (1, {"tool_1": hung}), (3.5, {"tool_1": hung})], hand))
    assert found.code == Code.OK, found.message
    # It does not where something that has no part in it was moved.
    beside = make("cylinder", 1, radius=0.02).as_object("beside", transforms.make(translation=[0.3, 0.4, 0.02]))
    s = replace(s, things=(*s.things, Thing(beside)))
    for way, code in ((0.03, Code.OBSTACLE_PUSHED), (0.005, Code.OK)):
        moves = [(0, {}), (1, {"tool_1": hung}), (3.5, {"tool_1": hung, "beside": shifted(beside.world_from_object, way)})]
        found = judge(s, "tool_1", track(s, moves, hand))
        assert found.code == code and ("beside by 30 mm" in found.message) == (code != Code.OK)
    # Nor where a bar beside it was turned about its middle.
    bar = make("peg", 1, length=0.12, side=0.02).as_object("beside", beside.world_from_object)
    s = replace(s, things=(*s.things[:-1], Thing(bar)))
    about, angle = transforms.make(translation=bar.mesh.bounds.mean(axis=0)), np.radians(30.0)
    turned = bar.world_from_object @ about @ transforms.from_rpy(0, 0, angle) @ transforms.inverse(about)
    moves = [(0, {}), (1, {"tool_1": hung}), (3.5, {"tool_1": hung, "beside": turned})]
    found = judge(s, "tool_1", track(s, moves, hand))
    assert found.code == Code.OBSTACLE_PUSHED
    assert f"beside by {60 * np.sin(angle) + 10 * np.cos(angle) - 10:.0f} mm" in found.message


def test_a_pull_ends_with_the_tool_and_not_with_what_rolls_on():
    s = scene("hooking")
    target, tool = s.thing("target").item.world_from_object, s.thing("tool_1").item.world_from_object
    pulled = {"target": shifted(target, -0.28), "tool_1": shifted(tool, -0.28)}
    moves = [(0, {}), (1, {}), (3.8, pulled), (5, {"target": shifted(target, -0.33), "tool_1": shifted(tool, -0.2)})]
    (phase,) = Replay(s, "tool_1", track(s, moves, lambda _t, p: p["tool_1"])).phases
    assert phase.start == pytest.approx(1.0, abs=0.1) and phase.end == pytest.approx(3.8, abs=0.1)
    # What moves without the tool, when an event pushes it, moves all the same.
    alone = [(0, {}), (1, {}), (3, {"target": shifted(target, -0.3)}), (4, {"target": shifted(target, -0.3)})]
    (phase,) = Replay(s, "tool_1", track(s, alone, lambda _t, p: p["tool_1"])).phases
    assert phase.end == pytest.approx(3.0, abs=0.1)


def test_another_target_that_was_chosen_is_judged():
    s = scene("hooking")
    ball = make("sphere", 1, radius=0.02).as_object("ball", transforms.make(translation=[0.3, 0.4, 0.02]))
    s = replace(s, things=(*s.things, Thing(ball)), target="ball")
    moved = track(s, [(0, {}), (1, {"ball": shifted(ball.world_from_object, -0.1)})], lambda _t, p: p["tool_1"])
    found = judge(s, "tool_1", moved)
    assert found.code == Code.LOST_CONTACT and "moved 100 mm" in found.message


def test_the_truth_begins_with_the_arm():
    s = scene("hooking")
    away = transforms.make(translation=[0.3, 0, 0.3])
    moved = track(s, [(0, {}), (8, {})], lambda time, _p: shifted(away, 0.1 * max(0.0, time - 6.0)))
    begun = moved.begun(0.01)
    assert (begun.times[0], begun.times[-1]) == pytest.approx((5.15, 8.0), abs=0.051)
    assert len(begun.times) == len(begun.tcp) == len(begun.poses["target"])
    assert track(s, [(0, {}), (2, {})], lambda _t, _p: away).begun(0.01) is None


def test_the_hand_and_what_it_holds():
    s = scene("hooking")
    tool = s.thing("tool_1").item.world_from_object
    way = [(0, {}), (1, {"tool_1": shifted(tool, 0.1)}), (2, {"tool_1": shifted(tool, 0.1)})]
    assert track(s, way, lambda _t, p: p["tool_1"]).let_go("tool_1") is None
    left = track(s, way, lambda t, p: transforms.make(translation=[0, 0, max(0.0, t - 1.0)]) @ p["tool_1"])
    assert left.times[left.let_go("tool_1")] == pytest.approx(1.05, abs=0.06)
    assert left.let_go("target") is None
    assert nearest({"a": np.array([0, 0, 9.0]), "b": np.array([1.0, 0, 0])}, np.array([0.2, 0, 0])) == "a"


def test_a_handle_behind_its_cup_is_out_of_every_cameras_sight():
    drawn = draw(SCENARIOS["hanging"], SCENARIOS["hanging"].cases[0], 22)  # the handle points at the robot, away from the cameras
    mug = drawn.thing("tool_1").item
    assert mug.world_from_object[0, 0] < -0.9
    assert loop_in_sight(drawn, "tool_1") < 0.01
    middle = transforms.make(translation=mug.world_from_box[:3, 3])
    shares = []
    for yaw in (np.pi / 2, np.pi, -np.pi / 2):
        pose = middle @ transforms.from_rpy(0.0, 0.0, yaw) @ transforms.inverse(middle) @ mug.world_from_object
        things = [replace(t, item=replace(t.item, world_from_object=pose)) if t.name == "tool_1" else t for t in drawn.things]
        shares.append(loop_in_sight(replace(drawn, things=tuple(things)), "tool_1"))
    assert min(shares) > 0.3 and max(shares) < 1.0
    hooks = draw(SCENARIOS["hooking"], SCENARIOS["hooking"].cases[0], 0)
    assert loop_in_sight(hooks, hooks.tools[0]) is None
