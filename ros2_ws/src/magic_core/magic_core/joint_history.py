"""Where the joints of an arm were at the moment that a picture was taken.  No ROS here."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, insort
from collections.abc import Iterable, Sequence

from magic_core.errors import Code, MagicError

#: A joint that is where it was up to a second ago, within this (rad, m), has been there meanwhile.
RESTS = 1e-3

#: A state that follows another within so many seconds is not kept.
THINNING = 0.004


class JointHistory:
    """Positions of joints over the last ``memory`` seconds, put together from messages that may each tell of some joints only.

    States that follow within :data:`THINNING` seconds of the one before are not kept: an arm at 1 kHz would fill the memory.
    """

    def __init__(self, memory: float = 10.0) -> None:
        self.memory = memory
        self._tracks: dict[str, list[tuple[float, float]]] = {}
        self._lock = threading.Lock()

    def take(self, names: Sequence[str], positions: Sequence[float], stamp: float) -> None:
        """Take one message in: positions in rad (m where a joint slides), its stamp in seconds.

        Raises ``STALE_DATA`` for a stamp of 0 and ``BAD_REQUEST`` for positions that do not go with the names or are not finite.
        """
        if len(positions) != len(names):
            raise MagicError(Code.BAD_REQUEST, "joint_states", f"{len(positions)} positions", f"{len(names)}, one for each name")
        if not all(map(math.isfinite, positions)):
            wrong = next(n for n, p in zip(names, positions, strict=True) if not math.isfinite(p))
            raise MagicError(Code.BAD_REQUEST, f"position of {wrong} in joint_states", "NaN or infinite", "a finite number")
        if not stamp > 0:
            raise MagicError(Code.STALE_DATA, "stamp of joint_states in s", stamp, "the time at which the joints were there")
        with self._lock:
            for name, position in zip(names, positions, strict=True):
                track = self._tracks.setdefault(name, [])
                if track and stamp < track[-1][0] - self.memory:
                    track.clear()  # time went back: a bag was started again
                if track and 0 <= stamp - track[-1][0] < THINNING:
                    continue
                insort(track, (stamp, float(position)))
                while track[0][0] < track[-1][0] - self.memory:
                    track.pop(0)

    def known(self) -> set[str]:
        """The names of all joints heard of."""
        with self._lock:
            return set(self._tracks)

    def newest(self, names: Iterable[str]) -> float:
        """The stamp up to which all these joints are known, s; -inf where one was never heard of."""
        with self._lock:
            return min((self._tracks[n][-1][0] if n in self._tracks else -math.inf for n in names), default=-math.inf)

    def at(self, names: Iterable[str], stamp: float, reach: float) -> dict[str, float]:
        """Positions by name at a stamp, linear between states; before the first and after the last as these, for at most ``reach``
        seconds, and in a longer gap where the joint is after it where it was before.

        Raises ``NO_FRAMES`` where nothing was received, ``STALE_DATA`` for a joint that no message tells of, or none within reach.
        """
        with self._lock:
            if not self._tracks:
                raise MagicError(Code.NO_FRAMES, "joint_states", "none received", f"states within {reach:g} s of each picture")
            return {name: self._one(name, stamp, reach) for name in names}

    def _one(self, name: str, stamp: float, reach: float) -> float:
        track = self._tracks.get(name)
        if track is None:
            raise MagicError(
                Code.STALE_DATA, f"position of {name} in joint_states", "not told", f"one of {', '.join(sorted(self._tracks))}"
            )
        i = bisect_left(track, (stamp, -math.inf))
        near = track[max(i - 1, 0) : i + 1]
        gaps = [abs(stamp - at) for at, _ in near]
        rests = len(near) == 2 and abs(near[1][1] - near[0][1]) < RESTS and max(gaps) < 1.0
        if min(gaps) > reach and not rests:
            raise MagicError(
                Code.STALE_DATA,
                f"state of {name} nearest to the picture's stamp, s away",
                round(min(gaps), 3),
                f"at most {reach:g} (parameter joint_state_age)",
            )
        if len(near) == 1 or i == len(track):
            return near[-1][1]
        (before, a), (after, b) = near
        if max(gaps) > reach or abs(b - a) > math.pi:  # a gap in the states, or a joint that has passed from pi to -pi
            return near[gaps.index(min(gaps))][1]
        return a + (b - a) * (stamp - before) / (after - before)
