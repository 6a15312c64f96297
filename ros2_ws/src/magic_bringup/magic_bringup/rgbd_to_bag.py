"""Turns one colour image and one depth image into a bag that the graph can run on.

    ros2 run magic_bringup rgbd_to_bag --color C.png --depth D.png --intrinsics K.json --out DIR

Without ``--camera-pose`` the camera's pose is found from the table that it sees: the
plane becomes z = 0, and it is turned and moved so that the nearest thing on it lies
within the robot's reach and off the strategy's fixtures (the rod of hanging, the arc of
scooping), which are put where the demonstration had them.

Exit status 0; 1 with one line ``[code NAME] what: value (allowed: ...)`` for bad input.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magic_core import depth as depths
from magic_core import images, transforms
from magic_core import strategy as strategies
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.shapes import make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_core.strategy import Strategy

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


def strategy_fixtures(strategy: Strategy, pose: NDArray[np.float64] | None = None) -> list[SceneObject]:
    """What a strategy calls for besides tool and movable target, as known objects where the demonstration had it.

    pose (4, 4): another place for the fixed target.
    """
    environment = strategy.environment
    world_from_target = demonstrated_pose(environment) if pose is None else pose
    contact = (world_from_target @ strategy.target_contact.object_from_contact)[:3, 3]
    found = fixtures(environment, contact)
    if strategy.physics.target_is_fixed:
        entry = environment["target"]
        found.append(make(entry["family"], entry["seed"], **entry["parameters"]).as_object(entry["family"], world_from_target))
    return found


def place_camera(points: NDArray[np.float64], known: Sequence[SceneObject], seed: int = 0) -> tuple[NDArray[np.float64], float]:
    """world_from_camera (4, 4) from the table in view, with the nearest thing on it where the robot reaches it, and that thing's length, m.

    points (H, W, 3) in the optical frame, NaN where there is none.  Of the places in
    :data:`PLACES` and 24 directions of view, the one is taken that keeps what was seen
    off the fixtures and the robot's foot; earlier places, and views towards the robot, first.
    Raises ``NO_TABLE``, ``NO_OBJECTS``.
    """
    from magic_perception.table import camera_over_table

    table_from_camera = camera_over_table(points, seed=seed)
    flat = transforms.apply(table_from_camera, points.reshape(-1, 3))
    high = flat[np.isfinite(flat).all(axis=1) & (flat[:, 2] > ABOVE) & (flat[:, 2] < 0.5)]
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


def convert(
    picture: images.Rgbd,
    out: Path | str,
    *,
    strategy: Strategy | None = None,
    fixture_pose: NDArray[np.float64] | None = None,
    camera_pose: NDArray[np.float64] | None = None,
    camera: str = "left",
    seed: int = 0,
) -> RgbdFrame:
    """Write the bag; returns the frame as it was written, with the camera's pose.

    camera_pose (4, 4): world_from_camera of the picture as it is stored.  Raises ``BAD_BAG`` where the folder exists, ``DEPTH_UNIT``
    where depth does not fit the pose, or things are large and far away.
    """
    from magic_bringup.recording import Recording

    known = strategy_fixtures(strategy, fixture_pose) if strategy is not None else []
    color, depth, intrinsics = picture.color, picture.depth, picture.intrinsics
    RgbdFrame(color, depth, intrinsics, np.eye(4), camera)  # the sizes agree, or BAD_IMAGE says which do not
    if camera_pose is None:
        world_from_camera, size = place_camera(intrinsics.unproject(depth), known, seed)
        depths.check_sizes(float(np.nanmedian(depth)), [size], picture.unit, picture.told, images.REMEDY)
    else:
        world_from_camera = camera_pose @ picture.stored_from_shown
        depths.check_pose(RgbdFrame(color, depth, intrinsics, world_from_camera, camera), picture.unit, images.REMEDY)
    with Recording(out) as bag:
        frames = [RgbdFrame(color, depth, intrinsics, world_from_camera, camera, START + 0.1 + k * PERIOD) for k in range(REPEATS)]
        bag.cameras(frames[:1], START)
        if known:
            bag.known_objects(known, START)
        for frame in frames:
            bag.joints(frame.stamp)
            bag.frame(frame)
    return frames[0]


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
    result.add_argument(
        "--rod", **pose, help="pose of the strategy's fixed target (hanging: the rod, free end at its -x); default: the demonstration's"
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
        frame = convert(
            picture,
            options.out,
            strategy=strategy,
            fixture_pose=_pose(options.rod, "--rod") if options.rod else None,
            camera_pose=_pose(options.camera_pose, "--camera-pose") if options.camera_pose else None,
            camera=options.camera,
            seed=options.seed,
        )
    except MagicError as error:
        print(error, file=sys.stderr)
        return 1
    x, y, z = frame.world_from_camera[:3, 3]
    qx, qy, qz, qw = transforms.quaternion_xyzw(frame.world_from_camera)
    print(f"wrote {options.out}; camera at {x:.4f} {y:.4f} {z:.4f} {qx:.6f} {qy:.6f} {qz:.6f} {qw:.6f} in panda_link0")
    return 0


if __name__ == "__main__":
    sys.exit(main())
