"""Where on a mesh a contact lies: the point in 3D, the surface's normal there, and its two principal curvatures.

A silhouette tells a contact in its picture's plane.  The line of sight through it grazes the surface; half way through the
material just inside of it is how deep the contact lies (:func:`depth_of_edge`).  Around that point the surface is a height
over the plane across its normal, sampled by rays, and a polynomial of the fourth degree is fitted to it; its second
derivatives give the principal curvatures (:func:`principal_frame`).  The fourth degree takes up what a quadric alone would
mistake for curvature on a patch that is not small against the radius.  The patch is the largest that the polynomial explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_core.scene import CanonicalView

#: Radii of the patches, as shares of the mesh's size (the diagonal of its box), and their number.
SMALLEST, LARGEST, PATCHES = 0.003, 0.12, 11
#: Samples across a patch; those needed for the fit's fifteen unknowns.
ACROSS, ENOUGH = 17, 60
#: A patch is explained where this share of its radius is left, root mean square, at most.
LEFT = 0.01
#: Nor is it larger than this share of the smaller radius of curvature: wider arcs are steep at their ends.
ARC = 0.55
#: What is turned away farther than this (cosine) belongs to another side; a patch whose kept part is
#: narrower than this share of it says nothing.
SAME_SIDE, WIDTH = 0.5, 0.6
#: How far inside of the edge the line of sight is looked along, px.
INSIDE = (1.5, 0.75, 3.0)
#: Principal curvatures nearer than this share of the larger one have no directions of their own.
UMBILIC = 0.05


@dataclass(frozen=True)
class PrincipalFrame:
    """A point of a surface with its principal (Darboux) frame.

    object_from_surface (4, 4): origin on the surface, x the outward normal, y and z the principal directions, y the one nearer
    to the picture's plane; curvatures (2,) 1/m along y and z, positive where convex; reach: radius in metres of the patch that
    they were fitted to; residue: what the fit leaves, root mean square, m.
    """

    object_from_surface: NDArray[np.float64]
    curvatures: NDArray[np.float64]
    reach: float
    residue: float

    @property
    def radii(self) -> NDArray[np.float64]:
        """(2,) m, inf where flat."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.abs(self.curvatures))


class Surface:
    """A mesh, ready to be asked where contacts lie on it."""

    def __init__(self, mesh: Mesh) -> None:
        self._caster = Raycaster([mesh])
        self.size = float(np.linalg.norm(mesh.extents))

    def depth_of_edge(self, view: CanonicalView, pixel: ArrayLike, normal: ArrayLike) -> float | None:
        """How far behind the view's plane, m, the surface lies at a pixel (2,) of its silhouette's edge, outward picture normal (2,).

        The middle of the material on the line of sight just inside; of several pieces the one nearest to the plane.  ``None`` where
        the line meets nothing.
        """
        for inside in INSIDE:
            start = view.points(np.asarray(pixel) - inside * np.asarray(normal), -2 * self.size)
            met = self._caster.crossings(start, view.direction) - 2 * self.size
            if len(met) == 0:
                continue
            # An open mesh is met an odd number of times: its sheets are the material.
            pieces = met.reshape(-1, 2).mean(axis=1) if len(met) % 2 == 0 else met
            return float(pieces[np.argmin(np.abs(pieces))])
        return None

    def depth_beside(self, view: CanonicalView, pixel: ArrayLike) -> float:
        """How far behind the view's plane, m, the surface lies that is nearest to the plane's point at a pixel
        (2,), where nothing is in sight itself."""
        point = view.points(np.asarray(pixel))
        nearest = self._caster.nearest(point)
        there = view.pixels(nearest)
        way = np.asarray(pixel) - there
        depth = self.depth_of_edge(view, there, way / max(float(np.linalg.norm(way)), 1e-9))
        return float((nearest - point) @ view.direction) if depth is None else depth

    def principal_frame(self, object_from_contact: NDArray[np.float64]) -> PrincipalFrame | None:
        """The surface at a contact's frame (4, 4), whose origin is on the surface or near it; ``None`` where no patch is explained.

        A sharp edge or a corner has no curvatures.
        """
        rotation, origin = object_from_contact[:3, :3], object_from_contact[:3, 3]
        start = self._caster.nearest(origin)
        reaches = np.geomspace(LARGEST, SMALLEST, PATCHES) * self.size
        fits = (self._fitted(start, rotation, float(reach)) for reach in reaches)
        found = next((fit for fit in fits if fit is not None), None)
        if found is None:
            return None
        # Once more across the normal that was found, where the height is least steep.
        again = self._fitted(found.object_from_surface[:3, 3], _aligned(found.object_from_surface[:3, 0], rotation), found.reach)
        return again or found

    def _fitted(self, start: NDArray[np.float64], rotation: NDArray[np.float64], reach: float) -> PrincipalFrame | None:
        """The frame from the patch of radius ``reach`` around a point (3,), its height along the first column of a rotation (3, 3)."""
        from scipy import ndimage  # only who asks for a surface pays for it

        x, y, z = rotation.T
        steps = np.linspace(-reach, reach, ACROSS)
        u, v = np.meshgrid(steps, steps, indexing="ij")
        origins = start + reach * x + u[..., None] * y + v[..., None] * z
        cast = self._caster.cast(origins, np.broadcast_to(-x, origins.shape))
        height = reach - cast.distance.astype(float)
        # Normals are told towards the eye: along x for what looks this way.
        there = (np.hypot(u, v) <= reach * (1 + 1e-9)) & (np.abs(height) < reach) & (cast.normals @ x > SAME_SIDE)
        labels, _ = ndimage.label(there)
        middle = labels[ACROSS // 2, ACROSS // 2]
        kept = (labels == middle) & (middle > 0)
        if np.count_nonzero(kept) < ENOUGH:
            return None
        u, v, height = u[kept] / reach, v[kept] / reach, height[kept] / reach
        if min(np.ptp(u), np.ptp(v)) < 2 * WIDTH:
            return None
        powers = [(i, j) for i in range(5) for j in range(5 - i)]
        basis = np.stack([u**i * v**j for i, j in powers], axis=1)
        fit, *_ = np.linalg.lstsq(basis, height, rcond=1e-8)
        residue = float(np.sqrt(np.mean((basis @ fit - height) ** 2)))
        if residue > LEFT:
            return None
        h = dict(zip(powers, fit.tolist(), strict=True))
        du, dv = h[1, 0], h[0, 1]
        first = np.array([[1 + du * du, du * dv], [du * dv, 1 + dv * dv]])
        second = np.array([[2 * h[2, 0], h[1, 1]], [h[1, 1], 2 * h[0, 2]]]) / (np.sqrt(1 + du * du + dv * dv) * reach)
        # Towards the outside the surface of what is convex falls.
        values, vectors = np.linalg.eig(-np.linalg.solve(first, second))
        values, vectors = np.real(values), np.real(vectors)
        if np.abs(values).max() * reach > ARC:
            return None
        normal = transforms.unit(x - du * y - dv * z)
        tangents = [transforms.unit(a * (y + du * x) + b * (z + dv * x)) for a, b in vectors.T]
        if abs(values[0] - values[1]) <= UMBILIC * np.abs(values).max():
            frame = _aligned(normal, rotation)
            values = np.full(2, values.mean())
        else:
            first_is_y = abs(tangents[0] @ y) >= abs(tangents[1] @ y)
            along = tangents[0 if first_is_y else 1]
            along = along if along @ y >= 0 else -along
            frame = np.column_stack([normal, along, np.cross(normal, along)])
            values = values if first_is_y else values[::-1]
        point = start + h[0, 0] * reach * x
        return PrincipalFrame(transforms.make(frame, point), values, reach, residue * reach)


def _aligned(normal: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation (3, 3) with a first column (3,) that is nearest to a given one about it."""
    y = transforms.unit(rotation[:, 1] - (rotation[:, 1] @ normal) * normal)
    return np.column_stack([normal, y, np.cross(normal, y)])
