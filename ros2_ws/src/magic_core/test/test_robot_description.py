"""A robot may be described on a topic, as robot_state_publisher does it, in place of a file."""

from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter
from std_msgs.msg import String

from magic_core import qos
from magic_core.errors import Code, MagicError
from magic_core.node import robot_parameters
from magic_core.robot import Description, RobotConfig
from magic_core.robot_description import file_of
from magic_core.testing import six_axis


@pytest.fixture
def ros():
    context = Context()
    rclpy.init(context=context)
    yield context
    context.try_shutdown()


def test_urdf_and_srdf_come_on_latched_topics(ros, tmp_path):
    config = six_axis.describe(tmp_path)
    robot = rclpy.create_node("robot_state_publisher", context=ros)
    topics = {"urdf": "/robot_description", "srdf": "/robot_description_semantic"}
    publishers = {name: robot.create_publisher(String, topic, qos.LATCHED) for name, topic in topics.items()}
    for name, publisher in publishers.items():
        publisher.publish(String(data=Path(getattr(config, name)).read_text()))
    given = {f"robot.{name}": f"topic:{topic}" for name, topic in topics.items()}
    given |= {"robot.move_group": config.move_group, "robot.closing_axis": config.closing_axis, "robot.opening": config.opening}
    given |= {"robot.home": list(config.home), "robot.acceleration": list(config.acceleration)}
    node = rclpy.create_node("planner", context=ros, parameter_overrides=[Parameter(name, value=value) for name, value in given.items()])
    try:
        heard = Description(RobotConfig(**robot_parameters(node)))
        assert heard.names == Description(config).names
        assert heard.urdf != Path(config.urdf)
    finally:
        node.destroy_node()
        robot.destroy_node()


def test_a_topic_on_which_nothing_comes_is_named(ros):
    node = rclpy.create_node("planner", context=ros)
    try:
        assert file_of(node, "robot.urdf", "/a/file.urdf") == "/a/file.urdf"
        for given, says in (("topic:/nothing", "nothing came on /nothing"), ("topic:", "the name of a topic")):
            with pytest.raises(MagicError) as caught:
                file_of(node, "robot.urdf", given, patience=0.3)
            assert caught.value.code == Code.BAD_REQUEST
            assert says in caught.value.message
    finally:
        node.destroy_node()
