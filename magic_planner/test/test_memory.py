"""What planning keeps: nothing of a request beyond it, and of what it has worked out no more than so many bytes."""

from __future__ import annotations

import gc
import logging
import weakref

import numpy as np
import planner_scenes as scenes
from hypothesis import given
from hypothesis import strategies as st

from magic_core.recent import Recent
from magic_planner import collision, timing
from magic_planner.object_motion import plan_tool_motion


def planned() -> list[weakref.ref]:
    """Plan a motion; the arrays of its request that still live when it is over."""
    tool, tool_contact = scenes.hook()
    target, target_contact = scenes.standing_cylinder()
    arrays = [weakref.ref(piece.vertices) for item in (tool, target) for piece in (item.mesh, *item.pieces)]
    plan_tool_motion(scenes.pulling(), tool, target, scenes.candidate(tool, tool_contact, target_contact))
    del tool, target
    gc.collect()
    return [array for array in arrays if array() is not None]


def test_the_arrays_of_a_request_do_not_outlive_it_and_equal_ones_have_known_hulls():
    planned()
    before = len(collision._HULLS), len(collision._EQUAL_HULLS), len(collision._SOLIDS)
    assert planned() == []
    assert (len(collision._HULLS), len(collision._EQUAL_HULLS), len(collision._SOLIDS)) == before


def test_timing_leaves_no_handler_in_the_logger_of_its_library():
    path = np.linspace(np.zeros(7), np.full(7, 0.3), 5)
    limits = timing.Limits(np.ones(7), np.ones(7), np.full(7, 20.0))
    timing.parameterise(path, limits, 0.02)  # the library has its own when it is imported
    before = list(logging.getLogger("toppra").handlers)
    timing.parameterise(path, limits, 0.02)
    assert logging.getLogger("toppra").handlers == before


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(1, 60)), max_size=40))
def test_what_is_kept_is_what_was_used_last_up_to_its_bytes(asked):
    """Against a list of the keys in the order in which they were last asked for."""
    recent: Recent[int, int] = Recent(100)
    order: list[tuple[int, int]] = []
    for key, size in asked:
        known = dict(order)
        assert recent.get(key) == known.get(key)
        if key not in known:
            recent.put(key, size, size)
        order = [entry for entry in order if entry[0] != key] + [(key, known.get(key, size))]
        while len(order) > 1 and sum(size for _, size in order) > 100:
            order.pop(0)
        assert len(recent) == len(order) and recent.held == sum(size for _, size in order)
