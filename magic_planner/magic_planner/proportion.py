"""A scoop keeps to table and walls in the measure of its target.

A demonstrated motion is carried over as it is, from where the new target's contact stands: what leads the contact 70 mm off a
wall at the end, with the lip of a bowl before it, leads it 50 mm off with a smaller ball that was 20 mm nearer.  The lip of the
tool that goes beneath it then is higher on the wall than the ball's middle, and drives the ball up and over the wall's end
instead of going beneath.  With d the distance of the contact from table and obstacles and h its height above what the target
stands on, the contact of a smaller target is led at

    d = (h / h_shown) d_shown

wherever it would be further off, by h_shown - h at most, d_shown being the distance that the contact of a target of the demonstrated size
would have at the same place.  Once the tool has turned beneath the target it is taken away as was shown.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import concatenate
from magic_core.rendering import Raycaster
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_planner.collision import solid_pieces
from magic_planner.giving_way import averaged, way_along

Array = NDArray[np.float64]
#: The tool has turned beneath its target where its contact's normal is so near (cosine) to how it ends: 2 degrees.
TURNED = np.cos(np.deg2rad(2.0))
#: Way, metres, over which the displacement is smoothed.
SMOOTHING = 0.03


def in_measure(
    strategy: Strategy,
    target: SceneObject,
    target_from_contact: Array,
    contacts: Array,
    obstacles: Sequence[SceneObject],
    plane: Array,
) -> Array:
    """world_from_contact (T, 4, 4): the contact frames C(t) (T, 4, 4) of a demonstrated scoop about a target, nearer to table and obstacles
    where it is smaller than the demonstrated one.  plane (4,): the table, unit normal up."""
    world_from_contact = target.world_from_object @ target_from_contact
    frames = world_from_contact @ contacts
    up = plane[:3] @ world_from_contact[:3, :3]
    shown = _height_and_depth(strategy.target_contact.object_from_contact, strategy.target_mesh.vertices, up)
    now = _height_and_depth(target_from_contact, concatenate(solid_pieces(target)).vertices, up)
    if not obstacles or now[0] >= shown[0]:
        return frames
    walls = Raycaster([piece.transformed(item.world_from_object) for item in obstacles for piece in solid_pieces(item)])
    points = frames[:, :3, 3]
    larger = points + (shown[0] - now[0]) * plane[:3] + (shown[1] - now[1]) * world_from_contact[:3, 0]
    away = walls.nearest(points) - points
    distance = np.linalg.norm(away, axis=1)
    wanted = now[0] / shown[0] * np.minimum(walls.distances(larger), larger @ plane[:3] + plane[3])
    off = np.where(distance < points @ plane[:3] + plane[3], np.clip(distance - wanted, 0.0, shown[0] - now[0]), 0.0)
    shift = off[:, None] * away / np.maximum(distance, 1e-9)[:, None]
    normal = world_from_contact[:3, 2]
    shift -= (shift @ normal)[:, None] * normal
    turned = int((frames[:, :3, 0] @ frames[-1, :3, 0] >= TURNED).argmax())
    shift[turned:] = shift[turned]
    frames[:, :3, 3] += averaged(shift, way_along(frames), lambda apart: np.exp(-0.5 * (apart / (SMOOTHING / 2)) ** 2))
    return frames


def _height_and_depth(object_from_contact: Array, vertices: Array, up: Array) -> tuple[float, float]:
    """How high a contact is above the lowest of an object's vertices (N, 3), and how far out from its middle along its own normal,
    metres; ``up`` (3,) in the contact frame."""
    points = transforms.apply(transforms.inverse(object_from_contact), vertices)
    return float(-(points @ up).min()), float(np.ptp(points[:, 0]) / 2)
