"""How sure a success rate is: its interval, and when so many rollouts have decided whether it reaches what is required."""

from __future__ import annotations

import math
from statistics import NormalDist

#: Two-sided 95 % of the normal distribution.
Z95 = NormalDist().inv_cdf(0.975)


def wilson(successes: int, count: int, z: float = Z95) -> tuple[float, float]:
    """The Wilson score interval of a success rate, 95 % unless told otherwise; (0, 1) of no trials."""
    if count == 0:
        return 0.0, 1.0
    share = successes / count
    centre = share + z * z / (2 * count)
    half = z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    scale = 1 + z * z / count
    return max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)


def level(tried: int) -> float:
    """The level of a motion's interval, where so many motions for the same task were tried before it: each try shares the 5 % that an
    interval may be wrong by (Bonferroni), as one of many that fail now and then is found to pass by chance."""
    return 1 - 0.05 / (1 + tried)


def deviations(tried: int) -> float:
    """As many standard deviations of the normal distribution as reach to either side to enclose :func:`level`."""
    return NormalDist().inv_cdf((1 + level(tried)) / 2)


def decided(successes: int, count: int, most: int, required: float, z: float = Z95) -> bool:
    """Whether no further rollout is needed: the interval lies on one side of the required rate, or can no more come above it."""
    low, high = wilson(successes, count, z)
    return low >= required or high < required or wilson(successes + most - count, most, z)[0] < required


def passes(successes: int, count: int, required: float, z: float = Z95) -> bool:
    """Whether a success rate is shown to be no lower than required."""
    return successes > 0 and wilson(successes, count, z)[0] >= required


def fewest(required: float, tried: int = 0) -> int:
    """With how many rollouts, none of which fails, a success rate is shown to be no lower than required, after so many motions that were
    simulated for the same task before: given to :func:`magic_verifier.verification.verify_proposal` as the most there may be, one that
    fails is a no."""
    count = 1
    while not passes(count, count, required, deviations(tried)):
        count += 1
    return count
