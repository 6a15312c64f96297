"""A bowl at the end of a handle, lying on its back: spoons, ladles, measuring cups.

Cameras look into the bowl from one side, so that its near wall hides a part of the hollow and its far wall the outside behind it.  What
they tell together is a rim, an ellipse in its own plane, and a profile: how deep the hollow is at a share of the way from its middle to the
rim, the same all around.  Both are fitted to the depth seen inside and to the masks' edges at the rim; the hollow then goes on, out of sight,
as it was seen.  How thick the wall is, the floor tells, which rests on the table.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from shapely.geometry import Polygon

from magic_core import transforms
from magic_core.mesh import Mesh, concatenate
from magic_perception.lying import Laid, relief, relief_pieces
from magic_perception.parameters import Parameters
from magic_perception.polygons import parts_of
from magic_perception.sight import Sight, surfaces
from magic_perception.solids import Reconstruction, hull_of
from magic_perception.turned import EDGE_STEP, crossing

#: Shares of the way from a bowl's middle to its rim at which its depth is told.
RINGS = np.array([0.0, 0.35, 0.6, 0.8, 0.92, 0.98, 1.0])
#: Largest and smallest half axis of a rim, m; least depth, m; a rim's longer half axis over its shorter.
HALF, SHALLOW, LONG = (0.015, 0.10), 0.006, 2.2
#: A rim leans by no more than this (tangent): a ladle that lies on bowl and handle leans by 40 degrees, one whose stem has rolled aside by 55.
STEEPEST = 1.5
#: A wall is at least and at most so thick, m.
WALLS = (0.0015, 0.006)
#: How far from the fitted rim a mask's edge is looked for, m; rim directions that face a camera less than this cosine show it against the table.
REACH, ASIDE = 0.010, 0.3
#: So far stereo carries the depth of a rim on to what is seen past it, m.
CARRIED = 0.008
#: Four fifths of the points seen inside are this near to the fitted hollow, m, or 2.5 times the noise of heights.
NEAR = 0.003
#: And all but a twentieth within so many times that; of what is seen within this share of the rim no more than that share stands above it.
FAR, WITHIN, STANDING = 2.5, 0.85, 0.05
#: A twentieth at least of what is seen inside is nearer to the middle than this share of the rim: from its steep side alone nobody tells how deep a hollow is.
#: Of ten fitted hollows of made tools it was 0.24 to 0.46 for the eight that were right to 2 mm, 0.75 and 0.89 for two that were off by 4 and 5 mm.
FLOOR = 0.6
#: What sticks out of a handle's side is a part of it where it is wider than this share of the handle's mean width.
WHISKER = 0.6
_SECTORS, _PIECES = 48, 16
#: Pieces follow a bowl's profile to this, m.
FOLLOWED = 0.0015


@dataclass(frozen=True)
class Bowl:
    """table_from_bowl (4, 4): from the frame in the middle of the rim, z out of the opening, x towards the handle; half (2,): half axes along x and y of
    the hollow at its rim, m; depths (K,): of the hollow at :data:`RINGS`, m, the last 0; wall: its thickness, m."""

    table_from_bowl: NDArray[np.float64]
    half: NDArray[np.float64]
    depths: NDArray[np.float64]
    wall: float

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 3) of the table frame in the bowl's own."""
        return (points - self.table_from_bowl[:3, 3]) @ self.table_from_bowl[:3, :3]

    def rim(self, grow: float, count: int = 64) -> NDArray[np.float64]:
        """(count, 3): the rim, ``grow`` metres wider than the hollow, in the table frame."""
        angle = np.arange(count) * 2 * np.pi / count
        ring = np.column_stack([(self.half[0] + grow) * np.cos(angle), (self.half[1] + grow) * np.sin(angle), 0 * angle])
        return transforms.apply(self.table_from_bowl, ring)

    def surface(self, shares: NDArray[np.float64], count: int, grow: float) -> NDArray[np.float64]:
        """(S, count, 3): the hollow at ``shares`` (S,) of the way to its rim, or the outside ``grow`` metres beyond it; table frame."""
        depth = np.interp(shares, RINGS, self.depths)
        mean = float(self.half.mean())
        # The normal in the plane of the profile, out of the hollow.
        slope = np.gradient(np.interp(np.linspace(0, 1, 101), RINGS, self.depths), 0.01 * mean)
        slope = np.interp(shares, np.linspace(0, 1, 101), slope)
        out, down = -slope / np.hypot(1, slope), 1 / np.hypot(1, slope)
        angle = np.arange(count) * 2 * np.pi / count
        x, y = ((half * shares + grow * out)[:, None] * turn for half, turn in zip(self.half, (np.cos(angle), np.sin(angle)), strict=True))
        z = np.minimum(-(depth + grow * down), 0.0)[:, None]
        return transforms.apply(self.table_from_bowl, np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1))


def build_scoop(laid: Laid, sights: list[Sight], noise: float, parameters: Parameters) -> Reconstruction | None:
    """The bowl and its handle; ``None`` where the lying thing is none, or no bowl can be told of it."""
    if laid.flat:
        return None
    bowl = fit_bowl(laid, sights, noise, parameters)
    if bowl is None:
        return None
    handles = _handles(laid, bowl)
    if not handles:
        return None
    mesh, pieces = bowl_solid(bowl)
    bars = []
    for part in handles:
        bars.append(relief(part, laid.grid, laid.top, laid.bottom))
        pieces += relief_pieces(part, laid.grid, laid.top, laid.bottom)
    try:
        import trimesh

        joined = trimesh.boolean.union([mesh.to_trimesh(), *[bar.to_trimesh() for bar in bars]], engine="manifold")
        mesh = Mesh(joined.vertices, joined.faces)
    except Exception:  # the boolean library refuses a degenerate solid: overlapping closed parts still bound the same solid
        mesh = concatenate([mesh, *bars])
    return Reconstruction(mesh, tuple(pieces), "scoop")


def _handles(laid: Laid, bowl: Bowl) -> list[Polygon]:
    """What goes on beyond the rim, each part up to the hollow."""
    hollow, outside = (Polygon(bowl.rim(grow)[:, :2]) for grow in (0.0, bowl.wall + 0.006))
    found = []
    for part in laid.parts:
        for beyond in parts_of(part.difference(outside)):
            if beyond.area < 1e-4:
                continue
            beyond = _without_whiskers(beyond)
            neck = part.intersection(beyond.buffer(0.009, join_style="mitre")).difference(hollow)
            found += parts_of(shapely.union_all([beyond, neck]))[:1]
    return found


def _without_whiskers(handle: Polygon) -> Polygon:
    """A handle without what sticks out of its sides and is much narrower than it: smear that has the thing's colour.

    The bar about the hole that it hangs by is as narrow, but sticks out of nothing: the outline tells what does.
    """
    outline = Polygon(handle.exterior)
    ring = np.asarray(handle.minimum_rotated_rectangle.exterior.coords)
    length = float(np.linalg.norm(np.diff(ring[:3], axis=0), axis=1).max())
    narrow = WHISKER * outline.area / max(length, 1e-6) / 2
    left = parts_of(outline.buffer(-narrow).buffer(narrow))
    return parts_of(left[0].intersection(handle))[0] if left and left[0].area > 0.8 * outline.area else handle


def fit_bowl(laid: Laid, sights: list[Sight], noise: float, parameters: Parameters) -> Bowl | None:
    """The bowl of a lying thing; ``None`` where what was seen is no hollow within an elliptic rim."""
    from scipy.optimize import least_squares

    bowl = _first(laid, parameters.wall)
    if bowl is None:
        return None
    points, eyes = surfaces(sights)
    for _ in range(3):
        ring = _rim_points(laid, bowl)
        inside = _seen_inside(bowl, points, eyes)
        if np.count_nonzero(inside) < 60:
            return None
        chosen = points[inside]
        chosen = chosen[:: max(1, len(chosen) // 250)]
        edges = _edges(bowl, sights)
        if sum(len(edge[1]) for edge in edges) < 12 or len(ring) < 8:
            return None
        base = bowl.table_from_bowl
        towards = base[:2, 0] / max(float(np.linalg.norm(base[:2, 0])), 1e-9)
        share = np.sqrt(len(chosen) / max(sum(len(edge[1]) for edge in edges), 1))

        def of(values: NDArray[np.float64], towards: NDArray[np.float64] = towards, wall: float = bowl.wall) -> Bowl:
            z = transforms.unit(np.array([-values[3], -values[4], 1.0]))
            x = transforms.unit(np.array([*towards, 0.0]) - z * (z[:2] @ towards))
            return Bowl(transforms.make(np.column_stack([x, np.cross(z, x), z]), values[:3]), values[5:7], np.append(values[7:], 0.0), wall)

        def residual(
            values: NDArray[np.float64],
            chosen: NDArray[np.float64] = chosen,
            edges: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = edges,
            share: float = share,
            ring: NDArray[np.float64] = ring,
            of=of,
        ) -> NDArray[np.float64]:
            bowl = of(values)
            rows = [_off_hollow(bowl, chosen)]
            for eye, rays in edges:
                # Where the rays through the mask's edge meet the plane of the rim.
                n, c = bowl.table_from_bowl[:3, 2], bowl.table_from_bowl[:3, 3]
                met = bowl.local(eye + rays * (((c - eye) @ n) / (rays @ n))[:, None])
                outer = bowl.half + bowl.wall
                rows.append(share * (np.hypot(met[:, 0] / outer[0], met[:, 1] / outer[1]) - 1) * outer.mean())
            rows.append(np.sqrt(len(chosen) / len(ring)) * bowl.local(ring)[:, 2])
            slopes = np.diff(bowl.depths) / np.diff(RINGS)
            rows.append(3.0 * np.maximum(slopes, 0))  # it becomes no deeper towards the rim...
            rows.append(0.5 * np.maximum(np.diff(slopes), 0))  # ...and seldom less steep
            rows.append(np.sqrt(len(chosen)) * 0.1 * np.array([bowl.half[0] - bowl.half[1]]))
            return np.concatenate(rows)

        tilt = -base[:2, 2] / base[2, 2]
        start = np.concatenate([base[:3, 3], tilt, bowl.half, bowl.depths[:-1]])
        low = np.concatenate([start[:3] - 0.02, [-STEEPEST] * 2, [HALF[0]] * 2, np.zeros(len(RINGS) - 1)])
        high = np.concatenate([start[:3] + 0.02, [STEEPEST] * 2, [HALF[1]] * 2, np.full(len(RINGS) - 1, 0.12)])
        scale = np.concatenate([np.full(3, 0.01), [0.1, 0.1], np.full(len(RINGS) + 1, 0.01)])
        solved = least_squares(
            residual, np.clip(start, low + 1e-6, high - 1e-6), bounds=(low, high), x_scale=scale, loss="soft_l1", f_scale=0.002, max_nfev=10
        )
        bowl = of(solved.x)
        bowl = replace(bowl, depths=np.maximum.accumulate(bowl.depths[::-1])[::-1])
        lowest = float(bowl.surface(RINGS[:-1], 24, 0.0)[..., 2].min())
        bowl = replace(bowl, wall=float(np.clip(lowest, *WALLS)))
    if bowl.depths[0] < SHALLOW or bowl.half.max() > LONG * bowl.half.min():
        return None
    return bowl if explains(bowl, points, eyes, noise) else None


def explains(bowl: Bowl, points: NDArray[np.float64], eyes: NDArray[np.float64], noise: float) -> bool:
    """Whether a hollow is what was seen through its opening: points (N, 3) by their cameras (N, 3); noise of heights, m."""
    inside, near = _seen_inside(bowl, points, eyes), max(NEAR, 2.5 * noise)
    if np.count_nonzero(inside) < 60:
        return False
    off = np.abs(_off_hollow(bowl, points[inside]))
    if float(np.percentile(off, 80)) >= near or float(np.percentile(off, 95)) >= FAR * near:
        return False
    x, y, z = bowl.local(points).T
    share = np.hypot(x / bowl.half[0], y / bowl.half[1])
    if float(np.percentile(share[inside], 5)) > FLOOR:
        return False
    # What stands in the opening is no part of a bowl, nor is the hollow there that is fitted to the rest.
    standing = (share < WITHIN) & (z > near)
    return bool(np.count_nonzero(standing) <= STANDING * np.count_nonzero(inside))


def _off_hollow(bowl: Bowl, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,): distance of points (N, 3) from the hollow's surface, in the plane through its axis, m; above 0 within the hollow."""
    x, y, z = bowl.local(points).T
    share = np.hypot(x / bowl.half[0], y / bowl.half[1])
    # One profile for all directions, of the length that the half axis has in each.
    reach = np.hypot(x, y) / np.maximum(share, 1e-6)
    along = np.where(share > 1e-6, reach, bowl.half.mean())[:, None]
    start = along * RINGS[:-1], np.broadcast_to(-bowl.depths[:-1], (len(x), len(RINGS) - 1))
    step = along * np.diff(RINGS), np.broadcast_to(-np.diff(bowl.depths), (len(x), len(RINGS) - 1))
    off = (share * along[:, 0])[:, None] - start[0], z[:, None] - start[1]
    part = np.clip((off[0] * step[0] + off[1] * step[1]) / (step[0] ** 2 + step[1] ** 2), 0, 1)
    distance = np.hypot(off[0] - part * step[0], off[1] - part * step[1]).min(axis=1)
    within = (share < 1) & (z > -np.interp(share, RINGS, bowl.depths))
    return np.where(within, distance, -distance)


def _seen_inside(bowl: Bowl, points: NDArray[np.float64], eyes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,): whether points (N, 3) were seen through the opening by their cameras (N, 3)."""
    here, eye = bowl.local(points), bowl.local(eyes)
    share = here[:, 2] / (here[:, 2] - eye[:, 2])  # of the way to the camera, at which the ray is in the rim's plane
    met = (here + share[:, None] * (eye - here))[:, :2]
    # Stereo carries the near rim's depth on to what is seen past it.
    towards = eye[:, :2] / np.maximum(np.linalg.norm(eye[:, :2], axis=1, keepdims=True), 1e-9)
    carried = np.maximum(np.sum(met * towards, axis=1), 0) / np.maximum(np.linalg.norm(met, axis=1), 1e-9) * CARRIED
    free = np.hypot(met[:, 0] / bowl.half[0], met[:, 1] / bowl.half[1]) < 0.97 - carried / bowl.half.mean()
    return free & (here[:, 2] < -0.001) & (np.hypot(here[:, 0] / bowl.half[0], here[:, 1] / bowl.half[1]) < 1.1)


def _edges(bowl: Bowl, sights: list[Sight]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """For each camera its place (3,) and unit rays (N, 3) through the mask's edge at the rim, where the rim is before the table."""
    steps = np.arange(-REACH, REACH + EDGE_STEP / 2, EDGE_STEP)
    rim = bowl.rim(bowl.wall, 96)
    middle = bowl.table_from_bowl[:3, 3]
    outward = rim - middle
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    found = []
    for sight in sights:
        towards = transforms.unit(np.array([*(sight.eye - middle)[:2], 0.0]))
        aside = outward @ towards < ASIDE
        places = rim[aside, None] + steps[:, None] * outward[aside, None]
        inside, blind, _, _ = sight.sample(places)
        at = crossing(inside, steps)
        sound = np.isfinite(at) & ~blind.any(axis=1)
        rays = rim[aside][sound] + at[sound, None] * outward[aside][sound] - sight.eye
        found.append((sight.eye, rays / np.linalg.norm(rays, axis=1, keepdims=True)))
    return found


def _first(laid: Laid, wall: float) -> Bowl | None:
    """A first guess: the widest place of the thing's outline is its bowl."""
    # A steep wall is seen in streaks, between which the map is empty.
    occupied, cell = binary_fill_holes(np.isfinite(laid.grid.top)), laid.grid.cell
    width = cv2.distanceTransform(np.pad(occupied, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(width)), width.shape)
    radius = float(width[row, column]) * cell - wall
    if not HALF[0] < radius < HALF[1]:
        return None
    centres = laid.grid.centres()
    middle = centres[row, column]
    beyond = centres[occupied & (np.linalg.norm(centres - middle, axis=-1) > 1.3 * (radius + wall))]
    if len(beyond) * cell**2 < 1e-4:
        return None
    towards = beyond.mean(axis=0) - middle
    towards /= max(float(np.linalg.norm(towards)), 1e-9)
    x, y = np.array([*towards, 0.0]), np.array([-towards[1], towards[0], 0.0])
    bowl = Bowl(transforms.make(np.column_stack([x, y, [0.0, 0.0, 1.0]]), [*middle, 0.0]), np.full(2, radius), 0 * RINGS, wall)
    ring = _rim_points(laid, bowl)
    if len(ring) < 8:
        return None
    for _ in range(3):  # a plane through the highest of each direction, without those that are far from it
        plane = np.linalg.lstsq(np.column_stack([ring[:, :2] - middle, np.ones(len(ring))]), ring[:, 2], rcond=None)[0]
        off = np.abs(np.column_stack([ring[:, :2] - middle, np.ones(len(ring))]) @ plane - ring[:, 2])
        ring = ring[off <= max(0.003, float(np.percentile(off, 85)))]
    z = transforms.unit(np.array([-plane[0], -plane[1], 1.0]))
    x = transforms.unit(x - z * (z @ x))
    floor = laid.grid.top[np.linalg.norm(centres - middle, axis=-1) < 0.5 * radius]
    if not np.isfinite(floor).any():
        return None  # an eye, through which the table shows
    depth = plane[2] - float(np.nanpercentile(floor, 20))
    if depth < SHALLOW / 2:
        return None
    pose = transforms.make(np.column_stack([x, np.cross(z, x), z]), [*middle, plane[2]])
    # What leans is narrower from above.
    return Bowl(pose, np.full(2, min(radius / float(z[2]), HALF[1])), depth * (1 - RINGS**3), wall)


def _rim_points(laid: Laid, bowl: Bowl, count: int = 36) -> NDArray[np.float64]:
    """(N, 3): the highest point in each direction from the bowl's middle, about where the rim is, but not towards the handle."""
    angle = np.arange(count) * 2 * np.pi / count
    angle = angle[np.cos(angle) < 0.8]
    half = 1 / np.hypot(np.cos(angle) / bowl.half[0], np.sin(angle) / bowl.half[1])
    reach = half[:, None] + np.linspace(-0.2 * half.mean(), bowl.wall + 0.006, 14)
    base = bowl.table_from_bowl
    direction = np.cos(angle)[:, None] * base[:2, 0] + np.sin(angle)[:, None] * base[:2, 1]
    places = base[:2, 3] + reach[..., None] * direction[:, None]
    index = np.round((places - laid.grid.origin) / laid.grid.cell).astype(int)
    rows, columns = laid.grid.top.shape
    inside = (index[..., 0] >= 0) & (index[..., 0] < columns) & (index[..., 1] >= 0) & (index[..., 1] < rows)
    height = np.where(inside, laid.grid.top[np.clip(index[..., 1], 0, rows - 1), np.clip(index[..., 0], 0, columns - 1)], np.nan)
    told = np.isfinite(height).any(axis=1)
    best = np.argmax(np.nan_to_num(height[told], nan=-1.0), axis=1)
    here = np.arange(len(best))
    return np.column_stack([places[told][here, best], height[told][here, best]])


def bowl_solid(bowl: Bowl) -> tuple[Mesh, list[Mesh]]:
    """The bowl's wall as a watertight mesh, nothing of it below the table, and convex pieces."""
    shares = np.concatenate([np.linspace(0, 0.8, 7)[1:], [0.87, 0.92, 0.96, 0.98, 1.0]])
    inner, outer = bowl.surface(shares, _SECTORS, 0.0), bowl.surface(shares, _SECTORS, bowl.wall)
    outer[-1] = bowl.rim(bowl.wall, _SECTORS)
    middle = np.array([bowl.surface(np.zeros(1), 1, grow)[0, 0] for grow in (0.0, bowl.wall)])
    outer[..., 2], inner[..., 2] = np.maximum(outer[..., 2], 0), np.maximum(inner[..., 2], 0.001)
    middle[:, 2] = np.maximum(middle[:, 2], [0.001, 0])
    rings, count = len(shares), _SECTORS
    vertices = np.concatenate([inner.reshape(-1, 3), outer.reshape(-1, 3), middle])
    i = np.arange(count)
    j = (i + 1) % count
    faces = []

    def band(inside: int, outside: int) -> None:
        """Faces between two rings, seen from above the one within the other."""
        faces.extend([np.column_stack([inside + i, outside + j, inside + j]), np.column_stack([inside + i, outside + i, outside + j])])

    for k in range(rings - 1):
        band(k * count, (k + 1) * count)
        band((rings + k + 1) * count, (rings + k) * count)  # from below
    band((rings - 1) * count, (2 * rings - 1) * count)
    first = 2 * rings * count
    faces += [
        np.column_stack([np.full(count, first), i, j]),
        np.column_stack([np.full(count, first + 1), rings * count + j, rings * count + i]),
    ]
    mesh = Mesh(vertices, np.concatenate(faces))
    # Pieces between rings at which the profile bends, and sectors; the floor's middle is one.
    cuts = _bends(bowl)
    inner, outer = bowl.surface(cuts, _PIECES, 0.0), bowl.surface(cuts, _PIECES, bowl.wall)
    outer[-1] = bowl.rim(bowl.wall, _PIECES)
    outer[..., 2], inner[..., 2] = np.maximum(outer[..., 2], 0), np.maximum(inner[..., 2], 0.001)
    clouds = [np.concatenate([inner[0], outer[0]])]
    for k in range(len(cuts) - 1):
        for s in range(_PIECES):
            t = (s + 1) % _PIECES
            clouds.append(np.concatenate([side[[k, k, k + 1, k + 1], [s, t, s, t]] for side in (inner, outer)]))
    return mesh, [hull for cloud in clouds if (hull := hull_of(cloud)) is not None]


def _bends(bowl: Bowl) -> NDArray[np.float64]:
    """Shares (K,) of the way to the rim, the last 1, so that a flat floor up to the first and straight walls between them are within FOLLOWED of the hollow."""
    shares = np.linspace(0, 1, 101)
    profile = np.column_stack([float(bowl.half.mean()) * shares, -np.interp(shares, RINGS, bowl.depths)])
    chosen = [max(1, int(np.flatnonzero(profile[:, 1] <= profile[0, 1] + FOLLOWED)[-1]))]
    while chosen[-1] < 100:
        begin = chosen[-1]
        for end in range(100, begin, -1):
            along = transforms.unit(profile[end] - profile[begin])
            away = profile[begin:end] - profile[begin]
            if np.abs(along[0] * away[:, 1] - along[1] * away[:, 0]).max() <= FOLLOWED:
                break
        chosen.append(end)
    return shares[chosen]
