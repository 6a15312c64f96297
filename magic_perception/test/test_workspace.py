"""The workspace that the node takes where nothing else is said."""

import numpy as np
from scenes import capture, pose, shape

from magic_core import transforms
from magic_perception.parameters import WORKSPACE, Parameters
from magic_perception.pipeline import perceive


def test_what_was_pulled_beside_the_robot_s_base_is_seen():
    """A pull towards the robot ends there, and cameras that stand before the robot show it."""
    place = [0.06, -0.3]
    eyes = {"left": pose([0.94, 0.42, 0.66], [0.52, 0.0, 0.04]), "right": pose([0.94, -0.42, 0.66], [0.52, 0.0, 0.04])}
    meshes = [shape("sphere", 1, *place), shape("cylinder", 2, 0.6, 0.1)]
    frames = [capture(meshes, name, seed, world_from_camera=eye)[0] for seed, (name, eye) in enumerate(eyes.items())]
    found = perceive(frames, parameters=Parameters(**WORKSPACE)).objects
    middles = [transforms.apply(item.world_from_object, item.mesh.bounds.mean(axis=0))[:2] for item in found]
    assert min(np.linalg.norm(middle - place) for middle in middles) < 0.015, middles
