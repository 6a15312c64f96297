"""Goals asked of what cameras see: yes, no, or that it cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from magic_core import goal, transforms
from magic_core.mesh import from_trimesh
from magic_server.seen_goal import APART, Hand, SeenGoal, Sight, Thing, judge, patience
from magic_server.testing import fakes

TABLE = np.array([0.0, 0.0, 1.0, 0.0])
NAMES = {"tool": "object_1", "target": "object_2"}
CYLINDER = from_trimesh(trimesh.creation.cylinder(0.03, 0.06))
RING = from_trimesh(trimesh.creation.annulus(0.03, 0.035, 0.02))
UPRIGHT = RING.transformed(transforms.from_rpy(0.0, np.pi / 2, 0.0))


def at(x, y=0.0, z=0.03, mesh=CYLINDER):
    return Thing.of(mesh, transforms.make(translation=[x, y, z]))


#: The phases of a pull.
PULL = ("approach", "contact", "goal", "retreat")
#: A hand that has let go, and gone away.
AWAY = Hand(True, 0.08)


def asked(test, before, now, hand=Hand(False), then=None, seconds=1.0, strategy=None, phases=PULL, accuracy=0.005):
    strategy = strategy or fakes.strategy()
    strategy = replace(strategy, goal=goal.shipped(test) if isinstance(test, str) else test)
    looks = Sight(before, 90.0), Sight(now if then is None else then, 100.0), Sight(now, 100.0 + seconds)
    return judge(strategy, NAMES, phases, looks, TABLE, hand, accuracy)


def tree(data, **beside):
    return goal.from_data({"test": data, **beside})


BESIDE = {"object_1": at(0.3, 0.2), "object_2": at(0.5)}


@pytest.mark.parametrize(
    "place, met, says",
    [
        ((0.29, 0.002), True, "moved 210 mm of 200"),
        ((0.35, 0.002), False, "moved 150 mm of 200"),
        ((0.298, 0.002), None, "moved 202 mm of 200, known to 5 mm"),
        ((0.29, 0.03), False, "drifted 30 mm sideways, allowed 15"),
        ((0.29, 0.012), None, "drifted 12 mm sideways, allowed 15, known to 5 mm"),
    ],
)
def test_a_pull_is_seen(place, met, says):
    found = asked("hook", BESIDE, {**BESIDE, "object_2": at(*place)})
    assert found.met is met and says in found.message, found.message


def test_what_is_not_seen_any_more_is_not_said_to_be_met_or_missed():
    found = asked("hook", BESIDE, {"object_1": at(0.3, 0.2)})
    assert found.met is None and "object_2 is not seen" in found.message


def test_what_is_seen_in_part_is_known_less_well():
    half = replace(at(0.27), points=at(0.27).points[at(0.27).points[:, 0] > 0.27])
    found = asked("hook", BESIDE, {**BESIDE, "object_2": half})
    assert found.met is None and "known to 20 mm" in found.message


def test_what_rolls_on_is_seen_to_roll():
    found = asked("hook", BESIDE, {**BESIDE, "object_2": at(0.2)}, then={**BESIDE, "object_2": at(0.28)}, seconds=0.1)
    assert found.met is False and "moved 80 mm in 0.1 s" in found.message


ROD = from_trimesh(trimesh.creation.box([0.2, 0.012, 0.012]))
STAND = {"object_1": at(0.3, 0.2, 0.01, RING), "object_2": at(0.5, 0.0, 0.4, ROD)}


@pytest.mark.parametrize(
    "where, hand, met, says",
    [
        ((0.5, 0.0, 0.376), AWAY, True, "let go"),
        ((0.5, 0.0, 0.376), AWAY, True, "the hand is 80 mm from where it let go, needed 30"),
        ((0.5, 0.0, 0.376), Hand(True, 0.01), False, "the hand is 10 mm from where it let go, needed 30"),
        ((0.5, 0.0, 0.376), Hand(True), None, "how far the hand has gone away is not known"),
        ((0.5, 0.0, 0.376), Hand(False), False, "in the hand"),
        ((0.5, 0.05, 0.01), AWAY, False, "10 mm above the table"),
        # High up, with nothing near that could hold it: something is wrong with what is seen.
        ((0.5, 0.2, 0.3), AWAY, False, "mm from the target"),
    ],
)
def test_a_ring_on_a_rod_is_seen_to_hang(where, hand, met, says):
    phases = ("grasp", "transfer", "contact", "release", "retreat")
    found = asked("hang", STAND, {**STAND, "object_1": at(*where, UPRIGHT)}, hand, phases=phases)
    assert found.met is met and says in found.message, found.message


@pytest.mark.parametrize(
    "swung, height, met, moving",
    [(0.0, 0.376, True, False), (0.018, 0.376, None, True), (0.04, 0.376, False, True), (0.04, 0.1, False, False)],
)
def test_what_swings_would_be_met_at_rest_and_what_fell_would_not(swung, height, met, moving):
    phases = ("grasp", "transfer", "contact", "release", "retreat")
    places = [{**STAND, "object_1": at(0.5, y, height, UPRIGHT)} for y in (swung, 0.0)]
    found = asked("hang", STAND, places[1], AWAY, then=places[0], phases=phases)
    assert (found.met, found.moving) == (met, moving), found.message


def test_what_swings_may_touch_where_it_comes_to_rest():
    """A mean of pictures of what swings lies beside it: whether it touches cannot be told before it rests, and
    then it is no question of time any more."""
    phases = ("grasp", "transfer", "contact", "release", "retreat")
    for swung, moving in ((0.012, True), (0.0, False)):
        places = [{**STAND, "object_1": at(0.5, y, 0.385, UPRIGHT)} for y in (swung, 0.0)]
        found = asked("hang", STAND, places[1], AWAY, then=places[0], phases=phases)
        assert found.met is None and found.moving is moving and "mm from the target" in found.message


def test_what_touches_in_one_place_is_not_seen_apart():
    """Points that stand for surfaces lie beside the place where they touch, not on it."""
    cup, rod = from_trimesh(trimesh.creation.annulus(0.04, 0.045, 0.1)), ROD.transformed(transforms.from_rpy(np.pi / 4, 0.0, 0.0))
    now = {"object_1": at(0.5, 0.0, 0.4, cup), "object_2": at(0.5, 0.045 + 0.006 * np.sqrt(2), 0.4, rod)}
    assert asked(tree({"touching": {"what": "tool", "whom": "target"}}), BESIDE, now, accuracy=0.002).met


@pytest.mark.parametrize(
    "gap, whole, span, met",
    [
        # What is seen of a thing ends 12 mm before a fixture that it touches; of one whose shape is laid on what is seen all is there.
        (0.016, False, None, None),
        (0.016, True, None, False),
        (0.04, False, None, False),
        # Some part of it: what is not seen may reach the rod, from a ring of 70 mm if all of that is no longer than 120 mm.
        (0.04, False, 0.12, None),
        (0.08, False, 0.12, False),
    ],
)
def test_what_is_seen_apart_may_touch_where_not_all_of_it_is_seen(gap, whole, span, met):
    """The rod is 12 mm thick and the ring hangs below it, 70 mm high."""
    low = replace(at(0.5, 0.0, 0.394 - gap - 0.035, UPRIGHT), whole=whole, span=span)
    now = {"object_1": low, "object_2": replace(STAND["object_2"], given=True, whole=True)}
    found = asked(tree({"touching": {"what": "tool", "whom": "target"}}), BESIDE, now)
    assert found.met is met, found.message
    assert found.unsure == (met is None and span is not None)
    assert found.message.startswith("what is seen of the tool is" if met is None else "the tool is")


def test_of_a_part_that_is_seen_only_what_holds_of_all_of_it_is_told():
    above = tree({"above": {"what": "tool", "height": 0.2}})
    part = at(0.5, 0.0, 0.25, UPRIGHT)
    assert asked(above, STAND, {"object_1": part}).met
    found = asked(above, STAND, {"object_1": part.part(0.2)})
    assert found.met is None and found.unsure and "known to 70 mm" in found.message
    assert asked(above, STAND, {"object_1": at(0.5, 0.0, 0.05, UPRIGHT).part(0.2)}).met is False
    rest = tree({"at_rest": {"what": "tool", "below": 0.02}})
    assert asked(rest, STAND, {"object_1": part}, then={"object_1": replace(part, middle=part.middle + 0.03)}).met is False
    assert asked(rest, STAND, {"object_1": part.part(0.2)}, then={"object_1": replace(part, middle=part.middle + 0.03)}).met is None
    on = tree({"touching": {"what": "tool", "whom": "table"}})
    for height, met in ((0.1, None), (0.3, False)):
        assert asked(on, STAND, {"object_1": at(0.5, 0.0, height, UPRIGHT).part(0.2)}).met is met


def test_what_holds_in_some_of_the_places_where_the_tool_may_be_is_not_told():
    met, missed = SeenGoal(True, "it hangs"), SeenGoal(False, "it is 20 mm away")
    assert SeenGoal.of_all([met, met]) is met and SeenGoal.of_all([missed, missed]) is missed
    found = SeenGoal.of_all([met, missed])
    assert found.met is None and found.unsure and found.message.endswith("goes with 2 poses of it, in some of which it is 20 mm away")


def test_what_rolls_on_after_it_had_to_stand_is_not_waited_for():
    found = asked("hook", BESIDE, {**BESIDE, "object_2": at(0.2)}, then={**BESIDE, "object_2": at(0.28)}, seconds=0.1)
    assert found.met is False and not found.moving


def test_what_hangs_beside_something_else_may_hang_on_that():
    now = {**STAND, "object_1": at(0.5, 0.0, 0.376, UPRIGHT), "object_3": at(0.5, 0.0, 0.31)}
    found = asked("hang", STAND, now, AWAY)
    assert found.met is None and "from the object_3" in found.message


def test_what_leans_on_the_hand_may_be_held_by_it():
    now = {**STAND, "object_1": at(0.5, 0.0, 0.376, UPRIGHT)}
    finger = at(0.5, 0.0, 0.376, UPRIGHT).points.mean(axis=0) + np.array([[0.0, 0.0, -0.05]])
    apart = np.linalg.norm(now["object_1"].points - finger, axis=1).min()
    assert asked("hang", STAND, now, replace(AWAY, points=finger - [0, 0, 0.05])).met
    beside = finger + [0, 0, apart - 0.004]
    found = asked("hang", STAND, now, replace(AWAY, points=beside))
    assert found.met is None and "from the hand" in found.message


def test_what_no_camera_tells_is_said():
    found = asked(tree({"upright": {"what": "target"}}), BESIDE, BESIDE)
    assert found.met is None and "no camera tells" in found.message
    assert asked("drive", BESIDE, {**BESIDE, "object_2": at(0.495)}).met is None  # 5 mm are not seen


def test_of_a_row_the_target_alone_is_seen():
    gone = {**BESIDE, "object_2": at(0.35)}
    assert asked("sweep", BESIDE, BESIDE).met is False  # of the row it is one, and did not go along
    found = asked("sweep", BESIDE, gone)
    assert found.met is None and "of what stands beside the target nothing is looked at" in found.message
    row = {"moved": {"what": "row", "along": "pull", "by": 0.1}}
    assert asked(tree(row), BESIDE, gone).met is True, "where nothing is put beside it, it is the row"
    assert asked(tree({"not": row}, trial={"row": {"others": 1}}), BESIDE, gone).met is None


STILL = {"stayed": {"what": "target", "within": 0.02}}
MOVED = {"moved": {"what": "target", "along": "up", "by": 0.1}}
UNKNOWN = {"upright": {"what": "target"}}
ENCLOSES = {"encloses": {"along": "pull"}}
TURNS = {"at_rest": {"what": "target", "below": 0.05, "turning": 0.1}}


@pytest.mark.parametrize(
    "data, met",
    [
        ({"all": [STILL, MOVED]}, False),
        ({"all": [STILL, UNKNOWN]}, None),
        ({"all": [UNKNOWN, STILL]}, None),
        ({"all": [MOVED, UNKNOWN]}, False),
        ({"all": [UNKNOWN, MOVED]}, False),
        ({"any": [STILL, UNKNOWN]}, True),
        ({"any": [UNKNOWN, STILL]}, True),
        ({"any": [MOVED, UNKNOWN]}, None),
        ({"not": MOVED}, True),
        ({"not": UNKNOWN}, None),
        ({"all": [{"any": [STILL, UNKNOWN]}, STILL]}, True),
        ({"inside": {"what": "target", "low": [0.4, -0.1, 0.0], "high": [0.6, 0.1, 0.1], "of": "world"}}, True),
        # What only a simulation tries decides neither an 'any' nor a 'not', wherever below it stands.
        (ENCLOSES, None),
        ({"any": [ENCLOSES, MOVED]}, None),
        ({"any": [ENCLOSES, STILL]}, True),
        ({"any": [{"all": [ENCLOSES, STILL]}, MOVED]}, None),
        ({"any": [{"all": [ENCLOSES, MOVED]}, MOVED]}, False),
        ({"any": [ENCLOSES]}, None),
        ({"all": [{"any": [ENCLOSES]}, STILL]}, None),
        ({"not": ENCLOSES}, None),
        ({"not": {"all": [STILL, ENCLOSES]}}, None),
        ({"not": {"all": [MOVED, ENCLOSES]}}, True),
        ({"all": [STILL, TURNS]}, True),
        ({"not": TURNS}, None),
        ({"any": [TURNS, MOVED]}, None),
    ],
)
def test_groups_and_their_opposites(data, met):
    found = asked(tree(data), BESIDE, BESIDE)
    assert found.met is met, found.message


def test_what_is_left_out_of_an_all_is_said():
    push = {"after": {"push": {"what": "target", "speed": 0.1}}, "all": [STILL]}
    found = asked(tree({"all": [STILL, TURNS, ENCLOSES, push]}), BESIDE, BESIDE)
    assert found.met is True
    said = found.message.partition("not looked at: ")[2]
    for words in ("how fast the target turns", "that pulled on along the pull", "how it is after the target was pushed from all sides"):
        assert words in said, found.message
    assert "not looked at" not in asked(tree({"all": [ENCLOSES, MOVED]}), BESIDE, BESIDE).message
    assert asked(tree(push), BESIDE, BESIDE).met is None


FAR = {"moved": {"what": "target", "along": "pull", "by": 0.1}}
TOUCHES = {"touching": {"what": "target", "whom": "tool"}}


@pytest.mark.parametrize(
    "phase, phases, met",
    [
        ("goal", PULL, True),
        ("contact", PULL, None),
        ("approach", PULL, None),
        ("retreat", PULL, None),
        ("goal", ("grasp", "transfer", "contact", "goal", "release", "retreat"), None),
        ("release", ("grasp", "transfer", "contact", "goal", "release", "retreat"), True),
        # The goal that no phase has is the motion's end.
        ("goal", ("approach", "contact"), True),
        ("contact", ("approach", "contact"), True),
        ("goal", (), True),
    ],
)
def test_of_phases_the_end_of_the_last_in_which_the_tool_acts_is_looked_at(phase, phases, met):
    gone = {**BESIDE, "object_2": at(0.35)}
    test = {**FAR, "after": {"phase": phase}}
    assert asked(tree(test), BESIDE, gone, phases=phases).met is met
    assert asked(tree({"not": test}), BESIDE, gone, phases=phases).met is (None if met is None else False)
    assert asked(tree({"all": [test, MOVED]}), BESIDE, gone, phases=phases).met is False
    # So are parts of phases.
    touched = {"object_1": at(0.35 + 0.06), "object_2": at(0.35)}
    assert asked(tree({**TOUCHES, "ever": {"phase": phase}}), BESIDE, touched, phases=phases).met is met


def test_what_is_seen_afterwards_may_have_been_otherwise_before():
    for often in ("ever", "always"):
        apart, close = ({"object_1": at(x), "object_2": at(0.35)} for x in (0.6, 0.41))
        test = tree({**TOUCHES, often: {"phase": "goal"}})
        assert asked(test, BESIDE, apart).met is (None if often == "ever" else False)
        assert asked(test, BESIDE, close).met is (True if often == "ever" else None)


@pytest.mark.parametrize(
    "leaf, place, yes",
    [
        ({"moved": {"what": "target", "along": "pull", "by": 0.1}}, (0.39,), True),
        ({"moved": {"what": "target", "along": "pull", "by": 0.1}}, (0.41,), False),
        ({"moved": {"what": "target", "along": "left", "by": 0.1}}, (0.5, -0.11), True),
        ({"moved": {"what": "target", "along": [0, 0, 2], "by": 0.1}}, (0.5, 0.0, 0.14), True),
        ({"stayed": {"what": "target", "within": 0.01}}, (0.5, 0.009), True),
        ({"stayed": {"what": "target", "within": 0.01}}, (0.5, 0.011), False),
        ({"drift": {"what": "target", "along": "pull", "below": 0.02}}, (0.3, 0.019), True),
        ({"drift": {"what": "target", "along": "pull", "below": 0.02}}, (0.3, -0.021), False),
        ({"drift": {"what": "target", "along": "pull", "below": 0.5, "of": "radius"}}, (0.3, 0.0149), True),
        ({"drift": {"what": "target", "along": "pull", "below": 0.5, "of": "radius"}}, (0.3, 0.0151), False),
        ({"drift": {"what": "target", "along": "down", "below": 0.02}}, (0.485, 0.015), False),
        ({"above": {"what": "target", "height": 0.2}}, (0.5, 0.0, 0.21), True),
        ({"above": {"what": "target", "height": 0.2}}, (0.5, 0.0, 0.19), False),
        ({"inside": {"what": "target", "low": [-0.2, -0.1, -1], "high": [0, 0.1, 1]}}, (0.35, 0.05), True),
        ({"inside": {"what": "target", "low": [-0.2, -0.1, -1], "high": [0, 0.1, 1]}}, (0.35, 0.15), False),
        ({"inside": {"what": "target", "low": [0.3, -0.1, 0], "high": [0.4, 0.1, 1], "of": "world"}}, (0.35, 0.05), True),
    ],
)
def test_places_tell_what_they_tell(leaf, place, yes):
    now = {**BESIDE, "object_2": at(*place)}
    found = asked(tree(leaf), BESIDE, now, accuracy=1e-5)
    assert found.met is yes, found.message
    assert asked(tree({"not": leaf}), BESIDE, now, accuracy=1e-5).met is not yes
    assert asked(tree(leaf), BESIDE, now, accuracy=1.0).met is None, "nearer to the bound than it is known"


def test_two_looks_tell_how_fast_things_are():
    rest = tree({"at_rest": {"what": "target", "below": 0.01}})
    for place, met in ((0.502, True), (0.504, True), (0.506, False)):
        found = asked(rest, BESIDE, {**BESIDE, "object_2": at(place)}, then=BESIDE, seconds=0.5, accuracy=1e-5)
        assert found.met is met, found.message


def test_what_creeps_is_not_at_rest_by_two_looks_at_once():
    """Two pictures a fifth of a second apart cannot tell a thing that creeps at the bound from one that stands."""
    rest = tree({"at_rest": {"what": "target", "below": 0.02}})
    assert asked(rest, BESIDE, BESIDE, seconds=0.2).met is None
    settle, apart = patience(replace(fakes.strategy(), goal=rest), 0.005)
    assert (settle, apart) == (0.0, pytest.approx(0.5))
    for speed, met in ((0.0, True), (0.05, False)):
        moved = {**BESIDE, "object_2": at(0.5 + speed * (apart + 0.01))}
        assert asked(rest, BESIDE, moved, then=BESIDE, seconds=apart + 0.01).met is met


def test_the_longest_settling_is_waited_for():
    test = {"all": [FAR, {"all": [FAR], "after": {"settle": 0.5}}, {"all": [FAR], "after": {"settle": "long"}}]}
    assert patience(replace(fakes.strategy(), goal=tree(test, values={"long": 2.25})), 0.005) == (2.25, 0.0)
    crawl = tree({"at_rest": {"what": "target", "below": 0.001}})
    assert patience(replace(fakes.strategy(), goal=crawl), 0.005) == (0.0, APART), "and not for ever"


def test_what_is_measured_by_the_target_asks_that_it_was_seen():
    before = {"object_1": BESIDE["object_1"]}
    for test in (
        FAR,
        {"drift": {"what": "tool", "along": "left", "below": 0.5, "of": "radius"}},
        {"inside": {"what": "tool", "low": [-1, -1, -1], "high": [1, 1, 1], "of": "start"}},
    ):
        found = asked(tree(test), before, BESIDE)
        assert found.met is None and "object_2 is not seen" in found.message


def test_bodies_are_in_each_other_in_simulations_alone():
    """What a simulation asks lest a ball stick in a bowl's wall hinders no answer of what is seen."""
    into = {"overlap": {"what": "target", "whom": "tool", "below": 0.001}}
    assert asked(tree({"all": [FAR, into]}), BESIDE, {**BESIDE, "object_2": at(0.29)}).met is True
