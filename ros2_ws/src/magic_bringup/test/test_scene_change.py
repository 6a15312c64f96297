"""Whether objects have moved, whatever frame and mesh another look gave them."""

from dataclasses import replace

import numpy as np
import pytest

from magic_bringup import fakes, scene_change
from magic_core import shapes, transforms
from magic_core.errors import Code, MagicError


def placed(world_from_object, mesh=None):
    item = fakes.scene().objects[0]
    return replace(item, mesh=mesh or item.mesh, world_from_object=world_from_object)


def test_a_shift_is_measured_as_it_is():
    pose = transforms.make(translation=[0.4, 0.1, 0.025])
    for shift in ([0.03, 0, 0], [0, -0.02, 0.01], [0.001, 0.001, 0]):
        found = scene_change.distance(placed(pose), placed(transforms.make(translation=shift) @ pose))
        # To within the spacing of 200 directions on the sphere: about 14 degrees between neighbours.
        assert found == pytest.approx(np.linalg.norm(shift), rel=0.02)


def test_another_frame_of_the_same_thing_is_no_move():
    mesh = shapes.make("l_hook", 1).mesh
    pose = transforms.make(translation=[0.4, 0.1, 0.0])
    turned = transforms.from_rpy(0.0, 0.0, np.pi)
    same = placed(pose @ transforms.inverse(turned), mesh.transformed(turned))
    assert scene_change.distance(placed(pose, mesh), same) < 1e-12


def test_a_turn_of_a_long_thing_is_a_move():
    mesh = shapes.make("l_hook", 1).mesh
    pose = transforms.make(translation=[0.4, 0.1, 0.0])
    assert scene_change.distance(placed(pose, mesh), placed(pose @ transforms.from_rpy(0.0, 0.0, 0.2), mesh)) > 0.02


def test_a_scene_that_is_no_longer_is_refused():
    before = fakes.scene().objects
    scene_change.check(before, before, 0.0)
    for after in (before[:1], fakes.scene(("object_1", "object_2", "object_3")).objects):
        with pytest.raises(MagicError) as caught:
            scene_change.check(before, after, 1.0)
        assert caught.value.code == Code.STALE_DATA
    nowhere = placed(np.full((4, 4), np.nan))
    with pytest.raises(MagicError) as caught:
        scene_change.check(before[:1], [nowhere], 1.0)
    assert caught.value.code == Code.STALE_DATA
