"""Who serves a service and who waits for its answers, by DDS endpoint: a server that was restarted is another one than before.  Whether a
bag is played."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node

#: How long an endpoint may be missing before it counts as gone, s.  A participant that the middleware has dropped because a busy
#: machine held up its announcements is found again with its next one (``ros2_ws/fastdds.xml``: 0.3 s).
BLINK = 0.6
#: What those who play bags call their node.
PLAYER = "rosbag2_player"


def servers(node: Node, service: str) -> frozenset[bytes]:
    """Those who take the requests of a service, given by its full name; empty where the middleware does not tell."""
    return _readers(node, f"rq{service}Request")


def askers(node: Node, service: str) -> frozenset[bytes]:
    """Those who take the answers of a service, given by its full name; empty where the middleware does not tell."""
    return _readers(node, f"rr{service}Reply")


def publishers(node: Node, topic: str) -> frozenset[bytes]:
    """Those who publish a topic, given by its full name."""
    return frozenset(bytes(i.endpoint_gid) for i in node.get_publishers_info_by_topic(topic))


def playing(node: Node) -> bool:
    """Whether somebody plays a bag, whose stamps are of another time."""
    return PLAYER in node.get_node_names()


def _readers(node: Node, dds_topic: str) -> frozenset[bytes]:
    # Services have no such query of their own; below it they are topics with these names in every DDS middleware.
    return frozenset(bytes(i.endpoint_gid) for i in node.get_subscriptions_info_by_topic(dds_topic, no_mangle=True))


class Watch:
    """Tells when all of the endpoints that were there at the start have gone.

    ``look`` gives the endpoints that are there now.  Where there were none at the start, the first ones seen are watched.
    """

    def __init__(self, look: Callable[[], frozenset[bytes]], clock: Callable[[], float] = time.monotonic) -> None:
        self._look, self._clock = look, clock
        self._first = look()
        self._missing_since: float | None = None

    @property
    def begun(self) -> bool:
        """Whether there has been anybody yet."""
        return bool(self._first)

    def gone(self) -> bool:
        """Whether none of the first ones has been there for :data:`BLINK` seconds; to be asked several times a second."""
        now = self._look()
        if not self._first:
            self._first = now
        if not self._first or self._first & now:
            self._missing_since = None
            return False
        if self._missing_since is None:
            self._missing_since = self._clock()
        return self._clock() - self._missing_since >= BLINK
