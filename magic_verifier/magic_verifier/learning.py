"""A strategy from one demonstration (paper, III-A): objects, the tool's motion, and what the motion was for.

1. The motion is replayed in physics.  Where tool and target press on each other are the contact points p_T and p_O; when they
   first do is when the contact is made.  Where the tool parts from the target and goes on to move it from another place, each place is
   a contact, the last one the strategy's first.
2. The plane in which the contact is reasoned about is chosen: across the thinnest side of the tool in which both contacts are on an
   outline where they were shown.  Looked at from above if that direction is upright, else from the side; in section where the contact is
   inside the silhouette, as a bowl's is.  The target may be met outside, in a hole or notch, or inside its cut.  What is round was
   met somewhere near the middle of the way that it was led: the contact is there.  Where two flat sides lay on each other any point of them
   may be what pressed: the contact is in the middle of the target's, with the normal of the way.
3. The part of the motion that belongs to the contact is kept, with its phases: approach, contact, goal, retreat.  Where the tool keeps
   its attitude it becomes waypoints (mode ``plan``), else it is carried over as it is (``retarget``).
4. Where no goal is given it is found (:mod:`magic_verifier.inference`): of those that what was changed suggests, the strictest that the
   strategy passes with the demonstrated objects and with what is drawn around them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from magic_core import transforms
from magic_core.contact import OPPOSED, Companion, Contact, ContactCandidate, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.motion import MotionPlan, Phase, ToolMotion
from magic_core.rendering import canonical_view
from magic_core.scene import VIEW_KINDS, CanonicalView, SceneObject
from magic_core.shapes import section_view
from magic_core.strategy import MODES, SIDES, ContactPair, Goal, Physics, Strategy, Waypoint
from magic_matcher import contour as contours
from magic_matcher import curvature
from magic_matcher.candidates import to_contact
from magic_matcher.matching import target_contact
from magic_matcher.targets import target_view
from magic_verifier import goals
from magic_verifier.demonstration import Meeting, Replay, replay
from magic_verifier.floating import TABLE, TARGET
from magic_verifier.inference import Changed, changed, proposals
from magic_verifier.posing import box_axes
from magic_verifier.verification import Proposal, Verdict, verify_proposal

Array = NDArray[np.float64]
#: The track is taken every TICK and smoothed over WINDOW seconds.
TICK, WINDOW = 0.02, 0.6
#: Samples of the motion are kept if they are so far from the one before: metres, radians, seconds.
SPACING = (0.002, np.deg2rad(1.0), 0.25)
#: The motion is kept from where the contact is so far from where it will be made, and the approach ends so far from there, metres.
APPROACH, NEAR = 0.12, 0.02
#: Rolling moves a contact: it is read until the tool has turned by so much since it was made (rad), or the target tips over, for so long
#: (s) at least.
TURNED, READ = np.deg2rad(10.0), 0.2
#: Tool and target meet in another place than before where the tool's normal is turned by so much (rad), or its point is so far (share of
#: its size) from there; a touch that moves the target by less (m) is none.
OTHERWISE, ELSEWHERE, MOVED = np.deg2rad(60.0), 0.15, 0.02
#: A tool leads a target along a straight way if it is so long (m), and the path along it no longer than so many times that.
LED, DETOUR = 0.03, 1.1
#: Directions so near (rad) to upright or to level are taken to be so.
NEARLY = np.deg2rad(20.0)
#: A tool that turns less than this (rad) keeps its attitude.
ATTITUDE = np.deg2rad(15.0)
#: A side of an outline faces a direction whose cosine with its normal is more than this.
FACING = 0.3
#: How far (m) a contact point may lie from the outline on which it is matched, and this share of the object's size.
OFF_OUTLINE, OFF_SHARE = 0.006, 0.03
#: A tool may have met the target so far beside where a strategy will have tools meet it, the middle of a side: share of the target's size.
ASIDE_SHARE = 0.15
#: What a strategy calls the target's outlines, in words.
PLACES = {
    "outer": "middle of its outer side",
    "inner": "side of its hole or notch",
    "cut": "inner side of its cut",
}
#: Waypoints stand for the motion to this (m); between them the tool moves at the demonstrated speed within these bounds (m/s).
STRAIGHT, SPEEDS = 0.005, (0.02, 0.12)
#: A motion that goes on for so long (s) after tool and target have parted ends in a retreat.
PARTED = 0.3
#: The tool rests (is let go) from when it moves no more than this, metres and radians.
RESTS = (0.002, np.deg2rad(2.0))


@dataclass(frozen=True)
class Task:
    """What the demonstration was for.  goal: ``None`` to have it, and whether the tool is let go, found; view and mode: one of
    VIEW_KINDS and MODES, or empty to have them found; values: numbers of the goal that are given all the same."""

    name: str
    goal: Goal | None
    physics: Physics = field(default_factory=Physics)
    releases: bool = False
    view: str = ""
    mode: str = ""
    description: str = ""
    simulatable: bool = True
    values: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Demonstration:
    """What was seen.  tool: as it was when ``times`` (T,) begin, in seconds; world_from_tool (T, 4, 4): its object frame's motion;
    target and obstacles where they stood then; table (4,): plane, unit normal up."""

    tool: SceneObject
    target: SceneObject
    obstacles: tuple[SceneObject, ...]
    table: Array
    times: Array
    world_from_tool: Array


@dataclass(frozen=True)
class Learned:
    """The strategy; how far (m) the contacts that the replay read are from the outlines' points that stand for them; the verdict on
    the strategy carried out with the demonstrated objects by a floating gripper, and that on the demonstrated motion itself (None where
    simulation cannot judge the goal); where the goal was found, what the demonstration changed, and why other goals that this suggested
    are not it; askew: how far (rad) the contact that was read is turned from the way that a round target was led, where no other place of
    the tool explains that way."""

    strategy: Strategy
    tool_gap: float
    target_gap: float
    verdict: Verdict | None
    shown: Verdict | None
    changed: Changed | None = None
    rejected: tuple[str, ...] = ()
    askew: float = 0.0


@dataclass(frozen=True)
class _Motion:
    """The tool's motion in the target's frame, with what a replay needs."""

    name: str
    times: Array
    target_from_tool: Array
    physics: Physics
    releases: bool

    def index(self, time: float) -> int:
        """Of the sample nearest to a time."""
        return int(np.abs(self.times - time).argmin())


def learn(demonstration: Demonstration, task: Task) -> Learned:
    """The strategy that a demonstration shows.

    Raises BAD_MOTION (times, poses), BAD_REQUEST (unknown view, mode or goal; a contact that no view shows in profile), LOST_CONTACT
    (tool and target never press on each other in the replay), and what the replay raises.
    """
    for what, value, allowed in (("view", task.view, VIEW_KINDS), ("mode", task.mode, MODES)):
        if value and value not in allowed:
            raise MagicError(Code.BAD_REQUEST, what, value, allowed)
    seen = None
    if task.goal is None:
        seen = _changed(demonstration, task)
        task = replace(task, releases=task.releases or TARGET in seen.tool_on)
    motion = _motion(demonstration, task)
    found, made, parted, meetings = _contacts(demonstration, task, motion)
    draft, tool_gap, target_gap, askew = _drafted(demonstration, task, motion, found, made, parted)
    if len(meetings) > 1:
        strategy = _with_motions(_with_earlier(draft, demonstration.target, meetings[:-1]), motion, meetings)
    else:
        strategy = _with_motion(draft, motion, made, parted, task.mode)
    made = meetings[0].first if len(meetings) > 1 else made
    if seen is None:
        shown = _shown(demonstration, strategy, motion, made, parted)
        return Learned(strategy, tool_gap, target_gap, _tried(demonstration, strategy), shown, askew=askew)
    found_goals = []
    for goal in proposals(seen, strategy.target_normal):
        strategy = replace(strategy, goal=_with_numbers(goal, task.values))
        verdict, shown = _tried(demonstration, strategy), _shown(demonstration, strategy, motion, made, parted)
        found_goals.append(Learned(strategy, tool_gap, target_gap, verdict, shown, seen, askew=askew))
        if verdict is None or verdict.success:
            break
    # Where none passes surely, the one that the demonstrated motion itself passes.
    chosen = next((one for one in found_goals[::-1] if one.verdict is None or one.verdict.success), None)
    chosen = chosen or next((one for one in found_goals if one.shown is not None and one.shown.success), found_goals[0])
    others = [one for one in found_goals if one is not chosen and one.verdict is not None]
    return replace(chosen, rejected=tuple(f"{one.strategy.goal.title}: {one.verdict.message}" for one in others if one.verdict))


def _with_numbers(goal: Goal, values: dict[str, float]) -> Goal:
    unknown = sorted(set(values) - set(goal.values))
    if unknown:
        raise MagicError(Code.BAD_REQUEST, f"numbers of the goal that was found ({goal.title})", ", ".join(unknown), list(goal.values))
    return goal.with_values(values)


def _changed(demonstration: Demonstration, task: Task) -> Changed:
    """What the whole motion changes, the tool held to its end and let go there."""
    motion = _motion(demonstration, replace(task, releases=False))
    scene = demonstration.tool, demonstration.target, demonstration.obstacles, demonstration.table
    return changed(*scene, task.physics, motion.times, demonstration.target.world_from_object @ motion.target_from_tool)


def _drafted(
    demonstration: Demonstration, task: Task, motion: _Motion, found: Replay, made: float, parted: float
) -> tuple[Strategy, float, float, float]:
    """The strategy but for its phases, looked at so that both contacts are where they were shown; how far (m) each is from there; and how
    far (rad) askew of the way that the target was led.

    The directions across the tool's sides are tried, thinnest first, and in each the target's outlines.  Raises BAD_REQUEST that says how
    near the best of them came.
    """
    draft = _Draft(demonstration, task, motion, found, made, parted)
    why: list[MagicError] = []
    for direction in draft.directions():
        if task.view and (task.view == "top") != (direction[2] != 0.0):
            continue
        try:
            return draft.along(direction)
        except MagicError as error:
            why.append(error)
    if why:
        raise why[0]
    raise MagicError(Code.BAD_REQUEST, "view", task.view, "one in which the contact is seen in profile; without --view it is found")


class _Draft:
    """A strategy but for its phases, as it is looked at along one direction or another.

    made, parted: seconds at which the contact is made, and at which tool and target part.
    """

    def __init__(self, demonstration: Demonstration, task: Task, motion: _Motion, found: Replay, made: float, parted: float) -> None:
        self.demonstration, self.task, self.motion, self.found = demonstration, task, motion, found
        world_from_target = demonstration.target.world_from_object
        self.world_from_tool = world_from_target @ motion.target_from_tool[motion.index(made)]
        before = (world_from_target @ motion.target_from_tool[_last_away(motion, found, made, APPROACH)])[:3, 3]
        self.came = self.world_from_tool[:3, 3] - before
        self.towards = world_from_target[:3, :3] @ found.target_normal
        self.way = world_from_target[:3, :3] @ _way(motion, found, made, parted)

    def directions(self) -> list[Array]:
        """The view directions (3,) to try, best first."""
        return view_directions(self.demonstration.tool, self.world_from_tool, self.towards, self.came)

    def along(self, direction: Array) -> tuple[Strategy, float, float, float]:
        """As :func:`_drafted`, looked at along a direction (3,).

        A round thing that was met a millimetre or two aside of its middle shows a normal some degrees askew of the way that it was led,
        and so does the tool; in a hollow hardly wider than it any number of degrees.  Flat sides press on each other along their edges,
        with the normals of neither.  There the normals are those of the way.
        """
        found, way = self.found, self.way
        draft, target_gap, tool_gap, found = self._read(direction, self.towards, found)
        radius = draft.target_contact.disc_radius if draft.target_outline == "outer" else None
        flat = draft.target_outline == "outer" and bool(np.isinf(draft.target_contact.radius))
        if not (radius or flat) or way @ self.towards >= 0:
            return draft, tool_gap, target_gap, 0.0
        led = levelled(transforms.unit(way - (way @ direction) * direction))
        tool_led = self.world_from_tool[:3, :3].T @ led
        askew = float(np.arccos(np.clip(-(way @ self.towards) / np.linalg.norm(way), -1.0, 1.0)))
        target_led = -self.demonstration.target.world_from_object[:3, :3].T @ led
        if radius is None:
            if askew >= NEARLY:
                return draft, tool_gap, target_gap, 0.0
            draft, target_gap, tool_gap, _ = self._read(direction, -led, replace(found, tool_normal=tool_led, target_normal=target_led))
            return replace(draft, tool_contact=_led(draft, tool_led, 0.0)), tool_gap, target_gap, 0.0
        about = radius if _elsewhere(draft, found, tool_led, radius) <= OFF_OUTLINE else 0.0
        if not about and askew >= NEARLY:
            return draft, tool_gap, target_gap, askew
        # On a round thing the place goes with the normal.
        met = found.target_point + radius * (target_led - found.target_normal)
        draft, _, tool_gap, _ = self._read(
            direction, -led, replace(found, tool_normal=tool_led, target_point=met, target_normal=target_led)
        )
        draft = replace(draft, tool_contact=_led(draft, tool_led, about))
        view = draft.target_view
        off = view.pixels(draft.target_contact.object_from_contact[:3, 3]) - view.pixels(found.target_point)
        return draft, tool_gap, float(np.linalg.norm(off)) * view.metres_per_pixel, 0.0

    def _read(self, direction: Array, towards: Array, read: Replay) -> tuple[Strategy, float, float, Replay]:
        """The draft with contacts as they were read, ``towards`` (3,) the target's outward normal; how far (m) the target's and the tool's
        are from where they were shown; and what was read.

        Where flat sides lie on each other any point of them may be what presses: there the contact is taken to be in the middle of the
        target's.
        """
        draft, tool_gap = self._seen(direction, towards, read)
        try:
            return *_target_contact(draft, self.demonstration.target, read), tool_gap, read
        except MagicError:
            slid = self._slid(draft, read)
            if slid is None:
                raise
        draft, tool_gap = self._seen(direction, towards, slid)
        return *_target_contact(draft, self.demonstration.target, slid), tool_gap, slid

    def _slid(self, draft: Strategy, read: Replay) -> Replay | None:
        """What was read, as if it had been in the middle of the target's outer side, the tool as it was; ``None`` where either side is not
        flat as far as that, as its normals tell."""
        target = self.demonstration.target
        try:
            seen = target_view(target, draft)
            touched = target_contact(draft, seen, target.world_from_object)
        except MagicError:
            return None
        axes = seen.object_from_view[:3, :2]
        contour = contours.extract(seen.mask)
        off = touched.pixel - seen.pixels(read.target_point)
        along = off - (off @ touched.normal) * touched.normal
        square = contour.normals[contour.nearest(touched.pixel)] @ transforms.unit(read.target_normal @ axes) > np.cos(NEARLY)
        if touched.disc_radius or not square or abs(off @ touched.normal) * seen.metres_per_pixel > OFF_OUTLINE:
            return None
        way = axes @ along * seen.metres_per_pixel
        tool_way = self.world_from_tool[:3, :3].T @ target.world_from_object[:3, :3] @ way
        tool_contour = contours.extract(draft.tool_view.mask)
        tool_axes = draft.tool_view.object_from_view[:3, :2]
        normal = transforms.unit(read.tool_normal @ tool_axes)
        for share in (0.25, 0.5, 0.75, 1.0):
            place = draft.tool_view.pixels(read.tool_point + share * tool_way)
            index = tool_contour.nearest(place)
            away = float(np.linalg.norm(tool_contour.points[index] - place)) * draft.tool_view.metres_per_pixel
            if away > OFF_OUTLINE or tool_contour.normals[index] @ normal < np.cos(NEARLY):
                return None
        return replace(read, tool_point=read.tool_point + tool_way, target_point=read.target_point + way)

    def _seen(self, direction: Array, towards: Array, read: Replay) -> tuple[Strategy, float]:
        """The draft with the tool's contact, and how far (m) that is from where it was read."""
        demonstration, task, motion = self.demonstration, self.task, self.motion
        tool, target = demonstration.tool, demonstration.target
        normal = levelled(transforms.unit(towards - (towards @ direction) * direction))
        view, contact, tool_gap = _tool_contact(tool, self.world_from_tool, direction, read, task.view)
        draft = Strategy(
            name=task.name,
            description=task.description,
            view=view.kind,
            mode="retarget",
            tool_view=view,
            tool_contact=contact,
            target_view=view,
            target_contact=contact,
            target_normal=normal,
            target_view_direction=direction,
            times=motion.times,
            target_from_tool=motion.target_from_tool,
            tool_mesh=tool.mesh,
            target_mesh=target.mesh,
            waypoints=(),
            goal=task.goal or Goal("none"),
            physics=task.physics,
            releases=task.releases,
            simulatable=task.simulatable,
        )
        return draft, tool_gap


def _way(motion: _Motion, found: Replay, made: float, parted: float) -> Array:
    """How far (3,), in the target's frame as it stood, the tool's contact point is led from when the contact is made until they part, or
    the tool turns, m.  Zeros where that is less than LED, or not straight.
    """
    first, last = motion.index(made), motion.index(parted)
    poses = motion.target_from_tool[first : last + 1]
    turned = [k for k, pose in enumerate(poses) if _apart(pose, poses[0])[1] > TURNED]
    poses = poses[: turned[0]] if turned else poses
    points = poses[:, :3, :3] @ found.tool_point + poses[:, :3, 3]
    way = points[-1] - points[0]
    long = float(np.linalg.norm(way))
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return way if long >= LED and length <= DETOUR * long else np.zeros(3)


def _elsewhere(draft: Strategy, found: Replay, normal: Array, radius: float) -> float:
    """How much elsewhere (m) the tool would have been, had it met a round target (radius, m) along a normal (3,) of its own frame instead
    of as it was read; infinite where it has no such place.

    In a hollow hardly wider than the target it is little, whatever the angle: a millimetre of the track turns the normal by ten degrees.
    """
    view = draft.tool_view
    place = _square_to(draft, normal, radius)
    if place is None:
        return float("inf")
    led, read = (transforms.unit(n @ view.object_from_view[:3, :2]) for n in (normal, found.tool_normal))
    return float(np.linalg.norm((place - view.pixels(found.tool_point)) * view.metres_per_pixel + radius * (led - read)))


def _led(draft: Strategy, normal: Array, about: float) -> Contact:
    """The tool's contact with the outward normal (3,) along which it was led, in the tool's frame: where its edge is square to that, if it
    is nearby."""
    view, contact = draft.tool_view, draft.tool_contact
    place = _square_to(draft, normal, about)
    if place is not None:
        contour = contours.extract(view.mask)
        contact = to_contact(view, curvature.estimate(contour, contour.nearest(place)))
    towards = transforms.unit(normal @ view.object_from_view[:3, :2])
    return replace(contact, normal=towards, object_from_contact=contact_frame(view, contact.pixel, towards))


def _square_to(draft: Strategy, normal: Array, about: float) -> Array | None:
    """The pixel (2,) at which the tool's outline is square to a normal (3,) of its frame, ``None`` where there is none within ``about`` (m)
    of its contact, or as far from it as a contact may be off."""
    view, contact = draft.tool_view, draft.tool_contact
    contour = contours.extract(view.mask)
    towards = transforms.unit(normal @ view.object_from_view[:3, :2])
    reach = round(max(max(OFF_OUTLINE, about) / view.metres_per_pixel, OFF_SHARE * contour.size))
    near, _ = contour.window(np.array([contour.nearest(contact.pixel)]), np.arange(-reach, reach + 1))
    # No farther than the side goes: over a lip is the back of a thin wall.
    away = np.flatnonzero(contour.normals[near[0]] @ towards <= FACING)
    first, last = (away[away < reach].max(initial=-1) + 1, away[away > reach].min(initial=2 * reach + 1))
    side = contour.points[near[0, first:last]]
    # The bottom of a hollow, the top of a bulge; of a straight edge that is askew neither is there.
    height = side @ towards * (-1.0 if contact.concave else 1.0)
    highest = np.flatnonzero(height >= height.max() - 0.25)
    return side[int(highest[len(highest) // 2])] if highest[0] > 0 and highest[-1] < len(height) - 1 else None


def _target_contact(draft: Strategy, target: SceneObject, found: Replay | Meeting) -> tuple[Strategy, float]:
    """The strategy with the first of the target's outlines whose contact is where it was shown, and how far (m) it is from there."""
    gaps: dict[str, float] = {}
    for outline in SIDES:
        tried = replace(draft, target_outline=outline)
        try:
            seen = target_view(target, tried)
            touched = target_contact(tried, seen, target.world_from_object)
        except MagicError:
            continue  # the target has no such outline
        off = (seen.pixels(touched.object_from_contact[:3, 3]) - seen.pixels(found.target_point)) * seen.metres_per_pixel
        size = contours.extract(seen.mask).size * seen.metres_per_pixel
        deep = abs(float(off @ touched.normal))
        gaps[outline] = float(np.linalg.norm(off))
        facing = float(touched.normal @ (found.target_normal @ seen.object_from_view[:3, :2])) > FACING
        if facing and deep <= max(OFF_OUTLINE, OFF_SHARE * size) and gaps[outline] <= max(OFF_OUTLINE, ASIDE_SHARE * size):
            return replace(tried, target_view=seen, target_contact=touched), gaps[outline]
    said = ", ".join(f"{1000 * gap:.0f} mm from the {PLACES[name]}" for name, gap in gaps.items())
    raise MagicError(
        Code.BAD_REQUEST,
        "where the tool met the target",
        said or "on no outline of it",
        f"near one of these, within {1000 * OFF_OUTLINE:g} mm or {100 * ASIDE_SHARE:.0f} % of the target's size; meet the target there, "
        "in the middle of its side",
    )


def _motion(demonstration: Demonstration, task: Task) -> _Motion:
    """The motion, thinned, up to where the tool rests if it is let go."""
    times, poses = np.asarray(demonstration.times, dtype=float), np.asarray(demonstration.world_from_tool, dtype=float)
    if len(times) < 2 or poses.shape != (len(times), 4, 4) or not (np.all(np.isfinite(times)) and np.all(np.isfinite(poses))):
        raise MagicError(Code.BAD_MOTION, "the tool's motion", f"{len(times)} times, poses {poses.shape}", "two or more finite timed poses")
    if not np.all(np.diff(times) > 0):
        raise MagicError(Code.BAD_MOTION, "times of the tool's motion", float(np.diff(times).min()), "increasing")
    times, poses = smoothed(times, poses)
    if task.releases:
        moves = [_apart(pose, poses[-1]) for pose in poses]
        rests = max((k + 1 for k, (way, turn) in enumerate(moves) if way > RESTS[0] or turn > RESTS[1]), default=0)
        times, poses = times[: rests + 1], poses[: rests + 1]
    kept = [0]
    for k in range(1, len(times)):
        way, turn = _apart(poses[k], poses[kept[-1]])
        if way >= SPACING[0] or turn >= SPACING[1] or times[k] - times[kept[-1]] >= SPACING[2] or k == len(times) - 1:
            kept.append(k)
    if len(kept) < 2:
        raise MagicError(Code.BAD_MOTION, "the tool's motion", "the tool does not move", "a tool in use")
    target_from_world = transforms.inverse(demonstration.target.world_from_object)
    return _Motion(task.name, times[kept] - times[0], target_from_world @ poses[kept], task.physics, task.releases)


def smoothed(times: Array, poses: Array) -> tuple[Array, Array]:
    """A track at 1 / TICK Hz without its jitter: times (N,) and poses (N, 4, 4) of quadratics through WINDOW seconds of it.

    A tracker's noise of a millimetre, at 30 Hz, is an acceleration of 1 m/s^2 and more: replayed as it is, the tool would hit what
    it only pushed.
    """
    at = np.arange(times[0], times[-1] + TICK / 2, TICK)
    even = transforms.interpolate(times, poses, at)
    width = min(round(WINDOW / TICK), len(at)) | 1
    if width > len(at) or width < 5:
        return times, poses
    quaternions = np.array([transforms.quaternion_xyzw(pose) for pose in even])
    # Of the two quaternions of a rotation the one nearer to that before.
    flips = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) < 0
    quaternions[1:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    values = savgol_filter(np.concatenate([even[:, :3, 3], quaternions], axis=1), width, 2, axis=0)
    return at, np.stack([transforms.from_quaternion(row[:3], row[3:]) for row in values])


def _apart(a: Array, b: Array) -> tuple[float, float]:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), transforms.rotation_angle(a, b)


def _contacts(demonstration: Demonstration, task: Task, motion: _Motion) -> tuple[Replay, float, float, tuple[Meeting, ...]]:
    """What the replay reads of the contact that the goal is reached with, when it is made and when tool and target part, seconds; and,
    where the target was moved from several places of a tool that keeps its attitude, one after the other, all of these meetings, that one
    the last."""
    end = float(motion.times[-1])
    scene = demonstration.tool, demonstration.target, demonstration.obstacles, demonstration.table
    if task.releases:
        return replay(motion, *scene, phases=(Phase("goal", 0.0, end),)), end, end, ()
    whole = replay(motion, *scene, phases=(Phase("goal", 0.0, end),))
    meetings = () if task.mode == "retarget" else _places(whole.meetings, demonstration.tool)
    if len(meetings) > 1:
        poses = motion.target_from_tool[motion.index(meetings[0].first) : motion.index(meetings[-1].last) + 1]
        meetings = meetings if max(_apart(pose, poses[0])[1] for pose in poses) < ATTITUDE else ()
    first, last = (meetings[-1].first, meetings[-1].last) if len(meetings) > 1 else (whole.first, whole.last)
    made = motion.index(first)
    turned = [k for k in range(made, len(motion.times)) if _apart(motion.target_from_tool[k], motion.target_from_tool[made])[1] > TURNED]
    # Of a target that tips over the place goes round with it, and its side is no longer where it was met.
    until = min(last, whole.tips, float(motion.times[turned[0]]) if turned else end)
    until = min(max(until, first + READ), end)
    phases = (Phase("approach", 0.0, first), Phase("contact", first, until), Phase("goal", until, end + 1e-3))
    found = replay(motion, *scene, phases=phases, watched="contact")
    return found, first, last, meetings


def _places(meetings: tuple[Meeting, ...], tool: SceneObject) -> tuple[Meeting, ...]:
    """Of the stretches of contact in which the target was moved those that follow each other at different places of the tool.

    What goes on where it was, after the tool was lifted, is one; a touch that moves nothing is none.
    """
    size = float(np.linalg.norm(tool.mesh.extents))
    found: list[Meeting] = []
    for meeting in meetings:
        if np.linalg.norm(meeting.after - meeting.before) < MOVED:
            continue
        last = found[-1] if found else None
        if last is not None and _same_place(last, meeting, size):
            found[-1] = replace(last, last=meeting.last, after=meeting.after)
        else:
            found.append(meeting)
    return tuple(found)


def _same_place(one: Meeting, other: Meeting, size: float) -> bool:
    alike = one.tool_normal @ other.tool_normal > np.cos(OTHERWISE)
    return bool(alike and np.linalg.norm(one.tool_point - other.tool_point) < ELSEWHERE * size)


def _with_earlier(draft: Strategy, target: SceneObject, earlier: tuple[Meeting, ...]) -> Strategy:
    """The strategy with the contacts of earlier meetings, in its own views; raises BAD_REQUEST where one of them is not seen in profile
    there."""
    pairs = []
    for number, meeting in enumerate(earlier, 1):
        contact, gap = _on_outline(draft.tool_view, meeting)
        if contact is None:
            raise _no_profile({f"{draft.view} of the last contact": gap})
        towards = target.world_from_object[:3, :3] @ meeting.target_normal
        normal = levelled(transforms.unit(towards - (towards @ draft.target_view_direction) * draft.target_view_direction))
        met, _ = _target_contact(replace(draft, target_normal=normal), target, meeting)
        pairs.append(ContactPair(f"contact_{number}", contact, met.target_contact, normal, met.target_outline))
    return replace(draft, contacts=tuple(pairs))


def _last_away(motion: _Motion, found: Replay, made: float, distance: float) -> int:
    """The last sample before the contact is made at which the tool's contact point is so far (m) from where it will be then."""
    points = motion.target_from_tool[:, :3, :3] @ found.tool_point + motion.target_from_tool[:, :3, 3]
    at = motion.index(made)
    far = np.flatnonzero(np.linalg.norm(points[:at] - points[at], axis=1) >= distance)
    return int(far[-1]) if len(far) else 0


def view_directions(tool: SceneObject, world_from_tool: Array, normal: Array, came: Array) -> list[Array]:
    """Directions (3,), world, in which the contact may be looked at, down or level, those across the tool's thinner sides first.

    world_from_tool (4, 4) when the contact is made; normal (3,): of the target's surface; came (3,): how the tool came there.
    Raises BAD_REQUEST where no side of the tool that shows the contact in profile is upright or level.
    """
    axes, _ = box_axes(tool.mesh)
    directions = [levelled(d) for d in axes @ world_from_tool[:3, :3].T if abs(d @ normal) < 0.7]
    usable = [d for d in directions if abs(d[2]) == 1.0 or d[2] == 0.0]
    if not usable:
        raise MagicError(
            Code.BAD_REQUEST,
            "directions in which the contact is seen in profile",
            [d.round(2).tolist() for d in directions],
            "one within 20 degrees of upright or of level: hold the tool upright or level when it meets the target",
        )
    return [np.array([0.0, 0.0, -1.0]) if abs(d[2]) == 1.0 else d if d @ came >= 0 else -d for d in usable]


def levelled(normal: Array) -> Array:
    """A direction (3,), made upright or level where it nearly is: what was meant, for tables are level and things stand on them."""
    if abs(normal[2]) > np.cos(NEARLY):
        return np.array([0.0, 0.0, np.sign(normal[2])])
    return transforms.unit(normal * [1.0, 1.0, 0.0]) if abs(normal[2]) < np.sin(NEARLY) else normal


def _tool_contact(
    tool: SceneObject, world_from_tool: Array, direction: Array, found: Replay, kind: str
) -> tuple[CanonicalView, Contact, float]:
    """The tool's picture as it was when the contact was made, the contact on its outline, and how far (m) that is from what was read."""
    tool_from_world = world_from_tool[:3, :3].T
    along = tool_from_world @ direction
    upright = bool(abs(direction[2]) > 0.5)
    up = tool_from_world @ ([1.0, 0.0, 0.0] if upright else [0.0, 0.0, 1.0])
    kinds = [kind] if kind else ["top" if upright else "side", *([] if upright else ["section"])]
    gaps: dict[str, float] = {}
    for tried in kinds:
        view = section_view(tool.mesh, along, up) if tried == "section" else canonical_view(tool.mesh, along, up, tried)
        contact, gaps[tried] = _on_outline(view, found)
        if contact is not None:
            return view, contact, gaps[tried]
    raise _no_profile(gaps)


def _on_outline(view: CanonicalView, read: Replay | Meeting) -> tuple[Contact | None, float]:
    """The place on the tool's outline where it met the target, ``None`` where that is not on it, and how far (m) it is from what was
    read."""
    contour = contours.extract(view.mask)
    pixel, towards = view.pixels(read.tool_point), read.tool_normal @ view.object_from_view[:3, :2]
    away = np.linalg.norm(contour.points - pixel, axis=1) + np.where(contour.normals @ towards > FACING, 0.0, np.inf)
    index = int(away.argmin())
    gap = float(away[index]) * view.metres_per_pixel
    if gap > max(OFF_OUTLINE, OFF_SHARE * contour.size * view.metres_per_pixel):
        return None, gap
    return to_contact(view, curvature.estimate(contour, index)), gap


def _no_profile(gaps: dict[str, float]) -> MagicError:
    return MagicError(
        Code.BAD_REQUEST,
        "distance of the contact from the tool's outline",
        ", ".join(f"{1000 * gap:.0f} mm in the view {name}" for name, gap in gaps.items()),
        "a contact that is seen in profile",
    )


def _with_motion(strategy: Strategy, motion: _Motion, made: float, parted: float, mode: str) -> Strategy:
    """The strategy with the part of the motion that belongs to its contact, the contact points meeting when it is made."""
    target_from_contact, tool_from_contact = (c.object_from_contact for c in (strategy.target_contact, strategy.tool_contact))
    contacts = transforms.inverse(target_from_contact) @ motion.target_from_tool @ tool_from_contact
    at = motion.index(made)
    # What the surfaces and the track are off by goes along with the tool, as it turns.
    off = contacts[at, :3, :3].T @ [*contacts[at, :2, 3], 0.0]
    contacts = contacts @ transforms.make(translation=-off)
    away = np.linalg.norm(contacts[: at + 1, :3, 3] - contacts[at, :3, 3], axis=1)
    start, near = (int(np.flatnonzero(away >= d)[-1]) if (away >= d).any() else 0 for d in (APPROACH, NEAR))
    last = motion.index(parted) if motion.times[-1] - parted > PARTED else len(motion.times) - 1
    ends = [(near, "approach"), (at, "contact"), (last, "goal"), (len(motion.times) - 1, "retreat")]
    ends = [(k, name) for n, (k, name) in enumerate(ends) if k > (ends[n - 1][0] if n else start)]
    if not mode:
        turns = [transforms.rotation_angle(c, OPPOSED) for c in contacts[start : last + 1]]
        mode = "plan" if max(turns) < ATTITUDE else "retarget"
    waypoints = _waypoints(motion.times, contacts[:, :3, 3], start, ends, every=mode == "plan")
    times = motion.times[start:] - motion.times[start]
    target_from_tool = target_from_contact @ contacts[start:] @ transforms.inverse(tool_from_contact)
    return replace(strategy, mode=mode, times=times, target_from_tool=target_from_tool, waypoints=waypoints)


def _with_motions(strategy: Strategy, motion: _Motion, meetings: tuple[Meeting, ...]) -> Strategy:
    """The strategy with a motion that meets the target in one place after the other, in mode ``plan``.

    meetings: in their order, those of the strategy's further contacts and at last of its first.  Offsets are from where the target stood
    when the motion began: a contact that is made after the target was moved is made as far from there.
    """
    pairs = [*((p.name, p.target, p.tool) for p in strategy.contacts), ("", strategy.target_contact, strategy.tool_contact)]
    legs = []
    for (name, target, tool), meeting in zip(pairs, meetings, strict=True):
        contact_from_target = transforms.inverse(target.object_from_contact)
        contacts = contact_from_target @ motion.target_from_tool @ tool.object_from_contact
        first, last = motion.index(meeting.first), motion.index(meeting.last)
        contacts[:, :2, 3] += (contact_from_target[:3, :3] @ meeting.before)[:2] - contacts[first, :2, 3]
        legs.append((name, contacts, first, last))

    def away(leg: tuple[str, Array, int, int], at: int) -> Array:
        return np.linalg.norm(leg[1][:, :3, 3] - leg[1][at, :3, 3], axis=1)

    end = len(motion.times) - 1
    far = np.flatnonzero(away(legs[0], legs[0][2])[: legs[0][2]] >= APPROACH)
    start = begin = int(far[-1]) if len(far) else 0
    waypoints: list[Waypoint] = []
    for number, leg in enumerate(legs):
        name, contacts, first, last = leg
        far = np.flatnonzero(away(leg, first)[begin:first] >= NEAR)
        near = begin + int(far[-1]) if len(far) else begin
        ends = [(near, "over"), (first, "over" if name else "goal")] if number else [(near, "approach"), (first, "contact")]
        over = end
        if name:
            # The tool goes over to the next contact where it is farthest from both.
            meets = legs[number + 1][2]
            over = last + int(np.minimum(away(leg, last), away(legs[number + 1], meets))[last : meets + 1].argmax())
        ends += [(last, name or "goal"), (over, "over" if name else "retreat")]
        ends = [(k, phase) for n, (k, phase) in enumerate(ends) if k > (ends[n - 1][0] if n else begin)]
        made = _waypoints(motion.times, contacts[:, :3, 3], begin, ends, every=True)
        waypoints += [replace(w, name=f"{w.name}_{number}" if number else w.name, contact=name) for w in made[number > 0 :]]
        begin = over
    # Within a leg a phase may end twice: on the way, and where the contact is made.
    named = [w.name for w in waypoints]
    waypoints = [replace(w, name=f"{w.name}_made") if w.name in named[:k] else w for k, w in enumerate(waypoints)]
    target_from_contact, tool_from_contact = (c.object_from_contact for c in (strategy.target_contact, strategy.tool_contact))
    target_from_tool = target_from_contact @ legs[-1][1][start:] @ transforms.inverse(tool_from_contact)
    times = motion.times[start:] - motion.times[start]
    return replace(strategy, mode="plan", times=times, target_from_tool=target_from_tool, waypoints=tuple(waypoints))


def _waypoints(times: Array, offsets: Array, start: int, ends: list[tuple[int, str]], every: bool) -> tuple[Waypoint, ...]:
    """One at the end of each phase and, with ``every``, the start and those between that the path's corners need."""
    waypoints = [Waypoint("start", offsets[start], ends[0][1])] if every else []
    before = start
    for end, phase in ends:
        corners = [*(_corners(offsets, before, end) if every else ()), end]
        for number, k in enumerate(corners, 1):
            speed = float(np.linalg.norm(np.diff(offsets[before : k + 1], axis=0), axis=1).sum() / (times[k] - times[before]))
            name = phase if k == end else f"{phase}_{number}"
            waypoints.append(Waypoint(name, offsets[k], phase, float(np.clip(speed, *SPEEDS))))
            before = k
    return tuple(waypoints)


def _corners(points: Array, first: int, last: int) -> list[int]:
    """Of a path the points between two that keep straight lines within STRAIGHT of it (Douglas and Peucker, 1973)."""
    if last - first < 2:
        return []
    line = points[last] - points[first]
    inner = points[first + 1 : last] - points[first]
    share = np.clip(inner @ line / max(float(line @ line), 1e-12), 0.0, 1.0)
    away = np.linalg.norm(inner - share[:, None] * line, axis=1)
    worst = first + 1 + int(away.argmax())
    if away.max() <= STRAIGHT:
        return []
    return [*_corners(points, first, worst), worst, *_corners(points, worst, last)]


def _tried(demonstration: Demonstration, strategy: Strategy) -> Verdict | None:
    """The strategy carried out with the objects that it was shown with."""
    from magic_planner.object_motion import plan_tool_motion

    if not strategy.simulatable:
        return None
    goals.require(strategy)
    scene = demonstration.tool, demonstration.target
    candidate = ContactCandidate(
        demonstration.tool.id,
        strategy.tool_contact,
        strategy.target_contact,
        0.0,
        False,
        1.0,
        1.0,
        1.0,
        np.eye(4),
        tuple(Companion(pair.name, pair.tool, pair.target) for pair in strategy.contacts),
    )
    try:
        motion = plan_tool_motion(strategy, *scene, candidate, "keep", demonstration.table, demonstration.obstacles)
    except MagicError as error:
        return Verdict(False, error.code, error.message)
    return verify_proposal(Proposal(strategy, *scene, demonstration.obstacles, demonstration.table, MotionPlan("fg", motion)))


def _shown(demonstration: Demonstration, strategy: Strategy, motion: _Motion, made: float, parted: float) -> Verdict | None:
    """The demonstrated motion itself, judged as the strategy's is: what the strategy cannot do better than."""
    if not strategy.simulatable:
        return None
    end = float(motion.times[-1])
    last = parted if end - parted > PARTED else end
    ends = [("approach", made), ("contact", min(made + READ, last)), ("goal", last), ("retreat", end)]
    times, poses = motion.times, demonstration.target.world_from_object @ motion.target_from_tool
    if motion.releases:
        # The hand opens where the motion ends.
        times, poses = np.append(times, end + READ), np.concatenate([poses, poses[-1:]])
        ends = [("approach", end), ("release", end + READ)]
    phases, start = [], 0.0
    for name, until in ends:
        if until > start:
            phases.append(Phase(name, start, until))
            start = until
    plan = MotionPlan("fg", ToolMotion(times, poses, tuple(phases)))
    scene = demonstration.tool, demonstration.target, demonstration.obstacles, demonstration.table
    return verify_proposal(Proposal(strategy, *scene, plan), repetitions=1)  # it was made once, in the scene as it was


def advice(learned: Learned) -> list[str]:
    """What a trial that failed measured beside what was shown, and what to change: sentences, none for a trial that passed."""
    verdict, shown, strategy = learned.verdict, learned.shown, learned.strategy
    if verdict is None or shown is None or verdict.success:
        return []
    if shown.success:
        other = "retarget" if strategy.mode == "plan" else "plan"
        return [
            f"the demonstrated motion itself passes, replayed: {shown.message}",
            f"to change: --mode {other} instead of {strategy.mode}; or record again: slower, the tool led straight to its contact and away",
        ]
    lines = [f"the demonstrated motion itself fails, replayed: {shown.code.name}, {shown.message}"]
    return [*lines, f"to change: {_remedy(shown, strategy)}"]


def doubts(learned: Learned) -> list[str]:
    """What the trial with the demonstrated objects, passed or not, does not tell of other tools and targets: sentences, none where nothing
    is to be said."""
    notes = []
    if (changed := learned.changed) is not None:
        notes += [f"the goal does not ask {line}" for line in changed.unasked(learned.strategy.goal)]
        if TABLE in changed.stood_on and (touched := sorted(set(changed.stood_on) & set(changed.fixtures))):
            notes.append(
                f"as it was seen the target stands on the table and touches {', '.join(touched)}: what stands on a fixture is taken to go down to "
                "the table; let it stand on the table, and clear of fixtures"
            )
    if not learned.askew:
        return notes
    return [
        *notes,
        f"the tool met the target {np.degrees(learned.askew):.0f} degrees off the way that it led it, and has no place near there that is square to "
        "that way: the tool's shape or its track is off where they met, or the tool was held askew. With tools and targets of other shapes this "
        "strategy will fail more often; to change: record again, the place of the tool that meets the target in the cameras' sight, nearer or "
        "from more sides",
    ]


def _remedy(shown: Verdict, strategy: Strategy) -> str:
    """What to record or to give otherwise where a demonstration does not pass its goal."""
    metrics, physics = shown.metrics, strategy.physics
    if shown.code == Code.GOAL_NOT_REACHED:
        for node in strategy.goal.written.nodes():
            number, measured = {"moved": ("by", "moved"), "above": ("height", "height")}.get(node.kind, ("", ""))
            name = node.args.get(number)
            reached = np.floor(100 * 0.95 * metrics.get(node.metric or f"{node.args.get('what')}_{measured}", 0.0)) / 100
            if isinstance(name, str) and reached > 0:
                return f"--value {name}={reached:g} (m) asks for no more than was shown; or record it farther than the goal asks for"
        return "the goal, or record a demonstration that reaches it"
    if shown.code == Code.DRIFT and metrics.get("holds") == 0.0:
        return "--value hold=0 where the target is only to be pushed; or a tool whose contact encloses the target"
    if shown.code == Code.DRIFT:
        drifted, radius = metrics.get("sideways_drift", 0.0), metrics.get("target_radius")
        unit, measured = ("m", f"{drifted:.3f}") if radius is None else ("a share of the target's radius", f"{drifted / radius:.2f}")
        return f"record again, the tool led straight along its normal; or --value drift=NUMBER ({unit}; {measured} was measured)"
    if shown.code == Code.LOST_CONTACT:
        return (
            f"--friction (now {physics.friction:g}) and --target-density (now {physics.target_density:g} kg/m^3) as they really are; or record "
            "again: slower, and still for a second at the end"
        )
    if shown.code == Code.UNSTABLE:
        return f"record again: slower towards the end, and still for a second before the recording ends; or --friction (now {physics.friction:g})"
    if shown.code == Code.PRE_CONTACT_COLLISION:
        return "record again: the tool led to its contact without touching anything before"
    if shown.code == Code.OBSTACLE_PUSHED:
        return "record again, nothing else in the way of tool and target: what is pushed beside the target has no part in any strategy"
    if shown.code == Code.LIMIT_EXCEEDED:
        return "record again: the tool held a few millimetres off the table and fixtures"
    return "record again: slower, and without pressing"
