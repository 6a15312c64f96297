"""Records the bags of this folder: three scenes and three demonstrations, ray-cast with a model of two D435 cameras.

``toppling`` and ``toppling_demonstration``, of a task that does not ship (``docs/your_own_task.md``), are recorded where they are named.

    python bags/record.py [--out DIR] [--seed N] [NAME ...]

Source ``ros2_ws/env.sh`` first (the message packages are needed).  The same seed
gives the same bag, byte for byte.  ``README.md`` beside this file says what is in them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from magic_bags.recording import Recording
from magic_bringup import make_strategies
from magic_bringup.demonstrating import UP, demonstrated, made_of, target_contact, target_view, through
from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.goal import Goal
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_core.sensor import D435, SMEARED, STATION, DepthModel, capture, looking_at, scene_raycaster
from magic_core.shapes import Shape, make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures, pose_data
from magic_core.strategy import Physics, Strategy, Waypoint
from magic_core.testing.hand import coming, hand

Array = NDArray[np.float64]

#: Start of every bag, seconds since the epoch (2025-01-01 00:00:00 UTC).
START = 1735689600.0
#: Frames of a scene, and seconds between them; sampling of the joint states and poses, seconds.
FRAMES, PERIOD = 3, 0.2
JOINT_PERIOD, POSE_PERIOD = 0.05, 0.05
#: The demonstrations are seen with less resolution (a mode of the D435) and more often.
D435_SMALL = Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)
DEMONSTRATION_FRAMES = 3
#: Before it is used, the tool lies on the table at x, y, yaw, seen so often, and is then taken to where its use begins: seconds.
PICKED_UP_FROM = {
    "hooking": (0.44, -0.24, 0.3),
    "hanging": (0.44, -0.26, 0.2),
    "scooping": (0.46, 0.31, 0.1),
    "toppling": (0.44, -0.24, 0.3),
}
LYING_FRAMES = 2
REST, TAKE = 0.6, 3.4
#: By a bare hand: it comes so long (s) before the tool moves.
HAND_COMES = 0.3

#: Where the cameras stand.
CAMERAS = STATION
#: The hanging scene goes further up.
HIGH_CAMERAS = {
    "left": looking_at([0.98, 0.42, 0.74], [0.50, 0.0, 0.12]),
    "right": looking_at([0.98, -0.42, 0.74], [0.50, 0.0, 0.12]),
}


@dataclass(frozen=True)
class Thing:
    """One object of a scene and where it is; a known one is announced on /known_objects."""

    name: str
    shape: Shape
    world_from_object: Array
    known: bool = False

    @property
    def mesh(self) -> Mesh:
        """Its mesh in the world."""
        return self.shape.mesh.transformed(self.world_from_object)

    def truth(self) -> dict[str, object]:
        """How it was made and where it is, for truth.yaml."""
        return {
            "name": self.name,
            "family": self.shape.family,
            "seed": self.shape.seed,
            "parameters": dict(self.shape.parameters),
            "known": self.known,
            "world_from_object": pose_data(self.world_from_object),
        }


def lying(shape: Shape, x: float, y: float, yaw: float) -> Array:
    """world_from_object of a shape on the table as its own frame stands."""
    return transforms.from_rpy(0, 0, yaw, [x, y, -shape.mesh.bounds[0, 2]])


def settled(shape: Shape, world_from_object: Array, seconds: float = 3.0) -> Array:
    """Where an object comes to rest on the table, by physics."""
    world = _World()
    world.add("object", shape, world_from_object @ transforms.make(translation=[0, 0, 0.002]), "dynamic", 0.5)
    for _ in range(int(seconds * _World.FREQUENCY)):
        world.step()
    return world.pose("object")


class _World:
    """The little physics that recording needs: a table, fixed, moved and free bodies (SAPIEN, CPU)."""

    FREQUENCY = 240

    def __init__(self) -> None:
        import sapien

        self._sapien = sapien
        self._scene = sapien.Scene([sapien.physx.PhysxCpuSystem()])
        self._scene.set_timestep(1 / self.FREQUENCY)
        self._scene.add_ground(0.0, render=False)
        self._bodies: dict[str, object] = {}

    def _to_pose(self, pose: Array) -> object:
        return self._sapien.Pose(pose[:3, 3], transforms.quaternion_wxyz(pose))

    def add(self, name: str, shape: Shape, pose: Array, kind: str, friction: float, density: float = 600.0) -> None:
        """A body of convex pieces; kind is dynamic, kinematic or static."""
        physx = self._sapien.physx
        component = physx.PhysxRigidStaticComponent() if kind == "static" else physx.PhysxRigidDynamicComponent()
        material = physx.PhysxMaterial(friction, friction, 0.0)
        for piece in shape.pieces:
            part = physx.PhysxCollisionShapeConvexMesh(piece.vertices.astype(np.float32), np.ones(3), material)
            part.density = density
            part.contact_offset = 0.002
            component.attach(part)
        if kind == "kinematic":
            component.kinematic = True
        entity = self._sapien.Entity()
        entity.add_component(component)
        entity.pose = self._to_pose(pose)
        self._scene.add_entity(entity)
        self._bodies[name] = (entity, component)

    def move(self, name: str, pose: Array) -> None:
        """Where a kinematic body shall be after the next step."""
        self._bodies[name][1].kinematic_target = self._to_pose(pose)

    def let_go(self, name: str) -> None:
        """From now on the body is free."""
        self._bodies[name][1].kinematic = False

    def step(self) -> None:
        """One step of 1/240 s."""
        self._scene.step()

    def pose(self, name: str) -> Array:
        """world_from_object (4, 4)."""
        pose = self._bodies[name][0].pose
        return transforms.from_quaternion_wxyz(np.asarray(pose.p, float), np.asarray(pose.q, float))


# ---------------------------------------------------------------- scenes


def hooking_scene(seed: int) -> list[Thing]:
    """A caliper and a watch on the table, and a cylinder out in front; the watch is too narrow to be of use."""
    caliper = make("caliper", seed + 4, beam=0.26, opening=0.105, jaw=0.07, width=0.022, thickness=0.018)
    watch = make("watch", seed + 2, half_length=0.026, half_width=0.025)
    cylinder = make("cylinder", seed + 9, radius=0.03)
    return [
        Thing("caliper", caliper, lying(caliper, 0.44, -0.22, 0.5)),
        Thing("watch", watch, lying(watch, 0.42, 0.24, 2.4)),
        Thing("cylinder", cylinder, lying(cylinder, 0.70, 0.0, 0.0)),
    ]


def hanging_scene(seed: int) -> list[Thing]:
    """A mug on the table, its handle in sight, and the rod."""
    mug = make(
        "mug",
        seed + 3,
        profile="straight",
        handle="D",
        radius=0.039,
        height=0.095,
        handle_thickness=0.010,
        handle_breadth=0.014,
        handle_reach=0.034,
    )
    rod = make("rod", 0, **make_strategies.ROD)
    return [Thing("mug", mug, lying(mug, 0.50, -0.30, np.deg2rad(70))), Thing("rod", rod, make_strategies.rod_pose(rod), known=True)]


#: Where the ladle lies in the scooping scene: x, y, yaw.
LADLE = (0.46, 0.31, 0.1)


def scooping_scene(seed: int) -> list[Thing]:
    """A ladle on its back, a ball and the quarter pipe."""
    ladle = make(
        "ladle",
        seed + 1,
        bowl_radius=0.05,
        aspect=1.0,
        depth=0.036,
        handle=0.22,
        angle=np.deg2rad(14),
        handle_thickness=0.012,
        handle_breadth=0.02,
    )
    radius = 0.035
    ball = make("sphere", seed + 5, radius=radius)
    ball_pose = make_strategies.scooped_ball(radius)
    strategy = make_strategies.scooping()
    arc = fixtures(strategy.environment, ball_pose[:3, 3] + radius * strategy.target_normal)[0]
    arc_shape = make("quarter_pipe", 0, **make_strategies.ARC)
    return [
        Thing("ladle", ladle, settled(ladle, lying(ladle, *LADLE))),
        Thing("ball", ball, ball_pose),
        Thing("arc", arc_shape, arc.world_from_object, known=True),
    ]


#: A bottle, and how far above its middle it is pulled.
BOTTLE, HIGH_UP = {"radius": 0.025, "half_height": 0.07}, 0.035
#: Where it stands (m).
BOTTLE_X = 0.62


def toppling_scene(seed: int) -> list[Thing]:
    """A caliper on the table, and a bottle out in front."""
    caliper = make("caliper", seed + 4, beam=0.26, opening=0.105, jaw=0.07, width=0.022, thickness=0.018)
    bottle = make("cylinder", seed + 9, **BOTTLE)
    return [
        Thing("caliper", caliper, lying(caliper, 0.44, -0.22, 0.5)),
        Thing("bottle", bottle, lying(bottle, BOTTLE_X, 0.0, 0.0)),
    ]


def toppling() -> Strategy:
    """An L hook, lowered behind a bottle's neck, pulls the bottle over; what it is for is not said."""
    tool = make("l_hook", 0, length=0.25, tip=0.07, width=0.02, thickness=0.018, inner_radius=0.03, bend=np.pi / 2)
    target = make("cylinder", 0, **BOTTLE)
    tool_view = tool.view("top")
    direction, normal = -UP, np.array([1.0, 0.0, 0.0])
    seen = target_view(target, "top", direction)
    touched = target_contact(seen, BOTTLE["radius"] * normal, normal, BOTTLE["radius"])
    waypoints = (
        Waypoint("above", np.array([0.03, 0, -0.12 - HIGH_UP]), "approach"),
        Waypoint("behind", np.array([0.03, 0, -HIGH_UP]), "approach"),
        Waypoint("touch", np.array([0.0, 0, -HIGH_UP]), "contact", 0.05),
        Waypoint("pulled", np.array([-0.08, 0, -HIGH_UP]), "goal"),
        Waypoint("up", np.array([-0.08, 0, -0.12 - HIGH_UP]), "retreat"),
    )
    times, contacts = through(waypoints)
    contact = tool.contact("inner", tool_view)
    return Strategy(
        name="toppling",
        description="",
        view="top",
        mode="plan",
        **demonstrated(tool, tool_view, contact, target, seen, touched, normal, direction, times, contacts),
        waypoints=waypoints,
        goal=Goal("none"),
        physics=Physics(friction=0.3),
        environment={
            "world_from_target": pose_data(transforms.make(translation=[BOTTLE_X, 0.0, BOTTLE["half_height"]])),
            "tool": made_of(tool),
            "target": made_of(target),
        },
    )


def record_scene(path: Path, things: list[Thing], seed: int, cameras: dict[str, Array], model: DepthModel) -> None:
    """A scene at rest: static transforms and known objects first, then frames and joint states in the order of time."""
    caster = scene_raycaster([t.mesh for t in things])
    frames = [
        capture([], D435, pose, [seed, index, number], camera=name, stamp=START + 0.1 + index * PERIOD, raycaster=caster, model=model)
        for index in range(FRAMES)
        for number, (name, pose) in enumerate(cameras.items())
    ]
    with Recording(path) as bag:
        bag.cameras(frames[: len(cameras)], START)
        known = [t.shape.as_object(t.name, t.world_from_object) for t in things if t.known]
        if known:
            bag.known_objects(known, START)
        events: list[tuple[float, Callable[..., None], tuple]] = [(frame.stamp, bag.frame, (frame,)) for frame in frames]
        events += [(t, bag.joints, (t,)) for t in START + np.arange(0, 0.1 + FRAMES * PERIOD, JOINT_PERIOD)]
        _play(events)
    _write_truth(path, seed, things)


# ---------------------------------------------------------------- demonstrations


@dataclass(frozen=True)
class Bare:
    """A demonstration by a bare hand: tool_from_grip (4, 4), where it holds the tool and its frame there (:mod:`magic_core.testing.hand`);
    thick: the handle's thickness (m); pictures a second."""

    tool_from_grip: Array
    thick: float
    rate: float = 10.0


def gripped(tool: Shape) -> tuple[Array, float]:
    """Where a hand takes a tool that lies, by its end farthest from its middle of mass; and how thick it is there (m)."""
    vertices, middle = tool.mesh.vertices, tool.mesh.to_trimesh().center_mass
    level = vertices[:, :2] - middle[:2]
    away = np.linalg.norm(level, axis=1)
    end = level[int(np.argmax(away))] / away.max()
    far = vertices[level @ end > away.max() - 0.05]
    low, high = far.min(axis=0), far.max(axis=0)
    x = np.array([-end[0], -end[1], 0.0])
    across = far @ np.array([-x[1], x[0], 0.0])
    place = (low + high) / 2 + 0.02 * x
    return transforms.frame(place, x, [0.0, 0.0, 1.0]), float(max(np.ptp(across), high[2] - low[2]))


def made(entry: Mapping[str, Any]) -> Shape:
    """The shape that an entry of a strategy's environment describes."""
    return make(entry["family"], entry["seed"], **entry["parameters"])


@dataclass(frozen=True)
class Cast:
    """What takes part in a demonstration: tool and target, where the target stands (4, 4) in the world, and the fixtures with the shapes
    that they are, by id."""

    tool: Shape
    target: Shape
    world_from_target: Array
    fixtures: list[SceneObject]
    shapes: dict[str, Shape]

    @classmethod
    def of(cls, strategy: Strategy) -> Cast:
        """As the strategy's environment has it."""
        environment = strategy.environment
        world_from_target = demonstrated_pose(environment)
        found = fixtures(environment, (world_from_target @ strategy.target_contact.object_from_contact)[:3, 3])
        shapes = {entry["id"]: made(entry) for entry in environment.get("fixtures", ())}
        return cls(
            made(environment["tool"]), made(environment["target"]), world_from_target, found, {item.id: shapes[item.id] for item in found}
        )


@dataclass(frozen=True)
class Moment:
    """Where tool and target are (4, 4), so many seconds after the demonstration has begun."""

    seconds: float
    world_from_tool: Array
    world_from_target: Array

    @property
    def stamp(self) -> float:
        """Seconds since the epoch."""
        return START + 0.1 + self.seconds


def played(strategy: Strategy, cast: Cast) -> list[Moment]:
    """The demonstration, a moment every :data:`POSE_PERIOD`: the tool lies, is taken up and used, and the target goes as physics has it."""
    rest = settled(cast.tool, lying(cast.tool, *PICKED_UP_FROM[strategy.name]))
    above = transforms.make(translation=[0, 0, 0.25]) @ rest
    way = np.stack([rest, rest, above, *(cast.world_from_target @ strategy.target_from_tool)])
    used = REST + TAKE + strategy.times - strategy.times[0]
    times = np.array([0.0, REST, REST + 0.4 * TAKE, *used])

    world = _World()
    physics = strategy.physics
    world.add("tool", cast.tool, rest, "kinematic", physics.friction, physics.tool_density)
    kind = "static" if physics.target_is_fixed else "dynamic"
    world.add("target", cast.target, cast.world_from_target, kind, physics.friction, physics.target_density)
    for item in cast.fixtures:
        world.add(item.id, cast.shapes[item.id], item.world_from_object, "static", physics.friction)
    settle = 2.0 if strategy.releases else 0.5
    at = np.arange(0, times[-1] + settle + 1e-9, 1 / _World.FREQUENCY)
    commanded = transforms.interpolate(times, way, at)
    moments = [Moment(0.0, rest, cast.world_from_target)]
    released = False
    for k, t in enumerate(at[1:], start=1):
        if strategy.releases and t > times[-1]:
            if not released:
                world.let_go("tool")
                released = True
        else:
            world.move("tool", commanded[k])
        world.step()
        if k % round(POSE_PERIOD * _World.FREQUENCY) == 0:
            moments.append(Moment(float(t), world.pose("tool"), world.pose("target")))
    return moments


def pictured(moments: list[Moment], bare: Bare | None) -> list[Moment]:
    """Those of which pictures are taken: by a bare hand at its rate, else a few while the tool lies and a few while it is used."""
    if bare is not None:
        return moments[:: max(1, round(1 / (bare.rate * POSE_PERIOD)))]
    lying_still = np.linspace(0, REST, LYING_FRAMES + 1)[:-1] / POSE_PERIOD
    in_use = np.linspace((REST + TAKE) / POSE_PERIOD, len(moments) - 1, DEMONSTRATION_FRAMES)
    return [moments[k] for k in np.concatenate([lying_still, in_use]).round().astype(int)]


def meshes_at(cast: Cast, moment: Moment, bare: Bare | None) -> list[Mesh]:
    """What a camera sees, in the world: tool, target, fixtures, and the hand where there is one by then."""
    meshes = [
        cast.tool.mesh.transformed(moment.world_from_tool),
        cast.target.mesh.transformed(moment.world_from_target),
        *(item.mesh.transformed(item.world_from_object) for item in cast.fixtures),
    ]
    if bare is not None and moment.seconds > REST - HAND_COMES:
        away = transforms.make(translation=coming(moment.seconds - REST + HAND_COMES, HAND_COMES))
        meshes.append(hand(bare.thick).transformed(moment.world_from_tool @ bare.tool_from_grip @ away))
    return meshes


def record_demonstration(
    path: Path, strategy: Strategy, seed: int, cameras: dict[str, Array], model: DepthModel, bare: Bare | None = None
) -> None:
    """The tool lying, taken up and in use: its pose and the target's over time, the target moved by physics, seen by both cameras.

    bare: by a hand, and seen all of the time, so that the tool may be followed without its poses.
    """
    cast = Cast.of(strategy)
    moments = played(strategy, cast)
    frames: list[RgbdFrame] = []
    for index, moment in enumerate(pictured(moments, bare)):
        caster = scene_raycaster(meshes_at(cast, moment, bare))
        frames += [
            capture([], D435_SMALL, pose, [seed, index, number], camera=name, stamp=moment.stamp, raycaster=caster, model=model)
            for number, (name, pose) in enumerate(cameras.items())
        ]
    known: list[SceneObject] = list(cast.fixtures)
    if strategy.physics.target_is_fixed:
        known.append(cast.target.as_object("rod", cast.world_from_target))
    with Recording(path) as bag:
        bag.cameras(frames[: len(cameras)], START)
        if known:
            bag.known_objects(known, START)
        events: list[tuple[float, Callable[..., None], tuple]] = [(frame.stamp, bag.frame, (frame,)) for frame in frames]
        for moment in moments:
            events.append((moment.stamp, bag.pose, ("/demonstration/tool_pose", moment.world_from_tool, moment.stamp)))
            events.append((moment.stamp, bag.pose, ("/demonstration/target_pose", moment.world_from_target, moment.stamp)))
            events.append((moment.stamp, bag.joints, (moment.stamp,)))
        _play(events)
    things = [
        Thing("tool", cast.tool, moments[0].world_from_tool),
        Thing("target", cast.target, cast.world_from_target, strategy.physics.target_is_fixed),
        *(Thing(item.id, cast.shapes[item.id], item.world_from_object, True) for item in cast.fixtures),
    ]
    _write_truth(path, seed, things, moments if bare is not None else [])


def _play(events: list[tuple[float, Callable[..., None], tuple]]) -> None:
    """Write what came at a stamp, each by its writer and what that takes, in the order of time."""
    for _, write, arguments in sorted(events, key=lambda event: event[0]):
        write(*arguments)


def _write_truth(path: Path, seed: int, things: list[Thing], moments: Sequence[Moment] = ()) -> None:
    data: dict[str, object] = {"seed": seed, "objects": [t.truth() for t in things]}
    if moments:
        data["tool"] = [{"stamp": moment.stamp, "world_from_object": pose_data(moment.world_from_tool)} for moment in moments]
    (path / "truth.yaml").write_text(yaml.safe_dump(data, sort_keys=False))


#: Things, cameras and what their depth is like.  Without smear are the ladle of ``scooping`` (as a D435 smears it, the arm's motion passes
#: in 12 of 15 rollouts, which is refused) and the demonstrations (at their resolution smear puts hooking's contacts off by 2 and 3 mm, and
#: what is learned from them passes in 6 of 9 rollouts).
SCENES = {
    "hooking": (hooking_scene, CAMERAS, SMEARED),
    "hanging": (hanging_scene, HIGH_CAMERAS, SMEARED),
    "scooping": (scooping_scene, CAMERAS, DepthModel()),
}
NAMES = (*SCENES, *(f"{name}_demonstration" for name in SCENES))
#: Of a task that does not ship.
OTHERS = ("toppling", "toppling_demonstration")


def record(name: str, out: Path, seed: int = 0, bare: bool = False) -> Path:
    """Record one bag of :data:`NAMES` or :data:`OTHERS` into a folder of its name; an older one is replaced."""
    path = out / name
    if path.exists():
        shutil.rmtree(path)
    out.mkdir(parents=True, exist_ok=True)

    def by_hand(strategy: Strategy) -> Bare | None:
        return Bare(*gripped(made(strategy.environment["tool"]))) if bare else None

    if name in SCENES:
        scene, cameras, model = SCENES[name]
        record_scene(path, scene(seed), seed, cameras, model)
    elif name == "toppling":
        record_scene(path, toppling_scene(seed), seed, CAMERAS, SMEARED)
    elif name == "toppling_demonstration":
        record_demonstration(path, toppling(), seed, CAMERAS, SMEARED, by_hand(toppling()))
    else:
        task = name.removesuffix("_demonstration")
        strategy = make_strategies.STRATEGIES[task]()
        record_demonstration(path, strategy, seed, SCENES[task][1], SMEARED if bare else DepthModel(), by_hand(strategy))
    return path


def main(arguments: list[str] | None = None) -> int:
    """Record bags."""
    parser = argparse.ArgumentParser(description="Record the bags of this folder.")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parent, help="folder that gets one folder for each bag")
    parser.add_argument("--seed", type=int, default=0, help="seed of objects and sensor noise, from 0 up")
    parser.add_argument("--bare-hand", action="store_true", help="demonstrations by a hand, seen all of the time")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"which of {', '.join(NAMES)}; all of them by default; or of {', '.join(OTHERS)}"
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in (*NAMES, *OTHERS)]
    if unknown:
        parser.error(f"unknown bag {unknown[0]!r} (allowed: {', '.join((*NAMES, *OTHERS))})")
    for name in options.names or NAMES:
        path = record(name, options.out, options.seed, options.bare_hand)
        size = sum(f.stat().st_size for f in path.iterdir())
        print(f"recorded {path}: {size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
