"""A small buffer of transforms: what a camera node needs of tf2, which has no Python package on PyPI."""

from __future__ import annotations

from bisect import bisect, insort

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError


class TransformBuffer:
    """Frames and the transforms between them, static or over the last ``memory`` seconds."""

    def __init__(self, memory: float = 10.0) -> None:
        self.memory = memory
        self._parent: dict[str, str] = {}
        self._static: dict[str, NDArray[np.float64]] = {}
        self._moving: dict[str, list[tuple[float, int, NDArray[np.float64]]]] = {}
        self._count = 0

    def set(self, parent: str, child: str, parent_from_child: NDArray[np.float64], stamp: float = 0.0, static: bool = False) -> None:
        """Take in one transform; a leading slash of a frame's name is dropped, as tf2 does."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not parent or not child or parent == child:
            raise MagicError(Code.NO_TRANSFORM, "frames of a transform", f"{parent!r} and {child!r}", "two different names")
        if not np.all(np.isfinite(parent_from_child)):
            raise MagicError(Code.NO_TRANSFORM, f"transform {parent} from {child}", "NaN or infinite", "finite numbers")
        self._parent[child] = parent
        if static:
            self._static[child] = parent_from_child
            self._moving.pop(child, None)
            return
        self._static.pop(child, None)
        track = self._moving.setdefault(child, [])
        if track and stamp < track[-1][0] - self.memory:
            track.clear()  # time went back: a bag was started again
        self._count += 1
        insort(track, (stamp, self._count, parent_from_child), key=lambda item: item[:2])
        while track[0][0] < track[-1][0] - self.memory:
            track.pop(0)

    def frames(self) -> list[str]:
        """All names that are known."""
        return sorted(set(self._parent) | set(self._parent.values()))

    def lookup(self, target: str, source: str, stamp: float | None = None, reach: float = 0.5) -> NDArray[np.float64]:
        """target_from_source (4, 4) at a stamp (``None``: the newest), interpolated; at most ``reach`` seconds beyond what is known.

        Raises ``NO_TRANSFORM`` that names the frames, and which are known.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        up_source, up_target = self._up(source, stamp, reach), self._up(target, stamp, reach)
        for frame, root_from_target in up_target.items():
            if frame in up_source:
                return transforms.inverse(root_from_target) @ up_source[frame]
        raise MagicError(
            Code.NO_TRANSFORM,
            f"transform from {source!r} to {target!r}",
            "not connected",
            f"frames known: {', '.join(self.frames()) or 'none'}",
        )

    def _up(self, frame: str, stamp: float | None, reach: float) -> dict[str, NDArray[np.float64]]:
        """ancestor_from_frame for the frame and all its ancestors."""
        result = {frame: np.eye(4)}
        current = np.eye(4)
        while frame in self._parent:
            current = self._one(frame, stamp, reach) @ current
            frame = self._parent[frame]
            if frame in result:
                raise MagicError(Code.NO_TRANSFORM, "frames", f"a loop at {frame!r}", "a tree")
            result[frame] = current
        return result

    def _one(self, child: str, stamp: float | None, reach: float) -> NDArray[np.float64]:
        if child in self._static:
            return self._static[child]
        track = self._moving[child]
        if stamp is None:
            return track[-1][2]
        if stamp < track[0][0] - reach or stamp > track[-1][0] + reach:
            raise MagicError(
                Code.NO_TRANSFORM,
                f"stamp of the transform of {child!r}",
                round(stamp, 3),
                f"{track[0][0]:.3f} to {track[-1][0]:.3f}, {reach} s more on both sides",
            )
        i = bisect([item[0] for item in track], stamp)
        if i == 0 or i == len(track) or track[i][0] - track[i - 1][0] < 1e-9:
            return track[min(i, len(track) - 1)][2]
        pair = track[i - 1 : i + 1]
        return transforms.interpolate([p[0] for p in pair], np.stack([p[2] for p in pair]), [stamp])[0]
