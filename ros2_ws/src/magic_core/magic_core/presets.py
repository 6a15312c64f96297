"""Arms by name: what else than its URDF and SRDF a node has to know of a make of arm, and where these files come from.

A preset sets the defaults of the parameters ``robot.*``; what is given beside it wins.  Its published limits
(:mod:`magic_core.joint_limits`) hold besides those of the URDF: of the two the narrower.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from magic_core.joint_limits import PUBLISHED
from magic_core.robot import PANDA_HOME, RobotConfig


@dataclass(frozen=True)
class Preset:
    """config: with no files but for the Panda; trajectory_action, gripper_action: what the maker's driver calls them;
    files: where URDF and SRDF are from.  torque_error: to which a joint repeats the torque that its driver tells as effort, Nm, where
    that is measured behind the gear; 0: it is not, and tells no weight."""

    config: RobotConfig
    trajectory_action: str
    gripper_action: str
    files: str
    torque_error: float = 0.0


#: Nm; this project's choice.  Both arms measure torques behind the gear, and their drivers tell these, gravity included, as effort (tau_J).
FRANKA_TORQUE = 0.2

PRESETS = {
    "panda": Preset(
        RobotConfig(preset="panda"),
        "panda_arm_controller/follow_joint_trajectory",
        "panda_gripper/gripper_action",
        "those of the Python package example-robot-data, which is installed with this project, where none are named",
        FRANKA_TORQUE,
    ),
    "fr3": Preset(
        RobotConfig(
            preset="fr3",
            move_group="fr3_hand_tcp",
            home=PANDA_HOME,
            acceleration=PUBLISHED["fr3"].acceleration,
            jerk=PUBLISHED["fr3"].jerk,
        ),
        "fr3_arm_controller/follow_joint_trajectory",
        "franka_gripper/gripper_action",
        "URDF: xacro of franka_description, robots/fr3/fr3.urdf.xacro with hand:=true; SRDF: xacro of franka_fr3_moveit_config",
        FRANKA_TORQUE,
    ),
    "ur5e": Preset(
        RobotConfig(
            preset="ur5e",
            move_group="gripper_tcp",
            home=(0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0),
            acceleration=PUBLISHED["ur5e"].acceleration,
            acceleration_scale=0.6,
            jerk=PUBLISHED["ur5e"].jerk,
        ),
        "scaled_joint_trajectory_controller/follow_joint_trajectory",
        "gripper_controller/gripper_cmd",
        "URDF: your cell's, of ur_description (ur_type:=ur5e) with your gripper and a link gripper_tcp between its pads; SRDF: ur_moveit_config's with the gripper's links added",
    ),
}


def config_of(preset: str) -> RobotConfig:
    """What a preset sets; without a name: the defaults, which are the Panda's."""
    return PRESETS[preset].config if preset else RobotConfig()
