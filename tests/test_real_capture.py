"""A real D435 capture of a mug, turned into a bag, becomes a verified motion: hung on a rod by its handle."""

import json
from pathlib import Path

import numpy as np
import pytest

from magic_bringup import demo, report, rgbd_to_bag
from magic_core import conversions, transforms

CAPTURE = Path(__file__).resolve().parents[2] / "shared" / "data" / "rgbd" / "realsense_single"

pytestmark = pytest.mark.skipif(not CAPTURE.is_dir(), reason="the shared captures are not here")


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "red_mug"
    arguments = ["--color", "red_mug_color.png", "--depth", "red_mug_depth_mm.png", "--intrinsics", "intrinsics.json"]
    arguments = [a if a.startswith("--") else str(CAPTURE / a) for a in arguments]
    assert rgbd_to_bag.main([*arguments, "--strategy", "hanging", "--out", str(folder)]) == 0
    return folder


def test_the_red_mug_is_hung_by_its_handle(bag, tmp_path):
    assert demo.main(["--strategy", "hanging", "--variant", "fg", "--bag", str(bag), "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["success"], summary["message"]
    assert 0 < summary["seconds"]["perceive"] < summary["seconds"]["total"]
    record = report.load(tmp_path)
    scene = conversions.scene_from_msg(record.scene)
    mug = scene.find(record.result.tool_id)
    assert record.result.target_id == "rod"

    # The mask is the mug: what is red in the picture, and not much else.
    color = next(conversions.color_from_msg(m) for t, m in record.images.items() if "/color/" in t).astype(int)
    red = (color[..., 0] > 120) & (color[..., 1] < 60) & (color[..., 2] < 80)
    assert (red & mug.mask).sum() > 0.9 * red.sum()
    v, u = np.argwhere(red).mean(axis=0)
    near = np.hypot(*(np.argwhere(mug.mask) - [v, u]).T)
    assert near.max() < 150

    # The mesh has a mug's size.
    low, high = mug.mesh.transformed(mug.world_from_object).bounds
    assert -0.005 < low[2] < 0.005
    assert 0.08 < high[2] < 0.12
    assert 0.09 < max(high[:2] - low[:2]) < 0.15

    # The contact lies on the handle, beside the body: inside its loop, where the rod will be.
    kept = conversions.candidate_from_msg(next(c for c in record.result.candidates if c.code == 0).candidate)
    contact = mug.world_from_object @ kept.tool.object_from_contact
    assert kept.tool.concave
    # The body is where most of the mug's volume is: its axis is the middle of what is highest and widest.
    body = transforms.apply(mug.world_from_object, mug.mesh.vertices)
    rim = body[body[:, 2] > high[2] - 0.01]
    axis, radius = (rim[:, :2].min(axis=0) + rim[:, :2].max(axis=0)) / 2, np.ptp(rim[:, :2], axis=0).max() / 2
    assert np.linalg.norm(contact[:2, 3] - axis) > 0.9 * radius
    assert low[2] + 0.01 < contact[2, 3] < high[2]

    page = (tmp_path / "report.html").read_text()
    assert "could not be drawn" not in page
    assert page.count("data:image/") >= 10
