"""The buffer of transforms answers between what it was told, and nowhere else."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.tf import NotYetError, TransformBuffer


def moving(stamps=(1.0, 2.0)):
    """A hand that goes by 0.1 m a second along x, with a camera on it that is turned by a quarter."""
    buffer = TransformBuffer()
    for stamp in stamps:
        buffer.set("base", "hand", transforms.make(None, [0.1 * stamp, 0, 0]), stamp)
    buffer.set("/hand", "camera", transforms.from_rpy(0, 0, np.pi / 2, [0, 0, 0.5]), static=True)
    return buffer


@given(st.floats(1.0, 2.0))
def test_between_two_stamps_it_is_interpolated(stamp):
    buffer = moving()
    pose = buffer.lookup("base", "camera", stamp)
    np.testing.assert_allclose(pose, transforms.from_rpy(0, 0, np.pi / 2, [0.1 * stamp, 0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(buffer.lookup("camera", "base", stamp) @ pose, np.eye(4), atol=1e-12)


@given(st.floats(1e-3, 100.0))
def test_no_pose_is_made_up_beyond_what_came(beyond):
    buffer = moving()
    with pytest.raises(NotYetError) as later:
        buffer.lookup("base", "camera", 2.0 + beyond)
    assert later.value.code is Code.NO_TRANSFORM and later.value.newest == 2.0 and "2.000" in later.value.message
    with pytest.raises(MagicError) as earlier:
        buffer.lookup("base", "camera", 1.0 - beyond)
    assert earlier.value.code is Code.NO_TRANSFORM and not isinstance(earlier.value, NotYetError)
    buffer.set("base", "hand", transforms.make(None, [0.2 + 0.1 * beyond, 0, 0]), 2.0 + beyond)
    assert buffer.lookup("base", "camera", 2.0 + beyond)[0, 3] == pytest.approx(0.2 + 0.1 * beyond)


def test_frames_that_move_together_need_no_stamp_of_what_is_above_them():
    """Between the camera and another thing on the hand nothing moves, whatever the hand does."""
    buffer = moving()
    buffer.set("hand", "finger", transforms.make(None, [0.1, 0, 0]), static=True)
    np.testing.assert_allclose(buffer.lookup("finger", "camera", 99.0)[:3, 3], [-0.1, 0, 0.5], atol=1e-12)


def test_what_is_missing_is_named():
    buffer = moving()
    with pytest.raises(MagicError) as caught:
        buffer.lookup("base", "nowhere")
    assert "nowhere" in caught.value.message and "camera" in caught.value.message
    buffer.refuse("tool", "transform base -> tool: rotation of length 1.25")
    with pytest.raises(MagicError) as caught:
        buffer.lookup("base", "tool")
    assert "length 1.25" in caught.value.message
    buffer.set("base", "tool", np.eye(4), static=True)
    assert not buffer.refused and buffer.lookup("base", "tool") is not None


def test_a_loop_of_frames_is_refused():
    buffer = TransformBuffer()
    buffer.set("a", "b", np.eye(4), static=True)
    buffer.set("b", "a", np.eye(4), static=True)
    with pytest.raises(MagicError, match="loop"):
        buffer.lookup("a", "b")
