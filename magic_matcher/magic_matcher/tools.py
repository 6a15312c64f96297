"""A tool as the matcher sees it: its views, and what of it is known and what is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView, SceneObject
from magic_core.views import as_it_stands, mirrored, own_views, same_direction, square_view
from magic_matcher import enclosing

#: A place whose outward normal points so far below the level, rad, faces what a tool lies on.
DOWN = np.deg2rad(20.0)


@dataclass(frozen=True)
class Tool:
    """A tool to consider: its id, the view in which contacts are matched, and what draws further ones, where it can be turned.

    Attributes
    ----------
    others : draws the further views.
    askew : the view is not square to the tool, and stands back behind the others.
    seen_share : how much of its surface was seen.
    unseen_side : the level direction (2,), in the world, that the rest of it faces, where that is known.
    told_in : the view in which what is found in ``view`` is told, where that is another.
    mesh : on whose surface contacts are put; ``None`` where there are pictures alone.
    up : (3,), the vertical, in the object's frame, of what cameras saw as it lies, and in a cut shows sides that none of them saw;
        ``None``: all sides are known.
    """

    id: str
    view: CanonicalView
    others: Callable[[], Sequence[CanonicalView]] = tuple
    askew: bool = False
    seen_share: float = 1.0
    unseen_side: Callable[[], NDArray[np.float64] | None] = lambda: None
    told_in: CanonicalView | None = None
    mesh: Mesh | None = None
    up: NDArray[np.float64] | None = None

    def hides(self, view: CanonicalView, normal: NDArray[np.float64]) -> bool:
        """Whether a place of a cut, with that outward normal (2,) in the picture, faces what the tool lies on: its shape there is a
        guess."""
        return self.up is not None and view.kind == "section" and float(view.directions(normal) @ self.up) < -np.sin(DOWN)


def tool_of(item: SceneObject, kind: str) -> Tool:
    """An object as a tool: seen in the view of a kind as it stands, and, where that is not enough, in those of its own shape.

    A hanger that lies on the table is edge-on in the side view of how it lies; the plane in which it is used is its own.  The view as
    it stands, where it is square to the tool, says from where to look; the picture is drawn along and in the tool's own axes, so that it
    is the same however the tool lies, and so is the place that is found in it.
    """

    def own(apart_from: NDArray[np.float64] | None) -> Sequence[CanonicalView]:
        return own_views(item.mesh, item.pieces, kind, apart_from)

    known: dict[str, Any] = {"seen_share": item.seen_share, "unseen_side": lambda: enclosing.unseen_side(item), "mesh": item.mesh}
    if item.source == "camera":
        known["up"] = item.world_from_object[2, :3].copy()
    try:
        stands = as_it_stands(item, kind)
    except MagicError as error:
        if error.code is not Code.BAD_MESH:
            raise
        views = own(None)
        if not views:
            raise
        return Tool(item.id, views[0], lambda: views[1:], **known)
    view = square_view(item, stands, kind)
    if view is None:
        return Tool(item.id, stands, lambda: own(None), True, **known)
    # What lies is told as seen from right above: it is used as it lies.  Else the axis is, of whose two sides the view is on one.
    side = view if view.direction @ stands.direction > 0 else mirrored(view)
    told_in = stands if kind == "top" or same_direction(side.direction, stands.direction) else side
    return Tool(item.id, view, lambda: own(view.direction), told_in=told_in, **known)
