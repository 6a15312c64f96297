"""The paper's other methods: an alignment that is known is found, and curvature alone finds the bend."""

from pathlib import Path

import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_matcher import baselines
from magic_matcher.matching import Target, target_contact, target_view

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")


@pytest.fixture(scope="module")
def strategy():
    return strategies.find("hooking", STRATEGIES)


@pytest.fixture(scope="module")
def target(strategy):
    item = shapes.make("cylinder", 0, radius=0.025).as_object("target", transforms.make(translation=[0.6, 0, 0.025]))
    view = target_view(item, strategy)
    return Target(item.id, view, target_contact(strategy, view, item.world_from_object))


def test_points_lie_on_the_surface_and_are_spread_by_area():
    mesh = shapes.make("sphere", 0, radius=0.05).mesh
    points, normals = baselines.sampled(mesh, 4000, np.random.default_rng(0))
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.05, rel=0.03)
    assert np.einsum("ni,ni->n", points, normals).min() > 0
    assert np.abs(points.mean(axis=0)).max() < 0.003
    with pytest.raises(MagicError) as error:
        baselines.sampled(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), 10, np.random.default_rng(0))
    assert error.value.code == Code.BAD_MESH


@pytest.mark.parametrize("name", list(baselines.ALIGNERS))
def test_the_demonstrated_tool_itself_turned_is_laid_on_itself(strategy, target, name):
    turned = transforms.from_rpy(0.4, -0.3, 2.0, [0.05, -0.02, 0.01])
    mesh = strategy.tool_mesh
    same = shapes.make("l_hook", 0).as_object("tool", np.eye(4))
    tool = type(same)(**{**vars(same), "mesh": mesh.transformed(turned)})
    best = baselines.by_shape(name, strategy, [tool], target, 1, 0)[0]
    wanted = turned @ strategy.tool_contact.object_from_contact
    assert np.linalg.norm(best.tool.object_from_contact[:3, 3] - wanted[:3, 3]) < 0.006
    assert best.tool.object_from_contact[:3, 0] @ wanted[:3, 0] > 0.99


def test_the_axes_leave_four_turns(strategy):
    found = baselines.pca(strategy.tool_mesh, strategy.tool_mesh)
    assert len(found) == 4
    for turn, _ in found:
        assert np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)
    assert [quality for _, quality in found] == sorted((quality for _, quality in found), reverse=True)


def test_curvature_alone_finds_a_bend_of_the_right_radius(strategy, target):
    tool = shapes.make("l_hook", 5).as_object("tool", transforms.make(translation=[0.4, 0.2, 0.01]))
    best = baselines.by_curvature(strategy, [tool], target, 3, 0)
    assert all(c.tool.concave == strategy.tool_contact.concave for c in best)
    assert best[0].score == max(c.score for c in best)
    again = baselines.by_curvature(strategy, [tool], target, 3, 0)
    assert [tuple(c.tool.pixel) for c in best] == [tuple(c.tool.pixel) for c in again]


def test_the_search_ends_when_its_time_is_over(strategy, target):
    tool = shapes.make("caliper", 5).as_object("tool", transforms.make(translation=[0.4, 0.2, 0.01]))
    ticks = iter(np.arange(0.0, 1e6, 100.0))
    few = baselines.by_curvature(strategy, [tool], target, 3, 0, seconds=150.0, clock=lambda: float(next(ticks)))
    assert few
