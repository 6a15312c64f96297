"""How quickly a tool is carried: no faster than it may go itself, and than grip and joints bear."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.motion import TOOL_SPEED, TOOL_TURN, Margin, MotionPlan, ToolMotion
from magic_core.scene import SceneObject
from magic_planner.grasps import GraspSettings
from magic_planner.margins import margins
from magic_planner.object_motion import turning
from magic_planner.request import StageError
from magic_planner.robot import Robot
from magic_planner.schedule import slowed

Array = NDArray[np.float64]
#: A tool that the arm can carry too fast for grip, joints or the tool's own speed is carried so many times as slowly at most; and so many
#: times as slowly nothing is left of its inertia.
GENTLEST, AT_REST = 3.0, 100.0


@dataclass(frozen=True)
class Pace:
    """Finds the pace at which an arm that holds a tool by ``grasping`` bears it, the contact at ``tool_from_contact`` (4, 4)."""

    robot: Robot
    grasping: GraspSettings
    tool: SceneObject
    tool_from_contact: Array

    def bearable(self, plan: MotionPlan) -> MotionPlan:
        """The plan with its margins, the tool carried no faster than it may go and than grip and joints bear; raises StageError where that
        is more than :data:`GENTLEST` times as slowly as the joints could."""
        plan = slowed(plan, max(1.0, *haste(plan.tool_motion)))
        try:
            return self.with_margins(plan)
        except StageError:
            quick, still = self.margins(plan), self.margins(slowed(plan, AT_REST))
            # Each share grows at most by its inertial part, which falls with the square of the factor: the shares are sums of norms.
            left = {margin.name: margin.left for margin in still}
            needed = [(margin.left, left[margin.name]) for margin in quick if margin.left < 0]
            if min(rest for _, rest in needed) <= 0:
                raise
            factor = max(math.sqrt((rest - moving) / rest) for moving, rest in needed) + 0.01
            if factor > GENTLEST:
                raise
        return self.with_margins(slowed(plan, factor))

    def with_margins(self, plan: MotionPlan) -> MotionPlan:
        """The plan with its margins; raises StageError where one is negative."""
        found = self.margins(plan)
        least = min(found, key=lambda margin: margin.left)
        if least.left < 0:
            code = Code.NO_GRASP if least.name == "grip" else Code.DYNAMIC_LIMIT
            raise StageError("timing", MagicError(code, f"margin of {least}", f"{100 * least.left:.0f} % left", "0 % or more"))
        return replace(plan, margins=found)

    def margins(self, plan: MotionPlan) -> tuple[Margin, ...]:
        """How much of what arm and grip bear the plan leaves over."""
        arm = plan.arm_motion
        assert arm is not None
        held = (arm.grasp_time, np.inf if arm.release_time is None else arm.release_time)
        phases = plan.tool_motion.phases
        tool_from_tcp, contact = arm.tool_from_tcp, self.tool_from_contact
        return margins(self.robot, self.grasping, self.tool, tool_from_tcp, contact, arm.times, arm.positions, held, phases)


def haste(motion: ToolMotion) -> tuple[float, float]:
    """Speed and turning speed of a tool at their greatest, in shares of what is allowed."""
    steps = np.diff(motion.times)
    way = np.linalg.norm(np.diff(motion.world_from_tool[:, :3, 3], axis=0), axis=1)
    turns = turning(motion.world_from_tool[:-1], motion.world_from_tool[1:])
    return float((way / steps).max() / TOOL_SPEED), float((turns / steps).max() / TOOL_TURN)
