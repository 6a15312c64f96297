"""What the demo measures and writes, without any node."""

import pytest

from magic_bringup.demo import perceive_seconds

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
