"""The pinhole camera (REP-103 optical frame: x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import Code, MagicError


@dataclass(frozen=True)
class Intrinsics:
    """Undistorted pinhole intrinsics in pixels; pixel centres lie at integer (u, v)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if self.width < 1 or self.height < 1:
            raise MagicError(Code.BAD_INTRINSICS, "image size", (self.width, self.height), "at least 1 x 1 pixels")
        if not np.all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise MagicError(Code.BAD_INTRINSICS, "fx, fy, cx, cy", values, "finite numbers, focal lengths above 0")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def unproject(self, depth: NDArray[np.float32]) -> NDArray[np.float64]:
        """Turn a depth image (H, W) in metres into points (H, W, 3) in the optical frame; NaN stays NaN."""
        v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
        z = np.asarray(depth, dtype=float)
        return np.stack([(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z], axis=-1)

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Project points (..., 3) in the optical frame to pixels (..., 2); NaN behind the camera."""
        points = np.asarray(points, dtype=float)
        z = np.where(points[..., 2] > 1e-9, points[..., 2], np.nan)
        return np.stack([self.fx * points[..., 0] / z + self.cx, self.fy * points[..., 1] / z + self.cy], axis=-1)


#: In ``RgbdFrame.held``.
NEARLY, SURELY = 1, 2


@dataclass(frozen=True)
class ArmSeen:
    """How a picture sees the arm against where its joints put it: ``offset`` (3,), m, in the world, carries what is seen of it about
    ``centre`` (3,) to where it should be; error: the standard error of each of its components, m."""

    centre: NDArray[np.float64]
    offset: NDArray[np.float64]
    error: float


@dataclass(frozen=True)
class RgbdFrame:
    """One colour image with depth registered to it.

    Attributes
    ----------
    color : (H, W, 3) uint8 RGB.
    depth : (H, W) float32 m, NaN where there is none.
    world_from_camera : (4, 4), pose of the colour optical frame.
    stamp : s.
    blind : (H, W) bool, something that is no part of the scene (the robot) stands before it there, so that the pixel tells nothing, neither
        of things nor of free space.
    held : (H, W) uint8, :data:`SURELY` where what the robot holds is seen, :data:`NEARLY` where it may be, else 0.
    arm : how the arm was seen before it was cut out, where that was measured.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    intrinsics: Intrinsics
    world_from_camera: NDArray[np.float64]
    camera: str = "camera"
    stamp: float = 0.0
    blind: NDArray[np.bool_] | None = None
    held: NDArray[np.uint8] | None = None
    arm: ArmSeen | None = None

    def __post_init__(self) -> None:
        size = (self.intrinsics.height, self.intrinsics.width)
        if self.color.shape != (*size, 3) or self.color.dtype != np.uint8:
            raise MagicError(
                Code.BAD_IMAGE, f"colour image of {self.camera}", f"{self.color.shape} {self.color.dtype}", f"{(*size, 3)} uint8"
            )
        if self.depth.shape != size:
            raise MagicError(Code.BAD_IMAGE, f"depth image of {self.camera}", self.depth.shape, f"{size}, the size of its colour image")
        for name, pixels in (("blind", self.blind), ("held", self.held)):
            if pixels is not None and pixels.shape != size:
                raise MagicError(Code.BAD_IMAGE, f"{name} pixels of {self.camera}", pixels.shape, f"{size}, the size of its colour image")

    def blinded(self, pixels: NDArray[np.bool_]) -> RgbdFrame:
        """The frame without the depth of these pixels (H, W), which are blind from now on."""
        blind = pixels if self.blind is None else self.blind | pixels
        return replace(self, depth=np.where(pixels, np.float32(np.nan), self.depth), blind=blind)

    @property
    def free(self) -> RgbdFrame:
        """The frame without what the robot holds, which is blind."""
        return self if self.held is None else self.blinded(self.held > 0)
