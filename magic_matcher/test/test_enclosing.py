"""Which outlines go around what they hold, and what is said of a tool whose loop may be on the side that nobody saw."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import from_trimesh
from magic_core.scene import SceneObject
from magic_core.views import find_view
from magic_matcher import contour, enclosing, features, jobs, matching
from magic_matcher.global_stage import make_reference


def arc(degrees: float, inner: float = 30.0, stock: float = 8.0) -> contour.Contour:
    """The outline of a ring's part, open upwards."""
    v, u = np.mgrid[0:161, 0:161] - 80.0
    distance, off = np.hypot(u, v), np.abs(np.degrees(np.arctan2(u, v)))
    return contour.extract((distance >= inner) & (distance <= inner + stock) & (off <= degrees / 2))


@pytest.mark.parametrize("degrees", [90, 150, 180, 270, 330])
def test_an_arc_encloses_its_middle_by_its_angle(degrees):
    outline = arc(degrees)
    found = enclosing.enclosure(outline, np.array([[80.0, 80.0]]), np.array([30.0]))[0]
    assert found == pytest.approx(degrees / 360, abs=0.05)
    assert enclosing.asked(outline, np.array([80.0, 110.0]), np.array([0.0, -1.0]), 30.0) == (degrees > 216)
    assert (enclosing.most(outline) >= enclosing.LOOP) == (degrees > 216)


def test_holes_are_loops_and_full_things_are_none():
    v, u = np.mgrid[0:161, 0:161] - 80.0
    disc = np.hypot(u, v) < 60
    assert enclosing.most(contour.extract(disc)) < 0.3
    assert enclosing.most(contour.extract(disc & (np.hypot(u - 40, v) > 8))) == 1.0
    corner = (np.maximum(u, v) > 20) & (np.maximum(u, v) < 40) & (np.minimum(u, v) > -60)
    assert 0.45 < enclosing.most(contour.extract(corner)) < enclosing.LOOP
    on_it = enclosing.enclosure(contour.extract(disc), np.array([[80.0, 80.0]]), np.array([20.0]))
    assert on_it[0] == 0.0


def seen_can(seen_share: float) -> SceneObject:
    """A can of which the half towards +x was seen."""
    can = from_trimesh(trimesh.creation.cylinder(0.04, 0.1))
    turns, heights = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 40), np.linspace(-0.05, 0.05, 20))
    front = np.stack([0.04 * np.cos(turns), 0.04 * np.sin(turns), heights], axis=-1).reshape(-1, 3)
    pose = transforms.from_rpy(0, 0, 0, (0.5, 0.2, 0.05))
    return SceneObject("can", can, (can,), pose, find_view(can, None, "side"), transforms.apply(pose, front), seen_share=seen_share)


def test_the_side_that_nobody_saw():
    assert enclosing.unseen_side(seen_can(0.5)) == pytest.approx([-1.0, 0.0], abs=0.1)
    assert enclosing.unseen_side(replace(seen_can(0.5), points=np.zeros((0, 3)))) is None


@pytest.mark.parametrize(
    ("job", "family", "region", "radius", "seen", "code"),
    [
        ("hanging", "hanger", "hook", 0.006, 0.5, Code.HANDLE_NOT_SEEN),
        ("hanging", "hanger", "hook", 0.006, 0.95, Code.NO_MATCH),  # seen all around: it has none
        ("hooking", "l_hook", "inner", 0.025, 0.5, Code.NO_MATCH),  # a bend is no loop
    ],
)
def test_a_loop_that_was_not_seen_is_told_from_one_that_is_not_there(job, family, region, radius, seen, code):
    shown = jobs.example(job, family, 3)
    contact = shown.contact(region)
    reference = make_reference(shown.view, contact.pixel, contact.normal, radius / shown.view.metres_per_pixel, shown.contour)
    tool = matching.tool_of(seen_can(seen), "side")
    with pytest.raises(MagicError) as caught:
        matching.Matcher(features.load("embedded")).match_views(
            reference, contact, [tool], jobs.disc_target(radius, "side"), reference_target_radius=radius
        )
    assert caught.value.code == code
    if code is Code.HANDLE_NOT_SEEN:
        assert "can" in caught.value.message and "50 %" in caught.value.message and "(-1.0, " in caught.value.message
