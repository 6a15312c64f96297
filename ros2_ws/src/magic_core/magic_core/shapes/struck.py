"""Tools that strike and sweep, what they strike, and letters cut from a plate (metres throughout)."""

from __future__ import annotations

from functools import lru_cache
from string import ascii_uppercase
from typing import Any

import numpy as np
import shapely
import shapely.affinity

from magic_core import transforms
from magic_core.shapes.draw import Draw, recipe
from magic_core.shapes.flat import DOWN, UP, _straight
from magic_core.shapes.shape import Region, Shape, assemble
from magic_core.shapes.solids import plate

FORMS = ("T", "L", "X")
#: Height of the outlines that :func:`_glyph` answers, in points.
GLYPH_SIZE = 100.0


def mallet(seed: int = 0, **given: float | str) -> Shape:
    """A handle along x with a block across it: at its end (T), at its end to one side (L), or crossing it aslant (X).

    Regions: ``face`` (the block's end towards -y; of an X its -y end as it is turned) and ``side`` (the handle's long side towards -y).
    """
    d = Draw("mallet", seed, given)
    form = d.choice("form", FORMS)
    handle, width, thickness = d.real("handle", 0.18, 0.28), d.real("width", 0.018, 0.026), d.real("thickness", 0.016, 0.022)
    head, head_width, depth = d.real("head", 0.08, 0.13), d.real("head_width", 0.026, 0.038), d.real("head_depth", 0.026, 0.036)
    along, slant = d.real("along", 0.62, 0.80), d.real("slant", 0.0, np.deg2rad(25))
    color, block_color = d.wood(), d.metal()
    d.done()
    shaft = shapely.box(0.0, -width / 2, handle, width / 2)
    block = shapely.box(-head_width / 2, -head / 2, head_width / 2, head / 2)
    if form == "L":
        # To the side of the face, flush with the handle on the other.
        block = shapely.affinity.translate(block, handle - head_width / 2, -head / 2 + width / 2)
        middle, turn = np.array([handle - head_width / 2, -head / 2 + width / 2]), 0.0
    elif form == "T":
        block = shapely.affinity.translate(block, handle - head_width / 2, 0.0)
        middle, turn = np.array([handle - head_width / 2, 0.0]), 0.0
    else:
        turn = slant
        middle = np.array([handle * along, 0.0])
        block = shapely.affinity.translate(shapely.affinity.rotate(block, np.rad2deg(turn), origin=(0, 0)), *middle)
    c, s = np.cos(turn), np.sin(turn)
    spin = np.array([[c, -s], [s, c]])
    face = np.array([(-0.4 * head_width, -head / 2), (0.4 * head_width, -head / 2)]) @ spin.T + middle
    parts = [plate(shaft, -thickness / 2, thickness / 2, color), plate(block, -depth / 2, depth / 2, block_color)]
    clear = block.bounds[0] - 0.005
    regions = {
        "face": _straight(face[0], face[1], spin @ [0.0, -1.0]),
        "side": _straight((0.1 * handle, -width / 2), (max(clear, 0.3 * handle), -width / 2), (0.0, -1.0)),
    }
    return assemble("mallet", seed, d.parameters, parts, regions, "top", DOWN, UP)


def peg(seed: int = 0, **given: float | str) -> Shape:
    """A square peg that lies along x; region ``head``: its end face at -x, seen from above."""
    d = Draw("peg", seed, given)
    length, side = d.real("length", 0.10, 0.14), d.real("side", 0.020, 0.028)
    color = d.wood()
    d.done()
    part = plate(shapely.box(-length / 2, -side / 2, length / 2, side / 2), -side / 2, side / 2, color)
    region = Region(
        np.column_stack([np.full(9, -length / 2), np.linspace(0.4, -0.4, 9) * side, np.zeros(9)]),
        np.tile([-1.0, 0.0, 0.0], (9, 1)),
        float("inf"),
        False,
    )
    return assemble("peg", seed, d.parameters, [part], {"head": region}, "top", DOWN, (1.0, 0.0, 0.0))


def block(seed: int = 0, **given: float | str) -> Shape:
    """A box that stands as it is, ``length`` along x; region ``side``: its face at -x, seen from above."""
    d = Draw("block", seed, given)
    length, breadth, height = d.real("length", 0.05, 0.08), d.real("breadth", 0.06, 0.10), d.real("height", 0.04, 0.06)
    color = d.wood()
    d.done()
    part = plate(shapely.box(-length / 2, -breadth / 2, length / 2, breadth / 2), -height / 2, height / 2, color)
    region = Region(
        np.column_stack([np.full(9, -length / 2), np.linspace(0.4, -0.4, 9) * breadth, np.zeros(9)]),
        np.tile([-1.0, 0.0, 0.0], (9, 1)),
        float("inf"),
        False,
    )
    return assemble("block", seed, d.parameters, [part], {"side": region}, "top", DOWN, (1.0, 0.0, 0.0))


def ring(seed: int = 0, **given: float | str) -> Shape:
    """A flat ring that lies on the table; region ``inside``: its inner outline."""
    d = Draw("ring", seed, given)
    radius, width, height = d.real("radius", 0.04, 0.055), d.real("width", 0.010, 0.016), d.real("height", 0.016, 0.026)
    color = d.metal()
    d.done()
    area = (
        shapely.Point(0, 0).buffer(radius + width / 2, quad_segs=8).difference(shapely.Point(0, 0).buffer(radius - width / 2, quad_segs=8))
    )
    angles = np.linspace(0.0, 2 * np.pi, 41)
    inwards = -np.column_stack([np.cos(angles), np.sin(angles), np.zeros(41)])
    inside = Region(-(radius - width / 2) * inwards, inwards, radius - width / 2, True)
    return assemble("ring", seed, d.parameters, [plate(area, -height / 2, height / 2, color)], {"inside": inside}, "top", DOWN, UP)


def slot(seed: int = 0, **given: float | str) -> Shape:
    """A block on the table with a straight channel along x, closed above: a peg slides in it from -x; no regions."""
    d = Draw("slot", seed, given)
    length, gap, height = d.real("length", 0.12, 0.12), d.real("gap", 0.022, 0.030), d.real("height", 0.022, 0.030)
    wall = d.real("wall", 0.02, 0.02)
    color = d.metal()
    d.done()
    outer = shapely.box(-gap / 2 - wall, 0.0, gap / 2 + wall, height + wall)
    profile = outer.difference(shapely.box(-gap / 2, -1.0, gap / 2, height))
    # The profile's x is the block's y, its y the block's z; it is drawn out along x.
    upright = transforms.make(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    part = plate(profile, -length / 2, length / 2, color).moved(upright)
    return assemble("slot", seed, d.parameters, [part], {}, "top", DOWN, (1.0, 0.0, 0.0))


@lru_cache(maxsize=32)
def _glyph(letter: str) -> Any:
    """The outline of a letter of DejaVu Sans, with its holes, as a shapely area; units are arbitrary."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    path = TextPath((0, 0), letter, size=GLYPH_SIZE, prop=FontProperties(family="DejaVu Sans"))
    area = shapely.Polygon()
    for ring in path.to_polygons(closed_only=True):
        if len(ring) >= 4:
            area = area.symmetric_difference(shapely.Polygon(ring).buffer(0))
    return area


def capital(seed: int = 0, **given: float | str) -> Shape:
    """A capital letter of DejaVu Sans cut from a plate, its foot towards -y; no regions: what it can do is a question, not known."""
    d = Draw("capital", seed, given)
    glyph = d.choice("glyph", tuple(ascii_uppercase))
    height, thickness = d.real("height", 0.12, 0.12), d.real("thickness", 0.016, 0.016)
    color = d.color()
    d.done()
    area = _glyph(glyph)
    low_x, low_y, high_x, high_y = area.bounds
    scale = height / (high_y - low_y)
    area = shapely.affinity.scale(
        shapely.affinity.translate(area, -(low_x + high_x) / 2, -(low_y + high_y) / 2), scale, scale, origin=(0, 0)
    )
    return assemble("capital", seed, d.parameters, [plate(area, -thickness / 2, thickness / 2, color)], {}, "top", DOWN, UP)


STRUCK = {f.__name__: recipe(f) for f in (mallet, peg, block, ring, slot, capital)}
