"""Cuts the arm out of frames, by where its joints were when each was taken, and tells what shows the thing in its hand.  No ROS here."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import NEARLY, SURELY, ArmSeen, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.joint_history import JointHistory
from magic_core.robot import Description
from magic_core.scene import SceneObject
from magic_core.self_filter import Body, Margins, SelfFilter, shown
from magic_perception.arm_seen import FLOOR, ArmInPicture

#: Joint states that ended so long before a picture, s, say nothing of it: nobody sends them any more.
SILENT = 2.0
#: No part of an arm is farther than this from any of its axes, m.
REACH = 1.5
#: An arm moves where a joint has moved by more than this, rad (m), in the last so many seconds: a picture taken 0.2 s after it stopped is
#: one of an arm that stands, and the tool in its hand is looked at in it.
MOVES, MOMENT = 0.002, 0.15
#: How an arm at rest is seen is measured again after so long, s; so many times are remembered.
AGAIN, SIGHTINGS = 5.0, 8
#: What a thing in the hand may be off where it is said to be, m: the closing fingers turn it.
IN_HAND = 0.01
#: What is drawn of it is it, but for the pixels at its edge, and noise.
DRAWN = Margins(edge=1, space=0.004)


@dataclass(frozen=True)
class Held:
    """A thing in the hand: its shape, the link that it is fixed to, link_from_object (4, 4), and its id."""

    body: Body
    link: str
    link_from_object: NDArray[np.float64]
    id: str

    @classmethod
    def of(cls, item: SceneObject, link: str) -> Held:
        """An object whose pose is given in the frame of a link."""
        return cls(Body(item.mesh), link, item.world_from_object, item.id)


@dataclass
class _Sightings:
    """How one camera saw the arm from one place: the last times, when and at which joint positions it was looked at last."""

    place: bytes
    stamp: float = -np.inf
    joints: bytes = b""
    arms: deque[ArmSeen] = field(default_factory=lambda: deque(maxlen=SIGHTINGS))

    @property
    def mean(self) -> ArmSeen | None:
        """All of them together; ``None`` where there are none."""
        arms = list(self.arms)
        if not arms:
            return None
        weights = np.array([arm.error**-2 for arm in arms])
        centre, offset = (np.average([getattr(arm, name) for arm in arms], axis=0, weights=weights) for name in ("centre", "offset"))
        return ArmSeen(centre, offset, max(float(weights.sum() ** -0.5), FLOOR))


class RobotInView:
    """An arm before cameras.

    age: so many seconds a joint state may be from a picture.  slack: so many seconds the stamps of picture and joints may differ by,
    and so the arm may be off where it moves.
    """

    def __init__(self, robot: Description, margins: Margins | None = None, age: float = 0.2, slack: float = 0.02) -> None:
        self.robot, self.age, self.slack = robot, age, slack
        self._picture = ArmInPicture(robot)
        self._seen: dict[str, _Sightings] = {}
        self.history = JointHistory()
        self.filter = SelfFilter(robot, margins)
        self.held: tuple[Held, ...] = ()

    def states(self, stamp: float) -> list[dict[str, float]]:
        """All positions (rad, m, by name) that the joints may have had at a stamp.

        Fingers that nothing is told of may be anywhere on their way; one that nothing is told of goes with the other.  Raises what
        :meth:`magic_core.joint_history.JointHistory.at` raises.
        """
        known = self.history.known()
        fingers = [joint.name for joint in self.robot.fingers]
        names = [*self.robot.names, *(name for name, joint in self.robot.joints.items() if joint.moves and name in known)]
        here = self.history.at(names, stamp, self.age)
        states = [self.history.at(names, at, self.age + self.slack) for at in (stamp - self.slack, stamp + self.slack)]
        # What is between two places is within the margin of them where they are near each other.
        if sum(abs(states[0][name] - states[1][name]) for name in names) * REACH > 2 * self.filter.margins.space:
            states.append(here)
        told = [i for i, name in enumerate(fingers) if name in known]
        shares = [0.0, 0.5, 1.0] if not told else [None]
        return [self._with_fingers(state, share, told) for state in states for share in shares]

    def _with_fingers(self, state: dict[str, float], share: float | None, told: list[int]) -> dict[str, float]:
        closed, way = self.robot.closed, self.robot.opened - self.robot.closed
        if share is None:
            share = float((state[self.robot.fingers[told[0]].name] - closed[told[0]]) / way[told[0]])
        missing = {joint.name: float(closed[i] + share * way[i]) for i, joint in enumerate(self.robot.fingers) if i not in told}
        return {**state, **missing}

    def waits(self, stamp: float) -> bool:
        """Whether joint states come that have not reached a stamp yet."""
        return self.told(stamp) and self.history.newest(self.robot.names) < stamp

    def told(self, stamp: float) -> bool:
        """Whether joint states come, or came until a moment before a stamp: where one is missing the arm is somewhere nonetheless."""
        return self.history.newest(self.robot.names) > stamp - SILENT

    def cut(self, frame: RgbdFrame, world_from_base: NDArray[np.float64] | None = None) -> RgbdFrame:
        """The frame, blind where it shows the robot, or may, and told where it shows what the robot holds.

        Raises ``STALE_DATA`` or ``NO_FRAMES`` where the joints' positions are not known, and ``ROBOT_NOT_THERE`` where the camera
        looks through the place at which they put the robot.
        """
        states = self.states(frame.stamp)
        cut = self.filter.cut(frame, states, world_from_base)
        if cut.contradicted:
            raise MagicError(
                Code.ROBOT_NOT_THERE,
                f"the place in {frame.camera}'s picture where joint_states and TF put the robot, share that is seen through",
                round(cut.through, 2),
                "less than a half: joint states, TF, calibration and description of the robot that is there; or self_filter: false where there is none",
            )
        frame = replace(frame.blinded(cut.robot) if cut.robot.any() else frame, arm=self._arm(frame, states[0], world_from_base))
        wide = replace(self.filter.margins, space=max(self.filter.margins.space, IN_HAND))
        base = np.eye(4) if world_from_base is None else np.asarray(world_from_base, dtype=float)
        poses = [self.robot.poses(dict(state)) for state in states] if self.held else []
        for held in self.held:
            places = [base @ pose[held.link] @ held.link_from_object for pose in poses if held.link in pose]
            near, sure = (shown(frame, held.body, places, margins) for margins in (wide, DRAWN))
            pixels = np.where(sure, SURELY, np.where(near, NEARLY, 0)).astype(np.uint8)
            if frame.blind is not None:
                pixels[frame.blind] = 0
            frame = replace(frame, held=pixels if frame.held is None else np.maximum(frame.held, pixels))
        return frame

    def _arm(self, frame: RgbdFrame, state: dict[str, float], world_from_base: NDArray[np.float64] | None) -> ArmSeen | None:
        """How a frame's camera sees the arm from where it stands: measured once in a while where the arm rests with an empty hand, and kept
        else, so that a scene stays where it is when the arm begins to move."""
        base = np.eye(4) if world_from_base is None else world_from_base
        place = np.concatenate([frame.world_from_camera.round(4).ravel(), base.round(4).ravel()]).tobytes()
        seen = self._seen.get(frame.camera)
        if seen is None or seen.place != place:
            seen = self._seen[frame.camera] = _Sightings(place)
        joints = np.round([state[name] for name in sorted(state)], 3).tobytes()
        due = joints != seen.joints or not 0 <= frame.stamp - seen.stamp < AGAIN
        if due and not self.held and not self.moves(frame.stamp):
            seen.stamp, seen.joints = frame.stamp, joints
            arm = self._picture.measure(frame, state, world_from_base)
            seen.arms += [] if arm is None else [arm]
        return seen.mean

    def offsets(self) -> dict[str, float]:
        """How far, m, each camera saw the arm from where its joints put it, by the pose that it came with, where that was measured last."""
        return {camera: float(np.linalg.norm(arm.offset)) for camera, seen in dict(self._seen).items() if (arm := seen.mean) is not None}

    def moves(self, stamp: float) -> bool:
        """Whether a joint of the arm has moved in the last moment before a stamp; false where that is not known."""
        try:
            now, then = (self.history.at(self.robot.names, at, self.age) for at in (stamp, stamp - MOMENT))
        except MagicError:
            return False
        return any(abs(now[name] - then[name]) > MOVES for name in self.robot.names)

    def moved(self, held: Held, then: float, now: float, world_from_base: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """What has carried (4, 4), in the world, a thing in the hand from where it was at one stamp to where it is at another; raises as
        :meth:`cut`."""
        base = np.eye(4) if world_from_base is None else np.asarray(world_from_base, dtype=float)
        was, here = (base @ self.robot.poses(self.history.at(self.robot.names, at, self.age))[held.link] for at in (then, now))
        return here @ transforms.inverse(was)
