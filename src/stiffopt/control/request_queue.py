"""The queue of requests, which other threads make and the control thread carries out."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from contextvars import ContextVar

from stiffopt.errors import CommandError

Action = Callable[[], None]

_CHECK_EVERY = 0.1  # s between checks of a waiting thread whether its request can still be served
_GIVEN_UP = "nobody waits for this any more; it is not done"


class Requester:
    """A client that waits for a request and may give it up. Any thread may call any method."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun = self._gone = False

    @property
    def gone(self) -> bool:
        """Whether the request was given up."""
        return self._gone

    def give_up(self) -> bool:
        """Stop waiting; return True if the request has not begun, and so never will."""
        with self._lock:
            self._gone = True
            return not self._begun

    def begin(self) -> None:
        """Note that the request is being carried out; `CommandError` if it was given up."""
        with self._lock:
            if self._gone:
                raise CommandError(_GIVEN_UP)
            self._begun = True


_requester: ContextVar[Requester | None] = ContextVar("requester", default=None)


@contextmanager
def requested_by(requester: Requester) -> Iterator[None]:
    """Attribute the requests of this thread, in the body, to a requester, who may give them up."""
    before = _requester.set(requester)
    try:
        yield
    finally:
        _requester.reset(before)


def current_requester() -> Requester:
    """Return this thread's requester; without `requested_by`, one that never gives up."""
    return _requester.get() or Requester()


class RequestQueue:
    """Runs requests in the thread that serves them, or at once in the caller's if none serves."""

    def __init__(self) -> None:
        self.turn = threading.RLock()  # held during a tick and during a request
        self._queue: deque[tuple[Future[None], Action]] = deque()
        self._server: threading.Thread | None = None

    def begin(self) -> None:
        """Serve from now on in this thread; `CommandError` if another thread serves."""
        with self.turn:
            if self._served():
                raise CommandError("the loop runs already")
            self._server = threading.current_thread()

    def end(self) -> None:
        """Stop serving; refuse waiting requests."""
        with self.turn:
            self._server = None
            self.serve(refusing="the loop has ended")

    def serve(self, refusing: str = "") -> None:
        """Carry out the waiting requests, or refuse them for the reason `refusing`."""
        while True:
            try:
                outcome, action = self._queue.popleft()
            except IndexError:
                return
            if not outcome.set_running_or_notify_cancel():
                continue  # it was given up
            try:
                if refusing:
                    raise CommandError(refusing)
                action()
            except BaseException as error:  # raised in the thread that made the request
                outcome.set_exception(error)
            else:
                outcome.set_result(None)

    def submit(self, action: Action) -> None:
        """Run a request, wait for its end, and raise what it raises.

        `CommandError`: the loop has ended, or the requester gave up before the request began (see
        `requested_by`).
        """
        requester = current_requester()

        def carry_out() -> None:
            requester.begin()
            action()

        if not self._served() or threading.current_thread() is self._server:
            self._in_turn(carry_out, requester)
            return
        outcome: Future[None] = Future()
        self._queue.append((outcome, carry_out))
        while not wait([outcome], _CHECK_EVERY).done:
            if requester.gone and outcome.cancel():  # it cannot be cancelled once it runs
                raise CommandError(_GIVEN_UP)
            if not self._served():
                self.serve(refusing="the loop has ended")
        outcome.result()

    def _in_turn(self, action: Action, requester: Requester) -> None:
        while not self.turn.acquire(timeout=_CHECK_EVERY):
            if requester.gone:
                raise CommandError(_GIVEN_UP)
        try:
            action()
        finally:
            self.turn.release()

    def _served(self) -> bool:
        return self._server is not None and self._server.is_alive()
