"""A tool's colours are told from those of ground, of a thing that stood about, and of a hand that comes."""

import numpy as np
import pytest

from magic_core.camera import Intrinsics, RgbdFrame
from magic_perception.tool_colors import ToolColors, lab

#: Pixels alone say what those about them say: colours are in stripes as wide, of which the middle is asked.
WIDE = 5
MIDDLE = slice(WIDE // 2, None, WIDE)
TOOL, GROUND, BALL, SHADED, SKIN = (110, 80, 50), (190, 155, 110), (180, 65, 50), (90, 42, 34), (200, 130, 110)


def picture(*colors):
    """A frame with a stripe of 20 rows of each colour, noisy."""
    noise = np.random.default_rng(0).normal(0, 4, (20, WIDE * len(colors), 3))
    color = np.clip(np.repeat(np.array(colors), WIDE, axis=0) + noise, 0, 255).astype(np.uint8)
    depth = np.ones(color.shape[:2], np.float32)
    return RgbdFrame(color, depth, Intrinsics(color.shape[1], 20, 100.0, 100.0, 1.0, 10.0), np.eye(4), "left", 0.0)


@pytest.fixture
def learned():
    def make(others=True):
        colors = ToolColors()
        tool, ground, ball, shaded = np.moveaxis(lab(picture(TOOL, GROUND, BALL, SHADED))[:, MIDDLE], 1, 0)
        colors.learn(tool, np.concatenate([ground] * 20), [np.concatenate([ball, shaded])] if others else [])
        return colors

    return make


def test_the_shaded_side_of_a_thing_that_stood_about_is_not_the_tool(learned):
    frame = picture(TOOL, GROUND, BALL, SHADED)
    assert (learned(others=False).said(frame).tool[:, MIDDLE][:, 3] > 0).mean() > 0.5  # by ground alone it is the tool's
    tool, touches = (each[:, MIDDLE] for each in learned().said(frame))
    assert [np.sign(np.median(tool[:, k])) for k in range(4)] == [1, -1, -1, -1]
    assert (touches.mean(axis=0) > 0.9).tolist() == [False, False, True, True]


def test_a_hand_that_comes_may_touch_the_tool_and_ground_may_not(learned):
    colors = learned()
    for _ in range(5):
        colors.see_moving(lab(picture(SKIN))[:, WIDE // 2])
        colors.see_ground(lab(picture(GROUND))[:, WIDE // 2])
    tool, touches = (each[:, MIDDLE] for each in colors.said(picture(SKIN, GROUND, TOOL)))
    assert (tool[:, :2] < 0).mean() > 0.9 and (tool[:, 2] > 0).mean() > 0.9
    assert touches[:, 0].mean() > 0.9 and touches[:, 1:].mean() < 0.1
