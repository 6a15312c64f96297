"""What a tree says of a simulated scene: predicates against analytic truths, times, groups, and what physics does not tell."""

from dataclasses import replace

import numpy as np
import pytest
import scenes

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.goal import PREDICATES, from_data, leaf_words
from magic_verifier.predicates import DECIDED, Asked, told
from magic_verifier.verification import Proposal, verify_proposal

BOX = scenes.block((-0.02, 0.02), (-0.03, 0.03), (-0.05, 0.05))


def tree(test, **values):
    return from_data({"test": test, "values": values})


def strategy(test, normal=(1.0, 0.0, 0.0)):
    return replace(scenes.strategy("hook", normal=normal), goal=tree(test))


class Standing:
    """A box that stood on the table at x = 0.5 and is elsewhere now, as predicates ask of it."""

    def __init__(self, pose):
        self._pose = pose

    def row(self):
        return ("target",)

    def pose(self, name):
        return self._pose

    def start(self, name):
        return transforms.make(translation=[0.5, 0, 0.05])

    def centre(self, name):
        return np.zeros(3)

    def corners(self, name):
        return BOX.vertices

    def table_height(self, point):
        return 0.0


def found(test, pose, normal=(1.0, 0.0, 0.0)):
    return told(Asked(strategy(test, normal), Standing(pose)), tree(test).resolved().test)


def at(x, y=0.0, z=0.05, rpy=(0, 0, 0)):
    return transforms.from_rpy(*rpy, [x, y, z])


@pytest.mark.parametrize(
    ("leaf", "pose", "yes"),
    [
        ({"moved": {"what": "target", "along": "pull", "by": 0.1}}, at(0.39), True),
        ({"moved": {"what": "target", "along": "pull", "by": 0.1}}, at(0.41), False),
        ({"moved": {"what": "target", "along": "left", "by": 0.1}}, at(0.5, -0.11), True),
        ({"moved": {"what": "target", "along": [0, 0, 2], "by": 0.1}}, at(0.5, z=0.16), True),
        ({"stayed": {"what": "target", "within": 0.01}}, at(0.5, 0.009), True),
        ({"stayed": {"what": "target", "within": 0.01}}, at(0.5, 0.011), False),
        ({"drift": {"what": "target", "along": "pull", "below": 0.02}}, at(0.3, 0.019), True),
        ({"drift": {"what": "target", "along": "pull", "below": 0.02}}, at(0.3, -0.021), False),
        ({"drift": {"what": "target", "along": "pull", "below": 0.5, "of": "radius"}}, at(0.3, 0.0149), True),
        ({"drift": {"what": "target", "along": "pull", "below": 0.5, "of": "radius"}}, at(0.3, 0.0151), False),
        ({"drift": {"what": "target", "along": "down", "below": 0.02}}, at(0.485, 0.015), False),
        ({"above": {"what": "target", "height": 0.2}}, at(0.5, z=0.21), True),
        ({"above": {"what": "target", "height": 0.2}}, at(0.5, z=0.2), False),
        ({"upright": {"what": "target", "within": 10}}, at(0.5, rpy=(0.17, 0, 2.0)), True),
        ({"upright": {"what": "target", "within": 10}}, at(0.5, rpy=(0.18, 0, 2.0)), False),
        ({"points": {"what": "target", "along": [1, 0, 0]}}, at(0.5, rpy=(0, 1.57, 0.7)), True),
        ({"points": {"what": "target", "along": [1, 0, 0]}}, at(0.5, rpy=(0, 1.57, 0.9)), False),
        ({"turned": {"what": "target", "by": 150, "about": "level"}}, at(0.5, rpy=(np.pi, 0, 0.4)), True),
        ({"turned": {"what": "target", "by": 150, "about": "level"}}, at(0.5, rpy=(0, 0, np.pi)), False),
        ({"turned": {"what": "target", "by": 150, "about": "up"}}, at(0.5, rpy=(0, 0, np.pi)), True),
        ({"turned": {"what": "target", "by": 150}}, at(0.5, rpy=(0, 0, np.pi)), True),
        ({"inside": {"what": "target", "low": [-0.2, -0.1, -1], "high": [0, 0.1, 1]}}, at(0.35, 0.05), True),
        ({"inside": {"what": "target", "low": [-0.2, -0.1, -1], "high": [0, 0.1, 1]}}, at(0.35, 0.15), False),
        ({"inside": {"what": "target", "low": [0.3, -0.1, 0], "high": [0.4, 0.1, 1], "of": "world"}}, at(0.35, 0.05), True),
    ],
)
def test_poses_tell_what_they_tell(leaf, pose, yes):
    answer = found(leaf, pose)
    assert answer.truth is yes, answer.measured
    assert answer.measured and ("needed" in answer.wanted or "allowed" in answer.wanted)


FAR = {"moved": {"what": "target", "along": "pull", "by": 0.1}}


def test_every_predicate_is_decided_here():
    assert set(DECIDED) == set(PREDICATES)


def test_directions_are_those_of_the_target():
    asked = Asked(strategy(FAR, normal=(0.0, 0.6, 0.8)), Standing(at(0.5)))
    np.testing.assert_allclose(asked.direction("pull"), [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(asked.direction("left"), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(asked.direction("press"), [0, -0.6, -0.8], atol=1e-12)
    with pytest.raises(MagicError, match="a direction along the table"):
        Asked(strategy(FAR, normal=(0.0, 0.0, 1.0)), asked.state).direction("pull")
    leaf = tree(FAR).resolved().test
    assert told(asked, leaf).truth is False and leaf_words(leaf).startswith("the target has moved 100 mm")


# ------------------------------------------------------------------------------------------------ in simulation


def pulled(test, trial=None):
    scene, tool, target, motion = scenes.hooking("L", noise=0.0)
    scene = replace(scene, goal=from_data({"test": test, **({"trial": trial} if trial else {})}))
    return verify_proposal(Proposal(scene, tool, target, (), scenes.TABLE, motion), repetitions=1)


def moved(by, **beside):
    return {"moved": {"what": "target", "along": "pull", "by": by}, **beside}


def test_phases_are_asked_at_their_ends():
    assert pulled({"all": [moved(0.2, after={"phase": "goal"}), {"not": moved(0.05, after={"phase": "contact"})}]}).success
    early = pulled({"all": [moved(0.2, after={"phase": "contact"})]})
    assert (early.success, early.code) == (False, Code.GOAL_NOT_REACHED) and "needed: 200 mm" in early.message


def test_what_holds_at_some_time_and_all_the_time():
    touches = {"touching": {"what": "target", "whom": "tool"}}
    assert pulled({"all": [{**touches, "ever": {"phase": "goal"}}]}).success
    assert not pulled({"all": [{**touches, "always": {"phase": "approach"}}]}).success
    assert not pulled({"all": [{**touches, "ever": {"seconds": 0.05}}]}).success, "the tool has left it by then"


def test_a_group_says_its_own_code_and_sentence():
    verdict = pulled({"all": [{"any": [moved(0.5), moved(0.6)], "code": "DRIFT", "say": "nowhere near"}]})
    assert verdict.code == Code.DRIFT and verdict.message.startswith("nowhere near: target moved 281 mm along")
    assert "(needed: 500 mm or 600 mm)" in verdict.message
    verdict = pulled({"all": [{"not": moved(0.1)}]})
    assert verdict.message.startswith("it holds that the target has moved 100 mm along the pull or more: target moved 281 mm")


def test_pressing_is_counted_in_newton_seconds():
    # A cylinder that is pulled at 0.1 m/s against a friction of 0.5: its weight times that, for 2.8 s.
    weight = 100.0 * np.pi * 0.025**2 * 0.05 * 9.81
    expected = 0.5 * weight * 2.8
    press = {"pressed": {"what": "target", "whom": "tool", "along": "pull", "impulse": 0.5 * expected}}
    verdict = pulled({"all": [press]})
    assert verdict.success, verdict.message
    assert verdict.metrics["target_impulse"] == pytest.approx(expected, rel=0.3)


def test_a_resistance_is_pressed_against():
    press = {"pressed": {"what": "target", "whom": "tool", "along": "pull", "impulse": 0.0}}
    free, held = (pulled({"all": [press]}, trial).metrics["target_impulse"] for trial in (None, {"resists": {"force": 0.1}}))
    assert held - free == pytest.approx(0.1 * 2.8, rel=0.1)


@pytest.mark.parametrize(
    ("test", "tellable"),
    [
        ({"touching": {"what": "target", "whom": "tool"}, "ever": {"phase": "goal"}}, True),
        ({"touching": {"what": "tool", "whom": "target"}, "ever": {"phase": "goal"}}, True),
        ({"touching": {"what": "target", "whom": "table"}}, True),
        ({"touching": {"what": "tool", "whom": "table"}}, False),
        ({"touching": {"what": "tool", "whom": "table"}, "ever": {"phase": "goal"}}, False),
        ({"not": {"touching": {"what": "tool", "whom": "table"}, "ever": {"phase": "goal"}}}, False),
        ({"not": {"touching": {"what": "tool", "whom": "table"}}}, False),
        ({"touching_only": {"what": "tool", "whom": "target"}}, False),
        ({"after": {"phase": "contact"}, "not": {"touching": {"what": "target", "whom": "tool"}, "ever": {"phase": "retreat"}}}, False),
        ({"any": [{"touching_only": {"what": "tool", "whom": "target"}}, moved(0.1)]}, True),
    ],
)
def test_contacts_that_physics_does_not_tell_of_pass_nothing(test, tellable):
    verdict = pulled({"all": [test]})
    assert (verdict.code == Code.OK) == tellable, verdict.message
    if not tellable:
        assert verdict.code == Code.NOT_VERIFIABLE and "touches" in verdict.message


@pytest.mark.parametrize(
    ("test", "says"),
    [
        (
            {"touching": {"what": "target", "whom": "shelf"}},
            r"goal: touching: whom: 'shelf' \(allowed: arm, fingers, table, target, tool\)",
        ),
        (moved(0.1, after={"phase": "goall"}), "goal: moved: phase: 'goall' (allowed: approach, contact, goal, retreat)"),
        ({"struck": {}}, "flies by its own momentum"),
        ({"encloses": {"along": "up"}}, "direction of encloses"),
    ],
)
def test_what_the_scene_does_not_have_is_refused(test, says):
    verdict = pulled({"all": [test]})
    assert verdict.code == Code.BAD_STRATEGY and says.replace("\\", "") in verdict.message.replace("\\", ""), verdict.message


@pytest.mark.parametrize("trial", [{"resists": {"force": 1.0}}, {"kicked": {"radii": 1.0}}])
def test_a_fixed_target_is_not_tried(trial):
    scene, tool, target, motion = scenes.hooking("L", noise=0.0)
    physics = replace(scene.physics, target_is_fixed=True)
    scene = replace(scene, physics=physics, goal=from_data({"test": {"all": [moved(0.1)]}, "trial": trial}))
    verdict = verify_proposal(Proposal(scene, tool, target, (), scenes.TABLE, motion), repetitions=1)
    assert verdict.code == Code.BAD_STRATEGY and "nothing moves it" in verdict.message
