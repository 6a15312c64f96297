"""A tool path that gives way to fixed things, as a hand does that follows a wall.

A motion carried over from another tool may lead a longer or deeper tool through
something that stands fast.  Here each pose of such a path is displaced by the shortest
vector d, in the plane in which the contact is reasoned about, that keeps the tool out:

    minimise |d - p|^2   subject to   n_i . d >= c_i

with one half space for each pair of convex pieces near each other and one for the table.
n_i is the normal of a face, of either piece, that parts the pair at the pose before, of
these the one that leaves most room at this pose: so the tool stays on the side from which
it came, however thin the wall, and is not stopped where two pieces of one wall abut.

The path is walked twice.  The first walk has p = 0; in the second p is the displacement
of the first one, smoothed along the path, so that the tool begins to give way before it
meets the obstacle and does not jerk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, box_corners
from magic_core.scene import SceneObject
from magic_planner.collision import Body, grown, hull, outermost, padded, solid_pieces

Array = NDArray[np.float64]
#: Gap kept between the tool and what it gives way to, metres: of a tool that is where it is led, and of one in a gripper, in
#: which it shifts and turns a little when it is gripped and pushed; there at most, however badly it was seen.
GAP = 0.001
GAP_IN_HAND, WIDEST_GAP = 0.004, 0.008
#: Largest displacement, metres: a tool that would have to give way further does something else than was shown.
MOST = 0.10
#: Pieces whose boxes are nearer than this, metres, bound the displacement, which changes by less from one pose to the next.
NEAR = 0.012
#: How far ahead, metres, the tool looks when it may step aside.
LOOK_AHEAD = 0.04
#: Displacements below this, metres, are left out where nothing asks for them.
CLEAR = 3e-4
#: Least way, metres, over which a displacement is smoothed.
SMOOTHING = 0.03
#: So many samples of a path are smoothed at a time: all of a long demonstration against all would not fit into memory.
BLOCK = 256
#: A piece with more corners is represented by the outermost ones in so many directions: what is cut off its curves is below
#: 4 % of its extent, which is less than GAP for pieces of a few centimetres.
CORNERS = 40
#: A face is of use only if its normal lies in the plane of the displacement to this share.
IN_PLANE = 0.5


def gap_of(tool: SceneObject, variant: str) -> float:
    """The gap for a tool, metres, that a floating gripper (``fg``) leads or an arm holds: one whose surface is
    stated to be off comes so much nearer."""
    return GAP if variant == "fg" else min(GAP_IN_HAND + tool.surface_error, WIDEST_GAP)


@dataclass(frozen=True)
class Pieces:
    """Convex pieces as rectangular arrays, the shorter ones padded with copies of their first row.

    corners (P, V, 3); normals (P, F, 3) outward; offsets (P, F): inside is where normals @ x <= offsets.
    """

    corners: Array
    normals: Array
    offsets: Array

    @classmethod
    def of(cls, pieces: Sequence[Mesh]) -> Pieces:
        """Pieces in their frame; finely rounded ones by fewer corners, see :data:`CORNERS`."""
        hulls = [hull(piece.vertices) for piece in pieces]
        hulls = [(v, f) if len(v) <= CORNERS else hull(outermost(v, CORNERS)) for v, f in hulls]
        planes = [_distinct_planes(vertices, faces) for vertices, faces in hulls]
        return cls(padded([v for v, _ in hulls]), padded([n for n, _ in planes]), padded([o for _, o in planes]))


def _distinct_planes(vertices: Array, faces: NDArray[np.int32]) -> tuple[Array, Array]:
    """Outward unit normals (F, 3) and offsets (F,) of a hull's faces, coplanar triangles taken as one."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 1e-14
    normals = normals[good] / lengths[good][:, None]
    rows = np.column_stack([normals, np.einsum("ij,ij->i", normals, a[good])])
    _, first = np.unique(np.round(rows * [1e3, 1e3, 1e3, 1e5]), axis=0, return_index=True)
    rows = rows[np.sort(first)]
    return rows[:, :3], rows[:, 3]


def separations(tool: Pieces, pose: Array, walls: Pieces, mine: NDArray[np.int64], theirs: NDArray[np.int64]) -> tuple[Array, Array]:
    """How far each face of K pairs of pieces parts the pair: gaps (K, G) in metres, negative where it does not, and the
    directions (K, G, 3) in which the tool goes away through it.

    pose (4, 4) of the tool in the walls' frame; mine, theirs (K,): the pieces of the tool and of the walls.  The first of the
    G faces are the wall's piece's, the others the tool's.
    """
    rotation, shift = pose[:3, :3], pose[:3, 3]
    some, which = np.unique(mine, return_inverse=True)
    normals = (tool.normals[some] @ rotation.T)[which]  # (K, F, 3)
    corners = (tool.corners[some] @ rotation.T + shift)[which]  # (K, V, 3)
    wall_normals, wall_corners = walls.normals[theirs], walls.corners[theirs]
    before = np.matmul(wall_normals, corners.transpose(0, 2, 1)).min(axis=2) - walls.offsets[theirs]
    beyond = np.matmul(normals, wall_corners.transpose(0, 2, 1)).min(axis=2) - tool.offsets[mine] - normals @ shift
    return np.concatenate([before, beyond], axis=1), np.concatenate([wall_normals, -normals], axis=1)


def nearest(preferred: Array, directions: Array, least: Array) -> Array | None:
    """The point x nearest to ``preferred`` (D,) with directions (M, D) @ x >= least (M,); None where there is none.

    Least-distance programming by non-negative least squares (Lawson and Hanson, Solving Least Squares Problems, chapter 23).
    """
    room = least - directions @ preferred
    if not np.any(room > 0):
        return preferred
    count = len(preferred)
    matrix = np.vstack([directions.T, room[None]])
    goal = np.append(np.zeros(count), 1.0)
    weights, residual = nnls(matrix, goal)
    rest = matrix @ weights - goal
    if residual < 1e-6 or abs(rest[-1]) < 1e-12:
        return None
    return np.asarray(preferred - rest[:count] / rest[-1])


def give_way(
    world_from_tool: Array,
    tool: SceneObject,
    obstacles: Sequence[SceneObject],
    direction: Array,
    plane: Array,
    clearance: float,
    name: Callable[[int], str] = lambda index: f"sample {index}",
    gap: float = GAP,
) -> Array:
    """The path world_from_tool (T, 4, 4), displaced where it would lead the tool through the obstacles.

    The first pose is taken to be clear.  direction (3,): normal of the plane of the displacement, world axes.  plane (4,): the
    table, which the tool keeps ``clearance`` metres above.  A path that is clear comes back as it is.  ``name`` names a sample
    in errors.  ``gap``: metres that are kept to the obstacles where it gives way.

    Raises PATH_IN_COLLISION, naming sample, tool and obstacle, where the tool would have to give way by more than :data:`MOST`
    or is between two things.
    """
    pieces = solid_pieces(tool)
    low, high = _swept_box(world_from_tool, np.concatenate([piece.vertices for piece in pieces]))
    met: list[SceneObject] = []
    for item in obstacles:
        box = np.concatenate([transforms.apply(item.world_from_object, piece.vertices) for piece in solid_pieces(item)])
        if np.all(box.min(axis=0) <= high + gap) and np.all(box.max(axis=0) >= low - gap):
            met.append(item)
    touching = hits(world_from_tool, Body(tool.id, grown(pieces, gap) if gap > GAP else pieces), [Body.from_object(item) for item in met])
    if not touching.any():
        return world_from_tool
    walls = Pieces.of([piece.transformed(item.world_from_object) for item in met for piece in solid_pieces(item)])
    walk = _Walk(world_from_tool, Pieces.of(pieces), walls, _basis(direction), plane, clearance, gap)
    first, last = int(touching.argmax()), len(touching) - int(touching[::-1].argmax())
    found = _both_walks(walk, first, last)
    if not _allowed(found).all():
        # Stopped before something that it might step round: then the side from which it came does not bind it.
        walk.aside = True
        other = _both_walks(walk, first, last)
        found = other if _allowed(other).all() else found
    if not _allowed(found).all():
        far = np.linalg.norm(found, axis=1)
        worst = int(np.argmin(_allowed(found)))
        value = f"out of the way by {far[worst] * 1000:.0f} mm" if np.isfinite(far[worst]) else "between things that stand fast"
        names = ", ".join(item.id for item in met)
        raise MagicError(
            Code.PATH_IN_COLLISION, f"{name(worst)}: {tool.id} and {names}", value, f"a path that gives way by {MOST * 1000:.0f} mm at most"
        )
    result = world_from_tool.copy()
    result[:, :3, 3] += found @ walk.basis.T
    return result


def _both_walks(walk: _Walk, first: int, last: int) -> Array:
    """Displacements (T, 2) of the two walks over a path that is not clear from sample ``first`` to ``last``."""
    found = walk.displacements(np.zeros((len(walk.poses), 2)), first - 1, last, stride=2)
    if not np.isfinite(found).all():
        return found
    smooth = _smoothed(found, walk.poses)
    moved = np.flatnonzero(np.linalg.norm(smooth, axis=1) > CLEAR)
    if not len(moved):
        return found
    smooth[: max(1, moved[0])] = smooth[moved[-1] + 1 :] = 0.0
    return walk.displacements(smooth, int(moved[0]) - 1, max(last, int(moved[-1])))


def _allowed(shifts: Array) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(shifts, axis=1) <= MOST)


def hits(poses: Array, tool: Body, walls: Sequence[Body]) -> NDArray[np.bool_]:
    """(T,) whether the tool touches any of the walls at poses (T, 4, 4)."""
    found = np.zeros(len(poses), dtype=bool)
    if not walls:
        return found
    low, high = (tool.local - tool.radii[:, None]).min(axis=0), (tool.local + tool.radii[:, None]).max(axis=0)
    centres = poses[:, :3, :3] @ ((low + high) / 2) + poses[:, :3, 3]
    halves = np.abs(poses[:, :3, :3]) @ ((high - low) / 2)
    for wall in walls:
        # Between a clear pose and one wholly inside there is one that touches: the surfaces are enough.
        low, high = (wall.centres - wall.radii[:, None]).min(axis=0), (wall.centres + wall.radii[:, None]).max(axis=0)
        for index in np.flatnonzero(~found & np.all((centres - halves <= high) & (centres + halves >= low), axis=1)):
            tool.move(poses[index])
            found[index] = tool.touches(wall, inside=False)
    return found


def _swept_box(poses: Array, points: Array) -> tuple[Array, Array]:
    """Lowest and highest corner (3,) of all that the box about points (N, 3) passes at poses (T, 4, 4)."""
    corners = box_corners(points.min(axis=0), points.max(axis=0))
    swept = np.einsum("tij,nj->tni", poses[:, :3, :3], corners) + poses[:, None, :3, 3]
    return swept.min(axis=(0, 1)), swept.max(axis=(0, 1))


def _basis(direction: Array) -> Array:
    """(3, 2): two unit vectors across a direction."""
    normal = transforms.unit(direction)
    helper = np.eye(3)[int(np.abs(normal).argmin())]
    first = transforms.unit(np.cross(normal, helper))
    return np.column_stack([first, np.cross(normal, first)])


def _smoothed(shifts: Array, poses: Array) -> Array:
    """Displacements (T, 2) averaged along the path, bell-shaped, over twice the largest of them to either side."""
    way = way_along(poses)
    width = max(SMOOTHING, 2.0 * float(np.linalg.norm(shifts, axis=1).max()))
    return averaged(shifts, way, lambda apart: np.exp(-0.5 * (apart / (width / 2)) ** 2))


def way_along(poses: Array) -> Array:
    """(T,) how far the origin of poses (T, 4, 4) has come, metres; it never stands quite still."""
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) + 1e-6
    return np.concatenate([[0.0], np.cumsum(moved)])


def averaged(values: Array, way: Array, bell: Callable[[Array], Array]) -> Array:
    """values (T, D) averaged along a way (T,) with the weights ``bell`` of distances, each counted by the stretch it stands for."""
    stretch = np.gradient(way)
    rows = []
    for first in range(0, len(way), BLOCK):
        weight = bell(way[first : first + BLOCK, None] - way[None]) * stretch
        rows.append(weight @ values / weight.sum(axis=1, keepdims=True))
    return np.concatenate(rows)


class _Walk:
    """One path, and the displacements that keep it clear."""

    def __init__(self, poses: Array, tool: Pieces, walls: Pieces, basis: Array, plane: Array, clearance: float, gap: float = GAP) -> None:
        self.poses, self.tool, self.walls, self.basis = poses, tool, walls, basis
        #: Whether a pair may also be parted on a side from which the tool did not come, if that is a short step and the shortest
        #: way out LOOK_AHEAD further on.
        self.aside = False
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
        self.ahead = np.minimum(np.searchsorted(way, way + LOOK_AHEAD), len(poses) - 1)
        self.gap = gap
        ends = tool.corners.min(axis=1), tool.corners.max(axis=1)
        self.middles, self.halves = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
        self.low, self.high = walls.corners.min(axis=1), walls.corners.max(axis=1)
        flat = plane[:3] @ basis
        length = float(np.linalg.norm(flat))
        self.up = flat / length if length > IN_PLANE else None
        corners = tool.corners.reshape(-1, 3)
        heights = ((plane[:3] @ poses[:, :3, :3]) @ corners.T).min(axis=1) + poses[:, :3, 3] @ plane[:3] + plane[3]
        self.floor = np.minimum(clearance - heights, 0.0) / max(length, IN_PLANE)

    def displacements(self, preferred: Array, first: int, last: int, stride: int = 1) -> Array:
        """(T, 2): for each pose the displacement nearest to the preferred one (T, 2) that keeps clear; infinite where none does.

        Poses up to ``first``, and after ``last`` once the preferred displacement is reached again, are taken as preferred.  Of
        the others every ``stride``-th is looked at.
        """
        result = preferred.copy()
        first = max(first, 0)
        now = preferred[first]
        before = self._pose(first, now)
        at = first
        for index in range(first + stride, len(preferred), stride):
            if index > last and np.linalg.norm(now - preferred[index]) < 1e-9:
                break
            ahead = self._pose(int(self.ahead[index]), now) if self.aside else None
            directions, least = self._half_spaces(before, self._pose(index, now), ahead)
            least = least + directions @ now
            if self.up is not None:
                directions, least = np.vstack([directions, self.up]), np.append(least, self.floor[index])
            found = nearest(preferred[index], directions, least)
            if found is None:
                result[index:] = np.inf
                break
            step = found - now
            size = float(np.linalg.norm(step))
            # What is further away than this was not looked at.  A part of the way keeps to the half spaces that now keeps to.
            now = found if size <= NEAR - self.gap or np.any(directions @ now < least) else now + step * ((NEAR - self.gap) / size)
            before = self._pose(index, now)
            # Between those that are looked at, in proportion.
            result[at + 1 : index + 1] = result[at] + (now - result[at]) * np.arange(1, index - at + 1)[:, None] / (index - at)
            at = index
        return result

    def _pose(self, index: int, shift: Array) -> Array:
        pose = self.poses[index].copy()
        pose[:3, 3] += self.basis @ shift
        return pose

    def _half_spaces(self, before: Array, pose: Array, ahead: Array | None) -> tuple[Array, Array]:
        """What parts the tool from the walls on the way from one pose to the next: directions (M, 2) in the plane and how far
        (M,) the tool has to go along each from the second pose, negative where there is room.

        ahead: the pose by which the side is chosen where the tool may step aside."""
        middles, halves = transforms.apply(pose, self.middles), self.halves @ np.abs(pose[:3, :3]).T + NEAR
        low, high = middles - halves, middles + halves
        close = np.all((low[:, None] < self.high) & (high[:, None] > self.low), axis=2)
        if not close.any():
            return np.zeros((0, 2)), np.zeros(0)
        mine, theirs = np.nonzero(close)
        parted, _ = separations(self.tool, before, self.walls, mine, theirs)
        room, away = separations(self.tool, pose, self.walls, mine, theirs)
        # A face parts the pair at the pose before; where none does (two edges cross), the one that comes nearest to it.
        valid = parted >= np.minimum(parted.max(axis=1, keepdims=True), 0.0) - 1e-6
        flat = away @ self.basis
        length = np.sqrt(flat[..., 0] ** 2 + flat[..., 1] ** 2)
        steep = length <= IN_PLANE
        # Room across the plane is room too, as the displacement does not use it up.
        across = (valid & steep & (room > self.gap)).any(axis=1)
        out = (self.gap - room) / np.maximum(length, IN_PLANE)
        way = np.where(valid & ~steep, out, np.inf)
        best = way.argmin(axis=1)
        if ahead is not None:
            later, _ = separations(self.tool, ahead, self.walls, mine, theirs)
            short = (valid | (out < NEAR - self.gap)) & ~steep
            way = np.where(short, out, np.inf)
            best = np.where(short, (self.gap - later) / np.maximum(length, IN_PLANE), np.inf).argmin(axis=1)
        row = np.arange(len(mine)), best
        needed = way[row]
        taken = ~across & np.isfinite(needed) & (needed > -NEAR)
        return (flat[row] / np.maximum(length[row], IN_PLANE)[:, None])[taken], needed[taken]
