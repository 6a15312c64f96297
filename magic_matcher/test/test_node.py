"""The node: answers by ids and by images, every failure with its code, several at a time."""

import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from magic_core.domain import free_domain

os.environ["ROS_DOMAIN_ID"] = str(free_domain(for_good=True))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("magic_interfaces.srv")

from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter

from magic_core import conversions, qos, shapes, strategy, transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import Scene
from magic_interfaces.msg import SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_matcher.node import MatcherNode


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "deadline passed"
        time.sleep(0.01)


@pytest.fixture(scope="module")
def graph(demonstration, tmp_path_factory):
    root = tmp_path_factory.mktemp("strategies")
    strategy.save(demonstration, root / "test")
    pull = (strategy.Waypoint("touch", np.zeros(3), "contact"), strategy.Waypoint("pulled", np.array([-0.2, 0.0, 0.0]), "goal"))
    strategy.save(replace(demonstration, name="led", waypoints=pull, turned_by=np.deg2rad(40.0)), root / "led")
    (root / "broken").mkdir()
    (root / "broken" / "strategy.yaml").write_text("name: broken\n")
    rclpy.init(args=["--ros-args", "-p", f"strategies:={root}", "-p", "cache:=none"])
    node = MatcherNode()
    other = rclpy.create_node("asker")
    client = other.create_client(MatchContact, "match_contact")
    publisher = other.create_publisher(SceneObjectArray, "objects", qos.LATCHED)
    executor = MultiThreadedExecutor(6)
    executor.add_node(node)
    executor.add_node(other)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    until(client.service_is_ready)
    items = [
        shapes.make(family, 4).as_object(family, transforms.make(translation=(0.4, 0.1 * k, 0.02)))
        for k, family in enumerate(("caliper", "cylinder", "l_hook"))
    ]

    class Graph:
        def ask(self, **fields):
            return self.start(**fields)()

        def start(self, **fields):
            future = client.call_async(MatchContact.Request(**fields))

            def wait():
                until(future.done)
                return future.result()

            return wait

        def show(self, *others):
            shown = Scene((*items, *others), np.array([0, 0, 1.0, 0]))
            publisher.publish(conversions.scene_to_msg(shown))
            until(lambda: node._scene is not None and len(node._scene.objects) == len(shown.objects))

    yield Graph()
    executor.shutdown()
    thread.join(5)
    node.destroy_node()
    other.destroy_node()
    rclpy.try_shutdown()


def image_request(demonstration, **changes):
    view = conversions.view_to_msg(demonstration.tool_view)
    for name, value in changes.items():
        setattr(view, name, value)
    return view


def test_before_any_objects_the_answer_says_so(graph):
    answer = graph.ask(strategy="test", tool_ids=["l_hook"])
    assert answer.code == Code.UNKNOWN_OBJECT and "none received" in answer.message


def test_images_need_no_objects(graph, demonstration):
    answer = graph.ask(strategy="test", tool_views=[image_request(demonstration)], want_heatmap=True, top_k=2)
    assert answer.code == Code.OK, answer.message
    assert 1 <= len(answer.candidates) <= 2 and not answer.candidates[0].has_target and np.isnan(answer.candidates[0].point.x)
    assert np.hypot(*(np.array(answer.candidates[0].tool.pixel) - demonstration.tool_contact.pixel)) < 10
    assert answer.heatmap.encoding == "32FC1" and answer.heatmap.width == 384
    assert answer.features == "embedded" and answer.seconds > 0


def test_by_ids(graph):
    graph.show()
    answer = graph.ask(strategy="test", tool_ids=["l_hook"], target_id="cylinder")
    assert answer.code == Code.OK, answer.message
    best = answer.candidates[0]
    assert best.tool_id == "l_hook" and best.has_target and answer.target_id == "cylinder"
    assert abs(best.point.x - 0.4) < 0.3 and abs(best.point.z - 0.02) < 0.01
    assert answer.heatmap.width == 0
    scores = [c.score for c in answer.candidates]
    assert scores == sorted(scores, reverse=True)


def test_what_blocks_every_way_is_named_whether_the_tool_stands_there_or_a_picture_shows_it(graph, demonstration):
    graph.show()
    fields = ({"tool_ids": ["l_hook"]}, {"tool_views": [image_request(demonstration)]})
    for tool in fields:
        answer = graph.ask(strategy="led", target_id="cylinder", **tool)
        assert answer.code == Code.OK, answer.message
    walls = []
    for angle in range(-40, 41, 10):
        place = transforms.from_rpy(0, 0, np.deg2rad(angle))[:3, :3] @ [-0.16, 0.0, 0.0] + [0.4, 0.1, 0.02]
        walls.append(shapes.make("cylinder", 1, radius=0.02).as_object(f"wall_{angle}", transforms.make(translation=place)))
    graph.show(*walls)
    for tool in fields:
        answer = graph.ask(strategy="led", target_id="cylinder", **tool)
        assert answer.code == Code.WAY_BLOCKED and "wall_" in answer.message, answer.message
    graph.show()


def test_choosing_tool_and_target(graph):
    graph.show()
    answer = graph.ask(strategy="test")
    assert answer.code == Code.OK and answer.target_id == "cylinder"
    assert {c.tool_id for c in answer.candidates} == {"caliper", "l_hook"}


def test_every_failure_has_its_code(graph, demonstration):
    graph.show()
    view = conversions.view_to_msg(demonstration.tool_view)
    empty = image_request(demonstration, mask=conversions.image_to_msg(np.zeros((384, 384), bool), "mono8"))
    wrong = image_request(demonstration, mask=conversions.image_to_msg(np.ones((10, 10), bool), "mono8"))
    for fields, code in (
        ({"strategy": ""}, Code.UNKNOWN_STRATEGY),
        ({"strategy": "juggling"}, Code.UNKNOWN_STRATEGY),
        ({"strategy": "/nowhere/at/all"}, Code.UNKNOWN_STRATEGY),
        ({"strategy": "broken"}, Code.BAD_STRATEGY),
        ({"strategy": "test", "tool_ids": ["spoon"]}, Code.UNKNOWN_OBJECT),
        ({"strategy": "test", "target_id": "spoon"}, Code.UNKNOWN_OBJECT),
        ({"strategy": "test", "tool_ids": ["l_hook"], "target_id": "l_hook"}, Code.BAD_REQUEST),
        ({"strategy": "test", "tool_ids": ["l_hook"], "tool_views": [view]}, Code.BAD_REQUEST),
        ({"strategy": "test", "tool_views": [empty]}, Code.EMPTY_MASK),
        ({"strategy": "test", "tool_views": [wrong]}, Code.BAD_REQUEST_IMAGE),
        ({"strategy": "test", "tool_views": [image_request(demonstration, kind="upside")]}, Code.BAD_REQUEST_IMAGE),
        ({"strategy": "test", "tool_views": [image_request(demonstration, metres_per_pixel=-1.0)]}, Code.BAD_REQUEST_IMAGE),
    ):
        answer = graph.ask(**fields)
        assert answer.code == code, (fields.get("strategy"), answer.code, answer.message)
        assert answer.message and not answer.candidates


def test_concurrent_requests_get_their_own_answers(graph):
    graph.show()
    alone = {name: graph.ask(strategy="test", tool_ids=[name], target_id="cylinder") for name in ("l_hook", "caliper")}
    waiting = [(name, graph.start(strategy="test", tool_ids=[name], target_id="cylinder")) for name in ("l_hook", "caliper") * 4]
    for name, wait in waiting:
        answer = wait()
        assert answer.code == Code.OK and {c.tool_id for c in answer.candidates} == {name}
        assert [c.score for c in answer.candidates] == [c.score for c in alone[name].candidates]


@pytest.mark.parametrize(
    ("name", "value", "code"), [("features", "resnet", Code.BAD_REQUEST), ("features", "dinov2", Code.FEATURE_WEIGHTS)]
)
def test_bad_parameters_keep_the_node_from_starting(graph, monkeypatch, name, value, code):
    with pytest.raises(MagicError) as caught:
        _with_parameter(monkeypatch, name, value)
    assert caught.value.code == code


def _with_parameter(monkeypatch, name, value):
    from rclpy.node import Node

    original = Node.__init__
    monkeypatch.setattr(
        Node,
        "__init__",
        lambda self, node_name, **rest: original(
            self, "second", parameter_overrides=[Parameter(name, value=value)], use_global_arguments=False, **rest
        ),
    )
    MatcherNode().destroy_node()
