"""The report: complete for a full record, and whole even where parts are missing or broken."""

import re

import numpy as np
import pytest

from magic_bringup import fakes, report
from magic_bringup.demo import Options, candidate_summary, empty_summary
from magic_bringup.record import Record
from magic_core import conversions
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import CandidateReport


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("strategies") / "fake"
    strategies.save(fakes.strategy(), path)
    return path


def full(folder, tmp_path, variant="arm"):
    record = Record(empty_summary(Options(str(folder), variant, tmp_path, tmp_path)))
    result = RunStrategy.Result(code=0, verified=True, tool_id="object_1", target_id="object_2")
    result.plan = conversions.plan_to_msg(fakes.plan(variant), "object_1")
    result.candidates = [
        CandidateReport(
            candidate=conversions.candidate_to_msg(fakes.candidate()),
            reflection="keep",
            stage="verify",
            code=int(code),
            message="why <b>so</b>",
        )
        for code in (Code.DRIFT, Code.OK)
    ]
    result.heatmap = conversions.image_to_msg(np.random.default_rng(0).random((64, 64)).astype(np.float32), "32FC1")
    result.film = conversions.image_to_msg(np.zeros((40, 80, 3), np.uint8), "rgb8")
    record.result = result
    record.scene = conversions.scene_to_msg(fakes.scene())
    color = np.full((48, 64, 3), 90, np.uint8)
    depth = np.full((48, 64), 700, np.uint16)
    depth[:8] = 0
    record.images = {
        "/camera/left/color/image_raw": conversions.image_to_msg(color, "rgb8"),
        "/camera/left/aligned_depth_to_color/image_raw": conversions.image_to_msg(depth, "16UC1"),
    }
    record.summary.update(success=True, code=0, message="passed", candidates=[candidate_summary(r) for r in result.candidates])
    return record


@pytest.mark.parametrize("variant", ["arm", "fg"])
def test_a_full_report_is_self_contained(folder, tmp_path, variant):
    page = report.render(full(folder, tmp_path, variant))
    assert "could not be drawn" not in page
    for title in (
        "What the cameras saw",
        "From the demonstrated contact",
        "What was reconstructed",
        "Simulation",
        "Candidates",
        "Time and memory",
    ):
        assert title in page
    assert ("Joints" if variant == "arm" else "Motion of the tool") in page
    # Nothing is fetched from elsewhere, and what nodes say is not taken for markup.
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert "<b>so</b>" not in page
    assert page.count("data:image/") >= 9


def test_a_run_that_never_began_has_a_report_too(tmp_path):
    record = Record(empty_summary(Options("hooking", "arm", tmp_path, tmp_path)))
    record.summary.update(code=int(Code.BAD_BAG), message="the bag is empty")
    page = report.render(record)
    assert "111 BAD_BAG" in page
    assert "the bag is empty" in page


def test_broken_parts_leave_the_others_alone(folder, tmp_path):
    record = full(folder, tmp_path)
    record.images["/camera/left/color/image_raw"].encoding = "bayer_rggb8"
    record.result.film.step = 1
    page = report.render(record)
    assert "bayer_rggb8" in page
    assert "could not be drawn" in page
    assert "What was reconstructed" in page


def test_a_record_comes_back_from_disk(folder, tmp_path):
    import json

    record = full(folder, tmp_path)
    (tmp_path / "summary.json").write_text(json.dumps(record.summary))
    report.save(record, tmp_path)
    again = report.load(tmp_path)
    assert report.render(again) == report.render(record)
    with pytest.raises(MagicError):
        report.load(tmp_path / "nothing")


def test_the_circle_of_curvature_lies_on_the_right_side(folder):
    strategy = strategies.load(folder)
    view, contact = strategy.tool_view, strategy.tool_contact
    picture = report.contact_picture(view, contact)
    # Convex with r = 20 mm at 0.1 m over 64 pixels: the circle's far end lies 40 mm inwards (left) of the contact.
    scale = report.PICTURE / 64
    radius = 0.02 / view.metres_per_pixel * scale
    u, v = ((contact.pixel + 0.5) * scale - 0.5).round().astype(int)
    near = picture[v - 3 : v + 4, round(u - 2 * radius) - 3 : round(u - 2 * radius) + 4].reshape(-1, 3)
    assert np.abs(near.astype(int) - report.CIRCLE).sum(axis=1).min() < 60


def test_depth_without_any_value_is_black():
    assert not report.depth_picture(np.full((4, 5), np.nan, np.float32)).any()
