"""Things that can do none of the jobs: the negative controls of the score's floor.

Outlines of boxes, rods, plates, balls, blades and handles as they lie on a table or in a drawer, seeded.  A few have corners
(a torch's head, a blade's heel, a bottle's shoulder) in which a small enough disc would be held: whether one is a control for
the target at hand is decided as for tools, by :meth:`magic_matcher.jobs.Example.works`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.rendering import VIEW_FILL, VIEW_SIZE
from magic_core.scene import CanonicalView
from magic_matcher.jobs import roughen

Array = NDArray[np.float64]

#: Families on which the floor is fitted, and those on which it is reported.
FITTED = ("bar", "disc", "rod", "torch")
HELD_OUT = ("blade", "polygon", "bottle", "driver", "segment", "bent")


def outline(family: str, seed: int) -> Array:
    """The outline (N, 2) of a plain thing, metres, its length along x."""
    random = np.random.default_rng([seed, *family.encode()])
    real = random.uniform
    length = real(0.06, 0.32)
    if family == "bar":
        return _rounded(_box(length, length * real(0.04, 1.0)), length * real(0.0, 0.02))
    if family == "disc":
        return _ellipse(length / 2, length / 2 * (1.0 if random.random() < 0.5 else real(0.2, 1.0)))
    if family == "rod":
        width = length * real(0.03, 0.3)
        return _rounded(_box(length, width), 0.499 * width)
    if family == "torch":
        thin, head = length * real(0.06, 0.16), length * real(0.15, 0.35)
        thick = thin * real(1.1, 1.9)
        neck = real(0.0, 0.5) * head
        return _mirrored([(0, thin), (length - head - neck, thin), (length - head, thick), (length, thick)])
    if family == "blade":
        handle, tall, grip = length * real(0.3, 0.5), length * real(0.06, 0.2), length * real(0.05, 0.1)
        x = np.linspace(0, 1, 20)
        edge = np.column_stack([handle + (length - handle) * x, tall * (x ** real(1.5, 4.0)) - tall * real(0.3, 1.0)])
        back = [(length, edge[-1, 1]), (0.0, edge[-1, 1]), (0.0, edge[-1, 1] - grip), (handle, edge[-1, 1] - grip)]
        return np.array([*edge, *back])
    if family == "polygon":
        count = int(random.integers(3, 9))
        angle = np.sort(random.uniform(0, 2 * np.pi / count * 0.4, count) + np.arange(count) * 2 * np.pi / count)
        return length / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    if family == "bottle":
        body, neck = length * real(0.12, 0.3), length * real(0.04, 0.11)
        high, top = length * real(0.5, 0.7), length * real(0.72, 0.85)
        s = np.linspace(0, 1, 16)
        shoulder = [(high + (top - high) * t, neck + (body - neck) * (0.5 + 0.5 * np.cos(np.pi * t))) for t in s]
        return _mirrored([(0, body), *shoulder, (length, neck)])
    if family == "driver":
        handle, grip, shaft = length * real(0.35, 0.5), length * real(0.05, 0.09), length * real(0.012, 0.025)
        s = np.linspace(0, np.pi, 24)
        bulge = [(handle * (0.5 - 0.5 * np.cos(t)), max(grip * np.sin(t) ** 0.6, shaft)) for t in s]
        return _mirrored([*bulge, (length, shaft)])
    if family == "segment":
        angle = np.linspace(-1, 1, 60) * real(0.5, np.pi / 2)
        return length / 2 * np.column_stack([np.sin(angle), np.cos(angle) - np.cos(angle[0])])
    if family == "bent":
        width, turn = length * real(0.03, 0.1), np.deg2rad(real(6, 22))
        x = np.linspace(-1, 1, 41)
        line = length / 2 * np.column_stack([x, np.tan(turn) * (np.sqrt(x * x + 0.02))])
        return np.concatenate([line + [0, width / 2], line[::-1] - [0, width / 2]])
    raise ValueError(f"family {family!r} (allowed: {', '.join(FITTED + HELD_OUT)})")


def view(family: str, seed: int, kind: str, rough: bool = False) -> CanonicalView:
    """A plain thing drawn as the matcher sees it, turned at random; rough: as a camera's segmentation has it."""
    points = outline(family, seed)
    angle = np.random.default_rng([seed, 3]).uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    points = points @ np.array([[c, s], [-s, c]])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = float((high - low).max()) / (VIEW_FILL * VIEW_SIZE)
    pixels = (points - (low + high) / 2) / scale + (VIEW_SIZE - 1) / 2
    drawn = np.zeros((VIEW_SIZE, VIEW_SIZE), np.uint8)
    cv2.fillPoly(drawn, [np.round(pixels * 256).astype(np.int32)], 1, shift=8)
    mask = roughen(drawn.astype(bool), seed) if rough else drawn.astype(bool)
    return CanonicalView(np.where(mask[..., None], 160, 0).astype(np.uint8).repeat(3, axis=2), mask, scale, np.eye(4), kind)


def _box(length: float, width: float) -> Array:
    return np.array([(0, 0), (length, 0), (length, width), (0, width)])


def _ellipse(a: float, b: float) -> Array:
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    return np.column_stack([a * np.cos(angle), b * np.sin(angle)])


def _mirrored(half: list[tuple[float, float]]) -> Array:
    upper = np.array(half)
    return np.concatenate([upper, upper[::-1] * [1, -1]])


def _rounded(points: Array, radius: float) -> Array:
    import shapely

    inner = shapely.Polygon(points).buffer(-radius)
    return np.asarray(inner.buffer(radius, quad_segs=16).exterior.coords)[:-1]
