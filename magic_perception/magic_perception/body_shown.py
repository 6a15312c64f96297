"""Where a round body shows through its handle: pixels that look as the body would there.

Before its body depth fills the hole of a handle, and the mask says nothing of it; the picture shows it.  What diffuse light makes of a
surface depends on the direction of that, through a few numbers alone (Ramamoorthi and Hanrahan 2001, "An efficient representation for
irradiance environment maps").  How a body of revolution would look behind its handle is therefore known from how it looks beside it.  A
bar, which is turned another way, looks otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.rendering import Raycaster
from magic_perception import primitives
from magic_perception.body import Body
from magic_perception.sight import Sight
from magic_perception.smear import REACH

#: A pixel looks as the body where each channel is off by no more than so many deviations of the body's own pixels, or so much, of 255.
DEVIATIONS, LEAST = 3.5, 4.0
#: From fewer pixels of its own, or of a body as uneven as this, of 255 (one that is printed on), it is not known how it looks.
ENOUGH, UNEVEN = 150, 8.0
#: The look is a sum, in the logarithm of the colour above so much of 255, of so many waves around the body and of its levels, about so far
#: apart, m: what a level is painted or tilted in takes its share of the light all around.
DARK, WAVES, LEVEL = 8.0, 3, 0.012
#: How stiff it is against waves, by the square of their number, and against bends from level to level.
CALM, EVEN = 1e-4, 1e-3
#: The look is known beside pixels that have it, this many pixels on, and then anew from there, so many times at most.
ON, TIMES = 2, 12
#: So many pixels of a patch tell something of it, and of the bar beside it.
TELLING, BESIDE = 12, 4
#: A bar beside a patch is off by so many times what a pixel may be in this share of its pixels: there is an edge, where a face that has the
#: body's look by chance goes over into it.
EDGE, ALONG = 2.0, 0.7


@dataclass(frozen=True)
class _Alone:
    """A body alone in the window of a picture that holds its thing's mask: rays (h, w, 3) of depth 1; depth (h, w) at which they meet the
    body, m, infinite where they do not; outside (h, w): where that is its outside; turn and level (h, w): where on it, radians around and
    0..1 up."""

    window: tuple[slice, slice]
    rays: NDArray[np.float64]
    depth: NDArray[np.float64]
    outside: NDArray[np.bool_]
    turn: NDArray[np.float64]
    level: NDArray[np.float64]


def _alone(sight: Sight, body: Body) -> _Alone:
    x, y, w, h = cv2.boundingRect(sight.mask.view(np.uint8))
    k = sight.intrinsics
    u, v = np.meshgrid(np.arange(x, x + w), np.arange(y, y + h))
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1) @ sight.table_from_camera[:3, :3].T
    length = np.linalg.norm(rays, axis=-1)
    solid = Raycaster([primitives.revolve(body.profile, body.axis, 96)])
    depth = solid.cast(np.broadcast_to(sight.eye, rays.shape), rays / length[..., None]).distance.astype(float) / length
    met = np.isfinite(depth)
    places = sight.eye + rays * np.where(met, depth, 0.0)[..., None]
    away, z, top = places[..., :2] - body.axis, places[..., 2], float(body.profile[-1, 1])
    # The top disc of an open body is no surface, and its rim is one of its own.
    outside = met & (np.linalg.norm(away, axis=-1) > 0.97 * body.radius(z)) & (z < top - 0.003)
    window = (slice(y, y + h), slice(x, x + w))
    return _Alone(window, rays, depth, outside, np.arctan2(away[..., 1], away[..., 0]), np.clip(z / top, 0.0, 1.0))


def _unlike(
    alone: _Alone, color: NDArray[np.float32], own: NDArray[np.bool_], may_be: NDArray[np.bool_], height: float
) -> NDArray[np.float64] | None:
    """(h, w): how far pixels are from the body's look, as a share of what they may be; ``None`` where that is not known.

    color (h, w, 3); own (h, w): pixels that are the body's; may_be: those that may be, through which what is known of it goes on; height of
    the body, m.
    """
    levels = max(3, round(height / LEVEL))
    waves = [wave(n * alone.turn) for n in range(1, WAVES + 1) for wave in (np.cos, np.sin)]
    hats = np.maximum(0.0, 1.0 - np.abs(alone.level[..., None] * (levels - 1) - np.arange(levels)))
    basis = np.concatenate([np.stack(waves, axis=-1), hats], axis=-1)
    bends = np.diff(np.eye(levels), 2, axis=0)
    stiff = np.zeros((basis.shape[-1],) * 2)
    stiff[: 2 * WAVES, : 2 * WAVES] = CALM * np.diag(np.repeat(np.arange(1.0, WAVES + 1) ** 2, 2))
    stiff[2 * WAVES :, 2 * WAVES :] = EVEN * bends.T @ bends + 1e-6 * np.eye(levels)
    bright, around = color + DARK, np.ones((2 * ON + 1,) * 2, np.uint8)
    log, found = np.log(bright), None
    for _ in range(TIMES):
        look = _look_of(basis[own], log[own], bright[own], stiff)
        if look is None:
            break
        found = look
        more = (cv2.dilate(own.view(np.uint8), around) > 0) & may_be & ~own
        more[more] = _off(basis[more], bright[more], *look) < 1
        if not more.any():
            break
        own = own | more
    return None if found is None else _off(basis, bright, *found)


def _look_of(
    basis: NDArray[np.float64], log: NDArray[np.float32], bright: NDArray[np.float32], stiff: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The look (B, 3) of pixels by their waves and levels (N, B), with what each channel is off by (3,).

    ``None`` where they are too few or too uneven.
    bright (N, 3): their colour above :data:`DARK`; log: of that; stiff (B, B).
    """
    keep = np.ones(len(basis), bool)
    for _ in range(3):
        if np.count_nonzero(keep) < ENOUGH:
            return None
        kept = basis[keep]
        model = np.linalg.solve(kept.T @ kept + len(basis) * stiff, kept.T @ log[keep])
        off = np.abs(bright - np.exp(basis @ model))
        sigma = 1.48 * np.median(off, axis=0)
        keep = (off < np.maximum(2.5 * sigma, 1.0)).all(axis=1)
    return None if sigma.max() > UNEVEN else (model, sigma)


def _off(
    basis: NDArray[np.float64], bright: NDArray[np.float32], model: NDArray[np.float64], sigma: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far pixels (...) are from a look, as a share of what they may be; arguments as :func:`_look_of` has them."""
    return (np.abs(bright - np.exp(basis @ model)) / np.maximum(DEVIATIONS * sigma, LEAST)).max(axis=-1)


def body_shown(
    sight: Sight, body: Body, place: NDArray[np.float64], across: NDArray[np.float64], handle: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Pixels (H, W) at which a body shows through its handle, and those of which it is known whether it does; ``None`` where it is not
    known how it looks.

    place, across (3,): a point of the handle's plane, and its normal; handle (H, W): where the handle may be.
    """
    alone = _alone(sight, body)
    window = alone.window
    mask, may = sight.mask[window], handle[window]
    # Pixels at an outline are of two things.
    inner = cv2.erode((alone.outside & mask & ~sight.hidden[window]).view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
    unlike = _unlike(alone, sight.color[window].astype(np.float32), inner & ~may, inner, float(body.profile[-1, 1]))
    if unlike is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = ((place - sight.eye) @ across) / (alone.rays @ across)
        told = alone.outside & (plane > 0) & (plane < alone.depth - 0.002)
    shown = told & (unlike < 1)
    # Between what is the body's and what is beside the thing lies the body's outline, a pixel or two of both.
    closed = cv2.morphologyEx((shown | ~mask).view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    shown |= closed & (cv2.dilate(shown.view(np.uint8), np.ones((5, 5), np.uint8)) > 0) & mask
    shown &= ~_doubtful(sight, alone, plane, shown, told, unlike)
    pictures = []
    for part in (shown, told):
        picture = np.zeros(sight.mask.shape, bool)
        picture[window] = part
        pictures.append(picture)
    return pictures[0], pictures[1]


def _doubtful(
    sight: Sight,
    alone: _Alone,
    plane: NDArray[np.float64],
    shown: NDArray[np.bool_],
    told: NDArray[np.bool_],
    unlike: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Patches (h, w) of what looks as the body that may be a fin's: small ones, those without an edge to the bar beside them, and those
    where depth, farther from all else than it is carried, lies at the handle."""
    reach = max(3, round(REACH * sight.intrinsics.fx / 615))
    bars = told & ~shown
    deep = shown & (cv2.dilate(bars.view(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) == 0) & np.isfinite(sight.depth[alone.window])
    with np.errstate(invalid="ignore"):
        near = sight.depth[alone.window] < (plane + alone.depth) / 2
    result = np.zeros_like(shown)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(shown.view(np.uint8), connectivity=4)
    for number in range(1, count):
        part = parts == number
        # A pixel at the edge is of both.
        one, three = (cv2.dilate(part.view(np.uint8), np.ones((size, size), np.uint8)) > 0 for size in (3, 7))
        beside, tells = bars & three & ~one, deep & part
        blurred = np.count_nonzero(beside) >= BESIDE and float(np.mean(unlike[beside] > EDGE)) < ALONG
        filled = np.count_nonzero(tells) >= TELLING and float(near[tells].mean()) > 0.5
        if stats[number, cv2.CC_STAT_AREA] < TELLING or blurred or filled:
            result |= part
    return result
