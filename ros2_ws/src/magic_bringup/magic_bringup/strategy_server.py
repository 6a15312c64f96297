"""The strategy server: runs a strategy through matcher, planner and verifier, and publishes what physics passed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from magic_bringup import markers, pipeline
from magic_bringup.arm import Arm, ArmSettings
from magic_bringup.remote import RemoteAction, RemoteService, Token
from magic_core import qos
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_core.node import describe, parameter, run
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_interfaces.msg import CandidateReport, MotionPlan, SceneObject, SceneObjectArray, StageTimes
from magic_interfaces.srv import MatchContact

#: Where perception's own explanation is looked for when no objects come.
PERCEPTION = "perception"
#: How old such an explanation may be, s.
COMPLAINT_AGE = 30.0
#: How much later than here the same objects may arrive at the matcher, s.
OBJECTS_LAG = 5.0


class StrategyServer(Node):
    """Action ``run_strategy``: perceive, match, plan, verify, publish.

    Subscribes
        objects (SceneObjectArray, latched), joint_states (JointState, where the arm is), /diagnostics (why no objects come)
    Calls
        match_contact (service), plan_motion (action), verify_motion (action)
    Publishes
        verified_trajectory (JointTrajectory, latched, variant arm), verified_tool_trajectory (MultiDOFJointTrajectory,
        latched, variant fg), strategy/markers (MarkerArray, latched), /diagnostics at 1 Hz.
        A trajectory is published only after the verifier has answered OK for it.
    With ``execute``, calls also
        ``trajectory_action`` (control_msgs/FollowJointTrajectory) and ``gripper_action`` (control_msgs/GripperCommand): arm and
        gripper carry out a plan of the variant arm that the verifier has passed, where the arm stands at its start.

    One goal runs at a time; a second one is answered BUSY.  Cancel is heeded between
    the stages and inside them: it is forwarded to the running plan or verify goal.
    """

    def __init__(self) -> None:
        super().__init__("strategy_server")
        seconds = {"low": 0.05, "high": 3600.0}
        self._root = parameter(self, "strategies", "", "folder of the strategies; empty: the installed ones", read_only=True)
        self._top_k = parameter(self, "top_k", 3, "candidates to try where the goal does not say", low=1, high=50, read_only=True)
        self._attempts = parameter(self, "attempts", 3, "grasps to try for one contact (variant arm)", low=1, high=50, read_only=True)
        self._repetitions = parameter(
            self, "repetitions", 1, "simulations of one motion; above 1: perturbed ones", low=1, high=1000, read_only=True
        )
        self._timeout = parameter(self, "timeout", 120.0, "s for a whole run where the goal does not say", **seconds, read_only=True)
        self._presence = parameter(self, "server_timeout", 5.0, "s to wait for a server that is not there", **seconds, read_only=True)
        self._objects_timeout = parameter(self, "objects_timeout", 10.0, "s to wait for objects", **seconds, read_only=True)
        self._match_timeout = parameter(self, "match_timeout", 60.0, "s for one match", **seconds, read_only=True)
        self._plan_timeout = parameter(self, "plan_timeout", 30.0, "s for one plan", **seconds, read_only=True)
        self._verify_timeout = parameter(self, "verify_timeout", 60.0, "s for one verification", **seconds, read_only=True)
        self._grace = parameter(
            self, "grace", 5.0, "s that an answer may come late before its server counts as dead", **seconds, read_only=True
        )
        execute = parameter(self, "execute", False, "carry verified plans out with arm and gripper", read_only=True)
        mover = parameter(
            self,
            "trajectory_action",
            "panda_arm_controller/follow_joint_trajectory",
            "action of the arm's controller (control_msgs/FollowJointTrajectory)",
            read_only=True,
        )
        gripper = parameter(
            self, "gripper_action", "panda_gripper/gripper_action", "action of the gripper (control_msgs/GripperCommand)", read_only=True
        )

        def number(name: str, text: str, low: float, high: float) -> float:
            return parameter(self, name, getattr(ArmSettings, name), text, low=low, high=high, read_only=True)

        settings = ArmSettings(
            speed=number("speed", "of the execution, as a share of the planned speed", 0.01, 1.0),
            start_tolerance=number("start_tolerance", "rad that a joint may be off where a move begins", 0.0, 0.5),
            state_age=number("state_age", "s that joint_states may be old where a move begins", 0.01, 10.0),
            opening=number("opening", "m between the open fingers", 0.0, 0.5),
            finger_scale=number("finger_scale", "position of the gripper's joint for a metre between the fingers", 0.01, 100.0),
            squeeze=number("squeeze", "m that the fingers are told to close beyond the tool's thickness", 0.0, 0.1),
            effort=number("effort", "of the gripper, N; 0: the driver's own", 0.0, 1000.0),
            grasp_tolerance=number("grasp_tolerance", "m that the opening of the closed fingers may be off the planned one", 0.0, 0.1),
            presence=self._presence,
        )

        group = ReentrantCallbackGroup()
        self._lock = threading.Lock()
        self._token: Token | None = None
        self._goals: dict[bytes, Token] = {}
        self._scene: SceneObjectArray | None = None
        self._joints: JointState | None = None
        self._complaints: dict[str, tuple[float, DiagnosticStatus]] = {}
        self._waiting: list[str] | None = None
        self._closing = False

        self._matcher = RemoteService(self, MatchContact, "match_contact", "matcher", group)
        self._planner = RemoteAction(self, PlanMotion, "plan_motion", "planner", group)
        self._verifier = RemoteAction(self, VerifyMotion, "verify_motion", "verifier", group)
        self._objects_sub = self.create_subscription(SceneObjectArray, "objects", self._on_objects, qos.LATCHED, callback_group=group)
        self._objects_topic = self._objects_sub.topic_name
        self.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR, callback_group=group)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE, callback_group=group)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.RELIABLE)
        self._arm_pub = self.create_publisher(JointTrajectory, "verified_trajectory", qos.LATCHED)
        self._tool_pub = self.create_publisher(MultiDOFJointTrajectory, "verified_tool_trajectory", qos.LATCHED)
        self._arm = Arm(self, mover, gripper, settings, group) if execute else None
        self._marker_pub = self.create_publisher(MarkerArray, "strategy/markers", qos.LATCHED)
        self.create_timer(1.0, self._tick, callback_group=group)
        self._server = ActionServer(
            self,
            RunStrategy,
            "run_strategy",
            execute_callback=self._execute,
            goal_callback=lambda goal: GoalResponse.REJECT if self._closing else GoalResponse.ACCEPT,
            cancel_callback=self._on_cancel,
            callback_group=group,
        )
        self._tick()

    # ------------------------------------------------------------ what comes in

    def _on_objects(self, message: SceneObjectArray) -> None:
        self._scene = message
        self._poke()

    def _on_joints(self, message: JointState) -> None:
        self._joints = message
        if self._arm is not None:
            self._arm.on_state(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if PERCEPTION in status.name:
                self._complaints[status.name] = (time.monotonic(), status)

    def _poke(self) -> None:
        token = self._token
        if token is not None:
            token.poke()

    def _tick(self) -> None:
        """Once a second: say what is missing, in the log when it changes and on /diagnostics."""
        waiting = [f"{r.server} ({r.name})" for r in (self._matcher, self._planner, self._verifier) if not r.ready()]
        waiting += self._arm.ready() if self._arm is not None else []
        if self._scene is None:
            waiting.append(f"perception ({self._objects_topic})")
        if waiting != self._waiting:
            self._waiting = waiting
            self.get_logger().info("waiting for " + ", ".join(waiting) if waiting else "ready: all servers are there and objects have come")
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if waiting else DiagnosticStatus.OK,
            name=f"{self.get_name()}: readiness",
            message="waiting for " + ", ".join(waiting) if waiting else "ready",
            hardware_id="",
            values=[KeyValue(key="running", value=str(self._token is not None).lower())],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def complaint(self) -> DiagnosticStatus | None:
        """Perception's worst recent diagnostic, where it has one; among equals one that says more than that nothing comes."""
        recent = [s for t, s in list(self._complaints.values()) if time.monotonic() - t < COMPLAINT_AGE and s.level != DiagnosticStatus.OK]
        return max(recent, key=lambda s: (s.level, complaint_code(s) not in (None, Code.NO_FRAMES, Code.STALE_DATA)), default=None)

    # ------------------------------------------------------------ the action

    def _on_cancel(self, handle: Any) -> CancelResponse:
        token = self._goals.get(bytes(handle.goal_id.uuid))
        if token is not None:
            token.cancel()
        return CancelResponse.ACCEPT

    def _execute(self, handle: Any) -> RunStrategy.Result:
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
            self._run(handle, token, result)
        except Exception as error:
            result.code, result.message = describe(self, error)
        finally:
            if mine:
                self._token = None
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
        goal = handle.request
        strategy = strategies.find(goal.strategy, self._root or None)
        if goal.timeout < 0 or not math.isfinite(goal.timeout):
            raise MagicError(Code.BAD_REQUEST, "timeout", goal.timeout, "seconds above 0, or 0 for the server's parameter")
        request = pipeline.Request(
            strategy=goal.strategy,
            variant=goal.variant,
            tool_id=goal.tool_id,
            target_id=goal.target_id,
            top_k=goal.top_k or self._top_k,
            seed=goal.seed,
            timeout=goal.timeout or self._timeout,
            allow_unverified=goal.allow_unverified,
        )
        stages = _Stages(self, token, needs_verifier=strategy.simulatable, heatmap=goal.want_pictures)

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

        outcome = pipeline.Run(
            request,
            strategy.reflections,
            strategy.simulatable,
            stages,
            pipeline.Settings(attempts=self._attempts),
            notify,
            lambda: token.canceled,
            lambda error: describe(self, error),
        ).execute()
        fill(result, outcome)
        # First what somebody waits for, then the pictures.
        if outcome.verified and outcome.code == Code.OK and not token.canceled:
            self._publish(outcome.plan)
            if self._arm is not None and outcome.plan.variant == MotionPlan.ARM:
                reports = tuple(outcome.reports)
                index = reports[-1].trial.index
                count = len(stages.matches.candidates)
                self._carry_out(
                    self._arm, outcome.plan, token, result, lambda text: notify(pipeline.Progress("execute", index, count, text, reports))
                )
        if stages.scene is not None and stages.matches is not None:
            plan = outcome.plan or next((r.plan for r in reversed(outcome.reports) if r.plan is not None), None)
            self._marker_pub.publish(
                markers.run_markers(stages.scene, list(stages.matches.candidates), outcome.target_id, outcome.reports, plan)
            )
        if goal.want_pictures:
            result.film = stages.film(outcome.code) or Image()
        ending = f"{goal.strategy} ({goal.variant}) ended with {Code(result.code).name}: {result.message}"
        if result.code == Code.OK:  # rclpy wants one severity for one line of code
            self.get_logger().info(ending)
        else:
            self.get_logger().warning(ending)

    def _publish(self, plan: MotionPlan) -> None:
        if plan.variant == MotionPlan.ARM:
            self._arm_pub.publish(plan.arm_trajectory)
        else:
            self._tool_pub.publish(plan.tool_trajectory)

    def _carry_out(self, arm: Arm, plan: MotionPlan, token: Token, result: RunStrategy.Result, tell: Callable[[str], None]) -> None:
        """Have arm and gripper do what physics has passed, and write into the result how that went."""
        sentence, metrics = pipeline.split_metrics(result.message)
        try:
            self.get_logger().warning("the arm is about to move: carrying out the verified plan")
            arm.execute(plan, token, tell)
            result.executed = True
            sentence += "; carried out by the arm"
        except Exception as error:
            result.code, message = describe(self, error)
            sentence = f"verified ({sentence}), but not carried out to the end: {message}"
            self.get_logger().error(sentence)
        result.message = pipeline.with_metrics(sentence, list(metrics.items()))

    def wind_down(self) -> bool:
        """Take no more goals and cancel the run at work, with all that it has begun; true once its client has the answer.

        An arm must not go on without this node: its goal is canceled too, and this waits until its controller says that it has ended.
        """
        if self._goals and not self._closing:
            self.get_logger().warning("winding down: the run at work is being canceled")
        self._closing = True
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


class _Stages:
    """The stages of :mod:`magic_bringup.pipeline`, done by the other nodes; messages pass through as they came."""

    def __init__(self, node: StrategyServer, token: Token, needs_verifier: bool, heatmap: bool) -> None:
        self._node = node
        self._heatmap = heatmap
        self._token = token
        self._needs_verifier = needs_verifier
        self.scene: SceneObjectArray | None = None
        self.matches: pipeline.Matches | None = None
        self._last_goal: VerifyMotion.Goal | None = None
        self._last_code = 0

    def perceive(self, request: pipeline.Request, timeout: float) -> None:
        """Take the objects there are, or wait for them; see that every server is there."""
        node = self._node
        # First the servers: a run that cannot be verified is not begun.
        deadline = time.monotonic() + min(timeout, node._presence)
        for remote in (node._matcher, node._planner, *([node._verifier] if self._needs_verifier else [])):
            remote.require(max(0.0, deadline - time.monotonic()), self._token)
        wait = min(timeout, node._objects_timeout)

        def enough() -> bool:
            scene = node._scene
            if scene is None:
                return False
            # A wrong id is answered at once; too few objects may still become enough: a tool that was seen, and a target.
            return bool(self._unknown(scene, request)) or (
                len(scene.objects) >= 2 and (bool(request.tool_id) or any(o.source == SceneObject.CAMERA for o in scene.objects))
            )

        came = self._token.wait(enough, time.monotonic() + wait)
        scene = node._scene
        if not came:
            raise self._no_objects(scene, wait)
        self.scene = scene
        unknown = self._unknown(scene, request)
        if unknown:
            raise MagicError(Code.UNKNOWN_OBJECT, unknown[0], unknown[1], [o.id for o in scene.objects])

    @staticmethod
    def _unknown(scene: SceneObjectArray, request: pipeline.Request) -> tuple[str, str] | None:
        ids = [o.id for o in scene.objects]
        for what, value in (("tool_id", request.tool_id), ("target_id", request.target_id)):
            if value and ids and value not in ids:
                return what, value
        return None

    def _no_objects(self, scene: SceneObjectArray | None, wait: float) -> MagicError:
        """Why there is nothing to work on: in perception's own words where it has spoken."""
        node = self._node
        topic = node._objects_topic
        if scene is not None:
            ids = [o.id for o in scene.objects]
            code, what = (
                Code.NO_OBJECTS,
                f"{topic} holds {len(ids)} objects {ids} (allowed: a tool that a camera sees, and a target), waited {wait:.1f} s",
            )
        else:
            publishers = node.count_publishers(topic)
            code = Code.NO_OBJECTS if publishers else Code.NO_FRAMES
            what = f"nothing came on {topic} within {wait:.1f} s; it has {publishers} publishers"
        complaint = node.complaint()
        if complaint is not None:
            code = complaint_code(complaint) or code
            what = f"{complaint.message} ({what})"
        return MagicError(code, what)

    def match(self, request: pipeline.Request, timeout: float) -> pipeline.Matches:
        """Ask the matcher."""
        node = self._node
        message = MatchContact.Request(
            strategy=request.strategy,
            tool_ids=[request.tool_id] if request.tool_id else [],
            target_id=request.target_id,
            top_k=request.top_k,
            want_heatmap=self._heatmap,
        )
        deadline = time.monotonic() + min(timeout, node._match_timeout)
        patience = time.monotonic() + OBJECTS_LAG
        while True:
            answer = node._matcher.call(message, max(0.0, deadline - time.monotonic()), self._token, node._presence)
            # The ids were found in the objects that came here; the matcher may just be about to read the same message.
            if answer.code not in (Code.UNKNOWN_OBJECT, Code.NO_OBJECTS) or time.monotonic() > min(patience, deadline):
                break
            self._token.wait(lambda: False, time.monotonic() + 0.05)
        if answer.code != Code.OK or not answer.candidates:
            raise MagicError(code_of(answer.code or Code.NO_MATCH), answer.message or "no contact was found")
        heatmap = answer.heatmap if len(answer.heatmap.data) else None
        target_id = answer.target_id or request.target_id
        scores = ", ".join(f"{c.tool_id} {c.score:.3f}" for c in answer.candidates)
        message = f"{len(answer.candidates)} candidates for {target_id} ({scores}), {answer.features} features, {answer.seconds:.2f} s"
        self.matches = pipeline.Matches(answer.candidates, target_id, answer.features, heatmap, message)
        # The matcher keeps its own copy of the objects: what it names must be in ours.
        for what, value in (("target", target_id), *(("tool", c.tool_id) for c in answer.candidates)):
            if value not in [o.id for o in self.scene.objects]:
                raise MagicError(Code.UNKNOWN_OBJECT, f"{what} that the matcher chose", value, [o.id for o in self.scene.objects])
        return self.matches

    def _find(self, object_id: str) -> SceneObject:
        return next(o for o in self.scene.objects if o.id == object_id)

    def plan(self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, timeout: float) -> pipeline.Planned:
        """Ask the planner for one trial."""
        node = self._node
        timeout = min(timeout, node._plan_timeout)
        goal = PlanMotion.Goal(
            strategy=request.strategy,
            variant=request.variant,
            tool=self._find(trial.candidate.tool_id),
            target=self._find(matches.target_id),
            obstacles=self._obstacles(trial, matches),
            table=self.scene.table,
            candidate=trial.candidate,
            reflection=trial.reflection,
            attempt=trial.attempt,
            seed=request.seed,
            timeout=timeout,
        )
        if node._joints is not None:
            goal.start = node._joints
        result = node._planner.call(goal, timeout, self._token, node._presence, node._grace)
        return pipeline.Planned(code_of(result.code), result.message, result.plan)

    def verify(
        self, request: pipeline.Request, matches: pipeline.Matches, trial: pipeline.Trial, plan: MotionPlan, timeout: float
    ) -> pipeline.Verdict:
        """Ask the verifier for one planned motion."""
        node = self._node
        timeout = min(timeout, node._verify_timeout)
        goal = VerifyMotion.Goal(
            strategy=request.strategy,
            tool=self._find(trial.candidate.tool_id),
            target=self._find(matches.target_id),
            obstacles=self._obstacles(trial, matches),
            table=self.scene.table,
            candidate=trial.candidate,
            plan=plan,
            repetitions=node._repetitions,
            seed=request.seed,
            timeout=timeout,
        )
        result = node._verifier.call(goal, timeout, self._token, node._presence, node._grace)
        self._last_goal, self._last_code = goal, result.code
        code = code_of(result.code)
        if code == Code.OK and not result.success:
            code = Code.GOAL_NOT_REACHED
        message = pipeline.with_metrics(result.message, list(zip(result.metric_names, result.metric_values)))
        return pipeline.Verdict(code, message, max(1, node._repetitions))

    def film(self, outcome_code: Code) -> Image | None:
        """The film strip of the last simulation: the verifier draws it from what it recorded when it gets the same goal again.

        Drawing may cost more than simulating, and only one of a run's simulations is looked at.
        """
        node, goal = self._node, self._last_goal
        if goal is None or outcome_code in pipeline.FATAL:
            return None
        goal.want_film = True
        try:
            result = node._verifier.call(goal, node._verify_timeout, self._token, node._presence, node._grace)
        except MagicError as error:
            node.get_logger().warning(f"no film: {error.message}")
            return None
        if result.code != self._last_code:  # another client came in between, and the repetition took too long, for one
            node.get_logger().warning(
                f"no film: asked for it, the verifier answered {result.code} instead of {self._last_code}: {result.message}"
            )
            return None
        return result.film if len(result.film.data) else None

    def _obstacles(self, trial: pipeline.Trial, matches: pipeline.Matches) -> list[SceneObject]:
        return [o for o in self.scene.objects if o.id not in (trial.candidate.tool_id, matches.target_id)]


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
    return message


def fill(result: RunStrategy.Result, outcome: pipeline.Outcome) -> None:
    """Write an outcome into the action's result."""
    result.code = int(outcome.code)
    result.message = outcome.message
    result.verified = outcome.verified
    if outcome.plan is not None:
        result.plan = outcome.plan
    result.tool_id, result.target_id = outcome.tool_id, outcome.target_id
    result.candidates = [report_to_msg(r) for r in outcome.reports]
    result.simulations = outcome.simulations
    result.times = StageTimes(**{key: float(outcome.seconds.get(key, 0.0)) for key in (*pipeline.STAGES, "total")})
    result.features = outcome.features
    result.heatmap = outcome.heatmap or Image()


def main() -> None:
    """Entry point of ``ros2 run magic_bringup strategy_server``."""
    run(StrategyServer, threads=6)


if __name__ == "__main__":
    main()
