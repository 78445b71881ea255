"""Ctrl-C while an arm is under pressure: it stops between two steps, and never the venting."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

__all__ = ["Stopping"]

_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Stopping:
    """Turns signals that end a program into one KeyboardInterrupt at a safe moment.

    The first is raised by `check`, which is called at each step; a second does not wait. While
    the rig is closed, none is: the arm is vented first.
    """

    def __init__(self) -> None:
        self._asked = False
        self._at_once = False
        self._closing = False

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Context in which signals are handled so."""
        before: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            heard = [n for n in _SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]  # nohup
            before = {number: signal.signal(number, self._handle) for number in heard}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def check(self) -> None:
        """Raise if the program shall end."""
        if self._asked:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Raise nothing from now on."""
        self._closing = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Context of what waits for a person: there a signal does not wait for a step."""
        self.check()
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        impatient = self._asked or self._at_once
        self._asked = True
        if impatient and not self._closing:
            raise KeyboardInterrupt
