"""How much of what arm and grip can bear a plan leaves over, by analysis, before anything is simulated.

Each margin is 1 less the share that is used where it is used most: 1 nothing, 0 all of it, below 0 more than there is.

==============  ==========================================================================================================
``grip``        what two soft pads hold by friction (:func:`magic_planner.grasps.pad_share`) against the tool's weight, its
                acceleration and the contact's force
``torque``      effort limits of the joints against gravity and acceleration of links and tool, and the contact's force; links
                are taken as point masses at their centres
``joint limit`` half a joint's range against how far it is from the middle of it
``singularity`` the smallest singular value of the Jacobian (angles counted at 0.3 m) in shares of that at home
==============  ==========================================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.motion import Margin, Phase
from magic_core.scene import SceneObject
from magic_planner.collision import mass_centre, solid_pieces
from magic_planner.grasps import GraspSettings, Patches, pad_share
from magic_planner.kinematics import GRAVITY, Chain
from magic_planner.robot import Robot

Array = NDArray[np.float64]
#: The length (m) at which a turn counts as much as a shift: a hand-sized tool's.
LEVER = 0.3


def margins(
    robot: Robot,
    grasping: GraspSettings,
    tool: SceneObject,
    tool_from_tcp: Array,
    tool_from_contact: Array,
    times: Array,
    q: Array,
    held: tuple[float, float],
    phases: Sequence[Phase],
) -> tuple[Margin, ...]:
    """The margins of a timed joint motion: times (N,), q (N, J), the tool in the hand from ``held[0]`` to ``held[1]`` s.

    ``grasping.force`` (N) acts on the contact during the phases contact and goal.
    """
    chain = robot.chain
    frames, tip = chain.frames(q)
    carried = (times >= held[0]) & (times <= held[1])
    pushed = np.zeros(len(times), dtype=bool)
    for phase in phases:
        if phase.name in ("contact", "goal"):
            pushed |= (times >= phase.start) & (times < phase.end)
    pieces = solid_pieces(tool)
    volume, centre = mass_centre(pieces)
    mass = volume * grasping.density
    tcp_from_tool = transforms.inverse(tool_from_tcp)
    world_from_tool = tip @ tcp_from_tool
    middle = world_from_tool[:, :3, :3] @ centre + world_from_tool[:, :3, 3]
    # Before it is held it lies still: how the empty hand comes to rest is no load.
    taken = int(np.searchsorted(times, held[0]))
    middle[:taken] = middle[min(taken, len(middle) - 1)]
    weight = mass * (GRAVITY - _acceleration(times, middle)) * carried[:, None]
    contact = world_from_tool[:, :3, :3] @ tool_from_contact[:3, 3] + world_from_tool[:, :3, 3]
    push = -grasping.force * world_from_tool[:, :3, :3] @ tool_from_contact[:3, 0] * (pushed & carried)[:, None]

    def margin(name: str, share: Array, what: str) -> Margin:
        worst = int(share.argmax())
        return Margin(name, 1 - float(share[worst]), float(times[worst]), _phase(phases, float(times[worst])), what)

    found = []
    share = _pad_shares(robot, grasping, tool, tool_from_tcp[None], tool_from_contact, world_from_tool, weight, push)
    if np.isfinite(share[0, 0]):
        found.append(margin("grip", share[0], f"of what pads pressed with {grasping.grip_force:g} N hold of {1000 * mass:.0f} g"))
    torque = np.abs(_torques(chain, frames, times, [(weight, middle), (push, contact)])) / chain.effort
    joint = int(torque.max(axis=0).argmax())
    limit = f"{chain.effort[joint]:g} {'N' if chain.prismatic[joint] else 'N m'}"
    found.append(margin("torque", torque.max(axis=1), f"of the {limit} of {chain.names[joint]}"))
    half = (chain.upper - chain.lower) / 2
    off = np.abs(q - (chain.upper + chain.lower) / 2) / half
    joint = int(off.max(axis=0).argmax())
    found.append(margin("joint limit", off.max(axis=1), f"of the way to the limit of {chain.names[joint]}"))
    least = _least_singular(chain, frames, tip)
    home = float(_least_singular(chain, *chain.frames(robot.home[None]))[0])
    found.append(margin("singularity", 1 - np.minimum(least / home, 1.0), "of the mobility at home is lost"))
    return tuple(found)


def _pad_shares(
    robot: Robot,
    grasping: GraspSettings,
    tool: SceneObject,
    frames: Array,
    tool_from_contact: Array,
    world_from_tool: Array,
    weight: Array,
    push: Array,
) -> Array:
    """(G, K): :func:`magic_planner.grasps.pad_share` of grasps (G, 4, 4) tool_from_tcp under forces (K, 3) in the world on a tool at K
    poses, ``weight`` on its mass and ``push`` on the contact; NaN where a pad meets nothing."""
    pieces = solid_pieces(tool)
    centre = mass_centre(pieces)[1]
    turn = world_from_tool[:, :3, :3].transpose(0, 2, 1)
    weights, pushes = (np.einsum("nij,nj->ni", turn, force) for force in (weight, push))
    origin = frames[:, None, :3, 3]
    levers = np.cross(centre - origin, weights[None]) + np.cross(tool_from_contact[:3, 3] - origin, pushes[None])
    patches = Patches.of(robot, frames, pieces)
    share = pad_share(robot, frames, weights + pushes, levers, *patches.spans(), grasping.grip_force, grasping.friction)
    return np.where(patches.there[:, None], share, np.nan)


def grip_at_rest(
    robot: Robot, grasping: GraspSettings, tool: SceneObject, frames: Array, tool_from_contact: Array, poses: Array, pushed: Array
) -> Array:
    """(G,): the share of what the pads of grasps (G, 4, 4) tool_from_tcp hold that is used however slowly the tool goes.

    poses (K, 4, 4): world_from_tool along the motion; pushed (K,): whether ``grasping.force`` acts on the contact there.  0 where a pad
    meets nothing, of which :func:`margins` says nothing either.
    """
    weight = np.tile(mass_centre(solid_pieces(tool))[0] * grasping.density * GRAVITY, (len(poses), 1))
    push = -grasping.force * poses[:, :3, :3] @ tool_from_contact[:3, 0] * pushed[:, None]
    share = _pad_shares(robot, grasping, tool, frames, tool_from_contact, poses, weight, push).max(axis=1)
    return np.asarray(np.nan_to_num(share, nan=0.0))


def _phase(phases: Sequence[Phase], time: float) -> str:
    return next((phase.name for phase in phases if phase.start <= time < phase.end), phases[-1].name if phases else "")


def _acceleration(times: Array, points: Array) -> Array:
    """Of points (N, ...) along a motion, m/s^2."""
    if len(times) < 3:
        return np.zeros_like(points)
    return np.asarray(np.gradient(np.gradient(points, times, axis=0), times, axis=0))


def _torques(chain: Chain, frames: Array, times: Array, loads: Sequence[tuple[Array, Array]]) -> Array:
    """(N, J): what the joints must bear of links that are accelerated, and of forces (N, 3) on the last link at points (N, 3)."""
    axes = np.einsum("njik,jk->nji", frames[:, :, :3, :3], chain.axes)
    every = [(chain.count - 1, force, point) for force, point in loads]
    for j, centre, mass in zip(chain.mass_joint, chain.mass_centre, chain.masses, strict=True):
        point = frames[:, j, :3, :3] @ centre + frames[:, j, :3, 3]
        every.append((int(j), mass * (GRAVITY - _acceleration(times, point)), point))
    torques = np.zeros((len(times), chain.count))
    for last, force, point in every:
        for j in range(last + 1):
            lever = force if chain.prismatic[j] else np.cross(point - frames[:, j, :3, 3], force)
            torques[:, j] -= np.einsum("ni,ni->n", axes[:, j], lever)
    return torques


def _least_singular(chain: Chain, frames: Array, tip: Array) -> Array:
    jacobian = chain.jacobian(frames, tip)
    jacobian[:, 3:] *= LEVER
    return np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, -1])
