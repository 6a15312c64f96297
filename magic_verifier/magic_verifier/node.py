"""The ``verifier`` node: the action ``verify_motion``."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image

from magic_core import conversions as convert
from magic_core import strategy as strategies
from magic_core.content import digest
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, check_solid
from magic_core.node import OneGoalServer, describe, parameter, robot_parameters, run
from magic_core.robot import Description, RobotConfig
from magic_core.threads import one_thread
from magic_interfaces.action import VerifyMotion
from magic_verifier import motion_check, uncertainty
from magic_verifier.articulation import ArmOptions, Articulation
from magic_verifier.simulation import DYNAMIC, World, usable_pieces
from magic_verifier.verification import DEFAULTS, ROLLOUTS, Limits, Verdict, verify
from magic_verifier.workers import Workers

#: More repetitions than this in one goal are refused.
MAX_REPETITIONS = 1000
NO_MESH = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
#: Feedback is for people: each phase once, and else no more often than so, s.  A rollout takes a fraction of the time that the motion itself takes.
FEEDBACK_PERIOD = 0.1
#: Goals that end so were not judged.
UNJUDGED = (Code.CANCELED, Code.INTERNAL, Code.BAD_REQUEST, Code.UNKNOWN_STRATEGY, Code.BAD_STRATEGY)


class VerifierNode(Node):
    """Runs planned motions in physics, one at a time; a goal during another one is answered BUSY at once.

    Action server: ``verify_motion`` (magic_interfaces/action/VerifyMotion).  The goal
    carries everything.  The last verdict is kept: the same goal again, with ``want_film``
    this time, is answered from what was recorded, as the same goal has the same verdict.

    Parameters: see ``config/verifier.param.yaml``.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("verifier", **kwargs)
        self._strategies = parameter(self, "strategies", "", "Folder of strategies; empty: those installed with magic_bringup.")
        self._timeout = parameter(self, "timeout", 120.0, "Wall time in s for one goal that names none.", low=0.1, high=3600.0)
        fg = parameter(self, "frequency", 240.0, "Steps per simulated second, floating gripper.", low=60.0, high=2000.0)
        arm = parameter(self, "arm_frequency", 240.0, "Steps per simulated second, arm.", low=120.0, high=2000.0)
        self._settings = {"fg": replace(DEFAULTS["fg"], frequency=fg), "arm": replace(DEFAULTS["arm"], frequency=arm)}
        self._rollouts = parameter(
            self, "rollouts", ROLLOUTS, "Rollouts at most of a goal that names no number.", low=1, high=MAX_REPETITIONS
        )
        self._spreads = uncertainty.read(
            parameter(self, "uncertainty", "", "YAML file of what rollouts draw; empty: the one that is installed, uncertainty.yaml.")
            or None
        )
        workers = parameter(self, "workers", 2, "Processes that simulate, this one among them.", low=1, high=64)
        self._limits = Limits(
            overlap=parameter(
                self, "limits.overlap", 0.0015, "Depth in m that the tool may be in static things before the contact.", low=0.0, high=0.1
            ),
            press=parameter(self, "limits.press", 0.01, "Depth in m that the tool may be in static things after that.", low=0.0, high=0.1),
            nudge=parameter(self, "limits.nudge", 0.002, "Way in m that the target may be pushed before the contact.", low=0.0, high=0.1),
            slip=parameter(self, "limits.slip", 0.02, "Way in m that the tool may slip in the gripper.", low=0.0, high=0.5),
            slip_angle=parameter(self, "limits.slip_angle", 0.35, "Angle in rad that the tool may turn in the gripper.", low=0.0, high=3.2),
            tracking=parameter(self, "limits.tracking", 0.1, "Angle in rad that a joint may lag behind its command.", low=0.001, high=3.2),
            tracking_slide=parameter(
                self, "limits.tracking_slide", 0.01, "Way in m that a sliding joint may lag behind its command.", low=0.0001, high=1.0
            ),
            give=parameter(
                self,
                "limits.give",
                0.01,
                "In drawn rollouts, m that a hand gives way by: overlap and nudge may be as large.",
                low=0.0,
                high=0.1,
            ),
            required_rate=parameter(
                self, "required_rate", Limits.required_rate, "Least lower end of the success rate's interval.", low=0.0, high=0.99
            ),
        )
        self._arm = ArmOptions(
            stiffness=tuple(
                parameter(
                    self,
                    "arm.stiffness",
                    list(ArmOptions.stiffness),
                    "Stiffness of the joint drives in Nm/rad, one a joint or one for all.",
                )
            ),
            damping=tuple(
                parameter(
                    self, "arm.damping", list(ArmOptions.damping), "Damping of the joint drives in Nms/rad, one a joint or one for all."
                )
            ),
            grip_force=parameter(self, "arm.grip_force", 60.0, "Force in N with which each finger closes.", low=0.1, high=1000.0),
            finger_friction=parameter(self, "arm.finger_friction", 1.5, "Friction coefficient of the finger pads.", low=0.0, high=10.0),
        )
        self._robot = Description(RobotConfig(**robot_parameters(self)))
        self._film_frames = parameter(self, "film_frames", 8, "Frames of the film strip.", low=1, high=64)
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
        self._pool = Workers(workers - 1)
        self._warm_up()
        self._threads = one_thread()
        self.get_logger().info("ready: waiting for goals of verify_motion")

    def destroy_node(self) -> None:
        """Take the action server down with the node."""
        self._server.destroy()
        self._pool.close()
        super().destroy_node()

    def _warm_up(self) -> None:
        """Load SAPIEN and the arm and step small worlds, so that the first goal does not pay for it; raises BAD_REQUEST."""
        cube = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
        world = World(self._settings["fg"])
        world.add_table(np.array([0, 0, 1.0, 0]), 0.5)
        world.add("cube", usable_pieces("cube", (Mesh(cube, np.zeros((0, 3))),)), np.eye(4), DYNAMIC, 500.0, 0.5)
        world.step()
        started = time.monotonic()
        world = World(self._settings["arm"])
        Articulation(world, self._robot, self._arm).place(np.array(self._robot.config.home))
        world.step()
        self.get_logger().info(f"arm {self._robot.urdf.stem} ready after {time.monotonic() - started:.2f} s")

    def _answer(self, handle: Any, result: VerifyMotion.Result) -> None:
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
        goal = handle.request
        if goal.repetitions > MAX_REPETITIONS:
            raise MagicError(Code.BAD_REQUEST, "repetitions", goal.repetitions, f"0 to {MAX_REPETITIONS}")
        if not (np.isfinite(goal.timeout) and goal.timeout >= 0):
            raise MagicError(Code.BAD_REQUEST, "timeout", goal.timeout, "0 or a number of seconds above it")
        strategy = strategies.known(goal.strategy, self._strategies or None)
        trajectories = goal.plan.tool_trajectory, goal.plan.arm_trajectory
        convert.check_frames(self._robot.base_frame, (goal.tool, goal.target, *goal.obstacles), *trajectories)
        tool, target = (convert.object_from_msg(item, pictures=False) for item in (goal.tool, goal.target))
        for item, what in ((tool, "tool"), (target, "target")):
            check_solid(item.mesh, f"the {what} {item.id}")
        obstacles = tuple(convert.object_from_msg(o, pictures=False) for o in goal.obstacles)
        ids = [tool.id, target.id, *(o.id for o in obstacles)]
        if len(set(ids)) != len(ids):
            raise MagicError(Code.BAD_REQUEST, "object ids", ", ".join(ids), "ids that differ")
        table = convert.plane_from_msg(goal.table)
        plan = convert.plan_from_msg(goal.plan)
        motion_check.check_trajectory(goal.plan.tool_trajectory, tool.id, plan.tool_motion)
        candidate = convert.candidate_from_msg(goal.candidate) if goal.candidate.tool_id else None

        told: set[str] = set()
        last = started

        def feedback(phase: str, simulated: float) -> None:
            nonlocal last
            now = time.monotonic()
            if phase in told and now - last < FEEDBACK_PERIOD:
                return
            told.add(phase)
            last = now
            handle.publish_feedback(VerifyMotion.Feedback(phase=phase, simulated=float(simulated)))

        # What obstacles look like is in the film alone.
        simulated = tuple(replace(obstacle, mesh=NO_MESH) for obstacle in obstacles)
        asked = digest((goal.strategy, tool, target, simulated, table, candidate, plan, goal.repetitions, goal.seed, goal.tried))
        if goal.want_film and self._last is not None and asked == self._last[0]:
            return self._with_film(self._last[1], tool, target, obstacles, table)
        verdict = verify(
            strategy,
            tool,
            target,
            obstacles,
            table,
            candidate,
            plan,
            seed=int(goal.seed),
            repetitions=int(goal.repetitions) or self._rollouts,
            deadline=started + (goal.timeout or self._timeout),
            cancel=lambda: handle.is_cancel_requested,
            progress=feedback,
            settings=self._settings[plan.variant],
            spreads=self._spreads,
            limits=self._limits,
            arm_options=self._arm,
            robot=self._robot,
            pool=self._pool.executor,
            workers=self._pool.count,
            tried=int(goal.tried),
        )
        self.get_logger().info(
            f"{goal.strategy} {plan.variant} {goal.tool.id}: {verdict.code.name}: {verdict.message} ({verdict.seconds:.2f} s)"
        )
        if verdict.code not in (Code.CANCELED, Code.SIMULATION_TIMEOUT):  # these depend on more than the goal
            self._last = asked, verdict
        return self._with_film(verdict, tool, target, obstacles, table) if goal.want_film else (verdict, Image())

    def _with_film(self, verdict: Verdict, tool: Any, target: Any, obstacles: Any, table: Any) -> tuple[Verdict, Image]:
        if verdict.recording is None or verdict.code == Code.CANCELED:
            return verdict, Image()
        try:
            return verdict, self._film(verdict, tool, target, obstacles, table)
        except Exception as error:  # a picture that cannot be drawn changes no verdict
            _, message = describe(self, error)
            return replace(verdict, message=f"{verdict.message}; no film: {message}"), Image()

    def _film(self, verdict: Verdict, tool: Any, target: Any, obstacles: Any, table: Any) -> Image:
        from magic_verifier.film import film_strip

        caption = f"{verdict.code.name}: {verdict.message}"
        strip = film_strip(verdict.recording, tool, target, obstacles, table, frames=self._film_frames, caption=caption, robot=self._robot)
        return convert.image_to_msg(strip, "rgb8")


def main() -> None:
    """Entry point of ``ros2 run magic_verifier verifier``."""
    run(VerifierNode)


if __name__ == "__main__":
    main()
