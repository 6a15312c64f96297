"""Rigid transforms as 4x4 float64 matrices, and the only place that touches quaternions.

A transform is named for the frames it joins: ``world_from_tool`` takes
coordinates in the tool frame to coordinates in the world frame, so that
``world_from_tool @ tool_from_contact`` reads off as ``world_from_contact``.
ROS and SciPy order quaternions xyzw; SAPIEN and MPlib wxyz.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

Matrix = NDArray[np.float64]


def make(rotation: ArrayLike | None = None, translation: ArrayLike | None = None) -> Matrix:
    """Build a 4x4 transform from a 3x3 rotation and a translation in metres."""
    transform = np.eye(4)
    if rotation is not None:
        transform[:3, :3] = np.asarray(rotation, dtype=float)
    if translation is not None:
        transform[:3, 3] = np.asarray(translation, dtype=float)
    return transform


def inverse(transform: Matrix) -> Matrix:
    """Invert a rigid transform or a stack of them, (..., 4, 4)."""
    transform = np.asarray(transform, dtype=float)
    result = np.zeros_like(transform)
    rotation_t = np.swapaxes(transform[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, transform[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def apply(transform: Matrix, points: ArrayLike) -> NDArray[np.float64]:
    """Map points (..., 3) by a 4x4 transform."""
    transform = np.asarray(transform, dtype=float)
    return np.asarray(points, dtype=float) @ transform[:3, :3].T + transform[:3, 3]


def unit(vector: ArrayLike) -> NDArray[np.float64]:
    """Scale a vector to length one; raises ``ValueError`` for a zero or non-finite vector."""
    vector = np.asarray(vector, dtype=float)
    norm = float(np.linalg.norm(vector))
    if not np.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"a direction needs a finite length above zero: {vector}")
    return vector / norm


def frame(origin: ArrayLike, x_axis: ArrayLike, z_axis: ArrayLike) -> Matrix:
    """Right-handed frame from its origin, its x axis and a z axis.

    The x axis is kept; z is made orthogonal to it; y = z cross x.
    """
    x = unit(x_axis)
    z = np.asarray(z_axis, dtype=float)
    z = unit(z - (z @ x) * x)
    return make(np.column_stack([x, np.cross(z, x), z]), origin)


def from_quaternion(translation: ArrayLike, xyzw: ArrayLike) -> Matrix:
    """Build a transform from a translation and a quaternion in ROS order (x, y, z, w)."""
    return make(Rotation.from_quat(np.asarray(xyzw, dtype=float)).as_matrix(), translation)


#: By how much a quaternion's length may differ from 1 and be normalised: numbers rounded to one decimal
#: do; more is another rotation or none.
UNIT = 0.1


def from_numbers(numbers: ArrayLike) -> Matrix:
    """Build a transform from what somebody wrote or sent: x y z in metres and a quaternion x y z w,
    which is normalised where it nearly is one.

    Raises ``ValueError``, whose text says what is allowed.
    """
    values = np.asarray(numbers, dtype=float)
    return from_rows(values[None] if values.shape == (7,) else np.zeros((1, 7)))[0]


def from_rows(rows: NDArray[np.float64]) -> Matrix:
    """Transforms (N, 4, 4) of rows (N, 7), as :func:`from_numbers` makes each; raises its ``ValueError`` for the first that is none."""
    lengths = np.linalg.norm(rows[:, 3:], axis=1)
    fine = np.isfinite(rows).all(axis=1) & (lengths > 1 - UNIT) & (lengths < 1 + UNIT)
    if not fine.all():
        raise ValueError(
            f"seven finite numbers, the last four a quaternion (x, y, z, w) whose length, here {lengths[np.argmin(fine)]:.4g}, differs from 1 "
            f"by less than {UNIT:g}"
        )
    result = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        result[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
        result[:, :3, 3] = rows[:, :3]
    return result


def quaternion_xyzw(transform: Matrix) -> NDArray[np.float64]:
    """Rotation of a transform as a unit quaternion in ROS order (x, y, z, w), w >= 0."""
    q = Rotation.from_matrix(np.asarray(transform)[..., :3, :3]).as_quat()
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_wxyz(transform: Matrix) -> NDArray[np.float64]:
    """Rotation of a transform as a unit quaternion in SAPIEN's and MPlib's order (w, x, y, z)."""
    return np.roll(quaternion_xyzw(transform), 1, axis=-1)


def from_quaternion_wxyz(translation: ArrayLike, wxyz: ArrayLike) -> Matrix:
    """Build a transform from a translation and a quaternion ordered (w, x, y, z)."""
    return from_quaternion(translation, np.roll(np.asarray(wxyz, dtype=float), -1))


def from_rotvec(rotation_vector: ArrayLike, translation: ArrayLike | None = None) -> Matrix:
    """Build a transform from a rotation vector in radians and a translation."""
    return make(Rotation.from_rotvec(np.asarray(rotation_vector, dtype=float)).as_matrix(), translation)


def from_rpy(roll: float, pitch: float, yaw: float, translation: ArrayLike | None = None) -> Matrix:
    """Build a transform from REP-103 fixed-axis roll, pitch, yaw in radians."""
    return make(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), translation)


def rotation_angle(a: Matrix, b: Matrix) -> float:
    """Angle in radians between the rotations of two transforms."""
    return float(Rotation.from_matrix(np.asarray(a)[:3, :3].T @ np.asarray(b)[:3, :3]).magnitude())


def interpolate(times: ArrayLike, transforms: Matrix, at: ArrayLike) -> Matrix:
    """Sample a pose trajectory: linear in translation, spherical in rotation.

    ``times`` (T,) strictly increasing, ``transforms`` (T, 4, 4), ``at`` (N,) ->
    (N, 4, 4).  Times outside the range take the first or last pose.
    """
    times = np.asarray(times, dtype=float)
    transforms = np.asarray(transforms, dtype=float)
    at = np.clip(np.asarray(at, dtype=float), times[0], times[-1])
    if len(times) == 1:
        return np.repeat(transforms[:1], len(at), axis=0)
    result = np.tile(np.eye(4), (len(at), 1, 1))
    result[:, :3, :3] = Slerp(times, Rotation.from_matrix(transforms[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        result[:, axis, 3] = np.interp(at, times, transforms[:, axis, 3])
    return result
