"""The bag player and recorder: what goes through them comes out byte for byte, with its QoS; bad bags are refused in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from magic_bags import bag_file, bag_qos
from magic_bags.bag_player import Player, PlayOptions
from magic_bags.bag_recorder import RecordOptions
from magic_core.domain import free_domain
from magic_core.errors import Code, MagicError
from magic_core.qos import LATCHED, SENSOR

DOMAIN = str(free_domain(for_good=True))
FOREVER = QosTime(9223372036, 854775807)


def profile(reliable: bool, latched: bool, depth: int = 5) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        FOREVER,
        FOREVER,
        QosLiveliness.AUTOMATIC,
        FOREVER,
        False,
    )


def image(number: int) -> bytes:
    message = Image(height=4, width=6, encoding="16UC1", step=12, data=bytes([number] * 48))
    message.header.stamp = Time(sec=number)
    message.header.frame_id = "left_color_optical_frame"
    return serialize_message(message)


def static_transforms() -> bytes:
    transform = TransformStamped(child_frame_id="left_color_optical_frame")
    transform.header.frame_id = "panda_link0"
    transform.transform.rotation.w = 1.0
    return serialize_message(TFMessage(transforms=[transform]))


#: topic, type, profile, stamps in ns from 100 s, messages
CONTENT = [
    ("/camera/left/color/image_raw", "sensor_msgs/msg/Image", profile(False, False), [(i * 50_000_000, image(i)) for i in range(10)]),
    ("/tf_static", "tf2_msgs/msg/TFMessage", profile(True, True), [(0, static_transforms()), (1, static_transforms())]),
]


@pytest.fixture(params=["storage", "message", "file", "none"])
def compression(request: pytest.FixtureRequest) -> str:
    return request.param


def write(path: Path, compression: str = "storage") -> Path:
    writer = bag_file.BagWriter(path, "mcap", compression)
    for topic, kind, qos, _ in CONTENT:
        writer.add_topic(topic, kind, (qos,))
    for stamp, topic, data in sorted((stamp, topic, data) for topic, _, _, messages in CONTENT for stamp, data in messages):
        writer.write(topic, 100 * 10**9 + stamp, data)
    writer.close()
    return path


def content(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with bag_file.open_bag(path) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def expected() -> dict[str, list[bytes]]:
    return {topic: [data for _, data in messages] for topic, _, _, messages in CONTENT}


def test_a_written_bag_is_read_back_byte_for_byte(tmp_path: Path, compression: str) -> None:
    bag = write(tmp_path / "bag", compression)
    assert content(bag) == expected()
    info = bag_file.info(bag)
    assert (info.storage, info.count, info.start, info.end) == ("mcap", 12, 100 * 10**9, 100 * 10**9 + 450_000_000)
    assert {t.name: t.qos for t in info.topics} == {topic: (qos,) for topic, _, qos, _ in CONTENT}
    text = info.format()
    assert "Topic: /tf_static | Type: tf2_msgs/msg/TFMessage | Count: 2 | Serialization Format: cdr" in text
    assert "Duration:          0.450000000s" in text


def test_type_hashes_are_those_of_jazzy() -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in ("tf2_msgs/msg/TFMessage", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"):
        definition, digest = bag_file.message_definition(kind)
        assert digest == store.hash_rihs01(kind)
        assert definition.count("MSG: ") >= 1


def test_offered_profile_keeps_latched_topics_latched() -> None:
    latched = bag_qos.offered([profile(True, True, depth=0)], 7)
    assert (latched.durability, latched.reliability, latched.depth) == (DurabilityPolicy.TRANSIENT_LOCAL, ReliabilityPolicy.RELIABLE, 7)
    sensor = bag_qos.offered([profile(False, False, depth=0)], 1000)
    assert (sensor.durability, sensor.reliability, sensor.depth) == (DurabilityPolicy.VOLATILE, ReliabilityPolicy.BEST_EFFORT, 10)
    # One latched publisher of two does not make the topic latched: the other's messages were not.
    assert bag_qos.offered([profile(True, True), profile(True, False)], 3).durability == DurabilityPolicy.VOLATILE
    assert bag_qos.offered([], 3) == QoSProfile(depth=10)


@pytest.fixture
def node():
    rclpy.init(domain_id=int(DOMAIN))
    node = rclpy.create_node("bag_test")
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def environment() -> dict[str, str]:
    return {**os.environ, "ROS_DOMAIN_ID": DOMAIN, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}


def test_record_what_is_published(node, tmp_path: Path) -> None:
    """A recording of live topics: every message after the discovery, byte for byte, and the QoS that the publishers offer."""
    images = node.create_publisher(Image, "/camera/left/color/image_raw", SENSOR)
    words = node.create_publisher(String, "/words", LATCHED)
    words.publish(String(data="said before the recorder came"))
    bag = tmp_path / "recorded"
    command = [sys.executable, "-m", "magic_bags.bag_recorder", "-o", str(bag), "/camera/left/color/image_raw", "/words"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True) as recorder:
        deadline = time.monotonic() + 20
        while not (images.get_subscription_count() and words.get_subscription_count()):
            assert time.monotonic() < deadline and recorder.poll() is None, "the recorder did not subscribe"
            rclpy.spin_once(node, timeout_sec=0.05)
        for number in range(5):
            images.publish(image(number))
            rclpy.spin_once(node, timeout_sec=0.05)
        words.publish(String(data="the end"))
        assert words.wait_for_all_acked(rclpy.duration.Duration(seconds=10))
        recorder.send_signal(signal.SIGINT)
        assert recorder.wait(20) == 0, recorder.stderr.read()
    found = content(bag)
    assert found["/camera/left/color/image_raw"] == [image(n) for n in range(5)]
    # The middleware pads a message's end to four bytes: strings are compared decoded.
    assert [deserialize_message(data, String).data for data in found["/words"]] == ["said before the recorder came", "the end"]
    qos = {t.name: t.qos[0] for t in bag_file.info(bag).topics}
    assert qos["/words"].durability == QosDurability.TRANSIENT_LOCAL and qos["/words"].reliability == QosReliability.RELIABLE
    assert qos["/camera/left/color/image_raw"].reliability == QosReliability.BEST_EFFORT


def test_play_reaches_late_and_early_subscribers(node, tmp_path: Path) -> None:
    """Best-effort images arrive byte for byte in order and in time; a latched topic also reaches who subscribes afterwards."""
    bag = write(tmp_path / "bag")
    received: list[bytes] = []
    stamps: list[float] = []
    clocks: list[float] = []
    late: list[bytes] = []

    def take(data: bytes) -> None:
        received.append(data)
        stamps.append(time.monotonic())

    player_node = rclpy.create_node("player")
    node.create_subscription(Image, "/renamed", take, SENSOR, raw=True)
    node.create_subscription(Clock, "/clock", lambda m: clocks.append(m.clock.sec + m.clock.nanosec * 1e-9), 100)
    remap = (("/camera/left/color/image_raw", "/renamed"),)
    player = Player(player_node, PlayOptions(str(bag), rate=0.5, clock_hz=20.0, delay=1.0, remap=remap))
    import threading

    counts: list[int] = []
    thread = threading.Thread(target=lambda: counts.append(player.play()))
    thread.start()
    deadline = time.monotonic() + 20
    while thread.is_alive() or len(received) < 10:
        assert time.monotonic() < deadline
        rclpy.spin_once(node, timeout_sec=0.05)
    thread.join()
    assert counts == [12]
    assert received == expected()["/camera/left/color/image_raw"]
    # 0.45 s of bag at half rate; arrival jitter is the executor's.
    assert stamps[-1] - stamps[0] == pytest.approx(0.9, abs=0.25)
    assert len(clocks) >= 15 and clocks == sorted(clocks) and clocks[-1] <= 100.451
    node.create_subscription(
        TFMessage, "/tf_static", late.append, QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL), raw=True
    )
    while len(late) < 2:
        assert time.monotonic() < deadline, "the latched messages did not come"
        rclpy.spin_once(node, timeout_sec=0.05)
    assert late == expected()["/tf_static"]
    player_node.destroy_node()


def run_player(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "magic_bags.bag_player", *arguments]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=30)


def test_player_refuses_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "rubbish.mcap").write_bytes(b"no bag")
    bag_file.BagWriter(tmp_path / "nothing").close()
    for path, words in (("absent", "no such bag"), ("empty", "metadata.yaml"), ("rubbish.mcap", "cannot read"), ("nothing", "is empty")):
        result = run_player(str(tmp_path / path))
        assert result.returncode == 1
        assert words in result.stderr and str(Code.BAD_BAG.value) in result.stderr and path in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1


def long_bag(path: Path, count: int = 120) -> tuple[Path, list[bytes]]:
    """A bag of several chunks: its one file, and its messages."""
    writer = bag_file.BagWriter(path)
    writer.add_topic("/noise", "sensor_msgs/msg/Image", (profile(False, False),))
    messages = []
    for number in range(count):
        data = np.random.default_rng(number).integers(0, 256, 48 * 1024, dtype=np.uint8).tobytes()
        messages.append(serialize_message(Image(height=1, width=len(data), encoding="mono8", step=len(data), data=data)))
        writer.write("/noise", 10**9 + number * 10**7, messages[-1])
    writer.close()
    return next(path.glob("*.mcap")), messages


@pytest.mark.parametrize("share", [0.4, 0.7, 0.999])
@pytest.mark.parametrize("where", ["file", "folder", "folder with metadata"])
def test_a_bag_that_was_cut_off_is_played_as_far_as_it_goes(tmp_path: Path, share: float, where: str) -> None:
    file, messages = long_bag(tmp_path / "bag")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    if where != "folder with metadata":
        (tmp_path / "bag/metadata.yaml").unlink()
    bag = file if where == "file" else tmp_path / "bag"
    found = content(bag)["/noise"]
    assert found == messages[: len(found)]
    assert len(found) >= int(share * len(messages)) - 25, "more was lost than the last chunk"
    info = bag_file.info(bag)
    assert (info.count, info.topics[0].qos) == (len(found), (profile(False, False),))
    assert "was cut off" in info.note and str(len(found)) in info.note and info.note in info.format()


def test_a_whole_bag_and_rubbish_are_not_taken_for_bags_that_were_cut_off(tmp_path: Path) -> None:
    file, _ = long_bag(tmp_path / "bag", 3)
    assert bag_file.info(file).note == "" == bag_file.info(tmp_path / "bag").note
    data = file.read_bytes()
    for name, broken in (("early", data[:20]), ("flipped", data[:200] + bytes(100) + data[300:-8])):
        (tmp_path / f"{name}.mcap").write_bytes(broken)
        with pytest.raises(MagicError) as caught, bag_file.open_bag(tmp_path / f"{name}.mcap") as reader:
            list(reader.messages())
            raise MagicError(Code.BAD_BAG, f"{reader.message_count} messages")  # an empty one is refused by who plays it
        assert caught.value.code is Code.BAD_BAG


def test_what_a_killed_recorder_leaves_of_several_files_is_answered_with_what_to_do(tmp_path: Path) -> None:
    file, _ = long_bag(tmp_path / "bag", 3)
    (tmp_path / "bag/metadata.yaml").unlink()
    (tmp_path / "bag/bag_1.mcap").write_bytes(file.read_bytes())
    with pytest.raises(MagicError, match="reindex"), bag_file.open_bag(tmp_path / "bag"):
        pass


def test_topics_are_renamed_from_the_command_line(node, tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    heard: list[bytes] = []
    node.create_subscription(Image, "/renamed", heard.append, SENSOR, raw=True)
    command = [sys.executable, "-m", "magic_bags.bag_player", str(bag), "-m", "/camera/left/color/image_raw:=/renamed", "-d", "1.0"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True) as player:
        deadline = time.monotonic() + 30
        while len(heard) < 10 and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.05)
        assert player.wait(20) == 0, player.stderr.read()
    assert heard == expected()["/camera/left/color/image_raw"]


def test_a_message_is_not_lost_by_a_signal_between_its_taking_and_its_writing(node, tmp_path: Path) -> None:
    """The signal comes while the recorder is at work on a message that it has taken already."""
    slow = (
        "import os, signal, sys, time\n"
        "from magic_bags import bag_recorder\n"
        "write = bag_recorder.BagWriter.write\n"
        "def slowly(self, *args):\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(0.2)\n"
        "    write(self, *args)\n"
        "bag_recorder.BagWriter.write = slowly\n"
        "bag_recorder.main(sys.argv[1:])\n"
    )
    words = node.create_publisher(String, "/words", LATCHED)
    words.publish(String(data="kept"))
    bag = tmp_path / "bag"
    result = subprocess.run(
        [sys.executable, "-c", slow, "-o", str(bag), "/words"], env=environment(), capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result.stderr
    assert [deserialize_message(data, String).data for data in content(bag)["/words"]] == ["kept"]


def test_bad_options_are_named(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    for options, words in ((["--rate", "0"], "rate"), (["--topics", "/nowhere"], "/nowhere"), (["--start-offset", "9"], "start_offset")):
        result = run_player(str(bag), *options)
        assert result.returncode == 1 and words in result.stderr and "Traceback" not in result.stderr
    with pytest.raises(MagicError) as caught:
        RecordOptions(output="x")
    assert caught.value.code == Code.BAD_REQUEST


def test_looping_player_ends_cleanly_on_signals(tmp_path: Path) -> None:
    bag = write(tmp_path / "bag")
    for number in (signal.SIGINT, signal.SIGTERM):
        command = [sys.executable, "-m", "magic_bags.bag_player", "--loop", "--clock", "--delay", "0.0", str(bag)]
        with subprocess.Popen(command, env=environment(), stderr=subprocess.PIPE, text=True) as player:
            rclpy.init(domain_id=int(DOMAIN))
            node = rclpy.create_node("listener")
            heard: list[Clock] = []
            node.create_subscription(Clock, "/clock", heard.append, 10)
            deadline = time.monotonic() + 20
            while not heard and time.monotonic() < deadline:
                rclpy.spin_once(node, timeout_sec=0.05)
            node.destroy_node()
            rclpy.try_shutdown()
            player.send_signal(number)
            assert player.wait(10) == 0 and heard
            assert "Traceback" not in player.stderr.read()
