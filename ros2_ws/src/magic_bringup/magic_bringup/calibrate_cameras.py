"""Where cameras stand, from a bag with a ChArUco board: ``ros2 run magic_bringup calibrate_cameras --help``.

    ros2 run magic_bringup calibrate_cameras --draw board.png                           the board, to be printed
    ros2 run magic_bringup calibrate_cameras --bag BAG --board-at X Y Z YAW --out DIR   it lies on the table at a measured place
    ros2 run magic_bringup calibrate_cameras --bag BAG --on-hand --out DIR              it is fixed to the hand, carried before the cameras

The bag holds ``/camera/NAME/color/image_raw`` (or ``/compressed``), its ``camera_info``, if possible ``aligned_depth_to_color``, and for
``--on-hand`` ``/joint_states``; the arm rests for a second at each of some ten places.  Exit status 0; 1 with one line that says why where
the pictures do not tell where the cameras are: then nothing is written but the pictures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from magic_bags import bag_messages
from magic_bringup.record import CAMERA_TOPIC, raw_topic, shown
from magic_core import conversions, transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description, RobotConfig
from magic_perception import calibration
from magic_perception.calibration import Board, Calibration, Lens, View

#: The arm rests where no joint moves by more than this within so many seconds on either side, rad; two rests differ by more than APART.
STILL, AROUND, APART = 0.002, 0.15, 0.01
#: Depth belongs to a colour picture whose stamp is off by no more than this, s.
TOGETHER = 0.02
#: Distortion models whose coefficients OpenCV takes in their order.
MODELS = ("plumb_bob", "rational_polynomial", "")


@dataclass
class Pictures:
    """Pictures of one camera: stamps of all, and the chosen ones by stamp."""

    stamps: list[float] = field(default_factory=list)
    color: dict[float, NDArray[np.uint8]] = field(default_factory=dict)
    depth: dict[float, NDArray[np.float32]] = field(default_factory=dict)
    lens: Lens | None = None


def _camera(topic: str) -> tuple[str, str, str] | None:
    """Camera, image (color, aligned_depth_to_color) and part (image_raw, camera_info) of a topic; None: of no camera."""
    match = CAMERA_TOPIC.match(raw_topic(topic))
    return (match["camera"].rstrip("/").rsplit("/", 1)[-1], match["image"], match["part"]) if match else None


def _stamp(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def lens_of(message: Any) -> Lens:
    """The lens of a CameraInfo; raises BAD_INTRINSICS for a distortion model that is not known here."""
    if message.distortion_model not in MODELS:
        raise MagicError(Code.BAD_INTRINSICS, "distortion model", message.distortion_model, MODELS[:-1])
    d = np.asarray(message.d, dtype=float)
    return Lens(conversions.intrinsics_from_msg(message), d if np.any(d) else np.zeros(0))


def read_stamps(bag: Path, cameras: Sequence[str]) -> tuple[dict[str, Pictures], list[tuple[float, dict[str, float]]]]:
    """Stamps and lenses of the cameras, and the joint states (stamp, positions by name); raises BAD_BAG, NO_FRAMES, NO_CAMERA_INFO."""
    found: dict[str, Pictures] = {}
    joints: list[tuple[float, dict[str, float]]] = []

    def wanted(topic: str, _kind: str) -> bool:
        place = _camera(topic)
        return topic.endswith("/joint_states") or (place is not None and place[1] == "color" and (not cameras or place[0] in cameras))

    for topic, _, message in bag_messages.messages(bag, wanted):
        if topic.endswith("/joint_states"):
            joints.append((_stamp(message), dict(zip(message.name, message.position))))
            continue
        place = _camera(topic)
        assert place is not None
        pictures = found.setdefault(place[0], Pictures())
        if place[2] == "camera_info":
            pictures.lens = pictures.lens or lens_of(message)
        else:
            pictures.stamps.append(_stamp(message))
    for name in cameras or sorted(found) or ("left",):
        if name not in found or not found[name].stamps:
            raise MagicError(Code.NO_FRAMES, f"pictures of camera {name} in {bag}", 0, f"/camera/{name}/color/image_raw or its /compressed")
        if found[name].lens is None:
            raise MagicError(Code.NO_CAMERA_INFO, f"intrinsics of camera {name} in {bag}", "none", f"/camera/{name}/color/camera_info")
    return found, joints


def rests(joints: Sequence[tuple[float, Mapping[str, float]]], names: Sequence[str]) -> list[tuple[float, float, NDArray[np.float64]]]:
    """Where the arm rested: begin and end in s, and the positions (J,) of its joints; raises NO_FRAMES where none of it is told."""
    rows = [(t, np.array([told[n] for n in names])) for t, told in joints if all(n in told for n in names)]
    if not rows:
        raise MagicError(Code.NO_FRAMES, "joint states of the arm in the bag", 0, f"/joint_states with {', '.join(names)}")
    times, positions = np.array([t for t, _ in rows]), np.stack([q for _, q in rows])
    found: list[tuple[float, float, NDArray[np.float64]]] = []
    for index, at in enumerate(times):
        near = positions[(times >= at - AROUND) & (times <= at + AROUND)]
        if len(near) < 2 or np.ptp(near, axis=0).max() > STILL:
            continue
        # The same pose again after a move is another rest: what lies between is no picture of an arm at rest.
        if found and at - found[-1][1] <= 2 * AROUND and np.abs(positions[index] - found[-1][2]).max() < APART:
            found[-1] = (found[-1][0], float(at), found[-1][2])
        else:
            found.append((float(at), float(at), positions[index]))
    return found


def choose(pictures: Mapping[str, Pictures], shots: Sequence[tuple[float, float]]) -> dict[str, dict[float, int]]:
    """For each camera the stamps to look at, one in the middle of each shot (begin, end), and the shot's number."""
    chosen: dict[str, dict[float, int]] = {}
    for name, found in pictures.items():
        stamps = np.array(sorted(found.stamps))
        chosen[name] = {}
        for number, (begin, end) in enumerate(shots):
            inside = stamps[(stamps >= begin) & (stamps <= end)]
            if len(inside):
                chosen[name][float(inside[len(inside) // 2])] = number
    return chosen


def read_pictures(bag: Path, pictures: dict[str, Pictures], chosen: Mapping[str, Mapping[float, int]]) -> None:
    """Read the chosen colour pictures and the depth that goes with them."""

    def wanted(topic: str, _kind: str) -> bool:
        place = _camera(topic)
        return place is not None and place[0] in chosen and place[2] == "image_raw"

    for topic, _, message in bag_messages.messages(bag, wanted):
        place = _camera(topic)
        assert place is not None
        name, image, _part = place
        near = min(chosen[name], key=lambda t: abs(t - _stamp(message)), default=None)
        if near is None:
            continue
        if image == "color" and near == _stamp(message):
            pictures[name].color[near] = conversions.color_from_msg(shown(message))
        elif image != "color" and abs(near - _stamp(message)) <= TOGETHER:
            pictures[name].depth.setdefault(near, conversions.depth_from_msg(shown(message)))


def views_of(board: Board, pictures: Mapping[str, Pictures], chosen: Mapping[str, Mapping[float, int]], hands: Sequence[Any]) -> list[View]:
    """The board in the chosen pictures; hands: world_from_hand (4, 4) of each shot, or None."""
    views = []
    for name, numbers in chosen.items():
        for stamp, number in numbers.items():
            ids, pixels = board.detected(pictures[name].color[stamp])
            if len(ids):
                views.append(View(name, number, ids, pixels, _depth_at(pictures[name].depth.get(stamp), pixels), hands[number]))
    return views


def _depth_at(depth: NDArray[np.float32] | None, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (N,) metres at pixels (N, 2), the median of 3 x 3; NaN where there is none."""
    if depth is None:
        return np.full(len(pixels), np.nan)
    found = []
    for u, v in np.round(pixels).astype(int):
        patch = depth[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        known = patch[np.isfinite(patch)]
        found.append(float(np.median(known)) if len(known) else np.nan)
    return np.array(found)


def on_table(x: float, y: float, z: float, yaw: float) -> NDArray[np.float64]:
    """world_from_board (4, 4) of a board that lies face up: its printed picture's upper left corner at x, y, z (metres), the upper edge
    along ``yaw`` (degrees about the world's z)."""
    return transforms.from_rpy(np.pi, 0.0, np.radians(yaw), (x, y, z))


def robot_of(path: Path | None) -> Description:
    """The arm of a parameters file (its ``robot.*``), or the Panda."""
    values: dict[str, Any] = {}
    if path is not None:
        try:
            content = yaml.safe_load(path.read_text())
            for part in content.values():
                values.update(part.get("ros__parameters", {}).get("robot", {}))
        except (OSError, yaml.YAMLError, AttributeError, UnicodeDecodeError) as error:
            raise MagicError(Code.BAD_REQUEST, f"robot parameters {path}", str(error), "a file as robot.param.yaml") from error
    fields = RobotConfig.__dataclass_fields__
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k in fields and v != ""}
    return Description(RobotConfig(**values))


def lines_of(found: Calibration) -> list[str]:
    """The result in lines for a terminal."""
    lines = [f"{'camera':<10} {'x, y, z in m':<26} {'rms px':>7} {'worst':>6} {'views':>6} {'corners':>8} {'off mm':>7} {'by depth':>9}"]
    for name, c in found.cameras.items():
        place = ", ".join(f"{v:.4f}" for v in c.world_from_camera[:3, 3])
        scale = f"{100 * (c.scale - 1):+.1f} %" if np.isfinite(c.scale) else "no depth"
        lines.append(f"{name:<10} {place:<26} {c.rms:7.2f} {c.largest:6.2f} {c.views:6d} {c.corners:8d} {1000 * c.off:7.1f} {scale:>9}")
    lines.append("off: two standard deviations of the worst point of the workspace; by depth: the board's distance, over that by its size")
    return lines


def parameters_of(found: Calibration) -> str:
    """A parameters file with the poses, for perception."""
    poses = {
        name: [round(float(v), 6) for v in (*c.world_from_camera[:3, 3], *transforms.quaternion_xyzw(c.world_from_camera))]
        for name, c in found.cameras.items()
    }
    rows = "".join(f"        {name}: {numbers}\n" for name, numbers in poses.items())
    return (
        "# x y z qx qy qz qw of each colour optical frame in the robot's base frame, by calibrate_cameras.\n"
        f"/**/perception:\n  ros__parameters:\n    cameras: [{', '.join(poses)}]\n    extrinsics:\n{rows}"
    )


def calibrate(options: argparse.Namespace) -> Calibration:
    """The command's work: read, choose, detect, draw, solve, write; raises MagicError."""
    board = board_of(options)
    pictures, joints = read_stamps(options.bag, options.cameras)
    hands: list[NDArray[np.float64] | None]
    if options.on_hand:
        robot = robot_of(options.robot_params)
        link = options.link or robot.config.move_group
        if link not in robot.links:
            raise MagicError(Code.BAD_REQUEST, "--link", link, robot.links)
        still = rests(joints, robot.names)
        shots = [(begin, end) for begin, end, _ in still]
        hands = [robot.poses(dict(zip(robot.names, q.tolist())))[link] for _, _, q in still]
    else:
        # The board rests: one picture tells all that others would.
        shots, hands = [(-np.inf, np.inf)], [None]
    chosen = choose(pictures, shots)
    read_pictures(options.bag, pictures, chosen)
    views = views_of(board, pictures, chosen, hands)
    lenses = {name: p.lens for name, p in pictures.items() if p.lens is not None}
    options.out.mkdir(parents=True, exist_ok=True)
    for view in views:  # what was found is shown also where it is then refused
        _save(options.out, pictures, chosen, view, np.zeros_like(view.pixels))
    world_from_board = None if options.on_hand else on_table(*options.board_at)
    found = calibration.calibrate(board, lenses, views, world_from_board, 1e-3 * options.allowed)
    for view in views:
        residuals = found.cameras[view.camera].residuals.get(view.shot)
        if residuals is not None:
            _save(options.out, pictures, chosen, view, residuals)
    (options.out / "cameras.param.yaml").write_text(parameters_of(found))
    return found


def _save(out: Path, pictures: Mapping[str, Pictures], chosen: Mapping[str, Mapping[float, int]], view: View, residuals: Any) -> None:
    stamp = next(t for t, number in chosen[view.camera].items() if number == view.shot)
    image = calibration.drawn(pictures[view.camera].color[stamp], view, residuals)
    cv2.imwrite(str(out / f"{view.camera}_{view.shot:02d}.png"), image[:, :, ::-1])


def board_of(options: argparse.Namespace) -> Board:
    """The board that the command line describes; raises BAD_REQUEST."""
    columns, _, rows = options.squares.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise MagicError(Code.BAD_REQUEST, "--squares", options.squares, "COLUMNSxROWS, for example 7x5")
    return Board(int(columns), int(rows), 1e-3 * options.square, 1e-3 * options.marker, options.dictionary, options.legacy)


def draw(board: Board, path: Path, dpi: int = 300) -> str:
    """Write a board as a picture that prints at its true size; returns what to do with it."""
    from PIL import Image

    per_square = round(board.square / 0.0254 * dpi)
    Image.fromarray(board.drawn(per_square, dpi // 4)).save(path, dpi=(dpi, dpi))
    width, height = (1000 * n * per_square / dpi * 0.0254 for n in (board.columns, board.rows))
    return f"{path}: print at 100 % (the squares together {width:.1f} x {height:.1f} mm), glue it on something flat, measure a square and give it by --square"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(prog="calibrate_cameras", description="Where cameras stand, from a bag with a ChArUco board.")
    what = result.add_mutually_exclusive_group(required=True)
    what.add_argument("--bag", type=Path, help="folder of the bag")
    what.add_argument("--draw", type=Path, metavar="FILE.png", help="write the board as a picture to print, and nothing else")
    place = result.add_mutually_exclusive_group()
    place.add_argument(
        "--board-at", nargs=4, type=float, metavar=("X", "Y", "Z", "YAW"),
        help="the board lies face up: place of the printed picture's upper left corner in the robot's base frame, m, and direction of its upper edge, degrees",
    )  # fmt: skip
    place.add_argument("--on-hand", action="store_true", help="the board is fixed to the hand; where on it is found, too")
    result.add_argument(
        "--out", type=Path, default=Path("out/calibration"), help="folder for cameras.param.yaml and the pictures (default out/calibration)"
    )
    result.add_argument(
        "--cameras", nargs="+", default=[], metavar="NAME", help="cameras, by the name in their topics (default: all in the bag)"
    )
    result.add_argument("--squares", default="7x5", help="of the board, columns x rows (default 7x5)")
    result.add_argument("--square", type=float, default=40.0, help="edge of a square, mm, as measured on the print (default 40)")
    result.add_argument("--marker", type=float, default=30.0, help="edge of a marker, mm (default 30)")
    result.add_argument("--dictionary", default="5X5_100", help=f"of the markers (default 5X5_100): {', '.join(calibration.DICTIONARIES)}")
    result.add_argument("--legacy", action="store_true", help="the board was drawn by OpenCV before 4.6")
    result.add_argument("--robot-params", type=Path, metavar="FILE", help="parameters file of the arm, for --on-hand (default: the Panda)")
    result.add_argument("--link", default="", help="link that the board is fixed to (default: robot.move_group)")
    result.add_argument(
        "--allowed", type=float, default=1000 * calibration.ALLOWED, help="mm that a point of the workspace may be off (default 5)"
    )
    return result


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    command = parser()
    options = command.parse_args(arguments)
    if options.bag is not None and not options.on_hand and options.board_at is None:
        command.error("--bag needs --board-at X Y Z YAW or --on-hand")
    try:
        if options.draw is not None:
            print(draw(board_of(options), options.draw))
            return 0
        found = calibrate(options)
    except (MagicError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    print("\n".join(lines_of(found)))
    print(f"wrote {options.out / 'cameras.param.yaml'} and pictures with the residuals magnified 20 times")
    return 0


if __name__ == "__main__":
    sys.exit(main())
