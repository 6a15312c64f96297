"""Spheres and upright cylinders, where the points say so: the target objects of most tasks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magic_core.mesh import Mesh
from magic_perception.percentiles import percentile
from magic_perception.solids import Reconstruction

#: Steps of a full turn of what is turned to a ring.
SEGMENTS = 48


@dataclass(frozen=True)
class Sphere:
    """centre (3,) and radius in metres; ``residual`` is the 90th percentile of the points' distances to the surface."""

    centre: NDArray[np.float64]
    radius: float
    residual: float


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder on the table z = 0: centre (2,), radius and height in metres; ``residual`` as for Sphere."""

    centre: NDArray[np.float64]
    radius: float
    height: float
    residual: float


def fit_circle(points: NDArray[np.float64], rounds: int = 4) -> tuple[NDArray[np.float64], float]:
    """Centre (2,) and radius of the circle through points (N, 2), by least squares, refitted to the nearest 80 %."""
    kept = points
    centre, radius = points.mean(axis=0), 0.0
    for _ in range(rounds):
        mean = kept.mean(axis=0)
        local = kept - mean
        # From their middle the centre is told without the radius.
        squared = np.einsum("ij,ij->i", local, local)
        offset = np.linalg.lstsq(local.T @ local, 0.5 * (local.T @ squared), rcond=None)[0]
        centre = mean + offset
        radius = float(np.sqrt(squared.mean() + offset @ offset))
        residual = np.abs(np.hypot(*(points - centre).T) - radius)
        kept = points[residual <= max(percentile(residual, 80), 1e-4)]
    return centre, radius


def likeliest_circle(
    sample: NDArray[np.float64], height: float, band: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], float] | None:
    """Centre and radius of the circle through three points of one level, seen from above, near which most points lie."""
    slices = np.digitize(sample[:, 2], np.linspace(0, height, 9))
    members = [np.nonzero(slices == i)[0] for i in np.unique(slices)]
    members = [m for m in members if len(m) > 8]
    if not members:
        return None
    # All hypotheses at once.
    counts = np.array([len(m) for m in members])
    level = rng.integers(len(members), size=160)
    drawn = rng.integers(np.repeat(counts[level], 3)).reshape(-1, 3)
    picked = sample[np.concatenate(members)[(np.cumsum(counts) - counts)[level][:, None] + drawn], :2]
    a = 2 * (picked[:, 1:] - picked[:, :1])
    rhs = np.sum(picked[:, 1:] ** 2, axis=2) - np.sum(picked[:, :1] ** 2, axis=2)
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    sound = np.abs(det) > 1e-7
    a, rhs, det, first = a[sound], rhs[sound], det[sound], picked[sound, 0]
    centres = (
        np.column_stack([rhs[:, 0] * a[:, 1, 1] - rhs[:, 1] * a[:, 0, 1], a[:, 0, 0] * rhs[:, 1] - a[:, 1, 0] * rhs[:, 0]]) / det[:, None]
    )
    radii = np.hypot(*(first - centres).T)
    sound = (radii > 0.01) & (radii < 0.12)
    centres, radii = centres[sound], radii[sound]
    if len(radii) == 0:
        return None
    few = sample[:1200]
    squared = (few[:, 0] - centres[:, :1]) ** 2 + (few[:, 1] - centres[:, 1:]) ** 2
    # |distance - radius| < 1.5 bands, without a root for each of 160 circles and 1200 points.
    on = (squared < ((radii + 1.5 * band) ** 2)[:, None]) & (squared > (np.maximum(radii - 1.5 * band, 0.0) ** 2)[:, None])
    i = int(np.argmax(np.count_nonzero(on, axis=1)))
    return centres[i], float(radii[i])


def fit_sphere(points: NDArray[np.float64]) -> Sphere | None:
    """The sphere through points (N, 3), by least squares, refitted to the nearest 85 %; ``None`` for fewer than 30 points."""
    if len(points) < 30:
        return None
    kept = points
    for _ in range(4):
        mean = kept.mean(axis=0)
        local = kept - mean
        solution = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), np.sum(local**2, axis=1), rcond=None)[0]
        centre = mean + solution[:3]
        radius = float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0)))
        residual = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        kept = points[residual <= percentile(residual, 85)]
    return Sphere(centre, radius, float(np.percentile(residual, 90)))


def fit_cylinder(points: NDArray[np.float64]) -> Cylinder | None:
    """The upright cylinder that stands on z = 0 and has the points (N, 3) on its side or its top; ``None`` where there are too few, or
    where a part of them tells of something else (a handle, a hollow)."""
    height = float(np.percentile(points[:, 2], 98))
    top = points[points[:, 2] > height - max(0.004, 0.06 * height)]
    side = points[(points[:, 2] < height - max(0.005, 0.08 * height)) & (points[:, 2] > 0.15 * height)]
    if len(side) < 30 or len(top) < 10:
        return None
    centre, radius = fit_circle(side[:, :2])
    if not 0.004 < radius < 0.15:
        return None
    height = float(np.median(top[:, 2]))
    outward = np.linalg.norm(points[:, :2] - centre, axis=1) - radius
    above = points[:, 2] - height
    # Distance to the surface of the solid: from inside the nearer of side and top, from outside the true distance.
    distance = np.where((outward < 0) & (above < 0), np.minimum(-outward, -above), np.hypot(np.maximum(outward, 0), np.maximum(above, 0)))
    # A handle, or a mug's inside, is a small share of the points but no noise.
    inside = points[outward < -0.4 * radius]
    if float(np.mean(distance > max(0.008, 0.12 * radius))) > 0.03 or (
        len(inside) > 20 and float(np.median(inside[:, 2])) < height - max(0.008, 0.1 * height)
    ):
        return None
    return Cylinder(centre, radius, height, float(np.percentile(distance, 90)))


def recognise(points: NDArray[np.float64], height: float, noise: float) -> Reconstruction | None:
    """The ball or upright cylinder that the points (N, 3) lie on; ``None`` where they tell of something else.

    height: of the points above the table; noise: standard deviation of the heights; metres.
    """
    if height < 0.012 or height > 0.3:
        return None
    sample = points[:: max(1, len(points) // 1500)]
    sample = sample[sample[:, 2] > min(0.004, 0.1 * height)]
    if len(sample) < 40:
        return None
    limit = max(0.0025, 2.5 * noise)
    ball = fit_sphere(sample)
    tin = fit_cylinder(sample)
    if ball is not None and not (
        0.006 < ball.radius < 0.12 and ball.residual < limit and abs(ball.centre[2] - ball.radius) < max(0.005, 0.2 * ball.radius)
    ):
        ball = None
    if tin is not None and not (tin.residual < limit and tin.radius < 0.13 and tin.height > 0.3 * tin.radius):
        tin = None
    if ball is not None and (tin is None or ball.residual < tin.residual):
        # It touches the table: its height above it is its radius, to which both measurements count.
        radius = (ball.radius + (ball.centre[2] + ball.radius) / 2) / 2
        ball = Sphere(np.array([*ball.centre[:2], radius]), radius, ball.residual)
        mesh = sphere_mesh(ball)
        return Reconstruction(mesh, (sphere_mesh(ball, 2),), "sphere")
    if tin is not None:
        profile = np.array([[tin.radius, 0], [tin.radius, tin.height]])
        mesh = revolve(profile, tin.centre)
        return Reconstruction(mesh, (mesh,), "cylinder")
    return None


def sphere_mesh(sphere: Sphere, subdivisions: int = 3) -> Mesh:
    """An icosphere whose volume is that of the sphere to a percent."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=sphere.radius)
    return Mesh(ball.vertices + sphere.centre, ball.faces)


def revolve(profile: NDArray[np.float64], centre: NDArray[np.float64], segments: int = 48) -> Mesh:
    """The solid that a polyline (K, 2) of (radius, z) sweeps about the upright axis through ``centre`` (2,).

    The line starts and ends on the axis (radius 0) or is closed there; it runs so that the solid lies on its left
    (from the bottom up on the outside).  Watertight.
    """
    profile = np.asarray(profile, float)
    if profile[0, 0] > 0:
        profile = np.vstack([[0.0, profile[0, 1]], profile])
    if profile[-1, 0] > 0:
        profile = np.vstack([profile, [0.0, profile[-1, 1]]])
    inner = profile[1:-1]
    angle = np.arange(segments) * 2 * np.pi / segments
    rings = np.stack(
        [inner[:, None, 0] * np.cos(angle), inner[:, None, 0] * np.sin(angle), np.repeat(inner[:, 1:2], segments, axis=1)], axis=-1
    )
    k = len(inner)
    vertices = np.concatenate([rings.reshape(-1, 3), [[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]]])
    vertices[:, :2] += centre
    i = np.arange(segments)
    j = (i + 1) % segments
    faces = []
    for row in range(k - 1):
        a, b = row * segments, (row + 1) * segments
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    last = (k - 1) * segments
    faces.append(np.column_stack([np.full(segments, k * segments), j, i]))
    faces.append(np.column_stack([np.full(segments, k * segments + 1), last + i, last + j]))
    return Mesh(vertices, np.concatenate(faces))


def turn_ring(profile: NDArray[np.float64], centre: NDArray[np.float64]) -> Mesh:
    """The ring that a closed polyline (K, 2) of (radius, z), radius above 0, sweeps about the upright axis through ``centre`` (2,).

    The line runs counter-clockwise in (radius, z).  Watertight, of genus 1.
    """
    profile = np.asarray(profile, float)
    angle = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    k = len(profile)
    vertices = np.stack(
        [profile[:, None, 0] * np.cos(angle), profile[:, None, 0] * np.sin(angle), np.repeat(profile[:, 1:2], SEGMENTS, axis=1)], axis=-1
    ).reshape(-1, 3)
    vertices[:, :2] += centre
    i = np.arange(SEGMENTS)
    j = (i + 1) % SEGMENTS
    faces = []
    for row in range(k):
        a, b = row * SEGMENTS, ((row + 1) % k) * SEGMENTS
        faces += [np.column_stack([a + i, a + j, b + j]), np.column_stack([a + i, b + j, b + i])]
    return Mesh(vertices, np.concatenate(faces))
