"""What of a target is met: flat sides, round ones and corners, smooth and rough."""

import numpy as np
import pytest

from magic_core.contact import Contact
from magic_matcher import contour, facing

#: Pixels a millimetre, and of a picture's side.
FINE, SIDE = 5.0, 520
DIRECTION = np.array([0.6, -0.8])


def outline(distance):
    """The contour of what has a signed distance (mm), a function of two coordinates (mm) from the picture's middle."""
    v, u = (np.mgrid[0:SIDE, 0:SIDE] - (SIDE - 1) / 2) / FINE
    return contour.extract(distance(u, v) < 0)


def box(width, depth, turn, rounded=0.0, noise=0.0, seed=0):
    """A box whose depth lies along DIRECTION, turned (degrees) from there."""
    angle = np.arctan2(DIRECTION[1], DIRECTION[0]) + np.deg2rad(turn)

    def distance(u, v):
        x, y = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
        qx, qy = np.abs(x) - depth / 2 + rounded, np.abs(y) - width / 2 + rounded
        return np.hypot(np.maximum(qx, 0), np.maximum(qy, 0)) + np.minimum(np.maximum(qx, qy), 0) - rounded + rough(u, v, noise, seed)

    return outline(distance), np.array([np.cos(angle), np.sin(angle)])


def disc(radius, noise=0.0, seed=0):
    return outline(lambda u, v: np.hypot(u, v) - radius + rough(u, v, noise, seed))


def rough(u, v, noise, seed):
    """Waves of 6 to 16 mm along an outline, root mean square ``noise`` mm."""
    rng = np.random.default_rng(seed)
    waves = [
        np.sin((u * np.cos(a) + v * np.sin(a)) * 2 * np.pi / w + p) for a, w, p in rng.uniform([0, 6, 0], [np.pi, 16, 2 * np.pi], (8, 3))
    ]
    return noise * np.sum(waves, axis=0) / 2


def away(found):
    """Where a side's point is from the picture's middle, mm."""
    return (found.point - (SIDE - 1) / 2) / FINE


@pytest.mark.parametrize(("width", "depth"), [(40, 40), (60, 30), (30, 60)])
@pytest.mark.parametrize("rounded", [0.0, 3.0])
@pytest.mark.parametrize("turn", [-28, -10, 0, 5, 20])
def test_a_box_is_met_in_the_middle_of_the_side_that_faces_the_tool(width, depth, turn, rounded):
    shape, normal = box(width, depth, turn, rounded)
    found = facing.side(shape, DIRECTION)
    assert np.isinf(found.radius)
    assert away(found) == pytest.approx(depth / 2 * normal, abs=1.2)


@pytest.mark.parametrize("noise", [0.5, 1.0])
@pytest.mark.parametrize("turn", [0, 10])
def test_a_rough_side_is_flat_all_the_same_but_for_one_in_five(turn, noise):
    shapes = [box(40, 40, turn, 2.0, noise, seed) for seed in range(5)]
    found = [(facing.side(shape, DIRECTION), normal) for shape, normal in shapes]
    flat = [(f, normal) for f, normal in found if np.isinf(f.radius)]
    assert len(flat) >= 4
    for f, normal in flat:
        assert away(f) == pytest.approx(20 * normal, abs=1.5 + 2 * noise)


@pytest.mark.parametrize("turn", [-20, 30, 45])
def test_the_waves_of_a_rough_box_are_no_small_discs(turn):
    for seed in range(3):
        found = facing.side(box(40, 40, turn, 2.0, 1.0, seed)[0], DIRECTION)
        disc_radius = Contact(found.point, DIRECTION, found.radius, False, found.scale, np.eye(4)).disc_radius
        assert disc_radius is None or disc_radius > 10 * FINE


@pytest.mark.parametrize("rounded", [0.0, 1.0, 3.0])
@pytest.mark.parametrize("turn", [45, 40])
def test_a_corner_that_is_led_against_is_met_and_stands_for_no_disc(turn, rounded):
    shape, _ = box(40, 40, turn, rounded)
    found = facing.side(shape, DIRECTION)
    reach = (shape.points @ DIRECTION).max() - (SIDE - 1) / 2 * DIRECTION.sum()
    assert found.radius / FINE == pytest.approx(rounded, abs=0.6)
    assert away(found) @ DIRECTION == pytest.approx(reach / FINE, abs=0.3)
    contact = Contact(found.point, DIRECTION, found.radius, False, found.scale, np.eye(4))
    assert contact.disc_radius is None


@pytest.mark.parametrize("radius", [15, 25, 40])
def test_a_disc_is_met_where_it_is_farthest_and_keeps_its_radius(radius):
    found = facing.side(disc(radius), DIRECTION)
    assert found.radius / FINE == pytest.approx(radius, rel=0.005)
    assert away(found) == pytest.approx(radius * DIRECTION, abs=0.1)
    assert Contact(found.point, DIRECTION, found.radius, False, found.scale, np.eye(4)).disc_radius == found.radius


@pytest.mark.parametrize("noise", [0.5, 1.0])
def test_a_rough_disc_keeps_its_radius_but_for_one_in_five(noise):
    found = [facing.side(disc(25, noise, seed), DIRECTION) for seed in range(10)]
    right = [f for f in found if f is not None and f.radius / FINE == pytest.approx(25, rel=0.2)]
    assert len(right) >= 8
    assert all(away(f) == pytest.approx(25 * DIRECTION, abs=3) for f in right)


def test_the_tip_of_an_ellipse_is_left_to_its_curvature():
    u, v = DIRECTION
    shape = outline(lambda x, y: np.hypot((x * u + y * v) / 45, (y * u - x * v) / 18) - 1)
    assert facing.side(shape, DIRECTION) is None


def test_a_notch_is_no_side():
    """Of a U that opens towards the tool the arms are met, not the floor between them."""

    def distance(u, v):
        x, y = u * DIRECTION[0] + v * DIRECTION[1], v * DIRECTION[0] - u * DIRECTION[1]
        return np.maximum(np.maximum(np.abs(x) - 20, np.abs(y) - 30), -np.maximum(-x - 5, np.abs(y) - 22))

    found = facing.side(outline(distance), DIRECTION)
    assert found is None or away(found) @ DIRECTION > 15


@pytest.mark.parametrize("turn", [0.0, 25.0])
@pytest.mark.parametrize(("place", "askew"), [((0.0, -12.0), 30.0), ((0.0, -3.0), 40.0), ((-3.0, 0.0), 60.0), ((-14.0, 0.0), 85.0)])
def test_beside_an_inner_corner_the_straight_side_is_found(turn, place, askew):
    """An L of 20 mm arms whose inner sides meet in the middle of the picture: x = 0 faces -x, y = 0 faces -y; told normals are askew."""
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))

    def distance(u, v):
        x, y = u * c + v * s, v * c - u * s
        return np.where((x > -30) & (x < 10) & (y > -30) & (y < 10) & ((x > 0) | (y > 0)), -1.0, 1.0)

    def shown(p):
        return np.array([[c, -s], [s, c]]) @ p

    found = outline(distance)
    point = FINE * shown(np.array(place)) + (SIDE - 1) / 2
    side, normal = facing.straight_at(found, point + 1.0, shown(np.array([-np.cos(np.deg2rad(askew)), -np.sin(np.deg2rad(askew))])))
    wanted = np.array([-1.0, 0.0]) if place[0] == 0 else np.array([0.0, -1.0])
    assert normal @ shown(wanted) > np.cos(np.deg2rad(1.0))
    assert abs((side.point - point) @ normal) < 1.5 and side.radius == np.inf
    assert facing.straight_at(found, point, -shown(wanted)) is None


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("length", [80.0, 30.0])
def test_a_place_on_a_straight_side_goes_to_where_another_is_on_its_own(length, mirrored):
    """Met 5 mm from one end; shown with 35 and 10 mm to its hands: where the side is long enough with as much, else in that proportion."""
    shape, normal = box(length, 20.0, 0.0)
    along, middle = np.array([-normal[1], normal[0]]), np.full(2, (SIDE - 1) / 2)
    place = middle + FINE * (10.0 * normal + (5.0 - length / 2) * along)
    found = facing.ends(shape, place, normal)
    assert [found.behind / FINE, found.ahead / FINE] == pytest.approx([5.0, length - 5.0], abs=3.0)

    def shown(behind, ahead):
        return facing.Ends(np.zeros(2), np.array([1.0, 0.0]), *((ahead, behind) if mirrored else (behind, ahead)))

    moved = (found.like(shown(35.0, 10.0), mirrored, FINE) - middle) / FINE
    assert moved @ along + length / 2 == pytest.approx(35.0 if length > 45 else length * 35 / 45, abs=2.0)
    assert moved @ normal == pytest.approx(10.0, abs=1.0)
    assert found.like(shown(4.0, 10.0), mirrored, FINE) == pytest.approx(place, abs=3.0)


def test_a_round_side_has_no_ends():
    shape = disc(30.0)
    assert facing.ends(shape, shape.points[0], shape.normals[0]) is None
