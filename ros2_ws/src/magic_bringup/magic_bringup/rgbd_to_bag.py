"""Turns one colour image and one depth image into a bag that the graph can run on.

    ros2 run magic_bringup rgbd_to_bag --color C.png --depth D.png --intrinsics K.json --out DIR

Without ``--camera-pose`` the camera's pose is found from the table that it sees: the
plane becomes z = 0, and it is turned and moved so that the tool, or without ``--tool`` the
nearest thing on it, lies within the robot's reach and off the target and the strategy's
fixtures (the rod of hanging, the arc of scooping), which are put where the demonstration
had them.

``--tool`` names what is the tool, by a pixel of the picture (``320,240``) or in words
(``"the red mug"``, see :mod:`magic_core.naming`).  ``--target`` puts another target on
the table: a mesh file, or a made one, ``FAMILY[:KEY=VALUE,...]`` (``cylinder:radius=0.03,half_height=0.03``,
``rod``, ``mug_tree:pegs=1``), where ``--target-pose`` says or the demonstration's target
stood.  The objects that perception finds in the bag are listed, with the command that runs it.

Exit status 0; 1 with one line ``[code NAME] what: value (allowed: ...)`` for bad input.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core import depth as depths
from magic_core import images, naming, transforms
from magic_core import strategy as strategies
from magic_core.camera import RgbdFrame
from magic_core.decomposition import convex_pieces
from magic_core.errors import Code, MagicError
from magic_core.mesh import check_solid, load
from magic_core.scene import Scene, SceneObject
from magic_core.shapes import FAMILIES, make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_core.strategy import Strategy
from magic_core.views import find_view

#: Stamp of the first message, seconds since the epoch, and how often the frame is repeated, seconds apart.
START, REPEATS, PERIOD = 1735689600.0, 3, 0.2
#: Where things are put in front of the robot (x, y), in order of preference, metres.
PLACES = ((0.48, -0.30), (0.48, 0.30), (0.42, -0.24), (0.42, 0.24), (0.55, -0.30), (0.55, 0.30), (0.45, 0.0))
#: Height above the table, metres, from which on a point belongs to a thing.
ABOVE = 0.012
#: A thing has at least so many points, and points of one thing are so near to each other (metres).
SMALLEST, GAP = 200, 0.012
#: Gap in metres that fixtures keep from what was seen.
CLEARANCE = 0.06
#: Id of a target that is put on the table.
TARGET = "target"


def strategy_fixtures(strategy: Strategy, pose: NDArray[np.float64] | None = None, target: str = "", seed: int = 0) -> list[SceneObject]:
    """What a strategy calls for besides tool and movable target, as known objects where the demonstration had it.

    pose (4, 4): another place for the target.  target: another one, as ``--target`` takes it, also where it is movable.
    """
    environment = strategy.environment
    if target:
        item = made_target(target, seed)
        if pose is None:
            # On the table, where the demonstration's stood.
            pose = transforms.make(translation=[*demonstrated_pose(environment)[:2, 3], -float(item.mesh.bounds[0, 2])])
        item = replace(item, world_from_object=pose, world_from_box=pose @ item.world_from_box)
        contact = transforms.apply(pose, item.mesh.vertices).mean(axis=0)
        return [*fixtures(environment, contact), item]
    world_from_target = demonstrated_pose(environment) if pose is None else pose
    contact = (world_from_target @ strategy.target_contact.object_from_contact)[:3, 3]
    found = fixtures(environment, contact)
    if strategy.physics.target_is_fixed:
        entry = environment["target"]
        found.append(make(entry["family"], entry["seed"], **entry["parameters"]).as_object(entry["family"], world_from_target))
    return found


def made_target(text: str, seed: int = 0) -> SceneObject:
    """A target as ``--target`` takes it, in its own frame: ``FAMILY[:KEY=VALUE,...]``, or a mesh file (metres, z up).
    Raises ``BAD_REQUEST``, ``BAD_MESH``."""
    family, _, rest = text.partition(":")
    if family in FAMILIES:
        parameters: dict[str, float | str] = {}
        for item in filter(None, rest.split(",")):
            key, equals, value = item.partition("=")
            if not equals:
                raise MagicError(Code.BAD_REQUEST, f"--target {family}", item, "KEY=VALUE")
            try:
                parameters[key.strip()] = float(value)
            except ValueError:
                parameters[key.strip()] = value.strip()
        return make(family, seed, **parameters).as_object(TARGET, np.eye(4))
    if not Path(text).is_file():
        raise MagicError(Code.BAD_REQUEST, "--target", text, f"a mesh file, or a family: {', '.join(FAMILIES)}")
    mesh = load(text)
    check_solid(mesh, text)
    pieces = convex_pieces(mesh)
    low, high = mesh.bounds
    box = transforms.make(translation=(low + high) / 2)
    return SceneObject(TARGET, mesh, pieces, np.eye(4), find_view(mesh, pieces), world_from_box=box, box_extents=high - low, source="known")


def place_camera(
    points: NDArray[np.float64],
    known: Sequence[SceneObject],
    seed: int = 0,
    table_from_camera: NDArray[np.float64] | None = None,
    thing: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], float]:
    """world_from_camera (4, 4) from the table in view, with one thing on it where the robot reaches it, and that thing's length, m.

    points (H, W, 3) in the optical frame, NaN where there is none; table_from_camera (4, 4): where it is known already; thing (N, 3):
    points of the thing in the table's frame, the nearest one where none are given.  Of the places in :data:`PLACES` and 24 directions of
    view, the one is taken that keeps what was seen off the fixtures and the robot's foot; earlier places, and views towards the robot,
    first. Raises ``NO_TABLE``, ``NO_OBJECTS``.
    """
    from magic_perception.table import camera_over_table

    if table_from_camera is None:
        table_from_camera = camera_over_table(points, seed=seed)
    flat = transforms.apply(table_from_camera, points.reshape(-1, 3))
    high = flat[np.isfinite(flat).all(axis=1) & (flat[:, 2] > ABOVE) & (flat[:, 2] < 0.5)]
    if thing is None:
        thing = _nearest_thing(high, table_from_camera[:2, 3])
    middle = (thing.min(axis=0) + thing.max(axis=0)) / 2
    radius = float(np.linalg.norm(thing[:, :2] - middle[:2], axis=1).max())
    boxes = [transforms.apply(item.world_from_object, item.mesh.vertices) for item in known]
    sample = high[:: max(1, len(high) // 3000)]

    best: tuple[float, NDArray[np.float64]] | None = None
    for rank, place in enumerate(PLACES):
        for k in range(24):
            # x of the table frame is the direction of view: half a turn looks back at the robot.
            yaw = np.pi + (k + 1) // 2 * (-1) ** k * 2 * np.pi / 24
            turn = transforms.from_rpy(0, 0, float(yaw))
            turn[:2, 3] = place - turn[:2, :2] @ middle[:2]
            seen = transforms.apply(turn, sample)
            blocked = float(np.mean(np.linalg.norm(seen[:, :2], axis=1) < 0.2))
            for corners in boxes:
                low, top = corners.min(axis=0) - CLEARANCE, corners.max(axis=0) + CLEARANCE
                blocked += float(np.mean(np.all((seen > low) & (seen < top), axis=1)))
                gap = np.maximum(np.maximum(low[:2] + CLEARANCE - place, place - top[:2] + CLEARANCE), 0)
                blocked += 10.0 * max(0.0, radius + CLEARANCE - float(np.linalg.norm(gap)))
            cost = 10 * blocked + 0.02 * rank + 0.001 * k
            if best is None or cost < best[0]:
                best = (cost, turn @ table_from_camera)
    assert best is not None
    return best[1], float(np.ptp(thing, axis=0).max())


def _nearest_thing(points: NDArray[np.float64], camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of points (N, 3) above the table, those of the connected thing that lies nearest to the camera's foot (2,)."""
    import cv2

    if len(points) >= SMALLEST:
        low = points[:, :2].min(axis=0)
        cells = np.floor((points[:, :2] - low) / (GAP / 2)).astype(int)
        size = cells.max(axis=0) + 1
        if size.max() < 8000:
            grid = np.zeros(tuple(size), np.uint8)
            grid[cells[:, 0], cells[:, 1]] = 1
            joined = cv2.dilate(grid, np.ones((3, 3), np.uint8))
            _, labels = cv2.connectedComponents(joined)
            label = labels[cells[:, 0], cells[:, 1]]
            things = [points[label == i] for i in np.unique(label)]
            things = [t for t in things if len(t) >= SMALLEST and np.ptp(t[:, :2], axis=0).max() < 0.5]
            if things:
                return min(things, key=lambda t: float(np.linalg.norm(np.median(t[:, :2], axis=0) - camera)))
    raise MagicError(Code.NO_OBJECTS, "points above the table", len(points), f"a thing of at least {SMALLEST} points, up to 0.5 m across")


def chosen(scene: Scene, tool: str) -> SceneObject:
    """The object that ``--tool`` means: that at a pixel ``U,V`` of the picture, or what words name.  Raises ``NO_OBJECTS``, or what
    :func:`magic_core.naming.resolve` raises."""
    try:
        u, v = (round(float(x)) for x in tool.split(","))
    except ValueError:
        return scene.find(naming.resolve(tool, scene.objects).id)
    seen = [o for o in scene.objects if o.mask is not None]
    for item in seen:
        if 0 <= v < item.mask.shape[0] and 0 <= u < item.mask.shape[1] and item.mask[v, u]:
            return item
    raise MagicError(Code.NO_OBJECTS, "thing at the pixel --tool", tool, [_told(o) for o in seen])


def standing_on(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """world_from_table (4, 4) of a plane (4,) whose normal points up: z along the normal, the origin below or above the
    world's, x as near to the world's as can be."""
    origin = np.array([0.0, 0.0, -table[3] / table[2]])
    return transforms.frame(origin, np.array([1.0, 0.0, 0.0]) - table[0] * table[:3], table[:3])


def _told(item: SceneObject) -> str:
    rows, columns = np.nonzero(item.mask)
    # A pixel of the thing itself, near its middle: that of a ring is none.
    best = int(np.argmin(np.hypot(rows - rows.mean(), columns - columns.mean())))
    return f"{naming.looks(item)}, at {columns[best]},{rows[best]}"


@dataclass(frozen=True)
class Converted:
    """The frame as it was written, with the camera's pose; known: what was put beside what it shows; scene: what perception will find;
    tool: the id of what ``--tool`` means there, empty without one."""

    frame: RgbdFrame
    known: tuple[SceneObject, ...]
    scene: Scene
    tool: str


def convert(
    picture: images.Rgbd,
    out: Path | str,
    *,
    strategy: Strategy | None = None,
    target: str = "",
    target_pose: NDArray[np.float64] | None = None,
    camera_pose: NDArray[np.float64] | None = None,
    tool: str = "",
    camera: str = "left",
    seed: int = 0,
) -> Converted:
    """Write the bag.

    camera_pose (4, 4): world_from_camera of the picture as it is stored.  target, tool: as the command line takes them.  Raises ``BAD_BAG``
    where the folder exists, ``DEPTH_UNIT`` where depth does not fit the pose, or things are large and far away.
    """
    from magic_bags.recording import Recording
    from magic_perception.parameters import WORKSPACE, Parameters
    from magic_perception.pipeline import perceive
    from magic_perception.table import camera_over_table
    from magic_perception.tracking import Tracker

    if target and strategy is None:
        raise MagicError(Code.BAD_REQUEST, "--target without a strategy", target, "a strategy, whose demonstration says where things stand")
    known = strategy_fixtures(strategy, target_pose, target, seed) if strategy is not None else []
    color, depth, intrinsics = picture.color, picture.depth, picture.intrinsics
    RgbdFrame(color, depth, intrinsics, np.eye(4), camera)  # the sizes agree, or BAD_IMAGE says which do not
    if camera_pose is None:
        points = intrinsics.unproject(depth)
        over, thing = camera_over_table(points, seed=seed), None
        if tool:
            first = perceive([RgbdFrame(color, depth, intrinsics, over, camera)], (), Parameters(seed=seed))
            # The plane that most of the picture shows may be the floor: what the tool stands on is z = 0.
            level = transforms.inverse(standing_on(first.table))
            over, thing = level @ over, transforms.apply(level, chosen(first, tool).points)
        world_from_camera, size = place_camera(points, known, seed, over, thing)
        depths.check_sizes(float(np.nanmedian(depth)), [size], picture.unit, picture.told, images.REMEDY)
    else:
        world_from_camera = camera_pose @ picture.stored_from_shown
        depths.check_pose(RgbdFrame(color, depth, intrinsics, world_from_camera, camera), picture.unit, images.REMEDY)
    frames = [RgbdFrame(color, depth, intrinsics, world_from_camera, camera, START + 0.1 + k * PERIOD) for k in range(REPEATS)]
    try:
        scene = Tracker().update(perceive(frames[:1], tuple(known), Parameters(**WORKSPACE, seed=seed)))
    except MagicError as error:
        if tool:
            raise
        scene = Scene((), np.array([0.0, 0.0, 1.0, 0.0]), notes=(f"perception finds nothing in it: {error}",))
    found = chosen(scene, tool).id if tool else ""
    with Recording(out) as bag:
        bag.cameras(frames[:1], START)
        if known:
            bag.known_objects(known, START)
        for frame in frames:
            bag.joints(frame.stamp)
            bag.frame(frame)
    return Converted(frames[0], tuple(known), scene, found)


def _pose(values: Sequence[float], what: str) -> NDArray[np.float64]:
    try:
        return transforms.from_numbers(values)
    except ValueError as error:
        raise MagicError(Code.BAD_REQUEST, what, list(values), f"x y z qx qy qz qw: {error}") from None


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(prog="rgbd_to_bag", description="Turn a colour image, a depth image and intrinsics into a bag.")
    result.add_argument("--color", type=Path, required=True, help="colour image (PNG, JPEG)")
    result.add_argument(
        "--depth", type=Path, required=True, help="depth image registered to the colour image (16-bit PNG, TIFF, EXR, .npy)"
    )
    result.add_argument("--intrinsics", required=True, help="fx,fy,cx,cy in pixels, or a JSON file (FILE:NAME for one entry of several)")
    result.add_argument(
        "--depth-unit",
        help=f"what 1 in the depth image is: {', '.join(depths.UNITS)} or another multiple; default: mm for whole numbers, m for floating point",
    )
    result.add_argument("--out", type=Path, required=True, help="folder of the new bag")
    result.add_argument("--force", action="store_true", help="replace the bag if it exists")
    pose = {"nargs": 7, "type": float, "metavar": ("X", "Y", "Z", "QX", "QY", "QZ", "QW")}
    result.add_argument("--camera-pose", **pose, help="pose of the colour optical frame in panda_link0; default: from the table in view")
    result.add_argument(
        "--strategy", default="hanging", help="name or folder of the strategy whose fixtures are added, or none; default hanging"
    )
    result.add_argument("--tool", default="", help="which thing is the tool: a pixel U,V of the picture, or words (the red mug)")
    result.add_argument(
        "--target",
        default="",
        help="a target that is put on the table: a mesh file (m, z up), or FAMILY[:KEY=VALUE,...], say cylinder:radius=0.03,half_height=0.03, "
        "rod, mug_tree:pegs=1; default: the strategy's own where it is fixed, else none",
    )
    result.add_argument(
        "--target-pose",
        "--rod",
        **pose,
        help="pose of the target (rod: free end at its -x; mug_tree: first peg at -x); default: where the demonstration's was",
    )
    result.add_argument("--camera", default="left", help="name of the camera in the topics; default left")
    result.add_argument("--seed", type=int, default=0, help="seed of the search for the table")
    return result


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    options = parser().parse_args(arguments)
    try:
        picture = images.read_rgbd(options.color, options.depth, options.intrinsics, options.depth_unit)
        strategy = None if options.strategy == "none" else strategies.find(options.strategy)
        if options.force and (options.out / "metadata.yaml").is_file():
            shutil.rmtree(options.out)
        made = convert(
            picture,
            options.out,
            strategy=strategy,
            target=options.target,
            target_pose=_pose(options.target_pose, "--target-pose") if options.target_pose else None,
            camera_pose=_pose(options.camera_pose, "--camera-pose") if options.camera_pose else None,
            tool=options.tool,
            camera=options.camera,
            seed=options.seed,
        )
    except MagicError as error:
        print(error, file=sys.stderr)
        return 1
    frame = made.frame
    x, y, z = frame.world_from_camera[:3, 3]
    qx, qy, qz, qw = transforms.quaternion_xyzw(frame.world_from_camera)
    print(f"wrote {options.out}; camera at {x:.4f} {y:.4f} {z:.4f} {qx:.6f} {qy:.6f} {qz:.6f} {qw:.6f} in panda_link0")
    for item in made.scene.objects:
        if item.source == "camera":
            print(
                f"{_told(item)}, confidence {item.confidence:.2f}" + (f", cut off by {' and '.join(item.cut_off)}" if item.cut_off else "")
            )
    for item in made.known:
        print(f"{item.id}: known")
    for note in made.scene.notes:
        print(f"note: {note}")
    words = ["bash ros2_ws/demo.sh", "--strategy", options.strategy, "--bag", str(options.out), "--cameras", options.camera]
    words += ["--tool", made.tool] if made.tool else []
    words += ["--target", TARGET] if options.target else []
    if strategy is not None:
        print(f"to run it: {' '.join(words)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
