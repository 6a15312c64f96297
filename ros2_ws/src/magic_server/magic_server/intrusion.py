"""What comes in while the arm moves, and is near where it is still to go.  No ROS here.

Arm and tool in the hand are cut out of the pictures, and what stood there when the motion was planned is known: what else perception tells
has come in, or is a part of one of those by another name.  A single picture may be wrong about that: it takes two that follow each other.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description
from magic_server import scene_change

Array = NDArray[np.float64]

#: In so many pictures that follow each other something has to be seen.
LOOKS = 2
#: The rest of a motion is looked at in so many places at most.
PLACES = 40
#: What is seen within so much, m, of where a known thing stood is a part of it, by whatever name.
PART = 0.02


class Intruded(MagicError):
    """Something has come in where the arm is still to go: a person is to look before anything moves again."""


@dataclass(frozen=True)
class Way:
    """Where arm and tool are still to go: at ``times`` (T,), s from the beginning of the move, the joints ``positions`` (T, J) of ``robot``.

    surfaces: points (N, 3) on each link that moves, in its frame.  tool: points (M, 3) on the tool in the frame of the tip, once it is in
    the hand.  fingers: positions of the other joints, by name.
    """

    robot: Description
    times: Array
    positions: Array
    surfaces: Mapping[str, Array]
    tool: Array
    fingers: Mapping[str, float]

    def after(self, time: float) -> Array:
        """(N, 3): points of all that is passed from a time on, m."""
        rest = np.flatnonzero(self.times >= time)
        if not len(rest):
            rest = np.array([len(self.times) - 1])
        rest = rest[::-1][:: math.ceil(len(rest) / PLACES)]  # its end is among them
        passed = []
        for positions in self.positions[rest]:
            poses = self.robot.poses({**self.fingers, **dict(zip(self.robot.names, map(float, positions), strict=True))})
            passed += [transforms.apply(poses[link], points) for link, points in self.surfaces.items()]
        tips = self.robot.forward(self.positions[rest])
        return np.concatenate([*passed, *(transforms.apply(tip, self.tool) for tip in tips)])


def away(hull: Array, points: Array) -> float:
    """How far the nearest of points (N, 3) is from a thing with a :func:`magic_server.scene_change.hull`, m, at least; 0: inside."""
    return float(max(0.0, (points @ scene_change.DIRECTIONS.T - hull).max(axis=1).min()))


def strangers(before: Mapping[str, Array], after: Mapping[str, Array], known: Collection[str], carried: Array | None) -> dict[str, Array]:
    """The hulls of what has come, by id.

    before, after: hulls by id, as the motion was planned among them and now; known: ids of what may be anywhere; carried: hull of the tool
    where the hand has it.  What lies within :data:`PART` of one that was there is a part of it; what lies within
    :data:`magic_server.scene_change.ABOUT` of the tool is the tool, the hand, or what these take along.
    """
    outer = [(hull, PART) for hull in before.values()]
    if carried is not None:
        outer.append((carried, scene_change.ABOUT))
    return {
        name: hull
        for name, hull in after.items()
        if name not in before and name not in known and not any(scene_change.contained(hull, there, margin) for there, margin in outer)
    }


class Intrusion:
    """Looks for what has come in during one move; ``clearance``: m that it has to be away from where the arm is still to go."""

    def __init__(self, way: Way, clearance: float) -> None:
        self._way, self._clearance = way, clearance
        self._seen, self._last = 0, -math.inf

    def take(self, come: Mapping[str, Array], stamp: float, time: float) -> None:
        """Take in what has come by the newest picture, hulls by id, of that stamp, ``time`` s after the move began; raises :class:`Intruded`
        where something is in the way in :data:`LOOKS` pictures that follow each other."""
        if stamp == self._last:
            return
        self._last = stamp
        passed = self._way.after(time) if come else np.zeros((0, 3))
        near = {name: found for name, hull in come.items() if (found := away(hull, passed)) < self._clearance}
        self._seen = self._seen + 1 if near else 0
        if self._seen < LOOKS:
            return
        name = min(near, key=near.__getitem__)
        place = ", ".join(f"{x:.2f}" for x in middle(come[name]))
        raise Intruded(
            Code.SCENE_CHANGED,
            f"{name} has come in while the arm moved, at ({place}) m, in mm from where the arm was to go",
            round(1000 * near[name]),
            f"at least {1000 * self._clearance:g}; the arm was stopped",
        )


def middle(hull: Array) -> Array:
    """(3,): about the middle of a thing by its hull, m."""
    return np.asarray(scene_change.EXPLAINS @ hull)
