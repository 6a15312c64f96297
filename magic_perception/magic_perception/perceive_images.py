"""Objects from one colour and one depth image, without ROS: ``ros2 run magic_perception perceive_images --help``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from magic_core import depth as depths
from magic_core import devices, images, transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.scene import Scene
from magic_perception.parameters import METHODS, Parameters
from magic_perception.pipeline import Report, perceive
from magic_perception.segmenters import SEGMENTERS, make_segmenter
from magic_perception.table import camera_over_table


def write(scene_dir: Path, frame: RgbdFrame, scene: Scene, report: Report, seconds: float) -> None:
    """labels.png, objects.json, and object_N.ply and object_N_view.png for each object."""
    scene_dir.mkdir(parents=True, exist_ok=True)
    labels = np.zeros(frame.depth.shape, np.uint16)
    items = []
    for number, item in enumerate((o for o in scene.objects if o.source == "camera"), 1):
        if item.mask is not None:
            labels[item.mask] = number
        mesh_file, view_file = f"{item.id}.ply", f"{item.id}_view.png"
        item.mesh.save(scene_dir / mesh_file)
        cv2.imwrite(str(scene_dir / view_file), item.view.image[..., ::-1])
        items.append(
            {
                "id": item.id,
                "label": number,
                "pixels": int(item.mask.sum()) if item.mask is not None else 0,
                "box": {"size": item.box_extents.tolist(), "world_from_box": item.world_from_box.tolist()},
                "world_from_object": item.world_from_object.tolist(),
                "camera_from_object": (np.linalg.inv(frame.world_from_camera) @ item.world_from_object).tolist(),
                "mesh": mesh_file,
                "pieces": len(item.pieces),
                "shape": report.shapes.get(item.id, ""),
                "view": {
                    "file": view_file,
                    "kind": item.view.kind,
                    "metres_per_pixel": item.view.metres_per_pixel,
                    "confidence": item.view.confidence,
                },
                "confidence": item.confidence,
                "seen_share": item.seen_share,
                "cut_off": list(item.cut_off),
            }
        )
    cv2.imwrite(str(scene_dir / "labels.png"), labels if labels.max() > 255 else labels.astype(np.uint8))
    content = {
        "objects": items,
        "table": scene.table.tolist(),
        "world_from_camera": frame.world_from_camera.tolist(),
        "notes": report.notes,
        "seconds": {**report.seconds, "total": seconds},
    }
    (scene_dir / "objects.json").write_text(json.dumps(content, indent=1))


def options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description="Objects from one colour and one depth image that is registered to it.")
    parser.add_argument("--color", required=True, type=Path, help="colour image (PNG, JPEG)")
    parser.add_argument("--depth", required=True, type=Path, help="depth image of the same size (16-bit PNG, TIFF, EXR, npy)")
    parser.add_argument("--intrinsics", required=True, help="fx,fy,cx,cy in pixels, or a JSON file (FILE:NAME for one entry of several)")
    parser.add_argument(
        "--depth-unit",
        help=f"what 1 in the depth image is: {', '.join(depths.UNITS)} or another multiple (default: mm for whole numbers, m for floating-point ones)",
    )
    parser.add_argument("--segmenter", choices=SEGMENTERS, default="depth")
    parser.add_argument("--weights", default="", help="weights of the segmenter: a hub name or a local folder")
    parser.add_argument(
        "--device", default=devices.AUTO, help="torch device of the segmenter; auto (default): cuda where there is a GPU, else cpu"
    )
    parser.add_argument("--method", choices=METHODS, default="completed", help="reconstruction")
    parser.add_argument(
        "--max-distance", type=float, default=1.3, help="how far from below the camera objects are looked for, m (default 1.3)"
    )
    parser.add_argument(
        "--camera-pose", help="world_from_camera as x,y,z,qx,qy,qz,qw (world z up); without, the table that is seen is the plane z = 0"
    )
    parser.add_argument("--no-split", action="store_true", help="do not part touching objects at concave seams")
    parser.add_argument("--out", required=True, type=Path, help="folder for the results")
    return parser


def perceived(given: argparse.Namespace, report: Report) -> Scene:
    """Look at the two images, and write what is on the table into the folder.  Raises what the input is at fault for."""
    start = time.perf_counter()
    picture = images.read_rgbd(given.color, given.depth, given.intrinsics, given.depth_unit)
    report.notes += picture.notes
    if given.camera_pose:
        try:
            numbers = [float(x) for x in given.camera_pose.split(",")]
            pose = transforms.from_numbers(numbers) @ picture.stored_from_shown
        except ValueError as error:
            raise MagicError(Code.NO_TRANSFORM, "--camera-pose", given.camera_pose, f"x,y,z,qx,qy,qz,qw; {error}") from None
    else:
        pose = camera_over_table(picture.intrinsics.unproject(picture.depth)[::3, ::3], notes=report.notes)
    frame = RgbdFrame(picture.color, picture.depth, picture.intrinsics, pose, "camera")
    depths.check_pose(frame, picture.unit, images.REMEDY)
    # The world of a pose that is given need not begin below the camera.
    reach = np.inf if given.camera_pose else given.max_distance
    parameters = Parameters(
        region_low=(-reach, -reach, -0.05), region_high=(reach, reach, 0.6), method=given.method, split=not given.no_split
    )
    segmenter = make_segmenter(given.segmenter, given.weights, given.device)
    scene = perceive([frame], parameters=parameters, segmenter=segmenter, report=report)
    sizes = [float(max(item.box_extents)) for item in scene.objects]
    depths.check_sizes(float(np.nanmedian(frame.depth)), sizes, picture.unit, picture.told, images.REMEDY)
    write(given.out, frame, scene, report, time.perf_counter() - start)
    return scene


def main(args: list[str] | None = None) -> None:
    """Entry point; exit status 1 with one line on stderr where the input cannot be used."""
    given = options().parse_args(args)
    report = Report()
    try:
        scene = perceived(given, report)
    except MagicError as error:
        print(f"perceive_images: {error}", file=sys.stderr)
        sys.exit(1)
    for item in scene.objects:
        size = " x ".join(f"{1000 * x:.0f}" for x in item.box_extents)
        print(
            f"{item.id}: {size} mm, {report.pixels.get(item.id, 0)} pixels, {report.shapes.get(item.id, '')}, view {item.view.kind}, confidence {item.confidence:.2f}"
            + (f", cut off by {' and '.join(item.cut_off)}" if item.cut_off else "")
        )
    for note in report.notes:
        print(f"note: {note}")
    print(f"{len(scene.objects)} objects in {given.out}")
    sys.exit(0)


if __name__ == "__main__":
    main()
