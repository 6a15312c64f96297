"""How far the surface of a reconstruction is likely to be off, computed from what was seen of it.

A thing may overlap the truth by little and be right to a millimetre, as what is thin does (:mod:`magic_perception.confidence`), or overlap
it well and have its handle elsewhere.  What a motion meets is the surface.  The root mean square distance between it and the true one,
below which it is for five of six things, is the exponential of a linear function of a few numbers: the quantile regression whose weights
``surface_error.json`` holds. ``ros2 run magic_perception learn_surface_error`` fits them anew; ``docs/results_perception.md`` says how it
does on others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_perception.confidence import ENDED, ROUND, TURNED, Evidence
from magic_perception.logistic import load_linear, save_linear
from magic_perception.sight import Sight

#: The share of things whose surface is off by less than is stated.
SHARE = 5 / 6
#: No surface is stated to be off by less than the first or more than the second, m.
LEAST, MOST = 0.0003, 0.03
#: So many pixels are farther from the other than what counts as astray: a few at a mask's edge are anywhere.
PIXELS = 20
#: So many measured points of each camera, or up to twice as many, tell how far they are from the solid.
POINTS = 800
#: A measured point that is farther from the solid than this, m, is as far: it may be none of its.
FARTHEST = 0.020
#: The numbers that speak for or against a surface: what they are, and 1 or -1 where more of them is known to be worse or better.
NUMBERS = {
    "astray": ("log of 2 mm and how far silhouette and mask are apart at most, mm", 1),
    "gap": ("log of 0.5 mm and the root mean square distance of the measured points from the solid, mm", 1),
    "residual": ("log of 0.5 mm and the median distance between measured and drawn depth, mm, up to 8", 1),
    "unseen": ("share of its surface that nobody saw", 1),
    "through": ("share of the rays that go on where the solid is", 1),
    "size": ("log of its largest size over 0.1 m", 1),
    "thin": ("log of its smallest size over 20 mm", 0),
    "box": ("1 for a box with sharp edges", 0),
    "turned": ("1 for a ball, a cylinder or a box with rounded edges", 0),
    "flat": ("1 for a flat thing", 0),
    "round": ("1 for a body of revolution with a profile", 0),
    "handle": ("1 for one with a handle", 0),
    "scoop": ("1 for a bowl with a handle that lies", 0),
    "border": ("1 where the picture or the region cuts it off", 1),
    "hidden": ("1 where another thing hides a part of it", 1),
    "joined": ("share of its outline along which another thing goes on at its depth, up to 0.3: they may be one", 1),
    "alone": ("1 where one camera saw it", 1),
    "apart": ("log of 2 mm and how far the cameras disagree, mm", 1),
}
SIGNS = np.array([sign for _, sign in NUMBERS.values()])


@dataclass(frozen=True)
class Departure:
    """How far a solid departs from what was seen of it, m: astray, the largest distance of its silhouette from the mask, or of the mask
    from its silhouette, in any camera; gap, the root mean square distance of the measured points from it."""

    astray: float
    gap: float


def departure(mesh: Mesh, sights: list[Sight]) -> Departure:
    """Draw a solid (table frame) into every camera, as dense as the pixels, and measure what is where the other is not.

    What something else may hide, or something nearer is before, tells nothing.
    """
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    astray, gaps = [0.0], []
    for sight in sights:
        corners = sight.pixels(mesh.vertices)
        x, y, w, h = cv2.boundingRect(sight.mask.view(np.uint8))
        height, width = sight.mask.shape
        low = np.clip(np.minimum(corners.min(axis=0), [x, y]) - 2, 0, None).astype(int)
        high = np.minimum(np.maximum(corners.max(axis=0), [x + w, y + h]) + 3, [width, height]).astype(int)
        cut = (slice(low[1], high[1]), slice(low[0], high[0]))
        u, v, k = np.arange(low[0], high[0]), np.arange(low[1], high[1]), sight.intrinsics
        rays = np.empty((len(v), len(u), 6), np.float32)
        rays[..., :3] = sight.eye
        ways = np.stack(np.broadcast_arrays(((u - k.cx) / k.fx)[None], ((v - k.cy) / k.fy)[:, None], 1.0), axis=-1)
        rays[..., 3:] = ways @ sight.table_from_camera[:3, :3].T
        depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        drawn, mask = np.isfinite(depth), sight.mask[cut]
        if drawn.any() and mask.any():
            with np.errstate(invalid="ignore"):
                told = ~sight.hidden[cut] & (mask | ~(sight.depth[cut] < depth - 0.02))
            pixel = float(np.median(depth[drawn])) / k.fx
            for one, other in ((drawn & told, mask), (mask, drawn)):
                away = cv2.distanceTransform((~other).view(np.uint8), cv2.DIST_L2, 5)[one]
                if len(away) > PIXELS:
                    astray.append(pixel * float(np.partition(away, -PIXELS)[-PIXELS]))
        points = sight.measured
        points = points[:: max(1, len(points) // POINTS)]
        if len(points):
            gaps.append(scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy())
    gap = float(np.sqrt(np.mean(np.minimum(np.concatenate(gaps), FARTHEST) ** 2))) if gaps else FARTHEST
    return Departure(max(astray), gap)


def row(evidence: Evidence, departed: Departure) -> NDArray[np.float64]:
    """The :data:`NUMBERS` of a solid."""
    told = {
        "astray": np.log(2 + min(1000 * departed.astray, 40.0)),
        "gap": np.log(0.5 + 1000 * departed.gap),
        "residual": np.log(0.5 + min(1000 * evidence.witnessed.residual, 8.0)),
        "unseen": 1.0 - evidence.witnessed.seen,
        "through": evidence.fit.through,
        "size": float(np.clip(np.log(max(float(evidence.extents.max()), 1e-6) / 0.1), -2, 2)),
        "thin": float(np.clip(np.log(max(float(evidence.extents.min()), 1e-6) / 0.02), -2, 2)),
        "box": float(evidence.shape == "box"),
        "turned": float(evidence.shape in TURNED),
        "flat": float(evidence.shape == "flat"),
        "round": float(evidence.shape in ROUND),
        "handle": float(evidence.shape == "round with handle"),
        "scoop": float(evidence.shape == "scoop"),
        "border": float(any(by in ENDED for by in evidence.cut)),
        "hidden": float(any(by not in ENDED for by in evidence.cut)),
        "joined": min(evidence.joined, 0.3),
        "alone": float(evidence.cameras == 1),
        "apart": np.log(2 + min(1000 * evidence.apart, 20.0)) if np.isfinite(evidence.apart) else np.log(22.0),
    }
    return np.array([told[name] for name in NUMBERS], float)


@dataclass(frozen=True)
class Quantile:
    """The logarithm of an error in mm: a constant, and a weight (C,) for each of the numbers."""

    constant: float
    weights: NDArray[np.float64]

    def error(self, numbers: NDArray[np.float64]) -> float:
        """Metres, at numbers (C,)."""
        return float(np.clip(np.exp(np.clip(self.constant + self.weights @ numbers, -10, 10)) / 1000, LEAST, MOST))

    def save(self, path: Path, names: Mapping[str, object]) -> None:
        """Write a JSON file; names: of the numbers, in their order."""
        save_linear(path, self.constant, self.weights, names)


def fit(
    rows: NDArray[np.float64], errors: NDArray[np.float64], share: float = SHARE, ridge: float = 1.0, signs: NDArray[np.int64] = SIGNS
) -> Quantile:
    """Quantile regression of the logarithm of errors (N,) in metres on rows (N, C), with a ridge penalty on the standardised numbers; signs
    (C,): 1 or -1 where more of a number is known to be worse or better, and its weight may not say otherwise.

    The quantile's loss has a corner, which is rounded over a tenth in the logarithm.
    """
    from scipy.optimize import minimize

    mean, scale = rows.mean(axis=0), np.maximum(rows.std(axis=0), 1e-6)
    columns = np.column_stack([np.ones(len(rows)), (rows - mean) / scale])
    wanted = np.log(1000 * np.maximum(errors, LEAST))
    soft, penalty = 0.1, np.append(0.0, np.full(rows.shape[1], ridge))

    def loss(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        over = wanted - columns @ x
        # share * over + soft * log(1 + exp(-over / soft)): the pinball loss, rounded.
        value = float(np.sum((share - 1) * over + soft * np.logaddexp(0, over / soft)) + 0.5 * penalty @ x**2)
        slope = (share - 1) + 0.5 * (1 + np.tanh(over / (2 * soft)))
        return value, -slope @ columns + penalty * x

    bounds = [(None, None), *((0 if s > 0 else None, 0 if s < 0 else None) for s in signs)]
    x = minimize(loss, np.zeros(columns.shape[1]), jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 2000}).x
    weights = x[1:] / scale
    return Quantile(float(x[0] - weights @ mean), weights)


@cache
def _learned() -> Quantile:
    return Quantile(*load_linear(Path(__file__).with_name("surface_error.json"), NUMBERS))


def likely(evidence: Evidence, departed: Departure) -> float:
    """The root mean square distance, m, between a solid's surface and the true one that :data:`SHARE` of the things like it stay below."""
    return _learned().error(row(evidence, departed))


def beyond(mesh: Mesh, own: NDArray[np.float64], *others: NDArray[np.float64]) -> float:
    """How far a surface is off, m, as :func:`distance` has it, if what was seen of other things is a part of this one.

    own (N, 3), others (M, 3) each: the points that were seen, in the frame of ``mesh``.
    """
    clouds = [points[:: max(1, len(points) // POINTS)] for points in (own, *others)]
    squares = [float(np.square(Raycaster([mesh]).distances(points)).mean()) for points in clouds]
    # The surface itself is none of it off: half of the mean over both.
    return float(np.sqrt(np.average(squares, weights=[len(own), *(len(points) for points in others)]) / 2))


def distance(one: Mesh, other: Mesh, points: int = 1500) -> float:
    """How far two surfaces are apart: root mean square distance, m, from points on each to the other."""
    import trimesh

    squares = []
    for here, there in ((one, other), (other, one)):
        sample = trimesh.sample.sample_surface(trimesh.Trimesh(here.vertices, here.faces, process=False), points, seed=0)[0]
        squares.append(np.square(Raycaster([there]).distances(sample)).mean())
    return float(np.sqrt(np.mean(squares)))
