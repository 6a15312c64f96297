"""The ``planner`` node: the action ``plan_motion``."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState

from magic_core import conversions as convert
from magic_core import masses
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_core.mesh import check_solid
from magic_core.motion import VARIANTS, MotionPlan
from magic_core.node import OneGoalServer, describe, parameter, robot_parameters, run
from magic_core.presets import config_of
from magic_core.robot import Description, RobotConfig
from magic_core.threads import one_thread
from magic_interfaces.action import PlanMotion
from magic_planner.budget import Budget
from magic_planner.giving_way import gap_of
from magic_planner.object_motion import plan_tool_motion, warm_up
from magic_planner.request import Problem


class PlannerNode(Node):
    """Turns a contact into a motion of the tool and, for the arm variant, of the arm.

    Action server: ``plan_motion`` (magic_interfaces/action/PlanMotion).  The goal
    carries everything; the node keeps no state between goals.  One goal at a time: a
    goal during another one is answered BUSY at once.  Cancelling takes effect inside
    the stages, within one search for a free path (0.5 s) at the latest.

    Parameters: see ``config/planner.param.yaml``.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("planner", **kwargs)
        self._strategies = parameter(self, "strategies", "", "Folder of strategies; empty: those installed with magic_bringup.")
        self._timeout = parameter(self, "timeout", 10.0, "Wall time in s for one goal that names none.", low=0.05, high=3600.0)
        self._arm = self._load_arm(parameter(self, "arm", True, "Load the arm; without it only the variant fg is served."))
        warm_up()
        self._threads = one_thread()
        self._server = OneGoalServer(
            self, PlanMotion, "plan_motion", self._answer, "another motion is being planned; send the goal again when it has ended"
        )
        self.get_logger().info("ready: waiting for goals of plan_motion")

    def destroy_node(self) -> None:
        """Take the action server down with the node."""
        self._server.destroy()
        super().destroy_node()

    def _load_arm(self, wanted: bool) -> Any:
        """Declare the arm's parameters and load it where it is wanted, so that the first goal does not pay for it; raises BAD_REQUEST."""
        from magic_planner.arm import ArmPlanner, ArmSettings
        from magic_planner.cloud import CloudSettings
        from magic_planner.grasps import GraspSettings
        from magic_planner.robot import Robot

        started = time.monotonic()
        given = robot_parameters(self)
        default = config_of(given["preset"])

        def share(name: str, of: str) -> float:
            return parameter(self, f"robot.{name}", getattr(default, name), f"Share of the {of} limits that is used.", low=0.001, high=1.0)

        config = RobotConfig(
            **given,
            velocity_scale=share("velocity_scale", "velocity"),
            acceleration_scale=share("acceleration_scale", "acceleration"),
            jerk_scale=share("jerk_scale", "jerk"),
        )
        #: The frame of everything that comes and goes.
        self._base = Description(config).base_frame
        grasping = GraspSettings(
            agreement=parameter(self, "grasp.agreement", 0.9, "Least cosine between the normals at the two fingers.", low=0.0, high=1.0),
            samples=parameter(self, "grasp.samples", 500, "Surface points tried for a grasp.", low=10, high=20000),
            clearance=parameter(self, "grasp.clearance", 0.0015, "Metres between hand and table.", low=0.0, high=0.1),
            grip_force=parameter(self, "grasp.grip_force", 60.0, "Newtons of each finger, for the ranking by slip.", low=1.0, high=1000.0),
            friction=parameter(self, "grasp.friction", 0.6, "Friction between pad and tool, for the ranking by slip.", low=0.05, high=3.0),
            away=parameter(self, "grasp.away", 0.025, "Metres around the contact in which no finger is placed.", low=0.0, high=1.0),
        )
        settings = ArmSettings(
            standoff=parameter(self, "standoff", 0.08, "Metres of straight way to the grasp.", low=0.01, high=0.5),
            lift=parameter(self, "lift", 0.06, "Metres straight up after the grasp.", low=0.005, high=0.5),
            retreat=parameter(
                self, "retreat", 0.16, "Metres straight away after a release, less where that is out of reach.", low=0.01, high=0.5
            ),
            room=parameter(
                self, "room", 0.015, "Metres of room about a tool that is carried, and about what the empty hand passes.", low=0.0, high=0.1
            ),
            dwell=parameter(self, "dwell", 0.5, "Seconds for the fingers to close or open.", low=0.0, high=10.0),
            time_step=parameter(self, "time_step", 0.02, "Seconds between the points of the trajectory.", low=0.002, high=0.2),
        )
        cloud = CloudSettings(
            use=parameter(self, "use_cloud", True, "Avoid measured points that no reconstructed shape accounts for."),
            resolution=parameter(self, "cloud.resolution", 0.01, "Metres, edge of a voxel of the cloud.", low=0.002, high=0.1),
            margin=parameter(
                self, "cloud.margin", 0.01, "Metres around shapes, tool and table in which points are left to these.", low=0.0, high=0.2
            ),
        )
        if not wanted:
            return None
        planner = ArmPlanner(Robot(config), settings, grasping, cloud)
        planner.warm_up()
        self.get_logger().info(f"arm {config.urdf or 'panda'} ready after {time.monotonic() - started:.2f} s")
        return planner

    def _answer(self, handle: Any, result: PlanMotion.Result) -> None:
        goal, started = handle.request, time.monotonic()
        try:
            plan = self._plan(handle)
            result.plan = convert.plan_to_msg(plan, goal.tool.id, self._base)
            end = (plan.arm_motion or plan.tool_motion).times[-1]
            result.code, result.message = int(Code.OK), f"a motion of {end:.1f} s in {len(plan.tool_motion.phases)} phases"
            if plan.margins:
                result.message += "; used at most: " + "; ".join(map(str, sorted(plan.margins, key=lambda margin: margin.left)))
        except Exception as error:  # into the answer, and into the log with the goal's name
            result.code, result.message = describe(self, error)
        name, seconds = Code(result.code).name, time.monotonic() - started
        self.get_logger().info(f"{goal.strategy} {goal.variant} {goal.tool.id}: {name}: {result.message} ({seconds:.2f} s)")

    def _plan(self, handle: Any) -> MotionPlan:
        goal = handle.request
        if goal.variant not in VARIANTS:
            raise MagicError(Code.UNKNOWN_VARIANT, "variant", goal.variant, VARIANTS)
        if not (np.isfinite(goal.timeout) and goal.timeout >= 0):
            raise MagicError(Code.BAD_REQUEST, "timeout", goal.timeout, "0 or a number of seconds above it")
        budget = Budget(goal.timeout or self._timeout, lambda: bool(handle.is_cancel_requested))

        def feedback(stage: str, message: str) -> None:
            handle.publish_feedback(PlanMotion.Feedback(stage=stage, message=message))

        feedback("motion", f"moving {goal.tool.id} by strategy {goal.strategy}")
        strategy = strategies.known(goal.strategy, self._strategies or None)
        convert.check_frames(self._base, (goal.tool, goal.target, *goal.obstacles))
        tool, target = (convert.object_from_msg(item, pictures=False) for item in (goal.tool, goal.target))
        for item, what in ((tool, "tool"), (target, "target")):
            check_solid(item.mesh, f"the {what} {item.id}")
        strategy = masses.told(strategy, tool, target, goal.tool_mass, goal.target_mass)
        obstacles = tuple(convert.object_from_msg(o, pictures=False) for o in goal.obstacles)
        ids = [tool.id, target.id, *(o.id for o in obstacles)]
        if len(set(ids)) != len(ids) or "" in ids:
            raise MagicError(Code.BAD_REQUEST, "object ids", ", ".join(repr(i) for i in ids), "ids that are not empty and differ")
        candidate = convert.candidate_from_msg(goal.candidate)
        table = convert.plane_from_msg(goal.table)
        reflection = goal.reflection or "keep"
        motion = plan_tool_motion(strategy, tool, target, candidate, reflection, table, obstacles, gap_of(tool, goal.variant))
        budget.check("motion")
        if goal.variant == "fg":
            if goal.attempt:
                raise MagicError(
                    Code.BAD_REQUEST, "attempt", goal.attempt, "0: the floating gripper has one motion for each candidate and reflection"
                )
            return MotionPlan("fg", motion)
        if self._arm is None:
            raise MagicError(Code.UNKNOWN_VARIANT, "variant", goal.variant, "fg, as this planner was started without an arm")
        problem = Problem(
            strategy,
            tool,
            target,
            candidate,
            reflection,
            motion,
            table,
            obstacles,
            start=self._start(goal.start),
            attempt=int(goal.attempt),
            seed=int(goal.seed),
        )
        return self._arm.solve(problem, budget, feedback)

    def _start(self, state: JointState) -> NDArray[np.float64] | None:
        """Joint positions of the arm out of a JointState (in any order, fingers and others left out); None where it is empty."""
        if not state.name and not state.position:
            return None
        if len(state.name) != len(state.position):
            raise MagicError(
                Code.BAD_REQUEST, "start: names and positions", f"{len(state.name)} and {len(state.position)}", "as many positions as names"
            )
        found = dict(zip(state.name, state.position, strict=True))
        names = self._arm.robot.chain.names
        missing = [name for name in names if name not in found]
        if missing:
            raise MagicError(Code.BAD_REQUEST, "start: joints", f"without {', '.join(missing)}", names)
        return np.array([found[name] for name in names], dtype=float)


def main() -> None:
    """Entry point of ``ros2 run magic_planner planner``."""
    run(PlannerNode)


if __name__ == "__main__":
    main()
