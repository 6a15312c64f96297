"""The goal tests: what decides, in simulation, whether a motion did its task.

Each test watches a run step by step and ends with a judgement.  Its numbers come
from ``strategy.goal.values``.  A test has two parts.  The first is that of the tasks
as the paper's authors released them, with their numbers:

=========  =========================================================================
``hook``   the target is pulled ``distance`` (0.2 m), drifts sideways by less than
           ``drift`` (0.5) times its radius, and is slower than ``max_speed`` (0.5
           m/s).  ``noise`` (1.0): standard deviation, in target radii per second, of
           the kick that its sideways velocity gets at each 1/240 s.
``hang``   the tool does not overlap the target where the motion starts, and
           ``settle`` (2.25 s, 540 steps at 240 Hz) after it was let go it is above
           ``height`` (0.2 m) and slower than ``max_speed`` (0.5 m/s).
``scoop``  the target is above ``height`` (0.2 m), touches the tool, and both are
           slower than ``max_speed`` (0.1 m/s), ``settle`` (1 s) after the motion.
``drive``  the target, which resists along its axis with ``resistance`` (8 N), was driven
           ``depth`` (5 mm) along minus its normal, and sideways by less than ``drift`` (3 mm).
``sweep``  the target and ``others`` (2) like it, ``spacing`` (50 mm) apart on its sides, were
           all moved ``distance`` (0.1 m) along minus its normal, each sideways by less than
           ``drift`` (50 mm).
=========  =========================================================================

What passes these by chance, held by something else or by friction that no real pair of
materials has, is found by the second:

=========  =========================================================================
``hook``   when the pull is turned by ``hold`` (30 degrees) to one side the target
           stays in the tool, and to the other it falls back no faster than along a
           flat face: the contact encloses it, is hollow towards the pull, or is the
           corner of an L; a flat or round thing that pushes it along is none of
           these.  ``hold: 0`` asks no such thing.
``hang``   the tool comes to rest (below ``rest``, 0.02 m/s, and ``rest_turn``, 0.3
           rad/s), touches the target and nothing else, its centre of mass is below
           what holds it, the arm has gone away, and all of that is still so after it
           was pushed in several directions at ``nudge`` (0.15 m/s), with a friction
           of no more than ``hold_friction`` (0.3).
``scoop``  the target lies on the tool alone, not stuck in it, and stays there when it
           is pushed in several directions at ``nudge`` (0.1 m/s).
=========  =========================================================================

Heights are those of the middle of the object above the table.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.strategy import Strategy
from magic_verifier.floating import TARGET, TOOL, fill_world, phase_end, phase_start
from magic_verifier.simulation import DYNAMIC, KINEMATIC, World, to_poses

#: Contact is sought this far apart (m): bodies that press on each other rest at up to the solver's slop.
TOUCH = 0.001
#: Contact is looked for every so many steps.
OBSERVE_EVERY = 6
#: What swings comes to rest within seconds under this damping (1/s), as it does by itself within a minute; damping holds nothing up.
CALM = 3.0
#: How long a thing gets to come to rest (s), and how long after a nudge (s) it may still slide, swing or begin to fall: from a
#: balance it falls by a centimetre within 0.05 s, and a swing of 0.2 m length passes its middle after 0.22 s.
REST_WITHIN = 2.5
AFTER_NUDGE = 0.45
#: State is looked at every so many seconds while things come to rest.
LOOK_EVERY = 0.1
#: A drawn rollout lets the tool settle no longer than this (s) before it is calmed down: a fall takes a quarter of a second.
SOON = 0.75
#: The hand has gone away when it is farther than this (m) from where it let go: a finger's breadth more than fingers reach round.
HAND_AWAY = 0.03
#: What is deeper than this (m) in another body is stuck in it; what lies on it is in by a tenth of a millimetre or less.
STUCK = 0.001
#: Pulls that try whether a hook holds: of this many target radii, within these bounds (m), at this speed (m/s).
HOLD_RADII, HOLD_BOUNDS, HOLD_SPEED = 3.0, (0.06, 0.12), 0.2
#: Over the last third of such a pull a target that is held goes with the tool, and one at a flat face without friction falls back
#: along it by the sine of the angle.  Of that sine: below HELD it is held, up to FLAT the face is no worse than flat.
HELD, FLAT = 0.5, 1.1
#: "Stronger noise" of hooking: so many times the kicks of the released code's test.
STRONGER = 2.0


@dataclass(frozen=True)
class Judgement:
    """What a goal test found: OK or why not, a sentence with numbers, and what it measured (SI units).

    The metric ``released_test`` is 1 where the released code's test passed, whatever came of the rest.
    """

    code: Code
    message: str
    metrics: dict[str, float] = field(default_factory=dict)

    @property
    def cause(self) -> str:
        """The sentence up to its numbers: what equal failures have in common."""
        return re.split(r":| at [0-9]", self.message, maxsplit=1)[0]


#: Steps a run on for some seconds, keeping deadline and cancel request, looking for explosions.
GoOn = Callable[[float], None]


class GoalTest:
    """Base of the goal tests.

    ``run`` is a floating or an arm run (``world``, ``time``, ``phase``, ``phases``,
    ``setup``, ``duration``, ``released``).  ``settle``: seconds to go on after the motion.
    ``nudge``: direction (rad) of the first nudge of a drawn rollout, ``None`` for the scene as given.
    """

    settle = 0.0
    #: The goal values that the test knows, with what they are where the strategy gives none.
    defaults: ClassVar[dict[str, float]] = {}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        self.strategy = strategy
        self.rng = rng
        self.nudge = nudge
        unknown = sorted(set(strategy.goal.values) - set(self.defaults))
        if unknown:
            raise MagicError(Code.BAD_STRATEGY, f"goal values of {strategy.goal.test}", ", ".join(unknown), list(self.defaults))
        self.values = {**self.defaults, **strategy.goal.values}

    @classmethod
    def around(cls, strategy: Strategy) -> float:
        """How far (m) from the target bodies of the test's own may stand."""
        return 0.0

    def until(self, run: Any) -> float:
        """The moment of the motion at which the run may end."""
        moment = run.duration + self.settle
        return moment if run.release_time is None else max(moment, run.release_time + self.settle)

    def disturb(self, run: Any) -> None:
        """Before each step."""

    def observe(self, run: Any) -> None:
        """After each step."""

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        """After the last step; ``go_on`` steps the run further."""
        raise NotImplementedError

    def directions(self) -> list[NDArray[np.float64]]:
        """Horizontal unit vectors (3,) of the nudges: four of them in the scene as given, else three that begin anywhere."""
        count, first = (4, 0.0) if self.nudge is None else (3, self.nudge)
        return [np.array([np.cos(a), np.sin(a), 0.0]) for a in first + 2 * np.pi * np.arange(count) / count]


def _middle(run: Any, name: str) -> NDArray[np.float64]:
    body = run.setup.tool if name == TOOL else run.setup.target
    return transforms.apply(run.world.pose(name), body.centre)


def _height(run: Any, name: str) -> float:
    middle = _middle(run, name)
    return float(middle[2]) - run.setup.table_height(middle)


def _others(run: Any, name: str, holder: str) -> list[str]:
    """What a body touches beside what is to hold it."""
    return [other for other in run.world.touched_by(name, TOUCH) if other != holder]


class Hook(GoalTest):
    """Pull the target; see the module's table."""

    defaults: ClassVar[dict[str, float]] = {"distance": 0.2, "drift": 0.5, "max_speed": 0.5, "noise": 1.0, "hold": 30.0}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        super().__init__(strategy, run, rng, nudge)
        if not 0 <= self.values["hold"] < 90:
            raise MagicError(Code.BAD_STRATEGY, "goal value hold of hook", self.values["hold"], "0 to below 90 degrees")
        target = run.setup.target
        pull = -np.asarray(strategy.target_normal, dtype=float)
        pull[2] = 0.0
        if np.linalg.norm(pull) < 1e-6:
            raise MagicError(
                Code.BAD_STRATEGY, "target_normal of a hooking strategy", strategy.target_normal, "a direction along the table"
            )
        self.pull = transforms.unit(pull)
        self.sideways = np.cross([0, 0, 1.0], self.pull)
        corners = transforms.apply(target.world_from_object, target.corners)
        across = corners @ self.sideways
        self.radius = float(across.max() - across.min()) / 2
        start, end = phase_start(run.phases, ("contact", "goal")), phase_end(run.phases, "goal")
        self.start = 0.0 if start is None else start
        self.end = run.duration if end is None else end
        self.goal_start = phase_start(run.phases, ("goal",)) or self.start
        self.origin = transforms.apply(target.world_from_object, target.centre)
        self._kick = self.values["noise"] * self.radius * np.sqrt(240.0 / run.setup.settings.frequency)
        self._touching: list[tuple[float, bool]] = []
        self._final: tuple[float, float, float] | None = None
        self._held: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._world: World | None = None

    def until(self, run: Any) -> float:
        # The retreat is looked at once, in the scene as given; what is judged is over by then.
        return super().until(run) if self.nudge is None else min(super().until(run), self.end)

    def disturb(self, run: Any) -> None:
        if self._kick > 0 and self.start <= run.time < self.end:
            run.world.set_velocity(TARGET, run.world.velocity(TARGET) + self.rng.normal(0, self._kick) * self.sideways)

    def observe(self, run: Any) -> None:
        if run.world.steps % OBSERVE_EVERY == 0 and self.goal_start <= run.time <= self.end:
            self._touching.append((run.time, run.world.touching(TOOL, TARGET, TOUCH)))
        if self._final is None and run.time >= self.end:
            self._note(run)

    def _note(self, run: Any) -> tuple[float, float, float]:
        moved = _middle(run, TARGET) - self.origin
        self._held = run.world.pose(TOOL), run.world.pose(TARGET)
        self._final = (float(moved @ self.pull), float(moved @ self.sideways), float(np.linalg.norm(run.world.velocity(TARGET))))
        return self._final

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        pulled, drift, speed = self._final or self._note(run)
        times = np.array([t for t, _ in self._touching])
        touching = np.array([c for _, c in self._touching], dtype=bool)
        last = touching[times > self.end - 0.2 * (self.end - self.goal_start)] if len(times) else touching
        metrics = {
            "pulled_distance": pulled,
            "sideways_drift": abs(drift),
            "final_speed": speed,
            "contact_share": float(touching.mean()) if len(touching) else 0.0,
            "target_radius": self.radius,
            "released_test": 0.0,
        }
        distance, limit, fastest = self.values["distance"], self.values["drift"] * self.radius, self.values["max_speed"]
        state = f"pulled {pulled * 1000:.0f} mm, drifted {abs(drift) * 1000:.1f} mm sideways, moving at {speed:.2f} m/s"
        if pulled < distance and not last.any():
            return Judgement(Code.LOST_CONTACT, f"the tool lost the target: {state} (needed: {distance * 1000:.0f} mm)", metrics)
        if abs(drift) >= limit:
            return Judgement(
                Code.DRIFT,
                f"the target slid off sideways: {state} (allowed: below {limit * 1000:.1f} mm, {self.values['drift']:g} of its radius)",
                metrics,
            )
        if pulled < distance:
            return Judgement(Code.GOAL_NOT_REACHED, f"not pulled far enough: {state} (needed: {distance * 1000:.0f} mm)", metrics)
        if speed >= fastest:
            return Judgement(Code.UNSTABLE, f"the target flew off: {state} (allowed: below {fastest:g} m/s)", metrics)
        metrics["released_test"] = 1.0
        return self._judge_hold(run, state, metrics)

    def _judge_hold(self, run: Any, state: str, metrics: dict[str, float]) -> Judgement:
        """Whether the contact holds: pulls that go on from where the motion's ended, turned to either side, and one under noise."""
        angle = self.values["hold"]
        if angle == 0:
            return Judgement(Code.OK, f"the target was {state}", metrics)
        slips = [self._slip(run, np.deg2rad(side * angle)) for side in (1.0, -1.0)]
        held, flat = HELD * np.sin(np.deg2rad(angle)), FLAT * np.sin(np.deg2rad(angle))
        sides = sum(slip < held for slip in slips)
        metrics["hold_slip"] = max(slips)
        metrics["sides_held"] = float(sides)
        metrics["holds"] = float(sides > 0 and max(slips) < flat)
        metrics["holds_in_stronger_noise"] = float(self._slip(run, 0.0, STRONGER * self.radius) < held)
        turned = (
            f"with the pull turned by {angle:g} degrees to either side it falls back by {100 * slips[0]:.0f} and {100 * slips[1]:.0f} % "
            "of the way"
        )
        noisy = f"in noise of {STRONGER:g} radii it {'stays' if metrics['holds_in_stronger_noise'] else 'is lost'}"
        if not metrics["holds"]:
            return Judgement(
                Code.DRIFT,
                f"the tool pushes the target but does not hold it: {turned} (allowed: below {100 * held:.0f} % to one side and "
                f"{100 * flat:.0f} % to the other), {noisy}; the pull itself: {state}",
                metrics,
            )
        return Judgement(Code.OK, f"the target was {state}; {turned}, {noisy}", metrics)

    def _slip(self, run: Any, turn: float, kick: float = 0.0) -> float:
        """By how much of its way the tool leaves the target behind, or to the side, in the last third of a pull that goes on turned
        by an angle (rad), with kicks of the sideways velocity (standard deviation in m/s at each 1/240 s)."""
        assert self._held is not None
        tool, target = self._held
        setup, settings = run.setup, run.setup.settings
        if self._world is None:
            self._world = self._hold_world(run)
        world = self._world
        world.place(TOOL, tool)
        world.place(TARGET, target)
        along = np.cos(turn) * self.pull + np.sin(turn) * self.sideways
        across = np.cross([0, 0, 1.0], along)
        length = float(np.clip(HOLD_RADII * self.radius, *HOLD_BOUNDS))
        steps = int(np.ceil(length / HOLD_SPEED * settings.frequency))
        kick *= np.sqrt(240.0 / settings.frequency)
        before = np.zeros(3)
        stack = np.repeat(tool[None], steps, axis=0)
        stack[:, :3, 3] += along * (length * np.arange(1, steps + 1) / steps)[:, None]
        poses = to_poses(stack)
        for step in range(1, steps + 1):
            if kick > 0:
                world.set_velocity(TARGET, world.velocity(TARGET) + self.rng.normal(0, kick) * across)
            world.move_to(TOOL, poses[step - 1])
            world.step()
            if step == 2 * steps // 3:
                before = transforms.apply(world.pose(TARGET), setup.target.centre) - length * step / steps * along
        after = transforms.apply(world.pose(TARGET), setup.target.centre) - length * along
        slip = float(np.linalg.norm((after - before)[:2]) / (length / 3))
        return slip if np.isfinite(slip) else 1.0

    def _hold_world(self, run: Any) -> World:
        """A world of the tool, moved, and the target on the table: what is around them is no part of the question."""
        assert self._held is not None
        tool, target = self._held
        setup = run.setup
        alone = replace(
            setup,
            obstacles=(),
            tool=replace(setup.tool, world_from_object=tool),
            target=replace(setup.target, world_from_object=target),
            target_kind=DYNAMIC,
        )
        return fill_world(alone, KINEMATIC)


class Hang(GoalTest):
    """Let the tool hang on the target; see the module's table.

    ``nudge`` 0.15 m/s: what a hand that brushes by or a slammed door gives; it lifts a thing by no more than 1.1 mm.  ``hold_friction``
    0.3: dry wood, steel, plastic and ceramics have 0.2 to 0.6 with each other, and the released code's 3.0 glues things together: what
    hangs by its shape needs no more.
    """

    defaults: ClassVar[dict[str, float]] = {
        "height": 0.2,
        "max_speed": 0.5,
        "settle": 2.25,
        "rest": 0.02,
        "rest_turn": 0.3,
        "nudge": 0.15,
        "hold_friction": 0.3,
    }

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        super().__init__(strategy, run, rng, nudge)
        self.settle = self.values["settle"] if nudge is None else min(self.values["settle"], SOON)

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        height = _height(run, TOOL)
        speed = float(np.linalg.norm(run.world.velocity(TOOL)))
        touching = run.world.touching(TOOL, TARGET, TOUCH)
        metrics = {"tool_height": height, "final_speed": speed, "touching": float(touching), "released_test": 0.0}
        needed, fastest = self.values["height"], self.values["max_speed"]
        state = (
            f"{height * 1000:.0f} mm above the table, moving at {speed:.2f} m/s, {'touching' if touching else 'not touching'} the target"
        )
        if not run.released:
            return Judgement(Code.GOAL_NOT_REACHED, f"the tool was never let go: {state}", metrics)
        if height <= needed:
            code = Code.GOAL_NOT_REACHED if touching else Code.LOST_CONTACT
            return Judgement(code, f"the tool fell when let go: {state} (needed: above {needed * 1000:.0f} mm)", metrics)
        if speed >= fastest and self.nudge is None:
            return Judgement(Code.UNSTABLE, f"the tool does not come to rest: {state} (allowed: below {fastest:g} m/s)", metrics)
        metrics["released_test"] = 1.0
        return self._judge_hold(run, go_on, metrics)

    def _judge_hold(self, run: Any, go_on: GoOn, metrics: dict[str, float]) -> Judgement:
        away = run.hand_has_left()
        if away < HAND_AWAY:
            return Judgement(
                Code.GOAL_NOT_REACHED,
                f"the hand has not gone away: it is {away * 1000:.0f} mm from where it let go (needed: {HAND_AWAY * 1000:g} mm)",
                metrics,
            )
        for name in (TOOL, TARGET):
            run.world.set_friction(name, min(run.setup.physics.friction, self.values["hold_friction"]))
        run.world.calm(TOOL, CALM)
        for _ in range(round(REST_WITHIN / LOOK_EVERY)):
            go_on(LOOK_EVERY)
            if self._rests(run) or _height(run, TOOL) <= self.values["height"]:
                break
        fault = self._fault(run, metrics, "")
        if fault is not None:
            return fault
        height = _height(run, TOOL)
        for index, direction in enumerate(self.directions()):
            run.world.set_velocity(TOOL, run.world.velocity(TOOL) + self.values["nudge"] * direction)
            for _ in range(2):  # what it only knocks against on its way counts as well
                go_on(AFTER_NUDGE / 2)
                fault = self._touch_fault(run, metrics, f" after nudge {index + 1}")
                if fault is not None:
                    return fault
        for _ in range(round(REST_WITHIN / LOOK_EVERY)):
            if self._rests(run):
                break
            go_on(LOOK_EVERY)
        fault = self._fault(run, metrics, f", pushed in {len(self.directions())} directions at {self.values['nudge']:g} m/s")
        if fault is not None:
            return fault
        metrics["sank"] = height - _height(run, TOOL)
        return Judgement(
            Code.OK,
            f"the tool hangs {_height(run, TOOL) * 1000:.0f} mm above the table, on the target alone, its centre of mass "
            f"{metrics['below_support'] * 1000:.0f} mm below what holds it, and stays when pushed at {self.values['nudge']:g} m/s",
            metrics,
        )

    def _rests(self, run: Any) -> bool:
        return self._speeds(run)[0] < self.values["rest"] and self._speeds(run)[1] < self.values["rest_turn"]

    def _speeds(self, run: Any) -> tuple[float, float]:
        return float(np.linalg.norm(run.world.velocity(TOOL))), float(np.linalg.norm(run.world.turning(TOOL)))

    def _touch_fault(self, run: Any, metrics: dict[str, float], when: str) -> Judgement | None:
        others = _others(run, TOOL, TARGET)
        if not others:
            return None
        return Judgement(
            Code.GOAL_NOT_REACHED,
            f"the tool does not hang by itself{when}: it touches {', '.join(others)} (allowed: the target alone)",
            metrics,
        )

    def _fault(self, run: Any, metrics: dict[str, float], when: str) -> Judgement | None:
        """What is wrong with how the tool hangs, ``None`` if nothing is; notes what it measures."""
        height, needed = _height(run, TOOL), self.values["height"]
        touching = run.world.touching(TOOL, TARGET, TOUCH)
        speed, turning = self._speeds(run)
        metrics.update(tool_height=height, final_speed=speed, final_turning=turning, touching=float(touching))
        if height <= needed:
            return Judgement(
                Code.UNSTABLE if when else Code.LOST_CONTACT,
                f"the tool fell{when}: {height * 1000:.0f} mm above the table (needed: above {needed * 1000:.0f} mm, with a friction of "
                f"{min(run.setup.physics.friction, self.values['hold_friction']):.2g})",
                metrics,
            )
        fault = self._touch_fault(run, metrics, when)
        if fault is not None:
            return fault
        if not touching:
            return Judgement(Code.LOST_CONTACT, f"the tool touches nothing{when}: {height * 1000:.0f} mm above the table", metrics)
        if not self._rests(run):
            return Judgement(
                Code.UNSTABLE,
                f"the tool does not come to rest{when}: {speed:.3f} m/s and {turning:.2f} rad/s (allowed: below {self.values['rest']:g} m/s "
                f"and {self.values['rest_turn']:g} rad/s)",
                metrics,
            )
        held_at = max(touch.position[2] for touch in run.world.touches(TOOL, TARGET, TOUCH))
        metrics["below_support"] = float(held_at - run.world.centre_of_mass(TOOL)[2])
        if metrics["below_support"] <= 0:
            return Judgement(
                Code.UNSTABLE,
                f"the tool lies balanced{when}: its centre of mass is {-metrics['below_support'] * 1000:.0f} mm above what holds it "
                "(allowed: below it)",
                metrics,
            )
        return None


class Scoop(GoalTest):
    """Lift the target in the tool; see the module's table.

    ``nudge`` 0.1 m/s: the jolt of an arm that stops or turns, which lifts a rolling ball by 0.7 mm.
    """

    defaults: ClassVar[dict[str, float]] = {"height": 0.2, "max_speed": 0.1, "settle": 1.0, "nudge": 0.1}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        super().__init__(strategy, run, rng, nudge)
        self.settle = self.values["settle"] if nudge is None else min(self.values["settle"], SOON)
        self._highest = 0.0
        self._touching = False

    def observe(self, run: Any) -> None:
        if run.world.steps % OBSERVE_EVERY:
            return
        self._highest = max(self._highest, float(run.world.position(TARGET)[2]))
        # The ball rocks a little in the bowl: touched within the last tenth of a second counts.
        if run.time >= run.duration + self.settle - 0.1:
            self._touching = self._touching or run.world.touching(TOOL, TARGET, TOUCH)

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        height = _height(run, TARGET)
        speed = float(np.linalg.norm(run.world.velocity(TARGET)))
        tool_speed = float(np.linalg.norm(run.world.velocity(TOOL)))
        touching = self._touching
        metrics = {
            "target_height": height,
            "highest": self._highest,
            "target_speed": speed,
            "tool_speed": tool_speed,
            "touching": float(touching),
            "released_test": 0.0,
        }
        needed, fastest = self.values["height"], self.values["max_speed"]
        state = (
            f"{height * 1000:.0f} mm above the table (at most {self._highest * 1000:.0f} mm on the way), moving at {speed:.2f} m/s, "
            f"{'touching' if touching else 'not touching'} the tool"
        )
        if height <= needed:
            code = Code.GOAL_NOT_REACHED if touching else Code.LOST_CONTACT
            return Judgement(code, f"the target was not lifted: {state} (needed: above {needed * 1000:.0f} mm)", metrics)
        if not touching:
            return Judgement(Code.LOST_CONTACT, f"the target left the tool: {state}", metrics)
        if speed >= fastest or tool_speed >= fastest:
            return Judgement(
                Code.UNSTABLE, f"not at rest: {state}, the tool at {tool_speed:.2f} m/s (allowed: below {fastest:g} m/s)", metrics
            )
        metrics["released_test"] = 1.0
        fault = self._fault(run, metrics, "")
        if fault is not None:
            return fault
        for direction in self.directions():
            run.world.set_velocity(TARGET, run.world.velocity(TARGET) + self.values["nudge"] * direction)
            go_on(AFTER_NUDGE)
        go_on(AFTER_NUDGE)
        fault = self._fault(run, metrics, f", pushed in {len(self.directions())} directions at {self.values['nudge']:g} m/s")
        if fault is not None:
            return fault
        return Judgement(
            Code.OK, f"the target lies in the tool, on it alone, and stays when pushed at {self.values['nudge']:g} m/s: {state}", metrics
        )

    def _fault(self, run: Any, metrics: dict[str, float], when: str) -> Judgement | None:
        """What is wrong with how the target lies in the tool, ``None`` if nothing is."""
        height, needed, fastest = _height(run, TARGET), self.values["height"], self.values["max_speed"]
        speed = float(np.linalg.norm(run.world.velocity(TARGET)))
        touches = run.world.touches(TARGET, TOOL, TOUCH)
        metrics.update(target_height=height, target_speed=speed)
        if height <= needed:
            return Judgement(
                Code.LOST_CONTACT,
                f"the target fell out of the tool{when}: {height * 1000:.0f} mm above the table (needed: above {needed * 1000:.0f} mm)",
                metrics,
            )
        others = _others(run, TARGET, TOOL)
        if others:
            return Judgement(
                Code.GOAL_NOT_REACHED,
                f"the target does not lie in the tool by itself{when}: it touches {', '.join(others)} (allowed: the tool alone)",
                metrics,
            )
        if when and not touches:
            return Judgement(Code.LOST_CONTACT, f"the target left the tool{when}: {height * 1000:.0f} mm above the table", metrics)
        metrics["depth_in_tool"] = depth = max((-touch.separation for touch in touches), default=0.0)
        if depth > STUCK:
            return Judgement(
                Code.UNSTABLE,
                f"the target is stuck in the tool{when}: {depth * 1000:.1f} mm deep (allowed: {STUCK * 1000:g} mm)",
                metrics,
            )
        if when and speed >= fastest:
            return Judgement(
                Code.UNSTABLE, f"the target does not come to rest{when}: {speed:.2f} m/s (allowed: below {fastest:g} m/s)", metrics
            )
        return None


def _along(strategy: Strategy) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The direction (3,) in which the target is to go, level, and the one to its left; raises ``BAD_STRATEGY``."""
    along = -np.asarray(strategy.target_normal, dtype=float) * [1, 1, 0]
    if np.linalg.norm(along) < 1e-6:
        raise MagicError(
            Code.BAD_STRATEGY, f"target_normal of a strategy to {strategy.goal.test}", strategy.target_normal, "a direction along the table"
        )
    along = transforms.unit(along)
    return along, np.cross([0, 0, 1.0], along)


class Drive(GoalTest):
    """Drive the target along its axis against a resistance (Coulomb's, in newtons): the depth that a blow gains.

    ``depth`` is half of what the demonstrated mallet gains (10.4 mm).
    """

    settle = 0.5
    defaults: ClassVar[dict[str, float]] = {"depth": 0.005, "resistance": 8.0, "drift": 0.003}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        super().__init__(strategy, run, rng, nudge)
        self.along, self.sideways = _along(strategy)
        if run.variant != "fg" or phase_start(run.phases, ("strike",)) is None:
            # A tool on rails drives anything to any depth: that would be no finding.
            raise MagicError(
                Code.BAD_STRATEGY,
                f"motion of a strategy to {strategy.goal.test}",
                f"{run.variant} with phases {', '.join(phase.name for phase in run.phases) or 'none'}",
                "fg with a phase 'strike', in which the tool flies by its own momentum",
            )
        self.origin = _middle(run, TARGET)
        self._slowing = self.values["resistance"] / float(run.world.component(TARGET).mass) / run.setup.settings.frequency

    def disturb(self, run: Any) -> None:
        velocity = run.world.velocity(TARGET)
        speed = float(velocity @ self.along)
        if speed != 0.0:
            run.world.set_velocity(TARGET, velocity - np.sign(speed) * min(abs(speed), self._slowing) * self.along)

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        moved = _middle(run, TARGET) - self.origin
        depth, drift = float(moved @ self.along), abs(float(moved @ self.sideways))
        metrics = {"depth": depth, "sideways_drift": drift}
        state = f"driven {depth * 1000:.1f} mm, {drift * 1000:.1f} mm sideways"
        if depth < self.values["depth"]:
            return Judgement(
                Code.GOAL_NOT_REACHED, f"not driven deep enough: {state} (needed: {self.values['depth'] * 1000:g} mm)", metrics
            )
        if drift >= self.values["drift"]:
            return Judgement(Code.DRIFT, f"knocked aside: {state} (allowed: below {self.values['drift'] * 1000:g} mm)", metrics)
        return Judgement(Code.OK, f"the target was {state}, against {self.values['resistance']:g} N", metrics)


class Sweep(GoalTest):
    """Move the target and others like it, which stand beside it, along one direction."""

    settle = 0.3
    defaults: ClassVar[dict[str, float]] = {"distance": 0.1, "others": 2, "spacing": 0.05, "drift": 0.05}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> None:
        super().__init__(strategy, run, rng, nudge)
        self.along, self.sideways = _along(strategy)
        body, physics = run.setup.target, run.setup.physics
        self.names = [TARGET]
        for number in range(round(self.values["others"])):
            # To the left, to the right, further to the left, ...
            aside = (number // 2 + 1) * self.values["spacing"] * (1 if number % 2 == 0 else -1)
            name = f"swept_{number + 1}"
            pose = transforms.make(translation=aside * self.sideways) @ body.world_from_object
            run.world.add(name, list(body.hulls), pose, DYNAMIC, physics.target_density, physics.friction, balls=body.balls)
            self.names.append(name)
        self.origins = [run.world.position(name) for name in self.names]

    @classmethod
    def around(cls, strategy: Strategy) -> float:
        values = {**cls.defaults, **strategy.goal.values}
        return float(np.ceil(values["others"] / 2) * values["spacing"])

    def judge(self, run: Any, go_on: GoOn) -> Judgement:
        moved = np.stack([run.world.position(name) - origin for name, origin in zip(self.names, self.origins, strict=True)])
        way, drift = moved @ self.along, np.abs(moved @ self.sideways)
        metrics = {
            "least_distance": float(way.min()),
            "most_drift": float(drift.max()),
            "swept": float((way >= self.values["distance"]).sum()),
        }
        ways = ", ".join(f"{1000 * w:.0f}" for w in way)
        state = f"swept {ways} mm, at most {1000 * drift.max():.0f} mm sideways"
        if way.min() < self.values["distance"]:
            return Judgement(
                Code.GOAL_NOT_REACHED,
                f"not all were swept far enough: {state} (needed: {self.values['distance'] * 1000:g} mm each)",
                metrics,
            )
        if drift.max() >= self.values["drift"]:
            return Judgement(Code.DRIFT, f"slid off sideways: {state} (allowed: below {self.values['drift'] * 1000:g} mm)", metrics)
        return Judgement(Code.OK, f"the {len(way)} objects were {state}", metrics)


#: Goal tests by the name that a strategy gives.
GOALS: dict[str, type[GoalTest]] = {"hook": Hook, "hang": Hang, "scoop": Scoop, "drive": Drive, "sweep": Sweep}


def goal_test(strategy: Strategy, run: Any, rng: np.random.Generator, nudge: float | None = None) -> GoalTest:
    """The goal test of a strategy, ready to watch a run; raises ``UNKNOWN_GOAL``.  ``nudge``: see :class:`GoalTest`."""
    require(strategy)
    return GOALS[strategy.goal.test](strategy, run, rng, nudge)


def require(strategy: Strategy) -> None:
    """Raise ``UNKNOWN_GOAL`` unless there is a goal test of that name."""
    if strategy.goal.test not in GOALS:
        raise MagicError(Code.UNKNOWN_GOAL, "goal test", strategy.goal.test, list(GOALS))
