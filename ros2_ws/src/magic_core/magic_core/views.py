"""The canonical view of an object, found from its shape (paper, III-A: there it is given)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import GREY, VIEW_FILL, VIEW_SIZE, Raycaster
from magic_core.scene import VIEW_KINDS, CanonicalView

#: Horizontal directions tried for the side view, over half a turn, and the pixels of their silhouettes.
_DIRECTIONS = 24
_PROBE = 80


def find_view(
    mesh: Mesh | NDArray[np.float64], pieces: Sequence[Mesh] | None = None, kind: str | None = None, size: int = VIEW_SIZE
) -> CanonicalView:
    """Draw an object (object frame, z up), a mesh or a cloud (N, 3), in its canonical view.

    kind ``top``: from above, the object's x to the right.  ``side``: along the horizontal direction in which the
    silhouette shows a hole best, else the one that is least convex (a handle), else the widest; up is +z, and what
    sticks out lies to the right.  ``section``: the upright cut through the long horizontal axis of its plan, filled; the wider
    end (the bowl) lies to the right.  ``None`` decides: ``side`` for what stands and shows a hole or a handle from the
    side but not from above, else ``top``.  ``pieces`` are used for the cut where the mesh is not watertight; one alone says
    that the object is convex.

    ``confidence``: how far the chosen picture tells more than the alternatives; 1 where a hole decides it.
    Of a cloud only what was seen is drawn (:func:`mesh_of_cloud`; paint it there).
    Raises ``BAD_MESH`` for an empty mesh or cloud, ``BAD_REQUEST_IMAGE`` for an unknown kind.
    """
    if not isinstance(mesh, Mesh):
        cloud = np.asarray(mesh, float)
        if kind == "section":
            return _section_of_cloud(cloud, size)
        mesh = mesh_of_cloud(cloud)
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
        return _drawn(mesh, direction, (0, 0, 1), "side", size, confidence)
    width = float(np.linalg.norm(mesh.extents[:2]))
    if mesh.extents[2] < 0.3 * width:  # it lies on the table
        return _top(mesh, size, float(np.clip(1.0 - mesh.extents[2] / max(width, 1e-9), 0.5, 1.0)))
    if pieces is not None and len(pieces) == 1:  # convex: no side tells more than another
        return _top(mesh, size, 0.5)
    direction, told, confidence = _best_side(mesh)
    from_above = _tells(_silhouettes(Raycaster([mesh]), mesh, np.array([[0, 0, -1.0]]), np.array([0, 1.0, 0]))[0][0])
    if told > 1.2 * from_above and told > 0.03:
        return _drawn(mesh, direction, (0, 0, 1), "side", size, confidence)
    return _top(mesh, size, float(np.clip(0.5 + from_above - told, 0.1, 1.0)))


def mesh_of_cloud(points: NDArray[np.float64], colors: NDArray[np.uint8] | None = None, spacing: float | None = None) -> Mesh:
    """A cloud (N, 3) with colours (N, 3) as small octahedra, so that it can be looked at like a mesh: neighbours touch, holes stay open.

    ``spacing`` metres between points; found from the cloud if not given, and thinned to it.  Raises ``BAD_MESH`` for fewer than 10 finite points.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MagicError(Code.BAD_MESH, "shape of the cloud", points.shape, "(N, 3)")
    finite = np.all(np.isfinite(points), axis=1)
    points = points[finite]
    if len(points) < 10:
        raise MagicError(Code.BAD_MESH, "points of the cloud", len(points), "at least 10, finite")
    if spacing is None:
        from scipy.spatial import cKDTree

        tree = cKDTree(points)
        # The third neighbour of a scattered surface is about as far as the gaps are wide.
        few = points[:: max(1, len(points) // 1000)]
        spacing = float(np.percentile(tree.query(few, k=4)[0][:, 3], 90))
        spacing = max(spacing, float(np.ptp(points, axis=0).max()) / 200, 1e-5)
    keys = np.floor(points / spacing).astype(np.int64)
    _, first = np.unique(keys, axis=0, return_index=True)
    first = np.sort(first)
    centres = points[first]
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]) * spacing
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    paint = None if colors is None else np.repeat(np.asarray(colors)[finite][first], 6, axis=0)
    return Mesh((centres[:, None] + corners).reshape(-1, 3), (6 * np.arange(len(centres))[:, None, None] + faces).reshape(-1, 3), paint)


def _section_of_cloud(points: NDArray[np.float64], size: int) -> CanonicalView:
    """The points near the upright plane along the long axis, seen from the side; what was not seen (an underside) is missing."""
    whole = mesh_of_cloud(points)
    axis, centre = _plan(whole)
    side = np.array([-axis[1], axis[0], 0.0])
    width = float(np.ptp(whole.vertices @ side))
    lateral = np.abs((whole.vertices - centre) @ side).reshape(-1, 6).mean(axis=1)
    near = lateral < max(0.08 * width, 0.004)
    if np.count_nonzero(near) < 10:
        raise MagicError(Code.BAD_MESH, "points of the cloud near its middle plane", int(near.sum()), "at least 10")
    faces = whole.faces.reshape(-1, 8, 3)[near].reshape(-1, 3)
    used, faces = np.unique(faces, return_inverse=True)
    part = Mesh(whole.vertices[used], faces.reshape(-1, 3))
    # The wider end, where the bowl is, goes to the right.
    along, across = (whole.vertices - centre) @ axis, (whole.vertices - centre) @ side
    half = (along.min() + along.max()) / 2
    if np.ptp(across[along < half]) > np.ptp(across[along >= half]):
        axis = -axis
    return _drawn(part, np.cross(axis, [0.0, 0.0, -1.0]), (0, 0, 1), "section", size, 0.5)


def _top(mesh: Mesh, size: int, confidence: float) -> CanonicalView:
    return _drawn(mesh, (0, 0, -1), (0, 1, 0), "top", size, confidence)


def _drawn(mesh: Mesh, direction: ArrayLike, up: ArrayLike, kind: str, size: int, confidence: float) -> CanonicalView:
    """What :func:`magic_core.rendering.canonical_view` draws, in half of its time: shaded by triangle, not by pixel."""
    import open3d as o3d

    z = transforms.unit(direction)
    up = np.asarray(up, dtype=float)
    y = transforms.unit(-(up - (up @ z) * z))
    x = np.cross(y, z)
    rotation = np.column_stack([x, y, z])
    local = mesh.vertices @ rotation
    low, high = local.min(axis=0), local.max(axis=0)
    centre = rotation @ ((low + high) / 2)
    scale = max(float((high - low)[:2].max()), 1e-6) / (VIEW_FILL * size)
    reach = float(high[2] - low[2]) / 2 + 0.01
    # The object is centred: rays are needed only in the rectangle that it fills, two pixels of margin around it.
    left, top = np.maximum((size - 2 * np.ceil((high - low)[:2] / scale / 2).astype(int) - 4) // 2, 0)
    width, height = size - 2 * left, size - 2 * top
    across = ((np.arange(width) - (width - 1) / 2) * scale).astype(np.float32)
    down = ((np.arange(height) - (height - 1) / 2) * scale).astype(np.float32)
    start = centre - reach * z
    rays = np.empty((height, width, 6), np.float32)
    for axis in range(3):
        np.add(np.float32(x[axis]) * across, (np.float32(y[axis]) * down + np.float32(start[axis]))[:, None], out=rays[..., axis])
        rays[..., 3 + axis] = z[axis]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    hits = scene.cast_rays(o3d.core.Tensor(rays))
    distance = hits["t_hit"].numpy()
    hit = np.isfinite(distance)
    where = np.flatnonzero(hit)
    face = np.take(hits["primitive_ids"].numpy().ravel(), where)
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    normals[normals @ z > 0] *= -1
    light = transforms.unit(-z + 0.4 * x - 0.3 * y)
    bright = (0.45 + 0.55 * np.clip(normals @ light, 0, 1)).astype(np.float32)
    seen = np.zeros((height * width, 3), np.uint8)
    if mesh.colors is None:
        seen[where] = np.take((GREY * bright[:, None]).astype(np.uint8), face, axis=0)
    else:
        # Colour over a triangle is linear: its value at a corner and the slopes along two sides.
        paint = mesh.colors[mesh.faces].astype(np.float32) * bright[:, None, None]
        paint[:, 1:] -= paint[:, :1]
        bc = np.take(hits["primitive_uvs"].numpy().reshape(-1, 2), where, axis=0)
        rows = np.take(paint.reshape(-1, 9), face, axis=0)
        rows[:, 3:6] *= bc[:, :1]
        rows[:, 6:] *= bc[:, 1:]
        seen[where] = rows[:, :3] + rows[:, 3:6] + rows[:, 6:]
    image = np.zeros((size, size, 3), np.uint8)
    mask = np.zeros((size, size), bool)
    depth = np.full((size, size), np.nan, np.float32)
    window = (slice(top, top + height), slice(left, left + width))
    image[window] = seen.reshape(height, width, 3)
    mask[window] = hit
    depth[window] = np.where(hit, distance - np.float32(reach), np.float32(np.nan))
    return CanonicalView(image, mask, scale, transforms.make(rotation, centre), kind, depth, confidence)


def _silhouettes(
    caster: Raycaster, mesh: Mesh, directions: NDArray[np.float64], up: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """The masks (D, P, P) of a mesh seen along directions (D, 3), and their metres per pixel (D,)."""
    count = len(directions)
    y = -(up - (directions @ up)[:, None] * directions)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    axes = np.stack([np.cross(y, directions), y, directions], axis=1)  # rows: right, down, into the picture
    local = axes @ mesh.vertices.T
    low, high = local.min(axis=2), local.max(axis=2)
    extent = (high - low)[:, :2]
    scales = np.maximum(extent.max(axis=1), 1e-6) / (0.9 * _PROBE)
    # The thing is in the middle: only the rows and columns that it reaches in some direction need rays.
    reach = np.minimum(np.ceil((extent / scales[:, None]).max(axis=0) / 2).astype(int) + 1, _PROBE // 2)
    columns, rows = (slice(_PROBE // 2 - r, _PROBE // 2 + r) for r in reach)
    steps = np.arange(_PROBE) - (_PROBE - 1) / 2
    middle = (low + high) / 2
    middle[:, 2] = low[:, 2] - 0.01
    across = scales[:, None] * steps[columns] + middle[:, :1]
    down = scales[:, None] * steps[rows] + middle[:, 1:2]
    rays = np.empty((count, down.shape[1], across.shape[1], 6), np.float32)
    for axis in range(3):
        right, below, into = axes[:, 0, axis, None], axes[:, 1, axis, None], axes[:, 2, axis, None]
        np.add((right * across + into * middle[:, 2:])[:, None, :], (below * down)[:, :, None], out=rays[..., axis], casting="same_kind")
        rays[..., 3 + axis] = directions[:, axis, None, None]
    masks = np.zeros((count, _PROBE, _PROBE), bool)
    masks[:, rows, columns] = caster.hits(rays[..., :3], rays[..., 3:])
    return masks, scales


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
