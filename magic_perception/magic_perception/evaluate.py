"""How good perception is, in numbers: ``ros2 run magic_perception evaluate --data FOLDER --out DIR``.

Three parts, each left out, and said so, where its data are absent:

osd       Segmentation of the OSD scenes by the field's measures (:mod:`magic_perception.measures`).
captures  RealSense captures: how many objects, whether what is one thing stays one, and sizes beside those read from the images by hand.
meshes    Ray-cast captures of scanned and modelled objects by two D435s (:mod:`magic_core.sensor`): mask IoU, and for the
          paper's reconstruction and this one side by side the Chamfer distance, the volumetric IoU and the holes that are open.

views     (``--views N``, needs no data) Surfaces of N procedural scenes by the number of views, and what has moved between them.
cameras   (``--moved-cameras N``, needs no data) What is said of two cameras on N procedural scenes, right and off by known amounts.
mugs      (``--mugs N``, needs no data) Whether the handles of N made mugs are there and open, by whether a camera sees through them.
speed     (``--speed``, needs no data) Seconds by stage for two cameras over four objects, and memory over ``--frames`` scenes.

Writes evaluation.json, evaluation.md and evaluation.png (the meshes part's pictures).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import images, transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import MagicError
from magic_core.mesh import Mesh, load
from magic_core.rendering import Raycaster
from magic_core.scene import CanonicalView, SceneObject
from magic_core.views import find_view, holes_of
from magic_perception import coverage, made_mugs, measures, moved_cameras, speed
from magic_perception.looks import Looked, find_table, frame_on, look
from magic_perception.parameters import METHODS, Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.segmentation import Segmenter
from magic_perception.segmenters import make_segmenter
from magic_perception.shared_out import perceiving
from magic_perception.table import camera_over_table

#: Longest, middle and shortest side in mm, read from the images: silhouette edges carried to the tangent planes, highest
#: points above the table; the bottle's depth is that of YCB's model 006.
SIZES = {"red_mug": (123, 99, 82), "mustard": (191, 95, 58), "cylinder": (150, 68, 68)}

#: Pixels (row, column) of one object, here a mallet's handle and head, and of what it leans against.
TOGETHER = {"mallet": (((120, 451), (260, 437), (400, 437)), ((330, 385), (350, 488)))}

#: Folders of meshes that stand as they are stored; the others lie in their most probable stable pose.
STANDING = ("mugs", "mug_trees", "targets", "watches")
#: Holes of less than this (m^2) in the true view are not counted.
LEAST_HOLE = 6e-5
#: Side of a picture in a strip, pixels.
TILE = 150


def read_frame(color: Path, depth: Path, intrinsics: Intrinsics, name: str) -> RgbdFrame:
    """A frame of PNG files, depth in mm; the table in sight is z = 0."""
    metres = images.read_depth(depth, "mm")
    return RgbdFrame(images.read_color(color), metres, intrinsics, camera_over_table(intrinsics.unproject(metres)[::3, ::3]), name)


def overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks."""
    return float(np.count_nonzero(a & b) / max(np.count_nonzero(a | b), 1))


# ---------------------------------------------------------------- OSD


#: The whole of a picture, up to 2 m.
OSD_PARAMETERS = Parameters(region_low=(-2, -2, -0.05), region_high=(2, 2, 0.6))


def osd_scenes(folder: Path) -> Iterator[tuple[str, RgbdFrame, NDArray[np.int64]]]:
    """Name, frame and truth (H, W) of each labelled scene: 0 for none, else the number of the object.

    Labels 40, 41, ... are surfaces of one thing (a bowl's outside and inside): objects are told by their tens.
    """
    intrinsics = json.loads((folder / "intrinsics.json").read_text())
    for name in sorted(path.name.removesuffix("_label.png") for path in folder.glob("*_label.png")):
        k = intrinsics.get(name, intrinsics.get("all scenes"))
        frame = read_frame(
            folder / f"{name}_color.png",
            folder / f"{name}_depth_mm.png",
            Intrinsics(k["width"], k["height"], k["fx"], k["fy"], k["cx"], k["cy"]),
            name,
        )
        truth = cv2.imread(str(folder / f"{name}_label.png"), cv2.IMREAD_UNCHANGED).astype(int) // 10 * 10
        truth[truth < 20] = 0
        yield name, frame, truth


def looked_at(frame: RgbdFrame, parameters: Parameters) -> Looked:
    """A frame over the table that it sees."""
    table, own = find_table([frame], parameters)
    return look(frame, own[0], frame_on(table, np.eye(4)), parameters)


def osd(folder: Path, segmenter: Segmenter, split: bool = True, pictures: Path | None = None) -> dict[str, object]:
    """Best IoU of each labelled object, and the field's measures; ``with_depth``: the same at pixels with depth alone, since only those
    have labels."""
    scenes: dict[str, object] = {}
    everything: list[float] = []
    measured: list[measures.Measures] = []
    with_depth: list[measures.Measures] = []
    parameters = replace(OSD_PARAMETERS, split=split)
    for name, frame, truth in osd_scenes(folder):
        start = time.process_time()
        labels = segmenter.segment([looked_at(frame, parameters)], (), parameters)[0]
        seconds = time.process_time() - start
        scores = measures.best_ious(labels, truth)
        measured.append(measures.measure(labels, truth))
        with_depth.append(measures.measure(np.where(np.isfinite(frame.depth), labels, 0), truth))
        scenes[name] = {
            "objects": len(scores),
            "found": int(labels.max()),
            "best_iou": scores.round(3).tolist(),
            "measures": {key: round(value, 4) for key, value in asdict(measured[-1]).items()},
            "cpu_seconds": round(seconds, 3),
        }
        everything += scores.tolist()
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(pictures / f"{name}.png"), tinted(frame.color, labels)[..., ::-1])
    return {
        "mean_best_iou": round(float(np.mean(everything)), 4),
        "above_0.75": round(float(np.mean(np.array(everything) > 0.75)), 4),
        "objects": len(everything),
        "measures": {key: round(value, 4) for key, value in asdict(measures.mean(measured)).items()},
        "with_depth": {key: round(value, 4) for key, value in asdict(measures.mean(with_depth)).items()},
        "scenes": scenes,
    }


def tinted(color: NDArray[np.uint8], labels: NDArray[np.int32]) -> NDArray[np.uint8]:
    """The picture with each label in a colour of its own."""
    palette = np.random.default_rng(1).integers(60, 255, (64, 3))
    drawn = color.copy()
    for value in np.unique(labels[labels > 0]):
        drawn[labels == value] = (0.4 * drawn[labels == value] + 0.6 * palette[value % 64]).astype(np.uint8)
    return drawn


# ---------------------------------------------------------------- real captures


def captures(folder: Path, segmenter: Segmenter) -> dict[str, object]:
    """Objects and sizes of the captures in every folder but ``osd``; the region is cut at 1.3 m before the camera.

    Those whose name does not begin with ``cluttered`` show one object alone.
    """
    frames, alone = [], []
    for file in sorted(folder.glob("*/intrinsics.json")):
        if file.parent.name == "osd":
            continue
        for name, k in json.loads(file.read_text()).items():
            color = file.parent / f"{name}_color.png"
            if not color.is_file():
                continue
            height, width = cv2.imread(str(color)).shape[:2]
            intrinsics = Intrinsics(width, height, k["fx"], k["fy"], k["cx"], k["cy"])
            frames.append(read_frame(color, file.parent / f"{name}_depth_mm.png", intrinsics, name))
            if not name.startswith("cluttered"):
                alone.append(name)
    if (folder / "mallet").is_dir():
        k = json.loads((folder / "mallet/realsense_intrinsic.json").read_text())
        m = k["intrinsic_matrix"]
        frames.append(
            read_frame(
                folder / "mallet/rgb.png",
                folder / "mallet/depth.png",
                Intrinsics(k["width"], k["height"], m[0], m[4], m[6], m[7]),
                "mallet",
            )
        )
    result: dict[str, object] = {}
    for frame in frames:
        report = Report()
        start = time.process_time()
        scene = perceive(
            [frame], parameters=Parameters(region_low=(-1.3, -1.3, -0.05), region_high=(1.3, 1.3, 0.6)), segmenter=segmenter, report=report
        )
        seconds = time.process_time() - start
        sizes = [sorted((o.box_extents * 1000).round(1).tolist(), reverse=True) for o in scene.objects]
        row: dict[str, object] = {"objects": len(sizes), "cpu_seconds": round(seconds, 3), "sizes_mm": sizes[:4]}
        if frame.camera in SIZES and sizes:
            row["read_mm"] = SIZES[frame.camera]
            row["largest_error_mm"] = round(float(np.max(np.abs(np.array(sizes[0]) - np.sort(SIZES[frame.camera])[::-1]))), 1)
        if frame.camera in alone:
            row["one_object"] = len(sizes) == 1
        if frame.camera in TOGETHER:
            mine, others = ([int(report.labels[0][pixel]) for pixel in pixels] for pixels in TOGETHER[frame.camera])
            row["one_object"] = len(set(mine)) == 1 and mine[0] > 0 and mine[0] not in others
        result[frame.camera] = row
    return result


# ---------------------------------------------------------------- meshes


def placed(path: Path, yaw: float) -> Mesh:
    """A mesh file on the table at the middle of the cameras' view, turned by ``yaw``."""
    mesh = load(path)
    if path.parent.name not in STANDING:
        poses, chance = mesh.to_trimesh().convex_hull.compute_stable_poses()
        mesh = mesh.transformed(poses[int(np.argmax(chance))])
    middle = (mesh.bounds[0] + mesh.bounds[1]) / 2
    mesh = mesh.transformed(transforms.make(None, [-middle[0], -middle[1], -mesh.bounds[0, 2]]))
    return mesh.transformed(transforms.from_rpy(0, 0, yaw, [0.5, 0, 0]))


def chamfer(a: Mesh, b: Mesh, count: int = 6000) -> float:
    """Mean of the two mean distances in metres between points sampled on the surfaces."""
    import trimesh
    from scipy.spatial import cKDTree

    p, q = (trimesh.sample.sample_surface(m.to_trimesh(), count, seed=0)[0] for m in (a, b))
    return float(cKDTree(q).query(p)[0].mean() + cKDTree(p).query(q)[0].mean()) / 2


def shared_volume(a: Mesh, b: Mesh, count: int = 60000) -> float | None:
    """Volume of the intersection over that of the union, by points in the common box; ``None`` where a mesh is not watertight."""
    import open3d as o3d

    inside = []
    low, high = np.minimum(a.bounds[0], b.bounds[0]), np.maximum(a.bounds[1], b.bounds[1])
    points = np.random.default_rng(0).uniform(low, high, (count, 3)).astype(np.float32)
    for mesh in (a, b):
        solid = mesh.to_trimesh()
        solid.merge_vertices()
        if not solid.is_watertight:
            return None
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
        inside.append(scene.compute_occupancy(o3d.core.Tensor(points), nsamples=3).numpy() > 0.5)
    return overlap(*inside)


def open_holes(view: CanonicalView, found: Mesh) -> tuple[int, int]:
    """Holes of at least :data:`LEAST_HOLE` square metres in the true object's view, and how many of them are at least half open and
    enclosed in ``found``."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(holes_of(view.mask).astype(np.uint8), connectivity=4)
    shown = Raycaster([found]).orthographic(view.object_from_view, view.mask.shape, view.metres_per_pixel, 1.0)[0].ids >= 0
    holes = holes_of(shown)
    total = opened = 0
    for i in range(1, count):
        if stats[i, cv2.CC_STAT_AREA] * view.metres_per_pixel**2 < LEAST_HOLE:
            continue
        total += 1
        opened += int(np.mean(holes[labels == i]) > 0.5)
    return total, opened


def meshes(
    folder: Path, segmenter: Segmenter, poses: int = 3, seed: int = 0, count: int = 2
) -> tuple[dict[str, object], list[NDArray[np.uint8]]]:
    """Ray-cast captures of each mesh file in ``poses`` yaws by ``count`` cameras; also a row of pictures for each mesh."""
    from magic_core import sensor

    cameras = {
        "left": sensor.looking_at([0.94, 0.42, 0.66], [0.5, 0, 0.03]),
        "right": sensor.looking_at([0.94, -0.42, 0.66], [0.5, 0, 0.03]),
    }
    cameras = dict(list(cameras.items())[:count])
    rows, pictures = [], []
    for number, path in enumerate(sorted(folder.glob("*/*.obj"))):
        for turn in range(poses):
            truth = placed(path, 0.4 + 2 * np.pi * turn / poses)
            caster = sensor.scene_raycaster([truth])
            frames = [
                sensor.capture([truth], sensor.D435, pose, [seed, number, turn, i], camera=name, raycaster=caster)
                for i, (name, pose) in enumerate(cameras.items())
            ]
            masks = [caster.perspective(sensor.D435, pose)[0].ids == 1 for pose in cameras.values()]
            view = find_view(truth)
            row: dict[str, object] = {"mesh": f"{path.parent.name}/{path.stem}", "turn": turn}
            drawn = [view.image]
            for method in METHODS:
                cells, picture = _reconstructed(method, frames, masks, truth, view, segmenter)
                row |= cells
                drawn += [picture] if picture is not None else []
            rows.append(row)
            if turn == 0:
                pictures.append(strip(frames, masks, drawn))
    return {"rows": rows, **summary(rows)}, pictures


def _reconstructed(
    method: str, frames: list[RgbdFrame], masks: list[NDArray[np.bool_]], truth: Mesh, view: CanonicalView, segmenter: Segmenter
) -> tuple[dict[str, object], NDArray[np.uint8] | None]:
    """What one method makes of captures of a mesh: its part of the row, and its picture in the true object's view.

    masks (H, W): where each frame truly shows it.  What is the same by both methods, which get the same masks, is told by the first.
    """
    report = Report()
    start = time.process_time()
    scene = perceive(frames, parameters=Parameters(method=method), segmenter=segmenter, report=report)
    cells: dict[str, object] = {f"{method}_cpu_seconds": round(time.process_time() - start, 3)}
    item = nearest(scene.objects, truth)
    if item is None:
        return {**cells, method: None}, None
    if method == METHODS[0]:
        label = report.numbers[item.id]
        cells["objects"] = len(scene.objects)
        cells["mask_iou"] = round(float(np.mean([overlap(m, i == label) for m, i in zip(masks, report.labels, strict=True)])), 4)
        cells["pieces"] = len(item.pieces)
        cells["shape"] = report.shapes[item.id]
    found = item.mesh.transformed(item.world_from_object)
    volume = shared_volume(truth, found)
    total, opened = open_holes(view, found)
    cells[method] = {
        "chamfer_mm": round(1000 * chamfer(truth, found), 2),
        "volume_iou": None if volume is None else round(volume, 3),
        "holes": total,
        "open": opened,
    }
    return cells, _shaded(found, view)


def _shaded(mesh: Mesh, view: CanonicalView) -> NDArray[np.uint8]:
    """A mesh in grey on black, as large as a view and seen as in it."""
    shown = Raycaster([replace(mesh, colors=None)]).orthographic(view.object_from_view, view.mask.shape, view.metres_per_pixel, 1.0)[0]
    grey = (90 + 150 * np.abs(shown.normals @ transforms.unit([0.3, 0.4, 0.86])))[..., None]
    return np.where((shown.ids >= 0)[..., None], grey, 0).astype(np.uint8).repeat(3, axis=2)


def nearest(objects: tuple[SceneObject, ...], truth: Mesh) -> SceneObject | None:
    """The object whose centre is nearest to that of the true mesh; ``None`` where all are farther than 15 cm."""
    middle = truth.bounds.mean(axis=0)
    far = [float(np.linalg.norm(o.world_from_object[:3, 3] - middle)) for o in objects]
    return objects[int(np.argmin(far))] if far and min(far) < 0.15 else None


def summary(rows: list[dict[str, object]]) -> dict[str, object]:
    """Means over all rows."""
    seen = [r for r in rows if r.get("mask_iou") is not None]
    result: dict[str, object] = {
        "captures": len(rows),
        "found": len(seen),
        "one_object": sum(r["objects"] == 1 for r in seen),
        "mask_iou": round(float(np.mean([r["mask_iou"] for r in seen])), 4),
    }
    for method in METHODS:
        cells = [r[method] for r in rows if isinstance(r.get(method), dict)]
        volumes = [c["volume_iou"] for c in cells if c["volume_iou"] is not None]
        result[method] = {
            "chamfer_mm": round(float(np.mean([c["chamfer_mm"] for c in cells])), 2),
            "chamfer_mm_median": round(float(np.median([c["chamfer_mm"] for c in cells])), 2),
            "volume_iou": round(float(np.mean(volumes)), 3),
            "volumes": len(volumes),
            "holes": sum(c["holes"] for c in cells),
            "holes_open": sum(c["open"] for c in cells),
        }
    return result


def strip(frames: list[RgbdFrame], masks: list[NDArray[np.bool_]], views: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """One row of pictures: the left camera's cut-out, then the true view, this reconstruction and the paper's."""
    rows, columns = np.nonzero(masks[0])
    middle = (int(rows.mean()), int(columns.mean()))
    half = int(max(np.ptp(rows), np.ptp(columns), 40) * 0.6)
    cut = frames[0].color[max(middle[0] - half, 0) : middle[0] + half, max(middle[1] - half, 0) : middle[1] + half]
    return np.hstack(
        [cv2.resize(np.ascontiguousarray(tile), (TILE, TILE), interpolation=cv2.INTER_AREA) for tile in (cut, *views)]
        + [np.zeros((TILE, TILE, 3), np.uint8)] * (3 - len(views))
    )


# ---------------------------------------------------------------- the report


def markdown(result: dict) -> str:
    """The tables of what was measured."""
    lines = ["# Perception, measured", ""]
    for part, table in TABLES.items():
        if part in result:
            lines += table(result[part])
    return "\n".join(lines) + "\n"


def _osd_table(part: dict) -> list[str]:
    """Lines of :func:`osd`'s figures."""

    def measured(where: str, m: dict) -> str:
        overlaps, boundary = ([100 * m[f"{kind}_{what}"] for what in ("precision", "recall", "f")] for kind in ("overlap", "boundary"))
        return (
            "{}, mean of the scenes, in percent: overlap P {:.1f}, R {:.1f}, F {:.1f}; boundary P {:.1f}, R {:.1f}, F {:.1f}; F@.75 {:.1f}."
        ).format(where, *overlaps, *boundary, 100 * m["detected"])

    return [
        f"OSD: mean best IoU {part['mean_best_iou']:.3f} over {part['objects']} objects of {len(part['scenes'])} scenes; above 0.75: {part['above_0.75']:.1%}.",
        measured("Whole pictures", part["measures"]),
        measured("Where there is depth, as the labels are", part["with_depth"]),
        "",
        "| scene | objects | found | best IoU | CPU s |",
        "| --- | --- | --- | --- | --- |",
        *(
            f"| {n} | {s['objects']} | {s['found']} | {', '.join(f'{x:.2f}' for x in s['best_iou'])} | {s['cpu_seconds']:.2f} |"
            for n, s in part["scenes"].items()
        ),
        "",
    ]


def _captures_table(part: dict) -> list[str]:
    """Lines of :func:`captures`' figures."""

    def line(name: str, row: dict) -> str:
        size = " x ".join(f"{x:.0f}" for x in row["sizes_mm"][0]) if row["sizes_mm"] else ""
        one = "" if "one_object" not in row else " (one object)" if row["one_object"] else " (not one object)"
        read, error = " x ".join(map(str, row.get("read_mm", []))), row.get("largest_error_mm", "")
        return f"| {name}{one} | {row['objects']} | {size} | {read} | {error} | {row['cpu_seconds']:.2f} |"

    alone = [row["one_object"] for row in part.values() if "one_object" in row]
    return [
        f"{sum(alone)} of {len(alone)} real captures in which one thing can fall apart show it as one.",
        "",
        "| real capture | objects | size of the largest, mm | read from the image, mm | largest error, mm | CPU s |",
        "| --- | --- | --- | --- | --- | --- |",
        *(line(name, row) for name, row in part.items()),
        "",
    ]


def _meshes_table(part: dict) -> list[str]:
    """Lines of :func:`meshes`' figures: of both methods, and of each mesh over its turns."""

    def method_line(method: str) -> str:
        m = part[method]
        volumes, holes = f"{m['volume_iou']:.3f} (of {m['volumes']})", f"{m['holes_open']} of {m['holes']}"
        return f"| {method} | {m['chamfer_mm']:.2f} | {m['chamfer_mm_median']:.2f} | {volumes} | {holes} |"

    def mesh_line(name: str) -> str:
        rows = [r for r in part["rows"] if r["mesh"] == name and r.get("mask_iou") is not None]
        if not rows:
            return f"| {name} | not found | | | | | |"
        cells = [[r[method] for r in rows if isinstance(r.get(method), dict)] for method in METHODS]

        def mean(key: str) -> str:
            told = [[c[key] for c in of_method if c[key] is not None] for of_method in cells]
            return ", ".join(f"{np.mean(values):.2f}" if values else "-" for values in told)

        holes = ", ".join(f"{sum(c['open'] for c in of_method)}/{sum(c['holes'] for c in of_method)}" for of_method in cells)
        iou, shapes = np.mean([r["mask_iou"] for r in rows]), ", ".join(dict.fromkeys(r["shape"] for r in rows))
        pieces = max(r["pieces"] for r in rows)
        return f"| {name} | {iou:.3f} | {shapes} | {pieces} | {mean('chamfer_mm')} | {mean('volume_iou')} | {holes} |"

    return [
        f"Ray-cast captures: {part['captures']}, found {part['found']}, as one object {part['one_object']}; mean mask IoU {part['mask_iou']:.3f}.",
        "",
        "| method | Chamfer, mm: mean | median | volumetric IoU | holes open |",
        "| --- | --- | --- | --- | --- |",
        *(method_line(method) for method in METHODS),
        "",
        "| mesh | mask IoU | shape | pieces | Chamfer, mm: completed, paper | volumetric IoU: completed, paper | holes open: completed, paper |",
        "| --- | --- | --- | --- | --- | --- | --- |",
        *(mesh_line(name) for name in dict.fromkeys(r["mesh"] for r in part["rows"])),
    ]


#: What writes the lines of each part of a result, in their order in the report.
TABLES: dict[str, Callable[[dict], list[str]]] = {
    "osd": _osd_table,
    "views": lambda part: [coverage.markdown(part)],
    "moved_cameras": lambda part: [moved_cameras.markdown(part)],
    "mugs": lambda part: [made_mugs.markdown(part)],
    "speed": lambda part: [speed.markdown(part)],
    "captures": _captures_table,
    "meshes": _meshes_table,
}


def _command(args: list[str] | None) -> argparse.Namespace:
    """What the command line asks for; ends the program where it makes no sense."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, help="folder with meshes/ and rgbd/ (not needed with --speed, --views, --moved-cameras or --mugs)"
    )
    parser.add_argument("--out", type=Path, default=Path("evaluation"), help="folder for the results (default ./evaluation)")
    parser.add_argument("--parts", nargs="+", choices=("osd", "captures", "meshes"), default=["osd", "captures", "meshes"])
    parser.add_argument("--poses", type=int, default=3, help="yaws of each mesh (default 3)")
    parser.add_argument("--cameras", type=int, choices=(1, 2), default=2, help="cameras that see the meshes (default 2)")
    parser.add_argument("--segmenter", default="depth")
    parser.add_argument("--weights", default="")
    parser.add_argument("--no-split", action="store_true", help="do not part touching objects (osd)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed", action="store_true", help="measure speed and memory instead")
    parser.add_argument("--views", type=int, default=0, metavar="N", help="measure what several views bring instead, on N scenes")
    parser.add_argument(
        "--moved-cameras", type=int, default=0, metavar="N", help="measure what is said of cameras that are off instead, on N scenes"
    )
    parser.add_argument("--mugs", type=int, default=0, metavar="N", help="measure what becomes of handles instead, on N made mugs")
    parser.add_argument("--frames", type=int, default=50, help="scenes of --speed (default 50; 1000 shows whether memory is flat)")
    parser.add_argument("--workers", type=int, default=2, help="processes of --speed, this one among them (default 2, as the node has)")
    given = parser.parse_args(args)
    if given.data is None and not _without_data(given):
        parser.error("--data is needed, or --speed, --views, --moved-cameras or --mugs")
    if given.frames < 1 or given.workers < 1 or min(given.views, given.moved_cameras, given.mugs) < 0:
        counts = {name: getattr(given, name) for name in ("frames", "workers", "views", "moved_cameras", "mugs")}
        parser.error(f"{counts}: frames and workers at least 1, the others at least 0")
    return given


def _without_data(given: argparse.Namespace) -> bool:
    """Whether what is asked for is measured on made scenes alone."""
    return bool(given.speed or given.views or given.moved_cameras or given.mugs)


def _made(given: argparse.Namespace) -> dict:
    """The figures on made scenes, by the part's name."""

    def said(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    result: dict = {}
    if given.speed:
        workers = perceiving(given.workers - 1)
        segmenter = make_segmenter(given.segmenter, given.weights, workers=workers)
        result["speed"] = speed.measure(given.frames, segmenter, given.seed, workers)
        workers.close()
    if given.views:
        result["views"] = coverage.measure(given.views, given.seed, said=said)
    if given.moved_cameras:
        result["moved_cameras"] = moved_cameras.measure(given.moved_cameras, given.seed, said=said)
    if given.mugs:
        result["mugs"] = made_mugs.measure(given.mugs, given.seed, said)
    return result


def _of_data(given: argparse.Namespace) -> dict:
    """The figures on the data of a folder, by the part's name; a part whose data are absent is left out, and said so."""
    segmenter = make_segmenter(given.segmenter, given.weights, workers=perceiving(0))
    result: dict = {}
    for part, folder in (("osd", given.data / "rgbd/osd"), ("captures", given.data / "rgbd"), ("meshes", given.data / "meshes")):
        if part not in given.parts:
            continue
        if not folder.is_dir():
            print(f"evaluate: {part} left out: no folder {folder}", file=sys.stderr)
        elif part == "osd":
            result[part] = osd(folder, segmenter, not given.no_split, given.out / "osd")
        elif part == "captures":
            result[part] = captures(folder, segmenter)
        else:
            result[part], pictures = meshes(folder, segmenter, given.poses, given.seed, given.cameras)
            _write_sheet(given.out / "evaluation.png", pictures)
    return result


def _write_sheet(path: Path, pictures: list[NDArray[np.uint8]]) -> None:
    """Write pictures (h, w, 3) RGB of one size as one, in two columns."""
    half = -(-len(pictures) // 2)
    pictures = [*pictures, *[np.zeros_like(pictures[0])] * (2 * half - len(pictures))]
    cv2.imwrite(str(path), np.hstack([np.vstack(pictures[:half]), np.vstack(pictures[half:])])[..., ::-1])


def main(args: list[str] | None = None) -> None:
    """Entry point; exit status 1 where no data are found."""
    given = _command(args)
    try:
        given.out.mkdir(parents=True, exist_ok=True)
        result = _made(given) if _without_data(given) else _of_data(given)
    except MagicError as error:
        print(f"evaluate: {error}", file=sys.stderr)
        sys.exit(1)
    if not result:
        print(f"evaluate: nothing to measure in {given.data}", file=sys.stderr)
        sys.exit(1)
    (given.out / "evaluation.json").write_text(json.dumps(result, indent=1))
    text = markdown(result)
    (given.out / "evaluation.md").write_text(text)
    print(text)
    sys.exit(0)


if __name__ == "__main__":
    main()
