"""Goals as data: what is wrong with a tree is said with its path, the value and what is allowed; what is right comes back."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import goal as goals
from magic_core.errors import Code, MagicError
from magic_core.goal import PREDICATES, Goal, from_data, named, names, shipped, to_data, words

TREE = {
    "values": {"distance": 0.2, "kicks": 0.0},
    "trial": {"kicked": {"radii": "kicks"}},
    "test": {
        "all": [
            {"moved": {"what": "target", "along": "pull", "by": "distance"}, "after": {"phase": "goal"}},
            {"any": [{"above": {"what": "target", "height": 0.1}}, {"not": {"touching": {"what": "target", "whom": "table"}}}]},
            {"at_rest": {"what": "target", "below": 0.05}, "after": {"push": {"what": "target", "speed": 0.1}}, "code": "UNSTABLE"},
        ]
    },
}


AT_REST = {"at_rest": {"what": "target", "below": 0.05}}
TRIED = {"after": {"push": {"what": "target", "speed": 0.1}}, "all": [{"moved": {"what": "target", "along": "pull", "by": "distance"}}]}
RESTED = {"after": {"rest": {"what": "target", "below": 0.02}}, "all": [AT_REST]}


@pytest.mark.parametrize("name", names())
def test_the_trees_that_ship_come_back_and_have_words(name):
    goal = named(name)
    assert from_data(to_data(goal)) == goal
    assert from_data(yaml.safe_load(yaml.safe_dump(to_data(goal)))) == goal
    assert shipped(name).resolved() == Goal(name).resolved()
    said = words(goal)
    assert said and not any("{" in line or "inf" in line for line in said)


def test_a_tree_is_read_with_its_numbers():
    goal = from_data(copy.deepcopy(TREE))
    full = goal.resolved()
    assert full.test.of[0].args == {"what": "target", "along": "pull", "by": 0.2}
    assert goal.with_values({"distance": 0.3}).resolved().test.of[0].args["by"] == 0.3
    assert full.trial == {"kicked": {"radii": 0.0}}
    assert words(goal)[0] == "at the end of the phase goal, the target has moved 200 mm along the pull or more"
    assert goal.title == "moved, above, touching, at_rest"


def change(path, value):
    def changed(data):
        *way, last = path
        for key in way:
            data = data[key]
        if value is None:
            del data[last]
        else:
            data[last] = value

    return changed


ITEM = ("test", "all")


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        (("test",), None, "goal: 'no test'"),
        (("values", "distance"), "far", r"goal.values.distance: 'far' \(allowed: a finite number\)"),
        (("values", "distance"), float("inf"), "goal.values.distance: inf"),
        (("values", "distanse"), 1.0, r"goal.values of the tree: 'distanse' \(allowed: distance, kicks\)"),
        (("values", "distance"), 200.0, r"goal.test.all\[0\].moved.by \(values.distance\): 200.0 \(allowed: a length in m, from -100 to 100\)"),
        (("trial", "kicked", "radii"), -1, r"goal.trial.kicked.radii: -1 \(allowed: target radii"),
        (("trial", "shaken"), {}, r"goal.trial: key: 'shaken' \(allowed: kicked, resists, row\)"),
        (ITEM, [], r"goal.test.all: \[\] \(allowed: a list of nodes\)"),
        ((*ITEM, 0), {"lifted": {}}, r"goal.test.all\[0\]: 'lifted' \(allowed: one of all, any, not, moved"),
        ((*ITEM, 0, "moved", "what"), "spoon", r"goal.test.all\[0\].moved.what: 'spoon' \(allowed: tool, target, row\)"),
        ((*ITEM, 0, "moved", "along"), "north", r"goal.test.all\[0\].moved.along: 'north' \(allowed: pull, left, press, up, down, or three"),
        ((*ITEM, 0, "moved", "along"), [0, 0, 0], r"moved.along: \[0, 0, 0\] \(allowed: a direction that is not zero"),
        ((*ITEM, 0, "moved", "by"), "distanse", r"goal.test.all\[0\].moved.by: 'distanse' \(allowed: a length in m, from -100 to 100, distance, kicks\)"),
        ((*ITEM, 0, "moved", "by"), True, r"goal.test.all\[0\].moved.by: True"),
        ((*ITEM, 0, "moved", "by"), None, r"goal.test.all\[0\].moved: 'without by' \(allowed: by: a length in m"),
        ((*ITEM, 0, "moved", "speed"), 1, r"goal.test.all\[0\].moved: key: 'speed'"),
        ((*ITEM, 0, "after", "phase"), 3, r"goal.test.all\[0\].after.phase: 3 \(allowed: the name of a phase\)"),
        ((*ITEM, 0, "after"), {"lunch": 1}, r"goal.test.all\[0\].after: key: 'lunch' \(allowed: phase, settle, rest, push\)"),
        ((*ITEM, 1, "any", 1, "not", "touching", "whom"), "", r"goal.test.all\[1\].any\[1\].not.touching.whom: '' \(allowed: the id of a body\)"),
        ((*ITEM, 1, "any", 0, "after"), {"push": {"what": "target", "speed": 1}}, r"goal.test.all\[1\].any\[0\].after: 'push' \(allowed: phase or settle here"),
        ((*ITEM, 1), {"after": {"settle": 1.0}, "all": [{"above": {"what": "tool", "height": 0}, "after": {"push": {"what": "tool", "speed": 1}}}]},
         r"goal.test.all\[1\].all\[0\].after: 'push' \(allowed: phase or settle here"),
        ((*ITEM, 1, "as_given"), True, None),
        ((*ITEM, 1, "any", 0, "as_given"), True, r"goal.test.all\[1\].any\[0\].as_given: True \(allowed: only in 'all'"),
        ((*ITEM, 0, "throughout"), True, r"goal.test.all\[0\].throughout: True \(allowed: only in a group after a push"),
        ((*ITEM, 2, "ever"), {"seconds": 0.1}, r"goal.test.all\[2\]: 'ever after a try'"),
        (ITEM, [TRIED, AT_REST], None),
        (ITEM, [TRIED, {**AT_REST, "after": {"settle": 1.0}}], r"goal.test.all\[1\].after: 'settle' \(allowed: rest or push here: after the push"),
        (ITEM, [TRIED, {**AT_REST, "after": {"phase": "goal"}}], r"goal.test.all\[1\].after: 'phase' \(allowed: rest or push here"),
        (ITEM, [{"all": [RESTED]}, {"any": [{"not": {**AT_REST, "after": {"settle": 1.0}}}]}],
         r"goal.test.all\[1\].any\[0\].not.after: 'settle' \(allowed: rest or push here: after the rest"),
        (ITEM, [{**AT_REST, "after": {"settle": 1.0}}, RESTED, TRIED], None),
        ((*ITEM, 1), {"after": {"settle": 1.0}, "all": [{"above": {"what": "tool", "height": 0}, "after": {"phase": "goal"}}]},
         r"goal.test.all\[1\].all\[0\].after: 'phase' \(allowed: nothing here: it is asked when what it is in is, after settle"),
        ((*ITEM, 2, "code"), "SAD", r"goal.test.all\[2\].code: 'SAD' \(allowed: PRE_CONTACT_COLLISION"),
        ((*ITEM, 2, "say"), "it rolls: on", r"goal.test.all\[2\].say: .* without a colon"),
        ((*ITEM, 2, "as_given"), "yes", r"goal.test.all\[2\].as_given: 'yes' \(allowed: true or false\)"),
        ((*ITEM, 0, "ever"), {"last": 0.2}, r"goal.test.all\[0\].ever: .* a phase, with the last share of it, or seconds above 0"),
        ((*ITEM, 2, "colour"), "red", r"goal.test.all\[2\]: key: 'colour'"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_its_path(path, value, says):
    data = copy.deepcopy(TREE)
    change(path, value)(data)
    if says is None:
        from_data(data)
        return
    with pytest.raises(MagicError, match=says) as error:
        from_data(data)
    assert error.value.code == Code.BAD_STRATEGY


def test_the_numbers_of_a_named_tree_are_its_own_and_those_that_are_set():
    assert Goal("hook").numbers == named("hook").values
    assert Goal("hook", {"noise": 0.0}).numbers == {**named("hook").values, "noise": 0.0}
    assert from_data(copy.deepcopy(TREE)).numbers == TREE["values"]
    with pytest.raises(MagicError, match="juggle"):
        Goal("juggle").numbers  # noqa: B018


def test_names_of_no_tree_and_numbers_that_it_does_not_name():
    with pytest.raises(MagicError) as error:
        Goal("juggle").resolved()
    assert error.value.code == Code.UNKNOWN_GOAL and "hook" in error.value.message
    with pytest.raises(MagicError, match=r"goal.values of hook: 'distanse' \(allowed: distance, drift"):
        Goal("hook", {"distanse": 0.2}).resolved()
    with pytest.raises(MagicError, match=r"encloses.turned \(values.hold\): 95.0 \(allowed: an angle in degrees, from 0 to 89\)"):
        Goal("hook", {"hold": 95.0}).resolved()


ARGS = {
    "number": st.floats(0.01, 1.0),
    "body": st.sampled_from(["tool", "target"]),
    "other": st.sampled_from(["tool", "table", "shelf"]),
    "direction": st.one_of(st.sampled_from(["pull", "up", "press"]), st.tuples(*[st.floats(0.1, 1.0)] * 3).map(list)),
    "phase": st.just("goal"),
    "point": st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(list),
}


@st.composite
def leaves(draw):
    kind = draw(st.sampled_from(sorted(PREDICATES)))
    args = {name: draw(ARGS[arg.kind] if arg.kind != "word" else st.sampled_from(arg.words)) for name, arg in PREDICATES[kind].args.items()}
    beside = draw(st.sampled_from([{}, {"code": "DRIFT"}, {"say": "no"}, {"after": {"phase": "goal"}}, {"metric": "it"}]))
    return {kind: args, **beside}


@settings(max_examples=60, deadline=None)
@given(
    st.recursive(
        leaves(),
        lambda inner: st.one_of(
            st.builds(lambda of: {"all": of}, st.lists(inner, min_size=1, max_size=3)),
            st.builds(lambda of: {"any": of}, st.lists(inner, min_size=1, max_size=3)),
            st.builds(lambda of: {"not": of}, inner),
        ),
        max_leaves=6,
    )
)
def test_any_tree_comes_back_from_its_file(tree):
    goal = from_data({"test": tree})
    again = from_data(yaml.safe_load(yaml.safe_dump(to_data(goal))))
    assert again == goal
    assert words(goal) == words(again)


def test_every_predicate_says_what_it_needs():
    for kind, predicate in PREDICATES.items():
        assert predicate.needs and set(predicate.needs) <= set(goals.NEEDS), kind
        assert 400 <= predicate.code < 500


def test_the_trees_are_where_they_are_installed():
    assert {path.stem for path in Path(goals.__file__).with_name("goals").glob("*.yaml")} == set(names())
