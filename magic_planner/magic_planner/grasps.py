"""Antipodal grasps of a tool, chosen with the whole motion in view.

Grasps are found on the tool's convex pieces, the shape that the physics grips too:
a line through a surface point along its normal leaves the last of the pieces
between the fingers at the opposite one.  That is robust to holes and flipped faces in
the mesh.

The frame of a grasp is the arm's tip frame: z out of the hand, y (or x, by
configuration) along the fingers' closing, the origin between the fingertips.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, box_corners
from magic_core.scene import SceneObject
from magic_planner.budget import Budget
from magic_planner.collision import Body, hull, mass_centre, solid, solid_pieces
from magic_planner.lines import between, crossings
from magic_planner.robot import Robot

#: Sine of the slope up to which fingers are made to close level, which turns them against the faces by as much.
LEVEL = 0.17
#: Grasps that are looked at together: more would fill the memory.
CHUNK = 256
#: Lines along the closing axis on a pad: across the fingers and along them.
ACROSS = 5
DEEP = 5


@dataclass(frozen=True)
class GraspSettings:
    """How grasps are drawn and ranked.

    Attributes
    ----------
    agreement : least cosine between the inward normal at one finger and the outward normal at the other.
    samples, pairs : surface points tried, and antipodal pairs kept of them.
    poses, enough : hand poses tested in one lot, and how many of them have to be clear for no further lot to be tested.
    looked : hand poses whose pads are looked at.
    standoff : m of straight way to the grasp.
    angles : approach directions about the closing axis.
    clearance : m kept between hand and table.
    margin : m left on each side of the object in the open hand.
    away : m around the contact in which no finger is placed.
    force, density : N, what the contact pushes with, and kg/m^3 of the tool, for the slip estimate.
    grip_force, friction : N of each finger, and coefficient between pad and tool.
    """

    agreement: float = 0.9
    samples: int = 500
    pairs: int = 300
    poses: int = 1500
    enough: int = 100
    looked: int = 240
    standoff: float = 0.08
    angles: int = 16
    clearance: float = 0.0015
    margin: float = 0.003
    away: float = 0.025
    force: float = 5.0
    density: float = 600.0
    grip_force: float = 60.0
    friction: float = 0.6


@dataclass(frozen=True)
class Grasp:
    """tool_from_tcp (4, 4); width in metres between the fingers when closed; cost: lower is better."""

    tool_from_tcp: NDArray[np.float64]
    width: float
    cost: float


def surface(
    pieces: Sequence[Mesh], count: int, rng: np.random.Generator, spared: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``count`` points (N, 3) spread evenly over the hulls of pieces and the outward normals (N, 3) there; none where there is no area.

    spared (3,): unit direction; faces across it get fewer points, by the squared sine of the angle to it, but a tenth at least.
    """
    corners = np.concatenate([vertices[faces] for vertices, faces in (hull(piece.vertices) for piece in pieces)])
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    good = areas > 1e-14
    corners, crosses, areas = corners[good], crosses[good], areas[good]
    if not len(areas):
        return np.zeros((0, 3)), np.zeros((0, 3))
    weights = areas if spared is None else areas * np.maximum(1 - (crosses @ spared / areas) ** 2, 0.1)
    # One stratified draw along the cumulated area: even cover, few samples.
    share = (np.arange(count) + rng.uniform(size=count)) / count
    face = np.searchsorted(np.cumsum(weights) / weights.sum(), share).clip(0, len(areas) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    points = corners[face, 0] + u * (corners[face, 1] - corners[face, 0]) + v * (corners[face, 2] - corners[face, 0])
    return points, crosses[face] / areas[face][:, None]


def in_the_way(
    robot: Robot, frames: NDArray[np.float64], static: NDArray[np.float64], swept: NDArray[np.float64], standoff: float
) -> NDArray[np.bool_]:
    """(G,) whether any of the points, all in the tool frame, lies within a box about a link of the open hand.

    static (S, 3): points where the hand must not be; swept (W, 3): points where it must not be on the last
    ``standoff`` metres before the grasp either.  A quick first test; thin things between the points are left to :func:`collision_free`.
    """
    boxes = [(m.vertices.min(axis=0) + 5e-4, m.vertices.max(axis=0) - 5e-4) for m in robot.hand.values()]
    blocked = np.zeros(len(frames), dtype=bool)
    for points, sweep in ((static, 0.0), (swept, standoff)):
        lows = np.array([low - [0, 0, sweep] for low, _ in boxes], dtype=np.float32)
        highs = np.array([high for _, high in boxes], dtype=np.float32)
        whole_low, whole_high = lows.min(axis=0), highs.max(axis=0)
        far = np.linalg.norm(np.maximum(-whole_low, whole_high))
        origins = frames[:, :3, 3]
        reached = np.all((points > origins.min(axis=0) - far) & (points < origins.max(axis=0) + far), axis=1) if len(frames) else []
        transposed = points[reached].astype(np.float32).T
        for first in range(0, len(frames), CHUNK):
            part = slice(first, first + CHUNK)
            axes = np.ascontiguousarray(frames[part, :3, :3].transpose(2, 0, 1), dtype=np.float32)
            local = np.matmul(axes, transposed)  # (3, G, N), each axis of the hand by itself: that is what makes it quick
            local -= np.einsum("kgi,gi->kg", axes, origins[part].astype(np.float32))[:, :, None]
            near = (local[0] > whole_low[0]) & (local[0] < whole_high[0])
            for axis in (1, 2):
                near &= (local[axis] > whole_low[axis]) & (local[axis] < whole_high[axis])
            which, index = np.nonzero(near)
            x, y, z = local[:, which, index]
            hit = np.zeros(len(which), dtype=bool)
            # Box by box over whole rows of numbers: a last axis of three is what numpy is slowest at.
            for low, high in zip(lows, highs, strict=True):
                hit |= (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
            blocked[first + which[hit]] = True
    return blocked


def antipodal(
    pieces: Sequence[Mesh],
    opening: float,
    settings: GraspSettings,
    rng: np.random.Generator,
    up: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centres (M, 3), closing directions (M, 3) unit and widths (M,) of antipodal pairs on a union of convex pieces: two opposite faces
    with nothing else of it beside them between open fingers, though there may be a gap within.  Of a ring as narrow as the hand opens
    they are the two outer sides, of which one finger would meet the other first that is to close on one side of it.

    up (3,): out of the table on which the pieces lie.  Few points are spent on faces across it, where a finger has no room below.
    """
    points, normals = surface(pieces, settings.samples, rng, up)
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    width, exit_normal, crowded = between(solid(pieces), points, -normals, opening)
    faces_back = np.einsum("ij,ij->i", -normals, exit_normal) >= settings.agreement
    fits = (width > 1e-3) & (width <= opening - 2 * settings.margin)
    keep = ~crowded & faces_back & fits
    return points[keep] - normals[keep] * width[keep, None] / 2, -normals[keep], width[keep]


def propose(
    robot: Robot,
    tool: SceneObject,
    tool_from_contact: NDArray[np.float64],
    table: NDArray[np.float64],
    poses: NDArray[np.float64],
    settings: GraspSettings,
    seed: int,
    static: NDArray[np.float64] | None = None,
    swept: NDArray[np.float64] | None = None,
    budget: Budget | None = None,
) -> list[Grasp]:
    """Grasps of the tool, best first, whose hand stays above the table at all poses (K, 4, 4) world_from_tool.

    poses[0] is where the tool lies when it is picked up, the others are the task's.  static, swept (N, 3): points of other
    things as :func:`in_the_way` wants them.  Raises NO_GRASP saying at which test the last of them fell.
    """
    budget = budget or Budget()
    return _Proposal(robot, tool, tool_from_contact, table, poses, settings, seed, static, swept, budget).grasps()


class _Proposal:
    """The stages of :func:`propose`, each of which leaves fewer grasps."""

    def __init__(
        self,
        robot: Robot,
        tool: SceneObject,
        tool_from_contact: NDArray[np.float64],
        table: NDArray[np.float64],
        poses: NDArray[np.float64],
        settings: GraspSettings,
        seed: int,
        static: NDArray[np.float64] | None,
        swept: NDArray[np.float64] | None,
        budget: Budget,
    ) -> None:
        self.robot, self.tool, self.table, self.poses, self.settings, self.budget = robot, tool, table, poses, settings, budget
        self.pieces = solid_pieces(tool)
        self.rng = np.random.default_rng(seed)
        self.up = poses[0, :3, :3].T @ table[:3]
        self.contact = tool_from_contact[:3, 3]
        self.terms = _Terms(self.pieces, tool_from_contact, poses, table, robot, settings)
        self.corners = np.concatenate([box_corners(*mesh.bounds) for mesh in robot.hand.values()])
        nothing = np.zeros((0, 3))
        self.static, self.swept = (nothing if points is None else points for points in (static, swept))

    def grasps(self) -> list[Grasp]:
        """The grasps, best first."""
        centres, closing, widths, first = self._pairs()
        frames, pair = _frames(self.robot, centres, closing, self.settings, self.up)
        low, back = self._above_table(frames)
        frames, pair = frames[low], pair[low]
        self.budget.check("grasp")
        costs = first[pair] + self.terms.of_approach(frames, back)
        own = surface(self.pieces, 400, self.rng)[0]
        keep = self._clear(frames, costs, own)
        frames, pair, costs = frames[keep], pair[keep], costs[keep]
        order = np.argsort(costs, kind="stable")
        looked = order[: self.settings.looked]
        costs[order[self.settings.looked :]] += 5.0
        self.budget.check("grasp")
        frames[looked] = self._moved_to_middle(frames[looked], own)
        self.budget.check("grasp")
        misfit = _misfit(self.robot, frames[looked], widths[pair[looked]], self.pieces, self.terms)
        if np.isfinite(misfit).any():
            costs[looked] += misfit
        return [Grasp(frames[i], float(widths[pair[i]]), float(costs[i])) for i in _varied(frames, costs) if np.isfinite(costs[i])]

    def _refused(self, what: str, value: str, allowed: str) -> MagicError:
        return MagicError(Code.NO_GRASP, f"{what} of {self.tool.id}", value, allowed)

    def _pairs(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Centres (M, 3), closing directions (M, 3), widths (M,) and costs (M,): of each neighbourhood and direction the best pair."""
        settings, opening = self.settings, self.robot.config.opening
        centres, closing, widths = antipodal(self.pieces, opening, settings, self.rng, self.up)
        if not len(widths):
            fits = f"two faces up to {opening - 2 * settings.margin:.3f} m apart whose normals agree to {settings.agreement}"
            raise self._refused("antipodal grasps", f"none in {settings.samples} samples", fits)
        closing = _levelled(closing, self.up)
        away = np.linalg.norm(centres - self.contact, axis=1) > settings.away
        if not away.any():
            raise self._refused("grasps", "all at the contact", f"one at least {settings.away} m away from it")
        centres, closing, widths = centres[away], closing[away], widths[away]
        costs = self.terms.of_pairs(centres, closing, widths)
        cells: dict[tuple[int, ...], int] = {}
        for i in np.argsort(costs, kind="stable"):
            axis = closing[i] * (1 if closing[i][np.abs(closing[i]).argmax()] > 0 else -1)
            cells.setdefault((*np.floor(centres[i] / 0.012).astype(int), *np.round(axis * 2).astype(int)), int(i))
        few = np.array(list(cells.values())[: settings.pairs])
        return centres[few], closing[few], widths[few], costs[few]

    def _above_table(self, frames: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices (L,) of the frames whose hand stays above the table, and how far (L,) they were drawn back for that, in place.

        Where the tool is picked up the hand may be drawn back along its own axis, as long as the fingertips can still reach the
        tool; how much of them is on it then, their patches tell.
        """
        room = _heights(frames, self.corners, self.poses[:1], self.table)[0] - self.settings.clearance
        descent = -(frames[:, :3, 2] @ self.up)
        with np.errstate(divide="ignore", invalid="ignore"):
            back = np.where(room < 0, np.where(descent > 0.1, -room / descent, np.inf), 0.0)
        low = np.flatnonzero(back <= 2 * self.robot.tip_reach)
        if not len(low):
            raise self._refused("grasps", "the hand would go through the table where the tool lies", "fingertips above the table")
        frames[low, :3, 3] -= frames[low, :3, 2] * back[low, None]
        if len(self.poses) > 1:
            low = low[_heights(frames[low], self.corners, self.poses[1:], self.table).min(axis=0) > self.settings.clearance * 0.5]
            if not len(low):
                raise self._refused(
                    "grasps", "the hand would go through the table during the task", "a hand above the table on the whole path"
                )
        return low, back[low]

    def _clear(self, frames: NDArray[np.float64], costs: NDArray[np.float64], own: NDArray[np.float64]) -> NDArray[np.int64]:
        """Indices of frames whose open hand meets no points: lots by cost until there are enough."""
        robot, settings = self.robot, self.settings
        ranked, kept, alone = np.argsort(costs, kind="stable"), [], 0
        for first in range(0, len(ranked), settings.poses):
            self.budget.check("grasp")
            lot = ranked[first : first + settings.poses]
            lot = lot[~in_the_way(robot, frames[lot], np.zeros((0, 3)), own, settings.standoff)]
            alone += len(lot)
            kept.append(lot[~in_the_way(robot, frames[lot], self.static, self.swept, settings.standoff)])
            if sum(len(k) for k in kept) >= settings.enough:
                break
        keep = np.concatenate(kept)
        if not len(keep):
            blocking = "the target or an obstacle" if alone else f"{self.tool.id} itself"
            value = f"the open hand and {blocking} are in collision for {alone or 'all'} of them"
            raise self._refused(f"{len(ranked)} grasps", value, "an open hand clear of everything")
        return keep

    def _moved_to_middle(self, frames: NDArray[np.float64], own: NDArray[np.float64]) -> NDArray[np.float64]:
        """The frames, those moved by :func:`_centred` whose hand is as clear there."""
        robot, settings = self.robot, self.settings
        centred, shift = _centred(robot, frames, self.pieces)
        moved = np.flatnonzero(shift > 0.001)
        fits = (_heights(centred[moved], self.corners, self.poses, self.table) > settings.clearance * 0.5).all(axis=0)
        for static, swept in ((np.zeros((0, 3)), own), (self.static, self.swept)):
            fits[fits] = ~in_the_way(robot, centred[moved[fits]], static, swept, settings.standoff)
        result = frames.copy()
        result[moved[fits]] = centred[moved[fits]]
        return result


def _varied(frames: NDArray[np.float64], costs: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices by cost, where each further grasp of a neighbourhood stands back: the arm's reach decides in the end, so what comes
    first should differ."""
    seen: dict[tuple[int, ...], int] = {}
    rank = np.zeros(len(costs))
    order = np.argsort(costs, kind="stable")
    for i in order:
        key = (*np.floor(frames[i, :3, 3] / 0.03).astype(int), *np.round(frames[i, :3, :2].ravel() * 1.2).astype(int))
        rank[i] = seen[key] = seen.get(key, -1) + 1
    return order[np.argsort((costs + 0.2 * rank)[order], kind="stable")]


def _levelled(directions: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit directions (M, 3), those that are nearly level made level: open fingers on a slant meet the table with one of them first."""
    slope = directions @ up
    level = directions - np.where(np.abs(slope) < LEVEL, slope, 0.0)[:, None] * up
    return np.asarray(level / np.linalg.norm(level, axis=1, keepdims=True))


def pad_profiles(robot: Robot, frames: NDArray[np.float64], pieces: Sequence[Mesh]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What each finger pad meets when it closes: heights (G, ACROSS, DEEP, 2) of the tool over the plane between the pads, metres.

    One line along the closing axis for each cell of a grid on the pad; [..., 0] is the height towards the finger on the
    positive side of that axis, [..., 1] towards the other, -inf where the line meets nothing between the open fingers.
    Also returns the grid's points (ACROSS, DEEP, 2) on the pad: metres across the fingers and along them, towards the tips.
    """
    index = "xy".index(robot.config.closing_axis)
    half, reach = 0.8 * robot.pad_half_width, robot.tip_reach - 0.001
    grid = np.stack(np.meshgrid(np.linspace(-half, half, ACROSS), np.linspace(-reach, reach, DEEP), indexing="ij"), axis=-1)
    flat = grid.reshape(-1, 2)
    closing, origin = frames[:, :3, index], frames[:, :3, 3]
    starts = origin[:, None] + flat[None, :, :1] * frames[:, None, :3, 1 - index] + flat[None, :, 1:] * frames[:, None, :3, 2]
    open_half = robot.config.opening / 2
    heights = np.full((len(frames) * len(flat), 2), -np.inf)
    shape = solid(pieces)
    reached = np.linalg.norm(origin[:, None] - shape.centres, axis=2) < shape.radii + open_half + half + reach
    for found in crossings(shape, starts, closing, reached, open_half + 0.002):
        met = (found.leave > found.enter + 1e-6) & (found.leave < open_half + 0.002) & (found.enter > -open_half - 0.002)
        lines, ends = found.lines[met], np.stack([found.leave[met], -found.enter[met]], axis=1)
        heights[lines] = np.maximum(heights[lines], ends)
    return heights.reshape(len(frames), ACROSS, DEEP, 2), grid


@dataclass(frozen=True)
class Patches:
    """Where the two pads (K = 2) of G grasps touch, by the cells of a grid on each pad.

    first (G, K): height in metres at which each pad stops, -inf where it meets nothing; contact (G, across, deep, K): cells that
    touch then; grid (across, deep, 2): the cells' places on the pad, metres.
    """

    first: NDArray[np.float64]
    contact: NDArray[np.bool_]
    heights: NDArray[np.float64]
    grid: NDArray[np.float64]

    @classmethod
    def of(cls, robot: Robot, frames: NDArray[np.float64], pieces: Sequence[Mesh]) -> Patches:
        """The patches of grasps (G, 4, 4)."""
        heights, grid = pad_profiles(robot, frames, pieces)
        first = heights.max(axis=(1, 2))
        return cls(first, heights >= np.where(np.isfinite(first), first, np.inf)[:, None, None] - 0.001, heights, grid)

    @property
    def there(self) -> NDArray[np.bool_]:
        """(G,) whether both pads meet something."""
        return np.asarray(np.isfinite(self.first).all(axis=1))

    def middles(self) -> NDArray[np.float64]:
        """(G, K, 2): the middle of each pad's patch on the pad, metres."""
        count = self.contact.sum(axis=(1, 2))
        return np.asarray(np.einsum("gadk,adj->gkj", self.contact, self.grid) / np.maximum(count, 1)[..., None])

    def secure(self) -> NDArray[np.float64]:
        """(G,): the share of its cells that a pad still touches when the tool has shifted by a cell to the worst side, 1 for a pad
        that is touched all over."""
        touched = self.contact
        sides = (touched[:, 1:], touched[:, :-1], touched[:, :, 1:], touched[:, :, :-1])
        left = np.min([side.sum(axis=(1, 2)) for side in sides], axis=0)
        whole = 1 - 1 / min(self.grid.shape[:2])
        return np.asarray(np.minimum(left / np.maximum(touched.sum(axis=(1, 2)), 1) / whole, 1.0).min(axis=1))

    def spans(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the smaller patch: mean distance (G,) of its cells from its middle, and half its extent (G, 2) across and along the
        fingers; half a cell is added to each, for a cell is not a point.  Metres."""
        cell = np.array([np.abs(np.diff(self.grid[..., 0], axis=0)).mean(), np.abs(np.diff(self.grid[..., 1], axis=1)).mean()])
        offsets = self.grid[None, :, :, None, :] - self.middles()[:, None, None]
        count = np.maximum(self.contact.sum(axis=(1, 2)), 1)
        arm = (np.linalg.norm(offsets, axis=-1) * self.contact).sum(axis=(1, 2)) / count + np.hypot(*cell) / 8
        half = (np.abs(offsets) * self.contact[..., None]).max(axis=(1, 2)) + cell / 4
        return arm.min(axis=1), half.min(axis=1)


def _centred(robot: Robot, frames: NDArray[np.float64], pieces: Sequence[Mesh]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Grasps (G, 4, 4) moved so that the middles of what the pads touch come to their middles, and that they touch it at the same time:
    the one that is first would push the tool on to the other; and by how much (G,), metres."""
    if not len(frames):
        return frames, np.zeros(0)
    patches = Patches.of(robot, frames, pieces)
    shift = np.where(patches.there[:, None], patches.middles().mean(axis=1), 0.0)
    first = np.where(patches.there[:, None], patches.first, 0.0)
    aside = (first[:, :1] - first[:, 1:]) / 2
    index = "xy".index(robot.config.closing_axis)
    result = frames.copy()
    result[:, :3, 3] += aside * frames[:, :3, index] + shift[:, :1] * frames[:, :3, 1 - index] + shift[:, 1:] * frames[:, :3, 2]
    return result, np.linalg.norm(np.concatenate([aside, shift], axis=1), axis=1)


def _misfit(
    robot: Robot, frames: NDArray[np.float64], widths: NDArray[np.float64], pieces: Sequence[Mesh], terms: _Terms | None = None
) -> NDArray[np.float64]:
    """(G,) cost of finger pads that do not lie flat on opposite faces: what is gripped so is shoved, turns or slips when they close;
    infinite where a pad meets nothing.

    From the heights under the pads: how far a pad is stopped by something else before it is where the grasp wants it (1 a
    centimetre), how far the middles of the two contact areas are from opposite (1 a centimetre), how far the faces are tilted
    (2 a radian), how little of the pad is on them (1.0 where nothing is), how far off the middle the tool is (1 for 2 cm), how far
    out on the pads (0.8 at their edges), how much of the touch a small shift takes (1.5 for half, 13.5 for all of it: what is held
    by the edge alone is squeezed out), and how much of what the patches can hold the motion asks of them (1 for half, 4 for all,
    up to 9).
    """
    if not len(frames):
        return np.zeros(0)
    patches = Patches.of(robot, frames, pieces)
    heights, grid, first, there = patches.heights, patches.grid, patches.first, patches.there
    middles = patches.middles()
    share = patches.contact.sum(axis=(1, 2)).min(axis=1) / (grid.shape[0] * grid.shape[1])
    safe = np.where(np.isfinite(first), first, 0.0)
    early = np.maximum(0.0, safe - widths[:, None] / 2).sum(axis=1)
    tilts = np.zeros(len(frames))
    for axis in (1, 2):
        step = float(np.abs(np.diff(grid, axis=axis - 1)[..., axis - 1]).mean())
        inner = np.take(heights, range(1, heights.shape[axis] - 1), axis=axis)
        ends = np.take(inner, -1, axis=axis), np.take(inner, 0, axis=axis)
        both = np.isfinite(ends[0]) & np.isfinite(ends[1])
        with np.errstate(invalid="ignore"):
            slopes = np.where(both, np.minimum(np.abs(ends[0] - ends[1]) / (step * (inner.shape[axis] - 1)), 0.6), 0.0)
        tilts += (slopes.sum(axis=1) / np.maximum(both.sum(axis=1), 1)).sum(axis=1) / 2
    used = terms.used(robot, frames, *patches.spans()) if terms is not None else 0.0
    cost = (
        np.minimum(early / 0.01, 3.0)
        + np.linalg.norm(middles[:, 0] - middles[:, 1], axis=1) / 0.01
        + 2.0 * tilts
        + np.maximum(0.0, 1 - share / 0.5)
        + np.abs(safe[:, 0] - safe[:, 1]) / 2 / 0.02
        + np.maximum(0.0, np.linalg.norm(middles.mean(axis=1) / np.abs(grid).max(axis=(0, 1)), axis=1) - 0.2)
        + 1.5 * (1 / np.maximum(patches.secure(), 0.1) - 1)
        + np.minimum((used / 0.5) ** 2, 9.0)
    )
    return np.where(there, cost, np.inf)


def _frames(
    robot: Robot, centres: NDArray[np.float64], closing: NDArray[np.float64], settings: GraspSettings, up: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """tool_from_tcp (G, 4, 4) of every approach direction and both ways round of each pair, and the pair's index (G,).

    Among the approach directions is the one that is nearest to straight down, against ``up`` (3,).
    """
    level = np.eye(3)[int(np.abs(up).argmin())]
    helper = np.where(np.abs(closing @ up)[:, None] < 0.9, up, level)
    side = np.cross(closing, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(closing, side)
    angles = np.arange(settings.angles) * 2 * np.pi / settings.angles
    approach = np.cos(angles)[None, :, None] * side[:, None] + np.sin(angles)[None, :, None] * other[:, None]
    frames = np.tile(np.eye(4), (len(centres), settings.angles, 2, 1, 1))
    for way, sign in enumerate((1.0, -1.0)):
        axis = np.broadcast_to(sign * closing[:, None], approach.shape)
        if robot.config.closing_axis == "y":
            columns = (np.cross(axis, approach), axis, approach)
        else:
            columns = (axis, np.cross(approach, axis), approach)
        frames[:, :, way, :3, :3] = np.stack(columns, axis=-1)
    frames[..., :3, 3] = centres[:, None, None]
    pair = np.repeat(np.arange(len(centres)), settings.angles * 2)
    return frames.reshape(-1, 4, 4), pair


def _heights(
    frames: NDArray[np.float64], points: NDArray[np.float64], poses: NDArray[np.float64], table: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(K, G): least height over the table of points (P, 3) of the hand, for each pose (K) and grasp (G)."""
    up = np.einsum("kji,j->ki", poses[:, :3, :3], table[:3])
    ground = poses[:, :3, 3] @ table[:3] + table[3]
    in_hand = np.einsum("gji,kj->kgi", frames[:, :3, :3], up)
    return (in_hand @ points.T).min(axis=2) + np.einsum("gj,kj->kg", frames[:, :3, 3], up) + ground[:, None]


def pad_share(
    robot: Robot,
    frames: NDArray[np.float64],
    forces: NDArray[np.float64],
    torques: NDArray[np.float64],
    arm: NDArray[np.float64],
    half: NDArray[np.float64],
    grip: float,
    friction: float,
) -> NDArray[np.float64]:
    """(G, K): the share of what the pads of G grasps can hold that K loads ask for: 1 is the verge of slipping.

    Two patches pressed with N each (``grip``) hold by friction a force 2 mu N along the pads and a torque 2 mu N r about the closing
    axis, r = ``arm`` (G,) the mean distance of a patch from its middle; and by the shift of the pressure within the patches
    a torque 2 N h about the other axes, h = ``half`` (G, 2) their half extents.  forces (K, 3), torques (G, K, 3) about the grasp's
    origin, in the tool's frame.  The shares are added up, which errs on the safe side.
    """
    index = "xy".index(robot.config.closing_axis)
    closing, across, along = frames[:, :3, index], frames[:, :3, 1 - index], frames[:, :3, 2]
    rub = friction * grip
    tangential = np.linalg.norm(forces[None] - (forces @ closing.T).T[..., None] * closing[:, None], axis=2)
    about = [np.abs(np.einsum("gkj,gj->gk", torques, axis)) for axis in (closing, across, along)]
    share = tangential / (2 * rub) + about[0] / (2 * rub * arm)[:, None]
    # A torque about the line across the fingers moves the pressure along them, and the other way round.
    share += about[1] / (2 * grip * half[:, 1])[:, None] + about[2] / (2 * grip * half[:, 0])[:, None]
    return np.asarray(share)


class _Terms:
    """The terms of a grasp's cost, each about 1 where it begins to matter."""

    def __init__(
        self,
        pieces: Sequence[Mesh],
        tool_from_contact: NDArray[np.float64],
        poses: NDArray[np.float64],
        table: NDArray[np.float64],
        robot: Robot,
        settings: GraspSettings,
    ) -> None:
        volume, self.centre = mass_centre(pieces)
        self.contact, self.force = tool_from_contact[:3, 3], -tool_from_contact[:3, 0] * settings.force
        vertices = np.concatenate([p.vertices for p in pieces])
        far = vertices[np.linalg.norm(vertices - self.contact, axis=1).argmax()]
        #: Where the hand would rather be: between the middle of the tool and its far end.
        self.guidance = self.centre + 0.4 * (far - self.centre)
        self.size = max(float(np.ptp(vertices, axis=0).max()), 1e-3)
        self.weights = -np.einsum("kji,j->ki", poses[:, :3, :3], table[:3]) * volume * settings.density * 9.81
        self.up = poses[0, :3, :3].T @ table[:3]
        self.opening = robot.config.opening
        self.grip, self.friction = settings.grip_force, settings.friction

    def of_pairs(self, centres: NDArray[np.float64], closing: NDArray[np.float64], widths: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M,): torque that the fingers must hold by friction, nearness to the contact, distance from the guidance point, width."""
        # Torque about the closing axis is held by friction alone; the fingers' width holds the rest.
        push = np.cross(self.contact - centres, self.force)
        hang = np.max([np.abs(np.einsum("gi,gi->g", np.cross(self.centre - centres, w), closing)) for w in self.weights], axis=0)
        twist = np.abs(np.einsum("gi,gi->g", push, closing)) + 2 * hang
        near = np.maximum(0.0, 1 - np.linalg.norm(centres - self.contact, axis=1) / min(0.10, 0.5 * self.size))
        return np.asarray(
            np.linalg.norm(centres - self.guidance, axis=1) / self.size
            + twist / 0.2
            + 0.25 * np.linalg.norm(push, axis=1) / max(float(np.linalg.norm(self.force)) * self.size, 1e-9)
            + 0.8 * near
            + (widths / self.opening) ** 2
        )

    def used(self, robot: Robot, frames: NDArray[np.float64], arm: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
        """(G,) :func:`pad_share` at its worst: of the tool's weight at each of the motion's poses, without and with the contact's push."""
        origin = frames[:, :3, 3]
        forces = np.concatenate([self.weights, self.weights + self.force])
        hang = np.cross((self.centre - origin)[:, None], self.weights[None])
        push = np.cross(self.contact - origin, self.force)[:, None]
        torques = np.concatenate([hang, hang + push], axis=1)  # (G, 2K, 3)
        return np.asarray(pad_share(robot, frames, forces, torques, arm, half, self.grip, self.friction).max(axis=1))

    def of_approach(self, frames: NDArray[np.float64], back: NDArray[np.float64]) -> NDArray[np.float64]:
        """(G,): an approach that is not from above, fingers drawn back by ``back`` metres."""
        return np.asarray(0.3 * (1 + frames[:, :3, 2] @ self.up) + 20.0 * back)


def collision_free(
    robot: Robot,
    grasps: Iterable[Grasp],
    tool: SceneObject,
    checks: Sequence[tuple[NDArray[np.float64], Sequence[Body]]],
    blocked: dict[str, int],
    budget: Budget,
    way: float = 0.0,
) -> Iterator[Grasp]:
    """Those grasps whose open hand is clear of the tool itself and, at each pose, of the bodies given with it, as they are asked for.

    checks: (world_from_tool, bodies already placed).  blocked: is told how often each body was in the way.  way: metres straight
    before the grasp on which the hand has to be clear of the tool as well.
    """
    back = np.linspace(0.0, way, 1 + int(np.ceil(way / 0.01)))
    hand = robot.hand_body()
    held = Body(tool.id, solid_pieces(tool))

    def met(frame: NDArray[np.float64]) -> str:
        for distance in back:
            hand.move(frame @ transforms.make(translation=[0.0, 0.0, -distance]))
            if hand.touches(held):
                return held.name
        for world_from_tool, bodies in checks:
            hand.move(world_from_tool @ frame)
            for body in bodies:
                if hand.touches(body):
                    return body.name
        return ""

    for n, grasp in enumerate(grasps):
        if n % 16 == 0:
            budget.check("grasp")
        if name := met(grasp.tool_from_tcp):
            blocked[name] = blocked.get(name, 0) + 1
        else:
            yield grasp
