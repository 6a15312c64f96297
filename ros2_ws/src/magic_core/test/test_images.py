"""Image files are read in one way: as they are shown, depth in metres, and a wrong unit is refused."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from magic_core import depth as depths
from magic_core import images
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.sensor import capture, looking_at
from magic_core.shapes import make

CAMERA = Intrinsics(160, 120, 150.0, 151.0, 82.0, 57.0)
POSE = looking_at([0.3, 0.1, 0.7], [0.5, 0.0, 0.0])


def refused(code, work, *words):
    with pytest.raises(MagicError) as caught:
        work()
    assert caught.value.code is code and all(w in caught.value.message for w in words), caught.value.message


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["png", "jpg", "tiff", "webp"])
def test_pictures_are_read_as_they_are_shown(tmp_path, kind, orientation):
    """Pillow's own turning is the reference, for each of the eight orientations."""
    rng = np.random.default_rng(orientation)
    pixels = cv2.resize(rng.integers(0, 255, (3, 4, 3), dtype=np.uint8), (64, 48), interpolation=cv2.INTER_LINEAR)
    tag = Image.Exif()
    tag[0x0112] = orientation
    Image.fromarray(pixels).save(tmp_path / f"p.{kind}", exif=tag, **({} if kind == "tiff" else {"lossless": True, "quality": 98}))
    with Image.open(tmp_path / f"p.{kind}") as stored:
        shown = np.asarray(ImageOps.exif_transpose(stored).convert("RGB")).astype(int)
    found = images.read_color(tmp_path / f"p.{kind}")
    assert found.shape == shown.shape and np.abs(found - shown).mean() < 3


@pytest.mark.parametrize(
    "unit, dtype", [("mm", np.uint16), ("cm", np.uint16), ("0.1mm", np.uint16), ("0.25mm", np.int32), ("m", np.float64)]
)
def test_units_and_holes(tmp_path, unit, dtype):
    truth = np.full((40, 50), 0.8, np.float32)
    raw = np.round(truth / depths.metres(unit), 0 if np.dtype(dtype).kind in "ui" else 9).astype(dtype)
    holes = (
        [0, -5, np.iinfo(dtype).max]
        if np.dtype(dtype).kind == "i"
        else [0, np.iinfo(dtype).max]
        if dtype == np.uint16
        else [0, -1, np.nan, np.inf, -np.inf, 1e9]
    )
    raw[0, : len(holes)] = holes
    np.save(tmp_path / "d.npy", raw)
    depth = images.read_depth(tmp_path / "d.npy", unit)
    assert depth.dtype == np.float32 and np.isnan(depth[0, : len(holes)]).all() and np.isnan(depth).sum() == len(holes)
    np.testing.assert_allclose(depth[1:], 0.8, rtol=1e-5)


@pytest.mark.parametrize("suffix", ["png", "tiff", "exr", "npy"])
def test_files_of_depth(tmp_path, suffix):
    path = tmp_path / f"d.{suffix}"
    raw = np.full((30, 40), 700, np.uint16) if suffix == "png" else np.full((30, 40), 0.7, np.float32)
    if suffix == "npy":
        np.save(path, raw)
    else:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")  # to write it: the reader sees to that itself
            assert cv2.imwrite(str(path), raw)
    np.testing.assert_allclose(images.read_depth(path), 0.7, rtol=1e-6)


@given(st.floats(0.4, 1.2), st.sampled_from(["cm", "0.1mm", "0.25mm", "m", "mm"]), st.sampled_from(["mm", "m"]))
def test_a_unit_that_was_not_told_and_is_wrong_is_refused_by_its_name(distance, true, read_as):
    """A table-top at a usual distance, in one unit and taken for another."""
    if true == read_as:
        return
    depth = np.full((20, 20), distance / depths.metres(true) * depths.metres(read_as), np.float32)
    refused(Code.DEPTH_UNIT, lambda: depths.check_distance(depth, "depth", read_as, False, "pass --depth-unit"), true, "--depth-unit")


@given(st.floats(0.2, 1.4))
def test_a_table_top_at_a_usual_distance_is_taken(distance):
    depth = np.full((20, 20), distance, np.float32)
    depth[0] = np.nan
    depths.check_distance(depth, "depth", "mm", False, "")


def test_depth_against_the_pose_of_its_camera():
    frame = capture([make("cylinder", 1).mesh], CAMERA, POSE, 0)
    depths.check_pose(frame, "mm", "")
    assert depths.times_as_far(frame) == pytest.approx(1.0, abs=0.05)
    for factor, unit in ((0.1, "cm"), (10.0, "0.1mm"), (4.0, "0.25mm"), (0.001, "m"), (50.0, "pose")):
        wrong = RgbdFrame(frame.color, frame.depth * np.float32(factor), CAMERA, POSE)
        refused(Code.DEPTH_UNIT, lambda wrong=wrong: depths.check_pose(wrong, "mm", "set it"), unit, "set it")
    # A camera that looks up sees no table, whatever it sees.
    depths.check_pose(RgbdFrame(frame.color, np.full_like(frame.depth, 0.3), CAMERA, looking_at([0.3, 0, 0.7], [0.3, 1.0, 1.4])), "mm", "")


def test_large_things_far_away_ask_for_the_unit():
    refused(Code.DEPTH_UNIT, lambda: depths.check_sizes(1.8, [0.44, 0.82], "mm", False, "pass --depth-unit"), "0.25mm", "--depth-unit")
    for distance, sizes, told in ((0.8, [0.44], False), (1.8, [0.1, 0.8], False), (1.8, [0.44], True), (1.8, [], False)):
        depths.check_sizes(distance, sizes, "mm", told, "")


@pytest.fixture
def sideways(tmp_path):
    """A capture, and the same as a camera stores it that was held sideways; ``k`` writes intrinsics."""
    frame = capture([make("l_hook", 1).mesh], CAMERA, POSE, 0)
    millimetres = np.round(np.nan_to_num(frame.depth) * 1000).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "shown_d.png"), millimetres)
    for orientation, back in ((6, 1), (8, -1), (3, 2)):
        tag = Image.Exif()
        tag[0x0112] = orientation
        Image.fromarray(np.ascontiguousarray(np.rot90(frame.color, back))).save(tmp_path / f"c{orientation}.png", exif=tag)
        cv2.imwrite(str(tmp_path / f"d{orientation}.png"), np.rot90(millimetres, back))
    return tmp_path, frame


@pytest.mark.parametrize("orientation", [6, 8])
def test_depth_and_intrinsics_are_turned_with_a_picture_that_is_stored_sideways(sideways, orientation):
    folder, frame = sideways
    w, h = CAMERA.width, CAMERA.height
    # The stored camera: (u, v) shown = (h' - 1 - v, u) stored for 6, (v, w' - 1 - u) for 8, with w' = h and h' = w.
    stored = (CAMERA.cy, w - 1 - CAMERA.cx) if orientation == 6 else (h - 1 - CAMERA.cy, CAMERA.cx)
    text = f"{CAMERA.fy},{CAMERA.fx},{stored[0]},{stored[1]}"
    picture = images.read_rgbd(folder / f"c{orientation}.png", folder / f"d{orientation}.png", text)
    assert picture.intrinsics == CAMERA and picture.notes
    np.testing.assert_array_equal(picture.color, frame.color)
    np.testing.assert_allclose(np.nan_to_num(picture.depth), np.nan_to_num(frame.depth), atol=6e-4)
    # Points of the stored picture in its own frame are those of the shown one in its own.
    raw = images.read_depth(folder / f"d{orientation}.png")
    points = Intrinsics(h, w, CAMERA.fy, CAMERA.fx, *stored).unproject(raw).reshape(-1, 3)
    moved = CAMERA.unproject(picture.depth).reshape(-1, 3) @ picture.stored_from_shown[:3, :3].T
    np.testing.assert_allclose(
        np.sort(points[np.isfinite(points[:, 2])], axis=0), np.sort(moved[np.isfinite(moved[:, 2])], axis=0), atol=1e-9
    )
    # Depth and intrinsics of the picture as it is shown stay as they are.
    upright = images.read_rgbd(folder / f"c{orientation}.png", folder / "shown_d.png", f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}")
    assert upright.intrinsics == CAMERA and not upright.notes
    np.testing.assert_array_equal(upright.depth, picture.depth)


def test_where_nothing_tells_which_way_depth_lies_the_picture_is_refused(sideways):
    folder, _ = sideways
    k = f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"
    refused(Code.BAD_IMAGE, lambda: images.read_rgbd(folder / "c3.png", folder / "d3.png", k), "EXIF")
    refused(Code.BAD_INTRINSICS, lambda: images.read_rgbd(folder / "c6.png", folder / "d6.png", k), "turned by a quarter")


@pytest.mark.parametrize("content", [None, b"", b"no picture"])
@pytest.mark.parametrize("name", ["x.png", "x.npy", "x.exr"])
def test_what_is_no_image_has_a_code(tmp_path, name, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    refused(Code.BAD_IMAGE, lambda: images.read_depth(tmp_path / name))
    refused(Code.BAD_IMAGE, lambda: images.read_color(tmp_path / name))


@pytest.mark.parametrize(
    "raw", [np.full((9, 9), 90, np.uint8), np.full((9, 9, 3), 700, np.uint16), np.zeros((0, 4), np.uint16), np.array("text")]
)
def test_what_is_no_depth_has_a_code(tmp_path, raw):
    np.save(tmp_path / "d.npy", raw)
    refused(Code.BAD_ENCODING, lambda: images.read_depth(tmp_path / "d.npy"))


@pytest.mark.parametrize("value", [0, 65535, np.nan])
def test_nothing_seen_is_no_depth(tmp_path, value):
    np.save(tmp_path / "d.npy", np.full((9, 9), value, float if np.isnan(value) else np.uint16))
    refused(Code.NO_DEPTH, lambda: images.read_depth(tmp_path / "d.npy"))


def test_intrinsics_are_read_in_every_common_form(tmp_path):
    expected = Intrinsics(640, 480, 600.0, 601.0, 320.0, 240.0)
    rows = [[600.0, 0, 320.0], [0, 601.0, 240.0], [0, 0, 1.0]]
    columns = [600.0, 0, 0, 0, 601.0, 0, 320.0, 240.0, 1.0]
    plain = {"fx": 600.0, "fy": 601.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}
    path = tmp_path / "k.json"
    for data in (
        plain,
        {"K": rows},
        {"intrinsic_matrix": columns, "width": 640, "height": 480},
        {"mug": plain, "can": {**plain, "fx": 1.0}},
    ):
        path.write_text(json.dumps(data))
        assert images.read_intrinsics(str(path), 640, 480, "mug_color.png") == expected
    assert images.read_intrinsics(f"{path}:can", 640, 480).fx == 1.0
    assert images.read_intrinsics("600,601,320,240", 640, 480) == expected
    refused(Code.BAD_INTRINSICS, lambda: images.read_intrinsics(str(path), 640, 480, "spoon.png"), "mug")
    path.write_text(json.dumps(plain))
    refused(Code.BAD_INTRINSICS, lambda: images.read_intrinsics(str(path), 320, 240), "320 x 240")
    refused(Code.BAD_INTRINSICS, lambda: images.read_intrinsics("600,601,320,240", 300, 480))
