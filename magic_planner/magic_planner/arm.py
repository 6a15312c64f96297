"""How the arm takes the tool along: grasp, lift, transfer, the task itself, retreat.

The tool's motion is given (:mod:`magic_planner.object_motion`) and a grasp is rigid,
so the hand's path is known for each grasp before anything is planned.  The search
therefore starts at the far end: grasps whose hand can follow the whole task come
first, and only for those are the pick-up and the free motion planned.  What fails
is kept with its stage, and the failure that came furthest is the one reported.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_core.motion import TOOL_SPEED, TOOL_TURN, Margin, MotionPlan, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_planner import timing
from magic_planner.budget import Budget
from magic_planner.choice import GraspChoice
from magic_planner.cloud import CloudSettings, unexplained
from magic_planner.collision import shell, solid_pieces
from magic_planner.free_motion import FreeMotion
from magic_planner.grasps import GraspSettings
from magic_planner.hand_moves import HandMoves
from magic_planner.held import grasp_in_hand
from magic_planner.margins import margins
from magic_planner.object_motion import placed_contact_frame, table_plane, turning, waypoint_times
from magic_planner.request import ArmSettings, Branch, Failures, Request, StageError
from magic_planner.robot import Robot
from magic_planner.schedule import Schedule, slowed
from magic_planner.task_path import TaskPath, key_poses
from magic_planner.workspace import Workspace

Array = NDArray[np.float64]
#: Ways to follow the task with one grasp that are tried.
WAYS = 3
#: A tool that is tipped by more (rad) from how it lies to how it is used asks for a grasp that serves both attitudes.
TIPPED = np.deg2rad(20.0)
#: A tool that the arm can carry too fast for grip, joints or the tool's own speed is carried so many times as slowly at most; and so many
#: times as slowly nothing is left of its inertia.
GENTLEST, AT_REST = 3.0, 100.0
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
        """The arm's motion that takes the tool from where it lies along ``motion``.

        start (J,): where the arm is (default: home).  attempt: 0 for the best grasp, n for the n-th next that differs from
        those before.  A tool's retreat that the arm cannot follow is left out.

        A tool that hangs (``tool.hanging``) is in the hand, where its pose and ``start`` put it: it is not grasped anew but raised
        where something is beneath it, and carried on; the gripper of such a plan closes at 0 s.

        Raises NO_GRASP, NO_IK, JOINT_LIMIT, START_IN_COLLISION, PATH_IN_COLLISION, NO_PATH, DYNAMIC_LIMIT,
        TIME_PARAMETERISATION, PLANNING_TIMEOUT, CANCELED, each naming the stage and the waypoint, pair or limit, and by how much a tool
        has to be tipped that lies otherwise than it is used.
        """
        budget = budget or Budget()
        if tool.hanging and start is None:
            raise MagicError(Code.BAD_REQUEST, f"start, with {tool.id} in the hand", "none", "where the arm is")
        given = (strategy, tool, target, candidate, reflection)
        rest = (table, obstacles, start, attempt, seed, budget, feedback)
        try:
            return self._with_ending(strategy, given, motion, rest, feedback)
        except MagicError as error:
            angle = tipping(tool.world_from_object, motion.world_from_tool[0])
            if error.code not in _REACHES or angle < TIPPED:
                raise
            raise MagicError(
                error.code,
                f"{error.message}; {tool.id} has to be tipped by {np.degrees(angle):.0f} degrees from how it lies to how it is used, "
                "and is not set down on the way to be grasped anew: one grasp has to serve both",
            ) from error

    def _with_ending(
        self,
        strategy: Strategy,
        given: tuple[Any, ...],
        motion: ToolMotion,
        rest: tuple[Any, ...],
        feedback: Callable[[str, str], None],
    ) -> MotionPlan:
        """The plan of the whole motion, or without the tool's retreat where that is what fails."""
        try:
            return self._plan(*given, motion, *rest)
        except MagicError as error:
            ending = next((p for p in motion.phases if p.name == "retreat"), None)
            if ending is None or strategy.releases or error.code not in (Code.NO_IK, Code.JOINT_LIMIT, Code.PATH_IN_COLLISION):
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
            return self._plan(*given, shorter, *rest)

    def _plan(
        self,
        strategy: Strategy,
        tool: SceneObject,
        target: SceneObject,
        candidate: ContactCandidate,
        reflection: str,
        motion: ToolMotion,
        table: Array | Sequence[float],
        obstacles: Sequence[SceneObject],
        start: Array | None,
        attempt: int,
        seed: int,
        budget: Budget,
        feedback: Callable[[str, str], None],
    ) -> MotionPlan:
        robot = self.robot
        start = robot.home.copy() if start is None else np.asarray(start, dtype=float)
        if start.shape != (robot.count,) or not np.all(np.isfinite(start)):
            raise MagicError(Code.BAD_REQUEST, "start configuration", start.tolist(), f"{robot.count} finite joint positions")
        over = np.flatnonzero((start < robot.chain.lower - 1e-3) | (start > robot.chain.upper + 1e-3))
        if len(over):
            j = int(over[0])
            raise MagicError(
                Code.JOINT_LIMIT,
                f"start, {robot.chain.names[j]}",
                round(float(start[j]), 4),
                f"{robot.chain.lower[j]} to {robot.chain.upper[j]} rad",
            )
        release = next((p.start for p in motion.phases if p.name == "release"), None) if strategy.releases else None
        count = len(motion.times) if release is None else int(np.searchsorted(motion.times, release + 1e-9))
        times, poses = motion.times[:count], motion.world_from_tool[:count]
        plane = table_plane(table)
        request = Request(
            strategy=strategy,
            tool=tool,
            target=target,
            obstacles=tuple(obstacles),
            motion=motion,
            plane=plane,
            start=start,
            seed=seed,
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
        self.space.build(request)
        held = grasp_in_hand(robot, tool, start) if tool.hanging else None
        if held is None:
            robot.open_to(robot.config.opening)
        else:
            self.space.carry_off(request, held)
        pair = robot.collision(start)
        if pair is not None:
            raise MagicError(Code.START_IN_COLLISION, "stage approach: the arm at its start", str(pair), "a start clear of everything")

        feedback("grasp", "looking for grasps that serve the whole motion" if held is None else "the tool is in the hand")
        failures = Failures()
        tool_from_contact = placed_contact_frame(strategy, candidate, reflection)
        choice = GraspChoice(robot, self.grasping, self.settings, request, tool_from_contact)
        lots = choice.lots() if held is None else iter([[held]])
        chosen: list[Array] = []  # grasps of the attempts before, in order
        spare: list[Branch] = []  # those that close where one of these does, only from another side
        tried = 0
        for number, lot in enumerate(itertools.chain(lots, [None])):
            quick = 0
            if lot is None:
                branches = spare
            else:
                budget.check("task")
                if number:  # what cannot be picked up is not followed; the best few are left to be looked at when their turn comes
                    lot = self.hand.reached(request, lot, failures)
                feedback("task", f"following the task with {len(lot)} grasps")
                branches = self.task.branches(request, lot, failures) if lot else []
            for grasp, ways in self.task.clear(request, branches, failures):
                if quick >= self.settings.quick_tries:
                    break
                frame = grasp.tool_from_tcp
                if lot is not None and any(_same_place(frame, other, robot.closing) for other in chosen):
                    spare += [branch for branch in branches if branch.grasp is grasp]
                    continue
                if any(_alike(frame, other) for other in chosen):
                    continue
                for branch in itertools.islice(ways, WAYS):
                    if tried >= self.settings.tries:
                        raise failures.error()
                    tried += 1
                    try:
                        plan = self._complete(request, branch, len(chosen) < attempt, held is not None)
                        if plan is not None:
                            plan = self._bearable(request.tool, choice.grasping, tool_from_contact, plan)
                    except StageError as failure:
                        failures.add(failure.stage, failure.error)
                        if failure.stage in ("task", "approach"):
                            tried, quick = tried - 1, quick + 1
                        if failure.stage == "approach":
                            break  # the same hand comes to the same grasp in its other ways
                        continue
                    chosen.append(frame)
                    if plan is not None:
                        return plan
                    tried -= 1
                    break
        if chosen:
            raise MagicError(
                Code.NO_GRASP, "stage grasp: attempt", attempt, f"0 to {len(chosen) - 1}: there are {len(chosen)} different grasps"
            )
        raise failures.error()

    def _bearable(self, tool: SceneObject, grasping: GraspSettings, tool_from_contact: Array, plan: MotionPlan) -> MotionPlan:
        """The plan with its margins, the tool carried no faster than it may go and than grip and joints bear; raises StageError where that
        is more than :data:`GENTLEST` times as slowly as the joints could."""
        plan = slowed(plan, max(1.0, *haste(plan.tool_motion)))
        try:
            return self._with_margins(tool, grasping, tool_from_contact, plan)
        except StageError:
            quick, still = (self._margins(tool, grasping, tool_from_contact, p) for p in (plan, slowed(plan, AT_REST)))
            # Each share grows at most by its inertial part, which falls with the square of the factor: the shares are sums of norms.
            left = {margin.name: margin.left for margin in still}
            needed = [(margin.left, left[margin.name]) for margin in quick if margin.left < 0]
            if min(rest for _, rest in needed) <= 0:
                raise
            factor = max(math.sqrt((rest - moving) / rest) for moving, rest in needed) + 0.01
            if factor > GENTLEST:
                raise
        return self._with_margins(tool, grasping, tool_from_contact, slowed(plan, factor))

    def _margins(self, tool: SceneObject, grasping: GraspSettings, tool_from_contact: Array, plan: MotionPlan) -> tuple[Margin, ...]:
        arm = plan.arm_motion
        assert arm is not None
        held = (arm.grasp_time, np.inf if arm.release_time is None else arm.release_time)
        return margins(
            self.robot, grasping, tool, arm.tool_from_tcp, tool_from_contact, arm.times, arm.positions, held, plan.tool_motion.phases
        )

    def _with_margins(self, tool: SceneObject, grasping: GraspSettings, tool_from_contact: Array, plan: MotionPlan) -> MotionPlan:
        """The plan with its margins; raises StageError where one is negative."""
        found = self._margins(tool, grasping, tool_from_contact, plan)
        least = min(found, key=lambda margin: margin.left)
        if least.left < 0:
            code = Code.NO_GRASP if least.name == "grip" else Code.DYNAMIC_LIMIT
            raise StageError("timing", MagicError(code, f"margin of {least}", f"{100 * least.left:.0f} % left", "0 % or more"))
        return replace(plan, margins=found)

    def _complete(self, request: Request, branch: Branch, only_check: bool, in_hand: bool) -> MotionPlan | None:
        """The whole plan for one branch, or (``only_check``) None once pick-up and task are known to be possible; raises StageError.

        in_hand: the tool is there already, and the arm at the request's start.
        """
        self.task.check(request, branch)
        if in_hand:
            here = request.start[None]
            pick = here, request.start, self.hand.raised(request, branch)
        else:
            pick = self.hand.pick(request, branch)
        task = self.task.follow(request, branch)
        retreat = self.hand.retreat(request, branch, task) if request.strategy.releases else None
        if only_check:
            return None
        request.feedback("transfer", "free motion with the tool in hand")
        carry = self.free.carry(request, branch, pick[2][-1], task[0])
        if in_hand:
            come = pick[0]
        else:
            request.feedback("approach", "free motion to the tool")
            come = self.free.come(request, pick[0][0])
        request.feedback("timing", "time parameterisation")
        return self.schedule.timed(request, branch, come, pick, carry, task, retreat)


def haste(motion: ToolMotion) -> tuple[float, float]:
    """Speed and turning speed of a tool at their greatest, in shares of what is allowed."""
    steps = np.diff(motion.times)
    way = np.linalg.norm(np.diff(motion.world_from_tool[:, :3, 3], axis=0), axis=1)
    turns = turning(motion.world_from_tool[:-1], motion.world_from_tool[1:])
    return float((way / steps).max() / TOOL_SPEED), float((turns / steps).max() / TOOL_TURN)


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
