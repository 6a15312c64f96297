"""A short-lived node and the waiting that its verbs need: there is no daemon that knows the graph already."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import rclpy
from rclpy.signals import SignalHandlerOptions

from magic_core import presence
from magic_core.presence import Watch
from magic_ros2cli.errors import CommandError

T = TypeVar("T")

#: How long a named node, topic or service may take to be discovered, s.
DISCOVERY = 5.0
#: The graph counts as known when it has not changed for this long, s.
SETTLED = 1.0
#: And as empty when no other node has been seen for this long, s.
EMPTY = 1.5
#: A graph that goes on changing is taken as it is after so long, s.
LONGEST = 5.0


@contextmanager
def node(**options: Any) -> Iterator[Any]:
    """A hidden node; SIGINT stays Python's KeyboardInterrupt."""
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    made = None
    try:
        name = options.pop("name", None) or f"_ros2cli_{os.getpid()}"
        made = rclpy.create_node(name, start_parameter_services=False, enable_rosout=False, **options)
        yield made
    finally:
        if made is not None:
            made.destroy_node()
        rclpy.try_shutdown()


def settle(made: Any, query: Callable[[], T]) -> T:
    """The answer of a graph query once it, and the list of nodes, have stopped changing."""
    start = changed = time.monotonic()
    state: Any = None
    while True:
        before, state = state, (sorted(made.get_node_names_and_namespaces()), query())
        now = time.monotonic()
        if state != before:
            changed = now
        others = len(state[0]) > 1
        if (now - changed >= SETTLED and (others or now - start >= EMPTY)) or now - start >= LONGEST:
            return state[1]
        time.sleep(0.05)


def wait_for(condition: Callable[[], T], seconds: float | None = DISCOVERY) -> T:
    """Poll until the condition is true or the time is over (None: for ever); its last value."""
    deadline = None if seconds is None else time.monotonic() + seconds
    while True:
        value = condition()
        if value or (deadline is not None and time.monotonic() > deadline):
            return value
        time.sleep(0.02)


def spin_until(made: Any, future: Any, seconds: float | None = None, server: Watch | None = None) -> Any | None:
    """Spin the node until the future is done; its result, or None where the time was over (``seconds`` None: for ever).

    In short steps: a signal is seen by Python only between two waits.  ``server``: who is to answer; raises :class:`CommandError`
    once it has gone.
    """
    deadline = None if seconds is None else time.monotonic() + seconds
    while not future.done():
        if deadline is not None and time.monotonic() > deadline:
            return None
        rclpy.spin_once(made, timeout_sec=0.1)
        if server is not None and not future.done() and server.gone():
            raise CommandError("The server has gone: it will not answer any more")
    return future.result()


def server_of(made: Any, service: str) -> Watch:
    """Those who serve a service now, to be given to :func:`spin_until`."""
    name = made.resolve_service_name(service)
    return Watch(lambda: presence.servers(made, name))


def absolute(name: str) -> str:
    """A topic, service or action name as the graph has it."""
    return name if name.startswith("/") else f"/{name}"


def hidden(name: str) -> bool:
    """Whether ros2cli leaves the name out of its lists."""
    return any(part.startswith("_") for part in name.split("/"))


def list_names(
    kind: str, description: str, query: Callable[[Any], list[tuple[str, list[str]]]], arguments: list[str], may_hide: bool = True
) -> int:
    """The verb ``list`` of a kind of things: their names, with types where that is asked for, or how many there are instead.

    query: names and types, of a node.  may_hide: whether ros2cli leaves hidden ones out, unless it is asked for them.
    """
    parser = argparse.ArgumentParser(prog=f"ros2 {kind} list", description=description)
    parser.add_argument("-t", "--show-types", action="store_true", help=f"additionally show the {kind} type")
    parser.add_argument("-c", f"--count-{kind}s", dest="count", action="store_true", help=f"only display the number of {kind}s discovered")
    if may_hide:
        parser.add_argument(f"--include-hidden-{kind}s", dest="all", action="store_true", help=f"consider hidden {kind}s as well")
    parser.set_defaults(all=not may_hide)
    parsed = parser.parse_args(arguments)
    with node() as made:
        found = settle(made, lambda: query(made))
    shown = sorted((name, types) for name, types in found if parsed.all or not hidden(name))
    if parsed.count:
        print(len(shown))
    else:
        for name, types in shown:
            print(f"{name} [{', '.join(types)}]" if parsed.show_types else name)
    return 0
