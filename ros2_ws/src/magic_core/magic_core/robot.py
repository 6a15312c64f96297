"""Which arm and which gripper: what planner and verifier read off the same URDF and SRDF.

:class:`RobotConfig` is what a user sets (parameters ``robot.*`` of both nodes);
:class:`Description` is what follows from it: the joints of the arm, the two
fingers, the links that stand still, the shapes.  Neither a collision library nor a
physics engine is needed for that.
"""

from __future__ import annotations

import copy
import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.joint_limits import PUBLISHED, Braking, JointLimits

#: Franka's ready pose.
PANDA_HOME = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
#: A URDF has none of these.
PANDA_ACCELERATION, PANDA_JERK = PUBLISHED["panda"].acceleration, PUBLISHED["panda"].jerk
#: Kinds of joints that move.
TURNING, SLIDING = ("revolute", "continuous"), "prismatic"
#: How far the fingers' way may deviate from the closing axis: cosine of about 8 degrees.
ALONG = 0.99
#: How far beyond a joint's end a ready pose may be, for numbers that were rounded, rad (m).
SLACK = 1e-3


@dataclass(frozen=True)
class RobotConfig:
    """Which arm and gripper, and how fast.

    Attributes
    ----------
    urdf, srdf : files; empty: the Panda of the package ``example-robot-data``.
    package_root : what ``package://`` in the URDF stands for; empty: the folder above the URDF in which a mesh is found, else the share
        folder of the ROS package.
    move_group : the link between the fingertips, z out of the hand.
    closing_axis : along which axis of that link the fingers close.
    opening : m between the open fingers.
    home : (J,) joint positions.
    acceleration, jerk : limits in rad/s^2 and rad/s^3, one for each joint or one for all.
    velocity_scale, acceleration_scale, jerk_scale : share of the limits that is used.
    base_frame : the name that objects, trajectories and TF have for the frame of the URDF's root link; empty: that link's own name.
    preset : whose published limits hold besides the URDF's (:mod:`magic_core.joint_limits`); empty: the Panda's where there is no URDF
        either, else nobody's.
    """

    urdf: str = ""
    srdf: str = ""
    package_root: str = ""
    move_group: str = "panda_hand_tcp"
    closing_axis: str = "y"
    opening: float = 0.08
    home: tuple[float, ...] = PANDA_HOME
    acceleration: tuple[float, ...] = PANDA_ACCELERATION
    jerk: tuple[float, ...] = PANDA_JERK
    velocity_scale: float = 0.3
    acceleration_scale: float = 0.2
    jerk_scale: float = 0.03
    base_frame: str = ""
    preset: str = ""

    def __post_init__(self) -> None:
        if self.closing_axis not in ("x", "y"):
            raise MagicError(Code.BAD_REQUEST, "closing axis", self.closing_axis, ("x", "y"))
        if not 0.005 <= self.opening <= 1.0:
            raise MagicError(Code.BAD_REQUEST, "gripper opening", self.opening, "0.005 to 1 m")
        if self.preset and self.preset not in PUBLISHED:
            raise MagicError(Code.BAD_REQUEST, "robot.preset", self.preset, (*PUBLISHED, "empty"))
        for name in ("velocity_scale", "acceleration_scale", "jerk_scale"):
            if not 0 < getattr(self, name) <= 1:
                raise MagicError(Code.BAD_REQUEST, name, getattr(self, name), "above 0, up to 1")


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF: parent_from_joint (4, 4), unit axis (3,), limits in rad or m, effort in Nm or N, velocity in rad/s or
    m/s (infinite where the URDF gives none)."""

    name: str
    kind: str
    parent: str
    child: str
    parent_from_joint: NDArray[np.float64]
    axis: NDArray[np.float64]
    lower: float
    upper: float
    effort: float
    velocity: float = math.inf

    @property
    def moves(self) -> bool:
        """Whether it is anything but fixed."""
        return self.kind in TURNING or self.sliding

    @property
    def sliding(self) -> bool:
        """Whether it moves along its axis (m, N) rather than about it (rad, Nm)."""
        return self.kind == SLIDING

    def motion(self, position: float) -> NDArray[np.float64]:
        """What the joint does at a position: (4, 4)."""
        return transforms.make(translation=position * self.axis) if self.sliding else transforms.from_rotvec(position * self.axis)


@dataclass(frozen=True)
class Shape:
    """One visual or collision shape: link_from_shape (4, 4); kind ``box``, ``sphere``, ``cylinder``, ``capsule`` or ``mesh``;
    size: edges, radius, or radius and length in metres, or the scales of a mesh; file of a mesh, None where it is not found;
    color RGB 0 to 255 where the URDF gives one."""

    link_from_shape: NDArray[np.float64]
    kind: str
    size: tuple[float, ...]
    file: Path | None = None
    color: tuple[int, int, int] | None = None


def panda_folder() -> Path:
    """The Panda's description in the package ``example-robot-data``, wherever it is installed."""
    try:
        for file in metadata.files("example-robot-data") or ():
            if file.name == "panda.urdf":
                return Path(str(file.locate())).resolve().parents[1]
    except metadata.PackageNotFoundError:
        pass
    raise MagicError(
        Code.BAD_REQUEST, "URDF of the Panda", "not found", "the Python package example-robot-data, or parameters urdf and srdf"
    )


class Description:
    """An arm with a parallel gripper as its URDF and SRDF give it; raises BAD_REQUEST with what is wrong with them.

    Attributes
    ----------
    root : the URDF's own element.
    base, base_frame : the root link, and what its frame is called outside the URDF: the frame of everything that is planned and verified.
    arm : the moving joints from the root to the move group, in order, their ranges no wider than half a turn either side of home: a turn
        more is the same to the hand, and takes a planner round in circles.
    fingers : two sliding joints beyond the last of these.
    closed, opened : (2,) m, their positions.
    moving : names of the joints of arm and fingers; others (a head, a second arm) are held at zero.
    finger_links, foot : what moves with the fingers; what never moves.
    masses : of each link that has one, kg, and its centre (3,), m in the link's frame.
    disabled : pairs of links that may touch.
    """

    def __init__(self, config: RobotConfig | None = None) -> None:
        self.config = config = config or RobotConfig()
        self.urdf, self.srdf = Path(config.urdf), Path(config.srdf)
        if not config.urdf:
            folder = panda_folder()
            self.urdf, self.srdf = folder / "urdf" / "panda.urdf", folder / "srdf" / "panda.srdf"
        for path, what in ((self.urdf, "URDF"), (self.srdf, "SRDF")):
            if not path.is_file():
                raise MagicError(Code.BAD_REQUEST, what, str(path), "an existing file")
        self.root = _parsed(self.urdf, "URDF")
        self._read_tree()
        self.base_frame = config.base_frame.lstrip("/") or self.base
        if self.base_frame != self.base and self.base_frame in self._links:
            raise MagicError(
                Code.BAD_REQUEST,
                "robot.base_frame",
                self.base_frame,
                f"the URDF's root link {self.base}, or another name for the same frame; this is another link of {self.urdf}",
            )
        self._read_arm()
        self._read_gripper()
        self.moving = frozenset((*self.names, *(joint.name for joint in self.fingers)))
        self.foot = frozenset(self.beyond(self.base, self.moving))
        self.disabled = frozenset(
            frozenset((pair.get("link1", ""), pair.get("link2", ""))) for pair in _parsed(self.srdf, "SRDF").findall("disable_collisions")
        )
        for joint in self.arm:
            if not joint.effort > 0:
                raise MagicError(
                    Code.BAD_REQUEST, f"effort limit of {joint.name} in {self.urdf}", joint.effort, "above 0 (Nm; N if it slides)"
                )

    def _read_tree(self) -> None:
        """Links, joints and masses of the URDF, which have to be one tree."""
        try:
            self.joints = {joint.name: joint for joint in map(_joint, self.root.findall("joint"))}
        except (ValueError, TypeError, AttributeError) as error:
            raise MagicError(Code.BAD_REQUEST, f"joints of {self.urdf}", str(error), "joints with parent, child and numbers") from error
        self._links = {link.get("name", ""): link for link in self.root.findall("link")}
        try:
            self.masses = {name: found for name, link in self._links.items() if (found := _mass(link)) is not None}
        except ValueError as error:
            raise MagicError(Code.BAD_REQUEST, f"masses of {self.urdf}", str(error), "numbers") from error
        self._above = {joint.child: joint for joint in self.joints.values()}
        for joint in self.joints.values():
            for link in {joint.parent, joint.child} - set(self._links):
                raise MagicError(Code.BAD_REQUEST, f"link of {joint.name} in {self.urdf}", link, list(self._links))
        self._below: dict[str, list[Joint]] = {link: [] for link in self._links}
        for joint in self.joints.values():
            self._below[joint.parent].append(joint)
        roots = [link for link in self._links if link not in self._above]
        self.base = roots[0] if roots else ""
        if len(roots) != 1 or len(self._above) != len(self.joints) or len(self.beyond(self.base)) != len(self._links):
            raise MagicError(Code.BAD_REQUEST, f"links of {self.urdf}", f"roots {roots}", "one tree with one root")

    def _read_arm(self) -> None:
        """The arm's joints, within the published limits and half a turn either side of home."""
        home = self.config.home
        self.arm = self._chain()
        self.published = self._published()
        if len(home) != len(self.arm):
            raise MagicError(Code.BAD_REQUEST, "home configuration", list(home), f"{len(self.arm)} joint positions")
        if self.published is not None:
            self.arm = tuple(_narrowed(joint, self.published, index) for index, joint in enumerate(self.arm))
        self._check_home()
        self.arm = tuple(_within_a_turn(joint, float(position)) for joint, position in zip(self.arm, home, strict=True))

    def _check_home(self) -> None:
        """The ready pose is within the joints' limits: one in degrees is not."""
        for joint, position in zip(self.arm, self.config.home, strict=True):
            low, high = (-math.inf, math.inf) if joint.kind == "continuous" else (joint.lower, joint.upper)
            if not (math.isfinite(position) and low - SLACK <= position <= high + SLACK):
                unit = "m" if joint.sliding else "rad"
                raise MagicError(Code.BAD_REQUEST, f"home position of {joint.name} in {unit}", position, f"{low:.4g} to {high:.4g}")

    def _read_gripper(self) -> None:
        """The two fingers, and where they are closed and open."""
        self.fingers = self._fingers()
        # Grippers count from closed: the limit further from zero is where they are open.
        far = [abs(joint.upper) >= abs(joint.lower) for joint in self.fingers]
        self.closed = np.array([joint.lower if up else joint.upper for joint, up in zip(self.fingers, far, strict=True)])
        self.opened = np.array([joint.upper if up else joint.lower for joint, up in zip(self.fingers, far, strict=True)])
        self.finger_links = frozenset(link for joint in self.fingers for link in self.beyond(joint.child))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arm's joints."""
        return tuple(joint.name for joint in self.arm)

    @property
    def links(self) -> tuple[str, ...]:
        """Names of all links."""
        return tuple(self._links)

    # ------------------------------------------------------------ the tree

    def _chain(self) -> tuple[Joint, ...]:
        link, chain = self.config.move_group, []
        if link not in self._links:
            raise MagicError(Code.BAD_REQUEST, "tip link (move_group)", link, list(self._links))
        while link in self._above:
            joint = self._above[link]
            chain.insert(0, joint)
            link = joint.parent
        moving = tuple(joint for joint in chain if joint.moves)
        if not moving:
            raise MagicError(Code.BAD_REQUEST, "tip link (move_group)", self.config.move_group, "a link that at least one joint moves")
        return moving

    def beyond(self, link: str, until: Collection[str] = ()) -> list[str]:
        """A link and those beyond it, nearer ones first, but not those beyond the joints ``until``."""
        found = [link]
        for name in found:
            found += [joint.child for joint in self._below[name] if joint.name not in until]
        return found

    def _fingers(self) -> tuple[Joint, ...]:
        hand = self.beyond(self.arm[-1].child, {joint.name for joint in self.joints.values() if joint.moves})
        fingers = tuple(joint for joint in self.joints.values() if joint.moves and joint.parent in hand)
        if len(fingers) != 2 or not all(joint.sliding for joint in fingers):
            raise MagicError(
                Code.BAD_REQUEST,
                f"gripper of {self.urdf}",
                ", ".join(f"{joint.name} ({joint.kind})" for joint in fingers) or "no joints",
                "two prismatic joints on the links that the arm's last joint moves",
            )
        poses = self.poses({})
        tip_from_world = transforms.inverse(poses[self.config.move_group])
        for joint in fingers:
            direction = (tip_from_world @ poses[joint.parent] @ joint.parent_from_joint)[:3, :3] @ joint.axis
            if abs(direction["xy".index(self.config.closing_axis)]) < ALONG:
                raise MagicError(
                    Code.BAD_REQUEST,
                    f"closing axis {self.config.closing_axis} of {self.config.move_group}: {joint.name} slides along",
                    direction.round(3).tolist(),
                    "the axis along which the fingers close, x or y",
                )
            if not joint.upper > joint.lower:
                raise MagicError(Code.BAD_REQUEST, f"limits of {joint.name}", [joint.lower, joint.upper], "lower below upper")
        return fingers

    def poses(self, positions: Mapping[str, float]) -> dict[str, NDArray[np.float64]]:
        """base_from_link (4, 4) of each link for joint positions by name; joints not named are at zero."""
        poses = {self.base: np.eye(4)}
        for link in self.beyond(self.base):
            for joint in self._below[link]:
                poses[joint.child] = poses[link] @ joint.parent_from_joint @ joint.motion(float(positions.get(joint.name, 0.0)))
        return poses

    def forward(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """base_from_tip (N, 4, 4), the tip being the move group, for positions (N, J) of the arm's joints."""
        positions = np.atleast_2d(np.asarray(positions, dtype=float))
        column = {name: index for index, name in enumerate(self.names)}
        chain, link = [], self.config.move_group
        while link in self._above:
            chain.insert(0, self._above[link])
            link = self._above[link].parent
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        for joint in chain:
            poses = poses @ joint.parent_from_joint
            if joint.name not in column:
                poses = poses @ joint.motion(0.0) if joint.moves else poses
                continue
            moved = np.tile(np.eye(4), (len(positions), 1, 1))
            at = positions[:, column[joint.name]]
            if joint.sliding:
                moved[:, :3, 3] = at[:, None] * joint.axis
            else:
                moved[:, :3, :3] = Rotation.from_rotvec(at[:, None] * joint.axis).as_matrix()
            poses = poses @ moved
        return poses

    def _published(self) -> JointLimits | None:
        """What the arm's maker publishes, where it is known which that is."""
        name = self.config.preset or ("" if self.config.urdf else "panda")
        if not name:
            return None
        if len(PUBLISHED[name].lower) != len(self.arm):
            raise MagicError(
                Code.BAD_REQUEST, f"joints of {self.urdf}", len(self.arm), f"{len(PUBLISHED[name].lower)}, as the robot.preset {name} has"
            )
        return PUBLISHED[name]

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(J,): limits of the joints' velocities in rad/s (m/s)."""
        return np.array([joint.velocity for joint in self.arm])

    @property
    def acceleration(self) -> NDArray[np.float64]:
        """(J,): limits of the joints' accelerations in rad/s^2 (m/s^2); raises BAD_REQUEST where there are more or fewer than joints.

        A URDF has none: where nothing was set for an arm of another number of joints than the Panda's, the least of the Panda's.
        """
        return self._limits("acceleration", PANDA_ACCELERATION)

    @property
    def jerk(self) -> NDArray[np.float64]:
        """(J,): limits of the joints' jerks in rad/s^3 (m/s^3), as :attr:`acceleration`."""
        return self._limits("jerk", PANDA_JERK)

    def _limits(self, name: str, default: tuple[float, ...]) -> NDArray[np.float64]:
        given = getattr(self.config, name)
        found = np.asarray([min(default)] if given == default and len(self.arm) != len(default) else given, dtype=float)
        if found.size not in (1, len(self.arm)) or not np.all(found > 0):
            raise MagicError(Code.BAD_REQUEST, f"{name} limits", found.tolist(), f"1 or {len(self.arm)} numbers above 0")
        return np.broadcast_to(found, (len(self.arm),)).copy()

    @property
    def braking(self) -> Braking | None:
        """How much slower the arm's joints have to be near the ends of their ranges, where its maker says so."""
        return self.published.braking if self.published is not None else None

    def finger_positions(self, width: float) -> NDArray[np.float64]:
        """(2,): where the fingers are when they are ``width`` metres apart, as far as they can be."""
        way = float(np.abs(self.opened - self.closed).sum())
        share = np.clip(1 - (self.config.opening - width) / way, 0.0, 1.0)
        return self.closed + share * (self.opened - self.closed)

    def arm_positions(self, joints: NDArray[np.float64]) -> dict[str, float]:
        """Positions by name out of (J + 2,): the arm's joints in rad (m), then the fingers in m."""
        return dict(zip((*self.names, *(j.name for j in self.fingers)), np.asarray(joints, dtype=float).tolist(), strict=True))

    # ------------------------------------------------------------ shapes and masses

    def shapes(self, link: str, what: str = "collision") -> list[Shape]:
        """The ``collision`` or ``visual`` shapes of a link."""
        colors = {m.get("name", ""): m.find("color") for m in self.root.findall("material")}
        return [shape for element in self._links[link].findall(what) if (shape := self._shape(element, colors)) is not None]

    def _shape(self, element: ET.Element, colors: Mapping[str, ET.Element | None]) -> Shape | None:
        geometry = element.find("geometry")
        if geometry is None or len(geometry) == 0:
            return None
        body, at, material = geometry[0], _origin(element.find("origin")), element.find("material")
        color = None
        if material is not None:
            found = material.find("color")
            found = found if found is not None else colors.get(material.get("name", ""))
            if found is not None:
                red, green, blue = (int(255 * v) for v in numbers(found.get("rgba"), "0.7 0.7 0.7 1")[:3].clip(0, 1))
                color = (red, green, blue)
        sizes = {
            "box": lambda: numbers(body.get("size"), ""),
            "sphere": lambda: numbers(body.get("radius"), ""),
            "cylinder": lambda: np.concatenate([numbers(body.get("radius"), ""), numbers(body.get("length"), "")]),
            "mesh": lambda: numbers(body.get("scale"), "1 1 1"),
        }
        sizes["capsule"] = sizes["cylinder"]
        if body.tag not in sizes:
            return None
        size = tuple(float(v) for v in sizes[body.tag]())
        return Shape(at, body.tag, size, self.mesh_file(body.get("filename", "")) if body.tag == "mesh" else None, color)

    def mesh_file(self, name: str) -> Path | None:
        """Where a mesh that the URDF names lies; None where it is not found."""
        if not name.startswith("package://"):
            path = self.urdf.resolve().parent / name.removeprefix("file://")
            return path if path.is_file() else None
        rest = name.removeprefix("package://")
        root = self.config.package_root
        for folder in (Path(root).resolve(),) if root else self.urdf.resolve().parents:
            if (folder / rest).is_file():
                return folder / rest
        try:
            from ament_index_python.packages import get_package_share_directory

            package, _, inside = rest.partition("/")
            path = Path(get_package_share_directory(package)) / inside
        except (ImportError, LookupError, ValueError):
            return None
        return path if path.is_file() else None

    @property
    def bodies(self) -> tuple[frozenset[str], ...]:
        """The links sorted into what moves as one."""
        return (self.foot, *(frozenset(self.beyond(joint.child, self.moving)) for joint in (*self.arm, *self.fingers)))

    def tree(self, folder: Path | None = None) -> ET.Element:
        """The URDF as a collision library or a physics engine needs it.

        Links with their collision shapes and inertia, and joints; meshes by their absolute paths, or relative to ``folder``; the
        fingers' coupling and what is neither link nor joint left out; joints beside arm and fingers fixed.  Raises BAD_REQUEST
        for a mesh that is missing.
        """
        limited = {joint.name: joint for joint in self.arm if joint is not self.joints[joint.name]}
        tree = ET.Element("robot", {"name": self.root.get("name", "robot")})
        for element in copy.deepcopy([*self.root.findall("link"), *self.root.findall("joint")]):
            for unused in [*element.findall("visual"), *element.findall("mimic")]:
                element.remove(unused)
            if element.tag == "joint" and element.get("name") not in self.moving:
                element.set("type", "fixed")
            elif element.tag == "joint" and element.get("name") in limited:
                joint = limited[element.get("name", "")]
                limit = element.find("limit")
                limit = limit if limit is not None else ET.SubElement(element, "limit")
                limit.attrib.update(lower=repr(joint.lower), upper=repr(joint.upper))
                if math.isfinite(joint.velocity):
                    limit.set("velocity", repr(joint.velocity))
                element.set("type", joint.kind)
            for mesh in element.iterfind("collision/geometry/mesh"):
                path = self.mesh_file(mesh.get("filename", ""))
                if path is None:
                    raise MagicError(
                        Code.BAD_REQUEST,
                        f"mesh of {self.urdf}",
                        mesh.get("filename"),
                        "an existing file; parameter package_root: the folder that package:// stands for",
                    )
                mesh.set("filename", str(path) if folder is None else os.path.relpath(path, folder.resolve()))
            tree.append(element)
        return tree


def _parsed(path: Path, what: str) -> ET.Element:
    try:
        return ET.fromstring(path.read_text())
    except (OSError, ET.ParseError, ValueError) as error:
        raise MagicError(Code.BAD_REQUEST, f"{what} {path}", f"{type(error).__name__}: {error}", f"a readable {what}") from error


def numbers(text: str | None, default: str) -> NDArray[np.float64]:
    """The numbers (N,) of an attribute or a text; those of ``default`` where there is none."""
    return np.array([float(x) for x in (text or default).split()])


def _origin(element: ET.Element | None) -> NDArray[np.float64]:
    if element is None:
        return np.eye(4)
    return transforms.from_rpy(*numbers(element.get("rpy"), "0 0 0"), translation=numbers(element.get("xyz"), "0 0 0"))


def _mass(link: ET.Element) -> tuple[float, NDArray[np.float64]] | None:
    """Mass, kg, and its centre (3,), m, of a link; ``None`` where it has none."""
    inertial = link.find("inertial")
    mass = None if inertial is None else inertial.find("mass")
    if inertial is None or mass is None:
        return None
    return float(mass.get("value", "0")), _origin(inertial.find("origin"))[:3, 3]


def _narrowed(joint: Joint, published: JointLimits, index: int) -> Joint:
    """A joint of the arm within its own limits and the published ones."""
    lower, upper = published.lower[index], published.upper[index]
    if joint.kind != "continuous":
        lower, upper = max(lower, joint.lower), min(upper, joint.upper)
    velocity = min(joint.velocity, published.velocity[index])
    if (lower, upper, velocity) == (joint.lower, joint.upper, joint.velocity):
        return joint
    return replace(joint, kind="revolute", lower=lower, upper=upper, velocity=velocity)


def _within_a_turn(joint: Joint, home: float) -> Joint:
    """A turning joint of the arm with at most half a turn either side of home; others as they are."""
    if joint.sliding or (joint.kind == "revolute" and joint.upper - joint.lower <= 2 * math.pi):
        return joint
    low, high = (joint.lower, joint.upper) if joint.kind == "revolute" else (-math.inf, math.inf)
    return replace(joint, kind="revolute", lower=max(low, home - math.pi), upper=min(high, home + math.pi))


def _joint(element: ET.Element) -> Joint:
    limit, axis = element.find("limit"), element.find("axis")

    def bound(key: str) -> float:
        return float(limit.get(key, 0)) if limit is not None else 0.0

    kind = element.get("type", "fixed")
    # Generators write the axis "0 0 0" for joints that have none.
    direction = numbers(axis.get("xyz"), "1 0 0") if axis is not None and kind != "fixed" else np.array([1.0, 0.0, 0.0])
    return Joint(
        element.get("name", ""),
        kind,
        element.find("parent").get("link", ""),  # type: ignore[union-attr]
        element.find("child").get("link", ""),  # type: ignore[union-attr]
        _origin(element.find("origin")),
        transforms.unit(direction),
        bound("lower"),
        bound("upper"),
        bound("effort"),
        bound("velocity") or math.inf,
    )
