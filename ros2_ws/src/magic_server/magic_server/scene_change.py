"""Whether the objects are still where a plan believes them.  No ROS here."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject


def _directions(count: int = 200) -> NDArray[np.float64]:
    """Unit vectors (count, 3), evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(count)
    z = 1 - 2 * (k + 0.5) / count
    turn = np.pi * (1 + 5**0.5) * k
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


DIRECTIONS = _directions()
#: Makes of how much farther a hull reaches along each of ``DIRECTIONS`` the shift (3,) that explains it best.
EXPLAINS = np.linalg.pinv(DIRECTIONS)
#: A thing may have been shifted by this share of what any of its points may be elsewhere by.  Its outline comes out otherwise with each
#: look, by 5.2 mm at most of 45 pairs of looks at tools and targets (of 30 that nothing was set by: 2.2); where it is as a whole by 1.3
#: (1.2).  Verified motions failed in up to half of the cases where the target had been shifted by 15 to 19 mm, and in none up to 10.
SHIFTED = 0.5
#: What is seen of a tool in the hand, with what is left of the hand at its edges, reaches so far beyond the tool at most, m.
ABOUT = 0.1


def hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far points (N, 3) m reach along each of ``DIRECTIONS``: the support function of their convex hull; NaN without points."""
    return (points @ DIRECTIONS.T).max(axis=0) if len(points) else np.full(len(DIRECTIONS), np.nan)


def hulls(objects: Iterable[SceneObject]) -> dict[str, NDArray[np.float64]]:
    """The hull of each object in the world, by its id."""
    return {o.id: hull(transforms.apply(o.world_from_object, o.mesh.vertices)) for o in objects}


def distance(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """How far an object has moved, m: the Hausdorff distance of two :func:`hull`.

    It does not depend on how the object's own frame and mesh were chosen, which another look may choose otherwise.
    """
    return float(np.abs(before - after).max())


class Changed(MagicError):
    """Target or obstacles are elsewhere: another look at them, and another plan, may help."""


def contained(inner: NDArray[np.float64], outer: NDArray[np.float64], margin: float) -> bool:
    """Whether one :func:`hull` lies within another that is grown by ``margin`` m; never where one is not a number."""
    return bool((inner <= outer + margin).all())


def gap(before: NDArray[np.float64], after: NDArray[np.float64], partly: bool) -> float:
    """How far an object has moved at least, m.  Of one that is seen in part only by how much it sticks out of where it was."""
    return float(np.maximum((after - before).max(), 0.0)) if partly else distance(before, after)


def shift(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """How far an object as a whole has been shifted, m, by two :func:`hull`: what errors of its outline all around hardly change."""
    return float(np.linalg.norm(EXPLAINS @ (after - before)))


def beyond(before: NDArray[np.float64], after: NDArray[np.float64], partly: bool, tolerance: float) -> tuple[float, float] | None:
    """How far an object has moved, m, and how far it may, where that is less; ``None`` where it stands where it stood.

    No point of it may be elsewhere by more than ``tolerance``, and all of it by no more than :data:`SHIFTED` of that.  ``partly``: as
    :func:`gap` has it.
    """
    found = [(gap(before, after, partly), tolerance)]
    if not partly:
        found.append((shift(before, after), SHIFTED * tolerance))
    return next((one for one in found if not one[0] <= one[1]), None)


def parts(
    before: Mapping[str, NDArray[np.float64]], after: Mapping[str, NDArray[np.float64]], partly: Collection[str], tolerance: float
) -> dict[str, set[str]]:
    """Of what is hidden in part (``partly``, ids) and was not there before under its id: the ids of the things before within whose hull, to
    ``tolerance`` m, it lies.  What hides the middle of a thing leaves two, and what is left in sight of one may have another id."""
    return {
        name: found
        for name in after.keys() - before.keys()
        if name in partly and (found := {thing for thing, there in before.items() if contained(after[name], there, tolerance)})
    }


def check(
    before: Mapping[str, NDArray[np.float64]],
    after: Mapping[str, NDArray[np.float64]],
    tolerance: float,
    meant: Collection[str] = (),
    partly: Collection[str] = (),
    carried: NDArray[np.float64] | None = None,
    remembered: Collection[str] = (),
) -> None:
    """Refuse a scene in which an object is gone, has come, or has moved (:func:`beyond` ``tolerance`` m); raises :class:`Changed`.

    before, after: hulls by id.  meant: ids of what has been moved on purpose since, which may be anywhere.  partly, remembered: ids of
    what the arm, or what it carries, hides a part of now that was seen before, and all of.  carried: hull of the tool when ``after`` was
    seen, in the hand or where that let it go: what has come within :data:`ABOUT` of it is the tool, by whatever id.
    """
    there = parts(before, after, partly, tolerance)
    old, new = before.keys() - set(meant), after.keys() - set(meant) - there.keys()
    if carried is not None:
        new = {name for name in new if name in old or not contained(after[name], carried, ABOUT)}
    hidden = set(remembered).union(*there.values())
    for what, ids in (("gone since the plan", old - new - hidden), ("come since the plan", new - old)):
        if ids:
            raise Changed(Code.STALE_DATA, f"objects {what}", ", ".join(sorted(ids)), ", ".join(sorted(before)))
    for name in sorted(old & new):
        moved = beyond(before[name], after[name], name in partly, tolerance)
        if moved is not None:
            found, allowed = moved
            raise Changed(Code.STALE_DATA, f"{name} has moved since the plan, in mm", round(1000 * found, 1), f"at most {1000 * allowed:g}")
