"""The D435 model against its own statement: steps, noise, edges, shadow, range, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.sensor import D435, SMEARED, DepthModel, capture, degrade, looking_at, smeared, table_mesh
from magic_core.shapes import make

SMALL = Intrinsics(320, 240, 307.5, 307.5, 160.0, 120.0)
QUIET = DepthModel(noise=0.0, dropout=0.0)


def wall(depth: float, intrinsics: Intrinsics = SMALL) -> tuple[np.ndarray, np.ndarray]:
    shape = (intrinsics.height, intrinsics.width)
    return np.full(shape, depth, np.float32), np.ones(shape, np.float32)


def test_noise_grows_with_the_square_of_the_distance() -> None:
    model = DepthModel()
    distances = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
    measured = []
    for z in distances:
        depth = degrade(*wall(float(z)), SMALL, 1, model)
        assert np.nanmean(depth) == pytest.approx(z, rel=2e-3)
        measured.append(np.nanstd(depth))
    # Quantisation adds step / sqrt(12); the noise dominates.
    expected = [np.hypot(model.sigma(z), model.step(z) / np.sqrt(12)) for z in distances]
    np.testing.assert_allclose(measured, expected, rtol=0.12)
    slope = np.polyfit(np.log(distances), np.log(measured), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)


def test_depth_comes_in_steps_of_a_32nd_of_a_disparity_pixel() -> None:
    z = np.linspace(1.9, 2.1, SMALL.width, dtype=np.float32)
    depth = degrade(np.tile(z, (SMALL.height, 1)), np.ones((SMALL.height, SMALL.width), np.float32), SMALL, 0, QUIET)
    disparity = QUIET.focal * QUIET.baseline / np.unique(depth[np.isfinite(depth)]).astype(float)
    steps = disparity / QUIET.subpixel
    # Depth is rounded to whole millimetres, which is 0.14 of a step here.
    assert np.abs(steps - np.round(steps)).max() < 0.1
    assert np.diff(np.sort(np.unique(np.round(depth[np.isfinite(depth)], 3)))).min() == pytest.approx(QUIET.step(1.9), abs=0.0011)
    assert DepthModel().step(0.7) == pytest.approx(0.0008, abs=5e-5)


def test_depth_is_whole_millimetres_within_range() -> None:
    depth = degrade(*wall(0.8), SMALL, 3)
    seen = depth[np.isfinite(depth)].astype(float) * 1000
    assert np.abs(seen - np.round(seen)).max() < 1e-3
    assert np.isnan(degrade(*wall(0.1), SMALL, 3)).all()
    assert np.isnan(degrade(*wall(4.0), SMALL, 3)).all()
    assert np.isnan(degrade(np.full((240, 320), np.nan, np.float32), np.ones((240, 320), np.float32), SMALL, 3)).all()


def test_edges_lose_depth_and_flat_parts_do_not() -> None:
    depth, cosine = wall(1.0)
    depth[:, 160:] = 0.6
    measured = degrade(depth, cosine, SMALL, 0, QUIET)
    lost = np.isnan(measured).mean(axis=0)
    assert lost[158:162].mean() > 0.3
    assert lost[:120].max() == 0 and lost[170:].max() == 0


def test_smear_reaches_past_edges_by_half_a_window_and_fills_narrow_gaps_only() -> None:
    depth, _ = wall(1.0)
    depth[60:180, 100:200] = 0.8
    depth[111:115, 120:180] = 1.0  # a gap of 4 pixels of this image, less than is filled
    depth[80:100, 120:180] = 1.0  # one of 20
    result = smeared(depth, SMALL, 0, SMEARED)
    most = SMEARED.window / 2 * SMALL.fx / SMEARED.focal
    reach = np.argmax(np.abs(result[70, 200:] - 1.0) < 1e-6)
    assert 1 <= reach <= np.ceil(most)
    assert np.all(result[112, 130:170] < 0.85)
    assert np.all(result[90, 130:170] > 0.99)
    np.testing.assert_array_equal(result, smeared(depth, SMALL, 0, SMEARED))
    np.testing.assert_array_equal(
        degrade(depth, np.ones_like(depth), SMALL, 4), degrade(depth, np.ones_like(depth), SMALL, 4, DepthModel())
    )


def test_near_things_cast_a_shadow_on_their_left() -> None:
    depth, cosine = wall(1.0)
    depth[:, 160:] = 0.6
    lost = np.isnan(degrade(depth, cosine, SMALL, 0, QUIET)).all(axis=0)
    # Width of the strip: difference of the disparities, f b (1 / 0.6 - 1 / 1.0) in pixels of this image.
    expected = SMALL.fx * QUIET.baseline * (1 / 0.6 - 1.0)
    assert lost[151:160].all()
    assert lost[100:160].sum() == pytest.approx(expected, abs=1.5)
    # On its right nothing is hidden.
    depth, cosine = wall(1.0)
    depth[:, :160] = 0.6
    assert not np.isnan(degrade(depth, cosine, SMALL, 0, QUIET))[:, 165:].any()


def test_grazing_surfaces_and_random_pixels_are_holes() -> None:
    depth, cosine = wall(0.8)
    assert np.isnan(degrade(depth, 0.05 * cosine, SMALL, 0)).all()
    assert not np.isnan(degrade(depth, 0.5 * cosine, SMALL, 0, QUIET)).any()
    share = np.isnan(degrade(depth, cosine, SMALL, 0)).mean()
    assert share == pytest.approx(DepthModel().dropout, rel=0.4)


def test_a_frame_sees_the_scene_where_it_is_and_is_a_function_of_the_seed() -> None:
    pose = looking_at([0.9, 0.3, 0.6], [0.5, 0.0, 0.0])
    cylinder = make("cylinder", 0, radius=0.035)
    mesh = cylinder.mesh.transformed(transforms.make(translation=[0.5, 0, 0.035]))
    first = capture([mesh], SMALL, pose, 7, camera="left", stamp=1.5)
    again = capture([mesh], SMALL, pose, 7, camera="left", stamp=1.5)
    other = capture([mesh], SMALL, pose, 8)
    np.testing.assert_array_equal(first.color, again.color)
    np.testing.assert_array_equal(first.depth, again.depth)
    assert not np.array_equal(first.color, other.color) and not np.array_equal(first.depth, other.depth, equal_nan=True)
    points = transforms.apply(pose, SMALL.unproject(first.depth)).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    near = points[np.linalg.norm(points[:, :2] - [0.5, 0], axis=1) < 0.025]
    assert np.median(near[near[:, 2] > 0.05, 2]) == pytest.approx(0.07, abs=0.002)
    far = points[np.linalg.norm(points[:, :2] - [0.5, 0], axis=1) > 0.15]
    assert np.median(far[:, 2]) == pytest.approx(0.0, abs=0.001)
    assert (first.camera, first.stamp) == ("left", 1.5)


def test_the_camera_looks_where_it_is_told() -> None:
    pose = looking_at([1.0, 0.4, 0.7], [0.5, 0, 0])
    np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1)
    np.testing.assert_allclose(D435.project(transforms.apply(transforms.inverse(pose), [0.5, 0, 0])), [320, 240], atol=1e-9)
    above = D435.project(transforms.apply(transforms.inverse(pose), [0.5, 0, 0.1]))
    assert above[1] < 240  # up in the world is up in the picture
    assert table_mesh().bounds[1, 2] == 0


def test_a_bad_pose_is_refused() -> None:
    with pytest.raises(MagicError) as caught:
        capture([], SMALL, np.full((4, 4), np.nan), 0)
    assert caught.value.code == Code.BAD_REQUEST
