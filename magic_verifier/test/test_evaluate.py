"""The evaluation counts right, goes on where it stopped, and takes any mesh."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial import ConvexHull

pytest.importorskip("magic_matcher.matching")
pytest.importorskip("magic_planner.object_motion")

from magic_core import decomposition, shapes, transforms
from magic_core import strategy as strategies
from magic_core.decomposition import ABOVE, convex_pieces
from magic_core.errors import Code, MagicError
from magic_core.goal import Goal
from magic_core.mesh import Mesh
from magic_core.rendering import Raycaster
from magic_core.shapes import make
from magic_core.strategy import Physics
from magic_verifier import evaluate as ev
from magic_verifier import posing
from magic_verifier.cases import METHODS, Options, all_cases, strategy_for, tool_names
from magic_verifier.simulation import sphere_of, usable_pieces
from magic_verifier.subjects import Case, load_object, tool_object
from magic_verifier.toolsets import evaluation_of

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")
OPTIONS = Options("scooping", strategies=STRATEGIES)


@pytest.mark.parametrize(
    ("good", "count", "low", "high"), [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)]
)
def test_wilson_interval(good, count, low, high):
    # Newcombe 1998, table I, method 3.
    assert ev.wilson(good, count) == pytest.approx((low, high), abs=1e-4)


def test_the_sets_have_the_sizes_that_the_tasks_ask_for():
    assert len(all_cases(OPTIONS)) == 18
    assert len(all_cases(replace(OPTIONS, task="hanging"))) == 134
    assert len(all_cases(replace(OPTIONS, task="hooking", variant="fg_no_selection"))) == 20
    selecting = all_cases(replace(OPTIONS, task="hooking"))
    assert len(selecting) == 5
    assert all(len(case.tools) == 4 for case in selecting)
    names = [case.name for case in all_cases(replace(OPTIONS, task="hanging"))]
    assert len(set(names)) == len(names)


def test_an_evaluation_is_written_and_goes_on_where_it_stopped(tmp_path):
    first = ev.evaluate(OPTIONS, tmp_path, limit=2, films=True, log=lambda _text: None)
    assert first["cases"] == 2
    heard = []
    again = ev.evaluate(OPTIONS, tmp_path, limit=3, films=False, log=heard.append)
    assert "2 of 3 cases are done already" in heard[0]
    assert again["cases"] == 3
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results) == {"cases", "summary"}
    for case in results["cases"]:
        assert {"object", "success", "reason", "candidates", "simulations", "seconds"} <= set(case)
        assert case["simulations"] >= 1
        assert case["seconds"]["total"] > 0
    assert results["summary"]["interval_95"] == list(ev.wilson(again["successes"], 3))
    assert (tmp_path / "successes.png").exists() or (tmp_path / "failures.png").exists()
    with pytest.raises(MagicError) as error:
        ev.evaluate(replace(OPTIONS, seed=1), tmp_path, limit=1, log=lambda _text: None)
    assert error.value.code == Code.BAD_REQUEST


@pytest.mark.parametrize(
    ("options", "name"),
    [
        # Between the arms of a V there is no place that looks like the corner of a hook.
        (Options("hooking", "fg_no_selection", set="alphabet"), "capital:V cylinder:0.035"),
        # A ring hardly wider than the cylinder was lowered on to it, where only its middle is clear.
        (Options("hooking", "fg_no_selection", set="alphabet"), "capital:Q cylinder:0.03"),
        # On the rod the engine tells a velocity of a V that does not move: it never came to rest.
        (Options("hanging", set="alphabet"), "capital:V"),
        # Met 58 mm from one end of a bar, a row of cylinders passed that end.
        (Options("sweeping"), "plain_bar:70007"),
    ],
)
def test_what_geometry_allows_is_done(options, name):
    (case,) = [case for case in all_cases(options) if case.name == name]
    found = ev.run_case(options, case)
    assert found["success"], found["candidates"]


def test_a_folder_without_meshes_is_refused(tmp_path):
    with pytest.raises(MagicError) as error:
        all_cases(replace(OPTIONS, objects=str(tmp_path)))
    assert error.value.code == Code.BAD_REQUEST


def _volume(pieces):
    return sum(trimesh.convex.convex_hull(p.vertices).volume for p in pieces)


def test_pieces_of_a_ring_fill_it_and_leave_its_hole_open():
    ring = trimesh.creation.torus(0.05, 0.01)
    pieces = convex_pieces(Mesh(ring.vertices, ring.faces))
    assert _volume(pieces) == pytest.approx(ring.volume, rel=0.15)
    assert all(np.linalg.norm(p.vertices[:, :2], axis=1).min() > 0.0385 for p in pieces)


def test_a_convex_mesh_is_one_piece():
    ball = trimesh.creation.icosphere(3, 0.03)
    pieces = convex_pieces(Mesh(ball.vertices, ball.faces))
    assert len(pieces) == 1
    assert sphere_of(usable_pieces("ball", pieces)[0])[1] == pytest.approx(0.03, rel=0.02)


def test_a_thin_hollow_thing_is_not_taken_for_convex():
    """Cubes as large as a shallow spoon is thick would fill its bowl."""
    shape = shapes.make(
        "spoon", 5, bowl_half_length=0.03, bowl_half_width=0.02, depth=0.006, wall=0.003, handle=0.25, handle_thickness=0.005
    )
    pieces = convex_pieces(shape.mesh)
    assert len(pieces) > 5
    assert _volume(pieces) < 1.6 * _volume(shape.pieces)
    plate = trimesh.creation.box(extents=[0.3, 0.05, 0.004])
    assert len(convex_pieces(Mesh(plate.vertices, plate.faces))) == 1


def _dish(depth, width, floor=0.003, rim=0.02):
    """A board with a spherical hollow of that depth and width at its top, z = 0, and the ball that made it: centre and radius."""
    radius = (depth**2 + (width / 2) ** 2) / (2 * depth)
    size = width + 2 * rim
    board = trimesh.creation.box(extents=[size, size, depth + floor])
    board.apply_translation([0, 0, -(depth + floor) / 2])
    ball = trimesh.creation.icosphere(5, radius)
    ball.apply_translation([0, 0, radius - depth])
    dish = board.difference(ball)
    return Mesh(dish.vertices, dish.faces), np.array([0, 0, radius - depth]), radius


def _into(pieces, centre, radius):
    """How far pieces reach into a ball, m, by points all over their surfaces, within the plane z = 0."""
    points = np.concatenate([trimesh.sample.sample_surface(trimesh.convex.convex_hull(p.vertices), 2000, seed=0)[0] for p in pieces])
    return float((radius - np.linalg.norm(points - centre, axis=1))[points[:, 2] < 1e-6].max())


@pytest.mark.parametrize(("depth", "width"), [(0.02, 0.08), (0.005, 0.06)])
def test_pieces_follow_a_hollow_of_known_depth(depth, width):
    mesh, centre, radius = _dish(depth, width)
    # Long as a spoon is: cubes as coarse as for one.
    handle = trimesh.creation.box(extents=[0.5, 0.02, 0.006])
    handle.apply_translation([0.25 + width / 2 + 0.01, 0, -0.004])
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces).union(handle)
    pieces = convex_pieces(Mesh(whole.vertices, whole.faces))
    assert _into(pieces, centre, radius) < ABOVE + 0.0003
    # Followed, not left out: what is beneath the hollow is there, and no piece lies outside of the solid but by that.
    assert _volume(pieces) == pytest.approx(whole.volume, rel=0.08)
    assert len(pieces) < 400


def test_a_bowl_without_thickness_stays_whole_and_open():
    ball = trimesh.creation.icosphere(4, 0.04)
    cap = ball.slice_plane([0, 0, -0.01], [0, 0, -1])
    plane = trimesh.creation.box(extents=[0.3, 0.02, 0.003])
    plane.apply_translation([0.189, 0, -0.0115])
    whole = trimesh.util.concatenate([cap, plane])
    pieces = convex_pieces(Mesh(whole.vertices, whole.faces))
    assert _into(pieces, np.zeros(3), 0.04) < ABOVE + 0.0003
    planes = [ConvexHull(p.vertices).equations for p in pieces]
    points = trimesh.sample.sample_surface(cap, 1000, seed=0)[0]
    gap = np.min([(points @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0)
    assert gap.max() < 0.001


def test_furrows_in_which_nothing_can_lie_are_cut_no_further(monkeypatch):
    board = trimesh.creation.box(extents=[0.1, 0.05, 0.01])
    for x in np.linspace(-0.04, 0.04, 10):
        furrow = trimesh.creation.box(extents=[0.002, 0.06, 0.012])
        furrow.apply_translation([x, 0, 0.005])
        board = board.difference(furrow)
    mesh = Mesh(board.vertices, board.faces)
    count = len(convex_pieces(mesh))
    monkeypatch.setattr(decomposition, "ABOVE", np.inf)
    assert len(convex_pieces(mesh)) == count > 1


@pytest.mark.parametrize(
    "mesh",
    [Mesh(np.zeros((0, 3)), np.zeros((0, 3))), Mesh(np.eye(3) * 1e-5, np.array([[0, 1, 2]])), Mesh(np.eye(3) * 100, np.array([[0, 1, 2]]))],
)
def test_meshes_that_cannot_be_simulated_are_refused(mesh):
    with pytest.raises(MagicError) as error:
        convex_pieces(mesh)
    assert error.value.code == Code.BAD_MESH


# ---------------------------------------------------------------- what is tested, and how


def test_hooking_is_judged_by_the_released_codes_own_test():
    hooking = replace(OPTIONS, task="hooking")
    assert ev._strategy(hooking).goal.values["noise"] == 1.0
    assert ev._strategy(hooking, "caliper:1").goal.values["distance"] == 0.2
    assert ev._strategy(hooking, "watch:1").goal.values["distance"] == 0.1
    assert ev._strategy(replace(hooking, noise=0.0)).goal.values["noise"] == 0.0
    said = ev.summarise(hooking, [])["test"]
    assert "kicked sideways, by 1 of its radius" in said and "watch: distance 0.1" in said
    assert "by 0.5 of its radius" in ev.summarise(replace(hooking, noise=0.5), [])["test"]
    with pytest.raises(MagicError, match="its goal names no such number"):
        ev.tested(replace(OPTIONS, noise=1.0))


def test_the_noise_of_a_named_tree_may_be_set(monkeypatch):
    hooking = replace(OPTIONS, task="hooking")
    own = ev.strategy_for(hooking)
    monkeypatch.setattr(ev, "strategy_for", lambda _options: replace(own, goal=Goal("hook")))
    values = ev.tested(replace(hooking, noise=0.5))
    assert Goal("hook", values).resolved().trial["kicked"]["radii"] == values["noise"] == 0.5
    monkeypatch.setattr(ev, "strategy_for", lambda _options: replace(own, goal=Goal("push")))
    with pytest.raises(MagicError, match="its goal names no such number"):
        ev.tested(replace(hooking, noise=0.5))


def test_a_strategy_is_evaluated_by_its_folder_and_no_task_is_known_by_name(tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(Path(STRATEGIES) / "pushing", folder)
    options = Options(str(folder), set="own")
    cases = all_cases(options)
    assert len(cases) == 36 and {case.target for case in cases} == {"block:1", "block:2", "block:3"}
    answer = ev.run_case(options, cases[0])
    assert answer["success"], answer
    source = "".join(Path(ev.__file__).with_name(name).read_text() for name in ("evaluate.py", "cases.py", "subjects.py", "toolsets.py"))
    assert not [name for name in ("hooking", "hanging", "scooping", "pushing", "hammering") if f'"{name}"' in source]


def test_what_is_asked_of_one_strategy_can_be_asked_of_another(tmp_path):
    """So is what is learned from a demonstration tried: it has no sets, and a goal of its own."""
    shipped = strategies.find("scooping", STRATEGIES)
    learned = replace(shipped, name="spooning", goal=shipped.goal.with_values({"height": 0.1}), environment={}, physics=Physics())
    (tmp_path / "spooning").mkdir()
    strategies.save(learned, tmp_path / "spooning")
    options = Options(str(tmp_path / "spooning"), set="unseen", seed=2)
    with pytest.raises(MagicError, match="set of spooning: 'unseen'"):
        all_cases(options)
    like = replace(options, like="scooping")
    assert all_cases(like) == all_cases(replace(OPTIONS, set="unseen", seed=2))
    found = strategy_for(like)
    assert found.name == "spooning" and found.goal == shipped.goal and found.physics == shipped.physics
    assert found.environment == shipped.environment


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"targets": "cylinder:1"}, "environment.evaluation.targets: 'cylinder:1' (allowed: a list of names)"),
        ({"tools": []}, "environment.evaluation: key: 'tools'"),
        ({"sets": {"own": {"tool": []}}}, "environment.evaluation.sets.own: key: 'tool'"),
        ({"sets": {"own": {"each": ["mug:{}"]}}}, "tools, or each with a count above 0"),
        ({"sets": {"own": {"each": ["mug:{}", "mug:{seed}"], "count": 2}}}, "a name with {} where its number goes"),
        ({"values": {"distanse": 1.0}}, "goal.values of the tree: 'distanse'"),
    ],
)
def test_what_is_wrong_with_the_sets_of_a_strategy_is_said(change, says):
    strategy = strategies.find("pushing", STRATEGIES)
    wrong = replace(strategy, environment={**strategy.environment, "evaluation": change})
    with pytest.raises(MagicError) as error:
        evaluation_of(wrong)
    assert error.value.code == Code.BAD_STRATEGY and says in error.value.message


def test_sets_that_a_strategy_does_not_have_are_refused():
    with pytest.raises(MagicError, match="set of scooping: 'hammers'"):
        all_cases(replace(OPTIONS, set="hammers"))
    names = tool_names(replace(OPTIONS, task="hooking", set="unseen", seed=2))
    assert len(names) == 60 and names[0] == "caliper:50120"


@pytest.mark.parametrize("method", [m for m in METHODS if m != "no_feature_pca_patch"])
def test_every_method_runs_a_case(method):
    options = replace(OPTIONS, task="hooking", variant="fg_no_selection", method=method)
    answer = ev.run_case(options, all_cases(options)[1])
    assert answer["reason"] in Code.__members__, answer
    assert answer["candidates"]
    if method == "no_simulation_verification":
        assert answer["simulations"] <= 1


def test_what_the_features_do_not_have_cannot_be_left_out(tmp_path):
    with pytest.raises(MagicError, match="dinov2"):
        ev.evaluate(replace(OPTIONS, method="no_feature_pca_patch"), tmp_path, limit=1, log=lambda _text: None)


def test_a_mug_is_hung_on_a_mug_tree():
    options = replace(OPTIONS, task="hanging", targets="mug_tree")
    assert len(all_cases(options)) == 3 * 134
    answer = ev.run_case(options, all_cases(options)[0])
    assert answer["success"], answer


# ---------------------------------------------------------------- folders of meshes


def _folder(tmp_path, poses=None, turn=None):
    """A folder with one mug, turned on its side, and perhaps poses.yaml."""
    mug = make("mug", 1).mesh
    (tmp_path / "mugs").mkdir()
    mug.transformed(np.eye(4) if turn is None else turn).save(tmp_path / "mugs" / "mine.obj")
    if poses is not None:
        (tmp_path / "poses.yaml").write_text(yaml.safe_dump(poses))
    return mug


def test_a_mug_from_a_file_is_set_upright_and_hung(tmp_path):
    turn = transforms.from_rpy(np.pi / 2, 0, 0)
    _folder(tmp_path, turn=turn)
    options = replace(OPTIONS, task="hanging", objects=str(tmp_path))
    (case,) = all_cases(options)
    assert case.name == "mugs/mine"
    tool = tool_object(case.tools[0], 0, "side")
    assert tool.mesh.extents == pytest.approx(make("mug", 1).mesh.extents, abs=1e-3)
    answer = ev.run_case(options, case)
    assert answer["success"], answer


def test_poses_yaml_says_how_a_mesh_stands_and_how_large_it_is(tmp_path):
    turn = transforms.from_rpy(0, np.pi / 2, 0)
    contact = {"point": [0.0, 0.0, 0.02], "normal": [0, 0, 1], "direction": [1, 0, 0]}
    entry = {"orientation": transforms.quaternion_xyzw(turn).tolist(), "scale": 0.5, "contact": contact}
    mug = _folder(tmp_path, {"mugs/mine.obj": entry})
    (name,) = tool_names(replace(OPTIONS, task="hanging", objects=str(tmp_path), scale=2.0))
    mesh, pieces, _, meeting = load_object(name, "side")
    assert mesh.extents == pytest.approx(np.abs(turn[:3, :3]) @ mug.extents, abs=1e-4)
    assert np.abs(mesh.bounds.sum(axis=0)).max() < 1e-9
    assert pieces
    assert meeting.direction == pytest.approx(turn[:3, 0], abs=1e-9)


@pytest.mark.parametrize(
    "poses",
    [
        {"mugs/mine.obj": {"scale": -1}},
        {"mugs/mine.obj": {"scael": 1}},
        {"mugs/mine.obj": {"orientation": [0, 0, 0]}},
        {"mugs/mine.obj": {"contact": {"point": [0, 0, 0], "normal": [1, 0, 0], "direction": [2, 0, 0]}}},
        {"mugs/other.obj": {"scale": 1}},
        ["mugs/mine.obj"],
    ],
)
def test_a_wrong_poses_yaml_is_refused_by_name(tmp_path, poses):
    _folder(tmp_path, poses)
    with pytest.raises(MagicError) as error:
        all_cases(replace(OPTIONS, task="hanging", objects=str(tmp_path)))
    assert error.value.code == Code.BAD_REQUEST
    assert "poses.yaml" in error.value.message


@pytest.mark.parametrize(("family", "kind"), [("mug", "side"), ("spoon", "section"), ("measuring_cup", "section"), ("caliper", "top")])
def test_the_canonical_pose_of_a_shape_that_is_upright_is_its_own(family, kind):
    assert posing.canonical_turn(make(family, 2).mesh, kind) == pytest.approx(np.eye(4))


@pytest.mark.parametrize(("family", "kind"), [("mug", "side"), ("spoon", "section"), ("hanger", "top")])
def test_the_canonical_pose_of_a_turned_shape_brings_its_top_up(family, kind):
    turn = transforms.from_rpy(0.7, 0.5, 0.3)
    found = posing.canonical_turn(make(family, 3).mesh.transformed(turn), kind)
    up = (found @ turn)[2, :3]
    assert (abs(up[2]) if kind == "top" else up[2]) > np.cos(np.deg2rad(12))


def test_a_cup_holds_what_is_inside_it():
    cup = trimesh.creation.annulus(0.03, 0.034, 0.08)
    bottom = trimesh.creation.cylinder(0.034, 0.004)
    bottom.apply_translation([0, 0, -0.038])

    def held(mesh):
        return posing.capacity(Raycaster([Mesh(mesh.vertices, mesh.faces)]), mesh.vertices, np.eye(4))

    assert held(trimesh.util.concatenate([cup, bottom])) == pytest.approx(np.pi * 0.03**2 * 0.076, rel=0.08)
    assert held(cup) == 0.0  # open below


def test_meshes_that_are_no_bodies_have_their_code_and_the_others_go_on(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    shapes.mug_of_set(0).mesh.save(folder / "mug.obj")
    (folder / "one_triangle.obj").write_text("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    angles = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    ring = [f"v {r * np.cos(a):.5f} 0 {r * np.sin(a):.5f}" for r in (0.03, 0.05) for a in angles]
    faces = [f"f {i + 1} {(i + 1) % 24 + 1} {i + 25}\nf {(i + 1) % 24 + 1} {(i + 1) % 24 + 25} {i + 25}" for i in range(24)]
    (folder / "sheet_ring.obj").write_text("\n".join([*ring, *faces]) + "\n")
    (folder / "empty.obj").write_text("")
    summary = ev.evaluate(
        Options("hanging", objects=str(folder), strategies=STRATEGIES), tmp_path / "out", films=False, log=lambda text: None
    )
    results = {c["object"]: c for c in json.loads((tmp_path / "out/results.json").read_text())["cases"]}
    assert {name: results[name]["reason"] for name in results} == {
        "empty": "BAD_MESH",
        "mug": "OK",
        "one_triangle": "BAD_MESH",
        "sheet_ring": "BAD_MESH",
    }
    assert (summary["cases"], summary["successes"]) == (4, 1)


def test_a_tool_or_a_scene_that_is_not_told_ends_the_evaluation(tmp_path):
    """As failures of the method they would lower the rate."""
    case = Case("a name", ("l_hok:52000",), "cylinder:0.02")
    with pytest.raises(MagicError, match="'l_hok'"):
        ev.attempt(Options("hooking", variant="fg_no_selection", strategies=STRATEGIES), case, None)
    strategies.save(replace(strategies.load(Path(STRATEGIES) / "hooking"), environment={}), tmp_path / "hooking")
    with pytest.raises(MagicError, match="world_from_target: 'missing'"):
        ev.attempt(Options("hooking", variant="fg_no_selection", strategies=str(tmp_path)), replace(case, tools=("l_hook:1",)), None)


def test_a_set_without_a_case_is_refused_and_is_no_rate(tmp_path, monkeypatch):
    monkeypatch.setattr(ev, "all_cases", lambda _options: [])
    with pytest.raises(MagicError, match="cases of the set controls of hooking: 0"):
        ev.evaluate(Options("hooking", set="controls", strategies=STRATEGIES), tmp_path / "out", log=lambda _text: None)
    assert not (tmp_path / "out").exists()


def test_a_case_that_breaks_does_not_end_the_others(tmp_path, monkeypatch):
    def run_case(options, case, film=None):
        raise ZeroDivisionError("in the middle")

    monkeypatch.setattr(ev, "run_case", run_case)
    summary = ev.evaluate(
        Options("hooking", variant="fg_no_selection", strategies=STRATEGIES), tmp_path, limit=2, films=False, log=lambda text: None
    )
    assert summary["reasons"] == {"INTERNAL": 2}
    assert "in the middle" in json.loads((tmp_path / "results.json").read_text())["cases"][0]["candidates"][0]["message"]
