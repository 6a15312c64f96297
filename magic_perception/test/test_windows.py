"""What is done in the window of a thing, or of some links first, is what is done of all."""

import cv2
import numpy as np
import pytest

from magic_perception import clusters, labels
from magic_perception.percentiles import bounds
from magic_perception.pixels import window


@pytest.mark.parametrize("margin", [0, 3, 40])
def test_a_window_holds_a_thing_and_ends_with_the_picture(margin):
    mask = np.zeros((60, 80), bool)
    mask[20:31, 50:78] = True
    rows, columns = window(mask, margin)
    assert (rows.start, columns.start) == (max(20 - margin, 0), max(50 - margin, 0))
    assert mask[rows, columns].shape == (min(31 + margin, 60) - rows.start, min(78 + margin, 80) - columns.start)
    assert mask[window(np.zeros_like(mask), margin)].size == 0


def test_links_join_what_they_reach_in_the_order_of_the_first():
    # A chain through every other thing, its links in any order, and one thing alone.
    rng = np.random.default_rng(0)
    a = rng.permutation(np.arange(0, 198, 2))
    assert np.array_equal(clusters.linked(201, a, a + 2)[:200:2], np.zeros(100))
    assert np.array_equal(clusters.linked(201, a, a + 2)[1::2], np.arange(1, 101))
    assert len(clusters.linked(0, a[:0], a[:0])) == 0


def test_bounds_are_the_lowest_and_the_highest_of_each_axis():
    points = np.random.default_rng(0).normal(size=(500, 3))
    assert np.array_equal(bounds(points), (points.min(axis=0), points.max(axis=0)))


def test_what_is_missing_gets_the_nearest_label_in_reach_of_its_own_region():
    mask = np.zeros((80, 120), bool)
    mask[10:20, 5:60] = mask[50:60, 5:60] = True
    image = np.zeros(mask.shape, np.int32)
    image[10:20, 5:10], image[10:20, 20:22] = 1, 2
    found = labels.fill(image, mask)
    distance = cv2.distanceTransform((image == 0).view(np.uint8), cv2.DIST_L2, 5)
    assert np.array_equal(found[:30] > 0, (mask & (distance <= 24))[:30])
    assert not found[50:60].any()
    assert found[15, 12] == 1 and found[15, 18] == 2
