"""Real captures of mugs, bowls and cans: the table they stand on, handles open, bowls whole, lids closed, no hole that is not there."""

from pathlib import Path

import numpy as np
import pytest

from magic_core import images, transforms
from magic_core.camera import RgbdFrame
from magic_core.views import find_view, holes_of
from magic_perception.looks import find_table
from magic_perception.parameters import Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.table import camera_over_table

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data" / "rgbd"

pytestmark = pytest.mark.skipif(not CAPTURES.is_dir(), reason="the shared captures are not here")

#: Of each capture pixels (column, row) of things: what solid each is to become, whether a hole shows in it from the side, and its width in
#: mm (read from depth; of the white mug of ``cluttered_0`` from its 81 pixels at 0.84 m, its handle turned away by some 10 degrees).
SEEN = {
    "realsense_single/red_mug": {(343, 264): ("round with handle", True, 123)},
    "realsense_single/cylinder": {(326, 139): ("cylinder", False, 66)},
    "mugs/blue_mug": {(331, 239): ("round with handle", True, 110)},
    "bowls_boxes/white_bowl": {(371, 280): ("round", False, 147)},
    "mugs/cluttered_0": {
        (304, 246): ("round with handle", True, 113),
        (233, 372): ("round", False, 155),
        (422, 375): ("round", False, 155),
        # A dark mug whose handle is behind it, a tin with rounded edges (YCB's of 102 mm), a can.
        (205, 200): ("round", False, 112),
        (70, 290): ("rounded box", False, 102),
        (545, 365): ("cylinder", False, 101),
    },
    # With a pen in it, its foot of the table's colour, its handle towards the camera.
    "mugs/cluttered_6": {(364, 300): ("round with handle", False, 110)},
}


@pytest.mark.parametrize("capture", SEEN)
def test_round_things_of_a_capture(capture):
    folder = (CAPTURES / capture).parent
    picture = images.read_rgbd(
        CAPTURES / f"{capture}_color.png", CAPTURES / f"{capture}_depth_mm.png", str(folder / "intrinsics.json"), "mm"
    )
    pose = camera_over_table(picture.intrinsics.unproject(picture.depth)[::3, ::3])
    frame = RgbdFrame(picture.color, picture.depth, picture.intrinsics, pose, "camera")
    report = Report()
    scene = perceive([frame], parameters=Parameters(region_low=(-1.3, -1.3, -0.05), region_high=(1.3, 1.3, 0.6)), report=report)
    for (u, v), (shape, hole, width) in SEEN[capture].items():
        (item,) = [o for o in scene.objects if o.mask[v, u]]
        assert report.shapes[item.id] == shape
        assert (holes_of(find_view(item.mesh, item.pieces, "side").mask).sum() > 100) == hole
        # A body alone has no hole from anywhere, a handle makes one loop.
        assert item.mesh.to_trimesh().euler_number == (0 if hole else 2)
        assert 1000 * np.max(item.mesh.extents) == pytest.approx(max(width, 1000 * item.mesh.extents[2]), abs=10)


@pytest.mark.parametrize("turn", np.radians([0, 60, 120, 200, 290]))
def test_the_table_of_a_capture_is_found_whichever_way_the_world_is_turned(turn):
    # A narrow table, half a metre above a floor that fills more of the picture.
    folder = CAPTURES / "mugs"
    picture = images.read_rgbd(
        folder / "cluttered_6_color.png", folder / "cluttered_6_depth_mm.png", str(folder / "intrinsics.json:cluttered_6"), "mm"
    )
    points = picture.intrinsics.unproject(picture.depth)
    for step in (1, 3):
        pose = camera_over_table(points[::step, ::step])
        foot = transforms.apply(pose, points[300:330, 420:470].reshape(-1, 3))
        assert np.nanmedian(foot[:, 2]) == pytest.approx(0.0, abs=0.01), "the table's own pixels"
        turned = transforms.from_rpy(0, 0, turn) @ pose
        frame = RgbdFrame(picture.color, picture.depth, picture.intrinsics, turned, "camera")
        table = find_table([frame], Parameters(region_low=(-3, -3, -0.05), region_high=(3, 3, 0.6)))[0]
        assert table.heights(turned[:3, 3]) == pytest.approx(pose[2, 3], abs=0.01)
