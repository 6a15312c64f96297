"""What was computed once for a reference, kept on disk under a key of everything that shaped it."""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from magic_matcher import __name__ as PACKAGE

#: Counted up when the meaning of what is kept changes.
VERSION = 1


def default_folder() -> Path:
    """``$XDG_CACHE_HOME/magic_matcher``, by default under ``~/.cache``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / PACKAGE


class Cache:
    """Pickled results by key in a folder; a damaged or unreadable entry is computed anew.

    The folder belongs to the user, as the pickles in it are trusted.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = Path(folder).expanduser() if folder else default_folder()
        self._lock = threading.Lock()

    def _path(self, key: str) -> Path:
        return self.folder / f"{hashlib.sha256(f'{VERSION} {key}'.encode()).hexdigest()}.pickle"

    def get(self, key: str, make: Callable[[], Any]) -> Any:
        """The entry of that key, made and kept where there is none; a folder that cannot be written only costs time."""
        path = self._path(key)
        with self._lock:
            try:
                with open(path, "rb") as file:
                    return pickle.load(file)
            except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError, ValueError):
                pass
            value = make()
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                handle, name = tempfile.mkstemp(dir=self.folder, suffix=".part")
                with os.fdopen(handle, "wb") as file:
                    pickle.dump(value, file, protocol=pickle.HIGHEST_PROTOCOL)
                os.replace(name, path)
            except OSError:
                pass
            return value
