"""What stands published, and when it is taken back.  No ROS here."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from magic_core.errors import Code, MagicError
from magic_server.permission import Claim, Limits, Purpose, World, permit


class Outlet(Protocol):
    """Where a motion is published; called by one thread at a time."""

    def publish(self, claim: Claim, notes: tuple[str, ...]) -> None:
        """Publish the motion of a claim, with what it rests on."""

    def withdraw(self, reason: str) -> None:
        """Say that nothing published is valid."""

    def beat(self) -> None:
        """Say again what stands."""


class Publication:
    """At most one motion stands published, and only while the rule allows it: :func:`magic_server.permission.permit`.

    What was published before this began (by a server that was killed) is taken back at once.  May be used from any thread;
    ``world()`` gives what there is at that moment.
    """

    def __init__(self, outlet: Outlet, world: Callable[[], World], limits: Limits) -> None:
        self._outlet, self._world, self._limits = outlet, world, limits
        self._lock = threading.RLock()
        self._standing: Claim | None = None
        self._closed = False
        outlet.withdraw("the strategy server has just started")

    @property
    def standing(self) -> Claim | None:
        """What is published and has not been taken back."""
        return self._standing

    def offer(self, claim: Claim) -> tuple[str, ...]:
        """Publish a motion if that is allowed now; returns what it rests on, raises what :func:`permit` does."""
        with self._lock:
            if self._closed:
                raise MagicError(Code.CANCELED, "the strategy server ends")
            notes = permit(claim, self._world(), self._limits, Purpose.PUBLISH)
            self.take_back("another motion is published instead")
            self._outlet.publish(claim, notes)
            self._standing = claim
            return notes

    def look(self) -> None:
        """See whether what stands may still stand; to be called when something has changed, and now and then."""
        with self._lock:
            claim = self._standing
            if claim is None:
                return
            try:
                permit(claim, self._world(), self._limits, Purpose.STAND)
            except MagicError as error:
                self.take_back(error.message)
            except Exception as error:  # what cannot be judged does not stand
                self.take_back(f"{type(error).__name__}: {error}")

    def beat(self) -> None:
        """Say again what stands: not while it is being taken back, after which nobody is to hear that it still does."""
        with self._lock:
            self._outlet.beat()

    def take_back(self, reason: str, run: str | None = None) -> None:
        """Take back what stands; ``run``: only if it is that run's."""
        with self._lock:
            if self._standing is not None and run in (None, self._standing.run):
                self._standing = None
                self._outlet.withdraw(reason)

    def close(self) -> None:
        """The end: nothing stands, and nothing more is published."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self.take_back("the strategy server ends")
