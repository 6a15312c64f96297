"""A verifier node, a client of its action and goals for it, for the tests over ROS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import scenes

from magic_core import conversions as convert
from magic_core import strategy as strategies
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView
from magic_core.testing.served import served


def save(folder, name, goal):
    """Write the strategy of a pull with a goal."""
    strategy, *_ = scenes.hooking("L")
    tetrahedron = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    view = CanonicalView(np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), bool), 0.01, np.eye(4))
    strategies.save(
        replace(strategy, name=name, tool_mesh=tetrahedron, target_mesh=tetrahedron, tool_view=view, target_view=view, goal=goal),
        folder / name,
    )


@contextmanager
def verifier(folder, **parameters) -> Iterator:
    """An action client of a verifier node, in a ROS domain of its own, that has the strategies ``hooking``, ``pulling`` and ``juggling``.

    folder: where these may be written; parameters: of the node, ``{"arm.grip_force": 40.0}``.
    """
    from magic_interfaces.action import VerifyMotion
    from magic_verifier.node import VerifierNode

    save(folder, "hooking", strategies.Goal("hook", {"noise": 1.0}))
    save(folder, "pulling", strategies.Goal("hook", {"noise": 0.0}))
    save(folder, "juggling", strategies.Goal("juggle"))
    with served(VerifierNode, VerifyMotion, "verify_motion", {"strategies": str(folder), **parameters}) as client:
        yield client


def slow_plan():
    """A motion that takes minutes to carry out, and seconds to simulate."""
    *_, plan = scenes.hooking("L")
    motion = plan.tool_motion
    phases = tuple(replace(phase, start=30 * phase.start, end=30 * phase.end) for phase in motion.phases)
    return replace(plan, tool_motion=replace(motion, times=30 * motion.times, phases=phases))


def goal_message(name="hooking", kind="L", tool=None, target=None, plan=None, **fields):
    """A goal that passes (an L hook that pulls), with some of it exchanged."""
    from magic_interfaces.action import VerifyMotion

    _, own_tool, own_target, own_plan = scenes.hooking(kind)
    head = convert.header("panda_link0")
    goal = VerifyMotion.Goal(
        strategy=name,
        tool=convert.object_to_msg(tool or own_tool, head),
        target=convert.object_to_msg(target or own_target, head),
        table=convert.plane_to_msg(scenes.TABLE),
        plan=convert.plan_to_msg(plan or own_plan, own_tool.id),
    )
    for key, value in fields.items():
        setattr(goal, key, value)
    return goal
