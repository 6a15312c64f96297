"""The global stage on feature maps of a network (paper, III-B).

The paper looks at the new tool in 24 views (12 rotations, each kept and mirrored) and at
the reference in one.  Only the relative view matters, so here the reference is turned
and mirrored instead, once for a strategy, and a new tool costs one pass.  ``literal=True``
does it the paper's way; a test compares the two.

Joint PCA: W is fitted to the tokens of the reference's views and of the new tool
together.  The reference's share of mean and covariance is kept with it, so that only the
new tool's tokens are added.

Patch-aggregated similarity, tokens scaled to length one after the PCA:

* ``pairs`` (the paper's formula): the sum over all pairs of the two m x m patches factors,
  sum_p sum_p' <f(p), f'(p')> = <sum_p f(p), sum_p' f'(p')>, into two box sums; divided by
  the number of pairs.
* ``aligned`` (the authors' code): the mean over offsets of <f(p_T + o), f'(p' + o)>.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView
from magic_matcher.contour import Contour
from magic_matcher.global_stage import GlobalMatch, Proposal, Reference, suppress

ROTATIONS = 12
#: Side of the patch as a share of the token grid (13 of 60 in the authors' code), and d'.
PATCH_SHARE, COMPONENTS = 13 / 60, 256
AGGREGATIONS = ("aligned", "pairs", "none")
#: A token counts as lying on the object if at least this share of it does.
ON_OBJECT = 0.3

#: Feature maps (V, n, n, d) float32 of pictures (V, S, S, 3) uint8.
Extract = Callable[[NDArray[np.uint8]], NDArray[np.float32]]


@dataclass(frozen=True)
class Views:
    """rotation (V,) radians and flipped (V,) of the views; a direction d of the picture appears as R(rotation) F d."""

    rotation: NDArray[np.float64]
    flipped: NDArray[np.bool_]

    @staticmethod
    def all(rotations: int = ROTATIONS, reflections: bool = True) -> Views:
        """``rotations`` turns, kept and mirrored."""
        angle = np.arange(rotations) * (2 * np.pi / rotations)
        if not reflections:
            return Views(angle, np.zeros(rotations, bool))
        return Views(np.concatenate([angle, angle]), np.repeat([False, True], rotations))


@dataclass(frozen=True)
class PreparedGlobal:
    """What is kept of a reference.

    patches (V, m, m, d) float32 raw tokens around the contact in each view, inside (V, m,
    m) which of them exist; mean (d,), scatter (d, d) and count of all the views' tokens.
    """

    patches: NDArray[np.float32]
    inside: NDArray[np.bool_]
    mean: NDArray[np.float64]
    scatter: NDArray[np.float64]
    count: int
    views: Views


def view_matrix(rotation: float, flipped: bool, centre: NDArray[np.float64], out: int, scale: float) -> NDArray[np.float64]:
    """The affine map (2, 3) from picture pixels to those of a turned, mirrored, square view of side ``out``."""
    c, s = np.cos(rotation), np.sin(rotation)
    linear = scale * np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if flipped else 1.0, 1.0])
    return np.column_stack([linear, np.full(2, (out - 1) / 2) - linear @ centre])


def frame(mask: NDArray[np.bool_], out: int, fill: float = 0.9) -> tuple[NDArray[np.float64], float]:
    """Centre (2,) and scale that put the object into a square of side ``out`` so that no turn cuts it off.

    The same for every turn, so that a tool and its turned copy are seen at one size.
    """
    rows = np.nonzero(mask.any(axis=1))[0]
    if len(rows) == 0:
        raise MagicError(Code.EMPTY_MASK, "pixels of the mask that are on the object", 0, "at least 16")
    # Each row's first and last pixel: no other can be the farthest.
    first, last = np.argmax(mask[rows], axis=1), mask.shape[1] - 1 - np.argmax(mask[rows, ::-1], axis=1)
    corners = np.column_stack([np.concatenate([first, last]), np.concatenate([rows, rows])]).astype(float)
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.hypot(*(corners - centre).T).max()) + 1.0
    return centre, fill * out / (2 * radius)


def draw(view: CanonicalView, views: Views, out: int) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
    """Masked pictures (V, out, out, 3), masks (V, out, out) 0..1 and affine maps (V, 2, 3) of the views."""
    centre, scale = frame(view.mask, out)
    soft = view.mask.astype(np.float32)
    image = cv2.bitwise_and(view.image, view.image, mask=view.mask.view(np.uint8))
    pictures, masks, maps = [], [], []
    for rotation, flipped in zip(views.rotation, views.flipped, strict=True):
        matrix = view_matrix(float(rotation), bool(flipped), centre, out, scale)
        pictures.append(cv2.warpAffine(image, matrix, (out, out), flags=cv2.INTER_LINEAR))
        masks.append(cv2.warpAffine(soft, matrix, (out, out), flags=cv2.INTER_LINEAR))
        maps.append(matrix)
    return np.stack(pictures), np.stack(masks), np.stack(maps)


def token_of(matrix: NDArray[np.float64], pixel: NDArray[np.float64], out: int, n: int) -> NDArray[np.int64]:
    """Row and column (2,) of the token under a picture pixel seen through an affine map."""
    u, v = matrix[:, :2] @ pixel + matrix[:, 2]
    cell = out / n
    return np.clip(np.floor(np.array([v + 0.5, u + 0.5]) / cell).astype(int), 0, n - 1)


def patch_side(n: int, share: float = PATCH_SHARE) -> int:
    """Side m of the patch in tokens, odd, for a grid of side n."""
    return max(1, int(round(share * n)) // 2 * 2 + 1)


def pairs_similarity(patch: NDArray[np.float32], inside: NDArray[np.bool_], features: NDArray[np.float32]) -> NDArray[np.float32]:
    """The paper's s_dino at every token: the mean over all pairs of a patch's and the neighbourhood's tokens.

    Patches (V, m, m, d) against a map (n, n, d) -> (V, n, n), or one patch (m, m, d) -> (n, n).
    """
    if patch.ndim == 3:
        return pairs_similarity(patch[None], inside[None], features)[0]
    m = patch.shape[1]
    directions = np.einsum("vrcd,vrc->vd", patch, inside.astype(np.float32))
    # One product and one box sum for all views: the sum over the neighbourhood is linear.
    response = np.ascontiguousarray(features @ directions.T)
    total = cv2.boxFilter(response, -1, (m, m), normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(np.ones(response.shape[:2], np.float32), -1, (m, m), normalize=False, borderType=cv2.BORDER_CONSTANT)
    here = np.maximum(inside.sum(axis=(1, 2)), 1).astype(np.float32)
    return total.reshape(response.shape).transpose(2, 0, 1) / (count * here[:, None, None])


def aligned_similarity(patches: NDArray[np.float32], inside: NDArray[np.bool_], features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean cosine at aligned positions (V, n, n) for patches (V, m, m, d) against a map (n, n, d)."""
    import torch

    m, n = patches.shape[1], features.shape[0]
    with torch.inference_mode():
        kept = np.ascontiguousarray(inside.reshape(-1), dtype=np.float32)
        tokens = torch.from_numpy(np.ascontiguousarray(patches.reshape(-1, patches.shape[-1]))) * torch.from_numpy(kept)[:, None]
        # All cosines at once, then each offset's plane is shifted to where it belongs: quicker than a convolution of so many channels.
        cosines = (tokens @ torch.from_numpy(np.ascontiguousarray(features.reshape(-1, features.shape[-1]))).T).reshape(-1, m, m, n, n)
        half = m // 2
        total = torch.zeros(len(patches), n + 2 * half, n + 2 * half)
        there = torch.zeros_like(total)
        exists = torch.from_numpy(inside.astype(np.float32))
        for r in range(m):
            for c in range(m):
                # Token r, c of the patch under token y, x of the map: the patch's middle lies at y - r + half, x - c + half.
                at = (slice(None), slice(2 * half - r, 2 * half - r + n), slice(2 * half - c, 2 * half - c + n))
                total[at] += cosines[:, r, c]
                there[at] += exists[:, r, c, None, None]
        total, there = (a[:, half : half + n, half : half + n] for a in (total, there))
        # A neighbourhood that the border cuts to a few tokens would win by chance: at least half of the patch counts.
        floor = exists.sum(dim=(1, 2))[:, None, None] / 2
        return (total / torch.maximum(there, floor).clamp(min=1)).numpy()


def _patches(maps: NDArray[np.float32], tokens: NDArray[np.int64], m: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Patches (V, m, m, d) of feature maps (V, n, n, d) around tokens (V, 2), and which of their cells exist."""
    half = m // 2
    padded = np.pad(maps, ((0, 0), (half, half), (half, half), (0, 0)))
    exists = np.pad(np.ones(maps.shape[:3], bool), ((0, 0), (half, half), (half, half)))
    cut = [(k, slice(r, r + m), slice(c, c + m)) for k, (r, c) in enumerate(tokens)]
    return np.stack([padded[c] for c in cut]), np.stack([exists[c] for c in cut])


def _moments(tokens: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Mean (d,), scatter matrix about the mean (d, d) and number of tokens (N, d)."""
    import torch

    with torch.inference_mode():
        mean = tokens.mean(axis=0, dtype=np.float64)
        centred = torch.from_numpy(tokens - mean.astype(np.float32))
        return mean, (centred.T @ centred).numpy().astype(np.float64), len(tokens)


def joint_pca(prepared: PreparedGlobal, tokens: NDArray[np.float32], components: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean (d,) and W (d, d') of the reference's tokens and new ones (N, d) together."""
    import torch

    mean, scatter, count = _moments(tokens)
    total = prepared.count + count
    shift = mean - prepared.mean
    joint = prepared.mean + shift * (count / total)
    covariance = (prepared.scatter + scatter + np.outer(shift, shift) * (prepared.count * count / total)) / total
    with torch.inference_mode():
        _values, vectors = torch.linalg.eigh(torch.from_numpy(covariance.astype(np.float32)))
    kept = vectors.numpy()[:, ::-1][:, : min(components, len(covariance))]
    return joint.astype(np.float32), np.ascontiguousarray(kept)


def _project(tokens: NDArray[np.float32], mean: NDArray[np.float32], w: NDArray[np.float32]) -> NDArray[np.float32]:
    """(tokens - mean) W for tokens (..., d)."""
    import torch

    with torch.inference_mode():
        flat = torch.from_numpy(np.ascontiguousarray(tokens.reshape(-1, tokens.shape[-1])))
        return torch.addmm(torch.from_numpy(-(mean @ w)), flat, torch.from_numpy(w)).numpy().reshape(*tokens.shape[:-1], -1)


def unit(tokens: NDArray[np.float32]) -> NDArray[np.float32]:
    """Tokens (..., d) scaled to length one."""
    length = np.sqrt(np.einsum("...d,...d->...", tokens, tokens))
    return tokens / np.maximum(length, 1e-9)[..., None]


def prepare(view: CanonicalView, pixel: NDArray[np.float64], extract: Extract, out: int, views: Views) -> PreparedGlobal:
    """Features of a reference in all ``views``: patches around the contact, and the moments for the joint PCA."""
    pictures, _, matrices = draw(view, views, out)
    maps = extract(pictures)
    n = maps.shape[1]
    tokens = np.stack([token_of(matrix, pixel, out, n) for matrix in matrices])
    patches, inside = _patches(maps, tokens, patch_side(n, PATCH_SHARE))
    mean, scatter, count = _moments(maps.reshape(-1, maps.shape[-1]))
    return PreparedGlobal(patches, inside, mean, scatter, count, views)


def similarity(prepared: PreparedGlobal, features: NDArray[np.float32], aggregation: str, components: int | None) -> NDArray[np.float32]:
    """s_dino (V, n, n) of every relative view at every token of the new tool's map (n, n, d).

    components=None leaves the PCA out, aggregation ``none`` compares single tokens (the ablation of Table III).
    """
    if aggregation not in AGGREGATIONS:
        raise MagicError(Code.BAD_REQUEST, "aggregation", aggregation, AGGREGATIONS)
    patches, inside = prepared.patches, prepared.inside
    if components is not None:
        mean, w = joint_pca(prepared, features.reshape(-1, features.shape[-1]), components)
        patches, features = _project(patches, mean, w), _project(features, mean, w)
    patches, features = unit(patches), unit(features)
    if aggregation == "aligned":
        return aligned_similarity(patches, inside, features)
    if aggregation == "none":
        half = patches.shape[1] // 2
        return np.einsum("vd,rcd->vrc", patches[:, half, half], features)
    return pairs_similarity(patches, inside, features)


def propose(
    prepared: PreparedGlobal,
    view: CanonicalView,
    extract: Extract,
    out: int,
    count: int,
    aggregation: str = "aligned",
    components: int | None = COMPONENTS,
    heatmap: bool = False,
    literal: CanonicalView | None = None,
    literal_pixel: NDArray[np.float64] | None = None,
) -> GlobalMatch:
    """The ``count`` best places on a new tool, apart from each other and never on the background.

    One pass of the network.  With ``literal`` (the reference view) and its pixel, the
    paper's way instead: the new tool in every view, each matched with the upright reference.
    """
    if literal is not None and literal_pixel is not None:
        scores, on, to_picture, views = _literal(prepared, view, extract, out, aggregation, components, literal, literal_pixel)
    else:
        upright = Views(np.zeros(1), np.zeros(1, bool))
        pictures, masks, matrices = draw(view, upright, out)
        maps = extract(pictures)
        scores = similarity(prepared, maps[0], aggregation, components)
        on, to_picture, views = _coverage(masks[0], maps.shape[1])[None], cv2.invertAffineTransform(matrices[0])[None], prepared.views
    scores = np.where(on, scores, -np.inf)
    n = scores.shape[1]
    if not np.isfinite(scores).any():
        raise MagicError(Code.EMPTY_MASK, "tokens of the network's map that lie on the object", 0, "at least one")
    # Where all relative views are seen in one picture a token is the same place in all of them: only its best view counts.
    best = np.argmax(scores, axis=0) if len(to_picture) == 1 else None
    ranked = scores if best is None else np.take_along_axis(scores, best[None], axis=0)
    centres = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1) + 0.5) * (out / n) - 0.5
    points = np.einsum("vij,rcj->vrci", to_picture[:, :, :2], centres) + to_picture[:, None, None, :, 2]
    rows, columns = (np.nonzero(view.mask.any(axis=axis))[0] for axis in (1, 0))
    size = float(np.hypot(rows[-1] - rows[0], columns[-1] - columns[0]))
    flat_scores, flat_points = ranked.reshape(-1), points.reshape(-1, 2)
    chosen = suppress(flat_points, flat_scores, 0.1 * size, count)
    which = [c // (n * n) if best is None else int(best.flat[c]) for c in chosen]
    proposals = tuple(
        Proposal(flat_points[c], float(views.rotation[k]), bool(views.flipped[k]), float(flat_scores[c]))
        for c, k in zip(chosen, which, strict=True)
    )
    heat = None
    if heatmap:
        v = which[0]
        grid = np.where(np.isfinite(scores[v]), scores[v], np.nan)
        low, high = float(np.nanmin(grid)), float(np.nanmax(grid))
        grid = np.nan_to_num((grid - low) / max(high - low, 1e-9)).astype(np.float32)
        large = cv2.resize(grid, (out, out), interpolation=cv2.INTER_LINEAR)
        height, width = view.mask.shape
        heat = cv2.warpAffine(large, np.ascontiguousarray(to_picture[v if best is None else 0]), (width, height), flags=cv2.INTER_LINEAR)
        heat = np.where(view.mask, np.clip(heat, 0, 1), 0).astype(np.float32)
    return GlobalMatch(proposals, heat)


def _coverage(mask: NDArray[np.float32], n: int) -> NDArray[np.bool_]:
    """Which tokens (n, n) lie on the object; where it is thinner than that everywhere, those with the most of it."""
    share = cv2.resize(mask, (n, n), interpolation=cv2.INTER_AREA)
    return share >= min(ON_OBJECT, 0.5 * float(share.max()) + 1e-6)


def _literal(
    prepared: PreparedGlobal,
    view: CanonicalView,
    extract: Extract,
    out: int,
    aggregation: str,
    components: int | None,
    reference: CanonicalView,
    pixel: NDArray[np.float64],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float64], Views]:
    """The new tool in all views against the upright reference.

    A view that turns the tool by R(a) F shows what the reference turned by its inverse would
    show upright: unmirrored R(-a), mirrored F R(-a) = R(a) F.
    """
    views = prepared.views
    pictures, masks, matrices = draw(view, views, out)
    maps = extract(pictures)
    n = maps.shape[1]
    upright = Views(np.zeros(1), np.zeros(1, bool))
    shown, _, back = draw(reference, upright, out)
    first = extract(shown)
    tokens = token_of(back[0], pixel, out, n)[None]
    patches, inside = _patches(first, tokens, prepared.patches.shape[1])
    mean, scatter, count = _moments(np.concatenate([first, maps[1:]]).reshape(-1, first.shape[-1]))
    alone = PreparedGlobal(patches, inside, mean, scatter, count, upright)
    scores = np.concatenate([similarity(alone, m, aggregation, components) for m in maps])
    on = np.stack([_coverage(m, n) for m in masks])
    relative = Views(np.where(views.flipped, views.rotation, -views.rotation) % (2 * np.pi), views.flipped)
    return scores, on, np.stack([cv2.invertAffineTransform(m) for m in matrices]), relative


class NetworkFeatures:
    """What backends on feature maps of a network share; each brings ``size``, ``aggregation``, ``components``, ``_views`` and
    :meth:`extract`."""

    # Cosines after a joint PCA have no common scale; none was fitted, as no trained weights could be reached.
    floor = 0.0
    clear = float("inf")
    size: int
    aggregation: str
    components: int | None
    _views: Views

    def extract(self, pictures: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Feature maps (V, n, n, d) of pictures (V, S, S, 3) uint8 RGB, S = self.size."""
        raise NotImplementedError

    def prepare(self, reference: Reference) -> PreparedGlobal:
        """The reference's 24 views through the network, once."""
        return prepare(reference.view, reference.pixel, self.extract, self.size, self._views)

    def propose(
        self, prepared: Any, view: CanonicalView, contour: Contour, target_radius: float | None, count: int, heatmap: bool = False
    ) -> GlobalMatch:
        """One pass of the network, then the best places over all relative views."""
        return propose(prepared, view, self.extract, self.size, count, self.aggregation, self.components, heatmap)


def state_of(weights: str) -> str:
    """A text that differs where weights do: their name, and for a folder its files with their sizes and times."""
    folder = Path(weights)
    files = sorted(path for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else []
    return " ".join([weights, *(f"{path.resolve()} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files)])
