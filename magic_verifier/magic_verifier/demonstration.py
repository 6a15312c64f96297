"""The contact points of a demonstration, read off its replay in simulation (paper, III-A).

The paper extracts p_T and p_O "automatically using the contact information in
simulation": the demonstrated trajectory moves the tool, the target follows as physics
has it, and the points where the two press on each other, averaged over the goal
phase, are the contacts.  They are averaged in the frame of the tool, and in the frame
of the target carried along without turning; each point is weighted by the force that
it carries.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Physics
from magic_verifier.floating import TARGET, TOOL, FloatingRun, make_setup
from magic_verifier.predicates import TOUCH
from magic_verifier.simulation import DYNAMIC, Settings

#: Of a target that is held where it is, kg/m^3.
HELD_DENSITY = 5e4
#: Tool and target meet again when they did not touch for so long, s.
APART = 0.3
#: What is tilted by so much (rad) while its middle is so much (m) higher or lower than at first tips over; what rolls keeps its height.
TILTED, RAISED = np.deg2rad(10.0), 0.001


@dataclass(frozen=True)
class Meeting:
    """One stretch of contact: first and last seconds from the motion's start; contact points, outward normals (3,) as of a :class:`Replay`;
    and how far (3,) the target had been moved, in its own frame as it stood, m, when it began and when it ended."""

    first: float
    last: float
    tool_point: NDArray[np.float64]
    tool_normal: NDArray[np.float64]
    target_point: NDArray[np.float64]
    target_normal: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]


@dataclass(frozen=True)
class Replay:
    """What a replay found: contact points p_T in the tool's and p_O in the target's frame (3,) metres, the unit outward
    normal of each surface there (3,) in the same frames, the share of the goal phase in contact, how many points were read,
    when in the phase they touched first and last, seconds from the motion's start, and each stretch of contact in the phase; tips: when in
    the phase the target begins to tip over, infinite where it does not."""

    tool_point: NDArray[np.float64]
    tool_normal: NDArray[np.float64]
    target_point: NDArray[np.float64]
    target_normal: NDArray[np.float64]
    contact_share: float
    points: int
    first: float
    last: float
    meetings: tuple[Meeting, ...] = ()
    tips: float = np.inf


class Shown(Protocol):
    """What a replay needs of a demonstration; a Strategy has it."""

    @property
    def name(self) -> str:
        """Its name, for messages."""

    @property
    def times(self) -> NDArray[np.float64]:
        """(T,) seconds."""

    @property
    def target_from_tool(self) -> NDArray[np.float64]:
        """(T, 4, 4), with the target's frame where it stood when the motion began."""

    @property
    def physics(self) -> Physics:
        """Friction and densities."""

    @property
    def releases(self) -> bool:
        """Whether the tool is let go at the end."""


def replay(
    strategy: Shown,
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...] = (),
    table: NDArray[np.float64] | None = None,
    phases: tuple[Phase, ...] = (),
    settings: Settings | None = None,
    watched: str = "goal",
) -> Replay:
    """Replay ``strategy``'s demonstrated trajectory and read its contacts.

    target: where it stood when the demonstration began.  phases: the one named ``watched`` among
    them is what is averaged over (the paper's is the goal phase; where the target rolls in the tool,
    as in scooping, ``contact`` is the phase in which they meet as they were shown to); without
    phases the second half of the motion is.  A fixed target's contacts are read after the release:
    the tool, let go, hangs from its contact points; of a tool that is not let go, while it presses, the target held where it is.
    Raises ``LOST_CONTACT`` where tool and target never press on each other.
    """
    settings = settings or Settings(frequency=480.0)
    table = np.array([0.0, 0.0, 1.0, 0.0]) if table is None else table
    releases = strategy.releases and strategy.physics.target_is_fixed
    motion = _motion(strategy, target, phases, releases)
    setup = make_setup(replace(tool, world_from_object=motion.world_from_tool[0]), target, obstacles, table, strategy.physics, settings)
    if not releases:
        # A few millimetres are what is asked for: the flats of convex pieces would be seen in them.
        setup = replace(setup, tool=replace(setup.tool, mesh=tool.mesh))
    held = strategy.physics.target_is_fixed and not releases
    if held:
        # PhysX tells of no contact between a led and a static body: the target is a free one, heavy, and put back after each step.
        setup = replace(setup, target_kind=DYNAMIC, physics=replace(setup.physics, target_density=HELD_DENSITY))
    run = FloatingRun(setup, MotionPlan("fg", motion))
    watched = "release" if releases else watched
    names = [phase.name for phase in motion.phases]
    if watched not in names:
        raise MagicError(Code.BAD_REQUEST, "phase to read contacts in", watched, names)
    stretches, share, tips = _contacts(run, watched, target, held, (TOOL,) if releases else (TOOL, TARGET))
    if not stretches:
        raise MagicError(
            Code.LOST_CONTACT,
            f"contacts in the {watched} phase of the demonstration {strategy.name}",
            0,
            "at least one contact that carries a force",
        )
    whole = _Stretch.joined(stretches)
    return Replay(*whole.read(), share, whole.points, whole.first, whole.last, tuple(stretch.meeting() for stretch in stretches), tips)


def _motion(strategy: Shown, target: SceneObject, phases: tuple[Phase, ...], releases: bool) -> ToolMotion:
    """The demonstrated motion in the world, from 0 s on; releases: the tool is let go where it ends, or at the phase of that name, and
    hangs for a second."""
    times = np.asarray(strategy.times, dtype=float)
    times = times - times[0]
    world_from_tool = target.world_from_object @ strategy.target_from_tool
    if len(times) < 2:
        raise MagicError(Code.BAD_STRATEGY, f"trajectory of {strategy.name}", f"{len(times)} poses", "two or more timed poses")
    if not phases:
        phases = (Phase("approach", 0.0, times[-1] / 2), Phase("goal", times[-1] / 2, float(times[-1])))
    if not releases:
        return ToolMotion(times, world_from_tool, phases)
    start = next((p.start for p in phases if p.name == "release"), float(times[-1]))
    phases = (*(p for p in phases if p.end <= start), Phase("release", start, start + 1.0))
    keep = times <= start + 1e-9
    return ToolMotion(np.append(times[keep], start + 1.0), np.concatenate([world_from_tool[keep], world_from_tool[keep][-1:]]), phases)


def _contacts(
    run: FloatingRun, watched: str, target: SceneObject, held: bool, checked: tuple[str, ...]
) -> tuple[list[_Stretch], float, float]:
    """The stretches in which tool and target press on each other in the watched phase, the share of it in which they do, and when in it the
    target begins to tip over.

    target: as it stood; held: it is put back there after each step; checked: the bodies whose state has to be sound.
    """
    # A ball rolls under the tool: its contact is a place on it as it stood, not on its turning surface.
    world_from_still = target.world_from_object.copy()
    target_from_start = transforms.inverse(target.world_from_object)
    stretches: list[_Stretch] = []
    touched, looked, tips = 0, 0, np.inf
    up, middle = target.world_from_object[2, :3], run.setup.target.centre
    height = float(transforms.apply(target.world_from_object, middle)[2])
    while run.time < run.duration:
        run.advance()
        run.free_touched()
        if held:
            run.world.place(TARGET, target.world_from_object)
        run.world.check(checked)
        if run.phase != watched:
            continue
        looked += 1
        touches = [t for t in run.world.touches(TOOL, TARGET, TOUCH) if np.linalg.norm(t.impulse) > 0]
        touched += bool(touches)
        world_from_still[:3, 3] = run.world.position(TARGET)
        tool_from_world, target_from_world = transforms.inverse(run.world.pose(TOOL)), transforms.inverse(world_from_still)
        moved = target_from_start[:3, :3] @ world_from_still[:3, 3] + target_from_start[:3, 3]
        pose = run.world.pose(TARGET)
        if np.isinf(tips) and pose[2, :3] @ up < np.cos(TILTED) and abs(float(transforms.apply(pose, middle)[2]) - height) > RAISED:
            tips = run.time
        if touches and (not stretches or run.time - stretches[-1].last > APART):
            stretches.append(_Stretch(run.time))
        for touch in touches:
            # The contact's normal points towards the tool: out of the target's surface.
            points = (tool_from_world @ [*touch.position, 1.0])[:3], (target_from_world @ [*touch.position, 1.0])[:3]
            normals = -tool_from_world[:3, :3] @ touch.normal, target_from_world[:3, :3] @ touch.normal
            stretches[-1].add(run.time, float(np.linalg.norm(touch.impulse)), points, normals, moved)
    return stretches, touched / max(looked, 1), tips


@dataclass
class _Stretch:
    """What adds up to a meeting, so many points, each weighted by its force."""

    first: float
    last: float = 0.0
    points: int = 0
    weight: float = 0.0
    sums: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 3)))
    moved: list[NDArray[np.float64]] = field(default_factory=list)

    def add(
        self,
        time: float,
        force: float,
        points: tuple[NDArray[np.float64], NDArray[np.float64]],
        normals: tuple[NDArray[np.float64], NDArray[np.float64]],
        moved: NDArray[np.float64],
    ) -> None:
        """Points and outward normals of tool and target, each in its own frame."""
        self.last, self.points, self.weight = time, self.points + 1, self.weight + force
        self.sums += force * np.stack([points[0], normals[0], points[1], normals[1]])
        self.moved = [*self.moved[:1], moved]

    @staticmethod
    def joined(stretches: list[_Stretch]) -> _Stretch:
        """All of them as one."""
        points, weight, sums = (
            sum(s.points for s in stretches),
            sum(s.weight for s in stretches),
            np.sum([s.sums for s in stretches], axis=0),
        )
        return _Stretch(stretches[0].first, stretches[-1].last, points, weight, sums)

    def read(self) -> tuple[NDArray[np.float64], ...]:
        """Mean point and normal on the tool, then on the target."""
        return self.sums[0] / self.weight, transforms.unit(self.sums[1]), self.sums[2] / self.weight, transforms.unit(self.sums[3])

    def meeting(self) -> Meeting:
        return Meeting(self.first, self.last, *self.read(), self.moved[0], self.moved[-1])
