"""Lying things: flat ones carved from the masks, others as a height field or a shell."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate
from magic_perception import polygons
from magic_perception.foreground import open_by_two
from magic_perception.parameters import Parameters
from magic_perception.percentiles import bounds
from magic_perception.sight import Sight, carve, surfaces
from magic_perception.solids import Reconstruction, extruded, joined

#: Empty cells about a height map.
BORDER = 4
#: Points of a relief's surface are so far apart, m.
LATTICE = 0.003
#: A cell of the partition of a relief is cut until both of its surfaces are flat to this (m), or it is no wider than the next.
FLAT_TO = 0.002
LEAST_CELL = 0.011


@dataclass(frozen=True)
class Grid:
    """An upright height map: origin (2,) of cell (0, 0)'s centre, cell size, top (rows, columns) metres, NaN empty."""

    origin: NDArray[np.float64]
    cell: float
    top: NDArray[np.float32]

    def centres(self) -> NDArray[np.float64]:
        """(rows, columns, 2): x, y of the cells."""
        rows, columns = self.top.shape
        y, x = np.mgrid[0:rows, 0:columns]
        return np.stack([x, y], axis=-1) * self.cell + self.origin


def height_map(points: NDArray[np.float64], cell: float) -> Grid:
    """The highest points (N, 3) over each cell; gaps of two cells closed, threads of one cell dropped."""
    low, high = bounds(points[:, :2])
    low = low - BORDER * cell
    size = np.ceil((high - low) / cell).astype(int) + BORDER + 1
    if size.max() > 1200:
        raise MagicError(
            Code.RECONSTRUCTION_FAILED, "extent of one object in metres", np.round(size * cell, 2).tolist(), f"below {1200 * cell}"
        )
    index = np.round((points[:, :2] - low) / cell).astype(int)
    flat = index[:, 1] * size[0] + index[:, 0]
    top = np.full(size[0] * size[1], -np.inf, np.float32)
    np.maximum.at(top, flat, points[:, 2].astype(np.float32))
    top[np.isneginf(top)] = np.nan
    top = top.reshape(size[1], size[0])
    occupied = np.isfinite(top).astype(np.uint8)
    closed = cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    closed = open_by_two(closed > 0)
    filled = nearest(top, occupied > 0)
    filled = cv2.medianBlur(filled, 5)
    return Grid(low, cell, np.where(closed, filled, np.nan).astype(np.float32))


def nearest(values: NDArray[np.float32], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Values everywhere: where unknown, those of the nearest known cell."""
    if not known.any():
        return np.zeros_like(values)
    _, index = cv2.distanceTransformWithLabels((~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    table = np.zeros(int(index.max()) + 1, np.float32)
    table[index[known]] = values[known]
    return np.take(table, index)


@dataclass(frozen=True)
class Laid:
    """A lying thing: its height map, the outlines of its parts, and whether it is flat, then ``thickness`` metres thick; else top and
    bottom (rows, columns) of its relief over the cells of the map, m; ``hollow``: it is seen to be hollow from above, and its bottom is
    that of a thin thing, else the table or the height below which cameras see past; ``thin``: what is not seen to be hollow from above
    taken for a thin thing nevertheless, as a bowl is that lies so far on its side that it would hold no water."""

    grid: Grid
    parts: list[Polygon]
    flat: bool
    thickness: float
    hollow: bool
    top: NDArray[np.float32]
    bottom: NDArray[np.float32]
    thin: Laid | None = None


def lay(sights: list[Sight], noise: float, parameters: Parameters) -> Laid:
    """What a lying thing is like, seen from above.  Raises ``RECONSTRUCTION_FAILED`` where nothing is left of its outline."""
    seen = surfaces(sights, 2)[0]
    points = seen[~_passed(seen, sights, noise)]
    if len(points) < 20:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "points of one object that no camera sees past", len(points), "at least 20")
    grid = height_map(points, parameters.resolution)
    occupied = np.isfinite(grid.top)
    inner = cv2.erode(occupied.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    # Heights along the middle lines: the round edge of a wire does not make it a relief.
    depth = cv2.distanceTransform(np.pad(occupied, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = occupied & (depth >= 0.85 * cv2.dilate(depth, np.ones((7, 7), np.uint8))) & (depth > 1.2)
    sample = grid.top[ridge] if ridge.sum() > 30 else grid.top[occupied]
    low, middle, high = np.percentile(sample, [8, 60, 96])
    flat = high - low < max(0.004, 0.2 * high, 3.0 * noise)
    thickness = float(max(middle if flat else high, 0.002))
    slim = flat and thickness < SLIM
    if slim:  # a rod is seen past by each of two cameras that do not agree to its width where it is
        grid = height_map(seen, parameters.resolution)
        occupied = np.isfinite(grid.top)
    centres = grid.centres()
    if flat and thickness < 0.06:
        near = cv2.dilate(occupied.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))) > 0
        spots = centres[near]
        levels = np.linspace(0, thickness, 2 + int(thickness / 0.006))
        field = np.zeros(near.shape, np.float32)
        field[near] = carve(sights, [np.column_stack([spots, np.full(len(spots), z)])[:, None] for z in levels])[:, 0]
        field = cv2.GaussianBlur(field, (0, 0), 0.8)
        if slim:
            field = np.maximum(field, polygons.smooth_field(_lost(sights, grid, field > 0.5), 0.8))
    else:
        # Smooth over 3 mm, over the thing's own cells only.
        weight = cv2.GaussianBlur(occupied.astype(np.float32), (0, 0), 2.0)
        smooth = cv2.GaussianBlur(np.where(occupied, grid.top, 0).astype(np.float32), (0, 0), 2.0) / np.maximum(weight, 1e-6)
        top = nearest(smooth.astype(np.float32), occupied)
        depression = _filled(np.where(occupied, top, 0)) - top
        hollow = bool(np.count_nonzero((depression > max(0.004, 3 * noise)) & inner) * grid.cell**2 > 1.5e-4)
        field = polygons.smooth_field(occupied, 1.8)
    parts = _parts(field, grid)
    if flat:
        return Laid(grid, _large(parts), True, thickness, False, grid.top, grid.top)
    spread = int(np.ceil(parameters.wall / grid.cell / 2))
    # A bowl's wall is thin; a handle is taken to be about half as thick as it is wide.
    reach = 2 * int(0.012 / grid.cell) + 1
    width = 2 * grid.cell * cv2.dilate(depth, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    thick = np.where(width < 0.03, np.clip(0.5 * width, parameters.wall, 0.012), parameters.wall).astype(np.float32)
    bottom = cv2.erode(top, np.ones((2 * spread + 1, 2 * spread + 1), np.uint8)) - cv2.GaussianBlur(thick, (0, 0), 3.0)
    thin = Laid(grid, _large(parts), False, thickness, hollow, top, np.clip(bottom, 0, top - 0.001))
    if hollow:  # it does not go down to the table
        return thin
    kept, foot = _upheld(sights, grid, top, noise)
    trimmed = _parts(polygons.smooth_field(kept, 1.8), grid)
    if len(trimmed) <= len(parts) and _holes(trimmed) >= _holes(parts):  # what a thing, or a ring in it, hangs together by is no smear
        parts = trimmed
    return Laid(grid, _large(parts), False, thickness, False, top, np.clip(foot, 0, top - 0.001), thin)


#: What is smaller, m^2, is no part of a thing, nor what has no more than this share of the largest part's area.
LEAST, CRUMB = 4e-5, 0.08
#: A column is looked at in so many places for each metre of it.
PLACES = 400
#: What a ray comes down from by more than this, m, and three times the noise, it passes through.
PAST = 0.005
#: The share of a column that cameras see empty from which nothing stands there.
EMPTY = 0.4
#: Of what is thinner, m, parts may be lost for want of whole columns; of what is thicker it is the round sides that have none down to the
#: table.
SLIM = 0.012
#: Masks of two cameras disagree by so many pixels; what stands out from the rest by so much, m, is no smeared rim, and is torn by gaps of
#: so much.
ROOM, STICKS, TORN = 2, 0.010, 0.010
#: Smear of depth carries a thing so far; in its corners, into which a disc of that radius does not reach, farther, m.
FRINGE, SMEAR, CORNER = 0.004, 0.012, 0.06


def _passed(points: NDArray[np.float64], sights: list[Sight], noise: float) -> NDArray[np.bool_]:
    """Which of points (..., 3) some camera sees past: beside the thing, or what lies behind."""
    result = np.zeros(points.shape[:-1], bool)
    for sight in sights:
        result |= sight.look_up(points, sight.reached) < points[..., 2] - max(PAST, 3 * noise)
    return result


def _upheld(sights: list[Sight], grid: Grid, top: NDArray[np.float32], noise: float) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Columns from the table up to ``top`` (rows, columns), m, held against what the cameras saw beside and through them: which of them are
    filled, and from what height on, m.

    Smear of depth, and the heights given to pixels without, fill the corners of a thing in the air; there some camera sees the table below,
    or another what is behind.
    """
    occupied, centres = np.isfinite(grid.top), grid.centres()
    shares = np.linspace(0, 1, 2 + int(PLACES * float(top[occupied].max())))
    empty = np.stack([_passed(np.concatenate([centres, (share * top)[..., None]], axis=-1), sights, noise) for share in shares])
    loose = occupied & (empty.mean(axis=0) > EMPTY)
    # What lies farther from the rest, and in no corner of it, stands off the table by itself, such as a thin handle.
    rest = occupied & ~loose
    away = _away(rest) * grid.cell
    corner = _closed(rest, CORNER / grid.cell) & (away < SMEAR)
    loose &= _away(loose & ~corner & (away > FRINGE)) * grid.cell > FRINGE
    kept = occupied & ~loose
    return kept, nearest(top * shares[np.argmin(empty, axis=0)].astype(np.float32), kept)


def _lost(sights: list[Sight], grid: Grid, carved: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (rows, columns) of the map of what stands out from what was carved of a flat thing and is missing in it, with what joins the
    two.

    A rod that is hardly as wide as the thing is thick leaves no whole column in the masks of two cameras from either side, or crumbs of
    some, the less so the farther their calibration is off; but each of them saw it.  What stands out by less is the rim, as it is smeared.
    """
    _, regions, stats, _ = cv2.connectedComponentsWithStats(carved.view(np.uint8), connectivity=8)
    large = np.append(False, stats[1:, cv2.CC_STAT_AREA] > CRUMB * stats[1:, cv2.CC_STAT_AREA].max(initial=0))
    away = _away(large[regions]) * grid.cell
    missing = np.isfinite(grid.top) & ~carved
    if not np.any(missing & (away > STICKS)):
        return np.zeros_like(missing)
    points = np.concatenate([grid.centres(), nearest(grid.top, np.isfinite(grid.top))[..., None]], axis=-1)
    seen = np.ones_like(missing)
    for sight in sights:
        wide = cv2.dilate((sight.mask | sight.hidden).view(np.uint8), np.ones((2 * ROOM + 1,) * 2, np.uint8)).astype(np.float32)
        seen &= ~(sight.look_up(points, wide) < 0.5)
    _, regions = cv2.connectedComponents((missing & seen & (away > FRINGE)).view(np.uint8), connectivity=8)
    out = np.isin(regions, np.unique(regions[missing & seen & (away > STICKS)])) & (regions > 0)
    # Where the heights of the two cameras contradict each other it is torn.
    mended = _closed(carved | (missing & seen), 0.5 * TORN / grid.cell)
    return mended & seen & ~carved & (_away(out) * grid.cell <= FRINGE + 2 * grid.cell)


def _away(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """How far each cell is from those of a mask, cells."""
    return cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 5) if mask.any() else np.full(mask.shape, np.inf, np.float32)


def _closed(mask: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """A mask with what a disc of so many cells cannot reach from outside: morphological closing."""
    margin = int(radius) + 2
    near = _away(np.pad(mask, margin)) <= radius
    return (_away(~near) > radius)[margin:-margin, margin:-margin]


def _parts(field: NDArray[np.float32], grid: Grid) -> list[Polygon]:
    """The outlines of what a field over the map holds, the largest first."""
    return [p for p in polygons.outline(field, grid.origin, grid.cell) if p.area > LEAST]


def _holes(parts: list[Polygon]) -> int:
    """How many holes there are in a thing's parts."""
    return sum(Polygon(ring).area > LEAST for part in parts for ring in part.interiors)


def _large(parts: list[Polygon]) -> list[Polygon]:
    """Those of a thing's parts that are no crumbs beside the first; raises ``RECONSTRUCTION_FAILED`` where there is none."""
    if not parts:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "outline of one object", "empty", "an area of at least 0.4 square centimetres")
    return [part for part in parts if part.area > CRUMB * parts[0].area]


def build_lying(laid: Laid) -> Reconstruction:
    """A thing that lies: carved where it is flat, else a height field, or a shell where it is seen to be hollow."""
    if laid.flat:
        return extruded(laid.parts, laid.thickness, "flat")
    meshes, pieces = [], []
    for part in laid.parts:
        meshes.append(relief(part, laid.grid, laid.top, laid.bottom))
        pieces += relief_pieces(part, laid.grid, laid.top, laid.bottom)
    return Reconstruction(concatenate(meshes), tuple(pieces), "shell" if laid.hollow else "height field")


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


def _at(field: NDArray[np.float32], grid: Grid, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """A field over the grid at points (N, 2), interpolated."""
    local = ((xy - grid.origin) / grid.cell).astype(np.float32)
    return cv2.remap(field, local[:, 0:1], local[:, 1:2], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0].astype(float)


def relief(part: Polygon, grid: Grid, top: NDArray[np.float32], bottom: NDArray[np.float32]) -> Mesh:
    """The solid between two height maps over a polygon: Delaunay over its rings and a lattice inside, with walls; watertight."""
    from scipy.spatial import Delaunay

    ring = polygons.ring_points(part, LATTICE * 0.8)
    x0, y0, x1, y1 = part.bounds
    y, x = np.mgrid[y0:y1:LATTICE, x0:x1:LATTICE]
    lattice = np.column_stack([x.ravel(), y.ravel()])
    lattice = lattice[shapely.contains_xy(part.buffer(-0.6 * LATTICE), lattice)]
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


def relief_pieces(part: Polygon, grid: Grid, top: NDArray[np.float32], bottom: NDArray[np.float32]) -> list[Mesh]:
    """Convex hulls over a convex partition of a polygon, cut on until both surfaces are flat to :data:`FLAT_TO` or the cell is
    :data:`LEAST_CELL` wide; then neighbours are joined again where that fills little."""
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
        if depth < 10 and size.max() > LEAST_CELL and max(_bend(xy, high), _bend(xy, low)) > FLAT_TO:
            long = int(np.argmax(size))
            half = (box[long] + box[long + 2]) / 2
            first, second = box.copy(), box.copy()
            first[long + 2], second[long] = half, half
            for b in (first, second):
                queue += [(p, depth + 1) for p in polygons.parts_of(shapely.clip_by_rect(cell, *b)) if p.area > 1e-6]
            continue
        low = np.minimum(low, high - 0.001)
        clouds.append(np.concatenate([np.column_stack([xy, low]), np.column_stack([xy, high])]))
    return joined(clouds)


def _bend(xy: NDArray[np.float64], z: NDArray[np.float64]) -> float:
    """Largest distance of points (xy, z) from the plane that fits them best along z, perpendicular to it: a steep wall is flat too."""
    a = np.column_stack([xy - xy.mean(axis=0), np.ones(len(xy))])
    plane = np.linalg.lstsq(a, z, rcond=None)[0]
    return float(np.max(np.abs(a @ plane - z)) / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2))
