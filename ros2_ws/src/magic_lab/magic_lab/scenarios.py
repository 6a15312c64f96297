"""What stands in the laboratory, and what happens to it meanwhile.  No ROS here.

A scenario names a strategy, the things to try it on, and events: what goes wrong, or changes, while the arm is at work.  Where
things lie, their friction and their densities are drawn by the seed, and are not what the strategy assumes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate
from magic_core.scene import CanonicalView, SceneObject
from magic_core.strategy import Strategy, find
from magic_lab.world import AWAY, Thing
from magic_verifier import placing
from magic_verifier.captured import lay_out
from magic_verifier.cases import Case
from magic_verifier.simulation import DYNAMIC, KINEMATIC, STATIC

Array = NDArray[np.float64]

#: What may happen, and to what.
EVENTS = {
    "nudge": "the target is pushed aside",
    "take_target": "the target is taken away",
    "take_tool": "the tool is taken away",
    "slip": "what is held slips in the fingers",
    "hand": "a person's hand comes into the pictures and leaves again",
    "block": "something that no camera had seen stands in the arm's way",
    "abort": "the arm's controller gives up",
    "freeze": "the first camera sends nothing any more",
    "silence": "joint_states come no more",
}
#: How far a nudged target is moved, m; how far what is held slips: along the fingers, m, and about the closing axis, rad.
NUDGE, SLIP, SLIP_TURN = 0.05, 0.012, 0.25
#: Names of what is moved by events, and of the target.
HAND, BLOCK, TARGET = "hand", "block", "target"
#: Between which factors of the densities that the strategy assumes the true ones are drawn; friction coefficients of
#: things, of the table and of the finger pads.
FACTOR = 2.0
#: How many times as heavy as the strategies' wood and plastics a thing is that is partly of metal, and one of steel.
METAL = (2.0, 13.0)
FRICTION, TABLE_FRICTION, PAD_FRICTION = (0.2, 0.5), (0.25, 0.5), (0.9, 1.5)


@dataclass(frozen=True)
class Event:
    """Something that happens ``after`` so many seconds of the arm's move number ``move`` since the
    reset; move 0: since the reset itself."""

    kind: str
    move: int = 0
    after: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Event:
        """Of ``KIND@MOVE+SECONDS``, the last two of which may be left out; raises BAD_REQUEST."""
        match = re.fullmatch(r"(\w+)(?:@(\d+))?(?:\+(\d+(?:\.\d*)?))?", text.strip())
        if match is None or match[1] not in EVENTS:
            raise MagicError(Code.BAD_REQUEST, "event", text, f"KIND@MOVE+SECONDS, KIND one of {', '.join(EVENTS)}")
        return cls(match[1], int(match[2] or 0), float(match[3] or 0))


@dataclass(frozen=True)
class Scenario:
    """A strategy on some things.

    cases: a tool (or several) and a target each, names as :mod:`magic_verifier.cases` has them.  chosen: tool and target are to be
    chosen, not told.  pads: what the pads' friction is multiplied by.  heavier: between which factors that is drawn by which the tool's
    density is multiplied.
    """

    name: str
    strategy: str
    cases: tuple[Case, ...]
    description: str
    chosen: bool = False
    events: tuple[Event, ...] = ()
    pads: float = 1.0
    heavier: tuple[float, float] = (1.0, 1.0)


def _cases(target: str, *tools: str) -> tuple[Case, ...]:
    return tuple(
        Case(tool.partition(":")[0] if len(tools) == len({t.partition(":")[0] for t in tools}) else tool, (tool,), target) for tool in tools
    )


HOOKS = _cases("cylinder:0.03", "caliper:61001", "scissors:61002", "hanger:61003", "hammer:61004")
CUPS = _cases("demonstration", "mug:3", "mug:46", "mug:89")
SPOONS = _cases("sphere:0.035", "spoon:61011", "ladle:61012", "measuring_cup:61013")
CLUTTER = (Case("six things", ("caliper:61021", "watch:61022", "mug:12", "sphere:0.03", "plain_bottle:61025"), "cylinder:0.03"),)

SCENARIOS = {
    s.name: s
    for s in (
        Scenario("hooking", "hooking", HOOKS, "four tools of different categories, one at a time, and a standing cylinder to be pulled"),
        Scenario("hanging", "hanging", CUPS, "three cups that look different, one at a time, and a rod to hang them on"),
        Scenario("scooping", "scooping", SPOONS, "a spoon, a ladle or a measuring cup, a ball and a curved wall"),
        Scenario("clutter", "hooking", CLUTTER, "six things on the table; tool and target are to be chosen", chosen=True),
        Scenario(
            "nudged",
            "hooking",
            HOOKS[:1],
            "the target is pushed aside while the arm is on its way with the tool",
            events=(Event("nudge", 2, 0.5),),
        ),
        Scenario(
            "slipping", "hooking", HOOKS[:1], "the tool slips in the fingers when it has been taken up", events=(Event("slip", 2, 0.5),)
        ),
        Scenario("heavy", "hooking", HOOKS, "the tools of hooking, of metal, which the strategy does not know", heavier=METAL),
    )
}


@dataclass(frozen=True)
class Scene:
    """A drawn scene: what is truly there, what of it is told as calibrated, tools and target by name, frictions of table and pads."""

    scenario: Scenario
    case: Case
    seed: int
    strategy: Strategy
    things: tuple[Thing, ...]
    known: tuple[SceneObject, ...]
    tools: tuple[str, ...]
    target: str
    table_friction: float
    pad_friction: float

    def thing(self, name: str) -> Thing:
        """The thing of that name."""
        return next(thing for thing in self.things if thing.name == name)


def scenario_of(name: str) -> Scenario:
    """Raises BAD_REQUEST naming those there are."""
    if name not in SCENARIOS:
        raise MagicError(Code.BAD_REQUEST, "scenario", name, tuple(SCENARIOS))
    return SCENARIOS[name]


def case_of(scenario: Scenario, name: str, seed: int) -> Case:
    """The case of that name; of no name the seed chooses one in turn.  Raises BAD_REQUEST."""
    if not name:
        return scenario.cases[seed % len(scenario.cases)]
    found = [case for case in scenario.cases if case.name == name]
    if not found:
        raise MagicError(Code.BAD_REQUEST, f"object of {scenario.name}", name, [case.name for case in scenario.cases])
    return found[0]


def draw(scenario: Scenario, case: Case, seed: int, strategies: str = "") -> Scene:
    """The scene of a case and a seed; the same seed gives the same.  Raises BAD_SCENE where there is no room for a thing."""
    strategy = find(scenario.strategy, strategies or None)
    layout = lay_out(strategy, case, seed)
    rng = np.random.default_rng([*placing.seed_of(case.name, seed), 14])

    physics = strategy.physics

    def thing(item: SceneObject, kind: str = DYNAMIC, density: float = physics.tool_density) -> Thing:
        return Thing(item, kind, density * float(FACTOR ** rng.uniform(-1, 1)), float(rng.uniform(*FRICTION)))

    fixed = physics.target_is_fixed
    metal = np.random.default_rng([*placing.seed_of(case.name, seed), 17])
    heavier = [float(np.exp(metal.uniform(*np.log(scenario.heavier)))) for _ in layout.tools]
    tools = [thing(item, density=factor * physics.tool_density) for item, factor in zip(layout.tools, heavier, strict=True)]
    things = [*tools, thing(layout.target, STATIC if fixed else DYNAMIC, physics.target_density)]
    things += [thing(item, STATIC) for item in layout.fixtures]
    known = (*layout.fixtures, *((layout.target,) if fixed else ()))
    return Scene(
        scenario,
        case,
        seed,
        strategy,
        tuple(things),
        known,
        tuple(item.id for item in layout.tools),
        layout.target.id,
        float(rng.uniform(*TABLE_FRICTION)),
        scenario.pads * float(rng.uniform(*PAD_FRICTION)),
    )


def actors(scene: Scene, events: tuple[Event, ...]) -> Scene:
    """The scene with what its events need, out of sight."""
    kinds = {event.kind for event in events}
    more = [Thing(item, KINEMATIC) for kind, item in (("hand", person_hand()), ("block", blocking_box())) if kind in kinds]
    return replace(scene, things=(*scene.things, *more))


def person_hand() -> SceneObject:
    """A forearm with a hand and four fingers, reaching along +x, level; its middle finger's tip is the origin."""
    boxes = [((-0.35, 0, 0), (0.3, 0.07, 0.06)), ((-0.14, 0, 0), (0.12, 0.085, 0.03)), ((-0.11, 0.06, 0.0), (0.07, 0.03, 0.022))]
    boxes += [((-0.04 - 0.004 * abs(k - 0.5), 0.021 * (k - 0.5), 0), (0.08, 0.017, 0.016)) for k in (-1, 0, 1, 2)]
    return _of_boxes(HAND, boxes, (222, 170, 140))


def blocking_box() -> SceneObject:
    """A heavy box about its middle."""
    return _of_boxes(BLOCK, [((0, 0, 0), (0.16, 0.16, 0.16))], (90, 90, 96))


def _of_boxes(name: str, boxes: list[tuple[tuple[float, ...], tuple[float, ...]]], color: tuple[int, int, int]) -> SceneObject:
    import trimesh

    pieces = []
    for middle, size in boxes:
        box = trimesh.creation.box(extents=size)
        pieces.append(Mesh(box.vertices + np.asarray(middle), box.faces).painted(color))
    nothing = np.zeros((1, 1), bool)
    view = CanonicalView(np.zeros((1, 1, 3), np.uint8), nothing, 1.0, np.eye(4), "top")
    return SceneObject(name, concatenate(pieces), tuple(pieces), transforms.make(translation=AWAY), view, source="known")


def hand_pose(time: float) -> Array | None:
    """world_from_hand (4, 4) so many seconds after it came: in from the robot's left over the table,
    and out again; ``None``: it has left."""
    seconds, reach = 4.0, 0.75
    if not 0 <= time <= seconds:
        return None
    y = 0.85 - reach * np.sin(np.pi * time / seconds)
    return transforms.make(transforms.from_rpy(0, 0, -np.pi / 2)[:3, :3], [0.5, y, 0.30])
