"""Other arms than the Panda for the tests: a made-up one, and two real ones of the package example-robot-data."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from pathlib import Path

from magic_core.robot import RobotConfig, panda_folder

#: What is kept of the Panda's description for a Franka hand on another arm.
HAND = ("panda_hand", "panda_hand_tcp", "panda_leftfinger", "panda_rightfinger")


def ur5_with_franka_hand(folder: Path) -> RobotConfig:
    """A UR5 that carries Franka's hand: two descriptions joined by one fixed joint, written into a folder."""
    robots = panda_folder().parent
    arm = ET.parse(robots / "ur_description/urdf/ur5_robot.urdf").getroot()
    panda = ET.parse(panda_folder() / "urdf/panda.urdf").getroot()
    hand = [link for link in panda.findall("link") if link.get("name") in HAND]
    hand += [joint for joint in panda.findall("joint") if joint.find("parent").get("link") == "panda_hand"]
    arm.extend(copy.deepcopy(hand))
    flange = ET.SubElement(arm, "joint", {"name": "flange", "type": "fixed"})
    ET.SubElement(flange, "parent", {"link": "tool0"})
    ET.SubElement(flange, "child", {"link": "panda_hand"})
    pairs = ET.parse(robots / "ur_description/srdf/ur5_joint_limited_robot.srdf").getroot()
    for name in ("wrist_1_link", "wrist_2_link", "wrist_3_link", "ee_link"):
        for part in HAND:
            ET.SubElement(pairs, "disable_collisions", {"link1": name, "link2": part, "reason": "Never"})
    for a, b in (("panda_hand", "panda_leftfinger"), ("panda_hand", "panda_rightfinger"), ("panda_leftfinger", "panda_rightfinger")):
        ET.SubElement(pairs, "disable_collisions", {"link1": a, "link2": b, "reason": "Adjacent"})
    urdf, srdf = folder / "ur5_hand.urdf", folder / "ur5_hand.srdf"
    ET.ElementTree(arm).write(urdf)
    ET.ElementTree(pairs).write(srdf)
    return RobotConfig(
        urdf=str(urdf),
        srdf=str(srdf),
        package_root=str(robots.parents[1]),
        home=(0.0, -1.7, 1.9, -1.77, -1.57, 0.0),
        acceleration=(8.0,),
    )


def baxter() -> RobotConfig:
    """Baxter's right arm with its electric gripper; the left arm hangs at zero."""
    folder = panda_folder().parent / "baxter_description"
    return RobotConfig(
        urdf=str(folder / "urdf/baxter.urdf"),
        srdf=str(folder / "srdf/baxter_manipulation.srdf"),
        move_group="right_gripper",
        opening=0.048,
        home=(-0.6, -0.84, 1.44, 1.7, -0.74, 1.39, -2.98),
        acceleration=(4.0,),
    )
