"""Antipodal grasps of a tool, chosen with the whole motion in view.

Grasps are found on the tool's convex pieces, the shape that the physics grips too:
a line through a surface point along its normal leaves the union of the pieces at
the opposite finger.  That is robust to holes and flipped faces in the mesh.

The frame of a grasp is the arm's tip frame: z out of the hand, y (or x, by
configuration) along the fingers' closing, the origin between the fingertips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_planner.budget import Budget
from magic_planner.collision import Body, hull, solid_pieces
from magic_planner.robot import Robot


@dataclass(frozen=True)
class GraspSettings:
    """agreement: least cosine between the inward normal at one finger and the outward normal at the other.
    samples: surface points tried.  angles: approach directions about the closing axis.  clearance: metres kept
    between hand and table.  margin: metres left on each side of the object in the open hand.  away: metres
    around the contact in which no finger is placed.  friction, force, density: of the slip estimate (N, kg/m^3)."""

    agreement: float = 0.9
    samples: int = 160
    angles: int = 16
    clearance: float = 0.0015
    margin: float = 0.003
    away: float = 0.035
    friction: float = 0.5
    force: float = 5.0
    density: float = 600.0


@dataclass(frozen=True)
class Grasp:
    """tool_from_tcp (4, 4); width in metres between the fingers when closed; cost: lower is better."""

    tool_from_tcp: NDArray[np.float64]
    width: float
    cost: float


def antipodal(
    pieces: Sequence[Mesh], opening: float, settings: GraspSettings, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centres (M, 3), closing directions (M, 3) unit and widths (M,) of antipodal pairs on a union of convex pieces."""
    hulls = [hull(piece.vertices) for piece in pieces]
    corners = np.concatenate([vertices[faces] for vertices, faces in hulls])
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    good = areas > 1e-14
    corners, crosses, areas = corners[good], crosses[good], areas[good]
    if not len(areas):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    # One stratified draw along the cumulated area: even cover, few samples.
    share = (np.arange(settings.samples) + rng.uniform(size=settings.samples)) / settings.samples
    face = np.searchsorted(np.cumsum(areas) / areas.sum(), share).clip(0, len(areas) - 1)
    u, v = rng.uniform(size=(2, settings.samples, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    points = corners[face, 0] + u * (corners[face, 1] - corners[face, 0]) + v * (corners[face, 2] - corners[face, 0])
    normals = crosses[face] / areas[face][:, None]
    # Where the line enters and leaves each piece; entries and exits are then joined into one stretch of material.
    enters, leaves, faced = [], [], []
    for vertices, faces in hulls:
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        planes = np.cross(b - a, c - a)
        norms = np.linalg.norm(planes, axis=1)
        planes, a = planes[norms > 1e-14] / norms[norms > 1e-14][:, None], a[norms > 1e-14]
        slope = -normals @ planes.T
        gap = np.einsum("ij,ij->i", a, planes)[None] - points @ planes.T
        with np.errstate(divide="ignore", invalid="ignore"):
            along = gap / slope
        out = np.where(slope > 1e-9, along, np.inf)
        into = np.where(slope < -1e-9, along, -np.inf)
        beside = (np.abs(slope) <= 1e-9) & (gap < -1e-9)
        enter, leave = into.max(axis=1), out.min(axis=1)
        leave = np.where(beside.any(axis=1), -np.inf, leave)
        enters.append(enter)
        leaves.append(leave)
        faced.append(planes[out.argmin(axis=1)])
    enter, leave, far = np.array(enters), np.array(leaves), np.array(faced)
    real = leave > enter + 1e-9
    # A point inside another piece (material just outside it) is no surface.
    inside = (real & (enter < -1e-4) & (leave > 1e-6)).any(axis=0)
    width = np.zeros(len(points))
    exit_normal = -normals.copy()
    for _ in range(len(hulls)):
        grows = real & (enter <= width + 1e-4) & (leave > width + 1e-9)
        if not grows.any():
            break
        best = np.where(grows, leave, -np.inf).argmax(axis=0)
        row = np.arange(len(points))
        grown = grows[best, row]
        width = np.where(grown, leave[best, row], width)
        exit_normal[grown] = far[best, row][grown]
    faces_back = np.einsum("ij,ij->i", -normals, exit_normal) >= settings.agreement
    fits = (width > 5e-4) & (width <= opening - 2 * settings.margin)
    keep = ~inside & faces_back & fits
    return points[keep] - normals[keep] * width[keep, None] / 2, -normals[keep], width[keep]


def propose(
    robot: Robot,
    tool: SceneObject,
    tool_from_contact: NDArray[np.float64],
    table: NDArray[np.float64],
    poses: NDArray[np.float64],
    settings: GraspSettings,
    seed: int,
) -> list[Grasp]:
    """Grasps of the tool, best first, whose hand stays above the table at all poses (K, 4, 4) world_from_tool.

    poses[0] is where the tool lies when it is picked up, the others are the task's.
    Raises NO_GRASP saying at which test the last of them fell.
    """
    pieces = solid_pieces(tool)
    rng = np.random.default_rng(seed)
    centres, closing, widths = antipodal(pieces, robot.config.opening, settings, rng)
    if not len(widths):
        raise MagicError(
            Code.NO_GRASP,
            f"antipodal grasps of {tool.id}",
            f"none in {settings.samples} samples",
            f"two faces up to {robot.config.opening - 2 * settings.margin:.3f} m apart whose normals agree to {settings.agreement}",
        )
    contact = tool_from_contact[:3, 3]
    away = np.linalg.norm(centres - contact, axis=1) > settings.away
    if not away.any():
        raise MagicError(Code.NO_GRASP, f"grasps of {tool.id}", "all at the contact", f"one at least {settings.away} m away from it")
    centres, closing, widths = centres[away], closing[away], widths[away]
    frames, pair = _frames(robot, centres, closing, settings)

    # The hand above the table: where the tool is picked up it may be drawn back along its own axis, as far as the fingertips still hold.
    corners = np.concatenate([mesh.vertices for mesh in robot.hand.values()])
    room = _heights(frames, corners, poses[:1], table)[0] - settings.clearance
    up_in_tool = poses[0, :3, :3].T @ table[:3]
    descent = -(frames[:, :3, 2] @ up_in_tool)
    with np.errstate(divide="ignore", invalid="ignore"):
        back = np.where(room < 0, np.where(descent > 0.1, -room / descent, np.inf), 0.0)
    allowed = max(0.0, robot.tip_reach - 0.0025)
    low = back <= allowed
    if not low.any():
        raise MagicError(Code.NO_GRASP, f"grasps of {tool.id}", "the hand would go through the table where the tool lies", "fingertips above the table")
    frames, pair, back = frames[low], pair[low], back[low]
    frames[:, :3, 3] -= frames[:, :3, 2] * back[:, None]
    if len(poses) > 1:
        high = _heights(frames, corners, poses[1:], table).min(axis=0) > settings.clearance * 0.5
        if not high.any():
            raise MagicError(Code.NO_GRASP, f"grasps of {tool.id}", "the hand would go through the table during the task", "a hand above the table on the whole path")
        frames, pair, back = frames[high], pair[high], back[high]

    costs = _costs(frames, pair, back, centres, widths, pieces, tool_from_contact, poses, table, settings)
    order = np.argsort(costs, kind="stable")
    # Best of each neighbourhood first: the reach of the arm decides in the end, so the first few should differ.
    seen: dict[tuple[int, ...], int] = {}
    rank = []
    for i in order:
        key = (*np.floor(frames[i, :3, 3] / 0.04).astype(int), *np.round(frames[i, :3, :2].ravel() * 1.2).astype(int))
        seen[key] = seen.get(key, -1) + 1
        rank.append(seen[key])
    order = order[np.argsort(np.array(rank), kind="stable")]
    return [Grasp(frames[i], float(widths[pair[i]]), float(costs[i])) for i in order]


def _frames(
    robot: Robot, centres: NDArray[np.float64], closing: NDArray[np.float64], settings: GraspSettings
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """tool_from_tcp (G, 4, 4) of every approach direction and both ways round of each pair, and the pair's index (G,)."""
    helper = np.where(np.abs(closing[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
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


def _heights(frames: NDArray[np.float64], points: NDArray[np.float64], poses: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, G): least height over the table of points (P, 3) of the hand, for each pose (K) and grasp (G)."""
    up = np.einsum("kji,j->ki", poses[:, :3, :3], table[:3])
    ground = poses[:, :3, 3] @ table[:3] + table[3]
    in_hand = np.einsum("gji,kj->kgi", frames[:, :3, :3], up)
    return (in_hand @ points.T).min(axis=2) + np.einsum("gj,kj->kg", frames[:, :3, 3], up) + ground[:, None]


def _costs(frames, pair, back, centres, widths, pieces, tool_from_contact, poses, table, settings):  # type: ignore[no-untyped-def]
    """(G,) cost: torque that the fingers must hold by friction, distance from the guidance point, an approach from below, fingers drawn back."""
    volumes, middles = zip(*[(m.convex_hull().to_trimesh().volume, m.vertices.mean(axis=0)) for m in (Mesh(*hull(p.vertices)) for p in pieces)], strict=True)
    volumes = np.maximum(np.array(volumes), 1e-12)
    centre = np.average(np.array(middles), axis=0, weights=volumes)
    weight = float(volumes.sum()) * settings.density * 9.81
    contact = tool_from_contact[:3, 3]
    vertices = np.concatenate([p.vertices for p in pieces])
    far = vertices[np.linalg.norm(vertices - contact, axis=1).argmax()]
    guidance = centre + 0.4 * (far - centre)
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-3)
    grip = centres[pair]
    # Torque about the closing axis is held by friction alone; the fingers' width holds the rest.
    push = np.cross(contact - grip, -tool_from_contact[:3, 0]) * settings.force
    down = -np.einsum("kji,j->ki", poses[:, :3, :3], table[:3]) * weight
    closing_axis = frames[:, :3, 1]
    hang = np.max([np.abs(np.einsum("gi,gi->g", np.cross(centre - grip, d), closing_axis)) for d in down], axis=0)
    twist = np.abs(np.einsum("gi,gi->g", push, closing_axis)) + hang
    up = poses[0, :3, :3].T @ table[:3]
    from_above = -(frames[:, :3, 2] @ up)
    return (
        np.linalg.norm(grip - guidance, axis=1) / size
        + twist / 0.5
        + 0.25 * np.linalg.norm(push, axis=1) / (settings.force * size)
        + 0.3 * (1 - from_above)
        + 20.0 * back
        + 2.0 * widths[pair]
    )


def collision_free(
    robot: Robot,
    grasps: Sequence[Grasp],
    tool: SceneObject,
    checks: Sequence[tuple[NDArray[np.float64], Sequence[Body]]],
    limit: int,
    budget: Budget,
) -> tuple[list[Grasp], dict[str, int]]:
    """The first ``limit`` grasps whose open hand is clear of the tool itself and, at each pose, of the bodies given with it.

    checks: (world_from_tool, bodies already placed).  Also returns how often each body was in the way.
    """
    hand = robot.hand_body()
    held = Body.from_pieces(tool.id, solid_pieces(tool))
    free: list[Grasp] = []
    blocked: dict[str, int] = {}
    for n, grasp in enumerate(grasps):
        if n % 32 == 0:
            budget.check("grasp")
        hand.move(grasp.tool_from_tcp)
        hit = held.name if hand.touches(held) else ""
        for world_from_tool, bodies in checks:
            if hit:
                break
            hand.move(world_from_tool @ grasp.tool_from_tcp)
            hit = next((body.name for body in bodies if hand.touches(body)), "")
        if hit:
            blocked[hit] = blocked.get(hit, 0) + 1
            continue
        free.append(grasp)
        if len(free) >= limit:
            break
    return free, blocked
