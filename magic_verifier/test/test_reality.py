"""Recorded tosses against simulated ones: the state before the first contact is found, and the scores count right."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_verifier import reality
from magic_verifier.simulation import DYNAMIC, Settings, World

PARAMETERS = Path(__file__).resolve().parents[1] / "config" / "reality.yaml"
DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "contacts"


@pytest.fixture(scope="module")
def setting():
    return reality.load_setting(PARAMETERS)


def recorded(setting, position, velocity, rotation, spin, count):
    """Rows (count, 13) of a cube in free flight, exact."""
    half = setting.edge / 2
    rows = np.zeros((count, 13))
    for k, t in enumerate(np.arange(count) / setting.rate):
        rows[k, :3] = (position + velocity * t - [0, 0, 0.5 * 9.81 * t * t]) / half
        turned = Rotation.from_rotvec(np.multiply(spin, t)) * rotation
        rows[k, 3:7] = np.roll(turned.as_quat(), 1)
        rows[k, 7:10] = (velocity - [0, 0, 9.81 * t]) / half
        rows[k, 10:13] = turned.inv().apply(spin)
    return rows


@pytest.mark.parametrize("count", [2, 12])
def test_the_state_before_the_first_contact_is_found(setting, count):
    position, velocity, spin = np.array([0.1, -0.2, 0.4]), np.array([-0.8, 0.3, 0.2]), np.array([3.0, -4.0, 1.5])
    rotation = Rotation.from_euler("xyz", [0.3, 1.0, -2.0])
    toss = reality.as_toss(1, recorded(setting, position, velocity, rotation, spin, count), setting)
    assert toss.position == pytest.approx(position, abs=1e-9)
    assert toss.velocity == pytest.approx(velocity, abs=1e-6)
    assert toss.spin == pytest.approx(spin, abs=1e-6)
    assert (toss.rotation * rotation.inv()).magnitude() < 1e-6


def test_rows_after_the_first_contact_do_not_count(setting):
    velocity = np.array([0.5, 0.0, 0.0])
    rows = recorded(setting, np.array([0.0, 0.0, 0.2]), velocity, Rotation.identity(), np.zeros(3), 40)
    lowest = rows[:, 2] * setting.edge / 2 - setting.edge / 2
    flying = int(np.argmax(lowest < setting.table + setting.free))
    assert 3 < flying < 40
    rows[flying:, :2] = 7.0
    assert reality.as_toss(1, rows, setting).velocity == pytest.approx(velocity, abs=1e-6)


def test_each_face_has_its_number():
    numbers = {reality.face_up(rotation) for rotation in Rotation.create_group("O")}
    assert numbers == set(range(6))
    assert reality.face_up(Rotation.identity()) == 5
    assert reality.face_up(Rotation.from_euler("x", 170, degrees=True)) == 4


def test_a_cube_dropped_flat_keeps_its_face_and_one_that_tips_changes_it(setting):
    flat = reality.Toss(1, np.array([0, 0, 0.1]), Rotation.identity(), np.zeros(3), np.zeros(3), 5)
    assert set(reality.faces(flat, setting, 6, 0)) == {5}
    # Leaning by 60 degrees about y it falls on to the side that it leans to, by less than what is drawn of its turn.
    leaning = replace(flat, position=np.array([0, 0, 0.075]), rotation=Rotation.from_euler("y", 60, degrees=True))
    assert reality.rollout(leaning, setting, None) == reality.face_up(Rotation.from_euler("y", 90, degrees=True))


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_a_rounded_cube_is_flat_on_its_faces_and_short_at_edges_and_corners(setting, share):
    half, rounding = setting.edge / 2, share * setting.edge
    hull = replace(setting, rounding=rounding).hull
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        reach = hull @ axis
        assert reach.max() == pytest.approx(half)
        flat = hull[reach > half - 1e-9] @ (np.eye(3) - np.outer(axis, axis))
        assert np.abs(flat).max() == pytest.approx(half - rounding)
    for count, way in ((2, [1.0, -1, 0]), (3, [1.0, 1, -1])):
        reach = float((hull @ np.array(way)).max()) / np.sqrt(count)
        assert reach == pytest.approx(np.sqrt(count) * half - (np.sqrt(count) - 1) * rounding)


def test_a_cube_springs_back_by_its_restitution(setting):
    height = {}
    for restitution in (0.0, 0.5):
        world = World(Settings(restitution=restitution, bounce_threshold=reality.BOUNCES))
        world.add_table(np.array([0.0, 0.0, 1.0, 0.0]), 0.2)
        world.add("cube", [setting.hull], transforms.make(translation=[0, 0, 0.1 + setting.edge / 2]), DYNAMIC, setting.density, 0.2)
        upwards = 0.0
        while world.time < 0.25:  # it falls for 0.143 s
            world.step()
            upwards = max(upwards, float(world.velocity("cube")[2]))
        height[restitution] = upwards**2 / (2 * 9.81)
    assert height[0.0] < 1e-4 and height[0.5] == pytest.approx(0.25 * 0.1, rel=0.15)


def test_a_rollout_has_a_seed_of_its_own(setting):
    toss = reality.Toss(
        3, np.array([0, 0, 0.15]), Rotation.from_euler("xyz", [0.4, 0.7, 0.1]), np.array([1.0, 0, 0]), np.array([6.0, 4, 2]), 0
    )
    assert np.array_equal(reality.faces(toss, setting, 6, 0)[:3], reality.faces(toss, setting, 3, 0))


def test_the_scores_of_known_answers():
    answers = np.array([[1, 1, 1, 1], [1, 1, 2, 2], [3, 3, 3, 0], [4, 4, 4, 4]])
    scores = reality.score(answers, np.array([1, 1, 0, 5]))
    assert scores.accuracy == 0.5
    assert scores.brier == pytest.approx(np.mean([0, 0.25, 0.75**2, 1]))
    assert (scores.unanimous, scores.unanimous_accuracy) == (2, 0.5)
    assert (scores.doubtful, scores.doubtful_accuracy) == (2, 0.5)
    assert sum(count for _, _, count in scores.bins) == 4


def test_what_is_not_a_recording_is_refused(setting, tmp_path):
    with pytest.raises(MagicError) as error:
        reality.read(tmp_path, setting)
    assert error.value.code == Code.BAD_REQUEST
    np.savez(tmp_path / "a.npz", **{"1": np.full((5, 13), np.nan)})
    with pytest.raises(MagicError, match="a.npz: 1"):
        reality.read(tmp_path, setting)


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the recorded tosses of ../shared/data/contacts")
def test_recorded_tosses_are_mostly_right_and_the_report_is_written(setting, tmp_path, capsys):
    with np.load(DATA / "cube_tosses_even.npz") as file:
        few = {name: file[name] for name in ("2", "4", "6", "8", "10", "12", "14", "16", "18", "20", "22", "24")}
    (tmp_path / "data").mkdir()
    np.savez(tmp_path / "data" / "few.npz", **few)
    reality.main(["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--rollouts", "4", "--params", str(PARAMETERS)])
    result = json.loads((tmp_path / "out" / "reality.json").read_text())
    # 84 % are right; of twelve at least seven are in 99 of 100 draws, and by chance one in six would be.
    assert result["held_out"]["nominal"]["accuracy"] * 6 + result["chosen_on"]["nominal"]["accuracy"] * 6 >= 7
    assert result["held_out"]["perturbed"]["rollouts"] == 4
    assert (tmp_path / "out" / "reliability.png").stat().st_size > 5000
    assert "Brier" in capsys.readouterr().out
