"""Something like a hand about a tool's handle, for made demonstrations and for tests: it hides what a hand hides."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh, concatenate, from_trimesh

SKIN = (205, 160, 135)


def _between(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> Mesh:
    a, b = np.array(start), np.array(end)
    along = b - a
    shape = from_trimesh(trimesh.creation.capsule(float(np.linalg.norm(along)), radius, count=(10, 10)))
    across = [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 * np.linalg.norm(along) else [0.0, 1.0, 0.0]
    z = transforms.unit(along)
    x = transforms.unit(np.cross(np.cross(z, across), z))
    return shape.transformed(transforms.make(np.column_stack([x, np.cross(z, x), z]), a))


def hand(thick: float) -> Mesh:
    """A hand that has closed on a handle from above, with a piece of the forearm; painted as skin.

    Its frame: the origin in the middle of the handle, x along the handle to the tool's working end, z up to the palm; ``thick`` metres:
    the handle's, across and up.
    """
    side, top = thick / 2 + 0.010, thick / 2 + 0.022
    palm = trimesh.creation.icosphere(subdivisions=2)
    palm.apply_scale([0.045, 0.036, 0.018])
    palm.apply_translation([0.0, 0.0, top])
    fingers = [_between((x, side, top), (x, side, 0.004), 0.009) for x in (-0.033, -0.012, 0.009, 0.030)]
    thumb = _between((0.0, -side, top), (0.025, -side, 0.004), 0.011)
    forearm = _between((-0.03, 0.0, top + 0.01), (-0.20, 0.0, top + 0.19), 0.033)
    return concatenate([from_trimesh(palm), *fingers, thumb, forearm]).painted(SKIN)


def coming(since: float, arrives: float = 0.3) -> NDArray[np.float64]:
    """Where the hand is (3,), from where it closes, in its own frame, ``since`` seconds after it sets out: it comes
    from behind and above in ``arrives`` s."""
    left = float(np.clip(1 - since / arrives, 0.0, 1.0))
    return left * np.array([-0.25, 0.0, 0.30])
