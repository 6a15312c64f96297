"""What the hand holds is told when the fingers have closed and when they open, in the frame of the hand."""

from types import SimpleNamespace

import numpy as np

from magic_core import conversions, transforms
from magic_server import pipeline
from magic_server.closed_loop import ClosedLoop, Job
from magic_server.held import Held
from magic_server.settings import LoopSettings
from magic_server.testing import fakes

TOOL_FROM_TCP = transforms.from_rpy(np.pi, 0.0, 0.3, [0.01, 0.0, 0.02])


def loop_of(told):
    """A loop about to carry out a plan for the first of two cubes, and a server that notes what it is told."""
    scene = conversions.scene_to_msg(fakes.scene())
    plan = conversions.plan_to_msg(fakes.plan("arm"), "object_1")
    plan.tool_from_tcp = conversions.pose_to_msg(TOOL_FROM_TCP)
    outcome = pipeline.Outcome(0, "", plan=plan, tool_id="object_1", target_id="object_2")
    clock = SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0))
    server = SimpleNamespace(
        tell_held=told.append, hand=lambda: np.eye(4), get_parameter=lambda name: SimpleNamespace(value=False), get_clock=lambda: clock
    )
    job = Job(outcome, SimpleNamespace(scene=scene), SimpleNamespace())
    return ClosedLoop(server, None, LoopSettings(), None, None, job, None), scene.objects[0]


def test_the_tool_is_told_from_closing_to_opening():
    told = []
    loop, tool = loop_of(told)
    loop.closed(0.03)
    (held,) = told
    assert held.tool is tool
    np.testing.assert_allclose(held.tool_from_tcp, TOOL_FROM_TCP, atol=1e-12)
    loop.opened()
    assert told[1:] == [None]


def test_in_the_hand_it_stands_in_the_frame_of_the_hand():
    item = conversions.scene_to_msg(fakes.scene()).objects[0]
    shown = Held(item, TOOL_FROM_TCP).in_hand()
    np.testing.assert_allclose(conversions.pose_from_msg(shown.pose), transforms.inverse(TOOL_FROM_TCP), atol=1e-12)
    assert shown.hanging and not len(shown.cloud.data) and shown.mesh is item.mesh
    assert not item.hanging, "the object as it was seen is as it was"
