"""``ros2 action`` info, list and send_goal."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import (
    ActionClient,
    get_action_client_names_and_types_by_node,
    get_action_names_and_types,
    get_action_server_names_and_types_by_node,
)
from rclpy.node import NodeNameNonExistentError

from magic_ros2cli import connect, messages
from magic_ros2cli.errors import CommandError

STATUS = {
    GoalStatus.STATUS_ACCEPTED: "ACCEPTED",
    GoalStatus.STATUS_EXECUTING: "EXECUTING",
    GoalStatus.STATUS_CANCELING: "CANCELING",
    GoalStatus.STATUS_SUCCEEDED: "SUCCEEDED",
    GoalStatus.STATUS_CANCELED: "CANCELED",
    GoalStatus.STATUS_ABORTED: "ABORTED",
}

#: After a cancel was sent: how long the server may take to answer it and to end the goal, s.
CANCEL_TIMEOUT = 10.0


def _of_node(ask: Callable[..., list[tuple[str, list[str]]]], node: Any, name: str, space: str) -> list[tuple[str, list[str]]]:
    """What ``ask`` says of a node; nothing of one that has gone since it was seen."""
    try:
        return ask(node, name, space)
    except NodeNameNonExistentError:
        return []


def action_info(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 action info", description="Print information about an action")
    parser.add_argument("action_name", help="name of the ROS action to get info (e.g. '/fibonacci')")
    parser.add_argument("-t", "--show-types", action="store_true", help="additionally show the action type")
    parser.add_argument("-c", "--count", action="store_true", help="only display the number of action clients and action servers")
    parsed = parser.parse_args(arguments)
    action = connect.absolute(parsed.action_name)
    with connect.node() as node:
        nodes = connect.settle(node, lambda: sorted(node.get_node_names_and_namespaces()))
        sides = {
            what: [
                (f"{space.rstrip('/')}/{name}", types)
                for name, space in nodes
                for found, types in _of_node(ask, node, name, space)
                if found == action
            ]
            for what, ask in (
                ("clients", get_action_client_names_and_types_by_node),
                ("servers", get_action_server_names_and_types_by_node),
            )
        }
    print(f"Action: {parsed.action_name}")
    for what, rows in sides.items():
        print(f"Action {what}: {len(rows)}")
        for name, types in [] if parsed.count else rows:
            print(f"    {name} [{', '.join(types)}]" if parsed.show_types else f"    {name}")
    return 0


def action_list(arguments: list[str]) -> int:
    return connect.list_names("action", "Output a list of action names", get_action_names_and_types, arguments, may_hide=False)


def action_send_goal(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 action send_goal", description="Send an action goal; Ctrl-C cancels it")
    parser.add_argument("action_name", help="name of the ROS action (e.g. '/fibonacci')")
    parser.add_argument("action_type", help="type of the ROS action (e.g. 'example_interfaces/action/Fibonacci')")
    parser.add_argument("goal", nargs="?", default="{}", help="goal request values in YAML (e.g. '{order: 10}')")
    parser.add_argument("--stdin", action="store_true", help="read the goal from standard input")
    parser.add_argument("-f", "--feedback", action="store_true", help="echo feedback messages for the goal")
    parsed = parser.parse_args(arguments)
    kind = messages.interface(parsed.action_type, "action")
    goal = messages.fill(kind.Goal(), messages.parse(sys.stdin.read() if parsed.stdin else parsed.goal))

    def feedback(message: object) -> None:
        print(f"Feedback:\n    {messages.to_yaml(message.feedback)}", flush=True)

    with connect.node() as node:
        client = ActionClient(node, kind, parsed.action_name)
        print("Waiting for an action server to become available...", flush=True)
        connect.wait_for(client.server_is_ready, None)
        print(f"Sending goal:\n     {messages.to_yaml(goal)}", flush=True)
        server = connect.server_of(node, f"{parsed.action_name}/_action/send_goal")
        sending = client.send_goal_async(goal, feedback if parsed.feedback else None)
        handle = result = None
        try:
            handle = connect.spin_until(node, sending, server=server)
            if not handle.accepted:
                print("Goal was rejected.")
                return 0
            print(f"Goal accepted with ID: {bytes(handle.goal_id.uuid).hex()}\n", flush=True)
            result = handle.get_result_async()
            answer = connect.spin_until(node, result, server=server)
        except KeyboardInterrupt:
            if handle is None:
                # The goal may be on its way: what has been accepted meanwhile is canceled too.
                handle = connect.spin_until(node, sending, CANCEL_TIMEOUT)
            if handle is None or not handle.accepted:
                raise
            print("Canceling goal...", flush=True)
            canceled = connect.spin_until(node, handle.cancel_goal_async(), CANCEL_TIMEOUT)
            if canceled is None:
                raise CommandError(f"The server did not answer the cancel request within {CANCEL_TIMEOUT:.0f} s") from None
            if not canceled.goals_canceling:
                raise CommandError("Failed to cancel goal") from None
            print("Goal canceled.", flush=True)
            answer = connect.spin_until(node, result or handle.get_result_async(), CANCEL_TIMEOUT)
            if answer is None:
                raise
        finally:
            client.destroy()
        print(f"Result:\n    {messages.to_yaml(answer.result)}")
        print(f"Goal finished with status: {STATUS.get(answer.status, 'UNKNOWN')}")
        return 0
