"""Mean best IoU of the ground-truth objects of the OSD scenes, for the segmenter as it is: ``python benchmark/osd.py [--no-split] [--pictures DIR]``."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

from magic_core.camera import Intrinsics, RgbdFrame
from magic_perception.parameters import Parameters
from magic_perception.segmentation import _frame_on, find_table, look, make_segmenter
from magic_perception.table import camera_over_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[3] / "shared/data/rgbd/osd", help="folder of the OSD scenes")
    parser.add_argument("--segmenter", default="depth")
    parser.add_argument("--weights", default="")
    parser.add_argument("--no-split", action="store_true")
    parser.add_argument("--surfaces", action="store_true", help="count every labelled surface as an object of its own")
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    segmenter = make_segmenter(given.segmenter, given.weights)
    cameras = json.loads((given.data / "intrinsics.json").read_text())
    rows = []
    for name, k in cameras.items():
        intrinsics = Intrinsics(k["width"], k["height"], k["fx"], k["fy"], k["cx"], k["cy"])
        color = cv2.imread(str(given.data / f"{name}_color.png"))[..., ::-1].copy()
        depth = cv2.imread(str(given.data / f"{name}_depth_mm.png"), -1).astype(np.float32) / 1000
        depth[depth == 0] = np.nan
        truth = cv2.imread(str(given.data / f"{name}_label.png"), -1)
        frame = RgbdFrame(color, depth, intrinsics, camera_over_table(intrinsics.unproject(depth)[::3, ::3]), name)
        start = time.perf_counter()
        parameters = Parameters(region_low=(-2, -2, -0.05), region_high=(2, 2, 0.6), split=not given.no_split)
        table, own = find_table([frame], parameters)
        looks = [look(frame, own[0], _frame_on(table, np.eye(4)), parameters)]
        labels = segmenter.segment(looks, (), parameters)[0]
        seconds = time.perf_counter() - start
        scores = []
        # 40, 41, ... are the surfaces of one thing (a bowl's outside and inside): objects are told by their tens.
        things = truth if given.surfaces else truth // 10 * 10
        for value in np.unique(things):
            if value < 20:
                continue
            mask = things == value
            best = 0.0
            for label in np.unique(labels[mask]):
                if label > 0:
                    best = max(best, float((mask & (labels == label)).sum() / (mask | (labels == label)).sum()))
            scores.append(best)
        rows += scores
        print(f"{name}: {len(scores)} objects, {labels.max()} found, best IoU {np.round(scores, 2).tolist()}, mean {np.mean(scores):.3f}, {seconds:.2f} s")
        if given.pictures:
            given.pictures.mkdir(parents=True, exist_ok=True)
            palette = np.random.default_rng(1).integers(60, 255, (64, 3))
            for tag, image in (("found", labels), ("truth", np.where(truth >= 20, truth, 0))):
                drawn = color.copy()
                for i, value in enumerate(np.unique(image[image > 0])):
                    drawn[image == value] = (0.4 * drawn[image == value] + 0.6 * palette[i % 64]).astype(np.uint8)
                cv2.imwrite(str(given.pictures / f"{name}_{tag}.png"), drawn[..., ::-1])
    print(f"mean best IoU over {len(rows)} objects: {np.mean(rows):.3f}")


if __name__ == "__main__":
    main()
