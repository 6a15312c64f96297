"""The topics on which verified motions stand: the trajectories, and what tells whether they may be begun."""

from __future__ import annotations

import copy
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, MultiDOFJointTrajectory

from magic_core import qos
from magic_interfaces.msg import MotionPlan, VerifiedMotion
from magic_server.permission import Claim


@dataclass(frozen=True)
class Motion:
    """What a claim is about: the plan, and what :class:`VerifiedMotion` tells of it."""

    plan: MotionPlan
    strategy: str
    tool_id: str
    target_id: str
    scene_stamp: Time


class Outlet:
    """Publishes, latched, for :class:`magic_server.publication.Publication`:

    ``verified_trajectory`` (JointTrajectory, variant arm), ``verified_tool_trajectory`` (MultiDOFJointTrajectory, variant fg): an
    empty one takes back what was there; ``verified_motion`` (VerifiedMotion): what stands there, said again by :meth:`beat`.
    """

    def __init__(self, node: Node, frame: str) -> None:
        self._node, self._frame = node, frame
        self._arm = node.create_publisher(JointTrajectory, "verified_trajectory", qos.LATCHED)
        self._tool = node.create_publisher(MultiDOFJointTrajectory, "verified_tool_trajectory", qos.LATCHED)
        self._verified = node.create_publisher(VerifiedMotion, "verified_motion", qos.LATCHED)
        self.state = VerifiedMotion()

    def _now(self) -> Time:
        return self._node.get_clock().now().to_msg()

    def publish(self, claim: Claim, notes: tuple[str, ...]) -> None:
        """The trajectory of a claim's motion, stamped with this moment and in the robot's base frame; then that it is valid."""
        motion, verdict, stamp = claim.motion, claim.verdict, self._now()
        assert verdict is not None, "a claim without a verdict was allowed"
        plan = motion.plan
        publisher, trajectory = (self._arm, plan.arm_trajectory) if plan.variant == MotionPlan.ARM else (self._tool, plan.tool_trajectory)
        stamped = copy.copy(trajectory)
        stamped.header = Header(stamp=stamp, frame_id=self._frame)
        publisher.publish(stamped)
        self.state = VerifiedMotion(
            valid=True,
            run_id=claim.run,
            stamp=stamp,
            scene_stamp=motion.scene_stamp,
            strategy=motion.strategy,
            variant=plan.variant,
            tool_id=motion.tool_id,
            target_id=motion.target_id,
            success_rate=verdict.success_rate,
            rate_low=verdict.rate_low,
            rate_high=verdict.rate_high,
            rollouts=verdict.rollouts,
            notes=list(notes),
        )
        self.beat()

    def withdraw(self, reason: str) -> None:
        """Take back what stands on either topic: late subscribers get an empty trajectory."""
        self.state.valid, self.state.reason = False, reason
        self.beat()
        header = Header(stamp=self._now(), frame_id=self._frame)
        for publisher, kind in ((self._arm, JointTrajectory), (self._tool, MultiDOFJointTrajectory)):
            publisher.publish(kind(header=header))
        self._node.get_logger().info(f"no verified trajectory is valid: {reason}")

    def beat(self) -> None:
        """Say again what stands: who hears this no more must take it for withdrawn."""
        self.state.header = Header(stamp=self._now(), frame_id=self._frame)
        self._verified.publish(self.state)
