"""Requests of other threads, carried out by the control thread between its measurements."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from stiffopt.errors import CommandError

__all__ = ["Requests"]

Request = Callable[[], None]

_PATIENCE = 0.1  # s after which one that waits looks whether anybody is there to answer


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
        """Have a request carried out, and return when it is; raise what it raises."""
        if not self._served() or threading.current_thread() is self._server:
            with self.turn:
                request()
            return
        waiting = _Waiting(request)
        self._queue.append(waiting)
        while not waiting.done.wait(_PATIENCE):
            if not self._served() and waiting in self._queue:
                self.serve(refusing="the loop has ended")
        if waiting.error is not None:
            raise waiting.error

    def _served(self) -> bool:
        return self._server is not None and self._server.is_alive()
