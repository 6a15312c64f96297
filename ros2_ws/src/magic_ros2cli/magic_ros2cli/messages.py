"""Messages as YAML, both ways, in the shape of rosidl_runtime_py (which the PyPI wheels do not have)."""

from __future__ import annotations

import array
import importlib
import os
import sys
from typing import Any

import numpy as np
import yaml

from magic_ros2cli.errors import CommandError

# The generated setters check types and ranges only where this is set before the first message package is imported.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")

#: ``ros2 topic echo`` cuts strings and sequences after so many elements.
TRUNCATE = 128


def interface(name: str, kind: str) -> Any:
    """The Python class of a type name such as ``std_msgs/msg/String``; ``kind`` is msg, srv or
    action. ``std_msgs/String`` is read alike."""
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    what = {"msg": "message", "srv": "service", "action": "action"}[kind]
    if len(parts) != 3 or parts[1] != kind or not all(p.isidentifier() for p in parts):
        raise CommandError(f"The passed {what} type is invalid: '{name}' (allowed: package/{kind}/Type)")
    try:
        return getattr(importlib.import_module(f"{parts[0]}.{kind}"), parts[2])
    except (ImportError, AttributeError):
        raise CommandError(f"The passed {what} type is invalid: '{name}' is not installed") from None


def to_dict(message: Any, truncate: int | None = None, no_arr: bool = False, no_str: bool = False) -> dict[str, Any]:
    """A message's fields, nested messages as dicts, in the order of the definition."""
    result = {}
    for (name, type_text), slot in zip(message.get_fields_and_field_types().items(), message.SLOT_TYPES, strict=True):
        result[name] = _plain(getattr(message, name), type_text, slot, truncate, no_arr, no_str)
    return result


def _plain(value: Any, type_text: str, slot: Any, truncate: int | None, no_arr: bool, no_str: bool) -> Any:
    if isinstance(value, np.generic):  # before float, which numpy's float64 is as well
        return value.item()
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, str):
        if no_str:
            return f"<string length: <{len(value)}>>"
        return value[:truncate] + "..." if truncate is not None and len(value) > truncate else value
    if isinstance(value, (list, tuple, array.array, np.ndarray)):
        if no_arr and slot is not None:
            element = type_text.removeprefix("sequence<").rstrip(">").split(",")[0].split("[")[0]
            size = getattr(slot, "size", None)
            return f"<array type: {element}[{size}]>" if size else f"<sequence type: {element}, length: {len(value)}>"
        cut = truncate is not None and len(value) > truncate
        items = [_plain(v, "", None, truncate, no_arr, no_str) for v in (value[:truncate] if cut else value)]
        return [*items, "..."] if cut else items
    return to_dict(value, truncate, no_arr, no_str)


def dump(value: Any, flow_style: bool = False) -> str:
    """YAML text of a dict or a plain value, as ``ros2 topic echo`` prints it."""
    text = yaml.dump(value, allow_unicode=True, width=sys.maxsize, default_flow_style=flow_style, sort_keys=False)
    return text.removesuffix("...\n")


def to_yaml(message: Any, **options: Any) -> str:
    """YAML text of a message; options of :func:`to_dict`."""
    return dump(to_dict(message, **options))


def parse(text: str) -> dict[str, Any]:
    """The YAML mapping that a user typed for a message."""
    try:
        values = yaml.safe_load(text) if text.strip() else {}
    except yaml.YAMLError as error:
        raise CommandError(f"The passed value needs to be a dictionary in YAML format ({' '.join(str(error).split())})") from None
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise CommandError(f"The passed value needs to be a dictionary in YAML format, not {values!r}")
    return values


def fill(message: Any, values: dict[str, Any]) -> Any:
    """Set a message's fields from a mapping; the message. Fields that are not named keep their defaults.

    Raises :class:`CommandError` that names the field, the value and what is allowed.
    """
    fields = message.get_fields_and_field_types()
    slots = dict(zip(fields, message.SLOT_TYPES, strict=True))
    for name, value in values.items():
        if name not in fields:
            raise CommandError(f"Failed to populate field: {type(message).__name__} has no field '{name}' (allowed: {', '.join(fields)})")
        try:
            setattr(message, name, _typed(getattr(message, name), value, slots[name]))
        except CommandError:
            raise
        except (AssertionError, TypeError, ValueError, OverflowError) as error:
            reason = " ".join(str(error).split())
            raise CommandError(f"Failed to populate field: '{name}' ({fields[name]}) cannot be {value!r}: {reason}") from None
    return message


def _typed(current: Any, value: Any, slot: Any) -> Any:
    if isinstance(current, (array.array, np.ndarray)):
        if isinstance(value, str):
            value = list(value.encode())
        if isinstance(current, array.array) and current.typecode in "fd":
            return [float(v) for v in value]
        return np.asarray(value, dtype=current.dtype) if isinstance(current, np.ndarray) else list(value)
    if isinstance(current, (list, tuple)):
        if not isinstance(value, (list, tuple)):
            raise TypeError("a list is wanted")
        kind = _class_of(slot.value_type)
        if kind is not None:
            return [fill(kind(), _mapping(v)) for v in value]
        typename = getattr(slot.value_type, "typename", "string")
        return [bytes([v]) if typename == "octet" and isinstance(v, int) else str(v) if typename == "string" else v for v in value]
    if isinstance(current, bool):
        if not isinstance(value, bool):
            raise TypeError("true or false is wanted")
        return value
    if isinstance(current, bytes):
        return value if isinstance(value, bytes) else bytes([value]) if isinstance(value, int) else str(value).encode("latin-1")
    if isinstance(current, (int, float, str)):
        if isinstance(value, (dict, list)):
            raise TypeError("a single value is wanted")
        return type(current)(value)
    if value == "now" and type(current).__name__ == "Time":
        import time

        current.sec, current.nanosec = divmod(time.time_ns(), 10**9)
        return current
    if value == "auto" and type(current).__name__ == "Header":
        current.stamp = _typed(current.stamp, "now", None)
        return current
    return fill(current, _mapping(value))


def _mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError("a mapping of fields is wanted")
    return value


def _class_of(slot: Any) -> Any | None:
    """The message class of a slot type of the generated code, None for basic types and strings."""
    names = getattr(slot, "namespaces", None)
    if not names:
        return None
    return getattr(importlib.import_module(".".join(names)), slot.name)
