"""Frames in, scene out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import Scene, SceneObject
from magic_core.views import find_view
from magic_perception import clusters
from magic_perception.parameters import Parameters
from magic_perception.reconstruction import Reconstruction, Sight, reconstruct
from magic_perception.segmentation import DepthSegmenter, Looked, Segmenter, _frame_on, each, find_table, look


@dataclass
class Report:
    """What perceive() can tell besides the scene: seconds by stage, and what it left out and why."""

    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    labels: list[NDArray[np.int32]] = field(default_factory=list)
    shapes: dict[str, str] = field(default_factory=dict)
    pixels: dict[str, int] = field(default_factory=dict)


def perceive(
    frames: list[RgbdFrame],
    known: tuple[SceneObject, ...] = (),
    parameters: Parameters = Parameters(),
    segmenter: Segmenter | None = None,
    report: Report | None = None,
) -> Scene:
    """What stands and lies on the table.

    frames: one for each camera, taken at nearly the same time, with poses in one world whose z is up.  known: fixtures,
    taken over into the scene; what belongs to them is left out of the segmentation.  Objects are numbered by size
    (``object_1``, ...); :class:`magic_perception.tracking.Tracker` makes the numbers stable from call to call.

    Raises ``NO_FRAMES`` without frames, ``NO_DEPTH`` where no frame has depth in the region of interest, ``NO_TABLE``.
    An empty table is a scene without objects.
    """
    report = report if report is not None else Report()
    segmenter = segmenter or DepthSegmenter()
    if not frames:
        raise MagicError(Code.NO_FRAMES, "frames", 0, "at least one RGB-D frame")
    seeing = []
    for frame in frames:
        if np.isfinite(frame.depth).sum() < 100:
            report.notes.append(f"{frame.camera}: no depth")
        else:
            seeing.append(frame)
    if not seeing:
        raise MagicError(
            Code.NO_DEPTH, "pixels with depth", {f.camera: int(np.isfinite(f.depth).sum()) for f in frames}, "at least 100 in one camera"
        )
    frames = seeing
    start = time.perf_counter()
    table, own = find_table(frames, parameters)
    world_from_table = _frame_on(table, np.eye(4))
    if (
        parameters.snap_height > 0
        and table.tilt() < parameters.snap_tilt
        and abs(table.heights(np.zeros(3))) < parameters.snap_height + 0.0
    ):
        world_from_table = np.eye(4)
    looks = each(lambda pair: look(*pair, world_from_table, parameters), list(zip(frames, own, strict=True)), parameters.workers)
    report.seconds["table"] = time.perf_counter() - start

    start = time.perf_counter()
    fixtures = tuple(item.mesh.transformed(item.world_from_object) for item in known if len(item.mesh.faces))
    labels = segmenter.segment(looks, fixtures, parameters)
    report.labels = labels
    report.seconds["segment"] = time.perf_counter() - start

    start = time.perf_counter()

    def build(label: int) -> tuple[SceneObject, str, int] | MagicError:
        try:
            return _build(label, looks, labels, world_from_table, parameters)
        except MagicError as error:
            return error

    objects = []
    found = range(1, max((int(image.max()) for image in labels), default=0) + 1)
    for label, built in zip(found, each(build, list(found), parameters.workers), strict=True):
        if isinstance(built, MagicError):
            report.notes.append(f"cluster {label} left out: {built.message}")
            for image in labels:
                image[image == label] = 0
            continue
        item = replace(built[0], id=f"object_{len(objects) + 1}")
        report.shapes[item.id], report.pixels[item.id] = built[1:]
        objects.append(item)
    report.seconds["objects"] = time.perf_counter() - start
    plane = np.append(world_from_table[:3, 2], -world_from_table[:3, 2] @ world_from_table[:3, 3])
    stamp = max(frame.stamp for frame in frames)
    return Scene((*objects, *known), plane, stamp)


def _build(
    label: int,
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    world_from_table: NDArray[np.float64],
    parameters: Parameters,
) -> tuple[SceneObject, str, int]:
    """The object with that label, how its shape was found, and its pixels in the camera that saw most of it."""
    table_from_world = transforms.inverse(world_from_table)
    sights, clouds, paints, counts = [], [], [], []
    for looked, image in zip(looks, labels, strict=True):
        mask = image == label
        counts.append(int(np.count_nonzero(mask)))
        if counts[-1] < 20:
            continue
        x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
        cut = (slice(y, y + h), slice(x, x + w))
        sigma = float(np.median(looked.sigma[cut][mask[cut]][::7]))
        hidden = (image != 0) & ~mask
        sights.append(
            Sight(
                looked.frame.intrinsics,
                table_from_world @ looked.frame.world_from_camera,
                mask,
                hidden,
                looked.frame.depth,
                looked.heights,
                sigma,
            )
        )
        seen = mask[cut] & np.isfinite(looked.heights[cut])
        clouds.append(looked.points[cut][seen])
        paints.append(looked.frame.color[cut][seen])
    if not sights:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "pixels of the object", max(counts), "at least 20 in one camera")
    points, colors = np.concatenate(clouds).astype(float), np.concatenate(paints)
    keep = clusters.largest(points, parameters.cluster_eps, parameters.cluster_points, 0.006)
    points, colors = points[keep], colors[keep]
    built = reconstruct(sights, parameters)
    best = int(np.argmax(counts))
    item = _as_object(f"cluster_{label}", built, points, colors, world_from_table)
    cut = _cut_by_border(labels[best] == label)
    item = replace(item, mask=labels[best] == label, camera=looks[best].frame.camera, confidence=built.confidence * (0.6 if cut else 1.0))
    return item, built.shape, counts[best]


def _cut_by_border(mask: NDArray[np.bool_]) -> bool:
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def _as_object(
    name: str, built: Reconstruction, points: NDArray[np.float64], colors: NDArray[np.uint8], world_from_table: NDArray[np.float64]
) -> SceneObject:
    """Object frame at the centre of the smallest upright box, z up, x along its longer horizontal side (towards +x, else +y, of the world)."""
    mesh = built.mesh
    low, high = mesh.bounds
    (cx, cy), (w, h), angle = cv2.minAreaRect(((mesh.vertices[:, :2] - low[:2]) * 1000).astype(np.float32))
    if abs(w - h) < 0.04 * max(w, h) and built.shape in ("sphere", "cylinder", "round"):
        angle = 0.0  # round: no direction is longer, keep the world's
        w = h
    elif h > w:
        w, h, angle = h, w, angle + 90
    yaw = np.radians(angle)
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    table_from_object = transforms.from_rpy(0, 0, yaw, [cx / 1000 + low[0], cy / 1000 + low[1], (low[2] + high[2]) / 2])
    object_from_table = transforms.inverse(table_from_object)
    local = mesh.transformed(object_from_table)
    pose = world_from_table @ table_from_object
    local = Mesh(local.vertices, local.faces, _paint(local, points, colors, transforms.inverse(pose)))
    pieces = tuple(piece.transformed(object_from_table) for piece in built.pieces)
    start = find_view(local, pieces)
    return SceneObject(
        name, local, pieces, pose, start, points, colors, world_from_box=pose, box_extents=local.extents, confidence=built.confidence
    )


def _paint(mesh: Mesh, points: NDArray[np.float64], colors: NDArray[np.uint8], object_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (V, 3) of a mesh's vertices from the nearest seen point."""
    from scipy.spatial import cKDTree

    step = max(1, len(points) // 6000)
    tree = cKDTree(transforms.apply(object_from_world, points[::step]))
    return colors[::step][tree.query(mesh.vertices, workers=2)[1]]
