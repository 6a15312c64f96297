"""Parameters: what nobody declared is refused by name, what is read once cannot be set, and what was dumped starts a node again."""

import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter

from magic_core.errors import Code, MagicError
from magic_core.node import ROBOT_PARAMETERS, parameter, refuse_unknown_parameters


@pytest.fixture
def node(tmp_path):
    made, contexts = [], []

    def make(*arguments, text="", namespace=None):
        context = rclpy.Context()
        rclpy.init(context=context)
        contexts.append(context)
        if text:
            (tmp_path / "given.yaml").write_text(text)
            arguments = (*arguments, "--params-file", str(tmp_path / "given.yaml"))
        found = Node("node", context=context, cli_args=["--ros-args", *arguments], namespace=namespace)
        made.append(found)
        return found

    yield make
    for each in made:
        each.destroy_node()
    for context in contexts:
        rclpy.try_shutdown(context=context)


def declared(found):
    return {
        "execute": parameter(found, "execute", False, "whether"),
        "speed": parameter(found, "speed", 1.0, "how fast", low=0.0, high=10.0),
        "home": list(parameter(found, "home", [0.0, 0.5], "where")),
        "axis": parameter(found, "axis", "x", "which", choices=("x", "y")),
        "top_k": parameter(found, "top_k", 3, "how many", low=1, high=9, read_only=False),
    }


def test_an_empty_list_is_refused_where_values_are_meant(node):
    with pytest.raises(MagicError, match="parameter home: 'an empty list'") as caught:
        declared(node("-p", "home:=[]"))
    assert caught.value.code is Code.BAD_REQUEST


@pytest.mark.parametrize(
    "arguments, text",
    [
        (("-p", "excute:=true"), ""),
        ((), "node:\n  ros__parameters:\n    excute: true\n"),
        ((), "/**:\n  ros__parameters:\n    excute: true\n    speed: 2.0\n"),
    ],
    ids=["on the command line", "in a file for the node", "in a file for all nodes"],
)
def test_what_nobody_declared_is_refused_and_what_is_written_alike_is_named(node, arguments, text):
    found = node(*arguments, text=text)
    declared(found)
    with pytest.raises(MagicError, match="'excute'.*execute") as caught:
        refuse_unknown_parameters(found)
    assert caught.value.code is Code.BAD_REQUEST


def test_what_is_declared_and_the_arms_parameters_pass(node):
    text = "/**:\n  ros__parameters:\n    robot: {urdf: a.urdf, acceleration: [1.0]}\n    speed: 2\n    use_sim_time: true\n"
    found = node("-p", "execute:=true", text=text)
    assert declared(found) == {"execute": True, "speed": 2.0, "home": [0.0, 0.5], "axis": "x", "top_k": 3}
    refuse_unknown_parameters(found)


def test_a_misspelt_parameter_of_the_arm_is_refused_by_nodes_that_have_none_too(node):
    found = node(text="/**:\n  ros__parameters:\n    robot: {urfd: a.urdf}\n")
    declared(found)
    with pytest.raises(MagicError, match="robot.urdf"):
        refuse_unknown_parameters(found)
    assert "robot.urdf" in ROBOT_PARAMETERS


@pytest.mark.parametrize(
    "text, wanted",
    [("speed: 2", {"speed": 2.0}), ("home: [1, 2]", {"home": [1.0, 2.0]}), ("axis: y", {"axis": "y"}), ("axis: x", {"axis": "x"})],
)
def test_values_that_yaml_has_another_type_for_are_understood(node, text, wanted):
    found = declared(node(text=f"/**:\n  ros__parameters:\n    {text}\n"))
    assert {name: found[name] for name in wanted} == wanted


@pytest.mark.parametrize("text", ["axis: n", "axis: z", "speed: fast", "execute: 1"])
def test_values_of_another_type_are_refused_with_the_parameters_name(node, text):
    found = node(text=f"/**:\n  ros__parameters:\n    {text}\n")
    with pytest.raises((MagicError, rclpy.exceptions.ParameterException), match=text.split(":")[0]):
        declared(found)


def test_what_is_read_at_the_start_alone_cannot_be_set(node):
    found = node()
    declared(found)
    results = found.set_parameters([Parameter("speed", value=2.0), Parameter("top_k", value=4), Parameter("top_k", value=99)])
    assert [r.successful for r in results] == [False, True, False]
    assert found.get_parameter("speed").value == 1.0 and found.get_parameter("top_k").value == 4
