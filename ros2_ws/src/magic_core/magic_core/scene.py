"""Objects on the table as every package sees them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh

#: What besides an object's id may stand in SceneObject.cut_off: the border of the pictures, of the region of interest, a known object or
#: the robot; and that no camera sees it now: what is told of it is remembered from earlier pictures.
PICTURE, REGION, FIXTURE, ROBOT, UNSEEN = "picture", "region", "fixture", "robot", "unseen"

VIEW_KINDS = ("top", "side", "section")


#: Metres a pixel that a view may have: from a microscope's to one in which a tool is a pixel; 1 stands for not known.
SCALES = 1e-7, 10.0


@dataclass(frozen=True)
class CanonicalView:
    """An orthographic picture of one object in its canonical pose (paper, III-A).

    The view frame is an optical frame: x right, y down, z into the picture.  Its origin is the image's centre, pixel
    ((W - 1) / 2, (H - 1) / 2), on the plane through the middle of the object, the plane in which contacts are modelled.

    Attributes
    ----------
    image : (H, W, 3) uint8 RGB, black background.
    mask : (H, W) bool, the object.
    metres_per_pixel : scale of the picture; 1 where it is not known.
    object_from_view : (4, 4).
    kind : ``top`` (seen from above), ``side`` (the side that shows the handle or the hole) or ``section`` (the upright cut along the long
        axis, drawn as a filled silhouette).
    depth : (H, W) float32, m along z from the view plane, negative nearer to the eye; NaN off the object.
    confidence : 0..1, how clearly this view was the canonical one.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    metres_per_pixel: float
    object_from_view: NDArray[np.float64]
    kind: str = "top"
    depth: NDArray[np.float32] | None = None
    confidence: float = 1.0

    def __post_init__(self) -> None:
        if self.mask.ndim != 2 or self.image.shape != (*self.mask.shape, 3):
            raise MagicError(Code.BAD_REQUEST_IMAGE, "image and mask", f"{self.image.shape} and {self.mask.shape}", "(H, W, 3) and (H, W)")
        if self.kind not in VIEW_KINDS:
            raise MagicError(Code.BAD_REQUEST_IMAGE, "kind of view", self.kind, VIEW_KINDS)
        low, high = SCALES
        if not low <= self.metres_per_pixel <= high:  # nor is NaN
            raise MagicError(Code.BAD_REQUEST_IMAGE, "metres_per_pixel", self.metres_per_pixel, f"{low:g} to {high:g}")

    @property
    def direction(self) -> NDArray[np.float64]:
        """(3,): the view direction v (into the picture) in the object frame."""
        return self.object_from_view[:3, 2].copy()

    def points(self, pixels: ArrayLike, z: float = 0.0) -> NDArray[np.float64]:
        """Points (..., 3) in the object frame of pixels (..., 2) on the plane z of the view frame."""
        pixels = np.asarray(pixels, dtype=float)
        height, width = self.mask.shape
        xy = (pixels - [(width - 1) / 2, (height - 1) / 2]) * self.metres_per_pixel
        return transforms.apply(self.object_from_view, np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1))

    def pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """Pixels (..., 2) of points (..., 3) given in the object frame."""
        height, width = self.mask.shape
        xy = transforms.apply(transforms.inverse(self.object_from_view), points)[..., :2]
        return xy / self.metres_per_pixel + [(width - 1) / 2, (height - 1) / 2]

    def directions(self, vectors: ArrayLike) -> NDArray[np.float64]:
        """Directions (..., 3) in the object frame of picture vectors (..., 2)."""
        return np.asarray(vectors, dtype=float) @ self.object_from_view[:3, :2].T


@dataclass(frozen=True)
class SceneObject:
    """One rigid object: what perception saw of it and what it was completed to.

    Attributes
    ----------
    mesh, pieces : the closed surface and convex pieces that together fill it, in the object frame; physics and planning use the pieces.
    world_from_object : (4, 4).
    view : the canonical view.
    points, colors : (N, 3) m in the world and (N, 3) uint8, the cleaned cloud.
    mask : (H, W) bool in the image of ``camera``.
    picture : (h, w, 3) uint8 RGB, that image about the object, with a margin.
    world_from_box, box_extents : (4, 4), and (3,) m along its axes.
    confidence : 0..1, the chance, as measured on known scenes, that mask and solid overlap the truth by more than 0.8.
    source : ``camera``, or ``known`` for a calibrated fixture or a given mesh.
    seen_share : 0..1, how much of the mesh's surface a camera saw, what rests on the table left out.
    cut_off : what keeps a part out of sight: ``picture``, ``region``, ``fixture``, ``robot``, or ids of objects in front; ``unseen``: no
        camera sees it now, it is remembered.  Such a thing is no whole tool.
    hanging : it is above the table with nothing below that could carry it (a hand, the arm, a cable), and no thing to plan with.
    surface_error : m, the root mean square distance between mesh and true surface below which it is for five of six things that look like
        this one; 0 where nobody says.
    """

    id: str
    mesh: Mesh
    pieces: tuple[Mesh, ...]
    world_from_object: NDArray[np.float64]
    view: CanonicalView
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    colors: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    mask: NDArray[np.bool_] | None = None
    camera: str = ""
    picture: NDArray[np.uint8] | None = None
    world_from_box: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    box_extents: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    confidence: float = 1.0
    source: str = "camera"
    seen_share: float = 1.0
    cut_off: tuple[str, ...] = ()
    hanging: bool = False
    surface_error: float = 0.0


@dataclass(frozen=True)
class Scene:
    """What is on the table at one moment.

    Attributes
    ----------
    table : (4,), the plane a x + b y + c z + d = 0 in world coordinates, unit normal up.
    stamp : s.
    camera_offset, camera_angle : m and rad, how far the cameras' poses disagree, the worst pair; NaN where it could not be measured.
    notes : what there is to say of the scene, in sentences.
    """

    objects: tuple[SceneObject, ...]
    table: NDArray[np.float64]
    stamp: float = 0.0
    frame_id: str = "panda_link0"
    camera_offset: float = math.nan
    camera_angle: float = math.nan
    notes: tuple[str, ...] = ()

    def find(self, object_id: str) -> SceneObject:
        """The object of that id; raises ``UNKNOWN_OBJECT`` naming the ids there are."""
        for item in self.objects:
            if item.id == object_id:
                return item
        raise MagicError(Code.UNKNOWN_OBJECT, "object id", object_id, [o.id for o in self.objects])

    @property
    def table_height(self) -> float:
        """Height in metres of the table plane at the world's origin."""
        _a, _b, c, d = (float(x) for x in self.table)
        return -d / c
