"""The strategies that ship: made by their script, consistent, and true in physics when replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magic_bringup import make_strategies
from magic_core import strategy as strategies
from magic_core import transforms
from magic_core.contact import Companion, ContactCandidate
from magic_core.motion import MotionPlan
from magic_core.shapes import make, mug_set
from magic_core.shapes.fixtures import demonstrated_pose, fixtures
from magic_core.shapes.shape import Shape
from magic_core.strategy import Strategy

FOLDER = Path(__file__).resolve().parents[1] / "strategies"
TABLE = np.array([0.0, 0.0, 1.0, 0.0])
NAMES = tuple(make_strategies.STRATEGIES)


@pytest.fixture(params=NAMES)
def strategy(request: pytest.FixtureRequest) -> Strategy:
    return strategies.load(FOLDER / request.param)


def made(strategy: Strategy, key: str) -> Shape:
    entry = strategy.environment[key]
    return make(entry["family"], entry["seed"], **entry["parameters"])


def replay(
    strategy: Strategy, tool: Shape, tool_contact: object, target: Shape, target_contact: object, world_from_target: np.ndarray
) -> object:
    from magic_planner.object_motion import plan_tool_motion
    from magic_verifier.verification import Proposal, verify_proposal

    further = tuple(Companion(pair.name, pair.tool, pair.target) for pair in strategy.contacts)
    candidate = ContactCandidate("tool", tool_contact, target_contact, 0.0, False, 1.0, 1.0, 1.0, np.eye(4), further)
    obstacles = tuple(fixtures(strategy.environment, (world_from_target @ target_contact.object_from_contact)[:3, 3]))
    target_object = target.as_object("target", world_from_target)
    motion = plan_tool_motion(strategy, tool.as_object("tool", np.eye(4)), target_object, candidate, obstacles=obstacles)
    tool_object = tool.as_object("tool", motion.world_from_tool[0])
    return verify_proposal(Proposal(strategy, tool_object, target_object, obstacles, TABLE, MotionPlan("fg", motion)), repetitions=1)


def test_the_files_are_those_of_the_script(strategy: Strategy, tmp_path: Path) -> None:
    assert make_strategies.main(["--out", str(tmp_path), strategy.name]) == 0
    assert sorted(f.name for f in (tmp_path / strategy.name).iterdir()) == sorted(f.name for f in (FOLDER / strategy.name).iterdir())
    again = strategies.load(tmp_path / strategy.name)
    # Equal but for the last digits, which are the processor's own.
    np.testing.assert_allclose(again.target_from_tool, strategy.target_from_tool, atol=1e-6)
    np.testing.assert_allclose(again.tool_contact.object_from_contact, strategy.tool_contact.object_from_contact, atol=1e-6)
    np.testing.assert_allclose(again.target_contact.object_from_contact, strategy.target_contact.object_from_contact, atol=1e-6)
    assert (again.tool_view.mask != strategy.tool_view.mask).mean() < 1e-3
    assert (again.target_view.mask != strategy.target_view.mask).mean() < 1e-3
    assert (again.goal, again.physics, again.environment, again.reflections) == (
        strategy.goal,
        strategy.physics,
        strategy.environment,
        strategy.reflections,
    )
    np.testing.assert_allclose([w.offset for w in again.waypoints], [w.offset for w in strategy.waypoints], atol=1e-9)


def test_the_demonstrated_contacts_meet(strategy: Strategy) -> None:
    contacts = (
        transforms.inverse(strategy.target_contact.object_from_contact)
        @ strategy.target_from_tool
        @ strategy.tool_contact.object_from_contact
    )
    distance = np.linalg.norm(contacts[:, :2, 3], axis=1)  # how deep in the picture does not matter
    assert distance.min() < 0.004  # hanging lets go 2 mm above the rod
    k = int(np.argmin(distance))
    # Squarely: normals oppose, view directions agree.
    np.testing.assert_allclose(contacts[k][:3, 0], [-1, 0, 0], atol=0.03)
    np.testing.assert_allclose(contacts[k][:3, 2], [0, 0, 1], atol=0.03)


def test_the_target_contact_is_the_support_point_along_the_normal(strategy: Strategy) -> None:
    if strategy.target_outline != "outer":
        pytest.skip("met inside")
    # The target stands in the world as in its own frame.
    world_from_target = demonstrated_pose(strategy.environment)
    np.testing.assert_allclose(world_from_target[:3, :3], np.eye(3), atol=1e-9)
    frame = strategy.target_contact.object_from_contact
    np.testing.assert_allclose(frame[:3, 0], strategy.target_normal, atol=1e-9)
    np.testing.assert_allclose(frame[:3, 2], strategy.target_view_direction, atol=1e-9)
    reach = (strategy.target_mesh.vertices @ strategy.target_normal).max()
    assert frame[:3, 3] @ strategy.target_normal == pytest.approx(reach, abs=5e-4)


def test_the_contacts_lie_on_the_outlines(strategy: Strategy) -> None:
    further = [side for p in strategy.contacts for side in ((strategy.tool_view, p.tool), (strategy.target_view, p.target))]
    for view, contact in ((strategy.tool_view, strategy.tool_contact), (strategy.target_view, strategy.target_contact), *further):
        u, v = np.round(contact.pixel - 1.2 * contact.normal).astype(int)
        assert view.mask[v, u]
        u, v = np.round(contact.pixel + 1.5 * contact.normal).astype(int)
        assert not view.mask[v, u]
    assert not strategy.target_contact.concave
    assert strategy.tool_contact.concave == np.isfinite(strategy.tool_contact.radius)


def test_the_tool_keeps_clear_of_the_table(strategy: Strategy) -> None:
    world_from_tool = demonstrated_pose(strategy.environment) @ strategy.target_from_tool
    height = (world_from_tool[:, 2, :3] @ strategy.tool_mesh.vertices.T).min(axis=1) + world_from_tool[:, 2, 3]
    # The spoon's bowl reaches below the ball's middle by more than its radius, a mallet's block below a flat peg's, a tip below a
    # ring's: the planner lifts them by this.
    low = strategy.name in ("scooping", "hammering", "pressing", "ring_pulling")
    assert height.min() > (-0.016 if low else 0.001)


def test_the_demonstration_succeeds_in_physics(strategy: Strategy) -> None:
    verdict = replay(
        strategy,
        made(strategy, "tool"),
        strategy.tool_contact,
        made(strategy, "target"),
        strategy.target_contact,
        demonstrated_pose(strategy.environment),
    )
    assert verdict.success, verdict.message


@pytest.mark.parametrize("radius", [0.015, 0.035])
def test_a_caliper_pulls_cylinders(radius: float) -> None:
    strategy = strategies.load(FOLDER / "hooking")
    tool, target = make("caliper", 1), make("cylinder", 0, radius=radius)
    view = make_strategies.target_view(target, "top", strategy.target_view_direction)
    contact = make_strategies.target_contact(view, radius * strategy.target_normal, strategy.target_normal, radius)
    verdict = replay(strategy, tool, tool.contact("jaw"), target, contact, transforms.make(translation=[0.7, 0, radius]))
    assert verdict.success, verdict.message


@pytest.mark.parametrize("seed", [2, 7, 40, 99])
def test_mugs_hang_by_their_handles(seed: int) -> None:
    strategy = strategies.load(FOLDER / "hanging")
    mug = mug_set(1, seed)[0]
    verdict = replay(
        strategy,
        mug,
        mug.contact("handle", towards=(-1, 0, -1)),
        made(strategy, "target"),
        strategy.target_contact,
        demonstrated_pose(strategy.environment),
    )
    assert verdict.success, verdict.message


@pytest.mark.parametrize(("family", "radius"), [("spoon", 0.035), ("ladle", 0.045), ("measuring_cup", 0.035)])
def test_other_spoons_scoop_other_balls(family: str, radius: float) -> None:
    strategy = strategies.load(FOLDER / "scooping")
    tool, target = make(family, 0), make("sphere", 0, radius=radius)
    view = make_strategies.target_view(target, "section", strategy.target_view_direction)
    contact = make_strategies.target_contact(view, radius * strategy.target_normal, strategy.target_normal, radius)
    verdict = replay(strategy, tool, tool.contact("bowl", towards=(0, 0, 1)), target, contact, make_strategies.scooped_ball(radius))
    assert verdict.success, verdict.message
