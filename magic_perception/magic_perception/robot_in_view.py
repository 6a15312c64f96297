"""Cuts the arm out of frames, by where its joints were when each was taken.  No ROS here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.joint_history import JointHistory
from magic_core.robot import Description
from magic_core.self_filter import Margins, SelfFilter

#: Joint states that ended so long before a picture, s, say nothing of it: nobody sends them any more.
SILENT = 2.0


class RobotInView:
    """An arm before cameras.

    age: so many seconds a joint state may be from a picture.  slack: so many seconds the stamps of picture and joints may differ by,
    and so the arm may be off where it moves.
    """

    def __init__(self, robot: Description, margins: Margins | None = None, age: float = 0.2, slack: float = 0.02) -> None:
        self.robot, self.age, self.slack = robot, age, slack
        self.history = JointHistory()
        self.filter = SelfFilter(robot, margins)

    def states(self, stamp: float) -> list[dict[str, float]]:
        """All positions (rad, m, by name) that the joints may have had at a stamp.

        Fingers that nothing is told of may be anywhere on their way; one that nothing is told of goes with the other.  Raises what
        :meth:`magic_core.joint_history.JointHistory.at` raises.
        """
        known = self.history.known()
        fingers = [joint.name for joint in self.robot.fingers]
        names = [*self.robot.names, *(name for name, joint in self.robot.joints.items() if joint.moves and name in known)]
        states = [self.history.at(names, stamp, self.age)]
        states += [self.history.at(names, at, self.age + self.slack) for at in (stamp - self.slack, stamp + self.slack)]
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
        """The frame, blind where it shows the robot, or may.

        Raises ``STALE_DATA`` or ``NO_FRAMES`` where the joints' positions are not known, and ``ROBOT_NOT_THERE`` where the camera
        looks through the place at which they put the robot.
        """
        cut = self.filter.cut(frame, self.states(frame.stamp), world_from_base)
        if cut.contradicted:
            raise MagicError(
                Code.ROBOT_NOT_THERE,
                f"the place in {frame.camera}'s picture where joint_states and TF put the robot, share that is seen through",
                round(cut.through, 2),
                "less than a half: joint states, TF, calibration and description of the robot that is there; or self_filter: false where there is none",
            )
        return frame.blinded(cut.robot) if cut.robot.any() else frame
