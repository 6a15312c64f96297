"""Motions of the tool and of the arm that holds it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError

#: The variants of the paper: a floating gripper moves the tool, or the arm grasps and moves it.
VARIANTS = ("fg", "arm")
#: Fastest that a tool may go, m/s and rad/s: Franka's limits of the hand (Franka Control Interface documentation), the arm that the
#: floating gripper stands for.
TOOL_SPEED = 1.7
TOOL_TURN = 2.5


@dataclass(frozen=True)
class Phase:
    """A named part of a motion: ``grasp``, ``transfer``, ``approach``, ``contact``, ``goal``,
    ``release``, ``retreat``; start and end in seconds from the motion's start."""

    name: str
    start: float
    end: float


@dataclass(frozen=True)
class ToolMotion:
    """times (T,) seconds from 0, strictly increasing; world_from_tool (T, 4, 4).

    marks: names of the places that the motion passes and when, in seconds, in order of time (for messages and for
    the arm's timing; they are not sent with the motion).
    """

    times: NDArray[np.float64]
    world_from_tool: NDArray[np.float64]
    phases: tuple[Phase, ...] = ()
    marks: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        times = np.asarray(self.times, dtype=float)
        poses = np.asarray(self.world_from_tool, dtype=float)
        if len(times) < 1 or poses.shape != (len(times), 4, 4):
            raise MagicError(Code.BAD_MOTION, "tool motion", f"{len(times)} times, poses {poses.shape}", "T >= 1 times and (T, 4, 4) poses")
        if not (np.all(np.isfinite(times)) and np.all(np.isfinite(poses))):
            raise MagicError(Code.BAD_MOTION, "tool motion", "NaN or infinite values", "finite times and poses")
        if np.any(np.diff(times) <= 0):
            raise MagicError(Code.BAD_MOTION, "times of the tool motion", float(np.diff(times).min()), "strictly increasing")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "world_from_tool", poses)


@dataclass(frozen=True)
class ArmMotion:
    """A joint trajectory with the moments at which the gripper closes and opens.

    Attributes
    ----------
    times : (N,) s from 0.
    positions, velocities, accelerations : (N, J) in rad, rad/s, rad/s^2, of ``joint_names``.
    tool_from_tcp : (4, 4), the grasp.
    grasp_width : m between the fingers when closed on the tool.
    grasp_time, release_time : s from the start; no release time: the tool stays in hand.
    """

    times: NDArray[np.float64]
    joint_names: tuple[str, ...]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    accelerations: NDArray[np.float64]
    tool_from_tcp: NDArray[np.float64]
    grasp_width: float
    grasp_time: float
    release_time: float | None = None
    phases: tuple[Phase, ...] = ()


@dataclass(frozen=True)
class Margin:
    """How much of a limit a motion leaves over where it leaves least: ``left`` 1 nothing is used, 0 all of it, below 0 more than there
    is; ``time`` s of the motion and ``phase`` in which that is; ``what`` completes "70 % ...", the share that is used."""

    name: str
    left: float
    time: float
    phase: str
    what: str

    def __str__(self) -> str:
        return f"{self.name}: {100 * (1 - self.left):.0f} % {self.what} at {self.time:.2f} s ({self.phase})"


@dataclass(frozen=True)
class MotionPlan:
    """What the planner hands to the verifier: where the tool goes, and how the arm takes it there; ``margins``: what analysis says of
    an arm's motion (not sent with it)."""

    variant: str
    tool_motion: ToolMotion
    arm_motion: ArmMotion | None = None
    margins: tuple[Margin, ...] = ()

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise MagicError(Code.UNKNOWN_VARIANT, "variant", self.variant, VARIANTS)
        if (self.variant == "arm") != (self.arm_motion is not None):
            raise MagicError(
                Code.BAD_MOTION,
                "plan",
                f"variant {self.variant} {'with' if self.arm_motion else 'without'} an arm motion",
                "arm with, fg without",
            )
