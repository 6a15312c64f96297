"""``ros2 lifecycle`` nodes, get, set and list."""

from __future__ import annotations

import argparse
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState

from magic_ros2cli import connect
from magic_ros2cli.errors import CommandError


def _nodes(node: Any) -> list[str]:
    """Full names of the nodes that have a lifecycle, sorted."""
    services = connect.settle(node, node.get_service_names_and_types)
    asked = [n for n, t in services if "lifecycle_msgs/srv/GetState" in t and n.endswith("/get_state")]
    # A service is known by its clients, too.
    return sorted(n.removesuffix("/get_state") for n in asked if node.count_services(n))


def _call(node: Any, target: str, kind: Any, service: str, request: Any) -> Any:
    client = node.create_client(kind, f"{target}/{service}")
    if not connect.wait_for(client.service_is_ready):
        raise CommandError("Node not found")
    answer = connect.spin_until(node, client.call_async(request), server=connect.server_of(node, f"{target}/{service}"))
    node.destroy_client(client)
    return answer


def _transitions(node: Any, target: str, service: str = "get_available_transitions") -> list[Any]:
    answer = _call(node, target, GetAvailableTransitions, service, GetAvailableTransitions.Request())
    return list(answer.available_transitions)


def lifecycle_nodes(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 lifecycle nodes", description="Output a list of nodes with lifecycle")
    parser.add_argument("-a", "--all", action="store_true", help="display all nodes even hidden ones")
    parser.add_argument("-c", "--count-nodes", action="store_true", help="only display the number of nodes discovered")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        found = [n for n in _nodes(node) if parsed.all or not connect.hidden(n)]
    if parsed.count_nodes:
        print(len(found))
    for name in [] if parsed.count_nodes else found:
        print(name)
    return 0


def lifecycle_get(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 lifecycle get", description="Get lifecycle state for one or more nodes")
    parser.add_argument("node_name", nargs="?", help="name of the ROS node; without it all nodes")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        targets = [connect.absolute(parsed.node_name)] if parsed.node_name else [n for n in _nodes(node) if not connect.hidden(n)]
        for target in targets:
            state = _call(node, target, GetState, "get_state", GetState.Request()).current_state
            print(f"{'' if parsed.node_name else f'{target}: '}{state.label} [{state.id}]")
    return 0


def lifecycle_set(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 lifecycle set", description="Trigger lifecycle state transition")
    parser.add_argument("node_name", help="name of the ROS node")
    parser.add_argument("transition", help="the lifecycle transition, its label or its number")
    parsed = parser.parse_args(arguments)
    target = connect.absolute(parsed.node_name)
    with connect.node() as node:
        there = [t.transition for t in _transitions(node, target)]
        chosen = next((t for t in there if t.label == parsed.transition), None)
        chosen = chosen or next((t for t in there if str(t.id) == parsed.transition), None)
        if chosen is None:
            raise CommandError("\n".join(["Unknown transition requested, available ones are:", *(f"- {t.label} [{t.id}]" for t in there)]))
        request = ChangeState.Request(transition=Transition(id=chosen.id, label=chosen.label))
        if not _call(node, target, ChangeState, "change_state", request).success:
            raise CommandError("Transitioning failed")
    print("Transitioning successful")
    return 0


def lifecycle_list(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 lifecycle list", description="Output a list of available transitions")
    parser.add_argument("node_name", help="name of the ROS node")
    parser.add_argument("-a", "--all", action="store_true", help="display all existing transitions")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        service = "get_transition_graph" if parsed.all else "get_available_transitions"
        for found in _transitions(node, connect.absolute(parsed.node_name), service):
            print(f"- {found.transition.label} [{found.transition.id}]")
            print(f"\tStart: {found.start_state.label}")
            print(f"\tGoal: {found.goal_state.label}")
    return 0
