"""What a generator returns: a solid, its convex pieces, its canonical view and its labelled functional regions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.contact import Contact, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import VIEW_FILL, VIEW_SIZE, canonical_view, frame_of_view
from magic_core.scene import CanonicalView, SceneObject
from magic_core.shapes.solids import Part, join


@dataclass(frozen=True)
class Region:
    """A stretch of the outline in the view's mid-plane on which a contact would do the named job.

    points (N, 3) metres and normals (N, 3) unit, outward (out of the material), in
    the object frame, in order along the outline; radius of curvature in metres (inf
    where straight), concave: its centre lies outside the material.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    radius: float
    concave: bool

    def moved(self, transform: NDArray[np.float64]) -> Region:
        """The region mapped by a rigid transform (4, 4)."""
        return Region(transforms.apply(transform, self.points), self.normals @ transform[:3, :3].T, self.radius, self.concave)

    def middle(self, towards: ArrayLike | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Point and normal (3,) each in the middle of the region, or where the normal is nearest to a direction."""
        index = len(self.points) // 2 if towards is None else int(np.argmax(self.normals @ transforms.unit(towards)))
        return self.points[index], self.normals[index]

    def distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Distances (N,) in metres of points (N, 3) from the region's polyline."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        if len(self.points) == 1:
            return np.linalg.norm(points - self.points[0], axis=1)
        a, b = self.points[:-1], self.points[1:]
        d = b - a
        t = np.einsum("nki,ki->nk", points[:, None] - a, d) / np.maximum(np.einsum("ki,ki->k", d, d), 1e-18)
        nearest = a + np.clip(t, 0, 1)[..., None] * d
        return np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1)


@dataclass(frozen=True)
class Shape:
    """A procedurally made object.

    family and seed with ``parameters`` (metres, radians) tell how it was made; mesh is
    watertight and coloured; pieces are convex and together fill it; view_kind with
    view_direction (3,) and view_up (3,) in the object frame is the canonical view;
    regions name the places where a contact does a job.

    Object frames, origin at the axis-aligned box's centre: flat tools lie in the xy
    plane, thickness along z; mugs stand, z up, handle towards +x; spoons, ladles and
    cups have their long axis along x, bowl at +x opening to +z; the rod and the mug
    tree stand, z up; the rod's free end is at -x; the arc stands, its concave side
    facing -x and up.
    """

    family: str
    seed: int
    parameters: Mapping[str, float | str]
    mesh: Mesh
    pieces: tuple[Mesh, ...]
    view_kind: str
    view_direction: NDArray[np.float64]
    view_up: NDArray[np.float64]
    regions: Mapping[str, Region]

    def view(self, kind: str | None = None, size: int = VIEW_SIZE) -> CanonicalView:
        """The canonical view, of another ``kind`` where one is asked for (same direction; ``section`` is drawn cut)."""
        kind = kind or self.view_kind
        if kind == "section":
            return section_view(self.mesh, self.view_direction, self.view_up, size)
        return canonical_view(self.mesh, self.view_direction, self.view_up, kind, size)

    def region(self, name: str) -> Region:
        """The region of that name; raises ``BAD_REQUEST`` naming those there are."""
        if name not in self.regions:
            raise MagicError(Code.BAD_REQUEST, f"region of a {self.family}", name, tuple(self.regions))
        return self.regions[name]

    def contact(
        self, name: str, view: CanonicalView | None = None, towards: ArrayLike | None = None, scale: float | None = None
    ) -> Contact:
        """A contact in the middle of a region (or where its normal is nearest to ``towards``), from the analytic shape.

        scale: motion functional scale in metres; by default 3.5 times the radius, within a twentieth and a quarter of the object.
        """
        view = view or self.view()
        region = self.region(name)
        point, normal = region.middle(towards)
        pixel = view.pixels(point)
        picture = transforms.unit(normal @ view.object_from_view[:3, :2])
        size = view.metres_per_pixel * VIEW_FILL * view.mask.shape[0]
        chosen = float(np.clip(3.5 * region.radius, 0.05 * size, 0.25 * size)) if scale is None else scale
        return Contact(pixel, picture, region.radius, region.concave, chosen, contact_frame(view, pixel, picture))

    def as_object(self, object_id: str, world_from_object: NDArray[np.float64], kind: str | None = None) -> SceneObject:
        """The shape as a known object of a scene at a pose (4, 4), complete with its canonical view."""
        low, high = self.mesh.bounds
        return SceneObject(
            id=object_id,
            mesh=self.mesh,
            pieces=self.pieces,
            world_from_object=np.asarray(world_from_object, dtype=float),
            view=self.view(kind),
            world_from_box=world_from_object @ transforms.make(translation=(low + high) / 2),
            box_extents=high - low,
            source="known",
        )


def section_view(mesh: Mesh, direction: ArrayLike, up: ArrayLike, size: int = VIEW_SIZE, fill: float = VIEW_FILL) -> CanonicalView:
    """Draw the cut of a closed mesh by the plane through its middle across ``direction``, as a filled silhouette.

    Frame and scale are those of :func:`magic_core.rendering.canonical_view`; the colour is the mesh's mean.
    """
    import cv2
    import shapely

    object_from_view, metres_per_pixel, _ = frame_of_view(mesh, direction, up, size, fill)
    cut = mesh.to_trimesh().section(plane_origin=object_from_view[:3, 3], plane_normal=object_from_view[:3, 2])
    if cut is None:
        raise MagicError(Code.BAD_MESH, "mesh", "no cut with the plane through its middle", "a closed mesh")
    view_from_object = transforms.inverse(object_from_view)
    mask = np.zeros((size, size), np.uint8)
    area = shapely.Polygon()
    for path in cut.discrete:
        ring = transforms.apply(view_from_object, path)[:, :2] / metres_per_pixel + (size - 1) / 2
        if len(ring) >= 4:
            area = area.symmetric_difference(shapely.Polygon(ring).buffer(0))
    if area.is_empty:
        raise MagicError(Code.BAD_MESH, "cut of the mesh", "no closed outline", "a closed mesh")
    shift = 4  # sub-pixel corners: 1/16 px
    for polygon in getattr(area, "geoms", [area]):
        rings = [np.round(np.asarray(r.coords) * 2**shift).astype(np.int32) for r in (polygon.exterior, *polygon.interiors)]
        cv2.fillPoly(mask, rings, 255, shift=shift)
    inside = mask > 0
    if not inside.any():
        raise MagicError(Code.BAD_MESH, "cut of the mesh", "no area", "a closed mesh")
    color = mesh.colors.mean(axis=0) if mesh.colors is not None else np.array([180.0, 180.0, 185.0])
    image = np.zeros((size, size, 3), np.uint8)
    image[inside] = np.clip(color, 60, 255).astype(np.uint8)
    return CanonicalView(image, inside, metres_per_pixel, object_from_view, "section")


def assemble(
    family: str,
    seed: int,
    parameters: Mapping[str, float | str],
    parts: list[Part],
    regions: Mapping[str, Region],
    view_kind: str,
    view_direction: ArrayLike,
    view_up: ArrayLike,
) -> Shape:
    """Join parts into a Shape with its origin at the box's centre."""
    mesh = join(parts)
    to_centre = transforms.make(translation=-mesh.bounds.mean(axis=0))
    return Shape(
        family,
        seed,
        MappingProxyType(dict(parameters)),
        mesh.transformed(to_centre),
        tuple(piece.transformed(to_centre) for part in parts for piece in part.pieces),
        view_kind,
        np.asarray(view_direction, dtype=float),
        np.asarray(view_up, dtype=float),
        MappingProxyType({name: region.moved(to_centre) for name, region in regions.items()}),
    )
