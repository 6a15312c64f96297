"""What the environment of a process must be before ROS is loaded.  Imports nothing of ROS."""

from __future__ import annotations

import os
import pwd
import tempfile
from pathlib import Path

from magic_core.errors import Code, MagicError


def middlewares() -> list[str]:
    """The installed middlewares (values of RMW_IMPLEMENTATION), by the ament index."""
    found: set[str] = set()
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        found |= {path.name for path in Path(prefix, "share/ament_index/resource_index/rmw_typesupport").glob("rmw_*")}
    return sorted(found - {"rmw_implementation"})  # which loads the others


def prepare() -> None:
    """See to what ROS needs of the environment: a home for its logs, and a middleware that is there.

    Raises BAD_REQUEST where RMW_IMPLEMENTATION names one that is not installed: ROS's own libraries end the process for that.
    """
    if not any(os.environ.get(name) for name in ("HOME", "ROS_HOME", "ROS_LOG_DIR")):
        try:
            os.environ["HOME"] = pwd.getpwuid(os.getuid()).pw_dir
        except KeyError:  # a user that the system does not know
            os.environ["HOME"] = tempfile.gettempdir()
    wanted, there = os.environ.get("RMW_IMPLEMENTATION"), middlewares()
    if wanted and there and wanted not in there:
        del os.environ["RMW_IMPLEMENTATION"]  # who reports the error may load ROS's libraries for that
        raise MagicError(
            Code.BAD_REQUEST, "RMW_IMPLEMENTATION", wanted, f"{', '.join(there)}, which is installed; or unset RMW_IMPLEMENTATION"
        )
