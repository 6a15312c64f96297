"""Round things that lie on their side: mugs, cans, cups.

In a frame whose z is the thing's own axis a lying body of revolution is a standing one, so that it is built as those are
(:mod:`magic_perception.turned`), handle and opening included.  What is looked for is the axis: level, or inclined by as much as a tapered
body that rests on its side or a handle under it makes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_perception.parameters import Parameters
from magic_perception.sight import Sight, agreement
from magic_perception.solids import Reconstruction
from magic_perception.turned import build_round, round_body

#: A lying round thing is about as high as it is narrow: its height over its lesser width from above, a handle counted with it.
NARROW = (0.4, 1.6)
#: Least height, m; points tried with, at most; how much of them lies on the body, at least.
HEIGHT, SAMPLE, ON = 0.03, 700, 0.6
#: Directions first tried over half a turn, and the steps in which direction and inclination are bettered, degrees.
DIRECTIONS, STEPS = 8, (12.0, 6.0, 3.0, 1.5)
#: A solid that hangs or sinks by less than this is set on the table, m.
SET = 0.01


@dataclass(frozen=True)
class _Try:
    """An axis tried: its direction (rad, from above) and inclination (rad), the frame along it, and how much lies on the body found there,
    0 to 1."""

    yaw: float
    tilt: float
    table_from_axis: NDArray[np.float64]
    share: float


def build_lain(
    sights: list[Sight], points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, parameters: Parameters
) -> Reconstruction | None:
    """A round body on its side, with or without a handle, or ``None``; arguments as for :func:`magic_perception.turned.build_round`."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    axes = np.linalg.svd(flat[:: max(1, len(flat) // 2000)], full_matrices=False)[2]
    narrow = float(np.min(np.subtract(*np.percentile(flat @ axes.T, [99, 1], axis=0))))
    if height < HEIGHT or not NARROW[0] * narrow < height < NARROW[1] * narrow:
        return None
    step = max(1, len(points) // SAMPLE)
    sample, seen_from = points[::step], eyes[::step]

    def attempt(yaw: float, tilt: float) -> _Try:
        frame = _frame(sample, yaw, tilt)
        back = transforms.inverse(frame)
        local = transforms.apply(back, sample)
        body = round_body(local, transforms.apply(back, seen_from), float(local[:, 2].max()), noise, parameters.wall, parameters.seed)
        if body is None:
            return _Try(yaw, tilt, frame, 0.0)
        off = np.abs(np.linalg.norm(local[:, :2] - body.axis, axis=1) - body.radius(local[:, 2])) / max(0.006, 4 * noise)
        return _Try(yaw, tilt, frame, float(np.mean(np.maximum(1 - off**2, 0.0))))

    best = max((attempt(yaw, 0.0) for yaw in np.arange(DIRECTIONS) * np.pi / DIRECTIONS), key=lambda t: t.share)
    if best.share == 0.0:
        return None
    for size in np.radians(STEPS):
        for turn, lean in ((size, 0.0), (0.0, size)):
            near = [attempt(best.yaw + sign * turn, best.tilt + sign * lean) for sign in (1, -1)]
            best = max([best, *near], key=lambda t: t.share)
    if best.share < ON:
        return None
    found = [
        _built(turned, sights, points, eyes, noise, parameters)
        for turned in (best.table_from_axis, _turned_over(best.table_from_axis, sample))
    ]
    solids = [solid for solid in found if solid is not None]
    return max(solids, key=lambda solid: solid.fit.score if solid.fit is not None else 0.0, default=None)


def _frame(points: NDArray[np.float64], yaw: float, tilt: float) -> NDArray[np.float64]:
    """table_from_axis (4, 4): z along the direction, the lowest of the points (N, 3) along it at z = 0."""
    z = np.array([np.cos(tilt) * np.cos(yaw), np.cos(tilt) * np.sin(yaw), np.sin(tilt)])
    x = transforms.unit(np.cross([0.0, 0.0, 1.0], z))
    along = points @ z
    start = points.mean(axis=0) + (float(np.percentile(along, 0.5)) - float(along.mean())) * z
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), start)


def _turned_over(frame: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same axis from its other end."""
    z = -frame[:3, 2]
    return _frame(points, float(np.arctan2(z[1], z[0])), float(np.arcsin(np.clip(z[2], -1, 1))))


def _built(
    table_from_axis: NDArray[np.float64],
    sights: list[Sight],
    points: NDArray[np.float64],
    eyes: NDArray[np.float64],
    noise: float,
    parameters: Parameters,
) -> Reconstruction | None:
    """The round solid along an axis, in the table frame, with how it agrees with what was seen."""
    back = transforms.inverse(table_from_axis)
    local = transforms.apply(back, points)
    turned = [replace(sight, table_from_camera=back @ sight.table_from_camera) for sight in sights]
    length = float(np.percentile(local[:, 2], 99))
    solid = build_round(turned, local, transforms.apply(back, eyes), length, noise, parameters)
    if solid is None:
        return None
    low = float(transforms.apply(table_from_axis, solid.mesh.vertices)[:, 2].min())
    frame = table_from_axis.copy()
    if abs(low) < SET:
        frame[2, 3] -= low

    def laid(mesh: Mesh) -> Mesh:
        return mesh.transformed(frame)

    mesh = laid(solid.mesh)
    return Reconstruction(mesh, tuple(laid(piece) for piece in solid.pieces), solid.shape, agreement(mesh, sights))
