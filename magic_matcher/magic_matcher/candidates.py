"""Contacts and candidates moved from where they were found to where they are wanted: onto the surface, and into another view."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import Contact, ContactCandidate, contact_frame, turned_over
from magic_core.scene import CanonicalView
from magic_core.surface import Surface
from magic_matcher import curvature, facing, global_stage
from magic_matcher.contour import Contour


def to_contact(view: CanonicalView, found: curvature.Estimate) -> Contact:
    """A Contact (metres) from an estimate (pixels of the view)."""
    scale = view.metres_per_pixel
    normal = found.normal / np.linalg.norm(found.normal)
    return Contact(found.point, normal, found.radius * scale, found.concave, found.scale * scale, contact_frame(view, found.point, normal))


def squared(view: CanonicalView, contour: Contour, candidate: ContactCandidate, reference: Contact) -> ContactCandidate:
    """A candidate of a straight reference as the straight side of its outline at its place, where there is one."""
    met = None if np.isfinite(reference.radius) else facing.straight_at(contour, candidate.tool.pixel, candidate.tool.normal)
    if met is None:
        return candidate
    side, normal = met
    scale = side.scale * view.metres_per_pixel
    contact = Contact(side.point, normal, np.inf, False, scale, contact_frame(view, side.point, normal))
    return with_contact(candidate, contact, candidate.flipped, candidate.rotation, reference)


def on_surface(surface: Surface, view: CanonicalView, reference: Contact, candidate: ContactCandidate) -> ContactCandidate:
    """The candidate with its frame as deep along the line of sight as the surface is, and the surface's own frame there.

    A section's plane cuts the surface where the contact is.
    """

    def put(contact: Contact) -> Contact:
        frame = contact.object_from_contact.copy()
        depth = 0.0 if view.kind == "section" else surface.depth_of_edge(view, contact.pixel, contact.normal)
        if depth is None:  # a pocket: the contact is between parts of the tool
            depth = surface.depth_beside(view, contact.pixel)
        frame[:3, 3] += depth * view.direction
        return replace(contact, object_from_contact=frame, surface=surface.principal_frame(frame))

    candidate = with_companions(candidate, put)
    return with_contact(candidate, put(candidate.tool), candidate.flipped, candidate.rotation, reference)


def seen_from(
    candidate: ContactCandidate, before: CanonicalView, view: CanonicalView, shown: NDArray[np.float64], reference: Contact
) -> ContactCandidate:
    """A candidate of the view ``before`` as it is in one along nearly the same direction, or nearly the opposite one: mirrored there.

    shown (2,): the demonstrated contact's normal in its picture, from which the rotation is told.
    """

    def there(contact: Contact) -> Contact:
        frame = contact.object_from_contact
        point, across = frame[:3, 3], frame[:3, 0] - (frame[:3, 0] @ view.direction) * view.direction
        normal = transforms.unit(across @ view.object_from_view[:3, :2])
        return replace(
            contact, pixel=view.pixels(point), normal=normal, object_from_contact=transforms.frame(point, across, view.direction)
        )

    over = bool(before.direction @ view.direction < 0)
    contact, flipped = there(candidate.tool), candidate.flipped != over
    rotation = global_stage.rotation_between(shown, contact.normal, flipped)
    return with_contact(with_companions(candidate, there), contact, flipped, rotation, reference)


def heatmap_seen_from(heatmap: NDArray[np.float32], before: CanonicalView, view: CanonicalView) -> NDArray[np.float32]:
    """A heatmap over the view ``before`` as one over another along nearly the same line."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    moved = view.pixels(before.points(corners)).astype(np.float32)
    height, width = view.mask.shape
    warped = cv2.warpAffine(heatmap, cv2.getAffineTransform(corners.astype(np.float32), moved), (width, height))
    return np.where(view.mask, np.clip(warped, 0, 1), 0).astype(np.float32)


def with_contact(candidate: ContactCandidate, contact: Contact, flipped: bool, rotation: float, reference: Contact) -> ContactCandidate:
    """The candidate with another contact, and the motion of the demonstrated tool onto it."""
    frame = turned_over(contact.object_from_contact) if flipped else contact.object_from_contact
    aligned = frame @ transforms.inverse(reference.object_from_contact)
    return replace(candidate, tool=contact, flipped=flipped, rotation=rotation, tool_from_reference=aligned)


def with_companions(candidate: ContactCandidate, changed: Callable[[Contact], Contact]) -> ContactCandidate:
    """The candidate with the contacts of its companions changed."""
    return replace(candidate, companions=tuple(replace(c, tool=changed(c.tool)) for c in candidate.companions))
