"""A run is one MCAP that says what the run was."""

import json
from pathlib import Path

import numpy as np
import pytest

from magic_bags import bag_messages
from magic_bags.bag_file import info
from magic_bringup import run_bag
from magic_bringup.record import Record, empty_summary
from magic_core import conversions
from magic_core.robot import Description
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import CandidateReport
from magic_server.testing import fakes


def record(variant, verified=True):
    picture = conversions.image_to_msg(np.full((8, 8, 3), 90, np.uint8), "rgb8", conversions.header("left"))
    result = RunStrategy.Result(verified=verified, plan=conversions.plan_to_msg(fakes.plan(variant), "object_1"), film=picture)
    result.candidates = [
        CandidateReport(candidate=conversions.candidate_to_msg(fakes.candidate()), stage="verify", code=0, message=text)
        for text in ("no", "yes")
    ]
    scene = conversions.scene_to_msg(fakes.scene())
    return Record(empty_summary("hooking", variant), {"/camera/left/color/image_raw": picture}, scene, result)


@pytest.mark.parametrize("variant, verified", [("fg", True), ("arm", True), ("arm", False)])
def test_everything_of_a_run_is_in_it(tmp_path, variant, verified):
    given = record(variant, verified)
    path = run_bag.write(given, tmp_path)
    assert len(list(path.glob("*.mcap"))) == 1
    counts = {topic.name: topic.count for topic in info(path).topics}
    kept = {"arm": "/verified_trajectory", "fg": "/verified_tool_trajectory"}[variant]
    assert (kept in counts) == verified
    assert counts["/strategy/candidates"] == 2
    assert {"/objects", "/perception/markers", "/camera/left/color/image_raw", "/strategy/film", "/strategy/plan"} <= set(counts)
    read = {}
    for topic, stamp, message in bag_messages.messages(path):
        read.setdefault(topic, []).append((stamp, message))
    assert json.loads(read["/strategy/summary"][0][1].data) == given.summary
    assert [m.message for _, m in read["/strategy/candidates"]] == ["no", "yes"]
    assert [o.id for o in read["/objects"][0][1].objects] == ["object_1", "object_2"]
    assert ("/tf" in counts) == (variant == "arm")
    if variant == "arm":
        frames = {(t.header.frame_id, t.child_frame_id): conversions.transform_from_msg(t.transform) for t in read["/tf"][-1][1].transforms}
        robot = Description()
        joint = robot.arm[0]
        expected = joint.parent_from_joint @ joint.motion(0.2)  # where the plan ends
        np.testing.assert_allclose(frames[joint.parent, joint.child], expected, atol=1e-9)
        assert read["/tf"][-1][0] - read["/tf"][0][0] == pytest.approx(3e9, abs=1e8)
    again = run_bag.write(given, tmp_path)  # in place of the one that is there
    assert info(again).count == sum(counts.values())


def test_the_layout_for_foxglove_shows_topics_that_there_are(tmp_path):
    layout = json.loads((Path(__file__).resolve().parents[1] / "foxglove/magic.json").read_text())
    panels = layout["configById"]
    named = set(panels["3D!scene"]["topics"]) - {"/strategy/markers"}  # of the live graph
    named |= {panel["imageMode"]["imageTopic"] for key, panel in panels.items() if key.startswith("Image!")}
    named |= {panel["topicPath"].partition(".")[0] for key, panel in panels.items() if key.startswith("RawMessages!")}
    assert named <= {topic.name for topic in info(run_bag.write(record("arm"), tmp_path)).topics}

    def leaves(node):
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(panels)


def test_a_run_that_failed_has_what_there_is(tmp_path):
    path = run_bag.write(Record(empty_summary("hooking", "fg"), {}, None, RunStrategy.Result()), tmp_path)
    assert [topic.name for topic in info(path).topics] == ["/strategy/summary"]
