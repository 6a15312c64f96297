"""How much of an opening is in sight: all of it from ahead, less askew, none behind a plate or from its own plane."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from magic_core import transforms
from magic_core.loops import Opening
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster

#: A square of 40 mm in the plane x = 0.
RIM = 0.02 * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]])


def plate(x: float, side: float = 1.0) -> Mesh:
    box = trimesh.creation.box((0.002, side, side))
    return Mesh(box.vertices, box.faces).transformed(transforms.make(translation=[x, 0, 0]))


@pytest.mark.parametrize("angle", [0, 30, 60, 90])
def test_an_opening_is_seen_by_the_cosine_of_the_angle(angle):
    turn = np.radians(angle)
    eye = 50 * np.array([np.cos(turn), np.sin(turn), 0.0])
    assert Opening.within(RIM).in_sight(eye, Raycaster([plate(-1.0)])) == pytest.approx(np.cos(turn), abs=0.002)


def test_what_stands_before_it_hides_it_and_what_stands_behind_does_not():
    opening, eye = Opening.within(RIM), np.array([50.0, 0.0, 0.0])
    assert opening.in_sight(eye, Raycaster([plate(0.1)])) == 0.0
    assert opening.in_sight(eye, Raycaster([plate(-0.1)])) == pytest.approx(1.0, abs=1e-3)
    # A quarter of the area behind a plate of half the side.
    assert opening.in_sight(eye, Raycaster([plate(0.1, 0.02)])) == pytest.approx(0.75, abs=0.03)


def test_an_opening_moves_with_its_thing():
    pose = transforms.from_rpy(0.3, -0.8, 1.1, [0.2, 0.1, 0.3])
    moved = Opening.within(RIM).moved(pose)
    hidden, free = (Raycaster([plate(x).transformed(pose)]) for x in (0.1, -0.1))
    eye = transforms.apply(pose, np.array([50.0, 0.0, 0.0]))
    assert moved.in_sight(eye, hidden) == 0.0 and moved.in_sight(eye, free) == pytest.approx(1.0, abs=1e-3)
