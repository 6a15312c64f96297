"""A thing's path by all that pictures say of it, moment for moment: an extended Kalman filter on SE(3) with velocities goes forward, a
Rauch-Tung-Striebel smoother back.

A pose is changed at the thing's middle: by a shift, and by a turn about it, both in the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magic_core import transforms

Array = NDArray[np.float64]
#: Spectral densities of a hand's accelerations: m^2/s^3 and rad^2/s^3.  It takes up 0.5 m/s and 3 rad/s within a quarter of a second.
JERKY, TWISTY = 1.0, 36.0
#: ... and shares of these densities that a motion may show by itself: most are quieter.
HASTES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
#: Pictures of so long (s) are wrong together: what cameras take an edge or a face for changes with how they look at it.  So long to either
#: side what two cameras say is compared.
TOGETHER, COMPARED = 0.5, 1.0
#: ... and where there is no second camera to contradict the first, variances are so many times larger than said: as much as they were found
#: to be.
UNCONTRADICTED = 6.0
#: What the reconstructed surface is off by is the same in all moments: standard deviations, m and rad.
SURFACE = (0.003, np.deg2rad(1.0))
#: So few points of the model that are looked through say that the tool is found.
CLEAR = 0.10


@dataclass(frozen=True)
class Seen:
    """What the pictures of a moment say near a pose (4, 4): information (6, 6) and pull (6,), of a change of the pose as :func:`moved`
    takes it; through: share of the model that they look through there; apart: how far apart two cameras, each by itself, say it to be, as a
    chi-squared over its degrees of freedom, not a number where that was not looked at."""

    pose: Array
    information: Array
    pull: Array
    through: float
    apart: float


@dataclass
class State:
    """Pose (4, 4) and velocity (6,): of the middle, and the rotation vector's, in the world; covariance (12, 12)."""

    pose: Array
    velocity: Array
    covariance: Array

    def moved(self, middle: Array, change: Array) -> State:
        """Changed by (12,), at the middle (3,) of the tool, in the tool's frame."""
        return State(moved(self.pose, middle, change[:6]), self.velocity + change[6:], self.covariance)


def moved(pose: Array, middle: Array, change: Array) -> Array:
    """The pose with the tool's middle shifted by change[:3] and the tool turned about it by change[3:]."""
    turned = Rotation.from_rotvec(change[3:]).as_matrix() @ pose[:3, :3]
    centre = transforms.apply(pose, middle) + change[:3]
    return transforms.make(turned, centre - turned @ middle)


def changed(pose: Array, other: Array, middle: Array) -> Array:
    """(6,): what takes ``other`` to ``pose``; the inverse of :func:`moved`."""
    shift = transforms.apply(pose, middle) - transforms.apply(other, middle)
    return np.concatenate([shift, Rotation.from_matrix(pose[:3, :3] @ other[:3, :3].T).as_rotvec()])


def predicted(state: State, middle: Array, step: float, haste: float = 1.0) -> tuple[State, Array]:
    """The state ``step`` seconds later, and the transition (12, 12); haste: share of a hand's accelerations."""
    transition = np.eye(12)
    transition[:6, 6:] = step * np.eye(6)
    density = haste * np.repeat([JERKY, TWISTY], 3)
    noise = np.block(
        [[np.diag(density * step**3 / 3), np.diag(density * step**2 / 2)], [np.diag(density * step**2 / 2), np.diag(density * step)]]
    )
    pose = moved(state.pose, middle, step * state.velocity)
    return State(pose, state.velocity.copy(), transition @ state.covariance @ transition.T + noise), transition


def likeliest(start: State, times: Array, told: Sequence[Seen | None], middle: Array) -> list[State]:
    """The states at the times (T,) by all that was seen, with the haste that what was seen is the likeliest with.

    How well they are known is another question: pictures of TOGETHER seconds are worth one, and the surface is off in all.
    """
    doubts = doubted(times, told)
    _, haste = max((_passed(start, times, told, doubts, middle, haste)[1], haste) for haste in HASTES)
    states, _ = _passed(start, times, told, doubts, middle, haste)
    alike = (np.abs(times[:, None] - times) <= TOGETHER / 2).sum(axis=1)
    known, _ = _passed(start, times, told, doubts * alike, middle, haste)
    off = np.diag(np.concatenate([np.repeat(SURFACE, 3), np.zeros(6)]) ** 2)
    return [State(state.pose, state.velocity, how.covariance + off) for state, how in zip(states, known, strict=True)]


def doubted(times: Array, told: Sequence[Seen | None]) -> Array:
    """By which factor (T,) the variances of what was seen are larger than said.

    What cameras are wrong in together with what they see, smeared edges, another thing taken for the tool, they are wrong in differently:
    how far apart they say it to be, over COMPARED seconds to either side, tells of it.  Where more of the tool is looked through than of
    one that is found, so much less is known.
    """
    apart = np.array([np.nan if seen is None else seen.apart for seen in told])
    looked = (np.abs(times[:, None] - times) <= COMPARED) & np.isfinite(apart)
    count = looked.sum(axis=1)
    pooled = np.divide(looked @ np.nan_to_num(apart), count, out=np.full(len(times), UNCONTRADICTED), where=count > 0)
    through = np.array([0.0 if seen is None else seen.through for seen in told])
    return np.maximum(pooled, 1.0) * np.maximum(through / CLEAR, 1.0) ** 2


def _passed(
    start: State, times: Array, told: Sequence[Seen | None], doubts: Array, middle: Array, haste: float
) -> tuple[list[State], float]:
    """The states by all that was seen with a haste, and the logarithm of how likely that is, but for what does not depend on the haste."""
    state, likely = start, 0.0
    after: list[State] = []
    before: list[tuple[State, Array]] = []
    for step, seen, doubt in zip(np.diff(times, prepend=times[0]), told, doubts, strict=True):
        expected, transition = predicted(state, middle, float(step), haste)
        state = expected
        if seen is not None:
            information, pull = seen.information / doubt, seen.pull / doubt
            off = changed(seen.pose, expected.pose, middle)
            prior = np.linalg.inv(expected.covariance)
            matrix, vector = prior.copy(), np.zeros(12)
            matrix[:6, :6] += information
            vector[:6] = information @ off + pull
            change = np.linalg.solve(matrix, vector)
            corrected = expected.moved(middle, change)
            state = State(corrected.pose, corrected.velocity, np.linalg.inv(matrix))
            likely += (vector @ change - off @ information @ off) / 2 - pull @ off
            likely += (np.linalg.slogdet(prior)[1] - np.linalg.slogdet(matrix)[1]) / 2
        after.append(state)
        before.append((expected, transition))
    return _smoothed(after, before, middle), float(likely)


def _smoothed(after: list[State], before: list[tuple[State, Array]], middle: Array) -> list[State]:
    """The states with what later frames say of them."""
    result = [after[-1]]
    for k in range(len(after) - 2, -1, -1):
        expected, transition = before[k + 1]
        gain = after[k].covariance @ transition.T @ np.linalg.inv(expected.covariance)
        later = result[-1]
        off = np.concatenate([changed(later.pose, expected.pose, middle), later.velocity - expected.velocity])
        covariance = after[k].covariance + gain @ (later.covariance - expected.covariance) @ gain.T
        corrected = after[k].moved(middle, gain @ off)
        result.append(State(corrected.pose, corrected.velocity, (covariance + covariance.T) / 2))
    return result[::-1]
