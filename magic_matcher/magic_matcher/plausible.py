"""Which places can stand in for the demonstrated contact at all.

The best place on a thing that cannot do the job is a place, too.  Four demands are read off the reference contact, and none
of them is written for a task:

* *sign*: concave for concave, convex for convex (where the reference is straight, either);
* *room*: the target, a disc of its radius at p_O, gets at least as near to touching the place squarely as one radius, or half as
  far again as at the reference: an inscribed circle that is too small, a mouth that is too narrow keep it out;
* *hollow*: a reference in whose hollow the target lies asks for a hollow as the target feels it: :data:`HOLLOW` radii deep on its
  shallower side, or half as deep as the reference's if that is less.  The waves of an edge and a wide bend are none;
* *likeness*: s_dino at least the backend's floor, where it has one.

Room and hollow need the target's radius, and are not asked where the reference is convex, where the target lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_matcher import enclosing, holding
from magic_matcher.contour import Contour
from magic_matcher.global_stage import Reference

#: How far from touching squarely, in its radii, a disc may have to stay: 0.41 in a right angle, 1 in one of 60 degrees.
GAP, GAP_SHARE = 1.0, 1.5
#: Depth of a hollow that counts, in radii, and as a share of the reference's.  Fitted together with the floor (docs/features.md).
HOLLOW, HOLLOW_SHARE = 0.2, 0.5
#: What will do, as shares of the hollow and of the likeness that are asked for, where a tool has few places that show all of them and a
#: simulation judges what is tried.  Dragged over a table at a friction of 0.3 a disc climbs a millimetre by a speed of 0.08 m/s: most
#: corners that are half as deep hold it, but not surely all.  Likeness is there to choose among places; whether one can do the job its room
#: and hollow say better.
SHALLOW, UNLIKE = 0.5, 0.8


@dataclass(frozen=True)
class Demands:
    """What a place must show.  concave: its sign, ``None``: either; floor: of s_dino; gap (at most) and hollow (at least) in radii of the
    target, ``None`` where they are not asked; loop: the reference lies in a loop (:mod:`magic_matcher.enclosing`); hangs: the tool is let
    go there;
    straight: it is led along the contact's normal."""

    concave: bool | None
    floor: float
    gap: float | None
    hollow: float | None
    loop: bool = False
    hangs: bool = False
    straight: bool = True


@dataclass(frozen=True)
class Refusal:
    """Why a place is none: what was looked at, its value, what is allowed, and the similarity of the place."""

    what: str
    value: str
    allowed: str
    similarity: float


def demands(reference: Reference, floor: float) -> Demands:
    """What the reference contact asks of others."""
    concave = reference.concave if np.isfinite(reference.radius) else None
    loop = reference.concave and enclosing.asked(reference.contour, reference.pixel, reference.normal, reference.radius)
    if not reference.concave or reference.target_radius is None or not np.isfinite(reference.target_radius):
        return Demands(concave, floor, None, None, loop, reference.let_go, reference.straight)
    held = holding.hold(reference.contour, reference.pixel[None], reference.normal[None], reference.target_radius)
    gap = float(held.gap[0])
    depth = HOLLOW_SHARE * float(held.press[0, 0])
    room, hollow = max(GAP, GAP_SHARE * gap) if np.isfinite(gap) else None, min(HOLLOW, depth) if depth > 0 else None
    return Demands(concave, floor, room, hollow, loop, reference.let_go, reference.straight)


def lesser(asked: Demands) -> Demands:
    """The same demands with :data:`SHALLOW` of the hollow and :data:`UNLIKE` of the likeness."""
    return replace(asked, floor=UNLIKE * asked.floor, hollow=None if asked.hollow is None else SHALLOW * asked.hollow)


def room_for(asked: Demands, contour: Contour, radius: float | None) -> holding.Room | None:
    """The room for a target of a radius (px) about a tool, ``None`` where it is not asked for."""
    return None if radius is None or (asked.gap is None and asked.hollow is None) else holding.room(contour, radius)


def refusals(
    asked: Demands,
    contour: Contour,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    concave: NDArray[np.bool_],
    similarity: NDArray[np.float64],
    radius: float | None,
    metres_per_pixel: float,
    around: holding.Room | None = None,
) -> list[Refusal | None]:
    """For each of the places (N, 2) with outward normals why it is refused, ``None`` where it is not; radius of the target, px; around:
    what :func:`room_for` gives, where that is known."""
    held = None
    around = room_for(asked, contour, radius) if around is None else around
    if radius is not None and around is not None and len(points):
        held = holding.hold(contour, points, normals, radius, around)
    result: list[Refusal | None] = []
    for i, likeness in enumerate(similarity):
        found = None
        if asked.concave is not None and bool(concave[i]) != asked.concave:
            names = ("convex", "concave")
            found = ("sign of the curvature", names[bool(concave[i])], f"{names[asked.concave]}, as demonstrated")
        elif held is not None and asked.gap is not None and not held.gap[i] <= asked.gap:
            room, size = free_radius(around, points[i], normals[i], radius) * metres_per_pixel, radius * metres_per_pixel
            if room < size:
                found = ("radius of the free room", f"{1000 * room:.1f} mm", f"at least {1000 * size:.1f} mm, the target's")
            else:
                away = f"{1000 * size * float(held.gap[i]):.1f} mm" if np.isfinite(held.gap[i]) else "the target has no room"
                found = ("distance that the target has to keep", away, f"at most {1000 * size * asked.gap:.1f} mm")
        elif held is not None and asked.hollow is not None and not held.press[i, 0] >= asked.hollow:
            size = 1000 * radius * metres_per_pixel
            found = ("depth of the hollow", f"{size * held.press[i, 0]:.1f} mm", f"at least {size * asked.hollow:.1f} mm for this target")
        elif not likeness >= asked.floor:
            found = ("similarity to the demonstrated contact", f"{likeness:.3f}", f"at least {asked.floor:.2f}")
        result.append(None if found is None else Refusal(*found, float(likeness)))
    return result


def free_radius(around: holding.Room, point: NDArray[np.float64], normal: NDArray[np.float64], radius: float) -> float:
    """Radius, px, of the largest disc that has room with its centre before a contact, up to the next edge or two of ``radius`` px away."""
    steps = np.arange(1.0, max(2 * radius, 3.0), 0.5)
    free = around.at(point + steps[:, None] * normal)
    closed = np.flatnonzero((free < 0.5) & (steps > 2.0))
    return max(float(free[: closed[0] if len(closed) else None].max()) - 0.5, 0.0)
