"""Whether a verified trajectory may be handed to an arm: only where the arm is known to stand at its start.  No ROS here."""

from __future__ import annotations

import math
from collections.abc import Sequence

from magic_core.errors import Code, MagicError


def check_start(
    names: Sequence[str],
    first: Sequence[float],
    state_names: Sequence[str],
    state_positions: Sequence[float],
    age: float,
    tolerance: float,
    max_age: float,
) -> None:
    """Refuse a trajectory whose start is not where the arm is.

    names, first: joints of the trajectory and their positions at its first point, rad.
    state_names, state_positions: the last joint state, rad; ``age``: how old it is in seconds, infinite where none came
    (negative: of a clock that is ahead).  Raises NO_FRAMES (no joint state), STALE_DATA (older than ``max_age`` or from
    the future) and BAD_MOTION (a joint is missing, not finite, or farther than ``tolerance`` off).
    """
    if not names or len(names) != len(first):
        raise MagicError(
            Code.BAD_MOTION, "trajectory", f"{len(names)} joints, {len(first)} positions at its start", "one position for each joint"
        )
    if math.isinf(age):
        raise MagicError(Code.NO_FRAMES, "joint_states", "none received", f"one not older than {max_age:g} s")
    if not -max_age <= age <= max_age:
        raise MagicError(
            Code.STALE_DATA, "age of joint_states in s", round(age, 3), f"at most {max_age:g}, by its stamp and by its arrival"
        )
    state = dict(zip(state_names, state_positions))
    missing = [name for name in names if name not in state]
    if missing:
        raise MagicError(Code.BAD_MOTION, "joint_states", f"nothing about {', '.join(missing)}", f"positions of {', '.join(names)}")
    gaps = {name: abs(state[name] - position) for name, position in zip(names, first)}
    # What is not a number is never within the tolerance.
    wrong = {name: gap for name, gap in gaps.items() if not gap <= tolerance}
    if wrong:
        name = max(wrong, key=lambda n: wrong[n] if math.isfinite(wrong[n]) else math.inf)
        raise MagicError(
            Code.BAD_MOTION,
            "distance of the arm from the trajectory's start in rad",
            f"{wrong[name]:.4f} at {name}",
            f"at most {tolerance:g} at every joint",
        )
