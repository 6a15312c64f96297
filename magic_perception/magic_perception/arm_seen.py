"""How far a camera sees the arm from where its joints put it: the calibration of camera and arm, measured in a picture of the arm itself.

Two cameras that agree with each other may both be off the arm, by a hand-eye calibration that is wrong, and then every motion is.  The
arm's visual shapes are drawn where its joints put them, and what is seen about them is carried onto them by a shift: the distances along
the surfaces' normals are made small (point-to-plane ICP), and what fits badly counts less (Cauchy's weights).  A turn of the camera shows
as the shift that it makes at the arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.camera import ArmSeen, RgbdFrame
from magic_core.mesh import Mesh, concatenate
from magic_core.robot import Description
from magic_core.robot_pictures import link_mesh

Array = NDArray[np.float64]

#: Every so many pixels are looked at.
STEP = 4
#: Points so near to a drawn surface may be of it, m, one step of the fit after the other.
REACHES = (0.1, 0.1, 0.08, 0.06, 0.05, 0.04, 0.03, 0.02, 0.015, 0.012)
#: Where depth jumps by so much, m, within so many pixels, it may be of neither side.
JUMP, BESIDE = 0.06, 9
#: Distances from the surface that count half, m: smear, and what an arm wears.
MISFIT = 0.006
#: So many points have to be drawn, and such a share of them has to be fitted: of arms in free sight it was 0.48 at least, of one behind a
#: box that its hand stuck in 0.38, and the box was taken for the hand.
DRAWN, SHARE = 100, 0.43
#: Errors of neighbouring points are alike: so many tell as much as one.  No shape and no depth is better than FLOOR, m.
ALIKE, FLOOR = 12.0, 0.001
#: How fast a shift is taken back that nothing tells, in points.
TIE = 1.0


class ArmInPicture:
    """An arm by its visual shapes, drawn where its joints put it."""

    def __init__(self, robot: Description) -> None:
        self._robot = robot
        meshes = {name: link_mesh(robot, name, ("visual",)) for name in robot.links}
        self._meshes = {name: mesh for name, mesh in meshes.items() if mesh is not None and len(mesh.faces)}
        self._posed: tuple[bytes, Any] | None = None

    def measure(self, frame: RgbdFrame, state: Mapping[str, float], world_from_base: Array | None = None) -> ArmSeen | None:
        """How a frame, from which the arm has not been cut, sees it at joint positions (rad, m, by name); ``None`` where that does not
        tell.

        world_from_base: the pose of the URDF's root in the frame's world.
        """
        if not self._meshes:
            return None
        arm = self._arm(state, np.eye(4) if world_from_base is None else np.asarray(world_from_base, dtype=float))
        rays = _rays(frame)
        drawn = arm.drawn(frame.world_from_camera[:3, 3], rays)
        on = np.isfinite(drawn)
        if np.count_nonzero(on) < DRAWN:
            return None
        points = _points(frame, rays, on, float(drawn[on].min()))
        shift, eye = np.zeros(3), frame.world_from_camera[:3, 3]
        for number, reach in enumerate(REACHES):
            nearest, normals = arm.nearest(points + shift)
            off = points + shift - nearest
            far = np.linalg.norm(off, axis=1)
            fitted = (far < reach) & (np.einsum("ij,ij->i", normals, eye - nearest) > 0)
            if np.count_nonzero(fitted) < SHARE * np.count_nonzero(on):
                return None
            n, misfit = normals[fitted], np.einsum("ij,ij->i", normals[fitted], off[fitted])
            weights = 1 / (1 + (misfit / MISFIT) ** 2)
            told = (n * weights[:, None]).T @ n
            shift = shift - np.linalg.solve(told + TIE * np.eye(3), (n * weights[:, None]).T @ misfit)
            centre = points[fitted].mean(axis=0)
            if number == 0:
                points = points[far < 2 * reach]  # what is farther off never comes near
        spread = float(np.average(misfit**2, weights=weights))
        error = np.sqrt(ALIKE * spread / max(float(np.linalg.eigvalsh(told)[0]), TIE))
        return ArmSeen(centre, shift, float(np.hypot(error, FLOOR)))

    def _arm(self, state: Mapping[str, float], base: Array) -> _Arm:
        poses = self._robot.poses(dict(state))
        posed = {name: base @ poses[name] for name in self._meshes}
        # A ten-thousandth of a radian or of a metre is nothing.
        key = np.concatenate([pose.round(4).ravel() for pose in posed.values()]).tobytes()
        if self._posed is None or self._posed[0] != key:
            self._posed = key, _Arm(concatenate([self._meshes[name].transformed(pose) for name, pose in posed.items()]))
        return self._posed[1]


class _Arm:
    """The whole arm in one place: Open3D's scene of its surface."""

    def __init__(self, mesh: Mesh) -> None:
        import open3d as o3d

        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32)))

    def drawn(self, eye: Array, rays: Array) -> NDArray[np.float32]:
        """(h, w): the depth at which rays (h, w, 3), one long in depth, meet it; inf where they do not."""
        lines = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=-1)
        found: NDArray[np.float32] = self._scene.cast_rays(self._tensor(lines.astype(np.float32)))["t_hit"].numpy()
        return found

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """The nearest places (N, 3) on it, and the normals (N, 3) there."""
        found = self._scene.compute_closest_points(self._tensor(points.astype(np.float32)))
        return found["points"].numpy().astype(float), found["primitive_normals"].numpy().astype(float)


def _rays(frame: RgbdFrame) -> Array:
    """(h, w, 3) in the world, one long in depth, through every ``STEP``-th pixel."""
    k = frame.intrinsics
    u, v = np.meshgrid(np.arange(0, k.width, STEP, dtype=float), np.arange(0, k.height, STEP, dtype=float))
    rays: Array = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones_like(u)], axis=-1) @ frame.world_from_camera[:3, :3].T
    return rays


def _points(frame: RgbdFrame, rays: Array, on: NDArray[np.bool_], nearest: float) -> Array:
    """What is seen (N, 3) about where the arm is drawn (h, w), but for the edges of depth."""
    pad = int(np.ceil(REACHES[0] * frame.intrinsics.fx / max(nearest, 0.1) / STEP))
    about = cv2.dilate(on.view(np.uint8), np.ones((2 * pad + 1,) * 2, np.uint8)).view(bool)
    depth = np.where(np.isfinite(frame.depth), frame.depth, np.float32(9.0)).astype(np.float32)
    window = np.ones((BESIDE,) * 2, np.uint8)
    smooth = (cv2.dilate(depth, window) - cv2.erode(depth, window))[::STEP, ::STEP] < JUMP
    seen = frame.depth[::STEP, ::STEP]
    told = about & smooth & np.isfinite(seen)
    points: Array = rays[told] * seen[told][:, None] + frame.world_from_camera[:3, 3]
    return points
