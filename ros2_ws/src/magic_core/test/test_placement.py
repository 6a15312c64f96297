"""Places of several contacts against one rigid, scaled, mirrored tool."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.placement import Relative, mirrored, placement, relative, together

FIRST = transforms.frame(np.array([0.1, 0.02, 0.0]), np.array([-1.0, 0, 0]), np.array([0, 0, -1.0]))
OTHERS = [
    transforms.frame(np.array([0.0, -0.03, 0.0]), np.array([0, -1.0, 0]), np.array([0, 0, -1.0])),
    transforms.frame(np.array([-0.08, 0.05, 0.0]), np.array([0.6, 0.8, 0]), np.array([0, 0, -1.0])),
]


def seen(first, others):
    return [relative(first, other) for other in others]


@given(angle=st.floats(-3, 3), scale=st.floats(0.5, 2.0), x=st.floats(-1, 1), mirror=st.booleans())
@settings(max_examples=50, deadline=None)
def test_a_moved_scaled_mirrored_tool_agrees_wholly(angle, scale, x, mirror):
    move = transforms.from_rpy(0.3, -0.4, angle, (x, 0.2, 0.1))

    def made(frame):
        frame = frame.copy()
        frame[:3, 3] *= scale
        if mirror:  # across the xz plane, the frame right-handed again
            over = np.diag([1.0, -1.0, 1.0, 1.0])
            frame = over @ frame @ over
        return move @ frame

    found = seen(made(FIRST), map(made, OTHERS))
    found = [mirrored(place) for place in found] if mirror else found
    result = placement(seen(FIRST, OTHERS), found, (0.2, 0.2 * scale))
    assert result.agreement == pytest.approx(1.0, abs=1e-6)
    assert result.angle == pytest.approx(0.0, abs=1e-6) and result.scale == pytest.approx(scale, rel=1e-6)


def test_a_first_normal_that_is_off_alone_is_told_as_the_angle():
    wanted = seen(FIRST, OTHERS)
    off = FIRST @ transforms.from_rotvec([0, 0, 0.2])
    result = placement(wanted, seen(off, OTHERS), (0.2, 0.2))
    # Two vectors and two normals say that the first is turned by 0.2, it alone says that it is not.
    assert result.angle == pytest.approx(-0.2 * 4 / 5, abs=2e-3) and 0.9 < result.agreement < 1


@pytest.mark.parametrize(
    "changed",
    [
        lambda p: Relative(p.vector * [-1, 1], p.angle),
        lambda p: Relative(p.vector, p.angle + np.pi / 2),
        lambda p: Relative(p.vector @ [[0, 1], [-1, 0]], p.angle),
    ],
)
def test_what_is_no_placement_agrees_little(changed):
    wanted = seen(FIRST, OTHERS)
    assert placement(wanted, [wanted[0], changed(wanted[1])], (0.2, 0.2)).agreement < 0.4


def test_one_scale_holds_for_all_lengths_and_is_near_the_tools():
    wanted = seen(FIRST, OTHERS)
    stretched = [Relative(p.vector * factor, p.angle) for p, factor in zip(wanted, (1.0, 3.0), strict=True)]
    assert placement(wanted, stretched, (0.2, 0.2)).agreement < 0.5
    alike = [Relative(p.vector * 2, p.angle) for p in wanted]
    assert placement(wanted, alike, (0.2, 0.4)).agreement == pytest.approx(1.0)
    assert placement(wanted, alike, (0.2, 0.4)).agreement > placement(wanted, alike, (0.2, 0.1)).agreement


def test_places_at_one_point_have_no_direction():
    wanted = [Relative(np.zeros(2), 0.0)]
    assert placement(wanted, [Relative(np.array([0.0, 1e-5]), 0.0)], (0.2, 0.2)).agreement == pytest.approx(1.0, abs=1e-3)
    assert placement(wanted, [Relative(np.array([0.0, 0.15]), 0.0)], (0.2, 0.2)).agreement < 0.1


def corner(size, turn=0.0, along=(0.0, 0.0)):
    """Two places on a square corner's inner sides, the first's and the second's, so far along them (m): relative to the first."""
    first = transforms.frame(np.array([0.0, -size - along[0], 0.0]), np.array([-1.0, 0, 0]), np.array([0, 0, -1.0]))
    second = transforms.frame(np.array([-size - along[1], 0.0, 0.0]), np.array([0, -1.0, 0]), np.array([0, 0, -1.0]))
    return relative(first, second @ transforms.from_rotvec([0, 0, turn]))


def test_two_straight_sides_are_met_wherever_along_them_they_were_told():
    angle, shift = together([corner(0.02)], [corner(0.02, along=(0.03, 0.01))], [True, True])
    # The second side is 30 mm too far away along the first's tangent; nothing is lacking across the first.
    assert angle == pytest.approx(0.0, abs=1e-9)
    assert abs(shift[0]) < 1e-3 and abs(shift[1]) == pytest.approx(0.03, rel=0.03)
    moved = corner(0.02, along=(0.03, 0.01)).vector + shift
    across = np.array([np.cos(corner(0.02).angle), np.sin(corner(0.02).angle)])
    assert abs((moved - corner(0.02).vector) @ across) < 1e-3


def test_two_round_places_share_what_is_lacking():
    angle, shift = together([corner(0.02)], [corner(0.02, along=(0.03, 0.0))], [False, False])
    assert abs(angle) > 0.05 and 0.005 < np.hypot(*shift) < 0.03


def test_a_skew_corner_is_turned_by_half_of_it():
    angle, _ = together([corner(0.02)], [corner(0.02, turn=0.2)], [True, True])
    assert angle == pytest.approx(0.1, abs=1e-9)


def test_between_two_jaws_the_middle_is_taken():
    facing = Relative(np.array([-0.05, 0.0]), np.pi)
    wider = Relative(np.array([-0.07, 0.0]), np.pi)
    angle, shift = together([facing], [wider], [True, True])
    assert angle == pytest.approx(0.0, abs=1e-9) and np.allclose(shift, [0.01, 0.0], atol=1e-6)
