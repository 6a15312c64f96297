"""Work that is begun before it is known whether it will be asked for."""

import threading

import pytest

from magic_server.ahead import Ahead

DEADLINE = 60.0


class Work:
    """Ends when it is told to, or canceled; ``begun`` is set when it runs."""

    def __init__(self, result="done"):
        self.begun, self.ends = threading.Event(), threading.Event()
        self.canceled = False
        self.result = result

    def __call__(self):
        self.begun.set()
        assert self.ends.wait(DEADLINE)
        if isinstance(self.result, Exception):
            raise self.result
        return self.result

    def cancel(self):
        self.canceled = True
        self.ends.set()


@pytest.fixture
def ahead():
    ahead = Ahead()
    yield ahead
    ahead.clear()


def test_it_is_found_by_its_key_and_once(ahead):
    work = Work()
    assert ahead.take("a") == (None, False)
    ahead.begin("a", work, work.cancel)
    assert work.begun.wait(DEADLINE)
    future, mine = ahead.take("a")
    assert mine and not future.done()
    work.ends.set()
    assert future.result(DEADLINE) == "done" and not work.canceled
    assert not ahead.take("a")[1]


def test_what_was_not_asked_for_is_canceled_and_can_be_waited_for(ahead):
    work = Work()
    ahead.begin("a", work, work.cancel)
    assert work.begun.wait(DEADLINE)
    future, mine = ahead.take("b")
    assert not mine and work.canceled
    assert future.result(DEADLINE) == "done"


def test_one_after_the_other(ahead):
    first, second, third = Work(), Work(), Work("third")
    first.cancel = lambda: setattr(first, "canceled", True)  # takes its time to end
    ahead.begin("a", first, first.cancel)
    assert first.begun.wait(DEADLINE)
    ahead.begin("b", second, second.cancel)
    ahead.begin("c", third, third.cancel)
    assert first.canceled and not third.begun.is_set()
    first.ends.set()
    third.ends.set()
    assert ahead.take("c")[0].result(DEADLINE) == "third"
    assert not second.begun.is_set(), "dropped before it had begun"


def test_nothing_is_under_way_after_clear(ahead):
    work = Work(ValueError("late"))
    ahead.begin("a", work, work.cancel)
    assert work.begun.wait(DEADLINE)
    ahead.clear()
    assert work.ends.is_set() and ahead.take("a") == (None, False)
