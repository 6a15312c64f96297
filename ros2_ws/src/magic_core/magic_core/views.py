"""The canonical view of an object, found from its shape (paper, III-A: there it is given)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import GREY, VIEW_FILL, VIEW_SIZE, Raycaster
from magic_core.scene import VIEW_KINDS, CanonicalView, SceneObject

#: Horizontal directions tried for the side view, over half a turn, and the pixels of their silhouettes.
_DIRECTIONS = 24
_PROBE = 80
#: Directions tried over half the sphere for the views of an object's own shape: 13 degrees apart.
_SPHERE = 120
#: Two views nearer than this show the same.
_APART = np.deg2rad(25.0)
#: A silhouette that tells less shows neither hole nor notch.
_PLAIN = 0.03
#: Skewness of a surface across a plane of symmetry, at most: reconstructions are not quite symmetric.
_SKEW = 0.25
#: Directions of an object's own shape, at most.
DIRECTIONS = 3


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
    _check(mesh)
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


def along(
    mesh: Mesh, pieces: Sequence[Mesh] | None, kind: str, direction: ArrayLike, size: int = VIEW_SIZE, confidence: float = 1.0
) -> CanonicalView:
    """Draw an object in a view of a kind along a direction (3,) of its own frame: a silhouette, or (``section``) the cut across it.

    Up in the picture is the long one of the object's own axes (:func:`own_axes`), or the next where that is what is looked along: a
    turned object looked at along the turned direction gives the same picture.  The same direction gives the same picture, so that a
    contact's frame, whose z is the view's direction, tells in which picture it was found; the opposite one gives its mirror image. Raises
    ``BAD_MESH`` where there is nothing to see: a sheet seen edge-on, a cut that is empty.
    """
    _check(mesh)
    direction = transforms.unit(direction)
    axes, centroid = own_axes(mesh)
    up = axes[1] if abs(direction @ axes[0]) > 0.9 else axes[0]
    if kind == "section":
        y = transforms.unit((direction @ up) * direction - up)
        return _cut_across(mesh, pieces, centroid, np.cross(y, direction), y, size, confidence)
    return _drawn(mesh, direction, up, kind, size, confidence)


def as_it_stands(item: SceneObject, kind: str) -> CanonicalView:
    """The view of a kind of an object as it lies or stands: the published one, or drawn from its mesh where the kind differs."""
    return item.view if item.view.kind == kind else find_view(item.mesh, item.pieces, kind)


def same_direction(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two unit directions (3,) are one but for rounding: to a tenth of a degree."""
    return bool(a @ b > 1 - 1e-6)


def view_of_contact(item: SceneObject, kind: str, object_from_contact: NDArray[np.float64]) -> CanonicalView:
    """The view of a kind in which a contact with this frame (4, 4) was found: its z is the view's direction."""
    direction = object_from_contact[:3, 2]
    try:
        view = as_it_stands(item, kind)
        if same_direction(view.direction, direction):
            return view
    except MagicError as error:
        if error.code is not Code.BAD_MESH:
            raise
    return along(item.mesh, item.pieces, kind, direction)


def own_directions(mesh: Mesh, kind: str) -> NDArray[np.float64]:
    """Directions (K, 3) of an object's own shape in which it may have been meant to be seen, whatever its attitude, best first.

    Silhouettes: of the principal axes of the surface and of directions all over the sphere, those in which holes and
    notches show most, at most :data:`DIRECTIONS` and well apart; none for what is convex from everywhere.  A hole shows in the
    topology of the mask (:func:`holes_of`), how much it tells is its area.  ``section``: the three principal axes; a plane
    of symmetry is across one of them. They turn with the object; of a direction and its opposite, whose pictures mirror
    each other, the one nearer to :func:`own_axes` is given.
    """
    _check(mesh)
    axes = own_axes(mesh)[0]
    if kind == "section":
        return axes
    caster = Raycaster([mesh])
    # Fibonacci's spiral in the object's own axes.
    k = np.arange(_SPHERE) + 0.5
    height, angle = k / _SPHERE, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - height**2)
    tried = np.concatenate([axes, np.column_stack([across * np.cos(angle), across * np.sin(angle), height]) @ axes])
    told = _told(caster, mesh, tried, axes)
    found: list[NDArray[np.float64]] = []
    # Summits alone: the slopes of one show the same, only worse.
    near = np.abs(tried @ tried.T) > np.cos(0.8 * _APART)
    left = (told > _PLAIN) & (told >= np.where(near, told, 0.0).max(axis=1))
    while left.any() and len(found) < DIRECTIONS:
        best = int(np.argmax(np.where(left, told, -1.0)))
        direction, value = _refined(caster, mesh, tried[best], axes)
        # Shapes with a plane of symmetry are told best across it, exactly along an axis.
        nearest = int(np.argmax(np.abs(axes @ direction)))
        if abs(axes[nearest] @ direction) > np.cos(0.5 * _APART) and told[nearest] >= 0.9 * value:
            direction = axes[nearest]
        if all(abs(direction @ other) < np.cos(_APART) for other in found):
            found.append(direction)
        left &= (np.abs(tried @ direction) < np.cos(_APART)) & (np.abs(tried @ tried[best]) < np.cos(_APART))
    chosen = np.array(found).reshape(-1, 3)
    along_axes = chosen @ axes.T
    largest = np.take_along_axis(along_axes, np.abs(along_axes).argmax(axis=1)[:, None], axis=1)
    return chosen * np.where(largest < 0, -1.0, 1.0)


def square_axis(mesh: Mesh, direction: ArrayLike, kind: str) -> NDArray[np.float64] | None:
    """The principal axis (3,) of an object's surface along which, or against which, a direction (3,) looks,
    to 12 degrees; ``None`` where it is askew.

    What is seen askew is drawn shorter than it is, and a contact found there lies beside the surface.  A section is square
    only if the object is as heavy on one side of the plane as on the other, which a spoon is across its plane of symmetry alone.
    """
    direction = transforms.unit(direction)
    axes, centroid = own_axes(mesh)
    nearest = int(np.abs(axes @ direction).argmax())
    if abs(axes[nearest] @ direction) < np.cos(0.5 * _APART):
        return None
    if kind == "section":
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) + 1e-15
        across = (corners.mean(axis=1) - centroid) @ direction
        second, third = (float(np.average(across**n, weights=area)) for n in (2, 3))
        if abs(third) >= _SKEW * second**1.5:
            return None
    return axes[nearest]


def square_view(item: SceneObject, view: CanonicalView, kind: str) -> CanonicalView | None:
    """The view along the principal axis to which a view of an object is square, drawn in the object's own axes; ``None`` where it is askew.

    Where nothing can be drawn along the axis it is the view itself.
    """
    axis = square_axis(item.mesh, view.direction, kind)
    if axis is None:
        return None
    try:
        return along(item.mesh, item.pieces, kind, axis, confidence=view.confidence)
    except MagicError as error:
        if error.code is not Code.BAD_MESH:
            raise
        return view


def own_views(
    mesh: Mesh, pieces: Sequence[Mesh] | None, kind: str, apart_from: ArrayLike | None = None, size: int = VIEW_SIZE
) -> list[CanonicalView]:
    """The views of a kind along :func:`own_directions`, but for those that show what ``apart_from`` (3,) shows already.

    What tells of no direction is seen along its principal axes.
    """
    directions = own_directions(mesh, kind)
    if not len(directions):
        directions = own_axes(mesh)[0][::-1]
    if apart_from is not None:
        known = transforms.unit(apart_from)
        directions = directions[np.abs(directions @ known) < np.cos(0.4 * _APART)]
    result = []
    for direction in directions:
        try:
            result.append(along(mesh, pieces, kind, direction, size, 0.5))
        except MagicError as error:
            if error.code is not Code.BAD_MESH:
                raise
    return result


def _told(caster: Raycaster, mesh: Mesh, directions: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much the silhouettes along directions (D, 3) tell; the pictures turn with the object's own axes (3, 3)."""
    up = np.where((np.abs(directions @ axes[0]) > 0.9)[:, None], axes[1], axes[0])
    return np.array([_tells(mask) for mask in _silhouettes(caster, mesh, directions, up)[0]])


def _refined(caster: Raycaster, mesh: Mesh, direction: NDArray[np.float64], axes: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The direction near the given one that tells most, from a parabola through what its neighbours tell, and how much it tells."""
    value = 0.0
    for reach in np.deg2rad([10.0, 5.0]):
        x = transforms.unit(np.cross(direction, axes[int(np.argmin(np.abs(axes @ direction)))]))
        y = np.cross(direction, x)
        angle = np.arange(6) * np.pi / 3
        steps = reach * np.concatenate([np.zeros((1, 2)), np.column_stack([np.cos(angle), np.sin(angle)])])
        around = direction + steps @ np.array([x, y])
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        told = _told(caster, mesh, around, axes)
        u, v = (steps / reach).T
        a, b, c, d, e, value = np.linalg.lstsq(np.column_stack([u * u, v * v, u * v, u, v, np.ones(7)]), told, rcond=None)[0]
        bend = np.array([[2 * a, c], [c, 2 * b]])
        if np.linalg.eigvalsh(bend)[-1] < -1e-6:  # a summit
            move = np.linalg.solve(bend, [-d, -e])
            move /= max(1.0, float(np.hypot(*move)))
        else:
            move = (steps / reach)[int(np.argmax(told))]
        direction = transforms.unit(direction + reach * move @ np.array([x, y]))
        value = float(told.max())
    return direction, value


def own_axes(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The principal axes (3, 3) of a mesh's surface as rows, the longest first, right-handed, and its centroid (3,).

    They turn with the mesh: an axis points to where the surface reaches farther out (its third moment is positive).  Two of them settle
    the third; along an axis across which the surface is symmetric either way is the same.
    """
    return mesh.principal_axes


def mirrored(view: CanonicalView) -> CanonicalView:
    """The silhouette as seen from behind: the mirror image, for the opposite direction.  The picture remains that
    of the front, the depth is not known."""
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    image, mask = (np.ascontiguousarray(a[:, ::-1]) for a in (view.image, view.mask))
    return replace(view, image=image, mask=mask, depth=None, object_from_view=view.object_from_view @ behind)


def _check(mesh: Mesh) -> None:
    if len(mesh.faces) == 0:
        raise MagicError(Code.BAD_MESH, "mesh to look at", "no faces", "at least one triangle")
    if float(mesh.extents.max()) < 1e-6:
        raise MagicError(Code.BAD_MESH, "size of the mesh to look at", f"{float(mesh.extents.max()):.1e} m", "more than a point")


def mesh_of_cloud(points: NDArray[np.float64], colors: NDArray[np.uint8] | None = None, spacing: float | None = None) -> Mesh:
    """A cloud (N, 3) with colours (N, 3) as small octahedra, so that it can be looked at like a mesh: neighbours touch, holes stay open.

    ``spacing`` metres between points; found from the cloud if not given, and thinned to it.  Raises
    ``BAD_MESH`` for fewer than 10 finite points.
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
    if not hit.any():
        raise MagicError(Code.BAD_MESH, "silhouette of the mesh", "empty", "a mesh with some thickness")
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
    """The masks (D, P, P) of a mesh seen along directions (D, 3), and their metres per pixel (D,); up (3,), or (D, 3) one for each."""
    count = len(directions)
    y = -(up - np.sum(directions * up, axis=1, keepdims=True) * directions)
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
    if not masks.any(axis=(1, 2)).all():
        raise MagicError(Code.BAD_MESH, "silhouette of the mesh from the side", "empty", "a mesh with some thickness")
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


def _plan(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The unit long principal axis (3,), level, and the centroid (3,) of a mesh's area as seen from above.

    For a thing with an upright plane of symmetry along it (a spoon) the plane contains this axis, which does not hold
    for the side of the smallest box.
    """
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
    axis, centre = _plan(mesh)
    side = np.array([-axis[1], axis[0], 0.0])
    lateral = (mesh.vertices - centre) @ side
    along_axis = (mesh.vertices - centre) @ axis
    # The wider end, where the bowl is, goes to the right.
    half = (along_axis.min() + along_axis.max()) / 2
    if np.ptp(lateral[along_axis < half], axis=0) > np.ptp(lateral[along_axis >= half], axis=0):
        axis = -axis
    confidence = float(np.clip(1 - np.ptp(mesh.vertices[:, 2]) / max(np.ptp(along_axis), 1e-9), 0.2, 1.0))
    return _cut_across(mesh, pieces, centre, axis, np.array([0.0, 0.0, -1.0]), size, confidence)


def _cut_across(
    mesh: Mesh,
    pieces: Sequence[Mesh] | None,
    centre: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    size: int,
    confidence: float,
) -> CanonicalView:
    """The cut through a point by the plane of x and y (3,), drawn filled with x to the right and y down."""
    import shapely

    shape = _cut(mesh, centre, x, y)
    if shape.is_empty and pieces:
        shape = shapely.union_all([_cut(piece, centre, x, y) for piece in pieces])
    if shape.is_empty:
        raise MagicError(Code.BAD_MESH, "section through the middle", "empty", "a mesh with an inside that the plane cuts")
    left, top, right, bottom = shape.bounds
    middle = np.array([(left + right) / 2, (top + bottom) / 2])
    scale = max(right - left, bottom - top, 1e-6) / (VIEW_FILL * size)
    mask = np.zeros((size, size), np.uint8)
    shift = 8
    for polygon in getattr(shape, "geoms", [shape]):
        if polygon.geom_type != "Polygon":
            continue
        rings = []
        for ring in (polygon.exterior, *polygon.interiors):
            p = (np.asarray(ring.coords) - middle) / scale + (size - 1) / 2
            rings.append(np.round(p * (1 << shift)).astype(np.int32))
        drawn = np.zeros_like(mask)
        cv2.fillPoly(drawn, rings, 1, shift=shift)
        mask |= drawn
    mask = mask.astype(bool)
    color = GREY if mesh.colors is None else np.median(mesh.colors, axis=0).astype(np.uint8)
    image = np.zeros((size, size, 3), np.uint8)
    image[mask] = np.maximum(color, 60)
    object_from_view = transforms.make(np.column_stack([x, y, np.cross(x, y)]), centre + middle[0] * x + middle[1] * y)
    return CanonicalView(image, mask, scale, object_from_view, "section", np.where(mask, np.float32(0), np.float32(np.nan)), confidence)


def _cut(mesh: Mesh, origin: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]) -> object:
    """The filled section (shapely) of a mesh by the plane through ``origin`` with axes x and y (3,); coordinates in metres along them."""
    import shapely

    cut = mesh.to_trimesh()
    cut.merge_vertices()
    segments = cut.section(plane_origin=origin, plane_normal=np.cross(x, y))
    if segments is None:
        return shapely.Polygon()
    rings = []
    for line in segments.discrete:
        if len(line) >= 4:
            ring = shapely.Polygon((line - origin) @ np.column_stack([x, y]))
            rings.append(ring if ring.is_valid else ring.buffer(0))
    rings.sort(key=lambda r: -r.area)
    shape = shapely.Polygon()
    for ring in rings:  # even-odd: what lies inside of another ring is its hole
        shape = shape.symmetric_difference(ring)
    return shape
