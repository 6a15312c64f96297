"""What the demo measures and makes of answers, without any node."""

import errno
import os
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.task import Future

from magic_bags.recording import Recording
from magic_bringup import report
from magic_bringup.demo import Pending, first_images, look_into, main, parse, perceive_seconds
from magic_core import conversions
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError

LEFT = [f"/camera/left/{part}/camera_info" for part in ("color", "aligned_depth_to_color")]
RIGHT = [topic.replace("left", "right") for topic in LEFT]


@pytest.mark.parametrize(
    "heard, objects_at, seconds",
    [
        ({**dict(zip(LEFT, (1.0, 1.5))), **dict(zip(RIGHT, (1.1, 1.3)))}, 3.0, 1.7),  # right was whole first
        (dict(zip(LEFT, (1.0, 1.5))), 3.0, 1.5),  # right was never whole
        (dict(zip(LEFT, (1.0, 3.5))), 3.0, 2.0),  # objects before this node had heard a whole set
        (dict(zip(LEFT, (3.1, 3.5))), 3.0, 2.5),  # and before it had heard anything: since the replay began
        ({}, 3.0, 2.5),
    ],
)
def test_perceive_is_never_less_than_it_took(heard, objects_at, seconds):
    assert perceive_seconds(heard, LEFT + RIGHT, objects_at, replay_at=0.5) == pytest.approx(seconds)


def test_a_refused_goal_is_an_answer():
    """A server that is about to end takes no goals; waiting for a result would last as long as a whole run may."""
    sent = Future()
    pending = Pending(SimpleNamespace(changed=threading.Condition()), sent)
    assert pending.result is None
    sent.set_result(SimpleNamespace(accepted=False))
    assert (pending.result.code, pending.result.verified) == (Code.SERVER_UNAVAILABLE, False)


def test_a_page_that_cannot_be_written_is_not_named_nor_is_an_older_one_left(tmp_path, monkeypatch, capsys):
    def full(*_given):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (tmp_path / "report.html").write_text("of a run before")
    monkeypatch.setattr(report, "save", full)
    assert main(["--bag", str(tmp_path / "none"), "--out", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "summary: " in said.out and "report: " not in said.out and not (tmp_path / "report.html").exists()
    assert said.err == f"demo: cannot write into {tmp_path}: No space left on device\n"


def test_what_the_command_line_names_is_looked_for_before_anything_starts(tmp_path, capsys):
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("/**:\n  ros__parameters:\n    rate: 2.0\n")
    bad.write_text("rate: 2.0\n")
    options = parse(
        [
            "--perception-params",
            str(good),
            "--robot-params",
            str(good),
            "--cameras",
            "wrist",
            "--topics",
            "/rgb:=/camera/wrist/color/image_raw",
        ]
    )
    assert options.cameras == ("wrist",) and options.topics == (("/rgb", "/camera/wrist/color/image_raw"),)
    assert options.files["perception"] == [good, good] and options.files["planner"] == [good] and "matcher" not in options.files
    for words in (
        ["--server-params", str(tmp_path / "none.yaml")],
        ["--robot-params", str(bad)],
        ["--topics", "rgb"],
        ["--topics", "/a:=b"],
        ["--launch", str(tmp_path / "none.launch.xml")],
        ["--launch", str(good), "features:=embedded", "--features", "embedded"],
    ):
        with pytest.raises(SystemExit) as caught:
            parse(words)
        assert caught.value.code == 2 and words[0] in capsys.readouterr().err


def test_weights_and_a_launch_file_are_taken_whole(tmp_path, monkeypatch):
    """Nodes have another working directory: folders become absolute, names of a hub stay as they are."""
    (tmp_path / "dino").mkdir()
    (tmp_path / "own.launch.xml").write_text("<launch/>")
    monkeypatch.chdir(tmp_path)
    assert parse(["--weights", "dino"]).weights == str(tmp_path / "dino")
    assert parse(["--features", "dinov2", "--weights", "facebook/dinov2-base"]).weights == "facebook/dinov2-base"
    options = parse(["--root", "/r", "--launch", "own.launch.xml", "robot:=my arm"])
    assert options.launch == (str(tmp_path / "own.launch.xml"), "robot:=my arm")
    assert options.command == "bash ros2_ws/demo.sh --launch own.launch.xml 'robot:=my arm'"


def test_topics_of_other_names_and_compressed_images_are_those_of_a_camera(tmp_path):
    cv2 = pytest.importorskip("cv2")
    from sensor_msgs.msg import CompressedImage

    picture = np.full((8, 9, 3), (200, 30, 40), np.uint8)
    png = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    with Recording(tmp_path / "bag") as bag:
        bag.write(
            "/rgb/compressed", CompressedImage(header=conversions.header("c", 1.0), format="rgb8; png compressed bgr8", data=png), 1.0
        )
        bag.write("/info", conversions.intrinsics_to_msg(Intrinsics(9, 8, 5.0, 5.0, 4.0, 4.0)), 1.2)
    topics = (("/rgb/compressed", "/camera/w/color/image_raw/compressed"), ("/info", "/camera/w/color/camera_info"))
    assert look_into(tmp_path / "bag", topics, ["w"]) == (("/camera/w/color/camera_info",), pytest.approx(0.2))
    (found,) = first_images(tmp_path / "bag", topics).items()
    assert found[0] == "/camera/w/color/image_raw" and (conversions.color_from_msg(found[1]) == picture).all()
    for wrong in ({"topics": (("/none", "/a"),)}, {"cameras": ["w"]}):
        with pytest.raises(MagicError) as caught:
            look_into(tmp_path / "bag", **wrong)
        assert caught.value.code is Code.BAD_BAG and "/info" in caught.value.message
