"""The strategy server: runs a strategy through matcher, planner and verifier, and publishes what physics passed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from magic_core import conversions, presence, qos
from magic_core import strategy as strategies
from magic_core.diagnostics import Diagnostics, clock_complaint, status
from magic_core.errors import Code, MagicError
from magic_core.listening import listen_apart
from magic_core.node import RESULT_TIMEOUT, describe, robot_parameters, run
from magic_core.open_words import OpenWords
from magic_core.robot import Description, RobotConfig
from magic_core.scene import UNSEEN
from magic_core.tf_listener import TransformListener
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_interfaces.msg import CandidateReport, MotionPlan, SceneObjectArray, StageTimes
from magic_interfaces.srv import MatchContact
from magic_server import interop, markers, pipeline
from magic_server import settings as parameters
from magic_server.ahead import Ahead
from magic_server.arm import SLOW, Arm
from magic_server.closed_loop import Calls, ClosedLoop, Goal, Job
from magic_server.held import Held, HeldStages
from magic_server.joints import JointStates
from magic_server.outlet import Motion, Outlet
from magic_server.permission import RECORDED, Claim, Limits, Look, NotYet, Verdict, World
from magic_server.publication import Publication
from magic_server.remote import SEND_GOAL, RemoteAction, RemoteService, Token, servers_of
from magic_server.scene_change import Changed
from magic_server.stages import Stages, check_ids, complaint_code, hull_of, mark_of, same_frames
from magic_server.watch import Bounds

#: Answers that another look at the same things may change: perception draws them anew every ten seconds, and
#: sooner where it can do so more closely.
BY_SIGHT = frozenset({Code.NO_MATCH, Code.OBJECT_CUT_OFF, Code.HANDLE_NOT_SEEN, Code.NO_CANDIDATE_SUCCEEDED})
#: A run that is to be carried out waits for such a look so many times, s each.
LOOKS, LOOK_TIME = 2, 12.0
#: Scenes that differ are kept, so many of them, for what another node answers of one that was the newest when it was asked.
SCENES = 8
#: Whose explanation is looked for when no objects come, besides that of those who publish objects: the node of this name beside this one.
PERCEPTION = "perception"
#: How old such an explanation may be, s.
COMPLAINT_AGE = 30.0
#: Where a run ends so, a clock that stands still may be why.
OUT_OF_TIME = (Code.NO_FRAMES, Code.NO_OBJECTS, Code.STALE_DATA)
#: How far the objects' frame may be turned against the robot's base for them to be carried from one into the other, degrees.
TURNED = 1.0
#: Between two questions whether a trajectory may be published or the arm may move, where that takes waiting, s.
ASKING_PERIOD = 0.1


@dataclass(frozen=True)
class _Asked:
    """A goal at work: what was asked for, by which strategy, as the pipeline is asked for it, what
    cancels it, and who is told how it goes."""

    goal: RunStrategy.Goal
    strategy: strategies.Strategy
    request: pipeline.Request
    token: Token
    notify: Callable[[pipeline.Progress], None]


class StrategyServer(LifecycleNode):
    """Action ``run_strategy``: perceive, match, plan, verify, publish.

    Subscribes
        objects (SceneObjectArray, latched), joint_states (JointState, where the arm is), /diagnostics (why no objects come);
        where objects come in another frame than the robot's base, /tf and /tf_static, by which they are carried into it
    Calls
        match_contact (service), plan_motion (action), verify_motion (action)
    Publishes
        verified_trajectory (JointTrajectory, latched, variant arm), verified_tool_trajectory (MultiDOFJointTrajectory,
        latched, variant fg), verified_motion (VerifiedMotion, latched, at 1 Hz besides), strategy/markers (MarkerArray, latched),
        /tf_static (the contacts of the candidate tried last, ``<object>/contact``), in_hand (SceneObjectArray, latched: what this
        node has made the hand hold, in the frame of the link between the fingertips; empty after it has let go),
        /diagnostics at 1 Hz.  A trajectory is published, and the arm moves, only where :mod:`magic_server.permission` says so;
        it is taken back, by an empty one, at the start, when the next run begins, when objects or arm are elsewhere, at the end.
    With ``execute``, calls also
        ``trajectory_action`` (control_msgs/FollowJointTrajectory) and ``gripper_action`` (control_msgs/GripperCommand): arm and
        gripper carry out a plan of the variant arm that the verifier has passed, where the arm stands at its start.

    Nothing moves unless the node's lifecycle is active (``ros2 lifecycle set``: configure, activate; the parameter ``autostart``);
    everything else works in each of its states.  Leaving active cancels what is being carried out.  ``~/emergency_stop``
    (std_srvs/Trigger) cancels the run at work, takes back what is published and forbids both until it is activated again.

    One goal runs at a time; a second one is answered BUSY.  Cancel is heeded between
    the stages and inside them: it is forwarded to the running plan or verify goal.
    """

    def __init__(self) -> None:
        super().__init__("strategy_server")
        robot = robot_parameters(self)
        settings = self.settings = parameters.read(self, robot["preset"])
        self.robot = Description(RobotConfig(**robot))
        arm = parameters.read_arm(self, settings.presence, self.robot.fingers[0].name)
        self._loop = parameters.read_loop(self, robot["preset"] or ("" if robot["urdf"] else "panda"))
        if settings.execute and settings.recorded:
            raise MagicError(
                Code.BAD_REQUEST, "parameters execute and recorded", "both true", "one of them: no arm is moved by a recording"
            )
        self.words = OpenWords(settings.words_weights) if settings.words_weights else None
        self._limits = Limits(
            self.robot.base_frame,
            settings.required_rate,
            settings.objects_age,
            settings.object_tolerance,
            arm.state_age,
            arm.start_tolerance,
        )
        self._group = ReentrantCallbackGroup()
        self._lock = threading.Lock()
        self._token: Token | None = None
        self._run_id = ""
        self._goals: dict[bytes, Token] = {}
        self._complaints: dict[str, tuple[float, DiagnosticStatus]] = {}
        self._waiting: list[str] | None = None
        self._closing = False
        self._active = self._stopped = self._moves = False
        self._transforms: TransformListener | None = None
        self._look: tuple[SceneObjectArray, Look] | None = None
        self.scene: SceneObjectArray | None = None
        self.scene_came = -math.inf
        self.scenes: Sequence[SceneObjectArray] = ()
        self.joints = JointStates()
        self.ahead: Ahead[pipeline.Planned] = Ahead()

        # Of a simulation's clock nobody knows how slow it is.
        self.patience = SLOW if self.get_parameter("use_sim_time").value else 1.0
        self.matcher = RemoteService(self, MatchContact, "match_contact", "matcher", self._group)
        self.planner = RemoteAction(self, PlanMotion, "plan_motion", "planner", self._group)
        self.verifier = RemoteAction(self, VerifyMotion, "verify_motion", "verifier", self._group)
        self._arm = Arm(self, settings.trajectory_action, settings.gripper_action, arm, self._group) if settings.execute else None
        self._server_name = self.resolve_service_name("run_strategy")
        self._outlet = Outlet(self, self.robot.base_frame)
        self.publication = Publication(self._outlet, self.world, self._limits)
        self._marker_pub = self.create_publisher(MarkerArray, "strategy/markers", qos.LATCHED)
        self._frames_pub = self.create_publisher(TFMessage, "/tf_static", qos.LATCHED)
        self._held_pub = self.create_publisher(SceneObjectArray, "in_hand", qos.LATCHED)
        self.objects_topic = self._listen()
        self._server = self._serve()
        if settings.autostart:
            self.trigger_configure()
            self.trigger_activate()
        self._diagnostics = Diagnostics(self, self._report, self._group)
        self._diagnostics.publish()

    def _listen(self) -> str:
        """Subscribe to what comes in; the topic of the objects."""
        # What comes on a topic is taken in the order in which it came: two at a time, the older could be the one that stays.
        one, two = (MutuallyExclusiveCallbackGroup() for _ in range(2))
        objects = self.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED, callback_group=one)
        listen_apart(self, JointState, "joint_states", self._on_joints, qos.STATES)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE, callback_group=two)
        return objects.topic_name

    def _serve(self) -> ActionServer:
        """Offer the action and the emergency stop."""
        server = ActionServer(
            self,
            RunStrategy,
            "run_strategy",
            execute_callback=self._execute,
            goal_callback=lambda goal: GoalResponse.REJECT if self._closing else GoalResponse.ACCEPT,
            cancel_callback=self._on_cancel,
            callback_group=self._group,
            result_timeout=RESULT_TIMEOUT,
        )
        self.create_service(Trigger, "~/emergency_stop", self._on_emergency_stop, callback_group=self._group)
        return server

    # ------------------------------------------------------------ whether anything may move

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Say what is missing for the arm to be moved."""
        missing = self._arm.ready() if self._arm is not None else ["an arm: the parameter execute is false"]
        self.get_logger().info(f"configured; missing: {', '.join(missing)}" if missing else "configured: arm and gripper are there")
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From here on the arm may move, where the rule says so."""
        self._active, self._stopped = True, False
        if self._arm is not None:
            self.get_logger().warning("active: from here on a run may move the arm")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From here on nothing moves; what is being carried out is canceled."""
        self._active = False
        if self._moves:
            self._cancel_all()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """As :meth:`on_deactivate`."""
        self._active = False
        if self._moves:
            self._cancel_all()
        return super().on_shutdown(state)

    def _cancel_all(self) -> None:
        for token in list(self._goals.values()):
            token.request_cancel()

    def _on_emergency_stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Stop; nothing moves and nothing is published until the lifecycle is activated again."""
        self._stopped, moving = True, self._moves
        self.get_logger().error("emergency stop")
        self._cancel_all()
        self.publication.take_back("an emergency stop was asked for")
        response.success = True
        was = "the arm was moving: its controller is told to stop" if moving else "nothing was being moved"
        response.message = f"{was}; nothing moves until this node is deactivated and activated again (ros2 lifecycle set)"
        return response

    # ------------------------------------------------------------ what comes in

    def _on_objects(self, message: SceneObjectArray) -> None:
        self.scene, self.scene_came = message, time.monotonic()
        # What stands as it stood is told again every second, with a new stamp: of those the newest is enough.
        told = bool(self.scenes) and same_frames(self.scenes[-1], message)
        self.scenes = (*(self.scenes[:-1] if told else self.scenes[1 - SCENES :]), message)
        if self._frame_of(message) != self.robot.base_frame and self._transforms is None:
            self._transforms = TransformListener(self, self._group)
        self._poke()
        self.publication.look()

    def _on_joints(self, message: JointState) -> None:
        stamp = conversions.time_from_msg(message.header.stamp)
        self.joints.take(message.name, message.position, message.velocity, stamp, time.monotonic(), message.effort)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for found in message.status:
            # Graphs under other namespaces report on the same topic.
            if found.name.partition(": ")[0] in self._perceivers():
                self._complaints[found.name] = (time.monotonic(), found)

    def _perceivers(self) -> set[str]:
        """Labels of the nodes that publish this node's objects, and of perception beside this node."""
        publishers = self.get_publishers_info_by_topic(self.objects_topic)
        nodes = [(p.node_namespace, p.node_name) for p in publishers] + [(self.get_namespace(), PERCEPTION)]
        return {f"{namespace.strip('/')}/{name}".lstrip("/") for namespace, name in nodes}

    def objects_watch(self) -> Callable[[], None]:
        """What raises SERVER_UNAVAILABLE once those who publish the objects now have gone."""
        publishers = presence.Watch(lambda: presence.publishers(self, self.objects_topic))

        def still_there() -> None:
            if publishers.gone():
                raise MagicError(Code.SERVER_UNAVAILABLE, f"perception has gone: what published {self.objects_topic} does not any more")

        return still_there

    @staticmethod
    def _frame_of(scene: SceneObjectArray) -> str:
        return scene.header.frame_id.lstrip("/")

    def in_base(self, scene: SceneObjectArray) -> SceneObjectArray:
        """Objects told in the robot's base frame; raises NO_TRANSFORM, BAD_REQUEST where they name no frame or two have one id."""
        check_ids(scene)
        frame, base = self._frame_of(scene), self.robot.base_frame
        if frame == base:
            return scene
        if not frame:
            raise MagicError(
                Code.BAD_REQUEST, f"frame of {self.objects_topic}", frame, f"{base}, the robot's base frame, or one that TF knows"
            )
        if self._transforms is None:
            raise NotYet(Code.NO_TRANSFORM, f"no transform yet from {frame!r}, the objects' frame, to {base!r}, the robot's base frame")
        with self._transforms.lock:
            try:
                base_from_frame = self._transforms.buffer.lookup(base, frame, conversions.time_from_msg(scene.header.stamp))
            except MagicError as error:
                raise NotYet(
                    error.code, f"objects in {frame!r} cannot be told in {base!r}, the robot's base frame: {error.message}"
                ) from error
        turned = float(np.rad2deg(np.arccos(np.clip((np.trace(base_from_frame[:3, :3]) - 1) / 2, -1.0, 1.0))))
        if not turned <= TURNED:
            # A round object's own axes are those of the frame in which it was seen, and a strategy's directions are told in them.
            raise MagicError(
                Code.BAD_REQUEST,
                f"frame of the objects {frame!r}, in degrees against {base!r}, the robot's base frame",
                round(turned, 2),
                f"at most {TURNED:g}; set perception's parameter frame to {base}",
            )
        return conversions.carried(scene, base, base_from_frame)

    def look(self) -> Look | None:
        """The newest objects, as the rule wants to know them; raises NO_TRANSFORM, BAD_REQUEST, BAD_MESH."""
        scene, came, kept = self.scene, self.scene_came, self._look
        if scene is None:
            return None
        if kept is None or kept[0] is not scene:
            kept = self._look = scene, look_at(self.in_base(scene))
        return replace(kept[1], came=came, stamp=conversions.time_from_msg(scene.header.stamp))

    def tell_held(self, held: Held | None) -> None:
        """Tell everybody what the hand holds from now on."""
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self.robot.config.move_group)
        self._held_pub.publish(SceneObjectArray(header=header, objects=[held.in_hand()] if held is not None else []))

    def hand(self, stamp: float | None = None) -> NDArray[np.float64]:
        """base_from_tcp (4, 4) as the joints were last heard, or as they were at a stamp; raises
        NO_FRAMES, STALE_DATA where that is not known."""
        names, joints = self.robot.names, self.joints.all()
        missing = [name for name in names if name not in joints]
        if missing:
            raise MagicError(Code.NO_FRAMES, f"joint_states: nothing about {', '.join(missing)}")
        if stamp is None:
            positions = {name: joints[name].position for name in names}
        else:
            positions = self.joints.history.at(names, stamp, self._limits.state_age)
        return self.robot.forward(np.array([positions[name] for name in names]))[0]

    def servers(self) -> dict[str, frozenset[bytes]]:
        """Those who serve what a run needs, by what they do; of perception those who publish objects."""
        found = {r.server: r.servers() for r in (self.matcher, self.planner, self.verifier)}
        found[PERCEPTION] = presence.publishers(self, self.objects_topic)
        return {**found, "strategy server": servers_of(self, self._server_name + SEND_GOAL)}

    def world(self) -> World:
        """What there is at this moment."""
        token = self._token
        return World(
            clock=self.get_clock().now().nanoseconds * 1e-9,
            now=time.monotonic(),
            run=self._run_id,
            canceled=token is not None and token.canceled,
            servers=self.servers(),
            scene=self.look(),
            joints=self.joints.all(),
            recorded=self.settings.recorded,
            replaying=presence.playing(self),
            active=self._active,
            stopped=self._stopped,
            simulated=self.patience > 1.0,
        )

    def _poke(self) -> None:
        token = self._token
        if token is not None:
            token.poke()

    def _report(self) -> list[DiagnosticStatus]:
        """Once a second: say what is missing, in the log when it changes and on /diagnostics."""
        waiting = [f"{r.server} ({r.name})" for r in (self.matcher, self.planner, self.verifier) if not r.ready()]
        waiting += self._arm.ready() if self._arm is not None else []
        if self.scene is None:
            there = self.count_publishers(self.objects_topic) > 0
            waiting.append(f"perception's objects ({self.objects_topic})" if there else f"perception (publishes {self.objects_topic})")
        waiting += [f"the end of other servers of {name}" for name, there in self.servers().items() if len(there) > 1]
        if waiting != self._waiting:
            self._waiting = waiting
            self.get_logger().info("waiting for " + ", ".join(waiting) if waiting else "ready: all servers are there and objects have come")
        level = DiagnosticStatus.WARN if waiting else DiagnosticStatus.OK
        message = "waiting for " + ", ".join(waiting) if waiting else "ready"
        self.publication.look()
        self.publication.beat()
        values = {
            "running": str(self._token is not None).lower(),
            "lifecycle": self._lifecycle(),
            "published": self._standing(),
            "joint_states": self._arm_state(),
        }
        return [status(self, "readiness", level, message, values)]

    def _standing(self) -> str:
        """What stands published, and what it rests on."""
        state = self._outlet.state
        if not state.valid:
            return f"nothing: {state.reason}"
        return "; ".join([f"{state.strategy} ({state.variant}) of run {state.run_id}", *state.notes])

    def _lifecycle(self) -> str:
        if self._stopped:
            return "stopped: an emergency stop was asked for"
        return "active" if self._active else "not active: no arm is moved"

    def _arm_state(self) -> str:
        if not any(name in self.joints.all() for name in self.robot.names):
            return "none came: motions of the arm are planned from its home configuration, and none is carried out"
        return "heard"

    def complaint(self) -> DiagnosticStatus | None:
        """Perception's worst recent diagnostic, where it has one; among equals one that says more than that nothing comes."""
        recent = [s for t, s in list(self._complaints.values()) if time.monotonic() - t < COMPLAINT_AGE and s.level != DiagnosticStatus.OK]
        return max(recent, key=lambda s: (s.level, complaint_code(s) not in (None, Code.NO_FRAMES, Code.STALE_DATA)), default=None)

    # ------------------------------------------------------------ the action

    def _on_cancel(self, handle: Any) -> CancelResponse:
        key = bytes(handle.goal_id.uuid)
        token = self._goals.get(key)
        if token is not None and not token.request_cancel():
            return CancelResponse.REJECT  # it has just ended, with its result
        self.publication.take_back("its run was canceled", key.hex())
        return CancelResponse.ACCEPT

    def _execute(self, handle: Any) -> RunStrategy.Result:
        """One goal from acceptance to its result, whatever comes between; no exception leaves."""
        result = RunStrategy.Result()
        key = bytes(handle.goal_id.uuid)
        token = Token()
        self._goals[key] = token
        if handle.is_cancel_requested:  # between acceptance and here
            token.cancel()
        mine = False
        try:
            with self._lock:
                mine = self._token is None
                if mine:
                    self._token = token
            if not mine:
                raise MagicError(Code.BUSY, "another run is at work; cancel it or wait for its result")
            self._run_id = key.hex()
            self._run(handle, token, result)
        except Exception as error:
            result.code, result.message = describe(self, error)
            result.verified = False
        finally:
            if mine:
                self.ahead.clear()
                self._token, self._run_id = None, ""
        if not token.end() and result.code == Code.OK:  # canceled when all was done
            result.code, result.message = int(Code.CANCELED), f"canceled: {result.message}"
        if result.code == Code.CANCELED:
            result.message += "; an emergency stop was asked for" if self._stopped and "emergency" not in result.message else ""
            result.verified = False
            self.publication.take_back("its run was canceled", key.hex())
        if result.code in OUT_OF_TIME and (complaint := clock_complaint(self)):
            result.message += f"; {complaint}"
        self._finish(handle, result)
        self._goals.pop(key, None)
        return result

    def _finish(self, handle: Any, result: RunStrategy.Result) -> None:
        """Bring the goal into the state that belongs to the result's code."""
        try:
            if result.code == Code.CANCELED and not self._closing and self._canceling(handle):
                handle.canceled()
            elif result.code == Code.OK:
                handle.succeed()
            else:
                handle.abort()
        except Exception as error:  # the client or the context may be gone
            self.get_logger().debug(f"goal state: {error}")

    @staticmethod
    def _canceling(handle: Any) -> bool:
        """rclpy enters CANCELING only after the cancel callback has returned, which may be after the run has ended."""
        deadline = time.monotonic() + 1.0
        while handle.status != GoalStatus.STATUS_CANCELING and time.monotonic() < deadline:
            time.sleep(0.002)
        return handle.status == GoalStatus.STATUS_CANCELING

    def _run(self, handle: Any, token: Token, result: RunStrategy.Result) -> None:
        """Plan until physics has passed a motion for the scene as it is, publish it, and have the arm carry it out where that is
        wanted; the result is told on the way."""
        goal = handle.request
        self.publication.take_back("a new run has begun")
        strategy = strategies.known(goal.strategy, self.settings.strategies or None)
        weight = ""
        asked = _Asked(goal, strategy, self._request(goal), token, self._notifier(handle))
        looks = LOOKS if self._arm is not None and asked.request.variant == MotionPlan.ARM else 0
        stages = self._stages(asked, closer=LOOK_TIME if looks else 0.0)
        bounds = Bounds(0, self._loop.replans, time.monotonic() + asked.request.timeout)
        tried: list[pipeline.Outcome] = []
        changes: list[str] = []
        while True:
            left = max(1.0, min(asked.request.timeout, bounds.end - time.monotonic()))
            outcome = self._plan(asked, replace(asked.request, timeout=left), stages, strategy.reflections)
            tried.append(outcome)
            fill(result, pipeline.joined(tried, outcome))
            result.notes = list(changes)
            # First what somebody waits for, then the pictures.
            if outcome.code in BY_SIGHT and looks and self._other_look(stages, token):
                looks -= 1
                changes.append(f"{outcome.code.name}: {outcome.message}")
                asked.notify(pipeline.Progress("perceive", 0, 0, f"{changes[-1]}; perception has looked again", ()))
                # Of motions for many looks one may pass by chance as well as of many for one.
                stages = self._stages(asked, tried=stages.tried)
                continue
            if outcome.code != Code.OK:
                result.message = "; planned again from there: ".join([*changes, outcome.message])
                break
            # What physics has not passed moves the arm only where goal and server both say so; it is published nowhere.
            waived = goal.allow_unverified and self.settings.execute_unverified
            claim = self._claim(outcome, stages, waived)
            try:
                published = outcome.verified and self._publish(claim, token, result, bounds)
            except Changed as change:
                # No arm has moved yet: what has come meanwhile is planned with.
                changes.append(f"{change.code.name}: {change.message}")
                asked.notify(pipeline.Progress("perceive", 0, 0, f"{changes[-1]}; planning again from the scene as it is", ()))
                stages = self._stages(asked)
                continue
            if self._arm is not None and (published or (waived and not outcome.verified)) and outcome.plan.variant == MotionPlan.ARM:
                loop = self._closed_loop(asked, self._arm, Job(outcome, stages, claim), waived)
                self._carry_out(loop, result, tried[:-1])
                outcome, stages, weight = loop.jobs[-1].outcome, loop.jobs[-1].stages, loop.weight
            break
        if result.verified and outcome.plan.variant == MotionPlan.ARM:
            result.notes = [*result.notes, weight or stages.weight(asked.request, outcome.reports[-1].trial, strategy)]
        self._show(stages, outcome)
        if goal.want_pictures:
            result.film = stages.film(outcome) or Image()
        ending = f"{goal.strategy} ({goal.variant}) ended with {Code(result.code).name}: {result.message}"
        if result.code == Code.OK:  # rclpy wants one severity for one line of code
            self.get_logger().info(ending)
        else:
            self.get_logger().warning(ending)

    def _stages(self, asked: _Asked, tried: int = 0, closer: float = 0.0) -> Stages:
        """The stages of a run from the newest scene on; tried and closer: as :class:`Stages` has them."""
        needs_verifier = asked.strategy.simulatable
        return Stages(self, asked.token, self._run_id, needs_verifier, asked.goal.want_pictures, tried=tried, closer=closer)

    def _plan(
        self,
        asked: _Asked,
        request: pipeline.Request,
        stages: Stages,
        reflections: Sequence[str],
        spent: Callable[[Any], int] = lambda candidate: 0,
    ) -> pipeline.Outcome:
        """One run of the pipeline: from objects to a verified motion."""
        return pipeline.Run(
            request,
            reflections,
            asked.strategy.simulatable,
            stages,
            # A tool that is in the hand is held as it is held.
            pipeline.Settings(attempts=1 if isinstance(stages, HeldStages) else self.settings.attempts),
            asked.notify,
            lambda: asked.token.canceled,
            lambda error: describe(self, error),
            spent=spent,
        ).execute()

    def _closed_loop(self, asked: _Asked, arm: Arm, first: Job, waived: bool) -> ClosedLoop:
        """What carries a planned motion out, and whatever is planned after it; waived: also what physics has not passed."""

        def tell(job: Job, text: str) -> None:
            reports = job.outcome.reports
            asked.notify(pipeline.Progress("execute", reports[-1].trial.index, len(job.stages.matches.candidates), text, reports))

        return ClosedLoop(
            self,
            arm,
            self._loop,
            self._limits,
            Goal(asked.strategy, asked.request, asked.token, self._run_id),
            first,
            Calls(
                plan=partial(self._plan, asked),
                claim=lambda outcome, stages: self._claim(outcome, stages, waived),
                allowed=lambda ask: self._when_allowed(ask, asked.token),
                # Nobody else is to begin what is being carried out.
                begun=lambda: self.publication.take_back("the strategy server carries it out itself", first.claim.run),
                tell=tell,
            ),
        )

    def _other_look(self, stages: Stages, token: Token) -> bool:
        """Whether perception makes something else of what stands there than what a run was begun with; waits for it a little."""
        before = look_at(stages.scene).objects

        def other() -> bool:
            try:
                seen = self.look()
            except NotYet:
                return False
            return seen is not None and not (
                seen.objects.keys() == before.keys() and all(np.array_equal(seen.objects[name], hull) for name, hull in before.items())
            )

        self.get_logger().info("waiting for another look")
        return token.wait(other, time.monotonic() + LOOK_TIME, alive=lambda: None)

    def _request(self, goal: RunStrategy.Goal) -> pipeline.Request:
        """What the goal asks for, with the server's own numbers where it names none."""
        if goal.timeout < 0 or not math.isfinite(goal.timeout):
            raise MagicError(Code.BAD_REQUEST, "timeout", goal.timeout, "seconds above 0, or 0 for the server's parameter")
        return pipeline.Request(
            strategy=goal.strategy,
            variant=goal.variant,
            tool_id=goal.tool_id,
            target_id=goal.target_id,
            top_k=goal.top_k or self.settings.top_k,
            seed=goal.seed,
            timeout=goal.timeout or self.settings.timeout,
            allow_unverified=goal.allow_unverified,
            tool_mass=goal.tool_mass,
            target_mass=goal.target_mass,
        )

    def _notifier(self, handle: Any) -> Callable[[pipeline.Progress], None]:
        """What tells a run's progress to the log and to the goal's client."""

        def notify(progress: pipeline.Progress) -> None:
            self.get_logger().info(f"{progress.stage}: {progress.message}")
            feedback = RunStrategy.Feedback(
                stage=progress.stage, candidate=progress.candidate, candidates=progress.candidates, message=progress.message
            )
            feedback.reports = [report_to_msg(r) for r in progress.reports]
            try:
                handle.publish_feedback(feedback)
            except Exception as error:  # a client that has gone must not end the run
                self.get_logger().debug(f"feedback: {error}")

        return notify

    def _claim(self, outcome: pipeline.Outcome, stages: Stages, waived: bool) -> Claim:
        """What the rule is to know of a motion that is to be published or carried out."""
        plan = outcome.plan
        arm = plan.arm_trajectory if plan.variant == MotionPlan.ARM else None
        trajectories = (plan.tool_trajectory, *([arm] if arm is not None else []))
        return Claim(
            run=self._run_id,
            frames=frozenset(t.header.frame_id for t in trajectories),
            scene=look_at(stages.scene),
            verdict=outcome.verdict,
            waived=waived,
            joints=tuple(arm.joint_names) if arm is not None else (),
            start=tuple(arm.points[0].positions) if arm is not None and arm.points else (),
            state_known=outcome.state_known,
            said=tuple(stages.scene.notes),
            motion=Motion(plan, stages.strategy, outcome.tool_id, outcome.target_id, stages.scene.header.stamp),
            mark=mark_of(plan),
        )

    def _when_allowed(self, ask: Callable[[], Any], token: Token) -> Any:
        """What ``ask`` returns, which asks the rule; waits a little where that may help.  Raises what the rule does."""
        deadline = time.monotonic() + self.patience * self.settings.objects
        while True:
            token.check()
            try:
                return ask()
            except NotYet:
                if time.monotonic() >= deadline:
                    raise
            token.wait(lambda: False, min(deadline, time.monotonic() + ASKING_PERIOD))

    def _publish(self, claim: Claim, token: Token, result: RunStrategy.Result, bounds: Bounds) -> bool:
        """Publish a verified motion, if that is allowed, and write into the result how that went; raises :class:`Changed` where the scene
        is another one by then and may be looked at and planned with once more."""
        sentence, metrics = pipeline.split_metrics(result.message)
        try:
            notes = self._when_allowed(lambda: self.publication.offer(claim), token)
            # Who has told the server that all is recorded need not be told in each sentence; what perception says it says of each scene.
            told = {*claim.said, *([RECORDED] if self.settings.recorded else [])}
            sentence = "; ".join([sentence, *(n for n in notes if n not in told)])
            result.notes = [*result.notes, *notes]
        except Exception as error:
            if isinstance(error, Changed):
                try:
                    bounds.elsewhere(error, error.code, time.monotonic())
                except MagicError as over:
                    error = over
                else:
                    raise
            result.code, message = describe(self, error)
            sentence = f"verified ({sentence}), but not published: {message}"
            result.verified = False
        result.message = pipeline.with_metrics(sentence, list(metrics.items()))
        return result.verified

    def _show(self, stages: Stages, outcome: pipeline.Outcome) -> None:
        """Markers of what was tried, and frames of its contacts; where they cannot be drawn, the run has still ended as it has."""
        if not stages.matched:
            return
        plan = outcome.plan or next((r.plan for r in reversed(outcome.reports) if r.plan is not None), None)
        try:
            self._tell_contacts(stages, outcome)
            self._marker_pub.publish(
                markers.run_markers(stages.scene, list(stages.matches.candidates), outcome.target_id, outcome.reports, plan)
            )
        except Exception as error:
            self.get_logger().warning(f"no markers: {describe(self, error)[1]}")

    def _tell_contacts(self, stages: Stages, outcome: pipeline.Outcome) -> None:
        """The contacts of the candidate that was tried last, as frames on /tf_static, where they were when it was planned."""
        if not outcome.reports:
            return
        frames = interop.contact_frames(stages.scene, outcome.reports[-1].trial.candidate, outcome.target_id)
        header = Header(stamp=stages.scene.header.stamp, frame_id=self.robot.base_frame)
        self._frames_pub.publish(
            TFMessage(
                transforms=[
                    TransformStamped(header=header, child_frame_id=name, transform=conversions.transform_to_msg(pose))
                    for name, pose in frames.items()
                ]
            )
        )

    def _carry_out(self, loop: ClosedLoop, result: RunStrategy.Result, before: Sequence[pipeline.Outcome]) -> None:
        """Have arm and gripper do what was planned, and write into the result how that went; ``before``: what was
        planned for scenes that did not last."""
        first = loop.jobs[0].outcome
        kind = "verified" if first.verified else "UNVERIFIED"
        self.get_logger().warning(f"the arm is about to move, if it may: carrying out the {kind} plan")
        notes, error = list(result.notes), None
        try:
            self._moves = True
            seen = loop.execute()
        except Exception as failure:
            error = failure
        finally:
            self._moves = False
        last = loop.jobs[-1].outcome
        fill(result, pipeline.joined([*before, *loop.tried], last))
        result.notes = [*notes, *loop.notes]
        result.executed = loop.executed
        sentence, metrics = pipeline.split_metrics(last.message)
        sentence = "; ".join([sentence, *(n for n in notes if n not in loop.jobs[0].claim.said)])
        if error is None:
            sentence += "; carried out by the arm" + (f", and seen to be met: {seen}" if seen else "")
        else:
            result.code, message = describe(self, error)
            how = "carried out" if loop.executed else "not carried out to the end"
            sentence = f"{'verified' if last.verified else 'planned'} ({sentence}), but {how}: {message}"
            self.get_logger().error(sentence)
        if len(loop.jobs) > 1:
            sentence += f"; motions begun: {len(loop.jobs)}"
        result.message = pipeline.with_metrics(sentence, list(metrics.items()))

    def wind_down(self) -> bool:
        """Take no more goals and cancel the run at work, with all that it has begun; true once its client has the answer.

        An arm must not go on without this node: its goal is canceled too, and this waits until its controller says that it has ended.
        """
        if self._goals and not self._closing:
            self.get_logger().warning("winding down: the run at work is being canceled")
        self._closing = True
        self.publication.close()
        for token in list(self._goals.values()):
            token.cancel()
        return not self._goals

    def destroy_node(self) -> None:
        """Let a run in progress end, so that its thread does not hold up the process."""
        self.wind_down()
        for token in list(self._goals.values()):
            token.cancel(closing=True)
        deadline = time.monotonic() + 1.0  # its goals are being canceled: the clients have to last until then
        while self._goals and time.monotonic() < deadline:
            time.sleep(0.005)
        super().destroy_node()


def report_to_msg(report: pipeline.Report) -> CandidateReport:
    """Report to its message."""
    message = CandidateReport(
        candidate=report.trial.candidate,
        reflection=report.trial.reflection,
        stage=report.stage,
        code=int(report.code),
        message=report.message,
    )
    if report.plan is not None:
        message.grasp = report.plan.tool_from_tcp
    if report.verdict is not None:
        tell_rates(message, report.verdict)
    return message


def tell_rates(message: CandidateReport | RunStrategy.Result, verdict: Verdict) -> None:
    """Write the verifier's rates into a message that has VerifyMotion's fields for them."""
    message.success_rate, message.rate_low, message.rate_high = verdict.success_rate, verdict.rate_low, verdict.rate_high
    message.rollouts, message.failures = verdict.rollouts, list(verdict.failures)


def look_at(scene: SceneObjectArray) -> Look:
    """The objects of a message as the rule wants to know them; ``came`` is not filled in.  What is only
    remembered has not been seen to be there."""
    hulls = {item.id: hull_of(item) for item in scene.objects}
    seen = [item for item in scene.objects if UNSEEN not in item.cut_off]
    return Look(
        {item.id: hulls[item.id] for item in seen},
        scene.header.frame_id.lstrip("/"),
        conversions.time_from_msg(scene.header.stamp),
        -math.inf,
        {item.id: frozenset(item.cut_off) for item in seen if item.cut_off},
        {item.id: hulls[item.id] for item in scene.objects if UNSEEN in item.cut_off},
    )


def fill(result: RunStrategy.Result, outcome: pipeline.Outcome) -> None:
    """Write an outcome into the action's result."""
    result.code = int(outcome.code)
    result.message = outcome.message
    result.verified = outcome.verified
    if outcome.verdict is not None:
        tell_rates(result, outcome.verdict)
    if outcome.plan is not None:
        result.plan = outcome.plan
    result.tool_id, result.target_id = outcome.tool_id, outcome.target_id
    result.candidates = [report_to_msg(r) for r in outcome.reports]
    result.simulations = outcome.simulations
    result.times = StageTimes(**{key: float(outcome.seconds.get(key, 0.0)) for key in (*pipeline.STAGES, "total")})
    result.features = outcome.features
    result.heatmap = outcome.heatmap or Image()


def main() -> None:
    """Entry point of ``ros2 run magic_server strategy_server``."""
    run(StrategyServer, threads=6)


if __name__ == "__main__":
    main()
