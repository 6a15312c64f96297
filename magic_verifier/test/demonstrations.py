"""The scenes of the demonstrations that ship with the project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scenes

from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.contact import ContactCandidate
from magic_core.shapes import make
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_verifier.floating import settled
from magic_verifier.learning import Demonstration

FOLDER = Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies"
NAMES = ("hooking", "hanging", "scooping")


def demonstration(name):
    """Strategy, tool, target, fixtures and the reference contact as a candidate."""
    strategy = strategies.find(name, FOLDER)
    entry = strategy.environment
    pose = demonstrated_pose(entry)
    tool = make(entry["tool"]["family"], entry["tool"]["seed"], **entry["tool"]["parameters"])
    target = make(entry["target"]["family"], entry["target"]["seed"], **entry["target"]["parameters"]).as_object("target", pose)
    lying = transforms.make(translation=[0.45, -0.32, 0.0005 - float(tool.mesh.bounds[0][2])])
    contact = (pose @ strategy.target_contact.object_from_contact)[:3, 3]
    candidate = ContactCandidate("tool", strategy.tool_contact, strategy.target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4))
    # A spoon that is set on the bottom of its bowl tips on to its handle: the tool is taken as it lies by itself.
    lying = settled(tool.as_object("tool", lying, strategy.view), scenes.TABLE, strategy.physics)
    return strategy, lying, target, tuple(fixtures(entry, contact)), candidate


def _at(x, y, z):
    return transforms.make(translation=[x, y, z])


def shown(tool, target, way, rate=30.0):
    """A demonstration of a tool that is led through (world_from_tool, seconds) by straight lines, at the rate of a tracker."""
    knots = np.cumsum([seconds for _, seconds in way])
    times = np.arange(0.0, knots[-1], 1 / rate)
    poses = transforms.interpolate(knots, np.stack([pose for pose, _ in way]), times)
    return Demonstration(tool, target, (), scenes.TABLE, times, poses)


LYING = _at(0.42, -0.22, 0.001)


def pushing(aside=0.0, far=0.25):
    """A box is pushed away by the bar of a T, which meets it ``aside`` (m) of its middle and goes on as ``far``."""
    bar = scenes.block((-0.02, 0.0), (-0.05, 0.05), (0.0, 0.02))
    tool = scenes.item("tool", [bar, scenes.block((-0.25, -0.02), (-0.01, 0.01), (0.0, 0.02))], LYING)
    box = scenes.item("target", [scenes.block((-0.03, 0.03), (-0.04, 0.04), (-0.025, 0.025))], _at(0.5, 0.0, 0.025))
    low, meets = 0.003, 0.47
    way = [(LYING, 0.0), (LYING, 0.5), (_at(meets - 0.1, aside, 0.1), 1.5), (_at(meets - 0.1, aside, low), 1.0)]
    way += [(_at(meets - 0.01, aside, low), 1.0), (_at(meets + far, aside, low), 3.0), (_at(meets + far - 0.1, aside, low), 1.0)]
    return shown(tool, box, way)


def ring_pulling(handle=True):
    """A ring that lies on the table is pulled by its inside: with the bent end of a bar, or with a stick that stands in it."""
    up = scenes.block((-0.006, 0.01), (-0.008, 0.008), (0.0, 0.066))
    lying = transforms.from_rpy(np.pi / 2, 0, 0, [0.46, -0.2, 0.009])
    tool = scenes.item("tool", [scenes.block((-0.2, 0.01), (-0.008, 0.008), (0.05, 0.066)), up] if handle else [up], lying)
    ring = scenes.item(
        "target", [p.transformed(transforms.from_rpy(np.pi / 2, 0, 0)) for p in scenes.ring(0.04, 0.012, 0.02)], _at(0.6, 0, 0.01)
    )
    meets, low = 0.6 - 0.034 + 0.006, 0.003
    way = [(lying, 0.0), (lying, 0.5), (_at(0.6, 0, 0.12), 1.5), (_at(0.6, 0, low), 1.0), (_at(meets, 0, low), 0.6)]
    way += [(_at(meets - 0.25, 0, low), 3.0), (_at(meets - 0.24, 0, low), 0.5), (_at(meets - 0.24, 0, 0.12), 1.0)]
    return shown(tool, ring, way)


def pressing():
    """The top of a standing peg is pressed by a flat bar."""
    tool = scenes.item("tool", [scenes.block((-0.12, 0.12), (-0.015, 0.015), (0.0, 0.02))], LYING)
    peg = scenes.item("target", [scenes.standing_cylinder(0.02)], _at(0.55, 0.0, 0.02))
    way = [(LYING, 0.0), (LYING, 0.5), (_at(0.45, 0, 0.2), 1.5), (_at(0.45, 0, 0.06), 1.0), (_at(0.45, 0, 0.039), 1.0)]
    return shown(tool, peg, [*way, (_at(0.45, 0, 0.039), 0.5), (_at(0.45, 0, 0.1), 1.0)])


def shunting():
    """A block is pushed away by the outside of a hook's tip, then, the tool lifted over it, pulled nearer by its inside; the target's way
    of each."""
    tool = scenes.item(
        "tool", [scenes.block((-0.25, 0.0), (-0.01, 0.01), (0.0, 0.02)), scenes.block((-0.02, 0.0), (0.01, 0.08), (0.0, 0.02))], LYING
    )
    block = scenes.item("target", [scenes.block((-0.02, 0.02), (-0.025, 0.025), (-0.02, 0.02))], _at(0.55, 0.0, 0.02))
    low, aside, out, back = 0.003, -0.045, 0.53, 0.57 + 0.02
    way = [
        (LYING, 0.0),
        (LYING, 0.5),
        (_at(out - 0.1, aside, 0.1), 1.5),
        (_at(out - 0.1, aside, low), 1.0),
        (_at(out - 0.01, aside, low), 1.0),
    ]
    way += [(_at(out + 0.06, aside, low), 1.0), (_at(out + 0.03, aside, low), 0.5), (_at(out + 0.03, aside, 0.1), 1.0)]
    way += [(_at(back + 0.11, aside, 0.1), 1.5), (_at(back + 0.11, aside, low), 1.0), (_at(back + 0.07, aside, low), 1.0)]
    way += [(_at(back - 0.12, aside, low), 2.0), (_at(back - 0.09, aside, low), 0.5), (_at(back - 0.09, aside, 0.1), 1.0)]
    return shown(tool, block, way)
