"""The verifier node's parameters; ``config/verifier.param.yaml`` lists them with their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rclpy.node import Node

from magic_core.node import parameter
from magic_verifier import uncertainty
from magic_verifier.articulation import ArmOptions
from magic_verifier.rollout import Limits
from magic_verifier.simulation import Settings
from magic_verifier.verification import DEFAULTS, ROLLOUTS

#: More repetitions than this in one goal are refused.
MAX_REPETITIONS = 1000


@dataclass(frozen=True)
class Parameters:
    """What the node is told.

    strategies: folder of the strategies, empty: the installed ones.  timeout: s for a goal that names none.  settings: of the simulation,
    by variant.
    rollouts: at most, of a goal that names no number.  spreads: what rollouts draw.  workers: processes that simulate, this one among them.
    limits: what a motion may do.
    arm: the arm's controller and fingers.  film_frames: of a film strip.
    """

    strategies: str
    timeout: float
    settings: Mapping[str, Settings]
    rollouts: int
    spreads: uncertainty.Uncertainty
    workers: int
    limits: Limits
    arm: ArmOptions
    film_frames: int


def read(node: Node) -> Parameters:
    """Declare and read the parameters but those of the robot.  Raises BAD_REQUEST."""
    fg = parameter(node, "frequency", 240.0, "Steps per simulated second, floating gripper.", low=60.0, high=2000.0)
    arm = parameter(node, "arm_frequency", 240.0, "Steps per simulated second, arm.", low=120.0, high=2000.0)
    spreads = parameter(node, "uncertainty", "", "YAML file of what rollouts draw; empty: the one that is installed, uncertainty.yaml.")
    return Parameters(
        strategies=parameter(node, "strategies", "", "Folder of strategies; empty: those installed with magic_bringup."),
        timeout=parameter(node, "timeout", 120.0, "Wall time in s for one goal that names none.", low=0.1, high=3600.0),
        settings={"fg": replace(DEFAULTS["fg"], frequency=fg), "arm": replace(DEFAULTS["arm"], frequency=arm)},
        rollouts=parameter(node, "rollouts", ROLLOUTS, "Rollouts at most of a goal that names no number.", low=1, high=MAX_REPETITIONS),
        spreads=uncertainty.read(spreads or None),
        workers=parameter(node, "workers", 2, "Processes that simulate, this one among them.", low=1, high=64),
        limits=_limits(node),
        arm=_arm(node),
        film_frames=parameter(node, "film_frames", 8, "Frames of the film strip.", low=1, high=64),
    )


def _limits(node: Node) -> Limits:
    """How much a motion may do of what it should not."""
    return Limits(
        overlap=parameter(
            node, "limits.overlap", 0.0015, "Depth in m that the tool may be in static things before the contact.", low=0.0, high=0.1
        ),
        press=parameter(node, "limits.press", 0.01, "Depth in m that the tool may be in static things after that.", low=0.0, high=0.1),
        shove=parameter(
            node, "limits.shove", 0.005, "Way in m that a loose thing which has no part in the motion may be moved.", low=0.0, high=0.1
        ),
        nudge=parameter(node, "limits.nudge", 0.002, "Way in m that the target may be pushed before the contact.", low=0.0, high=0.1),
        slip=parameter(node, "limits.slip", 0.02, "Way in m that the tool may slip in the gripper.", low=0.0, high=0.5),
        slip_angle=parameter(node, "limits.slip_angle", 0.35, "Angle in rad that the tool may turn in the gripper.", low=0.0, high=3.2),
        tracking=parameter(node, "limits.tracking", 0.1, "Angle in rad that a joint may lag behind its command.", low=0.001, high=3.2),
        tracking_slide=parameter(
            node, "limits.tracking_slide", 0.01, "Way in m that a sliding joint may lag behind its command.", low=0.0001, high=1.0
        ),
        give=parameter(
            node,
            "limits.give",
            0.01,
            "In drawn rollouts, m that a hand gives way by: overlap and nudge may be as large.",
            low=0.0,
            high=0.1,
        ),
        required_rate=parameter(
            node, "required_rate", Limits.required_rate, "Least lower end of the success rate's interval.", low=0.0, high=0.99
        ),
    )


def _arm(node: Node) -> ArmOptions:
    """The controller of the arm, and its fingers."""
    return ArmOptions(
        stiffness=tuple(
            parameter(
                node,
                "arm.stiffness",
                list(ArmOptions.stiffness),
                "Stiffness of the joint drives in Nm/rad, one a joint or one for all.",
            )
        ),
        damping=tuple(
            parameter(node, "arm.damping", list(ArmOptions.damping), "Damping of the joint drives in Nms/rad, one a joint or one for all.")
        ),
        grip_force=parameter(node, "arm.grip_force", 60.0, "Force in N with which each finger closes.", low=0.1, high=1000.0),
        finger_friction=parameter(node, "arm.finger_friction", 1.5, "Friction coefficient of the finger pads.", low=0.0, high=10.0),
    )
