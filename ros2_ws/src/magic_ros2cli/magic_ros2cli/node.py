"""``ros2 node list``."""

from __future__ import annotations

import argparse

from magic_ros2cli import connect


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
