"""A model of the Intel RealSense D435 looking at meshes: colour and registered depth with the sensor's errors.

What is modelled, and after what:

disparity     Depth comes from active infrared stereo with a baseline b of 50 mm and, at
              640 x 480 depth, a focal length f of about 380 px (horizontal field of view
              about 80 degrees; D400 series data sheet, 337029).  z = f b / d, and the
              disparity d is found in steps of 1/32 px (RealSense D4 ASIC), so that depth
              comes in steps of z^2 / (32 f b): 0.8 mm at 0.7 m.
noise         The disparity has a root-mean-square error of about 0.08 px on well-textured
              surfaces (Intel, "Tuning D435 and D415 for best performance": RMS = z^2 s / (f b)),
              which depth sees as an error that grows with z^2: about 2 mm at 0.7 m.  It is
              correlated over the matching window: white noise, smoothed over a few pixels.
edges         Where depth jumps, the window sees both sides: pixels within a couple of
              pixels of a jump are lost or land on either side.
fattening     The window that is matched spans ``window`` pixels of the depth imager. Near a jump the
              nearer side, which fills the better part of it or has the stronger texture, wins: its
              depth reaches up to half a window past its edge (Scharstein and Szeliski 2002;
              Hirschmueller et al. 2002), by an amount that wanders along the edge.  Off unless asked for.
filling       Gaps in the nearer surface that are narrower than ``filled`` pixels of the depth imager (the hole
              of a handle, seen aslant) get depth from their rims, as stereo windows and the edge-preserving and
              hole-filling filters of librealsense leave them: no hole, but a shallow hollow.  Off unless asked for.
shadow        The left imager is the reference: what it sees but the right one, 50 mm
              beside it, does not has no depth: a strip along the left sides of near things.
holes         Surfaces at grazing angles and single pixels here and there have no match.
range         Nothing nearer than 0.17 m (minimum at this resolution) or farther than 3 m.
registration  Depth is given in the colour camera's pixels, as ``align_depth`` does; the
              15 mm between the imagers is left out, both share one centre.
output        16-bit millimetres, rounded: the driver's 16UC1.

Colour: one distant light and ambient, the table with a mild wood grain, noise with a
standard deviation of 1.2 of 255.  All is a function of the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster, shade

#: Intrinsics of a D435's colour camera at 640 x 480.
D435 = Intrinsics(640, 480, 615.0, 615.0, 320.0, 240.0)


@dataclass(frozen=True)
class DepthModel:
    """Numbers of the depth sensor; lengths in metres, disparity and focal length in pixels of the depth imager."""

    baseline: float = 0.050
    focal: float = 380.0
    subpixel: float = 1 / 32
    noise: float = 0.08
    correlation: float = 1.5
    edge: float = 0.010
    edge_width: int = 2
    edge_loss: float = 0.5
    grazing: float = 0.15
    dropout: float = 0.002
    window: int = 0
    filled: int = 0
    near: float = 0.17
    far: float = 3.0

    def disparity(self, depth: NDArray) -> NDArray:
        """Disparity in pixels of a depth in metres."""
        return self.focal * self.baseline / depth

    def step(self, depth: float) -> float:
        """Distance in metres between neighbouring depths that the sensor can tell, at a depth."""
        return depth**2 * self.subpixel / (self.focal * self.baseline)

    def sigma(self, depth: float) -> float:
        """Standard deviation in metres of the depth noise at a depth."""
        return depth**2 * self.noise / (self.focal * self.baseline)


#: A D435 with the smear at edges and the filled holes that recorded depth images of small things show: at mugs with their
#: handle to the side depth reaches some 3 to 8 pixels of the colour image past the colour's edge, and holes of 8 to 12
#: pixels are closed, as read off pictures.
SMEARED = DepthModel(window=9, filled=6)


#: The light: a direction towards it (world), the share that comes from everywhere, and what is seen where nothing is (RGB).
LIGHT, AMBIENT, BACKGROUND = (-0.3, 0.4, 1.0), 0.5, (70, 72, 76)


def table_mesh(
    low: tuple[float, float] = (-0.6, -1.0), high: tuple[float, float] = (1.4, 1.0), color: tuple[int, int, int] = (186, 152, 112)
) -> Mesh:
    """The table top: the rectangle of the plane z = 0 between two corners (x, y)."""
    (x0, y0), (x1, y1) = low, high
    vertices = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])).painted(color)


def looking_at(eye: NDArray | Sequence[float], target: NDArray | Sequence[float]) -> NDArray[np.float64]:
    """world_from_camera (4, 4) of an optical frame at ``eye`` with its axis through ``target``, horizon level."""
    eye = np.asarray(eye, dtype=float)
    z = transforms.unit(np.asarray(target, dtype=float) - eye)
    x = transforms.unit(np.cross(z, [0, 0, 1.0]))
    return transforms.make(np.column_stack([x, np.cross(z, x), z]), eye)


#: Where the project's two cameras stand: left and right in front of the robot, looking back and down at the table (world_from_camera).
STATION = {
    "left": looking_at([0.94, 0.42, 0.66], [0.52, 0.0, 0.04]),
    "right": looking_at([0.94, -0.42, 0.66], [0.52, 0.0, 0.04]),
}


@dataclass(frozen=True)
class Noise:
    """What chance does to one frame, for every pixel, so that what one pixel gets does not depend on the others.

    smooth (H, W): error of the disparity in standard deviations; lottery, loss (H, W): from 0 to 1, what decides at grazing angles and
    at edges; shift (2, H, W): -1 to 1, which neighbour's depth a pixel at an edge takes; color (H, W, 3): of 255.
    """

    smooth: NDArray[np.float64]
    lottery: NDArray[np.float64]
    loss: NDArray[np.float64]
    shift: NDArray[np.int64]
    color: NDArray[np.float64]

    @classmethod
    def draw(cls, shape: tuple[int, int], seed: int | Sequence[int], model: DepthModel | None = None) -> Noise:
        """For frames of a shape (H, W)."""
        model = model or DepthModel()
        keys = [int(k) for k in np.atleast_1d(seed)]
        random = np.random.default_rng([*keys, 0])
        smooth = cv2.GaussianBlur(random.standard_normal(shape), (0, 0), model.correlation)
        # White noise smoothed with a Gaussian of s pixels keeps 1 / (4 pi s^2) of its variance.
        smooth *= np.sqrt(4 * np.pi) * model.correlation
        lottery, loss = random.random(shape), random.random(shape)
        shift = random.integers(-1, 2, (2, *shape))
        return cls(smooth, lottery, loss, shift, np.random.default_rng([*keys, 1]).normal(0, 1.2, (*shape, 3)))

    def light(self) -> Noise:
        """The same in fewer bytes, which are quicker to work with."""
        single = [x.astype(np.float32) for x in (self.smooth, self.lottery, self.loss)]
        return Noise(*single, self.shift.astype(np.int16), self.color.astype(np.float32))

    def rolled(self, down: int, right: int) -> Noise:
        """The same noise elsewhere in the picture: another frame's, at a fraction of the cost of drawing it."""
        by = (down, right)
        flat = [np.roll(x, by, (0, 1)) for x in (self.smooth, self.lottery, self.loss)]
        return Noise(*flat, np.roll(self.shift, by, (1, 2)), np.roll(self.color, by, (0, 1)))


def degrade(
    depth: NDArray[np.float32],
    cosine: NDArray[np.float32],
    intrinsics: Intrinsics,
    seed: int | Sequence[int],
    model: DepthModel | None = None,
    noise: Noise | None = None,
) -> NDArray[np.float32]:
    """What the sensor makes of true depth.

    depth (H, W) metres, NaN where nothing is; cosine (H, W) of the angle between ray and
    surface normal; noise: drawn by the seed where none is given.  Returns (H, W) float32 metres in whole millimetres, NaN where
    there is none.
    """
    model = model or DepthModel()
    noise = noise or Noise.draw(depth.shape, seed, model)
    if model.window or model.filled:
        depth = smeared(depth, intrinsics, seed, model)
    return Sight.of(depth, cosine, intrinsics, model).measured(noise)


@dataclass(frozen=True)
class Sight:
    """True depth with what of it chance does not change, so that a camera at rest before things at
    rest need not work it out for each frame.

    depth (H, W) metres, NaN where nothing is; disparity (H, W) pixels; jump (2, N): rows and columns of pixels beside a jump of the
    depth; lost (H, W) bool: where nothing is, or the second imager sees nothing; cosine (H, W).
    """

    depth: NDArray[np.float32]
    disparity: NDArray[np.float32]
    jump: NDArray[np.int64]
    lost: NDArray[np.bool_]
    cosine: NDArray[np.float32]
    model: DepthModel

    @classmethod
    def of(cls, depth: NDArray[np.float32], cosine: NDArray[np.float32], intrinsics: Intrinsics, model: DepthModel) -> Sight:
        """Of true depth, smeared where the model does."""
        valid = np.isfinite(depth)
        true = np.where(valid, depth, 0.0).astype(np.float32)
        window = np.ones((2 * model.edge_width + 1,) * 2, np.uint8)
        known = np.where(valid, depth, model.far).astype(np.float32)
        # A slope changes depth too: only what exceeds the slope of a steep plane counts as a jump.
        footprint = 2 * model.edge_width * true / intrinsics.fx
        jump = (cv2.dilate(known, window) - cv2.erode(known, window)) > model.edge + 2.0 * footprint
        with np.errstate(divide="ignore", invalid="ignore"):
            disparity = model.disparity(depth)
        return cls(depth, disparity, np.stack(np.nonzero(jump)), ~valid | _shadow(depth, intrinsics, model), cosine, model)

    def measured(self, noise: Noise) -> NDArray[np.float32]:
        """(H, W): what the sensor makes of it, metres in whole millimetres, NaN where there is none."""
        model, (rows, columns) = self.model, self.jump
        height, width = self.depth.shape
        # Near a jump a pixel takes the depth of one of its neighbours.
        down, right = noise.shift[:, rows, columns]
        strayed = self.depth[np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)]
        disparity, lost = self.disparity.copy(), self.lost.copy()
        with np.errstate(divide="ignore", invalid="ignore"):
            disparity[rows, columns] = model.disparity(strayed)
            disparity = disparity + model.noise * noise.smooth
            disparity = np.round(disparity / model.subpixel) * model.subpixel
            measured = model.focal * model.baseline / disparity
        lost[rows, columns] |= ~np.isfinite(strayed) | (noise.loss[rows, columns] < model.edge_loss)
        lost |= self.cosine < model.grazing * (0.7 + 0.6 * noise.lottery)
        lost |= noise.loss < model.dropout
        measured = np.round(measured * 1000) / 1000
        lost |= ~(measured >= model.near) | ~(measured <= model.far)
        measured[lost] = np.nan
        return measured.astype(np.float32)


def smeared(depth: NDArray[np.float32], intrinsics: Intrinsics, seed: int | Sequence[int], model: DepthModel) -> NDArray[np.float32]:
    """True depth (H, W) as the matching window and the filters leave it: near surfaces fattened at jumps, their narrow gaps filled."""
    scale = intrinsics.fx / model.focal  # pixels of this image to one of the depth imager
    known = np.where(np.isfinite(depth), depth, np.float32(model.far)).astype(np.float32)
    result = known
    if model.filled:
        side = 2 * round(model.filled * scale / 2) + 1
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        # Where only a gap is deeper than what is around it, the rims' depth, a quarter of the way back to the true one.
        closed = cv2.morphologyEx(known, cv2.MORPH_OPEN, kernel)
        soft = cv2.GaussianBlur(closed, (0, 0), side / 6)
        gap = known - closed > model.edge
        result = np.where(gap, soft + 0.25 * np.minimum(known - soft, 0.04), known).astype(np.float32)
    if model.window:
        random = np.random.default_rng([*(int(k) for k in np.atleast_1d(seed)), 77])
        most = model.window / 2 * scale
        wander = cv2.GaussianBlur(random.standard_normal(depth.shape), (0, 0), most)
        reach = most * np.clip(0.6 + 0.25 * wander / wander.std(), 0.1, 1.0)
        fattened = result
        for step in range(1, int(np.ceil(most)) + 1):
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * step + 1,) * 2)
            nearest = cv2.erode(result, kernel)
            # What the surface's own slope explains is no jump.
            jump = (reach >= step) & (fattened - nearest > model.edge + 2.0 * step * result / intrinsics.fx)
            fattened = np.where(jump, nearest, fattened)
        result = fattened
    return np.where(result < model.far, result, np.float32(np.nan)).astype(np.float32)


def _shadow(depth: NDArray[np.float32], intrinsics: Intrinsics, model: DepthModel) -> NDArray[np.bool_]:
    """Pixels (H, W) that the second imager, ``baseline`` to the right, does not see behind something nearer."""
    width = depth.shape[1]
    z = np.where(np.isfinite(depth), depth, model.far)
    # Column at which the second imager sees each pixel; where a pixel further left already landed right of it, it is hidden.
    landed = np.arange(width) - intrinsics.fx * model.baseline / z
    # The nearer a thing, the further left it lands; the scan runs from right to left.
    reach = np.minimum.accumulate(landed[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, :-1] = landed[:, :-1] > reach[:, 1:] + 0.5
    return hidden


def wood(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Brightness factors (...,) of a mild grain along world x at points (..., 3) of the table."""
    x, y = points[..., 0], points[..., 1]
    bend = 0.012 * np.sin(3 * x + 2 * y) + 0.004 * np.sin(11 * x)
    return 1 + 0.03 * np.sin(2 * np.pi * (y + bend) / 0.045) + 0.015 * np.sin(2 * np.pi * (y + 1.3 * bend) / 0.013)


def capture(
    meshes: Sequence[Mesh],
    intrinsics: Intrinsics,
    world_from_camera: NDArray[np.float64],
    seed: int | Sequence[int],
    *,
    model: DepthModel | None = None,
    table: Mesh | None = None,
    camera: str = "camera",
    stamp: float = 0.0,
    raycaster: Raycaster | None = None,
) -> RgbdFrame:
    """One frame of a D435 that looks at meshes (world coordinates) on the table.

    table: the table's mesh (default :func:`table_mesh`); the same seed gives the same frame.
    raycaster: reuse one made by :func:`scene_raycaster` of the same meshes, for several frames of one scene.
    """
    if np.asarray(world_from_camera).shape != (4, 4) or not np.all(np.isfinite(world_from_camera)):
        raise MagicError(Code.BAD_REQUEST, "world_from_camera", np.asarray(world_from_camera).shape, "a finite (4, 4) transform")
    caster = raycaster or scene_raycaster(meshes, table)
    cast, true = caster.perspective(intrinsics, np.asarray(world_from_camera, dtype=float))
    rays = intrinsics.unproject(np.ones((intrinsics.height, intrinsics.width)))
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ world_from_camera[:3, :3].T
    cosine = np.abs(np.einsum("hwi,hwi->hw", rays, cast.normals))
    image = shade(cast, light=LIGHT, ambient=AMBIENT, background=BACKGROUND).astype(float)
    on_table = cast.ids == 0
    points = rays * np.where(np.isfinite(cast.distance), cast.distance, 0.0)[..., None] + world_from_camera[:3, 3]
    image *= np.where(on_table, wood(points), 1.0)[..., None]
    return expose(image, true, cosine, intrinsics, world_from_camera, seed, model=model, camera=camera, stamp=stamp)


def expose(
    image: NDArray[np.floating],
    depth: NDArray[np.float32],
    cosine: NDArray[np.float32],
    intrinsics: Intrinsics,
    world_from_camera: NDArray[np.float64],
    seed: int | Sequence[int],
    *,
    model: DepthModel | None = None,
    camera: str = "camera",
    stamp: float = 0.0,
    noise: Noise | None = None,
) -> RgbdFrame:
    """What the sensor makes of what is there: a lit image (H, W, 3), true depth (H, W) in metres (NaN: nothing), and the cosine (H, W)
    of the angle between ray and surface normal."""
    noise = noise or Noise.draw(depth.shape, seed, model)
    measured = degrade(depth, cosine, intrinsics, [*np.atleast_1d(seed), 0], model, noise)
    color = colored(sharp(image), noise)
    return RgbdFrame(color, measured, intrinsics, np.asarray(world_from_camera, dtype=float), camera, stamp)


def sharp(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """A lit image (H, W, 3) as sharp as the lens makes it."""
    return cv2.GaussianBlur(image, (0, 0), 0.6)


def colored(image: NDArray[np.floating], noise: Noise) -> NDArray[np.uint8]:
    """The colour picture (H, W, 3) of what the lens makes of a lit image."""
    return np.clip(image + noise.color, 0, 255).astype(np.uint8)


def scene_raycaster(meshes: Sequence[Mesh], table: Mesh | None = None) -> Raycaster:
    """The raycaster of a scene for :func:`capture`: the table first, then the meshes."""
    return Raycaster([table or table_mesh(), *meshes])
