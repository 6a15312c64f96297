"""Which way a target is led among other things, on scenes whose free ways are known."""

from dataclasses import replace

import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.scene import Scene
from magic_core.strategy import Waypoint, load, save
from magic_matcher import clear_way, matching
from magic_matcher.features import load as load_features
from magic_matcher.selection import alike

RADIUS = 0.025
#: Where the cylinder stands that is pulled towards -x by 0.2 m.
AT = np.array([0.6, 0.0])


@pytest.fixture(scope="module")
def pulling(demonstration):
    def at(name, x, z, phase):
        return Waypoint(name, np.array([x, 0.0, z]), phase)

    way = (at("above", 0.03, -0.12, "approach"), at("behind", 0.03, 0.0, "approach"), at("touch", 0.0, 0.0, "contact"))
    way += (at("pulled", -0.2, 0.0, "goal"), at("up", -0.2, -0.12, "retreat"))
    return replace(demonstration, waypoints=way, turned_by=np.deg2rad(40.0))


@pytest.fixture(scope="module")
def matcher():
    return matching.Matcher(load_features("embedded"))


def cylinder(name="target", at=AT, radius=RADIUS):
    item = shapes.make("cylinder", 1, radius=radius)
    return item.as_object(name, transforms.make(translation=[*at, radius]))


def in_the_way(angle, far=0.15, radius=0.015, name="other"):
    """A small thing on the way that is turned by an angle, degrees."""
    turn = np.deg2rad(angle)
    return cylinder(name, AT - far * np.array([np.cos(turn), np.sin(turn)]), radius)


def contacts(pulling, matcher, target):
    return clear_way.contacts_of(matcher, pulling, target)


def candidate(pulling, matcher):
    return ContactCandidate("tool", pulling.tool_contact, contacts(pulling, matcher, cylinder())(0.0), 0.0, False, 1.0, 1.0, 1.0, np.eye(4))


def best(pulling, matcher, *others, tool=None):
    target = cylinder()
    ways = clear_way.Ways(pulling, target, [target, *others], contacts(pulling, matcher, target))
    return ways.best(candidate(pulling, matcher), tool)


def test_alone_a_candidate_is_led_as_it_is(pulling, matcher):
    target, one = cylinder(), candidate(pulling, matcher)
    tool = shapes.make("l_hook", 1).as_object("tool", transforms.make(translation=[0.45, 0.0, 0.01]))
    led = clear_way.lead(pulling, [one], target, [target, tool], contacts(pulling, matcher, target))
    assert led.candidates == led.clear and led.candidates[0] is one and led.worth == one.score


def test_a_way_that_is_clear_is_the_one_shown(pulling, matcher):
    way = best(pulling, matcher, cylinder("other", AT + [0.0, 0.2]))
    assert way.turn == 0.0 and not way.pushed and way.room >= clear_way.ROOM


@pytest.mark.parametrize(("offset", "turn"), [(8.0, -20.0), (-8.0, 20.0)])
def test_the_least_turn_past_what_is_in_the_way(pulling, matcher, offset, turn):
    """0.15 m on, a thing of 15 mm radius 8 degrees to one side: 40 mm and the room asked for are 20 degrees to the other."""
    way = best(pulling, matcher, in_the_way(offset))
    assert np.degrees(way.turn) == pytest.approx(turn)


def test_turned_the_target_is_met_on_the_side_from_which_it_is_pulled(pulling, matcher):
    target = cylinder()
    led = clear_way.lead(pulling, [candidate(pulling, matcher)], target, [target, in_the_way(8.0)], contacts(pulling, matcher, target))
    (found,) = led.candidates
    world = target.world_from_object @ found.target.object_from_contact
    np.testing.assert_allclose(world[:3, 0], [np.cos(found.turn), np.sin(found.turn), 0.0], atol=0.02)
    np.testing.assert_allclose(world[:2, 3], AT + RADIUS * world[:2, 0], atol=0.002)
    np.testing.assert_allclose(pulling.turned(found.turn).target_normal, world[:3, 0], atol=0.02)


def test_the_tool_needs_room_as_well_and_is_not_in_its_own_way(pulling, matcher):
    """Beside the target's way there is room for that, but not for the hook's arms, on both sides."""
    tool = shapes.make("l_hook", 1).as_object("tool", transforms.make(translation=[0.45, 0.0, 0.01]))
    beside = [cylinder(f"beside_{k}", AT + [-0.1, side * 0.06], 0.01) for k, side in enumerate((-1, 1))]
    alone = best(pulling, matcher, *beside)
    with_tool = best(pulling, matcher, *beside, tool=tool)
    assert alone.turn == 0.0 and with_tool.room < alone.room
    assert best(pulling, matcher, tool, tool=tool).turn == 0.0  # it lies in the way until it is taken up
    assert best(pulling, matcher, tool).pushed or best(pulling, matcher, tool).turn != 0.0


def test_what_is_in_the_way_everywhere_is_named(pulling, matcher):
    wall = [in_the_way(angle, name=f"wall_{angle}") for angle in range(-40, 41, 10)]
    target = cylinder()
    led = clear_way.lead(pulling, [candidate(pulling, matcher)], target, [target, *wall], contacts(pulling, matcher, target))
    assert not led.clear and led.worth == 0.0
    error = clear_way.blocked(pulling, target, led, [target, *wall])
    assert error.code is Code.WAY_BLOCKED and "wall_" in error.message and "target" in error.message and "40 degrees" in error.message


def test_of_two_like_targets_the_one_that_can_be_led(pulling, matcher):
    tool = shapes.make("l_hook", 1).as_object("tool", transforms.make(translation=[0.4, -0.35, 0.01]))
    wall = [in_the_way(angle, name=f"wall_{angle}", radius=0.012) for angle in range(-40, 41, 10)]
    free = cylinder("free", [0.6, 0.4], 0.0255)
    scene = Scene((tool, *wall, cylinder(), free), np.array([0, 0, 1.0, 0]))
    assert [item.id for item in alike(pulling, scene.objects, matcher.target_view)] == ["target", "free"]

    def match(tools, target):
        return matcher.match(pulling, [item for item in tools if item.id == "tool"], target, 2)

    assert clear_way.match_led(matcher, match, pulling, scene, ["tool"], "").target_id == "free"
    with pytest.raises(MagicError) as error:
        clear_way.match_led(matcher, match, pulling, scene, ["tool"], "target")
    assert error.value.code is Code.WAY_BLOCKED
    # Of a strategy that allows no turn nothing is looked at.
    assert clear_way.match_led(matcher, match, replace(pulling, turned_by=0.0), scene, ["tool"], "target").candidates


def test_a_turn_is_kept_in_the_file_and_refused_beyond_what_it_says(pulling, tmp_path):
    save(pulling, tmp_path / "s")
    assert load(tmp_path / "s").turned_by == pytest.approx(pulling.turned_by)
    with pytest.raises(MagicError) as error:
        pulling.turned(np.deg2rad(41.0))
    assert error.value.code is Code.BAD_REQUEST and "40 degrees" in error.value.message
    assert pulling.turned(0.0) is pulling
    text = (
        (tmp_path / "s" / "strategy.yaml")
        .read_text()
        .replace("view_direction_in_world: [0.0, 0.0, -1.0]", "view_direction_in_world: [0.0, 1.0, 0.0]")
    )
    (tmp_path / "s" / "strategy.yaml").write_text(text)
    with pytest.raises(MagicError) as error:
        load(tmp_path / "s")
    assert error.value.code is Code.BAD_STRATEGY and "turned_by" in error.value.message
