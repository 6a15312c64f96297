"""A tool is followed through ray-cast pictures of a motion that is known, with a hand about its handle."""

import numpy as np
import pytest

from magic_core import transforms
from magic_core.camera import Intrinsics
from magic_core.errors import Code, MagicError
from magic_core.sensor import SMEARED, STATION, capture, scene_raycaster
from magic_core.shapes import make
from magic_core.testing.hand import coming, hand
from magic_perception.following import BLIND, Followed, Follower, _apart, _moved, _predicted, _State, follow

SMALL = Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)
TABLE = np.array([0.0, 0.0, 1.0, 0.0])
RATE = 10.0


@pytest.fixture(scope="module")
def hook():
    return make("l_hook", 0, length=0.25, tip=0.07, width=0.02, thickness=0.018, inner_radius=0.03, bend=np.pi / 2)


@pytest.fixture(scope="module")
def hanger():
    """Of wire, in two colours."""
    return make("hanger", 0)


def path(hook):
    """Lying for 0.3 s; then up, across and turned about three axes; and back nearly down: times (T,), world_from_tool (T, 4, 4)."""
    rest = transforms.from_rpy(0, 0, 0.3, [0.44, -0.15, -hook.mesh.bounds[0, 2]])
    up = transforms.from_rpy(0.2, -0.3, 0.6, [0.48, -0.10, 0.16])
    over = transforms.from_rpy(0.0, 0.2, 1.1, [0.56, 0.08, 0.10])
    knots = np.array([0.0, 0.3, 1.2, 2.1])
    times = np.arange(0, 2.1 + 1e-9, 1 / RATE)
    # Smooth between the knots, as a hand is.
    after = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    share = (times - knots[after]) / np.diff(knots)[after]
    eased = knots[after] + (3 * share**2 - 2 * share**3) * np.diff(knots)[after]
    return times, transforms.interpolate(knots, np.stack([rest, rest, up, over]), eased)


def pictures(hook, times, poses, held=True, model=SMEARED, gone=np.inf, held_at=(-0.09, 0.0, 0.0)):
    grip = transforms.frame(held_at, [1.0, 0, 0], [0, 0, 1.0])
    skin = hand(0.02)
    for k, (t, pose) in enumerate(zip(times, poses, strict=True)):
        meshes = [hook.mesh.transformed(pose)] if t < gone else []
        if held and t > 0.15:
            meshes.append(skin.transformed(pose @ grip @ transforms.make(translation=coming(t - 0.15, 0.15))))
        caster = scene_raycaster(meshes)
        for number, (name, station) in enumerate(STATION.items()):
            yield capture([], SMALL, station, [5, k, number], camera=name, stamp=100.0 + t, raycaster=caster, model=model)


def errors(found: Followed, hook, times, poses):
    """Shift of the tool's middle, m, and turn, rad, at each picture."""
    true = transforms.interpolate(times, poses, found.times - 100.0)
    middle = hook.mesh.bounds.mean(axis=0)
    shift = [
        np.linalg.norm(transforms.apply(a, middle) - transforms.apply(b, middle)) for a, b in zip(found.world_from_tool, true, strict=True)
    ]
    return np.array(shift), np.array([transforms.rotation_angle(a, b) for a, b in zip(found.world_from_tool, true, strict=True)])


@pytest.mark.parametrize("held", [False, True], ids=["by nothing", "by a hand"])
def test_a_known_motion_is_recovered(hook, held):
    times, poses = path(hook)
    found = follow(hook.mesh, poses[0], TABLE, pictures(hook, times, poses, held))
    np.testing.assert_allclose(found.times - 100.0, times)  # both cameras' pictures are of one moment
    shift, turn = errors(found, hook, times, poses)
    assert shift.max() < 0.005 and turn.max() < np.deg2rad(3)


def test_a_thin_tool_in_a_hand_is_held_by_its_colours(hanger):
    # Its depth is smeared to twice its breadth, more where the hand is near.
    times, poses = path(hanger)
    found = follow(hanger.mesh, poses[0], TABLE, pictures(hanger, times, poses, held_at=(-0.19, -0.1, 0.0)))
    shift, turn = errors(found, hanger, times, poses)
    assert shift.max() < 0.005 and turn.max() < np.deg2rad(3)


def test_colours_tell_the_tool_from_the_ground_and_from_what_comes(hook):
    times, poses = path(hook)
    frames = [frame for frame in pictures(hook, times, poses) if frame.camera == "left"]
    follower = Follower(hook.mesh, poses[0], TABLE)
    follower.learn_colors(frames[:1])
    for frame, pose in zip(frames[:6], poses[:6], strict=True):
        follower.see_around([frame], pose)
    last, evidence = frames[5], follower.colors.said(frames[5]).tool
    alone, empty = (
        capture([], SMALL, STATION["left"], 0, camera="left", stamp=0.0, raycaster=scene_raycaster(meshes)).depth
        for meshes in ([hook.mesh.transformed(poses[5])], [])
    )
    of_tool = (np.abs(alone - last.depth) < 0.01) & (empty - alone > 0.03)
    of_hand = (empty - last.depth > 0.05) & (np.abs(empty - alone) < 0.005)
    of_table = np.abs(empty - last.depth) < 0.005
    assert min(of_tool.sum(), of_hand.sum()) > 100
    assert (evidence[of_tool] > 0).mean() > 0.8 and (evidence[of_hand] < 0).mean() > 0.8 and (evidence[of_table] < 0).mean() > 0.95


def test_a_tool_that_is_gone_is_lost_and_not_guessed_on(hook):
    times, poses = path(hook)
    with pytest.raises(MagicError) as caught:
        follow(hook.mesh, poses[0], TABLE, pictures(hook, times, poses, held=False, gone=1.0))
    assert caught.value.code == Code.BAD_MOTION and "the tool is lost" in caught.value.message
    # It says so as soon as it may, and not from before the tool was gone.
    moment = float(caught.value.message.split("lost ")[1].split(" s")[0])
    assert 1.0 - BLIND < moment < 1.0 + 2 / RATE


def test_pictures_come_in_the_order_of_their_stamps(hook):
    times, poses = path(hook)
    frames = list(pictures(hook, times[:3], poses[:3], held=False))
    with pytest.raises(MagicError, match="in the order of their stamps"):
        follow(hook.mesh, poses[0], TABLE, [frames[0], frames[4], frames[2]])
    with pytest.raises(MagicError) as caught:
        follow(hook.mesh, poses[0], TABLE, frames[:1])
    assert caught.value.code == Code.NO_FRAMES


def test_a_change_of_pose_is_undone_by_its_inverse():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = transforms.from_rotvec(rng.normal(size=3), rng.normal(size=3))
        middle, change = rng.normal(size=3), rng.normal(size=6) * 0.5
        moved = _moved(pose, middle, change)
        np.testing.assert_allclose(_apart(moved, pose, middle), change, atol=1e-12)
        np.testing.assert_allclose(transforms.apply(moved, middle) - transforms.apply(pose, middle), change[:3], atol=1e-12)


def test_a_prediction_goes_on_as_before_and_knows_less_the_longer_it_is():
    velocity = np.array([0.3, 0.0, 0.1, 0.0, 0.0, 1.0])
    state = _State(np.eye(4), velocity, np.eye(12) * 1e-6)
    middle = np.array([0.1, 0.0, 0.0])
    later, _ = _predicted(state, middle, 0.2)
    np.testing.assert_allclose(transforms.apply(later.pose, middle), middle + 0.2 * velocity[:3])
    assert transforms.rotation_angle(later.pose, state.pose) == pytest.approx(0.2)
    halves, _ = _predicted(_predicted(state, middle, 0.1)[0], middle, 0.1)
    np.testing.assert_allclose(halves.covariance, later.covariance, atol=1e-12)  # the steps do not matter
    assert np.all(np.diag(later.covariance)[:6] > np.diag(state.covariance)[:6])
