"""The score's properties."""

import math

import pytest

from magic_matcher import score


def test_ratio_is_symmetric_bounded_and_one_where_equal():
    assert score.curvature_score(2.0, 2.0) == 1.0
    assert score.curvature_score(2.0, 1.0) == score.curvature_score(1.0, 2.0) == pytest.approx(0.5)
    assert score.curvature_score(3.0, 6.0) == pytest.approx(math.exp(-abs(math.log(2))))


def test_straight_edges_and_signs():
    assert score.curvature_score(math.inf, math.inf) == 1.0
    assert score.curvature_score(1.0, math.inf) == 0.0
    assert score.curvature_score(1.0, 1.0, same_sign=False) == 0.0


def test_better_curvature_never_lowers_the_score():
    assert score.combine(0.5, 0.9) > score.combine(0.5, 0.1)
