"""The strategy server: runs a strategy through matcher, planner and verifier, and publishes what physics passed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import Image, JointState
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from magic_bringup import markers, pipeline, scene_change
from magic_bringup import settings as parameters
from magic_bringup.arm import Arm
from magic_bringup.joints import JointStates
from magic_bringup.remote import RemoteAction, RemoteService, Token, check_alone
from magic_bringup.stages import Stages, complaint_code
from magic_core import conversions, presence, qos
from magic_core import strategy as strategies
from magic_core.diagnostics import Diagnostics, clock_complaint, status
from magic_core.errors import Code, MagicError
from magic_core.node import RESULT_TIMEOUT, describe, run
from magic_interfaces.action import PlanMotion, RunStrategy, VerifyMotion
from magic_interfaces.msg import CandidateReport, MotionPlan, SceneObjectArray, StageTimes
from magic_interfaces.srv import MatchContact

#: Whose explanation is looked for when no objects come, besides that of those who publish objects: the node of this name beside this one.
PERCEPTION = "perception"
#: How old such an explanation may be, s.
COMPLAINT_AGE = 30.0
#: Where a run ends so, a clock that stands still may be why.
OUT_OF_TIME = (Code.NO_FRAMES, Code.NO_OBJECTS, Code.STALE_DATA)


class StrategyServer(Node):
    """Action ``run_strategy``: perceive, match, plan, verify, publish.

    Subscribes
        objects (SceneObjectArray, latched), joint_states (JointState, where the arm is), /diagnostics (why no objects come)
    Calls
        match_contact (service), plan_motion (action), verify_motion (action)
    Publishes
        verified_trajectory (JointTrajectory, latched, variant arm), verified_tool_trajectory (MultiDOFJointTrajectory,
        latched, variant fg), strategy/markers (MarkerArray, latched), /diagnostics at 1 Hz.
        A trajectory is published only after the verifier has answered OK for it; the next run begins by taking it back, by
        an empty one.
    With ``execute``, calls also
        ``trajectory_action`` (control_msgs/FollowJointTrajectory) and ``gripper_action`` (control_msgs/GripperCommand): arm and
        gripper carry out a plan of the variant arm that the verifier has passed, where the arm stands at its start.

    One goal runs at a time; a second one is answered BUSY.  Cancel is heeded between
    the stages and inside them: it is forwarded to the running plan or verify goal.
    """

    def __init__(self) -> None:
        super().__init__("strategy_server")
        settings = self.settings = parameters.read(self)
        arm = parameters.read_arm(self, settings.presence)
        group = ReentrantCallbackGroup()
        self._lock = threading.Lock()
        self._token: Token | None = None
        self._goals: dict[bytes, Token] = {}
        self._complaints: dict[str, tuple[float, DiagnosticStatus]] = {}
        self._waiting: list[str] | None = None
        self._closing = False
        self._published: dict[Publisher, JointTrajectory | MultiDOFJointTrajectory] = {}
        self.scene: SceneObjectArray | None = None
        self.scene_came = -math.inf
        self.joints = JointStates()

        self.matcher = RemoteService(self, MatchContact, "match_contact", "matcher", group)
        self.planner = RemoteAction(self, PlanMotion, "plan_motion", "planner", group)
        self.verifier = RemoteAction(self, VerifyMotion, "verify_motion", "verifier", group)
        self._arm = Arm(self, settings.trajectory_action, settings.gripper_action, arm, self.joints, group) if settings.execute else None
        self.objects_topic = self.create_subscription(
            SceneObjectArray, "objects", self._on_objects, qos.LATCHED, callback_group=group
        ).topic_name
        self.create_subscription(JointState, "joint_states", self._on_joints, qos.SENSOR, callback_group=group)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.RELIABLE, callback_group=group)
        self._arm_pub = self.create_publisher(JointTrajectory, "verified_trajectory", qos.LATCHED)
        self._tool_pub = self.create_publisher(MultiDOFJointTrajectory, "verified_tool_trajectory", qos.LATCHED)
        self._marker_pub = self.create_publisher(MarkerArray, "strategy/markers", qos.LATCHED)
        self._server = ActionServer(
            self,
            RunStrategy,
            "run_strategy",
            execute_callback=self._execute,
            goal_callback=lambda goal: GoalResponse.REJECT if self._closing else GoalResponse.ACCEPT,
            cancel_callback=self._on_cancel,
            callback_group=group,
            result_timeout=RESULT_TIMEOUT,
        )
        self._server_name = self.resolve_service_name("run_strategy")
        self._diagnostics = Diagnostics(self, self._report, group)
        self._diagnostics.publish()

    # ------------------------------------------------------------ what comes in

    def _on_objects(self, message: SceneObjectArray) -> None:
        self.scene, self.scene_came = message, time.monotonic()
        self._poke()

    def _on_joints(self, message: JointState) -> None:
        stamp = conversions.time_from_msg(message.header.stamp)
        self.joints.take(message.name, message.position, message.velocity, stamp, time.monotonic())

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

    def _poke(self) -> None:
        token = self._token
        if token is not None:
            token.poke()

    def _report(self) -> list[DiagnosticStatus]:
        """Once a second: say what is missing, in the log when it changes and on /diagnostics."""
        waiting = [f"{r.server} ({r.name})" for r in (self.matcher, self.planner, self.verifier) if not r.ready()]
        waiting += self._arm.ready() if self._arm is not None else []
        if self.scene is None:
            waiting.append(f"perception ({self.objects_topic})")
        if self.count_services(f"{self._server_name}/_action/send_goal") > 1:
            waiting.append(f"the end of other servers of {self._server_name}")
        if waiting != self._waiting:
            self._waiting = waiting
            self.get_logger().info("waiting for " + ", ".join(waiting) if waiting else "ready: all servers are there and objects have come")
        level = DiagnosticStatus.WARN if waiting else DiagnosticStatus.OK
        message = "waiting for " + ", ".join(waiting) if waiting else "ready"
        return [status(self, "readiness", level, message, {"running": str(self._token is not None).lower()})]

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
        goal = handle.request
        self._withdraw()
        strategy = strategies.find(goal.strategy, self.settings.strategies or None)
        request = self._request(goal)
        stages = Stages(self, token, needs_verifier=strategy.simulatable, heatmap=goal.want_pictures)
        notify = self._notifier(handle)
        outcome = pipeline.Run(
            request,
            strategy.reflections,
            strategy.simulatable,
            stages,
            pipeline.Settings(attempts=self.settings.attempts),
            notify,
            lambda: token.canceled,
            lambda error: describe(self, error),
        ).execute()
        fill(result, outcome)
        # First what somebody waits for, then the pictures.
        if outcome.code == Code.OK:
            token.check()
            if outcome.verified:
                self._publish(outcome.plan)
            # What physics has not passed moves the arm only where goal and server both say so; it is published nowhere.
            wanted = outcome.verified or (goal.allow_unverified and self.settings.execute_unverified)
            if self._arm is not None and wanted and outcome.plan.variant == MotionPlan.ARM:
                self._carry_out(self._arm, outcome, stages, token, result, notify)
        self._show(stages, outcome)
        if goal.want_pictures:
            result.film = stages.film(outcome.code) or Image()
        ending = f"{goal.strategy} ({goal.variant}) ended with {Code(result.code).name}: {result.message}"
        if result.code == Code.OK:  # rclpy wants one severity for one line of code
            self.get_logger().info(ending)
        else:
            self.get_logger().warning(ending)

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

    def _publish(self, plan: MotionPlan) -> None:
        publisher, trajectory = (
            (self._arm_pub, plan.arm_trajectory) if plan.variant == MotionPlan.ARM else (self._tool_pub, plan.tool_trajectory)
        )
        self._published[publisher] = trajectory
        publisher.publish(trajectory)

    def _withdraw(self) -> None:
        """Take the last run's trajectories back, which late subscribers would still get: an empty one says that none is valid."""
        for publisher, trajectory in self._published.items():
            publisher.publish(type(trajectory)(header=trajectory.header))
        self._published.clear()

    def _show(self, stages: Stages, outcome: pipeline.Outcome) -> None:
        """Markers of what was tried; where they cannot be drawn, the run has still ended as it has."""
        if stages.scene is None or stages.matches is None:
            return
        plan = outcome.plan or next((r.plan for r in reversed(outcome.reports) if r.plan is not None), None)
        try:
            self._marker_pub.publish(
                markers.run_markers(stages.scene, list(stages.matches.candidates), outcome.target_id, outcome.reports, plan)
            )
        except Exception as error:
            self.get_logger().warning(f"no markers: {describe(self, error)[1]}")

    def _carry_out(
        self,
        arm: Arm,
        outcome: pipeline.Outcome,
        stages: Stages,
        token: Token,
        result: RunStrategy.Result,
        notify: Callable[[pipeline.Progress], None],
    ) -> None:
        """Have arm and gripper do what was planned, and write into the result how that went."""

        def tell(text: str) -> None:
            index = outcome.reports[-1].trial.index
            notify(pipeline.Progress("execute", index, len(stages.matches.candidates), text, outcome.reports))

        sentence, metrics = pipeline.split_metrics(result.message)
        try:
            check_alone(self, self._server_name)
            self._check_scene(stages.scene, token)
            kind = "verified" if outcome.verified else "UNVERIFIED"
            self.get_logger().warning(f"the arm is about to move: carrying out the {kind} plan")
            arm.execute(outcome.plan, token, tell)
            result.executed = True
            sentence += "; carried out by the arm"
        except Exception as error:
            result.code, message = describe(self, error)
            sentence = f"{'verified' if outcome.verified else 'planned'} ({sentence}), but not carried out to the end: {message}"
            self.get_logger().error(sentence)
        result.message = pipeline.with_metrics(sentence, list(metrics.items()))

    def _check_scene(self, planned: SceneObjectArray, token: Token) -> None:
        """The objects must have been seen just now, and where the plan believes them.  Waits a little for perception."""
        limit = self.settings.objects_age
        if not token.wait(lambda: self._scene_age() <= limit, time.monotonic() + self.settings.objects, alive=self.objects_watch()):
            raise MagicError(
                Code.STALE_DATA, "age of the objects in s", round(self._scene_age(), 1), f"at most {limit:g}, by stamp and by arrival"
            )
        before, now = (conversions.scene_from_msg(s).objects for s in (planned, self.scene))
        scene_change.check(before, now, self.settings.object_tolerance)

    def _scene_age(self) -> float:
        """Seconds since the newest objects were seen, by their stamp or by their arrival, whichever is worse."""
        by_stamp = self.get_clock().now().nanoseconds * 1e-9 - conversions.time_from_msg(self.scene.header.stamp)
        return max(abs(by_stamp), time.monotonic() - self.scene_came)

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
