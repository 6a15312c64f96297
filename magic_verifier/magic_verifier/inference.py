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
the target ends off   ``scoop``, or where it swings from the tool ``carry``
the table, on the
tool alone
it was tipped or      ``tip``, and that it fell to the same side
turned over
it moved along the    ``hook`` if the contact encloses it, else ``push``, of what rolled without asking for what was up;
table                 lifted over something first, where it was lifted meanwhile
it was touched and    ``reach``
stayed
====================  =======================================================================================

Beside these: that it rests on a fixture on which it came to rest, that it has left one on which it stood, and that it is as much higher or
lower.  What rolls keeps the height of its middle all along; what is turned over does not, though it may end as high as it was.

A blow, and what the target would resist with, are not told from poses: ``drive`` and ``press`` have to be named.  Nor does any goal that is
found ask for the way that the target was led, or for how far it was turned about the vertical: what was led back to where it was, or
turned on the spot, is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.goal import Goal, from_data, shipped, to_data
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
#: What is tipped over has its middle higher or lower than before, then or meanwhile, by this (m) at least; what rolls has not.
OTHERWISE = 0.005
#: What is tilted by more than this (degrees) and was not tipped over has rolled; what is turned about the vertical by more was turned.
ROLLED, TURNED = 5.0, 15.0
#: What was up of a thing that fell the way that it was led points within this (rad) of that way.
ASIDE = np.deg2rad(30.0)
#: It falls to the same side within this (degrees): a standing cylinder that is met a little beside its middle rolls on its rim as it falls.
SAME_SIDE = 60.0
#: How long (s) things are watched after the motion, and how fast (m/s) what has come to rest may still be.
AFTER, SLOW = 1.0, 0.1
#: Touch is looked for every so many steps.
LOOK_EVERY = 6


@dataclass(frozen=True)
class Changed:
    """What a demonstration changed, lengths in metres.

    way (3,): how the middle of the target moved, world, until the tool last touched it; height: of it above the table in the end, and rise
    since the start; tilt (degrees) of what was up; on: what it touches in the end; touched: whether the tool met it at all; encloses:
    whether the tool, where it last touched it, holds it against being pulled on; tool_on: what the tool rests on when it is let go, nothing
    where it falls; tool_height: of its middle above the table then.  stood_on: what the target touched at first; lifted, farthest: by how
    much its middle was higher than at first, and how far the tool led it from there along the table, at most; tumbled (degrees): how far
    what was up was ever tilted; turned (degrees): about the vertical in the end; up (3,): where what was up points in the end, world;
    fixtures: ids of what is known to stand fast.
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
    stood_on: tuple[str, ...] = ()
    lifted: float = 0.0
    farthest: float = 0.0
    tumbled: float = 0.0
    turned: float = 0.0
    up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    fixtures: tuple[str, ...] = ()

    @property
    def level(self) -> float:
        """How far it moved along the table."""
        return float(np.linalg.norm(self.way[:2]))

    @property
    def rolled(self) -> bool:
        """Whether what was up says nothing: it came to rest another way up, or went over on its way."""
        return self.tilt > ROLLED or self.tumbled > TIPPED

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
        if self.lifted > max(self.rise, 0.0) + MOVED:
            lines.append(f"meanwhile it was up to {1000 * self.lifted:.0f} mm higher than at first")
        if self.farthest > self.level + MOVED:
            lines.append(f"meanwhile it was up to {1000 * self.farthest:.0f} mm from where it stood")
        if self.tilt > ROLLED:
            lines.append(f"what was up of it is now tilted by {self.tilt:.0f} degrees")
        elif self.turned > TURNED and not self.rolled:
            lines.append(f"it has turned by {self.turned:.0f} degrees about the vertical")
        if self.on or self.level > 0.001:  # of a fixed one that is not asked
            before = f", where it touched {', '.join(self.stood_on)} at first" if set(self.stood_on) - {TABLE} else ""
            lines.append(f"in the end it touches {', '.join(self.on) if self.on else 'nothing'}{before}")
        if self.tool_on:
            lines.append(f"let go, the tool stays {1000 * self.tool_height:.0f} mm above the table, on {', '.join(self.tool_on)}")
        if self.level > MOVED and self.touched:
            lines.append(f"the tool {'encloses it' if self.encloses else 'only pushes it: it does not enclose it'}")
        return lines

    def unasked(self, goal: Goal) -> list[str]:
        """What was changed that a goal does not ask for, in words."""
        nodes = list(goal.written.nodes())
        touched = {node.args["whom"] for node in nodes if node.kind == "touching"}
        lines = [f"that the target touches {name}" for name in self.on if name in self.fixtures and name not in touched]
        others = [name for name in self.on if name not in (TABLE, TOOL, *self.fixtures)]
        if others:
            lines.append(
                f"that the target touches {', '.join(others)}: what is seen has another name in other scenes, and only fixtures keep theirs"
            )
        if self.lifted > max(self.rise, 0.0) + MOVED and self.tilt <= ROLLED and not any(node.ever for node in nodes):
            lines.append(f"that the target is lifted by {1000 * self.lifted:.0f} mm on its way")
        if self.turned > TURNED and not self.rolled:
            lines.append(f"that the target turns by {self.turned:.0f} degrees about the vertical")
        if self.farthest > self.level + MOVED:
            lines.append(f"for the way on which it was {1000 * self.farthest:.0f} mm from where it stood")
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
    start, centre = held.world.pose(TARGET), setup.target.centre
    before = transforms.apply(start, centre)
    met: tuple[Array, Array] | None = None
    stood_on: tuple[str, ...] = ()
    lifted = farthest = tumbled = 0.0

    def tilt() -> float:
        return float(np.rad2deg(np.arccos(np.clip((held.world.pose(TARGET)[:3, :3] @ start[2, :3])[2], -1.0, 1.0))))

    while held.time < end + AFTER:
        held.advance()
        held.free_touched()
        held.world.check((TOOL, TARGET) if free else (TOOL,))
        if not free or held.world.steps % LOOK_EVERY:
            continue
        away = transforms.apply(held.world.pose(TARGET), centre) - before
        if held.world.touching(TOOL, TARGET, TOUCH):
            met = held.world.pose(TOOL), held.world.pose(TARGET)
            farthest = max(farthest, float(np.linalg.norm(away[:2])))
        if met is None:
            stood_on = stood_on or held.world.touched_by(TARGET, TOUCH)
        else:
            lifted, tumbled = max(lifted, float(away[2])), max(tumbled, tilt())
    pose = held.world.pose(TARGET)
    after = transforms.apply(pose, centre)
    # What rolls on by itself was not moved by the tool.
    way = (after if met is None else transforms.apply(met[1], centre)) - before
    on = tuple(name for name in held.world.touched_by(TARGET, TOUCH)) if free else ()
    turn = pose[:3, :3] @ start[:3, :3].T
    turned = abs(float(np.rad2deg(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))))
    tool_on: tuple[str, ...] = ()
    tool_height = float("nan")
    if not free or TOOL in on:
        tool_on, tool_height = _let_go(setup, motion, end)
    holds = met is not None and np.linalg.norm(way[:2]) > MOVED and _encloses(setup, met, way)
    return Changed(
        way,
        float(after[2]) - setup.table_height(after),
        float((after - before)[2]),
        tilt(),
        on,
        met is not None,
        bool(holds),
        tool_on,
        tool_height,
        stood_on,
        lifted,
        farthest,
        tumbled,
        turned,
        pose[:3, :3] @ start[2, :3],
        tuple(item.id for item in obstacles if item.source != "camera"),
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


def proposals(seen: Changed, normal: Array | None = None) -> list[Goal]:
    """Goals that what was seen suggests, the strictest first; normal (3,): the target's where the tool met it, world, if it is known.

    Raises ``GOAL_NOT_REACHED`` where nothing was changed that a goal could ask for.
    """
    if TARGET in seen.tool_on:
        return [shipped("hang", height=asked(seen.tool_height))]
    if set(seen.on) == {TOOL} and seen.rise > MOVED:
        height = asked(seen.height)
        return [shipped("scoop", height=height), shipped("carry", height=height)]
    if seen.tilt > TIPPED and max(abs(seen.rise), seen.lifted) > OTHERWISE:
        tip = shipped("tip", angle=float(np.floor(SHARE * seen.tilt / 5.0) * 5.0))
        # Of what is turned right over no side is told, nor of what fell aside of the way that it was led.
        ahead = seen.level > MOVED and float(seen.up @ transforms.unit(seen.way * [1.0, 1.0, 0.0])) > np.cos(ASIDE)
        side = {"points": {"what": TARGET, "along": _along(seen, normal), "within": SAME_SIDE}, "say": "it fell to another side"}
        return [_and(tip, [side] * ahead + _supports(seen))]
    if seen.level > MOVED:
        return _moves(seen, _along(seen, normal))
    if seen.farthest <= MOVED and (seen.rolled or seen.turned <= TURNED) and seen.touched:
        return [shipped("reach")]
    raise MagicError(
        Code.GOAL_NOT_REACHED,
        "what the demonstration changed",
        "; ".join(seen.words()),
        "something that a goal could be: a target that was moved to another place, lifted, tipped or touched, a tool that hangs; or name "
        "one, or a file with a tree of your own (--goal)",
    )


def _moves(seen: Changed, along: str | list[float]) -> list[Goal]:
    """Goals of what was moved along the table, the strictest first."""
    distance = asked(seen.level)
    push = shipped("push", distance=distance, **({"upright": 180.0} if seen.rolled else {}))
    found = [shipped("hook", distance=distance, noise=0.0), push] if seen.encloses and along == "pull" else [push]
    if along != "pull":
        found = [_along_other(goal, along) for goal in found]
    more = _supports(seen)
    if abs(seen.rise) > MOVED:
        say = f"the target is not as much {'higher' if seen.rise > 0 else 'lower'}"
        more.append(_moved("up" if seen.rise > 0 else "down", asked(abs(seen.rise)), say))
    elif seen.lifted > MOVED:
        lifted = {**_moved("up", asked(seen.lifted), "the target was not lifted on its way"), "ever": {"phase": "goal"}}
        return [*(_and(goal, [*more, lifted]) for goal in found), *(_and(goal, more) for goal in found)]
    if TABLE in seen.on and TABLE in seen.stood_on and more:
        return [*(_and(goal, more) for goal in found), *found]
    return [_and(goal, more) for goal in found]


def _along(seen: Changed, normal: Array | None) -> str | list[float]:
    """What to call the way that the target went: the pull, or where the tool met it from above or below, three numbers."""
    if normal is None or np.linalg.norm(normal[:2]) > 0.1:
        return "pull"
    return [round(float(x), 3) for x in transforms.unit(seen.way * [1.0, 1.0, 0.0])]


def _along_other(goal: Goal, along: list[float]) -> Goal:
    """The goal, of another direction than the pull."""

    def other(data: Any) -> Any:
        if isinstance(data, dict):
            return {key: along if key == "along" and value == "pull" else other(value) for key, value in data.items()}
        return [other(value) for value in data] if isinstance(data, list) else data

    return from_data(other(to_data(goal)))


def _moved(along: str | list[float], by: float, say: str) -> dict[str, Any]:
    return {"moved": {"what": TARGET, "along": along, "by": by}, "say": say}


def _supports(seen: Changed) -> list[dict[str, Any]]:
    """That the target rests on the fixtures on which it came to rest, off the table where it was, and off those on which it stood."""

    def touching(name: str) -> dict[str, Any]:
        return {"touching": {"what": TARGET, "whom": name}}

    on = [name for name in seen.on if name in seen.fixtures]
    found: list[dict[str, Any]] = [{**touching(name), "say": f"the target does not touch the {name}"} for name in on]
    left = [name for name in seen.stood_on if name in seen.fixtures and name not in seen.on]
    left += [TABLE] if on and TABLE not in seen.on else []
    return [*found, *({"not": touching(name), "say": f"the target still touches the {name}"} for name in left)]


def _and(goal: Goal, more: list[dict[str, Any]]) -> Goal:
    """The goal, and that all of these nodes hold when it has come to rest."""
    if not more:
        return goal
    data = to_data(goal)
    return from_data({**data, "test": {"all": [data["test"], {"after": {"settle": AFTER}, "all": more}]}})
