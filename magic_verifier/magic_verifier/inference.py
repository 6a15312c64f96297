"""What a demonstration was for, from what it changed: what moved where, what touches what, what rests on what.

:func:`changed` replays the demonstrated motion in physics with the tool held, and once more with the tool let go where the motion ends.
:func:`proposals` answers goals that what was seen there suggests, the strictest first; each asks for less than was shown, so that what
does the same with another tool and a little worse still passes.  Which of them it is, is for the demonstration itself to
decide: the strategy has to pass with the demonstrated objects, and with what is drawn around them.

====================  =======================================================================================
what was seen         goal
====================  =======================================================================================
the tool, let go,     ``hang``
stays on the target
the target ends off   ``scoop``
the table, in the
tool
it was tipped over    ``tip``
it moved along the    ``hook`` if the contact encloses it, else ``push``
table
it was touched and    ``reach``
stayed
====================  =======================================================================================

A blow, and what the target would resist with, are not told from poses: ``drive`` and ``press`` have to be named.  Nor is a cube that was
turned on to another of its sides from one that rolled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.goal import Goal, shipped
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Physics
from magic_verifier.enclosing import enclosure
from magic_verifier.floating import TABLE, TARGET, TOOL, FloatingRun, Setup, make_setup
from magic_verifier.predicates import TOUCH
from magic_verifier.simulation import DYNAMIC, Settings

Array = NDArray[np.float64]
#: Asked is for this share of what was shown, rounded down to a step that grows with it.
SHARE = 0.8
#: A thing has moved, or risen, by more than this (m); tipped over by more than this (degrees).
MOVED, TIPPED = 0.02, 45.0
#: What is tipped over has its middle higher or lower than before, by this (m) at least; what rolls has not.
OTHERWISE = 0.005
#: How long (s) things are watched after the motion, and how fast (m/s) what has come to rest may still be.
AFTER, SLOW = 1.0, 0.1
#: Touch is looked for every so many steps.
LOOK_EVERY = 6


@dataclass(frozen=True)
class Changed:
    """What a demonstration changed, lengths in metres.

    way (3,): how the middle of the target moved, world, until the tool last touched it; height: of it above the table in the end, and rise since the start; tilt
    (degrees) of what was up; on: what it touches in the end; touched: whether the tool met it at all; encloses: whether the tool, where
    it last touched it, holds it against being pulled on; tool_on: what the tool rests on when it is let go, nothing where it falls; tool_height: of its
    middle above the table then.
    """

    way: Array
    height: float
    rise: float
    tilt: float
    on: tuple[str, ...]
    touched: bool
    encloses: bool
    tool_on: tuple[str, ...]
    tool_height: float

    @property
    def level(self) -> float:
        """How far it moved along the table."""
        return float(np.linalg.norm(self.way[:2]))

    def words(self) -> list[str]:
        """The same in sentences."""
        lines = []
        if self.level > 0.001 or abs(self.rise) > 0.001:
            x, y, _ = self.way
            lines.append(
                f"the target moved {1000 * self.level:.0f} mm along the table, towards ({x:.2f}, {y:.2f}), and rose by {1000 * self.rise:.0f} mm"
            )
        else:
            lines.append("the target stayed where it was")
        if self.tilt > 5.0:
            lines.append(f"what was up of it is now tilted by {self.tilt:.0f} degrees")
        if self.on or self.level > 0.001:  # of a fixed one that is not asked
            lines.append(f"in the end it touches {', '.join(self.on) if self.on else 'nothing'}")
        if self.tool_on:
            lines.append(f"let go, the tool stays {1000 * self.tool_height:.0f} mm above the table, on {', '.join(self.tool_on)}")
        if self.level > MOVED and self.touched:
            lines.append(f"the tool {'encloses it' if self.encloses else 'only pushes it: it does not enclose it'}")
        return lines


def changed(
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...],
    table: Array,
    physics: Physics,
    times: Array,
    world_from_tool: Array,
) -> Changed:
    """Replay a motion, times (T,) seconds and world_from_tool (T, 4, 4), and see what it changes."""
    setup = make_setup(replace(tool, world_from_object=world_from_tool[0]), target, obstacles, table, physics, Settings(frequency=480.0))
    end = float(times[-1] - times[0])
    motion = ToolMotion(times - times[0], world_from_tool, (Phase("goal", 0.0, end),))
    held = FloatingRun(replace(setup, tool=replace(setup.tool, mesh=tool.mesh)), MotionPlan("fg", motion))
    free = setup.target_kind == DYNAMIC
    start = held.world.pose(TARGET)
    met: tuple[Array, Array] | None = None
    while held.time < end + AFTER:
        held.advance()
        held.world.check((TOOL, TARGET) if free else (TOOL,))
        if free and held.world.steps % LOOK_EVERY == 0 and held.world.touching(TOOL, TARGET, TOUCH):
            met = held.world.pose(TOOL), held.world.pose(TARGET)
    pose = held.world.pose(TARGET)
    centre = setup.target.centre
    before, after = transforms.apply(start, centre), transforms.apply(pose, centre)
    # What rolls on by itself was not moved by the tool.
    way = (after if met is None else transforms.apply(met[1], centre)) - before
    on = tuple(name for name in held.world.touched_by(TARGET, TOUCH)) if free else ()
    tilt = float(np.rad2deg(np.arccos(np.clip((pose[:3, :3] @ start[2, :3])[2], -1.0, 1.0))))
    tool_on: tuple[str, ...] = ()
    tool_height = float("nan")
    if not free or TOOL in on:
        tool_on, tool_height = _let_go(setup, motion, end)
    holds = met is not None and np.linalg.norm(way[:2]) > MOVED and _encloses(setup, met, way)
    return Changed(
        way,
        float(after[2]) - setup.table_height(after),
        float((after - before)[2]),
        tilt,
        on,
        met is not None,
        bool(holds),
        tool_on,
        tool_height,
    )


def _let_go(setup: Setup, motion: ToolMotion, end: float) -> tuple[tuple[str, ...], float]:
    """What the tool rests on when it is let go where its motion ends, and the height of its middle; nothing where it falls to the table."""
    times = np.append(motion.times, end + 0.1)
    poses = np.concatenate([motion.world_from_tool, motion.world_from_tool[-1:]])
    phases = (Phase("goal", 0.0, end), Phase("release", end, end + 0.1))
    # What it met before is no part of the question: the run begins where it is let go.
    run = FloatingRun(setup, MotionPlan("fg", ToolMotion(times, poses, phases)), start=end)
    while run.time < end + 2 * AFTER:
        run.advance()
        run.world.check((TOOL,))
    middle = transforms.apply(run.world.pose(TOOL), setup.tool.centre)
    height = float(middle[2]) - setup.table_height(middle)
    on = run.world.touched_by(TOOL, TOUCH)
    rests = float(np.linalg.norm(run.world.velocity(TOOL))) < SLOW and TABLE not in on and bool(on)
    return (on, height) if rests else ((), float("nan"))


def _encloses(setup: Setup, met: tuple[Array, Array], way: Array) -> bool:
    along = transforms.unit(way * [1.0, 1.0, 0.0])
    across = np.cross([0, 0, 1.0], along)
    corners = transforms.apply(met[1], setup.target.corners) @ across
    return enclosure(setup, *met, along, 30.0, float(np.ptp(corners)) / 2, np.random.default_rng(0)).holds


def asked(value: float) -> float:
    """What is asked for where this was shown: a share of it, rounded down to 50 mm from 0.1 m on, to 10 mm from 20 mm on, else to 1 mm."""
    least = SHARE * value
    step = 0.05 if least >= 0.1 else 0.01 if least >= 0.02 else 0.001
    return round(float(np.floor(least / step + 1e-9) * step), 6)


def proposals(seen: Changed) -> list[Goal]:
    """Goals that what was seen suggests, the strictest first; raises ``GOAL_NOT_REACHED`` where nothing was changed that could be one."""
    if TARGET in seen.tool_on:
        return [shipped("hang", height=asked(seen.tool_height))]
    if TOOL in seen.on and TABLE not in seen.on and seen.rise > MOVED:
        return [shipped("scoop", height=asked(seen.height))]
    if seen.tilt > TIPPED and abs(seen.rise) > OTHERWISE:
        return [shipped("tip", angle=float(np.floor(SHARE * seen.tilt / 5.0) * 5.0))]
    if seen.level > MOVED:
        distance = asked(seen.level)
        push = shipped("push", distance=distance)
        return [shipped("hook", distance=distance, noise=0.0), push] if seen.encloses else [push]
    if seen.touched:
        return [shipped("reach")]
    raise MagicError(
        Code.GOAL_NOT_REACHED,
        "what the demonstration changed",
        "; ".join(seen.words()),
        "something that a goal could be: a target that was moved, lifted, tipped or touched, a tool that hangs; or name one (--goal)",
    )
