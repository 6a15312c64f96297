"""Several processes find what one finds, whatever becomes of them."""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from magic_core import transforms
from magic_core.testing.work import dies, refuses, stands_still, who
from magic_core.workers import Workers
from magic_perception import shared_out as module
from magic_perception.pipeline import perceive
from magic_perception.segmentation import DepthSegmenter
from magic_perception.shared_out import Shared, perceiving, shared_out
from magic_perception.speed import OBJECTS, frame_pairs


def begun(workers, seconds=60.0):
    """The same, ready; a busy machine takes its time to begin a process."""
    end = time.monotonic() + seconds
    while not workers.ready:
        assert time.monotonic() < end
        time.sleep(0.01)
    return workers


@pytest.fixture
def workers():
    workers = begun(Workers(1, dict))
    yield workers
    workers.close()


def test_each_item_is_done_once_and_some_of_them_elsewhere(workers):
    here = os.getpid()
    found = shared_out(who, here, range(6), [1] * 6, workers)
    assert [item for item, _, _ in found] == list(range(6)) and {given for _, given, _ in found} == {here}
    assert {pid for _, _, pid in found} > {here}


def test_the_dearest_is_begun_first(workers):
    found = shared_out(who, os.getpid(), range(3), [1, 1, 100], workers)
    assert found[2][2] != os.getpid()


def test_others_begin_while_this_process_is_at_something_else(workers):
    with Shared(who, os.getpid(), range(3), [1, 2, 3], workers) as shared:
        end = time.monotonic() + 60.0
        while shared.left:
            assert time.monotonic() < end
            time.sleep(0.01)
        found = shared.done()
    assert [item for item, _, _ in found] == list(range(3)) and os.getpid() not in {pid for _, _, pid in found}


def test_what_nobody_has_begun_is_not_done_when_it_is_no_longer_wanted(workers, monkeypatch, tmp_path):
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    with pytest.raises(ValueError, match="on second thought"), Shared(who, 0, range(100), [1] * 100, workers) as shared:
        raise ValueError("on second thought")
    assert shared.left == 0 and not list(tmp_path.iterdir())
    # They are there for what comes next.
    assert {pid for _, _, pid in shared_out(who, os.getpid(), range(6), [1] * 6, workers)} > {os.getpid()}


def test_arrays_come_as_they_were_given():
    given = {
        "rows": np.arange(12.0).reshape(3, 4),
        "columns": np.asfortranarray(np.arange(12, dtype=np.int32).reshape(3, 4)),
        "every other": np.arange(24, dtype=np.uint8).reshape(4, 6)[:, ::2],
        "none": [np.zeros((0, 3)), np.zeros(0, bool)],
        "flags": np.array([True, False, True]),
        "words": "and the rest",
    }
    path = module._written(given)
    found = module._read(path)
    path.unlink()
    assert found["words"] == given["words"]
    for name in ("rows", "columns", "every other", "flags"):
        np.testing.assert_array_equal(found[name], given[name])
        assert found[name].dtype == given[name].dtype and found[name].ctypes.data % found[name].itemsize == 0
    assert [array.shape for array in found["none"]] == [(0, 3), (0,)]
    found["rows"][0] = 7  # its own copy
    assert given["rows"][0, 0] == 0


def test_nobody_is_waited_for_who_is_not_ready():
    idle = Workers(0, dict)
    assert {pid for _, _, pid in shared_out(who, 0, range(3), [1, 2, 3], idle)} == {os.getpid()}
    assert {pid for _, _, pid in shared_out(who, 0, range(3), [1, 2, 3], None)} == {os.getpid()}


@pytest.mark.parametrize("work", [dies, stands_still])
def test_what_a_process_is_lost_with_is_done_here_and_another_one_begun(work, workers, monkeypatch):
    monkeypatch.setattr(module, "MOMENT", 0.2)
    assert shared_out(work, os.getpid(), range(5), [1] * 5, workers) == list(range(5))
    # The next time, too, if nobody has noticed.
    assert [item for item, _, _ in shared_out(who, os.getpid(), range(5), [1] * 5, workers)] == list(range(5))
    begun(workers)
    assert {pid for _, _, pid in shared_out(who, os.getpid(), range(6), [1] * 6, workers)} > {os.getpid()}


def test_what_goes_wrong_elsewhere_is_told_here(workers):
    with pytest.raises(ValueError, match="no such thing"):
        shared_out(refuses, None, range(2), [2, 1], workers)


@pytest.mark.parametrize("what, name", [(module.pickle, "dump"), (module.tempfile, "mkstemp")])
def test_where_there_is_no_room_for_what_is_given_this_process_does_it_all(what, name, workers, monkeypatch, tmp_path):
    def full(*given, **more):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(what, name, full)
    assert {pid for _, _, pid in shared_out(who, 0, range(3), [1, 2, 3], workers)} == {os.getpid()}
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_of_what_was_given(workers, monkeypatch, tmp_path):
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))
    assert len({pid for _, _, pid in shared_out(who, os.getpid(), range(6), [1] * 6, workers)}) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("off", [0.0, 0.008])
def test_two_processes_see_the_scene_that_one_sees(off):
    """Also where things were begun before it was known that the cameras have to be brought together."""
    left, right = frame_pairs(1)[0]
    frames = [left, replace(right, world_from_camera=transforms.make(translation=[off, 0, 0]) @ right.world_from_camera)]
    alone = perceive(frames)
    assert any("brought together" in note for note in alone.notes) == (off > 0)
    workers = begun(perceiving(1))
    try:
        together = perceive(frames, segmenter=DepthSegmenter(workers=workers), workers=workers)
    finally:
        workers.close()
    assert len(together.objects) == len(alone.objects) == len(OBJECTS) and together.notes == alone.notes
    for one, other in zip(together.objects, alone.objects, strict=True):
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        np.testing.assert_array_equal(one.mask, other.mask)
        assert (one.id, one.confidence, one.surface_error, len(one.pieces)) == (
            other.id,
            other.confidence,
            other.surface_error,
            len(other.pieces),
        )
