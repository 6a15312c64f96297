"""A run as one MCAP, for Foxglove, RViz and ``ros2 bag play``: what was seen, what was tried, what was verified, and the motion played.

Topics::

    objects, perception/markers       what perception had made of the scene (magic_interfaces/SceneObjectArray, MarkerArray), latched
    the cameras' own                  one picture each
    strategy/candidates               what became of each (magic_interfaces/CandidateReport), latched
    strategy/plan, verified_trajectory, verified_tool_trajectory
                                      the plan (magic_interfaces/MotionPlan); a trajectory only where it was verified
    strategy/film, strategy/heatmap   of the simulation and of the match
    strategy/summary                  summary.json (std_msgs/String), with verdict, times and versions
    strategy/tool_pose, tf, robot_description
                                      the motion in its own time: the tool, and the arm where its joints are those of the default robot

All but the last line stand at the beginning.
"""

from __future__ import annotations

import datetime
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy.typing import NDArray
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from magic_bags.recording import Recording
from magic_bringup.record import Record
from magic_bringup.robot_model import link_frames, shown
from magic_core import conversions
from magic_core.motion import ArmMotion
from magic_core.robot import Description
from magic_interfaces.msg import MotionPlan

#: Of the bag, in the folder of a run.
NAME = "run"
#: Between two poses of the played motion, s.
PERIOD = 0.05


def write(record: Record, folder: Path) -> Path:
    """Write the bag ``run`` into a run's folder, in place of one that is there; its path."""
    path = folder / NAME
    shutil.rmtree(path, ignore_errors=True)
    start = datetime.datetime.fromisoformat(record.summary["date"]).timestamp()
    with Recording(path, repeatable=False) as bag:
        bag.write("/strategy/summary", String(data=json.dumps(record.summary)), start, latched=True, depth=1)
        for topic, message in record.images.items():
            bag.write(topic if topic.startswith("/") else f"/{topic}", message, start)
        if record.scene is not None:
            from magic_perception.conversions import markers

            bag.write("/objects", record.scene, start, latched=True, depth=1)
            bag.write("/perception/markers", markers(conversions.scene_from_msg(record.scene)), start, latched=True, depth=1)
        if record.result is not None:
            _tell(bag, record.result, start)
    return path


def joints_at(robot: Description, arm: ArmMotion, when: float) -> NDArray[np.float64]:
    """The arm's joints (J,) of a motion at a time, s, and after them the fingers'."""
    held = arm.grasp_time <= when and not (arm.release_time is not None and when > arm.release_time)
    fingers = robot.finger_positions(arm.grasp_width if held else robot.config.opening)
    return np.array([*(np.interp(when, arm.times, column) for column in arm.positions.T), *fingers])


def _tell(bag: Recording, result: Any, start: float) -> None:
    for report in result.candidates:
        bag.write("/strategy/candidates", report, start, latched=True)
    for name in ("film", "heatmap"):
        if len(getattr(result, name).data):
            bag.write(f"/strategy/{name}", getattr(result, name), start, latched=True, depth=1)
    plan = result.plan
    if not plan.tool_trajectory.points:
        return
    bag.write("/strategy/plan", plan, start, latched=True, depth=1)
    if result.verified:
        trajectory = (
            ("/verified_trajectory", plan.arm_trajectory)
            if plan.variant == MotionPlan.ARM
            else ("/verified_tool_trajectory", plan.tool_trajectory)
        )
        bag.write(*trajectory, start, latched=True, depth=1)
    motion = conversions.plan_from_msg(plan)
    frame = plan.tool_trajectory.header.frame_id
    messages: list[tuple[float, str, Any]] = []
    last = -np.inf
    for when, pose in zip(motion.tool_motion.times, motion.tool_motion.world_from_tool, strict=True):
        if when - last >= PERIOD - 1e-9:
            last = when
            stamped = PoseStamped(header=conversions.header(frame, start + when), pose=conversions.pose_to_msg(pose))
            messages.append((when, "/strategy/tool_pose", stamped))
    robot = Description()
    if motion.arm_motion is not None and tuple(motion.arm_motion.joint_names) == robot.names:
        bag.write("/robot_description", String(data=shown(robot)), start, latched=True, depth=1)
        arm = motion.arm_motion
        for when in np.arange(0.0, arm.times[-1] + PERIOD, PERIOD):
            frames = link_frames(robot, robot.arm_positions(joints_at(robot, arm, when)))
            transforms = [
                TransformStamped(header=conversions.header(parent, start + when), child_frame_id=child, transform=transform)
                for (parent, child), transform in zip(frames, conversions.transforms_to_msgs(np.stack(list(frames.values()))), strict=True)
            ]
            messages.append((float(when), "/tf", TFMessage(transforms=transforms)))
    for when, topic, message in sorted(messages, key=lambda entry: entry[0]):
        bag.write(topic, message, start + when)
