"""Meshes: checks, joining, files."""

import numpy as np
import pytest
import trimesh

from magic_core import mesh as meshes
from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh


def box(extents=(0.2, 0.1, 0.3)):
    return meshes.from_trimesh(trimesh.creation.box(extents))


def test_extents_and_volume_survive_a_turn():
    before = box()
    after = before.transformed(transforms.from_rpy(0, 0, np.pi / 2, [1, 2, 3]))
    np.testing.assert_allclose(before.extents, [0.2, 0.1, 0.3])
    np.testing.assert_allclose(after.extents, [0.1, 0.2, 0.3], atol=1e-12)
    assert after.to_trimesh().volume == pytest.approx(0.006)
    assert before.scaled(2).to_trimesh().volume == pytest.approx(0.048)


def test_faces_point_outwards():
    assert box().to_trimesh().volume > 0


def test_hull_of_two_boxes():
    far = box().transformed(transforms.make(translation=[1, 0, 0]))
    joined = meshes.concatenate([box(), far])
    assert (len(joined.vertices), len(joined.faces)) == (16, 24)
    assert joined.convex_hull().to_trimesh().volume == pytest.approx(1.2 * 0.1 * 0.3)


def test_colours_are_kept_where_all_have_them():
    red, plain = box().painted((255, 0, 0)), Mesh(box().vertices, box().faces)
    assert meshes.concatenate([red, red]).colors.tolist() == [[255, 0, 0]] * 16
    assert meshes.concatenate([red, plain]).colors is None
    assert len(meshes.concatenate([]).vertices) == 0


@pytest.mark.parametrize("ending", ["ply", "obj", "stl"])
def test_files_come_back(tmp_path, ending):
    path = tmp_path / f"box.{ending}"
    box().save(path)
    again = meshes.load(path)
    np.testing.assert_allclose(again.bounds, box().bounds, atol=1e-6)
    assert again.to_trimesh().volume == pytest.approx(0.006, rel=1e-5)


def test_ply_keeps_colours(tmp_path):
    box().painted((10, 20, 30)).save(tmp_path / "box.ply")
    assert meshes.load(tmp_path / "box.ply").colors[0].tolist() == [10, 20, 30]


@pytest.mark.parametrize(
    "make",
    [
        lambda p: Mesh(np.zeros((3, 3)), [[0, 1, 3]]),
        lambda p: Mesh(np.zeros((3, 3)), [[0, 1, -1]]),
        lambda p: Mesh([[0, 0, np.nan]], np.zeros((0, 3))),
        lambda p: Mesh(np.zeros((0, 3)), np.zeros((0, 3))).bounds,
        lambda p: meshes.load(p / "missing.ply"),
        lambda p: meshes.load(write(p / "broken.ply", "not a mesh")),
        lambda p: meshes.load(write(p / "empty.obj", "v 0 0 0\n")),
    ],
)
def test_bad_meshes_are_told(tmp_path, make):
    with pytest.raises(MagicError) as error:
        make(tmp_path)
    assert error.value.code == Code.BAD_MESH


def write(path, text):
    path.write_text(text)
    return path


def test_a_mesh_is_frozen():
    with pytest.raises(AttributeError):
        box().vertices = np.zeros((1, 3))
