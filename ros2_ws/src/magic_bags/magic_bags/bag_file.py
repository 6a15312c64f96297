"""Recorded bags as files: what is in one, and what a new one needs. Imports no rclpy.

The files are rosbag2's (MCAP or SQLite, metadata version 9), read and written by the ``rosbags`` library, so that ``ros2 bag`` of an
installed ROS and the tools of this package can use each other's bags.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magic_bags import mcap_mending
from magic_core.errors import Code, MagicError


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag. ``qos`` are the profiles (``rosbags.interfaces.Qos``) that its publishers offered."""

    name: str
    type_name: str
    count: int
    qos: tuple[Any, ...]


@dataclass(frozen=True)
class BagInfo:
    """What a bag holds. Times in nanoseconds since the epoch; ``end`` is the last message's stamp.

    ``note``: what became of a bag that was cut off; empty for whole ones.
    """

    files: tuple[str, ...]
    size: int
    storage: str
    distro: str
    start: int
    end: int
    count: int
    compression: str
    topics: tuple[BagTopic, ...]
    note: str = ""

    def format(self) -> str:
        """The text of ``ros2 bag info``."""

        def stamp(nanoseconds: int) -> str:
            seconds, rest = divmod(nanoseconds, 10**9)
            return f"{time.strftime('%b %e %Y %H:%M:%S', time.localtime(seconds))}.{rest:09d} ({seconds}.{rest:09d})"

        indent = "\n" + " " * 19
        topics = indent.join(f"Topic: {t.name} | Type: {t.type_name} | Count: {t.count} | Serialization Format: cdr" for t in self.topics)
        size, unit = float(self.size), "B"
        for larger in ("KiB", "MiB", "GiB"):
            if size >= 1024:
                size, unit = size / 1024, larger
        lines = [
            "",
            f"Files:             {indent.join(self.files)}",
            f"Bag size:          {size:.1f} {unit}",
            f"Storage id:        {self.storage}",
            f"ROS Distro:        {self.distro}",
            f"Duration:          {(self.end - self.start) * 1e-9:.9f}s",
            f"Start:             {stamp(self.start)}",
            f"End:               {stamp(self.end)}",
            f"Messages:          {self.count}",
            f"Topic information: {topics}",
            "Service:           0",
            "Service information: ",
        ]
        if self.compression:
            lines.insert(4, f"Compression:       {self.compression}")
        if self.note:
            lines.append(f"Note:              {self.note}")
        return "\n".join(lines) + "\n"


@contextmanager
def open_bag(path: Path | str) -> Iterator[Any]:
    """The ``rosbags`` reader of a bag: a folder with ``metadata.yaml``, or a single ``.mcap`` or ``.db3`` file.

    Of an MCAP file that was cut off, alone or as the one file of a folder, what is there is read; :func:`note_on` says so.
    Raises ``BAD_BAG`` where there is none, or where it cannot be read.
    """
    path = Path(path)
    try:
        reader = _opened(path)
    except MagicError:
        raise
    except FileNotFoundError:
        raise MagicError(Code.BAD_BAG, "no such bag", str(path), "a rosbag2 folder, or an .mcap or .db3 file") from None
    except Exception as error:  # the library lets out whatever the bytes of a broken file bring about
        raise _unreadable(path, error) from error
    try:
        yield reader
    except Exception as error:
        if _from_library(error):
            raise _unreadable(path, error) from error
        raise
    finally:
        reader.close()


def _unreadable(path: Path, error: Exception) -> MagicError:
    return MagicError(Code.BAD_BAG, f"cannot read the bag ({str(error) or type(error).__name__})", str(path))


def _from_library(error: BaseException) -> bool:
    """Whether an exception came out of the library that reads bags, rather than out of what was done with its messages."""
    frame = error.__traceback__
    while frame is not None:
        if "/rosbags/" in frame.tb_frame.f_code.co_filename:
            return True
        frame = frame.tb_next
    return False


def _opened(path: Path) -> Any:
    """An open reader; of what was cut off, as much as there is."""
    from rosbags.rosbag2 import Reader, ReaderError

    file = _only_file(path)
    cut_off = file is not None and file.suffix == ".mcap" and file.is_file() and mcap_mending.is_cut_off(file)
    if not cut_off:
        if path.is_dir() and file is not None and not (path / "metadata.yaml").exists():
            path = file
        reader = Reader(path)
        reader.open()
        return reader
    for length in dict.fromkeys(mcap_mending.whole_records(file)):  # the last chunk may be whole in length and broken in content
        reader = Reader(mcap_mending.Mended(file, length))
        try:
            reader.open()
            return reader
        except Exception as error:
            failure = error
    raise ReaderError(f"it was cut off, and nothing before that can be read: {failure}")


def _only_file(path: Path) -> Path | None:
    """The one file of a bag; None where it has several.  Raises BAD_BAG for a folder that is no bag, or whose recorder left it so."""
    if not path.is_dir():
        return path
    files = [p for p in sorted(path.iterdir()) if p.suffix in (".mcap", ".db3")]
    if not (path / "metadata.yaml").exists():
        if not files:
            raise MagicError(Code.BAD_BAG, "the folder holds no metadata.yaml", str(path), "a rosbag2 folder, or an .mcap or .db3 file")
        if len(files) > 1:
            raise MagicError(
                Code.BAD_BAG,
                f"the folder holds {len(files)} files and no metadata.yaml, as a recorder that was killed leaves it",
                str(path),
                f"one of its files, such as {files[0].name}, or the folder after `ros2 bag reindex`",
            )
    return files[0] if len(files) == 1 else None


def note_on(reader: Any) -> str:
    """What there is to say of an open reader's bag: that it was cut off; else empty."""
    if not isinstance(reader.path, mcap_mending.Mended):
        return ""
    return f"{reader.path} was cut off; its {reader.message_count} messages before that can be used"


def topics_of(reader: Any) -> tuple[BagTopic, ...]:
    """The topics of an open reader, one for each name and type, sorted by name."""
    topics: dict[tuple[str, str], BagTopic] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        qos = tuple(connection.ext.offered_qos_profiles)
        before = topics.get(key)
        topics[key] = BagTopic(*key, connection.msgcount + (before.count if before else 0), qos + (before.qos if before else ()))
    return tuple(topics[key] for key in sorted(topics))


def info(path: Path | str) -> BagInfo:
    """What the bag holds; raises ``BAD_BAG``."""
    path = Path(path)
    with open_bag(path) as reader:
        metadata = reader.storage.metadata
        files = sorted(p for p in path.iterdir() if p.name != "metadata.yaml") if path.is_dir() else [path]
        files = [p for p in files if {".mcap", ".db3"} & set(p.suffixes)]
        empty = reader.message_count == 0
        return BagInfo(
            files=tuple(p.name for p in files),
            size=sum(p.stat().st_size for p in files),
            storage="mcap" if files and ".mcap" in files[0].suffixes else "sqlite3",
            distro=metadata.ros_distro or "unknown",
            start=0 if empty else reader.start_time,
            end=0 if empty else reader.end_time - 1,  # the library's end is one past the last stamp
            count=reader.message_count,
            compression=f"{metadata.compression_format} ({metadata.compression_mode})" if metadata.compression_mode else "",
            topics=topics_of(reader),
            note=note_on(reader),
        )


# ---------------------------------------------------------------------------------------------- message definitions

_FIELD = re.compile(r"^\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[a-z]\w*\s*(?:$|[^=\s])")
_PRIMITIVES = frozenset(
    [
        "bool",
        "byte",
        "char",
        "float32",
        "float64",
        "int8",
        "uint8",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
        "string",
        "wstring",
        "duration",
        "time",
    ]
)


def nested_type(line: str, package: str) -> str | None:
    """The message type of the field that a line of a definition declares, as ``package/msg/Type``; None: a constant or of a plain type.

    ``line`` without its comment; ``package``: of the definition, in which types without a package are.
    """
    field = _FIELD.match(line)
    if not field or field["type"] in _PRIMITIVES:
        return None
    kind = field["type"].split("/")
    if kind == ["Header"]:
        kind = ["std_msgs", "Header"]
    return f"{kind[0] if len(kind) > 1 else package}/msg/{kind[-1]}"


def share_of(package: str) -> Path:
    """The share folder of an installed package; raises ``BAD_BAG`` where there is none."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        share = Path(prefix) / "share" / package
        if prefix and (share / "package.xml").exists():
            return share
    raise MagicError(Code.BAD_BAG, "the package of a message type is not installed", package)


def message_definition(type_name: str) -> tuple[str, str]:
    """Full text (with the nested types' texts after it, as rosbag2 stores it) and RIHS01 hash of an installed message type.

    ``type_name`` like ``sensor_msgs/msg/Image``. Raises ``BAD_BAG`` where it is not installed.
    """
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg":
        raise MagicError(Code.BAD_BAG, "not a message type", type_name, "package/msg/Type")

    def text_of(name: str) -> str:
        package, _, kind = name.split("/")
        path = share_of(package) / "msg" / f"{kind}.msg"
        try:
            return path.read_text()
        except OSError:
            raise MagicError(Code.BAD_BAG, "the message type has no installed definition", name) from None

    texts = {type_name: text_of(type_name)}
    waiting = [type_name]
    while waiting:
        name = waiting.pop(0)
        for line in texts[name].splitlines():
            nested = nested_type(line.split("#", 1)[0], name.split("/")[0])
            if nested is not None and nested not in texts:
                texts[nested] = text_of(nested)
                waiting.append(nested)
    definition = texts.pop(type_name)
    for name, text in texts.items():
        package, _, kind = name.split("/")
        definition += f"\n{'=' * 80}\nMSG: {package}/{kind}\n{text}"
    description = json.loads((share_of(parts[0]) / "msg" / f"{parts[2]}.json").read_text())
    return definition, next(h["hash_string"] for h in description["type_hashes"] if h["type_name"] == type_name)


# ---------------------------------------------------------------------------------------------- writing


class BagWriter:
    """A new rosbag2 folder, MCAP by default, metadata version 9.

    ``compression``: ``storage`` compresses the chunks inside the MCAP file with zstd (every reader of MCAP can seek in it), ``message``
    and ``file`` are rosbag2's two modes, ``none`` writes as it is. Raises ``BAD_BAG`` where the folder exists already.
    """

    COMPRESSIONS = ("storage", "message", "file", "none")

    def __init__(self, path: Path | str, storage: str = "mcap", compression: str = "storage") -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError

        if storage not in ("mcap", "sqlite3"):
            raise MagicError(Code.BAD_BAG, "unknown storage", storage, ("mcap", "sqlite3"))
        if compression not in self.COMPRESSIONS:
            raise MagicError(Code.BAD_BAG, "unknown compression mode", compression, self.COMPRESSIONS)
        if compression == "storage" and storage == "sqlite3":
            compression = "none"
        try:
            self._writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
            self._writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise MagicError(Code.BAD_BAG, f"cannot write the bag ({error})", str(path)) from error
        self.path = Path(path)
        self.count = 0
        self._connections: dict[str, Any] = {}

    def add_topic(self, topic: str, type_name: str, qos: tuple[Any, ...] = ()) -> None:
        """A topic of an installed message type, with the offered QoS profiles (``rosbags.interfaces.Qos``)."""
        definition, digest = message_definition(type_name)
        self._connections[topic] = self._writer.add_connection(
            topic, type_name, msgdef=definition, rihs01=digest, offered_qos_profiles=list(qos)
        )

    def write(self, topic: str, stamp: int, data: bytes) -> None:
        """One message: the stamp in nanoseconds since the epoch, and the CDR bytes with their 4-byte header."""
        self._writer.write(self._connections[topic], stamp, data)
        self.count += 1

    def close(self) -> None:
        """Writes the index and ``metadata.yaml``; a bag without messages is closed too."""
        if self.count == 0:
            self._writer.min_timestamp = self._writer.max_timestamp = 0
        self._writer.close()
