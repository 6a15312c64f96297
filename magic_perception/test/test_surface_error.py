"""How far a solid departs from what was seen of it, and what that tells of its surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import trimesh

from magic_core import sensor, transforms
from magic_core.mesh import Mesh, concatenate
from magic_perception import learn_surface_error, surface_error
from magic_perception.pipeline import perceive
from magic_perception.sight import Sight


def block(low, high) -> Mesh:
    """An upright box between two corners, m."""
    solid = trimesh.creation.box(bounds=[low, high])
    return Mesh(np.array(solid.vertices), np.array(solid.faces)).painted((180, 60, 50))


BODY = block([0.50, -0.03, 0.0], [0.56, 0.03, 0.08])
BAR = block([0.49, 0.03, 0.03], [0.50, 0.065, 0.04])


def sights(mesh: Mesh) -> list[Sight]:
    """What two cameras see of a mesh alone on the table, without noise."""
    found = []
    for name, pose in scenes.POSES.items():
        frame, ids = scenes.capture([mesh], name, noise=0.0)
        mask = ids == 0
        heights = transforms.apply(pose, frame.intrinsics.unproject(frame.depth).reshape(-1, 3).astype(float))[:, 2].reshape(mask.shape)
        found.append(Sight(frame.intrinsics, pose, mask, np.zeros_like(mask), frame.color, frame.depth, heights.astype(np.float32), 0.001))
    return found


def test_what_sticks_out_of_the_masks_and_what_they_show_beside_the_solid_is_astray():
    whole = concatenate([BODY, BAR])
    exact = surface_error.departure(whole, sights(whole))
    assert exact.astray < 0.003 and exact.gap < 0.001
    too_much = surface_error.departure(whole, sights(BODY))
    assert 0.02 < too_much.astray < 0.05 and too_much.gap < 0.001
    too_little = surface_error.departure(BODY, sights(whole))
    assert 0.02 < too_little.astray < 0.05 and too_little.gap > 0.002
    # What something in front may hide tells nothing.
    hidden = [replace(s, hidden=~s.mask) for s in sights(BODY)]
    assert surface_error.departure(whole, hidden).astray < 0.003


def test_five_of_six_lie_below_what_is_stated_and_no_weight_has_the_wrong_sign():
    random = np.random.default_rng(5)
    rows = random.normal(size=(1500, 3))
    spread = np.where(rows[:, 1] > 0, 0.6, 0.1)
    errors = np.exp(0.5 + 0.7 * rows[:, 0] + spread * random.normal(size=1500) - 0.3 * rows[:, 2]) / 1000
    model = surface_error.fit(rows[:1000], errors[:1000], signs=np.array([1, 1, 1]))
    stated = np.array([model.error(row) for row in rows[1000:]])
    assert np.mean(errors[1000:] <= stated) == pytest.approx(surface_error.SHARE, abs=0.05)
    assert model.weights[0] == pytest.approx(0.7, abs=0.1) and model.weights[1] > 0.1
    assert model.weights[2] == pytest.approx(0.0, abs=1e-3)  # known to be worse: it may not be told to be better


def test_a_perceived_thing_states_its_error_and_more_of_it_where_less_was_seen():
    mesh = scenes.shape("mug", 3, 0.55, 0.0, 1.2)
    frames = [
        sensor.capture([mesh], scenes.INTRINSICS, pose, [3, i], camera=name, model=sensor.SMEARED)
        for i, (name, pose) in enumerate(scenes.POSES.items())
    ]
    (both,) = perceive(frames).objects
    (one,) = perceive(frames[1:]).objects
    for item in (both, one):
        true = surface_error.distance(mesh, item.mesh.transformed(item.world_from_object))
        assert surface_error.LEAST <= item.surface_error <= surface_error.MOST
        assert true < item.surface_error
    assert both.surface_error < 0.004


def test_the_distance_of_two_surfaces():
    plate = block([0, 0, 0], [1.0, 1.0, 0.002])
    assert surface_error.distance(plate, plate) == pytest.approx(0.0, abs=1e-5)
    lifted = plate.transformed(transforms.make(translation=[0, 0, 0.05]))
    # One side lies 48 mm from the other's near side, the other 50: of both meshes.
    assert surface_error.distance(plate, lifted) == pytest.approx(np.sqrt((0.048**2 + 0.050**2) / 2), abs=0.001)


def test_errors_are_judged_by_scenes_that_the_weights_do_not_know():
    random = np.random.default_rng(2)
    things = [
        learn_surface_error.Judged(scene, "flat", row := random.normal(size=len(surface_error.NUMBERS)), float(np.exp(row[0]) / 1000))
        for scene in range(120)
    ]
    text, loss = learn_surface_error.cross_validated(things)
    assert "120 things of 120 seeds" in text and "| all | 120 |" in text and 0 < loss < 0.2


def test_more_is_stated_than_few_things_tell_so_that_five_of_six_others_lie_below():
    """Many numbers of few things fit their errors too well."""
    random = np.random.default_rng(4)

    def drawn(count):
        rows = random.normal(size=(count, len(surface_error.NUMBERS)))
        errors = np.exp(0.5 + 0.5 * rows[:, 0] + 0.5 * random.normal(size=count)) / 1000
        return [
            learn_surface_error.Judged(4 * i, "flat", row, float(error)) for i, (row, error) in enumerate(zip(rows, errors, strict=True))
        ]

    shares = []
    for _ in range(8):
        known, others = drawn(90), drawn(300)
        shares.append(
            [
                np.mean([thing.error <= model.error(thing.row) for thing in others])
                for model in (learn_surface_error._fitted(known), learn_surface_error.learned(known))
            ]
        )
    alone, raised = np.mean(shares, axis=0)
    assert alone < surface_error.SHARE - 0.02 < raised


def test_of_four_seeds_three_are_a_tool_alone_and_one_a_pile_and_a_ball_or_cylinder():
    (made,) = learn_surface_error.drawn(710001)
    assert made.things == 1 and made.meshes[0].bounds[0, 2] == pytest.approx(0, abs=1e-9)
    assert all((truth == 1).sum() > 200 for truth in made.truth)
    _, plain = learn_surface_error.drawn(710000)
    size = plain.meshes[0].extents
    assert plain.things == 1 and size[0] == pytest.approx(size[1], rel=0.02)  # round, seen from above
