"""Does the contact follow a tool that is turned any way?  ``python3 -m magic_matcher.attitudes``.

Each tool is matched as it stands and in attitudes drawn over all rotations; every contact is carried back into the tool as it
stands.  Told is how many are within 3 mm of the place where most are, and how far the others are::

    python3 -m magic_matcher.attitudes --strategy hanging --tools mug:3 scissors:2 mugs/ --attitudes 50 --out out

Shapes of the generator are named ``FAMILY:SEED``; mesh files are laid on their broadest side first, as by ``match_meshes``.
A tool with symmetries has its places as often as these repeat them: which of them is found is no error, and is counted as one here.
Writes ``attitudes.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import mesh as meshes
from magic_core import shapes, transforms
from magic_core import strategy as strategies
from magic_core.errors import MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_core.strategy import Strategy
from magic_core.views import find_view
from magic_matcher import features, global_stage, matching
from magic_matcher.match_meshes import files, laid

#: A contact within this of another (m) is the same place.
SAME = 0.003


@dataclass(frozen=True)
class Followed:
    """Best contacts of one tool in N attitudes, the first of which is as it stands, in the tool's own frame as it stands.

    points (N, 3) m and normals (N, 3), NaN where there was no match; most: index of the attitude around whose place most lie.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    @property
    def away(self) -> NDArray[np.float64]:
        """(N, N) distances between the contacts, m; inf where there is none."""
        return np.nan_to_num(np.linalg.norm(self.points[:, None] - self.points[None], axis=2), nan=np.inf)

    @property
    def most(self) -> int:
        return int(np.argmax((self.away < SAME).sum(axis=1)))

    @property
    def share(self) -> float:
        """Of all attitudes those whose contact is where most are."""
        return float((self.away[self.most] < SAME).mean())


def rotations(count: int, seed: int = 0) -> NDArray[np.float64]:
    """(1 + count, 3, 3): none, then uniformly drawn ones."""
    return np.concatenate([np.eye(3)[None], Rotation.random(count, random_state=seed).as_matrix()])


def follow(matcher: matching.Matcher, strategy: Strategy, mesh: Mesh, turns: NDArray[np.float64]) -> Followed:
    """Match a mesh (m, as it stands) in attitudes (N, 3, 3)."""
    reference, radius = global_stage.from_strategy(strategy), strategy.target_contact.disc_radius
    target = matching.Target("", strategy.target_view, strategy.target_contact)
    points, normals = np.full((len(turns), 3), np.nan), np.full((len(turns), 3), np.nan)
    for k, turn in enumerate(turns):
        turned = mesh.transformed(transforms.make(turn))
        try:
            item = SceneObject("tool", turned, (), np.eye(4), find_view(turned, None, strategy.view), source="known")
            tool = matching.tool_of(item, strategy.view)
            best = matcher.match_views(reference, strategy.tool_contact, [tool], target, 1, False, radius).candidates[0]
        except MagicError:
            continue
        frame = best.tool.object_from_contact
        points[k], normals[k] = turn.T @ frame[:3, 3], turn.T @ frame[:3, 0]
    return Followed(points, normals)


def load(name: str, kind: str) -> Mesh:
    """A mesh by its file, or a generated shape by ``FAMILY:SEED``."""
    family, _, seed = name.partition(":")
    if family in shapes.FAMILIES and seed.isdigit():
        return shapes.make(family, int(seed)).mesh
    mesh = meshes.load(name)
    return mesh if kind == "side" else laid(mesh)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog="attitudes", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--strategy", required=True, help="name or folder of a strategy")
    p.add_argument("--tools", nargs="+", required=True, metavar="MESH", help="mesh files, folders of them, or FAMILY:SEED of the generator")
    p.add_argument("--attitudes", type=int, default=50, metavar="N", help="besides the one in which it stands (default: 50)")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--features", default="auto", choices=features.BACKENDS)
    p.add_argument("--weights", default="", help="hub name or folder, for dinov2")
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    return p


def main(argv: Sequence[str] | None = None) -> None:
    """The command; errors are one line on stderr and exit status 2."""
    given = parser().parse_args(argv)
    rows = []
    try:
        strategy = strategies.find(given.strategy)
        matcher = matching.Matcher(features.load(given.features, given.weights))
        for name in files(given.tools):
            found = follow(matcher, strategy, load(name, strategy.view), rotations(given.attitudes, given.seed))
            away = found.away[found.most]
            there = np.isfinite(away)
            row = {"tool": name, "attitudes": len(away), "matched": int(there.sum()), "share": found.share}
            row |= {"away_mm": [round(1000 * float(d), 2) for d in away[there]], "stands": bool(away[0] < SAME)}
            rows.append(row)
            worst = f"{1000 * away[there].max():.1f}" if there.any() else "none"
            print(
                f"{Path(name).name:28} matched {there.sum():3}/{len(away)}  within 3 mm {100 * found.share:5.1f} %  worst {worst} mm",
                flush=True,
            )
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "attitudes.json").write_text(json.dumps({"strategy": strategy.name, "tools": rows}, indent=1) + "\n")
    except (MagicError, OSError) as error:
        print(f"attitudes: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
