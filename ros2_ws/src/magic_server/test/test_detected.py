"""Objects by somebody else's detector: their meshes where the detector has them, upright frames, and what has no mesh is a box."""

import numpy as np
import pytest
from foreign import VISION
from hypothesis import given, settings
from hypothesis import strategies as st

from magic_core import conversions, shapes, transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject
from magic_core.upright import placed, upright_box
from magic_server.detected import Meshes, scene_of
from magic_server.testing import fakes

TABLE = np.array([0.0, 0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    shapes.make("l_hook", 1).mesh.save(folder / "hook.ply")
    return Meshes(folder)


def detection(kind, pose, score=0.9, name="", size=(0.0, 0.0, 0.0)):
    out = VISION.Detection3D()
    out.id = name
    result = VISION.ObjectHypothesisWithPose()
    result.hypothesis.class_id, result.hypothesis.score = kind, score
    result.pose.pose = conversions.pose_to_msg(pose)
    out.results = [result]
    out.bbox.center = conversions.pose_to_msg(pose)
    out.bbox.size.x, out.bbox.size.y, out.bbox.size.z = (float(v) for v in size)
    return out


def array_of(*detections):
    out = VISION.Detection3DArray()
    out.header.frame_id, out.header.stamp = "camera", conversions.time_to_msg(12.5)
    out.detections = list(detections)
    return out


CAMERA = transforms.make(translation=[0.1, 0.0, 0.2])


def scene(message, meshes, **options):
    return scene_of(message, meshes, 0.3, TABLE, "panda_link0", lambda header: CAMERA, **options)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31))
def test_the_mesh_stands_where_the_detector_has_it_whatever_was_up_in_its_file(meshes, seed):
    rng = np.random.default_rng(seed)
    pose = transforms.from_quaternion(rng.uniform(-0.3, 0.3, 3), transforms.unit(rng.normal(size=4)))
    found = scene(array_of(detection("hook", pose)), meshes)
    (item,) = found.objects
    mesh, _ = meshes.find("hook")
    np.testing.assert_allclose(
        transforms.apply(item.world_from_object, item.mesh.vertices), transforms.apply(CAMERA @ pose, mesh.vertices), atol=1e-9
    )
    # Its own frame is upright, as that of what cameras reconstruct.
    np.testing.assert_allclose(item.world_from_object[:3, 2], [0.0, 0.0, 1.0], atol=1e-9)
    assert (item.id, item.source, item.confidence, found.stamp, found.frame_id) == ("hook_1", "camera", 0.9, 12.5, "panda_link0")
    assert item.view.mask.any() and item.pieces


def test_the_longer_side_is_x():
    corners = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (0, 0.02)])
    turned = transforms.apply(transforms.from_rpy(0, 0, 0.4, [0.5, 0.2, 0.0]), corners)
    box = upright_box(turned)
    np.testing.assert_allclose(box, transforms.from_rpy(0, 0, 0.4, [0.5, 0.2, 0.01]), atol=1e-4)


def test_what_has_no_mesh_is_a_box_that_nobody_knows(meshes):
    at = transforms.make(translation=[0.4, 0.0, 0.0])
    found = scene(array_of(detection("banana", at, size=(0.2, 0.04, 0.04), name="b7")), meshes)
    (item,) = found.objects
    assert (item.id, item.confidence, item.seen_share) == ("b7", 0.0, 0.0)
    np.testing.assert_allclose(item.box_extents, [0.2, 0.04, 0.04], atol=1e-6)
    assert "no mesh of 'banana' (hook)" in found.notes[0]


def test_what_is_left_out_is_said(meshes):
    at = transforms.make(translation=[0.4, 0.0, 0.0])
    nothing = scene(array_of(detection("banana", at), detection("hook", at, score=0.2), detection("hook", at, score=float("nan"))), meshes)
    assert nothing.objects == () and len(nothing.notes) == 3
    assert "neither a mesh of it nor a box" in nothing.notes[0] and "score 0.20" in nothing.notes[1]


def test_the_best_hypothesis_counts(meshes):
    at = transforms.make(translation=[0.4, 0.0, 0.0])
    both = detection("banana", at, 0.4, size=(0.1, 0.1, 0.1))
    both.results = [*both.results, *detection("hook", at, 0.8).results]
    (item,) = scene(array_of(both), meshes).objects
    assert item.id == "hook_1"


def test_two_of_one_id_are_refused_and_fixtures_are_there_besides(meshes):
    at = transforms.make(translation=[0.4, 0.0, 0.0])
    post = placed("post", fakes.box(), (fakes.box(),), at, "known")
    found = scene(array_of(detection("hook", at)), meshes, known=[post])
    assert [item.id for item in found.objects] == ["hook_1", "post"] and isinstance(found.objects[1], SceneObject)
    with pytest.raises(MagicError) as caught:
        scene(array_of(detection("hook", at, name="post")), meshes, known=[post])
    assert caught.value.code == Code.BAD_REQUEST


def test_a_class_cannot_name_a_file_elsewhere(meshes, tmp_path):
    fakes.box().save(tmp_path / "secret.ply")
    assert meshes.find(f"../{tmp_path.name}/secret") is None and meshes.find("") is None
    with pytest.raises(MagicError):
        Meshes(tmp_path / "nowhere")
