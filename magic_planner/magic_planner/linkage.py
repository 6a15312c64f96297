"""Linkage grippers reduced to their opening: two sliding fingers in the place of bars and knuckles.

Planner and simulation know grippers with two sliding fingers.  A parallel gripper driven by a linkage (one joint that drives, others that
``<mimic>`` it) keeps its fingertips parallel: what matters to a grasp is how far they are apart.  The reduction keeps the fingertips with
their shapes, lets them slide, and fixes what else moves as it stands when the gripper is open.
"""

from __future__ import annotations

import copy
import itertools
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.robot import Description, Joint
from magic_core.robot_pictures import shape_mesh

#: Positions of the driving joint that are looked at.
STEPS = 61
#: Links that reach as deep as the deepest, m; how much of a fingertip, from its end, is its pad, m.
DEEP, PAD = 0.005, 0.015
#: By how much fingertips may turn over their way, rad.
PARALLEL = math.radians(3.0)
#: Names of the sliding joints.
NAMES = ("left_finger_slide", "right_finger_slide")


class Ungripped(Description):
    """An arm whose gripper may be of any kind."""

    def _fingers(self) -> tuple[Joint, ...]:
        return ()

    def gripper_joints(self) -> tuple[Joint, ...]:
        """The moving joints beyond the arm's last one."""
        hand = set(self.beyond(self.arm[-1].child))
        return tuple(joint for joint in self.joints.values() if joint.moves and joint.parent in hand)

    def vertices(self, link: str) -> NDArray[np.float64]:
        """Corners (N, 3) of a link's collision shapes, in its own frame; raises BAD_REQUEST for a mesh that is missing."""
        found = []
        for shape in self.shapes(link):
            if shape.kind == "mesh" and shape.file is None:
                raise MagicError(
                    Code.BAD_REQUEST, f"collision mesh of {link} in {self.urdf}", "not found", "--package-root: what package:// stands for"
                )
            found.append(shape_mesh(shape).vertices)
        return np.concatenate(found) if found else np.empty((0, 3))

    @property
    def document(self) -> ET.Element:
        """The URDF."""
        return self.root

    def mesh_path(self, name: str) -> str:
        """The absolute path of a mesh that the URDF names, as it is where there is no such file."""
        path = self.mesh_file(name)
        return name if path is None else path.resolve().as_uri()

    def above(self, link: str) -> Joint | None:
        """The joint that a link hangs on."""
        return self._above.get(link)


@dataclass(frozen=True)
class Jaws:
    """How a linkage opens: positions (N,) of the driving joint (rad), widths (N,) between the fingertips and depths (N,) of the
    deepest point along z of the tip, metres; axis x or y of the tip; sliders: the joints that carry the left (+) and right (-) tip."""

    driver: str
    axis: str
    positions: NDArray[np.float64]
    widths: NDArray[np.float64]
    depths: NDArray[np.float64]
    sliders: tuple[Joint, Joint]

    @property
    def opened(self) -> int:
        """Where in the table the gripper is widest open."""
        return int(np.argmax(self.widths))

    @property
    def closed(self) -> int:
        """Where it is closed: the fingertips meet, or come as near as they can."""
        return int(np.argmin(np.where(self.widths < -1e-9, np.inf, self.widths)))

    @property
    def opening(self) -> float:
        """Metres between the open fingertips."""
        return float(self.widths[self.opened])

    @property
    def least(self) -> float:
        """Metres between the closed fingertips."""
        return max(float(self.widths[self.closed]), 0.0)

    @property
    def reaches_on(self) -> float:
        """By how much farther the fingertips reach closed than open, metres."""
        return float(self.depths[self.closed] - self.depths[self.opened])


def slides(robot: Ungripped) -> bool:
    """Whether the gripper has two sliding fingers as it is."""
    joints = robot.gripper_joints()
    return len(joints) == 2 and all(joint.sliding for joint in joints)


def followers(robot: Ungripped) -> tuple[Joint, dict[str, tuple[float, float]]]:
    """The joint that drives, and for every joint of the gripper factor and offset (rad); raises BAD_REQUEST where several drive."""
    joints = {joint.name: joint for joint in robot.gripper_joints()}
    told: dict[str, tuple[str, float, float]] = {}
    for element in robot.document.findall("joint"):
        mimic = element.find("mimic")
        if mimic is not None and element.get("name") in joints:
            told[element.get("name", "")] = (mimic.get("joint", ""), float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0)))
    drivers = [name for name in joints if name not in told]
    if len(drivers) != 1:
        raise MagicError(
            Code.BAD_REQUEST, f"driving joints of the gripper in {robot.urdf}", drivers or "none",
            "one, which the others <mimic>: add the tags that the real linkage enforces",
        )  # fmt: skip
    result = {drivers[0]: (1.0, 0.0)}
    for name in told:
        factor, offset, at = 1.0, 0.0, name
        for _ in range(len(told) + 1):
            if at == drivers[0]:
                break
            if at not in told:
                raise MagicError(Code.BAD_REQUEST, f"joint that {name} mimics", at, f"a joint of the gripper: {sorted(joints)}")
            above, by, plus = told[at]
            factor, offset, at = factor * by, offset + factor * plus, above
        result[name] = (factor, offset)
    return joints[drivers[0]], result


def _positions(factors: dict[str, tuple[float, float]], value: float) -> dict[str, float]:
    return {name: factor * value + offset for name, (factor, offset) in factors.items()}


def measure(robot: Ungripped) -> Jaws:
    """How a linkage opens; raises BAD_REQUEST where it is no parallel gripper."""
    driver, factors = followers(robot)
    low, high = (driver.lower, driver.upper) if driver.upper > driver.lower else (0.0, 0.0)
    if not high > low:
        raise MagicError(Code.BAD_REQUEST, f"limits of {driver.name}", [driver.lower, driver.upper], "lower below upper")
    values = np.linspace(low, high, STEPS)
    moved = sorted({link for joint in robot.gripper_joints() for link in robot.beyond(joint.child)})
    shapes = {link: vertices for link in moved if len(vertices := robot.vertices(link))}
    poses = [_from_tip(robot, _positions(factors, v)) for v in values]
    middle = {link: transforms.apply(poses[STEPS // 2][link], v) for link, v in shapes.items()}
    if not middle:
        raise MagicError(
            Code.BAD_REQUEST, f"gripper of {robot.urdf}", "no collision shapes on what moves", "fingertips with collision geometry"
        )
    deepest = max(v[:, 2].max() for v in middle.values())
    tips = [link for link, v in middle.items() if v[:, 2].max() > deepest - DEEP]
    first, last = ({link: transforms.apply(p[link], shapes[link]).mean(axis=0) for link in tips} for p in (poses[0], poses[-1]))
    way = np.sum([np.abs(last[link] - first[link]) for link in tips], axis=0)
    axis = int(np.argmax(way[:2]))
    sides = [[link for link in tips if sign * middle[link][:, axis].mean() > 1e-3] for sign in (1, -1)]
    if not all(sides):
        raise MagicError(Code.BAD_REQUEST, f"fingertips of {robot.urdf}", tips, "one on each side of the tip link's z axis (--tip)")
    pads = [max(side, key=lambda link: middle[link][:, 2].max()) for side in sides]
    sliders = tuple(_slider(robot, link) for link in pads)
    if sliders[0].name == sliders[1].name:
        raise MagicError(Code.BAD_REQUEST, f"joint of both fingertips in {robot.urdf}", sliders[0].name, "one of its own for each")
    for joint in sliders:
        turn = max(transforms.rotation_angle(poses[0][joint.child], p[joint.child]) for p in poses)
        if turn > PARALLEL:
            raise MagicError(
                Code.BAD_REQUEST, f"turn of the fingertip {joint.child} from open to closed, degrees", round(math.degrees(turn), 1),
                f"at most {math.degrees(PARALLEL):g}: a parallel gripper",
            )  # fmt: skip

    def at(value: float) -> tuple[float, float]:
        pose = _from_tip(robot, _positions(factors, value))
        left, right = (_pad(transforms.apply(pose[link], shapes[link])) for link in pads)
        return float(left[:, axis].min() - right[:, axis].max()), float(max(left[:, 2].max(), right[:, 2].max()))

    table = [(float(value), *at(value)) for value in values]
    meeting = next(((a, b) for a, b in itertools.pairwise(table) if (a[1] > 0) != (b[1] > 0)), None)
    if meeting is not None:  # where they meet lies between two steps
        inner, outer = sorted(meeting, key=lambda row: row[1])
        for _ in range(40):
            half = (inner[0] + outer[0]) / 2
            row = (half, *at(half))
            inner, outer = (row, outer) if row[1] < 0 else (inner, row)
        table = sorted([*table, outer])
    columns = np.array(table).T
    jaws = Jaws(driver.name, "xy"[axis], columns[0], columns[1], columns[2], (sliders[0], sliders[1]))
    if jaws.opening - jaws.least < 0.005:
        raise MagicError(Code.BAD_REQUEST, "way of the fingertips, m", round(jaws.opening - jaws.least, 4), "at least 0.005")
    return jaws


def _from_tip(robot: Ungripped, positions: dict[str, float]) -> dict[str, NDArray[np.float64]]:
    poses = robot.poses(positions)
    tip = transforms.inverse(poses[robot.config.move_group])
    return {link: tip @ pose for link, pose in poses.items()}


def _pad(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    return vertices[vertices[:, 2] > vertices[:, 2].max() - PAD]


def _slider(robot: Ungripped, link: str) -> Joint:
    """The moving joint that a fingertip hangs on."""
    joint = robot.above(link)
    while joint is not None and not joint.moves:
        joint = robot.above(joint.parent)
    assert joint is not None
    return joint


def reduced(robot: Ungripped, jaws: Jaws) -> ET.Element:
    """The URDF with two sliding fingers: closed at 0, open at half the way; meshes by their absolute paths.

    The fingertips slide at the depth that they have when closed, the largest: near a table no finger is deeper than planned.
    """
    _, factors = followers(robot)
    opened, closed = (_positions(factors, jaws.positions[n]) for n in (jaws.opened, jaws.closed))
    at_closed = robot.poses(closed)
    tip = at_closed[robot.config.move_group]
    gripper = {joint.name for joint in robot.gripper_joints()}
    way = (jaws.opening - jaws.least) / 2
    sliders = [joint.name for joint in jaws.sliders]
    tree = copy.deepcopy(robot.document)
    for element in tree.findall("joint"):
        name = element.get("name", "")
        if name not in gripper:
            continue
        for unused in [e for tag in ("mimic", "limit", "axis", "origin", "safety_controller", "dynamics") for e in element.findall(tag)]:
            element.remove(unused)
        joint = robot.joints[name]
        if name not in sliders:
            element.set("type", "fixed")
            _place(element, joint.parent_from_joint @ joint.motion(opened[name]))
            continue
        side = sliders.index(name)
        base = joint.parent
        while _under_gripper(robot, base, gripper):
            base = robot.above(base).parent  # type: ignore[union-attr]
        outward = (1 - 2 * side) * tip[:3, "xy".index(jaws.axis)]
        element.set("name", NAMES[side])
        element.set("type", "prismatic")
        element.find("parent").set("link", base)  # type: ignore[union-attr]
        _place(element, transforms.inverse(at_closed[base]) @ at_closed[joint.child])
        ET.SubElement(element, "axis", xyz=_text(at_closed[joint.child][:3, :3].T @ outward))
        ET.SubElement(element, "limit", lower="0", upper=f"{way:.6f}", velocity="0.1", effort="40")
    for unused in [e for e in tree if e.tag in ("transmission", "ros2_control", "gazebo")]:
        tree.remove(unused)
    for mesh in tree.iter("mesh"):
        mesh.set("filename", robot.mesh_path(mesh.get("filename", "")))
    return tree


def _under_gripper(robot: Ungripped, link: str, gripper: set[str]) -> bool:
    """Whether a joint of the gripper is on the way from a link to the root."""
    joint = robot.above(link)
    while joint is not None:
        if joint.name in gripper:
            return True
        joint = robot.above(joint.parent)
    return False


def _place(element: ET.Element, pose: NDArray[np.float64]) -> None:
    ET.SubElement(element, "origin", xyz=_text(pose[:3, 3]), rpy=_text(Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")))


def _text(values: NDArray[np.float64]) -> str:
    return " ".join(f"{v:.9g}" for v in values)
