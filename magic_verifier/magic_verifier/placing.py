"""Where the things of a case lie: tools in a turn drawn by the seed, where nothing else stands.

What is drawn is a function of the seed and the case's name, whatever other cases there are and in whichever order they are run.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.rendering import canonical_view
from magic_core.scene import SceneObject

#: Where tools may lie: x and y in metres from the arm's base, within its reach and in the sight of both cameras.
PLACES = (0.30, 0.62), (-0.42, 0.42)
#: Clear way round a tool that lies on the table (m), and places looked at.
CLEARANCE, TRIES = 0.03, 2000
#: Radius (m) of the table that the arm's base stands on.
BASE = 0.15


def seed_of(name: str, seed: int) -> list[int]:
    """A seed of the case's own."""
    return [int(seed), zlib.crc32(name.encode())]


def moved(item: SceneObject, world_from_world: NDArray[np.float64]) -> SceneObject:
    """The object after a motion of the world (4, 4)."""
    return replace(item, world_from_object=world_from_world @ item.world_from_object, world_from_box=world_from_world @ item.world_from_box)


def turned(item: SceneObject, yaw: float) -> SceneObject:
    """The object turned by so many radians about the vertical through its middle."""
    x, y = item.world_from_box[:2, 3]
    about = transforms.make(translation=[x, y, 0]) @ transforms.from_rpy(0, 0, yaw) @ transforms.make(translation=[-x, -y, 0])
    return moved(item, about)


def seen_from_above(item: SceneObject) -> SceneObject:
    """An object whose canonical view is from above, with the picture that a camera over the table has of it as it is turned now."""
    if item.view.kind != "top":
        return item
    ahead = item.world_from_object[:3, :3].T @ np.array([1.0, 0.0, 0.0])
    return replace(item, view=canonical_view(item.mesh, item.view.direction, ahead, "top", item.view.mask.shape[0]))


def footprint(item: SceneObject) -> Any:
    """What an object covers of the table, as a convex polygon in metres."""
    import shapely

    corners = transforms.apply(item.world_from_object, item.mesh.vertices)[:, :2]
    return shapely.MultiPoint(corners).convex_hull


def place(
    item: SceneObject,
    taken: Sequence[Any],
    rng: np.random.Generator,
    fits: Callable[[SceneObject, Any], bool] = lambda _item, _footprint: True,
) -> SceneObject:
    """The object moved to a place where nothing else is near; ``taken``: polygons.  Raises ``BAD_SCENE`` where there is none.

    ``fits`` has the last word on a place: it is given the object there and what it covers.
    """
    from shapely.affinity import translate

    covered = footprint(item)
    middle = covered.envelope.centroid
    for x, y in np.column_stack([rng.uniform(*PLACES[0], TRIES), rng.uniform(*PLACES[1], TRIES)]):
        shift = x - middle.x, y - middle.y
        there = translate(covered, *shift)
        if all(there.distance(other) >= CLEARANCE for other in taken):
            candidate = moved(item, transforms.make(translation=[*shift, 0.0]))
            if fits(candidate, there):
                return candidate
    raise MagicError(Code.BAD_SCENE, f"place for {item.id}", f"none of {TRIES} free", "a tool that finds room on the table")


def place_all(
    tools: Sequence[SceneObject],
    others: Sequence[SceneObject],
    rng: np.random.Generator,
    fits: Callable[[SceneObject, Any], bool] = lambda _item, _footprint: True,
) -> list[SceneObject]:
    """All tools beside each other, the others and the arm's base: the large ones first, the small ones find room between them."""
    import shapely

    taken = [shapely.Point(0.0, 0.0).buffer(BASE), *(footprint(item) for item in others)]
    placed = {}
    for tool in sorted(tools, key=lambda tool: -footprint(tool).area):
        placed[tool.id] = place(tool, taken, rng, fits)
        taken.append(footprint(placed[tool.id]))
    return [placed[tool.id] for tool in tools]
