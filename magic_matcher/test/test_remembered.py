"""What was matched before is answered at once, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from magic_core import shapes, transforms
from magic_core.content import digest
from magic_core.scene import SceneObject
from magic_matcher import matching, remembered
from magic_matcher.embedded import EmbeddedFeatures
from magic_matcher.matching import Matcher, MatchResult
from magic_matcher.remembered import Remembered


class Counted:
    """A matcher that counts what it is asked, and answers with a picture of a megabyte."""

    def __init__(self) -> None:
        self.asked = 0

    def match(self, strategy, tools, target, top_k=3, heatmap=False) -> MatchResult:
        self.asked += 1
        return MatchResult((), np.zeros((512, 512), np.float32), {}, target.id, str(self.asked), 1.0)


def things(turn: float = 0.0) -> tuple[SceneObject, SceneObject]:
    """A tool and a target, in arrays of their own each time."""
    tool = shapes.make("caliper", 3).as_object("caliper", transforms.from_rpy(0, 0, turn, [0.4, 0.0, 0.0]))
    return tool, shapes.make("cylinder", 3).as_object("cylinder", np.eye(4))


def test_the_same_objects_are_matched_once(demonstration):
    counted = Counted()
    kept = Remembered(counted)
    first, again = (kept.match(demonstration, [tool], target) for tool, target in (things(), things()))
    assert counted.asked == 1
    assert again.features == first.features and again.heatmap is first.heatmap and again.seconds < 1.0


@pytest.mark.parametrize("what", ["place", "mesh", "seen", "top_k", "heatmap", "strategy", "id"])
def test_what_differs_in_anything_is_matched_anew(demonstration, what):
    counted = Counted()
    kept = Remembered(counted)
    tool, target = things()
    kept.match(demonstration, [tool], target)
    strategy, more = demonstration, {}
    if what == "place":
        tool, _ = things(0.01)
    elif what == "mesh":
        vertices = tool.mesh.vertices.copy()
        vertices[0, 0] += 1e-9
        tool = replace(tool, mesh=replace(tool.mesh, vertices=vertices))
    elif what == "seen":
        tool = replace(tool, seen_share=0.5)
    elif what == "id":
        tool = replace(tool, id="other")
    elif what == "strategy":
        strategy = replace(demonstration)
    else:
        more = {"top_k": 5} if what == "top_k" else {"heatmap": True}
    kept.match(strategy, [tool], target, **more)
    assert counted.asked == 2


def test_what_is_kept_is_bounded(demonstration, monkeypatch):
    counted = Counted()
    monkeypatch.setattr(remembered, "MOST", 3 * 2**20)
    kept = Remembered(counted)
    for turn in range(10):
        tool, target = things(float(turn))
        kept.match(demonstration, [tool], target)
    assert len(kept._answers) == 3
    kept.match(demonstration, [things(9.0)[0]], target)
    assert counted.asked == 10
    kept.match(demonstration, [things(0.0)[0]], target)
    assert counted.asked == 11


def test_a_digest_tells_types_and_shapes():
    one = np.arange(6.0)
    values = [one, one.reshape(2, 3), one.astype(np.float32), (one[:3], one[3:]), [1, 2], (1, (2,)), "1", 1, 1.0, True, None]
    assert len({digest(value) for value in values}) == len(values)
    assert digest((one.copy(), "a")) == digest((one, "a"))
    assert digest(np.asfortranarray(one.reshape(2, 3))) == digest(one.reshape(2, 3))


def test_a_target_is_drawn_once(demonstration, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        matching, "target_view", lambda item, strategy, draw=matching.target_view: drawn.append(item) or draw(item, strategy)
    )
    matcher = Matcher(EmbeddedFeatures())
    _, target = things()
    _, same = things()
    turned = replace(target, world_from_object=transforms.from_rpy(0.0, 0.5, 0.0, [0, 0, 0]))
    views = [matcher.target_view(item, demonstration) for item in (target, same, turned)]
    assert [id(item) for item in drawn] == [id(target), id(turned)]
    assert views[1] is views[0] and not np.array_equal(views[2].object_from_view, views[0].object_from_view)
