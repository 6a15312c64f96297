"""An arm's files for this software, from its URDF or xacro: ``ros2 run magic_planner describe_robot --help``.

    ros2 run magic_planner describe_robot arm.urdf --tip tool_link --home 0 -1 1 0 1 0 --out DIR

writes ``robot.param.yaml`` for the launch file, ``robot.srdf`` with the pairs of links that need not be checked against each other, found
by sampling, and ``robot.urdf`` where the given file cannot be used as it is: a xacro, or a linkage gripper, which is reduced to its
opening. Exit status 0; 1 with one line that says what is wrong with the description.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magic_core.errors import Code, MagicError
from magic_core.robot import Description, RobotConfig
from magic_planner import linkage
from magic_planner.linkage import Jaws, Ungripped

#: Configurations that are looked at; with none of them touching, a pair touches in less than 3 / SAMPLES of all (95 %).
SAMPLES = 10000
#: With fewer of them a pair that touches in 3 of 100 may be taken for one that never does.
FEWEST = 100
#: Share of configurations from which on a pair touches always: neighbours whose shapes overlap.
ALWAYS = 0.98
#: Limit of the joints' accelerations until somebody sets the maker's, rad/s^2: a URDF has none.
ACCELERATION = 5.0
#: Name of the link that ``--tip-at`` makes.
TIP = "magic_tip"


@dataclass(frozen=True)
class Pairs:
    """Pairs of links that need not be checked: joined by a joint, or both fingers; touching in (nearly) every
    configuration; touching at home, so that nothing could be planned; never touching in ``samples``.  checked: the others,
    with the share of configurations in which they touch."""

    adjacent: tuple[tuple[str, str], ...]
    always: tuple[tuple[str, str], ...]
    home: tuple[tuple[str, str], ...]
    never: tuple[tuple[str, str], ...]
    checked: dict[tuple[str, str], float]
    samples: int


def link_pairs(config: RobotConfig, samples: int = SAMPLES, seed: int = 0) -> Pairs:
    """Sample which links of an arm touch each other; ``config.srdf`` is not read."""
    from magic_planner.robot import Robot

    with tempfile.TemporaryDirectory() as scratch:
        empty = Path(scratch) / "empty.srdf"
        empty.write_text('<robot name="robot"/>')
        robot = Robot(replace(config, srdf=str(empty)))
    links = sorted(o.name for o in robot.planner.robot.get_fcl_model().get_collision_objects())
    fingers = [link for link in links if link in robot.description.finger_links]
    # Fingers are made to meet.
    adjacent = _adjacent(robot.description, links) | {_pair(a, b) for a, b in itertools.combinations(fingers, 2)}
    rng = np.random.default_rng(seed)
    count: Counter[tuple[str, str]] = Counter()

    def touching() -> set[tuple[str, str]]:
        return {_pair(c.link_name1, c.link_name2) for c in robot.world.check_self_collision()}

    robot.world.set_qpos_all(robot.home)
    at_home = touching()
    for index in range(samples):
        if index % 20 == 0:  # the fingers' way matters to few pairs, and setting it takes as long as all else
            robot.open_to(float(rng.uniform(0, config.opening)))
        robot.world.set_qpos_all(rng.uniform(robot.chain.lower, robot.chain.upper))
        count.update(touching())
    pairs = [_pair(a, b) for a, b in itertools.combinations(links, 2)]
    rest = [pair for pair in pairs if pair not in adjacent]
    always = tuple(pair for pair in rest if count[pair] >= ALWAYS * samples)
    home = tuple(pair for pair in rest if pair in at_home and pair not in always)
    never = tuple(pair for pair in rest if not count[pair] and pair not in at_home)
    checked = {p: count[p] / samples for p in rest if p not in always and p not in home and p not in never}
    return Pairs(tuple(sorted(adjacent)), always, home, never, checked, samples)


def _pair(a: str, b: str) -> tuple[str, str]:
    return (a, b) if a < b else (b, a)


def _adjacent(robot: Description, links: Sequence[str]) -> set[tuple[str, str]]:
    """Links with shapes that a joint joins, links without shapes between them not counted."""
    above = {joint.child: joint.parent for joint in robot.joints.values()}
    found = set()
    for link in links:
        parent = above.get(link)
        while parent is not None and parent not in links:
            parent = above.get(parent)
        if parent is not None:
            found.add(_pair(link, parent))
    return found


def srdf(name: str, pairs: Pairs) -> str:
    """The SRDF of pairs."""
    root = ET.Element("robot", name=name)
    reasons = (("Adjacent", pairs.adjacent), ("Always", pairs.always), ("Default", pairs.home), ("Never", pairs.never))
    for reason, these in reasons:
        for first, second in these:
            ET.SubElement(root, "disable_collisions", link1=first, link2=second, reason=reason)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


# ------------------------------------------------------------ the file that is given


def document(path: Path, arguments: Sequence[str] = ()) -> ET.Element:
    """The URDF of a file; a xacro is processed with its arguments NAME:=VALUE.  Raises BAD_REQUEST."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise MagicError(Code.BAD_REQUEST, "robot description", str(path), f"a readable URDF or xacro ({error})") from error
    root = _parsed(text, path)
    if path.suffix == ".xacro" or any("ros.org/wiki/xacro}" in str(element.tag) for element in root.iter()):
        root = _parsed(_processed(path, arguments), path)
    elif arguments:
        raise MagicError(Code.BAD_REQUEST, "arguments of a URDF", " ".join(arguments), "none: only a xacro takes NAME:=VALUE")
    if root.tag != "robot":
        raise MagicError(Code.BAD_REQUEST, f"root element of {path}", root.tag, "robot")
    return root


def _parsed(text: str, path: Path) -> ET.Element:
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        raise MagicError(Code.BAD_REQUEST, f"robot description {path}", str(error), "well-formed XML") from error


def _processed(path: Path, arguments: Sequence[str]) -> str:
    try:
        import xacro
    except ImportError as error:
        raise MagicError(
            Code.BAD_REQUEST, f"{path} is a xacro", str(error),
            "the package xacro: apt-get install ros-jazzy-xacro, or pip install -r ros2_ws/requirements-robot.txt",
        ) from error  # fmt: skip
    given = {}
    for word in arguments:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise MagicError(Code.BAD_REQUEST, "xacro argument", word, "NAME:=VALUE")
        given[name] = value
    try:
        return str(xacro.process_file(str(path), mappings=given).toxml())
    except Exception as error:  # whatever a file can do wrong in a language of its own
        raise MagicError(Code.BAD_REQUEST, f"xacro {path}", f"{type(error).__name__}: {error}", "a file that xacro processes") from error


def with_tip(root: ET.Element, parent: str, pose: Sequence[float]) -> None:
    """Add an empty link TIP to a URDF, at x y z roll pitch yaw of a link."""
    if parent not in [link.get("name") for link in root.findall("link")]:
        raise MagicError(Code.BAD_REQUEST, "--tip-at", parent, [link.get("name", "") for link in root.findall("link")])
    ET.SubElement(root, "link", name=TIP)
    joint = ET.SubElement(root, "joint", name=f"{TIP}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=TIP)
    ET.SubElement(joint, "origin", xyz=" ".join(map(str, pose[:3])), rpy=" ".join(map(str, pose[3:])))


# ------------------------------------------------------------ the work


@dataclass(frozen=True)
class Described:
    """What was written: the configuration, the pairs, and how a linkage opens (None: two sliding fingers as they were)."""

    config: RobotConfig
    pairs: Pairs
    jaws: Jaws | None


def describe(
    path: Path, out: Path, *, arguments: Sequence[str] = (), tip: str = "", tip_at: Sequence[str] = (), home: Sequence[float] = (),
    base_frame: str = "", package_root: str = "", samples: int = SAMPLES, seed: int = 0,
) -> Described:  # fmt: skip
    """Write an arm's files into a folder; raises BAD_REQUEST with what is wrong with the description."""
    if samples < FEWEST:
        raise MagicError(Code.BAD_REQUEST, "--samples", samples, f"at least {FEWEST}: pairs that touch in none of them are not checked")
    root = document(path, arguments)
    out.mkdir(parents=True, exist_ok=True)
    if tip_at:
        try:
            with_tip(root, tip_at[0], [float(v) for v in tip_at[1:]])
        except ValueError as error:
            raise MagicError(Code.BAD_REQUEST, "--tip-at", " ".join(tip_at), "LINK X Y Z ROLL PITCH YAW") from error
        tip = TIP
    given, empty = out / "robot.urdf", out / "robot.srdf"
    given.write_text(ET.tostring(root, encoding="unicode"))
    empty.write_text('<robot name="robot"/>')
    config = RobotConfig(
        urdf=str(given), srdf=str(empty), package_root=package_root, move_group=tip, base_frame=base_frame, acceleration=(ACCELERATION,)
    )
    config = replace(config, home=tuple(home) or _middle(config))
    robot = Ungripped(config)
    robot.urdf = path  # the folders above it are where package:// is looked for
    jaws = None
    if linkage.slides(robot):
        axis, opening = _sliding(robot)
    else:
        jaws = linkage.measure(robot)
        root, axis, opening = linkage.reduced(robot, jaws), jaws.axis, jaws.opening
        (out / "gripper.csv").write_text(_table(jaws))
    for mesh in root.iter("mesh"):
        mesh.set("filename", robot.mesh_path(mesh.get("filename", "")))
    given.write_text('<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n")
    config = replace(config, closing_axis=axis, opening=round(opening, 5), package_root="")
    pairs = link_pairs(config, samples, seed)
    empty.write_text(srdf(root.get("name", "robot"), pairs))
    Description(config)  # what is written can be read
    (out / "robot.param.yaml").write_text(_parameters(config, path))
    return Described(config, pairs, jaws)


class _Anywhere(Ungripped):
    """An arm whose ready pose is still to be chosen."""

    def _check_home(self) -> None:
        pass


def _middle(config: RobotConfig) -> tuple[float, ...]:
    """The middle of each joint's range; 0 where it turns without end."""
    for count in range(1, 16):
        try:
            robot = _Anywhere(replace(config, home=(0.0,) * count))
        except MagicError as error:
            if error.message.startswith("home configuration"):
                continue
            raise
        ends = [(robot.joints[j.name].lower, robot.joints[j.name].upper) for j in robot.arm]
        return tuple(round((low + high) / 2, 4) if high > low else 0.0 for low, high in ends)
    raise MagicError(Code.BAD_REQUEST, "joints from the root to the tip", "more than 15", "an arm")


def _sliding(robot: Ungripped) -> tuple[str, float]:
    """Axis and way of two sliding fingers."""
    first = robot.gripper_joints()[0]
    poses = robot.poses({})
    direction = (np.linalg.inv(poses[robot.config.move_group]) @ poses[first.parent] @ first.parent_from_joint)[:3, :3] @ first.axis
    axis = "xy"[int(np.argmax(np.abs(direction[:2])))]
    return axis, float(sum(max(abs(j.lower), abs(j.upper)) for j in robot.gripper_joints()))


def _table(jaws: Jaws) -> str:
    rows = [f"{w:.5f},{p:.5f},{d:.5f}" for w, p, d in zip(jaws.widths, jaws.positions, jaws.depths)]
    return f"width_m,{jaws.driver}_rad,reach_m\n" + "\n".join(rows) + "\n"


def _parameters(config: RobotConfig, source: Path) -> str:
    """The parameters file."""
    home = ", ".join(f"{v:.6g}" if "." in f"{v:.6g}" or "e" in f"{v:.6g}" else f"{v:.6g}.0" for v in config.home)
    return f"""# Written by describe_robot from {source.name}; give it to the launch file: robot_params:=FILE
# magic_bringup/config/robot.param.yaml says what else may stand here. Check home, acceleration and scales before anything moves.
/**:
  ros__parameters:
    robot:
      urdf: {Path(config.urdf).resolve()}
      srdf: {Path(config.srdf).resolve()}
      base_frame: "{config.base_frame}"
      move_group: {config.move_group}
      closing_axis: "{config.closing_axis}"
      opening: {config.opening}
      home: [{home}]
      acceleration: [{ACCELERATION}]   # rad/s^2, one a joint or one for all: set the maker's limits
/**/perception:
  ros__parameters: {{frame: {Description(config).base_frame}}}
/**/verifier:
  ros__parameters: {{arm: {{stiffness: [3000.0], damping: [100.0]}}}}   # of the simulated drives, Nm/rad and Nms/rad
/**/strategy_server:
  ros__parameters: {{opening: {config.opening}}}   # trajectory_action, gripper_action: the controllers' names
"""


def lines_of(found: Described) -> list[str]:
    """What was found, in lines for a terminal."""
    robot, pairs = Description(found.config), found.pairs
    lines = [f"arm        {len(robot.arm)} joints: {', '.join(robot.names)}"]
    lines.append(f"home       {', '.join(f'{v:.3f}' for v in found.config.home)}")
    fingers = ", ".join(joint.name for joint in robot.fingers)
    lines.append(
        f"gripper    {1000 * found.config.opening:.1f} mm open, closes along {found.config.closing_axis} of {found.config.move_group} ({fingers})"
    )
    if found.jaws is not None:
        jaws = found.jaws
        lines.append(
            f"linkage    driven by {jaws.driver}: {jaws.positions[jaws.opened]:.3f} rad open, {jaws.positions[jaws.closed]:.3f} rad closed "
            f"({1000 * jaws.least:.1f} mm left); reduced to two sliding fingers"
        )
        lines.append(
            f"           closed, the fingertips reach {1000 * jaws.reaches_on:.1f} mm farther than open; planned with as if always so deep"
        )
        lines.append(
            "           the driver of the gripper has to take metres between the fingers; gripper.csv has the joint's position for each width"
        )
    lines.append(
        f"pairs      {len(pairs.adjacent)} joined, {len(pairs.always)} always touching, {len(pairs.never)} never in {pairs.samples} configurations: not checked; "
        f"{len(pairs.checked)} checked"
    )
    if pairs.home:
        names = ", ".join(f"{a} and {b}" for a, b in pairs.home)
        lines.append(f"LOOK AT    touching at home and so not checked: {names}; another --home, or shapes that are too large")
    return lines


def parser() -> argparse.ArgumentParser:
    """The command line."""
    result = argparse.ArgumentParser(prog="describe_robot", description="An arm's files for this software, from its URDF or xacro.")
    result.add_argument("robot", type=Path, help="URDF or xacro of the arm with its gripper")
    result.add_argument("arguments", nargs="*", metavar="NAME:=VALUE", help="arguments of the xacro")
    tip = result.add_mutually_exclusive_group(required=True)
    tip.add_argument("--tip", default="", metavar="LINK", help="link between the fingertips, z out of the hand")
    tip.add_argument(
        "--tip-at",
        nargs=7,
        default=(),
        metavar=("LINK", "X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="make such a link, at a place of another (m, rad)",
    )
    result.add_argument(
        "--home", nargs="+", type=float, default=[], metavar="Q", help="ready pose, rad (default: the middle of each range)"
    )
    result.add_argument("--base-frame", default="", help="what TF calls the frame of the URDF's root (default: the root link's name)")
    result.add_argument("--package-root", default="", help="what package:// stands for (default: found above the file, or by ROS)")
    result.add_argument("--samples", type=int, default=SAMPLES, help=f"configurations to look at for pairs that touch (default {SAMPLES})")
    result.add_argument("--seed", type=int, default=0, help="seed of them (default 0)")
    result.add_argument("--out", type=Path, default=Path("out/robot"), help="folder for the files (default out/robot)")
    return result


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    given = parser().parse_args(arguments)
    try:
        found = describe(
            given.robot, given.out, arguments=given.arguments, tip=given.tip, tip_at=given.tip_at, home=given.home, base_frame=given.base_frame,
            package_root=given.package_root, samples=given.samples, seed=given.seed,
        )  # fmt: skip
    except (MagicError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    print("\n".join(lines_of(found)))
    print(
        f"wrote {given.out / 'robot.param.yaml'}; next: ros2 launch magic_bringup magic.launch.xml robot_params:={given.out / 'robot.param.yaml'}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
