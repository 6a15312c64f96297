"""Round things seen to be hollow, wider than high or not: bowls, dishes, cups.  Inside and outside are one thing.

The rim tells the axis: the highest points lie on a circle, also where the side below it is hidden by the rim itself.  The outside that
faces a camera and the inside of the far wall then tell the profile together; each counts where the other was not seen, a wall's thickness apart.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_perception import primitives
from magic_perception.body import Body
from magic_perception.parameters import Parameters
from magic_perception.sight import Sight
from magic_perception.solids import Reconstruction
from magic_perception.turned import fit_to_silhouettes, seen_into, seen_through, turned_body

#: Of the rim: its least and largest radius, m; four fifths of the highest points lie within this share of the radius from its circle, in this
#: share of all directions from its middle.
RIM, ROUND, AROUND = (0.02, 0.15), 0.10, 0.5
#: Half of what is seen within this share of the rim's radius lies below this share of the height: a floor, or the far wall alone.
INNER, SUNK = 0.75, 0.75
#: What faces a camera does so by this cosine, seen from above; fewer points tell no radius of a level.
FACING, ENOUGH = 0.35, 8


def hollow_body(points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, wall: float) -> Body | None:
    """The open body of revolution whose rim the highest points are, or ``None``.

    points (N, 3) in the table frame with the camera (N, 3) that saw each; height of the rim above the table and thickness of the wall, m.
    """
    high = points[points[:, 2] > height - max(0.008, 0.15 * height)]
    if len(high) < 40:
        return None
    axis, radius = primitives.fit_circle(high[:, :2], rounds=6)
    away = points[:, :2] - axis
    rho = np.linalg.norm(away, axis=1)
    if not RIM[0] < radius < RIM[1]:
        return None
    rim = high[:, :2] - axis
    around = np.unique(np.floor(np.degrees(np.arctan2(rim[:, 1], rim[:, 0])) / 10)).size / 36
    inner = points[rho < INNER * radius, 2]
    if (
        float(np.percentile(np.abs(np.linalg.norm(rim, axis=1) - radius), 80)) > ROUND * radius
        or around < AROUND
        or len(inner) < 20
        or float(np.median(inner)) > SUNK * height
    ):
        return None
    cosine = np.sum((eyes[:, :2] - points[:, :2]) * away, axis=1) / np.maximum(
        np.linalg.norm(eyes[:, :2] - points[:, :2], axis=1) * rho, 1e-9
    )
    middle = points[rho < 0.3 * radius, 2]
    # Down to where the near rim lets a camera look on the axis.
    unique = np.unique(eyes, axis=0)
    distance = np.linalg.norm(unique[:, :2] - axis, axis=1)
    down = float(np.min(height - radius * (unique[:, 2] - height) / np.maximum(distance - radius, 1e-3)))
    told = len(middle) >= ENOUGH and down < float(np.median(middle)) - 0.004
    floor = float(np.clip(np.median(middle) if told else wall, 0.002, 0.8 * height))
    levels = np.linspace(0, height, max(5, int(height / 0.006)) + 1)
    radii = np.full(len(levels), np.nan)
    for i, level in enumerate(levels):
        here = np.abs(points[:, 2] - level) < 0.005
        found_here = []
        for side, thick in ((cosine > FACING, 0.0), ((cosine < -FACING) & (points[:, 2] > floor + 0.004), wall)):
            found = rho[here & side & (rho > 0.3 * radius) & (rho < 1.3 * radius)]
            if len(found) >= ENOUGH:
                found_here.append(float(np.median(found)) + thick)
        if found_here:
            radii[i] = np.mean(found_here)
    known = np.isfinite(radii)
    if known.sum() < 3:
        return None
    # A parabola through them: single levels hold few points, and below the floor there are none.
    curve = np.polynomial.Polynomial.fit(levels[known], radii[known], 2 if known.sum() > 4 else 1)
    low = levels[known].min()
    radii = curve(np.maximum(levels, low))
    return Body(axis, np.column_stack([np.clip(radii, 0.25 * radius, 1.4 * radius), levels]), open=True, floor=floor)


def build_vessel(
    sights: list[Sight], points: NDArray[np.float64], eyes: NDArray[np.float64], height: float, noise: float, parameters: Parameters
) -> Reconstruction | None:
    """A bowl, a dish or a cup without a handle; ``None`` where the points tell of something else.  Arguments as for
    :func:`magic_perception.turned.build_round`."""
    body = hollow_body(points, eyes, height, parameters.wall)
    if body is None:
        return None
    body = fit_to_silhouettes(body, sights)
    if not seen_into(sights, body, noise):
        return None
    body = replace(body, through=seen_through(body, sights))
    mesh, pieces = turned_body(body, max(parameters.wall, 0.0035))
    return Reconstruction(mesh, tuple(pieces), "round")
