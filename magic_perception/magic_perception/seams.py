"""Whether two parts that meet at a seam are two things or one.

A concave seam alone does not say: a handle meets a mug's side, a ladle's stem its bowl, a post its base.  A dozen criteria are measured at
each seam (:data:`CRITERIA`), and the chance of two things is a logistic function of them.  ``seams.json`` holds its weights, made by
``ros2 run magic_perception learn_seams`` from scenes whose things are known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_perception import logistic
from magic_perception.percentiles import percentile

#: What is measured at a seam between two parts, and what it means.
CRITERIA = {
    "length": "log of the pairs of voxels that meet at the seam, over 24",
    "concave": "share of those whose normals tell that bends inward by more than 25 degrees",
    "bend": "their median bend in right angles, negative where the seam is convex",
    "told": "share of the pairs whose normals tell anything (not those across a jump or a gap in what was seen)",
    "across": "largest extent of the seam over the middle extent of the smaller part: small where a part is attached at a spot",
    "hull": "share of voxels of either part that lie before the other's surface: 0 where both are faces of one convex body",
    "breadth": "log of the lesser middle extent of the parts, over 40 mm",
    "depth": "log of the lesser smallest extent of the parts, over 18 mm",
    "size": "log of the voxels of the smaller part, over 100",
    "stacked": "1 where one begins where the other ends",
    "foot": "log of the width of the lowest 25 mm of the upper, where stacked, over 35 mm",
    "neck": "1 where the upper, stacked, is round, on the axis of the other and narrower",
    "cup": "1 where one is the inside of the other: their normals pass by one upright axis, away from it on one and towards it on the other",
    "hangs": "1 where one begins above the table, not on the other, but beside it",
    "bar": "1 where one is a bar that ends at the seam",
    "hue": "difference of the mean chromaticities (R, G, B over their sum), up to 0.3",
    "own": "share of voxels that are nearer in chromaticity to their own part's mean than to the other's, less a half",
    "edge": "log of the median change of colour across the seam over that beside it within the parts",
}

#: What begins below FLOOR stands on the table; slack between the top of one and the bottom of what stands on it; the height of a foot; and
#: how much wider than the narrowest place of a gap what faces it may be, m.
FLOOR, REST, FOOT, BRIDGE = 0.015, 0.015, 0.025, 0.008
#: Voxels of each part, at most, that are compared in pairs.
COMPARED = 60


@dataclass(frozen=True)
class Voxels:
    """A cluster's voxels and the pairs of neighbours among them.

    centre, normal (V, 3); height (V,) above the table, m; rgb (V, 3), 0..1.  a, b (P,): the voxels of a pair; opening (P,): negative where
    the surface bends inward; bend (P,): by so many degrees; clear (P,): whether the normals tell.
    """

    centre: NDArray[np.float64]
    normal: NDArray[np.float64]
    height: NDArray[np.float64]
    rgb: NDArray[np.float64]
    a: NDArray[np.int64]
    b: NDArray[np.int64]
    opening: NDArray[np.float64]
    bend: NDArray[np.float64]
    clear: NDArray[np.bool_]

    @property
    def shade(self) -> NDArray[np.float64]:
        """Chromaticity (V, 3), which shading leaves as it is."""
        return self.rgb / np.maximum(self.rgb.sum(axis=1, keepdims=True), 0.02)


@dataclass(frozen=True)
class _Part:
    """What is measured of one part alone: its voxels (indices), extents (3,) ascending, 2 and 97 percent heights, mean chromaticity (3,),
    the direction (3,) of its length, and the median change of colour between neighbours in it."""

    members: NDArray[np.int64]
    extents: NDArray[np.float64]
    bottom: float
    top: float
    middle: float
    shade: NDArray[np.float64]
    axis: NDArray[np.float64]
    grain: float


def _part(voxels: Voxels, part: NDArray[np.int64], number: int, shade: NDArray[np.float64]) -> _Part:
    members = np.nonzero(part == number)[0]
    centre = voxels.centre[members]
    local = centre - centre.mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=False)[2] if len(members) > 2 else np.eye(3)
    extents = np.subtract(*np.percentile(local @ axes.T, [97, 3], axis=0))
    height = voxels.height[members]
    inside = (part[voxels.a] == number) & (part[voxels.b] == number)
    change = np.linalg.norm(voxels.rgb[voxels.a[inside]] - voxels.rgb[voxels.b[inside]], axis=1)
    return _Part(
        members, np.sort(extents), percentile(height, 2), percentile(height, 97), float(np.median(height)),
        shade[members].mean(axis=0), axes[0], float(np.median(change)) if len(change) else 0.0,
    )  # fmt: skip


def measured(voxels: Voxels, first: _Part, second: _Part, across: NDArray[np.bool_], shade: NDArray[np.float64]) -> NDArray[np.float64]:
    """The :data:`CRITERIA` (C,) of the seam between two parts; across (P,): the pairs of voxels that meet there."""
    told = across & voxels.clear
    some = bool(told.any())
    inward = voxels.opening[told] < 0
    seam = np.unique(np.concatenate([voxels.a[across], voxels.b[across]]))
    small, large = (first, second) if len(first.members) < len(second.members) else (second, first)
    lower, upper = (first, second) if first.middle < second.middle else (second, first)
    stacked = upper.bottom >= lower.top - REST
    standing = upper.bottom < FLOOR and lower.bottom < FLOOR
    foot = voxels.centre[upper.members[voxels.height[upper.members] < upper.bottom + FOOT], :2]
    width = 0.0
    if stacked and len(foot) > 3:
        local = foot - foot.mean(axis=0)
        width = float(np.ptp(local @ np.linalg.svd(local, full_matrices=False)[2][0]))
    nearer = [
        np.linalg.norm(shade[one.members] - one.shade, axis=1) < np.linalg.norm(shade[one.members] - other.shade, axis=1)
        for one, other in ((first, second), (second, first))
    ]
    change = np.median(np.linalg.norm(voxels.rgb[voxels.a[across]] - voxels.rgb[voxels.b[across]], axis=1))
    return np.array([
        np.log(np.count_nonzero(across) / 24),
        float(np.mean(inward & (voxels.bend[told] > 25))) if some else 0.0,
        float(np.median(np.where(inward, 1, -1) * voxels.bend[told])) / 90 if some else 0.0,
        np.count_nonzero(told) / np.count_nonzero(across),
        min(float(np.ptp(voxels.centre[seam], axis=0).max()) / max(small.extents[1], 0.008), 3.0),
        _before(voxels, small, large),
        np.log(max(min(first.extents[1], second.extents[1]), 0.004) / 0.040),
        np.log(max(min(first.extents[0], second.extents[0]), 0.002) / 0.018),
        np.log(len(small.members) / 100),
        float(stacked),
        np.log(max(width, 0.008) / 0.035) if stacked else 0.0,
        float(stacked and _neck(voxels, lower, upper)),
        float(_cup(voxels, first, second)),
        float(not stacked and not standing),
        float(_ends(voxels, first, seam) or _ends(voxels, second, seam)),
        min(float(np.linalg.norm(first.shade - second.shade)), 0.3),
        min(float(n.mean()) for n in nearer) - 0.5,
        np.log((change + 0.02) / (max(first.grain, second.grain) + 0.02)),
    ])  # fmt: skip


def _before(voxels: Voxels, first: _Part, second: _Part) -> float:
    """Share of pairs of voxels, one of each part, of which either lies before the other's tangent plane by more than 5 mm and 10
    degrees."""
    i, j = (one.members[:: max(1, len(one.members) // COMPARED)] for one in (first, second))
    offset = voxels.centre[i][:, None] - voxels.centre[j][None]
    distance = np.linalg.norm(offset, axis=-1)
    slack = np.maximum(0.005, 0.17 * distance)
    out = np.einsum("ijk,jk->ij", offset, voxels.normal[j]) > slack
    back = -np.einsum("ijk,ik->ij", offset, voxels.normal[i]) > slack
    return float(np.mean(out | back))


def _ends(voxels: Voxels, part: _Part, seam: NDArray[np.int64]) -> bool:
    """Whether a part is a bar and its voxels on the seam lie at one of its ends."""
    if part.extents[1] > 0.040 or part.extents[2] < 3 * part.extents[1]:
        return False
    along = voxels.centre[part.members] @ part.axis
    low, high = np.percentile(along, [2, 98])
    mine = voxels.centre[np.intersect1d(seam, part.members)] @ part.axis
    return (
        len(mine) > 0
        and float(np.percentile(np.minimum(mine - low, high - mine), 90)) < 0.2 * (high - low)
        and float(np.ptp(mine)) < 0.5 * (high - low)
    )


def _neck(voxels: Voxels, lower: _Part, upper: _Part) -> bool:
    """Whether the upper of two round parts is on the other's axis and narrower than 0.6 of it."""
    from magic_perception.primitives import fit_circle

    circles = []
    for part in (lower, upper):
        side = part.members[np.abs(voxels.normal[part.members, 2]) < 0.7]
        if len(side) < 12:
            return False
        middle, radius = fit_circle(voxels.centre[side, :2])
        gap = np.abs(np.linalg.norm(voxels.centre[side, :2] - middle, axis=1) - radius)
        circles.append((middle, radius, float(np.percentile(gap, 80))))
    (c0, r0, e0), (c1, r1, e1) = circles
    return e0 < 0.15 * r0 and e1 < 0.2 * r1 and r1 < 0.6 * r0 and float(np.linalg.norm(c0 - c1)) < 0.2 * r0


def _cup(voxels: Voxels, first: _Part, second: _Part) -> bool:
    """Whether two parts are the outside and the inside of one bowl or mug, which meet at its rim."""
    rows, places, ways = [], [], []
    for part in (first, second):
        slope = voxels.normal[part.members, :2]
        length = np.linalg.norm(slope, axis=1)
        upright = length > 0.3
        if np.count_nonzero(upright) < 8:
            return False
        way = slope[upright] / length[upright, None]
        place = voxels.centre[part.members[upright], :2]
        across = np.column_stack([-way[:, 1], way[:, 0]])
        rows.append(np.column_stack([across, np.sum(across * place, axis=1)]) / np.sqrt(len(way)))
        places.append(place)
        ways.append(way)
    matrix = np.concatenate(rows)
    axis = np.linalg.lstsq(matrix[:, :2], matrix[:, 2], rcond=None)[0]
    outward = []
    for place, way in zip(places, ways, strict=True):
        away = place - axis
        radius = float(np.median(np.linalg.norm(away, axis=1)))
        aside = float(np.median(np.abs(away[:, 0] * way[:, 1] - away[:, 1] * way[:, 0])))
        if not 0.015 < radius < 0.2 or aside > 0.2 * radius:
            return False
        outward.append(float(np.mean(np.sum(away * way, axis=1) > 0)))
    return max(outward) > 0.8 and min(outward) < 0.2


#: Told the criteria (C,) of a seam and the voxels of the part on either side: the logarithm of the odds that they are two things.
Judge = Callable[[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]], float]


def judge_by(model: logistic.Logistic) -> Judge:
    """The judge by the weights of the :data:`CRITERIA`."""
    return lambda row, _first, _second: model.odds(row)


@cache
def learned() -> Judge:
    """The judge by the weights that ship with the package."""
    return judge_by(logistic.load(Path(__file__).with_name("seams.json"), CRITERIA))


def _bridged(voxels: Voxels, part: NDArray[np.int64]) -> Voxels:
    """The voxels with pairs across gaps in what was seen, which tell nothing of the surface, so that no group of parts is without a
    neighbour."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    total = int(part.max()) + 1
    while True:
        links = coo_matrix((np.ones(len(voxels.a)), (part[voxels.a], part[voxels.b])), shape=(total, total))
        count, group = connected_components(links, directed=False)
        if count < 2:
            return voxels
        mine = np.nonzero(group[part] == np.argmin(np.bincount(group[part], minlength=count)))[0]
        others = np.setdiff1d(np.arange(len(part)), mine)
        distance, nearest = cKDTree(voxels.centre[others]).query(voxels.centre[mine])
        near = distance < distance.min() + BRIDGE
        none = np.zeros(np.count_nonzero(near))
        voxels = replace(
            voxels,
            a=np.concatenate([voxels.a, mine[near]]),
            b=np.concatenate([voxels.b, others[nearest[near]]]),
            opening=np.concatenate([voxels.opening, none]),
            bend=np.concatenate([voxels.bend, none]),
            clear=np.concatenate([voxels.clear, none > 0]),
        )


def joined(voxels: Voxels, part: NDArray[np.int64], judge: Judge) -> NDArray[np.int64]:
    """Parts (V,) of voxels joined, the likeliest to be one thing first, until all that touch are likelier two."""
    part = np.unique(part, return_inverse=True)[1]
    if part.max() == 0:
        return part
    voxels = _bridged(voxels, part)
    shade = voxels.shade
    parts = {i: _part(voxels, part, i, shade) for i in range(int(part.max()) + 1)}
    found: dict[tuple[int, int], float] = {}
    while len(parts) > 1:
        p, q = part[voxels.a], part[voxels.b]
        low, high = np.minimum(p, q), np.maximum(p, q)
        for i, j in {(int(i), int(j)) for i, j in np.unique(np.column_stack([low, high])[low < high], axis=0)}:
            if (i, j) not in found:
                row = measured(voxels, parts[i], parts[j], (low == i) & (high == j), shade)
                found[i, j] = judge(row, parts[i].members, parts[j].members)
        if not found:
            break
        (i, j), least = min(found.items(), key=lambda item: item[1])
        if least > 0:
            break
        part[part == j] = i
        parts.pop(j)
        parts[i] = _part(voxels, part, i, shade)
        found = {pair: value for pair, value in found.items() if not {i, j} & set(pair)}
    return np.unique(part, return_inverse=True)[1]
