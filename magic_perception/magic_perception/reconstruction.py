"""From what cameras saw of one thing to a closed solid with convex pieces.

Everything here is in the table frame: z = 0 is the table, z up.  The paper projects the points to the table,
takes their alpha shape and pulls it up (:func:`as_in_paper`).  :func:`reconstruct` does better where that fails:

* balls and upright cylinders are recognised by their residual;
* flat things are carved: a cell of the table is part of the thing if the whole upright column above it, up to the
  measured thickness, falls into the thing's mask in every camera.  For a prism this is its visual hull; it takes its
  sharpness from the colour image, not from depth, and a hole through which the table is seen stays open;
* things that lie become a height field on the table, or, where they are seen to be hollow from above (a spoon's
  bowl), a shell;
* things that stand on a round body (mugs, cans, bottles) become a body of revolution, open at the top where the
  inside was seen, with the handle carved in its own upright plane in the same way as a flat thing;
* other standing things are stacked from layers, completed by point symmetry where no camera saw through the completion.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate
from magic_core.rendering import Raycaster
from magic_perception import clusters, polygons, primitives
from magic_perception.parameters import Parameters
from magic_perception.segmentation import open_by_two


@dataclass(frozen=True)
class Sight:
    """One camera's view of one thing.

    mask (H, W) bool: the thing; hidden (H, W) bool: something else in front may hide it, so that a miss there says nothing.
    depth (H, W) float32 metres, NaN none; heights (H, W) float32 above the table; sigma: noise of the heights at the thing.
    """

    intrinsics: Intrinsics
    table_from_camera: NDArray[np.float64]
    mask: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    depth: NDArray[np.float32]
    heights: NDArray[np.float32]
    sigma: float

    @cached_property
    def _soft(self) -> NDArray[np.float32]:
        return self.mask.astype(np.float32)

    @cached_property
    def _blind(self) -> NDArray[np.uint8]:
        return self.hidden.astype(np.uint8)

    @property
    def eye(self) -> NDArray[np.float64]:
        """(3,): where the camera is."""
        return self.table_from_camera[:3, 3]

    def sample(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32], NDArray[np.float32]]:
        """At points (..., 3): the mask (0..1, interpolated; 1 where blind), where the picture tells nothing (hidden or
        outside of it), the points' depth and the measured depth."""
        camera = transforms.apply(transforms.inverse(self.table_from_camera), points)
        pixels = np.nan_to_num(self.intrinsics.project(camera), nan=-1e4)
        u, v = pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
        shape = u.shape
        # OpenCV's remap takes pictures of less than 32768 rows and columns.
        rows = -(-u.size // 8192)
        u, v = (np.resize(x, (rows, 8192)) if rows > 1 else x.reshape(1, -1) for x in (u, v))
        count = int(np.prod(shape))

        def at(field: NDArray, how: int, beyond: float) -> NDArray:
            return cv2.remap(field, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=beyond).ravel()[:count].reshape(shape)

        blind = at(self._blind, cv2.INTER_NEAREST, 1.0) > 0
        inside = np.where(blind, np.float32(1), at(self._soft, cv2.INTER_LINEAR, 1.0))
        return inside, blind, camera[..., 2].astype(np.float32), at(self.depth, cv2.INTER_NEAREST, float("nan"))


@dataclass(frozen=True)
class Reconstruction:
    """mesh and convex pieces in the table frame; ``shape`` names how they came about; confidence 0..1."""

    mesh: Mesh
    pieces: tuple[Mesh, ...]
    shape: str
    confidence: float


@dataclass(frozen=True)
class _Grid:
    """An upright height map: origin (2,) of cell (0, 0)'s centre, cell size, top (rows, columns) metres, NaN empty."""

    origin: NDArray[np.float64]
    cell: float
    top: NDArray[np.float32]

    def centres(self) -> NDArray[np.float64]:
        """(rows, columns, 2): x, y of the cells."""
        rows, columns = self.top.shape
        y, x = np.mgrid[0:rows, 0:columns]
        return np.stack([x, y], axis=-1) * self.cell + self.origin


def surface(sight: Sight, upsample: int = 2) -> NDArray[np.float64]:
    """The thing's visible surface as points (N, 3), also where depth is missing in the mask, twice as dense as the pixels.

    Heights are filled from the nearest pixel and smoothed in the mask; each point is where its pixel's ray reaches its height.
    """
    rows, columns = np.nonzero(sight.mask)
    if len(rows) == 0:
        return np.zeros((0, 3))
    pad = 3
    r0, r1 = max(rows.min() - pad, 0), min(rows.max() + pad + 1, sight.mask.shape[0])
    c0, c1 = max(columns.min() - pad, 0), min(columns.max() + pad + 1, sight.mask.shape[1])
    mask = sight.mask[r0:r1, c0:c1]
    heights = sight.heights[r0:r1, c0:c1]
    known = mask & np.isfinite(heights)
    if known.sum() < 5:
        return np.zeros((0, 3))
    distance, index = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    value = np.zeros(int(index.max()) + 1, np.float32)
    value[index[known]] = heights[known]
    filled = cv2.medianBlur(value[index], 5)
    mask = mask & (distance < 12)
    if upsample > 1:
        size = (mask.shape[1] * upsample, mask.shape[0] * upsample)
        mask = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
        filled = cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR)
    v, u = np.nonzero(mask)
    h = filled[v, u]
    u = (u + 0.5) / upsample - 0.5 + c0
    v = (v + 0.5) / upsample - 0.5 + r0
    k = sight.intrinsics
    rays = np.column_stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(len(u))]) @ sight.table_from_camera[:3, :3].T
    down = np.minimum(rays[:, 2], -1e-3)
    points = sight.eye + rays * ((h - sight.eye[2]) / down)[:, None]
    # A grazing ray turns a small error of height into a large one in the plane.
    return points[np.linalg.norm(points - sight.eye, axis=1) < 4.0]


def _height_map(points: NDArray[np.float64], cell: float, margin: int = 4) -> _Grid:
    low = points[:, :2].min(axis=0) - margin * cell
    size = np.ceil((points[:, :2].max(axis=0) - low) / cell).astype(int) + margin + 1
    if size.max() > 1200:
        raise MagicError(
            Code.RECONSTRUCTION_FAILED, "extent of one object in metres", np.round(size * cell, 2).tolist(), f"below {1200 * cell}"
        )
    index = np.round((points[:, :2] - low) / cell).astype(int)
    flat = index[:, 1] * size[0] + index[:, 0]
    order = np.argsort(points[:, 2], kind="stable")
    top = np.full(size[0] * size[1], np.nan, np.float32)
    top[flat[order]] = points[order, 2]  # the last, highest, wins
    top = top.reshape(size[1], size[0])
    occupied = np.isfinite(top).astype(np.uint8)
    closed = cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    closed = open_by_two(closed > 0)
    filled = _nearest(top, occupied > 0)
    filled = cv2.medianBlur(filled, 5)
    return _Grid(low, cell, np.where(closed, filled, np.nan).astype(np.float32))


def _nearest(values: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Values everywhere: where unknown, those of the nearest known cell."""
    if not known.any():
        return np.zeros_like(values)
    _, index = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(int(index.max()) + 1, np.float32)
    table[index[known]] = values[known]
    return table[index]


def _carve(
    sights: list[Sight], columns: list[NDArray[np.float64]], see_through: float | None = None, weights: list[float] | None = None
) -> NDArray[np.float32]:
    """Occupancy (rows, columns) 0..1 of cells, given the points (rows, columns, 3) of each cell's column: mean over cameras of the least mask.

    With ``see_through`` metres a camera that measured depth farther than that behind a cell saw it empty, and one
    that measured depth nearer than that before it says nothing.
    """
    total = np.zeros(columns[0].shape[:2], np.float32)
    weight = np.zeros_like(total)
    for sight, trust in zip(sights, weights or [1.0] * len(sights), strict=True):
        least = np.ones_like(total)
        blind = np.zeros(total.shape, bool)
        for points in columns:
            inside, unseen, z, measured = sight.sample(points)
            blind |= unseen
            if see_through is not None:
                with np.errstate(invalid="ignore"):
                    inside = np.where(measured > z + see_through, 0, inside)
                    behind = measured < z - see_through
                blind |= behind
                inside = np.where(behind, 1, inside)
            least = np.minimum(least, inside)
        share = np.where(blind & (least > 0.5), 0.05 * trust, trust).astype(np.float32)
        total += share * least
        weight += share
    return total / np.maximum(weight, 1e-6)


# ---------------------------------------------------------------- the whole


def reconstruct(sights: list[Sight], parameters: Parameters) -> Reconstruction:
    """The solid of one thing from all cameras that saw it.  Raises ``RECONSTRUCTION_FAILED`` where there is too little."""
    clouds = [surface(sight) for sight in sights]
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    eyes = np.repeat([sight.eye for sight in sights], [len(c) for c in clouds], axis=0)
    keep = points[:, 2] > -0.01
    points, eyes = points[keep], eyes[keep]
    if len(points) < 50:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "points of one object", len(points), "at least 50")
    points[:, 2] = np.maximum(points[:, 2], 0)
    noise = float(np.median([s.sigma for s in sights]))
    if parameters.method == "paper":
        return as_in_paper(points)
    height = float(np.percentile(points[:, 2], 98))
    found = _primitive(points, height, noise)
    if found is not None:
        return found
    spread = points[:, :2] - points[:, :2].mean(axis=0)
    axes = np.linalg.svd(spread[:: max(1, len(spread) // 4000)], full_matrices=False)[2]
    # Without the outermost half percent: one stray ray must not lay a mug down.
    length = float(np.max(np.subtract(*np.percentile(spread @ axes.T, [99.5, 0.5], axis=0))))
    if height > 0.04 and height > 0.45 * length:
        turned = _standing_round(sights, points, eyes, height, noise, parameters)
        fit = _agreement(turned.mesh, sights) if turned is not None else 0.0
        if turned is not None and fit > 0.8:
            return turned
        if height < 0.65 * length:  # a ladle's stem rises, but it lies
            return _lying(sights, points, height, noise, parameters)
        if turned is None:
            return _layers(sights, points, height, parameters)
        # It does not look as what was seen does: a hoop or a bent wire taken for a body.
        stacked = _layers(sights, points, height, parameters)
        other = _agreement(stacked.mesh, sights)
        better = turned if fit >= other else stacked
        return replace(better, confidence=better.confidence * max(fit, other))
    return _lying(sights, points, height, noise, parameters)


def _agreement(mesh: Mesh, sights: list[Sight], step: int = 3) -> float:
    """Mean over the cameras of the overlap (intersection over union) of a mesh's silhouette with the mask, every ``step``-th pixel."""
    caster = Raycaster([mesh])
    result = []
    for sight in sights:
        rows, columns = (np.nonzero(sight.mask.any(axis=axis))[0] for axis in (1, 0))
        pad = 24
        v = np.arange(max(rows[0] - pad, 0), min(rows[-1] + pad, sight.mask.shape[0]), step)
        u = np.arange(max(columns[0] - pad, 0), min(columns[-1] + pad, sight.mask.shape[1]), step)
        k = sight.intrinsics
        rays = (
            np.stack(np.broadcast_arrays(((u - k.cx) / k.fx)[None], ((v - k.cy) / k.fy)[:, None], 1.0), axis=-1)
            @ sight.table_from_camera[:3, :3].T
        )
        drawn = caster.hits(sight.eye, rays)
        mask, told = sight.mask[np.ix_(v, u)], ~sight.hidden[np.ix_(v, u)]
        result.append(np.count_nonzero(drawn & mask & told) / max(np.count_nonzero((drawn | mask) & told), 1))
    return float(np.mean(result))


def as_in_paper(points: NDArray[np.float64], alpha: float = 0.1, voxel: float = 0.005) -> Reconstruction:
    """The paper's completion: points projected to the table, their alpha shape, pulled up to the highest point.

    ``alpha`` and ``voxel`` are those of the authors' library; one piece, the hull of each part cut convexly.
    """
    thin, _ = clusters.thin(points, voxel)
    parts = polygons.alpha_shape(thin[:, :2], alpha)
    if not parts:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "alpha shape", "empty", "points that span an area")
    height = max(float(points[:, 2].max()), 0.002)
    return _extruded(parts[:1], height, "paper", 0.5)


def _extruded(parts: list[Polygon], height: float, shape: str, confidence: float, tolerance: float = 0.0004) -> Reconstruction:
    pieces = [polygons.prism(ring, 0.0, height) for part in parts for ring in polygons.convex_parts(part.simplify(0.0005), tolerance)]
    return Reconstruction(concatenate([polygons.extrude(part, 0.0, height) for part in parts]), tuple(pieces), shape, confidence)


# ---------------------------------------------------------------- balls and cylinders


def _primitive(points: NDArray[np.float64], height: float, noise: float) -> Reconstruction | None:
    if height < 0.012 or height > 0.3:
        return None
    sample = points[:: max(1, len(points) // 1500)]
    sample = sample[sample[:, 2] > min(0.004, 0.1 * height)]
    if len(sample) < 60:
        return None
    limit = max(0.0025, 2.5 * noise)
    ball = primitives.fit_sphere(sample)
    tin = primitives.fit_cylinder(sample)
    if ball is not None and not (
        0.006 < ball.radius < 0.12 and ball.residual < limit and abs(ball.centre[2] - ball.radius) < max(0.005, 0.2 * ball.radius)
    ):
        ball = None
    if tin is not None and not (tin.residual < limit and tin.radius < 0.08 and tin.height > 0.3 * tin.radius):
        tin = None
    if ball is not None and (tin is None or ball.residual < tin.residual):
        # It touches the table: its height above it is its radius, to which both measurements count.
        radius = (ball.radius + (ball.centre[2] + ball.radius) / 2) / 2
        ball = primitives.Sphere(np.array([*ball.centre[:2], radius]), radius, ball.residual)
        mesh = primitives.sphere_mesh(ball)
        return Reconstruction(mesh, (primitives.sphere_mesh(ball, 2),), "sphere", _trust(ball.residual, limit))
    if tin is not None:
        profile = np.array([[tin.radius, 0], [tin.radius, tin.height]])
        mesh = primitives.revolve(profile, tin.centre)
        return Reconstruction(mesh, (mesh,), "cylinder", _trust(tin.residual, limit))
    return None


def _trust(residual: float, limit: float) -> float:
    return float(np.clip(1.0 - 0.5 * residual / limit, 0.3, 1.0))


# ---------------------------------------------------------------- lying things


def _lying(sights: list[Sight], points: NDArray[np.float64], height: float, noise: float, parameters: Parameters) -> Reconstruction:
    grid = _height_map(points, parameters.resolution)
    occupied = np.isfinite(grid.top)
    inner = cv2.erode(occupied.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    # Heights along the middle lines: the round edge of a wire does not make it a relief.
    depth = cv2.distanceTransform(np.pad(occupied, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = occupied & (depth >= 0.85 * cv2.dilate(depth, np.ones((7, 7), np.uint8))) & (depth > 1.2)
    sample = grid.top[ridge] if ridge.sum() > 30 else grid.top[occupied]
    low, middle, high = np.percentile(sample, [8, 60, 96])
    flat = high - low < max(0.004, 0.2 * high, 3.0 * noise)
    centres = grid.centres()
    thickness = float(max(middle if flat else high, 0.002))
    if flat and thickness < 0.06:
        columns = [
            np.concatenate([centres, np.full((*centres.shape[:2], 1), z)], axis=-1)
            for z in np.linspace(0, thickness, 2 + int(thickness / 0.006))
        ]
        field = _carve(sights, columns)
        near = cv2.dilate(occupied.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7)))
        field = cv2.GaussianBlur(field * near, (0, 0), 0.8)
    else:
        columns = [np.concatenate([centres, np.nan_to_num(grid.top)[..., None]], axis=-1)]
        # The top of each cell must be seen; two pixels of grace for errors of height and calibration.
        seen = np.ones(occupied.shape, bool)
        for sight in sights:
            wide = Sight(
                sight.intrinsics,
                sight.table_from_camera,
                cv2.dilate(sight.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0,
                sight.hidden,
                sight.depth,
                sight.heights,
                sight.sigma,
            )
            seen &= wide.sample(columns[0])[0] > 0.3
        field = polygons.smooth_field(occupied & seen, 1.8)
    parts = [p for p in polygons.outline(field, grid.origin, grid.cell) if p.area > 4e-5]
    if not parts:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "outline of one object", "empty", "an area of at least 0.4 square centimetres")
    parts = [p for p in parts if p.area > 0.08 * parts[0].area]
    if flat:
        return _extruded(parts, thickness, "flat", 0.9)
    # Smooth over 3 mm, over the thing's own cells only.
    weight = cv2.GaussianBlur(occupied.astype(np.float32), (0, 0), 2.0)
    smooth = cv2.GaussianBlur(np.where(occupied, grid.top, 0).astype(np.float32), (0, 0), 2.0) / np.maximum(weight, 1e-6)
    top = _nearest(smooth.astype(np.float32), occupied)
    depression = _filled(np.where(occupied, top, 0)) - top
    hollow = (depression > max(0.004, 3 * noise)) & inner
    if hollow.sum() * grid.cell**2 > 1.5e-4:
        spread = int(np.ceil(parameters.wall / grid.cell / 2))
        # A bowl's wall is thin; a handle is taken to be about half as thick as it is wide.
        reach = 2 * int(0.012 / grid.cell) + 1
        width = 2 * grid.cell * cv2.dilate(depth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        thick = np.where(width < 0.03, np.clip(0.5 * width, parameters.wall, 0.012), parameters.wall).astype(np.float32)
        bottom = cv2.erode(top, np.ones((2 * spread + 1, 2 * spread + 1), np.uint8)) - cv2.GaussianBlur(thick, (0, 0), 3.0)
        bottom = np.clip(bottom, 0, top - 0.001)
        shape = "shell"
    else:
        bottom = np.zeros_like(top)
        shape = "height field"
    meshes, pieces = [], []
    for part in parts:
        meshes.append(_relief(part, grid, top, bottom))
        pieces += _relief_pieces(part, grid, top, bottom)
    return Reconstruction(concatenate(meshes), tuple(pieces), shape, 0.8)


def _filled(top: NDArray[np.float32]) -> NDArray[np.float32]:
    """A height map with its depressions filled to their lowest rim, in steps of a millimetre."""
    result = top.copy()
    for level in np.arange(0.001, float(top.max()) + 0.001, 0.001):
        above = (top >= level).astype(np.uint8)
        outside = np.pad(1 - above, 1, constant_values=1)
        cv2.floodFill(outside, None, (0, 0), 2)
        closed = outside[1:-1, 1:-1] == 1
        result[closed] = np.maximum(result[closed], level)
    return result


def _at(field: NDArray[np.float32], grid: _Grid, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """A field over the grid at points (N, 2), interpolated."""
    local = ((xy - grid.origin) / grid.cell).astype(np.float32)
    return cv2.remap(field, local[:, 0:1], local[:, 1:2], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0].astype(float)


def _relief(part: Polygon, grid: _Grid, top: NDArray[np.float32], bottom: NDArray[np.float32], step: float = 0.003) -> Mesh:
    """The solid between two height maps over a polygon: Delaunay over its rings and a lattice inside, with walls; watertight."""
    from scipy.spatial import Delaunay

    ring = polygons.ring_points(part, step * 0.8)
    x0, y0, x1, y1 = part.bounds
    y, x = np.mgrid[y0:y1:step, x0:x1:step]
    lattice = np.column_stack([x.ravel(), y.ravel()])
    lattice = lattice[shapely.contains_xy(part.buffer(-0.6 * step), lattice)]
    flat = np.concatenate([ring, lattice])
    faces = Delaunay(flat).simplices.astype(np.int64)
    middle = flat[faces].mean(axis=1)
    p = flat[faces]
    turn = (p[:, 1, 0] - p[:, 0, 0]) * (p[:, 2, 1] - p[:, 0, 1]) - (p[:, 1, 1] - p[:, 0, 1]) * (p[:, 2, 0] - p[:, 0, 0])
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    faces = faces[shapely.contains_xy(part, middle) & (np.abs(turn) > 1e-12)]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    flat = flat[used]
    n = len(flat)
    high = np.maximum(_at(top, grid, flat), 0.001)
    low = np.minimum(_at(bottom, grid, flat), high - 0.001)
    vertices = np.concatenate([np.column_stack([flat, low]), np.column_stack([flat, high])])
    return Mesh(vertices, np.concatenate([faces[:, ::-1], faces + n, *polygons._walls(faces, n)]))


def _relief_pieces(
    part: Polygon, grid: _Grid, top: NDArray[np.float32], bottom: NDArray[np.float32], tolerance: float = 0.002, least: float = 0.011
) -> list[Mesh]:
    """Convex hulls over a convex partition of a polygon, cut on until both surfaces are flat to ``tolerance`` or the cell is ``least`` wide;
    then neighbours are joined again where that fills little."""
    clouds = []
    queue = [(Polygon(ring), 0) for ring in polygons.convex_parts(part.simplify(0.001), 0.001)]
    while queue:
        cell, depth = queue.pop()
        box = np.array(cell.bounds)
        size = box[2:] - box[:2]
        n = np.maximum(np.ceil(size / 0.0025).astype(int), 2)
        y, x = np.meshgrid(np.linspace(box[1], box[3], n[1]), np.linspace(box[0], box[2], n[0]), indexing="ij")
        lattice = np.column_stack([x.ravel(), y.ravel()])
        lattice = lattice[shapely.contains_xy(cell, lattice)]
        xy = np.concatenate([np.asarray(cell.exterior.coords)[:-1], lattice])
        high, low = np.maximum(_at(top, grid, xy), 0.001), _at(bottom, grid, xy)
        if depth < 10 and size.max() > least and max(_bend(xy, high), _bend(xy, low)) > tolerance:
            long = int(np.argmax(size))
            half = (box[long] + box[long + 2]) / 2
            first, second = box.copy(), box.copy()
            first[long + 2], second[long] = half, half
            for b in (first, second):
                queue += [(p, depth + 1) for p in polygons.parts_of(shapely.clip_by_rect(cell, *b)) if p.area > 1e-6]
            continue
        low = np.minimum(low, high - 0.001)
        clouds.append(np.concatenate([np.column_stack([xy, low]), np.column_stack([xy, high])]))
    return _joined(clouds)


def _joined(clouds: list[NDArray[np.float64]], tolerance: float = 0.001, most: int = 40, limit: float = 0.0025) -> list[Mesh]:
    """Hulls of clouds (N, 3), neighbours joined, the pair that fills least first.

    Two are joined where the volume that their common hull fills, over half of its surface, is at most ``tolerance``
    metres; with more than ``most`` left the tolerance grows up to ``limit``.
    """
    import heapq

    from scipy.spatial import ConvexHull, QhullError

    def solid(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, float] | None:
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError):
            return None
        return points[hull.vertices], hull.volume, hull.area

    parts: dict[int, tuple[NDArray[np.float64], float, float]] = {}
    filled: dict[int, float] = {}
    boxes: dict[int, NDArray[np.float64]] = {}
    for cloud in clouds:
        made = solid(cloud)
        if made is not None:
            i = len(parts)
            parts[i], filled[i], boxes[i] = made, made[1], np.stack([made[0].min(axis=0), made[0].max(axis=0)])
    queue: list[tuple[float, int, int]] = []
    hulls: dict[tuple[int, int], tuple[NDArray[np.float64], float, float]] = {}

    def offer(i: int, others: list[int]) -> None:
        if not others:
            return
        box = np.stack([boxes[j] for j in others])
        near = np.all((box[:, 0] < boxes[i][1] + 5e-4) & (box[:, 1] > boxes[i][0] - 5e-4), axis=1)
        for j in np.array(others)[near].tolist():
            made = solid(np.concatenate([parts[i][0], parts[j][0]]))
            if made is not None:
                excess = (made[1] - filled[i] - filled[j]) / (made[2] / 2)
                if excess < limit:
                    hulls[i, j] = made
                    heapq.heappush(queue, (excess, i, j))

    for i in list(parts):
        offer(i, [j for j in parts if j > i])
    following = len(parts)
    while queue:
        excess, i, j = heapq.heappop(queue)
        made = hulls.pop((i, j))
        if i not in parts or j not in parts:
            continue
        if excess > tolerance and len(parts) <= most:
            break
        k, following = following, following + 1
        parts[k], filled[k], boxes[k] = made, filled[i] + filled[j], np.stack([made[0].min(axis=0), made[0].max(axis=0)])
        for gone in (i, j):
            del parts[gone], filled[gone], boxes[gone]
        offer(k, [m for m in parts if m != k])
    return [mesh for points, _, _ in parts.values() if (mesh := _hull(points)) is not None]


def _bend(xy: NDArray[np.float64], z: NDArray[np.float64]) -> float:
    """Largest distance of points (xy, z) from the plane that fits them best along z, perpendicular to it: a steep wall is flat too."""
    a = np.column_stack([xy - xy.mean(axis=0), np.ones(len(xy))])
    plane = np.linalg.lstsq(a, z, rcond=None)[0]
    return float(np.max(np.abs(a @ plane - z)) / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2))


def _hull(points: NDArray[np.float64]) -> Mesh | None:
    """The convex hull of points (N, 3), faces outward; ``None`` where they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = points[used]
    p = vertices[faces]
    normals = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    inward = np.sum(normals * hull.equations[:, :3], axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(vertices, faces)


# ---------------------------------------------------------------- standing things


@dataclass(frozen=True)
class _Body:
    """A round body: axis (2,), profile (K, 2) of radius and z from the table up, open at the top or not, or through and through (a band)."""

    axis: NDArray[np.float64]
    profile: NDArray[np.float64]
    open: bool
    through: bool = False

    def radius(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(z, self.profile[:, 1], self.profile[:, 0])


def _round_body(points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, seed: int) -> _Body | None:
    """The body of revolution on which most of the side points lie, or ``None``.

    x^2 + y^2 = 2 a x + 2 b y + q(z): linear in the axis (a, b) and in a parabola q, so that conical and bulged bodies fit at once.
    """
    index = np.nonzero((points[:, 2] > 0.08 * height) & (points[:, 2] < 0.94 * height))[0]
    if len(index) < 150:
        return None
    rng = np.random.default_rng(seed)
    index = index[rng.permutation(len(index))[:5000]]
    sample, eye = points[index], eyes[index]
    band = max(0.003, 2 * noise)
    slices = np.digitize(sample[:, 2], np.linspace(0, height, 9))
    members = [np.nonzero(slices == i)[0] for i in np.unique(slices)]
    members = [m for m in members if len(m) > 20]
    if not members:
        return None
    # Circles through three points of one level, all hypotheses at once.
    picked = np.stack([sample[members[i][rng.integers(len(members[i]), size=3)], :2] for i in rng.integers(len(members), size=160)])
    a = 2 * (picked[:, 1:] - picked[:, :1])
    rhs = np.sum(picked[:, 1:] ** 2, axis=2) - np.sum(picked[:, :1] ** 2, axis=2)
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    sound = np.abs(det) > 1e-7
    a, rhs, det, first = a[sound], rhs[sound], det[sound], picked[sound, 0]
    centres = (
        np.column_stack([rhs[:, 0] * a[:, 1, 1] - rhs[:, 1] * a[:, 0, 1], a[:, 0, 0] * rhs[:, 1] - a[:, 1, 0] * rhs[:, 0]]) / det[:, None]
    )
    radii = np.hypot(*(first - centres).T)
    sound = (radii > 0.01) & (radii < 0.12)
    centres, radii = centres[sound], radii[sound]
    if len(radii) == 0:
        return None
    few = sample[:1200]
    rho = np.hypot(few[:, 0] - centres[:, :1], few[:, 1] - centres[:, 1:])
    i = int(np.argmax(np.count_nonzero(np.abs(rho - radii[:, None]) < band * 1.5, axis=1)))
    best = (centres[i], radii[i])
    origin = best[0]
    # The inside of an open wall is seen beyond the axis: there the outward normal points away from the camera.
    out, ray = sample[:, :2] - origin, eye[:, :2] - sample[:, :2]
    cosine = np.sum(ray * out, axis=1) / np.maximum(np.linalg.norm(ray, axis=1) * np.linalg.norm(out, axis=1), 1e-9)
    inner_share = float(np.mean(cosine < 0))
    # At grazing incidence stereo rounds the silhouette off backwards, which would make the body wider.
    sample = sample[cosine > 0.35]
    near = np.abs(np.linalg.norm(sample[:, :2] - origin, axis=1) - best[1]) < max(0.008, 0.15 * best[1])
    axis, model = origin, None
    for width in (3 * band, 2 * band, 1.5 * band, 1.5 * band):
        p = sample[near]
        if len(p) < 60:
            return None
        local, z = p[:, :2] - origin, p[:, 2] / height
        matrix = np.column_stack([2 * local, np.ones(len(p)), z, z**2])
        model = np.linalg.lstsq(matrix, np.sum(local**2, axis=1), rcond=None)[0]
        axis = origin + model[:2]
        z = sample[:, 2] / height
        radius = np.sqrt(np.maximum(model[2] + model[3] * z + model[4] * z**2 + model[:2] @ model[:2], 1e-6))
        residual = np.linalg.norm(sample[:, :2] - axis, axis=1) - radius
        near = np.abs(residual) < width
    seen = sample[:, :2] - axis
    widest = max(float(np.ptp(seen @ np.array([np.cos(t), np.sin(t)]))) for t in np.linspace(0, np.pi, 12, endpoint=False))
    if 2 * float(np.median(radius)) > 1.12 * widest:
        return None  # a broad face bent a little, not a round body
    share = float(near.mean())
    angles = np.arctan2(*(sample[near, :2] - axis).T[::-1])
    coverage = np.unique(np.floor((angles + np.pi) / (2 * np.pi) * 36)).size / 36
    # What reaches beyond the body must be little: a box's corner reaches 0.4 r beyond its inscribed circle.
    if share < 0.5 or coverage < 0.28 or inner_share > 0.7:
        return None
    top = float(np.percentile(sample[near, 2], 99))
    around = points[np.abs(np.linalg.norm(points[:, :2] - axis, axis=1) - float(np.median(radius))) < 0.012]
    top = max(top, float(np.percentile(around[:, 2], 97)) if len(around) > 20 else top)
    levels = np.linspace(0, top, max(4, int(top / 0.008)) + 1)
    zs = levels / height
    radii = np.sqrt(np.maximum(model[2] + model[3] * zs + model[4] * zs**2 + model[:2] @ model[:2], 1e-6))
    rho = np.linalg.norm(sample[:, :2] - axis, axis=1)
    for i, level in enumerate(levels):
        here = rho[(np.abs(sample[:, 2] - level) < 0.006) & (np.abs(rho - radii[i]) < 2.5 * band)]
        if len(here) > 15:
            radii[i] = 0.5 * radii[i] + 0.5 * np.median(here)
    inside = points[np.linalg.norm(points[:, :2] - axis, axis=1) < 0.6 * radii[-1]]
    hollow = len(inside) > 25 and np.median(inside[:, 2]) < top - max(0.012, 0.15 * top)
    return _Body(axis, np.column_stack([radii, levels]), bool(hollow))


def _fit_to_silhouettes(body: _Body, sights: list[Sight], reach: float = 0.008) -> _Body:
    """The body moved and scaled to the masks' edges, which the colour image puts to a pixel, where depth rounds them off.

    At each level the two tangent rays of every camera tell the radius on the camera's left and right; where both are
    seen, half of their difference moves the axis sideways.  A side without an edge near (a handle) says nothing.  The
    far rim's upper edge tells the height.
    """
    axis, profile = body.axis, body.profile
    levels = profile[:, 1]
    inner = (levels > 0.1 * levels[-1]) & (levels < 0.97 * levels[-1])
    steps = np.arange(-reach, reach + 2.5e-4, 5e-4)

    def crossing(values: NDArray[np.float32]) -> NDArray[np.float64]:
        """The offset (N,) at which rows of mask values (N, S) fall below a half once and for all; NaN where they do not."""
        below = values < 0.5
        index = below.argmax(axis=1)
        rows = np.arange(len(values))
        sound = below.any(axis=1) & (index > 0) & ~(~below & (np.arange(values.shape[1]) > index[:, None])).any(axis=1)
        before, after = values[rows, np.maximum(index - 1, 0)], values[rows, index]
        share = np.clip((before - 0.5) / np.maximum(before - after, 1e-6), 0, 1)
        return np.where(sound, steps[np.maximum(index - 1, 0)] + share * 5e-4, np.nan)

    for _ in range(2):
        radii = body.radius(levels)
        sides, moves = [], []
        for sight in sights:
            away = axis - sight.eye[:2]
            distance = max(float(np.linalg.norm(away)), 1e-6)
            away = away / distance
            right = np.array([away[1], -away[0]])
            found = []
            for sign in (-1, 1):
                rho = radii[:, None] + steps
                sine = np.clip(rho / distance, 0, 0.9)
                tangent = axis + rho[..., None] * (-sine[..., None] * away + sign * np.sqrt(1 - sine**2)[..., None] * right)
                inside, blind, _, _ = sight.sample(
                    np.concatenate([tangent, np.broadcast_to(levels[:, None, None], (*rho.shape, 1))], axis=2)
                )
                edge = crossing(inside)
                edge[blind.any(axis=1) | ~inner] = np.nan
                found.append(edge)
            middle = np.nanmedian(np.concatenate(found)) if np.isfinite(np.concatenate(found)).any() else 0.0
            # Where a handle begins its edge is taken for the body's.
            found = [np.where(np.abs(edge - middle) < 0.003, edge, np.nan) for edge in found]
            sides += found
            both = np.isfinite(found[0]) & np.isfinite(found[1])
            if both.sum() >= 2:
                moves.append((right, float(np.median((found[1] - found[0])[both]) / 2)))
        if moves:
            matrix = np.array([right for right, _ in moves] + [[0.05, 0], [0, 0.05]])
            axis = axis + np.linalg.lstsq(matrix, np.array([move for _, move in moves] + [0, 0]), rcond=None)[0]
        edges = np.stack(sides)
        told = np.isfinite(edges)
        if told.sum() >= 4:
            # A line, so that the mask's ragged edge does not ruffle the profile.
            where = np.broadcast_to(levels / levels[-1], edges.shape)[told]
            slope, offset = np.polyfit(where, edges[told], 1) if np.ptp(where) > 0.4 else (0.0, float(np.median(edges[told])))
            radii = np.maximum(radii + offset + slope * levels / levels[-1], 0.004)
            profile = np.column_stack([radii, levels])
        body = replace(body, axis=axis, profile=profile)
    tops = []
    for sight in sights:
        away = axis - sight.eye[:2]
        bearing = np.arctan2(away[1], away[0]) + np.linspace(-0.5, 0.5, 9)
        rim = axis + profile[-1, 0] * np.column_stack([np.cos(bearing), np.sin(bearing)])
        heights = profile[-1, 1] + steps
        spots = np.concatenate(
            [np.repeat(rim[:, None], len(steps), axis=1), np.broadcast_to(heights[None, :, None], (len(rim), len(steps), 1))], axis=2
        )
        inside, blind, _, _ = sight.sample(spots)
        edge = crossing(inside)
        edge[blind.any(axis=1)] = np.nan
        tops += edge[np.isfinite(edge)].tolist()
    if len(tops) >= 5:
        profile = profile.copy()
        profile[:, 1] *= 1 + float(np.median(tops)) / profile[-1, 1]
        body = replace(body, profile=profile)
    return body


def _standing_round(
    sights: list[Sight], points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, parameters: Parameters
) -> Reconstruction | None:
    body = _round_body(points, eyes, height, noise, parameters.seed)
    if body is None:
        return None
    if height > body.profile[-1, 1] + 0.012:
        return None
    body = _fit_to_silhouettes(body, sights)
    # Of a band some part of the table inside shows to some camera.
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    spots = np.array(
        [[[*(body.axis + f * body.profile[0, 0] * np.array([np.cos(t), np.sin(t)])), 0.001] for t in turns] for f in (0.2, 0.4, 0.6, 0.75)]
    )
    if max(float(np.mean(_carve([sight], [spots]) < 0.3)) for sight in sights) > 0.12:
        body = _Body(body.axis, body.profile, True, True)
    top = body.profile[-1, 1]
    away = points[:, :2] - body.axis
    rho = np.linalg.norm(away, axis=1)
    beyond = rho - body.radius(points[:, 2])
    out = points[beyond > max(0.005, 2.5 * noise)]
    over = points[(points[:, 2] > top + 0.012) & (beyond < 0)]
    if len(over) > 0.08 * len(points):
        return None  # more than a body of revolution with a flat end, a bottle's neck say
    handle = None
    if len(out) > 60:
        out = out[clusters.largest(out, 0.012, 4, 0.003)]
        reach = np.linalg.norm(out[:, :2] - body.axis, axis=1)
        if np.percentile(reach - body.radius(out[:, 2]), 95) > 0.010 and len(out) > 0.02 * len(points):
            handle = _handle(sights, out, body, parameters)
            if handle is None and len(out) > 0.15 * len(points):
                return None
        elif len(out) > 0.2 * len(points):
            return None
    wall = max(parameters.wall, 0.0035)
    mesh, pieces = _turned(body, wall)
    if handle is None:
        return Reconstruction(mesh, tuple(pieces), "round", 0.85)
    bars, handle_pieces = handle
    try:
        import trimesh

        joined = trimesh.boolean.union([mesh.to_trimesh(), *[b.to_trimesh() for b in bars]], engine="manifold")
        mesh = Mesh(joined.vertices, joined.faces)
    except Exception:  # the boolean library refuses a degenerate solid: overlapping closed parts still bound the same solid
        mesh = concatenate([mesh, *bars])
    return Reconstruction(mesh, tuple(pieces + handle_pieces), "round with handle", 0.85)


def _turned(body: _Body, wall: float, sectors: int = 16) -> tuple[Mesh, list[Mesh]]:
    """Mesh and convex pieces of a round body: a stack of frusta, or a floor and wall sectors where it is open."""
    profile = body.profile
    simple = np.asarray(shapely.LineString(profile).simplify(0.0008).coords)
    if not body.open or profile[:, 0].min() < 2.5 * wall:
        mesh = primitives.revolve(profile, body.axis)
        pieces = [primitives.revolve(simple[i : i + 2], body.axis, 24) for i in range(len(simple) - 1)]
        chord = np.interp(profile[:, 1], profile[[0, -1], 1], profile[[0, -1], 0])
        if np.all(profile[:, 0] > chord - 0.001) and np.all(np.diff(profile[:, 0], 2) < 0.0015):
            hull = _hull(primitives.revolve(simple, body.axis, 32).vertices)
            pieces = [hull] if hull is not None else pieces
        return mesh, pieces
    floor = 0.0 if body.through else min(0.006, 0.2 * profile[-1, 1])
    inner = np.column_stack([profile[:, 0] - wall, profile[:, 1]])
    pieces: list[Mesh] = []
    if body.through:
        mesh = primitives.turn_ring(np.vstack([profile, inner[::-1]]), body.axis)
    else:
        inner = np.vstack([[np.interp(floor, inner[:, 1], inner[:, 0]), floor], inner[inner[:, 1] > floor + 0.001]])
        mesh = primitives.revolve(np.vstack([profile, inner[::-1]]), body.axis)
        ends = np.array([[np.interp(z, simple[:, 1], simple[:, 0]), z] for z in (0.0, floor)])
        pieces.append(primitives.revolve(ends, body.axis, 24))
    levels = simple[:, 1].copy()
    levels[0] = floor
    levels = levels[(levels >= floor)]
    angles = np.linspace(0, 2 * np.pi, sectors + 1)
    for z0, z1 in itertools.pairwise(levels):
        outer0, outer1 = np.interp([z0, z1], simple[:, 1], simple[:, 0])
        for a, b in itertools.pairwise(angles):
            corners = [
                [body.axis[0] + r * np.cos(t), body.axis[1] + r * np.sin(t), z]
                for t in (a, b)
                for r, z in ((outer0, z0), (outer0 - wall, z0), (outer1, z1), (outer1 - wall, z1))
            ]
            hull = _hull(np.array(corners))
            if hull is not None:
                pieces.append(hull)
    return mesh, pieces


def _handle(sights: list[Sight], out: NDArray[np.float64], body: _Body, parameters: Parameters) -> tuple[list[Mesh], list[Mesh]] | None:
    """A handle as bars in the upright plane through the body's axis: meshes and convex pieces, or ``None`` if nothing is left after carving."""
    local = out[:, :2] - body.axis
    direction = local.mean(axis=0)
    angle = float(np.arctan2(direction[1], direction[0]))
    for _ in range(3):
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        low, high = np.percentile(local @ across, [4, 96])
        angle += float(np.arctan2((low + high) / 2, np.median(local @ along)))
    thickness = float(np.clip(high - low, 0.005, 0.03))
    along = np.array([np.cos(angle), np.sin(angle)])
    e_s, e_z = np.array([*along, 0.0]), np.array([0.0, 0.0, 1.0])
    e_n = np.cross(e_s, e_z)
    cell = 0.001
    reach = float(np.percentile(local @ along, 99.5))
    start = float(body.profile[:, 0].min()) - 0.004
    top = float(max(body.profile[-1, 1], np.percentile(out[:, 2], 99))) + 0.004
    s = np.arange(start, reach + 0.006, cell)
    z = np.arange(0.0, top, cell)
    grid_s, grid_z = np.meshgrid(s, z)
    base = np.array([*body.axis, 0.0])
    plane = base + grid_s[..., None] * e_s + grid_z[..., None] * e_z
    facing = [
        abs(float((plane.mean(axis=(0, 1)) - sight.eye) @ e_n)) / np.linalg.norm(plane.mean(axis=(0, 1)) - sight.eye) for sight in sights
    ]
    useful = [sight for sight, f in zip(sights, facing, strict=True) if f > 0.25]
    splat = np.zeros(grid_s.shape, np.uint8)
    column = np.round((local @ along - start) / cell).astype(int)
    row = np.round(out[:, 2] / cell).astype(int)
    good = (column >= 0) & (column < len(s)) & (row >= 0) & (row < len(z))
    splat[row[good], column[good]] = 1
    near = cv2.dilate(splat, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13))) > 0
    if useful:
        # Half of the thickness, so that a few degrees of error in the plane do not eat thin bars.
        columns = [plane + n * e_n for n in np.linspace(-thickness / 4, thickness / 4, 3)]
        field = _carve(useful, columns, max(0.02, 1.5 * thickness), [f**2 for f in facing if f > 0.25])
    else:
        field = cv2.morphologyEx(splat, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))).astype(np.float32)
    within = grid_s < body.radius(grid_z)
    attach = within & (grid_s > body.radius(grid_z) - 0.0025) & (grid_z < body.profile[-1, 1])
    solid = (field > 0.5) & near & ~within
    # Where the bar meets the body its points are few: join them over 5 mm.
    reachable = cv2.dilate(attach.astype(np.uint8), np.ones((1, 11), np.uint8)) > 0
    solid |= reachable & (field > 0.5) & ~within & (cv2.dilate(solid.astype(np.uint8), np.ones((5, 11), np.uint8)) > 0)
    touching = attach & (cv2.dilate(solid.astype(np.uint8), np.ones((3, 7), np.uint8)) > 0)
    solid |= touching
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    parts = [
        p for p in polygons.outline(polygons.smooth_field(solid > 0, 1.2), np.array([start, 0.0]), cell, simplify=0.0004) if p.area > 3e-5
    ]
    # Only what reaches farther out than noise is a handle.
    parts = [p for p in parts if p.bounds[2] - float(body.radius(np.array((p.bounds[1] + p.bounds[3]) / 2))) > 0.008]
    if not parts:
        return None
    frame = transforms.make(np.column_stack([e_s, e_z, e_n]), base)
    bars = [polygons.extrude(p, -thickness / 2, thickness / 2).transformed(frame) for p in parts]
    pieces = [
        polygons.prism(ring, -thickness / 2, thickness / 2).transformed(frame)
        for p in parts
        for ring in polygons.convex_parts(p.simplify(0.0006), 0.0005)
    ]
    return bars, pieces


def _silhouette(sight: Sight, middle: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The thing's mask carried on to the upright plane through ``middle`` (2,) that faces the camera.

    Returns the horizontal unit vectors (2,) away from the camera and to its right, and points (N, 2) on the silhouette's
    left and right edges, row by row: distance to the right of ``middle``, height.
    """
    away = middle - sight.eye[:2]
    away = away / max(np.linalg.norm(away), 1e-9)
    right = np.array([away[1], -away[0]])
    rows = np.nonzero(sight.mask.any(axis=1))[0]
    first = sight.mask[rows].argmax(axis=1)
    last = sight.mask.shape[1] - 1 - sight.mask[rows, ::-1].argmax(axis=1)
    k = sight.intrinsics
    edges = []
    for u in (first - 0.5, last + 0.5):
        rays = np.column_stack([(u - k.cx) / k.fx, (rows - k.cy) / k.fy, np.ones(len(rows))]) @ sight.table_from_camera[:3, :3].T
        scale = ((middle - sight.eye[:2]) @ away) / np.maximum(rays[:, :2] @ away, 1e-6)
        points = sight.eye + rays * scale[:, None]
        edges.append(np.column_stack([(points[:, :2] - middle) @ right, points[:, 2]]))
    return away, right, np.concatenate(edges)


def _middle(sights: list[Sight], fronts: list[NDArray[np.float64]], start: NDArray[np.float64], height: float) -> NDArray[np.float64]:
    """The upright axis (2,) of a standing thing: where the cameras' silhouettes have their middles, and, along each camera's
    direction, where the seen fronts bend back to the silhouette's edges as the arcs of an ellipse do."""
    middle = start
    for _ in range(3):
        matrix, value = [], []
        for sight, points in zip(sights, fronts, strict=True):
            away, right, edges = _silhouette(sight, middle)
            band = edges[(edges[:, 1] > 0.15 * height) & (edges[:, 1] < 0.85 * height), 0]
            if len(band) < 6 or len(points) < 30:
                continue
            low, high = np.median(band[: len(band) // 2]), np.median(band[len(band) // 2 :])
            matrix.append(right)
            value.append(right @ middle + (low + high) / 2)
            part = points[(points[:, 2] > 0.15 * height) & (points[:, 2] < 0.85 * height)]
            across = ((part[:, :2] - middle) @ right - (low + high) / 2) / max((high - low) / 2, 1e-3)
            inner = np.abs(across) < 0.92
            bulge = np.sqrt(1 - across[inner] ** 2)
            far, depth = np.linalg.lstsq(np.column_stack([np.ones(len(bulge)), -bulge]), (part[inner, :2] - middle) @ away, rcond=None)[0]
            # A flat front does not tell how thick the thing is: then as thick as a third of its width, at most as it is wide.
            half = (high - low) / 2
            depth = float(np.clip(depth, 0.33 * half, half))
            far = float(np.median((part[inner, :2] - middle) @ away + depth * bulge))
            matrix.append(0.4 * away)
            value.append(0.4 * (away @ middle + far))
        if not matrix:
            return middle
        matrix += [0.01 * np.array([1.0, 0]), 0.01 * np.array([0, 1.0])]
        value += (0.01 * middle).tolist()
        middle = np.linalg.lstsq(np.array(matrix), np.array(value), rcond=None)[0]
    return middle


def _layers(sights: list[Sight], points: NDArray[np.float64], height: float, parameters: Parameters) -> Reconstruction:
    """A standing thing of any form: convex outlines of layers, joined.

    A layer holds what was seen of it, away from the mask's edge, where depth is not to be trusted, and the same turned by
    half a turn about the upright axis, where no camera saw through that; the silhouettes bound its width.
    """
    fronts = []
    for sight in sights:
        inner = cv2.erode(sight.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        cloud = surface(replace(sight, mask=inner))
        fronts.append(cloud[cloud[:, 2] > -0.005])
    seen = np.concatenate(fronts)
    if len(seen) < 50:
        seen = points
    height = max(height, float(np.percentile(seen[:, 2], 99.5)))
    middle = _middle(sights, fronts, np.median(seen[:, :2], axis=0), height)
    mirrored = np.column_stack([2 * middle - seen[:, :2], seen[:, 2]])
    inside = np.ones(len(mirrored), bool)
    for sight in sights:
        shown, _, z, measured = sight.sample(mirrored)
        with np.errstate(invalid="ignore"):
            inside &= ~((shown < 0.3) | (measured > z + 0.015))
    confidence = 0.7 if inside.mean() > 0.8 else 0.5
    everything = np.concatenate([seen, mirrored[inside]])
    views = [_silhouette(sight, middle) for sight in sights]
    count = int(np.clip(height / 0.008, 3, 24))
    levels = np.linspace(0, height, count + 1)
    turns = np.arange(_SIDES) * 2 * np.pi / _SIDES
    rings: list[NDArray[np.float64] | None] = []
    for z in levels:
        half = height / count / 2 + 0.002
        here = everything[np.abs(everything[:, 2] - np.clip(z, half, height - half)) < half, :2]
        for _, right, edges in views:
            row = edges[np.abs(edges[:, 1] - np.clip(z, half, height - half)) < half, 0]
            if len(row) > 1 and len(here):
                across = (here - middle) @ right
                here = here[(across > row.min() - 0.001) & (across < row.max() + 0.001)]
                if inside.mean() > 0.5:  # the edges themselves lie about beside the axis
                    here = np.vstack([here, middle + right * row.min(), middle + right * row.max()])
        rings.append(_ring(here, turns) if len(here) > 8 else None)
    known = [i for i, ring in enumerate(rings) if ring is not None]
    if not known:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "layers of one object", "empty", "points that span an area")
    loft = np.stack([rings[min(known, key=lambda j: abs(j - i))] for i in range(len(levels))])
    solid = np.concatenate([loft, np.repeat(levels[:, None, None], _SIDES, axis=1)], axis=2)
    return Reconstruction(_lofted(solid), tuple(_loft_pieces(solid)), "layers", confidence)


#: Corners of a layer's outline.
_SIDES = 40


def _ring(points: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The convex hull of points (N, 2) as a ring (len(turns), 2), its corners in fixed directions from the centroid; without the outermost 1 %."""
    centre = np.median(points, axis=0)
    reach = np.linalg.norm(points - centre, axis=1)
    hull = polygons.convex_hull(points[reach <= np.percentile(reach, 99)])
    if len(hull) < 3:
        return None
    outline = Polygon(hull)
    if outline.area < 1e-6:
        return None
    centre = np.asarray(outline.centroid.coords[0])
    local = hull - centre
    following = np.roll(local, -1, axis=0)
    edge = following - local
    # Ray t d meets the line through a corner along its edge: the least t over edges that face the direction.
    direction = np.column_stack([np.cos(turns), np.sin(turns)])
    normal = np.column_stack([edge[:, 1], -edge[:, 0]])
    facing = direction @ normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(facing > 1e-12, np.sum(normal * local, axis=1) / facing, np.inf)
    return centre + direction * t.min(axis=1)[:, None]


def _lofted(rings: NDArray[np.float64]) -> Mesh:
    """The closed solid through rings (L, K, 3), counter-clockwise, from the bottom up."""
    levels, k = rings.shape[:2]
    i = np.arange(k)
    j = (i + 1) % k
    faces = []
    for row in range(levels - 1):
        a, b = row * k, (row + 1) * k
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(axis=0, keepdims=True), rings[-1].mean(axis=0, keepdims=True)])
    last = (levels - 1) * k
    faces.append(np.column_stack([np.full(k, levels * k), j, i]))
    faces.append(np.column_stack([np.full(k, levels * k + 1), last + i, last + j]))
    return Mesh(vertices, np.concatenate(faces))


def _loft_pieces(rings: NDArray[np.float64], tolerance: float = 0.004) -> list[Mesh]:
    """Convex hulls of runs of rings (L, K, 3): a run grows upwards as long as its hull keeps within ``tolerance`` metres of the rings in it."""
    pieces = []
    start = 0
    flat = rings[..., :2]
    area = np.array([polygons.area_of(ring) for ring in flat])
    perimeter = np.array([np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1).sum() for ring in flat])
    while start < len(rings) - 1:
        stop = start + 1
        while stop + 1 < len(rings):
            fits = True
            a, b = flat[start], flat[stop + 1]
            for row in range(start + 1, stop + 1):
                # The hull's section between the run's ends holds at least their blend.
                share = (row - start) / (stop + 1 - start)
                blend = polygons.area_of(polygons.convex_hull(np.concatenate([(1 - share) * a + share * b, flat[row]])))
                if blend - area[row] > tolerance * perimeter[row] / 2:
                    fits = False
                    break
            if not fits:
                break
            stop += 1
        hull = _hull(rings[start : stop + 1].reshape(-1, 3))
        if hull is not None:
            pieces.append(hull)
        start = stop
    return pieces
