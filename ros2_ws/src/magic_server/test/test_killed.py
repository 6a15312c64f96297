"""A node that is killed while a run is at any stage: the run's client has an answer soon, and the next run works."""

import contextlib
import multiprocessing
import os
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import killed_roles
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from magic_core import presence, qos
from magic_core import strategy as strategies
from magic_core.domain import free_domain
from magic_core.errors import Code, MagicError
from magic_core.executor import ThreadedExecutor
from magic_interfaces.action import RunStrategy
from magic_server.remote import RemoteAction, Token
from magic_server.testing import fakes

ROLES = ("perception", "matcher", "planner", "verifier", "strategy_server")
STAGES = ("perceive", "match", "plan", "verify", "execute")
#: From the kill to the client's answer, s: the lease of 3 s of fastdds.xml, and what is waited beyond it for a participant to come back.
LIMIT = 5.0
#: For everything else, s.
DEADLINE = 60.0

PARAMETERS = {
    "server_timeout": 10.0,
    "execute": "true",
    "autostart": "true",
    "state_age": 10.0,
    "objects_age": 60.0,
    "trajectory_action": "arm/follow_joint_trajectory",
    "gripper_action": "gripper/gripper_action",
    **{name: str(value).lower() for name, value in fakes.OPEN_LOOP.items()},
}
#: In which stage a role itself is at work.
OWN = {"perception": "perceive", "matcher": "match", "planner": "plan", "verifier": "verify"}
#: The service by which a role is known to be there.
SERVES = {
    "matcher": "/match_contact",
    "planner": "/plan_motion/_action/send_goal",
    "verifier": "/verify_motion/_action/send_goal",
    "strategy_server": "/run_strategy/_action/send_goal",
}


class Bench:
    """One role as a process, the others here, and a client.  Cells of one bench come one after the other, ``perceive`` first."""

    def __init__(self, processes, role, domain, folder):
        self.processes, self.role, self.domain = processes, role, domain
        values = {"strategies": str(folder), **PARAMETERS}
        self.parameters = [x for k, v in values.items() for x in ("-p", f"{k}:={v}")]
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        here = tuple(s for r, ss in killed_roles.SERVICES.items() for s in ss if r != role)
        self.fakes = fakes.FakeServers(services=here, context=self.context)
        self.fakes.on_match = lambda request: self.at("match", self.fakes.match(request))
        self.fakes.on_plan = lambda goal, canceled: self.at("plan", self.fakes.plan(goal, canceled))
        self.fakes.on_verify = lambda goal, canceled: self.at("verify", self.fakes.verify(goal, canceled))
        self.arm = fakes.FakeArm(context=self.context)
        self.arm.on_move = lambda trajectory, canceled: self.at("execute", (0, ""))
        self.node = Node("client", context=self.context)
        self.client = RemoteAction(self.node, RunStrategy, "run_strategy", "strategy server", ReentrantCallbackGroup())
        self.known = threading.Event()
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, qos.RELIABLE)
        self.executor = ThreadedExecutor(8, context=self.context)
        for node in (self.fakes, self.arm, self.node):
            self.executor.add_node(node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()
        self.stage, self.reached, self.killed = "", threading.Event(), threading.Event()
        self.running = {}
        self.start("strategy_server")

    def start(self, role, blind=False):
        arguments = (role, self.domain, self.parameters, blind)
        process = self.processes.Process(target=killed_roles.serve, args=arguments, daemon=True)
        process.start()
        self.running[role] = process

    def kill(self, role):
        process = self.running.pop(role)
        process.kill()
        process.join(DEADLINE)

    def at(self, stage, answer):
        """Of the nodes that are here: wait in the stage of the cell until the kill."""
        if stage == self.stage:
            self.reached.set()
            assert self.killed.wait(DEADLINE)
        return answer

    def on_diagnostics(self, message):
        if any(s.name == "strategy_server: readiness" and f"{self.role} (" not in s.message for s in message.status):
            self.known.set()

    def feedback(self, feedback):
        if feedback.stage == self.stage and self.stage in ("perceive", OWN.get(self.role)):
            self.reached.set()

    def seen(self):
        """The processes of the role that the graph knows."""
        if self.role == "perception":
            return presence.publishers(self.node, "/objects")
        return presence.servers(self.node, SERVES[self.role])

    def see(self):
        if self.role != "perception":
            self.fakes.publish(fakes.scene())

    def run(self, variant):
        """(code, message) of one run; the code is SERVER_UNAVAILABLE too where the strategy server itself has gone."""
        goal = RunStrategy.Goal(strategy="fake", variant=variant, tool_id="object_1", target_id="object_2", timeout=40.0)
        if self.stage == OWN.get(self.role):
            goal.top_k = goal.seed = killed_roles.HELD
        try:
            result = self.client.call(goal, DEADLINE, Token(), presence=30.0, feedback=self.feedback).result
        except MagicError as error:
            return int(error.code), error.message
        return result.code, result.message

    def cell(self, stage):
        """Kill the role in this stage of a run: what the run's client heard after how many seconds, and of the next run."""
        self.stage = stage
        self.reached.clear()
        self.killed.clear()
        self.arm.positions = [0.0] * 7
        if self.role not in self.running:
            self.start(self.role, blind=True)
        # Who is killed before the strategy server knows of it has never been there, and is waited for.
        assert self.known.wait(DEADLINE), f"the strategy server does not find the {self.role}"
        if stage != "perceive":
            self.see()
        with ThreadPoolExecutor(1) as pool:
            answer = pool.submit(self.run, "arm" if stage == "execute" else "fg")
            assert self.reached.wait(DEADLINE), f"the run did not come to {stage}: {answer.result() if answer.done() else 'at work'}"
            self.kill(self.role)
            began = time.monotonic()
            self.killed.set()
            self.see()
            code, message = answer.result(DEADLINE)
            seconds = time.monotonic() - began
        self.stage = ""
        before = self.seen()
        self.start(self.role)
        deadline = time.monotonic() + DEADLINE
        while not self.seen() - before:
            assert time.monotonic() < deadline, "the node that was started again is not seen"
            time.sleep(0.02)
        self.see()
        following = self.run("fg")
        return code, message, seconds, following

    def close(self):
        self.killed.set()
        for role in list(self.running):
            self.kill(role)
        self.executor.shutdown(timeout_sec=2.0)
        for node in (self.fakes, self.arm, self.node):
            node.destroy_node()
        rclpy.try_shutdown(context=self.context)
        self.thread.join(5.0)


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """What came of all cells.  Most of their time is waiting, so that those of different roles wait together."""
    folder = tmp_path_factory.mktemp("strategies")
    strategies.save(fakes.strategy("fake"), folder / "fake")
    # Processes come from one that has imported everything: the start of a node takes no time that counts here.
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["magic_server.strategy_server", "magic_server.testing.fakes", "killed_roles"])
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *filter(None, [before])])
    main, name = sys.modules["__main__"], getattr(sys.modules["__main__"], "__spec__", None)
    main.__spec__ = None  # the processes need nothing of pytest's own main module
    sys.modules["killed_roles"] = killed_roles  # forgotten when the next folder was collected; pickle looks functions up by name
    domains: list[int] = []
    for _ in ROLES:
        domains.append(free_domain(exclude=tuple(domains)))

    def work(role, domain):
        bench = Bench(processes, role, domain, folder)
        found = {}
        try:
            for stage in STAGES:
                try:
                    found[stage] = bench.cell(stage)
                except Exception as error:  # the other cells are told all the same
                    found[stage] = error
                    bench.killed.set()
                    for left in set(bench.running) - {"strategy_server"}:
                        bench.kill(left)
                    if "strategy_server" not in bench.running:
                        bench.start("strategy_server")
        finally:
            bench.close()
        return found

    try:
        with ThreadPoolExecutor(len(ROLES)) as pool:
            futures = {role: pool.submit(work, role, domain) for role, domain in zip(ROLES, domains)}
            yield {role: future.result() for role, future in futures.items()}
    finally:
        main.__spec__ = name
        with contextlib.suppress(KeyError):
            del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("role", ROLES)
def test_a_killed_node(cells, role, stage):
    outcome = cells[role][stage]
    if isinstance(outcome, Exception):
        raise outcome
    code, message, seconds, following = outcome
    assert seconds < LIMIT, f"{Code(code).name} after {seconds:.1f} s: {message}"
    # Who is asked for something after its death is missed, by name; who has done its part is not.
    order = {r: STAGES.index(s) for r, s in OWN.items()}
    missed = role == "strategy_server" or order[role] >= STAGES.index(stage)
    if missed:
        assert code == Code.SERVER_UNAVAILABLE, f"{Code(code).name}: {message}"
        assert role.replace("_", " ") in message, message
    else:
        assert code == Code.OK, f"{Code(code).name}: {message}"
    assert following[0] == Code.OK, f"the next run: {Code(following[0]).name}: {following[1]}"
