"""Whether the objects are still where a plan believes them.  No ROS here."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject


def _directions(count: int = 200) -> NDArray[np.float64]:
    """Unit vectors (count, 3), evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(count)
    z = 1 - 2 * (k + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * k
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


DIRECTIONS = _directions()


def hull(item: SceneObject) -> NDArray[np.float64]:
    """How far an object reaches, in metres of the world, along each of ``DIRECTIONS``: the support function of its convex hull."""
    points = transforms.apply(item.world_from_object, item.mesh.vertices)
    return (points @ DIRECTIONS.T).max(axis=0)


def distance(before: SceneObject, after: SceneObject) -> float:
    """How far an object has moved, m: the Hausdorff distance of its convex hulls.

    It does not depend on how the object's own frame and mesh were chosen, which another look may choose otherwise.
    """
    return float(np.abs(hull(before) - hull(after)).max())


def check(before: Iterable[SceneObject], after: Iterable[SceneObject], tolerance: float) -> None:
    """Refuse a scene in which an object is gone, has come, or has moved by more than ``tolerance`` m; raises STALE_DATA."""
    old, new = {o.id: o for o in before}, {o.id: o for o in after}
    for what, ids in (("gone since the plan", old.keys() - new.keys()), ("come since the plan", new.keys() - old.keys())):
        if ids:
            raise MagicError(Code.STALE_DATA, f"objects {what}", ", ".join(sorted(ids)), ", ".join(sorted(old)))
    for name, item in old.items():
        moved = distance(item, new[name])
        if not moved <= tolerance:
            raise MagicError(
                Code.STALE_DATA, f"{name} has moved since the plan, in mm", round(1000 * moved, 1), f"at most {1000 * tolerance:g}"
            )
