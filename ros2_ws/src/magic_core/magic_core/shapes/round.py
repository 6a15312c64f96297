"""Vessels, spoons, fixtures and simple targets (metres throughout)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from magic_core import transforms
from magic_core.shapes.draw import Draw, recipe
from magic_core.shapes.shape import Region, Shape, assemble
from magic_core.shapes.solids import Array, Part, ball, bowl, cup, hull, tube, turned

SIDEWAYS, FORWARD, UP = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)

#: Body profiles and handle forms of the mugs.
PROFILES = ("straight", "tapered", "flared", "barrel", "tulip")
HANDLES = ("C", "D", "ear", "square")


def _xz(points: ArrayLike) -> Array:
    points = np.asarray(points, dtype=float)
    return np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]])


def _curve_radius(points: Array) -> float:
    """Radius of the circle through the first, middle and last of some points (N, 3)."""
    a, b, c = points[0], points[len(points) // 2], points[-1]
    area = np.linalg.norm(np.cross(b - a, c - a)) / 2
    return float("inf") if area < 1e-12 else float(np.linalg.norm(a - b) * np.linalg.norm(b - c) * np.linalg.norm(c - a) / (4 * area))


def _rounded(corners: Array, radius: float, count: int = 6) -> Array:
    """A polyline (N, 2) with its inner corners rounded to a radius."""
    result = [corners[0]]
    for a, b, c in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        u, v = transforms.unit(a - b), transforms.unit(c - b)
        half = np.arccos(np.clip(u @ v, -1, 1)) / 2
        centre = b + transforms.unit(u + v) * radius / np.sin(half)
        start, end = b + u * radius / np.tan(half) - centre, b + v * radius / np.tan(half) - centre
        for t in np.linspace(0, 1, count):
            result.append(centre + transforms.unit(start * (1 - t) + end * t) * radius)
    return np.array([*result, corners[-1]])


def _handle(form: str, low: float, high: float, reach: float, start_x: float, low_x: float) -> Array:
    """Middle line (K, 2) in (x, z) of a mug's handle from its upper to its lower end.

    low, high: heights of its ends; reach: how far it stands out from start_x; the ends lie at start_x (upper) and low_x.
    """
    middle, half = (low + high) / 2, (high - low) / 2
    if form == "C":
        t = np.linspace(np.pi / 2, -np.pi / 2, 19)
        line = np.column_stack([start_x + reach * np.cos(t), middle + half * np.sin(t)])
    elif form == "D":
        line = _rounded(
            np.array([(start_x, high), (start_x + reach, high - 0.05 * half), (start_x + reach, low + 0.35 * half), (low_x, low)]),
            min(0.45 * reach, 0.6 * half),
            7,
        )
    elif form == "square":
        line = _rounded(
            np.array([(start_x, high), (start_x + reach, high), (start_x + reach, low), (low_x, low)]), min(0.25 * reach, 0.25 * half), 4
        )
    else:  # ear: wide above, running in to the body below
        t = np.linspace(0, 1, 19)
        x = start_x + reach * np.sin(np.pi * t**0.75) ** 0.75 * (1 - 0.35 * t)
        z = high + 0.12 * half * np.sin(np.pi * np.minimum(2 * t, 1)) - 2 * half * t**1.2
        line = np.column_stack([x, z])
        line[0], line[-1] = (start_x, high), (low_x, low)
    line[-1, 0] = low_x
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    counts = np.maximum(np.ceil(steps / 0.005).astype(int), 1)
    filled = [a + (b - a) * t for a, b, n in zip(line[:-1], line[1:], counts, strict=True) for t in np.arange(n)[:, None] / n]
    return np.array([*filled, line[-1]])


def mug(seed: int = 0, **given: float | str) -> Shape:
    """A mug; regions ``handle`` (upper outer stretch of the handle's inner side, normals down and towards
    the body), ``handle_loop`` and ``rim``."""
    d = Draw("mug", seed, given)
    profile, form = d.choice("profile", PROFILES), d.choice("handle", HANDLES)
    radius, height = d.real("radius", 0.034, 0.044), d.real("height", 0.075, 0.115)
    wall, floor = d.real("wall", 0.003, 0.005), d.real("floor", 0.005, 0.008)
    bulge = d.real("bulge", 0.05, 0.14)
    thick, broad = d.real("handle_thickness", 0.006, 0.011), d.real("handle_breadth", 0.009, 0.016)
    reach = d.real("handle_reach", 0.026, 0.038)
    high, low = d.real("handle_top", 0.82, 0.92), d.real("handle_bottom", 0.14, 0.28)
    color = d.color()
    d.done()

    def outer(z: ArrayLike) -> Array:
        s = np.asarray(z, dtype=float) / height
        shape = {
            "straight": 0 * s,
            "tapered": bulge * (s - 1),
            "flared": bulge * (1 - s),
            "barrel": bulge * (np.sin(np.pi * s) - 0.6),
            "tulip": bulge * (0.7 * np.sin(2 * np.pi * s + 3.5) + 0.2 * s),
        }[profile]
        return radius * (1 + shape)

    steps = 1 if profile in ("straight", "tapered", "flared") else 6
    z = np.concatenate([[0.0], np.linspace(floor, height, steps + 1)])
    body = cup(z, outer(z), outer(z) - wall, floor, color)
    z_high, z_low = high * height, low * height
    # The ends lie in the middle of the wall, so that handle and body share volume and nothing shows inside.
    sag = 1 - np.cos(np.pi / 32)
    start, end = float(outer(z_high)) * (1 - sag) - wall / 2, float(outer(z_low)) * (1 - sag) - wall / 2
    line = _handle(form, z_low, z_high, reach + wall / 2 + thick / 2, start, end)
    path = _xz(line)
    grip = tube(path, thick, broad, SIDEWAYS, color)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inward = np.cross(SIDEWAYS, tangent)  # the path runs from top to bottom, clockwise in (x, z): its right side is the hole
    if inward[len(inward) // 2, 0] > 0:
        inward = -inward
    inner = path + inward * thick / 2
    free = inner[:, 0] > outer(np.clip(inner[:, 2], 0, height)) + 0.0005
    # A mug on a peg turns until the contact's normal points to its centre of mass, down and towards the body: the upper
    # outer stretch of the loop, with room for a peg before the body.
    room = inner[:, 0] > outer(np.clip(inner[:, 2], 0, height)) + 0.008
    upper = free & room & (inward @ transforms.unit([-1.0, 0, -1.0]) > 0.6) & (inner[:, 2] > (z_low + z_high) / 2)
    regions = {
        "handle": Region(inner[upper], inward[upper], _curve_radius(inner[upper]), True),
        "handle_loop": Region(inner[free], inward[free], min(reach, (z_high - z_low) / 2), True),
        "rim": Region(np.array([[-float(outer(height)) + wall / 2, 0, height]]), np.array([[0, 0, 1.0]]), float("inf"), False),
    }
    return assemble("mug", seed, d.parameters, [body, grip], regions, "side", SIDEWAYS, UP)


def _bowl_regions(half: float, depth: float, power: float, centre: Array) -> dict[str, Region]:
    """The inside of a bowl in the plane y = 0, from the analytic profile."""
    u = np.linspace(-0.55 if power <= 2.5 else -0.25, 0.55 if power <= 2.5 else 0.25, 25)
    full = np.linspace(-1.2, 1.2, 49)

    def profile(u: Array) -> tuple[Array, Array]:
        rho = np.sign(u) * np.abs(np.sin(u)) ** (2 / power)
        h = np.abs(np.cos(u)) ** (2 / power)
        points = np.column_stack([half * rho, np.zeros(len(u)), -depth * h]) + centre
        gradient = np.column_stack([np.sign(rho) * np.abs(rho) ** (power - 1) / half, np.zeros(len(u)), -(h ** (power - 1)) / depth])
        return points, -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    radius = half**2 / depth if power == 2 else float("inf")
    return {"bowl": Region(*profile(u), radius, True), "bowl_inside": Region(*profile(full), radius, True)}


def spoon(seed: int = 0, **given: float | str) -> Shape:
    """A spoon of 2.5 times a table spoon's size; regions ``bowl`` (bottom of the inside) and
    ``bowl_inside`` (all of the profile but the rim)."""
    d = Draw("spoon", seed, given)
    a, b = d.real("bowl_half_length", 0.042, 0.062), d.real("bowl_half_width", 0.038, 0.052)
    depth, wall = d.real("depth", 0.018, 0.034), d.real("wall", 0.003, 0.005)
    length, rise = d.real("handle", 0.20, 0.30), d.real("rise", 0.0, 0.03)
    thick, broad = d.real("handle_thickness", 0.009, 0.014), d.real("handle_breadth", 0.016, 0.028)
    color = d.metal() if d.choice("material", ("metal", "wood", "plastic")) == "metal" else d.wood()
    d.done()
    s = np.linspace(0, 1, 12)
    start = -(a + wall / 2)
    x = start - length * s
    # The handle leaves the rim level, dips at the neck and rises to its end.
    z = -thick / 2 + rise * s**1.5 - 0.15 * depth * np.sin(np.pi * np.minimum(2 * s, 1))
    width = broad * (0.6 + 0.4 * s)
    path = np.column_stack([x, 0 * x, z])
    handle = tube(path, thick * (1 - 0.25 * s), width, SIDEWAYS, color)
    parts = [bowl((a, b), depth, wall, 2.0, color), handle]
    regions = _bowl_regions(a, depth, 2.0, np.zeros(3))
    return assemble("spoon", seed, d.parameters, parts, regions, "section", SIDEWAYS, UP)


def ladle(seed: int = 0, **given: float | str) -> Shape:
    """A ladle: a deep round bowl and a handle that leaves it steeply; regions as of a spoon."""
    d = Draw("ladle", seed, given)
    a, aspect = d.real("bowl_radius", 0.042, 0.060), d.real("aspect", 0.9, 1.1)
    depth, wall = d.real("depth", 0.028, 0.045), d.real("wall", 0.003, 0.005)
    length, angle = d.real("handle", 0.20, 0.30), d.real("angle", np.deg2rad(10), np.deg2rad(45))
    thick, broad = d.real("handle_thickness", 0.008, 0.013), d.real("handle_breadth", 0.014, 0.022)
    color = d.metal() if d.choice("material", ("metal", "plastic")) == "metal" else d.color()
    d.done()
    start = np.array([-(a + wall / 2), -thick / 2])
    bend = start + [-0.012, 0.0]
    end = bend + length * np.array([-np.cos(angle), np.sin(angle)])
    line = _rounded(np.array([start, bend, end]), 0.02 if angle > 0.1 else 0.05, 6)
    far = np.linspace(line[-2], line[-1], 8)[1:]
    handle = tube(_xz(np.concatenate([line[:-1], far])), thick, broad, SIDEWAYS, color)
    parts = [bowl((a, a * aspect), depth, wall, 2.0, color), handle]
    regions = _bowl_regions(a, depth, 2.0, np.zeros(3))
    return assemble("ladle", seed, d.parameters, parts, regions, "section", SIDEWAYS, UP)


def measuring_cup(seed: int = 0, **given: float | str) -> Shape:
    """A measuring cup: a bowl with a flat floor and steep walls, a straight handle at the rim; regions as of a spoon."""
    d = Draw("measuring_cup", seed, given)
    a, depth, wall = d.real("bowl_radius", 0.045, 0.060), d.real("depth", 0.030, 0.045), d.real("wall", 0.003, 0.005)
    power = d.real("power", 3.0, 5.0)
    length, thick, broad = d.real("handle", 0.15, 0.24), d.real("handle_thickness", 0.008, 0.012), d.real("handle_breadth", 0.018, 0.028)
    color = d.color()
    d.done()
    x = np.linspace(-(a + wall / 2), -(a + length), 8)
    handle = tube(np.column_stack([x, 0 * x, np.full(8, -thick / 2)]), thick, broad, SIDEWAYS, color)
    parts = [bowl((a, a), depth, wall, power, color), handle]
    regions = _bowl_regions(a, depth, power, np.zeros(3))
    return assemble("measuring_cup", seed, d.parameters, parts, regions, "section", SIDEWAYS, UP)


# ---------------------------------------------------------------- fixtures


def rod(seed: int = 0, **given: float | str) -> Shape:
    """A bent rod on a foot: a post at +x that turns into a horizontal arm with its free end at -x.

    Looked at from the free end, the arm's top is the silhouette's top: region ``rod``.
    """
    d = Draw("rod", seed, given)
    radius, height = d.real("radius", 0.006, 0.009), d.real("height", 0.36, 0.40)
    length, foot = d.real("length", 0.18, 0.24), d.real("foot", 0.06, 0.08)
    color, base = d.metal(), d.metal()
    d.done()
    bend = 0.03
    line = _rounded(np.array([(0.0, 0.008), (0.0, height), (-length, height)]), bend, 10)
    straight = np.linspace(line[-2], line[-1], 4)[1:]
    path = _xz(np.concatenate([line[:1], np.linspace(line[0], line[1], 4)[1:-1], line[1:-1], straight]))
    parts = [tube(path, 2 * radius, 2 * radius, SIDEWAYS, color, corners=24), turned([0, 0.012], [foot, foot * 0.95], base)]
    top = np.linspace((-bend - 0.02, 0, height + radius), (-length + 0.01, 0, height + radius), 15)
    regions = {"rod": Region(top, np.tile([0, 0, 1.0], (15, 1)), radius, False)}
    return assemble("rod", seed, d.parameters, parts, regions, "side", FORWARD, UP)


def mug_tree(seed: int = 0, **given: float | str) -> Shape:
    """A post with inclined pegs, the first towards -x; regions ``peg_1``, ...: the pegs' tops."""
    d = Draw("mug_tree", seed, given)
    height, post = d.real("height", 0.34, 0.42), d.real("post", 0.010, 0.014)
    peg, length, incline = (
        d.real("peg_radius", 0.005, 0.008),
        d.real("peg_length", 0.08, 0.12),
        d.real("incline", np.deg2rad(20), np.deg2rad(45)),
    )
    count = int(d.choice("pegs", ("1", "2", "4", "6")))
    foot = d.real("foot", 0.07, 0.09)
    color = d.wood()
    d.done()
    parts: list[Part] = [turned([0, 0.015], [foot, foot], color), turned([0.01, height - 0.01, height], [post, post, post * 0.6], color)]
    regions = {}
    for k in range(count):
        turn = np.pi + k * (np.pi if count == 2 else 2 * np.pi / max(min(count, 3), 1) if count > 4 else np.pi / 2)
        level = height - 0.05 - 0.09 * (k // 2 if count > 2 else 0)
        spin = transforms.from_rpy(0, 0, float(turn))
        s = np.linspace(0, length + post / 2, 5)
        line = np.column_stack([post / 2 + s * np.cos(incline), level + s * np.sin(incline)])
        parts.append(tube(_xz(line), 2 * peg, 2 * peg, SIDEWAYS, color, corners=16).moved(spin))
        normal = np.array([-np.sin(incline), 0, np.cos(incline)])
        free = s[1:-1, None] * np.array([[np.cos(incline), 0, np.sin(incline)]]) + [post / 2, 0, level] + peg * normal
        regions[f"peg_{k + 1}"] = Region(free, np.tile(normal, (len(free), 1)), float("inf"), False).moved(spin)
    return assemble("mug_tree", seed, d.parameters, parts, regions, "side", SIDEWAYS, UP)


def quarter_pipe(seed: int = 0, **given: float | str) -> Shape:
    """A concave quarter of a cylinder's inside (or less: ``extent``) that leads from the table up; region ``arc``: its surface.

    The surface starts level at -x and rises towards +x about an axis along y.
    """
    d = Draw("quarter_pipe", seed, given)
    radius, width, back = d.real("radius", 0.2, 0.2), d.real("width", 0.2, 0.2), d.real("back", 0.02, 0.02)
    extent = d.real("extent", np.pi / 2, np.pi / 2)
    color = d.wood()
    d.done()
    if not np.deg2rad(12) <= extent <= np.pi / 2 + 1e-9:
        raise ValueError(f"an extent of {np.rad2deg(extent):.1f} degrees; allowed: 12 to 90")
    # The first column would be thinner than a hair: the steps widen towards the table.
    angle = np.concatenate([[0.0], np.linspace(np.deg2rad(6), extent, max(2, int(np.ceil(np.rad2deg(extent) / 3.6))))])
    x, z = radius * np.sin(angle), radius * (1 - np.cos(angle))

    def column(points: list[tuple[float, float]]) -> Array:
        return np.array([(px, py, pz) for py in (-width / 2, width / 2) for px, pz in points])

    pieces = [hull(column([(x[0], 0), (x[1], 0), (x[1], z[1])]))]
    pieces += [hull(column([(x[i], 0), (x[i + 1], 0), (x[i + 1], z[i + 1]), (x[i], z[i])])) for i in range(1, len(x) - 1)]
    pieces.append(hull(column([(x[-1], 0), (x[-1] + back, 0), (x[-1] + back, z[-1]), (x[-1], z[-1])])))
    outline = np.array([(0, 0), (x[-1] + back, 0), (x[-1] + back, z[-1]), *zip(x[::-1], z[::-1], strict=True)])[:-1]
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline[:, 0], np.full(n, y), outline[:, 1]]) for y in (-width / 2, width / 2)])
    i = np.arange(n)
    j = (i + 1) % n
    # The profile is seen whole from its lower back corner, so a fan from there fills it.
    fan = np.array([(1, k, (k + 1) % n) for k in range(2, n)])
    faces = np.concatenate([fan, fan[:, ::-1] + n, np.column_stack([i, i + n, j + n]), np.column_stack([i, j + n, j])]).astype(np.int32)
    # The lowest degrees are thinner than paper: nothing is to be touched there.
    fine = np.linspace(np.deg2rad(7), extent - np.deg2rad(1), 42)
    surface = np.column_stack([radius * np.sin(fine), 0 * fine, radius * (1 - np.cos(fine))])
    normals = np.column_stack([-np.sin(fine), 0 * fine, np.cos(fine)])
    regions = {"arc": Region(surface, normals, radius, True)}
    return assemble("quarter_pipe", seed, d.parameters, [Part(vertices, faces, tuple(pieces), color)], regions, "side", SIDEWAYS, UP)


def cylinder(seed: int = 0, **given: float | str) -> Shape:
    """A standing cylinder with half height equal to its radius; region ``side``: its outline seen from above."""
    d = Draw("cylinder", seed, given)
    radius = d.real("radius", 0.015, 0.035)
    half = d.real("half_height", radius, radius)
    color = d.color()
    d.done()
    part = turned([-half, half], [radius, radius], color, sectors=64, piece_sectors=64)
    angle = np.linspace(0, 2 * np.pi, 65)
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return assemble(
        "cylinder", seed, d.parameters, [part], {"side": Region(radius * normals, normals, radius, False)}, "top", (0, 0, -1), FORWARD
    )


def sphere(seed: int = 0, **given: float | str) -> Shape:
    """A ball; region ``side``: its outline seen from above (``outline``: seen from the side)."""
    d = Draw("sphere", seed, given)
    radius = d.real("radius", 0.015, 0.045)
    color = d.color()
    d.done()
    angle = np.linspace(0, 2 * np.pi, 65)
    flat = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    upright = flat[:, [0, 2, 1]]
    regions = {"side": Region(radius * flat, flat, radius, False), "outline": Region(radius * upright, upright, radius, False)}
    return assemble("sphere", seed, d.parameters, [ball(radius, color)], regions, "top", (0, 0, -1), FORWARD)


ROUND = {f.__name__: recipe(f) for f in (mug, spoon, ladle, measuring_cup, rod, mug_tree, quarter_pipe, cylinder, sphere)}
