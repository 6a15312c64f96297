"""The two tasks of the paper's Table V (KETO's): hammering, and pushing, here sweeping.

hammering  a peg lies in a slot and resists.  A mallet is swung in the plane of the table, about a hand and forearm's length behind its
           handle, and strikes the peg's end with its face.  The hand holds it loosely: from just before the blow the tool flies by
           its own momentum (phase ``strike``), so that what drives the peg is the tool's mass, where it is and how it hits.  Goal
           ``drive``.
sweeping   several cylinders stand side by side; the mallet's handle, lying, sweeps them away from the robot.  Goal ``sweep``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from magic_bringup.demonstrating import demonstrated, made_of, target_contact, target_view, through
from magic_core import transforms
from magic_core.contact import OPPOSED, Contact
from magic_core.goal import shipped
from magic_core.shapes import Shape, make
from magic_core.shapes.fixtures import pose_data
from magic_core.strategy import Physics, Strategy, Waypoint

#: Table V's: hammers (T, L and X of two blocks, and real-looking ones) and things that are none.
HAMMERS = ["mallet:{},form=T", "mallet:{},form=L", "mallet:{},form=X", "hammer:{}"]
NON_HAMMERS = ["caliper:{}", "scissors:{}", "j_hook:{}", "plain_bar:{}", "plain_bottle:{}", "plain_driver:{}"]
SETS = {
    name: {"each": each, "first": 70_000, "count": 24}
    for name, each in (("own", [*HAMMERS, *NON_HAMMERS]), ("hammers", HAMMERS), ("non_hammers", NON_HAMMERS))
}
DOWN = np.array([0.0, 0.0, -1.0])
#: The demonstrated tool: a T of a wooden handle and a block.
REFERENCE = {
    "form": "T", "handle": 0.24, "width": 0.022, "thickness": 0.02, "head": 0.10, "head_width": 0.032, "head_depth": 0.03,
}  # fmt: skip
#: The peg, how far it stands out of its slot (m), and the slot; play of 1 mm to each side.
PEG = {"length": 0.12, "side": 0.024}
OUT = 0.08
SLOT = {"length": 0.12, "gap": 0.026, "height": 0.026, "wall": 0.02}
#: The swing: radius from the hand's elbow to the face (m), speed of turning at the blow (rad/s), angle of the swing and of the
#: follow-through (rad), gap at which the hand only guides (m).
RADIUS, TURNING, SWING, THROUGH, GAP = 0.55, 2.2, 0.7, 0.2, 0.003
#: Sampling of the swing (s).
SAMPLE = 0.01
#: The row that is swept: radius and half height of its cylinders (m).
SWEPT = 0.02


def _tool(region: str) -> tuple[Shape, Any, Contact]:
    tool = make("mallet", 0, **REFERENCE)
    view = tool.view("top")
    return tool, view, tool.contact(region, view)


def swing(side: float) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[Waypoint, ...]]:
    """Times (T,), target_contact_from_tool_contact (T, 4, 4) and waypoints of a swing whose elbow is on the ``side`` (-1, 1) of the
    contact frame's y: turning faster and faster up to the blow, then slowing down."""
    speeding, slowing = 2 * SWING / TURNING, 2 * THROUGH / TURNING
    blow = speeding - GAP / (RADIUS * TURNING)
    times = np.unique(np.concatenate([np.arange(0.0, speeding + slowing, SAMPLE), [blow, speeding, speeding + slowing]]))
    before = SWING * (times / speeding) ** 2 - SWING
    after = THROUGH * (1 - (1 - (times - speeding) / slowing) ** 2)
    angle = -side * np.where(times <= speeding, before, after)
    elbow = np.array([0.0, side * RADIUS, 0.0])
    contacts = np.stack(
        [
            transforms.make(translation=elbow) @ transforms.from_rotvec([0, 0, a]) @ transforms.make(translation=-elbow) @ OPPOSED
            for a in angle
        ]
    )
    places = contacts[:, :3, 3]
    at = int(np.searchsorted(times, blow))
    waypoints = (
        Waypoint("back", places[0], "approach"),
        Waypoint("blow", places[at], "approach"),
        Waypoint("through", places[-1], "strike"),
    )
    return times, contacts, waypoints


def slot_fixture() -> dict[str, Any]:
    """The slot as a fixture of an environment: the peg stands out of it by OUT."""
    slot = make("slot", 0, **SLOT)
    from_target = transforms.make(translation=[OUT + SLOT["length"] / 2, 0.0, -float(slot.mesh.bounds[0, 2])])
    return {"id": "slot", **made_of(slot), "from_target": pose_data(from_target)}


def hammering() -> Strategy:
    """A peg is driven into a slot by one blow of a mallet."""
    tool, view, contact = _tool("face")
    peg = make("peg", 0, **PEG)
    normal = np.array([-1.0, 0.0, 0.0])
    seen = target_view(peg, "top", DOWN)
    touched = target_contact(seen, np.array([-PEG["length"] / 2, 0.0, 0.0]), normal, float("inf"))
    # Where the handle's end is, seen from the contact: the elbow is on that side.
    grip = np.array([tool.mesh.bounds[0, 0], 0.0, 0.0])
    side = float(np.sign((OPPOSED @ transforms.inverse(contact.object_from_contact) @ [*grip, 1.0])[1]))
    times, contacts, waypoints = swing(side)
    return Strategy(
        name="hammering",
        description="A mallet, swung in the plane of the table, drives a peg into a slot.",
        view="top",
        mode="retarget",
        **demonstrated(tool, view, contact, peg, seen, touched, normal, DOWN, times, contacts),
        waypoints=waypoints,
        goal=shipped("drive"),
        physics=Physics(friction=0.3, tool_density=1500.0, target_density=2700.0),
        environment={
            "evaluation": {"sets": SETS},
            "world_from_target": pose_data(transforms.make(translation=[0.62, 0.0, PEG["side"] / 2])),
            "tool": made_of(tool),
            "target": made_of(peg),
            "fixtures": [slot_fixture()],
        },
    )


def sweeping() -> Strategy:
    """A row of cylinders is swept away from the robot by a mallet's handle."""
    tool, view, contact = _tool("side")
    target = make("cylinder", 0, radius=SWEPT, half_height=SWEPT)
    normal = np.array([-1.0, 0.0, 0.0])
    seen = target_view(target, "top", DOWN)
    touched = target_contact(seen, SWEPT * normal, normal, SWEPT)
    waypoints = (
        Waypoint("above", np.array([0.05, 0, -0.12]), "approach"),
        Waypoint("behind", np.array([0.05, 0, 0]), "approach"),
        Waypoint("touch", np.zeros(3), "contact", 0.05),
        Waypoint("pushed", np.array([-0.16, 0, 0]), "goal"),
        Waypoint("clear", np.array([-0.13, 0, 0]), "retreat"),
        Waypoint("up", np.array([-0.13, 0, -0.12]), "retreat"),
    )
    times, contacts = through(waypoints)
    return Strategy(
        name="sweeping",
        description="The handle of a mallet that lies on the table sweeps a row of cylinders away.",
        view="top",
        mode="plan",
        **demonstrated(tool, view, contact, target, seen, touched, normal, DOWN, times, contacts),
        waypoints=waypoints,
        goal=shipped("sweep"),
        physics=Physics(friction=0.3, tool_density=600.0, target_density=600.0),
        environment={
            "evaluation": {"sets": SETS},
            "world_from_target": pose_data(transforms.make(translation=[0.45, 0.0, SWEPT])),
            "tool": made_of(tool),
            "target": made_of(target),
        },
    )


STRATEGIES = {"hammering": hammering, "sweeping": sweeping}
