"""The local stage against shapes whose curvature is known."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core.errors import Code, MagicError
from magic_matcher import contour, curvature

SIZE = 384
V, U = np.mgrid[0:SIZE, 0:SIZE]
CENTRE = np.array([191.3, 190.7])


def disc(radius, centre=CENTRE):
    return np.hypot(U - centre[0], V - centre[1]) <= radius


def ring(outer, inner):
    return disc(outer) & ~disc(inner)


def polygon(points):
    mask = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillPoly(mask, [np.round(np.asarray(points) * 16).astype(np.int32)], 1, shift=4)
    return mask > 0


def hook(radius=24.0, width=18.0, turn=0.0, scale=1.0, mirror=False, shift=(0.0, 0.0)):
    """An L with a round inner corner: its mask (pixels whose centres lie on it), where the middle of that corner lies, its normal."""
    c, s = np.cos(turn), np.sin(turn)
    linear = scale * np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if mirror else 1.0, 1.0])
    corner = radius * np.array([np.cos(np.pi / 4), np.sin(np.pi / 4)])
    shift = CENTRE - linear @ np.array([-45.0, -5.0]) + shift
    x, y = np.moveaxis((np.stack([U, V], axis=-1) - shift) @ np.linalg.inv(linear).T, -1, 0)

    def before(r):
        return (x < r) & (y < r) & ((x < 0) | (y < 0) | (np.hypot(x, y) < r))

    mask = before(radius + width) & ~before(radius) & (x > -150) & (y > -60)
    return mask, linear @ corner + shift, linear @ np.array([-1, -1]) / np.sqrt(2) / scale


@pytest.mark.parametrize(("a", "b", "median", "each"), [(40, 20, 0.06, 0.15), (60, 30, 0.03, 0.08)])
def test_small_tips_are_not_taken_for_fillets(a, b, median, each):
    random = np.random.default_rng(5)
    errors = []
    for _ in range(20):
        turn = random.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        x, y = (U - CENTRE[0]) * c + (V - CENTRE[1]) * s, (V - CENTRE[1]) * c - (U - CENTRE[0]) * s
        edge = contour.extract((x / a) ** 2 + (y / b) ** 2 <= 1)
        errors.append(abs(curvature.estimate(edge, edge.nearest(CENTRE + (a * c, a * s))).radius / (b * b / a) - 1))
    assert np.median(errors) <= median and max(errors) <= each


#: Largest error of the radius by the radius in pixels, over random places and directions: (median, each).
DISCS = {6: (0.04, 0.06), 8: (0.02, 0.04), 10: (0.015, 0.03), 15: (0.01, 0.03), 30: (0.005, 0.02), 60: (0.005, 0.01), 120: (0.005, 0.01)}
FILLETS = {8: (0.05, 0.3), 10: (0.04, 0.1), 12: (0.03, 0.08), 14: (0.03, 0.08), 20: (0.03, 0.1), 40: (0.02, 0.05), 60: (0.02, 0.05)}


@pytest.mark.parametrize("radius", DISCS)
def test_disc(radius):
    random = np.random.default_rng(radius)
    errors = []
    for _ in range(9):
        centre, angle = CENTRE + random.uniform(-0.5, 0.5, 2), random.uniform(0, 2 * np.pi)
        out = np.array([np.cos(angle), np.sin(angle)])
        c = contour.extract(disc(radius, centre))
        found = curvature.estimate(c, c.nearest(centre + radius * out))
        errors.append(abs(found.radius / radius - 1))
        assert not found.concave
        # At a small radius the contour point itself is known to half a step only.
        assert found.normal @ out > np.cos(max(0.03, 0.8 / radius))
    assert np.median(errors) <= DISCS[radius][0] and max(errors) <= DISCS[radius][1]


def test_large_disc():
    v, u = np.mgrid[0:430, 0:430]
    c = contour.extract(np.hypot(u - 214.6, v - 215.2) <= 200)
    assert curvature.estimate(c, c.nearest((414, 200))).radius == pytest.approx(200, rel=0.01)


@pytest.mark.parametrize(("outer", "inner"), [(60, 56), (60, 50), (100, 94), (30, 26), (150, 145)])
def test_thin_ring_has_two_edges(outer, inner):
    c = contour.extract(ring(outer, inner))
    direction = np.array([np.cos(0.3), np.sin(0.3)])
    out = curvature.estimate(c, c.nearest(CENTRE + outer * direction))
    into = curvature.estimate(c, c.nearest(CENTRE + inner * direction))
    assert out.radius == pytest.approx(outer, rel=0.05) and not out.concave
    assert into.radius == pytest.approx(inner, rel=0.05) and into.concave
    assert out.normal @ direction > 0.95 and into.normal @ direction < -0.95


def test_one_step_misjudges_what_two_steps_get_right():
    # A disc before a wall: at large scales the wall is no part of the disc's edge, and the walk does not reach it.
    mask = disc(40)
    mask |= (CENTRE[0] + 46 <= U) & (CENTRE[0] + 60 >= U)
    c = contour.extract(mask)
    found = curvature.estimate(c, c.nearest(CENTRE + [40, 0]))
    assert found.radius == pytest.approx(40, rel=0.05) and not found.concave


def test_parallel_edges_are_straight():
    mask = np.zeros((SIZE, SIZE), bool)
    mask[180:190, 40:340] = True
    c = contour.extract(mask)
    for v, normal in ((179.5, [0, -1]), (189.5, [0, 1])):
        found = curvature.estimate(c, c.nearest((190, v)))
        assert found.radius > 3 * c.size
        assert found.normal @ normal > 0.999


@pytest.mark.parametrize(("a", "b"), [(140, 110), (120, 90), (150, 130)])
def test_ellipse_at_scales_short_against_its_radius(a, b):
    c = contour.extract(((U - CENTRE[0]) / a) ** 2 + ((V - CENTRE[1]) / b) ** 2 <= 1)
    tip, flat = b * b / a, a * a / b
    for offset, radius in (((a, 0), tip), ((0, b), flat)):
        found = curvature.estimate(c, c.nearest(CENTRE + offset), scales=np.array([0.4 * radius]))
        assert found.radius == pytest.approx(radius, rel=0.05) and not found.concave


def test_corners():
    mask = np.zeros((SIZE, SIZE), bool)
    mask[50:330, 50:70] = True
    mask[50:70, 50:250] = True
    c = contour.extract(mask)
    inner = curvature.estimate(c, c.nearest((69.5, 69.5)))
    outer = curvature.estimate(c, c.nearest((49.5, 49.5)))
    assert inner.concave and not outer.concave
    assert inner.normal @ [1, 1] > 1.4 and outer.normal @ [-1, -1] > 1.4


@pytest.mark.parametrize("radius", [20, 30, 40])
def test_fillet_is_right_at_scales_within_it(radius):
    mask, corner, normal = hook(radius)
    c = contour.extract(mask)
    found = curvature.estimate(c, c.nearest(corner), scales=np.array([0.7 * radius]))
    assert found.radius == pytest.approx(radius, rel=0.06) and found.concave
    assert found.normal @ normal > 0.99


@pytest.mark.parametrize(("a", "b"), [(140, 110), (120, 90), (150, 130), (140, 50), (150, 80), (120, 100), (100, 55)])
@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_ellipse_at_the_scale_that_is_chosen(a, b, turn):
    c, s = np.cos(turn), np.sin(turn)
    x, y = (U - CENTRE[0]) * c + (V - CENTRE[1]) * s, (V - CENTRE[1]) * c - (U - CENTRE[0]) * s
    edge = contour.extract((x / a) ** 2 + (y / b) ** 2 <= 1)
    for along, across, radius in ((a, 0, b * b / a), (0, b, a * a / b)):
        found = curvature.estimate(edge, edge.nearest(CENTRE + (along * c - across * s, along * s + across * c)))
        assert found.radius == pytest.approx(radius, rel=0.05) and not found.concave


@pytest.mark.parametrize("radius", FILLETS)
def test_fillet_at_the_scale_that_is_chosen(radius):
    random = np.random.default_rng(radius)
    errors = []
    for k in range(9):
        mask, corner, normal = hook(radius, (8.0, 18.0)[k % 2], random.uniform(0, 2 * np.pi), shift=random.uniform(-0.5, 0.5, 2))
        c = contour.extract(mask)
        found = curvature.estimate(c, c.nearest(corner))
        errors.append(abs(found.radius / radius - 1))
        assert found.concave and found.normal @ normal > 0.98
    assert np.median(errors) <= FILLETS[radius][0] and max(errors) <= FILLETS[radius][1]


def test_fillet_model_is_exact_on_exact_points():
    radius, (left, right) = 7.0, (0.9, 0.6)
    w = np.linspace(-left, right, 15)
    arc = radius * np.column_stack([np.sin(w), 1 - np.cos(w)])
    t = np.arange(1.0, 20.0)[:, None]
    points = np.concatenate([(arc[0] + t * [-np.cos(left), np.sin(left)])[::-1], arc, arc[-1] + t * [np.cos(right), np.sin(right)]])
    for sign in (1, -1):  # mirrored, as a walk the other way round has it
        found = curvature.fillet(sign * points[:, 0], points[:, 1], 0.0)
        assert found is not None
        assert found[0] == pytest.approx(radius, rel=0.01) and found[1] < 0.01
    # A sharp corner has no arc, one arm alone no corner.
    assert curvature.fillet(t[:, 0] - 10, 0.01 * t[:, 0], 0.0) is None


@settings(max_examples=10, deadline=None)
@given(turn=st.floats(0, 2 * np.pi), scale=st.floats(0.55, 1.0), mirror=st.booleans())
def test_equivariance(turn, scale, mirror):
    plain, corner, normal = hook()
    moved, corner2, normal2 = hook(turn=turn, scale=scale, mirror=mirror)
    first, second = contour.extract(plain), contour.extract(moved)
    a, b = curvature.estimate(first, first.nearest(corner)), curvature.estimate(second, second.nearest(corner2))
    assert a.concave and b.concave
    assert b.radius / scale == pytest.approx(a.radius, rel=0.2)
    assert a.normal @ normal > 0.98 and b.normal @ normal2 > 0.98


def test_arc_curvature_inverts_the_fit():
    for radius in (10.0, 40.0):
        for t in (0.3, 1.0, 1.6, 1.95):
            w = np.linspace(-1, 1, 4001) * 2 * np.arcsin(t / 2)
            x, y = radius * np.sin(w), radius * (1 - np.cos(w))
            a = np.sum(y * x * x) / np.sum(x**4)
            assert curvature.arc_curvature(a, t * radius) == pytest.approx(1 / radius, rel=2e-3)
            assert curvature.arc_curvature(-a, t * radius) == pytest.approx(-1 / radius, rel=2e-3)


def test_convexity_search_crosses_the_stroke():
    mask, corner, normal = hook()
    c = contour.extract(mask)
    outside = c.nearest(corner - 18 * normal)  # the outer side of the bend
    found = curvature.estimate(c, outside, concave=True)
    assert found.concave
    assert np.hypot(*(found.point - corner)) < 8


def test_empty_and_tiny_masks_have_codes():
    for mask in (np.zeros((50, 50), bool), np.pad(np.ones((1, 1), bool), 20)):
        with pytest.raises(MagicError) as caught:
            contour.extract(mask)
        assert caught.value.code == Code.EMPTY_MASK


def test_contour_touching_the_border():
    c = contour.extract(np.ones((60, 80), bool))
    assert c.points.min() >= -1 and c.points[:, 0].max() <= 80
    assert np.allclose(np.hypot(*c.normals.T), 1)
