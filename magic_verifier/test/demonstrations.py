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
