"""An object of a scene from a mesh and where it stands, by somebody else's word: a detector's, another planner's."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh, check_solid
from magic_core.scene import SceneObject
from magic_core.views import find_view

#: A rectangle whose sides differ by less than this share has no longer side.
SQUARE = 0.04


def upright_box(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_box (4, 4): the middle of the smallest upright box about points (N, 3), z up, x along its longer horizontal side
    (towards +x, else +y, of the world; along the world's x where no side is longer)."""
    low, high = points.min(axis=0), points.max(axis=0)
    (x, y), (width, height), angle = cv2.minAreaRect(((points[:, :2] - low[:2]) * 1000).astype(np.float32))
    if abs(width - height) < SQUARE * max(width, height):
        x, y, angle = *((high - low)[:2] * 500), 0.0
    elif height > width:
        angle += 90.0
    yaw = (np.radians(angle) + np.pi / 2) % np.pi - np.pi / 2
    return transforms.from_rpy(0, 0, yaw, [x / 1000 + low[0], y / 1000 + low[1], (low[2] + high[2]) / 2])


def placed(
    name: str, mesh: Mesh, pieces: Sequence[Mesh], world_from_mesh: NDArray[np.float64], source: str, confidence: float = 1.0
) -> SceneObject:
    """An object from its mesh and convex pieces, both in the mesh's own frame, and its pose (4, 4), whatever is up in that frame.

    Its frame is that of its upright box, as of what cameras reconstruct, and the view is drawn as it stands.  Nothing of it was seen by
    this software: there is no cloud, and where ``confidence`` is 0 no surface counts as seen.  Raises BAD_MESH.
    """
    check_solid(mesh, name)
    pose = upright_box(transforms.apply(world_from_mesh, mesh.vertices))
    own = transforms.inverse(pose) @ world_from_mesh
    local, parts = mesh.transformed(own), tuple(piece.transformed(own) for piece in pieces)
    low, high = local.bounds
    return SceneObject(
        name,
        local,
        parts,
        pose,
        find_view(local, parts),
        world_from_box=pose @ transforms.make(translation=(low + high) / 2),
        box_extents=high - low,
        confidence=confidence,
        source=source,
        seen_share=1.0 if confidence > 0 else 0.0,
    )
