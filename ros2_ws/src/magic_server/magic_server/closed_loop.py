"""A goal carried out with open eyes: what is looked at while arm and gripper move, and what follows.

The states, each left by a step that was looked at or by a failure with a code::

    carried out ----------------------------------------> judged --met--> the end, OK
     |   |   |                                              |  `--cannot be told--> the end, GOAL_UNSEEN
     |   |   |                                              `--missed--> next candidate
     |   |   |--a thing has moved--> stopped, at rest --> perceived and planned anew, or with the tool in the hand from there
     |   |   `--pictures are too old--> the same, once newer ones have come; the end (STALE_DATA) where the tool has been let go
     |   |--the tool is off in the hand--> planned anew from its pose as it is, or given up (TOOL_SLIPPED)
     |   `--the tool weighs something else than was taken--> planned anew with what it weighs, or given up (TOOL_WEIGHT)
     `--the grasp failed--> next grasp or candidate

Whatever is planned anew is verified anew, and moves only by its own verdict: each beginning of the arm asks
:func:`magic_server.permission.permit`.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_core import conversions, masses, transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description
from magic_core.robot_pictures import link_mesh
from magic_core.scene import UNSEEN
from magic_core.strategy import Strategy
from magic_interfaces.msg import MotionPlan, SceneObject, SceneObjectArray
from magic_server import execution, in_hand, pipeline, scene_change, seen_goal, weighing
from magic_server.after_task import After, points_of, thing
from magic_server.arm import Arm
from magic_server.held import Carried, Held, HeldStages, rest_of
from magic_server.intrusion import Intruded, Intrusion, Way, strangers
from magic_server.joints import STANDSTILL
from magic_server.permission import Claim, Limits, Look, NotYet, Purpose, World, permit
from magic_server.remote import Token
from magic_server.scene_change import Changed
from magic_server.settings import LoopSettings
from magic_server.stages import Server, Stages, hull_of
from magic_server.watch import Bounds, SceneWatch, Unwatched
from magic_server.weighing import Reading

#: A picture shows what was there so many seconds before its stamp, too: several are averaged.
SETTLED = 0.3
#: An arm that has stopped swings for so long, s, and its torques are then read for so long, s.
CALM, WEIGHING = 0.2, 0.3
#: A tool whose lowest point is nearer to the table than this, m, may rest on it in part: it turned in the fingers.
CLEAR = 0.02
#: Fingers that are nearer to each other than this share of what they had between them have lost it.
LOST = 0.5
#: An arm is at rest where no joint has moved by more than so many rad in so many seconds.
STILL, STILL_FOR = 0.003, 0.1
#: A simulation is given so many times the wall's time.
SLOWEST = 20.0
#: joint_states that are silent for so much longer than ``state_age`` while the arm moves stop it, s: a busy machine delivers late.
SILENT = 1.0
#: Of the points on each link every so many stand for it where something has come in, and at most so many of the tool's corners.
SPARSE, MOST_OF_TOOL = 8, 300
#: Failures after which the next candidate is tried, from the state as it is then.
RETRIED = frozenset({Code.GRASP_FAILED, Code.GOAL_MISSED})
#: Two contacts of one tool that are nearer than this are the same, m.
SAME_CONTACT = 0.015
#: The phases of a motion in which the tool is meant to touch the target.
CONTACT_PHASES = ("contact", "goal")


class Robot(Server, Protocol):
    """What the loop needs of the strategy server, a node."""

    def look(self) -> Look | None: ...

    def world(self) -> World: ...

    def get_clock(self) -> Any: ...

    def tell_held(self, held: Held | None) -> None: ...

    def get_parameter(self, name: str) -> Any: ...


class Off(Exception):
    """The tool in the hand is not what the motion was verified with: ``held`` as it is, and by which ``error``."""

    def __init__(self, held: Held, error: MagicError) -> None:
        super().__init__(error.message)
        self.held, self.error = held, error


@dataclass(frozen=True)
class Job:
    """A planned motion that is to be carried out: what came of planning it, by which stages, and what the rule is to know of it;
    ``held``: the tool is in the hand where it begins."""

    outcome: pipeline.Outcome
    stages: Stages
    claim: Claim
    held: Held | None = None


@dataclass(frozen=True)
class Goal:
    """What is carried out: by which strategy, as the pipeline was asked for it, what cancels it, and the run that it is."""

    strategy: Strategy
    request: pipeline.Request
    token: Token
    run: str


@dataclass(frozen=True)
class Calls:
    """What the loop leaves to others.

    plan(request, stages, reflections, spent): a run of the pipeline.  claim(outcome, stages): what the rule is to
    know of it.  allowed(ask): what ``ask`` returns, once that is allowed.  begun(): the arm is about to move.
    tell(job, text): how far a job has come.
    """

    plan: Callable[[pipeline.Request, Stages, Sequence[str], Callable[[Any], int]], pipeline.Outcome]
    claim: Callable[[pipeline.Outcome, Stages], Claim]
    allowed: Callable[[Callable[[], Any]], Any]
    begun: Callable[[], None]
    tell: Callable[[Job, str], None]


class ClosedLoop:
    """Carries one goal out, looks, and goes on from what there is; :meth:`execute` raises what it ends with, unless that is success.

    first: what is carried out first.  Afterwards ``jobs`` holds what was carried out, the last one last, ``tried`` all
    outcomes of planning, ``executed`` whether the last was carried out to its end, ``notes`` what is to be told, and
    ``weight`` what the tool was found to weigh, if it was.
    """

    def __init__(
        self,
        server: Robot,
        arm: Arm,
        settings: LoopSettings,
        limits: Limits,
        goal: Goal,
        first: Job,
        calls: Calls,
    ) -> None:
        self._server, self._arm, self._settings, self._limits = server, arm, settings, limits
        self._goal, self._calls = goal, calls
        self.jobs, self.tried = [first], [first.outcome]
        self.notes: list[str] = []
        self.weight = ""
        self.executed = False
        self._in_hand: Held | None = None
        self._carried: Carried | None = None
        self._touched = self._may_touch = False
        self._point = 0  # of the trajectory, where the tool was looked at last
        self._width = math.nan  # m between the fingers when they had closed
        self._empty: Reading | None = None  # the arm before the fingers closed
        self._masses: dict[str, float] = {}  # kg of tools that weigh something else than was taken, by their ids
        self._spent: list[tuple[str, NDArray[np.float64], NDArray[np.float64], int]] = []
        self._simulated = bool(server.get_parameter("use_sim_time").value)
        self._bounds = Bounds(settings.executions, settings.replans, time.monotonic() + settings.seconds)

    @property
    def _held(self) -> Held | None:
        """What the hand holds."""
        return self._in_hand

    @_held.setter
    def _held(self, held: Held | None) -> None:
        self._in_hand = held
        self._server.tell_held(held)

    @property
    def _has_let_go(self) -> bool:
        """Whether the tool has been taken up and let go."""
        return self._carried is not None and self._carried.let_go_at is not None

    # ------------------------------------------------------------ the loop

    def execute(self) -> str:
        """Carry out, look, and go on until the goal is met; returns what was seen of it in a sentence.  Raises how else it ends."""
        while True:
            job = self.jobs[-1]
            try:
                return self._carry_out(job)
            except Off as off:
                error = off.error
                self._follow(error, lambda error: self._bounds.elsewhere(error, error.code, time.monotonic()))
                following = self._corrected(job, off.held)
            except Intruded as error:
                self._at_rest(error)
                raise
            except (Changed, Unwatched) as stop:
                if isinstance(stop, Unwatched) and self._has_let_go:
                    raise  # what is left is the way back: nothing that another plan would do
                error = MagicError(Code.SCENE_CHANGED if isinstance(stop, Changed) else stop.code, stop.message)
                self._follow(error, lambda error: self._bounds.elsewhere(error, error.code, time.monotonic()))
                following = self._anew()
            except MagicError as failure:
                error = failure
                if error.code not in RETRIED:
                    raise
                self._follow(error, lambda error: self._bounds.fail(error, time.monotonic()))
                self._spend(job, error.code)
                following = self._anew()
            self.tried.append(following.outcome)
            if following.outcome.code != Code.OK:
                raise MagicError(error.code, f"{error.message}; planned again from there: {following.outcome.message}")
            self.jobs.append(following)

    def _follow(self, error: MagicError, count: Callable[[MagicError], None]) -> None:
        """See that the arm stands and that there is another try."""
        self._at_rest(error)
        if self._has_lost():
            self._held = self._carried = None
        count(error)
        self._say(f"{error.code.name}: {error.message}; planning again from the state as it is")
        self.notes.append(f"{error.code.name}: {error.message}")

    def _carry_out(self, job: Job) -> str:
        self._held, self._touched, self._may_touch = job.held, False, False
        self._carried = None if job.held is None else Carried(job.held)
        self.executed = False
        # What goes on where the tool has just been looked at may stand next where it has met the target.
        looks = self._settings.look and not (isinstance(job.stages, HeldStages) and job.stages.goes_on(job.outcome.plan))
        self._arm.execute(job.outcome.plan, self._goal.token, self._say, self, job.held is not None, looks)
        self.executed = True
        return self._judge(job) if self._settings.judge else ""

    def _say(self, text: str) -> None:
        self._calls.tell(self.jobs[-1], text)

    # ------------------------------------------------------------ what the arm asks (magic_server.arm.Guard)

    def ask(self, point: int) -> None:
        """Ask the rule whether the arm may begin to move from a point of its trajectory; raises GRASP_FAILED
        where the tool has fallen out of the hand."""
        self._refuse_lost()
        self._touched = self._touched or self._may_touch
        job = self.jobs[-1]
        outcome = job.outcome
        positions = tuple(outcome.plan.arm_trajectory.points[point].positions)
        asked = replace(job.claim, start=positions, meant=frozenset(self._meant()))
        began = time.monotonic()

        def allowed() -> None:
            # What the joints told before the last move's end was heard may be from on the way.
            told = [joint.came for name, joint in self._server.joints.all().items() if name in asked.joints]
            if told and min(told) <= began and time.monotonic() - min(told) <= self._limits.state_age:
                raise NotYet(Code.STALE_DATA, "joint_states have not come since the last move ended")
            world = self._server.world()
            claim = asked if world.scene is None else replace(asked, carried=self._tool_at(world.scene.stamp))
            permit(claim, replace(world, servers={**world.servers, **self._arm.servers()}), self._limits, Purpose.MOVE)

        self._calls.allowed(allowed)
        self._calls.begun()

    def _meant(self) -> set[str]:
        """The ids of what the motion has moved so far, or may have."""
        outcome = self.jobs[-1].outcome
        moved = {outcome.tool_id} if self._carried is not None or self._touched else set()
        return moved | ({outcome.target_id} if self._touched else set())

    def _tool_at(self, stamp: float) -> NDArray[np.float64] | None:
        """The hull of the tool where it was at a stamp, once it has been taken up; raises STALE_DATA
        where nobody said where the hand was then."""
        if self._carried is None:
            return None
        try:
            return self._carried.hull(stamp, self._server.hand)
        except MagicError as error:
            raise NotYet(error.code, error.message) from error  # of a newer picture it may be known

    def watch(self, move: execution.Move, speed: float) -> Callable[[], None]:
        """Look at the scene while the arm moves."""
        job, server = self.jobs[-1], self._server
        times = [conversions.time_from_msg(p.time_from_start) for p in job.outcome.plan.arm_trajectory.points]
        contact = contact_time(job.outcome.plan) if self._held is not None else math.inf
        self._may_touch = times[move.last] > contact
        if not self._settings.watch:
            return lambda: None
        began = self._now()
        until = (contact - times[move.first]) / speed
        watching = SceneWatch(
            job.claim.scene, self._meant(), job.outcome.target_id, until, self._settings.watch_tolerance, self._limits.objects_age
        )

        newest: list[Look | None] = [None]
        intrusion = self._intrusion(move, speed)

        def check() -> None:
            try:
                with suppress(NotYet):  # what cannot be told in the base's frame yet has not come yet
                    newest[0] = server.look()
                # Of a simulation that is slower than the wall's clock only its own clock tells how old a thing is.
                now = newest[0].came if self._simulated and newest[0] is not None else time.monotonic()
                watching.take(newest[0], began, self._now(), now, server.hand()[:3, 3])
                if intrusion is not None and newest[0] is not None:
                    self._look_for_intruders(intrusion, newest[0], began)
                self._heard()
            except MagicError:
                raise
            except Exception as error:  # what cannot be looked at is not moved among: the arm has to be stopped
                raise MagicError(Code.INTERNAL, f"watching the scene: {type(error).__name__}: {error}") from error

        return check

    def _intrusion(self, move: execution.Move, speed: float) -> Intrusion | None:
        """What looks for what comes in where the arm is still to go, from a move on; ``None``: that is not wanted."""
        if self._settings.intrusion <= 0:
            return None
        robot, trajectory = self._server.robot, self.jobs[-1].outcome.plan.arm_trajectory
        points = trajectory.points[move.first :]
        times = np.array([conversions.time_from_msg(p.time_from_start) for p in points])
        order = [list(trajectory.joint_names).index(name) for name in robot.names]
        tool = np.zeros((0, 3))
        if self._held is not None:
            tool = transforms.apply(transforms.inverse(self._held.tool_from_tcp), self._held.mesh.vertices)
        way = Way(
            robot,
            (times - times[0]) / speed,
            np.array([p.positions for p in points])[:, order],
            {link: on[::SPARSE] for link, on in surfaces(robot).items()},
            tool[:: 1 + len(tool) // MOST_OF_TOOL],
            {name: joint.position for name, joint in self._server.joints.all().items() if name not in robot.names},
        )
        return Intrusion(way, self._settings.intrusion)

    def _look_for_intruders(self, intrusion: Intrusion, look: Look, began: float) -> None:
        """Whether something has come in by a look; raises :class:`magic_server.intrusion.Intruded`."""
        claim, outcome = self.jobs[-1].claim, self.jobs[-1].outcome
        try:
            carried = self._tool_at(look.stamp)
        except NotYet:
            return  # where the hand was then nobody said: the tool in it cannot be told from what has come
        before = {**look.remembered, **claim.scene.remembered, **claim.scene.objects}
        come = strangers(before, look.objects, {outcome.tool_id, outcome.target_id}, carried)
        intrusion.take(come, look.stamp, self._now() - began)

    def _heard(self) -> None:
        joints = [joint for name, joint in self._server.joints.all().items() if name in self._server.robot.names]
        if self._simulated:
            silent = self._now() - min((joint.stamp for joint in joints), default=-math.inf)
        else:
            silent = time.monotonic() - min((joint.came for joint in joints), default=-math.inf)
        allowed = self._limits.state_age + SILENT
        if not silent <= allowed:
            raise MagicError(
                Code.STALE_DATA, "joint_states are silent while the arm moves, for s", round(silent, 2), f"at most {allowed:g}"
            )

    def closing(self) -> None:
        """Read what the arm bears with its empty hand, to weigh what it takes up."""
        settings, since = self._settings, self._now() + CALM
        self._empty = None
        told = self._reading(-math.inf).torques  # of a stand-in for an arm all zero
        if settings.look and settings.torque_error > 0 and np.isfinite(told).all() and told.any():
            self._wait(lambda: False, CALM + WEIGHING)
            self._empty = self._reading(since)

    def _reading(self, since: float) -> Reading:
        """The arm as it stands, with what its joints have borne from a stamp on."""
        joints = self._server.joints
        positions = {name: joint.position for name, joint in joints.all().items()}
        return Reading(positions, joints.efforts(self._server.robot.names, since))

    def closed(self, opening: float) -> None:
        """The fingers have closed on the tool, and are so many metres apart."""
        job = self.jobs[-1]
        tool = next(o for o in job.stages.scene.objects if o.id == job.outcome.tool_id)
        self._held = Held(tool, conversions.pose_from_msg(job.outcome.plan.tool_from_tcp))
        self._carried = Carried(self._held, self._now(), self._server.hand())
        self._width = opening

    def _between(self) -> float:
        """Metres between the fingers; not a number where nobody tells."""
        robot, joints = self._server.robot, self._server.joints.all()
        told = [joints[joint.name].position if joint.name in joints else math.nan for joint in robot.fingers]
        return float(np.abs(np.array(told) - robot.closed).sum())

    def _has_lost(self) -> bool:
        """Whether the fingers have gone together where the tool was."""
        return self._held is not None and self._between() < LOST * self._width

    def _refuse_lost(self) -> None:
        if self._has_lost():
            self._held = self._carried = None
            between = f"{1000 * self._between():.1f} mm between the fingers"
            raise MagicError(
                Code.GRASP_FAILED, "the tool has fallen out of the hand", between, f"about {1000 * self._width:.1f} mm, as it was taken"
            )

    def opened(self) -> None:
        """The fingers are about to open: what was in the hand is where it was let go."""
        self._touched = self._touched or self._may_touch
        if self._held is not None and self._carried is not None:
            self._carried = replace(self._carried, let_go=self._now(), let_go_at=self._server.hand())
        self._held = None

    def look(self, point: int) -> None:
        """Look at the tool in the hand, and weigh it; raises :class:`Off`, GRASP_FAILED where it lies where
        it lay or has fallen out, TOOL_SLIPPED."""
        self._refuse_lost()
        held, self._point = self._held, point
        assert held is not None
        scene = self._fresh()
        if scene is None:
            self._unseen("no picture came")
            off = None
        else:
            try:
                off = self._off(held, scene)
            except MagicError as error:
                if error.code == Code.TOOL_SLIPPED:  # a weight may be why
                    self._weighed(held, rests=True)
                raise
        weight = self._weighed(held if off is None else off.held)
        if off is not None:
            raise off if weight is None else Off(off.held, MagicError(off.error.code, f"{off.error.message}; {weight.message}"))
        if weight is not None:
            raise Off(held, weight)

    def _weighed(self, held: Held, rests: bool = False) -> MagicError | None:
        """What speaks against going on by the tool's weight: that it is not what the motion was verified with.

        Of a tool that ``rests`` on something, or may, it is known what it weighs at least: that is told, and is not enough to plan with.
        """
        if self._empty is None:
            return None
        name, tool = self.jobs[-1].outcome.tool_id, conversions.object_from_msg(held.tool, pictures=False)
        centre = transforms.apply(transforms.inverse(held.tool_from_tcp), masses.centre(tool)[None])[0]
        try:
            robot, error = self._server.robot, self._settings.torque_error
            weight = weighing.weighed(robot, error, self._empty, self._reading(self._now() - WEIGHING), centre)
        except MagicError as failure:
            self.notes.append(f"the tool was not weighed: {failure.message}")
            return None
        taken = masses.taken(self._goal.strategy, tool, self._masses.get(name, self._goal.request.tool_mass))
        grams = 1000 * taken
        if rests or self._above_table(held) < CLEAR:
            if weight.least > weighing.DRAWN * taken:
                least = 1000 * weight.least
                self.notes.append(
                    f"the tool weighs {least:.0f} g at least by the arm's torques, where {grams:.0f} g were taken: weigh it, and give tool_mass"
                )
            else:
                self.notes.append("the tool was not weighed: a part of it may rest on the table")
            return None
        self.weight = f"the tool weighs {weight} by the arm's torques"
        self._say(f"{self.weight}; {grams:.0f} g were taken")
        if not self._goal.strategy.simulatable or not weight.differs(taken):
            return None
        self._masses[name] = weight.mass
        return MagicError(Code.TOOL_WEIGHT, f"{self.weight}, where {grams:.0f} g were taken")

    def _above_table(self, held: Held) -> float:
        """How far the lowest point of the tool in the hand is above the table, m."""
        table = conversions.plane_from_msg(self.jobs[-1].stages.scene.table)
        return float((transforms.apply(held.pose(self._server.hand()), held.mesh.vertices) @ table[:3] + table[3]).min())

    def _off(self, held: Held, scene: SceneObjectArray) -> Off | None:
        """How the tool is off in the hand by what is seen, where that asks for another plan; raises GRASP_FAILED, TOOL_SLIPPED."""
        settings = self._settings
        hand = self._server.hand(conversions.time_from_msg(scene.header.stamp))
        expected = held.pose(hand)
        job = self.jobs[-1]
        points = in_hand.clear_of(hand, points_of(scene, job.claim.scene.objects, job.outcome.tool_id, self._limits.object_tolerance))
        spread = in_hand.LOOKED if held.looked else in_hand.GRASPED
        found = in_hand.locate(held.shape, expected, points, hand, self._closing, spread)
        if found is None:
            lying = next((o for o in scene.objects if self._lies(o, job)), None)
            if lying is not None:
                self._held = self._carried = None
                raise MagicError(Code.GRASP_FAILED, f"{job.outcome.tool_id} was not taken along: it lies where it lay, seen as", lying.id)
            self._unseen("the hand hides it, or too little of it is seen")
            return None
        off = in_hand.Deviation.of(held.mesh, expected, found.world_from_tool)
        if off.within(settings.tool_shift, settings.tool_turn):
            self._say(f"the tool is in the hand as planned, off by {off}")
            return None
        if not off.within(settings.slip_shift, settings.slip_turn):
            limit = f"at most {1000 * settings.slip_shift:g} mm and {np.degrees(settings.slip_turn):.0f} degrees"
            raise MagicError(Code.TOOL_SLIPPED, "the tool has slipped in the hand by", str(off), limit)
        self._held = Held(held.tool, transforms.inverse(found.world_from_tool) @ hand, True)
        self._carried = Carried(self._held)
        return Off(self._held, MagicError(Code.TOOL_SLIPPED, f"the tool is off in the hand by {off}"))

    @property
    def _closing(self) -> int:
        """The axis of the hand along which the fingers close."""
        return "xy".index(self._server.robot.config.closing_axis)

    def _unseen(self, why: str) -> None:
        self._say(f"the tool in the hand was not seen ({why}): it is carried on as it was grasped")
        self.notes.append(f"the tool in the hand was not seen: {why}")

    def _lies(self, item: SceneObject, job: Job) -> bool:
        """Whether an object is the tool, where it was before it was grasped, and seen there."""
        before = job.claim.scene.objects.get(job.outcome.tool_id)
        if before is None:  # it was in the hand already
            return False
        seen = item.source == SceneObject.CAMERA and not {SceneObject.ROBOT, UNSEEN} & set(item.cut_off)
        return seen and scene_change.distance(before, hull_of(item)) <= self._limits.object_tolerance

    # ------------------------------------------------------------ what is looked at, and when

    def _now(self) -> float:
        return float(self._server.get_clock().now().nanoseconds * 1e-9)

    def _wait(self, done: Callable[[], bool], seconds: float) -> bool:
        """Wait until ``done()``, at most so many seconds by the clock of the stamps, which in a simulation may be slow; returns it."""
        end, patience = self._now() + seconds, SLOWEST * seconds if self._simulated else seconds
        over = (lambda: self._now() >= end) if self._simulated else (lambda: False)
        self._goal.token.wait(lambda: done() or over(), time.monotonic() + patience, alive=lambda: None)
        return done()

    def _fresh(self, since: float | None = None) -> SceneObjectArray | None:
        """The objects as a picture shows them that was taken from now on; ``None`` where none comes in time."""
        server, since = self._server, self._now() + SETTLED if since is None else since

        def came() -> bool:
            scene = server.scene
            return scene is not None and conversions.time_from_msg(scene.header.stamp) >= since

        if not self._wait(came, self._settings.look_time):
            return None
        try:
            return server.in_base(server.scene)
        except NotYet:
            return None

    def _at_rest(self, error: MagicError) -> None:
        """Wait until the arm stands that an error has stopped; raises ARM_NOT_AT_REST, also where nobody says where it is."""
        server = self._server
        names = server.robot.names
        first: dict[str, Any] = {}
        begin = time.monotonic()

        def stands() -> bool:
            joints = server.joints.all()
            if any(name not in joints or joints[name].came <= begin for name in names):
                return False
            moving = any(
                name not in first
                or abs(joints[name].position - first[name].position) > STILL
                or abs(joints[name].velocity) > STANDSTILL  # not told: not a number, and not larger
                for name in names
            )
            if moving:
                first.update({name: joints[name] for name in names})
                return False
            return all(joints[name].stamp - first[name].stamp >= STILL_FOR for name in names)

        if not self._wait(stands, self._settings.rest_time):
            raise MagicError(
                Code.ARM_NOT_AT_REST, f"{error.message}; the arm is not known to stand {self._settings.rest_time:g} s after it was to stop"
            )

    # ------------------------------------------------------------ planning again

    def _left(self, tool_id: str = "") -> pipeline.Request:
        """The request with the time that is left of the whole; of the tool that is named, if one is, with what it was found to weigh."""
        left = max(1.0, min(self._goal.request.timeout, self._bounds.end - time.monotonic()))
        request = replace(self._goal.request, timeout=left)
        tool_id = tool_id or request.tool_id
        return replace(request, tool_mass=self._masses.get(tool_id, request.tool_mass))

    def _corrected(self, job: Job, held: Held) -> Job:
        """The rest of the motion, planned anew with the tool as it is, the same contact first; where no plan is found, as it was planned
        before.  Each has its own verdict with the tool as it is."""
        trial = job.outcome.reports[-1].trial
        rest = rest_of(job.outcome.plan, self._point, held.tool_from_tcp, self._server.robot)
        stages = HeldStages(
            self._server,
            self._goal.token,
            self._goal.run,
            self._goal.strategy.simulatable,
            held,
            self.jobs[-1].claim.scene.objects,
            -math.inf,
            job.stages,
            (trial, rest),
        )
        others = [r for r in self._goal.strategy.reflections if r != trial.reflection]
        worse = {id(c): index for index, c in enumerate(job.stages.matches.candidates)}
        outcome = self._calls.plan(
            replace(self._left(job.outcome.tool_id), tool_id=job.outcome.tool_id, target_id=job.outcome.target_id),
            stages,
            [trial.reflection, *others],
            # What was better than this one has failed already.
            lambda candidate: 1 if worse[id(candidate)] < trial.index else self._made(candidate),
        )
        return Job(outcome, stages, self._claim(outcome, stages), held)

    def _anew(self) -> Job:
        """A motion from the state as it is: everything looked at and planned again."""
        held, last = self._held, self.jobs[-1].outcome
        request = self._left() if held is None else self._left(last.tool_id)
        needs = self._goal.strategy.simulatable
        since = self._now() + SETTLED
        if held is None:
            stages = Stages(self._server, self._goal.token, self._goal.run, needs, heatmap=False, since=since)
        else:
            request = replace(request, tool_id=last.tool_id, target_id=last.target_id)
            known = self.jobs[-1].claim.scene.objects
            stages = HeldStages(self._server, self._goal.token, self._goal.run, needs, held, known, since)
        outcome = self._calls.plan(request, stages, self._goal.strategy.reflections, self._made)
        return Job(outcome, stages, self._claim(outcome, stages), held)

    def _claim(self, outcome: pipeline.Outcome, stages: Stages) -> Claim:
        return self._calls.claim(outcome, stages) if outcome.code == Code.OK else self.jobs[-1].claim

    def _spend(self, job: Job, code: Code) -> None:
        """Remember what has failed: a grasp, or where the task was not done a contact with all its grasps."""
        trial = job.outcome.reports[-1].trial
        attempts = trial.attempt + 1 if code == Code.GRASP_FAILED else sys.maxsize
        candidate = trial.candidate
        self._spent.append((candidate.tool_id, *_places(candidate), attempts))

    def _made(self, candidate: Any) -> int:
        """How many attempts were made with a candidate's contact, by its place on the tool or in the world."""
        made = 0
        for tool_id, on_tool, in_world, attempts in self._spent:
            if tool_id == candidate.tool_id:
                here = _places(candidate)
                # Not a number, where it is not told, is near nothing.
                if min(np.nan_to_num(np.linalg.norm(a - b), nan=np.inf) for a, b in zip(here, (on_tool, in_world))) < SAME_CONTACT:
                    made = max(made, attempts)
        return made

    # ------------------------------------------------------------ the goal

    def _judge(self, job: Job) -> str:
        """Look whether the goal is met, twice, so that what moves is seen to move, and on while what may come to rest
        is all that speaks against it, the tool is not well enough seen, or one pair of looks alone says that it is
        missed; raises GOAL_MISSED, GOAL_UNSEEN."""
        settle, apart = seen_goal.patience(self._goal.strategy, self._settings.accuracy)
        self._say("looking whether the goal is met")
        begin = self._now()
        look, missed = self._fresh(begin + max(settle, SETTLED)), False
        while True:
            first, look = look, None if look is None else self._fresh(_later(look, apart))
            if first is None or look is None:
                raise MagicError(
                    Code.GOAL_UNSEEN, f"carried out, but no picture came within {self._settings.look_time:g} s that shows what came of it"
                )
            seen = self._seen_goal(job, first, look)
            again, missed = seen.moving or seen.unsure or (seen.met is False and not missed), seen.met is False
            if seen.met or not again or self._now() >= begin + settle + seen_goal.CALMING:
                break
        if missed and not again:
            raise MagicError(Code.GOAL_MISSED, f"carried out, but the goal is not met by what is seen: {seen.message}")
        if not seen.met:
            raise MagicError(Code.GOAL_UNSEEN, f"carried out, but whether the goal is met cannot be told by what is seen: {seen.message}")
        return seen.message

    def _seen_goal(self, job: Job, first: SceneObjectArray, second: SceneObjectArray) -> seen_goal.SeenGoal:
        """The goal asked of two looks after the motion, for each place where the tool may be by the
        second, and where it was then by the first."""
        outcome = job.outcome
        names = {"tool": outcome.tool_id, "target": outcome.target_id}
        table = conversions.plane_from_msg(first.table)
        let_go = None if self._carried is None else self._carried.let_go_at
        away = None if let_go is None else float(np.linalg.norm((self._server.hand() - let_go)[:3, 3]))
        hand = seen_goal.Hand(self._held is None, away, self._arm_surface())
        phases = [phase.name for phase in outcome.plan.phases]
        scene = job.stages.scene
        before = seen_goal.Sight({item.id: thing(item) for item in scene.objects}, conversions.time_from_msg(scene.header.stamp))
        tolerance, accuracy = self._limits.object_tolerance, self._settings.accuracy
        stood, ids = job.claim.scene.objects, (outcome.tool_id, outcome.target_id)
        strategy = self._goal.strategy.turned(outcome.reports[-1].trial.candidate.turn)
        after = After(scene, stood, *ids, self._carried, self._held, self._closing, tolerance, accuracy)
        firsts, seconds = (after.sights(look, self._server.hand) for look in (first, second))
        found = []
        for now in seconds:
            looks = before, min(firsts, key=lambda sight: sight.apart(now, outcome.tool_id)), now
            found.append(seen_goal.judge(strategy, names, phases, looks, table, hand, accuracy))
        return seen_goal.SeenGoal.of_all(found)

    def _arm_surface(self) -> NDArray[np.float64]:
        """Points (N, 3) on arm and hand where the joints are now."""
        poses = self._server.robot.poses({name: joint.position for name, joint in self._server.joints.all().items()})
        return np.concatenate([transforms.apply(poses[link], points) for link, points in surfaces(self._server.robot).items()])


@lru_cache(maxsize=2)
def surfaces(robot: Description) -> dict[str, NDArray[np.float64]]:
    """Points (N, 3) on the surface of each link beyond the base, in its frame."""
    meshes = {link: link_mesh(robot, link, ("collision", "visual")) for link in robot.links if link != robot.base}
    return {
        link: np.asarray(trimesh.sample.sample_surface(mesh.to_trimesh(), seen_goal.SURFACE, seed=0)[0])
        for link, mesh in meshes.items()
        if mesh is not None and len(mesh.faces)
    }


def contact_time(plan: MotionPlan) -> float:
    """When the tool may first touch the target, s of the plan: as soon as it is in the hand where no phase says."""
    starts = [p.start for p in plan.phases if p.name in CONTACT_PHASES]
    return min(starts, default=plan.grasp_time)


def _later(scene: SceneObjectArray, seconds: float) -> float:
    """The stamp of the next look that is at least so much later than one, s."""
    stamp = conversions.time_from_msg(scene.header.stamp)
    return max(stamp + seconds, math.nextafter(stamp, math.inf))


def _places(candidate: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A contact's place (3,) on the tool and in the world, m; not a number where it is not told."""
    on_tool = conversions.pose_from_msg(candidate.tool.object_from_contact)[:3, 3]
    return on_tool, np.array([candidate.point.x, candidate.point.y, candidate.point.z])
