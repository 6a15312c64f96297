"""Strategies of everyday handling, each from one demonstration with a mallet or an L hook.

pushing       a block is pushed away along the table, straight, by the side of a handle.
tipping       a block that stands on its end is tipped over by a push near its top.
pressing      a peg is pressed into a slot that holds it back.
reaching      a thing that is far away is touched, and stays where it is.
shunting      a block is pushed away with the outside of an L hook's tip, then pulled back and nearer with its inside.
cornering     a block is taken between the head and the handle of a mallet, by two of its sides at once, and brought nearer and to the side.
ring_pulling  a ring that lies on the table is pulled nearer by its inside, with the tip of an L hook that stands upright in it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from magic_bringup.demonstrating import demonstrated, made_of, target_contact, target_view, through, unseen
from magic_bringup.striking import DOWN, PEG, REFERENCE, slot_fixture
from magic_core import transforms
from magic_core.goal import shipped
from magic_core.placement import pairs_of
from magic_core.shapes import Shape, make
from magic_core.shapes.fixtures import pose_data
from magic_core.strategy import ContactPair, Goal, Physics, Strategy, Waypoint

#: The side on which the tool acts: that of the robot, which pushes away.
NEAR_SIDE = np.array([-1.0, 0.0, 0.0])
OUTWARDS = -NEAR_SIDE
#: Tools that have a straight side: of the demonstration's kind, and others.
STRAIGHT = {
    "own": {"each": [f"mallet:{{}},form={form}" for form in "TLX"] + ["hammer:{}"], "first": 70_000, "count": 12},
    "unseen": unseen("caliper", "hammer", "mallet", "l_hook"),
}


def _pushed(name: str, description: str, target: Shape, x: float, waypoints: tuple[Waypoint, ...], goal: Goal, **more: Any) -> Strategy:
    """A mallet that lies acts by its handle's side on the near side of a target that stands at x (m)."""
    tool = make("mallet", 0, **REFERENCE)
    view = tool.view("top")
    seen = target_view(target, "top", DOWN)
    low = target.mesh.bounds[0]
    touched = target_contact(seen, np.array([low[0], 0.0, 0.0]), NEAR_SIDE, more.pop("radius", float("inf")))
    times, contacts = through(waypoints)
    environment = {
        "world_from_target": pose_data(transforms.make(translation=[x, 0.0, -float(low[2])])),
        "tool": made_of(tool),
        "target": made_of(target),
        "evaluation": {"sets": STRAIGHT, "targets": more.pop("targets", ["demonstration"])},
    }
    if "fixtures" in more:
        environment["fixtures"] = more.pop("fixtures")
    return Strategy(
        name=name,
        description=description,
        view="top",
        mode="plan",
        **demonstrated(tool, view, tool.contact("side", view), target, seen, touched, NEAR_SIDE, DOWN, times, contacts),
        waypoints=waypoints,
        goal=goal,
        physics=Physics(friction=0.3, tool_density=600.0, target_density=600.0),
        environment=environment,
    )


def _way(through_by: float, up: float = 0.0) -> tuple[Waypoint, ...]:
    """From above to behind the target, into touch, on by some metres and away; ``up`` (m) above the target's middle."""
    return (
        Waypoint("above", np.array([0.05, 0, -0.12 - up]), "approach"),
        Waypoint("behind", np.array([0.05, 0, -up]), "approach"),
        Waypoint("touch", np.array([0.0, 0, -up]), "contact", 0.05),
        Waypoint("through", np.array([-through_by, 0, -up]), "goal"),
        Waypoint("clear", np.array([0.03 - through_by, 0, -up]), "retreat"),
        Waypoint("up", np.array([0.03 - through_by, 0, -0.12 - up]), "retreat"),
    )


def pushing() -> Strategy:
    """A block is pushed 0.18 m away."""
    return _pushed(
        "pushing",
        "The side of a mallet's handle pushes a block away along the table.",
        make("block", 0, length=0.06, breadth=0.08, height=0.05),
        0.42,
        _way(0.18),
        shipped("push"),
        targets=["block:1", "block:2", "block:3"],
    )


def tipping() -> Strategy:
    """A block of 120 mm that stands on its end falls over."""
    return _pushed(
        "tipping",
        "The side of a mallet's handle tips a standing block over.",
        make("block", 0, length=0.03, breadth=0.06, height=0.12),
        0.5,
        _way(0.07, up=0.035),
        shipped("tip"),
        targets=["demonstration", "block:1,length=0.035,height=0.11", "block:2,length=0.028,height=0.13"],
    )


def pressing() -> Strategy:
    """A peg is pressed 40 mm into a slot, against 8 N."""
    return _pushed(
        "pressing",
        "The side of a mallet's handle presses a peg into a slot.",
        make("peg", 0, **PEG),
        0.55,
        _way(0.04),
        shipped("press"),
        fixtures=[slot_fixture()],
    )


def reaching() -> Strategy:
    """A cylinder that is far away is touched with a push of 6 mm."""
    return _pushed(
        "reaching",
        "The side of a mallet's handle touches a cylinder and leaves it where it is.",
        make("cylinder", 0, radius=0.03, half_height=0.03),
        0.7,
        _way(0.006),
        shipped("reach"),
        radius=0.03,
        targets=["cylinder:0.025", "cylinder:0.03", "cylinder:0.035"],
    )


def ring_pulling() -> Strategy:
    """A ring is pulled by 0.25 m."""
    tool = make("l_hook", 0, length=0.25, tip=0.045, width=0.014, thickness=0.014, inner_radius=0.012, bend=np.pi / 2)
    target = make("ring", 0, radius=0.045, width=0.012, height=0.03)
    tool_view = tool.view("side")  # level shaft, the tip down
    tool_contact = tool.contact("tip_inner", tool_view)
    direction, normal = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    seen = target_view(target, "section", direction)
    inside = np.array([-(0.045 - 0.006), 0.0, 0.0])
    touched = target_contact(seen, inside, normal, float("inf"))
    waypoints = (
        Waypoint("above", np.array([0.03, 0.12, 0.0]), "approach"),
        Waypoint("in_it", np.array([0.03, 0.0, 0.0]), "approach"),
        Waypoint("touch", np.zeros(3), "contact", 0.05),
        Waypoint("pulled", np.array([-0.25, 0.0, 0.0]), "goal"),
        Waypoint("clear", np.array([-0.235, 0.0, 0.0]), "retreat"),
        Waypoint("up", np.array([-0.235, 0.12, 0.0]), "retreat"),
    )
    times, contacts = through(waypoints)
    return Strategy(
        name="ring_pulling",
        description="The tip of an L hook that stands upright in a ring pulls it nearer.",
        view="side",
        mode="plan",
        **demonstrated(tool, tool_view, tool_contact, target, seen, touched, normal, direction, times, contacts),
        waypoints=waypoints,
        target_outline="cut",
        goal=shipped("hook", noise=0.0),
        physics=Physics(friction=0.3, tool_density=600.0, target_density=600.0),
        environment={
            "world_from_target": pose_data(transforms.make(translation=[0.68, 0.0, 0.015])),
            "tool": made_of(tool),
            "target": made_of(target),
            "evaluation": {
                "sets": {
                    "own": {"each": ["l_hook:{}", "j_hook:{}", "hammer:{}"], "first": 70_000, "count": 9},
                    "unseen": unseen("l_hook", "j_hook"),
                },
                "targets": ["ring:1", "ring:2", "ring:3"],
            },
        },
    )


def shunting() -> Strategy:
    """A block is pushed away by 60 mm, then pulled back by 160 mm: two contacts, one after the other."""
    tool = make("l_hook", 0, length=0.25, tip=0.07, width=0.02, thickness=0.018, inner_radius=0.012, bend=np.pi / 2)
    target = make("block", 0, length=0.04, breadth=0.05, height=0.04)
    tool_view = tool.view("top")
    inside = tool.contact("tip_inner", tool_view)
    middle, across = inside.object_from_contact[:3, 3], inside.object_from_contact[:3, 0]
    outside = target_contact(tool_view, middle - 0.02 * across, -across, float("inf"))
    seen = target_view(target, "top", DOWN)
    far, near = (target_contact(seen, np.array([x, 0.0, 0.0]), np.sign(x) * OUTWARDS, float("inf")) for x in (0.02, -0.02))
    pushed = -0.06
    waypoints = (
        Waypoint("above", np.array([0.05, 0, -0.12]), "approach", contact="outside"),
        Waypoint("before", np.array([0.05, 0, 0]), "approach", contact="outside"),
        Waypoint("touch", np.array([0.0, 0, 0]), "contact", 0.05, "outside"),
        Waypoint("pushed", np.array([pushed, 0, 0]), "push", 0.1, "outside"),
        Waypoint("apart", np.array([pushed + 0.03, 0, 0]), "over", 0.1, "outside"),
        Waypoint("lifted", np.array([pushed + 0.03, 0, -0.12]), "over", 0.1, "outside"),
        Waypoint("beyond", np.array([0.03 - pushed, 0, -0.12]), "over"),
        Waypoint("behind", np.array([0.03 - pushed, 0, 0]), "over"),
        Waypoint("met", np.array([-pushed, 0, 0]), "goal", 0.05),
        Waypoint("pulled", np.array([-0.1, 0, 0]), "goal"),
        Waypoint("clear", np.array([-0.07, 0, 0]), "retreat"),
        Waypoint("up", np.array([-0.07, 0, -0.12]), "retreat"),
    )
    frames = {"outside": (near.object_from_contact, outside.object_from_contact)}
    times, contacts = through(waypoints, pairs_of((far.object_from_contact, inside.object_from_contact), frames))
    return Strategy(
        name="shunting",
        description="The outside of an L hook's tip pushes a block away, then its inside pulls the block nearer.",
        view="top",
        mode="plan",
        **demonstrated(tool, tool_view, inside, target, seen, far, OUTWARDS, DOWN, times, contacts),
        contacts=(ContactPair("outside", outside, near, NEAR_SIDE),),
        waypoints=waypoints,
        goal=shipped("shunt"),
        physics=Physics(friction=0.3, tool_density=600.0, target_density=600.0),
        environment={
            "world_from_target": pose_data(transforms.make(translation=[0.55, 0.0, 0.02])),
            "tool": made_of(tool),
            "target": made_of(target),
            "evaluation": {
                "sets": {
                    "own": {"each": ["l_hook:{}", "j_hook:{}", "hammer:{}"], "first": 70_000, "count": 12},
                    "unseen": unseen("l_hook", "j_hook"),
                },
            },
        },
    )


def cornering() -> Strategy:
    """A block is brought 0.12 m nearer and 0.08 m to the side: two contacts at once."""
    tool = make("mallet", 0, form="L", handle=0.25, width=0.022, thickness=0.018, head=0.1, head_width=0.03, head_depth=0.03)
    target = make("block", 0, length=0.04, breadth=0.05, height=0.04)
    tool_view = tool.view("top")
    # The inner face of the head, across x, and the side of the handle that it stands out from, across y.
    inner, side = float(tool.mesh.bounds[1, 0]) - 0.03, float(tool.mesh.bounds[1, 1]) - 0.022
    head = target_contact(tool_view, np.array([inner, side - 0.025, 0.0]), NEAR_SIDE, float("inf"))
    handle = target_contact(tool_view, np.array([inner - 0.02, side, 0.0]), np.array([0.0, -1.0, 0.0]), float("inf"))
    seen, left = target_view(target, "top", DOWN), np.array([0.0, 1.0, 0.0])
    far = target_contact(seen, 0.02 * OUTWARDS, OUTWARDS, float("inf"))
    flank = target_contact(seen, 0.025 * left, left, float("inf"))
    waypoints = (
        Waypoint("above", np.array([0.04, -0.04, -0.12]), "approach"),
        Waypoint("behind", np.array([0.04, -0.04, 0.0]), "approach"),
        Waypoint("touch", np.zeros(3), "contact", 0.05),
        Waypoint("brought", np.array([-0.12, 0.08, 0.0]), "goal"),
        Waypoint("clear", np.array([-0.09, 0.05, 0.0]), "retreat"),
        Waypoint("up", np.array([-0.09, 0.05, -0.12]), "retreat"),
    )
    times, contacts = through(waypoints)
    return Strategy(
        name="cornering",
        description="A mallet's head and handle take a block by two sides at once and bring it nearer and to the side.",
        view="top",
        mode="plan",
        **demonstrated(tool, tool_view, head, target, seen, far, OUTWARDS, DOWN, times, contacts),
        contacts=(ContactPair("flank", handle, flank, left),),
        waypoints=waypoints,
        # What is led by both sides keeps its handedness: mirrored, a tool has to be turned over.
        reflections=("turn",),
        goal=shipped("bring"),
        physics=Physics(friction=0.3, tool_density=600.0, target_density=600.0),
        environment={
            "world_from_target": pose_data(transforms.make(translation=[0.6, 0.04, 0.02])),
            "tool": made_of(tool),
            "target": made_of(target),
            "evaluation": {
                "sets": {
                    "own": {"each": ["mallet:{},form=L", "mallet:{},form=T", "hammer:{}", "caliper:{}"], "first": 70_000, "count": 12},
                    "unseen": unseen("mallet", "hammer", "caliper", "l_hook"),
                },
                "targets": ["demonstration", "block:1,height=0.04", "block:2,height=0.04"],
                "near_misses": ["letter:60001,glyph=I", "cylinder:0.04", "sphere:0.04"],
            },
        },
    )


STRATEGIES = {
    "cornering": cornering,
    "shunting": shunting,
    "pushing": pushing,
    "tipping": tipping,
    "pressing": pressing,
    "reaching": reaching,
    "ring_pulling": ring_pulling,
}
