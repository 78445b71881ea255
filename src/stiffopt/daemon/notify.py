"""Telling systemd how things stand: ready, alive, in a word, stopping."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from stiffopt.errors import MissingExtraError

__all__ = ["ServiceManager"]


class ServiceManager:
    """The service manager that started this process; without one nothing happens.

    The environment tells: ``NOTIFY_SOCKET``, and ``WATCHDOG_USEC`` if it wants signs of life.
    Nothing here waits: what the manager does not take at once is lost.

    Parameters
    ----------
    clock :
        Time in s.

    Attributes
    ----------
    watchdog_interval : seconds after which the manager ends a process that has not called
        `watchdog`; None: it does not look.

    Raises
    ------
    MissingExtraError
        There is a manager and sdnotify is not installed.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._notifier = _notifier() if os.environ.get("NOTIFY_SOCKET") else None
        self.watchdog_interval = _interval() if self._notifier is not None else None
        self._fed = float("-inf")

    def ready(self) -> None:
        """Say that the start is over."""
        self._say("READY=1")

    def status(self, text: str) -> None:
        """Say how things stand, for people."""
        self._say("STATUS=" + " ".join(text.split()))

    def watchdog(self) -> None:
        """Say that all is well; for the control loop itself, in every tick, and nobody else.

        A timer or another thread would go on to say so after the loop hangs. It is passed on when
        half of the interval is over.
        """
        if self.watchdog_interval is None:
            return
        now = self._clock()
        if now - self._fed >= 0.5 * self.watchdog_interval:
            self._fed = now
            self._say("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._say("STOPPING=1")

    def close(self) -> None:
        """Say no more."""
        notifier, self._notifier = self._notifier, None
        self.watchdog_interval = None
        if notifier is not None and notifier.socket is not None:
            notifier.socket.close()

    def _say(self, text: str) -> None:
        if self._notifier is not None:
            # sdnotify sends Latin-1 and systemd reads UTF-8: the bytes must be those of the latter
            self._notifier.notify(text.encode().decode("latin-1"))


def _notifier() -> Any:
    try:
        notifier: Any = import_module("sdnotify").SystemdNotifier()
    except ImportError:
        raise MissingExtraError("sdnotify", "daemon") from None
    if notifier.socket is not None:
        notifier.socket.setblocking(False)
    return notifier


def _interval() -> float | None:
    """Return the watchdog's interval in s, if it is meant for this process."""
    try:
        interval = float(os.environ["WATCHDOG_USEC"]) * 1e-6
        meant_for = int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0 and meant_for == os.getpid() else None
