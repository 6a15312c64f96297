"""What a request for an arm motion consists of, the ways found to serve it, and how their failures are kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.contact import ContactCandidate
from magic_core.errors import MagicError
from magic_core.motion import ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_planner.budget import Budget
from magic_planner.cloud import cloud_name
from magic_planner.collision import roomy_shell, shell, solid_pieces
from magic_planner.grasps import Grasp

Array = NDArray[np.float64]
#: The stages of a plan in the order in which they are decided: a later one is a better failure.
STAGES = ("motion", "grasp", "task", "approach", "lift", "transfer", "retreat", "timing")


@dataclass(frozen=True)
class ArmSettings:
    """How an arm's motion is searched for.

    Attributes
    ----------
    key_length, key_angle : m and rad, spacing of the poses at which grasps are compared.
    lots : how many grasps are compared at once, the best ones first.
    closer : the same where none of these serves and more are looked for.
    tries : plans that may fail after the hand has come to its grasp.
    quick_tries : those of each lot that may fail before, by arm and tool along the task or on the way to the grasp.
    standoff : m before the grasp from which the hand comes straight.
    lift, retreat : m up with the tool, and back from it after a release.
    room : m about a tool that is carried, and about all that the empty hand passes.
    dwell : s for the fingers to close or open.
    jump : rad, the largest joint step between neighbouring key poses.
    time_step : s, of the result.
    free_time : s for one search of a free path.  It takes some 0.03 s; the limit is wide so that a loaded machine finds the same path.
    searches : how many of a request may fail, of those that keep room about things and of the others.
    """

    key_length: float = 0.02
    key_angle: float = np.deg2rad(8.0)
    lots: tuple[int, ...] = (12, 28, 40, 40)
    closer: tuple[int, ...] = (40, 120, 320)
    tries: int = 10
    quick_tries: int = 40
    standoff: float = 0.08
    lift: float = 0.06
    retreat: float = 0.16
    room: float = 0.015
    dwell: float = 0.5
    jump: float = 0.5
    time_step: float = 0.02
    free_time: float = 0.5
    searches: int = 2


@dataclass(frozen=True)
class Branch:
    """One way to take the tool along the key poses: which grasp, and the joint positions (K, J)."""

    grasp: Grasp
    path: Array
    cost: float


@dataclass(frozen=True)
class Problem:
    """What the arm is asked for, and all that its plan is a function of: to take a tool that lies in the world along ``motion``.

    Attributes
    ----------
    candidate, reflection : the contacts for which the motion was made, as :func:`magic_planner.object_motion.plan_tool_motion` had them.
    table : (4,), plane with its unit normal up.
    start : (J,), where the arm is; ``None``: home.
    attempt : 0 for the best grasp, n for the n-th next that differs from those before.
    """

    strategy: Strategy
    tool: SceneObject
    target: SceneObject
    candidate: ContactCandidate
    reflection: str
    motion: ToolMotion
    table: Array | Sequence[float] = (0.0, 0.0, 1.0, 0.0)
    obstacles: Sequence[SceneObject] = ()
    start: Array | None = None
    attempt: int = 0
    seed: int = 0


@dataclass
class Request:
    """A problem as one call of :meth:`ArmPlanner.solve` works on it: checked, with what follows from it."""

    strategy: Strategy
    tool: SceneObject
    target: SceneObject
    obstacles: tuple[SceneObject, ...]
    motion: ToolMotion
    plane: Array
    start: Array
    seed: int
    budget: Budget
    feedback: Callable[[str, str], None]
    times: Array  # (T,) of the task: the tool's motion up to the release
    poses: Array  # (T, 4, 4)
    keys: NDArray[np.int64]  # (K,) indices into times
    met: float  # seconds at which the tool meets the target
    shapes: list[Any]  # the tool's surface
    marks: tuple[tuple[str, float], ...]  # names of the places the tool's motion passes, and when
    cloud: dict[str, Array]  # by object: measured points (N, 3) that no shape accounts for
    searches: int  # that may still fail
    roomy_searches: int  # the same, of those that keep room about things

    @staticmethod
    def roomy(item: SceneObject, margin: float) -> list[Any]:
        """The surface of tool, target or an obstacle, grown by ``margin`` metres."""
        return roomy_shell(solid_pieces(item), margin) if margin > 0 else shell(solid_pieces(item))

    def surroundings(self, target: bool = True) -> list[str]:
        """Names of all that is in the collision world besides table and tool; without the target on request."""
        items = (self.target, *self.obstacles) if target else self.obstacles
        return [item.id for item in items] + [cloud_name(item) for item in items if item.id in self.cloud]

    def place(self, index: int) -> str:
        """A sentence's name for a sample of the task: the waypoint it leads to."""
        now = float(self.times[index])
        marks = self.marks
        name = next((n for n, t in marks if t >= now - 1e-6), marks[-1][0])
        return f"waypoint {name!r} (at {now:.2f} s of the tool's motion)"


class StageError(Exception):
    """A try that ended at a stage of :data:`STAGES`."""

    def __init__(self, stage: str, error: MagicError) -> None:
        super().__init__(str(error))
        self.stage = stage
        self.error = error


class Failures:
    """The failures of the tries, of which the one that came furthest counts."""

    def __init__(self) -> None:
        self._best: tuple[int, MagicError] | None = None
        self.count = 0

    def add(self, stage: str, error: MagicError | Callable[[], MagicError]) -> None:
        """Note that a try ended at a stage; what is to be said about it may be found out only if it is the one that counts."""
        self.count += 1
        rank = STAGES.index(stage)
        if self._best is None or rank > self._best[0]:
            self._best = (rank, error() if callable(error) else error)

    def error(self) -> MagicError:
        """The failure to report."""
        assert self._best is not None
        rank, error = self._best
        tail = f"; {self.count} tries failed, this one came furthest" if self.count > 1 else ""
        return MagicError(error.code, f"stage {STAGES[rank]}: {error.message}{tail}")
