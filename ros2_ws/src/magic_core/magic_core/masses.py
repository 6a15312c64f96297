"""What tool and target weigh: what somebody has told, or else the strategy's densities times what their shapes hold.

No camera sees a weight, and it decides what a grip holds: a steel hammer is thirteen times as heavy as a wooden one of its shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy

#: Densities, kg/m^3, between which solid things and hollow ones that were taken for solid lie: from foam to more than osmium.  What is
#: outside was told in another unit, or of another thing.
LEAST, MOST = 2.0, 25_000.0


def mass_centre(hulls: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]]) -> tuple[float, NDArray[np.float64]]:
    """Volume in m^3 of convex solids taken together, and the centre (3,) of their mass; of each its
    vertices (V, 3) and outward faces (F, 3)."""
    # Tetrahedra between each face and a corner of its solid.
    corners = np.concatenate([vertices[faces] - vertices[0] for vertices, faces in hulls])
    apexes = np.array([vertices[0] for vertices, _ in hulls])
    first = np.cumsum([0] + [len(faces) for _, faces in hulls[:-1]])
    tetrahedra = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    volumes = np.maximum(np.add.reduceat(tetrahedra, first), 1e-12)
    centres = apexes + np.add.reduceat(tetrahedra[:, None] * corners.sum(axis=1) / 4, first) / volumes[:, None]
    return float(volumes.sum()), np.average(centres, axis=0, weights=volumes)


def volume(item: SceneObject) -> float:
    """m^3 that an object's convex pieces hold together, as they are simulated; of the hull of its mesh where it has none."""
    return mass_centre(_hulls(item))[0]


def centre(item: SceneObject) -> NDArray[np.float64]:
    """(3,): the middle of what these hold, m in the object's frame."""
    return mass_centre(_hulls(item))[1]


def _hulls(item: SceneObject) -> list[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    pieces = [piece for piece in item.pieces if len(piece.vertices)] or [item.mesh]
    try:
        return [(hull.vertices, hull.faces) for hull in (piece.convex_hull() for piece in pieces)]
    except (QhullError, ValueError) as error:
        raise MagicError(Code.BAD_MESH, f"shape of {item.id}", "flat or empty", "a solid that can weigh something") from error


def told(strategy: Strategy, tool: SceneObject, target: SceneObject, tool_mass: float, target_mass: float) -> Strategy:
    """The strategy with the densities that give the objects the masses told, kg; 0 leaves the strategy's own.

    Raises BAD_REQUEST where a mass is negative, not finite, or no solid of that size weighs so much or so little.
    """
    physics = strategy.physics
    densities = {
        name: density
        for name, item, mass in (("tool", tool, tool_mass), ("target", target, target_mass))
        if (density := _density(name, item, mass)) is not None
    }
    if not densities:
        return strategy
    physics = replace(
        physics,
        tool_density=densities.get("tool", physics.tool_density),
        target_density=densities.get("target", physics.target_density),
    )
    return replace(strategy, physics=physics)


def _density(name: str, item: SceneObject, mass: float) -> float | None:
    """kg/m^3 of an object of a mass, kg; ``None`` where none is told."""
    if mass == 0:
        return None
    if not (math.isfinite(mass) and mass > 0):
        raise MagicError(Code.BAD_REQUEST, f"{name}_mass", mass, "kg above 0, or 0 where it is not known")
    holds = volume(item)
    density = mass / max(holds, 1e-12)
    if not LEAST <= density <= MOST:
        raise MagicError(
            Code.BAD_REQUEST,
            f"{name}_mass",
            f"{mass:g} kg of {1e6 * holds:.0f} cm^3, which is {density:.3g} kg/m^3",
            f"{LEAST * holds:.2g} to {MOST * holds:.2g} kg ({LEAST:g} to {MOST:g} kg/m^3)",
        )
    return density


def taken(strategy: Strategy, tool: SceneObject, tool_mass: float) -> float:
    """kg that the tool is taken to weigh; ``tool_mass``: what was told, 0 where nothing was."""
    return tool_mass if tool_mass > 0 else strategy.physics.tool_density * volume(tool)


def sentence(strategy: Strategy, tool: SceneObject, tool_mass: float) -> str:
    """What the tool is taken to weigh, and by whose word."""
    if tool_mass > 0:
        return f"the tool weighs {1000 * tool_mass:.0f} g, as was told"
    return (
        f"the tool is taken to weigh {1000 * taken(strategy, tool, 0.0):.0f} g, by the strategy's {strategy.physics.tool_density:g} kg/m^3; "
        "where it is heavier, weigh it and give tool_mass"
    )
