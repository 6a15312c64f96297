"""What the doctor concludes from what it has seen: every fault that is told of has its remedy, and a sound graph has none."""

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from sensor_msgs.msg import JointState

from magic_bringup import doctor
from magic_bringup.doctor import Seen, Topic
from magic_core import conversions
from magic_core.camera import Intrinsics
from magic_core.errors import Code
from magic_core.remedies import REMEDIES

COLOR, INFO, DEPTH = (f"/lab/camera/left/{part}" for part in ("color/image_raw", "color/camera_info", "aligned_depth_to_color/image_raw"))
NOW = 1000.0


def sound(now=NOW):
    """A graph in the namespace /lab with one camera, where nothing is missing."""
    header = conversions.header("left_optical", now - 0.1)
    seen = Seen("/lab", NOW)
    told = {"cameras": ["left"], "frame": "base", "aligned": True, "segmenter": "depth", "use_sim_time": False}
    seen.parameters = {
        "perception": told,
        "matcher": {"features": "auto", "weights": "", "device": "auto", "use_sim_time": False},
        "planner": {"robot.urdf": "", "robot.home": None, "use_sim_time": False},
        "strategy_server": {"execute": True, "trajectory_action": "arm/move", "gripper_action": "hand/close", "use_sim_time": False},
    }
    messages = {
        COLOR: conversions.image_to_msg(np.zeros((8, 9, 3), np.uint8), "rgb8", header),
        INFO: conversions.intrinsics_to_msg(Intrinsics(9, 8, 5.0, 5.0, 4.0, 4.0), header),
        DEPTH: conversions.image_to_msg(np.full((8, 9), 700, np.uint16), "16UC1", header),
    }
    for name, message in messages.items():
        seen.topics[name] = Topic((f"sensor_msgs/msg/{type(message).__name__}",), 1, 0, message)
    seen.joints = {f"panda_joint{n}" for n in range(1, 8)}
    seen.topics["/lab/joint_states"] = Topic(("sensor_msgs/msg/JointState",), 1, 1, JointState(header=header))
    seen.actions = {"arm/move": 1, "hand/close": 1}
    seen.transforms.set("base", "left_optical", np.eye(4), static=True)
    return seen


def told(seen):
    return [
        *doctor.clock_findings(seen),
        *(f for c in doctor.cameras_of(seen) for f in doctor.camera_findings(c, seen)),
        *doctor.fixture_findings(seen),
        *doctor.joint_findings(seen),
        *doctor.weight_findings(seen),
        *doctor.controller_findings(seen),
    ]


def test_a_sound_graph_has_nothing_to_mend():
    findings = told(sound())
    assert {f.level for f in findings} == {"ok"}, findings
    assert any("camera left" in f.text for f in findings)


def no(name):
    return lambda seen: seen.topics.pop(name)


def setting(node, key, value):
    return lambda seen: seen.parameters[node].update({key: value})


def message(name, **fields):
    return lambda seen: [setattr(seen.topics[name].message, key, value) for key, value in fields.items()]


@pytest.mark.parametrize(
    "harm, level, text, mend",
    [
        (no(COLOR), "FAIL", f"nobody publishes {COLOR}", "driver"),
        (no(DEPTH), "FAIL", f"nobody publishes {DEPTH}", "align_depth.enable:=true"),
        (lambda s: setattr(s.topics[COLOR], "types", ("std_msgs/msg/String",)), "FAIL", "is of type std_msgs/msg/String", "sensor_msgs/msg/Image"),
        (lambda s: setattr(s.topics[COLOR], "publishers", 2), "FAIL", "has 2 publishers", "all but one"),
        (lambda s: setattr(s.topics[INFO], "message", None), "FAIL", "is published, but nothing came", "ros2 topic hz"),
        (message(COLOR, encoding="bayer_rggb8"), "FAIL", "BAD_ENCODING", "rgb8"),
        (message(DEPTH, encoding="rgb8"), "FAIL", "BAD_ENCODING", "16UC1"),
        (message(INFO, k=[0.0] * 9), "FAIL", "BAD_INTRINSICS", "pixels"),
        (message(INFO, width=18), "FAIL", "image of 9 x 8, intrinsics of 18 x 8", "own resolution"),
        (message(COLOR, header=conversions.header("", NOW)), "FAIL", "frame_id is empty", "frame names"),
        (message(COLOR, header=conversions.header("left_optical", NOW - 60)), "FAIL", "60 s in the past", "clocks"),
        (message(COLOR, header=conversions.header("left_optical", NOW + 60)), "FAIL", "60 s in the future", "clocks"),
        (message(COLOR, header=conversions.header("elsewhere", NOW)), "note", "no pose in TF", "calibrate_cameras"),
        (setting("matcher", "use_sim_time", True), "FAIL", "use_sim_time is set for matcher and not", "use_sim_time:=true"),
        (lambda s: [p.update(use_sim_time=True) for p in s.parameters.values()], "FAIL", "nobody publishes /clock", "--clock"),
        (lambda s: s.topics.update({"/lab/known_objects": Topic((), 1, 1)}), "FAIL", "is not latched", "transient local"),
        (lambda s: s.joints.remove("panda_joint3"), "FAIL", "says nothing of panda_joint3", "robot_params"),
        (lambda s: s.joints.clear(), "FAIL", "nothing came on /lab/joint_states", "joint_state_broadcaster"),
        (setting("planner", "robot.urdf", "/none.urdf"), "FAIL", "/none.urdf", "describe_robot"),
        (lambda s: s.parameters["matcher"].update(features="dinov2", weights="/no/such/folder"), "FAIL", "no such folder", "`weights`"),
        (lambda s: s.actions.update({"arm/move": 0}), "FAIL", "the arm's controller (/lab/arm/move) is not there", "list_controllers"),
        (lambda s: s.actions.update({"hand/close": 2}), "FAIL", "is there 2 times", "all but one"),
    ],
)  # fmt: skip
def test_each_fault_is_told_with_its_remedy(harm, level, text, mend):
    seen = sound()
    harm(seen)
    faults = [f for f in told(seen) if f.level != "ok"]
    assert any(f.level == level and text in f.text and mend in f.mend for f in faults), faults
    assert all(f.mend for f in faults)


def test_without_execution_controllers_may_be_missing_and_a_bag_may_be_old():
    seen = sound(now=NOW - 500)
    seen.playing = True
    seen.parameters["strategy_server"]["execute"] = False
    seen.actions.clear()
    findings = told(seen)
    assert "FAIL" not in {f.level for f in findings}
    assert any("a bag is being played" in f.text for f in findings)
    assert any("nothing moves" in f.text for f in findings)


def test_an_image_that_comes_compressed_is_not_missing():
    seen = sound()
    seen.topics[COLOR + "/compressed"] = seen.topics.pop(COLOR)
    assert not [f for f in doctor.camera_findings("left", seen) if f.level == "FAIL"]


def test_a_topic_of_another_name_is_named():
    seen = sound()
    seen.topics["/rs/rgb"] = seen.topics.pop(COLOR)
    (fault,) = [f for f in doctor.camera_findings("left", seen) if f.text.startswith("nobody")]
    assert f"(remap: -r {COLOR}:=" in fault.mend and "/rs/rgb" in fault.mend


def test_what_nodes_say_comes_with_the_remedy_of_its_code():
    def say(name, level, text, **values):
        return DiagnosticStatus(name=name, level=level, message=text, values=[KeyValue(key=k, value=v) for k, v in values.items()])

    heard = [
        say("lab/perception: scene", DiagnosticStatus.ERROR, "no plane", code="NO_TABLE"),
        say("lab/perception: camera left", DiagnosticStatus.WARN, "[109 NO_TRANSFORM] frames"),
        say("lab/matcher: requests", DiagnosticStatus.OK, "3 answered"),
        say("other/matcher: requests", DiagnosticStatus.ERROR, "of another lab"),
    ]
    findings = doctor.diagnostic_findings({s.name: s for s in heard}, "/lab")
    assert [(f.level, f.mend) for f in findings] == [
        ("ok", ""),
        ("note", REMEDIES[Code.NO_TRANSFORM].mend),
        ("FAIL", REMEDIES[Code.NO_TABLE].mend),
    ]
