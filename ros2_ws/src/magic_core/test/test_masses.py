"""What things weigh: told, or by the strategy's densities."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from magic_core import masses, shapes
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import SceneObject
from magic_core.strategy import Physics


@dataclass(frozen=True)
class Shown:
    """Of a strategy what counts here."""

    physics: Physics = field(default_factory=lambda: Physics(tool_density=600.0, target_density=300.0))


def box(*size):
    """A box of edges (3,), m, in two halves."""
    a, b, c = size
    half = np.array([[x, y, z] for x in (0, a / 2) for y in (0, b) for z in (0, c)], dtype=float)
    faces = np.zeros((1, 3), np.int32)
    pieces = tuple(Mesh(half + [x, 0, 0], faces) for x in (0, a / 2))
    return SceneObject("box", Mesh(half * [2, 1, 1], faces), pieces, np.eye(4), None)


def test_volume_is_that_of_the_pieces_together():
    item = box(0.2, 0.03, 0.01)
    assert masses.volume(item) == pytest.approx(0.2 * 0.03 * 0.01)
    assert masses.volume(replace(item, pieces=())) == pytest.approx(0.2 * 0.03 * 0.01)
    ball = shapes.make("sphere", 1).mesh
    radius = float(np.ptp(ball.vertices[:, 2])) / 2
    assert masses.volume(replace(item, mesh=ball, pieces=())) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.03)
    flat = replace(item, mesh=Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])), pieces=())
    with pytest.raises(MagicError) as error:
        masses.volume(flat)
    assert error.value.code is Code.BAD_MESH


def test_a_mass_that_is_told_becomes_the_density_that_gives_it():
    tool, target = box(0.2, 0.03, 0.01), box(0.1, 0.1, 0.1)  # 60 and 1000 cm^3
    assert masses.told(Shown(), tool, target, 0.0, 0.0) == Shown()
    physics = masses.told(Shown(), tool, target, 0.471, 0.0).physics
    assert physics.tool_density == pytest.approx(7850.0) and physics.target_density == 300.0  # steel
    physics = masses.told(Shown(), tool, target, 0.0, 0.05).physics
    assert physics.tool_density == 600.0 and physics.target_density == pytest.approx(50.0)


@pytest.mark.parametrize("mass", [-0.1, float("nan"), float("inf"), 471.0, 1e-6])
def test_a_mass_that_nothing_of_that_size_has_is_refused(mass):
    """471: grams taken for kilograms."""
    tool, target = box(0.2, 0.03, 0.01), box(0.1, 0.1, 0.1)
    with pytest.raises(MagicError) as error:
        masses.told(Shown(), tool, target, mass, 0.0)
    assert error.value.code is Code.BAD_REQUEST and "tool_mass" in error.value.message
    assert "kg" in error.value.message


def test_the_sentence_says_what_was_assumed():
    tool = box(0.2, 0.03, 0.01)
    assert "36 g" in masses.sentence(Shown(), tool, 0.0) and "600 kg/m^3" in masses.sentence(Shown(), tool, 0.0)
    assert masses.sentence(Shown(), tool, 0.471) == "the tool weighs 471 g, as was told"
