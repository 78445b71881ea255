"""Makes `stiffopt run` end in bounded time, even if the terminal or a thread hangs."""

from __future__ import annotations

import logging
import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Self

from stiffopt.cli.exits import FAULT
from stiffopt.daemon.calls import call_in_thread, ends_within

__all__ = ["Backstop", "Screen", "leave"]

_LOOK = 0.2  # s
_FLUSH = 0.3  # s
_LATE = b"error: the daemon did not end in time and is left as it is; its guard vents\n"
_log = logging.getLogger(__name__)


class Screen:
    """Prints from a thread of its own, since writing to a terminal may block."""

    def __init__(self) -> None:
        self._waiting: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="screen", daemon=True)
        self._thread.start()

    @property
    def is_behind(self) -> bool:
        """Whether something waits to be shown."""
        return not self._waiting.empty()

    def post(self, show: Callable[[], object]) -> None:
        """Have something shown; this waits for nothing."""
        self._waiting.put(show)

    def finish(self, seconds: float) -> bool:
        """Show what waits and then nothing more; return whether that is done in time."""
        self._waiting.put(None)
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (show := self._waiting.get()) is not None:
            try:
                show()
            except Exception:
                _log.exception("something could not be shown")


class Backstop:
    """A watchdog that ends the process if it does not end in time by itself.

    Parameters
    ----------
    seconds :
        That it may take from when the end has begun.
    has_begun :
        Whether it has; asked again and again.
    """

    def __init__(self, seconds: float, has_begun: Callable[[], bool]) -> None:
        self._seconds, self._has_begun = seconds, has_begun
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="backstop", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def _run(self) -> None:
        while not self._has_begun():
            if self._over.wait(_LOOK):
                return
        if not self._over.wait(self._seconds):
            _tell(_LATE)
            leave(FAULT)


def leave(code: int) -> None:
    """End this process at once, without waiting for any thread; what was printed is flushed."""
    ends_within(_FLUSH, call_in_thread("flush", _flush))
    os._exit(code)


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()


def _tell(line: bytes) -> None:
    """Write to stderr unless that would block."""
    with suppress(OSError, ValueError, AttributeError):
        ready = select.poll()
        ready.register(sys.stderr.fileno(), select.POLLOUT)
        if ready.poll(0):
            os.write(sys.stderr.fileno(), line)
