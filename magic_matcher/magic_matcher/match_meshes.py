"""Matches on meshes from files, as a contact sheet: ``ros2 run magic_matcher match_meshes``.

A strategy's contact on other tools::

    ros2 run magic_matcher match_meshes --strategy hooking --radius 0.02 --tools scissors.obj caliper.obj --out out

A contact shown on one mesh (pixels of its canonical view, which is written as ``reference.png`` too)::

    ros2 run magic_matcher match_meshes --reference hanger.obj --kind side --reference-point 192 123 --radius 0.006 --tools mug.obj --out
    out

All meshes of a folder, and shapes of the project's own generator (``FAMILY:SEED``), in rows of six::

    ros2 run magic_matcher match_meshes --strategy hanging --radius 0.006 --tools meshes/ mug:7003 watch:7001 --columns 6 --out out

Meshes that lie (``--kind top`` and ``section``) are laid on their broadest side first, unless ``--as-is``;
a ``section`` is then turned bowl up only if its file has it so.  Writes ``matches.png`` and ``matches.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import mesh as meshes
from magic_core import shapes
from magic_core import strategy as strategies
from magic_core.contact import Contact
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.views import find_view
from magic_matcher import curvature, drawing, features, global_stage, jobs, matching
from magic_matcher.global_stage import Reference, make_reference
from magic_matcher.match_images import _number

#: Mesh files that are looked for in a folder.
SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".off", ".dae")


def laid(mesh: Mesh) -> Mesh:
    """The mesh turned in steps of 90 degrees so that its shortest side is upright and its longest along x."""
    order = np.argsort(-mesh.extents)
    rotation = np.eye(3)[order]
    if np.linalg.det(rotation) < 0:
        rotation[1] *= -1
    return Mesh(mesh.vertices @ rotation.T, mesh.faces)


def files(names: Sequence[str]) -> list[str]:
    """What ``--tools`` means: files and shapes as they are, folders by the mesh files in them, in order of their names."""
    result = []
    for name in names:
        if not Path(name).is_dir():
            result.append(name)
            continue
        found = sorted(str(path) for path in Path(name).iterdir() if path.suffix.lower() in SUFFIXES)
        if not found:
            raise MagicError(Code.BAD_REQUEST, "--tools", name, f"a folder with files of {', '.join(SUFFIXES)}")
        result += found
    return result


def draw(path: str | Path, kind: str, as_is: bool) -> matching.Tool:
    """A mesh file, or a generated shape ``FAMILY:SEED``, as a tool: its canonical view of a kind."""
    family, _, seed = str(path).partition(":")
    if family in shapes.FAMILIES and seed.isdigit() and not Path(path).exists():
        return matching.Tool(family, shapes.make(family, int(seed)).view(kind))
    mesh = meshes.load(path)
    mesh = mesh if as_is or kind == "side" else laid(mesh)
    return matching.Tool(Path(path).stem, find_view(mesh, None, kind))


def reference_of(given: argparse.Namespace) -> tuple[Reference, Contact, float, str]:
    """The reference, its contact, the radius (m) of its target, and the kind of view."""
    if given.strategy:
        found = strategies.find(given.strategy)
        return global_stage.from_strategy(found), found.tool_contact, found.target_contact.disc_radius, found.view
    tool = draw(given.reference, given.kind, given.as_is)
    radius = given.reference_radius or given.radius
    reference = make_reference(tool.view, np.array(given.reference_point, dtype=float), None, radius / tool.view.metres_per_pixel)
    contact = matching.to_contact(tool.view, curvature.estimate(reference.contour, reference.contour.nearest(reference.pixel)))
    return reference, contact, radius, given.kind


def run(given: argparse.Namespace) -> tuple[dict[str, Any], NDArray[np.uint8]]:
    """What ``matches.json`` holds, and the sheet."""
    reference, contact, old, kind = reference_of(given)
    matcher = matching.Matcher(features.load(given.features, given.weights))
    target = jobs.disc_target(given.radius, kind)
    pictures, titles, rows = [drawing.draw_match(reference.view, contact)], ["reference"], []
    for path in files(given.tools):
        row: dict[str, Any] = {"tool": str(path)}
        try:
            tool = draw(path, kind, given.as_is)
            result = matcher.match_views(reference, contact, [tool], target, 3, False, old)
        except MagicError as error:
            rows.append({**row, "code": str(error)})
            continue
        row["candidates"] = [
            {
                "pixel": [float(v) for v in c.tool.pixel],
                "normal": [float(v) for v in c.tool.normal],
                "radius": _number(c.tool.radius),
                "concave": c.tool.concave,
                "flipped": c.flipped,
                "score": c.score,
            }
            for c in result.candidates
        ]
        rows.append(row)
        picture = drawing.draw_match(tool.view, [c.tool for c in result.candidates])
        best, pixels = result.candidates[0].tool, given.radius / tool.view.metres_per_pixel
        centre = best.pixel + pixels * best.normal
        cv2.circle(picture, tuple(int(round(v)) for v in centre), int(round(pixels)), (90, 255, 90), 2, cv2.LINE_AA)
        pictures.append(picture)
        titles.append(tool.id[:24])
    return {"radius": given.radius, "kind": kind, "matches": rows}, drawing.sheet(pictures, titles, given.columns or len(pictures), 192)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="match_meshes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shown = p.add_mutually_exclusive_group(required=True)
    shown.add_argument("--strategy", help="name or folder of a strategy whose contact is carried over")
    shown.add_argument("--reference", metavar="MESH", help="mesh on which the contact is shown")
    p.add_argument(
        "--reference-point", nargs=2, type=float, metavar=("U", "V"), default=(0.0, 0.0), help="its contact, pixels of its canonical view"
    )
    p.add_argument("--reference-radius", type=float, help="radius of the target that the reference meets, m (default: --radius)")
    p.add_argument("--kind", default="side", choices=("top", "side", "section"), help="view, with --reference (default: side)")
    p.add_argument("--radius", type=float, required=True, help="radius of the target that the tools shall meet, m")
    p.add_argument("--tools", nargs="+", required=True, metavar="MESH", help="mesh files, folders of them, or FAMILY:SEED of the generator")
    p.add_argument("--columns", type=int, default=0, metavar="N", help="pictures in a row (default: all in one)")
    p.add_argument("--as-is", action="store_true", help="do not lay the meshes on their broadest side")
    p.add_argument("--features", default="auto", choices=features.BACKENDS)
    p.add_argument("--weights", default="", help="hub name or folder, for dinov2")
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    return p


def main(argv: list[str] | None = None) -> None:
    """The command; errors are one line on stderr and exit status 2."""
    given = parser().parse_args(argv)
    try:
        if given.columns < 0:
            raise MagicError(Code.BAD_REQUEST, "--columns", given.columns, "0 or more")
        if not (np.isfinite(given.radius) and given.radius > 0):
            raise MagicError(Code.BAD_REQUEST, "--radius", given.radius, "a length in metres above 0")
        data, sheet = run(given)
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "matches.json").write_text(json.dumps(data, indent=1) + "\n")
        cv2.imwrite(str(given.out / "matches.png"), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    except (MagicError, OSError) as error:
        print(f"match_meshes: {error}", file=sys.stderr)
        sys.exit(2)
    for row in data["matches"]:
        outcome = row["code"] if "code" in row else f"score {row['candidates'][0]['score']:.3f}"
        print(f"{row['tool']}: {outcome}")


if __name__ == "__main__":
    main()
