"""Features that ship with the package: the silhouette as seen from a contact.

Every contour point is described in the frame of its own normal and tangent, so that no
picture is ever rotated; the mirrored reading of the reference gives the reflections.

* ``wide``: occupancy on a log-polar grid around the point, radii relative to the object's size.
* ``probe``: the same around the centre of the disc that touches the edge there, radii
  relative to the disc's.  The disc is the target (its radius at p_O), so this is the tool
  as the target meets it: whether it fits, from where it is embraced, where it could leave.
* ``bend``: signed curvature at scales relative to the size and to the disc.
* ``well``: how high the edge rises on either side before it falls below the contact, along
  the normal: the depth of the hollow in which the disc is held.
* ``fit``: the largest share of the disc's radius that finds room before the contact.
* ``gap``, ``drift``, ``press``, ``swing``: what becomes of the disc when it is pressed against the
  tool, or when the tool hangs from it (:mod:`magic_matcher.holding`).
* ``mass``, ``far``: where the centroid and the far end lie as seen from the contact.
* ``depth``: local thickness behind the contact, free way in front of it.

The dissimilarity is a weighted sum of the distances block by block (ring by ring for the
grids), each divided into "more than the reference" and "less than the reference" where
one of them may matter and the other not.  The weights are fitted by the training script
on procedural shapes (``python3 -m magic_matcher.train_embedded``); no block and no weight
belongs to a task or a category: every expected value is read off the reference contact.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.scene import CanonicalView
from magic_matcher import curvature, holding
from magic_matcher.contour import Contour
from magic_matcher.global_stage import GlobalMatch, Proposal, Reference, rotation_between, suppress

SECTORS = 24
WIDE_RADII = np.geomspace(0.03, 1.0, 7)
PROBE_RADII = np.array([0.55, 1.3, 1.8, 2.6, 3.8, 5.6])
BEND_SIZE = (0.04, 0.09, 0.18)
BEND_PROBE = (0.8, 1.6)
#: Without a target its radius is taken to be this share of the tool's size at least and at most.
PROBE_RANGE = (0.02, 0.15)
#: Contour points that are described; more do not find better places.
SAMPLES = 360
#: Two proposals are the same place if they are nearer than this share of the object's size.
SUPPRESSION = 0.08
#: similarity = exp(-CONTRAST w . d): the fit settles w . d only up to a factor, and the sum with s_curv needs one.  With 0.2
#: any lambda up to 0.15 leaves the order of clear cases alone and decides between near ones (docs/features.md).
CONTRAST = 0.2
#: What is less similar is no analogy, and from what on nothing better need be looked for: fitted to families of tools and of plain things
#: (``ros2 run magic_matcher bench --controls``, docs/features.md).
FLOOR, CLEAR = 0.33, 0.5


@dataclass(frozen=True)
class Description:
    """Descriptors of B contour points.

    wide (B, 7, 24), probe (B, 6, 24): occupancy 0..1, sector 0 along the outward normal,
    turning towards the tangent; scalars (B, S): values that a mirror leaves alone; sided
    (B, T, 2): pairs (left, right) that it swaps; lateral (B, U): values whose sign it turns.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    wide: NDArray[np.float32]
    probe: NDArray[np.float32]
    scalars: NDArray[np.float64]
    sided: NDArray[np.float64]
    lateral: NDArray[np.float64]


SCALARS = (
    *(f"bend {s} size" for s in BEND_SIZE),
    *(f"bend {s} probe" for s in BEND_PROBE),
    "mass along",
    "mass distance",
    "far along",
    "far distance",
    "thickness",
    "way, size",
    "way, probe",
    "well, shallower, probe",
    "well, shallower, size",
    "fit",
    "gap",
    "drift",
    "press, shallower",
    "press, deeper",
    "swing, shallower",
    "swing, deeper",
    "swing, start",
)
SIDED = ("well, probe", "well, size")
LATERAL = ("mass across", "far across")


def _sample_pyramid(
    contour: Contour, centres: NDArray[np.float64], normals: NDArray[np.float64], radii: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Occupancy (B, R, SECTORS) around centres (B, 2) at radii (R,) px, each ring in a picture blurred to its own coarseness."""
    soft = contour.soft
    # Normal and tangent turned through the sectors.
    angle = np.arange(SECTORS) * (2 * np.pi / SECTORS)
    cosine = normals[:, :1] * np.cos(angle) - normals[:, 1:] * np.sin(angle)
    sine = normals[:, 1:] * np.cos(angle) + normals[:, :1] * np.sin(angle)
    cosine, sine = cosine.astype(np.float32), sine.astype(np.float32)
    low, high = contour.points.min(axis=0), contour.points.max(axis=0)
    result = np.empty((len(centres), len(radii), SECTORS), np.float32)
    for ring, radius in enumerate(radii):
        sigma = float(np.clip(0.22 * radius, 0.6, 24.0))
        # Wide blurs are taken from a smaller picture: the blur has removed what that loses.
        step = int(max(1, 2 ** int(np.log2(max(sigma / 2.0, 1.0)))))
        # Beyond where the blur carries the object there is nothing; the cut keeps to the smaller picture's pixels.
        left, top = (max(0, int(a - 4 * sigma) // step * step) for a in low)
        right, bottom = (int(a + 4 * sigma) // step * step + step for a in high)
        cut = np.ascontiguousarray(soft[top:bottom, left:right])
        picture = cv2.resize(cut, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA) if step > 1 else cut
        picture = cv2.GaussianBlur(picture, (0, 0), max(sigma / step, 0.5), borderType=cv2.BORDER_CONSTANT)
        u = cosine * np.float32(radius / step)
        u += ((centres[:, 0:1] - left + 0.5) / step - 0.5).astype(np.float32)
        v = sine * np.float32(radius / step)
        v += ((centres[:, 1:2] - top + 0.5) / step - 0.5).astype(np.float32)
        result[:, ring] = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return result


def _wells(contour: Contour, indices: NDArray[np.int64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth (B, 2) px of the hollow to the left and right of the contact: the highest rise along
    the normal on the walk along the edge before it falls below the contact."""
    result = np.zeros((len(indices), 2))
    tolerance = np.float32(0.015 * contour.size)
    u, v, _, _ = contour.flat
    out = normals.astype(np.float32)
    for loop in np.unique(contour.loop[indices]):
        rows = np.nonzero(contour.loop[indices] == loop)[0]
        start, length = int(contour.starts[loop]), int(contour.lengths[loop])
        stride = max(1, length // 360)
        steps = np.arange(0, length, stride)
        here = indices[rows]
        # The loop twice, so that a walk once around from anywhere needs no turning back.
        twice = slice(start, start + length)
        u2, v2 = np.concatenate([u[twice], u[twice]]), np.concatenate([v[twice], v[twice]])
        level = (u[here] * out[rows, 0] + v[here] * out[rows, 1])[:, None]
        for side, sign in enumerate((1, -1)):
            walk = (here - start if sign > 0 else here - start + length)[:, None] + sign * steps
            height = u2[walk]
            height *= out[rows, :1]
            height += v2[walk] * out[rows, 1:]
            height -= level
            fallen = np.argmax(height < -tolerance, axis=1)
            fallen = np.where(fallen > 0, fallen, len(steps))
            height[np.arange(len(steps)) >= fallen[:, None]] = 0.0
            result[rows, side] = np.maximum(height.max(axis=1), 0.0)
    return result


def _fit(around: holding.Room, points: NDArray[np.float64], normals: NDArray[np.float64], probe: float) -> NDArray[np.float64]:
    """Share (B,) of the disc's radius that is free before the contact, 0..1.

    The disc need not touch the very point: in a sharp corner its centre stands off by
    more than its radius, sqrt(2) times in a right angle.
    """
    best = np.max([around.at(points + step * probe * normals) for step in (1.0, 1.2, 1.45)], axis=0)
    return np.clip((best + 1.0) / probe, 0.0, 1.0)


def describe(contour: Contour, indices: NDArray[np.int64], normals: NDArray[np.float64], probe: float) -> Description:
    """Describe contour points (B,) with their normals (B, 2); ``probe`` is the disc's radius in pixels."""
    size = contour.size
    points = contour.points[indices]
    left = np.column_stack([-normals[:, 1], normals[:, 0]])
    wide = _sample_pyramid(contour, points, normals, WIDE_RADII * size)
    around = _sample_pyramid(contour, points + probe * normals, normals, PROBE_RADII * probe)
    bends = []
    for scale in (*(s * size for s in BEND_SIZE), *(s * probe for s in BEND_PROBE)):
        scale = float(np.clip(scale, 4.0, 0.5 * size))
        bends.append(np.tanh(curvature.curvature_map(contour, indices, scale)[0] * scale))
    mass = contour.centroid - points
    # The farthest of the contour's points: |q|^2 - 2 p q is greatest for it.
    spread = contour.points[:: max(1, len(contour.points) // 200)]
    away = spread - contour.centroid
    far = spread[np.argmax(np.sum(away * away, axis=1) - 2 * (points - contour.centroid) @ away.T, axis=1)] - points
    thickness = curvature.clearance(contour, points, -normals, 0.5 * size, 96)
    way = curvature.clearance(contour, points, normals, 0.7 * size, 96)
    wells = _wells(contour, indices, normals)
    shallow = wells.min(axis=1)
    around_tool = holding.room(contour, probe)
    held = holding.hold(contour, points, normals, probe, around_tool)
    scalars = np.column_stack(
        [
            *bends,
            np.sum(mass * normals, axis=1) / size,
            np.hypot(*mass.T) / size,
            np.sum(far * normals, axis=1) / size,
            np.hypot(*far.T) / size,
            np.log(thickness / size + 0.02),
            np.log(way / size + 0.02),
            np.tanh(way / (4 * probe)),
            np.tanh(shallow / (1.5 * probe)),
            np.tanh(shallow / (0.15 * size)),
            _fit(around_tool, points, normals, probe),
            np.tanh(np.minimum(held.gap, 9.0)),
            np.tanh(np.minimum(held.drift, 9.0)),
            np.tanh(held.press / 0.8),
            np.tanh(held.swing / 0.8),
            np.tanh(held.start / 0.8),
        ]
    )
    sided = np.stack([np.tanh(wells / (1.5 * probe)), np.tanh(wells / (0.15 * size))], axis=1)
    lateral = np.column_stack([np.sum(mass * left, axis=1), np.sum(far * left, axis=1)]) / size
    return Description(points, normals, wide, around, scalars, sided, lateral)


def _mirror_sectors(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    return grid[..., (-np.arange(SECTORS)) % SECTORS]


def _sides(difference: NDArray[np.float64]) -> NDArray[np.float64]:
    """(B, S) differences as (B, 2 S): how much more and how much less than the reference."""
    return np.concatenate([np.maximum(difference, 0), np.maximum(-difference, 0)], axis=1)


DISTANCES = (
    *(f"wide {r:.2f}" for r in WIDE_RADII),
    *(f"probe {r:.2f} more" for r in PROBE_RADII),
    *(f"probe {r:.2f} less" for r in PROBE_RADII),
    *(f"{n} more" for n in SCALARS),
    *(f"{n} less" for n in SCALARS),
    *(f"{n}, sides, more" for n in SIDED),
    *(f"{n}, sides, less" for n in SIDED),
    *LATERAL,
)


def distances(reference: Description, found: Description, flipped: bool) -> NDArray[np.float64]:
    """Distances (B, len(DISTANCES)) of described points from the one reference point, mirrored or not."""
    wide, probe = reference.wide[0], reference.probe[0]
    sided, lateral = reference.sided[0], reference.lateral[0]
    if flipped:
        wide, probe, sided, lateral = _mirror_sectors(wide), _mirror_sectors(probe), sided[:, ::-1], -lateral
    in_probe = found.probe - probe
    return np.concatenate(
        [
            np.abs(found.wide - wide).mean(axis=2),
            np.maximum(in_probe, 0).mean(axis=2),
            np.maximum(-in_probe, 0).mean(axis=2),
            _sides(found.scalars - reference.scalars[0]),
            np.maximum(found.sided - sided, 0).sum(axis=2),
            np.maximum(sided - found.sided, 0).sum(axis=2),
            np.abs(found.lateral - lateral),
        ],
        axis=1,
    )


def default_weights() -> NDArray[np.float64]:
    """Weights (len(DISTANCES),) by hand, for the training to start from."""
    weights = dict.fromkeys(DISTANCES, 1.0)
    for name in DISTANCES:
        if name.startswith("wide"):
            weights[name] = 2.0
        elif name.startswith("probe"):
            weights[name] = 3.0
        elif name.startswith("bend"):
            weights[name] = 0.6
        elif name.startswith(("thickness", "way")):
            weights[name] = 0.15
        elif name.startswith(("press", "swing", "gap", "drift")):
            weights[name] = 0.1
        elif "well" in name:
            weights[name] = 0.5 if "less" in name else 0.1
    return np.array([weights[name] for name in DISTANCES])


@lru_cache(maxsize=32)
def weights(without: str = "") -> NDArray[np.float64]:
    """The fitted weights that ship with the package; ``without``: those whose fit never saw that family of shapes, for the bench."""
    name = "embedded_left_out.json" if without else "embedded_weights.json"
    path = resources.files("magic_matcher").joinpath(name)
    if not path.is_file():
        return default_weights()
    table = json.loads(path.read_text())["weights"]
    table = table.get(without, {}) if without else table
    return np.array([float(table[name]) for name in DISTANCES]) if table else default_weights()


def probe_radius(radius: float | None, size: float, fallback: float) -> float:
    """The disc's radius in pixels: the target's, else ``fallback`` (a share of the size), held within what a grid can show."""
    value = radius if radius is not None and np.isfinite(radius) else fallback * size
    return float(np.clip(value, 2.5, 0.3 * size))


@dataclass(frozen=True)
class Prepared:
    """The reference's description, its normal, and the share of its size that stands in for an unknown target radius."""

    description: Description
    normal: NDArray[np.float64]
    share: float


class EmbeddedFeatures:
    """Silhouette descriptors in contour frames; needs no weights to download, no GPU, about 20 ms a tool."""

    name = "embedded"
    floor = FLOOR
    clear = CLEAR

    def __init__(self, weight: NDArray[np.float64] | None = None) -> None:
        self._weights = weights() if weight is None else np.asarray(weight, dtype=float)

    def key(self) -> str:
        """Name of this backend and its weights."""
        return "embedded-" + hashlib.sha256(self._weights.tobytes()).hexdigest()[:16]

    def prepare(self, reference: Reference) -> Prepared:
        """Describe the reference contact."""
        size = reference.contour.size
        share = float(np.clip(min(reference.radius, size) / size, *PROBE_RANGE))
        index = np.array([reference.contour.nearest(reference.pixel)])
        probe = probe_radius(reference.target_radius, size, share)
        return Prepared(describe(reference.contour, index, reference.normal[None], probe), reference.normal, share)

    def dissimilarities(self, prepared: Prepared, contour: Contour, target_radius: float | None) -> tuple[Description, NDArray[np.float64]]:
        """Descriptions of the sampled contour points and their distances (2, B, D) to the reference, kept and mirrored."""
        stride = max(1, len(contour.points) // SAMPLES)
        indices = np.arange(0, len(contour.points), stride)
        found = describe(contour, indices, contour.normals[indices], probe_radius(target_radius, contour.size, prepared.share))
        return found, np.stack([distances(prepared.description, found, flipped) for flipped in (False, True)])

    def propose(
        self, prepared: Prepared, view: CanonicalView, contour: Contour, target_radius: float | None, count: int, heatmap: bool = False
    ) -> GlobalMatch:
        """The ``count`` best contour points, apart from each other; similarity = exp(-CONTRAST * weighted distance)."""
        found, parts = self.dissimilarities(prepared, contour, target_radius)
        similarity = np.exp(-CONTRAST * (parts @ self._weights))
        flipped = similarity[1] > similarity[0]
        best = similarity.max(axis=0)
        chosen = suppress(found.points, best, SUPPRESSION * contour.size, count)
        proposals = tuple(
            Proposal(
                found.points[i], rotation_between(prepared.normal, found.normals[i], bool(flipped[i])), bool(flipped[i]), float(best[i])
            )
            for i in chosen
        )
        return GlobalMatch(proposals, paint(view.mask, found.points, best) if heatmap else None)


def paint(mask: NDArray[np.bool_], points: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float32]:
    """A heat map (H, W) in 0..1 from values at contour points (N, 2), fading with the distance from them; 0 off the mask."""
    height, width = mask.shape
    low, high = float(np.min(values)), float(np.max(values))
    heat = (values - low) / max(high - low, 1e-12)
    picture = np.zeros((height, width), np.float32)
    u = np.clip(np.rint(points[:, 0]).astype(int), 0, width - 1)
    v = np.clip(np.rint(points[:, 1]).astype(int), 0, height - 1)
    np.maximum.at(picture, (v, u), heat.astype(np.float32))
    reach = max(3, int(0.02 * max(height, width))) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    picture = cv2.GaussianBlur(cv2.dilate(picture, kernel), (0, 0), reach / 3)
    return np.where(mask, np.clip(picture, 0, 1), 0).astype(np.float32)
