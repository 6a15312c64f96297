"""Which cases can be done at all, by geometry alone: what no method could do is no fault of a method.

Each function answers a necessary condition that is wider than the goal test, so that "impossible" is certain and
"possible" is not a promise.  Everything is seen from the target's middle: the tool is grown by the target's radius, and
what is left free are the places where the target's middle may be (its configuration space).

hook    in the plane of the table the target's middle moves along the border of that free space.  Where the border turns
        around the target it is held against every pull whose direction lies within the turn.  The goal asks that a pull
        and one turned by 30 degrees are both held: no border that turns by so much, no hook.
hang    in the plane across the rod a thing that hangs freely turns until its centre of mass is below the point at which the rod
        bears it; the surface there must be across that line within the angle of friction, material above the rod, and
        the thing's middle must then be above the height that the goal asks for.
scoop   over the tool as it is carried the middle of a ball has a lowest height at each place.  It lies in the tool where that
        surface has a basin out of which a push at 0.1 m/s (0.7 mm for a rolling ball) does not lead.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.content import digest
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Strategy
from magic_verifier.subjects import Case, load_object, scene_for

#: Turn of the border (degrees) that the goal of hooking needs, with a tenth off for outlines made of straight pieces.
HOOK_TURN = 27.0
#: Rise (m) that the push of the goal of scooping gives a rolling ball: 7/10 v^2 / g.
SCOOP_RISE = 0.0007
#: Angle of friction (degrees) of hanging: 0.3, at which the goal looks whether a thing stays, and a fifth more.
HANG_ANGLE = float(np.rad2deg(np.arctan(1.2 * 0.3)))
#: Step (m) along the border, and normals looked at in each of its corners.
STEP, NORMALS = 0.001, 7
#: Levels at which a tool is cut across its view, as shares of its thickness.
LEVELS = (0.15, 0.35, 0.5, 0.65, 0.85)
#: Grid (m) and tilts (degrees, about the two horizontal axes) of scooping.
GRID, TILTS = 0.003, ((0, 0), (15, 0), (-15, 0), (30, 0), (-30, 0), (0, 15), (0, -15))
#: A target is round when its outline from above covers its smallest box as a circle does, within this.
ROUND = 0.03


def outlines(mesh: Mesh, direction: NDArray[np.float64], up: NDArray[np.float64]) -> Iterator[Any]:
    """Cuts of a mesh across a direction (3,), at several levels, as shapely areas in metres; ``up`` (3,) is their y."""
    import shapely

    across = np.cross(up, -direction)
    rotation = np.stack([across, np.cross(-direction, across), -direction])
    flat = transforms.make(rotation)
    solid = mesh.transformed(flat).to_trimesh()
    low, high = solid.bounds[:, 2]
    for share in LEVELS:
        cut = solid.section(plane_origin=[0, 0, low + share * (high - low)], plane_normal=[0, 0, 1.0])
        if cut is None:
            continue
        area = shapely.Polygon()
        for path in cut.discrete:
            if len(path) >= 4:
                area = area.symmetric_difference(shapely.Polygon(path[:, :2]).buffer(0))
        area = shapely.simplify(area, 1e-4)
        if not area.is_empty:
            yield area


def silhouette(view: CanonicalView) -> Any:
    """A view's mask as a shapely area in metres of the view's frame, through the middles of its outermost pixels."""
    import cv2
    import shapely

    area = shapely.Polygon()
    contours, _ = cv2.findContours(view.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    height, width = view.mask.shape
    for contour in contours:
        if len(contour) >= 4:
            ring = (contour[:, 0] - np.array([(width - 1) / 2, (height - 1) / 2])) * view.metres_per_pixel
            area = area.symmetric_difference(shapely.Polygon(ring).buffer(0))
    return shapely.simplify(area, 0.5 * view.metres_per_pixel)


def _borders(area: Any, radius: float) -> Iterator[NDArray[np.float64]]:
    """The borders (N, 2) of the places where a disc's middle may be, free space on the right-hand side of the way round."""
    import shapely.geometry.polygon

    grown = area.buffer(radius, quad_segs=16)
    for polygon in getattr(grown, "geoms", [grown]):
        polygon = shapely.geometry.polygon.orient(polygon)
        for ring in (polygon.exterior, *polygon.interiors):
            yield np.asarray(ring.coords)[:-1]


def pocket(area: Any, radius: float) -> float:
    """By how many degrees the border of the places of a disc turns around it, at most, in one stretch; 360 inside a ring."""
    most = 0.0
    for ring in _borders(area, radius):
        step = np.diff(np.concatenate([ring[-1:], ring, ring[:1]]), axis=0)
        turn = np.arctan2(
            step[:-1, 0] * step[1:, 1] - step[:-1, 1] * step[1:, 0], np.einsum("ij,ij->i", step[:-1], step[1:])
        )  # positive: away from the free space; negative: around it
        around = np.minimum(np.maximum(-turn, -np.pi), np.pi)
        # The greatest sum over neighbouring corners of the closed border (Kadane, twice round).
        best = here = 0.0
        for angle in np.concatenate([around, around]):
            here = max(0.0, here + angle)
            best = max(best, here)
        most = max(most, min(best, 2 * np.pi))
    return float(np.rad2deg(most))


def hangs(area: Any, centre: NDArray[np.float64], radius: float, drop: float = np.inf, middle: NDArray[np.float64] | None = None) -> bool:
    """Whether a flat thing (shapely area, centre of mass (2,)) hangs on a rod of that radius, seen along the rod.

    drop: how far below the rod its ``middle`` (2,) may be (m); by default the centre of mass.
    """
    middle = centre if middle is None else middle
    least = np.cos(np.deg2rad(HANG_ANGLE))
    for ring in _borders(area, radius):
        ends = np.roll(ring, -1, axis=0)
        edges = ends - ring
        length = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)
        into = np.column_stack([-edges[:, 1], edges[:, 0]]) / length[:, None]  # the material is on the left
        places, normals = [], []
        for k in range(len(ring)):
            count = int(np.ceil(length[k] / STEP))
            places.append(ring[k] + np.linspace(0, 1, count + 1)[:, None] * edges[k])
            normals.append(np.tile(into[k], (count + 1, 1)))
            before, after = into[k - 1], into[k]
            if before[0] * after[1] - before[1] * after[0] < 0:  # around the rod: it may press either way, or in between
                share = np.linspace(0, 1, NORMALS)[:, None]
                between = (1 - share) * before + share * after
                kept = np.linalg.norm(between, axis=1) > 1e-6
                normals.append(between[kept] / np.linalg.norm(between[kept], axis=1, keepdims=True))
                places.append(np.tile(ring[k], (int(kept.sum()), 1)))
        place, normal = np.concatenate(places), np.concatenate(normals)
        held = place + radius * normal - centre
        away = np.linalg.norm(held, axis=1)
        up = held / np.maximum(away, 1e-12)[:, None]
        bears = (away > 1e-4) & (np.einsum("ij,ij->i", up, normal) >= least)
        low = np.einsum("ij,ij->i", place + radius * normal - middle, up)
        if np.any(bears & (low <= drop)):
            return True
    return False


def basin(mesh: Mesh, radius: float, enough: float = np.inf) -> float:
    """Depth (m) of the deepest basin over a tool, its top up as it stands in its own frame or tilted, for the middle of a ball;
    the first one that is deep ``enough`` will do."""
    from scipy.ndimage import grey_dilation

    from magic_core.rendering import Raycaster

    count = int(np.ceil(radius / GRID))
    x, y = np.meshgrid(*[np.arange(-count, count + 1) * GRID] * 2, indexing="ij")
    inside = np.hypot(x, y) < radius
    ball = np.where(inside, np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0)), 0.0)
    deepest = 0.0
    for roll, pitch in TILTS:
        standing = mesh.transformed(transforms.from_rpy(np.deg2rad(roll), np.deg2rad(pitch), 0.0))
        low, high = standing.bounds
        xs, ys = (np.arange(low[i] - 2 * GRID, high[i] + 2 * GRID, GRID) for i in (0, 1))
        grid = np.stack([*np.meshgrid(xs, ys, indexing="ij"), np.full((len(xs), len(ys)), high[2] + 0.01)], axis=-1).reshape(-1, 3)
        cast = Raycaster([standing]).cast(grid, np.tile([0.0, 0.0, -1.0], (len(grid), 1)))
        top = (high[2] + 0.01 - np.asarray(cast.distance)).reshape(len(xs), len(ys))
        # Nothing is there: as low as nothing can lie on it.
        top = np.where(np.isfinite(top), top, low[2] - 10 * radius)
        top = np.pad(top, count + 1, constant_values=low[2] - 10 * radius)
        heights = grey_dilation(top, footprint=inside, structure=ball)
        deepest = max(deepest, float((_filled(heights) - heights).max()))
        if deepest >= enough:
            break
    return deepest


def _filled(heights: NDArray[np.float64]) -> NDArray[np.float64]:
    """A surface (N, M) with its basins filled to their rims (priority flood, Barnes 2014)."""
    filled = np.full_like(heights, np.inf)
    n, m = heights.shape
    queue = [(float(heights[i, j]), i, j) for i in range(n) for j in range(m) if i in (0, n - 1) or j in (0, m - 1)]
    for height, i, j in queue:
        filled[i, j] = height
    heapq.heapify(queue)
    while queue:
        height, i, j = heapq.heappop(queue)
        for a, b in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= a < n and 0 <= b < m and filled[a, b] == np.inf:
                filled[a, b] = max(height, heights[a, b])
                heapq.heappush(queue, (float(filled[a, b]), a, b))
    return filled


def _round_radius(mesh: Mesh) -> float | None:
    """Radius of a target that is round from above, ``None`` where it is not."""
    import shapely

    covered = shapely.MultiPoint(mesh.vertices[:, :2]).convex_hull
    box = covered.minimum_rotated_rectangle
    if box.geom_type != "Polygon" or abs(covered.area / box.area / (np.pi / 4) - 1) > ROUND:
        return None
    return float(np.sqrt(covered.area / np.pi))


def impossible(strategy: Strategy, case: Case) -> str:
    """Why no motion can do a case, with the number; empty where geometry does not forbid it, or says nothing of such a goal or target."""
    reasons = []
    for name in case.tools:
        try:
            reason = _impossible(strategy, name, case.target)
        except MagicError as error:
            if error.code != Code.BAD_MESH:
                raise
            reason = ""  # what is no body is for the case itself to refuse
        if not reason:
            return ""
        reasons.append(reason if len(case.tools) == 1 else f"{name}: {reason}")
    return "; ".join(reasons)


#: Answers for tools and targets that were asked for before, by what they depend on: that is not the method or the turn.
_known: dict[bytes, str] = {}


def _impossible(strategy: Strategy, name: str, target_name: str) -> str:
    where = strategy.target_contact.radius, strategy.target_outline
    key = digest((strategy.goal, strategy.view, where, strategy.environment, strategy.target_mesh, name, target_name))
    if key not in _known:
        _known[key] = _looked_at(strategy, name, target_name)
    return _known[key]


def _looked_at(strategy: Strategy, name: str, target_name: str) -> str:
    """What by geometry keeps a tool from reaching the goal with a target; empty where nothing does, or nobody can tell."""
    mesh, pieces, shape, _ = load_object(name, strategy.view)
    target, _, meeting = scene_for(strategy, target_name)
    asked = list(strategy.goal.tree.nodes())
    if any(node.kind in ("touching_only", "held_by") and (node.args["what"], node.args["whom"]) == ("target", "tool") for node in asked):
        return _why_not_scooped(mesh, target)
    hangs_on = any(node.kind == "below_support" for node in asked)
    if not hangs_on and not any(node.kind == "encloses" for node in asked):
        return ""
    if strategy.target_outline != "outer":  # what is met in its hole encloses the tool, whatever its shape
        return ""
    if shape is not None:
        views = [shape.view(strategy.view)]
    else:
        from magic_core.views import find_view, own_views

        # Of a file nobody has said how it is used: a tool may be turned to be seen, and led, along any direction of its own shape.
        first = find_view(mesh, pieces, strategy.view)
        views = [first, *own_views(mesh, pieces, strategy.view, first.direction)]
    if not hangs_on:
        return _why_not_pulled(mesh, views, target)
    if meeting is None:
        radius = strategy.target_contact.radius
        top = float(transforms.apply(target.world_from_object, target.mesh.vertices)[:, 2].max())
    else:
        radius = meeting.radius
        top = float(transforms.apply(target.world_from_object, meeting.point[None])[0, 2])
    drop = top - max((node.args["height"] for node in asked if node.kind == "above" and node.args["what"] == "tool"), default=-np.inf)
    return _why_not_hung(mesh, views, radius, drop)


def _why_not_scooped(mesh: Mesh, target: SceneObject) -> str:
    """Why a ball does not lie in a tool; empty where it does, or the target is no ball."""
    radius = _round_radius(target.mesh)
    if radius is None:
        return ""
    depth = basin(mesh, radius, SCOOP_RISE)
    if depth >= SCOOP_RISE:
        return ""
    return f"a ball of {1000 * radius:.0f} mm lies {1000 * depth:.1f} mm deep in it (needed: {1000 * SCOOP_RISE:.1f} mm)"


def _why_not_pulled(mesh: Mesh, views: list[CanonicalView], target: SceneObject) -> str:
    """Why a tool that is seen in these views does not hold a round target; empty where it does, or the target is not round."""
    radius = _round_radius(target.mesh)
    if radius is None:
        return ""
    areas = (area for view in views for area in outlines(mesh, view.direction, -view.object_from_view[:3, 1]))
    turn = max((pocket(area, radius) for area in areas), default=0.0)
    if turn >= HOOK_TURN:
        return ""
    return f"nothing in it turns around a disc of {1000 * radius:.0f} mm by more than {turn:.0f} degrees (needed: {HOOK_TURN:g})"


def _why_not_hung(mesh: Mesh, views: list[CanonicalView], radius: float, drop: float) -> str:
    """Why a tool that is seen in these views does not hang on a rod of a radius, m, or not with its middle no more than ``drop`` m below
    the rod's top; empty where it does."""
    solid = mesh.to_trimesh()
    weight = np.stack([solid.center_mass if solid.is_volume else solid.centroid, mesh.bounds.mean(axis=0)])
    lower = False
    for view in views:
        centre, middle = transforms.apply(transforms.inverse(view.object_from_view), weight)[:, :2]
        # The rod goes through all of it: what is in its way anywhere is.
        area = silhouette(view)
        if hangs(area, centre, radius, drop, middle):
            return ""
        lower = lower or hangs(area, centre, radius)
    if lower:
        return f"hanging on the rod its middle would be more than {1000 * drop:.0f} mm below it: lower than the goal allows"
    return f"nothing in it holds a rod of {1000 * radius:.0f} mm radius above its centre of mass"
