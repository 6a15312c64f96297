"""An arm with a parallel gripper as an articulation of the physics engine: from URDF and SRDF to driven joints."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description, RobotConfig
from magic_core.robot_pictures import shape_mesh
from magic_verifier.grip import Grip, Patch
from magic_verifier.simulation import World, engine, from_pose, to_pose

ARM = "arm"
FINGERS = "fingers"
#: Force (N) that moves any tool of a kilogram over the table, so that fingers centre it before they press on it.
SOFTLY = 8.0
#: What of the arm never moves and may well stand on the table.
BASE = "base"
#: PhysX's filter has so many bits for sets of links that may touch each other, and one more: a hand and the tool that it holds.
GROUPS = 31
HELD = 1 << GROUPS
#: What a link of unknown size is taken for where its inertia is not given: edge of a cube in metres.
UNKNOWN_SIZE = 0.1


@dataclass(frozen=True)
class ArmOptions:
    """Controller and gripper.

    Attributes
    ----------
    stiffness, damping : Nm/rad and Nms/rad (N/m and Ns/m where a joint slides) of the arm's joint drives, one for each joint or one for
        all.  The defaults are those of Franka's joint impedance controller, near critical damping.
    armature : kg m^2 that the geared motors add to each joint's inertia.
    grip_force : N with which each finger presses on what it has closed on.
    finger_stiffness : N/m that couple the two fingers, as a belt does in the real hand.
    finger_armature : kg that its gears add to each of them.
    closing_speed : m/s of each free finger.
    finger_friction : of the pads.
    quiet, closing_time : s for which the fingers must stand still before they have closed on nothing, and s after which they have anyway.
    past : m; where it is given, not the belt but a drive for each finger closes the hand, sent so far past where the fingers meet while the
        arm goes on, and nothing but the engine's contacts holds the tool: what the hands of other simulators do, not real ones.
    command_period : s for which each command stays, 0 for every step of the simulation; by what it jumps the arm jerks.
    effort : Nm (N) that each drive of the arm gives at most; 0: the URDF's.
    """

    stiffness: tuple[float, ...] = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)
    damping: tuple[float, ...] = (120.0, 120.0, 100.0, 100.0, 60.0, 40.0, 30.0)
    armature: float = 0.1
    grip_force: float = 60.0
    finger_stiffness: float = 1e4
    finger_armature: float = 0.1
    closing_speed: float = 0.1
    finger_friction: float = 1.5
    quiet: float = 0.1
    closing_time: float = 1.5
    past: float | None = None
    command_period: float = 0.0
    effort: float = 0.0

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            values = tuple(float(v) for v in getattr(self, name))
            if not values or not all(np.isfinite(v) and v > 0 for v in values):
                raise MagicError(Code.BAD_REQUEST, f"arm {name}", values, "numbers above 0")
            object.__setattr__(self, name, values)

    @property
    def closing_force(self) -> float:
        """N with which each finger closes until both touch: a hand that is to grip does so slowly and softly, and then presses."""
        return min(self.grip_force, SOFTLY)

    def gains(self, robot: Description) -> list[tuple[float, float]]:
        """Stiffness and damping of each joint of the arm; raises BAD_REQUEST where there are more or fewer than joints."""
        count, found = len(robot.arm), []
        for name in ("stiffness", "damping"):
            values = getattr(self, name)
            if len(values) not in (1, count):
                raise MagicError(Code.BAD_REQUEST, f"arm {name}", values, f"1 number, or {count} for {', '.join(robot.names)}")
            found.append(values * count if len(values) == 1 else values)
        return list(zip(*found, strict=True))


@lru_cache(maxsize=4)
def described(config: RobotConfig) -> Description:
    """The arm of a configuration, read once by each process."""
    return Description(config)


def panda() -> Description:
    """The arm that is simulated where no other one is given."""
    return described(RobotConfig())


def prepare(robot: Description) -> None:
    """Read what the first run with an arm would otherwise wait for."""
    _prepared(robot)


class Articulation:
    """The arm in a world, its root fixed in the world's origin.  Contacts find its links as ``base``, ``arm`` and ``fingers``."""

    def __init__(self, world: World, robot: Description, options: ArmOptions) -> None:
        """Raises BAD_REQUEST for a description that the engine cannot load or gains that do not fit it."""
        self._options, self._robot = options, robot
        gains = options.gains(robot)
        self._world = world  # the engine's bodies live no longer than their world
        self.body = body = _load(world, robot)
        self._name_links(world, robot)
        active = [joint.name for joint in body.active_joints]
        self._size = len(active)
        self._arm = [active.index(name) for name in robot.names]
        self._fingers = [active.index(joint.name) for joint in robot.fingers]
        self._arm_joints = [body.find_joint_by_name(name) for name in robot.names]
        self._finger_joints = [body.find_joint_by_name(joint.name) for joint in robot.fingers]
        #: (J,): Nm, or N where a joint slides.
        self.effort = np.array([options.effort or joint.effort for joint in robot.arm])
        for joint, effort, (stiffness, damping) in zip(self._arm_joints, self.effort, gains, strict=True):
            joint.set_drive_properties(stiffness, damping, force_limit=float(effort), mode="force")
            joint.set_armature(np.array([options.armature], dtype=np.float32))
        for joint in self._finger_joints:
            joint.set_drive_properties(
                options.finger_stiffness,
                options.closing_force / options.closing_speed,
                force_limit=max(200.0, 3 * options.grip_force),
                mode="force",
            )
            joint.set_armature(np.array([options.finger_armature], dtype=np.float32))
        # Where, among three forces and three torques for each link, the engine reports what a joint of the arm transmits about its axis, or
        # along it where it slides: the axis is x of the engine's joint frames.
        links = [link.name for link in body.links]
        self._carried = np.array([6 * links.index(joint.child) + (0 if joint.sliding else 3) for joint in robot.arm])
        carrier, carrier_from_tcp = _prepared(robot).bare.get(robot.config.move_group, (robot.config.move_group, np.eye(4)))
        self._carrier, self._carrier_from_tcp = body.find_link_by_name(carrier), to_pose(carrier_from_tcp)
        self.hand = body.find_link_by_name(robot.fingers[0].parent)
        #: Of the hand, in which the tool is.
        self._gripper = [link for link in body.links if link.name in robot.finger_links] + [self.hand]
        self._targets = [joint.set_drive_target for joint in self._arm_joints]
        #: (J,): s, damping over stiffness.  A drive that leads its position by so much of a velocity gives the torque of one that is
        #: told the velocity as well, by half as many calls of the engine.
        self.lead = np.array([damping / stiffness for stiffness, damping in gains])
        self._finger_targets = [joint.set_drive_target for joint in self._finger_joints]
        strokes = np.abs(robot.opened - robot.closed)
        self._closed, self._opened = robot.closed.astype(np.float32), robot.opened.astype(np.float32)
        #: Of each finger: which way it opens, and its share of the way.
        self._outward = (np.sign(robot.opened - robot.closed) * strokes / strokes.mean()).astype(np.float32)
        #: Metres between the fingers when they are closed.
        self._rest = robot.config.opening - float(strokes.sum())

    def _name_links(self, world: World, robot: Description) -> None:
        for part in (BASE, ARM, FINGERS):
            if world.has(part):
                raise MagicError(Code.BAD_SCENE, "object id", part, f"ids other than {BASE}, {ARM} and {FINGERS}, which are the robot's")
        pads = world.material(self._options.finger_friction)
        for link in self.body.links:
            part = FINGERS if link.name in robot.finger_links else BASE if link.name in robot.foot else ARM
            world.name_component(link, part)
            for shape in link.collision_shapes if part == FINGERS else ():
                shape.physical_material = pads

    # ------------------------------------------------------------ state

    def place(self, q: NDArray[np.float64], width: float | None = None) -> None:
        """Put the arm at q (J,), at rest, the fingers open or ``width`` metres apart."""
        positions = np.zeros(self._size)
        positions[self._arm] = q
        positions[self._fingers] = self._opened if width is None else self._robot.finger_positions(width)
        self.body.set_qpos(positions)

    def set_speed(self, speed: NDArray[np.float64]) -> None:
        """Set the velocities of the arm's joints (J,), the fingers at rest."""
        velocities = np.zeros(self._size)
        velocities[self._arm] = speed
        self.body.set_qvel(velocities)

    def lags(self, command: list[float]) -> list[float]:
        """(J,): how far each of the arm's joints is from its command, rad or m."""
        found = self.body.qpos.tolist()
        return [abs(found[index] - position) for index, position in zip(self._arm, command, strict=True)]

    def joints(self) -> NDArray[np.float64]:
        """(J + 2,): the arm's joints in rad (m), then the fingers in m."""
        return np.asarray(self.body.qpos, dtype=float).ravel()[[*self._arm, *self._fingers]]

    def speeds(self) -> NDArray[np.float64]:
        """(J + 2,): velocities of the arm's joints in rad/s (m/s), then of the fingers in m/s."""
        return np.asarray(self.body.qvel, dtype=float).ravel()[[*self._arm, *self._fingers]]

    def _opened_by(self) -> NDArray[np.float32]:
        """(2,): how far each finger is from closed, divided by its share of the way, m."""
        return (np.asarray(self.body.qpos).ravel()[self._fingers] - self._closed) / self._outward

    def width(self) -> float:
        """Metres between the fingers."""
        return float(self._opened_by().sum()) + self._rest

    def tcp(self) -> NDArray[np.float64]:
        """world_from_tcp (4, 4)."""
        return from_pose(self.tcp_pose)

    @property
    def tcp_pose(self) -> Any:
        """The same as the engine's pose."""
        return self._carrier.entity_pose * self._carrier_from_tcp

    def transmitted(self) -> list[float]:
        """(J,): the torque about (the force along) the axis that each of the arm's joints carries, Nm (N)."""
        return self.body.get_link_incoming_joint_forces().take(self._carried).tolist()  # type: ignore[no-any-return]

    # ------------------------------------------------------------ drives

    def command(self, q: NDArray[np.float64], speed: NDArray[np.float64]) -> None:
        """Drive the arm to positions (J,) at velocities (J,)."""
        self.drive((q + self.lead * speed).tolist())

    def drive(self, targets: list[float]) -> None:
        """Set the drives of the arm to positions that lead by :attr:`lead` (J,), and feed gravity and Coriolis torques forward."""
        for target, position in zip(self._targets, targets, strict=True):
            target(position)
        # Gravity and Coriolis are what it gives unless told otherwise: to be told so takes it half as long again.
        self.body.set_qf(self.body.compute_passive_force())

    def open_fingers(self, width: float | None = None) -> None:
        """Drive the fingers to where they are open, or ``width`` metres apart."""
        wanted = self._opened if width is None else self._robot.finger_positions(width)
        for target, position in zip(self._finger_targets, wanted.tolist(), strict=True):
            target(position)

    def close_fingers(self, force: float = 0.0) -> None:
        """Drive both fingers to their mean less the way that gives the closing force, or ``force`` N where that is more.

        What moves them together is resisted by that force alone, what moves one against the other by the stiffness.  Fingers that are
        driven one by one go past where they would meet.
        """
        opened = self._opened_by()
        force = min(max(force, self._options.closing_force), self._options.grip_force)
        mean = 0.5 * float(opened[0] + opened[1]) - force / self._options.finger_stiffness
        mean = mean if self._options.past is None else -self._options.past
        for target, closed, outward in zip(self._finger_targets, self._closed.tolist(), self._outward.tolist(), strict=True):
            target(closed + outward * mean)

    def rest_fingers(self) -> None:
        """Drive the fingers to where they are."""
        for target, position in zip(self._finger_targets, self.joints()[-2:].tolist(), strict=True):
            target(position)

    def sleeps(self) -> bool:
        """Let the engine leave the arm where it is, until something hits it; whether it does."""
        speed = np.zeros(self._size, np.float32)
        self.body.set_qvel(speed)
        self.body.sleep_threshold = 1e6
        for link in self.body.links:
            link.put_to_sleep()
        return bool(self.body.links[-1].sleeping)

    # ------------------------------------------------------------ grip

    def grips(self, tool: Any, patch: Patch, friction: float, force: float | None = None) -> Grip:
        """Hold a tool (the engine's body) where it is between the pads, which leave it to the joint until :meth:`lets_go`.

        force: N of each finger; ``None``: that of the options.
        """
        hand_from_tcp = transforms.inverse(from_pose(self.hand.entity_pose)) @ self.tcp()
        self._ignore(tool, True)
        hand_from_patch = hand_from_tcp @ patch.tcp_from_patch
        force = self._options.grip_force if force is None else force
        return Grip(self.hand, hand_from_patch, tool, patch, force, friction, self._world.timestep)

    def lets_go(self, tool: Any) -> None:
        """Hand and tool collide again."""
        self._ignore(tool, False)

    def _ignore(self, tool: Any, ignored: bool) -> None:
        for body in (tool, *self._gripper):
            for shape in body.collision_shapes:
                first, second, together, group = shape.get_collision_groups()
                together = together | HELD if ignored else together & ~HELD
                shape.set_collision_groups([first, second, together, group])


def _load(world: World, robot: Description) -> Any:
    prepared = _prepared(robot)
    prepared.builder.set_scene(world.scene)
    try:
        body = prepared.builder.build()
    except Exception as error:  # the engine raises whatever a file brings up
        raise _unloadable(robot, error) from error
    finally:
        prepared.builder.set_scene(None)  # a world that has ended is not kept
    body.set_solver_position_iterations(world.settings.position_iterations)
    body.set_solver_velocity_iterations(world.settings.velocity_iterations)
    for link in body.links:
        # The engine leaves out, and only logs, what it can make no hull of.
        count = prepared.counts[link.name]
        if len(link.collision_shapes) != count:
            raise MagicError(
                Code.BAD_REQUEST,
                f"collision shapes of {link.name} in {robot.urdf} that could be loaded",
                len(link.collision_shapes),
                f"all {count}; meshes with a volume",
            )
        for shape in link.collision_shapes:
            shape.set_collision_groups([1, 1, prepared.groups.get(link.name, 0), 0])
    return body


def _unloadable(robot: Description, error: Exception) -> MagicError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return MagicError(Code.BAD_REQUEST, f"robot {robot.urdf}", reason, "a URDF that SAPIEN loads")


@dataclass(frozen=True)
class _Prepared:
    """The engine's builder of an arm; for each link the bits of its filter and how many collision shapes it has; of the links that were
    left out which one carries each, and where on it that is (4, 4)."""

    builder: Any
    groups: dict[str, int]
    counts: dict[str, int]
    bare: dict[str, tuple[str, NDArray[np.float64]]]


@lru_cache(maxsize=4)
def _prepared(robot: Description) -> _Prepared:
    """What is built of an arm, read once."""
    from sapien.wrapper.urdf_loader import URDFLoader

    tree = robot.tree()
    bare = _leave_out_bare(robot, tree)
    for link in tree.iterfind("link"):
        _complete_inertia(robot, link)
    sapien = engine()
    loader = URDFLoader()
    loader.set_scene(sapien.Scene([sapien.physx.PhysxCpuSystem()]))
    loader.fix_root_link = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(ET.tostring(tree, encoding="unicode"))
        try:
            builders, others, _ = loader.parse(str(path))
        except Exception as error:  # the loader raises whatever a file brings up
            raise _unloadable(robot, error) from error
    if len(builders) != 1 or others:
        raise MagicError(Code.BAD_REQUEST, f"robot {robot.urdf}", f"{len(builders) + len(others)} separate bodies", "one")
    return _Prepared(builders[0], collision_groups(robot), {link: len(robot.shapes(link)) for link in robot.links}, bare)


def _leave_out_bare(robot: Description, tree: ET.Element) -> dict[str, tuple[str, NDArray[np.float64]]]:
    """Take links out of a URDF that are no more than names of a place: fixed on another one, with neither mass nor shape.

    The engine solves each link in every part of every step, whether or not a joint moves it.  Those that a moving joint hangs on stay, for
    parent and child of a joint are never tested for contact, and so does what the fingers hang on.  Returns for each which link carries it,
    and where on it that is (4, 4).
    """
    poses, parents = robot.poses({}), {name: joint.parent for name, joint in robot.joints.items()}
    above = {joint.child: name for name, joint in robot.joints.items()}
    joints, links = ({element.get("name", ""): element for element in tree.iterfind(tag)} for tag in ("joint", "link"))
    bare: dict[str, tuple[str, NDArray[np.float64]]] = {}
    for link in robot.beyond(robot.base)[1:]:  # nearer ones first
        below = [name for name, parent in parents.items() if parent == link]
        moves = any(joints[name].get("type") != "fixed" for name in (above[link], *below))
        if moves or robot.masses.get(link, (0.0,))[0] > 0 or robot.shapes(link):
            continue
        carrier = parents[above[link]]
        bare[link] = carrier, transforms.inverse(poses[carrier]) @ poses[link]
        for name in below:
            parents[name] = carrier
            _hang(joints[name], carrier, bare[link][1] @ robot.joints[name].parent_from_joint)
        del parents[above[link]]
        tree.remove(joints[above[link]])
        tree.remove(links[link])
    return bare


def _hang(joint: ET.Element, parent: str, parent_from_joint: NDArray[np.float64]) -> None:
    """Hang a joint of a URDF on another link."""
    for element in [*joint.iterfind("parent"), *joint.iterfind("origin")]:
        joint.remove(element)
    xyz, rpy = parent_from_joint[:3, 3], Rotation.from_matrix(parent_from_joint[:3, :3]).as_euler("xyz")
    ET.SubElement(joint, "parent", {"link": parent})
    ET.SubElement(joint, "origin", {name: " ".join(map(repr, values.tolist())) for name, values in (("xyz", xyz), ("rpy", rpy))})


def _complete_inertia(robot: Description, link: ET.Element) -> None:
    """Give a link numbers that the engine can work with.

    A link without a mass gets that of its collision shapes filled with water, which is what the engine does with a mass of 0; a
    mass without a positive inertia gets that of a box as large as its shapes.
    """
    inertial = link.find("inertial")
    if inertial is None:
        inertial = ET.SubElement(link, "inertial")
    mass_element, inertia_element = inertial.find("mass"), inertial.find("inertia")
    mass = float(mass_element.get("value", 0)) if mass_element is not None else 0.0
    given = inertia_element.attrib if inertia_element is not None else {}
    xx, yy, zz, xy, xz, yz = (float(given.get(key, 0)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    if mass > 0 and np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0] > 0:
        return
    for element in (mass_element, inertia_element):
        if element is not None:
            inertial.remove(element)
    moments = np.zeros(3)
    if mass > 0:
        corners = [shape_mesh(shape).bounds for shape in robot.shapes(link.get("name", ""))]
        size = np.ptp(np.concatenate(corners), axis=0) if corners else np.full(3, UNKNOWN_SIZE)
        moments = mass * ((size**2).sum() - size**2) / 12
    ET.SubElement(inertial, "mass", {"value": str(max(mass, 0.0))})
    values = dict(zip(("ixx", "iyy", "izz"), map(str, moments.tolist()), strict=True))
    ET.SubElement(inertial, "inertia", {**values, "ixy": "0", "ixz": "0", "iyz": "0"})


def collision_groups(robot: Description) -> dict[str, int]:
    """Bits for each link, such that two links share one exactly where they may touch: by the SRDF, or because they move as one.

    Each bit stands for a set of links any two of which may touch; sets are grown greedily until every pair is in one.  Parent and
    child of a joint are never tested by the engine and need none.  Raises BAD_REQUEST where the engine's bits do not suffice.
    """
    shaped = [link for link in robot.links if robot.shapes(link)]
    together = {pair for body in robot.bodies for pair in map(frozenset, combinations(sorted(body), 2))} | robot.disabled
    untested = {frozenset((joint.parent, joint.child)) for joint in robot.joints.values()}
    wanted = [pair for pair in map(frozenset, combinations(shaped, 2)) if pair in together and pair not in untested]
    together |= untested
    groups = dict.fromkeys(shaped, 0)
    open_pairs, bit = set(wanted), 0
    for pair in wanted:
        if pair not in open_pairs:
            continue
        members = sorted(pair)
        for link in shaped:
            if link not in members and all(frozenset((link, other)) in together for other in members):
                members.append(link)
        if bit == GROUPS:
            raise MagicError(Code.BAD_REQUEST, f"disable_collisions of {robot.srdf}", f"more than {GROUPS} sets of links", "fewer")
        for link in members:
            groups[link] |= 1 << bit
        open_pairs -= set(map(frozenset, combinations(members, 2)))
        bit += 1
    return groups
