"""An image pair becomes a bag: the table is found, the thing lies in reach, and bad input gets a code."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from magic_bags.bag_file import info as read_info
from magic_bringup import rgbd_to_bag
from magic_core import images, transforms
from magic_core import strategy as strategies
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.sensor import capture, looking_at
from magic_core.shapes import make

STRATEGIES = Path(__file__).resolve().parents[1] / "strategies"
SHARED = Path(__file__).resolve().parents[5] / "shared" / "data" / "rgbd" / "realsense_single"
CAMERA = Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A mug seen by a camera whose pose is not told."""
    folder = tmp_path_factory.mktemp("rgbd")
    mug = make("mug", 3)
    frame = capture(
        [mug.mesh.transformed(transforms.from_rpy(0, 0, 1.0, [3.0, 2.0, mug.mesh.extents[2] / 2]))],
        CAMERA,
        looking_at([3.4, 2.2, 0.45], [3, 2, 0.04]),
        0,
        table=_table(),
    )
    cv2.imwrite(str(folder / "c.png"), frame.color[..., ::-1])
    depth = np.nan_to_num(frame.depth)
    cv2.imwrite(str(folder / "d.png"), np.round(depth * 1000).astype(np.uint16))
    np.save(folder / "d.npy", depth)
    (folder / "k.json").write_text(json.dumps({"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}))
    return {name: folder / name for name in ("c.png", "d.png", "d.npy", "k.json")}


def _table() -> object:
    from magic_core.sensor import table_mesh

    return table_mesh((2.0, 1.0), (4.0, 3.0))


def run(files: dict[str, Path], out: Path, *more: str, **instead: str) -> int:
    named = {
        "--color": str(files["c.png"]),
        "--depth": str(files["d.png"]),
        "--intrinsics": str(files["k.json"]),
        "--strategy": str(STRATEGIES / "hanging"),
    }
    named.update({f"--{k.replace('_', '-')}": v for k, v in instead.items()})
    return rgbd_to_bag.main([*(x for pair in named.items() for x in pair), "--out", str(out), *more])


def test_the_mug_stands_upright_in_reach_beside_the_rod(files: dict[str, Path], tmp_path: Path) -> None:
    picture = images.read_rgbd(files["c.png"], files["d.png"], str(files["k.json"]))
    strategy = strategies.load(STRATEGIES / "hanging")
    frame = rgbd_to_bag.convert(picture, tmp_path / "bag", strategy=strategy).frame
    points = transforms.apply(frame.world_from_camera, CAMERA.unproject(frame.depth)).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    assert np.median(points[:, 2]) == pytest.approx(0, abs=0.002)
    mug = points[points[:, 2] > 0.015]
    assert mug[:, 2].max() == pytest.approx(make("mug", 3).mesh.extents[2], abs=0.006)
    middle = (mug.min(axis=0) + mug.max(axis=0)) / 2
    np.testing.assert_allclose(middle[:2], rgbd_to_bag.PLACES[0], atol=0.02)
    (rod,) = rgbd_to_bag.strategy_fixtures(strategy)
    corners = transforms.apply(rod.world_from_object, rod.mesh.vertices)
    assert np.linalg.norm(mug[:, None, :2] - corners[None, ::10, :2], axis=2).min() > 0.1
    topics = {t.name: t.count for t in read_info(tmp_path / "bag").topics}
    assert topics["/known_objects"] == topics["/tf_static"] == 1 and topics["/camera/left/color/image_raw"] == rgbd_to_bag.REPEATS


def test_given_poses_are_kept(files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pose = ["0.9", "0", "0.5", "0.653281", "0.653281", "-0.270598", "-0.270598"]
    assert (
        run(files, tmp_path / "bag", "--camera-pose", *pose, "--rod", "0.5", "0.1", "0.19", "0", "0", "0", "1", depth=str(files["d.npy"]))
        == 0
    )
    assert "camera at 0.9000 0.0000 0.5000" in capsys.readouterr().out


def test_without_a_strategy_nothing_is_known(files: dict[str, Path], tmp_path: Path) -> None:
    assert run(files, tmp_path / "bag", strategy="none") == 0
    assert "/known_objects" not in {t.name for t in read_info(tmp_path / "bag").topics}
    assert run(files, tmp_path / "bag", strategy="none") == 1  # it is there already
    assert run(files, tmp_path / "bag", "--force", strategy="none") == 0


@pytest.mark.parametrize(
    ("instead", "code"),
    [
        ({"color": "missing.png"}, Code.BAD_IMAGE),
        ({"depth": "missing.png"}, Code.BAD_IMAGE),
        ({"depth": "c.png"}, Code.BAD_ENCODING),
        ({"depth_unit": "m"}, Code.DEPTH_UNIT),
        ({"depth_unit": "0.1mm"}, Code.DEPTH_UNIT),
        ({"depth_unit": "inch"}, Code.DEPTH_UNIT),
        ({"intrinsics": "1,2,3"}, Code.BAD_INTRINSICS),
        ({"intrinsics": "0,300,212,120"}, Code.BAD_INTRINSICS),
        ({"intrinsics": "none.json"}, Code.BAD_INTRINSICS),
        ({"strategy": "no/such"}, Code.UNKNOWN_STRATEGY),
    ],
)
def test_bad_input_gets_a_code(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], instead: dict[str, str], code: Code
) -> None:
    instead = {k: str(files[v]) if v in files else v for k, v in instead.items()}
    assert run(files, tmp_path / "bag", **instead) == 1
    assert f"[{int(code)} {code.name}]" in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()


@pytest.fixture(scope="module")
def two_things(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A red cylinder in front, and a hook behind it, seen by a camera whose pose is not told; ``hook`` is a pixel of it."""
    folder = tmp_path_factory.mktemp("two")
    hook = make("l_hook", 2).mesh.painted((40, 80, 200))
    hook = hook.transformed(transforms.from_rpy(0, 0, 0.4, [2.95, 1.85, hook.extents[2] / 2]))
    can = make("cylinder", 0, radius=0.03, half_height=0.03).mesh.painted((200, 30, 30))
    can = can.transformed(transforms.make(translation=[3.1, 2.1, 0.03]))
    pose = looking_at([3.5, 2.2, 0.5], [3, 2, 0.0])
    frame = capture([hook, can], CAMERA, pose, 0, table=_table())
    blue = np.argwhere(frame.color[..., 2].astype(int) - frame.color[..., 0] > 60)
    v, u = blue[np.argmin(np.linalg.norm(blue - np.median(blue, axis=0), axis=1))]
    cv2.imwrite(str(folder / "c.png"), frame.color[..., ::-1])
    cv2.imwrite(str(folder / "d.png"), np.round(np.nan_to_num(frame.depth) * 1000).astype(np.uint16))
    (folder / "k.json").write_text(json.dumps({"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}))
    return {**{name: folder / name for name in ("c.png", "d.png", "k.json")}, "hook": f"{u},{v}"}


@pytest.mark.parametrize("how", ["pixel", "words"])
def test_the_named_thing_is_the_tool_and_lies_in_reach(
    two_things: dict, tmp_path: Path, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    tool = two_things["hook"] if how == "pixel" else "the blue tool"
    status = run(
        two_things, tmp_path / "bag", "--target", "cylinder:radius=0.02,half_height=0.04", strategy=str(STRATEGIES / "hooking"), tool=tool
    )
    out = capsys.readouterr().out
    assert status == 0, out
    command = out.splitlines()[-1]
    name = command.split("--tool ")[1].split()[0]
    assert command.endswith("--target target") and "target: known" in out
    line = next(x for x in out.splitlines() if x.startswith(f"{name}:"))
    assert "blue" in line
    # In the bag: the hook where tools are put, the cylinder where the demonstration's target stood, on the table.
    picture = images.read_rgbd(two_things["c.png"], two_things["d.png"], str(two_things["k.json"]))
    strategy = strategies.load(STRATEGIES / "hooking")
    made = rgbd_to_bag.convert(picture, tmp_path / "again", strategy=strategy, target="cylinder:radius=0.02,half_height=0.04", tool=tool)
    assert made.tool == name
    hook, target = made.scene.find(name), made.scene.find(rgbd_to_bag.TARGET)
    assert min(np.linalg.norm(hook.world_from_box[:2, 3] - place) for place in rgbd_to_bag.PLACES) < 0.05
    np.testing.assert_allclose(target.box_extents, [0.04, 0.04, 0.08], atol=1e-6)
    np.testing.assert_allclose(target.world_from_box[:3, 3], [0.7, 0.0, 0.04], atol=1e-6)


def test_a_table_above_the_floor_is_what_things_stand_on() -> None:
    table = transforms.from_rpy(0.05, -0.03, 0.7, [0.3, -0.2, 0.42])
    normal = table[:3, 2]
    plane = np.append(normal, -normal @ table[:3, 3])
    level = transforms.inverse(rgbd_to_bag.standing_on(plane))
    points = transforms.apply(level @ table, [[0.0, 0, 0], [0.5, 0.2, 0], [0, 0, 0.1]])
    np.testing.assert_allclose(points[:, 2], [0, 0, 0.1], atol=1e-12)
    assert transforms.rotation_angle(level, np.eye(4)) < 0.06


def test_targets_are_meshes_or_made(tmp_path: Path) -> None:
    make("rod", 0).mesh.save(tmp_path / "rod.obj")
    hanging = strategies.load(STRATEGIES / "hanging")
    pose = transforms.from_rpy(0, 0, 0.5, [0.5, 0.1, 0.2])
    for text in (str(tmp_path / "rod.obj"), "rod", "mug_tree:pegs=1"):
        (item,) = rgbd_to_bag.strategy_fixtures(hanging, pose, text)
        assert item.id == rgbd_to_bag.TARGET and item.source == "known" and item.pieces
        np.testing.assert_allclose(item.world_from_object, pose)
        (item,) = rgbd_to_bag.strategy_fixtures(hanging, None, text)
        assert transforms.apply(item.world_from_object, item.mesh.vertices)[:, 2].min() == pytest.approx(0, abs=1e-9)
    for text in ("sofa", "rod:length", "rod:size=3", "mug_tree:pegs=3"):
        with pytest.raises(MagicError) as caught:
            rgbd_to_bag.made_target(text)
        assert caught.value.code is Code.BAD_REQUEST


def test_a_tool_that_is_not_there_is_refused_with_what_is(two_things: dict, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(two_things, tmp_path / "bag", tool="5,5") == 1
    said = capsys.readouterr().err
    assert "NO_OBJECTS" in said and "red" in said and "blue" in said
    assert run(two_things, tmp_path / "bag", tool="the green box") == 1
    assert run(two_things, tmp_path / "bag", "--target", "rod", strategy="none") == 1
    assert not (tmp_path / "bag").exists()


def test_bad_depth_and_sizes_get_a_code(files: dict[str, Path], tmp_path: Path) -> None:
    color = images.read_color(files["c.png"])
    strategy = strategies.load(STRATEGIES / "hanging")
    flat = capture([], CAMERA, looking_at([0.9, 0.2, 0.5], [0.5, 0, 0]), 0).depth
    for depth, code in (
        (np.full((240, 424), np.nan, np.float32), None),
        (flat, Code.NO_OBJECTS),
        (flat[:100], Code.BAD_IMAGE),
    ):
        with pytest.raises(MagicError) as caught:
            rgbd_to_bag.convert(images.Rgbd(color, depth, CAMERA, "mm", True), tmp_path / "bag", strategy=strategy)
        assert caught.value.code in ((code,) if code else (Code.NO_TABLE, Code.NO_DEPTH, Code.NO_OBJECTS))


@pytest.mark.skipif(not SHARED.is_dir(), reason="shared/data is not here")
def test_the_red_mug_of_a_real_capture(tmp_path: Path) -> None:
    picture = images.read_rgbd(SHARED / "red_mug_color.png", SHARED / "red_mug_depth_mm.png", str(SHARED / "intrinsics.json"))
    color, intrinsics = picture.color, picture.intrinsics
    frame = rgbd_to_bag.convert(picture, tmp_path / "bag", strategy=strategies.load(STRATEGIES / "hanging")).frame
    points = transforms.apply(frame.world_from_camera, intrinsics.unproject(frame.depth)).reshape(-1, 3)
    reds = (color[..., 0] > 120) & (color[..., 1] < 60)
    mug = points[reds.ravel() & np.isfinite(points).all(axis=1)]
    mug = mug[mug[:, 2] > 0.01]
    assert 0.08 < np.percentile(mug[:, 2], 99) < 0.115
    assert np.linalg.norm(np.median(mug[:, :2], axis=0) - rgbd_to_bag.PLACES[0]) < 0.06
