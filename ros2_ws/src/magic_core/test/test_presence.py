"""Who counts as gone: all of those who were there, and for longer than the middleware may lose sight of them."""

from magic_core.presence import BLINK, Watch


class World:
    def __init__(self, *there):
        self.there, self.time = frozenset(there), 0.0

    def watch(self):
        return Watch(lambda: self.there, lambda: self.time)

    def after(self, seconds, *there):
        self.time += seconds
        self.there = frozenset(there)


def test_gone_is_who_stays_away():
    world = World(b"a")
    watch = world.watch()
    assert not watch.gone()
    world.after(1.0)
    assert not watch.gone()
    world.after(0.9 * BLINK)
    assert not watch.gone()
    world.after(0.2 * BLINK)
    assert watch.gone()


def test_who_is_lost_sight_of_for_a_moment_is_not_gone():
    world = World(b"a")
    watch = world.watch()
    for _ in range(5):
        world.after(0.5 * BLINK)
        assert not watch.gone()
        world.after(0.4 * BLINK, b"a")
        assert not watch.gone()


def test_another_in_the_same_place_does_not_count():
    world = World(b"a")
    watch = world.watch()
    world.after(0.1, b"b")
    assert not watch.gone()
    world.after(1.1 * BLINK, b"b")
    assert watch.gone()


def test_one_of_several_is_enough():
    world = World(b"a", b"b")
    watch = world.watch()
    world.after(1.0, b"b", b"c")
    world.after(1.1 * BLINK, b"b")
    assert not watch.gone()


def test_where_nobody_was_the_first_that_come_are_watched():
    world = World()
    watch = world.watch()
    world.after(10.0)
    assert not watch.gone() and not watch.begun
    world.after(0.1, b"a")
    assert not watch.gone() and watch.begun
    world.after(0.1)
    assert not watch.gone()
    world.after(1.1 * BLINK)
    assert watch.gone()
