"""A tool's colours are told from those of ground, of a thing that stood about, and of a hand that comes."""

import numpy as np
import pytest

from magic_core.camera import Intrinsics, RgbdFrame
from magic_perception.tool_colors import ToolColors, lab

TOOL, GROUND, BALL, SHADED, SKIN = (110, 80, 50), (190, 155, 110), (180, 65, 50), (90, 42, 34), (200, 130, 110)


def picture(*colors):
    """A frame with a column of 20 pixels of each colour, noisy."""
    noise = np.random.default_rng(0).normal(0, 4, (20, len(colors), 3))
    color = np.clip(np.array(colors)[None] + noise, 0, 255).astype(np.uint8)
    depth = np.ones(color.shape[:2], np.float32)
    return RgbdFrame(color, depth, Intrinsics(len(colors), 20, 100.0, 100.0, 1.0, 10.0), np.eye(4), "left", 0.0)


@pytest.fixture
def learned():
    def make(others=True):
        colors = ToolColors()
        tool, ground, ball, shaded = np.moveaxis(lab(picture(TOOL, GROUND, BALL, SHADED)), 1, 0)
        colors.learn(tool, np.concatenate([ground] * 20), [np.concatenate([ball, shaded])] if others else [])
        return colors

    return make


def test_the_shaded_side_of_a_thing_that_stood_about_is_not_the_tool(learned):
    frame = picture(TOOL, GROUND, BALL, SHADED)
    assert (learned(others=False).said(frame).tool[:, 3] > 0).mean() > 0.5  # by ground alone it is the tool's
    said = learned().said(frame)
    assert [np.sign(np.median(said.tool[:, k])) for k in range(4)] == [1, -1, -1, -1]
    assert (said.touches.mean(axis=0) > 0.9).tolist() == [False, False, True, True]


def test_a_hand_that_comes_may_touch_the_tool_and_ground_may_not(learned):
    colors = learned()
    for _ in range(5):
        colors.see_moving(lab(picture(SKIN))[:, 0])
        colors.see_ground(lab(picture(GROUND))[:, 0])
    said = colors.said(picture(SKIN, GROUND, TOOL))
    assert (said.tool[:, :2] < 0).mean() > 0.9 and (said.tool[:, 2] > 0).mean() > 0.9
    assert said.touches[:, 0].mean() > 0.9 and said.touches[:, 1:].mean() < 0.1
