"""Lines through convex pieces, by what geometry says of them."""

import numpy as np
import planner_scenes as scenes
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_planner.collision import solid
from magic_planner.lines import between, crossings, through


def piece(turn, at, sides):
    return scenes.box(sides).transformed(transforms.from_rpy(*turn, at))


def chord(turn, at, sides, point, direction):
    """Length of a line within a box, by its three slabs in the box's own frame."""
    own = transforms.inverse(transforms.from_rpy(*turn, at))
    start, way = transforms.apply(own, point[None])[0], own[:3, :3] @ direction
    low, high = -np.inf, np.inf
    for axis in range(3):
        half = sides[axis] / 2
        if abs(way[axis]) < 1e-12:
            if abs(start[axis]) > half:
                return 0.0
            continue
        ends = sorted((sign * half - start[axis]) / way[axis] for sign in (-1, 1))
        low, high = max(low, ends[0]), min(high, ends[1])
    return max(0.0, high - low)


numbers = st.floats(-1.0, 1.0, allow_nan=False)


@settings(max_examples=60, deadline=None)
@given(st.lists(numbers, min_size=12, max_size=12))
def test_a_line_crosses_a_box_as_far_as_its_slabs_say(drawn):
    turn, at, point = np.array(drawn[:3]) * 3, np.array(drawn[3:6]) * 0.05, np.array(drawn[6:9]) * 0.1
    direction = transforms.unit(np.array(drawn[9:12]) + np.array([1e-3, 0, 2e-3]))
    sides = (0.02, 0.06, 0.1)
    found = list(crossings(solid([piece(turn, at, sides)]), point[None, None], direction[None]))
    length = sum(float(np.maximum(c.leave - c.enter, 0).sum()) for c in found)
    assert length == pytest.approx(chord(turn, at, sides, point, direction), abs=1e-6)


@pytest.mark.parametrize("axis", range(3))
def test_lines_along_the_sides_of_a_box_are_found_inside_and_not_beside(axis):
    sides, other = (0.02, 0.04, 0.06), [n for n in range(3) if n != axis]
    direction = np.eye(3)[axis]
    inside, beside = np.zeros(3), np.zeros(3)
    inside[other[0]], beside[other[0]] = 0.49 * sides[other[0]], 0.51 * sides[other[0]]
    box = solid([piece((0, 0, 0), (0, 0, 0), sides)])
    for point, length in ((inside, sides[axis]), (beside, 0.0)):
        for sign in (1, -1):
            found = list(crossings(box, point[None, None], sign * direction[None]))
            assert sum(float(np.maximum(c.leave - c.enter, 0).sum()) for c in found) == pytest.approx(length, abs=1e-9)


def test_pieces_that_abut_are_gone_through_as_one():
    row = solid([piece((0, 0, 0), (x, 0, 0), (0.02, 0.02, 0.02)) for x in (0.0, 0.02, 0.05)])
    length, normal, _ = through(row, np.array([[-0.01, 0.001, 0.002]]), np.array([[1.0, 0, 0]]))
    assert length[0] == pytest.approx(0.04, abs=1e-6)  # the third one is 10 mm behind
    np.testing.assert_allclose(normal[0], [1, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("start", "opening", "length", "beside"),
    [
        (-0.01, 0.09, 0.07, False),
        (-0.01, 0.05, 0.02, False),
        (-0.01, 0.5, 0.27, False),
        (0.04, 0.09, 0.02, True),
        (0.04, 0.04, 0.02, False),
    ],
)
def test_fingers_close_on_the_last_face_between_them(start, opening, length, beside):
    """Two bars with a gap of 30 mm, and one far from both: of a line from the first or the second, however wide fingers about it are
    open."""
    bars = solid([piece((0, 0, 0), (x, 0, 0), (0.02, 0.1, 0.02)) for x in (0.0, 0.05, 0.25)])
    found, normal, before = between(bars, np.array([[start, 0.001, 0.002]]), np.array([[1.0, 0, 0]]), opening)
    assert found[0] == pytest.approx(length, abs=1e-6) and before[0] == beside
    np.testing.assert_allclose(normal[0], [1, 0, 0], atol=1e-6)
