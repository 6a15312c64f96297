"""Messages of bags that were recorded with another definition of their type, as messages of the installed one. Imports no rclpy.

A bag carries the definitions of its messages. Where one differs from what is installed (a field was added since), each message is read
by the bag's own definition and written by the installed one: fields of the same name are taken over, new ones are zero or empty, old
ones are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from magic_bags.bag_file import message_definition
from magic_core.errors import Code, MagicError


class Carrier:
    """Brings messages to the installed definitions; one for a bag."""

    def __init__(self) -> None:
        self._ways: dict[tuple[str, str], _Way | None] = {}

    def carry(self, connection: Any, data: bytes | memoryview) -> bytes:
        """CDR bytes of a message of a ``rosbags`` connection, as the installed type has them.

        The same bytes where the definitions agree or nothing is known of them.  Raises ``BAD_BAG`` where a message cannot be carried over.
        """
        key = (connection.msgtype, connection.digest)
        if key not in self._ways:
            self._ways[key] = _way(connection)
        way = self._ways[key]
        return bytes(data) if way is None else way.carry(connection.topic, bytes(data))


def _way(connection: Any) -> _Way | None:
    """None where the bag's definition is the installed one, or one of the two is not known."""
    try:
        definition, digest = message_definition(connection.msgtype)
    except MagicError:  # not installed, or without its sources: nothing to compare with
        return None
    text = getattr(connection.msgdef, "data", "")
    if not text or not connection.digest or connection.digest == digest:
        return None
    return _Way(connection.msgtype, text, definition)


class _Way:
    """From one definition of a type to another."""

    def __init__(self, name: str, old: str, new: str) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._name = name
        self._old, self._new = get_typestore(Stores.EMPTY), get_typestore(Stores.EMPTY)
        for store, text in ((self._old, old), (self._new, new)):
            store.register({kind: fields for kind, fields in get_types_from_msg(text, name).items() if kind not in store.fielddefs})

    def carry(self, topic: str, data: bytes) -> bytes:
        try:
            message = self._made(self._name, self._old.deserialize_cdr(data, self._name))
            return bytes(self._new.serialize_cdr(message, self._name))
        except Exception as error:  # whatever the library makes of bytes that are not what their definition says
            raise MagicError(
                Code.BAD_BAG,
                f"message of {topic}, recorded with another definition of {self._name}",
                str(error) or type(error).__name__,
                "one that its own definition can read",
            ) from error

    def _made(self, name: str, message: Any | None) -> Any:
        """A message of the new type from one of the old type, or with nothing in it."""
        values = {
            field: self._value(kind, getattr(message, field, None) if message is not None else None)
            for field, kind in self._new.fielddefs[name][1]
        }
        return self._new.types[name](**values)

    def _value(self, kind: Any, value: Any) -> Any:
        from rosbags.interfaces import Nodetype

        node, detail = kind
        if node == Nodetype.BASE:
            return value if value is not None else _nothing(detail[0])
        if node == Nodetype.NAME:
            return self._made(detail, value)
        inner, length = detail
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return np.zeros(length if node == Nodetype.ARRAY else 0, inner[1][0]) if value is None else np.asarray(value, inner[1][0])
        items = [None] * (length if node == Nodetype.ARRAY else 0) if value is None else value
        return [self._value(inner, item) for item in items]


def _nothing(base: str) -> Any:
    return "" if base == "string" else False if base == "bool" else 0.0 if base.startswith("float") else 0
