"""Edges between colours are found to a fraction of a pixel, by how much of a line is of the one and of the other."""

import cv2
import numpy as np
import pytest

from magic_perception.color_edges import CONTRAST, parted

TOOL, GROUND = np.array([112.0, 82.0, 55.0]), np.array([186.0, 152.0, 112.0])


def strip(low, high, angle, ground=GROUND):
    """A picture, as sharp as a lens makes it, of a strip of the tool's colour about its middle: from ``low`` to ``high`` pixels along a
    direction."""
    fine, size = 8, 60
    v, u = (np.indices((size * fine,) * 2) + 0.5) / fine - 0.5
    along = (u - size / 2) * np.cos(angle) + (v - size / 2) * np.sin(angle)
    picture = np.where(((along > low) & (along < high))[..., None], TOOL, ground).astype(np.float32)
    picture = cv2.GaussianBlur(cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA), (0, 0), 0.6)
    return np.clip(picture + np.random.default_rng(0).normal(0, 1.2, picture.shape), 0, 255).astype(np.uint8)


def lines(angle):
    """Starts (K, 2) of lines beside each other through the picture's middle, their direction (K, 2)."""
    aside = np.arange(-10, 11)[:, None] * [-np.sin(angle), np.cos(angle)]
    return aside + 30.0, np.tile([np.cos(angle), np.sin(angle)], (21, 1))


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
@pytest.mark.parametrize("thought", [-0.9, 0.0, 0.9])
def test_an_edge_is_where_the_colours_part_wherever_it_was_thought_to_be(angle, thought):
    starts, outwards = lines(angle)
    at, found = parted(
        strip(-9.0, 1.3, angle), np.zeros((60, 60), bool), starts, outwards, np.full(21, 1.3 + thought), np.full((21, 2), 5.0)
    )
    assert found.all() and abs(at.mean() - 1.3) < 0.1 and np.abs(at - 1.3).max() < 0.3


def test_a_wire_is_no_wider_than_it_is():
    starts, outwards = lines(0.4)
    picture, none = strip(-1.2, 1.2, 0.4), np.zeros((60, 60), bool)
    for side in (1, -1):
        at, found = parted(picture, none, starts, side * outwards, np.full(21, 1.7), np.column_stack([np.full(21, 1.2), np.full(21, 5.0)]))
        assert found.all() and abs(at.mean() - 1.2) < 0.4  # its middle is mixed a little as well


def test_where_colours_are_alike_or_hidden_there_is_no_edge():
    starts, outwards = lines(0.0)
    about, room = np.full(21, 1.0), np.full((21, 2), 5.0)
    _, found = parted(strip(-9.0, 1.0, 0.0, ground=TOOL + CONTRAST / 4), np.zeros((60, 60), bool), starts, outwards, about, room)
    assert not found.any()
    hidden = np.zeros((60, 60), bool)
    hidden[:30, 32] = True
    at, found = parted(strip(-9.0, 1.0, 0.0), hidden, starts, outwards, about, room)
    assert not found[:10].any() and found[10:].all() and (at[:10] == 1.0).all()
