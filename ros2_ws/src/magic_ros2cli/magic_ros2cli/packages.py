"""Installed packages, found through the ament index; imports nothing of ROS."""

from __future__ import annotations

import os
from pathlib import Path

from magic_ros2cli.errors import CommandError


def names() -> list[str]:
    """Names of all installed packages, sorted."""
    found = set()
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        index = Path(prefix or os.devnull) / "share" / "ament_index" / "resource_index" / "packages"
        found |= {path.name for path in index.iterdir() if path.is_file() and not path.name.startswith(".")} if index.is_dir() else set()
    return sorted(found)


def prefix_of(package: str) -> Path:
    """Prefix that a package is installed in; raises :class:`CommandError` with ros2cli's words."""
    if package and "/" not in package:
        for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
            if prefix and (Path(prefix) / "share" / "ament_index" / "resource_index" / "packages" / package).exists():
                return Path(prefix)
    raise CommandError(f"Package '{package}' not found")


def share_of(package: str) -> Path:
    """Share folder of an installed package."""
    return prefix_of(package) / "share" / package


def executables_of(package: str) -> list[Path]:
    """The executables of a package, sorted."""
    folder = prefix_of(package) / "lib" / package
    return sorted(p for p in folder.rglob("*") if p.is_file() and os.access(p, os.X_OK))


def executable(package: str, name: str) -> Path:
    """One executable of a package; raises :class:`CommandError` with ros2cli's words."""
    found = [p for p in executables_of(package) if p.name == name]
    if not found:
        raise CommandError("No executable found")
    if len(found) > 1:
        raise CommandError("Multiple executables found:\n" + "\n".join(f"- {p}" for p in found))
    return found[0]
