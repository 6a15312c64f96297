"""``bag_recorder``: records topics into a rosbag2 folder, with the options of ``ros2 bag record``.

Topics are found as they appear; the messages' CDR bytes are stored as they arrive, with the QoS profiles that their publishers offer.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from magic_bags import bag_qos
from magic_bags.bag_file import BagWriter
from magic_bags.bag_messages import message_class
from magic_core import arguments
from magic_core.errors import Code, MagicError

#: How often the graph is asked for new topics, s (``ros2 bag record`` does the same).
POLL = 0.1

#: At the end: how long messages that have arrived already may take to be written, and after which silence none is left, s.
DRAIN, SILENCE = 1.0, 0.2


@dataclass(frozen=True)
class RecordOptions:
    """What to record: the named topics, those that match ``regex``, or ``everything``; hidden topics and ``/rosout`` only by name."""

    output: str
    topics: tuple[str, ...] = ()
    regex: str = ""
    everything: bool = False
    exclude: tuple[str, ...] = ()
    storage: str = "mcap"
    compression: str = "storage"

    def __post_init__(self) -> None:
        if not (self.topics or self.regex or self.everything):
            raise MagicError(Code.BAD_REQUEST, "nothing to record", None, "topic names, --regex or --all")
        try:
            re.compile(self.regex)
        except re.error as error:
            raise MagicError(Code.BAD_REQUEST, f"regex ({error})", self.regex) from None

    def wants(self, topic: str) -> bool:
        """Whether this topic is to be recorded."""
        if topic in self.exclude:
            return False
        if topic in self.topics:
            return True
        if any(part.startswith("_") for part in topic.split("/")):
            return False
        return self.everything or bool(self.regex and re.search(self.regex, topic))


class Recorder:
    """Subscribes on a node and writes until :meth:`close`. ``error`` is what ended the recording before that, None if nothing did."""

    def __init__(self, node: Node, options: RecordOptions) -> None:
        self._node = node
        self._options = options
        self._writer = BagWriter(options.output, options.storage, options.compression)
        self._seen: set[str] = set()
        self.error: MagicError | None = None
        self._discover()
        self._timer = node.create_timer(POLL, self._discover)

    @property
    def count(self) -> int:
        """Messages written so far."""
        return self._writer.count

    def close(self) -> None:
        """Ends the bag."""
        self._timer.cancel()
        self._writer.close()

    def _discover(self) -> None:
        logger = self._node.get_logger()
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._seen or not self._options.wants(topic):
                continue
            endpoints = self._node.get_publishers_info_by_topic(topic)
            if not endpoints:
                continue  # only subscribers so far: the QoS to record with is not known yet
            self._seen.add(topic)
            kind = message_class(types[0]) if len(types) == 1 else None
            if kind is None:
                logger.warning(f"{topic} is not recorded: its type {', '.join(types)} is not installed, or there are several")
                continue
            try:
                self._writer.add_topic(topic, types[0], bag_qos.recorded(endpoints))
            except MagicError as error:
                logger.warning(f"{topic} is not recorded: {error}")
                continue
            self._node.create_subscription(kind, topic, self._callback(topic), bag_qos.requested(endpoints), raw=True)
            logger.info(f"Subscribed to topic '{topic}'")

    def _callback(self, topic: str) -> Any:
        def store(data: bytes) -> None:
            if self.error is not None:
                return
            try:
                self._writer.write(topic, time.time_ns(), data)
            except (OSError, ValueError) as error:
                self.error = MagicError(Code.BAD_BAG, f"cannot write the bag ({error})", self._options.output)

        return store


def parser() -> argparse.ArgumentParser:
    """The command line, with the names of ``ros2 bag record``."""
    result = argparse.ArgumentParser(prog="bag_recorder", description="Record ROS data to a bag")
    result.add_argument("topics", nargs="*", default=[], help="topics to record")
    result.add_argument("--topics", nargs="+", default=[], dest="named_topics", help="topics to record")
    result.add_argument("-a", "--all", action="store_true", help="record all topics")
    result.add_argument("-e", "--regex", default="", help="record topics that match this regular expression")
    result.add_argument("--exclude-topics", nargs="+", default=[], help="topics not to record")
    result.add_argument("-o", "--output", default="", help="folder to make (default rosbag2_ and the time)")
    result.add_argument("-s", "--storage", default="mcap", choices=("mcap", "sqlite3"), help="storage format (default mcap)")
    result.add_argument("--compression-mode", default="storage", choices=BagWriter.COMPRESSIONS, help="default: inside the MCAP file")
    result.add_argument("--compression-format", default="zstd", choices=("zstd",), help="default zstd")
    return result


def options_from(parsed: argparse.Namespace) -> RecordOptions:
    """Options from the parsed command line; raises ``BAD_REQUEST``."""

    def full(names: list[str]) -> tuple[str, ...]:
        return tuple(name if name.startswith("/") else f"/{name}" for name in names)

    return RecordOptions(
        output=parsed.output or time.strftime("rosbag2_%Y_%m_%d-%H_%M_%S"),
        topics=full(parsed.topics + parsed.named_topics),
        regex=parsed.regex,
        everything=parsed.all,
        exclude=full(parsed.exclude_topics),
        storage=parsed.storage,
        compression=parsed.compression_mode,
    )


def main(args: list[str] | None = None) -> None:
    """Records until SIGINT or SIGTERM (status 0); status 1 with one line on stderr where it cannot."""
    own, ros = arguments.split(sys.argv[1:] if args is None else args)
    parsed = parser().parse_args(own)
    told_to_end = False

    def end(_signum: int, _frame: Any) -> None:
        # No exception: it could come between the taking of a message and its writing.
        nonlocal told_to_end
        told_to_end = True

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    status = 0
    node = recorder = None
    executor = None
    try:
        options = options_from(parsed)
        if Path(options.output).exists():
            raise MagicError(Code.BAD_BAG, "the output folder exists already", options.output)
        rclpy.init(args=ros, signal_handler_options=SignalHandlerOptions.NO)
        node = Node("rosbag2_recorder")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        recorder = Recorder(node, options)
        node.get_logger().info("Recording...")
        while recorder.error is None and not told_to_end:
            executor.spin_once(timeout_sec=0.1)
        _drain(executor, recorder)
        if recorder.error is not None:
            raise recorder.error
    except MagicError as error:
        print(f"bag_recorder: {error}", file=sys.stderr)
        status = 1
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if recorder is not None:
            recorder.close()
            print(f"{recorder.count} messages recorded in {options.output}", file=sys.stderr)
        if executor is not None:
            executor.shutdown(timeout_sec=2.0)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)


def _drain(executor: SingleThreadedExecutor, recorder: Recorder) -> None:
    """Write what had arrived before the signal: until nothing has come for a while, as a busy machine hands it over late."""
    now = heard = time.monotonic()
    deadline = now + DRAIN
    while now < deadline and now - heard < SILENCE and recorder.error is None:
        before = recorder.count
        executor.spin_once(timeout_sec=0.05)
        now = time.monotonic()
        heard = now if recorder.count != before else heard


if __name__ == "__main__":
    main()
