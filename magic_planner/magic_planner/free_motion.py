"""Free motion of the arm, empty and with the tool in hand: straight where that is clear, else by RRT-Connect."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_planner import timing
from magic_planner.budget import Budget
from magic_planner.request import STAGES, ArmSettings, Branch, Request, StageError
from magic_planner.robot import Robot
from magic_planner.workspace import Workspace

Array = NDArray[np.float64]
#: Searches for one free path, each with its own random numbers.
SEARCHES = 2
#: The longest that a search may take by the clock, in times of what it may take of the processor.
LONGEST = 8.0
#: Joint step, rad, at which a path is looked at that will be moved along, and one that is only tried.
FINE, COARSE = 0.03, 0.08
#: A path is shortened at random places so many times.
ROUNDS = 15


class FreeMotion:
    """Finds joint paths from one configuration to another."""

    def __init__(self, space: Workspace, settings: ArmSettings) -> None:
        self.space, self.robot, self.settings = space, space.robot, settings

    def come(self, request: Request, goal: Array) -> Array:
        """Joint path (n, J) of the empty hand from where the arm is to ``goal`` (J,) before the tool; raises StageError.

        What was seen may stand some millimetres elsewhere: a finger that just clears a rim in the scene as given pushes the tool off in
        the true one, and no grasp is where it was planned any more.
        """
        try:
            path = self._roomy(request, request.start, goal, "approach", lambda room: self.space.come(request, room), lambda path: True)
        finally:
            self.space.come(request, 0.0)
        return self._free(request, request.start, goal, "approach") if path is None else path

    def carry(self, request: Request, branch: Branch, start: Array, goal: Array) -> Array:
        """Joint path (n, J) with the tool in hand from the lift to the start of the task; raises StageError."""
        robot = self.robot
        self.space.hold(request, branch.grasp)
        for q, what in ((start, "lifted"), (goal, "at the start of the task")):
            pair = robot.collision(q)
            if pair is not None:
                raise StageError(
                    "transfer",
                    MagicError(
                        Code.PATH_IN_COLLISION, f"the tool {what}: {pair}", "in collision", "a tool in the hand clear of everything"
                    ),
                )

        def hold(room: float) -> None:
            self.space.hold_with_room(request, branch.grasp, room, (start, goal))

        def clear(path: Array) -> bool:
            self.space.hold(request, branch.grasp)  # to the table nothing was asked but not to pass through it
            return robot.free(timing.swept(path, FINE), request.budget, "transfer")

        # A tool shifts a little in the hand when it is gripped: it is carried with room about it, where its ends leave that.
        path = self._roomy(request, start, goal, "transfer", hold, clear)
        if path is not None:
            return path
        self.space.hold(request, branch.grasp)
        return self._free(request, start, goal, "transfer")

    def _roomy(
        self, request: Request, start: Array, goal: Array, stage: str, world: Callable[[float], None], clear: Callable[[Array], bool]
    ) -> Array | None:
        """A joint path (n, J) in ``world(room)``, with as much room (m) as its ends leave, that is ``clear``; ``None`` where none is found.

        It has searches of its own, so that those for a way that may be narrow are still there.
        """
        kept, request.searches = request.searches, request.roomy_searches
        try:
            for room in (self.settings.room, self.settings.room / 3):
                world(room)
                if self.robot.collides(start) or self.robot.collides(goal):
                    continue
                try:
                    path = self._free(request, start, goal, stage)
                except StageError:
                    continue
                if clear(path):
                    return path
            return None
        finally:
            request.searches, request.roomy_searches = kept, request.searches

    def _free(self, request: Request, start: Array, goal: Array, stage: str) -> Array:
        """A collision-free joint path (n, J): straight where that is free, else around things and shortened."""
        robot = self.robot
        line = np.stack([start, goal])
        if robot.free(straight(start, goal, FINE), request.budget, stage):
            return line
        pair = robot.collision(start) or robot.collision(goal)
        if pair is not None:
            raise StageError(stage, MagicError(Code.PATH_IN_COLLISION, f"an end of the free motion: {pair}", "in collision", "free ends"))
        rng = np.random.default_rng([request.seed, STAGES.index(stage)])
        for path in self._candidates(request, start, goal, stage):
            # OMPL checks edges coarsely, and a spline swings out at corners; what that meets is found here.
            for shorter in (_shorten(robot, path, rng, request.budget, stage), path):
                if robot.free(timing.swept(shorter, FINE), request.budget, stage):
                    return shorter
        raise StageError(
            stage,
            MagicError(
                Code.NO_PATH,
                f"free motion of stage {stage}",
                f"none found in {SEARCHES} searches of {self.settings.free_time} s",
                "a way around the obstacles",
            ),
        )

    def _candidates(self, request: Request, start: Array, goal: Array, stage: str) -> Iterator[Array]:
        """Paths (n, J) that may be free: by way of home, where the arm is out of the way of most things, then by RRT-Connect."""
        robot = self.robot
        by_home = np.stack([start, robot.home, goal])
        if all(robot.free(straight(a, b, FINE), request.budget, stage) for a, b in itertools.pairwise(by_home)):
            yield by_home
        for n in range(SEARCHES):
            request.budget.check(stage)
            if request.searches < 1:
                return
            status, path = self._search(request, start, goal, int(request.seed) % 100_000 * 10 + n + 1)
            if status.startswith("Exact"):
                yield np.asarray(path, dtype=float)
            else:
                request.searches -= 1

    def _search(self, request: Request, start: Array, goal: Array, seed: int) -> tuple[str, Array]:
        """RRT-Connect's status and path (n, J), after ``free_time`` seconds of the processor at most.

        The library counts seconds of the clock.  A search that other work kept from the processor is done again, for longer, or a busy
        machine would find other paths than an idle one.
        """
        import mplib

        wanted = seconds = self.settings.free_time
        while True:
            mplib.set_global_seed(seed)
            seconds, used = min(seconds, max(0.05, request.budget.left)), time.thread_time()
            status, path = self.robot.planner.planner.plan(start, [goal], time=seconds, range=0.3, simplify=False)
            used = time.thread_time() - used
            if str(status).startswith("Exact") or used > 0.8 * wanted or seconds >= min(LONGEST * wanted, request.budget.left):
                return str(status), path
            seconds = min(LONGEST, 1.5 * wanted / max(used, 0.01)) * wanted


def straight(start: Array, goal: Array, step: float) -> Array:
    """Joint positions (n, J) on the straight line between two, at most ``step`` rad apart."""
    parts = max(1, int(np.ceil(np.abs(goal - start).max() / step)))
    return start + (goal - start) * (np.arange(parts + 1) / parts)[:, None]


def _shorten(robot: Robot, path: Array, rng: np.random.Generator, budget: Budget, stage: str) -> Array:
    """Replace stretches of a path (n, J) by straight lines wherever those are free: from corner to corner, then at random places."""
    path = _pulled(robot, path, budget, stage)
    for _ in range(ROUNDS):
        if len(path) < 3:
            break
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        a, b = np.sort(rng.uniform(0, lengths[-1], 2))
        if np.searchsorted(lengths, a) == np.searchsorted(lengths, b):
            continue  # on one straight piece
        ends = np.stack([np.array([np.interp(s, lengths, path[:, j]) for j in range(path.shape[1])]) for s in (a, b)])
        if robot.free(straight(*ends, COARSE), budget, stage):
            path = np.concatenate([path[lengths < a - 1e-9], ends, path[lengths > b + 1e-9]])
    return path


def _pulled(robot: Robot, path: Array, budget: Budget, stage: str) -> Array:
    """The corners of a path (n, J) that are left when each is joined with one as far on as is found free by halving."""
    kept = [0]
    while kept[-1] < len(path) - 1:
        at = kept[-1]
        ahead = len(path) - 1 - at
        while ahead > 1 and not robot.free(straight(path[at], path[at + ahead], COARSE), budget, stage):
            ahead //= 2
        kept.append(at + ahead)
    return path[kept]
