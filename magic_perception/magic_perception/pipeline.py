"""Frames in, scene out."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import scene, transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import FIXTURE, PICTURE, REGION, UNSEEN, Scene, SceneObject
from magic_core.views import find_view
from magic_core.workers import Workers
from magic_perception import attached, cameras, clusters, keyframes
from magic_perception.confidence import Evidence, chance
from magic_perception.glass import once, unmeasured
from magic_perception.hidden import ROBOT, hangs, mostly_held, parted, veil
from magic_perception.looks import Looked, find_table, frame_on, look
from magic_perception.parameters import Parameters
from magic_perception.percentiles import bounds
from magic_perception.reconstruction import Reconstruction, Sight, reconstruct
from magic_perception.room import bordered, room
from magic_perception.seen import cut_off, joined, witnessed
from magic_perception.segmentation import DepthSegmenter, Segmenter
from magic_perception.shared_out import Shared, shared_out
from magic_perception.sight import agreement
from magic_perception.smear import before, behind
from magic_perception.solids import hangs_together, hull_of
from magic_perception.surface_error import MOST, Departure, beyond, departure, likely
from magic_perception.table import Plane

#: A frame with fewer pixels of depth shows nothing; nor does one with fewer of a thing tell of that.
LEAST, FEW = 100, 20
#: Round an object in its picture, as a share of its longer side.
MARGIN = 0.15
#: Behind others a thing may go on by this, m, and is told whole; and by the second where some camera has the thing itself before it.
BEHIND, AROUND = 0.015, 0.03
#: A camera that certainly sees the arm farther than this from where its joints put it, m, is told to, and what is seen is moved.
ARM_TOLD = 0.005
#: Between parts of one solid that are farther from each other, m, is one that nobody saw.
GAP = 0.006
#: Two things are likely parts of one that a seam has parted where they touch (m), and, within so much of that place (m), have one height (m) and one chromaticity.
TOUCHING, THERE, LEVEL, SHADE = 0.003, 0.02, 0.005, 0.02


@dataclass
class Report:
    """What perceive() can tell besides the scene: what it left out and why, and by stage the seconds by the clock and of this process on any processor.

    labels (H, W): of the frames; by id in the scene: numbers, the label of each object, shapes, pixels in the camera that saw most of it, evidence and departures.
    held: the ids of what the robot holds, the largest first.
    cameras: how far each pair of cameras disagrees.  earlier: the earlier frames with what has become of each, blind where newer ones contradict it.  Stages: ``table``, ``masks``, ``cameras``, ``meshes`` (with convex pieces), ``views`` (colours and canonical views).
    """

    seconds: dict[str, float] = field(default_factory=dict)
    cpu: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    labels: list[NDArray[np.int32]] = field(default_factory=list)
    numbers: dict[str, int] = field(default_factory=dict)
    held: list[str] = field(default_factory=list)
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
    workers: Workers | None = None,
) -> Scene:
    """What stands and lies on the table.

    frames: one for each camera, taken at nearly the same time, with poses in one world whose z is up.  known: fixtures,
    taken over into the scene; what belongs to them is left out of the segmentation.  Objects are numbered by size
    (``object_1``, ...); :class:`magic_perception.tracking.Tracker` makes the numbers stable from call to call.
    earlier: frames of the same scene from before (:class:`magic_perception.keyframes.Keyframes`), oldest first: they show what the frames do not,
    as far as no newer one contradicts them.  What they alone show is told, and marked ``unseen``.
    workers: processes that build a part of the things (:func:`magic_perception.shared_out.perceiving`); a segmenter has its own use for them.

    What the robot holds (``RgbdFrame.held``) is an object of its own.

    Cameras are measured against the arm where frames tell how they saw it (``RgbdFrame.arm``).

    Raises ``NO_FRAMES`` without frames, ``NO_DEPTH`` where no frame has :data:`LEAST` pixels with depth, ``NO_TABLE``,
    ``CAMERAS_DISAGREE`` where the cameras' poses contradict each other by more than may be corrected, ``ROBOT_ELSEWHERE`` where one is as far off the arm.
    An empty table is a scene without objects.
    """
    report = report if report is not None else Report()
    segmenter = segmenter or DepthSegmenter()
    if not frames:
        raise MagicError(Code.NO_FRAMES, "frames", 0, "at least one RGB-D frame")
    seeing = _seeing(frames, report.notes)
    now = sum(seeing)
    used = [*(frame for frame, sees in zip(frames, seeing, strict=True) if sees), *(frame.free for frame in earlier)]
    fixtures = tuple(item.mesh.transformed(item.world_from_object) for item in known if len(item.mesh.faces))

    with report.stage("table"):
        ground = _on_the_arm(used, now, parameters, report.notes)

    def labelled(looks: list[Looked]) -> _Views:
        labels = parted(looks, veil(looks, segmenter.segment(looks, fixtures, parameters)))
        return _Views(looks, labels, now, ground.world_from_table, fixtures)

    with report.stage("masks"):
        views = labelled(ground.looks)
        if earlier:
            blotted = _blotted(ground, views, parameters)
            if blotted is not ground:
                ground, views = blotted, labelled(blotted.looks)
            report.earlier = list(zip(earlier, ground.frames[now:], strict=True))

    with ExitStack() as stack:
        with report.stage("cameras"):
            building = stack.enter_context(_building(views, parameters, workers))
            report.cameras = _disagreements(views, ground.frames, parameters.seed)
            worst = _worst(report.cameras)
            _look_at_one_scene(views)
            report.notes += _about_poses(report.cameras, views)
            apart = _apart(worst, views)
            if views.corrects and worst is not None and worst.certain and worst.motion.any():
                stack.close()  # what others have begun is of cameras that have moved since
                views = labelled(_brought_together(views, worst))
                building = stack.enter_context(_building(views, parameters, workers))
            report.notes += _about_glass(views)

        with report.stage("meshes"):
            solids, refused = _solids(building, views, apart)
            report.notes += [_about_refused(label, error, views) for label, error in refused.items()]
            report.numbers = {f"object_{number}": built.label for number, built in enumerate(solids, 1)}
            report.held = [name for name, label in report.numbers.items() if label in views.held]
            report.labels = _of_all_frames(views, refused, frames, seeing)
            sizes = [len(built.points) for built in solids]
            hidden = shared_out(_hidden, (solids, views), range(len(solids)), sizes, workers)
            pairs = attached.doubtful(views.labels, views.looks)
            off = shared_out(_off_at_most, (solids, views, pairs), range(len(solids)), sizes, workers)

    with report.stage("views"):
        objects = _objects(solids, hidden, off, ground.world_from_table, report)
    up, origin = ground.world_from_table[:3, 2], ground.world_from_table[:3, 3]
    stamp = max(frame.stamp for frame in ground.frames)
    offset, angle = (worst.offset, worst.angle) if worst is not None else (np.nan, np.nan)
    return Scene(
        (*objects, *known), np.append(up, -up @ origin), stamp, camera_offset=offset, camera_angle=angle, notes=tuple(report.notes)
    )


# ---------------------------------------------------------------- frames, table, cameras


def _seeing(frames: list[RgbdFrame], notes: list[str]) -> list[bool]:
    """Which frames have depth enough to be looked at; the others are noted.  Raises ``NO_DEPTH`` where none has."""
    counts = [int(np.isfinite(frame.depth).sum()) for frame in frames]
    seeing = [count >= LEAST for count in counts]
    notes += [f"{frame.camera}: no depth" for frame, sees in zip(frames, seeing, strict=True) if not sees]
    if not any(seeing):
        found = {frame.camera: count for frame, count in zip(frames, counts, strict=True)}
        raise MagicError(Code.NO_DEPTH, "pixels with depth", found, f"at least {LEAST} in one camera")
    return seeing


@dataclass(frozen=True)
class _Ground:
    """The frames that are used, those of now first, and the table in them: its plane in each camera, world_from_table (4, 4), and how each frame looks on it."""

    frames: list[RgbdFrame]
    planes: list[Plane]
    world_from_table: NDArray[np.float64]
    looks: list[Looked]


def _ground(frames: list[RgbdFrame], parameters: Parameters, notes: list[str]) -> _Ground:
    """The table in all frames.  What there is to say of it goes to the notes."""
    table, planes = find_table(frames, parameters, notes)
    world_from_table = _table_frame(table, parameters)
    looks = [look(frame, plane, world_from_table, parameters) for frame, plane in zip(frames, planes, strict=True)]
    return _Ground(frames, planes, world_from_table, looks)


def _on_the_arm(frames: list[RgbdFrame], now: int, parameters: Parameters, notes: list[str]) -> _Ground:
    """The table in all frames, all of them moved as far as the first ``now`` are told to see the arm elsewhere than it is."""
    ground = _ground(frames, parameters, about_table := [])
    shift, about_arm = _to_the_arm(_off_the_arm(ground.looks[:now], frames[:now]), parameters.arm_offset)
    if shift.any():
        ground = _ground([_shifted(frame, shift) for frame in frames], parameters, about_table := [])
    notes += [*about_table, *about_arm]
    return ground


def _blotted(ground: _Ground, views: _Views, parameters: Parameters) -> _Ground:
    """With what newer frames contradict blotted out of the earlier ones; the same ground where nothing is."""
    stale = keyframes.contradicted(views.looks, views.labels, views.now, ground.world_from_table)
    if not any(pixels.any() for pixels in stale):
        return ground
    frames, looks = list(ground.frames), list(ground.looks)
    for i, pixels in enumerate(stale, views.now):
        if pixels.any():
            frames[i] = frames[i].blinded(pixels)
            looks[i] = look(frames[i], ground.planes[i], ground.world_from_table, parameters)
    return replace(ground, frames=frames, looks=looks)


def _table_frame(table: Plane, parameters: Parameters) -> NDArray[np.float64]:
    """world_from_table (4, 4), z up: the world's own frame where the table is as good as its z = 0."""
    near = abs(table.heights(np.zeros(3))) < parameters.snap_height
    if parameters.snap_height > 0 and table.tilt() < parameters.snap_tilt and near:
        return np.eye(4)
    return frame_on(table, np.eye(4))


@dataclass(frozen=True)
class _Views:
    """What all frames show of one scene: first those of now, one of each camera, then the earlier ones, oldest first.

    labels (H, W) of each: which thing a pixel belongs to, 1, 2, ... the same in all of them; 0 none, negative the robot or what is known.  now: so many are of now.
    world_from_table (4, 4): z up, z = 0 on the table.  fixtures: what is known, in the world frame.
    """

    looks: list[Looked]
    labels: list[NDArray[np.int32]]
    now: int
    world_from_table: NDArray[np.float64]
    fixtures: tuple[Mesh, ...]

    @property
    def numbers(self) -> list[int]:
        """The labels of things."""
        return list(range(1, max((int(image.max()) for image in self.labels), default=0) + 1))

    @cached_property
    def held(self) -> set[int]:
        """The labels of what the robot holds."""
        return {label for label in self.numbers if mostly_held(self.looks, self.labels, label)}

    @cached_property
    def hanging(self) -> set[int]:
        """The labels of what hangs above the table, what the robot holds among them."""
        return {label for label in self.numbers if label in self.held or hangs(self.looks, self.labels, label, self.fixtures)}

    @property
    def compared(self) -> int:
        """The poses of so many of the frames are compared: those of now, but one camera alone is measured against where it was before."""
        return self.now if self.now > 1 else len(self.looks)

    @property
    def corrects(self) -> bool:
        """Whether cameras that disagree are brought together: of three nobody knows which is off."""
        return self.now == 2

    @property
    def several_see(self) -> bool:
        """Whether more than one of the compared frames shows something."""
        return sum(bool((image > 0).any()) for image in self.labels[: self.compared]) > 1


def _disagreements(views: _Views, frames: list[RgbdFrame], seed: int) -> list[cameras.Disagreement]:
    """How far each pair of the compared frames' poses disagrees, by what is at rest in both; frames: as they came, since looks have their tables put on one another."""
    count = views.compared
    still = [_at_rest(image, views.hanging) for image in views.labels[:count]]
    poses = [frame.world_from_camera for frame in frames[:count]]
    return cameras.measure(views.looks[:count], still, poses, views.world_from_table, seed)


def _at_rest(labels: NDArray[np.int32], hanging: set[int]) -> NDArray[np.int32]:
    """The labels (H, W) of a picture without what may be on its way: what hangs, and what the robot is before, or holds.  Two cameras' pictures are not of one
    moment: that they see such a thing at two places does not speak against their poses."""
    beside = cv2.dilate((labels == ROBOT).view(np.uint8), np.ones((7, 7), np.uint8)).view(bool)
    doubtful = hanging | set(np.unique(labels[beside & (labels > 0)]).tolist())
    return np.where(np.isin(labels, sorted(doubtful)), 0, labels) if doubtful else labels


def _worst(pairs: list[cameras.Disagreement]) -> cameras.Disagreement | None:
    """The pair that disagrees most; ``None`` where none could be compared.  Raises ``CAMERAS_DISAGREE`` where that is more than may be corrected."""
    worst = max(pairs, key=lambda pair: (pair.beyond, pair.offset), default=None)
    if worst is not None and worst.beyond:
        raise MagicError(
            Code.CAMERAS_DISAGREE,
            "poses of the cameras",
            str(worst),
            f"up to {1000 * cameras.MOST_OFFSET:.0f} mm and {np.degrees(cameras.MOST_ANGLE):.1f} degrees; calibrate them again",
        )
    return worst


def _look_at_one_scene(views: _Views) -> None:
    """What one camera sees may not stand where another sees the bare table, and the other way round, as with cameras that were exchanged: then they often see
    nothing in common by which their poses could be compared.  Raises ``CAMERAS_DISAGREE``."""
    images = [_at_rest(image, views.hanging) for image in views.labels[: views.now]]
    for i, j in itertools.combinations(range(views.now), 2):
        one, other = views.looks[i], views.looks[j]
        shares = cameras.looked_through(one, images[i], other), cameras.looked_through(other, images[j], one)
        if all(share > cameras.THROUGH for share in shares):  # NaN, which tells nothing, is not
            raise MagicError(
                Code.CAMERAS_DISAGREE,
                f"share of what {one.frame.camera} sees that {other.frame.camera} looks through, and the other way round",
                " and ".join(f"{share:.2f}" for share in shares),
                f"at most {cameras.THROUGH:g}; were the cameras, or their poses, exchanged?",
            )


def _about_poses(pairs: list[cameras.Disagreement], views: _Views) -> list[str]:
    """What there is to say of the poses of the cameras."""
    if not pairs and views.several_see:
        return ["whether the cameras agree could not be measured: they see no side of anything in common"]
    notes = []
    for pair in pairs:
        if pair.certain:
            notes.append(f"cameras disagree: {pair}" + ("; brought together half way" if views.corrects else ""))
        elif pair.offset > cameras.MOST_OFFSET:
            notes.append(f"cameras may disagree: {pair}; more things in common view would tell")
    return notes


@dataclass(frozen=True)
class _OffTheArm:
    """That a camera sees the arm elsewhere: ``offset`` (3,), m, in the world, carries what it sees of it to where the joints put it; error: standard error, m."""

    camera: str
    offset: NDArray[np.float64]
    error: float

    @property
    def sure(self) -> float:
        """How much of it is more than chance, m."""
        return float(np.linalg.norm(self.offset)) - 2 * self.error

    def __str__(self) -> str:
        x, y, z = (1000 * self.offset).round(1)
        return (
            f"{self.camera} sees the arm {1000 * np.linalg.norm(self.offset):.1f} mm from where its joints put it, to be moved by ({x:g}, {y:g}, {z:g}) mm "
            f"(standard error {1000 * self.error:.1f} mm)"
        )


def _off_the_arm(looks: Sequence[Looked], frames: Sequence[RgbdFrame]) -> list[_OffTheArm]:
    """How far each camera that tells sees the arm from where its joints put it, with its table on the others'; frames: as they came."""
    found = []
    for seen, frame in zip(looks, frames, strict=True):
        if frame.arm is not None:
            moved = seen.frame.world_from_camera @ transforms.inverse(frame.world_from_camera)
            offset = frame.arm.centre + frame.arm.offset - transforms.apply(moved, frame.arm.centre[None])[0]
            found.append(_OffTheArm(frame.camera, offset, frame.arm.error))
    return found


def _to_the_arm(off: Sequence[_OffTheArm], limit: float) -> tuple[NDArray[np.float64], list[str]]:
    """By what (3,) all that is seen is moved along the table so that the arm finds it, and what there is to say; tables tell the height.

    Zero where no camera is certainly off, and where two contradict each other: what one took for the arm was something else.

    Raises ``ROBOT_ELSEWHERE`` where one certainly is by more than ``limit``, m.
    """
    worst = max(off, key=lambda one: one.sure, default=None)
    if worst is None or not limit or worst.sure <= ARM_TOLD:
        return np.zeros(3), []
    parted = [float(np.linalg.norm(a.offset - b.offset)) - 2 * float(np.hypot(a.error, b.error)) for a, b in itertools.combinations(off, 2)]
    if any(apart > ARM_TOLD for apart in parted):
        return np.zeros(3), [f"where the cameras see the arm does not agree and is not made use of: {'; '.join(map(str, off))}"]
    if worst.sure > limit:
        allowed = f"up to {1000 * limit:.0f} mm; calibrate the camera against the arm again"
        raise MagicError(Code.ROBOT_ELSEWHERE, "calibration of camera and arm", str(worst), allowed)
    shift = np.average([one.offset for one in off], axis=0, weights=[one.error**-2 for one in off]) * (1.0, 1.0, 0.0)
    return shift, [f"{worst}; what the cameras see is moved by ({1000 * shift[0]:.1f}, {1000 * shift[1]:.1f}) mm along the table"]


def _shifted(frame: RgbdFrame, shift: NDArray[np.float64]) -> RgbdFrame:
    """A frame from a camera that stands elsewhere, by ``shift`` (3,), m."""
    arm = frame.arm
    if arm is not None:
        arm = replace(arm, centre=arm.centre + shift, offset=arm.offset - shift)
    return replace(frame, world_from_camera=transforms.make(translation=shift) @ frame.world_from_camera, arm=arm)


def _apart(worst: cameras.Disagreement | None, views: _Views) -> float:
    """How far the cameras are, or may be, apart, m: those of which nothing is known as far as would be borne."""
    if worst is not None:
        return worst.offset
    return cameras.MOST_OFFSET if views.several_see else 0.0


def _brought_together(views: _Views, worst: cameras.Disagreement) -> list[Looked]:
    """The looks with the two cameras of a pair moved half way to each other, and the earlier frames that were taken from where these still stand."""
    moved = cameras.brought_together(views.looks, worst, views.world_from_table)
    current = [look.frame for look in views.looks[: views.now]]
    return [
        after if any(keyframes.alike(before.frame, frame, keyframes.STILL, keyframes.STEADY) for frame in current) else before
        for before, after in zip(views.looks, moved, strict=True)
    ]


def _about_glass(views: _Views) -> list[str]:
    """What there is to say of what stands there and gives no depth."""
    pairs = zip(views.looks[: views.now], views.labels[: views.now], strict=True)
    blank = [item for look, image in pairs for item in unmeasured(look, image, views.world_from_table)]
    return [f"[{int(Code.NO_DEPTH)} {Code.NO_DEPTH.name}] {item}" for item in once(blank)]


def _about_refused(label: int, error: MagicError, views: _Views) -> str:
    """What there is to say of what was seen to stand there and is no object."""
    points = np.concatenate([look.points(*np.nonzero(image == label)) for look, image in zip(views.looks, views.labels, strict=True)])
    points = points[np.isfinite(points[:, 0])]
    at = " at ({:.2f}, {:.2f}) m".format(*np.median(points[:, :2], axis=0)) if len(points) else ""
    return f"something{at} is no object, and motions do not avoid it: {error.message}"


# ---------------------------------------------------------------- solids


@dataclass(frozen=True)
class _Seen:
    """What all frames saw of one thing: the sights, in the table frame, of those that saw enough of it; its points (N, 3) of the world without strays, and their
    colors (N, 3); counts: its pixels in each of the frames."""

    sights: list[Sight]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    counts: list[int]


@dataclass(frozen=True)
class _Built:
    """The label of a thing, its solid in the table frame, the points (N, 3) of the world that were seen of it with their colors (N, 3), the mask (H, W) in the camera that
    saw most of it, its pixels there, and the picture (h, w, 3) about it; what speaks for the solid; whether nothing carries it."""

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

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lowest and the highest coordinates (3,) of its points."""
        return bounds(self.points)

    @cached_property
    def shade(self) -> NDArray[np.float32]:
        """Of all that was seen of it (:func:`magic_perception.attached.shade`)."""
        return attached.shade(self.colors)


def _building(
    views: _Views, parameters: Parameters, workers: Workers | None
) -> Shared[tuple[_Views, Parameters], int, _Built | MagicError]:
    """The things that are to be built, which other processes begin with."""
    pixels = np.sum([np.bincount(image[image > 0], minlength=len(views.numbers) + 1) for image in views.labels], axis=0)
    return Shared(_attempt, (views, parameters), views.numbers, [int(pixels[label]) for label in views.numbers], workers)


def _solids(
    building: Shared[tuple[_Views, Parameters], int, _Built | MagicError], views: _Views, apart: float
) -> tuple[list[_Built], dict[int, MagicError]]:
    """The things that are built, in the order of their labels, and why others are not; apart: how far the cameras disagree, m."""
    found = dict(zip(views.numbers, building.done(), strict=True))
    refused = {label: built for label, built in found.items() if isinstance(built, MagicError)}
    solids = [built for built in found.values() if not isinstance(built, MagicError)]
    return [replace(built, evidence=replace(built.evidence, apart=apart)) for built in solids], refused


def _attempt(given: tuple[_Views, Parameters], label: int) -> _Built | MagicError:
    """The thing with that label, or why it cannot be built."""
    most = given[1].max_objects
    if label > most:  # the largest come first
        return MagicError(Code.RECONSTRUCTION_FAILED, "things in the scene", label, f"the {most} largest; parameter max_objects")
    try:
        return _build(label, *given)
    except MagicError as error:
        return error


def _build(label: int, views: _Views, parameters: Parameters) -> _Built:
    """The solid of the thing with that label, and what speaks for it but how far the cameras disagree, which is measured meanwhile.  Raises ``RECONSTRUCTION_FAILED``,
    and ``OBJECT_CUT_OFF`` for a wall, a monitor, a person: no thing on the table."""
    looks, labels, now, hanging = views.looks, views.labels, views.now, label in views.hanging
    seen = _seen(label, views, parameters)
    cut = cut_off(looks, labels, label, parameters)
    if max(seen.counts[:now]) < parameters.min_pixels:
        cut.append(UNSEEN)
    across = float(np.ptp(np.percentile(seen.points[:: max(1, len(seen.points) // 500)], [1, 99], axis=0), axis=0).max())
    if across > parameters.max_extent and any(by in (PICTURE, REGION) for by in cut) and not hanging:
        raise MagicError(
            Code.OBJECT_CUT_OFF,
            "extent in metres of something that the picture or the region cuts",
            round(across, 2),
            f"up to {parameters.max_extent}",
        )
    # Of a hand, or of what is in one, its place is asked, and it is elsewhere in the next scene.
    hull = hull_of(transforms.apply(transforms.inverse(views.world_from_table), seen.points)) if hanging else None
    solid = reconstruct(seen.sights, parameters) if hull is None else Reconstruction(hull, (hull,), "hull")
    evidence = Evidence(
        shape=solid.shape,
        fit=solid.fit or agreement(solid.mesh, seen.sights),
        witnessed=witnessed(solid.mesh, seen.sights),
        extents=solid.mesh.extents,
        cameras=_places(seen.sights),
        apart=np.nan,
        cut=cut,
        joined=joined(looks, labels, label),
    )
    # Its picture is of now, unless earlier frames alone show it.
    best = int(np.argmax(seen.counts[:now] if max(seen.counts[:now]) else seen.counts))
    mask, frame = labels[best] == label, looks[best].frame
    return _Built(
        label,
        solid,
        seen.points,
        seen.colors,
        mask,
        frame.camera,
        seen.counts[best],
        _about(mask, frame.color),
        evidence,
        departure(solid.mesh, seen.sights),
        hanging,
    )


def _seen(label: int, views: _Views, parameters: Parameters) -> _Seen:
    """What all frames saw of the thing with that label.  Raises ``RECONSTRUCTION_FAILED`` where that is next to nothing."""
    table_from_world = transforms.inverse(views.world_from_table)
    sights, clouds, paints, counts = [], [], [], []
    for looked, image in zip(views.looks, views.labels, strict=True):
        mask = image == label
        counts.append(int(np.count_nonzero(mask)))
        if counts[-1] < FEW:
            continue
        x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
        cut = (slice(y, y + h), slice(x, x + w))
        sigma = float(np.median(looked.sigma[cut][mask[cut]][::7]))
        hidden = (image != 0) & ~mask
        # What colour gives to the thing and depth to the table behind it, or to another thing before it, has no depth.
        lost = behind(mask, looked.heights) | before(mask, hidden, looked.frame.depth, looked.frame.intrinsics.fx)
        depth, heights = looked.frame.depth.copy(), looked.heights.copy()
        depth[cut][lost[cut]] = heights[cut][lost[cut]] = np.nan
        table_from_camera = table_from_world @ looked.frame.world_from_camera
        sights.append(Sight(looked.frame.intrinsics, table_from_camera, mask, hidden, looked.frame.color, depth, heights, sigma))
        rows, columns = np.nonzero(mask[cut] & np.isfinite(heights[cut]))
        clouds.append(looked.points(rows + y, columns + x))
        paints.append(looked.frame.color[rows + y, columns + x])
    if not sights:
        raise MagicError(Code.RECONSTRUCTION_FAILED, "pixels of the object", max(counts), f"at least {FEW} in one camera")
    points, colors = np.concatenate(clouds).astype(float), np.concatenate(paints)
    if not len(points):
        raise MagicError(Code.RECONSTRUCTION_FAILED, "pixels of the object with depth of its own", 0, "at least 1")
    keep = clusters.largest(points, parameters.cluster_eps, parameters.cluster_points, 0.006)
    return _Seen(sights, points[keep], colors[keep], counts)


def _hidden(given: tuple[list[_Built], _Views], number: int) -> list[int | str]:
    """What keeps a part of one of the things out of sight, once it is known where the others are: that something ends its outline in a picture does not say so, and
    that nothing does does not say that there is none, as of what is thin.

    It may go on behind others where no camera looks: so far that it matters, or not.  What may be the rest of it, of its colour and beside it, leaves it cut off, and
    so do parts that nothing joins.  What it goes on as, of its colour and height where they touch, cuts it off.
    """
    solids, views = given
    built = solids[number]
    world_from_table = views.world_from_table
    rest = [other for other in solids if other is not built and _goes_on(built, other, world_from_table[:3, 2])]
    cut = list(dict.fromkeys([*built.evidence.cut, *(other.label for other in rest)]))
    if built.hanging or not bordered(views.labels, built.label) or any(by in (PICTURE, REGION, scene.ROBOT, UNSEEN) for by in cut):
        return cut
    table_from_world = transforms.inverse(world_from_table)
    others = [other.solid.mesh for other in solids if other is not built] + [mesh.transformed(table_from_world) for mesh in views.fixtures]
    left = room(built.solid.mesh, views.looks, views.labels, built.label, others, world_from_table, BEHIND)
    if left.behind > BEHIND:
        return list(dict.fromkeys([*cut, *(by if by > 0 else FIXTURE for by in left.by)]))
    whole = left.around < AROUND and hangs_together(built.solid.mesh, GAP)
    return [] if whole and not rest and not any(_one_thing(built, other) for other in solids if other is not built) else cut


def _one_thing(one: _Built, other: _Built) -> bool:
    """Whether two things may be parts of one: of one colour, and near each other."""
    if np.linalg.norm(one.shade - other.shade) > attached.COLOR:
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


def _off_at_most(given: tuple[list[_Built], _Views, list[tuple[int, int]]], number: int) -> float:
    """How far the surface of one of the things is off, m, if all that may be a part of it is; 0 where nothing may.

    given: with the pairs of labels that may be parts of one thing (:func:`magic_perception.attached.doubtful`).
    """
    solids, views, pairs = given
    built = solids[number]
    rest = [other for other in solids if (built.label, other.label) in pairs or (other.label, built.label) in pairs]
    if not rest:
        return 0.0
    table_from_world = transforms.inverse(views.world_from_table)
    return beyond(built.solid.mesh, *(transforms.apply(table_from_world, one.points) for one in (built, *rest)))


def _nearest(one: _Built, other: _Built, reach: float, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The points (3,) of two things, at most so many looked at of each, that are nearest to each other; ``None`` where they are farther apart than ``reach``, m."""
    from scipy.spatial import cKDTree

    low, high = np.maximum(one.bounds[0], other.bounds[0]) - reach, np.minimum(one.bounds[1], other.bounds[1]) + reach
    if np.any(low > high):
        return None
    few, many = (built.points[:: max(1, len(built.points) // most)] for built in (one, other))
    few, many = (points[np.all((points >= low) & (points <= high), axis=1)] for points in (few, many))
    if not (len(few) and len(many)):
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


# ---------------------------------------------------------------- objects


def _of_all_frames(
    views: _Views, refused: Mapping[int, MagicError], frames: list[RgbdFrame], seeing: list[bool]
) -> list[NDArray[np.int32]]:
    """Labels (H, W) of each of the frames, without those of what was refused; of a frame that shows nothing, none."""
    told = (np.where(np.isin(image, list(refused)), 0, image) for image in views.labels[: views.now])
    return [next(told) if sees else np.zeros(frame.depth.shape, np.int32) for frame, sees in zip(frames, seeing, strict=True)]


def _objects(
    solids: Sequence[_Built], hidden: Sequence[list[int | str]], off: Sequence[float], world_from_table: NDArray[np.float64], report: Report
) -> list[SceneObject]:
    """The objects of the scene, by the names that the report gives them.

    hidden: by labels and names, what keeps a part of each out of sight; off: how far (m) its surface is off if what may be a part of it is one.
    """
    ids = {label: name for name, label in report.numbers.items()}
    objects = []
    for built, by, at_most in zip(solids, hidden, off, strict=True):
        item = _as_object(built, world_from_table)
        # What hides a thing and was left out itself is as nameless as a fixture.
        names = dict.fromkeys(name if isinstance(name, str) else ids.get(name, FIXTURE) for name in by)
        surface_error = min(float(np.hypot(item.surface_error, at_most)), MOST)
        item = replace(item, id=ids[built.label], cut_off=tuple(names), surface_error=surface_error)
        _tell(report, built, item)
        objects.append(item)
    return objects


def _tell(report: Report, built: _Built, item: SceneObject) -> None:
    """Write into the report what the scene does not say of an object."""
    if item.hanging:
        x, y, z = item.world_from_box[:3, 3]
        report.notes.append(f"something hangs above the table, with nothing below that carries it, at ({x:.2f}, {y:.2f}, {z:.2f}) m")
    report.evidence[item.id], report.departures[item.id] = built.evidence, built.departed
    report.shapes[item.id], report.pixels[item.id] = built.solid.shape, built.pixels


def _as_object(built: _Built, world_from_table: NDArray[np.float64]) -> SceneObject:
    """The object of the scene, as yet without id.  Its frame is at the centre of the smallest upright box, z up, x along its longer horizontal side (towards +x, else +y,
    of the world); painted, with its canonical view."""
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
        seen_share=built.evidence.witnessed.seen, surface_error=likely(built.evidence, built.departed), hanging=built.hanging,
    )  # fmt: skip


def _paint(mesh: Mesh, points: NDArray[np.float64], colors: NDArray[np.uint8], object_from_world: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Colours (V, 3) of a mesh's vertices from the nearest seen point."""
    from scipy.spatial import cKDTree

    step = max(1, len(points) // 4000)
    tree = cKDTree(transforms.apply(object_from_world, points[::step]), balanced_tree=False, compact_nodes=False)
    return colors[::step][tree.query(mesh.vertices)[1]]
