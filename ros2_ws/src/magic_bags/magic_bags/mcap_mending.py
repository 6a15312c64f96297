"""MCAP files that were cut off: a recorder that was killed, a disk that was full.

An MCAP file is a row of records, most of them chunks of messages that can be read by themselves; only the index at the end is lost
with the end (https://mcap.dev/spec).
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

MAGIC = b"\x89MCAP0\r\n"
#: Records: the footer, a chunk, and the end of the data section.
FOOTER, CHUNK, DATA_END = 0x02, 0x06, 0x0F
#: What stands for the lost end: an empty DataEnd, and a Footer that says that there is no index.
END = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC


def is_cut_off(path: Path) -> bool:
    """Whether a file begins as MCAP and does not end as MCAP."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
        size = file.seek(0, io.SEEK_END)
        file.seek(max(0, size - len(MAGIC)))
        return file.read() != MAGIC or size < 2 * len(MAGIC)


def whole_records(path: Path) -> tuple[int, int]:
    """Up to which byte a file consists of whole records, and where the last chunk among these begins (else the same byte)."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        end = file.seek(len(MAGIC))
        last = None
        while end + 9 <= size:
            file.seek(end)
            kind, length = struct.unpack("<BQ", file.read(9))
            if kind in (0, FOOTER, DATA_END) or end + 9 + length > size:
                break
            last = end if kind == CHUNK else last
            end += 9 + length
    return end, end if last is None else last


class Mended:
    """Stands for the path of a file, of which it gives the first ``length`` bytes and an end that needs no index."""

    def __init__(self, path: Path, length: int) -> None:
        self._path, self._length = path, length
        self.suffix = path.suffix

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        """As Path's."""
        return self._path.exists()

    def is_dir(self) -> bool:
        """As Path's."""
        return False

    def open(self, mode: str = "rb") -> Any:
        """The mended file, to be read."""
        return io.BufferedReader(_MendedFile(self._path, self._length))


class _MendedFile(io.RawIOBase):
    def __init__(self, path: Path, length: int) -> None:
        self._file, self._length, self._at = path.open("rb"), length, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._length + len(END)}[whence]
        self._at = base + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._length:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._length - self._at))
        else:
            data = END[self._at - self._length :][: len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
