"""Standing things of any form: convex outlines of layers, completed by half a turn, bounded by the silhouettes, joined."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from shapely.geometry import Polygon

from magic_core.errors import Code, MagicError
from magic_perception import polygons
from magic_perception.sight import Sight, silhouette, surface
from magic_perception.solids import Reconstruction, loft_pieces, lofted


def upright_axis(sights: list[Sight], fronts: list[NDArray[np.float64]], start: NDArray[np.float64], height: float) -> NDArray[np.float64]:
    """The upright axis (2,) of a standing thing: where the cameras' silhouettes have their middles, and, along each camera's
    direction, where the seen fronts bend back to the silhouette's edges as the arcs of an ellipse do."""
    middle = start
    for _ in range(3):
        matrix, value = [], []
        for sight, points in zip(sights, fronts, strict=True):
            away, right, edges = silhouette(sight, middle)
            band = edges[(edges[:, 1] > 0.15 * height) & (edges[:, 1] < 0.85 * height), 0]
            if len(band) < 6 or len(points) < 30:
                continue
            low, high = np.median(band[: len(band) // 2]), np.median(band[len(band) // 2 :])
            matrix.append(right)
            value.append(right @ middle + (low + high) / 2)
            part = points[(points[:, 2] > 0.15 * height) & (points[:, 2] < 0.85 * height)]
            across = ((part[:, :2] - middle) @ right - (low + high) / 2) / max((high - low) / 2, 1e-3)
            inner = np.abs(across) < 0.92
            if np.count_nonzero(inner) < 6:  # all that was seen of it is at its top or foot, or at its edges
                continue
            bulge = np.sqrt(1 - across[inner] ** 2)
            far, depth = np.linalg.lstsq(np.column_stack([np.ones(len(bulge)), -bulge]), (part[inner, :2] - middle) @ away, rcond=None)[0]
            # A flat front does not tell how thick the thing is: then as thick as a third of its width, at most as it is wide.
            half = (high - low) / 2
            depth = float(np.clip(depth, 0.33 * half, half))
            far = float(np.median((part[inner, :2] - middle) @ away + depth * bulge))
            matrix.append(0.4 * away)
            value.append(0.4 * (away @ middle + far))
        if not matrix:
            return middle
        matrix += [0.01 * np.array([1.0, 0]), 0.01 * np.array([0, 1.0])]
        value += (0.01 * middle).tolist()
        middle = np.linalg.lstsq(np.array(matrix), np.array(value), rcond=None)[0]
    return middle


def build_layers(sights: list[Sight], points: NDArray[np.float64], height: float) -> Reconstruction:
    """A standing thing of any form: convex outlines of layers, joined.

    A layer holds what was seen of it, away from the mask's edge, where depth is not to be trusted, and the same turned by
    half a turn about the upright axis, where no camera saw through that; the silhouettes bound its width.
    """
    fronts = []
    for sight in sights:
        inner = cv2.erode(sight.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        cloud = surface(replace(sight, mask=inner))
        fronts.append(cloud[cloud[:, 2] > -0.005])
    seen = np.concatenate(fronts)
    if len(seen) < 50:
        seen = points
    height = max(height, float(np.percentile(seen[:, 2], 99.5)))
    middle = upright_axis(sights, fronts, np.median(seen[:, :2], axis=0), height)
    mirrored = np.column_stack([2 * middle - seen[:, :2], seen[:, 2]])
    inside = np.ones(len(mirrored), bool)
    for sight in sights:
        shown, _, z, measured = sight.sample(mirrored)
        with np.errstate(invalid="ignore"):
            inside &= ~((shown < 0.3) | (measured > z + 0.015))
    everything = np.concatenate([seen, mirrored[inside]])
    views = [silhouette(sight, middle) for sight in sights]
    count = int(np.clip(height / 0.008, 3, 24))
    levels = np.linspace(0, height, count + 1)
    turns = np.arange(_SIDES) * 2 * np.pi / _SIDES
    rings: list[NDArray[np.float64] | None] = []
    for z in levels:
        half = height / count / 2 + 0.002
        here = everything[np.abs(everything[:, 2] - np.clip(z, half, height - half)) < half, :2]
        for _, right, edges in views:
            row = edges[np.abs(edges[:, 1] - np.clip(z, half, height - half)) < half, 0]
            if len(row) > 1 and len(here):
                across = (here - middle) @ right
                here = here[(across > row.min() - 0.001) & (across < row.max() + 0.001)]
                if inside.mean() > 0.5:  # the edges themselves lie about beside the axis
                    here = np.vstack([here, middle + right * row.min(), middle + right * row.max()])
        rings.append(_ring(here, turns) if len(here) > 8 else None)
    known = [i for i, ring in enumerate(rings) if ring is not None]
    if not known:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "layers of one object", "empty", "points that span an area")
    loft = np.stack([rings[min(known, key=lambda j: abs(j - i))] for i in range(len(levels))])
    solid = np.concatenate([loft, np.repeat(levels[:, None, None], _SIDES, axis=1)], axis=2)
    return Reconstruction(lofted(solid), tuple(loft_pieces(solid)), "layers")


#: Corners of a layer's outline.
_SIDES = 40


def _ring(points: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The convex hull of points (N, 2) as a ring (len(turns), 2), its corners in fixed directions from the centroid; without the outermost
    1 %."""
    centre = np.median(points, axis=0)
    reach = np.linalg.norm(points - centre, axis=1)
    hull = polygons.convex_hull(points[reach <= np.percentile(reach, 99)])
    if len(hull) < 3:
        return None
    outline = Polygon(hull)
    if outline.area < 1e-6:
        return None
    centre = np.asarray(outline.centroid.coords[0])
    local = hull - centre
    following = np.roll(local, -1, axis=0)
    edge = following - local
    # Ray t d meets the line through a corner along its edge: the least t over edges that face the direction.
    direction = np.column_stack([np.cos(turns), np.sin(turns)])
    normal = np.column_stack([edge[:, 1], -edge[:, 0]])
    facing = direction @ normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(facing > 1e-12, np.sum(normal * local, axis=1) / facing, np.inf)
    return centre + direction * t.min(axis=1)[:, None]
