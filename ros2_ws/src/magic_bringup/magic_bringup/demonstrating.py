"""What demonstrations that are made, not recorded, have in common: motions through waypoints, views and contacts of the target."""

from __future__ import annotations

import itertools
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import OPPOSED, Contact, contact_frame
from magic_core.placement import Pairs, waypoint_poses
from magic_core.rendering import VIEW_FILL, canonical_view
from magic_core.scene import CanonicalView
from magic_core.shapes import Shape, section_view
from magic_core.strategy import Waypoint

Poses = NDArray[np.float64]

#: Sampling of the demonstrated trajectories, seconds.
SAMPLE = 0.05
UP = np.array([0.0, 0.0, 1.0])


def line(points: list[NDArray[np.float64]], speed: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rest-to-rest motion with a smooth start and stop along a polyline: times (T,), points (T, 3)."""
    times, places, now = [0.0], [points[0]], 0.0
    for a, b in itertools.pairwise(points):
        length = float(np.linalg.norm(b - a))
        duration = max(1.5 * length / speed, SAMPLE)  # a cubic's highest speed is 1.5 times its mean
        count = max(int(np.ceil(duration / SAMPLE)), 1)
        s = np.linspace(0, 1, count + 1)[1:]
        times += list(now + s * duration)
        places += [a + (b - a) * (3 * t**2 - 2 * t**3) for t in s]
        now += duration
    return np.array(times), np.array(places)


def target_view(shape: Shape, kind: str, direction: NDArray[np.float64]) -> CanonicalView:
    """The view of a target that stands in its object frame: world up is up, world +x where it is seen from above."""
    up = np.array([1.0, 0.0, 0.0]) if abs(direction[2]) > 0.9 else UP
    return section_view(shape.mesh, direction, up) if kind == "section" else canonical_view(shape.mesh, direction, up, kind)


def target_contact(view: CanonicalView, point: NDArray[np.float64], normal: NDArray[np.float64], radius: float) -> Contact:
    """The contact at a point (3,) of a convex outline with an outward normal (3,), object frame, and a radius of curvature."""
    pixel = view.pixels(point)
    picture = transforms.unit(normal @ view.object_from_view[:3, :2])
    # Of a straight one a quarter of the thing, as shapes have it.
    scale = 3.5 * radius if np.isfinite(radius) else 0.25 * VIEW_FILL * view.mask.shape[0] * view.metres_per_pixel
    return Contact(pixel, picture, radius, False, scale, contact_frame(view, pixel, picture))


def through(waypoints: tuple[Waypoint, ...], pairs: Pairs = MappingProxyType({})) -> tuple[NDArray[np.float64], Poses]:
    """Times (T,) and target_contact_from_tool_contact (T, 4, 4), of the first contact, through waypoints, squarely opposed.

    Frames of further contacts (``pairs``) are those of the first, moved: the tool does not turn.
    """
    times, offsets = line([pose[:3, 3] for pose in waypoint_poses(waypoints, pairs)], 0.1)
    return times, np.stack([transforms.make(translation=offset) @ OPPOSED for offset in offsets])


def trajectory(target: Contact, contacts: Poses, tool: Contact) -> Poses:
    """target_from_tool (T, 4, 4) from the contact frames' relative motion."""
    return target.object_from_contact @ contacts @ transforms.inverse(tool.object_from_contact)


def demonstrated(
    tool: Shape,
    tool_view: CanonicalView,
    tool_contact: Contact,
    target: Shape,
    seen: CanonicalView,
    touched: Contact,
    normal: NDArray[np.float64],
    direction: NDArray[np.float64],
    times: NDArray[np.float64],
    contacts: Poses,
) -> dict[str, Any]:
    """What every strategy has of its demonstration, by the names of :class:`Strategy`.

    ``seen`` and ``touched``: the target's view and contact; ``contacts``: target_contact_from_tool_contact (T, 4, 4) over ``times``.
    """
    return {
        "tool_view": tool_view,
        "tool_contact": tool_contact,
        "target_view": seen,
        "target_contact": touched,
        "target_normal": normal,
        "target_view_direction": direction,
        "times": times,
        "target_from_tool": trajectory(touched, contacts, tool_contact),
        "tool_mesh": tool.mesh,
        "target_mesh": target.mesh,
    }


def made_of(shape: Shape) -> dict[str, Any]:
    """A shape for a strategy's environment."""
    return {"family": shape.family, "seed": shape.seed, "parameters": dict(shape.parameters)}


def unseen(*families: str) -> dict[str, Any]:
    """A set of tools by whose seeds nothing was ever set: 60 of the families in turn, one target each."""
    return {"each": [f"{family}:{{}}" for family in families], "first": 50_000, "count": 60, "paired": True}
