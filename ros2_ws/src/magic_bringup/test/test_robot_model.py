"""The arm and its ghost stand where joint states and the verified trajectory put them."""

import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory

from magic_bringup.robot_model import GHOST, PAUSE, RobotModel, link_frames, played, shown
from magic_core import conversions, qos
from magic_core.robot import Description
from magic_server.testing import fakes

ROBOT = Description()


def place(frames, link, root):
    """base_from_link, by going up the frames."""
    pose, parents = np.eye(4), {child: (parent, matrix) for (parent, child), matrix in frames.items()}
    while link != root:
        link, step = parents[link][0], parents[link][1]
        pose = step @ pose
    return pose


def test_frames_are_those_of_the_links():
    positions = dict(zip(ROBOT.names, np.random.default_rng(0).uniform(-1, 1, 7)))
    links = ROBOT.poses(positions)
    for prefix in ("", GHOST):
        frames = link_frames(ROBOT, positions, prefix)
        for name, pose in links.items():
            found = place(frames, f"{prefix}/{name}".lstrip("/"), ROBOT.base_frame)
            np.testing.assert_allclose(found, pose, atol=1e-12)


def test_the_description_names_meshes_that_are_there():
    meshes = [mesh.get("filename") for mesh in ET.fromstring(shown(ROBOT)).iter("mesh")]
    assert meshes and all(name.startswith("file:///") and Path(name.removeprefix("file://")).is_file() for name in meshes)


def test_the_layout_shows_arm_and_ghost():
    layout = yaml.safe_load((Path(__file__).resolve().parents[1] / "rviz/magic.rviz").read_text())
    models = [d for d in layout["Visualization Manager"]["Displays"] if d["Class"] == "rviz_default_plugins/RobotModel"]
    assert [m["TF Prefix"] for m in models] == ["", GHOST]
    assert all(m["Description Topic"]["Value"] == "robot_description" for m in models)


def test_a_trajectory_is_played_again_and_again():
    times, rows = [0.0, 1.0, 2.0], np.array([[0.0], [1.0], [0.0]])
    for since, expected in ((0.0, 0.0), (0.5, 0.5), (1.5, 0.5), (2.0 + PAUSE / 2, 0.0), (2.0 + PAUSE + 0.25, 0.25)):
        assert played(times, rows, since)[0] == pytest.approx(expected)


def test_the_node_tells_arm_and_ghost():
    context = Context()
    rclpy.init(context=context)
    model, other = RobotModel(context=context), Node("other", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(model)
    executor.add_node(other)
    heard, texts = [], []
    other.create_subscription(TFMessage, "/tf", heard.append, 100)
    other.create_subscription(String, "robot_description", texts.append, qos.LATCHED)
    arm = conversions.arm_motion_to_msg(fakes.plan("arm").arm_motion)
    for point in arm.points:
        point.positions = [0.3] * 7
    other.create_publisher(JointTrajectory, "verified_trajectory", qos.LATCHED).publish(arm)
    try:

        def at(prefix):
            if not heard:
                return None
            frames = {(t.header.frame_id, t.child_frame_id): conversions.transform_from_msg(t.transform) for t in heard[-1].transforms}
            return place(frames, f"{prefix}panda_hand_tcp", "panda_link0")

        home = ROBOT.forward(np.array(ROBOT.config.home))[0]
        there = ROBOT.forward(np.full(7, 0.3))[0]
        deadline = time.monotonic() + 30.0
        while not (texts and heard and np.allclose(at("ghost/"), there)) and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
        np.testing.assert_allclose(at("ghost/"), there, atol=1e-9)
        np.testing.assert_allclose(at(""), home, atol=1e-9)
        assert "panda_link7" in texts[0].data
    finally:
        executor.shutdown()
        model.destroy_node()
        other.destroy_node()
        context.try_shutdown()
