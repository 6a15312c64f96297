"""What a rollout draws: the parameter file, the draw, and the scene as it is under a draw.

A draw is made of one seed and one number; the rollout that follows from it depends
on nothing else, in whatever order and by whichever process it is computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_verifier.floating import Body, Setup
from magic_verifier.simulation import STATIC

Array = NDArray[np.float64]

#: The parameter file that ships.
FILE = Path(__file__).with_name("uncertainty.yaml")
KINDS = ("normal", "factor", "uniform")
#: Normals are cut at so many widths.
CUT = 2.0
#: Waves that make up a smooth error of a surface, and the shortest, m, but no longer than this part of the object's largest extent, which
#: is the longest: whatever the size of a thing, the errors of a reconstruction agree over some 20 to 50 mm and no farther (24 tools of 80
#: to 420 mm); longer ones are in place and size.
WAVES = 3
SHORTEST, SHORTEST_PART = 0.05, 0.4
#: Within so many metres of a point that a camera saw a surface is as well known as the file has it, and from so many on it is known no
#: better for it.  Of 76 seen tools the surface was off by 1.1 to 1.8 mm within 5 mm of one, whether 1 mm or 4 was stated of all of it.
SEEN, UNSEEN = 0.005, 0.015
#: A wall keeps at least this share of its thickness.
THINNEST = 0.4


@dataclass(frozen=True)
class Spread:
    """One distribution: see the head of ``uncertainty.yaml``."""

    kind: str
    width: float
    unit: str = ""
    reason: str = ""

    def draw(self, rng: np.random.Generator, count: int, wider: float = 1.0) -> Array:
        """(count,): numbers drawn, of a width ``wider`` times as large."""
        width = self.width * wider
        if self.kind == "uniform":
            return rng.uniform(0.0, 1.0, count) * width
        found = rng.normal(0.0, 1.0, count)
        while np.any(beyond := np.abs(found) > CUT):
            found[beyond] = rng.normal(0.0, 1.0, int(beyond.sum()))
        return np.exp(found * width) if self.kind == "factor" else found * width


@dataclass(frozen=True)
class Eyes:
    """How well an object is known: where it is (m), how turned (rad), and what is wrong with its shape (m), by a factor more or less of one
    object than of another (``shape``)."""

    place: Spread
    turn: Spread
    shape: Spread
    size: Spread
    thickness: Spread
    pieces: Spread


@dataclass(frozen=True)
class Uncertainty:
    """The widths of everything that a rollout draws."""

    friction: Spread
    tool_density: Spread
    target_density: Spread
    centre_of_mass: Spread
    grip_force: Spread
    lag: Spread
    stiffness: Spread
    held_place: Spread
    held_turn: Spread
    known: Eyes
    camera: Eyes
    seen_less: float
    drawn_error: float

    def eyes(self, item: SceneObject) -> tuple[Eyes, float]:
        """What is known of an object, and by how much its widths are to be multiplied."""
        if item.source == "known":
            return self.known, 1.0
        if item.surface_error > 0:
            return self.camera, max(1.0, item.surface_error / self.drawn_error)
        sure = [float(np.clip(v, 0.0, 1.0)) if np.isfinite(v) else 0.0 for v in (item.confidence, item.seen_share)]
        return self.camera, 1.0 + self.seen_less * (1.0 - sure[0] * sure[1])


def read(path: Path | str | None = None) -> Uncertainty:
    """The parameter file (default: the one that ships); raises ``BAD_REQUEST`` naming the entry that is wrong."""
    path = Path(path) if path else FILE
    return _read(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=4)
def _read(path: Path, _changed: int) -> Uncertainty:
    try:
        found = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise MagicError(Code.BAD_REQUEST, f"parameter file {path}", str(error).splitlines()[0], "a readable YAML file") from error

    def entries(value: Any, where: str, names: list[str]) -> dict[str, Any]:
        given = sorted(value) if isinstance(value, dict) else [type(value).__name__]
        if not isinstance(value, dict) or given != sorted(names):
            raise MagicError(Code.BAD_REQUEST, f"entries of {where or path.name}", ", ".join(map(str, given)), sorted(names))
        return value

    def spread(value: Any, where: str) -> Spread:
        entry = entries(value, where, ["kind", "width", "unit", "reason"])
        width = entry["width"]
        if entry["kind"] not in KINDS:
            raise MagicError(Code.BAD_REQUEST, f"kind of {where} in {path.name}", str(entry["kind"]), KINDS)
        if isinstance(width, bool) or not isinstance(width, (int, float)) or not 0 <= width < 10:
            raise MagicError(Code.BAD_REQUEST, f"width of {where} in {path.name}", str(width), "a number, 0 or above, below 10")
        return Spread(entry["kind"], float(width), str(entry["unit"]), str(entry["reason"]))

    def eyes(value: dict[str, Any], where: str) -> Eyes:
        entry = entries(value, where, [f.name for f in fields(Eyes)])
        return Eyes(**{name: spread(entry[name], f"{where}.{name}") for name in entry})

    by_sight = {"seen_less": (0.0, 100.0), "drawn_error": (1e-5, 0.1)}
    names = [f.name for f in fields(Uncertainty) if f.name not in by_sight]
    top = entries(found, "", names)
    camera = dict(top["camera"]) if isinstance(top["camera"], dict) else {}
    told = {}
    for name, (low, high) in by_sight.items():
        value = camera.pop(name, None)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
            raise MagicError(Code.BAD_REQUEST, f"camera.{name} in {path.name}", str(value), f"a number, {low:g} to {high:g}")
        told[name] = float(value)
    plain = {name: spread(top[name], name) for name in names if name not in ("known", "camera")}
    return Uncertainty(**plain, known=eyes(top["known"], "known"), camera=eyes(camera, "camera"), **told)


@dataclass(frozen=True)
class ShapeError:
    """What is wrong with an object's shape: size (3,) m of its extents, thickness m of its walls, and waves that shift its surface:
    amplitudes (K, 3) m, directions (K, 3), how long they are (K,) between the shortest, 0, and the longest that there are, 1, phases
    (K,)."""

    size: Array
    thickness: float
    amplitudes: Array
    directions: Array
    lengths: Array
    phases: Array

    def applied(self, body: Body, shares: Sequence[Array] | None = None) -> Body:
        """The body as it then is; a ball stays a ball, of another size.  shares: for each hull (N,), the shares of the waves that its
        corners are shifted by."""
        corners = body.corners
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, extent = (low + high) / 2, high - low
        scale = np.clip(1 + self.size / np.maximum(extent, 1e-6), 0.5, 1.5)
        largest = max(float(extent.max()), 1e-6)
        shortest = min(SHORTEST, SHORTEST_PART * largest)
        waves = 2 * np.pi * self.directions / (shortest * (largest / shortest) ** self.lengths)[:, None]
        hulls: list[Array] = list(body.hulls)
        balls: list[tuple[Array, float] | None] = list(body.balls)
        for index, ball in enumerate(body.balls):
            if ball is not None:
                grown = max(1 + (float(self.size.mean()) + self.thickness) / (2 * ball[1]), THINNEST)
                hulls[index] = ball[0] + grown * (hulls[index] - ball[0])
                balls[index] = (ball[0], grown * ball[1])
        # All pieces of so many corners at once: a mug has hundreds.
        for count in {len(hull) for hull, ball in zip(hulls, balls, strict=True) if ball is None}:
            some = [i for i, (hull, ball) in enumerate(zip(hulls, balls, strict=True)) if ball is None and len(hull) == count]
            points = middle + scale * (_thicker(np.stack([hulls[i] for i in some]), self.thickness) - middle)
            shifts = np.sin((points - middle) @ waves.T + self.phases) @ self.amplitudes
            if shares is not None:
                shifts *= np.stack([shares[i] for i in some])[..., None]
            for i, moved in zip(some, points + shifts, strict=True):
                hulls[i] = moved
        return replace(body, hulls=tuple(hulls), mesh=None, known_balls=tuple(balls))


def _thicker(hulls: Array, by: float) -> Array:
    """Convex pieces (K, N, 3) that are ``by`` metres thicker along each of their principal axes."""
    middle = hulls.mean(axis=1, keepdims=True)
    local = hulls - middle
    axes = np.linalg.eigh(local.transpose(0, 2, 1) @ local)[1]
    along = local @ axes
    low, high = along.min(axis=1, keepdims=True), along.max(axis=1, keepdims=True)
    factor = np.maximum(1 + by / np.maximum(high - low, 1e-6), THINNEST)
    centre = (low + high) / 2
    return np.asarray(middle + (centre + factor * (along - centre)) @ axes.transpose(0, 2, 1))


@dataclass(frozen=True)
class Draw:
    """One rollout's scene, as far as it differs from the one given.

    friction, densities, grip_force, stiffness: factors; lag s; place (3,) m and turn (3,) rad vector of the target about the middle of
    its box; centres (3,) shares of the extents; tool_from_held (4, 4): where the tool really is in the hand, seen from where it is
    thought to be; nudge rad: the direction of the first nudge.
    """

    friction: float
    tool_density: float
    target_density: float
    tool_centre: Array
    target_centre: Array
    place: Array
    turn: Array
    tool_error: ShapeError
    target_error: ShapeError
    tool_from_held: Array
    grip_force: float
    lag: float
    stiffness: float
    nudge: float

    def values(self, setup: Setup) -> dict[str, float]:
        """The numbers by which failures are told apart: what, in words and with its unit, and how much it was."""
        physics = setup.physics
        found = {
            "friction": physics.friction * self.friction,
            "density of the tool in kg/m^3": physics.tool_density * self.tool_density,
            "thickness of the tool in mm": 1000 * self.tool_error.thickness,
            "size of the tool in mm": 1000 * float(self.tool_error.size.mean()),
            "size of the target in mm": 1000 * float(self.target_error.size.mean()),
            "turn of the target in rad": float(self.turn[2]),
        }
        for axis, place, held in zip("xyz", self.place, self.tool_from_held[:3, 3], strict=True):
            found[f"shift of the target along {axis} in mm"] = 1000 * float(place)
            found[f"shift of the held tool along {axis} in mm"] = 1000 * float(held)
        if setup.target_kind != STATIC:
            found["density of the target in kg/m^3"] = physics.target_density * self.target_density
        return found


def draw(uncertainty: Uncertainty, tool: tuple[Eyes, float], target: tuple[Eyes, float], seed: int, index: int) -> Draw:
    """The draw of one rollout: a function of its arguments alone.  ``tool``, ``target``: as :meth:`Uncertainty.eyes` has them."""
    rng = np.random.default_rng([int(seed), int(index)])

    def shape(eyes: Eyes, wider: float) -> ShapeError:
        wider *= float(eyes.shape.draw(rng, 1)[0])
        size = eyes.size.draw(rng, 3, wider)
        thickness = float(eyes.thickness.draw(rng, 1, wider)[0])
        # A sum of K sines of amplitude a has the standard deviation a sqrt(K / 2).
        sigma = abs(eyes.pieces.width) * wider * np.sqrt(2 / WAVES)
        directions = rng.normal(size=(WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths = rng.uniform(0.0, 1.0, WAVES)
        amplitudes = sigma * rng.choice([-1.0, 1.0], (WAVES, 3))
        return ShapeError(size, thickness, amplitudes, directions, lengths, rng.uniform(0, 2 * np.pi, WAVES))

    eyes, wider = target
    held = transforms.from_rotvec(uncertainty.held_turn.draw(rng, 3), uncertainty.held_place.draw(rng, 3))
    return Draw(
        friction=float(uncertainty.friction.draw(rng, 1)[0]),
        tool_density=float(uncertainty.tool_density.draw(rng, 1)[0]),
        target_density=float(uncertainty.target_density.draw(rng, 1)[0]),
        tool_centre=uncertainty.centre_of_mass.draw(rng, 3),
        target_centre=uncertainty.centre_of_mass.draw(rng, 3),
        place=eyes.place.draw(rng, 3, wider),
        turn=eyes.turn.draw(rng, 3, wider),
        tool_error=shape(*tool),
        target_error=shape(*target),
        tool_from_held=held,
        grip_force=float(uncertainty.grip_force.draw(rng, 1)[0]),
        lag=float(uncertainty.lag.draw(rng, 1)[0]),
        stiffness=float(uncertainty.stiffness.draw(rng, 1)[0]),
        nudge=float(rng.uniform(0, 2 * np.pi)),
    )


def shares(item: SceneObject, wider: float, hulls: Sequence[Array]) -> tuple[Array, ...] | None:
    """For each hull of an object, in its frame, the shares (N,) of the drawn waves that its corners are shifted by; ``None``: all by all of
    them.

    What a surface is off by beyond what the file has is where no camera saw it, and not near the points that one saw.
    """
    if wider <= 1.0 or len(item.points) == 0:
        return None
    seen = cKDTree(transforms.apply(transforms.inverse(item.world_from_object), item.points))
    found = []
    for hull in hulls:
        away = np.clip((seen.query(hull)[0] - SEEN) / (UNSEEN - SEEN), 0.0, 1.0)
        found.append((1 + (wider - 1) * away) / wider)
    return tuple(found)


def applied(given: Draw, setup: Setup, shares: Sequence[Array] | None = None) -> Setup:
    """The scene under a draw; shares: of the tool's hulls, as :func:`shares` has them.

    A free target is displaced along the table, turned about the vertical and stands on the table as before; a fixed one is displaced
    and turned in any direction.  Obstacles stay: they bound the motion, and what they do to it is looked at in the scene as given.
    """
    physics = replace(
        setup.physics,
        friction=setup.physics.friction * given.friction,
        tool_density=setup.physics.tool_density * given.tool_density,
        target_density=setup.physics.target_density * given.target_density,
    )
    tool, target = given.tool_error.applied(setup.tool, shares), given.target_error.applied(setup.target)
    fixed = setup.target_kind == STATIC
    place = given.place if fixed else given.place * [1.0, 1.0, 0.0]
    turn = given.turn if fixed else given.turn * [0.0, 0.0, 1.0]
    pose = setup.target.world_from_object
    middle = transforms.apply(pose, setup.target.centre)
    about = transforms.make(translation=middle + place) @ transforms.from_rotvec(turn) @ transforms.make(translation=-middle)
    target = replace(target, world_from_object=about @ pose)
    if not fixed:
        target = _stood(target, setup.target, setup.table)
    return replace(setup, physics=physics, tool=_off_centre(tool, given.tool_centre), target=_off_centre(target, given.target_centre))


def _off_centre(body: Body, shares: Array) -> Body:
    """A body whose centre of mass is off; a ball's is not, as it would have rolled until its heavy side was down."""
    return body if all(body.balls) else replace(body, centre_shift=shares * np.ptp(body.corners, axis=0))


def _stood(body: Body, before: Body, table: Array) -> Body:
    """A body as high above the table as it was before it was changed; what rests on the table rests on it again."""

    def height(item: Body) -> float:
        return float((transforms.apply(item.world_from_object, item.corners) @ table[:3] + table[3]).min())

    raise_by = max(0.0, height(before)) - height(body)
    return replace(body, world_from_object=transforms.make(translation=raise_by * table[:3]) @ body.world_from_object)
