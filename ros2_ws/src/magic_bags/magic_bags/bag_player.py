"""``bag_player``: publishes a recorded bag with its recorded QoS and relative timing, with the options of ``ros2 bag play``.

The messages' CDR bytes go out as they were recorded, without being decoded.

Publishers: every topic of the bag whose type is installed; with ``--clock`` also ``/clock`` (rosgraph_msgs/Clock).
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from magic_bags import bag_qos
from magic_bags.bag_file import note_on, open_bag, topics_of
from magic_bags.bag_messages import message_class
from magic_bags.bag_types import Carrier
from magic_core import arguments
from magic_core.errors import Code, MagicError

#: After the last message: how long reliable subscribers have to acknowledge, s.
ACKNOWLEDGE_TIMEOUT = 2.0


@dataclass(frozen=True)
class PlayOptions:
    """What to play and how.

    ``rate``: bag seconds per second; ``clock_hz``: of ``/clock``, 0 for none; ``start_offset`` and ``duration`` (0: to the end) in bag
    seconds; ``delay`` in seconds before the first message; ``topics``: only these (empty: all); ``remap``: recorded name to published name.
    """

    bag: str
    rate: float = 1.0
    clock_hz: float = 0.0
    loop: bool = False
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    start_offset: float = 0.0
    duration: float = 0.0
    delay: float = 0.0
    remap: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if not self.rate > 0:
            raise MagicError(Code.BAD_REQUEST, "rate", self.rate, "above 0")
        for name in ("clock_hz", "start_offset", "duration", "delay"):
            if not getattr(self, name) >= 0:
                raise MagicError(Code.BAD_REQUEST, name, getattr(self, name), "0 or more")


class Player:
    """Publishes one bag on a node; :meth:`play` returns the number of messages that went out."""

    def __init__(self, node: Node, options: PlayOptions) -> None:
        self._node = node
        self._options = options
        self._clock = node.create_publisher(Clock, "/clock", 10) if options.clock_hz > 0 else None
        self._publishers: dict[tuple[str, str], Any] = {}
        self._carrier = Carrier()

    def play(self) -> int:
        """Raises ``BAD_BAG`` where the bag is unreadable, empty, or none of its topics can be published."""
        options = self._options
        with open_bag(options.bag) as reader:
            if note := note_on(reader):
                self._node.get_logger().warning(note)
            if reader.message_count == 0:
                raise MagicError(Code.BAD_BAG, f"the bag is empty{note and '; '}{note}", options.bag)
            self._advertise(topics_of(reader))
            connections = [c for c in reader.connections if (c.topic, c.msgtype) in self._publishers]
            start = reader.start_time + round(options.start_offset * 1e9)
            stop = min(reader.end_time, start + round(options.duration * 1e9)) if options.duration > 0 else reader.end_time
            if start >= reader.end_time:
                length = (reader.end_time - reader.start_time) * 1e-9
                raise MagicError(Code.BAD_REQUEST, "start_offset", options.start_offset, f"less than the bag's {length:.3f} s")
            self._sleep_until(time.monotonic() + options.delay)
            count = 0
            while True:
                count += self._play_once(reader, connections, start, stop)
                if not options.loop:
                    break
            for publisher in self._publishers.values():
                publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=ACKNOWLEDGE_TIMEOUT))
            return count

    def _advertise(self, topics: tuple[Any, ...]) -> None:
        options = self._options
        known = {t.name for t in topics}
        for name in options.topics + options.exclude:
            if name not in known:
                raise MagicError(Code.BAD_BAG, "the bag has no such topic", name, sorted(known))
        remap = dict(options.remap)
        for topic in topics:
            if (options.topics and topic.name not in options.topics) or topic.name in options.exclude:
                continue
            if topic.name == "/clock" and self._clock is not None:
                continue
            kind = message_class(topic.type_name)
            if kind is None:
                self._node.get_logger().warning(f"{topic.name} is not played: its type {topic.type_name} is not installed")
                continue
            profile = bag_qos.offered(topic.qos, topic.count)
            self._publishers[topic.name, topic.type_name] = self._node.create_publisher(kind, remap.get(topic.name, topic.name), profile)
        if not self._publishers:
            raise MagicError(Code.BAD_BAG, "nothing in the bag can be played", options.bag, [f"{t.name} ({t.type_name})" for t in topics])

    def _play_once(self, reader: Any, connections: list[Any], start: int, stop: int) -> int:
        began = time.monotonic()
        rate = self._options.rate
        period = 1e9 * rate / self._options.clock_hz if self._clock is not None else 0.0
        ticks = 0
        count = 0

        def due(stamp: float) -> float:
            return began + (stamp - start) * 1e-9 / rate

        def tick(until: float) -> None:
            nonlocal ticks
            while self._clock is not None and start + ticks * period <= until:
                stamp = start + round(ticks * period)
                self._sleep_until(due(stamp))
                message = Clock()
                message.clock.sec, message.clock.nanosec = divmod(stamp, 10**9)
                self._clock.publish(message)
                ticks += 1

        for connection, stamp, data in reader.messages(connections, start, stop):
            tick(stamp)
            self._sleep_until(due(stamp))
            self._publishers[connection.topic, connection.msgtype].publish(self._carrier.carry(connection, data))
            count += 1
        tick(stop)
        return count

    @staticmethod
    def _sleep_until(when: float) -> None:
        left = when - time.monotonic()
        if left > 0:
            time.sleep(left)


def parser() -> argparse.ArgumentParser:
    """The command line, with the names of ``ros2 bag play``."""
    result = argparse.ArgumentParser(prog="bag_player", description="Play back ROS data from a bag")
    result.add_argument("bag_path", help="bag to play: a rosbag2 folder, or an .mcap or .db3 file")
    result.add_argument("-r", "--rate", type=float, default=1.0, help="rate at which to play back messages; above 0 (default 1.0)")
    result.add_argument("--clock", type=float, nargs="?", const=40.0, default=0.0, metavar="HZ", help="publish /clock (default at 40 Hz)")
    result.add_argument("-l", "--loop", action="store_true", help="start again at the end, until interrupted")
    result.add_argument("--topics", nargs="+", default=[], help="topics to play; without it all")
    result.add_argument("--exclude-topics", nargs="+", default=[], help="topics not to play")
    result.add_argument("--start-offset", type=float, default=0.0, help="start this many seconds into the bag")
    result.add_argument("--playback-duration", type=float, default=0.0, help="play this many bag seconds; 0 for all")
    result.add_argument("-d", "--delay", type=float, default=0.0, help="sleep this many seconds before the first message")
    result.add_argument("-m", "--remap", nargs="+", default=[], metavar="OLD:=NEW", help="topics to publish under another name")
    return result


def options_from(parsed: argparse.Namespace) -> PlayOptions:
    """Options from the parsed command line; raises ``BAD_REQUEST``."""
    remap = []
    for rule in parsed.remap:
        old, separator, new = rule.partition(":=")
        if not (old and separator and new):
            raise MagicError(Code.BAD_REQUEST, "remap", rule, "OLD:=NEW")
        remap.append((old, new))
    return PlayOptions(
        bag=parsed.bag_path,
        rate=parsed.rate,
        clock_hz=parsed.clock,
        loop=parsed.loop,
        topics=tuple(parsed.topics),
        exclude=tuple(parsed.exclude_topics),
        start_offset=parsed.start_offset,
        duration=parsed.playback_duration,
        delay=parsed.delay,
        remap=tuple(remap),
    )


def interrupt(_signum: int, _frame: Any) -> None:
    """Signal handler: ends the sleep or the wait that the process is in."""
    raise KeyboardInterrupt


def main(args: list[str] | None = None) -> None:
    """Exit status 0 at the end of the bag and on SIGINT or SIGTERM, 1 with one line on stderr where the bag cannot be played."""
    own, ros = arguments.split(sys.argv[1:] if args is None else args)
    parsed = parser().parse_args(own)
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    status = 0
    node = None
    try:
        options = options_from(parsed)
        rclpy.init(args=ros, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("rosbag2_player")
        count = Player(node, options).play()
        node.get_logger().info(f"played {count} messages of {options.bag}")
    except KeyboardInterrupt:
        pass
    except MagicError as error:
        print(f"bag_player: {error}", file=sys.stderr)
        status = 1
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)


if __name__ == "__main__":
    main()
