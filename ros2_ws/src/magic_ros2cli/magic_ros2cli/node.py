"""``ros2 node`` list and info."""

from __future__ import annotations

import argparse
import sys

from rclpy.action import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node

from magic_ros2cli import connect
from magic_ros2cli.errors import CommandError


def names(node: object, include_hidden: bool = False) -> list[str]:
    """Full names of the nodes in the graph, sorted."""
    pairs = connect.settle(node, lambda: sorted(node.get_node_names_and_namespaces()))
    return sorted(f"{space.rstrip('/')}/{name}" for name, space in pairs if include_hidden or not name.startswith("_"))


def node_list(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 node list", description="Output a list of available nodes")
    parser.add_argument("-a", "--all", action="store_true", help="display all nodes even hidden ones")
    parser.add_argument("-c", "--count-nodes", action="store_true", help="only display the number of nodes discovered")
    parsed = parser.parse_args(arguments)
    with connect.node() as node:
        found = names(node, parsed.all)
    if parsed.count_nodes:
        print(len(found))
    else:
        for name in found:
            print(name)
    return 0


def node_info(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 node info", description="Output information about a node")
    parser.add_argument("node_name", help="fully qualified node name to request information")
    parser.add_argument("--include-hidden", action="store_true", help="display hidden topics, services, and actions as well")
    parsed = parser.parse_args(arguments)
    name = connect.absolute(parsed.node_name)
    space, _, base = name.rpartition("/")
    with connect.node() as node:
        count = names(node, parsed.include_hidden).count(name)
        if count > 1:
            print(
                f"There are {count} nodes in the graph with the exact name '{name}'. You are seeing information about only one of them.",
                file=sys.stderr,
            )
        if not count:
            raise CommandError(f"Unable to find node '{name}'")
        where = base, space or "/"
        found = {
            "Subscribers": node.get_subscriber_names_and_types_by_node(*where),
            "Publishers": node.get_publisher_names_and_types_by_node(*where),
            "Service Servers": node.get_service_names_and_types_by_node(*where),
            "Service Clients": node.get_client_names_and_types_by_node(*where),
            "Action Servers": get_action_server_names_and_types_by_node(node, *where),
            "Action Clients": get_action_client_names_and_types_by_node(node, *where),
        }
    print(name)
    for what, rows in found.items():
        shown = sorted((n, t) for n, t in rows if parsed.include_hidden or not connect.hidden(n))
        print(f"  {what}:")
        # Where there are none ros2cli prints an empty line.
        print("\n".join(f"    {n}: {', '.join(t)}" for n, t in shown))
    return 0
