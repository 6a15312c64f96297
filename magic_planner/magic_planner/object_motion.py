"""The motion of the tool alone: the floating gripper of the paper (III-C).

Two ways to make it, both in terms of C(t) = target_contact_from_tool_contact, the
pose of the tool's contact frame in the target's:

    world_from_tool(t) = world_from_target  target_from_contact  C(t)  tool_from_contact^-1

``retarget`` takes C(t) from the demonstration, ``plan`` leads the squarely opposed
frames through the strategy's waypoints.  A strategy may have several pairs of contacts.  Of one that waypoints name the
frames are led at these waypoints as those of the first are at the others; between two such waypoints the tool turns
evenly.  One that no waypoint names is met together with the first: the tool is turned about the first contact, and shifted, as suits
all of them best (:mod:`magic_core.placement`).  A scoop with a smaller target is led nearer to walls
(:mod:`magic_planner.proportion`).  Where the tool has no room to meet the target
at the contact itself, the contact slides along it (:mod:`magic_planner.sliding`); what
the table still lacks raises the whole motion; what is still in the way is given way to
(:mod:`magic_planner.giving_way`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.contact import OPPOSED, Companion, Contact, ContactCandidate, turned_over
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, concatenate
from magic_core.motion import Phase, ToolMotion
from magic_core.placement import Pairs, pairs_of, relative, together, waypoint_poses
from magic_core.rendering import Raycaster
from magic_core.scene import SceneObject
from magic_core.strategy import MODES, REFLECTIONS, Strategy, Waypoint
from magic_planner.collision import Body, grown, hull, mass_centre, outer_points, solid_pieces
from magic_planner.giving_way import GAP, give_way
from magic_planner.proportion import in_measure
from magic_planner.sliding import lowest, slid_contacts

#: Largest step between two samples: metres, radians.
STEP_LENGTH = 0.005
STEP_ANGLE = np.deg2rad(2.0)
#: Gap kept between tool and table, metres, at least, and the share of the target's height that a larger one may take up.
TABLE_CLEARANCE, LOW_SHARE = 0.001, 0.2
#: A tool that goes beneath its target does so along what it goes up; on the table it only pushes.  The share of the target's height that
#: the room for the contact may take up there: gap and lip together have to stay well below the target's middle, or it is driven along
#: before the lip.  But a tool turns in the hand, which holds it about its middle: as much room as its contact is off then, in metres for
#: each metre from there, a long one needs.
BENEATH_SHARE, TURNED_IN_HAND = 0.05, 0.01
#: A tool is beneath its target where its side at the contact faces up by at least so much (cosine).
BENEATH = 0.7
#: What comes so near (m) to the sides of a target that is met is to be beside it; into how many sectors about it that is parted; how far
#: (m) within a side the lower end of it is looked for.
TOUCHED, SECTORS, INSIDE = 0.003, 36, 0.0005
#: By so much (rad) a tool is turned out of the attitude in which its contact was seen, where it would pass over its target in that.
LEVELLED = np.deg2rad(45.0)
#: How quickly the tool takes up and loses its speed between waypoints, m/s^2.
ACCELERATION = 1.0
#: How long a waypoint that does not move the tool lasts (the gripper opens), seconds.
DWELL = 0.5


#: By how much an approach is drawn in, in order of trial.
SHARES = (1.0, 0.75, 0.55, 0.4, 0.28, 0.2, 0.12)
#: The gap in metres that a tool keeps to a fixed target until it is let go, in order of trial: what cameras and hand do not know of
#: where the tool is, two standard deviations, then what room there is.  It falls so far.  An approach to a target that moves keeps the
#: first of them, or as much as there is.
GAPS = (0.006, 0.0045, 0.003, 0.0015)
#: Where there is no such place it is let go so much of the way from its approach to the contact, in order of trial.
SHORT = (0.75, 0.5, 0.25, 0.0)
#: Room (m) with which a tool is slid over a fixed target, if there is so much, how far aside (m) from how it was shown that is looked for,
#: by which steps (m), and on how many points of the tool's surface at how many poses it is measured.
ROOM, ROOM_ASIDE, ROOM_STEPS, ROOM_POINTS, ROOM_POSES = 0.010, 0.02, (0.004, 0.002, 0.001), 3000, 9
#: Where the tool turns between waypoints, what is so far from the contact (m) moves at the waypoint's speed.
TURNING_ARM = 0.15
#: What is no lack of room (m).
ROUNDING = 0.0005
#: How far beside the contact, along its tangent, that room is looked for, in order of trial (m): what is let go there slides into the
#: hollow by its weight.
ASIDE = (0.0, 0.002, -0.002, 0.004, -0.004, 0.006, -0.006)


def warm_up() -> None:
    """Load what the first motion with a wall or a hole would otherwise wait half a second for."""
    Raycaster([Mesh(np.eye(3), np.array([[0, 1, 2]]))]).distances(np.zeros((1, 3)))


def plan_tool_motion(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    candidate: ContactCandidate,
    reflection: str = "keep",
    table: NDArray[np.float64] | Sequence[float] = (0.0, 0.0, 1.0, 0.0),
    obstacles: Sequence[SceneObject] = (),
    gap: float = GAP,
) -> ToolMotion:
    """The motion of a new tool that brings its contact onto the target's as the demonstration did.

    reflection: for a mirrored candidate, ``turn`` turns the tool over (exact), ``keep`` keeps its
    face (the mirrored part of the likeness is lost); without effect on other candidates.
    table (4,): plane a x + b y + c z + d = 0 in world coordinates, unit normal up.  gap: metres that the tool keeps to an
    obstacle that it has to give way to (:mod:`magic_planner.giving_way`).

    A strategy that releases ends with its phase ``release``: the tool has left the hand, and
    waypoints after that are the hand's own.

    Raises BAD_REQUEST (no target contact, unknown reflection, another tool's candidate), BAD_STRATEGY
    (no waypoints, no demonstration), BAD_MOTION (NaN, a frame that is not a rotation, a table that
    stands on edge), BAD_MESH (a tool without a shape), and PATH_IN_COLLISION naming the pair where the
    tool would start inside the target or an obstacle.
    """
    met = _target_contact(candidate, tool)
    if reflection not in REFLECTIONS:
        raise MagicError(Code.BAD_REQUEST, "reflection", reflection, REFLECTIONS)
    plane = table_plane(table)
    _rigid(tool.world_from_object, f"pose of {tool.id}")  # the arm starts from it
    world_from_target = _rigid(target.world_from_object, f"pose of {target.id}")
    target_from_contact = _rigid(met.object_from_contact, f"contact frame of {target.id}")
    tool_from_contact = placed_contact_frame(strategy, candidate, reflection)
    world_from_contact = world_from_target @ target_from_contact
    shown = demonstrated_motion(strategy) if strategy.mode == "retarget" else None
    beneath = shown is not None and _ends_beneath(world_from_contact @ shown[1], plane)
    clearance = _share_of_height(target, plane, gap, LOW_SHARE)
    if not beneath:
        clearance = _beside(tool, tool_from_contact, target, world_from_contact, plane, clearance)
    if not candidate.companions:
        tool_from_contact = _not_over(tool, tool_from_contact, target, world_from_contact, plane, clearance)
    pairs = further_pairs(strategy, candidate, reflection, tool_from_contact)

    if strategy.mode == "plan":
        waypoint_motion(strategy, pairs)  # what is wrong with the waypoints is said before they are changed
        strategy = drawn_in(strategy, tool, target, world_from_contact, transforms.inverse(tool_from_contact), pairs)
        times, contacts, phases = waypoint_motion(strategy, pairs)
    elif shown is not None:
        times, contacts, phases = shown
    else:
        raise MagicError(Code.BAD_STRATEGY, f"mode of {strategy.name}", strategy.mode, MODES)
    world_from_meeting = world_from_contact @ contacts
    if beneath:
        world_from_meeting = in_measure(strategy, target, target_from_contact, contacts, obstacles, plane)
    room = _room_beneath(tool, tool_from_contact, target, plane, gap) if beneath else gap
    frames = slid_contacts(tool, tool_from_contact, world_from_meeting, obstacles, plane, clearance, room)
    world_from_tool = world_from_meeting @ transforms.inverse(frames)
    world_from_tool[:, 2, 3] += lift_above(plane, world_from_tool, outer_points(tool), clearance)
    _require_clear_start(tool, world_from_tool[0], (target, *obstacles))
    marks = waypoint_times(strategy, pairs)

    def name(index: int) -> str:
        ahead = next((n for n, t in marks if t >= times[index] - 1e-6), marks[-1][0])
        return f"waypoint {ahead!r} (at {times[index]:.2f} s of the tool's motion)"

    world_from_tool = give_way(world_from_tool, tool, obstacles, world_from_contact[:3, 2], plane, clearance, name, gap)
    return ToolMotion(times, world_from_tool, phases, marks)


def _target_contact(candidate: ContactCandidate, tool: SceneObject) -> Contact:
    """Where a candidate's tool is to meet the target; raises BAD_REQUEST where the candidate does not say it, or is another tool's."""
    if candidate.target is None:
        raise MagicError(
            Code.BAD_REQUEST, f"candidate of tool {tool.id}", "without a target contact", "a candidate with the target's contact filled in"
        )
    if candidate.tool_id and candidate.tool_id != tool.id:
        raise MagicError(Code.BAD_REQUEST, "tool of the candidate", candidate.tool_id, f"{tool.id!r}, the tool of the request")
    return candidate.target


def _require_clear_start(tool: SceneObject, world_from_tool: NDArray[np.float64], others: Sequence[SceneObject]) -> None:
    """Raises PATH_IN_COLLISION where a tool at the first pose (4, 4) of its motion is in something else."""
    start = Body(tool.id, solid_pieces(tool))
    start.move(world_from_tool)
    for item in others:
        if start.touches(Body.from_object(item)):
            raise MagicError(
                Code.PATH_IN_COLLISION,
                f"start of the tool's motion: {tool.id} and {item.id}",
                "in collision",
                "a first waypoint at which the tool is clear of the target and the obstacles",
            )


def _ends_beneath(world_from_meeting: NDArray[np.float64], plane: NDArray[np.float64]) -> bool:
    """Whether a motion of the contact (T, 4, 4) turns the tool, which meets its target from the side, until it is beneath: a scoop."""
    up = world_from_meeting[[0, -1], :3, 0] @ plane[:3]
    return bool(up[0] < BENEATH < up[1])


def _share_of_height(target: SceneObject, plane: NDArray[np.float64], gap: float, share: float) -> float:
    """``gap`` (m), as to obstacles, for a tool that has turned a little in the gripper would scrape along the table with the far end of a
    long handle; but no more than a share of the target's height, so that a low target is met all the same."""
    pieces = np.concatenate([piece.vertices for piece in solid_pieces(target)])
    height = float((transforms.apply(target.world_from_object, pieces) @ plane[:3] + plane[3]).max())
    return max(TABLE_CLEARANCE, min(gap, share * height))


def _room_beneath(
    tool: SceneObject, tool_from_contact: NDArray[np.float64], target: SceneObject, plane: NDArray[np.float64], gap: float
) -> float:
    """The room (m), ``gap`` or less, to what a tool goes up along that goes beneath its target (:data:`BENEATH_SHARE`,
    :data:`TURNED_IN_HAND`)."""
    off = TURNED_IN_HAND * float(np.linalg.norm(tool_from_contact[:3, 3] - mass_centre(solid_pieces(tool))[1]))
    return max(_share_of_height(target, plane, gap, BENEATH_SHARE), min(gap, off))


def _beside(
    tool: SceneObject,
    tool_from_contact: NDArray[np.float64],
    target: SceneObject,
    world_from_contact: NDArray[np.float64],
    plane: NDArray[np.float64],
    clearance: float,
) -> float:
    """The gap (m) to the table, ``clearance`` or less where the table raises parts of the tool that are to be beside the target until
    little of them
    is: no more than a share of what the target rises above the lower side of each where the tool is led without any gap.  The stem of a
    hook that stands on its plate was led over a cylinder."""
    import trimesh

    up, points = plane[:3], outer_points(tool)
    met = world_from_contact @ OPPOSED @ transforms.inverse(tool_from_contact)
    raised = lift_above(plane, met[None], points, clearance) > 0
    if clearance <= TABLE_CLEARANCE or not raised or abs(world_from_contact[:3, 0] @ up) > BENEATH:
        return clearance
    met[2, 3] += lift_above(plane, met[None], points, 0.0)
    wall = concatenate([Mesh(*hull(piece.vertices)) for piece in solid_pieces(target)]).transformed(target.world_from_object)
    body = concatenate([Mesh(*hull(piece.vertices)) for piece in solid_pieces(tool)])
    on = transforms.apply(met, np.asarray(trimesh.sample.sample_surface(body.to_trimesh(), ROOM_POINTS, seed=0)[0]))
    heights = on @ up + plane[3]
    level = float(world_from_contact[:3, 3] @ up + plane[3])
    near = Raycaster([wall]).distances(on + (level - heights)[:, None] * up) < TOUCHED
    on, heights = on[near], heights[near]
    # Sector by sector about the target: a part that is low on one side of it says nothing of the other side.
    away = on - wall.vertices.mean(axis=0)
    away -= (away @ up)[:, None] * up
    first = transforms.unit(world_from_contact[:3, 0] - (world_from_contact[:3, 0] @ up) * up)
    sector = np.floor(np.arctan2(away @ np.cross(up, first), away @ first) / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    # The tool's lower side there, a little within what faces the target.
    below = on + INSIDE * away / np.linalg.norm(away, axis=1, keepdims=True) - (heights + INSIDE)[:, None] * up
    hit = Raycaster([body.transformed(met)]).cast(below, np.tile(up, (len(below), 1))).distance - INSIDE
    lowest_of = np.full(SECTORS, np.inf)
    np.minimum.at(lowest_of, sector, np.minimum(heights, hit))
    rises = float((wall.vertices @ up).max() + plane[3]) - lowest_of
    rises = rises[np.isfinite(rises) & (rises > 0)]
    return clearance if not len(rises) else max(TABLE_CLEARANCE, min(clearance, LOW_SHARE * float(rises.min())))


def _not_over(
    tool: SceneObject,
    tool_from_contact: NDArray[np.float64],
    target: SceneObject,
    world_from_contact: NDArray[np.float64],
    plane: NDArray[np.float64],
    clearance: float,
) -> NDArray[np.float64]:
    """The contact frame (4, 4), turned about the contact so that the tool is led as flat as it lies, where it would pass over the target.

    A contact is seen in the view that shows it best, which may be a little askew to a long tool: held so it stands on its one end, and
    the contact is higher than a low target.
    """
    up = plane[:3]
    pieces = transforms.apply(target.world_from_object, np.concatenate([piece.vertices for piece in solid_pieces(target)]))
    room = float((pieces @ up).max() - world_from_contact[:3, 3] @ up)
    points = outer_points(tool)

    def raised(frame: NDArray[np.float64]) -> float:
        return lift_above(plane, (world_from_contact @ OPPOSED @ transforms.inverse(frame))[None], points, clearance)

    lift = raised(tool_from_contact)
    lying = tool.world_from_object[:3, :3].T @ up
    used = (world_from_contact @ OPPOSED @ transforms.inverse(tool_from_contact))[:3, :3].T @ up
    lying = lying if lying @ used > 0 else -lying  # turned over it lies as flat
    axis = np.cross(used, lying)
    sine = float(np.linalg.norm(axis))
    if lift < room or not 1e-6 < sine <= np.sin(LEVELLED):
        return tool_from_contact
    turned = tool_from_contact.copy()
    turned[:3, :3] = transforms.from_rotvec(axis / sine * np.arcsin(sine))[:3, :3] @ turned[:3, :3]
    return turned if raised(turned) < min(room, lift) else tool_from_contact


def tool_contact_frame(candidate: ContactCandidate, reflection: str) -> NDArray[np.float64]:
    """tool_from_contact (4, 4) that is led along: turned over for a mirrored match that is to be turned."""
    tool_from_contact = _rigid(candidate.tool.object_from_contact, f"contact frame of {candidate.tool_id or 'the tool'}")
    return turned_over(tool_from_contact) if candidate.flipped and reflection == "turn" else tool_from_contact


def placed_contact_frame(strategy: Strategy, candidate: ContactCandidate, reflection: str) -> NDArray[np.float64]:
    """As :func:`tool_contact_frame`, turned and shifted so that further contacts, which no waypoint names, meet the target together with
    it.

    Raises BAD_REQUEST for a candidate that lacks contacts of the strategy.
    """
    frame = tool_contact_frame(candidate, reflection)
    names, given = [pair.name for pair in strategy.contacts], [companion.name for companion in candidate.companions]
    lacking = [c.name for c in candidate.companions if c.target is None]
    if names != given or lacking:
        told = f"{given}, {lacking} without a target contact" if lacking else given
        raise MagicError(Code.BAD_REQUEST, f"further contacts of the candidate on {candidate.tool_id or 'the tool'}", told, names)
    named = {waypoint.contact for waypoint in strategy.waypoints}
    at_once = [companion for companion in candidate.companions if companion.name not in named]
    if not at_once or candidate.target is None:
        return frame
    first = _rigid(candidate.target.object_from_contact, "contact frame of the target") @ OPPOSED
    wanted = [relative(first, c.target.object_from_contact @ OPPOSED) for c in at_once if c.target is not None]
    found = [relative(frame, _further_frame(candidate, c, reflection)) for c in at_once]
    pairs = [(candidate.tool, candidate.target), *((c.tool, c.target) for c in at_once)]
    straight = [not all(np.isfinite(contact.radius) for contact in pair if contact is not None) for pair in pairs]
    angle, shift = together(wanted, found, straight)
    return frame @ transforms.from_rotvec([0.0, 0.0, angle]) @ transforms.make(translation=[*-shift, 0.0])


def _further_frame(candidate: ContactCandidate, companion: Companion, reflection: str) -> NDArray[np.float64]:
    frame = _rigid(companion.tool.object_from_contact, f"frame of contact {companion.name}")
    return turned_over(frame) if candidate.flipped and reflection == "turn" else frame


def further_pairs(strategy: Strategy, candidate: ContactCandidate, reflection: str, tool_from_contact: NDArray[np.float64]) -> Pairs:
    """The contacts that waypoints name, for :func:`magic_core.placement.waypoint_poses`."""
    if candidate.target is None:
        return {}
    named = {waypoint.contact for waypoint in strategy.waypoints}
    companions = {c.name: c for c in candidate.companions if c.name in named and c.target is not None}
    frames = {
        name: (_rigid(c.target.object_from_contact, f"frame of contact {name} on the target"), _further_frame(candidate, c, reflection))
        for name, c in companions.items()
        if c.target is not None
    }
    return pairs_of((candidate.target.object_from_contact, tool_from_contact), frames)


def drawn_in(
    strategy: Strategy,
    tool: SceneObject,
    target: SceneObject,
    world_from_contact: NDArray[np.float64],
    contact_from_tool: NDArray[np.float64],
    pairs: Pairs = MappingProxyType({}),
) -> Strategy:
    """The strategy with its approach and its retreat drawn in to the contact where the tool would meet the target on the way.

    A ring that is lowered over a target has less room than a hook that comes from the open side.  Offsets across the view
    direction are scaled, of the approach's waypoints from that of the contact, of the retreat's from that of the goal; the
    largest of :data:`SHARES` counts at which the approach keeps the first of :data:`GAPS` to the target, as neither is quite where it was
    seen; where none does, the approach goes from the one with most room to where there is most beside it.  Where that is not clear either,
    or the strategy has no approach that ends in a contact, it comes back as it is.

    A tool that is let go on a fixed target is let go above it: approach and contact keep the largest of :data:`GAPS` for which
    there is room, so that a tool that is not quite where it was seen does not press on what cannot give way; where there is none at the
    contact, on the way to it.  The approach, on which a rod passes through a handle, goes where there is most room about it.
    """
    waypoints = list(strategy.waypoints)
    meets = next((i for i, w in enumerate(waypoints) if w.phase != "approach"), 0)
    if meets == 0 or waypoints[meets].phase != "contact":
        return strategy
    held = Body(tool.id, solid_pieces(tool))

    def poses_of(changed: Strategy, until: int) -> NDArray[np.float64]:
        times, contacts, phases = waypoint_motion(changed, pairs)
        return np.asarray(world_from_contact @ contacts[times <= phases[until].end + 1e-9] @ contact_from_tool)

    def roomy(gap: float) -> Body:
        wall = Body(target.id, grown(solid_pieces(target), gap))
        wall.move(target.world_from_object)
        return wall

    if strategy.releases and strategy.physics.target_is_fixed:
        for gap in GAPS:
            wall = roomy(gap - ROUNDING)
            for aside in ASIDE:
                seated = _seated(strategy, gap, aside)
                if _touches_on(held, poses_of(seated, 1)[-1:], wall):
                    continue
                for share in (*SHARES, 0.0):
                    changed = _scaled(seated, meets, share)
                    if not _touches_on(held, poses_of(changed, 1), wall):
                        middle = _with_room(changed, meets, tool, poses_of(changed, 0), target, world_from_contact)
                        return changed if _touches_on(held, poses_of(middle, 1), wall) else middle
        middle = _with_room(strategy, meets, tool, poses_of(strategy, 0), target, world_from_contact)
        for gap, share in itertools.product(GAPS, SHORT):
            changed = _stopped_short(middle, meets, share)
            if not _touches_on(held, poses_of(changed, 1), roomy(gap - ROUNDING)):
                return changed
    fixed, wall = Body.from_object(target), roomy(GAPS[0])
    for share in SHARES:
        changed = _scaled(strategy, meets, share)
        if not _touches_on(held, poses_of(changed, 0), wall):
            return changed
    # In a hole that is hardly wider than the target only its middle is clear.
    around, surface = Raycaster([_solid(target).transformed(target.world_from_object)]), _surface(tool)
    some = [_scaled(strategy, meets, share) for share in SHARES]
    clear = [changed for changed in some if not _touches_on(held, poses_of(changed, 0), fixed)] or some[-1:]
    roomiest = max(clear, key=lambda changed: float(around.distances(_swept(surface, poses_of(changed, 0))).min()))
    middle = _with_room(roomiest, meets, tool, poses_of(roomiest, 0), target, world_from_contact)
    return strategy if _touches_on(held, poses_of(middle, 0), fixed) else middle


def _seated(strategy: Strategy, gap: float, aside: float) -> Strategy:
    """The strategy ``aside`` metres along the contact's tangent, its contact and all that follows ``gap`` metres from the target or
    more."""

    def moved(w: Waypoint) -> Waypoint:
        x, y, z = (float(value) for value in w.offset)
        return replace(w, offset=np.array([x if w.phase == "approach" else max(x, gap), y + aside, z]))

    return replace(strategy, waypoints=tuple(moved(w) for w in strategy.waypoints))


def _stopped_short(strategy: Strategy, meets: int, share: float) -> Strategy:
    """The strategy with its contact, and all that follows, at a share of the way across the view direction from the approach to the
    contact."""
    waypoints = list(strategy.waypoints)
    short = (1 - share) * (np.asarray(waypoints[meets - 1].offset, dtype=float) - np.asarray(waypoints[meets].offset, dtype=float))
    for i in range(meets, len(waypoints)):
        waypoints[i] = replace(waypoints[i], offset=np.asarray(waypoints[i].offset, dtype=float) + [*short[:2], 0.0])
    return replace(strategy, waypoints=tuple(waypoints))


def _with_room(
    strategy: Strategy,
    meets: int,
    tool: SceneObject,
    poses: NDArray[np.float64],
    target: SceneObject,
    world_from_contact: NDArray[np.float64],
) -> Strategy:
    """The strategy, its approach shifted across the view direction to where the tool, at the poses (T, 4, 4) of it, is farthest from the
    target; no farther than it takes for :data:`ROOM`.  Uphill from where it is, so that what goes round the target goes on round it."""
    wall = Raycaster([_solid(target).transformed(target.world_from_object)])
    swept = _swept(_surface(tool), poses)

    def apart(shift: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float32]:
        return wall.distances(points + world_from_contact[:3, :2] @ shift)

    angles = np.arange(8) * np.pi / 4
    best = np.zeros(2)
    gaps = apart(best, swept)
    for step in ROOM_STEPS:
        while gaps.min() < ROOM:
            around = [best + step * np.array([np.cos(a), np.sin(a)]) for a in angles]
            close = swept[gaps < gaps.min() + 2 * step]  # a step away no other point can be the nearest
            found = [float(apart(shift, close).min()) if np.linalg.norm(shift) <= ROOM_ASIDE else 0.0 for shift in around]
            if max(found) < gaps.min() + ROUNDING / 2:
                break
            best = around[int(np.argmax(found))]
            gaps = apart(best, swept)
    waypoints = [
        replace(w, offset=np.asarray(w.offset, dtype=float) + [*best, 0.0]) if i < meets else w for i, w in enumerate(strategy.waypoints)
    ]
    return replace(strategy, waypoints=tuple(waypoints))


def _solid(item: SceneObject) -> Mesh:
    """An object's convex pieces as one mesh, in its frame."""
    return concatenate([Mesh(*hull(piece.vertices)) for piece in solid_pieces(item)])


def _surface(item: SceneObject) -> NDArray[np.float64]:
    """Points (:data:`ROOM_POINTS`, 3) all over an object, in its frame."""
    import trimesh

    return np.asarray(trimesh.sample.sample_surface(_solid(item).to_trimesh(), ROOM_POINTS, seed=0)[0])


def _swept(points: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 3) of a tool at :data:`ROOM_POSES` of its poses (T, 4, 4) at most, all together, in the world."""
    some = poses[np.unique(np.linspace(0, len(poses) - 1, ROOM_POSES).round().astype(int))]
    return np.concatenate([transforms.apply(pose, points) for pose in some])


def _touches_on(body: Body, poses: NDArray[np.float64], other: Body) -> bool:
    for pose in poses[::-1]:
        body.move(pose)
        if body.touches(other):
            return True
    return False


def _scaled(strategy: Strategy, meets: int, share: float) -> Strategy:
    if share == 1:
        return strategy
    waypoints, across = list(strategy.waypoints), np.array([share, share, 1.0])
    contact = waypoints[meets]
    goal = next((w for w in reversed(waypoints) if w.phase == "goal"), contact)
    for i, waypoint in enumerate(waypoints):
        origin = contact if i < meets else goal if waypoint.phase == "retreat" else None
        if origin is not None and waypoint.contact == origin.contact:  # offsets of other contacts are in other frames
            at = np.asarray(origin.offset, dtype=float)
            waypoints[i] = replace(waypoint, offset=at + across * (np.asarray(waypoint.offset, dtype=float) - at))
    return replace(strategy, waypoints=tuple(waypoints))


def waypoint_motion(
    strategy: Strategy, pairs: Pairs = MappingProxyType({})
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[Phase, ...]]:
    """times (T,), C(t) (T, 4, 4) and phases of a ``plan`` strategy: straight lines, at rest at each waypoint.

    pairs: what :func:`further_pairs` gives, for waypoints of further contacts; all C(t) are of the first contact's frames.
    """
    waypoints = list(strategy.waypoints)
    if strategy.releases:
        last = next((i for i, w in enumerate(waypoints) if w.phase == "release"), None)
        waypoints = waypoints[: last + 1] if last is not None else waypoints
    if len(waypoints) < 2:
        raise MagicError(Code.BAD_STRATEGY, f"waypoints of {strategy.name}", len(waypoints), "two or more for mode 'plan'")
    offsets = np.array([np.asarray(w.offset, dtype=float) for w in waypoints])
    if offsets.shape != (len(waypoints), 3) or not np.all(np.isfinite(offsets)):
        raise MagicError(Code.BAD_STRATEGY, f"offsets of the waypoints of {strategy.name}", offsets.tolist(), "three finite metres each")
    poses = waypoint_poses(waypoints, pairs)
    times, contacts = [np.zeros(1)], [poses[:1]]
    pieces: list[tuple[str, float]] = []
    now = 0.0
    for i in range(1, len(waypoints)):
        speed = float(waypoints[i].speed)
        if not (np.isfinite(speed) and speed > 0):
            raise MagicError(
                Code.BAD_STRATEGY, f"speed of waypoint {waypoints[i].name} of {strategy.name}", speed, "a number of m/s above 0"
            )
        seconds, share = straight_line(_way(poses[i - 1], poses[i]), speed)
        times.append(now + seconds)
        contacts.append(_between(poses[i - 1], poses[i], share))
        now += float(seconds[-1])
        pieces.append((waypoints[i].phase, now))
    if strategy.releases and waypoints[-1].phase != "release":
        now += DWELL
        times.append(np.array([now]))
        contacts.append(poses[-1:])
        pieces.append(("release", now))
    return np.concatenate(times), np.concatenate(contacts), join_phases(pieces)


def _way(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """How long the way between two poses (4, 4) is, m: of the contact, or of what is TURNING_ARM away from it if that turns farther."""
    moved = float(np.linalg.norm(b[:3, 3] - a[:3, 3]))
    return moved if np.array_equal(a[:3, :3], b[:3, :3]) else max(moved, TURNING_ARM * float(turning(a, b[None])[0]))


def _between(a: NDArray[np.float64], b: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (n, 4, 4) at shares (n,) of the way from one pose (4, 4) to another: along a line, turning evenly."""
    if np.array_equal(a[:3, :3], b[:3, :3]):
        poses = np.tile(a, (len(share), 1, 1))
    else:
        poses = transforms.interpolate(np.array([0.0, 1.0]), np.stack([a, b]), share)
    poses[:, :3, 3] = a[:3, 3] + share[:, None] * (b[:3, 3] - a[:3, 3])
    return poses


def straight_line(length: float, speed: float, acceleration: float = ACCELERATION) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (n,) and shares (n,) of a rest-to-rest line, its start left out: trapezoidal speed, steps of STEP_LENGTH at most.

    A line of no length is a rest of DWELL seconds.
    """
    if length < 1e-9:
        return np.array([DWELL]), np.ones(1)
    ramp = min(speed / acceleration, np.sqrt(length / acceleration))
    top = ramp * acceleration
    cruise = max(0.0, (length - top * ramp) / top)
    knots = np.concatenate(
        [
            np.linspace(0, ramp, max(4, int(np.ceil(0.5 * top * ramp / STEP_LENGTH * 2))) + 1),
            np.linspace(ramp, ramp + cruise, int(np.ceil(top * cruise / STEP_LENGTH)) + 1) if cruise > 1e-9 else [],
            np.linspace(ramp + cruise, 2 * ramp + cruise, max(4, int(np.ceil(0.5 * top * ramp / STEP_LENGTH * 2))) + 1),
        ]
    )
    times = knots[np.concatenate([[True], np.diff(knots) > 1e-9])][1:]
    total = 2 * ramp + cruise
    left = total - times
    travelled = np.where(
        times <= ramp,
        0.5 * acceleration * times**2,
        np.where(left <= ramp, length - 0.5 * acceleration * left**2, 0.5 * top * ramp + top * (times - ramp)),
    )
    share = np.clip(travelled / length, 0.0, 1.0)
    share[-1] = 1.0
    return times, share


def demonstrated_motion(strategy: Strategy) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[Phase, ...]]:
    """times (T,), C(t) (T, 4, 4) and phases of a ``retarget`` strategy: the demonstration, its own samples kept and refined.

    The phases come from the strategy's waypoints: each ends when the demonstrated contact
    passes nearest to its offset.  Without waypoints: ``approach`` until the contact points
    first meet (3 mm), then ``goal``.
    """
    times = np.asarray(strategy.times, dtype=float)
    demonstrated = np.asarray(strategy.target_from_tool, dtype=float)
    if len(times) < 2 or demonstrated.shape != (len(times), 4, 4):
        raise MagicError(
            Code.BAD_STRATEGY,
            f"trajectory of {strategy.name}",
            f"{len(times)} times, poses {demonstrated.shape}",
            "two or more timed poses",
        )
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(demonstrated)) and np.all(np.diff(times) > 0)):
        raise MagicError(
            Code.BAD_STRATEGY, f"trajectory of {strategy.name}", "NaN, or times that do not increase", "finite poses at increasing times"
        )
    target_from_contact = _reference(strategy.target_contact, f"target contact of {strategy.name}")
    tool_from_contact = _reference(strategy.tool_contact, f"tool contact of {strategy.name}")
    at = refined_times(times, demonstrated)
    contacts = transforms.inverse(target_from_contact) @ transforms.interpolate(times, demonstrated, at) @ tool_from_contact
    at = at - at[0]
    points = contacts[:, :3, 3]
    pieces: list[tuple[str, float]] = []
    if strategy.waypoints:
        first = 0
        for waypoint in strategy.waypoints:
            first += int(np.argmin(np.linalg.norm(points[first:] - np.asarray(waypoint.offset, dtype=float), axis=1)))
            if first > 0:
                pieces.append((waypoint.phase, float(at[first])))
        if not pieces or pieces[-1][1] < at[-1]:
            pieces.append((strategy.waypoints[-1].phase, float(at[-1])))
    else:
        met = np.flatnonzero(np.linalg.norm(points, axis=1) <= 0.003)
        if len(met) and 0 < met[0] < len(at) - 1:
            pieces.append(("approach", float(at[met[0]])))
        pieces.append(("goal", float(at[-1])))
    if strategy.releases and pieces[-1][0] != "release":
        at = np.append(at, at[-1] + DWELL)
        contacts = np.concatenate([contacts, contacts[-1:]])
        pieces.append(("release", float(at[-1])))
    return at, contacts, join_phases(pieces)


def refined_times(times: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The given times (T,) and as many between them as keep each step of poses (T, 4, 4) within :data:`STEP_LENGTH` and
    :data:`STEP_ANGLE`."""
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = turning(poses[:-1], poses[1:])
    parts = np.maximum(1, np.ceil(np.maximum(moved / STEP_LENGTH, turned / STEP_ANGLE) - 1e-9)).astype(int)
    inner = [np.linspace(a, b, n + 1)[1:] for a, b, n in zip(times[:-1], times[1:], parts, strict=True)]
    return np.concatenate([times[:1], *inner])


def turning(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (N,) in radians between the rotations of transforms (N, 4, 4) or (4, 4) and (N, 4, 4)."""
    relative = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    skew = np.stack(
        [relative[..., 2, 1] - relative[..., 1, 2], relative[..., 0, 2] - relative[..., 2, 0], relative[..., 1, 0] - relative[..., 0, 1]],
        axis=-1,
    )
    return np.arctan2(np.linalg.norm(skew, axis=-1), np.trace(relative, axis1=-2, axis2=-1) - 1)


def waypoint_times(strategy: Strategy, pairs: Pairs = MappingProxyType({})) -> tuple[tuple[str, float], ...]:
    """Names of the places the tool's motion passes and when, in seconds from its start, in order of time.

    A ``plan`` strategy: its waypoints, at each of which the tool is at rest.  A ``retarget`` strategy:
    the start, then the end of each phase.
    """
    if strategy.mode != "plan":
        return (("start", 0.0), *((f"end of {p.name}", p.end) for p in demonstrated_motion(strategy)[2]))
    waypoints = list(strategy.waypoints)
    marks, now = [(waypoints[0].name, 0.0)], 0.0
    if strategy.releases:
        waypoints = waypoints[: next((i for i, w in enumerate(waypoints) if w.phase == "release"), len(waypoints)) + 1]
    for (_, before), (waypoint, pose) in itertools.pairwise(zip(waypoints, waypoint_poses(waypoints, pairs), strict=True)):
        now += float(straight_line(_way(before, pose), waypoint.speed)[0][-1])
        marks.append((waypoint.name, now))
    return tuple(marks)


def join_phases(ends: Sequence[tuple[str, float]]) -> tuple[Phase, ...]:
    """Phases from (name, end in seconds) in order of time; neighbours of one name become one."""
    phases: list[Phase] = []
    start = 0.0
    for name, end in ends:
        if end <= start:
            continue
        if phases and phases[-1].name == name:
            phases[-1] = Phase(name, phases[-1].start, end)
        else:
            phases.append(Phase(name, start, end))
        start = end
    return tuple(phases)


def lift_above(
    plane: NDArray[np.float64], world_from_tool: NDArray[np.float64], points: NDArray[np.float64], clearance: float = TABLE_CLEARANCE
) -> float:
    """Least rise along world up, metres, that keeps points (N, 3) of the tool frame above the plane at all poses (T, 4, 4)."""
    return max(0.0, (clearance - float(lowest(plane, world_from_tool, points).min())) / float(plane[2]))


def table_plane(table: NDArray[np.float64] | Sequence[float]) -> NDArray[np.float64]:
    """(4,) coefficients with a unit normal that points up; BAD_MOTION for a plane that is not finite or stands on edge."""
    plane = np.asarray(table, dtype=float).reshape(-1)
    if plane.shape != (4,) or not np.all(np.isfinite(plane)):
        raise MagicError(Code.BAD_MOTION, "table plane", plane.tolist(), "four finite coefficients a, b, c, d")
    norm = float(np.linalg.norm(plane[:3]))
    if norm < 1e-9 or abs(plane[2]) < 0.5 * norm:
        raise MagicError(Code.BAD_MOTION, "table plane", plane.tolist(), "a normal within 60 degrees of world up")
    plane = plane / norm
    return plane if plane[2] > 0 else -plane


def _rigid(transform: NDArray[np.float64], what: str) -> NDArray[np.float64]:
    transform = np.asarray(transform, dtype=float)
    if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
        raise MagicError(Code.BAD_MOTION, what, "NaN, infinite or misshapen", "a finite 4x4 transform")
    rotation = transform[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise MagicError(Code.BAD_MOTION, what, rotation.round(4).tolist(), "a right-handed rotation (determinant 1)")
    return transform


def _reference(contact: Contact, what: str) -> NDArray[np.float64]:
    try:
        return _rigid(contact.object_from_contact, what)
    except MagicError as error:
        raise MagicError(Code.BAD_STRATEGY, what, error.message) from error
