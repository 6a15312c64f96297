"""Handles of round bodies: bars in an upright plane through the body's axis, carved by masks, depth, and where the body shows through."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_perception import clusters, polygons
from magic_perception.body import Body
from magic_perception.body_shown import body_shown
from magic_perception.sight import Sight, carve

#: Edge of a cell of a handle's plane, m; cameras see it where they look at it no more askew than this cosine.
CELL, SQUARELY = 0.001, 0.25
#: Pixels around a round body within which a mask may be the body's own.
EDGE = 3
#: The largest width of a handle's bar, or of bar and hole where no camera sees through that, m: what is wider is a part of another form.
#: (Handles of made mugs stand off by 28 to 48 mm.)
BAR = 0.05
#: The least hole between a handle and its body, m^2.
HOLE = 6e-5
#: A handle's bow is what stands off from the body farther than this share of how far it stands off at most; of nine made mugs the surface
#: is as near with 0.4, without it up to 5 mm farther off.
BOW = 0.2
#: A handle is no thicker than this, m; points lie about its plane with a deviation of so much.
THICKEST, ABOUT = 0.03, 0.006
#: Clusters of points beyond a body within this angle (rad) of the largest one are of the same handle.
APART = 0.44


@dataclass(frozen=True)
class Handle:
    """Bars beside a round body: their meshes and convex pieces, and the largest hole that they enclose with the body, m^2."""

    bars: list[Mesh]
    pieces: list[Mesh]
    hole: float


@dataclass(frozen=True)
class _Plane:
    """The upright plane of a handle, which holds the body's axis, in cells of :data:`CELL`.

    base (3,): where the axis meets the table; out, up, across (3,): unit vectors away from the axis, upwards, and along the normal; start:
    distance of the first column of cells from the axis, m; s, z (Z, S): distances of the cells from the axis, and their heights, m.
    """

    base: NDArray[np.float64]
    out: NDArray[np.float64]
    up: NDArray[np.float64]
    across: NDArray[np.float64]
    start: float
    s: NDArray[np.float64]
    z: NDArray[np.float64]

    @classmethod
    def through(cls, points: NDArray[np.float64], along: NDArray[np.float64], body: Body) -> _Plane:
        """The plane in the direction ``along`` (2,) from a body's axis, as large as a handle with these points (N, 3) may be."""
        out, up = np.array([*along, 0.0]), np.array([0.0, 0.0, 1.0])
        start = float(body.profile[:, 0].min()) - 0.004
        top = float(max(body.profile[-1, 1], np.percentile(points[:, 2], 99))) + 0.004
        # Farther out than its points: depth may have lost its bow.
        end = float(np.percentile((points[:, :2] - body.axis) @ along, 99.5)) + 0.025
        s, z = np.meshgrid(np.arange(start, end, CELL), np.arange(0.0, top, CELL))
        return cls(np.array([*body.axis, 0.0]), out, up, np.cross(out, up), start, s, z)

    @cached_property
    def places(self) -> NDArray[np.float64]:
        """(Z, S, 3): where the cells are."""
        return self.base + self.s[..., None] * self.out + self.z[..., None] * self.up

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """(3,)."""
        return self.places.mean(axis=(0, 1))

    def facing(self, sight: Sight) -> float:
        """How squarely a camera looks at the plane: the cosine of the angle from its normal."""
        return abs(float((self.middle - sight.eye) @ self.across)) / np.linalg.norm(self.middle - sight.eye)

    def cells_of(self, points: NDArray[np.float64]) -> NDArray[np.uint8]:
        """(Z, S): 1 where points (N, 3) fall."""
        cells = np.zeros(self.s.shape, np.uint8)
        column = np.round(((points[:, :2] - self.base[:2]) @ self.out[:2] - self.start) / CELL).astype(int)
        row = np.round(points[:, 2] / CELL).astype(int)
        good = (column >= 0) & (column < cells.shape[1]) & (row >= 0) & (row < cells.shape[0])
        cells[row[good], column[good]] = 1
        return cells

    def seen(self, sight: Sight, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(Z, S): the cells that a camera sees in a mask (H, W) of its picture."""
        return sight.look_up(self.places, mask.astype(np.float32)) > 0.5


def handle_of(sights: list[Sight], out: NDArray[np.float64], body: Body) -> Handle | None:
    """A handle as bars in the upright plane through the body's axis, from points (N, 3) beyond the body; ``None`` if nothing is left after
    carving."""
    local = out[:, :2] - body.axis
    along, thickness = _handle_plane(local, np.linalg.norm(local, axis=1) - body.radius(out[:, 2]))
    plane = _Plane.through(out, along, body)
    points = plane.cells_of(out)
    near = cv2.dilate(points, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13))) > 0
    covered = np.zeros(near.shape, bool)
    useful = [sight for sight in sights if plane.facing(sight) > SQUARELY]
    if useful:
        # Where depth lost a thin bar, the mask beside the body's outline is the handle's.
        drawn = [_drawn(sight, body) for sight in useful]
        beside = [sight.mask & ~_wider(there, EDGE) for sight, there in zip(useful, drawn, strict=True)]
        thickness = min([thickness, *(_widest(sight, mask, plane.middle) for sight, mask in zip(useful, beside, strict=True))])
        seen = [plane.seen(sight, mask) for sight, mask in zip(useful, beside, strict=True)]
        near |= clusters.connected(near | np.any(seen, axis=0), near, 8)
        field = _carved(plane, _beside(useful, drawn), thickness)
        covered = _covered(plane, useful, drawn, body, field)
    else:
        field = cv2.morphologyEx(points, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))).astype(np.float32)
    solid = _bars(field > 0.5, near, covered, plane, body)
    if not useful:
        # No camera looks through it: what is missing between points is no hole.
        solid |= _enclosed(plane, solid, body).view(np.uint8)
    else:
        # Where the body shows through its handle, what is left of the mask there are the handle's bars.
        field = _carved(plane, _without_body(plane, useful, drawn, near, body), thickness)
        opened = _without_specks(_bars(field > 0.5, near, covered, plane, body, to_the_body=True))
        if _largest_hole(plane, opened, body) > max(HOLE, _largest_hole(plane, solid, body)):
            solid = opened
    if 2 * CELL * float(cv2.distanceTransform(solid, cv2.DIST_L2, 5).max()) > BAR:
        return None
    outlines = polygons.outline(polygons.smooth_field(solid > 0, 1.2), np.array([plane.start, 0.0]), CELL, simplify=0.0004)
    # Only what reaches farther out than noise is a handle.
    parts = [p for p in outlines if p.area > 3e-5 and p.bounds[2] - float(body.radius(np.array((p.bounds[1] + p.bounds[3]) / 2))) > 0.008]
    if not parts:
        return None
    frame = transforms.make(np.column_stack([plane.out, plane.up, plane.across]), plane.base)
    low, high = -thickness / 2, thickness / 2
    rings = [ring for p in parts for ring in polygons.convex_parts(p.simplify(0.0006), 0.0005)]
    return Handle(
        [polygons.extrude(p, low, high).transformed(frame) for p in parts],
        [polygons.prism(ring, low, high).transformed(frame) for ring in rings],
        _largest_hole(plane, solid, body),
    )


def _beside(sights: list[Sight], drawn: list[NDArray[np.bool_]]) -> list[Sight]:
    """The sights as they tell of a handle: where a camera has the body in its picture, drawn (H, W), its mask says nothing of that."""
    return [replace(sight, hidden=sight.hidden | there) for sight, there in zip(sights, drawn, strict=True)]


def _without_body(plane: _Plane, sights: list[Sight], drawn: list[NDArray[np.bool_]], near: NDArray[np.bool_], body: Body) -> list[Sight]:
    """As :func:`_beside`, but a camera to which it is known how the body looks tells of the handle before it as well.

    near (Z, S): cells that may be the handle's.
    """
    result = []
    for sight, there, plain in zip(sights, drawn, _beside(sights, drawn), strict=True):
        pixels = np.round(sight.pixels(plane.places[near])).astype(int)
        within = (pixels >= 0).all(axis=1) & (pixels < sight.mask.shape[::-1]).all(axis=1)
        may = np.zeros(sight.mask.shape, bool)
        may[pixels[within, 1], pixels[within, 0]] = True
        found = body_shown(sight, body, plane.base, plane.across, _wider(may, EDGE))
        if found is None:
            result.append(plain)
        else:
            shown, told = found
            result.append(replace(sight, mask=sight.mask & ~shown, hidden=sight.hidden | (there & ~told)))
    return result


def _carved(plane: _Plane, told: list[Sight], thickness: float) -> NDArray[np.float32]:
    """(Z, S) 0..1: how solid the cells are by what masks and depths are ``told`` to say of the handle; thickness: of the handle, m."""
    # Half of the thickness, so that a few degrees of error in the plane do not eat thin bars.
    columns = [plane.places + n * plane.across for n in np.linspace(-thickness / 4, thickness / 4, 3)]
    # Of a bar no wider than the smear of depth a measurement a little behind it says nothing: only one far behind shows a hole.
    return carve(told, columns, max(0.04, 1.5 * thickness), [plane.facing(sight) ** 2 for sight in told])


def _covered(
    plane: _Plane, sights: list[Sight], drawn: list[NDArray[np.bool_]], body: Body, field: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(Z, S): the cells that are behind the body for all cameras; drawn (H, W) of each camera: where it sees the body; field: as
    :func:`_carved` has it."""
    # Before the body depth sees the handle, behind it nothing does; at the body's edge a mask may be the body's.
    behind = [bool((sight.eye[:2] - body.axis) @ plane.out[:2] < 0) for sight in sights]

    def behind_for_all(masks: list[NDArray[np.bool_]]) -> NDArray[np.bool_]:
        return np.all([plane.seen(sight, mask) & far for sight, mask, far in zip(sights, masks, behind, strict=True)], axis=0)

    return behind_for_all(drawn) | (behind_for_all([_wider(there, EDGE) for there in drawn]) & (field > 0.5))


def _without_specks(solid: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Cells (Z, S) with what they enclose filled where that is no hole, but a few pixels that look as the body by chance."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats((solid == 0).view(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < HOLE / CELL**2
    small[0] = False
    return solid | small[parts].view(np.uint8)


def _enclosed(plane: _Plane, solid: NDArray[np.uint8], body: Body) -> NDArray[np.bool_]:
    """The cells (Z, S) that a handle's cells (Z, S) enclose with the body."""
    filled = (solid > 0) | ((plane.s < body.radius(plane.z)) & (plane.z < body.profile[-1, 1]))
    _, holes = cv2.connectedComponents(np.pad(~filled, 1, constant_values=True).view(np.uint8), connectivity=4)
    return ~filled & (holes != holes[0, 0])[1:-1, 1:-1]


def _largest_hole(plane: _Plane, solid: NDArray[np.uint8], body: Body) -> float:
    """The largest area, m^2, that a handle's cells (Z, S) enclose with the body."""
    stats = cv2.connectedComponentsWithStats(_enclosed(plane, solid, body).view(np.uint8), connectivity=4)[2]
    return float(stats[1:, cv2.CC_STAT_AREA].max(initial=0)) * CELL**2


def standing_off(out: NDArray[np.float64], body: Body) -> NDArray[np.float64]:
    """Of the points (N, 3) beyond the body the largest cluster, and the others in its direction, to :data:`APART` radians: a handle that
    depth tore."""
    labels = clusters.cluster(out, 0.012, 4, 0.003)
    if labels.max(initial=-1) < 0:
        return out
    sizes = np.bincount(labels[labels >= 0])
    middles = np.array([out[labels == i, :2].mean(axis=0) - body.axis for i in range(len(sizes))])
    angles = np.arctan2(middles[:, 1], middles[:, 0])
    off = np.abs((angles - angles[np.argmax(sizes)] + np.pi) % (2 * np.pi) - np.pi)
    return out[np.isin(labels, np.flatnonzero((off < APART) & (sizes >= 8)))]


def _drawn(sight: Sight, body: Body) -> NDArray[np.bool_]:
    """Where the round body is in a camera's picture (H, W)."""
    turns = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    radius, z = body.profile.T
    rings = np.stack(
        [
            body.axis[0] + radius[:, None] * np.cos(turns),
            body.axis[1] + radius[:, None] * np.sin(turns),
            np.broadcast_to(z[:, None], (len(z), 32)),
        ],
        axis=-1,
    )
    drawn = np.zeros(sight.mask.shape, np.uint8)
    for low, high in itertools.pairwise(sight.pixels(rings)):
        cv2.fillConvexPoly(drawn, cv2.convexHull(np.concatenate([low, high])).round().astype(np.int32), 1)
    return drawn > 0


def _wider(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    return cv2.dilate(mask.view(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0


def _widest(sight: Sight, mask: NDArray[np.bool_], place: NDArray[np.float64]) -> float:
    """How wide a handle's bar is at its widest in a mask, metres at the handle's place (3,), and no less than 5 mm; a bar is about as
    thick."""
    if not mask.any():
        return float("inf")
    distance = cv2.distanceTransform(mask.view(np.uint8), cv2.DIST_L2, 5)
    away = float(np.linalg.norm(place - sight.eye))
    return max(2 * float(distance.max()) * away / sight.intrinsics.fx, 0.005)


def _handle_plane(local: NDArray[np.float64], beyond: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Direction (2,) from the axis in which a handle's points (N, 2) stand off, seen from above, and its thickness in metres; beyond (N,):
    how far they are outside of the body.

    What stands off farthest tells it: near the body there is smear as well, and what of the body is not quite round.
    """
    far = beyond > BOW * np.percentile(beyond, 95)
    local, weight = local[far], beyond[far]
    # The direction about which most of it lies: smear beside a handle would draw a mean to itself.
    turns = np.radians(np.arange(360))
    out, across = (np.stack([np.cos(turns + quarter), np.sin(turns + quarter)]) for quarter in (0.0, np.pi / 2))
    beside = np.exp(-0.5 * (local @ across / ABOUT) ** 2) * (local @ out > 0)
    angle = float(turns[np.argmax(weight @ beside)])
    low, high = -THICKEST / 2, THICKEST / 2
    for _ in range(3):
        along = np.array([np.cos(angle), np.sin(angle)])
        aside = local @ np.array([-along[1], along[0]])
        own = np.abs(aside) < THICKEST / 2
        low, high = np.percentile(aside[own], [4, 96])
        angle += float(np.arctan2((low + high) / 2, np.median((local @ along)[own])))
    return np.array([np.cos(angle), np.sin(angle)]), float(np.clip(high - low, 0.005, THICKEST))


def _bars(
    seen: NDArray[np.bool_], near: NDArray[np.bool_], covered: NDArray[np.bool_], plane: _Plane, body: Body, to_the_body: bool = False
) -> NDArray[np.uint8]:
    """The handle's cells in its plane: what was ``seen`` solid ``near`` its points, joined to the body.

    All (Z, S); covered: behind the body for all cameras; to_the_body: what ends close to the body goes on to it also unseen, as where the
    body's look tells, pixels of its outline are of both.
    """
    radius = body.radius(plane.z)
    within = plane.s < radius
    attach = within & (plane.s > radius - 0.0025) & (plane.z < body.profile[-1, 1])
    solid = seen & near & ~within & ~covered
    # What goes out of sight behind the body goes on to it, level by level, and so does a hole.
    known = ~covered & ~within
    first = known.argmax(axis=1)
    on = solid[np.arange(len(solid)), first] & known.any(axis=1)
    solid |= on[:, None] & covered & ~within & (np.arange(solid.shape[1]) < first[:, None])
    # Where the bar meets the body its points are few: join them over 5 mm.
    reachable = (cv2.dilate(attach.astype(np.uint8), np.ones((1, 11), np.uint8)) > 0) & ~within
    solid |= reachable & seen & (cv2.dilate(solid.astype(np.uint8), np.ones((5, 11), np.uint8)) > 0)
    if to_the_body:
        solid |= reachable & (cv2.dilate(solid.astype(np.uint8), np.ones((1, 11), np.uint8)) > 0)
    solid |= attach & (cv2.dilate(solid.astype(np.uint8), np.ones((3, 7), np.uint8)) > 0)
    return cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
