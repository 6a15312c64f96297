"""What was computed once for a reference, kept on disk under a key of everything that shaped it."""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
import threading
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from magic_matcher import __name__ as PACKAGE

#: Entries in a folder; a network's are a few megabytes each.
KEPT = 64


@lru_cache(maxsize=1)
def code() -> str:
    """A digest of this package's sources: what an older version has kept is not taken for what this one would compute."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/magic_matcher``, by default under ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / PACKAGE


def _packed(value: Any) -> bytes:
    """A value's pickle behind its digest."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    return hashlib.sha256(data).digest() + data


def _unpacked(entry: bytes) -> Any:
    """What :func:`_packed` made; raises ValueError for a damaged entry, of which a pickle may crash the process."""
    digest, data = entry[:32], entry[32:]
    if hashlib.sha256(data).digest() != digest:
        raise ValueError("the entry is damaged")
    return pickle.loads(data)


class Cache:
    """Pickled results by key in a folder; a damaged or unreadable entry is computed anew.

    The folder belongs to the user, as the pickles in it are trusted.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = Path(folder).expanduser() if folder else default_folder()
        self._lock = threading.Lock()

    def _path(self, key: str) -> Path:
        return self.folder / f"{hashlib.sha256(f'{code()} {key}'.encode()).hexdigest()}.pickle"

    def get(self, key: str, make: Callable[[], Any]) -> Any:
        """The entry of that key, made and kept where there is none; a folder that cannot be written only costs time."""
        path = self._path(key)
        with self._lock:
            try:
                return _unpacked(path.read_bytes())
            except (OSError, ValueError):
                pass
            value = make()
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                handle, name = tempfile.mkstemp(dir=self.folder, suffix=".part")
                with os.fdopen(handle, "wb") as file:
                    file.write(_packed(value))
                os.replace(name, path)
                self._prune()
            except OSError:
                pass
            return value

    def _prune(self) -> None:
        """Delete the entries that were made first, until ``KEPT`` are left."""
        entries = sorted(self.folder.glob("*.pickle"), key=lambda entry: entry.stat().st_mtime)
        for entry in entries[:-KEPT]:
            entry.unlink(missing_ok=True)
