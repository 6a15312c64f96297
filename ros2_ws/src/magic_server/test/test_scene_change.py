"""Whether objects have moved, whatever frame and mesh another look gave them."""

from dataclasses import replace

import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core.errors import Code, MagicError
from magic_server import scene_change
from magic_server.testing import fakes


def placed(world_from_object, mesh=None):
    item = fakes.scene().objects[0]
    return replace(item, mesh=mesh or item.mesh, world_from_object=world_from_object)


def moved(before, after):
    return scene_change.distance(*(scene_change.hulls([item])[item.id] for item in (before, after)))


def test_a_shift_is_measured_as_it_is():
    pose = transforms.make(translation=[0.4, 0.1, 0.025])
    for shift in ([0.03, 0, 0], [0, -0.02, 0.01], [0.001, 0.001, 0]):
        found = moved(placed(pose), placed(transforms.make(translation=shift) @ pose))
        # To within the spacing of 200 directions on the sphere: about 14 degrees between neighbours.
        assert found == pytest.approx(np.linalg.norm(shift), rel=0.02)


def test_another_frame_of_the_same_thing_is_no_move():
    mesh = shapes.make("l_hook", 1).mesh
    pose = transforms.make(translation=[0.4, 0.1, 0.0])
    turned = transforms.from_rpy(0.0, 0.0, np.pi)
    same = placed(pose @ transforms.inverse(turned), mesh.transformed(turned))
    assert moved(placed(pose, mesh), same) < 1e-12


def test_a_turn_of_a_long_thing_is_a_move():
    mesh = shapes.make("l_hook", 1).mesh
    pose = transforms.make(translation=[0.4, 0.1, 0.0])
    assert moved(placed(pose, mesh), placed(pose @ transforms.from_rpy(0.0, 0.0, 0.2), mesh)) > 0.02


def test_a_scene_that_is_no_longer_is_refused():
    before = scene_change.hulls(fakes.scene().objects)
    scene_change.check(before, before, 0.0)
    only_one = scene_change.hulls(fakes.scene(("object_1",)).objects)
    three = scene_change.hulls(fakes.scene(("object_1", "object_2", "object_3")).objects)
    nowhere = scene_change.hulls([placed(np.full((4, 4), np.nan))])
    for old, new, says in (
        (before, only_one, "gone since the plan: 'object_2'"),
        (before, three, "come since the plan: 'object_3'"),
        (only_one, nowhere, "object_1 has moved since the plan, in mm: nan"),
    ):
        with pytest.raises(MagicError) as caught:
            scene_change.check(old, new, 1.0)
        assert caught.value.code == Code.STALE_DATA
        assert says in caught.value.message
    scene_change.check(before, only_one, 0.0, meant={"object_2"})


def test_what_is_nowhere_has_moved_though_it_is_seen_in_part():
    there = scene_change.hulls(fakes.scene().objects)
    nowhere = {**there, "object_1": np.full(len(scene_change.DIRECTIONS), np.nan)}
    with pytest.raises(scene_change.Changed, match="nan"):
        scene_change.check(there, nowhere, 1.0, partly={"object_1"})


def test_a_thing_that_was_shifted_is_told_from_one_whose_outline_comes_out_otherwise():
    rng = np.random.default_rng(3)
    mesh = shapes.make("l_hook", 1).mesh
    pose = transforms.make(translation=[0.4, 0.1, 0.0])
    before = scene_change.hulls([placed(pose, mesh)])["object_1"]
    for direction in (0.0, 1.0, 2.5):
        by = 0.012 * np.array([np.cos(direction), np.sin(direction), 0.0])
        after = scene_change.hulls([placed(transforms.make(translation=by) @ pose, mesh)])["object_1"]
        assert scene_change.shift(before, after) == pytest.approx(0.012, rel=1e-6)
        assert scene_change.beyond(before, after, False, 0.02) == pytest.approx((0.012, 0.01))
        assert scene_change.beyond(before, after, True, 0.02) is None  # of what is hidden in part nobody knows
    otherwise = before + rng.uniform(-0.015, 0.015, len(before))
    assert scene_change.distance(before, otherwise) > 0.013 and scene_change.beyond(before, otherwise, False, 0.02) is None
