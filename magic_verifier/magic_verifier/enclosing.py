"""Whether a tool holds the target that it pulls, or only pushes it along: pulls that go on, turned to either side.

What encloses the target keeps it whichever way it is pulled; the corner of an L keeps it to one side and is, to the other, a flat
face; a flat or round thing keeps it to neither, as long as friction does not hold it (at 30 degrees that takes more than 0.57).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_verifier.floating import TARGET, TOOL, Setup, fill_world
from magic_verifier.simulation import DYNAMIC, KINEMATIC, to_poses

#: Pulls that try it: of this many target radii, within these bounds (m), at this speed (m/s).
RADII, BOUNDS, SPEED = 3.0, (0.06, 0.12), 0.2
#: Over the last third of such a pull a target that is held goes with the tool, and one at a flat face without friction falls back
#: along it by the sine of the angle.  Of that sine: below HELD it is held, up to FLAT the face is no worse than flat.
HELD, FLAT = 0.5, 1.1
#: "Stronger noise" of a pull: so many times the kicks of the released code's test of hooking.
STRONGER = 2.0


@dataclass(frozen=True)
class Enclosure:
    """What the pulls found.  slips: by how much of its way the tool leaves the target behind, or to the side, with the pull turned to
    either side; bounds: what is below the first counts as held, and from the second on as no face at all; noisy: whether it stays in
    stronger noise."""

    slips: tuple[float, float]
    bounds: tuple[float, float]
    noisy: bool

    @property
    def sides(self) -> int:
        """On how many sides the target is held."""
        return sum(slip < self.bounds[0] for slip in self.slips)

    @property
    def holds(self) -> bool:
        """Held on one side at least, and on the other no worse than by a flat face."""
        return self.sides > 0 and max(self.slips) < self.bounds[1]


def enclosure(
    setup: Setup,
    tool: NDArray[np.float64],
    target: NDArray[np.float64],
    along: NDArray[np.float64],
    turned: float,
    radius: float,
    rng: np.random.Generator,
) -> Enclosure:
    """Pull on from where tool and target are (world_from_object, (4, 4)) along a level direction (3,), turned by an angle (degrees) to
    either side, and straight on under noise; ``radius`` (m) of the target across the pull."""
    # What is around them is no part of the question.
    alone = replace(
        setup,
        obstacles=(),
        tool=replace(setup.tool, world_from_object=tool),
        target=replace(setup.target, world_from_object=target),
        target_kind=DYNAMIC,
    )
    world = fill_world(alone, KINEMATIC)

    def slip(turn: float, kick: float = 0.0) -> float:
        world.place(TOOL, tool)
        world.place(TARGET, target)
        return _slip(world, setup, tool, along, turn, radius, kick, rng)

    angle = float(np.deg2rad(turned))
    left, right = slip(angle), slip(-angle)
    held, flat = HELD * float(np.sin(angle)), FLAT * float(np.sin(angle))
    return Enclosure((left, right), (held, flat), slip(0.0, STRONGER * radius) < held)


def _slip(
    world: Any,
    setup: Setup,
    tool: NDArray[np.float64],
    along: NDArray[np.float64],
    turn: float,
    radius: float,
    kick: float,
    rng: np.random.Generator,
) -> float:
    """By how much of its way the tool leaves the target behind, or to the side, in the last third of a pull that is turned by an angle
    (rad), with kicks of the sideways velocity (standard deviation in m/s at each 1/240 s)."""
    frequency = setup.settings.frequency
    sideways = np.cross([0, 0, 1.0], along)
    along = np.cos(turn) * along + np.sin(turn) * sideways
    across = np.cross([0, 0, 1.0], along)
    length = float(np.clip(RADII * radius, *BOUNDS))
    steps = int(np.ceil(length / SPEED * frequency))
    kick *= np.sqrt(240.0 / frequency)
    before = np.zeros(3)
    stack = np.repeat(tool[None], steps, axis=0)
    stack[:, :3, 3] += along * (length * np.arange(1, steps + 1) / steps)[:, None]
    poses = to_poses(stack)
    for step in range(1, steps + 1):
        if kick > 0:
            world.set_velocity(TARGET, world.velocity(TARGET) + rng.normal(0, kick) * across)
        world.move_to(TOOL, poses[step - 1])
        world.step()
        if step == 2 * steps // 3:
            before = transforms.apply(world.pose(TARGET), setup.target.centre) - length * step / steps * along
    after = transforms.apply(world.pose(TARGET), setup.target.centre) - length * along
    slip = float(np.linalg.norm((after - before)[:2]) / (length / 3))
    return slip if np.isfinite(slip) else 1.0
