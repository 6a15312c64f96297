"""Flat tools: an outline in the xy plane given a thickness (metres throughout)."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import ArrayLike

from magic_core.shapes.draw import Draw, recipe
from magic_core.shapes.shape import Region, Shape, assemble
from magic_core.shapes.solids import Array, arc, fillet, plate, stroke

DOWN, UP = (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)


def _bend(centre: ArrayLike, radius: float, start: float, end: float, concave: bool, count: int = 25) -> Region:
    """A circular stretch in the plane z = 0; concave: normals point to the centre."""
    points = arc(centre, radius, start, end, count)
    outward = (points - np.asarray(centre, dtype=float)) / radius * (-1 if concave else 1)
    return Region(_lift(points), _lift(outward), radius, concave)


def _straight(start: ArrayLike, end: ArrayLike, normal: ArrayLike, count: int = 9) -> Region:
    points = np.linspace(start, end, count)
    return Region(_lift(points), np.tile(_lift(np.asarray(normal, dtype=float)[None]), (count, 1)), float("inf"), False)


def _corner(corner: ArrayLike, bisector: float, half: float, radius: float) -> Region:
    """The fillet of a concave corner; ``bisector`` the angle of its outward (open) direction, ``half`` half its opening."""
    corner = np.asarray(corner, dtype=float)
    centre = corner + radius / np.sin(half) * np.array([np.cos(bisector), np.sin(bisector)])
    reach = np.pi / 2 - half
    return _bend(centre, radius, bisector + np.pi - reach, bisector + np.pi + reach, True)


def _lift(points: Array) -> Array:
    return np.column_stack([points, np.zeros(len(points))])


def _turn(points: ArrayLike, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points, dtype=float) @ np.array([[c, s], [-s, c]])


def l_hook(seed: int = 0, **given: float | str) -> Shape:
    """A bar with its end bent aside; region ``inner``: the inside of the bend."""
    d = Draw("l_hook", seed, given)
    length, tip = d.real("length", 0.18, 0.32), d.real("tip", 0.055, 0.10)
    width, thickness = d.real("width", 0.014, 0.024), d.real("thickness", 0.012, 0.022)
    inner = d.real("inner_radius", 0.008, 0.035)
    bend = d.real("bend", np.deg2rad(80), np.deg2rad(100))
    color = d.color()
    d.done()
    middle = inner + width / 2
    centre = (length / 2, middle)
    start = np.array([centre[0] - length, 0.0])
    turn = arc(centre, middle, -np.pi / 2, -np.pi / 2 + bend, 20)
    leave = np.array([np.cos(bend), np.sin(bend)])
    end = turn[-1] + leave * tip
    outline = stroke(np.concatenate([[start], turn, [end]]), width, flat_ends=True)
    regions = {
        "inner": _bend(centre, inner, -np.pi / 2, -np.pi / 2 + bend, True),
        "tip_inner": _straight(
            turn[-1] + leave * 0.1 * tip - width / 2 * _turn([leave], -np.pi / 2)[0],
            end - leave * 0.1 * tip - width / 2 * _turn([leave], -np.pi / 2)[0],
            _turn([leave], np.pi / 2)[0],
        ),
    }
    return assemble("l_hook", seed, d.parameters, [plate(outline, -thickness / 2, thickness / 2, color)], regions, "top", DOWN, UP)


def j_hook(seed: int = 0, **given: float | str) -> Shape:
    """A bar whose end turns back on itself; region ``inner``: the inside of the turn."""
    d = Draw("j_hook", seed, given)
    length, width, thickness = d.real("length", 0.16, 0.30), d.real("width", 0.010, 0.020), d.real("thickness", 0.012, 0.020)
    inner, bend, tip = d.real("inner_radius", 0.018, 0.045), d.real("bend", np.deg2rad(130), np.deg2rad(190)), d.real("tip", 0.005, 0.04)
    color = d.color()
    d.done()
    middle = inner + width / 2
    turn = arc((length / 2, middle), middle, -np.pi / 2, -np.pi / 2 + bend, 30)
    end = turn[-1] + tip * np.array([np.cos(bend), np.sin(bend)])
    outline = stroke(np.concatenate([[(-length / 2, 0)], turn, [end]]), width)
    regions = {"inner": _bend((length / 2, middle), inner, -np.pi / 3, min(np.pi / 3, bend - np.pi / 2), True)}
    return assemble("j_hook", seed, d.parameters, [plate(outline, -thickness / 2, thickness / 2, color)], regions, "top", DOWN, UP)


def s_hook(seed: int = 0, **given: float | str) -> Shape:
    """Two open loops turned against each other; regions ``upper`` and ``lower``: their insides."""
    d = Draw("s_hook", seed, given)
    width, thickness = d.real("width", 0.006, 0.012), d.real("thickness", 0.006, 0.012)
    upper, lower = d.real("upper_radius", 0.015, 0.035), d.real("lower_radius", 0.018, 0.040)
    neck, sweep = d.real("neck", 0.0, 0.08), d.real("sweep", np.deg2rad(190), np.deg2rad(235))
    color = d.color()
    d.done()
    a, b = upper + width / 2, lower + width / 2
    top, bottom = (-a, neck / 2), (b, -neck / 2)
    path = np.concatenate([arc(top, a, sweep, 0, 30), arc(bottom, b, np.pi, np.pi + sweep, 30)])
    if neck < 1e-4:
        path = np.delete(path, 30, axis=0)
    outline = stroke(path, width)
    regions = {
        "upper": _bend(top, upper, np.deg2rad(30), np.deg2rad(150), True),
        "lower": _bend(bottom, lower, np.deg2rad(210), np.deg2rad(330), True),
    }
    return assemble("s_hook", seed, d.parameters, [plate(outline, -thickness / 2, thickness / 2, color)], regions, "top", DOWN, UP)


def hanger(seed: int = 0, **given: float | str) -> Shape:
    """A coat hanger, hook towards +y; regions ``hook`` (inside of the hook, at its top), ``hook_side`` and ``shoulder``."""
    d = Draw("hanger", seed, given)
    span, drop = d.real("span", 0.28, 0.42), d.real("drop", 0.07, 0.14)
    width, thickness = d.real("width", 0.008, 0.016), d.real("thickness", 0.008, 0.016)
    inner, neck = d.real("inner_radius", 0.016, 0.030), d.real("neck", 0.015, 0.05)
    sweep, sag = d.real("sweep", np.deg2rad(225), np.deg2rad(285)), d.real("sag", 0.0, 0.03)
    bar, color, metal = d.choice("bar", ("straight", "none")), d.color(), d.color()
    d.done()
    middle = inner + width / 2
    half, top = span / 2, drop
    s = np.linspace(0, 1, 16)[:, None]
    left, right = np.array([-half, 0.0]), np.array([half, 0.0])
    apex = np.array([0.0, top])
    bow = np.sin(np.pi * s) * np.array([[0.0, sag]])
    shoulders = np.concatenate([left + (apex - left) * s + bow, (apex + (right - apex) * s + bow)[1:]])
    outline = stroke(shoulders, width)
    if bar == "straight":
        outline = outline.union(stroke([left, right], width))
    outline = fillet(outline, 0.003)
    centre = np.array([0.0, top + neck + middle])
    hook = stroke(np.concatenate([[apex], arc(centre, middle, -np.pi / 2, -np.pi / 2 + sweep, 40)]), width)
    parts = [
        plate(outline, -thickness / 2, thickness / 2, color),
        plate(hook, -thickness * 0.45, thickness * 0.45, metal),
    ]
    normal = _turn([(apex - left) / np.linalg.norm(apex - left)], np.pi / 2)[0]
    regions = {
        "hook": _bend(centre, inner, np.deg2rad(30), np.deg2rad(150) if sweep > np.deg2rad(240) else sweep - np.pi / 2, True),
        "hook_side": _bend(centre, inner, np.deg2rad(-45), np.deg2rad(30), True),
    }
    if bar == "straight":
        # Straight shoulders only: a bowed one has its own normals.
        regions["bar"] = _straight((-0.3 * half, width / 2), (0.3 * half, width / 2), (0, 1))
    if sag < 1e-6:
        regions["shoulder"] = _straight(left * 0.8 + apex * 0.2 + normal * width / 2, left * 0.4 + apex * 0.6 + normal * width / 2, normal)
    return assemble("hanger", seed, d.parameters, parts, regions, "side", DOWN, UP)


def scissors(seed: int = 0, **given: float | str) -> Shape:
    """Open scissors, blades towards +x; regions ``crotch`` (between the blades), ``ring_1``, ``ring_2`` (inside the finger rings)."""
    d = Draw("scissors", seed, given)
    blade, base = d.real("blade", 0.08, 0.14), d.real("blade_width", 0.014, 0.022)
    handle, opening = d.real("handle", 0.05, 0.09), d.real("opening", np.deg2rad(35), np.deg2rad(75))
    ring_x, ring_y = d.real("ring_length", 0.018, 0.030), d.real("ring_width", 0.013, 0.020)
    rim, thickness = d.real("rim", 0.006, 0.010), d.real("thickness", 0.008, 0.014)
    color, metal = d.color(), d.metal()
    d.done()
    half = opening / 2
    tip = 0.003
    blades, handles, rings, holes = [], [], [], []
    for side in (1, -1):
        # A blade along +x, tapering; its inner edge is straight from the pivot's side to the tip.
        outline = [(-0.012, -base / 2 * side), (blade, -tip / 2 * side), (blade, tip / 2 * side), (-0.012, base / 2 * side)]
        blades.append(shapely.Polygon(_turn(outline, side * half)))
        away = side * (half + np.deg2rad(4))
        # Handles cross over: the upper blade's handle lies below.
        centre = -(handle + ring_x) * np.array([np.cos(away), np.sin(away)])
        ring_axis = away
        outer = shapely.Polygon(_turn(arc((0, 0), (ring_x + rim, ring_y + rim), 0, 2 * np.pi, 41)[:-1], ring_axis) + centre)
        holes.append(shapely.Polygon(_turn(arc((0, 0), (ring_x, ring_y), 0, 2 * np.pi, 41)[:-1], ring_axis) + centre))
        handles.append(stroke([(0, 0), centre + ring_x * np.array([np.cos(away), np.sin(away)])], base * 0.7))
        rings.append((centre, ring_axis, outer))
    crotch_fillet = 0.0015
    steel = fillet(shapely.union_all([*blades, shapely.Point(0, 0).buffer(base * 0.6)]), crotch_fillet)
    grips = fillet(shapely.union_all([*handles, *(r[2] for r in rings)]), 0.002)
    grips = grips.difference(shapely.union_all(holes))
    parts = [
        plate(grips, -thickness / 2, thickness / 2, color),
        plate(
            steel.difference(grips.buffer(-0.004)) if steel.difference(grips.buffer(-0.004)).geom_type == "Polygon" else steel,
            -thickness * 0.4,
            thickness * 0.4,
            metal,
        ),
    ]
    regions = {}
    # Where the inner edges of the blades meet, and half the angle between them.
    edge = np.array([blade + 0.012, (base - tip) / 2])
    slope = np.arctan2(edge[1], edge[0])
    angle = half + slope  # inner edge of the upper blade, after the turn
    start = _turn([(-0.012, -base / 2)], half)[0]
    corner = (start[0] - start[1] / np.tan(angle), 0.0)
    pivot = base * 0.6
    if corner[0] > pivot * 0.9:
        regions["crotch"] = _corner(corner, 0.0, angle, crotch_fillet)
    for k, (centre, axis, _) in enumerate(rings):
        angles = np.linspace(np.deg2rad(-100), np.deg2rad(100), 41) + np.pi
        points = np.column_stack([ring_x * np.cos(angles), ring_y * np.sin(angles)])
        normals = -np.column_stack([np.cos(angles) / ring_x, np.sin(angles) / ring_y])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        regions[f"ring_{k + 1}"] = Region(_lift(_turn(points, axis) + centre), _lift(_turn(normals, axis)), ring_y**2 / ring_x, True)
    return assemble("scissors", seed, d.parameters, parts, regions, "top", DOWN, UP)


def caliper(seed: int = 0, **given: float | str) -> Shape:
    """A sliding caliper, beam along x, jaws towards +y, the fixed one at +x.

    Regions ``jaw`` (inner corner of the fixed jaw), ``slider`` (the slider's inner
    corner, facing it) and ``slider_back`` (corner of the slider's far side with the beam).
    """
    d = Draw("caliper", seed, given)
    beam, width, thickness = d.real("beam", 0.20, 0.30), d.real("width", 0.016, 0.024), d.real("thickness", 0.010, 0.018)
    jaw, jaw_width = d.real("jaw", 0.050, 0.080), d.real("jaw_width", 0.014, 0.022)
    opening, slider = d.real("opening", 0.075, 0.12), d.real("slider", 0.035, 0.055)
    small, radius = d.real("small_jaw", 0.012, 0.025), d.real("fillet", 0.0015, 0.004)
    color, metal = d.color(), d.metal()
    d.done()
    end = beam / 2
    y = width / 2
    face = end - jaw_width  # measuring face of the fixed jaw
    back = face - opening  # measuring face of the slider
    fixed = shapely.union_all(
        [
            shapely.box(-end, -y, end, y),
            shapely.Polygon([(face, -y), (end, -y), (end, y + jaw * 0.5), (face + 0.3 * jaw_width, y + jaw), (face, y + jaw)]),
            shapely.Polygon([(face, -y), (face, -y - small), (face + 0.3 * jaw_width, -y - small), (end, -y)]),
        ]
    )
    lip = 0.006
    moving = shapely.union_all(
        [
            shapely.box(back - slider, -y - lip, back, y + lip),
            shapely.Polygon(
                [(back, y), (back, y + jaw), (back - 0.3 * jaw_width, y + jaw), (back - jaw_width, y + jaw * 0.5), (back - jaw_width, y)]
            ),
            shapely.Polygon([(back, -y), (back, -y - small), (back - 0.3 * jaw_width, -y - small), (back - jaw_width, -y)]),
        ]
    )
    outline = fillet(fixed.union(moving), radius)
    parts = [plate(outline, -thickness / 2, thickness / 2, metal)]
    plaque = shapely.box(back - slider * 0.85, -y * 0.75, back - slider * 0.15, y * 0.75)
    parts.append(plate(plaque, thickness * 0.4, thickness * 0.5 + 0.0015, color))
    quarter = np.pi / 4
    regions = {
        "jaw": _corner((face, y), 3 * quarter, quarter, radius),
        "slider": _corner((back, y), quarter, quarter, radius),
        "slider_back": _corner((back - jaw_width, y + lip), 3 * quarter, quarter, radius),
    }
    return assemble("caliper", seed, d.parameters, parts, regions, "top", DOWN, UP)


def watch(seed: int = 0, **given: float | str) -> Shape:
    """A watch on its side, its closed band a ring in the xy plane, the case at +x; region ``band``: the
    inside of the band away from the case."""
    d = Draw("watch", seed, given)
    rx, ry = d.real("half_length", 0.024, 0.036), d.real("half_width", 0.024, 0.034)
    strap, breadth = d.real("strap", 0.003, 0.005), d.real("breadth", 0.016, 0.024)
    case, depth = d.real("case", 0.034, 0.044), d.real("case_depth", 0.008, 0.012)
    color, metal = d.color(), d.metal()
    d.done()
    ring = arc((0, 0), (rx, ry), 0, 2 * np.pi, 73)[:-1]
    normals = np.column_stack([np.cos(np.linspace(0, 2 * np.pi, 73)[:-1]) / rx, np.sin(np.linspace(0, 2 * np.pi, 73)[:-1]) / ry])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    hole = shapely.Polygon(ring)
    face = rx - 0.002
    hole = hole.difference(shapely.box(face, -1, 1, 1))
    band = shapely.Polygon(ring + strap * normals).difference(hole)
    # The strap ends inside the case, by so little that the case's piece counts only once.
    band = band.difference(shapely.box(face + 0.0015, -case / 2, 1, case / 2))
    parts = [
        plate(band, -breadth / 2, breadth / 2, color),
        plate(shapely.box(face, -case / 2, face + depth, case / 2), -case / 2, case / 2, metal),
    ]
    a = np.linspace(np.deg2rad(70), np.deg2rad(290), 45)
    inward = -np.column_stack([np.cos(a) / rx, np.sin(a) / ry])
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    points = np.column_stack([rx * np.cos(a), ry * np.sin(a)])
    return assemble("watch", seed, d.parameters, parts, {"band": Region(_lift(points), _lift(inward), ry**2 / rx, True)}, "top", DOWN, UP)


def hammer(seed: int = 0, **given: float | str) -> Shape:
    """A hammer, handle along x, head at +x across it; regions ``neck_1``, ``neck_2`` (corners of head and handle) and ``face``."""
    d = Draw("hammer", seed, given)
    handle, width, thickness = d.real("handle", 0.18, 0.28), d.real("width", 0.018, 0.028), d.real("thickness", 0.016, 0.026)
    head, head_width, depth = d.real("head", 0.08, 0.12), d.real("head_width", 0.022, 0.034), d.real("head_depth", 0.024, 0.036)
    claw, radius = d.choice("back", ("flat", "wedge")), 0.002
    color, metal = d.wood(), d.metal()
    d.done()
    x0, x1 = handle, handle + head_width
    y = head / 2
    back = (
        [(x1, y * 0.4), (x1 - head_width * 0.15, y), (x0 + head_width * 0.3, y), (x0, y * 0.4)] if claw == "wedge" else [(x1, y), (x0, y)]
    )
    outline = shapely.Polygon([(x0, -y), (x1, -y), *back])
    parts = [
        plate(stroke([(width / 2, 0), (x0 + head_width * 0.5, 0)], width), -thickness / 2, thickness / 2, color),
        plate(outline, -depth / 2, depth / 2, metal),
    ]
    regions = {
        "neck_1": _corner((x0, -width / 2), np.deg2rad(225), np.pi / 4, radius),
        "neck_2": _corner((x0, width / 2), np.deg2rad(135), np.pi / 4, radius),
        "face": _straight((x0 + 0.15 * head_width, -y), (x1 - 0.15 * head_width, -y), (0, -1)),
    }
    # The corners are sharp: their regions shrink to the corner itself.
    for name, corner in (("neck_1", (x0, -width / 2)), ("neck_2", (x0, width / 2))):
        normal = regions[name].middle()[1]
        regions[name] = Region(np.array([[*corner, 0.0]]), normal[None], radius, True)
    return assemble("hammer", seed, d.parameters, parts, regions, "top", DOWN, UP)


_LETTERS: dict[str, tuple[list[list[tuple[float, float]]], list[tuple[tuple[float, float], float, float]]]] = {
    # strokes on a 4 x 6 raster; concave corners: place, angle of the open direction, half opening (degrees)
    "C": ([[(4, 6), (0, 6), (0, 0), (4, 0)]], [((0, 0), 45, 45), ((0, 6), -45, 45)]),
    "E": ([[(4, 6), (0, 6), (0, 0), (4, 0)], [(0, 3), (3, 3)]], [((0, 0), 45, 45), ((0, 6), -45, 45), ((0, 3), 45, 45), ((0, 3), -45, 45)]),
    "F": ([[(4, 6), (0, 6), (0, 0)], [(0, 3), (3, 3)]], [((0, 6), -45, 45), ((0, 3), 45, 45), ((0, 3), -45, 45)]),
    "H": (
        [[(0, 0), (0, 6)], [(4, 0), (4, 6)], [(0, 3), (4, 3)]],
        [((0, 3), 45, 45), ((0, 3), -45, 45), ((4, 3), 135, 45), ((4, 3), -135, 45)],
    ),
    "I": ([[(0, 0), (0, 6)]], []),
    "L": ([[(0, 6), (0, 0), (4, 0)]], [((0, 0), 45, 45)]),
    "T": ([[(0, 6), (4, 6)], [(2, 6), (2, 0)]], [((2, 6), -45, 45), ((2, 6), -135, 45)]),
    "U": ([[(0, 6), (0, 0), (4, 0), (4, 6)]], [((0, 0), 45, 45), ((4, 0), 135, 45)]),
    "V": ([[(0, 6), (2, 0), (4, 6)]], [((2, 0), 90, float(np.rad2deg(np.arctan2(2, 6))))]),
    "X": (
        [[(0, 6), (4, 0)], [(0, 0), (4, 6)]],
        [((2, 3), a, h) for a, h in ((90, 33.690067526), (-90, 33.690067526), (0, 56.309932474), (180, 56.309932474))],
    ),
    "Z": ([[(0, 6), (4, 6), (0, 0), (4, 0)]], [((4, 6), -180 + 28.154966, 28.154966), ((0, 0), 28.154966, 28.154966)]),
}


def letter(seed: int = 0, **given: float | str) -> Shape:
    """A block letter; regions ``concave_1``, ...: its inner corners, in the order of the letter's strokes (none for I)."""
    d = Draw("letter", seed, given)
    glyph = d.choice("glyph", tuple(_LETTERS))
    height, aspect = d.real("height", 0.08, 0.16), 1.0
    width, thickness, radius = d.real("width", 0.012, 0.018), d.real("thickness", 0.012, 0.02), d.real("fillet", 0.0015, 0.004)
    color = d.color()
    d.done()
    unit = height / 6 * aspect
    strokes, corners = _LETTERS[glyph]
    outline = shapely.union_all([stroke(np.array(s) * unit, width, flat_ends=False) for s in strokes])
    outline = fillet(outline, radius)
    regions = {}
    for k, (place, angle, half) in enumerate(corners):
        bisector, half = np.deg2rad(angle), np.deg2rad(half)
        corner = np.array(place, dtype=float) * unit + width / 2 / np.sin(half) * np.array([np.cos(bisector), np.sin(bisector)])
        regions[f"concave_{k + 1}"] = _corner(corner, float(bisector), float(half), radius)
    return assemble("letter", seed, d.parameters, [plate(outline, -thickness / 2, thickness / 2, color)], regions, "top", DOWN, UP)


FLAT = {f.__name__: recipe(f) for f in (l_hook, j_hook, s_hook, hanger, scissors, caliper, watch, hammer, letter)}
