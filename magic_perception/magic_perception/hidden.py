"""What the robot hides: parts of one thing on both sides of it, and things that hang where nothing carries them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.camera import SURELY
from magic_core.mesh import Mesh
from magic_perception.looks import Looked
from magic_perception.pixels import opened, where, window

#: In images of labels: the robot, or what else of no interest stands before the scene (``RgbdFrame.blind``).
ROBOT = -2

#: Two parts of one thing: so many metres apart at most (what a hand across it hides), at heights that differ by no more than this...
GAP, LEVEL = 0.20, 0.02
#: ...and in colours that differ by no more than this (OpenCV's Lab of 8 bits).
COLOR = 40.0
#: Depth farther than this behind a place, metres, shows that the place is empty.
EMPTY = 0.02
#: What hangs: its lowest seen part is so high above the table, metres, and for most of it, and under its middle, the space below is seen to
#: be empty.
CLEAR, MOST = 0.03, 0.5
#: What is held is where what is held may be, by more than this share of its pixels.
HELD = 0.6
#: What is so narrow, pixels, may be the edge of something else; a part of what is held that is so wide, and where that cannot be, is
#: something else.
EDGE, APART = 5, 11
#: Pieces of no more than this share of what is surely held belong to it.
LOOSE = 0.25
#: What carries a thing out of sight is under its middle, within this, m, and is a part of it: no more than this share of its height, as a
#: ball's or an egg's underside and a vase's foot are.
FOOT, UNDERSIDE = 0.01, 0.4
#: What is nearer to a fixture than this (m) may hang on it.
AT_FIXTURE = 0.02


def veil(looks: list[Looked], labels: list[NDArray[np.int32]]) -> list[NDArray[np.int32]]:
    """Labels with ``ROBOT`` where a picture is blind; parts of one thing on both sides of a blind place get one label.

    Parts belong together where each ends at the same blind place, the way between them is seen to be empty by no camera, and height
    and colour are alike.  Labels stay in the order of their numbers, from 1 without gaps.
    """
    if all(look.frame.blind is None or not look.frame.blind.any() for look in looks):
        return labels
    labels = [image.copy() for image in labels]
    for look, image in zip(looks, labels, strict=True):
        if look.frame.blind is not None:
            image[look.frame.blind] = ROBOT
    top = max(int(image.max()) for image in labels)
    joined = np.arange(top + 1)
    for look, image in zip(looks, labels, strict=True):
        if look.frame.blind is None:
            continue
        ends = _ends(look, image)
        for a, b in ((a, b) for i, a in enumerate(ends) for b in ends[i + 1 :]):
            if a.label != b.label and a.place == b.place and joined[a.label] != joined[b.label] and _one_thing(a, b, looks, labels):
                joined[joined == max(joined[a.label], joined[b.label])] = min(joined[a.label], joined[b.label])
    present = np.zeros(top + 1, bool)
    for image in labels:
        present[joined[np.unique(image[image > 0])]] = True
    number = np.where(present, np.cumsum(present), 0)
    for image in labels:
        positive = image > 0
        image[positive] = number[joined[image[positive]]]
    return labels


def parted(looks: list[Looked], labels: list[NDArray[np.int32]]) -> list[NDArray[np.int32]]:
    """Labels with what the robot holds apart from what it is held to, under one label of its own.

    A thing that is mostly what is held is it, but for what of it is surely something else.  Of another thing what is surely held is
    taken away, with the scraps about it.
    """
    if all(look.frame.held is None for look in looks):
        return labels
    top = max((int(image.max()) for image in labels), default=0)
    own = top + 1
    tools = [n for n in range(1, top + 1) if mostly_held(looks, labels, n)]
    labels = [image.copy() for image in labels]
    for look, image in zip(looks, labels, strict=True):
        held = look.frame.held
        if held is None:
            continue
        for label in np.unique(image[(image > 0) & (held > 0)]):
            mask = image == label
            if label in tools:
                outside = mask & (held == 0)
                image[mask & ~_pieces(outside, opened(outside, APART))] = own
            else:
                # Where the two are told apart already, pixels at the edge are all that is taken for the other.
                sure = opened(mask & (held == SURELY), EDGE)
                if sure.any():
                    rest = mask & ~sure
                    count, pieces = cv2.connectedComponents(rest.view(np.uint8), connectivity=4)
                    size, near = np.bincount(pieces.ravel(), minlength=count), np.bincount(pieces[held > 0], minlength=count)
                    scraps = (near > HELD * size) & (size < LOOSE * np.count_nonzero(sure))
                    scraps[0] = False
                    image[sure | scraps[pieces]] = own
    present = np.unique(np.concatenate([image[image > 0] for image in labels]))
    number = np.zeros(own + 1, np.int32)
    number[present] = np.arange(1, len(present) + 1)
    for image in labels:
        image[image > 0] = number[image[image > 0]]
    return labels


def _pieces(mask: NDArray[np.bool_], seeds: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pieces of a mask (H, W) in which any of the seeds lies."""
    count, pieces = cv2.connectedComponents(mask.view(np.uint8), connectivity=4)
    chosen = np.bincount(pieces[seeds], minlength=count) > 0
    chosen[0] = False
    return chosen[pieces]


def mostly_held(looks: list[Looked], labels: list[NDArray[np.int32]], label: int) -> bool:
    """Whether a thing is what the robot holds: most of what is seen of it is where that may be, and a part where it surely is."""
    near = sure = count = 0
    for look, image in zip(looks, labels, strict=True):
        if look.frame.held is not None:
            held = look.frame.held[image == label]
            count, near, sure = count + held.size, near + np.count_nonzero(held), sure + np.count_nonzero(held == SURELY)
    return near > HELD * count and sure > 0


class _End:
    """Where a thing ends at a blind place in one picture: world points (N, 3), heights (N,), mean colour (3,) in Lab."""

    def __init__(self, label: int, place: int, look: Looked, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
        self.label, self.place = label, place
        self.points = look.points(rows, columns).astype(float)
        self.heights = look.heights[rows, columns]
        colors = look.frame.color[rows, columns][None]
        self.color = cv2.cvtColor(np.ascontiguousarray(colors), cv2.COLOR_RGB2LAB)[0].astype(float).mean(axis=0)


def _ends(look: Looked, labels: NDArray[np.int32]) -> list[_End]:
    """Where things end at blind places."""
    blind = (labels == ROBOT).view(np.uint8)
    count, places = cv2.connectedComponents(blind, connectivity=8)
    beside = cv2.dilate(blind, np.ones((13, 13), np.uint8)).view(bool) & (labels > 0) & np.isfinite(look.heights)
    if not beside.any():
        return []
    # The blind place nearest to each pixel beside one.
    _, index = cv2.distanceTransformWithLabels(1 - blind, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    place = np.zeros(int(np.count_nonzero(blind)) + 1, np.int32)
    place[index[blind > 0]] = places[blind > 0]
    rows, columns = np.nonzero(beside)
    key = labels[rows, columns].astype(np.int64) * count + place[index[rows, columns]]
    ends = []
    for value in np.unique(key):
        mine = np.nonzero(key == value)[0]
        if len(mine) >= 8:
            mine = mine[:: max(1, len(mine) // 200)]
            ends.append(_End(int(value // count), int(value % count), look, rows[mine], columns[mine]))
    return ends


def _one_thing(a: _End, b: _End, looks: list[Looked], labels: list[NDArray[np.int32]]) -> bool:
    """Whether what ends at both sides of a blind place goes on behind it."""
    if abs(np.median(a.heights) - np.median(b.heights)) > LEVEL or np.linalg.norm(a.color - b.color) > COLOR:
        return False
    distance = np.linalg.norm(a.points[:, None] - b.points[None], axis=-1)
    i, j = np.unravel_index(np.argsort(distance, axis=None)[:12], distance.shape)
    if distance[i[0], j[0]] > GAP:
        return False
    steps = np.linspace(0, 1, 14)[1:-1, None, None]
    ways = (1 - steps) * a.points[i] + steps * b.points[j]  # (12, 12, 3)
    empty, unseen = np.zeros(ways.shape[:2], bool), np.zeros(ways.shape[:2], bool)
    for look, image in zip(looks, labels, strict=True):
        label, free = _at(look, image, ways)
        unseen |= label == ROBOT
        empty |= free & (label != a.label) & (label != b.label)
    return bool(empty.mean() < 0.1 and unseen.mean() > 0.5)


def _at(look: Looked, labels: NDArray[np.int32], points: NDArray[np.float64]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """At world points (..., 3): the label of their pixels (0 outside of the picture), and whether depth shows them to be empty space."""
    k = look.frame.intrinsics
    local = transforms.apply(transforms.inverse(look.frame.world_from_camera), points)
    z = np.maximum(local[..., 2], 1e-3)
    u, v = np.rint(k.fx * local[..., 0] / z + k.cx), np.rint(k.fy * local[..., 1] / z + k.cy)
    inside = (local[..., 2] > 0.05) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    u, v = (np.where(inside, x, 0).astype(int) for x in (u, v))
    with np.errstate(invalid="ignore"):
        free = inside & (look.frame.depth[v, u] > local[..., 2] + EMPTY)
    return np.where(inside, labels[v, u], 0), free


def hangs(looks: list[Looked], labels: list[NDArray[np.int32]], label: int, fixtures: tuple[Mesh, ...] = ()) -> bool:
    """Whether a thing is above the table with nothing below that could carry it: a hand, an arm, a cable.

    What touches a fixture (world) may hang on it.  Where no camera sees what is below, a thing is taken to stand: so does a large ball,
    which goes on down out of sight from the lowest that is seen of it, to where it touches the table under its own middle.
    """
    clouds, heights = [], []
    for look, image in zip(looks, labels, strict=True):
        mask = image == label
        cut = window(mask)
        rows, columns = where(mask[cut] & np.isfinite(look.heights[cut]))
        rows, columns = rows + cut[0].start, columns + cut[1].start
        clouds.append(look.points(rows, columns).astype(float))
        heights.append(look.heights[rows, columns])
    points, height = np.concatenate(clouds), np.concatenate(heights)
    if len(points) < 20 or np.percentile(height, 5) < CLEAR:
        return False
    if fixtures and _touches(points[:: max(1, len(points) // 2000)], fixtures):
        return False
    order = np.argsort(height)[: max(20, len(points) // 10)]
    order = order[:: max(1, len(order) // 150)]
    feet = points - height[:, None] * looks[0].normal
    empty = seen_through(looks, labels, feet[order], height[order])
    if np.mean(empty) <= MOST:
        return False
    if np.percentile(height, 1) > UNDERSIDE * np.percentile(height, 98):
        return True
    low, high = np.percentile(feet, [2, 98], axis=0)
    beside = np.stack(np.meshgrid(*[np.linspace(-FOOT, FOOT, 5)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    under = (low + high) / 2 + beside
    return float(np.mean(seen_through(looks, labels, under, np.full(len(under), np.percentile(height, 5))))) > MOST


def seen_through(
    looks: list[Looked], labels: list[NDArray[np.int32]], feet: NDArray[np.float64], height: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """(N,): whether a camera sees an empty place in the columns that rise from the table at ``feet`` (N, 3) to just below ``height`` (N,),
    m."""
    at = 0.005 + np.linspace(0.1, 0.9, 9)[:, None] * (height.astype(float) - 0.015 - 0.005)
    ways = feet + at[..., None] * looks[0].normal
    empty = np.zeros(ways.shape[:2], bool)
    for look, image in zip(looks, labels, strict=True):
        empty |= _at(look, image, ways)[1]
    return empty.any(axis=0)


def _touches(points: NDArray[np.float64], fixtures: tuple[Mesh, ...]) -> bool:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    for mesh in fixtures:
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return bool(scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy().min() < AT_FIXTURE)
