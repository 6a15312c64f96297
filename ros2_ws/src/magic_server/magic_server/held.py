"""A tool in the hand, and the stages of a run that goes on with it."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from magic_core import conversions, transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.motion import Phase, ToolMotion
from magic_core.robot import Description
from magic_interfaces.msg import MotionPlan, SceneObject, SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_server import pipeline, scene_change
from magic_server.in_hand import Shape
from magic_server.remote import Token
from magic_server.stages import Server, Stages, code_of, hull_of


@dataclass(frozen=True)
class Held:
    """A tool in the hand: the object as it was seen before it was grasped, and tool_from_tcp (4, 4), how it is held;
    ``looked``: as it was seen in the hand."""

    tool: SceneObject
    tool_from_tcp: NDArray[np.float64]
    looked: bool = False

    @property
    def mesh(self) -> Mesh:
        """Its shape, in its own frame."""
        return conversions.mesh_from_msg(self.tool.mesh)

    @cached_property
    def shape(self) -> Shape:
        """Its shape with what was seen of it before it was grasped."""
        seen = transforms.inverse(conversions.pose_from_msg(self.tool.pose))
        return Shape.of(self.mesh, transforms.apply(seen, conversions.cloud_from_msg(self.tool.cloud)[0]))

    def pose(self, world_from_tcp: NDArray[np.float64]) -> NDArray[np.float64]:
        """world_from_tool (4, 4) with the hand at a pose."""
        return np.asarray(world_from_tcp @ transforms.inverse(self.tool_from_tcp))

    def hull(self, world_from_tcp: NDArray[np.float64]) -> NDArray[np.float64]:
        """Its hull (see :mod:`magic_server.scene_change`) with the hand at a pose."""
        return scene_change.hull(transforms.apply(self.pose(world_from_tcp), self.mesh.vertices))

    def sees(self, item: SceneObject, world_from_tcp: NDArray[np.float64], known: Collection[str]) -> bool:
        """Whether an object, as it is seen, is this tool in the hand, whatever its id; ``known``: ids of other things, which are none."""
        if item.id == self.tool.id:
            return True
        return item.id not in known and scene_change.contained(hull_of(item), self.hull(world_from_tcp), scene_change.ABOUT)

    def in_hand(self) -> SceneObject:
        """The object in the frame of the hand's tip."""
        return self.at(np.eye(4))

    def at(self, world_from_tcp: NDArray[np.float64]) -> SceneObject:
        """The object with the hand at a pose; the points seen of it before are left out."""
        item, pose = copy.copy(self.tool), self.pose(world_from_tcp)
        moved = pose @ transforms.inverse(conversions.pose_from_msg(item.pose))
        item.pose = conversions.pose_to_msg(pose)
        item.box_pose = conversions.pose_to_msg(moved @ conversions.pose_from_msg(item.box_pose))
        item.cloud = PointCloud2(header=item.cloud.header)
        item.hanging = True
        return item


@dataclass(frozen=True)
class Carried:
    """Where a tool has been that was taken up: in the hand from the stamp ``taken`` on, when the hand was at ``taken_at`` (4, 4; None:
    since before the motion began), and until ``let_go``, when it was at ``let_go_at`` (None: it still is)."""

    held: Held
    taken: float = -math.inf
    taken_at: NDArray[np.float64] | None = None
    let_go: float = math.inf
    let_go_at: NDArray[np.float64] | None = None

    def hull(self, stamp: float, hand: Callable[[float], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Its hull at a stamp, with world_from_tcp (4, 4) by stamps: what has been let go is taken to stay where it was."""
        if self.taken_at is not None and stamp <= self.taken:
            return self.held.hull(self.taken_at)
        if self.let_go_at is not None and stamp >= self.let_go:
            return self.held.hull(self.let_go_at)
        return self.held.hull(hand(stamp))


def rest_of(plan: MotionPlan, point: int, tool_from_tcp: NDArray[np.float64], robot: Description) -> MotionPlan:
    """What is left of an arm's motion from a point of its trajectory on, where it stands, with the tool in
    the hand as it is: tool_from_tcp (4, 4)."""
    arm, begin = plan.arm_trajectory, conversions.time_from_msg(plan.arm_trajectory.points[point].time_from_start)
    rest = MotionPlan(variant=plan.variant, grasp_width=plan.grasp_width, grasp_time=0.0, release_time=plan.release_time - begin)
    rest.tool_from_tcp = conversions.pose_to_msg(tool_from_tcp)
    rest.phases = [copy.copy(phase) for phase in plan.phases if phase.end > begin]
    for phase in rest.phases:
        phase.start, phase.end = max(0.0, phase.start - begin), phase.end - begin
    rest.arm_trajectory.header, rest.arm_trajectory.joint_names = arm.header, arm.joint_names
    times = np.array([conversions.time_from_msg(p.time_from_start) for p in arm.points[point:]]) - begin
    for time_, row in zip(times, arm.points[point:], strict=True):
        row = copy.copy(row)
        row.time_from_start = conversions.duration_to_msg(time_)
        rest.arm_trajectory.points.append(row)
    first = rest.arm_trajectory.points[0]
    first.velocities, first.accelerations = [0.0] * len(first.velocities), [0.0] * len(first.accelerations)
    poses = robot.forward(np.array([row.positions for row in arm.points[point:]])) @ transforms.inverse(tool_from_tcp)
    if not math.isnan(rest.release_time):  # from there on it stays where it was let go
        poses[times > rest.release_time] = poses[times <= rest.release_time][-1]
    phases = tuple(Phase(phase.name, phase.start, phase.end) for phase in rest.phases)
    tool_id, frame = plan.tool_trajectory.joint_names[0], plan.tool_trajectory.header.frame_id
    rest.tool_trajectory = conversions.tool_motion_to_msg(ToolMotion(times, poses, phases), tool_id, frame)
    return rest


class HeldStages(Stages):
    """The stages of a run with the tool in the hand: nothing is grasped, and the tool is matched by its view from before.

    ``known``: ids of the other things.  ``before``: whose contacts are kept, for a scene that is as it was; else the target is looked at
    and matched anew.  ``rest``: a trial, and what is left of its motion, which is tried where no other can be planned from there.
    """

    def __init__(
        self,
        server: Server,
        token: Token,
        run: str,
        needs_verifier: bool,
        held: Held,
        known: Collection[str],
        since: float,
        before: Stages | None = None,
        rest: tuple[pipeline.Trial, MotionPlan] | None = None,
    ) -> None:
        super().__init__(server, token, run, needs_verifier, heatmap=False, since=since)
        self.held, self._known = held, frozenset(known)
        self._kept, self._rest = before, rest
        self._tool = held.tool

    def perceive(self, request: pipeline.Request, timeout: float) -> tuple[pipeline.Request, str]:
        """Take the objects there are, the tool where the hand has it."""
        if self._kept is None:
            super().perceive(request, timeout)
        else:
            self._scene, self._seen, self.strategy, self._minds = self._kept.scene, self._kept._seen, request.strategy, self._kept._minds
        self._tool = self.held.at(self._server.hand())
        self._scene = self._without_tool(self.scene)
        return request, ""

    def _named(self, request: pipeline.Request) -> tuple[pipeline.Request, str]:
        return request, ""  # both are known by their ids

    def _without_tool(self, scene: SceneObjectArray) -> SceneObjectArray:
        """The scene without what is in the hand, whatever its id."""
        rest = copy.copy(scene)
        rest.objects = [o for o in scene.objects if o.id != self._tool.id]
        if any(o.id not in self._known for o in rest.objects):  # of what is known from before its id is enough
            hand = self._server.hand(conversions.time_from_msg(scene.header.stamp))
            rest.objects = [o for o in rest.objects if not self.held.sees(o, hand, self._known)]
        return rest

    def _enough(self, scene: SceneObjectArray, request: pipeline.Request) -> bool:
        return any(o.id == request.target_id for o in scene.objects)

    def _unknown(self, scene: SceneObjectArray, request: pipeline.Request) -> tuple[str, str] | None:
        return None  # a target that is hidden may come in sight

    def _tool_of(self, trial: pipeline.Trial) -> SceneObject:
        return self._tool

    def _obstacles(self, trial: pipeline.Trial, matches: pipeline.Matches) -> list[SceneObject]:
        return [o for o in self.scene.objects if o.id != matches.target_id]

    def match(self, request: pipeline.Request, timeout: float) -> pipeline.Matches:
        """The contacts kept, or those of the tool's view and the target that is seen now."""
        if self._kept is not None:
            known = self._kept.matches
            candidates = [c for c in known.candidates if c.tool_id == self.held.tool.id]
            sentence = f"{len(candidates)} candidates for {known.target_id}, the tool is in the hand"
            self._matches = pipeline.Matches(candidates, known.target_id, known.features, None, sentence, known.doubts)
            return self._matches
        server = self._server
        message = MatchContact.Request(
            strategy=request.strategy, tool_views=[self.held.tool.view], target_id=request.target_id, top_k=request.top_k
        )
        deadline = time.monotonic() + min(timeout, server.settings.match)
        with self._minding(server.planner, *self._verifier()):
            answer = server.matcher.call(message, max(0.0, deadline - time.monotonic()), self._token, server.settings.presence)
        if answer.code != Code.OK or not answer.candidates:
            raise MagicError(code_of(answer.code or Code.NO_MATCH), answer.message or "no contact was found")
        self._same_target(request.target_id)
        for candidate in answer.candidates:
            candidate.tool_id = self.held.tool.id
            point = transforms.apply(
                conversions.pose_from_msg(self._tool.pose), conversions.pose_from_msg(candidate.tool.object_from_contact)[:3, 3]
            )
            candidate.point.x, candidate.point.y, candidate.point.z = map(float, point)
        sentence = f"{len(answer.candidates)} candidates for {request.target_id}, the tool is in the hand, {answer.features} features"
        self._matches = pipeline.Matches(answer.candidates, request.target_id, answer.features, None, sentence)
        return self._matches

    def plan(self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, timeout: float) -> pipeline.Planned:
        """Ask the planner, and where it finds nothing for the trial that was under way take what is left of that."""
        planned = super().plan(request, matches, trial, timeout)
        if self._rest is None or planned.code == Code.OK or planned.code in pipeline.FATAL:
            return planned
        before, rest = self._rest
        if trial.candidate is not before.candidate or trial.reflection != before.reflection:
            return planned
        sentence = f"no other motion from there ({planned.code.name}: {planned.message}); the rest of the one begun, with the tool as it is"
        return pipeline.Planned(Code.OK, sentence, rest)

    def goes_on(self, plan: MotionPlan) -> bool:
        """Whether a plan is what was left of the motion before, and not another one."""
        return self._rest is not None and plan is self._rest[1]

    def _same_target(self, target_id: str) -> None:
        """The contact on the target is told in its own frame, which the matcher may have from a newer scene than this run's: take that
        one where the frame is another; raises STALE_DATA where the target is gone from it."""
        newest = self._server.scene
        if newest is None or newest is self._seen:
            return
        found = next((o for o in newest.objects if o.id == target_id), None)
        if found is None:
            raise MagicError(Code.STALE_DATA, f"{target_id} has gone while its contact was looked for")
        self._take(newest, time.monotonic())
        self._scene = self._without_tool(self.scene)
