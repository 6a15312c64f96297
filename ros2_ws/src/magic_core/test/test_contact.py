"""Contact frames."""

import numpy as np

from magic_core import transforms as tf
from magic_core.contact import OPPOSED, contact_frame, turned_over
from magic_core.scene import CanonicalView


def view():
    mask = np.ones((10, 10), bool)
    # Seen from above with +x up: right is -y, into the picture is -z.
    rotation = np.column_stack([[0, -1, 0], [-1, 0, 0], [0, 0, -1]]).astype(float)
    return CanonicalView(np.zeros((10, 10, 3), np.uint8), mask, 0.01, tf.make(rotation, [0.1, 0, 0.02]))


def test_axes_of_the_contact_frame():
    frame = contact_frame(view(), np.array([4.5, 0.0]), np.array([0.0, -1.0]))
    np.testing.assert_allclose(frame[:3, 3], [0.145, 0, 0.02])
    np.testing.assert_allclose(frame[:3, 0], [1, 0, 0], atol=1e-12)  # outward: up in the picture, +x
    np.testing.assert_allclose(frame[:3, 2], [0, 0, -1], atol=1e-12)  # the view direction
    np.testing.assert_allclose(frame[:3, 1], np.cross(frame[:3, 2], frame[:3, 0]), atol=1e-12)


def test_squarely_touching_surfaces():
    met = contact_frame(view(), np.array([4.5, 0.0]), np.array([0.0, -1.0])) @ OPPOSED
    np.testing.assert_allclose(met[:3, 0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(met[:3, 2], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(OPPOSED @ OPPOSED, np.eye(4))
    assert np.linalg.det(OPPOSED) == 1


def test_turning_over_keeps_the_normal_and_is_its_own_inverse():
    frame = contact_frame(view(), np.array([2.0, 3.0]), np.array([1.0, 0.0]))
    turned = turned_over(frame)
    np.testing.assert_allclose(turned[:3, 0], frame[:3, 0])
    np.testing.assert_allclose(turned[:3, 2], -frame[:3, 2])
    np.testing.assert_allclose(np.linalg.det(turned[:3, :3]), 1.0)
    np.testing.assert_allclose(turned_over(turned), frame)
