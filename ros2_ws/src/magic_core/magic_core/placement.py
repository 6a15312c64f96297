"""Several contacts of one rigid tool: how well places found one by one are those of one placement.

Seen in the frame of the first contact (x its normal, y its tangent), another lies at a vector with its own normal turned by an
angle.  One rigid placement of the reference tool, larger or smaller as a whole, turns all normals and all vectors by one
angle and stretches all vectors by one factor; what is left beside these two tells how far the places are from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import OPPOSED
from magic_core.errors import Code, MagicError
from magic_core.strategy import Waypoint

#: For contacts after the first, by name: its frame in the first's on the target, and the first's frame in its own on the tool, (4, 4) each.
Pairs = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]

#: Standard deviations: of an angle (rad), of the logarithm of a length against the common scale, and
#: of that scale against the tools' sizes.
ANGLE, LENGTH, SCALE = np.deg2rad(25.0), np.log(1.5), np.log(3.0)
#: A vector shorter than this share of its tool's size has no direction.
SHORT = 0.03
#: Where a side is straight two that lie on each other may be so many times farther from where they were told along it than across it.
ALONG = 10.0


@dataclass(frozen=True)
class Relative:
    """A contact in the frame of the first: vector (2,) m along its normal and tangent, angle (rad) from its normal to the other's."""

    vector: NDArray[np.float64]
    angle: float


@dataclass(frozen=True)
class Placement:
    """How places agree with one placement: agreement 0..1, the angle (rad) by which the tool is turned about
    the first contact for it, and its scale."""

    agreement: float
    angle: float
    scale: float


def relative(first: NDArray[np.float64], other: NDArray[np.float64]) -> Relative:
    """The one of two contact frames (4, 4) as seen from the other; both look along the same z."""
    between = transforms.inverse(first) @ other
    return Relative(between[:2, 3].copy(), float(np.arctan2(between[1, 0], between[0, 0])))


def mirrored(place: Relative) -> Relative:
    """The same on the mirrored tool."""
    return Relative(place.vector * [1.0, -1.0], -place.angle)


def placement(wanted: Sequence[Relative], found: Sequence[Relative], sizes: tuple[float, float]) -> Placement:
    """The placement that suits places best, pair by pair as ``wanted`` on a tool of the first of two sizes
    (m), and ``found`` on one of the second."""
    turned, stretched = [0.0], []
    for a, b in zip(wanted, found, strict=True):
        turned.append(_wrapped(b.angle - a.angle))
        lengths = float(np.hypot(*a.vector)), float(np.hypot(*b.vector))
        if min(lengths[0] / sizes[0], lengths[1] / sizes[1]) > SHORT:
            turned.append(_wrapped(float(np.arctan2(b.vector[1], b.vector[0]) - np.arctan2(a.vector[1], a.vector[0]))))
            stretched.append(float(np.log(lengths[1] / lengths[0])))
        else:  # there is no direction; that one is far and the other is not counts as a length
            stretched.append(float(np.log((lengths[1] / sizes[1] + SHORT) / (lengths[0] / sizes[0] + SHORT)) + np.log(sizes[1] / sizes[0])))
    angles = np.array(turned)
    angle = float(np.angle(np.mean(np.exp(1j * angles))))
    scale = float(np.mean(stretched)) if stretched else 0.0
    left = np.array([_wrapped(value - angle) for value in angles])
    cost = np.mean((left / ANGLE) ** 2)
    if stretched:
        cost += np.mean(((np.array(stretched) - scale) / LENGTH) ** 2) + ((scale - np.log(sizes[1] / sizes[0])) / SCALE) ** 2
    return Placement(float(np.exp(-0.5 * cost)), angle, float(np.exp(scale)))


def together(wanted: Sequence[Relative], found: Sequence[Relative], straight: Sequence[bool]) -> tuple[float, NDArray[np.float64]]:
    """The turn (rad) about the first contact and then the shift (2,) m along its normal and tangent by which a tool meets its target at
    several places at once.

    wanted: where further contacts are on the target, seen from the first, normals as those of the tool that lies against it; found: where
    they are on the tool.  straight: of the first contact and of each further one, whether tool or target is straight there: what lies on
    a straight side may do so anywhere along it.
    """
    turned = [0.0, *(_wrapped(b.angle - a.angle) for a, b in zip(wanted, found, strict=True))]
    for a, b, free in zip(wanted, found, straight[1:], strict=True):
        # Where the one lies from the other says nothing of a side along which either may be.
        if not free and not straight[0] and min(np.hypot(*a.vector), np.hypot(*b.vector)) > 0:
            turned.append(_wrapped(float(np.arctan2(b.vector[1], b.vector[0]) - np.arctan2(a.vector[1], a.vector[0]))))
    angle = float(np.angle(np.mean(np.exp(1j * np.array(turned)))))
    back = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    normals, gaps = [0.0, *(place.angle for place in wanted)], [np.zeros(2)]
    gaps += [a.vector - back @ b.vector for a, b in zip(wanted, found, strict=True)]
    rows, lacks = [], []
    for normal, gap, free in zip(normals, gaps, straight, strict=True):
        across = np.array([np.cos(normal), np.sin(normal)])
        for direction, weight in ((across, 1.0), (np.array([-across[1], across[0]]), 1 / ALONG if free else 1.0)):
            rows.append(weight * direction)
            lacks.append(weight * float(direction @ gap))
    return angle, np.linalg.lstsq(np.array(rows), np.array(lacks), rcond=None)[0]


def pairs_of(
    first: tuple[NDArray[np.float64], NDArray[np.float64]], others: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> Pairs:
    """From the frames (4, 4) of contacts on the target and on the tool, the first's and by name the others'."""
    of_target, of_tool = first
    return {name: (transforms.inverse(of_target) @ target, transforms.inverse(tool) @ of_tool) for name, (target, tool) in others.items()}


def waypoint_poses(waypoints: Sequence[Waypoint], pairs: Pairs) -> NDArray[np.float64]:
    """(N, 4, 4): where the first contact's frame on the tool is in that on the target at each
    waypoint, squarely opposed the frames it is of.

    Raises BAD_STRATEGY for a waypoint of a contact that is not among the pairs.
    """
    poses = np.tile(OPPOSED, (len(waypoints), 1, 1))
    for i, waypoint in enumerate(waypoints):
        poses[i, :3, 3] = waypoint.offset
        if waypoint.contact:
            if waypoint.contact not in pairs:
                raise MagicError(Code.BAD_STRATEGY, f"contact of waypoint {waypoint.name}", waypoint.contact, ["", *pairs])
            of_target, of_tool = pairs[waypoint.contact]
            poses[i] = of_target @ poses[i] @ of_tool
    return poses


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
