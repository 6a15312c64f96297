"""Calls to other nodes that always come back: by an answer, a timeout or a cancel.

Waiting happens on a condition in the caller's thread while the executor's other
threads receive the answer; nothing here spins, so that a call may be made from
inside a callback of a reentrant group.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.task import Future

from magic_core import presence
from magic_core.actions import ActionClient
from magic_core.errors import Code, MagicError
from magic_server.permission import Exchange, check_single

#: Between looks at whether a server is still there, s; discovery gives no event for it in rclpy.
PRESENCE_PERIOD = 0.1
#: After this many seconds without an answer it is asked for again.
AGAIN = 10.0
#: The service of an action that takes its goals, after the action's name.
SEND_GOAL = "/_action/send_goal"


class Token:
    """Joins the reasons to stop waiting: something arrived, the run was canceled, the node closes.

    ``within``: a token by which this one is canceled and poked as well; that one minds nothing of this one.
    """

    def __init__(self, within: Token | None = None) -> None:
        self._within = within
        self._condition: threading.Condition = threading.Condition() if within is None else within._condition
        self._canceled = self._ended = False
        self._closing = False
        self._minded: Callable[[], None] = lambda: None

    def cancel(self, closing: bool = False) -> None:
        """Make all present and later waits end with CANCELED; ``closing``: without waiting for what other nodes say to that."""
        with self._condition:
            self._canceled = True
            self._closing = self._closing or closing
            self._condition.notify_all()

    def request_cancel(self) -> bool:
        """Cancel, where there is still something to cancel: not after :meth:`end`."""
        with self._condition:
            if not self._ended:
                self.cancel()
            return not self._ended

    def end(self) -> bool:
        """What it was for is over, and no cancel comes any more; false where one has come."""
        with self._condition:
            self._ended = not self._canceled
            return self._ended

    @property
    def canceled(self) -> bool:
        """Whether :meth:`cancel` was called."""
        return self._canceled or (self._within is not None and self._within.canceled)

    @property
    def closing(self) -> bool:
        """Whether the node itself is going down."""
        return self._closing or (self._within is not None and self._within.closing)

    def check(self) -> None:
        """Raise CANCELED where :meth:`cancel` was called: before something is begun that a wait would only regret."""
        if self.canceled:
            raise MagicError(Code.CANCELED, "canceled")

    @contextmanager
    def minding(self, check: Callable[[], None]) -> Iterator[None]:
        """While inside, each wait that looks whether somebody is ``alive`` calls ``check`` as well, unless it is about an end."""
        before, self._minded = self._minded, check
        try:
            yield
        finally:
            self._minded = before

    def poke(self, *_: Any) -> None:
        """Make waiters look at their condition again; fits as a future's done callback."""
        with self._condition:
            self._condition.notify_all()

    def wait(self, done: Callable[[], bool], deadline: float, heed_cancel: bool = True, alive: Callable[[], None] | None = None) -> bool:
        """Wait until ``done()`` or until ``time.monotonic()`` reaches the deadline; returns ``done()``.

        ``alive`` is called every tenth of a second and may raise to end the wait.  Raises CANCELED.
        """
        with self._condition:
            while not done():
                if self.canceled and (heed_cancel or self.closing):
                    raise MagicError(Code.CANCELED, "canceled")
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                if alive is not None:
                    alive()
                    if heed_cancel:
                        self._minded()
                self._condition.wait(min(left, PRESENCE_PERIOD) if alive is not None else left)
            return True


class _Gone(MagicError):
    """Those who were asked have gone."""


@dataclass(frozen=True)
class Answer:
    """What came back: the response or result, an action goal's ``status``, and the one ``server`` that there was to answer."""

    result: Any
    server: bytes
    status: int = GoalStatus.STATUS_UNKNOWN


class _Remote:
    """What service and action calls share: the server's name and whether it is there."""

    #: What a server of this kind adds to its name for the service that is asked first.
    ASKED = ""

    def __init__(self, node: Node, name: str, server: str) -> None:
        self.name = node.resolve_service_name(name)
        self.server = server
        self._node = node

    def servers(self) -> frozenset[bytes]:
        """Those who serve it now."""
        return servers_of(self._node, self.name + self.ASKED)

    def ready(self) -> bool:
        """Whether the server can be seen now."""
        raise NotImplementedError

    def require(self, timeout: float, token: Token) -> None:
        """Wait for the server, and until it is alone: one that was killed stays in sight for a moment.

        Raises SERVER_UNAVAILABLE naming it, NOT_ALONE.
        """

        def one() -> bool:
            return self.ready() and len(self.servers()) <= 1

        if not token.wait(one, time.monotonic() + timeout, alive=lambda: None):
            check_single({self.name: self.servers()})
            raise MagicError(
                Code.SERVER_UNAVAILABLE, f"the {self.server} does not answer: nothing serves {self.name} (waited {timeout:.1f} s)"
            )

    def watch(self, exchange: Exchange | None = None) -> Callable[[], None]:
        """What raises SERVER_UNAVAILABLE once those who serve now have gone, be there others by then: they know nothing of what was asked.

        ``exchange`` is told who is in sight meanwhile.
        """
        servers = presence.Watch(lambda: presence.servers(self._node, self.name + self.ASKED))
        seen = self.ready()

        def still_there() -> None:
            nonlocal seen
            if exchange is not None:
                exchange.look(self.servers())
            if servers.gone() or (seen and not servers.begun and not self.ready()):
                raise _Gone(Code.SERVER_UNAVAILABLE, f"the {self.server} has gone: what served {self.name} does not any more")
            seen = seen or self.ready()

        return still_there

    def mind(self) -> Callable[[], None]:
        """What raises SERVER_UNAVAILABLE once those who serve now have gone and nobody has come in their place."""
        servers = presence.Watch(self.servers)

        def to_be_asked() -> None:
            if servers.gone() and not self.ready():
                raise MagicError(Code.SERVER_UNAVAILABLE, f"the {self.server} has gone: nothing serves {self.name} any more")

        return to_be_asked

    def _asked_again(self, ask: Callable[[float], Any], timeout: float) -> Any:
        """What ``ask(seconds left)`` returns, asked again where those asked have gone and others have come in their place meanwhile."""
        deadline = time.monotonic() + timeout
        while True:
            try:
                return ask(max(0.0, deadline - time.monotonic()))
            except _Gone:
                if not self.ready() or time.monotonic() > deadline:
                    raise

    def _answer(self, ask: Callable[[], Future], token: Token, deadline: float, alive: Callable[[], None]) -> Future | None:
        """The first future of ``ask()`` that is done, ``None`` where none is at the deadline.

        It is asked again after AGAIN seconds, and after twice as long each time: of what is under way nothing is kept for a participant
        that was out of sight, as one is on a machine that has held it up for longer than its lease, and an answer may be lost.
        """
        asked: list[Future] = []
        patience = AGAIN
        while True:
            asked.append(ask())
            asked[-1].add_done_callback(token.poke)
            if token.wait(lambda: any(f.done() for f in asked), min(deadline, time.monotonic() + patience), alive=alive):
                return next(f for f in asked if f.done())
            if time.monotonic() >= deadline:
                return None
            patience *= 2

    def _late(self, what: str, timeout: float) -> MagicError:
        return MagicError(Code.SERVER_TIMEOUT, f"the {self.server} ({self.name}) {what} within {timeout:.1f} s")


class RemoteService(_Remote):
    """A service of another node."""

    def __init__(self, node: Node, kind: Any, name: str, server: str, group: CallbackGroup) -> None:
        super().__init__(node, name, server)
        self._client = node.create_client(kind, name, callback_group=group)

    def ready(self) -> bool:
        return self._client.service_is_ready()

    def call(self, request: Any, timeout: float, token: Token, presence: float = 5.0) -> Any:
        """The response; raises SERVER_UNAVAILABLE, SERVER_TIMEOUT, CANCELED, or NOT_ALONE (several serve it)."""
        return self._asked_again(lambda left: self._call(request, left, token, presence), timeout)

    def _call(self, request: Any, timeout: float, token: Token, presence: float) -> Any:
        deadline = time.monotonic() + timeout
        self.require(min(presence, timeout), token)
        exchange = Exchange(self.name, self.servers())
        still_there = self.watch(exchange)
        asked: list[Future] = []

        def ask() -> Future:
            asked.append(self._client.call_async(request))
            return asked[-1]

        try:
            future = self._answer(ask, token, deadline, still_there)
            if future is None:
                raise self._late("did not answer", timeout)
            exchange.end(self.servers())
            return future.result()
        finally:
            for future in asked:
                if not future.done():
                    self._client.remove_pending_request(future)


class RemoteAction(_Remote):
    """An action of another node."""

    #: How long a canceled or late goal is given to end by itself, s.
    CANCEL_PATIENCE = 2.0
    ASKED = SEND_GOAL

    def __init__(self, node: Node, kind: Any, name: str, server: str, group: CallbackGroup, refusal: Code = Code.BUSY) -> None:
        super().__init__(node, name, server)
        self._refusal = refusal
        self._client = ActionClient(node, kind, name, callback_group=group)

    def ready(self) -> bool:
        return self._client.server_is_ready()

    def call(
        self,
        goal: Any,
        timeout: float,
        token: Token,
        presence: float = 5.0,
        grace: float = 0.0,
        feedback: Callable[[Any], None] | None = None,
        accepted: Callable[[], None] = lambda: None,
    ) -> Answer:
        """The answer to a goal, of one of this project's actions.

        ``timeout`` is what the server itself is given; ``grace`` what is waited
        beyond it for the answer; ``accepted`` is called, from here, when the server has taken the goal.
        Raises what :meth:`respond` does.
        """
        # Of this project's actions none changes anything but its answer: a goal may be sent again.
        answer: Answer = self._asked_again(lambda left: self.respond(goal, left, token, presence, feedback, accepted), timeout + grace)
        if answer.status != GoalStatus.STATUS_SUCCEEDED and answer.result.code == 0:
            # rclpy answers an empty result where a server's handler raised.
            raise MagicError(Code.INTERNAL, f"the {self.server} ended its goal with status {answer.status} and no result")
        return answer

    def respond(
        self,
        goal: Any,
        timeout: float,
        token: Token,
        presence: float = 5.0,
        feedback: Callable[[Any], None] | None = None,
        accepted: Callable[[], None] = lambda: None,
    ) -> Answer:
        """The answer to a goal, of any action.

        A cancel, and a timeout, are forwarded to the goal.  Raises SERVER_UNAVAILABLE, SERVER_TIMEOUT, CANCELED, NOT_ALONE
        (several serve it), or BUSY (``refusal``); the message says where the goal, canceled, may still be at work.
        """
        deadline = time.monotonic() + timeout
        self.require(min(presence, timeout), token)
        token.check()
        exchange = Exchange(self.name, self.servers())
        still_there = self.watch(exchange)
        callback = None if feedback is None else (lambda message: feedback(message.feedback))
        accepting = self._client.send_goal_async(goal, feedback_callback=callback)
        accepting.add_done_callback(token.poke)
        try:
            if not token.wait(accepting.done, deadline, alive=still_there):
                raise self._late("did not accept the goal", timeout)
            handle = accepting.result()
            if not handle.accepted:
                raise MagicError(self._refusal, f"the {self.server} ({self.name}) refused the goal")
            accepted()
            future = self._answer(handle.get_result_async, token, deadline, still_there)
            if future is None:
                raise self._late("did not finish", timeout)
            server = exchange.end(self.servers())
        except MagicError as error:
            if isinstance(error, _Gone) or self._cancel(accepting, token, still_there):
                raise
            raise MagicError(error.code, f"{error.message}; the {self.server} did not say that its goal has ended") from error
        response = future.result()
        return Answer(response.result, server, response.status)

    def _cancel(self, accepting: Any, token: Token, still_there: Callable[[], None]) -> bool:
        """Cancel a goal that nobody waits for any more, be it accepted only later; true where it is known to have ended."""
        ended = threading.Event()

        def over(_: Any = None) -> None:
            ended.set()
            token.poke()

        def stop(sent: Any) -> None:
            handle = sent.result()
            if handle is None or not handle.accepted:
                over()
            else:
                handle.cancel_goal_async()
                handle.get_result_async().add_done_callback(over)

        if accepting.done():
            stop(accepting)  # at once, even where no executor spins any more
        else:
            accepting.add_done_callback(stop)
        try:
            return token.wait(ended.is_set, time.monotonic() + self.CANCEL_PATIENCE, heed_cancel=False, alive=still_there)
        except MagicError:
            return False


def servers_of(node: Node, service: str) -> frozenset[bytes]:
    """Those who serve a service, given by its full name; as many unnamed ones as there are where the middleware does not tell who."""
    count = node.count_services(service)
    return presence.servers(node, service) or frozenset(b"unnamed %d" % i for i in range(count))
