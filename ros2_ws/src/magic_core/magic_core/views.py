"""The canonical view of an object, found from its shape (paper, III-A: there it is given)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import GREY, VIEW_FILL, VIEW_SIZE, Raycaster, canonical_view
from magic_core.scene import VIEW_KINDS, CanonicalView

#: Horizontal directions tried for the side view, over half a turn, and the pixels of their silhouettes.
_DIRECTIONS = 24
_PROBE = 80


def find_view(mesh: Mesh, pieces: Sequence[Mesh] | None = None, kind: str | None = None, size: int = VIEW_SIZE) -> CanonicalView:
    """Draw an object (object frame, z up) in its canonical view.

    kind ``top``: from above, the object's x to the right.  ``side``: along the horizontal direction in which the
    silhouette shows a hole best, else the one that is least convex (a handle), else the widest; up is +z, and what
    sticks out lies to the right.  ``section``: the upright cut through the long horizontal axis of its plan, filled; the wider
    end (the bowl) lies to the right.  ``None`` decides: ``side`` for what stands and shows a hole or a handle from the
    side but not from above, else ``top``.  ``pieces`` are used for the cut where the mesh is not watertight; one alone says
    that the object is convex.

    ``confidence``: how far the chosen picture tells more than the alternatives; 1 where a hole decides it.
    Raises ``BAD_MESH`` for an empty mesh, ``BAD_REQUEST_IMAGE`` for an unknown kind.
    """
    if len(mesh.faces) == 0:
        raise MagicError(Code.BAD_MESH, "mesh to look at", "no faces", "at least one triangle")
    if kind is not None and kind not in VIEW_KINDS:
        raise MagicError(Code.BAD_REQUEST_IMAGE, "kind of view", kind, VIEW_KINDS)
    if kind == "top":
        return _top(mesh, size, 1.0)
    if kind == "section":
        return _section(mesh, pieces, size)
    if kind == "side":
        direction, _, confidence = _best_side(mesh)
        return canonical_view(mesh, direction, (0, 0, 1), "side", size, confidence=confidence)
    width = float(np.linalg.norm(mesh.extents[:2]))
    if mesh.extents[2] < 0.3 * width:  # it lies on the table
        return _top(mesh, size, float(np.clip(1.0 - mesh.extents[2] / max(width, 1e-9), 0.5, 1.0)))
    if pieces is not None and len(pieces) == 1:  # convex: no side tells more than another
        return _top(mesh, size, 0.5)
    direction, told, confidence = _best_side(mesh)
    from_above = _tells(_silhouettes(Raycaster([mesh]), mesh, np.array([[0, 0, -1.0]]), np.array([0, 1.0, 0]))[0][0])
    if told > 1.2 * from_above and told > 0.03:
        return canonical_view(mesh, direction, (0, 0, 1), "side", size, confidence=confidence)
    return _top(mesh, size, float(np.clip(0.5 + from_above - told, 0.1, 1.0)))


def _top(mesh: Mesh, size: int, confidence: float) -> CanonicalView:
    return canonical_view(mesh, (0, 0, -1), (0, 1, 0), "top", size, confidence=confidence)


def _silhouettes(
    caster: Raycaster, mesh: Mesh, directions: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """The masks (D, P, P) of a mesh seen along directions (D, 3), and their metres per pixel (D,)."""
    steps = np.arange(_PROBE) - (_PROBE - 1) / 2
    rays = np.empty((len(directions), _PROBE, _PROBE, 6), np.float32)
    scales = []
    for ray, direction in zip(rays, directions, strict=True):
        y = transforms.unit(-(up - (up @ direction) * direction))
        rotation = np.column_stack([np.cross(y, direction), y, direction])
        local = mesh.vertices @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        scale = max(float((high - low)[:2].max()), 1e-6) / (0.9 * _PROBE)
        middle = (low + high) / 2
        middle[2] = low[2] - 0.01
        across, down = steps * scale + middle[0], steps * scale + middle[1]
        for axis in range(3):
            ray[..., axis] = (rotation[axis, 0] * across + rotation[axis, 2] * middle[2])[None, :] + (rotation[axis, 1] * down)[:, None]
        ray[..., 3:] = direction
        scales.append(scale)
    return caster.hits(rays[..., :3], rays[..., 3:]), np.array(scales)


def holes_of(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels of a mask's enclosed holes (H, W)."""
    outside = np.pad((~mask).astype(np.uint8), 1, constant_values=1)
    cv2.floodFill(outside, None, (0, 0), 2)
    return outside[1:-1, 1:-1] == 1


def _tells(mask: NDArray[np.bool_]) -> float:
    """How much a silhouette tells of a handle: its holes (counted three times) and notches over its area."""
    area = max(int(mask.sum()), 1)
    holes = int(cv2.morphologyEx(holes_of(mask).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)).sum())
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(np.concatenate(contours)) if contours else None
    hull_area = cv2.contourArea(hull) if hull is not None else 0.0
    outer = sum(cv2.contourArea(c) for c in contours)
    notch = max(0.0, (hull_area - outer) / area)
    return 3 * holes / area + notch


def _best_side(mesh: Mesh) -> tuple[NDArray[np.float64], float, float]:
    """The horizontal direction that tells most, how much it tells, and the confidence."""
    caster = Raycaster([mesh])
    up = np.array([0.0, 0.0, 1.0])
    angles = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    masks, scales = _silhouettes(caster, mesh, directions, up)
    told = np.array([_tells(mask) for mask in masks])
    widths = masks.any(axis=1).sum(axis=1) * scales
    # Width decides between directions that tell the same: smoothing makes the middle of a good range win.
    smooth = np.convolve(np.concatenate([told[-2:], told, told[:2]]), [0.1, 0.2, 0.4, 0.2, 0.1], mode="valid")
    best = int(np.argmax(smooth + 0.05 * widths / widths.max()))
    direction, mask = directions[best], masks[best]
    # What sticks out is thinner than the body: it lies on the side that is farther from the centroid.
    columns = np.nonzero(mask.any(axis=0))[0]
    centroid = np.nonzero(mask)[1].mean()
    if columns[-1] - centroid < centroid - columns[0]:
        direction = -direction
    spread = float(told.max() - np.median(told))
    confidence = 1.0 if holes_of(mask).sum() > 0.005 * mask.sum() else float(np.clip(0.3 + 2 * spread, 0.1, 0.9))
    return direction, float(told[best]), confidence


def long_axis(mesh: Mesh) -> NDArray[np.float64]:
    """(3,): unit horizontal direction of the long principal axis of a mesh's area as seen from above.

    For a thing with an upright plane of symmetry along it (a spoon) the plane contains this axis, which does not hold
    for the side of the smallest box.
    """
    return _plan(mesh)[0]


def _plan(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The long axis (3,) and the centroid (3,) of a mesh's area as seen from above."""
    corners = mesh.vertices[mesh.faces]
    u, v = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    # A closed mesh is seen from below and from above: the area counts twice, which does not matter here.
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) + 1e-12
    centroid = np.average(corners.mean(axis=1), axis=0, weights=area)
    # Second moments of triangles are exact with the three edge midpoints.
    middles = ((corners + np.roll(corners, 1, axis=1)) / 2 - centroid)[..., :2]
    moments = np.einsum("n,nki,nkj->ij", area, middles, middles)
    x, y = np.linalg.eigh(moments)[1][:, 1]
    axis = np.array([x, y, 0.0])
    return (axis if axis[np.argmax(np.abs(axis))] > 0 else -axis), centroid


def _section(mesh: Mesh, pieces: Sequence[Mesh] | None, size: int) -> CanonicalView:
    import shapely

    axis, centre = _plan(mesh)
    side = np.array([-axis[1], axis[0], 0.0])
    lateral = (mesh.vertices - centre) @ side
    along = (mesh.vertices - centre) @ axis
    middle = centre
    # The wider end, where the bowl is, goes to the right.
    half = (along.min() + along.max()) / 2
    if np.ptp(lateral[along < half], axis=0) > np.ptp(lateral[along >= half], axis=0):
        axis = -axis
    shape = _cut(mesh, middle, axis, side)
    if shape.is_empty and pieces:
        shape = shapely.union_all([_cut(piece, middle, axis, side) for piece in pieces])
    if shape.is_empty:
        raise MagicError(Code.BAD_MESH, "section along the long axis", "empty", "a mesh that the upright plane through its middle cuts")
    # The picture: x along the axis, y down, z = x cross y.
    x, y = axis, np.array([0.0, 0.0, -1.0])
    x0, z0, x1, z1 = shape.bounds
    mid = np.array([(x0 + x1) / 2, (z0 + z1) / 2])
    scale = max(x1 - x0, z1 - z0, 1e-6) / (VIEW_FILL * size)
    mask = np.zeros((size, size), np.uint8)
    shift = 8
    for polygon in getattr(shape, "geoms", [shape]):
        if polygon.geom_type != "Polygon":
            continue
        rings = []
        for ring in (polygon.exterior, *polygon.interiors):
            p = (np.asarray(ring.coords) - mid) * [1, -1] / scale + (size - 1) / 2
            rings.append(np.round(p * (1 << shift)).astype(np.int32))
        drawn = np.zeros_like(mask)
        cv2.fillPoly(drawn, rings, 1, shift=shift)
        mask |= drawn
    mask = mask.astype(bool)
    color = GREY if mesh.colors is None else np.median(mesh.colors, axis=0).astype(np.uint8)
    image = np.zeros((size, size, 3), np.uint8)
    image[mask] = np.maximum(color, 60)
    origin = middle + axis * mid[0] + np.array([0, 0, mid[1] - middle[2]])
    object_from_view = transforms.make(np.column_stack([x, y, np.cross(x, y)]), origin)
    depth = np.where(mask, np.float32(0), np.float32(np.nan))
    return CanonicalView(
        image,
        mask,
        scale,
        object_from_view,
        "section",
        depth,
        float(np.clip(1 - np.ptp(mesh.vertices[:, 2]) / max(np.ptp(along), 1e-9), 0.2, 1.0)),
    )


def _cut(mesh: Mesh, origin: NDArray[np.float64], axis: NDArray[np.float64], normal: NDArray[np.float64]) -> object:
    """The filled section (shapely) of a mesh by an upright plane; coordinates (metres along axis from origin, world z)."""
    import shapely

    cut = mesh.to_trimesh()
    cut.merge_vertices()
    segments = cut.section(plane_origin=origin, plane_normal=normal)
    if segments is None:
        return shapely.Polygon()
    rings = []
    for line in segments.discrete:
        if len(line) >= 4:
            ring = shapely.Polygon(np.column_stack([(line - origin) @ axis, line[:, 2]]))
            rings.append(ring if ring.is_valid else ring.buffer(0))
    rings.sort(key=lambda r: -r.area)
    shape = shapely.Polygon()
    for ring in rings:  # even-odd: what lies inside of another ring is its hole
        shape = shape.symmetric_difference(ring)
    return shape
