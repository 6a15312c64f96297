"""The object to act on: the view that it is matched in, and p_O', the place on it that a tool meets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import Contact, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.rendering import canonical_view
from magic_core.scene import CanonicalView, SceneObject
from magic_core.shapes import section_view
from magic_core.strategy import Strategy
from magic_matcher import contour as contours
from magic_matcher import curvature, facing
from magic_matcher.candidates import to_contact
from magic_matcher.contour import Contour

#: Narrower ways across (share of the object's size) are the raster's.
LEAST_ACROSS = 0.03

#: Finds the place on a target, in its view, that is like the strategy's contact on the demonstrated one, of those that face a picture
#: direction (2,).
FeatureOf = Callable[[Strategy, CanonicalView, NDArray[np.float64]], Contact]
#: Points within so many pixels of the farthest are of one flat side.
FLAT = 0.5


@dataclass(frozen=True)
class Target:
    """The object to act on: its id, the view along the strategy's direction and p_O on it; further: where the strategy's further contacts
    meet it."""

    id: str
    view: CanonicalView
    contact: Contact
    further: tuple[Contact, ...] = ()


def target_view(item: SceneObject, strategy: Strategy) -> CanonicalView:
    """The target as seen along the strategy's direction, world up (world x where it looks down) at the top of the picture.

    Where the strategy's contact is on the target's outline as cut through its middle, the cut is what is drawn.
    """
    object_from_world = transforms.inverse(item.world_from_object)
    direction = strategy.target_view_direction
    up = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    rotation = object_from_world[:3, :3]
    if strategy.target_outline == "cut":
        return replace(section_view(item.mesh, rotation @ direction, rotation @ up), kind=strategy.view)
    return canonical_view(item.mesh, rotation @ direction, rotation @ up, strategy.view)


def contact_on(strategy: Strategy, view: CanonicalView, world_from_object: NDArray[np.float64], feature_of: FeatureOf) -> Contact:
    """p_O': what of the target's silhouette a tool meets that is led against the strategy's target normal (:mod:`magic_matcher.facing`),
    with its curvature; where that is neither flat, round nor a corner, the place that reaches farthest.

    For a strategy that meets its target inside, the place inside that faces that normal (:func:`inner_point`); for one that meets
    it at a feature, what ``feature_of`` finds (:meth:`magic_matcher.matching.Matcher.feature_of`).
    """
    normal = world_from_object[:3, :3].T @ strategy.target_normal
    picture = normal @ view.object_from_view[:3, :2]
    if np.linalg.norm(picture) < 0.1:
        raise MagicError(
            Code.BAD_STRATEGY, "target normal", strategy.target_normal.round(3).tolist(), "a direction that is seen in the target's view"
        )
    direction = picture / np.linalg.norm(picture)
    if strategy.target_outline == "feature":
        return feature_of(strategy, view, direction)
    contour = contours.extract(view.mask)
    met = facing.side(contour, direction) if strategy.target_outline == "outer" else None
    if met is not None:
        contact = Contact(
            met.point,
            direction,
            met.radius * view.metres_per_pixel,
            False,
            met.scale * view.metres_per_pixel,
            contact_frame(view, met.point, direction),
        )
    else:
        place = support_point if strategy.target_outline == "outer" else inner_point
        contact = to_contact(view, curvature.estimate(contour, place(contour, direction)))
    # The normal asked for is the one acted along; the picture's own differs from it by raster noise only.
    if float(contact.normal @ direction) > np.cos(np.deg2rad(20)):
        contact = replace(contact, normal=direction, object_from_contact=contact_frame(view, contact.pixel, direction))
    return contact


def support_point(contour: Contour, direction: NDArray[np.float64]) -> int:
    """Index of the contour point farthest along a picture direction (2,); in the middle of a flat side."""
    return _middle_of_highest(contour, np.nonzero(contour.loop == 0)[0], direction, FLAT)


def inner_point(contour: Contour, direction: NDArray[np.float64]) -> int:
    """Index of the contour point that a tool meets which is led against a picture direction (2,) inside the object.

    Inside is where, going from the object along ``direction``, one comes to the object again: a hole, a notch.  Of several the one
    with the widest way across is taken, in it the point that lies farthest against ``direction``, in the middle of a flat side.
    Raises ``NO_MATCH`` where the outline has no such place.
    """
    towards = np.nonzero(contour.normals @ direction > np.cos(facing.FACING))[0]
    way = np.arange(2.0, contour.size + 2.0)
    ahead = (contour.points[towards, None] + way[:, None] * direction).astype(np.float32)
    solid = contour.sample(ahead[..., 0], ahead[..., 1]) > 0.5
    across = np.where(solid.any(axis=1), way[np.argmax(solid, axis=1)], 0.0)
    towards, across = towards[across > LEAST_ACROSS * contour.size], across[across > LEAST_ACROSS * contour.size]
    if not len(towards):
        raise MagicError(
            Code.NO_MATCH,
            "places inside the target's outline that face the tool",
            0,
            "a hole or a notch that is open towards the strategy's target normal",
        )
    # Stretches: neighbours on one loop.  A loop that begins within a stretch cuts it in two, which changes nothing that counts.
    stretch = np.concatenate([[0], np.cumsum((np.diff(towards) > 3) | (np.diff(contour.loop[towards]) != 0))])
    widest = stretch[int(np.argmax(across))]
    return _middle_of_highest(contour, towards[stretch == widest], -direction, FLAT)


def _middle_of_highest(contour: Contour, among: NDArray[np.int64], direction: NDArray[np.float64], tolerance: float) -> int:
    """Index of the point farthest along a direction (2,) of those ``among`` (K,) the contour's; in the middle of a flat side."""
    height = contour.points[among] @ direction
    level = among[height >= float(height.max()) - tolerance]
    across = contour.points[level] @ np.array([-direction[1], direction[0]])
    middle = 0.5 * (float(across.min()) + float(across.max()))
    return int(level[np.argmin(np.abs(across - middle))])
