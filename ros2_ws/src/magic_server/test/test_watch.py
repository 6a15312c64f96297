"""What a moving arm is stopped by, and how often a goal is tried anew."""

import math
from dataclasses import replace

import numpy as np
import pytest

from magic_core.errors import Code, MagicError
from magic_server import scene_change
from magic_server.permission import Look
from magic_server.scene_change import Changed
from magic_server.watch import Bounds, SceneWatch, Unwatched

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.025
BEGAN = 1000.0
FAR = np.array([0.0, 0.0, 0.8])
ROBOT = frozenset({"robot"})


def look(places, after=0.0, came=0.0, partly=()):
    """Cubes of 50 mm along x, as a picture shows them some seconds after the move began."""
    hulls = {name: scene_change.hull(CORNERS + [x, 0, 0]) for name, x in places.items()}
    return Look(hulls, "base", BEGAN + after, came, dict.fromkeys(partly, ROBOT))


TABLE = {"tool": 0.0, "target": 0.2, "cup": 0.5}


def watch(meant=("tool",), contact=math.inf):
    return SceneWatch(look(TABLE), meant, "target", contact, 0.03, 5.0)


def take(watching, places, after=1.0, partly=(), hand=FAR):
    watching.take(look(places, after, came=after, partly=partly), BEGAN, BEGAN + after + 0.3, after + 0.1, hand)


def test_what_stays_or_is_moved_on_purpose_stops_nothing():
    watching = watch(contact=4.0)
    take(watching, TABLE)
    take(watching, {**TABLE, "tool": 0.4, "target": 0.21, "hand": 0.1}, 2.0)
    take(watching, {"target": 0.2, "cup": 0.5}, 3.0)
    take(watching, {"target": 0.9, "cup": 0.5}, 5.0)  # the tool has met it by then
    take(watching, {"cup": 0.5}, 6.0)


@pytest.mark.parametrize(
    "places, says",
    [({**TABLE, "target": 0.24}, "target has moved while the arm moved, in mm: 3"), ({**TABLE, "cup": 0.4}, "cup has moved")],
)
def test_what_moves_stops_the_arm(places, says):
    with pytest.raises(Changed, match=says) as caught:
        take(watch(), places)
    assert caught.value.code == Code.SCENE_CHANGED


def test_what_is_missed_in_one_picture_has_not_gone():
    watching, without = watch(), {"tool": 0.0, "target": 0.2}
    take(watching, without, 1.0)
    take(watching, without, 1.0)  # the same picture again
    take(watching, TABLE, 2.0)
    take(watching, without, 3.0)
    with pytest.raises(Changed, match="cup has gone"):
        take(watching, without, 4.0)


@pytest.mark.parametrize("cup", [{"cup": 0.7}, {}])
def test_what_stands_where_a_thing_stood_is_that_thing_by_another_id(cup):
    watching = watch()
    for number in range(1, 4):
        take(watching, {"tool": 0.0, "target": 0.2, **cup, "object_9": 0.505}, float(number))
    with pytest.raises(Changed, match="cup has"):
        for number in (4, 5):
            take(watching, {"tool": 0.0, "target": 0.2, **cup, "object_9": 0.52}, float(number))


def test_what_the_hand_may_hide_has_not_gone():
    watching = watch()
    for number in range(1, 6):
        take(watching, {"tool": 0.0, "target": 0.2}, float(number), hand=np.array([0.4, 0.1, 0.2]))  # the cup is at 0.5 m


def test_of_what_the_arm_hides_in_part_only_what_sticks_out_counts():
    half = look({"cup": 0.5}).objects["cup"]
    corners = CORNERS[CORNERS[:, 0] > 0] + [0.5, 0, 0]  # the half of it that the arm leaves in sight
    assert scene_change.distance(half, scene_change.hull(corners)) > 0.03
    assert scene_change.gap(half, scene_change.hull(corners), True) == 0.0
    watching = watch()
    hidden = look(TABLE, 1.0, 1.0, ("cup",))
    hidden.objects["cup"] = scene_change.hull(corners)
    watching.take(hidden, BEGAN, BEGAN + 1.3, 1.1, FAR)
    with pytest.raises(Changed, match="cup has moved"):
        take(watch(), {**TABLE, "cup": 0.55}, partly=("cup",))


def test_a_thing_that_the_arm_parts_in_two_is_there_but_what_comes_elsewhere_is_not_it():
    left, right = (scene_change.hull(CORNERS[side * CORNERS[:, 0] > 0] + [0.5, 0, 0]) for side in (-1, 1))
    for ids in (("cup", "object_8"), ("object_8", "object_9")):
        watching = watch()
        for number in (1, 2, 3):
            parted = look({"target": 0.2}, number, number)
            parted = replace(parted, objects={**parted.objects, **dict(zip(ids, (left, right)))}, cut_off=dict.fromkeys(ids, ROBOT))
            watching.take(parted, BEGAN, BEGAN + number + 0.3, number + 0.1, FAR)
    watching = watch()
    with pytest.raises(Changed, match="cup has gone"):
        for number in (1, 2):  # moved away, and hidden in part there
            moved = look({"target": 0.2, "object_8": 0.62}, number, number, ("object_8",))
            watching.take(moved, BEGAN, BEGAN + number + 0.3, number + 0.1, FAR)


def test_what_was_hidden_when_it_was_planned_is_held_to_what_was_seen_of_it():
    """What cuts a thing off as it did then hides nothing new: it is compared as a whole."""
    planned = replace(look(TABLE), cut_off={"cup": frozenset({"target"})})
    for by, raises in (("target", True), ("tool", False)):
        watching = SceneWatch(planned, ("tool",), "target", math.inf, 0.03, 5.0)
        half = scene_change.hull(CORNERS[CORNERS[:, 0] > 0] + [0.5, 0, 0])
        seen = look(TABLE, 1.0, 1.0)
        seen = replace(seen, objects={**seen.objects, "cup": half}, cut_off={"cup": frozenset({by})})
        if raises:
            with pytest.raises(Changed, match="cup has moved"):
                watching.take(seen, BEGAN, BEGAN + 1.3, 1.1, FAR)
        else:
            watching.take(seen, BEGAN, BEGAN + 1.3, 1.1, FAR)


def test_what_was_hidden_when_it_was_planned_is_watched_once_it_is_seen():
    planned = look({"tool": 0.0, "target": 0.2})
    planned = replace(planned, remembered=look({"cup": 0.5}).objects)
    watching = SceneWatch(planned, ("tool",), "target", math.inf, 0.03, 5.0)
    take(watching, {"tool": 0.0, "target": 0.2}, 1.0)
    take(watching, {"tool": 0.0, "target": 0.2}, 2.0)
    take(watching, TABLE, 3.0)
    with pytest.raises(Changed, match="cup has moved"):
        take(watching, {**TABLE, "cup": 0.56}, 4.0)


@pytest.mark.parametrize("seen", [None, look(TABLE, after=-6.0, came=0.0), look(TABLE, after=0.0, came=-6.0), look(TABLE, after=math.nan)])
def test_an_arm_is_not_moved_blindly(seen):
    with pytest.raises(Unwatched, match="not moved blindly"):
        watch().take(seen, BEGAN, BEGAN + 0.3, 0.1, FAR)


def test_tries_are_bounded_in_number_and_time():
    error = MagicError(Code.GRASP_FAILED, "closed on nothing")
    bounds = Bounds(executions=3, replans=1, end=10.0)
    bounds.fail(error, 1.0)
    bounds.fail(error, 2.0)
    with pytest.raises(MagicError, match="3 executions are over") as caught:
        bounds.fail(error, 3.0)
    assert caught.value.code == Code.GRASP_FAILED
    bounds.elsewhere(error, Code.SCENE_CHANGED, 3.0)
    with pytest.raises(MagicError, match="planned anew 1 times") as caught:
        bounds.elsewhere(error, Code.SCENE_CHANGED, 3.0)
    assert caught.value.code == Code.SCENE_CHANGED
    for late in (Bounds(3, 3, 10.0).fail, lambda e, now: Bounds(3, 3, 10.0).elsewhere(e, Code.SCENE_CHANGED, now)):
        with pytest.raises(MagicError, match="the time for trying again is over"):
            late(error, 10.0)
