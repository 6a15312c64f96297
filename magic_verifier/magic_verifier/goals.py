"""The goal tests: what decides, in simulation, whether a motion did its task.

Each test watches a run step by step and ends with a judgement.  Its numbers come
from ``strategy.goal.values``; the defaults are those of the tasks as the paper's
authors released them.

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
=========  =========================================================================

Heights are those of the middle of the object above the table.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.strategy import Strategy
from magic_verifier.floating import TARGET, TOOL, phase_end, phase_start

#: Contact is sought this far apart (m): bodies that press on each other rest at up to the solver's slop.
TOUCH = 0.001
#: Contact is looked for every so many steps.
OBSERVE_EVERY = 6


@dataclass(frozen=True)
class Judgement:
    """What a goal test found: OK or why not, a sentence with numbers, and what it measured (SI units)."""

    code: Code
    message: str
    metrics: dict[str, float] = field(default_factory=dict)


class GoalTest:
    """Base of the goal tests.

    ``run`` is a floating or an arm run (``world``, ``time``, ``phase``, ``phases``,
    ``setup``, ``duration``, ``released``).  ``settle``: seconds to go on after the motion.
    """

    settle = 0.0
    #: The goal values that the test knows, with what they are where the strategy gives none.
    defaults: ClassVar[dict[str, float]] = {}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator) -> None:
        self.strategy = strategy
        self.rng = rng
        unknown = sorted(set(strategy.goal.values) - set(self.defaults))
        if unknown:
            raise MagicError(Code.BAD_STRATEGY, f"goal values of {strategy.goal.test}", ", ".join(unknown), list(self.defaults))
        self.values = {**self.defaults, **strategy.goal.values}

    def disturb(self, run: Any) -> None:
        """Before each step."""

    def observe(self, run: Any) -> None:
        """After each step."""

    def judge(self, run: Any) -> Judgement:
        """After the last step."""
        raise NotImplementedError


def _middle(run: Any, name: str) -> NDArray[np.float64]:
    body = run.setup.tool if name == TOOL else run.setup.target
    return transforms.apply(run.world.pose(name), body.centre)


def _height(run: Any, name: str) -> float:
    middle = _middle(run, name)
    return float(middle[2]) - run.setup.table_height(middle)


class Hook(GoalTest):
    """Pull the target; see the module's table."""

    defaults: ClassVar[dict[str, float]] = {"distance": 0.2, "drift": 0.5, "max_speed": 0.5, "noise": 1.0}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator) -> None:
        super().__init__(strategy, run, rng)
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

    def disturb(self, run: Any) -> None:
        if self._kick > 0 and self.start <= run.time < self.end:
            run.world.set_velocity(TARGET, run.world.velocity(TARGET) + self.rng.normal(0, self._kick) * self.sideways)

    def observe(self, run: Any) -> None:
        if run.world.steps % OBSERVE_EVERY == 0 and self.goal_start <= run.time <= self.end:
            self._touching.append((run.time, run.world.touching(TOOL, TARGET, TOUCH)))
        if self._final is None and run.time >= self.end:
            moved = _middle(run, TARGET) - self.origin
            self._final = (float(moved @ self.pull), float(moved @ self.sideways), float(np.linalg.norm(run.world.velocity(TARGET))))

    def judge(self, run: Any) -> Judgement:
        if self._final is None:
            moved = _middle(run, TARGET) - self.origin
            self._final = (float(moved @ self.pull), float(moved @ self.sideways), float(np.linalg.norm(run.world.velocity(TARGET))))
        pulled, drift, speed = self._final
        times = np.array([t for t, _ in self._touching])
        touching = np.array([c for _, c in self._touching], dtype=bool)
        last = touching[times > self.end - 0.2 * (self.end - self.goal_start)] if len(times) else touching
        metrics = {
            "pulled_distance": pulled,
            "sideways_drift": abs(drift),
            "final_speed": speed,
            "contact_share": float(touching.mean()) if len(touching) else 0.0,
            "target_radius": self.radius,
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
        return Judgement(Code.OK, f"the target was {state}", metrics)


class Hang(GoalTest):
    """Let the tool hang on the target; see the module's table."""

    defaults: ClassVar[dict[str, float]] = {"height": 0.2, "max_speed": 0.5, "settle": 2.25}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator) -> None:
        super().__init__(strategy, run, rng)
        self.settle = self.values["settle"]

    def judge(self, run: Any) -> Judgement:
        height = _height(run, TOOL)
        speed = float(np.linalg.norm(run.world.velocity(TOOL)))
        touching = run.world.touching(TOOL, TARGET, TOUCH)
        metrics = {"tool_height": height, "final_speed": speed, "touching": float(touching)}
        needed, fastest = self.values["height"], self.values["max_speed"]
        state = (
            f"{height * 1000:.0f} mm above the table, moving at {speed:.2f} m/s, {'touching' if touching else 'not touching'} the target"
        )
        if not run.released:
            return Judgement(Code.GOAL_NOT_REACHED, f"the tool was never let go: {state}", metrics)
        if height <= needed:
            code = Code.GOAL_NOT_REACHED if touching else Code.LOST_CONTACT
            return Judgement(code, f"the tool fell when let go: {state} (needed: above {needed * 1000:.0f} mm)", metrics)
        if speed >= fastest:
            return Judgement(Code.UNSTABLE, f"the tool does not come to rest: {state} (allowed: below {fastest:g} m/s)", metrics)
        return Judgement(Code.OK, f"the tool hangs {state}", metrics)


class Scoop(GoalTest):
    """Lift the target in the tool; see the module's table."""

    defaults: ClassVar[dict[str, float]] = {"height": 0.2, "max_speed": 0.1, "settle": 1.0}

    def __init__(self, strategy: Strategy, run: Any, rng: np.random.Generator) -> None:
        super().__init__(strategy, run, rng)
        self.settle = self.values["settle"]
        self._highest = 0.0
        self._touching = False

    def observe(self, run: Any) -> None:
        if run.world.steps % OBSERVE_EVERY:
            return
        self._highest = max(self._highest, float(run.world.position(TARGET)[2]))
        # The ball rocks a little in the bowl: touched within the last tenth of a second counts.
        if run.time >= run.duration + self.settle - 0.1:
            self._touching = self._touching or run.world.touching(TOOL, TARGET, TOUCH)

    def judge(self, run: Any) -> Judgement:
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
        return Judgement(Code.OK, f"the target lies in the tool: {state}", metrics)


#: Goal tests by the name that a strategy gives.
GOALS: dict[str, type[GoalTest]] = {"hook": Hook, "hang": Hang, "scoop": Scoop}


def goal_test(strategy: Strategy, run: Any, rng: np.random.Generator) -> GoalTest:
    """The goal test of a strategy, ready to watch a run; raises ``UNKNOWN_GOAL``."""
    require(strategy)
    return GOALS[strategy.goal.test](strategy, run, rng)


def require(strategy: Strategy) -> None:
    """Raise ``UNKNOWN_GOAL`` unless there is a goal test of that name."""
    if strategy.goal.test not in GOALS:
        raise MagicError(Code.UNKNOWN_GOAL, "goal test", strategy.goal.test, list(GOALS))
