"""What arm and gripper do in turn to carry a verified plan out.  No ROS here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from magic_core.errors import Code, MagicError


@dataclass(frozen=True)
class Move:
    """The arm follows its trajectory from point ``first`` to point ``last``, both included."""

    first: int
    last: int


@dataclass(frozen=True)
class Fingers:
    """The gripper opens (``close`` false) or closes on the tool; ``opening`` between the fingers, m, is where it is to stop."""

    close: bool
    opening: float


@dataclass(frozen=True)
class Look:
    """The arm stands at point ``point`` with the tool in its hand, which can be looked at."""

    point: int


Step = Move | Fingers | Look

#: Fingers whose opening is no larger than this, m, have closed on nothing.
EMPTY = 0.002

#: What the error codes of control_msgs/FollowJointTrajectory say: name, what has happened, what it asks for.
_ENDINGS = {
    0: ("SUCCESSFUL", "it ended as if carried out", "look at the controller's state"),
    -1: ("INVALID_GOAL", "the controller cannot use this trajectory", "see its log"),
    -2: ("INVALID_JOINTS", "the controller moves other joints than the trajectory names", "parameter trajectory_action"),
    -3: ("OLD_HEADER_TIMESTAMP", "the trajectory came too late to be begun", "compare the clocks of both computers"),
    -4: ("PATH_TOLERANCE_VIOLATED", "a joint left the path further than path_tolerance", "what the arm met, or a lower speed"),
    -5: ("GOAL_TOLERANCE_VIOLATED", "a joint did not come within goal_tolerance of the end in goal_time", "what holds the arm up"),
}


def controller_error(error_code: int, status: int, reason: str) -> MagicError:
    """What a trajectory controller that did not carry a trajectory out has said, by its
    FollowJointTrajectory result, as EXECUTION_FAILED."""
    name, what, look = _ENDINGS.get(error_code, ("an error of its own", "no code of FollowJointTrajectory", "see the controller's log"))
    return MagicError(
        Code.EXECUTION_FAILED,
        f"the arm's controller ended the trajectory with error {error_code} ({name}: {what}; {look}), status {status}: "
        f"{reason or 'no reason given'}",
    )


def steps(
    times: Sequence[float],
    velocities: Sequence[Sequence[float]],
    grasp_time: float,
    release_time: float,
    grasp_width: float,
    opening: float,
    standstill: float = 0.01,
    holding: bool = False,
    look: bool = False,
) -> tuple[Step, ...]:
    """What arm and gripper do in turn: open, go to the tool, close, do the task, and where it ends with a release, open and leave.

    times (N,) seconds from 0, rising; velocities (N, J) rad/s; grasp_time and release_time seconds (release_time NaN: never);
    grasp_width and opening (of the open gripper) m.  The arm must stand, within ``standstill`` rad/s, where the fingers move,
    and at the end.  holding: the tool is in the hand already, and the fingers do not open before the release; such a plan closes
    them at its start.  look: the tool is looked at where the arm stands for the first time after it has moved it, at the end of
    the lift.  Raises BAD_MOTION.
    """
    if len(times) < 2 or any(not b > a for a, b in pairwise(times)):
        raise MagicError(Code.BAD_MOTION, "times of the trajectory", f"{len(times)} points", "at least two points, at rising times")
    if not 0.0 <= grasp_width <= opening:
        raise MagicError(Code.BAD_MOTION, "grasp_width in m", grasp_width, f"0 to the gripper's opening of {opening:g}")
    releases = not math.isnan(release_time)
    moments = [("grasp_time", grasp_time), *([("release_time", release_time)] if releases else [])]
    cuts = []
    for name, moment in moments:
        if not times[0] - 1e-6 <= moment <= times[-1] + 1e-6:
            raise MagicError(Code.BAD_MOTION, name, moment, f"{times[0]:g} to {times[-1]:g}, within the trajectory")
        cuts.append(min(range(len(times)), key=lambda i: abs(times[i] - moment)))
    if releases and cuts[1] <= cuts[0]:
        raise MagicError(Code.BAD_MOTION, "release_time", release_time, f"after the grasp at {grasp_time:g}")
    last = len(times) - 1
    for index in (0, *cuts, last):
        speed = max((abs(v) for v in velocities[index]), default=0.0)
        if not speed <= standstill:
            raise MagicError(
                Code.BAD_MOTION, f"speed of the arm in rad/s at {times[index]:.3f} s", round(speed, 4), f"at most {standstill:g} there"
            )
    if holding and cuts[0] != 0:
        raise MagicError(Code.BAD_MOTION, "grasp_time of a tool that is in the hand", grasp_time, f"{times[0]:g}, the start")
    actions: list[Step] = [] if holding else [Fingers(False, opening)]
    begin = 0
    for cut, close in zip(cuts, (True, False)):
        if cut > begin:
            actions += _moves(begin, cut, velocities, standstill, look=look and not close)
        if not (close and holding):
            actions.append(Fingers(close, grasp_width if close else opening))
        begin = cut
    if last > begin:
        actions += _moves(begin, last, velocities, standstill, look=look and not releases)
    return tuple(actions)


def _moves(first: int, last: int, velocities: Sequence[Sequence[float]], standstill: float, look: bool) -> list[Step]:
    """The arm's way from one point to another, with a look where it stands for the first time, if that is wanted."""
    moving = False
    for index in range(first, last) if look else ():
        stands = max((abs(v) for v in velocities[index]), default=0.0) <= standstill
        if moving and stands:
            return [Move(first, index), Look(index), Move(index, last)]
        moving = moving or not stands
    return [Move(first, last)]


def check_grasp(wanted: float, found: float, tolerance: float, looked: bool = False) -> None:
    """Whether fingers that closed have the tool between them: their opening ``found`` is ``wanted`` within ``tolerance``, all m.

    looked: the tool in the hand is looked at before it is used.  Then it is enough that there is something between the fingers: cameras
    that look down tell a lying thing's thickness worst, and where the tool is tells more than how thick it is.  Raises GRASP_FAILED.
    """
    thinner = looked and EMPTY < found < wanted
    if not thinner and not abs(found - wanted) <= tolerance:
        what = "the fingers closed on nothing, or lost the tool" if found < wanted else "the fingers did not close on the tool as planned"
        raise MagicError(
            Code.GRASP_FAILED, f"{what}: opening in mm", round(1000 * found, 1), f"{1000 * wanted:.1f} within {1000 * tolerance:.1f}"
        )
