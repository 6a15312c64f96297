"""The same thing keeps its id from scene to scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.scene import ROBOT, Scene, SceneObject

Array = NDArray[np.float64]

#: Speed of what a robot pushes or carries, m/s: so far a thing may be from where it was last seen, where nothing else can be it.
SPEED = 0.5
#: What may be the same thing from afar: box edges within this, m, and this share, of each other, and mean colours within this (Lab).
EDGE, SHARE, COLOR = 0.010, 0.15, 14.0
#: A thing's speed says where it is for so many seconds.
AHEAD = 2.0
#: What is so near to where it was, m, stands there.
STANDS = 0.02
#: A thing is looked for within this of where it was (m), among those whose box edges are within this factor of its own, for so many scenes.
REACH, GROWTH, MEMORY = 0.10, 0.5, 10


@dataclass(frozen=True)
class _Track:
    """A thing as it was seen last: centre and box edges m, mean colour (Lab), speed m/s; when, s, and how many scenes ago."""

    centre: Array
    extents: Array
    color: Array
    speed: Array
    stamp: float
    age: int = 0

    @classmethod
    def of(cls, item: SceneObject, stamp: float, before: _Track | None) -> _Track:
        """Of an object as it is seen; before: as it was seen before that, if it was."""
        centre = item.world_from_object[:3, 3].copy()
        seconds = stamp - before.stamp if before is not None else 0.0
        speed = (centre - before.centre) / seconds if before is not None and seconds > 1e-3 else np.zeros(3)
        return cls(centre, np.sort(item.box_extents), _color(item), speed, stamp)

    def expected(self, stamp: float) -> Array:
        """Where it is at a stamp if it goes on as it did."""
        return self.centre + self.speed * min(max(stamp - self.stamp, 0.0), AHEAD)


class Tracker:
    """Hands ids on from the last scenes.

    An object takes the id of the one it resembles most in place (within :data:`REACH` metres of where that was, or would be if it went on
    as it did) and in size (box edges within :data:`GROWTH` of each other plus 15 mm).  What is left then takes the id of what is missing
    where both are alike in size and colour, no farther apart than a robot may have moved it, and nothing else could be either of them. A
    thing not seen for :data:`MEMORY` scenes is forgotten, but its number is not given out again.  What is told by other means, as the
    thing in the robot's hand, goes by that.  ``standing``: ids of what is where it was before.
    """

    def __init__(self) -> None:
        self.standing: frozenset[str] = frozenset()
        self._last: dict[str, _Track] = {}
        self._next = 1

    def update(self, scene: Scene, named: Mapping[str, str] | None = None) -> Scene:
        """The scene with stable ids; known objects keep theirs.  named: by their ids in the scene, the ids of things that are told otherwise."""
        seen = [o for o in scene.objects if o.source == "camera"]
        new = [_Track.of(item, scene.stamp, None) for item in seen]
        names = {i: named[item.id] for i, item in enumerate(seen) if named and item.id in named}
        names |= self._near(new, names)
        names |= self._far(new, names)
        taken = {o.id for o in scene.objects if o.source != "camera"}
        renamed: list[SceneObject] = []
        for i, item in enumerate(seen):
            while i not in names:
                candidate = f"object_{self._next}"
                self._next += 1
                if candidate not in taken and candidate not in names.values():
                    names[i] = candidate
            renamed.append(replace(item, id=names[i]))
        ids = {old.id: item.id for old, item in zip(seen, renamed, strict=True)}
        renamed = [replace(item, cut_off=tuple(ids.get(by, by) for by in item.cut_off)) for item in renamed]
        before = self._last
        self._last = {n: replace(track, age=track.age + 1) for n, track in before.items() if track.age + 1 < MEMORY}
        for item in renamed:
            self._last[item.id] = _Track.of(item, scene.stamp, before.get(item.id))
        kept = ((name, before[name], self._last[name]) for name in self._last.keys() & before.keys())
        self.standing = frozenset(name for name, old, now in kept if np.linalg.norm(now.centre - old.centre) < STANDS)
        return replace(scene, objects=(*renamed, *(o for o in scene.objects if o.source != "camera")))

    def carried(self, item: SceneObject) -> bool:
        """Whether an object of the newest scene is where it is by the grace of what holds it: it hangs, or the robot is before it and it
        was not there before."""
        return item.source == "camera" and (item.hanging or (ROBOT in item.cut_off and item.id not in self.standing))

    def _near(self, new: list[_Track], names: dict[int, str]) -> dict[int, str]:
        """The ids of what is about where something was, of those without one, the most alike first."""
        left = [i for i in range(len(new)) if i not in names]
        gone = [name for name in self._last if name not in names.values()]
        costs = []
        for i, item in ((i, new[i]) for i in left):
            for name, old in ((name, self._last[name]) for name in gone):
                distance = min(float(np.linalg.norm(item.centre - place)) for place in (old.centre, old.expected(item.stamp)))
                change = np.abs(item.extents - old.extents)
                if distance < REACH and np.all(change < 0.015 + GROWTH * np.maximum(old.extents, item.extents)):
                    costs.append((distance + 0.5 * float(change.max()), i, name))
        found: dict[int, str] = {}
        for _, i, name in sorted(costs):
            if i not in found and name not in found.values():
                found[i] = name
        return found

    def _far(self, new: list[_Track], names: dict[int, str]) -> dict[int, str]:
        """The ids of what is elsewhere, of those without one, where there is no other choice."""

        def alike(item: _Track, old: _Track) -> bool:
            edges = np.abs(item.extents - old.extents) < EDGE + SHARE * np.maximum(item.extents, old.extents)
            distance = float(np.linalg.norm(item.centre - old.centre))
            near = distance < REACH + SPEED * max(item.stamp - old.stamp, 0.0)
            return bool(near and edges.all() and np.linalg.norm(item.color - old.color) < COLOR)

        left = [i for i in range(len(new)) if i not in names]
        gone = [name for name in self._last if name not in names.values()]
        pairs = [(i, name) for i in left for name in gone if alike(new[i], self._last[name])]
        return {i: name for i, name in pairs if [p[0] for p in pairs].count(i) == 1 and [p[1] for p in pairs].count(name) == 1}


def _color(item: SceneObject) -> Array:
    """(3,) mean colour in Lab; not a number where none was seen."""
    if len(item.colors) == 0:
        return np.full(3, math.nan)
    step = max(1, len(item.colors) // 500)
    colors = np.ascontiguousarray(item.colors[::step][None], dtype=np.uint8)
    return cv2.cvtColor(colors, cv2.COLOR_RGB2LAB)[0].astype(float).mean(axis=0)
