"""A strategy: one demonstration of a tool in use, as a folder (paper, III-A).

The folder holds ``strategy.yaml`` and what it names::

    strategy.yaml     everything below
    tool.png          canonical view of the reference tool T, RGB
    tool_mask.png     its mask (255 on the tool)
    target.png, target_mask.png      the same for the reference object O
    tool.ply, target.ply             meshes in their own frames (to replay and to render)
    trajectory.csv    t, x, y, z, qx, qy, qz, qw: target_from_tool, with the target's
                      frame where it stood when the motion began

``tool.contact`` and ``target.contact`` are the first pair of contacts, as a rule the only one.  Where the tool meets the target at further
places, at once or one after the other, each is an entry of a list beside them, in pixels of the same two views::

    contacts:
    - name: back
      tool: {pixel: [372.6, 168.8], normal: [1.0, 0.0], radius: .inf, concave: false, scale: 0.06}
      target: {pixel: [191.5, 316.0], normal: [0.0, 1.0], radius: .inf, concave: false, scale: 0.02, normal_in_world: [-1.0, 0.0, 0.0],
      outline: outer}

Under ``target``, ``turned_by: 40`` allows motion and goal to be turned by up to 40 degrees about the
vertical where other things stand in the way.

A waypoint with ``contact: back`` is a pose of that contact of the tool in the frame of that contact
of the target; without it, of the first.
"""

from __future__ import annotations

import csv
import hashlib
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from magic_core import goal as goals
from magic_core import images, transforms
from magic_core.contact import Contact, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.goal import Goal
from magic_core.mesh import Mesh
from magic_core.mesh import load as load_mesh
from magic_core.scene import CanonicalView

MODES = ("plan", "retarget")
REFLECTIONS = ("keep", "turn")
#: Where the tool meets the target: outside on its silhouette, inside a hole or a notch of the silhouette, or inside what only a cut
#: through the target's middle shows to be hollow (a ring seen from its side, a cup).  Where on it follows from the target's normal.
SIDES = ("outer", "inner", "cut")
#: Or at a feature: anywhere on the outline, inner ones included, where it looks as at the demonstrated contact.
OUTLINES = (*SIDES, "feature")

#: libyaml's where PyYAML has it: seven times as quick, and a strategy is read for every goal.
SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Waypoint:
    """A pose of the tool's contact frame on the way.

    offset (3,) metres from the target's contact frame, in axes of that frame: x
    along the target's outward normal, z along the view direction.  ``phase`` names
    the part of the motion that ends here; speed in m/s.  contact: the name of the pair
    of contacts whose frames are meant, '' for the first.
    """

    name: str
    offset: NDArray[np.float64]
    phase: str
    speed: float = 0.1
    contact: str = ""


@dataclass(frozen=True)
class ContactPair:
    """A further place at which the tool meets the target, in the strategy's two views; target_normal and target_outline as there."""

    name: str
    tool: Contact
    target: Contact
    target_normal: NDArray[np.float64]
    target_outline: str = "outer"


@dataclass(frozen=True)
class Physics:
    """Friction coefficients and densities (kg/m^3) of the simulation."""

    friction: float = 0.5
    tool_density: float = 600.0
    target_density: float = 600.0
    target_is_fixed: bool = False


@dataclass(frozen=True)
class Strategy:
    """The demonstration and how it is to be carried over.

    Attributes
    ----------
    view : kind of canonical view the contacts are matched in.
    mode : ``plan`` goes through the waypoints, ``retarget`` carries the demonstrated trajectory over.
    tool_view, tool_contact : where p_T is on the demonstrated tool.
    target_view, target_contact : where p_O is on the demonstrated target.
    target_normal : (3,) in the world, the target's outward normal at p_O: the side on which the tool acts.
    target_view_direction : (3,) in the world, along which the target is looked at; the tool's view direction is made to agree with it.
    times, target_from_tool : (T,) s and (T, 4, 4), the demonstrated motion.
    target_outline : one of OUTLINES; "cut" has the target drawn as cut through its middle, "feature" has p_O found by the matching that
        finds p_T, among the places that face the target's normal.
    reflections : what to do with mirrored matches, in order of trial: ``keep`` the tool's face or ``turn`` it over.
    releases : the tool is let go at the end.
    simulatable : physics can judge the goal.
    environment : names and numbers of the fixed things around, for scenes and evaluations.
    contacts : the pairs of contacts after the first.
    turned_by : rad, how far to either side the target's normal, and with it motion and goal, may be turned about the vertical where
        something stands in the way (``target: turned_by`` in the file, degrees).
    """

    name: str
    description: str
    view: str
    mode: str
    tool_view: CanonicalView
    tool_contact: Contact
    target_view: CanonicalView
    target_contact: Contact
    target_normal: NDArray[np.float64]
    target_view_direction: NDArray[np.float64]
    times: NDArray[np.float64]
    target_from_tool: NDArray[np.float64]
    tool_mesh: Mesh
    target_mesh: Mesh
    waypoints: tuple[Waypoint, ...]
    goal: Goal
    physics: Physics
    target_outline: str = "outer"
    reflections: tuple[str, ...] = REFLECTIONS
    releases: bool = False
    simulatable: bool = True
    environment: dict[str, Any] = field(default_factory=dict)
    contacts: tuple[ContactPair, ...] = ()
    turned_by: float = 0.0

    def turned(self, angle: float) -> Strategy:
        """The strategy with the target's normal turned by an angle (rad) about the vertical, and so what its goal calls the pull;
        raises BAD_REQUEST for more than it allows."""
        if angle == 0:
            return self
        if not abs(angle) <= self.turned_by + 1e-6:
            allowed = f"up to {np.degrees(self.turned_by):.0f} degrees to either side"
            raise MagicError(Code.BAD_REQUEST, f"turn of strategy {self.name}", f"{np.degrees(angle):.1f} degrees", allowed)
        return replace(self, target_normal=transforms.from_rpy(0, 0, angle)[:3, :3] @ self.target_normal)


def _read_image(path: Path) -> NDArray[np.uint8]:
    return images.read_color(path, "reference image", Code.BAD_STRATEGY)


def _read_mask(path: Path) -> NDArray[np.bool_]:
    return images.read_color(path, "reference mask", Code.BAD_STRATEGY)[..., 0] > 127


def _view(folder: Path, prefix: str, kind: str, data: dict[str, Any]) -> CanonicalView:
    return CanonicalView(
        _read_image(folder / f"{prefix}.png"),
        _read_mask(folder / f"{prefix}_mask.png"),
        float(data["metres_per_pixel"]),
        transforms.from_quaternion(data["object_from_view"]["position"], data["object_from_view"]["orientation"]),
        kind,
    )


def _contact(view: CanonicalView, data: dict[str, Any]) -> Contact:
    pixel = np.array(data["pixel"], dtype=float)
    normal = transforms.unit(data["normal"])
    return Contact(pixel, normal, float(data["radius"]), bool(data["concave"]), float(data["scale"]), contact_frame(view, pixel, normal))


def _pair(tool_view: CanonicalView, target_view: CanonicalView, data: dict[str, Any]) -> ContactPair:
    target = data["target"]
    return ContactPair(
        str(data["name"]),
        _contact(tool_view, data["tool"]),
        _contact(target_view, target),
        transforms.unit(target["normal_in_world"]),
        str(target.get("outline", "outer")),
    )


def _check(strategy: Strategy) -> None:
    """Refuse numbers with which nothing can be matched, planned or simulated; raises ValueError that names them."""
    times, physics = strategy.times, strategy.physics
    numbers = {
        "friction": physics.friction,
        "tool_density": physics.tool_density,
        "target_density": physics.target_density,
        **{f"speed of waypoint {w.name}": w.speed for w in strategy.waypoints},
    }
    positive = [name for name in numbers if name != "friction"]
    rules = {
        f"outline of the target {strategy.target_outline!r}: one of {OUTLINES}": strategy.target_outline in OUTLINES,
        f"reflections {strategy.reflections}: of {REFLECTIONS}, at least one": bool(strategy.reflections)
        and set(strategy.reflections) <= set(REFLECTIONS),
        "times of trajectory.csv: finite, strictly increasing": bool(np.all(np.isfinite(times)) and np.all(np.diff(times) > 0)),
        "poses of trajectory.csv: finite": bool(np.all(np.isfinite(strategy.target_from_tool))),
        **{
            f"offset of waypoint {w.name}: 3 finite metres": w.offset.shape == (3,) and np.all(np.isfinite(w.offset))
            for w in strategy.waypoints
        },
        **{f"{name}: a finite number": np.isfinite(value) for name, value in numbers.items()},
        **{f"{name}: above 0": numbers[name] > 0 for name in positive},
        "friction: 0 or more": physics.friction >= 0,
        "turned_by of the target: 0 to 180 degrees": 0 <= strategy.turned_by <= np.pi,
        "turned_by of the target: of one contact with a level normal, looked at from above": strategy.turned_by == 0
        or (not strategy.contacts and abs(strategy.target_normal[2]) < 1e-6 and strategy.target_view_direction[2] < -1 + 1e-6),
    }
    pairs = [("", strategy.tool_contact, strategy.target_contact), *((f" {p.name}", p.tool, p.target) for p in strategy.contacts)]
    names = [pair.name for pair in strategy.contacts]
    rules[f"names of contacts {names}: each once, none empty"] = len(set(names)) == len(names) and "" not in names
    if names:
        rules["mode of a strategy with several contacts: 'plan'"] = strategy.mode == "plan"
    for pair in strategy.contacts:
        if strategy.target_outline == "cut" or pair.target_outline == "cut":
            same = pair.target_outline == strategy.target_outline
            rules[f"outline of {pair.name}: {strategy.target_outline!r}, as the first, where one is of a cut"] = same
        rules[f"outline of {pair.name} {pair.target_outline!r}: one of {OUTLINES}"] = pair.target_outline in OUTLINES
    for waypoint in strategy.waypoints:
        rules[f"contact of waypoint {waypoint.name} {waypoint.contact!r}: one of {names}"] = waypoint.contact in ("", *names)
    for name, contact, view in (
        (f"{body}'s contact{which}", contact, view)
        for which, *both in pairs
        for body, contact, view in zip(("tool", "target"), both, (strategy.tool_view, strategy.target_view), strict=True)
    ):
        height, width = view.mask.shape
        rules[f"pixel of the {name}: within {width} x {height}"] = bool(np.all((contact.pixel >= -0.5) & (contact.pixel < [width, height])))
        rules[f"radius of the {name}: above 0"] = contact.radius > 0
        rules[f"scale of the {name}: above 0, finite"] = 0 < contact.scale < np.inf
    broken = [rule for rule, kept in rules.items() if not kept]
    if broken:
        raise ValueError("; ".join(broken))


def stamp(folder: str | Path) -> int:
    """When the file of a strategy was changed, in ns; 0 where there is none, or where no file can have such a name."""
    try:
        return (Path(folder) / "strategy.yaml").stat().st_mtime_ns
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return 0


def load(folder: str | Path) -> Strategy:
    """Read a strategy folder; ``BAD_STRATEGY`` says which key or file is wrong."""
    folder = Path(folder)
    path = folder / "strategy.yaml"
    if not stamp(folder):
        raise MagicError(Code.UNKNOWN_STRATEGY, "strategy folder", str(folder), "a folder with a strategy.yaml")
    try:
        data = yaml.load(path.read_text(), Loader=SafeLoader)
        if data["mode"] not in MODES:
            raise MagicError(Code.BAD_STRATEGY, f"{path}: mode", data["mode"], MODES)
        tool_view = _view(folder, "tool", data["view"], data["tool"])
        target_view = _view(folder, "target", data["view"], data["target"])
        with open(folder / "trajectory.csv", newline="") as file:
            rows = np.array([[float(x) for x in row] for row in list(csv.reader(file))[1:]])
        physics = data["physics"]
        strategy = Strategy(
            name=data["name"],
            description=data["description"],
            view=data["view"],
            mode=data["mode"],
            tool_view=tool_view,
            tool_contact=_contact(tool_view, data["tool"]["contact"]),
            target_view=target_view,
            target_contact=_contact(target_view, data["target"]["contact"]),
            target_normal=transforms.unit(data["target"]["normal_in_world"]),
            target_view_direction=transforms.unit(data["target"]["view_direction_in_world"]),
            times=rows[:, 0],
            target_from_tool=np.stack([transforms.from_quaternion(r[1:4], r[4:8]) for r in rows]),
            tool_mesh=load_mesh(folder / "tool.ply"),
            target_mesh=load_mesh(folder / "target.ply"),
            waypoints=tuple(
                Waypoint(w["name"], np.array(w["offset"], dtype=float), w["phase"], float(w.get("speed", 0.1)), str(w.get("contact", "")))
                for w in data.get("waypoints", [])
            ),
            goal=goals.from_data(data["goal"], f"{path}: goal"),
            physics=Physics(**physics),
            target_outline=str(data["target"].get("outline", "outer")),
            reflections=tuple(data.get("reflections", REFLECTIONS)),
            releases=bool(data.get("releases", False)),
            simulatable=bool(data.get("simulatable", True)),
            environment=dict(data.get("environment", {})),
            contacts=tuple(_pair(tool_view, target_view, entry) for entry in data.get("contacts", [])),
            turned_by=float(np.deg2rad(float(data["target"].get("turned_by", 0.0)))),
        )
        _check(strategy)
        return strategy
    except MagicError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OSError, yaml.YAMLError) as error:
        raise MagicError(
            Code.BAD_STRATEGY, f"strategy file {path}", f"{type(error).__name__}: {error}", "the keys that magic_core.strategy documents"
        ) from error


def installed_folder() -> Path:
    """Where the strategies that ship with the project are installed."""
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory("magic_bringup")) / "strategies"


def find(name: str, root: str | Path | None = None) -> Strategy:
    """Load a strategy by the name of its folder under ``root`` (default: the installed ones) or by its path.

    Raises ``UNKNOWN_STRATEGY`` naming the strategies there are.
    """
    return load(_folder(name, root))


#: What a strategy is read from.
FILES = ("strategy.yaml", "trajectory.csv", *(f"{body}{what}" for body in ("tool", "target") for what in (".png", "_mask.png", ".ply")))
#: Strategies by the content of their files; the newest of them.
_KNOWN: dict[bytes, Strategy] = {}
MOST_KNOWN = 16


def known(name: str, root: str | Path | None = None) -> Strategy:
    """As :func:`find`, for who asks again and again: read once for files of the same content.  Its arrays
    are not to be written to, and refuse it."""
    folder = _folder(name, root)
    content = _content(folder)
    kept = _KNOWN.get(content)
    if kept is not None:
        return kept
    strategy = load(folder)
    if content == _content(folder):  # else it was written while it was read
        _make_read_only(strategy)
        while len(_KNOWN) >= MOST_KNOWN:
            _KNOWN.pop(next(iter(_KNOWN)), None)
        _KNOWN[content] = strategy
    return strategy


def _content(folder: Path) -> bytes:
    """A digest of a strategy's files; of what cannot be read one as well, which no strategy has."""
    found = hashlib.sha256()
    for name in FILES:
        try:
            data = (folder / name).read_bytes()
        except (OSError, ValueError):  # ValueError: a NUL in the name
            data = b""
        found.update(f"{name} {len(data)} ".encode() + data)
    return found.digest()


def _make_read_only(value: Any) -> None:
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif is_dataclass(value):
        for part in fields(value):
            _make_read_only(getattr(value, part.name))
    elif isinstance(value, (tuple, list)):
        for part in value:
            _make_read_only(part)


def _folder(name: str, root: str | Path | None) -> Path:
    if name and "/" in name:
        return Path(name)
    try:
        root = Path(root) if root else installed_folder()
    except LookupError:
        raise MagicError(
            Code.UNKNOWN_STRATEGY, "strategy", name, "the path of a strategy folder (magic_bringup is not installed)"
        ) from None
    names = sorted(p.parent.name for p in root.glob("*/strategy.yaml"))
    if name not in names:
        raise MagicError(Code.UNKNOWN_STRATEGY, "strategy", name, [*(names or [f"none is in {root}"]), "or the path of a strategy folder"])
    return root / name


def _floats(values: Any) -> list[float]:
    return [float(x) for x in np.asarray(values, dtype=float).ravel()]


def _view_data(view: CanonicalView, contact: Contact) -> dict[str, Any]:
    return {
        "metres_per_pixel": float(view.metres_per_pixel),
        "object_from_view": {
            "position": _floats(view.object_from_view[:3, 3]),
            "orientation": _floats(transforms.quaternion_xyzw(view.object_from_view)),
        },
        "contact": _contact_data(contact),
    }


def _contact_data(contact: Contact) -> dict[str, Any]:
    return {
        "pixel": _floats(contact.pixel),
        "normal": _floats(contact.normal),
        "radius": float(contact.radius),
        "concave": bool(contact.concave),
        "scale": float(contact.scale),
    }


def _pair_data(pair: ContactPair) -> dict[str, Any]:
    target = {**_contact_data(pair.target), "normal_in_world": _floats(pair.target_normal), "outline": pair.target_outline}
    return {"name": pair.name, "tool": _contact_data(pair.tool), "target": target}


def _waypoint_data(waypoint: Waypoint) -> dict[str, Any]:
    data = {"name": waypoint.name, "offset": _floats(waypoint.offset), "phase": waypoint.phase, "speed": waypoint.speed}
    return {**data, "contact": waypoint.contact} if waypoint.contact else data


def _depth(value: Any) -> int:
    """How many mappings and lists are in each other."""
    if isinstance(value, dict):
        return 1 + max(map(_depth, value.values()), default=0)
    return 1 + max(map(_depth, value), default=0) if isinstance(value, (list, tuple)) else 0


class _Dumper(yaml.SafeDumper):
    """What is flat stands in one line, and there are no anchors: a strategy, its goal above all, is to be read."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        return super().represent_mapping(tag, mapping, flow_style=_depth(dict(mapping)) <= 2)

    def represent_sequence(self, tag: str, sequence: Any, flow_style: bool | None = None) -> yaml.SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style=_depth(sequence) <= 1)


def save(strategy: Strategy, folder: str | Path) -> None:
    """Write a strategy folder that :func:`load` reads back."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for prefix, view in (("tool", strategy.tool_view), ("target", strategy.target_view)):
        cv2.imwrite(str(folder / f"{prefix}.png"), cv2.cvtColor(view.image, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / f"{prefix}_mask.png"), view.mask.astype(np.uint8) * 255)
    strategy.tool_mesh.save(folder / "tool.ply")
    strategy.target_mesh.save(folder / "target.ply")
    with open(folder / "trajectory.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "x", "y", "z", "qx", "qy", "qz", "qw"])
        for t, pose in zip(strategy.times, strategy.target_from_tool, strict=True):
            writer.writerow([f"{v:.9g}" for v in (t, *pose[:3, 3], *transforms.quaternion_xyzw(pose))])
    data = {
        "name": strategy.name,
        "description": strategy.description,
        "view": strategy.view,
        "mode": strategy.mode,
        "tool": _view_data(strategy.tool_view, strategy.tool_contact),
        "target": {
            **_view_data(strategy.target_view, strategy.target_contact),
            "normal_in_world": _floats(strategy.target_normal),
            "view_direction_in_world": _floats(strategy.target_view_direction),
            "outline": strategy.target_outline,
            **({"turned_by": round(float(np.degrees(strategy.turned_by)), 6)} if strategy.turned_by else {}),
        },
        "reflections": list(strategy.reflections),
        "releases": strategy.releases,
        "simulatable": strategy.simulatable,
        **({"contacts": [_pair_data(pair) for pair in strategy.contacts]} if strategy.contacts else {}),
        "waypoints": [_waypoint_data(w) for w in strategy.waypoints],
        "goal": goals.to_data(strategy.goal),
        "physics": {
            "friction": strategy.physics.friction,
            "tool_density": strategy.physics.tool_density,
            "target_density": strategy.physics.target_density,
            "target_is_fixed": strategy.physics.target_is_fixed,
        },
        "environment": dict(strategy.environment),
    }
    (folder / "strategy.yaml").write_text(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=140))
