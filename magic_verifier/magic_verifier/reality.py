"""How often the simulation is right about recorded contacts: ``ros2 run magic_verifier reality``.

Recorded tosses of a cube are simulated in the verifier's own world, and the question is
which face ends up.  The state from which a toss is simulated is fitted to its rows of free
flight, before anything touches.  Once each toss is simulated as it was recorded; then
again and again with what is not known drawn at random (friction, restitution, velocities, turn), as
the verifier does with a motion.  The share of those rollouts that agree is the
confidence of their answer, and what matters is whether it is worth that much.

Data: a folder with npz files, each array a toss (T, 13) under its number: position (3)
and linear velocity (3) in half edges (and per second), orientation (4, wxyz), angular
velocity (3, rad/s, body frame), as DAIRLab's contact-nets records them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_verifier import reliability
from magic_verifier.simulation import DYNAMIC, Settings, World

#: Tosses whose number this divides were used to choose the parameters; figures are given for the others.
CHOSEN_ON = 4
#: The corners of a cube of half edge 1.
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
#: Directions (7, 3) to the points that stand for a rounded corner of an octant: along its axes, so that the faces stay flat, and between
#: them.
ROUND = np.array([d / np.linalg.norm(d) for d in itertools.product((0.0, 1.0), repeat=3) if any(d)])
#: A rollout ends when the cube has been slower than this (m/s, rad/s) for REST_STEPS steps, else after LONGEST seconds.
REST_SPEED, REST_SPIN, REST_STEPS, LONGEST = 0.02, 0.2, 24, 3.0
#: Slower than this (m/s) nothing springs back: a cube would never come to rest.
BOUNCES = 0.05
#: Edges of the bins of the reliability diagram: shares of rollouts that agree.
BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.999, 1.0)


@dataclass(frozen=True)
class Spread:
    """What a rollout draws: friction and restitution uniformly from (low, high); relative standard deviations of each component of
    velocity and spin; standard deviation of the turn about each axis in rad."""

    friction: tuple[float, float]
    restitution: tuple[float, float]
    velocity: float
    spin: float
    turn: float


@dataclass(frozen=True)
class Setting:
    """What was recorded: edge (m), rounding of its edges and corners (radius, m) and mass (kg) of the cube, rows a second, height of
    the table (m), clearance above which the cube flies freely (m), and the spread of what is not known."""

    edge: float
    rounding: float
    mass: float
    rate: float
    table: float
    free: float
    spread: Spread

    @property
    def density(self) -> float:
        """kg/m^3."""
        return self.mass / self.edge**3

    @property
    def hull(self) -> NDArray[np.float64]:
        """The corners (N, 3) of the cube as it is simulated, m."""
        return np.concatenate([corner * (self.edge / 2 - self.rounding + self.rounding * ROUND) for corner in CORNERS])


@dataclass(frozen=True)
class Toss:
    """One toss: state at its first row (position (3,) m, velocity (3,) m/s, spin (3,) rad/s, all in the world) and the face that ended
    up."""

    number: int
    position: NDArray[np.float64]
    rotation: Rotation
    velocity: NDArray[np.float64]
    spin: NDArray[np.float64]
    face: int


@dataclass(frozen=True)
class Scores:
    """How often the answer was right, and what its confidence was worth.

    accuracy: share of right answers; brier: mean of (confidence - right)^2, 0 is best; unanimous: tosses in which every rollout
    agreed, unanimous_accuracy among them (``None`` without any); doubtful, doubtful_accuracy: those below 90 % agreement;
    bins: for each bin of agreement its mean agreement, share of right answers, and count.
    """

    tosses: int
    rollouts: int
    accuracy: float
    brier: float
    unanimous: int
    unanimous_accuracy: float | None
    doubtful: int
    doubtful_accuracy: float | None
    bins: tuple[tuple[float, float, int], ...]


def load_setting(path: Path) -> Setting:
    """Read the parameter file; raises ``BAD_REQUEST``."""
    try:
        data = yaml.safe_load(path.read_text())
        spread = data.pop("spread")
        return Setting(**data, spread=Spread(**{**spread, **{name: tuple(spread[name]) for name in ("friction", "restitution")}}))
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError) as error:
        raise MagicError(Code.BAD_REQUEST, str(path), str(error), "the keys of magic_verifier/config/reality.yaml") from error


def face_up(rotation: Rotation) -> int:
    """Which of the six faces looks up: twice the number of the axis, and one more where its positive end is up."""
    up = rotation.as_matrix()[2]
    axis = int(np.argmax(np.abs(up)))
    return 2 * axis + int(up[axis] > 0)


def read(folder: Path, setting: Setting) -> list[Toss]:
    """The tosses of all npz files of a folder, by number; raises ``BAD_REQUEST`` where there are none or a row is not as it should be."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise MagicError(Code.BAD_REQUEST, "recorded contacts", str(folder), "a folder with npz files")
    tosses = []
    for path in paths:
        with np.load(path) as file:
            for name in file.files:
                rows = np.asarray(file[name], dtype=float)
                if not name.isdigit() or rows.ndim != 2 or rows.shape[1] != 13 or len(rows) < 2 or not np.all(np.isfinite(rows)):
                    raise MagicError(Code.BAD_REQUEST, f"{path.name}: {name}", rows.shape, "a number, and (T >= 2, 13) finite values")
                tosses.append(as_toss(int(name), rows, setting))
    return sorted(tosses, key=lambda toss: toss.number)


def as_toss(number: int, rows: NDArray[np.float64], setting: Setting) -> Toss:
    """A toss from its rows (T, 13): the state at the first row, fitted to all rows of free flight from there on.

    In free flight positions are a parabola of known curvature, and a cube, whose principal moments of inertia are equal, turns at a
    constant rate.
    """
    half = setting.edge / 2
    positions = rows[:, :3] * half
    rotations = Rotation.from_quat(np.roll(rows[:, 3:7], -1, axis=1))
    lowest = np.array([rotation.apply(CORNERS)[:, 2].min() for rotation in rotations]) * half + positions[:, 2]
    flying = lowest > setting.table + setting.free
    count = len(rows) if flying.all() else int(np.argmin(flying))
    if count >= 3:
        times = np.arange(count) / setting.rate
        fallen = positions[:count] + 0.5 * Settings().gravity * times[:, None] ** 2 * [0, 0, 1]
        (position, velocity), *_ = np.linalg.lstsq(np.column_stack([np.ones(count), times]), fallen, rcond=None)
        spin = (rotations[1:count] * rotations[: count - 1].inv()).as_rotvec().mean(axis=0) * setting.rate
        rotation = (Rotation.from_rotvec(-np.outer(times, spin)) * rotations[:count]).mean()
    else:
        position, rotation, velocity = positions[0], rotations[0], rows[0, 7:10] * half
        spin = rotation.apply(rows[0, 10:13])
    return Toss(number, position, rotation, velocity, spin, face_up(rotations[-1]))


def rollout(toss: Toss, setting: Setting, draw: np.random.Generator | None) -> int:
    """The face that ends up in one simulation; ``draw``: what the unknown is drawn with, ``None`` for the middle of it."""
    spread = setting.spread
    friction, restitution = float(np.mean(spread.friction)), float(np.mean(spread.restitution))
    velocity, spin, rotation = toss.velocity, toss.spin, toss.rotation
    if draw is not None:
        friction, restitution = float(draw.uniform(*spread.friction)), float(draw.uniform(*spread.restitution))
        velocity = velocity * (1 + spread.velocity * draw.standard_normal(3))
        spin = spin * (1 + spread.spin * draw.standard_normal(3))
        rotation = Rotation.from_rotvec(spread.turn * draw.standard_normal(3)) * rotation
    # A thrown cube is not damped by the air, and springs back at any speed.
    world = World(Settings(angular_damping=0.0, restitution=restitution, bounce_threshold=BOUNCES))
    world.add_table(np.array([0.0, 0.0, 1.0, -setting.table]), friction)
    pose = transforms.make(rotation.as_matrix(), [0.0, 0.0, toss.position[2]])
    world.add("cube", [setting.hull], pose, DYNAMIC, setting.density, friction)
    cube = world.component("cube")
    cube.linear_velocity = velocity.astype(np.float32)
    cube.angular_velocity = spin.astype(np.float32)
    still = 0
    while world.time < LONGEST and still < REST_STEPS:
        world.step()
        slow = np.linalg.norm(cube.linear_velocity) < REST_SPEED and np.linalg.norm(cube.angular_velocity) < REST_SPIN
        still = still + 1 if slow else 0
    world.check(("cube",))
    return face_up(Rotation.from_matrix(world.pose("cube")[:3, :3]))


def faces(toss: Toss, setting: Setting, rollouts: int, seed: int) -> NDArray[np.int64]:
    """The faces (rollouts,) that end up; each rollout has a seed of its own, so that more of them change none."""
    return np.array([rollout(toss, setting, np.random.default_rng([seed, toss.number, k])) for k in range(rollouts)])


def score(answers: NDArray[np.int64], truth: NDArray[np.int64]) -> Scores:
    """Answers (N, K) of K rollouts each against the faces (N,) that truly ended up."""
    votes = np.array([np.bincount(row, minlength=6) for row in answers])
    answer, confidence = votes.argmax(axis=1), votes.max(axis=1) / answers.shape[1]
    right = answer == truth
    whole, doubtful = confidence == 1, confidence < 0.9
    bins = []
    for low, high in itertools.pairwise(BINS):
        inside = (confidence > low) & (confidence <= high)
        if inside.any():
            bins.append((float(confidence[inside].mean()), float(right[inside].mean()), int(inside.sum())))
    return Scores(
        len(truth),
        answers.shape[1],
        float(right.mean()),
        float(np.mean((confidence - right) ** 2)),
        int(whole.sum()),
        float(right[whole].mean()) if whole.any() else None,
        int(doubtful.sum()),
        float(right[doubtful].mean()) if doubtful.any() else None,
        tuple(bins),
    )


def table(rows: Sequence[tuple[str, Scores]]) -> str:
    """The scores as lines of text."""

    def share(value: float | None, count: int) -> str:
        return f"{'-' if value is None else f'{100 * value:.1f} %'} of {count}"

    head = f"{'':<42}{'right':>8}{'Brier':>8}{'all agree, right':>20}{'below 90 %, right':>20}"
    lines = [
        f"{name:<42}{100 * s.accuracy:>6.1f} %{s.brier:>8.3f}{share(s.unanimous_accuracy, s.unanimous):>20}"
        f"{share(s.doubtful_accuracy, s.doubtful):>20}"
        for name, s in rows
    ]
    return "\n".join([head, *lines])


def diagram(scores: Scores, path: Path) -> None:
    """The reliability diagram: how many rollouts agreed against how often they were right."""
    title = f"{scores.tosses} recorded tosses (number of tosses at each point)"
    said = f"share of {scores.rollouts} rollouts that agree"
    reliability.draw(scores.bins, path, title, said, "share of right answers", lowest=0.33)


def compare(tosses: list[Toss], setting: Setting, rollouts: int, seed: int, jobs: int, log: Any = print) -> dict[str, Any]:
    """Simulate every toss once as recorded and ``rollouts`` times with the unknown drawn; scores of the chosen-on and the other tosses."""
    from joblib import Parallel, delayed

    def simulate(toss: Toss) -> tuple[int, NDArray[np.int64]]:
        return rollout(toss, setting, None), faces(toss, setting, rollouts, seed)

    results = []
    for result in Parallel(n_jobs=jobs, return_as="generator")(delayed(simulate)(toss) for toss in tosses):
        results.append(result)
        if len(results) % 50 == 0 or len(results) == len(tosses):
            log(f"[{len(results)}/{len(tosses)}] tosses simulated")
    nominal = np.array([[first] for first, _ in results])
    drawn = np.stack([rest for _, rest in results])
    truth = np.array([toss.face for toss in tosses])
    chosen = np.array([toss.number % CHOSEN_ON == 0 for toss in tosses])
    parts = {"held_out": ~chosen, "chosen_on": chosen}
    return {
        name: {"nominal": score(nominal[part], truth[part]), "perturbed": score(drawn[part], truth[part])}
        for name, part in parts.items()
        if part.any()
    }


def main(args: list[str] | None = None) -> None:
    """Entry point of ``ros2 run magic_verifier reality``."""
    from ament_index_python.packages import get_package_share_directory

    parser = argparse.ArgumentParser(prog="reality", description="How often the simulation is right about recorded contacts.")
    parser.add_argument("--data", required=True, type=Path, help="folder with npz files of tosses")
    parser.add_argument("--out", required=True, type=Path, help="folder for reality.json, reality.txt and reliability.png")
    parser.add_argument("--rollouts", type=int, default=20, help="perturbed simulations of each toss")
    parser.add_argument("--params", type=Path, default=None, help="parameter file; by default the installed config/reality.yaml")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args(args)
    try:
        if given.rollouts < 2:
            raise MagicError(Code.BAD_REQUEST, "--rollouts", given.rollouts, "2 or more")
        path = given.params or Path(get_package_share_directory("magic_verifier")) / "config" / "reality.yaml"
        setting = load_setting(path)
        tosses = read(given.data, setting)
        scores = compare(tosses, setting, given.rollouts, given.seed, given.jobs, lambda text: print(text, flush=True))
    except MagicError as error:
        print(f"reality: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("reality: interrupted", file=sys.stderr)
        sys.exit(130)
    words = {"held_out": "not chosen on", "chosen_on": "chosen on"}
    rows = [
        (f"{words[part]}, {'as recorded' if kind == 'nominal' else f'{given.rollouts} rollouts'}", value)
        for part, kinds in scores.items()
        for kind, value in kinds.items()
    ]
    given.out.mkdir(parents=True, exist_ok=True)
    text = table(rows)
    (given.out / "reality.txt").write_text(text + "\n")
    (given.out / "reality.json").write_text(
        json.dumps({part: {kind: asdict(value) for kind, value in kinds.items()} for part, kinds in scores.items()}, indent=1)
    )
    shown = scores.get("held_out") or scores["chosen_on"]
    diagram(shown["perturbed"], given.out / "reliability.png")
    print(text)
    print(f"written: {given.out}/reality.txt, reality.json, reliability.png")


if __name__ == "__main__":
    main()
