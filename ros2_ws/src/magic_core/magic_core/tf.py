"""A buffer of transforms: what a node needs of tf2, which has no Python package on PyPI.  No rclpy here.

:mod:`magic_core.tf_listener` fills it from ``/tf`` and ``/tf_static``.
"""

from __future__ import annotations

from bisect import bisect, insort

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError


class NotYetError(MagicError):
    """``NO_TRANSFORM`` of a stamp that lies after the newest transform: it may still come.  ``newest``: its stamp, s."""

    def __init__(self, what: str, stamp: float, newest: float) -> None:
        self.newest = newest
        super().__init__(
            Code.NO_TRANSFORM,
            what,
            f"{stamp:.3f}",
            f"up to {newest:.3f}, that of the newest transform; {stamp - newest:.3f} s are missing, and no later pose is guessed",
        )


class TransformBuffer:
    """Frames and the transforms between them, static or over the last ``memory`` seconds.

    Between two stamps a transform is interpolated, as tf2 does; outside of what came there is none.
    """

    def __init__(self, memory: float = 10.0) -> None:
        self.memory = memory
        self._parent: dict[str, str] = {}
        self._static: dict[str, NDArray[np.float64]] = {}
        self._moving: dict[str, list[tuple[float, int, NDArray[np.float64]]]] = {}
        self._refused: dict[str, str] = {}
        self._count = 0

    def set(self, parent: str, child: str, parent_from_child: NDArray[np.float64], stamp: float = 0.0, static: bool = False) -> None:
        """Take in one transform; a leading slash of a frame's name is dropped, as tf2 does."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not parent or not child or parent == child:
            raise MagicError(Code.NO_TRANSFORM, "frames of a transform", f"{parent!r} and {child!r}", "two different names")
        if not np.all(np.isfinite(parent_from_child)):
            raise MagicError(Code.NO_TRANSFORM, f"transform {parent} from {child}", "NaN or infinite", "finite numbers")
        self._refused.pop(child, None)
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

    def refuse(self, child: str, why: str) -> None:
        """Note that a transform of this frame came which is not one: what is missing because of it will be told with it."""
        self._refused[child.lstrip("/")] = why

    @property
    def refused(self) -> dict[str, str]:
        """Frame -> why its newest transform was left out; a good one ends it."""
        return dict(self._refused)

    def frames(self) -> list[str]:
        """All names that are known."""
        return sorted(set(self._parent) | set(self._parent.values()))

    def lookup(self, target: str, source: str, stamp: float | None = None) -> NDArray[np.float64]:
        """target_from_source (4, 4) at a stamp, interpolated; ``None``: the newest.

        Raises ``NO_TRANSFORM`` that names the frames and which are known; :class:`NotYetError` where the stamp lies after the
        newest transform of a frame on the way, ``NO_TRANSFORM`` where it lies before the oldest.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        up_source, up_target = self._ancestors(source), self._ancestors(target)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            left_out = [f"left out: {why}" for child, why in self._refused.items() if child in (*up_source, *up_target)]
            known = f"frames known: {', '.join(self.frames()) or 'none'}"
            raise MagicError(Code.NO_TRANSFORM, f"transform from {source!r} to {target!r}", "not connected", "; ".join([known, *left_out]))
        return transforms.inverse(self._up(target, up_target, common, stamp)) @ self._up(source, up_source, common, stamp)

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, its parent, and so on up to the root."""
        result = [frame]
        while result[-1] in self._parent:
            parent = self._parent[result[-1]]
            if parent in result:
                raise MagicError(Code.NO_TRANSFORM, "frames", f"a loop at {parent!r}", "a tree")
            result.append(parent)
        return result

    def _up(self, frame: str, ancestors: list[str], ancestor: str, stamp: float | None) -> NDArray[np.float64]:
        """ancestor_from_frame."""
        result = np.eye(4)
        for child in ancestors[: ancestors.index(ancestor)]:
            result = self._one(child, stamp) @ result
        return result

    def _one(self, child: str, stamp: float | None) -> NDArray[np.float64]:
        if child in self._static:
            return self._static[child]
        track = self._moving[child]
        if stamp is None:
            return track[-1][2]
        if stamp > track[-1][0]:
            why = f" (left out since: {self._refused[child]})" if child in self._refused else ""
            raise NotYetError(f"stamp at which {child!r} is looked for{why}", stamp, track[-1][0])
        if stamp < track[0][0]:
            raise MagicError(
                Code.NO_TRANSFORM,
                f"stamp at which {child!r} is looked for",
                f"{stamp:.3f}",
                f"{track[0][0]:.3f} to {track[-1][0]:.3f}, the stamps of its transforms",
            )
        i = bisect([item[0] for item in track], stamp)
        if i == len(track) or track[i][0] - track[i - 1][0] < 1e-9:
            return track[i - 1][2]
        pair = track[i - 1 : i + 1]
        return transforms.interpolate([p[0] for p in pair], np.stack([p[2] for p in pair]), [stamp])[0]
