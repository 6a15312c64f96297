"""What the demo measures and makes of answers, without any node."""

import threading
from types import SimpleNamespace

import pytest
from rclpy.task import Future

from magic_bringup.demo import Pending, perceive_seconds
from magic_core.errors import Code

LEFT = [f"/camera/left/{part}/camera_info" for part in ("color", "aligned_depth_to_color")]
RIGHT = [topic.replace("left", "right") for topic in LEFT]


@pytest.mark.parametrize(
    "heard, objects_at, seconds",
    [
        ({**dict(zip(LEFT, (1.0, 1.5))), **dict(zip(RIGHT, (1.1, 1.3)))}, 3.0, 1.7),  # right was whole first
        (dict(zip(LEFT, (1.0, 1.5))), 3.0, 1.5),  # right was never whole
        (dict(zip(LEFT, (1.0, 3.5))), 3.0, 2.0),  # objects before this node had heard a whole set
        (dict(zip(LEFT, (3.1, 3.5))), 3.0, 2.5),  # and before it had heard anything: since the replay began
        ({}, 3.0, 2.5),
    ],
)
def test_perceive_is_never_less_than_it_took(heard, objects_at, seconds):
    assert perceive_seconds(heard, LEFT + RIGHT, objects_at, replay_at=0.5) == pytest.approx(seconds)


def test_a_refused_goal_is_an_answer():
    """A server that is about to end takes no goals; waiting for a result would last as long as a whole run may."""
    sent = Future()
    pending = Pending(SimpleNamespace(changed=threading.Condition()), sent)
    assert pending.result is None
    sent.set_result(SimpleNamespace(accepted=False))
    assert (pending.result.code, pending.result.verified) == (Code.SERVER_UNAVAILABLE, False)
