"""A person's hand in the pictures: perception says that something hangs there, and finds the things beside it where they are."""

import numpy as np
from lab_scenes import empty, robot

from magic_core import sensor, transforms
from magic_core.robot_pictures import link_mesh
from magic_core.self_filter import SelfFilter
from magic_lab.cameras import Bodies, Camera
from magic_lab.laboratory import Lab
from magic_lab.scenarios import TARGET, Event, hand_pose
from magic_perception.parameters import Parameters
from magic_perception.pipeline import perceive


def test_a_hand_over_the_table_is_something_that_hangs_and_the_things_stay_things():
    lab = Lab(empty(), robot(), (Event("hand"),))
    while lab.time < 2.0:
        lab.tick()
    assert np.allclose(lab.world.pose("hand"), hand_pose(1.99), atol=0.02)
    links = {name: mesh for name in robot().links if (mesh := link_mesh(robot(), name)) is not None and len(mesh.faces)}
    bodies = Bodies({**links, **{thing.name: thing.item.mesh for thing in lab.scene.things}})
    positions = robot().arm_positions(lab.joints[0])
    poses = {**{name: pose for name, pose in robot().poses(positions).items() if name in links}, **lab.world.poses()}
    cut = SelfFilter(robot())
    frames = []
    for number, (name, pose) in enumerate(sensor.STATION.items()):
        frame = Camera(name, pose, bodies).picture(poses, [0, number])
        frames.append(frame.blinded(cut.cut(frame, [positions]).robot))
    found = perceive(frames, (), Parameters())
    hanging = [o for o in found.objects if o.hanging]
    assert hanging, [o.id for o in found.objects]
    lying = [transforms.apply(o.world_from_object, o.mesh.bounds.mean(axis=0)) for o in found.objects if not o.hanging]
    for name in ("tool_1", TARGET):
        true = transforms.apply(lab.world.pose(name), lab.scene.thing(name).item.mesh.bounds.mean(axis=0))
        assert min(np.linalg.norm((place - true)[:2]) for place in lying) < 0.02, name
    assert all(place[2] < 0.15 for place in lying), "nothing that is up there is told as lying on the table"
