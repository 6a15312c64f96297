"""The main job through the five real processes, from recorded bags."""

from pathlib import Path

import numpy as np
import pytest

from magic_bringup import reference
from magic_bringup.graph import NODES
from magic_bringup.testing import ONCE, Bench, started, until
from magic_core import conversions
from magic_core.errors import Code
from magic_server import execution

BAGS = Path(__file__).resolve().parents[1] / "bags"


@pytest.fixture(scope="module", params=["hooking", "hanging", "scooping"])
def replay(request, tmp_path_factory):
    """A graph that has seen one bag: (strategy, bench)."""
    bag = BAGS / request.param
    # With all rollouts for one of them; the others are there for their motions.
    server = {} if request.param == "hooking" else ONCE
    with started(tmp_path_factory.mktemp(request.param), bag, {"strategy_server": server}) as bench:
        bench.ready()
        bench.play(bag)
        yield request.param, bench


def check_trajectory(result, bench: Bench, variant: str) -> None:
    """What is published is what was verified, and it is fit to be executed."""
    came = until(lambda: bench.watcher.trajectory, what="the verified trajectory is published")
    plan = conversions.plan_from_msg(result.plan)
    assert plan.variant == variant
    if variant == "fg":
        assert came.joint_names == [result.tool_id]
        assert len(came.points) == len(plan.tool_motion.times)
        return
    arm = plan.arm_motion
    assert list(came.joint_names) == [f"panda_joint{i}" for i in range(1, 8)]
    assert len(came.points) == len(arm.times)
    assert arm.times[0] == 0
    assert np.all(np.diff(arm.times) > 0)
    # The Panda's joint and velocity limits, from its data sheet.
    low = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
    high = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
    speed = np.array([2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100])
    assert np.all(arm.positions >= low)
    assert np.all(arm.positions <= high)
    assert np.all(np.abs(arm.velocities) <= speed)
    # Velocities are the slopes of the positions: the trapezoidal rule brings each step's end.
    step = np.diff(arm.times)[:, None] * (arm.velocities[1:] + arm.velocities[:-1]) / 2
    np.testing.assert_allclose(np.diff(arm.positions, axis=0), step, atol=5e-3)
    np.testing.assert_allclose(arm.velocities[[0, -1]], 0, atol=1e-3)
    # Arm and gripper can carry it out in turn: the arm stands wherever the fingers move.
    release = np.nan if arm.release_time is None else arm.release_time
    done = execution.steps(arm.times, arm.velocities, arm.grasp_time, release, arm.grasp_width, 0.08)
    assert [type(step) for step in done[:4]] == [execution.Fingers, execution.Move] * 2


def test_nobody_is_told_what_only_a_simulated_laboratory_knows(replay):
    """Of ``lab/truth`` and anything else below ``lab/``; a simulated laboratory's truth is for judging alone."""
    node = replay[1].watcher.node
    told = {info.node_name for info in node.get_subscriptions_info_by_topic("/joint_states")}
    assert {"perception", "strategy_server"} <= told, "subscriptions of the graph are seen"
    listened = {topic: node.get_subscriptions_info_by_topic(topic) for topic, _ in node.get_topic_names_and_types()}
    assert not [topic for topic, infos in listened.items() if topic.startswith("/lab/") and infos]


def test_floating_gripper(replay):
    strategy, bench = replay
    bench.watcher.trajectory = None
    result = bench.run(strategy=strategy, variant="fg")
    assert result.code == 0, f"{Code(result.code).name}: {result.message}\n" + "\n".join(bench.lines)
    assert result.verified
    assert result.simulations >= 1
    assert result.candidates[-1].code == 0
    assert all(c.code != 0 and c.message for c in result.candidates[:-1])
    assert result.tool_id != result.target_id
    assert len(result.film.data)
    assert len(result.heatmap.data)
    check_trajectory(result, bench, "fg")
    assert {line.split(":")[0] for line in bench.lines} >= {"perceive", "match", "plan", "verify"}


def test_the_reference_says_what_the_nodes_say(replay):
    """Parameters and endpoints in docs/reference.md are those of the running nodes."""
    strategy, bench = replay
    if strategy != "hooking":
        pytest.skip("the nodes are the same for every strategy")
    page = (BAGS.parent / "docs/reference.md").read_text()
    for name in NODES:
        rows = reference.parameters_page({name: reference.ask_parameters(bench.watcher.node, name)}).splitlines()
        rows += reference.endpoints_page({name: reference.ask_endpoints(bench.watcher.node, name)}).splitlines()
        for row in rows:
            # This graph is told that it sees a recording.
            assert row in page or row.startswith("| `recorded` |"), (
                f"not in docs/reference.md (ros2 run magic_bringup reference): {name}: {row}"
            )


def test_same_seed_same_trajectory(replay):
    strategy, bench = replay
    if strategy != "hooking":
        pytest.skip("one strategy is enough: what is random is the same for all")
    first = bench.run(strategy=strategy, variant="fg", seed=3)
    second = bench.run(strategy=strategy, variant="fg", seed=3)
    assert first.code == second.code == 0
    assert first.plan.tool_trajectory == second.plan.tool_trajectory


def test_arm(replay):
    strategy, bench = replay
    bench.watcher.trajectory = None
    result = bench.run(strategy=strategy, variant="arm")
    assert result.code == 0, f"{Code(result.code).name}: {result.message}\n" + "\n".join(bench.lines)
    assert result.verified
    check_trajectory(result, bench, "arm")
    assert 0 < result.plan.grasp_width <= 0.08
    bench.graph.sample()
    assert all(mb < 2048 for mb in bench.graph.peak_memory_mb().values()), bench.graph.peak_memory_mb()
