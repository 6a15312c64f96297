"""The score of a contact analogy: s_dino + lambda * s_curv.

The paper defines s_curv = |r(p_T) / r(p_O) - r(p_T') / r(p_O')|, a difference, and adds it,
times lambda, to a similarity; it gives neither lambda's value nor its sign.  As it stands
that form has three defects: it grows with the mismatch, so that lambda would have to be
negative; it is not symmetric (a ratio of 4 instead of 2 counts 2, a ratio of 1 instead of
2 counts 1, though both are off by a factor of two); and a straight edge makes it infinite.

Here with q = r(p_T) / r(p_O) and q' = r(p_T') / r(p_O')

    s_curv = exp(-|log(q / q')|) = min(q, q') / max(q, q')    in 0..1,

1 where the ratios agree, 0.5 where they are off by a factor of two either way, 0 for a
straight edge against a bent one, 1 for two straight edges.  It does not change when tool
and target grow together.  A convex contact never stands in for a concave one: s_curv is
then 0.  Being a similarity it is added with lambda > 0.  Where no target is known, r(p_O)
is replaced by the size of the tool, for both tools alike.
"""

from __future__ import annotations

import math

#: lambda.  Chosen on the procedural training families, see docs/features.md.
LAMBDA = 0.1


def curvature_score(reference_ratio: float, ratio: float, same_sign: bool = True) -> float:
    """s_curv in 0..1 of two ratios r(p_T) / r(p_O), each > 0 or inf."""
    if not same_sign:
        return 0.0
    low, high = sorted((reference_ratio, ratio))
    if math.isinf(high) or high <= 0:
        return 1.0 if low == high else 0.0
    return max(low, 0.0) / high


def combine(s_dino: float, s_curv: float, weight: float = LAMBDA) -> float:
    """The score by which candidates are ranked."""
    return s_dino + weight * s_curv
