"""What the predicates of a goal's tree say of a state: whether they hold, what was measured, and what was wanted.

They are asked of a :class:`State`, which is a simulated run (:class:`Simulated`).  What physics does not tell is answered with neither yes
nor no: a contact between two bodies that it does not move.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.goal import Node, direction_of, leaf_words
from magic_core.strategy import Strategy
from magic_verifier.enclosing import STRONGER, enclosure
from magic_verifier.floating import TARGET, TOOL, phase_start
from magic_verifier.simulation import DYNAMIC

Array = NDArray[np.float64]
#: Contact is sought this far apart (m): bodies that press on each other rest at up to the solver's slop.
TOUCH = 0.001
#: The robot's parts, as contacts name them.
ARM, FINGERS = "arm", "fingers"
#: What a trial has put beside the target begins with this.
BESIDE = "swept_"


@dataclass(frozen=True)
class Told:
    """What a predicate says: ``truth`` (``None``: it cannot be told), what was measured and what was wanted in words, and numbers; the
    first of them is the one that a node's ``metric`` renames."""

    truth: bool | None
    measured: str = ""
    wanted: str = ""
    metrics: dict[str, float] = field(default_factory=dict)


class State(Protocol):
    """What predicates ask of a scene.  Bodies go by ``tool``, ``target``, what a trial put beside it, and ids."""

    def row(self) -> tuple[str, ...]:
        """The target and what stands beside it."""

    def pose(self, name: str) -> Array:
        """world_from_object (4, 4)."""

    def start(self, name: str) -> Array:
        """world_from_object (4, 4) where it stood when the motion began."""

    def centre(self, name: str) -> Array:
        """(3,): middle of its box, object frame."""

    def corners(self, name: str) -> Array:
        """(N, 3): points that span it, object frame."""

    def table_height(self, point: Array) -> float:
        """Height (m) of the table under a world point (3,)."""

    def speeds(self, name: str) -> tuple[float, float]:
        """How fast it is, m/s, and turns, rad/s."""

    def touched_by(self, name: str) -> tuple[str, ...]:
        """What it touches."""

    def feels(self, name: str, other: str = "") -> bool:
        """Whether it can tell if a body touches another one, or any."""


class Simulated:
    """The state of a run: a floating or an arm run (``world``, ``time``, ``phases``, ``setup``, ``released``, ``hand_has_left``)."""

    def __init__(self, run: Any, beside: tuple[str, ...] = ()) -> None:
        self.run = run
        self._row = (TARGET, *beside)
        self._start = {name: run.world.pose(name) for name in (TOOL, *self._row)}
        self._start[TARGET] = run.setup.target.world_from_object  # the engine's own is rounded
        self._before: tuple[float, dict[str, tuple[Array, Array]]] | None = None

    def row(self) -> tuple[str, ...]:
        return self._row

    def pose(self, name: str) -> Array:
        return self.run.world.pose(name)

    def start(self, name: str) -> Array:
        return self._start[name]

    def _body(self, name: str) -> Any:
        return self.run.setup.tool if name == TOOL else self.run.setup.target

    def centre(self, name: str) -> Array:
        return self._body(name).centre

    def corners(self, name: str) -> Array:
        return self._body(name).corners

    def table_height(self, point: Array) -> float:
        return self.run.setup.table_height(point)

    def note(self) -> None:
        """Keep where things are, for :meth:`speeds` a moment later."""
        world = self.run.world
        moved = [name for name in (TOOL, *self._row) if self._moved_by_physics(name)]
        self._before = self.run.time, {name: (world.centre_of_mass(name), world.pose(name)) for name in moved}

    def speeds(self, name: str) -> tuple[float, float]:
        """No faster than things moved since :meth:`note`: of what is held between contacts that press against each other the engine tells a
        velocity (0.5 rad/s of a V on a rod) with which it does not move."""
        world = self.run.world
        speed, turning = float(np.linalg.norm(world.velocity(name))), float(np.linalg.norm(world.turning(name)))
        if self._before is not None and name in self._before[1] and (seconds := self.run.time - self._before[0]) > 0:
            centre, pose = self._before[1][name]
            speed = min(speed, float(np.linalg.norm(world.centre_of_mass(name) - centre)) / seconds)
            turning = min(turning, transforms.rotation_angle(pose, world.pose(name)) / seconds)
        return speed, turning

    def touched_by(self, name: str) -> tuple[str, ...]:
        return self.run.world.touched_by(name, TOUCH)

    def feels(self, name: str, other: str = "") -> bool:
        """PhysX tells of no contact between two bodies that it does not move: a tool that is led, a fixed target, table and fixtures."""
        return self._moved_by_physics(name) or (bool(other) and self._moved_by_physics(other))

    def _moved_by_physics(self, name: str) -> bool:
        if name == TOOL:
            return not self.run.world.component(TOOL).kinematic
        if name in self._row:
            return self.run.setup.target_kind == DYNAMIC
        return name in (ARM, FINGERS)


class Asked:
    """What a tree is asked with: the strategy's directions, and of a simulated run what has happened in it."""

    def __init__(self, strategy: Strategy, state: Any, rng: np.random.Generator | None = None) -> None:
        self.strategy = strategy
        self.state = state
        self.rng = rng
        self.impulses: dict[str, float] = {}

    def direction(self, along: Any) -> Array:
        """The unit vector (3,) of a direction's name or numbers; raises ``BAD_STRATEGY`` for a level one of an upright normal."""
        return direction_of(along, self.strategy.target_normal)

    def radius(self, along: Array) -> float:
        """Half of what the target measured across a direction when the motion began, m."""
        corners = transforms.apply(self.state.start(TARGET), self.state.corners(TARGET))
        side = np.cross([0, 0, 1.0], along)
        across = corners @ (side if np.linalg.norm(side) > 1e-6 else np.array([1.0, 0.0, 0.0]))
        return float(across.max() - across.min()) / 2

    def bodies(self, what: str) -> tuple[str, ...]:
        """The bodies that a name stands for."""
        return self.state.row() if what == "row" else (what,)

    def way(self, name: str) -> Array:
        """(3,): how far the middle of a body has moved since the start."""
        state = self.state
        centre = state.centre(name)
        return transforms.apply(state.pose(name), centre) - transforms.apply(state.start(name), centre)

    def height(self, name: str) -> float:
        """Of the middle of a body above the table, m."""
        middle = transforms.apply(self.state.pose(name), self.state.centre(name))
        return float(middle[2]) - self.state.table_height(middle)

    def aside(self, name: str, along: Array) -> float:
        """How far a body has moved to the side of a direction, m: level ones have their left and right, others all sides."""
        way = self.way(name)
        side = np.cross([0, 0, 1.0], along)
        if np.linalg.norm(side) > 0.5:
            return abs(float(way @ transforms.unit(side)))
        return float(np.linalg.norm(way - (way @ along) * along))


def _mm(value: float) -> str:
    return f"{1000 * value:.0f} mm" if abs(value) >= 0.0995 else f"{1000 * value:.1f} mm"


def _said(along: Any) -> str:
    return {"pull": "along", "press": "inwards", "left": "to the left"}.get(along, along) if isinstance(along, str) else "along"


def _moved(asked: Asked, what: str, along: Any, by: float) -> Told:
    direction = asked.direction(along)
    ways = [float(asked.way(name) @ direction) for name in asked.bodies(what)]
    metrics = {f"{what}_moved": min(ways)}
    if len(ways) > 1:
        metrics["swept"] = float(sum(way >= by for way in ways))
    return Told(min(ways) >= by, f"{what} moved {', '.join(map(_mm, ways))} {_said(along)}", f"needed: {1000 * by:g} mm", metrics)


def _stayed(asked: Asked, what: str, within: float) -> Told:
    ways = [float(np.linalg.norm(asked.way(name))) for name in asked.bodies(what)]
    return Told(max(ways) <= within, f"{what} moved {_mm(max(ways))}", f"allowed: {1000 * within:g} mm", {f"{what}_moved_by": max(ways)})


def _drift(asked: Asked, what: str, along: Any, below: float, of: str) -> Told:
    direction = asked.direction(along)
    drift = max(asked.aside(name, direction) for name in asked.bodies(what))
    metrics, limit, unit = {"sideways_drift": drift}, below, ""
    if of == "radius":
        metrics["target_radius"] = radius = asked.radius(direction)
        limit, unit = below * radius, f", {below:g} of its radius"
    return Told(drift < limit, f"drifted {1000 * drift:.1f} mm sideways", f"allowed: below {1000 * limit:.3g} mm{unit}", metrics)


def _above(asked: Asked, what: str, height: float) -> Told:
    heights = [asked.height(name) for name in asked.bodies(what)]
    return Told(
        min(heights) > height,
        f"{what} {1000 * min(heights):.0f} mm above the table",
        f"needed: above {1000 * height:.0f} mm",
        {f"{what}_height": min(heights)},
    )


def _up_then(asked: Asked, name: str) -> Array:
    """(3,), object frame: what was up when the motion began."""
    return asked.state.start(name)[2, :3]


def _tilt(asked: Asked, name: str) -> float:
    cosine = float((asked.state.pose(name)[:3, :3] @ _up_then(asked, name))[2])
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _upright(asked: Asked, what: str, within: float) -> Told:
    tilt = max(_tilt(asked, name) for name in asked.bodies(what))
    return Told(tilt <= within, f"{what} tilted by {tilt:.0f} degrees", f"allowed: {within:g} degrees", {f"{what}_tilt": tilt})


def _points(asked: Asked, what: str, along: Any, within: float) -> Told:
    direction = asked.direction(along)
    cosines = [float((asked.state.pose(name)[:3, :3] @ _up_then(asked, name)) @ direction) for name in asked.bodies(what)]
    angle = float(np.rad2deg(np.arccos(np.clip(min(cosines), -1.0, 1.0))))
    measured = f"what was up of the {what} is {angle:.0f} degrees off that way"
    return Told(angle <= within, measured, f"allowed: {within:g} degrees", {f"{what}_points_off": angle})


def _turned(asked: Asked, what: str, by: float, about: str) -> Told:
    angles = []
    for name in asked.bodies(what):
        pose, start = asked.state.pose(name), asked.state.start(name)
        if about == "level":
            angles.append(_tilt(asked, name))
        elif about == "any":
            angles.append(float(np.rad2deg(transforms.rotation_angle(start, pose))))
        else:
            turn = pose[:3, :3] @ start[:3, :3].T
            angles.append(abs(float(np.rad2deg(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))))
    return Told(
        min(angles) >= by, f"{what} turned by {min(angles):.0f} degrees", f"needed: {by:g} degrees", {f"{what}_turned": min(angles)}
    )


def _inside(asked: Asked, what: str, low: Any, high: Any, of: str) -> Told:
    out = []
    for name in asked.bodies(what):
        place = transforms.apply(asked.state.pose(name), asked.state.centre(name))
        if of == "start":
            place = place - transforms.apply(asked.state.start(TARGET), asked.state.centre(TARGET))
        out.append(np.maximum(np.maximum(np.asarray(low) - place, place - np.asarray(high)), 0.0))
    worst = float(max(np.linalg.norm(o) for o in out))
    return Told(worst == 0.0, f"{what} {_mm(worst)} outside the region", "needed: inside it", {f"{what}_outside": worst})


def _at_rest(asked: Asked, what: str, below: float, turning: float) -> Told:
    speeds = [asked.state.speeds(name) for name in asked.bodies(what)]
    speed, turn = max(s for s, _ in speeds), max(t for _, t in speeds)
    metrics = {f"{what}_speed": speed}
    measured, wanted = f"{what} at {speed:.2g} m/s", f"allowed: below {below:g} m/s"
    if np.isfinite(turning):
        metrics[f"{what}_turning"] = turn
        measured, wanted = f"{measured} and {turn:.2g} rad/s", f"{wanted} and {turning:g} rad/s"
    return Told(speed < below and turn < turning, measured, wanted, metrics)


def _touching(asked: Asked, what: str, whom: str) -> Told:
    yes = all(whom in asked.state.touched_by(name) for name in asked.bodies(what))
    return Told(yes, f"{what} {'touching' if yes else 'not touching'} the {whom}", f"needed: touching the {whom}", {"touching": float(yes)})


def _strangers(asked: Asked, what: str, whom: str) -> list[str]:
    return sorted({other for name in asked.bodies(what) for other in asked.state.touched_by(name)} - {whom})


def _touching_only(asked: Asked, what: str, whom: str) -> Told:
    others = _strangers(asked, what, whom)
    return Told(not others, f"it touches {', '.join(others)}" if others else "", f"allowed: the {whom} alone")


def _held_by(asked: Asked, what: str, whom: str) -> Told:
    touching, others = _touching(asked, what, whom), _strangers(asked, what, whom)
    measured = f"{touching.measured} and {', '.join(others)}" if others else touching.measured
    return Told(bool(touching.truth) and not others, measured, f"needed: touching the {whom} alone", touching.metrics)


def _overlap(asked: Asked, what: str, whom: str, below: float) -> Told:
    depth = max(asked.state.run.world.depth(name, whom) for name in asked.bodies(what))
    return Told(depth <= below, f"{1000 * depth:.1f} mm in the {whom}", f"allowed: {1000 * below:g} mm", {f"depth_in_{whom}": depth})


def _below_support(asked: Asked, what: str, whom: str) -> Told:
    world = asked.state.run.world
    depths = []
    for name in asked.bodies(what):
        places = [touch.position[2] for touch in world.touches(name, whom, TOUCH)]
        depths.append(float(max(places) - world.centre_of_mass(name)[2]) if places else -np.inf)
    depth = min(depths)
    if not np.isfinite(depth):
        return Told(False, "", f"needed: held by the {whom}")
    side = "below" if depth > 0 else "above"
    measured = f"its centre of mass is {1000 * abs(depth):.0f} mm {side} what holds it"
    return Told(depth > 0, measured, "allowed: below it", {"below_support": depth})


def _pressed(asked: Asked, what: str, whom: str, along: Any, impulse: float) -> Told:
    given = asked.impulses.get(_press_key(what, whom, along), 0.0)
    return Told(
        given >= impulse, f"{what} pressed with {given:.3g} N s {_said(along)}", f"needed: {impulse:g} N s", {f"{what}_impulse": given}
    )


def _press_key(what: str, whom: str, along: Any) -> str:
    return f"{what}|{whom}|{along}"


def note_presses(asked: Asked, leaves: Sequence[Node]) -> None:
    """After each step of a simulated run: what bodies have pressed on each other, for ``pressed``."""
    seen = set()
    for leaf in leaves:
        what, whom, along = leaf.args["what"], leaf.args["whom"], leaf.args["along"]
        if (key := _press_key(what, whom, along)) in seen:
            continue
        seen.add(key)
        direction = asked.direction(along)
        gain = sum(float(t.impulse @ direction) for name in asked.bodies(what) for t in asked.state.run.world.touches(name, whom, TOUCH))
        asked.impulses[key] = asked.impulses.get(key, 0.0) + gain


def _released(asked: Asked) -> Told:
    yes = bool(asked.state.run.released)
    return Told(yes, "let go" if yes else "still in the hand", "needed: let go")


def _hand_away(asked: Asked, by: float) -> Told:
    away = float(asked.state.run.hand_has_left())
    measured = f"it is {1000 * away:.0f} mm from where it let go" if np.isfinite(away) else ""
    return Told(away >= by, measured, f"needed: {1000 * by:g} mm", {"hand_away": away} if np.isfinite(away) else {})


def _struck(asked: Asked, phase: str) -> Told:
    run = asked.state.run
    if run.variant != "fg" or phase_start(run.phases, (phase,)) is None or phase != "strike":
        # A tool on rails drives anything to any depth: that would be no finding.
        raise MagicError(
            Code.BAD_STRATEGY,
            "motion of a strategy that strikes",
            f"{run.variant} with phases {', '.join(p.name for p in run.phases) or 'none'}",
            "fg with a phase 'strike', in which the tool flies by its own momentum",
        )
    return Told(True)


def _encloses(asked: Asked, along: Any, turned: float) -> Told:
    if turned == 0:
        return Told(True)
    direction = asked.direction(along)
    if abs(direction[2]) > 1e-6:
        raise MagicError(Code.BAD_STRATEGY, "direction of encloses", along, "a level one")
    radius = asked.radius(direction)
    state = asked.state
    found = enclosure(
        state.run.setup, state.pose(TOOL), state.pose(TARGET), direction, turned, radius, asked.rng or np.random.default_rng(0)
    )
    left, right = (100 * slip for slip in found.slips)
    held, flat = (100 * bound for bound in found.bounds)
    metrics = {
        "holds": float(found.holds),
        "hold_slip": max(found.slips),
        "sides_held": float(found.sides),
        "holds_in_stronger_noise": float(found.noisy),
    }
    measured = (
        f"with the pull turned by {turned:g} degrees to either side it falls back by {left:.0f} and {right:.0f} % of the way, "
        f"in noise of {STRONGER:g} radii it {'stays' if found.noisy else 'is lost'}"
    )
    return Told(found.holds, measured, f"allowed: below {held:.0f} % to one side and {flat:.0f} % to the other", metrics)


DECIDED: dict[str, Callable[..., Told]] = {
    "moved": _moved,
    "stayed": _stayed,
    "drift": _drift,
    "above": _above,
    "upright": _upright,
    "points": _points,
    "turned": _turned,
    "inside": _inside,
    "at_rest": _at_rest,
    "touching": _touching,
    "touching_only": _touching_only,
    "held_by": _held_by,
    "overlap": _overlap,
    "below_support": _below_support,
    "pressed": _pressed,
    "released": _released,
    "hand_away": _hand_away,
    "struck": _struck,
    "encloses": _encloses,
}


def told(asked: Asked, node: Node) -> Told:
    """What a predicate says now; of what the state cannot tell, nothing."""
    # Whether it touches one other body may be told by that one; whether it touches nothing else, by itself alone.
    other = node.args.get("whom", "") if node.kind == "touching" else ""
    if "whom" in node.args and not all(asked.state.feels(name, other) for name in asked.bodies(node.args["what"])):
        return Told(None, wanted=leaf_words(node))
    return DECIDED[node.kind](asked, **node.args)
