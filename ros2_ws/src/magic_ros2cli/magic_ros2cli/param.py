"""``ros2 param`` list, get, set, describe and dump."""

from __future__ import annotations

import argparse
from typing import Any

import yaml
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters

from magic_ros2cli import connect
from magic_ros2cli.errors import CommandError

#: ParameterType -> (name in the output, field of ParameterValue)
TYPES = {
    ParameterType.PARAMETER_BOOL: ("Boolean value is:", "bool_value"),
    ParameterType.PARAMETER_INTEGER: ("Integer value is:", "integer_value"),
    ParameterType.PARAMETER_DOUBLE: ("Double value is:", "double_value"),
    ParameterType.PARAMETER_STRING: ("String value is:", "string_value"),
    ParameterType.PARAMETER_BYTE_ARRAY: ("Byte values are:", "byte_array_value"),
    ParameterType.PARAMETER_BOOL_ARRAY: ("Boolean values are:", "bool_array_value"),
    ParameterType.PARAMETER_INTEGER_ARRAY: ("Integer values are:", "integer_array_value"),
    ParameterType.PARAMETER_DOUBLE_ARRAY: ("Double values are:", "double_array_value"),
    ParameterType.PARAMETER_STRING_ARRAY: ("String values are:", "string_array_value"),
}


#: ParameterType -> what ``describe`` calls it.
NAMES = {
    ParameterType.PARAMETER_NOT_SET: "not set",
    ParameterType.PARAMETER_BOOL: "boolean",
    ParameterType.PARAMETER_INTEGER: "integer",
    ParameterType.PARAMETER_DOUBLE: "double",
    ParameterType.PARAMETER_STRING: "string",
    ParameterType.PARAMETER_BYTE_ARRAY: "byte array",
    ParameterType.PARAMETER_BOOL_ARRAY: "boolean array",
    ParameterType.PARAMETER_INTEGER_ARRAY: "integer array",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "double array",
    ParameterType.PARAMETER_STRING_ARRAY: "string array",
}


def value_from(text: str) -> ParameterValue:
    """A parameter value from what the user typed, read as YAML as ros2cli does: ``1`` integer, ``1.0`` double, ``true`` bool."""
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        value = text
    result = ParameterValue()
    kind, field, stored = ParameterType.PARAMETER_STRING, "string_value", value if isinstance(value, str) else text
    scalars = ((bool, ParameterType.PARAMETER_BOOL), (int, ParameterType.PARAMETER_INTEGER), (float, ParameterType.PARAMETER_DOUBLE))
    arrays = (
        (bool, ParameterType.PARAMETER_BOOL_ARRAY),
        (int, ParameterType.PARAMETER_INTEGER_ARRAY),
        (float, ParameterType.PARAMETER_DOUBLE_ARRAY),
        (str, ParameterType.PARAMETER_STRING_ARRAY),
    )
    for python, number in scalars:
        if type(value) is python:
            kind, field, stored = number, TYPES[number][1], value
    if isinstance(value, list) and value:
        if {type(v) for v in value} == {int, float}:
            value = [float(v) for v in value]
        for python, number in arrays:
            if all(type(v) is python for v in value):
                kind, field, stored = number, TYPES[number][1], value
    result.type = kind
    setattr(result, field, stored)
    return result


def text_of(value: ParameterValue, hide_type: bool = False) -> str:
    """The line that ``ros2 param get`` prints."""
    if value.type not in TYPES:
        return "Parameter not set"
    label, field = TYPES[value.type]
    plain = getattr(value, field)
    plain = plain if isinstance(plain, (bool, int, float, str)) else list(plain)
    return f"{plain}" if hide_type else f"{label} {plain}"


def _call(node: Any, target: str, kind: Any, service: str, request: Any) -> Any:
    """Call a parameter service of a node; raises :class:`CommandError` where the node is not there or does not answer."""
    client = node.create_client(kind, f"{target}/{service}")
    if not connect.wait_for(client.service_is_ready, connect.DISCOVERY):
        raise CommandError("Node not found")
    answer = connect.spin_until(node, client.call_async(request), connect.DISCOVERY)
    if answer is None:
        raise CommandError(f"{target} did not answer within {connect.DISCOVERY:.0f} s")
    return answer


def param_list(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 param list", description="Output a list of available parameters")
    parser.add_argument("node_name", nargs="?", help="name of the ROS node; without it all nodes")
    parser.add_argument("--filter", default="", help="only list parameters matching the provided regular expression")
    parsed = parser.parse_args(arguments)
    import re

    try:
        wanted = re.compile(parsed.filter)
    except re.error as error:
        raise CommandError(f"filter is {parsed.filter!r}: {error}", 2) from None
    with connect.node() as node:
        if parsed.node_name:
            targets = [connect.absolute(parsed.node_name)]
        else:
            services = connect.settle(node, node.get_service_names_and_types)
            kind = "rcl_interfaces/srv/ListParameters"
            targets = sorted(n.removesuffix("/list_parameters") for n, t in services if kind in t and not connect.hidden(n))
        for target in targets:
            answer = _call(node, target, ListParameters, "list_parameters", ListParameters.Request())
            if not parsed.node_name:
                print(f"{target}:")
            for name in sorted(answer.result.names):
                if wanted.search(name):
                    print(f"  {name}")
    return 0


def param_get(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 param get", description="Get parameter")
    parser.add_argument("node_name", help="name of the ROS node")
    parser.add_argument("parameter_name", help="name of the parameter")
    parser.add_argument("--hide-type", action="store_true", help="hide the type information")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        request = GetParameters.Request(names=[parsed.parameter_name])
        answer = _call(node, connect.absolute(parsed.node_name), GetParameters, "get_parameters", request)
    if not answer.values:
        raise CommandError("Parameter not set")
    print(text_of(answer.values[0], parsed.hide_type))
    return 0


def param_describe(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 param describe", description="Show descriptive information about declared parameters")
    parser.add_argument("node_name", help="name of the ROS node")
    parser.add_argument("parameter_names", nargs="+", help="names of the parameters")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        request = DescribeParameters.Request(names=parsed.parameter_names)
        answer = _call(node, connect.absolute(parsed.node_name), DescribeParameters, "describe_parameters", request)
    for descriptor in answer.descriptors:
        print(f"Parameter name: {descriptor.name}")
        print(f"  Type: {NAMES.get(descriptor.type, 'not set')}")
        if descriptor.description:
            print(f"  Description: {descriptor.description}")
        print("  Constraints:")
        if descriptor.read_only:
            print("    Read only: true")
        for span in [*descriptor.floating_point_range, *descriptor.integer_range][:1]:
            print(f"    Min value: {span.from_value}")
            print(f"    Max value: {span.to_value}")
            if span.step:
                print(f"    Step: {span.step}")
        if descriptor.additional_constraints:
            print(f"    Additional constraints: {descriptor.additional_constraints}")
    return 0


def plain(value: ParameterValue) -> Any:
    """A parameter value as YAML has it; None where it is not set."""
    if value.type not in TYPES:
        return None
    found = getattr(value, TYPES[value.type][1])
    if value.type == ParameterType.PARAMETER_BYTE_ARRAY:
        return [int.from_bytes(b, "little") for b in found]
    return found if isinstance(found, (bool, int, float, str)) else list(found)


class _Quoting(yaml.SafeDumper):
    """Quotes every text: ROS's reader of parameter files takes ``y``, ``on`` and the like for truths, PyYAML does not."""


_Quoting.add_representer(str, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"'))


def _nested(values: dict[str, Any]) -> dict[Any, Any]:
    """Names with dots as maps of maps.  Keys are left unquoted."""
    result: dict[Any, Any] = {}
    for name, value in sorted(values.items()):
        *outer, last = name.split(".")
        place = result
        for part in outer:
            place = place.setdefault(_Key(part), {})
        place[_Key(last)] = value
    return result


class _Key(str):
    """A key of a dumped file."""


_Quoting.add_representer(_Key, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", str(text)))


def param_dump(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="ros2 param dump", description="Show all of the parameters of a node in a YAML file format, with which it can be started again"
    )
    parser.add_argument("node_name", help="name of the ROS node")
    parsed = parser.parse_args(arguments)
    target = connect.absolute(parsed.node_name)
    with connect.node() as node:
        names = list(_call(node, target, ListParameters, "list_parameters", ListParameters.Request()).result.names)
        answer = _call(node, target, GetParameters, "get_parameters", GetParameters.Request(names=names))
    values = {name: plain(value) for name, value in zip(names, answer.values, strict=True) if value.type in TYPES}
    print(yaml.dump({_Key(target): {_Key("ros__parameters"): _nested(values)}}, Dumper=_Quoting, default_flow_style=False), end="")
    return 0


def param_set(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 param set", description="Set parameter")
    parser.add_argument("node_name", help="name of the ROS node")
    parser.add_argument("parameters", nargs="+", metavar="parameter_name value", help="names and their values, in turn")
    parsed = parser.parse_args(arguments)
    if len(parsed.parameters) % 2:
        raise CommandError("Must provide pairs of name and value", 2)
    pairs = list(zip(parsed.parameters[::2], parsed.parameters[1::2], strict=True))
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value_from(text)) for name, text in pairs])
    with connect.node() as node:
        answer = _call(node, connect.absolute(parsed.node_name), SetParameters, "set_parameters", request)
    status = 0
    for result in answer.results:
        if result.successful:
            print("Set parameter successful" + (f": {result.reason}" if result.reason else ""))
        else:
            print("Setting parameter failed" + (f": {result.reason}" if result.reason else ""))
            status = 1
    return status
