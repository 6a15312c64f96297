"""From what cameras saw of one thing to a closed solid with convex pieces.

Everything here is in the table frame: z = 0 is the table, z up.  The paper projects the points to the table,
takes their alpha shape and pulls it up (:func:`as_in_paper`).  :func:`reconstruct` does better where that fails:

* balls, upright cylinders and boxes are recognised by their residual;
* flat things are carved: a cell of the table is part of the thing if the whole upright column above it, up to the
  measured thickness, falls into the thing's mask in every camera.  For a prism this is its visual hull; it takes its
  sharpness from the colour image, not from depth, and a hole through which the table is seen stays open.  What stands out of a thing of
  less than 12 mm by 10 mm or more and was seen by each camera stays, though a rod thinner than the thing is high has no whole column in two
  masks;
* a bowl with a handle that lies on its back (a spoon, a ladle) becomes a wall about a hollow, whose rim and profile are fitted;
* other things that lie become a height field, filled down to where no camera sees past any more, or, where they are seen to be hollow from
above, a shell;
* things that stand on a round body (mugs, cans, bottles) become a body of revolution, open at the top where cameras
  look into it, with the handle carved in its own upright plane in the same way as a flat thing, and by where the picture shows the body
  through it;
* bowls and dishes become a body of revolution as well, from their rim, their inside and what shows of their outside;
* round things that lie on their side are built in the frame of their own axis as if they stood;
* other standing things are stacked from layers, completed by point symmetry where no camera saw through the completion;
* every proposal but the flat ones has to agree with the masks, and free space forbids it: where rays of a depth camera pass
  through a proposed solid (a hoop taken for a ball, a bent wire for a wall), the thing is carved out of space instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_perception import clusters, polygons, primitives
from magic_perception.body import Body
from magic_perception.boxes import recognise_box
from magic_perception.carved import build_carved
from magic_perception.lain import build_lain
from magic_perception.layers import build_layers
from magic_perception.lying import build_lying, lay
from magic_perception.parameters import Parameters
from magic_perception.scoops import build_scoop
from magic_perception.sight import Agreement, Sight, agreement, surfaces
from magic_perception.solids import Reconstruction, extruded
from magic_perception.turned import build_round, seen_into
from magic_perception.vessels import build_vessel

__all__ = ["Reconstruction", "Sight", "as_in_paper", "reconstruct"]


def reconstruct(sights: list[Sight], parameters: Parameters) -> Reconstruction:
    """The solid of one thing from all cameras that saw it.  Raises ``RECONSTRUCTION_FAILED`` where there is too little."""
    points, eyes = surfaces(sights)
    if len(points) < 20:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "points of one object", len(points), "at least 20")
    noise = float(np.median([s.sigma for s in sights]))
    if parameters.method == "paper":
        return as_in_paper(points)
    height = float(np.percentile(points[:, 2], 98))
    found = primitives.recognise(points, height, noise)
    if found is not None:
        fit = agreement(found.mesh, sights)
        if fit.overlap > 0.75 and fit.through < _FREE and not _open(found, sights, noise):
            return replace(found, fit=fit)
    found = recognise_box(sights, height, noise)
    if found is not None:
        fit = agreement(found.mesh, sights)
        if fit.overlap > _LEAST[found.shape] and fit.through < _FREE and not _open(found, sights, noise):
            return replace(found, fit=fit)
    spread = points[:, :2] - points[:, :2].mean(axis=0)
    axes = np.linalg.svd(spread[:: max(1, len(spread) // 4000)], full_matrices=False)[2]
    # Without the outermost half percent: one stray ray must not lay a mug down.
    length = float(np.max(np.subtract(*np.percentile(spread @ axes.T, [99.5, 0.5], axis=0))))
    turned, stands = None, height > 0.04 and height > 0.45 * length
    # Round things: standing, hollow, on their side.  One that agrees well is taken; else the best of those that agree.
    agreeing: list[tuple[float, Reconstruction]] = []
    standing: Mesh | None = None
    if stands:
        # What is drawn at random tells its axis; where it came out badly it is drawn anew.
        for draw in range(DRAWS):
            drawn = build_round(sights, points, eyes, height, noise, replace(parameters, seed=parameters.seed + draw))
            if drawn is None:
                break
            drawn = replace(drawn, fit=agreement(drawn.mesh, sights))
            if turned is None or drawn.fit.score > turned.fit.score:
                turned = drawn
            if turned.fit.score > _WELL:
                break
        if turned is not None:
            standing = turned.mesh
            agreeing += _agreeing(turned, sights, 0.8)
    lain: Reconstruction | None = None
    if max((score for score, _ in agreeing), default=0.0) < _WELL:
        agreeing += _agreeing(build_vessel(sights, points, eyes, height, noise, parameters), sights, 0.85)
    if max((score for score, _ in agreeing), default=0.0) < _WELL:
        lain = build_lain(sights, points, eyes, height, noise, parameters)
        agreeing += _agreeing(lain, sights, 0.9)
    if agreeing:
        # What stands and may have a handle gives way to another only where that is clearly better.
        return max(agreeing, key=lambda pair: pair[0] + (_CLEARLY if pair[1].mesh is standing else 0.0))[1]
    # A round thing on its side that agrees less is still better than what is stacked, filled or carved, but no better than a scoop.
    roughly = [solid for _, solid in _agreeing(lain, sights, 0.85)]
    if stands and height > 0.65 * length:  # a ladle's stem rises, but it lies
        return roughly[0] if roughly else _freest([lambda: turned, lambda: build_layers(sights, points, height)], sights, noise)
    try:
        laid = lay(sights, noise, parameters)
    except MagicError:
        return roughly[0] if roughly else _freest([], sights, noise)
    scoop = build_scoop(laid.thin or laid, sights, noise, parameters)
    for score, solid in _agreeing(scoop, sights, 0.0):
        if score > _WELL:
            return solid
    if roughly:
        return roughly[0]
    return _freest([lambda: scoop, lambda: build_lying(laid)], sights, noise)


#: Largest share of rays that may pass through a solid: noise and a pixel of the edge.
_FREE = 0.15
#: Least overlap of what is fitted to depth and outlines together with the masks.
_LEAST = {"box": 0.9, "rounded box": 0.9, "cylinder": 0.8}
#: From this score on a solid agrees so well with what was seen that no other is looked for.
_WELL = 0.86
#: A round body is drawn so often at most.
DRAWS = 3
#: A solid is clearly better than another by so much of the score.
_CLEARLY = 0.05


def _open(found: Reconstruction, sights: list[Sight], noise: float) -> bool:
    """Whether cameras look into what is taken for a cylinder: of a narrow cup little of the inside shows."""
    if found.shape != "cylinder":
        return False
    (x, y, _), (wide, deep, high) = found.mesh.bounds.mean(axis=0), found.mesh.extents
    radius = (wide + deep) / 4
    return seen_into(sights, Body(np.array([x, y]), np.array([[radius, 0.0], [radius, high]])), noise)


def _agreeing(solid: Reconstruction | None, sights: list[Sight], least: float) -> list[tuple[float, Reconstruction]]:
    """The solid with its score where its overlap is above ``least`` and few rays pass through it."""
    if solid is None:
        return []
    fit = solid.fit or agreement(solid.mesh, sights)
    return [(fit.score, replace(solid, fit=fit))] if fit.overlap > least and fit.through < _FREE else []


def _freest(builds: list[Callable[[], Reconstruction | None]], sights: list[Sight], noise: float) -> Reconstruction:
    """The solid that agrees best with what was seen; carved out of space where the cameras look through all others."""
    best, value, problem = None, Agreement(0.0, 1.0), None
    for build in builds:
        try:
            found = build()
        except MagicError as error:
            problem = error
            continue
        if found is None:
            continue
        if found.shape == "flat":  # carved already
            return found
        fit = found.fit or agreement(found.mesh, sights)
        if best is None or fit.score > value.score:
            best, value = found, fit
    if best is None or value.through > _FREE:
        try:
            found = build_carved(sights, noise)
            fit = agreement(found.mesh, sights)
            # A body that is a little amiss is worth more than what is carved of it: that has no unseen side.
            if best is None or 0.75 * fit.score > value.score:
                best, value = found, fit
        except MagicError as error:
            problem = error
    if best is None:
        assert problem is not None
        raise problem
    return replace(best, fit=value)


def as_in_paper(points: NDArray[np.float64], alpha: float = 0.1, voxel: float = 0.005) -> Reconstruction:
    """The paper's completion: points projected to the table, their alpha shape, pulled up to the highest point.

    ``alpha`` and ``voxel`` are those of the authors' library; one piece, the hull of each part cut convexly.
    """
    thin, _ = clusters.thin(points, voxel)
    parts = polygons.alpha_shape(thin[:, :2], alpha)
    if not parts:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "alpha shape", "empty", "points that span an area")
    height = max(float(points[:, 2].max()), 0.002)
    return extruded(parts[:1], height, "paper")
