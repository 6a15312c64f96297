"""What is said of cameras that are right, of one that is off the other, and of both that are off the arm: ``evaluate --moved-cameras N``.

Each of N procedural scenes (one thing, two to six apart, or a pile) is seen by two D435, mostly with smear, on wood, cloth or stripes, with
cast shadows or more noise; half of the pairs stand at the station, the others anywhere.  It is perceived as it is, and with the
second camera said to stand where it does not: off along the table, or turned about itself.  In each of N others, with an arm over the table
in an attitude drawn about two, both cameras are said to stand elsewhere, by the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import shapes, transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster, shade
from magic_core.robot import Description
from magic_core.robot_pictures import RobotPictures
from magic_core.sensor import AMBIENT, BACKGROUND, D435, LIGHT, SMEARED, STATION, capture, expose, looking_at, scene_raycaster, wood
from magic_perception.arm_seen import ArmInPicture
from magic_perception.averaging import average
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.piles import pile
from magic_perception.pipeline import Report, perceive

REGION = Parameters(**WORKSPACE)
#: By how much the second camera is off: along the table, m, any way; and turned about any axis through it, rad.
SHIFTS = (0.003, 0.006, 0.009, 0.018, 0.025, 0.040)
TURNS = tuple(np.radians((1.0, 2.0, 3.0)).tolist())
#: Frames that are averaged, as perception does with those of a camera at rest.
AVERAGED = 3
#: How near the middle of the table things stand (m, each way), how far apart, and how near the border of a picture they may come, pixels.
REACH, APART, BORDER = (0.14, 0.18), 0.006, 4
#: Families that stand or lie freely on a table; the more frequent ones say little of where a camera stands.
FAMILIES = ("mug", "mug", "spoon", "sphere", "cylinder", "l_hook", "j_hook", "caliper", "hammer", "hanger", "ladle", "scissors", "watch")
#: Attitudes of the arm (joints, then fingers: rad, m) about which it is drawn, and by how much, rad: over the table, and at home.
ATTITUDES = (
    (0.0, 0.35, 0.0, -2.1, 0.0, 2.45, np.pi / 4, 0.04, 0.04),
    (0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4, 0.04, 0.04),
)
TURNED = 0.15
#: The light that casts a shadow, where one does.
LAMP = transforms.unit(np.array([0.5, -0.4, 0.8]))


@dataclass(frozen=True)
class Surroundings:
    """What differs between scenes besides the things: a cloth of squares or stripes on the wooden table, a cast shadow, depth noise of 3 mm
    at 0.5 m besides the sensor's."""

    cloth: bool = False
    stripes: bool = False
    shadow: bool = False
    noisy: bool = False


SURROUNDINGS = (
    Surroundings(),
    Surroundings(),
    Surroundings(noisy=True),
    Surroundings(cloth=True),
    Surroundings(shadow=True),
    Surroundings(shadow=True, stripes=True),
    Surroundings(cloth=True, shadow=True, noisy=True),
)


def measure(
    count: int,
    seed: int,
    shifts: Sequence[float] = SHIFTS,
    turns: Sequence[float] = TURNS,
    said: Callable[[str], None] = lambda _: None,
) -> dict:
    """Over ``count`` scenes: by how much the second camera is off, how often it is said, refused or noted, and how well measured."""
    rows: dict[str, list[dict]] = {}
    for number in range(count):
        random = np.random.default_rng([seed, number, 40])
        poses = _cameras(random)
        frames = _frames(_things(random, seed * 1000 + number, poses), poses, random)
        for name, moved in _moved(random, poses["right"], shifts, turns):
            rows.setdefault(name, []).append(_told(frames, moved))
        said(f"moved cameras: scene {number + 1} of {count}")
    found = {"scenes": count, "seed": seed, "rows": {name: _sum(told) for name, told in rows.items()}}
    return {**found, "arm": _arms(count, seed, (0.0, *shifts))}


def _arms(count: int, seed: int, shifts: Sequence[float]) -> dict[str, dict]:
    """Of ``count`` scenes with an arm, two pictures each: by how far both cameras are off it, m, how well that is measured."""
    robot = Description()
    pictures, arm = RobotPictures(robot), ArmInPicture(robot)
    rows: dict[str, list[tuple[float, float] | None]] = {f"{1000 * shift:.0f}": [] for shift in shifts}
    for number in range(count):
        random = np.random.default_rng([seed, number, 41])
        joints = np.array(ATTITUDES[number % len(ATTITUDES)])
        joints[:7] += random.normal(0, TURNED, 7)
        caster = scene_raycaster([*_things(random, seed * 1000 + number, STATION), *pictures.at(joints)])
        for index, (name, pose) in enumerate(STATION.items()):
            frame = capture([], D435, pose, [seed, number, index], camera=name, raycaster=caster, model=SMEARED)
            for shift in shifts:
                way = shift * transforms.unit(random.normal(size=3))
                said = replace(frame, world_from_camera=transforms.make(translation=way) @ pose)
                seen = arm.measure(said, robot.arm_positions(joints))
                found = None if seen is None else (float(np.linalg.norm(seen.offset + way)), seen.error)
                rows[f"{1000 * shift:.0f}"].append(found)
    return {shift: _arm_sum(found) for shift, found in rows.items()}


def _arm_sum(rows: list[tuple[float, float] | None]) -> dict:
    told = np.array([row for row in rows if row is not None]).reshape(-1, 2)
    return {
        "pictures": len(rows),
        "measured": len(told),
        "error_mm": [round(1000 * float(value), 1) for value in np.percentile(told[:, 0], (50, 95, 100))] if len(told) else None,
        "beyond": int(np.count_nonzero(told[:, 0] > 2 * told[:, 1])),
    }


def _told(frames: list[RgbdFrame], second: NDArray[np.float64]) -> dict:
    """What perception says where the second camera is said to stand at ``second`` (4, 4); error: of the measured offset, m."""
    first, true = frames
    report = Report()
    refused = False
    try:
        perceive([first, replace(true, world_from_camera=second)], (), REGION, None, report)
    except MagicError as error:
        if error.code is not Code.CAMERAS_DISAGREE:
            raise
        refused = True
    told = {"refused": refused, "said": False, "noted": any("may disagree" in note for note in report.notes), "error": None}
    if report.cameras:
        pair = report.cameras[0]
        seen = second @ transforms.inverse(true.world_from_camera)
        off = float(np.linalg.norm(transforms.apply(seen, pair.centre[None])[0] - pair.centre))
        told |= {"said": bool(pair.certain), "error": abs(pair.offset - off)}
    return told


def _sum(rows: list[dict]) -> dict:
    """Counts of the rows of one way to be off."""
    errors = [1000 * row["error"] for row in rows if row["error"] is not None]
    return {
        "pairs": len(rows),
        "measured": len(errors),
        **{key: sum(row[key] for row in rows) for key in ("said", "refused", "noted")},
        "error_mm": [round(float(value), 2) for value in np.percentile(errors, (50, 95))] if errors else None,
    }


def _moved(
    random: np.random.Generator, pose: NDArray[np.float64], shifts: Sequence[float], turns: Sequence[float]
) -> list[tuple[str, NDArray[np.float64]]]:
    """Where the second camera is said to be: first where it is."""
    found = [("right", pose)]
    for shift in shifts:
        way = random.uniform(-np.pi, np.pi)
        found.append((f"{1000 * shift:.0f} mm", transforms.make(translation=[shift * np.cos(way), shift * np.sin(way), 0]) @ pose))
    for turn in turns:
        axis = transforms.unit(random.normal(size=3))
        found.append((f"turned by {np.degrees(turn):.0f}°", pose @ transforms.from_rotvec(turn * axis)))
    return found


# ---------------------------------------------------------------- scenes


def _cameras(random: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """The station's two cameras, or two anywhere about the table's middle."""
    if random.random() < 0.5:
        return dict(STATION)
    way, across, middle = random.uniform(-np.pi, np.pi), random.uniform(0.6, 2.2), np.array([0.5, 0.0, 0.04])
    poses = {}
    for i, name in enumerate(STATION):
        rise, distance, turn = np.radians(random.uniform(30, 60)), random.uniform(0.6, 0.95), way + i * across
        eye = middle + distance * np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        poses[name] = looking_at(eye, middle)
    return poses


def _things(random: np.random.Generator, seed: int, poses: dict[str, NDArray[np.float64]]) -> list[Mesh]:
    """One thing, two to six apart, or a pile."""
    kind = random.random()
    if kind > 0.8:
        return pile(seed, 0.2).meshes
    meshes: list[Mesh] = []
    wanted = 1 if kind < 0.3 else int(random.integers(2, 7))
    for number in range(1000 * wanted):  # a place that does not do is drawn again
        if len(meshes) == wanted:
            break
        mesh = shapes.make(str(random.choice(FAMILIES)), (seed * 1000 + number) % 2**31).mesh
        mesh = mesh.transformed(transforms.from_rpy(0, 0, random.uniform(-np.pi, np.pi)))
        low, high = mesh.bounds
        place = np.array([0.5, 0.0]) + random.uniform(-1, 1, 2) * REACH
        mesh = mesh.transformed(transforms.make(translation=[*(place - (low + high)[:2] / 2), -low[2]]))
        if all(_in_sight(mesh, pose) for pose in poses.values()) and all(_apart(mesh, other) for other in meshes):
            meshes.append(mesh)
    return meshes


def _apart(a: Mesh, b: Mesh) -> bool:
    return bool(np.any(a.bounds[0, :2] > b.bounds[1, :2] + APART) or np.any(b.bounds[0, :2] > a.bounds[1, :2] + APART))


def _in_sight(mesh: Mesh, pose: NDArray[np.float64]) -> bool:
    pixels = D435.project(transforms.apply(transforms.inverse(pose), mesh.vertices))
    return bool(np.all(pixels >= BORDER) and np.all(pixels <= [D435.width - 1 - BORDER, D435.height - 1 - BORDER]))


def _frames(meshes: list[Mesh], poses: dict[str, NDArray[np.float64]], random: np.random.Generator) -> list[RgbdFrame]:
    """What the cameras see, averaged over some frames."""
    surroundings = SURROUNDINGS[random.integers(len(SURROUNDINGS))]
    model = SMEARED if random.random() < 0.75 else None
    caster, seed = scene_raycaster(meshes), int(random.integers(2**31))
    frames = []
    for number, (name, pose) in enumerate(poses.items()):
        image, depth, cosine = _lit(caster, pose, surroundings)
        shots = [expose(image, depth, cosine, D435, pose, [seed, number, i], model=model, camera=name) for i in range(AVERAGED)]
        frame = average(shots)
        if surroundings.noisy:
            error = random.normal(0, 1, frame.depth.shape) * 0.003 * (frame.depth / 0.5) ** 2
            frame = replace(frame, depth=(frame.depth + error).astype(np.float32))
        frames.append(frame)
    return frames


def _lit(
    caster: Raycaster, pose: NDArray[np.float64], surroundings: Surroundings
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """A lit image (H, W, 3), true depth (H, W) and the cosine (H, W) of the angle between ray and surface."""
    cast, depth = caster.perspective(D435, pose)
    rays = D435.unproject(np.ones((D435.height, D435.width)))
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ pose[:3, :3].T
    points = rays * np.where(np.isfinite(cast.distance), cast.distance, 0.0)[..., None] + pose[:3, 3]
    image = shade(cast, light=LIGHT, ambient=AMBIENT, background=BACKGROUND).astype(float)
    table = (cast.ids == 0)[..., None]
    image *= np.where(table[..., 0], wood(points), 1.0)[..., None]
    if surroundings.cloth:
        square = (np.floor(points[..., 0] / 0.03) + np.floor(points[..., 1] / 0.03)) % 2 > 0
        image = np.where(table & square[..., None], image * [0.55, 0.6, 1.05], image)
    if surroundings.stripes:
        image = np.where(table & (np.floor(points[..., 1] / 0.02) % 4 == 0)[..., None], image * [0.5, 0.35, 0.35], image)
    if surroundings.shadow:
        above = (points + 0.002 * cast.normals).reshape(-1, 3)
        dark = np.isfinite(np.asarray(caster.cast(above, np.tile(LAMP, (len(above), 1))).distance)).reshape(table.shape[:2])
        image *= (1 - 0.5 * cv2.GaussianBlur(dark.astype(np.float32), (0, 0), 3))[..., None]
    return image, depth, np.abs(np.einsum("hwi,hwi->hw", rays, cast.normals))


def markdown(result: dict) -> str:
    """The table."""
    lines = [
        f"Cameras that disagree: {result['scenes']} scenes, seed {result['seed']}.",
        "",
        "| second camera off | pairs measured | said | refused | noted | error of the measured offset, mm: median, 95 % |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, row in result["rows"].items():
        error = ", ".join(f"{value:.1f}" for value in row["error_mm"]) if row["error_mm"] else ""
        off = "not at all" if name == "right" else name
        lines.append(f"| {off} | {row['measured']} of {row['pairs']} | {row['said']} | {row['refused']} | {row['noted']} | {error} |")
    lines += [
        "",
        "| both cameras off the arm, mm | pictures that tell | error of the measured shift, mm: median, 95 %, most | more than two standard errors off |",
        "| --- | --- | --- | --- |",
    ]
    for shift, row in result["arm"].items():
        error = ", ".join(f"{value:.1f}" for value in row["error_mm"]) if row["error_mm"] else ""
        lines.append(f"| {shift} | {row['measured']} of {row['pictures']} | {error} | {row['beyond']} |")
    return "\n".join(lines) + "\n"
