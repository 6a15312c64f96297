"""What truly came of a trial: the strategy's goal test on where everything was.  No ROS here.

The goal tests of :mod:`magic_verifier.goals` watch a run of the verifier.  Here they watch the truth: tool, target and all else are put
where they were, step by step of the engine, in a world of the true things, and what a test asks beyond that (a nudge, a turned pull)
begins where the truth ends.  What an event of the scenario has put elsewhere began there: no tool has moved it that far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.loops import Opening
from magic_core.motion import Phase
from magic_core.rendering import Raycaster
from magic_core.sensor import STATION
from magic_lab.scenarios import Scene
from magic_lab.world import PLANE, SETTINGS, Thing
from magic_verifier.displacement import Place
from magic_verifier.floating import TARGET, TOOL, Body, Setup, fill_world
from magic_verifier.goals import Judgement, goal_test
from magic_verifier.simulation import DYNAMIC, KINEMATIC, STATIC, to_poses, usable_pieces
from magic_verifier.subjects import load_object

Array = NDArray[np.float64]

#: A thing has moved when it is farther than this (m) from where it was, or faster than this (m/s).
MOVED, MOVING = 0.01, 0.02
#: The tool has left the hand when it is farther (m) from where it was in it than this.
LEFT = 0.03
#: The region of a shape that goes round the opening of its loop.
LOOP = "handle_loop"
#: The truth's name for where an event has put a thing: the thing's, and this.
PUT = "/put"


@dataclass(frozen=True)
class Track:
    """Where everything truly was: times (T,) s, poses[name] (T, 4, 4) world_from_object, tcp (T, 4, 4) of the hand; put[name] (4, 4):
    where an event has put a thing, last."""

    times: Array
    poses: Mapping[str, Array]
    tcp: Array
    put: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, samples: Sequence[tuple[float, Mapping[str, Array]]], hand: str) -> Track:
        """Of (time, poses by name) with the hand among them; raises NO_FRAMES where there is none."""
        if len(samples) < 2:
            raise MagicError(Code.NO_FRAMES, "samples of the truth", len(samples), "at least 2")
        names = {name for name in set.intersection(*(set(poses) for _, poses in samples)) if not name.endswith(PUT)} - {hand}
        stacks = {name: np.stack([poses[name] for _, poses in samples]) for name in sorted(names)}
        put = {name.removesuffix(PUT): pose for name, pose in samples[-1][1].items() if name.endswith(PUT)}
        return cls(np.array([time for time, _ in samples]), stacks, np.stack([poses[hand] for _, poses in samples]), put)

    def moved(self, name: str) -> Array:
        """(T,): how far a thing is from where it began, m."""
        places = self.poses[name][:, :3, 3]
        return np.linalg.norm(places - places[0], axis=1)

    def begun(self, by: float, lead: float = 1.0) -> Track | None:
        """The track from ``lead`` seconds before the hand was first more than ``by`` metres from where it was; ``None``: it never was.
        While planner and verifier are at work nothing moves, and that may be minutes."""
        away = np.flatnonzero(np.linalg.norm((self.tcp - self.tcp[0])[:, :3, 3], axis=1) > by)
        if not len(away):
            return None
        first = int(np.searchsorted(self.times, self.times[away[0]] - lead))
        poses = {name: stack[first:] for name, stack in self.poses.items()}
        return replace(self, times=self.times[first:], poses=poses, tcp=self.tcp[first:])

    def let_go(self, tool: str) -> int | None:
        """The sample at which the tool, once taken up, has left the hand; ``None``: it was never taken, or is held."""
        carried = np.flatnonzero(self.moved(tool) > MOVED)
        if len(carried) == 0:
            return None
        in_hand = (np.linalg.inv(self.tcp) @ self.poses[tool])[:, :3, 3]
        away = np.flatnonzero(np.linalg.norm(in_hand[carried[0] :] - in_hand[carried[0]], axis=1) > LEFT)
        return int(carried[0] + away[0]) if len(away) else None


class Replay:
    """The truth as a run that a goal test can watch; :meth:`advance` goes on by one step of the engine."""

    variant = "arm"

    def __init__(self, scene: Scene, tool: str, track: Track) -> None:
        self._track, self._tool, self._target = track, tool, scene.target
        things = {thing.name: thing for thing in scene.things if thing.name in track.poses}

        def body(thing: Thing, name: str) -> Body:
            return Body(name, tuple(usable_pieces(name, thing.item.pieces)), track.put.get(thing.name, track.poses[thing.name][0]))

        # Where another thing was chosen, the one of that name is one of the others.
        names = {n: "not_the_target" if n == TARGET else n for n in things if n not in (tool, scene.target)}
        others = [replace(body(things[n], name), world_from_object=track.poses[n][-1]) for n, name in names.items()]
        true = things[scene.target]
        physics = replace(
            scene.strategy.physics, friction=things[tool].friction, tool_density=things[tool].density, target_density=true.density
        )
        self.setup = Setup(body(things[tool], TOOL), body(true, TARGET), tuple(others), PLANE, physics, true.kind, SETTINGS)
        self._gone = track.let_go(tool)
        self.duration = float(track.times[-1] - track.times[0])
        self._steps, self._told = 0, round(self.duration * SETTINGS.frequency)
        at = track.times[0] + np.arange(self._told + 1) / SETTINGS.frequency
        moving = ((TOOL, tool), (TARGET, scene.target)) if true.kind != STATIC else ((TOOL, tool),)
        ways = {name: transforms.interpolate(track.times, track.poses[thing], at) for name, thing in moving}
        self._ways = {name: (to_poses(way), np.diff(way[:, :3, 3], axis=0) * SETTINGS.frequency) for name, way in ways.items()}
        self.release_time = None if self._gone is None else float(track.times[self._gone] - track.times[0])
        self.world = fill_world(self.setup, KINEMATIC if self._gone is None else DYNAMIC)
        self.phases = (Phase("goal", *self._pull()),)

    def _pull(self) -> tuple[float, float]:
        """From when to when the target moved along with the tool, s, what rolls on after that left out; of one that never did: while it
        moved, and of one that never moved: all the time."""
        times, poses = self._track.times, self._track.poses
        target, tool = (np.gradient(poses[name][:, :3, 3], times, axis=0) for name in (self._target, self._tool))
        moves = np.linalg.norm(target, axis=1) > MOVING
        led = moves & (np.einsum("ti,ti->t", target, tool) > MOVING**2)
        moving = np.flatnonzero(led if led.any() else moves)
        first, last = (moving[0], moving[-1]) if len(moving) else (0, len(times) - 1)
        return float(times[first] - times[0]), float(times[last] - times[0])

    @property
    def time(self) -> float:
        """Seconds since the first sample."""
        return self._steps / SETTINGS.frequency

    @property
    def _index(self) -> int:
        """The newest sample of the truth."""
        times = self._track.times
        return int(np.searchsorted(times, times[0] + self.time + 1e-6, side="right")) - 1

    @property
    def phase(self) -> str:
        """The name of the present phase."""
        phase = self.phases[0]
        return phase.name if phase.start <= self.time < phase.end else ""

    @property
    def released(self) -> bool:
        """Whether the tool has left the hand."""
        return self._gone is not None and self._index >= self._gone

    def hand_has_left(self) -> float:
        """By how many metres the hand has gone away from where it let the tool go."""
        if self._gone is None:
            return 0.0
        # It is noticed once the tool is LEFT away.
        return LEFT + float(np.linalg.norm(self._track.tcp[self._index][:3, 3] - self._track.tcp[self._gone][:3, 3]))

    def advance(self) -> None:
        """Go on by a step, from where tool and target were; beyond the last sample physics alone goes on."""
        if self._steps < self._told:
            for name, (poses, speeds) in self._ways.items():
                self.world.put(name, poses[self._steps])
                if not self.world.component(name).kinematic:
                    self.world.set_velocity(name, speeds[self._steps])
        self.world.step()
        self._steps += 1

    def go_on(self, seconds: float) -> None:
        """Let physics go on from there."""
        for _ in range(round(seconds * SETTINGS.frequency)):
            self.world.step()


def judge(scene: Scene, tool: str, track: Track) -> Judgement:
    """What the strategy's goal test says of the truth, and where it is met whether other things stand where they stood; never raises
    for what may have happened to things."""
    try:
        run = Replay(scene, tool, track)
        test = goal_test(scene.strategy, run, np.random.default_rng(0))  # nobody kicks the target: it is not asked to disturb
        while run.time < max(run.duration, test.until()):
            run.advance()
            test.observe()
        found = test.judge(run.go_on)
    except MagicError as error:
        return Judgement(error.code, error.message)
    pushed = pushed_aside(scene, tool, track)
    if found.code != Code.OK or not pushed:
        return found
    told = ", ".join(f"{name} by {1000 * way:.0f} mm" for name, way in pushed.items())
    return Judgement(Code.OBSTACLE_PUSHED, f"{found.message}; but other things were moved: {told}", found.metrics)


def pushed_aside(scene: Scene, tool: str, track: Track) -> dict[str, float]:
    """How far (m) things that have no part in it have left the places where they began, of those that did by more than :data:`MOVED`."""
    others = [thing for thing in scene.things if thing.name in track.poses and thing.name not in (tool, scene.target, *track.put)]
    ways = {thing.name: _left_by(thing, *track.poses[thing.name][[0, -1]]) for thing in others}
    return {name: way for name, way in ways.items() if way > MOVED}


def _left_by(thing: Thing, first: Array, last: Array) -> float:
    place = Place(thing.item.mesh.vertices, first, middle(thing, first), PLANE[:3])
    return place.left_by(last, middle(thing, last))


def nearest(names: Mapping[str, Array], place: Array) -> str:
    """Of things by name and place (3,) that which is nearest to a place, level."""
    return min(names, key=lambda name: float(np.linalg.norm((names[name] - place)[:2])))


def middle(thing: Thing, pose: Array) -> Array:
    """(3,): where the middle of a thing's box is in the world."""
    return transforms.apply(pose, thing.item.mesh.bounds.mean(axis=0))


def loop_in_sight(scene: Scene, tool: str) -> float | None:
    """How much of the opening of a tool's loop is in a camera's sight where the tool lies at first, as a share of what there is from
    straight ahead: the most of any camera.  ``None`` where the tool has no such opening.

    Where hardly any is in sight of a camera it is right that nobody finds a handle.
    """
    shape = load_object(scene.case.tools[scene.tools.index(tool)], None)[2]
    if shape is None or LOOP not in shape.regions:
        return None
    opening = Opening.within(shape.region(LOOP).points).moved(scene.thing(tool).item.world_from_object)
    everything = Raycaster([thing.item.mesh.transformed(thing.item.world_from_object) for thing in scene.things])
    return max(opening.in_sight(world_from_camera[:3, 3], everything) for world_from_camera in STATION.values())
