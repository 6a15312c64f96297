"""A tool is followed through ray-cast pictures of a motion that is known, with a hand about its handle."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from magic_core import transforms
from magic_core.camera import Intrinsics, RgbdFrame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.sensor import SMEARED, STATION, capture, scene_raycaster
from magic_core.shapes import make
from magic_core.testing.hand import coming, hand
from magic_perception.following import BLIND, CLOSE, SOUGHT, UNSURE, Followed, Follower, _known, follow, reshaped_along
from magic_perception.paths import moved
from magic_perception.reshaped import divided, raycaster
from magic_perception.tool_colors import Said, ToolColors, lab

SMALL = Intrinsics(424, 240, 307.5, 307.5, 212.0, 120.0)
TABLE = np.array([0.0, 0.0, 1.0, 0.0])
RATE = 10.0
SPOON = {"bowl_half_length": 0.046, "bowl_half_width": 0.044, "depth": 0.030, "wall": 0.003, "handle": 0.24, "rise": 0.0}


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


def pictures(hook, times, poses, held=True, model=SMEARED, gone=np.inf, held_at=(-0.09, 0.0, 0.0), beside=()):
    grip = transforms.frame(held_at, [1.0, 0, 0], [0, 0, 1.0])
    skin, frames = hand(0.02), []
    for k, (t, pose) in enumerate(zip(times, poses, strict=True)):
        meshes = [hook.mesh.transformed(pose)] if t < gone else []
        meshes += beside[k : k + 1]
        if held and t > 0.15:
            meshes.append(skin.transformed(pose @ grip @ transforms.make(translation=coming(t - 0.15, 0.15))))
        caster = scene_raycaster(meshes)
        frames += [
            capture([], SMALL, station, [5, k, number], camera=name, stamp=100.0 + t, raycaster=caster, model=model)
            for number, (name, station) in enumerate(STATION.items())
        ]
    return frames


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


def scooped():
    """A spoon with a hand on its handle, and a ball of another colour that stands about at first, then lies in its bowl: spoon, poses (T,
    4, 4), times (T,), pictures, and the ball where it stood."""
    spoon, ball = make("spoon", 1, **SPOON), make("sphere", 3, radius=0.035)
    times, poses = path(spoon)
    middle = spoon.contact("bowl", spoon.view("section"), towards=(0, 0, 1)).object_from_contact[:3, 3] + [0, 0, 0.035]
    stood = transforms.make(translation=[0.5, 0.15, 0.035])
    held_at = (float(spoon.mesh.bounds[0, 0]) + 0.03, 0.0, 0.0)
    balls = [ball.mesh.transformed(stood if k < 4 else pose @ transforms.make(translation=middle)) for k, pose in enumerate(poses)]
    return spoon, times, poses, pictures(spoon, times, poses, held_at=held_at, beside=balls), ball.mesh.transformed(stood)


def test_a_ball_in_the_bowl_of_a_spoon_is_not_the_bowl():
    spoon, times, poses, frames, ball = scooped()
    found = follow(spoon.mesh, poses[0], TABLE, frames, [ball])
    shift, turn = errors(found, spoon, times, poses)
    assert shift.max() < 0.005 and turn.max() < np.deg2rad(6)
    assert np.sqrt(((turn / found.turn)[1:] ** 2).mean()) < 1.5  # and it is known how well


def test_where_no_colour_tells_the_ball_from_the_spoon_the_track_is_refused(monkeypatch):
    spoon, _, poses, frames, ball = scooped()
    monkeypatch.setattr(
        ToolColors, "said", lambda _, frame: Said(np.full(frame.depth.shape, 0.1, np.float32), np.zeros(frame.depth.shape, bool))
    )
    with pytest.raises(MagicError, match=r"known to .* mm and .* degrees") as caught:
        follow(spoon.mesh, poses[0], TABLE, frames, [ball])
    assert caught.value.code == Code.BAD_MOTION


def test_a_track_that_cameras_contradict_is_refused(hook):
    """One camera is moved by 20 mm on the way: nothing else tells of it."""
    times, poses = path(hook)
    aside = transforms.make(translation=[0.02, 0.0, 0.0])
    frames = [
        frame if frame.camera == "left" or frame.stamp < 100.9 else replace(frame, world_from_camera=aside @ frame.world_from_camera)
        for frame in pictures(hook, times, poses)
    ]
    with pytest.raises(MagicError, match=r"known to .* mm and .* degrees") as caught:
        follow(hook.mesh, poses[0], TABLE, frames)
    assert caught.value.code == Code.BAD_MOTION and "more of it in sight" in caught.value.message


@pytest.mark.parametrize("late", [0.0, 0.02])
def test_a_mesh_is_mended_along_a_path_that_something_else_tells(hook, late):
    """A hand is about it, and the other's clock may differ."""
    times, poses = path(hook)
    solid = trimesh.Trimesh(*divided(hook.mesh.vertices, hook.mesh.faces, 0.006), process=True)
    thin = Mesh(solid.vertices - 0.0025 * solid.vertex_normals, solid.faces)
    surface, shown = reshaped_along(thin, poses[0], TABLE, pictures(hook, times, poses), 100.0 + times + late, poses)
    assert shown >= 3
    # What no camera sees of it, its lower side and what the hand holds, stays as it was.
    points, _ = trimesh.sample.sample_surface(hook.mesh.to_trimesh(), 3000, seed=0)
    points = points[(points[:, 0] > -0.03) & (points[:, 2] > hook.mesh.bounds[:, 2].mean())]
    before, after = (
        np.abs(raycaster(mesh).compute_signed_distance(points.astype(np.float32)).numpy()).mean() for mesh in (thin, surface.mended()[0])
    )
    assert after < 0.5 * before
    # Where the path ends nothing is known: no picture after it counts.
    assert reshaped_along(thin, poses[0], TABLE, pictures(hook, times, poses), 100.0 + times[:14], poses[:14])[1] < shown


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


def test_the_outline_by_colours_is_where_it_is_and_not_where_they_mix():
    """Brown on brown wood: what lies between both is a colour of the bowl's as well."""
    spoon, _, poses, frames, _ = scooped()
    follower = Follower(spoon.mesh, poses[0], TABLE)
    follower.learn_colors(frames[:2])
    off = []
    for k in range(2, len(poses), 3):
        for frame in frames[2 * k : 2 * k + 2]:
            aside = follower.outline(frame, poses[k], follower.colors.said(frame), SOUGHT[1])
            off.append(aside.off @ aside.weights / aside.weights.sum())
            follower.see_around([frame], poses[k])
    assert abs(np.mean(off)) < 0.0005 and np.max(np.abs(off)) < 0.0015


def test_a_pixel_alone_is_not_another_thing():
    colors, color = ToolColors(), np.full((40, 60, 3), (70, 40, 20), np.uint8)
    color[:, 30:] = (205, 160, 135)
    frame = RgbdFrame(color, np.ones((40, 60), np.float32), Intrinsics(60, 40, 50.0, 50.0, 30.0, 20.0), np.eye(4), "left", 0.0)
    colors.learn(lab(frame)[:, :30].reshape(-1, 3), np.zeros((50, 3), np.uint8), [])
    for _ in range(20):
        colors.see_moving(lab(frame)[:, 30:].reshape(-1, 3))
    color[20, 40] = color[0, 0]
    color[20, 10] = color[0, -1]
    tool, touches = colors.said(frame)
    assert (tool[:, :29] > 0).all() and not touches[:, :29].any()
    assert (tool[:, 31:] < 0).all() and touches[:, 31:].all()


def test_what_is_looked_through_tells_of_a_wrong_pose_and_not_of_the_edge_of_a_right_one(hook):
    times, poses = path(hook)
    follower, nothing = Follower(hook.mesh, poses[0], TABLE), (np.zeros((0, 3)), np.zeros(0, bool))
    for k in (9, 12, 16):
        for frame in pictures(hook, times[k : k + 1], poses[k : k + 1]):
            information, _ = follower._information(frame, poses[k], nothing, CLOSE)
            assert not information.any()  # the hand hides one end: what pulls at the other would shift the tool along its handle
            information, _ = follower._information(frame, moved(poses[k], follower.middle, np.r_[0.03, 0, 0, 0, 0, 0]), nothing, CLOSE)
            assert information.any()


def test_a_tool_that_is_gone_is_lost_and_not_guessed_on(hook):
    times, poses = path(hook)
    with pytest.raises(MagicError) as caught:
        follow(hook.mesh, poses[0], TABLE, pictures(hook, times, poses, held=False, gone=1.0))
    assert caught.value.code == Code.BAD_MOTION and "the tool is lost" in caught.value.message
    # It says so as soon as it may, and not from before the tool was gone.
    moment = float(caught.value.message.split("lost ")[1].split(" s")[0])
    assert 1.0 - BLIND < moment < 1.0 + 2 / RATE


def test_a_path_ends_where_it_was_known_last_if_that_is_near_its_end():
    times = np.arange(20) / RATE
    turn = np.where(times > 1.65, 2.0, 0.5) * UNSURE[1]
    assert _known(times, np.zeros(20), turn) == 17
    assert _known(times, np.zeros(20), np.where(times > 1.9 - BLIND - 0.15, 2.0, 0.5) * UNSURE[1]) == 20  # too much for that: it is refused
    assert _known(times, np.where(times == times[5], 2.0, 0.5) * UNSURE[0], np.zeros(20)) == 20


def test_pictures_come_in_the_order_of_their_stamps(hook):
    times, poses = path(hook)
    frames = list(pictures(hook, times[:3], poses[:3], held=False))
    with pytest.raises(MagicError, match="in the order of their stamps"):
        follow(hook.mesh, poses[0], TABLE, [frames[0], frames[4], frames[2]])
    with pytest.raises(MagicError) as caught:
        follow(hook.mesh, poses[0], TABLE, frames[:1])
    assert caught.value.code == Code.NO_FRAMES
