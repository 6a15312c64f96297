"""``ros2 service`` list, type and call."""

from __future__ import annotations

import argparse
import time

from magic_ros2cli import connect, messages
from magic_ros2cli.errors import CommandError


def service_list(arguments: list[str]) -> int:
    return connect.list_names("service", "Output a list of available services", lambda node: node.get_service_names_and_types(), arguments)


def service_type(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 service type", description="Output a service's type")
    parser.add_argument("service_name", help="name of the ROS service (e.g. '/talker/list_parameters')")
    parsed = parser.parse_args(arguments)
    name = connect.absolute(parsed.service_name)
    with connect.node() as node:
        types = connect.wait_for(lambda: dict(node.get_service_names_and_types()).get(name), 3.0)
    if not types:
        raise CommandError(f"Unknown service '{parsed.service_name}'")
    for kind in types:
        print(kind)
    return 0


def service_call(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 service call", description="Call a service")
    parser.add_argument("service_name", help="name of the ROS service to call to (e.g. '/add_two_ints')")
    parser.add_argument("service_type", help="type of the ROS service (e.g. 'std_srvs/srv/Empty')")
    parser.add_argument("values", nargs="?", default="{}", help="values of the request in YAML (e.g. '{a: 1, b: 2}')")
    parser.add_argument("-r", "--rate", type=float, help="repeat the call at this rate in Hz")
    parsed = parser.parse_args(arguments)
    if parsed.rate is not None and not parsed.rate > 0:
        raise CommandError(f"rate is {parsed.rate} (allowed: above 0)", 2)
    kind = messages.interface(parsed.service_type, "srv")
    request = messages.fill(kind.Request(), messages.parse(parsed.values))
    with connect.node() as node:
        client = node.create_client(kind, parsed.service_name)
        if not client.service_is_ready():
            print("waiting for service to become available...", flush=True)
            connect.wait_for(client.service_is_ready, None)
        while True:
            print(f"requester: making request: {request!r}\n", flush=True)
            start = time.monotonic()
            response = connect.spin_until(node, client.call_async(request), server=connect.server_of(node, parsed.service_name))
            print(f"response:\n{response!r}\n", flush=True)
            if parsed.rate is None:
                return 0
            time.sleep(max(start + 1.0 / parsed.rate - time.monotonic(), 0.0))
