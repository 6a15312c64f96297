"""Strategies as folders: what is saved comes back, and what is wrong is named."""

import contextlib
import os
from dataclasses import replace

import numpy as np
import pytest
import yaml

from magic_core import strategy as strategies
from magic_core import transforms as tf
from magic_core.contact import Contact, contact_frame
from magic_core.errors import Code, MagicError
from magic_core.mesh import Mesh
from magic_core.scene import CanonicalView
from magic_core.strategy import ContactPair, Goal, Physics, Strategy, Waypoint


def make():
    rng = np.random.default_rng(0)

    def view(kind):
        mask = np.zeros((32, 32), bool)
        mask[8:24, 8:24] = True
        return CanonicalView(
            rng.integers(0, 256, (32, 32, 3), dtype=np.uint8), mask, 0.001, tf.from_rpy(np.pi, 0, 0.3, [0.01, 0.02, 0.03]), kind
        )

    def contact(of, radius, concave):
        pixel, normal = np.array([23.5, 16.0]), np.array([1.0, 0.0])
        return Contact(pixel, normal, radius, concave, 0.008, contact_frame(of, pixel, normal))

    mesh = Mesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    tool, target = view("top"), view("top")
    times = np.linspace(0, 2, 5)
    return Strategy(
        name="pull",
        description="pulls — with a hook",
        view="top",
        mode="plan",
        tool_view=tool,
        tool_contact=contact(tool, 0.02, True),
        target_view=target,
        target_contact=contact(target, float("inf"), False),
        target_normal=np.array([1.0, 0, 0]),
        target_view_direction=np.array([0, 0, -1.0]),
        times=times,
        target_from_tool=np.stack([tf.from_rpy(0, 0, t, [t, 0, 0]) for t in times]),
        tool_mesh=mesh,
        target_mesh=mesh.scaled(2),
        waypoints=(Waypoint("behind", np.array([0.03, 0, 0]), "approach", 0.2), Waypoint("contact", np.zeros(3), "contact")),
        goal=Goal("hook", {"distance": 0.2}),
        physics=Physics(0.05, 500.0, 10.0, False),
        target_outline="inner",
        reflections=("turn",),
        releases=True,
        simulatable=False,
        environment={"rod": 0.3},
    )


@pytest.fixture
def folder(tmp_path):
    strategies.save(make(), tmp_path / "pull")
    return tmp_path / "pull"


def test_everything_comes_back(folder):
    before, after = make(), strategies.load(folder)
    for name in (
        "name",
        "description",
        "view",
        "mode",
        "goal",
        "physics",
        "target_outline",
        "reflections",
        "releases",
        "simulatable",
        "environment",
    ):
        assert getattr(after, name) == getattr(before, name), name
    for name in ("target_normal", "target_view_direction", "times", "target_from_tool"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-7, err_msg=name)
    for view in ("tool_view", "target_view"):
        np.testing.assert_array_equal(getattr(after, view).image, getattr(before, view).image)
        np.testing.assert_array_equal(getattr(after, view).mask, getattr(before, view).mask)
    for name in ("tool_contact", "target_contact"):
        np.testing.assert_allclose(getattr(after, name).object_from_contact, getattr(before, name).object_from_contact, atol=1e-9)
        assert getattr(after, name).radius == getattr(before, name).radius
        assert getattr(after, name).concave == getattr(before, name).concave
    assert [(w.name, w.phase, w.speed, w.offset.tolist()) for w in after.waypoints] == [
        (w.name, w.phase, w.speed, w.offset.tolist()) for w in before.waypoints
    ]
    np.testing.assert_allclose(after.target_mesh.extents, 2 * after.tool_mesh.extents, rtol=1e-6)


def several():
    """With two contacts more, one of which a waypoint names."""
    one = make()
    pixel, normal = np.array([8.5, 12.0]), np.array([-0.6, 0.8])
    tool, target = (
        Contact(pixel, normal, 0.03, False, 0.01, contact_frame(view, pixel, normal)) for view in (one.tool_view, one.target_view)
    )
    pairs = (ContactPair("heel", tool, target, np.array([-1.0, 0, 0]), "inner"), ContactPair("tip", target, tool, np.array([0, 1.0, 0])))
    return replace(one, contacts=pairs, waypoints=(*one.waypoints, Waypoint("levered", np.array([0, 0.01, 0]), "goal", 0.1, "heel")))


def test_several_contacts_come_back(tmp_path):
    before = several()
    strategies.save(before, tmp_path)
    after = strategies.load(tmp_path)
    assert [(p.name, p.target_outline) for p in after.contacts] == [("heel", "inner"), ("tip", "outer")]
    for a, b in zip(after.contacts, before.contacts, strict=True):
        np.testing.assert_allclose(a.target_normal, b.target_normal)
        for found, wanted in ((a.tool, b.tool), (a.target, b.target)):
            np.testing.assert_allclose(found.object_from_contact, wanted.object_from_contact, atol=1e-7)
            assert (found.radius, found.concave, found.scale) == (wanted.radius, wanted.concave, wanted.scale)
    assert [w.contact for w in after.waypoints] == ["", "", "heel"]
    # A single contact is written as it always was.
    strategies.save(make(), tmp_path / "one")
    text = (tmp_path / "one" / "strategy.yaml").read_text()
    assert "contacts:" not in text and "contact: heel" not in text


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda d: d["contacts"][0].pop("target"), "target"),
        (lambda d: d["contacts"][1].update(name="heel"), "each once"),
        (lambda d: d["contacts"][1].update(name=""), "each once"),
        (lambda d: d["waypoints"][2].update(contact="toe"), "contact of waypoint levered 'toe'"),
        (lambda d: d["contacts"][0]["tool"].update(pixel=[99.0, 1.0]), "pixel of the tool's contact heel"),
        (lambda d: d["contacts"][1]["target"].update(radius=-1.0), "radius of the target's contact tip"),
        (lambda d: d["contacts"][0]["target"].update(outline="under"), "outline of heel 'under'"),
        (lambda d: d["contacts"][0]["target"].update(outline="cut"), "as the first"),
        (lambda d: d["contacts"][0]["target"].pop("normal_in_world"), "normal_in_world"),
        (lambda d: d.update(mode="retarget"), "several contacts"),
        (lambda d: d.update(contacts=3), "TypeError"),
    ],
)
def test_wrong_contacts_are_named(tmp_path, change, says):
    strategies.save(several(), tmp_path)
    edit(tmp_path, change)
    with pytest.raises(MagicError, match=says) as error:
        strategies.load(tmp_path)
    assert error.value.code == Code.BAD_STRATEGY


def test_found_by_name_and_by_path(folder):
    assert strategies.find("pull", folder.parent).name == "pull"
    assert strategies.find(str(folder)).name == "pull"


@pytest.mark.parametrize("name", ["push", "", "../pull", "pull/.."])
def test_unknown_names(folder, name):
    with pytest.raises(MagicError) as error:
        strategies.find(name, folder.parent)
    assert error.value.code == Code.UNKNOWN_STRATEGY
    if "/" not in name:
        assert "pull" in error.value.message


def edit(folder, change):
    path = folder / "strategy.yaml"
    data = yaml.safe_load(path.read_text())
    change(data)
    path.write_text(yaml.safe_dump(data))


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda d: d.update(mode="guess"), "guess"),
        (lambda d: d.pop("goal"), "goal"),
        (lambda d: d["tool"].pop("contact"), "contact"),
        (lambda d: d["physics"].update(colour=1), "colour"),
        (lambda d: d["target"].update(normal_in_world=[0, 0, 0]), "direction"),
        (lambda d: d.update(reflections=["keep", "flip"]), "flip"),
        (lambda d: d.update(reflections=[]), "at least one"),
        (lambda d: d["target"].update(outline="under"), "outline of the target 'under'"),
        (lambda d: d["waypoints"][0].update(offset=[0.1, 0.2]), "offset of waypoint behind"),
        (lambda d: d["waypoints"][0].update(offset=[0.1, 0.2, float("nan")]), "offset of waypoint behind"),
        (lambda d: d["waypoints"][0].update(speed=0.0), "speed of waypoint behind: above 0"),
        (lambda d: d["waypoints"][0].update(speed=float("inf")), "speed of waypoint behind: a finite"),
        (lambda d: d["goal"]["values"].update(distance=float("nan")), "goal.values.distance: nan"),
        (lambda d: d["physics"].update(friction=-0.1), "friction"),
        (lambda d: d["physics"].update(tool_density=0.0), "tool_density"),
        (lambda d: d["tool"]["contact"].update(pixel=[32.0, 3.0]), "pixel of the tool's contact"),
        (lambda d: d["target"]["contact"].update(pixel=[float("nan"), 3.0]), "pixel of the target's contact"),
        (lambda d: d["tool"]["contact"].update(radius=-0.02), "radius of the tool's contact"),
        (lambda d: d["target"]["contact"].update(scale=0.0), "scale of the target's contact"),
    ],
)
def test_wrong_keys_are_named(folder, change, says):
    edit(folder, change)
    with pytest.raises(MagicError, match=says) as error:
        strategies.load(folder)
    assert error.value.code == Code.BAD_STRATEGY


@pytest.mark.parametrize("name", ["tool.png", "target_mask.png", "trajectory.csv", "tool.ply"])
def test_missing_files_are_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(MagicError) as error:
        strategies.load(folder)
    assert error.value.code in (Code.BAD_STRATEGY, Code.BAD_MESH)
    assert name in error.value.message


@pytest.mark.parametrize("row, column, value, says", [(2, 0, 0.1, "increasing"), (1, 0, np.nan, "finite"), (1, 3, np.inf, "poses")])
def test_a_trajectory_that_is_none(folder, row, column, value, says):
    path = folder / "trajectory.csv"
    head, *lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines]
    rows[row][column] = str(value)
    path.write_text("\n".join([head, *(",".join(r) for r in rows)]))
    with pytest.raises(MagicError, match=says) as error:
        strategies.load(folder)
    assert error.value.code == Code.BAD_STRATEGY


@pytest.mark.parametrize("name", ["empty", "nowhere"])
def test_a_folder_without_strategies_is_named(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(MagicError, match=f"'pull' .allowed: none is in {tmp_path / name}, or"):
        strategies.find("pull", tmp_path / name)


def test_without_the_installed_ones_a_path_is_asked_for(monkeypatch):
    def nowhere():
        raise LookupError("package 'magic_bringup' not found")

    monkeypatch.setattr(strategies, "installed_folder", nowhere)
    with pytest.raises(MagicError, match="path of a strategy folder") as error:
        strategies.find("hooking")
    assert error.value.code == Code.UNKNOWN_STRATEGY


def test_what_is_no_yaml(folder):
    (folder / "strategy.yaml").write_text("a: [1, ")
    with pytest.raises(MagicError) as error:
        strategies.load(folder)
    assert error.value.code == Code.BAD_STRATEGY


@pytest.mark.parametrize("name", ["x" * 5000, "/" + "x" * 5000, "/a\0b", "a\0b", "../../etc/passwd", "~", ""])
def test_names_that_no_file_can_have_are_unknown_strategies(tmp_path, name):
    with pytest.raises(MagicError) as caught:
        strategies.find(name, tmp_path)
    assert caught.value.code is Code.UNKNOWN_STRATEGY
    assert strategies.stamp(tmp_path / name) == 0


def test_what_is_asked_for_again_is_read_once_until_a_file_changes(tmp_path):
    folder = tmp_path / "pull"
    strategies.save(make(), folder)
    first = strategies.known("pull", tmp_path)
    assert strategies.known("pull", tmp_path) is first is strategies.known(str(folder))
    for name in strategies.FILES:
        # Neither size nor time of the file tell that it is another one.
        path, stat = folder / name, (folder / name).stat()
        before = path.read_bytes()
        path.write_bytes(before[:-1] + bytes([before[-1] ^ 1]))
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        with contextlib.suppress(MagicError):  # most are none any more
            assert strategies.known("pull", tmp_path) is not first, name
        path.write_bytes(before)
    assert strategies.known("pull", tmp_path) is first
    for name in ("push", str(folder / "nothing"), "a\0b/c"):
        with pytest.raises(MagicError) as error:
            strategies.known(name, tmp_path)
        with pytest.raises(MagicError) as same:
            strategies.find(name, tmp_path)
        assert (error.value.code, error.value.message) == (same.value.code, same.value.message)


def test_a_strategy_that_is_kept_cannot_be_written_to(tmp_path):
    strategies.save(make(), tmp_path / "pull")
    kept = strategies.known("pull", tmp_path)
    for array in (kept.times, kept.target_from_tool, kept.tool_view.image, kept.tool_mesh.vertices, kept.waypoints[0].offset):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    strategies.load(tmp_path / "pull").times[...] = 0


def test_no_more_strategies_are_kept_than_a_few(tmp_path):
    for number in range(strategies.MOST_KNOWN + 3):
        strategies.save(replace(make(), description=str(number)), tmp_path / "pull")
        assert strategies.known("pull", tmp_path).description == str(number)
    assert len(strategies._KNOWN) == strategies.MOST_KNOWN
