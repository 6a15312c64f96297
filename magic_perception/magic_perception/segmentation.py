"""Which pixels belong to which thing on the table.

A segmenter maps frames and the table to instance labels.  ``depth`` needs no weights: what stands above the
table, helped by the table's own colour where depth is too coarse (a 4 mm hook) or missing (a handle's edge).
``sam`` and ``sam2`` (module :mod:`magic_perception.sam`) refine its masks.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magic_core.mesh import Mesh
from magic_core.workers import Workers
from magic_perception import attached, between, convexity, cuts
from magic_perception.behind_one import behind_one
from magic_perception.clustered import Clusters, Surfaces, clustered, surfaces
from magic_perception.labels import beside, fill, sizeable, with_depth
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.seams import Judge, learned
from magic_perception.surface_edges import on_surfaces


class Segmenter(Protocol):
    """Anything that labels instances."""

    name: str

    def segment(self, looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> list[NDArray[np.int32]]:
        """Labels (H, W) int32 for each look: 0 none, i >= 1 the same thing in all cameras, -1 a known object."""


class DepthSegmenter:
    """Table plane, table colour, clusters: no weights but those of a few criteria of seams and of upright planes.

    judge, cut: what tells whether a seam parts two things, and whether an upright plane does, instead of the weights that ship with the
    package.
    workers: processes that look at a part of the pictures.
    """

    name = "depth"

    def __init__(self, judge: Judge | None = None, cut: cuts.Judge | None = None, workers: Workers | None = None) -> None:
        self._judge = judge or learned()
        self._cut = cut or cuts.learned()
        self._workers = workers

    def segment(self, looks: list[Looked], known: tuple[Mesh, ...], parameters: Parameters) -> list[NDArray[np.int32]]:
        """See :class:`Segmenter`."""
        found = clustered(looks, known, parameters, self._workers)
        instance = found.instance
        if parameters.split:
            seen = surfaces(looks, found)
            instance = cuts.parted(looks, found, uncut(looks, found, seen, self._judge, parameters), self._cut, self._workers)
            instance = _borne(looks, found, seen, instance, self._judge)
        labels = []
        start = 0
        for mask, where in zip(found.masks, found.spots, strict=True):
            image = np.zeros(mask.shape, np.int32)
            image[where] = instance[start : start + len(where[0])] + 1
            start += len(where[0])
            labels.append(fill(image, mask))
        # What is too small for a thing and hangs together with one in the mask belongs to it: depth is not to be trusted there.
        labels = [fill(image, mask) for image, mask in zip(sizeable(labels, looks, parameters), found.masks, strict=True)]
        labels = with_depth(labels, looks, parameters)
        for image, mask, fixed, looked in zip(labels, found.masks, found.fixed, looks, strict=True):
            image[fixed | beside(fixed, mask & (image == 0) & ~np.isfinite(looked.frame.depth))] = -1
        labels = behind_one(_attached(labels, looks, parameters), looks, parameters)
        return [on_surfaces(image, looked) for image, looked in zip(labels, looks, strict=True)]


def uncut(looks: list[Looked], found: Clusters, seen: Surfaces, judge: Judge, parameters: Parameters) -> NDArray[np.int64]:
    """The instances (N,) parted at the seams between things and where the table shows between them, before :mod:`magic_perception.cuts`."""
    return between.parted(looks, found, _parted(found, seen, judge), parameters.min_pixels)


def _parted(found: Clusters, seen: Surfaces, judge: Judge) -> NDArray[np.int64]:
    """The instances (N,) with tall clusters parted at the seams between things."""
    instance = found.instance.copy()
    following = int(instance.max(initial=-1)) + 1
    for mine in seen.tall:
        part = convexity.parts(
            found.cloud[mine], seen.normal[mine], seen.heights[mine], seen.rgb[mine], judge, across=found.bridges.among(mine)
        )
        for number in range(1, int(part.max()) + 1):
            instance[mine[part == number]] = following
            following += 1
    instance = convexity.insides(found.cloud, seen.normal, instance, seen.heights)
    return convexity.with_handles(found.cloud, seen.normal, instance, seen.heights, seen.rgb)


def _borne(looks: list[Looked], found: Clusters, seen: Surfaces, instance: NDArray[np.int64], judge: Judge) -> NDArray[np.int64]:
    """The instances (N,) with those parted of which one thing stands on another's level face; what a hand holds over a face does not."""
    held = np.concatenate(
        [
            np.zeros(len(where[0]), bool) if look.frame.held is None else look.frame.held[where] > 0
            for look, where in zip(looks, found.spots, strict=True)
        ]
    )
    result = instance.copy()
    for number in np.setdiff1d(np.arange(int(instance.max(initial=-1)) + 1), instance[held]):
        mine = np.nonzero(instance == number)[0]
        part = convexity.parts(found.cloud[mine], seen.normal[mine], seen.heights[mine], seen.rgb[mine], judge, convexity.on_tops)
        result[mine[part > 0]] = result.max() + part[part > 0]
    # Of a mug that stood so, seams may have parted the inside before.
    return instance if np.array_equal(result, instance) else convexity.insides(found.cloud, seen.normal, result, seen.heights)


def _attached(labels: list[NDArray[np.int32]], looks: list[Looked], parameters: Parameters) -> list[NDArray[np.int32]]:
    """Labels with the parts of one thing joined that depth or a seam has parted (:mod:`magic_perception.attached`)."""
    owner = attached.owners(labels, looks)
    if np.array_equal(owner, np.arange(len(owner))):
        return labels
    owner = np.append(owner, -1)
    return sizeable([owner[image] for image in labels], looks, parameters)
