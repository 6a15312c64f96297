"""Frames in, scene out."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import scene, transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import FIXTURE, PICTURE, REGION, UNSEEN, Scene, SceneObject
from magic_core.views import find_view
from magic_perception import attached, cameras, clusters, keyframes
from magic_perception.confidence import Evidence, chance
from magic_perception.glass import once, unmeasured
from magic_perception.hidden import ROBOT, hangs, mostly_held, parted, veil
from magic_perception.parameters import Parameters
from magic_perception.reconstruction import Reconstruction, Sight, reconstruct
from magic_perception.room import bordered, room
from magic_perception.seen import cut_off, joined, witnessed
from magic_perception.segmentation import DepthSegmenter, Looked, Segmenter, _frame_on, each, find_table, look
from magic_perception.sight import agreement
from magic_perception.smear import behind
from magic_perception.solids import hangs_together, hull_of
from magic_perception.surface_error import Departure, departure, likely

#: Round an object in its picture, as a share of its longer side.
MARGIN = 0.15
#: Behind others a thing may go on by this, m, and is told whole; and by the second where some camera has the thing itself before it.
BEHIND, AROUND = 0.015, 0.03
#: Between parts of one solid that are farther from each other, m, is one that nobody saw.
GAP = 0.006
#: Two things are likely parts of one that a seam has parted where they touch (m), and, within so much of that place (m), have one height (m) and one chromaticity.
TOUCHING, THERE, LEVEL, SHADE = 0.003, 0.02, 0.005, 0.02


@dataclass
class Report:
    """What perceive() can tell besides the scene: what it left out and why, and by stage the seconds by the clock and of all processors.

    labels: of the frames; numbers: the label of each object, by its id in the scene.  cameras: how far each pair of cameras disagrees.  earlier: the earlier frames with what has become of each, blind where newer
    ones contradict it.  Stages: ``table``, ``masks``, ``cameras``, ``meshes`` (with convex pieces), ``views`` (colours and canonical views).
    """

    seconds: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    labels: list[NDArray[np.int32]] = field(default_factory=list)
    numbers: dict[str, int] = field(default_factory=dict)
    shapes: dict[str, str] = field(default_factory=dict)
    pixels: dict[str, int] = field(default_factory=dict)
    cameras: list[cameras.Disagreement] = field(default_factory=list)
    earlier: list[tuple[RgbdFrame, RgbdFrame]] = field(default_factory=list)
    evidence: dict[str, Evidence] = field(default_factory=dict)
    departures: dict[str, Departure] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Take the time of what runs inside."""
        start, used = time.perf_counter(), time.process_time()
        yield
        self.seconds[name], self.cpu[name] = time.perf_counter() - start, time.process_time() - used


def perceive(
    frames: list[RgbdFrame],
    known: tuple[SceneObject, ...] = (),
    parameters: Parameters = Parameters(),
    segmenter: Segmenter | None = None,
    report: Report | None = None,
    earlier: Sequence[RgbdFrame] = (),
) -> Scene:
    """What stands and lies on the table.

    frames: one for each camera, taken at nearly the same time, with poses in one world whose z is up.  known: fixtures,
    taken over into the scene; what belongs to them is left out of the segmentation.  Objects are numbered by size
    (``object_1``, ...); :class:`magic_perception.tracking.Tracker` makes the numbers stable from call to call.
    earlier: frames of the same scene from before (:class:`magic_perception.keyframes.Keyframes`), oldest first: they show what the frames do not,
    as far as no newer one contradicts them.  What they alone show is told, and marked ``unseen``.

    What the robot holds (``RgbdFrame.held``) is an object of its own.

    Raises ``NO_FRAMES`` without frames, ``NO_DEPTH`` where no frame has depth in the region of interest, ``NO_TABLE``,
    ``CAMERAS_DISAGREE`` where the cameras' poses contradict each other by more than may be corrected.
    An empty table is a scene without objects.
    """
    report = report if report is not None else Report()
    segmenter = segmenter or DepthSegmenter()
    if not frames:
        raise MagicError(Code.NO_FRAMES, "frames", 0, "at least one RGB-D frame")
    given = frames
    seeing = [bool(np.isfinite(frame.depth).sum() >= 100) for frame in given]
    report.notes += [f"{frame.camera}: no depth" for frame, sees in zip(given, seeing, strict=True) if not sees]
    if not any(seeing):
        raise MagicError(
            Code.NO_DEPTH, "pixels with depth", {f.camera: int(np.isfinite(f.depth).sum()) for f in frames}, "at least 100 in one camera"
        )
    frames, now = [*(frame for frame, sees in zip(given, seeing, strict=True) if sees), *(frame.free for frame in earlier)], sum(seeing)
    with report.stage("table"):
        table, own = find_table(frames, parameters, report.notes)
        world_from_table = _frame_on(table, np.eye(4))
        if parameters.snap_height > 0 and table.tilt() < parameters.snap_tilt and abs(table.heights(np.zeros(3))) < parameters.snap_height:
            world_from_table = np.eye(4)
        looks = each(lambda pair: look(*pair, world_from_table, parameters), list(zip(frames, own, strict=True)), parameters.workers)

    with report.stage("masks"):
        fixtures = tuple(item.mesh.transformed(item.world_from_object) for item in known if len(item.mesh.faces))
        labels = parted(looks, veil(looks, segmenter.segment(looks, fixtures, parameters)))
        if earlier:
            stale = keyframes.contradicted(looks, labels, now, world_from_table)
            for i, pixels in enumerate(stale, now):
                if pixels.any():
                    frames[i] = frames[i].blinded(pixels)
                    looks[i] = look(frames[i], own[i], world_from_table, parameters)
            if any(pixels.any() for pixels in stale):
                labels = parted(looks, veil(looks, segmenter.segment(looks, fixtures, parameters)))
            report.earlier = list(zip(earlier, frames[now:], strict=True))

    with report.stage("cameras"):
        poses = [frame.world_from_camera for frame in frames]
        # One camera alone is measured against where it was before.
        count = now if now > 1 else len(looks)
        hanging = _hanging(looks, labels, fixtures)
        still = [_at_rest(image, hanging) for image in labels[:count]]
        pairs = cameras.measure(looks[:count], still, poses[:count], world_from_table, parameters.seed)
        report.cameras = pairs
        worst = max(pairs, key=lambda pair: (pair.beyond, pair.offset), default=None)
        if worst is not None and worst.beyond:
            raise MagicError(
                Code.CAMERAS_DISAGREE,
                "poses of the cameras",
                str(worst),
                f"up to {1000 * cameras.MOST_OFFSET:.0f} mm and {np.degrees(cameras.MOST_ANGLE):.1f} degrees; calibrate them again",
            )
        for pair in pairs:
            if pair.certain:
                report.notes.append(f"cameras disagree: {pair}" + ("; brought together half way" if now == 2 else ""))
            elif pair.offset > cameras.MOST_OFFSET:
                report.notes.append(f"cameras may disagree: {pair}; more things in common view would tell")
        both = sum(bool((image > 0).any()) for image in labels[:count]) > 1
        if both and not pairs:
            report.notes.append("whether the cameras agree could not be measured: they see no side of anything in common")
        if now == 2 and worst is not None and worst.certain:
            # What a camera saw from where it still stands is off as it is now.
            here = [
                any(keyframes.alike(each.frame, other.frame, keyframes.STILL, keyframes.STEADY) for other in looks[:now]) for each in looks
            ]
            moved = cameras.brought_together(looks, worst, world_from_table)
            looks = [after if same else before for before, after, same in zip(looks, moved, here, strict=True)]
            labels = parted(looks, veil(looks, segmenter.segment(looks, fixtures, parameters)))
            hanging = _hanging(looks, labels, fixtures)
        found = iter(labels[:now])
        report.labels = [next(found) if sees else np.zeros(frame.depth.shape, np.int32) for frame, sees in zip(given, seeing, strict=True)]
        blank = [item for look, image in zip(looks[:now], labels[:now], strict=True) for item in unmeasured(look, image, world_from_table)]
        report.notes += [f"[{int(Code.NO_DEPTH)} {Code.NO_DEPTH.name}] {item}" for item in once(blank)]

    offset, angle = (worst.offset, worst.angle) if worst is not None else (np.nan, np.nan)
    # Cameras of which nothing is known may be as far apart as would be borne.
    apart = offset if worst is not None else cameras.MOST_OFFSET if both else 0.0

    def build(label: int) -> _Built | MagicError:
        try:
            return _build(label, looks, labels, now, label in hanging, world_from_table, apart, parameters)
        except MagicError as error:
            return error

    with report.stage("meshes"):
        before = [image.copy() for image in labels]
        numbers = list(range(1, max((int(image.max()) for image in labels), default=0) + 1))
        solids: list[_Built] = []
        ids: dict[int | str, str] = {}
        for label, built in zip(numbers, each(build, numbers, parameters.workers), strict=True):
            if isinstance(built, MagicError):
                report.notes.append(f"cluster {label} left out: {built.message}")
                for image in labels:
                    image[image == label] = 0
            else:
                solids.append(built)
                ids[label] = f"object_{len(solids)}"
                report.numbers[ids[label]] = label
        hidden = each(lambda built: _hidden(built, solids, looks, before, fixtures, world_from_table), solids, parameters.workers)

    with report.stage("views"):
        objects = []
        made = each(lambda built: _as_object(built, world_from_table), solids, parameters.workers)
        for built, names, item in zip(solids, hidden, made, strict=True):
            # What hides a thing and was left out itself is as nameless as a fixture.
            by = tuple(dict.fromkeys(by if isinstance(by, str) else ids.get(by, FIXTURE) for by in names))
            item = replace(
                item, id=f"object_{len(objects) + 1}", cut_off=by, seen_share=built.evidence.witnessed.seen, hanging=built.hanging
            )
            if item.hanging:
                x, y, z = item.world_from_box[:3, 3]
                report.notes.append(
                    f"something hangs above the table, with nothing below that carries it, at ({x:.2f}, {y:.2f}, {z:.2f}) m"
                )
            report.evidence[item.id], report.departures[item.id] = built.evidence, built.departed
            report.shapes[item.id], report.pixels[item.id] = built.solid.shape, built.pixels
            objects.append(item)
    plane = np.append(world_from_table[:3, 2], -world_from_table[:3, 2] @ world_from_table[:3, 3])
    stamp = max(frame.stamp for frame in frames)
    return Scene((*objects, *known), plane, stamp, camera_offset=offset, camera_angle=angle, notes=tuple(report.notes))


def _hanging(looks: list[Looked], labels: list[NDArray[np.int32]], fixtures: tuple[Mesh, ...]) -> set[int]:
    """The labels of what hangs above the table."""
    top = max((int(image.max()) for image in labels), default=0)
    return {label for label in range(1, top + 1) if mostly_held(looks, labels, label) or hangs(looks, labels, label, fixtures)}


def _at_rest(labels: NDArray[np.int32], hanging: set[int]) -> NDArray[np.int32]:
    """The labels (H, W) of a picture without what may be on its way: what hangs, and what the robot is before, or holds.  Two cameras' pictures are not of one
    moment: that they see such a thing at two places does not speak against their poses."""
    beside = cv2.dilate((labels == ROBOT).view(np.uint8), np.ones((7, 7), np.uint8)).view(bool)
    doubtful = hanging | set(np.unique(labels[beside & (labels > 0)]).tolist())
    return np.where(np.isin(labels, sorted(doubtful)), 0, labels) if doubtful else labels


@dataclass(frozen=True)
class _Built:
    """The label of a thing, its solid in the table frame, the cleaned cloud (N, 3) of the world with its colours, the mask in the camera that saw most of it, its pixels there,
    and the picture (h, w, 3) about it."""

    label: int
    solid: Reconstruction
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    camera: str
    pixels: int
    picture: NDArray[np.uint8]
    evidence: Evidence
    departed: Departure
    hanging: bool


def _build(
    label: int,
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    now: int,
    hanging: bool,
    world_from_table: NDArray[np.float64],
    apart: float,
    parameters: Parameters,
) -> _Built:
    """The solid of the object with that label, and what was seen of it; now: so many looks are no earlier ones; hanging: nothing carries it; apart: how far the cameras disagree, m."""
    table_from_world = transforms.inverse(world_from_table)
    sights, clouds, paints, counts = [], [], [], []
    for looked, image in zip(looks, labels, strict=True):
        mask = image == label
        counts.append(int(np.count_nonzero(mask)))
        if counts[-1] < 20:
            continue
        x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
        cut = (slice(y, y + h), slice(x, x + w))
        sigma = float(np.median(looked.sigma[cut][mask[cut]][::7]))
        hidden = (image != 0) & ~mask
        # What colour gives to the thing and depth to the table behind it has no depth.
        lost = behind(mask, looked.heights)
        depth, heights = (np.where(lost, np.float32(np.nan), values) for values in (looked.frame.depth, looked.heights))
        sights.append(
            Sight(looked.frame.intrinsics, table_from_world @ looked.frame.world_from_camera, mask, hidden, depth, heights, sigma)
        )
        rows, columns = np.nonzero(mask[cut] & np.isfinite(heights[cut]))
        clouds.append(looked.points(rows + y, columns + x))
        paints.append(looked.frame.color[rows + y, columns + x])
    if not sights:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "pixels of the object", max(counts), "at least 20 in one camera")
    points, colors = np.concatenate(clouds).astype(float), np.concatenate(paints)
    keep = clusters.largest(points, parameters.cluster_eps, parameters.cluster_points, 0.006)
    points, colors = points[keep], colors[keep]
    cut = cut_off(looks, labels, label, parameters)
    if max(counts[:now]) < parameters.min_pixels:
        cut.append(UNSEEN)
    # A wall, a monitor, a person: no thing on the table.
    across = float(np.ptp(np.percentile(points[:: max(1, len(points) // 500)], [1, 99], axis=0), axis=0).max())
    if across > parameters.max_extent and any(by in (PICTURE, REGION) for by in cut) and not hanging:
        raise MagicError(
            Code.OBJECT_CUT_OFF,
            "extent in metres of something that the picture or the region cuts; motions do not avoid it",
            round(across, 2),
            f"up to {parameters.max_extent}",
        )
    # Of a hand, or of what is in one, its place is asked, and it is elsewhere in the next scene.
    seen_alone = hull_of(transforms.apply(table_from_world, points)) if hanging else None
    solid = reconstruct(sights, parameters) if seen_alone is None else Reconstruction(seen_alone, (seen_alone,), "hull")
    evidence = Evidence(
        solid.shape,
        solid.fit or agreement(solid.mesh, sights),
        witnessed(solid.mesh, sights),
        solid.mesh.extents,
        _places(sights),
        apart,
        cut,
        joined(looks, labels, label),
    )
    best = int(np.argmax(counts[:now] if max(counts[:now]) else counts))
    mask, frame = labels[best] == label, looks[best].frame
    departed = departure(solid.mesh, sights)
    picture = _about(mask, frame.color)
    return _Built(label, solid, points, colors, mask, frame.camera, counts[best], picture, evidence, departed, hanging)


def _hidden(
    built: _Built,
    solids: list[_Built],
    looks: list[Looked],
    labels: list[NDArray[np.int32]],
    fixtures: tuple[Mesh, ...],
    world_from_table: NDArray[np.float64],
) -> list[int | str]:
    """What keeps a part of a thing out of sight, once it is known where other things are: that something ends its outline in a picture does not say so, and that nothing
    does does not say that there is none, as of what is thin.

    It may go on behind others where no camera looks: so far that it matters, or not.  What may be the rest of it, of its colour and beside it, leaves it cut off, and
    so do parts that nothing joins.  What it goes on as, of its colour and height where they touch, cuts it off.
    """
    rest = [other for other in solids if other is not built and _goes_on(built, other, world_from_table[:3, 2])]
    cut = list(dict.fromkeys([*built.evidence.cut, *(other.label for other in rest)]))
    if built.hanging or not bordered(labels, built.label) or any(by in (PICTURE, REGION, scene.ROBOT, UNSEEN) for by in cut):
        return cut
    table_from_world = transforms.inverse(world_from_table)
    others = [other.solid.mesh for other in solids if other is not built] + [mesh.transformed(table_from_world) for mesh in fixtures]
    left = room(built.solid.mesh, looks, labels, built.label, others, world_from_table, BEHIND)
    if left.behind > BEHIND:
        return list(dict.fromkeys([*cut, *(by if by > 0 else FIXTURE for by in left.by)]))
    whole = left.around < AROUND and hangs_together(built.solid.mesh, GAP)
    return [] if whole and not rest and not any(_one_thing(built, other) for other in solids if other is not built) else cut


def _one_thing(one: _Built, other: _Built) -> bool:
    """Whether two things may be parts of one: of one colour, and near each other."""
    if np.linalg.norm(attached.shade(one.colors) - attached.shade(other.colors)) > attached.COLOR:
        return False
    return _nearest(one, other, attached.GAP, 2000) is not None


def _goes_on(one: _Built, other: _Built, normal: NDArray[np.float64]) -> bool:
    """Whether a thing goes on as another: they touch, and are of one colour and equally high there; normal (3,): of the table."""
    met = _nearest(one, other, TOUCHING, 20000)
    if met is None:
        return False
    ends = []
    for built, place in zip((one, other), met, strict=True):
        offset = built.points - place
        near = np.linalg.norm(offset - np.outer(offset @ normal, normal), axis=1) < THERE
        ends.append((float(np.percentile(built.points[near] @ normal, 95)), attached.shade(built.colors[near])))
    (height, shade), (level, tint) = ends
    return abs(height - level) < LEVEL and float(np.linalg.norm(shade - tint)) < SHADE


def _nearest(one: _Built, other: _Built, reach: float, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The points (3,) of two things, at most so many looked at of each, that are nearest to each other; ``None`` where they are farther apart than ``reach``, m."""
    from scipy.spatial import cKDTree

    few, many = (built.points[:: max(1, len(built.points) // most)] for built in (one, other))
    if np.any(few.min(axis=0) > many.max(axis=0) + reach) or np.any(many.min(axis=0) > few.max(axis=0) + reach):
        return None
    distance, index = cKDTree(many).query(few, distance_upper_bound=reach)
    best = int(np.argmin(distance))
    return (few[best], many[index[best]]) if distance[best] < reach else None


def _about(mask: NDArray[np.bool_], color: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The part of a picture about a mask, with a margin that shows what the thing stands on."""
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    margin = round(MARGIN * max(w, h))
    return color[max(y - margin, 0) : y + h + margin, max(x - margin, 0) : x + w + margin].copy()


def _places(sights: list[Sight]) -> int:
    """From how many places a thing was seen: a camera that has not moved is one."""
    places: list[NDArray[np.float64]] = []
    for sight in sights:
        if all(np.linalg.norm(sight.eye - other) > keyframes.NEAR for other in places):
            places.append(sight.eye)
    return len(places)


def _as_object(built: _Built, world_from_table: NDArray[np.float64]) -> SceneObject:
    """Object frame at the centre of the smallest upright box, z up, x along its longer horizontal side (towards +x, else +y, of the world);
    painted, with its canonical view."""
    mesh = built.solid.mesh
    low, high = mesh.bounds
    (cx, cy), (w, h), angle = cv2.minAreaRect(((mesh.vertices[:, :2] - low[:2]) * 1000).astype(np.float32))
    if abs(w - h) < 0.04 * max(w, h) and built.solid.shape in ("sphere", "cylinder", "round"):
        angle = 0.0  # round: no direction is longer, keep the world's
        w = h
    elif h > w:
        w, h, angle = h, w, angle + 90
    yaw = np.radians(angle)
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    table_from_object = transforms.from_rpy(0, 0, yaw, [cx / 1000 + low[0], cy / 1000 + low[1], (low[2] + high[2]) / 2])
    object_from_table = transforms.inverse(table_from_object)
    local = mesh.transformed(object_from_table)
    pose = world_from_table @ table_from_object
    local = Mesh(local.vertices, local.faces, _paint(local, built.points, built.colors, transforms.inverse(pose)))
    pieces = tuple(piece.transformed(object_from_table) for piece in built.solid.pieces)
    return SceneObject(
        "", local, pieces, pose, find_view(local, pieces), built.points, built.colors, built.mask, built.camera, built.picture,
        world_from_box=pose, box_extents=local.extents, confidence=chance(built.evidence),
        surface_error=likely(built.evidence, built.departed),
    )  # fmt: skip


def _paint(mesh: Mesh, points: NDArray[np.float64], colors: NDArray[np.uint8], object_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (V, 3) of a mesh's vertices from the nearest seen point."""
    from scipy.spatial import cKDTree

    step = max(1, len(points) // 4000)
    tree = cKDTree(transforms.apply(object_from_world, points[::step]), balanced_tree=False, compact_nodes=False)
    return colors[::step][tree.query(mesh.vertices)[1]]
