"""Where cameras stand, found from boards whose pictures are drawn with cameras that are known."""

import cv2
import numpy as np
import pytest

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.sensor import looking_at
from magic_perception import calibration
from magic_perception.calibration import Board, Lens, View

BOARD = Board()
LENS = Lens(Intrinsics(640, 480, 615.0, 615.0, 320.3, 239.1))
LEFT, RIGHT = looking_at([0.1, 0.55, 0.6], [0.5, 0.05, 0.0]), looking_at([0.15, -0.6, 0.7], [0.55, 0.0, 0.0])
#: A board that lies face up before the robot.
LYING = transforms.from_rpy(np.pi, 0.0, 0.3, (0.36, 0.12, 0.001))


def painted(lens, camera_from_board, board=BOARD, fine=2):
    """The board as an ideal camera sees it (H, W, 3): the printed picture under its homography, antialiased."""
    texture = board.drawn(120)
    metres = np.diag([board.square / 120, board.square / 120, 1.0]) @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    k = np.diag([fine, fine, 1.0]) @ np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]]) @ lens.intrinsics.matrix
    k = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]]) @ k
    homography = k @ camera_from_board[:3, [0, 1, 3]] @ metres
    size = (fine * lens.intrinsics.width, fine * lens.intrinsics.height)
    large = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_AREA, borderValue=128)
    gray = cv2.resize(large, (size[0] // fine, size[1] // fine), interpolation=cv2.INTER_AREA)
    return np.repeat(gray[..., None], 3, axis=2)


def seen(camera, shot, world_from_camera, world_from_board, lens=LENS, hand=None, noise=0.05, square=1.0, depth=True, seed=0):
    """A view of every corner that falls into the picture, with noise; square: how much larger the print is than the board says."""
    points = transforms.apply(transforms.inverse(world_from_camera) @ world_from_board, square * BOARD.corners)
    pixels = lens.project(points) + np.random.default_rng([seed, shot]).normal(0, noise, (len(points), 2))
    inside = (pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1) & (points[:, 2] > 0)
    return View(camera, shot, np.nonzero(inside)[0], pixels[inside], points[inside, 2] if depth else np.full(inside.sum(), np.nan), hand)


HAND_FROM_BOARD = transforms.from_rpy(0.1, -0.05, 0.4, (-0.1, -0.08, 0.05))


def carried(count=10, tilt=0.5, axes="xy", seed=3):
    """Places of the hand with the board towards the camera LEFT, each turned by up to ``tilt`` rad about the axes named."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        turn = np.array([rng.uniform(-tilt, tilt) if axis in axes else 0.0 for axis in "xyz"])
        at = transforms.make(translation=(rng.uniform(-0.12, 0.1), rng.uniform(-0.1, 0.08), rng.uniform(0.45, 0.6)))
        world_from_board = LEFT @ at @ transforms.from_rotvec(turn)
        found.append(world_from_board @ transforms.inverse(HAND_FROM_BOARD))
    return found


def close(a, b, metres, degrees):
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) < metres
    assert np.degrees(transforms.rotation_angle(a, b)) < degrees


def test_a_drawn_board_is_found_where_it_is():
    camera_from_board = transforms.inverse(LEFT) @ LYING
    ids, pixels = BOARD.detected(painted(LENS, camera_from_board))
    assert len(ids) == (BOARD.columns - 1) * (BOARD.rows - 1)
    expected = LENS.project(transforms.apply(camera_from_board, BOARD.corners[ids]))
    assert np.abs(pixels - expected).max() < 0.3 and np.abs((pixels - expected).mean(axis=0)).max() < 0.05
    assert len(BOARD.detected(np.full((480, 640, 3), 128, np.uint8))[0]) == 0


def test_cameras_over_a_lying_board_are_found_from_pictures():
    views = []
    for name, world_from_camera in (("left", LEFT), ("right", RIGHT)):
        ids, pixels = BOARD.detected(painted(LENS, transforms.inverse(world_from_camera) @ LYING))
        views.append(View(name, 0, ids, pixels, np.full(len(ids), np.nan)))
    found = calibration.calibrate(BOARD, {"left": LENS, "right": LENS}, views, LYING)
    close(found.cameras["left"].world_from_camera, LEFT, 0.002, 0.15)
    close(found.cameras["right"].world_from_camera, RIGHT, 0.002, 0.15)
    assert found.cameras["left"].rms < 0.2 and np.isnan(found.cameras["left"].scale) and found.hand_from_board is None


def test_exact_corners_give_the_exact_camera_and_the_place_on_the_hand():
    lens = Lens(LENS.intrinsics, np.array([0.08, -0.1, 0.001, -0.002, 0.02]))
    hands = carried()
    views = [seen("left", n, LEFT, h @ HAND_FROM_BOARD, lens, h, noise=0.0) for n, h in enumerate(hands)]
    found = calibration.calibrate(BOARD, {"left": lens}, views)
    close(found.cameras["left"].world_from_camera, LEFT, 1e-6, 1e-4)
    close(found.hand_from_board, HAND_FROM_BOARD, 1e-6, 1e-4)
    assert found.cameras["left"].scale == pytest.approx(1.0)


@pytest.mark.parametrize("on_hand", [True, False])
def test_the_uncertainty_told_is_that_of_repeated_calibrations(on_hand):
    """The spread of the workspace's points over many calibrations with fresh noise is what one of them foresees."""
    hands = carried()
    place, told = [], []
    for seed in range(12):
        if on_hand:
            views = [seen("left", n, LEFT, h @ HAND_FROM_BOARD, hand=h, noise=0.15, seed=seed) for n, h in enumerate(hands)]
            found = calibration.calibrate(BOARD, {"left": LENS}, views)
        else:
            found = calibration.calibrate(BOARD, {"left": LENS}, [seen("left", seed, LEFT, LYING, noise=0.15)], LYING, allowed=0.05)
        one = found.cameras["left"]
        told.append(one.off)
        place.append(transforms.apply(one.world_from_camera @ transforms.inverse(LEFT), calibration.WORKSPACE))
    error = np.array(place) - calibration.WORKSPACE
    spread = 2 * np.sqrt((error**2).sum(axis=-1).mean(axis=0)).max()
    assert 0.4 * spread < np.median(told) < 2.0 * spread


@pytest.mark.parametrize(
    "views, place, words",
    [
        ([], LYING, "usable pictures of the board by left: 'none'"),
        ([seen("left", n, LEFT, h @ HAND_FROM_BOARD, hand=h) for n, h in enumerate(carried(5))], None, "at least 6"),
        ([seen("left", n, LEFT, h @ HAND_FROM_BOARD, hand=h) for n, h in enumerate(carried(axes="x"))], None, "tilt the hand to all sides"),
        ([seen("left", n, LEFT, h @ HAND_FROM_BOARD, hand=h, square=1.06) for n, h in enumerate(carried())], None, "left"),
        ([seen("left", 0, LEFT, LYING, square=1.06)], LYING, "measure the printed squares"),
        ([seen("left", 0, LEFT, LYING, noise=2.0)], LYING, "residual of left, pixels rms"),
        ([seen("left", 0, looking_at([-1.0, 1.6, 2.2], [0.45, 0.05, 0.0]), LYING, noise=0.3)], LYING, ""),
    ],
)  # fmt: skip
def test_what_does_not_tell_where_the_camera_is_is_refused(views, place, words):
    with pytest.raises(MagicError) as caught:
        calibration.calibrate(BOARD, {"left": LENS}, views, place)
    assert caught.value.code is Code.BAD_REQUEST
    assert words in caught.value.message


def test_the_camera_moved_between_two_pictures_is_refused():
    hands = carried()
    views = [
        seen("left", n, LEFT if n < 5 else LEFT @ transforms.make(translation=(0.02, 0, 0)), h @ HAND_FROM_BOARD, hand=h)
        for n, h in enumerate(hands)
    ]
    with pytest.raises(MagicError, match="residual of left"):
        calibration.calibrate(BOARD, {"left": LENS}, views)


@pytest.mark.parametrize(
    "wrong", [{"columns": 2}, {"marker": 0.05}, {"dictionary": "9X9_1"}, {"columns": 20, "rows": 20, "dictionary": "5X5_50"}]
)
def test_a_board_that_cannot_be_is_refused(wrong):
    with pytest.raises(MagicError):
        Board(**wrong)
