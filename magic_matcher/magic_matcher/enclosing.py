"""How far a tool goes around what it holds: a hole does so all the way, a hook most of it, a bend or a hollow less.

A demonstrated contact in a loop can only be repeated in a loop.  A thing that shows none, and of which a good part was never seen,
may have one on the side that no camera saw: that is another answer than that it has no such place.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.scene import SceneObject
from magic_core.views import holes_of
from magic_matcher.contour import Contour

#: What goes around its middle by at least this share of all directions is a loop: a hook of 265 degrees does by 0.74 and more, a U whose
#: arms are long by 0.77, a right-angled bend by 0.52 at most.
LOOP = 0.6
#: A direction counts where the tool is met within so many times the distance from the middle to the nearest edge.
REACH = 1.5
#: Directions looked in, and places of an outline looked at.
DIRECTIONS, PLACES = 36, 120
#: The middle of a loop is as far from the outline as these shares of the tool's size, at least and at most.
NEAREST, FARTHEST, DISTANCES = 0.03, 0.45, 8
#: So much of a thing's surface must have stayed unseen for a handle to be there: one takes a quarter of what is seen of a round body from
#: its side.
UNSEEN = 0.2
#: Points of a surface that tell which way what was seen of it faces.
SURFACE = 2000


def enclosure(contour: Contour, middles: NDArray[np.float64], distances: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share (N,), 0 to 1, of directions in which from points (N, 2) px the tool is met within :data:`REACH` times distances (N,) px.

    0 for a point on the tool, or with the tool nearer than eight tenths of its distance.
    """
    turns = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    # Steps of a pixel and a half at most: a thin bar is not stepped over.
    steps = np.linspace(0.0, 1.0, max(8, int(REACH * float(distances.max(initial=1.0)) / 1.5)))
    spots = middles[:, None, None] + (REACH * distances)[:, None, None, None] * steps[:, None] * ways[:, None]
    solid = np.empty(spots.shape[:3], bool)
    for i, spot in enumerate(spots):
        solid[i] = contour.sample(spot[..., 0].astype(np.float32), spot[..., 1].astype(np.float32)) > 0.5
    crowded = (solid & (REACH * steps < 0.8)).any(axis=(1, 2))
    return np.where(crowded, 0.0, solid.any(axis=2).mean(axis=1))


def asked(contour: Contour, pixel: NDArray[np.float64], normal: NDArray[np.float64], radius: float) -> bool:
    """Whether a concave contact (2,) px with its outward normal and radius of curvature, px, lies in a loop."""
    if not np.isfinite(radius):
        return False
    # Where a loop is no circle its middle is nearer than the centre of curvature.
    distances = radius * np.array([0.4, 0.55, 0.75, 1.0])
    return bool(enclosure(contour, pixel + distances[:, None] * normal, distances).max() >= LOOP)


def most(contour: Contour) -> float:
    """By how much an outline goes around the place that it goes around most, 0 to 1; a hole that is more than a slit counts in full."""
    holes = cv2.distanceTransform(np.pad(holes_of(contour.soft > 0.5), 1).view(np.uint8), cv2.DIST_L2, 3)
    if float(holes.max()) > NEAREST * contour.size / 2:
        return 1.0
    index = np.unique(np.linspace(0, len(contour.points) - 1, PLACES).round().astype(int))
    distances = np.geomspace(NEAREST * contour.size, FARTHEST * contour.size, DISTANCES)
    return max(
        float(enclosure(contour, contour.points[index] + distance * contour.normals[index], np.full(len(index), distance)).max())
        for distance in distances
    )


def unseen_side(item: SceneObject) -> NDArray[np.float64] | None:
    """The level direction (2,), in the world, away from the one that the seen part of a thing's surface faces; ``None`` where that faces
    none more than another, or no cloud is known."""
    import trimesh
    from scipy.spatial import cKDTree

    if not len(item.points) or not len(item.mesh.faces):
        return None
    solid = item.mesh.transformed(item.world_from_object).to_trimesh()
    points, face = trimesh.sample.sample_surface(solid, SURFACE, seed=0)
    cloud = item.points[:: max(1, len(item.points) // SURFACE)]
    seen = solid.face_normals[face[cKDTree(points).query(cloud)[1]], :2].mean(axis=0)
    facing = float(np.linalg.norm(seen))
    return -seen / facing if facing > 0.1 else None
