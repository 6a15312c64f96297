"""One node of the graph as a process that can be killed; matcher, planner, verifier and perception are stand-ins."""

from __future__ import annotations

import os
import time
from typing import Any

#: What a process of each role serves.
SERVICES = {"matcher": ("match",), "planner": ("plan",), "verifier": ("verify",), "perception": ("objects",)}
#: A run with this seed, or match with this top_k, is not answered by the process of the role that it is for.
HELD = 77


def serve(role: str, domain: int, parameters: list[str], blind: bool) -> None:
    """Be this node until killed.  ``blind``: perception sees nothing."""
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    if role == "strategy_server":
        from magic_core.node import run
        from magic_server.strategy_server import StrategyServer

        run(StrategyServer, threads=6, args=["--ros-args", *parameters])
        return
    import rclpy

    from magic_core.executor import ThreadedExecutor
    from magic_server.testing import fakes

    rclpy.init(domain_id=domain)
    node = fakes.FakeServers(role, SERVICES[role])

    def unless_held(mark: int, answer: Any) -> Any:
        if mark == HELD:
            time.sleep(60.0)
        return answer

    node.on_match = lambda request: unless_held(request.top_k, node.match(request))
    node.on_plan = lambda goal, canceled: unless_held(goal.seed, node.plan(goal, canceled))
    node.on_verify = lambda goal, canceled: unless_held(goal.seed, node.verify(goal, canceled))
    if role == "perception" and not blind:
        node.publish(fakes.scene())
        node.create_timer(0.2, lambda: node.publish(fakes.scene()))
    executor = ThreadedExecutor(4)
    executor.add_node(node)
    while True:
        executor.spin_once(timeout_sec=1.0)
