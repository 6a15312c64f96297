"""The scene while nothing changes, which is looked at more closely, and while the arm moves: as long as the pictures differ by the arm
alone, and by what it holds, nothing is perceived anew.  No ROS here."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import RgbdFrame
from magic_core.errors import MagicError
from magic_core.scene import ROBOT, UNSEEN, Scene, SceneObject
from magic_perception.averaging import average, unchanged, unchanged_beside_robot
from magic_perception.robot_in_view import Held, RobotInView

#: A scene in which nothing changes is looked at again after so long by the stamps, s; what noise has made of it is not for ever.
AFRESH = 10.0
#: Of so many looks at a scene in which nothing changes the mean is perceived: with half of the noise handles come out that one look misses.
LOOKS = 4
#: Of a thing of which the robot hides more than this share that was seen before a part is hidden, and of which less than this share is left
#: all of it.
PART, REST = 0.05, 0.1


@dataclass(frozen=True)
class Made:
    """A scene and what it was made of: frames, fixtures, what the robot held; masks (H, W) in each frame by the ids of what was seen;
    carried: ids of what the robot carries; looks: the frames of the last looks at it, the newest last; count: of how many it was made."""

    scene: Scene
    frames: list[RgbdFrame]
    known: tuple[SceneObject, ...]
    held: tuple[Held, ...]
    masks: dict[str, list[NDArray[np.bool_]]]
    carried: frozenset[str]
    looks: tuple[list[RgbdFrame], ...] = ()
    count: int = 1

    def shows(self, frames: list[RgbdFrame], known: tuple[SceneObject, ...]) -> bool:
        """Whether frames may be of this scene."""
        return self._age(frames) >= 0 and list(map(id, known)) == list(map(id, self.known)) and len(frames) == len(self.frames)

    def recent(self, frames: list[RgbdFrame]) -> bool:
        """Whether it need not be looked at again yet."""
        return self._age(frames) < AFRESH

    def earlier(self, frames: list[RgbdFrame]) -> bool:
        """Whether its last look is earlier than frames; those of the same stamp are the same pictures, of a bag that is played again."""
        return _stamp(self.looks[-1]) < _stamp(frames)

    def _age(self, frames: list[RgbdFrame]) -> float:
        return _stamp(frames) - _stamp(self.frames)

    def seen_again(self, frames: list[RgbdFrame]) -> Made:
        """The same with one more look, by frames that show nothing else."""
        return replace(self, looks=(*self.looks, frames)[-LOOKS:])

    @property
    def better(self) -> bool:
        """Whether there are as many looks as are averaged, and it was made of fewer."""
        return len(self.looks) == LOOKS > self.count

    def mean(self) -> list[RgbdFrame]:
        """The mean of the looks, one frame for each camera."""
        return [average(list(each)) for each in zip(*self.looks, strict=True)]

    def same(self, frames: list[RgbdFrame]) -> bool:
        """Whether frames show nothing else than those that the scene was made of."""
        return all(unchanged(f, b) for f, b in zip(frames, self.frames, strict=True))

    def meanwhile(self, frames: list[RgbdFrame], robot: RobotInView, world_from_base: NDArray[np.float64] | None = None) -> Scene | None:
        """The scene while the arm moves, what it carries taken along, and what it hides marked so; ``None``: it stands, or something else
        has changed, or comes in sight that it hid, and all has to be looked at."""
        stamp = _stamp(frames)
        items = [item for item in self.scene.objects if item.source == "camera"]
        standing = [item for item in items if item.id not in self.carried]
        if robot.held != self.held or len(self.held) > 1 or any({ROBOT, UNSEEN} & set(item.cut_off) for item in standing):
            return None
        if (len(items) > len(standing) and not self.held) or not robot.moves(stamp):
            return None
        if not all(unchanged_beside_robot(f, b) for f, b in zip(frames, self.frames, strict=True)):
            return None
        try:
            moved = robot.moved(self.held[0], _stamp(self.frames), stamp, world_from_base) if self.held else np.eye(4)
        except MagicError:
            return None
        objects = [
            item if item.source != "camera" else _carried(item, moved) if item.id in self.carried else self._hidden(item, frames)
            for item in self.scene.objects
        ]
        return replace(self.scene, objects=tuple(objects), stamp=stamp)

    def _hidden(self, item: SceneObject, frames: list[RgbdFrame]) -> SceneObject:
        """A thing that stands, marked by what the robot, and what that holds, hides of it."""
        masks = self.masks.get(item.id, [])
        left = [mask & ~_veil(frame) for mask, frame in zip(masks, frames, strict=False)]
        shares = [np.count_nonzero(rest) / count for mask, rest in zip(masks, left, strict=True) if (count := np.count_nonzero(mask))]
        if not shares or min(shares) > 1 - PART:
            return item
        return replace(item, cut_off=(*item.cut_off, ROBOT, *((UNSEEN,) if max(shares) < REST else ())))


def _veil(frame: RgbdFrame) -> NDArray[np.bool_]:
    """(H, W): where a frame shows the robot, or what it holds."""
    blind = np.zeros(frame.depth.shape, bool) if frame.blind is None else frame.blind
    return blind if frame.held is None else blind | (frame.held > 0)


def _carried(item: SceneObject, moved: NDArray[np.float64]) -> SceneObject:
    """A thing that was carried; without points: nobody has looked where it is in the hand."""
    return replace(
        item,
        world_from_object=moved @ item.world_from_object,
        world_from_box=moved @ item.world_from_box,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
    )


def _stamp(frames: list[RgbdFrame]) -> float:
    return max(frame.stamp for frame in frames)
