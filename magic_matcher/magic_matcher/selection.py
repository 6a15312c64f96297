"""Which objects of a scene a request means: its tools and its target, named or chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core.errors import Code, MagicError
from magic_core.scene import CanonicalView, Scene, SceneObject
from magic_core.strategy import Strategy
from magic_matcher.targets import target_view

#: What is as like the demonstrated target as the likest thing, to this share, may as well be meant.
ALIKE = 0.9


def select(
    scene: Scene,
    strategy: Strategy,
    tool_ids: Sequence[str],
    target_id: str,
    seen: Callable[[SceneObject, Strategy], CanonicalView] = target_view,
) -> tuple[list[SceneObject], SceneObject]:
    """The tools and the target that a request names, or that are meant by naming none; seen: as for :func:`choose_target`.

    No tool: every object that was seen by the cameras, but the target; where there is
    none of them, every other object.  No target: the one most like the demonstration's
    among the objects not named as tools.  What was seen in part is no tool: left out where
    tools are chosen; ``OBJECT_CUT_OFF`` where one is named, or none is left.  Raises
    ``SOMETHING_HANGS`` where something is above the table with nothing below that
    carries it: nothing is planned around a hand.
    """
    hanging = [item for item in scene.objects if item.hanging]
    if hanging:
        places = (f"{item.id} at ({', '.join(f'{x:.2f}' for x in item.world_from_box[:3, 3])}) m" for item in hanging)
        raise MagicError(
            Code.SOMETHING_HANGS,
            "something hangs above the table, with nothing below that carries it",
            ", ".join(places),
            "nothing there: hands away; an arm that the cameras see is cut out where its joint_states are there and fit",
        )
    named = [scene.find(name) for name in tool_ids]
    for item in named:
        if item.cut_off:
            raise _cut_off([item])
    if target_id:
        target = scene.find(target_id)
    else:
        rest = [item for item in scene.objects if item.id not in set(tool_ids)]
        if not rest:
            raise MagicError(
                Code.UNKNOWN_OBJECT, "objects left to be the target", 0, "name a target_id, or have one more object on the table"
            )
        target = choose_target(strategy, rest, seen)
    if target.id in set(tool_ids):
        raise MagicError(Code.BAD_REQUEST, "target_id", target.id, "an object that is not one of tool_ids")
    if named:
        return named, target
    others = [item for item in scene.objects if item.id != target.id]
    tools = [item for item in others if item.source != "known"] or others
    if not tools:
        raise MagicError(Code.UNKNOWN_OBJECT, "objects to use as the tool", 0, f"at least one besides the target {target.id}")
    whole = [item for item in tools if not item.cut_off]
    if not whole:
        raise _cut_off(tools)
    return whole, target


def choose_target(
    strategy: Strategy, objects: Sequence[SceneObject], seen: Callable[[SceneObject, Strategy], CanonicalView] = target_view
) -> SceneObject:
    """The object that looks most like the demonstration's target, seen as the target is, in shape and size; seen: what draws it
    (:func:`target_view`)."""
    return alike(strategy, objects, seen)[0]


def alike(
    strategy: Strategy, objects: Sequence[SceneObject], seen: Callable[[SceneObject, Strategy], CanonicalView] = target_view
) -> list[SceneObject]:
    """The objects of which each may as well be the target (:data:`ALIKE`), the one most like the demonstration's first; raises
    UNKNOWN_OBJECT for none."""
    if not objects:
        raise MagicError(Code.UNKNOWN_OBJECT, "objects to choose the target from", 0, "at least one")

    def like(item: SceneObject) -> float:
        try:
            return likeness(strategy.target_view, seen(item, strategy))
        except MagicError:  # what cannot be drawn as the target was (a mesh that is not closed has no cut) is not like it
            return -1.0

    found = sorted(((like(item), -index) for index, item in enumerate(objects)), reverse=True)
    best = found[0][0]
    return [objects[-index] for value, index in found if value >= best - (1 - ALIKE) * abs(best)]


def likeness(reference: CanonicalView, view: CanonicalView) -> float:
    """How alike two silhouettes are, 0..1: overlap of the outlines at equal size, best of four turns, times the ratio of their sizes."""

    def crop(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        v, u = np.nonzero(mask)
        if len(v) == 0:
            raise MagicError(Code.EMPTY_MASK, "pixels of the view that are on the object", 0, "at least 16")
        side = max(int(np.ptp(v)), int(np.ptp(u))) + 1
        square = np.zeros((side, side), np.uint8)
        top, left = (side - int(np.ptp(v)) - 1) // 2, (side - int(np.ptp(u)) - 1) // 2
        part = mask[v.min() : v.max() + 1, u.min() : u.max() + 1]
        square[top : top + part.shape[0], left : left + part.shape[1]] = part
        return cv2.resize(square, (64, 64), interpolation=cv2.INTER_AREA) > 0

    def extent(item: CanonicalView) -> float:
        return float(np.sqrt(item.mask.sum())) * item.metres_per_pixel

    a, b = crop(reference.mask), crop(view.mask)
    overlap = max(float((a & t).sum() / (a | t).sum()) for t in (np.rot90(b, k) for k in range(4)))
    sizes = sorted((extent(reference), extent(view)))
    return overlap * (sizes[0] / max(sizes[1], 1e-12))


def _cut_off(tools: Sequence[SceneObject]) -> MagicError:
    """Why these cannot be tools."""
    told = "; ".join(f"{item.id}, cut off by {' and '.join(item.cut_off)}" for item in tools)
    return MagicError(Code.OBJECT_CUT_OFF, "tool seen in part only", told, "a thing that is seen whole: move it, or what hides it")
