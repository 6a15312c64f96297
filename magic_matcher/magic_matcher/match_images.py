"""``match_images``: a contact carried from one picture to another, without ROS running.

1. Two pictures on a plain background::

    ros2 run magic_matcher match_images --reference hook.png --reference-point 205 118 --target mug.png --out out

2. With masks, DINOv2 features from a local folder and five candidates::

    ros2 run magic_matcher match_images --reference R.png --reference-point 205 118 --reference-mask RM.png \\
        --target T.png --target-mask TM.png --features dinov2 --weights ~/dinov2-base --top 5 --out out

``match.json`` holds ``candidates``, best first: pixel, normal, radius and scale in pixels
of the target picture, concave, rotation (rad), flipped, s_dino, s_curv, score, and
target_from_reference, the 3x3 that carries pixels of the reference picture onto the
target's so that the contacts meet (turned, mirrored where flipped, not scaled).
``match.png`` shows both, ``heatmap.png`` (8 bits, size of the target picture) how alike its
places are to the reference.  Objects of more than 768 px a side are matched at a whole fraction of their size
(``block``); all that is written is in pixels of the files.  Exit status: 0, or 2 with the code and what was wrong.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from magic_core import devices
from magic_core.contact import ContactCandidate
from magic_core.errors import Code, MagicError
from magic_matcher import contour as contours
from magic_matcher import curvature, drawing, features, global_stage, images, matching
from magic_matcher.cache import Cache


def _number(value: float) -> float | None:
    return None if not math.isfinite(value) else float(value)


def record(first: images.Picture, second: images.Picture, reference: global_stage.Reference, candidate: ContactCandidate) -> dict[str, Any]:
    """One candidate as plain data, lengths in pixels of the files; straight edges have radius ``null``."""
    tool = candidate.tool
    pixel = second.on_edge(second.to_file(tool.pixel), tool.normal)
    c, s = math.cos(candidate.rotation), math.sin(candidate.rotation)
    linear = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if candidate.flipped else 1.0, 1.0])
    shift = pixel - linear @ _contact_pixel(first, reference)
    return {
        "pixel": [float(v) for v in pixel],
        "normal": [float(v) for v in tool.normal],
        "radius": _number(tool.radius * second.block),
        "concave": tool.concave,
        "scale": float(tool.scale) * second.block,
        "rotation": candidate.rotation,
        "flipped": candidate.flipped,
        "s_dino": candidate.s_dino,
        "s_curv": candidate.s_curv,
        "score": candidate.score,
        "target_from_reference": [[*map(float, linear[0]), float(shift[0])], [*map(float, linear[1]), float(shift[1])], [0.0, 0.0, 1.0]],
    }


def _contact_pixel(picture: images.Picture, reference: global_stage.Reference) -> np.ndarray:
    """The reference's contact (2,) in the file."""
    return picture.on_edge(picture.to_file(reference.pixel), reference.normal)


def _reference(picture: images.Picture, point: np.ndarray) -> global_stage.Reference:
    """The reference at a file's pixel (2,); errors in the file's pixels."""
    width, height = picture.size
    if not np.all(np.isfinite(point)) or not (-0.5 <= point[0] <= width - 0.5 and -0.5 <= point[1] <= height - 0.5):
        raise MagicError(Code.POINT_OUTSIDE, "reference point", point.tolist(), f"u in 0..{width - 1}, v in 0..{height - 1}")
    # What lies off the part that is matched lies far from the object: the view's nearest pixel does, too.
    shown = picture.view.mask.shape
    at = np.clip(picture.to_view(point), 0, np.array([shown[1] - 1, shown[0] - 1]))
    contour = contours.extract(picture.view.mask)
    away = float(np.hypot(*(contour.points[contour.nearest(at)] - picture.to_view(point)))) * picture.block
    allowed = 0.1 * contour.size * picture.block
    if away > allowed:
        raise MagicError(
            Code.POINT_OUTSIDE, "distance of the reference point from the object's edge", f"{away:.1f} px", f"at most {allowed:.1f} px"
        )
    return global_stage.make_reference(picture.view, at, contour=contour)


def run(given: argparse.Namespace) -> dict[str, Any]:
    """Do what the command line asks for; returns what ``match.json`` holds."""
    first = images.load(given.reference, given.reference_mask)
    second = images.load(given.target, given.target_mask)
    reference = _reference(first, np.array(given.reference_point, dtype=float))
    matcher = matching.Matcher(
        features.load(given.features, given.weights, given.device), cache=Cache(given.cache) if given.cache else None
    )
    contact = matching.to_contact(first.view, curvature.estimate(reference.contour, reference.contour.nearest(reference.pixel)))
    result = matcher.match_views(reference, contact, [matching.Tool("target", second.view)], None, given.top, heatmap=True)
    data = {
        "reference": {
            "pixel": [float(v) for v in _contact_pixel(first, reference)],
            "normal": [float(v) for v in reference.normal],
            "radius": _number(reference.radius * first.block),
            "concave": reference.concave,
            "scale": float(contact.scale) * first.block,
            **_about(first, given.reference_mask),
        },
        "candidates": [record(first, second, reference, candidate) for candidate in result.candidates],
        "target": _about(second, given.target_mask),
        "units": "pixels and radians; normals point out of the material, v down",
        "features": result.features,
        "seconds": result.seconds,
    }
    out = Path(given.out)
    out.mkdir(parents=True, exist_ok=True)
    (out / "match.json").write_text(json.dumps(data, indent=1) + "\n")
    shown = [drawing.draw_match(first.view, contact), drawing.draw_match(second.view, [c.tool for c in result.candidates], result.heatmap)]
    picture = drawing.side_by_side(
        shown, ("reference", f"target, best score {result.candidates[0].score:.3f}"), height=max(384, second.view.mask.shape[0])
    )
    files = {"match.png": cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)}
    if result.heatmap is not None:
        files["heatmap.png"] = np.rint(255 * np.clip(second.enlarged(result.heatmap), 0, 1)).astype(np.uint8)
    for name, content in files.items():
        done, raw = cv2.imencode(".png", content)
        if not done:
            raise OSError(f"{out / name} could not be encoded")
        (out / name).write_bytes(raw.tobytes())
    return data


def _about(picture: images.Picture, mask: str | None) -> dict[str, Any]:
    """What was matched: the file's size, where the mask is from, its pixels, file pixels a side of a pixel that was matched."""
    return {
        "size": list(picture.size),
        "mask": "file" if mask else "background",
        "mask_pixels": int(np.count_nonzero(picture.mask)),
        "block": picture.block,
    }


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="match_images", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--reference", required=True, metavar="R.png", help="picture of the reference tool")
    p.add_argument(
        "--reference-point", required=True, nargs=2, type=float, metavar=("U", "V"), help="its contact point, pixels right and down"
    )
    p.add_argument("--reference-mask", metavar="M.png", help="its mask, 255 on the tool; without one the background must be plain")
    p.add_argument("--target", required=True, metavar="T.png", help="picture of the new tool")
    p.add_argument("--target-mask", metavar="M.png", help="its mask")
    p.add_argument("--features", default="auto", choices=features.BACKENDS, help="feature backend (default: auto)")
    p.add_argument("--weights", default="", help="hub name or folder of weights, for dinov2")
    p.add_argument(
        "--device", default=devices.AUTO, help="torch device of the network; auto (default): cuda where there is a GPU, else cpu"
    )
    p.add_argument("--top", type=int, default=3, metavar="K", help="how many candidates (default: 3)")
    p.add_argument("--cache", default="", metavar="DIR", help="keep the prepared reference in this folder")
    p.add_argument("--out", required=True, metavar="DIR", help="folder for match.json and match.png")
    return p


def main(argv: list[str] | None = None) -> None:
    """The command; errors are one line on stderr and exit status 2."""
    given = parser().parse_args(argv)
    try:
        data = run(given)
    except MagicError as error:
        print(f"match_images: {error}", file=sys.stderr)
        sys.exit(2)
    except (OSError, cv2.error, MemoryError) as error:
        print(f"match_images: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
        sys.exit(2)
    for k, candidate in enumerate(data["candidates"]):
        u, v = candidate["pixel"]
        print(
            f"{k + 1}: pixel ({u:.1f}, {v:.1f})  score {candidate['score']:.3f}  s_dino {candidate['s_dino']:.3f}  s_curv {candidate['s_curv']:.3f}"
        )


if __name__ == "__main__":
    main()
