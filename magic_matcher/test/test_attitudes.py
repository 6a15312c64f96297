"""The contact follows a tool that is turned any way."""

from pathlib import Path

import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core import strategy as strategies
from magic_core.scene import SceneObject
from magic_core.views import find_view
from magic_matcher import attitudes, features, global_stage, matching, plausible, tools

STRATEGIES = Path(__file__).resolve().parents[2] / "ros2_ws" / "src" / "magic_bringup" / "strategies"
if not STRATEGIES.is_dir():
    pytest.skip("the strategies are not beside this package", allow_module_level=True)


@pytest.mark.parametrize(
    ("strategy", "tool", "seed"),
    [
        ("hooking", "l_hook:5", 1),
        ("hooking", "caliper:1", 2),
        ("hanging", "mug:8", 3),
        ("hanging", "scissors:2", 4),
        ("scooping", "spoon:4", 5),
    ],
)
def test_fifty_attitudes(strategy, tool, seed):
    # Ten to each; the normal turns with the tool as well.
    found = attitudes.follow(
        matching.Matcher(features.load("embedded")),
        strategies.find(strategy, STRATEGIES),
        attitudes.load(tool, ""),
        attitudes.rotations(10, seed),
    )
    assert np.isfinite(found.points).all()
    assert found.away[0].max() < attitudes.SAME
    assert (found.normals @ found.normals[0]).min() > np.cos(np.deg2rad(5))


def test_the_command_tells_of_each_tool(tmp_path, capsys):
    attitudes.main(["--strategy", str(STRATEGIES / "hooking"), "--tools", "l_hook:5", "--attitudes", "2", "--out", str(tmp_path)])
    assert "l_hook:5" in capsys.readouterr().out and (tmp_path / "attitudes.json").is_file()
    with pytest.raises(SystemExit):
        attitudes.main(["--strategy", "nothing", "--tools", "l_hook:5", "--out", str(tmp_path)])


@pytest.mark.parametrize(("strategy", "tool"), [("scooping", "spoon:4"), ("hanging", "mug:8"), ("hooking", "l_hook:5")])
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_as_it_stands_a_contact_is_told_from_the_side_that_is_looked_at(strategy, tool, yaw):
    # How the tool is to be held follows from it: the mirror image would turn it over.
    found = strategies.find(strategy, STRATEGIES)
    mesh = attitudes.load(tool, "").transformed(transforms.from_rpy(0, 0, yaw))
    item = SceneObject("tool", mesh, (), np.eye(4), find_view(mesh, None, found.view), source="known")
    result = matching.Matcher(features.load("embedded")).match(found, [item], found.target_view, 1)
    assert result.candidates[0].tool.object_from_contact[:3, 2] @ item.view.direction > 0.97
    place = result.views["tool"].pixels(result.candidates[0].tool.object_from_contact[:3, 3])
    np.testing.assert_allclose(place, result.candidates[0].tool.pixel, atol=0.01)


def test_what_most_agree_on():
    points = np.array([[0, 0, 0], [0.1, 0, 0], [0.101, 0, 0], [np.nan] * 3])
    found = attitudes.Followed(points, points)
    assert found.most in (1, 2) and found.share == 0.5
    assert shapes.make("l_hook", 5).mesh.extents == pytest.approx(attitudes.load("l_hook:5", "side").extents)


def test_the_side_that_a_seen_tool_lies_on_is_no_place():
    """No camera has seen the hollow of a spoon that lies on its face, nor the underside of a handle: what is reconstructed there is a
    guess."""
    found = strategies.find("scooping", STRATEGIES)
    backend = features.load("embedded")

    def lying(rotation, source):
        mesh = attitudes.load("spoon:4", "").transformed(rotation)
        return SceneObject("tool", mesh, (), np.eye(4), find_view(mesh, None, found.view), source=source)

    def outward(item):
        candidates = matching.Matcher(backend).match(found, [item], found.target_view, 3).candidates
        return [c.tool.object_from_contact[:3, 0] for c in candidates]

    back, face = transforms.from_rpy(0, 0, 0.4), transforms.from_rpy(np.pi, 0, 0.4)
    assert outward(lying(back, "camera"))[0][2] > 0.9
    # A given mesh is known all around, and its hollow is found whichever way it faces.
    assert outward(lying(face, "known"))[0][2] < -0.9
    assert all(normal[2] > -np.sin(tools.DOWN) for normal in outward(lying(face, "camera")))


def test_what_faces_the_table_in_a_cut_alone_is_hidden():
    view = find_view(attitudes.load("spoon:4", ""), None, "section")
    up = np.array([0.0, 0.0, 1.0])
    down = -(view.object_from_view[:3, :2].T @ up)
    tool = matching.Tool("tool", view, up=up)
    assert tool.hides(view, down) and not tool.hides(view, -down)
    assert not matching.Tool("tool", view).hides(view, down)
    side = find_view(attitudes.load("mug:8", ""), None, "side")
    assert not matching.Tool("tool", side, up=up).hides(side, down)


@pytest.mark.parametrize(("strategy", "straight"), [("hooking", True), ("hanging", True), ("scooping", False)])
def test_a_scoop_is_led_along_and_then_up_and_a_hook_straight_on(strategy, straight):
    reference = global_stage.from_strategy(strategies.find(strategy, STRATEGIES))
    assert plausible.demands(reference, 0.0).straight is straight
