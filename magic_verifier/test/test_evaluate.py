"""The evaluation counts right, goes on where it stopped, and takes any mesh."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("magic_matcher.matching")
pytest.importorskip("magic_planner.object_motion")

from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_verifier import evaluate as ev
from magic_verifier.decomposition import convex_pieces
from magic_verifier.simulation import sphere_of, usable_pieces

STRATEGIES = str(Path(__file__).resolve().parents[2] / "ros2_ws/src/magic_bringup/strategies")
OPTIONS = ev.Options("scooping", "fg", "magic", "embedded", "", "", "", 0, 3, None, STRATEGIES)


@pytest.mark.parametrize(
    ("good", "count", "low", "high"), [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)]
)
def test_wilson_interval(good, count, low, high):
    # Newcombe 1998, table I, method 3.
    assert ev.wilson(good, count) == pytest.approx((low, high), abs=1e-4)


def test_the_sets_have_the_sizes_that_the_tasks_ask_for():
    assert len(ev.cases(OPTIONS)) == 18
    assert len(ev.cases(replace(OPTIONS, task="hanging"))) == 134
    assert len(ev.cases(replace(OPTIONS, task="hooking", variant="fg_no_selection"))) == 20
    selecting = ev.cases(replace(OPTIONS, task="hooking"))
    assert len(selecting) == 5
    assert all(len(case.tools) == 4 for case in selecting)
    names = [case.name for case in ev.cases(replace(OPTIONS, task="hanging"))]
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


def test_a_folder_without_meshes_is_refused(tmp_path):
    with pytest.raises(MagicError) as error:
        ev.cases(replace(OPTIONS, objects=str(tmp_path)))
    assert error.value.code == Code.BAD_REQUEST


def _volume(pieces):
    return sum(trimesh.convex.convex_hull(p.vertices).volume for p in pieces)


def test_pieces_of_a_ring_fill_it_and_leave_its_hole_open():
    ring = trimesh.creation.torus(0.05, 0.01)
    pieces = convex_pieces(Mesh(ring.vertices, ring.faces))
    assert _volume(pieces) == pytest.approx(ring.volume, rel=0.15)
    assert all(np.linalg.norm(p.vertices[:, :2], axis=1).min() > 0.035 for p in pieces)


def test_a_convex_mesh_is_one_piece():
    ball = trimesh.creation.icosphere(3, 0.03)
    pieces = convex_pieces(Mesh(ball.vertices, ball.faces))
    assert len(pieces) == 1
    assert sphere_of(usable_pieces("ball", pieces)[0])[1] == pytest.approx(0.03, rel=0.02)


@pytest.mark.parametrize("damage", ["holes", "flipped", "sheet", "many"])
def test_damaged_meshes_get_pieces_in_bounded_time(damage):
    mesh = trimesh.creation.annulus(0.03, 0.04, 0.05)
    if damage == "holes":
        mesh.update_faces(np.random.default_rng(0).random(len(mesh.faces)) > 0.2)
    elif damage == "flipped":
        mesh.faces[::3] = mesh.faces[::3, ::-1]
    elif damage == "sheet":
        mesh = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
    else:
        mesh = trimesh.creation.icosphere(7, 0.05)  # 327,680 triangles
    pieces = convex_pieces(Mesh(mesh.vertices, mesh.faces))
    assert usable_pieces(damage, pieces)


@pytest.mark.parametrize(
    "mesh",
    [Mesh(np.zeros((0, 3)), np.zeros((0, 3))), Mesh(np.eye(3) * 1e-5, np.array([[0, 1, 2]])), Mesh(np.eye(3) * 100, np.array([[0, 1, 2]]))],
)
def test_meshes_that_cannot_be_simulated_are_refused(mesh):
    with pytest.raises(MagicError) as error:
        convex_pieces(mesh)
    assert error.value.code == Code.BAD_MESH
