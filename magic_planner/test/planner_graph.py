"""A planner node, a client of its action and goals for it, for the tests over ROS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import planner_scenes as scenes

from magic_core import strategy as strategies
from magic_core.testing.served import served

DEADLINE = 20.0


@contextmanager
def planner(folder, **parameters) -> Iterator:
    """An action client of a planner node, both in a domain of their own, that has the strategy ``pulling``; folder: where that may
    be written."""
    from magic_interfaces.action import PlanMotion
    from magic_planner.node import PlannerNode

    strategies.save(scenes.pulling(), folder / "pulling")
    with served(PlannerNode, PlanMotion, "plan_motion", {"strategies": str(folder), **parameters}) as client:
        yield client


def goal(tool=None, target=None, **changes):
    """A goal that can be planned, with some of it exchanged."""
    from magic_core import conversions as convert
    from magic_interfaces.action import PlanMotion

    lying, tool_contact = scenes.hook()
    standing, target_contact = scenes.standing_cylinder()
    head = convert.header("panda_link0")
    message = PlanMotion.Goal(strategy="pulling", variant="arm", reflection="keep", timeout=10.0)
    message.tool = convert.object_to_msg(tool or lying, head)
    message.target = convert.object_to_msg(target or standing, head)
    message.candidate = convert.candidate_to_msg(scenes.candidate(lying, tool_contact, target_contact))
    for name, value in changes.items():
        setattr(message, name, value)
    return message
