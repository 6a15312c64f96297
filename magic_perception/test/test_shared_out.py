"""Several processes find what one finds, whatever becomes of them."""

import os
import time

import numpy as np
import pytest

from magic_core.testing.work import dies, refuses, stands_still, who
from magic_core.workers import Workers
from magic_perception import shared_out as module
from magic_perception.pipeline import perceive
from magic_perception.segmentation import DepthSegmenter
from magic_perception.shared_out import perceiving, shared_out
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


def test_two_processes_see_the_scene_that_one_sees():
    frames = frame_pairs(1)[0]
    alone = perceive(frames)
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
