"""The physics engine obeys the laws it is used for."""

import time

import numpy as np
import pytest
import scenes
import trimesh

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh, from_trimesh
from magic_verifier.simulation import DYNAMIC, KINEMATIC, STATIC, Probe, Settings, World, reduced, sphere_of, to_pose, usable_pieces

CUBE = usable_pieces("cube", (scenes.block((-0.02, 0.02), (-0.02, 0.02), (-0.02, 0.02)),))


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_box_on_an_incline_slides_exactly_where_tan_exceeds_friction(friction, share):
    angle = share * np.arctan(friction)
    tilt = transforms.from_rpy(0, angle, 0)
    world = World(Settings())
    world.add_table(np.array([*tilt[:3, 2], 0.0]), friction)
    world.add("box", CUBE, tilt @ transforms.make(translation=[0, 0, 0.02]), DYNAMIC, 500.0, friction)
    start = world.position("box")
    for _ in range(240):
        world.step()
    slid = float(np.linalg.norm(world.position("box") - start))
    if share < 1:
        assert slid < 1e-3
    else:
        # s = g (sin a - mu cos a) t^2 / 2
        assert slid == pytest.approx(9.81 * (np.sin(angle) - friction * np.cos(angle)) / 2, rel=0.08)


@pytest.mark.parametrize("frequency", [240.0, 480.0])
def test_free_fall(frequency):
    world = World(Settings(frequency=frequency))
    world.add("box", CUBE, transforms.make(translation=[0, 0, 5]), DYNAMIC, 500.0, 0.5)
    for _ in range(int(frequency / 2)):
        world.step()
    # Semi-implicit Euler: g t (t + dt) / 2.
    assert 5 - world.position("box")[2] == pytest.approx(9.81 * 0.5 * (0.5 + 1 / frequency) / 2, rel=1e-3)
    assert world.velocity("box")[2] == pytest.approx(-9.81 * 0.5, rel=1e-3)


def test_a_kinematic_pusher_moves_a_box_by_its_way_less_the_gap():
    world = World(Settings())
    world.add_table(scenes.TABLE, 0.5)
    world.add("box", CUBE, transforms.make(translation=[0, 0, 0.02]), DYNAMIC, 500.0, 0.5)
    world.add("pusher", CUBE, transforms.make(translation=[-0.05, 0, 0.021]), KINEMATIC, 500.0, 0.5)
    for k in range(1, 481):
        world.move_to("pusher", to_pose(transforms.make(translation=[-0.05 + 0.1 * k / 480, 0, 0.021])))
        world.step()
    assert world.position("box")[0] == pytest.approx(0.09, abs=1e-3)
    touches = world.touches("pusher", "box", 1e-3)
    assert touches and all(touch.normal[0] < -0.99 for touch in touches)


@pytest.mark.parametrize("shape", ["sphere", "cylinder", "box"])
def test_things_rest_on_the_table_at_their_own_height_with_their_own_mass(shape):
    make = trimesh.creation
    mesh = {
        "sphere": lambda: make.icosphere(3, 0.02),
        "cylinder": lambda: make.cylinder(0.02, 0.04),
        "box": lambda: make.box(extents=[0.04] * 3),
    }[shape]()
    world = World(Settings())
    world.add_table(scenes.TABLE, 0.5)
    world.add("thing", usable_pieces("thing", (from_trimesh(mesh),)), transforms.make(translation=[0, 0, 0.02]), DYNAMIC, 1000.0, 0.5)
    for _ in range(240):
        world.step()
    assert world.position("thing") == pytest.approx([0, 0, 0.02], abs=2e-4)
    assert world.component("thing").mass == pytest.approx(1000 * mesh.volume, rel=0.03)


def test_a_ball_of_many_facets_is_simulated_as_a_sphere():
    centre, radius = sphere_of(reduced(np.asarray(trimesh.creation.icosphere(3, 0.03).vertices) + np.array([1, 2, 3])))
    assert centre == pytest.approx([1, 2, 3], abs=1e-4)
    assert radius == pytest.approx(0.03, rel=0.01)
    assert sphere_of(reduced(np.asarray(trimesh.creation.cylinder(0.03, 0.06).vertices))) is None


def test_reduction_keeps_the_volume():
    ball = trimesh.creation.icosphere(5, 0.1)
    corners = reduced(np.asarray(ball.vertices))
    assert len(corners) <= 200
    assert trimesh.convex.convex_hull(corners).volume == pytest.approx(ball.volume, rel=0.05)


@pytest.mark.parametrize("depth", [0.001, 0.005])
def test_the_probe_measures_how_deep_a_body_is_in_a_static_one(depth):
    probe = Probe(Settings(), CUBE, {"wall": (CUBE, np.eye(4))})
    assert probe.depths(to_pose(transforms.make(translation=[0.04 - depth, 0, 0]))) == {"wall": pytest.approx(depth, abs=1e-4)}
    assert probe.depths(to_pose(transforms.make(translation=[0.041, 0, 0]))) == {}


def test_the_same_calls_give_the_same_poses():
    def run():
        world = World(Settings())
        world.add_table(scenes.TABLE, 0.4)
        for k in range(6):
            world.add(f"cube{k}", CUBE, transforms.from_rpy(0.1 * k, 0.2, 0.3, [0.005 * k, 0, 0.03 + 0.05 * k]), DYNAMIC, 500.0, 0.4)
        for _ in range(240):
            world.step()
        return np.stack([world.pose(f"cube{k}") for k in range(6)])

    assert np.array_equal(run(), run())


def test_a_world_that_explodes_is_noticed():
    world = World(Settings())
    world.add("box", CUBE, np.eye(4), DYNAMIC, 500.0, 0.5)
    world.set_velocity("box", np.array([0, 0, 1e4]))
    world.step()
    with pytest.raises(MagicError) as error:
        world.check(("box",))
    assert error.value.code == Code.SIMULATION_EXPLODED


def test_a_rolling_ball_does_not_pass_through_a_wall():
    world = World(Settings())
    ball = usable_pieces("ball", (from_trimesh(trimesh.creation.icosphere(3, 0.02)),))
    world.add_table(scenes.TABLE, 0.3)
    world.add("wall", usable_pieces("wall", (scenes.block((0.2, 0.21), (-0.1, 0.1), (0, 0.1)),)), np.eye(4), STATIC, 500.0, 0.3)
    world.add("ball", ball, transforms.make(translation=[0, 0, 0.02]), DYNAMIC, 500.0, 0.3)
    world.set_velocity("ball", np.array([1.0, 0, 0]))
    for _ in range(480):
        world.step()
    assert world.position("ball")[0] < 0.185


def _flat():
    return Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("pieces", "what"),
    [
        ((), "pieces of"),
        ((_flat(),), "volume of"),
        ((Mesh(np.zeros((0, 3)), np.zeros((0, 3))),), "vertices of"),
        ((scenes.block((0, 1e-4), (0, 1e-4), (0, 1e-4)),), "largest extent"),
        ((scenes.block((0, 50), (0, 50), (0, 50)),), "largest extent"),
        ((scenes.block((0, 0.1), (0, 0.1), (0, 0.1)),) * 2000, "pieces of"),
    ],
)
def test_what_cannot_be_simulated_is_refused_with_a_reason(pieces, what):
    with pytest.raises(MagicError) as error:
        usable_pieces("thing", pieces)
    assert error.value.code == Code.BAD_SCENE
    assert error.value.message.startswith(f"{what} ") or what in error.value.message
    assert "thing" in error.value.message


def test_a_piece_of_a_million_points_is_reduced_in_time():
    points = np.random.default_rng(0).normal(size=(500_000, 3))
    points *= 0.1 / np.linalg.norm(points, axis=1, keepdims=True)
    started = time.monotonic()
    hulls = usable_pieces("ball", (Mesh(points, np.zeros((0, 3))),))
    assert time.monotonic() - started < 30
    assert len(hulls[0]) <= 200
