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
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.shapes import make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_core.strategy import Strategy

#: Stamp of the first message, seconds since the epoch, and how often the frame is repeated, seconds apart.
START, REPEATS, PERIOD = 1735689600.0, 3, 0.2
#: Units of depth images, metres.
UNITS = {"mm": 0.001, "m": 1.0}
#: Where things are put in front of the robot (x, y), in order of preference, metres.
PLACES = ((0.48, -0.30), (0.48, 0.30), (0.42, -0.24), (0.42, 0.24), (0.55, -0.30), (0.55, 0.30), (0.45, 0.0))
#: Height above the table, metres, from which on a point belongs to a thing.
ABOVE = 0.012
#: A thing has at least so many points, and points of one thing are so near to each other (metres).
SMALLEST, GAP = 200, 0.012
#: Gap in metres that fixtures keep from what was seen.
CLEARANCE = 0.06


def read_color(path: Path | str) -> NDArray[np.uint8]:
    """A colour or grey image as (H, W, 3) uint8 RGB; raises ``BAD_IMAGE``."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if Path(path).is_file() else None
    if image is None:
        raise MagicError(Code.BAD_IMAGE, "colour image", str(path), "a readable PNG or JPEG")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(path: Path | str, unit: str | None = None) -> NDArray[np.float32]:
    """A depth image (16-bit PNG, float TIFF or EXR, ``.npy``) as (H, W) float32 metres, NaN where there is none.

    unit: ``mm`` or ``m``; by default mm for whole numbers, m for floating-point ones.  Raises
    ``BAD_IMAGE``, ``BAD_ENCODING`` (an 8-bit image), ``NO_DEPTH`` (no valid pixel, or none between 0.05 and 20 m).
    """
    import cv2

    path = Path(path)
    try:
        raw = (
            np.load(path, allow_pickle=False)
            if path.suffix == ".npy"
            else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if path.is_file()
            else None
        )
    except (OSError, ValueError) as error:
        raise MagicError(Code.BAD_IMAGE, "depth image", f"{path}: {error}", "a readable array") from error
    if raw is None:
        raise MagicError(Code.BAD_IMAGE, "depth image", str(path), "a readable 16-bit PNG, float TIFF or .npy")
    if raw.ndim != 2 or raw.dtype == np.uint8 or raw.dtype.kind not in "uif":
        raise MagicError(Code.BAD_ENCODING, "depth image", f"{path}: {raw.shape} {raw.dtype}", "one channel, 16-bit or floating point")
    unit = unit or ("m" if raw.dtype.kind == "f" else "mm")
    if unit not in UNITS:
        raise MagicError(Code.BAD_ENCODING, "depth unit", unit, tuple(UNITS))
    depth = raw.astype(np.float32) * np.float32(UNITS[unit])
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    seen = depth[np.isfinite(depth)]
    if len(seen) == 0:
        raise MagicError(Code.NO_DEPTH, f"depth image {path}", "no valid pixel", "at least one above 0")
    middle = float(np.median(seen))
    if not 0.05 <= middle <= 20:
        raise MagicError(Code.NO_DEPTH, f"median depth of {path} in {unit}", f"{middle:.4g} m", "0.05 to 20 m; is the depth unit right?")
    return depth


def read_intrinsics(source: str, width: int, height: int, hint: str = "") -> Intrinsics:
    """Intrinsics from ``fx,fy,cx,cy`` or a JSON file, for an image of that size; raises ``BAD_INTRINSICS``.

    The file holds ``fx, fy, cx, cy``, or a 3 x 3 ``K`` / ``intrinsic_matrix`` (nested rows, or nine
    numbers, row- or column-major), or such entries by name: ``FILE:NAME`` picks one, else the one
    that ``hint`` (a file name) begins with, else the only one.
    """
    allowed = "fx,fy,cx,cy or a JSON file with fx, fy, cx, cy or a 3 x 3 matrix"
    path, _, name = source.partition(":") if not Path(source).is_file() else (source, "", "")
    if Path(path).is_file():
        try:
            data: Any = json.loads(Path(path).read_text())
        except (OSError, ValueError) as error:
            raise MagicError(Code.BAD_INTRINSICS, "intrinsics file", f"{path}: {error}", allowed) from error
        if isinstance(data, dict) and data and all(isinstance(v, dict) for v in data.values()):
            fitting = [name] if name else [k for k in data if hint.startswith(k)] or (list(data) if len(data) == 1 else [])
            if not fitting or fitting[0] not in data:
                raise MagicError(Code.BAD_INTRINSICS, f"entry of {path}", name or hint, [f"{path}:{k}" for k in data])
            data = data[max(fitting, key=len)]
        values, size = _from_json(data, path, allowed)
        if size and size != (width, height):
            raise MagicError(
                Code.BAD_INTRINSICS, f"image size in {path}", f"{size[0]} x {size[1]}", f"{width} x {height}, the size of the colour image"
            )
    else:
        try:
            values = [float(v) for v in source.split(",")]
        except ValueError:
            raise MagicError(Code.BAD_INTRINSICS, "intrinsics", source, allowed) from None
    if len(values) != 4:
        raise MagicError(Code.BAD_INTRINSICS, "intrinsics", source, allowed)
    return Intrinsics(width, height, *values)


def _from_json(data: Any, path: str, allowed: str) -> tuple[list[float], tuple[int, int] | None]:
    try:
        size = (int(data["width"]), int(data["height"])) if "width" in data and "height" in data else None
        if "fx" in data:
            return [float(data[k]) for k in ("fx", "fy", "cx", "cy")], size
        matrix = np.array(next(data[k] for k in ("K", "k", "intrinsic_matrix", "camera_matrix") if k in data), dtype=float).reshape(3, 3)
        if matrix[2, 0] != 0 or matrix[2, 1] != 0:  # Open3D writes the columns one after the other
            matrix = matrix.T
        return [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])], size
    except (KeyError, StopIteration, TypeError, ValueError, IndexError) as error:
        raise MagicError(Code.BAD_INTRINSICS, "intrinsics file", f"{path}: {type(error).__name__} {error}", allowed) from error


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


def place_camera(points: NDArray[np.float64], known: Sequence[SceneObject], seed: int = 0) -> NDArray[np.float64]:
    """world_from_camera (4, 4) from the table in view, with the nearest thing on it where the robot reaches it.

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
    return best[1]


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
    color: NDArray[np.uint8],
    depth: NDArray[np.float32],
    intrinsics: Intrinsics,
    out: Path | str,
    *,
    strategy: Strategy | None = None,
    fixture_pose: NDArray[np.float64] | None = None,
    camera_pose: NDArray[np.float64] | None = None,
    camera: str = "left",
    seed: int = 0,
) -> RgbdFrame:
    """Write the bag; returns the frame as it was written, with the camera's pose.  Raises ``BAD_BAG`` where the folder exists."""
    from magic_bringup.recording import Recording

    known = strategy_fixtures(strategy, fixture_pose) if strategy is not None else []
    RgbdFrame(color, depth, intrinsics, np.eye(4), camera)  # the sizes agree, or BAD_IMAGE says which do not
    world_from_camera = place_camera(intrinsics.unproject(depth), known, seed) if camera_pose is None else camera_pose
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
    if not np.all(np.isfinite(values)) or abs(float(np.linalg.norm(values[3:])) - 1) > 0.01:
        raise MagicError(Code.BAD_REQUEST, what, list(values), "x y z in metres and a unit quaternion qx qy qz qw")
    return transforms.from_quaternion(values[:3], values[3:])


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(prog="rgbd_to_bag", description="Turn a colour image, a depth image and intrinsics into a bag.")
    result.add_argument("--color", type=Path, required=True, help="colour image (PNG, JPEG)")
    result.add_argument(
        "--depth", type=Path, required=True, help="depth image registered to the colour image (16-bit PNG, float TIFF, .npy)"
    )
    result.add_argument("--intrinsics", required=True, help="fx,fy,cx,cy in pixels, or a JSON file (FILE:NAME for one entry of several)")
    result.add_argument(
        "--depth-unit", choices=tuple(UNITS), help="unit of the depth image; default: mm for whole numbers, m for floating point"
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
        color = read_color(options.color)
        depth = read_depth(options.depth, options.depth_unit)
        intrinsics = read_intrinsics(options.intrinsics, color.shape[1], color.shape[0], options.color.name)
        strategy = None if options.strategy == "none" else strategies.find(options.strategy)
        if options.force and (options.out / "metadata.yaml").is_file():
            shutil.rmtree(options.out)
        frame = convert(
            color,
            depth,
            intrinsics,
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
