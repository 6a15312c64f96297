"""Bad input gets a code and a message that names the value and what is allowed, and no process dies."""

import json
import threading
import time

import numpy as np
import pytest

from magic_bags import bag_file
from magic_bringup import demo, record
from magic_bringup.testing import DEADLINE, Bench, camera_messages, feeding, started, until
from magic_core import conversions, shapes, transforms
from magic_core.errors import Code
from magic_core.executor import ThreadedExecutor
from magic_server.testing import fakes

DEPTH, COLOR, INFO = "/aligned_depth_to_color/image_raw", "/color/image_raw", "/color/camera_info"


@pytest.fixture(scope="module")
def messages():
    tool = shapes.make("l_hook", 1).mesh
    tool = tool.transformed(transforms.make(translation=[0.45, 0.0, -tool.bounds[0, 2]]))
    target = shapes.make("cylinder", 1).mesh
    target = target.transformed(transforms.make(translation=[0.6, 0.15, -target.bounds[0, 2]]))
    return camera_messages([tool, target])


@pytest.fixture(scope="module")
def empty_table():
    return camera_messages([])


def without(*parts):
    return lambda topic, message: None if topic.endswith(parts) else message


def encoding(part, name):
    def change(topic, message):
        if topic.endswith(part):
            message.encoding = name
        return message

    return change


def nan_depth(topic, message):
    if topic.endswith(DEPTH):
        return conversions.image_to_msg(np.full((480, 640), np.nan, np.float32), "32FC1", message.header)
    return message


def short_rows(topic, message):
    if topic.endswith(COLOR):
        message.step = 100
    return message


def no_focal_length(topic, message):
    if topic.endswith(INFO):
        message.k[0] = 0.0
    return message


def other_depth_size(topic, message):
    if topic.endswith(DEPTH):
        return conversions.image_to_msg(np.full((240, 320), 700, np.uint16), "16UC1", message.header)
    return message


@pytest.mark.parametrize(
    "change, code, says",
    [
        (without(DEPTH), Code.NO_FRAMES, ("aligned_depth_to_color/image_raw",)),
        (without("camera_info"), Code.NO_CAMERA_INFO, ("color/camera_info",)),
        (encoding(COLOR, "bayer_rggb8"), Code.BAD_ENCODING, ("bayer_rggb8", "rgb8")),
        (encoding(DEPTH, "64FC1"), Code.BAD_ENCODING, ("64FC1", "16UC1", "32FC1")),
        (nan_depth, Code.NO_DEPTH, ("aligned_depth_to_color/image_raw",)),
        (short_rows, Code.BAD_IMAGE, ("100", "1920")),
        (no_focal_length, Code.BAD_INTRINSICS, ("fx", "above 0")),
        (other_depth_size, Code.BAD_IMAGE, ("(240, 320)", "(480, 640)")),
        (without("tf_static"), Code.NO_TRANSFORM, ("left_color_optical_frame", "panda_link0")),
        (None, Code.NO_OBJECTS, ("stands on the table",)),
        ("nothing", Code.NO_FRAMES, ("image_raw",)),
    ],
    ids=["missing topic", "no camera_info", "colour encoding", "depth encoding", "all-NaN depth", "short rows", "no focal length", "depth size", "no tf", "empty table", "silence"],
)  # fmt: skip
def test_bad_frames(tmp_path, messages, empty_table, change, code, says):
    source, function = (empty_table, without("no such topic")) if change is None else (messages, change)
    if change == "nothing":
        function = without("")
    # One camera, and a goal sent once perception has made up its mind: the outcome does not hang on how fast this machine is.
    source = {topic: message for topic, message in source.items() if "right" not in topic}
    parameters = {"strategy_server": {"objects_timeout": 1.5}, "perception": {"cameras": "[left]"}}
    with started(tmp_path, parameters=parameters, leave_out=("matcher", "planner", "verifier")) as bench, stand_ins():
        bench.ready()
        with feeding(source, function):
            bench.diagnosed(code, says)
            result = bench.run()
            assert result.code == code, f"{Code(result.code).name}: {result.message}"
            assert all(s in result.message for s in says), result.message
            assert not result.verified
            bench.graph.check()


class stand_ins:
    """Matcher, planner and verifier that need nothing, so that each case only starts what it tests; perception is the true one."""

    def __enter__(self):
        self.node = fakes.FakeServers(services=("match", "plan", "verify"))
        self.executor = ThreadedExecutor(4)
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()
        return self.node

    def __exit__(self, *_):
        self.executor.shutdown(timeout_sec=2.0)
        self.node.destroy_node()
        self.thread.join(2.0)


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def test_the_demo_on_an_empty_bag(tmp_path, capsys):
    writer = bag_file.BagWriter(tmp_path / "bag")
    writer.add_topic("/camera/left/color/image_raw", "sensor_msgs/msg/Image")
    writer.close()
    out = tmp_path / "out"
    assert demo.main(["--bag", str(tmp_path / "bag"), "--out", str(out)]) == 1
    summary = summary_of(out)
    assert list(summary) == list(record.empty_summary("hooking", "arm"))
    assert summary["code"] == Code.BAD_BAG
    assert "empty" in summary["message"]
    assert str(tmp_path / "bag") in summary["message"]
    assert "111 BAD_BAG" in (out / "report.html").read_text()
    assert str(out / "summary.json") in capsys.readouterr().out


def test_the_demo_without_a_bag_and_with_an_unknown_strategy(tmp_path):
    assert demo.main(["--bag", str(tmp_path / "none"), "--out", str(tmp_path / "a")]) == 1
    assert summary_of(tmp_path / "a")["code"] == Code.BAD_BAG
    assert demo.main(["--strategy", "juggling", "--out", str(tmp_path / "b")]) == 1
    summary = summary_of(tmp_path / "b")
    assert summary["code"] == Code.UNKNOWN_STRATEGY
    assert "hooking" in summary["message"]


@pytest.fixture(scope="module")
def bench(tmp_path_factory, messages):
    """The real graph on a good scene, with short timeouts."""
    parameters = {"strategy_server": {"verify_timeout": 4.0, "grace": 1.0, "server_timeout": 2.0}}
    with started(tmp_path_factory.mktemp("logs"), parameters=parameters) as found:
        found.ready()
        with feeding(messages):
            until(lambda: found.watcher.scene is not None and len(found.watcher.scene.objects) >= 2, what="two objects are seen")
            yield found


@pytest.mark.parametrize(
    "goal, code, says",
    [
        ({"strategy": "juggling"}, Code.UNKNOWN_STRATEGY, ("juggling", "hooking", "hanging", "scooping")),
        ({"target": "object_99"}, Code.UNKNOWN_OBJECT, ("object_99", "object_1")),
        ({"tool": "object_99"}, Code.UNKNOWN_OBJECT, ("object_99", "object_1")),
        ({"variant": "legs"}, Code.UNKNOWN_VARIANT, ("legs", "fg", "arm")),
    ],
)
def test_bad_goals(bench: Bench, goal, code, says):
    result = bench.run(**goal)
    assert result.code == code, result.message
    assert all(s in result.message for s in says), result.message
    bench.graph.check()


def test_a_request_with_an_image_of_the_wrong_size(bench: Bench):
    from magic_interfaces.srv import MatchContact

    client = bench.watcher.node.create_client(MatchContact, "match_contact")
    try:
        assert client.wait_for_service(DEADLINE)
        view = conversions.view_to_msg(fakes.view())
        view.mask = conversions.image_to_msg(np.ones((10, 12), bool), "mono8")
        request = MatchContact.Request(strategy="hooking", tool_views=[view], target_view=conversions.view_to_msg(fakes.view()))
        future = client.call_async(request)
        until(future.done, what="the matcher answers")
        response = future.result()
        assert response.code == Code.BAD_REQUEST_IMAGE, response.message
        assert "64" in response.message
        assert "10" in response.message
        bench.graph.check()
    finally:
        bench.watcher.node.destroy_client(client)


def test_a_dead_verifier_is_named_within_its_timeout(bench: Bench):
    """The last test on this graph: it kills the verifier."""
    import signal

    process = bench.graph.processes["verifier"]
    process.stopped = True  # its death is no surprise
    process.signal(signal.SIGKILL)
    process.wait(DEADLINE)
    begin = time.monotonic()
    result = bench.run(variant="fg")
    assert result.code in (Code.SERVER_UNAVAILABLE, Code.SERVER_TIMEOUT), f"{Code(result.code).name}: {result.message}"
    assert "verifier" in result.message
    assert "verify_motion" in result.message
    # Match and plan before it, then verify_timeout and grace.
    assert time.monotonic() - begin < 30.0
    assert not result.verified
    bench.graph.check()
