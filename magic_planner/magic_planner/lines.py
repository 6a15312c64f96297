"""Straight lines through convex pieces: where each line is inside of which piece, and how long it stays in their union."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_planner.collision import Solid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Crossings:
    """Lines (L,) through one piece: indices of the lines; enter, leave (L,): where they go in and out, in metres along their
    directions (no crossing where leave <= enter); out (L, 3): outward normals of the faces by which they leave."""

    lines: NDArray[np.int64]
    enter: Array
    leave: Array
    out: Array


def crossings(
    pieces: Solid, points: Array, directions: Array, near: NDArray[np.bool_] | None = None, within: float = np.inf
) -> Iterator[Crossings]:
    """For each piece the lines through points (G, C, 3) along unit directions (G, 3) that come near it; pieces without any left out.

    Lines are counted through both axes.  near (G, P): which pieces each group of C lines is to be cut with.  within: metres from
    their points to both sides in which crossings are wanted; of those farther away not all are left out.
    """
    count = points.shape[1]
    # A line along one of a box's sides is between that pair of planes all the way, or never.
    inverse = 1.0 / np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    for piece in range(len(pieces.radii)):
        groups = np.arange(len(points)) if near is None else np.flatnonzero(near[:, piece])
        if not len(groups):
            continue
        # Only lines that pass through a piece's ball and box are cut with its planes, of which there are many more.
        arm = pieces.centres[piece] - points[groups]
        along = np.einsum("gcj,gj->gc", arm, directions[groups])
        passes = np.einsum("gcj,gcj->gc", arm, arm) - along**2 < (pieces.radii[piece] + 1e-6) ** 2
        group, cell = np.nonzero(passes & (np.abs(along) < pieces.radii[piece] + within))
        middle, slack = arm[group, cell] * inverse[groups[group]], (pieces.halves[piece] + 1e-6) * np.abs(inverse[groups[group]])
        boxed = (middle - slack).max(axis=1) <= (middle + slack).min(axis=1)
        group, cell = group[boxed], cell[boxed]
        if len(group):
            lines = groups[group] * count + cell
            yield _cut(pieces, piece, lines, points[groups[group], cell], directions[groups[group]])


def _cut(pieces: Solid, piece: int, lines: NDArray[np.int64], points: Array, directions: Array) -> Crossings:
    count = pieces.counts[piece]
    normals, offsets = pieces.normals[piece, :count], pieces.offsets[piece, :count]
    slope = directions @ normals.T
    gap = offsets - points @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = gap / slope
    out = np.where(slope > 1e-9, along, np.inf)
    enter = np.where(slope < -1e-9, along, -np.inf).max(axis=1)
    by = out.argmin(axis=1)
    beside = ((np.abs(slope) <= 1e-9) & (gap < -1e-9)).any(axis=1)
    leave = np.where(beside, -np.inf, out[np.arange(len(lines)), by])
    return Crossings(lines, enter, leave, normals[by])


def through(pieces: Solid, points: Array, directions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Follow lines (N, 3), (N, 3) from a surface into the union of convex pieces until they leave it.

    Returns the length (N,) in the material, the outward normal (N, 3) of the face they leave by, and whether the start was
    no surface at all: inside a piece, or where two abut.
    """
    found = list(crossings(pieces, points[:, None], directions))
    count = len(points)
    length, normal, inside = np.zeros(count), directions.copy(), np.zeros(count, dtype=bool)
    if not found:
        return length, normal, inside
    lines = np.concatenate([c.lines for c in found])
    enter, leave = np.concatenate([c.enter for c in found]), np.concatenate([c.leave for c in found])
    out = np.concatenate([c.out for c in found])
    inside[lines[(leave > enter + 1e-4) & (enter < -3e-4) & (leave > -2e-4)]] = True
    real = (leave > enter + 1e-9) & (leave > 1e-9)
    lines, enter, leave, out = lines[real], enter[real], leave[real], out[real]
    # The union of the intervals from 0 on, up to its first gap: the k-th interval of every line at once, in order.
    order = np.lexsort((enter, lines))
    lines, enter, leave, out = lines[order], enter[order], leave[order], out[order]
    rank = np.arange(len(lines)) - np.searchsorted(lines, lines)
    going = np.ones(count, dtype=bool)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        now = np.flatnonzero(rank == k)
        now_lines = lines[now]
        going[now_lines] &= enter[now] <= length[now_lines] + 1e-4
        further = going[now_lines] & (leave[now] > length[now_lines])
        length[now_lines[further]], normal[now_lines[further]] = leave[now[further]], out[now[further]]
    return length, normal, inside


def between(pieces: Solid, points: Array, directions: Array, opening: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """What two fingers ``opening`` metres apart close on, along lines (N, 3), (N, 3) from a surface into the convex pieces: the last face
    between them, where the middle of the fingers is that of the line from the surface to that face.

    Returns the length (N,) of that line, gaps between the pieces counted, the outward normal (N, 3) of that face, and whether the start
    is none of a surface, or a piece lies before it between the fingers.
    """
    length, normal, before = through(pieces, points, directions)
    found = list(crossings(pieces, points[:, None], directions))
    if not found:
        return length, normal, before
    lines = np.concatenate([c.lines for c in found])
    enter, leave = np.concatenate([c.enter for c in found]), np.concatenate([c.leave for c in found])
    out = np.concatenate([c.out for c in found])
    real = leave > enter + 1e-4
    lines, enter, leave, out = lines[real], enter[real], leave[real], out[real]
    while True:  # what else is between the fingers moves their middle, and they reach further
        further = (leave > length[lines] + 1e-9) & (enter > 0) & (enter < (length[lines] + opening) / 2)
        if not further.any():
            break
        order = np.argsort(leave[further], kind="stable")
        now = lines[further][order]
        length[now], normal[now] = leave[further][order], out[further][order]
    before[lines[(enter < -3e-4) & (leave > (length[lines] - opening) / 2) & (leave < 0)]] = True
    return length, normal, before
