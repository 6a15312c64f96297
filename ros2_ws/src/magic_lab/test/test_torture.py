"""The strategy server with an arm in the laboratory: what goes wrong has its code, the arm stands, and the next goal works.

Server and laboratory are the real ones; perception is a stand-in that knows where things are, and the plan is a fixed one: above a
block, down, fingers round it, and up.
"""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from lab_scenes import ABOVE, HOME, empty, lowered, robot
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

import magic_lab.node
from magic_core import conversions, qos
from magic_core import strategy as strategies
from magic_core.actions import ActionClient
from magic_core.domain import free_domain
from magic_core.errors import Code
from magic_core.executor import ThreadedExecutor
from magic_core.motion import ArmMotion, MotionPlan
from magic_core.scene import Scene
from magic_interfaces.action import PlanMotion, RunStrategy
from magic_interfaces.msg import SceneObjectArray
from magic_interfaces.srv import MatchContact
from magic_server.strategy_server import StrategyServer
from magic_server.testing import fakes

DEADLINE = 60.0


def plan():
    """Above the block at 1.4 s, round it at 2 s, up again at 2.6 s."""
    rows = np.array([HOME, ABOVE, lowered(0.07), ABOVE])
    still = np.zeros_like(rows)
    arm = ArmMotion(np.array([0.0, 1.4, 2.0, 2.6]), robot().names, rows, still, still, np.eye(4), 0.03, 2.0, None)
    return MotionPlan("arm", fakes.plan("fg").tool_motion, arm)


class Rig:
    """Laboratory, server, stand-ins and a client in one process."""

    def __init__(self, folder):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=free_domain())
        self.lab = self.made(magic_lab.node.LabNode, camera_rate=0.1, rate=1.0)
        # All nodes share one interpreter: what is told may come a second late, on a busy machine more.
        settings = {"objects_age": 1.5, "state_age": 2.0, "objects_timeout": 1.0, "server_timeout": 5.0, "effort": 40.0, **fakes.OPEN_LOOP}
        self.server = self.made(StrategyServer, strategies=folder, execute=True, autostart=True, use_sim_time=True, **settings)
        self.fakes = fakes.FakeServers(services=("match", "plan", "verify"), context=self.context)
        self.fakes.on_match = self.match
        self.fakes.on_plan = lambda goal, _canceled: PlanMotion.Result(plan=conversions.plan_to_msg(plan(), goal.tool.id))
        self.node = Node("client", context=self.context)
        self.objects = self.node.create_publisher(SceneObjectArray, "objects", qos.LATCHED)
        self.client = ActionClient(self.node, RunStrategy, "run_strategy")
        self.reset_client = self.node.create_client(Trigger, "lab/reset")
        self.node.create_timer(0.2, self.perceive)
        self.executor = ThreadedExecutor(16, context=self.context)
        self.nodes = (self.lab, self.server, self.fakes, self.node)
        for node in self.nodes:
            self.executor.add_node(node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()
        self.until(lambda: self.client.server_is_ready() and self.reset_client.service_is_ready() and not self.server._arm.ready())

    def made(self, kind, **values):
        """A node that takes no arguments, with this rig's context and parameters."""
        given = [x for k, v in values.items() for x in ("-p", f"{k}:={str(v).lower() if isinstance(v, bool) else v}")]
        original = Node.__init__

        def init(node, *args, **kwargs):
            original(node, *args, **{**kwargs, "context": self.context, "cli_args": ["--ros-args", *given]})

        Node.__init__ = init
        try:
            return kind()
        finally:
            Node.__init__ = original

    def until(self, condition, timeout=DEADLINE):
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.01)

    @staticmethod
    def match(request):
        found = conversions.candidate_to_msg(fakes.candidate("tool_1"))
        return MatchContact.Response(code=0, candidates=[found], target_id="target", features="fake")

    def perceive(self):
        """Objects where they are, as long as the cameras say anything."""
        lab = self.lab.lab
        if lab.silent.camera:
            return
        items = []
        for name in ("tool_1", "target"):
            pose = lab.world.pose(name)
            if pose[0, 3] > -1.0:  # what was taken away is not seen
                items.append(replace(lab.scene.thing(name).item, world_from_object=pose))
        self.objects.publish(conversions.scene_to_msg(Scene(tuple(items), np.array([0.0, 0.0, 1.0, 0.0]), self.lab.now)))

    def begin(self, events=""):
        """The scene anew, the arm at home, and told so."""
        assert self.lab.set_parameters([Parameter("events", value=events)])[0].successful
        done = self.reset_client.call_async(Trigger.Request())
        self.until(done.done)
        assert done.result().success, done.result().message
        since = self.lab.now
        self.until(lambda: self.server.scene is not None and conversions.time_from_msg(self.server.scene.header.stamp) > since)

    def run(self):
        """The result of one run."""
        sent = self.client.send_goal_async(RunStrategy.Goal(strategy="fake", variant="arm", tool_id="tool_1", target_id="target"))
        self.until(sent.done)
        answer = sent.result().get_result_async()
        self.until(answer.done)
        return answer.result().result

    def stands(self):
        """Whether nothing is at work and the arm stands still soon."""
        lab = self.lab.lab
        end = lab.time + 0.6
        self.until(lambda: lab.time > end)
        return lab.arm.goal is None and lab.gripper.goal is None and float(np.abs(lab.joints[1]).max()) < 0.02

    def close(self):
        self.lab.wind_down()
        self.executor.shutdown(timeout_sec=5.0)
        for node in self.nodes:
            node.destroy_node()
        rclpy.shutdown(context=self.context)
        self.thread.join(5.0)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    root = tmp_path_factory.mktemp("strategies")
    strategies.save(fakes.strategy("fake"), root / "fake")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(magic_lab.node, "draw", lambda *_args: empty())
        it = Rig(root)
        yield it
        it.close()


@pytest.mark.parametrize(
    "events, codes",
    [
        ("abort@1+0.5", {Code.EXECUTION_FAILED}),
        ("block@1+0.4", {Code.EXECUTION_FAILED}),
        ("take_tool@1+0.5", {Code.GRASP_FAILED, Code.SCENE_CHANGED}),
        ("take_target@1+0.5", {Code.SCENE_CHANGED}),
        ("freeze@1+0.2", {Code.STALE_DATA}),
        ("silence@1+0.2", {Code.STALE_DATA}),
    ],
)
def test_what_goes_wrong_has_its_code_and_the_arm_stands(rig, events, codes):
    rig.begin(events)
    result = rig.run()
    assert Code(result.code) in codes, f"{Code(result.code).name}: {result.message}"
    assert not result.executed
    assert rig.stands()
    assert [event.kind for event in rig.lab.lab.happened] == [events.partition("@")[0]]


def test_a_cancel_leaves_the_arm_where_it_is(rig):
    rig.begin()
    sent = rig.client.send_goal_async(RunStrategy.Goal(strategy="fake", variant="arm", tool_id="tool_1", target_id="target"))
    rig.until(sent.done)
    lab = rig.lab.lab
    rig.until(lambda: lab.arm.goal is not None)
    answer = sent.result().get_result_async()
    sent.result().cancel_goal_async()
    rig.until(answer.done)
    assert answer.result().result.code == Code.CANCELED
    assert rig.stands() and lab.moves == 1


def test_what_is_no_scene_is_refused_and_the_old_one_stays(rig):
    before = rig.lab.lab
    for name, value in (("scenario", "circus"), ("events", "fire@1"), ("seed", -1)):
        assert not rig.lab.set_parameters([Parameter(name, value=value)])[0].successful
    assert rig.lab.set_parameters([Parameter("object", value="teapot")])[0].successful
    done = rig.reset_client.call_async(Trigger.Request())
    rig.until(done.done)
    assert not done.result().success and "teapot" in done.result().message and rig.lab.lab is before
    assert rig.lab.set_parameters([Parameter("object", value="")])[0].successful


def test_after_all_of_that_the_next_goal_is_carried_out(rig):
    rig.begin()
    result = rig.run()
    assert (result.code, result.executed) == (Code.OK, True), result.message
    assert rig.stands()
    assert rig.lab.lab.world.held == "tool_1" and rig.lab.lab.world.pose("tool_1")[2, 3] > 0.07
