"""Requests of other threads, carried out by the control thread between its measurements."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

from stiffopt.errors import CommandError

__all__ = ["Asker", "Requests", "asked_by", "asking"]

Request = Callable[[], None]

_PATIENCE = 0.1  # s after which one that waits looks whether anybody is there to answer
_GIVEN_UP = "nobody waits for this any more; it is not done"


class Asker:
    """Whoever waits for a request, and may give it up. Any thread may call any method."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun = self._gone = False

    @property
    def gone(self) -> bool:
        """Whether it was given up."""
        return self._gone

    def give_up(self) -> bool:
        """Wait no more; return whether the request had not been begun, and so never will be."""
        with self._lock:
            self._gone = True
            return not self._begun

    def begin(self) -> None:
        """Note that the request is being carried out.

        Raises
        ------
        CommandError
            It was given up.
        """
        with self._lock:
            if self._gone:
                raise CommandError(_GIVEN_UP)
            self._begun = True


_asker: ContextVar[Asker | None] = ContextVar("asker", default=None)


@contextmanager
def asked_by(asker: Asker) -> Iterator[None]:
    """Let what this thread asks for in the body be asked for by someone who may give it up."""
    before = _asker.set(asker)
    try:
        yield
    finally:
        _asker.reset(before)


def asking() -> Asker:
    """Return for whom this thread asks; where nobody was named, one who never gives up."""
    return _asker.get() or Asker()


class _Waiting:
    """A request whose outcome somebody waits for."""

    def __init__(self, request: Request) -> None:
        self.request = request
        self.done = threading.Event()
        self.error: BaseException | None = None


class Requests:
    """Hands requests to whoever serves them, or carries them out at once where nobody does."""

    def __init__(self) -> None:
        self.turn = threading.RLock()
        """Held by whoever works with what requests change."""
        self._queue: deque[_Waiting] = deque()
        self._server: threading.Thread | None = None

    def begin(self) -> None:
        """Serve from now on, in this thread.

        Raises
        ------
        CommandError
            Another one does already.
        """
        with self.turn:
            if self._served():
                raise CommandError("the loop runs already")
            self._server = threading.current_thread()

    def end(self) -> None:
        """Serve no more; what waits is refused."""
        with self.turn:
            self._server = None
            self.serve(refusing="the loop has ended")

    def serve(self, refusing: str = "") -> None:
        """Carry out what waits, or refuse it and say why."""
        while True:
            try:
                waiting = self._queue.popleft()
            except IndexError:
                return
            try:
                if refusing:
                    raise CommandError(refusing)
                waiting.request()
            except BaseException as error:  # it is raised where it was asked for
                waiting.error = error
            waiting.done.set()

    def make(self, request: Request) -> None:
        """Have a request carried out, and return when it is; raise what it raises.

        Raises
        ------
        CommandError
            The loop has ended, or the request was given up before it was begun (see `asked_by`).
        """
        asker = asking()

        def carry_out() -> None:
            asker.begin()
            request()

        if not self._served() or threading.current_thread() is self._server:
            self._in_turn(carry_out, asker)
            return
        waiting = _Waiting(carry_out)
        self._queue.append(waiting)
        while not waiting.done.wait(_PATIENCE):
            if asker.gone:
                self._withdraw(waiting)
            if not self._served() and waiting in self._queue:
                self.serve(refusing="the loop has ended")
        if waiting.error is not None:
            raise waiting.error

    def _in_turn(self, request: Request, asker: Asker) -> None:
        while not self.turn.acquire(timeout=_PATIENCE):
            if asker.gone:
                raise CommandError(_GIVEN_UP)
        try:
            request()
        finally:
            self.turn.release()

    def _withdraw(self, waiting: _Waiting) -> None:
        """Take a request back, unless it is just being carried out."""
        with suppress(ValueError, IndexError):  # it is not there any more, or others just take some
            self._queue.remove(waiting)
            waiting.error = CommandError(_GIVEN_UP)
            waiting.done.set()

    def _served(self) -> bool:
        return self._server is not None and self._server.is_alive()
