"""How the arm takes the tool along: grasp, lift, transfer, the task itself, retreat.

The tool's motion is given (:mod:`magic_planner.object_motion`) and a grasp is rigid,
so the hand's path is known for each grasp before anything is planned.  The search
therefore starts at the far end: grasps whose hand can follow the whole task come
first, and only for those are the pick-up and the free motion planned.  What fails
is kept with its stage, and the failure that came furthest is the one reported.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import OPPOSED, ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_planner import timing
from magic_planner.budget import Budget
from magic_planner.choice import GraspChoice
from magic_planner.cloud import CloudSettings, unexplained
from magic_planner.collision import shell, solid_pieces
from magic_planner.free_motion import FreeMotion
from magic_planner.grasps import Grasp, GraspSettings
from magic_planner.hand_moves import HandMoves
from magic_planner.held import grasp_in_hand
from magic_planner.object_motion import placed_contact_frame, table_plane, waypoint_times
from magic_planner.pace import Pace
from magic_planner.request import ArmSettings, Branch, Failures, Problem, Request, StageError
from magic_planner.robot import Robot
from magic_planner.schedule import Schedule
from magic_planner.task_path import TaskPath, key_poses
from magic_planner.workspace import Workspace

Array = NDArray[np.float64]
#: Ways to follow the task with one grasp that are tried.
WAYS = 3
#: A tool that is tipped by more (rad) from how it lies to how it is used asks for a grasp that serves both attitudes.
TIPPED = np.deg2rad(20.0)
#: What becomes of a request for which there is no such grasp.
_REACHES = (Code.NO_GRASP, Code.NO_IK, Code.JOINT_LIMIT, Code.PATH_IN_COLLISION)


class ArmPlanner:
    """Plans arm motions for one robot.  One request at a time; the same request and seed give the same plan."""

    def __init__(
        self,
        robot: Robot,
        settings: ArmSettings | None = None,
        grasping: GraspSettings | None = None,
        cloud: CloudSettings | None = None,
    ) -> None:
        self.robot = robot
        self.cloud = cloud or CloudSettings()
        self.settings = settings or ArmSettings()
        self.grasping = grasping or GraspSettings()
        self.space = Workspace(robot, self.cloud)
        self.task = TaskPath(self.space, self.settings)
        self.hand = HandMoves(self.space, self.settings)
        self.free = FreeMotion(self.space, self.settings)
        self.schedule = Schedule(robot, self.settings)

    def warm_up(self) -> None:
        """Load and build what the first request would otherwise wait for."""
        self.robot.warm_up()
        timing.parameterise(np.stack([self.robot.home, self.robot.home + 0.05]), self.robot.limits, 0.02)

    def plan(
        self,
        strategy: Strategy,
        tool: SceneObject,
        target: SceneObject,
        candidate: ContactCandidate,
        reflection: str,
        motion: ToolMotion,
        table: Array | Sequence[float] = (0.0, 0.0, 1.0, 0.0),
        obstacles: Sequence[SceneObject] = (),
        start: Array | None = None,
        attempt: int = 0,
        seed: int = 0,
        budget: Budget | None = None,
        feedback: Callable[[str, str], None] = lambda stage, message: None,
    ) -> MotionPlan:
        """:meth:`solve` for a caller that has the parts of a :class:`Problem`, as a script has them."""
        problem = Problem(strategy, tool, target, candidate, reflection, motion, table, obstacles, start, attempt, seed)
        return self.solve(problem, budget, feedback)

    def solve(
        self,
        problem: Problem,
        budget: Budget | None = None,
        feedback: Callable[[str, str], None] = lambda stage, message: None,
    ) -> MotionPlan:
        """The arm's motion that solves a problem; ``feedback`` hears each stage and what is done in it.

        A tool's retreat that the arm cannot follow is left out.

        A tool that hangs (``tool.hanging``) is in the hand, where its pose and ``start`` put it: it is not grasped anew but raised
        where something is beneath it, and carried on; the gripper of such a plan closes at 0 s.

        Raises NO_GRASP, NO_IK, JOINT_LIMIT, START_IN_COLLISION, PATH_IN_COLLISION, NO_PATH, DYNAMIC_LIMIT,
        TIME_PARAMETERISATION, PLANNING_TIMEOUT, CANCELED, each naming the stage and the waypoint, pair or limit, and by how much a tool
        has to be tipped that lies otherwise than it is used.
        """
        tool = problem.tool
        if tool.hanging and problem.start is None:
            raise MagicError(Code.BAD_REQUEST, f"start, with {tool.id} in the hand", "none", "where the arm is")
        try:
            return self._with_ending(problem, budget or Budget(), feedback)
        except MagicError as error:
            angle = tipping(tool.world_from_object, problem.motion.world_from_tool[0])
            if error.code not in _REACHES or angle < TIPPED:
                raise
            raise MagicError(
                error.code,
                f"{error.message}; {tool.id} has to be tipped by {np.degrees(angle):.0f} degrees from how it lies to how it is used, "
                "and is not set down on the way to be grasped anew: one grasp has to serve both",
            ) from error

    def _with_ending(self, problem: Problem, budget: Budget, feedback: Callable[[str, str], None]) -> MotionPlan:
        """The plan of the whole motion, or without the tool's retreat where that is what fails."""
        try:
            return self._solved(problem, budget, feedback)
        except MagicError as error:
            motion = problem.motion
            ending = next((p for p in motion.phases if p.name == "retreat"), None)
            if ending is None or problem.strategy.releases or error.code not in (Code.NO_IK, Code.JOINT_LIMIT, Code.PATH_IN_COLLISION):
                raise
            # What the tool is for is done by then: better to stop there than not to act.
            feedback("task", f"without the tool's retreat, as {error.message}")
            until = motion.times <= ending.start + 1e-9
            shorter = ToolMotion(
                motion.times[until],
                motion.world_from_tool[until],
                tuple(p for p in motion.phases if p.end <= ending.start + 1e-9),
                tuple(m for m in motion.marks if m[1] <= ending.start + 1e-9),
            )
            return self._solved(replace(problem, motion=shorter), budget, feedback)

    def _solved(self, problem: Problem, budget: Budget, feedback: Callable[[str, str], None]) -> MotionPlan:
        robot = self.robot
        request = self._request(problem, budget, feedback)
        self.space.build(request)
        held = grasp_in_hand(robot, request.tool, request.start) if request.tool.hanging else None
        if held is None:
            robot.open_to(robot.config.opening)
        else:
            self.space.carry_off(request, held)
        pair = robot.collision(request.start)
        if pair is not None:
            raise MagicError(Code.START_IN_COLLISION, "stage approach: the arm at its start", str(pair), "a start clear of everything")
        feedback("grasp", "looking for grasps that serve the whole motion" if held is None else "the tool is in the hand")
        tool_from_contact = placed_contact_frame(problem.strategy, problem.candidate, problem.reflection)
        met = problem.candidate.target
        tool_from_target = None if met is None else tool_from_contact @ OPPOSED @ transforms.inverse(met.object_from_contact)
        choice = GraspChoice(robot, self.grasping, self.settings, request, tool_from_contact, tool_from_target)
        pace = Pace(robot, choice.grasping, request.tool, tool_from_contact)
        return _Search(self, request, held, pace, problem.attempt).plan(choice.lots() if held is None else iter([[held]]))

    def _request(self, problem: Problem, budget: Budget, feedback: Callable[[str, str], None]) -> Request:
        """What all parts of the planner work on.  Raises BAD_REQUEST and JOINT_LIMIT for a start at which the arm cannot be."""
        start = self._start(problem.start)
        strategy, tool, target, motion = problem.strategy, problem.tool, problem.target, problem.motion
        obstacles = tuple(problem.obstacles)
        release = next((p.start for p in motion.phases if p.name == "release"), None) if strategy.releases else None
        count = len(motion.times) if release is None else int(np.searchsorted(motion.times, release + 1e-9))
        times, poses = motion.times[:count], motion.world_from_tool[:count]
        plane = table_plane(problem.table)
        return Request(
            strategy=strategy,
            tool=tool,
            target=target,
            obstacles=obstacles,
            motion=motion,
            plane=plane,
            start=start,
            seed=problem.seed,
            budget=budget,
            feedback=feedback,
            times=times,
            poses=poses,
            keys=key_poses(poses, self.settings),
            met=next((p.start for p in motion.phases if p.name in ("contact", "goal")), float(times[-1])),
            shapes=shell(solid_pieces(tool)),
            marks=motion.marks or waypoint_times(strategy),
            cloud=unexplained((target, *obstacles), tool, plane, self.cloud),
            searches=self.settings.searches,
            roomy_searches=self.settings.searches,
        )

    def _start(self, given: Array | None) -> Array:
        """Where the arm is (J,): at home where nothing else is ``given``."""
        chain = self.robot.chain
        start = self.robot.home.copy() if given is None else np.asarray(given, dtype=float)
        if start.shape != (self.robot.count,) or not np.all(np.isfinite(start)):
            raise MagicError(Code.BAD_REQUEST, "start configuration", start.tolist(), f"{self.robot.count} finite joint positions")
        over = np.flatnonzero((start < chain.lower - 1e-3) | (start > chain.upper + 1e-3))
        if len(over):
            j = int(over[0])
            allowed = f"{chain.lower[j]} to {chain.upper[j]} rad"
            raise MagicError(Code.JOINT_LIMIT, f"start, {chain.names[j]}", round(float(start[j]), 4), allowed)
        return start


class _Search:
    """The search for the plan of one request among grasps and the ways of the arm to follow the task with each.

    held: the grasp of a tool that is in the hand already, the arm at the request's start.  attempt: how many grasps that serve are left
    to the attempts before.
    """

    def __init__(self, planner: ArmPlanner, request: Request, held: Grasp | None, pace: Pace, attempt: int) -> None:
        self.planner, self.request, self.pace, self.attempt = planner, request, pace, attempt
        self.in_hand = held is not None
        self.failures = Failures()
        self.chosen: list[Array] = []  # grasps of the attempts before, in order
        self.spare: list[Branch] = []  # those that close where one of these does, only from another side
        self.tried = 0  # plans that failed after the hand had come to its grasp
        self.quick = 0  # of the lot in hand: those that failed before

    def plan(self, lots: Iterator[list[Grasp]]) -> MotionPlan:
        """The plan with the first grasp that serves, after those of the attempts before; raises what came furthest where there is none."""
        for number, lot in enumerate(lots):
            plan = self._among(self._branches(lot, number == 0), elsewhere=True)
            if plan is not None:
                return plan
        plan = self._among(self.spare, elsewhere=False)
        if plan is not None:
            return plan
        if self.chosen:
            count = len(self.chosen)
            allowed = f"0 to {count - 1}: there are {count} different grasps"
            raise MagicError(Code.NO_GRASP, "stage grasp: attempt", self.attempt, allowed)
        raise self.failures.error()

    def _branches(self, lot: list[Grasp], best: bool) -> list[Branch]:
        """The ways to follow the task with the grasps of a lot; ``best``: these are the first ones."""
        planner, request = self.planner, self.request
        request.budget.check("task")
        if not best:  # what cannot be picked up is not followed; the best few are left to be looked at when their turn comes
            lot = planner.hand.reached(request, lot, self.failures)
        request.feedback("task", f"following the task with {len(lot)} grasps")
        return planner.task.branches(request, lot, self.failures) if lot else []

    def _among(self, branches: list[Branch], elsewhere: bool) -> MotionPlan | None:
        """The plan with the first of these branches that serves, where no attempt before had its grasp; ``elsewhere``: those that close
        where one of these does are put by."""
        self.quick = 0
        for grasp, ways in self.planner.task.clear(self.request, branches, self.failures):
            if self.quick >= self.planner.settings.quick_tries:
                break
            frame = grasp.tool_from_tcp
            if elsewhere and any(_same_place(frame, other, self.planner.robot.closing) for other in self.chosen):
                self.spare += [branch for branch in branches if branch.grasp is grasp]
                continue
            if any(_alike(frame, other) for other in self.chosen):
                continue
            plan = self._in_one_of(itertools.islice(ways, WAYS))
            if plan is not None:
                return plan
        return None

    def _in_one_of(self, ways: Iterator[Branch]) -> MotionPlan | None:
        """The plan in the first of the ways with one grasp that serves; ``None`` where none does, or the grasp is one
        of the attempts before, which is noted."""
        for branch in ways:
            if self.tried >= self.planner.settings.tries:
                raise self.failures.error()
            try:
                plan = self._along(branch)
            except StageError as failure:
                self.failures.add(failure.stage, failure.error)
                if failure.stage in ("task", "approach"):
                    self.quick += 1
                else:
                    self.tried += 1
                if failure.stage == "approach":
                    break  # the same hand comes to the same grasp in its other ways
                continue
            self.chosen.append(branch.grasp.tool_from_tcp)
            return plan
        return None

    def _along(self, branch: Branch) -> MotionPlan | None:
        """The whole plan along one branch, or ``None``, once pick-up and task are known to be possible, where its grasp is one of
        the attempts before; raises StageError."""
        planner, request = self.planner, self.request
        planner.task.check(request, branch)
        if self.in_hand:
            here = request.start[None]
            pick = here, request.start, planner.hand.raised(request, branch)
        else:
            pick = planner.hand.pick(request, branch)
        task = planner.task.follow(request, branch)
        retreat = planner.hand.retreat(request, branch, task) if request.strategy.releases else None
        if len(self.chosen) < self.attempt:
            return None
        request.feedback("transfer", "free motion with the tool in hand")
        carry = planner.free.carry(request, branch, pick[2][-1], task[0])
        if self.in_hand:
            come = pick[0]
        else:
            request.feedback("approach", "free motion to the tool")
            come = planner.free.come(request, pick[0][0])
        request.feedback("timing", "time parameterisation")
        return self.pace.bearable(planner.schedule.timed(request, branch, come, pick, carry, task, retreat))


def tipping(lying: Array, used: Array) -> float:
    """The angle (rad) by which a tool is tipped out of one pose (4, 4) in the world for another; turns about the vertical do not count."""
    return float(np.arccos(np.clip(lying[2, :3] @ used[2, :3], -1.0, 1.0)))


def _alike(a: Array, b: Array) -> bool:
    """Whether two grasps are the same to the eye: 15 mm and 20 degrees."""
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.015) and transforms.rotation_angle(a, b) < np.deg2rad(20)


def _same_place(a: Array, b: Array, closing: Array) -> bool:
    """Whether two grasps close at the same place along the same line, to 15 mm and 20 degrees, from whatever side the hand comes."""
    near = bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < 0.015)
    return near and abs(float((a[:3, :3] @ closing) @ (b[:3, :3] @ closing))) > np.cos(np.deg2rad(20))
