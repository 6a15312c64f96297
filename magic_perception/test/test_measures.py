"""The measures of segmentations against masks whose overlaps are known."""

import numpy as np
import pytest

from magic_perception.measures import best_ious, mean, measure
from magic_perception.percentiles import percentile

SIZE = (120, 160)


def picture(*boxes):
    labels = np.zeros(SIZE, np.int32)
    for number, (top, left, bottom, right) in enumerate(boxes, 1):
        labels[top:bottom, left:right] = number
    return labels


def test_the_same_picture_under_other_numbers_is_perfect():
    truth = picture((10, 10, 40, 50), (60, 20, 100, 60))
    labels = np.where(truth > 0, 30 - truth, 0)
    assert tuple(vars(measure(labels, truth)).values()) == pytest.approx([1.0] * 8)


def test_two_things_taken_for_one():
    truth = picture((10, 10, 40, 40), (10, 40, 40, 100))
    found = measure(np.minimum(truth, 1), truth)
    # The larger one (60 of 90 columns) is matched.
    assert found.overlap_precision == found.overlap_recall == pytest.approx(2 / 3)
    assert found.iou == pytest.approx((1 / 3 + 2 / 3) / 2)
    assert found.detected == 0.5
    assert found.boundary_precision > 0.6 > found.boundary_recall


def test_an_invented_thing_costs_precision_only():
    truth = picture((10, 10, 40, 40))
    found = measure(picture((10, 10, 40, 40), (60, 60, 70, 90)), truth)
    assert found.overlap_precision == pytest.approx(900 / 1200) and found.overlap_recall == 1 and found.detected == 1
    assert found.boundary_precision < found.boundary_recall == 1


def test_an_outline_may_be_off_by_a_pixel_but_not_by_four():
    truth = picture((20, 20, 60, 60))
    one, four = (measure(picture((20, 20 + by, 60, 60 + by)), truth).boundary_f for by in (1, 4))
    assert one == 1 and four < 0.6


def test_empty_pictures():
    nothing, one = picture(), picture((10, 10, 40, 40))
    assert measure(nothing, nothing).overlap_f == 1
    assert measure(nothing, one).overlap_f == measure(one, nothing).overlap_f == 0
    assert best_ious(nothing, one).tolist() == [0] and best_ious(one, nothing).tolist() == []
    assert mean([measure(one, one), measure(nothing, one)]).detected == 0.5


def test_percentiles_are_those_of_numpy_to_the_bit():
    rng = np.random.default_rng(0)
    for count in (1, 2, 3, 10, 777):
        for values in (rng.normal(size=count), np.round(rng.normal(size=count), 1), np.zeros(count)):
            for share in (0, 3, 50, 80, 85.0, 97, 100):
                assert percentile(values, share) == np.percentile(values, share)
                assert percentile(values[::-2], share) == np.percentile(values[::-2], share)
