"""One camera's messages, paired and checked; no rclpy here.

Colour and depth come by themselves, in any order; a pair has stamps within the tolerance.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import Intrinsics
from magic_core.errors import Code


@dataclass
class Problem:
    """What is wrong now: code, message, and when it was last seen (seconds, monotonic)."""

    code: Code
    message: str
    when: float


@dataclass
class Pair:
    """A colour and a depth image that belong together; ``arrived`` is when the first pair of this stamp was complete."""

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    frame_id: str
    depth_frame_id: str
    stamp: float
    arrived: float


#: Pairs that are kept beyond those that are averaged: for as long as their transform may still come, and until they are looked at.
WAITING = 9


@dataclass
class Stream:
    """The state of one camera.

    tolerance: largest difference in seconds of the stamps of a pair.  keep: pairs kept, in the order of their stamps.  unit: of
    the newest depth image's numbers.  unplaced: since when no pair's transform is known (infinite: one is).  few: since when there
    have been frames, but fewer than are averaged (infinite: there are enough, or none has come yet).  repeated: a pair has come whose
    stamp is not later than those before, as of a bag that began again.
    Times called ``now`` are monotonic seconds.
    """

    name: str
    tolerance: float = 0.02
    keep: int = 5
    unit: str = "mm"
    unplaced: float = math.inf
    few: float = math.inf
    repeated: bool = False
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
            # Of a bag that is played again what comes later in it is dropped: it comes again, too.  The frame itself came when it came
            # first: one that is played again and again would be young for ever, and what is waited for with it as well.
            first = next((p.arrived for p in self.pairs if p.stamp == stamp), now)
            self.repeated |= any(p.stamp >= stamp for p in self.pairs)
            self.pairs = [p for p in self.pairs if p.stamp < stamp][-self.keep + 1 :]
            self.pairs.append(Pair(color, depth, frame_id, depth_frame_id, stamp, first))


def next_scene(
    stamps: Mapping[str, Sequence[float]],
    count: int,
    done: float = -math.inf,
    period: float = 0.0,
    skew: float = math.inf,
    limit: float = math.inf,
    settled: bool = False,
) -> float | None:
    """The stamp of the next scene, ``None`` where there is nothing new: it is made of the last ``count`` frames of each camera up to it.

    stamps: of each camera's frames, rising.  A scene has the first stamp at which every camera has ``count`` frames (fewer where no
    more are known), the last of them at most ``skew`` seconds old, that is ``period`` later than the scene before (``done``) and
    before ``limit``.  A camera's next frame is waited for where it may still come before that stamp, unless all is ``settled``:
    nothing is under way.  Where more than a period is waiting, whole periods are passed over.  So which frames are averaged depends on
    their stamps, and not on when each came or when this is asked.  A stamp at which a frame of a camera is missing makes no scene: in the
    one before it what moves is elsewhere.
    """
    if not stamps or not all(stamps.values()):
        return None
    gaps = {camera: float(np.median(np.diff(each))) if len(each) > 1 else math.inf for camera, each in stamps.items()}
    # So often a camera sends a frame, also where many are lost; two that follow each other by a driver's whim say nothing.
    short = {
        camera: min((s for s in np.diff(each).tolist() if s > 0.3 * gaps[camera]), default=math.inf) for camera, each in stamps.items()
    }

    def whole(stamp: float) -> bool:
        for camera, each in stamps.items():
            n = bisect_right(each, stamp)
            if n < min(count, len(each)) or stamp - each[n - 1] > (skew if settled else min(skew, 0.95 * short[camera])):
                return False
            if n == len(each) and not settled and stamp - each[-1] > 0.75 * gaps[camera]:
                return False
        return True

    best, passed = None, -1
    for stamp in sorted({s for each in stamps.values() for s in each if done < s < limit}):
        periods = math.floor((stamp - done) / period + 1e-6) if period > 0 and done > -math.inf else 1
        if periods >= 1 and periods > passed and whole(stamp):
            best, passed = stamp, periods
    return best
