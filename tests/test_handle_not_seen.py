"""A mug is asked to be hung: where its handle stands out to the side of the cameras a contact is found, where it is behind the body the
answer says so."""

import numpy as np
import pytest

from magic_core import shapes, strategy, transforms
from magic_core.errors import Code, MagicError
from magic_core.sensor import D435, SMEARED, STATION, capture, scene_raycaster
from magic_matcher import features, matching
from magic_perception.averaging import average
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive

#: The middle of the two cameras' directions, seen from where the mug stands, is +x: the robot's side is behind it.
PLACE = (0.50, 0.0)
#: Across the line of sight of the left camera.
ASIDE = np.radians(134)


@pytest.fixture(scope="module")
def matcher():
    return matching.Matcher(features.load("embedded"))


def perceived(mesh, yaw):
    """The one thing in the scene of a mesh that stands on the table, its handle in direction ``yaw``, seen by the station's cameras."""
    standing = mesh.transformed(transforms.make(translation=[0, 0, -mesh.bounds[0, 2]])).transformed(
        transforms.from_rpy(0, 0, yaw, [*PLACE, 0])
    )
    caster = scene_raycaster([standing.painted((60, 90, 200))])
    frames = [
        average([capture([], D435, pose, [5, i, j], model=SMEARED, camera=name, raycaster=caster) for j in range(3)])
        for i, (name, pose) in enumerate(STATION.items())
    ]
    scene = perceive(frames, parameters=Parameters())
    assert len(scene.objects) == 1
    return scene.objects[0]


@pytest.mark.parametrize("seed", [7002, 7005])
def test_a_handle_behind_the_body_is_not_seen_and_one_to_the_side_is_met(matcher, seed):
    hanging, rod = strategy.find("hanging"), shapes.make("rod", 0).as_object("rod", transforms.make(translation=[0.56, 0.4, 0]))
    shape = shapes.make("mug", seed)
    behind = perceived(shape.mesh, np.pi)
    with pytest.raises(MagicError) as caught:
        matcher.match(hanging, [behind], rod)
    assert caught.value.code == Code.HANDLE_NOT_SEEN, caught.value
    # Most of what was not seen faces the robot, away from the cameras.
    assert "of its surface, most of it towards (-" in caught.value.message
    aside = perceived(shape.mesh, ASIDE)
    best = matcher.match(hanging, [aside], rod).candidates[0]
    contact = transforms.apply(aside.world_from_object, best.tool.object_from_contact[:3, 3])
    away = (contact[:2] - PLACE) @ np.array([[np.cos(ASIDE), -np.sin(ASIDE)], [np.sin(ASIDE), np.cos(ASIDE)]])
    assert away[0] > 0.03 and abs(away[1]) < 0.015
    assert best.tool.concave
