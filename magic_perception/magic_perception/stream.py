"""One camera's messages, paired and checked; no rclpy here.

Colour and depth come by themselves, in any order; a pair has stamps within the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError


@dataclass
class Problem:
    """What is wrong now: code, message, and when it was last seen (seconds, monotonic)."""

    code: Code
    message: str
    when: float


@dataclass
class Pair:
    """A colour and a depth image that belong together."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    frame_id: str
    depth_frame_id: str
    stamp: float
    arrived: float


@dataclass
class Stream:
    """The state of one camera.

    tolerance: largest difference in seconds of the stamps of a pair.  keep: pairs kept for averaging.
    Times called ``now`` are monotonic seconds.
    """

    name: str
    tolerance: float = 0.02
    keep: int = 5
    intrinsics: Intrinsics | None = None
    depth_intrinsics: Intrinsics | None = None
    pairs: list[Pair] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=lambda: {"color": 0, "depth": 0, "camera_info": 0})
    last: dict[str, float] = field(default_factory=dict)
    problems: dict[str, Problem] = field(default_factory=dict)
    _colors: list[tuple[float, NDArray[np.uint8], str]] = field(default_factory=list)
    _depths: list[tuple[float, NDArray[np.float32], str]] = field(default_factory=list)
    _newest: dict[str, float] = field(default_factory=dict)

    def wrong(self, what: str, code: Code, message: str, now: float) -> None:
        """Note a problem of one input (``color``, ``depth``, ...); a good input of the same kind clears it."""
        self.problems[what] = Problem(code, message, now)

    def clear(self, what: str) -> None:
        """That input is good again."""
        self.problems.pop(what, None)

    def info(self, intrinsics: Intrinsics, now: float) -> None:
        """Take in the colour camera's intrinsics; a change of size drops what was collected."""
        if self.intrinsics is not None and (intrinsics.width, intrinsics.height) != (self.intrinsics.width, self.intrinsics.height):
            self.reset()
        self.intrinsics = intrinsics
        self.counts["camera_info"] += 1
        self.last["camera_info"] = now
        self.clear("camera_info")

    def reset(self) -> None:
        """Forget all images."""
        self.pairs.clear()
        self._colors.clear()
        self._depths.clear()
        self._newest.clear()

    def color(self, stamp: float, image: NDArray[np.uint8], frame_id: str, now: float) -> None:
        """Take in a colour image."""
        self._take("color", self._colors, stamp, image, frame_id, now)

    def depth(self, stamp: float, image: NDArray[np.float32], frame_id: str, now: float) -> None:
        """Take in a depth image in metres."""
        self._take("depth", self._depths, stamp, image, frame_id, now)

    def _take(self, what: str, queue: list, stamp: float, image: NDArray, frame_id: str, now: float) -> None:
        self.counts[what] += 1
        self.last[what] = now
        newest = self._newest.get(what)
        if newest is not None and stamp < newest - 1.0:
            # Time went back (a bag began again): what was collected is of another time.
            self.reset()
            self.wrong(
                "stamps", Code.STALE_DATA, f"stamps of {what} went back from {newest:.3f} to {stamp:.3f}; collected images dropped", now
            )
        self._newest[what] = stamp
        self.clear(what)
        queue.append((stamp, image, frame_id))
        del queue[: -max(4, self.keep)]
        self._pair(now)

    def _pair(self, now: float) -> None:
        while self._colors and self._depths:
            best = min(
                ((abs(c[0] - d[0]), i, j) for i, c in enumerate(self._colors) for j, d in enumerate(self._depths)), key=lambda item: item[0]
            )
            gap, i, j = best
            if gap > self.tolerance:
                if min(self.counts["color"], self.counts["depth"]) > 3 and now - self.last.get("pair", -1e9) > 1.0:
                    self.wrong(
                        "pairing",
                        Code.STALE_DATA,
                        f"stamps of colour and depth differ by at least {gap:.3f} s (allowed: {self.tolerance} s)",
                        now,
                    )
                return
            stamp, color, frame_id = self._colors[i]
            _, depth, depth_frame_id = self._depths[j]
            del self._colors[: i + 1]
            del self._depths[: j + 1]
            self.clear("pairing")
            self.last["pair"] = now
            self.pairs.append(Pair(color, depth, frame_id, depth_frame_id, stamp, now))
            del self.pairs[: -self.keep]

    def frames(self, world_from_camera: NDArray[np.float64]) -> list[RgbdFrame]:
        """The collected pairs as frames; raises ``NO_CAMERA_INFO``, or ``BAD_IMAGE`` where sizes disagree."""
        if self.intrinsics is None:
            raise MagicError(
                Code.NO_CAMERA_INFO, f"camera_info of {self.name}", "none received", "one message before the first image is used"
            )
        return [RgbdFrame(p.color, p.depth, self.intrinsics, world_from_camera, self.name, p.stamp) for p in self.pairs]
