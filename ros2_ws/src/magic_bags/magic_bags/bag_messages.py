"""The messages of a recorded bag, decoded.  Needs the message packages, but no running graph."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message

from magic_bags.bag_file import open_bag
from magic_bags.bag_types import Carrier
from magic_core.errors import Code, MagicError


def message_class(type_name: str) -> Any | None:
    """The Python class of a message type such as ``sensor_msgs/msg/Image``, None where it is not installed."""
    package, _, kind = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError, ValueError):
        return None


def messages(bag: Path, wanted: Callable[[str, str], bool] = lambda topic, type_name: True) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp of recording in nanoseconds and message, in the order of the bag.

    ``wanted`` is asked with topic and type before a message is decoded; types that are not installed are left out.  Raises BAD_BAG.
    """
    carrier = Carrier()
    with open_bag(bag) as reader:
        for connection, stamp, data in reader.messages():
            kind = message_class(connection.msgtype)
            if kind is not None and wanted(connection.topic, connection.msgtype):
                try:
                    message = deserialize_message(carrier.carry(connection, data), kind)
                except RuntimeError as error:  # RMWError: the bytes are not what their type says
                    raise MagicError(
                        Code.BAD_BAG, f"message of {connection.topic} in {bag}", str(error), f"{connection.msgtype} as installed"
                    ) from error
                yield connection.topic, stamp, message
