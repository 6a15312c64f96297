"""What a tracker may give, and what it may not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import from_trimesh
from magic_core.sensor import D435, capture, looking_at
from magic_verifier.track import Track, check_above, check_motion, check_raw, check_seen, check_still, seen_through


def motion(rate=30.0, noise=0.0, turn_noise=0.0, seed=0, seconds=4.0):
    """A tool that lies, is taken up, turned, moved to and fro, and held still."""
    knots = [0.0, 0.8, 1.6, 2.4, 3.2, seconds]
    places = [[0.4, 0, 0], [0.4, 0, 0], [0.4, 0.1, 0.2], [0.6, 0.0, 0.1], [0.35, 0, 0.1], [0.35, 0, 0.1]]
    poses = np.stack([transforms.from_rpy(0, 0.3 * k, 0.5 * k if k > 1 else 0, p) for k, p in enumerate(places)])
    poses[0], poses[-1] = poses[1], poses[-2]
    times = np.arange(0, seconds, 1 / rate)
    rng = np.random.default_rng(seed)
    exact = transforms.interpolate(knots, poses, times)
    return times, np.stack([p @ transforms.from_rotvec(rng.normal(0, turn_noise, 3), rng.normal(0, noise, 3)) for p in exact])


@given(
    rate=st.sampled_from([10.0, 30.0, 60.0, 120.0, 1000.0]),
    noise=st.sampled_from([0.0, 1e-4, 1e-3, 2e-3]),
    seed=st.integers(0, 1000),
    jitter=st.sampled_from([0.0, 0.3]),
)
@settings(max_examples=40, deadline=None)
def test_a_hand_is_believed_at_any_rate_and_noise(rate, noise, seed, jitter):
    times, poses = motion(rate, noise, 4 * noise, seed)
    rng = np.random.default_rng(seed)
    times = times + rng.uniform(0, jitter / rate, len(times))
    check_motion("tool", times, poses)


@pytest.mark.parametrize("noise", [0.0, 0.0005])
@pytest.mark.parametrize("rate", [20.0, 30.0, 100.0])
@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda k: transforms.make(translation=[0.06, 0, 0] if k >= 0 else [0, 0, 0]), id="stays off"),
        pytest.param(lambda k: transforms.make(translation=[0, 0.05, 0] if k == 0 else [0, 0, 0]), id="one sample off"),
        pytest.param(lambda k: transforms.from_rpy(np.pi / 2 if k >= 0 else 0, 0, 0), id="marker the other way round"),
        pytest.param(lambda k: transforms.from_rpy(0, 0, np.deg2rad(25) if k == 0 else 0), id="one sample turned"),
    ],
)
def test_jumps_are_refused_with_their_time(change, rate, noise):
    times, poses = motion(rate, noise, 2 * noise)
    at = int(2.0 * rate)
    poses = np.stack([pose @ change(k - at) for k, pose in enumerate(poses)])
    with pytest.raises(MagicError, match=r"jump in tool at (1\.9|2\.[01])\d s: '\d+ (mm|degrees)") as error:
        check_motion("tool", times, poses)
    assert error.value.code == Code.BAD_MOTION


def test_a_gap_and_a_pose_that_is_always_the_same_are_refused():
    times, poses = motion()
    keep = (times < 1.2) | (times > 1.5)
    with pytest.raises(MagicError, match=r"gap in tool from 1\.17 to 1\.5. s: '0\.3. s' \(allowed: at most 0\.25 s\)"):
        check_motion("tool", times[keep], poses[keep])
    with pytest.raises(MagicError, match="the same pose 120 times"):
        check_motion("tool", times, np.repeat(poses[:1], len(times), axis=0))
    with pytest.raises(MagicError, match="two or more"):
        check_motion("tool", times[:1], poses[:1])


def test_a_tracker_that_stops_looking_is_refused():
    times, poses = motion(noise=0.0003)
    poses[(times > 3.3) & (times < 3.8)] = poses[times > 3.3][0]  # while the tool is held still, which a noiseless one would not show
    with pytest.raises(MagicError, match=r"the same pose of tool from 3\.3. to 3\.7. s"):
        check_motion("tool", times, poses)
    times, poses = motion(rate=60)
    poses[(times > 2.45) & (times < 2.75)] = poses[times > 2.45][0]
    with pytest.raises(MagicError, match="tool"):
        check_motion("tool", times, poses)


def raw(times, poses):
    return Track("marker", times, poses[:, :3, 3].copy(), Rotation.from_matrix(poses[:, :3, :3]).as_quat())


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda t: t.stamps.__setitem__(9, t.stamps[7]), "stamp that goes back of marker, 0.27 s"),
        (lambda t: t.stamps.__setitem__(9, t.stamps[8]), "stamp given twice of marker, 0.27 s"),
        (lambda t: t.positions.__setitem__((9, 1), np.nan), "pose of marker, 0.30 s .* finite"),
        (lambda t: t.quaternions.__setitem__((9, 0), np.inf), "finite"),
        (lambda t: t.quaternions.__imul__(1.05), "quaternion of marker, 0.00 s .*: 1.05"),
        (lambda t: t.quaternions.__setitem__(9, 0.0), "quaternion of marker, 0.30 s .*: 0.0"),
        (
            lambda t: (t.positions.__setitem__(slice(9, 12), 0.0), t.quaternions.__setitem__(slice(9, 12), [0, 0, 0, -1.0])),
            "pose of marker, 0.30 s .*'3 of 120 poses are the identity'",
        ),
    ],
)
def test_what_no_tracker_may_give_is_refused_each_in_its_words(spoil, said):
    track = raw(*motion())
    check_raw(track)
    spoil(track)
    with pytest.raises(MagicError, match=said) as error:
        check_raw(track)
    assert error.value.code == Code.BAD_MOTION
    with pytest.raises(MagicError, match="poses of marker: 0"):
        check_raw(Track("marker", np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))))


def test_a_joint_may_stand_at_zero():
    times, poses = motion()
    poses[:] = np.eye(4)
    check_raw(raw(times, poses), tracker=False)


def test_the_tool_lies_still_while_it_is_pictured():
    times, poses = motion(noise=0.0005, turn_noise=0.002)
    check_still("tool", times, poses, 0.1, 0.5)
    with pytest.raises(MagicError, match=r"motion of tool while the first pictures are taken, within 0.50 s: '\d+ mm"):
        check_still("tool", times, poses, 0.9, 1.4)


@pytest.fixture(scope="module")
def pictures():
    """A bar carried before two cameras, pictures every second, and the bar."""
    import trimesh

    bar = from_trimesh(trimesh.creation.box((0.2, 0.03, 0.03)))
    table = from_trimesh(trimesh.creation.box((2, 2, 0.02))).transformed(transforms.make(translation=[0.5, 0, -0.06]))
    times, poses = motion(seconds=4.5)
    frames = []
    for stamp in (0.5, 3.5, 4.2):
        pose = transforms.interpolate(times, poses, [stamp])[0]
        hand = from_trimesh(trimesh.creation.icosphere(2, 0.03)).transformed(pose)
        for number, eye in enumerate(([0.94, 0.42, 0.66], [0.94, -0.42, 0.66])):
            camera = looking_at(eye, [0.5, 0, 0.04])
            meshes = [table, bar.transformed(pose), *([hand] if stamp > 1 else [])]
            frames.append(capture(meshes, D435, camera, [1, number, int(10 * stamp)], camera=str(number), stamp=stamp))
    return bar, times, poses, frames


def test_a_track_that_follows_the_tool_is_believed(pictures):
    bar, times, poses, frames = pictures
    assert check_seen("tool", bar, times, poses, frames) == len(frames)
    off = np.stack([p @ transforms.from_rpy(0, 0, 0.03, [0.004, 0.004, 0.004]) for p in poses])
    assert check_seen("tool", bar, times, off, frames) == len(frames)
    assert check_seen("tool", bar, times, poses, []) == 0


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda p, first: transforms.from_rpy(0, 0, np.pi / 2) @ p, id="another world"),
        pytest.param(lambda p, first: p @ transforms.make(translation=[0, 0, 0.08]) if np.any(p != first) else p, id="not fixed"),
    ],
)
def test_a_track_of_something_else_is_refused(pictures, wrong):
    bar, times, poses, frames = pictures
    with pytest.raises(MagicError, match=r"tool is not where the tool is: .* looks through at \d\.\d\d s: '\d+ %") as error:
        check_seen("tool", bar, times, np.stack([wrong(p, poses[0]) for p in poses]), frames)
    assert error.value.code == Code.BAD_MOTION


def test_a_track_that_goes_the_wrong_way_ends_under_the_table(pictures):
    bar, times, poses, _ = pictures
    table = np.array([0, 0, 1.0, 0.05])
    check_above("tool", bar, times, poses, table)
    inverted = poses[0] @ transforms.inverse(transforms.inverse(poses[0]) @ poses)
    with pytest.raises(MagicError, match=r"tool is under the table at 1.6\d s: '\d+ mm deep'"):
        check_above("tool", bar, times, inverted, table)


def test_what_hides_the_tool_says_nothing(pictures):
    bar, _, poses, frames = pictures
    behind = transforms.make(translation=-0.1 * frames[2].world_from_camera[:3, 2]) @ poses[-1]
    share, count = seen_through(bar, behind, frames[2])
    nearer, _ = seen_through(bar, poses[-1], frames[2])
    assert share > 0.9 and nearer < 0.1 and count > 100
