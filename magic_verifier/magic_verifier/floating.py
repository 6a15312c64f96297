"""The scene of a strategy, and the floating-gripper run (paper, Table I: FG).

In a floating run the tool is a kinematic body on its planned trajectory: only the
contact between tool and target is put to the test, not the arm.  Where the plan
has a ``release`` phase the tool becomes free at its start, at rest; where it has a
``strike`` phase, with the speed that its motion has there: a loose hand guides a blow
up to it and adds nothing to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.scene import SceneObject
from magic_core.strategy import Physics
from magic_verifier.simulation import (
    DYNAMIC,
    KINEMATIC,
    STATIC,
    Probe,
    Settings,
    World,
    from_pose,
    sphere_of,
    to_poses,
    usable_pieces,
)

TOOL = "tool"
TARGET = "target"
TABLE = "table"

#: Phases in which the tool may touch what it acts on.
CONTACT_PHASES = ("contact", "goal", "release", "strike", "retreat")
#: A tool that overlaps what it is let go on, by no more than is allowed, is pushed out of it so fast (m/s): the fall of a tenth of a
#: millimetre.  The solver's own speed for bodies that were driven into each other would throw it up by a centimetre.
PUSHED_OUT = 0.05
#: A led tool comes no farther than this (m) from one look at what it is in to the next: past a rod that is thicker, together with it, it
#: does not slip unseen.
BETWEEN_LOOKS = 0.005


@dataclass(frozen=True)
class Body:
    """An object ready for physics: hull corners in its own frame and its pose; ``mesh``, where it is given, is the exact
    surface that it collides by instead, as long as it is not free; ``centre_shift`` (3,): by how much its centre of mass is
    off that of the filled hulls, metres in its own frame; ``known_balls``: what ``balls`` says, where that is known; ``loose``: of an
    obstacle, that nothing holds it where it stands: what pushes it moves it."""

    id: str
    hulls: tuple[NDArray[np.float64], ...]
    world_from_object: NDArray[np.float64]
    mesh: Mesh | None = None
    centre_shift: NDArray[np.float64] | None = None
    known_balls: tuple[tuple[NDArray[np.float64], float] | None, ...] | None = None
    loose: bool = False

    @cached_property
    def balls(self) -> tuple[tuple[NDArray[np.float64], float] | None, ...]:
        """Of each hull the ball that it stands for, ``None`` where it is none."""
        return tuple(sphere_of(hull) for hull in self.hulls) if self.known_balls is None else self.known_balls

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """(N, 3): all hull corners in the object's frame."""
        return np.concatenate(self.hulls)

    @cached_property
    def outermost(self) -> NDArray[np.float64]:
        """(M, 3): the corners beyond which no other one reaches, in the object's frame."""
        corners = self.corners
        return corners[ConvexHull(corners).vertices]

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """(3,): middle of the axis-aligned box in the object's frame."""
        corners = self.corners
        return (corners.min(axis=0) + corners.max(axis=0)) / 2


@dataclass(frozen=True)
class Setup:
    """All that a run is built from.  ``target_kind`` is static or dynamic; table and fixtures never move, loose obstacles once they are
    touched."""

    tool: Body
    target: Body
    obstacles: tuple[Body, ...]
    table: NDArray[np.float64]
    physics: Physics
    target_kind: str
    settings: Settings

    def table_height(self, point: NDArray[np.float64]) -> float:
        """Height in metres of the table under a world point."""
        a, b, c, d = (float(v) for v in self.table)
        return -(a * float(point[0]) + b * float(point[1]) + d) / c


def make_setup(
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...],
    table: NDArray[np.float64],
    physics: Physics,
    settings: Settings,
) -> Setup:
    """Check the objects and compute their hulls; raises ``BAD_SCENE``."""

    def body(item: SceneObject) -> Body:
        if not np.all(np.isfinite(item.world_from_object)):
            raise MagicError(Code.BAD_SCENE, f"pose of {item.id}", "not finite", "a finite pose")
        return Body(item.id, tuple(usable_pieces(item.id, item.pieces)), np.asarray(item.world_from_object, dtype=float))

    table = np.asarray(table, dtype=float)
    if table.shape != (4,) or not np.all(np.isfinite(table)) or table[2] < 0.5:
        raise MagicError(Code.BAD_SCENE, "table plane", table, "a, b, c, d with a unit normal that points up")
    kind = STATIC if physics.target_is_fixed else DYNAMIC
    around = tuple(_loose(body(o), table) if o.source == "camera" and not o.hanging else body(o) for o in obstacles)
    setup = Setup(body(tool), body(target), around, table, physics, kind, settings)
    return replace(setup, target=lifted_onto_table(setup.target, table)) if kind == DYNAMIC else setup


def _loose(body: Body, table: NDArray[np.float64]) -> Body:
    """A thing that cameras saw beside tool and target, to be moved by what touches it; what is deep in the table stands fast."""
    try:
        return replace(lifted_onto_table(body, table), loose=True)
    except MagicError:
        return body


def lifted_onto_table(body: Body, table: NDArray[np.float64]) -> Body:
    """A free body raised out of the table, into which a reconstruction may reach by some millimetres; raises ``BAD_SCENE`` for more."""
    corners = transforms.apply(body.world_from_object, body.corners)
    depth = -float((corners @ table[:3] + table[3]).min())
    if depth <= 0:
        return body
    if depth > 0.02:
        raise MagicError(Code.BAD_SCENE, f"lowest point of {body.id}", f"{depth * 1000:.1f} mm below the table", "at most 20 mm below")
    return replace(body, world_from_object=transforms.make(translation=depth * table[:3]) @ body.world_from_object)


def settled(item: SceneObject, table: NDArray[np.float64], physics: Physics, seconds: float = 3.0) -> SceneObject:
    """The object as it comes to lie on the table when it is put down at its pose and let go, as a tool lies that is to be grasped.

    It has come to rest when it is slower than 2 mm/s and 0.02 rad/s for a tenth of a second; else after ``seconds``.
    Raises ``BAD_SCENE`` as :func:`make_setup` does, ``SIMULATION_EXPLODED`` where it does not stay.
    """
    body = Body(item.id, tuple(usable_pieces(item.id, item.pieces)), np.asarray(item.world_from_object, dtype=float))
    body = lifted_onto_table(body, np.asarray(table, dtype=float))
    world = World(Settings(position_iterations=25, angular_damping=2.0))
    world.add_table(np.asarray(table, dtype=float), physics.friction, TABLE)
    world.add(TOOL, list(body.hulls), body.world_from_object, DYNAMIC, physics.tool_density, physics.friction)
    still = 0
    while world.time < seconds and still < 24:
        world.step()
        turning = float(np.linalg.norm(world.component(TOOL).angular_velocity))
        still = still + 1 if np.linalg.norm(world.velocity(TOOL)) < 0.002 and turning < 0.02 else 0
    world.check((TOOL,))
    pose = world.pose(TOOL)
    moved = pose @ transforms.inverse(item.world_from_object)
    return replace(item, world_from_object=pose, world_from_box=moved @ item.world_from_box)


def fill_world(setup: Setup, tool_kind: str) -> World:
    """A world with table, obstacles, target and tool.  Loose obstacles are where they are until they are let go."""
    physics = setup.physics
    world = World(setup.settings)
    world.add_table(setup.table, physics.friction, TABLE)
    for obstacle in setup.obstacles:
        kind, density = (KINEMATIC, physics.target_density) if obstacle.loose else (STATIC, 1000.0)
        world.add(obstacle.id, list(obstacle.hulls), obstacle.world_from_object, kind, density, physics.friction)
    for name, body, kind, density in (
        (TARGET, setup.target, setup.target_kind, physics.target_density),
        (TOOL, setup.tool, tool_kind, physics.tool_density),
    ):
        hulls = list(body.hulls)
        world.add(name, hulls, body.world_from_object, kind, density, physics.friction, body.mesh, body.balls, body.centre_shift)
    return world


def phase_start(phases: tuple[Phase, ...], names: tuple[str, ...]) -> float | None:
    """When the first phase of one of these names begins, ``None`` where there is none."""
    starts = [phase.start for phase in phases if phase.name in names]
    return min(starts) if starts else None


def phase_end(phases: tuple[Phase, ...], name: str) -> float | None:
    """When the last phase of this name ends, ``None`` where there is none."""
    ends = [phase.end for phase in phases if phase.name == name]
    return max(ends) if ends else None


def phase_at(phases: tuple[Phase, ...], time: float) -> str:
    """The phase at a time; after the last one ``settle``."""
    for phase in phases:
        if phase.start <= time < phase.end:
            return phase.name
    return "settle" if not phases or time >= phases[-1].end else ""


def speed(motion: ToolMotion, tool: Body, start: float = 0.0) -> float:
    """How fast the fastest point of the tool ever is from a moment of its motion (s) on, m/s."""
    times = motion.times - motion.times[0]
    used = slice(max(int(np.searchsorted(times, start, "right")) - 1, 0), None)
    times, poses = times[used], motion.world_from_tool[used]
    if len(times) < 2:
        return 0.0
    return float((_ways(poses, tool) / np.diff(times)).max())


def _ways(poses: NDArray[np.float64], tool: Body) -> NDArray[np.float64]:
    """(T - 1,): how far the fastest point of the tool comes from each of the poses (T, 4, 4) to the next, m."""
    steps = np.diff(poses, axis=0)
    ways = tool.outermost @ steps[:, :3, :3].transpose(0, 2, 1) + steps[:, None, :3, 3]
    return np.asarray(np.linalg.norm(ways, axis=2).max(axis=1))


@dataclass(frozen=True)
class Intrusion:
    """Where a planned motion goes through something: body, depth in metres, time, whether before the contact phase."""

    body: str
    depth: float
    time: float
    before_contact: bool


class FloatingRun:
    """One run of a floating plan; :meth:`advance` steps it once.

    ``duration`` is the motion's length in seconds; the run may be advanced beyond
    it, the tool then stays where it is (or free, if it was released).  ``start``: the
    moment of the motion at which the run begins, after the tool has come along without
    touching anything.  ``tool_from_held``: where the tool is in the hand, seen from where
    it is thought to be; ``thought``: the tool as it is thought to be.
    """

    variant = "fg"

    def __init__(
        self,
        setup: Setup,
        plan: MotionPlan,
        start: float = 0.0,
        tool_from_held: NDArray[np.float64] | None = None,
        thought: Body | None = None,
    ) -> None:
        motion = plan.tool_motion
        self._off = 0.0  # by so much at most (m) a point of the tool is from where it would be as it is thought to be
        if tool_from_held is not None:
            thought = thought or setup.tool
            poses, raised = _clear_of_table(setup, motion.world_from_tool, tool_from_held, thought)
            motion = replace(motion, world_from_tool=poses)
            self._off = _apart(setup.tool, thought, tool_from_held) + raised
        self.setup = setup
        self.phases = motion.phases
        self.duration = float(motion.times[-1] - motion.times[0])
        if not self.duration <= 600:
            raise MagicError(Code.BAD_SCENE, "length of the motion", f"{self.duration:.0f} s", "up to 600 s")
        self.release_time = phase_start(self.phases, ("release",))
        self.strike_time = phase_start(self.phases, ("strike",))
        self.contact_time = self._contact_time()
        self._motion = motion
        self._start = start = float(np.clip(start, 0.0, self.duration))
        steps = int(np.ceil((self.duration - start) * setup.settings.frequency)) + 1
        at = motion.times[0] + start + np.arange(steps + 1) / setup.settings.frequency
        poses = transforms.interpolate(motion.times, motion.world_from_tool, at)
        self.world = fill_world(replace(setup, tool=replace(setup.tool, world_from_object=poses[0])), KINEMATIC)
        self._targets = to_poses(poses[1:])
        self._released = False
        self._resting = [obstacle.id for obstacle in setup.obstacles if obstacle.loose]

    def _contact_time(self) -> float:
        start = phase_start(self.phases, CONTACT_PHASES)
        return self.duration if start is None else start

    @property
    def time(self) -> float:
        """Seconds on the clock of the motion."""
        return self._start + self.world.time

    @property
    def phase(self) -> str:
        """The name of the present phase."""
        return phase_at(self.phases, self.time)

    @property
    def released(self) -> bool:
        """Whether the tool has been let go."""
        return self._released

    def advance(self) -> None:
        """One step."""
        if not self._released:
            if self.release_time is not None and self.time >= self.release_time:
                self.world.let_go(TOOL)
                self.world.component(TOOL).max_depenetration_velocity = PUSHED_OUT
                self._released = True
            elif self.strike_time is not None and self.time >= self.strike_time:
                self._throw()
                self._released = True
            else:
                self.world.move_to(TOOL, self._targets[min(self.world.steps, len(self._targets) - 1)])
        self.world.step()

    def free_touched(self) -> None:
        """Let go of the loose obstacles that something that moves touches; without it they stand fast."""
        touched = [name for name in self._resting if self.world.touched_by(name)]
        for name in touched:
            self.world.let_go(name)
        self._resting = [name for name in self._resting if name not in touched]

    def _throw(self) -> None:
        """Make the tool free with the speed that its motion has now."""
        step = min(self.world.steps, len(self._targets) - 1)
        before, after = (from_pose(self._targets[k]) for k in (max(step - 1, 0), max(step, 1)))
        rate = self.setup.settings.frequency
        turn = after @ transforms.inverse(before)
        centre = self.world.centre_of_mass(TOOL)
        self.world.let_go(TOOL)
        self.world.set_velocity(TOOL, (transforms.apply(turn, centre[None])[0] - centre) * rate)
        self.world.set_turning(TOOL, Rotation.from_matrix(turn[:3, :3]).as_rotvec() * rate)

    def joints(self) -> NDArray[np.float64]:
        """(0,): there is no arm."""
        return np.zeros(0)

    def hand_has_left(self) -> float:
        """By how many metres the hand has gone away from where it let the tool go: there is no hand."""
        return np.inf

    def intrusions(
        self,
        interval: float = 0.02,
        check: Callable[[float], None] = lambda _time: None,
        harmless: float = 0.0,
        planned: float = np.inf,
    ) -> tuple[Intrusion, ...]:
        """The deepest overlap of the planned tool with each static body and the table, before and after the contact
        phase begins, sampled every ``interval`` seconds up to the release, and every :data:`BETWEEN_LOOKS` of its way; ``check`` may raise
        to end it early.

        ``harmless``: a depth in metres of which nobody has to know.  A tool comes no deeper than by what it moves: samples at which it
        cannot be deeper than that are left out, and overlaps that are not deeper may be told as less than they are.  ``planned``: what this
        found of the tool as it is thought to be, at the deepest, m: no obstacle is looked at where what the tool is off by adds too little
        to that, nor the table where that itself is harmless, as a tool that is off is raised to go no deeper into it.
        """
        setup, motion = self.setup, self._motion
        others = {o.id: (list(o.hulls), o.world_from_object) for o in setup.obstacles}
        if setup.target_kind == STATIC:
            others[TARGET] = (list(setup.target.hulls), setup.target.world_from_object)
        elif planned + self._off <= harmless:
            others = {}
        if not others and planned <= harmless:
            return ()
        end = min((t for t in (self.release_time, self.strike_time) if t is not None), default=self.duration)
        times, poses = _looks(motion, setup.tool, end, interval)
        worst: dict[tuple[str, bool], Intrusion] = {}

        def note(name: str, depth: float, time: float) -> None:
            early = time < self.contact_time
            if depth > 0 and ((known := worst.get((name, early))) is None or depth > known.depth):
                worst[(name, early)] = Intrusion(name, depth, time, early)

        if planned > harmless:
            below = -_heights(poses, setup.tool.outermost, setup.table)
            for time, depth in zip(times, below, strict=True):
                note(TABLE, float(depth), float(time))
        near = _near(setup.tool, poses, others)
        if near.any():
            probe = Probe(setup.settings, list(setup.tool.hulls), others)
            way = np.concatenate([[0.0], np.cumsum(_ways(poses, setup.tool))])[near]
            known = -np.inf  # so far on its way it is no deeper than what is harmless
            for index, (time, at, pose) in enumerate(zip(times[near], way, to_poses(poses[near]), strict=True)):
                if index % 32 == 0:
                    check(0.0)
                if at < known:
                    continue
                depths = probe.depths(pose)
                known = at + harmless - max(depths.values(), default=0.0)
                for name, depth in depths.items():  # one may bear what another does not
                    note(name, depth, float(time))
        return tuple(worst.values())


def _looks(motion: ToolMotion, tool: Body, end: float, interval: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Moments (T,), s from the motion's beginning to ``end``, and the tool's poses then (T, 4, 4): ``interval`` seconds apart, nearer where
    the tool is fast."""

    def posed(times: NDArray[np.float64]) -> NDArray[np.float64]:
        return transforms.interpolate(motion.times, motion.world_from_tool, motion.times[0] + times)

    times = np.append(np.arange(0.0, end, interval), end)
    poses = posed(times)
    parts = np.ceil(_ways(poses, tool) / BETWEEN_LOOKS).astype(int)
    if (parts <= 1).all():
        return times, poses
    between = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(times, times[1:], np.maximum(parts, 1), strict=False)]
    times = np.concatenate([*between, times[-1:]])
    return times, posed(times)


def _apart(tool: Body, thought: Body, tool_from_held: NDArray[np.float64]) -> float:
    """How far (m) any corner of a tool that is held, and shaped, otherwise than thought is at most from where it is thought to be; infinite
    where that does not bound how far its surface is: of balls, and of other pieces."""
    if [len(hull) for hull in tool.hulls] != [len(hull) for hull in thought.hulls] or any(ball is not None for ball in tool.balls):
        return np.inf
    return float(np.linalg.norm(transforms.apply(tool_from_held, tool.corners) - thought.corners, axis=1).max())


def _clear_of_table(
    setup: Setup, poses: NDArray[np.float64], tool_from_held: NDArray[np.float64], thought: Body
) -> tuple[NDArray[np.float64], float]:
    """The poses (T, 4, 4) of a tool that is held otherwise, and shaped otherwise, than thought, raised together so that it goes no deeper
    into the table than 0, or than it was planned to: a hand gives way to the table by what it is off; and by how much (m)."""
    held = poses @ tool_from_held
    allowed = min(0.0, float(_heights(poses, thought.outermost, setup.table).min()))
    # All corners of a tool that is drawn: to find the outermost of them takes longer than what they save.
    depth = max(0.0, allowed - float(_heights(held, setup.tool.corners, setup.table).min()))
    held[:, :3, 3] += depth * setup.table[:3]
    return held, depth


def _heights(poses: NDArray[np.float64], corners: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """(T,): how high the lowest of corners (N, 3) is above the table (4,) at each of the poses (T, 4, 4), m."""
    normal = table[:3]
    return np.asarray(((normal @ poses[:, :3, :3]) @ corners.T).min(axis=1) + poses[:, :3, 3] @ normal + table[3])


def nears(
    setup: Setup, poses: NDArray[np.float64], times: NDArray[np.float64], within: float, others: tuple[Body, ...] | None = None
) -> float | None:
    """The first of the times (T,) at which the box of one of the tool's pieces comes within so many metres of that of one of another
    body's (default: target and obstacles)."""
    others = (setup.target, *setup.obstacles) if others is None else others
    boxes = [transforms.apply(body.world_from_object, hull) for body in others for hull in body.hulls]
    low, high = np.array([b.min(axis=0) for b in boxes]) - within, np.array([b.max(axis=0) for b in boxes]) + within
    whole = {"": ([np.array([low.min(axis=0), high.max(axis=0)])], np.eye(4))}
    for index in np.flatnonzero(_near(setup.tool, poses, whole)):
        moved = [hull @ poses[index, :3, :3].T + poses[index, :3, 3] for hull in setup.tool.hulls]
        mine_low, mine_high = np.array([m.min(axis=0) for m in moved]), np.array([m.max(axis=0) for m in moved])
        if np.any(np.all((mine_low[:, None] <= high) & (mine_high[:, None] >= low), axis=2)):
            return float(times[index])
    return None


def _near(
    tool: Body, poses: NDArray[np.float64], others: dict[str, tuple[list[NDArray[np.float64]], NDArray[np.float64]]]
) -> NDArray[np.bool_]:
    """At which of the poses (T, 4, 4) the axis-aligned box of the tool meets that of one of the bodies: (T,)."""
    boxes = []
    for hulls, world_from_object in others.values():
        points = transforms.apply(world_from_object, np.concatenate(hulls))
        boxes.append((points.min(axis=0), points.max(axis=0)))
    near = np.zeros(len(poses), dtype=bool)
    if not boxes:
        return near
    meets = np.ones((len(boxes), len(poses)), dtype=bool)
    for axis in range(3):
        along = poses[:, axis, :3] @ tool.outermost.T + poses[:, axis, 3:]
        low, high = along.min(axis=1), along.max(axis=1)
        for row, (box_low, box_high) in zip(meets, boxes, strict=True):
            row &= (low <= box_high[axis]) & (high >= box_low[axis])
    return meets.any(axis=0)


def as_object(
    item_id: str, mesh: Mesh, pieces: tuple[Mesh, ...], world_from_object: NDArray[np.float64], kind: str = "top", source: str = "known"
) -> SceneObject:
    """A SceneObject of a mesh and its pieces without a picture, for simulations that need none."""
    from magic_core.scene import CanonicalView

    blank = CanonicalView(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), bool), 1.0, np.eye(4), kind)
    return SceneObject(item_id, mesh, pieces, np.asarray(world_from_object, dtype=float), blank, source=source)
