"""Film strips of a simulated run, ray-cast: no renderer, no GPU, no display."""

from __future__ import annotations

import textwrap

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.mesh import Mesh, box_corners, concatenate
from magic_core.rendering import Raycaster, shade
from magic_core.robot import Description
from magic_core.robot_pictures import RobotPictures
from magic_core.scene import SceneObject
from magic_verifier.articulation import panda
from magic_verifier.floating import TARGET, TOOL
from magic_verifier.rollout import Recording

TOOL_COLOR = (222, 150, 62)
TARGET_COLOR = (72, 126, 196)
OBSTACLE_COLOR = (150, 152, 158)
TABLE_COLORS = ((226, 222, 214), (214, 209, 199))
BACKGROUND = (244, 245, 247)
LIGHT = np.array([-0.35, -0.45, 1.0])
#: Frames are cast at this multiple of their size and scaled down.
OVERSAMPLING = 1.25
#: Pixels for a letter of the caption, on the average of English sentences.
LETTER = 7.5
#: The table's squares, m.
SQUARE = 0.1


def _painted(item: SceneObject, color: tuple[int, int, int], world_from_object: NDArray[np.float64]) -> Mesh:
    mesh = item.mesh if len(item.mesh.faces) else concatenate(list(item.pieces))
    if mesh.colors is None or len(mesh.colors) != len(mesh.vertices):
        mesh = Mesh(mesh.vertices, mesh.faces).painted(color)
    return mesh.transformed(world_from_object)


def _table(plane: NDArray[np.float64], centre: NDArray[np.float64], size: float = 4.0) -> Mesh:
    """A chequered piece of the table plane around a world point; squares of :data:`SQUARE` metres, aligned with the world."""
    count = int(size / SQUARE)
    low = np.floor(centre[:2] / SQUARE) * SQUARE - count // 2 * SQUARE
    vertices, faces, colors = [], [], []
    a, b, c, d = plane
    for i in range(count):
        for j in range(count):
            x, y = low + SQUARE * np.array([i, j])
            corners = np.array([[x, y], [x + SQUARE, y], [x + SQUARE, y + SQUARE], [x, y + SQUARE]])
            k = len(vertices)
            vertices += [[*p, -(a * p[0] + b * p[1] + d) / c] for p in corners]
            faces += [[k, k + 1, k + 2], [k, k + 2, k + 3]]
            colors += [TABLE_COLORS[(round(x / SQUARE) + round(y / SQUARE)) % 2]] * 4
    return Mesh(np.array(vertices), np.array(faces), np.array(colors, dtype=np.uint8))


def _joint_places(robot: Description, joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the moving links of an arm have their origins, (N, 3) in the world."""
    poses = robot.poses(robot.arm_positions(joints))
    return np.array([poses[joint.child][:3, 3] for joint in (*robot.arm, *robot.fingers)])


def frame_times(recording: Recording, count: int) -> NDArray[np.int64]:
    """Indices of ``count`` recorded moments, spread evenly over a mean of time passed and way travelled."""
    n = len(recording.times)
    if n <= count:
        return np.arange(n)
    way = np.zeros(n - 1)
    for poses in recording.poses.values():
        way += np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    progress = np.diff(recording.times) / max(recording.times[-1] - recording.times[0], 1e-9) + way / max(way.sum(), 1e-9)
    cumulative = np.concatenate([[0.0], np.cumsum(progress)])
    return np.unique(np.searchsorted(cumulative, np.linspace(0, cumulative[-1], count)).clip(0, n - 1))


def _camera(points: NDArray[np.float64], size: tuple[int, int], direction: NDArray[np.float64]) -> tuple[Intrinsics, NDArray[np.float64]]:
    """A camera that looks along ``direction`` and sees all points (N, 3)."""
    width, height = size
    z = transforms.unit(direction)
    y = transforms.unit(-(np.array([0, 0, 1.0]) - z[2] * z))
    rotation = np.column_stack([np.cross(y, z), y, z])
    focal = 1.6 * height
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    local = (points - centre) @ rotation
    # Stand back until the widest point is within 0.9 of the picture.
    back = np.maximum(np.abs(local[:, 0]) * focal / (0.45 * width), np.abs(local[:, 1]) * focal / (0.39 * height)) - local[:, 2]
    distance = max(float(back.max()), 0.15)
    intrinsics = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    return intrinsics, transforms.make(rotation, centre - distance * z)


def _picture(meshes: list[Mesh], intrinsics: Intrinsics, world_from_camera: NDArray[np.float64]) -> NDArray[np.uint8]:
    caster = Raycaster(meshes)
    cast, depth = caster.perspective(intrinsics, world_from_camera)
    image = shade(cast, light=LIGHT, ambient=0.5, background=BACKGROUND).astype(np.float32)
    # Shadows: a second ray from each surface point towards the light.
    seen = cast.ids >= 0
    points = transforms.apply(world_from_camera, intrinsics.unproject(depth)[seen])
    if len(points):
        shadow = caster.occluded(points + 1e-3 * cast.normals[seen], transforms.unit(LIGHT))
        image[seen] *= np.where(shadow, 0.68, 1.0).astype(np.float32)[:, None]
    # The table fades into the background with distance.
    table = cast.ids == 0
    if table.any():
        middle = float(np.median(depth[seen]))
        far = np.clip((depth[table] - middle) / (2.5 * max(middle, 1e-3)), 0, 1)[:, None]
        image[table] += far * (np.array(BACKGROUND, dtype=np.float32) - image[table])
    return np.clip(image, 0, 255).astype(np.uint8)


def film_strip(
    recording: Recording,
    tool: SceneObject,
    target: SceneObject,
    obstacles: tuple[SceneObject, ...] | list[SceneObject],
    table: NDArray[np.float64],
    frames: int = 8,
    columns: int = 4,
    size: tuple[int, int] = (360, 270),
    direction: tuple[float, float, float] = (0.62, 0.62, -0.55),
    caption: str = "",
    robot: Description | None = None,
) -> NDArray[np.uint8]:
    """Frames of a run side by side in rows, (H, W, 3) uint8 RGB, each with its time and phase.

    size (width, height) of one frame; the camera stands still and sees the whole way of tool and target.
    ``caption`` is written below the last row.  ``robot``: the arm, where the run has one; ``None`` for the Panda.
    """
    chosen = frame_times(recording, frames)
    items = {TOOL: (tool, TOOL_COLOR), TARGET: (target, TARGET_COLOR)}
    way = []
    for name, (item, _) in items.items():
        corners = np.concatenate([p.vertices for p in item.pieces]) if item.pieces else item.mesh.vertices
        box = box_corners(corners.min(axis=0), corners.max(axis=0))
        way += [transforms.apply(pose, box) for pose in recording.poses[name][chosen]]
    with_arm = recording.joints.shape[1] > 0
    if with_arm:
        robot = robot or panda()
        looks = RobotPictures(robot)
        way += [_joint_places(robot, recording.joints[index]) for index in chosen]
    # What fell off and flew away would make everything else tiny.
    points = np.concatenate(way)
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < 1.5]
    big = (round(size[0] * OVERSAMPLING), round(size[1] * OVERSAMPLING))
    intrinsics, world_from_camera = _camera(points, big, np.array(direction))
    still = [_table(table, points.mean(axis=0))] + [_painted(o, OBSTACLE_COLOR, o.world_from_object) for o in obstacles]
    pictures = []
    for index in chosen:
        meshes = still + [_painted(item, color, recording.poses[name][index]) for name, (item, color) in items.items()]
        if with_arm:
            meshes += looks.at(recording.joints[index])
        picture = cv2.resize(_picture(meshes, intrinsics, world_from_camera), size, interpolation=cv2.INTER_AREA)
        path = transforms.apply(transforms.inverse(world_from_camera), recording.poses[TARGET][: index + 1, :3, 3])
        pixels = intrinsics.project(path) / OVERSAMPLING
        pixels = pixels[np.all(np.isfinite(pixels), axis=1)].round().astype(np.int32)
        if len(pixels) > 1:
            cv2.polylines(picture, [pixels[:, None]], False, (200, 60, 50), 1, cv2.LINE_AA)
        pictures.append(_captioned(picture, f"{recording.times[index]:.2f} s", recording.phases[index]))
    while len(pictures) % columns and len(pictures) > columns:
        pictures.append(np.full_like(pictures[0], 255))
    rows = [np.concatenate(pictures[i : i + columns], axis=1) for i in range(0, len(pictures), columns)]
    strip = np.concatenate(rows, axis=0)
    if caption:
        lines = textwrap.wrap(caption, max(1, int((strip.shape[1] - 16) / LETTER)))
        bar = np.full((8 + 18 * len(lines), strip.shape[1], 3), 255, np.uint8)
        for k, line in enumerate(lines):
            cv2.putText(bar, line, (8, 18 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (40, 40, 45), 1, cv2.LINE_AA)
        strip = np.concatenate([strip, bar], axis=0)
    return np.ascontiguousarray(strip)


def _captioned(picture: NDArray[np.uint8], time: str, phase: str) -> NDArray[np.uint8]:
    width = picture.shape[1]
    picture = cv2.rectangle(picture, (0, 0), (width, 20), (255, 255, 255), -1)
    cv2.putText(picture, time, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 35), 1, cv2.LINE_AA)
    (text_width, _), _ = cv2.getTextSize(phase, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    cv2.putText(picture, phase, (width - text_width - 6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (120, 60, 30), 1, cv2.LINE_AA)
    return cv2.copyMakeBorder(picture, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=(255, 255, 255))
