"""The stages of a run as the strategy server has them done: by the graph's other nodes."""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Quaternion, Vector3
from numpy.typing import NDArray
from sensor_msgs.msg import Image, JointState

from magic_core import conversions, masses, naming, transforms
from magic_core.conversions import without_pictures as light
from magic_core.errors import Code, MagicError
from magic_core.open_words import OpenWords
from magic_core.robot import Description
from magic_core.strategy import Strategy
from magic_interfaces.action import PlanMotion, VerifyMotion
from magic_interfaces.msg import ContactCandidate, MotionPlan, SceneObject, SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_server import pipeline, scene_change
from magic_server.ahead import Ahead
from magic_server.joints import JointStates, check_range
from magic_server.permission import Verdict, check_single
from magic_server.remote import RemoteAction, RemoteService, Token
from magic_server.settings import Settings

#: How much later than here the same objects may arrive at the matcher, s.
OBJECTS_LAG = 5.0
#: An id that is in no objects yet is looked for so long, s: who asks by the newest ones may be quicker than they come here.
ID_LAG = 1.0
#: Points of a contact that are nearer than this are the same, m: it went through messages, but nobody measured it anew.
SAME_POINT = 1e-6
#: A reconstruction whose surface may be off by more than this, m, is no longer what a hook, a handle or a hollow is judged by; where
#: nobody says by how much, one below this confidence, which is hardly ever right (``docs/results_perception.md``).
OFF, DOUBTFUL = 0.004, 0.2


def doubt(item: SceneObject) -> str:
    """Why an object as it was reconstructed may not be what stands there; empty where it probably is."""
    stated = item.surface_error > 0
    if item.source == SceneObject.KNOWN or (item.surface_error <= OFF if stated else item.confidence >= DOUBTFUL):
        return ""
    why = f"may be off by {1000 * item.surface_error:.1f} mm" if stated else f"confidence {item.confidence:.2f}"
    return (
        f"{item.id} is a doubtful reconstruction ({why}, {100 * item.seen_share:.0f} % of its surface seen): "
        "a hole or a hollow that no view shows is not in it; turn it, or look from another side"
    )


class Server(Protocol):
    """What the stages need of the strategy server, a node."""

    settings: Settings
    patience: float
    robot: Description
    matcher: RemoteService
    planner: RemoteAction
    verifier: RemoteAction
    scene: SceneObjectArray | None
    scenes: Sequence[SceneObjectArray]
    joints: JointStates
    words: OpenWords | None
    ahead: Ahead[pipeline.Planned]
    objects_topic: str

    def in_base(self, scene: SceneObjectArray) -> SceneObjectArray: ...

    def hand(self, stamp: float | None = None) -> NDArray[np.float64]: ...

    def servers(self) -> dict[str, frozenset[bytes]]: ...

    def objects_watch(self) -> Callable[[], None]: ...

    def complaint(self) -> DiagnosticStatus | None: ...

    def count_publishers(self, topic: str) -> int: ...

    def get_logger(self) -> Any: ...


class Stages:
    """The stages of :mod:`magic_server.pipeline`, done by the other nodes; messages pass through as they came.

    scene: the objects of this run, in the robot's base frame, with a stamp no older than ``since``, s.  tried:
    motions for the same task that were simulated before. closer: how long a better reconstruction is waited for, s,
    where that of what the request names is doubtful.
    """

    def __init__(
        self,
        server: Server,
        token: Token,
        run: str,
        needs_verifier: bool,
        heatmap: bool,
        since: float = -math.inf,
        tried: int = 0,
        closer: float = 0.0,
    ) -> None:
        self._server = server
        self._closer = closer
        self._since = since
        self._run = run
        self._heatmap = heatmap
        self._token = token
        self._minds: dict[str, Callable[[], None]] = {}  # by a server's name, since the run began
        self._needs_verifier = needs_verifier
        self.strategy = ""
        self._seen: SceneObjectArray | None = None  # the same objects as they came
        self._scene: SceneObjectArray | None = None
        self._matches: pipeline.Matches | None = None
        #: What the verifier was asked and the code of its answer, of motions that passed and of the last one, by their trials.
        self._judged: dict[tuple[int, str, int], tuple[VerifyMotion.Goal, int]] = {}
        self._meanwhile: Callable[[], None] = lambda: None  # begun once, while the verifier is at work
        #: Motions for the same task that the verifier was asked for.
        self.tried = tried

    @property
    def scene(self) -> SceneObjectArray:
        """The objects of this run, from :meth:`perceive` on."""
        assert self._scene is not None, "no objects have been taken yet"
        return self._scene

    @property
    def matches(self) -> pipeline.Matches:
        """The contacts of this run, from :meth:`match` on."""
        assert self._matches is not None, "nothing has been matched yet"
        return self._matches

    @property
    def matched(self) -> bool:
        """Whether there are objects and contacts."""
        return self._scene is not None and self._matches is not None

    def perceive(self, request: pipeline.Request, timeout: float) -> tuple[pipeline.Request, str]:
        """Take the objects there are, or wait for them; see that every server is there.  Names in words become ids."""
        server, self.strategy = self._server, request.strategy
        # First the servers: a run that cannot be verified is not begun.
        deadline = time.monotonic() + min(timeout, server.settings.presence)
        needed = (server.matcher, server.planner, *self._verifier())
        for remote in needed:
            remote.require(max(0.0, deadline - time.monotonic()), self._token)
        if not self._token.wait(lambda: all(len(s) <= 1 for s in server.servers().values()), deadline, alive=lambda: None):
            check_single(server.servers())
        wait = min(timeout, server.patience * server.settings.objects)
        soon = time.monotonic() + ID_LAG

        def enough() -> bool:
            scene = server.scene
            if scene is None or conversions.time_from_msg(scene.header.stamp) < self._since:
                return False
            # A wrong id is answered soon; too few objects may still become enough.
            return time.monotonic() > soon if self._unknown(scene, request) else self._enough(scene, request)

        self._minds = {remote.name: remote.mind() for remote in (server.planner, *self._verifier())}
        watches = [server.objects_watch(), *(remote.watch() for remote in needed)]

        def still_there() -> None:
            for watch in watches:
                watch()

        came = self._token.wait(enough, time.monotonic() + wait, alive=still_there)
        scene = server.scene
        if not came or scene is None:
            raise self._no_objects(scene, wait)
        if self._closer > 0 and self._doubtful(request):
            # Motions for what does not stand there fail, and of those that follow more is asked, as of the last of many.
            server.get_logger().info("waiting for a closer look at what is to be used")
            self._token.wait(lambda: not self._doubtful(request), time.monotonic() + min(self._closer, timeout / 3), alive=still_there)
            scene = server.scene or scene
        unknown = self._unknown(scene, request)
        if unknown:
            there = [o.id for o in scene.objects]
            raise MagicError(Code.UNKNOWN_OBJECT, unknown[0], unknown[1], f"{', '.join(there)}, or a name such as 'the longest tool'")
        self._take(scene, time.monotonic() + wait)
        return self._named(request)

    def _named(self, request: pipeline.Request) -> tuple[pipeline.Request, str]:
        """The request with its names read, and how; a name is of the objects as the robot's base sees them."""
        ids = {o.id for o in self.scene.objects}
        given = {what: value for what in ("tool_id", "target_id") if (value := getattr(request, what)) and value not in ids}
        if not given:
            return request, ""
        objects = [conversions.object_from_msg(o) for o in self.scene.objects]
        words = self._server.words
        readings = {
            what: naming.resolve(value, objects) if words is None or naming.is_name(value) else words.resolve(value, objects)
            for what, value in given.items()
        }
        ids_of = {what: reading.id for what, reading in readings.items()}
        request = replace(request, tool_id=ids_of.get("tool_id", request.tool_id), target_id=ids_of.get("target_id", request.target_id))
        pipeline.check_different(request)
        return request, "; ".join(reading.sentence for reading in readings.values())

    def _doubtful(self, request: pipeline.Request) -> bool:
        """Whether one of the things that are named by their ids is a doubtful reconstruction by the newest look."""
        scene = self._server.scene
        return scene is not None and any(o.id in (request.tool_id, request.target_id) and doubt(o) for o in scene.objects)

    def _enough(self, scene: SceneObjectArray, request: pipeline.Request) -> bool:
        """Whether there is a tool that was seen, and a target."""
        return len(scene.objects) >= 2 and (bool(request.tool_id) or any(o.source == SceneObject.CAMERA for o in scene.objects))

    def _verifier(self) -> tuple[RemoteAction, ...]:
        """The verifier, where this run needs it."""
        return (self._server.verifier,) if self._needs_verifier else ()

    def _minding(self, *remotes: RemoteAction) -> AbstractContextManager[None]:
        """End waits while inside where one of these, to be asked now or later, has gone since the run began."""
        checks = [self._minds[remote.name] for remote in remotes if remote.name in self._minds]

        def still_there() -> None:
            for check in checks:
                check()

        return self._token.minding(still_there)

    def _take(self, scene: SceneObjectArray, deadline: float) -> None:
        """Make a scene this run's own, told in the robot's base frame; waits a little for the transform.  Raises NO_TRANSFORM."""

        def carried() -> bool:
            try:
                self._scene, self._seen = self._server.in_base(scene), scene
            except MagicError as error:
                if error.code != Code.NO_TRANSFORM or time.monotonic() >= deadline:
                    raise
                return False
            return True

        # Until the deadline is past, so that the last try says why.
        while not self._token.wait(carried, time.monotonic() + 0.1):
            pass

    def _unknown(self, scene: SceneObjectArray, request: pipeline.Request) -> tuple[str, str] | None:
        ids = [o.id for o in scene.objects]
        for what, value in (("tool_id", request.tool_id), ("target_id", request.target_id)):
            if value and ids and value not in ids and not naming.is_name(value) and self._server.words is None:
                return what, value
        return None

    def _no_objects(self, scene: SceneObjectArray | None, wait: float) -> MagicError:
        """Why there is nothing to work on: in perception's own words where it has spoken."""
        server = self._server
        topic = server.objects_topic
        if scene is not None and conversions.time_from_msg(scene.header.stamp) < self._since:
            code, what = Code.STALE_DATA, f"nothing newer than what is to be looked at again came on {topic} within {wait:.1f} s"
        elif scene is not None:
            ids = [o.id for o in scene.objects]
            seen = sum(o.source == SceneObject.CAMERA for o in scene.objects)
            code, what = (
                Code.NO_OBJECTS,
                f"objects on {topic}: {len(ids)} ({', '.join(ids) or 'none'}), {seen} of them seen by a camera "
                f"(allowed: at least two, a tool that a camera sees, and a target), waited {wait:.1f} s",
            )
        else:
            publishers = server.count_publishers(topic)
            code = Code.NO_OBJECTS if publishers else Code.NO_FRAMES
            what = f"nothing came on {topic} within {wait:.1f} s; it has {publishers} publishers"
        complaint = server.complaint()
        if complaint is not None:
            code = complaint_code(complaint) or code
            what = f"{complaint.message} ({what})"
        return MagicError(code, what)

    def match(self, request: pipeline.Request, timeout: float) -> pipeline.Matches:
        """Ask the matcher, until its objects and ours are the same."""
        server = self._server
        message = MatchContact.Request(
            strategy=request.strategy,
            tool_ids=[request.tool_id] if request.tool_id else [],
            target_id=request.target_id,
            top_k=request.top_k,
            want_heatmap=self._heatmap,
        )
        deadline = time.monotonic() + min(timeout, server.settings.match)
        patience = min(time.monotonic() + OBJECTS_LAG, deadline)
        while True:
            # A match may take a minute: it is not waited for where nobody will be there to go on with it.
            with self._minding(server.planner, *self._verifier()):
                answer = server.matcher.call(message, max(0.0, deadline - time.monotonic()), self._token, server.settings.presence)
            # The ids were found in the objects that came here; the matcher may just be about to read the same message.
            if not self._behind(answer) and self._same_objects(answer):
                break
            if time.monotonic() > patience:
                raise self._other_objects(answer)
            self._token.wait(lambda: False, time.monotonic() + 0.05)
        if answer.code != Code.OK or not answer.candidates:
            raise MagicError(code_of(answer.code or Code.NO_MATCH), answer.message or "no contact was found")
        heatmap = answer.heatmap if len(answer.heatmap.data) else None
        target_id = answer.target_id or request.target_id
        scores = ", ".join(f"{c.tool_id} {c.score:.3f}" for c in answer.candidates)
        sentence = f"{len(answer.candidates)} candidates for {target_id} ({scores}), {answer.features} features, {answer.seconds:.2f} s"
        involved = {target_id, *(c.tool_id for c in answer.candidates)}
        doubts = tuple(text for o in self.scene.objects if o.id in involved and (text := doubt(o)))
        self._matches = pipeline.Matches(answer.candidates, target_id, answer.features, heatmap, sentence, doubts)
        return self._matches

    def _behind(self, answer: MatchContact.Response) -> bool:
        """Whether the matcher has refused for what this run's objects do not show: it may not have read them yet."""
        if answer.code == Code.SOMETHING_HANGS:
            return not any(o.hanging for o in self.scene.objects)
        return answer.code in (Code.UNKNOWN_OBJECT, Code.NO_OBJECTS)

    def _same_objects(self, answer: MatchContact.Response) -> bool:
        """Whether the answer is about this run's objects, or about newer ones, which are this run's from here on.

        Perception goes on meanwhile, and an object's own frame, in which contacts are given, may be another one in the next
        scene: its axis may point the other way.  The contacts' points in the world tell.
        """
        seen = self._seen
        assert seen is not None
        # A match takes as long as perception takes for several scenes: its own may be neither the first nor the newest of them.
        since = conversions.time_from_msg(seen.header.stamp)
        newer = [s for s in reversed(self._server.scenes) if s is not seen and conversions.time_from_msg(s.header.stamp) >= since]
        for scene in (seen, *newer):
            if all(_stands_in(scene, c, answer.target_id) for c in answer.candidates):
                if scene is not seen:
                    self._take(scene, time.monotonic())
                for candidate in answer.candidates:
                    self._carry_point(candidate)
                return True
        return False

    def _carry_point(self, candidate: ContactCandidate) -> None:
        """Tell a candidate's point in the robot's base frame, as the objects are."""
        if not np.isnan(candidate.point.x):
            tool = conversions.pose_from_msg(self._find(candidate.tool_id).pose)
            x, y, z = (tool @ conversions.pose_from_msg(candidate.tool.object_from_contact))[:3, 3]
            candidate.point.x, candidate.point.y, candidate.point.z = float(x), float(y), float(z)

    def _other_objects(self, answer: MatchContact.Response) -> MagicError:
        if answer.code != Code.OK:
            return MagicError(code_of(answer.code), answer.message or "the matcher knows no such objects")
        ids = [o.id for o in self.scene.objects]
        named = [answer.target_id, *(c.tool_id for c in answer.candidates)]
        return MagicError(
            Code.UNKNOWN_OBJECT, "objects that the matcher chose", ", ".join(dict.fromkeys(named)), [*ids, "where they stand now"]
        )

    def _find(self, object_id: str) -> SceneObject:
        return next(o for o in self.scene.objects if o.id == object_id)

    def _tool_of(self, trial: pipeline.Trial) -> SceneObject:
        """The tool of a trial, where it is when the motion begins."""
        return self._find(trial.candidate.tool_id)

    def plan(self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, timeout: float) -> pipeline.Planned:
        """Ask the planner for one trial, or take its answer where it was asked before."""
        deadline = time.monotonic() + timeout
        with self._minding(self._server.planner, *self._verifier()):
            planned = self._expected(trial, deadline)
            if planned is not None:
                return planned
            return self._ask_planner(request, matches, trial, max(0.0, deadline - time.monotonic()), self._token)

    def expect(self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, timeout: float) -> None:
        """Have the planner asked for a trial, in another thread, as soon as the verifier has its next
        motion: not before, for that is waited for."""
        token = Token(self._token)
        self._meanwhile = lambda: self._server.ahead.begin(
            self._key(trial), lambda: self._ask_planner(request, matches, trial, timeout, token), token.cancel
        )

    def forget(self) -> None:
        """Cancel what the planner was asked for that nobody waits for."""
        self._server.ahead.drop()

    def _key(self, trial: pipeline.Trial) -> Hashable:
        return self, trial.index, trial.reflection, trial.attempt

    def _expected(self, trial: pipeline.Trial, deadline: float) -> pipeline.Planned | None:
        """What the planner answered for a trial that was expected; ``None`` where it is to be asked now,
        which nothing stands in the way of then.

        Only an answer for the trial itself counts: whatever else kept one from coming may be over.
        """
        future, mine = self._server.ahead.take(self._key(trial))
        if future is None:
            return None
        future.add_done_callback(self._token.poke)
        if not self._token.wait(future.done, deadline, alive=lambda: None) or not mine or future.exception() is not None:
            return None
        planned = future.result()
        return None if planned.code in pipeline.FATAL else planned

    def _ask_planner(
        self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, timeout: float, token: Token
    ) -> pipeline.Planned:
        server = self._server
        timeout = min(timeout, server.settings.plan)
        goal = PlanMotion.Goal(
            strategy=request.strategy,
            variant=request.variant,
            # The tool's own points are never obstacles, and of an obstacle its pieces and what was measured of it count.
            tool=light(self._tool_of(trial), cloud=False, surface=True),
            target=light(self._find(matches.target_id), cloud=True, surface=True),
            obstacles=[light(o, cloud=True, surface=False) for o in self._obstacles(trial, matches)],
            table=self.scene.table,
            candidate=trial.candidate,
            reflection=trial.reflection,
            attempt=trial.attempt,
            tool_mass=request.tool_mass,
            target_mass=request.target_mass,
            seed=request.seed,
            timeout=timeout,
        )
        joints = server.joints.all()
        goal.start = JointState(name=list(joints), position=[j.position for j in joints.values()])
        result = server.planner.call(goal, timeout, token, server.settings.presence, server.settings.grace).result
        if result.code == Code.OK:
            self._check_plan(result.plan, request.variant)
        elif result.code == Code.JOINT_LIMIT:
            # Of the way that was planned, or of where the arm stands already, which is the same whatever is tried next.
            try:
                check_range(server.robot.arm, joints)
            except MagicError as error:
                raise pipeline.HopelessError(error.code, error.message) from error
        return pipeline.Planned(code_of(result.code), result.message, result.plan, bool(joints))

    def _check_plan(self, plan: MotionPlan, variant: str) -> None:
        """A plan must be what was asked for, and in the robot's base frame."""
        if plan.variant != variant:
            raise MagicError(Code.UNKNOWN_VARIANT, "variant of the plan", plan.variant, variant)
        trajectories = (plan.tool_trajectory, plan.arm_trajectory) if variant == MotionPlan.ARM else (plan.tool_trajectory,)
        for frame in {t.header.frame_id for t in trajectories}:
            if frame != self.scene.header.frame_id:
                raise MagicError(
                    Code.BAD_REQUEST, "frame of the plan", frame, f"{self.scene.header.frame_id}, the robot's base frame and the objects'"
                )

    def verify(
        self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, plan: MotionPlan, timeout: float
    ) -> Verdict:
        """Ask the verifier for one planned motion."""
        server = self._server
        timeout = min(timeout, server.settings.verify)
        goal = VerifyMotion.Goal(
            strategy=request.strategy,
            # Where points were seen of it, its surface is known best.
            tool=light(self._tool_of(trial), cloud=True, surface=True),
            target=light(self._find(matches.target_id), cloud=False, surface=True),
            # Obstacles are simulated by their pieces; their surface is for the film alone.
            obstacles=[light(o, cloud=False, surface=False) for o in self._obstacles(trial, matches)],
            table=self.scene.table,
            candidate=trial.candidate,
            plan=plan,
            repetitions=server.settings.repetitions,
            tool_mass=request.tool_mass,
            target_mass=request.target_mass,
            seed=request.seed,
            tried=self.tried,
            timeout=timeout,
        )
        self.tried += 1
        meanwhile, self._meanwhile = self._meanwhile, lambda: None
        with self._minding(server.verifier):
            answer = server.verifier.call(goal, timeout, self._token, server.settings.presence, server.settings.grace, accepted=meanwhile)
        result = answer.result
        code = code_of(result.code)
        if code == Code.OK and not result.success:
            code = Code.GOAL_NOT_REACHED
        self._judged = {made: asked for made, asked in self._judged.items() if asked[1] == Code.OK}
        self._judged[trial.index, trial.reflection, trial.attempt] = goal, result.code
        message = pipeline.with_metrics(result.message, list(zip(result.metric_names, result.metric_values)))
        return Verdict(
            code,
            message,
            result.success_rate,
            result.rate_low,
            result.rate_high,
            result.rollouts,
            tuple(result.failures),
            answer.server,
            self._run,
            mark_of(plan),
        )

    def weight(self, request: pipeline.Request, trial: pipeline.Trial, strategy: Strategy) -> str:
        """What the tool of a trial was taken to weigh: no camera sees it, and a verdict rests on it."""
        return masses.sentence(strategy, conversions.object_from_msg(self._tool_of(trial), pictures=False), request.tool_mass)

    def film(self, outcome: pipeline.Outcome) -> Image | None:
        """The film strip of the motion that a run ended with, or of the last that it simulated: the verifier draws it from what it
        recorded when it gets the same goal again.

        Drawing may cost more than simulating, and only one of a run's simulations is looked at.
        """
        server = self._server
        if not self._judged or outcome.code in pipeline.FATAL:
            return None
        trial = outcome.reports[-1].trial
        goal, code = self._judged[(trial.index, trial.reflection, trial.attempt) if outcome.verified else next(reversed(self._judged))]
        goal.want_film = True
        around = {o.id for o in goal.obstacles}
        goal.obstacles = [light(o, cloud=False, surface=True) for o in self.scene.objects if o.id in around]
        try:
            result = server.verifier.call(goal, server.settings.verify, self._token, server.settings.presence, server.settings.grace).result
        except MagicError as error:
            server.get_logger().warning(f"no film: {error.message}")
            return None
        if result.code != code:  # another client came in between, and the repetition took too long, for one
            server.get_logger().warning(f"no film: asked for it, the verifier answered {result.code} instead of {code}: {result.message}")
            return None
        return result.film if len(result.film.data) else None

    def _obstacles(self, trial: pipeline.Trial, matches: pipeline.Matches) -> list[SceneObject]:
        return [o for o in self.scene.objects if o.id not in (trial.candidate.tool_id, matches.target_id)]


def _stands_in(scene: SceneObjectArray, candidate: ContactCandidate, target_id: str) -> bool:
    """Whether a candidate's tool and target are in a scene, the tool such that its contact is where the matcher has it."""
    tools = {o.id: o for o in scene.objects}
    if candidate.tool_id not in tools or (target_id and target_id not in tools):
        return False
    point = np.array([candidate.point.x, candidate.point.y, candidate.point.z])
    if np.isnan(point).any():  # not told
        return True
    world_from_tool = conversions.pose_from_msg(tools[candidate.tool_id].pose)
    contact = conversions.pose_from_msg(candidate.tool.object_from_contact)
    return bool(np.allclose((world_from_tool @ contact)[:3, 3], point, rtol=0.0, atol=SAME_POINT))


def check_ids(scene: SceneObjectArray) -> None:
    """Refuse objects two of which have one id: what is asked for by it would be one of them, and the other in no plan; raises
    BAD_REQUEST."""
    counts = Counter(item.id for item in scene.objects)
    twice = sorted(name for name, count in counts.items() if count > 1)
    if twice:
        raise MagicError(Code.BAD_REQUEST, "ids of the objects, given twice", ", ".join(twice), "ids that differ")


def same_frames(one: SceneObjectArray, other: SceneObjectArray) -> bool:
    """Whether two scenes have the same objects, in the same order, with their own frames where they
    were: contacts mean the same in both."""
    return one.header.frame_id == other.header.frame_id and [(o.id, o.pose) for o in one.objects] == [(o.id, o.pose) for o in other.objects]


def hull_of(item: SceneObject) -> NDArray[np.float64]:
    """The hull of an object (see :mod:`magic_server.scene_change`), in the frame of its array."""
    vertices = np.array([(p.x, p.y, p.z) for p in item.mesh.vertices]).reshape(-1, 3)
    return scene_change.hull(transforms.apply(conversions.pose_from_msg(item.pose), vertices))


def mark_of(plan: MotionPlan) -> bytes:
    """What tells a motion from every other one: a digest of its numbers (serialised messages have padding in them)."""
    numbers: list[float] = []

    def pose(at: Vector3 | Point, turned: Quaternion) -> None:
        numbers.extend((at.x, at.y, at.z, turned.x, turned.y, turned.z, turned.w))

    numbers.extend((plan.grasp_width, plan.grasp_time, plan.release_time))
    pose(plan.tool_from_tcp.position, plan.tool_from_tcp.orientation)
    for point in plan.arm_trajectory.points:
        since = point.time_from_start
        numbers.extend((since.sec, since.nanosec, *point.positions, *point.velocities, *point.accelerations))
    for point in plan.tool_trajectory.points:
        numbers.extend((point.time_from_start.sec, point.time_from_start.nanosec))
        for transform in point.transforms:
            pose(transform.translation, transform.rotation)
    names = " ".join([plan.variant, *plan.arm_trajectory.joint_names])
    return hashlib.sha256(names.encode() + np.array(numbers, dtype=float).tobytes()).digest()


def code_of(number: int) -> Code:
    """A number from another node as a Code; what is not one is INTERNAL."""
    try:
        return Code(number)
    except ValueError:
        return Code.INTERNAL


def complaint_code(status: DiagnosticStatus) -> Code | None:
    """The result code that a diagnostic names under the key ``code``, as a number or a name."""
    for item in status.values:
        if item.key == "code":
            text = item.value.strip()
            code = Code.__members__.get(text) or (Code(int(text)) if text.isdigit() and int(text) in list(Code) else None)
            return code if code != Code.OK else None
    return None
