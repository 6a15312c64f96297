"""The ``verifier`` node: the action ``verify_motion``."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image

from magic_core import conversions as convert
from magic_core import masses
from magic_core import strategy as strategies
from magic_core.content import digest
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, check_solid
from magic_core.node import OneGoalServer, describe, robot_parameters, run
from magic_core.robot import Description, RobotConfig
from magic_interfaces.action import VerifyMotion
from magic_verifier import motion_check, node_parameters
from magic_verifier.articulation import Articulation
from magic_verifier.node_parameters import MAX_REPETITIONS
from magic_verifier.simulation import DYNAMIC, World, usable_pieces
from magic_verifier.verification import Proposal, Verdict, verify_proposal
from magic_verifier.workers import simulating

NO_MESH = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
#: Feedback is for people: each phase once, and else no more often than so, s.  A rollout takes a fraction of the time that the motion
#: itself takes.
FEEDBACK_PERIOD = 0.1
#: Goals that end so were not judged.
UNJUDGED = (Code.CANCELED, Code.INTERNAL, Code.BAD_REQUEST, Code.UNKNOWN_STRATEGY, Code.BAD_STRATEGY)


def mark_of(goal: VerifyMotion.Goal, proposal: Proposal) -> bytes:
    """The same for goals whose verdicts are the same."""
    # What obstacles look like is in the film alone.
    simulated = tuple(replace(obstacle, mesh=NO_MESH) for obstacle in proposal.obstacles)
    plan = proposal.plan, goal.repetitions, goal.seed, goal.tried, goal.tool_mass, goal.target_mass
    # The strategy as it was read: its files may have changed since.
    return digest((proposal.strategy, proposal.tool, proposal.target, simulated, proposal.table, *plan))


class VerifierNode(Node):
    """Runs planned motions in physics, one at a time; a goal during another one is answered BUSY at once.

    Action server: ``verify_motion`` (magic_interfaces/action/VerifyMotion).  The goal
    carries everything.  The last verdict is kept: the same goal again, with ``want_film``
    this time, is answered from what was recorded, as the same goal has the same verdict.

    Parameters: see ``config/verifier.param.yaml``.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("verifier", **kwargs)
        self._given = node_parameters.read(self)
        self._robot = Description(RobotConfig(**robot_parameters(self)))
        self._last: tuple[bytes, Verdict] | None = None
        self._server = OneGoalServer(
            self,
            VerifyMotion,
            "verify_motion",
            self._answer,
            "a simulation is running; send the goal again when it has ended",
            # A verdict is an answer, whatever it says; only what could not be judged aborts.
            lambda code: code in UNJUDGED,
        )
        self._pool = simulating(self._given.workers - 1)
        self._warm_up()
        self.get_logger().info("ready: waiting for goals of verify_motion")

    def destroy_node(self) -> None:
        """Take the action server down with the node."""
        self._server.destroy()
        self._pool.close()
        super().destroy_node()

    def _warm_up(self) -> None:
        """Load SAPIEN and the arm and step small worlds, so that the first goal does not pay for it; raises BAD_REQUEST."""
        cube = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
        world = World(self._given.settings["fg"])
        world.add_table(np.array([0, 0, 1.0, 0]), 0.5)
        world.add("cube", usable_pieces("cube", (Mesh(cube, np.zeros((0, 3))),)), np.eye(4), DYNAMIC, 500.0, 0.5)
        world.step()
        started = time.monotonic()
        world = World(self._given.settings["arm"])
        Articulation(world, self._robot, self._given.arm).place(np.array(self._robot.config.home))
        world.step()
        self.get_logger().info(f"arm {self._robot.urdf.stem} ready after {time.monotonic() - started:.2f} s")

    def _answer(self, handle: Any, result: VerifyMotion.Result) -> None:
        """Write the verdict on a goal into its result."""
        verdict, film = self._verify(handle, time.monotonic())
        result.code, result.message = int(verdict.code), verdict.message
        result.success = verdict.success
        result.success_rate = float(verdict.success_rate)
        result.rate_low, result.rate_high = float(verdict.rate_low), float(verdict.rate_high)
        result.rollouts = len(verdict.runs)
        result.failures = list(verdict.failures)
        result.metric_names = list(verdict.metrics)
        result.metric_values = [float(v) for v in verdict.metrics.values()]
        result.simulated = float(verdict.simulated)
        result.film = film

    def _verify(self, handle: Any, started: float) -> tuple[Verdict, Image]:
        """The verdict on a goal that came at ``started`` (s, monotonic), and its film, empty where none was asked for."""
        goal, given = handle.request, self._given
        proposal = self._read(goal)
        mark = mark_of(goal, proposal)
        if goal.want_film and self._last is not None and mark == self._last[0]:
            return self._with_film(self._last[1], proposal)
        verdict = verify_proposal(
            proposal,
            repetitions=int(goal.repetitions) or given.rollouts,
            deadline=started + (goal.timeout or given.timeout),
            cancel=lambda: handle.is_cancel_requested,
            progress=_Feedback(handle, started),
            pool=self._pool.executor,
            workers=self._pool.count,
            tried=int(goal.tried),
        )
        self.get_logger().info(
            f"{goal.strategy} {proposal.plan.variant} {goal.tool.id}: {verdict.code.name}: {verdict.message} ({verdict.seconds:.2f} s)"
        )
        if verdict.code not in (Code.CANCELED, Code.SIMULATION_TIMEOUT):  # these depend on more than the goal
            self._last = mark, verdict
        return self._with_film(verdict, proposal) if goal.want_film else (verdict, Image())

    def _read(self, goal: VerifyMotion.Goal) -> Proposal:
        """What a goal proposes, checked, under the node's physics and limits.  Raises BAD_REQUEST, and what the conversions raise."""
        if goal.repetitions > MAX_REPETITIONS:
            raise MagicError(Code.BAD_REQUEST, "repetitions", goal.repetitions, f"0 to {MAX_REPETITIONS}")
        if not (np.isfinite(goal.timeout) and goal.timeout >= 0):
            raise MagicError(Code.BAD_REQUEST, "timeout", goal.timeout, "0 or a number of seconds above it")
        strategy = strategies.known(goal.strategy, self._given.strategies or None).turned(float(goal.candidate.turn))
        trajectories = goal.plan.tool_trajectory, goal.plan.arm_trajectory
        convert.check_frames(self._robot.base_frame, (goal.tool, goal.target, *goal.obstacles), *trajectories)
        tool, target = (convert.object_from_msg(item, pictures=False) for item in (goal.tool, goal.target))
        for item, what in ((tool, "tool"), (target, "target")):
            check_solid(item.mesh, f"the {what} {item.id}")
        strategy = masses.told(strategy, tool, target, goal.tool_mass, goal.target_mass)
        obstacles = tuple(convert.object_from_msg(o, pictures=False) for o in goal.obstacles)
        ids = [tool.id, target.id, *(o.id for o in obstacles)]
        if len(set(ids)) != len(ids):
            raise MagicError(Code.BAD_REQUEST, "object ids", ", ".join(ids), "ids that differ")
        table = convert.plane_from_msg(goal.table)
        plan = convert.plan_from_msg(goal.plan)
        motion_check.check_trajectory(goal.plan.tool_trajectory, tool.id, plan.tool_motion)
        given = self._given
        return Proposal(
            strategy,
            tool,
            target,
            obstacles,
            table,
            plan,
            seed=int(goal.seed),
            settings=given.settings[plan.variant],
            spreads=given.spreads,
            limits=given.limits,
            arm_options=given.arm,
            robot=self._robot,
        )

    def _with_film(self, verdict: Verdict, proposal: Proposal) -> tuple[Verdict, Image]:
        if verdict.recording is None or verdict.code == Code.CANCELED:
            return verdict, Image()
        try:
            return verdict, self._film(verdict, proposal)
        except Exception as error:  # a picture that cannot be drawn changes no verdict
            _, message = describe(self, error)
            return replace(verdict, message=f"{verdict.message}; no film: {message}"), Image()

    def _film(self, verdict: Verdict, proposal: Proposal) -> Image:
        from magic_verifier.film import film_strip

        caption = f"{verdict.code.name}: {verdict.message}"
        scene = proposal.tool, proposal.target, proposal.obstacles, proposal.table
        strip = film_strip(verdict.recording, *scene, frames=self._given.film_frames, caption=caption, robot=self._robot)
        return convert.image_to_msg(strip, "rgb8")


class _Feedback:
    """Tells a goal's client how far its simulation is: each phase once, and else no more often than every :data:`FEEDBACK_PERIOD`."""

    def __init__(self, handle: Any, started: float) -> None:
        self._handle, self._last = handle, started
        self._told: set[str] = set()

    def __call__(self, phase: str, simulated: float) -> None:
        now = time.monotonic()
        if phase in self._told and now - self._last < FEEDBACK_PERIOD:
            return
        self._told.add(phase)
        self._last = now
        self._handle.publish_feedback(VerifyMotion.Feedback(phase=phase, simulated=float(simulated)))


def main() -> None:
    """Entry point of ``ros2 run magic_verifier verifier``."""
    run(VerifierNode)


if __name__ == "__main__":
    main()
