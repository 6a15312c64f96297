"""The graph from a terminal, against the strategy server and stand-ins of the other nodes."""

import os
import signal
import threading

import numpy as np
import pytest
from sensor_msgs.msg import Image

from magic_bringup import client, report
from magic_core import conversions, qos
from magic_core import strategy as strategies
from magic_core.errors import Code
from magic_core.remedies import REMEDIES
from magic_interfaces.action import VerifyMotion
from magic_interfaces.msg import SceneObjectArray
from magic_server.testing import fakes
from magic_server.testing.bench import Bench


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("strategies")
    strategies.save(fakes.strategy("fake"), root / "fake")
    return root


@pytest.fixture(scope="module")
def bench(folder):
    made = Bench(folder)
    made.fakes.publish(fakes.scene())
    yield made
    made.close()


@pytest.fixture
def magic(bench, capsys, monkeypatch):
    """Runs a command line in the bench's domain: (exit status, lines)."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(bench.context.get_domain_id()))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    def call(*arguments):
        status = client.main(list(arguments))
        return status, capsys.readouterr().out.splitlines()

    return call


def test_a_run_is_told_in_a_screenful(magic, tmp_path):
    status, lines = magic("run", "fake", "--variant", "fg", "--out", str(tmp_path / "pictures"))
    assert status == 0, lines
    told = [line for line in lines if not line.startswith("[")]
    assert told[0].startswith("VERIFIED: OK (0): ")
    assert any("s] verify: " in line for line in lines)
    assert any(line.startswith("  tool       object_") for line in told)
    assert len(told) <= 20
    assert max(map(len, told)) < 400


def test_a_live_run_has_a_report_with_what_the_cameras_see(magic, bench, tmp_path):
    picture = conversions.image_to_msg(np.full((48, 64, 3), 90, np.uint8), "rgb8")
    publisher = bench.node.create_publisher(Image, "/camera/left/color/image_raw", qos.SENSOR)
    timer = bench.node.create_timer(0.05, lambda: publisher.publish(picture))
    bench.fakes.on_verify, before = delayed(bench.fakes.on_verify, 1.5), bench.fakes.on_verify
    try:
        status, lines = magic("run", "fake", "--variant", "fg", "--out", str(tmp_path / "run"))
    finally:
        bench.fakes.on_verify = before
        bench.node.destroy_timer(timer)
        bench.node.destroy_publisher(publisher)
    assert status == 0, lines
    assert f"  report     {tmp_path / 'run' / 'report.html'}" in lines
    page = (tmp_path / "run" / "report.html").read_text()
    assert "left: colour, 64 x 48" in page and "object_1 (" in page and "could not be drawn" not in page
    assert "ros2 run magic_bringup magic run fake --variant fg --out" in page
    again = report.load(tmp_path / "run")
    assert again.summary["success"] and list(again.images) == ["/camera/left/color/image_raw"] and again.scene.objects


def delayed(answer, seconds):
    """An answer that comes later: a real verification takes its time, too."""

    def late(goal, canceled):
        threading.Event().wait(seconds)
        return answer(goal, canceled)

    return late


def test_a_refused_run_says_why(magic, bench):
    bench.fakes.on_verify, before = (
        (lambda goal, canceled: VerifyMotion.Result(code=int(Code.DRIFT), message="it slid off")),
        bench.fakes.on_verify,
    )
    try:
        status, lines = magic("run", "fake", "--variant", "fg")
    finally:
        bench.fakes.on_verify = before
    assert status == 1
    assert any(line.startswith("not verified: ") for line in lines)
    assert f"  to do      {REMEDIES[Code.NO_CANDIDATE_SUCCEEDED].mend}" in lines
    assert any(line.startswith("  dropped    0: object_") and "DRIFT: it slid off" in line for line in lines)
    assert magic("run", "none_such")[0] == 1


def test_an_interrupt_cancels_the_run(magic, bench):
    bench.fakes.on_verify, before = fakes.FakeServers.until_canceled(VerifyMotion.Result()), bench.fakes.on_verify

    def interrupt():
        bench.fakes.started.wait(30.0)
        while "verify_motion" not in [name for name, _ in bench.fakes.goals[first:]]:
            bench.fakes.started.wait(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    first = len(bench.fakes.goals)
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        status, lines = magic("run", "fake", "--variant", "fg")
    finally:
        bench.fakes.on_verify = before
        thread.join()
    assert status == 130
    assert lines[-1].startswith("CANCELED (502)")
    assert bench.fakes.canceled_goals[-1] == "verify_motion"


def test_matches_and_objects_are_tables(magic, bench):
    status, lines = magic("match", "fake", "--top-k", "2")
    assert status == 0
    assert lines[0].startswith("OK (0)")
    assert any(line.split()[:1] == ["object_1"] for line in lines)
    status, lines = magic("objects")
    assert status == 0
    assert lines[0].startswith("2 objects in ")
    assert "50 x 50 x 50" in lines[2]


def test_what_keeps_an_object_from_being_a_tool_stands_beside_it():
    message = conversions.scene_to_msg(fakes.scene())
    message.objects[0].cut_off, message.objects[1].hanging = ["picture"], True
    message.notes = ["cameras disagree by 4 mm"]
    lines = client.object_lines(message, 3.0)
    assert lines[2].endswith("cut off by picture")
    assert lines[3].endswith("hangs above the table")
    assert lines[-1] == "  note: cameras disagree by 4 mm"
    assert " s ago" in lines[0] and "bag" in client.object_lines(message, None)[0]  # a recording's stamps are years old


def test_strategies_are_listed_and_so_is_one_that_cannot_be_used(folder, capsys, tmp_path):
    assert client.main(["strategies", "--folder", str(folder)]) == 0
    assert "a stand-in" in capsys.readouterr().out
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "strategy.yaml").write_text("name: broken")
    assert client.main(["strategies", "--folder", str(tmp_path)]) == 0
    assert "broken         cannot be used: " in capsys.readouterr().out
    assert client.main(["strategies", "--folder", str(tmp_path / "broken")]) == 1


def test_the_doctor_names_what_is_missing_and_how_to_start_it(magic, bench):
    """Perception's stand-in publishes objects, so that nothing is missing; with a second one there is one too many."""
    status, lines = magic("doctor", "--timeout", "20")
    assert status == 0, lines
    assert lines[-1] == "nothing is missing"
    assert sum(line.startswith("ok    ") and line.endswith(" is there") for line in lines) == 5
    second = bench.node.create_publisher(SceneObjectArray, "objects", qos.LATCHED)
    try:
        status, lines = magic("doctor", "--timeout", "0")
    finally:
        bench.node.destroy_publisher(second)
    assert status == 1
    assert "FAIL  perception (/objects) is there 2 times" in lines
    assert lines[-1] == "1 to mend"


def test_the_doctor_of_an_empty_domain(capsys, monkeypatch):
    from magic_core.domain import free_domain

    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_domain()))
    assert client.main(["doctor", "--timeout", "0"]) == 1
    out = capsys.readouterr().out
    assert out.count("is not there") == 5
    assert "mend: ros2 run magic_matcher matcher, or all at once: ros2 launch magic_bringup magic.launch.xml" in out


def test_wrong_arguments_are_told_and_nothing_is_asked(capsys):
    with pytest.raises(SystemExit) as ended:
        client.main(["run"])
    assert ended.value.code == 2
