"""``ros2 topic`` list, info, type, echo, hz and pub."""

from __future__ import annotations

import argparse
import itertools
import math
import sys
import time
from collections import deque
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from magic_ros2cli import connect, messages
from magic_ros2cli.errors import CommandError

RELIABILITIES = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
DURABILITIES = {"transient_local": DurabilityPolicy.TRANSIENT_LOCAL, "volatile": DurabilityPolicy.VOLATILE}


def topic_list(arguments: list[str]) -> int:
    return connect.list_names("topic", "Output a list of available topics", lambda node: node.get_topic_names_and_types(), arguments)


def topic_info(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 topic info", description="Print information about a topic")
    parser.add_argument("topic_name", help="name of the ROS topic (e.g. '/chatter')")
    parser.add_argument("-v", "--verbose", action="store_true", help="print nodes, namespaces, types and QoS of the topic's endpoints")
    parsed = parser.parse_args(arguments)
    topic = connect.absolute(parsed.topic_name)
    with connect.node() as node:
        types = dict(connect.settle(node, node.get_topic_names_and_types)).get(topic)
        if not types:
            raise CommandError(f"Unknown topic '{parsed.topic_name}'")
        publishers, subscriptions = node.get_publishers_info_by_topic(topic), node.get_subscriptions_info_by_topic(topic)
    print(f"Type: {types[0] if len(types) == 1 else types}")
    for what, infos in (("Publisher", publishers), ("Subscription", subscriptions)):
        if parsed.verbose:
            print(f"\n{what} count: {len(infos)}\n")
            for info in infos:
                print(f"{info}\n")
        else:
            print(f"{what} count: {len(infos)}")
    return 0


def topic_type(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 topic type", description="Print a topic's type")
    parser.add_argument("topic_name", help="name of the ROS topic to get type (e.g. '/chatter')")
    parsed = parser.parse_args(arguments)
    topic = connect.absolute(parsed.topic_name)
    with connect.node() as node:
        types = connect.wait_for(lambda: dict(node.get_topic_names_and_types()).get(topic), 3.0)
    for kind in types or []:
        print(kind)
    return 0 if types else 1  # without a word, as ros2cli


def _type_of(node: Any, topic: str, given: str | None) -> Any:
    """Message class of a topic: as given, else as the graph says."""
    if given:
        return messages.interface(given, "msg")
    types = connect.wait_for(lambda: dict(node.get_topic_names_and_types()).get(topic))
    if not types:
        print(f"WARNING: topic [{topic}] does not appear to be published yet", file=sys.stderr)
        raise CommandError("Could not determine the type for the passed topic")
    if len(types) > 1:
        raise CommandError(f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]")
    return messages.interface(types[0], "msg")


def _add_qos(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--qos-reliability", choices=RELIABILITIES, help="quality of service reliability; without it the publishers' own")
    parser.add_argument("--qos-durability", choices=DURABILITIES, help="quality of service durability; without it the publishers' own")
    parser.add_argument("--qos-depth", type=int, help="queue size")


def _matching_qos(node: Any, topic: str, parsed: argparse.Namespace) -> QoSProfile:
    """Reliable, and latched, where every publisher is; the options override. Without a publisher: best effort, which accepts any."""
    if parsed.qos_reliability is None or parsed.qos_durability is None:
        offered = [e.qos_profile for e in connect.wait_for(lambda: node.get_publishers_info_by_topic(topic), 1.0)]
    else:
        offered = []
    reliable = bool(offered) and all(q.reliability == ReliabilityPolicy.RELIABLE for q in offered)
    latched = bool(offered) and all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
    profile = QoSProfile(depth=parsed.qos_depth or (100 if latched else 10))
    profile.reliability = RELIABILITIES[parsed.qos_reliability or ("reliable" if reliable else "best_effort")]
    profile.durability = DURABILITIES[parsed.qos_durability or ("transient_local" if latched else "volatile")]
    return profile


def topic_echo(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 topic echo", description="Output messages from a topic")
    parser.add_argument("topic_name", help="name of the ROS topic to listen to (e.g. '/chatter')")
    parser.add_argument("message_type", nargs="?", help="type of the ROS message (e.g. 'std_msgs/msg/String')")
    parser.add_argument("--field", help="echo a selected field of a message, with dots (e.g. 'header.stamp')")
    parser.add_argument("-f", "--full-length", action="store_true", help="output all elements of arrays, bytes and strings")
    parser.add_argument("-l", "--truncate-length", type=int, default=messages.TRUNCATE, help="length to truncate to (default 128)")
    parser.add_argument("--no-arr", action="store_true", help="don't print array fields of messages")
    parser.add_argument("--no-str", action="store_true", help="don't print string fields of messages")
    parser.add_argument("--flow-style", action="store_true", help="print collections in the block style")
    parser.add_argument("--once", action="store_true", help="print the first message received and then exit")
    parser.add_argument("--timeout", type=float, help="with --once: give up after this many seconds")
    _add_qos(parser)
    parsed = parser.parse_args(arguments)
    topic = connect.absolute(parsed.topic_name)
    options = {
        "truncate": None if parsed.full_length else parsed.truncate_length,
        "no_arr": parsed.no_arr,
        "no_str": parsed.no_str,
    }
    waiting: deque[Any] = deque()
    with connect.node() as node:
        kind = _type_of(node, topic, parsed.message_type)
        fields = parsed.field.strip(".").split(".") if parsed.field else []
        _select(kind(), fields)
        node.create_subscription(kind, topic, lambda m: waiting.append(m), _matching_qos(node, topic, parsed))
        deadline = math.inf if parsed.timeout is None else time.monotonic() + parsed.timeout
        while True:
            rclpy.spin_once(node, timeout_sec=0.1)
            while waiting:
                value = _select(waiting.popleft(), fields)
                if hasattr(value, "get_fields_and_field_types"):
                    text = messages.dump(messages.to_dict(value, **options), parsed.flow_style)
                elif isinstance(value, (bool, int, float, str, bytes)):
                    text = f"{value}\n"
                else:
                    plain = messages._plain(value, "", None, options["truncate"], parsed.no_arr, parsed.no_str)
                    text = messages.dump(plain, parsed.flow_style)
                print(f"{text}---", flush=True)
                if parsed.once:
                    return 0
            if time.monotonic() > deadline:
                raise CommandError(f"no message on {topic} within {parsed.timeout} s")


def _select(message: Any, fields: list[str]) -> Any:
    value = message
    for field in fields:
        if not hasattr(value, "get_fields_and_field_types") or field not in value.get_fields_and_field_types():
            raise CommandError(f"Invalid field '{'.'.join(fields)}': '{type(value).__name__}' has no field '{field}'")
        value = getattr(value, field)
    return value


def topic_hz(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 topic hz", description="Print the average publishing rate to screen")
    parser.add_argument("topic_name", help="name of the ROS topic to listen to (e.g. '/chatter')")
    parser.add_argument("-w", "--window", type=int, default=10000, help="window size, in number of messages (default 10000)")
    _add_qos(parser)
    parsed = parser.parse_args(arguments)
    if parsed.window < 2:
        raise CommandError(f"window is {parsed.window} (allowed: 2 or more)", 2)
    topic = connect.absolute(parsed.topic_name)
    stamps: deque[float] = deque(maxlen=parsed.window)
    with connect.node() as node:
        kind = _type_of(node, topic, None)
        # Raw: decoding large images would itself lower the rate that is measured.
        node.create_subscription(kind, topic, lambda _data: stamps.append(time.monotonic()), _matching_qos(node, topic, parsed), raw=True)
        reported, seen = time.monotonic(), 0.0
        while True:
            rclpy.spin_once(node, timeout_sec=0.1)
            now = time.monotonic()
            if now - reported < 1.0:
                continue
            reported = now
            if len(stamps) < 2 or stamps[-1] == seen:
                continue
            seen = stamps[-1]
            times = list(stamps)
            gaps = [b - a for a, b in itertools.pairwise(times)]
            mean = sum(gaps) / len(gaps)
            deviation = math.sqrt(sum((g - mean) ** 2 for g in gaps) / len(gaps))
            print(f"average rate: {1.0 / mean:.3f}" if mean > 0 else "average rate: inf")
            print(f"\tmin: {min(gaps):.3f}s max: {max(gaps):.3f}s std dev: {deviation:.5f}s window: {len(times)}", flush=True)


def topic_pub(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="ros2 topic pub", description="Publish a message to a topic")
    parser.add_argument("topic_name", help="name of the ROS topic to publish to (e.g. '/chatter')")
    parser.add_argument("message_type", help="type of the ROS message (e.g. 'std_msgs/msg/String')")
    parser.add_argument("values", nargs="?", default="{}", help="values of the message in YAML (e.g. '{data: Hello}')")
    parser.add_argument("-r", "--rate", type=float, default=1.0, help="publishing rate in Hz (default 1)")
    parser.add_argument("-p", "--print", type=int, default=1, dest="every", help="only print every N-th published message (default 1)")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("-1", "--once", action="store_true", help="publish one message and exit")
    group.add_argument("-t", "--times", type=int, default=0, help="publish this number of times and then exit")
    parser.add_argument("-w", "--wait-matching-subscriptions", type=int, help="wait for this many subscriptions (default 1 with -1 and -t)")
    parser.add_argument("--keep-alive", type=float, default=0.1, help="stay this many seconds after the last message (default 0.1)")
    parser.add_argument("-n", "--node-name", help="name of the created publishing node")
    _add_qos(parser)
    parsed = parser.parse_args(arguments)
    if not parsed.rate > 0:
        raise CommandError(f"rate is {parsed.rate} (allowed: above 0)", 2)
    kind = messages.interface(parsed.message_type, "msg")
    values = messages.parse(parsed.values)
    times = 1 if parsed.once else parsed.times
    wanted = parsed.wait_matching_subscriptions
    if wanted is None:
        wanted = 1 if times else 0
    profile = QoSProfile(depth=parsed.qos_depth or 10)
    profile.reliability = RELIABILITIES[parsed.qos_reliability or "reliable"]
    profile.durability = DURABILITIES[parsed.qos_durability or "volatile"]
    message = messages.fill(kind(), values)
    with connect.node(name=parsed.node_name) as node:
        publisher = node.create_publisher(kind, parsed.topic_name, profile)
        said = 0.0
        while publisher.get_subscription_count() < wanted:
            if time.monotonic() - said > 1.0:
                print(f"Waiting for at least {wanted} matching subscription(s)...", flush=True)
                said = time.monotonic()
            time.sleep(0.02)
        print("publisher: beginning loop")
        count, start = 0, time.monotonic()
        while True:
            message = messages.fill(kind(), values)  # anew: a stamp of "now" moves on
            count += 1
            if parsed.every and count % parsed.every == 0:
                print(f"publishing #{count}: {message!r}\n", flush=True)
            publisher.publish(message)
            if times and count >= times:
                publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=2.0))
                time.sleep(max(parsed.keep_alive, 0.0))
                return 0
            time.sleep(max(start + count / parsed.rate - time.monotonic(), 0.0))
