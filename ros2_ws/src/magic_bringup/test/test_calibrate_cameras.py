"""The command that calibrates cameras, on bags of drawn pictures with a camera that is known."""

import cv2
import numpy as np
import pytest
import yaml

from magic_bags.recording import READY, Recording
from magic_bringup import calibrate_cameras
from magic_bringup.calibrate_cameras import main, rests
from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.robot import Description
from magic_core.sensor import looking_at
from magic_perception.calibration import Board

BOARD = Board()
K = Intrinsics(640, 480, 615.0, 615.0, 320.3, 239.1)
CAMERA = looking_at([1.15, 0.15, 0.75], [0.45, 0.0, 0.45])
ABOVE = looking_at([0.1, 0.5, 0.55], [0.47, 0.0, 0.0])
TCP_FROM_BOARD = transforms.from_rpy(0.0, -np.pi / 2, 0.0, (0.03, 0.1, -0.02)) @ transforms.from_rpy(0, 0, 0.2)


def painted(camera_from_board):
    """The board before gray, as the camera sees it (H, W, 3), and its depth (H, W)."""
    texture = BOARD.drawn(100)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    metres = np.diag([BOARD.square / 100, BOARD.square / 100, 1.0]) @ half
    homography = np.linalg.inv(half) @ np.diag([2, 2, 1.0]) @ half @ K.matrix @ camera_from_board[:3, [0, 1, 3]] @ metres
    large = cv2.warpPerspective(texture, homography, (1280, 960), flags=cv2.INTER_LINEAR, borderValue=128)
    gray = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)
    normal, at = camera_from_board[:3, 2], camera_from_board[:3, 3]
    rays = K.unproject(np.ones((480, 640), np.float32))
    return np.repeat(gray[..., None], 3, axis=2), (normal @ at / (rays @ normal)).astype(np.float32)


def record(bag, poses, board_of, scale=1.0):
    """A bag: the arm rests half a second at each of the poses, pictures at 10 Hz, joint states at 50 Hz, moving between them."""
    time = 100.0
    for number, pose in enumerate(poses):
        before = poses[number - 1]
        for part in np.linspace(0, 1, 10)[1:-1] if number else ():
            bag.joints(time, [*(before + part * (pose - before)), 0.04, 0.04])
            time += 0.02
        color, depth = painted(transforms.inverse(CAMERA) @ board_of(pose))
        for tick in range(25):
            bag.joints(time, [*pose, 0.04, 0.04])
            if tick % 10 == 5:
                bag.frame(RgbdFrame(color, (scale * depth).astype(np.float32), K, CAMERA, "left", time))
            time += 0.02


@pytest.fixture(scope="module")
def carried(tmp_path_factory):
    """A bag with the board on the Panda's hand."""
    robot = Description()

    def board_of(pose):
        return robot.forward(pose)[0] @ TCP_FROM_BOARD

    rng, poses = np.random.default_rng(4), []
    while len(poses) < 8:
        pose = np.array(READY[:7]) + rng.uniform(-0.3, 0.3, 7) * [1, 1, 1, 1, 2, 2, 2]
        camera_from_board = transforms.inverse(CAMERA) @ board_of(pose)
        corners = K.project(transforms.apply(camera_from_board, BOARD.corners))
        if camera_from_board[2, 2] > 0.7 and (corners > 20).all() and (corners < (620, 460)).all():
            poses.append(pose)
    path = tmp_path_factory.mktemp("carried") / "bag"
    with Recording(path) as bag:
        record(bag, poses, board_of)
    return path


def pose_in(folder):
    content = yaml.safe_load((folder / "cameras.param.yaml").read_text())["/**/perception"]["ros__parameters"]
    assert content["cameras"] == ["left"]
    return transforms.from_numbers(content["extrinsics"]["left"])


def test_a_board_on_the_hand_gives_the_camera_its_place(carried, tmp_path, capsys):
    assert main(["--bag", str(carried), "--on-hand", "--out", str(tmp_path)]) == 0, capsys.readouterr().err
    found = pose_in(tmp_path)
    assert np.linalg.norm(found[:3, 3] - CAMERA[:3, 3]) < 0.002
    assert np.degrees(transforms.rotation_angle(found, CAMERA)) < 0.15
    assert len(list(tmp_path.glob("left_*.png"))) == 8
    out = capsys.readouterr().out
    assert "left" in out and "views" in out


def test_a_lying_board_gives_the_camera_its_place_and_a_wrong_size_is_refused(tmp_path, capsys):
    place = ["0.35", "0.1", "0.0", "-20"]
    world_from_board = calibrate_cameras.on_table(*map(float, place))
    with Recording(tmp_path / "bag") as bag:
        color, depth = painted(transforms.inverse(ABOVE) @ world_from_board)
        bag.frame(RgbdFrame(color, depth, K, ABOVE, "left", 5.0))
    words = [
        "--bag",
        str(tmp_path / "bag"),
        "--board-at",
        *place,
    ]
    assert main([*words, "--out", str(tmp_path / "right")]) == 0, capsys.readouterr().err
    found = pose_in(tmp_path / "right")
    assert np.linalg.norm(found[:3, 3] - ABOVE[:3, 3]) < 0.002
    assert main([*words, "--square", "42", "--marker", "31.5", "--out", str(tmp_path / "wrong")]) == 1
    assert "measure the printed squares" in capsys.readouterr().err
    assert not (tmp_path / "wrong" / "cameras.param.yaml").exists() and (tmp_path / "wrong" / "left_00.png").exists()


def test_what_a_bag_lacks_is_named(carried, tmp_path, capsys):
    words = ["--bag", str(carried), "--on-hand", "--out", str(tmp_path)]
    assert main([*words, "--cameras", "right"]) == 1
    assert "/camera/right/color/image_raw" in capsys.readouterr().err
    assert main([*words, "--link", "nothing"]) == 1
    assert "panda_hand" in capsys.readouterr().err
    assert main(["--bag", str(tmp_path / "none"), "--board-at", "0", "0", "0", "0"]) == 1
    with pytest.raises(SystemExit):
        main(["--bag", str(carried)])


def test_rests_are_where_no_joint_moves():
    still = [(t, {"a": 0.0}) for t in np.arange(0.0, 1.0, 0.05)]
    moving = [(t, {"a": t - 1.0}) for t in np.arange(1.0, 2.0, 0.05)]
    again = [(t, {"a": 1.0}) for t in np.arange(2.0, 3.0, 0.05)]
    found = rests([*still, *moving, *again], ["a"])
    assert [round(float(q[0]), 2) for _, _, q in found] == [0.0, 1.0]
    assert found[0][0] == 0.0 and found[0][1] < 1.0 and found[1][0] > 2.0


def test_a_pose_that_is_come_back_to_is_another_rest():
    times = np.arange(0.0, 3.0, 0.05)
    out_and_back = np.clip(0.5 - np.abs(times - 1.5), 0.0, None)
    found = rests([(t, {"a": a}) for t, a in zip(times, out_and_back, strict=True)], ["a"])
    assert len(found) == 2 and found[0][1] < 1.0 and found[1][0] > 2.0


def test_the_board_is_drawn_at_its_size(tmp_path, capsys):
    from PIL import Image

    assert main(["--draw", str(tmp_path / "board.png")]) == 0
    with Image.open(tmp_path / "board.png") as picture:
        dpi = picture.info["dpi"][0]
        assert (picture.width - 2 * (300 // 4)) / dpi * 25.4 == pytest.approx(7 * 40, abs=0.6)
    assert "print at 100 %" in capsys.readouterr().out
