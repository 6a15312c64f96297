"""How much of a thing was seen, and what kept the rest out of sight."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import scene, transforms
from magic_core.mesh import Mesh
from magic_core.scene import FIXTURE, PICTURE, REGION
from magic_perception.hidden import ROBOT
from magic_perception.looks import Looked
from magic_perception.parameters import Parameters
from magic_perception.sight import Sight

#: A thing is cut off where at least so much of its outline, m, borders on what hides it.
LEAST = 0.010
#: What hides a thing is nearer than it by this, m.
NEARER = 0.012
#: Pixels around a cut within which the outline tells nothing.
AROUND = 8
#: Depth beside an edge is compared so many pixels across it.
ACROSS = 4
#: Points of a solid's surface that are looked at from each camera.
POINTS = 800


@dataclass(frozen=True)
class Cut:
    """What cuts a thing off in one camera, by its name, and the pixels (row, column) (N, 2) of the thing's outline there."""

    by: int | str
    pixels: NDArray[np.int64]


def cuts(look: Looked, labels: NDArray[np.int32], label: int, parameters: Parameters) -> list[Cut]:
    """Where the picture's border, the region's, or something nearer ends a mask; ``by`` is a label where that is another thing."""
    mask = labels == label
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    if w == 0:
        return []
    pad = 6
    r0, c0 = max(y - pad, 0), max(x - pad, 0)
    cut = (slice(r0, y + h + pad), slice(c0, x + w + pad))
    mine, others = mask[cut], labels[cut]
    depth = look.frame.depth[cut]
    known = mine & np.isfinite(depth)
    if not known.any():
        return []
    # The thing's own depth around each pixel of its outline.
    share = cv2.blur(known.astype(np.float32), (11, 11))
    own = cv2.blur(np.where(known, depth, 0).astype(np.float32), (11, 11)) / np.maximum(share, 1e-6)
    scale = float(np.median(depth[known])) / look.frame.intrinsics.fx
    outline = mine & (cv2.erode(mine.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) == 0)
    found = []

    def add(by: int | str, where: NDArray[np.bool_]) -> None:
        rows, columns = np.nonzero(outline & where)
        if len(rows) * scale >= LEAST:
            found.append(Cut(by, np.column_stack([rows + r0, columns + c0])))

    edge = np.zeros(mask.shape, bool)
    edge[:2] = edge[-2:] = True
    edge[:, :2] = edge[:, -2:] = True
    add(PICTURE, edge[cut])
    # The region cuts where the thing itself is at its side: what lies far behind a tall thing's edge may be outside too.
    rows, columns = np.nonzero(outline & ~edge[cut])
    k, pose = look.frame.intrinsics, look.frame.world_from_camera
    rays = np.column_stack([(columns + c0 - k.cx) / k.fx, (rows + r0 - k.cy) / k.fy, np.ones(len(rows))])
    points = (rays * own[rows, columns, None]) @ pose[:3, :3].T + pose[:3, 3]
    low, high = np.asarray(parameters.region_low), np.asarray(parameters.region_high)
    aside = np.zeros(outline.shape, bool)
    aside[rows, columns] = np.any((points[:, :2] < low[:2] + LEAST) | (points[:, :2] > high[:2] - LEAST), axis=1)
    beyond = (~look.inside[cut] & ~mine & (others != ROBOT)).astype(np.uint8)
    add(REGION, aside & (cv2.dilate(beyond, np.ones((5, 5), np.uint8)) > 0))
    near = cv2.dilate(mine.view(np.uint8), np.ones((7, 7), np.uint8)) > 0
    with np.errstate(invalid="ignore"):
        # Of a fixture or the robot there may be no depth.
        front = near & (others != 0) & ~mine & (share > 0) & ((depth < own - NEARER) | ((others < 0) & ~np.isfinite(depth)))
    for by in np.unique(others[front]):
        name = int(by) if by > 0 else scene.ROBOT if by == ROBOT else FIXTURE
        add(name, cv2.dilate((front & (others == by)).view(np.uint8), np.ones((7, 7), np.uint8)) > 0)
    return found


def cut_off(looks: list[Looked], labels: list[NDArray[np.int32]], label: int, parameters: Parameters) -> list[int | str]:
    """What keeps a part of a thing out of the sight of all cameras: ``picture``, ``region``, ``fixture``, or labels of other things.

    A cut in one camera counts unless another camera sees the thing there and is not cut there itself.
    """
    by_camera = [cuts(look, image, label, parameters) for look, image in zip(looks, labels, strict=True)]
    result: list[int | str] = []
    for i, found in enumerate(by_camera):
        for cut in found:
            if cut.by not in result and not any(
                _sees(looks[k], labels[k] == label, by_camera[k], looks[i], cut.pixels) for k in range(len(looks)) if k != i
            ):
                result.append(cut.by)
    return result


def _sees(other: Looked, mask: NDArray[np.bool_], cuts_there: list[Cut], look: Looked, pixels: NDArray[np.int64]) -> bool:
    """Whether a camera sees most of the thing at an outline that is cut in another."""
    if not mask.any():
        return False
    points = look.points(pixels[:, 0], pixels[:, 1])
    points = points[np.isfinite(points[:, 0])]
    if len(points) < 3:
        return False
    k = other.frame.intrinsics
    local = transforms.apply(transforms.inverse(other.frame.world_from_camera), points.astype(float))
    z = np.maximum(local[:, 2], 1e-3)
    u, v = np.round(k.fx * local[:, 0] / z + k.cx).astype(int), np.round(k.fy * local[:, 1] / z + k.cy).astype(int)
    inside = (u >= AROUND) & (u < k.width - AROUND) & (v >= AROUND) & (v < k.height - AROUND)
    wide = cv2.dilate(mask.view(np.uint8), np.ones((9, 9), np.uint8)) > 0
    for cut in cuts_there:
        blind = np.zeros(mask.shape, np.uint8)
        blind[cut.pixels[:, 0], cut.pixels[:, 1]] = 1
        wide &= cv2.dilate(blind, np.ones((2 * AROUND + 1,) * 2, np.uint8)) == 0
    return float(np.mean(inside & wide[np.clip(v, 0, k.height - 1), np.clip(u, 0, k.width - 1)])) > 0.7


def joined(looks: list[Looked], labels: list[NDArray[np.int32]], label: int) -> float:
    """The share, 0..1, of a thing's outline along which another thing goes on at its depth, in the camera where that is largest: there they
    touch, and may be one thing that a seam has parted."""
    largest = 0.0
    for look, image in zip(looks, labels, strict=True):
        x, y, w, h = cv2.boundingRect((image == label).view(np.uint8))
        if w == 0:
            continue
        cut = (slice(max(y - ACROSS, 0), y + h + ACROSS), slice(max(x - ACROSS, 0), x + w + ACROSS))
        part, depth = image[cut], look.frame.depth[cut]
        mine = part == label
        outline = mine & (cv2.erode(mine.view(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) == 0)
        touching = 0
        for axis in range(2):
            turned, z = np.moveaxis(part, axis, 0), np.moveaxis(depth, axis, 0)
            one, two = turned[:-ACROSS], turned[ACROSS:]
            meets = ((one == label) & (two > 0) & (two != label)) | ((two == label) & (one > 0) & (one != label))
            with np.errstate(invalid="ignore"):
                touching += int(np.count_nonzero(meets & (np.abs(z[ACROSS:] - z[:-ACROSS]) < NEARER)))
        largest = max(largest, touching / ACROSS / max(int(np.count_nonzero(outline)), 1))
    return min(largest, 1.0)


@dataclass(frozen=True)
class Witnessed:
    """How a solid and what the cameras saw of it go together.

    seen: share of the solid's surface, what rests on the table left out, that a camera saw.  residual: median distance in metres
    between measured and drawn depth; far: share of the measured points farther than 6 mm from it.
    """

    seen: float
    residual: float
    far: float


def witnessed(mesh: Mesh, sights: list[Sight]) -> Witnessed:
    """Sample the surface of a solid (table frame) and look at it from each camera."""
    import open3d as o3d

    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(area, 1e-12)[:, None]
    lying = (corners[..., 2].max(axis=1) < 0.003) & (normal[:, 2] < -0.5)
    weight = np.where(lying, 0, area)
    if weight.sum() <= 0:
        return Witnessed(0.0, 1.0, 1.0)
    rng = np.random.default_rng(0)
    face = rng.choice(len(weight), POINTS, p=weight / weight.sum())
    a, b = rng.random((2, POINTS))
    swap = a + b > 1
    a[swap], b[swap] = 1 - a[swap], 1 - b[swap]
    points = corners[face, 0] + a[:, None] * (corners[face, 1] - corners[face, 0]) + b[:, None] * (corners[face, 2] - corners[face, 0])
    normals = normal[face]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    seen = np.zeros(POINTS, bool)
    gaps = []
    for sight in sights:
        toward = sight.eye - points
        distance = np.linalg.norm(toward, axis=1)
        facing = np.sum(normals * toward, axis=1) > 0.1 * distance
        inside, blind, z, measured = sight.sample(points)
        visible = facing & (inside > 0.5) & ~blind
        start = (points + 0.0015 * toward / distance[:, None])[visible]
        rays = np.concatenate([start, sight.eye - start], axis=1).astype(np.float32)
        visible[visible] = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() > 1
        with np.errstate(invalid="ignore"):
            near = ~np.isfinite(measured) | (np.abs(measured - z) < 0.012)
        seen |= visible & near
        told = visible & np.isfinite(measured)
        # Along the normal: at a grazing look a small gap is a large one along the ray.
        cosine = np.sum(normals * toward, axis=1) / distance
        gaps.append(np.abs(measured - z)[told] * cosine[told])
    every = np.concatenate(gaps)
    if len(every) < 10:
        return Witnessed(float(seen.mean()), 1.0, 1.0)
    return Witnessed(float(seen.mean()), float(np.median(every)), float(np.mean(every > 0.006)))
