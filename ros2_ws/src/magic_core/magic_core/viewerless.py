"""Open3D without its viewer for the browser, whose libraries (Dash, IPython, requests) take longer to import than all the rest of it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

VIEWER = "open3d.visualization.draw_plotly"


class _Later(ModuleType):
    """Stands for the viewer's module until one of its functions is called."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*args: Any, **kwargs: Any) -> Any:
            if sys.modules.get(VIEWER) is self:
                del sys.modules[VIEWER]
            return getattr(importlib.import_module(VIEWER), name)(*args, **kwargs)

        return call


def prepare() -> None:
    """From here on importing Open3D imports its viewer only when that is used; does nothing where Open3D
    is there already, and imports nothing."""
    if "open3d" not in sys.modules:
        sys.modules.setdefault(VIEWER, _Later(VIEWER))
