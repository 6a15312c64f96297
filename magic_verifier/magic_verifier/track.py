"""Whether what a tracker recorded can be the motion of a tool in a hand, and whether it is that of the tool which the cameras see.

A tracker that loses its marker says so in many ways: with the identity, with the last pose over and over, with nothing for a while,
with a pose somewhere else.  Learned from, each would be a motion that nobody made.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.camera import RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh

Array = NDArray[np.float64]
#: A tracker may be silent for so long (s); what the tool does meanwhile is taken to be on a straight line.
GAP = 0.25
#: How far a quaternion's length may be from 1.
LENGTH = 0.01
#: What a hand does not do: m/s and rad/s.
SPEED, TURN_RATE = 2.5, 12.0
#: ... and m/s^2 and rad/s^2, but for stops and starts within a sample: m/s and rad/s.
ACCELERATION, TURN_ACCELERATION = 6.0, 40.0
STOP, TURN_STOP = 0.6, 4.0
#: What is no jump, whatever the rate: m, rad.
FLOOR, TURN_FLOOR = 0.003, np.deg2rad(1.0)
#: A tracker's noise (standard deviation, m) from which on it never gives the same pose twice.
NOISY = 2e-5
#: The tool lies still while the pictures are taken that it is found in: m, rad.
STILL = (0.005, np.deg2rad(2.0))
#: How deep (m) the tool may be in the table: what perception and tracker may be off together.
UNDER = 0.02
#: Points of the tool's surface that are looked for in a picture, and how many of them have to be in it to tell anything.
POINTS, FEWEST = 400, 40
#: Depth behind a point by more than this (m, and share of its distance), so far (m) around it, means that the camera looks through
#: where it should be.
BEHIND, BEHIND_SHARE, AROUND = 0.01, 0.01, 0.012
#: Of the points so much may be seen through, and of the pictures in so many they may be.
THROUGH, PICTURES = 0.5, 0.25


@dataclass(frozen=True)
class Track:
    """What one source told, in the order in which it was recorded: stamps (N,) seconds, positions (N, 3) metres, quaternions (N, 4)
    xyzw as they came; what: its name for messages."""

    what: str
    stamps: Array
    positions: Array
    quaternions: Array


def check_raw(track: Track, tracker: bool = True) -> None:
    """Refuse stamps and poses that no tracker may give; raises BAD_MOTION with time, value and what is allowed.

    tracker: the poses are measured, so that an identity means that there was nothing to measure (a joint may well stand at zero).
    """
    if not len(track.stamps):
        raise MagicError(Code.BAD_MOTION, f"poses of {track.what}", 0, "two or more")
    since = track.stamps - track.stamps[0]

    def refuse(index: int, what: str, value: object, allowed: str) -> None:
        raise MagicError(Code.BAD_MOTION, f"{what} of {track.what}, {since[index]:.2f} s after its first pose", value, allowed)

    steps = np.diff(track.stamps)
    if (steps < 0).any():
        k = int(np.argmax(steps < 0))
        refuse(k, "stamp that goes back", f"by {-steps[k]:.3f} s", "stamps that increase from pose to pose")
    if (steps == 0).any():
        k = int(np.argmax(steps == 0))
        refuse(k, "stamp given twice", round(float(since[k]), 3), "one pose at a time: is there a second publisher?")
    unusable = ~(np.isfinite(track.positions).all(axis=1) & np.isfinite(track.quaternions).all(axis=1))
    if unusable.any():
        k = int(np.argmax(unusable))
        refuse(k, "pose", f"position {track.positions[k].tolist()}, orientation {track.quaternions[k].tolist()}", "finite numbers, not NaN")
    lengths = np.linalg.norm(track.quaternions, axis=1)
    if (np.abs(lengths - 1) > LENGTH).any():
        k = int(np.argmax(np.abs(lengths - 1) > LENGTH))
        refuse(k, "length of the orientation's quaternion", round(float(lengths[k]), 4), f"1 within {LENGTH:g}")
    identity = (np.abs(track.positions).max(axis=1) < 1e-6) & (np.abs(np.abs(track.quaternions[:, 3]) - 1) < 1e-6)
    if tracker and identity.any():
        k = int(np.argmax(identity))
        share = f"{int(identity.sum())} of {len(identity)} poses are the identity"
        refuse(k, "pose", share, "measured poses; the identity is what a tracker gives that sees nothing")


def check_motion(what: str, times: Array, poses: Array) -> None:
    """Refuse a track, times (T,) seconds and poses (T, 4, 4), that has gaps, jumps or stands still where a tool in a hand does not.

    Raises BAD_MOTION with time, value and what is allowed.
    """
    since = times - times[0]
    check_gaps(what, since)
    steps = np.diff(times)
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    turns = _turns(rotations)
    turned = np.linalg.norm(turns, axis=1)
    if not ((moved > 1e-6) | (turned > 1e-5)).any():
        raise MagicError(Code.BAD_MOTION, what, f"the same pose {len(times)} times", "a tool in use: it never moves")
    noise, turn_noise = _noise(poses[:, :3, 3]), _noise(np.cumsum(turns, axis=0))
    _refuse_jumps(what, since, steps, moved, _mismatch(poses[:, :3, 3], steps), noise, (SPEED, ACCELERATION, STOP, FLOOR), 1000.0, "mm")
    _refuse_jumps(
        what,
        since,
        steps,
        turned,
        _turn_mismatch(rotations, turns, steps),
        turn_noise,
        (TURN_RATE, TURN_ACCELERATION, TURN_STOP, TURN_FLOOR),
        float(np.rad2deg(1)),
        "degrees",
    )
    _refuse_frozen(what, since, moved, turned, noise)


def check_gaps(what: str, since: Array) -> None:
    """Refuse a track, times (T,) seconds from its begin, that is silent for too long; raises BAD_MOTION."""
    if len(since) < 2:
        raise MagicError(Code.BAD_MOTION, f"poses of {what}", len(since), "two or more at different times")
    steps = np.diff(since)
    k = int(np.argmax(steps))
    if steps[k] > GAP:
        raise MagicError(
            Code.BAD_MOTION, f"gap in {what} from {since[k]:.2f} to {since[k + 1]:.2f} s", f"{steps[k]:.2f} s", f"at most {GAP:g} s"
        )


def _turns(rotations: Rotation) -> Array:
    """Rotation vectors (T - 1, 3) from each rotation to the next."""
    return (rotations[:-1].inv() * rotations[1:]).as_rotvec()


def _noise(values: Array) -> float:
    """Standard deviation of the noise on values (N, 3), per axis: of a smooth motion the fourth differences are next to nothing."""
    if len(values) < 8:
        return 0.0
    fourth = np.diff(values, n=4, axis=0)
    return float(1.48 * np.median(np.abs(fourth)) / np.sqrt(70.0))


def _mismatch(points: Array, steps: Array) -> Array:
    """Half way between samples k and k + 1 (T - 3,): how far the line through the two before ends from that through the two after."""
    slope = np.diff(points, axis=0) / steps[:, None]
    half = steps[1:-1, None] / 2
    before, after = points[1:-2] + slope[:-2] * half, points[2:-1] - slope[2:] * half
    return np.linalg.norm(before - after, axis=1)


def _turn_mismatch(rotations: Rotation, turns: Array, steps: Array) -> Array:
    """As :func:`_mismatch`, of rotations, rad."""
    half = steps[1:-1] / 2
    before = rotations[1:-2] * Rotation.from_rotvec(turns[:-2] * (half / steps[:-2])[:, None])
    after = rotations[2:-1] * Rotation.from_rotvec(-turns[2:] * (half / steps[2:])[:, None])
    return (before.inv() * after).magnitude()


def _refuse_jumps(
    what: str,
    since: Array,
    steps: Array,
    moved: Array,
    mismatch: Array,
    noise: float,
    limits: tuple[float, float, float, float],
    scale: float,
    unit: str,
) -> None:
    """Raise where a step (T - 1,) is faster than a hand, or does not go on from the motion before to the motion after (T - 3,)."""
    speed, acceleration, stop, floor = limits
    allowed = speed * steps + 8 * noise + floor
    if (moved > allowed).any():
        k = int(np.argmax(moved - allowed))
        raise MagicError(
            Code.BAD_MOTION,
            f"jump in {what} at {since[k + 1]:.2f} s",
            f"{scale * moved[k]:.0f} {unit} within {1000 * steps[k]:.0f} ms",
            f"at most {scale * allowed[k]:.0f} {unit}: a hand is slower",
        )
    # Two samples to each side make the noise of one 2.2 times as large; 12: five standard deviations of it.
    between, before, after = steps[1:-1], steps[:-2], steps[2:]
    reach = np.maximum(np.maximum(before, between), after)
    uneven = between / np.minimum(before, after)
    allowed = acceleration * reach**2 + stop * reach / 2 + 12 * noise * np.maximum(uneven, 1.0) + floor
    if (mismatch > allowed).any():
        k = int(np.argmax(mismatch - allowed))
        raise MagicError(
            Code.BAD_MOTION,
            f"jump in {what} at {since[k + 2]:.2f} s",
            f"{scale * mismatch[k]:.0f} {unit} from where the motion before and after it leads",
            f"at most {scale * allowed[k]:.0f} {unit} at this rate",
        )


def _refuse_frozen(what: str, since: Array, moved: Array, turned: Array, noise: float) -> None:
    """Raise where a tracker repeats one pose although it is noisy, or although the tool has gone on meanwhile."""
    same = (moved < 1e-9) & (turned < 1e-7)
    edges = np.diff(np.concatenate([[0], same.astype(int), [0]]))
    for first, last in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
        length = float(since[last] - since[first])
        if length <= GAP:
            continue
        caught_up = last + 1 < len(moved) and moved[last] > 2 * moved[last + 1] + FLOOR and first > 0 and moved[first - 1] > FLOOR / 2
        if noise > NOISY or caught_up:
            raise MagicError(
                Code.BAD_MOTION,
                f"the same pose of {what} from {since[first]:.2f} to {since[last]:.2f} s",
                f"{length:.2f} s",
                f"at most {GAP:g} s: the tracker has stopped looking",
            )


def check_still(what: str, times: Array, poses: Array, first: float, last: float) -> None:
    """Refuse a track that moves from ``first`` to ``last`` seconds, while the pictures are taken; raises BAD_MOTION."""
    inside = (times > first) & (times < last)
    at = np.concatenate([[first], times[inside], [max(first, last)]])
    seen = transforms.interpolate(times, poses, at)
    moved = float(np.linalg.norm(seen[:, :3, 3] - seen[0, :3, 3], axis=1).max())
    turned = max(transforms.rotation_angle(seen[0], pose) for pose in seen)
    turn_noise = _noise(np.cumsum(_turns(Rotation.from_matrix(poses[:, :3, :3])), axis=0))
    if moved > STILL[0] + 5 * _noise(poses[:, :3, 3]) or turned > STILL[1] + 5 * turn_noise:
        raise MagicError(
            Code.BAD_MOTION,
            f"motion of {what} while the first pictures are taken, within {last - first:.2f} s",
            f"{1000 * moved:.0f} mm, {np.rad2deg(turned):.0f} degrees",
            f"at most {1000 * STILL[0]:g} mm and {np.rad2deg(STILL[1]):.0f} degrees: start the recording before the tool is taken up",
        )


def check_above(what: str, mesh: Mesh, times: Array, world_from_tool: Array, table: Array) -> None:
    """Refuse a track, times (T,) and poses (T, 4, 4) of the tool, that leads it under the table (4,); raises BAD_MOTION."""
    corners = mesh.vertices @ np.swapaxes(world_from_tool[:, :3, :3], 1, 2) + world_from_tool[:, None, :3, 3]
    depth = -(corners @ table[:3] + table[3]).min(axis=1)
    k = int(np.argmax(depth))
    if depth[k] > UNDER:
        raise MagicError(
            Code.BAD_MOTION,
            f"the tool led by {what} is under the table at {times[k] - times[0]:.2f} s",
            f"{1000 * depth[k]:.0f} mm deep",
            f"at most {1000 * UNDER:g} mm: track a body fixed to the tool, in the world of the cameras",
        )


def seen_through(mesh: Mesh, world_from_tool: Array, frame: RgbdFrame, seed: int = 0) -> tuple[float, int]:
    """Share of the tool's near side, where the track says it is, that a camera looks through to what is behind, and of how many points.

    What hides the tool (a hand) is nearer than it and says nothing; where there is no depth, nothing is said either.
    """
    camera_from_tool = transforms.inverse(frame.world_from_camera) @ world_from_tool
    corners = transforms.apply(camera_from_tool, mesh.vertices)[mesh.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    near = np.einsum("ni,ni->n", outward, corners[:, 0]) < 0
    corners, areas = corners[near], np.linalg.norm(outward[near], axis=1)
    if not areas.sum() > 0:
        return 0.0, 0
    rng = np.random.default_rng(seed)
    chosen = corners[rng.choice(len(areas), POINTS, p=areas / areas.sum())]
    points = np.einsum("ni,nij->nj", rng.dirichlet(np.ones(3), POINTS), chosen)
    points = points[points[:, 2] > 0.05]
    height, width = frame.depth.shape
    pixels = np.round(frame.intrinsics.project(points)).astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    points, pixels = points[inside], pixels[inside]
    if not len(points):
        return 0.0, 0
    depth = np.where(np.isfinite(frame.depth) & (frame.depth > 0), frame.depth, np.inf).astype(np.float32)
    reach = int(np.ceil(AROUND * frame.intrinsics.fx / float(np.median(points[:, 2]))))
    nearest = cv2.erode(depth, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))[pixels[:, 1], pixels[:, 0]]
    known = np.isfinite(depth[pixels[:, 1], pixels[:, 0]])
    through = nearest[known] > points[known, 2] * (1 + BEHIND_SHARE) + BEHIND
    return (float(through.mean()) if known.any() else 0.0), int(known.sum())


def check_seen(what: str, mesh: Mesh, times: Array, world_from_tool: Array, frames: list[RgbdFrame]) -> int:
    """Refuse a track, times (T,) and poses (T, 4, 4) of the tool, that leads it to where the cameras see through it: it is not fixed to the
    tool, or not in this world.

    Pictures in which the tool moves fast are left out, stamps and exposure differ too much there.  Raises BAD_MOTION; returns the
    number of pictures that told anything.
    """
    told: list[tuple[float, float, str]] = []
    for frame in frames:
        if not times[0] <= frame.stamp <= times[-1]:
            continue
        before, pose, after = transforms.interpolate(times, world_from_tool, frame.stamp + np.array([-0.05, 0.0, 0.05]))
        middle = mesh.vertices.mean(axis=0)
        if np.linalg.norm(transforms.apply(after, middle) - transforms.apply(before, middle)) > 0.02:
            continue
        share, count = seen_through(mesh, pose, frame)
        if count >= FEWEST:
            told.append((share, frame.stamp, frame.camera))
    wrong = [entry for entry in told if entry[0] > THROUGH]
    if len(wrong) > PICTURES * len(told):
        share, stamp, camera = wrong[0]
        raise MagicError(
            Code.BAD_MOTION,
            f"{what} is not where the tool is: the tool's surface that camera {camera} looks through at {stamp - times[0]:.2f} s",
            f"{100 * share:.0f} %; so in {len(wrong)} of {len(told)} pictures",
            f"at most {100 * THROUGH:.0f} %: track a body fixed to the tool, in the frame and by the clock of the cameras",
        )
    return len(told)
