"""The robot in a camera's picture: which pixels show it, and so say nothing of what is behind.

From the URDF and the joints' positions follows where every link is; rays through the pixels on which a link can fall tell at
which depth it begins.  The collision shapes are what is drawn: planning holds them to be the robot, they come with every
description that can plan, and they enclose what is seen (the Panda's visual meshes stick out of them by 1 mm at most).  A link
without collision shapes is drawn by its visual ones.

What is drawn is widened before it is compared with a picture:

edge    The stereo window of a depth camera sees both sides of an edge, so that pixels beside it take a depth of either, or of
        something between: some pixels, wherever the edge is.
space   Camera and base are calibrated to some millimetres, and shapes are not exact: metres, hence more pixels the nearer.
time    A moving arm is elsewhere by the time that the stamps of picture and joint state may differ by: all positions that are
        possible are drawn, and their union is cut.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.mesh import Mesh
from magic_core.robot import Description
from magic_core.robot_pictures import link_mesh

#: Rays start here, metres: what encloses the lens (a wrist camera's own housing) is not in its picture.
NEAR = 0.05
#: Rays go through every so many pixels.
STEP = 2
#: Standard deviation of the depth, metres at one metre, growing with its square (a D435: magic_core.sensor).
NOISE = 0.0042
#: A robot that is drawn but looked through: depth farther than this behind its front, metres, in more than
#: this share of at least so many pixels.
BEHIND, SHARE, PIXELS = 0.15, 0.5, 300
#: Drawn pictures kept: some cameras, some frames each.
KEPT = 12


@dataclass(frozen=True)
class Margins:
    """How much wider than drawn the robot is cut: ``edge`` in pixels, ``space`` in metres (see the module)."""

    edge: int = 4
    space: float = 0.010


@dataclass(frozen=True)
class Cut:
    """The robot in one picture.

    robot (H, W) bool: what is seen there is the robot, or may be.  It is no object, and nothing is known of what it hides.
    drawn (H, W) float32: where its front was expected, metres, NaN where it is not, without margins.
    through: share of the pixels well inside what was drawn at which depth lies far behind it; NaN where too few have depth.
    """

    robot: NDArray[np.bool_]
    drawn: NDArray[np.float32]
    through: float

    @property
    def contradicted(self) -> bool:
        """Whether the camera looks through where the robot was expected: it is not there."""
        return self.through > SHARE


class Body:
    """A rigid shape that is drawn: the corners (V, 3) of its convex hull, which bound it in every picture, and Open3D's scene of rays."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        self.vertices, self._tensor = _corners(mesh.vertices), o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32)))

    def cast(self, camera_from_body: NDArray[np.float64], k: Intrinsics, margins: Margins) -> _Cast | None:
        """The window of a picture on which it can fall, and what is seen of it there; ``None``: nothing."""
        corners = transforms.apply(camera_from_body, self.vertices)
        nearest, farthest = corners[:, 2].min(), corners[:, 2].max()
        if farthest <= NEAR:
            return None
        height, width = _size(k)
        nearest = max(float(nearest), NEAR)
        pad = -(-(margins.edge + int(np.ceil(max(k.fx, k.fy) * margins.space / nearest))) // STEP)
        if corners[:, 2].min() <= NEAR:
            c0, c1, r0, r1 = 0, width, 0, height
        else:
            seen = k.project(corners) / STEP
            low, high = seen.min(axis=0), seen.max(axis=0)
            c0, r0 = (max(int(np.floor(x)) - pad - 1, 0) for x in low)
            c1, r1 = (min(int(np.ceil(x)) + pad + 2, most) for x, most in zip(high, (width, height), strict=True))
        if c0 >= c1 or r0 >= r1:
            return None
        # The middle of each block of pixels; rays are one long in depth, so that their length to the hit is the depth.
        u, v = ((np.arange(*span, dtype=np.float32) + 0.5) * STEP - 0.5 for span in ((c0, c1), (r0, r1)))
        across, down = ((u - np.float32(k.cx)) / np.float32(k.fx))[None, :], ((v - np.float32(k.cy)) / np.float32(k.fy))[:, None]
        body_from_camera = transforms.inverse(camera_from_body).astype(np.float32)
        rays = np.empty((len(v), len(u), 6), np.float32)
        for axis in range(3):
            x, y, one, eye = body_from_camera[axis]
            np.add(across * x + one, down * y, out=rays[..., 3 + axis])
            np.add(rays[..., 3 + axis] * np.float32(NEAR), eye, out=rays[..., axis])
        depth = self._scene.cast_rays(self._tensor(rays))["t_hit"].numpy() + np.float32(NEAR)
        return _Cast((slice(r0, r1), slice(c0, c1)), depth, pad)


@dataclass(frozen=True)
class _Cast:
    """What is seen of a body in a window of a drawing: depth (h, w) where it begins, metres, inf where it
    is not; pad: by how much it is widened."""

    window: tuple[slice, slice]
    depth: NDArray[np.float32]
    pad: int

    @property
    def widened(self) -> NDArray[np.float32]:
        """(h, w): the least depth about each place."""
        return cv2.erode(self.depth, self._around, borderType=cv2.BORDER_CONSTANT, borderValue=float("inf"))

    @property
    def deepest(self) -> NDArray[np.float32]:
        """(h, w): the greatest depth about each place, -inf where the body is not near."""
        there = np.where(np.isfinite(self.depth), self.depth, np.float32(-np.inf))
        return cv2.dilate(there, self._around, borderType=cv2.BORDER_CONSTANT, borderValue=float("-inf"))

    @property
    def _around(self) -> NDArray[np.uint8]:
        return np.ones((2 * self.pad + 1,) * 2, np.uint8)


def _corners(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of points (N, 3) that are corners of their convex hull; all of them where they are flat."""
    points = np.unique(vertices, axis=0)
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return points


def _size(k: Intrinsics) -> tuple[int, int]:
    """Rows and columns of a drawing."""
    return -(-k.height // STEP), -(-k.width // STEP)


def shown(frame: RgbdFrame, body: Body, places: Sequence[NDArray[np.float64]], margins: Margins) -> NDArray[np.bool_]:
    """(H, W): where a frame shows a body, or may.

    places: all that world_from_body (4, 4) may be.  Within its outline, widened by the margins, all that has no depth, or a depth that
    the body has about there: what is seen beyond it or before it is something else.
    """
    camera_from_world, k = transforms.inverse(frame.world_from_camera), frame.intrinsics
    near, far = np.full(_size(k), np.inf, np.float32), np.full(_size(k), -np.inf, np.float32)
    for place in places:
        cast = body.cast(camera_from_world @ place, k, margins)
        if cast is not None:
            np.minimum(near[cast.window], cast.widened, out=near[cast.window])
            np.maximum(far[cast.window], cast.deepest, out=far[cast.window])
    near, far = (_enlarged(x, (k.width, k.height)) for x in (near, far))
    tolerance = margins.space + 3 * NOISE * np.minimum(near, 5.0) ** 2
    with np.errstate(invalid="ignore"):
        return np.isfinite(near) & ~(frame.depth < near - tolerance) & ~(frame.depth > far + tolerance)


@dataclass(frozen=True)
class _Drawing:
    """Depths at every ``STEP``-th pixel, metres, inf where the robot is not: as drawn, and widened by the margins."""

    front: NDArray[np.float32]
    widened: NDArray[np.float32]


class SelfFilter:
    """Cuts a robot out of the pictures of any camera; the last drawings are kept, so that an arm at rest is drawn once for each camera."""

    def __init__(self, robot: Description, margins: Margins | None = None) -> None:
        self.robot, self.margins = robot, margins or Margins()
        self._links: dict[str, Body] = {}
        for name in robot.links:
            mesh = link_mesh(robot, name, ("collision", "visual"))
            if mesh is not None and len(mesh.faces):
                self._links[name] = Body(mesh)
        self._kept: OrderedDict[tuple, _Drawing] = OrderedDict()

    def cut(self, frame: RgbdFrame, positions: Sequence[Mapping[str, float]], world_from_base: NDArray[np.float64] | None = None) -> Cut:
        """Where the robot is in a frame.

        positions: all that the joints' positions (rad, m, by name) may have been when it was taken; joints not named are at zero.
        world_from_base: the pose of the URDF's root in the frame's world.
        """
        base = np.eye(4) if world_from_base is None else np.asarray(world_from_base, dtype=float)
        drawing = self._drawing(frame.intrinsics, transforms.inverse(frame.world_from_camera) @ base, positions)
        size = (frame.intrinsics.width, frame.intrinsics.height)
        widened = _enlarged(drawing.widened, size)
        front = _enlarged(drawing.front, size)
        depth = frame.depth
        tolerance = self.margins.space + 3 * NOISE * np.minimum(widened, 5.0) ** 2
        drawn = np.isfinite(front)
        with np.errstate(invalid="ignore"):
            # What is measured before the robot hides it.  All else in the widened outline is the
            # robot, its smear, or cannot be told from it.
            robot = np.isfinite(widened) & ~(depth < widened - tolerance)
            inner = cv2.erode(drawn.view(np.uint8), np.ones((2 * self.margins.edge + 1,) * 2, np.uint8)).view(bool) & np.isfinite(depth)
            count = np.count_nonzero(inner)
            through = np.count_nonzero(inner & (depth > front + BEHIND)) / count if count >= PIXELS else float("nan")
        return Cut(robot, np.where(drawn, front, np.float32(np.nan)), through)

    def _drawing(self, intrinsics: Intrinsics, camera_from_base: NDArray[np.float64], positions: Sequence[Mapping[str, float]]) -> _Drawing:
        # A ten-thousandth of a radian or of a metre moves nothing by a pixel.
        states = tuple(sorted({tuple(sorted((name, round(float(q), 4)) for name, q in state.items())) for state in positions}))
        key = (intrinsics, camera_from_base.round(5).tobytes(), states)
        found = self._kept.pop(key, None)
        if found is None:
            found = _Drawing(*(np.full(_size(intrinsics), np.inf, np.float32) for _ in range(2)))
            for state in states:
                poses = self.robot.poses(dict(state))
                for name, link in self._links.items():
                    cast = link.cast(camera_from_base @ poses[name], intrinsics, self.margins)
                    if cast is not None:
                        np.minimum(found.front[cast.window], cast.depth, out=found.front[cast.window])
                        np.minimum(found.widened[cast.window], cast.widened, out=found.widened[cast.window])
        self._kept[key] = found
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return found


def _enlarged(small: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Each value of a drawing (h, w) for its block of pixels: (H, W) for a picture of ``size`` (W, H)."""
    return np.repeat(np.repeat(small, STEP, axis=0), STEP, axis=1)[: size[1], : size[0]]
